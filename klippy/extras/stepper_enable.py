"""Stepper motor enable pins: motors are switched on before their first step and off by M18/M84 or shutdown.

Several steppers may share a pin; it is off only when all of them are off.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import stepstream
from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

# Between the last step and switching off, and before anything else: lets the motors settle.
DISABLE_STALL_S = 0.100


class StepperEnablePin:
    """A pin with the number of steppers that need it on."""

    def __init__(self, mcu_enable: Any) -> None:
        self.mcu_enable = mcu_enable
        self.enable_count = 0
        self.is_dedicated = True

    def set_enable(self, print_time: float) -> None:
        if not self.enable_count and self.mcu_enable is not None:
            self.mcu_enable.set_digital(print_time, 1)
        self.enable_count += 1

    def set_disable(self, print_time: float) -> None:
        self.enable_count -= 1
        if not self.enable_count and self.mcu_enable is not None:
            self.mcu_enable.set_digital(print_time, 0)


class EnableTracking:
    """Whether one stepper is on."""

    def __init__(self, stepper: Any, enable: StepperEnablePin) -> None:
        self.stepper = stepper
        self.enable = enable
        self.callbacks: list[Callable[[float, bool], None]] = []
        self.is_enabled = False
        self.stepper.add_active_callback(self.motor_enable)

    def register_state_callback(self, callback: Callable[[float, bool], None]) -> None:
        """callback(print_time, is_enabled) at each change."""
        self.callbacks.append(callback)

    def motor_enable(self, print_time: float) -> None:
        if self.is_enabled:
            return
        for callback in self.callbacks:
            callback(print_time, True)
        self.enable.set_enable(print_time)
        self.is_enabled = True

    def motor_disable(self, print_time: float) -> None:
        if not self.is_enabled:
            return
        for callback in self.callbacks:
            callback(print_time, False)
        self.enable.set_disable(print_time)
        self.is_enabled = False
        self.stepper.add_active_callback(self.motor_enable)

    def is_motor_enabled(self) -> bool:
        return self.is_enabled

    def has_dedicated_enable(self) -> bool:
        return self.enable.mcu_enable is not None and self.enable.is_dedicated


class PrinterStepperEnable:
    """Printer object 'stepper_enable'."""

    def __init__(self, printer: Printer) -> None:
        self.printer = printer
        self.enable_lines: dict[str, EnableTracking] = {}
        self._pins: dict[tuple[int, str], StepperEnablePin] = {}

    def register_commands(self) -> None:
        """Third step of the set-up: G-code and events."""
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command("M18", self.cmd_M18)
        gcode.register_command("M84", self.cmd_M18)
        gcode.register_command("M17", self.cmd_M17)
        gcode.register_command(
            "SET_STEPPER_ENABLE",
            self.cmd_SET_STEPPER_ENABLE,
            desc="Enable/disable individual stepper by name",
        )
        self.printer.register_event_handler("gcode:request_restart", self._handle_request_restart)

    def _setup_pin(self, config: ConfigWrapper) -> StepperEnablePin:
        pin_desc = config.get("enable_pin", None)
        if pin_desc is None:
            pin = StepperEnablePin(None)
            pin.is_dedicated = False
            return pin
        ppins = self.printer.lookup_object("pins")
        params = ppins.lookup_pin(pin_desc, can_invert=True, share_type="stepper_enable")
        known = self._pins.get((id(params["chip"]), params["pin"]))
        if known is not None:
            known.is_dedicated = False
            return known
        mcu_enable = params["chip"].setup_pin("digital_out", params)
        mcu_enable.setup_max_duration(0.0)
        pin = self._pins[(id(params["chip"]), params["pin"])] = StepperEnablePin(mcu_enable)
        return pin

    def register_stepper(self, config: ConfigWrapper, mcu_stepper: Any) -> None:
        self.enable_lines[mcu_stepper.get_name()] = EnableTracking(mcu_stepper, self._setup_pin(config))

    def set_motors_enable(self, stepper_names: list[str], enable: bool, at_once: bool = False) -> bool:
        """Switch motors on or off after the queued moves, and (not at_once) some rest; True if any changed."""
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.get_last_move_time()
        if enable and all(self.enable_lines[n].is_motor_enabled() for n in stepper_names):
            return False
        if not at_once:
            toolhead.dwell(DISABLE_STALL_S)
            # All steps are out before: one that is worked out later would switch its motor on again, too late. And
            # only now is it known who is on: a motor's first step may have been among them.
            streams = stepstream.lookup_streams(self.printer)
            streams.advance(toolhead.get_last_move_time() - streams.look_ahead_s(), hold_back=False)
        print_time = toolhead.get_last_move_time()
        changing = [n for n in stepper_names if self.enable_lines[n].is_motor_enabled() != enable]
        if not changing:
            return False
        for name in changing:
            line = self.enable_lines[name]
            (line.motor_enable if enable else line.motor_disable)(print_time)
        if enable:
            self.printer.send_event("stepper_enable:motors_on", print_time)
        toolhead.dwell(DISABLE_STALL_S)
        return True

    def motor_off(self) -> None:
        """All motors off; the head's position is no longer known."""
        self.set_motors_enable(list(self.enable_lines), False)
        toolhead = self.printer.lookup_object("toolhead")
        toolhead.get_kinematics().clear_homing_state("xyz")
        self.printer.send_event("stepper_enable:motor_off", toolhead.get_last_move_time())

    def motor_debug_enable(self, stepper: str, enable: bool) -> None:
        self.set_motors_enable([stepper], enable)

    def lookup_enable(self, name: str) -> EnableTracking:
        if name not in self.enable_lines:
            raise self.printer.config_error(f"Unknown stepper '{name}'")
        return self.enable_lines[name]

    def get_steppers(self) -> list[str]:
        return list(self.enable_lines)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {"steppers": {name: line.is_motor_enabled() for name, line in self.enable_lines.items()}}

    def _handle_request_restart(self, print_time: float) -> None:
        self.motor_off()

    def cmd_M18(self, gcmd: GCodeCommand) -> None:
        """M18, M84: motors off."""
        self.motor_off()

    def cmd_M17(self, gcmd: GCodeCommand) -> None:
        """M17: motors on."""
        self.set_motors_enable(list(self.enable_lines), True)

    def cmd_SET_STEPPER_ENABLE(self, gcmd: GCodeCommand) -> None:
        """SET_STEPPER_ENABLE STEPPER=<name> ENABLE=[0|1]."""
        name = gcmd.get("STEPPER", None)
        if name not in self.enable_lines:
            known = ", ".join(self.enable_lines)
            gcmd.respond_info(f"SET_STEPPER_ENABLE: Invalid stepper '{name}' (known: {known})")
            return
        self.set_motors_enable([name], bool(gcmd.get_int("ENABLE", 1)))


def load_config(config: ConfigWrapper) -> PrinterStepperEnable:
    enable = PrinterStepperEnable(config.get_printer())
    enable.register_commands()
    return enable
