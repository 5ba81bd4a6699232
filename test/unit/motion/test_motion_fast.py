"""G1 lines in rows give what they give line by line: the same bytes for the MCU, the same state and errors."""

from __future__ import annotations

import itertools
import logging
import os
import random
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from extras.gcode_move import MoveRows
from motion_rig import CLOCK_HZ, CONFIG, EXTRUDER, dictionary
from printer import Printer
from reactor import Reactor
from simulation.sample_gcode import sample_path

MACHINE = CONFIG + EXTRUDER + "pressure_advance: 0.04\n[fan]\npin: PE0\n"
HOMED = "G28\nM83\nG1 X20 Y20 Z0.3 F9000\n"


@dataclass
class Outcome:
    """What can be seen of a run."""

    result: str
    out: bytes
    warnings: list[str]
    gcode_state: dict[str, Any]
    position: list[float]
    row_lines: int  # that went in rows


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    numbers = itertools.count()
    count = 0
    in_rows = True
    whole = MoveRows.run

    def counting(self: Any, text: bytes, start: int, end: int) -> int:
        nonlocal count
        stop = whole(self, text, start, end) if in_rows else start
        count += text.count(b"\n", start, stop)
        return stop

    monkeypatch.setattr(MoveRows, "run", counting)

    def go(gcode: str, short: bool, config: str = MACHINE, prepare: Any = None) -> Outcome:
        nonlocal count, in_rows
        folder = tmp_path / str(next(numbers))
        folder.mkdir()
        (folder / "printer.cfg").write_text(config)
        (folder / "in.gcode").write_text(gcode)
        (folder / "dict").write_bytes(dictionary(CLOCK_HZ))
        caplog.clear()
        count, in_rows = 0, short
        reactor = Reactor()
        start_args = {
            "config_file": str(folder / "printer.cfg"), "config_overrides": [], "apiserver": None,
            "start_reason": "startup", "software_version": "test", "cpu_info": "test",
            "debuginput": str(folder / "in.gcode"),
            "gcode_fd": os.open(folder / "in.gcode", os.O_RDONLY),
            "debugoutput": str(folder / "out"), "dictionary": str(folder / "dict"),
        }  # fmt: skip
        printer = Printer(reactor, start_args)
        if prepare is not None:
            printer.register_event_handler("klippy:ready", lambda: prepare(printer))
        result = printer.run()
        warnings = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
        state = printer.lookup_object("gcode_move").get_status()
        position = printer.lookup_object("toolhead").get_position()
        reactor.finalize()
        os.close(start_args["gcode_fd"])
        return Outcome(result, (folder / "out").read_bytes(), warnings, state, position, count)

    return go


def both(run: Any, gcode: str, **options: Any) -> Outcome:
    """Run both ways; returns the short one."""
    long, short = run(gcode, short=False, **options), run(gcode, short=True, **options)
    assert long.row_lines == 0
    assert short.warnings == long.warnings
    assert short.result == long.result
    assert short.out == long.out
    assert short.gcode_state == long.gcode_state
    assert short.position == long.position
    return short


PLAIN = (
    "G1 X{x:.3f} Y{y:.3f} E{e:.5f}",
    "G0 X{x:.2f} Y{y:.2f} F{f}",
    "G1 X{x:.3f} E{e:.4f} F{f}",
    "G1 E{s:.2f} F2400",
)
ODD = (
    "g1 x{x:.3f} y{y:.3f}", "G1X{x:.1f}Y{y:.1f}", "  G1 X{x:.1f}", "G1\tX{x:.1f}", "N7 G1 X{x:.2f}", "G1 X {x:.1f}",
    "G1 X{x:.1f} X{y:.1f}", "G1 X+{x:.17f}", "G1 X{x:.1f}e0", "G1 X{x:.1f} Y{y:.1f} ; F1 {{", "G1", "G1 F{f}", "G1 ;",
    "G1 Z{z:.2f} F{f}", "G1 X{x:.1f} Y{y:.1f} Z{z:.2f} E{e:.3f}", "G1 X{x:.1f} A3", "G01 X{x:.1f}", "", "   ", "; X",
    "G1 X{x:.0f}. Y.5", "G1 X{x:.3f} Y{y:.3f} E{e:.5f}\r", "% percent", "# hash", "G1 X1_0", "G1 E-0.0", "G1 X-0",
    "M106 S{p}", "M204 S{f}", "G92 E0", "M220 S{q}", "M221 S{q}", "M82\nG92 E0\nG1 E{s:.2f}\nM83",
    "G91\nG1 X0.1 Y-0.1\nG90", "SET_PRESSURE_ADVANCE ADVANCE=0.0{p}", "SET_VELOCITY_LIMIT ACCEL={f}", "G4 P{p}",
    "SAVE_GCODE_STATE NAME=a\nG1 X{x:.1f}\nRESTORE_GCODE_STATE NAME=a MOVE=1", "M400", "M117 G1 X{x:.1f}", "BLA A=1",
    "SET_GCODE_OFFSET X=0.{p}", "SET_VELOCITY_LIMIT SQUARE_CORNER_VELOCITY={p}", "M105", "T0", "M114",
)  # fmt: skip
WRONG = (
    "G1 X{x:.1f} F0", "G1 X201", "G1 X{x:.1f} E90", "G1 E51", "G1 Xnan", "G1 Y1e999", "G1 F-1", "G1 X--1", "G1 X1 2",
    "G1 Z-30", "G1 X", "M18\nG1 X{x:.1f}\nG1 X-5", "G1 E1{{", "G1 X1.2.3", "G1 9", "é",
)  # fmt: skip


def random_file(number: int, lines: int) -> str:
    """A print gone wild: mostly plain moves near each other, odd lines between; every second file ends in an error."""
    dice = random.Random(number)
    text = [HOMED]
    x, y = 100.0, 100.0
    for _ in range(lines):
        x = min(190.0, max(10.0, x + dice.gauss(0.0, dice.choice((0.2, 1.0, 20.0)))))
        y = min(190.0, max(10.0, y + dice.gauss(0.0, dice.choice((0.2, 1.0, 20.0)))))
        form = dice.choice(PLAIN) if dice.random() < 0.93 else dice.choice(ODD)
        text.append(fill(form, dice, x, y))
    if number % 2:
        text.append(fill(dice.choice(WRONG), dice, x, y))
        text.append("G1 X5")
    return "\n".join(text)


def fill(form: str, dice: random.Random, x: float, y: float) -> str:
    return form.format(
        x=x, y=y, z=dice.uniform(0.2, 1.0), e=dice.uniform(0.0, 0.02), s=dice.uniform(-1.0, 1.0),
        f=dice.randint(600, 15000), p=dice.randint(10, 99), q=dice.randint(50, 150),
    )  # fmt: skip


@pytest.mark.parametrize("number", range(16))
def test_random_files_come_out_the_same_both_ways(run, number: int) -> None:
    short = both(run, random_file(number, 400))
    assert short.result == ("error_exit" if number % 2 else "exit"), short.warnings
    assert short.row_lines > 150
    assert len(short.out) > 2000


@pytest.mark.parametrize("line", WRONG)
def test_errors_are_the_same_both_ways(run, line: str) -> None:
    moves = "".join(f"G1 X{20 + i % 7} Y{20 + i % 5} E0.01\n" for i in range(30))
    short = both(run, HOMED + moves + fill(line, random.Random(1), 50.0, 50.0) + "\nG1 X9\n")
    assert short.result == "error_exit"
    assert short.warnings


@pytest.mark.parametrize("name", ["cubhelix", "benchy"])
def test_sliced_files_come_out_the_same_both_ways(run, name: str) -> None:
    lines = sample_path(name).read_text().splitlines()[:8000]
    start = "M104 S0\n"
    body = [line for line in lines if not line.startswith(("M140", "M190", "M104", "M109", "G28", "G29"))]
    config = MACHINE.replace(
        "_endstop: 200\nposition_max: 200", "_endstop: 200\nposition_min: -10\nposition_max: 200"
    )
    short = both(run, "G28\n" + start + "\n".join(body), config=config)
    assert short.row_lines > 2000


def test_unhomed_machine_refuses_both_ways(run) -> None:
    short = both(run, "G1 X10 F6000\n")
    assert any("Must home axis first" in w for w in short.warnings)


def test_no_extruder_refuses_to_extrude_both_ways(run) -> None:
    short = both(run, "G28\nG1 X10 F6000\nG1 X20\nG1 X30 E1\n", config=CONFIG)
    assert any("Extrude when no extruder present" in w for w in short.warnings)
    assert short.row_lines >= 2


def test_last_line_without_an_end_is_run(run) -> None:
    assert both(run, "G28\nG1 X10 F6000\nG1 X33").position[0] == 33.0


def test_listener_gets_every_move_of_the_short_way(run) -> None:
    """Text goes the short way, yet whoever listens sees the same moves."""
    seen: list[list[tuple[Any, ...]]] = []

    def listen(printer: Any) -> None:
        seen_moves: list[tuple[Any, ...]] = []
        seen.append(seen_moves)
        printer.lookup_object("toolhead").register_move_listener(
            lambda moves: seen_moves.extend(
                (
                    m.print_time,
                    m.start_pos,
                    m.end_pos,
                    m.axes_d,
                    m.axes_r,
                    m.start_v,
                    m.cruise_v,
                    m.end_v,
                    m.accel_t,
                )
                for m in moves
            )
        )

    short = both(run, random_file(100, 200), prepare=listen)
    assert short.row_lines > 80
    assert len(seen[0]) > 100
    assert seen[0] == seen[1]


class Shifted:
    """A transform between G-code and toolhead."""

    def __init__(self, toolhead: Any) -> None:
        self.toolhead = toolhead

    def move(self, newpos: list[float], speed: float) -> None:
        self.toolhead.move([newpos[0] + 1.0, *newpos[1:]], speed)

    def get_position(self) -> list[float]:
        position = self.toolhead.get_position()
        return [position[0] - 1.0, *position[1:]]


def test_transform_sees_every_line(run) -> None:
    def put_between(printer: Any) -> None:
        move = printer.lookup_object("gcode_move")
        move.set_move_transform(Shifted(printer.lookup_object("toolhead")), force=True)

    short = both(run, "G28\nG1 X10 F6000\nG1 X20\n", prepare=put_between)
    assert short.row_lines == 0
    assert short.position[0] == 21.0


def test_other_handlers_and_patched_checks_are_called(run) -> None:
    lines: list[str] = []
    ends: list[Any] = []

    def other_handler(printer: Any) -> None:
        gcode = printer.lookup_object("gcode")
        own = gcode.register_command("G1", None)
        gcode.register_command("G1", lambda gcmd: (lines.append(gcmd.get_commandline()), own(gcmd)))

    def other_check(printer: Any) -> None:
        kin = printer.lookup_object("toolhead").kin
        own = kin.check_move
        kin.check_move = lambda move: (ends.append(move.end_pos), own(move))

    assert both(run, "G28\nG1 X10 F6000\nG1 X20\n", prepare=other_handler).row_lines == 0
    assert lines == ["G1 X10 F6000", "G1 X20"] * 2
    assert both(run, "G28\nG1 X10 F6000\nG1 X20\n", prepare=other_check).row_lines == 0
    assert [x for x, *_ in ends][-2:] == [10.0, 20.0]


def test_callbacks_get_the_end_of_their_move_both_ways(run) -> None:
    times: list[float] = []

    def register(printer: Any) -> None:
        toolhead = printer.lookup_object("toolhead")
        printer.lookup_object("gcode").register_command(
            "MARK", lambda gcmd: toolhead.register_lookahead_callback(times.append)
        )

    gcode = HOMED + "".join(f"G1 X{20 + i % 40} E0.01\n" + "MARK\n" * (i % 3 == 0) for i in range(60))
    both(run, gcode, prepare=register)
    half = len(times) // 2
    assert half == 20
    assert times[:half] == times[half:] == sorted(times[:half])


def test_the_junction_behind_the_last_filament_is_the_same_when_the_extruder_has_cooled(run) -> None:
    def register(printer: Any) -> None:
        heater = printer.lookup_object("extruder").heater
        printer.lookup_object("gcode").register_command(
            "COOL", lambda gcmd: setattr(heater, "can_extrude", False)
        )

    cooled = HOMED + "G1 X30 E1\nCOOL\nG1 X40\nG1 X50\n"
    assert (
        both(run, cooled, prepare=register).out != run(cooled.replace(" E1", ""), True, prepare=register).out
    )
