"""Random G-code text for the temperature plan: what slicers, macros and impatient users send, in any order."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field

START = """M104 S{base}
G28
G90
M83
EXCLUDE_OBJECT_DEFINE NAME=CUBE
EXCLUDE_OBJECT_DEFINE NAME=CONE
G1 X90 Y90 Z0.3 F6000
M109 S{base}
"""
END = "M400\nG4 P12000\nM400\n"  # time to go home from the hottest plan
COMMENTS = (
    ";TYPE:External perimeter",
    ";TYPE:Internal infill",
    "; FEATURE: Outer wall",
    "; FEATURE: Bridge",
    ";TYPE:WALL-OUTER",
    ";TYPE:FILL",
    ";TYPE:",
    ";TYPE:\xe9t\xe9 42",
    ";LAYER:-1",
    ";LAYER_CHANGE",
    "; CHANGE_LAYER",
    ";HEIGHT:0.2",
    ";HEIGHT:1e9",
    ";HEIGHT:.",
)
LOWEST, HIGHEST = 4.0, 176.0  # of the bed, mm


@dataclass(slots=True)
class Writer:
    """Writes lines; keeps what a file that can be printed has to keep."""

    rng: random.Random
    x: float = 90.0
    y: float = 90.0
    z: float = 0.3
    retracted: float = 0.0
    planned: bool = True
    paused: int = 0
    lines: list[str] = field(default_factory=list)

    def put(self, line: str) -> None:
        self.lines.append(line)

    def road(self) -> None:
        rng = self.rng
        length = rng.choice((0.05, 0.4, 2.0, 8.0, 30.0)) * rng.uniform(0.5, 2.0)
        angle = rng.uniform(0.0, 2.0 * math.pi)
        x = min(HIGHEST, max(LOWEST, self.x + length * math.cos(angle)))
        y = min(HIGHEST, max(LOWEST, self.y + length * math.sin(angle)))
        length = math.dist((x, y), (self.x, self.y))
        self.x, self.y = x, y
        e_mm = length * rng.choice((0.01, 0.04, 0.15))
        slowest = 60.0 * max(1.0, 0.5 * length)  # no move longer than 2 s: the test's time is dear
        feed = rng.choice((slowest, 1200, 3600, 9000, 99999))
        if self.retracted:
            self.put(f"G1 E{self.retracted} F2400")
            self.retracted = 0.0
        self.put(f"G1 X{x:.3f} Y{y:.3f} E{e_mm:.5f} F{max(slowest, feed):.0f}")

    def infill(self) -> None:
        for _ in range(self.rng.randint(3, 12)):
            self.road()

    def arc(self) -> None:
        radius = self.rng.uniform(1.0, 3.0)
        if LOWEST + 2.0 * radius < self.x < HIGHEST - 2.0 * radius:
            self.put(
                f"G{self.rng.choice((2, 3))} X{self.x + radius:.3f} Y{self.y:.3f} I{radius / 2:.3f} J0 E0.1 F2400"
            )
            self.x += radius

    def travel(self) -> None:
        self.x, self.y = self.rng.uniform(LOWEST, HIGHEST), self.rng.uniform(LOWEST, HIGHEST)
        self.put(f"G0 X{self.x:.2f} Y{self.y:.2f} F{self.rng.choice((6000, 15000))}")

    def layer(self) -> None:
        self.z = max(0.1, self.z + self.rng.choice((0.2, 0.2, 0.2, 0.05, 0.6, -0.4)))
        self.put(f"G1 Z{self.z:.2f} F600")

    def retract(self) -> None:
        if not self.retracted:
            self.retracted = 0.8
            self.put("G1 E-0.8 F2400")

    def target(self) -> None:
        command = self.rng.choice(("M104", "M104", "M104", "M109"))
        low, high = (165, 300) if command == "M104" else (205, 235)  # far ones take long to wait for
        self.put(f"{command} S{self.rng.randint(low, high)}")

    def request(self) -> None:
        temp = self.rng.choice((0, 160, 200, 228, 260, 320))
        self.put(
            self.rng.choice(
                (
                    f"M104.1 S{temp}",
                    f"SET_SEGMENT_TEMPERATURE TEMP={temp}",
                    f"SET_SEGMENT_TEMPERATURE TEMP={temp} UNTIL={self.rng.choice(('layer', 'feature', 'object'))}",
                    f"SET_SEGMENT_TEMPERATURE TEMP={temp} DURATION={self.rng.choice((0.01, 0.5, 3))}",
                )
            )
        )

    def comment(self) -> None:
        self.put(self.rng.choice(COMMENTS))

    def part(self) -> None:
        name = self.rng.choice(("CUBE", "CONE"))
        self.put(
            self.rng.choice(
                (
                    f"EXCLUDE_OBJECT_START NAME={name}",
                    f"EXCLUDE_OBJECT_END NAME={name}",
                    f"EXCLUDE_OBJECT NAME={name}",
                )
            )
        )

    def factor(self) -> None:
        self.put(
            self.rng.choice(
                ("M220 S30", "M220 S100", "M220 S250", "M221 S60", "M221 S100", "M106 S255", "M107")
            )
        )

    def rest(self) -> None:
        self.put(f"G4 P{self.rng.choice((1, 30, 400, 3000))}")

    def pause(self) -> None:
        if self.paused < 1:  # a pause takes long
            self.paused += 1
            self.put("PAUSE")

    def plan(self) -> None:
        self.put(
            self.rng.choice(
                (
                    "TEMPERATURE_PLAN ENABLE=0",
                    "TEMPERATURE_PLAN ENABLE=1",
                    "TEMPERATURE_PLAN ENABLE=1",
                    "TEMPERATURE_PLAN",
                    "TEMPERATURE_PLAN INTERFACE=150",
                    "TEMPERATURE_PLAN INTERFACE=0",
                    "TEMPERATURE_PLAN INTERFACE=500",
                    "TEMPERATURE_PLAN MATERIAL=PLA REPORT=1",
                )
            )
        )

    def write(self, count: int) -> str:
        """So many random things to do, as a file."""
        kinds: list[tuple[Callable[[], None], int]] = [
            (self.road, 12), (self.infill, 8), (self.arc, 3), (self.travel, 3), (self.layer, 4), (self.retract, 3),
            (self.target, 3), (self.request, 8), (self.comment, 8), (self.part, 4), (self.factor, 3), (self.rest, 2),
            (self.pause, 1), (self.plan, 3),
        ]  # fmt: skip
        self.put(START.format(base=self.rng.choice((190, 215, 240))))
        for kind in self.rng.choices([k for k, _ in kinds], [w for _, w in kinds], k=count):
            kind()
        self.put(f"M220 S100\nM104 S{self.rng.randint(190, 240)}\n{END}")
        return "\n".join(self.lines)
