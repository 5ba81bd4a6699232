"""Steps and commands a second, by the procedure of Klipper's Benchmarks page, on the image of any chip.

https://www.klipper3d.org/Benchmarks.html: every stepper is given 60000 steps of one interval from the same clock on;
the result is the shortest interval at which all are made and nothing shuts down; here they must also come in time, so
that fewer steps give nearly the same. Steps on both edges of the pin, as there where Klipper can; its AVR figures are
with pulses (`pulse_ticks`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import measure
from chip_rig import FREQ, Firmware
from mega_rig import MEGA_HZ, Mega
from mega_rig import STEP_PINS as MEGA_PINS

BOTH_EDGES = 0xFF
STEPS = 60000  # of each stepper
LATE_S = 0.001  # the last step may be: what is behind by more goes on falling behind


@dataclass(frozen=True)
class Published:
    """Klipper's figures for a like chip: ticks between steps, by number of steppers; commands a second.

    `pulse_ticks`: of the step pulses it made, 0 if it stepped on both edges.
    """

    chip: str
    clock_hz: int
    ticks: dict[int, int]
    commands_per_s: int
    pulse_ticks: int = 0

    def steps_per_s(self, steppers: int) -> float:
        return steppers * self.clock_hz / self.ticks[steppers]


@dataclass(frozen=True)
class Figures:
    """What the documentation says of our firmware: instructions a step and ticks between steps by number of steppers,
    instructions a command."""

    step_instructions: dict[int, int]
    command_instructions: int
    ticks: dict[int, int]


@dataclass(frozen=True)
class Bench:
    """How to put a chip through it. `cycles_per_instruction`: as the emulator assumes; 0: it counts exactly."""

    name: str
    clock_hz: int
    pins: tuple[tuple[int, int], ...]
    cycles_per_instruction: int
    published: Published
    documented: Figures

    def steps_per_s(self, steppers: int) -> float:
        return steppers * self.clock_hz / self.documented.ticks[steppers]

    def power_on(self) -> Firmware:
        return Mega() if self.name == "atmega2560" else Firmware(self.name)

    def run(self, chip: Firmware, ticks: int) -> None:
        chip.run_to(chip.now + ticks)
        chip._blocks()
        assert not chip.fault(), chip.fault()


BENCHES = {
    "stm32f334": Bench(
        "stm32f334",
        FREQ,
        measure.STEP_PINS,
        measure.CYCLES_PER_INSTRUCTION,
        Published("STM32F103, 72 MHz", 72_000_000, {1: 61, 3: 264}, 355_000),
        Figures({1: 130, 3: 77}, 93, {1: 49, 3: 258}),
    ),
    "atmega2560": Bench(
        "atmega2560",
        MEGA_HZ,
        MEGA_PINS,
        0,
        Published("AVR, 16 MHz", 16_000_000, {1: 102, 3: 486}, 23_000, 32),
        Figures({1: 352, 3: 193}, 276, {1: 90, 3: 438}),
    ),
}


@dataclass(frozen=True)
class Cost:
    """Of one: exact instructions; cycles of the processor, exact or assumed."""

    instructions: float
    cycles: float


def _steppers(bench: Bench, count: int, pulse_ticks: int) -> Firmware:
    chip = bench.power_on()
    edge = {"invert_step": 0, "step_pulse_ticks": pulse_ticks} if pulse_ticks else {"invert_step": BOTH_EDGES}
    rest: dict[str, Any] = {"step_pulse_ticks": 0} | edge
    chip.configure(
        count,
        *(
            ("config_stepper", {"oid": oid, "step_pin": step, "dir_pin": direction} | rest)
            for oid, (step, direction) in enumerate(bench.pins[:count])
        ),
    )
    return chip


def _start(bench: Bench, chip: Firmware, steppers: int, interval: int, steps: int) -> int:
    """Queue them; returns ticks until the last is due."""
    lead = bench.clock_hz // 10
    now = chip.ask("get_clock")["clock"]
    clock = (now + lead) & 0xFFFFFFFF
    for oid in range(steppers):
        chip.send("reset_step_clock", oid=oid, clock=clock)
        chip.send("set_next_step_dir", oid=oid, dir=0)
        chip.send("queue_step", oid=oid, interval=interval, count=steps, add=0)
    return lead + interval * steps


def completes(bench: Bench, steppers: int, interval: int, steps: int = STEPS, pulse_ticks: int = 0) -> bool:
    """Are they all made, one after the other at that interval, without a shutdown?"""
    chip = _steppers(bench, steppers, pulse_ticks)
    until = _start(bench, chip, steppers, interval, steps)
    while until > 0 and chip.shutdown_reason() is None:  # a tenth of a second at a time: failures show early
        bench.run(chip, bench.clock_hz // 10)
        until -= bench.clock_hz // 10
    bench.run(chip, bench.clock_hz // 10)
    per_step = 2 if pulse_ticks else 1
    if chip.shutdown_reason() is not None:
        return False
    for pin, _ in bench.pins[:steppers]:
        edges = [clock for clock, _ in chip.edges(pin)[1:]]
        longest = interval * (steps - 1) + LATE_S * bench.clock_hz
        if len(edges) != per_step * steps or edges[-per_step] - edges[0] > longest:
            return False
    return True


def shortest_interval(bench: Bench, steppers: int, steps: int = STEPS, pulse_ticks: int = 0) -> int:
    """Ticks: bisection, as on the page."""
    low, high = 20, 4000
    assert completes(bench, steppers, high, min(steps, 2000), pulse_ticks), "not even slow steps are made"
    while high - low > 1:
        middle = (low + high) // 2
        if completes(bench, steppers, middle, steps, pulse_ticks):
            high = middle
        else:
            low = middle
    return high


def _cycles(bench: Bench, chip: Firmware) -> float:
    """In interrupts, so far."""
    if not bench.cycles_per_instruction:
        return chip.chip.peek("ticks.interrupt")
    return bench.cycles_per_instruction * chip.chip.counters()["interrupt_instructions"]


def step_cost(bench: Bench, steppers: int) -> Cost:
    """Of one step in the timer's interrupt, with time between the steps: a long queue less a short one.

    What goes on all the time (clock overflows, house-keeping) is taken off by a chip that only waits for as long.
    """
    interval, lengths, spent = bench.clock_hz // 4000, (200, 1200), []
    for steps in lengths:
        figures = []
        for moving in (steppers, 0):
            chip = _steppers(bench, steppers, 0)
            before = chip.chip.counters()["interrupt_instructions"], _cycles(bench, chip)
            until = _start(bench, chip, moving, interval, steps)
            chip.run_to(chip.now + until)
            after = chip.chip.counters()["interrupt_instructions"], _cycles(bench, chip)
            figures.append((after[0] - before[0], after[1] - before[1]))
        spent.append((figures[0][0] - figures[1][0], figures[0][1] - figures[1][1]))
    count = (lengths[1] - lengths[0]) * steppers
    return Cost((spent[1][0] - spent[0][0]) / count, (spent[1][1] - spent[0][1]) / count)


def command_cost(bench: Bench, blocks: int = 60, commands: int = 40) -> Cost:
    """Of one command with no work of its own, forty to a block: receiving, checking, acknowledging included."""
    chip = bench.power_on()
    content = chip.encode("debug_nop") * commands
    chip.send_content(content)

    def spent(work: bool) -> tuple[float, float, int]:
        begin, before = chip.now, chip.chip.counters()
        if work:
            for _ in range(blocks):
                chip.send_content(content)
        else:
            chip.run_to(chip.now + elapsed)
        after = chip.chip.counters()
        busy = (after["ticks"] - before["ticks"]) - (after["idle_ticks"] - before["idle_ticks"])
        return after["instructions"] - before["instructions"], busy, chip.now - begin

    elapsed = 0
    instructions, busy, elapsed = spent(True)
    idle_instructions, idle_busy, _ = spent(False)
    count = blocks * commands
    mean = (instructions - idle_instructions) / count
    exact = (busy - idle_busy) / count
    return Cost(mean, bench.cycles_per_instruction * mean if bench.cycles_per_instruction else exact)
