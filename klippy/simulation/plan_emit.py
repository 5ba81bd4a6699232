"""A sliced file with the plan as M104, M220 and G4 commands, for firmware that has no plan of its own.

M104 acts when it is read, some motion before the path it stands at; the plan's own preview is far longer, so that is
left out. What the file itself says with M104/M109 while it extrudes is taken out: the plan holds it already. Its own
M220 are multiplied with the plan's speed_factor (M220 slows travel, too, which the plan does not).
"""

from __future__ import annotations

import os
import re
import shutil
import stat
import tempfile
from pathlib import Path
from typing import BinaryIO

from .plan_offline import OfflinePlan

_TARGET = re.compile(rb"^\s*(?:N\d+\s*)?M10[49](?![.\d])[^;]*S\s*([0-9.]+)", re.IGNORECASE)
_FACTOR = re.compile(rb"^\s*(?:N\d+\s*)?M220(?![.\d])[^;]*S\s*([0-9.]+)", re.IGNORECASE)


def write(source: Path, target: Path, plan: OfflinePlan, step_c: float) -> int:
    """Write `target`, which may be `source`; returns how many commands it got. `step_c`: min change. Raises OSError.

    The new file is written beside the target and replaces it when complete: no file is ever left half written.
    """
    kind = target.stat().st_mode if target.exists() else stat.S_IFREG
    if not stat.S_ISREG(kind):  # /dev/stdout, a pipe
        with target.open("wb") as out:
            return _write(source, out, plan, step_c)
    target = target.resolve()  # through a link: the file it names
    handle, name = tempfile.mkstemp(prefix=target.name + ".", dir=target.parent)
    part = Path(name)
    try:
        with os.fdopen(handle, "wb") as out:
            count = _write(source, out, plan, step_c)
        shutil.copymode(source, part)  # mkstemp's is for the owner alone
        part.replace(target)
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    return count


def _write(source: Path, out: BinaryIO, plan: OfflinePlan, step_c: float) -> int:
    commands = _commands(plan, step_c)
    speed_changes = {change.line: change.speed for change in plan.speed_changes}
    first, last = plan.moves[0].line, plan.moves[-1].line
    count, file_percent, factor = len(commands), 100.0, 1.0
    with source.open("rb") as lines:
        for number, line in enumerate(lines):
            if number in commands:
                out.write(b"M104 S%d ;planned\n" % commands[number])
            if number in speed_changes:
                speed = speed_changes[number]
                if speed.factor != factor:
                    factor = speed.factor
                    out.write(b"M220 S%d ;planned\n" % round(file_percent * factor))
                    count += 1
                if speed.pause_s > 0.0:
                    out.write(b"G4 P%d ;planned\n" % round(1000.0 * speed.pause_s))
                    count += 1
            kept = line
            found = _TARGET.match(line)
            if found is not None and first < number < last and float(found[1]) > 0.0:
                kept = b";planned: " + line.lstrip()
            found = _FACTOR.match(line)
            if found is not None:
                file_percent = float(found[1])
                kept = b"M220 S%d ;planned, was: %s" % (round(file_percent * factor), line.lstrip())
            out.write(kept)
        if factor != 1.0:
            out.write(b"M220 S%d ;planned\n" % round(file_percent))
            count += 1
    return count


def _commands(plan: OfflinePlan, step_c: float) -> dict[int, int]:
    """Line -> target: where the planned nozzle temperature has moved by `step_c` since the last command."""
    commands: dict[int, int] = {}
    sent_c = plan.base_c
    for move in plan.moves:
        if abs(move.wall_c - sent_c) >= step_c:
            sent_c = commands[move.line] = round(move.wall_c)
    return commands
