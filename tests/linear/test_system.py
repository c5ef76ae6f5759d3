"""One linear system: what is asked of it alone, against scipy, python-control and formulas of blocks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy import linalg

import malta
from malta.linear.diagrams import feedback, interconnect, lft, parallel
from malta.linear.interconnection import append, connect, gain, series
from malta.linear.minimal import minimal
from malta.linear.reduction import balanced_reduction
from malta.linear.system import System

W = 1j * np.geomspace(0.1, 30, 9)
EPS = float(np.finfo(float).eps)


def drawn(seed: int, n: int, p: int = 2, m: int = 2, dt: float | None = None) -> System:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n)) - 2 * np.sqrt(n) * np.eye(n)
    B, C, D = rng.normal(size=(n, m)), rng.normal(size=(p, n)), 0.1 * rng.normal(size=(p, m))
    return System(A if dt is None else linalg.expm(0.1 * A), B, C, D, None, dt)


def known(system: System) -> Any:
    return control.ss(*system, system.dt or 0)


def same(one: System, other: Any) -> None:
    np.testing.assert_allclose(
        one.response(W), np.moveaxis(other(W, squeeze=False), 2, 0), rtol=1e-10, atol=1e-12
    )


SEEDS = st.integers(0, 10_000)


@settings(max_examples=15)
@given(SEEDS, st.integers(0, 5), st.integers(1, 5))
def test_connections_are_those_of_python_control(seed: int, n: int, k: int) -> None:
    G, K = drawn(seed, n), drawn(seed + 1, k)
    g, h = known(G), known(K)
    same(series(G, K), h * g)
    same(parallel(G, K), g + h)
    same(append(G, K), control.append(g, h))
    same(feedback(G, K), control.feedback(g, h))
    same(feedback(G, K, 1), control.feedback(g, h, 1))
    assert len(series(G, K, G).A) == 2 * n + k


@settings(max_examples=15)
@given(SEEDS, st.integers(1, 4), st.integers(0, 3))
def test_a_linear_fractional_transform_is_that_of_its_blocks(seed: int, n: int, k: int) -> None:
    P, K = drawn(seed, n, 3, 4), drawn(seed + 1, k, 2, 1)
    G, F = P.response(W), K.response(W)
    G11, G12, G21, G22 = G[:, :2, :2], G[:, :2, 2:], G[:, 2:, :2], G[:, 2:, 2:]
    expected = G11 + G12 @ F @ np.linalg.solve(np.eye(1) - G22 @ F, G21)
    np.testing.assert_allclose(lft(P, K).response(W), expected, rtol=1e-9, atol=1e-12)


def test_names_connect_and_pick() -> None:
    error = replace(gain(np.array([[1.0, -1.0]])), inputs=("r", "y"), outputs=("e",))
    law = replace(drawn(1, 2, 1, 1), inputs=("e",), outputs=("u",))
    plant = replace(drawn(2, 3, 1, 1), inputs=("u",), outputs=("y",))
    whole = interconnect([error, law, plant], ["r", "u"], ["y", "e"])
    same(whole.part(["y"], ["r"]), control.feedback(known(plant) * known(law), 1))
    same(whole.part([0], ["u"]), control.feedback(known(plant), known(law)))
    assert (whole.inputs, whole.part(["e"], [0]).outputs) == (("r", "u"), ("e",))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda G: System(G.A, G.B, G.C, np.zeros((1, 2))), r"System: D: found shape \(1, 2\), expected \(2, 2\)"),
        (lambda G: replace(G, inputs=("u",)), "inputs: found u, expected 2 names"),
        (lambda G: replace(G, dt=-1.0), "dt: found -1.0, expected a sample time above 0"),
        (lambda G: replace(G, E=np.eye(2)), r"E: found shape \(2, 2\)"),
        (lambda G: G.part(["z"], [0]), "outputs: found 'z'"),
        (lambda G: series(G, gain(np.ones((1, 3)))), "system 2: found 3 inputs, expected as many as the 2 outputs"),
        (lambda G: parallel(G, gain(np.ones((1, 3)))), r"system 2: found shape \(1, 3\)"),
        (lambda G: feedback(G, gain(np.ones((1, 3)))), r"law: found shape \(1, 3\), expected \(2, 2\)"),
        (lambda G: lft(G, gain(np.ones((3, 1)))), "law: found shape"),
        (lambda G: append(G, drawn(1, 1, dt=0.1)), "dt: found 0.1 s, continuous"),
        (lambda _: connect(gain(np.eye(1)), np.eye(1), np.eye(1), np.eye(1)), "an algebraic loop without a solution"),
        (lambda _: drawn(1, 1, dt=0.1).sampled(0.1), "system: found dt = 0.1"),
        (lambda G: G.sampled(0.0), "Ts: found 0.0"),
        (lambda G: G.sampled(0.1, -1.0), "delay: found -1.0"),
        (lambda G: balanced_reduction(G, 4), "order: found 4"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_by_its_field(make: Any, words: str) -> None:
    with pytest.raises(malta.InputError, match=words) as caught:
        make(drawn(1, 3))
    assert "\n" not in str(caught.value)


def test_a_descriptor_is_solved_for_its_states() -> None:
    G, E = drawn(3, 4), np.diag([2.0, 3.0, 4.0, 5.0])
    of_E = System(E @ G.A, E @ G.B, G.C, G.D, E)
    np.testing.assert_allclose(of_E.response(W), G.response(W), rtol=1e-12)
    both = append(G, of_E)
    assert both.E is not None
    np.testing.assert_allclose(np.sort(both.poles), np.sort([*G.poles, *of_E.poles]), rtol=1e-9)
    with pytest.raises(malta.CheckError, match="E is singular"):
        replace(of_E, E=0 * E).poles  # noqa: B018


@settings(max_examples=15)
@given(SEEDS, st.integers(1, 6))
def test_a_similar_system_is_the_same(seed: int, n: int) -> None:
    G, T = drawn(seed, n), np.random.default_rng(seed).normal(size=(n, n)) + 3 * np.eye(n)
    scale = EPS * np.linalg.cond(T) ** 2 * 1e3
    np.testing.assert_allclose(G.similar(T).response(W), G.response(W), rtol=max(scale, 1e-12), atol=scale)
    with pytest.raises(malta.CheckError, match="singular"):
        G.similar(np.ones((n, n)) if n > 1 else np.zeros((1, 1)))


def test_poles_of_a_block_triangular_system_are_those_of_its_blocks() -> None:
    """A threefold pole beside a fast one: eigenvalues of the whole are off by the third root of rounding."""
    A = np.diag([-1.0, -1.0, -1.0, -1e6]) + np.diag([1.0, 1.0, 1.0], -1)
    system = System(A, np.eye(4, 1), np.eye(1, 4, 3), np.zeros((1, 1)))
    assert sorted(system.poles.real.tolist()) == [-1e6, -1.0, -1.0, -1.0]
    assert system.stable
    assert not replace(system, dt=0.1).stable


@settings(max_examples=20)
@given(SEEDS, st.integers(1, 5), st.integers(1, 3), st.integers(1, 3))
def test_zeros_drop_the_rank_of_the_pencil(seed: int, n: int, p: int, m: int) -> None:
    G = drawn(seed, n, p, m)
    G = replace(G, D=0 * G.D) if seed % 2 else G

    def least(s: complex) -> float:
        pencil = np.block([[G.A - s * np.eye(n), G.B], [G.C, G.D]])
        return float(linalg.svdvals(pencil)[min(n + p, n + m) - 1])

    zeros = G.zeros
    if p == m and n >= p:
        assert len(zeros) == n - (0 if G.D.any() else p)
    for z in zeros:
        assert least(z) <= 1e-8 * (1 + abs(z)) * linalg.norm(G.A)


def test_zeros_of_a_system_that_is_not_square() -> None:
    A = np.diag([-1.0, -2.0, -3.0])
    seen = System(A, np.array([[1.0], [1.0], [0.0]]), np.array([[1.0, 0, 0], [0, 1, 0]]), np.zeros((2, 1)))
    np.testing.assert_allclose(seen.zeros, [-3.0], atol=1e-12)  # the state that no input moves
    driven = System(A.T, seen.C.T, seen.B.T, seen.D.T)
    np.testing.assert_allclose(driven.zeros, [-3.0], atol=1e-12)
    assert not len(gain(np.ones((2, 1))).zeros)


@settings(max_examples=15)
@given(SEEDS, st.integers(1, 4), st.floats(0.01, 0.5))
def test_sampling_is_exact(seed: int, n: int, Ts: float) -> None:
    G = drawn(seed, n)
    expected = control.c2d(known(G), Ts)
    made = G.sampled(Ts)
    for letter in "ABCD":
        np.testing.assert_allclose(getattr(made, letter), getattr(expected, letter), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.3, 0.7, 1.0, 1.4, 2.0, 3.9])  # samples
def test_a_delay_is_that_of_the_response_between_samples(delay: float) -> None:
    """The step response of the late system at the samples is that of the system, earlier by the delay."""
    G, Ts, steps = drawn(5, 3, 2, 1), 0.1, 12
    late = G.sampled(Ts, delay * Ts)
    x, outputs = np.zeros(len(late.A)), []
    for _ in range(steps):
        outputs.append(late.C @ x + late.D[:, 0])
        x = late.A @ x + late.B[:, 0]

    def step(t: float) -> Any:
        if t < -1e-12:
            return np.zeros(2)
        return G.C @ np.linalg.solve(G.A, (linalg.expm(G.A * t) - np.eye(3)) @ G.B[:, 0]) + G.D[:, 0]

    expected = [step((k - delay) * Ts) for k in range(steps)]
    np.testing.assert_allclose(outputs, expected, rtol=1e-10, atol=1e-13)


@settings(max_examples=20)
@given(SEEDS, st.integers(1, 4), st.integers(0, 3), st.integers(0, 3))
def test_a_minimal_realization_says_what_it_drops(seed: int, n: int, idle: int, unseen: int) -> None:
    """Poles that no input moves, and poles that no output sees, in states that are mixed."""
    G, rng = drawn(seed, n), np.random.default_rng(seed)
    a, b = np.diag(1.0 + np.arange(idle)), np.diag(0.25 + np.arange(unseen))
    size = n + idle + unseen
    A, B, C = linalg.block_diag(G.A, a, b), np.zeros((size, 2)), np.zeros((2, size))
    A[:n, n : n + idle] = rng.normal(size=(n, idle))
    A[n + idle :, :n] = rng.normal(size=(unseen, n))
    B[:n], B[n + idle :], C[:, : n + idle] = G.B, rng.normal(size=(unseen, 2)), rng.normal(size=(2, n + idle))
    C[:, :n] = G.C
    T, _ = linalg.qr(rng.normal(size=(size, size)))
    found = minimal(System(A, B, C, G.D).similar(T))
    np.testing.assert_allclose(np.sort(found.uncontrollable.real), np.diag(a), rtol=1e-6)
    np.testing.assert_allclose(np.sort(found.unobservable.real), np.diag(b), rtol=1e-6)
    np.testing.assert_allclose(found.system.response(W), G.response(W), rtol=1e-7, atol=1e-9)


@settings(max_examples=15)
@given(SEEDS, st.integers(2, 6), st.booleans())
def test_balanced_reduction_keeps_its_bound(seed: int, n: int, sampled: bool) -> None:
    G = drawn(seed, n, dt=0.1 if sampled else None)
    order = n // 2
    found = balanced_reduction(G, order)
    at = (
        np.exp(1j * np.linspace(0, np.pi, 60))
        if sampled
        else 1j * np.append(0.0, np.geomspace(1e-2, 1e3, 59))
    )
    error = np.linalg.norm(G.response(at) - found.system.response(at), 2, axis=(1, 2))
    assert error.max() <= found.error * (1 + 1e-6) + 1e-9 * found.hankel[0]
    assert found.system.stable
    P = (linalg.solve_discrete_lyapunov(G.A, G.B @ G.B.T) if sampled else
         linalg.solve_continuous_lyapunov(G.A, -G.B @ G.B.T))  # fmt: skip
    Q = (linalg.solve_discrete_lyapunov(G.A.T, G.C.T @ G.C) if sampled else
         linalg.solve_continuous_lyapunov(G.A.T, -G.C.T @ G.C))  # fmt: skip
    sizes = np.sqrt(np.sort(np.abs(np.linalg.eigvals(P @ Q)))[::-1])
    np.testing.assert_allclose(found.hankel, sizes, atol=1e-7 * sizes[0])
    with pytest.raises(malta.CheckError, match="stable system"):
        balanced_reduction(replace(G, A=G.A + 50 * np.eye(n)), 1)
