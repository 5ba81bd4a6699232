"""The host in batch mode for its path alone: any printer.cfg, no firmware, no waiting.

    printer.cfg ─► PathConfig ─► PathPrinter (macros, transforms, kinematics, look-ahead as on the printer) ─► moves

The firmware is made up: it takes every command and has every pin. Sections that only another host knows are left out,
and so is [temperature_plan], whose commands belong to who plans. Options that a planning program can do without may
be missing. Nothing is written: SAVE_CONFIG and the like do nothing.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any, Protocol

import configfile
import mcu
import msgproto
from clocksync import ClockSync, SecondarySync
from configtext import ConfigData, OptionText, Origin, SectionText
from printer import Printer
from reactor import FdPoll, Reactor

CONSTANTS = {"CLOCK_FREQ": 72_000_000, "ADC_MAX": 4095, "PWM_MAX": 255, "MCU": "stm32f103xe"}
# What a config for a look-ahead may leave out. Pins and sensors have no meaning here.
HEATER = {"sensor_type": "Generic 3950", "control": "watermark", "min_temp": "0"}
DEFAULTS: dict[str, dict[str, str]] = {
    "printer": {"max_velocity": "200", "max_accel": "2000"},
    "heater_bed": {"heater_pin": "path1", "sensor_pin": "path2", "max_temp": "500", **HEATER},
    "fan": {"pin": "path3"},
    "exclude_object": {},
    "gcode_arcs": {},
}
EXTRUDER = {
    "nozzle_diameter": "0.4", "filament_diameter": "1.75", "max_extrude_only_distance": "1000",
    "max_extrude_cross_section": "50",
}  # fmt: skip
_TOOL = re.compile(r"extruder\d+")
# They write files, read others, or end the run.
WITHOUT_EFFECT = (
    "SAVE_CONFIG", "SAVE_VARIABLE", "RESTART", "FIRMWARE_RESTART", "M112", "SDCARD_PRINT_FILE", "M23", "M24",
)  # fmt: skip


class AnyFirmware(msgproto.MessageParser):
    """A made-up firmware with every requested message and every pin."""

    def lookup_command(self, msgformat: str) -> msgproto.MessageFormat:
        name = msgformat.partition(" ")[0]
        if name not in self._commands and name not in self._responses:
            self._add("command", msgformat, len(self._by_id) + 2)
        return super().lookup_command(msgformat)

    def lookup_response(self, name: str) -> msgproto.MessageFormat | None:
        return self._responses.get(name) or self._commands.get(name)

    def create_command(self, text: str) -> bytes:
        return b"\0"

    def get_enumerations(self) -> dict[str, dict[str, int]]:
        return {"pin": {"ADC_TEMPERATURE": 0}}


class PathMCU(mcu.MCU):
    """A board without firmware."""

    def _connect_file(self) -> None:
        dictionary = json.dumps({"config": CONSTANTS}).encode()
        self._serial.connect_file(dictionary, os.devnull)
        self._serial.msgparser = AnyFirmware()
        self._serial.msgparser.process_identify(dictionary, decompress=False)
        self._clocksync.connect_file(self._serial)


def add_printer_objects(config: Any) -> None:
    """In the place of mcu.add_printer_objects."""
    printer = config.get_printer()
    main_sync = ClockSync(printer.get_reactor())
    printer.add_object("mcu", PathMCU(config.getsection("mcu"), main_sync))
    for section in config.get_prefix_sections("mcu "):
        sync = SecondarySync(printer.get_reactor(), main_sync)
        printer.add_object(section.get_name(), PathMCU(section, sync))


class PathConfig(configfile.PrinterConfig):
    """A printer.cfg with what matters for the path."""

    def read_main_config(self) -> configfile.ConfigWrapper:
        wrapper = super().read_main_config()
        complete(self._data)
        return wrapper

    def unused_options(self, failed: set[str]) -> list[str]:
        """The printer refuses unknown options; the path does not depend on them."""
        return []


def complete(data: ConfigData) -> None:
    """What this host needs and a config may lack."""
    origin, sections = Origin("default", 0), data.sections
    for name in sorted({"mcu", *(name for name in sections if name.startswith("mcu "))}):
        sections.pop(name, None)  # by whatever line it is reached
        data.set(name, "serial", os.devnull, origin)
    sections.pop("temperature_plan", None)
    if not any(name.startswith("stepper") for name in sections):
        data.set("printer", "kinematics", "none", origin)
    defaults = dict(DEFAULTS)
    if {"gcode_macro m106", "gcode_macro m107"} & {name.lower() for name in sections}:
        del defaults["fan"]
    for name in sorted({"extruder", *(name for name in sections if _TOOL.fullmatch(name))}):
        defaults[name] = _extruder(name, set(sections[name].options) if name in sections else set())
    for name, options in defaults.items():
        section = sections.setdefault(name, SectionText(name, origin))
        for option, value in options.items():
            section.options.setdefault(option, OptionText(value, origin))


def _extruder(name: str, has: set[str]) -> dict[str, str]:
    """What its section may lack; one without a nozzle has limits of motion that stop no file."""
    heater = {"heater_pin": f"path_{name}1", "sensor_pin": f"path_{name}2", "max_temp": "300", **HEATER}
    return (heater if not has & {"heater", "shared_heater"} else {}) | (
        EXTRUDER if "nozzle_diameter" not in has else {}
    )


class PathPrinter(Printer):
    """The host's objects, for a path."""

    CORE_FIRST = ("pins", "simulation.path_host")
    CONFIG = PathConfig


class NoWaiting:
    """Time that passes only when it is waited for, and then at once."""

    runs_by_itself = False

    def __init__(self) -> None:
        self.now = 1.0

    def monotonic(self) -> float:
        return self.now

    def wait(self, until: float, poll: FdPoll) -> None:
        if until >= Reactor.NEVER:
            raise RuntimeError("the host waits for what never comes")
        self.now = max(self.now, until)


class Reader(Protocol):
    """Who wants the path."""

    def on_ready(self, printer: PathPrinter) -> None:
        """Before the first line."""

    def before_line(self, number: int) -> None:
        """From 0."""

    def after_line(self) -> None:
        """It has been carried out: its moves are in the look-ahead or have been given out."""


class PathHost:
    """Runs one file."""

    def __init__(self, config: Path, gcode: Path) -> None:
        self._gcode_file = gcode
        self._problem: Exception | None = None
        start_args = {
            "config_file": str(config),
            "config_overrides": [("virtual_sdcard", "path", str(gcode.resolve().parent))],
            "debugoutput": os.devnull,
            "apiserver": None,
            "gcode_fd": None,
            "start_reason": "startup",
            "log_file": None,
            "software_version": "path",
            "cpu_info": "path",
        }
        self.printer = PathPrinter(Reactor(NoWaiting()), start_args)

    def run(self, reader: Reader) -> None:
        """Raises ValueError with the line that cannot be, OSError, or what the reader raises."""
        printer = self.printer
        printer.get_reactor().register_callback(lambda eventtime: self._drive(reader))
        printer.run()
        printer.get_reactor().finalize()
        if self._problem is not None:
            raise self._problem

    def _drive(self, reader: Reader) -> None:
        printer, reactor = self.printer, self.printer.get_reactor()
        try:
            while printer.get_state_message()[1] == "startup":
                reactor.pause(reactor.monotonic() + 0.1)
            self._check_state()
            self._prepare()
            reader.on_ready(printer)
            with printer.lookup_object("gcode").get_mutex():
                self._read(reader)
            printer.lookup_object("toolhead").wait_moves()
        except Exception as problem:
            self._problem = problem
        finally:
            printer.request_exit("exit")

    def _check_state(self) -> None:
        message, state = self.printer.get_state_message()
        if state != "ready":
            raise ValueError(message.partition("\n")[0])

    def _prepare(self) -> None:
        """The axes are where the origin is, and what reaches beyond the path does nothing."""
        gcode = self.printer.lookup_object("gcode")
        for name in WITHOUT_EFFECT:
            if gcode.get_handler(name) is not None:
                gcode.register_command(name, None)
            gcode.register_command(name, lambda gcmd: None)
        self.printer.lookup_object("toolhead").set_position([0.0, 0.0, 0.0, 0.0], (0, 1, 2))

    def _read(self, reader: Reader) -> None:
        gcode = self.printer.lookup_object("gcode")
        with self._gcode_file.open(encoding="utf-8-sig", errors="replace") as stream:
            for number, line in enumerate(stream):
                reader.before_line(number)
                try:
                    gcode.run_line(line)
                    self._check_state()
                    reader.after_line()
                except Exception as error:
                    text = str(error).partition("\n")[0]
                    where = f"{self._gcode_file}, line {number + 1}: '{line.strip()[:60]}'"
                    raise ValueError(f"{where}: {text}") from None
