"""[tmc2130 STEPPER]: a stepper driver on SPI, with StallGuard."""

from __future__ import annotations

from configfile import ConfigWrapper

from .tmc.chips import TMC2130
from .tmc.current import TwoRanges
from .tmc.driver import StepperDriver
from .tmc.spi import RegisterLink


def load_config_prefix(config: ConfigWrapper) -> StepperDriver:
    sense_ohm = config.getfloat("sense_resistor", 0.110, above=0.0)
    driver = StepperDriver(config, TMC2130, RegisterLink(config), TwoRanges(sense_ohm, (0.320, 0.180)))
    driver.register()
    return driver
