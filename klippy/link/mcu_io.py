"""Pins of a micro-controller: digital outputs, PWM, analog inputs.

Each object is made by `pins.setup_pin(TYPE, ...)` while the config is read, gets its `setup_…` calls, and adds its
commands when the MCU is configured. Values are set with the print time at which they hold; the MCU queues them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Any

import pins

from .mcu_homing import MCU_endstop, TriggerDispatch
from .plugin_trsync import MCU_trsync
from .roles import Mcu

__all__ = ["MCU_adc", "MCU_digital_out", "MCU_endstop", "MCU_pwm", "MCU_trsync", "TriggerDispatch"]

MAX_DURATION_DEFAULT_S = 2.0
CYCLE_TIME_DEFAULT_S = 0.100
MAX_TICKS = 2**31 - 1  # the farthest a 32-bit clock can be scheduled ahead
ADC_REPORT_BYTES = 2  # one sum of samples, 16 bits, low byte first
QUERY_ANALOG = (
    "query_analog_in oid={} clock={} sample_ticks={} sample_count={} rest_ticks={}"
    f" bytes_per_report={ADC_REPORT_BYTES}"
    " min_value={} max_value={} range_check_count={}"
)
# Firmware before 2025 (and Kalico's) has neither `bytes_per_report` nor several values to a report.
QUERY_ANALOG_SINGLE = (
    "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u"
    " min_value=%hu max_value=%hu range_check_count=%c"
)
QUERY_ANALOG_SINGLE_FILLED = (
    "query_analog_in oid={} clock={} sample_ticks={} sample_count={} rest_ticks={}"
    " min_value={} max_value={} range_check_count={}"
)


def _duration_ticks(mcu: Mcu, pin: str, duration_s: float) -> int:
    ticks = mcu.seconds_to_clock(duration_s)
    if ticks > MAX_TICKS:
        raise pins.error(
            f"Pin {pin} of mcu '{mcu.get_name()}': a duration of {duration_s} s is too long for its clock."
        )
    return ticks


class MCU_digital_out:
    """An on/off output. With a max_duration it falls back to its shutdown value (a shutdown) when not refreshed."""

    def __init__(self, mcu: Mcu, pin_params: dict[str, Any]) -> None:
        self._mcu = mcu
        self._pin: str = pin_params["pin"]
        self._invert = int(pin_params["invert"])
        self._start_value = self._shutdown_value = self._invert
        self._max_duration_s = MAX_DURATION_DEFAULT_S
        self._oid = mcu.create_oid()
        self._last_clock = 0
        self._last_value: int | None = None
        self._set: Any = None
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Mcu:
        return self._mcu

    def setup_max_duration(self, max_duration: float) -> None:
        """Longest time (s) without a refresh while not at the shutdown value; 0: no limit."""
        self._max_duration_s = max_duration

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        """Value at start, and value in shutdown."""
        self._start_value = int(bool(start_value)) ^ self._invert
        self._shutdown_value = int(bool(shutdown_value)) ^ self._invert

    def _build_config(self) -> None:
        mcu, oid = self._mcu, self._oid
        if self._max_duration_s and self._start_value != self._shutdown_value:
            raise pins.error(
                f"Pin {self._pin} with max duration must have start value equal to shutdown value."
            )
        mcu.request_move_queue_slot()
        mcu.add_config_cmd(
            f"config_digital_out oid={oid} pin={self._pin} value={self._start_value}"
            f" default_value={self._shutdown_value}"
            f" max_duration={_duration_ticks(mcu, self._pin, self._max_duration_s)}"
        )
        mcu.add_config_cmd(f"update_digital_out oid={oid} value={self._start_value}", on_restart=True)
        if self._last_value is not None:  # the board was absent
            mcu.add_config_cmd(f"update_digital_out oid={oid} value={self._last_value}", is_init=True)
        self._last_clock = 0
        self._set = mcu.lookup_command(
            "queue_digital_out oid=%c clock=%u on_ticks=%u", cq=mcu.alloc_command_queue()
        )

    def set_digital(self, print_time: float, value: int) -> None:
        """The value from print_time on; times must not decrease."""
        clock = self._mcu.print_time_to_clock(print_time)
        on_ticks = int(bool(value)) ^ self._invert
        self._set.send([self._oid, clock, on_ticks], minclock=self._last_clock, reqclock=clock)
        self._last_clock, self._last_value = clock, on_ticks


class MCU_pwm:
    """A duty cycle from 0 to 1, by the MCU's timer hardware or by its software."""

    def __init__(self, mcu: Mcu, pin_params: dict[str, Any]) -> None:
        self._mcu = mcu
        self._pin: str = pin_params["pin"]
        self._invert = bool(pin_params["invert"])
        self._start_value = self._shutdown_value = float(self._invert)
        self._max_duration_s = MAX_DURATION_DEFAULT_S
        self._cycle_time_s = CYCLE_TIME_DEFAULT_S
        self._hardware_pwm = False
        self._oid = mcu.create_oid()
        self._pwm_max = 0.0  # value of a duty cycle of 1, in what the command takes
        self._start_clock = 0  # of the start value, if that was sent as a queued command
        self._clocks = deque([0], maxlen=1)  # of the last values
        self._last_duty: float | None = None
        self._set: Any = None
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Mcu:
        return self._mcu

    def setup_max_duration(self, max_duration: float) -> None:
        """Longest time (s) without a refresh while not at the shutdown value; 0: no limit."""
        self._max_duration_s = max_duration

    def setup_cycle_time(self, cycle_time: float, hardware_pwm: bool = False) -> None:
        """Period of the PWM (s), and whether the timer hardware makes it."""
        self._cycle_time_s = cycle_time
        self._hardware_pwm = hardware_pwm

    def setup_waiting(self, count: int) -> None:
        """Number of values that may wait on the MCU for their time."""
        self._clocks = deque([0] * count, maxlen=count)

    def setup_start_value(self, start_value: float, shutdown_value: float) -> None:
        """Duty cycle at start, and in shutdown."""
        self._start_value = self._duty(start_value)
        self._shutdown_value = self._duty(shutdown_value)

    def _duty(self, value: float) -> float:
        value = max(0.0, min(1.0, value))
        return 1.0 - value if self._invert else value

    def _raw(self, duty: float) -> int:
        return int(duty * self._pwm_max + 0.5)

    def _build_config(self) -> None:
        mcu = self._mcu
        if self._max_duration_s and self._start_value != self._shutdown_value:
            raise pins.error(
                f"Pin {self._pin} with max duration must have start value equal to shutdown value."
            )
        for _ in self._clocks:
            mcu.request_move_queue_slot()
        cycle_ticks = _duration_ticks(mcu, self._pin, self._cycle_time_s)
        max_ticks = _duration_ticks(mcu, self._pin, self._max_duration_s)
        # The clock is chosen once at each start: it must not be in the configuration's CRC.
        self._start_clock = mcu.get_query_slot(self._oid)
        self._clocks = deque([0] * len(self._clocks), maxlen=len(self._clocks))
        if self._hardware_pwm:
            self._build_hardware(cycle_ticks, max_ticks)
        else:
            self._build_software(cycle_ticks, max_ticks)

    def _build_hardware(self, cycle_ticks: int, max_ticks: int) -> None:
        mcu, oid = self._mcu, self._oid
        self._pwm_max = mcu.get_constant_float("PWM_MAX")
        mcu.add_config_cmd(
            f"config_pwm_out oid={oid} pin={self._pin} cycle_ticks={cycle_ticks} value={self._raw(self._start_value)}"
            f" default_value={self._raw(self._shutdown_value)} max_duration={max_ticks}"
        )
        self._set = mcu.lookup_command(
            "queue_pwm_out oid=%c clock=%u value=%hu", cq=mcu.alloc_command_queue()
        )
        raw, is_back = self._raw(self._first_duty()), self._last_duty is not None
        mcu.add_config_cmd(
            f"queue_pwm_out oid={oid} clock={self._start_clock} value={raw}",
            is_init=is_back,
            on_restart=not is_back,
        )

    def _build_software(self, cycle_ticks: int, max_ticks: int) -> None:
        mcu, oid = self._mcu, self._oid
        if self._shutdown_value not in (0.0, 1.0):
            raise pins.error(f"Pin {self._pin}: the shutdown value of software pwm must be 0 or 1.")
        self._pwm_max = float(cycle_ticks)
        mcu.add_config_cmd(
            f"config_digital_out oid={oid} pin={self._pin} value={int(self._start_value >= 1.0)}"
            f" default_value={int(self._shutdown_value >= 0.5)} max_duration={max_ticks}"
        )
        mcu.add_config_cmd(f"set_digital_out_pwm_cycle oid={oid} cycle_ticks={cycle_ticks}")
        self._set = mcu.lookup_command(
            "queue_digital_out oid=%c clock=%u on_ticks=%u", cq=mcu.alloc_command_queue()
        )
        by_queue = self._starts_by_queue() or self._last_duty is not None
        mcu.add_config_cmd(
            f"queue_digital_out oid={oid} clock={self._start_clock} on_ticks={self._raw(self._first_duty())}",
            is_init=by_queue,
            on_restart=not by_queue,
        )

    def _first_duty(self) -> float:
        """At a start, or when a board that was absent is back."""
        return self._start_value if self._last_duty is None else self._last_duty

    def _starts_by_queue(self) -> bool:
        """config_digital_out can only set on or off."""
        return not self._hardware_pwm and 0.0 < self._start_value < 1.0

    def set_pwm(self, print_time: float, value: float) -> None:
        """The duty cycle from print_time on; times must not decrease."""
        clock = self._mcu.print_time_to_clock(print_time)
        if not self._clocks[-1] and (
            self._starts_by_queue() or self._last_duty is not None or self._mcu.kept_configuration()
        ):
            clock = max(clock, self._start_clock + 1)
        self._last_duty = self._duty(value)
        data = [self._oid, clock, self._raw(self._last_duty)]
        self._set.send(data, minclock=self._clocks[0], reqclock=clock)
        self._clocks.append(clock)


class MCU_adc:
    """An analog input: sums of `sample_count` conversions, reported every `report_time`."""

    def __init__(self, mcu: Mcu, pin_params: dict[str, Any]) -> None:
        self._mcu = mcu
        self._pin: str = pin_params["pin"]
        self._oid = -1
        self._sample_time_s = 0.0
        self._sample_count = 0  # 0: not set up, the pin is not used
        self._range = (0.0, 1.0)
        self._range_check_count = 0
        self._report_time_s = 0.0
        self._report_ticks = 0
        self._full_scale = 1.0
        self._callback: Callable[[float, float], None] | None = None
        self._last_state = (0.0, 0.0)
        mcu.register_config_callback(self._build_config)

    def get_mcu(self) -> Mcu:
        return self._mcu

    def get_oid(self) -> int:
        """The oid, for units on the MCU that listen to this input; valid from the config callbacks on."""
        if self._oid < 0:
            self._oid = self._mcu.create_oid()
        return self._oid

    def get_full_scale(self) -> float:
        """What a value of 1.0 is on the wire."""
        return self._mcu.get_constant_float("ADC_MAX") * max(1, self._sample_count)

    def setup_adc_sample(
        self, sample_time: float, sample_count: int, minval: float = 0.0, maxval: float = 1.0,
        range_check_count: int = 0,
    ) -> None:  # fmt: skip
        """`sample_count` conversions `sample_time` s apart. Outside minval..maxval (0..1) this many times in a row
        the MCU shuts down; 0: it never does."""
        self._sample_time_s, self._sample_count = sample_time, sample_count
        self._range, self._range_check_count = (minval, maxval), range_check_count

    def setup_adc_callback(self, report_time: float, callback: Callable[[float, float], None]) -> None:
        """`callback(print_time, value)` every report_time s, value 0..1."""
        self._report_time_s, self._callback = report_time, callback

    def get_last_value(self) -> tuple[float, float]:
        """(value 0..1, print time) of the last report."""
        return self._last_state

    def _build_config(self) -> None:
        mcu = self._mcu
        if not self._sample_count:
            return
        self._full_scale = mcu.get_constant_float("ADC_MAX") * self._sample_count
        if self._full_scale > 0xFFFF:
            raise pins.error(
                f"Pin {self._pin}: the sum of {self._sample_count} samples does not fit 16 bits."
            )
        oid = self.get_oid()
        mcu.add_config_cmd(f"config_analog_in oid={oid} pin={self._pin}")
        self._report_ticks = mcu.seconds_to_clock(self._report_time_s)
        low = max(0, min(0xFFFF, int(self._range[0] * self._full_scale)))
        high = max(0, min(0xFFFF, math.ceil(self._range[1] * self._full_scale)))
        when = (mcu.get_query_slot(oid), mcu.seconds_to_clock(self._sample_time_s), self._sample_count)
        values = (oid, *when, self._report_ticks, low, high, self._range_check_count)
        if mcu.try_lookup_command(QUERY_ANALOG_SINGLE) is None:
            mcu.add_config_cmd(QUERY_ANALOG.format(*values), is_init=True)
        else:
            mcu.add_config_cmd(QUERY_ANALOG_SINGLE_FILLED.format(*values), is_init=True)
        mcu.register_response(self._on_report, "analog_in_state", oid)

    def _on_report(self, params: dict[str, Any]) -> None:
        total = params.get("value")
        if total is None:
            values = params["values"]
            if len(values) < ADC_REPORT_BYTES:
                return
            total = int.from_bytes(values[-ADC_REPORT_BYTES:], "little")
        value = total / self._full_scale
        # next_clock is when the next sampling starts: one report time after this one did
        clock = self._mcu.clock32_to_clock64(params["next_clock"]) - self._report_ticks
        print_time = self._mcu.clock_to_print_time(clock)
        self._last_state = (value, print_time)
        if self._callback is not None:
            self._callback(print_time, value)
