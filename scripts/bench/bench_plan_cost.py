#!/usr/bin/env python3
"""What the temperature plan costs the host: time and instructions a move, memory of a million moves.

    scripts/bench/bench_plan_cost.py [--moves 50000] [--instructions] [--memory] [FILE ...]

The section's own code (extras/temperature_plan/__init__.py) is run as the printer does it: the look-ahead hands it
moves, its timer plans again 2 s behind, marks of layers and features come by; the minimum layer time is off. Counted
is what [temperature_plan] adds: the copy in the look-ahead, the timer, the records, and the list of corners that it
hands to the heater. Not counted are look-ahead and reading of the file, which are there without it as well.

    --instructions   counts instructions with valgrind, with the plan less without: as exact as time is noisy
    --memory         peak memory of a process after a tenth of a million moves and after a million
    --real-time S    nothing of the above: S seconds of short moves (200 a second) on the simulated printer in real
                     time, host and machine as processes of their own, with the plan and without: how far motion was
                     known ahead at least, stalls, processor time of the host
"""

from __future__ import annotations

import harness

import argparse
import itertools
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
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

AHEAD_S = 2.0  # planned while [temperature_plan] is enabled
NOZZLE_C = 245.0
SECTION = {"material": "ABS", "bed_temp": "100", "chamber_temp": "40", "minimum_speed_factor": "1"}
# The flat part reaches X 190.
WIDE_CONFIG = f"[include {harness.SAMPLE_CONFIG}]\n[stepper_x]\nposition_max: 200\n"
FILES = ("benchy.gcode", "cubhelix.gcode", "brace.gcode")
INSTRUCTION_MOVES = 3000
MEMORY_MOVES = (100_000, 1_000_000)
Planned = tuple[Any, Requests]  # Move of the look-ahead, what holds for it


def sample_config(section: dict[str, str]) -> ConfigWrapper:
    """[temperature_plan] with these options in the sample printer's config."""
    data, _ = configtext.read_main(str(harness.SAMPLE_CONFIG))
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
            register_lookahead_callback=lambda callback: self.marks.append(callback),  # noqa: PLW0108  # the list changes
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
        """The minimum layer time is off."""

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
    for move, requests in moves:
        count += 1
        if planned and requests is not state:
            watch.start()
            section.mark(requests)
            watch.stop()
            state = requests
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
        callbacks, printer.marks = printer.marks, []
        watch.start()
        for callback in callbacks:
            callback(time_s)
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
    config.write_text(WIDE_CONFIG, encoding="utf-8")
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


def child(path: Path, how: str, moves: int, *before: str, endless: bool = False) -> harness.Run:
    """This program again, for one run of replay()."""
    more = ["--endless"] if endless else []
    return harness.run(*before, sys.executable, __file__, path, how, "--moves", moves, *more)


def instructions(path: Path, count: int) -> float:
    """Instructions that planning takes a move: a run with the plan less one without, of the same moves."""
    totals = []
    valgrind = ("valgrind", "--tool=callgrind", "--callgrind-out-file=/dev/null")
    for how in ("--replay", "--replay-without"):
        done = child(path, how, count, *valgrind)
        found = re.search(r"Collected : (\d+)", done.errors)
        assert found is not None, done.errors
        totals.append((int(found[1]), int(done.output)))
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


def in_real_time(section: str, seconds: float) -> tuple[bench_steady.Steadiness, float]:
    """(how steady, share of a core that the host takes) of a print in real time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = f"[include {harness.SAMPLE_CONFIG}]\n[virtual_sdcard]\npath: {folder}\n{section}"
        (folder / "part.gcode").write_text(lines_of_chords(2.0 * seconds))
        with harness.printer(folder, config) as (client, pid):
            client.ask("gcode/script", script="SDCARD_PRINT_FILE FILENAME=part.gcode")
            time.sleep(15.0)  # homing, heating
            before_s = harness.cpu_s(pid)
            found = bench_steady.watch(client, seconds)
            return found, (harness.cpu_s(pid) - before_s) / seconds


def measure_real_time(seconds: float, report: harness.Report) -> None:
    section = "[temperature_plan]\n" + "".join(f"{name}: {value}\n" for name, value in SECTION.items())
    rows = []
    for name, text in (("without the plan", ""), ("with it", section)):
        found, share = in_real_time(text, seconds)
        report.missed += found.faults
        report.figures[name] = {"print": found, "host_share": share}
        rows.append((name, f"{found.min_ahead_s:.2f}", found.stalls, f"{100.0 * share:.1f}"))
    report.table("", ("real time", "plan ahead min, s", "stalls", "host, % of a core"), rows)


def measure_files(options: argparse.Namespace, report: harness.Report) -> None:
    heads = ["file", "us a move"]
    heads += ["instructions a move"] * options.instructions
    heads += [f"{n:,} moves: peak MB" for n in MEMORY_MOVES] * options.memory
    rows = []
    for path in map(data_file, options.files):
        row = [cost_us(path, options.moves)]
        if options.instructions:
            row.append(instructions(path, min(options.moves, INSTRUCTION_MOVES)))
        if options.memory:
            row += [child(path, "--replay", n, endless=True).peak_mb for n in MEMORY_MOVES]
        report.figures[path.name] = dict(zip(heads[1:], row, strict=True))
        rows.append((path.name, *(f"{value:.1f}" for value in row)))
    report.table("", heads, rows)


def bench(options: argparse.Namespace, report: harness.Report) -> None:
    if options.replay or options.replay_without:
        with tempfile.TemporaryDirectory() as folder:
            moves = moves_of(data_file(options.files[0]), Path(folder))
            endless = itertools.cycle(moves) if options.endless else moves
            print(replay(itertools.islice(endless, options.moves), options.replay)[0])
    elif options.real_time:
        measure_real_time(options.real_time, report)
    else:
        measure_files(options, report)


def parser() -> argparse.ArgumentParser:
    parser = harness.options(__doc__)
    parser.add_argument("files", nargs="*", default=FILES, help="G-code files")
    parser.add_argument("--moves", type=int, default=50_000, help="so many of each file at most")
    parser.add_argument("--instructions", action="store_true")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--real-time", type=float, metavar="S")
    for hidden in ("--replay", "--replay-without", "--endless"):
        parser.add_argument(hidden, action="store_true", help=argparse.SUPPRESS)
    return parser


if __name__ == "__main__":
    sys.exit(harness.main(bench, parser()))
