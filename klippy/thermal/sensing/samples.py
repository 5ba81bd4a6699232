"""Samples where the C helper holds them (struct model_sample); Python's records on demand.

One comes with each block, 600 a second. They go from the chain to the predictive law, both in C.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, overload

import chelper
from thermal.records import Sample

_SAMPLE = struct.Struct("5d?7x")  # struct model_sample
_new_sample = partial(tuple.__new__, Sample)  # Sample._make without a Python frame for each


class Samples(Sequence[Sample]):
    """The first `size` of C's array `raw`. Whoever hands one over does not write to it any more."""

    __slots__ = ("raw", "size")

    def __init__(self, raw: Any, size: int) -> None:
        self.raw = raw
        self.size = size

    @classmethod
    def of(cls, samples: Sequence[Sample]) -> Samples:
        """From records, if they are not in C already."""
        if isinstance(samples, Samples):
            return samples
        ffi = chelper.get_ffi()[0]
        return cls(ffi.new("struct model_sample[]", list(samples)), len(samples))

    def __len__(self) -> int:
        return self.size

    @property
    def end_s(self) -> float:
        """When the newest one's output ended; there must be one."""
        return float(self.raw[self.size - 1].end_s)

    @property
    def output(self) -> float:
        """That output."""
        return float(self.raw[self.size - 1].output)

    def _records(self) -> list[Sample]:
        data = chelper.get_ffi()[0].buffer(self.raw, self.size * _SAMPLE.size) if self.size else b""
        return list(map(_new_sample, _SAMPLE.iter_unpack(data)))

    @overload
    def __getitem__(self, index: int) -> Sample: ...
    @overload
    def __getitem__(self, index: slice) -> list[Sample]: ...
    def __getitem__(self, index: int | slice) -> Sample | list[Sample]:
        return self._records()[index]

    def __iter__(self) -> Iterator[Sample]:
        return iter(self._records())
