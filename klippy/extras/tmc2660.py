"""[tmc2660 STEPPER]: a stepper driver on SPI.

It has no current for holding: the host lowers its current while the printer is idle.
"""

from __future__ import annotations

from configfile import ConfigWrapper

from .tmc.chips import TMC2660
from .tmc.current import OneScale
from .tmc.driver import StepperDriver
from .tmc.spi import ShortLink


class Tmc2660Driver(StepperDriver):
    """`hold_current` is the current while the printer is idle."""

    def _read_hold_current(self, config: ConfigWrapper) -> float:
        return self.run_current * config.getint("idle_current_percent", 100, minval=0, maxval=100) / 100.0

    def register(self) -> None:
        super().register()
        for event, is_idle in (("idle", True), ("printing", False)):
            self.printer.register_event_handler(
                f"idle_timeout:{event}", lambda print_time, is_idle=is_idle: self._set_idle(is_idle)
            )

    def _set_idle(self, is_idle: bool) -> None:
        current_a = self.hold_current if is_idle else self.run_current
        self._change(self.current.fields(current_a, current_a))


def load_config_prefix(config: ConfigWrapper) -> Tmc2660Driver:
    current = OneScale(config.getfloat("sense_resistor", above=0.0))
    driver = Tmc2660Driver(config, TMC2660, ShortLink(config), current)
    driver.register()
    return driver
