"""[tmc2240 STEPPER]: a stepper driver that needs no sense resistors, on SPI or a single-wire UART, with StallGuard."""

from __future__ import annotations

from configfile import ConfigWrapper

from .tmc import spi, uart
from .tmc.chips import TMC2240, TMC2240_UART
from .tmc.current import ReferenceResistor
from .tmc.driver import StepperDriver


def load_config_prefix(config: ConfigWrapper) -> StepperDriver:
    reference_ohm = config.getfloat("rref", 12000.0, minval=12000.0, maxval=60000.0)
    current = ReferenceResistor(reference_ohm)
    if config.get("uart_pin", None) is None:
        driver = StepperDriver(config, TMC2240, spi.RegisterLink(config), current)
    else:
        driver = StepperDriver(config, TMC2240_UART, uart.RegisterLink(config, addresses=8), current)
    driver.register()
    return driver
