"""[save_variables]: values that survive restarts, in a file of their own."""

from __future__ import annotations

import os
from typing import Any

import util
from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

from .gcode_macro import parse_literal

_SECTION = "Variables"


def lasting_literal(text: str) -> Any:
    """The value of a Python literal that comes back from the file as it went in; ValueError otherwise."""
    try:
        value = parse_literal(text)
        if parse_literal(repr(value)) == value:
            return value
    except ValueError:
        pass
    raise ValueError(
        f"'{text:.60}' cannot be saved; expected a finite number, a quoted text, True, False, None, or a list, "
        "tuple or dict of those"
    )


class SaveVariables:
    """The object `save_variables`; its status is {"variables": {...}}."""

    def __init__(self, printer: Printer, path: str) -> None:
        self.printer = printer
        self.filename = os.path.expanduser(path)
        self.variables: dict[str, Any] = {}

    def register(self) -> None:
        """Read the file (making it if need be) and make the command known."""
        if not os.path.exists(self.filename):
            self._write({})
        self.variables = self._read()
        self.printer.lookup_object("gcode").register_command(
            "SAVE_VARIABLE", self.cmd_SAVE_VARIABLE, desc="Save arbitrary variables to disk"
        )

    def get_status(self, eventtime: float) -> dict[str, Any]:
        """All variables."""
        return {"variables": dict(self.variables)}

    @property
    def allVariables(self) -> dict[str, Any]:
        """The name plugins know. What they put in is in the file after the next SAVE_VARIABLE."""
        return self.variables

    def _read(self) -> dict[str, Any]:
        data: dict[str, Any] = {}
        try:
            lines = util.read_plain(self.filename).split("\n")
        except (OSError, UnicodeDecodeError) as e:
            raise self.printer.command_error(
                f"Unable to read the variable file {self.filename}: {e}"
            ) from None
        for number, line in enumerate(lines, 1):
            name, equals, text = line.strip().partition("=")
            if equals and not name.startswith(("#", ";", "[")):
                try:
                    data[name.strip().lower()] = lasting_literal(text.strip())
                except ValueError as e:
                    raise self.printer.command_error(
                        f"Unable to parse the variable file {self.filename}, line {number}: {name.strip()}: {e}. "
                        "Correct the line or delete it."
                    ) from None
        return data

    def _write(self, values: dict[str, Any]) -> None:
        text = f"[{_SECTION}]\n" + "".join(f"{name} = {value!r}\n" for name, value in sorted(values.items()))
        try:
            util.replace_file(self.filename, text)
        except OSError as e:
            raise self.printer.command_error(
                f"Unable to save variables: {e.strerror}: {self.filename}"
            ) from None

    def cmd_SAVE_VARIABLE(self, gcmd: GCodeCommand) -> None:
        """Set a variable and write the file."""
        name, text = gcmd.get("VARIABLE"), gcmd.get("VALUE")
        if name.lower() != name or not name.isidentifier():
            raise gcmd.error("VARIABLE must be a lower case name")
        try:
            value = lasting_literal(text)
        except ValueError as e:
            raise gcmd.error(f"SAVE_VARIABLE: VALUE: {e}") from None
        self._write({**self.variables, name: value})
        self.variables[name] = value


def load_config(config: ConfigWrapper) -> SaveVariables:
    """Section [save_variables]."""
    variables = SaveVariables(config.get_printer(), config.get("filename"))
    variables.register()
    return variables
