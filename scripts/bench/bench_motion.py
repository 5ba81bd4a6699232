#!/usr/bin/env python3
"""Throughput of G-code lines to queued steps: many short moves through the whole host (`make bench-motion`).

A generated file (0.5 mm chords: round perimeters, zigzag infill, travels, retracts, relative extrusion) is run by
processes of their own, at 16 and 64 microsteps, cartesian and corexy, without and with pressure advance and input
shaper, in three ways:

    batch   klippy.py -i FILE
    SD      printed by [virtual_sdcard] in batch mode (rigs/sd_host.py)
    live    printed so with the pacing of a print under way, in virtual time: the host's share of a print

Beside the time of each run stands that of an otherwise equal run of a file that only homes, so that moves/s are those
of moves. Time is processor time of the process (with --wall: by the clock), which other work on the machine disturbs
little. The ways take turns.

--peer "COMMAND" runs another host on the same files in the same turn; CONFIG, GCODE, OUT and DICT in it are replaced,
e.g. --peer "kalico CONFIG -i GCODE -o OUT -d DICT". A host that needs other messages than the built-in
dictionary has gets the file after -d itself. The ratio is that of the live print to the peer in batch mode.

Goals: the three ways within 20 % of each other, three times the peer's moves/s, 45 MB.
"""

from __future__ import annotations

import harness
from harness import ROOT

import argparse
import math
import os
import shlex
import statistics
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import batch_messages

MAX_MEMORY_MB = 45.0
MAX_SPREAD = 1.2  # of the slowest way to the fastest
OUR_WAYS = ("batch", "SD", "live")
CHORD_MM = 0.5
FILAMENT_PER_MM = 0.0333  # 0.4 x 0.2 mm lines of 1.75 mm filament
DICTIONARY = batch_messages.dictionary(20e6, STEPPER_STEP_BOTH_EDGE=1, PWM_MAX=255)

RAIL = """[stepper_{axis}]
step_pin: P{port}1
dir_pin: P{port}2
enable_pin: !P{port}3
microsteps: {microsteps}
rotation_distance: {rotation}
endstop_pin: P{port}4
position_endstop: 0
position_max: 200
homing_speed: {homing}
"""
CONFIG = """[mcu]
serial: /tmp/none
restart_method: command
[printer]
kinematics: {kinematics}
max_velocity: 300
max_accel: 5000
max_z_velocity: 12
max_z_accel: 400
{rails}[extruder]
step_pin: PD1
dir_pin: PD2
enable_pin: !PD3
microsteps: {microsteps}
rotation_distance: {e_rotation}
nozzle_diameter: 0.400
filament_diameter: 1.750
max_extrude_only_distance: 100
heater_pin: PF0
sensor_type: Generic 3950
sensor_pin: PF1
control: pid
pid_Kp: 60
pid_Ki: 1.0
pid_Kd: 600
min_temp: 0
max_temp: 300
pressure_advance: {advance}
"""
SHAPER = """[input_shaper]
shaper_freq_x: 48
shaper_freq_y: 40
shaper_type: mzv
"""


@dataclass(frozen=True, slots=True)
class Case:
    """One row of the table."""

    kinematics: str
    microsteps: int
    smooth: bool  # pressure advance and input shaper

    @property
    def title(self) -> str:
        return f"{self.kinematics}, 1/{self.microsteps}, advance and shaper {'on' if self.smooth else 'off'}"

    def config(self) -> str:
        rails = "".join(
            RAIL.format(axis=axis, port=port, microsteps=self.microsteps, rotation=turn, homing=homing)
            for axis, port, turn, homing in (("x", "A", 40, 40), ("y", "B", 40, 40), ("z", "C", 8, 8))
        )
        return CONFIG.format(
            kinematics=self.kinematics, microsteps=self.microsteps, rails=rails, e_rotation=7.6,
            advance=0.05 if self.smooth else 0.0,
        ) + (SHAPER if self.smooth else "")  # fmt: skip


def ring(x: float, y: float, radius: float) -> Iterator[str]:
    """A round perimeter of chords, with its travel and retract."""
    yield f"G1 X{x + radius:.3f} Y{y:.3f} F12000"
    yield "G1 E0.8 F2400"
    count = max(8, int(2.0 * math.pi * radius / CHORD_MM))
    for i in range(1, count + 1):
        angle = 2.0 * math.pi * i / count
        feed = " F3600" if i == 1 else ""
        e = CHORD_MM * FILAMENT_PER_MM
        yield f"G1 X{x + radius * math.cos(angle):.3f} Y{y + radius * math.sin(angle):.3f} E{e:.5f}{feed}"
    yield "G1 E-0.8 F2400"


def infill(x: float, y: float, side: float, lines: int) -> Iterator[str]:
    """Zigzag lines, cut into chords."""
    yield f"G1 X{x:.3f} Y{y:.3f} F12000"
    yield "G1 E0.8 F2400"
    chords = int(side / CHORD_MM)
    for line in range(lines):
        for i in range(1, chords + 1):
            along = i if line % 2 == 0 else chords - i
            feed = " F4800" if line == 0 and i == 1 else ""
            e = CHORD_MM * FILAMENT_PER_MM
            yield f"G1 X{x + along * CHORD_MM:.3f} Y{y + line * 0.4:.3f} E{e:.5f}{feed}"
        yield f"G1 Y{y + (line + 1) * 0.4:.3f} E{0.4 * FILAMENT_PER_MM:.5f}"
    yield "G1 E-0.8 F2400"


def layers() -> Iterator[str]:
    """A part without end, in layers of 0.2 mm."""
    for layer in range(900):
        yield f";LAYER:{layer}"
        yield f"G1 Z{0.2 * (layer + 1):.3f} F600"
        for radius in (20.0, 19.6, 8.0):
            yield ";TYPE:Perimeter"
            yield from ring(100.0, 100.0, radius)
        yield ";TYPE:Infill"
        yield from infill(80.0, 80.0, 24.0, 20)
        yield "G92 E0"


def write_gcode(path: Path, moves: int) -> None:
    """Write a file of that many moves."""
    head = ["G28", "M83", "G90"]
    with path.open("w") as out:
        out.write("\n".join(head) + "\n")
        left = moves
        for line in layers() if moves else ():
            out.write(line + "\n")
            left -= line.startswith("G1")
            if not left:
                return


class Bench:
    """Files and commands of one bench run."""

    def __init__(self, folder: Path, moves: int, peer: str | None, by_clock: bool) -> None:
        self.folder = folder
        self.moves = moves
        self.by_clock = by_clock
        host, printing = str(ROOT / "klippy" / "klippy.py"), str(ROOT / "scripts/bench/rigs/sd_host.py")
        files = ["CONFIG", "GCODE", "OUT", "DICT"]
        self.ways = {
            "batch": [sys.executable, host, "CONFIG", "-i", "GCODE", "-o", "OUT", "-d", "DICT"],
            "SD": [sys.executable, printing, *files],
            "live": [sys.executable, printing, *files, "--live"],
        }
        if peer:
            self.ways["peer"] = shlex.split(peer)
        (folder / "bench.dict").write_bytes(DICTIONARY)
        write_gcode(folder / "moves.gcode", moves)
        write_gcode(folder / "home.gcode", 0)

    def cost(self, way: str, case: Case, gcode: str) -> tuple[float, float]:
        """(seconds, peak MB) of one run of a host."""
        path = self.folder / "printer.cfg"
        path.write_text(case.config() + f"[virtual_sdcard]\npath: {self.folder}\n")
        values = {
            "CONFIG": str(path), "GCODE": str(self.folder / f"{gcode}.gcode"), "OUT": os.devnull,
            "DICT": str(self.folder / "bench.dict"),
        }  # fmt: skip
        done = harness.run(*(values.get(word, word) for word in self.ways[way]))
        return done.wall_s if self.by_clock else done.cpu_s, done.peak_mb

    def measure(self, case: Case, repeat: int) -> tuple[dict[str, float], float]:
        """(moves/s by way, our peak MB): the best of some runs in turn, start-up and homing taken off."""
        idle, busy = (dict.fromkeys(self.ways, math.inf) for _ in range(2))
        peak_mb = 0.0
        # the first start of a host reads files that no cache holds: one more than is asked for
        for turn in range(repeat + 1):
            for way in self.ways:
                idle[way] = min(idle[way], self.cost(way, case, "home")[0])
                if turn:
                    took_s, took_mb = self.cost(way, case, "moves")
                    busy[way] = min(busy[way], took_s)
                    peak_mb = max(peak_mb, took_mb if way != "peer" else 0.0)
        return {way: self.moves / (busy[way] - idle[way]) for way in self.ways}, peak_mb


def cases(quick: bool) -> list[Case]:
    everything = [
        Case(name, micro, smooth)
        for name in ("cartesian", "corexy")
        for micro in (16, 64)
        for smooth in (False, True)
    ]
    return everything[:1] if quick else everything


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        work = Bench(folder, options.moves, options.peer, options.wall)
        for case in cases(options.quick):
            if options.only not in case.title:
                continue
            rates, peak_mb = work.measure(case, options.repeat)
            own = [rates[way] for way in OUR_WAYS]
            row = {**rates, "spread": max(own) / min(own), "peak MB": peak_mb}
            if "peer" in rates:
                row["live / peer"] = rates["live"] / rates["peer"]
            rows[case.title] = row
            report.at_most(f"{case.title}: slowest to fastest way", row["spread"], MAX_SPREAD)
            report.at_most(f"{case.title}: MB", peak_mb, MAX_MEMORY_MB, 1)
    report.figures["moves_per_s"] = rows
    heads = list(next(iter(rows.values()), {}))
    texts = (
        [title, *(f"{row[head]:,.{2 if row[head] < 20 else 0}f}" for head in heads)]
        for title, row in rows.items()
    )
    report.table(f"{options.moves} moves, moves/s", ["case", *heads], texts)
    if ratios := [row["live / peer"] for row in rows.values() if "live / peer" in row]:
        print(f"live / peer: median {statistics.median(ratios):.2f}, lowest {min(ratios):.2f}")


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__, "the first case only")
    parser.add_argument("--moves", type=int, default=300_000)
    parser.add_argument("--repeat", type=int, default=2, help="best of so many runs")
    parser.add_argument("--only", default="", metavar="TEXT", help="the cases whose title has this")
    parser.add_argument("--wall", action="store_true", help="measure by the clock, not by processor time")
    parser.add_argument("--peer", help="command of another host; CONFIG GCODE OUT DICT are replaced")
    parser.add_argument("--keep", type=Path, help="folder for the files, kept")
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
