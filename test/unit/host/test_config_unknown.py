"""Every section of Klipper is here; sections and options that nobody knows are named all at once."""

from __future__ import annotations

from pathlib import Path

import pytest

import configfile
import configreaders
import extras
from base_rig import Session, start_error
from klipper_names import SECTIONS

# Sections that the toolhead reads, not a module of their name.
READ_ELSEWHERE = {
    *("mcu", "printer", "stepper_x", "stepper_z1", "extruder", "extruder1"),
    *("carriage", "extra_carriage", "dual_carriage", "stepper"),
    *configreaders.READ_BY,
}


def test_sections_that_only_a_display_reads_need_one(tmp_path: Path) -> None:
    text = start_error(tmp_path, "[display_data a b]\n[menu __main]\ntype: list\n")
    assert text.splitlines()[:2] == [
        "Section 'display_data a b' needs a section [display] (printer.cfg, line 1).",
        "Section 'menu __main' needs a section [display] (printer.cfg, line 2).",
    ]


def test_sections_and_options_nobody_knows_are_refused_all_at_once(tmp_path: Path) -> None:
    text = start_error(
        tmp_path,
        "[display_statuss]\n[pause_resume]\nrecover_velocty: 3\nlift: 1\n[respnd]\n",
    )
    assert text.splitlines()[:4] == [
        "Section 'display_statuss' is not a valid config section (printer.cfg, line 1). "
        "Did you mean 'display_status'?",
        "Option 'recover_velocty' is not valid in section 'pause_resume' (printer.cfg, line 3). "
        "Did you mean 'recover_velocity'?",
        "Option 'lift' is not valid in section 'pause_resume' (printer.cfg, line 4).",
        "Section 'respnd' is not a valid config section (printer.cfg, line 5). Did you mean 'respond'?",
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


def test_a_plugin_may_bring_a_section_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(extras, "__path__", list(extras.__path__))
    (tmp_path / "plugins").mkdir()
    (tmp_path / "plugins" / "warp_drive.py").write_text(
        "def load_config(config):\n    return config.get('x')\n"
    )
    config = f"[warp_drive]\nx: 1\n[plugins]\npath: {tmp_path / 'plugins'}\n"
    session = Session(tmp_path, config).run(lambda s: None)
    assert session.state[1] == "ready", session.state[0]
    assert session.printer.lookup_object("warp_drive") == "1"


def test_every_section_of_klipper_is_loaded() -> None:
    assert not SECTIONS - configfile.section_modules() - READ_ELSEWHERE
