"""One command line: its two syntaxes, and the object its handler gets.

*Traditional* commands are a letter and a number with one-letter parameters (`G1 X1.5 Y2`, also `G1X1.5Y2`);
*extended* commands are a name with `KEY=value` parameters quoted as in a shell (`SET_X A=1 B="two words"`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any, Protocol


class Dispatch(Protocol):
    """Where answers go (klippy/gcode.py)."""

    def respond_raw(self, msg: str) -> None: ...
    def respond_info(self, msg: str, log: bool = True) -> None: ...


class CommandError(Exception):
    """A command could not be carried out; the text is for the user."""


class _Required:
    """Marks a parameter without default."""


REQUIRED: Any = _Required()
WORD = re.compile(r"([A-Z])([^A-Z]*)")
_TRADITIONAL_NAME = re.compile(r"[A-Z][0-9]+(?:\.[0-9]+)?")
LINE_NUMBER = re.compile(r"\s*[Nn](\d+)\s*")
CHECKSUM = re.compile(r"\*\s*(\d+)\s*$")
TRADITIONAL_WORD = re.compile(r"[A-Z]\s*[0-9]+(?:\.[0-9]+)?(?![A-Z0-9_]*_)", re.IGNORECASE)
_KEY = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_]*)=")
_VALUE_PIECE = re.compile(r"""[^\s"'\\;#]+|"(?:[^"\\]|\\.)*"|'[^']*'|\\.""", re.DOTALL)
_ESCAPE = re.compile(r'\\(["\\])')


class GCodeCommand:
    """One command with its parameters, as handed to its handler."""

    __slots__ = ("_command", "_commandline", "_dispatch", "_need_ack", "_params")

    error = CommandError

    def __init__(
        self, dispatch: Dispatch, command: str, commandline: str, params: dict[str, str], need_ack: bool
    ) -> None:
        self._dispatch = dispatch
        self._command = command
        self._commandline = commandline
        self._params = params
        self._need_ack = need_ack

    # --- what was typed ---
    def get_command(self) -> str:
        """Name of the command, upper case."""
        return self._command

    def get_commandline(self) -> str:
        """The whole line as received."""
        return self._commandline

    def get_command_parameters(self) -> dict[str, str]:
        """Parameters by (upper case) name; values are text as received."""
        return self._params

    def get_raw_command_parameters(self) -> str:
        """Everything behind the command word, without line number, checksum and comment (for M117 and the like)."""
        line = self._commandline
        number = LINE_NUMBER.match(line)
        if number is not None:
            line = CHECKSUM.sub("", line[number.end() :])
        line = line.lstrip()
        if line.upper().startswith(self._command):
            line = line[len(self._command) :]
        else:  # `m 117 text`
            word = TRADITIONAL_WORD.match(line)
            line = line[word.end() :] if word else line
        return line.partition(";")[0].strip()

    # --- answering ---
    def ack(self, msg: str | None = None) -> bool:
        """Send `ok` (with `msg`) if the sender waits for one; False if it does not."""
        if not self._need_ack:
            return False
        self._need_ack = False
        self._dispatch.respond_raw(f"ok {msg}" if msg else "ok")
        return True

    def respond_info(self, msg: str, log: bool = True) -> None:
        """Send the user a message."""
        self._dispatch.respond_info(msg, log)

    def respond_raw(self, msg: str) -> None:
        """Send a line without a prefix."""
        self._dispatch.respond_raw(msg)

    # --- parameters ---
    def get(
        self,
        name: str,
        default: Any = REQUIRED,
        parser: Callable[[str], Any] = str,
        minval: float | None = None,
        maxval: float | None = None,
        above: float | None = None,
        below: float | None = None,
    ) -> Any:
        """A parameter turned into a value by `parser` and checked against the bounds."""
        text = self._params.get(name)
        if text is None:
            if default is REQUIRED:
                raise CommandError(f"Error on '{self._commandline}': missing {name}")
            return default
        try:
            value = parser(text)
        except (ValueError, TypeError, ArithmeticError):
            kind = _PARSER_KIND.get(parser, "valid")
            if not text:
                raise CommandError(
                    f"{self._command}: {name} needs {kind}: '{self._commandline.strip()}'"
                ) from None
            raise CommandError(f"{self._command}: {name}: '{text}' is not {kind}") from None
        if minval is not None and value < minval:
            raise CommandError(f"{self._command}: {name} must have minimum of {minval}, it is {text}")
        if maxval is not None and value > maxval:
            raise CommandError(f"{self._command}: {name} must have maximum of {maxval}, it is {text}")
        if above is not None and value <= above:
            raise CommandError(f"{self._command}: {name} must be above {above}, it is {text}")
        if below is not None and value >= below:
            raise CommandError(f"{self._command}: {name} must be below {below}, it is {text}")
        return value

    def get_int(
        self, name: str, default: Any = REQUIRED, minval: int | None = None, maxval: int | None = None
    ) -> Any:
        """A whole number."""
        return self.get(name, default, parse_int, minval, maxval)

    def get_float(
        self,
        name: str,
        default: Any = REQUIRED,
        minval: float | None = None,
        maxval: float | None = None,
        above: float | None = None,
        below: float | None = None,
    ) -> Any:
        """A finite number."""
        return self.get(name, default, parse_float, minval, maxval, above, below)


def parse_float(text: str) -> float:
    """A finite number; ValueError otherwise."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def parse_int(text: str) -> int:
    """A whole number; ValueError otherwise."""
    return int(text)


_PARSER_KIND: dict[Any, str] = {
    parse_float: "a number",
    float: "a number",
    parse_int: "a whole number",
    int: "a whole number",
}


def is_traditional(command: str) -> bool:
    """Whether a command name is of the letter-and-number kind."""
    return _TRADITIONAL_NAME.fullmatch(command) is not None


def parse_traditional(text: str) -> dict[str, str]:
    """One-letter parameters of a traditional command; the text must be upper case and without comment."""
    text = text.strip()
    if not text:
        return {}
    if not "A" <= text[0] <= "Z":
        raise CommandError(f"Malformed parameters '{text}': expected a letter first")
    return {letter: value.strip() for letter, value in WORD.findall(text)}


def parse_extended(text: str) -> dict[str, str]:
    """`KEY=value` parameters of an extended command; an unquoted # or ; starts a comment."""
    params: dict[str, str] = {}
    position = 0
    while True:
        rest = text[position:].lstrip()
        if not rest or rest[0] in ";#":
            return params
        key = _KEY.match(text, position)
        if key is None:
            raise CommandError(f"Malformed parameters '{rest}': expected NAME=value")
        value, position = _read_value(text, key.end())
        params[key[1].upper()] = value


def _read_value(text: str, position: int) -> tuple[str, int]:
    """A shell-like word starting at `position`, and where it ends."""
    pieces: list[str] = []
    while True:
        piece = _VALUE_PIECE.match(text, position)
        if piece is None:
            if text[position : position + 1] in ('"', "'", "\\"):
                raise CommandError(f"Malformed parameters '{text[position:]}': quote without an end")
            return "".join(pieces), position
        token = piece[0]
        if token[0] == '"':
            token = _ESCAPE.sub(r"\1", token[1:-1])
        elif token[0] == "'":
            token = token[1:-1]
        elif token[0] == "\\":
            token = token[1:]
        pieces.append(token)
        position = piece.end()
