"""METHOD=tap: the nozzle on the bed stops the coil's approach, and so the rise of its frequency.

On the board: the frequency's change per mm, smoothed; when it has fallen by tap_threshold from its highest, the head
stops. Then it is lifted, and height and place of the samples show where the nozzle left the bed: above it, both change
alike; below, the coil's height changes less.
"""

from __future__ import annotations

import statistics
from typing import Any

from ..load_cells.contact import find_contact
from ..probing.analog_endstop import AnalogEndstop
from ..probing.filters import Scale, low_pass
from ..probing.stream import position_at
from .chip import CODE_MAX, RATE_HZ

MAX_SECTIONS = 2
SMOOTH_HZ = 20.0
DIFFERENCE = (1.0, -1.0, 0.0, 0.0, 0.0)
UNITS = 16  # of Hz/mm
LIFT_MM, LIFT_SPEED = 0.6, 1.5
GUESS_SHARE = 0.3  # of the slope at the bed
DEPTH_MAX_MM = 0.5


class Tap:
    """One touch. `slope_hz_mm`: of the frequency just above the bed, after `run`."""

    def __init__(self, coil: Any, speed: float, threshold_hz_mm: float) -> None:
        self._coil, self._speed, self._threshold = coil, speed, threshold_hz_mm
        self._printer = coil.printer
        self.slope_hz_mm = 0.0

    def arm(self, endstop: AnalogEndstop) -> None:
        """Called before the move."""
        chip = self._coil.chip
        # codes a sample -> Hz/mm in UNITS
        factor = chip.hz_of(1.0) * RATE_HZ / self._speed * UNITS
        sections = [DIFFERENCE, low_pass(SMOOTH_HZ, RATE_HZ, 2)]
        endstop.filter.send(sections, Scale(0, factor, auto_offset=True))
        endstop.set_trigger("diff_peak_gt", round(self._threshold * UNITS), (1, CODE_MAX))

    def run(self, switch: Any) -> list[float]:
        """x, y, height of the contact. Raises the printer's command_error."""
        toolhead = self._printer.lookup_object("toolhead")
        status = toolhead.get_status(self._printer.get_reactor().monotonic())
        target = toolhead.get_position()
        target[2] = status["axis_minimum"][2]
        stopped = switch.probing_move(target, self._speed)
        gathering = self._coil.chip.stream.gather()
        try:
            start = toolhead.get_last_move_time()
            here = toolhead.get_position()
            toolhead.manual_move([None, None, here[2] + LIFT_MM], LIFT_SPEED)
            end = toolhead.get_last_move_time()
            gathering.wait_until(end)
            samples = gathering.between(start, end)
        finally:
            gathering.end()
        if self._coil.chip.mcu.is_fileoutput():
            return list(stopped[:3])
        period_s = 1.0 / RATE_HZ
        points = []
        for time, hz in samples:
            z = position_at(self._printer, time, period_s)[2]
            points.append((z, self._coil.height_mm(hz) - z))
        contact = find_contact(points)
        if contact is None or contact - here[2] > DEPTH_MAX_MM:
            raise self._printer.command_error(
                "The tap did not show a contact with the bed: if the head stopped above the bed, tap_threshold is too"
                " low; else lower it, and see that nozzle and bed are clean."
            )
        above = [(z, hz) for (z, _), (_, hz) in zip(points, samples, strict=True) if z > contact]
        if len(above) > 2:
            self.slope_hz_mm = -statistics.linear_regression(
                [z for z, _ in above], [hz for _, hz in above]
            ).slope
        return [*here[:2], contact]
