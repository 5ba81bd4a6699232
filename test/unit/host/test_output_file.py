"""Where commands may write files, and under which names."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from extras import pid_calibrate
from extras.heater.run import Runner
from extras.outputs import output_file
from extras.outputs.output_file import OutputError
from thermal.identification import relay


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """The log folder, with a config beside it."""
    (tmp_path / "printer.cfg").write_text("[printer]\n")
    folder = tmp_path / "logs"
    folder.mkdir()
    return folder


def write(folder: Path, name: str) -> str:
    """Where a file of that name came to lie, below the folder."""
    with output_file.open_new(folder, name) as stream:
        stream.write("text\n")
    path = Path(stream.name)
    assert path.read_text() == "text\n"
    return str(path.relative_to(folder))


@pytest.mark.parametrize("name", ["dump.csv", "of the day/dump.csv", "dump", "./dump.csv", "a/../dump.csv"])
def test_a_free_name_in_the_folder_is_used_as_it_is(logs: Path, name: str) -> None:
    assert write(logs, name) == os.path.normpath(name)
    assert write(logs, str(logs / "absolute" / name)) == os.path.normpath(f"absolute/{name}")


def test_a_missing_folder_is_made(tmp_path: Path) -> None:
    assert write(tmp_path / "new" / "logs", "dump.csv") == "dump.csv"


def test_what_is_there_stays_and_the_new_file_gets_a_number(logs: Path) -> None:
    (logs / "dump.csv").write_text("old")
    assert [write(logs, "dump.csv") for _ in range(2)] == ["dump-2.csv", "dump-3.csv"]
    assert (logs / "dump.csv").read_text() == "old"


@pytest.mark.parametrize(
    "name",
    [
        "../printer.cfg",
        "../new.csv",
        "{parent}/printer.cfg",
        "/dev/full",
        "~/dump.csv",
        "link/printer.cfg",
        "link.csv",
        "..",
        ".",
        "",
    ],
)
def test_a_name_that_leads_out_of_the_folder_is_refused(logs: Path, name: str) -> None:
    (logs / "link").symlink_to(logs.parent)
    (logs / "link.csv").symlink_to(logs.parent / "printer.cfg")
    name = name.format(parent=logs.parent)
    with pytest.raises(OutputError, match=r"is not in .*/logs; give a name without a path"):
        output_file.open_new(logs, name)
    assert (logs.parent / "printer.cfg").read_text() == "[printer]\n"
    assert sorted(path.name for path in logs.parent.iterdir()) == ["logs", "printer.cfg"]


def test_a_pipe_or_a_folder_in_the_way_is_refused(logs: Path) -> None:
    os.mkfifo(logs / "pipe")  # opening it would wait for a reader for ever
    (logs / "folder").mkdir()
    for name in ("pipe", "folder"):
        with pytest.raises(OutputError, match=f"'{name}' is a folder, a pipe or a device"):
            output_file.open_new(logs, name)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("~nobody_of_that_name/x", "'~nobody_of_that_name/x' is no name of a file"),
        ("a\0b", "is no name of a file"),
        ("x" * 300, "cannot be written in .*: File name too long"),
        ("file/x.csv", "cannot be written in .*: (Not a directory|File exists)"),
        ("loop/x.csv", "'loop/x.csv' "),
    ],
)
def test_a_name_that_cannot_be_is_explained(logs: Path, name: str, words: str) -> None:
    (logs / "file").write_text("old")
    (logs / "loop").symlink_to("loop")
    with pytest.raises(OutputError, match=words):
        output_file.open_new(logs, name)


class Printer:
    def __init__(self, **args: str | None) -> None:
        self._args = args

    def get_start_args(self) -> dict[str, str | None]:
        return self._args


def test_files_lie_beside_the_log_or_where_the_program_says() -> None:
    assert output_file.default_folder(Printer(log_file="/a/b/klippy.log", output_folder="/c")) == "/a/b"
    assert output_file.default_folder(Printer(log_file=None, output_folder="/c")) == "/c"
    assert output_file.default_folder(Printer(log_file=None)) == "~/printer_data/logs"


class Said:
    """What PID_CALIBRATE says at its end."""

    what = "PID_CALIBRATE"

    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)


def test_the_trace_of_a_pid_calibration_replaces_a_link_or_a_pipe_and_opens_neither(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config, trace = tmp_path / "printer.cfg", tmp_path / "heattest.txt"
    config.write_text("[printer]\n")
    monkeypatch.setattr(pid_calibrate, "TRACE", trace)
    run = relay.RelayRun(relay.RelayPlan(60.0, 1.0, 0.5))
    run.decide(1.0, 20.0)
    for put in (lambda: trace.symlink_to(config), lambda: os.mkfifo(trace), lambda: None):
        put()
        runner = Said()
        Runner.write_trace(runner, run, trace, pid_calibrate._open_trace)  # type: ignore[arg-type]
        assert runner.said == []
        assert trace.read_text() == "1.0000 20.000 1.0000\n"
        assert trace.is_file() and not trace.is_symlink()
        trace.unlink()
    assert config.read_text() == "[printer]\n"
