"""[led NAME]: an LED on PWM pins, and `LEDHelper`, the colours and commands of any kind of LED.

SET_LED LED=NAME [RED GREEN BLUE WHITE 0..1] [INDEX=n] [TRANSMIT=0] [SYNC=0]: without INDEX all LEDs of the chain; with
TRANSMIT=0 only remembered until the next transmission; with SYNC=0 at once instead of in step with the moves.
SET_LED_TEMPLATE lets it follow the printer's status (template_evaluator.py).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from .outputs.scheduled_pin import ScheduledPin

COLORS = ("RED", "GREEN", "BLUE", "WHITE")
MIN_LEAD_S = 0.100  # a change outside the moves is placed that far ahead of the MCU's clock

Color = tuple[float, float, float, float]
UpdateFunction = Callable[[Sequence[Color], float | None], None]


class LEDHelper:
    """The colours of a chain of LEDs. `update_func(colours, print_time or None)` brings them out."""

    def __init__(self, config: ConfigWrapper, update_func: UpdateFunction, led_count: int = 1) -> None:
        self.printer = config.get_printer()
        self.update_func = update_func
        self.led_count = led_count
        initial = [config.getfloat(f"initial_{color}", 0.0, minval=0.0, maxval=1.0) for color in COLORS]
        self.led_state: list[Color] = [(initial[0], initial[1], initial[2], initial[3])] * led_count
        self.need_transmit = False
        name = config.get_name().split(maxsplit=1)[-1]
        gcode = self.printer.lookup_object("gcode")
        gcode.register_mux_command("SET_LED", "LED", name, self.cmd_SET_LED, desc="Set the color of an LED")
        self._templates = self.printer.load_object(config, "template_evaluator")
        gcode.register_mux_command(
            "SET_LED_TEMPLATE",
            "LED",
            name,
            self.cmd_SET_LED_TEMPLATE,
            desc="Assign a display_template to an LED",
        )

    def get_led_count(self) -> int:
        return self.led_count

    def set_color(self, index: int | None, color: Color) -> None:
        """The colour of LED number `index` (from 1 on), or of all."""
        if index is None:
            changed = [color] * self.led_count
        else:
            changed = list(self.led_state)
            changed[index - 1] = color
        if changed != self.led_state:
            self.led_state = changed
            self.need_transmit = True

    def check_transmit(self, print_time: float | None) -> None:
        """Send the changed colours."""
        if self.need_transmit:
            self.need_transmit = False
            self.update_func(self.led_state, print_time)

    def get_status(self, eventtime: float | None = None) -> dict[str, Any]:
        return {"color_data": self.led_state}

    def cmd_SET_LED(self, gcmd: GCodeCommand) -> None:
        """Set a colour."""
        red, green, blue, white = (gcmd.get_float(color, 0.0, minval=0.0, maxval=1.0) for color in COLORS)
        index = gcmd.get_int("INDEX", None, minval=1, maxval=self.led_count)
        transmit = gcmd.get_int("TRANSMIT", 1)
        sync = gcmd.get_int("SYNC", 1)

        def bring_out(print_time: float | None) -> None:
            self.set_color(index, (red, green, blue, white))
            if transmit:
                self.check_transmit(print_time)

        if sync:
            self.printer.lookup_object("toolhead").register_lookahead_callback(bring_out)
        else:
            bring_out(None)

    def cmd_SET_LED_TEMPLATE(self, gcmd: GCodeCommand) -> None:
        """Let one LED, or all, follow a template."""
        index = gcmd.get_int("INDEX", None, minval=1, maxval=self.led_count)
        for number in range(1, self.led_count + 1) if index is None else (index,):
            self._templates.assign(
                (self, number), gcmd, partial(self._show, number), partial(self.check_transmit, None)
            )

    def _show(self, number: int, text: str) -> None:
        """The colour a template gives as `red, green, blue, white`; missing ones are dark."""
        parts = [min(1.0, max(0.0, float(part))) for part in text.split(",")]
        red, green, blue, white, *_ = [*parts, 0.0, 0.0, 0.0, 0.0]
        self.set_color(number, (red, green, blue, white))


class PrinterLED:
    """The object `led`, for modules with LEDs of their own."""

    def setup_helper(
        self, config: ConfigWrapper, update_func: UpdateFunction, led_count: int = 1
    ) -> LEDHelper:
        return LEDHelper(config, update_func, led_count)


class PrinterPWMLED:
    """The object `led NAME`."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        cycle_time_s = config.getfloat("cycle_time", 0.010, above=0.0, maxval=5.0)
        hardware_pwm = config.getboolean("hardware_pwm", False)
        self.led_helper = LEDHelper(config, self._update)
        self.get_status = self.led_helper.get_status
        initial = self.led_helper.led_state[0]
        self._outputs: list[tuple[int, ScheduledPin]] = []
        pins = self.printer.lookup_object("pins")
        for index, color in enumerate(COLORS):
            pin_name = config.get(f"{color.lower()}_pin", None)
            if pin_name is None:
                continue
            pin = pins.setup_pin("pwm", pin_name)
            pin.setup_max_duration(0.0)
            pin.setup_cycle_time(cycle_time_s, hardware_pwm)
            pin.setup_start_value(initial[index], 0.0)
            self._mcu = pin.get_mcu()
            self._outputs.append((index, ScheduledPin(self.printer, self._mcu, pin.set_pwm, initial[index])))
        if not self._outputs:
            raise config.error(
                f"Section '{config.get_name()}' needs at least one of red_pin, green_pin, blue_pin, white_pin."
            )

    def _update(self, led_state: Sequence[Color], print_time: float | None) -> None:
        if print_time is None:
            eventtime = self.printer.get_reactor().monotonic()
            print_time = self._mcu.estimated_print_time(eventtime) + MIN_LEAD_S
        for index, output in self._outputs:
            output.request(print_time, led_state[0][index])


def load_config(config: ConfigWrapper) -> PrinterLED:
    """Loaded by LED modules."""
    return PrinterLED()


def load_config_prefix(config: ConfigWrapper) -> PrinterPWMLED:
    """Section [led NAME]."""
    return PrinterPWMLED(config)
