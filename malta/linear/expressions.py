"""A CasADi function's instructions, walked in whatever arithmetic is asked for.

The same straight-line program is evaluated on exact rationals (a point), on polynomials (structure), and on complex
balls (a bound over a whole box, complex neighbourhoods included). What an arithmetic cannot do it refuses by raising
`NotAnalytic` with the operation's name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import casadi as ca
from flint import fmpq

from malta.errors import InputError
from malta.linear.roots import PREFIX, RootEntry, root_name

NAMES = {getattr(ca, name): name.removeprefix("OP_").lower() for name in dir(ca) if name.startswith("OP_")}
FIELD: dict[str, Callable[..., Any]] = {  # operations of any field
    "assign": lambda a: a,
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "sq": lambda a: a * a,
    "twice": lambda a: a + a,
    "inv": lambda a: 1 / a,
}
CIRCULAR = ("sin", "cos", "tan", "asin", "acos", "atan", "atan2")
HYPERBOLIC = ("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
ANALYTIC = (
    *CIRCULAR,
    *HYPERBOLIC,
    "exp",
    "expm1",
    "log",
    "log1p",
    "sqrt",
    "pow",
    "hypot",
    "erf",
)  # in balls.py


def is_rational_step(name: str, value: float) -> bool:
    """Whether a step is one of +, -, *, / and whole powers, a constant or an input."""
    return name in FIELD or name in ("const", "input") or (name == "constpow" and value == round(value))


class NotAnalytic(Exception):
    """An operation has no value, or is not analytic, at its arguments."""


@lru_cache(maxsize=4096)  # constants and gains are needed at every place
def exact(x: float) -> Any:
    """The rational number that a float is; rational constants, as another basis has, are what they are."""
    if isinstance(x, fmpq):
        return x
    if not abs(x) < float("inf"):
        raise NotAnalytic("a constant that is not finite")
    return fmpq(*float(x).as_integer_ratio())


Step = tuple[str, int, tuple[int, ...], Any]  # operation, target, operands; a constant, a power, a RootEntry


@dataclass(frozen=True, eq=False)
class MatrixProgram:
    """Matrices of scalar expressions in p: instructions (operation, target, operands, constant) on numbered cells."""

    steps: tuple[Step, ...]
    entries: tuple[tuple[tuple[int, int, int], ...], ...]  # of each matrix: row, column, step that made it
    shapes: tuple[tuple[int, int], ...]
    inputs: int

    @cached_property
    def rational(self) -> bool:
        """Whether p enters by +, -, *, / and whole powers alone."""
        return all(is_rational_step(name, value) for name, _, _, value in self.steps)

    @cached_property
    def short(self) -> bool:
        """Whether all constants are floats: other rationals, of another basis, are long."""
        return all(isinstance(value, float) for _, _, _, value in self.steps)

    @cached_property
    def foreign(self) -> tuple[str, ...]:
        """Operations that have no complex extension: if_else, abs, floor, ..."""
        return tuple(sorted({name for name, *_ in self.steps if name not in KNOWN_OPERATIONS}))

    @cached_property
    def implicit(self) -> bool:
        """Whether roots of equations are among the operations."""
        return any(name == "root" for name, *_ in self.steps)

    @cached_property
    def reach(self) -> tuple[frozenset[int], ...]:
        """The parameters on which each step depends."""
        on: list[frozenset[int]] = []
        for name, target, operands, _ in self.steps:
            if name == "input":
                on.append(frozenset({target}))
            else:
                on.append(frozenset().union(*(on[k] for k in operands)))
        return tuple(on)

    @cached_property
    def depends(self) -> tuple[frozenset[int], ...]:
        """The parameters on which each matrix depends."""
        return tuple(frozenset().union(*(self.reach[k] for _, _, k in entries)) for entries in self.entries)

    def only(self, matrices: tuple[int, ...]) -> MatrixProgram:
        """The program of these matrices alone; the others have no entries."""
        return _only(self, matrices)

    def run(self, p: Sequence[Any], field: Arithmetic) -> list[list[tuple[int, int, Any]]]:
        """The entries (row, column, value) of each matrix at p, without structural zeros."""
        cells = self.cells(p, field)
        return [[(i, j, cells[k]) for i, j, k in entries] for entries in self.entries]

    def cells(self, p: Sequence[Any], field: Arithmetic) -> list[Any]:
        """The results of all steps at p."""
        cells: list[Any] = []
        for name, target, operands, value in self.steps:
            if name == "mul":  # nine of ten steps are these
                cells.append(cells[operands[0]] * cells[operands[1]])
            elif name == "add":
                cells.append(cells[operands[0]] + cells[operands[1]])
            elif name == "sub":
                cells.append(cells[operands[0]] - cells[operands[1]])
            elif name == "input":
                cells.append(p[target])
            elif name == "const":
                cells.append(field.constant(value))
            else:
                cells.append(field.apply(name, [cells[k] for k in operands], value))
        return cells


@lru_cache(maxsize=64)
def _only(program: MatrixProgram, matrices: tuple[int, ...]) -> MatrixProgram:
    needed = {k for n in matrices if n < len(program.entries) for _, _, k in program.entries[n]}
    for k in range(len(program.steps) - 1, -1, -1):
        if k in needed:
            needed.update(program.steps[k][2])
    new = {k: i for i, k in enumerate(sorted(needed))}
    steps = tuple(
        (name, target, tuple(new[i] for i in operands), value)
        for name, target, operands, value in (program.steps[k] for k in new)
    )
    entries = tuple(
        tuple((i, j, new[k]) for i, j, k in own) if n in matrices else ()
        for n, own in enumerate(program.entries)
    )
    return MatrixProgram(steps, entries, program.shapes, program.inputs)


class Arithmetic:
    """An arithmetic: the field operations of its numbers, and a table of other operations."""

    def __init__(self, constant: Callable[[float], Any], others: dict[str, Callable[..., Any]]) -> None:
        self.constant = constant
        self.others = others

    def apply(self, name: str, operands: list[Any], value: Any) -> Any:
        try:
            if name in FIELD:
                return FIELD[name](*operands)
            if name == "constpow":
                return self._power(operands[0], value)
            if name == "root" and name in self.others:
                return self.others[name](value, operands)
            if name in self.others:
                return self.others[name](*operands)
        except ZeroDivisionError as error:
            raise NotAnalytic("a division by zero") from error
        raise NotAnalytic(name)

    def _power(self, base: Any, exponent: float) -> Any:
        if exponent == round(exponent):
            k = int(exponent)
            return base**k if k >= 0 else 1 / base ** (-k)
        if "pow" not in self.others:
            raise NotAnalytic("pow")
        return self.others["pow"](base, self.constant(exponent))


KNOWN_OPERATIONS = frozenset({*FIELD, *ANALYTIC, "const", "input", "constpow", "root"})
EXACT_ARITHMETIC = Arithmetic(exact, {})


def program(function: ca.Function) -> MatrixProgram:
    """The instructions of a CasADi function p -> matrices.

    Raises InputError when the function calls one without scalar instructions, as an interpolation table.
    """
    try:
        flat = function.expand() if not function.is_a("SXFunction") else function
    except RuntimeError as error:
        raise InputError(
            "uncertain", function.name(), "calls of functions that cannot be written out", "plain expressions"
        ) from error
    made: dict[int, int] = {}  # work cell of CasADi -> our step
    steps: list[Step] = []
    outputs: dict[tuple[int, int], int] = {}
    arity = dict.fromkeys(("assign", "neg", "sq", "twice", "inv", "constpow"), 1)
    for k in range(flat.n_instructions()):
        op, source, target = flat.instruction_id(k), flat.instruction_input(k), flat.instruction_output(k)
        name = NAMES[op]
        if name == "output":
            outputs[target[0], target[1]] = made[source[0]]
            continue
        if name == "input":
            steps.append((name, source[1], (), 0.0))
        elif name == "const":
            steps.append((name, 0, (), flat.instruction_constant(k)))
        elif name == "constpow":
            exponent = steps[made[source[1]]] if len(source) > 1 else None
            value = exponent[3] if exponent is not None else flat.instruction_constant(k)
            steps.append((name, 0, (made[source[0]],), value))
        elif name == "call":
            operands = [made[i] for i in source if i >= 0]  # cells that the results may take
            root = _called_root(flat, [steps[k] for k in operands])
            for place, cell in enumerate(target):
                if cell >= 0:
                    made[cell] = len(steps)
                    steps.append(
                        ("call", 0, tuple(operands), 0.0) if root is None or place >= root.numel_out(0)
                        else ("root", 0, tuple(operands[: root.numel_in(0)]), RootEntry(root, place))
                    )  # fmt: skip
            continue
        else:
            steps.append(_step(name, [made[i] for i in source[: arity.get(name, len(source))]], steps))
        made[target[0]] = len(steps) - 1
    entries = []
    for n in range(flat.n_out()):
        pattern = flat.sparsity_out(n)
        rows, columns = pattern.get_triplet()
        entries.append(
            tuple(
                (i, j, outputs[n, k])
                for k, (i, j) in enumerate(zip(rows, columns, strict=True))
                if (n, k) in outputs and steps[outputs[n, k]] != ("const", 0, (), 0.0)
            )
        )
    shapes = tuple(flat.size_out(n) for n in range(flat.n_out()))
    return MatrixProgram(tuple(steps), tuple(entries), shapes, flat.size1_in(0))


def _called_root(flat: ca.Function, operands: list[Step]) -> ca.Function | None:
    """The root that a call is of, which the constant behind its parameters names; None for another call.

    Calls of what CasADi derives of a root have the same constant there, and more operands: values and seeds.
    """
    for name in flat.get_function():
        root = flat.get_function(name) if name.startswith(PREFIX) else None
        if root is not None and len(operands) == root.nnz_in():
            key = operands[root.numel_in(0)]
            if key[0] == "const" and name == root_name(key[3]):
                return root
    return None


def _step(name: str, operands: list[int], steps: list[Step]) -> Step:
    if name == "pow" and steps[operands[1]][0] == "const":
        return ("constpow", 0, (operands[0],), steps[operands[1]][3])
    return (name, 0, tuple(operands), 0.0)
