"""Planned flow: the C and its plain version agree to the last bit; retracted filament that returns is no flow."""

from __future__ import annotations

import random

import pytest

import chelper
from flow_reference import FilamentFlow

FFI, LIB = chelper.get_ffi()
AREA_MM2 = 2.4


class Queue:
    """An extruder's queue of moves."""

    def __init__(self) -> None:
        self.trapq = FFI.gc(LIB.trapq_alloc(), LIB.trapq_free)
        self.end_s, self.at_mm = 1.0, 0.0

    def move(self, length_mm: float, duration_s: float) -> None:
        way = 1.0 if length_mm >= 0.0 else -1.0
        speed = abs(length_mm) / duration_s
        place = (self.at_mm, 0.0, 0.0, way, 0.0, 0.0)
        LIB.trapq_append(self.trapq, self.end_s, 0.0, duration_s, 0.0, *place, speed, speed, 0.0)
        self.end_s += duration_s
        self.at_mm += length_mm

    def spans(self, start_s: float, end_s: float) -> list:
        found = FFI.new("struct trapq_span[]", LIB.FLOW_SPANS_MAX)
        return list(found[0 : LIB.trapq_extract(self.trapq, found, LIB.FLOW_SPANS_MAX, start_s, end_s)])


class Look:
    def __init__(self) -> None:
        self.flow = FFI.new("struct filament_flow *")
        LIB.filament_flow_reset(self.flow)

    def __call__(self, queue: Queue, start_s: float, end_s: float) -> list[tuple[float, float]]:
        times, flows = (FFI.new("double[]", LIB.FLOW_STEPS_MAX) for _ in range(2))
        count = LIB.filament_flow_look(self.flow, queue.trapq, start_s, end_s, AREA_MM2, times, flows)
        return list(zip(times[0:count], flows[0:count], strict=True))


def test_retracted_filament_that_returns_is_no_flow() -> None:
    queue, look = Queue(), Look()
    for length_mm in (2.0, -1.0, 1.0, 2.0):
        queue.move(length_mm, 0.5)
    assert look(queue, 1.0, 3.0) == [(1.0, 4.0 * AREA_MM2), (1.5, 0.0), (2.5, 4.0 * AREA_MM2), (3.0, 0.0)]


@pytest.mark.parametrize("seed", range(4))
def test_flow_is_that_of_the_plain_version(seed: int) -> None:
    rng, queue, look, plain = random.Random(seed), Queue(), Look(), FilamentFlow()
    seen = 0
    for _ in range(400):
        for _ in range(rng.randrange(4)):
            queue.move(rng.choice((0.01, 1.0, 1.01, -0.8, 0.8, 3.0 * rng.random())), rng.choice((0.02, 0.1)))
        if rng.random() < 0.05:
            queue.end_s += 0.1  # nothing is planned for a while
        if rng.random() < 0.02:
            queue.at_mm = 0.0 if rng.random() < 0.5 else 1000.0
        start_s = queue.end_s - 0.3 * rng.random()
        expected = plain.look(queue.spans(start_s, start_s + 0.25), start_s, AREA_MM2)
        assert look(queue, start_s, start_s + 0.25) == expected
        seen += len(expected)
    assert seen > 400
