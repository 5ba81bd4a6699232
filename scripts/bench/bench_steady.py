#!/usr/bin/env python3
"""Does the buffer of motion ever run dry, and does a long print leak? (`make bench-steady`; QUICK=1: a short run)

0. On the idle printer: how long objects/query takes, and from a line of G-code to its first step.
1. The simulated printer behind a pseudo terminal and klippy.py as a process of its own, in real time, as with a real
   board. Beside them one process per core that is busy for 60 % of the time, and the host is stopped for 20 ms at
   random moments, once a second on average. It prints lines of 0.8 mm at 60 mm/s (75 moves a second), then of 0.5 mm
   at 100 mm/s (200 moves a second). Reported: how far the plan was ahead of the machine at least, and stalls.
2. Batch mode over one hour and over ten hours of motion: the peak memory of both processes.
"""

from __future__ import annotations

import harness
from harness import Client

import argparse
import math
import multiprocessing
import os
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import bench_motion

BUSY_SHARE = 0.6
BUSY_CYCLE_S = 0.010
STALL_S = 0.020
STALLS_PER_S = 1.0
POLL_S = 0.1
QUERIES = 200
GROWTH_MAX_MB = 2.0  # allocator noise; the smallest leak per move (8 bytes) would be 20 MB in nine hours


# No heaters: what is measured is motion, and the model of the nozzle takes processor time from the host
CONFIG = """[mcu]
restart_method: command
[printer]
kinematics: cartesian
max_velocity: 200
max_accel: 3000
[virtual_sdcard]
path: {folder}
{rails}"""


@dataclass(slots=True)
class Steadiness:
    """What the real-time print was like."""

    min_ahead_s: float = float("inf")
    stalls: int = 0
    seconds: float = 0.0
    faults: list[str] = field(default_factory=list)
    query_ms: float = 0.0  # median
    first_step_s: float = 0.0


def burn(stop_at: float) -> None:
    """Be busy for BUSY_SHARE of the time."""
    while time.monotonic() < stop_at:
        until = time.monotonic() + BUSY_SHARE * BUSY_CYCLE_S
        while time.monotonic() < until:
            pass
        time.sleep((1.0 - BUSY_SHARE) * BUSY_CYCLE_S)


def hold_up(pid: int, ended: threading.Event, rng: random.Random) -> None:
    """Stop a process for STALL_S now and then."""
    while not ended.wait(rng.expovariate(STALLS_PER_S)):
        try:
            os.kill(pid, signal.SIGSTOP)
            time.sleep(STALL_S)
            os.kill(pid, signal.SIGCONT)
        except ProcessLookupError:
            return


def zigzag(seconds: float, chord_mm: float, speed_mm_s: float) -> list[str]:
    """Lines of short chords for about so long."""
    lines = [f"G1 X40 Y40 F{speed_mm_s * 60:.0f}"]
    per_line = int(80.0 / chord_mm)
    for number in range(int(seconds * speed_mm_s / chord_mm)):
        row, along = divmod(number, per_line)
        along = along if row % 2 == 0 else per_line - 1 - along
        lines.append(f"G1 X{40 + along * chord_mm:.3f} Y{40 + (row % 80) * 0.8:.3f}")
    return lines


def idle_latency(client: Client) -> tuple[float, float]:
    """(median time of an objects/query in ms, time in s from a line of G-code to its first step), of a homed printer
    at rest."""
    times = []
    for _ in range(QUERIES):
        begin = time.monotonic()
        client.status(toolhead=None)
        times.append(time.monotonic() - begin)
    template = {"kind": "stepper"}
    client.ask("motion_report/dump_stepper", name="stepper_x", response_template=template)
    time.sleep(1.0)
    now = client.status(toolhead=None)["toolhead"]["estimated_print_time"]
    client.send("gcode/script", script="G91\nG1 X5 F6000\nG90")
    answered, first_s = False, math.nan
    while not answered or math.isnan(first_s):
        message = client.receive()
        answered |= message.get("id") == 1
        if message.get("kind") == "stepper" and math.isnan(first_s):
            first_s = message["params"]["first_time"]
    return 1e3 * statistics.median(times), first_s - now


def watch(client: Client, seconds: float) -> Steadiness:
    """Look at the toolhead while it prints."""
    result = Steadiness(seconds=seconds)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(POLL_S)
        status = client.status(toolhead=None, print_stats=["state"], webhooks=None)
        if status["webhooks"]["state"] != "ready":
            result.faults.append(status["webhooks"]["state_message"])
            break
        if status["print_stats"]["state"] != "printing":
            break
        toolhead = status["toolhead"]
        ahead_s = toolhead["print_time"] - toolhead["estimated_print_time"]
        result.min_ahead_s = min(result.min_ahead_s, ahead_s)
        result.stalls = toolhead["stalls"]
    return result


def print_under_load(folder: Path, seconds: float) -> Steadiness:
    """The whole of part 1."""
    rails = "".join(
        bench_motion.RAIL.format(axis=axis, port=port, microsteps=16, rotation=turn, homing=homing)
        + f"[simulator axis {axis}]\n"
        for axis, port, turn, homing in (("x", "A", 40, 80), ("y", "B", 40, 80), ("z", "C", 8, 12))
    )
    lines = ["G28", *zigzag(0.6 * seconds, 0.8, 60.0), *zigzag(0.8 * seconds, 0.5, 100.0)]
    (folder / "part.gcode").write_text("\n".join(lines) + "\n")
    ended = threading.Event()
    burners: list[multiprocessing.Process] = []
    with harness.printer(folder, CONFIG.format(folder=folder, rails=rails)) as (client, pid):
        try:
            client.ask("gcode/script", script="G28\nM400")
            query_ms, first_step_s = idle_latency(client)
            client.ask("gcode/script", script="SDCARD_PRINT_FILE FILENAME=part.gcode")
            until = time.monotonic() + seconds + 60.0
            for _ in range(os.cpu_count() or 1):
                burners.append(multiprocessing.Process(target=burn, args=(until,), daemon=True))
                burners[-1].start()
            time.sleep(12.0)  # homing
            threading.Thread(target=hold_up, args=(pid, ended, random.Random(1)), daemon=True).start()
            result = watch(client, seconds)
            result.query_ms, result.first_step_s = query_ms, first_step_s
            return result
        finally:
            ended.set()
            time.sleep(2.0 * STALL_S)
            for burner in burners:
                burner.kill()


def batch_memory_mb(folder: Path, hours: float) -> float:
    """Peak memory of a batch run over so much motion."""
    messages, config, gcode = folder / "bench.dict", folder / "batch.cfg", folder / "long.gcode"
    messages.write_bytes(bench_motion.DICTIONARY)
    config.write_text(bench_motion.Case("cartesian", 16, True).config())
    with gcode.open("w") as out:
        out.write("G28\nM83\nG1 Z1\n")
        for _ in range(round(hours * 12)):
            out.write("\n".join(zigzag(300.0, 0.8, 60.0)) + "\n")
    done = harness.program("klippy/klippy.py", config, "-i", gcode, "-o", os.devnull, "-d", messages)
    gcode.unlink()
    return done.peak_mb


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    if options.quick:
        options.seconds, options.hours = min(options.seconds, 30.0), min(options.hours, 1.0)
    hours = options.hours / 10.0, options.hours
    with tempfile.TemporaryDirectory() as name:
        # first: what runs as a child begins with the memory of this process
        short_mb, long_mb = (batch_memory_mb(Path(name), h) for h in hours)
        report.at_most("growth of memory in the long batch run, MB,", long_mb - short_mb, GROWTH_MAX_MB)
        rows = [
            (f"batch, {h:g} h of motion: peak, MB", f"{mb:.1f}")
            for h, mb in zip(hours, (short_mb, long_mb), strict=True)
        ]
        report.figures["batch_peak_mb"] = short_mb, long_mb
        if not options.skip_print:
            steady = print_under_load(Path(name), options.seconds)
            report.figures["print"] = steady
            report.missed += steady.faults
            report.require(not steady.stalls, f"the print stalled {steady.stalls} times")
            rows += [
                ("idle: objects/query, ms", f"{steady.query_ms:.2f}"),
                ("idle: from a line to its first step, s", f"{steady.first_step_s:.3f}"),
                (
                    f"{steady.seconds:.0f} s in real time under load: plan ahead min, s",
                    f"{steady.min_ahead_s:.2f}",
                ),
                ("stalls", str(steady.stalls)),
            ]
    report.table("", ("", ""), rows)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "30 s of printing, one hour of motion")
    parser.add_argument("--seconds", type=float, default=120.0, help="of printing under load")
    parser.add_argument("--hours", type=float, default=10.0, help="of motion in the long batch run")
    parser.add_argument("--skip-print", action="store_true")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
