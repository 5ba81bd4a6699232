"""The guard trips inside the sampling interrupt of the STM32F334's image, and a whole printer is shut down there."""

from __future__ import annotations

from typing import Any

import pytest

from block_codec import one_step
from chip_rig import FREQ, Firmware
from measure import PERIOD, SIGNAL_TESTS, clock_offset, moving_code

BLOCK = 192
DEAD_CODE = 2000
STEPPERS, SWITCHES, OUTPUTS = 5, 3, 12
PLAN_STEPS = 12  # as many as a message carries: all are pending when the guard trips
PINS = [*range(16, 32), *range(32, 45), 4, 5, 6, 7]  # ports B and C, and what is free on A


def whole_printer() -> list[tuple[str, dict[str, Any]]]:
    """Objects of a machine with five motors, beside the heater: 23."""
    pins, objects = iter(PINS), []

    def add(name: str, **values: int) -> None:
        objects.append((name, {"oid": len(objects) + 1} | values))

    for _ in range(STEPPERS):
        add("config_stepper", step_pin=next(pins), dir_pin=next(pins), invert_step=0, step_pulse_ticks=144)
    for _ in range(SWITCHES):
        add("config_endstop", pin=next(pins), pull_up=1)
        add("config_trsync")
    for _ in range(OUTPUTS):
        add("config_digital_out", pin=next(pins), value=0, default_value=0, max_duration=0)
    return objects


def tripped(settle_samples: int) -> Firmware:
    """A heating printer whose coil signal stays on one code while its drive steps far; the settling shifts its blocks
    against the interrupts."""
    chip = Firmware()
    config = {"oid": 0, "bridge": 0, "adc_pin": 0, "period_ticks": PERIOD, "phase_max": 45000}
    objects = whole_printer()
    chip.configure(
        1 + len(objects),
        ("config_induction", config | {"max_duration": FREQ // 2}),
        (
            "config_induction_sense",
            {"oid": 0, "oversample": 5, "settle_samples": settle_samples, "ema_shift": 0},
        ),
        ("config_induction_block", {"oid": 0, "samples": BLOCK, "records": 2}),
        ("config_induction_test", SIGNAL_TESTS),
        ("config_induction_limit", {"oid": 0, "phase": 1000, "low": 0, "high": 65535, "trip_blocks": 1}),
        *objects,
    )
    chip.sample_code = alive = moving_code(chip)
    chip.send("induction_report", oid=0, enable=1)
    at = chip.now - clock_offset(chip) + FREQ // 100
    chip.post("queue_induction_plan", oid=0, clock=at & 0xFFFFFFFF, steps=one_step(20000))
    chip.run(0.1)
    far, later = at + FREQ // 8, at + FREQ // 5
    chip.post("queue_induction_plan", oid=0, clock=far & 0xFFFFFFFF, steps=one_step(30000))
    steps = b"".join(word.to_bytes(2, "little") for n in range(PLAN_STEPS) for word in (2 * BLOCK, 20000 + n))
    chip.post("queue_induction_plan", oid=0, clock=later & 0xFFFFFFFF, steps=steps)
    chip.run(0.02)
    dies = chip.now + 3 * BLOCK // 4 * PERIOD
    chip.sample_code = lambda clock: DEAD_CODE if clock >= dies else alive(clock)
    chip.run(0.05)
    assert chip.bridge_sets[-1][1] == 0
    assert chip.ask("induction_query", oid=0)["trip"] == 4
    return chip


@pytest.mark.parametrize("settle_samples", range(0, BLOCK, 12))
def test_wherever_in_the_interrupt_the_guard_trips_it_ends_within_a_tenth_of_a_millisecond(
    settle_samples: int,
) -> None:
    """Steps wait for it and the console's bytes do. The worst place, at the end of a half buffer's second block, is
    found by shifting the blocks: 93 us."""
    counters = tripped(settle_samples).chip.counters()
    assert max(counters["longest_ticks"].values()) / FREQ < 100e-6
    assert counters["console_overruns"] == 0
