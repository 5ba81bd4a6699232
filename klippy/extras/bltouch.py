"""[bltouch]: a probe with a pin that comes out, commanded by servo pulses. BLTOUCH_DEBUG, BLTOUCH_STORE.

    lower    pin_down, then touch_mode: a pin that is out does not report a touch there; back to pin_down (unless
             probing is done in touch_mode)
    touch    in pin_down the sensor gives a pulse of some ms and the pin springs back; in touch_mode it reports as long
             as the pin is pushed
    raise    pin_up: the sensor then reports nothing

The commands are angles of a hobby servo (vendor's manual), its pulses 544 to 2400 us long over 180 degrees.
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .probe import PrinterProbe
from .probing.switch import ProbeSwitch

SIGNAL_PERIOD_S = 0.020  # the rhythm of servos
# A command has to be repeated to be understood: five pulses, and the signal ends in a pause between two.
SIGNAL_S = 5.5 * SIGNAL_PERIOD_S
TRIES = 3
ANGLES = {
    "pin_down": 10,
    "touch_mode": 60,
    "pin_up": 90,
    "self_test": 120,
    "output_mode_store": 130,
    "set_5V_output_mode": 140,
    "set_OD_output_mode": 150,
    "reset": 160,
}
OUTPUT_MODES = {"5V": "set_5V_output_mode", "OD": "set_OD_output_mode"}


def pulse_width_s(angle: float) -> float:
    """Length of a servo's pulse."""
    return 544e-6 + (2400e-6 - 544e-6) * angle / 180.0


class BLTouch(ProbeSwitch):
    """The probe's switch, brought out and back by its own commands."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self._z_offset = config.getfloat("z_offset")
        self._each_sample = config.getboolean("stow_on_each_sample", True)
        self._move_time_s = config.getfloat("pin_move_time", 0.680, above=0.0)
        self._touch_mode = config.getboolean("probe_with_touch_mode", False)
        self._up_is_reported = config.getboolean("pin_up_reports_not_triggered", True)
        self._touch_mode_is_reported = config.getboolean("pin_up_touch_mode_reports_triggered", True)
        self._output_mode = config.getchoice("set_output_mode", {None: None, "5V": "5V", "OD": "OD"}, None)
        self._control = self.printer.lookup_object("pins").setup_pin("pwm", config.get("control_pin"))
        self._control.setup_max_duration(0.0)
        self._control.setup_cycle_time(SIGNAL_PERIOD_S)
        self._control.setup_start_value(0.0, 0.0)
        self._free_at = 0.0  # print time at which the last command has been given
        self.setup_endstop(config.get("sensor_pin"))

    def register(self) -> None:
        self.printer.register_event_handler("klippy:ready", self._handle_ready)
        gcode = self.printer.lookup_object("gcode")
        gcode.register_command(
            "BLTOUCH_DEBUG", self.cmd_BLTOUCH_DEBUG, desc="Send a command to the bltouch for debugging"
        )
        gcode.register_command(
            "BLTOUCH_STORE", self.cmd_BLTOUCH_STORE, desc="Store an output mode in the BLTouch EEPROM"
        )

    def _handle_ready(self) -> None:
        """Move the pin up: its state after the last session is unknown."""
        if self._output_mode is not None:
            self._signal(OUTPUT_MODES[self._output_mode])
        self._signal("pin_up", self._move_time_s)

    # -- the signal --

    def _signal(self, command: str, wait_s: float = 0.0) -> None:
        """Send a command after all queued moves; the head rests until it has been executed."""
        toolhead = self.printer.lookup_object("toolhead")
        start = max(toolhead.get_last_move_time(), self._free_at)
        self._control.set_pwm(start, pulse_width_s(ANGLES[command]) / SIGNAL_PERIOD_S)
        self._control.set_pwm(start + SIGNAL_S, 0.0)
        self._free_at = start + max(SIGNAL_S + SIGNAL_PERIOD_S, wait_s)
        toolhead.dwell(self._free_at - toolhead.get_last_move_time())

    def _is_triggered(self) -> bool:
        """What the sensor says once all commands are done."""
        return bool(
            self.mcu_endstop.query_endstop(self.printer.lookup_object("toolhead").get_last_move_time())
        )

    # -- out and back --

    def lower_probe(self) -> None:
        for _ in range(TRIES):
            self._signal("pin_down", self._move_time_s)
            if not self._touch_mode_is_reported:
                break
            self._signal("touch_mode")
            if not self._is_triggered():
                break
            # that it is up all the same may be an alarm (it blinks), which a reset ends
            self._signal("reset", self._move_time_s)
        else:
            raise self.printer.command_error(
                "BLTouch failed to verify sensor state: its pin does not come out"
            )
        if self._touch_mode:
            self._signal("touch_mode")
        elif self._touch_mode_is_reported:
            self._signal("pin_down")

    def raise_probe(self) -> None:
        for _ in range(TRIES):
            self._signal("pin_up", self._move_time_s)
            if not self._up_is_reported or not self._is_triggered():
                return
            self._signal("reset", self._move_time_s)
        raise self.printer.command_error("BLTouch failed to raise probe")

    def probe_prepare(self, hmove: Any) -> None:
        if self._is_out and not self._touch_mode:
            self._signal("pin_down", self._move_time_s)  # the last touch has sent it back
        super().probe_prepare(hmove)

    # -- commands --

    def cmd_BLTOUCH_DEBUG(self, gcmd: GCodeCommand) -> None:
        """BLTOUCH_DEBUG COMMAND=<name>."""
        command = gcmd.get("COMMAND", None)
        if command not in ANGLES:
            gcmd.respond_info(f"BLTouch commands: {', '.join(sorted(ANGLES))}")
            return
        gcmd.respond_info(f"Sending BLTOUCH_DEBUG COMMAND={command}")
        self._signal(command, self._move_time_s)

    def cmd_BLTOUCH_STORE(self, gcmd: GCodeCommand) -> None:
        """BLTOUCH_STORE MODE=5V|OD: V3.1 keeps the mode; it must be named before and after."""
        mode = gcmd.get("MODE", None)
        if mode not in OUTPUT_MODES:
            gcmd.respond_info(f"BLTouch output modes: {', '.join(sorted(OUTPUT_MODES))}")
            return
        gcmd.respond_info(f"Storing BLTouch output mode {mode}")
        for command in (OUTPUT_MODES[mode], "output_mode_store", OUTPUT_MODES[mode]):
            self._signal(command, self._move_time_s)


def load_config(config: ConfigWrapper) -> BLTouch:
    bltouch = BLTouch(config)
    bltouch.register()
    config.get_printer().add_object("probe", PrinterProbe(config, bltouch))
    return bltouch
