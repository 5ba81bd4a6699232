"""Raw `induction_block` messages to SampleBlock records.

One message carries a running block index (16 bit), the clock of its first sample and one to three records, little
endian:

    u16  bits 0-11 lowest sample, bits 12-15 flags
    u8   highest minus lowest sample
    u24  value = sum >> oversample: eq 2 of source 000 (4^y samples, scaled by 2^y)
    PHASE u16  bridge phase in force, ticks; without it as in the record before
    CUT   u16  samples summed; without it a whole block
    GAP   u16 discarded, u16 lost  samples left out or overwritten since the block before; without it none
    WIDE  u16  highest sample, where the u8 is too small

A block ends at its full length or at a phase step, so `count` may be smaller; the host divides by the count it was
told. Every sample is told of, so a record's first sample is the end of the record before plus what was left out.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from .records import SampleBlock

HEAD = struct.Struct("<HBHB")
U16 = struct.Struct("<H")
GAP = struct.Struct("<HH")
LOW_MASK, HAS_PHASE, IS_CUT, HAS_GAP, IS_WIDE = 0x0FFF, 0x1000, 0x2000, 0x4000, 0x8000
SEQUENCE_MODULUS = 1 << 16


class ConvertError(ValueError):
    """A block message whose length or content cannot be right."""


@dataclass(frozen=True, slots=True)
class ConvertParameters:
    """How the MCU was told to sample."""

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


@dataclass(slots=True)
class ConvertState:
    """Counters of one stream of blocks, for the log and the status."""

    next_sequence: int = -1  # unwrapped index expected next; -1 before the first message
    blocks: int = 0
    missing_blocks: int = 0  # never arrived: gaps in the sequence
    lost_samples: int = 0  # overwritten on the MCU
    discarded_samples: int = 0


def _unwrap(state: ConvertState, sequence: int) -> int:
    """Extend the 16-bit index and count what is missing since the message before."""
    if state.next_sequence < 0:
        return sequence
    gap = (sequence - state.next_sequence) % SEQUENCE_MODULUS
    if gap >= SEQUENCE_MODULUS // 2:
        return -1  # older than what was seen: a duplicate
    state.missing_blocks += gap
    return state.next_sequence + gap


class _Record(NamedTuple):
    """One record as it came, before its place in time is known."""

    count: int  # type: ignore[assignment]
    value: int
    phase: int
    low: int
    high: int
    discarded: int
    lost: int


def _records(data: bytes, block_samples: int) -> list[_Record]:
    """Unpack the records of one message; raises ConvertError."""
    records: list[_Record] = []
    at, end, phase = 0, len(data), -1
    try:
        while at < end:
            first, span, value_low, value_high = HEAD.unpack_from(data, at)
            at += HEAD.size
            low, count, discarded, lost = first & LOW_MASK, block_samples, 0, 0
            high = low + span
            if first & HAS_PHASE:
                (phase,) = U16.unpack_from(data, at)
                at += 2
            if first & IS_CUT:
                (count,) = U16.unpack_from(data, at)
                at += 2
            if first & HAS_GAP:
                discarded, lost = GAP.unpack_from(data, at)
                at += 4
            if first & IS_WIDE:
                (high,) = U16.unpack_from(data, at)
                at += 2
            if not count or phase < 0:
                raise ConvertError("induction_block record without samples or phase")
            records.append(_Record(count, value_high << 16 | value_low, phase, low, high, discarded, lost))
    except struct.error:
        raise ConvertError(f"induction_block with {end} data bytes ends within a record") from None
    if not records:
        raise ConvertError("induction_block without records")
    return records


def convert_message(
    parameters: ConvertParameters,
    state: ConvertState,
    sequence: int,
    clock: int,
    data: bytes,
    print_time_of: Callable[[int], float],
) -> list[SampleBlock]:
    """The blocks of one message; `clock` is the message's clock extended to 64 bit.

    A message seen before gives an empty list. Raises ConvertError on a malformed message.
    """
    records = _records(data, parameters.block_samples)
    index = _unwrap(state, sequence)
    if index < 0:
        return []
    scale = 1 << parameters.oversample
    # The MCU's shift drops the low bits of the sum; on average it drops half of their range.
    dropped = 0.5 * (scale - 1)
    period_s = parameters.period_s
    start_s = print_time_of(clock)
    blocks = []
    offset = -(records[0].discarded + records[0].lost)  # the first record lies at the message's clock
    for record in records:
        offset += record.discarded + record.lost
        mean_raw = (record.value * scale + dropped) / record.count
        blocks.append(
            SampleBlock(
                index,
                clock + offset * parameters.period_ticks,
                start_s + offset * period_s,
                record.count * period_s,
                record.count,
                mean_raw,
                record.low,
                record.high,
                record.phase,
                record.discarded,
                record.lost,
            )
        )
        offset += record.count
        index += 1
        state.lost_samples += record.lost
        state.discarded_samples += record.discarded
    state.next_sequence = index
    state.blocks += len(blocks)
    return blocks
