"""A host that is killed while it writes: each file is the old one or the new one, whole."""

from __future__ import annotations

import os
import random
import resource
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from base_rig import Session
from configtext import read_main
from extras.outputs import output_file
from extras.save_variables import SaveVariables

KILLS = int(os.environ.get("KILLS", "100"))  # of each kind
FILLING = "# " + "x" * 76 + "\n"
CONFIG = "[pause_resume]\n[save_variables]\nfilename: {folder}/variables.cfg\n" + 2000 * FILLING
FULL = 60_000  # bytes in a file of a full disk: less than the config has, more than the variables


def write_for_ever(session: Session, command: str) -> None:
    """In the child: the command again and again, with another value each time."""
    configfile = session.printer.lookup_object("configfile")
    number = 0
    while True:
        number += 1
        text = str(number % 10) * 4000
        try:
            if command == "SAVE_VARIABLE":
                session.gcode.run_script(f"SAVE_VARIABLE VARIABLE=a VALUE=\"'{text}'\"")
            elif command == "INDUCTION_DUMP":
                with output_file.open_new(session.config_path.parent, "dump.csv") as stream:
                    stream.write(text)
                os.unlink(stream.name)
            else:
                section = "heater_profile extruder fast" if command == "HEATER_PROFILE" else "pause_resume"
                configfile.remove_section(section)
                configfile.set(section, "note", text)
                session.gcode.run_script("SAVE_CONFIG RESTART=0")
        except (session.gcode.error, OSError, output_file.OutputError):
            if resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY:
                os._exit(1)  # only a full disk is a reason


def is_whole_config(path: Path) -> None:
    assert path.read_text().startswith("[pause_resume]\n") and path.read_text().count(FILLING) == 2000
    _, saved = read_main(str(path))
    for section in saved.sections.values():
        assert len(section.options["note"].value) == 4000 and len(set(section.options["note"].value)) == 1


def kill_at_random(
    session: Session, command: str, disk_is_full: bool, check: Callable[[], None], dice: random.Random
) -> None:
    child = os.fork()
    if not child:
        try:
            if disk_is_full:
                resource.setrlimit(resource.RLIMIT_FSIZE, (FULL, resource.RLIM_INFINITY))
            write_for_ever(session, command)
        finally:
            os._exit(1)
    time.sleep(dice.uniform(0.0, 0.02))
    os.kill(child, signal.SIGKILL)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL  # it was at work to the end
    check()


@pytest.mark.parametrize("disk_is_full", [False, True], ids=["normal disk", "full disk"])
@pytest.mark.parametrize("command", ["SAVE_CONFIG", "SAVE_VARIABLE", "HEATER_PROFILE", "INDUCTION_DUMP"])
def test_a_file_is_the_old_or_the_new_one(tmp_path: Path, command: str, disk_is_full: bool) -> None:
    session = Session(tmp_path, CONFIG.format(folder=tmp_path))
    precious = tmp_path / "dump.csv"
    precious.write_text("of a measurement")

    def check() -> None:
        is_whole_config(session.config_path)
        for backup in tmp_path.glob("printer-*.cfg"):
            is_whole_config(backup)
        variables = SaveVariables(session.printer, str(tmp_path / "variables.cfg"))._read()
        text = variables.get("a", "")
        assert not text or (len(text) == 4000 and len(set(text)) == 1)
        assert precious.read_text() == "of a measurement"

    def body(s: Session) -> None:
        dice = random.Random(command)
        for _ in range(KILLS):
            kill_at_random(s, command, disk_is_full, check, dice)
        s.gcode.run_script("SAVE_VARIABLE VARIABLE=b VALUE=1")  # what a killed host left is in nobody's way
        configfile = s.printer.lookup_object("configfile")
        configfile.set("pause_resume", "note", "1" * 4000)
        s.gcode.run_script("SAVE_CONFIG RESTART=0")

    session.run(body)
    check()
    assert {path.name.split("-")[0] for path in tmp_path.iterdir()} <= {
        "printer.cfg", "printer", "variables.cfg", "dump.csv", "dump",
    }  # fmt: skip
