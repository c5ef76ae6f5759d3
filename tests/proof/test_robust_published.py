"""Robust stability margins of polynomials whose answers are published, or follow by hand from a published polynomial.

Every margin is in multiples of its box. Each number was found a second time without frequencies: the constant, the
leading coefficient and the last Hurwitz determinant as polynomials in the parameters, positive up to it by their
Bernstein coefficients. Where that and the source disagree, the test says what the source overlooked.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import published_cases as cases
import pytest

import malta

if TYPE_CHECKING:
    from collections.abc import Mapping

    from published_cases import Box, Coefficients, Polynomial

    from malta.proof import Margin


def bracketed(m: Margin, number: float, rounding: float = 1e-9) -> None:
    """The number lies between a proof and a witness that are 0.1 % apart, but for its rounding (relative)."""
    assert m.lower is not None, m.reason
    assert m.lower <= m.upper <= 1.001 * m.lower
    assert m.lower <= number * (1 + rounding)
    assert m.upper >= number * (1 - rounding)


def growth(coefficients: list[float], discrete: bool) -> float:
    """How far the worst root is beyond the boundary of stability."""
    roots = np.roots(coefficients)
    return float(np.abs(roots).max() - 1 if discrete else roots.real.max())


def margin(
    coefficients: Coefficients,
    box: Box,
    nominal: Mapping[str, float] | None = None,
    *,
    discrete: bool = False,
) -> Margin:
    """A margin that roots agree with: unstable beyond its witness, stable at random inside its box and at corners."""
    m = malta.proof.margin_of_polynomial(coefficients, box, nominal, discrete=discrete)
    assert m.lower is not None, m.reason
    assert m.witness is not None
    middle = {k: (low + high) / 2 for k, (low, high) in box.items()} | dict(nominal or {})
    beyond = {k: middle[k] + 1.001 * (m.witness[k] - middle[k]) for k in box}
    assert growth([float(c) for c in coefficients(**beyond)], discrete) > 0
    rng = np.random.default_rng(0)
    u = rng.uniform(-1, 1, (400, len(box)))
    u[::2] = np.sign(u[::2])
    for row in u:
        inside = {}
        for share, (k, (low, high)) in zip(row, box.items(), strict=True):
            side = high - middle[k] if share > 0 else middle[k] - low
            inside[k] = middle[k] + 0.9999 * m.lower * share * side
        assert growth([float(c) for c in coefficients(**inside)], discrete) < 0
    return m


def margin_of(case: Polynomial) -> Margin:
    return margin(case.coefficients, case.box, case.nominal)


def test_de_gaston_and_safonov_1988() -> None:
    """Exact calculation of the multiloop stability margin, IEEE TAC 33; Handbook of Test Problems 7.3.1: 0.34174."""
    case = cases.DE_GASTON_SAFONOV
    m = margin_of(case)
    bracketed(m, case.margin, 1e-8)
    assert m.moved == pytest.approx({"q1": 273.392, "q2": -0.683479, "q3": -1.025219}, rel=1e-3)


def test_handbook_7_3_2() -> None:
    """Floudas et al., Handbook of Test Problems in Local and Global Optimization, 7.3.2: 1.0899.

    Given there as its last Hurwitz determinant, which a polynomial of first order has as its root.
    """
    case = cases.HANDBOOK_7_3_2
    m = margin_of(case)
    bracketed(m, case.margin, 1e-8)
    assert m.upper == pytest.approx(1.0899, abs=1.2e-3)


def test_handbook_7_3_3() -> None:
    """Floudas et al. 7.3.3: 0.8175, with all three parameters at their upper ends."""
    case = cases.HANDBOOK_7_3_3
    m = margin_of(case)
    bracketed(m, case.margin)
    assert m.moved == pytest.approx({"q1": 0.204382, "q2": 0.408765, "q3": 1.226294}, rel=1e-3)
    assert m.frequency == pytest.approx(1.162318, rel=1e-3)


@pytest.mark.slow
def test_vicino_tesi_and_milanese_1990() -> None:
    """Computation of nonconservative stability perturbation bounds, IEEE TAC 35; Handbook 7.3.4: 6.2746."""
    case = cases.VICINO_TESI_MILANESE
    m = margin_of(case)
    bracketed(m, case.margin, 1e-6)
    assert m.frequency == pytest.approx(0.9864, rel=1e-3)  # the Handbook's


def test_the_bus_of_handbook_7_3_5_is_lost_beyond_its_frequencies() -> None:
    """Ackermann, Kaesbauer and Muench 1991; Handbook 7.3.5 prints 1.2069, as does GAMS' model `benz`.

    That is 17.5 / 14.5, where the bus stands. Both bound w, by 10 and by 2 rad/s: at 0.9888, full speed and the least
    mass, the loop is lost at 16.4 rad/s.
    """
    m = margin_of(cases.BUS)
    bracketed(m, cases.BUS.margin)
    assert m.frequency == pytest.approx(16.44757, rel=1e-3)
    assert max(np.roots(cases.bus(32.0, 5.0)).real) > 0.1  # the published box itself


def test_ackermanns_bus_is_lost_where_it_stands() -> None:
    """v in 3 .. 20 m/s, m in 9.95 .. 32 t: to v = 0, where two roots come to zero and two go to infinity."""
    m = malta.proof.margin_of_polynomial(cases.bus, {"v": (3, 20), "m": (9.95, 32)})
    bracketed(m, 11.5 / 8.5)


DEDRA = (  # from s^7 down: factor and indices of q, so 0.1586 177 is 0.1586 q1 q7^2
    "1 77",
    "0.1586 177; 2 277; 2 57; 0.1826 67; 0.0552 77",
    "0.0189477 177; 0.1104 277; 0.1826 56; 0.1104 57; 0.0237398 67; 1 2277; 0.1586 1277; 0.0872 147; "
    "0.0215658 167; 0.3652 267; 2 347; -0.0848 367; 1 55; 0.00076176 77; 0.3172 157; 4 257",
    "0.1586 155; 0.000402141 177; 2 255; 0.00152352 277; 0.0237398 56; 0.00152352 57; 0.00051612 67; "
    "0.0552 2277; 0.0189477 1277; 0.0872 145; 0.034862 147; 0.0215658 156; 0.00287416 167; 0.0474795 267; "
    "2 345; 0.1826 346; 0.1104 347; -0.0848 356; -0.00234048 367; 2 2257; 0.1826 2267; 0.0872 1247; "
    "0.3172 1257; 0.0215658 1267; 0.1586 1347; 2 2347; -0.0848 2367; 0.0552 55; 0.3652 256; 0.0378954 "
    "157; 0.2208 257",
    "0.189477 155; 0.1104 255; 0.00051612 56; 1 2255; 0.00076176 2277; 1 3344; 0.1586 1255; 0.000402141 "
    "1277; 0.0872 1344; 0.034862 145; 0.00336706 147; 0.00287416 156; 6.28987e-05 167; 0.00103224 267; "
    "0.1104 345; 0.0237398 346; 0.00152352 347; -0.00234048 356; 0.1826 2256; 0.1104 2257; 0.0237398 "
    "2267; -0.0848 3346; 0.0872 1245; 0.034862 1247; 0.0215658 1256; 0.0378954 1257; 0.00287416 1267; "
    "0.1586 1345; 0.0215658 1346; 0.0189477 1347; 2 2345; 0.1826 2346; 0.1104 2347; -0.0848 2356; "
    "-0.00234048 2367; 0.00076176 55; 0.0474795 256; 0.000804282 157; 0.00304704 257",
    "0.000402141 155; 0.00152352 255; 0.0552 2255; 0.0552 3344; 0.0189477 1255; 0.034862 1344; 0.00336706 "
    "145; 6.82079e-05 147; 6.28987e-05 156; 0.00152352 345; 0.00051612 346; -0.00234048 3346; 0.034862 "
    "1245; 0.0237398 2256; 0.00152352 2257; 0.00051612 2267; 0.00336706 1247; 0.00287416 1256; "
    "0.000804282 1257; 6.28987e-05 1267; 0.0189477 1345; 0.00287416 1346; 0.000402141 1347; 0.1104 2345; "
    "0.0237398 2346; 0.00152352 2347; -0.00234048 2356; 0.00103224 256",
    "0.00076176 2255; 0.00076176 3344; 0.000402141 1255; 0.00337606 1344; 6.82079e-05 145; 0.00051612 "
    "2256; 0.00337606 1245; 6.82079e-05 1247; 6.28987e-05 1256; 0.000402141 1345; 6.28987e-05 1346; "
    "0.00152352 2345; 0.00051612 2346",
    "6.82079e-05 1344; 6.82079e-05 1245",
)


def dedra(q1: Any, q2: Any, q3: Any, q4: Any, q5: Any, q6: Any, q7: Any) -> list[Any]:
    """The idle speed of an engine, Fiat Dedra, at seven parameters of its working point."""
    q = (1, q1, q2, q3, q4, q5, q6, q7)
    terms = ([term.split() for term in line.split("; ")] for line in DEDRA)
    return [
        sum(float(factor) * math.prod(q[int(i)] for i in indices) for factor, indices in line)
        for line in terms
    ]


@pytest.mark.slow
def test_the_engine_of_abate_barmish_murillo_sanchez_and_tempo_1994() -> None:
    """IEEE Transactions on Control Systems Technology 2; Handbook 7.3.6: stable, no solution with k <= 1.

    From the middle it is lost where q7 = 0 is the leading coefficient; from the corner the Handbook starts at, where
    q2 q5 + q3 q4 = 0 is the constant. (GAMS' model `fiat` prints 1.4594, with other ranges for q1, q5 and q7.)
    """
    low = {"q1": 2.1608, "q2": 0.1027, "q3": 0.0357, "q4": 0.2539, "q5": 0.0100, "q6": 2.0247, "q7": 1.0}
    high = {"q1": 3.4329, "q2": 0.1627, "q3": 0.1139, "q4": 0.5607, "q5": 0.0208, "q6": 4.4962, "q7": 10.0}
    box = {k: (low[k], high[k]) for k in low}
    bracketed(margin(dedra, box), 11 / 9)
    corner = high | {k: low[k] for k in ("q4", "q6", "q7")}
    m = margin(dedra, box, corner)
    bracketed(m, 1.4633300485)
    assert m.frequency == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("e", [0.1, 1e-2, 1e-4])
def test_the_island_of_barmishs_examination(e: float) -> None:
    """B. R. Barmish's examination in ECE 717 (Wisconsin): unstable within sqrt(e) of (1/2, 1/2) only.

    From (0, 0) the box [0, t] x [0, t] meets that disk with its corner.
    """
    m = margin(
        lambda q1, q2: [1, 1 + q1 + q2, 1 + q1 + q2, 0.5 + e + 3 * (q1 + q2) + 2 * q1 * q2],
        {"q1": (0, 1), "q2": (0, 1)},
        {"q1": 0, "q2": 0},
    )
    bracketed(m, 0.5 - math.sqrt(e / 2))


@pytest.mark.parametrize("r", [0.2, 0.1, 0.01, 1e-3])
def test_an_island_that_a_side_of_the_box_meets(r: float) -> None:
    """MATLAB's robstab (2022) prints 0.2722 .. 1.2389 at r = 0.1: exactly, the side q1 = 1.4 - 1.1 t is at 1 + r."""
    case = cases.island_by_a_side(r)
    bracketed(margin_of(case), case.margin)


@pytest.mark.slow_for("0.001")
@pytest.mark.parametrize("r", [0.5, 0.1, 0.01, 1e-3])
def test_an_island_that_a_corner_of_the_box_meets(r: float) -> None:
    m = margin(cases.island(r), {"q1": (0, 2), "q2": (0, 2)}, {"q1": 0, "q2": 0})
    bracketed(m, (1 - r / math.sqrt(2)) / 2)


# Interval polynomials and polytopes


def test_an_interval_polynomial_of_barmish_1994() -> None:
    """New Tools for Robustness of Linear Systems (a demo of the Polynomial Toolbox): 1.0952 by Kharitonov's four."""
    middle = {"a5": 4.0, "a4": 4.0, "a3": 6.0, "a2": 3.0, "a1": 2.0, "a0": 0.5}
    m = margin(
        lambda a5, a4, a3, a2, a1, a0: [1, a5, a4, a3, a2, a1, a0],
        {k: (value - 0.05, value + 0.05) for k, value in middle.items()},
    )
    bracketed(m, 1.0951959265)

    def worst(t: float) -> float:
        """Of Kharitonov's polynomials."""
        a = np.array([*reversed(middle.values())])
        signs = (np.array(s) for s in ((-1, -1, 1, 1), (1, 1, -1, -1), (1, -1, -1, 1), (-1, 1, 1, -1)))
        return max(growth([1, *(a + 0.05 * t * np.resize(s, 6))[::-1]], False) for s in signs)

    assert worst(m.lower or 0) < 0 <= worst(m.upper)


def test_a_polytope_that_loses_its_degree() -> None:
    """A demo of the Polynomial Toolbox calls it stable for |q| <= 0.245, from value sets at w <= 1.5.

    Its leading coefficient vanishes at |q| = 0.2, where a root comes back from infinity.
    """
    m = margin(
        lambda q1, q2, q3: [
            1 + 2 * q1 - q2 + 2 * q3,
            3 + 3 * q1 - 3 * q2 + q3,
            3 + 3 * q1 + q2 + q3,
            3 + q1 - q2 + 2 * q3,
        ],
        dict.fromkeys(("q1", "q2", "q3"), (-0.245, 0.245)),
    )
    bracketed(m, 0.2 / 0.245)


def test_multilinear_and_polynomial_structures_of_the_polynomial_toolbox() -> None:
    """Its demo's examples 6 and 7: 2, where 1 + q1 + q2 = 0, and 1/2."""
    box = {"q1": (0, 1), "q2": (0, 1)}
    bracketed(margin(lambda q1, q2: [1, 1 + q1 * q2, 1 + q1 + q2], box), 2)

    def seventh(q1: Any, q2: Any) -> list[Any]:
        a, b, c = q1**3 + q1, q2**3 - q2**2, q1 * q2
        return [1 + c, 1 + a - b - c, 1 + a + b + c]

    bracketed(margin(seventh, {"q1": (-1, 1), "q2": (-1, 1)}), 0.5)


def test_one_parameter_of_the_polynomial_toolbox() -> None:
    """The stability interval of 3 + 10 s + 12 s^2 + 6 s^3 + s^4 + q (s + s^3) begins at q = -5.6277."""
    m = margin(lambda q: [1, 6 + q, 12, 10 + q, 3], {"q": (-1, 1)})
    bracketed(m, 5.6277186767)
    assert m.frequency == pytest.approx(3.4270, rel=1e-3)


def test_a_discrete_interval_polynomial_of_the_polynomial_toolbox() -> None:
    """[168, 178] z^4 + [260, 270] z^3 + [128, 138] z^2 + [20, 30] z + [10, 20] is stable, by 31 / 25 at z = -1."""
    box = {"a4": (168, 178), "a3": (260, 270), "a2": (128, 138), "a1": (20, 30), "a0": (10, 20)}
    m = margin(lambda a4, a3, a2, a1, a0: [a4, a3, a2, a1, a0], box, discrete=True)
    bracketed(m, 31 / 25)


def test_rohrs_1985() -> None:
    """Robustness of continuous-time adaptive control, IEEE TAC 30: lost at a gain of 17.03, at 16.1 rad/s."""
    m = margin(lambda k: [1, 31, 259, 229 + 458 * k], {"k": (1.0, 2.0)}, {"k": 1.0})
    bracketed(m, 7800 / 458 - 1)
    assert 1 + m.upper == pytest.approx(17.03, abs=0.02)
    assert m.frequency == pytest.approx(16.1, abs=0.05)


def test_a_margin_at_one_frequency_only() -> None:
    """MATLAB, Getting Reliable Estimates of Robustness Margins: s^2 + c s + 1, c = 1 +- 1: 1, at 1 rad/s alone."""
    m = margin(lambda c: [1, c, 1], {"c": (0, 2)})
    bracketed(m, 1)
    assert m.frequency == pytest.approx(1, rel=1e-6)
