"""Predictive control by itself: its plant model, its filter, its choice; on plants of the test's own."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import pytest

from thermal.control import predictive_filter
from thermal.control.control_api import ControlInput, Reference, Schedule
from thermal.control.predictive import MODEL, model_step
from thermal.models import heater_model
from thermal.models.heater_model import ModelParameters, advance, at_rest, hold_w
from thermal.records import ParameterError, Planned, Sample

BLOCK = ModelParameters(
    heat_j_k=15.0, loss_w_k=0.07, output_w=40.0, output_high=1.0, ambient_c=20.0, melt_ua_w_k=0.06
)
NOZZLE = ModelParameters(
    heat_j_k=0.414,
    heat_slope_per_k=4.5e-4,
    loss_w_k=0.00716,
    radiation_m2=1e-4,
    ambient_c=20.0,
    second_j_k=0.572,
    link_w_k=0.0411,
    second_loss_w_k=0.016,
    output_w=1.0,
    output_high=81.3,
    melt_ua_w_k=0.0276,
    bore_s=0.049,
    hold_s=0.008,
    tau_s=0.03,
    ahead=7,
)


@pytest.mark.parametrize("p", [BLOCK, NOZZLE])
def test_the_power_that_holds_a_temperature_holds_it(p: ModelParameters) -> None:
    nodes = at_rest(p, 200.0)
    drive = hold_w(p, 200.0, 0.0, 0.0) / p.output_w, 1.0, 0.0
    assert advance(p, nodes, drive, (0.0, 0.0), 100.0).temp_c == pytest.approx(200.0, abs=0.01)


def test_static_losses_are_the_reference_nozzles() -> None:
    # Oskolkov 2021: 3.9 / 4.7 / 11.0 W, published with two digits
    for temp_c, watts in ((212.0, 3.9), (250.0, 4.7), (500.0, 11.0)):
        assert hold_w(NOZZLE, temp_c, 0.0, 0.0) == pytest.approx(watts, rel=0.03)


def test_one_node_follows_the_exact_exponential() -> None:
    p = replace(BLOCK, melt_ua_w_k=0.0)
    nodes = advance(p, at_rest(p, 20.0), (0.5, 1.0, 0.0), (0.0, 0.0), 60.0)
    rise = 20.0 / 0.07 * (1.0 - math.exp(-60.0 * 0.07 / 15.0))
    assert nodes.temp_c == pytest.approx(20.0 + rise, rel=2e-3)  # Euler steps of 0.25 s


@pytest.mark.parametrize(
    "change",
    [
        {"heat_j_k": 0.0},
        {"heat_j_k": -1.0},
        {"heat_j_k": math.nan},
        {"loss_w_k": -0.1},
        {"loss_w_k": 0.0},
        {"output_w": 0.0},
        {"sensor_s": -1.0},
        {"second_j_k": 1.0},
        {"element_w_k": 0.5},
        {"heat_slope_per_k": 1.0},
        {"ambient_c": 500.0},
        {"slew_per_s": 0.0},
    ],
    ids=lambda c: next(iter(c)),
)
def test_impossible_parameters_are_refused_in_words(change: dict[str, float]) -> None:
    with pytest.raises(ParameterError, match=r"^model: "):
        replace(BLOCK, **change)


class Truth:
    """A plant of the model's kind with other parameters, measured without noise every `dt_s`."""

    def __init__(self, p: ModelParameters, temp_c: float, dt_s: float) -> None:
        self.p, self.dt_s, self.now_s = p, dt_s, 0.0
        self.nodes = at_rest(p, temp_c)
        self.disturbance_w = 0.0

    def sample(self, output: float) -> Sample:
        self.nodes = advance(self.p, self.nodes, (output, 1.0, self.disturbance_w), (0.0, 0.0), self.dt_s)
        self.now_s += self.dt_s
        return Sample(self.now_s, self.now_s, self.nodes.sensor_c, 0.05, output)


def test_the_filter_reports_a_weak_drive_from_a_draught() -> None:
    """30 % less heat shows while heating, 3 W taken away shows while holding: each is learned as what it is."""
    weak = Truth(replace(NOZZLE, output_w=0.7), 25.0, 0.005)
    state = predictive_filter.begin(NOZZLE, 25.0, 0.0)
    for _ in range(200):
        state = predictive_filter.observe(NOZZLE, state, [weak.sample(81.3)])
    assert state.gain == pytest.approx(0.7, abs=0.03)
    draught = Truth(NOZZLE, 25.0, 0.005)
    state = predictive_filter.begin(NOZZLE, 25.0, 0.0)
    for _ in range(200):
        state = predictive_filter.observe(NOZZLE, state, [draught.sample(81.3)])
    draught.disturbance_w = -3.0
    for _ in range(200):
        state = predictive_filter.observe(NOZZLE, state, [draught.sample(13.0)])
    assert state.disturbance_w == pytest.approx(-3.0, abs=0.7)  # 3 % of the gain is worth 0.4 W
    assert state.gain == pytest.approx(1.0, abs=0.05)


def test_readings_that_lean_one_way_move_the_disturbance_and_noise_does_not() -> None:
    """An unknown disturbance of 3 W: a walk of 0.3 W in a second alone would take most of a second for it."""
    p, noise = replace(NOZZLE, disturbance_w=0.3), random.Random(1)
    truth = Truth(p, 250.0, 0.005)
    state = predictive_filter.taken_over(p, predictive_filter.begin(p, 250.0, 0.0), 0.0)
    held_w = hold_w(p, 250.0, 0.0, 0.0)

    def run(messages: int) -> None:
        nonlocal state
        for _ in range(messages):
            seen = truth.sample(held_w)
            state = predictive_filter.observe(
                p, state, [seen._replace(temp_c=seen.temp_c + noise.gauss(0.0, 0.05))]
            )

    run(400)
    assert abs(state.disturbance_w) < 0.5
    truth.disturbance_w = -3.0
    run(40)
    assert state.disturbance_w == pytest.approx(-3.0, abs=0.6)  # within 0.2 s


def test_a_lagging_sensor_is_looked_through() -> None:
    p = replace(BLOCK, sensor_s=1.5, sigma_c=0.05)
    truth = Truth(p, 25.0, 0.3)
    state = predictive_filter.begin(p, 25.0, 0.0)
    for _ in range(60):
        state = predictive_filter.observe(p, state, [truth.sample(1.0)])
    # 2.5 K/s through 1.5 s of lag: the reading is 3.7 degC behind
    assert truth.nodes.temp_c - truth.nodes.sensor_c > 3.0
    assert state.nodes.temp_c == pytest.approx(truth.nodes.temp_c, abs=0.2)


def test_blocks_of_one_message_count_as_their_mean() -> None:
    state = predictive_filter.begin(NOZZLE, 250.0, 0.0)
    apart = [Sample(0.001 * i, 0.001 * i, 250.0 + 0.1 * i, 0.09, 5.0) for i in range(1, 4)]
    one = [Sample(0.002, 0.003, 250.2, 0.09 / math.sqrt(3.0), 5.0)]
    a, b = predictive_filter.observe(NOZZLE, state, apart), predictive_filter.observe(NOZZLE, state, one)
    assert a.nodes.temp_c == pytest.approx(b.nodes.temp_c, abs=1e-6)
    assert a.disturbance_w == pytest.approx(b.disturbance_w, abs=1e-6)


def test_a_jump_no_heat_can_make_moves_the_temperature_and_teaches_nothing() -> None:
    state = predictive_filter.begin(NOZZLE, 250.0, 0.0)
    after = predictive_filter.observe(NOZZLE, state, [Sample(0.005, 0.005, 230.0, 0.05, 5.0)])
    assert after.nodes.temp_c == pytest.approx(230.0, abs=0.5)
    assert (after.disturbance_w, after.gain) == pytest.approx((0.0, 1.0), abs=0.05)


def test_a_step_of_the_reading_with_the_drive_is_taken_out_until_the_drive_falls() -> None:
    state = predictive_filter.begin(NOZZLE, 250.0, 0.0)
    state = predictive_filter.observe(NOZZLE, state, [Sample(0.005, 0.005, 250.0, 0.1, 5.0)])
    state = predictive_filter.observe(NOZZLE, state, [Sample(0.010, 0.010, 222.0, 0.1, 81.3, rebased=True)])
    assert state.nodes.temp_c == pytest.approx(250.8, abs=0.5)
    state = predictive_filter.observe(NOZZLE, state, [Sample(0.015, 0.015, 251.0, 0.1, 5.0, rebased=True)])
    assert state.nodes.temp_c == pytest.approx(251.0, abs=0.5)


def known(temp_c: float) -> predictive_filter.ModelState:
    return predictive_filter.begin(NOZZLE, temp_c, 10.0)


def ask(temp_c: float, target_c: float, **fields: object) -> ControlInput:
    del temp_c
    return ControlInput(target_c, math.nan, applied=5.0, apply_s=10.02, pending=(), **fields)  # type: ignore[arg-type]


def test_far_below_it_is_full_power_far_above_none() -> None:
    assert model_step(NOZZLE, known(100.0), ask(100.0, 250.0), 10.0)[0].value == 81.3
    assert model_step(NOZZLE, known(250.0), ask(250.0, 200.0), 10.0)[0].value == 0.0


def test_limits_are_met_exactly() -> None:
    output, _ = model_step(NOZZLE, known(100.0), ask(100.0, 250.0, limit=30.0), 10.0)
    assert output.value == 30.0
    assert all(planned.value <= 30.0 for planned in output.horizon)
    slow = replace(NOZZLE, slew_per_s=1000.0)
    state = MODEL.follow(slow, known(100.0), ask(100.0, 250.0), 5.0)
    output, _ = model_step(slow, state, ask(100.0, 250.0), 10.0)
    assert output.value == pytest.approx(5.0 + 1000.0 * NOZZLE.hold_s)
    before, before_s = output.value, 10.02
    for planned in output.horizon[:-1]:
        assert planned.value - before <= 1000.0 * (planned.time_s - before_s) + 1e-6
        before, before_s = planned.value, planned.time_s


def test_a_plan_made_in_the_climb_ends_at_holding_power() -> None:
    output, _ = model_step(NOZZLE, known(243.0), ask(243.0, 250.0), 10.0)
    assert output.value == 81.3
    times = [planned.time_s for planned in output.horizon]
    assert times == sorted(times)
    assert times[0] > 10.02
    assert output.horizon[-1].value < 15.0


def test_what_is_pending_is_counted_on() -> None:
    """Full power already on its way for 20 ms is 3.5 degC: less is asked for on top of it."""
    without, _ = model_step(NOZZLE, known(245.0), ask(245.0, 250.0), 10.0)
    sent = ask(245.0, 250.0)._replace(pending=(Planned(10.0, 81.3),))
    after, _ = model_step(NOZZLE, known(245.0), sent, 10.0)
    assert after.value < without.value
    assert after.predicted_c > without.predicted_c + 3.0


def test_flow_to_come_is_fed_forward() -> None:
    still, _ = model_step(NOZZLE, known(250.0), ask(250.0, 250.0), 10.0)
    flow = Schedule((10.02,), (13.0,))  # with the output
    flowing, _ = model_step(NOZZLE, known(250.0), ask(250.0, 250.0, flow_mm3_s=flow), 10.0)
    melt_w = heater_model.melt_w_k(NOZZLE, 13.0) * 225.0
    assert flowing.value - still.value == pytest.approx(melt_w, rel=0.2)


def stepped_on_time(flow: Schedule, temp_c: float, apply_s: float) -> list[Planned]:
    """What the law says stride by stride if it is asked anew at each, the plant being its model."""
    state, said, h = known(temp_c), [], NOZZLE.hold_s
    nodes = advance(NOZZLE, state.nodes, (5.0, 1.0, 0.0), (0.0, 0.0), apply_s - 10.0)
    for i in range(NOZZLE.ahead + 1):
        at_s = apply_s + i * h
        state = state.replaced(time_s=at_s, nodes=nodes)
        inputs = ControlInput(250.0, math.nan, applied=5.0, apply_s=at_s, pending=(), flow_mm3_s=flow)
        seen = (Sample(at_s, at_s, math.nan, 0.0, 5.0),)
        output, _ = model_step(NOZZLE, state, inputs._replace(samples=seen), at_s)
        said.append(Planned(at_s, output.value))
        surroundings = flow.at(at_s + 0.5 * h), 0.0
        nodes = advance(NOZZLE, nodes, (output.value, 1.0, 0.0), surroundings, h)
    return said


@pytest.mark.parametrize("temp_c", [249.0, 250.0, 250.1])
@pytest.mark.parametrize("flow_s", [10.021, 10.043])
def test_the_plan_is_what_a_host_on_time_would_say(temp_c: float, flow_s: float) -> None:
    flow = Schedule((flow_s,), (25.0,))
    asked = ask(temp_c, 250.0, flow_mm3_s=flow)
    output, _ = model_step(NOZZLE, known(temp_c), asked, 10.0)
    plan = Schedule(
        tuple(planned.time_s for planned in output.horizon),
        tuple(planned.value for planned in output.horizon),
        output.value,
    )
    on_time = stepped_on_time(flow, temp_c, 10.02)
    sent_j = sum(plan.at(said.time_s + 1e-4) * NOZZLE.hold_s for said in on_time)
    asked_j = sum(said.value * NOZZLE.hold_s for said in on_time)
    assert sent_j == pytest.approx(asked_j, abs=0.02)  # 0.05 degC of this nozzle
    for said in on_time[:6]:
        assert plan.at(said.time_s + 1e-4) == pytest.approx(said.value, abs=0.02 * 81.3)


def test_flow_that_begins_within_the_plan_is_in_it_and_later_flow_makes_none() -> None:
    end_s = 10.02 + (NOZZLE.ahead + 1) * NOZZLE.hold_s
    soon, _ = model_step(
        NOZZLE, known(250.0), ask(250.0, 250.0, flow_mm3_s=Schedule((end_s - 0.02,), (25.0,))), 10.0
    )
    assert soon.horizon and soon.horizon[-1].value > soon.value + 1.0
    later, _ = model_step(
        NOZZLE, known(250.0), ask(250.0, 250.0, flow_mm3_s=Schedule((end_s + 0.01,), (25.0,))), 10.0
    )
    assert not later.horizon
    blip = Schedule((10.04, 10.06), (25.0, 0.0))  # the same before and after
    within, _ = model_step(NOZZLE, known(250.0), ask(250.0, 250.0, flow_mm3_s=blip), 10.0)
    assert within.horizon


def test_a_plan_fits_one_message() -> None:
    """Ten steps, the first output among them, with the product's own 90 ms."""
    p = replace(NOZZLE, ahead=11, tau_s=0.045)
    flow = Schedule(tuple(10.0 + 0.005 * i for i in range(40)), tuple(25.0 * (i % 3) for i in range(40)))
    for temp_c in (230.0, 243.0, 249.0, 250.0, 251.0):
        output, _ = model_step(p, known(temp_c), ask(temp_c, 250.0, flow_mm3_s=flow), 10.0)
        assert 1 + len(output.horizon) <= 10


def test_a_ramp_ahead_is_begun_in_time() -> None:
    ramp = Reference.of([(0.0, 250.0), (10.022, 250.0), (10.122, 260.0)])
    output, _ = model_step(NOZZLE, known(250.0), ask(250.0, 250.0, reference=ramp), 10.0)
    assert output.value > 30.0  # 100 K/s of 0.46 J/K are 46 W


def test_off_is_off_and_nothing_known_is_off() -> None:
    assert model_step(NOZZLE, known(250.0), ask(250.0, 0.0), 10.0)[0].value == 0.0
    nothing, state = model_step(NOZZLE, MODEL.start, ask(0.0, 250.0), 10.0)
    assert nothing.value == 0.0
    assert not state.known


def test_alone_it_remembers_its_own_outputs() -> None:
    """As an ordinary heater calls it: a reading and a time; delays are its own affair."""
    p = replace(BLOCK, delay_s=0.6, sensor_s=1.5, sigma_c=0.05, horizon_s=2.0, tau_s=2.0)
    truth = Truth(replace(p, heat_j_k=18.0), 20.0, 0.3)
    duties = [0.0, 0.0]
    state, temps = MODEL.start, []
    for _ in range(800):
        seen = truth.sample(duties.pop(0))
        output, state = MODEL.step(p, state, ControlInput(200.0, seen.temp_c), seen.time_s)
        assert 0.0 <= output.value <= 1.0
        duties.append(output.value)
        temps.append(truth.nodes.temp_c)
    assert max(temps) < 201.0
    assert temps[-1] == pytest.approx(200.0, abs=0.05)


def test_a_reference_out_of_order_is_refused() -> None:
    with pytest.raises(ParameterError, match="order"):
        Reference.of([(1.0, 200.0), (0.0, 210.0)])
