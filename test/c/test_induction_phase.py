"""src/phase.c: phases queued by clock, and which phase holds at which sample."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pure_harness import load_induction

ffi, lib = load_induction()
RING = 64


def schedule(phase_max: int = 45000):
    t = ffi.new("struct phase_schedule *")
    lib.phase_init(t, phase_max)
    return t


def push(t, clock: int, phase: int, earliest: int | None = None):
    """(accepted, node); the caller keeps the node alive, as the firmware's move queue does."""
    node = ffi.new("struct phase_node *", {"clock": clock & 0xFFFFFFFF, "phase": phase})
    node.next = node  # what an entry of the pool had there before
    return lib.phase_push(t, node, (clock if earliest is None else earliest) & 0xFFFFFFFF), node


def pending(t) -> list[int]:
    """Phases that wait, oldest first."""
    phases, node = [], t.first
    while node != ffi.NULL:
        phases.append(node.phase)
        node = node.next
    return phases


def phases_at(t, first: int, count: int, piece: int = 32) -> list[int]:
    """Phase of each sample, asked half buffer by half buffer."""
    out: list[int] = []
    run = ffi.new("uint16_t *")
    for start in range(first, first + count, piece):
        left = piece
        while left:
            phase = lib.phase_run(t, (start + piece - left) & 0xFFFFFFFF, left, run)
            assert 1 <= run[0] <= left
            out += [phase] * run[0]
            left -= run[0]
    return out


@pytest.mark.parametrize("base", [1000, 2**32 - 50])
def test_phases_come_due_in_order_across_the_clocks_wrap(base):
    t = schedule()
    nodes = [push(t, base + 40 * i, 100 + i) for i in range(4)]
    assert all(accepted for accepted, _ in nodes)
    assert lib.phase_pop_due(t, (base - 1) & 0xFFFFFFFF) == ffi.NULL
    seen = []
    for clock in range(base, base + 200):
        while (node := lib.phase_pop_due(t, clock & 0xFFFFFFFF)) != ffi.NULL:
            seen.append((clock - base, node.phase))
    assert seen == [(0, 100), (40, 101), (80, 102), (120, 103)]
    assert t.first == ffi.NULL and t.last == ffi.NULL


@pytest.mark.parametrize("base", [1000, 2**32 - 50])
@pytest.mark.parametrize(("cut_at", "kept"), [(0, 0), (39, 1), (40, 1), (41, 2), (500, 4)])
def test_a_cut_takes_back_what_is_not_before_its_clock(base, cut_at, kept):
    t = schedule()
    nodes = [push(t, base + 40 * i, 100 + i)[1] for i in range(4)]
    node, taken = lib.phase_cut(t, (base + cut_at) & 0xFFFFFFFF), []
    assert pending(t) == [100 + i for i in range(kept)]
    while node != ffi.NULL:
        taken.append(node.phase)
        node = node.next
    assert taken == [100 + i for i in range(kept, 4)]
    accepted, newest = push(t, base + max(cut_at, 0), 7)  # goes behind what stayed
    assert accepted == 1
    assert pending(t) == [n.phase for n in nodes[:kept]] + [newest.phase]


def test_phases_queued_between_pops_stay_in_line():
    t = schedule()
    kept = [push(t, 1000, 1)[1], push(t, 1001, 2)[1]]
    assert lib.phase_pop_due(t, 1000) == kept[0]
    kept.append(push(t, 1002, 3)[1])
    assert pending(t) == [2, 3]
    assert [lib.phase_pop_due(t, 1002).phase for _ in range(2)] == [2, 3]
    accepted, late = push(t, 900, 4)  # nothing is pending, so nothing is out of order
    assert accepted and pending(t) == [4] and late not in kept


def test_what_is_forgotten_is_never_due_and_new_phases_are_taken():
    t = schedule()
    kept = [push(t, 1000 + i, 1 + i)[1] for i in range(3)]
    lib.phase_forget(t)
    assert lib.phase_pop_due(t, 2000) == ffi.NULL
    accepted, node = push(t, 500, 9)  # older than what was forgotten
    assert accepted and pending(t) == [9]
    assert lib.phase_pop_due(t, 500) == node and node not in kept


def test_order_of_clocks_is_demanded_and_a_refused_node_is_not_kept():
    t = schedule()
    first, second = push(t, 1000, 1), push(t, 999, 2)
    assert first[0] and not second[0]
    assert t.first == t.last == first[1]
    assert pending(t) == [1]


def test_late_phases_are_due_at_once_and_stay_in_order():
    t = schedule()
    kept = [push(t, 100, 1, earliest=5000), push(t, 100, 2, earliest=5001), push(t, 5100, 3, earliest=5002)]
    assert all(accepted for accepted, _ in kept)
    assert lib.phase_pop_due(t, 4999) == ffi.NULL
    assert [lib.phase_pop_due(t, 5001).phase for _ in range(2)] == [1, 2]
    assert lib.phase_pop_due(t, 5099) == ffi.NULL
    assert lib.phase_pop_due(t, 5100).phase == 3


@pytest.mark.parametrize(("asked", "given_"), [(0, 0), (20000, 20000), (20001, 20000), (45000, 20000)])
def test_phase_is_held_to_the_configured_maximum(asked, given_):
    t = schedule(phase_max=20000)
    _, node = push(t, 1, asked)
    assert node.phase == given_


@settings(max_examples=200, deadline=None)
@given(
    start=st.sampled_from([0, 32, 2**32 - 64]),
    steps=st.lists(st.tuples(st.integers(0, 40), st.integers(1, 9)), max_size=40),
)
def test_every_sample_gets_the_phase_that_held(start, steps):
    """Steps arrive as time passes, read half a buffer behind, as the ADC interrupt does."""
    t = schedule()
    total = 64 + sum(gap for gap, _ in steps) + 32
    expected = [0] * (total + 32)
    arrivals, at = [], 0
    for gap, phase in steps:
        at += gap
        arrivals.append((at, phase))
        expected[at:] = [phase] * (len(expected) - at)
    got: list[int] = []
    for half in range(total // 32):
        while arrivals and arrivals[0][0] <= half * 32 + 32:
            index, phase = arrivals.pop(0)
            lib.phase_applied(t, (start + index) & 0xFFFFFFFF, phase)
        got += phases_at(t, start + half * 32, 32)
    assert got == expected[: len(got)]


def test_two_steps_before_one_sample_leave_the_later():
    t = schedule()
    lib.phase_applied(t, 10, 5)
    lib.phase_applied(t, 10, 7)
    assert phases_at(t, 0, 32) == [0] * 10 + [7] * 22


def test_more_steps_than_the_ring_keeps_the_newest_right():
    """A step every sample for two rings: what the double buffer can still hold (64 samples) is exact."""
    t = schedule()
    for index in range(2 * RING):
        lib.phase_applied(t, index, index)
    assert phases_at(t, RING, RING) == list(range(RING, 2 * RING))
    assert t.commanded == 2 * RING - 1


@pytest.mark.parametrize("steps", [RING, RING + 1, RING + 5])
def test_a_ring_of_steps_ahead_is_exact_and_one_more_counts_to_the_oldest_that_fell_out(steps):
    t = schedule()
    for n in range(steps):
        lib.phase_applied(t, 100 + n, 1000 + n)
    fallen = steps - RING
    before = 1000 + fallen - 1 if fallen else 0
    held = [before] * (100 + fallen) + [1000 + n for n in range(fallen, steps)]
    assert phases_at(t, 0, 96) + phases_at(t, 96, 96) == (held + [held[-1]] * 96)[:192]


def test_a_step_ahead_of_the_samples_waits_for_its_sample():
    t = schedule()
    lib.phase_applied(t, 100, 5)
    assert phases_at(t, 0, 96) == [0] * 96
    assert phases_at(t, 96, 32) == [0] * 4 + [5] * 28
