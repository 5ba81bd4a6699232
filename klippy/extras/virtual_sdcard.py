"""[virtual_sdcard]: prints G-code files from a folder of this computer.

The file is read in chunks by a greenlet of its own, which runs whole lines while it holds the G-code lock and lets go
whenever a command from elsewhere waits for it. The position counts bytes of the file; it always points at the first
line that was not carried out completely. Moves come in rows (gcode.run_next), of which the last waits for its turn.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Iterator
from typing import Any, BinaryIO

import greenlet

import util
from configfile import ConfigWrapper
from gcode import GCodeCommand
from gcode_waits import ScriptEnded
from roles import Printer

_CHUNK = 8192  # bytes between looks at the rest of the host: about 10 ms of parsing
_FILES_AT_ONCE = 200  # names in a list between looks at the rest of the host
_SUFFIXES = ("gcode", "g", "gco")
_DEFAULT_ON_ERROR = "{% if 'heaters' in printer %}\nTURN_OFF_HEATERS\n{% endif %}"
_UNSUPPORTED = ("M28", "M29", "M30")


def _is_listed(name: str, check_subdirs: bool) -> bool:
    ending = name.rpartition(".")[2].lower()
    return not name.startswith(".") and (not check_subdirs or ending in _SUFFIXES)


class VirtualSD:
    """The object `virtual_sdcard`."""

    def __init__(self, printer: Printer, folder: str, on_error: Any) -> None:
        self.printer = printer
        self.reactor = printer.get_reactor()
        self.gcode = printer.lookup_object("gcode")
        self.print_stats = printer.lookup_object("print_stats")
        self.sdcard_dirname = os.path.normpath(os.path.expanduser(folder))
        self._on_error = on_error
        self.current_file: BinaryIO | None = None
        self.file_position = 0
        self.file_size = 0
        self._next_position = 0
        self._working = False
        self._in_line = False
        self._must_pause = False
        self._runner: Any = None  # greenlet of the print
        self._generation = 0  # a greenlet of an older generation ends as soon as it gets the lock

    def register(self) -> None:
        """Make commands and events known."""
        self.printer.register_event_handler("klippy:shutdown", self._handle_shutdown)
        self.printer.register_event_handler("klippy:disconnect", self._close)
        for name in ("M20", "M21", "M23", "M24", "M25", "M26", "M27"):
            self.gcode.register_command(name, getattr(self, f"cmd_{name}"))
        for name in _UNSUPPORTED:
            self.gcode.register_command(name, self.cmd_error)
        for name in ("SDCARD_RESET_FILE", "SDCARD_PRINT_FILE"):
            self.gcode.register_command(
                name, getattr(self, f"cmd_{name}"), desc=getattr(self, f"cmd_{name}_help")
            )

    # --- for others ---
    def get_status(self, eventtime: float) -> dict[str, Any]:
        """Progress (0..1) and position of the file being printed."""
        return {
            "file_path": self.file_path(),
            "progress": self.progress(),
            "is_active": self.is_active(),
            "file_position": self.file_position,
            "file_size": self.file_size,
        }

    def stats(self, eventtime: float) -> tuple[bool, str]:
        """For the statistics line."""
        return self._working, f"sd_pos={self.file_position}" if self._working else ""

    def file_path(self) -> str | None:
        """The loaded file."""
        return None if self.current_file is None else str(self.current_file.name)

    def progress(self) -> float:
        """Share of the file that was carried out."""
        return self.file_position / self.file_size if self.file_size else 0.0

    def is_active(self) -> bool:
        """Whether a file is being printed."""
        return self._working and not self._must_pause

    def has_print(self) -> bool:
        """Whether a print has begun and is not over: it runs, or it is paused."""
        return self.current_file is not None and self.print_stats.state in ("printing", "paused")

    def is_cmd_from_sd(self) -> bool:
        """Whether the running command came from the file."""
        return self._in_line and self._runner is greenlet.getcurrent()

    def _is_frozen(self) -> bool:
        """Whether the file's line is paused within its temperature wait."""
        return self._in_line and bool(self.gcode.waits.is_frozen(self._runner))

    def get_file_position(self) -> int:
        """Where the line after the running one starts (bytes)."""
        return self._next_position

    def set_file_position(self, pos: int) -> None:
        """Go on elsewhere in the file after the running line."""
        self._next_position = pos
        if not self.is_cmd_from_sd():
            self.file_position = pos

    def do_pause(self) -> None:
        """Stop after the running line of the file."""
        if not self._working:
            return
        self._must_pause = True
        # A pause from outside waits for the running line; one in the file itself (a PAUSE macro) is that line
        while self._in_line and not self.gcode.get_mutex().is_mine() and not self._is_frozen():
            self.reactor.pause(self.reactor.monotonic() + 0.001)
        if self._is_frozen():
            self.gcode.waits.hold()
            self.print_stats.note_pause()

    def do_resume(self) -> None:
        """Go on printing."""
        if self.is_active():
            raise self.gcode.error("SD busy")
        if self.current_file is None:
            raise self.gcode.error("No file is selected to be printed")
        self._must_pause = False
        if self._is_frozen():
            self.print_stats.note_start()
            self.gcode.waits.thaw()
            return
        self._working = True
        self._generation = generation = self._generation + 1
        self.reactor.register_callback(lambda eventtime: self._work(generation))

    def do_cancel(self) -> None:
        """Give up the print."""
        if self.current_file is not None:
            self.do_pause()
            self._close()
            self.print_stats.note_cancel()
        self.file_position = self.file_size = 0

    # --- files ---
    def get_file_list(self, check_subdirs: bool = False) -> list[tuple[str, int]]:
        """Names relative to the folder, and sizes."""
        return sorted(self._files(check_subdirs), key=lambda entry: entry[0].lower())

    def _files(self, check_subdirs: bool) -> Iterator[tuple[str, int]]:
        walked: set[str] = set()
        folders = [self.sdcard_dirname]
        while folders:
            folder = folders.pop()
            place = os.path.realpath(folder)
            if place in walked:  # a link back
                continue
            walked.add(place)
            with contextlib.suppress(OSError), os.scandir(folder) as entries:
                for entry in entries:
                    if entry.name.startswith("."):
                        continue
                    if entry.is_dir():
                        folders += [entry.path] if check_subdirs else []
                    elif _is_listed(entry.name, check_subdirs) and entry.is_file():
                        yield os.path.relpath(entry.path, self.sdcard_dirname), entry.stat().st_size

    def _find_like(self, name: str, check_subdirs: bool) -> str | None:
        """The path of the listed file of that name, in whatever letters; looks only into the folders it names."""
        path, parts = self.sdcard_dirname, name.split("/")
        for part in parts:
            try:
                names = os.listdir(path)
            except OSError:
                return None
            like = part if part in names else next((n for n in names if n.lower() == part.lower()), "")
            if not like or like.startswith("."):
                return None
            path = os.path.join(path, like)
        is_listed = _is_listed(parts[-1], check_subdirs) and (check_subdirs or len(parts) == 1)
        return path if is_listed and os.path.isfile(path) else None

    def _close(self) -> None:
        if self.current_file is not None:
            self.current_file.close()
            self.current_file = None

    def _reset_file(self) -> None:
        if self.current_file is not None:
            self.do_pause()
            self._close()
            if self._is_frozen():
                self.gcode.waits.end("SDCARD_RESET_FILE")
        self.file_position = self.file_size = 0
        self.print_stats.reset()
        self.printer.send_event("virtual_sdcard:reset_file")

    def _load_file(self, gcmd: GCodeCommand, name: str, check_subdirs: bool = False) -> None:
        name = name.lstrip("/")
        if "\0" in name:
            raise gcmd.error("Unable to open file: its name has a zero byte")
        path = os.path.join(self.sdcard_dirname, name)
        inside = os.path.realpath(path).startswith(os.path.realpath(self.sdcard_dirname) + os.sep)
        if not inside or not os.path.isfile(path):  # a link, or in other letters: one of the list
            found = self._find_like(name, check_subdirs)
            if found is None and not inside:
                raise gcmd.error(f"Unable to open file '{name}': it is outside of {self.sdcard_dirname}")
            path = found or path
        try:
            file = util.open_plain(path)  # stays open while it is printed
            size = file.seek(0, os.SEEK_END)
            file.seek(0)
        except OSError as e:
            raise gcmd.error(f"Unable to open file '{name}' in {self.sdcard_dirname}: {e.strerror}") from None
        gcmd.respond_raw(f"File opened:{name} Size:{size}")
        gcmd.respond_raw("File selected")
        self.current_file, self.file_position, self.file_size = file, 0, size
        self.print_stats.set_current_file(name)

    # --- commands ---
    cmd_SDCARD_RESET_FILE_help = "Clears a loaded SD File. Stops the print if necessary"

    def cmd_SDCARD_RESET_FILE(self, gcmd: GCodeCommand) -> None:
        """Unload the file."""
        if self.is_cmd_from_sd():
            raise gcmd.error("SDCARD_RESET_FILE cannot be run from the sdcard")
        self._reset_file()

    cmd_SDCARD_PRINT_FILE_help = "Loads a SD file and starts the print.  May include files in subdirectories."

    def cmd_SDCARD_PRINT_FILE(self, gcmd: GCodeCommand) -> None:
        """Load a file and print it."""
        self._check_idle(gcmd)
        self._reset_file()
        self._load_file(gcmd, gcmd.get("FILENAME"), check_subdirs=True)
        self.do_resume()

    def cmd_error(self, gcmd: GCodeCommand) -> None:
        """Writing to the card."""
        raise gcmd.error("SD write not supported")

    def _check_idle(self, gcmd: GCodeCommand) -> None:
        if self.is_active() or self.is_cmd_from_sd():
            raise gcmd.error("SD busy")

    def cmd_M20(self, gcmd: GCodeCommand) -> None:
        """List files."""
        gcmd.respond_raw("Begin file list")
        files = []
        for number, entry in enumerate(self._files(check_subdirs=False), 1):
            files.append(entry)
            if number % _FILES_AT_ONCE == 0:
                self.reactor.pause(self.reactor.NOW)
        for number, (name, size) in enumerate(sorted(files, key=lambda entry: entry[0].lower()), 1):
            gcmd.respond_raw(f"{name} {size}")
            if number % _FILES_AT_ONCE == 0:
                self.reactor.pause(self.reactor.NOW)
        gcmd.respond_raw("End file list")

    def cmd_M21(self, gcmd: GCodeCommand) -> None:
        """Initialise: always done."""
        gcmd.respond_raw("SD card ok")

    def cmd_M23(self, gcmd: GCodeCommand) -> None:
        """Select a file."""
        self._check_idle(gcmd)
        self._reset_file()
        self._load_file(gcmd, gcmd.get_raw_command_parameters().strip())

    def cmd_M24(self, gcmd: GCodeCommand) -> None:
        """Start or go on."""
        self.do_resume()

    def cmd_M25(self, gcmd: GCodeCommand) -> None:
        """Pause."""
        self.do_pause()

    def cmd_M26(self, gcmd: GCodeCommand) -> None:
        """Set the position."""
        self._check_idle(gcmd)
        self.set_file_position(gcmd.get_int("S", minval=0))

    def cmd_M27(self, gcmd: GCodeCommand) -> None:
        """Report the position."""
        if self.current_file is None:
            gcmd.respond_raw("Not SD printing.")
        else:
            gcmd.respond_raw(f"SD printing byte {self.file_position}/{self.file_size}")

    # --- the print ---
    def _handle_shutdown(self) -> None:
        if not self._working:
            return
        self._must_pause = True
        if self.current_file is None:
            return
        try:
            start = max(self.file_position - 1024, 0)
            self.current_file.seek(start)
            before = self.current_file.read(self.file_position - start)
            after = self.current_file.read(128)
        except (OSError, ValueError):
            logging.exception("virtual_sdcard: unable to read the file again")
            return
        logging.info("Virtual sdcard (%d): %r\nUpcoming (%d): %r", start, before, self.file_position, after)

    def _work(self, generation: int) -> None:
        """Greenlet of one print, from start or resume to pause, end or error."""
        logging.info("Starting SD card print (position %d)", self.file_position)
        self.print_stats.note_start()
        self._runner = greenlet.getcurrent()
        failure: str | None = None
        finished = False
        try:
            finished = self._feed(generation)
        except self.gcode.error as e:
            if (
                not isinstance(e, ScriptEnded) or e.by == "M108"
            ):  # others say themselves what becomes of the print
                failure = str(e)
        except OSError as e:
            failure = f"Unable to read the G-code file: {e.strerror}"
            self.gcode.respond_error(failure)
        except Exception as e:  # a bug in a command: the dispatcher has logged it and shut the printer down
            failure = f"Internal error: {e}"
        logging.info("Exiting SD card print (position %d)", self.file_position)
        if generation == self._generation:
            self._working = self._must_pause = False
            self._note_end(finished, failure)

    def _note_end(self, finished: bool, failure: str | None) -> None:
        if failure is not None:
            self.print_stats.note_error(failure)
            self._run_on_error()
        elif finished:
            self._close()
            self.gcode.respond_raw("Done printing file")
            self.print_stats.note_complete()
        elif self.current_file is not None:
            self.print_stats.note_pause()

    def _run_on_error(self) -> None:
        try:
            self.gcode.run_script(self._on_error.render())
        except Exception:
            logging.exception("virtual_sdcard on_error")

    def _feed(self, generation: int) -> bool:
        """Run lines until paused (False) or the end of the file (True)."""
        mutex = self.gcode.get_mutex()
        text, end = b"", 0  # what was read and not run yet, and the end of its last whole line
        is_placed = False  # False: go to the file position first
        while True:
            with mutex:
                # Whoever pauses or cancels holds the lock: look only now
                if self._must_pause or self.current_file is None or generation != self._generation:
                    return False
                if not is_placed:
                    self.current_file.seek(self.file_position)
                    text, end, is_placed = b"", 0, True
                if not end:
                    chunk = self.current_file.read(_CHUNK)
                    if not chunk and not text:
                        return True
                    text += chunk or b"\n"
                    end = text.rfind(b"\n") + 1
                done, is_placed = self._run_text(text, end, mutex)
                text, end = text[done:], end - done
            self.reactor.pause(self.reactor.NOW)

    def _run_text(self, text: bytes, end: int, mutex: Any) -> tuple[int, bool]:
        """Run lines of text[:end] until another task waits: (how far, whether the file's position is that place)."""
        base, limit, run_next = self.file_position, self.file_size, self.gcode.run_next
        at = 0

        def note(start: int, stop: int) -> None:
            self.file_position, self._next_position = base + start, min(base + stop, limit)

        while at < end:
            self._in_line = True
            try:
                at = run_next(text, at, end, note=note)
            finally:
                self._in_line = False
            self.file_position = self._next_position
            if self.file_position != min(base + at, limit):
                return at, False
            if self._must_pause or mutex.contended():
                break
        return at, True


def load_config(config: ConfigWrapper) -> VirtualSD:
    """Section [virtual_sdcard]."""
    printer = config.get_printer()
    printer.load_object(config, "print_stats")
    templates = printer.load_object(config, "gcode_macro")
    on_error = templates.load_template(config, "on_error_gcode", _DEFAULT_ON_ERROR)
    card = VirtualSD(printer, config.get("path"), on_error)
    card.register()
    return card
