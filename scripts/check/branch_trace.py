"""Runs pytest and notes which instructions of one Python file follow each other.

branch_trace.py FILE REPORT [PYTEST-ARGUMENT ...]: REPORT gets a line for each line of FILE that was not reached and for
each condition that went one way only. Conditions are the jumps of the compiled code: each operand of an `and` is one.
"""

from __future__ import annotations

import dis
import sys
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FrameType
from typing import Any

UNCONDITIONAL = ("JUMP_FORWARD", "JUMP_BACKWARD", "JUMP_ABSOLUTE", "JUMP_BACKWARD_NO_INTERRUPT", "SEND")


class Tracer:
    """Which offset came after which, for the code of one file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.steps: set[tuple[str, int, int, int]] = set()  # function, its line, offset before, offset
        self._before: dict[int, int] = {}

    def __call__(self, frame: FrameType, _event: str, _value: Any) -> Any:
        if frame.f_code.co_filename != str(self.path):
            return None
        frame.f_trace_opcodes = True
        self._before[id(frame)] = -1
        return self._step

    def _step(self, frame: FrameType, event: str, _value: Any) -> Any:
        if event == "opcode":
            code, before = frame.f_code, self._before[id(frame)]
            self.steps.add((code.co_name, code.co_firstlineno, before, frame.f_lasti))
            self._before[id(frame)] = frame.f_lasti
        return self._step

    def missed(self) -> Iterator[str]:
        """What never happened, in order of lines."""
        text = self.path.read_text()
        lines = text.splitlines()
        gaps: set[tuple[int, str]] = set()
        for code in _codes(compile(text, str(self.path), "exec")):
            gaps.update(self._missed_in(code))
        for line, what in sorted(gaps):
            yield f"{line}: {what}: {lines[line - 1].strip()}"

    def _missed_in(self, code: CodeType) -> Iterator[tuple[int, str]]:
        steps = {step[2:] for step in self.steps if step[:2] == (code.co_name, code.co_firstlineno)}
        reached = {offset for _, offset in steps}
        instructions = list(dis.get_instructions(code))
        line = code.co_firstlineno
        for here, after in zip(instructions, [*instructions[1:], None], strict=True):
            line = here.starts_line or line
            if here.starts_line and here.offset not in reached and here.opname != "RESUME":
                yield line, "not reached"
            if here.opcode not in dis.hasjrel + dis.hasjabs or here.opname in UNCONDITIONAL:
                continue
            ways = {here.argval, after.offset if after else -1}
            if here.offset in reached and any((here.offset, way) not in steps for way in ways):
                yield line, "goes one way only"


def _codes(code: CodeType) -> Iterator[CodeType]:
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)


def main() -> int:
    import pytest

    path, report = Path(sys.argv[1]).resolve(), Path(sys.argv[2])
    tracer = Tracer(path)
    sys.settrace(tracer)
    status = pytest.main(sys.argv[3:])
    sys.settrace(None)
    report.write_text("\n".join(tracer.missed()))
    return int(status)


if __name__ == "__main__":
    sys.exit(main())
