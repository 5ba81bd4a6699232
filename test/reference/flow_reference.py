"""filament_flow.h in Python: what the C has to agree with to the last bit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

RETRACT_MAX_MM = 50.0
FLOW_MIN = 0.01
SAME_SHARE = 0.02


class FilamentFlow:
    """Spans are those of trapq_extract."""

    def __init__(self) -> None:
        self.peak_mm = -1e9  # farthest the filament has been fed before the spans looked at
        self.passed: list[tuple[float, float]] = []  # (end of a span, farthest by then)

    def look(self, spans: Sequence[Any], start_s: float, area_mm2: float) -> list[tuple[float, float]]:
        """(time, flow) of each step."""
        if not spans:
            return []
        passed = [peak_mm for end, peak_mm in self.passed if end <= start_s]
        peak_mm = passed[-1] if passed else self.peak_mm
        self.peak_mm, self.passed = peak_mm, []
        steps: list[tuple[float, float]] = []
        flow, until_s = 0.0, start_s
        for span in spans:
            new_mm, peak_mm = _new_filament(span, peak_mm)
            self.passed.append((span.print_time + span.duration, peak_mm))
            mean = new_mm / span.duration * area_mm2 if span.duration > 0.0 else 0.0
            mean = mean if mean > FLOW_MIN else 0.0
            if span.print_time > until_s + 1e-6 and flow:
                steps.append((until_s, 0.0))
                flow = 0.0
            if abs(mean - flow) > SAME_SHARE * flow:
                steps.append((span.print_time, mean))
                flow = mean
            until_s = span.print_time + span.duration
        if flow:
            steps.append((until_s, 0.0))
        return steps


def _new_filament(span: Any, peak_mm: float) -> tuple[float, float]:
    """Length of new filament over a span, and the farthest fed after it."""
    length_mm = span.x_r * (span.start_v + 0.5 * span.accel * span.duration) * span.duration
    if span.start_x < peak_mm - RETRACT_MAX_MM:
        peak_mm = span.start_x  # another origin
    end_mm = span.start_x + length_mm
    return max(0.0, min(length_mm, end_mm - peak_mm)), max(peak_mm, end_mm)
