"""[tmc2240 STEPPER]: a stepper driver that needs no sense resistors on SPI, with StallGuard."""

from __future__ import annotations

from configfile import ConfigWrapper

from .tmc.chips import TMC2240
from .tmc.current import ReferenceResistor
from .tmc.driver import StepperDriver
from .tmc.spi import RegisterLink


def load_config_prefix(config: ConfigWrapper) -> StepperDriver:
    reference_ohm = config.getfloat("rref", 12000.0, minval=12000.0, maxval=60000.0)
    driver = StepperDriver(config, TMC2240, RegisterLink(config), ReferenceResistor(reference_ohm))
    driver.register()
    return driver
