"""[screws_tilt_adjust]: SCREWS_TILT_CALCULATE probes above each screw of the bed and says how far to turn it.

Turns are given as a clock shows them: 01:15 is one turn and a quarter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .probing.points import ProbePointsHelper

# Rise in one turn (mm): ISO 261, coarse.
PITCH_MM = {"M3": 0.5, "M4": 0.7, "M5": 0.8, "M6": 1.0, "M8": 1.25}
# CW: turned clockwise (from above) the bed comes nearer to the nozzle.
THREADS = {
    f"{sense}-{size}": (sense == "CW", pitch) for size, pitch in PITCH_MM.items() for sense in ("CW", "CCW")
}
MINUTES = 60


@dataclass(frozen=True, slots=True)
class Screw:
    x: float
    y: float
    name: str


def read_screws(config: ConfigWrapper, min_count: int) -> list[Screw]:
    """Options screw1, screw1_name, screw2, ...; also of bed_screws."""
    screws: list[Screw] = []
    number = 1
    while config.get(f"screw{number}", None) is not None or not screws:
        x, y = config.getfloatlist(f"screw{number}", count=2)
        screws.append(Screw(x, y, config.get(f"screw{number}_name", f"screw at {x:.3f},{y:.3f}")))
        number += 1
    if len(screws) < min_count:
        raise config.error(f"Section '{config.get_name()}' needs {min_count} screws at least")
    return screws


def turns(way_mm: float, pitch_mm: float) -> str:
    """A clock's HH:MM for a way (>= 0), rounded to a minute."""
    minutes = round(way_mm / pitch_mm * MINUTES)
    return f"{minutes // MINUTES:02d}:{minutes % MINUTES:02d}"


class ScrewsTiltAdjust:
    """Printer object 'screws_tilt_adjust'."""

    def __init__(self, config: ConfigWrapper, screws: list[Screw], thread: tuple[bool, float]) -> None:
        self.printer = config.get_printer()
        self.screws = screws
        self.clockwise_raises, self.pitch_mm = thread
        self.points = ProbePointsHelper(config, self._finish_probing, [(s.x, s.y) for s in screws])
        self._gcmd: Any = None
        self._direction: str | None = None
        self._max_deviation: float | None = None
        self._status: dict[str, Any] = {"error": False, "max_deviation": None, "results": {}}

    def register(self) -> None:
        self.printer.lookup_object("gcode").register_command(
            "SCREWS_TILT_CALCULATE", self.cmd_SCREWS_TILT_CALCULATE,
            desc="Tool to help adjust bed leveling screws by calculating the number of turns to level it.",
        )  # fmt: skip

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return self._status

    def cmd_SCREWS_TILT_CALCULATE(self, gcmd: GCodeCommand) -> None:
        """SCREWS_TILT_CALCULATE [DIRECTION=CW|CCW] [MAX_DEVIATION=mm] [HORIZONTAL_MOVE_Z=mm] ..."""
        direction = gcmd.get("DIRECTION", None)
        if direction is not None and direction.upper() not in ("CW", "CCW"):
            raise gcmd.error(f"Error on '{gcmd.get_commandline()}': DIRECTION must be either CW or CCW")
        self._direction = direction.upper() if direction is not None else None
        self._max_deviation = gcmd.get_float("MAX_DEVIATION", None, minval=0.0)
        self._gcmd = gcmd
        self.points.start_probe(gcmd)

    def _base(self, heights: Sequence[float]) -> int:
        """Number of the screw that stays: the first, or with a direction the one from which all turn that way."""
        if self._direction is None:
            return 0
        raise_others = (self._direction == "CW") == self.clockwise_raises
        return heights.index(max(heights) if raise_others else min(heights))

    def _finish_probing(self, offsets: Sequence[float], places: list[list[float]]) -> None:
        heights = [place[2] for place in places]
        base = self._base(heights)
        lines = ["01:20 means 1 full turn and 20 minutes, CW=clockwise, CCW=counter-clockwise"]
        results = {}
        too_far = False
        for number, (screw, z) in enumerate(zip(self.screws, heights, strict=True)):
            low_mm = heights[base] - z  # > 0: the bed has to come up here
            sign = "CW" if (low_mm >= 0.0) == self.clockwise_raises else "CCW"
            is_base = number == base
            adjust = "00:00" if is_base else turns(abs(low_mm), self.pitch_mm)
            results[f"screw{number + 1}"] = {"z": z, "sign": sign, "adjust": adjust, "is_base": is_base}
            line = f"{screw.name}{' (base)' if is_base else ''} : x={screw.x:.1f}, y={screw.y:.1f}, z={z:.5f}"
            lines.append(line if is_base else f"{line} : adjust {sign} {adjust}")
            too_far = too_far or (self._max_deviation is not None and abs(low_mm) > self._max_deviation)
        self._status = {"error": too_far, "max_deviation": self._max_deviation, "results": results}
        self._gcmd.respond_info("\n".join(lines))
        if too_far:
            raise self._gcmd.error(
                f"bed level exceeds configured limits ({self._max_deviation}mm)! Adjust screws and restart print."
            )


def load_config(config: ConfigWrapper) -> ScrewsTiltAdjust:
    thread = config.getchoice("screw_thread", THREADS, "CW-M3")
    adjust = ScrewsTiltAdjust(config, read_screws(config, 2), thread)
    adjust.register()
    return adjust
