"""A lowered function as a list of operations; evaluated here in either precision, written as C in ctext.py."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.errors import CheckError
from malta.firmware.elementary import Precision
from malta.firmware.lowering import NAMES

TRUTHS = ("LT", "LE", "EQ", "NE", "NOT", "AND", "OR")  # operations whose result is true or false
TYPES: dict[Precision, Any] = {"double": np.float64, "float": np.float32}


class Operation(NamedTuple):
    """One operation on earlier ones; an argument or a constant has no operands."""

    op: str  # CasADi's name without OP_; PICK: the first operand decides between the other two
    operands: tuple[int, ...] = ()
    value: float = 0.0  # of a CONST
    place: tuple[int, int] = (0, 0)  # of an INPUT: argument, entry


class Block(NamedTuple):
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
    blocks: tuple[Block, ...] = ()  # in which it is computed, if any

    @property
    def names(self) -> list[str]:
        """The names of the results, then of what blocks hand on."""
        return [name for name, _ in (*self.results, *self.between)]

    @property
    def statements(self) -> int:
        """The number of operations that compute something."""
        return sum(o.op not in ("INPUT", "CONST") for o in self.operations)


@lru_cache(maxsize=256)
def program_of(f: ca.Function) -> Program:
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


def reached(operations: Sequence[Operation], wanted: Iterable[int]) -> set[int]:
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
    needed = reached(p.operations, [k for *_, k in p.outputs])
    number = {k: n for n, k in enumerate(sorted(needed))}
    operations = tuple(
        p.operations[k]._replace(operands=tuple(number[a] for a in p.operations[k].operands)) for k in number
    )
    return p._replace(operations=operations, outputs=tuple((i, j, number[k]) for i, j, k in p.outputs))


_RULES: dict[str, Callable[..., Any]] = {
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
