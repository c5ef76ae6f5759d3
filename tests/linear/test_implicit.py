"""Roots of equations over balls of parameters: against closed forms and Brent's method, and where there is none."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from flint import acb, acb_mat, arb, ctx
from hypothesis import given, settings, strategies as st
from scipy.optimize import brentq

from malta.linear.balls import BALLS, POINTS, enclosed_root
from malta.linear.branches import INTERVALS, Interval
from malta.linear.expressions import ANALYTIC, MatrixProgram, NotAnalytic, program
from malta.linear.implicit import ImplicitRoot
from malta.linear.roots import call, implicit_function

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


@pytest.fixture(autouse=True)
def _digits() -> Iterator[None]:
    before, ctx.prec = ctx.prec, 128
    yield
    ctx.prec = before


def root_program(
    rows: Callable[[Any, Any], Any], nominal: list[float], near: list[float]
) -> tuple[ca.Function, MatrixProgram]:
    """The root of equations as a function of parameters, and its program."""
    p, r = ca.SX.sym("p", len(nominal)), ca.SX.sym("r", len(near))
    root = implicit_function(rows(p, r), p, r, np.array(nominal), np.array(near))
    function = ca.Function("root_of", [p], [call(root, p)])
    return function, program(function)


def square(p: Any, r: Any) -> Any:
    return r**2 - p


def complex_square(p: Any, r: Any) -> Any:
    """(r_1 + j r_2)^2 = p_1 + j p_2, which has two roots that change places around p = 0."""
    return ca.vertcat(r[0] ** 2 - r[1] ** 2 - p[0], 2 * r[0] * r[1] - p[1])


def on_interval(model: MatrixProgram, *sides: tuple[float, float]) -> list[Interval]:
    (entries,) = model.run([Interval(*side) for side in sides], INTERVALS)
    return [x for *_, x in entries]


@pytest.mark.parametrize("bits", [53, 128, 700])
def test_a_square_root_at_points_has_all_digits(bits: int) -> None:
    _, model = root_program(square, [1.0], [1.0])
    ctx.prec = bits
    for p in (0.001, 0.3, 1.0, 7.0):
        (((*_, found),),) = model.run([arb(p)], POINTS)
        assert abs(found - arb(p).sqrt()) < arb(2) ** (16 - bits)
        assert found.rel_accuracy_bits() > bits - 16


def test_a_square_root_over_discs_is_that_of_each_point() -> None:
    _, model = root_program(square, [1.0], [1.0])
    (((*_, found),),) = model.run([acb(arb(1.5, 0.4), arb(0, 0.4))], BALLS)
    for angle in np.linspace(0, 2 * np.pi, 17):
        z = acb(1.5 + 0.39 * np.cos(angle), 0.39 * np.sin(angle))
        assert found.contains(z.sqrt())
    for corner in (1.1 + 0.4j, 1.1 - 0.4j, 1.9 + 0.4j, 1.9 - 0.4j):  # of the rectangle that the ball is
        assert found.contains(acb(corner).sqrt())
    assert float(abs(found - acb(1.5).sqrt()).upper()) < 0.5


def test_no_function_where_two_roots_meet() -> None:
    """At zero and below, and over a disc about zero, where the square root is none."""
    function, model = root_program(square, [1.0], [1.0])
    for side in ((-0.1, 0.1), (-0.3, -0.2), (0.0, 2.0)):
        with pytest.raises(NotAnalytic, match="root of equations"):
            on_interval(model, side)
    with pytest.raises(NotAnalytic, match="root of equations"):
        model.run([acb(arb(0.2, 0.3), arb(0, 0.3))], BALLS)
    with pytest.raises(NotAnalytic, match="root of equations"):  # on one side of it, off the real axis
        model.run([acb(-0.2, 0.2)], BALLS)
    assert np.isnan(float(function(-0.2)))
    assert float(function(0.04)) == pytest.approx(0.2, rel=1e-9)


def test_one_branch_on_either_side_of_what_is_no_rest() -> None:
    """Around p = 0 two roots change places: on all lines from p = 1 it is the principal one, and none beyond zero."""
    _, model = root_program(complex_square, [1.0, 0.0], [1.0, 0.0])
    for sign in (1, -1):
        real, imaginary = on_interval(model, (-0.6, -0.5), (0.55 * sign - 0.05, 0.55 * sign + 0.05))
        exact = np.sqrt(-0.55 + 0.55j * sign)
        assert real.low <= exact.real <= real.high
        assert imaginary.low <= exact.imag <= imaginary.high
        assert real.high - real.low < 0.2
    with pytest.raises(NotAnalytic, match="root of equations"):
        on_interval(model, (-0.6, -0.5), (-0.05, 0.05))


def test_a_line_beside_what_is_no_rest_is_not_all_lines() -> None:
    """The line to the middle of a ball passes p = 0, lines to its points do not: one root, and no one function."""
    function, model = root_program(complex_square, [1.0, 0.0], [1.0, 0.0])
    root = another_search(model, lambda p: np.array(function(p)).ravel())
    P = [acb(arb(-0.55, 0.05)), acb(arb(0.1, 0.15))]
    found = root.enclose(P)
    assert found is not None
    assert found[0].contains(np.sqrt(-0.55 + 0.1j).real)
    assert root.enclose(P, is_one=False) is None


def another_search(model: MatrixProgram, search: Callable[[Any], Any]) -> ImplicitRoot:
    """The root in a program without what is known of it, which another search looks for."""
    (*_, entry) = next(step for step in model.steps if step[0] == "root")
    return replace(enclosed_root(entry.function), root=search, known=[], along=[], last={})


def signed_root(sign: int, p: Any) -> Any:
    return sign * np.sqrt(p)


def test_a_root_that_a_search_mistakes_is_no_enclosure() -> None:
    """Newton's method from the other root finds the other root: where it is not that of nominal p, there is none."""
    _, model = root_program(square, [1.0], [1.0])
    for sign in (1, -1):
        for is_one in (True, False):
            root = another_search(model, partial(signed_root, sign))
            for ball in (acb(3.0), acb(arb(3.0, 0.2)), acb(arb(3.0, 0.1), arb(0, 0.1 * is_one))):
                found = root.enclose([ball], is_one=is_one)
                assert (found is not None) == (sign > 0)
                assert found is None or found[0].contains(acb(3.0).sqrt())


def test_the_radius_of_a_root_covers_what_the_slope_leaves_open() -> None:
    """F = 0.1 in the middle, where F' = 1, and F' from 0.6 to 1.4 about it: the root is up to 0.1 / 0.6 away."""

    def equations(_: Any, r: Any) -> Any:
        wide = r[0].real.rad() > 0
        return acb_mat([[0.1]]), acb_mat([[acb(arb(1, 0.4 if wide else 0))]]), acb_mat([[0]])

    root = ImplicitRoot(equations, np.zeros_like, np.zeros(1), np.zeros(1))
    assert root.start is not None
    assert 0.1 / 0.6 <= float(root.start.most[0]) < 0.3


@settings(max_examples=40, deadline=None)
@given(st.floats(0.2, 4.0), st.floats(-3.0, 3.0), st.floats(0.0, 0.2))
def test_a_root_is_that_of_brents_method(a: float, b: float, width: float) -> None:
    """a tanh(r) + r^3 / 10 + r = b has one root, which grows with b: over a ball it is between those at the ends."""
    _, model = root_program(lambda p, r: p[0] * ca.tanh(r) + 0.1 * r**3 + r - p[1], [1.0, 0.5], [0.25])

    def exact(at: float) -> float:
        return float(brentq(lambda r: a * np.tanh(r) + 0.1 * r**3 + r - at, -9, 9, xtol=1e-14))

    (((*_, found),),) = model.run([arb(a), arb(b)], POINTS)
    assert abs(float(found.mid()) - exact(b)) < 1e-12
    (over,) = on_interval(model, (a, a), (b - width, b + width))
    assert over.low - 1e-12 <= exact(b - width) <= exact(b + width) <= over.high + 1e-12
    assert over.high - over.low <= 2 * width + 1e-12 + 2 * width**2


def test_a_root_of_a_root_and_its_copy() -> None:
    """p^(1/4) by two equations, also where the function was copied."""
    p, r = ca.SX.sym("p"), ca.SX.sym("r")
    root = implicit_function(square(p, r), p, r, np.array([1.0]), np.array([1.0]))
    function = ca.Function("twice", [p], [call(root, call(root, p))])
    for one in (function, pickle.loads(pickle.dumps(function))):
        (((*_, found),),) = program(one).run([arb(0.5)], POINTS)
        assert abs(float(found.mid()) - 0.5**0.25) < 1e-15
        assert [step[0] for step in program(one).steps].count("root") == 2


def test_the_slope_of_a_root_is_no_enclosure() -> None:
    """What CasADi derives of a root calls functions that no enclosure knows: they are foreign, and refused."""
    p = ca.SX.sym("p")
    function, _ = root_program(square, [1.0], [1.0])
    slope = ca.Function("slope", [p], [ca.jacobian(function(p), p)])
    assert float(slope(4.0)) == pytest.approx(0.25, rel=1e-9)
    assert program(slope).foreign == ("call",)
    for backwards in (True, False):
        wanted = ca.jtimes(function(p), p, ca.SX(1), backwards)
        both = program(ca.Function("both", [p], [function(p), wanted]))
        assert (both.foreign, both.implicit) == (("call",), True)
        ((*_, value),) = both.only((0,)).run([arb(4.0)], POINTS)[0]
        assert value.contains(2)


def test_what_counts_as_analytic_is_what_balls_enclose() -> None:
    """A name without an enclosure would be "nothing proven" late; an enclosure without a name would never be used."""
    assert sorted(ANALYTIC) == sorted({*BALLS.others} - {"root"}) == sorted({*POINTS.others} - {"root"})
