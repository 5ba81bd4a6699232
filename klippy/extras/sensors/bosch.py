"""Sensor type BME280: Bosch's chips for the air by I2C. BMP180, BMP280, BME280, BMP388 and BME680 differ by their ids.

Single shots, twofold oversampling, compensated as the data sheets say (their versions with floating point). The gas
sensor of a BME680 is heated for one reading in GAS_EVERY, as its heat warms the chip.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from configfile import ConfigWrapper

from .. import bus
from .i2c_temperature import I2cTemperature, Pause, Reading, SensorError, build, fetch

TWOFOLD = 2  # oversampling, as the registers of BMP280, BME280 and BME680 have it
REPORT_TIME_S = 0.8


class Model(Protocol):
    """One of the chips."""

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None: ...
    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading: ...


def _signed(byte: int) -> int:
    return byte - 256 if byte > 127 else byte


@dataclass(slots=True)
class Bmp180:
    """Data sheet, figure 4; integers as there, so that its example comes out to the last digit."""

    OVERSAMPLING = 1  # 2^1

    calibration: tuple[int, ...] = ()  # AC1 ... MD

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        self.calibration = struct.unpack(">3h3H5h", fetch(i2c, [0xAA], 22))

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        i2c.i2c_write([0xF4, 0x2E])
        pause(0.005)
        raw_temp = int.from_bytes(fetch(i2c, [0xF6], 2), "big")
        i2c.i2c_write([0xF4, 0x34 | self.OVERSAMPLING << 6])
        pause(0.008)
        raw_pressure = int.from_bytes(fetch(i2c, [0xF6], 3), "big") >> 8 - self.OVERSAMPLING
        tenths, pascal = self.compensate(raw_temp, raw_pressure, self.OVERSAMPLING)
        return Reading(tenths / 10.0, None, pascal / 100.0)

    def compensate(self, raw_temp: int, raw_pressure: int, oversampling: int) -> tuple[int, int]:
        """0.1 degC and Pa."""
        ac1, ac2, ac3, ac4, ac5, ac6, b1, b2, _, mc, md = self.calibration
        x1 = (raw_temp - ac6) * ac5 >> 15
        if x1 + md == 0:
            raise SensorError("its calibration is void")
        b5 = x1 + int(mc * 2048 / (x1 + md))
        b6 = b5 - 4000
        x3 = (b2 * (b6 * b6 >> 12) >> 11) + (ac2 * b6 >> 11)
        b3 = ((ac1 * 4 + x3 << oversampling) + 2) // 4
        x3 = (ac3 * b6 >> 13) + (b1 * (b6 * b6 >> 12) >> 16) + 2 >> 2
        b4 = ac4 * (x3 + 32768) >> 15
        if not b4:
            raise SensorError("its calibration is void")
        pressure = (raw_pressure - b3) * (50000 >> oversampling) * 2 // b4
        x1 = ((pressure >> 8) ** 2 * 3038) >> 16
        return b5 + 8 >> 4, pressure + (x1 + (-7357 * pressure >> 16) + 3791 >> 4)


@dataclass(slots=True)
class Bme280:
    """BME280, BMP280: single shots, twofold oversampling; compensated as the data sheet's appendix says."""

    has_humidity: bool
    temp: tuple[int, ...] = ()  # dig_T1 ..
    pressure: tuple[int, ...] = ()  # dig_P1 ..
    humidity: tuple[int, ...] = ()  # dig_H1 ..

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        i2c.i2c_write([0xE0, 0xB6])  # reset
        pause(0.010)
        data = fetch(i2c, [0x88], 26)
        words = struct.unpack_from("<HhhH8h", data)
        self.temp, self.pressure = words[:3], words[3:]
        if not self.has_humidity:
            return
        more = fetch(i2c, [0xE1], 7)
        h2, h3, h4, h45, h5, h6 = struct.unpack("<hBbBbb", more)
        self.humidity = (data[25], h2, h3, h4 << 4 | h45 & 0x0F, h5 << 4 | h45 >> 4, h6)
        i2c.i2c_write([0xF2, TWOFOLD])

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        i2c.i2c_write([0xF4, TWOFOLD << 5 | TWOFOLD << 2 | 1])
        pause(0.025)  # 18.7 ms at most
        data = fetch(i2c, [0xF7], 8 if self.has_humidity else 6)
        raw_pressure = int.from_bytes(data[:3], "big") >> 4
        fine = self._fine(int.from_bytes(data[3:6], "big") >> 4)
        humidity = self._humidity_pct(fine, int.from_bytes(data[6:8], "big")) if self.has_humidity else None
        return Reading(fine / 5120.0, humidity, self._pressure_pa(fine, raw_pressure) / 100.0)

    def _fine(self, raw: int) -> float:
        """Temperature in 1/5120 degC."""
        t1, t2, t3 = self.temp
        linear = raw / 16384.0 - t1 / 1024.0
        square = raw / 131072.0 - t1 / 8192.0
        return linear * t2 + square * square * t3

    def _pressure_pa(self, fine: float, raw: int) -> float:
        p1, p2, p3, p4, p5, p6, p7, p8, p9 = self.pressure
        t = fine / 2.0 - 64000.0
        offset = (t * t * p6 / 32768.0 + t * p5 * 2.0) / 4.0 + p4 * 65536.0
        scale = (1.0 + (p3 * t * t / 524288.0 + p2 * t) / 524288.0 / 32768.0) * p1
        if scale == 0.0:
            return 0.0
        pressure = (1048576.0 - raw - offset / 4096.0) * 6250.0 / scale
        return pressure + (p9 * pressure * pressure / 2147483648.0 + pressure * p8 / 32768.0 + p7) / 16.0

    def _humidity_pct(self, fine: float, raw: int) -> float:
        h1, h2, h3, h4, h5, h6 = self.humidity
        t = fine - 76800.0
        shape = 1.0 + h6 / 67108864.0 * t * (1.0 + h3 / 67108864.0 * t)
        value = (raw - (h4 * 64.0 + h5 / 16384.0 * t)) * h2 / 65536.0 * shape
        value *= 1.0 - h1 * value / 524288.0
        return min(100.0, max(0.0, value))


@dataclass(slots=True)
class Bmp388:
    """Data sheet, chapters 3.11 and 9."""

    temp: tuple[float, ...] = ()  # PAR_T1 ...
    pressure: tuple[float, ...] = ()  # PAR_P1 ...

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        i2c.i2c_write([0x7E, 0xB6])  # reset
        pause(0.010)
        t1, t2, t3, p1, p2, *p = struct.unpack("<HHbhhbbHHbbhbb", fetch(i2c, [0x31], 21))
        self.temp = (t1 * 2.0**8, t2 / 2.0**30, t3 / 2.0**48)
        exponents = (32, 37, -3, 6, 8, 15, 48, 48, 65)  # of PAR_P3 to PAR_P11
        rest = (value / 2.0**exponent for value, exponent in zip(p, exponents, strict=True))
        self.pressure = ((p1 - 2**14) / 2.0**20, (p2 - 2**14) / 2.0**29, *rest)
        i2c.i2c_write([0x1C, 1 << 3 | 1])  # OSR: twofold

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        i2c.i2c_write([0x1B, 0x13])  # PWR_CTRL: both, once
        pause(0.015)  # 9.1 ms
        data = fetch(i2c, [0x04], 6)
        t1, t2, t3 = self.temp
        above = int.from_bytes(data[3:6], "little") - t1
        temp_c = above * t2 + above * above * t3
        return Reading(temp_c, None, self._pressure_pa(temp_c, int.from_bytes(data[:3], "little")) / 100.0)

    def _pressure_pa(self, t: float, raw: int) -> float:
        p1, p2, p3, p4, p5, p6, p7, p8, p9, p10, p11 = self.pressure
        offset = p5 + p6 * t + p7 * t**2 + p8 * t**3
        linear = p1 + p2 * t + p3 * t**2 + p4 * t**3
        return offset + raw * linear + raw**2 * (p9 + p10 * t) + raw**3 * p11


GAS_EVERY = 40  # readings
GAS_TEMP_C = 300.0
GAS_WAIT_S, GAS_WAIT = 0.100, 0x59  # 25 * 4 ms
# BME680 data sheet, table 16: factors of the ranges of the gas sensor's resistance
GAS_FACTORS = (1.0, 1.0, 1.0, 1.0, 1.0, 0.99, 1.0, 0.992, 1.0, 1.0, 0.998, 0.995, 1.0, 0.99, 1.0, 1.0)
GAS_RANGES = (8e6, 4e6, 2e6, 1e6, 499500.4995, 248262.1648, 125e3, 63004.03226, 31281.28128, *(
    125e3 / 2**n for n in range(3, 10)
))  # fmt: skip


@dataclass(slots=True)
class Bme680:
    """Data sheet, chapters 3.3 and 5."""

    temp: tuple[int, ...] = ()  # par_t1 ...
    pressure: tuple[int, ...] = ()
    humidity: tuple[int, ...] = ()
    gas: tuple[int, ...] = ()  # par_g1 to g3, res_heat_range, res_heat_val, range_switching_error
    count: int = 0
    last_gas_ohm: float | None = None

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        i2c.i2c_write([0xE0, 0xB6])  # reset
        pause(0.010)
        low, high = fetch(i2c, [0x89], 25), fetch(i2c, [0xE1], 16)
        p1_p5, (p7, p6) = struct.unpack_from("<Hhbxhh", low, 5), struct.unpack_from("<bb", low, 15)
        t1, g2, g1, g3 = struct.unpack_from("<Hhbb", high, 8)
        self.temp = (t1, *struct.unpack_from("<hb", low, 1))
        self.pressure = (*p1_p5, p6, p7, *struct.unpack_from("<hhB", low, 19))
        h1, h2 = high[2] << 4 | high[1] & 0x0F, high[0] << 4 | high[1] >> 4
        self.humidity = (h1, h2, *struct.unpack_from("<bbbBb", high, 3))
        heat_val, heat_range, switching = (fetch(i2c, [register], 1)[0] for register in (0x00, 0x02, 0x04))
        self.gas = (g1, g2, g3, heat_range >> 4 & 3, _signed(heat_val), _signed(switching) >> 4)
        i2c.i2c_write([0x72, TWOFOLD])

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        with_gas = self.count % GAS_EVERY == 1  # not the first: the heater needs the air's temperature
        self.count += 1
        i2c.i2c_write([0x71, with_gas << 4])
        i2c.i2c_write([0x74, TWOFOLD << 5 | TWOFOLD << 2 | 1])
        pause(0.030 + with_gas * GAS_WAIT_S)
        data = fetch(i2c, [0x1D], 15)
        if not data[0] & 0x80:
            raise SensorError("its measurement does not end")
        fine = self._fine(int.from_bytes(data[5:8], "big") >> 4)
        temp_c = fine / 5120.0
        if with_gas and data[14] & 0x30 == 0x30:  # valid, and the heater was stable
            self.last_gas_ohm = self._gas_ohm(data[13] << 2 | data[14] >> 6, data[14] & 0x0F)
        i2c.i2c_write([0x5A, self._heater(temp_c)])
        i2c.i2c_write([0x64, GAS_WAIT])
        humidity = self._humidity_pct(temp_c, int.from_bytes(data[8:10], "big"))
        pressure_pa = self._pressure_pa(fine, int.from_bytes(data[2:5], "big") >> 4)
        return Reading(temp_c, humidity, pressure_pa / 100.0, self.last_gas_ohm)

    def _fine(self, raw: int) -> float:
        """Temperature in 1/5120 degC."""
        t1, t2, t3 = self.temp
        return (raw / 16384.0 - t1 / 1024.0) * t2 + (raw / 131072.0 - t1 / 8192.0) ** 2 * t3 * 16.0

    def _pressure_pa(self, fine: float, raw: int) -> float:
        p1, p2, p3, p4, p5, p6, p7, p8, p9, p10 = self.pressure
        t = fine / 2.0 - 64000.0
        offset = (t * t * p6 / 131072.0 + t * p5 * 2.0) / 4.0 + p4 * 65536.0
        scale = (1.0 + (p3 * t * t / 16384.0 + p2 * t) / 524288.0 / 32768.0) * p1
        if scale == 0.0:
            return 0.0
        pressure = (1048576.0 - raw - offset / 4096.0) * 6250.0 / scale
        square = p9 * pressure * pressure / 2147483648.0
        cube = (pressure / 256.0) ** 3 * p10 / 131072.0
        return pressure + (square + pressure * p8 / 32768.0 + cube + p7 * 128.0) / 16.0

    def _humidity_pct(self, temp_c: float, raw: int) -> float:
        h1, h2, h3, h4, h5, h6, h7 = self.humidity
        value = raw - (h1 * 16.0 + h3 / 2.0 * temp_c)
        value *= h2 / 262144.0 * (1.0 + h4 / 16384.0 * temp_c + h5 / 1048576.0 * temp_c * temp_c)
        value += (h6 / 16384.0 + h7 / 2097152.0 * temp_c) * value * value
        return min(100.0, max(0.0, value))

    def _heater(self, ambient_c: float) -> int:
        """res_heat_0 for GAS_TEMP_C."""
        g1, g2, g3, heat_range, heat_val, _ = self.gas
        slope = (g1 / 16.0 + 49.0) * (1.0 + (g2 / 32768.0 * 0.0005 + 0.00235) * GAS_TEMP_C)
        ratio = (slope + g3 / 1024.0 * ambient_c) * (4.0 / (4.0 + heat_range)) / (1.0 + heat_val * 0.002)
        return min(255, max(0, int(3.4 * (ratio - 25.0))))

    def _gas_ohm(self, raw: int, gas_range: int) -> float:
        factor = (1340.0 + 5.0 * self.gas[5]) * GAS_FACTORS[gas_range]
        return factor * GAS_RANGES[gas_range] / (raw - 512.0 + factor)


MODELS: dict[int, Callable[[], Model]] = {
    0x55: Bmp180, 0x58: lambda: Bme280(False), 0x60: lambda: Bme280(True), 0x61: Bme680,
}  # fmt: skip
BMP388_ID = 0x50


@dataclass(slots=True)
class BoschAir:
    """Any of them."""

    kind: str = "bme280"
    fields: tuple[str, ...] = ("humidity", "pressure", "gas")
    model: Model | None = None

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        chip = fetch(i2c, [0xD0], 1)[0]
        make = MODELS.get(chip)
        if make is None and fetch(i2c, [0x00], 1)[0] == BMP388_ID:
            make = Bmp388
        if make is None:
            known = ", ".join(f"{number:#04x}" for number in MODELS)
            raise SensorError(
                f"its id is {chip:#04x}, those of the chips of this type are {known} and {BMP388_ID:#04x}"
            )
        self.model = make()
        self.model.set_up(i2c, pause)

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        assert self.model is not None
        return self.model.read(i2c, pause)


def build_bme280(config: ConfigWrapper) -> I2cTemperature:
    return build(config, BoschAir(), 0x76, REPORT_TIME_S)


def register_builtin(heaters: Any) -> None:
    """Add the type of this file."""
    heaters.add_sensor_factory("BME280", build_bme280)
