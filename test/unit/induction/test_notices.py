"""Warnings of a nozzle: said once, and again when they come back after a while."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from extras.induction.notices import Notices

DRIFT = "the thermometer seems to have drifted by {:+.0f} C"
WRONG = "wrong nozzle? its heat capacity measures {:.2f} times the one set up"


class Printer:
    """What notices need of it."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.lines: list[str] = []

    def get_reactor(self) -> Any:
        return SimpleNamespace(monotonic=lambda: self.now_s)

    def lookup_object(self, name: str, default: Any = None) -> Any:
        return SimpleNamespace(respond_raw=self.lines.append) if name == "gcode" else default


def test_a_warning_that_comes_and_goes_is_said_once() -> None:
    printer = Printer()
    notices = Notices(printer, "nozzle")  # type: ignore[arg-type]
    for step in range(1000):
        printer.now_s = 0.1 * step
        notices.warn_once(DRIFT.format(step % 7) if step % 25 < 5 else "")
    assert len(printer.lines) == len(notices.kept) == 1


def test_another_warning_is_said_at_once_and_one_that_was_away_for_minutes_again() -> None:
    printer = Printer()
    notices = Notices(printer, "nozzle")  # type: ignore[arg-type]
    for now_s, text in ((0.0, DRIFT), (1.0, WRONG), (2.0, DRIFT), (30.0, DRIFT), (120.0, DRIFT)):
        printer.now_s = now_s
        notices.warn_once(text.format(12.0))
    assert ["drifted" in line for line in printer.lines] == [True, False, True]
