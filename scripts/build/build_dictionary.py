#!/usr/bin/env python3
"""Collect the message declarations of the firmware sources; write the tables and the data dictionary.

Usage: build_dictionary.py --out DIR [--version TEXT] --cc 'gcc -Isrc -Isrc/simulator' SOURCE...

Every source is preprocessed with -DDICTIONARY_PASS, under which the DECL_ macros of src/command.h leave
`DICT_ENTRY_KIND(arguments)` in the text.  From these come

* DIR/compile_time.c: command table, response encoders, init/task/shutdown calls, the compressed dictionary
* DIR/ferrite.dict: the dictionary as JSON text, as a host gets it from `identify`

Message ids: identify_response 0 and identify 1 are fixed; commands follow in source order without gaps (the
firmware indexes its table with them), then responses, which use the one-byte negative numbers -32..-1 once the
one-byte positive ones (up to 95) are used up.
"""

from __future__ import annotations

import argparse
import ast
import json
import operator
import re
import shlex
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

NUMBER_TYPES = {"%c": "u", "%hu": "u", "%hi": "s", "%u": "w", "%i": "w"}
BUFFER_TYPES = ("%*s", "%.*s")
COMMAND_ARGS_MAX = 12  # as in src/command.h
COMMAND_FLAGS = {"0": 0, "HF_IN_SHUTDOWN": 1}
IDENTIFY = "identify offset=%u count=%c"
IDENTIFY_RESPONSE = "identify_response offset=%u data=%.*s"
ONE_BYTE_MAX, ONE_BYTE_MIN = 95, -32


class DeclarationError(Exception):
    """A declaration that cannot be used; the text names file and line."""


@dataclass(frozen=True, slots=True)
class Place:
    file: str
    line: int

    def __str__(self) -> str:
        return f"{self.file}:{self.line}"


@dataclass(frozen=True, slots=True)
class Unit:
    """One source file and the compiler it is built with."""

    source: str
    compiler: tuple[str, ...]

    def preprocess(self) -> str:
        command = [*self.compiler, "-E", "-DDICTIONARY_PASS", self.source]
        run = subprocess.run(command, capture_output=True, text=True, check=False)
        if run.returncode:
            raise DeclarationError(f"{self.source} could not be preprocessed:\n{run.stderr.strip()}")
        return run.stdout

    def compile_time_value(self, expression: str, place: Place) -> int:
        """The value of an expression with enumerators or sizeof: the compiler prints it into assembler text."""
        probe = f'__asm__ volatile (".ascii \\"DICT_VALUE %c0 END\\"" :: "i" ((long)({expression})));'
        text = f'#include "{Path(self.source).resolve()}"\nvoid dictionary_probe(void) {{ {probe} }}\n'
        command = [*self.compiler, "-fno-lto", "-S", "-w", "-x", "c", "-o", "-", "-"]
        run = subprocess.run(command, input=text, capture_output=True, text=True, check=False)
        found = re.search(r"DICT_VALUE [$#]?(-?\d+) END", run.stdout)
        if run.returncode or not found:
            raise DeclarationError(f"{place}: '{expression}' is not a compile-time integer constant.")
        return int(found[1])


@dataclass(frozen=True, slots=True)
class Entry:
    """One DICT_ENTRY_ call: its kind, its argument texts, where it stands."""

    kind: str
    args: tuple[str, ...]
    place: Place
    unit: Unit


@dataclass(frozen=True, slots=True)
class Message:
    """A command (symbol = handler) or a response (symbol = variable)."""

    symbol: str
    format: str
    types: tuple[str, ...]  # "%c" ... of each parameter
    place: Place
    flags: int = 0

    @property
    def name(self) -> str:
        return self.format.split()[0]

    @property
    def buffer_index(self) -> int | None:
        return next((i for i, kind in enumerate(self.types) if kind in BUFFER_TYPES), None)

    @property
    def letters(self) -> str:
        return "".join(NUMBER_TYPES.get(kind, "b") for kind in self.types)


@dataclass(slots=True)
class Declarations:
    """All that the sources declare, in source order."""

    commands: list[Message] = field(default_factory=list)
    responses: list[Message] = field(default_factory=list)
    constants: dict[str, int | str] = field(default_factory=dict)
    enumerations: dict[str, dict[str, int | list[int]]] = field(default_factory=dict)
    functions: dict[str, list[str]] = field(default_factory=lambda: {"INIT": [], "TASK": [], "SHUTDOWN": []})
    places: dict[tuple[str, str], Place] = field(default_factory=dict)

    def claim(self, kind: str, name: str, place: Place) -> None:
        """Raise if `name` is already taken by another declaration of this kind."""
        earlier = self.places.setdefault((kind, name), place)
        if earlier is not place:
            raise DeclarationError(f"{place}: {kind} '{name}' is declared already at {earlier}.")


# ---------------------------------------------------------------- reading C


def scan_entries(unit: Unit) -> Iterator[Entry]:
    """Find the DICT_ENTRY_ calls in a preprocessed source, following its line markers."""
    text = unit.preprocess()
    place_of = line_map(text)
    for match in re.finditer(r"\bDICT_ENTRY_([A-Z_]+)\s*\(", text):
        place = place_of(match.start())
        yield Entry(match[1], tuple(split_arguments(text, match.end(), place)), place, unit)


def line_map(text: str) -> Callable[[int], Place]:
    """A function from character offset to source place, by the `# line "file"` markers."""
    starts: list[tuple[int, Place]] = []
    offset, here = 0, Place("?", 1)
    for line in text.splitlines(keepends=True):
        marker = re.match(r'#\s+(\d+)\s+"((?:[^"\\]|\\.)*)"', line)
        if marker:
            here = Place(marker[2], int(marker[1]))
        else:
            starts.append((offset, here))
            here = Place(here.file, here.line + 1)
        offset += len(line)

    def find(position: int) -> Place:
        low, high = 0, len(starts)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if starts[middle][0] <= position else (low, middle)
        return starts[low][1] if starts else here

    return find


def split_arguments(text: str, position: int, place: Place) -> list[str]:
    """The comma-separated arguments that begin at `position`, up to the parenthesis that closes them."""
    args: list[str] = []
    current: list[str] = []
    depth = 1
    for token in re.finditer(r'"(?:[^"\\]|\\.)*"|[(),]|[^"(),]+', text[position:]):
        piece = token[0]
        depth += {"(": 1, ")": -1}.get(piece, 0)
        if depth == 0:
            args.append("".join(current).strip())
            return args
        if piece == "," and depth == 1:
            args.append("".join(current).strip())
            current = []
        else:
            current.append(piece)
    raise DeclarationError(f"{place}: the declaration's closing parenthesis is missing.")


def string_value(arg: str, place: Place) -> str:
    """The text of adjacent C string literals."""
    if not re.fullmatch(r'\s*("(?:[^"\\]|\\.)*"\s*)+', arg):
        raise DeclarationError(f"{place}: a string literal is needed here, not: {arg}")
    return "".join(str(ast.literal_eval(piece)) for piece in re.findall(r'"(?:[^"\\]|\\.)*"', arg))


OPERATORS: dict[type[ast.AST], Callable[..., int]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: lambda a, b: int(a / b),
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.BitOr: operator.or_,
    ast.BitAnd: operator.and_,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
    ast.Invert: operator.invert,
}


def integer_value(entry: Entry, index: int) -> int:
    """The value of an integer argument: literals (what macros expand to) are computed here, names by the compiler."""
    arg = entry.args[index]
    if re.search(r"\b[A-Za-z_]", re.sub(r"\b0[xX]", "0", arg)):
        return entry.unit.compile_time_value(arg, entry.place)
    return literal_value(arg, entry.place)


def literal_value(arg: str, place: Place) -> int:
    plain = re.sub(r"\b(0[xX][0-9a-fA-F]+|\d+)[uUlL]+\b", r"\1", arg)

    def value(node: ast.AST) -> int:
        match node:
            case ast.Expression(body=body):
                return value(body)
            case ast.Constant(value=int(number)):
                return number
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(left), value(right))
            case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
                return OPERATORS[type(op)](value(operand))
        raise DeclarationError(f"{place}: '{arg}' is not a constant the preprocessor can compute.")

    try:
        return value(ast.parse(plain.strip(), mode="eval"))
    except (SyntaxError, ZeroDivisionError) as error:
        raise DeclarationError(f"{place}: '{arg}' is not an integer expression.") from error


# ---------------------------------------------------------------- understanding


def parse_message(symbol: str, text: str, place: Place, flags: int = 0) -> Message:
    """Check a message format and take its parameter types apart."""
    words = text.split(" ")
    if not re.fullmatch(r"[a-z_][a-z0-9_]*", words[0]):
        raise DeclarationError(f"{place}: '{text}' does not begin with a message name.")
    types: list[str] = []
    names: set[str] = set()
    for word in words[1:]:
        name, equals, kind = word.partition("=")
        if not equals or not re.fullmatch(r"[a-z_][a-z0-9_]*", name):
            raise DeclarationError(
                f"{place}: parameter '{word}' of '{words[0]}' is not of the form name=%type."
            )
        if kind not in NUMBER_TYPES and kind not in BUFFER_TYPES:
            known = " ".join([*NUMBER_TYPES, *BUFFER_TYPES])
            raise DeclarationError(
                f"{place}: parameter '{word}' of '{words[0]}' has an unknown type (known: {known})."
            )
        if name in names:
            raise DeclarationError(f"{place}: '{words[0]}' has two parameters called '{name}'.")
        names.add(name)
        types.append(kind)
    return Message(symbol, text, tuple(types), place, flags)


def add_command(found: Declarations, entry: Entry) -> None:
    handler, flags, text = entry.args
    if flags not in COMMAND_FLAGS:
        raise DeclarationError(
            f"{entry.place}: unknown command flag '{flags}' (known: {' '.join(COMMAND_FLAGS)})."
        )
    message = parse_message(handler, string_value(text, entry.place), entry.place, COMMAND_FLAGS[flags])
    buffers = sum(kind in BUFFER_TYPES for kind in message.types)
    if buffers > 1 or len(message.types) - buffers > COMMAND_ARGS_MAX:
        raise DeclarationError(
            f"{entry.place}: command '{message.name}' has more than {COMMAND_ARGS_MAX} numbers or than one byte string."
        )
    found.claim("command", message.name, entry.place)
    found.commands.append(message)


def add_response(found: Declarations, entry: Entry) -> None:
    symbol, text = entry.args
    message = parse_message(symbol, string_value(text, entry.place), entry.place)
    found.claim("response", message.name, entry.place)
    found.responses.append(message)


def add_constant(found: Declarations, entry: Entry) -> None:
    name = string_value(entry.args[0], entry.place)
    is_text = entry.kind.endswith("_STR")
    value = string_value(entry.args[1], entry.place) if is_text else integer_value(entry, 1)
    found.claim("constant", name, entry.place)
    found.constants[name] = value


def add_enumeration(found: Declarations, entry: Entry) -> None:
    enumeration, text = (string_value(arg, entry.place) for arg in entry.args[:2])
    first, count = integer_value(entry, 2), integer_value(entry, 3)
    if count != 1 and not text[-1:].isdigit():
        raise DeclarationError(f"{entry.place}: the first name of a range must end in digits, not '{text}'.")
    found.claim(f"value of enumeration '{enumeration}'", text, entry.place)
    found.enumerations.setdefault(enumeration, {})[text] = first if count == 1 else [first, count]


def add_series(found: Declarations, entry: Entry) -> None:
    """A row of an X-macro table: numbered from 1 in order, as the C enum beside it is."""
    enumeration, text = (string_value(arg, entry.place) for arg in entry.args[:2])
    found.claim(f"value of enumeration '{enumeration}'", text, Place(entry.place.file, entry.place.line))
    rows = found.enumerations.setdefault(enumeration, {})
    rows[text] = len(rows) + 1


def add_function(found: Declarations, entry: Entry) -> None:
    found.claim(f"{entry.kind.lower()} function", entry.args[0], entry.place)
    found.functions[entry.kind].append(entry.args[0])


HANDLERS: dict[str, tuple[int, Callable[[Declarations, Entry], None]]] = {
    "COMMAND": (3, add_command),
    "RESPONSE": (2, add_response),
    "CONSTANT": (2, add_constant),
    "CONSTANT_STR": (2, add_constant),
    "ENUMERATION": (4, add_enumeration),
    "SERIES": (3, add_series),
    "INIT": (1, add_function),
    "TASK": (1, add_function),
    "SHUTDOWN": (1, add_function),
}


def collect(units: list[Unit]) -> Declarations:
    """All declarations in all sources."""
    found = Declarations()
    for entry in (entry for unit in units for entry in scan_entries(unit)):
        arity, handler = HANDLERS.get(entry.kind, (-1, add_function))
        if len(entry.args) != arity:
            raise DeclarationError(
                f"{entry.place}: a {entry.kind} declaration cannot have {len(entry.args)} arguments."
            )
        handler(found, entry)
    formats = {message.format for message in found.commands}, {message.format for message in found.responses}
    if IDENTIFY not in formats[0] or IDENTIFY_RESPONSE not in formats[1]:
        raise DeclarationError(f"The sources must declare the command '{IDENTIFY}' and its response.")
    return found


# ---------------------------------------------------------------- numbering and writing


def number_messages(found: Declarations) -> tuple[dict[str, int], dict[str, int]]:
    """Ids by format, for commands and for responses."""
    commands = sorted(found.commands, key=lambda message: message.format != IDENTIFY)
    command_ids = {message.format: number for number, message in enumerate(commands, 1)}
    others = [message.format for message in found.responses if message.format != IDENTIFY_RESPONSE]
    first_free = len(commands) + 1
    short = [*range(first_free, ONE_BYTE_MAX + 1), *range(ONE_BYTE_MIN, 0)]
    long_first = max(first_free, ONE_BYTE_MAX + 1)
    free = [*short, *range(long_first, long_first + len(others))]
    response_ids = {IDENTIFY_RESPONSE: 0} | dict(zip(others, free, strict=False))
    return command_ids, response_ids


def make_dictionary(
    found: Declarations, version: str, build_versions: str, license_name: str
) -> dict[str, object]:
    command_ids, response_ids = number_messages(found)
    return {
        "app": "Ferrite",
        "license": license_name,
        "version": version,
        "build_versions": build_versions,
        "commands": command_ids,
        "responses": response_ids,
        "enumerations": found.enumerations,
        "config": found.constants,
    }


def command_rows(found: Declarations) -> Iterator[str]:
    for message in sorted(found.commands, key=lambda command: command.format != IDENTIFY):
        buffer_index = message.buffer_index
        position = "COMMAND_NO_BUFFER" if buffer_index is None else str(buffer_index)
        yield f"    {{ {message.symbol}, {message.flags}, {len(message.types)}, {position} }},  /* {message.name} */"


def byte_rows(data: bytes) -> Iterator[str]:
    for offset in range(0, len(data), 20):
        yield "    " + ", ".join(str(byte) for byte in data[offset : offset + 20]) + ","


def make_c_text(found: Declarations, identify: bytes) -> str:
    """The generated C file."""
    _, response_ids = number_messages(found)
    lines = [
        "/* Generated by scripts/build/build_dictionary.py; do not edit. */",
        '#include "command.h"',
        '#include "flash_data.h"',
        "",
    ]
    handlers = dict.fromkeys(message.symbol for message in found.commands)
    lines += [f"void {handler}(const struct command_args *args);" for handler in handlers]
    lines += ["", "const struct command command_table[] FLASH_DATA = {", *command_rows(found), "};"]
    lines += [f"const uint16_t command_count = {len(found.commands)};", ""]
    for message in found.responses:
        number = response_ids[message.format]
        types = f"{message.symbol}_types"
        lines.append(f'static const char {types}[] FLASH_DATA = "{message.letters}";')
        lines.append(
            f"const struct response {message.symbol} FLASH_DATA = {{ {number}, {types} }};  /* {message.name} */"
        )
    lines += ["", "const uint8_t identify_data[] FLASH_DATA = {", *byte_rows(identify), "};"]
    lines += [f"const uint32_t identify_size = {len(identify)};", ""]
    for kind, name in (("INIT", "init"), ("TASK", "tasks"), ("SHUTDOWN", "shutdown")):
        functions = found.functions[kind]
        lines += [f"void {function}(void);" for function in functions]
        lines += [
            "",
            "void",
            f"compile_time_{name}(void)",
            "{",
            *(f"    {function}();" for function in functions),
            "}",
            "",
        ]
    return "\n".join(lines)


def compiler_version(compiler: list[str]) -> str:
    run = subprocess.run([compiler[0], "--version"], capture_output=True, text=True, check=False)
    return run.stdout.splitlines()[0] if run.stdout else compiler[0]


def write_if_changed(path: Path, text: str) -> None:
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for compile_time.c and ferrite.dict")
    parser.add_argument("--cc", required=True, help="compiler and flags the port is built with")
    parser.add_argument("--version", default="unknown", help="version text for the dictionary")
    parser.add_argument("--license", default="GPL-3.0-or-later", help="licence name for the dictionary")
    parser.add_argument("sources", nargs="+")
    parser.add_argument("--round-up", type=int, default=1, help="bytes the identify data is a multiple of")
    options = parser.parse_args(argv)
    compiler = shlex.split(options.cc)
    try:
        found = collect([Unit(source, tuple(compiler)) for source in options.sources])
    except DeclarationError as error:
        print(f"build_dictionary: {error}", file=sys.stderr)
        return 1
    dictionary = make_dictionary(found, options.version, compiler_version(compiler), options.license)
    text = json.dumps(dictionary, separators=(",", ":"), sort_keys=True)
    options.out.mkdir(parents=True, exist_ok=True)
    identify = zlib.compress(text.encode(), 9)
    identify += bytes(-len(identify) % options.round_up)
    write_if_changed(options.out / "compile_time.c", make_c_text(found, identify))
    write_if_changed(options.out / "ferrite.dict", text)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
