"""docs/guides/Safety.md against the program: every figure on the page is one of the code's, or measured here."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from doc_rig import ROOT, Figures
from extras import heaters, induction_heater
from extras.induction import calibrate as induction_calibrate
from extras.induction import settings, signal_limits
from heater_fakes import CommandError, FakePrinter
from induction_rig import PERIOD_S, Plant, Rig, default_parameters, true_law
from thermal.control import nozzle_model
from thermal.control.loop import LoopParameters
from thermal.records import PHASE_MAX_TICKS
from thermal.sensing import guard_limits, heat_balance_monitor, laws
from thermal.sensing.block_temperature import SENSING_PHASE_TICKS

SECTION = "induction_heater nozzle"
CONFIG = f"[{SECTION}]\nsense_pin: PA0\nmax_temp: 320\n"

PAGE = Figures(
    "Safety.md",
    facts=(
        "some 40 W behind a block of 20 g",
        "above about 260 °C; at 400 °C most plastics burn",
        "If the capacitor warms by enough for 20 °C",
        "current limit turned down for first tests (2 A)",
    ),
)


@cache
def printer() -> tuple[FakePrinter, Any]:
    """A printer with nothing but defaults, its options read, and the config they came from."""
    fake = FakePrinter(CONFIG, {})
    return fake, fake.config(SECTION)


@cache
def parameters() -> LoopParameters:
    _, config = printer()
    return settings.read_parameters(config, settings.read_unit(config))


def option(name: str) -> Any:
    """Default of an option that the program has read."""
    fake, config = printer()
    parameters()
    settings.guard_rows(config, parameters())
    settings.read_tests(config, parameters())
    return fake._access[SECTION, name]


def milliseconds(blocks: float) -> float:
    unit = settings.read_unit(printer()[1])
    return 1e3 * blocks * unit.block_samples / unit.frequency_hz


# ---- the nozzle, measured on the plant -----------------------------------------------------------------------------


def heated(preset: str) -> tuple[float, float, float]:
    """Full power from 20 °C: (W, seconds to 300 °C, °C/s on the way)."""
    plant = Plant(1, preset)
    plant.set_phase(PHASE_MAX_TICKS)
    periods = 0
    while plant.read().skin_c < 300.0:
        plant.run(32)
        periods += 32
    return plant.read().power_w, periods * PERIOD_S, 280.0 / (periods * PERIOD_S)


def two_digits(value: float) -> str:
    return f"{float(f'{value:.1e}'):g}"


def sensing_w(preset: str) -> float:
    plant = Plant(1, preset)
    plant.set_phase(SENSING_PHASE_TICKS)
    plant.run(32)
    return float(plant.read().power_w)


def reads_off_c(**changes: float) -> float:
    """By how much a change of the tank moves the reading of a nozzle at 200 °C."""

    def codes(temp_c: float, **values: float) -> float:
        fine = {"noise_lsb": 0.0, "units_per_lsb": 0.15, "start_c": temp_c, "mass_g": 20.0}
        plant = Plant(1, **fine, **values)
        plant.set_phase(SENSING_PHASE_TICKS)
        plant.run(32)  # the tank settles
        return float(plant.run(32).mean())

    per_c = (codes(210.0) - codes(190.0)) / 20.0
    return abs(codes(200.0, **changes) - codes(200.0)) / abs(per_c)


def nozzle_claims() -> Iterator[str]:
    for name, preset in (("as published", "reference"), ("well coupled", "strong")):
        power_w, seconds, rate = heated(preset)
        yield f"| {name} ({power_w:.0f} W into the metal) | {two_digits(seconds)} s | {two_digits(rate)} °C/s |"
    plant = Plant(1)
    assert plant.get_param("electrical_base_w") + plant.get_param("electrical_swing_w") > 300.0
    yield "a bridge of over 300 W"
    assert plant.get_param("mass_g") < 1.0
    assert plant.get_param("ambient_c") == plant.get_param("start_c")
    yield f"full power, from {plant.get_param('start_c'):g} °C | 300 °C after |"
    tank = reads_off_c(c1_factor=1.001), reads_off_c(frequency_ppm=100.0), reads_off_c(skew_ns=1.0)
    yield "off by 0.1 % is {:.0f} °C, 100 ppm of frequency {:.0f} °C, 1 ns of sampling skew {:.0f} °C".format(
        *tank
    )
    published_w, coupled_w = sensing_w("reference"), sensing_w("strong")
    yield f"puts {published_w:.1f} W into the published nozzle, {coupled_w:.0f} W into the well coupled"
    yield f"at {option('frequency') / 1e3:g} kHz"


# ---- the three guards ------------------------------------------------------------------------------------------------


def near_w(law: laws.Law, control: str, band_c: float) -> float:
    """Greatest request within so much of the target, on the way up."""
    rig = Rig(Plant(3), default_parameters(law=law, control=control), 1)
    rig.run(0.6)
    rig.set_target(250.0)
    rig.run(1.6)
    trace = rig.trace.arrays()
    near = (trace["target_c"] == 250.0) & (trace["estimate_c"] > 250.0 - band_c + 2.0)
    assert near.any()
    return float(trace["request_w"][near].max())


def loop_claims() -> Iterator[str]:
    yield f"After {parameters().timing.stale_s:g} s without one"
    assert (option("estimator"), option("control")) == ("exp", "model")
    band_c = parameters().approach.band_c
    assert settings.CALIBRATED_APPROACH.band_c == band_c
    yield f"| sensing law | within {band_c:g} °C of the target |"
    yield f"| `exp` (default), `eq5` | max {near_w(laws.ExpLaw(), 'model', band_c):.0f} W |"
    limited_w = {near_w(true_law(), control, band_c) for control in ("pid", "watermark", "two_period")}
    assert len(limited_w) == 1 and near_w(laws.ExpLaw(), "pid", band_c) == near_w(
        laws.Eq5Law(), "model", band_c
    )
    yield f"`control: pid`, `watermark` or `two_period` | max {limited_w.pop():.0f} W |"
    assert near_w(true_law(), "model", band_c) == pytest.approx(parameters().control.power_max_w)


def supervision_claims() -> Iterator[str]:
    p = parameters().supervise
    in_a_row = f"{p.limit_blocks} estimates in a row ({milliseconds(p.limit_blocks):.0f} ms)"
    yield f"or more than {p.over_c:g} °C above `max_temp` | {in_a_row} |"
    yield f"| no samples arrive, or the host was late | {p.silence_s:g} s |"
    yield f"give no valid temperature | {p.invalid_s:g} s |"
    assert p.demand_fraction == 0.5
    yield f"half of full power or more is requested {p.demand_c:g} °C or more below the target"
    yield f"does not warm by {p.gain_c:g} °C (no nozzle, broken coil, no supply) | {p.gain_s:g} s |"
    yield f"the nozzle is more than {p.above_target_c:g} °C above its target"
    yield f"(bridge stuck on) | {p.warming_c:g} °C within {p.warming_s:g} s |"


def guard_claims() -> Iterator[str]:
    max_duration_s = option("max_duration")
    silence = re.search(r"SILENCE_US = (\d+)", (ROOT / "src/inductionconfig.c").read_text())
    assert silence
    yield f"`max_duration` ({1e3 * max_duration_s:g} ms): bridge off; shutdown after {1e-6 * int(silence[1]):g} s"
    timing = parameters().timing
    yield f"begins {1e3 * (timing.lead_s + timing.stride_s):.0f} ms after it was sent"
    blocks = option("guard_trip_blocks")
    yield f"`guard_trip_blocks` blocks in a row trip ({blocks}, which are {milliseconds(blocks):.0f} ms)"
    low_c, margin_c = settings.GUARD_LOW_C, option("guard_margin")
    yield f"the readings at {low_c:g} °C and at `max_temp` + `guard_margin` ({margin_c:g} °C)"
    p = parameters()
    expected = guard_limits.guard_limits(p.estimator.law, p.front, low_c, p.supervise.temp_high_c + margin_c)
    assert settings.guard_rows(printer()[1], p) == expected


def signal_claims() -> Iterator[str]:
    """The tests of src/signal_test.h with the limits of extras/induction/signal_limits.py."""
    header = (ROOT / "src" / "signal_test.h").read_text(encoding="utf-8")
    board = (ROOT / "src" / "board" / "sync_adc.h").read_text(encoding="utf-8")

    def constant(name: str) -> int:
        return int(re.findall(rf"\b{name} = (\d+)", header + board)[0])

    interval_s, length = option("signal_test_interval"), constant("SIGNAL_TEST_LEN")
    yield f"The next three come every `signal_test_interval` ({interval_s:g} s)."
    off, ticks = constant("SIGNAL_TEST_OFF_LEN"), constant("SYNC_ADC_MOVE_TICKS")
    assert signal_limits.SLACK_LSB == 1.0
    moved = signal_limits.GAIN_UNITS_DEG * 360.0 * ticks / 72e6 / PERIOD_S
    heating = f"Each {2e3 * interval_s:g} ms of heating the"
    hard = f"{2e3 * interval_s:g} ms of heating ({1e3 * interval_s:g} ms at more than half the phase)"
    yield f"{hard} the sampling instant is moved by {ticks} ticks for {length} samples."
    yield f"moves by {moved:.0f} units with the published amplifier"
    learned = 1 << constant("SIGNAL_TEST_LEARN_SHIFT")
    yield f"from the first {learned} tests, which may differ from that by a factor of {signal_limits.GAIN_RANGE:g}"
    yield f"must be within {100 * signal_limits.LEARNED_TOLERANCE:g} % of it and one LSB"
    yield f"by what that says, within {100 * signal_limits.MEASURED_TOLERANCE:g} % and one LSB"
    yield f"{heating} bridge is off for {off} samples ({1e3 * off * PERIOD_S:.1g} ms)."
    yield f"The last {length} must be within {signal_limits.OFF_UNITS:g} units of `adc_zero`"
    assert (constant("SIGNAL_TEST_BAD"), constant("SIGNAL_JUMP_BLOCKS")) == (2, 3)
    assert constant("SIGNAL_IDLE_BLOCKS") == 4
    yield "of an idle nozzle too, must show the same: four bad ones in a row trip"
    yield f"at the same drive by more than {signal_limits.JUMP_UNITS:g} units, three blocks in a row"
    ripple = PHASE_MAX_TICKS / 2**15 + (PHASE_MAX_TICKS - 2**15) / 2**12
    yield f"drive the limit is {signal_limits.JUMP_UNITS * (1.0 + ripple):.0f} units"
    samples = 2.0 * interval_s / PERIOD_S
    lost = (length + off + option("settle_samples")) / samples
    yield f"The tests cost {100 * lost:.1f} % of the samples and the bridge {100 * off / samples:.0f} % of its time."


def drift_claims() -> Iterator[str]:
    p = parameters().heat_balance
    yield f"After {p.ready_s:g} s without extrusion and fan"
    yield f"`drift_limit` ({p.limit_c:g} °C)"

    def reported_c(loss_uncertainty: float) -> float:
        """The smallest drift at 250 °C that is warned of."""
        known = replace(p, loss_uncertainty=loss_uncertainty)
        tenths = (
            n
            for n in range(2000)
            if heat_balance_monitor.warning(
                known, heat_balance_monitor.HeatBalanceState(temp_c=250.0, drift_c=n / 10)
            )
        )
        return next(tenths) / 10

    with_one, without = (
        reported_c(induction_calibrate.LOSS_UNCERTAINTY),
        reported_c(option("loss_uncertainty")),
    )
    yield f"At 250 °C this is a drift of more than {with_one:.0f} °C after a calibration, {without:.0f} °C without one"


# ---- a host that dies, in the rig ------------------------------------------------------------------------------------


def off_after_s(warm_s: float) -> float:
    """How long the bridge is on after the host's death, that long after the target was set."""
    rig = Rig(Plant(3), default_parameters(law=true_law()), 1)
    rig.run(0.6)
    rig.set_target(250.0)
    rig.run(warm_s)
    dead_s, on_s = rig.now_s, rig.now_s
    rig._host = lambda: None  # type: ignore[method-assign]
    while rig.now_s < dead_s + 0.5:
        rig.run(0.002)
        on_s = rig.now_s if rig.phase else on_s
    assert not rig.phase
    return on_s - dead_s


def dead_host_claims() -> Iterator[str]:
    """Rounded up to 0.05 s."""
    heating_s = max(off_after_s(warm_s) for warm_s in (0.1, 0.3, 0.5, 0.52, 0.8, 1.0))
    held_s = max(off_after_s(warm_s) for warm_s in (1.5, 1.6, 2.5, 2.6, 3.0))
    yield f"the plan reaches {1e3 * nozzle_model.AHEAD_S:g} ms ahead | max {math.ceil(20.0 * heating_s) / 20.0:g} s"
    yield f"at the latest | max {math.ceil(20.0 * held_s) / 20.0:g} s"


GROUPS = (
    nozzle_claims,
    loop_claims,
    supervision_claims,
    guard_claims,
    signal_claims,
    drift_claims,
    dead_host_claims,
)


@cache
def claims(group: Callable[[], Iterator[str]]) -> list[str]:
    return list(group())


@pytest.mark.parametrize("group", GROUPS, ids=lambda group: group.__name__.removesuffix("_claims"))
def test_the_page_says_what_the_program_does(group: Callable[[], Iterator[str]]) -> None:
    missing = PAGE.missing(claims(group))
    assert not missing, f"{PAGE.page} should say: {missing}"


def test_no_figure_on_the_page_is_without_a_check() -> None:
    assert PAGE.unchecked(claim for group in GROUPS for claim in claims(group)) == []


def test_a_nozzle_without_a_calibration_has_no_limits_and_no_target() -> None:
    loaders = {"induction_heater": induction_heater.load_config_prefix, "heaters": heaters.load_config}
    fake = FakePrinter(CONFIG + "estimator: uncalibrated\n", loaders)
    heater = fake.load(SECTION).heater
    assert settings.guard_rows(fake.config(SECTION), heater.parameters) == [
        guard_limits.LimitRow(SENSING_PHASE_TICKS, 0, 65535)
    ]
    with pytest.raises(CommandError, match="not calibrated"):
        heater.set_temp(100.0)
    assert (
        "With `estimator: uncalibrated` only silence shuts down, and every target is refused." in PAGE.text()
    )
    assert "With `estimator: uncalibrated` there are no such limits." in PAGE.text()
