"""The instructions of a CasADi function as a simplified straight line of scalar operations.

A scalar that depends on the parameters theta only is marked `fixed`: it is computed once a run. Every operation
stands once.
A fixed factor that the terms of a sum share is taken out of the sum.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Sequence
from functools import reduce
from typing import NamedTuple

import casadi as ca

from malta.errors import CheckError

_BINARY_SIGNS = {"ADD": "+", "SUB": "-", "MUL": "*"}
_TRUTH = {"LT": "<", "LE": "<=", "EQ": "==", "NE": "!="}
_MATH = (
    *("sqrt", "floor", "ceil", "exp", "log", "tan", "tanh", "asin", "acos", "atan", "sinh", "cosh", "sign"),
    *("asinh", "acosh", "atanh", "erf", "expm1", "log1p"),
)
_MATH_OF_TWO = ("pow", "atan2", "hypot", "fmod", "remainder", "copysign")
_FORMS = (
    {f"OP_{name}": f"{{0}} {sign} {{1}}" for name, sign in _BINARY_SIGNS.items()}
    | {f"OP_{name.upper()}": f"each_{name}({{0}})" for name in _MATH}
    | {f"OP_{name.upper()}": f"each_{name}({{0}}, {{1}})" for name in _MATH_OF_TWO}
    | {
        "OP_ASSIGN": "{0}",
        "OP_NEG": "-{0}",
        "OP_SQ": "{0} * {0}",
        "OP_TWICE": "{0} + {0}",
        "OP_DIV": "{0} * inverse({1})",
        "OP_INV": "inverse({0})",
        "OP_FABS": "size({0})",
        "OP_SIN": "sine({0})",
        "OP_COS": "cosine({0})",
        "OP_FMIN": "smaller({0}, {1})",
        "OP_FMAX": "larger({0}, {1})",
        "OP_CONSTPOW": "each_pow({0}, {1})",
        "OP_IF_ELSE_ZERO": "where({0}, {1})",  # the first argument is a mask
        "PICK": "pick({0}, {1}, {2})",  # the first argument is a mask
        "TILT": "tilt({0})",  # the square of an angle that is probably small; sine, cosine and secant of it
        "TILT_SINE": "tilt_sine({0}, {1})",
        "TILT_COSINE": "tilt_cosine({0}, {1})",
        "TILT_SECANT": "tilt_secant({0}, {1})",
        "SINE_OF_PI": "sine_of_pi({0}, 0)",  # of an angle in half turns
        "COSINE_OF_PI": "sine_of_pi({0}, 1)",
    }
)


# Truth values are masks; they become 1 and 0 where an arithmetic operation reads them.
MASKS = {f"OP_{name}": f"MASK({{0}} {sign} {{1}})" for name, sign in _TRUTH.items()} | {
    "OP_NOT": "~{0}",
    "OP_AND": "{0} & {1}",
    "OP_OR": "{0} | {1}",
}
_NAMES = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}


class Node(NamedTuple):
    """A scalar of the straight line: an operation on earlier nodes, an argument, or a constant."""

    op: str  # "" for arguments and constants, whose form stands in place of a variable
    form: str  # in C, with {0}, {1}, ... for the arguments
    arguments: tuple[int, ...]
    fixed: bool  # depends on theta and constants only: computed once a run
    common: bool  # has the same value in every lane


def read_instructions(
    f: ca.Function, shared: Sequence[int], common: Collection[int] = ()
) -> tuple[list[Node], list[tuple[int, int, int]]]:
    """The nodes of an SX function, and (result, entry, node) for every entry of its results.

    shared : arguments that have the same value in every lane
    common : entries of theta that have the same value in every lane

    Raises CheckError for an operation that has no form in C.
    """
    theta = f.n_in() - 1
    nodes = _StraightLine()
    slot: dict[int, int] = {}  # place in CasADi's work vector -> the node there
    outputs: list[tuple[int, int, int]] = []
    for k in range(f.n_instructions()):
        op, reads, writes = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_OUTPUT:
            outputs.append((writes[0], writes[1], slot[reads[0]]))
            continue
        if op == ca.OP_INPUT:
            i, j = reads
            if i == theta:
                node = Node("INPUT", f"theta[{j}]", (), True, j in common)
            elif i in shared:
                node = Node("", f"K(a{i}[{j}])", (), False, True)
            else:
                node = Node("", f"a{i}[{j}]", (), False, False)
            slot[writes[0]] = nodes.place(node)
        elif op == ca.OP_CONST:
            text = f"K({_number(f.instruction_constant(k))})"
            slot[writes[0]] = nodes.place(Node("", text, (), True, True))
        else:
            name = _NAMES[op]
            if name not in _FORMS and name not in MASKS:
                raise CheckError(f"the compiled engine has no {name}")
            slot[writes[0]] = nodes.add(name, *(slot[r] for r in reads))
    return nodes.nodes, outputs


def _number(value: float) -> str:
    """A constant in C."""
    return repr(value).replace("inf", "INFINITY").replace("nan", "NAN")


class _StraightLine:
    """Nodes in order, each of them once. Methods named after an operation return a simpler form, or None."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[Node, int] = {}

    def place(self, node: Node) -> int:
        """The index of a node, which is appended unless it is there already."""
        if node not in self._known:
            self._known[node] = len(self.nodes)
            self.nodes.append(node)
        return self._known[node]

    def add(self, name: str, *arguments: int) -> int:
        """The index of an operation's result, in the cheapest form that is known for it."""
        made = getattr(self, f"_{name.removeprefix('OP_').lower()}", None)
        found: int | None = made(*arguments) if made is not None else None
        return self._append(name, *arguments) if found is None else found

    def _append(self, name: str, *arguments: int) -> int:
        if name in ("OP_ADD", "OP_MUL"):
            arguments = tuple(sorted(arguments))
        fixed, common = (all(getattr(self.nodes[a], each) for a in arguments) for each in ("fixed", "common"))
        return self.place(Node(name, MASKS.get(name) or _FORMS[name], arguments, fixed, common))

    def _fixed_factor(self, k: int) -> tuple[int, int] | None:
        """(fixed factor, other factor) of a product; None for other nodes and for fixed products."""
        node = self.nodes[k]
        if node.op != "OP_MUL" or node.fixed:
            return None
        one, other = node.arguments
        if self.nodes[one].fixed:
            return one, other
        return (other, one) if self.nodes[other].fixed else None

    def _mul(self, one: int, other: int) -> int | None:
        """f (g x) = (f g) x for fixed f and g: their product is computed once a run."""
        for factor, product in ((one, other), (other, one)):
            parts = self._fixed_factor(product)
            if self.nodes[factor].fixed and parts is not None:
                return self._append("OP_MUL", self._append("OP_MUL", factor, parts[0]), parts[1])
        return self._cancel(one, other)

    def _cancel(self, one: int, other: int) -> int | None:
        """A product without the pairs of a tilt's cosine and secant among its factors; None if there is no pair."""
        first, second = self._factors(one), self._factors(other)
        for k in first + second:
            node = self.nodes[k]
            inverse = {"TILT_COSINE": "TILT_SECANT", "TILT_SECANT": "TILT_COSINE"}.get(node.op)
            pair = [
                j
                for j in first + second
                if (self.nodes[j].op, self.nodes[j].arguments) == (inverse, node.arguments)
            ]
            if pair:
                rest = first + second
                rest.remove(k)
                rest.remove(pair[0])
                return reduce(lambda a, b: self.add("OP_MUL", a, b), rest) if rest else None
        return None

    def _factors(self, k: int) -> list[int]:
        """The factors of a product of products."""
        node = self.nodes[k]
        if node.op != "OP_MUL" or node.fixed:
            return [k]
        return [factor for a in node.arguments for factor in self._factors(a)]

    def _div(self, one: int, other: int) -> int | None:
        """x / y = x (1 / y): the reciprocal of a fixed y is computed once a run."""
        return self.add("OP_MUL", one, self.add("OP_INV", other))

    def _inv(self, k: int) -> int | None:
        node = self.nodes[k]
        if node.fixed:
            return self.place(Node("OP_INV", "1.0 / {0}", (k,), True, node.common))
        factors = self._factors(k)
        if any(self.nodes[a].op != "TILT_COSINE" for a in factors):
            return None
        secants = [self._append("TILT_SECANT", *self.nodes[a].arguments) for a in factors]
        return reduce(lambda a, b: self.add("OP_MUL", a, b), secants)

    def _add(self, one: int, other: int) -> int | None:
        """(c ? x : 0) + (not c ? y : 0), as CasADi writes if_else(c, x, y), becomes one operation."""
        first, second = self.nodes[one], self.nodes[other]
        if first.op == second.op == "OP_IF_ELSE_ZERO":
            condition = self.nodes[second.arguments[0]]
            if condition.op == "OP_NOT" and condition.arguments == first.arguments[:1]:
                return self._append("PICK", *first.arguments, second.arguments[1])
        return self._take_out_factor("OP_ADD", one, other)

    def _sub(self, one: int, other: int) -> int | None:
        return self._take_out_factor("OP_SUB", one, other)

    def _take_out_factor(self, name: str, one: int, other: int) -> int | None:
        """f x + f y = f (x + y) for a fixed f; the same for differences."""
        first, second = self._fixed_factor(one), self._fixed_factor(other)
        if first is None or second is None or first[0] != second[0]:
            return None
        return self.add("OP_MUL", first[0], self.add(name, first[1], second[1]))

    def _sin(self, k: int) -> int | None:
        return self._tilt("TILT_SINE", k) or self._wave("SINE_OF_PI", k)

    def _cos(self, k: int) -> int | None:
        return self._tilt("TILT_COSINE", k) or self._wave("COSINE_OF_PI", k)

    def _wave(self, name: str, k: int) -> int | None:
        """Sine or cosine of f x + g with fixed f and g, as of pi ((f / pi) x + g / pi): half turns are integers."""
        node = self.nodes[k]
        product, shift = k, None
        if node.op == "OP_ADD":
            shift, product = sorted(node.arguments, key=lambda a: not self.nodes[a].fixed)
        parts = self._fixed_factor(product)
        if parts is None or not (shift is None or self.nodes[shift].fixed):
            return None
        per_pi = self.place(Node("", f"K({1 / math.pi!r})", (), True, True))
        turns = self._append("OP_MUL", self.add("OP_MUL", per_pi, parts[0]), parts[1])
        if shift is not None:
            turns = self._append("OP_ADD", turns, self.add("OP_MUL", per_pi, shift))
        return self._append(name, turns)

    def _tilt(self, name: str, k: int) -> int | None:
        """Sine or cosine of an angle that is probably small: a state, or a state with something added to it."""
        return self._append(name, k, self._append("TILT", k)) if self._is_tilt(k) else None

    def _is_tilt(self, k: int) -> bool:
        node = self.nodes[k]
        if node.op in ("OP_ADD", "OP_SUB"):
            return any(self._is_tilt(a) for a in node.arguments)
        return node.form.startswith("a0[")


def mask_arguments(node: Node) -> range:
    """Indices of the arguments that a node takes as masks."""
    if node.op in ("OP_IF_ELSE_ZERO", "PICK"):
        return range(1)
    return range(2) if node.op in ("OP_NOT", "OP_AND", "OP_OR") else range(0)


def needed_nodes(nodes: list[Node], roots: list[int]) -> list[int]:
    """The nodes on which the roots depend, in order."""
    needed, waiting = set(), list(roots)
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += nodes[k].arguments
    return sorted(needed)


# What is computed once rather than in every lane at every sample, and its place in the arrays c, d and g of C text.
#
# c   once a run, in every lane: depends on theta only
# d   once a run for all lanes: depends only on the numbers that they share, those of the controller
# g   once a sample for all lanes: depends on these and on the inputs of the sample, as K xi* + v_ff does


PLAIN_OPERATIONS = ("OP_ADD", "OP_SUB", "OP_MUL", "OP_SQ", "OP_NEG", "OP_TWICE")  # same text for lanes


class Counts(NamedTuple):
    """Entries of the arrays of what is computed once."""

    c: int = 0
    d: int = 0
    g: int = 0


NO_COUNTS = Counts()


def counts_of(place: dict[int, str]) -> Counts:
    """How many entries of each array are taken."""
    return Counts(*(sum(entry.startswith(array) for entry in place.values()) for array in "cdg"))


def find_common(nodes: list[Node], used: list[int]) -> set[int]:
    """The nodes that are computed once a sample for all lanes: plain operations on inputs of the sample and numbers
    that the lanes share."""
    found: set[int] = set()
    for k in used:
        node = nodes[k]
        known = all(nodes[a].fixed or not nodes[a].op or a in found for a in node.arguments)
        if node.op in PLAIN_OPERATIONS and node.common and not node.fixed and known:
            found.add(k)
    return found


def places(
    nodes: list[Node], used: list[int], early: set[int], results: set[int], first: Counts
) -> dict[int, str]:
    """The entries of nodes that are computed once and read later.

    early : the nodes that `find_common` found
    results : of the function
    first : entries before those of this function
    """
    later = [k for k in used if nodes[k].op and not nodes[k].fixed and k not in early]
    read = {a for k in later for a in nodes[k].arguments} | results
    kept = [k for k in used if nodes[k].fixed and nodes[k].op]
    kept = [k for k in kept if k in read or any(k in nodes[reader].arguments for reader in early)]
    members = {
        "c": [k for k in kept if not nodes[k].common],
        "d": [k for k in kept if nodes[k].common],
        "g": [k for k in used if k in early and k in read],
    }
    return {
        k: f"{array}[{start + index}]"
        for (array, chosen), start in zip(members.items(), first, strict=True)
        for index, k in enumerate(chosen)
    }


def foresee(nodes: list[Node], used: list[int], early: set[int], place: dict[int, str]) -> list[str]:
    """Lines that compute the entries of g from the inputs of a sample, in numbers rather than lanes."""

    def text(k: int) -> str:
        if k in early:
            return f"t{k}"
        if nodes[k].op:
            return place[k]
        return re.sub(r"^K\((?:a\d+(\[\d+\])|(.*))\)$", _of_one_lane, nodes[k].form)

    members = [k for k in used if k in early]
    values = [nodes[k].form.format(*map(text, nodes[k].arguments)) for k in members]
    lines = [f"  const double t{k} = {value};" for k, value in zip(members, values, strict=True)]
    return lines + [f"  {place[k]} = t{k};" for k in members if k in place]


def _of_one_lane(found: re.Match[str]) -> str:
    """An input of the sample, or a constant, without its repetition in every lane."""
    return f"given{found[1]}" if found[1] else f"({found[2]})"
