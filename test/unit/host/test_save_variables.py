"""SAVE_VARIABLE: what is accepted comes back after a restart, and nothing else is accepted."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from base_rig import Session, start_error
from extras.save_variables import lasting_literal


def config(tmp_path: Path) -> str:
    return f"[save_variables]\nfilename: {tmp_path / 'variables.cfg'}\n"


def variables(tmp_path: Path, *scripts: str) -> dict[str, object]:
    """The variables after these commands and a restart."""
    Session(tmp_path, config(tmp_path)).run(lambda s: [s.gcode.run_script(text) for text in scripts] and None)
    session = Session(tmp_path, config(tmp_path)).run(lambda s: None)
    found: dict[str, object] = session.status("save_variables")["variables"]
    return found


def test_a_variable_survives_a_restart(tmp_path: Path) -> None:
    scripts = ("SAVE_VARIABLE VARIABLE=a VALUE=1.5", "SAVE_VARIABLE VARIABLE=b VALUE=\"'x = 1'\"")
    assert variables(tmp_path, *scripts) == {"a": 1.5, "b": "x = 1"}


@pytest.mark.parametrize("value", ["1e999", "-1e999", "[1,-1e999]", "{1:1e999}", "inf", "nan", "1+2j", "abc"])
def test_a_value_that_cannot_be_read_back_is_refused_and_changes_nothing(tmp_path: Path, value: str) -> None:
    path = tmp_path / "variables.cfg"

    def body(s: Session) -> None:
        s.gcode.run_script("SAVE_VARIABLE VARIABLE=a VALUE=1")
        before = path.read_text()
        with pytest.raises(s.gcode.error, match="cannot be saved; expected a finite number"):
            s.gcode.run_script(f"SAVE_VARIABLE VARIABLE=a VALUE={value}")
        assert s.status("save_variables")["variables"] == {"a": 1} and path.read_text() == before

    Session(tmp_path, config(tmp_path)).run(body)


_plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text()
_values = st.recursive(
    _plain, lambda inner: st.lists(inner) | st.dictionaries(_plain, inner) | st.tuples(inner)
)


@settings(max_examples=200, deadline=None)
@given(_values)
def test_what_is_accepted_is_the_same_when_read_again(value: object) -> None:
    try:
        accepted = lasting_literal(repr(value))
    except ValueError:
        assert "inf" in repr(value) or "nan" in repr(value)
    else:
        assert lasting_literal(repr(accepted)) == accepted == value
        assert not isinstance(value, float) or math.isfinite(value)


@pytest.mark.parametrize("value", ["inf", "nan", "1e999", "[1, inf]", "unquoted", "'open"])
def test_a_file_with_a_value_that_cannot_be_read_names_its_line(tmp_path: Path, value: str) -> None:
    path = tmp_path / "variables.cfg"
    path.write_text(f"[Variables]\nfirst = 1\nsecond = {value}\nthird = 3\n")
    text = start_error(tmp_path, config(tmp_path))
    assert f"{path}, line 3: second: '{value}' cannot be saved" in text


def test_permissions_and_a_symbolic_link_stay(tmp_path: Path) -> None:
    kept = tmp_path / "kept.cfg"
    kept.write_text("[Variables]\na = 1\n")
    kept.chmod(0o600)
    (tmp_path / "variables.cfg").symlink_to(kept)
    assert variables(tmp_path, "SAVE_VARIABLE VARIABLE=a VALUE=2") == {"a": 2}
    assert (tmp_path / "variables.cfg").is_symlink() and kept.stat().st_mode & 0o777 == 0o600
