#!/usr/bin/env python3
"""Runs tests in Klipper's .test format in batch mode, and checks what they expect.

    scripts/test_klippy.py [-d FOLDER_OF_DICTIONARIES] FILE.test ...

A file is read line by line; a CONFIG line begins a case. What stands before the first one holds for all.

    CONFIG printer.cfg                       relative to the test file
    DICTIONARY ferrite.dict [zed=other.dict] from the folder of dictionaries; NAME=: of a further MCU
    GCODE part.gcode                         relative to the test file
    SHOULD_FAIL                              the run must end with an error
    G28                                      any other line is G-code

and, beyond Klipper's format, because an exit status alone proves little:

    OPTION [stepper_x] position_max: 100     set an option of the config
    REFUSED G1 X500 => Move out of range     this line must be refused with that text, and the run goes on
    EXPECT steps stepper_x: 1600 net -800    steps made, and their sum in the motor's direction
    EXPECT position X=1 Y=2 Z=3 E=4          of the toolhead at the end (mm, to 1e-6)
    EXPECT response some text                some answer contains it (no_response: none does)
    EXPECT error some text                   the error that ended the run contains it
    EXPECT temperature extruder: 200 0       targets set, in this order (the end of a run sets 0)
    EXPECT duration stepper_x: 3.25          from its first step to its last (s, to 50 us)
"""

from __future__ import annotations

import in_venv

import argparse
import logging
import os
import re
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

import msgproto  # noqa: E402
from printer import Printer  # noqa: E402
from reactor import Reactor  # noqa: E402

DEFAULT_DICTIONARIES = ROOT / "out" / "simulator"
POSITION_TOLERANCE_MM = 1e-6
DURATION_TOLERANCE_S = 50e-6  # the error allowed to a step is 25 us
REFUSED_COMMAND = "TEST_REFUSED"
STEP_MESSAGES = ("queue_step", "set_next_step_dir", "reset_step_clock")

_OPTION = re.compile(r"\[(?P<section>[^\]]+)\]\s*(?P<option>\w+)\s*[:=]\s*(?P<value>.*)")
_STEPS = re.compile(r"(?P<name>[^:]+):\s*(?P<count>\d+)(?:\s+net\s+(?P<net>-?\d+))?")
_DURATION = re.compile(r"(?P<name>[^:]+):\s*(?P<seconds>[\d.]+)")


class TestError(Exception):
    """A test file is malformed, or a case did not do what it should; the text says which."""

    __test__ = False


@dataclass(frozen=True, slots=True)
class Case:
    """One run of a printer, and what is expected of it."""

    source: str  # file and line of its CONFIG
    config: Path | None = None
    dictionaries: tuple[tuple[str, str], ...] = ()  # (MCU's name, file name)
    gcode: tuple[str, ...] = ()
    refusals: tuple[tuple[str, str], ...] = ()  # (G-code line, text)
    options: tuple[tuple[str, str, str], ...] = ()
    expectations: tuple[tuple[str, str], ...] = ()  # (kind, rest of the line)
    should_fail: bool = False


def read_cases(path: Path) -> list[Case]:
    """The cases of a .test file."""
    shared = Case(str(path))
    cases: list[Case] = []
    current = shared
    for number, raw in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        keyword, _, rest = line.partition(" ")
        rest = rest.strip()
        if keyword == "CONFIG":
            if current is not shared:
                cases.append(current)
            else:
                shared = current
            current = replace(shared, source=f"{path}:{number}", config=path.parent / rest)
        else:
            try:
                changed = _apply(current, path.parent, keyword, rest, line)
            except (ValueError, OSError) as e:
                raise TestError(f"{path}:{number}: {e}") from None
            if current is shared:
                shared = changed
            current = changed
    if current.config is None:
        raise TestError(f"{path}: a test needs a CONFIG line")
    return [*cases, current]


def _add_dictionary(case: Case, folder: Path, rest: str) -> Case:
    pairs = (entry.rpartition("=") for entry in rest.split())
    return replace(case, dictionaries=tuple((name or "mcu", file) for name, _, file in pairs))


def _add_gcode_file(case: Case, folder: Path, rest: str) -> Case:
    text = (folder / rest).read_text(encoding="utf-8")
    return replace(case, gcode=case.gcode + tuple(text.splitlines()))


def _set_should_fail(case: Case, folder: Path, rest: str) -> Case:
    return replace(case, should_fail=True)


def _add_option(case: Case, folder: Path, rest: str) -> Case:
    found = _OPTION.fullmatch(rest)
    if found is None:
        raise ValueError("expected: OPTION [section] option: value")
    return replace(case, options=(*case.options, (found["section"], found["option"], found["value"])))


def _add_expectation(case: Case, folder: Path, rest: str) -> Case:
    kind, _, what = rest.partition(" ")
    if kind not in CHECKS:
        raise ValueError(f"unknown expectation '{kind}' (known: {', '.join(CHECKS)})")
    return replace(case, expectations=(*case.expectations, (kind, what.strip())))


def _add_refusal(case: Case, folder: Path, rest: str) -> Case:
    gcode, arrow, text = rest.partition("=>")
    if not arrow or not text.strip():
        raise ValueError("expected: REFUSED <G-code> => <text of the error>")
    line = f"{REFUSED_COMMAND} N={len(case.refusals)}"
    refusals = (*case.refusals, (gcode.strip(), text.strip()))
    return replace(case, gcode=(*case.gcode, line), refusals=refusals)


KEYWORDS = {
    "DICTIONARY": _add_dictionary,
    "GCODE": _add_gcode_file,
    "SHOULD_FAIL": _set_should_fail,
    "OPTION": _add_option,
    "EXPECT": _add_expectation,
    "REFUSED": _add_refusal,
}


def _apply(case: Case, folder: Path, keyword: str, rest: str, line: str) -> Case:
    """The case with one more line."""
    add = KEYWORDS.get(keyword)
    return replace(case, gcode=(*case.gcode, line)) if add is None else add(case, folder, rest)


# ---- running ----


@dataclass
class Motor:
    """What an MCU would do with a stepper's commands."""

    steps: int = 0
    position: int = 0
    clock: int = 0
    first_clock: int | None = None
    direction: int = 0

    def feed(self, params: dict[str, Any]) -> None:
        name = params["#name"]
        if name == "set_next_step_dir":
            self.direction = 1 if params["dir"] else -1
        elif name == "reset_step_clock":
            self.clock += (params["clock"] - self.clock) & 0xFFFFFFFF
        else:
            count = params["count"]
            if self.first_clock is None:
                self.first_clock = self.clock + params["interval"]
            self.steps += count
            self.position += count * self.direction
            self.clock += params["interval"] * count + params["add"] * (count * (count - 1) // 2)


@dataclass
class Outcome:
    """What a run has left."""

    result: str = ""
    message: str = ""
    replies: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  # lines that were not refused as they should
    motors: dict[str, Motor] = field(default_factory=dict)
    motor_hz: dict[str, float] = field(default_factory=dict)
    targets: dict[str, list[float]] = field(default_factory=dict)
    position: list[float] = field(default_factory=list)

    def errors(self) -> list[str]:
        return [r for r in self.replies if r.startswith("!!")] + (
            [self.message] if self.result != "exit" else []
        )


class Run:
    """Runs one case in this process."""

    def __init__(self, case: Case, dictionaries: Path, folder: Path) -> None:
        self.case = case
        self.folder = folder
        self.files = {name: dictionaries / file for name, file in case.dictionaries}
        if not self.files:
            raise TestError(f"{case.source}: a DICTIONARY line is missing")
        self.outcome = Outcome()

    def _start_args(self) -> dict[str, Any]:
        gcode_path = self.folder / "in.gcode"
        gcode_path.write_text("\n".join(self.case.gcode) + "\n", encoding="utf-8")
        args: dict[str, Any] = {
            "config_file": str(self.case.config),
            "config_overrides": list(self.case.options),
            "apiserver": None,
            "start_reason": "startup",
            "software_version": "test",
            "cpu_info": "test",
            "debuginput": str(gcode_path),
            "gcode_fd": os.open(gcode_path, os.O_RDONLY),
            "debugoutput": str(self.folder / "out"),
        }
        for name, path in self.files.items():
            args["dictionary" if name == "mcu" else f"dictionary_{name}"] = str(path)
        return args

    def execute(self) -> Outcome:
        reactor = Reactor()
        printer = Printer(reactor, self._start_args())
        gcode = printer.lookup_object("gcode")
        gcode.register_output_handler(self.outcome.replies.append)
        gcode.register_command(REFUSED_COMMAND, lambda gcmd: self._refused(gcode, gcmd))
        printer.register_event_handler("klippy:ready", lambda: self._watch_heaters(printer))
        self.outcome.result = printer.run()
        self.outcome.message = printer.get_state_message()[0]
        toolhead = printer.lookup_object("toolhead", None)
        if toolhead is not None:
            self.outcome.position = list(toolhead.get_position())
        self._decode(printer)
        reactor.finalize()
        return self.outcome

    def _refused(self, gcode: Any, gcmd: Any) -> None:
        """The line must fail; in batch mode that would end the run, so for once this is none."""
        line, text = self.case.refusals[gcmd.get_int("N")]
        gcode.is_fileinput = False
        try:
            gcode.run_script_from_command(line)
        except Printer.command_error as e:
            if text not in str(e):
                self.outcome.problems.append(f"'{line}' was refused with '{e}', not with '{text}'")
        else:
            self.outcome.problems.append(f"'{line}' was not refused ('{text}')")
        finally:
            gcode.is_fileinput = True

    def _watch_heaters(self, printer: Any) -> None:
        """Note every target set, by heater."""
        heaters = printer.lookup_object("heaters", None)
        for name, heater in getattr(heaters, "heaters", {}).items():
            trace = self.outcome.targets.setdefault(name.split()[-1], [])

            def noting(degrees: float, plain: Any = heater.set_temp, trace: list[float] = trace) -> None:
                plain(degrees)  # raises if it is out of range
                trace.append(degrees)

            heater.set_temp = noting

    def _decode(self, printer: Any) -> None:
        force_move = printer.lookup_object("force_move", None)
        steppers = force_move.steppers if force_move is not None else {}
        for mcu, dictionary in self.files.items():
            path = self.folder / ("out" if mcu == "mcu" else f"out-{mcu}")
            by_oid = {s.get_oid(): n for n, s in steppers.items() if s.get_mcu().get_name() == mcu}
            self.outcome.motors.update({name: Motor() for name in by_oid.values()})
            if not path.exists():
                continue
            parser = msgproto.MessageParser()
            parser.process_identify(dictionary.read_bytes(), decompress=False)
            hz = parser.get_constant_float("CLOCK_FREQ")
            self.outcome.motor_hz.update(dict.fromkeys(by_oid.values(), hz))
            for params in _messages(parser, path):
                if params["#name"] in STEP_MESSAGES:
                    self.outcome.motors[by_oid[params["oid"]]].feed(params)


def _messages(parser: msgproto.MessageParser, path: Path) -> Iterator[dict[str, Any]]:
    for block in msgproto.BlockReader().feed(path.read_bytes()):
        if block is not None:
            yield from parser.parse_content(block.content)


# ---- expectations: each returns what is wrong, or nothing ----


def _motor(outcome: Outcome, name: str) -> Motor:
    motor = outcome.motors.get(name.strip())
    if motor is None:
        raise TestError(f"there is no stepper '{name.strip()}' (known: {', '.join(outcome.motors)})")
    return motor


def check_steps(outcome: Outcome, what: str) -> str | None:
    found = _STEPS.fullmatch(what)
    if found is None:
        raise TestError(f"EXPECT steps {what}: expected 'stepper: count [net number]'")
    motor = _motor(outcome, found["name"])
    net = motor.position if found["net"] is None else int(found["net"])
    if (motor.steps, motor.position) != (int(found["count"]), net):
        return f"{found['name']} made {motor.steps} steps net {motor.position}"
    return None


def check_duration(outcome: Outcome, what: str) -> str | None:
    found = _DURATION.fullmatch(what)
    if found is None:
        raise TestError(f"EXPECT duration {what}: expected 'stepper: seconds'")
    name = found["name"].strip()
    motor = _motor(outcome, name)
    duration_s = (motor.clock - (motor.first_clock or 0)) / outcome.motor_hz[name]
    if abs(duration_s - float(found["seconds"])) > DURATION_TOLERANCE_S:
        return f"{name} steps for {duration_s:.6f} s"
    return None


def check_position(outcome: Outcome, what: str) -> str | None:
    for pair in what.split():
        letter, _, value = pair.partition("=")
        index = "XYZE".find(letter)
        if index < 0 or not value:
            raise TestError(f"EXPECT position {what}: expected X=, Y=, Z=, E=")
        if not outcome.position or abs(outcome.position[index] - float(value)) > POSITION_TOLERANCE_MM:
            return f"the toolhead is at {outcome.position}"
    return None


def check_response(outcome: Outcome, what: str) -> str | None:
    return None if any(what in reply for reply in outcome.replies) else f"answers: {outcome.replies}"


def check_no_response(outcome: Outcome, what: str) -> str | None:
    matching = [reply for reply in outcome.replies if what in reply]
    return f"answers: {matching}" if matching else None


def check_error(outcome: Outcome, what: str) -> str | None:
    return None if any(what in text for text in outcome.errors()) else f"errors: {outcome.errors()}"


def check_temperature(outcome: Outcome, what: str) -> str | None:
    name, _, values = what.partition(":")
    wanted = [float(value) for value in values.split()]
    targets = outcome.targets.get(name.strip())
    return None if targets == wanted else f"targets of {name.strip()}: {targets}"


CHECKS = {
    "steps": check_steps,
    "duration": check_duration,
    "position": check_position,
    "response": check_response,
    "no_response": check_no_response,
    "error": check_error,
    "temperature": check_temperature,
}


def run_case(case: Case, dictionaries: Path = DEFAULT_DICTIONARIES) -> list[str]:
    """Run a case; returns what is wrong, line by line."""
    with tempfile.TemporaryDirectory() as folder:
        outcome = Run(case, dictionaries, Path(folder)).execute()
    wrong = list(outcome.problems)
    failed = outcome.result != "exit"
    if failed != case.should_fail:
        wrong.append("it did not fail" if case.should_fail else f"it failed: {outcome.errors()}")
    for kind, what in case.expectations:
        problem = CHECKS[kind](outcome, what)
        if problem is not None:
            wrong.append(f"EXPECT {kind} {what}: {problem}")
    return [f"{case.source}: {text}" for text in wrong]


def run_file(path: Path, dictionaries: Path = DEFAULT_DICTIONARIES) -> list[str]:
    """Run all cases of a .test file; returns what is wrong."""
    return [text for case in read_cases(path) for text in run_case(case, dictionaries)]


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status 0: all passed, 1: some failed, 2: a file can not be used."""
    parser = argparse.ArgumentParser(description="Run tests in Klipper's .test format.")
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE.test")
    parser.add_argument("-d", "--dictdir", type=Path, default=DEFAULT_DICTIONARIES, help="(%(default)s)")
    parser.add_argument("-v", "--verbose", action="store_true", help="show the printer's log")
    options = parser.parse_args(argv)
    logging.basicConfig(level=logging.INFO if options.verbose else logging.CRITICAL)
    status = 0
    for path in options.files:
        try:
            wrong = run_file(path, options.dictdir)
        except (TestError, OSError) as e:
            print(f"{path}: {e}", file=sys.stderr)
            return 2
        print(f"{path}: {'FAILED' if wrong else 'ok'}")
        for text in wrong:
            print(f"    {text}")
        status |= bool(wrong)
    return status


if __name__ == "__main__":
    sys.exit(main())
