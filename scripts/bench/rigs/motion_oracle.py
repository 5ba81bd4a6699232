"""An oracle for steps: those of a batch run against where every motor has to be, worked out from the plan alone.

    planned moves (listener) -> exact places (motion_exact.py) -.
                                                                 >- each step at most 25 us before its time, none after
    bytes of a batch run     -> steps of each motor            -'

A step's time is when its motor passes the middle between two places of its grid.
"""

from __future__ import annotations

import configparser
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import msgproto
from batch_messages import CLOCK_HZ, MAX_ERROR_S, batch_args, decode, dictionary
from motion_exact import Array, Epoch, Ramps, filament_epochs, geometry, head_epochs
from printer import Printer
from reactor import Reactor

# clocks are whole numbers at both ends of the conversion from print_time
TICK_S = 2.0 / CLOCK_HZ
# Share of a step by which a motor may miss an edge: matters only where it turns around and stands almost still.
SLACK_STEPS = 2e-4
# A step and its reversal within this time are left out: they would move nothing.
CANCEL_S = 750e-6

# ---- a run with its plan ----


@dataclass
class Recording:
    """What the toolhead planned, in order: (kind, what)."""

    log: list[tuple[str, Any]] = field(default_factory=list)
    wanted: list[tuple[Any, ...]] = field(default_factory=list)  # limits when each move came in

    def attach(self, printer: Any) -> None:
        toolhead = printer.lookup_object("toolhead")
        toolhead.register_move_listener(lambda moves: self.log.extend(("move", move) for move in moves))
        self._watch(toolhead, "set_position", lambda p, *_: ("set", (toolhead.print_time, tuple(p[:3]))))
        self._watch(toolhead, "_begin_drip", lambda move: ("move", self._started(toolhead, move)))
        shaper = printer.lookup_object("input_shaper", None)
        if shaper is not None:
            self._watch(shaper, "_set_pulses", lambda axes: ("shaper", (toolhead.print_time, tuple(axes))))
        extruder = printer.lookup_object("extruder", None)
        if extruder is not None:
            self._watch(
                extruder.extruder_stepper,
                "_set_pressure_advance",
                lambda advance, smooth: ("advance", (toolhead.print_time, advance, smooth)),
            )
        self._watch_limits(toolhead)

    @staticmethod
    def _started(toolhead: Any, move: Any) -> Any:
        move.print_time = toolhead.print_time - (move.accel_t + move.cruise_t + move.decel_t)
        return move

    def _watch(self, owner: Any, name: str, entry: Callable[..., tuple[str, Any]]) -> None:
        original = getattr(owner, name)

        def watched(*args: Any, **kwargs: Any) -> Any:
            result = original(*args, **kwargs)
            self.log.append(entry(*args))
            return result

        setattr(owner, name, watched)

    def _watch_limits(self, toolhead: Any) -> None:
        original = toolhead.lookahead.add_move

        def add_move(move: Any, extruder: Any) -> bool:
            limits = (toolhead.max_velocity, toolhead.max_accel, toolhead.square_corner_velocity)
            self.wanted.append((move.end_pos, *limits, math.sqrt(move.max_cruise_v2)))
            return original(move, extruder)

        toolhead.lookahead.add_move = add_move


@dataclass(frozen=True)
class Steps:
    """Of one motor: time of each step (s of its MCU), place after it in steps (positive as commanded)."""

    times: Array
    after: Array

    @property
    def before(self) -> Array:
        return np.concatenate([[0], self.after[:-1]])

    def count_at(self, times: Array | float) -> Array:
        return np.concatenate([[0], self.after])[np.searchsorted(self.times, times, side="right")]


@dataclass
class Decoder:
    """Commands of one motor to steps, as its MCU would make them."""

    base: int = 0
    direction: int = 0
    rows: list[tuple[int, int, int, int, int]] = field(default_factory=list)

    def feed(self, params: dict[str, Any], now: int) -> None:
        """`now`: the last clock of any motor before this command. A new clock base is the one nearest to it, as the
        MCU only sees 32 bits."""
        if params["#name"] == "set_next_step_dir":
            self.direction = 1 if params["dir"] else -1
        elif params["#name"] == "reset_step_clock":
            near = max(self.base, now - 2**31)
            self.base = near + ((params["clock"] - near) & 0xFFFFFFFF)
        else:
            interval, count, add = params["interval"], params["count"], params["add"]
            self.rows.append((self.base, interval, count, add, self.direction))
            self.base += interval * count + add * (count * (count - 1) // 2)

    def steps(self, sign: int, clock_hz: float = CLOCK_HZ) -> Steps:
        table = np.array(self.rows, dtype=np.int64).reshape(-1, 5)
        many = np.repeat(table, table[:, 2], axis=0)
        ends = np.cumsum(table[:, 2])
        k = np.arange(len(many)) - np.repeat(ends - table[:, 2], table[:, 2]) + 1
        clocks = many[:, 0] + k * many[:, 1] + many[:, 3] * (k * (k - 1) // 2)
        assert np.all(np.diff(clocks) > 0), "steps out of order"
        return Steps(clocks / clock_hz, np.cumsum(sign * many[:, 4]))


@dataclass
class Run:
    """A batch run: what was planned, and the steps of each motor by name."""

    printer: Any
    recording: Recording
    steps: dict[str, Steps]
    motors: dict[str, Any]
    options: configparser.ConfigParser


def run_batch(folder: Path, gcode: str, config: str, record: bool = True) -> Run:
    """Run G-code in batch mode; without `record` nobody listens, and moves take the short way through C."""
    for name, text in (("printer.cfg", config), ("in.gcode", gcode)):
        (folder / name).write_text(text)
    (folder / "dict").write_bytes(dictionary())
    reactor = Reactor()
    printer = Printer(reactor, batch_args(folder))
    recording = Recording()
    if record:
        printer.register_event_handler("klippy:connect", lambda: recording.attach(printer))
    replies: list[str] = []
    printer.lookup_object("gcode").register_output_handler(replies.append)
    result = printer.run()
    assert result == "exit", (printer.get_state_message()[0], replies[-3:])
    reactor.finalize()
    blocks = msgproto.BlockReader().feed((folder / "out").read_bytes())
    params = decode([block.content for block in blocks if block is not None])
    motors = {m.get_oid(): m for m in printer.lookup_object("force_move").steppers.values()}
    decoders, now = {oid: Decoder() for oid in motors}, 0
    for command in params:
        if command["#name"] in ("queue_step", "set_next_step_dir", "reset_step_clock"):
            decoder = decoders[command["oid"]]
            decoder.feed(command, now)
            now = max(now, decoder.base)
    steps = {m.get_name(): decoders[oid].steps(-1 if m.is_dir_inverted() else 1) for oid, m in motors.items()}
    options = configparser.ConfigParser(strict=False, interpolation=None)
    options.read_string(config)
    return Run(printer, recording, steps, {m.get_name(): m for m in motors.values()}, options)


# ---- the check ----


@dataclass
class Tally:
    """What was looked at."""

    steps: int = 0
    moves: int = 0
    earliest_s: float = 0.0  # of a step against its analytic time
    latest_s: float = 0.0
    turning: int = 0  # steps so near to a turning point that only the slack decides
    faults: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        self.steps += other.steps
        self.moves += other.moves
        self.earliest_s = max(self.earliest_s, other.earliest_s)
        self.latest_s = max(self.latest_s, other.latest_s)
        self.turning += other.turning
        self.faults += other.faults


@dataclass
class Follow:
    """One motor between two changes: where(t) in mm (rad), steps of it, and the coordinate of step 0."""

    name: str
    where: Callable[[Array], Array]
    steps: Steps
    step_dist: float
    origin: float
    period: float = 0.0

    def ahead(self, t: Array, edge: Array) -> Array:
        """How far the motor should be beyond `edge`, in steps."""
        way = self.where(t) - edge
        if self.period:
            way = way - self.period * np.round(way / self.period)
        return way / self.step_dist

    def check_times(self, low: float, high: float, tally: Tally) -> None:
        """Every step in [low, high): the motor passes its edge within the 25 us after it."""
        pick = (self.steps.times >= low) & (self.steps.times < high)
        t, after, before = self.steps.times[pick], self.steps.after[pick], self.steps.before[pick]
        if not len(t):
            return
        edge = self.origin + 0.5 * (before + after) * self.step_dist
        way = np.sign(after - before)
        a, b = t - TICK_S, t + MAX_ERROR_S + TICK_S
        fa, fb = way * self.ahead(a, edge), way * self.ahead(b, edge)
        tally.steps += len(t)
        late, early = fa > SLACK_STEPS, fb < -SLACK_STEPS
        # just beyond a turning point the edge may be passed and left again within 25 us
        near = np.flatnonzero(early)
        if len(near):
            between = np.linspace(a[near], b[near], 40).ravel()
            beyond = np.tile(way[near], 40) * self.ahead(between, np.tile(edge[near], 40)) >= -SLACK_STEPS
            early[near] = ~beyond.reshape(40, -1).any(axis=0)
        self._report(late, "after", t, fa, tally)
        self._report(early, "more than 25 us before", t, fb, tally)
        crossing = (fa < 0.0) & (fb > 0.0)
        tally.turning += int((~crossing).sum())
        if crossing.any():
            error = self._crossing(
                a[crossing], b[crossing], fa[crossing], fb[crossing], edge[crossing], way[crossing]
            )
            error -= t[crossing]
            tally.earliest_s = max(tally.earliest_s, float(error.max()))
            tally.latest_s = max(tally.latest_s, float(-error.min()))

    def _crossing(self, a: Array, b: Array, fa: Array, fb: Array, edge: Array, way: Array) -> Array:
        """False position: the functions are all but straight over 25 us."""
        for _ in range(2):
            x = a - fa * (b - a) / (fb - fa)
            fx = way * self.ahead(x, edge)
            left = fx < 0.0
            a, fa = np.where(left, x, a), np.where(left, fx, fa)
            b, fb = np.where(left, b, x), np.where(left, fb, fx)
        return a - fa * (b - a) / np.where(fb > fa, fb - fa, 1.0)

    def _report(self, bad: Array, what: str, t: Array, miss: Array, tally: Tally) -> None:
        if bad.any():
            i = int(np.flatnonzero(bad)[0])
            tally.faults.append(
                f"{self.name}: {bad.sum()} of {len(t)} steps {what} their time, first at {t[i]:.6f} s "
                f"({miss[i]:.6f} steps)"
            )

    def check_places(self, t: Array, tally: Tally) -> None:
        """At any time the motor is within half a step of where it should be: no step is missing."""
        place = self.origin + self.steps.count_at(t) * self.step_dist
        room = 0.5 + SLACK_STEPS
        behind = self._astray(t, place, room)
        off = np.flatnonzero(behind)
        if len(off):
            # for less than the time within which a step and its reversal cancel?
            near = t[off] + np.linspace(-CANCEL_S, CANCEL_S, 61)[:, None]
            inside = ~self._astray(near.ravel(), np.tile(place[off], 61), room).reshape(61, -1)
            behind[off] = ~(inside[:30].any(axis=0) & inside[31:].any(axis=0))
        if behind.any():
            i = int(np.flatnonzero(behind)[0])
            way = self.ahead(t[i : i + 1], place[i : i + 1])[0]
            tally.faults.append(f"{self.name}: {way:.4f} steps off at {t[i]:.6f} s ({behind.sum()} times)")

    def _astray(self, t: Array, place: Array, room: float) -> Array:
        now, soon = self.ahead(t - TICK_S, place), self.ahead(t + MAX_ERROR_S + TICK_S, place)
        return ((now > room) & (soon > room)) | ((now < -room) & (soon < -room))


def _sample_times(path: Ramps, rng: np.random.Generator, per_piece: int = 6) -> Array:
    table = path.table()
    if not len(table):
        return np.zeros(0)
    inside = table[:, :1] + rng.uniform(0.0, 1.0, (len(table), per_piece)) * table[:, 1:2]
    return np.concatenate([inside.ravel(), path.edges(), [path.edges().max() + 0.2]])


def check_motors(run: Run, seed: int = 0) -> Tally:
    """Every step of every motor against the plan. Machines of carriages only after the last change of coordinates."""
    rng, tally = np.random.default_rng(seed), Tally()
    epochs = head_epochs(run.recording.log)
    stages = list(zip(epochs, _borders(epochs), _borders(epochs)[1:], strict=False))
    if run.options["printer"]["kinematics"] == "generic_cartesian":
        stages = stages[max(i for i, epoch in enumerate(epochs) if epoch.placed) :]
    tally.moves = sum(kind == "move" for kind, _ in run.recording.log)
    for name, (position, period) in geometry(run.options).items():
        _follow_head(run, name, stages, position, period, rng, tally)
    if "extruder" in run.steps:
        _follow_filament(run, rng, tally)
    return tally


def _borders(epochs: list[Any]) -> list[float]:
    """Where each epoch's steps begin, and infinity: it lasts until its last motion is over, since shaping and averaging
    let the next one's motion begin before its first move."""
    ends = [float(e.path.edges().max()) + e.reach_s + TICK_S if e.path.rows else -1.0 for e in epochs]
    return [-1.0, *np.maximum.accumulate(ends)[:-1], math.inf]


def _head_position(position: Any, epoch: Epoch, t: Any) -> Any:
    return position(epoch.head(t))


def _follow_head(
    run: Run, name: str, stages: list[tuple[Epoch, float, float]], position: Any, period: float,
    rng: np.random.Generator, tally: Tally,
) -> None:  # fmt: skip
    steps, step_dist, origin = run.steps[name], run.motors[name].get_step_dist(), 0.0
    for epoch, begin, until in stages:
        if epoch.placed:
            here = position(epoch.path.start_place[None, :])[0]
            origin = float(here) - float(steps.count_at(begin)) * step_dist
        follow = Follow(name, partial(_head_position, position, epoch), steps, step_dist, origin, period)
        follow.check_times(begin, until, tally)
        times = _sample_times(epoch.path, rng)
        follow.check_places(times[(times >= begin) & (times < until)], tally)


def _follow_filament(run: Run, rng: np.random.Generator, tally: Tally) -> None:
    epochs = filament_epochs(run.recording.log)
    steps, step_dist = run.steps["extruder"], run.motors["extruder"].get_step_dist()
    begins = _borders(epochs)
    for epoch, begin, until in zip(epochs, begins, begins[1:], strict=False):
        follow = Follow("extruder", epoch.motor, steps, step_dist, 0.0)
        follow.check_times(begin, until, tally)
        times = _sample_times(epoch.path, rng)
        follow.check_places(times[(times >= begin) & (times < until)], tally)
