"""Sections of Klipper that Ferrite does not have: the printer starts without them, or all are named at once."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import configabsent
import configfile
import extras
from base_rig import Session, start_error
from doc_rig import load, read_page
from klipper_names import SECTIONS
from printer import _locate_extra

PALETTE = """\
[palette2]
serial: /dev/ttyUSB0
[load_cell_probe]
sensor_type: hx717
"""
SENSORS = """\
[angle hotend]
cs_pin: PA3
[load_cell]
sensor_type: hx711
"""
DISPENSABLE = frozenset().union(*(group.kinds for group in configabsent.DISPENSABLE))
# Sections that the toolhead reads, not a module of their name.
READ_ELSEWHERE = {
    *("mcu", "printer", "stepper_x", "stepper_z1", "extruder", "extruder1"),
    *("carriage", "extra_carriage", "dual_carriage", "stepper"),
    *configabsent.READ_BY,
}


def notices(session: Session) -> list[str]:
    return [line for line in session.lines if "Ferrite does not yet" in line]


def test_a_printer_starts_without_palette_and_sensors_and_says_so_once(tmp_path: Path) -> None:
    session = Session(tmp_path, PALETTE + SENSORS)
    session.run(lambda s: s.sleep(5.0))
    assert session.state[1] == "ready"
    (notice,) = notices(session)
    probe, other, palette = notice.splitlines()[1:]
    assert probe.startswith("// [load_cell_probe] (printer.cfg, line 3): there is no probe")
    assert other.startswith("// [angle] (printer.cfg, line 5), [load_cell] (printer.cfg, line 7): the sensor")
    assert palette.startswith("// [palette2] (printer.cfg, line 1): the Palette is not driven")
    (warning,) = session.status("configfile")["warnings"]
    assert warning["type"] == "runtime_warning"
    assert warning["message"] == notice.replace("// ", "")


def test_without_such_sections_nothing_is_said(tmp_path: Path) -> None:
    session = Session(tmp_path, "[display_status]\n").run(lambda s: None)
    assert not notices(session)
    assert session.status("configfile")["warnings"] == []


def test_sections_of_an_included_file_are_named_with_that_file(tmp_path: Path) -> None:
    (tmp_path / "cell.cfg").write_text("# my sensor\n[load_cell]\nsensor_type: hx711\n")
    session = Session(tmp_path, "[include cell.cfg]\n").run(lambda s: None)
    assert session.state[1] == "ready"
    assert "[load_cell] (cell.cfg, line 2)" in notices(session)[0]


def test_sections_that_only_a_display_reads_need_one(tmp_path: Path) -> None:
    text = start_error(tmp_path, "[display_data a b]\n[menu __main]\ntype: list\n")
    assert text.splitlines()[:2] == [
        "Section 'display_data a b' needs a section [display] (printer.cfg, line 1).",
        "Section 'menu __main' needs a section [display] (printer.cfg, line 2).",
    ]


def test_pins_of_a_section_that_is_left_out_stay_free(tmp_path: Path) -> None:
    config = (
        "[mcu]\nserial: x\n[printer]\nkinematics: none\nmax_velocity: 1\nmax_accel: 1\n"
        f"{PALETTE}{SENSORS}[output_pin light]\npin: PA1\n[output_pin beeper]\npin: !PA3\n"
    )
    assert load(tmp_path, config).message == "Printer is ready"


def test_save_config_keeps_what_is_left_out(tmp_path: Path) -> None:
    """Both what the user wrote and what a calibration had saved."""
    saved = "\n#*# <---------------------- SAVE_CONFIG ---------------------->\n#*#\n#*# [angle]\n#*# rate = 1600\n"
    session = Session(tmp_path, PALETTE + SENSORS + saved)

    def body(s: Session) -> None:
        assert s.state[1] == "ready", s.state[0]
        s.printer.lookup_object("configfile").set("pause_resume", "recover_velocity", 7)
        s.gcode.run_script("SAVE_CONFIG")

    session.run(body)
    text = session.config_path.read_text()
    assert text.startswith(PALETTE + SENSORS)
    assert "#*# [angle]\n#*# rate = 1600\n" in text
    assert "#*# [pause_resume]\n#*# recover_velocity = 7\n" in text


ABSENT_PROBE = """\
[probe_eddy_current eddy]
sensor_type: ldc1612
"""


def test_homing_by_a_probe_that_is_left_out_fails_with_its_section(tmp_path: Path) -> None:
    def home(s: Session) -> None:
        endstop = s.printer.lookup_object("pins").setup_pin("endstop", "probe:z_virtual_endstop")
        assert endstop.query_endstop(0.0) == 0
        with pytest.raises(
            s.printer.command_error, match=r"Ferrite does not have \[probe_eddy_current eddy\]"
        ):
            endstop.home_start(0.0, 0.001, 4, 0.01)

    Session(tmp_path, ABSENT_PROBE).run(home)


def test_a_sensor_on_a_pin_that_is_left_out_stops_the_start(tmp_path: Path) -> None:
    text = start_error(
        tmp_path,
        "[load_cell_probe]\n[temperature_sensor bed]\nsensor_type: Generic 3950\nsensor_pin: probe:force\n",
    )
    assert "Pin 'probe:force' can not be read: Ferrite does not have [load_cell_probe] yet" in text


def test_sections_and_options_nobody_knows_are_refused_all_at_once(tmp_path: Path) -> None:
    text = start_error(
        tmp_path,
        "[display_statuss]\n[pause_resume]\nrecover_velocty: 3\nlift: 1\n[angle]\n[respnd]\n",
    )
    assert text.splitlines()[:4] == [
        "Section 'display_statuss' is not a valid config section (printer.cfg, line 1). "
        "Did you mean 'display_status'?",
        "Option 'recover_velocty' is not valid in section 'pause_resume' (printer.cfg, line 3). "
        "Did you mean 'recover_velocity'?",
        "Option 'lift' is not valid in section 'pause_resume' (printer.cfg, line 4).",
        "Section 'respnd' is not a valid config section (printer.cfg, line 6). Did you mean 'respond'?",
    ]


def test_the_problems_of_several_sections_are_named_at_once(tmp_path: Path) -> None:
    """Of each its first; what only follows from another one is not repeated."""
    text = start_error(
        tmp_path,
        "[pause_resume]\nrecover_velocity: fast\n[idle_timeout]\ntimeout: -1\n[respond]\ndefault_tpe: echo\n"
        "[gcode_macro A]\ngcode: {% if %}\n[firmware_retraction]\nretract_speed: 0\n"
        "[output_pin light]\npin: no_chip:PA1\n",
    )
    named = [line.partition(":")[0] for line in text.splitlines()]
    for start in (
        "Option 'recover_velocity' in section 'pause_resume'",
        "Option 'timeout' in section 'idle_timeout'",
        "Option 'default_tpe' is not valid in section 'respond' (printer.cfg, line 6). Did you mean 'default_type'?",
    ):
        assert start in named
    assert "Unknown pin chip name" not in text
    assert "(printer.cfg, line 8)" in text, "the macro"
    assert "(printer.cfg, line 10)" in text, "the retraction"


def test_a_module_that_breaks_over_another_ones_problem_does_not_hide_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "__path__", list(extras.__path__))
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "follower.py").write_text(
        "def load_config(config):\n"
        "    return config.get_printer().lookup_object('pause_resume', None).is_paused\n"
    )
    config = f"[pause_resume]\nrecover_velocity: fast\n[follower]\n[plugins]\npath: {tmp_path / 'plugins'}\n"
    text = start_error(tmp_path, config)
    assert text.startswith("Option 'recover_velocity' in section 'pause_resume'")
    assert "Internal error" not in text


def test_a_plugin_may_bring_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "__path__", list(extras.__path__))
    (tmp_path / "plugins").mkdir()
    for name in ("load_cell", "palette2"):
        (tmp_path / "plugins" / f"{name}.py").write_text(
            "def load_config(config):\n    return config.get('x')\n"
        )
    config = f"[load_cell]\nx: 1\n[palette2]\nx: 2\n[plugins]\npath: {tmp_path / 'plugins'}\n"
    session = Session(tmp_path, config).run(lambda s: None)
    assert session.state[1] == "ready", session.state[0]
    assert session.printer.lookup_object("load_cell") == "1"
    assert session.printer.lookup_object("palette2") == "2"
    assert not notices(session)


def test_what_is_missing_is_documented() -> None:
    page = read_page("Config_Reference.md")
    listed = set(re.findall(r"`(\w+)`", page.partition("## Sections of Klipper that are missing")[2]))
    assert listed >= DISPENSABLE


def test_every_section_of_klipper_is_loaded_or_left_out() -> None:
    absent = DISPENSABLE
    modules = configfile.section_modules()
    assert not SECTIONS - absent - modules - READ_ELSEWHERE
    assert not {name for name in absent if _locate_extra(name)}, "there is a module: take it off the list"
