"""Builds C files that know no board into shared libraries and opens them with cffi.

A library is rebuilt when its sources, the headers beside them or the flags change (content hash), so a test
run costs a compile only after an edit. `sanitize="undefined"` stops the process at the first undefined
operation.
"""

from __future__ import annotations

import functools
import hashlib
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cffi

from chelper.compiler import read_headers

ROOT = Path(__file__).resolve().parents[2]
SRC = ROOT / "src"
PLANT = ROOT / "klippy" / "simulation" / "plant"
OUT = ROOT / "out" / "test-c"
BASE_FLAGS = ("-std=c11", "-O2", "-g", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared")
SANITIZERS = {
    "": (),
    "undefined": ("-fsanitize=undefined", "-fno-sanitize-recover=all"),
    "address": ("-fsanitize=address,undefined", "-fno-sanitize-recover=all"),
}

INDUCTION_SOURCES = ("filters.c", "oversample.c", "phase.c", "guard.c", "signal_test.c")
PLANT_SOURCES = tuple(map(str, sorted(PLANT.glob("*.c"))))
PLANT_HEADERS = (PLANT / "plant.h", PLANT / "thermal_load.h")


def compile_library(name: str, sources: Sequence[str], sanitize: str = "", flags: Sequence[str] = ()) -> Path:
    """Compile src/ files into out/test-c/NAME-HASH.so and return its path; raises with gcc's words."""
    paths = [SRC / source for source in sources]
    options = [*BASE_FLAGS, *SANITIZERS[sanitize], *flags, f"-I{SRC}", f"-I{SRC}/simulator"]
    digest = hashlib.sha256(" ".join(options).encode())
    for folder in sorted({path.parent for path in paths}):
        for header in sorted(folder.glob("*.h")):
            digest.update(header.read_bytes())
    for path in paths:
        digest.update(path.read_bytes())
    target = OUT / f"{name}-{digest.hexdigest()[:16]}.so"
    if not target.exists():
        OUT.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(suffix=".so", dir=OUT)
        os.close(handle)
        done = subprocess.run(
            ["gcc", *options, *map(str, paths), "-o", partial, "-lm"],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            os.unlink(partial)
            raise RuntimeError(f"gcc failed on {name}:\n{done.stderr}")
        os.replace(partial, target)  # several test processes may build at once
    return target


@functools.cache
def load(
    name: str, sources: Sequence[str], headers: Sequence[Path], sanitize: str = "undefined"
) -> tuple[cffi.FFI, Any]:
    """Build if needed and open: (ffi, lib) with what the headers declare."""
    ffi = cffi.FFI()
    ffi.cdef(read_headers(headers))
    return ffi, ffi.dlopen(str(compile_library(name, sources, sanitize)))


@functools.cache
def load_induction() -> tuple[cffi.FFI, Any]:
    """The pure files of the firmware's induction unit, with the sanitizer for undefined behaviour."""
    return load("induction", INDUCTION_SOURCES, tuple(SRC / f"{Path(c).stem}.h" for c in INDUCTION_SOURCES))


class _Device:
    """What Plant and Load share: the parameter table and the C object's life."""

    prefix = ""
    presets: tuple[str, ...] = ()

    def __init__(self, preset: str, seed: int = 1, sanitize: str = "", **changes: float) -> None:
        self.ffi, self.lib = load("plant", PLANT_SOURCES, PLANT_HEADERS, sanitize)
        rows = self.params()
        if unknown := set(changes) - {row.name for row in rows}:
            raise KeyError(f"no such parameter: {sorted(unknown)}")
        values = [changes.get(row.name, getattr(row, preset)) for row in rows]
        self._call = {
            verb: getattr(self.lib, f"{self.prefix}_{verb}") for verb in ("init", "set_param", "read")
        }
        self.c = self.ffi.gc(
            getattr(self.lib, f"{self.prefix}_new")(), getattr(self.lib, f"{self.prefix}_free")
        )
        self._call["init"](self.c, values, seed)

    def params(self) -> list[SimpleNamespace]:
        """The C table as Python objects, one attribute per column."""
        table = getattr(self.lib, f"{self.prefix}_params")
        texts, numbers = ("name", "unit", "doc"), (*self.presets, "min", "max")
        return [
            SimpleNamespace(
                **{column: self.ffi.string(getattr(table[i], column)).decode() for column in texts},
                **{column: getattr(table[i], column) for column in numbers},
            )
            for i in range(getattr(self.lib, f"{self.prefix}_param_count"))
        ]

    def set_param(self, name: str, value: float) -> None:
        index = getattr(self.lib, f"{self.prefix}_param_index")(name.encode())
        if index < 0:
            raise KeyError(name)
        self._call["set_param"](self.c, index, value)

    def read(self) -> Any:
        out = self.ffi.new(f"struct {self.prefix}_outputs *")
        self._call["read"](self.c, out)
        return out


class Plant(_Device):
    """The induction nozzle: temperatures in degC, seconds, phase in ticks of 0..45000."""

    prefix = "plant"
    presets = ("reference", "strong", "real")

    def __init__(self, preset: str = "reference", **kwargs: Any) -> None:
        super().__init__(preset, **kwargs)

    def phase(self, ticks: float) -> None:
        self.lib.plant_set_phase(self.c, ticks)

    def power(self, percent: float) -> None:
        """Power in percent as the tables have it: ticks = 45000 sqrt(percent / 100)."""
        self.phase(45000 * (percent / 100) ** 0.5)

    def inputs(self, flow_mm3_s: float = 0.0, fan: float = 0.0) -> None:
        self.lib.plant_set_inputs(self.c, flow_mm3_s, fan)

    def advance(self, dt_s: float) -> None:
        self.lib.plant_advance(self.c, dt_s)

    def sample(self, count: int, period_s: float = 1 / 120e3) -> Any:
        """`count` ADC codes as a numpy array of uint16."""
        import numpy as np

        out = np.zeros(count, dtype=np.uint16)
        self.lib.plant_sample(self.c, self.ffi.cast("uint16_t *", out.ctypes.data), count, period_s)
        return out

    def balance(self) -> Any:
        out = self.ffi.new("struct plant_balance *")
        self.lib.plant_energy(self.c, out)
        return out


class Load(_Device):
    """The conventional heater: preset `hotend` or `bed`."""

    prefix = "thermal_load"
    presets = ("hotend", "bed")

    def duty(self, duty: float) -> None:
        self.lib.thermal_load_set_duty(self.c, duty)

    def inputs(self, flow_mm3_s: float = 0.0, fan: float = 0.0) -> None:
        self.lib.thermal_load_set_inputs(self.c, flow_mm3_s, fan)

    def advance(self, dt_s: float) -> None:
        self.lib.thermal_load_advance(self.c, dt_s)

    def sample(self, count: int) -> Any:
        import numpy as np

        out = np.zeros(count, dtype=np.uint16)
        self.lib.thermal_load_sample(self.c, self.ffi.cast("uint16_t *", out.ctypes.data), count)
        return out
