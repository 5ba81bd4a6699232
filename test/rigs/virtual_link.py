"""A serialqueue and a reference MCU at the two ends of a bad line, in virtual time.

The MCU end is written from the protocol's description with msgproto's blocks; it executes what arrives in order, acks,
naks, and may answer. The line delays, and damages bytes or whole writes as configured.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import chelper
import msgproto

NEVER = 1e30


@dataclass(frozen=True)
class Damage:
    """Probabilities per byte (corrupt, drop, duplicate) and per write (truncate, repeat, swap)."""

    corrupt: float = 0.0
    drop: float = 0.0
    duplicate: float = 0.0
    truncate: float = 0.0  # the rest of a write is lost
    repeat: float = 0.0  # a write arrives twice
    swap: float = 0.0  # a write arrives after the next one


@dataclass
class Line:
    """One direction. `send` returns (arrival time, bytes) pairs."""

    rng: random.Random
    damage: Damage = field(default_factory=Damage)
    latency_s: float = 0.0005
    jitter_s: float = 0.0
    byte_s: float = 0.0
    free_s: float = 0.0
    held: list[tuple[float, bytes]] = field(default_factory=list)  # to arrive after the next write

    def send(self, data: bytes, now: float) -> list[tuple[float, bytes]]:
        d, rng = self.damage, self.rng
        self.free_s = max(self.free_s, now) + len(data) * self.byte_s
        arrival = self.free_s + self.latency_s + rng.random() * self.jitter_s
        out = bytearray()
        for byte in data:
            if rng.random() < d.drop:
                continue
            flipped = 1 << rng.randrange(8) if rng.random() < d.corrupt else 0
            out.append(byte ^ flipped)
            if rng.random() < d.duplicate:
                out.append(byte ^ flipped)
        if rng.random() < d.truncate:
            del out[rng.randrange(len(out) + 1) :]
        deliveries = [(arrival, bytes(out)), *((arrival, late) for _, late in self.held)]
        self.held = []
        if rng.random() < d.repeat:
            deliveries.append((arrival + 0.0002, bytes(out)))
        if rng.random() < d.swap:
            self.held = deliveries
            return []
        return deliveries


class ReferenceMcu:
    """The receiving end of the protocol: executes blocks in order, exactly once, and acks each."""

    def __init__(self, answer: Callable[[bytes], list[bytes]] | None = None, expected: int = 0) -> None:
        self.expected = expected
        self.executed: list[tuple[float, bytes]] = []  # time, content of the block
        self.naks = 0
        self._reader = msgproto.BlockReader()
        self._answer = answer or (lambda content: [])
        self._in_error = False
        self.emit: Callable[[bytes], None] = lambda data: None

    def receive(self, data: bytes, now: float) -> None:
        for block in self._reader.feed(data):
            if block is None:
                if not self._in_error:  # one nak for a run of garbage
                    self._nak()
                self._in_error = True
                continue
            self._in_error = False
            if block.seq != self.expected:
                self._nak()
                continue
            self.expected = (self.expected + 1) & msgproto.BLOCK_SEQ_MASK
            if block.content:
                self.executed.append((now, block.content))
                for reply in self._answer(block.content):
                    self.emit(msgproto.encode_block(self.expected, reply))
            self.emit(msgproto.encode_block(self.expected, b""))

    def _nak(self) -> None:
        self.naks += 1
        self.emit(msgproto.encode_block(self.expected, b""))


class Rig:
    """Both ends and both directions. `run(until)` lets virtual time pass."""

    def __init__(self, mcu: ReferenceMcu, to_mcu: Line, to_host: Line, start_s: float = 1.0) -> None:
        self.ffi, self.lib = chelper.get_ffi()
        self.sq = self.ffi.gc(self.lib.serialqueue_alloc(0), self.lib.serialqueue_free)
        self.mcu, self.to_mcu, self.to_host = mcu, to_mcu, to_host
        self.now = start_s
        self.received: list[tuple[float, bytes, float, int]] = []  # time, content, sent_time, notify_id
        self.written: list[tuple[float, bytes]] = []  # what the host put on the line
        self.max_unacked_bytes = self.max_unacked_blocks = 0
        self._events: list[tuple[float, int, str, bytes]] = []
        self._order = 0
        self._out = self.ffi.new("uint8_t[1024]")
        self._wake = self.ffi.new("double *", NEVER)
        self._stats = self.ffi.new("struct serialqueue_stats *")
        mcu.emit = lambda data: self._post("host", self.to_host.send(data, self.now))

    def queue(self) -> Any:
        return self.lib.serialqueue_alloc_commandqueue(self.sq)

    def send(self, cq: Any, data: bytes, min_clock: int = 0, req_clock: int = 0, notify_id: int = 0) -> None:
        assert self.lib.serialqueue_send(self.sq, cq, data, len(data), min_clock, req_clock, notify_id) == 0

    def stats(self) -> Any:
        self.lib.serialqueue_get_stats(self.sq, self._stats)
        return self._stats

    def _post(self, where: str, deliveries: list[tuple[float, bytes]]) -> None:
        for arrival, data in deliveries:
            self._order += 1
            heapq.heappush(self._events, (arrival, self._order, where, data))

    def _transmit(self) -> float:
        while count := self.lib.serialqueue_transmit(self.sq, self._out, 1024, self.now, self._wake):
            data = bytes(self.ffi.buffer(self._out, count))
            self.written.append((self.now, data))
            self._post("mcu", self.to_mcu.send(data, self.now))
        stats = self.stats()
        self.max_unacked_bytes = max(self.max_unacked_bytes, stats.unacked_bytes)
        self.max_unacked_blocks = max(self.max_unacked_blocks, stats.unacked_blocks)
        return self._wake[0]

    def run(self, until: float, stop: Callable[[], bool] = lambda: False) -> None:
        """Until `until` (s) or until `stop()`."""
        while not stop():
            wake = self._transmit()
            arrival = self._events[0][0] if self._events else NEVER
            upcoming = min(wake, arrival)
            if upcoming > until:
                self.now = until
                return
            assert wake > self.now or arrival <= self.now, (
                "transmit asks to be called at once, but has nothing"
            )
            self.now = max(self.now, upcoming)
            while self._events and self._events[0][0] <= self.now:
                _, _, where, data = heapq.heappop(self._events)
                if where == "mcu":
                    self.mcu.receive(data, self.now)
                else:
                    self._host_receive(data)

    def _host_receive(self, data: bytes) -> None:
        if not self.lib.serialqueue_receive(self.sq, data, len(data), self.now):
            return
        pulled = self.ffi.new("struct pull_message[]", 16)
        while count := self.lib.serialqueue_pull(self.sq, pulled, 16):
            for m in pulled[0:count]:
                content = bytes(self.ffi.buffer(m.data, m.len))
                self.received.append((self.now, content, m.sent_time, m.notify_id))


def blocks_of(data: bytes) -> list[msgproto.Block]:
    """The valid blocks in a piece of the line."""
    return [b for b in msgproto.BlockReader().feed(data) if b is not None]
