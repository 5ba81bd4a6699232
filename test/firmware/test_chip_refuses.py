"""A chip that is not as it should be does not energise the bridge, and says why."""

from __future__ import annotations

import pytest
from chip_rig import FREQ, Firmware
from measure import PERIOD, clock_offset

CONFIG = {
    "oid": 0,
    "bridge": 0,
    "adc_pin": 0,
    "period_ticks": PERIOD,
    "phase_max": 45000,
    "max_duration": FREQ // 2,
}
SENSE = {"oid": 0, "oversample": 5, "settle_samples": 20, "ema_shift": 0}

# RM0364, RCC: offset of the enable register and bit
CLOCKS = {"HRTIM": 0x181D, "ADC": 0x141C, "DMA": 0x1400}


def try_to_heat(chip: Firmware) -> str:
    """Configure the heater and ask for heat, as a host does; the reason if the firmware refuses."""
    for name, values in (
        ("allocate_oids", {"count": 1}),
        ("config_induction", CONFIG),
        ("config_induction_sense", SENSE),
        ("finalize_config", {"crc": 1}),
    ):
        chip.send(name, **values)
    for _ in range(5):
        clock = (chip.now - clock_offset(chip) + FREQ // 200) & 0xFFFFFFFF
        chip.post("queue_induction_phase", oid=0, clock=clock, phase=20000)
        chip.run(0.03)
    return chip.shutdown_reason() or ""


def energised(chip: Firmware) -> bool:
    return any(phase for _, phase in chip.bridge_sets)


def test_a_sound_chip_heats() -> None:
    """What the others are measured against."""
    chip = Firmware()
    assert try_to_heat(chip) == ""
    assert chip.bridge_sets[-1][1] == pytest.approx(20000, abs=2)


@pytest.mark.parametrize(
    ("mutation", "value", "words"),
    [
        ("clock_stuck", CLOCKS["HRTIM"], "clock"),
        ("clock_stuck", CLOCKS["ADC"], "ADC"),
        ("adc_uncalibrated", 1, "ADC"),
        ("adc_dead", 1, "ADC"),
        ("no_dll", 1, "delay line"),
        ("fault_line", 1, "fault"),
        ("brown_out", 1, "supply"),
        ("dma_dead", 1, "sample"),
        ("hrtim_dead", 1, "clock"),
    ],
)
def test_a_mutated_peripheral_is_named_and_the_bridge_stays_off(
    mutation: str, value: int, words: str
) -> None:
    chip = Firmware(settle_s=0.0)
    chip.chip.mutate(mutation, value)
    chip.run(0.05)
    reason = try_to_heat(chip)
    assert not energised(chip)
    assert reason and words.lower() in reason.lower(), reason


@pytest.mark.parametrize("mutation", ["no_crystal", "no_pll"])
def test_without_its_clock_the_chip_tells_and_does_not_heat(mutation: str) -> None:
    """64 or 8 MHz from its own oscillator, on the right baud rate and without a reset: a host hears why."""
    chip = Firmware(settle_s=0.0, mutations=(mutation,))
    chip.run(1.5)  # it waits long for the crystal
    reason = try_to_heat(chip)
    assert not energised(chip)
    assert "clock" in reason.lower(), reason
    counters = chip.chip.counters()
    assert counters["console_baud"] == 250000 and counters["resets"] == 0


def test_a_dip_of_the_supply_is_remembered() -> None:
    """The supply fell and came back: memory was kept, the chip stopped in the middle of something."""
    chip = Firmware()
    assert try_to_heat(chip) == ""
    chip.chip.mutate("supply_dip")
    chip.bridge_sets.clear()
    chip.lib.sim_mcu_boot(chip.board, chip.now)
    chip.sequence = 0
    chip.run(0.05)
    assert "supply" in try_to_heat(chip).lower() or "brown" in try_to_heat(chip).lower()
    assert not energised(chip)


def test_the_fault_line_stops_a_running_bridge_and_is_told() -> None:
    chip = Firmware()
    assert try_to_heat(chip) == ""
    before = chip.now
    chip.chip.mutate("fault_line")
    clock, phase = chip.bridge_sets[-1]
    assert phase == 0 and clock - before < FREQ // 1_000_000  # hardware: no instruction in between
    chip.run(0.02)
    assert "fault" in (chip.shutdown_reason() or "").lower()


def test_a_low_supply_stops_a_running_bridge() -> None:
    chip = Firmware()
    assert try_to_heat(chip) == ""
    chip.chip.mutate("brown_out")
    assert chip.bridge_sets[-1][1] == 0
    chip.run(0.02)
    assert chip.shutdown_reason()


def test_a_crystal_that_stops_takes_the_bridge_down_and_the_watchdog_the_rest() -> None:
    chip = Firmware()
    assert try_to_heat(chip) == ""
    chip.chip.mutate("crystal_stops")
    assert chip.bridge_sets[-1][1] == 0
    chip.run(1.0)
    assert chip.lib.sim_mcu_take_reset()
