"""The probe as an endstop, brought out before and back after use (see probe.py).

ProbeSwitch   a pin, with G-code to bring the probe out and back
ProbeEvents   does so around every move that ends at the probe, G28's included
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from configfile import ConfigWrapper
from roles import Printer


class ProbeSwitch:
    """The probe as an endstop (klippy/link/mcu_homing.py) that is brought out before and back after use.

    A subclass with another way to do that overrides `raise_probe` and `lower_probe`.
    """

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self._z_offset = config.getfloat("z_offset")
        self._each_sample = config.getboolean("deactivate_on_each_sample", True)
        load = self.printer.load_object(config, "gcode_macro").load_template
        self._activate = load(config, "activate_gcode", "")
        self._deactivate = load(config, "deactivate_gcode", "")
        self.setup_endstop(config.get("pin"))

    def setup_endstop(self, pin: str) -> None:
        """Claim the pin; also part of subclasses' constructors."""
        self.mcu_endstop = self.printer.lookup_object("pins").setup_pin("endstop", pin)
        self._in_series = False  # between multi_probe_begin and multi_probe_end
        self._is_out = False
        self.printer.register_event_handler("klippy:mcu_identify", self._attach_steppers)

    def _attach_steppers(self) -> None:
        """The trigger stops every motor that moves the head up or down, on whichever board."""
        for motor in self.printer.lookup_object("toolhead").get_kinematics().get_steppers():
            if motor.is_active_axis("z"):
                self.mcu_endstop.add_stepper(motor)

    # -- as an endstop --

    def get_mcu(self) -> Any:
        return self.mcu_endstop.get_mcu()

    def add_stepper(self, stepper: Any) -> None:
        self.mcu_endstop.add_stepper(stepper)

    def get_steppers(self) -> list[Any]:
        return self.mcu_endstop.get_steppers()

    def home_start(
        self,
        print_time: float,
        sample_time: float,
        sample_count: int,
        rest_time: float,
        triggered: bool = True,
    ) -> Any:
        return self.mcu_endstop.home_start(print_time, sample_time, sample_count, rest_time, triggered)

    def home_wait(self, home_end_time: float) -> float:
        return self.mcu_endstop.home_wait(home_end_time)

    def query_endstop(self, print_time: float) -> int:
        return self.mcu_endstop.query_endstop(print_time)

    def get_position_endstop(self) -> float:
        """Homing with the virtual endstop ends at this height."""
        return self._z_offset

    # -- out and back --

    def lower_probe(self) -> None:
        """Bring the probe out."""
        self._run(self._activate, "activate_gcode")

    def raise_probe(self) -> None:
        """Bring the probe back."""
        self._run(self._deactivate, "deactivate_gcode")

    def _run(self, template: Any, what: str) -> None:
        toolhead = self.printer.lookup_object("toolhead")
        before = toolhead.get_position()[:3]
        template.run_gcode_from_command()
        if toolhead.get_position()[:3] != before:
            raise self.printer.command_error(f"Toolhead moved during probe {what} script")

    def _stay_out(self) -> bool:
        return self._in_series and not self._each_sample

    def multi_probe_begin(self) -> None:
        """Several samples follow: the probe may stay out between them."""
        self._in_series = True

    def multi_probe_end(self) -> None:
        self._in_series = False
        if self._is_out:
            self._is_out = False
            self.raise_probe()

    def probe_prepare(self, hmove: Any) -> None:
        """Before each move towards the bed."""
        if not self._is_out:
            self.lower_probe()
            self._is_out = True

    def probe_finish(self, hmove: Any) -> None:
        """After each move towards the bed."""
        if self._is_out and not self._stay_out():
            self._is_out = False
            self.raise_probe()

    def probing_move(self, pos: Sequence[float], speed: float) -> list[float]:
        """Move to pos until the trigger; returns where the head was then."""
        return self.printer.lookup_object("homing").probing_move(self, pos, speed)


class ProbeEvents:
    """Brings the probe out and back around every move that ends at it, G28's included."""

    def __init__(self, printer: Printer, mcu_probe: Any) -> None:
        self._printer = printer
        self._mcu_probe = mcu_probe
        self._homing = False
        for event, handler in (
            ("homing:homing_move_begin", self._move_begins),
            ("homing:homing_move_end", self._move_ends),
            ("homing:home_rails_begin", self._rails_begin),
            ("homing:home_rails_end", self._rails_end),
            ("gcode:command_error", self._on_error),
        ):
            printer.register_event_handler(event, handler)

    def _move_begins(self, hmove: Any) -> None:
        if self._mcu_probe in hmove.get_mcu_endstops():
            self._mcu_probe.probe_prepare(hmove)

    def _move_ends(self, hmove: Any) -> None:
        if self._mcu_probe in hmove.get_mcu_endstops():
            self._mcu_probe.probe_finish(hmove)

    def _rails_begin(self, homing_state: Any, rails: Sequence[Any]) -> None:
        if any(endstop is self._mcu_probe for rail in rails for endstop, _name in rail.get_endstops()):
            self._homing = True
            self._mcu_probe.multi_probe_begin()

    def _rails_end(self, homing_state: Any, rails: Sequence[Any]) -> None:
        if self._homing:
            self._homing = False
            self._mcu_probe.multi_probe_end()

    def _on_error(self) -> None:
        """Whatever was under way has failed; a probe that cannot be brought back now is only reported."""
        try:
            self._rails_end(None, ())
        except self._printer.command_error as e:
            self._printer.lookup_object("gcode").respond_info(str(e))
