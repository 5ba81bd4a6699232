"""What a nozzle has to say to people: once in the console, on the display line, and in status until it is read."""

from __future__ import annotations

import logging
import math

from roles import Printer

KIND_LENGTH = 20  # texts that begin alike are of one kind: their numbers change
KEPT_MAX = 8
AGAIN_S = 60.0  # a kind that was away for less is not news


class Notices:
    """Warnings and faults of one [induction_heater]."""

    def __init__(self, printer: Printer, section_name: str) -> None:
        self.printer = printer
        self.section_name = section_name
        self.kept: list[str] = []  # until INDUCTION_STATUS shows them
        self._seen_s: dict[str, float] = {}  # by kind

    def keep(self, text: str) -> None:
        """A fault, which the stop of the printer reports."""
        self.kept = [*self.kept, text][-KEPT_MAX:]
        display = self.printer.lookup_object("display_status", None)
        if display is not None:
            display.message = text

    def warn(self, text: str) -> None:
        line = f"Induction heater '{self.section_name}': {text}"
        logging.warning("%s", line)
        self.printer.lookup_object("gcode").respond_raw(f"!! Warning: {line}")
        self.keep(text)

    def warn_once(self, text: str) -> None:
        """To be called regularly; "": all is well."""
        if not text:
            return
        now_s, kind = self.printer.get_reactor().monotonic(), text[:KIND_LENGTH]
        before_s = self._seen_s.get(kind, -math.inf)
        self._seen_s[kind] = now_s
        if now_s - before_s > AGAIN_S:
            self.warn(text)

    def read(self) -> list[str]:
        """A person has seen them."""
        kept, self.kept = self.kept, []
        display = self.printer.lookup_object("display_status", None)
        if display is not None and display.message in kept:
            display.message = None
        return kept
