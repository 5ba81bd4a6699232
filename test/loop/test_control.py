"""The control laws in closed loop with the C plants: what the studies config/studies/control*.toml do not show.

Limits are the product's promises; docs/theory/Control.md has what is measured.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import hotend_bench as hotend
import peers
from induction_rig import PERIOD_S, Plant, Rig, default_parameters, true_law
from thermal.control.control_api import Reference, Schedule
from thermal.records import TempEstimate
from thermal.sensing.features import FeatureParameters


@pytest.mark.parametrize("peer", list(peers.PEERS))
def test_the_designs_the_field_ships_miss_what_ours_has_to_reach(peer: str) -> None:
    """The limits of strong_model in config/studies/control.toml, the true temperature and no link notwithstanding."""
    theirs = peers.run(peer, "strong")
    assert theirs.settle_ratio > 1.15
    assert max(theirs.overshoot_c, theirs.hold_c) > 3.0
    assert theirs.flow_steady_c > 0.1
    assert theirs.step_over_s > 0.1


def flow_deviation_c(planned: bool) -> float:
    rig = nozzle()
    start_s = rig.now_s + 0.25  # moves stand in the queue this long before they happen
    if planned:
        rig.loop.flow = Schedule((start_s,), (25.0,), 0.0)
    rig.run(0.25)
    rig.plant.set_inputs(25.0, 0.0)
    rig.run(1.0)
    trace = rig.trace.arrays()
    return float(np.abs(trace["skin_c"][trace["t_s"] > start_s] - 220.0).max())


def test_the_planned_flow_is_what_makes_the_difference_in_flow() -> None:
    planned, unplanned = flow_deviation_c(True), flow_deviation_c(False)
    assert planned < 0.5 * unplanned
    assert unplanned < 1.0  # 4.8 W unknown: 10 K/s until the filter has seen it


@pytest.mark.parametrize("plant", ["hotend", "hotend mass x0.8", "hotend sensor x1.3"])
def test_model_on_a_conventional_hotend(plant: str) -> None:
    r = hotend.run("model", plant)
    assert r.settle_ratio < 1.15
    assert r.overshoot_c < 1.0
    assert r.hold_c < 0.2
    assert r.flow_deviation_c < 0.6
    assert r.flow_steady_c < 0.1


def test_model_beats_pid_on_the_hotend() -> None:
    ours, theirs = hotend.run("model", "hotend"), hotend.run("pid", "hotend")
    for figure in ("settle_s", "overshoot_c", "hold_c", "flow_deviation_c", "flow_steady_c"):
        assert getattr(ours, figure) < getattr(theirs, figure), figure


def nozzle(seed: int = 4, **plant: float) -> Rig:
    rig = Rig(Plant(seed, **plant), default_parameters(law=true_law()), seed)
    rig.run(0.6)
    rig.set_target(220.0)
    rig.run(2.5)
    return rig


def test_a_reference_known_ahead_is_met_on_time() -> None:
    rig = nozzle()
    start_s = rig.now_s
    corners = [(0.0, 220.0), (0.5, 220.0), (0.8, 250.0), (1.3, 250.0), (3.3, 235.0), (4.0, 235.0)]
    points = [(start_s + t, c) for t, c in corners]
    rig.loop.set_reference(points, rig.now_s)
    rig.run(4.0)
    trace = rig.trace.arrays()
    select = trace["t_s"] > start_s
    plan = Reference.of(points)
    wanted = np.array([plan.at(t) for t in trace["t_s"][select]])
    # 100 K/s up and 7.5 K/s down are within the nozzle's power; a lag of 10 ms on the way up would be 1 degC
    assert np.abs(trace["skin_c"][select] - wanted).max() < 1.0
    assert rig.loop.state.target_c == pytest.approx(235.0)


def test_an_empty_plan_and_a_new_target_end_the_reference() -> None:
    rig = nozzle()
    rig.loop.set_reference([(rig.now_s, 220.0), (rig.now_s + 5.0, 260.0)], rig.now_s)
    rig.run(0.5)
    rig.loop.set_reference([], rig.now_s)
    target_c = rig.loop.state.target_c
    rig.run(0.5)
    assert 220.0 < target_c < 230.0
    assert rig.loop.state.target_c == target_c
    rig.loop.set_reference([(rig.now_s, 220.0), (rig.now_s + 5.0, 260.0)], rig.now_s)
    rig.set_target(240.0)
    rig.run(1.0)
    assert rig.loop.state.target_c == 240.0


def test_a_plan_does_not_turn_a_heater_on_that_is_off() -> None:
    rig = Rig(Plant(4), default_parameters(law=true_law()), 4)
    rig.run(0.6)
    rig.loop.set_reference([(rig.now_s, 220.0), (rig.now_s + 5.0, 260.0)], rig.now_s)
    rig.run(1.0)
    assert rig.loop.state.target_c == 0.0
    assert rig.plant.read().skin_c < 25.0


def test_a_silent_host_is_carried_through_by_the_plan_it_sent() -> None:
    """The host stops in the middle of the climb: the MCU goes on as commanded and does not run through the target."""
    rig = nozzle()
    rig.set_target(250.0)
    rig.run(0.10)  # about 235 degC at full power, 14 ms of it decided
    rig._host = lambda: None  # type: ignore[method-assign]
    rig.run(0.12)
    trace = rig.trace.arrays()
    assert abs(rig.plant.read().skin_c - 250.0) < 3.0
    assert trace["phase"][-1] < 20000  # holding power, not full


def test_a_drifted_thermometer_neither_runs_away_nor_hunts() -> None:
    """C1 +0.1 %: the law is off by 16 degC at little drive and by 44 at full; full power must not call for more."""
    rig = nozzle()
    rig.plant.set_param("c1_factor", 1.001)
    rig.run(3.0)
    start_s = rig.now_s
    rig.run(2.0)
    trace = rig.trace.arrays()
    late = trace["skin_c"][trace["t_s"] > start_s]
    assert np.ptp(late) < 0.2  # measured: 0.07; 1.5 where the reading is trusted at any drive
    assert abs(late.mean() - 236.0) < 3.0  # off by what the thermometer is, not more
    assert trace["skin_c"].max() < 245.0


@pytest.mark.parametrize("sent_lsb", [0.0, 1.0])
def test_an_adc_without_noise_does_not_make_the_loop_hunt(sent_lsb: float) -> None:
    """A code is 1.25 degC wide and says the same from one end to the other: trusted to 0.1 it rippled by 2.4."""
    front = FeatureParameters(noise_lsb=sent_lsb)
    rig = Rig(Plant(5, noise_lsb=0.0), default_parameters(law=true_law(), front=front), 5)
    rig.run(0.6)
    rig.set_target(250.0)
    rig.run(3.0)
    skin = np.asarray(rig.trace.skin_c[-round(1.0 / 32 / PERIOD_S) :])
    assert np.ptp(skin) < 1.2  # measured: 0.4 to 1.0 in a second, over seeds
    assert np.abs(skin - 250.0).max() < 0.9


@pytest.mark.parametrize("control", ["pid", "model"])
def test_both_laws_hold_an_uncalibrated_nozzle(control: str) -> None:
    rig = Rig(Plant(3), default_parameters(control=control), 5)
    rig.run(0.6)
    rig.set_target(250.0)
    rig.run(3.0)
    skin = rig.trace.arrays()["skin_c"]
    assert abs(skin[-1] - 250.0) < 3.0
    assert skin.max() < 253.0
    assert not math.isnan(rig.loop.state.request.power_w)


def held_by(law: str, flow_mm3_s: float, until_s: float) -> Rig:
    """The reference nozzle under this law with the target 250 degC, filament running from the start."""
    plant = Plant(1)
    rig = Rig(plant, default_parameters(law=true_law(), control=law))
    plant.set_inputs(flow_mm3_s, 0.0)
    rig.set_target(250.0)
    rig.run(until_s)
    return rig


def swapped(rig: Rig, law: str, for_s: float) -> np.ndarray:
    """True degC above 250 after the swap."""
    start = len(rig.trace.t_s)
    rig.loop.use(default_parameters(law=true_law(), control=law))
    rig.run(for_s)
    return np.asarray(rig.trace.skin_c[start:]) - 250.0


@pytest.mark.parametrize("flow_mm3_s", [0.0, 10.0])
@pytest.mark.parametrize(("before", "after"), [("model", "pid"), ("pid", "model")])
def test_a_law_takes_over_at_temperature_without_a_bump(before: str, after: str, flow_mm3_s: float) -> None:
    """Measured: 0.07 to 0.29 degC; a law that begins without memory makes 0.4 to 1.2."""
    rig = held_by(before, flow_mm3_s, 4.0)
    assert np.abs(swapped(rig, after, 1.0)).max() < 0.35


def test_a_model_takes_over_from_a_swing_and_ends_it() -> None:
    rig = held_by("watermark", 10.0, 4.0)
    off_c = swapped(rig, "model", 1.0)
    assert np.abs(off_c).max() < 7.0  # no farther than the watermark's own swing
    assert np.abs(off_c[len(off_c) // 2 :]).max() < 0.3


@pytest.mark.parametrize(("before", "after", "over_c"), [("pid", "model", 1.0), ("model", "pid", 2.0)])
def test_a_law_takes_over_in_the_climb(before: str, after: str, over_c: float) -> None:
    """The limits are those of the laws alone: 0.05 and 1.1 degC on this plant, with the product's margin."""
    rig = held_by(before, 0.0, 0.7)
    assert 100.0 < rig.trace.skin_c[-1] < 200.0
    off_c = swapped(rig, after, 2.5)
    assert off_c.max() < over_c
    assert np.abs(off_c[-1000:]).max() < 0.5


@pytest.mark.parametrize("preset", ["reference", "strong"])
def test_looks_out_of_a_hold_come_in_turn_and_hardly_move_the_temperature(preset: str) -> None:
    power_w, looks = peers.POWER_W[preset], (45000, 31820)
    parameters = default_parameters(law=true_law(), power_full_w=power_w)
    actuator = replace(parameters.actuator, hold_look_s=0.25, hold_look_ticks=looks)
    rig = Rig(Plant(4, preset), replace(parameters, actuator=actuator), 4)
    seen: list[int] = []
    rig.loop.listeners.append(lambda block, *_: seen.append(block.phase_ticks))
    rig.run(2.0)
    assert not set(seen) & set(looks)  # an idle nozzle is to be read at rest
    rig.set_target(220.0)
    rig.run(3.0)
    seen.clear()
    begin_s = rig.now_s
    rig.run(3.0)
    held = [phase for phase in seen if phase in looks]
    assert len(held) == pytest.approx(12, abs=1)
    assert set(held) == set(looks)
    trace = rig.trace.arrays()
    assert np.abs(trace["skin_c"][trace["t_s"] > begin_s] - 220.0).max() < 0.3
    assert not rig.loop.fault


def test_what_follows_the_heat_balance_and_fails_is_left_out_and_the_nozzle_is_held() -> None:
    rig = Rig(Plant(4), default_parameters(law=true_law()), 4)
    calls: list[float] = []
    problems: list[Exception] = []

    def fails(news: TempEstimate, heat_j: float) -> None:
        calls.append(news.time_s)
        raise ValueError("of the monitor")

    rig.loop.on_balance = fails
    rig.loop.on_listener_error = problems.append
    rig.set_target(220.0)
    rig.run(3.0)
    assert len(calls) == 1 and [str(problem) for problem in problems] == ["of the monitor"]
    assert rig.loop.state.estimate.temp_c == pytest.approx(220.0, abs=1.0)
    assert not rig.loop.fault
