"""Polynomials of many parameters by multipliers: a loop that has the polynomial, in which parameters enter linearly."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest
from flint import fmpq

import malta
from malta.proof.groups import groups
from malta.proof.multipliers.pencil import Rows
from malta.proof.problem import MAX_SIGNALS, companion

NAMES = tuple(f"q{i}" for i in range(14))


def terms(count: int, degree: int, seed: int) -> list[dict[tuple[int, ...], Any]]:
    """Of each power of s or z the terms of its coefficient: constants, parameters, some products and squares."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(degree + 1):
        own = {(0,) * count: fmpq(int(rng.integers(50, 99)), 7)}
        for e in np.eye(count, dtype=int):
            own[tuple(e.tolist())] = fmpq(int(rng.integers(-9, 9)), 3)
        for i, j in ((0, 1), (1, 1), (0, count - 1)):
            e = np.zeros(count, dtype=int)
            e[i] += 1
            e[j] += 1
            own[tuple(e.tolist())] = fmpq(int(rng.integers(-9, 9)), 11)
        e = np.zeros(count, dtype=int)
        e[:3] = 1, 2, 1
        own[tuple(e.tolist())] = fmpq(1, 3)
        found.append(own)
    return found


def value(coefficient: dict[tuple[int, ...], Any], p: Any) -> float:
    return sum(float(int(c.p) / int(c.q)) * float(np.prod(p ** np.array(e))) for e, c in coefficient.items())


@pytest.mark.parametrize("T", [None, 1.0])
def test_its_determinant_is_the_polynomial(T: float | None) -> None:
    a = terms(4, 3, 5)
    loop = companion(NAMES[:4], a, T)
    assert loop is not None
    (group,) = groups(loop)
    rows, rng = Rows(loop, group), np.random.default_rng(6)
    ratios = []
    for _ in range(5):
        p = rng.uniform(-1, 1, 4)
        pencil = rows.over(np.column_stack([p, p]))
        assert pencil is not None
        coefficients = [value(c, p) for c in a]
        for _ in range(3):
            v = complex(*rng.uniform(-2, 2, 2))
            found = np.linalg.det(pencil.constant.middle + v * pencil.linear.middle)
            z = v if T is None else (1 + v) / (1 - v)
            scale = 1 if T is None else (1 - v) ** 3
            ratios.append(found / (scale * sum(c * z**k for k, c in enumerate(coefficients))))
    assert ratios == pytest.approx([ratios[0]] * len(ratios), rel=1e-9)


def test_pencils_hold_the_polynomial_all_over_their_box() -> None:
    loop = companion(NAMES[:4], terms(4, 3, 5), None)
    assert loop is not None
    rows, rng = Rows(loop, groups(loop)[0]), np.random.default_rng(1)
    sides = np.array([[-0.5, 0.7], [0.2, 0.9], [-1, 1], [0, 0.1]])
    whole = rows.over(sides)
    assert whole is not None
    assert whole.constant.rest.max() < 1e-12 * whole.constant.size.max()  # nothing is left out
    for delta in rng.uniform(-1, 1, (20, 4)):
        p = sides.mean(axis=1) + delta * (sides[:, 1] - sides[:, 0]) / 2
        point = rows.over(np.column_stack([p, p]))
        assert point is not None
        moved = whole.constant.middle + np.tensordot(delta, whole.constant.slopes, 1)
        assert (np.abs(moved - point.constant.middle) <= whole.constant.rest + point.constant.rest).all()


def test_dense_products_have_no_short_loop() -> None:
    count = 7
    every = {tuple(int(x) for x in np.binary_repr(k, count)): fmpq(1, 3) for k in range(2**count)}
    assert 2**count > MAX_SIGNALS
    assert companion(NAMES[:count], [every, every], None) is None


def uncertain(discrete: bool) -> tuple[Any, dict[str, tuple[float, float]]]:
    """Six roots; every coefficient depends on 14 parameters, and on a product of two of them."""
    rng = np.random.default_rng(14)
    base = np.poly(np.linspace(-0.6, 0.7, 6) if discrete else -np.linspace(0.5, 3, 6))
    by = rng.normal(size=(7, 14)) * (0.1 if discrete else 0.3)
    p = ca.SX.sym("p", 14)
    a = [base[k] * (1 + ca.dot(ca.DM(by[k]), p) + 0.1 * by[k, 0] * p[0] * p[13]) for k in range(7)]
    a[0] = 1.0 if discrete else a[0]
    return ca.Function("a", [p], [ca.vertcat(*a)]), dict.fromkeys(NAMES, (-0.1, 0.1))


@pytest.mark.slow
@pytest.mark.parametrize("discrete", [False, True])
def test_fourteen_parameters_are_proven(discrete: bool) -> None:
    """Up to a few thousandths below the witness; corners and places inside the proven box have stable roots."""
    f, box = uncertain(discrete)
    m = malta.proof.margin_of_polynomial(f, box, discrete=discrete, time=60)
    assert m.lower is not None
    assert m.lower > 0.99 * m.upper
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (800, 14))
    places[::2] = np.sign(places[::2])
    for u in 0.1 * m.lower * places:
        roots = np.roots(np.array(f(u)).ravel())
        assert (np.abs(roots) < 1).all() if discrete else (roots.real < 0).all()
