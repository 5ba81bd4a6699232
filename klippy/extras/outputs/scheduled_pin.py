"""Time-stamped values for one output pin: never denser than the MCU can take them, or in a queue on the MCU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from link import optional_board
from roles import Printer

MIN_GAP_S = 0.1  # between two values: an MCU keeps one value waiting per pin
LEAD_S = 0.25  # a held-back value is sent that long before it is due
RESEND_SHARE = 0.5  # of the pin's maximum duration: refresh well before the MCU's own time-out


class ScheduledPin:
    """Sends `apply(print_time, value)` in order of print time; a value overtaken by the next one is dropped."""

    def __init__(
        self, printer: Printer, mcu: Any, apply: Callable[[float, float], None], initial: float
    ) -> None:
        self._printer = printer
        self._reactor = printer.get_reactor()
        self._mcu = mcu
        self._apply = apply
        self.last_value = initial
        self._resting_value = initial
        self._last_time = 0.0
        self._pending: tuple[float, float] | None = None
        self._max_duration_s = 0.0
        self._timer = self._reactor.register_timer(self._handle_timer)

    def keep_alive(self, max_duration_s: float, resting_value: float) -> None:
        """Repeat values other than `resting_value`, for an MCU that switches off after `max_duration_s`."""
        self._max_duration_s, self._resting_value = max_duration_s, resting_value

    def request(self, print_time: float, value: float) -> None:
        """Set the pin to `value` at `print_time`. Times must not go back."""
        if self._pending is not None and print_time >= self._pending[0]:
            self._flush()
        self._pending = None
        if value == self.last_value:
            return
        earliest = self._last_time + MIN_GAP_S if self._last_time else print_time
        if print_time >= earliest:
            self._send(print_time, value)
            return
        self._pending = (earliest, value)
        self._reactor.update_timer(self._timer, self._reactor.NOW)

    def queue_from_command(self, value: float) -> None:
        """Set the pin in step with the moves queued so far."""
        optional_board.require_connected(self._mcu)
        toolhead = self._printer.lookup_object("toolhead")
        toolhead.register_lookahead_callback(lambda print_time: self.request(print_time, value))

    def set_now(self, value: float) -> None:
        """Set the pin as soon as the MCU can, whatever moves are queued."""
        now = self._mcu.estimated_print_time(self._reactor.monotonic())
        self.request(now + LEAD_S, value)

    def _send(self, print_time: float, value: float) -> None:
        self._apply(print_time, value)
        self._last_time, self.last_value = print_time, value
        if self._max_duration_s and value != self._resting_value:
            self._reactor.update_timer(self._timer, self._reactor.NOW)

    def _flush(self) -> None:
        if self._pending is not None:
            due, value = self._pending
            self._pending = None
            self._send(due, value)

    def _handle_timer(self, eventtime: float) -> float:
        if self._printer.is_shutdown():
            return float(self._reactor.NEVER)
        now = self._mcu.estimated_print_time(eventtime)
        if self._pending is not None:
            wait_s = self._pending[0] - now - LEAD_S
            if wait_s > 0.0:
                return eventtime + wait_s
            due, value = self._pending
            self._pending = (max(due, now + MIN_GAP_S), value)
            self._flush()
        if not self._max_duration_s or self.last_value == self._resting_value:
            return float(self._reactor.NEVER)
        refresh_s = self._max_duration_s * RESEND_SHARE
        if now + LEAD_S >= self._last_time + refresh_s:
            self._last_time = now + LEAD_S
            self._apply(self._last_time, self.last_value)
        return eventtime + self._last_time + refresh_s - LEAD_S - now


class QueuedPin(ScheduledPin):
    """Values as dense as they come, for a pin on which several may wait on the MCU. None is dropped."""

    def request(self, print_time: float, value: float) -> None:
        if value == self.last_value:
            return
        print_time = max(print_time, self._last_time)
        step_s = self._max_duration_s * RESEND_SHARE
        # the MCU switches off if the next value it knows of is too late
        while step_s and self.last_value != self._resting_value and print_time - self._last_time > step_s:
            self._last_time += step_s
            self._apply(self._last_time, self.last_value)
        self._send(print_time, value)
