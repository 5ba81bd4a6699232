"""What is going to take heat from an induction nozzle: the planned extrusion and the part fan, for its control law.

Moves stand in the extruder's motion queue a fraction of a second before they happen; asking the queue costs nothing
while nothing is printed and does not slow the planning of moves down, as a callback for each move would.
"""

from __future__ import annotations

from typing import Any

import chelper
from roles import Printer
from thermal.control.control_api import IDLE, Schedule

BEHIND_S = 0.050  # blocks that are still to arrive lie this far back
AHEAD_S = 0.200  # beyond any horizon, and until the next look
LOOK_S = 0.025
SPANS_MAX = 256
RETRACT_MAX_MM = 50.0
FLOW_MIN = 0.01  # mm^3/s; less is standing still
SAME_SHARE = 0.02  # neighbouring spans nearer than this are one


class FlowAhead:
    """Looks ahead for one heater."""

    def __init__(self, printer: Printer, extruder_name: str) -> None:
        self.printer = printer
        self.extruder_name = extruder_name
        self.flow = self.fan = IDLE
        self._looked_s = -1e9
        self._peak_mm = -1e9  # farthest the filament has been fed before the spans looked at
        self._passed: list[tuple[float, float]] = []  # (end of a span, farthest by then)
        self._ffi, self._lib = chelper.get_ffi()
        self._spans = self._ffi.new("struct trapq_span[]", SPANS_MAX)

    def look(self, now_s: float) -> bool:
        """Bring flow and fan up to date; False: it is too soon to look again."""
        if abs(now_s - self._looked_s) < LOOK_S:
            return False
        self._looked_s = now_s
        self.flow = self._flow(now_s)
        fan = self.printer.lookup_object("fan", None)
        speed = fan.get_status(now_s)["speed"] if fan is not None else 0.0
        if speed != self.fan.before:
            self.fan = Schedule.constant(speed)
        return True

    def _flow(self, now_s: float) -> Schedule:
        extruder = self.printer.lookup_object(self.extruder_name, None)
        if extruder is None or not hasattr(extruder, "get_trapq"):
            return IDLE
        start_s, end_s = now_s - BEHIND_S, now_s + AHEAD_S
        count = self._lib.trapq_extract(extruder.get_trapq(), self._spans, SPANS_MAX, start_s, end_s)
        if not count:
            return IDLE
        passed = [peak_mm for end, peak_mm in self._passed if end <= start_s]
        peak_mm = passed[-1] if passed else self._peak_mm
        self._peak_mm, self._passed = peak_mm, []
        times, flows, flow, until_s = [], [], 0.0, start_s
        for i in range(count):
            span = self._spans[i]
            new_mm, peak_mm = _new_filament(span, peak_mm)
            self._passed.append((span.print_time + span.duration, peak_mm))
            mean = new_mm / span.duration * extruder.filament_area if span.duration > 0.0 else 0.0
            mean = mean if mean > FLOW_MIN else 0.0
            if span.print_time > until_s + 1e-6 and flow:
                times.append(until_s)
                flows.append(0.0)
                flow = 0.0
            if abs(mean - flow) > SAME_SHARE * flow:
                times.append(span.print_time)
                flows.append(mean)
                flow = mean
            until_s = span.print_time + span.duration
        if flow:
            times.append(until_s)
            flows.append(0.0)
        return Schedule(tuple(times), tuple(flows)) if times else IDLE


def _new_filament(span: Any, peak_mm: float) -> tuple[float, float]:
    """Length of new filament over a span, and the farthest fed after it: what was drawn back and comes again is not
    new, no cold filament follows it."""
    length_mm = span.x_r * (span.start_v + 0.5 * span.accel * span.duration) * span.duration
    if span.start_x < peak_mm - RETRACT_MAX_MM:
        peak_mm = span.start_x  # another origin
    end_mm = span.start_x + length_mm
    return max(0.0, min(length_mm, end_mm - peak_mm)), max(peak_mm, end_mm)
