"""The wire form of sample blocks, written from the message's description, for tests on both sides of it."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any

import chelper


@dataclass(frozen=True)
class Row:
    """One record; `offset` counts bridge periods from the message's clock and is worked out when unpacking."""

    count: int
    value: int
    phase: int
    low: int
    high: int
    discarded: int = 0
    lost: int = 0
    offset: int = 0


def one_step(phase: int) -> bytes:
    """A plan of one phase, for queue_induction_plan."""
    return struct.pack("<HH", 0, phase)


def vlq(value: int) -> bytes:
    """A number as the link sends it: groups of seven bits, the first with its sign in two of them."""
    value = (value + (1 << 31)) % (1 << 32) - (1 << 31)
    groups = next(n for n in range(1, 6) if n == 5 or -(1 << 7 * n - 2) <= value < 3 << 7 * n - 2)
    return bytes(value >> 7 * i & 0x7F | (0x80 if i else 0) for i in reversed(range(groups)))


def content(sequence: int, clock: int, data: bytes, oid: int = 3) -> bytes:
    """One induction_block message behind the link's framing."""
    head = vlq(45) + vlq(oid) + vlq(sequence & 0xFFFF) + vlq(clock)
    return head + bytes([len(data)]) + data


def take(stream: Any, clock_hz: float, *messages: tuple[int, int, bytes]) -> Any:
    """The blocks of a batch of messages (sequence, 64-bit clock, data); print time 0 is clock 0."""
    pulled = chelper.get_ffi()[0].new("struct pull_message[]", len(messages))
    for entry, (sequence, clock, data) in zip(pulled, messages, strict=True):
        packed = content(sequence, clock, data)
        entry.len, entry.data = len(packed), packed
    clock = messages[-1][1] + 1_000_000
    return stream.take(pulled, len(messages), clock, clock / clock_hz, 1.0 / clock_hz)


def pack(rows: list[Row], block_len: int) -> bytes:
    out, phase = b"", None
    for row in rows:
        span = row.high - row.low
        flags = 0
        tail = b""
        if row.phase != phase:
            flags |= 0x1000
            tail += struct.pack("<H", row.phase)
        if row.count != block_len:
            flags |= 0x2000
            tail += struct.pack("<H", row.count)
        if row.discarded or row.lost:
            flags |= 0x4000
            tail += struct.pack("<HH", row.discarded, row.lost)
        if span >= 255:
            flags |= 0x8000
            tail += struct.pack("<H", row.high)
        out += struct.pack("<HB", flags | row.low, min(span, 255)) + row.value.to_bytes(3, "little") + tail
        phase = row.phase
    return out


def unpack(data: bytes, block_len: int) -> list[Row]:
    rows: list[Row] = []
    at, phase, offset = 0, -1, 0

    def take(size: int) -> int:
        nonlocal at
        at += size
        assert at <= len(data), "a record ends within its fields"
        return int.from_bytes(data[at - size : at], "little")

    while at < len(data):
        head, span, value = take(2), take(1), take(3)
        phase = take(2) if head & 0x1000 else phase
        count = take(2) if head & 0x2000 else block_len
        discarded, lost = (take(2), take(2)) if head & 0x4000 else (0, 0)
        low = head & 0x0FFF
        high = take(2) if head & 0x8000 else low + span
        if rows:
            offset += discarded + lost
        rows.append(Row(count, value, phase, low, high, discarded, lost, offset))
        offset += count
    return rows
