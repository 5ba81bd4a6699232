"""Sensor type temperature_mcu: the temperature sensor inside the micro-controller.

The firmware offers it as the pin ADC_TEMPERATURE. Temperature is linear in the ADC reading:

    temp_c = base_c + slope_c * adc          adc 0..1

by two points of the user (sensor_temperature1/2, sensor_adc1/2), by one point and the slope of the chip's data sheet,
by the factory's calibration values in the chip's memory (read with debug_read), or by the data sheet's typical values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

from . import query_adc
from .adc_temperature import ReadingRange

SAMPLE_TIME_S = 0.001
SAMPLE_COUNT = 8
REPORT_TIME_S = 0.300
RANGE_CHECK_COUNT = 4

PIN = "ADC_TEMPERATURE"
KELVIN_0_C = -273.15


@dataclass(frozen=True, slots=True)
class Line:
    """temp_c = base_c + slope_c * adc"""

    base_c: float
    slope_c: float

    @classmethod
    def through(cls, adc: float, temp_c: float, slope_c: float) -> Line:
        return cls(temp_c - adc * slope_c, slope_c)

    @classmethod
    def through_two(cls, adc1: float, temp1_c: float, adc2: float, temp2_c: float) -> Line:
        return cls.through(adc1, temp1_c, (temp2_c - temp1_c) / (adc2 - adc1))

    def calc_temp(self, adc: float) -> float:
        return self.base_c + adc * self.slope_c

    def calc_adc(self, temp: float) -> float:
        return (temp - self.base_c) / self.slope_c


@dataclass(frozen=True, slots=True)
class Typical:
    """A data sheet's typical values: volts at a temperature, volts per degree, ADC reference."""

    temp_c: float
    volt: float
    volt_per_c: float
    reference_v: float = 3.3

    def line(self) -> Line:
        slope_c = self.reference_v / self.volt_per_c
        return Line.through(self.volt / self.reference_v, self.temp_c, slope_c)


@dataclass(frozen=True, slots=True)
class Factory:
    """Two readings the maker left in the chip: 16-bit words, full scale, temperatures, at which supply voltage."""

    address1: int
    address2: int
    temp1_c: float
    temp2_c: float
    supply_v: float
    full_scale: int = 4095


# By beginning of the constant MCU. Sources: the chips' data sheets, section "temperature sensor characteristics" and
# "calibration values". The chips with factory values keep `Typical` for the slope of a one-point calibration.
TYPICAL: tuple[tuple[str, Typical], ...] = (
    ("rp2040", Typical(27.0, 0.706, -0.001721)),
    ("rp2350", Typical(27.0, 0.706, -0.001721)),
    ("sam3x8", Typical(27.0, 0.800, 0.002650)),
    ("sam4", Typical(27.0, 1.440, 0.004700)),
    ("same70", Typical(25.0, 0.720, 0.002330)),
    ("stm32f1", Typical(25.0, 1.430, -0.004300)),
    ("stm32f0", Typical(30.0, 1.430, -0.004300)),
    ("stm32f2", Typical(25.0, 0.760, 0.002500)),
    ("stm32f3", Typical(25.0, 1.430, -0.004300)),
    ("stm32f4", Typical(25.0, 0.760, 0.002500)),
    ("stm32f7", Typical(25.0, 0.760, 0.002500)),
    ("stm32g0", Typical(30.0, 0.760, 0.002500)),
    ("stm32g4", Typical(30.0, 0.760, 0.002500)),
    ("stm32l4", Typical(30.0, 0.760, 0.002500)),
    ("stm32h7", Typical(30.0, 0.620, 0.002000)),
    ("simulator", Typical(25.0, 1.395, -0.004200)),  # klippy/simulation/world/chip_sensor.h
)
FACTORY: tuple[tuple[str, Factory], ...] = (
    ("stm32f0", Factory(0x1FFFF7B8, 0x1FFFF7C2, 30.0, 110.0, 3.3)),
    ("stm32f3", Factory(0x1FFFF7B8, 0x1FFFF7C2, 30.0, 110.0, 3.3)),
    ("stm32f401", Factory(0x1FFF7A2C, 0x1FFF7A2E, 30.0, 110.0, 3.3)),
    ("stm32f42", Factory(0x1FFF7A2C, 0x1FFF7A2E, 30.0, 110.0, 3.3)),
    ("stm32f446", Factory(0x1FFF7A2C, 0x1FFF7A2E, 30.0, 110.0, 3.3)),
    ("stm32f7", Factory(0x1FF0F44C, 0x1FF0F44E, 30.0, 110.0, 3.3)),
    ("stm32g0", Factory(0x1FFF75A8, 0x1FFF75CA, 30.0, 130.0, 3.0)),
    ("stm32g4", Factory(0x1FFF75A8, 0x1FFF75CA, 30.0, 130.0, 3.0)),
    ("stm32l4", Factory(0x1FFF75A8, 0x1FFF75CA, 30.0, 130.0, 3.0)),
    ("stm32h7", Factory(0x1FF1E820, 0x1FF1E840, 30.0, 110.0, 3.3, 65535)),
)
BOARD_V = 3.3  # what the chips run on


def _of_chip(table: tuple[tuple[str, Any], ...], chip: str) -> Any:
    """The row whose beginning fits the chip's name best, or None."""
    rows = [(len(prefix), row) for prefix, row in table if chip.startswith(prefix)]
    return max(rows, key=lambda pair: pair[0])[1] if rows else None


@dataclass(frozen=True, slots=True)
class Calibration:
    """What the user measured: (degC, adc) pairs, none, one or two."""

    points: tuple[tuple[float, float], ...] = ()


class McuTemperature:
    """One chip's own temperature."""

    def __init__(self, printer: Printer, name: str, mcu_name: str, calibration: Calibration) -> None:
        self.printer = printer
        self.name = name
        self.mcu_name = mcu_name
        self.calibration = calibration
        self.line: Line | None = None
        self._range_c = (0.0, 0.0)
        self._range = ReadingRange()
        self._callback: Callable[[float, float], None] | None = None
        self.mcu_adc = printer.lookup_object("pins").setup_pin("adc", f"{mcu_name}:{PIN}")
        self.mcu_adc.setup_adc_callback(REPORT_TIME_S, self._on_adc)

    def register(self) -> None:
        self.printer.register_event_handler("klippy:mcu_identify", self._handle_identify)
        self.printer.register_event_handler("mcu:explain_shutdown", self._explain)

    def setup_callback(self, temperature_callback: Callable[[float, float], None]) -> None:
        self._callback = temperature_callback

    def get_report_time_delta(self) -> float:
        return REPORT_TIME_S

    def setup_minmax(self, min_temp: float, max_temp: float) -> None:
        self._range_c = (min_temp, max_temp)

    def _explain(self, mcu: Any, reason: str) -> str:
        return self._range.explain(self.name, self.mcu_adc, self.line, mcu, reason) if self.line else ""

    def _handle_identify(self) -> None:
        mcu = self.mcu_adc.get_mcu()
        if PIN not in mcu.get_enumerations().get("pin", {}):
            raise self.printer.config_error(
                f"Sensor '{self.name}': the firmware of mcu '{self.mcu_name}' does not offer its chip's own temperature"
                f" (there is no pin {PIN})"
            )
        self.line = self._find_line(mcu, str(mcu.get_constants().get("MCU", "")))
        low, high = sorted(min(1.0, max(0.0, self.line.calc_adc(temp))) for temp in self._range_c)
        self._range = ReadingRange(*self._range_c, low, high)
        self.mcu_adc.setup_adc_sample(
            SAMPLE_TIME_S, SAMPLE_COUNT, minval=low, maxval=high, range_check_count=RANGE_CHECK_COUNT
        )

    def _find_line(self, mcu: Any, chip: str) -> Line:
        points = self.calibration.points
        if len(points) == 2:
            (temp1_c, adc1), (temp2_c, adc2) = points
            return Line.through_two(adc1, temp1_c, adc2, temp2_c)
        typical: Typical | None = _of_chip(TYPICAL, chip)
        if typical is None:
            raise self.printer.config_error(
                f"Sensor '{self.name}': the temperature of a '{chip}' chip (mcu '{self.mcu_name}') is known only from"
                " two points: give sensor_temperature1, sensor_adc1, sensor_temperature2 and sensor_adc2."
            )
        if points:
            temp_c, adc = points[0]
            return Line.through(adc, temp_c, typical.line().slope_c)
        factory: Factory | None = _of_chip(FACTORY, chip)
        return (self._read_factory(mcu, factory) if factory else None) or typical.line()

    def _read_factory(self, mcu: Any, factory: Factory) -> Line | None:
        """The maker's calibration; None if the memory does not hold any."""
        if mcu.is_fileoutput():
            return None
        query = mcu.lookup_query_command("debug_read order=%c addr=%u", "debug_result val=%u")
        scale = factory.supply_v / BOARD_V / factory.full_scale
        adc1, adc2 = (
            query.send([1, address])["val"] * scale for address in (factory.address1, factory.address2)
        )
        if not 0.0 < adc1 < 1.0 or not 0.0 < adc2 < 1.0 or adc1 == adc2:
            return None
        return Line.through_two(adc1, factory.temp1_c, adc2, factory.temp2_c)

    def _on_adc(self, read_time: float, read_value: float) -> None:
        if self._callback is not None and self.line is not None:
            self._callback(read_time + SAMPLE_COUNT * SAMPLE_TIME_S, self.line.calc_temp(read_value))


def read_calibration(config: ConfigWrapper) -> Calibration:
    """sensor_temperature1/2 with sensor_adc1/2; raises the config's error for points that make no line."""
    points = []
    for number in (1, 2):
        temp_c = config.getfloat(f"sensor_temperature{number}", None, above=KELVIN_0_C)
        if temp_c is None:
            break
        points.append((temp_c, config.getfloat(f"sensor_adc{number}", minval=0.0, maxval=1.0)))
    if len(points) == 2 and (points[0][0] == points[1][0] or points[0][1] == points[1][1]):
        raise config.error(
            f"Section '{config.get_name()}': the two calibration points must differ in temperature and in adc."
        )
    return Calibration(tuple(points))


def build_sensor(config: ConfigWrapper) -> McuTemperature:
    """Sensor of a section with this type."""
    name = config.get_name().split()[-1]
    mcu_name = config.get("sensor_mcu", "mcu")
    sensor = McuTemperature(config.get_printer(), name, mcu_name, read_calibration(config))
    query_adc.register_adc(config, config.get_name(), sensor.mcu_adc)
    sensor.register()
    return sensor


def register_builtin(heaters: Any) -> None:
    """Register the type of this file."""
    heaters.add_sensor_factory("temperature_mcu", build_sensor)


def load_config(config: ConfigWrapper) -> None:
    """Section [temperature_mcu] of older configs: the type is built in."""
