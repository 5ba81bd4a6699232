"""G-code parsing and dispatch."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gcode
from base_rig import Session
from gcode import CommandError, GCodeCommand
from gcode_command import parse_extended, parse_traditional


class FakePrinter:
    """Just enough printer for a dispatcher that is not ready for anything but what is registered."""

    config_error = CommandError
    command_error = CommandError

    def __init__(self) -> None:
        self.shutdowns: list[str] = []

    def get_start_args(self) -> dict[str, Any]:
        return {}

    def get_reactor(self) -> Any:
        import contextlib

        class Mutexes:
            def mutex(self) -> Any:
                return contextlib.nullcontext()

        return Mutexes()

    def register_event_handler(self, event: str, callback: Callable[..., Any]) -> None:
        pass

    def send_event(self, event: str, *params: Any) -> None:
        pass

    def get_state_message(self) -> tuple[str, str]:
        return "not ready", "startup"

    def invoke_shutdown(self, msg: str) -> None:
        self.shutdowns.append(msg)

    def request_exit(self, result: str) -> None:
        pass


class Bench:
    """A dispatcher with recording commands G1, M117, SET_X."""

    def __init__(self) -> None:
        self.printer = FakePrinter()
        self.dispatch = gcode.GCodeDispatch(self.printer)
        self.lines: list[str] = []
        self.commands: list[GCodeCommand] = []
        self.dispatch.register_output_handler(self.lines.append)
        for name in ("G1", "M117", "SET_X", "G28"):
            self.dispatch.register_command(name, self.commands.append, when_not_ready=True)

    def run(self, line: str) -> GCodeCommand:
        self.dispatch.run_line(line)
        return self.commands[-1]


def test_an_output_that_fails_gets_no_more_and_the_others_do(caplog: pytest.LogCaptureFixture) -> None:
    bench = Bench()

    def failing(line: str) -> None:
        raise OSError("gone")

    bench.dispatch.output_callbacks.insert(0, failing)
    bench.dispatch.respond_info("one")
    bench.dispatch.respond_info("two")
    assert bench.lines == ["// one", "// two"]
    assert [record.exc_info is not None for record in caplog.records].count(True) == 1


@pytest.mark.parametrize(
    ("line", "params"),
    [
        ("G1 X1.5 Y-2 E.3", {"X": "1.5", "Y": "-2", "E": ".3"}),
        ("G1X1.5Y-2", {"X": "1.5", "Y": "-2"}),
        ("g1 x1 y2", {"X": "1", "Y": "2"}),
        ("  G1   X 1   Y2  ; Z3", {"X": "1", "Y": "2"}),
        ("G1 X1;Y2", {"X": "1"}),
        ("G1", {}),
        ("G1 X", {"X": ""}),
        ("G1 X1 Y2 ", {"X": "1", "Y": "2"}),
        ("N7 G1 X1*102", {"X": "1"}),
        ("N7 G1 X1", {"X": "1"}),
        ("G1\tX1\tY2", {"X": "1", "Y": "2"}),
        ("G1 X1 Y2\r", {"X": "1", "Y": "2"}),
    ],
)
def test_traditional_syntax(line: str, params: dict[str, str]) -> None:
    command = Bench().run(line)
    assert command.get_command() == "G1"
    assert command.get_command_parameters() == params


@pytest.mark.parametrize(
    ("line", "params"),
    [
        ("SET_X A=1 b=two", {"A": "1", "B": "two"}),
        ("set_x A=1", {"A": "1"}),
        ('SET_X A="two words" B=\'it "is"\'', {"A": "two words", "B": 'it "is"'}),
        (r'SET_X FILE="dir/na\"me; 1.gcode"', {"FILE": 'dir/na"me; 1.gcode'}),
        ("SET_X A=1 ; B=2", {"A": "1"}),
        ("SET_X A=1 # B=2", {"A": "1"}),
        ("SET_X A= B=", {"A": "", "B": ""}),
        ("SET_X A=x=y", {"A": "x=y"}),
        (r"SET_X A=two\ words", {"A": "two words"}),
        ("SET_X", {}),
    ],
)
def test_extended_syntax(line: str, params: dict[str, str]) -> None:
    command = Bench().run(line)
    assert command.get_command() == "SET_X"
    assert command.get_command_parameters() == params


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("SET_X A", "expected NAME=value"),
        ("SET_X =1", "expected NAME=value"),
        ('SET_X A="open', "quote without an end"),
        ("G1 5X1", "expected a letter first"),
        ("$$$", "expected a command"),
        ("N7 G1 X1*103", "Checksum mismatch in line 7"),
    ],
)
def test_malformed_lines_are_refused(line: str, expected: str) -> None:
    bench = Bench()
    with pytest.raises(CommandError, match=expected):
        bench.dispatch.run_line(line)
    assert not bench.commands
    assert bench.lines[-1].startswith("!! ")


@pytest.mark.parametrize("line", ["", "   ", "; comment", "  ;G1 X1", "%", "\r", "N5", "# remark"])
def test_lines_without_a_command_do_nothing(line: str) -> None:
    bench = Bench()
    bench.dispatch.run_line(line)
    assert bench.commands == []
    assert bench.lines == []


@pytest.mark.parametrize(
    ("line", "rest"),
    [
        ("M117 Hello World ; not this", "Hello World"),
        ("m117 lower", "lower"),
        ("M117 Layer 3/10 \u00b0C", "Layer 3/10 \u00b0C"),
        ("M117", ""),
        ("N2 M117 with number*99", "with number"),
    ],
)
def test_free_text_arrives_as_typed(line: str, rest: str) -> None:
    if "*" in line:
        body = line.partition("*")[0]
        check = 0
        for byte in body.encode():
            check ^= byte
        line = f"{body}*{check}"
    assert Bench().run(line).get_raw_command_parameters() == rest


@pytest.mark.parametrize(
    ("line", "getter", "kwargs", "message"),
    [
        ("G1 Xabc", "get_float", {}, "G1: X needs a number: 'G1 Xabc'"),
        ("G1 X1.2.3", "get_float", {}, "G1: X: '1.2.3' is not a number"),
        ("G1 X" + "9" * 400, "get_float", {}, "is not a number"),
        ("SET_X X=abc", "get_float", {}, "SET_X: X: 'abc' is not a number"),
        ("SET_X X=nan", "get_float", {}, "SET_X: X: 'nan' is not a number"),
        ("SET_X X=inf", "get_float", {}, "SET_X: X: 'inf' is not a number"),
        ("SET_X X=1.5", "get_int", {}, "SET_X: X: '1.5' is not a whole number"),
        ("SET_X X=1", "get_float", {"above": 1.0}, "X must be above 1.0"),
        ("SET_X X=1", "get_float", {"below": 1.0}, "X must be below 1.0"),
        ("SET_X X=1", "get_int", {"minval": 2}, "X must have minimum of 2"),
        ("SET_X X=3", "get_int", {"maxval": 2}, "X must have maximum of 2"),
        ("SET_X Y=3", "get_int", {}, "missing X"),
    ],
)
def test_wrong_parameters_are_named(line: str, getter: str, kwargs: dict[str, Any], message: str) -> None:
    command = Bench().run(line)
    with pytest.raises(CommandError) as caught:
        getattr(command, getter)("X", **kwargs)
    assert message in str(caught.value)


def test_parameters_with_defaults_and_bounds() -> None:
    command = Bench().run("SET_X A=2 B=text")
    assert command.get_float("A", minval=2.0, maxval=2.0) == 2.0
    assert command.get_int("A") == 2
    assert command.get("B") == "text"
    assert command.get_float("MISSING", 7.5, above=100.0) == 7.5
    assert command.get("MISSING", None) is None


@settings(max_examples=400, deadline=None)
@given(st.text(max_size=60) | st.text(alphabet="GMNT01 9.*;#\"'\\=XYe_-\t", max_size=40))
def test_any_line_runs_or_raises_a_command_error(line: str) -> None:
    bench = Bench()
    try:
        bench.dispatch.run_line(line)
    except CommandError as e:
        assert str(e)
    assert bench.printer.shutdowns == []  # an internal error would shut the printer down


_word = st.text(alphabet=st.characters(blacklist_categories=["Cs"], blacklist_characters="\n\r"), max_size=20)


@settings(max_examples=200, deadline=None)
@given(st.dictionaries(st.from_regex(r"[A-Z][A-Z0-9_]{0,6}", fullmatch=True), _word, max_size=4))
def test_quoted_values_survive(params: dict[str, str]) -> None:
    escaped = {key: value.replace("\\", "\\\\").replace('"', '\\"') for key, value in params.items()}
    text = " ".join(f'{key}="{value}"' for key, value in escaped.items())
    assert parse_extended(text) == params


@settings(max_examples=200, deadline=None)
@given(
    st.dictionaries(
        st.sampled_from("XYZEFIJ"),
        st.floats(allow_nan=False, allow_infinity=False).map("{:.5f}".format),
        max_size=5,
    ),
    st.sampled_from(["", " ", "  "]),
)
def test_numbers_survive(params: dict[str, str], gap: str) -> None:
    assert parse_traditional(gap.join(key + value for key, value in params.items())) == params


def test_unknown_command_is_an_info_and_not_an_error(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script("FOO_BAR A=1\nG999 X1\nM106 S3\nM107\nM104 S0\nM140\nM21\nFOO_BAR nonsense")

    session = Session(tmp_path, "").run(body)
    answers = [line for line in session.lines if "state" not in line]
    assert answers == [
        '// Unknown command:"FOO_BAR"',
        '// Unknown command:"G999"',
        '// Unknown command:"FOO_BAR"',
    ]


def test_script_stops_at_its_first_error(tmp_path: Path) -> None:
    seen: list[str] = []

    def body(s: Session) -> None:
        def fail(gcmd: GCodeCommand) -> None:
            raise gcmd.error("first reason\nmore words")

        s.gcode.register_command("FAIL", fail)
        s.gcode.register_command("NOTE", lambda gcmd: seen.append("note"))
        with pytest.raises(CommandError, match="first reason"):
            s.gcode.run_script("NOTE\nFAIL\nNOTE")

    session = Session(tmp_path, "").run(body)
    assert seen == ["note"]
    assert "!! first reason" in session.lines
    assert "// more words" in session.lines


def test_a_bug_in_a_command_shuts_the_printer_down(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.register_command("BUG", lambda gcmd: 1 // 0)
        with pytest.raises(ZeroDivisionError):
            s.gcode.run_script("BUG")
        assert s.state[1] == "shutdown"
        assert s.state[0].startswith('Internal error on command:"BUG"')
        with pytest.raises(CommandError, match="Internal error"):
            s.gcode.run_script("G1 X1")
        s.gcode.run_script("M115")  # still allowed

    Session(tmp_path, "").run(body)


def test_commands_before_ready_are_refused_with_the_reason(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        with pytest.raises(CommandError, match="not a valid config section"):
            s.gcode.run_script("G1 X1")
        assert "G1" not in s.status("gcode")["commands"]
        assert "RESTART" in s.status("gcode")["commands"]

    Session(tmp_path, "[wrong]\n").run(body)


def test_emergency_stop(tmp_path: Path) -> None:
    def body(s: Session) -> None:
        s.gcode.run_script("M112")
        assert s.state[1] == "shutdown"
        assert s.state[0].startswith("Shutdown due to M112 command")

    session = Session(tmp_path, "").run(body)
    assert "// Klipper state: Shutdown" in session.lines


def test_mux_commands_and_wrong_names(tmp_path: Path) -> None:
    seen: list[str] = []

    def body(s: Session) -> None:
        s.gcode.register_mux_command("DO", "WHAT", "a", lambda gcmd: seen.append("a"))
        s.gcode.register_mux_command("DO", "WHAT", "b", lambda gcmd: seen.append("b"))
        s.gcode.run_script("DO WHAT=b\nDO WHAT=a")
        with pytest.raises(CommandError, match=r"'c' is not valid for WHAT \(choices: a, b\)"):
            s.gcode.run_script("DO WHAT=c")
        with pytest.raises(CommandError, match=r"missing WHAT \(choices: a, b\)"):
            s.gcode.run_script("DO")
        for name in ("low", "G1.2.3", "9A", "A B", ""):
            with pytest.raises(s.printer.config_error):
                s.gcode.register_command(name, print)
        with pytest.raises(s.printer.config_error, match="already registered"):
            s.gcode.register_command("M112", print)

    Session(tmp_path, "").run(body)
    assert seen == ["b", "a"]


def test_a_command_that_is_taken_back_is_gone_from_the_help_too() -> None:
    bench = Bench()
    bench.dispatch.register_command("ABORT", bench.commands.append, desc="End it")
    assert bench.dispatch.get_command_help()["ABORT"] == "End it"
    assert bench.dispatch.register_command("ABORT", None) == bench.commands.append
    assert "ABORT" not in bench.dispatch.get_command_help()
    bench.dispatch.register_command("ABORT", bench.commands.append)
    assert "ABORT" not in bench.dispatch.get_command_help()  # the new one said nothing of itself


def test_g1_lines_are_cheap() -> None:
    bench = Bench()
    bench.dispatch.register_command("G1", None)
    bench.dispatch.register_command("G1", lambda gcmd: None, when_not_ready=True)
    count = 20000
    started_s = time.process_time()
    for _ in range(count):
        bench.dispatch.run_line("G1 X100.123 Y50.333 E0.01234")
    per_line_us = (time.process_time() - started_s) / count * 1e6
    assert per_line_us < 30.0  # about 3 us measured; the margin is for a busy test machine


def batch(tmp_path: Path, text: str) -> Session:
    source = tmp_path / "in.gcode"
    source.write_text(text)
    fd = os.open(source, os.O_RDONLY)
    session = Session(tmp_path, "[respond]\n", debuginput=str(source), gcode_fd=fd)
    session.result = session.printer.run()
    os.close(fd)
    session.reactor.finalize()
    return session


def test_batch_mode_runs_the_file_and_ends(tmp_path: Path) -> None:
    session = batch(tmp_path, "M118 one\nUNKNOWN_THING\nM118 two")
    assert session.result == "exit"
    assert [line for line in session.lines if line.startswith("echo")] == ["echo: one", "echo: two"]


def test_batch_mode_ends_at_the_first_error(tmp_path: Path) -> None:
    session = batch(tmp_path, "M118 one\nRESPOND TYPE=wrong\nM118 two\n")
    assert session.result == "error_exit"
    assert [line for line in session.lines if line.startswith("echo")] == ["echo: one"]


def test_terminal_lines_are_acknowledged(tmp_path: Path) -> None:
    from reactor import SystemTime

    to_host, from_user = os.pipe()  # stands for the terminal's input; answers go nowhere
    os.set_blocking(to_host, False)

    def body(s: Session) -> None:
        os.write(from_user, b"M118 hi\nBAD A\nRESPOND TYPE=x\n; c\nM115\n")
        s.sleep(0.1)

    session = Session(tmp_path, "[respond]\n", SystemTime(), gcode_fd=to_host).run(body)
    for fd in (to_host, from_user):
        os.close(fd)
    answers = [line for line in session.lines if not line.startswith("// Klipper")]
    assert answers[0:2] == ["echo: hi", "ok"]
    assert answers.count("ok") == 4
    assert answers[-1].startswith("ok FIRMWARE_NAME")
