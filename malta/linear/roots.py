"""Functions r(p) that equations F(p, r) = 0 define, as CasADi calls them; implicit.py encloses them.

r(p) is the root that is reached from a known one, r(p_0), along the straight line from p_0 to p.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray

PREFIX = "root_"  # of the names of these functions
EQUATIONS = "equations"
STAGES = 4  # parts of the line to p
STEPS, LAST_STEPS = 2, 8  # of Newton's method, in each of them and at the end
STILL_SHARE = 1e-5  # of the unknowns: a last step below this is one that found a root


def implicit_function(rows: Any, p: Any, r: Any, nominal: FloatArray, near: FloatArray) -> ca.Function:
    """The function p -> r with rows(p, r) = 0 that is `near` at nominal p; not a number where no root is found.

    A second output at further arguments s, rows(p, s), carries what `root_equations` reads.
    """
    k = r.numel()
    rows, s, key = ca.densify(rows), ca.SX.sym("s", k), ca.SX.sym("key")
    slope = ca.densify(ca.jacobian(rows, r))
    step = ca.Function("step", [p, r], [ca.cse(ca.solve(slope, rows))])
    p0, found, change = ca.SX(ca.DM(nominal)), ca.SX(ca.DM(near)), ca.SX.zeros(k)
    for stage in range(1, STAGES + 1):
        q = p0 + (p - p0) * (stage / STAGES)
        for _ in range(STEPS + LAST_STEPS * (stage == STAGES)):
            change = step(q, found)
            found = found - change
    size = ca.fabs(found) + np.abs(near) + 1e-3 * np.abs(near).max(initial=0.0)
    still = ca.logic_all(ca.fabs(change) <= STILL_SHARE * size + 1e-12)
    value = found + ca.if_else(still, 0.0, ca.SX.nan())
    outputs = [rows, slope, ca.densify(ca.jacobian(rows, p)), ca.SX(ca.DM(nominal)), ca.SX(ca.DM(near))]
    of = ca.Function(EQUATIONS, [ca.vertcat(p, r)], outputs, {"never_inline": True})
    number = int.from_bytes(hashlib.sha256(of.serialize().encode()).digest()[:6], "big")
    left = of(ca.vertcat(p, s))[0]
    return ca.Function(root_name(number), [p, key, s], [value, left], {"never_inline": True})


def root_name(number: float) -> str:
    return f"{PREFIX}{number:.0f}"


def call(root: ca.Function, p: Any) -> Any:
    """The root at p. Its own number is among the arguments: of a call in a program no more is known than these."""
    key = float(root.name().removeprefix(PREFIX))
    return root(p, key, ca.SX.zeros(root.numel_in(2)))[0]


def root_value(root: ca.Function, p: FloatArray) -> FloatArray:
    """The root at numbers p; not a number where none is found."""
    return np.array(root(p, 0.0, np.zeros(root.numel_in(2)))[0]).ravel()


def root_equations(root: ca.Function) -> tuple[ca.Function, FloatArray, FloatArray]:
    """F, F_r and F_p as a function of (p; r), the nominal p, and r there."""
    of = root.get_function(EQUATIONS)
    *_, nominal, near = of(ca.DM.zeros(of.numel_in(0)))
    return of, np.array(nominal).ravel(), np.array(near).ravel()


class RootEntry(NamedTuple):
    """An entry of the root that a call asks for."""

    function: ca.Function
    place: int  # among the entries

    def at_symbols(self, p: Sequence[Any]) -> Any:
        """Its expression at expressions of p."""
        return call(self.function, ca.vertcat(*p))[self.place]
