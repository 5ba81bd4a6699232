"""Sensor types LM75, HTU21D (SI7013 SI7020 SI7021 SHT21), SHT3X, AHT10, BME280: the air in a chamber, by I2C.

Each type is a `Device`: how it is set up, how one reading is taken and what its bytes mean, from the chip's data sheet.
`I2cTemperature` is what they share: a reading every report time, limits, and the status of an object named
`KIND NAME` (`bme280 chamber`). A chip that does not answer MAX_FAILURES times in a row shuts the printer down: a fan or
heater that goes by it would be blind.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from configfile import ConfigWrapper
from roles import Printer

from .. import bus

MAX_FAILURES = 3


class SensorError(Exception):
    """A reading that cannot be used; the text is for people."""


@dataclass(frozen=True, slots=True)
class Reading:
    """degC; %; hPa. None: the chip does not measure that."""

    temp_c: float
    humidity_pct: float | None = None
    pressure_hpa: float | None = None


Pause = Callable[[float], None]  # argument: seconds


class Device(Protocol):
    """One kind of chip."""

    kind: str
    fields: tuple[str, ...]  # of the status beside the temperature

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None: ...
    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading: ...


def crc8(data: Sequence[int], start: int) -> int:
    """Of the polynomial x^8+x^5+x^4+1, high bit first (Sensirion's application note; HTU21D data sheet)."""
    crc = start
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x31 if crc & 0x80 else crc << 1) & 0xFF
    return crc


def _fetch(i2c: bus.MCU_I2C, command: Sequence[int], count: int) -> bytes:
    return bytes(i2c.i2c_read(list(command), count)["response"])


def _checked(data: bytes, crc_start: int) -> int:
    """The 16 bits of two bytes and their CRC."""
    if crc8(data[:2], crc_start) != data[2]:
        raise SensorError("its checksum is wrong")
    return data[0] << 8 | data[1]


@dataclass(slots=True)
class Lm75:
    """LM75, LM75A: 9 to 11 bits, signed, in the upper bits of register 0."""

    kind: str = "lm75"
    fields: tuple[str, ...] = ()

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        """Measures by itself."""

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        data = _fetch(i2c, [0x00], 2)
        return Reading((int.from_bytes(data, "big", signed=True) & ~0x1F) / 256.0)


# user register bits, longest conversion of temperature and humidity, s (the slowest of the family, SHT21)
HTU21D_RESOLUTIONS = {
    "TEMP14_HUM12": (0x00, 0.085, 0.029),
    "TEMP13_HUM10": (0x80, 0.043, 0.009),
    "TEMP12_HUM08": (0x01, 0.022, 0.004),
    "TEMP11_HUM11": (0x81, 0.011, 0.015),
}


@dataclass(slots=True)
class Htu21d:
    """HTU21D, SHT21, Si7013/20/21: two measurements, each by its own command."""

    resolution: str
    hold: bool  # the chip stretches the clock until it has finished
    kind: str = "htu21d"
    fields: tuple[str, ...] = ("humidity",)

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        i2c.i2c_write([0xFE])  # reset
        pause(0.015)
        register = _fetch(i2c, [0xE7], 1)[0]
        i2c.i2c_write([0xE6, register & ~0x81 & 0xFF | HTU21D_RESOLUTIONS[self.resolution][0]])

    def _measure(self, i2c: bus.MCU_I2C, pause: Pause, commands: tuple[int, int], wait_s: float) -> float:
        """Share of the full scale."""
        if self.hold:
            data = _fetch(i2c, commands[:1], 3)
        else:
            i2c.i2c_write(commands[1:])
            pause(wait_s)
            data = _fetch(i2c, [], 3)
        return (_checked(data, 0x00) & ~0x03) / 65536.0

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        _, temp_s, humidity_s = HTU21D_RESOLUTIONS[self.resolution]
        temp_c = -46.85 + 175.72 * self._measure(i2c, pause, (0xE3, 0xF3), temp_s)
        humidity = -6.0 + 125.0 * self._measure(i2c, pause, (0xE5, 0xF5), humidity_s)
        humidity -= 0.15 * (25.0 - temp_c)  # the data sheet's coefficient
        return Reading(temp_c, min(100.0, max(0.0, humidity)))


@dataclass(slots=True)
class Sht3x:
    """SHT30, SHT31, SHT35: single shots of high repeatability."""

    kind: str = "sht3x"
    fields: tuple[str, ...] = ("humidity",)

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        i2c.i2c_write([0x30, 0xA2])  # reset
        pause(0.002)

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        i2c.i2c_write([0x24, 0x00])
        pause(0.016)
        data = _fetch(i2c, [], 6)
        return Reading(
            -45.0 + 175.0 * _checked(data[:3], 0xFF) / 65535.0, 100.0 * _checked(data[3:], 0xFF) / 65535.0
        )


@dataclass(slots=True)
class Aht10:
    """AHT10, AHT20, AHT21: 20 bits each of humidity and temperature."""

    kind: str = "aht10"
    fields: tuple[str, ...] = ("humidity",)

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        for command in (0xE1, 0xBE):  # AHT10's, AHT20's way to load its calibration
            pause(0.040)
            if _fetch(i2c, [], 1)[0] & 0x08:
                return
            i2c.i2c_write([command, 0x08, 0x00])

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        i2c.i2c_write([0xAC, 0x33, 0x00])
        pause(0.080)
        data = _fetch(i2c, [], 6)
        if data[0] & 0x80:
            raise SensorError("it is still busy")
        bits = int.from_bytes(data[1:], "big")
        share = 1 << 20
        return Reading((bits & share - 1) / share * 200.0 - 50.0, (bits >> 20) / share * 100.0)


BME280_IDS = {0x58: False, 0x60: True}  # whether that chip measures humidity
BME280_TWOFOLD = 2  # oversampling, as the registers have it


def _words(data: bytes, signed: bool) -> list[int]:
    return [int.from_bytes(data[i : i + 2], "little", signed=signed) for i in range(0, len(data), 2)]


@dataclass(slots=True)
class Bme280:
    """BME280, BMP280: single shots, twofold oversampling; compensated as the data sheet's appendix says."""

    kind: str = "bme280"
    fields: tuple[str, ...] = ("humidity", "pressure")
    has_humidity: bool = False
    temp: tuple[int, ...] = ()  # dig_T1 ..
    pressure: tuple[int, ...] = ()  # dig_P1 ..
    humidity: tuple[int, ...] = ()  # dig_H1 ..

    def set_up(self, i2c: bus.MCU_I2C, pause: Pause) -> None:
        i2c.i2c_write([0xE0, 0xB6])  # reset
        pause(0.010)
        chip = _fetch(i2c, [0xD0], 1)[0]
        if chip not in BME280_IDS:
            raise SensorError(f"its id is {chip:#04x}, that of a BME280 is 0x60, of a BMP280 0x58")
        self.has_humidity = BME280_IDS[chip]
        data = _fetch(i2c, [0x88], 26)
        unsigned, signed = _words(data[:24], False), _words(data[:24], True)
        self.temp = (unsigned[0], *signed[1:3])
        self.pressure = (unsigned[3], *signed[4:12])
        if not self.has_humidity:
            return
        more = _fetch(i2c, [0xE1], 7)
        signed_12 = (
            int.from_bytes(more[3:4], "big", signed=True) << 4 | more[4] & 0x0F,
            int.from_bytes(more[5:6], "big", signed=True) << 4 | more[4] >> 4,
        )
        h6 = int.from_bytes(more[6:7], "big", signed=True)
        self.humidity = (data[25], _words(more[:2], True)[0], more[2], *signed_12, h6)
        i2c.i2c_write([0xF2, BME280_TWOFOLD])

    def read(self, i2c: bus.MCU_I2C, pause: Pause) -> Reading:
        i2c.i2c_write([0xF4, BME280_TWOFOLD << 5 | BME280_TWOFOLD << 2 | 1])
        pause(0.025)  # 18.7 ms at most
        data = _fetch(i2c, [0xF7], 8 if self.has_humidity else 6)
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


class I2cTemperature:
    """The object `KIND NAME` of one sensor."""

    def __init__(
        self, printer: Printer, name: str, device: Device, i2c: bus.MCU_I2C, report_time_s: float
    ) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self.name = name
        self.device = device
        self.i2c = i2c
        self.reading = Reading(0.0)
        self._report_time_s = report_time_s
        self._range_c = (float("-inf"), float("inf"))
        self._callback: Callable[[float, float], None] | None = None
        self._is_set_up = False
        self._failures = 0

    def register(self) -> None:
        """Begin once connected."""
        self.printer.add_object(f"{self.device.kind} {self.name}", self)
        self.printer.register_event_handler("klippy:connect", self._handle_connect)

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        self._range_c = (min_temp, max_temp)

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return self._report_time_s

    def _handle_connect(self) -> None:
        if self.printer.get_start_args().get("debugoutput") is None:  # nothing is measured in batch mode
            self.reactor.register_timer(self._sample, self.reactor.NOW)

    def _pause(self, seconds: float) -> None:
        self.reactor.pause(self.reactor.monotonic() + seconds)

    def _sample(self, eventtime: float) -> float:
        if self.printer.is_shutdown():
            return float(self.reactor.NEVER)
        try:
            if not self._is_set_up:
                self.device.set_up(self.i2c, self._pause)
                self._is_set_up = True
            self.reading = self.device.read(self.i2c, self._pause)
        except (SensorError, self.printer.command_error) as e:
            return self._note_failure(str(e))
        self._failures = 0
        temp_c = self.reading.temp_c
        if not self._range_c[0] <= temp_c <= self._range_c[1]:
            self._shut_down(f"{temp_c:.1f} C is outside of {self._range_c[0]:.1f} to {self._range_c[1]:.1f}")
        elif self._callback is not None:
            now_s = self.i2c.get_mcu().estimated_print_time(self.reactor.monotonic())
            self._callback(now_s, temp_c)
        return float(self.reactor.monotonic() + self._report_time_s)

    def _note_failure(self, reason: str) -> float:
        """Try again soon, from the start; when that does not help either, give up."""
        self._failures += 1
        self._is_set_up = False
        logging.warning("%s '%s': %s", self.device.kind, self.name, reason)
        if self._failures >= MAX_FAILURES:
            self._shut_down(reason)
        return float(self.reactor.monotonic() + min(1.0, self._report_time_s))

    def _shut_down(self, reason: str) -> None:
        self.printer.invoke_shutdown(f"Sensor '{self.name}' ({self.device.kind.upper()}): {reason}")

    def get_status(self, eventtime: float) -> dict[str, float | None]:
        """What this kind of chip measures, as of the last reading; null what there is none of."""
        reading = self.reading
        status: dict[str, float | None] = {"temperature": round(reading.temp_c, 2)}
        for field, value, digits in (
            ("humidity", reading.humidity_pct, 1),
            ("pressure", reading.pressure_hpa, 2),
        ):
            if field in self.device.fields:
                status[field] = None if value is None else round(value, digits)
        return status


def _build(config: ConfigWrapper, device: Device, address: int, report_time_s: float) -> I2cTemperature:
    i2c = bus.MCU_I2C_from_config(config, address)
    sensor = I2cTemperature(config.get_printer(), config.get_name().split()[-1], device, i2c, report_time_s)
    sensor.register()
    return sensor


def build_lm75(config: ConfigWrapper) -> I2cTemperature:
    return _build(config, Lm75(), 0x48, config.getfloat("lm75_report_time", 0.8, minval=0.5))


def build_htu21d(config: ConfigWrapper) -> I2cTemperature:
    names = {name: name for name in HTU21D_RESOLUTIONS}
    device = Htu21d(
        config.getchoice("htu21d_resolution", names, default="TEMP11_HUM11"),
        config.getboolean("htu21d_hold_master", False),
    )
    return _build(config, device, 0x40, config.getfloat("htu21d_report_time", 30.0, minval=1.0))


def build_sht3x(config: ConfigWrapper) -> I2cTemperature:
    return _build(config, Sht3x(), 0x44, config.getfloat("sht3x_report_time", 1.0, minval=0.5))


def build_aht10(config: ConfigWrapper) -> I2cTemperature:
    return _build(config, Aht10(), 0x38, config.getfloat("aht10_report_time", 30.0, minval=5.0))


def build_bme280(config: ConfigWrapper) -> I2cTemperature:
    return _build(config, Bme280(), 0x76, 0.8)


TYPES: dict[str, Callable[[Any], I2cTemperature]] = {
    "LM75": build_lm75,
    **dict.fromkeys(("HTU21D", "SI7013", "SI7020", "SI7021", "SHT21"), build_htu21d),
    "SHT3X": build_sht3x,
    "AHT10": build_aht10,
    "BME280": build_bme280,
}


def register_builtin(heaters: Any) -> None:
    """Register the types of this file."""
    for name, build in TYPES.items():
        heaters.add_sensor_factory(name, build)
