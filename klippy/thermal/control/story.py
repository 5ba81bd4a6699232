"""What one nozzle's loop saw and did of late, as lines for the log: written when the printer stops.

last blocks (time, phase, heat, signal, reading) ─┐
target, request, commands sent, plan              ├─► lines()
what is missing of the heat, or too much          ┘
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator
from typing import Any

import chelper
from thermal.sensing import supervision
from thermal.sensing.blocks import BLOCK_SIZE, REASONS, Blocks

from .loop_records import LoopState

BLOCKS = 64
COMMANDS = 8


class Story:
    """Remembers the newest blocks as they are: a copy of some hundred bytes a message."""

    def __init__(self) -> None:
        self._ffi = chelper.get_ffi()[0]
        self._messages: deque[bytes] = deque(maxlen=BLOCKS)

    def note(self, blocks: Blocks) -> None:
        """Blocks that went through the chain."""
        if blocks.count:
            self._messages.append(blocks.copy())

    def lines(self, state: LoopState, witness: Any) -> Iterator[str]:
        """Newest last."""
        request, news = state.request, state.estimate
        named = supervision.name_state(state.supervise, witness, news.temp_c, state.target_c)
        yield (
            f"state {named}, target {state.target_c:.1f} C, reading {news.temp_c:.1f} C at"
            f" {news.time_s:.4f} s, power requested {request.power_w:.1f} W at {request.time_s:.4f} s"
        )
        yield (
            f"heat over heat capacity {witness.ratio:.2f} of what is set up; rise missing {witness.missing_c:.1f} C,"
            f" too much {witness.surplus_c:.1f} C, allowed {witness.allowed_c:.1f} C"
        )
        line = state.bridge.raw.line
        for command in line.commands[max(0, line.count - COMMANDS) : line.count]:
            yield f"command: from {command.time_s:.4f} s {command.phase_ticks} ticks ({command.power_w:.1f} W)"
        for planned in state.horizon[:COMMANDS]:
            yield f"plan: from {planned.time_s:.4f} s {planned.value:.1f} W"
        for block in self.blocks():
            reading = (
                f"{block.temp_c:.2f} C +-{block.sigma_c:.2f}" if not block.fault else REASONS[block.fault]
            )
            yield (
                f"block: {block.end_s:.4f} s {block.phase_ticks} ticks {block.heat_w:.1f} W mean {block.mean_raw:.1f}"
                f" min {block.min_raw} max {block.max_raw}: {reading}"
            )

    def blocks(self) -> list[Any]:
        """The newest last."""
        found: list[Any] = []
        for message in reversed(self._messages):
            count = len(message) // BLOCK_SIZE
            raw = self._ffi.from_buffer("struct coil_block[]", message)
            found[:0] = [(raw, n) for n in range(count)]  # the pair keeps the memory
            if len(found) >= BLOCKS:
                break
        return [raw[n] for raw, n in found[-BLOCKS:] if not math.isnan(raw[n].end_s)]
