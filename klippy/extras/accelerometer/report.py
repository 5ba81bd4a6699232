"""NOZZLE_REPORT PLOT=1: what [nozzle_monitor] saw as a table, and a picture of it by a process of its own."""

from __future__ import annotations

import csv
import subprocess
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Any

from gcode import GCodeCommand
from roles import Printer

from .commands import open_result, result_name

COLUMNS = ("t_s", "condition", "diameter_mm", "sigma_mm", "lost_flow", "evidence")
SCRIPT = Path(__file__).resolve().parents[3] / "scripts" / "bench" / "plot_nozzle.py"


def write(printer: Printer, gcmd: GCodeCommand, rows: Iterable[tuple[Any, ...]]) -> str:
    """The rows have COLUMNS. Returns where they are; raises the command's error."""
    table = list(rows)
    if not table:
        raise gcmd.error("NOZZLE_REPORT: nothing was extruded yet, there is nothing to draw")
    name = f"nozzle_report_{result_name(gcmd)}"
    with open_result(gcmd, f"{name}.csv") as stream:
        writer = csv.writer(stream)
        writer.writerows([COLUMNS, *table])
    command = [sys.executable, str(SCRIPT), stream.name]
    run = partial(subprocess.run, command, capture_output=True, check=False)
    done = printer.get_reactor().run_beside(run).wait()
    if isinstance(done, Exception) or done.returncode:
        text = str(done) if isinstance(done, Exception) else done.stderr.decode(errors="replace").strip()
        return f"Table: {stream.name}. No picture: {(text.splitlines() or ['no reason'])[-1].rstrip('.')}."
    with open_result(gcmd, f"{name}.png") as picture:
        picture.buffer.write(done.stdout)
    return f"Table: {stream.name}, picture: {picture.name}"
