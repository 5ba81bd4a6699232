"""The sections "Numbers in the program" against the program: each row of their tables is made of its values."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import pytest

from doc_rig import Figures
from extras.induction import calibrate, mcu, settings
from heater_fakes import FakePrinter
from thermal.control import bridge_driver, loop, nozzle_model
from thermal.sensing import block_temperature, features, laws
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS


@cache
def options() -> tuple[Any, Any]:
    """(unit, parameters) of an [induction_heater] that has nothing but defaults."""
    config = FakePrinter("[induction_heater nozzle]\nsense_pin: PA0\nmax_temp: 320\n", {}).config(
        "induction_heater nozzle"
    )
    unit = settings.read_unit(config)
    return unit, settings.read_parameters(config, unit)


def ms(seconds: float) -> str:
    return f"{1e3 * seconds:.3g} ms"


def coefficient(value: float) -> str:
    """As in a text: 1.081e-4, with a true minus before it."""
    if abs(value) > 1e-3:
        return f"{value:g}"
    mantissa, _, exponent = f"{abs(value):.3e}".partition("e")
    return f"{'−' if value < 0.0 else ''}{mantissa}e{int(exponent)}"


def thermometer_rows() -> Iterator[str]:
    unit, p = options()
    exp, eq5, tank, heat = laws.ExpLaw(), laws.Eq5Law(), laws.TankLaw(), p.heat_balance
    span = block_temperature.EstimatorParameters(exp)
    settle_s = unit.settle_samples / unit.frequency_hz
    yield f"block | {unit.block_samples} samples, {ms(p.timing.block_s)}"
    yield f"settling after a phase step | {unit.settle_samples} samples, {1e3 * settle_s:.2f} ms"
    yield f"blocks in a message | {unit.records}"
    share = 100.0 * features.power_fraction(SENSING_PHASE_TICKS)
    yield f"smallest phase that measures | {SENSING_PHASE_TICKS} ticks, {share:.1f} % of full power"
    yield f"range of a valid temperature | −{-span.temp_low_c:g} °C to {span.temp_high_c:g} °C"
    yield f"coefficients of `exp` | a {exp.a}, b {exp.b}, c {exp.c}, d {exp.d}"
    names = {"A": eq5.a, "B": eq5.b, "AB": eq5.ab, "BB": eq5.bb, "ABB": eq5.abb, "C": eq5.c}
    listed = ", ".join(f"{name} {coefficient(value)}" for name, value in names.items())
    yield f"coefficients of `eq5` | {listed}"
    residuals = ", ".join(f"{law.residual_units:g}" for law in (exp, eq5, tank))
    yield f"residual of `exp`, `eq5`, `tank` on Table 1 | {residuals} units"
    yield f"noise needed at the ADC | {features.NOISE_NEEDED_LSB:g} LSB"
    yield f"spectral density of the unexplained heating rate | {p.filter.rate_noise:g} K²/s³"
    yield f"filter starts anew after a gap of | {p.filter.gap_s:g} s"
    yield f"outlier | {p.filter.gate_sigma:g} σ and {p.filter.gate_c:g} °C off; {p.filter.outliers_max} in a row"
    yield f"quiet time before a report | {heat.window_s:g} s, {heat.ready_s:g} s"
    yield f"drift reported | {heat.limit_c:g} °C"
    known, measured = 100.0 * heat.loss_uncertainty, 100.0 * calibrate.LOSS_UNCERTAINTY
    yield f"uncertainty of the losses | {known:g} %, after a calibration {measured:g} %"
    yield f"more than drift | {heat.drift_max_c:g} °C"
    yield f"heat capacity measured | over a rise of {heat.run_c:g} °C with {heat.run_w:g} W or more"
    yield f"wrong nozzle | heat capacity off by more than {100.0 * heat.capacity_band:g} %"


def control_rows() -> Iterator[str]:
    unit, p = options()
    calibrated = settings.CALIBRATED_APPROACH
    assert calibrated.band_c == p.approach.band_c
    yield f"control interval | {ms(p.timing.control_s)}"
    yield f"command lead | {ms(p.timing.lead_s)}"
    yield f"phases in a plan | max {mcu.PLAN_STEPS_MAX}"
    yield f"plan reaches ahead | {ms(nozzle_model.AHEAD_S)}"
    yield f"new plan when it differs by | {100.0 * bridge_driver.RESEND_SHARE:g} % of full power"
    yield f"closed-loop time constant | {ms(nozzle_model.FADE_S)}"
    yield f"lag from extruder motor to nozzle flow | {ms(nozzle_model.FLOW_LAG_S)}"
    yield f"disturbance: process noise | {nozzle_model.DISTURBANCE_W:g} W per √s"
    yield f"disturbance: largest | {nozzle_model.DISTURBANCE_MAX_W:g} W"
    yield f"change of the reading with the drive: initial 1 σ | {nozzle_model.SLANT_C:g} °C at full drive"
    yield f"no heating without a temperature for | {p.timing.stale_s:g} s"
    limits = f"{p.approach.power_w:g} W (`tank` law {calibrated.power_w:g} W), {p.approach.band_c:g} °C"
    yield f"near the target: power limit, band | {limits}"

    settled_s, settled_c = loop.InductionLoop.SETTLED_S, loop.InductionLoop.SETTLED_C
    yield f"holding: begin | within {settled_c:g} °C of the target for {settled_s:g} s"
    message_s = unit.records * unit.block_samples / unit.frequency_hz
    yield f"interval of control steps | {ms(int(mcu.BATCH_S / message_s) * message_s)}"


SECTIONS = (
    (Figures("Induction.md", "Numbers in the program"), thermometer_rows),
    (Figures("Control.md", "Numbers in the program"), control_rows),
)


@pytest.mark.parametrize(("section", "rows"), SECTIONS, ids=lambda part: getattr(part, "page", ""))
def test_the_tables_have_the_numbers_of_the_program(
    section: Figures, rows: Callable[[], Iterator[str]]
) -> None:
    missing = section.missing(rows())
    assert not missing, f"{section.page}, {section.section}: should say {missing}"
    assert section.unchecked(rows()) == []
