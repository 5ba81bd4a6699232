#!/usr/bin/env python3
"""What the temperature plan costs the host: time and instructions a move, memory of a million moves.

    scripts/bench/bench_plan_cost.py [--moves 50000] [--instructions] [--memory] [FILE ...]

The section's own code (extras/temperature_plan/__init__.py) is run as the printer does it: the look-ahead hands it
moves, its timer plans again 2 s behind, marks of layers and features come by; the pace of hot layers is off. Counted
is what [temperature_plan] adds: the copy in the look-ahead, the timer, the books, and the list of corners that it
hands to the heater. Not counted are look-ahead and reading of the file, which are there without it as well.

    --instructions   counts instructions with valgrind, with the plan less without: as exact as time is noisy
    --memory         peak memory of a process after a tenth of a million moves and after a million
    --real-time S    nothing of the above: S seconds of short moves (200 a second) on the simulated printer in real
                     time, host and machine as processes of their own, with the plan and without: how far motion was
                     known ahead at least, stalls, processor time of the host
"""

from __future__ import annotations

from bench_paths import ROOT  # isort: skip

import argparse
import itertools
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import bench_steady
import configtext
from configfile import ConfigWrapper
from extras import temperature_plan
from extras.induction import settings as induction_settings
from lookahead import LookAheadQueue
from simulation.path_host import PathHost, PathPrinter
from thermal.control.control_api import Reference
from thermal.plan.requests import Requests, read_comment

AHEAD_S = 2.0  # toolhead.BUFFER_FULL_S
NOZZLE_C = 245.0
SECTION = {"material": "ABS", "bed_temp": "100", "chamber_temp": "40", "minimum_speed_factor": "1"}
WIDER = "[stepper_x]\nposition_max: 200\n"  # the flat part reaches X 190
FILES = ("benchy.gcode", "cubhelix.gcode", "brace.gcode")
INSTRUCTION_MOVES = 3000
MEMORY_MOVES = (100_000, 1_000_000)
Planned = tuple[Any, Requests]  # Move of the look-ahead, what holds for it


def sample_config(section: dict[str, str]) -> ConfigWrapper:
    """[temperature_plan] with these options in the sample printer's config."""
    data, _ = configtext.read_main(str(ROOT / "config" / "sim-induction.cfg"))
    for name, value in section.items():
        data.set("temperature_plan", name, value, configtext.Origin("bench", 0))
    return ConfigWrapper(None, data, {}, "temperature_plan")


class Printer:
    """As much of a printer as the section asks for; `time_s`: print time now."""

    def __init__(self) -> None:
        section = sample_config({}).getsection("induction_heater nozzle")
        parameters = induction_settings.read_parameters(section, induction_settings.read_unit(section))
        self.time_s = 0.0
        self.woken = False
        self.next_s = 0.0  # when the section's timer is due
        self.loop = SimpleNamespace(
            reference=None, state=SimpleNamespace(target_c=NOZZLE_C), set_reference=self._set_reference
        )
        self.heater = SimpleNamespace(
            batch=False, in_calibration=False, min_temp=parameters.supervise.temp_low_c,
            max_temp=parameters.supervise.temp_high_c, min_extrude_c=170.0, parameters=parameters,
            loop=self.loop, now_s=lambda: self.time_s,
        )  # fmt: skip
        extruder = SimpleNamespace(get_name=lambda: "extruder", get_heater=lambda: self.heater)
        ignore = SimpleNamespace(register_command=_nothing, register_comment_listener=_nothing)
        self.toolhead = SimpleNamespace(
            get_extruder=lambda: extruder,
            register_move_listener=_nothing,
            register_lookahead_callback=lambda tell: self.marks.append(tell),  # noqa: PLW0108  # the list changes
        )
        self.marks: list[Callable[[float], None]] = []
        heaters = SimpleNamespace(lookup_heater=lambda name: self.heater)
        fan = SimpleNamespace(fan=SimpleNamespace(last_fan_value=0.0))
        stats = SimpleNamespace(state="standby")
        self._objects = {
            "gcode": ignore, "toolhead": self.toolhead, "heaters": heaters, "fan": fan, "print_stats": stats,
        }  # fmt: skip

    def _set_reference(self, points: Sequence[tuple[float, float]], now_s: float) -> None:
        """As thermal/control/loop.py does it."""
        self.loop.reference = Reference.of(points) if points else None
        if self.loop.reference is not None:
            self.loop.state.target_c = self.loop.reference.at(now_s)

    def get_reactor(self) -> Any:
        return SimpleNamespace(
            monotonic=lambda: self.time_s, register_timer=_nothing, update_timer=self._wake, NOW=0.0
        )

    def _wake(self, timer: object, time_s: float) -> None:
        self.woken = True

    def register_event_handler(self, event: str, handler: object) -> None:
        """No event is sent here."""

    def lookup_object(self, name: str, default: Any = None) -> Any:
        return self._objects.get(name, default)


def _nothing(*args: object, **kwargs: object) -> object:
    return args


class Section(temperature_plan.TemperaturePlanner):
    """[temperature_plan] on that printer, driven by hand."""

    def __init__(self, printer: Any) -> None:
        super().__init__(printer, temperature_plan.read_settings(sample_config(SECTION)))
        self._on_connect()
        self._on_ready()

    def set_speed(self, factor: float) -> None:
        """The pace is off."""

    def moves(self, row: Any, count: int, time_s: float) -> None:
        self._on_moves(row, count, time_s)

    def timer(self, time_s: float) -> float:
        return self._on_timer(time_s)

    def mark(self, state: Requests) -> None:
        self._mark(state)


class Watch:
    """Adds up processor time, less what looking at the clock takes itself (about 1 µs)."""

    def __init__(self, runs: bool) -> None:
        self._clock = time.process_time if runs else lambda: 0.0
        pairs = [-(self._clock() - self._clock()) for _ in range(1001)]
        self._own_s = statistics.median(pairs)
        self._began = self.spent_s = 0.0

    def start(self) -> None:
        self._began = self._clock()

    def stop(self) -> None:
        self.spent_s += self._clock() - self._began - self._own_s


def replay(moves: Iterable[Planned], planned: bool) -> tuple[int, float]:
    """(moves, seconds of processor time that the section took)."""
    printer = Printer()
    section = Section(printer)
    queue = LookAheadQueue()
    count, time_s, state, watch = 0, 1.0, Requests(), Watch(planned)
    for move, wishes in moves:
        count += 1
        if planned and wishes is not state:
            watch.start()
            section.mark(wishes)
            watch.stop()
            state = wishes
        if not queue.add_move(move, move.toolhead.extruder):
            continue
        ready, row = queue.plan(lazy=True), queue.row
        watch.start()
        if planned and ready:
            section.moves(row, ready, time_s)
        watch.stop()
        for at in range(row.first, row.first + ready):
            record = row.ring[at & row.mask]
            time_s += record.accel_t + record.cruise_t + record.decel_t
        queue.take(ready)
        told, printer.marks = printer.marks, []
        watch.start()
        for tell in told:
            tell(time_s)
        while planned and (printer.woken or printer.next_s <= time_s - AHEAD_S):
            printer.time_s = max(printer.time_s, time_s - AHEAD_S if printer.woken else printer.next_s)
            printer.woken = False
            printer.next_s = section.timer(printer.time_s)
        watch.stop()
    return count, watch.spent_s


class Collector:
    """Moves as the host's look-ahead gives them out, each with what the comments before it say."""

    def __init__(self) -> None:
        self.moves: list[Planned] = []
        self._state = Requests()

    def on_ready(self, printer: PathPrinter) -> None:
        printer.lookup_object("toolhead").register_move_listener(self._on_moves)
        printer.lookup_object("gcode").register_comment_listener(self._on_comment)

    def _on_moves(self, moves: Sequence[Any]) -> None:
        self.moves += [(move, self._state) for move in moves]

    def _on_comment(self, line: str) -> None:
        found = read_comment(line)
        self._state = self._state if found is None else self._state.comment(found)

    def before_line(self, number: int) -> None:
        """All lines are alike."""

    def after_line(self) -> None:
        """The moves come by themselves."""


def moves_of(path: Path, folder: Path) -> list[Planned]:
    """The file's moves, with targets of our own (it is sliced for PLA)."""
    text = path.read_text(encoding="utf-8", errors="replace")
    plain, config = folder / path.name, folder / "path.cfg"
    plain.write_text(re.sub(r"(?m)^M1[0-9]{2}\b.*", "", text), encoding="utf-8")
    config.write_text(f"[include {ROOT / 'config' / 'sim-induction.cfg'}]\n{WIDER}", encoding="utf-8")
    reader = Collector()
    PathHost(config, plain).run(reader)
    return reader.moves


def data_file(name: str) -> Path:
    """A sliced file of pyGCodeDecode's examples, or a file's own path."""
    import importlib.util

    if Path(name).exists():
        return Path(name)
    spec = importlib.util.find_spec("pyGCodeDecode")
    assert spec is not None and spec.origin is not None, "scripts/setup.sh demo installs the sliced files"
    return Path(spec.origin).parent / "examples" / "data" / name


def cost_us(path: Path, count: int = 50_000) -> float:
    """Processor time that planning takes, µs a move."""
    with tempfile.TemporaryDirectory() as folder:
        moves, spent_s = replay(itertools.islice(moves_of(path, Path(folder)), count), planned=True)
    return 1e6 * spent_s / max(1, moves)


def again_and_again(path: Path, folder: Path) -> Iterator[Planned]:
    """A print without end: the file over and over."""
    return itertools.cycle(moves_of(path, folder))


def peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def child(path: Path, *options: object) -> str:
    """What this program prints with other options."""
    command = [sys.executable, __file__, str(path), *map(str, options)]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


def instructions(path: Path, count: int) -> float:
    """Instructions that planning takes a move: a run with the plan less one without, of the same moves."""
    totals = []
    for how in ("--replay", "--replay-without"):
        command = ["valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null", sys.executable, __file__]
        done = subprocess.run(
            [*command, str(path), "--moves", str(count), how], capture_output=True, text=True, check=True
        )
        found = re.search(r"Collected : (\d+)", done.stderr)
        assert found is not None, done.stderr
        totals.append((int(found[1]), int(done.stdout.split()[0])))
    (planned, moves), (without, _) = totals
    return (planned - without) / moves


def lines_of_chords(seconds: float) -> str:
    """0.5 mm at 100 mm/s with material, another feature every 40 moves, another layer every 2000."""
    lines = ["M104 S240", "G28", "G90", "M83", "G1 X40 Y40 Z0.3 F6000", "M109 S240"]
    for number, line in enumerate(bench_steady.zigzag(seconds, 0.5, 100.0)):
        if number % 2000 == 0:
            lines += [";LAYER_CHANGE", f"G1 Z{0.3 + 0.2 * (number // 2000):.2f} F600"]
        if number % 40 == 0:
            lines.append(f";TYPE:{('External perimeter', 'Internal infill')[number // 40 % 2]}")
        lines.append(f"{line} E0.018 F6000" if number else line)
    return "\n".join([*lines, ""])


def processor_s(pid: int) -> float:
    """Processor time a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def in_real_time(section: str, seconds: float) -> str:
    """A print in real time, as a line of text."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = folder / "printer.cfg"
        config.write_text(
            f"[include {ROOT / 'config' / 'sim-induction.cfg'}]\n[mcu]\nserial: {folder}/tty\n"
            f"[virtual_sdcard]\npath: {folder}\n{section}"
        )
        (folder / "part.gcode").write_text(lines_of_chords(2.0 * seconds))
        machine = [sys.executable, ROOT / "scripts" / "run_simulator.py", config, "--pty", folder / "tty"]
        host = [
            sys.executable,
            ROOT / "klippy" / "klippy.py",
            config,
            "-a",
            folder / "sock",
            "-l",
            folder / "log",
        ]
        processes = [subprocess.Popen(list(map(str, machine)), stdout=subprocess.DEVNULL)]
        try:
            time.sleep(2.0)
            processes.append(subprocess.Popen(list(map(str, host)), stdout=subprocess.DEVNULL))
            client = bench_steady.bench_api.connect(folder / "sock")
            client.sock.settimeout(60.0)
            client.ask("gcode/script", script="SDCARD_PRINT_FILE FILENAME=part.gcode")
            time.sleep(15.0)  # homing, heating
            before_s = processor_s(processes[1].pid)
            found = bench_steady.watch(client, seconds)
            used_s = processor_s(processes[1].pid) - before_s
        finally:
            for process in reversed(processes):
                process.terminate()
                process.wait()
    faults = "".join(f"; {fault}" for fault in found.faults)
    return (
        f"ahead by {found.min_ahead_s:.2f} s at least, {found.stalls} stalls,"
        f" host busy for {100.0 * used_s / seconds:.1f} % of a core{faults}"
    )


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", default=FILES, help="G-code files")
    parser.add_argument("--moves", type=int, default=50_000, help="so many of each file at most")
    parser.add_argument("--instructions", action="store_true")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--real-time", type=float, metavar="S")
    parser.add_argument("--replay", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--replay-without", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--endless", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.real_time:
        section = "[temperature_plan]\n" + "".join(f"{name}: {value}\n" for name, value in SECTION.items())
        print("without the plan: ", in_real_time("", options.real_time), flush=True)
        print("with it:          ", in_real_time(section, options.real_time))
        return 0
    paths = [data_file(name) for name in options.files]
    if options.replay or options.replay_without:
        with tempfile.TemporaryDirectory() as folder:
            source = (again_and_again if options.endless else moves_of)(paths[0], Path(folder))
            done = replay(itertools.islice(source, options.moves), options.replay)
        print(done[0], f"{peak_mb():.1f}")
        return 0
    for path in paths:
        text = f"{path.name:<16} {cost_us(path, options.moves):5.1f} us a move"
        if options.instructions:
            count = min(options.moves, INSTRUCTION_MOVES)
            text += f"  {instructions(path, count):8.0f} instructions a move"
        if options.memory:
            runs = [child(path, "--replay", "--endless", "--moves", n).split() for n in MEMORY_MOVES]
            text += "  " + ", ".join(f"{moves} moves: peak {mb} MB" for moves, mb in runs)
        print(text, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
