"""The blocks of one message where the C helper holds them (thermal/sensing/pipeline.h); Python's records on demand.

Hundreds of blocks arrive every second and few are ever looked at one by one: by a dump, a calibration run, a test.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from functools import partial
from typing import Any

import chelper
from thermal.records import SampleBlock, TempEstimate

BLOCKS_MAX = 256  # as in thermal/sensing/convert.h
BLOCK_SIZE = chelper.get_ffi()[0].sizeof("struct coil_block")

# Why a block gives no temperature, in the order of thermal/sensing/pipeline.h's enum block_fault.
REASONS = (
    "",
    "bridge off",
    "signal clipped",
    "samples lost",
    "too little excitation",
    "signal far above any nozzle's: is the nozzle missing from the coil?",
    "outside the range of the sensing law: wrong nozzle, or its thermometer is not calibrated?",
)

_new_estimate = partial(tuple.__new__, TempEstimate)


class Blocks:
    """Up to BLOCKS_MAX blocks in order of time. `raw` is C's array, of which the first `count` mean something."""

    __slots__ = ("_bytes", "count", "raw")

    def __init__(self) -> None:
        ffi = chelper.get_ffi()[0]
        self.raw: Any = ffi.new("struct coil_block[]", BLOCKS_MAX)
        self._bytes = ffi.buffer(self.raw)
        self.count = 0

    @classmethod
    def of(cls, blocks: Iterable[SampleBlock]) -> Blocks:
        """From records, for who makes blocks up."""
        made = cls()
        for block in blocks:
            if made.count == BLOCKS_MAX:
                raise ValueError(f"more than {BLOCKS_MAX} blocks in one message")
            raw = made.raw[made.count]
            for name, value in block._asdict().items():
                setattr(raw, name, value)
            made.count += 1
        return made

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> SampleBlock:
        if not -self.count <= index < self.count:
            raise IndexError("no such block")
        raw = self.raw[index % self.count]
        return SampleBlock(
            raw.sequence,
            raw.clock,
            raw.time_s,
            raw.duration_s,
            raw.count,
            raw.mean_raw,
            raw.min_raw,
            raw.max_raw,
            raw.phase_ticks,
            raw.discarded,
            raw.lost,
        )

    def __iter__(self) -> Iterator[SampleBlock]:
        return (self[i] for i in range(self.count))

    @property
    def end_s(self) -> float:
        """Print time at which the newest block ended; -inf without one."""
        if not self.count:
            return -math.inf
        newest = self.raw[self.count - 1]
        return float(newest.time_s + newest.duration_s)

    def copy(self) -> bytes:
        """C's struct coil_block, one after another."""
        return self._bytes[: self.count * BLOCK_SIZE]

    def estimate(self, index: int) -> TempEstimate:
        """What one block says by itself, after it went through a chain."""
        b = self.raw[index]
        return TempEstimate(
            b.centre_s,
            b.temp_c,
            b.sigma_c,
            b.noise_c,
            b.c_per_unit,
            b.phase_ticks,
            not b.fault,
            REASONS[b.fault],
        )

    def tracked(self, index: int) -> TempEstimate | None:
        """The filtered estimate at this block's centre; None: it gave no valid temperature."""
        b = self.raw[index]
        if not b.is_tracked:
            return None
        figures = (b.centre_s, b.tracked_c, b.tracked_sigma_c, b.tracked_noise_c, b.c_per_unit, b.phase_ticks)
        return _new_estimate((*figures, True, ""))
