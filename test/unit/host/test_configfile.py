"""printer.cfg: syntax, typed access, messages with file and line, SAVE_CONFIG."""

from __future__ import annotations

import errno
import os
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import configtext
from base_rig import Session, start_error
from configfile import ConfigWrapper
from configtext import ConfigData, ConfigError, ConfigParser


def parse(text: str, path: str = "/nowhere/printer.cfg") -> ConfigData:
    data = ConfigData()
    ConfigParser(data).parse_text(text, path)
    return data


def options(text: str, section: str = "a") -> dict[str, str]:
    return {name: option.value for name, option in parse(text).sections[section].options.items()}


def wrapper(text: str, section: str = "a") -> ConfigWrapper:
    return ConfigWrapper(None, parse(text), {}, section)


def test_names_of_earlier_versions_are_replaced_with_a_warning_that_says_where() -> None:
    text = "[a]\ncontrol: practical\npractical_turn: 1\n[b]\npractical_turn: 1\ntwo_period_turn: 2\n"
    data = parse(text)
    messages = [warning["message"] for warning in configtext.replace_old(data.sections)]
    found = {n: {k: o.value for k, o in s.options.items()} for n, s in data.sections.items()}
    assert found == {"a": {"control": "two_period", "two_period_turn": "1"}, "b": {"two_period_turn": "2"}}
    assert messages == [
        "Value 'practical' of option 'control' in section 'a' is now 'two_period' (printer.cfg, line 2).",
        "Option 'practical_turn' in section 'a' is now called 'two_period_turn' (printer.cfg, line 3).",
        "Option 'practical_turn' in section 'b' is now called 'two_period_turn' (printer.cfg, line 5).",
    ]
    assert list(configtext.replace_old(data.sections)) == []


# --- syntax ---
def test_colon_and_equals_and_comments() -> None:
    text = "# head\n[a]\nOne: 1 # tail\ntwo = 2 ; tail\nthree: x;y\n; whole line\nfour:\n"
    assert options(text) == {"one": "1", "two": "2", "three": "x;y", "four": ""}


def test_multi_line_values_keep_their_lines() -> None:
    text = "[a]\ngcode:\n  G28 ; home\n\n  # remark\n  G1 X1\nnext: 5\n"
    assert options(text) == {"gcode": "G28\n\n\nG1 X1", "next": "5"}


def test_indented_options_of_equal_depth_are_options() -> None:
    assert options("[a]\n  x: 1\n  y: 2\n") == {"x": "1", "y": "2"}


def test_values_may_contain_separators() -> None:
    assert options("[a]\npin: mcu:PA1\nurl = a=b:c\n") == {"pin": "mcu:PA1", "url": "a=b:c"}


def test_windows_line_ends_and_byte_order_mark() -> None:
    assert options("\ufeff[a]\r\nx: 1\r\n") == {"x": "1"}


def test_same_section_twice_merges_and_repeats_are_noted() -> None:
    data = parse("[a]\nx: 1\n[b]\n[a]\nx: 2\ny: 3\n")
    assert {k: v.value for k, v in data.sections["a"].options.items()} == {"x": "2", "y": "3"}
    assert len(data.notes) == 1
    assert "'x'" in data.notes[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x: 1\n", "before the first"),
        ("[a]\nnonsense\n", "line 2"),
        ("[ ]\n", "without a name"),
    ],
)
def test_lines_that_make_no_sense_are_named(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        parse(text)


def test_include_is_relative_globbed_and_may_be_overridden(tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "1.cfg").write_text("[a]\nx: 1\ny: 1\n")
    (tmp_path / "parts" / "2.cfg").write_text("[b]\nz: 1\n")
    main = tmp_path / "printer.cfg"
    main.write_text("[include parts/*.cfg]\n[include none-of-these-*.cfg]\n[a]\nx: 2\n")
    data = ConfigData()
    ConfigParser(data).parse_file(str(main))
    assert {k: v.value for k, v in data.sections["a"].options.items()} == {"x": "2", "y": "1"}
    assert str(data.sections["b"].options["z"].origin) == "2.cfg, line 2"


def test_missing_and_circular_includes(tmp_path: Path) -> None:
    main = tmp_path / "printer.cfg"
    main.write_text("[include gone.cfg]\n")
    with pytest.raises(ConfigError, match=r"gone\.cfg' does not exist \(printer\.cfg, line 1\)"):
        ConfigParser(ConfigData()).parse_file(str(main))
    main.write_text("[include other.cfg]\n")
    (tmp_path / "other.cfg").write_text("[include printer.cfg]\n")
    with pytest.raises(ConfigError, match="includes itself"):
        ConfigParser(ConfigData()).parse_file(str(main))


@settings(max_examples=300, deadline=None)
@given(st.text(alphabet=st.sampled_from('[]ab:=#; \n\t*\\"x1\u00e9\x00'), max_size=80) | st.text(max_size=60))
def test_any_text_parses_or_raises_a_config_error(text: str) -> None:
    try:
        user, saved = configtext.split_autosave(text)
        data = parse(user)
        parse(saved)
    except ConfigError as e:
        assert str(e)
    else:
        assert all(name for name in data.sections)


_names = st.text("abcxyz_0", min_size=1, max_size=8)
_line = st.text("AZaz09 !^:=,.{}%-", min_size=1, max_size=14).map(lambda text: "x" + text.strip() + "y")
_sections = st.dictionaries(
    _names, st.dictionaries(_names, st.lists(_line, min_size=1, max_size=3), min_size=1)
)


@settings(max_examples=100, deadline=None)
@given(_sections)
def test_what_is_saved_is_read_again(content: dict[str, dict[str, list[str]]]) -> None:
    saved = {
        section: {name: "\n".join(lines) for name, lines in values.items()}
        for section, values in content.items()
        if section != "include"
    }
    text = "[printer]\nx: 1\n\n" + configtext.format_autosave(saved)
    user, block = configtext.split_autosave(text)
    assert user == "[printer]\nx: 1\n\n"
    data = parse(block)
    assert {
        name: {key: option.value for key, option in section.options.items()}
        for name, section in data.sections.items()
    } == saved


# --- typed access ---
def test_typed_values() -> None:
    config = wrapper("[a]\nf: 1.5\ni: 7\nb: Yes\nc: two\nl: 1, 2,3\np: 1,2\n 3,4\ns: x , y\n")
    assert config.getfloat("f") == 1.5
    assert config.getint("i", minval=7, maxval=7) == 7
    assert config.getboolean("b") is True
    assert config.getchoice("c", {"one": 1, "two": 2}) == 2
    assert config.getintlist("l", count=3) == (1, 2, 3)
    assert config.getfloatlist("l") == (1.0, 2.0, 3.0)
    assert config.getlist("s") == ("x", "y")
    assert config.getlists("p", seps=(",", "\n"), parser=float, count=2) == ((1.0, 2.0), (3.0, 4.0))
    assert config.get("missing", None) is None
    assert config.getfloat("missing", 0.0, above=1.0) == 0.0  # defaults are not checked against the bounds
    assert config.get_prefix_options("i") == ["i"]
    assert config.has_section("a")
    assert not config.has_section("b")


@pytest.mark.parametrize(
    ("method", "value", "bounds", "expected"),
    [
        ("getfloat", "abc", {}, "expected a number"),
        ("getfloat", "nan", {}, "expected a number"),
        ("getfloat", "inf", {}, "expected a number"),
        ("getfloat", "1e999", {}, "expected a number"),
        ("getint", "1.5", {}, "expected a whole number"),
        ("getint", "", {}, "expected a whole number"),
        ("getboolean", "maybe", {}, "expected yes or no"),
        ("getfloat", "1", {"above": 1.0}, "must be above 1.0"),
        ("getfloat", "1", {"below": 1.0}, "must be below 1.0"),
        ("getfloat", "1", {"minval": 1.5}, "must have minimum of 1.5"),
        ("getint", "9", {"maxval": 8}, "must have maximum of 8"),
        ("getintlist", "1,x", {}, "expected a list of whole numbers"),
        ("getfloatlist", "1,2,3", {"count": 2}, "must have 2 elements"),
        ("getfloatlist", "1,inf", {}, "expected a list of numbers"),
        ("getchoice", "x", {"choices": {"p": 1, "q": 2}}, r"not one of the choices \(p, q\)"),
    ],
)
def test_wrong_values_name_option_section_file_and_line(
    method: str, value: str, bounds: dict, expected: str
) -> None:
    config = wrapper(f"[a]\nfirst: 1\nopt: {value}\n")
    with pytest.raises(ConfigError, match=expected) as caught:
        getattr(config, method)("opt", **bounds)
    assert str(caught.value).startswith("Option 'opt' in section 'a'")
    assert "(printer.cfg, line 3)" in str(caught.value)


def test_a_pipe_a_device_or_a_folder_is_no_file_to_include(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.cfg")  # opening it would wait for a writer for ever
    (tmp_path / "zero.cfg").symlink_to("/dev/zero")
    (tmp_path / "folder.cfg").mkdir()
    main = tmp_path / "printer.cfg"
    for name in ("pipe.cfg", "zero.cfg", "/dev/zero", "folder.cfg", "f*.cfg"):
        main.write_text(f"[include {name}]\n")
        with pytest.raises(
            ConfigError, match=r"Unable to open config file .*: (it is no plain file|Is a directory)"
        ):
            ConfigParser(ConfigData()).parse_file(str(main))


def test_missing_option_names_the_section_and_its_line() -> None:
    with pytest.raises(ConfigError, match=r"'x' in section 'a' must be specified \(printer.cfg, line 2\)"):
        wrapper("\n[a]\n").get("x")
    with pytest.raises(ConfigError, match=r"there is no section \[b\]"):
        wrapper("[a]\n", "b").get("x")


# --- the whole printer ---
def test_unknown_section_and_option_are_refused_with_a_suggestion(tmp_path: Path) -> None:
    text = start_error(tmp_path, "[display_statuss]\n")
    assert "Section 'display_statuss' is not a valid config section (printer.cfg, line 1)" in text
    assert "Did you mean 'display_status'?" in text
    text = start_error(tmp_path, "[pause_resume]\nrecover_velocty: 3\n")
    assert "Option 'recover_velocty' is not valid in section 'pause_resume' (printer.cfg, line 2)" in text
    assert "Did you mean 'recover_velocity'?" in text
    assert "Traceback" not in text


def test_missing_config_file_is_one_clear_sentence(tmp_path: Path) -> None:
    session = Session(tmp_path, "")
    session.config_path.unlink()
    session.run(lambda s: None)
    assert session.state[1] == "error"
    assert session.state[0].startswith(f"Unable to open config file {session.config_path}: No such file")


def test_overrides_win_over_the_file_and_the_saved_block(tmp_path: Path) -> None:
    config = "[pause_resume]\nrecover_velocity: 1\n" + configtext.format_autosave(
        {"pause_resume": {"recover_velocity": "2"}}
    )
    session = Session(tmp_path, config, config_overrides=[("pause_resume", "recover_velocity", "3")])
    session.run(lambda s: None)
    assert session.printer.lookup_object("pause_resume").recover_velocity_mm_s == 3.0
    session = Session(tmp_path, config).run(lambda s: None)
    assert session.printer.lookup_object("pause_resume").recover_velocity_mm_s == 2.0


def test_status_has_raw_and_typed_values_with_defaults(tmp_path: Path) -> None:
    session = Session(tmp_path, "[idle_timeout]\ntimeout: 90\n").run(lambda s: None)
    status = session.status("configfile")
    assert status["config"] == {"idle_timeout": {"timeout": "90"}}
    assert status["settings"]["idle_timeout"]["timeout"] == 90.0
    assert "gcode" in status["settings"]["idle_timeout"]
    assert status["save_config_pending"] is False
    assert status["warnings"] == []


SAVED = """# my printer
[pause_resume]
recover_velocity: 1  # keep this remark

[gcode_macro A]
gcode:
  G1 X1

#*# <---------------------- SAVE_CONFIG ---------------------->
#*# DO NOT EDIT THIS BLOCK OR BELOW. The contents are auto-generated.
#*#
#*# [idle_timeout]
#*# timeout = 77
"""


def test_save_config_keeps_text_and_order_and_makes_a_backup(tmp_path: Path) -> None:
    session = Session(tmp_path, SAVED)

    def body(s: Session) -> None:
        configfile = s.printer.lookup_object("configfile")
        configfile.set("pause_resume", "recover_velocity", 42.5)
        configfile.set("bed_mesh default", "points", "1, 2\n3, 4")
        assert s.status("configfile")["save_config_pending"] is True
        assert s.status("configfile")["save_config_pending_items"]["pause_resume"] == {
            "recover_velocity": "42.5"
        }
        s.gcode.run_script("SAVE_CONFIG")

    session.run(body)
    assert session.result == "restart"
    text = session.config_path.read_text()
    expected_start = SAVED[: SAVED.index("#*#")].replace("recover_velocity: 1", "#recover_velocity: 1")
    assert text.startswith(expected_start.rstrip("\n"))
    assert text.endswith(
        "#*# [idle_timeout]\n#*# timeout = 77\n#*#\n#*# [pause_resume]\n#*# recover_velocity = 42.5\n#*#\n"
        "#*# [bed_mesh default]\n#*# points = 1, 2\n#*# \t3, 4\n"
    )
    backups = [path for path in tmp_path.iterdir() if path.name.startswith("printer-")]
    assert [path.read_text() for path in backups] == [SAVED]


def test_save_config_with_nothing_to_save_says_so(tmp_path: Path) -> None:
    """As before a calibration that was started without WAIT=1 has come to its result."""
    session = Session(tmp_path, SAVED)
    session.run(lambda s: s.gcode.run_script("SAVE_CONFIG"))
    assert any("nothing to save" in line for line in session.lines) and session.result != "restart"
    assert session.config_path.read_text() == SAVED


def test_save_config_refuses_options_of_included_files(tmp_path: Path) -> None:
    (tmp_path / "more.cfg").write_text("[pause_resume]\nrecover_velocity: 5\n")
    session = Session(tmp_path, "[include more.cfg]\n")

    def body(s: Session) -> None:
        s.printer.lookup_object("configfile").set("pause_resume", "recover_velocity", 6)
        with pytest.raises(s.gcode.error, match=r"included file \(more.cfg, line 2\)"):
            s.gcode.run_script("SAVE_CONFIG")

    session.run(body)
    assert session.config_path.read_text() == "[include more.cfg]\n"


def save_pause_velocity(session: Session) -> None:
    session.printer.lookup_object("configfile").set("pause_resume", "recover_velocity", 42.5)
    session.gcode.run_script("SAVE_CONFIG")


def test_save_config_leaves_a_whole_config_file_whenever_it_is_killed(tmp_path: Path) -> None:
    session = Session(tmp_path, SAVED)
    texts: list[str] = []

    def look(frame: object, event: str, argument: object) -> None:
        if event == "c_return":  # after every call into the operating system
            texts.append(session.config_path.read_text() if session.config_path.exists() else "no file")

    def body(s: Session) -> None:
        sys.setprofile(look)
        try:
            save_pause_velocity(s)
        finally:
            sys.setprofile(None)

    session.run(body)
    new = session.config_path.read_text()
    assert "recover_velocity = 42.5" in new and set(texts) == {SAVED, new}


def test_save_config_keeps_permissions_and_a_symbolic_link(tmp_path: Path) -> None:
    session = Session(tmp_path, SAVED)
    kept = tmp_path / "kept" / "my printer.cfg"
    kept.parent.mkdir()
    session.config_path.rename(kept)
    session.config_path.symlink_to(kept.relative_to(tmp_path))
    kept.chmod(0o600)
    session.run(save_pause_velocity)
    assert session.config_path.is_symlink() and "recover_velocity = 42.5" in kept.read_text()
    (backup,) = tmp_path.glob("printer-*.cfg")
    assert [path.stat().st_mode & 0o777 for path in (kept, backup)] == [0o600, 0o600]
    assert backup.read_text() == SAVED and list(kept.parent.iterdir()) == [kept]


def test_save_config_that_cannot_write_says_so_and_leaves_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    session = Session(tmp_path, SAVED)

    def body(s: Session) -> None:
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(s.gcode.error, match=r"unable to write the config file: .*No space left"):
            save_pause_velocity(s)

    session.run(body)
    assert list(tmp_path.iterdir()) == [session.config_path] and session.config_path.read_text() == SAVED


def test_hand_edited_saved_block_is_refused(tmp_path: Path) -> None:
    text = start_error(tmp_path, SAVED + "[extra]\nx: 1\n")
    assert "inside the SAVE_CONFIG block" in text
    assert "Line 14 " in text


def test_a_package_of_helpers_is_no_section_and_no_suggestion(tmp_path: Path) -> None:
    text = start_error(tmp_path, "[heater]\n")
    assert "Section 'heater' is not a valid config section (printer.cfg, line 1)" in text
    assert "Did you mean 'heater'" not in text


@pytest.mark.parametrize("name", ["pipe", "/dev/zero", "folder"])
def test_an_include_that_is_no_plain_file_is_refused_at_once(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    text = start_error(tmp_path, f"[include {name}]\n")
    assert text.startswith(f"Unable to open config file {tmp_path / name}: ")
    assert "it is no plain file" in text or "Is a directory" in text
