"""Watts to bridge phase and back.

Drive law (fit to Oskolkov 2021, its inverse is exact):

    P = P_full sin(phi/2)^n (Vdc/V0)^n,    phi = pi phase/phase_max

Measuring needs excitation: below `phase_low_ticks` the coil says nothing. A request under the power of that
phase (about 1.5 W) is met by pulses at that phase against bridge off, so that the mean power is right and
every pulse is long enough to give a whole measured block. Even a request of zero gives one pulse each
`sense_interval_s`, so that the temperature stays known; that surplus is carried as a debt and taken off later
requests. The work is done in C: actuator_act and actuator_ahead of bridge.h.

    request ->  |‾‾|______|‾‾|______|‾‾‾‾‾|___    pulses of pulse_s at phase_low, mean = request
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from thermal.models.drive_law import DriveLaw
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS


@dataclass(frozen=True, slots=True)
class ActuatorParameters:
    """Drive law and the timing of sensing pulses."""

    law: DriveLaw
    pulse_s: float  # settling plus one whole block
    sense_interval_s: float = 0.1  # longest time without a pulse while a target is set
    idle_interval_s: float = (
        0.5  # the same with the heater off, if its blocks arrive: 1.5 W * 8.9 ms / 0.5 s = 27 mW
    )
    watch_interval_s: float = 0.0  # longest time without a measurement while a target is set, if `look_s`
    phase_low_ticks: int = SENSING_PHASE_TICKS
    pulses_max: int = 2  # in one piece: as many as fill the time until the next command
    look_s: float = 0.0  # a look at the sensing phase within a strong drive; 0: none ...
    long_look_s: float = 0.0  # ... and one that is taken rarely
    hold_look_s: float = 0.0  # a look out of a weak drive or a pulse as often as this; 0: none ...
    hold_look_ticks: tuple[int, ...] = ()  # ... to these phases in turn, for `look_s`; four at most

    @property
    def power_low_w(self) -> float:
        """Heat at the smallest useful phase."""
        return self.law.power_w(self.phase_low_ticks)

    def packed(self) -> dict[str, Any]:
        """As C's struct actuator_params."""
        law = self.law
        return {
            "power_max_w": law.power_max_w,
            "exponent": law.exponent,
            "phase_max_ticks": law.phase_max_ticks,
            "power_low_w": self.power_low_w,
            "pulse_s": self.pulse_s,
            "sense_interval_s": self.sense_interval_s,
            "idle_interval_s": self.idle_interval_s,
            "watch_interval_s": self.watch_interval_s,
            "phase_low_ticks": self.phase_low_ticks,
            "pulses_max": self.pulses_max,
            "look_s": self.look_s,
            "long_look_s": self.long_look_s,
            "hold_look_s": self.hold_look_s,
            "hold_looks": len(self.hold_look_ticks),
            "hold_look_ticks": list(self.hold_look_ticks),
        }
