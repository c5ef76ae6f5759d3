"""Margins of many parameters by multipliers: chains of masses and springs, and random sampled loops."""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from scipy import linalg

import malta
from malta.linear.closed_loops import instability
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.proof.box import Box, box_of
from malta.proof.multipliers import BlockSizes, Branch, Multiplier, excludes_zero, multiplier, response
from malta.proof.multipliers.pencil import LEVELS, gains_of_level
from malta.proof.multipliers.structured import Structured, rows_of
from malta.proof.problem import OfLoop
from malta.proof.robust import law_of, problem_of
from malta.synthesis.riccati import care, dare
from malta.work import WorkUp, work_limit

pytestmark = pytest.mark.first

Loop = tuple[UncertainSystem, Compensator]


def chain(n: int, T: float | None) -> Loop:
    """n masses and springs under a force on the last one, and an LQG law; all parameters are 1."""

    def of(p: Any) -> Any:
        m, k, A = [p[i] for i in range(n)], [p[n + i] for i in range(n)], ca.SX(2 * n, 2 * n)
        for i in range(n):
            A[i, n + i] = 1
            A[n + i, i] -= k[i] / m[i]
            A[n + i, n + i] -= 0.002 * k[i] / m[i]
            if i:
                A[n + i, i - 1] += k[i] / m[i]
                A[n + i - 1, i] += k[i] / m[i - 1]
                A[n + i - 1, i - 1] -= k[i] / m[i - 1]
        B, C = ca.SX(2 * n, 1), ca.SX(1, 2 * n)
        B[2 * n - 1], C[0, n - 1] = 1 / m[n - 1], 1
        return A, B, C

    system = malta.uncertain(of, {f"p{i}": 1.0 for i in range(2 * n)})
    A, B, C = (np.array(M) for M in system.matrices(np.ones(2 * n)))
    weight, solve = 0.1 * np.eye(2 * n), care if T is None else dare
    if T is not None:
        held = linalg.expm(T * np.block([[A, B], [np.zeros((1, 2 * n + 1))]]))
        A, B = held[:-1, :-1], held[:-1, -1:]
    K = solve(A, B, weight, np.eye(1)).K
    L = solve(A.T, C.T, weight + B @ B.T, 0.01 * np.eye(1)).K.T
    return system, Compensator(A - B @ K - L @ C, L, -K, np.zeros((1, 1)), sample_time=T)


def ranges(system: UncertainSystem, share: float = 0.1) -> dict[str, float]:
    return dict.fromkeys(system.names, share)


def asked(loop: Loop, share: float = 0.1) -> Structured:
    system, law = loop
    box = box_of(system.names, system.nominal, system.limits, ranges(system, share), {})
    problem = problem_of(system, law_of(system, law))
    assert isinstance(problem, OfLoop)
    rows = rows_of(problem)
    assert rows is not None
    return Structured(rows, box)


def stable_within(loop: Loop, box: Box, t: float, count: int = 2000) -> bool:
    """Corners and places inside of box(t)."""
    rng = np.random.default_rng(0)
    sides = box.sides(t)
    u = rng.uniform(0, 1, (count, len(sides)))
    u[::2] = rng.integers(0, 2, u[::2].shape)
    return bool((instability(*loop, sides[:, 0] + u * (sides[:, 1] - sides[:, 0])) < 0).all())


@pytest.mark.parametrize("T", [None, 0.1, 1.5, 2.1])
def test_pencils_hold_the_loop_all_over_their_box(T: float | None) -> None:
    system, law = chain(2, T)
    s = asked((system, Compensator(law.A, law.B, law.C, law.D, sample_time=T, delay=2 if T else 0)))
    rng, sides = np.random.default_rng(1), s.box.sides(1.7)
    whole = s.rows[0].over(sides)
    assert whole is not None
    for _ in range(20):
        delta = rng.uniform(-1, 1, 4)
        p = sides.mean(axis=1) + delta * (sides[:, 1] - sides[:, 0]) / 2
        point = s.rows[0].over(np.column_stack([p, p]))
        assert point is not None
        for wide, narrow in ((whole.constant, point.constant), (whole.linear, point.linear)):
            moved = wide.middle + np.tensordot(delta, wide.slopes, 1)
            assert (np.abs(moved - narrow.middle) <= wide.rest + narrow.rest).all()


@pytest.mark.parametrize("T", [None, 0.1, 1.5, 2.1])
def test_pencils_are_singular_at_the_poles(T: float | None) -> None:
    system, law = chain(2, T)
    s = asked((system, law))
    p = np.array([1.1, 0.9, 0.8, 1.2])
    pencil = s.rows[0].over(np.column_stack([p, p]))
    assert pencil is not None
    for v in linalg.eigvals(-pencil.constant.middle, pencil.linear.middle):
        if abs(v) < 1e8:
            pole = v if T is None else (1 + v) / (1 - v)
            poles = linalg.eigvals(_matrix(system, law, p))
            assert np.abs(poles - pole).min() < 1e-6 * (1 + abs(pole))


def _matrix(system: UncertainSystem, law: Compensator, p: Any) -> Any:
    """Of the closed loop: x', or x+."""
    A, B, C = (np.array(M) for M in system.matrices(p))
    if law.sample_time is not None:
        n = len(A)
        held = linalg.expm(law.sample_time * np.block([[A, B], [np.zeros((1, n + 1))]]))
        A, B = held[:n, :n], held[:n, n:]
    return np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])


def test_fractions_come_close_to_a_hold() -> None:
    """Y / 2 coth(Y / 2) - 1 is the fraction of a level and a remainder, whose terms are no larger than the whole's."""
    whole, y = np.array(gains_of_level(0)), 1.7
    for level in range(LEVELS + 1):
        z, held = y / 2, 0.0
        for k in range(level, 0, -1):
            held = z * z / (2 * k + 1 + held)
        left = np.array(gains_of_level(level))
        beyond = float(left @ y ** (2.0 * np.arange(1, len(left) + 1)))
        assert held + beyond == pytest.approx(z / math.tanh(z) - 1, rel=1e-14)
        assert (left[:level] == 0).all()
        assert (left[level:] * whole[level:] > 0).all()
        assert (np.abs(left) <= np.abs(whole)).all()


def test_slower_samples_have_more_levels() -> None:
    found = []
    for T in (0.1, 0.5, 1.5, 1.8):
        (rows,) = asked(chain(2, T)).rows
        found.append(rows._level(np.ones(4)))
    assert found == sorted(found)
    assert (found[0], found[-1]) == (1, LEVELS)


@pytest.mark.parametrize("T", [None, 0.1])
def test_responses_hold_over_their_interval(T: float | None) -> None:
    s = asked(chain(2, T))
    pencil = s.rows[0].over(s.box.sides(1.0))
    assert pencil is not None
    own = Branch(pencil, 0, 0.5)
    wide = response(own, 0.48, 0.5)
    assert wide is not None
    for t in np.linspace(-1, 1, 9):
        x = 0.49 + 0.01 * t
        point = response(own, x, x)
        assert point is not None
        N = wide.terms[0] + t * wide.terms[1] + t * t * wide.terms[2]
        assert (np.abs(N - point.terms[0]) <= wide.rest + point.rest + 1e-12).all()


def test_multipliers_of_one_repeated_parameter_are_exact() -> None:
    """1 - delta N is singular for real delta at the real eigenvalues of N alone."""
    N = np.array([[0.0, 2.0], [-2.0, 0.0]]) + 0.5 * np.eye(2)
    _, beta = multiplier(N.astype(complex), BlockSizes((2,)), None, 0.0, 1e-3)
    assert beta < 0.1
    _, beta = multiplier(np.diag([0.5, -0.8]).astype(complex), BlockSizes((2,)), None, 0.0, 1e-3)
    assert beta == pytest.approx(0.8, rel=1e-2)


def test_multipliers_of_another_structure_are_not_taken() -> None:
    """One of 1 - N diag(a, a, b) passes F > 0 for 1 - N diag(a, b, b) too, of which it proves nothing."""
    s = asked(chain(2, None))
    taken: list[BlockSizes] = []
    for cell in s.cover(1.0):
        own = s._branch(cell)
        assert own is not None
        blocks = own.channels[0].blocks
        size = blocks.size
        other = BlockSizes((size,))  # full matrices, that show more than there is
        D = np.eye(size) + 0j
        _, near, done = s._level(replace(cell, near=Multiplier(D, 0 * D, other)))
        if done and near is not None:
            taken.append(near.blocks)
            assert near.blocks == blocks
    assert taken


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "T", "t"),
    [
        (3, None, 2.0),
        (3, 0.1, 1.5),
        (3, 1.5, 0.4),
        (7, None, 0.5),
        pytest.param(3, 0.5, 1.6, marks=pytest.mark.slow),
    ],
)
def test_chains_are_stable_where_it_is_proven(n: int, T: float | None, t: float) -> None:
    """Six and fourteen parameters."""
    loop = chain(n, T)
    s = asked(loop)
    assert s.raise_bound(t) == t
    assert stable_within(loop, s.box, t)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("n", "T", "t", "lost"),
    [
        (3, None, 6.63, 6.639),
        pytest.param(3, 0.1, 6.4, 6.442, marks=pytest.mark.slow),
        pytest.param(4, None, 6.5, 6.524, marks=pytest.mark.slow),
    ],
)
def test_wide_chains_are_proven_to_within_a_percent(n: int, T: float | None, t: float, lost: float) -> None:
    """Six and eight parameters of 10 % each: at the corner of light masses on stiff springs they are lost."""
    loop = chain(n, T)
    s = asked(loop)
    assert s.raise_bound(t) == t
    assert s.count < 8000
    assert stable_within(loop, s.box, t)
    if n == 3:
        corner = np.array([1 - 0.1 * lost] * 3 + [1 + 0.1 * lost] * 3)
        assert instability(*loop, corner[None])[0] > 0


@pytest.mark.slow
def test_multipliers_that_move_with_frequency_exclude_zero_all_along_it() -> None:
    """F(t) > 0 with N, D and G of every t, and with D and G that stand on a narrower interval alone."""
    s = asked(chain(3, None))
    (own,) = (c for c in s.cover(5.0) if c.branch == 0 and c.low <= 1.2 < c.high)
    branch = s._branch(own)
    assert branch is not None
    blocks, widths = branch.channels[0].blocks, []
    for constant in (False, True):
        width = 0.2
        while True:
            low, high = 1.2, 1.2 + width
            r, x, half = response(branch, low, high), 1.2 + width / 2, width / 2
            if r is not None:
                m, beta = multiplier(r.terms[0], blocks, None, 1.0, along=r.terms[1] / half)
                assert beta < 1
                m = m._replace(x=x, slopes=None if constant else m.slopes)
                if excludes_zero(r, m, half):
                    break
            width /= 2
        widths.append(width)
        for t in np.linspace(-1, 1, 7):
            at = m.at(x + t * half)
            N = r.terms[0] + t * r.terms[1] + t * t * r.terms[2]
            turned = 1j * at.G @ N
            F = at.D - N.conj().T @ at.D @ N - turned - turned.conj().T
            assert linalg.eigvalsh(F).min() > 0
            assert linalg.eigvalsh(at.D).min() > 0
    assert widths[0] >= 2 * widths[1]


@pytest.mark.slow
def test_a_proof_goes_on_where_its_work_ended_it() -> None:
    loop = chain(2, None)
    whole, parts = asked(loop), asked(loop)
    assert whole.raise_bound(3.0) == 3.0
    for k in range(40):
        with work_limit(0.02 * 1.3**k), suppress(WorkUp):
            if parts.raise_bound(3.0, 0.02 * 1.3**k) == 3.0:
                break
    assert parts.lower == 3.0
    assert stable_within(loop, parts.box, 3.0)


@pytest.mark.slow
def test_no_box_is_proven_that_holds_an_unstable_loop() -> None:
    loop = chain(3, None)
    m = malta.robust_margin(*loop, ranges(loop[0]), budget=malta.proof.Budget(2))
    s = asked(loop)
    assert m.lower is not None
    assert m.lower <= m.upper
    with work_limit(1.0), suppress(WorkUp):
        s.raise_bound(1.2 * m.upper, 1.0)
    assert s.lower < m.upper


def test_parts_of_a_box_without_a_pencil_are_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """However narrow they are, nothing is computed on them: halving ends, and nothing is proven."""
    s = asked(chain(2, None))
    monkeypatch.setattr(Structured, "_branch", lambda *_: None)
    assert s.raise_bound(1.0) == 0.0
    assert 20 < s.count < 2000


@pytest.mark.slow
def test_fourteen_parameters_have_a_bound_in_half_a_minute_and_four_gigabytes() -> None:
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    pages = int(Path("/proc/self/statm").read_text().split()[0])  # that tests before it left
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (4 << 30), before[1]))
    try:
        loop = chain(7, 0.1)
        m = malta.robust_margin(*loop, ranges(loop[0]), budget=malta.proof.Budget(30))
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)
    assert m.lower is not None
    assert 0.2 < m.lower <= m.upper
    assert m.work < 36
    assert stable_within(loop, asked(loop).box, m.lower)


@pytest.mark.slow_for("4", "6")
@pytest.mark.parametrize("count", [2, 4, 6])
def test_eight_states_over_twelve_decades(count: int) -> None:
    """Four masses of a gram on springs of 1e5 N/m, states counted in units from 1e-6 to 1e6: settled at once."""
    n, units = 4, np.array([1e-6, 1e-3, 1, 1e3, 1e6, 1e-2, 1e2, 1e4])

    def of(p: Any) -> Any:
        m, k = [p[i] * 1e-3 for i in range(n)], [p[n + i] * 1e5 for i in range(n)]
        A, B, C = ca.SX(2 * n, 2 * n), ca.SX(2 * n, 1), ca.SX(1, 2 * n)
        for i in range(n):
            A[i, n + i] = 1
            A[n + i, i] -= k[i] / m[i]
            A[n + i, n + i] -= 2e-7 * k[i] / m[i]
            if i:
                A[n + i, i - 1] += k[i] / m[i]
                A[n + i - 1, i] += k[i] / m[i - 1]
                A[n + i - 1, i - 1] -= k[i] / m[i - 1]
        B[2 * n - 1], C[0, n - 1] = 1 / m[n - 1], 1
        to, back = ca.DM(np.diag(units)), ca.DM(np.diag(1 / units))
        return to @ A @ back, to @ B, C @ back

    names = [*(f"m{i}" for i in range(n)), *(f"k{i}" for i in range(n))]
    system = malta.uncertain(of, dict.fromkeys(names, 1.0))
    A, B, C = (np.array(M) for M in system.matrices(np.ones(2 * n)))
    back, to = np.diag(1 / units), np.diag(units)
    A, B, C = back @ A @ to, back @ B, C @ to
    K = care(A, B, np.diag([1e4] * n + [1e-4] * n), 1e-4 * np.eye(1)).K
    L = care(A.T, C.T, 1e-2 * np.eye(2 * n) + 1e2 * B @ B.T, 1e-8 * np.eye(1)).K.T
    law = Compensator(A - B @ K - L @ C, L, -K, np.zeros((1, 1)))
    chosen = names[: count // 2] + names[n : n + count // 2]
    m = malta.robust_margin(system, law, dict.fromkeys(chosen, 0.1), budget=malta.proof.Budget(20.0))
    assert m.lower is not None
    assert m.upper <= 1.001 * m.lower
    assert m.upper == pytest.approx({2: 1.6833, 4: 0.5107, 6: 0.2838}[count], rel=1e-3)


def random_sampled(seed: int) -> tuple[Loop, float] | None:
    """2 to 4 states and parameters, affine or one of them inverted, LQG at 2 to 100 samples in the fastest period."""
    rng = np.random.default_rng(seed)
    n, count = int(rng.integers(2, 5)), int(rng.integers(2, 5))
    A0, B0, C0 = rng.normal(size=(n, n)), rng.normal(size=(n, 1)), rng.normal(size=(1, n))
    A0 -= (linalg.eigvals(A0).real.max() + rng.uniform(-0.3, 0.6)) * np.eye(n)
    dA = rng.normal(size=(count, n, n)) * 0.4 * (rng.random((count, n, n)) < 0.35)
    dB = rng.normal(size=(count, n, 1)) * 0.3 * (rng.random((count, n, 1)) < 0.3)
    inverted = int(rng.integers(0, 2 * count))

    def of(p: Any) -> Any:
        q = [1 / p[i] if i == inverted else p[i] for i in range(count)]
        A, B = A0 - dA.sum(axis=0), B0 - dB.sum(axis=0)
        for i in range(count):
            A, B = A + dA[i] * q[i], B + dB[i] * q[i]
        return A, B, C0

    system = malta.uncertain(of, {f"p{i}": 1.0 for i in range(count)})
    T = 2 * math.pi / float(np.abs(linalg.eigvals(A0)).max()) / 10 ** rng.uniform(0.3, 2)
    held = linalg.expm(T * np.block([[A0, B0], [np.zeros((1, n + 1))]]))
    A, B = held[:n, :n], held[:n, n:]
    late = int(rng.integers(0, 2))
    if late:
        A, B = np.block([[A, B], [np.zeros((1, n + 1))]]), np.vstack([np.zeros((n, 1)), [[1.0]]])
    C = np.hstack([C0, np.zeros((1, late))])
    try:
        K = dare(A, B, np.eye(len(A)) * 10 ** rng.uniform(-2, 1), np.eye(1)).K
        L = dare(A.T, C.T, 0.1 * np.eye(len(A)), np.eye(1) * 10 ** rng.uniform(-2, 1)).K.T
    except malta.CheckError:
        return None
    law = Compensator(A - B @ K - L @ C, L, -K, np.zeros((1, 1)), sample_time=T, delay=late)
    stable = instability(system, law, np.ones((1, count)))[0] < -1e-6 / T
    return ((system, law), float(rng.choice([0.05, 0.1, 0.2]))) if stable else None


@pytest.mark.slow
def test_random_sampled_loops_have_a_bound() -> None:
    """All of these, whatever they sample at; none is unstable in its proven box."""
    asked_for, without = 0, 0
    for seed in range(16):
        made = random_sampled(seed)
        if made is None:
            continue
        loop, share = made
        asked_for += 1
        m = malta.robust_margin(*loop, ranges(loop[0], share), budget=malta.proof.Budget(15.0))
        without += m.lower is None
        if m.lower is not None:
            assert m.lower <= m.upper
            system = loop[0]
            box = box_of(system.names, system.nominal, system.limits, ranges(system, share), {})
            assert stable_within(loop, box, m.lower, 400)
    assert asked_for >= 10
    assert without == 0
