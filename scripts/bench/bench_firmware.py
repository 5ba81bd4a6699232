#!/usr/bin/env python3
"""What the firmware costs on each chip, measured on its image: sampling, interrupts, steps, commands, stack, memory.

    make bench-firmware            (or scripts/bench/bench_firmware.py [--json FILE] [--quick])

Instructions are counted and exact. On the STM32F334 times and rates assume the emulator's two cycles an instruction
(docs/reference/Emulation.md); the ATmega2560's cycles are its datasheet's. Steps and commands are measured by the
procedure of Klipper's Benchmarks page (https://www.klipper3d.org/Benchmarks.html), and its figures for a like chip,
which were taken on hardware or in simulavr, stand beside them.
"""

from __future__ import annotations

import harness

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import full_load
import measure
import rates
from chip_rig import FREQ, Firmware

SAMPLES_IRQ, TIMER_IRQ = 16 + 11, 16 + 28
STEPPERS = (1, 3)  # as on Klipper's page
QUICK_STEPS = 20000


def memory(chip: Firmware) -> dict[str, int]:
    """Flash and static RAM of the image, B."""
    out = harness.run("arm-none-eabi-size", chip.image).output.splitlines()[1]
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


def printing(seconds: float) -> dict[str, Any]:
    """A print in closed loop, sampled, and one more axis at 50,000 steps a second."""
    with tempfile.TemporaryDirectory() as folder:
        load = full_load.play(Path(folder), seconds)
    blocks = full_load.check_blocks(load)
    full_load.check_continuity(load)
    longest = load.counters["longest_ticks"]
    return {
        "print_seconds": seconds,
        "print_blocks_exact": blocks,
        "print_phases_as_commanded": full_load.check_phases(load),
        "print_samples_lost": load.counters["samples_lost"],
        "print_longest_interrupt_us": round(max(longest.values()) / FREQ * 1e6, 1),
        "print_stack_used_bytes": load.counters["stack_top"] - load.counters["stack_low"],
    }


def idle_speed() -> float:
    """Simulated seconds a second of a chip that sleeps."""
    chip = Firmware()
    began = time.perf_counter()
    chip.run(20.0)
    return 20.0 / (time.perf_counter() - began)


def speed(bench: rates.Bench, steps: int) -> dict[str, Any]:
    """Steps and commands of one chip."""
    result: dict[str, Any] = {}
    for steppers in STEPPERS:
        cost = rates.step_cost(bench, steppers)
        interval = rates.shortest_interval(bench, steppers, steps)
        result[f"step_instructions_{steppers}"] = round(cost.instructions, 1)
        result[f"step_cycles_{steppers}"] = round(cost.cycles, 1)
        result[f"step_interval_ticks_{steppers}"] = interval
        result[f"steps_per_s_{steppers}"] = round(steppers * bench.clock_hz / interval)
        pulse_ticks = bench.published.pulse_ticks
        if pulse_ticks:
            interval = rates.shortest_interval(bench, steppers, steps, pulse_ticks)
            result[f"pulses_per_s_{steppers}"] = round(steppers * bench.clock_hz / interval)
    command = rates.command_cost(bench)
    result["command_instructions"] = round(command.instructions, 1)
    result["command_cycles"] = round(command.cycles, 1)
    result["commands_per_s"] = round(bench.clock_hz / command.cycles)
    return result


# What a row says: figure, how it is written, what stands beside it.
SAMPLING_ROWS = (
    ("flash, B", "{flash_bytes}", "of 57344 allowed"),
    ("static RAM, B", "{static_ram_bytes}", "the rest up to 11264 is objects, moves and stack"),
    ("stack used, B", "{stack_used_bytes}", "of {stack_bytes}"),
    ("samples", "{samples}", "in {seconds:g} s, {samples_lost} lost"),
    ("steps beside it", "{steps_made}", "of {steps_asked} asked for, 50,000 a second"),
    ("instructions a sample", "{sampling_instructions_per_sample}", "whole interrupt, blocks and guard"),
    ("longest sampling interrupt, us", "{longest_sampling_interrupt_us}", ""),
    ("longest timer interrupt, us", "{longest_timer_interrupt_us}", "with what preempts it: nothing"),
    ("longest wait of an interrupt, us", "{longest_wait_of_an_interrupt_us}", ""),
    ("processor awake, %", "{processor_awake_percent}", ""),
    ("emulator, times real: asleep", "{emulator_idle_times_real}", ""),
    ("emulator, times real: this load", "{emulator_times_real}", ""),
)
PRINT_ROWS = (
    ("samples lost", "{print_samples_lost}", "{print_blocks_exact} blocks, every sum exact"),
    ("changes of phase as commanded", "{print_phases_as_commanded}", "by the compare registers"),
    ("longest interrupt, us", "{print_longest_interrupt_us}", ""),
    ("stack used, B", "{print_stack_used_bytes}", ""),
)


def show(
    report: harness.Report, title: str, rows: tuple[tuple[str, str, str], ...], f: dict[str, Any]
) -> None:
    texts = ((name, value.format(**f), note.format(**f)) for name, value, note in rows)
    report.table(title, ("", "", ""), texts)


def show_speed(report: harness.Report, bench: rates.Bench, f: dict[str, Any]) -> None:
    known = bench.published
    rows = []
    for n in STEPPERS:
        many = f"{n} stepper{'s' * (n > 1)}"
        rows += [
            (f"instructions a step, {many}", f"{{step_instructions_{n}}}", f"{{step_cycles_{n}}} cycles"),
            (
                f"steps a second, {many}",
                f"{{steps_per_s_{n}:,}}",
                f"one every {{step_interval_ticks_{n}}} ticks; Klipper, {known.chip}: {known.steps_per_s(n):,.0f}"
                f" (every {known.ticks[n]})",
            ),
        ]
        if known.pulse_ticks:
            rows.append(
                (f"  as pulses of {known.pulse_ticks} ticks, like Klipper's", f"{{pulses_per_s_{n}:,}}", "")
            )
    there = f"computed; Klipper, {known.chip}: {known.commands_per_s:,}"
    rows += [
        ("instructions a command", "{command_instructions}", "{command_cycles} cycles"),
        ("commands a second", "{commands_per_s:,}", there),
    ]
    how = f"{bench.cycles_per_instruction} cycles an instruction assumed"
    how = how if bench.cycles_per_instruction else "cycles as in the datasheet"
    show(report, f"{bench.name} image at {bench.clock_hz // 10**6} MHz; {how}", tuple(rows), f)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    figures = report.figures
    figures |= sampling(1.0 if options.quick else 10.0)
    figures["emulator_idle_times_real"] = round(idle_speed(), 1)
    title = "STM32F334 image on the emulator, bridge sampled (2 cycles an instruction assumed for all times)"
    show(report, title, SAMPLING_ROWS, figures)
    report.at_most("samples lost", figures["samples_lost"], 0, 0)
    report.at_least("steps made", figures["steps_made"], figures["steps_asked"], 0)
    if not options.quick:
        figures |= printing(10.0)
        title = f"{figures['print_seconds']:g} s of a print in closed loop, and an axis at 50,000 steps/s beside it"
        show(report, title, PRINT_ROWS, figures)
        report.at_most("samples lost in the print", figures["print_samples_lost"], 0, 0)
    for chip in rates.BENCHES.values():
        figures[chip.name] = speed(chip, QUICK_STEPS if options.quick else rates.STEPS)
        show_speed(report, chip, figures[chip.name])


if __name__ == "__main__":
    sys.exit(harness.main(bench, harness.options(__doc__, "one second instead of ten, fewer steps")))
