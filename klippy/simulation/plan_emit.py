"""A sliced file with the plan as M104 commands, for firmware that has no plan of its own.

M104 acts when it is read, some motion before the path it stands at; the plan's own preview is far longer, so that is
left out. What the file itself says with M104/M109 while it extrudes is taken out: the plan holds it already.
"""

from __future__ import annotations

import re
from pathlib import Path

from .plan_offline import OfflinePlan

_TARGET = re.compile(rb"^\s*M10[49](?![.\d])[^;]*S\s*([0-9.]+)", re.IGNORECASE)


def write(source: Path, target: Path, plan: OfflinePlan, step_c: float) -> int:
    """Write `target`; returns how many commands it got. `step_c`: least change. Raises OSError."""
    commands = _commands(plan, step_c)
    first, last = plan.moves[0].line, plan.moves[-1].line
    with source.open("rb") as lines, target.open("wb") as out:
        for number, line in enumerate(lines):
            told = _TARGET.match(line)
            if told is not None and first < number < last and float(told[1]) > 0.0:
                out.write(b";planned: " + line.lstrip())
                continue
            if number in commands:
                out.write(b"M104 S%d ;planned\n" % commands[number])
            out.write(line)
    return len(commands)


def _commands(plan: OfflinePlan, step_c: float) -> dict[int, int]:
    """Line -> target: where the planned nozzle temperature has moved by `step_c` since the last command."""
    commands: dict[int, int] = {}
    told_c = plan.base_c
    for move in plan.moves:
        if abs(move.wall_c - told_c) >= step_c:
            told_c = commands[move.line] = round(move.wall_c)
    return commands
