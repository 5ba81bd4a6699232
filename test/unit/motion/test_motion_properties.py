"""Random lists of moves on every machine: each step against the analytic path, every limit, and the oracle's own eyes.

The long form, thousands of lists, is `make soak-motion`.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from motion_exact import LINEAR, Filament, Ramps, head_epochs, published_pulses
from motion_limits import plan_faults, step_faults
from motion_lists import BOXES, config_of, gcode_of
from motion_oracle import MAX_ERROR_S, TICK_S, Run, Steps, check_motors, run_batch
from motion_rig import LIB, CStepper, from_rest, path

LISTS = 12  # per machine and seed


@pytest.mark.parametrize("name", BOXES)
def test_random_lists(tmp_path: Path, name: str) -> None:
    run = run_batch(tmp_path, gcode_of(name, 1, LISTS), config_of(name))
    tally = check_motors(run)
    assert not tally.faults
    assert tally.steps > 100_000
    assert tally.moves > 500
    # steps do use the tolerance they have: else nothing here would have looked at it
    assert 0.9 * MAX_ERROR_S < tally.earliest_s <= MAX_ERROR_S + TICK_S
    assert not plan_faults(run)
    if name.replace("-", "_") in LINEAR:
        windows, faults = step_faults(run)
        assert windows > 100
        assert not faults


@pytest.mark.parametrize("name", ["cartesian", "corexy"])
def test_the_short_way_through_c_makes_the_same_steps(tmp_path: Path, name: str) -> None:
    """Without a listener Python does not see plain moves; the oracle's runs have one."""
    gcode, config = gcode_of(name, 2, 6), config_of(name)
    seen, unseen = (run_batch(tmp_path, gcode, config, record) for record in (True, False))
    assert not check_motors(seen).faults
    for motor, steps in seen.steps.items():
        assert np.array_equal(steps.after, unseen.steps[motor].after)
        # times are summed in another order: a tick of rounding
        assert np.abs(steps.times - unseen.steps[motor].times).max() < MAX_ERROR_S


def test_a_longer_smooth_time_in_mid_print_makes_no_burst(tmp_path: Path) -> None:
    """The motor begins to move half the smooth time before the filament: the next move waits for it."""
    change = "SET_PRESSURE_ADVANCE ADVANCE=0.5 SMOOTH_TIME=0.2\n"
    gcode = f"G28\nM83\nG1 X50 Y50 F6000\nG1 X60 E0.5\n{change}G1 X90 E1.5 F12000\nG1 Y80 E1\nM400\n"
    run = run_batch(tmp_path, gcode, config_of("cartesian"))
    assert not check_motors(run).faults
    # 4 mm/s at most, and the advance of 0.5 s on 3000 mm/s^2 * 0.05: under 80 mm/s, a step of 0.0105 mm each 130 us
    assert np.diff(run.steps["extruder"].times).min() > 100e-6


def test_motion_that_should_have_begun_is_refused_not_rushed() -> None:
    """Steps are worked out up to 2 s; a move from 1.5 s on wants a hundred of them at once. None may come at the clock
    of the one before: the printer stops and says so."""
    stepper = CStepper()
    stepper.open()
    from_rest(1.0, 0.0, 5.0, 100.0, 3000.0).append(stepper.trapq)
    stepper.run(2.0)
    from_rest(1.5, 5.0, 80.0, 100.0, 3000.0).append(stepper.trapq)
    with pytest.raises(AssertionError):
        stepper.run(4.0)
    assert np.all(np.diff(stepper.trace.clocks) > 0)


# ---- the oracle can fail ----


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Run:
    run = run_batch(tmp_path_factory.mktemp("good"), gcode_of("corexy", 3, 3), config_of("corexy"))
    assert not check_motors(run).faults
    return run


def shift_one(steps: Steps, by_s: float) -> Steps:
    """One step in the midst of fast motion comes earlier or later."""
    times = steps.times.copy()
    gaps = np.minimum(np.diff(times)[:-1], np.diff(times)[1:])
    number = 1 + int(np.flatnonzero(gaps > 100e-6)[len(times) // 50])
    times[number] += by_s
    return Steps(times, steps.after)


def leave_out_pair(steps: Steps) -> Steps:
    """A step and its reversal are missing."""
    turn = int(np.flatnonzero(np.diff(np.sign(steps.after - steps.before)) != 0)[3])
    gap = steps.times[turn + 1] - steps.times[turn]
    assert gap > 0.0
    keep = np.ones(len(steps.times), dtype=bool)
    keep[turn - 20 : turn + 22] = False
    return Steps(steps.times[keep], steps.after[keep])


SPOILT = {
    "a step 50 us early": lambda s: shift_one(s, -2 * MAX_ERROR_S),
    "a step 50 us late": lambda s: shift_one(s, 2 * MAX_ERROR_S),
    "all steps 2 us late": lambda s: Steps(s.times + MAX_ERROR_S + 2e-6, s.after),
    "all steps the other way": lambda s: Steps(s.times, -s.after),
    "twenty steps and their return missing": leave_out_pair,
    "the last step missing": lambda s: Steps(s.times[:-1], s.after[:-1]),
}


@pytest.mark.parametrize("motor", ["stepper_x", "extruder"])
@pytest.mark.parametrize("fault", SPOILT)
def test_the_oracle_sees(good: Run, motor: str, fault: str) -> None:
    spoilt = replace(good, steps={**good.steps, motor: SPOILT[fault](good.steps[motor])})
    assert check_motors(spoilt).faults


def test_the_oracle_sees_another_shaper(good: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pulses one per cent too far apart."""
    assert any(any(pulses[0] for pulses in e.pulses) for e in head_epochs(good.recording.log))

    def wrong(kind: str, frequency_hz: float, damping: float) -> Any:
        return published_pulses(kind, 1.01 * frequency_hz, damping)

    monkeypatch.setattr("motion_exact.published_pulses", wrong)
    assert check_motors(good).faults


@pytest.mark.parametrize("field", ["cruise_v", "accel", "print_time", "end_v"])
def test_the_limits_check_sees_a_wrong_plan(good: Run, field: str) -> None:
    moves = [what for kind, what in good.recording.log if kind == "move"]
    move = max((m for m in moves if m.start_v > 1.0 and m.end_v > 1.0), key=lambda m: m.move_d)
    value = getattr(move, field)
    setattr(move, field, value * 1.02 + 0.1 if field != "print_time" else value - 0.01)
    try:
        assert _refused(good)
    finally:
        setattr(move, field, value)
    assert not _refused(good)


def _refused(run: Run) -> bool:
    try:
        return bool(plan_faults(run))
    except AssertionError:
        return True


# ---- the oracle's parts against first principles ----


@pytest.mark.parametrize("kind", ["zv", "zvd", "mzv"])
def test_published_pulses_cancel_what_they_are_for(kind: str) -> None:
    """Undamped, no vibration is left at the design frequency."""
    weights, delays = published_pulses(kind, 50.0, 0.0)
    assert sum(weights) == pytest.approx(1.0)
    left = abs(sum(w * np.exp(2j * math.pi * 50.0 * t) for w, t in zip(weights, delays, strict=True)))
    assert left == pytest.approx(0.0, abs=1e-3)


def test_the_average_by_moments_is_the_integral() -> None:
    """Against the triangle summed up over ten thousand points."""
    rows = Ramps(np.array([0.3]))
    rows.rows = [(1.0, 0.1, 0.0, 50.0, 1.0, 0.3, 0.05), (1.1, 0.2, 10.0, 0.0, 1.0, 0.325, 0.05)]
    advance, smooth = 0.08, 0.05
    fine = np.linspace(-0.5 * smooth, 0.5 * smooth, 20001)
    weight = (0.5 * smooth - np.abs(fine)) / (0.5 * smooth) ** 2
    times = np.array([0.99, 1.0, 1.013, 1.09, 1.1, 1.2, 1.29, 1.31])
    got = Filament(0.9, rows, advance, smooth).motor(times)
    for t, value in zip(times, got, strict=True):
        x = t + fine
        speed = np.where(x < 1.1, 100.0 * (x - 1.0), 10.0) * 0.05 * ((x >= 1.0) & (x < 1.3))
        p = (rows.at(x, 0) + advance * speed) * weight
        # edges of the speed fall between points: 1e-6 s * a jump of 0.04 mm * the weight of 40
        assert value == pytest.approx(np.sum(0.5 * (p[1:] + p[:-1])) * (fine[1] - fine[0]), abs=5e-6)


# ---- several MCUs whose clocks wander ----

CRYSTALS = {16e6: 40e-6, 72e6: -50e-6, 180e6: 15e-6}  # nominal frequency, share by which it is off
ESTIMATE_ERROR_S = 5e-6  # of the host's estimate of a clock; in simulation it is held below 10 us (test/loop)
SLICE_S = 0.25


def true_clock(hz: float, off: float, t: np.ndarray | float) -> Any:
    """Ticks at a true time: off from the start, and warming up for a minute or so."""
    return hz * (
        (1.0 + off) * np.asarray(t) + 8e-6 * 20.0 / math.tau * (1 - np.cos(math.tau * np.asarray(t) / 20.0))
    )


@pytest.mark.parametrize("count", [2, 3])
def test_boards_with_wandering_clocks_step_together(count: int) -> None:
    """One axis driven from each board; the host fits a new line through each clock every quarter of a second, wrong
    by 5 us. Read in true time, steps of all boards keep to the path and to each other."""
    rng = np.random.default_rng(count)
    moves, place, time = [], 0.0, 1.0
    for _ in range(40):
        moves.append(from_rest(time, place, float(rng.normal(0, 40)), float(rng.uniform(5, 250)), 3000.0))
        place, time = moves[-1].end, moves[-1].end_time + float(rng.choice([0.0, 0.02, 0.4]))
    traces = []
    for hz, off in list(CRYSTALS.items())[:count]:
        stepper = CStepper(0.0125, clock_hz=hz)
        stepper.open()
        for move in moves:
            move.append(stepper.trapq)
        for until in np.arange(SLICE_S, time + 1.0, SLICE_S):
            now = until + rng.uniform(-ESTIMATE_ERROR_S, ESTIMATE_ERROR_S)
            slope = (true_clock(hz, off, until + 1e-3) - true_clock(hz, off, until - 1e-3)) / 2e-3
            LIB.steppersync_set_time(stepper.sync, now - float(true_clock(hz, off, until)) / slope, slope)
            stepper.run(float(until), float(until) - 0.05)
        stepper.run(time + 1.5)
        fine = np.linspace(0.0, time + 2.0, 200001)
        true = np.interp(np.array(stepper.trace.clocks), true_clock(hz, off, fine), fine)
        traces.append((true, np.array(stepper.trace.positions)))
    # a slice is up to 0.25 s from where its line touches the clock: 8e-6 * tau / 20 / s of bend
    bend_s = 0.5 * 8e-6 * math.tau / 20.0 * SLICE_S**2
    allowed = ESTIMATE_ERROR_S + bend_s + 1e-6
    for true, positions in traces:
        assert np.array_equal(positions, traces[0][1])
        edges = 0.0125 * 0.5 * (np.concatenate([[0], positions[:-1]]) + positions)
        way = np.sign(np.diff(positions, prepend=0))
        assert np.max(way * (path(moves, true - allowed) - edges)) <= 1e-6, "late"
        assert np.min(way * (path(moves, true + MAX_ERROR_S + allowed) - edges)) >= -1e-6, "early"
    apart = np.abs(traces[0][0] - traces[-1][0])
    assert apart.max() <= MAX_ERROR_S + 2 * allowed
    # 25 us of it is what compression may do; the rest is the clocks'
    assert abs(float(np.median(traces[0][0] - traces[-1][0]))) < 10e-6
