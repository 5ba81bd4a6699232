"""Random lists of moves for the motion tests: what slicers write, and what they should not."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

CONFIGS = Path(__file__).resolve().parents[3] / "config"

# x, y, z from .. to, within every machine's range and off the centre of the polar one
BOXES: dict[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = {
    "cartesian": ((5, 5, 1), (195, 195, 60)),
    "corexy": ((5, 5, 1), (195, 195, 60)),
    "corexz": ((5, 5, 1), (195, 195, 60)),
    "hybrid-corexy": ((5, 5, 1), (195, 195, 60)),
    "hybrid-corexz": ((5, 5, 1), (195, 195, 60)),
    "generic-cartesian": ((5, 5, 1), (195, 195, 60)),
    "delta": ((-80, -80, 1), (80, 80, 60)),
    "deltesian": ((-80, 5, 1), (80, 195, 60)),
    "rotary-delta": ((-60, -60, 1), (60, 60, 60)),
    "polar": ((-150, -60, 1), (-20, 150, 60)),  # astride of where the angle jumps from pi to -pi
    "winch": ((-200, -200, 1), (200, 200, 200)),
}
HOMES_AGAIN = {"cartesian": "G28 X", "corexy": "G28 Y", "hybrid-corexy": "G28 Z", "deltesian": "G28 Y"}
SHAPERS = ("zv", "mzv", "zvd", "ei", "2hump_ei", "3hump_ei")
EXTRAS = "[gcode_arcs]\nresolution: 0.7\n[input_shaper]\n"


def config_of(name: str) -> str:
    """The example's machine with an extruder that extrudes cold, arcs and a shaper."""
    config = (CONFIGS / f"example-{name}.cfg").read_text()
    config = re.sub(r"(?m)^max_z_velocity:.*", "max_z_velocity: 60", config)
    config = re.sub(r"(?m)^max_z_accel:.*", "max_z_accel: 1500", config)
    if "[extruder]" not in config:
        whole = (CONFIGS / "example-cartesian.cfg").read_text()
        config += whole[whole.index("[extruder]") : whole.index("[heater_bed]")]
    return config.replace("[extruder]", "[extruder]\nmin_extrude_temp: 0", 1) + EXTRAS


@dataclass
class MoveWriter:
    """Writes G-code, keeping within the machine's box."""

    name: str
    rng: np.random.Generator
    lines: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.low, self.high = (np.array(corner, dtype=float) for corner in BOXES[self.name])
        self.at = self.low + 0.5 * (self.high - self.low)
        self.before = self.at

    def begin(self) -> None:
        self.lines += ["G28", "M83", "G90"]
        if self.name == "polar":  # the way from where it homes must not cross the centre
            self.lines += ["G1 X200 Y1 F6000", "G1 X100 Y100"]
        self._go(self.at, 100.0)

    def _go(self, to: np.ndarray, speed: float, filament: float | None = None) -> None:
        """filament: per mm."""
        self.before, self.at = self.at, np.round(np.clip(to, self.low, self.high), 4)
        way = float(np.linalg.norm(self.at - self.before))
        e = "" if filament is None else f" E{filament * way:.5f}"
        self.lines.append("G1 X{:.4f} Y{:.4f} Z{:.4f}".format(*self.at) + f"{e} F{60 * speed:.1f}")

    def _speed(self) -> float:
        low, high = ((2.0, 20.0), (20.0, 120.0), (100.0, 350.0))[self.rng.choice(3, p=(0.1, 0.3, 0.6))]
        return float(self.rng.uniform(low, high))

    # -- kinds of moves --

    def travel(self) -> None:
        near = self.rng.random() < 0.8
        to = (
            self.at + self.rng.normal(0.0, 15.0, 3) * [1, 1, 0.1]
            if near
            else self.rng.uniform(self.low, self.high)
        )
        self._go(to, max(60.0, self._speed()))

    def line(self) -> None:
        way = self.rng.normal(0.0, 12.0, 3) * [1.0, 1.0, 0.02]
        self._go(self.at + way, self._speed(), 0.035)

    def chords(self) -> None:
        """A wriggle of tiny moves."""
        speed, angle = self._speed(), self.rng.uniform(0, 2 * math.pi)
        for _ in range(int(self.rng.integers(3, 25))):
            angle += self.rng.normal(0.0, 0.4)
            length = 10 ** self.rng.uniform(-2.3, 0.0)
            way = length * np.array([math.cos(angle), math.sin(angle), 0.0])
            self._go(self.at + way, speed, 0.04)

    def zigzag(self) -> None:
        """Straight back, again and again."""
        other, speed = self.at + self.rng.normal(0.0, 2.0, 3) * [1, 1, 0.1], self._speed()
        here = self.at
        for _ in range(int(self.rng.integers(1, 4))):
            self._go(other, speed, 0.05)
            self._go(here, speed, 0.05)

    def straight(self) -> None:
        """Pieces of one line, at different speeds."""
        way = self.rng.normal(0.0, 4.0, 3) * [1, 1, 0]
        for _ in range(int(self.rng.integers(2, 6))):
            self._go(self.at + way, self._speed(), 0.03)

    def lift(self) -> None:
        self._go(self.at + np.array([0.0, 0.0, self.rng.normal(0.0, 1.0)]), self._speed())

    def filament(self) -> None:
        """Retract, move or not, and back."""
        amount, speed = self.rng.uniform(0.2, 5.0), 60 * self.rng.uniform(5.0, 60.0)
        self.lines.append(f"G1 E-{amount:.4f} F{speed:.0f}")
        if self.rng.random() < 0.7:
            self.travel()
        self.lines.append(f"G1 E{amount:.4f} F{speed:.0f}")

    def arc(self) -> None:
        """G2 or G3 about a centre that keeps all of the circle in the box; often a helix."""
        room = np.minimum(self.at - self.low, self.high - self.at)[:2].min()
        if room < 2.0:
            return self.travel()
        radius, angle = self.rng.uniform(0.3, 0.48 * room), self.rng.uniform(0.0, 2 * math.pi)
        i, j = (round(radius * f(angle), 4) for f in (math.cos, math.sin))
        turn = self.rng.uniform(0.3, 2 * math.pi)
        # from the centre back to here, turned
        x = i - i * math.cos(turn) + j * math.sin(turn)
        y = j - i * math.sin(turn) - j * math.cos(turn)
        to = np.round(self.at + np.array([x, y, self.rng.choice([0.0, self.rng.normal(0.0, 0.5)])]), 4)
        to[2] = min(max(to[2], self.low[2]), self.high[2])
        self.before, self.at = self.at, to
        end = "X{:.4f} Y{:.4f} Z{:.4f}".format(*to)
        e = 0.04 * radius * min(turn, 2 * math.pi - turn)  # whichever way round
        self.lines.append(
            f"G{self.rng.choice([2, 3])} {end} I{i:.4f} J{j:.4f} E{e:.5f} F{60 * self._speed():.0f}"
        )
        return None

    def pause(self) -> None:
        self.lines.append(f"G4 P{self.rng.uniform(0.0, 200.0):.1f}")

    def limits(self) -> None:
        """While moves are waiting."""
        rng = self.rng
        self.lines.append(
            f"SET_VELOCITY_LIMIT VELOCITY={rng.uniform(30, 300):.3f} ACCEL={10 ** rng.uniform(2.5, 4.2):.3f} "
            f"SQUARE_CORNER_VELOCITY={rng.choice([0.0, 5.0, rng.uniform(0, 20)]):.3f} "
            f"MINIMUM_CRUISE_RATIO={rng.choice([0.0, 0.5, rng.uniform(0, 0.95)]):.3f}"
        )

    def shaping(self) -> None:
        parts = []
        for axis in "XYZ" if self.rng.random() < 0.3 else "XY":
            kind, f = self.rng.choice(SHAPERS), self.rng.choice([0.0, *self.rng.uniform(18.0, 110.0, 4)])
            damping = self.rng.choice([0.0, 0.1, self.rng.uniform(0.0, 0.2)])
            parts.append(
                f"SHAPER_TYPE_{axis}={kind} SHAPER_FREQ_{axis}={f:.3f} DAMPING_RATIO_{axis}={damping:.4f}"
            )
        self.lines.append("SET_INPUT_SHAPER " + " ".join(parts))

    def advance(self) -> None:
        k = self.rng.choice([0.0, self.rng.uniform(0.005, 0.08), self.rng.uniform(0.1, 0.8)])
        self.lines.append(
            f"SET_PRESSURE_ADVANCE ADVANCE={k:.5f} SMOOTH_TIME={self.rng.uniform(0.002, 0.1):.5f}"
        )

    KINDS = (
        (travel, 2), (line, 6), (chords, 2), (zigzag, 1), (straight, 1), (lift, 1), (filament, 1), (arc, 2),
        (pause, 0.4), (limits, 0.6),
    )  # fmt: skip

    def list_of_moves(self, count: int) -> None:
        """One list: limits, perhaps shaping and advance, then moves, then the end of motion."""
        self.limits()
        if self.rng.random() < 0.5:
            self.shaping()
        if self.rng.random() < 0.5:
            self.advance()
        if self.rng.random() < 0.15 and self.name in HOMES_AGAIN:
            self.lines.append(HOMES_AGAIN[self.name])
            self._go(self.at, 100.0)
        weights = np.array([weight for _, weight in self.KINDS])
        for number in self.rng.choice(len(self.KINDS), count, p=weights / weights.sum()):
            self.KINDS[number][0](self)
        self.lines.append("M400")


def gcode_of(name: str, seed: int, lists: int, count: int = 14) -> str:
    writer = MoveWriter(name, np.random.default_rng(seed))
    writer.begin()
    for _ in range(lists):
        writer.list_of_moves(count)
    return "\n".join(writer.lines) + "\n"
