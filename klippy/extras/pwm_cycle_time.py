"""[pwm_cycle_time NAME]: a software PWM pin whose cycle time can be changed: SET_PIN PIN=NAME VALUE=… [CYCLE_TIME=…].

The firmware changes the cycle only while the pin stands still, so a change of cycle goes

    t            off
    t + PAUSE_S  the new cycle has been set meanwhile; on with the new value
"""

from __future__ import annotations

from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

MAX_CYCLE_S = 5.0
MIN_GAP_S = 0.100  # between two values
PAUSE_S = 0.100  # without signal when the cycle time changes
SETTLE_S = 0.002  # after switching off, before the MCU may be sent the new cycle


class MCU_pwm_cycle:
    """The pin."""

    def __init__(self, pin_params: dict[str, Any], cycle_time: float, start: float, shutdown: float) -> None:
        self._mcu = mcu = pin_params["chip"]
        self._pin = pin_params["pin"]
        self._invert = pin_params["invert"]
        self._cycle_time_s = cycle_time
        self._start_value = 1.0 - start if self._invert else start
        self._shutdown_value = 1.0 - shutdown if self._invert else shutdown
        self._last_clock = 0
        self._cycle_ticks = 0
        self._set: Any = None
        self._set_cycle: Any = None
        self._oid = mcu.create_oid()
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Any:
        return self._mcu

    def _build_config(self) -> None:
        mcu, oid = self._mcu, self._oid
        self._cycle_ticks = mcu.seconds_to_clock(self._cycle_time_s)
        mcu.request_move_queue_slot()
        mcu.add_config_cmd(
            f"config_digital_out oid={oid} pin={self._pin} value={int(self._start_value >= 1.0)}"
            f" default_value={int(self._shutdown_value >= 0.5)} max_duration=0"
        )
        mcu.add_config_cmd(f"set_digital_out_pwm_cycle oid={oid} cycle_ticks={self._cycle_ticks}")
        self._last_clock = mcu.get_query_slot(oid)
        on_ticks = int(self._start_value * self._cycle_ticks + 0.5)
        if 0 < on_ticks < self._cycle_ticks:
            mcu.add_config_cmd(
                f"queue_digital_out oid={oid} clock={self._last_clock} on_ticks={on_ticks}", is_init=True
            )
        queue = mcu.alloc_command_queue()
        self._set = mcu.lookup_command("queue_digital_out oid=%c clock=%u on_ticks=%u", cq=queue)
        self._set_cycle = mcu.lookup_command("set_digital_out_pwm_cycle oid=%c cycle_ticks=%u", cq=queue)

    def _queue(self, clock: int, on_ticks: int) -> None:
        self._set.send([self._oid, clock, on_ticks], minclock=self._last_clock, reqclock=clock)
        self._last_clock = clock

    def set_pwm_cycle(self, print_time: float, value: float, cycle_time: float) -> float:
        """Duty cycle and cycle time (s) from print_time on; returns when they are really in force."""
        mcu = self._mcu
        cycle_ticks = mcu.seconds_to_clock(cycle_time)
        if cycle_ticks != self._cycle_ticks:
            self._cycle_ticks = cycle_ticks
            self._queue(mcu.print_time_to_clock(print_time), 0)
            settled = mcu.print_time_to_clock(print_time + SETTLE_S)
            print_time += PAUSE_S
            ready = mcu.print_time_to_clock(print_time)
            self._set_cycle.send([self._oid, cycle_ticks], minclock=settled, reqclock=ready)
            self._last_clock = settled
        duty = 1.0 - value if self._invert else value
        self._queue(mcu.print_time_to_clock(print_time), int(max(0.0, min(1.0, duty)) * cycle_ticks + 0.5))
        return print_time


class PrinterOutputPWMCycle:
    """The object `pwm_cycle_time NAME`. Values are in units of `scale` outwards, 0..1 inside."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        params = self.printer.lookup_object("pins").lookup_pin(config.get("pin"), can_invert=True)
        self.scale = config.getfloat("scale", 1.0, above=0.0)
        self.default_cycle_time_s = config.getfloat("cycle_time", 0.100, above=0.0, maxval=MAX_CYCLE_S)
        start = config.getfloat("value", 0.0, minval=0.0, maxval=self.scale) / self.scale
        shutdown = config.getfloat("shutdown_value", 0.0, minval=0.0, maxval=self.scale) / self.scale
        self.mcu_pin = MCU_pwm_cycle(params, self.default_cycle_time_s, start, shutdown)
        self.last_value = start
        self._last = (start, self.default_cycle_time_s)
        self._last_time = 0.0

    def register(self, name: str) -> None:
        """Make the command known."""
        self.printer.lookup_object("gcode").register_mux_command(
            "SET_PIN", "PIN", name, self.cmd_SET_PIN, desc="Set the value of an output pin"
        )

    def get_status(self, eventtime: float) -> dict[str, float]:
        """The value 0..1."""
        return {"value": self.last_value}

    def _apply(self, print_time: float, value: float, cycle_time_s: float) -> None:
        if (value, cycle_time_s) == self._last:
            return
        self._last = (value, cycle_time_s)
        if self._last_time:
            print_time = max(print_time, self._last_time + MIN_GAP_S)
        self._last_time = self.mcu_pin.set_pwm_cycle(print_time, value, cycle_time_s)

    def cmd_SET_PIN(self, gcmd: GCodeCommand) -> None:
        """Set value and cycle time in step with the moves queued so far."""
        value = gcmd.get_float("VALUE", minval=0.0, maxval=self.scale) / self.scale
        cycle_time_s = gcmd.get_float("CYCLE_TIME", self.default_cycle_time_s, above=0.0, maxval=MAX_CYCLE_S)
        self.last_value = value
        self.printer.lookup_object("toolhead").register_lookahead_callback(
            lambda print_time: self._apply(print_time, value, cycle_time_s)
        )


def load_config_prefix(config: ConfigWrapper) -> PrinterOutputPWMCycle:
    """Section [pwm_cycle_time NAME]."""
    pin = PrinterOutputPWMCycle(config)
    pin.register(config.get_name().split(maxsplit=1)[1])
    return pin
