"""A measurement: the samples of an accelerometer between two moments."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from roles import Printer

HEADER = "#time,accel_x,accel_y,accel_z\n"
LATE_S = 1.0  # after the end, until samples are given up that have not come
POLL_S = 0.05


class Sample(NamedTuple):
    """Print time (s), mm/s^2."""

    time: float
    accel_x: float
    accel_y: float
    accel_z: float


class Recording:
    """Collects until finish_measurements(); its samples are those between request and end."""

    def __init__(self, printer: Printer, section: str) -> None:
        self.section = section
        self.errors = self.overflows = 0
        self.fault: str | None = None
        self._printer = printer
        self._reactor = printer.get_reactor()
        self._toolhead = printer.lookup_object("toolhead")
        self.request_start_time = self.request_end_time = self._toolhead.get_last_move_time()
        self._values = array("d")  # four to a sample
        self._is_finished = False

    def take(self, batch: dict[str, Any]) -> bool:
        """A batch; False when no more are wanted."""
        if self._is_finished:
            return False
        for row in batch["data"]:
            self._values.extend(row)
        self.errors += batch["errors"]
        self.overflows += batch["overflows"]
        self.fault = batch["fault"]
        return True

    def finish_measurements(self) -> None:
        """Wait for the end of motion and the samples up to then."""
        self.request_end_time = self._toolhead.get_last_move_time()
        self._toolhead.wait_moves()
        mcu = self._printer.lookup_object("mcu")
        deadline = self.request_end_time + LATE_S
        while not self._values or self._values[-4] < self.request_end_time:
            now = self._reactor.monotonic()
            if mcu.estimated_print_time(now) > deadline or self._printer.is_shutdown():
                break
            self._reactor.pause(now + POLL_S)
        self._is_finished = True

    def _rows(self) -> Iterator[tuple[float, ...]]:
        values = self._values
        for at in range(0, len(values), 4):
            if self.request_start_time <= values[at] <= self.request_end_time:
                yield tuple(values[at : at + 4])

    def has_valid_samples(self) -> bool:
        """Is there any sample between start and end?"""
        return next(self._rows(), None) is not None

    def get_samples(self) -> list[Sample]:
        return [Sample(*row) for row in self._rows()]

    def write(self, stream: TextIO) -> None:
        """As CSV: print time in s, mm/s^2."""
        stream.write(HEADER)
        stream.writelines("%.6f,%.6f,%.6f,%.6f\n" % row for row in self._rows())  # noqa: UP031

    def write_to_file(self, filename: str) -> None:
        with Path(filename).open("w") as stream:
            self.write(stream)
