"""The simulated world (klippy/simulation/world/world_api.h) for Python: loading, a thin typed shell.

Units as in world_api.h: seconds, mm, °C. Nothing here decides anything.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cffi

from ..builds import OUT, SIMULATOR, Build, WorldError, make

BUILD_DIR = OUT / "simulator"
WORLD_LIBRARY = BUILD_DIR / "libferrite_world.so"
MCU_LIBRARY = SIMULATOR.library
MCU_DICTIONARY = SIMULATOR.dictionary
API_HEADER = Path(__file__).with_name("world_api.h")


@dataclass(frozen=True, slots=True)
class Parameter:
    """One row of the plant's or the load's parameter table. `presets`: value per preset name."""

    name: str
    unit: str
    doc: str
    presets: dict[str, float]
    min: float
    max: float


@dataclass(frozen=True, slots=True)
class Pin:
    """A pin of one MCU of the world; mcu -1: not connected."""

    mcu: int = -1
    number: int = 0
    inverted: bool = False


def build() -> None:
    """Bring the simulated firmware and the world library up to date. Raises WorldError."""
    make((MCU_LIBRARY, WORLD_LIBRARY), "The simulator")


@lru_cache(maxsize=1)
def get_world_ffi() -> tuple[Any, Any]:
    """(ffi, lib) of libferrite_world.so, which must have been built."""
    ffi = cffi.FFI()
    ffi.cdef("\n".join(line for line in API_HEADER.read_text().splitlines() if not line.startswith("#")))
    return ffi, ffi.dlopen(str(WORLD_LIBRARY))


# As enum accel_kind and enum world_accelerometer_fault count them.
_GAUGES = ("hx711", "hx717", "ads1220", "ads131m02", "ads131m04", "ldc1612")
_ACCELEROMETERS = ("adxl345", "lis2dw", "lis3dh", "mpu9250", "icm20948", "bmi160")
_ACCELEROMETER_FAULTS = ("none", "unplugged", "frozen", "saturated")
_PRESETS = {"nozzle": ("reference", "strong", "real"), "load": ("hotend", "bed")}
_LIGHT_MASS_G = 0.46  # preset `light`: `strong` with half the steel


@lru_cache(maxsize=1)
def parameter_tables() -> dict[str, dict[str, Parameter]]:
    """The C parameter tables: "nozzle" and "load", each name → row, in table order."""
    ffi, lib = get_world_ffi()
    text = [ffi.new("const char **") for _ in range(3)]
    values = ffi.new("double[5]")
    tables: dict[str, dict[str, Parameter]] = {}
    for number, (table, presets) in enumerate(_PRESETS.items()):
        rows: dict[str, Parameter] = {}
        while lib.world_parameter(number, len(rows), *text, values):
            name, unit, doc = (ffi.string(t[0]).decode() for t in text)
            of_presets = dict(zip(presets, values[2:5], strict=False))
            if "strong" in of_presets:
                of_presets["light"] = _LIGHT_MASS_G if name == "mass_g" else of_presets["strong"]
            rows[name] = Parameter(name, unit, doc, of_presets, min=values[0], max=values[1])
        tables[table] = rows
    return tables


def parameter_values(table: str, preset: str, changes: dict[str, float]) -> list[float]:
    """A table's values in its order: the preset's, with changes. Raises WorldError at an unknown name."""
    rows = parameter_tables()[table]
    for name in changes:
        if name not in rows:
            raise WorldError(f"The simulated {table} has no parameter '{name}'.")
    return [changes.get(name, row.presets[preset]) for name, row in rows.items()]


class World:
    """One simulated world. `start_s`: its first `now`, not 0 as on a real host; `seed` fixes chance."""

    def __init__(self, seed: int = 1, start_s: float = 100.0) -> None:
        self.ffi, self.lib = get_world_ffi()
        pointer = self.lib.world_new(start_s, seed & 0xFFFFFFFFFFFFFFFF)
        if pointer == self.ffi.NULL:
            raise MemoryError("no memory for the simulated world")
        self.pointer = self.ffi.gc(pointer, self.lib.world_free)
        self.start_s = start_s

    @property
    def now(self) -> float:
        """World time, s."""
        return float(self.lib.world_now(self.pointer))

    def close(self) -> None:
        """Free everything now rather than at garbage collection; the world must not be used afterwards."""
        if self.pointer is not None:
            self.ffi.release(self.pointer)
            self.pointer = None

    def _index(self, result: int) -> int:
        if result < 0:
            raise WorldError(
                "Simulated machine: " + self.ffi.string(self.lib.world_error(self.pointer)).decode()
            )
        return result

    # --- building ---
    def add_mcu(
        self,
        clock_ppm: float = 0.0,
        baud: float = 250000.0,
        latency_s: float = 0.0005,
        jitter_s: float = 0.0,
        corrupt: float = 0.0,
        drop: float = 0.0,
        duplicate: float = 0.0,
        library: Path | None = None,
        build: Build = SIMULATOR,
    ) -> int:
        """One more MCU: its own copy of the firmware, so that it has its own variables. Returns its index.

        `library` in place of the build's; the line of an emulated chip has the chip's own baud rate.
        """
        library = library or build.library
        baud = 0.0 if build.emulated else baud
        link = self.ffi.new(
            "struct world_link_options *", (baud, latency_s, jitter_s, corrupt, drop, duplicate)
        )
        handle, copy = tempfile.mkstemp(prefix="ferrite-mcu-", suffix=".so")
        os.close(handle)
        try:
            shutil.copyfile(library, copy)
            index = self._index(
                self.lib.world_add_mcu(self.pointer, copy.encode(), build.clock_hz, clock_ppm, link)
            )
            if build.image is not None:
                self._index(self.lib.world_load_image(self.pointer, index, os.fspath(build.image).encode()))
            return index
        except FileNotFoundError:
            raise WorldError(
                f"The simulated firmware {library} is not there; `make sim` builds it."
            ) from None
        finally:
            os.unlink(copy)  # once loaded it needs no name

    def set_chip_temperature(self, mcu: int, temp_c: float) -> None:
        """What the sensor inside the chip of an MCU feels from now on."""
        self._index(self.lib.world_set_chip_temperature(self.pointer, mcu, temp_c))

    def pin(self, pin: Pin) -> Any:
        """The C form of a pin."""
        return self.ffi.new("struct world_pin *", (pin.mcu, pin.number, int(pin.inverted)))[0]

    def add_axis(
        self,
        role: str,
        step: Pin,
        dir_pin: Pin,
        mm_per_step: float,
        start_mm: float = 0.0,
        limits_mm: tuple[float, float] | None = None,
        endstop: Pin | None = None,
        endstop_mm: float = 0.0,
        endstop_at_max: bool = False,
        both_edges: bool = False,
    ) -> int:
        """`role`: X, Y, Z, E or OTHER (its column in the trace). Returns its index."""
        options = self.ffi.new("struct world_axis_options *")
        options.role = getattr(self.lib, f"WORLD_AXIS_{role}")
        options.step, options.dir = self.pin(step), self.pin(dir_pin)
        options.endstop = self.pin(endstop or Pin())
        options.endstop_mm, options.endstop_at_max = endstop_mm, int(endstop_at_max)
        options.both_edges, options.mm_per_step, options.start_mm = int(both_edges), mm_per_step, start_mm
        options.limited = int(limits_mm is not None)
        options.min_mm, options.max_mm = limits_mm or (start_mm, start_mm)
        return self._index(self.lib.world_add_axis(self.pointer, options))

    def couple_axes(self, axis: int, partner: int, own_share: float, partner_share: float) -> None:
        """The carriage of `axis` goes by shares of its motor's way and that of the motor of `partner`."""
        self._index(self.lib.world_couple_axes(self.pointer, axis, partner, own_share, partner_share))

    def add_probe(
        self,
        pin: Pin,
        axes: tuple[int, int],
        motors: Sequence[tuple[int, tuple[float, float, float]]],
        offset_mm: tuple[float, float, float],
        bed: Mapping[str, float],
        noise_mm: float = 0.0,
        control: Pin | None = None,
        stuck: bool = False,
    ) -> int:
        """`axes`: of x and y; `motors`: Z axis and its shares; `bed`: fields of struct world_bed. Returns its index."""
        options = self.ffi.new("struct world_probe_options *")
        options.pin, options.control = self.pin(pin), self.pin(control or Pin())
        options.x_axis, options.y_axis = axes
        options.z_count, options.stuck, options.noise_mm = len(motors), int(stuck), noise_mm
        for number, (axis, shares) in enumerate(motors):
            options.z_axes[number] = axis
            options.z_shares[number] = shares
        options.x_offset_mm, options.y_offset_mm, options.trigger_mm = offset_mm
        for name, value in bed.items():
            setattr(options.bed, name, value)
        return self._index(self.lib.world_add_probe(self.pointer, options))

    def add_gauge(self, kind: str, probe: int, pins: Mapping[str, Pin], values: Mapping[str, float]) -> int:
        """`kind`: name of the chip; `pins` and `values`: fields of struct world_gauge_options. Returns its index."""
        options = self.ffi.new("struct world_gauge_options *", {"probe": probe, **values})
        options.kind = _GAUGES.index(kind)
        for name in ("ready", "clock", "select", "temperature"):
            setattr(options, name, self.pin(pins.get(name, Pin())))
        return self._index(self.lib.world_add_gauge(self.pointer, options))

    def coil_temperature(self, gauge: int) -> float:
        """Of a gauge's coil, degC."""
        return float(self.lib.world_coil_temperature(self.pointer, gauge))

    def add_frame(
        self, frequency_hz: tuple[float, float], damping_ratio: tuple[float, float], motor_hz: float
    ) -> None:
        """Ringing of the axes X and Y, which must be there."""
        options = self.ffi.new("struct world_frame *", (frequency_hz, damping_ratio, motor_hz))
        self._index(self.lib.world_add_frame(self.pointer, options))

    def add_mount(self, nozzle: int, axis: int, values: Mapping[str, float]) -> None:
        """The mount of the nozzle's extruder; `values`: the other fields of struct world_mount."""
        options = self.ffi.new("struct world_mount *", {"nozzle": nozzle, "axis": axis, **values})
        self._index(self.lib.world_add_mount(self.pointer, options))

    def frame_place(self, axis: int) -> float:
        """Place (mm) of the mass on axis 0 (X) or 1 (Y)."""
        return float(self.lib.world_frame_place(self.pointer, axis))

    def add_accelerometer(
        self,
        kind: str,
        orientation: tuple[int, int, int],
        select: Pin | None,
        i2c: tuple[int, int],
        noise_ug: float,
        rate_error: float,
        fault: str,
    ) -> int:
        """`kind`: name of the chip; `i2c`: MCU and address. Returns its index."""
        options = self.ffi.new("struct world_accelerometer_options *")
        options.kind, options.fault = _ACCELEROMETERS.index(kind), _ACCELEROMETER_FAULTS.index(fault)
        options.orientation, options.select = orientation, self.pin(select or Pin())
        options.i2c_mcu, options.i2c_address = i2c
        options.noise_ug, options.rate_error = noise_ug, rate_error
        return self._index(self.lib.world_add_accelerometer(self.pointer, options))

    def set_accelerometer_fault(self, accelerometer: int, fault: str) -> None:
        """From now on: none, unplugged, frozen or saturated."""
        number = _ACCELEROMETER_FAULTS.index(fault)
        self._index(self.lib.world_set_accelerometer_fault(self.pointer, accelerometer, number))

    def add_panel(
        self, bus: str, pins: Mapping[str, Pin], data: Sequence[Pin] = (), i2c: tuple[int, int] = (-1, 0)
    ) -> int:
        """`bus`: SERIAL, PARALLEL or I2C; `pins`: fields of struct world_panel_options. Returns its index."""
        options = self.ffi.new("struct world_panel_options *")
        options.bus = getattr(self.lib, f"WORLD_PANEL_{bus}")
        for name in ("select", "clock", "is_data", "reset"):
            setattr(options, name, self.pin(pins.get(name, Pin())))
        for line in range(self.lib.WORLD_PANEL_LINES):
            options.data[line] = self.pin(data[line] if line < len(data) else Pin())
        options.i2c_mcu, options.i2c_address = i2c
        return self._index(self.lib.world_add_panel(self.pointer, options))

    def read_panel(self, panel: int) -> list[int]:
        """Events of a display since the last call. Raises WorldError if some were lost."""
        events: list[int] = []
        buffer = self.ffi.new("uint16_t[4096]")
        while count := self._index(self.lib.world_read_panel(self.pointer, panel, buffer, 4096)):
            events += self.ffi.unpack(buffer, count)
        return events

    def set_input(self, pin: Pin, level: int) -> None:
        """The level of a line that nothing else drives."""
        self._index(self.lib.world_set_input(self.pointer, self.pin(pin), level))

    def bed_height(self, probe: int, x: float, y: float) -> float:
        """Height (mm) of the bed of probe number `probe`."""
        return float(self.lib.world_bed_height(self.pointer, probe, x, y))

    def add_fan(self, pin: Pin, spin_up_s: float) -> int:
        """Returns its index."""
        return self._index(self.lib.world_add_fan(self.pointer, self.pin(pin), spin_up_s))

    def _feed(self, axis: int, filament_area_mm2: float) -> Any:
        return self.ffi.new("struct world_feed *", (axis, filament_area_mm2))[0]

    def add_nozzle(
        self, mcu: int, values: list[float], axis: int = -1, filament_area_mm2: float = 2.405, fan: int = -1
    ) -> int:
        """An induction nozzle on the MCU's bridge. `values`: see `parameter_values`. Returns its index."""
        feed = self._feed(axis, filament_area_mm2)
        return self._index(self.lib.world_add_nozzle(self.pointer, mcu, values, feed, fan))

    def add_load(
        self,
        values: list[float],
        is_bed: bool,
        heater: Pin,
        sensor: Pin,
        axis: int = -1,
        filament_area_mm2: float = 2.405,
        fan: int = -1,
    ) -> int:
        """A bed or a conventional hotend. Returns its index."""
        feed = self._feed(axis, filament_area_mm2)
        pins = self.pin(heater), self.pin(sensor)
        return self._index(self.lib.world_add_load(self.pointer, values, int(is_bed), *pins, feed, fan))

    def add_reference(
        self, nozzle: int, pin: Pin, gain: float, tau_s: float, volt_per_k: float, adc_volt: float
    ) -> int:
        """A thermocouple on a nozzle's skin. Returns its index."""
        options = self.ffi.new(
            "struct world_reference_options *", (nozzle, gain, tau_s, volt_per_k, adc_volt, 0.5)
        )
        return self._index(self.lib.world_add_reference(self.pointer, options, self.pin(pin)))

    def add_supply_sensor(self, nozzle: int, pin: Pin, full_scale_v: float) -> None:
        """The voltage of a nozzle's bridge at a pin, by a divider."""
        self._index(self.lib.world_add_supply_sensor(self.pointer, nozzle, self.pin(pin), full_scale_v))

    def add_supply_switch(self, nozzle: int, enable: Pin, delay_s: float, watchdog_s: float) -> None:
        """A switch in the supply of a nozzle's bridge."""
        options = self.ffi.new(
            "struct world_supply_switch_options *", (self.pin(enable), delay_s, watchdog_s)
        )
        self._index(self.lib.world_add_supply_switch(self.pointer, nozzle, options))

    def add_profile(self, nozzle: int, name: str, points: Sequence[tuple[float, float]]) -> None:
        """A parameter of a nozzle over time: (s since the start, value), straight lines between."""
        number = list(parameter_tables()["nozzle"]).index(name)
        times, values = zip(*points, strict=True)
        self._index(self.lib.world_add_profile(self.pointer, nozzle, number, times, values, len(points)))

    # --- running ---
    def advance(self, until_s: float) -> int:
        """Let time pass; returns a bit per MCU whose host queue holds messages. Raises WorldError, see `check`."""
        waiting = int(self.lib.world_advance(self.pointer, until_s))
        self.check()
        return waiting

    def check(self) -> None:
        """Raises WorldError if the model of an emulated chip has objected to what its firmware did."""
        if self.lib.world_failed(self.pointer):
            raise WorldError(self.ffi.string(self.lib.world_error(self.pointer)).decode())

    def feed_bytes(self, mcu: int, data: bytes) -> None:
        """Bytes from an outside host, for an MCU without attached queue."""
        self.lib.world_feed(self.pointer, mcu, data, len(data))

    def drain_bytes(self, mcu: int) -> bytes:
        """Bytes that have arrived at the outside host."""
        buffer = self.ffi.new("uint8_t[4096]")
        length = self.lib.world_drain(self.pointer, mcu, buffer, 4096)
        return bytes(self.ffi.buffer(buffer, length))

    def set_parameter(self, table: str, index: int, name: str, value: float) -> None:
        """Change a parameter of nozzle or load number `index` while the machine runs."""
        number = list(parameter_tables()[table]).index(name)
        change = (
            self.lib.world_set_nozzle_parameter if table == "nozzle" else self.lib.world_set_load_parameter
        )
        change(self.pointer, index, number, value)

    def parameter(self, nozzle: int, name: str) -> float:
        """A parameter of a nozzle as it is now."""
        number = list(parameter_tables()["nozzle"]).index(name)
        return float(self.lib.world_nozzle_parameter(self.pointer, nozzle, number))

    def stop_adc(self, mcu: int) -> None:
        """No more samples in step with the bridge. Raises WorldError for an emulated chip."""
        self._index(self.lib.world_stop_adc(self.pointer, mcu))

    def watch(self, nozzle: int) -> int:
        """Look at a nozzle from now on; returns the number for `watched`."""
        return self._index(self.lib.world_watch(self.pointer, nozzle))

    def watched(self, watch: int) -> dict[str, Any]:
        """struct world_watch_state"""
        return self._record("world_watch_state", self.lib.world_watched, watch)

    # --- recording ---
    def open_trace(self, path: Path | None, rate_hz: float) -> None:
        """Record from now on; without a path only figures are kept."""
        name = self.ffi.NULL if path is None else os.fspath(path).encode()
        self._index(self.lib.world_trace_open(self.pointer, name, rate_hz))

    def close_trace(self) -> None:
        """Finish the file. Raises WorldError if it could not be written."""
        self._index(self.lib.world_trace_close(self.pointer))

    def _record(self, kind: str, fill: Any, *index: int) -> dict[str, Any]:
        record = self.ffi.new(f"struct {kind} *")
        fill(self.pointer, *index, record)
        return {name: getattr(record, name) for name, _ in self.ffi.typeof(f"struct {kind}").fields}

    def nozzle(self, index: int) -> dict[str, Any]:
        """struct world_nozzle_state"""
        return self._record("world_nozzle_state", self.lib.world_nozzle, index)

    def axis(self, index: int) -> dict[str, Any]:
        """struct world_axis_state"""
        return self._record("world_axis_state", self.lib.world_axis, index)

    def link(self, mcu: int) -> dict[str, Any]:
        """struct world_link_state"""
        return self._record("world_link_state", self.lib.world_link, mcu)

    def figures(self) -> dict[str, Any]:
        """struct world_figures"""
        return self._record("world_figures", self.lib.world_figures)

    def epochs(self) -> list[dict[str, Any]]:
        """struct world_target_epoch of each target so far, in order."""
        record = self.ffi.new("struct world_target_epoch *")
        names = [name for name, _ in self.ffi.typeof("struct world_target_epoch").fields]
        found: list[dict[str, Any]] = []
        while self.lib.world_epoch(self.pointer, len(found), record):
            found.append({name: getattr(record, name) for name in names})
        return found
