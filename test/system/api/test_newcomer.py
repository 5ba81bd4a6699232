"""A newcomer's path by docs/guides/Getting_Started.md: own config, `make printer`, a print by Moonraker, SAVE_CONFIG.

The commands are those of the page, only with folders, ports and a speed of the test's own.
"""

from __future__ import annotations

import re
import urllib.parse
from collections.abc import Iterator
from pathlib import Path

import pytest

from doc_rig import read_page
from moonraker_rig import ROOT, HttpError, SimulatedPrinter
from system.api.test_moonraker import finished_job, square

PAGE = read_page("Getting_Started.md")


# Someone's module: it finds better gains by looking at them, and offers them to SAVE_CONFIG as PID_CALIBRATE does.
PLUGIN = """
def load_config(config):
    printer = config.get_printer()
    gcode = printer.lookup_object("gcode")

    def tune(gcmd):
        configfile = printer.lookup_object("configfile")
        configfile.set("heater_bed", "pid_Kp", "%.3f" % gcmd.get_float("KP", above=0.0))
        gcmd.respond_info("SAVE_CONFIG keeps it")

    gcode.register_command("TUNE_BED", tune, desc="Better gains for the bed")
"""


@pytest.fixture
def printer(tmp_path: Path) -> Iterator[SimulatedPrinter]:
    own = tmp_path / "my-printer.cfg"
    example = (ROOT / "config" / "sim-induction.cfg").read_text()
    example = example.replace("pid_Kp: 60", "# a bed of my own\npid_Kp: 55  ; found by hand")
    own.write_text(f"{example}\n[plugins]\npath: {tmp_path / 'plugins'}\n[bed_tuner]\n")
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "bed_tuner.py").write_text(PLUGIN)
    with SimulatedPrinter(tmp_path / "data", "--config", str(own), "--speed", "10") as machine:
        machine.wait_start()
        yield machine


def settings(printer: SimulatedPrinter, section: str) -> dict[str, object]:
    values: dict[str, object] = printer.query("configfile")["settings"][section]
    return values


def restarted(printer: SimulatedPrinter, script: str) -> None:
    """A script that restarts the host; until it is ready again."""
    before = printer.query("toolhead")["estimated_print_time"]
    printer.gcode(script)

    def is_new() -> bool:
        ready = printer.call("/server/info")["klippy_state"] == "ready"
        return bool(ready and printer.query("toolhead")["print_time"] < before)

    printer.wait("the restart", is_new)


def test_from_the_example_to_a_print_and_a_value_that_stays(printer: SimulatedPrinter) -> None:
    config = printer.data / "config" / "printer.cfg"
    assert settings(printer, "heater_bed")["pid_kp"] == 55.0

    # print by the HTTP API, as the page says
    assert "/server/files/upload" in PAGE
    printer.upload("first.gcode", square(1), start=True)
    job = printer.wait("the print", lambda: finished_job(printer, "first.gcode"), 60.0)
    assert job["status"] == "completed"

    # edit a PID value in the file, RESTART
    edited = config.read_text().replace("pid_Kp: 55  ; found by hand", "pid_Kp: 61  ; better")
    config.write_text(edited)
    restarted(printer, "RESTART")
    assert settings(printer, "heater_bed")["pid_kp"] == 61.0

    # values the printer finds by itself, SAVE_CONFIG
    saved = check_save_config(printer, config)

    # nothing that a client can ask for does harm
    check_bad_requests(printer)

    assert printer.stop() == 0
    assert config.read_text() == saved
    for log in ("klippy.log", "moonraker.log"):
        assert "Traceback" not in printer.log(log), log


def check_save_config(printer: SimulatedPrinter, config: Path) -> str:
    """The file afterwards: own lines, comments and order as they were, replaced options commented out."""
    before = config.read_text()
    old = settings(printer, "induction_heater nozzle")["tank_delta"]
    printer.wait("the nozzle to cool", lambda: printer.query("extruder")["temperature"] < 60.0, 60.0)
    temp_c = printer.query("extruder")["temperature"]
    printer.gcode(f"INDUCTION_ZERO HEATER=nozzle TEMP={temp_c + 5.0:.1f}")
    printer.gcode("TUNE_BED KP=72.5")
    pending = printer.query("configfile")
    assert pending["save_config_pending"] is True
    items = pending["save_config_pending_items"]
    assert set(items) == {"induction_heater nozzle", "heater_bed"}
    changed = {option.lower() for section in items.values() for option in section}
    restarted(printer, "SAVE_CONFIG")
    after = config.read_text()
    mine, _, block = after.partition("#*# <")
    assert "DO NOT EDIT THIS BLOCK" in block
    kept = [line for line in before.splitlines() if line.partition(":")[0].lower() not in changed]
    assert [line for line in mine.rstrip().splitlines() if line in kept] == kept, (
        "comments and order are kept"
    )
    for option in changed:
        assert f"#*# {option} =" in block.lower()
        assert re.search(rf"(?mi)^{option}\s*[:=]", mine) is None, "commented out"
    assert "#pid_Kp: 61  ; better" in mine
    assert settings(printer, "induction_heater nozzle")["tank_delta"] != old
    assert settings(printer, "heater_bed")["pid_kp"] == 72.5
    backups = [path for path in config.parent.iterdir() if path.name.startswith("printer-")]
    assert [path.read_text() for path in backups] == [before]
    return after


def check_bad_requests(printer: SimulatedPrinter) -> None:
    """As a broken front end would send them; the printer does not notice."""
    pid = printer.host_pid()
    for path, status, words in (
        ("/printer/no/such/endpoint", 404, "Not Found"),
        ("/printer/print/start?filename=" + urllib.parse.quote("../config/printer.cfg"), 400, "printer.cfg"),
        ("/printer/print/start", 400, "filename"),
        ("/printer/gcode/script?script=" + urllib.parse.quote("G1 X1e999"), 400, "Must home"),
        ("/printer/gcode/script?script=" + urllib.parse.quote("M104 Sabc"), 400, "M104 Sabc"),
    ):
        with pytest.raises(HttpError) as refused:
            printer.post(path)
        assert refused.value.status == status, path
        assert words in refused.value.message, path
    with pytest.raises(HttpError):
        printer.upload("../../config/evil.gcode", "M117 out")
    assert not list(printer.data.parent.rglob("evil*"))
    assert printer.host_pid() == pid
    assert printer.call("/printer/info")["state"] == "ready"
