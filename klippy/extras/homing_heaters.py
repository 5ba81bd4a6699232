"""[homing_heaters]: heaters that pause while an axis homes or probes, because they disturb the endstop."""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from roles import Printer


class HomingHeaters:
    """Switches the named heaters off for homing moves of the named steppers (None: all)."""

    def __init__(
        self, printer: Printer, steppers: tuple[str, ...] | None, heaters: tuple[str, ...] | None
    ) -> None:
        self.printer = printer
        self._steppers = steppers
        self._heaters = heaters
        self._saved_c: dict[str, float] = {}

    def register(self) -> None:
        """Make events known."""
        for event, handler in (
            ("klippy:connect", self._check_names),
            ("homing:homing_move_begin", self._begin),
            ("homing:homing_move_end", self._end),
        ):
            self.printer.register_event_handler(event, handler)

    def _check_names(self) -> None:
        pheaters = self.printer.lookup_object("heaters")
        known = pheaters.get_all_heaters()
        if self._heaters is None:
            self._heaters = tuple(known)
        unknown = [name for name in self._heaters if name not in known]
        if unknown:
            raise self.printer.config_error(
                f"Section 'homing_heaters': there is no heater '{unknown[0]}' (there are: {', '.join(known)})"
            )
        if self._steppers is None:
            return
        kinematics = self.printer.lookup_object("toolhead").get_kinematics()
        names = [stepper.get_name() for stepper in kinematics.get_steppers()]
        missing = [name for name in self._steppers if name not in names]
        if missing:
            raise self.printer.config_error(
                f"Section 'homing_heaters': there is no stepper '{missing[0]}' (there are: {', '.join(names)})"
            )

    def _concerns_us(self, homing_move: Any) -> bool:
        if self._steppers is None:
            return True
        return any(
            stepper.get_name() in self._steppers
            for endstop in homing_move.get_mcu_endstops()
            for stepper in endstop.get_steppers()
        )

    def _begin(self, homing_move: Any) -> None:
        if not self._concerns_us(homing_move):
            return
        pheaters = self.printer.lookup_object("heaters")
        now = self.printer.get_reactor().monotonic()
        for name in self._heaters or ():
            heater = pheaters.lookup_heater(name)
            if name not in self._saved_c:
                self._saved_c[name] = heater.get_temp(now)[1]
            heater.set_temp(0.0)

    def _end(self, homing_move: Any) -> None:
        saved_c, self._saved_c = self._saved_c, {}
        for name, target_c in saved_c.items():
            self.printer.lookup_object("heaters").lookup_heater(name).set_temp(target_c)


def load_config(config: ConfigWrapper) -> HomingHeaters:
    """Section [homing_heaters]."""
    printer = config.get_printer()
    printer.load_object(config, "heaters")
    module = HomingHeaters(printer, config.getlist("steppers", None), config.getlist("heaters", None))
    module.register()
    return module
