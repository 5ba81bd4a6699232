"""Input shaping: pulses that cancel the ringing, and steps that follow the sum of shifted copies."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_motion_kinematics import MACHINES, Polyline, follow, random_path

from extras.input_shaper import make_axis
from motion_rig import CONFIG, FFI, LIB, MAX_ERROR_S, CStepper, batch
from vibration.shapers import SHAPERS, parse

TICK_S = 1.0 / 72e6
DATA = Path(__file__).resolve().parents[2] / "data"


def _recorded() -> list[dict[str, Any]]:
    """Impulses of stock Klipper's running host (August 2026), times in shaper periods; t 0: default."""
    cases: list[dict[str, Any]] = json.loads((DATA / "shaper_impulses.json").read_text())["impulses"]
    return cases


@pytest.mark.parametrize("kind", SHAPERS)
def test_impulses_are_those_of_the_peer(kind: str) -> None:
    cases = [case for case in _recorded() if case["shaper"] == kind]
    assert len(cases) >= 10
    for case in cases:
        named = [f"{name}={case[name]}" for name in ("n", "t", "v_tol") if case.get(name)]
        shaper = parse(f"{kind}({', '.join(named)})")
        amplitudes, times = shaper.pulses(1.0, case["damping_ratio"])
        assert amplitudes == pytest.approx(case["A"], abs=1e-6)
        assert times == pytest.approx(case["T"], abs=1e-6)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("mzv", "mzv(3, 0.75)"),
        ("MZV( n = 4 )", "mzv(4)"),
        ("mzv(5,t=0.6)", "mzv(t=0.6,n=5)"),
        ("ei()", "ei(0.05)"),
    ],
)
def test_a_type_may_carry_parameters_by_place_or_name(text: str, same: str) -> None:
    assert parse(text).arguments == parse(same).arguments
    assert parse(text).kind is parse(same).kind


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("box", "types are zv, mzv"),
        ("zv(1)", "zv has none"),
        ("mzv(2)", "n must be a whole number from 3 to 8"),
        ("mzv(3.5)", "n must be a whole number"),
        ("mzv(t=nan)", "t must be a number from 0.5 to 1"),
        ("ei(tol=0.1)", r"unknown parameter 'tol'; ei has v_tol"),
        ("ei(0.05", "is not a shaper type"),
    ],
)
def test_a_wrong_type_is_refused_with_what_would_be_right(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(text)


@pytest.mark.parametrize("kind", SHAPERS)
def test_pulses_sum_to_one_around_their_mean(kind: str) -> None:
    weights, delays = make_axis("x", kind, 50.0, 0.1).pulses()
    assert sum(weights) == pytest.approx(1.0)
    assert sum(w * t for w, t in zip(weights, delays, strict=True)) == pytest.approx(0.0, abs=1e-12)
    assert delays == sorted(delays)


# EI shapers leave 5 % by design, damping adds a little; MZV trades a clean zero for a shorter row
LEFT_OVER = {"zv": 0.001, "mzv": 0.01, "zvd": 0.001, "ei": 0.06, "2hump_ei": 0.06, "3hump_ei": 0.06}


@pytest.mark.parametrize(("kind", "left"), LEFT_OVER.items())
def test_ringing_at_the_design_frequency_is_gone(kind: str, left: float) -> None:
    """What rings on after the pulses."""
    f, z = 40.0, 0.1
    weights, delays = make_axis("x", kind, f, z).pulses()
    omega, end = 2 * math.pi * f, delays[-1]
    damped = omega * math.sqrt(1 - z * z)
    vector = sum(
        w * np.exp(-z * omega * (end - t)) * np.exp(1j * damped * t)
        for w, t in zip(weights, delays, strict=True)
    )
    assert abs(vector) <= left


@pytest.mark.parametrize("machine", ["corexy+", "delta"])
@pytest.mark.parametrize("kind", ["zv", "mzv", "mzv(8)", "3hump_ei"])
def test_steps_follow_the_shaped_path(machine: str, kind: str) -> None:
    alloc, position, step_dist = MACHINES[machine]
    line: Polyline = random_path(5, 20)
    stepper = CStepper(step_dist, solver=alloc())
    pulses = {axis: make_axis(axis, kind, f, 0.1).pulses() for axis, f in (("x", 55.0), ("y", 38.0))}
    for axis, (weights, delays) in pulses.items():
        assert (
            LIB.itersolve_set_shaper(
                stepper.sk,
                axis.encode(),
                len(weights),
                FFI.new("double[]", weights),
                FFI.new("double[]", delays),
            )
            == 0
        )
    reach = max(abs(d) for _, delays in pulses.values() for d in delays)
    assert LIB.itersolve_look_ahead(stepper.sk) == pytest.approx(reach)
    follow(stepper, line)

    def shaped(t: np.ndarray) -> np.ndarray:
        xyz = line.at(t)
        for number, axis in enumerate("xy"):
            xyz[:, number] = sum(w * line.at(t - d)[:, number] for w, d in zip(*pulses[axis], strict=True))
        return position(xyz)

    t = stepper.step_times()
    after = np.array(stepper.trace.positions)
    before = np.concatenate([[0], after[:-1]])
    ends = position(line.points[[0, -1]])
    edges = ends[0] + 0.5 * (before + after) * step_dist
    forward = np.sign(after - before)
    slack = 1e-4 * step_dist
    assert np.max(forward * (shaped(t - TICK_S) - edges)) <= slack, "late"
    assert np.min(forward * (shaped(t + MAX_ERROR_S + TICK_S) - edges)) >= -slack, "early"
    assert abs(ends[0] + stepper.trace.position * step_dist - ends[1]) <= 0.5 * step_dist + slack


SHAPED = CONFIG + "[input_shaper]\nshaper_freq_x: 50\nshaper_freq_y: 40\n"


def test_a_print_ends_where_it_would_without_shaping(tmp_path: Path) -> None:
    gcode = "G28\nG1 X10 Y100 F6000\nG1 X60\nG1 Y50\nM400\nG1 X20 Y20\nG4 P100\nG1 X30\nM400\n"
    plain, shaped = batch(tmp_path, gcode), batch(tmp_path, gcode, SHAPED)
    assert plain.result == shaped.result == "exit", shaped.replies
    for name in ("stepper_x", "stepper_y", "stepper_z"):
        assert plain.traces()[name].position == shaped.traces()[name].position
        clocks = np.diff(shaped.traces()[name].clocks)
        # no burst: 1000 mm/s at 80 steps/mm would be 12.5 us
        assert clocks.min() > 72 * 12.5


def test_the_command_reports_and_refuses(tmp_path: Path) -> None:
    outcome = batch(tmp_path, "SET_INPUT_SHAPER SHAPER_FREQ_X=61.5 SHAPER_TYPE_X=ei\n", SHAPED)
    assert any("shaper_type_x:ei shaper_freq_x:61.500" in r for r in outcome.replies)
    outcome = batch(tmp_path, "SET_INPUT_SHAPER SHAPER_TYPE=foo\n", SHAPED)
    assert outcome.result == "error_exit"
    assert any("'foo' is not a shaper type" in r for r in outcome.replies)
