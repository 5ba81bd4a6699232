"""A sensor that streams: samples with their times, for clients, for whoever waits for some, and for the API."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from ..accelerometer.bulk import Batches, BulkReader, Subscribers

FAST_S = 0.01  # between two looks, while somebody waits for samples
WAIT_MAX_S = 1.0  # for samples beyond their time
SAMPLES_PER_MESSAGE, SAMPLE_BYTES = 13, 4
Sample = tuple[float, float]  # print time of the conversion's middle, value


class SampleStream:
    """Samples of four bytes. `unpack` gives a value, None where there is none."""

    def __init__(
        self,
        mcu: Any,
        oid: int,
        unpack: Callable[[bytes], float | None],
        start: Callable[[], float],
        stop: Callable[[], None],
        name: str,
    ) -> None:
        self.printer = mcu.get_printer()
        self._reactor = self.printer.get_reactor()
        self.mcu, self.name = mcu, name
        self._unpack, self._start_chip, self._stop_chip = unpack, start, stop
        self._bulk = BulkReader(mcu, oid, SAMPLES_PER_MESSAGE, SAMPLE_BYTES)
        self._batches = Batches(self.printer, self._collect, self._start, self._stop, self._report)
        self._samples: list[Sample] = []
        self._listeners: list[deque[Sample]] = []
        self._period_s = 0.0
        self._errors = 0

    def build(self, status: Any) -> None:
        """Called when the board's commands are known; `status` is the query of how far the reading is."""
        self._bulk.build(status)

    def _start(self) -> None:
        rate_hz = self._start_chip()
        self._period_s = 1.0 / rate_hz
        self._bulk.start(rate_hz)

    def _stop(self) -> None:
        self._stop_chip()

    @property
    def is_running(self) -> bool:
        return self._batches.is_running

    def rate_hz(self) -> float:
        """As measured by the board's clock."""
        return self._bulk.rate_hz()

    def _collect(self) -> dict[str, Any]:
        lost = self._bulk.overflows + self._bulk.lost_messages
        errors = self._errors
        self._samples = []
        self._bulk.update()
        self._bulk.take(self._take)
        for listener in self._listeners:
            listener.extend(self._samples)
        now_lost = self._bulk.overflows + self._bulk.lost_messages
        return {"data": self._samples, "errors": self._errors - errors, "overflows": now_lost - lost}

    def _take(self, raw: bytes, print_time: float) -> None:
        value = self._unpack(raw)
        if value is None:
            self._errors += 1
        else:
            self._samples.append((print_time - 0.5 * self._period_s, value))

    def _report(self, problem: Exception) -> None:
        self.printer.lookup_object("gcode").respond_raw(f"!! [{self.name}]: the reading has ended: {problem}")

    def add_client(self, client: Callable[[dict[str, Any]], bool], period_s: float = 0.1) -> None:
        """Each batch goes to `client` until it returns False."""
        self._batches.add_client(client, period_s)

    def register_dump(
        self, path: str, name: str, header: Sequence[str], row: Callable[[Sample], Any]
    ) -> None:
        """The API's endpoint `path` of this sensor."""
        hooks = self.printer.lookup_object("webhooks", None)
        if hooks is None:
            return

        subscribers = Subscribers(self.add_client, lambda: self._batches.is_running)

        def on_request(request: Any) -> None:
            subscribers.serve(
                request, header, lambda batch: {**batch, "data": [row(sample) for sample in batch["data"]]}
            )

        hooks.register_mux_endpoint(path, "sensor", name, on_request)

    def gather(self) -> Gathering:
        """Samples from now on, until `end`."""
        return Gathering(self)

    def attach(self, listener: deque[Sample]) -> None:
        self._listeners.append(listener)
        self.add_client(lambda batch: any(listener is other for other in self._listeners), FAST_S)

    def detach(self, listener: deque[Sample]) -> None:
        self._listeners = [other for other in self._listeners if other is not listener]


class Gathering:
    """The samples of one probing."""

    def __init__(self, stream: SampleStream) -> None:
        self._stream = stream
        self._reactor = stream.printer.get_reactor()
        self.samples: deque[Sample] = deque()
        stream.attach(self.samples)

    def wait_until(self, print_time: float) -> None:
        """Until all samples up to print_time are here. Raises the printer's command_error if they do not come."""
        stream = self._stream
        mcu = stream.mcu
        if mcu.is_fileoutput():
            return
        while not self.samples or self.samples[-1][0] < print_time:
            now = self._reactor.monotonic()
            if mcu.estimated_print_time(now) > print_time + WAIT_MAX_S or not stream.is_running:
                raise stream.printer.command_error(f"[{stream.name}] sends no samples: check its wiring")
            self._reactor.pause(now + FAST_S)

    def between(self, start: float, end: float) -> list[Sample]:
        """The samples of a time; both are print times."""
        return [sample for sample in self.samples if start <= sample[0] <= end]

    def end(self) -> None:
        self._stream.detach(self.samples)


def position_at(printer: Any, print_time: float, span_s: float = 0.0) -> list[float]:
    """Where the head was, as the steps of its motors say; the mean over a time of `span_s` around it."""
    kin = printer.lookup_object("toolhead").get_kinematics()
    times = [print_time + span_s * share for share in ((-0.375, -0.125, 0.125, 0.375) if span_s else (0.0,))]
    sums = [0.0, 0.0, 0.0]
    for time in times:
        places = {
            motor.get_name(): motor.mcu_to_commanded_position(motor.get_past_mcu_position(time))
            for motor in kin.get_steppers()
        }
        for axis, value in enumerate(kin.calc_position(places)):
            sums[axis] += (value or 0.0) / len(times)
    return sums
