"""Steps in C: every one within 25 us of the analytic time, never late, none missing, none too many."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, seed, settings
from hypothesis import strategies as st

from motion_rig import FFI, LIB, MAX_ERROR_S, CStepper, Trapezoid, from_rest, path

# Clocks are whole numbers: a step may sit one tick beyond either end of its tolerance.
TICK = 1.0


def random_moves(rng: np.random.Generator, count: int, start_time: float = 1.0) -> list[Trapezoid]:
    """Joined moves: speeds agree at the joints, directions change only at rest, some rests between."""
    moves: list[Trapezoid] = []
    time, place, speed, sign = start_time, 0.0, 0.0, 1.0
    for _ in range(count):
        accel = rng.uniform(500.0, 20000.0)
        top = max(speed, rng.uniform(2.0, 300.0))
        end = 0.0 if rng.random() < 0.4 else rng.uniform(0.0, top)
        cruise_t = 0.0 if rng.random() < 0.3 else rng.uniform(0.0, 0.2)
        move = Trapezoid(
            time, (top - speed) / accel, cruise_t, (top - end) / accel, place, sign, speed, top, accel
        )
        moves.append(move)
        time, place, speed = move.end_time, move.end, end
        if not end:
            sign = -sign if rng.random() < 0.6 else sign
            time += rng.uniform(0.002, 0.5) if rng.random() < 0.5 else 0.0
    return moves


def check_against(stepper: CStepper, moves: list[Trapezoid]) -> None:
    """Each step lies where its edge is passed: not later, and at most 25 us before."""
    trace, d = stepper.trace, stepper.step_dist
    assert trace.intervals_ok
    clocks = np.array(trace.clocks)
    assert np.all(np.diff(clocks) > 0)
    before = np.concatenate([[0], trace.positions[:-1]])
    after = np.array(trace.positions)
    edges = 0.5 * (before + after) * d
    forward = np.where(after > before, 1.0, -1.0)
    tick_s = TICK / stepper.clock_hz
    # not late: a tick after the step the edge is not behind … a step before its time by the tolerance it is not reached
    at_step = path(moves, clocks / stepper.clock_hz - tick_s)
    at_latest = path(moves, clocks / stepper.clock_hz + MAX_ERROR_S + tick_s)
    slack = 1e-9
    assert np.all(forward * (at_step - edges) <= slack), "a step after its time"
    assert np.all(forward * (at_latest - edges) >= -slack), "a step more than 25 us before its time"


@pytest.mark.parametrize("clock_hz", [16e6, 72e6, 520e6])
@pytest.mark.parametrize("step_dist", [0.0125, 0.0025])
def test_every_step_is_in_its_tolerance(clock_hz: float, step_dist: float) -> None:
    moves = random_moves(np.random.default_rng(7), 150)
    stepper = CStepper(step_dist, clock_hz)
    stepper.open()
    for move in moves:
        move.append(stepper.trapq)
    stepper.run(moves[-1].end_time + 1.0)
    check_against(stepper, moves)
    # the grid is left by less than half a step
    assert abs(stepper.trace.position * step_dist - moves[-1].end) <= 0.5 * step_dist + 1e-9


@seed(20261121)
@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.02, 0.4), st.booleans())
def test_working_in_slices_changes_nothing(number: int, slice_s: float, invert: bool) -> None:
    moves = random_moves(np.random.default_rng(number), 12)
    whole, sliced = CStepper(invert=invert), CStepper(invert=invert)
    for stepper in (whole, sliced):
        stepper.open()
        for move in moves:
            move.append(stepper.trapq)
    end = moves[-1].end_time + 0.5
    whole.run(end)
    time = 0.0
    while time < end:
        time = min(end, time + slice_s)
        sliced.run(time, time - 0.05)
    sliced.run(end)
    if not invert:
        check_against(sliced, moves)
    sign = -1 if invert else 1
    assert whole.trace.position == sliced.trace.position
    assert sign * whole.trace.position == LIB.itersolve_get_steps(whole.sk)


def test_direction_pin_inversion_only_turns_the_pin() -> None:
    traces = []
    for invert in (False, True):
        stepper = CStepper(invert=invert)
        stepper.open()
        from_rest(1.0, 0.0, 5.0, 100.0, 3000.0).append(stepper.trapq)
        stepper.run(3.0)
        traces.append(stepper.trace)
    assert traces[0].clocks == traces[1].clocks
    assert traces[0].position == -traces[1].position == 400


def test_constant_speed_needs_few_commands() -> None:
    """10 s at constant speed: runs as long as the search allows (4096 steps), so two orders below one per step."""
    stepper = CStepper()
    stepper.open()
    Trapezoid(1.0, 0.0, 10.0, 0.0, 0.0, 1.0, 50.0, 50.0, 0.0).append(stepper.trapq)
    stepper.run(12.0)
    assert stepper.trace.position == 40000
    assert stepper.trace.commands <= 40000 / 1000


def test_step_and_immediate_return_cancel() -> None:
    """Half a millisecond over an edge and back is not worth two steps; 20 ms is."""
    for dwell_s, steps in ((0.0001, 0), (0.020, 2)):
        stepper = CStepper()
        stepper.open()
        first = from_rest(1.0, 0.0, 0.00626, 100.0, 3000.0)
        back = from_rest(first.end_time + dwell_s, first.end, -0.00626, 100.0, 3000.0)
        first.append(stepper.trapq)
        back.append(stepper.trapq)
        stepper.run(3.0)
        assert len(stepper.trace.clocks) == steps
        assert stepper.trace.position == 0


def test_a_long_rest_gets_a_new_clock_base() -> None:
    """The 32-bit clock of 72 MHz wraps each minute; a rest of ten must not confuse it."""
    stepper = CStepper()
    stepper.open()
    place = 0.0
    for time in (1.0, 8.0, 700.0):
        move = from_rest(time, place, 4.0, 100.0, 3000.0)
        move.append(stepper.trapq)
        place = move.end
        stepper.run(time + 2.0)
    assert stepper.trace.rebases == 2  # at the start and before the last; 7 s fit into an interval
    assert stepper.trace.position == 960
    wrapped = [c & 0xFFFFFFFF for c in stepper.trace.clocks[-320:]]
    wanted = [int(t * 72e6) & 0xFFFFFFFF for t in (700.0, 702.0)]
    assert all(0 < (c - wanted[0]) & 0xFFFFFFFF < 2 * 72e6 for c in wrapped)


def test_position_lookup_knows_the_past() -> None:
    moves = random_moves(np.random.default_rng(3), 40)
    stepper = CStepper()
    stepper.open()
    for move in moves:
        move.append(stepper.trapq)
    stepper.run(moves[-1].end_time + 0.1)
    clocks, positions = stepper.trace.clocks, stepper.trace.positions
    for index in range(0, len(clocks), 37):
        assert LIB.stepcompress_position_at(stepper.sc, clocks[index]) == positions[index]
        assert LIB.stepcompress_position_at(stepper.sc, clocks[index] - 1) == (
            positions[index - 1] if index else 0
        )


def test_reset_places_the_stepper_where_the_mcu_says() -> None:
    stepper = CStepper()
    stepper.open()
    from_rest(1.0, 0.0, 10.0, 100.0, 3000.0).append(stepper.trapq)
    stepper.run(1.05)
    halted = LIB.stepcompress_position_at(stepper.sc, int(1.04 * 72e6))
    LIB.stepcompress_reset(stepper.sc, int(1.1 * 72e6), halted)
    LIB.itersolve_set_steps(stepper.sk, halted)
    LIB.trapq_set_position(stepper.trapq, 1.05, 3.0, 0.0, 0.0)
    LIB.itersolve_set_position(stepper.sk, 3.0, 0.0, 0.0)
    assert LIB.stepcompress_position_at(stepper.sc, int(2.0 * 72e6)) == halted
    made = len(stepper.trace.clocks)
    from_rest(2.0, 3.0, 1.0, 100.0, 3000.0).append(stepper.trapq)
    stepper.run(3.0)
    assert stepper.trace.rebases == 2
    assert len(stepper.trace.clocks) - made == 80


def test_move_queue_places_are_never_overbooked() -> None:
    """With few places a command must wait until the command that many before it has ended."""
    stepper = CStepper(0.0025)
    places = 16
    stepper.open(places)
    moves = random_moves(np.random.default_rng(11), 60)
    for move in moves:
        move.append(stepper.trapq)
    stepper.run(moves[-1].end_time + 0.5)
    ends, total = [], 0
    history = FFI.new("struct step_record[]", 100000)
    total = LIB.stepcompress_history(stepper.sc, history, 100000, 0, 2**63)
    ends = [history[i].last_clock for i in range(total)]
    # reset_step_clock takes no place
    min_clocks = [m for m, _ in stepper.messages][-total:]
    assert total > 10 * places
    for number in range(places, total):
        assert min_clocks[number] >= ends[number - places]
    requests = [r for _, r in stepper.messages]
    assert requests == sorted(requests)


def test_a_step_solver_at_the_end_of_a_stop_finds_the_last_edge() -> None:
    """Decelerating to rest exactly on a step edge: the root is where the speed is zero."""
    stepper = CStepper(0.01)
    stepper.open()
    move = from_rest(1.0, 0.0, 0.995, 50.0, 1000.0)
    move.append(stepper.trapq)
    stepper.run(2.0)
    assert stepper.trace.position in (99, 100)  # 99.5 steps: a hair's breadth decides
    assert stepper.trace.clocks[-1] <= move.end_time * 72e6 + 1


# ---- pressure advance ----


def smoothed(
    moves: list[Trapezoid], flags: list[bool], advance: float, window: float, t: np.ndarray
) -> np.ndarray:
    """The documented formula by brute force: triangular average of e + K*v over +-window."""
    fine = np.linspace(-window, window, 4001)
    weight = (window - np.abs(fine)) / window**2
    result = np.empty_like(t)
    for i, centre in enumerate(t):
        times = centre + fine
        p = path(moves, times)
        for move, flag in zip(moves, flags, strict=True):
            inside = (times >= move.time) & (times < move.end_time)
            if flag and inside.any():
                p[inside] += advance * move.velocity(times[inside])
        result[i] = np.trapezoid(p * weight, fine) if hasattr(np, "trapezoid") else np.trapz(p * weight, fine)
    return result


def test_pressure_advance_follows_the_documented_formula() -> None:
    advance, smooth_s = 0.05, 0.040
    solver = LIB.extruder_stepper_alloc()
    LIB.extruder_set_pressure_advance(solver, advance, smooth_s)
    step = 0.002
    stepper = CStepper(step, solver=solver)
    stepper.open()
    moves, flags = [], []
    time, place = 1.0, 0.0
    for ratio, start, top, end, cruise, flag in (
        (0.05, 0.0, 100.0, 60.0, 0.05, True),
        (0.05, 60.0, 60.0, 10.0, 0.02, True),
        (0.05, 10.0, 150.0, 0.0, 0.1, True),
        (-1.0, 0.0, 30.0, 0.0, 0.01, False),
        (1.0, 0.0, 30.0, 0.0, 0.01, False),
        (0.08, 0.0, 80.0, 0.0, 0.2, True),
    ):
        move = Trapezoid(
            time, (top - start) / 3000, cruise, (top - end) / 3000, place, ratio, start, top, 3000.0
        )
        move.append(stepper.trapq, 1.0 if flag else 0.0)
        moves.append(move)
        flags.append(flag)
        time, place = move.end_time, move.end
    assert LIB.itersolve_look_ahead(solver) == pytest.approx(smooth_s / 2)
    for until in np.arange(0.1, moves[-1].end_time + 0.2, 0.07):
        stepper.run(float(until), float(until) - 0.05)
    stepper.run(moves[-1].end_time + 0.5)
    trace = stepper.trace
    # a slice boundary is a boundary of pieces only: the motion ends where the filament was asked to
    assert abs(trace.position * step - place) <= step / 2 + 1e-9
    after = np.array(trace.positions)
    before = np.concatenate([[0], after[:-1]])
    edges, forward = 0.5 * (before + after) * step, np.sign(after - before)
    pick = slice(None, None, 7)
    t = stepper.step_times()
    early = smoothed(moves, flags, advance, smooth_s / 2, t[pick] - 1e-6)
    late = smoothed(moves, flags, advance, smooth_s / 2, t[pick] + MAX_ERROR_S + 1e-6)
    # the brute force integral is good to about a thousandth of a step
    slack = 2e-3 * step
    assert np.all(forward[pick] * (early - edges[pick]) <= slack)
    assert np.all(forward[pick] * (late - edges[pick]) >= -slack)
    assert trace.positions[-1] < max(trace.positions), "the advance is taken back at the end"


def test_trapq_remembers_where_it_was() -> None:
    trapq = FFI.gc(LIB.trapq_alloc(), LIB.trapq_free)
    moves = random_moves(np.random.default_rng(5), 400)
    for move in moves:
        move.append(trapq)
    position, speed = FFI.new("double[3]"), FFI.new("double *")
    for t in np.linspace(1.0, moves[-1].end_time, 97):
        assert LIB.trapq_state_at(trapq, t, position, speed)
        assert position[0] == pytest.approx(path(moves, np.array([t]))[0], abs=1e-6)
    assert not LIB.trapq_state_at(trapq, 0.5, position, speed)
    LIB.trapq_forget_before(trapq, moves[200].time)
    assert not LIB.trapq_state_at(trapq, moves[100].time, position, speed)
    LIB.trapq_set_position(trapq, moves[300].time, 7.0, 8.0, 9.0)
    assert LIB.trapq_state_at(trapq, moves[-1].end_time + 5.0, position, speed)
    assert list(position) == [7.0, 8.0, 9.0] and math.isclose(speed[0], 0.0)
