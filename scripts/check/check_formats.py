#!/usr/bin/env python3
"""Checks every MCU message the host asks for against the firmware's dictionary.

    scripts/check/check_formats.py out/simulator/ferrite.dict

Reads klippy/ as text and collects the format strings given to the calls named in ASKS. A command looked
up must be in the dictionary to the letter; a configuration command, whose values are already filled in, must
have the same name and the same parameters in the same order. A format that cannot be read off the source is
an offence too: nobody could check it. Only a function that hands on its own parameter asks nothing itself.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


class Kind(Enum):
    """What an argument of a call is."""

    COMMAND = "command"  # a command's format
    OPTIONAL = "optional command"  # the same, but firmware without a command of that name will do
    RESPONSE = "response"  # a response's format
    RESPONSE_NAME = "response name"
    FILLED = "configuration command"  # a command with values in place of types


# method -> (position of the argument, its keyword, what it is)
ASKS: Mapping[str, tuple[tuple[int, str, Kind], ...]] = {
    "lookup_command": ((0, "msgformat", Kind.COMMAND),),
    "try_lookup_command": ((0, "msgformat", Kind.OPTIONAL),),
    "lookup_query_command": ((0, "msgformat", Kind.COMMAND), (1, "respformat", Kind.RESPONSE)),
    "register_response": ((1, "name", Kind.RESPONSE_NAME),),
    "add_config_cmd": ((0, "cmd", Kind.FILLED),),
}
# responses the host makes itself, of which no firmware knows
HOST_MADE = frozenset({"#output", "#unknown", "#state"})
# forms that firmware of other makers, or of another configuration (SINGLE_ANALOG_REPORTS), has for one of our commands
ALSO_SPOKEN = {
    "query_analog_in": "query_analog_in oid=%c clock=%u sample_ticks=%u sample_count=%c rest_ticks=%u"
    " min_value=%hu max_value=%hu range_check_count=%c",
}
# what only Klipper's firmware for SAMD51, for Linux and for CAN knows, as its dictionaries and documentation have it
COMMANDS_ELSEWHERE = (
    "get_canbus_status",
    "set_sercom_pin bus=%u sercom_pin_type=%u pin=%u",
    "config_pca9685 oid=%c bus=%c addr=%c channel=%c cycle_ticks=%u value=%hu default_value=%hu max_duration=%u",
    "queue_pca9685_out oid=%c clock=%u value=%hu",
    "config_ds18b20 oid=%c serial=%*s max_error_count=%c",
    "query_ds18b20 oid=%c clock=%u rest_ticks=%u min_value=%i max_value=%i",
)
RESPONSES_ELSEWHERE = (
    "ds18b20_result oid=%c next_clock=%u value=%i fault=%u",
    "canbus_status rx_error=%u tx_error=%u tx_retries=%u canbus_bus_state=%u",
)

PERCENT_FIELD = re.compile(r"%[-+ #0]*\d*(\.\d+)?[a-z]")
BRACE_FIELD = re.compile(r"\{\w*\}")


@dataclass(frozen=True, slots=True)
class Ask:
    """One format the host asks for; text None if the source does not show it."""

    path: Path
    line: int
    kind: Kind
    text: str | None


class Module:
    """One source file, and the strings its names stand for."""

    def __init__(self, path: Path, constants: Mapping[str, str]) -> None:
        self.path = path
        self.tree = ast.parse(path.read_text(encoding="utf-8"), filename=str(path))
        self.constants = dict(constants)
        self.constants.update(self._strings())

    def _strings(self) -> Iterator[tuple[str, str]]:
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Assign) and len(node.targets) == 1:
                target, value = node.targets[0], node.value
            elif isinstance(node, ast.AnnAssign) and node.value is not None:
                target, value = node.target, node.value
            else:
                continue
            if isinstance(target, ast.Name):
                text = self.text_of(value)
                if text is not None:
                    yield target.id, text

    def text_of(self, node: ast.expr) -> str | None:
        """The string an expression gives, with 0 for every value filled in; None if it is not known."""
        text: str | None = None
        match node:
            case ast.Constant(value=str(literal)):
                text = literal
            case ast.JoinedStr(values=parts):
                text = "".join(str(p.value) if isinstance(p, ast.Constant) else "0" for p in parts)
            case ast.BinOp(left=left, op=ast.Mod()):
                text = _filled(self.text_of(left), PERCENT_FIELD)
            case ast.Call(func=ast.Attribute(value=template, attr="format")):
                text = _filled(self.text_of(template), BRACE_FIELD)
            case ast.BinOp(left=left, op=ast.Add(), right=right):
                first, second = self.text_of(left), self.text_of(right)
                text = None if first is None or second is None else first + second
            case ast.Name(id=name) | ast.Attribute(attr=name):
                text = self.constants.get(name)
        return text

    def asks(self) -> Iterator[Ask]:
        yield from self._asks_in(self.tree, {})

    def _asks_in(self, node: ast.AST, local: Mapping[str, Sequence[ast.expr]]) -> Iterator[Ask]:
        """Asks below `node`; `local`: what the names bound around it stand for, nothing for a parameter."""
        local = {**local, **_bound_by(node)}
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in ASKS:
            for position, keyword, kind in ASKS[node.func.attr]:
                argument = _argument(node, position, keyword)
                meant: Sequence[ast.expr | None] = [argument]
                if isinstance(argument, ast.Name):
                    meant = local.get(argument.id, [argument])
                for each in meant:
                    yield Ask(self.path, node.lineno, kind, None if each is None else self.text_of(each))
        for child in ast.iter_child_nodes(node):
            yield from self._asks_in(child, local)


def _filled(template: str | None, field: re.Pattern[str]) -> str | None:
    return None if template is None else field.sub("0", template)


def _bound_by(node: ast.AST) -> dict[str, Sequence[ast.expr]]:
    """Names a node binds for what is inside it: parameters, and loop variables over a literal sequence."""
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
        given = node.args
        return {a.arg: () for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)}
    loops: Sequence[ast.For | ast.comprehension] = ()
    if isinstance(node, ast.For):
        loops = [node]
    elif isinstance(node, (ast.ListComp, ast.SetComp, ast.GeneratorExp, ast.DictComp)):
        loops = node.generators
    bound: dict[str, Sequence[ast.expr]] = {}
    for loop in loops:
        if isinstance(loop.iter, (ast.Tuple, ast.List)):
            bound.update(_unpacked(loop.target, loop.iter.elts))
    return bound


def _unpacked(target: ast.expr, values: Sequence[ast.expr]) -> Iterator[tuple[str, Sequence[ast.expr]]]:
    """Loop variables with the values they take in turn: `for a, b in ((1, 2), (3, 4))` -> a: 1 3, b: 2 4."""
    if isinstance(target, ast.Name):
        yield target.id, values
    elif isinstance(target, ast.Tuple):
        for position, name in enumerate(target.elts):
            column = [v.elts[position] for v in values if isinstance(v, ast.Tuple) and position < len(v.elts)]
            if isinstance(name, ast.Name) and len(column) == len(values):
                yield name.id, column


def _argument(call: ast.Call, position: int, keyword: str) -> ast.expr | None:
    if position < len(call.args):
        return call.args[position]
    return next((k.value for k in call.keywords if k.arg == keyword), None)


def parameters(text: str) -> list[str]:
    """Names of a message's parameters, in order: "foo oid=%c x=3" -> ["oid", "x"]."""
    return [word.partition("=")[0] for word in text.split()[1:]]


class Dictionary:
    """The formats one firmware build knows."""

    def __init__(self, path: Path) -> None:
        content = json.loads(path.read_text(encoding="utf-8"))
        self.commands = {text.split()[0]: text for text in (*content["commands"], *COMMANDS_ELSEWHERE)}
        self.responses = {text.split()[0]: text for text in (*content["responses"], *RESPONSES_ELSEWHERE)}

    def complaint(self, ask: Ask) -> str | None:
        """What is wrong with a request, None if it is met."""
        if ask.text is None or not ask.text.strip():
            return f"the {ask.kind.value} asked for here is not a text that can be checked"
        name = ask.text.split()[0]
        if ask.kind is Kind.RESPONSE_NAME:
            known = name in self.responses or name in HOST_MADE
            return None if known else f"the firmware has no response '{name}'"
        table = self.responses if ask.kind is Kind.RESPONSE else self.commands
        built = table.get(name)
        if built is None:
            return None if ask.kind is Kind.OPTIONAL else f"the firmware has no {ask.kind.value} '{name}'"
        forms = (built, ALSO_SPOKEN.get(name, built))
        if ask.kind is Kind.FILLED:
            fits = any(parameters(ask.text) == parameters(form) for form in forms)
            return None if fits else f"'{ask.text}' does not fill in '{built}'"
        return None if ask.text in forms else f"asks for '{ask.text}', the firmware has '{built}'"


def collect(folder: Path) -> list[Ask]:
    """All asks in the Python files below `folder`; constants of one file are known in the others."""
    paths = sorted(folder.rglob("*.py"))
    shared: dict[str, str] = {}
    for path in paths:
        shared.update((k, v) for k, v in Module(path, {}).constants.items() if k.isupper())
    return [ask for path in paths for ask in Module(path, shared).asks()]


def main(argv: Sequence[str]) -> int:
    if len(argv) != 2:
        print("usage: check_formats.py DICTIONARY", file=sys.stderr)
        return 2
    dictionary = Dictionary(Path(argv[1]))
    asks = collect(ROOT / "klippy")
    complaints = [(ask, text) for ask in asks if (text := dictionary.complaint(ask)) is not None]
    for ask, text in complaints:
        print(f"{ask.path}:{ask.line}: {text}")
    if not asks:
        print(f"{ROOT / 'klippy'} asks for no message at all; this check no longer sees what it should")
    return 1 if complaints or not asks else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv))
