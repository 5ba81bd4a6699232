"""[gcode_macro]: whose name a macro may take, and what a template may do with dicts and lists."""

from __future__ import annotations

from pathlib import Path

import pytest

from base_rig import Session, start_error
from doc_rig import ROOT
from gcode import OWN_COMMANDS
from klipper_names import COMMANDS, UNDOCUMENTED
from unit.project.test_docs_reference import OF_THE_USER, documented_commands


def run(tmp_path: Path, config: str, script: str) -> list[str]:
    """What the printer said while it ran a script."""
    said: list[str] = []

    def body(s: Session) -> None:
        assert s.state[1] == "ready", s.state[0]
        s.lines.clear()
        s.gcode.run_script(script)
        said.extend(s.lines)

    Session(tmp_path, config).run(body)
    return said


def macro(name: str, *lines: str, options: str = "") -> str:
    return f"[respond]\ndefault_type: command\n[gcode_macro {name}]\n{options}gcode:\n" + "".join(
        f"  {line}\n" for line in lines
    )


# --- names ---
def test_a_macro_takes_the_place_of_a_command_that_klipper_does_not_have(tmp_path: Path) -> None:
    session = Session(tmp_path, macro("m17", "M118 mine"))
    ours: list[str] = []

    def body(s: Session) -> None:
        s.gcode.register_command("M17", lambda gcmd: ours.append("late"))  # a module loaded after the macro
        s.lines.clear()
        s.gcode.run_script("M17")
        assert s.lines == ["// mine"]
        assert s.gcode.get_command_help()["M17"] == "G-Code macro"

    session.gcode.register_command("M17", lambda gcmd: ours.append("early"), desc="Motors on")
    session.run(body)
    assert not ours


def test_such_a_command_can_still_be_renamed(tmp_path: Path) -> None:
    session = Session(tmp_path, macro("M17", "M17.1", options="rename_existing: M17.1\n"))
    ours: list[str] = []
    session.gcode.register_command("M17", lambda gcmd: ours.append("called"))
    session.run(lambda s: s.gcode.run_script("M17"))
    assert ours == ["called"]


@pytest.mark.parametrize("name", ["TEMPERATURE_PLAN", "T0"])
def test_word_commands_and_tools_yield_too(tmp_path: Path, name: str) -> None:
    session = Session(tmp_path, macro(name, "M118 mine"))
    session.gcode.register_command(name, lambda gcmd: None)
    session.run(lambda s: s.gcode.run_script(name))
    assert "// mine" in session.lines


def test_a_command_that_klipper_has_needs_rename_existing(tmp_path: Path) -> None:
    text = start_error(tmp_path, "[pause_resume]\n" + macro("PAUSE", "M118 mine"))
    assert "G-code command PAUSE is already registered" in text


def test_two_macros_of_one_name_are_refused(tmp_path: Path) -> None:
    text = start_error(tmp_path, macro("M17", "M118 a") + macro("m17", "M118 b"))
    assert "is already registered" in text


def test_a_command_to_rename_that_is_not_there_stops_the_start(tmp_path: Path) -> None:
    renaming = "[gcode_macro MEASURE_IT]\nrename_existing: _MEASURE\ngcode:\n    M118 mine\n"
    assert "Existing command 'MEASURE_IT' not found" in start_error(tmp_path, "[respond]\n" + renaming)


def test_a_macro_may_be_taken_away_and_put_back(tmp_path: Path) -> None:
    """As a dry run does with commands that heat."""

    def body(s: Session) -> None:
        handler = s.gcode.register_command("M104.1", None)
        s.gcode.register_command("M104.1", lambda gcmd: None)
        s.gcode.register_command("M104.1", None)
        s.gcode.register_command("M104.1", handler)
        s.gcode.run_script("M104.1 S200")

    session = Session(tmp_path, macro("M104.1", "M118 mine")).run(body)
    assert "// mine" in session.lines


def test_the_commands_that_yield_are_those_that_klipper_does_not_have() -> None:
    """A new command of our own belongs on the list, one that Klipper has does not."""
    ours = (
        documented_commands() - COMMANDS - UNDOCUMENTED - {"M200"}
    )  # of files to plan offline, no printer has it
    assert {name for name in ours if not OF_THE_USER.match(name)} == OWN_COMMANDS


# --- templates ---
def test_a_macro_sets_and_deletes_items_of_its_dicts_and_lists(tmp_path: Path) -> None:
    text = macro(
        "COLLECT",
        "{% set d = {'a': 1, 'b': 2} %}{% set l = [1, 2, 3] %}",
        "{% set dummy = d.__setitem__('c', []) %}",
        "{% set dummy = d['c'].append(4) %}",
        "{% do d.update(e=5) %}",
        "{% do d.__delitem__('a') %}",
        "{% set _ = l.__setitem__(0, 9) %}{% do l.extend([7]) %}",
        "M118 {d} {l} {d.__len__()} {d.__contains__('b')} {l.__getitem__(1)}",
    )
    assert run(tmp_path, text, "COLLECT") == ["// {'b': 2, 'c': [4], 'e': 5} [9, 2, 3, 7] 3 True 2"]


def test_a_macro_changes_its_parameters_before_it_hands_them_on(tmp_path: Path) -> None:
    text = macro(
        "START",
        "{% if not params.BED %}{% set dummy = params.__setitem__('BED', params.BED_TEMP|int) %}{% endif %}",
        "M118 {params.BED}",
    )
    assert run(tmp_path, text, "START BED_TEMP=60") == ["// 60"]


def test_what_a_macro_puts_into_its_own_variable_stays_there(tmp_path: Path) -> None:
    config = macro(
        "REMEMBER",
        "{% for k in params %}{% set dummy = kept.__setitem__(k, params[k]) %}{% endfor %}",
        options="variable_kept: {}\n",
    ) + macro("SHOW", 'M118 {printer["gcode_macro REMEMBER"].kept}')
    assert run(tmp_path, config, "REMEMBER A=1\nREMEMBER B=2\nSHOW") == ["// {'A': '1', 'B': '2'}"]


def test_a_macro_changes_what_another_one_keeps(tmp_path: Path) -> None:
    config = (
        "[gcode_macro KEEPER]\nvariable_store: {'a': 1}\ngcode:\n  M118 {store.b}\n[respond]\n"
        "[gcode_macro WRITER]\ngcode:\n  {% set _ = printer['gcode_macro KEEPER'].store.update({'b': 7}) %}\n"
    )
    session = Session(tmp_path, config).run(lambda s: s.gcode.run_script("WRITER\nKEEPER"))
    assert "echo: 7" in session.lines


def test_a_change_inside_a_variable_shows_in_the_status(tmp_path: Path) -> None:
    """Clients are sent what differs from the status before: that may not change along."""
    config = macro("REMEMBER", "{% do kept[0].append(params.A) %}", options="variable_kept: [[]]\n")

    def body(s: Session) -> None:
        before = s.status("gcode_macro REMEMBER")
        s.gcode.run_script("REMEMBER A=1")
        assert before == {"kept": [[]]}
        assert s.status("gcode_macro REMEMBER") == {"kept": [["1"]]}

    Session(tmp_path, config).run(body)


@pytest.mark.parametrize(
    "expression",
    [
        "{}.__class__",
        "[].__class__.__base__",
        "printer.__init__",
        "action_respond_info.__globals__",
        "d.__reduce__",
    ],
)
def test_a_template_does_not_get_out_of_the_sandbox(tmp_path: Path, expression: str) -> None:
    text = macro("ESCAPE", "{% set d = {} %}", f"M118 {{ ({expression})() }}")
    with pytest.raises(Exception, match=r"unsafe|undefined"):
        run(tmp_path, text, "ESCAPE")


def test_the_documented_macros_take_no_name_of_ours() -> None:
    """What config/ offers to users shall not switch off what it is for."""
    names = {
        line.split()[1].rstrip("]").upper()
        for path in (ROOT / "config").glob("*.cfg")
        for line in path.read_text(encoding="utf-8").splitlines()
        if line.startswith("[gcode_macro ")
    }
    assert names and not names & OWN_COMMANDS


@pytest.mark.parametrize("value", ["1e999", "[1, -1e999]", "{'a': 1e999}"])
def test_a_variable_is_no_number_without_an_end(tmp_path: Path, value: str) -> None:
    def body(s: Session) -> None:
        with pytest.raises(s.gcode.error, match="Unable to parse"):
            s.gcode.run_script(f'SET_GCODE_VARIABLE MACRO=A VARIABLE=x VALUE="{value}"')
        assert s.status("gcode_macro A") == {"x": 1}

    Session(tmp_path, "[gcode_macro A]\nvariable_x: 1\ngcode:\n").run(body)
