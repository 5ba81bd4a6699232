"""LOAD_CELL_CALIBRATE: TARE without load, CALIBRATE GRAMS= with a known one, then ACCEPT; ABORT gives up."""

from __future__ import annotations

from typing import Any

from gcode import GCodeCommand

from .. import manual_probe
from .chips import RANGE

COMMANDS = {
    "TARE": "Set the zero force of the load cell",
    "CALIBRATE": "Calibrate with a known force",
    "ACCEPT": "Accept the calibration",
    "ABORT": "Give up the calibration",
}
MIN_SHARE = 0.001  # of the range: a smaller change is no load
GOOD_SHARE = 0.01
Result = tuple[int, float]  # tare, counts per gram


class Calibration:
    """The dialogue of one load cell."""

    def __init__(self, cell: Any) -> None:
        self._cell = cell
        self._tare: int | None = None
        self._counts_per_gram: float | None = None

    def begin(self, gcmd: GCodeCommand) -> None:
        """Open the dialogue. Raises if another one is open."""
        manual_probe.verify_no_manual_probe(self._cell.printer)
        self._tare = self._counts_per_gram = None
        gcode = self._cell.printer.lookup_object("gcode")
        for command, text in COMMANDS.items():
            gcode.register_command(command, getattr(self, f"cmd_{command}"), desc=text)
        gcmd.respond_info(
            "Starting load cell calibration.\n"
            "1.) Remove all load and run TARE.\n"
            "2.) Apply a known load, run CALIBRATE GRAMS=nnn.\n"
            "Complete with ACCEPT, or give up with ABORT."
        )

    def _end(self) -> None:
        gcode = self._cell.printer.lookup_object("gcode")
        for command in COMMANDS:
            gcode.register_command(command, None)

    def cmd_TARE(self, gcmd: GCodeCommand) -> None:
        """Nothing is on it now."""
        self._counts_per_gram = None
        self._tare = round(self._cell.mean_counts())
        gcmd.respond_info(
            f"Load cell tare value: {100.0 * self._tare / RANGE:.2f}% ({self._tare})\n"
            "Now apply a known force to the load cell and run CALIBRATE GRAMS=nnn."
        )

    def cmd_CALIBRATE(self, gcmd: GCodeCommand) -> None:
        """CALIBRATE GRAMS=: this is on it now."""
        grams = gcmd.get_float("GRAMS", above=0.0)
        if self._tare is None:
            raise gcmd.error("Run TARE first, without load")
        counts = self._cell.mean_counts()
        change = counts - self._tare
        if abs(change) < MIN_SHARE * RANGE:
            raise gcmd.error(
                f"The reading has changed by {100.0 * abs(change) / RANGE:.3f}% of the range only: is the load on the"
                " cell, and the cell connected?"
            )
        if change < 0.0:
            raise gcmd.error(
                "The reading falls under load: set sensor_orientation: inverted (or take it away)"
            )
        self._counts_per_gram = change / grams
        capacity_kg = RANGE / self._counts_per_gram / 1000.0
        gcmd.respond_info(
            f"Calibration value: {100.0 * counts / RANGE:.2f}% ({int(counts)}), Counts/gram:"
            f" {self._counts_per_gram:.5f}, Total capacity: +/- {capacity_kg:.2f}Kg"
        )
        if change < GOOD_SHARE * RANGE:
            gcmd.respond_info("The load is small against the range: a larger one calibrates better.")

    def cmd_ACCEPT(self, gcmd: GCodeCommand) -> None:
        """Use it, and keep it for SAVE_CONFIG."""
        if self._tare is None or self._counts_per_gram is None:
            raise gcmd.error("Calibration is not complete: TARE, then CALIBRATE GRAMS=nnn")
        self._end()
        cell = self._cell
        cell.counts_per_gram, cell.reference_tare = self._counts_per_gram, self._tare
        cell.tare_counts = self._tare
        configfile = cell.printer.lookup_object("configfile")
        configfile.set(cell.section, "counts_per_gram", f"{self._counts_per_gram:.5f}")
        configfile.set(cell.section, "reference_tare_counts", str(self._tare))
        manual_probe.report_save_config(gcmd, "Load cell calibration settings")

    def cmd_ABORT(self, gcmd: GCodeCommand) -> None:
        """Everything stays as it was."""
        self._end()
        gcmd.respond_info("Load cell calibration aborted")
