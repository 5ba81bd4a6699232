"""Relation between the host's clock and the clocks of the MCUs.

Three time lines:

- *system time* t: the reactor's clock, seconds
- *MCU clock* c: ticks of one MCU, 64 bits here, the low 32 on the wire
- *print time* p: seconds of the first MCU's clock at its nominal frequency; motion is planned in it

How the line between t and c is found from the answers to `get_clock`: clockfit.py. With one MCU it is only needed to
time what the host sends, and one question a second does. With several, their steps must fall on the same instant. All
of them are asked more often: the fastest answers of the last minute fix the line to a few microseconds.

`SecondarySync` lets another MCU follow print time: its line from print time to clock is bent at each calibration
so that it stays continuous and meets the true relation a few seconds later.
"""

from __future__ import annotations

import math
from typing import Any

from link.clockfit import ClockEstimator, ClockLine, ClockSample, fit_clock_line
from reactor import Reactor
from serialhdl import SerialReader

__all__ = ["ClockEstimator", "ClockLine", "ClockSample", "ClockSync", "SecondarySync", "fit_clock_line"]

FIRST_SAMPLES = 8
FIRST_SAMPLE_PERIOD_S = 0.050
SAMPLE_PERIOD_S = 0.97  # not 1.0: must not lock to things that happen once a second
# With several MCUs: (until this age in s, ask that often); at the end some 200 byte/s in each direction
SHARED_PERIODS = ((12.0, 0.0193), (30.0, 0.0487), (math.inf, 0.0973))
LEARN_S = 8.0  # for this long the lines still change much
SILENCE_MAX_S = 4.0  # this long without an answer: communication is lost

MEET_TIME_S = 4.0  # a secondary MCU meets its true clock this long after a calibration
LEARN_MEET_TIME_S = 1.0  # ... while its line still changes much
IDLE_BEND_S = 0.25  # while nothing moves, this long after the last calibration the next one is made


class ClockSync:
    """Keeps the clock of one MCU related to system time; print time of this MCU is clock / nominal frequency."""

    def __init__(self, reactor: Reactor) -> None:
        self.reactor = reactor
        self.mcu_freq = 1.0
        self._estimator = ClockEstimator(1.0)
        self._serial: SerialReader | None = None
        self._timer = reactor.register_timer(self._ask_clock)
        self._cmd_queue: Any = None
        self._get_clock = b""
        self._asked_s = 0.0  # time of the first question since the last answer; 0: none is open
        self._silence_s = 0.0  # since then
        self._is_shared = False  # several MCUs must agree
        self._shared_from_s = 0.0
        self._next_try_s = 0.0
        self._last_clock = 0
        self._is_file = False

    # --- connecting ---

    def connect(self, serial: SerialReader) -> None:
        """Learn uptime and a first estimate (0.4 s), then keep asking about once a second."""
        self._serial = serial
        parser = serial.get_msgparser()
        self.mcu_freq = parser.get_constant_float("CLOCK_FREQ")
        self._estimator = ClockEstimator(self.mcu_freq)
        uptime = serial.send_with_response("get_uptime", "uptime")
        self._last_clock = uptime["high"] << 32 | uptime["clock"]
        self._get_clock = parser.create_command("get_clock")
        self._cmd_queue = serial.alloc_command_queue()
        for _ in range(FIRST_SAMPLES):
            self._take_sample(serial.query(self._get_clock, "clock", cmd_queue=self._cmd_queue))
            self.reactor.pause(self.reactor.monotonic() + FIRST_SAMPLE_PERIOD_S)
        serial.register_response(self._on_clock, "clock")
        self._asked_s = self._silence_s = 0.0
        self.reactor.update_timer(self._timer, self.reactor.NOW)

    def connect_file(self, serial: SerialReader) -> None:
        """Batch mode: no MCU answers; time stands still at print time 0 so that the output never varies."""
        self._serial = serial
        self._is_file = True
        self.mcu_freq = serial.get_msgparser().get_constant_float("CLOCK_FREQ")
        self._estimator = ClockEstimator(self.mcu_freq)

    def disconnect(self) -> None:
        """Stop asking the MCU."""
        self.reactor.update_timer(self._timer, self.reactor.NEVER)

    # --- sampling ---

    def share(self) -> None:
        """From now on another MCU must agree with this one: ask often."""
        self._is_shared = True
        self._shared_from_s = self.reactor.monotonic()
        if not self._is_file:
            self.reactor.update_timer(self._timer, self.reactor.NOW)

    def _period_s(self, eventtime: float) -> float:
        if not self._is_shared:
            return SAMPLE_PERIOD_S
        age_s = eventtime - self._shared_from_s
        return next(period_s for until_s, period_s in SHARED_PERIODS if age_s < until_s)

    def _ask_clock(self, eventtime: float) -> float:
        if self._serial is None:
            return self.reactor.NEVER
        if self._asked_s:
            self._silence_s = eventtime - self._asked_s
        if self._silence_s < SAMPLE_PERIOD_S or eventtime >= self._next_try_s:
            # a line that is busy with retransmissions is not asked twenty times a second
            self._next_try_s = eventtime + SAMPLE_PERIOD_S
            self._asked_s = self._asked_s or eventtime
            self._serial.raw_send(self._get_clock, 0, 0, self._cmd_queue)
        return eventtime + self._period_s(eventtime)

    def _on_clock(self, params: dict[str, Any]) -> None:
        self._asked_s = self._silence_s = 0.0
        self._take_sample(params)

    def _take_sample(self, params: dict[str, Any]) -> None:
        # answers keep their order and come often: the clock has run forward by less than 32 bits
        clock = self._last_clock + (params["clock"] - self._last_clock & 0xFFFFFFFF)
        self._last_clock = clock
        if not params["#sent_time"]:
            return  # sent more than once: which one this answers is unknown
        line = self._estimator.add(ClockSample(params["#sent_time"], params["#receive_time"], clock))
        assert self._serial is not None
        self._serial.set_clock_est(line.freq, line.time_s, int(line.clock))

    # --- conversions ---

    @property
    def line(self) -> ClockLine:
        return self._estimator.line

    def print_time_to_clock(self, print_time: float) -> int:
        return int(print_time * self.mcu_freq)

    def clock_to_print_time(self, clock: float) -> float:
        return clock / self.mcu_freq

    def get_clock(self, eventtime: float) -> int:
        """Estimated clock at a system time; 0 in batch mode."""
        line = self._estimator.line
        return 0 if self._is_file else int(line.clock + (eventtime - line.time_s) * line.freq)

    def dated(self, eventtime: float) -> tuple[int, float, float]:
        """Estimated clock at a system time, its print time, and the seconds of a tick there."""
        clock = self.get_clock(eventtime)
        return clock, clock / self.mcu_freq, 1.0 / self.mcu_freq

    def estimate_clock_systime(self, reqclock: int) -> float:
        """System time at which the MCU's clock reaches `reqclock`."""
        return self._estimator.line.time_of(reqclock)

    def estimated_print_time(self, eventtime: float) -> float:
        return self.clock_to_print_time(self.get_clock(eventtime))

    def reported_print_time(self) -> float:
        """Print time that the MCU has reached for certain: that of its last answer."""
        return self.clock_to_print_time(self._last_clock)

    def clock32_to_clock64(self, clock32: int) -> int:
        """The 64-bit clock nearest to the last one known (within 2**31 ticks) that has these low 32 bits."""
        difference = (clock32 - self._last_clock) & 0xFFFFFFFF
        if difference & 0x80000000:
            difference -= 1 << 32
        return self._last_clock + difference

    def is_active(self) -> bool:
        """False when the MCU has stopped answering."""
        return self._is_file or self._silence_s <= SILENCE_MAX_S

    def calibrate_clock(self, print_time: float, eventtime: float) -> tuple[float, float]:
        """(offset_s, freq) with clock = (print time - offset_s) * freq. Print time is this MCU's own: never bent."""
        return 0.0, self.mcu_freq

    # --- reports ---

    def stats(self, eventtime: float) -> str:
        return f"freq={self._estimator.line.freq:.0f}"

    def dump_debug(self) -> str:
        line = self._estimator.line
        return (
            f"clocksync: time={line.time_s:.6f} clock={line.clock:.0f} freq={line.freq:.3f}"
            f" nominal={self.mcu_freq:.0f} shortest_round_trip={self._estimator.shortest_round_trip_s:.6f}"
            f" silence={self._silence_s:.3f} last_clock={self._last_clock}"
        )


class SecondarySync(ClockSync):
    """A further MCU that follows the print time of the first one although their clocks drift."""

    def __init__(self, reactor: Reactor, main_sync: ClockSync) -> None:
        super().__init__(reactor)
        self._main_sync = main_sync
        self._offset_s, self._adjusted_freq = 0.0, 1.0
        self._bend_time = 0.0  # print time of the last calibration

    def connect(self, serial: SerialReader) -> None:
        self._main_sync.share()
        super().connect(serial)
        self.share()
        # start on the true relation: now, and with the slope of both fitted lines
        now = self.reactor.monotonic()
        print_time = self._main_sync.clock_to_print_time(self._main_sync.line.clock_at(now))
        clock = self.line.clock_at(now)
        self._adjusted_freq = self.line.freq / (self._main_sync.line.freq / self._main_sync.mcu_freq)
        self._offset_s = print_time - clock / self._adjusted_freq

    def connect_file(self, serial: SerialReader) -> None:
        super().connect_file(serial)
        self._adjusted_freq = self.mcu_freq

    def print_time_to_clock(self, print_time: float) -> int:
        return int((print_time - self._offset_s) * self._adjusted_freq)

    def clock_to_print_time(self, clock: float) -> float:
        return clock / self._adjusted_freq + self._offset_s

    def dated(self, eventtime: float) -> tuple[int, float, float]:
        clock = self.get_clock(eventtime)
        return clock, self.clock_to_print_time(clock), 1.0 / self._adjusted_freq

    def _true_clock(self, print_time: float) -> float:
        system_s = self._main_sync.estimate_clock_systime(self._main_sync.print_time_to_clock(print_time))
        return self.line.clock_at(system_s)

    def calibrate_clock(self, print_time: float, eventtime: float) -> tuple[float, float]:
        """Bend the line at `print_time` (all before it is already on its way) to meet the truth seconds later.

        Returns (offset_s, freq) with clock = (print time - offset_s) * freq from then on.
        """
        if self._is_file:
            return self._offset_s, self._adjusted_freq
        bend_time = max(print_time, self._main_sync.estimated_print_time(eventtime))
        self._bend_time = bend_time
        bend_clock = (bend_time - self._offset_s) * self._adjusted_freq
        is_learning = eventtime - self._shared_from_s < LEARN_S
        meet_s = LEARN_MEET_TIME_S if is_learning else MEET_TIME_S
        self._adjusted_freq = (self._true_clock(bend_time + meet_s) - bend_clock) / meet_s
        self._offset_s = bend_time - bend_clock / self._adjusted_freq
        return self._offset_s, self._adjusted_freq

    def _on_clock(self, params: dict[str, Any]) -> None:
        super()._on_clock(params)
        # nothing moves: without calibrations both clocks would have drifted apart by the next motion
        eventtime = self.reactor.monotonic()
        print_time = self._main_sync.estimated_print_time(eventtime)
        if print_time > self._bend_time + IDLE_BEND_S:
            self.calibrate_clock(print_time, eventtime)

    def stats(self, eventtime: float) -> str:
        return f"{super().stats(eventtime)} adj={self._adjusted_freq:.0f}"

    def dump_debug(self) -> str:
        return f"{super().dump_debug()} offset={self._offset_s:.6f} adjusted_freq={self._adjusted_freq:.3f}"
