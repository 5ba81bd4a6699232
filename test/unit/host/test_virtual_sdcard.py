"""Printing files, pausing, macros: the modules that feed G-code."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Any

import pytest

from base_rig import Session
from gcode import CommandError

CONFIG = """[virtual_sdcard]
path: {path}
on_error_gcode: RESPOND MSG=on_error
[pause_resume]
[display_status]
[respond]
[gcode_macro MOVE]
variable_count: 0
gcode:
  SET_GCODE_VARIABLE MACRO=MOVE VARIABLE=count VALUE={{count + 1}}
"""


def sd_session(tmp_path: Path, **files: str) -> Session:
    folder = tmp_path / "gcodes"
    folder.mkdir(exist_ok=True)
    for name, text in files.items():
        (folder / f"{name}.gcode").write_text(text)
    session = Session(tmp_path, CONFIG.format(path=folder).replace("{{", "{").replace("}}", "}"))
    gcode = session.printer.lookup_object("gcode")
    # gcode_move is another module's: the two commands pause_resume needs
    gcode.register_command("SAVE_GCODE_STATE", lambda gcmd: None)
    gcode.register_command("RESTORE_GCODE_STATE", lambda gcmd: None)
    return session


def wait_until(session: Session, state: str, limit_s: float = 60.0) -> None:
    end = session.reactor.monotonic() + limit_s
    while session.status("print_stats")["state"] != state:
        assert session.reactor.monotonic() < end, f"never {state}: {session.status('print_stats')}"
        session.sleep(0.05)


def test_a_file_is_printed_to_its_end(tmp_path: Path) -> None:
    text = "; header\n" + "MOVE\n" * 3000 + "M117 d\u00f6ne"  # several chunks, no line end at the end

    def body(s: Session) -> None:
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        assert s.status("virtual_sdcard")["is_active"] is True
        wait_until(s, "complete")
        assert s.status("gcode_macro MOVE")["count"] == 3000
        status = s.status("virtual_sdcard")
        assert (status["is_active"], status["file_path"]) == (False, None)
        assert status["progress"] == 1.0
        assert status["file_position"] == status["file_size"] == len(text.encode())
        assert s.status("display_status")["message"] == "d\u00f6ne"

    session = sd_session(tmp_path, part=text).run(body)
    assert "Done printing file" in session.lines
    assert f"File opened:part.gcode Size:{len(text.encode())}" in session.lines


def test_missing_file_is_a_clear_error(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        with pytest.raises(CommandError, match=r"Unable to open file 'none.gcode' in .*: No such file"):
            s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=none.gcode")
        with pytest.raises(CommandError, match="outside"):
            s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=../printer.cfg")
        with pytest.raises(CommandError, match="No file is selected"):
            s.gcode.run_script("M24")

    sd_session(tmp_path).run(body)


def test_links_and_letters_lead_to_files_and_never_in_circles(tmp_path: Path) -> None:
    session = sd_session(tmp_path, Part="MOVE\n")
    folder, elsewhere = tmp_path / "gcodes", tmp_path / "stick"
    elsewhere.mkdir()
    (elsewhere / "linked.gcode").write_text("MOVE\nMOVE\n")
    (folder / "usb").symlink_to(elsewhere)
    (elsewhere / "back").symlink_to(folder)

    def body(s: Session) -> None:
        card = s.printer.lookup_object("virtual_sdcard")
        assert card.get_file_list(check_subdirs=True) == [("Part.gcode", 5), ("usb/linked.gcode", 10)]
        for name, moves in (("pART.gcode", 1), ("usb/linked.gcode", 3)):
            s.gcode.run_script(f"SDCARD_PRINT_FILE FILENAME={name}")
            wait_until(s, "complete")
            assert s.status("gcode_macro MOVE")["count"] == moves

    session.run(body)


def test_a_named_file_is_opened_without_a_look_at_all_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part may lie in a home folder with a million files."""
    monkeypatch.setattr("extras.virtual_sdcard.os.scandir", lambda *_: pytest.fail("looked"))

    def body(s: Session) -> None:
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        wait_until(s, "complete")

    sd_session(tmp_path, part="MOVE\n").run(body)


def test_a_pipe_or_a_device_is_no_file_to_print(tmp_path: Path) -> None:
    session = sd_session(tmp_path, part="MOVE\n")
    os.mkfifo(tmp_path / "gcodes" / "pipe.gcode")  # opening it would wait for a writer for ever
    (tmp_path / "gcodes" / "zero.gcode").symlink_to("/dev/zero")

    def body(s: Session) -> None:
        for name, words in (("pipe.gcode", "it is no plain file"), ("zero.gcode", "outside")):
            with pytest.raises(CommandError, match=words):
                s.gcode.run_script(f"SDCARD_PRINT_FILE FILENAME={name}")

    session.run(body)


@pytest.mark.parametrize("script", ["SDCARD_PRINT_FILE FILENAME=none.gcode", "M23 none.gcode", "M20"])
def test_twenty_thousand_files_do_not_hold_up_the_host(tmp_path: Path, script: str) -> None:
    session = sd_session(tmp_path, part="MOVE\n")
    for number in range(20_000):
        (tmp_path / "gcodes" / f"part{number}.gcode").touch()
    longest_s, seen = 0.0, time.process_time()

    def look(eventtime: float) -> float:
        nonlocal longest_s, seen
        now = time.process_time()
        longest_s, seen = max(longest_s, now - seen), now
        return session.reactor.NOW

    def body(s: Session) -> None:
        s.reactor.register_timer(look, s.reactor.NOW)
        s.reactor.pause(s.reactor.NOW)
        nonlocal longest_s
        longest_s = 0.0
        with contextlib.suppress(CommandError):
            s.gcode.run_script(script)
        s.reactor.pause(s.reactor.NOW)
        assert longest_s < 0.1  # 20 ms at rest; looking at each file of them takes 150 ms
        assert (sum("part" in line for line in s.lines) == 20_001) == (script == "M20")

    session.run(body)


def test_pause_resume_from_outside_loses_no_line(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.register_command("SLOW", lambda gcmd: s.sleep(0.1))
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        s.sleep(1.05)
        s.gcode.run_script("PAUSE")
        wait_until(s, "paused")
        done = s.status("gcode_macro MOVE")["count"]
        position = s.status("virtual_sdcard")["file_position"]
        assert 5 <= done <= 15
        assert position in (done * 10, done * 10 + 5)  # after a MOVE or after a SLOW
        s.sleep(3.0)
        assert s.status("gcode_macro MOVE")["count"] == done
        assert s.status("pause_resume")["is_paused"] is True
        s.gcode.run_script("RESUME")
        wait_until(s, "complete")
        assert s.status("gcode_macro MOVE")["count"] == 30
        stats = s.status("print_stats")
        assert stats["total_duration"] == pytest.approx(6.0, abs=0.3)  # 30 x 0.1 s and the pause of 3 s

    sd_session(tmp_path, part="SLOW\nMOVE\n" * 30).run(body)


def test_pause_inside_the_file_stops_behind_it(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        wait_until(s, "paused")
        assert s.status("gcode_macro MOVE")["count"] == 1
        assert s.status("virtual_sdcard")["file_position"] == len("MOVE\nPAUSE\n")
        s.gcode.run_script("RESUME")
        wait_until(s, "complete")
        assert s.status("gcode_macro MOVE")["count"] == 2

    sd_session(tmp_path, part="MOVE\nPAUSE\nMOVE\n").run(body)


def test_cancel_and_print_another(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.register_command("SLOW", lambda gcmd: s.sleep(0.1))
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        s.sleep(0.5)
        s.gcode.run_script("CANCEL_PRINT\nSDCARD_PRINT_FILE FILENAME=other.gcode")
        wait_until(s, "complete")
        assert s.status("gcode_macro MOVE")["count"] == 2
        assert s.status("print_stats")["filename"] == "other.gcode"
        s.gcode.run_script("SDCARD_RESET_FILE")
        assert s.status("print_stats")["state"] == "standby"

    sd_session(tmp_path, part="SLOW\n" * 100 + "MOVE\n", other="MOVE\nMOVE\n").run(body)


def test_an_error_in_the_file_ends_the_print_and_says_why(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        wait_until(s, "error")
        assert s.status("print_stats")["message"] == "RESPOND TYPE 'x' is invalid. Must be one of " + (
            "'echo', 'command', 'error', 'echo_no_space'"
        )
        assert s.status("gcode_macro MOVE")["count"] == 1
        s.sleep(0.1)

    session = sd_session(tmp_path, part="MOVE\nRESPOND TYPE=x\nMOVE\n").run(body)
    assert "echo: on_error" in session.lines


def test_commands_from_elsewhere_get_their_turn(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.register_command("SLOW", lambda gcmd: s.sleep(0.1))
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        s.sleep(0.15)
        before = s.reactor.monotonic()
        s.gcode.run_script("M118 now")
        assert s.reactor.monotonic() - before <= 0.11  # after the running line, not after the file

    sd_session(tmp_path, part="SLOW\n" * 100).run(body)


def test_reading_by_selection_and_position(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script("M23 part.gcode\nM27\nM26 S5\nM27\nM24")
        wait_until(s, "complete")
        assert s.status("gcode_macro MOVE")["count"] == 1

    session = sd_session(tmp_path, part="MOVE\nMOVE\n").run(body)
    assert [line for line in session.lines if line.startswith("SD printing")] == [
        "SD printing byte 0/10",
        "SD printing byte 5/10",
    ]


def test_feeding_is_fast(tmp_path: Path) -> None:
    lines = 40000
    text = "G1 X100.123 Y50.333 E0.01234\n" * lines

    def body(s: Session) -> None:
        s.gcode.register_command("G1", lambda gcmd: None)
        started_s = time.process_time()
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        wait_until(s, "complete", 1e6)
        assert (
            time.process_time() - started_s
        ) / lines < 40e-6  # about 4 us measured: 5 MB take below a second

    sd_session(tmp_path, part=text).run(body)


# --- macros and the like ---
MACROS = """[respond]
[gcode_macro GREET]
description: says hello
gcode:
  {% if params.NAME is defined %}
    M118 hello {params.NAME} from {printer.configfile.settings.respond.default_type}
  {% else %}
    {action_raise_error("NAME is missing")}
  {% endif %}
[gcode_macro M118]
rename_existing: M9118
gcode: M9118 wrapped {rawparams}
[gcode_macro LOOP]
gcode: LOOP
[gcode_macro BROKEN]
gcode: {printer.nothing.at_all}
"""


def macros(tmp_path: Path, script: str, expect_error: str | None = None) -> list[str]:
    def body(s: Session) -> None:
        if expect_error is None:
            s.gcode.run_script(script)
        else:
            with pytest.raises(CommandError, match=expect_error):
                s.gcode.run_script(script)

    return [line for line in Session(tmp_path, MACROS).run(body).lines if line.startswith("echo")]


def test_macro_with_parameters_and_renamed_command(tmp_path: Path) -> None:
    assert macros(tmp_path, 'GREET NAME="big world"') == ["echo: wrapped hello big world from echo"]


def test_macro_errors_are_for_people(tmp_path: Path) -> None:
    macros(tmp_path, "GREET", "NAME is missing")
    macros(tmp_path, "LOOP", "LOOP called recursively")
    macros(tmp_path, "BROKEN", "'printer' has no attribute 'nothing'")
    macros(tmp_path, "SET_GCODE_VARIABLE MACRO=LOOP VARIABLE=x VALUE=1", "Unknown gcode_macro variable 'x'")


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (
            "[gcode_macro A]\ngcode: {% if %}\n",
            "Error loading template 'gcode_macro A:gcode' (printer.cfg, line 2)",
        ),
        ("[gcode_macro A]\n", "Option 'gcode' in section 'gcode_macro A' must be specified"),
        ("[gcode_macro A]\nvariable_x: )\ngcode:\n", "Option 'variable_x' in section 'gcode_macro A'"),
        ("[gcode_macro A]\nrename_existing: B\ngcode:\n", "Existing command 'A' not found"),
        ("[gcode_macro G1]\nrename_existing: OLD\ngcode:\n", "different types"),
    ],
)
def test_wrong_macros_are_refused_at_start(tmp_path: Path, config: str, expected: str) -> None:
    from base_rig import start_error

    assert expected in start_error(tmp_path, config)


def test_macros_can_not_leave_the_sandbox(tmp_path: Path) -> None:
    config = "[gcode_macro A]\ngcode: {''.__class__.__mro__[1].__subclasses__()}\n"

    def body(s: Session) -> None:
        with pytest.raises(CommandError, match="unsafe"):
            s.gcode.run_script("A")

    Session(tmp_path, config).run(body)


def test_variables_survive_a_restart(tmp_path: Path) -> None:
    config = f"[save_variables]\nfilename: {tmp_path}/vars.cfg\n"

    def write(s: Session) -> None:
        s.gcode.run_script("SAVE_VARIABLE VARIABLE=size VALUE='[1, \"two\"]'")
        for wrong in ("VARIABLE=Size VALUE=1", "VARIABLE=x VALUE=words"):
            with pytest.raises(CommandError):
                s.gcode.run_script(f"SAVE_VARIABLE {wrong}")

    def read(s: Session) -> None:
        assert s.status("save_variables")["variables"] == {"size": [1, "two"]}

    Session(tmp_path, config).run(write)
    Session(tmp_path, config).run(read)


def test_idle_timeout_runs_its_gcode_once(tmp_path: Path) -> None:
    config = "[respond]\n[idle_timeout]\ntimeout: 30\ngcode: M118 idle\n"

    def body(s: Session) -> None:
        s.gcode.register_command("SLOW", lambda gcmd: s.sleep(2.0))
        s.gcode.run_script("SLOW")
        assert s.status("idle_timeout")["state"] == "Printing"
        s.sleep(5.0)
        assert s.status("idle_timeout")["state"] == "Ready"
        s.sleep(60.0)
        assert s.status("idle_timeout")["state"] == "Idle"

    assert Session(tmp_path, config).run(body).lines.count("echo: idle") == 1


def test_display_progress_prefers_the_slicer(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script("M73 P42")
        assert s.status("display_status")["progress"] == 0.42
        s.sleep(60.0)
        assert s.status("display_status")["progress"] == 0.0

    sd_session(tmp_path).run(body)


def test_print_stats_info(tmp_path: Path) -> None:
    def info(s: Session) -> Any:
        return s.status("print_stats")["info"]

    def body(s: Session) -> None:
        s.gcode.run_script("SET_PRINT_STATS_INFO TOTAL_LAYER=10 CURRENT_LAYER=12")
        assert info(s) == {"total_layer": 10, "current_layer": 10}
        s.gcode.run_script("SET_PRINT_STATS_INFO TOTAL_LAYER=0")
        assert info(s) == {"total_layer": None, "current_layer": None}

    sd_session(tmp_path).run(body)


LOOPS = """MOVE
SDCARD_LOOP_BEGIN COUNT=3
MOVE
SDCARD_LOOP_BEGIN COUNT=2
MOVE
SDCARD_LOOP_END
SDCARD_LOOP_END
MOVE
"""


def test_parts_of_a_file_are_repeated_also_inside_each_other(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        for total in (11, 22):  # 1 + 3 * (1 + 2) + 1, each time the file is printed
            s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
            wait_until(s, "complete")
            assert s.status("gcode_macro MOVE")["count"] == total

    session = sd_session(tmp_path, part=LOOPS)
    session.config_path.write_text(session.config_path.read_text() + "[sdcard_loop]\n")
    session.run(body)


def test_an_endless_loop_ends_by_desist_and_a_loop_is_for_files_only(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        with pytest.raises(CommandError, match="only counts in a file"):
            s.gcode.run_script("SDCARD_LOOP_BEGIN COUNT=2")
        s.gcode.run_script("SDCARD_PRINT_FILE FILENAME=part.gcode")
        while s.status("gcode_macro MOVE")["count"] < 50:  # in virtual time it takes none
            s.reactor.pause(s.reactor.NOW)
        assert s.status("print_stats")["state"] == "printing"
        s.gcode.run_script("SDCARD_LOOP_DESIST")
        wait_until(s, "complete")

    session = sd_session(tmp_path, part="SDCARD_LOOP_BEGIN COUNT=0\nMOVE\nSDCARD_LOOP_END\n")
    session.config_path.write_text(session.config_path.read_text() + "[sdcard_loop]\n")
    session.run(body)
