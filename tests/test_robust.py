"""Robust stability margins: golden cases, proofs repeated in other arithmetic, and what a margin promises."""

from __future__ import annotations

import functools
import itertools
import math
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from malta import gains
from malta.chain import compensators
from malta.data import plant_of
from malta.enclose import characteristic_values, enclosure, polynomial
from malta.errors import InputError
from malta.robust import _blocks, _box, _prove, robust_margin
from malta.uncertain import Compensator, UncertainSystem, critical, instability, responses, uncertain
from malta.verify import machine_law, travel_margin

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from malta.controller import Controller
    from malta.plant import FloatArray, Plant
    from malta.robust import Certificate, Margin

SHIPPED = ("table2", "calibrated", "robust")
BOX = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.2)


def system(
    functions: Any,
    nominal: Sequence[float],
    *,
    second_order: bool = False,
    names: tuple[str, ...] | None = None,
    above: float = -math.inf,
) -> UncertainSystem:
    """functions: symbols p -> A, B, C."""
    p = ca.SX.sym("p", len(nominal))
    matrices = ca.Function("f", [p], [ca.densify(ca.SX(M)) for M in functions(p)])
    names = names or tuple(f"p{i}" for i in range(len(nominal)))
    limits = ((above, math.inf),) * len(nominal)
    return UncertainSystem(names, np.array(nominal, dtype=float), matrices, second_order, limits)


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
    return float(instability(s, c, np.array([m.witness[name] for name in s.names]))[0])


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
    s = system(of, [1, 1, 1], second_order=True, names=("m1", "m2", "k"), above=0)
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
    assert m.seconds < 5
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
    s = uncertain(plant, list(BOX), states=True)
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


def test_each_parameter_alone_of_full_state_feedback(
    regulators: dict[str, tuple[Plant, Compensator]],
) -> None:
    """K_B down by a half (the LQR's gain margin), K_A doubled, m never."""
    plant, c = regulators["table2"]
    found = {name: robust_margin(uncertain(plant, [name], states=True), c, {name: 0.2}) for name in BOX}
    assert found["K_B"].upper == pytest.approx(2.5, rel=1e-3)
    assert found["K_B"].lower == pytest.approx(2.5, rel=1e-3)
    assert found["m"].exhausted
    assert found["m"].lower == pytest.approx(5, rel=2e-4)  # m = 0
    # K_A upwards alone: its lower end is zero attraction, just there
    up = robust_margin(uncertain(plant, ["K_A"], states=True), c, {"K_A": (8626.7, 1.2 * 8626.7)})
    assert up.upper == pytest.approx(5, rel=1e-3)
    assert up.lower == pytest.approx(5, rel=1e-3)
    assert found["K_A"].lower == pytest.approx(5, rel=1e-3)
    assert "as the parameters exist" in str(found["m"])


def test_full_state_margins_of_the_other_designs(regulators: dict[str, tuple[Plant, Compensator]]) -> None:
    plant, c = regulators["calibrated"]
    m = robust_margin(uncertain(plant, list(BOX), states=True), c, BOX)
    assert m.lower == pytest.approx(3.0, rel=0.01)
    assert m.upper == pytest.approx(3.0, rel=0.01)


def test_the_published_observer_keeps_a_fifth_of_it() -> None:
    """Doyle 1978 on the published machine: a third of the box in place of 5/3."""
    c, plant = shipped("table2")
    law, _ = compensators(plant, c)["LQG"]
    m = robust_margin(uncertain(plant, list(BOX)), law, BOX)
    assert m.lower == pytest.approx(0.334, abs=0.005)
    assert m.upper == pytest.approx(0.334, abs=0.005)
    P, F = responses(uncertain(plant, []), law, np.zeros(0), np.geomspace(1, 1e4, 2000))
    assert np.linalg.norm(np.linalg.inv(np.eye(5) - P @ F), 2, axis=(1, 2)).max() == pytest.approx(
        7, rel=0.05
    )


# Shipped designs on the machine


def _machine(
    name: str, current_loops: Any = "lag", z: float = 0.0, names: Sequence[str] = tuple(BOX)
) -> tuple[UncertainSystem, Compensator]:
    c, plant = shipped(name)
    return uncertain(plant, names, at={"z": z}), machine_law(plant, c, current_loops)


@pytest.mark.parametrize("current_loops", ["lag", "pi"])
@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_designs_have_the_margin_that_is_proven(name: str, current_loops: Any) -> None:
    s, c = _machine(name, current_loops)
    m = robust_margin(s, c, BOX)
    assert m.lower is not None
    single = all(len(b.states) == 1 for b in _blocks(s, c, _box(s, BOX, {})))
    assert single == (name != "calibrated")
    assert 0 < m.upper / m.lower - 1 <= (1e-6 if single else 1e-3)
    assert at_witness(s, c, m) > 0
    assert m.seconds < 5
    assert (instability(s, c, samples(s, m, BOX, {}, 1000)) < 0).all()
    assert m.frequency is not None
    p = np.array(list((m.witness or {}).values()))
    assert critical(s, c, p) == pytest.approx(m.frequency, rel=1e-3)


@pytest.mark.parametrize("name", SHIPPED)
def test_the_whole_travel_in_one_proof(name: str) -> None:
    c, plant = shipped(name)
    m = travel_margin(plant, c, BOX)
    s, law = _machine(name, names=(*BOX, "z"))
    assert m.lower is not None
    assert m.upper / m.lower <= 1.001
    assert m.seconds < 5
    assert at_witness(s, law, m) > 0
    over = {"z": (-15e-3, 15e-3)}
    assert (instability(s, law, samples(s, m, BOX, over, 1000)) < 0).all()
    for z in (0.0, 7e-3, -15e-3):
        here = robust_margin(uncertain(plant, list(BOX), at={"z": z}), law, BOX)
        assert here.upper >= m.lower
        assert here.lower is not None
        assert m.upper >= m.lower
        assert here.lower <= here.upper
    assert set(m.sensitivity) <= set(BOX)
    assert sum(m.sensitivity.values()) == pytest.approx(1)


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_hundred_thousand_machines_of_the_proven_box_are_stable(name: str) -> None:
    c, plant = shipped(name)
    m = travel_margin(plant, c, BOX)
    s, law = _machine(name, names=(*BOX, "z"))
    p = samples(s, m, BOX, {"z": (-15e-3, 15e-3)}, 100_000)
    assert max(float(instability(s, law, part).max()) for part in np.array_split(p, 100)) < 0


def test_the_closed_form_is_what_branch_and_bound_finds(monkeypatch: pytest.MonkeyPatch) -> None:
    """Single modes by the second route: the same witness and a proof that agrees."""
    for name in ("table2", "robust"):
        s, c = _machine(name)
        exact = robust_margin(s, c, BOX)
        with monkeypatch.context() as patch:
            patch.setattr("malta.robust._at_crossovers", lambda *_: None)
            other = robust_margin(s, c, BOX, tolerance=1e-5)
        assert other.upper == pytest.approx(exact.upper, rel=2e-6)
        assert other.frequency == pytest.approx(exact.frequency, rel=1e-3)
        assert other.lower is not None
        assert exact.lower is not None
        assert other.lower <= exact.upper
        assert exact.lower <= other.upper
        assert other.upper / other.lower < 1.0001
        for key, share in exact.sensitivity.items():
            assert other.sensitivity[key] == pytest.approx(share, abs=1e-3)


def test_a_grid_of_frequencies_without_zero_promises_what_is_not_so(
    regulators: dict[str, tuple[Plant, Compensator]],
) -> None:
    """Where stability is first lost at w = 0, a search from 1 rad/s on does not see it. The proof has no such gap."""
    plant, c = regulators["table2"]
    s = uncertain(plant, ["K_A", "K_B"], states=True)
    ranges = {"K_A": 0.2, "K_B": 0.2}
    m = robust_margin(s, c, ranges)
    grid = np.geomspace(10, 1e5, 400)

    def lost(t: float) -> bool:
        """A root of f on the grid, at any corner, where f's phase along the box's edge turns through zero."""
        box = _box(s, ranges, {})
        found = False
        for block in _blocks(s, c, box):
            p = np.array(
                [s.nominal + t * np.array(d) * s.nominal * 0.2 for d in ((1, -1), (-1, 1), (1, 1), (-1, -1))]
            )
            f = characteristic_values(block, p, grid)
            span = np.angle(f / f.mean(axis=1, keepdims=True))
            found |= bool((span.max(axis=1) - span.min(axis=1) >= np.pi).any())
        return found

    naive = next((t for t in np.arange(0.1, 4.9, 0.05) if lost(t)), 4.9)
    assert m.upper == pytest.approx(5 / 3, rel=1e-4)
    assert naive > 2.5


# Proofs, checked


def cells_of(proof: Certificate, k: int, rng: np.random.Generator) -> None:
    """Every frequency with every box, once: volumes add up in each octave, and random points are in a cell."""
    cells, boxes = proof.intervals, proof.boxes
    volume = (boxes[:, :, 1] - boxes[:, :, 0]).prod(axis=1) * (cells[:, 2] - cells[:, 1])
    low = cells[cells[:, 0] == 0]
    end = low[:, 2].max()
    assert low[:, 1].min() == 0
    assert proof.frequencies[0] == 0
    assert ((boxes >= 0) & (boxes <= 1)).all()
    edges = [0.0, *(end * 2.0 ** np.arange(-24, 1))]
    for a, b in itertools.pairwise(edges):
        inside = (cells[:, 0] == 0) & (cells[:, 1] >= a) & (cells[:, 2] <= b)
        assert volume[inside].sum() == pytest.approx(b - a, rel=1e-9)
    if math.isinf(proof.frequencies[1]):
        high = cells[:, 0] == 1
        assert cells[high, 1].min() == 0
        assert volume[high].sum() == pytest.approx(1 / end, rel=1e-9)
    else:
        assert proof.frequencies[1] == pytest.approx(end)
    for w, u in zip(end * 10 ** -rng.uniform(0, 8, k), rng.uniform(size=(k, boxes.shape[1])), strict=True):
        held = (cells[:, 0] == 0) & (cells[:, 1] <= w) & (w <= cells[:, 2])
        assert (held & (boxes[:, :, 0] <= u).all(axis=1) & (u <= boxes[:, :, 1]).all(axis=1)).any()


@pytest.mark.parametrize("name", SHIPPED)
def test_a_certificate_covers_all_frequencies_and_the_whole_box(
    name: str, two_masses: tuple[UncertainSystem, Compensator]
) -> None:
    rng = np.random.default_rng(3)
    c, plant = shipped(name)
    proofs = [*robust_margin(*_machine(name), BOX).certificate, *travel_margin(plant, c, BOX).certificate]
    spring, law = two_masses
    proofs += robust_margin(spring, law, dict.fromkeys(spring.names, 0.2)).certificate
    for proof in proofs:
        assert proof.cells >= len(proof.intervals) == len(proof.boxes) > 0
        cells_of(proof, 50, rng)


def test_sampled_proofs_end_at_the_nyquist_frequency() -> None:
    s, c = _machine("table2")
    for proof in robust_margin(s, c, BOX).certificate:
        assert proof.frequencies[0] == 0
        assert proof.frequencies[1] == pytest.approx(np.pi / 50e-6)


@pytest.mark.parametrize(
    ("name", "mode"), [("table2", 0), ("table2", 3), ("table2", 2), ("robust", 0), ("robust", 2)]
)
def test_proofs_hold_in_ball_arithmetic(name: str, mode: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Zero is outside of a single mode's f on every cell of its certificate: other formulas, rigorous arithmetic.

    A mode is q'' = a q + b u, sampled exactly with its lag: y = b phi(a, z) F(z) y. It loses stability where
    1 / (phi F) = b: a real number in the range that the parameters leave b at this a. Law and phi are rational in
    delta = (z - 1) / T, their coefficients are found in balls.
    """
    flint = pytest.importorskip("flint")
    monkeypatch.setattr(flint.ctx, "prec", 160)
    acb, arb, acb_mat, acb_poly = flint.acb, flint.arb, flint.acb_mat, flint.acb_poly
    s, c = _machine(name)
    m = robust_margin(s, c, BOX)
    box = _box(s, BOX, {})
    assert m.lower is not None
    assert c.sample_time is not None
    assert c.lag is not None
    T, lag, low, high = arb(c.sample_time), acb(c.lag), *box.sides(m.lower).T
    blocks = _blocks(s, c, box)
    k = next(i for i, block in enumerate(blocks) if block.states == (mode,))
    own, proof = blocks[k].own, m.certificate[k]
    A, B, C = (M[0] for M in s.at(s.nominal))
    stiffness, B, C = float(A[5 + mode, mode]), B[5 + mode], C[:, mode]
    heavy, strong = (
        (None if mode == 3 else 0),
        (2 if mode == 2 else 3),
    )  # which parameter is the inertia, the force
    # the law as num / den
    x = [[(acb(v) - int(i == j)) / T for j, v in enumerate(row)] for i, row in enumerate(own.A.tolist())]
    into = [acb(v) / T for v in (own.B @ C).tolist()]
    out = [acb(v) for v in (B @ own.C).tolist()]

    def ball(a: float, b: float) -> Any:
        return arb(a).union(arb(b))

    def fraction(A: Any, into: Any, out: Any) -> tuple[Any, Any]:
        """out (delta - A)^-1 into as numerator and denominator."""
        n = len(into)
        closed = acb_mat([[A[i][j] - into[i] * out[j] for j in range(n)] for i in range(n)])
        own = acb_poly(acb_mat(A).charpoly())
        return acb_poly(closed.charpoly()) - own, own

    num, den = fraction(x, into, out)
    num += den * acb(float(B @ own.D @ C))

    series = flint.acb_series

    @functools.cache
    def mode_at(low: float, high: float) -> Any:
        """phi of the stiffnesses in an interval, and of its middle: coefficients with their derivatives.

        By the exponential of mode, lag and held input; [[M, M'], [0, M]] gives the derivative beside it.
        """
        found = []
        for wide in (ball(low, high), arb(ball(low, high).mid())):
            M = [[acb(0)] * 8 for _ in range(8)]
            for k in (0, 4):
                M[k][k + 1] = M[k + 1][k + 2] = acb(1)
                M[k + 1][k], M[k + 2][k + 2], M[k + 2][k + 3] = acb(wide * stiffness), -lag, lag
            M[1][4] = acb(stiffness)
            E = (acb_mat(M) * acb(T)).exp()
            E = [
                [series([E[i, j] - int(i == j), E[i, 4 + j]], 2) / acb(T) for j in range(4)] for i in range(3)
            ]
            (_, b, e), (_, g, h), (_, n, o) = (row[:3] for row in E)
            u, v, y = (row[3] for row in E)
            first = [
                u * (g * o - h * n) + v * (e * n - b * o) + y * (b * h - e * g),
                v * b + y * e - u * (g + o),
                u,
            ]
            found.append((first, cubic(E)))
        return found

    def cubic(A: Any) -> list[Any]:
        """det(d - A) of 3 x 3, of series."""
        minors = [A[i][i] * A[j][j] - A[i][j] * A[j][i] for i, j in ((0, 1), (0, 2), (1, 2))]
        third = A[1][0] * A[2][1] - A[1][1] * A[2][0]
        det = A[0][0] * (A[1][1] * A[2][2] - A[1][2] * A[2][1]) + A[0][2] * third
        det -= A[0][1] * (A[1][0] * A[2][2] - A[1][2] * A[2][0])
        return [-det, minors[0] + minors[1] + minors[2], -(A[0][0] + A[1][1] + A[2][2]), series([1], 2)]

    def value(polynomial: Any, d: Any) -> Any:
        total = acb(0)
        for k in reversed(polynomial):
            total = d * total + k
        return total

    numerator, denominator = num.coeffs(), den.coeffs()

    def wanted(w: Any, phi: Any) -> Any:
        """1 / (phi F), of balls or of series."""
        z = (w * (acb(0, 1) * acb(T))).exp()
        d = (z - 1) / acb(T)
        late = acb(1)
        for _ in range(c.delay):
            late = late * z
        return value(phi[1], d) * (value(denominator, d) * late) / (value(phi[0], d) * value(numerator, d))

    def excluded(w: Any, a: tuple[float, float], b: Any) -> bool:
        """Whether 1 / (phi F) is in b nowhere in the intervals of w and a. By the mean value theorem."""
        w0, a0, (anywhere, middle) = arb(w.mid()), arb(ball(*a).mid()), mode_at(*a)
        fixed = [[k[0] for k in polynomial] for polynomial in anywhere]
        try:
            q = wanted(acb(w0), middle)[0] + wanted(series([acb(w), 1], 2), fixed)[1] * (w - w0)
            if stiffness:
                q += wanted(acb(w), anywhere)[1] * (ball(*a) - a0)
        except ValueError:  # a division by what may be zero
            return False
        return not q.imag.contains(0) or not q.real.overlaps(b)

    for (_, w0, w1), unit in zip(proof.intervals.tolist(), proof.boxes, strict=True):
        ends = [
            (float(a + (b - a) * u), float(a + (b - a) * v))
            for a, b, (u, v) in zip(low, high, unit, strict=True)
        ]
        relative = [(arb(x) / n, arb(y) / n) for (x, y), n in zip(ends, s.nominal.tolist(), strict=True)]
        mass = (arb(1), arb(1)) if heavy is None else relative[heavy]
        attraction = relative[1]
        force = relative[strong]
        # a = attraction / mass, subdivided; at a, mass is attraction / a: b = force / mass
        first = (float((attraction[0] / mass[1]).lower()), float((attraction[1] / mass[0]).upper()))
        stack = [(w0, w1, *(first if stiffness else (1.0, 1.0)), 0)]
        while stack:
            wa, wb, aa, ab, depth = stack.pop()
            inertia = mass[0].union(mass[1])
            if stiffness and heavy is not None:
                least = max(float(mass[0].lower()), float((attraction[0] / ab).lower()))
                most = min(float(mass[1].upper()), float((attraction[1] / aa).upper()))
                if least > most:
                    continue
                inertia = ball(least, most)
            if excluded(ball(wa, wb), (aa, ab), force[0].union(force[1]) / inertia):
                continue
            assert depth < 80, (wa, wb, aa, ab)
            if not stiffness or depth % 2 == 0:
                stack += [(wa, (wa + wb) / 2, aa, ab, depth + 1), ((wa + wb) / 2, wb, aa, ab, depth + 1)]
            else:
                stack += [(wa, wb, aa, (aa + ab) / 2, depth + 1), (wa, wb, (aa + ab) / 2, ab, depth + 1)]
    cells_of(proof, 20, np.random.default_rng(0))


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
    return system(of, [0.0] * k, second_order=second), c


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 100_000))
def test_no_machine_of_a_proven_box_is_unstable(seed: int) -> None:
    s, c = handmade(seed)
    assume(instability(s, c, s.nominal)[0] < -1e-3)
    ranges = {name: (-1.0, 0.5 + 0.4 * i) for i, name in enumerate(s.names)}
    m = robust_margin(s, c, ranges, most_cells=4000)
    if m.lower is None:
        assert m.reason
        return
    assert m.lower <= m.upper
    assert (instability(s, c, samples(s, m, ranges, {}, 400, seed)) < 0).all()
    if not m.exhausted:
        assert at_witness(s, c, m) > 0
        assert m.witness is not None
        p = np.array(list(m.witness.values()))
        low, high = np.array([ranges[name] for name in s.names]).T
        reached = np.maximum(p / high, p / low).max()
        assert reached == pytest.approx(m.upper, rel=1e-6)
        if c.sample_time is None:  # sampled ten times slower than their poles, images leave a gap
            assert m.upper / m.lower < 1.05


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

    s, c = system(of, [1.0, 1.0], second_order=True, names=("m", "k")), static([[-2.0, -1.0]])
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
    m = robust_margin(s, c, {"m": 0.2}, {"k": (-1.0, 30.0)})
    assert m.upper == pytest.approx(5, rel=1e-5)  # m = 0


def test_f_that_is_no_polynomial_has_a_witness_but_no_proof() -> None:
    s = system(
        lambda p: (
            ca.vertcat(ca.horzcat(0, 1), ca.horzcat(-1, 0.2 * ca.exp(p[0]) - 1)),
            ca.SX([0, 1]),
            ca.SX([[1, 0]]),
        ),
        [0.0],
    )
    m = robust_margin(s, static(0.0), {"p0": (-1.0, 1.0)})
    assert m.lower is None
    assert m.upper == pytest.approx(math.log(5), rel=1e-6)
    assert m.frequency == pytest.approx(1, rel=1e-6)
    assert "p0 enters neither as a polynomial" in m.reason
    assert str(m).startswith("nothing proven, lost at 160.94 %")


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


def test_parameters_of_the_geometry_and_twins() -> None:
    """l_B enters squared, I_xx stands for I_yy as well, z couples: all of it in one proof."""
    c, plant = shipped("calibrated")
    names = ["I_xx", "l_B", "K_A", "z"]
    s, law = uncertain(plant, names), machine_law(plant, c, "lag")
    ranges: dict[str, float | tuple[float, float]] = {"I_xx": 0.2, "l_B": 0.1, "K_A": 0.2, "z": (-5e-3, 5e-3)}
    m = robust_margin(s, law, ranges)
    assert m.lower is not None
    assert 1 < m.lower < m.upper <= 1.001 * m.lower
    assert at_witness(s, law, m) > 0
    assert (instability(s, law, samples(s, m, ranges, {}, 1000)) < 0).all()


def test_shares_are_what_the_margin_loses_with_a_range() -> None:
    """-d ln margin / d ln range by differences; together one, as a scaled box has a margin scaled back."""
    for name in ("table2", "calibrated"):
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
        ({"m": 0.0}, None, "a share above 0"),
        ({"m": -0.2}, None, "a share above 0"),
        ({"m": math.nan}, None, "a share above 0"),
        ({"m": math.inf}, None, "a share above 0"),
        ({"m": (0.2, math.nan)}, None, "about the nominal 0.36"),
        ({"m": (0.4, 0.5)}, None, "about the nominal 0.36"),
        ({"m": (0.36, 0.36)}, None, "about the nominal 0.36"),
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


def test_a_proof_that_is_given_up_says_where() -> None:
    s, c = _machine("calibrated")
    m = robust_margin(s, c, BOX, most_cells=3)
    assert m.lower is None
    assert "not settled within 3 cells, near" in m.reason
    assert not m.exhausted
    assert at_witness(s, c, m) > 0


def test_a_box_beyond_the_witness_is_not_proven() -> None:
    """_prove on a box that holds an unstable plant, single and coupled: refused, with a place nearby."""
    for name in ("table2", "calibrated"):
        s, c = _machine(name)
        m, box = robust_margin(s, c, BOX), _box(s, BOX, {})
        refused = 0
        for block in _blocks(s, c, box):
            poly = polynomial(block, box.names, box.sides(1.01 * m.upper))
            assert not isinstance(poly, str)
            proved = _prove(enclosure(block, box.nominal, box.sides(1.01 * m.upper), poly), 20_000, None)
            refused += isinstance(proved, tuple)
        assert refused


@pytest.mark.parametrize("more", [1e-4, 1e-5, 1e-6])
def test_groups_that_differ_a_little_are_proven_each(more: float) -> None:
    """Two modes at 20 kHz, the second a little less stable: its margin is the loop's, to less than they differ."""
    K = np.diag([1e4, 1e4 * (1 + more)])

    def of(p: Any) -> Any:
        A = ca.vertcat(ca.horzcat(ca.SX(2, 2), ca.SX.eye(2)), ca.horzcat(p[0] * ca.DM(K), ca.SX(2, 2)))
        return A, ca.vertcat(ca.SX(2, 2), ca.SX.eye(2)), np.eye(4)

    s = system(of, [1.0], second_order=True)
    c = static(np.hstack([-2e4 * np.eye(2), -200 * np.eye(2)]), sample_time=50e-6, delay=1, lag=3000.0)
    m = robust_margin(s, c, {"p0": 0.2})
    assert m.lower is not None
    p = np.array([[1 + 0.2 * m.lower]])
    assert instability(s, c, p)[0] < 0
    assert m.lower < m.upper
