"""Functions of basic operations: their errors, and the same bits by CasADi, by Python and in C."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st

import malta
from malta.firmware.program import Precision, Program, build_program, evaluate, lower

X, Y = ca.SX.sym("x"), ca.SX.sym("y")
ALL = ca.Function(
    "f", [X, Y], [ca.vertcat(ca.sin(X), ca.cos(X), ca.exp(X), ca.atan2(Y, X))], ["x", "y"], ["r"]
)
BOUNDS = {"double": (2.3e-16, 2.3e-16, 2.5e-16, 4.5e-16), "float": (1.2e-7, 1.4e-7, 1.3e-7, 2.5e-7)}
FARTHEST = {"double": 1e5, "float": 1e3}


def program(f: ca.Function, precision: Precision) -> Program:
    return build_program(lower(f, precision))


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["double", "float"])
def test_errors_of_elementary_functions(precision: Precision) -> None:
    """Against extended precision, over the documented domains: as the module's table says."""
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("no extended precision on this processor")
    rng, p, worst = np.random.default_rng(1), program(ALL, precision), np.zeros(4)
    for k in range(2000):
        largest = FARTHEST[precision] if k % 2 else 80.0
        x = float(np.float32(rng.choice([-1, 1]) * 10 ** rng.uniform(-6, math.log10(largest))))
        y = float(np.float32(rng.normal() * 10 ** rng.uniform(-3, 3)))
        found = evaluate(p, {"x": x, "y": y}, precision)["r"].astype(np.longdouble)
        a, b, end = np.longdouble(x), np.longdouble(y), np.longdouble(np.clip(x, -87, 87))
        exact = np.array([np.sin(a), np.cos(a), np.exp(end), np.arctan2(b, a)])
        scale = np.array([1, 1, np.exp(end), 1])
        worst = np.maximum(worst, (np.abs(found - exact) / scale).astype(float))
    assert (worst < BOUNDS[precision]).all(), worst
    assert (worst > 0.2 * np.array(BOUNDS[precision])).all(), "the table can promise more"


INVERSES: dict[
    str, tuple[Any, Any, Any]
] = {  # of sines and exponentials: the function, numpy's, and where it is defined
    "log": (ca.log, np.log, lambda x: 10.0 ** (12 * x)),
    "log1p": (ca.log1p, np.log1p, lambda x: 0.9 * x**3),
    "asinh": (ca.asinh, np.arcsinh, lambda x: 1e6 * x**9),
    "acosh": (ca.acosh, np.arccosh, lambda x: 1 + 1e3 * x**6),
    "atanh": (ca.atanh, np.arctanh, lambda x: 0.999 * x**3),
    "asin": (ca.asin, np.arcsin, lambda x: x),
    "acos": (ca.acos, np.arccos, lambda x: x),
}


@pytest.mark.parametrize("name", INVERSES)
def test_errors_of_inverse_functions(name: str) -> None:
    """Against extended precision: within some roundings of the value, small values included."""
    if np.finfo(np.longdouble).eps > 1e-18:
        pytest.skip("no extended precision on this processor")
    own, exact, argument = INVERSES[name]
    p = program(ca.Function("f", [X], [own(X)], ["x"], ["r"]), "double")
    for share in np.random.default_rng(2).uniform(-1, 1, 500):
        x = float(argument(share))
        found, true = evaluate(p, {"x": x}, "double")["r"][0], exact(np.longdouble(x))
        assert abs(found - true) <= 2e-15 * abs(true) + 1e-300, (x, found, true)


@pytest.mark.slow
@given(st.floats(-1e5, 1e5), st.floats(-1e3, 1e3))
def test_casadi_computes_the_same_bits(x: float, y: float) -> None:
    f = lower(ALL, "double")
    assert np.array_equal(
        np.array(f(x, y)).ravel(), evaluate(build_program(f), {"x": x, "y": y}, "double")["r"]
    )


def test_sines_of_shifted_angles_are_two_evaluations() -> None:
    """Three phases cost two sines and products; the values are those of three sines."""
    phases = ca.Function(
        "p", [X], [ca.vertcat(*(ca.cos(X - 2 * math.pi / 3 * k) for k in range(3)))], ["x"], ["r"]
    )
    one = program(ca.Function("s", [X], [ca.sin(X)], ["x"], ["r"]), "double").statements
    p = program(phases, "double")
    assert p.statements < 2.2 * one + 8
    for x in (-3.0, 0.1, 1.2):
        expected = np.cos(x - 2 * np.pi / 3 * np.arange(3))
        assert np.abs(evaluate(p, {"x": x}, "double")["r"] - expected).max() < 2e-15


def test_other_operations_are_rewritten() -> None:
    rows = ca.vertcat(ca.floor(X), ca.ceil(X), ca.sign(X), ca.tanh(X), X**3, X**-2, ca.tan(X), ca.cosh(X))
    p = program(ca.Function("f", [X], [rows], ["x"], ["r"]), "double")
    for x in (-2.5, -1.0, 0.3, 2.0, 1.5):
        expected = [
            math.floor(x),
            math.ceil(x),
            np.sign(x),
            math.tanh(x),
            x**3,
            x**-2,
            math.tan(x),
            math.cosh(x),
        ]
        assert evaluate(p, {"x": x}, "double")["r"] == pytest.approx(expected, rel=1e-14)


@pytest.mark.parametrize(
    ("expression", "named"),
    [(ca.erf(X), "ERF"), (X**0.3, "powers"), (X / 0 + ca.inf, "inf"), (ca.expm1(X), "EXPM1")],
)
def test_what_has_no_form_is_named(expression: ca.SX, named: str) -> None:
    with pytest.raises(malta.CheckError, match=named):
        program(ca.Function("f", [X], [expression], ["x"], ["r"]), "double")


def test_nothing_is_cancelled_that_rounding_needs() -> None:
    """The rounded number of a large argument, and simplification as it was before."""
    before = ca.GlobalOptions.getSimplificationOnTheFly()
    f = lower(ca.Function("f", [X], [ca.floor(X)], ["x"], ["r"]), "double")
    assert float(f(2.0**40 + 0.75)) == 2.0**40
    assert ca.GlobalOptions.getSimplificationOnTheFly() == before
