"""Counting pulses on a pin: `MCU_counter` (the firmware's counter), `FrequencyCounter`, and `Tachometer` of a fan.

The firmware counts every edge, two a pulse. Each sample_time it reports the count and the clock of the last edge.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from configfile import ConfigWrapper
from roles import Printer

SAMPLE_TIME_S = 1.0


class MCU_counter:
    """Edges on one pin, reported every `sample_time` s; the pin is read every `poll_time` s."""

    def __init__(self, printer: Printer, pin: str, sample_time: float, poll_time: float) -> None:
        params = printer.lookup_object("pins").lookup_pin(pin, can_pullup=True)
        self._mcu = mcu = params["chip"]
        self._pin = params["pin"]
        self._pullup = params["pullup"]
        self._sample_time_s, self._poll_time_s = sample_time, poll_time
        self._callback: Callable[[float, int, float], None] | None = None
        self._last_count = 0
        self._oid = mcu.create_oid()
        mcu.register_config_callback(self._build_config)

    def _build_config(self) -> None:
        mcu, oid = self._mcu, self._oid
        mcu.add_config_cmd(f"config_counter oid={oid} pin={self._pin} pull_up={self._pullup}")
        mcu.add_config_cmd(
            f"query_counter oid={oid} clock={mcu.get_query_slot(oid)}"
            f" poll_ticks={mcu.seconds_to_clock(self._poll_time_s)}"
            f" sample_ticks={mcu.seconds_to_clock(self._sample_time_s)}",
            is_init=True,
        )
        mcu.register_response(self._on_state, "counter_state", oid)

    def setup_callback(self, cb: Callable[[float, int, float], None]) -> None:
        """cb(print time of the report, running count, print time of the last edge counted)."""
        self._callback = cb

    def _on_state(self, params: dict[str, Any]) -> None:
        mcu = self._mcu
        next_clock = mcu.clock32_to_clock64(params["next_clock"])
        time_s = mcu.clock_to_print_time(next_clock - mcu.seconds_to_clock(self._sample_time_s))
        count_time_s = mcu.clock_to_print_time(mcu.clock32_to_clock64(params["count_clock"]))
        self._last_count += (params["count"] - self._last_count) & 0xFFFFFFFF  # the MCU's count has 32 bits
        if self._callback is not None:
            self._callback(time_s, self._last_count, count_time_s)


class FrequencyCounter:
    """Edges a second on one pin."""

    def __init__(self, printer: Printer, pin: str, sample_time: float, poll_time: float) -> None:
        self._frequency_hz = 0.0
        self._last: tuple[int, float] | None = None  # count and time of its last edge
        self._counter = MCU_counter(printer, pin, sample_time, poll_time)
        self._counter.setup_callback(self._on_count)

    def _on_count(self, time_s: float, count: int, count_time_s: float) -> None:
        if self._last is not None:
            edges, elapsed_s = count - self._last[0], count_time_s - self._last[1]
            self._frequency_hz = edges / elapsed_s if edges > 0 and elapsed_s > 0.0 else 0.0
        self._last = (count, count_time_s)

    def get_frequency(self) -> float:
        """Edges a second over the last sample; 0 when there was none."""
        return self._frequency_hz


class Tachometer:
    """Speed of a fan in revolutions a minute."""

    def __init__(self, printer: Printer, pin: str, pulses_per_revolution: int, poll_time: float) -> None:
        self._counter = FrequencyCounter(printer, pin, SAMPLE_TIME_S, poll_time)
        self._edges_per_revolution = 2 * pulses_per_revolution

    def get_status(self, eventtime: float) -> dict[str, float]:
        return {"rpm": 60.0 * self._counter.get_frequency() / self._edges_per_revolution}


def tachometer_from_config(config: ConfigWrapper) -> Tachometer | None:
    """By the options tachometer_pin, tachometer_ppr, tachometer_poll_interval; None without a pin."""
    pin = config.get("tachometer_pin", None)
    if pin is None:
        return None
    pulses = config.getint("tachometer_ppr", 2, minval=1)
    poll_time_s = config.getfloat("tachometer_poll_interval", 0.0015, above=0.0, maxval=1.0)
    return Tachometer(config.get_printer(), pin, pulses, poll_time_s)
