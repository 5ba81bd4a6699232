"""bridge.h in Python, as plain as can be: what the C has to agree with to the last bit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from thermal.control import bridge_driver
from thermal.control.actuator import ActuatorParameters
from thermal.control.timeline import Timing
from thermal.models.heat_loss import HeatCapacity
from thermal.records import PhaseCommand, Planned

TIME_SLACK_S = 1e-7
KEEP_S = 0.4
LOOK_SHARE = 0.05  # of full power: a weaker drive is read without looks
# From look to look the nozzle rises by this much, within these times. A look of 0.3 ms each 18 ms costs 1.7 % of power.
LOOK_C, LOOK_MIN_S, LOOK_MAX_S = 6.0, 0.006, 0.100
LOOK_RARE_S = 0.050  # so far apart they may be long
LOOK_DOUBT_C = 20.0  # more doubt about full drive than this: a look at each command
NOT_COMMANDED = PhaseCommand(-math.inf, 0, 0.0)


@dataclass(slots=True)
class Timeline:
    """Commands of one bridge in order of time: the newest that is surely in force, and all after it."""

    edge_s: float = -math.inf  # an edge between two blocks
    commands: list[PhaseCommand] = field(default_factory=lambda: [NOT_COMMANDED])
    head: PhaseCommand = NOT_COMMANDED  # first of the newest plan

    @property
    def newest(self) -> PhaseCommand:
        return self.commands[-1]

    def note(self, commands: list[PhaseCommand], now_s: float) -> None:
        """These are sent now."""
        if not commands:
            return
        self.head = commands[0]
        start_s = commands[0].time_s - TIME_SLACK_S
        kept = [c for c in self.commands if c.time_s < start_s]
        past = sum(1 for c in kept if c.time_s <= now_s - KEEP_S)
        self.commands = kept[max(0, past - 1) :] + commands

    def last_before(self, time_s: float) -> PhaseCommand:
        """The command in force just before `time_s`."""
        for command in reversed(self.commands):
            if command.time_s < time_s:
                return command
        return self.commands[0]

    def is_on_from(self, time_s: float) -> bool:
        """Is the bridge on at `time_s` or later, if nothing more is said?"""
        if self.last_before(time_s + TIME_SLACK_S).phase_ticks:
            return True
        return any(c.phase_ticks for c in self.commands if c.time_s > time_s)

    def at(self, time_s: float) -> PhaseCommand | None:
        """The command that begins at `time_s`, if one does."""
        for command in reversed(self.commands):
            if command.time_s <= time_s + TIME_SLACK_S:
                return command if command.time_s >= time_s - TIME_SLACK_S else None
        return None

    def pending(self, after_s: float, until_s: float) -> tuple[Planned, ...]:
        """Heat (W) of the commands that begin within this time."""
        return tuple(Planned(c.time_s, c.power_w) for c in self.commands if after_s <= c.time_s < until_s)

    def differs(self, plan: Sequence[Planned], by_w: float) -> bool:
        """Whether, from the plan's first time on, what was sent differs from it by more than this anywhere."""
        first_s = plan[0].time_s + TIME_SLACK_S
        for planned in plan:
            if abs(self.last_before(planned.time_s + TIME_SLACK_S).power_w - planned.value) > by_w:
                return True
        i = 0
        for command in self.commands:
            if command.time_s > first_s:
                while i + 1 < len(plan) and plan[i + 1].time_s <= command.time_s + TIME_SLACK_S:
                    i += 1
                if abs(command.power_w - plan[i].value) > by_w:
                    return True
        return False

    def edge(self, timing: Timing, earliest_s: float) -> float:
        """First edge between two blocks not before `earliest_s`, given the commands already sent."""
        edge_s = self.edge_s
        before = self.last_before(earliest_s + TIME_SLACK_S)
        if before.time_s > edge_s:
            edge_s = before.time_s + timing.settle_s
        if edge_s == -math.inf:
            return earliest_s
        blocks = math.ceil((earliest_s - edge_s) / timing.block_s - 1e-6)
        return edge_s + max(0, blocks) * timing.block_s

    def slot(self, timing: Timing, now_s: float, apart_s: float, lead_s: float) -> float:
        """Where a command sent now may begin: lead time ahead and `apart_s` after the last that stays."""
        earliest_s = now_s + lead_s
        settled = self.last_before(earliest_s)
        return self.edge(timing, max(earliest_s, settled.time_s + apart_s))


@dataclass(slots=True)
class ActuatorState:
    """What was delivered against what was asked."""

    last_s: float = -math.inf  # start of the interval the last request holds for
    request_w: float = 0.0  # request in force since last_s
    owed_j: float = 0.0  # asked minus delivered
    last_excited_s: float = -math.inf  # end of the last pulse or continuous drive
    driving: bool = False  # continuous drive (phase above the smallest) since last_s
    look_s: float = -math.inf  # start of the newest look at the sensing phase
    hold_look_s: float = -math.inf  # start of the newest look out of a weak drive ...
    hold_look: int = 0  # ... and its number


def _account(parameters: ActuatorParameters, state: ActuatorState, time_s: float) -> None:
    """Add the request of the interval that ends now. Continuous drive delivers what is requested."""
    if state.driving:
        state.last_excited_s = time_s
        state.owed_j = 0.0
    elif state.last_s > -math.inf:
        state.owed_j += state.request_w * (time_s - state.last_s)
    limit_j = 2.0 * parameters.pulses_max * parameters.power_low_w * parameters.pulse_s
    state.owed_j = min(limit_j, max(-limit_j, state.owed_j))


def sensing_s(parameters: ActuatorParameters, need: str, since_s: float) -> float:
    """Length of the pulse that is due for the sake of measuring."""
    if need == "watch" and parameters.look_s:
        return parameters.look_s if since_s >= parameters.watch_interval_s - TIME_SLACK_S else 0.0
    interval_s = parameters.idle_interval_s if need == "idle" else parameters.sense_interval_s
    return parameters.pulse_s if since_s >= interval_s else 0.0


def actuate(
    parameters: ActuatorParameters,
    state: ActuatorState,
    power_w: float,
    time_s: float,
    is_on: bool,
    need: str = "lost",
) -> list[PhaseCommand]:
    """Commands that start meeting `power_w` at `time_s`; in order of time, the first at `time_s` if any.

    An empty list means: the bridge stays off, between pulses. The last command of a pulse turns the bridge off, so a
    host that dies in between leaves nothing running. `is_on`: with nothing more sent, the bridge is on at `time_s` or
    later, booked pulses apart. `need`: sense rarely ("idle"), more often ("lost"), or shortly
    and all the time ("watch").
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
    pulses = min(parameters.pulses_max, math.floor(state.owed_j / pulse_j + 0.5))
    length_s = pulses * parameters.pulse_s
    if pulses < 1:
        length_s = sensing_s(parameters, need, time_s - state.last_excited_s)
    if not length_s:
        return [PhaseCommand(time_s, 0, 0.0)] if is_on else []
    end_s = time_s + length_s
    state.owed_j -= parameters.power_low_w * length_s
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
    if not strong:
        return with_hold_look(parameters, state, commands)
    if not parameters.look_s:
        return commands
    apart_s = min(LOOK_MAX_S, max(LOOK_MIN_S, LOOK_C / max(1e-3, rate_k_s)))
    if 0.0 < first.time_s - state.look_s < (0.0 if doubt_c > LOOK_DOUBT_C else apart_s):
        return commands
    state.look_s = first.time_s
    after_s = first.time_s + (parameters.long_look_s if apart_s >= LOOK_RARE_S else parameters.look_s)
    look = PhaseCommand(first.time_s, parameters.phase_low_ticks, parameters.power_low_w)
    return [look, first._replace(time_s=after_s), *(c for c in commands[1:] if c.time_s > after_s)]


def with_hold_look(
    parameters: ActuatorParameters, state: ActuatorState, commands: list[PhaseCommand]
) -> list[PhaseCommand]:
    """A weak drive begins with a look at one phase after the other, if one is due; a pulse keeps its length."""
    first, phases, look_s = commands[0], parameters.hold_look_ticks, parameters.look_s
    if not phases or not parameters.hold_look_s or not look_s or not first.phase_ticks:
        return commands
    since_s = first.time_s - state.hold_look_s
    if 0.0 < since_s < parameters.hold_look_s:
        return commands
    if since_s != 0.0:
        state.hold_look = (state.hold_look + 1) % len(phases)
    state.hold_look_s = first.time_s
    rest = commands[1:]
    if not state.driving:
        state.last_excited_s = rest[0].time_s + look_s
        rest = [rest[0]._replace(time_s=state.last_excited_s)]
    phase, after_s = phases[state.hold_look], first.time_s + look_s
    look = PhaseCommand(first.time_s, phase, parameters.law.power_w(phase))
    state.owed_j -= look.power_w * look_s
    return [look, first._replace(time_s=after_s), *(c for c in rest if c.time_s > after_s)]


@dataclass(frozen=True, slots=True)
class Request:
    """What the bridge shall do, and what is known now."""

    now_s: float
    apart_s: float
    target_c: float
    power_w: float
    estimate_s: float
    estimate_c: float
    horizon: tuple[Planned, ...] = ()


@dataclass(slots=True)
class Bridge:
    """One bridge: `plans` as in struct bridge_params."""

    timing: Timing
    actuator: ActuatorParameters
    power_max_w: float
    plans: bool
    heat: HeatCapacity | None = None  # of a calibrated sensing law
    doubt_c: float = 0.0  # about full drive
    line: Timeline = field(default_factory=Timeline)
    owed: ActuatorState = field(default_factory=ActuatorState)

    def slot(self, now_s: float, apart_s: float) -> float | None:
        """Where a command sent now may begin; None: it is too soon after the last."""
        timing = self.timing
        if self.plans:
            lead_s = timing.lead_s if apart_s > 0.0 else min(timing.lead_s, bridge_driver.PROMPT_S)
            return self.line.slot(timing, now_s, min(apart_s, timing.control_s) - TIME_SLACK_S, lead_s)
        at_s = self.line.edge(timing, now_s + timing.lead_s)
        apart_s = min(apart_s, timing.control_s)
        taken_s = self.line.newest.time_s + max(TIME_SLACK_S, apart_s - TIME_SLACK_S)
        return at_s if at_s > taken_s else None

    def improves(self, taken: PhaseCommand, power_w: float, horizon: tuple[Planned, ...]) -> bool:
        """Is it worth a message to send anew what was sent for this edge?"""
        driving = self.owed.driving and power_w >= self.actuator.power_low_w
        if not self.plans or not driving or not taken.phase_ticks:
            return False
        plan = (Planned(taken.time_s, power_w), *horizon)
        return self.line.differs(plan, bridge_driver.RESEND_SHARE * self.power_max_w)

    def command(self, request: Request) -> list[PhaseCommand]:
        """The request as commands from the next usable edge on."""
        now_s, actuator = request.now_s, self.actuator
        at_s = self.slot(now_s, request.apart_s)
        if at_s is None:
            return []
        power_w = request.power_w if request.target_c > 0.0 else 0.0
        horizon = request.horizon if request.target_c > 0.0 else ()
        stale_s = self.timing.stale_s + (0.0 if self.owed.driving else actuator.idle_interval_s)
        if power_w > 0.0 and not now_s - request.estimate_s <= stale_s:
            power_w, horizon = actuator.power_low_w, ()
        taken = self.line.at(at_s)
        if taken is not None and request.apart_s > 0.0 and not self.improves(taken, power_w, horizon):
            return []
        arriving_s = actuator.idle_interval_s + bridge_driver.PULSE_DELAY_S
        need = "idle" if now_s - request.estimate_s <= arriving_s else "lost"
        need = "watch" if request.target_c > 0.0 else need
        is_on = self.line.is_on_from(max(at_s, self.owed.last_excited_s))
        commands = actuate(actuator, self.owed, power_w, at_s, is_on, need)
        if len(commands) == 1:
            late = Planned(at_s + self.timing.control_s, power_w)  # between pulses, if the host is late
            is_planned = bool(horizon) and horizon[0].time_s <= late.time_s
            if self.plans and power_w > 0.0 and not commands[0].phase_ticks and not is_planned:
                commands += ahead(actuator, commands[0], [late])
            commands += ahead(actuator, commands[-1], horizon)
        if commands and self.heat is not None and power_w > 0.0:
            rate_k_s = power_w / self.heat.at(request.estimate_c)
            looked = with_look(actuator, self.owed, commands, rate_k_s, self.doubt_c)
            self.line.note(looked, now_s)
            self.line.head = commands[0]
            return looked
        self.line.note(commands, now_s)
        return commands
