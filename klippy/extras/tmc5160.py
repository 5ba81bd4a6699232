"""[tmc5160 STEPPER]: a stepper driver with external transistors on SPI, with StallGuard."""

from __future__ import annotations

from configfile import ConfigWrapper

from .tmc.chips import TMC5160
from .tmc.current import tmc5160_current
from .tmc.driver import StepperDriver
from .tmc.spi import RegisterLink


def load_config_prefix(config: ConfigWrapper) -> StepperDriver:
    sense_ohm = config.getfloat("sense_resistor", 0.075, above=0.0)
    driver = StepperDriver(config, TMC5160, RegisterLink(config), tmc5160_current(sense_ohm))
    driver.register()
    return driver
