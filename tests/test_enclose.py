"""Enclosures: what an interval or a box is said to hold, it holds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from malta.enclose import (
    Block,
    Taylor,
    bernstein,
    characteristic,
    characteristic_values,
    coefficients,
    cover,
    enclosure,
    excludes_zero,
    frequencies,
    matrices_of,
    nodes,
    polynomial,
    products,
    response,
    restrictions,
)
from malta.enclose import along as turned
from malta.uncertain import Compensator, UncertainSystem, closed_loop

if TYPE_CHECKING:
    from malta.plant import ComplexArray, FloatArray

numbers = st.floats(-10, 10, allow_subnormal=False).map(lambda v: round(v, 3))
rows = arrays(float, 4, elements=numbers)
FEW = settings(max_examples=60, deadline=None)


@st.composite
def models(draw: st.DrawFn) -> tuple[Taylor, ComplexArray]:
    """Models and, for each, true values at e = -1 .. 1 within them: 4 x 9."""
    c, g = draw(rows) + 1j * draw(rows), draw(rows) + 1j * draw(rows)
    r, angle = np.abs(draw(rows)) / 10, draw(rows)
    e = np.linspace(-1, 1, 9)
    off = r[:, None] * np.exp(1j * (angle[:, None] + 3 * e))
    return Taylor(c, g, r), c[:, None] + g[:, None] * e + off


def holds(t: Taylor, true: ComplexArray, slack: float = 1e-9) -> Any:
    e = np.linspace(-1, 1, true.shape[1])
    off = np.abs(true - t.c[:, None] - t.g[:, None] * e)
    return off <= t.r[:, None] * (1 + slack) + slack * (1 + np.abs(t.c[:, None]))


@FEW
@given(models(), models(), numbers)
def test_arithmetic_holds_what_it_is_said_to(
    a: tuple[Taylor, ComplexArray], b: tuple[Taylor, ComplexArray], k: float
) -> None:
    (s, true_s), (t, true_t) = a, b
    for found, true in (
        (s + t, true_s + true_t),
        (s - t, true_s - true_t),
        (s * t, true_s * true_t),
        (-s, -true_s),
        (s.conj(), true_s.conj()),
        (s * k + (2 - 1j), true_s * k + 2 - 1j),
        (k * s, true_s * k),
    ):
        assert holds(found, true).all()
    assert (np.abs(true_s) <= s.size()[:, None] + 1e-12).all()
    M = np.array([[1, -2, 0.5, 1j], [0, 3, -1, 2]])
    assert holds(s.mapped(M, "ij,j->i"), M @ true_s).all()


@FEW
@given(models())
def test_an_inverse_holds_or_is_infinite(model: tuple[Taylor, ComplexArray]) -> None:
    t, true = model
    with np.errstate(all="ignore"):
        found = t.inverse()
        fine = np.isfinite(found.r)
        assert holds(found[fine], 1 / true[fine], 1e-7).all()
        # infinite only where zero is in the enclosure itself
        e = np.linspace(-1, 1, 2001)
        near = np.abs(t.c[:, None] + t.g[:, None] * e).min(axis=1) - t.r
    assert (near[~fine] <= 2 * np.abs(t.g[~fine]) / 1000 + 1e-9).all()


@FEW
@given(arrays(float, 5, elements=numbers), arrays(float, 5, elements=numbers), numbers, numbers)
def test_zero_is_excluded_only_from_what_lies_in_a_half_plane(
    re: FloatArray, im: FloatArray, g: float, r: float
) -> None:
    points = (re + 1j * im)[None, :]
    f = Taylor(points, np.full_like(points, 0.1 * g * (1 + 1j)), np.full(points.shape, abs(r) / 20))
    if excludes_zero(f)[0]:
        corners = np.concatenate([f.c - f.g, f.c + f.g], axis=1)[0]
        directions = np.exp(1j * np.linspace(0, 2 * np.pi, 721))
        # some direction sees all of the disks ahead
        ahead = (corners[None] * directions[:, None].conj()).real.min(axis=1) - f.r[0, 0]
        assert ahead.max() > -1e-9
        # any convex combination stays away from zero
        weights = np.random.default_rng(0).dirichlet(np.ones(5), 200)
        assert (np.abs(weights @ f.c[0]) > 0).all()


def test_zero_is_excluded_from_clear_cases() -> None:
    def says(points: list[complex], g: complex = 0, r: float = 0.0) -> bool:
        c = np.array([points], dtype=complex)
        return bool(excludes_zero(Taylor(c, np.full_like(c, g), np.full(c.shape, r)))[0])

    assert says([1, 1 + 1j, 1 - 1j])
    assert says([-1, -2, -1 + 3j])
    assert says([1e-9, 1e-9 * (1 + 1j)])
    assert says([1j, 1 + 0.01j, -1 + 0.01j])
    assert not says([1, -1])
    assert not says([1, 1j, -1 - 1j])
    assert not says([0, 1])
    assert says([1, 2], g=0.5, r=0.4)
    assert not says([1, 2], g=0.5, r=0.6)
    assert not says([1, 2], r=np.inf)
    assert not says([complex(np.nan), 2])


@FEW
@given(st.integers(1, 5), st.integers(1, 4), st.randoms(use_true_random=False))
def test_bernstein_coefficients_hold_a_polynomial_over_a_box_and_its_parts(
    d: int, k: int, random: Any
) -> None:
    rng = np.random.default_rng(random.randrange(1 << 30))
    power = rng.normal(size=(d + 1, k + 1)) + 1j * rng.normal(size=(d + 1, k + 1))

    def value(u: FloatArray, v: FloatArray) -> ComplexArray:
        return np.asarray(np.polynomial.polynomial.polyval2d(u, v, power))

    grid = np.array([(u, v) for u in nodes(d) for v in nodes(k)])
    f = Taylor(value(*grid.T)[None], np.zeros((1, len(grid)), complex), np.zeros((1, len(grid))))
    shape = (d + 1, k + 1)
    whole = turned(f, shape, [np.linalg.inv(bernstein(n, nodes(n)))[None] for n in (d, k)])
    box = np.sort(rng.uniform(size=(1, 2, 2)), axis=2)
    part = turned(whole, shape, restrictions(shape, box))
    for coefficient, low, high in ((whole, np.zeros(2), np.ones(2)), (part, *box[0].T)):
        u = low + (high - low) * rng.uniform(size=(500, 2))
        true = value(*u.T)
        for direction in np.exp(1j * np.linspace(0, 6, 13)):
            ahead, seen = (coefficient.c[0] * direction).real, (true * direction).real
            assert ahead.min() - 1e-9 <= seen.min()
            assert seen.max() <= ahead.max() + 1e-9


def system(
    functions: Any, nominal: list[float], *, second_order: bool = False, names: tuple[str, ...] | None = None
) -> UncertainSystem:
    """functions: symbols p -> A, B, C."""
    p = ca.SX.sym("p", len(nominal))
    matrices = ca.Function("f", [p], [ca.densify(ca.SX(M)) for M in functions(p)])
    names = names or tuple(f"p{i}" for i in range(len(nominal)))
    return UncertainSystem(
        names, np.array(nominal), matrices, second_order, ((-np.inf, np.inf),) * len(nominal)
    )


def coupled(rng: np.random.Generator, n: int, *, damped: bool = True) -> UncertainSystem:
    """n coupled modes with stiffness and damping that two parameters scale."""
    K, D = rng.normal(size=(n, n)) * 3e4, rng.normal(size=(n, n)) * 30 * damped
    B, C = rng.normal(size=(n, n)) + 2 * np.eye(n), rng.normal(size=(n, 2 * n))
    C[:, n:] *= 1e-3

    def of(p: Any) -> Any:
        A = ca.vertcat(
            ca.horzcat(ca.SX(n, n), ca.SX.eye(n)), ca.horzcat(p[0] * K + p[1] * (K.T @ K) * 1e-6, p[1] * D)
        )
        return A, ca.vertcat(ca.SX(n, n), p[1] * B), C

    return system(of, [1.0, 1.0], second_order=True)


def first_order(rng: np.random.Generator, n: int) -> UncertainSystem:
    A, B, C = rng.normal(size=(n, n)) * 40, rng.normal(size=(n, 2)), rng.normal(size=(2, n))
    return system(lambda p: (p[0] * A + p[1] * (A.T @ A) * 1e-3, p[1] * B, C), [1.0, 1.0])


def law(rng: np.random.Generator, k: int, m: int, p: int, **of: Any) -> Compensator:
    """Random and stable, the last states integrate."""
    integrals, T = of.get("integrals", 0), of.get("sample_time")
    A = rng.normal(size=(k, k)) * 50 - 200 * np.eye(k)
    A = A if T is None else np.eye(k) + A * T
    full = np.zeros((k + integrals, k + integrals))
    full[:k, :k], full[:k, k:] = A, rng.normal(size=(k, integrals)) * (1 if T is None else T)
    full[k:, k:] = np.eye(integrals) * (T is not None)
    B = rng.normal(size=(k + integrals, p)) * (1 if T is None else T)
    C, D = rng.normal(size=(m, k + integrals)) * 300, rng.normal(size=(m, p)) * 10
    return Compensator(full, B, C, D, **of)


LOOPS = {
    "continuous": {},
    "continuous, integrals, lag": {"integrals": 1, "lag": 300.0},
    "sampled": {"sample_time": 1e-3},
    "sampled, delay, lag": {"sample_time": 1e-3, "delay": 2, "lag": 700.0},
    "sampled, integrals, delay": {"sample_time": 1e-3, "delay": 1, "integrals": 2},
    "sampled, slow lag": {"sample_time": 1e-3, "lag": 5.0, "integrals": 1},
}


@pytest.mark.parametrize("kind", LOOPS)
@pytest.mark.parametrize("seed", range(3))
def test_f_on_an_interval_holds_f_at_its_points(kind: str, seed: int) -> None:
    """Both the response of the law and f, on short and long intervals, up to the end of all frequencies."""
    rng = np.random.default_rng(seed)
    n = 1 + seed
    plant, c = coupled(rng, n), law(rng, 3, n, n, **LOOPS[kind])
    M = matrices_of(Block(plant, c, tuple(range(n))), plant.nominal + rng.uniform(-0.2, 0.2, (3, 2)))
    cells = cover(c, M.stiffest)
    for parts in (64, 8):
        fine = np.vstack(
            [
                np.column_stack(
                    [
                        np.full(parts, b),
                        np.linspace(lo, hi, parts + 1)[:-1],
                        np.linspace(lo, hi, parts + 1)[1:],
                    ]
                )
                for b, lo, hi in [*cells[:: max(1, len(cells) // 9)].tolist(), cells[-1].tolist()]
            ]
        )
        with np.errstate(all="ignore"):
            G = response(c, frequencies(c, fine), fine)
            f, images = characteristic(c, M, fine)
        for e in (-1.0, -0.4, 0.7, 1.0):
            at = fine[:, 1] + (1 + e) / 2 * (fine[:, 2] - fine[:, 1])
            at = np.where((fine[:, 0] == 1) & (at == 0), 1e-12 * fine[:, 2], at)
            points = np.column_stack([fine[:, 0], at, at])
            exact, (value, _) = response(c, frequencies(c, points), points), characteristic(c, M, points)
            for t, true, more in ((G, exact.c, 0.0), (f, value.c, images[:, None])):
                off = np.abs(true - t.c - e * t.g)
                assert (off <= t.r * (1 + 1e-9) + more + 1e-9 * np.abs(true)).all() or not np.isfinite(
                    t.r
                ).all()
                fine_enough = np.isfinite(t.r).reshape(len(fine), -1).all(axis=1)
                allowed = t.r * (1 + 1e-9) + 1e-9 * np.abs(true) + more
                assert (off <= allowed)[fine_enough].all()
        if parts == 64:
            assert np.isfinite(f.r).all(axis=1).mean() > 0.9


@pytest.mark.parametrize("kind", LOOPS)
@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_f_is_the_characteristic_polynomial_of_the_loop(kind: str, order: int, seed: int) -> None:
    """f(jw; p) / f(jw; p0) against determinants of the exact closed loop; of sampled ones within the images' bound.

    f = det(s - A_closed) x det N(s) / det(s - A_open), up to a factor that no parameter enters.
    """
    rng = np.random.default_rng(seed)
    n = 1 + seed % 3
    plant = coupled(rng, n) if order == 2 else first_order(rng, n)
    m = p = n if order == 2 else 2
    c = law(rng, 3, m, p, **LOOPS[kind])
    T = c.sample_time
    values = np.vstack([plant.nominal, plant.nominal + rng.uniform(-0.3, 0.3, (4, 2))])
    w = np.geomspace(0.1, 1e4 if T is None else 0.999 * np.pi / T, 40)
    f, images = characteristic(
        c, matrices_of(Block(plant, c, tuple(range(n))), values), np.column_stack([0 * w, w, w])
    )
    s = 1j * w if T is None else np.expm1(1j * w * T) / T
    loops = closed_loop(plant, c, values)
    closed = np.linalg.slogdet(s[:, None, None, None] * np.eye(loops.shape[-1]) - loops)
    total = closed[0] * np.exp(closed[1] - closed[1][:, :1])
    if T is not None:
        own = np.linalg.eigvals(plant.at(values)[0])
        sampled = (s[:, None, None] - np.expm1(own * T) / T).prod(axis=2)
        total = total / sampled * (1j * w[:, None, None] - own).prod(axis=2)
    ratio, true = f.c / f.c[:, :1], total / total[:, :1]
    error = np.abs(ratio - true)
    radius = (f.r + images[:, None]) / np.abs(f.c)
    allowed = np.abs(true) * (radius + radius[:, :1]) * 1.05 + 1e-8 * np.abs(true)
    clear = (radius < 0.05).all(axis=1)
    assert (error <= allowed)[clear].all()
    assert clear.mean() > 0.7
    assert np.isfinite(f.r).all()


def test_the_bound_of_a_holds_images_is_no_slacker_than_needed(designs: dict[str, Any]) -> None:
    """Images are exact for a free mass: MALTA's stiffness leaves a ten-thousandth of a percent near the crossover."""
    from malta.uncertain import sampled_law, uncertain

    design = designs["calibrated"]
    c = sampled_law(design.controller, 1, 3000.0)
    plant = uncertain(design.plant, ["m", "K_A"], at={"z": 0.01})
    M = matrices_of(Block(plant, c, tuple(range(5))), plant.nominal[None])
    w = np.geomspace(1, 6e4, 30)
    f, images = characteristic(c, M, np.column_stack([0 * w, w, w]))
    assert (images[w < 3000] < 1e-6 * np.abs(f.c[w < 3000, 0])).all()
    free = system(
        lambda p: (ca.SX([[0.0, 1], [0, 0]]), ca.vertcat(0, p[0]), ca.SX([[1.0, 0]])),
        [1.0],
        second_order=True,
    )
    one = law(np.random.default_rng(0), 2, 1, 1, sample_time=1e-3, delay=1, lag=300.0)
    f, images = characteristic(
        one, matrices_of(Block(free, one, (0,)), np.ones((1, 1))), np.array([[0, 1e3, 1e3]])
    )
    assert images[0] == 0
    assert f.r[0, 0] < 1e-9 * abs(f.c[0, 0])


def test_degrees_are_found_and_denominators_cleared() -> None:
    """p0 over itself, p1 cubed, p2 not at all, p3 through the sine."""

    def of(p: Any) -> Any:
        A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-1 / p[0] - p[1] ** 3, -1 - ca.sin(p[3])))
        return A, ca.vertcat(0, 1 / p[0]), ca.SX([[1.0, 0]])

    plant = system(of, [1.0, 0.5, 2.0, 0.0])
    block = Block(
        plant, Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), -np.ones((1, 1))), (0, 1)
    )
    sides = np.array([[0.5, 1.5], [0.2, 0.8], [1, 3], [0, 0]])
    found = polynomial(block, plant.names, sides)
    assert not isinstance(found, str)
    assert (found.degrees, found.poles) == ((1, 3, 0, 0), (1, 0, 0, 0))
    sides[3] = -1, 1
    assert "p3 enters neither" in str(polynomial(block, plant.names, sides))


@FEW
@given(st.integers(0, 10_000))
def test_coefficients_hold_f_over_the_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = 1 + seed % 2
    plant = coupled(rng, n)
    c = law(rng, 2, n, n, **LOOPS[list(LOOPS)[seed % len(LOOPS)]])
    block = Block(plant, c, tuple(range(n)))
    sides = np.column_stack([plant.nominal - rng.uniform(0, 0.5, 2), plant.nominal + rng.uniform(0.1, 1, 2)])
    poly = polynomial(block, plant.names, sides)
    assume(not isinstance(poly, str))
    assert not isinstance(poly, str)
    e = enclosure(block, plant.nominal, sides, poly)
    w = float(rng.uniform(1, 3000))
    f = coefficients(e, np.array([[0, w, w]]))
    values = rng.uniform(sides[:, 0], sides[:, 1], (200, 2))
    true = characteristic_values(block, values, np.array([w]))[0] * np.prod(
        values ** np.array(poly.poles), axis=1
    )
    size = np.abs(true).max()
    assert np.abs(products(e, values) @ f.c[0] - true).max() < 1e-8 * size
    for direction in np.exp(1j * np.linspace(0, 6, 13)):
        ahead = (f.c[0] * direction).real + f.r[0]
        assert (true * direction).real.max() <= ahead.max() + 1e-9 * size


@pytest.mark.parametrize("T", [None, 1e-3])
def test_intervals_cover_all_frequencies(T: float | None) -> None:
    c = Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)), sample_time=T)
    cells = cover(c, 10.0)
    low = cells[cells[:, 0] == 0]
    assert low[0, 1] == 0
    assert (low[1:, 1] == low[:-1, 2]).all()
    if T is None:
        (high,) = cells[cells[:, 0] == 1]
        assert high[1] == 0
        assert 1 / high[2] == pytest.approx(low[-1, 2], rel=1e-12)
        assert 1 / high[2] <= low[-1, 2]
    else:
        assert low[-1, 2] >= np.pi / T * (1 - 1e-15)
