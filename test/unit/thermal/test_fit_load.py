"""The fit behind MODEL_CALIBRATE: numbers and their doubt from a run on a heater made here, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from thermal.identification import fit_load, step_test
from thermal.models.heater_model import ModelParameters, advance, at_rest, stepped

POWER_W, AMBIENT_C = 40.0, 22.0
READ_S, NOISE_C = 0.3, 0.03


def hotend(mass: float = 1.0, loss: float = 1.0, lag: float = 1.0, element: float = 0.2) -> ModelParameters:
    heat = 17.0 * mass
    return ModelParameters(
        heat_j_k=heat * (1.0 - element),
        loss_w_k=0.07 * loss,
        output_w=POWER_W,
        output_high=1.0,
        ambient_c=AMBIENT_C,
        element_j_k=heat * element,
        element_w_k=heat * element * (1.0 - element) / (3.0 * lag),
        sensor_s=1.5 * lag,
        fan_w_k=0.03 * loss,
    )


def recording(true: ModelParameters, seed: int = 1, flow: float = 0.0) -> list[step_test.Row]:
    """A run of MODEL_CALIBRATE on this heater, with noise."""
    rng = np.random.default_rng(seed)
    plan = step_test.StepTestPlan(200.0, 1.0, 2.0, 0.0, hold_s=40.0, cool_s=40.0, coast_s=30.0, fan_s=30.0,
                           flow_s=30.0 if flow else 0.0, flow_mm3_s=flow)  # fmt: skip
    fine = stepped(true, 0.02)  # nature does not step
    run, nodes, output = step_test.StepTest(plan, AMBIENT_C), at_rest(true, AMBIENT_C), 0.0
    for i in range(20000):
        output = run.decide(i * READ_S, nodes.sensor_c + rng.normal(0.0, NOISE_C))
        if run.over:
            break
        nodes = advance(fine, nodes, (output, 1.0, 0.0), (run.flow_mm3_s, run.fan), READ_S)
    assert run.stage == "done", run.fault
    return run.rows


def all_heat(p: ModelParameters) -> float:
    return p.heat_j_k + p.element_j_k


@pytest.mark.parametrize(("mass", "loss", "lag"), [(1.0, 1.0, 1.0), (1.3, 0.7, 0.75), (0.7, 1.3, 1.3)])
def test_a_heater_of_the_models_kind_is_found_within_three_sigma(
    mass: float, loss: float, lag: float
) -> None:
    true = hotend(mass, loss, lag)
    fit = fit_load.fit_rows(recording(true), POWER_W, AMBIENT_C, is_nozzle=False)
    expected = {
        "model_heat_j_per_k": all_heat(true),
        "model_loss_w_per_k": true.loss_w_k,
        "model_fan_w_per_k": true.fan_w_k,
    }
    for name, value in expected.items():
        assert abs(fit.values[name] - value) < 3.0 * fit.sigma[name], name
        assert fit.sigma[name] < 0.02 * value, name


def test_a_heater_that_is_not_its_model_gets_a_wider_doubt() -> None:
    """A slow second mass behind the block is nothing the two lags can be: parts of the run want other losses."""
    sigmas = [
        fit_load.fit_rows(recording(p), POWER_W, AMBIENT_C, is_nozzle=False).sigma["model_loss_w_per_k"]
        for p in (hotend(), replace(hotend(), second_j_k=1.0, link_w_k=0.02))
    ]
    assert sigmas[1] > 5.0 * sigmas[0]


def test_what_is_printed_as_doubt_is_never_less_than_the_share_for_the_models_shape() -> None:
    fit = fit_load.fit_rows(recording(hotend()), POWER_W, AMBIENT_C, is_nozzle=False)
    for name, value in fit.values.items():
        assert fit.doubt(name) >= max(fit.sigma[name], fit_load.FORM_SHARE * value)
    heat = next(line for line in fit_load.report(fit) if "heat capacity" in line)
    assert float(heat.split("+-")[1]) == pytest.approx(fit.doubt("model_heat_j_per_k"), rel=0.05)


def test_a_number_the_run_does_not_determine_is_reported_as_unknown() -> None:
    rows = [row._replace(flow_mm3_s=1e-4 if row.stage == "hold" else 0.0) for row in recording(hotend())]
    rows = [row._replace(stage="flow") if row.flow_mm3_s else row for row in rows]
    fit = fit_load.fit_rows(rows, POWER_W, AMBIENT_C, is_nozzle=False)
    assert math.isinf(fit.sigma["model_melt_w_per_k"])
    assert "not determined by the run" in "\n".join(fit_load.report(fit))


def test_an_exchange_found_at_one_flow_is_in_doubt_by_its_assumptions() -> None:
    """Filament 5 % heavier and 3 degC warmer than taken as given: no effect at UA/cf of 5, much at 1."""
    true = replace(hotend(), melt_ua_w_k=0.053, melt_j_mm3_k=1.05 * 2.1e-3, melt_in_c=AMBIENT_C + 3.0)
    slow, fast = (
        fit_load.fit_rows(recording(true, flow=flow), POWER_W, AMBIENT_C, is_nozzle=False)
        for flow in (5.0, 25.0)
    )
    assert math.isinf(slow.sigma["model_melt_w_per_k"])
    assert abs(fast.values["model_melt_w_per_k"] - 0.053) < 3.0 * fast.sigma["model_melt_w_per_k"]
    assert 0.05 * 0.053 < fast.sigma["model_melt_w_per_k"] < 0.3 * 0.053


def test_a_model_that_misses_the_segment_it_was_not_shown_is_refused() -> None:
    """In the last pulse the room's door was open: four tenths of the heat go elsewhere."""
    rows = recording(hotend())
    assert fit_load.fit_rows(rows, POWER_W, AMBIENT_C, is_nozzle=False).validation_rms_c < 0.2
    first = next(i for i, row in enumerate(rows) if row.stage in fit_load.HELD_OUT)
    less = replace(hotend(), output_w=0.6 * POWER_W)
    missing = fit_load.predict(less, rows) - fit_load.predict(hotend(), rows)
    bent = [
        row._replace(temp_c=row.temp_c + missing[first + i] - missing[first])
        for i, row in enumerate(rows[first:])
    ]
    with pytest.raises(fit_load.LoadFitError, match=r"misses the segment it was not shown by .* C rms"):
        fit_load.fit_rows(rows[:first] + bent, POWER_W, AMBIENT_C, is_nozzle=False)


def test_a_wrong_power_scales_the_numbers() -> None:
    """Heat, loss and power only show as ratios: twice the power given is twice the heat found."""
    rows = recording(hotend())
    once, twice = (fit_load.fit_rows(rows, p, AMBIENT_C, is_nozzle=False) for p in (POWER_W, 2.0 * POWER_W))
    for name in ("model_heat_j_per_k", "model_loss_w_per_k"):
        assert twice.values[name] == pytest.approx(2.0 * once.values[name], rel=1e-3)


def test_a_run_that_was_cut_short_is_refused() -> None:
    rows = recording(hotend())
    with pytest.raises(fit_load.LoadFitError, match="too few readings"):
        fit_load.fit_rows(rows[:20], POWER_W, AMBIENT_C, is_nozzle=False)
