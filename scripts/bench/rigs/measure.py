"""The bridge sampled at 120 kHz on the STM32F334's image, an axis stepping beside it: what comes of every sample, and
what it costs in instructions. Steps and commands by themselves: rates.py.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from block_codec import Row, one_step, unpack
from chip_rig import FREQ, Firmware

CYCLES_PER_INSTRUCTION = 2  # CORE_CYCLES_PER_INSTRUCTION of klippy/simulation/emulator/core.h
BOTH_EDGES = 0xFF
STEP_PINS = ((16, 17), (20, 21), (23, 24))  # PB0 PB1, PB4 PB5, PB7 PB8
PERIOD = 600  # ticks: 120 kHz
STEP_OID, AXIS_PINS = 1, (16, 17)  # PB0, PB1
TRAVEL = 50_000  # steps a second


@dataclass
class Sampling:
    """A run with the bridge sampled: `records` as the firmware reports them, `given` samples by clock, counters before
    and after."""

    chip: Firmware
    records: list[tuple[int, Row]]  # clock of the first sample, record
    given: dict[int, int]
    before: dict[str, Any]
    after: dict[str, Any]
    steps_asked: int
    steps_made: int
    phases: list[tuple[int, int, int]]  # asked, seen by the world, in the compare registers

    @property
    def samples(self) -> int:
        return int(self.after["samples"] - self.before["samples"])

    def spent(self, exception: int) -> int:
        return int(self.after["spent"].get(exception, 0) - self.before["spent"].get(exception, 0))


def code_at(clock: int) -> int:
    """What the ADC gives at a clock: no two neighbours alike, nothing periodic, nothing the guard calls clipped."""
    n = clock // PERIOD
    return 40 + ((n * 2654435761 >> 7 ^ n * 40503) & 0xFFF) % 4000


def moving_code(chip: Firmware) -> Callable[[int], int]:
    """A signal that moves with the sampling instant, as tests of the signal expect."""

    def code(clock: int) -> int:
        moved = chip.sampling_moves[-1][1] if chip.sampling_moves else 0
        return 1000 + clock // PERIOD % 3 + 12 * moved

    return code


def sampling_unit(
    block: tuple[int, int] = (192, 2),
    period: int = PERIOD,
    adc_pin: int = 0,
    before: tuple[tuple[str, dict[str, int]], ...] = (),
    beside: tuple[tuple[str, dict[str, int]], ...] = (),
    **options: Any,
) -> Firmware:
    """The induction heater configured, sampling, reporting; an axis; objects (oids from 2) before and after them."""
    chip = Firmware(**options)
    config = {"oid": 0, "bridge": 0, "adc_pin": adc_pin, "period_ticks": period, "phase_max": 45000}
    stepper = {
        "step_pin": AXIS_PINS[0],
        "dir_pin": AXIS_PINS[1],
        "invert_step": BOTH_EDGES,
        "step_pulse_ticks": 0,
    }
    chip.configure(
        2 + len(before) + len(beside),
        *before,
        ("config_induction", config | {"max_duration": FREQ // 2}),
        ("config_induction_sense", {"oid": 0, "oversample": 5, "settle_samples": 20, "ema_shift": 0}),
        ("config_induction_block", {"oid": 0, "samples": block[0], "records": block[1]}),
        ("config_stepper", {"oid": STEP_OID} | stepper),
        *beside,
    )
    return chip


def clock_offset(chip: Firmware) -> int:
    """The world's clock less the firmware's, which begins when the firmware starts its timer."""
    return (chip.chip.peek("ticks") - chip.chip.peek("tim2.count")) % 2**32


# All tests of the signal, at the interval of the product, with limits that any signal keeps whose moves are positive.
SIGNAL_TESTS = {
    "oid": 0,
    "moved_low": 0,
    "moved_high": 65535,
    "off_low": 0,
    "off_high": 65535,
    "interval": 1200,
}
SIGNAL_TESTS |= {"phase": 2012, "jump": 65535, "rise": 0, "fall": 0, "tolerance": 255, "slack": 65535}


def run_sampling(
    seconds: float, block: tuple[int, int] = (192, 2), steps_hz: int = TRAVEL, *, tests: bool = False
) -> Sampling:
    """Heat with changing phases, step an axis, sample and report, for so long."""
    chip = sampling_unit(block, beside=(("config_induction_test", SIGNAL_TESTS),) if tests else ())
    given: dict[int, int] = {}

    code = moving_code(chip) if tests else code_at

    def sample(clock: int) -> int:
        given[clock] = code(clock)
        return given[clock]

    chip.sample_code = sample
    offset = clock_offset(chip)
    start = chip.now - offset + round(0.2 * FREQ)
    chip.send("induction_report", oid=0, enable=1)
    chip.send("reset_step_clock", oid=STEP_OID, clock=start & 0xFFFFFFFF)
    chip.send("set_next_step_dir", oid=STEP_OID, dir=0)
    chip.run(0.02)
    before = chip.chip.counters()
    asked, phases = 0, []
    end = chip.now + round(seconds * FREQ)
    turn = 0
    while chip.now < end:
        # some ten orders ahead of the motor, as a host does; the phase ten times a second
        if steps_hz:
            while asked * FREQ // steps_hz < chip.now - offset - start + round(0.1 * FREQ):
                chip.post("queue_step", oid=STEP_OID, interval=FREQ // steps_hz, count=1000, add=0)
                asked += 1000
        phase = 3000 + (turn * 7919) % 42000
        clock = (chip.now - offset + FREQ // 200) & 0xFFFFFFFF
        chip.post("queue_induction_plan", oid=0, clock=clock, steps=one_step(phase))
        chip.run(0.03)
        if not tests:  # one may have the bridge off now
            phases.append((phase, chip.bridge_sets[-1][1], chip.chip.peek("hrtim.lag")))
        turn += 1
    after = chip.chip.counters()
    assert chip.shutdown_reason() is None, chip.shutdown_reason()
    while asked * FREQ // (steps_hz or FREQ) > chip.now - offset - start:
        chip.run(0.02)
        clock = (chip.now - offset) & 0xFFFFFFFF
        chip.post("queue_induction_plan", oid=0, clock=clock, steps=one_step(3000))
    chip.send("induction_report", oid=0, enable=0)
    chip.run(0.05)
    made = abs(int(chip.ask("stepper_get_position", oid=STEP_OID)["pos"]))
    return Sampling(chip, records_of(chip, offset, block[0]), given, before, after, asked, made, phases)


def everything_cost(block: tuple[int, int], seconds: float = 0.5) -> float:
    """Instructions a sample of all that sampling brings: interrupts, blocks, guard, tasks, records written and sent.

    What the chip spends without sampling is taken off.
    """
    chip = sampling_unit(block)
    chip.sample_code = code_at

    def spent() -> tuple[int, int]:
        before = chip.chip.counters()
        chip.run(seconds)
        after = chip.chip.counters()
        return after["instructions"] - before["instructions"], after["samples"] - before["samples"]

    idle, _ = spent()
    chip.send("induction_report", oid=0, enable=1)
    chip.run(0.05)
    busy, samples = spent()
    return (busy - idle) / samples


def records_of(chip: Firmware, offset: int, block_len: int) -> list[tuple[int, Row]]:
    """All records reported, with the world's clock of their first sample."""
    out = []
    for message in chip.replies("induction_block"):
        for row in unpack(bytes(message["data"]), block_len):
            firmware_clock = message["clock"] + row.offset * PERIOD
            near = message.clock - offset
            clock = near + ((firmware_clock - near + 2**31) % 2**32 - 2**31) + offset
            out.append((clock, row))
    return out
