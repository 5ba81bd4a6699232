"""A load cell: force from counts, its commands, status and API."""

from __future__ import annotations

import statistics
from collections import deque
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand

from ..probing.stream import Sample, SampleStream
from . import chips, messages
from .calibrate import Calibration

STATUS_S = 1.0  # what the status is an average of
READ_S = 1.0
DIAGNOSTIC_S = 10.0


class LoadCell:
    """Printer object of [load_cell NAME] and [load_cell_probe]."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.section = config.get_name()
        self.name = self.section.split()[-1]
        self.chip = chips.read_chip(config)
        self.mcu = self.chip.mcu
        self.counts_per_gram = config.getfloat("counts_per_gram", None, above=0.0)
        self.reference_tare = config.getint("reference_tare_counts", None)
        self.sign = config.getchoice("sensor_orientation", {"normal": 1.0, "inverted": -1.0}, "normal")
        self.tare_counts = self.reference_tare
        self._query: Any = None
        self.stream = SampleStream(
            self.mcu, self.chip.oid, self._unpack, self._start, self._stop, self.section
        )
        self._recent: deque[Sample] = deque()
        self.calibration = Calibration(self)
        self.mcu.register_config_callback(self._build_config)

    def register(self, is_default: bool) -> None:
        """`is_default`: for commands without LOAD_CELL=."""
        gcode = self.printer.lookup_object("gcode")
        for command, text in (
            ("LOAD_CELL_TARE", "Set the zero of the load cell"),
            ("LOAD_CELL_READ", "Read the force on the load cell"),
            ("LOAD_CELL_DIAGNOSTIC", "Check the health of the load cell"),
            ("LOAD_CELL_CALIBRATE", "Start the calibration of the load cell"),
        ):
            handler = getattr(self, f"cmd_{command}")
            gcode.register_mux_command(command, "LOAD_CELL", self.name, handler, desc=text)
            if is_default:
                gcode.register_mux_command(command, "LOAD_CELL", None, handler, desc=text)
        self.printer.register_event_handler("klippy:ready", self._watch)
        header = ("time", "force (g)", "counts", "tare_counts")
        self.stream.register_dump("load_cell/dump_force", self.name, header, self._row)
        family = self.chip.family
        raw = ("time", "counts", "value")
        self.stream.register_dump(f"{family}/dump_{family}", self.name, raw, self._raw_row)

    # -- the stream --

    def _build_config(self) -> None:
        chip = self.chip
        chip.configure()
        messages.stop_at_restart(self.mcu, chip.family, chip.oid)
        self._query = messages.query(self.mcu, chip.family, chip.queue())
        self.stream.build(messages.status(self.mcu, chip.family, chip.oid, chip.queue()))

    def _start(self) -> float:
        self.chip.prepare()
        self._query.send([self.chip.oid, self.mcu.seconds_to_clock(chips.rest_s(self.chip))])
        return self.chip.rate_hz

    def _stop(self) -> None:
        self._query.send([self.chip.oid, 0])

    def _unpack(self, raw: bytes) -> float | None:
        counts = chips.unpack(raw)
        return None if counts is None else self.sign * counts

    def _watch(self) -> None:
        """Read on for the status."""
        if self.mcu.is_fileoutput():
            return

        def begin(eventtime: float) -> None:
            try:
                self.stream.add_client(self._note)
            except self.printer.command_error as e:
                self.printer.lookup_object("gcode").respond_raw(f"!! [{self.section}]: {e}")

        self.reactor.register_callback(begin)

    def _note(self, batch: dict[str, Any]) -> bool:
        recent = self._recent
        recent.extend(batch["data"])
        while recent and recent[0][0] < recent[-1][0] - STATUS_S:
            recent.popleft()
        return True

    def _row(self, sample: Sample) -> tuple[float, float | None, int, int | None]:
        time, counts = sample
        return round(time, 6), self.force_g(counts), int(counts), self.tare_counts

    def _raw_row(self, sample: Sample) -> tuple[float, int, float]:
        return round(sample[0], 6), int(sample[1]), round(sample[1] / chips.RANGE, 6)

    # -- force --

    @property
    def is_calibrated(self) -> bool:
        return self.counts_per_gram is not None and self.reference_tare is not None

    def force_g(self, counts: float) -> float | None:
        """Above the tare."""
        if self.counts_per_gram is None or self.tare_counts is None:
            return None
        return round((counts - self.tare_counts) / self.counts_per_gram, 3)

    def read_counts(self, duration_s: float) -> list[float]:
        """The samples of the next `duration_s`. Raises the printer's command_error if there are none."""
        gathering = self.stream.gather()
        try:
            start = self.mcu.estimated_print_time(self.reactor.monotonic())
            gathering.wait_until(start + duration_s)
            counts = [value for _, value in gathering.between(start, start + duration_s)]
        finally:
            gathering.end()
        if not counts and not self.mcu.is_fileoutput():
            raise self.printer.command_error(f"[{self.section}] has sent no good sample: check its wiring")
        return counts or [0.0]

    def mean_counts(self, duration_s: float = READ_S) -> float:
        """Raises command_error beside `read_counts` if the converter is at its limit."""
        counts = self.read_counts(duration_s)
        if max(map(abs, counts)) >= chips.RANGE - 1:
            raise self.printer.command_error(
                f"[{self.section}]: the converter is at the end of its range: check the wiring, or choose a smaller"
                " gain"
            )
        return statistics.fmean(counts)

    def describe(self, counts: float) -> str:
        force = self.force_g(counts)
        share = f"{100.0 * counts / chips.RANGE:.2f}%"
        return f"{share} ({int(counts)})" if force is None else f"{force:.1f}g ({share}, {int(counts)})"

    def get_status(self, eventtime: float) -> dict[str, Any]:
        forces = [self.force_g(value) for _, value in self._recent]
        known = [force for force in forces if force is not None]
        return {
            "is_calibrated": self.is_calibrated,
            "counts_per_gram": self.counts_per_gram,
            "reference_tare_counts": self.reference_tare,
            "tare_counts": self.tare_counts,
            "force_g": round(statistics.fmean(known), 2) if known else None,
            "min_force_g": min(known, default=None),
            "max_force_g": max(known, default=None),
        }

    # -- commands --

    def cmd_LOAD_CELL_TARE(self, gcmd: GCodeCommand) -> None:
        """The present load is zero."""
        counts = self.mean_counts()
        self.tare_counts = round(counts)
        gcmd.respond_info(f"Load cell tare value: {100.0 * counts / chips.RANGE:.2f}% ({self.tare_counts})")

    def cmd_LOAD_CELL_READ(self, gcmd: GCodeCommand) -> None:
        """A second's mean."""
        gcmd.respond_info(self.describe(self.mean_counts()))

    def cmd_LOAD_CELL_DIAGNOSTIC(self, gcmd: GCodeCommand) -> None:
        """Ten seconds of samples and what they say of the wiring."""
        gcmd.respond_info(f"Collecting load cell data for {DIAGNOSTIC_S:.0f} seconds...")
        counts = self.read_counts(DIAGNOSTIC_S)
        saturated = sum(abs(value) >= chips.RANGE - 1 for value in counts)
        low, high = (100.0 * value / chips.RANGE for value in (min(counts), max(counts)))
        gcmd.respond_info(
            f"Samples Collected: {len(counts)}\n"
            f"Measured samples per second: {self.stream.rate_hz():.1f}\n"
            f"Good samples: {len(counts) - saturated}, Saturated samples: {saturated},"
            f" Unique values: {len(set(counts))}\n"
            f"Sample range: [{low:.2f}% to {high:.2f}%]\n"
            f"Sample range / sensor capacity: {(high - low) / 2.0:.5f}%"
        )

    def cmd_LOAD_CELL_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """TARE, CALIBRATE GRAMS=, ACCEPT or ABORT."""
        self.calibration.begin(gcmd)
