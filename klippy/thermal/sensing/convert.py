"""Raw `induction_block` messages to blocks, many at a time; the work is done in C (thermal/sensing/convert.h).

One message carries a running block index (16 bit), the clock of its first sample and as many records as fit, little
endian:

    u16  bits 0-11 lowest sample, bits 12-15 flags
    u8   highest minus lowest sample
    u24  value = sum >> oversample: eq 2 of Oskolkov 2021 (4^y samples, scaled by 2^y)
    PHASE u16  bridge phase in force, ticks; without it as in the record before
    CUT   u16  samples summed; without it a whole block
    GAP   u16 discarded, u16 lost  samples left out or overwritten since the block before; without it none
    WIDE  u16  highest sample, where the u8 is too small

A block ends at its full length or at a phase step, so `count` may be smaller; the host divides by the count of the
record. Every sample is accounted for: a record's first sample is the end of the record before plus what was left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import chelper

from .blocks import Blocks

BATCH_MESSAGES = 32  # unpacked at a time, 0.15 s; more wait for the next time

# By thermal/sensing/convert.h's enum blockwire_error.
_COMPLAINTS = {
    1: "an induction_block ends within a field or a record",
    2: "an induction_block record without samples or phase",
    3: "an induction_block without records",
}


@dataclass(frozen=True, slots=True)
class ConvertParameters:
    """How the MCU samples."""

    oversample: int  # y: 4^y samples a block
    period_ticks: int  # bridge period in MCU clock ticks
    clock_hz: float
    block_len: int = 0  # samples of a whole block, 0: 4^y

    @property
    def period_s(self) -> float:
        return self.period_ticks / self.clock_hz

    @property
    def block_samples(self) -> int:
        return self.block_len or 4**self.oversample


class Stream:
    """The blocks of one MCU. `counters` is C's struct block_stream, read for the log and the status."""

    def __init__(self, parameters: ConvertParameters) -> None:
        ffi, self._lib = chelper.get_ffi()
        self.counters: Any = ffi.new("struct block_stream *")
        self.counters.period_ticks, self.counters.period_s = parameters.period_ticks, parameters.period_s
        self.counters.oversample, self.counters.block_samples = (
            parameters.oversample,
            parameters.block_samples,
        )
        self._blocks = Blocks()
        self._near = ffi.new("struct clock_point *")
        self.counters.next_sequence = -1

    def take(self, messages: Any, count: int, clock: int, time_s: float, tick_s: float) -> Blocks:
        """The blocks of up to BATCH_MESSAGES messages (C's struct pull_message), valid until the next.

        `clock` is any 64-bit clock within 2^31 ticks of theirs, `time_s` its print time, `tick_s` that of a tick.
        A message seen before gives none, a malformed one neither: `complaint` says why.
        """
        blocks, near = self._blocks, self._near
        near.clock, near.time_s, near.tick_s = clock, time_s, tick_s
        blocks.count = self._lib.blockwire_unpack(self.counters, near, messages, count, blocks.raw)
        return blocks

    def complaint(self) -> str:
        """What was wrong with the newest malformed message since this was last asked, or ""."""
        number, self.counters.complaint = self.counters.complaint, 0
        return _COMPLAINTS.get(number, "")
