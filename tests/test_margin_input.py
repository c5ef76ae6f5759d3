"""What margins are asked of: systems that overflow are answered, input that is none is one clear sentence."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest

import malta
from malta.errors import InputError
from malta.margins.expressions import program
from malta.margins.problem import OfCoefficients, OfPolynomial
from malta.uncertain import UncertainSystem

LAG = control.ss([[-1.0]], [[1.0]], [[-1.0]], [[0.0]])


@pytest.fixture(autouse=True)
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def motor(**options: Any) -> UncertainSystem:
    """k / (s + 1)."""
    return malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0}, **options)


@pytest.mark.parametrize("f", [ca.exp, ca.sin, ca.cosh])
@pytest.mark.parametrize("sign", [-1, 1])
def test_functions_that_overflow_far_from_the_axis_are_enclosed_on_smaller_discs(f: Any, sign: int) -> None:
    """-1 - f(k) / 2 < 0 as far as is looked, sin as well as the others for a positive f(k)."""
    system = malta.uncertain(lambda k: ([[-1.0]], [[f(sign * k)]], [[1.0]]), {"k": 1.0})
    assert malta.robust_margin(system, [[-0.5]], {"k": 0.3}).lower == pytest.approx(100)


def test_an_exponential_in_the_input_loses_stability_where_it_does() -> None:
    """-1 + e^-k / 2 = 0 at k = -ln 2: 1 + ln 2 below the nominal value."""
    system = malta.uncertain(lambda k: ([[-1.0]], [[ca.exp(-k)]], [[1.0]]), {"k": 1.0})
    m = malta.robust_margin(system, [[0.5]], {"k": 0.3})
    assert m.lower is not None
    assert m.lower <= (1 + math.log(2)) / 0.3 <= m.upper * (1 + 1e-12)
    assert m.lower == pytest.approx(m.upper, rel=1e-3)


@pytest.mark.parametrize("law", [LAG, [[-1.0]]], ids=["a law with states", "a gain"])
@pytest.mark.parametrize("f", [ca.sin, ca.exp])
def test_functions_in_the_direct_feedthrough_are_enclosed(f: Any, law: Any) -> None:
    system = malta.uncertain(lambda k: ([[-1.0]], [[1.0]], [[1.0]], [[0.1 * f(k)]]), {"k": 1.0})
    m = malta.robust_margin(system, law, {"k": 0.3})
    assert m.lower is not None
    assert m.lower > 4


def test_a_loop_without_states_is_no_loop() -> None:
    none = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0))
    static = malta.uncertain(lambda k: (*none, [[k]]), {"k": 1})
    algebraic = malta.uncertain(lambda k: ([[-k]], [[1.0]], [[1.0]], [[0.0]], [[0.0]]), {"k": 1})
    for system in (static, algebraic):
        with pytest.raises(InputError, match="uncertain: A: found no states but algebraic ones"):
            malta.robust_margin(system, [[-0.5]], {"k": 0.1})
    # x' = -x + k u, u = -x
    assert malta.robust_margin(static, LAG, {"k": 0.1}).lower == pytest.approx(20, rel=1e-3)


@pytest.mark.parametrize("value", [1e308, (-1e308, 1e308), (1.0, 1e308), (-1e308, 1.7e308), 1e151])
def test_ranges_that_overflow_are_refused(value: Any) -> None:
    says = r"k: found .*, expected values between -1e\+150 and 1e\+150"
    with pytest.raises(InputError, match=says):
        malta.robust_margin(motor(), [[-2.0]], {"k": value})
    with pytest.raises(InputError, match=says):
        malta.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k], {"k": value}, {"k": 1})


@pytest.mark.parametrize("power", [1, 2, 3, 5])
@pytest.mark.parametrize("decades", [20, 100, 150])
def test_numbers_that_overflow_prove_nothing(decades: int, power: int) -> None:
    """(s + 1)^3 + k^n is unstable beyond k^n = 8."""
    R = 10.0**decades
    m = malta.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k**power], {"k": (-R, R)}, {"k": 0.0}, time=2)
    assert m.lower is None or m.lower * R <= 8 ** (1 / power) * (1 + 1e-9)
    system = malta.uncertain(lambda k: ([[-1.0, 0], [0, -2]], [[k**power], [1]], [[1.0, 1]]), {"k": 0.0})
    m = malta.robust_margin(system, [[-2.0]], {"k": (-R, R)}, time=2)
    assert m.lower is None or m.lower * R <= 8


def test_what_overflows_at_the_ends_of_an_interval_is_not_proven() -> None:
    system = malta.uncertain(lambda k, c: ([[-1.0 - c**3]], [[k]], [[1.0]]), {"k": 1.0, "c": 1.0})
    assert malta.robust_margin(system, [[-2.0]], {"k": 0.1}, {"c": (0.5, 1e120)}, time=2).upper > 0


def test_roots_of_coefficients_beyond_floating_point() -> None:
    p = ca.SX.sym("p")
    f = ca.Function("f", [p], [ca.vertcat(p**3, p**3, p**3)])
    problem = OfPolynomial(OfCoefficients(program(f), ("p",), False))
    assert problem.instability(np.array([[1e120]]))[0] == pytest.approx(-0.5)
    assert problem.instability(np.array([[0.0]]))[0] > 0  # nothing is left of it
