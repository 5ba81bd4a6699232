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
from vibration.plot_condition import COLUMNS

from .commands import open_result, result_name

HOST_FOLDER = Path(__file__).resolve().parents[2]


def write(printer: Printer, gcmd: GCodeCommand, rows: Iterable[tuple[Any, ...]]) -> str:
    """The rows have plot_condition.COLUMNS. Returns where they are; raises the command's error."""
    table = list(rows)
    if not table:
        raise gcmd.error("NOZZLE_REPORT: nothing was extruded yet, there is nothing to draw")
    name = f"nozzle_report_{result_name(gcmd)}"
    with open_result(gcmd, f"{name}.csv") as stream:
        writer = csv.writer(stream)
        writer.writerows([COLUMNS, *table])
    command = [sys.executable, "-m", "vibration.plot_condition", stream.name]
    run = partial(subprocess.run, command, cwd=HOST_FOLDER, capture_output=True, check=False)
    done = printer.get_reactor().run_beside(run).wait()
    if isinstance(done, Exception) or done.returncode:
        text = str(done) if isinstance(done, Exception) else done.stderr.decode(errors="replace").strip()
        return f"Table: {stream.name}. No picture: {(text.splitlines() or ['no reason'])[-1]}."
    with open_result(gcmd, f"{name}.png") as picture:
        picture.buffer.write(done.stdout)
    return f"Table: {stream.name}, picture: {picture.name}"
