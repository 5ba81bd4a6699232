"""Recorded runs of an [induction_heater] (thermal/recording/stored.py): a whole run, a while, the last seconds before a
fault.

    record_file: NAME      the whole run, from the start of the printer on
    record_seconds: 20     kept in memory; written when the heater faults, its board stops or M112 comes
    INDUCTION_RECORD       from now on for DURATION
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer
from thermal.recording import recorder, stored

from ..heater import tuning as heater_tuning
from ..outputs import output_file

KEPT_S = 20.0
SECONDS_MAX = 120.0


class InductionRecord:
    """One heater's. While nothing is recorded its loop is the plain one."""

    def __init__(self, config: ConfigWrapper, heater: Any, rows: list[Any], folder: str) -> None:
        self.printer: Printer = config.get_printer()
        self.heater = heater
        self._rows = rows
        self._folder = Path(folder).expanduser()
        self._file_name = config.get("record_file", None)
        usual_s = 0.0 if self.printer.get_start_args().get("is_simulated") else KEPT_S
        keep_s = config.getfloat("record_seconds", usual_s, minval=0.0, maxval=SECONDS_MAX)
        self._ring = recorder.Ring(keep_s, lambda: recorder.state_frame(heater.loop)) if keep_s else None
        self._writer: stored.Writer | None = None
        self._name = ""
        self._until_s = 0.0

    def register(self) -> None:
        command = (
            "INDUCTION_RECORD",
            self.cmd_record,
            "Record a run of the nozzle's loop for scripts/replay.py",
        )
        heater_tuning.register_commands(self.printer, self.heater, [command])
        if self.heater.batch:
            return
        if self._ring is not None or self._file_name is not None:
            self.heater.loop = recorder.recorded(self.heater.loop, self._take)
        self.printer.register_event_handler("klippy:connect", self._on_connect)
        self.printer.register_event_handler("klippy:shutdown", self._on_shutdown)
        self.printer.register_event_handler("klippy:disconnect", self._close)

    def _header(self) -> bytes:
        unit, args = self.heater.unit, self.printer.get_start_args()
        about = {
            "version": args.get("software_version", "?"),
            "heater": self.heater.section_name,
            "block_samples": unit.settings.block_samples,
            "trip_blocks": unit.settings.trip_blocks,
            "guard": [[row.phase_ticks, row.low_raw, row.high_raw] for row in self._rows],
            "adc_max": self.heater.parameters.front.adc_max_raw,
        }
        return recorder.header(self.heater.parameters, about)

    def _on_connect(self) -> None:
        if self._file_name is not None:
            try:
                self._open(self._file_name)
            except output_file.OutputError as e:
                raise self.printer.config_error(
                    f"Option 'record_file' in section 'induction_heater {self.heater.section_name}': {e}"
                ) from None

    def _open(self, name: str) -> None:
        stream = output_file.open_new_binary(self._folder, name)
        self._name = stream.name
        self._writer = stored.Writer(stream)
        self._until_s = float("inf")
        self._write(self._header() + recorder.state_frame(self.heater.loop))

    # Frames

    def _take(self, frames: bytes) -> None:
        if self._ring is not None:
            self._ring.take(frames)
        if self._writer is not None:
            self._write(frames)

    def tick(self, now_s: float) -> None:
        """Between two verbs of the loop."""
        if self._ring is not None:
            self._ring.tick(now_s)
        if self._writer is not None and now_s >= self._until_s:
            self._close()

    def _write(self, frames: bytes) -> None:
        try:
            if self._writer is not None:
                self._writer.write(frames)
        except OSError as e:
            self._close(e)

    def _close(self, problem: OSError | None = None) -> None:
        """The file is over, whether or not what is left of it can still be written."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
        except OSError as e:
            problem = problem or e
        if problem is not None:
            text = f"Recording ended: {self._name} cannot be written: {problem.strerror}"
            self.printer.lookup_object("gcode").respond_info(text)

    # A fault

    def _on_shutdown(self) -> None:
        self._close()
        if self._ring is None or not (frames := self._ring.frames()):
            return
        try:
            name = f"induction-{self.heater.section_name}-fault.run"
            stream = output_file.open_new_binary(self._folder, name)
            writer = stored.Writer(stream)
            writer.write(self._header() + frames)
            writer.close()
        except (OSError, output_file.OutputError) as e:
            logging.warning("The run before the stop cannot be written: %s", e)
            return
        logging.info("The last seconds of heater '%s' are in %s", self.heater.section_name, stream.name)

    # By hand

    def cmd_record(self, gcmd: GCodeCommand) -> None:
        if self._writer is not None:
            raise gcmd.error(f"INDUCTION_RECORD: {self._name} is being written already")
        name = gcmd.get("FILE", f"induction-{self.heater.section_name}.run")
        duration_s = gcmd.get_float("DURATION", 60.0, above=0.0, maxval=86400.0)
        if not isinstance(self.heater.loop, recorder.RecordedLoop):
            self.heater.loop = recorder.recorded(self.heater.loop, self._take)
        try:
            self._open(name)
        except output_file.OutputError as e:
            raise gcmd.error(f"INDUCTION_RECORD: {e}") from None
        self._until_s = self.heater.now_s() + duration_s
        gcmd.respond_info(f"Recording {duration_s:g} s of heater '{self.heater.name}' to {self._name}")
