"""The log: a file a day and a file a size, for the user's eyes, and one line about a disk that is full."""

from __future__ import annotations

import logging
import os
from pathlib import Path

import pytest

from queuelogger import RolloverFile


def record(text: str) -> logging.LogRecord:
    return logging.makeLogRecord({"msg": text, "levelno": logging.INFO})


def test_a_long_log_goes_on_in_a_new_file_and_old_ones_are_deleted(tmp_path: Path) -> None:
    log = RolloverFile(str(tmp_path / "klippy.log"), size_max=1000)
    log.rollover_info["config"] = "[printer]"
    for number in range(200):
        log.emit(record(f"line {number} " + "x" * 90))
    log.close()
    names = sorted(path.name for path in tmp_path.iterdir())
    assert len(names) == 6 and names[0] == "klippy.log"
    assert all((tmp_path / name).stat().st_size < 1300 for name in names)
    lines = (tmp_path / "klippy.log").read_text().splitlines()
    assert lines[0] == "[printer]" and "Log rollover at" in lines[1] and lines[-1].startswith("line 199 ")
    kept = sorted(
        int(line.split()[1])
        for name in names
        for line in (tmp_path / name).read_text().splitlines()
        if "line" in line
    )
    assert kept == list(range(kept[0], 200))  # nothing is lost between two files


def test_the_log_is_not_for_everybody(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        RolloverFile(str(tmp_path / "klippy.log")).close()
    finally:
        os.umask(before)
    assert (tmp_path / "klippy.log").stat().st_mode & 0o007 == 0


def test_a_full_disk_is_reported_once(capsys: pytest.CaptureFixture[str]) -> None:
    log = RolloverFile("/dev/full")
    for number in range(100):
        log.emit(record(f"line {number}"))
    assert (
        capsys.readouterr().err == "The log /dev/full cannot be written: [Errno 28] No space left on device\n"
    )
