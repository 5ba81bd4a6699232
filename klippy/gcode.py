"""G-code: dispatch of command lines (gcode_command.py) to registered handlers.

A print is mostly G1 lines: wherever text comes from, `run_next` gives rows of them to the C helper (gcode_rows.h), and
all else to `run_line`, line by line. That is short for lines in the plain form; others go through `_parse_slow`, which
understands line numbers, checksums, lower case, comments and quotes.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from gcode_command import (
    CHECKSUM,
    LINE_NUMBER,
    TRADITIONAL_WORD,
    WORD,
    CommandError,
    GCodeCommand,
    is_traditional,
    parse_extended,
    parse_traditional,
)
from gcode_waits import ScriptEnded, ScriptWaits

__all__ = ["CommandError", "Coord", "GCodeCommand", "GCodeDispatch"]

OutputHandler = Callable[[str], None]
# (start, end) of the line under way; those before it are done
LineNote = Callable[[int, int], None]
# Rows of moves begin so: a line of G0 or G1, or one without a command
_ROW_BEGINS = (b"G1 ", b"G0 ", b";", b"\n")


class RowRunner(Protocol):
    """Carries out rows of G0 and G1 (extras/gcode_move.py)."""

    def run(self, text: bytes, start: int, end: int) -> int:
        """Queue moves of whole lines of text[start:end]; returns where it stopped: at `start`, or behind a line."""
        ...

    def settle(self) -> None:
        """Plan the queued moves, and wait while enough is planned. Raises the errors of planning."""
        ...


class Coord(NamedTuple):
    """A position: x, y, z and extruder, mm."""

    x: float
    y: float
    z: float
    e: float


# Commands that Klipper does not have. A config written for it may have a macro of that name, which then takes the place
# of the command. Macros with the name of any other command need `rename_existing`, as in Klipper.
OWN_COMMANDS = frozenset({
    "DRY_RUN", "EXTRUSION_CALIBRATE", "HEATER_PROFILE", "INDUCTION_CALIBRATE", "INDUCTION_DUMP", "INDUCTION_RECORD",
    "INDUCTION_REFERENCE", "INDUCTION_STATUS", "INDUCTION_ZERO", "M104.1", "M108", "M17", "MODEL_CALIBRATE",
    "NOZZLE_MONITOR_CALIBRATE", "NOZZLE_REPORT", "PRIME_OOZE", "RECOVER_DISCARD", "RECOVER_PRINT",
    "SET_SEGMENT_TEMPERATURE", "SIMULATOR_FAULT", "SIMULATOR_PANEL", "TEMPERATURE_PLAN",
})  # fmt: skip
MACRO_INSTEAD = "A macro has the name of the command %s and takes its place"
_TOOL = re.compile(r"T\d+")
_EXTENDED_NAME = re.compile(r"[A-Z_][A-Z0-9_]*[A-Z_][A-Z0-9_]*|[A-Z_]")
_COMMAND_WORD = re.compile(r"[A-Z_][A-Z0-9_]*", re.IGNORECASE)


def yields_to_macros(command: str) -> bool:
    """Whether a macro of that name takes the place of our command."""
    return command in OWN_COMMANDS or _TOOL.fullmatch(command) is not None


class _MuxCommand:
    """A command whose handler is chosen by the value of one parameter."""

    def __init__(self, command: str, key: str) -> None:
        self.command = command
        self.key = key
        self.handlers: dict[str | None, Callable[[GCodeCommand], None]] = {}

    def __call__(self, gcmd: GCodeCommand) -> None:
        value = gcmd.get(self.key, None)
        handler = self.handlers.get(value)
        if handler is None:
            choices = ", ".join(sorted(str(name) for name in self.handlers if name is not None))
            if value is None:
                raise gcmd.error(
                    f"Error on '{gcmd.get_commandline()}': missing {self.key} (choices: {choices})"
                )
            raise gcmd.error(f"The value '{value}' is not valid for {self.key} (choices: {choices})")
        handler(gcmd)


class GCodeDispatch:
    """The object `gcode`: knows all commands and runs lines of G-code."""

    error = CommandError
    Coord = Coord

    def __init__(self, printer: Any) -> None:
        self.printer = printer
        self.is_fileinput = bool(printer.get_start_args().get("debuginput"))
        self.mutex = printer.get_reactor().mutex()
        self.output_callbacks: list[OutputHandler] = []
        # plugins look these up, too
        self.ready_gcode_handlers: dict[str, Callable[[GCodeCommand], None]] = {}
        self.base_gcode_handlers: dict[str, Callable[[GCodeCommand], None]] = {}
        self._handlers = self.base_gcode_handlers
        self._mux: dict[str, _MuxCommand] = {}
        self.gcode_help: dict[str, str] = {}
        self._taken_by_macros: set[str] = set()
        self._comment_listeners: list[Callable[[str], None]] = []
        self._rows: RowRunner | None = None
        self._status_commands: dict[str, dict[str, str]] = {}
        self.is_printer_ready = False
        self.waits = ScriptWaits(printer, self.mutex, lambda name: name in self._handlers)
        for event, handler in (
            ("klippy:ready", self._handle_ready),
            ("klippy:shutdown", self._handle_shutdown),
            ("klippy:disconnect", self._handle_disconnect),
        ):
            printer.register_event_handler(event, handler)
        for name in ("M110", "M112", "M115", "RESTART", "FIRMWARE_RESTART", "ECHO", "STATUS", "HELP"):
            handler = getattr(self, f"cmd_{name}")
            self.register_command(name, handler, True, getattr(self, f"cmd_{name}_help", None))
        self.register_command("M108", self.cmd_M108, desc="End a temperature wait and the script around it")

    # --- registration ---
    def register_command(
        self,
        cmd: str,
        func: Callable[[GCodeCommand], Any] | None,
        when_not_ready: bool = False,
        desc: str | None = None,
    ) -> Callable[[GCodeCommand], Any] | None:
        """Set the handler of a command; `None` removes it and returns the old one."""
        if func is None:
            old = self.ready_gcode_handlers.pop(cmd, None)
            self.base_gcode_handlers.pop(cmd, None)
            self.gcode_help.pop(cmd, None)
            self._taken_by_macros.discard(cmd)
            self._note_commands()
            return old
        if cmd in self._taken_by_macros:
            logging.info(MACRO_INSTEAD, cmd)
            return None
        if cmd in self.ready_gcode_handlers:
            raise self.printer.config_error(f"G-code command {cmd} is already registered")
        if not is_traditional(cmd) and not _EXTENDED_NAME.fullmatch(cmd):
            raise self.printer.config_error(
                f"'{cmd}' can not be the name of a G-code command: names are upper case letters, digits and '_', "
                "or one letter and a number"
            )
        self.ready_gcode_handlers[cmd] = func
        if when_not_ready:
            self.base_gcode_handlers[cmd] = func
        if desc is not None:
            self.gcode_help[cmd] = desc
        self._note_commands()
        return None

    def register_macro(self, cmd: str, func: Callable[[GCodeCommand], Any], desc: str) -> None:
        """Set the handler of a macro: it takes the place of a command that only we have, now and from now on."""
        ours = yields_to_macros(cmd)
        if ours and cmd not in self._taken_by_macros and self.register_command(cmd, None) is not None:
            logging.info(MACRO_INSTEAD, cmd)
        self._taken_by_macros.discard(cmd)
        self.register_command(cmd, func, desc=desc)
        if ours:
            self._taken_by_macros.add(cmd)

    def register_mux_command(
        self,
        cmd: str,
        key: str,
        value: str | None,
        func: Callable[[GCodeCommand], Any],
        desc: str | None = None,
    ) -> None:
        """Set the handler of `cmd key=value`; value None: used when the parameter is missing."""
        mux = self._mux.get(cmd)
        if mux is None:
            mux = self._mux[cmd] = _MuxCommand(cmd, key)
            self.register_command(cmd, mux, desc=desc)
        if mux.key != key:
            raise self.printer.config_error(f"G-code command {cmd} is selected by {mux.key}, not by {key}")
        if value in mux.handlers:
            raise self.printer.config_error(f"G-code command {cmd} {key}={value} is already registered")
        mux.handlers[value] = func

    def register_output_handler(self, cb: OutputHandler) -> None:
        """Call `cb(line)` with everything sent to the user."""
        self.output_callbacks.append(cb)

    @property
    def mux_commands(self) -> dict[str, tuple[str, dict[str | None, Callable[[GCodeCommand], None]]]]:
        """Parameter, and handlers by its value, of the commands chosen by one; plugins replace handlers there."""
        return {name: (mux.key, mux.handlers) for name, mux in self._mux.items()}

    def get_command_help(self) -> dict[str, str]:
        """Help text by command."""
        return dict(self.gcode_help)

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """The commands that can be given now."""
        return {"commands": self._status_commands}

    def _note_commands(self) -> None:
        self._status_commands = {
            name: {"help": self.gcode_help[name]} if name in self.gcode_help else {}
            for name in self._handlers
        }

    # --- printer events ---
    def _handle_ready(self) -> None:
        self.is_printer_ready = True
        self._handlers = self.ready_gcode_handlers
        self._note_commands()
        self.respond_state("Ready")

    def _handle_shutdown(self) -> None:
        if not self.is_printer_ready:
            return
        self.is_printer_ready = False
        self._handlers = self.base_gcode_handlers
        self._note_commands()
        self.respond_state("Shutdown")

    def _handle_disconnect(self) -> None:
        self.respond_state("Disconnect")

    # --- running ---
    def get_mutex(self) -> Any:
        """The lock held while a script or a line from outside runs."""
        return self.mutex

    def run_script(self, script: str) -> None:
        """Run lines in order, after any other script; the first error ends them and is raised."""
        with self.waits.turn(script):
            self.run_script_from_command(script)

    def run_script_from_command(self, script: str) -> None:
        """As `run_script`, from inside a command's handler."""
        text = script.encode("utf-8", "replace") + b"\n"
        at, end = 0, len(text)
        while at < end:
            at = self.run_next(text, at, end)

    def run_next(
        self, text: bytes, at: int, end: int, need_ack: bool = False, note: LineNote | None = None
    ) -> int:
        """Run a row of moves, or else one line, at the front of text[at:end], which ends with a line end. Returns
        where the next line begins; errors as of `run_line`."""
        if self._rows is not None and text.startswith(_ROW_BEGINS, at):
            stop = self._rows.run(text, at, end)
            if stop > at:
                last = max(at, text.rfind(b"\n", at, stop - 1) + 1)
                if note is not None:
                    note(last, stop)
                try:
                    self._rows.settle()
                except Exception as e:
                    self._report(e, text[last:stop].decode("utf-8", "replace"))
                    if not need_ack:
                        raise
                if need_ack and self.output_callbacks:
                    for _ in range(text.count(b"\n", at, stop)):
                        self.respond_raw("ok")
                return stop
        stop = text.index(b"\n", at) + 1
        if note is not None:
            note(at, stop)
        self.run_line(text[at : stop - 1].decode("utf-8", "replace"), need_ack)
        return stop

    def run_line(self, line: str, need_ack: bool = False) -> None:
        """Run one line; the caller holds the mutex. The user gets its errors; they are raised unless acknowledging."""
        gcmd: GCodeCommand | None = None
        handler: Callable[[GCodeCommand], Any] | None
        try:
            command, _, rest = line.partition(" ")
            handler = self._handlers.get(command) if rest.isupper() and ";" not in rest else None
            if handler is not None and is_plain(command) and "A" <= rest[0] <= "Z" and "*" not in rest:
                params = {letter: value.strip() for letter, value in WORD.findall(rest)}
                gcmd = GCodeCommand(self, command, line, params, need_ack)
            else:
                gcmd, handler = self._parse_slow(line, need_ack)
                if gcmd is None:
                    if need_ack:
                        self.respond_raw("ok")
                    return
            handler(gcmd)
        except Exception as e:
            self._report(e, line)
            if not need_ack:
                raise
        if need_ack:
            if gcmd is None:
                self.respond_raw("ok")
            else:
                gcmd.ack()

    def register_comment_listener(self, listener: Callable[[str], None]) -> None:
        """Call listener(line) for each line that is only a comment: slicers announce layers and features so."""
        self._comment_listeners.append(listener)

    def has_comment_listeners(self) -> bool:
        """Whether there are comment listeners."""
        return bool(self._comment_listeners)

    def register_row_runner(self, runner: RowRunner) -> None:
        """What carries out rows of moves."""
        self._rows = runner

    def get_handler(self, command: str) -> Callable[[GCodeCommand], Any] | None:
        """What carries out a command now."""
        return self._handlers.get(command)

    def _report(self, problem: Exception, line: str) -> None:
        """Report to the user why a line could not be carried out; a bug stops the printer."""
        if isinstance(problem, ScriptEnded):
            return
        if isinstance(problem, CommandError):
            self.respond_error(str(problem))
            self.printer.send_event("gcode:command_error")
            return
        message = f'Internal error on command:"{line.strip()}"'
        logging.exception(message)
        self.printer.invoke_shutdown(message)
        self.respond_error(f"{message} ({problem})")

    def _parse_slow(
        self, line: str, need_ack: bool
    ) -> tuple[GCodeCommand | None, Callable[[GCodeCommand], Any]]:
        """The command of any line (None if it holds no command) and its handler."""
        text = line.strip()
        number = LINE_NUMBER.match(text)
        if number is not None and "_" not in text[: number.end() + 1]:
            text = self._check_number(text, number)
        if not text or text[0] in ";#%":
            for listener in self._comment_listeners:
                listener(text)
            return None, self._ignore
        word = TRADITIONAL_WORD.match(text) or _COMMAND_WORD.match(text)
        if word is None:
            raise CommandError(f"Malformed line '{text}': expected a command")
        command = "".join(word[0].split()).upper()
        handler = self._handlers.get(command)
        rest = text[word.end() :]
        if handler is None or command in _FREE_TEXT:
            params = {}
        elif is_traditional(command):
            params = parse_traditional(rest.partition(";")[0].upper())
        else:
            params = parse_extended(rest)
        return GCodeCommand(self, command, line.strip(), params, need_ack), handler or self.cmd_default

    @staticmethod
    def _ignore(gcmd: GCodeCommand) -> None:
        """A line without a command."""

    def _check_number(self, text: str, number: re.Match[str]) -> str:
        """Take line number and checksum off; a wrong checksum asks for the line again."""
        checksum = CHECKSUM.search(text)
        if checksum is None:
            return text[number.end() :]
        expected = 0
        for byte in text[: checksum.start()].encode():
            expected ^= byte
        if int(checksum[1]) != expected:
            self.respond_raw(f"Resend: {number[1]}")
            raise CommandError(f"Checksum mismatch in line {number[1]}: it is {checksum[1]}, not {expected}")
        return text[number.end() : checksum.start()].rstrip()

    def create_gcode_command(self, command: str, commandline: str, params: Mapping[str, Any]) -> GCodeCommand:
        """A command object made by hand, for calling another module's handler."""
        return GCodeCommand(self, command, commandline, {k: str(v) for k, v in params.items()}, False)

    def _get_extended_params(self, gcmd: GCodeCommand) -> GCodeCommand:
        """A command like T0 with `KEY=value` parameters; plugins call it."""
        params = parse_extended(gcmd.get_raw_command_parameters())
        return GCodeCommand(self, gcmd.get_command(), gcmd.get_commandline(), params, False)

    # --- answers to the user ---
    def respond_raw(self, msg: str) -> None:
        """Send a line to every output. An output that fails is dropped: the caller may be a heater's control."""
        for callback in tuple(self.output_callbacks):
            try:
                callback(msg)
            except Exception:
                logging.exception("An output of the G-code console failed and gets no more")
                if callback in self.output_callbacks:
                    self.output_callbacks.remove(callback)

    def respond_info(self, msg: str, log: bool = True) -> None:
        """Send text as comment lines."""
        if log:
            logging.info(msg)
        self.respond_raw("\n".join("// " + line.strip() for line in msg.split("\n")))

    def respond_error(self, msg: str) -> None:
        """Send the first line as an error, the rest as comments before it; in batch mode it ends the run."""
        logging.warning(msg)
        first, *more = msg.strip().split("\n")
        if more:
            self.respond_info("\n".join(more), log=False)
        self.respond_raw(f"!! {first.strip()}")
        if self.is_fileinput:
            self.printer.request_exit("error_exit")

    def respond_state(self, state: str) -> None:
        """Report a change of state to the user."""
        self.respond_info(f"Klipper state: {state}", log=False)

    # --- built-in commands ---
    def cmd_default(self, gcmd: GCodeCommand) -> None:
        """Anything without a handler of its own."""
        command = gcmd.get_command()
        if command in ("M105", "M21"):  # front ends ask for these before we are ready
            gcmd.ack("T:0" if command == "M105" else None)
            return
        if not self.is_printer_ready:
            raise gcmd.error(self.printer.get_state_message()[0])
        if command in ("M106", "M107"):  # no fan to switch
            return
        if command in ("M104", "M140") and _switches_off(gcmd.get_commandline()):  # no heater to switch off
            return
        gcmd.respond_info(f'Unknown command:"{command}"')

    def cmd_M110(self, gcmd: GCodeCommand) -> None:
        """Set line number: numbers are not tracked."""

    def cmd_M108(self, gcmd: GCodeCommand) -> None:
        """The wait ended when the command was announced (gcode_waits.py)."""

    def cmd_M112(self, gcmd: GCodeCommand) -> None:
        """Emergency stop."""
        self.printer.invoke_shutdown("Shutdown due to M112 command")

    def cmd_M115(self, gcmd: GCodeCommand) -> None:
        """Firmware name and version."""
        version = self.printer.get_start_args().get("software_version", "?")
        text = f"FIRMWARE_NAME:Klipper FIRMWARE_VERSION:{version} HOST_NAME:Ferrite"
        if not gcmd.ack(text):
            gcmd.respond_info(text)

    def request_restart(self, result: str) -> None:
        """End this run of the host (`restart`, `firmware_restart`): heaters off, queue drained, then out."""
        if self.is_printer_ready:
            toolhead = self.printer.lookup_object("toolhead", None)
            if toolhead is not None:
                print_time = toolhead.get_last_move_time()
                if result == "exit":
                    logging.info("Exiting (print time %.3fs)", print_time)
                self.printer.send_event("gcode:request_restart", print_time)
                toolhead.dwell(0.5)
                toolhead.wait_moves()
        self.printer.request_exit(result)

    cmd_RESTART_help = "Reload config file and restart host software"

    def cmd_RESTART(self, gcmd: GCodeCommand) -> None:
        """Restart the host."""
        self.request_restart("restart")

    cmd_FIRMWARE_RESTART_help = "Restart firmware, host, and reload config"

    def cmd_FIRMWARE_RESTART(self, gcmd: GCodeCommand) -> None:
        """Restart the host and its MCUs."""
        self.request_restart("firmware_restart")

    def cmd_ECHO(self, gcmd: GCodeCommand) -> None:
        """Repeat the line."""
        gcmd.respond_info(gcmd.get_commandline(), log=False)

    cmd_STATUS_help = "Report the printer status"

    def cmd_STATUS(self, gcmd: GCodeCommand) -> None:
        """Ready, or why not."""
        if self.is_printer_ready:
            self.respond_state("Ready")
            return
        message, _ = self.printer.get_state_message()
        raise gcmd.error(message.rstrip() + "\nKlipper state: Not ready")

    cmd_HELP_help = "Report the list of available extended G-Code commands"

    def cmd_HELP(self, gcmd: GCodeCommand) -> None:
        """List the commands that have a description."""
        lines = [] if self.is_printer_ready else ["Printer is not ready - not all commands available."]
        lines.append("Available extended commands:")
        lines += [
            f"{name:<10}: {self.gcode_help[name]}"
            for name in sorted(self._handlers)
            if name in self.gcode_help
        ]
        gcmd.respond_info("\n".join(lines), log=False)


# Commands whose parameters are prose
_FREE_TEXT = frozenset({"M117", "M118", "M20", "M23"})
_OFF = re.compile(r"(?:^|[^A-Z])S\s*0*(?:\.0*)?\s*(?:$|[;A-Z*])", re.IGNORECASE)
_PLAIN: dict[str, bool] = {}


def _switches_off(line: str) -> bool:
    """Whether a temperature command sets 0 (the default)."""
    return _OFF.search(line) is not None or "S" not in line.upper()


def is_plain(command: str) -> bool:
    """Whether a line of this command may take the short way (traditional, parameters not prose); remembered."""
    known = _PLAIN.get(command)
    if known is None:
        known = _PLAIN[command] = is_traditional(command) and command not in _FREE_TEXT
    return known
