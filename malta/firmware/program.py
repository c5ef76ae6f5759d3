"""A lowered function as a list of operations; evaluated here in either precision, written as C in ctext.py."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, reduce
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from malta.errors import CheckError

# Elementary functions as polynomials of basic operations: every processor that adds by IEEE 754 gets the same bits.
#
# Every C library rounds its sine in its own way. Here a function consists of +, -, *, /, comparisons and choices, of
# which the standard fixes each bit, in an order that no compiler changes unless it is told to (-ffast-math,
# contraction).
#
#     function     domain             largest error: double     float
#     sine         |x| <= 1e5, 1e3    2.3e-16, absolute         1.2e-7
#     cosine       |x| <= 1e5, 1e3    2.3e-16, absolute         1.2e-7
#     exponential  -87 .. 87          2.5e-16, relative         1.3e-7; beyond the domain the value at its end
#     arctangent   of y / x, any      4.5e-16, absolute         2.4e-7
#     floor        |x| < 2^51, 2^22   0                         0
#
# Arguments and results are CasADi SX; call these functions within `as_written()`, or CasADi cancels what rounding
# needs.


Precision = Literal["double", "float"]
EDGE = 87.0  # of the exponential's domain: e^87 is the largest power of e that a float holds


@contextmanager
def as_written() -> Iterator[None]:
    """CasADi keeps expressions as they are written: (x + s) - s does not become x."""
    before = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)
    try:
        yield
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(before)


@dataclass(frozen=True)
class Elementary:
    """The functions of one precision; coefficients are minimax polynomials (Remez), rounded to that precision."""

    shift: float  # 1.5 times 2 to the bits of the significand: adding it rounds to a whole number
    pi: tuple[float, ...]  # parts that add up to pi, of so few bits that a whole number times a part is exact
    ln2: tuple[float, ...]
    sines: tuple[float, ...]  # (sin(r) / r - 1) / r^2 in powers of r^2, |r| up to pi/2
    exponentials: tuple[float, ...]  # (e^r - 1 - r) / r^2 in powers of r, |r| up to ln(2) / 2
    arctangents: tuple[float, ...]  # (atan(r) / r - 1) / r^2 in powers of r^2, |r| up to tan(pi/8)

    def round_to_even(self, x: Any) -> Any:
        """The nearest whole number; halves go to the even one."""
        return (x + self.shift) - self.shift

    def floor(self, x: Any) -> Any:
        """The largest whole number that is not above x."""
        n = self.round_to_even(x)
        return ca.if_else(x < n, n - 1, n)

    def sine(self, x: Any) -> Any:
        """sin(x) = (-1)^n sin(x - n pi) with the nearest n."""
        return self._wave(x, self.round_to_even(x * (1 / math.pi)), 0.0)

    def cosine(self, x: Any) -> Any:
        """cos(x) = sin(x + pi/2) = (-1)^n sin(x - (n - 1/2) pi)."""
        return self._wave(x, self.round_to_even(x * (1 / math.pi) + 0.5), 0.5)

    def _wave(self, x: Any, n: Any, half: float) -> Any:
        turns = n - half if half else n
        r = reduce(lambda rest, part: rest - turns * part, self.pi, x)
        odd = n * 0.5 - self.round_to_even(n * 0.5)  # -1/2 or 1/2 for odd n, else 0
        t = r * r
        return (r + r * (t * polynomial(self.sines, t))) * (1 - 8 * (odd * odd))

    def exponential(self, x: Any) -> Any:
        """e^x = 2^n e^(x - n ln 2) with the nearest n; x is taken within the domain."""
        x = ca.fmax(ca.fmin(x, EDGE), -EDGE)
        n = self.round_to_even(x * (1 / math.log(2)))
        r = reduce(lambda rest, part: rest - n * part, self.ln2, x)
        return (1 + (r + r * r * polynomial(self.exponentials, r))) * _power_of_two(n)

    def arctangent(self, y: Any, x: Any) -> Any:
        """The angle of the point (x, y), in [-pi, pi]; 0 at the origin."""
        a, b = ca.fabs(y), ca.fabs(x)
        low, high = ca.fmin(a, b), ca.fmax(a, b)
        q = low / ca.if_else(high > 0, high, 1)
        steep = q > math.tan(math.pi / 8)
        r = ca.if_else(steep, (q - 1) / (q + 1), q)
        t = r * r
        angle = ca.if_else(steep, math.pi / 4, 0) + (r + r * (t * polynomial(self.arctangents, t)))
        angle = ca.if_else(a > b, math.pi / 2 - angle, angle)
        angle = ca.if_else(x < 0, math.pi - angle, angle)
        return ca.if_else(y < 0, -angle, angle)


def polynomial(coefficients: tuple[float, ...], t: Any) -> Any:
    """Horner's scheme; the coefficient of the lowest power first."""
    return reduce(lambda value, c: c + t * value, coefficients[-2::-1], ca.SX(coefficients[-1]))


def _logarithm(x: Any, beyond: Any) -> Any:
    """ln x = n ln 2 + 2 artanh((m - 1) / (m + 1)) of x = 2^n m with m near 1; beyond: x - 1, as exact as it is known.

    x is taken within 2^-126 .. 2^127; m is within 0.7 .. 1.41, where 11 terms of the series leave 1e-17.
    """
    m, n = ca.fmax(ca.fmin(x, 2.0**127), 2.0**-126), ca.SX(0)
    for digit in range(6, -1, -1):
        up = 2.0 ** (2**digit)
        large, small = m >= up, m * up <= 1
        m = ca.if_else(large, m / up, ca.if_else(small, m * up, m))
        n += ca.if_else(large, 2**digit, ca.if_else(small, -(2**digit), 0))
    over, under = m > math.sqrt(2), m < math.sqrt(0.5)
    m = ca.if_else(over, m / 2, ca.if_else(under, 2 * m, m))
    n += ca.if_else(over, 1, ca.if_else(under, -1, 0))
    s = ca.if_else(n == 0, beyond / (2 + beyond), (m - 1) / (m + 1))
    t = s * s
    return n * math.log(2) + 2 * s * (1 + t * polynomial(tuple(1 / k for k in range(3, 23, 2)), t))


def _area_of_sine(x: Any) -> Any:
    """arsinh x = ln(1 + |x| + x^2 / (1 + sqrt(1 + x^2))) with the sign of x."""
    size = ca.fabs(x)
    beyond = size + size * (size / (1 + ca.sqrt(1 + size * size)))
    found = _logarithm(1 + beyond, beyond)
    return ca.if_else(x < 0, -found, found)


def _power_of_two(n: Any) -> Any:
    """2^n for a whole number n, |n| < 128, as a product of powers for the binary digits of |n|."""
    left, factor = ca.fabs(n), ca.SX(1)
    for digit in range(6, -1, -1):
        up = 2.0 ** (2**digit)
        has = left >= 2**digit
        factor *= ca.if_else(has, ca.if_else(n < 0, 1 / up, up), 1)
        left -= ca.if_else(has, 2**digit, 0)
    return factor


ELEMENTARY_FUNCTIONS: dict[Precision, Elementary] = {
    "double": Elementary(
        shift=1.5 * 2**52,
        pi=(3.1415926534682512, 1.2154201012607932e-10, 4.044532497591901e-21),
        ln2=(0.6931471806019545, -4.200915072890502e-11, 2.0941744292700725e-21),
        sines=(
            *(-0.16666666666666666, 0.008333333333333316, -0.00019841269841254982, 2.755731921916461e-06),
            *(-2.505210761710018e-08, 1.605897731537374e-10, -7.643970286287713e-13, 2.731443529317799e-15),
        ),
        exponentials=(
            *(0.5000000000000001, 0.16666666666666674, 0.04166666666662382, 0.00833333333332212),
            *(0.0013888888917367593, 0.00019841269886848863, 2.4801521057447296e-05, 2.755724205886447e-06),
            *(2.762020173029291e-07, 2.5110149838822772e-08),
        ),
        arctangents=(
            *(-0.33333333333333254, 0.19999999999903234, -0.14285714266830954, 0.11111109679581514),
            *(-0.0909085382136565, 0.07691076011426169, -0.06649815716362417, 0.057374725614175615),
            *(-0.04486805174954979, 0.022794521873363453),
        ),
    ),
    "float": Elementary(
        shift=1.5 * 2**23,
        pi=(3.1416015625, -8.907169103622437e-06, -1.7411032e-09),
        ln2=(0.693115234375, 3.1948089599609375e-05, -1.9046542e-09),
        sines=(-0.16666666, 0.0083332425, -0.00019822776, 2.6348505e-06),
        exponentials=(0.5, 0.16666576, 0.041666374, 0.008363235, 0.0013941204),
        arctangents=(-0.3333333, 0.19999558, -0.14264451, 0.10748238, -0.06464761),
    ),
}


# Any CasADi function as one of basic operations: what firmware computes, instruction by instruction.
#
# `lower` replaces elementary functions by those of program.py. What is left are +, -, *, /, negation, size, the
# smaller and larger of two, square roots, comparisons, their conjunctions, and choices: IEEE 754 fixes every bit of
# them. So the C text, CasADi's own virtual machine and `program.evaluate` give the same bits for the same function.


NAMES = {getattr(ca, name): name.removeprefix("OP_") for name in dir(ca) if name.startswith("OP_")}
_MIN_SHIFTS = 3  # sines and cosines of one angle plus constants, from which on two of them serve for all


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
        waves = _Waves(f, ELEMENTARY_FUNCTIONS[precision])
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
                work[writes[0]] = _form_of(f, k, ELEMENTARY_FUNCTIONS[precision])(*(work[r] for r in reads))
            waves.note(k, work[writes[0]] if op != ca.OP_OUTPUT else None)
        found = [ca.densify(ca.vertcat(*column)) for column in results]
        return ca.Function(f.name(), arguments, ca.cse(found), f.name_in(), f.name_out())


def _form_of(f: ca.Function, k: int, own: Elementary) -> Callable[..., Any]:
    """How an instruction is computed by basic operations."""
    name = NAMES[f.instruction_id(k)]
    if name in _KEPT_OPERATIONS:
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
        "ASIN": lambda x: own.arctangent(x, ca.sqrt((1 - x) * (1 + x))),
        "ACOS": lambda x: own.arctangent(ca.sqrt((1 - x) * (1 + x)), x),
        "LOG": lambda x: _logarithm(x, x - 1),
        "LOG1P": lambda x: _logarithm(1 + x, x),
        "ASINH": _area_of_sine,
        "ACOSH": lambda x: _logarithm(x + ca.sqrt((x - 1) * (x + 1)), (x - 1) + ca.sqrt((x - 1) * (x + 1))),
        "ATANH": lambda x: 0.5 * _logarithm((1 + x) / (1 - x), 2 * x / (1 - x)),
        "HYPOT": lambda x, y: ca.sqrt(x * x + y * y),
        "CONSTPOW": _power,
        "POW": _power,
    }
    if name not in forms:
        raise CheckError(
            f"firmware has no form of CasADi's {name}: none of sines, exponentials, logarithms and roots"
        )
    return forms[name]


_KEPT_OPERATIONS = (
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
        if self.uses[base] < _MIN_SHIFTS:
            return self.own.sine(x) if name == "SIN" else self.own.cosine(x)
        if base not in self.pairs:
            self.pairs[base] = self.own.sine(self.values[base]), self.own.cosine(self.values[base])
        s, c = self.pairs[base]
        if not shift:
            return s if name == "SIN" else c
        if name == "SIN":
            return s * math.cos(shift) + c * math.sin(shift)
        return c * math.cos(shift) - s * math.sin(shift)


TRUTHS = ("LT", "LE", "EQ", "NE", "NOT", "AND", "OR")  # operations whose result is true or false
TYPES: dict[Precision, Any] = {"double": np.float64, "float": np.float32}


class Operation(NamedTuple):
    """One operation on earlier ones; an argument or a constant has no operands."""

    op: str  # CasADi's name without OP_; PICK: the first operand decides between the other two
    operands: tuple[int, ...] = ()
    value: float = 0.0  # of a CONST
    place: tuple[int, int] = (0, 0)  # of an INPUT: argument, entry


class NamedEquation(NamedTuple):
    """An equation and the names of what it gives."""

    name: str
    equation: str
    results: tuple[str, ...]
    times: int = 1  # of equal computations, one after the other in each result


class Program(NamedTuple):
    """The operations of a function in order, each of them once."""

    name: str
    arguments: tuple[tuple[str, int], ...]  # names and sizes
    results: tuple[tuple[str, int], ...]
    operations: tuple[Operation, ...]
    outputs: tuple[tuple[int, int, int], ...]  # result, or behind them one of `between`; entry, operation
    between: tuple[tuple[str, int], ...] = ()  # what blocks hand on: names and sizes
    blocks: tuple[NamedEquation, ...] = ()  # in which it is computed, if any

    @property
    def names(self) -> list[str]:
        """The names of the results, then of what blocks hand on."""
        return [name for name, _ in (*self.results, *self.between)]

    @property
    def statements(self) -> int:
        """The number of operations that compute something."""
        return sum(o.op not in ("INPUT", "CONST") for o in self.operations)


@lru_cache(maxsize=256)
def build_program(f: ca.Function) -> Program:
    """The program of a lowered SX function. Raises CheckError for what `lower` would replace."""
    known: dict[Operation, int] = {}
    operations: list[Operation] = []
    work: dict[int, int] = {}
    outputs = []

    def place(operation: Operation) -> int:
        if operation not in known:
            known[operation] = len(operations)
            operations.append(operation)
        return known[operation]

    for k in range(f.n_instructions()):
        op, reads, writes = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_OUTPUT:
            outputs.append((writes[0], writes[1], work[reads[0]]))
        elif op == ca.OP_INPUT:
            work[writes[0]] = place(Operation("INPUT", place=(reads[0], reads[1])))
        elif op == ca.OP_CONST:
            value = f.instruction_constant(k)
            if not math.isfinite(value):
                raise CheckError(f"firmware has no {value}, which {f.name()} holds")
            work[writes[0]] = place(Operation("CONST", value=value))
        elif NAMES[op] in _RULES:
            operands = tuple(work[r] for r in reads)
            work[writes[0]] = place(
                _shorter(operations, NAMES[op], operands) or Operation(NAMES[op], operands)
            )
        else:
            raise CheckError(f"firmware has no {NAMES[op]}")
    arguments = tuple((f.name_in(i), f.size1_in(i)) for i in range(f.n_in()))
    results = tuple((f.name_out(i), f.size1_out(i)) for i in range(f.n_out()))
    return without_unused(Program(f.name(), arguments, results, tuple(operations), tuple(outputs)))


def _shorter(operations: list[Operation], name: str, operands: tuple[int, ...]) -> Operation | None:
    """A shorter operation with the same value; None where there is none.

    The larger of two truths is their disjunction, the smaller one their conjunction. (c ? x : 0) + (not c ? y : 0), as
    CasADi writes if_else(c, x, y), is one choice.
    """
    if name in ("FMIN", "FMAX") and all(operations[k].op in TRUTHS for k in operands):
        return Operation("OR" if name == "FMAX" else "AND", operands)
    if name != "ADD":
        return None
    first, second = (operations[k] for k in operands)
    if first.op == second.op == "IF_ELSE_ZERO":
        condition = operations[second.operands[0]]
        if condition.op == "NOT" and condition.operands == first.operands[:1]:
            return Operation("PICK", (*first.operands, second.operands[1]))
    return None


def dependencies(operations: Sequence[Operation], wanted: Iterable[int]) -> set[int]:
    """The wanted operations and all on which they depend."""
    needed, waiting = set[int](), list(wanted)
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += operations[k].operands
    return needed


def without_unused(p: Program) -> Program:
    """The program without operations on which no result depends."""
    needed = dependencies(p.operations, [k for *_, k in p.outputs])
    number = {k: n for n, k in enumerate(sorted(needed))}
    operations = tuple(
        p.operations[k]._replace(operands=tuple(number[a] for a in p.operations[k].operands)) for k in number
    )
    return p._replace(operations=operations, outputs=tuple((i, j, number[k]) for i, j, k in p.outputs))


FUSED = ("FMA", "FMS", "FNMA")  # a b + c, a b - c and c - a b, rounded once


def fuse(p: Program) -> Program:
    """The program with a product and the one sum that takes it as one operation, whose bits are other ones.

    For targets that have it as an instruction. Of a sum of two products the first one is fused.
    """
    uses = Counter(a for o in p.operations for a in o.operands) + Counter(k for *_, k in p.outputs)
    fused = list(p.operations)
    for k, o in enumerate(p.operations):
        if o.op not in ("ADD", "SUB"):
            continue
        for side, product in enumerate(o.operands):
            if p.operations[product].op == "MUL" and uses[product] == 1:
                op = "FMA" if o.op == "ADD" else ("FMS", "FNMA")[side]
                fused[k] = Operation(op, (*p.operations[product].operands, o.operands[1 - side]))
                break
    return without_unused(p._replace(operations=tuple(fused)))


def multiply_add(a: Any, b: Any, c: Any) -> Any:
    """a b + c of numbers of one precision, rounded once to it.

    >>> odd = 1 + 2.0**-27
    >>> odd * odd - (1 + 2.0**-26), multiply_add(odd, odd, -(1 + 2.0**-26)) == 2.0**-54
    (0.0, True)
    """
    single = np.float32 in (type(a), type(b), type(c))
    plain = a * b + c
    if not np.isfinite([a, b, c]).all():
        return plain
    exact = Fraction(float(a)) * Fraction(float(b)) + Fraction(float(c))
    if not exact:
        return plain  # 0 of this sign
    try:
        found = float(exact)
    except OverflowError:
        return math.inf if exact > 0 else -math.inf
    rest = exact - Fraction(found) if single else 0
    if rest and not np.float64(found).view(np.int64) & 1:
        found = math.nextafter(
            found, math.copysign(math.inf, rest)
        )  # to odd: single precision then rounds all bits
    return found


_RULES: dict[str, Callable[..., Any]] = {
    "FMA": multiply_add,
    "FMS": lambda a, b, c: multiply_add(a, b, -c),
    "FNMA": lambda a, b, c: multiply_add(-a, b, c),
    "ADD": lambda a, b: a + b,
    "SUB": lambda a, b: a - b,
    "MUL": lambda a, b: a * b,
    "DIV": lambda a, b: a / b,
    "NEG": lambda a: -a,
    "FABS": abs,
    "SQRT": lambda a: np.sqrt(a) if a > 0 else 0.0,
    "FMIN": lambda a, b: a if a < b else b,
    "FMAX": lambda a, b: a if a > b else b,
    "LT": lambda a, b: a < b,
    "LE": lambda a, b: a <= b,
    "EQ": lambda a, b: a == b,
    "NE": lambda a, b: a != b,
    "NOT": lambda a: not a,
    "AND": lambda a, b: bool(a) and bool(b),
    "OR": lambda a, b: bool(a) or bool(b),
    "IF_ELSE_ZERO": lambda c, a: a if c else 0.0,
    "PICK": lambda c, a, b: a if c else b,
}


def evaluate(p: Program, given: Mapping[str, Any], precision: Precision) -> dict[str, Any]:
    """The results by name, in the arithmetic of a precision: operation by operation, without a compiler.

    given : by name, vectors
    """
    real = TYPES[precision]
    vectors = [np.asarray(given[name], dtype=real).ravel() for name, _ in p.arguments]
    values: list[Any] = []
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for operation in p.operations:
            if operation.op == "INPUT":
                i, j = operation.place
                values.append(vectors[i][j])
            elif operation.op == "CONST":
                values.append(real(operation.value))
            else:
                found = _RULES[operation.op](*(values[k] for k in operation.operands))
                values.append(bool(found) if operation.op in TRUTHS else real(found))
    results = {name: np.zeros(size, dtype=real) for name, size in p.results}
    names = [name for name, _ in p.results]
    for i, j, k in p.outputs:
        if i < len(names):
            results[names[i]][j] = values[k]
    return results
