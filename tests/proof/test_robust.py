"""Robust stability margins: golden cases, proofs repeated in other arithmetic, and what a margin promises."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np
import pytest
from conditions import EPS
from hypothesis import assume, given, settings, strategies as st

from malta import gains
from malta.errors import InputError
from malta.linear.closed_loops import critical_frequency, instability
from malta.linear.open_loops import responses
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.parametric_loops import machine_system
from malta.loops.sampled_laws import machine_law
from malta.loops.uncertain_models import uncertain
from malta.margins.travel import travel_margin
from malta.margins.verify import compensators
from malta.model.plants import plant_of
from malta.proof import Budget
from malta.proof.robust import robust_margin

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.proof.margin import Certificate, Margin
    from malta.synthesis.controller import Controller

SHIPPED = ("table2", "calibrated", "robust")
BOX = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2)


def system(
    functions: Any,
    nominal: Sequence[float],
    *,
    names: tuple[str, ...] | None = None,
    above: float = -math.inf,
) -> UncertainSystem:
    """functions: symbols p -> A, B, C."""
    p = ca.SX.sym("p", len(nominal))
    matrices = ca.Function("f", [p], [ca.densify(ca.SX(M)) for M in functions(p)])
    names = names or tuple(f"p{i}" for i in range(len(nominal)))
    limits = ((above, math.inf),) * len(nominal)
    return UncertainSystem(names, np.array(nominal, dtype=float), matrices, limits)


def static(K: Any, **of: Any) -> Compensator:
    """u = K y."""
    K = np.atleast_2d(np.asarray(K, dtype=float))
    m, p = K.shape
    return Compensator(np.zeros((0, 0)), np.zeros((0, p)), np.zeros((m, 0)), K, **of)


def shipped(name: str) -> tuple[Controller, Plant]:
    c = gains.read(f"design/gains/{name}.json")
    return c, plant_of(c.parameters)


def at_witness(s: UncertainSystem, c: Compensator, m: Margin) -> float:
    """How unstable the witness is, 1/s."""
    assert m.witness is not None
    at = dict(m.witness) | (s.derived.at(m.witness["z"]) if s.derived is not None else {})
    return float(instability(s, c, np.array([at[name] for name in s.names]))[0])


def samples(
    s: UncertainSystem,
    m: Margin,
    ranges: Mapping[str, Any],
    over: Mapping[str, tuple[float, float]],
    k: int,
    seed: int = 0,
) -> FloatArray:
    """Random parameters of the proven box, half of them in its corners."""
    assert m.lower is not None
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (k, len(s.names)))
    u[::2] = np.sign(u[::2])
    p = np.tile(s.nominal, (k, 1))
    for i, name in enumerate(s.names):
        if name in over:
            low, high = over[name]
            p[:, i] = low + (high - low) * (1 + u[:, i]) / 2
        elif name in ranges:
            value, own = ranges[name], s.nominal[i]
            low, high = (
                value if isinstance(value, tuple) else (own - abs(own) * value, own + abs(own) * value)
            )
            p[:, i] = own + m.lower * np.where(u[:, i] > 0, u[:, i] * (high - own), u[:, i] * (own - low))
    if s.derived is not None:
        along = p[:, s.names.index(s.derived.of)]
        p[:, -len(s.derived.intervals) :] = [s.derived.values(z) for z in along.tolist()]
    return p


# Golden cases


@pytest.fixture(scope="module")
def two_masses() -> tuple[UncertainSystem, Compensator]:
    """P = k / (m1 m2 s^4 + k (m1 + m2) s^2), C = 100 ((s + 1) / (0.001 s + 1))^3: MATLAB's example of robstab."""

    def of(p: Any) -> Any:
        m1, m2, k = p[0], p[1], p[2]
        A = ca.SX(4, 4)
        A[0, 2], A[1, 3] = 1, 1
        A[2, 0], A[2, 1], A[3, 0], A[3, 1] = -k / m1, k / m1, k / m2, -k / m2
        return A, ca.vertcat(0, 0, 1 / m1, 0), ca.SX([[0.0, 1, 0, 0]])

    section = control.ss(control.tf([1, 1], [0.001, 1]))
    K = 100 * section * section * section
    s = system(of, [1, 1, 1], names=("m1", "m2", "k"), above=0)
    return s, Compensator(K.A, K.B, -K.C, -K.D)


def test_two_masses_and_a_spring(two_masses: tuple[UncertainSystem, Compensator]) -> None:
    """MATLAB R2023's robstab: 2.8826 .. 2.8864 at 575.034 rad/s, k = 1.5773."""
    s, c = two_masses
    m = robust_margin(s, c, dict.fromkeys(s.names, 0.2))
    assert m.upper == pytest.approx(2.8864, abs=1e-3)
    assert m.lower is not None
    assert 2.8826 <= m.lower <= m.upper
    assert m.frequency == pytest.approx(575.034, abs=0.01)
    assert m.witness is not None
    assert m.witness["k"] == pytest.approx(1.5773, abs=1e-4)
    assert m.work < 5
    assert at_witness(s, c, m) > 0
    assert (instability(s, c, samples(s, m, dict.fromkeys(s.names, 0.2), {}, 2000)) < 0).all()
    tight = robust_margin(s, c, dict.fromkeys(s.names, 0.2), tolerance=1e-5)
    assert tight.lower is not None
    assert tight.upper / tight.lower - 1 < 2e-5


def test_a_time_constant_with_an_asymmetric_range() -> None:
    """1 / (tau s + 1), tau in [0.75, 1.5] about 1: 4, at tau = 0. (MATLAB has answered 3, which is stable.)"""
    s = system(lambda p: (-1 / p[0], 1 / p[0], ca.SX(1)), [1.0], names=("tau",))
    m = robust_margin(s, static(0.0), {"tau": (0.75, 1.5)})
    assert m.lower is not None
    assert 4 * 0.998 <= m.lower < 4
    assert m.upper == pytest.approx(4, rel=1e-6)
    assert m.witness is not None
    assert m.witness["tau"] == pytest.approx(0, abs=1e-6)
    assert m.frequency == math.inf
    assert at_witness(s, static(0.0), m) > 0
    assert m.sensitivity == {"tau": 1.0}


@pytest.fixture(scope="module")
def regulators() -> dict[str, tuple[Plant, Compensator]]:
    found = {}
    for name in SHIPPED:
        c, plant = shipped(name)
        found[name] = plant, compensators(plant, c)["LQR"][0]
    return found


def test_the_published_margin_is_that_of_full_state_feedback(
    regulators: dict[str, tuple[Plant, Compensator]],
) -> None:
    """5/3 of the 20 % box: K_A +33.3 %, K_B -33.3 % at w = 0."""
    plant, c = regulators["table2"]
    s = uncertain(plant, list(BOX), states=True, loaded=False)
    m = robust_margin(s, c, BOX)
    assert m.lower == pytest.approx(5 / 3, rel=1e-3)
    assert m.upper == pytest.approx(5 / 3, rel=1e-5)
    assert m.lower is not None
    assert m.lower < m.upper
    assert m.frequency == 0
    assert m.witness is not None
    assert m.witness["K_A"] == pytest.approx(8626.7 * (1 + 1 / 3), rel=1e-4)
    assert m.witness["K_B"] == pytest.approx(5.2 * (1 - 1 / 3), rel=1e-4)
    assert m.witness["m"] == 0.36
    assert set(m.sensitivity) == {"K_A", "K_B"}
    assert sum(m.sensitivity.values()) == pytest.approx(1)
    assert m.sensitivity["K_B"] == pytest.approx(2 / 3, abs=1e-3)


@pytest.mark.slow
def test_each_parameter_alone_of_full_state_feedback(
    regulators: dict[str, tuple[Plant, Compensator]],
) -> None:
    """K_B down by a half (the LQR's gain margin), K_A doubled, m never."""
    plant, c = regulators["table2"]
    found = {
        name: robust_margin(uncertain(plant, [name], states=True, loaded=False), c, {name: 0.2})
        for name in BOX
    }
    assert found["K_B"].upper == pytest.approx(2.5, rel=1e-3)
    assert found["K_B"].lower == pytest.approx(2.5, rel=1e-3)
    assert found["m"].exhausted
    assert found["m"].lower == pytest.approx(5, rel=2e-4)  # m = 0
    # K_A upwards alone: its lower end is zero attraction, just there
    up = robust_margin(
        uncertain(plant, ["K_A"], states=True, loaded=False), c, {"K_A": (8626.7, 1.2 * 8626.7)}
    )
    assert up.upper == pytest.approx(5, rel=1e-3)
    assert up.lower == pytest.approx(5, rel=1e-3)
    assert found["K_A"].lower == pytest.approx(5, rel=1e-3)
    assert str(found["m"]).endswith("no unstable machine found up to t = 5, where m reaches its limit 0")
    assert not up.searched


def test_full_state_margins_of_the_other_designs(regulators: dict[str, tuple[Plant, Compensator]]) -> None:
    plant, c = regulators["calibrated"]
    m = robust_margin(uncertain(plant, list(BOX), states=True, loaded=False), c, BOX)
    assert m.lower == pytest.approx(3.0, rel=0.01)
    assert m.upper == pytest.approx(3.0, rel=0.01)


def test_the_published_observer_keeps_a_fifth_of_it() -> None:
    """Doyle 1978 on the published machine: a third of the box in place of 5/3."""
    c, plant = shipped("table2")
    law, _ = compensators(plant, c)["LQG"]
    m = robust_margin(uncertain(plant, list(BOX), loaded=False), law, BOX)
    assert m.lower == pytest.approx(0.334, abs=0.005)
    assert m.upper == pytest.approx(0.334, abs=0.005)
    P, _, _, F = responses(uncertain(plant, [], loaded=False), law, np.zeros(0), np.geomspace(1, 1e4, 2000))
    assert np.linalg.norm(np.linalg.inv(np.eye(5) - P @ F), 2, axis=(1, 2)).max() == pytest.approx(
        7, rel=0.05
    )


# Shipped designs on the machine


def _machine(
    name: str, current_loops: Any = "lag", z: float = 0.0, names: Sequence[str] = tuple(BOX)
) -> tuple[UncertainSystem, Compensator]:
    c, plant = shipped(name)
    return machine_system(plant, c, names, {"z": z}, current_loops)


@pytest.mark.slow
@pytest.mark.parametrize("current_loops", ["lag", "pi"])
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_designs_have_the_margin_that_is_proven(name: str, current_loops: Any) -> None:
    s, c = _machine(name, current_loops)
    m = robust_margin(s, c, BOX)
    assert m.lower is not None
    assert 0 < m.upper / m.lower - 1 <= 1e-5
    assert at_witness(s, c, m) > 0
    assert (instability(s, c, samples(s, m, BOX, {}, 1000)) < 0).all()
    assert m.frequency is not None
    p = np.array(list((m.witness or {}).values()))
    assert critical_frequency(s, c, p) == pytest.approx(m.frequency, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["calibrated", "robust"])
def test_the_whole_travel_in_one_proof(name: str) -> None:
    c, plant = shipped(name)
    m = travel_margin(plant, c, BOX)
    s, law = _machine(name, "pi", names=(*BOX, "z"))
    assert m.lower is not None
    assert m.upper / m.lower <= 1.001
    assert at_witness(s, law, m) > 0
    over = {"z": (-15e-3, 15e-3)}
    assert (instability(s, law, samples(s, m, BOX, over, 1000)) < 0).all()
    for z in (0.0, 7e-3, -15e-3):
        here = robust_margin(*_machine(name, "pi", z), BOX)
        assert here.upper >= m.lower
        assert here.lower is not None
        assert m.upper >= m.lower
        assert here.lower <= here.upper
    assert set(m.sensitivity) <= set(BOX)
    assert sum(m.sensitivity.values()) == pytest.approx(1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robust"])
def test_a_hundred_thousand_machines_of_the_proven_box_are_stable(name: str) -> None:
    c, plant = shipped(name)
    m = travel_margin(plant, c, BOX)
    s, law = _machine(name, "pi", names=(*BOX, "z"))
    p = samples(s, m, BOX, {"z": (-15e-3, 15e-3)}, 100_000)
    assert max(float(instability(s, law, part).max()) for part in np.array_split(p, 100)) < 0


def test_stability_that_is_lost_at_zero_frequency(regulators: dict[str, tuple[Plant, Compensator]]) -> None:
    """A grid of frequencies from 1 rad/s on does not see it; the proof covers w = 0."""
    plant, c = regulators["table2"]
    m = robust_margin(
        uncertain(plant, ["K_A", "K_B"], states=True, loaded=False), c, {"K_A": 0.2, "K_B": 0.2}
    )
    assert m.upper == pytest.approx(5 / 3, rel=1e-6)
    assert m.lower == pytest.approx(5 / 3, rel=1e-5)
    assert m.frequency == 0


# Proofs, checked


def cells_of(
    proofs: Sequence[Certificate], s: UncertainSystem, p: FloatArray, rng: np.random.Generator
) -> None:
    """Every frequency with every p of the proven box is in a cell of each group."""
    groups = {tuple(np.round(proof.intervals[:1].ravel(), 300)): proof for proof in proofs}
    assert groups
    for proof in proofs:
        low, high = proof.sides.T
        inverted = np.array(proof.inverted)
        a, b = np.where(inverted, 1 / high, low), np.where(inverted, 1 / low, high)
        inside = ((p >= low) & (p <= high)).all(axis=1)
        v = np.where(inverted, 1 / p, p)
        u = np.where(b > a, (v - a) / np.where(b > a, b - a, 1), 0.5)
        for x, row in zip(10 ** rng.uniform(-30, 30, len(u)), u[inside], strict=False):
            cells, boxes = proof.intervals, proof.boxes
            at = np.where(cells[:, 0] == 0, x, 1 / x)
            there = (cells[:, 1] <= at) & (at <= cells[:, 2])
            near = (boxes[:, :, 0] <= row + 1e-12) & (row - 1e-12 <= boxes[:, :, 1])
            assert (there & near.all(axis=1)).any()
    assert len(s.names) == p.shape[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_certificate_covers_all_frequencies_and_the_whole_box(
    name: str, two_masses: tuple[UncertainSystem, Compensator]
) -> None:
    rng = np.random.default_rng(3)
    loops = [(*_machine(name), BOX), (*two_masses, dict.fromkeys(two_masses[0].names, 0.2))]
    for s, c, box in loops:
        m = robust_margin(s, c, box)
        p = samples(s, replace(m, lower=0.999 * (m.lower or 0)), box, {}, 60)
        assert all(proof.cells >= len(proof.intervals) == len(proof.boxes) > 0 for proof in m.certificate)
        cells_of(m.certificate, s, p, rng)


def test_sampled_proofs_end_at_the_nyquist_frequency() -> None:
    s, c = _machine("table2")
    for proof in robust_margin(s, c, BOX).certificate:
        assert proof.frequencies[0] == 0
        assert proof.frequencies[1] == pytest.approx(np.pi / 50e-6)


# What a margin promises, on small loops made at random


def handmade(seed: int) -> tuple[UncertainSystem, Compensator]:
    """Modes or first-order states whose entries two or three parameters scale, with a random law."""
    rng = np.random.default_rng(seed)
    n, k, second = int(rng.integers(1, 4)), int(rng.integers(2, 4)), bool(rng.integers(2))
    n = min(n, 2) if second else n
    base, moves = -np.diag(rng.uniform(0.5, 3, n)), rng.normal(size=(k, n, n))
    damping = -np.diag(rng.uniform(0.5, 2, n))
    B, C = rng.normal(size=(n, 1)), rng.normal(size=(1, n))

    def of(p: Any) -> Any:
        A = ca.DM(base)
        for i in range(k):
            A = A + p[i] * ca.DM(moves[i])
        b = (1 + 0.5 * p[0]) * ca.DM(B)
        if not second:
            return A, b, C
        top = ca.horzcat(ca.SX(n, n), ca.SX.eye(n))
        return (
            ca.vertcat(top, ca.horzcat(A, ca.DM(damping))),
            ca.vertcat(ca.SX(n, 1), b),
            np.hstack([C, 0 * C]),
        )

    T = None if rng.integers(2) else 0.3
    states = int(rng.integers(0, 3))
    A = -np.diag(rng.uniform(1, 4, states))
    if T is not None:
        A = np.diag(np.exp(np.diag(A) * T)) if states else A
    c = Compensator(
        A, rng.normal(size=(states, 1)), rng.normal(size=(1, states)) * 0.3, rng.normal(size=(1, 1)) * 0.3,
        sample_time=T, delay=0 if T is None else int(rng.integers(0, 3)), lag=[None, 5.0][int(rng.integers(2))],
    )  # fmt: skip
    return system(of, [0.0] * k), c


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 100_000))
def test_no_machine_of_a_proven_box_is_unstable(seed: int) -> None:
    s, c = handmade(seed)
    assume(instability(s, c, s.nominal)[0] < -1e-3)
    ranges = {name: (-1.0, 0.5 + 0.4 * i) for i, name in enumerate(s.names)}
    m = robust_margin(s, c, ranges, budget=Budget(cells=4000))
    if m.lower is None:
        assert m.reason
        return
    assert m.lower <= m.upper
    assert (instability(s, c, samples(s, m, ranges, {}, 400, seed)) < 0).all()
    if not m.exhausted:
        assert at_witness(s, c, m) >= -50 * EPS  # on the boundary a pole is zero, to rounding
        assert m.witness is not None
        p = np.array(list(m.witness.values()))
        low, high = np.array([ranges[name] for name in s.names]).T
        reached = np.maximum(p / high, p / low).max()
        assert reached == pytest.approx(m.upper, rel=1e-6)
        if not m.reason:
            assert m.upper / m.lower < 1.01


@pytest.mark.slow
def test_stability_is_lost_inside_a_face() -> None:
    """Least damped in the middle of a side: the corners say nothing, the proof gets stuck there and finds it."""
    for edge in (0.6, -0.25):

        def of(p: Any, edge: float = edge) -> Any:
            A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-1, -(0.5 + 2 * (p[0] - edge) ** 2 - 0.5 * p[1])))
            return A, ca.SX([0, 1]), ca.SX([[1, 0]])

        s = system(of, [0.0, 0.0])
        m = robust_margin(s, static(0.0), {"p0": (-1.0, 1.0), "p1": (-1.0, 1.0)})
        assert m.lower is not None
        assert m.lower <= 1.0 <= m.upper  # p1 = 1 at p0 = edge
        assert m.upper / m.lower < 1.0012
        assert m.witness is not None
        assert m.witness["p0"] == pytest.approx(edge, abs=0.02)
        assert m.sensitivity["p1"] > 0.97
        assert (
            instability(s, static(0.0), samples(s, m, {"p0": (-1.0, 1.0), "p1": (-1.0, 1.0)}, {}, 2000)) < 0
        ).all()


def test_asymmetric_ranges_and_intervals_that_stay() -> None:
    """m q'' = -(k + 2) q - q': a stiffness that loses at k = -2, by hand."""

    def of(p: Any) -> Any:
        A = ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-p[1] / p[0], 0))
        return A, ca.vertcat(0, 1 / p[0]), ca.SX([[1.0, 0], [0, 1]])

    s, c = system(of, [1.0, 1.0], names=("m", "k")), static([[-2.0, -1.0]])
    cases: tuple[tuple[dict[str, Any], Any, float], ...] = (
        ({"k": (0.0, 5.0)}, None, 3.0),
        ({"k": (0.5, 1.0)}, None, 6.0),
        ({"m": 0.2, "k": (0.0, 1.0)}, None, 3.0),
        ({"m": (0.9, 1.5)}, {"k": (-1.9, 30.0)}, 10.0),
    )
    for ranges, over, upper in cases:
        m = robust_margin(s, c, ranges, over)
        assert m.upper == pytest.approx(upper, rel=1e-5)
        assert m.lower == pytest.approx(upper, rel=1e-3)
    unstable = robust_margin(s, c, {"m": 0.2}, {"k": (-2.5, 1.0)})
    assert (unstable.lower, unstable.upper) == (0.0, 0.0)
    assert unstable.witness is not None
    assert unstable.witness["k"] == -2.5
    assert unstable.reason == "the nominal loop is unstable"
    assert str(unstable) == "nothing proven (the nominal loop is unstable), lost at 0.00 %"
    m = robust_margin(s, c, {"m": 0.2}, {"k": (-1.0, 30.0)})
    assert m.upper == pytest.approx(5, rel=1e-5)  # m = 0


def test_groups_do_not_depend_on_units() -> None:
    """Two first-order states that couple both ways, one of them in units of a billionth: lost at p0 p1 = 1."""
    for unit in (1, 1e9, 1e-9):

        def of(p: Any, unit: float = unit) -> Any:
            A = ca.vertcat(ca.horzcat(-1, p[0] * unit), ca.horzcat(p[1] / unit, -1))
            return A, ca.SX([0, 0]), ca.SX([[0, 0]])

        s = system(of, [0.1, 0.1])
        m = robust_margin(s, static(0.0), {"p0": (-0.9, 1.1), "p1": (-0.9, 1.1)})
        assert m.upper == pytest.approx(0.9, rel=1e-5)
        assert m.lower == pytest.approx(0.9, rel=1.1e-3)


def test_a_slowly_sampled_loop_is_lost_at_the_nyquist_frequency() -> None:
    """An integrator p / s under a hold with gain 10 and T = 0.1 s: z = 1 - p, lost at p = 2."""
    s = system(lambda p: (ca.SX([[0.0]]), p[0], ca.SX([[1.0]])), [1.0])
    m = robust_margin(s, static(-10.0, sample_time=0.1), {"p0": (0.9, 1.5)})
    assert m.upper == pytest.approx(2.0, rel=1e-5)
    assert m.lower == pytest.approx(2.0, rel=1.1e-3)
    assert m.frequency == pytest.approx(np.pi / 0.1, rel=1e-3)


@pytest.mark.slow
def test_parameters_of_the_geometry_and_twins() -> None:
    """l_B enters squared, I_xx stands for I_yy as well, z couples: all of it in one proof."""
    c, plant = shipped("calibrated")
    names = ["I_xx", "l_B", "K_A", "z"]
    s, law = uncertain(plant, names, loaded=False), machine_law(plant, c, "lag")
    ranges: dict[str, float | tuple[float, float]] = {"I_xx": 0.2, "l_B": 0.1, "K_A": 0.2, "z": (-5e-3, 5e-3)}
    m = robust_margin(s, law, ranges)
    assert m.lower is not None
    assert 1 < m.lower < m.upper <= 1.001 * m.lower
    assert at_witness(s, law, m) > 0
    assert (instability(s, law, samples(s, m, ranges, {}, 1000)) < 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["table2", pytest.param("calibrated", marks=pytest.mark.slow)])
def test_shares_are_what_the_margin_loses_with_a_range(name: str) -> None:
    """-d ln margin / d ln range by differences; together one, as a scaled box has a margin scaled back."""
    s, c = _machine(name)
    m = robust_margin(s, c, BOX)
    for key in BOX:
        more, less = (robust_margin(s, c, BOX | {key: 0.2 * f}).upper for f in (1.001, 0.999))
        share = -(math.log(more) - math.log(less)) / (math.log(1.001) - math.log(0.999))
        assert m.sensitivity.get(key, 0.0) == pytest.approx(share, abs=2e-3)
    assert sum(m.sensitivity.values()) == pytest.approx(1)


def test_an_unstable_loop_has_no_margin() -> None:
    s, c = _machine("table2")
    weak = Compensator(
        c.A, c.B, 0.3 * c.C, 0.3 * c.D, integrals=c.integrals, sample_time=c.sample_time, delay=1
    )
    m = robust_margin(s, weak, BOX)
    assert (m.lower, m.upper, m.reason) == (0.0, 0.0, "the nominal loop is unstable")
    assert not m.exhausted


@pytest.mark.parametrize(
    ("ranges", "over", "part"),
    [
        ({}, None, "at least one"),
        ({"K_X": 0.2}, None, "an unknown parameter"),
        ({"m": 0.2}, {"q": (0.0, 1.0)}, "an unknown parameter"),
        ({"m": 0.0}, None, "at least one uncertain parameter"),
        ({"m": -0.2}, None, "a share of 0 or more"),
        ({"m": math.nan}, None, "a share of 0 or more"),
        ({"m": math.inf}, None, "a share of 0 or more"),
        ({"m": (0.2, math.nan)}, None, "about the nominal 0.36"),
        ({"m": (0.4, 0.5)}, None, "about the nominal 0.36"),
        ({"m": (0.36, 0.36)}, None, "at least one uncertain parameter"),
        ({"m": (0.5, 0.1)}, None, "about the nominal 0.36"),
        ({"m": 0.2}, {"m": (0.3, 0.4)}, "in one of them"),
    ],
)
def test_bad_ranges_get_one_sentence(ranges: Any, over: Any, part: str) -> None:
    s, c = _machine("table2")
    with pytest.raises(InputError) as caught:
        robust_margin(s, c, ranges, over)
    assert part in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.slow
def test_a_proof_that_is_given_up_says_where() -> None:
    s, c = _machine("calibrated")
    m = robust_margin(s, c, BOX, budget=Budget(cells=3))
    assert m.lower is None or m.lower < 0.9 * m.upper
    assert re.search(r"not settled within \d+ cells, near", m.reason)
    assert not m.exhausted
    assert at_witness(s, c, m) > 0


@pytest.mark.parametrize("more", [1e-4, 1e-5, 1e-6])
def test_groups_that_differ_a_little_are_proven_each(more: float) -> None:
    """Two modes at 20 kHz, the second a little less stable: its margin is the loop's, to less than they differ."""
    K = np.diag([1e4, 1e4 * (1 + more)])

    def of(p: Any) -> Any:
        A = ca.vertcat(ca.horzcat(ca.SX(2, 2), ca.SX.eye(2)), ca.horzcat(p[0] * ca.DM(K), ca.SX(2, 2)))
        return A, ca.vertcat(ca.SX(2, 2), ca.SX.eye(2)), np.eye(4)

    s = system(of, [1.0])
    c = static(np.hstack([-2e4 * np.eye(2), -200 * np.eye(2)]), sample_time=50e-6, delay=1, lag=3000.0)
    m = robust_margin(s, c, {"p0": 0.2})
    assert m.lower is not None
    p = np.array([[1 + 0.2 * m.lower]])
    assert instability(s, c, p)[0] < 0
    assert m.lower < m.upper
