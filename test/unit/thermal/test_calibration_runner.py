"""The runner of a calibration, on a heater and a run written down here."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import pytest

from base_rig import Session
from extras.heater import run as heater_run
from gcode import CommandError
from reactor import SystemTime
from thermal.identification.run import DONE, Run

DIALOG = [
    "action:prompt_begin TEST of oven",
    "action:prompt_text The heater gets hot by itself. Abort switches it off.",
    "action:prompt_footer_button Abort|ABORT|error",
    "action:prompt_show",
]


class Heater:
    """Notes who has acquired it."""

    name = "oven"

    def __init__(self) -> None:
        self.run: Run | None = None
        self.age_s = 0.1

    def acquire(self, run: Run) -> None:
        self.run = run

    def release(self) -> None:
        self.run = None

    def follow_run(self) -> None:
        pass

    def reading(self, eventtime: float) -> tuple[float, float]:
        return self.age_s, 100.0


class ShortRun(Run):
    """Over when the test says so."""

    def progress(self, temp_c: float) -> str:
        return f"{self.stage}, {temp_c:.0f} C"

    def write(self, stream: TextIO) -> None:
        stream.write("trace\n")


def calibrate(
    tmp_path: Path, body: Callable[[Session, heater_run.Runner, ShortRun], None], time_source: Any = None
) -> list[str]:
    """What is said while `body` goes on beside a run, heater released at its end."""
    heater = Heater()

    def drive(session: Session) -> None:
        runner, run = heater_run.Runner(session.printer, heater, "TEST"), ShortRun("heating")

        def done() -> None:
            assert heater.run is None
            runner.say(f"over: {run.fault or run.stage}")
            if not run.fault:
                runner.fit("fit_load", [], lambda found: runner.say(f"found {found}"), "not found")

        runner.start(run, done)
        assert heater.run is run
        body(session, runner, run)
        runner.wait()
        assert session.gcode.get_handler("ABORT") is None

    lines = Session(tmp_path, "", time_source).run(drive).lines
    lines = [line.removeprefix("// ") for line in lines if "Klipper state" not in line]
    assert lines[: len(DIALOG)] == DIALOG and lines.pop() == "action:prompt_end"
    return lines[len(DIALOG) :]


def test_abort_ends_a_run_and_progress_is_reported_before(tmp_path: Path) -> None:
    def body(session: Session, runner: heater_run.Runner, run: ShortRun) -> None:
        session.sleep(10.5)
        session.gcode.run_script("ABORT")

    assert calibrate(tmp_path, body) == ["TEST: heating, 100 C", "over: ended by ABORT"]


@pytest.mark.parametrize("command", ["ABORT", "CANCEL_PRINT"])
def test_a_client_ends_a_run_that_a_script_waits_for(tmp_path: Path, command: str) -> None:
    """The script holds the lock of the console: the dialog's button must not wait behind it."""

    def body(session: Session, runner: heater_run.Runner, run: ShortRun) -> None:
        gcode, ended = session.gcode, []
        gcode.register_command("CALIBRATE", lambda gcmd: runner.wait())
        gcode.register_command("CANCEL_PRINT", lambda gcmd: None)

        def script(eventtime: float) -> None:
            with pytest.raises(CommandError, match=f"{command} ended the wait for the end of TEST"):
                gcode.run_script("CALIBRATE\nCANCEL_PRINT")
            ended.append(session.reactor.monotonic())

        session.reactor.register_callback(script)
        session.sleep(1.0)
        begin_s = session.reactor.monotonic()
        gcode.run_script(command)
        session.sleep(0.3)
        assert ended and ended[0] - begin_s < 0.2

    assert calibrate(tmp_path, body) == ["over: ended by ABORT"]


def test_a_second_calibration_is_refused_while_one_runs(tmp_path: Path) -> None:
    def body(session: Session, runner: heater_run.Runner, run: ShortRun) -> None:
        second = heater_run.Runner(session.printer, Heater(), "SECOND")
        with pytest.raises(
            session.printer.command_error, match="Another calibration is running; ABORT ends it"
        ):
            second.start(ShortRun("heating"), lambda: None)
        session.gcode.run_script("ABORT")

    assert calibrate(tmp_path, body) == ["over: ended by ABORT"]


def test_a_sensor_that_falls_silent_ends_a_run_unless_it_watches_by_itself(tmp_path: Path) -> None:
    def body(session: Session, runner: heater_run.Runner, run: ShortRun) -> None:
        runner.heater.age_s = math.inf
        run.progress_s, run.timeout_s = math.inf, patience_s
        session.sleep(15.0)
        run.abort("patient")

    patience_s = 10.0
    assert calibrate(tmp_path, body) == ["over: no reading for 10 s"]
    patience_s = math.inf
    assert calibrate(tmp_path, body) == ["over: patient"]


def test_a_trace_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    def body(session: Session, runner: heater_run.Runner, run: ShortRun) -> None:
        path = tmp_path / "missing" / "trace.csv"
        assert runner.write_trace(run, path.parent, lambda: path.open("w"), ". Pity") is None
        path = tmp_path / "trace.csv"
        assert runner.write_trace(run, path.parent, lambda: path.open("w")) == path
        assert path.read_text() == "trace\n"
        run.abort("enough")

    text = f"The trace cannot be written to {tmp_path / 'missing'}: No such file or directory. Pity"
    assert calibrate(tmp_path, body) == [text, "over: enough"]


def fake_python(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    script = tmp_path / "python"
    script.write_text(f"#!/bin/sh\n{text}\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("echo '{\"k\": 1}'", "found {'k': 1}"),
        ("echo first >&2; echo 'no swing' >&2; exit 2", "not found: no swing. Nothing was changed."),
        ("exit 3", "not found: status 3. Nothing was changed."),
        ("echo nonsense", "not found: Expecting value: line 1 column 1 (char 0). Nothing was changed."),
    ],
)
def test_a_fit_says_what_it_finds_or_why_it_finds_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, script: str, said: str
) -> None:
    fake_python(tmp_path, monkeypatch, script)
    lines = calibrate(tmp_path, lambda session, runner, run: setattr(run, "stage", DONE))
    assert lines == ["over: done", said]


def test_abort_ends_a_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_python(tmp_path, monkeypatch, f"touch {tmp_path}/begun; exec sleep 60")

    def body(session: Session, runner: heater_run.Runner, run: ShortRun) -> None:
        run.stage = DONE
        while not (tmp_path / "begun").exists():
            session.sleep(0.01)
        session.gcode.run_script("ABORT")

    said = calibrate(tmp_path, body, SystemTime())
    assert said == ["over: done", "not found: ended by ABORT. Nothing was changed."]
