"""Sensor types MAX31855, MAX31856, MAX31865 and MAX6675: thermocouple and RTD converters on SPI.

    option sensor_pin = chip select; spi_speed (4000000) and the other SPI options of bus.py
    MAX31856   tc_type B E J K N R S T (K), tc_use_50Hz_filter, tc_averaging_count 1 2 4 8 16 (1)
    MAX31865   rtd_nominal_r (100), rtd_reference_r (430), rtd_num_of_wires 2 3 4 (2), rtd_use_50Hz_filter

The MCU reads the chip every REPORT_TIME_S and watches the range by itself (src/thermocouple.c); the host turns the raw
value into degC. Each chip is a `Chip`: registers to write at start, conversion both ways, and the names of its faults.
All from the chips' data sheets (Maxim 19-5793, 19-7534, 19-6478, 19-2235).
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

from . import bus

REPORT_TIME_S = 0.300
MAX_INVALID_COUNT = 3  # readings in a row out of range or with a fault before the MCU shuts down

Faults = tuple[tuple[int, str], ...]  # bit mask, text


@dataclass(frozen=True, slots=True)
class Chip:
    """One kind of converter with its settings."""

    type_name: str
    spi_mode: int
    registers: tuple[tuple[int, ...], ...]  # messages that set it up
    to_temp_c: Callable[[int], float]
    to_value: Callable[[float], int]  # of a temperature; 0 where the chip's range begins
    faults: Faults


def signed(value: int, bits: int) -> int:
    """A number in two's complement."""
    return value - (1 << bits) if value >> (bits - 1) & 1 else value


# MAX31855: bits 31..18 the thermocouple in 0.25 degC, signed
_MAX31855_FAULTS = (
    (0x01, "thermocouple open circuit"),
    (0x02, "thermocouple shorted to ground"),
    (0x04, "thermocouple shorted to the supply"),
)


def max31855(config: ConfigWrapper) -> Chip:
    return Chip(
        "MAX31855",
        0,
        (),
        lambda value: signed(value >> 18, 14) * 0.25,
        lambda temp_c: max(0, min(0x1FFF, int(temp_c / 0.25 + 0.5))) << 18,
        _MAX31855_FAULTS,
    )


# MAX6675: bits 14..3 in 0.25 degC, bit 2 set when the thermocouple is open
def max6675(config: ConfigWrapper) -> Chip:
    return Chip(
        "MAX6675",
        0,
        (),
        lambda value: (value >> 3 & 0xFFF) * 0.25,
        lambda temp_c: max(0, min(0xFFF, int(temp_c / 0.25 + 0.5))) << 3,
        ((0x04, "thermocouple open circuit"),),
    )


# MAX31856: 24 bits, the upper 19 in 1/128 degC, signed
_MAX31856_TYPES = {"B": 0, "E": 1, "J": 2, "K": 3, "N": 4, "R": 5, "S": 6, "T": 7}
_MAX31856_AVERAGING = {1: 0, 2: 1, 4: 2, 8: 3, 16: 4}
_MAX31856_CR0_AUTO, _MAX31856_CR0_OPEN_TEST, _MAX31856_CR0_50HZ = 0x80, 0x10, 0x01
_MAX31856_WRITE = 0x80
_MAX31856_FAULTS = (
    (0x80, "cold junction out of range"),
    (0x40, "thermocouple out of range"),
    (0x20, "cold junction too hot"),
    (0x10, "cold junction too cold"),
    (0x08, "temperature too high"),
    (0x04, "temperature too low"),
    (0x02, "input over or under voltage"),
    (0x01, "thermocouple open circuit"),
)


def max31856(config: ConfigWrapper) -> Chip:
    tc_type = config.getchoice("tc_type", _MAX31856_TYPES, default=_MAX31856_TYPES["K"])
    use_50hz = config.getboolean("tc_use_50Hz_filter", False)
    averaging = config.getchoice("tc_averaging_count", _MAX31856_AVERAGING, default=0)
    cr0 = _MAX31856_CR0_AUTO | _MAX31856_CR0_OPEN_TEST | (_MAX31856_CR0_50HZ if use_50hz else 0)
    cr1 = averaging << 4 | tc_type
    mask = 0x00  # every fault is reported
    return Chip(
        "MAX31856",
        1,
        ((_MAX31856_WRITE | 0x00, cr0, cr1, mask),),
        lambda value: signed(value >> 5, 19) / 128.0,
        lambda temp_c: max(0, min(0x3FFFF, int(temp_c * 128.0 + 0.5))) << 5,
        _MAX31856_FAULTS,
    )


# MAX31865: 15 bits of R / R_reference, bit 0 = fault
_MAX31865_BIAS, _MAX31865_AUTO, _MAX31865_3WIRE = 0x80, 0x40, 0x10
_MAX31865_CLEAR, _MAX31865_50HZ = 0x02, 0x01
_MAX31865_WRITE_CONFIG = 0x80
_MAX31865_FAULTS = (
    (0x80, "RTD resistance too high (open?)"),
    (0x40, "RTD resistance too low (shorted?)"),
    (0x20, "REFIN- above 0.85 of the bias (broken line?)"),
    (0x10, "REFIN- below 0.85 of the bias (open FORCE-)"),
    (0x08, "RTDIN- below 0.85 of the bias (open FORCE-)"),
    (0x04, "input over or under voltage"),
)
_CVD_A, _CVD_B = 3.9083e-3, -5.775e-7  # IEC 60751


@dataclass(frozen=True, slots=True)
class Rtd:
    """A platinum resistor against the chip's reference resistor."""

    nominal_ohm: float
    reference_ohm: float

    def temp_c(self, value: int) -> float:
        """Callendar-Van Dusen, solved for the temperature.

        Below 0 degC the standard's cubic term is left out: an error of 0.03 degC at -50 degC.
        """
        ratio = (value >> 1) / 32768.0 * self.reference_ohm / self.nominal_ohm
        inside = _CVD_A * _CVD_A - 4.0 * _CVD_B * (1.0 - ratio)
        return (-_CVD_A + math.sqrt(max(0.0, inside))) / (2.0 * _CVD_B)

    def value(self, temp_c: float) -> int:
        ratio = 1.0 + _CVD_A * temp_c + _CVD_B * temp_c * temp_c
        code = int(ratio * self.nominal_ohm / self.reference_ohm * 32768.0 + 0.5)
        return max(0, min(0x7FFF, code)) << 1


def max31865(config: ConfigWrapper) -> Chip:
    rtd = Rtd(
        config.getfloat("rtd_nominal_r", 100.0, above=0.0),
        config.getfloat("rtd_reference_r", 430.0, above=0.0),
    )
    wires = config.getchoice("rtd_num_of_wires", (2, 3, 4), default=2)
    settings = _MAX31865_BIAS | _MAX31865_AUTO | _MAX31865_CLEAR
    settings |= _MAX31865_3WIRE if wires == 3 else 0
    settings |= _MAX31865_50HZ if config.getboolean("rtd_use_50Hz_filter", False) else 0
    return Chip(
        "MAX31865",
        1,
        ((_MAX31865_WRITE_CONFIG, settings),),
        rtd.temp_c,
        rtd.value,
        _MAX31865_FAULTS,
    )


class SpiSensor:
    """One converter."""

    def __init__(self, printer: Printer, name: str, chip: Chip, spi: bus.MCU_SPI) -> None:
        self.printer = printer
        self.name = name
        self.chip = chip
        self.spi = spi
        self.mcu = mcu = spi.get_mcu()
        self.oid = mcu.create_oid()
        self._range = (0, 0)
        self._callback: Callable[[float, float], None] | None = None
        self._report_ticks = 0
        self._reported_fault = 0
        for message in chip.registers:
            spi.spi_send(message)
        mcu.register_response(self._on_result, "thermocouple_result", self.oid)
        mcu.register_config_callback(self._build_config)

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        """Range for the MCU's check."""
        low, high = self.chip.to_value(min_temp), self.chip.to_value(max_temp)
        self._range = (low, high)

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return REPORT_TIME_S

    def _build_config(self) -> None:
        mcu, oid = self.mcu, self.oid
        mcu.add_config_cmd(
            f"config_thermocouple oid={oid} spi_oid={self.spi.get_oid()} thermocouple_type={self.chip.type_name}"
        )
        self._report_ticks = mcu.seconds_to_clock(REPORT_TIME_S)
        low, high = self._range
        mcu.add_config_cmd(
            f"query_thermocouple oid={oid} clock={mcu.get_query_slot(oid)} rest_ticks={self._report_ticks}"
            f" min_value={low} max_value={high} max_invalid_count={MAX_INVALID_COUNT}",
            is_init=True,
        )

    def _on_result(self, params: dict[str, Any]) -> None:
        fault = params["fault"]
        if fault:
            self._report(fault)
            return
        self._reported_fault = 0
        clock = self.mcu.clock32_to_clock64(params["next_clock"]) - self._report_ticks
        if self._callback is not None:
            self._callback(self.mcu.clock_to_print_time(clock), self.chip.to_temp_c(params["value"]))

    def _report(self, fault: int) -> None:
        """Once a change: the MCU shuts down by itself if it stays."""
        if fault == self._reported_fault:
            return
        self._reported_fault = fault
        names = [text for mask, text in self.chip.faults if fault & mask]
        text = f"{self.chip.type_name} in section '{self.name}': {', '.join(names) or f'fault {fault:#04x}'}"
        logging.warning("%s", text)
        gcode = self.printer.lookup_object("gcode")
        self.printer.get_reactor().register_async_callback(
            lambda eventtime: gcode.respond_info(text, log=False)
        )


CHIPS: dict[str, Callable[[Any], Chip]] = {
    "MAX31855": max31855,
    "MAX31856": max31856,
    "MAX31865": max31865,
    "MAX6675": max6675,
}


def build_sensor(config: ConfigWrapper, read_chip: Callable[[Any], Chip]) -> SpiSensor:
    """Sensor of a section with one of these types."""
    chip = read_chip(config)
    spi = bus.MCU_SPI_from_config(config, chip.spi_mode, pin_option="sensor_pin", default_speed=4000000)
    return SpiSensor(config.get_printer(), config.get_name(), chip, spi)


def register_builtin(heaters: Any) -> None:
    """Register the types of this file."""
    for name, read_chip in CHIPS.items():
        heaters.add_sensor_factory(name, lambda config, read_chip=read_chip: build_sensor(config, read_chip))


def load_config(config: ConfigWrapper) -> None:
    """Section [spi_temperature] of older configs: the types are built in."""
