"""An oracle for steps: where every motor has to be at any time, worked out from the planned moves alone.

    planned moves (listener) -> path of the head -> shaped by pulses -> geometry of the machine -> motor (mm, rad)
                             -> filament + advance * speed -> triangular average          -> extruder motor (mm)

All formulas are from the documentation (Motion.md, Config_Reference.md, the papers on input shaping), none from the C
helper. Steps are decoded from the bytes of a batch run, and each must lie where its motor passes the middle between
two steps: at most 25 us before, never after (a clock tick aside).
"""

from __future__ import annotations

import configparser
import math
import os
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from motion_rig import CLOCK_HZ, MAX_ERROR_S, decode, dictionary

import msgproto
from printer import Printer
from reactor import Reactor

CONFIGS = Path(__file__).resolve().parents[2] / "config"
# clocks are whole numbers at both ends of the conversion from print_time
TICK_S = 2.0 / CLOCK_HZ
# Share of a step by which a motor may miss an edge: matters only where it turns around and stands almost still.
SLACK_STEPS = 2e-4
# A step and its reversal within this time are left out: they would move nothing.
CANCEL_S = 750e-6

Array = np.ndarray
Pulses = tuple[list[float], list[float]]

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
    start_args = {
        "config_file": str(folder / "printer.cfg"),
        "config_overrides": [],
        "apiserver": None,
        "start_reason": "startup",
        "software_version": "test",
        "cpu_info": "test",
        "debuginput": str(folder / "in.gcode"),
        "gcode_fd": os.open(folder / "in.gcode", os.O_RDONLY),
        "debugoutput": str(folder / "out"),
        "dictionary": str(folder / "dict"),
    }
    printer = Printer(reactor, start_args)
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


# ---- paths ----


@dataclass
class Ramps:
    """Positions as pieces of constant acceleration: place = origin + ratio * (v t + h t^2); at rest between them."""

    start_place: Array
    rows: list[tuple[float, ...]] = field(default_factory=list)  # time, duration, v, h, advancing, origin.., ratio..
    _table: Array | None = None

    def add(self, move: Any, origin: Array, ratio: Array, advancing: float = 0.0) -> None:
        """One planned move: up, along, down."""
        time, at = move.print_time, np.array(origin, dtype=float)
        top, accel = move.cruise_v, move.accel
        phases = ((move.accel_t, move.start_v, 0.5 * accel), (move.cruise_t, top, 0.0))
        for duration, v, h in (*phases, (move.decel_t, top, -0.5 * accel)):
            if duration > 0.0:
                self.rows.append((time, duration, v, h, advancing, *at, *ratio))
                at = at + ratio * (v * duration + h * duration**2)
            time += duration

    def table(self) -> Array:
        if self._table is None:
            size = 5 + 2 * len(self.start_place)
            self._table = np.array(self.rows, dtype=float).reshape(-1, size)
        return self._table

    def at(self, t: Array, axis: int) -> Array:
        table, axes = self.table(), len(self.start_place)
        if not len(table):
            return np.full(len(t), self.start_place[axis])
        i = np.searchsorted(table[:, 0], t, side="right") - 1
        first = i < 0
        row = table[np.maximum(i, 0)]
        tau = np.clip(t - row[:, 0], 0.0, row[:, 1])
        place = row[:, 5 + axis] + row[:, 5 + axes + axis] * (row[:, 2] + row[:, 3] * tau) * tau
        return np.where(first, self.start_place[axis], place)

    def end(self) -> Array:
        t = np.array([math.inf])
        return np.array([self.at(t, axis)[0] for axis in range(len(self.start_place))])

    def edges(self) -> Array:
        table = self.table()
        return np.concatenate([table[:, 0], table[:, 0] + table[:, 1]])


def published_pulses(kind: str, frequency_hz: float, damping: float) -> Pulses:
    """Weights and delays of an input shaper as published (Singer & Seering, Singhose), mean delay 0."""
    root = math.sqrt(1.0 - damping**2)
    k, period = math.exp(-damping * math.pi / root), 1.0 / (frequency_hz * root)
    v = 0.05  # vibration the EI shapers tolerate
    if kind == "mzv":
        a, kk = 1.0 - 1.0 / math.sqrt(2.0), math.exp(-0.75 * damping * math.pi / root)
        rows = [(a, 0.0), ((math.sqrt(2.0) - 1.0) * kk, 0.375), (a * kk * kk, 0.75)]
    elif kind == "2hump_ei":
        x = np.cbrt(v * v * (math.sqrt(1.0 - v * v) + 1.0))
        a = (3.0 * x * x + 2.0 * x + 3.0 * v * v) / (16.0 * x)
        rows = [(a, 0.0), ((0.5 - a) * k, 0.5), ((0.5 - a) * k**2, 1.0), (a * k**3, 1.5)]
    elif kind == "3hump_ei":
        a = (1.0 + 3.0 * v + 2.0 * math.sqrt(2.0 * (v * v + v))) / 16.0
        b = (1.0 - v) / 4.0
        rows = [(a, 0.0), (b * k, 0.5), ((1.0 - 2.0 * (a + b)) * k**2, 1.0), (b * k**3, 1.5), (a * k**4, 2.0)]
    else:
        table = {"zv": (1.0, 1.0), "zvd": (1.0, 2.0, 1.0), "ei": ((1 + v) / 4, (1 - v) / 2, (1 + v) / 4)}
        rows = [(w * k**i, 0.5 * i) for i, w in enumerate(table[kind])]
    total = sum(w for w, _ in rows)
    mean = sum(w * t for w, t in rows) / total
    return [w / total for w, _ in rows], [(t - mean) * period for _, t in rows]


@dataclass
class Epoch:
    """From one change of coordinates or shaping, made at rest, to the next."""

    time: float
    path: Ramps
    pulses: list[Pulses]  # per axis
    placed: bool  # the head was given new coordinates

    def head(self, t: Array) -> Array:
        columns = []
        for axis in range(3):
            weights, delays = self.pulses[axis]
            columns.append(
                sum(w * self.path.at(t - d, axis) for w, d in zip(weights, delays, strict=True))
                if weights
                else self.path.at(t, axis)
            )
        return np.column_stack(columns)


def head_epochs(log: list[tuple[str, Any]]) -> list[Epoch]:
    none: Pulses = ([], [])
    epochs = [Epoch(-1.0, Ramps(np.zeros(3)), [none] * 3, True)]
    for kind, what in log:
        last = epochs[-1]
        if kind == "move" and what.is_kinematic_move:
            last.path.add(what, np.array(what.start_pos[:3]), np.array(what.axes_r[:3]))
        elif kind == "set":
            epochs.append(Epoch(what[0], Ramps(np.array(what[1])), last.pulses, True))
        elif kind == "shaper":
            pulses = [
                published_pulses(a.kind, a.frequency_hz, a.damping_ratio) if a.frequency_hz else none
                for a in what[1]
            ]
            epochs.append(Epoch(what[0], Ramps(last.path.end()), pulses, False))
    return epochs


@dataclass
class Filament:
    """Motion of the filament between two changes of pressure advance: averaged over +-w with a triangle."""

    time: float
    path: Ramps
    advance_s: float
    smooth_s: float

    @property
    def reach_s(self) -> float:
        """The motor moves this long before and after the filament is planned to."""
        return 0.5 * self.smooth_s if self.advance_s else 0.0

    def motor(self, t: Array) -> Array:
        """s(t) = 1/w^2 * integral of (w - |u|) * p(t + u), p = filament + advance * speed; by moments of p."""
        w = 0.5 * self.smooth_s
        if not self.advance_s or not w:
            return self.path.at(t, 0)
        x, offset = t - self.time, self.path.start_place[0]
        (a0, b0), (a1, b1), (a2, b2) = (self._moments(x + shift) for shift in (-w, 0.0, w))
        rising = (w - x) * (a1 - a0) + (b1 - b0)
        falling = (w + x) * (a2 - a1) - (b2 - b1)
        return offset + (rising + falling) / w**2

    def _pieces(self) -> tuple[Array, Array]:
        """Start times (since self.time) and p = c0 + c1 t + c2 t^2 of all pieces, rests among them."""
        starts, rows, place, time = [-1e3], [(0.0, 0.0, 0.0)], 0.0, -1e3
        for row in self.path.table():
            start, duration, v, h, advancing, origin, ratio = row
            start -= self.time
            if start > time + 1e-9:
                starts.append(time)
                rows.append((place, 0.0, 0.0))
            k = self.advance_s * advancing
            place0 = origin - self.path.start_place[0]
            starts.append(start)
            rows.append((place0 + k * ratio * v, ratio * v + 2.0 * k * ratio * h, ratio * h))
            place, time = place0 + ratio * (v + h * duration) * duration, start + duration
        starts.append(time)
        rows.append((place, 0.0, 0.0))
        return np.array(starts), np.array(rows)

    def _moments(self, x: Array) -> tuple[Array, Array]:
        """Integrals of p and of t*p up to x."""
        if not hasattr(self, "_sums"):
            starts, c = self._pieces()
            tau = np.diff(starts)
            a, b = _integrals(starts[:-1], c[:-1], tau)
            zero = np.zeros(1)
            self._sums = (starts, c, np.concatenate([zero, np.cumsum(a)]), np.concatenate([zero, np.cumsum(b)]))
        starts, c, a_sum, b_sum = self._sums
        i = np.maximum(np.searchsorted(starts, x, side="right") - 1, 0)
        a, b = _integrals(starts[i], c[i], x - starts[i])
        return a_sum[i] + a, b_sum[i] + b


def _integrals(start: Array, c: Array, tau: Array) -> tuple[Array, Array]:
    whole = (c[:, 0] + (c[:, 1] / 2 + c[:, 2] / 3 * tau) * tau) * tau
    moment = (c[:, 0] / 2 + (c[:, 1] / 3 + c[:, 2] / 4 * tau) * tau) * tau**2
    return whole, start * whole + moment


def filament_epochs(log: list[tuple[str, Any]]) -> list[Filament]:
    epochs = [Filament(-1.0, Ramps(np.zeros(1)), 0.0, 0.0)]
    place = 0.0
    for kind, what in log:
        if kind == "move" and what.axes_d[3]:
            ratio = what.axes_r[3]
            along_line = ratio > 0.0 and (what.axes_d[0] or what.axes_d[1])
            epochs[-1].path.add(what, np.array([place]), np.array([ratio]), 1.0 if along_line else 0.0)
            place += what.axes_d[3]
        elif kind == "advance":
            epochs.append(Filament(what[0], Ramps(np.array([place])), what[1], what[2]))
    return epochs


# ---- geometry ----


def _mix(x: float, y: float, z: float) -> Callable[[Array], Array]:
    return lambda p: x * p[:, 0] + y * p[:, 1] + z * p[:, 2]


def _carriage(tower_x: float, tower_y: float, arm: float) -> Callable[[Array], Array]:
    """Height of a carriage: Pythagoras on the arm."""
    return lambda p: p[:, 2] + np.sqrt(arm**2 - (p[:, 0] - tower_x) ** 2 - (p[:, 1] - tower_y) ** 2)


def _shoulder(radius: float, height: float, angle: float, upper: float, lower: float, p: Array) -> Array:
    """Angle of the upper arm, by its half tangent; of both solutions the one whose elbow is farther out."""
    out = p[:, 0] * math.cos(angle) + p[:, 1] * math.sin(angle) - radius
    side = p[:, 1] * math.cos(angle) - p[:, 0] * math.sin(angle)
    up = p[:, 2] - height
    k = (out**2 + up**2 + side**2 + upper**2 - lower**2) / (2.0 * upper)
    root = np.sqrt(out**2 + up**2 - k**2)
    angles = [2.0 * np.arctan2(up + sign * root, k + out) for sign in (1.0, -1.0)]
    return np.where(np.cos(angles[0]) > np.cos(angles[1]), angles[0], angles[1])


LINEAR = {
    "cartesian": {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)},
    "corexy": {"x": (1, 1, 0), "y": (1, -1, 0), "z": (0, 0, 1)},
    "corexz": {"x": (1, 0, 1), "y": (0, 1, 0), "z": (1, 0, -1)},
    "hybrid_corexy": {"x": (1, -1, 0), "y": (0, 1, 0), "z": (0, 0, 1)},
    "hybrid_corexz": {"x": (1, 0, -1), "y": (0, 1, 0), "z": (0, 0, 1)},
}
# the example's machine, with its second carriage at rest
CARRIAGES = {"a": (1, 1, 0), "u": (0, -1, 0), "y": (0, 1, 0), "y1": (0, 1, 0), "z": (0, 0, 1)}


def geometry(options: configparser.ConfigParser) -> dict[str, tuple[Callable[[Array], Array], float]]:
    """Place of each motor from x, y, z, and the period of that place (0: none), from the configuration."""
    kind = options["printer"]["kinematics"]
    if kind in LINEAR:
        return {f"stepper_{n}": (_mix(*mix), 0.0) for n, mix in LINEAR[kind].items()}
    if kind == "generic_cartesian":
        return {f"stepper {n}": (_mix(*mix), 0.0) for n, mix in CARRIAGES.items()}
    get = lambda name, option: float(options[name][option])  # noqa: E731
    if kind == "delta":
        radius, arm = get("printer", "delta_radius"), get("stepper_a", "arm_length")
        return {
            f"stepper_{n}": (_carriage(radius * math.cos(a), radius * math.sin(a), arm), 0.0)
            for n, a in zip("abc", np.radians([210.0, 330.0, 90.0]), strict=True)
        }
    if kind == "deltesian":
        foot, arm = get("stepper_left", "arm_x_length"), get("stepper_left", "arm_length")
        sides = (("left", -foot), ("right", foot))
        found = {
            f"stepper_{n}": (lambda p, x=x: p[:, 2] + np.sqrt(arm**2 - (p[:, 0] - x) ** 2), 0.0)
            for n, x in sides
        }
        return {**found, "stepper_y": (_mix(0, 1, 0), 0.0)}
    if kind == "rotary_delta":
        size = [get("printer", "shoulder_radius"), get("printer", "shoulder_height")]
        arms = [get("stepper_a", "upper_arm_length"), get("stepper_a", "lower_arm_length")]
        angles = np.radians([30.0, 150.0, 270.0])
        return {
            f"stepper_{n}": (partial(_shoulder, *size, a, *arms), 2 * math.pi)
            for n, a in zip("abc", angles, strict=True)
        }
    if kind == "polar":
        return {
            "stepper_bed": (lambda p: np.arctan2(p[:, 1], p[:, 0]), 2 * math.pi),
            "stepper_arm": (lambda p: np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2), 0.0),
            "stepper_z": (_mix(0, 0, 1), 0.0),
        }
    assert kind == "winch"
    anchors = {n: np.array([get(f"stepper_{n}", f"anchor_{a}") for a in "xyz"]) for n in "abcd"}
    return {
        f"stepper_{n}": (lambda p, a=a: np.sqrt(((p - a) ** 2).sum(axis=1)), 0.0) for n, a in anchors.items()
    }


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
        for i in np.flatnonzero(early):
            between = np.linspace(a[i], b[i], 40)
            early[i] = not np.any(way[i] * self.ahead(between, np.full(40, edge[i])) >= -SLACK_STEPS)
        self._tell(late, "after", t, fa, tally)
        self._tell(early, "more than 25 us before", t, fb, tally)
        crossing = (fa < 0.0) & (fb > 0.0)
        tally.turning += int((~crossing).sum())
        if crossing.any():
            error = self._crossing(a[crossing], b[crossing], fa[crossing], fb[crossing], edge[crossing], way[crossing])
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

    def _tell(self, bad: Array, what: str, t: Array, miss: Array, tally: Tally) -> None:
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
        for i in np.flatnonzero(behind):
            # off the grid for less than the time within which a step and its reversal cancel?
            near = t[i] + np.linspace(-CANCEL_S, CANCEL_S, 61)
            inside = ~self._astray(near, np.full(61, place[i]), room)
            behind[i] = not (inside[:30].any() and inside[31:].any())
        if behind.any():
            i = int(np.flatnonzero(behind)[0])
            off = self.ahead(t[i : i + 1], place[i : i + 1])[0]
            tally.faults.append(f"{self.name}: {off:.4f} steps off at {t[i]:.6f} s ({behind.sum()} times)")

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
    if run.options["printer"]["kinematics"] == "generic_cartesian":
        epochs = epochs[max(i for i, epoch in enumerate(epochs) if epoch.placed) :]
    tally.moves = sum(kind == "move" for kind, _ in run.recording.log)
    for name, (position, period) in geometry(run.options).items():
        _follow_head(run, name, epochs, position, period, rng, tally)
    if "extruder" in run.steps:
        _follow_filament(run, rng, tally)
    return tally


def _follow_head(
    run: Run, name: str, epochs: list[Epoch], position: Any, period: float, rng: np.random.Generator, tally: Tally
) -> None:
    steps, step_dist, origin = run.steps[name], run.motors[name].get_step_dist(), 0.0
    for i, epoch in enumerate(epochs):
        until = epochs[i + 1].time if i + 1 < len(epochs) else math.inf
        if epoch.placed:
            here = position(epoch.path.start_place[None, :])[0]
            origin = float(here) - float(steps.count_at(epoch.time)) * step_dist
        follow = Follow(name, lambda t, e=epoch: position(e.head(t)), steps, step_dist, origin, period)
        follow.check_times(epoch.time, until, tally)
        times = _sample_times(epoch.path, rng)
        follow.check_places(times[(times >= epoch.time) & (times < until)], tally)


def _follow_filament(run: Run, rng: np.random.Generator, tally: Tally) -> None:
    epochs = filament_epochs(run.recording.log)
    steps, step_dist = run.steps["extruder"], run.motors["extruder"].get_step_dist()
    # an epoch lasts until its last motion is over: the next one's may begin before its first move
    ends = [float(e.path.edges().max()) + e.reach_s if e.path.rows else -1.0 for e in epochs]
    begins = [-1.0, *(max(ends[: i + 1]) + TICK_S for i in range(len(epochs) - 1)), math.inf]
    for epoch, begin, until in zip(epochs, begins, begins[1:], strict=False):
        follow = Follow("extruder", epoch.motor, steps, step_dist, 0.0)
        follow.check_times(begin, until, tally)
        times = _sample_times(epoch.path, rng)
        follow.check_places(times[(times >= begin) & (times < until)], tally)
