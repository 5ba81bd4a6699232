"""One print of a study: what determines it, its key, and its execution by a worker.

A job is plain data, since it goes to workers of another computer: files below the checkout by their path in it. The
worker runs each session (calibrations first) in a process of its own and takes part in nothing else.
"""

from __future__ import annotations

import glob
import hashlib
import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from configtext import ConfigError, read_main

from ..builds import ROOT

KEY_DIGITS = 16
MEMORY_MB = 2000  # of one print: 40 MB, and the columns of the longest trace
POLL_S = 0.5  # how often a worker looks whether its print is still wanted
CRASHED = "crashed"
STEP_FAILED = "calibration failed"
_SOURCES = frozenset((".py", ".c", ".h", ".mk"))
_INCLUDE = re.compile(r"^\s*\[include\s+([^]]+)\].*$", re.MULTILINE)


class WrongWorker(Exception):
    """This worker has another program or other files than the study."""


@dataclass(frozen=True, slots=True)
class Job:
    """`overrides`: (section, option, value); `before`: G-code of calibrations; `inputs`: hashes of config and file."""

    config: str
    gcode: str
    seed: int
    overrides: tuple[tuple[str, str, str], ...]
    before: tuple[str, ...]
    until_s: float | None
    figures: Mapping[str, Mapping[str, Any]]
    version: str
    inputs: tuple[str, str]

    @property
    def key(self) -> str:
        """Hash of what determines the result; where the files are does not."""
        facts = {name: value for name, value in asdict(self).items() if name not in ("config", "gcode")}
        return digest(json.dumps(facts, sort_keys=True).encode())[:KEY_DIGITS]


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def version() -> str:
    """Hash of the sources of host, firmware and simulator: the same commit, the same version."""
    total = hashlib.sha256()
    for folder in ("klippy", "src"):
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix in _SOURCES:
                total.update(f"{path.relative_to(ROOT)}\0".encode() + path.read_bytes())
    return total.hexdigest()


def input_hashes(config: str, gcode: str) -> tuple[str, str]:
    """Of the config with all it includes, and of the G-code file. Raises WrongWorker."""
    try:
        data, _ = read_main(str(locate(config)))
        sections = {name: {k: o.value for k, o in s.options.items()} for name, s in data.sections.items()}
        return digest(json.dumps(sections).encode()), digest(locate(gcode).read_bytes())
    except (OSError, ConfigError) as e:
        raise WrongWorker(str(e)) from None


def locate(path: str) -> Path:
    """A job's path on this computer."""
    return ROOT / path


def portable(path: Path) -> str:
    """A path as jobs have it: within the checkout relative to that, else absolute."""
    path = path.absolute()
    return str(path.relative_to(ROOT) if path.is_relative_to(ROOT) else path)


def execute(job: Job, keep: Path | None = None, wanted: Callable[[], bool] = lambda: True) -> dict[str, Any]:
    """Print. `keep`: folder in which trace, summary and log stay. Raises WrongWorker, InterruptedError.

    Returns `row`, which is a function of the job alone, and `seen`, which is not.
    """
    if job.version != version():  # computed each time: somebody may edit a file while a study runs
        raise WrongWorker("its sources of Ferrite are not, or no longer, those that the study began with.")
    if job.inputs != input_hashes(job.config, job.gcode):
        raise WrongWorker(f"its {job.config} or {job.gcode} is not, or no longer, that of the study.")
    start = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="ferrite-study-") as name:
        row = _sessions(job, Path(name), keep, wanted)
    seen = {"wall_s": round(time.monotonic() - start, 3), "host": socket.gethostname(), "root": str(ROOT)}
    return {"key": job.key, "row": row, "seen": seen}


def _sessions(job: Job, folder: Path, keep: Path | None, wanted: Callable[[], bool]) -> dict[str, Any]:
    config = locate(job.config)
    if job.before:
        config = copy_config(config, folder)
    common: dict[str, Any] = {"seed": job.seed, "overrides": job.overrides}
    for number, lines in enumerate(_split_sessions(job.before)):
        step = folder / f"before{number}.gcode"
        step.write_text("\n".join(lines) + "\n", encoding="utf-8")
        log = (keep or folder) / f"before{number}.log"  # the trace of a calibration goes beside it
        answer = run_child(
            {**common, "config": str(config), "gcode": str(step), "log": str(log)}, folder, wanted
        )
        if answer["exit_status"] != 0:
            return _row(STEP_FAILED, f"{shlex.quote(lines[0])}: {answer['reason']}", {}, folder)
    task = {**common, "config": str(config), "gcode": str(locate(job.gcode)), "until_s": job.until_s}
    if keep:
        task |= {"keep": str(keep), "log": str(keep / "host.log")}
    answer = run_child({**task, "figures": job.figures}, folder, wanted)
    return _row(answer["status"], answer["reason"], answer["figures"], folder)


def _row(status: str, reason: str, figures: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    for place in (folder, ROOT):
        reason = reason.replace(f"{place}/", "")
    return {"status": status, "reason": reason, "figures": figures}


def copy_config(config: Path, folder: Path) -> Path:
    """A copy that SAVE_CONFIG may write to, which it would not do to options of an included file: all in one file."""

    def text_of(path: Path) -> str:
        return _INCLUDE.sub(
            lambda match: "\n".join(text_of(path.parent / name) for name in _named(path.parent, match[1])),
            path.read_text(encoding="utf-8"),
        )

    copy = folder / config.name
    copy.write_text(text_of(config.resolve()), encoding="utf-8")
    return copy


def _named(folder: Path, pattern: str) -> list[str]:
    return sorted(glob.glob(pattern.strip(), root_dir=folder))


def _split_sessions(lines: Sequence[str]) -> list[list[str]]:
    """SAVE_CONFIG ends a session: what follows it runs on the config it wrote."""
    sessions: list[list[str]] = [[]]
    for line in lines:
        sessions[-1].append(line)
        if line.strip().upper() == "SAVE_CONFIG":
            sessions.append([])
    return [session for session in sessions if session]


def run_child(
    task: Mapping[str, Any], folder: Path, wanted: Callable[[], bool] = lambda: True
) -> dict[str, Any]:
    """One simulated session in a process of its own, which ends when this process or thread does."""
    answer, errors = folder / "answer.json", folder / "errors.txt"
    answer.unlink(missing_ok=True)
    command = [sys.executable, "-m", f"{__package__}.child", str(answer)]
    with errors.open("w") as stderr:
        process = subprocess.Popen(
            command,
            cwd=ROOT / "klippy",
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=stderr,
            text=True,
            start_new_session=True,  # a Ctrl-C in a terminal is not for the print
        )
        try:
            process.communicate(json.dumps({**task, "parent": os.getpid(), "memory_mb": MEMORY_MB}), POLL_S)
        except subprocess.TimeoutExpired:
            _wait(process, wanted)
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
    if process.returncode in (-signal.SIGKILL, -signal.SIGTERM):
        raise InterruptedError(
            "the print was killed from outside"
        )  # of no meaning for the study: it is repeated
    if process.returncode != 0 or not answer.exists():
        last = ([line for line in errors.read_text().splitlines() if line.strip()] or ["no message"])[-1]
        text = f"the process ended with status {process.returncode}: {last}"
        return {
            "exit_status": 1,
            "status": CRASHED,
            "reason": text,
            "figures": {},
            "settings": {},
            "summary": {},
        }
    result: dict[str, Any] = json.loads(answer.read_text())
    return result


def _wait(process: subprocess.Popen[str], wanted: Callable[[], bool]) -> None:
    while True:
        try:
            process.wait(POLL_S)
            return
        except subprocess.TimeoutExpired:
            if not wanted():
                raise InterruptedError("the print is no longer wanted") from None
