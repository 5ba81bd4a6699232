#!/usr/bin/env python3
"""Talks to an MCU by hand: for people who bring up boards.

    scripts/console.py /dev/serial/by-id/usb-Klipper_... [--baud 250000]

Lines are commands of the firmware's own dictionary (`get_clock`, `allocate_oids count=1`), with expressions in braces
(`queue_digital_out oid=0 clock={clock + freq} on_ticks=1`), or the console's own words in capitals (HELP lists them).
Every message of the MCU is shown. A host must not be connected to the same board.
"""

from __future__ import annotations

import in_venv

import argparse
import ast
import functools
import operator
import queue
import re
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "klippy"))

import clocksync  # noqa: E402
import msgproto  # noqa: E402
import serialhdl  # noqa: E402
from link import serialport  # noqa: E402
from reactor import Reactor  # noqa: E402

HISTORY = Path.home() / ".ferrite_console_history"
HELP = """Commands of the firmware (LIST shows them), with {expressions} of numbers, constants, variables,
`clock` (now, in ticks) and `freq` (ticks a second). And:
  LIST [TEXT]        messages, enumerations and constants with TEXT in their name
  SET NAME VALUE     set a variable for use in expressions
  EVAL EXPRESSION    show a value
  QUIET NAME         do not show messages of this name;   SHOW NAME: show them again
  DELAY CLOCK LINE   send the line when the MCU's clock is CLOCK
  WAIT SECONDS       do nothing for so long
  FLOOD COUNT DELAY LINE   send a command COUNT times, DELAY seconds apart
  STATS              counters of the link and the state of the clock
  HELP, QUIT"""

_BINARY: dict[type, Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: operator.mod,
    ast.LShift: operator.lshift,
    ast.RShift: operator.rshift,
    ast.BitAnd: operator.and_,
    ast.BitOr: operator.or_,
    ast.BitXor: operator.xor,
}
_UNARY: dict[type, Callable[[Any], Any]] = {
    ast.UAdd: operator.pos,
    ast.USub: operator.neg,
    ast.Invert: operator.invert,
}
_FUNCTIONS: dict[str, Callable[..., Any]] = {"int": int, "round": round, "min": min, "max": max, "abs": abs}


class ConsoleError(Exception):
    """A line cannot be carried out; the text is for people."""


def evaluate(text: str, names: Mapping[str, Any]) -> Any:
    """Value of an arithmetic expression; raises ConsoleError."""

    def value(node: ast.AST) -> Any:
        if isinstance(node, ast.Expression):
            return value(node.body)
        if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            return node.value
        if isinstance(node, ast.Name):
            if node.id not in names:
                raise ConsoleError(f"'{node.id}' is no constant and no variable")
            return names[node.id]
        if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
            return _BINARY[type(node.op)](value(node.left), value(node.right))
        if isinstance(node, ast.UnaryOp) and type(node.op) in _UNARY:
            return _UNARY[type(node.op)](value(node.operand))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in _FUNCTIONS:
            return _FUNCTIONS[node.func.id](*[value(argument) for argument in node.args])
        raise ConsoleError(f"only arithmetic is possible in {{{text}}}")

    try:
        return value(ast.parse(text.strip(), mode="eval"))
    except (SyntaxError, TypeError, ValueError, ArithmeticError) as e:
        raise ConsoleError(f"{{{text}}}: {e}") from None


class Console:
    """One session. All methods run in the reactor's greenlets; `show` prints."""

    def __init__(self, reactor: Reactor, path: str, baud: int, show: Callable[[str], None]) -> None:
        self._reactor = reactor
        self._path, self._baud = path, baud
        self._show = show
        self._serial = serialhdl.SerialReader(reactor, "", serialport.open_port)
        self._clock = clocksync.ClockSync(reactor)
        self._variables: dict[str, Any] = {}
        self._quiet: set[str] = set()
        self._start_s = 0.0

    # --- link ---
    def connect(self) -> str:
        """Fetch the dictionary; returns a line about the firmware. Raises serialhdl.error."""
        self._serial.connect(self._path, self._baud)
        self._clock.connect(self._serial)
        self._start_s = self._reactor.monotonic()
        for _, kind, text in self._parser.get_messages():
            name = text.split()[0]
            if kind == "response" and name not in ("clock", "identify_response"):
                self._serial.register_response(self._on_message, name)
        version, build = self._parser.get_version_info()
        constants = self._parser.get_constants()
        return f"Connected to {constants.get('MCU', '?')} (firmware {version}, {build}). HELP lists what is possible."

    def disconnect(self) -> None:
        """Close the port."""
        self._clock.disconnect()
        self._serial.disconnect()

    @property
    def _parser(self) -> msgproto.MessageParser:
        return self._serial.get_msgparser()

    def words(self) -> list[str]:
        """What a line may begin with, and parameters, for completion."""
        found = set(self._own)
        for _, kind, text in self._parser.get_messages():
            name, *parameters = text.split()
            if kind == "command":
                found.add(name)
                found.update(parameter.partition("=")[0] + "=" for parameter in parameters)
        return sorted(found)

    def _on_message(self, params: dict[str, Any]) -> None:
        if params["#name"] not in self._quiet:
            at = params.get("#receive_time", 0.0) - self._start_s
            self._show(f"{at:9.3f}: {self._parser.format_params(params)}")

    # --- lines ---
    def run(self, line: str) -> bool:
        """Carry out one line; False to end. Problems are shown."""
        try:
            return self._run(line.strip())
        except (ConsoleError, msgproto.error, serialhdl.error) as e:
            self._show(f"Error: {e}")
        return True

    def _run(self, line: str) -> bool:
        if not line or line.startswith("#"):
            return True
        word, _, rest = line.partition(" ")
        if word in ("QUIT", "EXIT"):
            return False
        if word in self._own:
            self._own[word](self, rest.strip())
        else:
            self._send(line)
        return True

    def _names(self) -> dict[str, Any]:
        constants = {
            name: value
            for name, value in self._parser.get_constants().items()
            if isinstance(value, int | float)
        }
        now = self._reactor.monotonic()
        freq = self._parser.get_constant_float("CLOCK_FREQ")
        return {**constants, "freq": freq, "clock": self._clock.get_clock(now), **self._variables}

    def _fill_in(self, line: str) -> str:
        def replace(match: re.Match[str]) -> str:
            value = evaluate(match[1], self._names())
            return str(int(value) if isinstance(value, float) else value)

        return re.sub(r"\{([^{}]*)\}", replace, line)

    def _send(self, line: str, minclock: int = 0) -> None:
        text = self._fill_in(line)
        command = self._parser.create_command(text)
        queue_ = self._serial.get_default_command_queue()
        if text.split()[0] == "get_clock":  # its answer is shown here: it feeds the clock estimate otherwise
            params = self._serial.query(command, "clock")
            self._show(f"           {self._parser.format_params(params)}")
            return
        self._serial.raw_send(command, minclock, minclock, queue_)

    # --- the console's own words ---
    def _list(self, rest: str) -> None:
        wanted = rest.lower()
        lines = [
            f"  {kind:9} {text}" for _, kind, text in self._parser.get_messages() if wanted in text.lower()
        ]
        lines += [
            f"  constant  {name}={value}"
            for name, value in sorted(self._parser.get_constants().items())
            if wanted in name.lower()
        ]
        for name, entries in sorted(self._parser.get_enumerations().items()):
            if wanted in name.lower():
                shown = ", ".join(list(entries)[:12]) + (" ..." if len(entries) > 12 else "")
                lines.append(f"  values    {name}: {shown}")
        self._show("\n".join(lines) or "nothing of that name")

    def _set(self, rest: str) -> None:
        name, _, text = rest.partition(" ")
        if not name.isidentifier() or not text:
            raise ConsoleError("SET needs a name and a value")
        self._variables[name] = evaluate(text, self._names())
        self._show(f"{name} = {self._variables[name]}")

    def _eval(self, rest: str) -> None:
        self._show(str(evaluate(rest.strip("{}"), self._names())))

    def _hide(self, rest: str) -> None:
        self._quiet.add(rest)

    def _unhide(self, rest: str) -> None:
        self._quiet.discard(rest)

    def _delay(self, rest: str) -> None:
        clock, _, line = self._fill_in(rest).partition(" ")
        if not clock.isdigit() or not line:
            raise ConsoleError("DELAY needs a clock and a line, such as DELAY {clock + freq} get_uptime")
        self._send(line, int(clock))

    def _wait(self, rest: str) -> None:
        seconds = evaluate(rest, self._names())
        self._reactor.pause(self._reactor.monotonic() + float(seconds))

    def _flood(self, rest: str) -> None:
        words = rest.split(None, 2)
        if len(words) < 3:
            raise ConsoleError("FLOOD needs a count, a delay in seconds and a line")
        count, delay_s = int(evaluate(words[0], self._names())), float(evaluate(words[1], self._names()))
        next_s = self._reactor.monotonic()
        for _ in range(count):
            self._send(words[2])
            next_s += delay_s
            self._reactor.pause(next_s)

    def _stats(self, rest: str) -> None:
        now = self._reactor.monotonic()
        self._show(f"{self._serial.stats(now)}\n{self._clock.stats(now)}")

    def _help(self, rest: str) -> None:
        self._show(HELP)

    _own: Mapping[str, Callable[[Console, str], None]] = {
        "LIST": _list,
        "SET": _set,
        "EVAL": _eval,
        "QUIET": _hide,
        "SHOW": _unhide,
        "DELAY": _delay,
        "WAIT": _wait,
        "FLOOD": _flood,
        "STATS": _stats,
        "HELP": _help,
    }


class ReactorThread:
    """The reactor in a thread of its own; `call` runs a function in it and waits for the result."""

    def __init__(self) -> None:
        self.reactor = Reactor()
        self._thread = threading.Thread(target=self.reactor.run, daemon=True)
        self._thread.start()

    def call(self, function: Callable[[], Any]) -> Any:
        results: queue.SimpleQueue[tuple[Any, Exception | None]] = queue.SimpleQueue()

        def run(eventtime: float) -> None:
            try:
                results.put((function(), None))
            except Exception as e:  # handed to the caller
                results.put((None, e))

        self.reactor.register_async_callback(run)
        value, problem = results.get()
        if problem is not None:
            raise problem
        return value

    def stop(self) -> None:
        self.reactor.register_async_callback(lambda eventtime: self.reactor.end())
        self._thread.join(2.0)


def lines_of_user(words: Callable[[], list[str]]) -> Iterable[str]:
    """Lines typed (with history and completion) or, if stdin is no terminal, read."""
    if not sys.stdin.isatty():
        yield from sys.stdin
        return
    try:
        from prompt_toolkit import PromptSession
        from prompt_toolkit.completion import WordCompleter
        from prompt_toolkit.history import FileHistory
        from prompt_toolkit.patch_stdout import patch_stdout
    except ImportError:
        print("(prompt_toolkit is not installed: no history, no completion)")
        yield from iter(input, "QUIT")
        return
    session: Any = PromptSession(history=FileHistory(str(HISTORY)))
    completer = WordCompleter(words(), pattern=re.compile(r"[\w=]+"))
    while True:
        try:
            with patch_stdout():
                line = session.prompt("mcu> ", completer=completer)
        except KeyboardInterrupt:
            continue
        except EOFError:
            return
        yield line


def parse(argv: Sequence[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description="Talk to an MCU by hand.")
    parser.add_argument("serial", help="serial device, pseudo terminal or unix socket of the MCU")
    parser.add_argument("--baud", type=int, default=250000, help="of a UART (default 250000)")
    return parser.parse_args(argv)


def main(argv: Sequence[str] | None = None) -> int:
    options = parse(sys.argv[1:] if argv is None else argv)
    thread = ReactorThread()
    console = Console(thread.reactor, options.serial, options.baud, lambda text: print(text, flush=True))
    try:
        print(thread.call(console.connect), flush=True)
    except (serialhdl.error, serialport.PortError) as e:
        print(f"console: {e}", file=sys.stderr)
        thread.stop()
        return 2
    try:
        for line in lines_of_user(console.words):
            if not thread.call(functools.partial(console.run, line)):
                break
        time.sleep(0.1)  # answers to the last line
    finally:
        thread.call(console.disconnect)
        thread.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
