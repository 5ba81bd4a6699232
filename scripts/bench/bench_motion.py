#!/usr/bin/env python3
"""Throughput of batch mode: many short moves through the whole host to /dev/null (`make bench-motion`).

A generated file (0.5 mm chords: round perimeters, zigzag infill, travels, retracts, relative extrusion) is run by
klippy.py as a process of its own, at 16 and 64 microsteps, cartesian and corexy, without and with pressure advance
and input shaper. Beside the time of the whole run stands that of an otherwise equal run of a file that only homes, so
that moves/s are those of moves. Time is processor time of the process (with --wall: by the clock), which other work
on the machine disturbs little. The stages are told apart by further runs: one whose steppers are a thousand times
coarser (almost no steps), and one of a file with as many lines, as long, that go nowhere (reading only).

--peer "COMMAND" runs another host on the same files in the same turn; CONFIG, GCODE, OUT and DICT in it are replaced,
e.g. --peer "kalico CONFIG -i GCODE -o OUT -d DICT". A host that needs other messages than the built-in
dictionary has gets the file after -d itself. Goal: three times the peer's moves/s.
"""

from __future__ import annotations

from bench_paths import ROOT  # isort: skip

import argparse
import json
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

MAX_MEMORY_MB = 75.0
CHORD_MM = 0.5
FILAMENT_PER_MM = 0.0333  # 0.4 x 0.2 mm lines of 1.75 mm filament
# Coarse steps for the run that measures everything but step generation
COARSE = 1000.0
CLOCK_HZ = 20_000_000

COMMANDS = (
    "allocate_oids count=%c", "finalize_config crc=%u", "get_config", "get_clock", "get_uptime", "emergency_stop",
    "clear_shutdown", "identify offset=%u count=%c", "debug_nop", "config_reset", "reset",
    "config_stepper oid=%c step_pin=%c dir_pin=%c invert_step=%c step_pulse_ticks=%u",
    "queue_step oid=%c interval=%u count=%hu add=%hi", "set_next_step_dir oid=%c dir=%c",
    "reset_step_clock oid=%c clock=%u", "stepper_get_position oid=%c", "stepper_stop_on_trigger oid=%c trsync_oid=%c",
    "config_endstop oid=%c pin=%c pull_up=%c", "endstop_query_state oid=%c",
    "endstop_home oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u pin_value=%c trsync_oid=%c"
    " trigger_reason=%c",
    "config_trsync oid=%c", "trsync_start oid=%c report_clock=%u report_ticks=%u expire_reason=%c",
    "trsync_set_timeout oid=%c clock=%u", "trsync_trigger oid=%c reason=%c",
    "config_digital_out oid=%c pin=%u value=%c default_value=%c max_duration=%u",
    "set_digital_out_pwm_cycle oid=%c cycle_ticks=%u", "queue_digital_out oid=%c clock=%u on_ticks=%u",
    "update_digital_out oid=%c value=%c", "set_digital_out pin=%u value=%c",
    "config_pwm_out oid=%c pin=%u cycle_ticks=%u value=%hu default_value=%hu max_duration=%u",
    "queue_pwm_out oid=%c clock=%u value=%hu", "config_analog_in oid=%c pin=%u",
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u bytes_per_report=%c"
    " min_value=%hu max_value=%hu range_check_count=%c",
)  # fmt: skip
RESPONSES = (
    "identify_response offset=%u data=%.*s", "stats count=%u sum=%u sumsq=%u", "clock clock=%u",
    "uptime high=%u clock=%u", "config is_config=%c crc=%u is_shutdown=%c move_count=%hu", "starting",
    "shutdown clock=%u static_string_id=%hu", "is_shutdown static_string_id=%hu",
    "stepper_position oid=%c pos=%i", "endstop_state oid=%c homing=%c next_clock=%u pin_value=%c",
    "trsync_state oid=%c can_trigger=%c trigger_reason=%c clock=%u", "analog_in_state oid=%c next_clock=%u values=%*s",
)  # fmt: skip

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

    def config(self, coarse: bool = False) -> str:
        factor = COARSE if coarse else 1.0
        rails = "".join(
            RAIL.format(
                axis=axis, port=port, microsteps=self.microsteps, rotation=turn * factor, homing=homing
            )
            for axis, port, turn, homing in (("x", "A", 40, 40), ("y", "B", 40, 40), ("z", "C", 8, 8))
        )
        return CONFIG.format(
            kinematics=self.kinematics, microsteps=self.microsteps, rails=rails, e_rotation=7.6 * factor,
            advance=0.05 if self.smooth else 0.0,
        ) + (SHAPER if self.smooth else "")  # fmt: skip


@dataclass(frozen=True, slots=True)
class Cost:
    """What one process took; memory is its peak resident set in MB (1e6 bytes)."""

    time_s: float
    peak_mb: float


class BenchError(Exception):
    """A run did not come to its end; the text says why."""


def dictionary() -> dict[str, object]:
    """What an ordinary MCU would say about itself; message ids are ours."""
    numbers = {"identify offset=%u count=%c": 1, "identify_response offset=%u data=%.*s": 0}
    free = iter(range(2, 200))

    def numbered(formats: Sequence[str]) -> dict[str, int]:
        return {text: numbers[text] if text in numbers else next(free) for text in formats}

    pins = {f"P{port}0": [16 * index, 16] for index, port in enumerate("ABCDEFGH")}
    return {
        "app": "Bench", "license": "none", "version": "bench", "build_versions": "none",
        "commands": numbered(COMMANDS), "responses": numbered(RESPONSES),
        "enumerations": {"pin": pins, "static_string_id": {"Timer too close": 2}},
        "config": {
            "MCU": "bench", "CLOCK_FREQ": CLOCK_HZ, "ADC_MAX": 4095, "PWM_MAX": 255, "STATS_SUMSQ_BASE": 256,
            "STEPPER_STEP_BOTH_EDGE": 1,
        },
    }  # fmt: skip


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


def write_still(path: Path, moves: int) -> None:
    """As many lines, as long as those of moves, that go nowhere: only reading them takes time."""
    with path.open("w") as out:
        out.write("G28\nM83\nG91\nG1 F6000\n")
        for _ in range(moves):
            out.write("G1 X000.000 Y000.000 E0.00000\n")


def run(command: Sequence[str], by_clock: bool) -> Cost:
    """Run a process to its end and measure it: its processor time, or by the clock."""
    begin = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    assert process.stderr is not None
    complaint = process.stderr.read().decode("utf-8", "replace")
    _pid, status, usage = os.wait4(process.pid, 0)
    wall_s = time.monotonic() - begin
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise BenchError(
            f"{shlex.join(command)} ended with status {process.returncode}:\n{complaint[-2000:]}"
        )
    return Cost(wall_s if by_clock else usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e6)


class Bench:
    """Files and commands of one bench run."""

    def __init__(self, folder: Path, moves: int, peer: str | None, by_clock: bool) -> None:
        self.folder = folder
        self.moves = moves
        self.by_clock = by_clock
        self.peer = shlex.split(peer) if peer else None
        self.own = [sys.executable, str(ROOT / "klippy" / "klippy.py"), "CONFIG", "-i", "GCODE", "-o", "OUT"]
        self.own += ["-d", "DICT"]
        (folder / "bench.dict").write_text(json.dumps(dictionary()))
        write_gcode(folder / "moves.gcode", moves)
        write_gcode(folder / "home.gcode", 0)
        write_still(folder / "still.gcode", moves)

    def cost(self, template: Sequence[str], config: str, gcode: str, out: str = os.devnull) -> Cost:
        """One run of a host."""
        path = self.folder / "printer.cfg"
        path.write_text(config)
        values = {
            "CONFIG": str(path), "GCODE": str(self.folder / f"{gcode}.gcode"), "OUT": out,
            "DICT": str(self.folder / "bench.dict"),
        }  # fmt: skip
        return run([values.get(word, word) for word in template], self.by_clock)

    def moves_per_s(self, template: Sequence[str], case: Case, repeat: int) -> tuple[float, float]:
        """(moves/s, peak MB): the best of some runs, start-up and homing taken off."""
        # the first start of a host reads files that no cache holds: one more than is asked for
        idle = min(self.cost(template, case.config(), "home").time_s for _ in range(repeat + 1))
        costs = [self.cost(template, case.config(), "moves") for _ in range(repeat)]
        busy = min(cost.time_s for cost in costs) - idle
        return self.moves / busy, max(cost.peak_mb for cost in costs)

    def stages_us(self, case: Case) -> tuple[float, float]:
        """(time of reading a move's line, of planning it) without its steps (µs)."""
        idle, still, busy = (
            self.cost(self.own, case.config(coarse=True), gcode).time_s
            for gcode in ("home", "still", "moves")
        )
        return (still - idle) / self.moves * 1e6, (busy - still) / self.moves * 1e6

    def steps(self, case: Case) -> int:
        """Steps of the whole file, all steppers (counted from the commands)."""
        out = self.folder / "steps.bin"
        self.cost(self.own, case.config(), "moves", str(out))
        command = [
            sys.executable,
            str(ROOT / "klippy" / "parsedump.py"),
            str(self.folder / "bench.dict"),
            str(out),
        ]
        total = 0
        # line by line: this process must stay small, a child's peak memory begins with that of its parent
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as listing:
            assert listing.stdout is not None
            for line in listing.stdout:
                if "queue_step" in line:
                    total += int(line.partition(" count=")[2].split(" ", 1)[0])
        if listing.returncode:
            raise BenchError(f"{shlex.join(command)} ended with status {listing.returncode}")
        out.unlink()
        return total


def cases(quick: bool) -> list[Case]:
    everything = [
        Case(name, micro, smooth)
        for name in ("cartesian", "corexy")
        for micro in (16, 64)
        for smooth in (False, True)
    ]
    return everything[:1] if quick else everything


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="Throughput of batch mode.")
    parser.add_argument("--moves", type=int, default=300_000)
    parser.add_argument("--repeat", type=int, default=1, help="best of so many runs")
    parser.add_argument("--quick", action="store_true", help="the first case only")
    parser.add_argument("--only", default="", metavar="TEXT", help="the cases whose title has this")
    parser.add_argument("--wall", action="store_true", help="measure by the clock, not by processor time")
    parser.add_argument("--peer", help="command of another host; CONFIG GCODE OUT DICT are replaced")
    parser.add_argument("--keep", type=Path, help="folder for the files, kept")
    options = parser.parse_args(argv)
    table = Table(title=f"{options.moves} moves in batch mode")
    for heading in (
        "case",
        "moves/s",
        "k steps/s",
        "µs/move: read",
        "plan",
        "steps",
        "peak MB",
        "peer moves/s",
        "ratio",
    ):
        table.add_column(heading, justify="left" if heading == "case" else "right")
    too_big = False
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        bench = Bench(folder, options.moves, options.peer, options.wall)
        try:
            for case in cases(options.quick):
                if options.only not in case.title:
                    continue
                rate, peak_mb = bench.moves_per_s(bench.own, case, options.repeat)
                read_us, plan_us = bench.stages_us(case)
                steps_per_move = bench.steps(case) / options.moves
                row = [case.title, f"{rate:,.0f}", f"{rate * steps_per_move / 1e3:,.0f}", f"{read_us:.1f}"]
                row += [f"{plan_us:.1f}", f"{max(0.0, 1e6 / rate - read_us - plan_us):.1f}", f"{peak_mb:.0f}"]
                if bench.peer:
                    other, _ = bench.moves_per_s(bench.peer, case, options.repeat)
                    row += [f"{other:,.0f}", f"{rate / other:.2f}"]
                table.add_row(*row)
                too_big = too_big or peak_mb > MAX_MEMORY_MB
        except BenchError as problem:
            print(f"bench_motion: {problem}", file=sys.stderr)
            return 1
    Console(width=130).print(table)
    if too_big:
        print(f"bench_motion: more than {MAX_MEMORY_MB:.0f} MB", file=sys.stderr)
    return int(too_big)


if __name__ == "__main__":
    sys.exit(main())
