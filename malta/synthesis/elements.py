"""Tunable elements of a control law, and how to add one: named, with parameters, matrices in CasADi."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from scipy import linalg

from malta.arguments import require_real
from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.diagrams import feedback, parallel
from malta.linear.matrices import system_matrix
from malta.linear.system import System

CALLER = "structured"
Matrices = tuple[Any, Any, Any, Any]  # A, B, C and D in CasADi
Solve = Callable[["FloatArray"], tuple["FloatArray", "FloatArray"]]


def _themselves(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    return values, np.eye(len(values))


@dataclass(frozen=True)
class Parameter:
    """A number that is searched: value = start e^x where it keeps its sign, else start + scale x.

    name : within its element
    start : its first value
    scale : of x where the number may change its sign; 0: it keeps its sign
    low, high : bounds of the value
    """

    name: str
    start: float
    scale: float = 0.0
    low: float = -math.inf
    high: float = math.inf

    def value(self, x: float) -> float:
        """The value at x."""
        return self.start + self.scale * x if self.scale else self.start * float(ca.exp(x))

    def slope(self, x: float) -> float:
        """The derivative of the value by x."""
        return self.scale or self.value(x)

    @property
    def bounds(self) -> tuple[float, float]:
        """The bounds of x."""
        ends: list[float | None] = []
        for end in (self.low, self.high):
            if self.scale:
                ends.append((end - self.start) / self.scale)
            else:
                share = end / self.start
                ends.append(math.log(share) if share > 0 and math.isfinite(share) else None)
        low, high = ends if self.scale or self.start > 0 else ends[::-1]
        return (-math.inf if low is None else low), (math.inf if high is None else high)


@dataclass(frozen=True, eq=False)
class Element:
    """A tunable part of a law: `a * b` is b, then a; `a + b` both side by side; `a.feedback(b)` a loop of both.

    name : of the element; parameters are called "name.parameter"
    parameters : what is searched, with the values at which a search starts
    matrices : CasADi values of the parameters, in their order, or of what is solved for -> A, B, C and D
    solve : values of the parameters -> what `matrices` takes, and its derivative by them; the values themselves, but
        of an LQG, whose gains solve two Riccati equations

    >>> from malta import structured
    >>> law = structured.pid("axial", Kp=2e3, Ki=1e4, Kd=5.0, filter=1e-4)
    >>> law = law * structured.lead("roll_off", zero=5e3, pole=2e4)
    >>> law.order, list(law.values)[:2]
    (3, ['axial.Kp', 'axial.Ki'])
    """

    name: str
    parameters: tuple[Parameter, ...]
    matrices: Callable[[Sequence[Any]], Matrices] = field(repr=False)
    solve: Solve = field(default_factory=lambda: _themselves, repr=False)

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name: "element.parameter"."""
        return {p.name if "." in p.name else f"{self.name}.{p.name}": p.start for p in self.parameters}

    @cached_property
    def numbers(self) -> FloatArray:
        """What `matrices` takes at the present values."""
        return self.solve(np.array([p.start for p in self.parameters]))[0]

    @cached_property
    def system(self) -> System:
        """The element with its present values."""
        made = self.matrices([ca.DM(number) for number in self.numbers])
        A, B, C, D = (np.atleast_2d(np.array(ca.DM(M), dtype=float)) for M in made)
        return System(A, B, C, D)

    @property
    def order(self) -> int:
        """The number of states."""
        return len(self.system.A)

    def at(self, values: Mapping[str, float]) -> Element:
        """The same element with other values.

        values : by the names of `Element.values`; others stay
        """
        names = list(self.values)
        own = (
            replace(p, start=float(values.get(n, p.start)))
            for n, p in zip(names, self.parameters, strict=True)
        )
        return replace(self, parameters=tuple(own))

    def __mul__(self, other: Element) -> Element:
        """This element behind another."""
        k = len(self.numbers)

        def matrices(values: Sequence[Any]) -> Matrices:
            A1, B1, C1, D1 = other.matrices(values[k:])
            A2, B2, C2, D2 = self.matrices(values[:k])
            A = system_matrix(A2, B2 @ C1, None, A1)
            return A, ca.vertcat(B2 @ D1, B1), ca.horzcat(C2, D2 @ C1), D2 @ D1

        return _diagram(" ", self, other, matrices)

    def __add__(self, other: Element) -> Element:
        """This element beside another: the sum of their outputs."""
        k = len(self.numbers)

        def matrices(values: Sequence[Any]) -> Matrices:
            return parallel(_expressions(self, values[:k]), _expressions(other, values[k:])).matrices

        return _diagram(" + ", self, other, matrices)

    def feedback(self, other: Element) -> Element:
        """This element with another in its negative feedback: self / (1 + other self).

        other : from the outputs of this element to its inputs
        """
        k = len(self.numbers)

        def matrices(values: Sequence[Any]) -> Matrices:
            return feedback(_expressions(self, values[:k]), _expressions(other, values[k:])).matrices

        return _diagram(" / ", self, other, matrices)


def _expressions(element: Element, values: Sequence[Any]) -> System:
    A, B, C, D = (ca.SX(M) for M in element.matrices(values))
    return System(A, B, C, D)


def _diagram(
    sign: str, one: Element, other: Element, matrices: Callable[[Sequence[Any]], Matrices]
) -> Element:
    """An element of two, its parameters under their whole names. Raises InputError for a name that comes twice."""
    pairs = [pair for e in (one, other) for pair in zip(e.parameters, e.values, strict=True)]
    named = [replace(p, name=name) for p, name in pairs]
    names = [p.name for p in named]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise InputError(CALLER, twice, "one parameter twice", "elements of different names in one diagram")
    return Element(f"{one.name}{sign}{other.name}", tuple(named), matrices, side_by_side(one, other))


def side_by_side(*elements: Element) -> Solve:
    """What several elements solve, each from its own parameters."""
    ends = np.cumsum([len(e.parameters) for e in elements])[:-1]

    def solve(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        own = zip(elements, np.split(values, ends), strict=True)
        numbers, slopes = zip(*(e.solve(v) for e, v in own), strict=True)
        return np.concatenate(numbers), linalg.block_diag(*slopes)

    return solve


def keep_sign(
    element: str, bounds: Mapping[str, tuple[float, float]] | None, **starts: float
) -> list[Parameter]:
    """Parameters that keep their sign. Raises InputError for zeros, and for bounds of others."""
    given = dict(bounds or {})
    found = []
    for name, start in starts.items():
        low, high = given.pop(name, (-math.inf, math.inf))
        if not (math.isfinite(start) and start != 0):
            raise InputError(CALLER, f"{element}.{name}", f"{start}", "a first value that is not 0")
        if not low <= start <= high:
            raise InputError(CALLER, f"{element}.{name}", f"{start}", f"a first value within {low} .. {high}")
        found.append(Parameter(name, float(start), 0.0, low, high))
    if given:
        raise InputError(CALLER, f"{element}.bounds", " ".join(given), "some of " + " ".join(starts))
    return found


Bounds = Mapping[str, tuple[float, float]]


def gain(name: str, value: float, *, bounds: Bounds | None = None) -> Element:
    """A gain, which keeps its sign.

    name : of the element
    value : at which a search starts
    bounds : (low, high) of "value"

    Raises InputError for a gain of 0.

    >>> from malta import structured
    >>> structured.gain("stiffness", 2e3).order
    0
    """
    none = ca.DM(0, 0), ca.DM(0, 1), ca.DM(1, 0)
    return Element(name, tuple(keep_sign(name, bounds, value=value)), lambda v: (*none, v[0]))


def pid(
    name: str,
    Kp: float,
    Ki: float = 0.0,
    Kd: float = 0.0,
    filter: float = 0.0,
    *,
    bounds: Bounds | None = None,
) -> Element:
    """A PID, Kp + Ki / s + Kd s / (1 + filter s), without the terms that are 0.

    name : of the element
    Kp, Ki, Kd : force per error, its integral, its rate
    filter : s, of the rate
    bounds : (low, high) of some of them

    Raises InputError for a Kd without a filter: no sampled law differentiates at once.

    >>> from malta import structured
    >>> structured.pid("axial", Kp=2e3, Ki=1e4, Kd=5.0, filter=1e-4).order
    2
    """
    if Kd and not filter > 0:
        raise InputError(
            CALLER, f"{name}.filter", f"{filter} s", "a time above 0 s: no sampled law has a plain rate"
        )
    terms = {"Kp": Kp} | ({"Ki": Ki} if Ki else {}) | ({"Kd": Kd, "filter": filter} if Kd else {})

    def matrices(v: Sequence[Any]) -> Matrices:
        term = dict(zip(terms, v, strict=True))
        A, B, C, D = [], [], [], term["Kp"]
        if Ki:
            A, B, C = [0], [1], [term["Ki"]]
        if Kd:
            rate = 1 / term["filter"]
            A, B, C, D = [*A, -rate], [*B, rate], [*C, -term["Kd"] * rate], D + term["Kd"] * rate
        n = len(A)
        return (
            ca.diag(ca.vertcat(*A)) if n else ca.DM(0, 0),
            ca.vertcat(*B) if n else ca.DM(0, 1),
            ca.horzcat(*C) if n else ca.DM(1, 0),
            D,
        )

    return Element(name, tuple(keep_sign(name, bounds, **terms)), matrices)


def lead(name: str, zero: float, pole: float, *, bounds: Bounds | None = None) -> Element:
    """A lead, (1 + s / zero) / (1 + s / pole), a lag where the pole is the slower one.

    name : of the element
    zero, pole : rad/s
    bounds : (low, high) of some of them

    Raises InputError for frequencies that are not above 0.

    >>> from malta import structured
    >>> structured.lead("phase", 100.0, 1000.0).system.D.item()
    10.0
    """
    _require_above_zero(name, zero=zero, pole=pole)

    def matrices(v: Sequence[Any]) -> Matrices:
        share = v[1] / v[0]
        return -v[1], v[1], 1 - share, share

    return Element(name, tuple(keep_sign(name, bounds, zero=zero, pole=pole)), matrices)


def notch(
    name: str, frequency: float, depth: float, damping: float, *, bounds: Bounds | None = None
) -> Element:
    """A notch, (s^2 + 2 depth w s + w^2) / (s^2 + 2 damping w s + w^2).

    name : of the element
    frequency : w, rad/s
    depth, damping : of its zeros and of its poles
    bounds : (low, high) of some of them

    Raises InputError for numbers that are not above 0.

    >>> from malta import structured
    >>> structured.notch("bending", 300.0, 0.1, 1.0).order
    2
    """
    _require_above_zero(name, frequency=frequency, depth=depth, damping=damping)

    def matrices(v: Sequence[Any]) -> Matrices:
        w, zeta, damped = v
        A = ca.blockcat([[0, w], [-w, -2 * damped * w]])
        return A, ca.vertcat(0, 1), ca.horzcat(0, 2 * (zeta - damped) * w), ca.DM(1)

    terms = {"frequency": frequency, "depth": depth, "damping": damping}
    return Element(name, tuple(keep_sign(name, bounds, **terms)), matrices)


def _require_above_zero(element: str, **values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0):
            raise InputError(CALLER, f"{element}.{name}", f"{value}", "a number above 0")


def transfer(name: str, numerator: Sequence[float], denominator: Sequence[float]) -> Element:
    """A proper transfer function of order n with free coefficients, the highest power first.

    name : of the element
    numerator, denominator : at which a search starts, with as many coefficients; each may change its sign

    Raises InputError for an improper one.

    >>> from malta import structured
    >>> structured.transfer("shape", [2.0, 100.0], [1.0, 50.0]).values
    {'shape.b1': 2.0, 'shape.b0': 100.0, 'shape.a0': 50.0}
    """
    given = (require_real(CALLER, name, one) for one in (denominator, numerator))
    a, b = (np.asarray(one, dtype=float) for one in given)
    n = len(a) - 1
    if n < 0 or not a[0] or len(b) > n + 1:
        found = f"{len(b)} over {len(a)} coefficients"
        raise InputError(CALLER, name, found, "a numerator of at most the denominator's order")
    b, a = np.append(np.zeros(n + 1 - len(b)), b) / a[0], a[1:] / a[0]
    k = np.arange(1, n + 1)
    rate = float((np.abs(a) ** (1 / k)).max(initial=0.0)) or 1.0
    size = float((np.abs(b) / rate ** np.arange(n + 1.0)).max()) or 1.0
    parameters = [Parameter(f"b{n - i}", float(b[i]), size * rate**i) for i in range(n + 1)]
    parameters += [Parameter(f"a{n - 1 - i}", float(a[i]), rate ** (i + 1.0)) for i in range(n)]

    def matrices(v: Sequence[Any]) -> Matrices:
        if not n:
            return ca.DM(0, 0), ca.DM(0, 1), ca.DM(1, 0), v[0]
        own = ca.horzcat(*(v[n + 1 + i] / rate ** (i + 0.0) for i in range(n)))
        A = ca.vertcat(-own, rate * ca.DM(np.eye(n - 1, n))) if n > 1 else -own
        out = [(v[1 + i] - v[0] * v[n + 1 + i]) / rate ** (i + 0.0) for i in range(n)]
        return A, ca.DM(np.eye(n, 1)), ca.horzcat(*out), v[0]

    return Element(name, tuple(parameters), matrices)


def states(name: str, start: Any, pattern: Any = None) -> Element:
    """A state-space system of the order of its start, from several errors to several forces.

    name : of the element
    start : continuous control.StateSpace, or A, B, C and D, at which a search starts
    pattern : four arrays of truth values, of entries of A, B, C and D that are searched; None: all

    Raises InputError for matrices that do not fit.

    >>> from malta import structured
    >>> element = structured.states("law", ([[-10.0]], [[1.0]], [[5.0]], [[2.0]]))
    >>> element.order, len(element.parameters)
    (1, 4)
    """
    given = (start.A, start.B, start.C, start.D) if hasattr(start, "A") else start
    parts = [np.atleast_2d(np.asarray(require_real(CALLER, name, M), dtype=float)) for M in given]
    shapes = [M.shape for M in parts]
    (n, _), (m, r) = shapes[0], shapes[3]
    if shapes != [(n, n), (n, r), (m, n), (m, r)] or not all(np.isfinite(M).all() for M in parts):
        raise InputError(CALLER, name, f"matrices of shapes {shapes}", "A, B, C and D that fit, of numbers")
    masks = (
        [np.ones(s, dtype=bool) for s in shapes]
        if pattern is None
        else [np.asarray(M, dtype=bool) for M in pattern]
    )
    if [M.shape for M in masks] != shapes:
        raise InputError(CALLER, f"{name}.pattern", "other shapes", f"those of A, B, C and D: {shapes}")
    parameters, places = [], []
    for letter, M, mask in zip("ABCD", parts, masks, strict=True):
        scale = float(np.abs(M).max(initial=0.0)) or 1.0
        for i, j in np.argwhere(mask).tolist():
            parameters.append(Parameter(f"{letter}{i}{j}", float(M[i, j]), scale))
            places.append(("ABCD".index(letter), i, j))
    if not parameters:
        raise InputError(CALLER, f"{name}.pattern", "nothing to search", "an entry at least")

    def matrices(v: Sequence[Any]) -> Matrices:
        made = [ca.SX(ca.DM(M)) for M in parts]
        for value, (which, i, j) in zip(v, places, strict=True):
            made[which][i, j] = value
        A, B, C, D = made
        return A, B, C, D

    return Element(name, tuple(parameters), matrices)


def observer(name: str, model: Any, K: Any, L: Any) -> Element:
    """State feedback of an observer, as an LQG has it, whose gains are tuned: the order is that of the model.

    xi' = (A - B K - L C) xi + L e,   v = K xi        xi: minus the observed states, since e = -y at rest

    A model of lower order than the plant gives a reduced observer.

    name : of the element
    model : continuous control.StateSpace without D, or A, B and C; n states, m inputs, p outputs
    K : m x n, regulator at which a search starts
    L : n x p, observer

    Raises InputError for matrices that do not fit.

    >>> from malta import structured
    >>> body = [[0, 1], [100, 0]], [[0], [1]], [[1, 0]]
    >>> law = structured.observer("lqg", body, [[300, 20]], [[80], [3000]])
    >>> law.order, len(law.parameters), law.system.C.tolist()
    (2, 4, [[300.0, 20.0]])
    """
    given = (model.A, model.B, model.C) if hasattr(model, "A") else model
    read = (require_real(CALLER, name, M) for M in (*given, K, L))
    A, B, C, K, L = (np.atleast_2d(np.asarray(M, dtype=float)) for M in read)
    (n, m), p = B.shape, len(C)
    shapes = [M.shape for M in (A, C, K, L)]
    if shapes != [(n, n), (p, n), (m, n), (n, p)] or not all(np.isfinite(M).all() for M in (A, B, C, K, L)):
        raise InputError(CALLER, name, f"A, C, K and L of shapes {shapes}", "matrices that fit, of numbers")

    parameters = [
        Parameter(
            f"{letter}{i}{j}", float(M[i, j]), float(np.abs(M[i] if letter == "K" else M[:, j]).max()) or 1.0
        )
        for letter, M in (("K", K), ("L", L))
        for i, j in np.ndindex(*M.shape)
    ]

    def matrices(v: Sequence[Any]) -> Matrices:
        k = ca.vertcat(*(ca.horzcat(*v[i * n : (i + 1) * n]) for i in range(m)))
        rest = v[m * n :]
        gain = ca.vertcat(*(ca.horzcat(*rest[i * p : (i + 1) * p]) for i in range(n)))
        return ca.DM(A) - ca.DM(B) @ k - gain @ ca.DM(C), gain, k, ca.DM(m, p)

    return Element(name, tuple(parameters), matrices)
