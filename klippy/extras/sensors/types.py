"""Which sensor types exist: the files with built-in ones, and the sections that define more.

A sensor file has `register_builtin(heaters)`, which registers its types (heaters.add_sensor_factory) by the names used
in `sensor_type:`. A section of CUSTOM_SECTIONS, e.g. [thermistor NAME], makes NAME a type.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from .. import (
    adc_temperature,
    spi_temperature,
    temperature_combined,
    temperature_host,
    temperature_mcu,
    thermistor,
)
from . import bosch, ds18b20, i2c_temperature, induction

CUSTOM_SECTIONS = ("thermistor", "adc_temperature", "polynomial_thermistor")

BUILTIN: tuple[Callable[[Any], None], ...] = (
    thermistor.register_builtin,
    adc_temperature.register_builtin,
    spi_temperature.register_builtin,
    i2c_temperature.register_builtin,
    bosch.register_builtin,
    ds18b20.register_builtin,
    induction.register_builtin,
    temperature_mcu.register_builtin,
    temperature_host.register_builtin,
    temperature_combined.register_builtin,
)


def register_builtin(heaters: Any) -> None:
    """Register every built-in type."""
    for register in BUILTIN:
        register(heaters)
