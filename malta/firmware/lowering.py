"""Any CasADi function as one of basic operations: what firmware computes, instruction by instruction.

`lower` replaces elementary functions by those of elementary.py. What is left are +, -, *, /, negation, size, the
smaller and larger of two, square roots, comparisons, their conjunctions, and choices: IEEE 754 fixes every bit of them.
So the C text, CasADi's own virtual machine and `program.evaluate` give the same bits for the same function.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import casadi as ca

from malta.errors import CheckError
from malta.firmware.elementary import ELEMENTARY, Elementary, Precision, as_written

NAMES = {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}
_SHIFTS_WORTH = 3  # sines and cosines of one angle plus constants, from which on two of them serve for all


class _Angle(NamedTuple):
    """An angle as a number plus a constant."""

    base: int  # instruction that computes the number
    shift: float


def lower(f: ca.Function, precision: Precision) -> ca.Function:
    """The same function by basic operations alone. Raises CheckError for an operation that has no such form.

    f : SX, dense arguments and results

        lower(ca.Function("f", [x], [ca.sin(x)]), "float")
    """
    with as_written():
        arguments = [ca.SX.sym(f.name_in(i), f.size1_in(i)) for i in range(f.n_in())]
        results = [[ca.SX(0)] * f.size1_out(i) for i in range(f.n_out())]
        waves = _Waves(f, ELEMENTARY[precision])
        work: dict[int, Any] = {}
        for k in range(f.n_instructions()):
            op, reads, writes = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
            if op == ca.OP_OUTPUT:
                results[writes[0]][writes[1]] = work[reads[0]]
            elif op == ca.OP_INPUT:
                work[writes[0]] = arguments[reads[0]][reads[1]]
            elif op == ca.OP_CONST:
                work[writes[0]] = ca.SX(f.instruction_constant(k))
            elif NAMES[op] in ("SIN", "COS"):
                work[writes[0]] = waves.value(k, NAMES[op], work[reads[0]])
            else:
                work[writes[0]] = _form_of(f, k, ELEMENTARY[precision])(*(work[r] for r in reads))
            waves.note(k, work[writes[0]] if op != ca.OP_OUTPUT else None)
        found = [ca.densify(ca.vertcat(*column)) for column in results]
        return ca.Function(f.name(), arguments, ca.cse(found), f.name_in(), f.name_out())


def _form_of(f: ca.Function, k: int, own: Elementary) -> Callable[..., Any]:
    """How an instruction is computed by basic operations."""
    name = NAMES[f.instruction_id(k)]
    if name in _KEPT:
        operation = f.instruction_id(k)
        return lambda *a: ca.SX.binary(operation, *a) if len(a) == 2 else ca.SX.unary(operation, *a)
    forms: dict[str, Callable[..., Any]] = {
        "ASSIGN": lambda x: x,
        "SQ": lambda x: x * x,
        "TWICE": lambda x: x + x,
        "INV": lambda x: 1 / x,
        "SIGN": lambda x: ca.if_else(x > 0, 1, 0) - ca.if_else(x < 0, 1, 0),
        "FLOOR": own.floor,
        "CEIL": lambda x: -own.floor(-x),
        "TAN": lambda x: own.sine(x) / own.cosine(x),
        "EXP": own.exponential,
        "SINH": lambda x: 0.5 * (own.exponential(x) - own.exponential(-x)),
        "COSH": lambda x: 0.5 * (own.exponential(x) + own.exponential(-x)),
        "TANH": lambda x: 1 - 2 / (own.exponential(x + x) + 1),
        "ATAN2": own.arctangent,
        "ATAN": lambda x: own.arctangent(x, ca.SX(1)),
        "HYPOT": lambda x, y: ca.sqrt(x * x + y * y),
        "CONSTPOW": _power,
        "POW": _power,
    }
    if name not in forms:
        raise CheckError(f"firmware has no form of CasADi's {name}: none of sines, exponentials and roots")
    return forms[name]


_KEPT = (
    *("ADD", "SUB", "MUL", "DIV", "NEG", "FABS", "SQRT", "FMIN", "FMAX"),
    *("LT", "LE", "EQ", "NE", "NOT", "AND", "OR", "IF_ELSE_ZERO"),
)


def _power(x: Any, exponent: Any) -> Any:
    """x to a constant whole exponent, by squares. Raises CheckError for others."""
    value = float(exponent) if ca.SX(exponent).is_constant() else math.nan
    if value != round(value) or abs(value) > 64:
        raise CheckError("firmware has no powers but those of whole exponents up to 64")
    left, square, found = int(abs(value)), x, None
    while left:
        if left & 1:
            found = square if found is None else found * square
        square, left = square * square, left >> 1
    found = ca.SX(1) if found is None else found
    return 1 / found if value < 0 else found


class _Waves:
    """Sines and cosines of a function; those of one angle plus several constants follow from two of them.

    sin(x + c) = sin(x) cos(c) + cos(x) sin(c)
    """

    def __init__(self, f: ca.Function, own: Elementary) -> None:
        self.own = own
        self.values: dict[int, Any] = {}  # by the instruction that computes them
        self.angles: dict[int, _Angle] = {}  # of the instructions that are sines and cosines
        self.pairs: dict[int, tuple[Any, Any]] = {}  # sine and cosine of a base
        maker: dict[int, int] = {}  # place in CasADi's work vector -> the instruction there
        constant: dict[int, float] = {}
        split: dict[int, _Angle] = {}
        for k in range(f.n_instructions()):
            op, reads, writes = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
            if op == ca.OP_CONST:
                constant[k] = f.instruction_constant(k)
            elif op in (ca.OP_ADD, ca.OP_SUB):
                one, other = maker[reads[0]], maker[reads[1]]
                if other in constant:
                    split[k] = _Angle(one, constant[other] if op == ca.OP_ADD else -constant[other])
                elif one in constant and op == ca.OP_ADD:
                    split[k] = _Angle(other, constant[one])
            elif op in (ca.OP_SIN, ca.OP_COS):
                self.angles[k] = split.get(maker[reads[0]], _Angle(maker[reads[0]], 0.0))
            if op != ca.OP_OUTPUT:
                maker[writes[0]] = k
        self.uses = Counter(angle.base for angle in self.angles.values())

    def note(self, k: int, value: Any) -> None:
        """Keep the value of an instruction: it may be an angle without its shift."""
        self.values[k] = value

    def value(self, k: int, name: str, x: Any) -> Any:
        """The sine or cosine x of instruction k."""
        base, shift = self.angles[k]
        if self.uses[base] < _SHIFTS_WORTH:
            return self.own.sine(x) if name == "SIN" else self.own.cosine(x)
        if base not in self.pairs:
            self.pairs[base] = self.own.sine(self.values[base]), self.own.cosine(self.values[base])
        s, c = self.pairs[base]
        if not shift:
            return s if name == "SIN" else c
        if name == "SIN":
            return s * math.cos(shift) + c * math.sin(shift)
        return c * math.cos(shift) - s * math.sin(shift)
