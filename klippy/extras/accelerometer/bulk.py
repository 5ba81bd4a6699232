"""Samples that firmware sends in bulk, and when each was taken.

The firmware numbers its messages and knows, at a clock, how many samples there have been. That gives points (samples
taken, clock); a line through the last ones is the chip's own rate, which may be some percent off its nominal one.

      clock  │            ·─── a point lies up to one sample period early:
             │        ·─'      the line through the middle of them is half a period late, sample k is at k + 0.5
             │    ·─'
             └────────────────► samples taken
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from msgproto import decode_vlq
from roles import Printer

from . import messages

STATUS_S = 0.1
POINTS_MAX = 256  # of the line
MAX_QUERY_S = 0.001  # a count that took longer to read says little about when
Params = dict[str, Any]
RawHandler = Callable[[int, bytes], None]


class SampleClock:
    """The line from sample numbers to MCU clock (64 bits). Sums of whole numbers: exact, however long it runs."""

    def __init__(self, nominal_ticks: float) -> None:
        self._nominal = nominal_ticks
        self._points: deque[tuple[int, int]] = deque()
        self._sums = [0, 0, 0, 0]  # of n, clock, n^2, n clock
        self._line: tuple[float, float] | None = None

    def add(self, taken: int, clock: int) -> None:
        self._points.append((taken, clock))
        self._count(taken, clock, 1)
        if len(self._points) > POINTS_MAX:
            self._count(*self._points.popleft(), -1)
        self._line = None

    def forget(self) -> None:
        """Only points from now on count."""
        self._points.clear()
        self._sums = [0, 0, 0, 0]

    def _count(self, n: int, clock: int, sign: int) -> None:
        for place, value in enumerate((n, clock, n * n, n * clock)):
            self._sums[place] += sign * value

    def line(self) -> tuple[float, float]:
        """(clock of sample 0, ticks a sample)."""
        if self._line is None:
            self._line = self._fit()
        return self._line

    def _fit(self) -> tuple[float, float]:
        count = len(self._points)
        n, clock, squares, products = self._sums
        spread = count * squares - n * n
        slope = self._nominal
        if count > 2 and spread > 0:
            slope = (count * products - n * clock) / spread
        return clock / count + (0.5 - n / count) * slope, slope


class BulkReader:
    """One sensor's messages between start and stop. Messages come whole and in order."""

    def __init__(self, mcu: Any, oid: int, samples_per_message: int, sample_bytes: int) -> None:
        self._mcu = mcu
        self._per_message, self._sample_bytes = samples_per_message, sample_bytes
        self._oid = oid
        self._messages: list[bytes] = []  # from the sequence on
        self._status: Any = None
        self.lost_messages = self.overflows = 0
        self._next_sequence = 0  # 64 bits
        self._has_gap = False  # since the line's last point
        self._clock = SampleClock(1.0)

    def build(self, status: Any) -> None:
        """Called when the MCU's commands are known; `status` is the query of how far the reading is."""
        self._status = status
        # asking for the status fetches them
        self._mcu.let_wait(messages.DATA, self._oid, self._messages.append)

    def start(self, rate_hz: float) -> None:
        """The firmware has begun anew."""
        self._messages.clear()
        self._next_sequence = self.lost_messages = self.overflows = 0
        self._clock = SampleClock(self._mcu.seconds_to_clock(1.0) / rate_hz)

    def update(self) -> int:
        """Ask for the count; returns how many samples the chip has taken since the start."""
        params = self._status.send([self._oid])
        clock = self._mcu.clock32_to_clock64(params["clock"])
        behind = params["next_sequence"] - self._next_sequence & 0xFFFF
        overflows = (params["possible_overflows"] - self.overflows) & 0xFFFF
        self.overflows += overflows
        self._has_gap |= overflows > 0
        messages = self._next_sequence + behind
        taken = messages * self._per_message + params["buffered"] // self._sample_bytes
        if params["query_ticks"] <= self._mcu.seconds_to_clock(MAX_QUERY_S):
            if self._has_gap:  # samples are missing: a line across the gap has another slope
                self._clock.forget()
                self._has_gap = False
            self._clock.add(taken, clock)
        return int(taken)

    def rate_hz(self) -> float:
        """Samples a second, by the MCU's clock."""
        return float(self._mcu.seconds_to_clock(1.0) / self._clock.line()[1])

    def time_of(self, number: float) -> float:
        """Print time of a sample."""
        first_clock, ticks = self._clock.line()
        return float(self._mcu.clock_to_print_time(first_clock + number * ticks))

    def take(self, sample: Callable[[bytes, float], None] | None, raw: Sequence[RawHandler] = ()) -> None:
        """Each sample that has come, with its print time; `raw` gets runs without a gap: number of the first, bytes."""
        messages, self._messages[:] = list(self._messages), []
        run: list[bytes] = []
        first = self._next_sequence
        for message in messages:
            sequence, at = decode_vlq(message, 0)
            gap = (sequence - self._next_sequence) & 0xFFFF
            if gap:
                self._take_run(first, run, sample, raw)
                run, first = [], self._next_sequence + gap
                self.lost_messages += gap
            run.append(message[at + 1 :])  # behind its length
            self._next_sequence += gap + 1
        self._take_run(first, run, sample, raw)

    def _take_run(
        self,
        sequence: int,
        run: list[bytes],
        sample: Callable[[bytes, float], None] | None,
        raw: Sequence[RawHandler],
    ) -> None:
        if not run:
            return
        number, size, data = sequence * self._per_message, self._sample_bytes, b"".join(run)
        for handler in raw:
            handler(number, data)
        if sample is None:
            return
        first_clock, ticks = self._clock.line()
        for place, at in enumerate(range(0, len(data), size), number):
            sample(data[at : at + size], self._mcu.clock_to_print_time(first_clock + place * ticks))


class Batches:
    """A timer that calls `collect()` while anybody listens, and hands what it gives to all of them.

    A client returns False when it wants no more. `start` and `stop` switch the source on and off.
    """

    def __init__(
        self,
        printer: Printer,
        collect: Callable[[], Params],
        start: Callable[[], None],
        stop: Callable[[], None],
        report_error: Callable[[Exception], None],
    ) -> None:
        self._printer = printer
        self._reactor = printer.get_reactor()
        self._collect, self._start, self._stop, self._report_error = collect, start, stop, report_error
        self._clients: list[tuple[Callable[[Params], bool], float]] = []
        self._timer: Any = None

    def add_client(self, client: Callable[[Params], bool], period_s: float = STATUS_S) -> None:
        """Called with each batch; raises the printer's command_error if the source does not start."""
        now = self._reactor.monotonic()
        if self._timer is None:
            self._start()
            self._timer = self._reactor.register_timer(self._on_timer, now + period_s)
        else:
            self._reactor.update_timer(self._timer, now)
        self._clients.append((client, period_s))

    @property
    def is_running(self) -> bool:
        return self._timer is not None

    def _on_timer(self, eventtime: float) -> float:
        """Timer of the reactor; may wait for the MCU's answer."""
        try:
            batch = self._collect()
            self._clients = [(client, period_s) for client, period_s in self._clients if client(batch)]
            if self._clients and not self._printer.is_shutdown():
                return eventtime + min(period_s for _, period_s in self._clients)
            self._end()
        except self._printer.command_error as problem:
            self._end(problem)
        return float(self._reactor.NEVER)

    def _end(self, problem: Exception | None = None) -> None:
        self._reactor.unregister_timer(self._timer)
        self._timer = None
        self._clients = []
        try:
            if not self._printer.is_shutdown():
                self._stop()
        except self._printer.command_error as e:
            problem = problem or e
        if problem is not None:
            self._report_error(problem)


class Subscribers:
    """Clients of the API: each connection gets a batch once, with the template it gave last, however often it asks."""

    def __init__(
        self, add_client: Callable[[Callable[[Params], bool]], None], is_running: Callable[[], bool]
    ) -> None:
        self._add_client, self._is_running = add_client, is_running
        self._templates: dict[Any, dict[str, Any]] = {}

    def serve(
        self, request: Any, header: Sequence[str], shape: Callable[[Params], Params] = lambda batch: batch
    ) -> None:
        """Endpoint: the header now, `shape` of each batch from now on."""
        template, connection = request.get_dict("response_template", {}), request.get_client_connection()

        def send(batch: Params) -> bool:
            if connection.is_closed():
                self._templates.pop(connection, None)
                return False
            connection.send({**self._templates[connection], "params": shape(batch)})
            return True

        if not self._is_running():
            self._templates.clear()
        if connection not in self._templates:
            self._add_client(send)
        self._templates[connection] = template
        request.send({"header": list(header)})
