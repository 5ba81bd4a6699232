"""Where G-code lines come from besides scripts: a pseudo terminal, or an input file in batch mode."""

from __future__ import annotations

import collections
import logging
import os
import re
from typing import Any

import greenlet

from gcode import CommandError, GCodeDispatch

_FIRST_WORD = re.compile(r"\s*(?:[nN][0-9]+\s*)?([A-Za-z_]\w*)")
_EMERGENCY = re.compile(r"^(?:[nN][0-9]+)?\s*[mM]112(?:\s|$|\*)")
_READ_SIZE = 4096
_PRINT_POLL_S = 0.01
_PENDING_LIMIT = 20  # lines waiting before reading stops, so that the sender feels it


class GCodeIO:
    """The object `gcode_io`: reads lines from `start_args["gcode_fd"]` and acknowledges each with `ok`."""

    def __init__(self, printer: Any, gcode: GCodeDispatch) -> None:
        self.printer = printer
        self.gcode = gcode
        self.reactor = printer.get_reactor()
        self.fd: int | None = printer.get_start_args().get("gcode_fd")
        self.is_fileinput = gcode.is_fileinput
        self._handle: Any = None
        self._partial = ""
        self._lines: list[str] = []
        self._runner: Any = None  # greenlet that runs the lines
        self._output_ok = True
        self._bytes_read = 0
        self._recent: collections.deque[tuple[float, bytes]] = collections.deque(maxlen=50)
        if self.fd is None:
            return
        printer.register_event_handler("klippy:ready", self._handle_ready)
        printer.register_event_handler("klippy:shutdown", self._handle_shutdown)
        if not self.is_fileinput:
            gcode.register_output_handler(self._respond)
            self._handle = self.reactor.register_fd(self.fd, self._handle_readable)

    def _handle_ready(self) -> None:
        """In batch mode the file is read only now: no client waits for an error that the printer is not ready."""
        if self.is_fileinput and self._handle is None and self.fd is not None:
            if _is_pollable(self.fd):
                self._handle = self.reactor.register_fd(self.fd, self._handle_readable)
            else:  # after all that the other handlers of this event put off
                self.reactor.register_callback(lambda _: self.reactor.register_callback(self._read_file))

    def _handle_shutdown(self) -> None:
        if self._recent:
            text = "\n".join(
                f"Read {when:.6f}: {data.decode('utf-8', 'replace')!r}" for when, data in self._recent
            )
            logging.info("G-code read lately (%d lines waiting):\n%s", len(self._lines), text)
        if self.is_fileinput:
            self.printer.request_exit("error_exit")

    def _read_file(self, eventtime: float) -> None:
        """Batch mode on a plain file."""
        assert self.fd is not None
        rest = b""
        while not self.printer.is_exiting():
            try:
                data = os.read(self.fd, _READ_SIZE)
            except OSError:
                logging.exception("Unable to read G-code")
                return
            if not data:
                if not rest:
                    self._end_of_file()
                    return
                data = b"\n"
            self._recent.append((self.reactor.monotonic(), data))
            self._bytes_read += len(data)
            text = rest + data
            end = text.rfind(b"\n") + 1
            rest = text[end:]
            with self.gcode.get_mutex():
                self._run_text(text, end)
            self.reactor.pause(self.reactor.NOW)

    def _run_text(self, text: bytes, end: int) -> None:
        """Run the lines of text[:end], until the printer ends."""
        at = 0
        while at < end and not self.printer.is_exiting():
            at = self.gcode.run_next(text, at, end, need_ack=True)

    def _handle_readable(self, eventtime: float) -> None:
        if self._take_in(eventtime) and not self._is_running():
            self._run_waiting()

    def _is_running(self) -> bool:
        """Whether a greenlet runs the lines; one that is paused in a temperature wait leaves new ones to another."""
        return self._runner is not None and not self.gcode.waits.is_frozen(self._runner)

    def _take_in(self, eventtime: float) -> bool:
        """Read what there is into whole lines; False at the end of a file."""
        assert self.fd is not None
        try:
            data = os.read(self.fd, _READ_SIZE)
        except (BlockingIOError, InterruptedError):
            return True
        except OSError:
            logging.exception("Unable to read G-code")
            return False
        if not data:
            if not self.is_fileinput:
                return False
            data = b"\n" if self._partial else b""
            if not data:
                self._end_of_file()
                return False
        self._recent.append((eventtime, data))
        self._bytes_read += len(data)
        *lines, self._partial = (self._partial + data.decode("utf-8", "replace")).split("\n")
        if not self.is_fileinput and any(_EMERGENCY.match(line) for line in lines):
            self.gcode.run_line("M112", need_ack=True)
        for line in lines:
            self._put(line)
        if len(self._lines) > _PENDING_LIMIT and self._runner is not None and self._handle is not None:
            self.reactor.set_fd_wake(self._handle, is_readable=False)
        return True

    def _put(self, line: str) -> None:
        """A line behind the others, or past them if it ends the wait of a script."""
        word = _FIRST_WORD.match(line)
        waits = self.gcode.waits
        if word is None or not waits.is_waiting() or not waits.ends_waits(word[1].upper()):
            self._lines.append(line)
            return

        def run(eventtime: float) -> None:
            with waits.turn(word[1]):
                self.gcode.run_line(line, need_ack=True)

        self.reactor.register_callback(run)

    def _end_of_file(self) -> None:
        if self._handle is not None:
            self.reactor.unregister_fd(self._handle)
            self._handle = None
        if self._runner is not None:
            return
        self._wait_for_print()
        with self.gcode.get_mutex():
            if not self.printer.is_exiting():
                self.gcode.request_restart("exit")

    def _wait_for_print(self) -> None:
        """A file that the input has started is printed to its end."""
        card = self.printer.lookup_object("virtual_sdcard", None)
        while card is not None and card.is_active() and not self.printer.is_exiting():
            self.reactor.pause(self.reactor.monotonic() + _PRINT_POLL_S)

    def _run_waiting(self) -> None:
        me = self._runner = greenlet.getcurrent()
        try:
            while self._lines:
                lines, self._lines = self._lines, []
                if self._handle is not None:
                    self.reactor.set_fd_wake(self._handle, is_readable=True)
                with self.gcode.get_mutex():
                    for line in lines:
                        self.gcode.run_line(line, need_ack=True)
                        if self.is_fileinput and self.printer.is_exiting():
                            return
        except CommandError:
            logging.exception("Error of a line that was to be acknowledged")
        finally:
            if self._runner is me:
                self._runner = None

    def _respond(self, msg: str) -> None:
        """Send a line to the pseudo terminal; without a reader it is dropped."""
        if not self._output_ok or self.fd is None:
            return
        try:
            os.write(self.fd, (msg + "\n").encode())
        except BlockingIOError:
            pass
        except OSError:
            logging.exception("Unable to write to the G-code terminal")
            self._output_ok = False

    def stats(self, eventtime: float) -> tuple[bool, str]:
        """For the statistics line."""
        return False, f"gcodein={self._bytes_read}"


def _is_pollable(fd: int) -> bool:
    """Pipes and terminals are polled; plain files are always ready and read from a callback."""
    return not os.path.isfile(f"/proc/self/fd/{fd}")
