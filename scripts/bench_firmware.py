#!/usr/bin/env python3
"""What the firmware costs on a chip, measured on its image: sampling, interrupts, steps, commands, stack, memory.

    make bench-firmware            (or scripts/bench_firmware.py [--json FILE] [--quick])

Instructions are counted and exact. Times and rates assume the emulator's two cycles an instruction (docs/Emulation.md).
Beside them stand the figures that Klipper publishes for a like chip (STM32F103, 72 MHz, https://www.klipper3d.org/Benchmarks.html
and Features.html), which were taken on hardware.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
for folder in ("klippy", "test", "test/firmware"):
    sys.path.insert(0, str(ROOT / folder))

import measure  # type: ignore[import-not-found]  # noqa: E402
from chip_rig import FREQ, Firmware  # type: ignore[import-not-found]  # noqa: E402

SAMPLES_IRQ, TIMER_IRQ = 16 + 11, 16 + 28
KLIPPER_STEPS_K = {1: 1180, 3: 818}  # thousand steps a second, one and three steppers (all three together)
KLIPPER_COMMANDS_K = 355


def memory(chip: Firmware) -> dict[str, int]:
    """Flash and static RAM of the image, B."""
    out = subprocess.run(
        ["arm-none-eabi-size", str(chip.image)], capture_output=True, text=True, check=True
    ).stdout.splitlines()[1]
    text, data, bss = (int(word) for word in out.split()[:3])
    return {"flash_bytes": text + data, "static_ram_bytes": data + bss}


def sampling(seconds: float) -> dict[str, Any]:
    """The bridge sampled at 120 kHz while an axis steps at 50,000 steps a second, the phase changing."""
    began = time.perf_counter()
    run = measure.run_sampling(seconds)
    wall = time.perf_counter() - began
    after = run.after
    awake = 1.0 - (after["idle_ticks"] - run.before["idle_ticks"]) / (after["ticks"] - run.before["ticks"])
    counters = run.chip.chip.counters()
    return {
        "seconds": seconds,
        "samples": run.samples,
        "samples_lost": after["samples_lost"] + sum(row.lost for _, row in run.records),
        "steps_asked": run.steps_asked,
        "steps_made": run.steps_made,
        "sampling_instructions_per_sample": round(run.spent(SAMPLES_IRQ) / run.samples, 3),
        "longest_sampling_interrupt_us": round(after["longest_ticks"][SAMPLES_IRQ] / FREQ * 1e6, 1),
        "longest_timer_interrupt_us": round(after["longest_ticks"][TIMER_IRQ] / FREQ * 1e6, 1),
        "longest_wait_of_an_interrupt_us": round(after["worst_latency_ticks"] / FREQ * 1e6, 1),
        "processor_awake_percent": round(100.0 * awake, 1),
        "stack_used_bytes": counters["stack_top"] - counters["stack_low"],
        "stack_bytes": counters["stack_top"] - counters["stack_limit"],
        "emulator_times_real": round(seconds / wall, 2),
        **memory(run.chip),
    }


def idle_speed() -> float:
    """Simulated seconds a second of a chip that sleeps."""
    chip = Firmware()
    began = time.perf_counter()
    chip.run(20.0)
    return 20.0 / (time.perf_counter() - began)


def rates() -> dict[str, Any]:
    """Steps and commands."""
    result: dict[str, Any] = {}
    for steppers in (1, 3):
        result[f"step_instructions_{steppers}"] = round(measure.step_cost(steppers).instructions, 1)
        interval = measure.step_limit(steppers)
        result[f"steps_per_s_{steppers}"] = round(steppers * FREQ / interval)
    command = measure.dispatch_cost()
    result["command_instructions"] = round(command.instructions, 1)
    result["commands_per_s"] = round(command.rate_hz)
    return result


def tell(figures: dict[str, Any]) -> None:
    def line(text: str, value: object, note: str = "") -> None:
        print(f"  {text:<46} {value!s:>12}  {note}")

    f = figures
    print("STM32F334 image on the emulator (2 cycles an instruction assumed for all times)")
    line("flash, B", f["flash_bytes"], "of 57344 allowed")
    line("static RAM, B", f["static_ram_bytes"], "the rest up to 11264 is objects, moves and stack")
    line("stack used, B", f["stack_used_bytes"], f"of {f['stack_bytes']}")
    line("samples", f["samples"], f"in {f['seconds']:g} s, {f['samples_lost']} lost")
    line("steps beside it", f["steps_made"], f"of {f['steps_asked']} asked for, 50,000 a second")
    line("instructions a sample", f["sampling_instructions_per_sample"], "whole interrupt, blocks and guard")
    line("longest sampling interrupt, us", f["longest_sampling_interrupt_us"])
    line("longest timer interrupt, us", f["longest_timer_interrupt_us"], "with what preempts it: nothing")
    line("longest wait of an interrupt, us", f["longest_wait_of_an_interrupt_us"])
    line("processor awake, %", f["processor_awake_percent"])
    for n in (1, 3):
        line(
            f"steps a second, {n} stepper{'s' * (n > 1)}",
            f[f"steps_per_s_{n}"],
            f"{f[f'step_instructions_{n}']} instructions a step; Klipper, STM32F103: {KLIPPER_STEPS_K[n]}K",
        )
    line(
        "commands a second",
        f["commands_per_s"],
        f"{f['command_instructions']} instructions each; Klipper, STM32F103: {KLIPPER_COMMANDS_K}K",
    )
    line("emulator, times real: asleep", f["emulator_idle_times_real"])
    line("emulator, times real: this load", f["emulator_times_real"])


def main(argv: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description="Measure the firmware on the image for a chip.")
    parser.add_argument("--json", type=Path, metavar="FILE", help="the figures")
    parser.add_argument("--quick", action="store_true", help="one second instead of ten")
    options = parser.parse_args(argv)
    figures = sampling(1.0 if options.quick else 10.0) | rates()
    figures["emulator_idle_times_real"] = round(idle_speed(), 1)
    tell(figures)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    held = figures["samples_lost"] == 0 and figures["steps_made"] == figures["steps_asked"]
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
