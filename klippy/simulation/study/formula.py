"""Values computed from draws: "0:{v}, 300:{v}, 1200:{v * (1 + d)}" with v and d drawn.

What stands in braces is arithmetic: numbers, names of draws, + - * / ** and parentheses. A formula that is one pair of
braces is a number, any other is text.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Mapping

_BRACES = re.compile(r"\{([^{}]*)\}")
_OPERATIONS: dict[type, Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}


class FormulaError(ValueError):
    """What is wrong with a formula; the text is for people."""


def evaluate(formula: str, draws: Mapping[str, float]) -> float | str:
    """The value of a formula with these draws. Raises FormulaError."""
    whole = _BRACES.fullmatch(formula)
    if whole:
        return _number(whole[1], draws)
    return _BRACES.sub(lambda match: f"{_number(match[1], draws):.9g}", formula)


def _number(text: str, draws: Mapping[str, float]) -> float:
    try:
        return _value(ast.parse(text.strip(), mode="eval").body, draws)
    except SyntaxError:
        raise FormulaError(f"{text!r} is no arithmetic") from None
    except (ZeroDivisionError, OverflowError):
        raise FormulaError(f"{text!r} has no value") from None


def _value(node: ast.expr, draws: Mapping[str, float]) -> float:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name):
        if node.id not in draws:
            raise FormulaError(f"there is no draw '{node.id}'; there are {', '.join(draws) or 'none'}")
        return float(draws[node.id])
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        return -_value(node.operand, draws)
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATIONS:
        return _OPERATIONS[type(node.op)](_value(node.left, draws), _value(node.right, draws))
    raise FormulaError(f"{ast.unparse(node)!r}: there are numbers, draws, + - * / ** and parentheses")
