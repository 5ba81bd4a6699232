"""Builds C files that know no board into shared libraries and opens them with cffi.

A library is rebuilt when its sources, the headers beside them or the flags change (content hash), so a test
run costs a compile only after an edit. `sanitize="undefined"` stops the process at the first undefined
operation.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cffi

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

INDUCTION_SOURCES = ("filters.c", "oversample.c", "phase.c", "guard.c", "attention.c")
PLANT_SOURCES = tuple(
    str(PLANT / name) for name in ("plant.c", "plant_tank.c", "plant_noise.c", "thermal_load.c")
)

PLANT_CDEF = """
struct plant_param { const char *name, *unit, *doc; double reference, strong, min, max; };
extern struct plant_param plant_params[];
extern int plant_param_count;
struct plant;
struct plant_outputs { double skin_c, bore_c, melt_c, second_c, power_w, electrical_w, flow_mm3_s; };
struct plant_balance { double metal_j, lost_j, melt_j, stored_j; };
struct plant *plant_new(void);
void plant_free(struct plant *p);
void plant_init(struct plant *p, const double *values, uint64_t seed);
int plant_param_index(const char *name);
void plant_set_param(struct plant *p, int index, double value);
double plant_get_param(const struct plant *p, int index);
void plant_set_phase(struct plant *p, double phase_ticks);
void plant_set_inputs(struct plant *p, double flow_mm3_s, double fan);
void plant_advance(struct plant *p, double dt_s);
void plant_sample(struct plant *p, uint16_t *out, uint32_t n, double period_s);
void plant_read(const struct plant *p, struct plant_outputs *out);
void plant_energy(const struct plant *p, struct plant_balance *out);

struct thermal_load_param { const char *name, *unit, *doc; double hotend, bed, min, max; };
extern struct thermal_load_param thermal_load_params[];
extern int thermal_load_param_count;
struct thermal_load;
struct thermal_load_outputs { double body_c, sensor_c, element_c, melt_c, power_w, flow_mm3_s; };
struct thermal_load *thermal_load_new(void);
void thermal_load_free(struct thermal_load *l);
void thermal_load_init(struct thermal_load *l, const double *values, uint64_t seed);
int thermal_load_param_index(const char *name);
void thermal_load_set_param(struct thermal_load *l, int index, double value);
double thermal_load_get_param(const struct thermal_load *l, int index);
void thermal_load_set_duty(struct thermal_load *l, double duty);
void thermal_load_set_inputs(struct thermal_load *l, double flow_mm3_s, double fan);
void thermal_load_advance(struct thermal_load *l, double dt_s);
void thermal_load_sample(struct thermal_load *l, uint16_t *out, uint32_t n);
void thermal_load_read(const struct thermal_load *l, struct thermal_load_outputs *out);
"""


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


def load(name: str, sources: Sequence[str], cdef: str, sanitize: str = "undefined") -> tuple[cffi.FFI, Any]:
    """Build if needed and open: (ffi, lib)."""
    ffi = cffi.FFI()
    ffi.cdef(cdef)
    return ffi, ffi.dlopen(str(compile_library(name, sources, sanitize)))


class _Device:
    """What Plant and Load share: the parameter table and the C object's life."""

    prefix = ""
    presets: tuple[str, ...] = ()

    def __init__(self, preset: str, seed: int = 1, sanitize: str = "", **changes: float) -> None:
        self.ffi, self.lib = load("plant", PLANT_SOURCES, PLANT_CDEF, sanitize)
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
    presets = ("reference", "strong")

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
