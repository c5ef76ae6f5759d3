"""Riccati equations: closed forms, textbook cases, any units and weights, two solvers, 600 bits, bad input."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import control
import numpy as np
import pytest
from conditions import EPS, of_gain
from hypothesis import given, settings, strategies as st
from scipy import linalg
from scipy.integrate import quad_vec

import malta
from malta.linear.matrices import eigenvalues
from malta.linear.sampling import delay_inputs, sample, sample_cost, sample_noise
from malta.synthesis import riccati
from malta.synthesis.riccati import RESIDUAL, Solver, care, dare

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.linearize import LinearModel


@pytest.mark.slow
@given(
    sign=st.sampled_from([-1, 0, 1]),
    w=st.floats(1, 1e4),
    m=st.floats(1e-3, 1e3),
    r=st.floats(1e-6, 1e6),
    weight=st.floats(-8, 8),
    damping=st.floats(0, 10),
)
def test_one_mode_has_a_closed_form(
    sign: int, w: float, m: float, r: float, weight: float, damping: float
) -> None:
    """m x'' = k x + u: K1 = k + sqrt(k^2 + q1/r), K2 = sqrt(q2/r + 2 m K1), k = +-m w^2 or 0."""
    k = sign * m * w**2
    q1 = r * (m * w**2) ** 2 * 10 ** (weight if sign > 0 else abs(weight))
    q2 = damping * q1 / w**2
    A, B = np.array([[0, 1], [k / m, 0]]), np.array([[0], [1 / m]])
    solution = care(A, B, np.diag([q1, q2]), np.array([[r]]))
    K1 = k + math.hypot(k, math.sqrt(q1 / r))
    assert solution.K[0] == pytest.approx([K1, math.sqrt(q2 / r + 2 * m * K1)], rel=1e-6)


@pytest.mark.parametrize("variance", [7e-10, 1e-13, 1e-15, 1e-18, 1e-24])
def test_kalman_filter_at_any_sensor_variance_in_SI(model: LinearModel, variance: float) -> None:
    """Unscaled solvers fail from 1e-13 m2 on: slycot silently, scipy with an error."""
    W = model.B * np.array([2.55e-3] * 4 + [4.95e-3]) @ model.B.T
    V = variance * np.eye(5)
    continuous = care(model.A.T, model.C.T, W, V)
    assert continuous.residual <= RESIDUAL
    poles = eigenvalues(model.A - continuous.K.T @ model.C)
    assert poles.real.max() < 0
    # z'' = w with force noise s_f: all poles of the axial pair at sqrt(s_f / (m s_z)), 45 degrees
    expected = math.sqrt(math.sqrt(4.95e-3 / variance) * model.force_map[2, 4])
    axial = eigenvalues(
        model.A[np.ix_([2, 7], [2, 7])] - continuous.K.T[np.ix_([2, 7], [4])] @ np.array([[1, 0]])
    )
    assert axial == pytest.approx(expected * np.exp(1j * np.pi * np.array([0.75, -0.75])), rel=1e-9)
    Ts = 50e-6
    Ad, _ = sample(model.A, model.B, Ts)
    sampled = dare(Ad.T, model.C.T, sample_noise(model.A, W * Ts, Ts), V)
    assert sampled.residual <= RESIDUAL
    assert np.abs(eigenvalues(Ad - sampled.K.T @ model.C)).max() < 1


def test_the_solution_is_symmetric_positive_and_satisfies_the_equation(design: Design) -> None:
    A, B, w = design.model.A, design.model.B, design.spec.weights
    X, K, residual = care(A, B, w.Q, w.R)
    assert residual <= RESIDUAL
    assert np.array_equal(X, X.T)
    assert linalg.eigvalsh(X).min() > 0
    assert pytest.approx(np.linalg.solve(w.R, B.T @ X), rel=1e-9, abs=1e-9) == K


def test_scipy_and_slycot_agree_where_both_are_right(model: LinearModel, designs: dict[str, Design]) -> None:
    pytest.importorskip("slycot", reason="slycot is not installed")
    w = designs["table2"].spec.weights
    ours = care(model.A, model.B, w.Q, w.R)
    X, _, K = control.care(model.A, model.B, w.Q, w.R, method="slycot")
    assert pytest.approx(K, abs=1e-6 * np.abs(K).max()) == ours.K
    assert pytest.approx(X, abs=1e-6 * np.abs(X).max()) == ours.X
    Ad, Bd = sample(model.A, model.B, 50e-6)
    w = designs["calibrated"].spec.weights
    sampled = dare(Ad, Bd, w.Q * 50e-6, w.R * 50e-6)
    _, _, K = control.dare(Ad, Bd, w.Q * 50e-6, w.R * 50e-6, method="slycot")
    assert pytest.approx(K, abs=1e-6 * np.abs(K).max()) == sampled.K


def test_slycot_in_the_environment_changes_nothing(
    model: LinearModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """control prefers slycot when it is installed, whose filter may be off by a thousandth at 1e-13 m2."""
    slycot = pytest.importorskip("slycot", reason="slycot is not installed")
    for solver in ("sb02md", "sb02mt", "sb02od", "sg02ad", "sb03md57"):
        monkeypatch.delattr(slycot, solver)
    W = model.B * np.array([2.55e-3] * 4 + [4.95e-3]) @ model.B.T
    riccati._solution_of.cache_clear()
    ours = care(model.A.T, model.C.T, (W + W.T) / 2, 1e-13 * np.eye(5)).K.T
    assert eigenvalues(model.A - ours @ model.C).real.max() < -500


@pytest.mark.parametrize(("q", "sigma"), [(60.0, 60.0), (1000.0, 1000.0)])
def test_doyle_1978_lqg_has_no_guaranteed_margin(q: float, sigma: float) -> None:
    """Doyle's example: K = f [1 1], L = d [1 1]', f = 2 + sqrt(4 + q), d = 2 + sqrt(4 + sigma), for A = [1 1; 0 1].

    With an actuator gain m the loop is stable only for 1 - 1/(d f) < m < 1 + 1/(d f) (1 - (d + f - 4) / ...): both
    bounds close in on 1 as q and sigma grow. The lower order coefficients of the characteristic polynomial are
    d + f - 4 + 2 (m - 1) d f and 1 + (1 - m) d f.
    """
    A, B, C = np.array([[1.0, 1], [0, 1]]), np.array([[0.0], [1]]), np.array([[1.0, 0]])
    K = care(A, B, q * np.ones((2, 2)), np.eye(1)).K
    L = care(A.T, C.T, sigma * np.ones((2, 2)), np.eye(1)).K.T
    f, d = 2 + math.sqrt(4 + q), 2 + math.sqrt(4 + sigma)
    assert pytest.approx(np.array([[f, f]]), rel=1e-9) == K
    assert pytest.approx(np.array([[d], [d]]), rel=1e-9) == L

    def stable(m: float) -> bool:
        loop = np.block([[A, -m * B @ K], [L @ C, A - B @ K - L @ C]])
        return bool(eigenvalues(loop).real.max() < 0)

    upper = 1 + 1 / (d * f)
    lower = 1 - (d + f - 4) / (2 * d * f)
    assert stable(1.0)
    assert stable(1 + 0.99 * (upper - 1))
    assert not stable(1 + 1.01 * (upper - 1))
    assert not stable(lower - 1e-6)
    assert upper - 1 < 0.011


@pytest.mark.parametrize("Ts", [50e-6, 1e-3])
def test_van_loan_equals_quadrature(model: LinearModel, designs: dict[str, Design], Ts: float) -> None:
    w = designs["calibrated"].spec.weights
    A, B = model.A, model.B

    def integrand(s: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        Ad, Bd = sample(A, B, s) if s else (np.eye(10), np.zeros((10, 5)))
        both = np.hstack([Ad, Bd])
        held = np.hstack([np.zeros((5, 10)), np.eye(5)])
        return np.asarray(both.T @ w.Q @ both + held.T @ w.R @ held)

    Q, N, R = sample_cost(A, B, w.Q, w.R, Ts)
    expected, _ = quad_vec(integrand, 0, Ts, epsrel=1e-12)
    found = np.block([[Q, N], [N.T, R]])
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((found - expected) / scale).max() < 1e-9
    W = B @ B.T

    def spread(s: float) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        return np.asarray(linalg.expm(A * s) @ W @ linalg.expm(A * s).T)

    noise, _ = quad_vec(spread, 0, Ts, epsrel=1e-12)
    scale = np.sqrt(np.outer(np.diag(noise), np.diag(noise)))
    assert np.abs((sample_noise(A, W, Ts) - noise) / scale).max() < 1e-9


def test_sampled_gains_become_the_continuous_ones(model: LinearModel, designs: dict[str, Design]) -> None:
    """lqrd and kalmd converge to lqr and lqe, linearly in Ts."""
    w = designs["calibrated"].spec.weights
    continuous = care(model.A, model.B, w.Q, w.R).K
    errors = []
    for Ts in (40e-6, 20e-6, 10e-6):
        Q, N, R = sample_cost(model.A, model.B, w.Q, w.R, Ts)
        K = dare(*sample(model.A, model.B, Ts), Q, R, N).K
        errors.append(np.abs(K - continuous).max() / np.abs(continuous).max())
    assert errors[0] < 0.03
    assert errors[0] / errors[1] == pytest.approx(2, abs=0.05)
    assert errors[1] / errors[2] == pytest.approx(2, abs=0.05)


def test_delayed_inputs_act_late() -> None:
    Ad, Bd = np.array([[0.5]]), np.array([[2.0, 3.0]])
    A, B = delay_inputs(Ad, Bd, 3)
    state = np.zeros(7)
    seen = []
    for k in range(6):
        u = np.array([1.0, 10.0]) if k == 0 else np.zeros(2)
        state = A @ state + B @ u
        seen.append(state[0])
    assert seen == [0, 0, 0, 32, 16, 8]


def test_systems_that_do_not_touch_are_solved_apart(design: Design) -> None:
    """Gains between the planes x-beta, y-alpha and the axis z are zero, not small."""
    K = malta.synthesis.lqr(design.model, design.spec.weights)
    groups = [({0, 4, 5, 9}, {0, 2}), ({1, 3, 6, 8}, {1, 3}), ({2, 7}, {4})]
    for states, inputs in groups:
        outside = [i for i in range(10) if i not in states]
        assert not K[np.ix_(sorted(inputs), outside)].any()
        assert K[np.ix_(sorted(inputs), sorted(states))].all()


def test_bad_input_is_named() -> None:
    A, B, Q, R = np.eye(2), np.eye(2), np.eye(2), np.eye(2)
    nan = np.array([[1, np.nan], [0, 1]])
    cases = [
        ((A[:1], B, Q, R), "A"),
        ((nan, B, Q, R), "A"),
        ((A, B, Q[:, :1], R), "Q"),
        ((A, B, np.array([[1.0, 0.5], [0, 1]]), R), "Q"),
        ((A, B, Q, -R), "R"),
    ]
    for solve in (care, dare):
        for arguments, field in cases:
            with pytest.raises(malta.InputError, match=f": {field}: found"):
                solve(*arguments)


def test_costs_that_no_input_bounds_are_named() -> None:
    """A singular weight needs an input that moves something; a continuous one has to be definite."""
    A, Q = np.eye(2), np.eye(2)
    with pytest.raises(malta.InputError, match="R: found a matrix that is not positive definite"):
        care(A, np.eye(2), Q, np.zeros((2, 2)))
    with pytest.raises(malta.InputError, match="R: found a matrix that is not positive definite"):
        dare(A, np.zeros((2, 1)), Q, np.zeros((1, 1)))
    with pytest.raises(malta.CheckError):  # X = 1 twice: the loop of X is on the boundary
        care(A, np.eye(2), -Q, np.eye(2))


@pytest.mark.parametrize("solve", [care, dare])
def test_no_stabilizing_solution_is_a_failed_check(solve: type) -> None:
    """An unstable state that no input reaches."""
    A, B = np.diag([2.0, 0.5]), np.array([[0.0], [1.0]])
    with pytest.raises(malta.CheckError):
        solve(A, B, np.eye(2), np.eye(1))


@pytest.mark.parametrize("Ts", [10.0, 1e300])
def test_sampling_that_overflows_is_a_failed_check(model: LinearModel, Ts: float) -> None:
    A, B = model.A, model.B
    for sampled in (
        lambda: sample(A, B, Ts),
        lambda: sample_cost(A, B, np.eye(10), np.eye(5), Ts),
        lambda: sample_noise(A, np.eye(10), Ts),
    ):
        with pytest.raises(malta.CheckError, match="no sample time of this length for so fast a machine"):
            sampled()


@pytest.mark.parametrize("matrix", [np.array([[math.inf]]), np.array([[math.nan]])])
def test_eigenvalues_beyond_all_floats_are_a_failed_check(
    matrix: np.ndarray[tuple[int, int], np.dtype[np.float64]],
) -> None:
    with pytest.raises(malta.CheckError, match="overflow"):
        eigenvalues(matrix)


PENDULUM = np.array([[0.0, 1], [100, 0]])
PUSH = np.array([[0.0], [1]])


def exact_gain(A: FloatArray, B: FloatArray, Q: FloatArray, r: float) -> FloatArray:
    """The gain of one input from the stable eigenvectors of the symplectic matrix, in 600 bits."""
    flint = pytest.importorskip("flint")
    n, before, flint.ctx.prec = len(A), flint.ctx.prec, 600
    try:
        a, b, q = (flint.acb_mat([[flint.acb(v) for v in row] for row in M.tolist()]) for M in (A, B, Q))
        back, weight = a.transpose().inv(), flint.acb_mat([[flint.acb(r)]])
        g = -b * weight.inv() * b.transpose() * back
        blocks = ((a - g * q, g), (-back * q, back))
        pencil = [[M[i, k] for M in row for k in range(n)] for row in blocks for i in range(n)]
        poles, vectors = flint.acb_mat(pencil).eig(right=True, algorithm="approx")
        stable = [k for k in range(2 * n) if abs(complex(poles[k])) < 1]
        assert len(stable) == n
        upper, lower = (
            flint.acb_mat([[vectors[h + i, k] for k in stable] for i in range(n)]) for h in (0, n)
        )
        bX = b.transpose() * lower * upper.inv()
        K = (weight + bX * b).inv() * bX * a
        return np.array([[float(K[0, k].real) for k in range(n)]])
    finally:
        flint.ctx.prec = before


def test_a_pendulum_under_weak_weights() -> None:
    """scipy's pencil leaves a residual of 1e-7 here: on the scales that fit X, Q is a tiny fraction of it."""
    A, B = sample(PENDULUM, PUSH, 0.01)
    Q, R = np.diag([1, 0.01]) * 0.01, np.array([[1e2]])
    solution = dare(A, B, Q, R)
    assert solution.residual < 10 * EPS
    off = np.abs(exact_gain(A, B, Q, 1e2) - solution.K)
    assert (off <= of_gain(A, B, Q, R, solution.X, sampled=True)).all()


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("Ts", [1e-4, 1e-3, 1e-2, 1e-1])
def test_a_pendulum_at_any_sample_time_and_weight(sign: int, Ts: float) -> None:
    """Standing and hanging, R over twelve decades, beside eigenvectors in 600 bits.

    A residual below 1e-13 is left as scipy has it: which ones are, rounding decides, and the gain is as good as each.
    """
    A, B = sample(PENDULUM * np.array([[1], [sign]]), PUSH, Ts)
    Q = np.diag([1, 0.01]) * Ts
    for r in 10.0 ** np.arange(-4, 9) * Ts:
        R = np.array([[r]])
        X, K, residual = dare(A, B, Q, R)
        assert residual <= riccati.REFINED_RESIDUAL
        off = np.abs(exact_gain(A, B, Q, r) - K)
        assert (off <= of_gain(A, B, Q, R, X, sampled=True, residual=residual)).all()


@pytest.mark.slow
@settings(deadline=None)
@given(
    modes=st.lists(st.floats(-4, 4), min_size=1, max_size=3),
    coupling=st.floats(-1, 1),
    decades=st.lists(st.floats(-6, 6), min_size=9, max_size=9),
    clock=st.floats(-9, 9),
    weight=st.floats(-6, 8),
    Ts=st.floats(0.01, 1),
)
def test_units_do_not_matter(
    modes: list[float], coupling: float, decades: list[float], clock: float, weight: float, Ts: float
) -> None:
    """Coupled masses on springs of either sign: the gain in other units is the gain, in other units.

    x = t x', u = s u', time counts in w. Weights of ordinary size are compared with scipy, in units of one.
    """
    k = len(modes)
    stiffness = np.diag(modes) + coupling * (np.ones((k, k)) - np.eye(k))
    A = np.block([[np.zeros((k, k)), np.eye(k)], [stiffness, -0.1 * np.eye(k)]])
    B = np.vstack([np.zeros((k, k)), np.eye(k)])
    Q, R = np.eye(2 * k), (np.eye(k) + np.ones((k, k))) * 10**weight
    t, s, w = 10.0 ** np.array(decades[: 2 * k]), 10.0 ** np.array(decades[6 : 6 + k]), 10**clock
    Ad, Bd = sample(A, B, Ts)

    def gain(solve: Callable[..., Any], A: FloatArray, B: FloatArray, w: float) -> FloatArray:
        scaled = A * t / t[:, None] * w, B * s / t[:, None] * w, Q * t**2 * w, R * np.outer(s, s) * w
        return np.asarray(solve(*scaled).K * s[:, None] / t)

    if abs(weight) < 3:
        X, Xd = linalg.solve_continuous_are(A, B, Q, R), linalg.solve_discrete_are(Ad, Bd, Q, R)
        K, Kd = np.linalg.solve(R, B.T @ X), np.linalg.solve(R + Bd.T @ Xd @ Bd, Bd.T @ Xd @ Ad)
    else:
        K, Kd = care(A, B, Q, R).K, dare(Ad, Bd, Q, R).K
    assert gain(care, A, B, w) == pytest.approx(K, abs=1e-7 * np.abs(K).max())
    assert gain(dare, Ad, Bd, 1.0) == pytest.approx(Kd, abs=1e-7 * np.abs(Kd).max())


def test_an_equation_that_was_solved_is_remembered() -> None:
    """A weight of another axis leaves it; its own weight does not."""
    A, B = np.kron(np.eye(2), PENDULUM), np.kron(np.eye(2), PUSH)
    known = riccati._solution_of.cache_info
    care(A, B, np.diag([1, 0.011, 1, 0.012]), 1e-3 * np.eye(2))
    before = known()
    found = care(A, B, np.diag([1, 0.011, 1, 0.013]), 1e-3 * np.eye(2))
    assert (known().hits - before.hits, known().misses - before.misses) == (1, 1)
    alone = care(PENDULUM, PUSH, np.diag([1, 0.011]), 1e-3 * np.eye(1))
    assert np.array_equal(found.K[:1, :2], alone.K)


@pytest.fixture
def solved_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """No solution is remembered: parts of the solver are replaced."""
    monkeypatch.setattr(riccati, "_solution_of", riccati._solution_of.__wrapped__)


@pytest.mark.usefixtures("solved_anew")
@pytest.mark.parametrize("solver", ["python-control", "scipy"])
@pytest.mark.parametrize("solve", [care, dare])
def test_what_the_solver_leaves_is_refined(
    solve: Callable[..., Any], solver: Solver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a solution that is off by what its condition allows; one by 0.1 % is refused, or by 30 %."""
    A, B = (PENDULUM, PUSH) if solve is care else sample(PENDULUM, PUSH, 0.01)
    Q, R = np.diag([1, 0.01]), np.array([[1e-3]])
    right, first = solve(A, B, Q, R, solver=solver), riccati._library_solution
    for off in (1 - 1e-8, 1 + 1e-7):
        monkeypatch.setattr(riccati, "_library_solution", lambda *a, off=off, **k: first(*a, **k) * off)
        X, K, residual = solve(A, B, Q, R, solver=solver)
        assert residual < 1e-15
        assert pytest.approx(right.X, rel=1e-11) == X
        assert pytest.approx(right.K, rel=1e-11) == K
    for off in (0.999, 1.3):
        monkeypatch.setattr(riccati, "_library_solution", lambda *a, off=off, **k: first(*a, **k) * off)
        with pytest.raises(
            malta.CheckError, match=f": the solution of {solver} is .* from its refinement, and "
        ):
            solve(A, B, Q, R, solver=solver)


@pytest.mark.usefixtures("solved_anew")
@pytest.mark.parametrize("Ts", [1e-1, 1e-3, 1e-5])
def test_a_sampled_equation_has_the_solution_of_a_continuous_one(
    Ts: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both ways give the gain, and the second still does where the sample is short and the weight weak."""
    A, B = sample(PENDULUM, PUSH, Ts)
    Q, R = np.diag([1, 0.01]) * Ts, np.array([[1e-3]]) * Ts
    exact = exact_gain(A, B, Q, R[0, 0])
    assert pytest.approx(exact, rel=1e-9) == dare(A, B, Q, R).K

    def refuses(*_: Any) -> FloatArray:
        raise np.linalg.LinAlgError("Reordering of (A, B) failed")

    monkeypatch.setattr(riccati, "_symplectic", refuses)
    assert pytest.approx(exact, rel=1e-9) == dare(A, B, Q, R).K
    monkeypatch.setattr(riccati, "_refine", lambda found: found)
    assert pytest.approx(exact, rel=1e-8) == dare(A, B, Q, R).K


@pytest.mark.usefixtures("solved_anew")
def test_a_gain_that_does_not_stabilize_is_not_refined(monkeypatch: pytest.MonkeyPatch) -> None:
    """X = 0 leaves the pendulum standing: care says so, dare finds X another way. So it does when scipy refuses."""
    Q, R = np.diag([1, 0.01]), np.array([[1e-3]])
    Ad, Bd = sample(PENDULUM, PUSH, 0.01)
    exact = exact_gain(Ad, Bd, Q, 1e-3)

    def nothing(equation: Any, _solver: Solver) -> FloatArray:
        return np.asarray(0 * equation.A)

    def refuses(_equation: Any, _solver: Solver) -> FloatArray:
        raise np.linalg.LinAlgError("Reordering of (A, B) failed")

    with monkeypatch.context() as patch:
        patch.setattr(riccati, "_hamiltonian", nothing)
        with pytest.raises(malta.CheckError, match="residual is 1"):
            care(PENDULUM, PUSH, Q, R)
    for way in (nothing, refuses):
        monkeypatch.setattr(riccati, "_symplectic", way)
        assert pytest.approx(exact, rel=1e-11) == dare(Ad, Bd, Q, R).K
    monkeypatch.setattr(riccati, "_bilinear", refuses)
    with pytest.raises(malta.CheckError, match=r"no stabilizing solution \(Reordering of \(A, B\) failed\)"):
        dare(Ad, Bd, Q, R)


@pytest.mark.parametrize("angle", np.linspace(0.1, 1.5, 15).tolist())
def test_a_mode_that_neither_dies_nor_is_moved_is_a_failed_check(angle: float) -> None:
    """Turned, so that rounding gives it the shadow of an input, and X a way to end."""
    c, s = math.cos(angle), math.sin(angle)
    V = np.array([[c, -s], [s, c]])
    for solve, marginal in ((care, 0.0), (dare, 1.0)):
        A = V @ np.diag([marginal, marginal - 0.5]) @ V.T
        with pytest.raises(malta.CheckError):
            solve(A, V @ PUSH, np.eye(2), np.eye(1))


@pytest.mark.parametrize("units", list(itertools.permutations([1e-9, 3.0, 1e7])))
def test_weights_of_inputs_in_any_units(units: tuple[float, ...]) -> None:
    """x' = u with Q = 1: K = R^-1/2, and R is definite in the units in which its entries are of one size."""
    s = np.array(units)
    R = np.eye(3) + np.ones((3, 3))
    K = care(np.zeros((3, 3)), np.diag(s), np.eye(3), R * np.outer(s, s)).K
    assert pytest.approx(np.linalg.inv(linalg.sqrtm(R)), rel=1e-12) == K * s[:, None]
    with pytest.raises(malta.InputError, match=": R: found a matrix that is not positive definite"):
        care(np.zeros((3, 3)), np.diag(s), np.eye(3), (R - 1.01 * np.eye(3)) * np.outer(s, s))
