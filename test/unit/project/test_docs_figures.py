"""Figures of the documentation that the program has as well: each is made of the program's value.

The sections "Numbers in the program" have no other figures. Other pages have measured ones beside them.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import pytest

import bench_plan
import bench_plan_cost
import full_load
import rates
from bus_rig import build_dictionary
from doc_rig import ROOT, Figures
from extras import temperature_plan
from extras.induction import calibrate, mcu, settings
from extras.temperature_plan import settings as plan_settings
from heater_fakes import FakePrinter
from thermal.control import bridge_driver, loop, nozzle_model
from thermal.identification.sweep import LOW_PHASES_TICKS
from thermal.plan import session, set_points
from thermal.plan.deposit import Surroundings
from thermal.plan.materials import MATERIALS
from thermal.plan.planner import TemperaturePlan
from thermal.sensing import block_temperature, features, laws
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS

TIMING = re.findall(
    r"^    (INDUCTION_\w+) =", (ROOT / "src" / "induction_timing.h").read_text(), re.MULTILINE
)


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
    larger = LOW_PHASES_TICKS[-1]
    share = 100.0 * features.power_fraction(larger)
    yield f"the same with a dead time that takes most of its pulse | {larger} ticks, {share:.1f} % of full power"
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
    yield f"closed-loop time constant | {ms(nozzle_model.TAU_S)}"
    yield f"lag from extruder motor to nozzle flow | {ms(nozzle_model.FLOW_LAG_S)}"
    yield f"disturbance: process noise | {nozzle_model.DISTURBANCE_W:g} W per √s"
    yield f"disturbance: largest | {nozzle_model.DISTURBANCE_MAX_W:g} W"
    yield f"change of the reading with the drive: initial 1 σ | {nozzle_model.SLANT_C:g} °C at full drive"
    yield f"coloured errors of the reading: density | {1e4 * nozzle_model.COLOURED_C2_S:g} · 10⁻⁴ °C² s"
    yield f"no heating without a temperature for | {p.timing.stale_s:g} s"
    limits = f"{p.approach.power_w:g} W (`tank` law {calibrated.power_w:g} W), {p.approach.band_c:g} °C"
    yield f"near the target: power limit, band | {limits}"

    settled_s, settled_c = loop.InductionLoop.SETTLED_S, loop.InductionLoop.SETTLED_C
    yield f"holding: begin | within {settled_c:g} °C of the target for {settled_s:g} s"
    message_s = unit.records * unit.block_samples / unit.frequency_hz
    for span_s, when in ((loop.HELD_BATCH_S, "nothing"), (loop.PLANNED_BATCH_S, "a change")):
        yield f"interval of control steps with {when} planned | {ms(int(span_s / message_s) * message_s)}"


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


def test_the_dictionary_has_the_hosts_timing_of_the_sampling_chain() -> None:
    constants = json.loads(build_dictionary())["config"]
    unit, parameters = options()
    assert {name: value for name, value in constants.items() if name in TIMING} == {
        "INDUCTION_FREQUENCY": unit.frequency_hz,
        "INDUCTION_OVERSAMPLE": unit.oversample,
        "INDUCTION_BLOCK_SAMPLES": unit.block_samples,
        "INDUCTION_SETTLE_SAMPLES": unit.settle_samples,
        "INDUCTION_RECORDS": unit.records,
        "INDUCTION_LEAD_US": pytest.approx(1e6 * parameters.timing.lead_s),
    }


# ---- pages that repeat some figures of the program


def source(path: str, name: str) -> float:
    """A number that a C file, a header, a build file or a config gives a name."""
    found = re.findall(rf"\b{name}\s*:?[=:]?\s*([\d.]+)", (ROOT / path).read_text(encoding="utf-8"))
    assert len(set(found)) == 1, f"{path} should have one {name}, has {found}"
    return float(found[0])


def plan_claims() -> Iterator[str]:
    plan = "klippy/thermal/plan"
    around, pc = Surroundings(), MATERIALS["PC"]
    cell = inspect.signature(TemperaturePlan.__init__).parameters["cell_mm"].default
    yield f"cut into nodes of {1e3 * set_points.NODE_S:.0f} ms. They are earlier by"
    yield f"when {source(f'{plan}/path_pieces.c', 'REPLAN_S'):g} s of new motion have come in"
    yield f"in {source(f'{plan}/path_pieces.c', 'REPLAN_MOVES'):g} moves or more, or {temperature_plan.WORK_S:g} s."
    yield f"It starts {session.COMMIT_S:g} s ahead of now."
    yield f"The plan keeps {plan_settings.HEADROOM_C:g} °C below `max_temp`"
    yield f"reference between `min_extrude_temp` and {plan_settings.HEADROOM_C:g} °C below `max_temp`"
    yield f"the layer below has kept {100.0 * source(f'{plan}/planner.c', 'LEFT_OF_A_LAYER'):g} % of a road's excess"
    yield f"counts as {1e-3 * source(f'{plan}/planner.c', 'GUESS_MM'):g} m of path"
    yield f"A grid of {cell:g} mm columns"
    yield f"a road more than {source(f'{plan}/deposit.c', 'TAKEN_OFF_MM'):g} mm below the top of its column"
    yield f"Still air of {around.still_w_m2k:g} W/(m² K)"
    yield f"decays by a factor e every {around.bed_reach_mm:g} mm of height"
    yield f"`minimum_speed_factor` ({plan_settings.SLOWEST:g}) is the minimum share"
    yield f"{pc.low_c:g} to {pc.high_c:g} °C is {0.5 * (pc.high_c - pc.low_c):g} °C at the weld"
    yield f"below the bonding temperature ({MATERIALS['ABS'].bonding_c:g} °C) either way"
    bed, chamber = (bench_plan.SECTION[name] for name in ("bed_temp", "chamber_temp"))
    yield f"ABS at {bench_plan.NOZZLE_C} °C on a bed of {bed} °C in a chamber of {chamber} °C"
    bed, chamber = (bench_plan.HARD_SECTION[name] for name in ("bed_temp", "chamber_temp"))
    yield f"PC at {bench_plan.HARD_NOZZLE_C} °C on {bed} °C without an enclosure ({chamber} °C)"
    yield f"over the first {bench_plan_cost.INSTRUCTION_MOVES} moves"


def thousands(value: float) -> str:
    return f"{round(value, -3):,.0f}"


def emulation_claims() -> Iterator[str]:
    core, port = "klippy/simulation/emulator/core.h", "src/stm32f334/port.mk"
    cycles = source(core, "CORE_CYCLES_PER_INSTRUCTION")
    yield f"**{cycles:g} cycles** of the processor clock (`CORE_CYCLES_PER_INSTRUCTION` in `core.h`)"
    entry = source(core, "CORE_EXCEPTION_CYCLES")
    yield f"| exception | {entry:g} cycles in, {entry:g} out |"
    yield f"of {source(port, 'F334_STACK') / 1024:g} KiB"
    yield f"of {source(port, 'F334_RAM_BUDGET') / 1024:g} KiB with objects, moves and stack"
    yield f"({rates.STEPS:,} steps of each motor"
    yield f"an axis at {full_load.TRAVEL_HZ:,} pulses/s beside it"
    for bench in rates.BENCHES.values():
        ours, theirs = bench.documented, bench.published
        yield f"ticks between steps, 1 / 3 steppers together | {ours.ticks[1]} / {ours.ticks[3]} |"
        yield f" {theirs.ticks[1]} / {theirs.ticks[3]} |"
        yield f"that is steps a second | {thousands(bench.steps_per_s(1))} / {thousands(bench.steps_per_s(3))} |"
        yield f" {thousands(theirs.steps_per_s(1))} / {thousands(theirs.steps_per_s(3))} |"
        yield f"{ours.command_instructions} instructions each"
        yield f"{theirs.commands_per_s:,} |"
    f334, mega = (bench.documented.step_instructions for bench in rates.BENCHES.values())
    yield f"its interrupt included | {f334[1]} instructions |"
    yield f"its interrupt included | {mega[1]} / {mega[3]} instructions |"


PAGES = ((Figures("Temperature_Plan.md"), plan_claims), (Figures("Emulation.md"), emulation_claims))


@pytest.mark.parametrize(("page", "claims"), PAGES, ids=lambda part: getattr(part, "page", ""))
def test_pages_repeat_the_figures_of_the_program(page: Figures, claims: Callable[[], Iterator[str]]) -> None:
    missing = page.missing(claims())
    assert not missing, f"{page.page} should say {missing}"
