"""Temperature waits of scripts, and the commands that end them from outside.

A script holds the G-code lock while it waits for a temperature. PAUSE, CANCEL_PRINT, M108 and restarts from elsewhere
would wait behind it; so they are announced before they wait for the lock (`turn`), and the waiting script looks:

    PAUSE                    the script keeps its place and gives the lock away until RESUME; then it waits anew
    CANCEL_PRINT, a restart  the script ends there, with the macros around it
    M108                     the same; a print from a file ends with an error, its heaters off
    ABORT                    the same for a script that waits for a calibration

No line behind a wait runs before the temperature is reached.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import greenlet

from gcode_command import CommandError

PAUSE, RESUME = "PAUSE", "RESUME"
ENDING = frozenset({"CANCEL_PRINT", "M108", "RESTART", "FIRMWARE_RESTART"})


class ScriptEnded(CommandError):
    """A script was ended in its wait. `by`: the command that did."""

    def __init__(self, what: str, by: str) -> None:
        super().__init__(f"{by} ended the wait for {what}; the rest of the script was not run")
        self.by = by


class _Frozen:
    """A script that keeps its place in a wait without holding the lock."""

    def __init__(self, owner: Any) -> None:
        self.owner = owner
        self.is_held = True
        self.ended_by: str | None = None
        self.wake: Any = None


class ScriptWaits:
    """Who waits for the lock to end a wait, and the script that is frozen in one."""

    def __init__(self, printer: Any, mutex: Any, is_command: Callable[[str], bool]) -> None:
        self._printer = printer
        self._reactor = printer.get_reactor()
        self._mutex = mutex
        self._is_command = is_command
        self._pending: list[str] = []  # commands that wait for the lock and end waits
        self._holder = ""  # first command of the script that holds the lock
        self._more: frozenset[str] = frozenset()  # what ends the present wait beside ENDING
        self._alarm: Any = None  # completed by an announcement
        self._frozen: _Frozen | None = None
        for event in ("klippy:shutdown", "klippy:disconnect"):
            printer.register_event_handler(event, lambda: self.end("the stop of the printer"))

    # --- scripts from outside ---
    @contextmanager
    def turn(self, script: str) -> Iterator[None]:
        """Hold the lock for a script; it is announced to waits before if it begins with a command that ends them."""
        words = script.split(None, 1)
        first = words[0].upper() if words else ""
        ends = self.ends_waits(first)
        if ends:
            self._pending.append(first)
            if self._alarm is not None:
                self._alarm.complete(None)
        try:
            self._mutex.lock()
        finally:
            if ends:
                self._pending.remove(first)
        before, self._holder = self._holder, first
        try:
            yield
        finally:
            self._holder = before
            if first == PAUSE and not self._is_paused():
                self.thaw()  # the macro PAUSE did not come to pausing
            self._mutex.unlock()

    def ends_waits(self, command: str) -> bool:
        """Whether a command from outside ends waits; PAUSE only where RESUME can let the script go on."""
        if command == PAUSE:
            return self._printer.lookup_object("pause_resume", None) is not None
        return command in ENDING | self._more and self._is_command(command)

    def is_waiting(self) -> bool:
        """Whether a script waits for a temperature now, or is frozen in its wait."""
        return self._alarm is not None or self._frozen is not None

    # --- the waiting script ---
    @contextmanager
    def ended_by(self, *commands: str) -> Iterator[None]:
        """These commands end the waits within, too."""
        before, self._more = self._more, self._more | set(commands)
        try:
            yield
        finally:
            self._more = before

    def sleep(self, waketime: float, what: str) -> bool:
        """One look of a wait: sleep until `waketime`, sooner if a command ends the wait. True: the script was frozen
        and goes on now, so that what it waits for must be set again. Raises ScriptEnded."""
        if self._next(what) is None:
            self._alarm = self._reactor.completion()
            try:
                self._alarm.wait(waketime)
            finally:
                self._alarm = None
        request = self._next(what)
        if request is None:
            return False
        if request != PAUSE or self._holder == RESUME:
            raise ScriptEnded(what, request)
        self._freeze(what)
        return True

    def _next(self, what: str) -> str | None:
        """The command that is to end the wait of the script that holds the lock."""
        for command in self._pending:
            if command == PAUSE:
                # A paused print needs no pause; but RESUME is stopped on its way
                if self._holder == RESUME or (self._holder != PAUSE and not self._is_paused()):
                    return command
            elif self._holder != command:
                return command
        return None

    def _freeze(self, what: str) -> None:
        frozen = self._frozen = _Frozen(greenlet.getcurrent())
        holder = self._holder
        try:
            while frozen.is_held:
                frozen.wake = self._reactor.completion()
                self._holder = ""
                self._mutex.unlock()
                frozen.wake.wait()
                self._mutex.lock()
        finally:
            self._frozen = None
        self._holder = holder
        if frozen.ended_by is not None:
            raise ScriptEnded(what, frozen.ended_by)

    # --- pausing, resuming, cancelling ---
    def is_frozen(self, owner: Any) -> bool:
        """Whether this greenlet runs the frozen script."""
        return self._frozen is not None and self._frozen.owner is owner

    def hold(self) -> None:
        """Paused again before the script could go on."""
        if self._frozen is not None and self._frozen.ended_by is None:
            self._frozen.is_held = True

    def thaw(self) -> None:
        """The frozen script goes on with its wait."""
        if self._frozen is not None:
            self._frozen.is_held = False
            self._frozen.wake.complete(None)

    def end(self, by: str) -> None:
        """The frozen script ends where it is, by the running script, or else by `by`."""
        if self._frozen is not None:
            self._frozen.ended_by = self._holder or by
            self.thaw()

    def _is_paused(self) -> bool:
        pause_resume = self._printer.lookup_object("pause_resume", None)
        return bool(pause_resume is not None and pause_resume.is_paused)
