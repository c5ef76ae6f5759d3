"""Bounds that proofs rest on, each against what it bounds: remainders, half planes, degrees, couplings, minima."""

from __future__ import annotations

import copy
import itertools
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import Ordering, acb, arb, fmpq, fmpq_mpoly_ctx
from tampering import claiming

import malta
from malta.checker import check, file as checked_file, loop as checked_loop
from malta.linear.closed_loops import closed_loop
from malta.linear.expressions import exact
from malta.linear.uncertain import Compensator
from malta.margins.loop_report import StagePeak
from malta.margins.travel import smallest_margin
from malta.proof import certificate, exclusion
from malta.proof.box import below
from malta.proof.groups import loop_of
from malta.proof.margin import Margin
from malta.proof.polynomial import characteristic as degrees, enclosure
from malta.proof.polynomial.closed_loop import loop_parts
from malta.proof.polynomial.family import nodes, restrict, restriction_rounding
from malta.proof.problem import OfLoop
from malta.work import WorkUp, count_work, work_limit

RANGES = {"m": 0.3, "k": 0.3}


def _spring() -> Any:
    def matrices(m: Any, k: Any) -> Any:
        return [[0, 1], [-k / m, -0.2 / m]], [[0], [1 / m]], [[1, 0]]

    return malta.uncertain(matrices, {"m": 1.0, "k": 4.0})


def _sampled() -> Compensator:
    """Samples so far apart that e^(A T) is far from linear in the parameters."""
    none = np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[-0.1]])
    return Compensator(*none, sample_time=0.8)


def _polynomial(sides: Any) -> tuple[Any, tuple[Any, ...]]:
    problem = OfLoop(loop_of(_spring(), _sampled()))
    ((f, moves),) = problem.parts([arb((a + b) / 2, (b - a) / 2) for a, b in sides])
    return f, moves


SIDES = np.array([[0.6, 1.4], [2.5, 5.5]])


# The enclosure of the search


def test_coefficients_lie_in_their_family() -> None:
    f, moves = _polynomial(SIDES.tolist())
    assert not f.exact
    found = enclosure.over_box(f, SIDES, moves)
    rng = np.random.default_rng(0)
    for _ in range(50):
        p = SIDES[:, 0] + (SIDES[:, 1] - SIDES[:, 0]) * rng.uniform(size=2)
        v = [1 / x if inv else x for x, inv in zip(p.tolist(), f.inverted, strict=True)]
        ends = [1 / s[::-1] if inv else s for s, inv in zip(SIDES, f.inverted, strict=True)]
        u = [(x - a) / (b - a) for x, (a, b) in zip(v, ends, strict=True)]
        bases = [
            [math.comb(n - 1, k) * x**k * (1 - x) ** (n - 1 - k) for k in range(n)]
            for n, x in zip(found.shape, u, strict=True)
        ]
        weights = np.array([math.prod(row) for row in itertools.product(*bases)])
        exact = f.at([fmpq(*x.as_integer_ratio()) for x in v])
        for k, x in enumerate(exact):
            scaled = float(x * arb(2) ** (found.scale * k - found.exponents[k]))
            assert abs(scaled - found.values[k] @ weights) <= found.radius[k] + 1e-12


def _moduli(degree: int, of: Callable[[Any], Any], turn: float) -> tuple[float, float]:
    """The product of (z - node) on a path z(0 .. turn), in balls over its parts: the least and the largest modulus."""
    x, parts, found = [2 * exact(u) - 1 for u in nodes(degree, chebyshev=True)], 256 * (degree + 1), []
    for k in range(parts):
        product, z = arb(1), of(arb(fmpq(2 * k + 1, 2 * parts) * exact(turn), turn / parts))
        for node in x:
            product *= abs(z - node)
        found.append(product)
    return min(float(one.lower()) for one in found), max(float(one.upper()) for one in found)


@pytest.mark.parametrize("degree", [1, 2, 5, 16])
@pytest.mark.parametrize("radius", [2.0**0.5, 4.0, 2.0**12])
def test_the_remainder_of_an_interpolation_covers_hermites_integral(degree: int, radius: float) -> None:
    """In balls at the rounded nodes: max |w| on the side, R / (R - 1), and min |w| on the circle; and T_n takes it."""
    ((bound, exponent),) = enclosure.remainder(enclosure.Disc(radius, 0.0, [(1.0, 3)]), degree)
    assert exponent == 3
    _, most = _moduli(degree, lambda x: acb(1 - x), 2.0)
    least, _ = _moduli(degree, lambda b: acb(radius * b.cos(), radius * b.sin()), 3.1416)
    integral = most / least * radius / (radius - 1)
    assert 0.95 * bound < integral < 1.1 * bound  # balls over parts of the paths are wide
    n = (
        degree + 1
    )  # T_n is zero at the nodes and one at the end: an error of one, with cosh(n a) on the circle
    assert 1 / math.cosh(n * math.acosh(radius)) <= bound


def test_a_remainder_below_all_numbers_is_not_zero() -> None:
    ((bound, _),) = enclosure.remainder(enclosure.Disc(2.0**40, 0.0, [(1.0, 0)]), 40)
    assert 0 < bound < 1e-300


@pytest.mark.parametrize("degree_of", [1e-5, 1e-6, 1e-9])
def test_the_remainder_of_an_interpolation_is_bounded(degree_of: float) -> None:
    """1 / (a - x), whose pole is a little beyond the disc: what is left out at Chebyshev nodes, and its bound."""
    radius = 4.0
    a = 1.01 * radius
    disc = enclosure.Disc(radius, 0.0, [(1 / (a - radius), 0)])
    side = enclosure.interpolation_side("x", 0, [disc], degree_of)
    d = side.degree
    points = np.cos(np.pi * (np.arange(d + 1) + 0.5) / (d + 1))
    x = np.linspace(-1, 1, 1001)
    fitted = np.polynomial.chebyshev.Chebyshev.fit(points, 1 / (a - points), d, domain=[-1, 1])(x)
    assert side.tails is not None
    ((bound, exponent),) = side.tails
    left = np.abs(fitted - 1 / (a - x)).max()
    assert (
        1e-3 * math.ldexp(bound, exponent)
        < left - 1e-15
        <= math.ldexp(bound, exponent)
        <= degree_of / (a - radius)
    )


def test_errors_of_axes_are_summed_with_the_constants_of_those_before() -> None:
    sides = [enclosure.Side(d, True, ((m, 0), (2 * m, 1))) for d, m in ((1, 1.0), (3, 8.0), (2, 2.0))]
    sides.append(enclosure.Side(2, False, None))
    total = enclosure.sum_tails(sides)
    assert total is not None
    wanted = 8 + enclosure.lebesgue(3) * (2 + enclosure.lebesgue(2) * 1)
    assert [math.ldexp(m, e) for m, e in total] == pytest.approx([wanted, 4 * wanted], rel=1e-12)


def test_bounds_add_up() -> None:
    one, two = [(1.0, 3), (2.0, -1)], [(3.0, 0), (1.0, 2)]
    assert enclosure.add_bounds(one, None) == one
    assert enclosure.add_bounds(None, two) == two
    assert enclosure.add_bounds(None, None) is None
    both = enclosure.add_bounds(one, two)
    assert both is not None
    assert [math.ldexp(m, e) for m, e in both] == [11.0, 5.0]


def test_neglected_couplings_widen_the_family() -> None:
    f, _ = _polynomial(SIDES.tolist())
    plain = enclosure.over_box(f, SIDES)
    moved = enclosure.over_box(f, SIDES, [arb(1e-3)] * 3)
    assert (moved.radius > plain.radius).all()
    size = np.ldexp(moved.radius - plain.radius, moved.powers)
    assert size.max() >= 1e-3


def test_a_parameter_that_divides_must_not_reach_zero() -> None:
    f, _ = _polynomial(SIDES.tolist())
    assert f.inverted == (True, False)
    with pytest.raises(enclosure.Unproven, match="divides reaches zero"):
        enclosure.over_box(f, np.array([[-0.5, 1.4], [2.5, 5.5]]))


def test_an_enclosure_ends_with_its_work() -> None:
    f, _ = _polynomial(SIDES.tolist())
    with work_limit(1e-6), pytest.raises(WorkUp):
        enclosure.over_box(f, SIDES)


def test_an_enclosure_ends_in_time_where_later_places_take_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Places are counted before they are computed; where these take longer than that, the clock ends them."""
    f, _ = _polynomial(SIDES.tolist())
    clock = iter([0.0, 0.0, 0.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(clock, 1e9))
    with count_work(1e6, 1.0), pytest.raises(WorkUp):
        enclosure.values_within(f, [(fmpq(1), fmpq(4))] * 3)


# Exclusion of zero


def test_a_half_plane_holds_all_discs() -> None:
    """Whatever direction is found, every disc about b0 +- b1 lies beyond zero in it; some are found."""
    rng = np.random.default_rng(1)
    count = 4000
    spread = 10.0 ** rng.uniform(-2, 0.5, (count, 1))
    b0: Any = np.exp(2j * np.pi * rng.uniform(size=(count, 1))) + spread * (
        rng.normal(size=(count, 3)) + 1j * rng.normal(size=(count, 3))
    )
    b1: Any = 10.0 ** rng.uniform(-3, 0.3, (count, 1)) * (
        rng.normal(size=(count, 3)) + 1j * rng.normal(size=(count, 3))
    )
    radius = 10.0 ** rng.uniform(-4, 0.5, count)
    beside: Any = 0.1 * radius[:, None] * np.ones((count, 3), dtype=complex)
    c = exclusion.half_plane([b0, b1, beside], 0.9 * radius)
    found = c != 0
    assert 200 < found.sum() < count - 200
    for sign in (1, -1):
        inner = (np.conj(c)[:, None] * (b0 + sign * b1)).real - radius[:, None] * np.abs(c)[:, None]
        assert (inner[found] > 0).all()


def _search(smallest: list[float], target: float) -> exclusion.CellSearch:
    nothing: Any = None
    return exclusion.CellSearch(
        nothing, nothing, np.zeros((0, 3)), np.zeros((0, 1, 2)), np.array(smallest), np.zeros(0), target
    )


def test_what_is_proven_ends_at_the_nearest_open_cell() -> None:
    assert _search([0.3, 0.7], 1.0).lower == 0.3
    assert _search([1.5], 1.0).lower == 1.0
    assert _search([], 1.0).lower == 1.0
    assert not _search([0.3, 1.5], 1.0).finished
    assert _search([1.5], 1.0).finished


def test_a_box_that_reaches_zero_of_what_divides_is_whole() -> None:
    one = np.array([1.0])
    growth = exclusion.Growth(np.array([0.2]), np.array([2.0]), (True,), one, one, one)
    assert growth.inside(0.5).tolist() == pytest.approx(np.array([[(2 / 3 - 0.2) / 1.8, 1.0]]))
    assert growth.inside(2.0).tolist() == [[0.0, 1.0]]


# Degrees


def test_degrees_are_not_below_those_of_the_determinant() -> None:
    context = fmpq_mpoly_ctx.get(["p", "q"], Ordering.lex)
    p, q = context.gens()
    one = context.constant(1)
    pool = [one, p, q, p * q, p + q, p * p, one + p, p * q + one, context.constant(0)]
    rng = np.random.default_rng(2)
    tables = [[[p * q, p], [p, p * q]], [[p, p], [p, p]], [[one + p, p], [p, one + p]]]
    tables += [[[pool[k] for k in row] for row in rng.integers(len(pool), size=(3, 3))] for _ in range(200)]
    for table in tables:
        n = len(table)
        determinant = context.constant(0)
        for order in itertools.permutations(range(n)):
            sign = round(np.linalg.det(np.eye(n)[list(order)]))
            determinant += sign * math.prod((table[i][j] for i, j in enumerate(order)), start=one)
        rows = [{("x", j): x for j, x in enumerate(row) if not x.is_zero()} for row in table]
        for i in (0, 1):
            assert degrees.determinant_degree(rows, i) >= degrees.degree(determinant, i)


# Couplings of the size of rounding


def _coupled(coupling: float) -> tuple[Any, Compensator]:
    def matrices(k: Any) -> Any:
        A = [[0, 1, 0, 0], [-k, -0.2, coupling, 0], [0, 0, 0, 1], [coupling, 0, -2 * k, -0.2]]
        return A, [[0, 0], [1, 0], [0, 0], [0, 1]], [[1, 0, 0, 0], [0, 0, 1, 0]]

    none = np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.eye(2)
    return malta.uncertain(matrices, {"k": 4.0}), Compensator(*none)


def test_couplings_that_are_taken_as_zero_are_bounded() -> None:
    system, law = _coupled(1e-14)
    problem = OfLoop(loop_of(system, law))
    found = loop_parts(problem.loop, problem.couplings, [arb(4.0, 0.5)])
    assert [part.group.states for part in found] == [(0, 1), (2, 3)]
    for part in found:
        assert part.moves
        assert max(float(x) for x in part.moves) >= 1e-15


def test_sizes_of_couplings_are_bounds() -> None:
    """Of every entry of the closed loop, at parameters throughout the balls."""
    system, law = _coupled(0.3)
    problem = OfLoop(loop_of(system, law))
    assert problem.couplings is not None
    size = problem.couplings.bounds([arb(4.0, 1.5)])
    for k in (2.5, 3.3, 5.5):
        assert (np.abs(closed_loop(system, law, np.array([k]))) <= size).all()


# Certificates


@cache
def _certificate() -> dict[str, Any]:
    """The certificate of a spring with a gain, in continuous time."""
    system, law = _spring(), replace(_sampled(), sample_time=None)
    margin = malta.robust_margin(system, law, RANGES)
    return certificate.certificate_of([(system, law)], RANGES, None, margin)


def _loop() -> Any:
    """The loop of that certificate, sampled."""
    content = copy.deepcopy(_certificate())
    content["loops"][0]["sample_time"] = (0.8).hex()
    return checked_file.loop(checked_file.DocumentValue(Path("c"), "", content["loops"][0]), 2)


def test_what_interpolation_leaves_out_is_in_the_radius() -> None:
    """Coefficients over a box, interpolated far too coarsely and cut further: still within their Bernstein balls."""
    (f,) = checked_loop.split(_loop())
    box = [(1 / fmpq(b), 1 / fmpq(a)) if i in inverted else (fmpq(a), fmpq(b)) for i, inverted, (a, b) in (
        (0, {0} if f.group.inverted[0] else set(), (fmpq(6, 10), fmpq(14, 10))),
        (1, {1} if f.group.inverted[1] else set(), (fmpq(25, 10), fmpq(55, 10))),
    )]  # fmt: skip
    for degree, kept in ((1, 0), (2, 1), (4, 1), (4, 4)):
        axes = [checked_file.AxisEnclosure(degree, fmpq(3, 2), kept)] * 2
        values, left = check.interpolate(f, box, axes)
        balls, shape = check.bernstein(values, left, axes)
        each = math.prod(shape)
        for at in itertools.product((0.0, 0.21, 0.5, 0.83, 1.0), repeat=2):
            exact = f.at([a + (b - a) * arb(u) for (a, b), u in zip(box, at, strict=True)])
            for k, x in enumerate(exact):
                own = balls[k * each : (k + 1) * each]
                assert float(min(y.lower() for y in own)) <= float(x.upper()) + 1e-12
                assert float(max(y.upper() for y in own)) >= float(x.lower()) - 1e-12


def test_terms_that_are_not_kept_are_in_the_radius() -> None:
    """Interpolation leaves out next to nothing here: what the balls have to cover are the terms that are cut."""
    (f,) = checked_loop.split(_loop())
    box = [(fmpq(9, 10), fmpq(11, 10)), (fmpq(36, 10), fmpq(44, 10))]
    axes = [checked_file.AxisEnclosure(8, fmpq(3), 0)] * 2
    balls, shape = check.bernstein(*check.interpolate(f, box, axes), axes)
    assert shape == (1, 1)
    for at in itertools.product((0.0, 1.0), repeat=2):
        exact = f.at([a + (b - a) * arb(u) for (a, b), u in zip(box, at, strict=True)])
        assert all(ball.contains(x.mid()) for ball, x in zip(balls, exact, strict=True))


def test_cells_that_overlap_tile_nothing() -> None:
    """Their volumes add up to that of the box, and half of it is not covered."""
    half, whole = fmpq(1, 2), [(fmpq(0), fmpq(1))] * 2
    left = ((fmpq(0), half), (fmpq(0), fmpq(1)))
    assert not check.tiles_box([left, left], whole)
    assert check.tiles_box([left, ((half, fmpq(1)), (fmpq(0), fmpq(1)))], whole)


def test_what_is_left_out_is_at_least_the_error_of_the_interpolant() -> None:
    (f,) = checked_loop.split(_loop())
    box = [(fmpq(7, 10), fmpq(17, 10)), (fmpq(25, 10), fmpq(55, 10))]
    axes = [checked_file.AxisEnclosure(1, fmpq(3, 2), 1)] * 2
    values, left = check.interpolate(f, box, axes)
    for at in itertools.product((0.0, 0.5, 1.0), repeat=2):
        exact = f.at([a + (b - a) * arb(u) for (a, b), u in zip(box, at, strict=True)])
        t = [[1.0, 1 - 2 * u] for u in at]
        for k, x in enumerate(exact):
            own = sum(float(values[4 * k + 2 * i + j]) * t[0][i] * t[1][j] for i in (0, 1) for j in (0, 1))
            assert abs(float(x) - own) <= float(left[k].upper()) + 1e-12


def test_a_claim_in_which_a_mass_vanishes_is_refused(tmp_path: Path) -> None:
    content = copy.deepcopy(_certificate())
    claiming(content, 4.0)
    for part in content["loops"][0]["groups"][0]["parts"]:
        part["box"] = [[(-0.3).hex(), (2.3).hex()], [(-0.9).hex(), (8.9).hex()]]
    content["sha256"] = checked_file.digest(content)
    path = tmp_path / "c.json"
    path.write_text(json.dumps(content))
    found = check.check(path)
    assert not found.ok
    assert "a parameter that divides reaches zero" in found.failures[0]


def test_sizes_are_those_of_whole_balls() -> None:
    assert float(checked_loop.upper(arb(1, 0.5))) >= 1.5
    assert float(checked_loop.upper(arb(-2, 0.5))) >= 2.5


def test_doubles_below_exact_numbers() -> None:
    rng = np.random.default_rng(3)
    for p, q in rng.integers(1, 10**12, (500, 2)).tolist():
        for x in (fmpq(p, q), fmpq(-p, q)):
            low = below(x)
            assert fmpq(*low.as_integer_ratio()) <= x
            assert low == pytest.approx(p / q if x > 0 else -p / q, rel=1e-15)


def test_expressions_have_a_length() -> None:
    context = fmpq_mpoly_ctx.get(["p", "q"], Ordering.lex)
    p, q = context.gens()
    with pytest.raises(checked_loop.Refused, match="too long"):
        checked_loop.CheckedRatio((1 + p + q) ** 80, context.constant(1))


# What counts as proven


def _margin(lower: float | None, upper: float, reason: str = "") -> Margin:
    return Margin(lower, upper, None, None, {}, {}, (), 0.0, reason)


def test_the_margin_of_several_places_is_the_smallest() -> None:
    found = smallest_margin([_margin(1.0, 2.0), _margin(0.5, 3.0)])
    assert (found.lower, found.upper) == (0.5, 2.0)


def test_a_place_without_a_proof_leaves_nothing_proven() -> None:
    found = smallest_margin([_margin(1.0, 2.0), _margin(None, 3.0, "too wide"), _margin(0.5, 4.0)])
    assert (found.lower, found.upper, found.reason) == (None, 2.0, "too wide")


@pytest.mark.parametrize(("radius", "stable"), [(0.999, True), (1.0, False), (1.5, False), (math.nan, False)])
def test_a_loop_is_stable_below_one(radius: float, stable: bool) -> None:
    assert StagePeak("loop", {}, 0.0, radius).stable is stable


def test_an_unstable_loop_is_refused_though_zero_is_excluded(tmp_path: Path) -> None:
    """With the damping's sign turned, a(jw) is conjugate to that of the stable loop: every cell still excludes zero."""
    content = copy.deepcopy(_certificate())
    loop = content["loops"][0]
    turned = [step for step in loop["steps"] if step[0] == "const" and abs(float.fromhex(step[3])) == 0.2]
    assert turned
    for step in turned:
        step[3] = (-float.fromhex(step[3])).hex()
    for part in loop["groups"][0]["parts"]:
        for cell in part["cells"]:
            cell[5] = -cell[5]
    content["sha256"] = checked_file.digest(content)
    path = tmp_path / "c.json"
    path.write_text(json.dumps(content))
    assert check.check(path).failures == ("loop, group 1: the nominal loop is not shown to be stable",)


def _field(value: Any) -> checked_file.DocumentValue:
    return checked_file.DocumentValue(Path("c"), "x", value)


def test_fields_of_certificates_have_bounds() -> None:
    for value in (1e-91, -1e-300, 1e91, math.inf, math.nan, 2**53 + 1, "0x1p-400", "x" * 41, True):
        with pytest.raises(checked_file.Unreadable):
            _field(value).number()
    assert _field(0).number() == _field("0x0p0").number() == 0
    for whole in (-1, 5, 10**9, 1.0, True):
        with pytest.raises(checked_file.Unreadable, match="a whole number from 0 to 4"):
            _field(whole).whole(0, 4)
    for power in (33.0, -33.0, 0.5):
        with pytest.raises(checked_file.Unreadable, match="a whole power up to 32"):
            checked_file.step(_field(["constpow", 0, [0], power]), 1, 1)
    assert checked_file.step(_field(["constpow", 0, [0], 32.0]), 1, 1)[0] == "constpow"
    several: tuple[Any, ...] = ([1], [1, 2, 3], {}, None)
    for items in several:
        with pytest.raises(checked_file.Unreadable, match="a list of 2 to 2 items"):
            _field(items).items(2)
    with pytest.raises(checked_file.Unreadable, match="low, high"):
        _field([2.0, 1.0]).pair()


def test_certificates_have_a_size(tmp_path: Path) -> None:
    path = tmp_path / "c.json"
    path.write_bytes(b" " * (checked_file.MAX_BYTES + 1))
    with pytest.raises(
        checked_file.Unreadable, match="found 4000001 bytes, expected a certificate of at most 4000000"
    ):
        check.check(path)


def test_nothing_is_proven_unless_the_nominal_loop_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """Poles in floating point say that it is stable; without the proof of that, cells prove nothing."""
    law = replace(_sampled(), sample_time=None)
    assert malta.robust_margin(_spring(), law, RANGES).lower is not None
    monkeypatch.setattr("malta.proof.search.is_nominal_stable", lambda *_: False)
    found = malta.robust_margin(_spring(), law, RANGES)
    assert found.lower is None
    assert "the nominal loop is not proven stable" in found.reason


def test_frequencies_that_no_cell_covers_are_missed(tmp_path: Path) -> None:
    """Without the cells of the highest s = jx, those of s = j / x begin beyond the gap."""
    content = copy.deepcopy(_certificate())
    for part in content["loops"][0]["groups"][0]["parts"]:
        low = [cell[1] for cell in part["cells"] if cell[0] == 0]
        part["cells"] = [cell for cell in part["cells"] if cell[0] == 1 or cell[1] < max(low)]
    content["sha256"] = checked_file.digest(content)
    path = tmp_path / "c.json"
    path.write_text(json.dumps(content))
    assert check.check(path).failures == ("loop, group 1: frequencies between the two branches are missing",)


@pytest.mark.parametrize("degree", range(1, 17))
def test_interpolation_is_no_further_off_than_its_constant(degree: int) -> None:
    """Lambda at the nodes that are taken, the largest sum of Lagrange's polynomials' moduli."""
    u, x = np.array(nodes(degree, chebyshev=True)), np.linspace(0, 1, 4001)
    total = np.zeros(len(x))
    for k in range(degree + 1):
        others = np.delete(u, k)
        total += np.abs(np.prod((x[:, None] - others) / (u[k] - others), axis=1))
    assert 0.95 * enclosure.lebesgue(degree) < total.max() <= enclosure.lebesgue(degree)


@pytest.mark.parametrize("shape", [(2,), (2, 2, 2), (3,), (5, 4), (8,), (17,), (17, 3)])
def test_the_rounding_of_restrictions_is_bounded(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(len(shape))
    values, ends = rng.uniform(-1, 1, math.prod(shape)), np.sort(rng.uniform(0, 1, (len(shape), 2)), axis=1)
    found = restrict(values[None], shape, ends[None])[0]
    exact, before = [Fraction(x) for x in values.tolist()], 1
    for n, (low, high) in zip(shape, ends.tolist(), strict=True):
        a, b, after = Fraction(low), Fraction(high), math.prod(shape) // before // n
        made = []
        for outer, i, inner in itertools.product(range(before), range(n), range(after)):
            c = [exact[(outer * n + k) * after + inner] for k in range(n)]
            for at in [a] * (n - 1 - i) + [b] * i:  # de Casteljau's scheme: the blossom at a, ..., b, ...
                c = [(1 - at) * x + at * y for x, y in itertools.pairwise(c)]
            made.append(c[0])
        exact, before = made, before * n
    apart = max(abs(Fraction(x) - y) for x, y in zip(found.tolist(), exact, strict=True))
    assert apart <= restriction_rounding(shape) * np.abs(values).max()
