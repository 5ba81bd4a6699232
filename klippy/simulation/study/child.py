"""The process of one simulated session: task as JSON on stdin, answer as JSON in a file.

    python -m simulation.study.child ANSWER.json <TASK.json

The simulator has static state, so a print has a process of its own. The process ends with the thread that started it.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Any

import queuelogger

from ..runner import RunOptions, Simulation
from ..world import WorldError
from .figures import collect, columns_of

PR_SET_PDEATHSIG = 1  # linux/prctl.h


def end_with_parent(parent: int) -> None:
    """Also when the parent is killed: the kernel sends the signal. `parent` may have ended before this call."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(1)


def run(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Simulate; the answer as simulation.study.job expects it. `folder`: for a trace that nobody keeps."""
    keep = Path(task["keep"]) if task.get("keep") else None
    figures = task.get("figures", {})
    trace = (keep or folder) / "trace.csv" if keep or task.get("describe") or columns_of(figures) else None
    log = Path(task["log"]) if task.get("log") else None
    handler: logging.Handler = logging.FileHandler(log, mode="w") if log else logging.NullHandler()
    handler.setFormatter(queuelogger.LineFormatter("%(message)s"))
    logging.basicConfig(level=logging.INFO if log else logging.CRITICAL + 1, handlers=[handler])
    overrides = tuple((section, option, value) for section, option, value in task["overrides"])
    simulation = Simulation(
        RunOptions(
            Path(task["config"]),
            Path(task["gcode"]),
            task["seed"],
            overrides,
            trace,
            task.get("until_s"),
            log=log,
        )
    )
    outcome = simulation.run()
    answer = {
        "exit_status": outcome.status,
        "status": outcome.summary["status"],
        "reason": outcome.reason,
        "figures": collect(figures, outcome.summary, trace),
    }
    if keep:
        (keep / "summary.json").write_text(json.dumps(outcome.summary, indent=2) + "\n", encoding="utf-8")
    if task.get("describe"):
        answer |= _description(simulation, outcome.summary, trace)
    return answer


def _description(simulation: Simulation, summary: dict[str, Any], trace: Path | None) -> dict[str, Any]:
    """What the config has: options read while it was loaded, and the names of figures."""
    config = simulation.printer.lookup_object("configfile").get_status(0.0)
    columns = trace.open(encoding="utf-8").readline().strip().split(",") if trace and trace.exists() else []
    settings = {s: {o: str(v) for o, v in options.items()} for s, options in config["settings"].items()}
    return {"settings": settings, "summary": summary, "columns": columns}


def main(argv: list[str]) -> int:
    task = json.load(sys.stdin)
    end_with_parent(task["parent"])
    answer_path = Path(argv[0])
    limit = task["memory_mb"] * 1_000_000
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    try:
        answer = run(task, answer_path.parent)
    except WorldError as e:
        print(e, file=sys.stderr)
        return 1
    answer_path.write_text(json.dumps(answer), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
