"""What can be said of a G-code file before it is printed: is it one, and do its plain moves stay within the axes?

The second question saves the heating before a part that is too large. It is asked only as far as the answer is
certain: reading ends at the first command that may give coordinates another meaning, such as a macro.
"""

from __future__ import annotations

import math
import mmap
import os
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import chelper
from gcode_command import CHECKSUM, LINE_NUMBER, TRADITIONAL_WORD

# Commands that leave the meaning of coordinates alone.
_HARMLESS = frozenset(
    (
        "G4", "G10", "G11", "G17", "G18", "G19", "G21", "M17", "M18", "M73", "M82", "M83", "M84", "M104", "M105",
        "M106", "M107", "M109", "M110", "M115", "M117", "M118", "M119", "M140", "M190", "M204", "M220", "M221",
        "M400", "T0", "EXCLUDE_OBJECT_DEFINE", "EXCLUDE_OBJECT_END", "EXCLUDE_OBJECT_START", "RESPOND",
        "SET_FAN_SPEED", "SET_HEATER_TEMPERATURE", "SET_INPUT_SHAPER", "SET_PRESSURE_ADVANCE", "SET_PRINT_STATS_INFO",
        "SET_SEGMENT_TEMPERATURE", "SET_VELOCITY_LIMIT", "TEMPERATURE_WAIT",
    )
)  # fmt: skip
_MOVES = frozenset(("G0", "G1", "G2", "G3"))
_AXES = "XYZ"
_PLACE = re.compile(r"([XYZ])([^A-Z]*)")
_NEWLINE = ord("\n")
_NAME = re.compile(r"[A-Z_][A-Z0-9_]*", re.IGNORECASE)
_NUMBERED = re.compile(r"[GMT][0-9]")  # what every dialect's commands look like
_HEAD_BYTES = 8192  # a binary file shows a zero byte within this
# Machines whose axes have ends of their own; of the round ones only x and y are known to end at the reported range.
_RECTANGULAR = frozenset(
    ("cartesian", "corexy", "corexz", "hybrid_corexy", "hybrid_corexz", "generic_cartesian")
)
_ROUND = frozenset(("delta", "rotary_delta", "deltesian", "polar"))


class _UncertainError(Exception):
    """What coordinates mean from here on is not known."""


@dataclass(frozen=True, slots=True)
class Machine:
    """What the printer knows. `knows`: is this a command; `macros`: commands that are the config's own;
    `ranges`: lowest and highest coordinate by axis (mm)."""

    knows: Callable[[str], bool]
    macros: frozenset[str]
    ranges: Mapping[str, tuple[float, float]]


@dataclass(slots=True)
class _Head:
    """Modal state; None: not known."""

    absolute: bool = True
    has_moved: bool = False  # a move was among the lines passed over
    origin: dict[str, float] = field(default_factory=lambda: dict.fromkeys(_AXES, 0.0))
    position: dict[str, float | None] = field(default_factory=lambda: dict.fromkeys(_AXES))


def objection(path: Path, machine: Machine) -> str | None:
    """Why this file can not be printed, as far as that is certain. Raises OSError."""
    with path.open("rb") as stream:
        if b"\0" in stream.read(_HEAD_BYTES):
            return f"{path.name} is not G-code: it is a binary file"
        size = stream.seek(0, os.SEEK_END)
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) if size else b""
    is_gcode, head = False, _Head()
    watching = bool(machine.ranges)
    plain = watching and all(machine.knows(move) and move not in machine.macros for move in ("G0", "G1"))
    for number, line in _lines(data, head, machine.ranges if plain else {}):
        command, rest = _split(line)
        if not command:
            continue
        known = machine.knows(command)
        is_gcode = is_gcode or known or _NUMBERED.match(command) is not None
        if watching and known:
            try:
                problem = _follow(head, command, rest, machine)
            except _UncertainError:
                watching, problem = False, ""
            if problem:
                return f"{path.name}, line {number}: '{line.strip()[:60]}' is out of range: {problem}"
        if is_gcode and not watching:
            return None
    return None if is_gcode or head.has_moved else f"{path.name} is not G-code: no line of it is a command"


def _lines(
    data: mmap.mmap | bytes, head: _Head, ranges: Mapping[str, tuple[float, float]]
) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, without runs of plain moves that stay within the ranges: these are nearly all."""
    ffi, lib = chelper.get_ffi()
    text, span = ffi.from_buffer(data), ffi.new("struct rows_span *")
    number = at = 0
    while at < len(data):
        count = lib.rows_span(span, text + at, len(data) - at) if ranges and head.absolute else 0
        if count and _stay_within(head, span, ranges):
            at, number = at + count, number + span.lines
            continue
        end = at + count if count else data.find(b"\n", at) + 1 or len(data)
        for line in data[at:end].decode(errors="replace").split("\n"):
            number += 1
            yield number, line
        number, at = number - (data[end - 1] == _NEWLINE), end


def _stay_within(head: _Head, span: Any, ranges: Mapping[str, tuple[float, float]]) -> bool:
    """Whether these moves surely do; then the head is where they end. `span`: C's struct rows_span."""
    ends = {}
    for bit, axis in enumerate(_AXES):
        if span.given >> bit & 1:
            low, high = ranges.get(axis, (-math.inf, math.inf))
            origin = head.origin[axis]
            if not low <= origin + span.low[bit] <= origin + span.high[bit] <= high:
                return False
            ends[axis] = origin + span.last[bit]
    head.position.update(ends)
    head.has_moved = head.has_moved or span.moves > 0
    return True


def _split(line: str) -> tuple[str, str]:
    """(name of the command, the rest); empty if the line holds none."""
    if line.startswith(("G1 ", "G0 ")):  # nearly all of them
        return line[:2], line[3:].partition(";")[0]
    text = line.strip()
    numbered = LINE_NUMBER.match(text)
    if numbered is not None:
        text = CHECKSUM.sub("", text[numbered.end() :])
    word = TRADITIONAL_WORD.match(text) or _NAME.match(text)
    if word is None:
        return "", ""
    return "".join(word[0].split()).upper(), text[word.end() :].partition(";")[0]


def _follow(head: _Head, command: str, rest: str, machine: Machine) -> str:
    """Carry out a command; returns what is wrong with where it goes. Raises _UncertainError."""
    if command in machine.macros:
        raise _UncertainError
    if command in _MOVES:
        return _move(head, _words(rest), machine.ranges)
    if command == "G92":
        _set_origin(head, _words(rest) if rest.strip() else dict.fromkeys(_AXES, 0.0))
    elif command in ("G90", "G91"):
        head.absolute = command == "G90"
    elif command == "G28":
        homed = [axis for axis in _AXES if axis in rest.upper()] or _AXES
        if any(head.origin[axis] for axis in _AXES if axis not in homed):
            raise _UncertainError  # which further axes lose their G92 is up to the kinematics
        head.origin, head.position = dict.fromkeys(_AXES, 0.0), dict.fromkeys(_AXES)
    elif command not in _HARMLESS:
        raise _UncertainError
    return ""


def _words(rest: str) -> dict[str, float]:
    try:
        return {name: float(value) for name, value in _PLACE.findall(rest.upper())}
    except ValueError:
        raise _UncertainError from None


def _move(head: _Head, words: Mapping[str, float], ranges: Mapping[str, tuple[float, float]]) -> str:
    """What is wrong with the end of a move."""
    for axis, value in words.items():
        start = head.origin[axis] if head.absolute else head.position[axis]
        if start is None:
            continue
        place = head.position[axis] = start + value
        low, high = ranges.get(axis, (place, place))
        if not low <= place <= high:
            return f"{axis} {place:g}, the printer's {axis} goes from {low:g} to {high:g} mm"
    return ""


def _set_origin(head: _Head, words: Mapping[str, float]) -> None:
    """G92."""
    for axis, value in words.items():
        place = head.position[axis]
        if place is None:
            raise _UncertainError
        head.origin[axis] = place - value


def describe(printer: Any) -> Machine:
    """Of a printer that is ready. Without ranges where the config may shift coordinates behind the file's back."""
    gcode, toolhead = printer.lookup_object("gcode"), printer.lookup_object("toolhead")
    names = [name for name, _ in printer.lookup_objects()]
    macros = frozenset(name.split()[1].upper() for name in names if name.startswith("gcode_macro "))
    config = printer.lookup_object("configfile").get_status(0.0)["config"]
    kinematics = config["printer"]["kinematics"]
    axes = _AXES if kinematics in _RECTANGULAR else "XY" if kinematics in _ROUND else ""
    if any(name.split()[0] in ("delayed_gcode", "homing_override") for name in names):
        axes = ""
    status = toolhead.get_status(printer.get_reactor().monotonic())
    ranges = {
        axis: (status["axis_minimum"][i], status["axis_maximum"][i])
        for i, axis in enumerate(_AXES)
        if axis in axes
    }
    return Machine(lambda command: gcode.get_handler(command) is not None, macros, ranges)
