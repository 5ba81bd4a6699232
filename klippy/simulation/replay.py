"""The MCU's guard on the blocks of a recorded run: src/guard.c, built by this machine's compiler."""

from __future__ import annotations

import hashlib
import itertools
import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import cffi

from chelper.compiler import read_headers, run_compiler
from thermal.recording import rerun, stored
from thermal.sensing.blocks import Blocks

from .builds import OUT

SOURCE = Path(__file__).resolve().parents[2] / "src" / "guard.c"
FLAGS = ("-std=c11", "-O2", "-fPIC", "-shared")
TRIPS = (
    "",
    "too low",
    "too high",
    "clipped",
    "stuck",
    "timeout",
    "unmoved",
    "conducts",
    "jump",
)  # enum guard_trip


@cache
def _library() -> tuple[cffi.FFI, Any]:
    header = SOURCE.with_suffix(".h")
    digest = hashlib.sha256(SOURCE.read_bytes() + header.read_bytes()).hexdigest()[:16]
    folder = OUT / "replay"
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"guard-{digest}.so"
    if not target.exists():
        handle, partial = tempfile.mkstemp(suffix=".so", dir=folder)
        os.close(handle)
        run_compiler([*FLAGS, str(SOURCE), "-o", partial], "The guard")
        os.replace(partial, target)
    ffi = cffi.FFI()
    ffi.cdef(read_headers([header]))
    return ffi, ffi.dlopen(str(target))


class Guard:
    """Judges blocks as the MCU does. `trip`: what it found first, with the print time of that block. The blocks of a
    trip often do not reach the host any more: `bad_blocks` are those in a row at the end."""

    def __init__(self, header: dict[str, Any]) -> None:
        ffi, self._lib = _library()
        self._guard, self._block = ffi.new("struct guard *"), ffi.new("struct guard_input *")
        self._lib.guard_init(self._guard, header["adc_max"], 0xFFFFFFFF, 0xFFFFFFFF)
        for phase, low, high in header["guard"]:
            row = {"phase": phase, "low": low, "high": high, "trip_blocks": header["trip_blocks"]}
            self._lib.guard_add_row(self._guard, ffi.new("struct guard_row *", row)[0])
        self.trip, self.trip_s = "", float("nan")

    @property
    def bad_blocks(self) -> int:
        return int(self._guard.bad_blocks)

    def take(self, blocks: Blocks) -> None:
        for block in blocks:
            self._block.sum, self._block.count = round(block.mean_raw * block.count), block.count
            self._block.phase, self._block.min, self._block.max = (
                block.phase_ticks,
                block.min_raw,
                block.max_raw,
            )
            found = self._lib.guard_block(self._guard, self._block)
            if found and not self.trip:
                self.trip, self.trip_s = TRIPS[found], block.time_s


def replayed(path: Path) -> tuple[rerun.Rerun, Guard]:
    """A recorded run decided again, and the guard's word on it. Raises RunFileError, UnknownType, OSError."""
    frames = stored.read(path)
    first = next(frames, None)
    if first is None or first.kind != "H":
        raise stored.RunFileError(f"{path} has no header")
    guard = Guard(first.json())
    return rerun.rerun(itertools.chain([first], frames), guard.take), guard
