"""Where every motor has to be at any time, worked out from the planned moves alone (see motion_oracle.py).

    path of the head -> shaped by pulses -> geometry of the machine -> motor (mm, rad)
    filament + advance * speed -> triangular average                -> extruder motor (mm)

All formulas are from the documentation (Motion.md, Config_Reference.md, the papers on input shaping), none from the C
helper.
"""

from __future__ import annotations

import configparser
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

from vibration import shapers

Array = np.ndarray
Pulses = tuple[list[float], list[float]]

# ---- paths ----


@dataclass
class Ramps:
    """Positions as pieces of constant acceleration: place = origin + ratio * (v t + h t^2); at rest between them."""

    start_place: Array
    rows: list[tuple[float, ...]] = field(
        default_factory=list
    )  # time, duration, v, h, advancing, origin.., ratio..
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
    """Weights and delays of an input shaper, mean delay 0. ZV, ZVD and MZV from their closed form; the fits of the EI
    family are the product's, which a test compares with recorded figures."""
    root = math.sqrt(1.0 - damping**2)
    k, period = math.exp(-damping * math.pi / root), 1.0 / (frequency_hz * root)
    if kind == "mzv":
        a, kk = 1.0 - 1.0 / math.sqrt(2.0), math.exp(-0.75 * damping * math.pi / root)
        rows = [(a, 0.0), ((math.sqrt(2.0) - 1.0) * kk, 0.375), (a * kk * kk, 0.75)]
    elif kind in ("zv", "zvd"):
        table = {"zv": (1.0, 1.0), "zvd": (1.0, 2.0, 1.0)}
        rows = [(w * k**i, 0.5 * i) for i, w in enumerate(table[kind])]
    else:
        weights, times = shapers.parse(kind).pulses(frequency_hz, damping)
        rows, period = list(zip(weights, times, strict=True)), 1.0
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

    @property
    def reach_s(self) -> float:
        """Motors move this long before and after the head is planned to."""
        return max((abs(d) for _, delays in self.pulses for d in delays), default=0.0)

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
            self._sums = (
                starts,
                c,
                np.concatenate([zero, np.cumsum(a)]),
                np.concatenate([zero, np.cumsum(b)]),
            )
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
    if "delta" in kind or kind == "deltesian":
        return _arms(kind, get)
    if kind == "polar":
        return {
            "stepper_bed": (lambda p: np.arctan2(p[:, 1], p[:, 0]), 2 * math.pi),
            "stepper_arm": (lambda p: np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2), 0.0),
            "stepper_z": (_mix(0, 0, 1), 0.0),
        }
    assert kind == "winch"
    anchors = {n: np.array([get(f"stepper_{n}", f"anchor_{a}") for a in "xyz"]) for n in "abcd"}
    return {f"stepper_{n}": (partial(_distance, a), 0.0) for n, a in anchors.items()}


def _distance(anchor: Array, p: Array) -> Array:
    return np.asarray(np.sqrt(((p - anchor) ** 2).sum(axis=1)))


def _arms(kind: str, get: Callable[[str, str], float]) -> dict[str, tuple[Callable[[Array], Array], float]]:
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
    radius, height = get("printer", "shoulder_radius"), get("printer", "shoulder_height")
    upper, lower = get("stepper_a", "upper_arm_length"), get("stepper_a", "lower_arm_length")
    angles = np.radians([30.0, 150.0, 270.0])
    return {
        f"stepper_{n}": (partial(_shoulder, radius, height, a, upper, lower), 2 * math.pi)
        for n, a in zip("abc", angles, strict=True)
    }
