"""Relation between the host's clock and the clocks of the MCUs.

Three time lines:

- *system time* t: the reactor's clock, seconds
- *MCU clock* c: ticks of one MCU, 64 bits here, the low 32 on the wire
- *print time* p: seconds of the first MCU's clock at its nominal frequency; motion is planned in it

One `get_clock` gives a clock value that was taken between sending and receiving, so its system time is the middle
give or take half the round trip. With x the age of a sample and y = c/f_nominal - t (s), the model is a straight line
y = a + e*x: offset a and frequency error e. `ClockEstimator` fits it by weighted least squares. A sample's standard
deviation grows with the excess of its round trip over the shortest seen, so samples that met no queue decide; e has a
prior at the tolerance of crystals, which bridges the first seconds. The line through the last minute is accurate to
microseconds where single samples are good to a millisecond only.

`SecondarySync` lets another MCU follow print time: its line from print time to clock is bent at each calibration
so that it stays continuous and meets the true relation a few seconds later.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from reactor import Reactor
from serialhdl import SerialReader

FIRST_SAMPLES = 8
FIRST_SAMPLE_PERIOD_S = 0.050
SAMPLE_PERIOD_S = 0.97  # not 1.0: must not lock to things that happen once a second
UNANSWERED_MAX = 4  # this many requests without an answer: communication is lost

WINDOW_SAMPLES = 48
CRYSTAL_SIGMA = (
    100e-6  # frequency error of an MCU's clock source (ceramic resonators: 0.5 %, learnt in a second)
)
SAMPLE_SIGMA_S = 4e-6  # a sample with the shortest round trip: jitter of interrupts on both sides
DRIFT_SIGMA_PER_S = 2e-7  # how far temperature drift makes a sample of age 1 s wrong (s per s)

MEET_TIME_S = 4.0  # a secondary MCU meets its true clock this long after a calibration


@dataclass(frozen=True, slots=True)
class ClockSample:
    """One answered get_clock, times in system seconds."""

    sent_s: float
    received_s: float
    clock: int

    @property
    def round_trip_s(self) -> float:
        return max(0.0, self.received_s - self.sent_s)

    @property
    def middle_s(self) -> float:
        return 0.5 * (self.sent_s + self.received_s)


@dataclass(frozen=True, slots=True)
class ClockLine:
    """clock = clock_0 + (system time - time_s) * freq."""

    time_s: float
    clock: float
    freq: float

    def clock_at(self, time_s: float) -> float:
        return self.clock + (time_s - self.time_s) * self.freq

    def time_of(self, clock: float) -> float:
        return self.time_s + (clock - self.clock) / self.freq


def fit_clock_line(samples: Iterable[ClockSample], nominal_freq: float) -> ClockLine:
    """Weighted least squares over samples (oldest first, at least one) with a prior on the frequency error."""
    points = list(samples)
    last = points[-1]
    shortest_s = min(p.round_trip_s for p in points)
    # y relative to the last sample keeps the figures small (64-bit clocks do not fit a double's ns)
    sum_w = sum_x = sum_y = sum_xx = sum_xy = 0.0
    for p in points:
        x = p.middle_s - last.middle_s
        y = (p.clock - last.clock) / nominal_freq - x
        sigma_s = SAMPLE_SIGMA_S + 0.5 * (p.round_trip_s - shortest_s) + DRIFT_SIGMA_PER_S * -x
        w = 1.0 / (sigma_s * sigma_s)
        sum_w += w
        sum_x += w * x
        sum_y += w * y
        sum_xx += w * x * x
        sum_xy += w * x * y
    sum_xx += 1.0 / CRYSTAL_SIGMA**2  # the prior: e = 0 +- CRYSTAL_SIGMA
    determinant = sum_w * sum_xx - sum_x * sum_x
    offset_s = (sum_y * sum_xx - sum_xy * sum_x) / determinant
    freq_error = (sum_w * sum_xy - sum_x * sum_y) / determinant
    return ClockLine(last.middle_s, last.clock + offset_s * nominal_freq, nominal_freq * (1.0 + freq_error))


class ClockEstimator:
    """The samples of the last minute and the line through them. Pure: told times and clocks, asks nobody."""

    def __init__(self, nominal_freq: float) -> None:
        self.nominal_freq = nominal_freq
        self.line = ClockLine(0.0, 0.0, nominal_freq)
        self._samples: deque[ClockSample] = deque(maxlen=WINDOW_SAMPLES)

    def add(self, sample: ClockSample) -> ClockLine:
        self._samples.append(sample)
        self.line = fit_clock_line(self._samples, self.nominal_freq)
        return self.line

    @property
    def shortest_round_trip_s(self) -> float:
        return min((s.round_trip_s for s in self._samples), default=0.0)


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
        self._unanswered = 0
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
        self._unanswered = 0
        self.reactor.update_timer(self._timer, self.reactor.NOW)

    def connect_file(self, serial: SerialReader, pace: bool = False) -> None:
        """Batch mode: no MCU answers; time stands still at print time 0 so that the output never varies."""
        self._serial = serial
        self._is_file = True
        self.mcu_freq = serial.get_msgparser().get_constant_float("CLOCK_FREQ")
        self._estimator = ClockEstimator(self.mcu_freq)

    def disconnect(self) -> None:
        """Ask no more."""
        self.reactor.update_timer(self._timer, self.reactor.NEVER)

    # --- sampling ---

    def _ask_clock(self, eventtime: float) -> float:
        assert self._serial is not None
        self._unanswered += 1
        self._serial.raw_send(self._get_clock, 0, 0, self._cmd_queue)
        return eventtime + SAMPLE_PERIOD_S

    def _on_clock(self, params: dict[str, Any]) -> None:
        self._unanswered = 0
        self._take_sample(params)

    def _take_sample(self, params: dict[str, Any]) -> None:
        # answers keep their order and come often: the clock has run forward by less than 32 bits
        clock = self._last_clock + (params["clock"] - self._last_clock & 0xFFFFFFFF)
        self._last_clock = clock
        if not params["#sent_time"]:
            return  # sent more than once: nobody knows which one this answers
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
        return 0 if self._is_file else int(self._estimator.line.clock_at(eventtime))

    def estimate_clock_systime(self, reqclock: int) -> float:
        """System time at which the MCU's clock reaches `reqclock`."""
        return self._estimator.line.time_of(reqclock)

    def estimated_print_time(self, eventtime: float) -> float:
        return self.clock_to_print_time(self.get_clock(eventtime))

    def clock32_to_clock64(self, clock32: int) -> int:
        """The 64-bit clock nearest to the last one known (within 2**31 ticks) that has these low 32 bits."""
        difference = (clock32 - self._last_clock) & 0xFFFFFFFF
        if difference & 0x80000000:
            difference -= 1 << 32
        return self._last_clock + difference

    def is_active(self) -> bool:
        """False when the MCU has stopped answering."""
        return self._is_file or self._unanswered <= UNANSWERED_MAX

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
            f" unanswered={self._unanswered} last_clock={self._last_clock}"
        )


class SecondarySync(ClockSync):
    """A further MCU that follows the print time of the first one although their clocks drift."""

    def __init__(self, reactor: Reactor, main_sync: ClockSync) -> None:
        super().__init__(reactor)
        self._main_sync = main_sync
        self._offset_s, self._adjusted_freq = 0.0, 1.0

    def connect(self, serial: SerialReader) -> None:
        super().connect(serial)
        # start on the true relation: now, and with the slope of both fitted lines
        now = self.reactor.monotonic()
        print_time = self._main_sync.clock_to_print_time(self._main_sync.line.clock_at(now))
        clock = self.line.clock_at(now)
        self._adjusted_freq = self.line.freq / (self._main_sync.line.freq / self._main_sync.mcu_freq)
        self._offset_s = print_time - clock / self._adjusted_freq

    def connect_file(self, serial: SerialReader, pace: bool = False) -> None:
        super().connect_file(serial, pace)
        self._adjusted_freq = self.mcu_freq

    def print_time_to_clock(self, print_time: float) -> int:
        return int((print_time - self._offset_s) * self._adjusted_freq)

    def clock_to_print_time(self, clock: float) -> float:
        return clock / self._adjusted_freq + self._offset_s

    def _true_clock(self, print_time: float) -> float:
        system_s = self._main_sync.estimate_clock_systime(self._main_sync.print_time_to_clock(print_time))
        return self.line.clock_at(system_s)

    def calibrate_clock(self, print_time: float, eventtime: float) -> tuple[float, float]:
        """Bend the line at `print_time` (all before it is already on its way) to meet the true clock 4 s later.

        Returns (offset_s, freq) with clock = (print time - offset_s) * freq from then on.
        """
        if self._is_file:
            return self._offset_s, self._adjusted_freq
        bend_time = max(print_time, self._main_sync.estimated_print_time(eventtime))
        bend_clock = (bend_time - self._offset_s) * self._adjusted_freq
        meet_time = bend_time + MEET_TIME_S
        self._adjusted_freq = (self._true_clock(meet_time) - bend_clock) / MEET_TIME_S
        self._offset_s = bend_time - bend_clock / self._adjusted_freq
        return self._offset_s, self._adjusted_freq

    def stats(self, eventtime: float) -> str:
        return f"{super().stats(eventtime)} adj={self._adjusted_freq:.0f}"

    def dump_debug(self) -> str:
        return f"{super().dump_debug()} offset={self._offset_s:.6f} adjusted_freq={self._adjusted_freq:.3f}"
