"""[respond]: M118 and RESPOND send text to the user."""

from __future__ import annotations

from configfile import ConfigWrapper
from gcode import GCodeCommand
from roles import Printer

_PREFIXES = {"echo": "echo:", "command": "//", "error": "!!"}
_TYPES = {**{name: prefix + " " for name, prefix in _PREFIXES.items()}, "echo_no_space": "echo:"}


class HostResponder:
    """The object `respond`."""

    def __init__(self, printer: Printer, prefix: str) -> None:
        self._gcode = printer.lookup_object("gcode")
        self._prefix = prefix

    def register(self) -> None:
        """Make the commands known."""
        self._gcode.register_command("M118", self.cmd_M118, True)
        self._gcode.register_command("RESPOND", self.cmd_RESPOND, True, desc=self.cmd_RESPOND_help)

    def cmd_M118(self, gcmd: GCodeCommand) -> None:
        """Send the rest of the line with the default prefix."""
        gcmd.respond_raw(f"{self._prefix}{gcmd.get_raw_command_parameters()}")

    cmd_RESPOND_help = "Echo the message prepended with a prefix"

    def cmd_RESPOND(self, gcmd: GCodeCommand) -> None:
        """Send MSG with the prefix of TYPE, or PREFIX."""
        prefix = self._prefix
        kind = gcmd.get("TYPE", None)
        if kind is not None:
            if kind.lower() not in _TYPES:
                raise gcmd.error(
                    f"RESPOND TYPE '{kind}' is invalid. Must be one of {', '.join(map(repr, _TYPES))}"
                )
            prefix = _TYPES[kind.lower()]
        own = gcmd.get("PREFIX", None)
        if own is not None:
            prefix = own + " "
        gcmd.respond_raw(f"{prefix}{gcmd.get('MSG', '')}")


def load_config(config: ConfigWrapper) -> HostResponder:
    """Section [respond]."""
    kind = config.getchoice("default_type", _PREFIXES, "echo")
    responder = HostResponder(config.get_printer(), config.get("default_prefix", kind) + " ")
    responder.register()
    return responder
