#!/usr/bin/env python3
"""Does the buffer of motion ever run dry, and does a long print leak? (`make bench-steady`; QUICK=1: a short run)

0. On the idle printer: how long objects/query takes, and from a line of G-code to its first step.
1. The simulated printer behind a pseudo terminal and klippy.py as a process of its own, in real time, as with a real
   board. Beside them one process per core that is busy for 60 % of the time, and the host is stopped for 20 ms at
   random moments, once a second on average. It prints lines of 0.8 mm at 60 mm/s (75 moves a second), then of 0.5 mm
   at 100 mm/s (200 moves a second). Reported: how far the plan was ahead of the machine at least, and stalls.
2. Batch mode over one hour and over ten hours of motion: the peak memory of both processes.

Exit status 1 if the print stalled or stopped, or if ten hours need more memory than one.
"""

from __future__ import annotations

from bench_paths import ROOT  # isort: skip

import argparse
import multiprocessing
import os
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import bench_api
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
serial: {folder}/tty
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


def idle_latency(path: Path) -> tuple[float, float]:
    """(median time of an objects/query in ms, time in s from a line of G-code to its first step), of a homed printer
    at rest."""
    import motion_plot  # not before the batch runs: a child's peak memory begins with that of its parent

    host = motion_plot.LiveHost(str(path))
    query = {"objects": {"toolhead": None}}
    times = []
    for _ in range(QUERIES):
        begin = time.monotonic()
        host.ask("objects/query", query)
        times.append(time.monotonic() - begin)
    template = {"kind": "stepper", "name": "stepper_x"}
    host.ask("motion_report/dump_stepper", {"name": "stepper_x", "response_template": template})
    time.sleep(1.0)
    now = host.ask("objects/query", query)["status"]["toolhead"]["estimated_print_time"]
    host.ask("gcode/script", {"script": "G91\nG1 X5 F6000\nG90"})
    host.collect(2.0)
    if "stepper_x" not in host.motors:
        raise bench_api.BenchError("no step came out of a line of G-code")
    return 1e3 * statistics.median(times), host.motors["stepper_x"][0]["first_time"] - now


def watch(client: bench_api.Client, seconds: float) -> Steadiness:
    """Look at the toolhead while it prints."""
    result = Steadiness(seconds=seconds)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        time.sleep(POLL_S)
        status = client.ask(
            "objects/query",
            objects={"toolhead": None, "print_stats": ["state"], "webhooks": ["state", "state_message"]},
        )["status"]
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
    config = folder / "printer.cfg"
    rails = "".join(
        bench_motion.RAIL.format(axis=axis, port=port, microsteps=16, rotation=turn, homing=homing)
        + f"[simulator axis {axis}]\n"
        for axis, port, turn, homing in (("x", "A", 40, 80), ("y", "B", 40, 80), ("z", "C", 8, 12))
    )
    config.write_text(CONFIG.format(folder=folder, rails=rails))
    lines = ["G28", *zigzag(0.6 * seconds, 0.8, 60.0), *zigzag(0.8 * seconds, 0.5, 100.0)]
    (folder / "part.gcode").write_text("\n".join(lines) + "\n")
    machine = [
        sys.executable,
        str(ROOT / "scripts" / "run_simulator.py"),
        str(config),
        "--pty",
        f"{folder}/tty",
    ]
    host = [sys.executable, str(ROOT / "klippy" / "klippy.py"), str(config), "-a", f"{folder}/sock"]
    host += ["-l", f"{folder}/klippy.log"]
    processes = [subprocess.Popen(machine, stdout=subprocess.DEVNULL)]
    ended = threading.Event()
    burners: list[multiprocessing.Process] = []
    try:
        time.sleep(2.0)
        processes.append(subprocess.Popen(host, stdout=subprocess.DEVNULL))
        client = bench_api.connect(folder / "sock")
        client.sock.settimeout(60.0)
        client.ask("gcode/script", script="G28\nM400")
        query_ms, first_step_s = idle_latency(folder / "sock")
        client.ask("gcode/script", script="SDCARD_PRINT_FILE FILENAME=part.gcode")
        for _ in range(os.cpu_count() or 1):
            burner = multiprocessing.Process(
                target=burn, args=(time.monotonic() + seconds + 60.0,), daemon=True
            )
            burner.start()
            burners.append(burner)
        time.sleep(12.0)  # homing
        holder = threading.Thread(
            target=hold_up, args=(processes[1].pid, ended, random.Random(1)), daemon=True
        )
        holder.start()
        result = watch(client, seconds)
        result.query_ms, result.first_step_s = query_ms, first_step_s
        return result
    finally:
        ended.set()
        time.sleep(2.0 * STALL_S)
        for burner in burners:
            burner.kill()
        for process in reversed(processes):
            process.terminate()
            process.wait()


def batch_memory_mb(folder: Path, hours: float) -> float:
    """Peak memory of a batch run over so much motion."""
    (folder / "bench.dict").write_text(bench_motion.json.dumps(bench_motion.dictionary()))
    config = folder / "batch.cfg"
    config.write_text(bench_motion.Case("cartesian", 16, True).config())
    gcode = folder / "long.gcode"
    with gcode.open("w") as out:
        out.write("G28\nM83\nG1 Z1\n")
        for _ in range(round(hours * 12)):
            out.write("\n".join(zigzag(300.0, 0.8, 60.0)) + "\n")
    command = [sys.executable, str(ROOT / "klippy" / "klippy.py"), str(config), "-i", str(gcode)]
    command += ["-o", os.devnull, "-d", str(folder / "bench.dict")]
    peak_mb = bench_motion.run(command, by_clock=False).peak_mb
    gcode.unlink()
    return peak_mb


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=120.0, help="of printing under load")
    parser.add_argument("--hours", type=float, default=10.0, help="of motion in the long batch run")
    parser.add_argument("--skip-print", action="store_true")
    options = parser.parse_args(argv)
    missed = []
    with tempfile.TemporaryDirectory() as name:
        try:
            # first: what runs as a child begins with the memory of this process
            short, long = (
                batch_memory_mb(Path(name), options.hours / 10.0),
                batch_memory_mb(Path(name), options.hours),
            )
            if not options.skip_print:
                steady = print_under_load(Path(name), options.seconds)
        except (bench_api.BenchError, bench_motion.BenchError) as e:
            print(f"bench_steady: {e}", file=sys.stderr)
            return 2
    print(
        f"batch, {options.hours / 10:g} h and {options.hours:g} h of motion: peak {short:.1f} and {long:.1f} MB"
    )
    if long > short + GROWTH_MAX_MB:
        missed.append("a long print needs more memory")
    if not options.skip_print:
        print(
            f"idle: objects/query {steady.query_ms:.2f} ms, first step {steady.first_step_s:.3f} s after its line"
        )
        print(
            f"{steady.seconds:.0f} s in real time under load: plan ahead by {steady.min_ahead_s:.2f} s at least,"
        )
        print(f"{steady.stalls} stalls")
        missed += steady.faults
        if steady.stalls:
            missed.append("the print stalled")
    for text in missed:
        print(f"MISSED: {text}")
    return int(bool(missed))


if __name__ == "__main__":
    sys.exit(main())
