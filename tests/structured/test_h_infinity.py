"""H-infinity laws: optima in closed form, two ways to one, slycot's where it is installed, and refusals."""

from __future__ import annotations

import math
from collections.abc import Callable

import control
import numpy as np
import pytest

import malta
from malta import structured
from malta.structured.riccati import _stable_graph

DOUBLE = [[0.0]], [[1.0, 0.0, 1.0]], [[1.0], [0.0], [1.0]], [[0, 0, 0], [0, 0, 1], [0, 1, 0]]


def scalar(a: float) -> tuple[list[list[float]], ...]:
    """x' = a x + w1 + u, z = (x, u), y = x + w2."""
    return [[a]], *DOUBLE[1:]  # type: ignore[return-value]


@pytest.mark.parametrize("a", [-2.0, -0.3, 0.0, 0.7, 3.0])
def test_the_scalar_optimum_is_that_of_the_equations(a: float) -> None:
    """X = Y = gamma solves X^2 (gamma^-2 - 1) + 2 a X + 1 = 0: gamma = a + sqrt(a^2 + 2) where coupling decides."""
    found = structured.h_infinity(scalar(a), 1, 1)
    assert found.gamma == pytest.approx(a + math.sqrt(a * a + 2), rel=1e-5)
    assert found.gamma <= found.norm * (1 + 1e-9) <= 1.0011 * found.gamma
    assert found.coupling < 1


def test_skogestad_and_postlethwaite_print_1_37() -> None:
    """Multivariable Feedback Control, example 2.17: |[wP S; wu K S]| with wP = (s / 1.5 + 10) / (s + 1e-3), wu = 1."""
    G = control.tf([200], np.polymul([10, 1], np.polymul([0.05, 1], [0.05, 1])))
    found = structured.mixed_sensitivity(G, control.tf([1 / 1.5, 10], [1, 1e-3]), 1.0)
    assert f"{found.gamma:.2f}" == "1.37"
    K = control.ss(*found.law)
    S = control.feedback(1, G * K)
    both = control.append(control.tf([1 / 1.5, 10], [1, 1e-3]) * S, K * S)
    stacked = both * control.ss([], [], [], [[1.0], [1.0]])
    assert control.linfnorm(control.ss(stacked))[0] == pytest.approx(found.norm, rel=1e-4)


def four_block(G: control.StateSpace) -> tuple[np.ndarray, ...]:
    """(r, d) -> (u, y) and y = r - G (u + d)."""
    n, p, m = G.nstates, G.noutputs, G.ninputs
    e = np.eye(p)
    B = np.hstack([np.zeros((n, p)), G.B, G.B])
    C = np.vstack([np.zeros((m, n)), -G.C, -G.C])
    D = np.block([[np.zeros((m, p + m)), np.eye(m)], [e, np.zeros((p, 2 * m))], [e, np.zeros((p, 2 * m))]])
    return G.A, B, C, D


@pytest.mark.parametrize("seed", range(4))
def test_loop_shaping_has_the_optimum_of_the_coprime_factors(seed: int) -> None:
    """gamma = 1 / sqrt(1 - |[N M]|_H^2), with the Hankel norm from the Gramians; the two equations find the same."""
    rng = np.random.default_rng(seed)
    n, m, p = 3, 1 + seed % 2, 1 + seed // 2
    G = control.ss(
        rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(p, n)), np.zeros((p, m))
    )
    found = structured.shape_loop(G)
    Z = control.care(G.A.T, G.C.T, G.B @ G.B.T)[0]
    H = -Z @ G.C.T
    A, B = G.A + H @ G.C, np.hstack([G.B, H])  # [N M]
    Q, P = control.lyap(A.T, G.C.T @ G.C), control.lyap(A, B @ B.T)
    hankel = float(np.linalg.eigvals(P @ Q).real.max())
    assert found.gamma == pytest.approx(1 / math.sqrt(1 - hankel), rel=1e-6)
    assert structured.h_infinity(four_block(G), p, m).gamma == pytest.approx(found.gamma, rel=1e-5)
    assert found.gamma <= found.norm * (1 + 1e-9) <= 1.0011 * found.gamma


def test_loop_shaping_keeps_its_weights() -> None:
    """K = W1 K_s W2 holds the plant itself, with the integral of W1."""
    G, W = control.tf([1], [1, 2, 1]), control.tf([1, 1], [1, 0])
    K = control.ss(*structured.shape_loop(G, before=W).law)
    assert control.feedback(1, G * K).poles().real.max() < 0
    assert np.abs(K.poles()).min() < 1e-9


@pytest.mark.parametrize("seed", range(2))
def test_gammas_are_those_of_slycot(seed: int) -> None:
    pytest.importorskip("slycot", reason="control.hinfsyn needs slycot")
    rng = np.random.default_rng(seed)
    n, p2, m2 = 2 + seed, 1 + seed % 2, 2
    shape = (n, n), (n, 3 + m2), (3 + p2, n), (3 + p2, 3 + m2)
    P = control.ss(*(rng.normal(size=s) for s in shape))
    assert structured.h_infinity(P, p2, m2).gamma == pytest.approx(control.hinfsyn(P, p2, m2)[2], rel=1e-4)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda: structured.h_infinity((*DOUBLE[:3], [[0, 0, 0], [0, 0, 0], [0, 1, 0]]), 1, 1),
            "weight of every input",
        ),
        (
            lambda: structured.h_infinity((*DOUBLE[:3], [[0, 0, 0], [0, 0, 1], [0, 0, 0]]), 1, 1),
            "noise of every output",
        ),
        (
            lambda: structured.h_infinity(([[1.0]], [[1.0, 0.0, 0.0]], *DOUBLE[2:]), 1, 1),
            "no law up to gamma",
        ),
        (lambda: structured.h_infinity(DOUBLE, 3, 1), "more than 3 outputs"),
        (lambda: structured.h_infinity((*DOUBLE[:3], [[1.0]]), 1, 1), "do not fit"),
        (lambda: structured.h_infinity(control.ss(*DOUBLE, 0.1), 1, 1), "a continuous system"),
        (lambda: structured.shape_loop(control.tf([1, 1], [1, 2])), "a strictly proper one"),
        (
            lambda: structured.mixed_sensitivity(control.tf([1], [1, 1]), control.tf([1], [1, 1])),
            "weight of every input",
        ),
    ],
)
def test_what_no_law_can_have_is_refused(make: Callable[[], object], words: str) -> None:
    with pytest.raises(malta.InputError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


def _ordinary_plant(seed: int) -> tuple[tuple[np.ndarray, ...], int, int]:
    """Matrices of normal numbers, with a weight of every input and noise of every output; rows of any size."""
    rng = np.random.default_rng(seed)
    n, inputs, outputs = (int(k) for k in rng.integers((2, 1, 1), (9, 3, 3)))
    w, z = outputs + int(rng.integers(0, 3)), inputs + int(rng.integers(0, 3))
    rows = 10.0 ** rng.uniform(-2, 4, n) if seed % 4 == 3 else np.full(n, 10.0 ** rng.uniform(-1, 3))
    A = (np.ones(n) if seed % 4 < 2 else rows)[:, None] * rng.normal(size=(n, n))
    D = rng.normal(size=(z + outputs, w + inputs))
    D[z:, w:] = 0
    return (A, rng.normal(size=(n, w + inputs)), rng.normal(size=(z + outputs, n)), D), outputs, inputs


def test_ordinary_plants_have_a_law_or_one_sentence() -> None:
    """Sixty plants; LAPACK cannot order the Schur form of some Hamiltonian matrices on the way to their gamma."""
    found = 0
    for seed in range(60):
        plant, outputs, inputs = _ordinary_plant(seed)
        try:
            law = structured.h_infinity(plant, outputs, inputs)
        except (malta.InputError, malta.CheckError):
            continue
        assert law.norm <= 1.0011 * law.gamma
        found += 1
    assert found >= 57


@pytest.mark.parametrize("seed", range(8))
def test_the_sign_function_has_the_solution_of_the_schur_form(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """X of a regulator by the two ways, to the condition of the Hamiltonian matrix."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 12))
    A, B, C = rng.normal(size=(n, n)), rng.normal(size=(n, 2)), rng.normal(size=(2, n))
    H = np.vstack([np.hstack([A, -B @ B.T]), np.hstack([-C.T @ C, -A.T])])
    X = _stable_graph(H)

    def refuse(*_: object, **__: object) -> None:
        raise np.linalg.LinAlgError("Leading eigenvalues do not satisfy sort condition.")

    monkeypatch.setattr("malta.structured.riccati.linalg.schur", refuse)
    other = _stable_graph(H)
    assert X is not None
    assert other is not None
    assert np.abs(X - other).max() < 1e3 * np.finfo(float).eps * np.linalg.cond(H) * np.abs(X).max()
