"""What the firmware costs on a chip: instructions a step, a command, a sample; counted, so free of noise.

Instruction counts are exact. Rates made from them assume the emulator's two cycles an instruction.
"""

from __future__ import annotations

from dataclasses import dataclass

from chip_rig import FREQ, Firmware

CYCLES_PER_INSTRUCTION = 2  # CORE_CYCLES_PER_INSTRUCTION of src/emulator/core.h
BOTH_EDGES = 0xFF
STEP_PINS = ((16, 17), (20, 21), (23, 24))  # PB0 PB1, PB4 PB5, PB7 PB8


@dataclass(frozen=True)
class Cost:
    """`instructions` for one of them, `rate_hz` that fit into a second at the assumed cycles."""

    instructions: float

    @property
    def rate_hz(self) -> float:
        return FREQ / (self.instructions * CYCLES_PER_INSTRUCTION)


def _steppers(count: int) -> Firmware:
    chip = Firmware()
    chip.configure(
        count,
        *(
            (
                "config_stepper",
                {"oid": oid, "step_pin": pin, "dir_pin": dir_pin, "invert_step": BOTH_EDGES, "step_pulse_ticks": 0},
            )
            for oid, (pin, dir_pin) in enumerate(STEP_PINS[:count])
        ),
    )
    return chip


def _run_steps(chip: Firmware, steppers: int, interval: int, steps: int) -> int:
    """All steppers at once, from the same clock; returns the chip's instructions over steps and a little more."""
    clock = int(chip.ask("get_clock")["clock"]) + round(0.2 * FREQ)
    for oid in range(steppers):
        chip.send("reset_step_clock", oid=oid, clock=clock & 0xFFFFFFFF)
        chip.send("set_next_step_dir", oid=oid, dir=0)
        chip.send("queue_step", oid=oid, interval=interval, count=steps, add=0)
    before = chip.chip.counters()["instructions"]
    chip.run(0.25 + interval * steps / FREQ)
    return int(chip.chip.counters()["instructions"] - before)


def step_cost(steppers: int = 1) -> Cost:
    """Of one step in its interrupt, from the difference between a long and a short queue: what else goes on falls out.

    The tasks that look for work after every interrupt are not in it; under load they have less and less turns.
    """
    interval, short, long = 3000 * steppers, 1000, 6000
    counts = []
    for steps in (short, long):
        chip = _steppers(steppers)
        before = chip.chip.counters()["interrupt_instructions"]
        _run_steps(chip, steppers, interval, steps)
        counts.append(chip.chip.counters()["interrupt_instructions"] - before)
    return Cost((counts[1] - counts[0]) / ((long - short) * steppers))


def step_limit(steppers: int = 1, steps: int = 3000) -> float:
    """Ticks between two steps of one motor when they are asked for faster than they can be made: the saturated rate.

    For some milliseconds the firmware makes late steps as fast as it can; longer, and it shuts down.
    """
    chip = _steppers(steppers)
    _run_steps(chip, steppers, 20, steps)
    clocks = [clock for clock, _ in chip.edges(STEP_PINS[0][0])]
    assert len(clocks) >= steps, f"{len(clocks)} of {steps} steps: {chip.shutdown_reason()}"
    return (clocks[-1] - clocks[-steps]) / (steps - 1)


def dispatch_cost(commands: int = 40) -> Cost:
    """Of one command with no work of its own, many to a block, receiving and acknowledging included."""
    chip = Firmware()
    counts = []
    for blocks in (10, 110):
        before = chip.chip.counters()["instructions"]
        for _ in range(blocks):
            chip.send_content(chip.encode("debug_nop") * commands)
        counts.append((chip.chip.counters()["instructions"] - before, chip.now))
    waiting = Firmware()
    before = waiting.chip.counters()["instructions"]
    waiting.run(1.0)
    idle_per_s = waiting.chip.counters()["instructions"] - before
    (few, first), (many, second) = counts
    return Cost((many - idle_per_s * (second - first) / FREQ) / (110 * commands))
