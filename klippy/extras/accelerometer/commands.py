"""ACCELEROMETER_MEASURE, ACCELEROMETER_QUERY, ACCELEROMETER_DEBUG_READ, ACCELEROMETER_DEBUG_WRITE."""

from __future__ import annotations

import re
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TextIO

from gcode import GCodeCommand
from roles import Printer

from ..outputs import output_file
from .recording import HEADER

QUERY_S = 0.5
_NAME = re.compile(r"[A-Za-z0-9_-]+")


def result_name(gcmd: GCodeCommand) -> str:
    """NAME of a command for the files it writes; the time where there is none."""
    name = gcmd.get("NAME", time.strftime("%Y%m%d_%H%M%S"))
    if not _NAME.fullmatch(name):
        raise gcmd.error(f"NAME='{name}' must have letters, digits, '_' and '-' only.")
    return name


def open_result(gcmd: GCodeCommand, name: str) -> TextIO:
    """A new file in the folder for temporary files, where Klipper's tools look for it."""
    try:
        return output_file.open_new(Path(tempfile.gettempdir()), name)
    except (output_file.OutputError, OSError) as e:
        raise gcmd.error(f"The measurement cannot be written: {e}") from None


def _byte(gcmd: GCodeCommand, name: str, high: int) -> int:
    """A number, also as 0x1f."""
    return int(gcmd.get(name, parser=lambda text: int(text, 0), minval=0, maxval=high))


class AccelerometerCommands:
    """The commands of one chip."""

    def __init__(self, printer: Printer, sensor: Any) -> None:
        self.printer = printer
        self.sensor = sensor
        self._recording: Any = None

    def register(self, chip: str | None) -> None:
        gcode = self.printer.lookup_object("gcode")
        for name, function, text in (
            ("ACCELEROMETER_MEASURE", self.cmd_ACCELEROMETER_MEASURE, "Start/stop accelerometer"),
            (
                "ACCELEROMETER_QUERY",
                self.cmd_ACCELEROMETER_QUERY,
                "Query accelerometer for the current values",
            ),
            ("ACCELEROMETER_DEBUG_READ", self.cmd_ACCELEROMETER_DEBUG_READ, "Query register (for debugging)"),
            ("ACCELEROMETER_DEBUG_WRITE", self.cmd_ACCELEROMETER_DEBUG_WRITE, "Set register (for debugging)"),
        ):
            gcode.register_mux_command(name, "CHIP", chip, function, desc=text)

    def cmd_ACCELEROMETER_MEASURE(self, gcmd: GCodeCommand) -> None:
        """ACCELEROMETER_MEASURE [CHIP=] [NAME=]: starts; the next one stops and writes a file."""
        if self._recording is None:
            self._recording = self.sensor.start_internal_client()
            gcmd.respond_info("accelerometer measurements started")
            return
        name = result_name(gcmd)
        recording, self._recording = self._recording, None
        recording.finish_measurements()
        words = [*self.sensor.section.split(), name]
        with open_result(gcmd, f"{'-'.join(words)}.csv") as stream:
            write_samples(stream, recording)
        gcmd.respond_info(f"Writing raw accelerometer data to {stream.name} file")
        report_quality(gcmd, recording)

    def cmd_ACCELEROMETER_QUERY(self, gcmd: GCodeCommand) -> None:
        """ACCELEROMETER_QUERY [CHIP=]: the mean over half a second."""
        recording = self.sensor.start_internal_client()
        self.printer.lookup_object("toolhead").dwell(QUERY_S)
        recording.finish_measurements()
        samples = recording.get_samples()
        report_quality(gcmd, recording)
        if not samples:
            raise gcmd.error("No accelerometer measurements found")
        means = [sum(axis) / len(samples) for axis in zip(*samples, strict=True)]
        gcmd.respond_info("accelerometer values (x, y, z): {:.6f}, {:.6f}, {:.6f}".format(*means[1:]))

    def _register_of(self, gcmd: GCodeCommand) -> int:
        return _byte(gcmd, "REG", self.sensor.chip.max_register)

    def cmd_ACCELEROMETER_DEBUG_READ(self, gcmd: GCodeCommand) -> None:
        """ACCELEROMETER_DEBUG_READ [CHIP=] REG="""
        register = self._register_of(gcmd)
        value = self.sensor.registers.read(register)
        gcmd.respond_info(f"Accelerometer REG[0x{register:x}] = 0x{value:x}")

    def cmd_ACCELEROMETER_DEBUG_WRITE(self, gcmd: GCodeCommand) -> None:
        """ACCELEROMETER_DEBUG_WRITE [CHIP=] REG= VAL="""
        register = self._register_of(gcmd)
        self.sensor.registers.write(register, _byte(gcmd, "VAL", 255))


FAULTS = {
    "unplugged": "it stopped answering: check its power and wires",
    "frozen": "its samples do not change: it hangs, or it is not measuring",
    "saturated": "its samples reach the end of its range: it is hit, or it is loose",
}


def report_quality(gcmd: GCodeCommand, recording: Any) -> None:
    """Say what is wrong with a measurement, if anything."""
    if getattr(recording, "fault", None) is not None:
        gcmd.respond_info(f"[{recording.section}]: {recording.fault}: {FAULTS[recording.fault]}.")
    if getattr(recording, "overflows", 0):
        gcmd.respond_info(
            f"[{recording.section}]: {recording.overflows} gaps in the samples: the board or its line is too slow for"
            " the rate."
        )


def write_samples(stream: TextIO, recording: Any) -> None:
    """As CSV, ours or a plugin's: print time in s, mm/s^2."""
    stream.write(HEADER)
    for sample in recording.get_samples():
        stream.write("%.6f,%.6f,%.6f,%.6f\n" % tuple(sample))  # noqa: UP031


class _PluginRegisters:
    def __init__(self, chip: Any) -> None:
        self.read, self.write = chip.read_reg, chip.set_reg


class _PluginSensor:
    """A plugin's accelerometer as the commands see it."""

    chip = SimpleNamespace(max_register=127)

    def __init__(self, section: str, chip: Any) -> None:
        self.section, self.name = section, section.rsplit(maxsplit=1)[-1]
        self.registers = _PluginRegisters(chip)
        self.start_internal_client = chip.start_internal_client


class AccelCommandHelper(AccelerometerCommands):
    """The commands of a plugin's chip. It also answers to no name, unless there is an [adxl345]."""

    def __init__(self, config: Any, chip: Any) -> None:
        sensor = _PluginSensor(config.get_name(), chip)
        super().__init__(config.get_printer(), sensor)
        self.register(sensor.name)
        if sensor.name == sensor.section and not config.has_section("adxl345"):
            self.register(None)


def register(printer: Printer, sensor: Any) -> None:
    """A chip answers to its name; the first section also to no name."""
    own = AccelerometerCommands(printer, sensor)
    own.register(sensor.name)
    others = [thing for _, thing in printer.lookup_objects() if isinstance(thing, type(sensor))]
    if sensor.name == sensor.section and not any(other.name == other.section for other in others):
        own.register(None)
