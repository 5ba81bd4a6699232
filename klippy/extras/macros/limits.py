"""Limits of templates: no expression and no loop may hold up the host, or fill the memory.

Python computes `2**(2**30)` in one step that nothing interrupts, so what an operation would make is estimated before.
Loops and calls are counted. A template that has worked for some milliseconds lets others run.

    template ─► syntax tree ─► For: its items are counted; Concat: its length is checked ─► code
    code ─► call_binop, call, filters: checked and counted ─► TemplateLimit
"""

from __future__ import annotations

import functools
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from typing import Any, NoReturn

import jinja2
import jinja2.nodes
import jinja2.runtime
import jinja2.sandbox
import jinja2.visitor

STEPS_MAX = 200_000  # items of loops and calls of one rendering
CPU_MAX_S = 3.0
SLICE_S = 0.005  # so long without a turn for others
TEXT_MAX = 1_000_000  # characters
ITEMS_MAX = 100_000
BITS_MAX = 4096
WIDTH_MAX = 10_000
BUDGET = "(budget)"  # in the context of a rendering: no name that a template can write
_ITEMS, _JOINED = "(items)", "(joined)"  # filters of the syntax tree, likewise
_LOOK = 100  # steps between looks at the clock
_LONG_NUMBER = re.compile(r"\d{5}|\*|:[^}]*\{")
_WIDTH_METHODS = frozenset({"center", "expandtabs", "ljust", "rjust", "zfill"})
_WIDTH_FILTERS = ("center", "indent", "wordwrap", "round", "truncate", "tojson", "batch", "slice")


class TemplateLimit(Exception):
    """A template asks for too much; the text is for people."""


class Budget:
    """Of one rendering."""

    def __init__(self, reactor: Any) -> None:
        self._reactor = reactor
        self._left = STEPS_MAX
        self._next_look = STEPS_MAX - _LOOK
        self._cpu_end_s = time.thread_time() + CPU_MAX_S
        self._slice_end_s = reactor.monotonic() + SLICE_S

    def spend(self, steps: int) -> None:
        """Count steps; let others run if it is time to. Raises TemplateLimit."""
        self._left -= steps
        if self._left < 0:
            raise TemplateLimit(f"more than {STEPS_MAX} steps of loops and calls")
        if self._left < self._next_look:
            self._next_look = self._left - _LOOK
            if time.thread_time() > self._cpu_end_s:
                raise TemplateLimit(f"more than {CPU_MAX_S:g} s of computing")
            if self._reactor.monotonic() > self._slice_end_s:
                self._slice_end_s = self._reactor.pause(self._reactor.NOW) + SLICE_S


def _spend(context: jinja2.runtime.Context, steps: int) -> None:
    budget = context.get(BUDGET)
    if isinstance(budget, Budget):
        budget.spend(steps)


@jinja2.pass_context
def _items(context: jinja2.runtime.Context, values: Any) -> Iterable[Any]:
    """What a loop goes through."""
    if isinstance(values, Sized) and len(values) <= _LOOK:
        _spend(context, len(values))
        return values  # type: ignore[return-value]  # what a loop cannot go through, it refuses itself
    return _counted(context, values)


def _counted(context: jinja2.runtime.Context, values: Iterable[Any]) -> Iterator[Any]:
    for value in values:
        _spend(context, 1)
        yield value


@jinja2.pass_context
def _joined(context: jinja2.runtime.Context, values: list[Any]) -> str:
    """a ~ b ~ c."""
    texts = [str(value) for value in values]
    _check_text(sum(map(len, texts)))
    return "".join(texts)


@jinja2.pass_context
def _output(context: jinja2.runtime.Context, value: Any) -> Any:
    """What goes into the text."""
    if isinstance(value, str) and len(value) > _LOOK:
        _spend(context, len(value) // _LOOK)
    return value


def _check_text(length: int) -> None:
    if length > TEXT_MAX:
        raise TemplateLimit(f"a text of more than {TEXT_MAX} characters")


def _check_items(count: int) -> None:
    if count > ITEMS_MAX:
        raise TemplateLimit(f"a list of more than {ITEMS_MAX} items")


def _check_bits(bits: int) -> None:
    if bits > BITS_MAX:
        raise TemplateLimit(f"a number of more than {BITS_MAX} bits")


def _check_widths(values: Iterable[Any]) -> None:
    if any(isinstance(value, int) and abs(value) > WIDTH_MAX for value in values):
        raise TemplateLimit(f"a width or a precision of more than {WIDTH_MAX}")


def _check_format(text: str | bytes, values: Any) -> None:
    if _LONG_NUMBER.search(text if isinstance(text, str) else text.decode("latin-1")):
        values = values if isinstance(values, tuple) else (values,)
        numbers = re.findall(r"\d+", str(text))
        _check_widths(value for group in (values, map(int, numbers)) for value in group)


def _check_replaced(text: str | bytes, old: Any, new: Any, *rest: Any) -> None:
    if isinstance(old, type(text)) and isinstance(new, type(text)):
        _check_text(len(text) + text.count(old) * len(new))  # type: ignore[arg-type]


def _check_join(separator: str, values: Any) -> None:
    if isinstance(values, list | tuple):
        _check_items(len(values))
        texts = sum(len(value) for value in values if isinstance(value, str))
        _check_text(texts + len(separator) * len(values))


def _check_operation(operator: str, left: Any, right: Any) -> None:
    if operator == "%":
        if isinstance(left, str | bytes):
            _check_format(left, right)
    elif isinstance(left, int) and isinstance(right, int):
        if operator == "**":
            _check_bits(left.bit_length() * max(right, 0))
        elif operator == "*":
            _check_bits(left.bit_length() + right.bit_length())
    elif operator == "+" and isinstance(left, Sized) and isinstance(right, Sized):
        (_check_text if isinstance(left, str | bytes) else _check_items)(len(left) + len(right))
    elif operator == "*":
        values, count = (right, left) if isinstance(left, int) else (left, right)
        if isinstance(values, Sized) and isinstance(count, int):
            (_check_text if isinstance(values, str | bytes) else _check_items)(len(values) * max(count, 0))


def _check_method(owner: Any, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
    if isinstance(owner, str | bytes):
        if name in _WIDTH_METHODS:
            _check_widths((*args, *kwargs.values()))
        elif name == "replace" and len(args) > 1:
            _check_replaced(owner, *args)
        elif name == "join" and args:
            _check_join(str(owner), args[0])
        elif name in ("format", "format_map"):
            _check_format(owner, (*args, *kwargs.values()))
    elif isinstance(owner, list) and name in ("extend", "__iadd__") and args and isinstance(args[0], Sized):
        _check_items(len(owner) + len(args[0]))


def _with_check(function: Callable[..., Any], check: Callable[..., None]) -> Callable[..., Any]:
    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        check(args, kwargs)
        return function(*args, **kwargs)

    return checked


def _limited_filters(filters: dict[str, Any]) -> dict[str, Any]:
    """Filters whose result may be far longer than what they are given."""

    def width(args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        _check_widths((*args[1:], *kwargs.values()))

    limited = {name: _with_check(filters[name], width) for name in _WIDTH_FILTERS}
    limited["format"] = _with_check(
        filters["format"], lambda args, kwargs: _check_format(str(args[0]), (*args[1:], *kwargs.values()))
    )
    # the first argument of these two is the evaluation context
    limited["replace"] = _with_check(
        filters["replace"],
        lambda args, kwargs: _check_replaced(str(args[1]), *map(str, args[2:4]), *([""] * (4 - len(args)))),
    )
    limited["join"] = _with_check(
        filters["join"], lambda args, kwargs: _check_join(str(args[2]) if len(args) > 2 else "", args[1])
    )
    return limited


class _Counting(jinja2.visitor.NodeTransformer):
    """Puts the counting filters into a syntax tree."""

    def visit_For(self, node: jinja2.nodes.For) -> jinja2.nodes.Node:
        self.generic_visit(node)
        node.iter = jinja2.nodes.Filter(node.iter, _ITEMS, [], [], None, None, lineno=node.lineno)
        return node

    def visit_Concat(self, node: jinja2.nodes.Concat) -> jinja2.nodes.Node:
        self.generic_visit(node)
        values = jinja2.nodes.List(node.nodes, lineno=node.lineno)
        return jinja2.nodes.Filter(values, _JOINED, [], [], None, None, lineno=node.lineno)


class LimitedSandbox(jinja2.sandbox.SandboxedEnvironment):
    """Jinja's sandbox with limits."""

    intercepted_binops = frozenset({"**", "*", "+", "%"})

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, finalize=_output, **kwargs)
        self.globals.pop("lipsum", None)
        self.filters.update(_limited_filters(self.filters))
        self.filters[_ITEMS], self.filters[_JOINED] = _items, _joined

    def _generate(self, source: jinja2.nodes.Template, *args: Any, **kwargs: Any) -> str:
        tree = _Counting().visit(source)
        tree.set_environment(self)
        return super()._generate(tree, *args, **kwargs)

    def handle_exception(self, source: str | None = None) -> NoReturn:
        """Jinja adds lines of the template to the traceback; its frames then hold each other, and their callers, until
        the next search for cycles."""
        if isinstance(sys.exception(), jinja2.TemplateSyntaxError):
            super().handle_exception(source)  # its text needs that
        raise  # noqa: PLE0704  # called while an exception is handled; a name for it here would be a cycle

    def call_binop(self, context: jinja2.runtime.Context, operator: str, left: Any, right: Any) -> Any:
        """a + b and the like."""
        _check_operation(operator, left, right)
        return super().call_binop(context, operator, left, right)

    def call(__self, __context: jinja2.runtime.Context, __obj: Any, *args: Any, **kwargs: Any) -> Any:
        """f(...)."""
        _spend(__context, 1)
        method = getattr(__obj, "__wrapped__", __obj)  # Jinja wraps str.format
        _check_method(getattr(method, "__self__", None), getattr(method, "__name__", ""), args, kwargs)
        return super().call(__context, __obj, *args, **kwargs)
