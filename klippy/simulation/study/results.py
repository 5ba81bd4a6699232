"""What a study leaves in its folder.

    journal.jsonl     one line a finished print: key, row, and what differs from computer to computer
    results.parquet   one row a print, sorted by key: a function of study, version and seeds
    failures.txt      prints that did not end well, with the command that repeats each

A line of the journal that a kill cut short is left out, and its print runs again.
"""

from __future__ import annotations

import fcntl
import json
import os
import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from .job import CRASHED, Job
from .studyfile import StudyError

Rows = dict[str, dict[str, Any]]  # key → row of a print


class Journal:
    """The finished prints of a folder; open in one study at a time."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "journal.jsonl"
        self._file = self.path.open("a+", encoding="utf-8")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise StudyError(f"Another study is running in {folder}.") from None
        self.rows: Rows = dict(self._read())

    def _read(self) -> Iterable[tuple[str, dict[str, Any]]]:
        self._file.seek(0)
        line = "\n"
        for line in self._file:
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue
            if entry["row"]["status"] != CRASHED:  # it may have been the computer: once more
                yield entry["key"], entry["row"]
        if not line.endswith("\n"):
            self._file.write("\n")

    def add(self, result: Mapping[str, Any]) -> None:
        self._file.write(json.dumps(result) + "\n")
        self._file.flush()
        self.rows[result["key"]] = result["row"]

    def close(self) -> None:
        self._file.close()


def write_table(
    path: Path, jobs: Mapping[str, Job], points: Mapping[str, Mapping[str, Any]], rows: Rows
) -> None:
    """The prints that are done. `points`: key → parameters."""
    keys = sorted(key for key in jobs if key in rows)
    columns: dict[str, pa.Array] = {
        "key": pa.array(keys, pa.string()),
        "file": pa.array([Path(jobs[key].gcode).name for key in keys], pa.string()),
        "seed": pa.array([jobs[key].seed for key in keys], pa.int64()),
        "status": pa.array([rows[key]["status"] for key in keys], pa.string()),
        "reason": pa.array([rows[key]["reason"] for key in keys], pa.string()),
    }
    for name in next(iter(points.values()), {}):
        columns[name] = _column([points[key][name] for key in keys])
    for name in next(iter(jobs.values())).figures:
        columns[name] = pa.array([rows[key]["figures"].get(name) for key in keys], pa.float64())
    new = path.with_suffix(".new")
    pq.write_table(pa.table(columns), new)
    os.replace(new, path)


def _column(values: Sequence[Any]) -> pa.Array:
    """Numbers as numbers; a parameter with any text as text."""
    if all(isinstance(value, int | float) and not isinstance(value, bool) for value in values):
        return pa.array([float(value) for value in values], pa.float64())
    return pa.array([str(value) for value in values], pa.string())


def write_failures(path: Path, jobs: Mapping[str, Job], rows: Rows, command: str) -> int:
    """How many prints did not end well. `command`: of the study, which repeats one with --run KEY."""
    failed = [(key, rows[key]) for key in sorted(jobs) if key in rows and rows[key]["status"] != "printed"]
    text = "".join(f"# {row['status']}: {row['reason']}\n{command} --run {key}\n" for key, row in failed)
    path.write_text(text, encoding="utf-8")
    return len(failed)


def command_of(*words: object) -> str:
    return shlex.join(map(str, words))
