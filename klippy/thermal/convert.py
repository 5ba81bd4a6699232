"""Raw `induction_block` messages to SampleBlock records.

One message carries a running block index (16 bit), a clock and one or more records of 18 bytes, little
endian:

    u16 offset   first sample, in bridge periods after the message's clock
    u16 count    samples summed
    u32 value    sum >> oversample: eq 2 of source 000 (4^y samples, scaled by 2^y)
    u16 phase    bridge phase in force, ticks
    u16 min, u16 max            raw extremes
    u16 discarded, u16 lost     samples left out or overwritten since the block before

A block ends at 4^y samples or at a phase step, so `count` may be smaller; the host divides by the count it
was told.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from .records import SampleBlock

RECORD = struct.Struct("<HHIHHHHH")
SEQUENCE_MODULUS = 1 << 16


class ConvertError(ValueError):
    """A block message whose length or content cannot be right."""


@dataclass(frozen=True, slots=True)
class ConvertParameters:
    """How the MCU was told to sample."""

    oversample: int  # y: 4^y samples a block
    period_ticks: int  # bridge period in MCU clock ticks
    clock_hz: float

    @property
    def period_s(self) -> float:
        return self.period_ticks / self.clock_hz

    @property
    def block_samples(self) -> int:
        return 4**self.oversample


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
    if not data or len(data) % RECORD.size:
        raise ConvertError(f"induction_block with {len(data)} data bytes, not a multiple of {RECORD.size}")
    index = _unwrap(state, sequence)
    if index < 0:
        return []
    scale = 1 << parameters.oversample
    # The MCU's shift drops the low bits of the sum; on average it drops half of their range.
    dropped = 0.5 * (scale - 1)
    period_s = parameters.period_s
    blocks = []
    for offset, count, value, phase, low, high, discarded, lost in RECORD.iter_unpack(data):
        if not count:
            raise ConvertError("induction_block record without samples")
        first_clock = clock + offset * parameters.period_ticks
        mean_raw = (value * scale + dropped) / count
        time_s = print_time_of(first_clock)
        duration_s = count * period_s
        block = SampleBlock(
            index, first_clock, time_s, duration_s, count, mean_raw, low, high, phase, discarded, lost
        )
        blocks.append(block)
        index += 1
        state.lost_samples += lost
        state.discarded_samples += discarded
    state.next_sequence = index
    state.blocks += len(blocks)
    return blocks
