"""How a point is probed, and what several samples come to.

All heights are the nozzle's at the trigger, in the toolhead's coordinates.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

RESULTS: dict[str, Callable[[list[float]], float]] = {
    "average": statistics.fmean,
    "median": statistics.median,
}


@dataclass(frozen=True, slots=True)
class Sampling:
    """mm, mm/s."""

    probe_speed: float
    lift_speed: float
    samples: int
    retract_dist: float
    tolerance: float
    retries: int
    result: str  # a key of RESULTS

    @staticmethod
    def read(config: ConfigWrapper) -> Sampling:
        speed = config.getfloat("speed", 5.0, above=0.0)
        return Sampling(
            speed,
            config.getfloat("lift_speed", speed, above=0.0),
            config.getint("samples", 1, minval=1),
            config.getfloat("sample_retract_dist", 2.0, above=0.0),
            config.getfloat("samples_tolerance", 0.100, minval=0.0),
            config.getint("samples_tolerance_retries", 0, minval=0),
            config.getchoice("samples_result", list(RESULTS), "average"),
        )

    def changed_by(self, gcmd: GCodeCommand | None) -> Sampling:
        """With the parameters of a command."""
        if gcmd is None:
            return self
        result = gcmd.get("SAMPLES_RESULT", self.result).lower()
        if result not in RESULTS:
            raise gcmd.error(f"SAMPLES_RESULT is '{result}'; it can be {' or '.join(RESULTS)}")
        return replace(
            self,
            probe_speed=gcmd.get_float("PROBE_SPEED", self.probe_speed, above=0.0),
            lift_speed=gcmd.get_float("LIFT_SPEED", self.lift_speed, above=0.0),
            samples=gcmd.get_int("SAMPLES", self.samples, minval=1),
            retract_dist=gcmd.get_float("SAMPLE_RETRACT_DIST", self.retract_dist, above=0.0),
            tolerance=gcmd.get_float("SAMPLES_TOLERANCE", self.tolerance, minval=0.0),
            retries=gcmd.get_int("SAMPLES_TOLERANCE_RETRIES", self.retries, minval=0),
            result=result,
        )

    def as_params(self) -> dict[str, Any]:
        """The same for plugins."""
        return {
            "probe_speed": self.probe_speed,
            "lift_speed": self.lift_speed,
            "samples": self.samples,
            "sample_retract_dist": self.retract_dist,
            "samples_tolerance": self.tolerance,
            "samples_tolerance_retries": self.retries,
            "samples_result": self.result,
        }

    def combine(self, places: list[list[float]]) -> list[float]:
        """One place (x, y, z) of several."""
        return [RESULTS[self.result]([place[axis] for place in places]) for axis in range(3)]


def check_homed(printer: Printer) -> dict[str, Any]:
    """Status of the toolhead; raises if the height is not known."""
    status: dict[str, Any] = printer.lookup_object("toolhead").get_status(printer.get_reactor().monotonic())
    if "z" not in status["homed_axes"]:
        raise printer.command_error("Must home before probe")
    return status


def take_samples(
    printer: Printer, gcmd: GCodeCommand, sampling: Sampling, touch: Callable[[float], list[float]]
) -> list[list[float]]:
    """As many samples as asked for, all within the tolerance; touch(speed) goes down once."""
    toolhead = printer.lookup_object("toolhead")
    start = toolhead.get_position()
    places: list[list[float]] = []
    retries = 0
    while len(places) < sampling.samples:
        places.append(touch(sampling.probe_speed))
        heights = [place[2] for place in places]
        if max(heights) - min(heights) > sampling.tolerance:
            if retries >= sampling.retries:
                raise gcmd.error(
                    f"Probe samples exceed samples_tolerance: they differ by {max(heights) - min(heights):.4f} mm"
                )
            gcmd.respond_info("Probe samples exceed tolerance. Retrying...")
            retries += 1
            places = []
        if len(places) < sampling.samples:
            lifted = toolhead.get_position()[2] + sampling.retract_dist
            toolhead.manual_move([start[0], start[1], lifted], sampling.lift_speed)
    return places
