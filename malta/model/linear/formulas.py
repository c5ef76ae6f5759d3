"""Formulas: functions of named parameters as text, "-b / J", which a file can hold and which can only compute.

A formula has numbers, names, + - * / **, brackets and the functions of FUNCTIONS. It is read by a grammar of its own
over Python's syntax tree: nothing else of Python is run.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Mapping
from typing import Any

import casadi as ca

MAX_FORMULA_LENGTH = 4000  # characters of a formula
FUNCTIONS = {
    name: getattr(ca, name)
    for name in ("sqrt", "exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")
}
_OPERATORS: dict[type[ast.AST], Any] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}


def value_of(text: str, values: Mapping[str, Any]) -> Any:
    """Compute a formula at values by name, numbers or CasADi symbols.

    Raises ValueError for what formulas do not have, unknown names, and results that are not finite.

    >>> value_of("-b / J", {"b": 0.1, "J": 2e-3})
    -50.0
    """
    if len(text) > MAX_FORMULA_LENGTH:
        raise ValueError(f"{len(text)} characters, of at most {MAX_FORMULA_LENGTH}")
    try:
        found = _evaluate(ast.parse(text.strip(), mode="eval").body, values)
    except SyntaxError as error:
        raise ValueError("no formula: numbers, names of parameters, + - * / ** and brackets") from error
    except (RecursionError, MemoryError) as error:
        raise ValueError("too many brackets in brackets") from error
    except (ZeroDivisionError, OverflowError) as error:
        raise ValueError(f"no value ({error})") from error
    if isinstance(found, complex) or (isinstance(found, float) and not math.isfinite(found)):
        raise ValueError(f"the value {found}, not a finite number")
    return found


def _evaluate(node: ast.AST, values: Mapping[str, Any]) -> Any:
    if (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and type(node.value) is not bool
    ):
        return float(node.value)
    if isinstance(node, ast.Name) and node.id in values:
        return values[node.id]
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_evaluate(node.left, values), _evaluate(node.right, values))
    if isinstance(node, ast.UnaryOp) and type(node.op) in _OPERATORS:
        return _OPERATORS[type(node.op)](_evaluate(node.operand, values))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS:
        if len(node.args) == 1 and not node.keywords:
            return FUNCTIONS[node.func.id](_evaluate(node.args[0], values))
        raise ValueError(f"{node.func.id} of {len(node.args)} arguments")
    if isinstance(node, ast.Name):
        raise ValueError(f"{node.id!r}, which is none of the parameters {' '.join(values)}")
    raise ValueError(f"{ast.unparse(node)[:40]!r}, which no formula has")
