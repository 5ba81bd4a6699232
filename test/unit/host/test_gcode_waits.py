"""Temperature waits: what PAUSE, CANCEL_PRINT, M108 and a restart do to a script that waits."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from base_rig import Session
from extras.heaters import PrinterHeaters
from gcode import CommandError, GCodeCommand

AT_ONCE_S = 0.2
CONFIG = """[virtual_sdcard]
path: {path}
on_error_gcode: MARK TEXT=on_error
[pause_resume]
[respond]
[gcode_macro START]
gcode:
  MARK TEXT=before
  M109 S200
  MARK TEXT=hot
[gcode_macro PAUSE]
rename_existing: BASE_PAUSE
gcode:
  BASE_PAUSE
  M104 S0
[gcode_macro RESUME]
rename_existing: BASE_RESUME
gcode:
  M109 S150
  BASE_RESUME
"""


class Heater:
    """Hot as soon as the test says so."""

    name = "extruder"

    def __init__(self) -> None:
        self.temp_c = 20.0
        self.target_c = 0.0

    def set_temp(self, target_c: float) -> None:
        self.target_c = target_c

    def get_temp(self, eventtime: float) -> tuple[float, float]:
        return self.temp_c, self.target_c

    def check_busy(self, eventtime: float) -> bool:
        return self.temp_c < self.target_c


class Printer(Session):
    """A session with a heater, a file `part.gcode`, and marks of the lines that were run."""

    def __init__(self, folder: Path, text: str, config: str = CONFIG, **start_args: object) -> None:
        (folder / "part.gcode").write_text(text)
        super().__init__(folder, config.format(path=folder), **start_args)
        self.heater = Heater()
        self.marks: list[str] = []
        self.errors: list[str] = []
        self.printer.add_object(
            "toolhead",
            SimpleNamespace(
                register_lookahead_callback=lambda callback: None,
                get_last_move_time=lambda: 0.0,
                dwell=lambda delay: None,
                wait_moves=lambda: None,
                get_status=lambda eventtime: {"print_time": 0.0, "estimated_print_time": 0.0},
            ),
        )
        heaters = PrinterHeaters(self.printer)
        heaters.register()
        self.printer.add_object("heaters", heaters)
        heaters.heaters["extruder"] = self.heater
        heaters.available_sensors.append("extruder")

        def set_temperature(wait: bool) -> Callable[[GCodeCommand], None]:
            return lambda gcmd: heaters.set_temperature(self.heater, gcmd.get_float("S"), wait)

        for name, handler in (
            ("M104", set_temperature(False)),
            ("M109", set_temperature(True)),
            ("MARK", lambda gcmd: self.marks.append(gcmd.get("TEXT"))),
            ("SAVE_GCODE_STATE", lambda gcmd: None),
            ("RESTORE_GCODE_STATE", lambda gcmd: None),
        ):
            self.gcode.register_command(name, handler)

    def beside(self, script: str) -> None:
        """A request of another client."""

        def run(eventtime: float) -> None:
            try:
                self.gcode.run_script(script)
            except CommandError as e:
                self.errors.append(str(e))

        self.reactor.register_callback(run)
        self.sleep(AT_ONCE_S)

    def print(self) -> None:
        self.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        self.sleep(3.0)
        assert self.state_of_print == "printing"

    @property
    def state_of_print(self) -> str:
        return str(self.status("print_stats")["state"])


PART = "START\nMARK TEXT=second\n"


@pytest.mark.parametrize("wait", ["START", "M109 S200", "TEMPERATURE_WAIT SENSOR=extruder MINIMUM=200"])
def test_cancel_ends_the_wait_at_once_and_nothing_behind_it_runs(tmp_path: Path, wait: str) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        s.beside("CANCEL_PRINT")
        assert s.state_of_print == "cancelled"
        s.heater.temp_c = 250.0
        s.sleep(5.0)
        assert set(s.marks) <= {"before"}
        assert s.status("virtual_sdcard")["file_path"] is None
        assert not any(line.startswith("!!") for line in s.lines)

    Printer(tmp_path, f"{wait}\nMARK TEXT=cold\n").run(body)


def test_pause_freezes_the_macro_in_its_wait_and_resume_waits_for_the_same_temperature(
    tmp_path: Path,
) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        s.beside("PAUSE")
        assert (s.state_of_print, s.status("pause_resume")["is_paused"]) == ("paused", True)
        assert s.heater.target_c == 0.0, "the macro has run"
        s.gcode.run_script("MARK TEXT=console")  # others have their turn meanwhile
        s.heater.temp_c = 250.0
        s.sleep(10.0)
        assert s.marks == ["before", "console"]
        s.heater.temp_c = 160.0
        s.gcode.run_script("RESUME")
        s.sleep(5.0)
        assert (s.state_of_print, s.heater.target_c) == ("printing", 200.0)
        assert s.marks == ["before", "console"], "at 160 C nothing runs"
        s.heater.temp_c = 201.0
        s.sleep(1.5)
        assert s.marks == ["before", "console", "hot", "second"]
        assert s.state_of_print == "complete"

    Printer(tmp_path, PART).run(body)


def test_a_paused_wait_is_paused_again_cancelled_or_forgotten(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        for last, state in (
            ("CANCEL_PRINT", "cancelled"),
            ("SDCARD_RESET_FILE", "standby"),
            ("CLEAR_PAUSE", "paused"),
        ):
            s.heater.temp_c, s.marks = 160.0, []
            s.print()
            for command in ("PAUSE", "RESUME", "PAUSE"):
                s.beside(command)
            assert s.state_of_print == "paused"
            s.beside(last)
            assert s.state_of_print == state
            s.heater.temp_c = 250.0
            s.sleep(3.0)
            assert s.marks == ["before"]
            s.gcode.run_script("CANCEL_PRINT")

    Printer(tmp_path, PART).run(body)


def test_pause_and_cancel_end_the_wait_of_resume(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        for command, state in (("PAUSE", "paused"), ("CANCEL_PRINT", "cancelled")):
            if s.state_of_print != "paused":
                s.beside("PAUSE")
            s.beside("RESUME")
            s.beside(command)
            assert s.state_of_print == state
            assert f"{command} ended the wait for extruder to reach 150.0 C" in s.errors.pop()
        s.heater.temp_c = 250.0
        s.sleep(3.0)
        assert s.marks == ["before"]

    Printer(tmp_path, PART).run(body)


def test_m108_ends_a_wait_with_the_script_around_it(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.beside("START")
        s.beside("M108")
        assert s.errors == [
            "M108 ended the wait for extruder to reach 200.0 C; the rest of the script was not run"
        ]
        s.print()
        s.beside("M108")
        assert s.state_of_print == "error"
        assert "M108 ended the wait" in s.status("print_stats")["message"]
        s.heater.temp_c = 250.0
        s.sleep(3.0)
        assert s.marks == ["before", "before", "on_error"]

    Printer(tmp_path, PART).run(body)


def test_a_restart_does_not_wait_for_the_temperature(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        before = s.reactor.monotonic()
        s.gcode.run_script("RESTART")
        assert s.reactor.monotonic() - before < AT_ONCE_S

    assert Printer(tmp_path, PART).run(body).result == "restart"


def test_a_shutdown_ends_a_paused_wait(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        s.beside("PAUSE")
        s.printer.invoke_shutdown("test")
        s.sleep(1.0)
        assert s.status("virtual_sdcard")["is_active"] is False
        assert s.marks == ["before"]

    Printer(tmp_path, PART).run(body)


def test_a_macro_pause_that_fails_lets_the_print_wait_on(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        s.beside("PAUSE")
        assert s.errors == ["no"]
        assert s.state_of_print == "printing"
        s.heater.temp_c = 250.0
        s.sleep(2.0)
        assert s.state_of_print == "complete"

    failing = CONFIG.replace("  BASE_PAUSE\n", '  {{action_raise_error("no")}}\n')
    Printer(tmp_path, PART, failing).run(body)


def test_without_pause_resume_pause_waits_for_its_turn(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        s.print()
        s.beside("PAUSE")
        s.heater.temp_c = 250.0
        s.sleep(2.0)
        assert s.state_of_print == "complete"

    no_pause = CONFIG.replace("[pause_resume]\n", "").partition("[gcode_macro PAUSE]")[0]
    Printer(tmp_path, PART, no_pause).run(body)


@pytest.mark.parametrize("own", [False, True], ids=["print", "console"])
def test_the_console_ends_waits_of_the_print_and_its_own(tmp_path: Path, own: bool) -> None:
    """Numbered lines, behind another line that waits for its turn."""
    here, there = socket.socketpair()
    here.setblocking(False)

    def body(s: Session) -> None:
        assert isinstance(s, Printer)
        type_in = lambda text: (there.send(text), s.sleep(AT_ONCE_S))  # noqa: E731
        if own:
            type_in(b"START\n")
        else:
            s.print()
        type_in(b"MARK TEXT=queued\n")
        type_in(b"N7 PAUSE\n")
        assert s.status("pause_resume")["is_paused"] is True
        s.heater.temp_c = 160.0
        type_in(b"RESUME\n")
        assert (s.status("pause_resume")["is_paused"], s.heater.target_c) == (False, 200.0)
        type_in(b"CANCEL_PRINT\n")
        s.heater.temp_c = 250.0
        s.sleep(3.0)
        assert sorted(s.marks) == ["before", "queued"]
        type_in(b"MARK TEXT=later\n")
        assert s.marks[-1] == "later"

    Printer(tmp_path, PART, gcode_fd=here.fileno()).run(body)
    there.close()
