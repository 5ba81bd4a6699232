"""Tables of stepper drivers: currents by the datasheets' formulas, fields side by side, options that fit."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from extras.tmc.chips import (
    FLAGS,
    SIGNED,
    TMC2130,
    TMC2208,
    TMC2209,
    TMC2240,
    TMC2240_UART,
    TMC2660,
    TMC5160,
    Chip,
)
from extras.tmc.current import CurrentModel, ReferenceResistor, TwoRanges, tmc5160_current
from extras.tmc.registers import Fields, adc_temp_c

CHIPS = (TMC2130, TMC2208, TMC2209, TMC2240, TMC2240_UART, TMC2660, TMC5160)
FULL_PEAK_A = {0: 11.75 / 12.0, 1: 2.0, 2: 3.0}  # TMC2240 with 12 kohm, by range


def set_current_a(model: CurrentModel, fields: dict[str, int], scale: str) -> float:
    """What the chip makes of its fields, by the datasheets (peak / sqrt 2)."""
    share = (fields[scale] + 1) / 32.0
    if "vsense" in fields:
        return share * (0.325, 0.180)[fields["vsense"]] / (0.110 + 0.020) / math.sqrt(2.0)
    factor = (fields["globalscaler"] or 256) / 256.0
    if "current_range" in fields:
        return share * factor * FULL_PEAK_A[fields["current_range"]] / math.sqrt(2.0)
    return share * factor * 0.325 / 0.075 / math.sqrt(2.0)


# 2209: 0.11 ohm; 5160: 0.075 ohm; 2240: 12 kohm. Resolution near a current: half a CS step of the range in use, or half
# a step of the factor, 1/512 of the full current
MODELS: dict[str, tuple[CurrentModel, float]] = {
    "tmc2209": (TwoRanges(0.110, (0.325, 0.180)), 0.5 / 32.0),
    "tmc5160": (tmc5160_current(0.075), 0.5 / 256.0),
    "tmc2240": (ReferenceResistor(12000.0), 0.5 / 256.0),
}


@pytest.mark.parametrize("name", MODELS)
@given(share=st.floats(0.15, 1.0))
def test_currents_are_as_near_as_the_scales_allow(name: str, share: float) -> None:
    model, resolution = MODELS[name]
    run_a = share * model.largest_a
    fields = model.fields(run_a, 0.5 * run_a)
    assert set_current_a(model, fields, "irun") == pytest.approx(
        run_a, abs=resolution * model.largest_a + 1e-9
    )
    # the holding current shares the range and the factor: CS is all it has
    scale_a = set_current_a(model, fields, "irun") / (fields["irun"] + 1)
    assert set_current_a(model, fields, "ihold") == pytest.approx(0.5 * run_a, abs=scale_a)


def test_known_settings() -> None:
    # TMC5160 datasheet, chapter 9: 0.075 ohm give 3.06 A rms at full scale
    assert tmc5160_current(0.075).largest_a == pytest.approx(3.06, abs=0.005)
    assert tmc5160_current(0.075).fields(5.0, 5.0)["globalscaler"] == 0
    assert tmc5160_current(0.075).fields(0.1, 0.1) == {"globalscaler": 32, "irun": 7, "ihold": 7}
    assert ReferenceResistor(12000.0).fields(0.6, 0.6)["current_range"] == 0
    assert ReferenceResistor(12000.0).fields(1.0, 1.0)["current_range"] == 1
    assert TwoRanges(0.110, (0.325, 0.180)).fields(0.8, 0.5) == {"vsense": 1, "irun": 25, "ihold": 15}


@pytest.mark.parametrize("chip", CHIPS, ids=lambda chip: chip.name)
def test_fields_lie_side_by_side_in_registers_that_exist(chip: Chip) -> None:
    for register in chip.registers:
        fields = sorted((f.low, f.low + f.width) for f in chip.fields.values() if f.register == register)
        assert fields, register
        assert fields[-1][1] <= 32
        assert all(before[1] <= after[0] for before, after in itertools.pairwise(fields)), register
    assert {f.register for f in chip.fields.values()} <= set(chip.registers)
    assert len(set(chip.registers.values())) == len(chip.registers)


@pytest.mark.parametrize("chip", CHIPS, ids=lambda chip: chip.name)
def test_options_are_fields_that_are_written(chip: Chip) -> None:
    names = [*chip.options, *chip.fixed, "mres", "intpol", "dedge"]
    names += ["vsense", "cs"] if chip.stealth_field is None else [chip.stealth_field[0], "irun", "ihold"]
    names += (
        []
        if chip.stall is None
        else [*chip.stall.homing, *chip.stall.quiet, *filter(None, chip.stall.pins.values())]
    )
    for name in names:
        assert chip.fields[name].register in chip.written, name
    for name, value in chip.options.items():
        limit = 1 << chip.fields[name].width
        assert 0 <= value < (2 if name in FLAGS else limit // 2 if name in SIGNED else limit), name
    assert chip.written[-1] == "CHOPCONF"
    assert not set(chip.write_only) - set(chip.written)


def test_status_fields_that_are_not_zero_and_the_temperature_of_the_2240() -> None:
    """Datasheet: 2038 counts at 0 degrees C, 7.7 counts a degree."""
    values = Fields(TMC2240.fields)
    stealth, otpw, scale = 1 << 14, 1 << 26, 16 << 16
    assert values.parts("DRV_STATUS", stealth | otpw | scale) == {"stealth": 1, "otpw": 1, "cs_actual": 16}
    assert adc_temp_c(2038) == 0.0 and adc_temp_c(2038 + 77 * 3) == 30.0
