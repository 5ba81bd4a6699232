"""A chip that is not as it should be does not energise the bridge, and says why."""

from __future__ import annotations

import pytest

from block_codec import one_step
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
CLOCKS = {
    "HRTIM": 0x181D,
    "ADC": 0x141C,
    "DMA": 0x1400,
    "CRC": 0x1406,
    "GPIOA": 0x1411,
    "GPIOB": 0x1412,
    "SYSCFG": 0x1800,
    "TIM2": 0x1C00,
    "USART2": 0x1C11,
    "PWR": 0x1C1C,
}


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
        chip.post("queue_induction_plan", oid=0, clock=clock, steps=one_step(20000))
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
        ("clock_stuck", CLOCKS["GPIOB"], "clock"),
        ("clock_stuck", CLOCKS["SYSCFG"], "clock"),
        ("clock_stuck", CLOCKS["PWR"], "clock"),
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


@pytest.mark.parametrize("gate", ["DMA", "CRC", "GPIOA", "TIM2", "USART2"])
def test_a_chip_that_cannot_speak_does_nothing(gate: str) -> None:
    """Without these clocks no report could be sent: it stops before any pin is an output, and asks no dead block."""
    chip = Firmware(settle_s=0.0, mutations=())
    chip.chip.mutate("clock_stuck", CLOCKS[gate])
    chip.run(1.0)
    assert try_to_heat(chip) == "" and not chip.sent
    assert not energised(chip) and not chip.pin_writes
    assert chip.chip.counters()["resets"] == 0


@pytest.mark.parametrize("gate", ["SYSCFG", "PWR", "GPIOB"])
def test_a_clock_that_goes_while_heating_is_found_at_the_next_switching_on(gate: str) -> None:
    chip = Firmware()
    assert try_to_heat(chip) == ""
    chip.post(
        "queue_induction_plan", oid=0, clock=(chip.now - clock_offset(chip)) & 0xFFFFFFFF, steps=one_step(0)
    )
    chip.run(0.01)
    chip.bridge_sets.clear()
    chip.chip.mutate("clock_stuck", CLOCKS[gate])
    clock = (chip.now - clock_offset(chip) + FREQ // 200) & 0xFFFFFFFF
    chip.post("queue_induction_plan", oid=0, clock=clock, steps=one_step(20000))
    chip.run(0.03)
    assert "clock" in (chip.shutdown_reason() or "")
    assert not energised(chip)


@pytest.mark.parametrize("mutation", ["no_crystal", "no_pll"])
def test_without_its_clock_the_chip_reports_and_does_not_heat(mutation: str) -> None:
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


def test_the_fault_line_stops_a_running_bridge_and_is_reported() -> None:
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


# --- what could leave the bridge on --------------------------------------------------------------------------------


def heating() -> Firmware:
    chip = Firmware()
    assert try_to_heat(chip) == "" and chip.bridge_sets[-1][1] > 0
    return chip


def keep_asking(chip: Firmware, seconds: float) -> None:
    """A host that does not notice anything: a phase every 30 ms, until the chip resets."""
    end = chip.now + round(seconds * FREQ)
    while chip.now < end and chip.chip.counters()["resets"] == 0:
        clock = (chip.now - clock_offset(chip) + FREQ // 200) & 0xFFFFFFFF
        chip.post("queue_induction_plan", oid=0, clock=clock, steps=one_step(20000))
        chip.run(0.03)


def off_after(chip: Firmware, since: int) -> float:
    """Seconds from a clock until the bridge went off, the reset included that puts its pins to rest."""
    if chip.lib.sim_mcu_take_reset():
        chip.lib.sim_mcu_boot(chip.board, chip.now)
    off = [clock for clock, phase in chip.bridge_sets if phase == 0 and clock >= since]
    assert off and chip.bridge_sets[-1][1] == 0, "the bridge is on"
    return (off[0] - since) / FREQ


def test_a_silent_host_ends_the_heat() -> None:
    """A cable pulled out, a host that hangs, a serial port that is stuck: the bridge is off after max_duration, in the
    firmware's own timer, and after 3 s the board stops."""
    chip = heating()
    since = chip.now - round(0.025 * FREQ)  # the last phase was applied then
    chip.run(2.9)
    assert off_after(chip, since) == pytest.approx(CONFIG["max_duration"] / FREQ, abs=0.001)
    assert chip.shutdown_reason() is None
    chip.run(0.1)
    assert "induction" in (chip.shutdown_reason() or "").lower()


@pytest.mark.parametrize("channel", [1 << 5, 1 << 6], ids=["receive", "transmit"])
def test_a_serial_port_whose_dma_dies_ends_the_heat(channel: int) -> None:
    """It hears nothing more, or nobody hears it and goes: the host's last word holds for max_duration."""
    chip = heating()
    chip.chip.mutate("dma_dead", channel)
    since = chip.now
    if channel == 1 << 5:
        keep_asking(chip, 0.2)
    chip.run(1.0)
    assert off_after(chip, since) < CONFIG["max_duration"] / FREQ + 0.001


def test_samples_that_stop_coming_end_the_heat() -> None:
    chip = heating()
    chip.chip.mutate("dma_dead", 1)
    since = chip.now
    keep_asking(chip, 0.2)
    assert off_after(chip, since) < 0.05
    assert "sample" in (chip.shutdown_reason() or "").lower()


def test_a_processor_that_faults_lets_go_at_once_and_is_reset() -> None:
    chip = heating()
    since = chip.now
    chip.chip.mutate("hard_fault")
    chip.run(0.001)
    assert off_after(chip, since) < 5e-6
    chip.run(1.0)
    assert chip.chip.counters()["resets"] == 1


def test_a_processor_that_spins_in_an_interrupt_is_reset() -> None:
    """The list of timers bitten into its own tail: no timer runs any more, no task, no guard. The watchdog is left."""
    chip = heating()
    since = chip.now
    head = chip.chip.peek("=sched_turn")
    chip.post("debug_write", order=2, addr=head, val=head)  # its `next` is itself
    chip.run(0.6)
    assert chip.chip.counters()["resets"] == 1
    assert off_after(chip, since) < 0.601  # it is looked at no sooner here


def test_timers_that_stop_running_are_found_though_tasks_and_samples_go_on() -> None:
    """Without its timer the firmware has no limits of time. The watchdog is fed for timers and tasks both."""
    chip = heating()
    since = chip.now
    chip.chip.mutate("compare_dead")
    keep_asking(chip, 1.5)
    assert chip.chip.counters()["resets"] == 1
    assert off_after(chip, since) < 1.0


def test_a_second_fault_is_reported_like_the_first() -> None:
    """Shut down, cleared by the host, heating again: hardware and firmware watch as before."""
    chip = heating()
    for _ in range(2):
        chip.chip.mutate("fault_line", 1)
        assert chip.bridge_sets[-1][1] == 0
        chip.run(0.02)
        assert "fault" in (chip.shutdown_reason() or "").lower()
        chip.chip.mutate("fault_line", 0)
        chip.send("clear_shutdown")
        chip.sent.clear()
        chip._whole = 0
        keep_asking(chip, 0.1)
        assert chip.shutdown_reason() is None and chip.bridge_sets[-1][1] > 0
