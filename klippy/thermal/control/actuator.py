"""Watts to bridge phase and back.

Drive law (fit to Oskolkov 2021, its inverse is exact):

    P = P_full sin(phi/2)^n (Vdc/V0)^n,    phi = pi phase/phase_max

Measuring needs excitation: below `phase_low_ticks` the coil says nothing. A request under the power of that
phase (about 1.5 W) is met by pulses at that phase against bridge off, so that the mean power is right and
every pulse is long enough to give a whole measured block. Even a request of zero gives one pulse each
`sense_interval_s`, so that the temperature stays known; that surplus is carried as a debt and taken off later
requests.

    request ->  |‾‾|______|‾‾|______|‾‾‾‾‾|___    pulses of pulse_s at phase_low, mean = request
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from thermal.models.drive_law import DriveLaw
from thermal.records import PhaseCommand, Planned
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS

LOOK_SHARE = 0.05  # of full power: a weaker drive is read without looks
# From look to look the nozzle rises by this much, within these times. A look of 0.3 ms each 18 ms costs 1.7 % of power.
LOOK_C, LOOK_MIN_S, LOOK_MAX_S = 6.0, 0.018, 0.100
LOOK_RARE_S = 0.050  # so far apart they may be long
LOOK_DOUBT_C = 20.0  # more doubt about full drive than this: a look at each command


@dataclass(frozen=True, slots=True)
class ActuatorParameters:
    """Drive law and the timing of sensing pulses."""

    law: DriveLaw
    pulse_s: float  # settling plus one whole block
    sense_interval_s: float = 0.1  # longest time without a pulse while a target is set
    idle_interval_s: float = (
        0.5  # the same with the heater off, if its blocks arrive: 1.5 W * 8.9 ms / 0.5 s = 27 mW
    )
    phase_low_ticks: int = SENSING_PHASE_TICKS
    pulses_max: int = 2  # in one piece: as many as fill the time until the next command
    look_s: float = 0.0  # a look at the sensing phase within a strong drive; 0: none ...
    long_look_s: float = 0.0  # ... and one that is taken rarely

    @property
    def power_low_w(self) -> float:
        """Heat at the smallest useful phase."""
        return self.law.power_w(self.phase_low_ticks)


@dataclass(slots=True)
class ActuatorState:
    """What was delivered against what was asked."""

    last_s: float = -math.inf  # start of the interval the last request holds for
    request_w: float = 0.0  # request in force since last_s
    owed_j: float = 0.0  # asked minus delivered
    last_excited_s: float = -math.inf  # end of the last pulse or continuous drive
    driving: bool = False  # continuous drive (phase above the smallest) since last_s
    look_s: float = -math.inf  # start of the newest look at the sensing phase


def _account(parameters: ActuatorParameters, state: ActuatorState, time_s: float) -> None:
    """Add the request of the interval that ends now. Continuous drive delivers what is requested."""
    if state.driving:
        state.last_excited_s = time_s
        state.owed_j = 0.0
    elif state.last_s > -math.inf:
        state.owed_j += state.request_w * (time_s - state.last_s)
    limit_j = 2.0 * parameters.pulses_max * parameters.power_low_w * parameters.pulse_s
    state.owed_j = min(limit_j, max(-limit_j, state.owed_j))


def actuate(
    parameters: ActuatorParameters,
    state: ActuatorState,
    power_w: float,
    time_s: float,
    is_on: bool,
    idle: bool = False,
) -> list[PhaseCommand]:
    """Commands that start meeting `power_w` at `time_s`; in order of time, the first at `time_s` if any.

    An empty list means: the bridge stays off, between pulses. The last command of a pulse turns the bridge off, so a
    host that dies in between leaves nothing running. `is_on`: with nothing more sent, the bridge is on at `time_s` or
    later, booked pulses apart. `idle`: no target, sense rarely.
    """
    _account(parameters, state, time_s)
    state.last_s = time_s
    state.request_w = max(0.0, power_w)
    law = parameters.law
    phase = round(law.phase_ticks(power_w))
    if phase >= parameters.phase_low_ticks:
        state.driving = True
        return [PhaseCommand(time_s, phase, law.power_w(phase))]
    state.driving = False
    pulse_j = parameters.power_low_w * parameters.pulse_s
    interval_s = parameters.idle_interval_s if idle else parameters.sense_interval_s
    pulses = min(parameters.pulses_max, math.floor(state.owed_j / pulse_j + 0.5))
    if pulses < 1 and time_s - state.last_excited_s >= interval_s:
        pulses = 1
    if pulses < 1:
        return [PhaseCommand(time_s, 0, 0.0)] if is_on else []
    end_s = time_s + pulses * parameters.pulse_s
    state.owed_j -= pulses * pulse_j
    state.last_excited_s = end_s
    return [
        PhaseCommand(time_s, parameters.phase_low_ticks, parameters.power_low_w),
        PhaseCommand(end_s, 0, 0.0),
    ]


def ahead(
    parameters: ActuatorParameters, first: PhaseCommand, horizon: Sequence[Planned]
) -> list[PhaseCommand]:
    """Commands after `first` that follow a law's horizon, for the case that nothing newer arrives.

    Below the smallest useful phase the bridge is off or at that phase, whichever is nearer: pulses are booked only
    when they are sure to come.
    """
    law, low_w = parameters.law, parameters.power_low_w
    commands, before = [], first
    for planned in horizon:
        phase = round(law.phase_ticks(planned.value))
        if phase < parameters.phase_low_ticks:
            phase = parameters.phase_low_ticks if planned.value > 0.5 * low_w else 0
        if phase == before.phase_ticks or planned.time_s <= before.time_s:
            continue
        before = PhaseCommand(planned.time_s, phase, law.power_w(phase))
        commands.append(before)
    return commands


def with_look(
    parameters: ActuatorParameters,
    state: ActuatorState,
    commands: list[PhaseCommand],
    rate_k_s: float,
    doubt_c: float,
) -> list[PhaseCommand]:
    """A strong drive begins with a look at the sensing phase, if one is due: where the reading is true. It shows by how
    much that of the strong drive is off (thermal/sensing/drive_offset.h).

    `rate_k_s`: heating rate of the commands; `doubt_c`: 1 sigma of what full drive adds to the reading.
    """
    first = commands[0]
    strong = (first.phase_ticks / parameters.law.phase_max_ticks) ** 2 >= LOOK_SHARE
    if not strong or not parameters.look_s:
        return commands
    apart_s = min(LOOK_MAX_S, max(LOOK_MIN_S, LOOK_C / max(1e-3, rate_k_s)))
    if 0.0 < first.time_s - state.look_s < (0.0 if doubt_c > LOOK_DOUBT_C else apart_s):
        return commands
    state.look_s = first.time_s
    after_s = first.time_s + (parameters.long_look_s if apart_s >= LOOK_RARE_S else parameters.look_s)
    look = PhaseCommand(first.time_s, parameters.phase_low_ticks, parameters.power_low_w)
    return [look, first._replace(time_s=after_s), *(c for c in commands[1:] if c.time_s > after_s)]
