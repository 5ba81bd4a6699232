"""Several Z motors, each of which can be turned alone: from probed heights to a level bed. Used by z_tilt and
quad_gantry_level, which differ in what the heights at the motors are.

A motor that is turned on by d without the coordinates knowing makes the gap there larger by d: what was probed at h is
then probed at h - d. So every motor goes up by its height above the lowest one, which moves nothing towards the bed,
and the coordinates are then shifted: quad_gantry_level keeps the mean height at the motors, after z_tilt the bed that
the probe has found is z = 0, whatever an endstop said.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .points import ProbePointsHelper

# Motors are turned one after the other, never more than this out of line at a time (mm).
ROUND_MM = 1.0
# Of a single motor (mm/s^2): any Z axis can do that.
ACCEL_MM_S2 = 100.0
# Places of the probe (x, y, z of the trigger) -> height at each motor
HeightsAtMotors = Callable[[list[list[float]]], list[float]]


class ZLevel:
    """A levelling command with its retries."""

    def __init__(
        self,
        config: ConfigWrapper,
        motors: int,
        heights: HeightsAtMotors,
        max_adjust: float | None = None,
        bed_is_zero: bool = False,
    ) -> None:
        self.printer = config.get_printer()
        self.name = config.get_name()
        self._count = motors
        self._heights = heights
        self._max_adjust = max_adjust
        self._bed_is_zero = bed_is_zero
        self._default_retries = config.getint("retries", 0, minval=0)
        self._default_tolerance = config.getfloat("retry_tolerance", 0.0, minval=0.0)
        self.points = ProbePointsHelper(config, self._finish_probing)
        self._motors: list[Any] = []
        self._gcmd: Any = None
        self._retries = self._tries = 0
        self._tolerance = 0.0
        self._last_range: float | None = None
        self.applied = False

    def register(self, command: str, text: str) -> None:
        self.printer.lookup_object("gcode").register_command(command, self.run, desc=text)
        self.printer.register_event_handler("klippy:connect", self._find_motors)
        self.printer.register_event_handler("stepper_enable:motor_off", self._forget)

    def _forget(self, print_time: float) -> None:
        self.applied = False

    def _find_motors(self) -> None:
        """Those that z alone turns, in the order of their sections."""
        kin = self.printer.lookup_object("toolhead").get_kinematics()
        self._motors = [
            motor
            for motor in kin.get_steppers()
            if motor.is_active_axis("z") and not motor.is_active_axis("x") and not motor.is_active_axis("y")
        ]
        if len(self._motors) != self._count:
            raise self.printer.config_error(
                f"Section '{self.name}' is for {self._count} Z motors, the printer has {len(self._motors)} "
                f"({', '.join(motor.get_name() for motor in self._motors)})"
            )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"applied": self.applied}

    def run(self, gcmd: GCodeCommand) -> None:
        """Probe and level, again if need be."""
        self._gcmd = gcmd
        self._retries = gcmd.get_int("RETRIES", self._default_retries, minval=0)
        self._tolerance = gcmd.get_float("RETRY_TOLERANCE", self._default_tolerance, minval=0.0)
        self._tries, self._last_range = 0, None
        self.applied = False
        self.points.start_probe(gcmd)

    def _finish_probing(self, offsets: Sequence[float], places: list[list[float]]) -> str:
        """'retry' or 'done'. Raises command_error."""
        of_probe = [[x + offsets[0], y + offsets[1], z] for x, y, z in places]
        found = [place[2] for place in places]
        spread = max(found) - min(found)
        self._gcmd.respond_info(
            f"Retries: {self._tries}/{self._retries} Probed points range: {spread:.6f} tolerance: {self._tolerance:.6f}"
        )
        if self._last_range is not None and spread > self._last_range + self._tolerance:
            raise self._gcmd.error(
                "Retries aborting: Probed points range is increasing. Possibly the Z motors are in another order than "
                "their places in the config, or the tolerance is too low."
            )
        self._adjust(self._heights(of_probe), offsets[2] if self._bed_is_zero else None)
        if self._retries and spread > self._tolerance:
            if self._tries >= self._retries:
                raise self._gcmd.error("Too many retries")
            self._tries, self._last_range = self._tries + 1, spread
            return "retry"
        self.applied = True
        return "done"

    def _adjust(self, heights: list[float], after: float | None) -> None:
        """Turn the motors so that what was probed at `heights` is level, and probed at `after`; None: their mean."""
        lowest = min(heights)
        middle = sum(heights) / len(heights)
        if self._max_adjust is not None:
            largest = max(abs(h - middle) for h in heights)
            if largest > self._max_adjust:
                raise self._gcmd.error(
                    f"Aborting {self.name}: required adjustment {largest:.6f} is greater than max_adjust "
                    f"{self._max_adjust:.6f}"
                )
        self._gcmd.respond_info(
            "Making the following Z adjustments:\n"
            + "\n".join(
                f"{motor.get_name()} = {h - middle:.6f}"
                for motor, h in zip(self._motors, heights, strict=True)
            )
        )
        self._turn([h - lowest for h in heights])
        toolhead = self.printer.lookup_object("toolhead")
        place = toolhead.get_position()
        place[2] += (middle if after is None else after) - lowest
        toolhead.set_position(place)

    def _turn(self, ways: Sequence[float]) -> None:
        force_move = self.printer.lookup_object("force_move")
        rounds = max(1, math.ceil(max(ways) / ROUND_MM))
        speed = self.points.get_lift_speed()
        for _ in range(rounds):
            for motor, way in zip(self._motors, ways, strict=True):
                if way:
                    force_move.manual_move(motor, way / rounds, speed, ACCEL_MM_S2)
