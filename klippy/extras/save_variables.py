"""[save_variables]: values that survive restarts, in a file of their own."""

from __future__ import annotations

import os
from typing import Any

from .gcode_macro import parse_literal

_SECTION = "Variables"


class SaveVariables:
    """The object `save_variables`; its status is {"variables": {...}}."""

    def __init__(self, printer: Any, path: str) -> None:
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
        return {"variables": self.variables}

    def _read(self) -> dict[str, Any]:
        data: dict[str, Any] = {}
        try:
            with open(self.filename, encoding="utf-8") as file:
                for line in file:
                    name, equals, text = line.strip().partition("=")
                    if equals and not name.startswith(("#", ";", "[")):
                        data[name.strip().lower()] = parse_literal(text.strip())
        except (OSError, ValueError) as e:
            raise self.printer.command_error(
                f"Unable to parse existing variable file {self.filename}: {e}"
            ) from None
        return data

    def _write(self, values: dict[str, Any]) -> None:
        text = f"[{_SECTION}]\n" + "".join(f"{name} = {value!r}\n" for name, value in sorted(values.items()))
        temporary = self.filename + ".new"
        try:
            with open(temporary, "w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, self.filename)
        except OSError as e:
            raise self.printer.command_error(
                f"Unable to save variables: {e.strerror}: {self.filename}"
            ) from None

    def cmd_SAVE_VARIABLE(self, gcmd: Any) -> None:
        """Set a variable and write the file."""
        name, text = gcmd.get("VARIABLE"), gcmd.get("VALUE")
        if name.lower() != name or not name.isidentifier():
            raise gcmd.error("VARIABLE must be a lower case name")
        try:
            value = parse_literal(text)
        except ValueError as e:
            raise gcmd.error(f"Unable to parse '{text}' as a literal: {e}") from None
        changed = {**self.variables, name: value}
        self._write(changed)
        self.variables = changed


def load_config(config: Any) -> SaveVariables:
    """Section [save_variables]."""
    variables = SaveVariables(config.get_printer(), config.get("filename"))
    variables.register()
    return variables
