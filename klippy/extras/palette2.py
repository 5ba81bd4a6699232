"""[palette2]: a Palette 2 on a serial port, which splices the filament of a print. PALETTE_CONNECT and others.

Lines `O<number> D<value> U<value> ...`, as the maker's own OctoPrint plugin sends and reads them:

    G-code file  O21 ... O30, O32   kept: header, splices, algorithms     O31   a ping, kept and announced
                 O1                 the print begins: sent, and the file pauses until the Palette says O40
    Palette      O20 D0 D1 D2 D4 D8 asks for the next header line, splice, ping, algorithm, or the last line again
                 O34 D0 | D1 %      a ping was refused, or is within so many percent    O50 firmware, or the file list
                 O97 U0 | U25 | U39 splices done, cancelled; a splice begins, ends; filament left to load
                 O40 go on   O88 error   O99 heartbeat   O100 pause   O102 smart load
"""

from __future__ import annotations

import logging
import os
import termios
from collections import deque
from typing import Any

import serial

from configfile import ConfigWrapper
from gcode import GCodeCommand

HEARTBEAT, PING, FIRMWARE, SPLICE, CANCEL = "O99", "O31", "O50", "O30", "O0"
CUT = "O10 D5"
CLEAR = (CUT, *(f"O10 D{drive} D0 D0 DFFE1" for drive in range(4)), "O10 D4 D0 D0 D0069")
FILES_DONE, LOAD_STOP = "O52", "O102 D1"
HEADER = tuple(f"O{number}" for number in range(21, 30))
HEARTBEAT_S, HEARTBEAT_TIMEOUT_S, CONNECT_S = 5.0, 11.0, 4.0
LOAD_MM, LOAD_RETRACT_MM = 5.0, 0.0
STATES = {"D2": "cancelling", "D3": "cancelled"}


def parse_line(line: str) -> tuple[int, list[str]] | None:
    """(number, parameters) of a line; None if it is none."""
    words = line.split()
    if not words or words[0][0] != "O" or not words[0][1:].isdigit():
        return None
    if any(word[0] not in "DU" for word in words[1:]):
        return None
    return int(words[0][1:]), words[1:]


class Job:
    """What the G-code file has said of the print, and how far the Palette has asked for it."""

    def __init__(self) -> None:
        self.header: dict[str, str] = {}
        self.splices: list[str] = []
        self.algorithms: list[str] = []
        self.ping = ""
        self._sent = {"header": 0, "splice": 0, "algorithm": 0}

    def take(self, line: str) -> bool:
        """Keep a line of the file; False if it is to be sent at once."""
        code = line.split(maxsplit=1)[0]
        if code in HEADER:
            self.header[code] = line
        elif code == SPLICE:
            self.splices.append(line)
        elif code == "O32":
            self.algorithms.append(line)
        elif code == PING:
            self.ping = line
        else:
            return False
        return True

    def answer(self, wanted: str) -> str | None:
        """The next line of what an O20 asks for; None if there is none left."""
        if wanted == "D2":
            return self.ping or None
        kind = {"D0": "header", "D1": "splice", "D4": "algorithm"}.get(wanted, "")
        lines = {
            "header": [self.header[code] for code in HEADER if code in self.header],
            "splice": self.splices,
            "algorithm": self.algorithms,
        }.get(kind, [])
        number = self._sent.get(kind, 0)
        if number >= len(lines):
            return None
        self._sent[kind] = number + 1
        return lines[number]


class Palette2:
    """Printer object 'palette2'."""

    def __init__(self, config: ConfigWrapper) -> None:
        self.printer = config.get_printer()
        self.reactor = self.printer.get_reactor()
        self.gcode = self.printer.lookup_object("gcode")
        self._path = config.get("serial")
        self._baud = config.getint("baud", 115200, minval=2400)
        self._feed_splice = config.getfloat("feedrate_splice", 0.8, minval=0.0, maxval=1.0)
        self._feed_normal = config.getfloat("feedrate_normal", 1.0, minval=0.0, maxval=1.0)
        self._load_speed = config.getint("auto_load_speed", 2, minval=1)
        self._max_variation = config.getfloat("auto_cancel_variation", None, minval=0.01, maxval=0.2)
        self.printer.load_object(config, "pause_resume")
        self._port: Any = None
        self._fd_handle: Any = None
        self._received = b""
        self._last_line = ""
        self._last_received_at = 0.0
        self._is_setting_up = False  # the Palette is too busy for heartbeats
        self._heartbeat_timer = self.reactor.register_timer(self._send_heartbeat)
        self._job = Job()
        self._pings: list[float] = []
        self._left_mm: int | None = None
        self._is_splicing = False
        self._queue: deque[str] = deque(maxlen=1000)  # sent, for the log of a failure
        for command, text in (
            ("PALETTE_CONNECT", "Connect to the Palette 2"),
            ("PALETTE_DISCONNECT", "Disconnect from the Palette 2"),
            ("PALETTE_CLEAR", "Clear the input and output of the Palette 2"),
            ("PALETTE_CUT", "Cut the filament in the Palette 2"),
            ("PALETTE_SMART_LOAD", "Automatically load filament through the extruder"),
        ):
            self.gcode.register_command(command, getattr(self, f"cmd_{command}"), desc=text)
        for number in range(1, 33):
            self.gcode.register_command(f"O{number}", self._on_code)
        self.gcode.register_command("O9", None)
        self.gcode.register_command("O9", self._on_reset, desc="Reset the print of the Palette 2")
        self.printer.register_event_handler("klippy:disconnect", self._close)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        return {
            "ping": self._pings[-1] if self._pings else None,
            "remaining_load_length": self._left_mm,
            "is_splicing": self._is_splicing,
        }

    # -- the line --

    def _require(self, gcmd: GCodeCommand) -> None:
        if self._port is None:
            raise gcmd.error("Palette 2 is not connected: PALETTE_CONNECT first")

    def _send(self, line: str) -> None:
        if self._port is None:
            return
        self._last_line = line
        self._queue.append(line)
        try:
            self._port.write(f"{line}\n".encode())
        except (OSError, serial.SerialException) as e:
            self._fail(f"the serial port has failed: {e}")

    def _fail(self, problem: str) -> None:
        self._close()
        self.gcode.respond_raw(f"!! [palette2]: {problem}")

    def _close(self) -> None:
        if self._fd_handle is not None:
            self.reactor.unregister_fd(self._fd_handle)
            self._fd_handle = None
        if self._port is not None:
            self._port.close()
            self._port = None
        self.reactor.update_timer(self._heartbeat_timer, self.reactor.NEVER)

    def _read(self, eventtime: float) -> None:
        """The port has something."""
        try:
            data = os.read(self._port.fileno(), 4096)
        except OSError as e:
            self._fail(f"the serial port has failed: {e}")
            return
        if not data:
            self._fail("the Palette has gone")
            return
        *lines, self._received = (self._received + data).split(b"\n")
        for raw in lines:
            parsed = parse_line(raw.decode("ascii", "replace").strip())
            if parsed is not None:
                self._last_received_at = eventtime
                self._handle(*parsed)

    def _send_heartbeat(self, eventtime: float) -> float:
        """Timer."""
        if not self._is_setting_up and eventtime > self._last_received_at + HEARTBEAT_TIMEOUT_S:
            self._fail("no heartbeat: the connection is lost")
            return float(self.reactor.NEVER)
        self._send(HEARTBEAT)
        return eventtime + HEARTBEAT_S

    # -- what the Palette says --

    def _handle(self, number: int, params: list[str]) -> None:
        first = params[0] if params else ""
        if number == 20:
            self._answer(first)
        elif number == 34 and len(params) > 2 and first == "D1":
            self._note_ping(params[1])
        elif number == 40:
            self._is_setting_up = False
            self._run("RESUME")
        elif number == 50 and not params:
            self._send(FILES_DONE)  # no files to choose from
        elif number == 88:
            self.gcode.respond_raw(f"!! [palette2]: error {first.removeprefix('D')} of the Palette")
            self._run("PAUSE")
        elif number == 97:
            self._handle_state(params)
        elif number == 100:
            self._run("PAUSE")
        elif number == 102 and first == "D0":
            self._run("PALETTE_SMART_LOAD")

    def _answer(self, wanted: str) -> None:
        line = self._last_line if wanted == "D8" else self._job.answer(wanted)
        if line is None:
            self.gcode.respond_raw(f"!! [palette2]: the Palette asks for more ({wanted}) than the file has")
            return
        self._send(line)

    def _handle_state(self, params: list[str]) -> None:
        unit, value = params[0] if params else "", params[1] if len(params) > 1 else ""
        if unit == "U0":
            if value in STATES:
                self.gcode.respond_info(f"Palette 2: {STATES[value]}")
                if value == "D2":
                    self._run("CANCEL_PRINT")
            elif value == "D0":
                self.gcode.respond_info("Palette 2: all splices are done")
        elif unit == "U25":
            self._is_splicing = value == "D0"
            factor = self._feed_splice if self._is_splicing else self._feed_normal
            self._run(f"M220 S{factor * 100.0:.0f}")
        elif unit == "U39":
            # how far the extruder has to pull, negative; 0 and more: loaded
            left = int(value[1:]) if value.lstrip("DU-").isdigit() else None
            self._left_mm = None if left is None else max(0, -left)

    def _note_ping(self, text: str) -> None:
        """Filament used against planned, percent."""
        try:
            percent = float(text.removeprefix("D"))
        except ValueError:
            return
        self._pings.append(percent)
        self.gcode.respond_info(f"Palette 2: ping {percent:g}%")
        if self._max_variation is not None and abs(percent / 100.0 - 1.0) > self._max_variation:
            self.gcode.respond_raw(f"!! [palette2]: ping {percent:g}% is beyond auto_cancel_variation")
            self._run("CANCEL_PRINT")

    def _run(self, script: str) -> None:
        def run(eventtime: float) -> None:
            try:
                self.gcode.run_script(script)
            except self.printer.command_error as e:
                logging.warning("palette2: %s: %s", script, e)

        self.reactor.register_callback(run)

    # -- commands --

    def cmd_PALETTE_CONNECT(self, gcmd: GCodeCommand) -> None:
        """Open the port, and wait for a heartbeat."""
        if self._port is not None:
            gcmd.respond_info("Palette 2 is connected already")
            return
        try:
            self._port = serial.Serial(self._path, self._baud, timeout=0, write_timeout=1.0)
        except (OSError, serial.SerialException, termios.error) as e:
            raise gcmd.error(
                f"Palette 2: {self._path} cannot be opened (option 'serial' in [palette2]): {e}"
            ) from None
        self._received, self._last_received_at = b"", 0.0
        self._fd_handle = self.reactor.register_fd(self._port.fileno(), self._read)
        self._send("")
        self._send(HEARTBEAT)
        end = self.reactor.monotonic() + CONNECT_S
        while not self._last_received_at and self._port is not None and self.reactor.monotonic() < end:
            self.reactor.pause(self.reactor.monotonic() + 0.05)
        if not self._last_received_at:
            self._close()
            raise gcmd.error(
                f"No Palette 2 answers at {self._path}: is it on, and the baud rate {self._baud}?"
            )
        self._send(FIRMWARE)
        self.reactor.update_timer(self._heartbeat_timer, self.reactor.monotonic() + HEARTBEAT_S)
        gcmd.respond_info("Palette 2 is connected")

    def cmd_PALETTE_DISCONNECT(self, gcmd: GCodeCommand) -> None:
        """Close the port."""
        self._close()
        gcmd.respond_info("Palette 2 is disconnected")

    def cmd_PALETTE_CLEAR(self, gcmd: GCodeCommand) -> None:
        """All filament out of the Palette."""
        self._require(gcmd)
        for line in CLEAR:
            self._send(line)

    def cmd_PALETTE_CUT(self, gcmd: GCodeCommand) -> None:
        """Cut in the splice core."""
        self._require(gcmd)
        self._send(CUT)

    def cmd_PALETTE_SMART_LOAD(self, gcmd: GCodeCommand) -> None:
        """Extrude as long as the Palette asks for, then confirm."""
        self._require(gcmd)
        if not self._left_mm:
            raise gcmd.error("Smart load: the Palette has not said how much filament is left to load")
        while self._left_mm and self._port is not None:
            length = min(LOAD_MM, self._left_mm)
            self.gcode.run_script_from_command(f"M83\nG1 E{length:g} F{self._load_speed * 60}\nM400")
            self._left_mm = max(0, int(self._left_mm - length))
        self._send(LOAD_STOP)

    def _on_reset(self, gcmd: GCodeCommand) -> None:
        """O9: forget the print."""
        self._job = Job()
        self._send("O9")

    def _on_code(self, gcmd: GCodeCommand) -> None:
        """O1 to O32 of a file."""
        self._require(gcmd)
        line = gcmd.get_commandline().split(";")[0].strip()
        code = line.split(maxsplit=1)[0].upper()
        if code == "O21":
            self._job = Job()
        if self._job.take(line):
            if code == PING:
                self._send(PING)
            return
        self._send(line)
        if code == "O1":
            self._is_setting_up = True
            self.gcode.respond_info("Palette 2: the print waits until the filament is loaded")
            self.printer.lookup_object("pause_resume").send_pause_command()


def load_config(config: ConfigWrapper) -> Palette2:
    return Palette2(config)
