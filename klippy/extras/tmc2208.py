"""[tmc2208 STEPPER]: a stepper driver on a single-wire UART."""

from __future__ import annotations

from configfile import ConfigWrapper

from .tmc.chips import TMC2208
from .tmc.current import TwoRanges
from .tmc.driver import StepperDriver
from .tmc.uart import RegisterLink


def load_config_prefix(config: ConfigWrapper) -> StepperDriver:
    sense_ohm = config.getfloat("sense_resistor", 0.110, above=0.0)
    driver = StepperDriver(config, TMC2208, RegisterLink(config), TwoRanges(sense_ohm, (0.325, 0.180)))
    driver.register()
    return driver
