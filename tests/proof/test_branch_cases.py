"""Margins of matrices with branches, and of functions whose enclosures reach beyond 1.

x'' = g(p) x - x' + u, u = -3 x: stable while g(p) < 3.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.linear.branches import MAX_CASES, branch_cases
from malta.linear.closed_loops import instability
from malta.linear.compensators import compensator_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.linear.uncertain import UncertainSystem

LAW = [[-3.0]]


def column(g: Callable[[Any], Any], nominal: float) -> UncertainSystem:
    return malta.uncertain(lambda k: ([[0, 1], [g(k), -1]], [[0], [1]], [[1, 0]]), {"k": nominal})


SMOOTH = {  # g, nominal k, k at which g is 3
    "an inverse tangent far from 0": (lambda k: 2 * ca.atan(k - 8), 10.0, 8 + math.tan(1.5)),
    "an inverse sine": (lambda k: 4 * ca.asin(k), 0.5, math.sin(0.75)),
    "an inverse cosine": (lambda k: 2 * ca.acos(k), 0.5, math.cos(1.5)),
    "an inverse hyperbolic sine": (lambda k: ca.asinh(2 * k), 3.0, math.sinh(3) / 2),
    "an inverse hyperbolic cosine": (lambda k: 2 * ca.acosh(k), 2.0, math.cosh(1.5)),
    "an inverse hyperbolic tangent": (lambda k: 3 * ca.atanh(k), 0.5, math.tanh(1)),
    "an error function": (lambda k: 3.1 * ca.erf(k), 1.0, 1.514054),
    "an angle": (lambda k: 2 * ca.atan2(k, k - 2), 3.0, None),
}


@pytest.mark.parametrize("name", list(SMOOTH))
def test_a_function_is_enclosed_wherever_it_is_analytic(name: str) -> None:
    g, nominal, end = SMOOTH[name]
    found = malta.robust_margin(column(g, nominal), LAW, {"k": 0.2})
    if end is None:  # tan 1.5 (k - 2) = k
        end = 2 * math.tan(1.5) / (math.tan(1.5) - 1)
    assert found.lower is not None
    assert found.lower <= found.upper == pytest.approx(abs(end / nominal - 1) / 0.2, rel=1e-3)
    assert found.lower >= (1 - 2e-3) * found.upper
    assert found.witness is not None
    assert found.witness["k"] == pytest.approx(end, rel=1e-3)


@pytest.mark.parametrize(
    ("g", "nominal", "end"),
    [
        (lambda k: 3 * ca.fabs(k - 2.5), 3.0, 3.5),
        (lambda k: 3 * ca.fabs(k - 2.5), 2.4, 1.5),
        (lambda k: 3 * ca.fabs(k - 2.5), 2.5, 3.5),  # on the switch
        (
            lambda k: ca.if_else(k > 3.05, 3.05 + 2 * (k - 3.05), 3.05 * (k / 3.05) ** 2),
            2.8,
            3.05 * math.sqrt(3 / 3.05),
        ),
        (lambda k: ca.fmax(ca.fmin(k, 2.0), 2 * k - 5), 2.5, 4.0),
        (
            lambda k: ca.if_else(ca.logic_and(k <= 1.5, k >= 1.0), k, 4.0),
            1.3,
            1.5,
        ),  # a step to where it is unstable
    ],
)
def test_a_loop_with_branches_is_lost_where_its_own_branch_is(
    g: Callable[[Any], Any], nominal: float, end: float
) -> None:
    found = malta.robust_margin(column(g, nominal), LAW, {"k": 0.2})
    assert found.lower is not None
    assert found.lower <= found.upper == pytest.approx(abs(end - nominal) / (0.2 * nominal), rel=1e-5)
    assert found.lower >= (1 - 1e-3) * found.upper
    assert found.certificate == ()


def test_what_another_branch_loses_is_not_lost() -> None:
    """Above 1.5 the branch k would be unstable at 3, where 1 acts: never lost."""
    found = malta.robust_margin(column(lambda k: ca.if_else(k < 1.5, k, 1.0), 1.3), LAW, {"k": 0.2})
    assert found.exhausted
    assert found.lower is not None
    assert found.lower >= 99


def test_a_parameter_that_no_branch_has_is_named() -> None:
    system = malta.uncertain(
        lambda k, q: ([[0, 1], [3 * ca.fabs(k - 2.5), -1 + 0 * q]], [[0], [1]], [[1, 0]]),
        {"k": 3.0, "q": 1.0},
    )
    found = malta.robust_margin(system, LAW, {"k": 0.2, "q": 0.2})
    assert found.idle == ("q",)
    assert found.lower == pytest.approx(0.5 / 0.6, rel=1e-3)


def test_an_unstable_loop_with_branches_is_that() -> None:
    found = malta.robust_margin(column(lambda k: 4 + ca.fabs(k), 1.0), LAW, {"k": 0.2})
    assert (found.lower, found.upper, found.reason) == (0.0, 0.0, "the nominal loop is unstable")


def test_branches_without_cases_prove_nothing() -> None:
    """A sign is zero at zero, a floor has any number of branches; and ten switches have too many cases."""
    for g in (lambda k: 2 + ca.sign(k - 2), ca.floor):
        found = malta.robust_margin(column(g, 1.3), LAW, {"k": 0.2})
        assert (found.lower, "no enclosure" in found.reason) == (None, True)
    k = ca.SX.sym("k")
    many = sum((ca.fabs(k - i) for i in range(10)), ca.SX(0))
    assert branch_cases(ca.Function("many", [k], [many])) == []
    assert len(branch_cases(ca.Function("few", [k], [ca.fabs(k) + ca.fmax(k, 1)]))) == 4 <= MAX_CASES


def piecewise(rng: np.random.Generator, p: Any, q: Any, depth: int) -> Any:
    """A random expression of two parameters with branches."""
    kind = rng.integers(0, 7)
    if depth == 0 or kind == 0:
        a, b, c = rng.uniform(-1, 1, 3).tolist()
        return a * p + b * q + c
    one, two = (piecewise(rng, p, q, depth - 1) for _ in range(2))
    share = float(rng.uniform(0.5, 1.5))
    return {
        1: lambda: ca.fabs(one),
        2: lambda: ca.fmax(one, two),
        3: lambda: ca.fmin(one, two),
        4: lambda: ca.if_else(one < two, share * one, two),
        5: lambda: one * two,
        6: lambda: ca.if_else(ca.logic_or(one <= 0.2, two > 0.4), one, share * two),
    }[int(kind)]()


@pytest.mark.slow
def test_no_machine_of_a_proven_box_with_branches_is_unstable() -> None:
    """Random matrices of two parameters: 3000 points of each proven box; and the witness is lost."""
    rng, proven, closed = np.random.default_rng(7), 0, 0
    law = compensator_of(LAW, 1, 1)
    for _ in range(8):

        def matrices(p: Any, q: Any) -> Any:
            g, h = piecewise(rng, p, q, 2), piecewise(rng, p, q, 1)
            return [[0, 1], [g, -1.2 + 0.3 * h / (1 + h**2)]], [[0], [1]], [[1, 0]]

        system = malta.uncertain(matrices, {"p": rng.uniform(0.5, 1.5), "q": rng.uniform(-1.5, -0.5)})
        found = malta.robust_margin(system, LAW, {"p": 0.3, "q": 0.3}, budget=malta.proof.Budget(work=8))
        if not found.lower:
            continue
        proven += 1
        shares = rng.uniform(-1, 1, (3000, 2))
        shares[::3] = np.sign(shares[::3])
        p = system.nominal + 0.999 * min(found.lower, 100.0) * 0.3 * np.abs(system.nominal) * shares
        assert instability(system, law, p).max() < 0
        if found.witness is not None:
            w = np.array([found.witness[name] for name in system.names])
            beyond = system.nominal + 1.001 * (w - system.nominal)
            assert instability(system, law, np.array([w, beyond])).max() > -1e-6
            closed += found.lower > 0.99 * found.upper
    assert proven >= 4
    assert closed >= 1
