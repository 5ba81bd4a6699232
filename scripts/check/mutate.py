"""Small changes of C and Python source, one at a time: each comparison, operator, bound and constant, each condition
turned round, each field of an initializer and each simple statement left out. Whether a change compiles is not asked.
"""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

OPERATORS = {
    "<": ("<=", ">="), "<=": ("<", ">"), ">": (">=", "<="), ">=": (">", "<"), "==": ("!=",), "!=": ("==",),
    "&&": ("||",), "||": ("&&",), "+": ("-",), "-": ("+",), "*": ("/",), "/": ("*",), "%": ("*",), "<<": (">>",),
    ">>": ("<<",), "&": ("|",), "|": ("&",), "^": ("&",), "+=": ("-=",), "-=": ("+=",), "|=": ("&=",),
    "&=": ("|=",), "<<=": (">>=",), ">>=": ("<<=",), "++": ("--",), "--": ("++",), "!": ("",), "~": ("",),
    "?": ("== 0 ?",), "and": ("or",), "or": ("and",), "not": ("",), "True": ("False",), "False": ("True",),
}  # fmt: skip
_C_TOKEN = re.compile(
    r"(?P<number>\b\d\w*)|(?P<name>\b[A-Za-z_]\w*)|(?P<op>->|<<=|>>=|[-+*/%&|^<>=!]=|&&|\|\||<<|>>|\+\+|--|[-+*/%&|^<>!~?])"
)
_C_HIDDEN = re.compile(r"/\*.*?\*/|//[^\n]*|^[ \t]*#(?:[^\n]*\\\n)*[^\n]*|\"(?:\\.|[^\"\\])*\"", re.S | re.M)
_C_STATEMENT = re.compile(
    r"^[ \t]*+(?!(?:return|break|continue|goto|else|case|default|if|for|while|do)\b|\s)[^;{}]+;[ \t]*$", re.M
)
_C_FIELD = re.compile(r"[{,]\s*\.\w+ = ([^,{}]+)")
_C_CONDITION = re.compile(r"\b(?:if|while) \(")


@dataclass(frozen=True)
class Mutation:
    """`before` and `after` are the line as it stands and as it becomes, `nth` which of several alike in the file."""

    line: int
    before: str
    after: str
    text: str  # of the whole file
    nth: int = 1

    @property
    def key(self) -> tuple[str, str, int]:
        return self.before, self.after, self.nth


# A piece of the text, from offset to offset, and what stands there instead.
Edit = tuple[int, int, str]


def mutations(text: str, is_c: bool, functions: tuple[str, ...] = ()) -> list[Mutation]:
    """In order of lines. `functions`: of a C file only these."""
    edits = sorted(_c_edits(text, functions) if is_c else _python_edits(text))
    found, seen = [], Counter[tuple[str, str]]()
    for start, end, new in edits:
        begin, stop = text.rfind("\n", 0, start) + 1, text.find("\n", end)
        before, after = (
            _one_line(part) for part in (text[begin:stop], text[begin:start] + new + text[end:stop])
        )
        if before == after:
            continue
        seen[before, after] += 1
        line = text.count("\n", 0, start) + 1
        changed = text[:start] + new + text[end:]
        found.append(Mutation(line, before, after, changed, seen[before, after]))
    return found


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _numbers(literal: str) -> Iterator[str]:
    """A whole number one up and one down, zero up only; a broken one a tenth up and down."""
    digits = literal.rstrip("uUlL")
    suffix = literal[len(digits) :]
    try:
        value = int(digits, 0)
    except ValueError:
        yield from (repr(float(digits) * factor) for factor in (1.1, 0.9)) if float(digits) else ("1.0",)
        return
    yield f"{value + 1}{suffix}"
    if value:
        yield f"{value - 1}{suffix}"


# --- C


def _c_edits(text: str, functions: tuple[str, ...]) -> Iterator[Edit]:
    code = _C_HIDDEN.sub(lambda hidden: re.sub(r"[^\n]", " ", hidden[0]), text)
    ranges = [_c_function(code, name) for name in functions] or [(0, len(code))]
    fields = ((*field.span(1), "0") for field in _C_FIELD.finditer(code))
    for edit in (*_c_tokens(code), *_c_conditions(code), *_c_statements(code), *fields):
        if any(begin <= edit[0] < end for begin, end in ranges):
            yield edit


def _c_function(code: str, name: str) -> tuple[int, int]:
    begin = re.search(rf"^{name}\(", code, re.M)
    if not begin:
        raise ValueError(f"there is no function {name}")
    return begin.start(), code.index("\n}", begin.start())


def _c_tokens(code: str) -> Iterator[Edit]:
    for token in _C_TOKEN.finditer(code):
        start, end = token.span()
        word = token[0]
        if token["number"]:
            yield from ((start, end, new) for new in _numbers(word))
        elif token["name"]:
            if word.isupper() and len(word) > 1 and word != "NULL":
                yield from ((start, end, f"({word} {sign} 1)") for sign in "+-")
        elif word in "+-*&" and not re.search(
            r"(?<!\breturn)(?<=[\w)\]])\s*$", code[max(0, start - 80) : start]
        ):
            if word == "-":
                yield start, end, ""
        else:
            yield from ((start, end, new) for new in OPERATORS.get(word, ()))


def _c_conditions(code: str) -> Iterator[Edit]:
    for found in _C_CONDITION.finditer(code):
        depth, end = 1, found.end()
        while depth:
            depth += {"(": 1, ")": -1}.get(code[end], 0)
            end += 1
        yield found.end(), end - 1, f"!({code[found.end() : end - 1]})"


def _c_statements(code: str) -> Iterator[Edit]:
    """Assignments and calls with lines of their own; a declaration left out does not compile."""
    for found in _C_STATEMENT.finditer(code):
        if not re.search(r"(?:[;{})]|\belse)\s*$", code[: found.start()]):
            continue  # goes on from the line before
        start = found.start() + len(found[0]) - len(found[0].lstrip())
        yield start, found.end(), ";"


# --- Python


def _python_edits(text: str) -> Iterator[Edit]:
    tree = ast.parse(text)
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def span(node: ast.expr | ast.stmt) -> tuple[int, int]:
        assert node.end_lineno is not None and node.end_col_offset is not None
        return starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset

    types: list[tuple[int, int]] = []
    for node in ast.walk(tree):
        hints = [getattr(node, "annotation", None), getattr(node, "returns", None)]
        types += [span(hint) for hint in hints if hint is not None]
        if isinstance(node, ast.If | ast.While | ast.IfExp):
            start, end = span(node.test)
            yield start, end, f"not ({text[start:end]})"
        is_call = isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        if isinstance(node, ast.Assign | ast.AugAssign) or is_call:
            assert isinstance(node, ast.stmt)
            if node.col_offset:
                yield *span(node), "pass"
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        start, end = (starts[row - 1] + column for row, column in (token.start, token.end))
        if any(begin <= start < stop for begin, stop in types):
            continue
        if token.type == tokenize.NUMBER:
            yield from ((start, end, new) for new in _numbers(token.string))
        elif token.type in (tokenize.OP, tokenize.NAME):
            yield from ((start, end, new) for new in OPERATORS.get(token.string, ()))
