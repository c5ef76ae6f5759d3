"""Formulas: functions of named parameters as text, "-b / J", which a file can hold and which can only compute.

A formula has numbers, names, + - * / **, brackets and the functions of FUNCTIONS. It is read by a grammar of its own
over Python's syntax tree: nothing else of Python is run.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

LONGEST = 4000  # characters of a formula
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

# How tightly a text binds: a sum, a product, a sign, a power, a name.
SUM, PRODUCT, SIGN, POWER, NAME = range(5)
_BINARY = {  # operation: sign, how tightly it binds, and its left and right side must bind
    ca.OP_ADD: (" + ", SUM, SUM, PRODUCT),
    ca.OP_SUB: (" - ", SUM, SUM, PRODUCT),
    ca.OP_MUL: (" * ", PRODUCT, PRODUCT, SIGN),
    ca.OP_DIV: (" / ", PRODUCT, PRODUCT, SIGN),
    ca.OP_POW: ("**", POWER, NAME, NAME),
    ca.OP_CONSTPOW: ("**", POWER, NAME, NAME),
}
_CALLS = {getattr(ca, f"OP_{name.upper()}"): name for name in FUNCTIONS}

Text = tuple[str, int]  # and how tightly it binds


def formula(expression: Any, p: Any, names: Sequence[str]) -> str:
    """Write a scalar expression of the parameters p as a formula of their names; `value_of` gives it back exactly.

    expression : casadi.SX, 1 x 1
    p : casadi.SX, the vector of the parameters

    Raises ValueError for operations that formulas do not have, and beyond LONGEST characters.

    >>> k, m = ca.SX.sym("k"), ca.SX.sym("m")
    >>> formula(-2 * k / (m + 1) ** 2, ca.vertcat(k, m), ["k", "m"])
    '-2.0 * k / (m + 1.0)**2'
    """
    f = ca.Function("formula", [p], [ca.densify(expression)])
    cells: dict[int, Text] = {}
    found = ""
    for k in range(f.n_instructions()):
        into, out, code = f.instruction_input(k), f.instruction_output(k), f.instruction_id(k)
        if code == ca.OP_OUTPUT:
            found = cells[into[0]][0]
        elif code == ca.OP_INPUT:
            cells[out[0]] = names[into[1]], NAME
        elif code == ca.OP_CONST:
            cells[out[0]] = _constant(f.instruction_constant(k))
        else:
            cells[out[0]] = _text(code, [cells[i] for i in into])
        if max(map(len, (text for text, _ in cells.values())), default=0) > LONGEST:
            raise ValueError(f"an expression of more than {LONGEST} characters")
    return found


def _constant(value: float) -> Text:
    if not math.isfinite(value):
        raise ValueError(f"the constant {value}")
    text = repr(float(value))
    return text, SIGN if text.startswith("-") else NAME


def _text(code: int, sides: list[Text]) -> Text:
    def side(k: int, least: int) -> str:
        text, binds = sides[k]
        return text if binds >= least else f"({text})"

    if code in _BINARY:
        sign, binds, left, right = _BINARY[code]
        return side(0, left) + sign + side(1, right), binds
    if code in _CALLS:
        return f"{_CALLS[code]}({sides[0][0]})", NAME
    unary = {
        ca.OP_ASSIGN: sides[0],
        ca.OP_NEG: (f"-{side(0, POWER)}", SIGN),
        ca.OP_SQ: (f"{side(0, NAME)}**2", POWER),
        ca.OP_TWICE: (f"2 * {side(0, SIGN)}", PRODUCT),
        ca.OP_INV: (f"1 / {side(0, SIGN)}", PRODUCT),
    }
    if code not in unary:
        raise ValueError(f"operation {code} of CasADi, which formulas do not have")
    return unary[code]


def value_of(text: str, values: Mapping[str, Any]) -> Any:
    """Compute a formula at values by name, numbers or CasADi symbols.

    Raises ValueError for what formulas do not have, unknown names, and results that are not finite.

    >>> value_of("-b / J", {"b": 0.1, "J": 2e-3})
    -50.0
    """
    if len(text) > LONGEST:
        raise ValueError(f"{len(text)} characters, of at most {LONGEST}")
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
