"""Margins of plain matrices: no scale changes an answer, structure is read and not believed, what is random holds."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest
from hypothesis import assume, given, settings, strategies as st

import malta
from malta.errors import InputError
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.proof.problem import hurwitz


def chain(tau: float, unit: float = 1.0) -> UncertainSystem:
    """k / (tau s + 1)^3, the second state in units of its own; with u = -y and k in (1, 2) about 1 the margin is 7."""
    A = np.array([[-1, unit, 0], [0, -1, 1 / unit], [0, 0, -1]]) / tau
    return malta.uncertain(lambda k: (A, [[0], [0], [k / tau]], [[1, 0, 0]]), {"k": 1.0})


@pytest.mark.slow
@settings(max_examples=20, deadline=None)
@given(st.floats(-9, 9), st.floats(-6, 6))
def test_time_and_states_have_no_scale(decades: float, unit: float) -> None:
    m = malta.robust_margin(chain(10**decades, 10**unit), [[-1.0]], {"k": (1, 2)})
    assert m.lower is not None
    assert 7 * (1 - 1e-5) < m.lower <= 7 <= m.upper * (1 + 1e-12)
    assert m.upper < 7 * (1 + 1e-6)
    assert m.frequency == pytest.approx(math.sqrt(3) / 10**decades, rel=1e-6)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_parameters_have_no_scale(scale: float) -> None:
    system = malta.uncertain(
        lambda q: ([[-1, 1, 0], [0, -1, 1], [0, 0, -1]], [[0], [0], [q / scale]], [[1, 0, 0]]), {"q": scale}
    )
    m = malta.robust_margin(system, [[-1.0]], {"q": (scale, 2 * scale)})
    assert m.lower == pytest.approx(7, rel=1e-5)
    assert m.upper == pytest.approx(7, rel=1e-6)


@pytest.mark.slow_for("0.1")
@pytest.mark.parametrize("T", [1e-9, 1e-7, 1e-5, 1e-3, 0.1])
def test_sampling_faster_and_faster_tends_to_the_continuous_loop(T: float) -> None:
    """Two masses and a spring near 1 rad/s under state feedback, sampled exactly."""

    def of(m1: Any, m2: Any, k: Any) -> Any:
        A = [[0, 0, 1, 0], [0, 0, 0, 1], [-k / m1, k / m1, 0, 0], [k / m2, -k / m2, 0, 0]]
        return A, [[0], [0], [1 / m1], [0]], np.eye(4)

    system, K = malta.uncertain(of, {"m1": 1, "m2": 1, "k": 1}), [[-1.0, -0.5, -1.5, -0.3]]
    box = dict.fromkeys(("m1", "m2", "k"), 0.2)
    slow = malta.robust_margin(system, K, box)
    none = np.zeros((0, 0)), np.zeros((0, 4)), np.zeros((1, 0))
    fast = malta.robust_margin(system, Compensator(*none, np.array(K), sample_time=T), box)
    for m in (slow, fast):
        assert m.lower is not None
        assert m.lower <= m.upper <= 1.001 * m.lower
    assert fast.upper == pytest.approx(slow.upper, rel=max(0.2 * T, 1e-6))


@pytest.mark.parametrize("rate", [1e-6, 1.0, 1e6])
def test_loops_that_differ_are_proven_each(rate: float) -> None:
    """k / (s + 1)^3 beside 6 k / (s + 1)^3: the second decides, 4/3 of k."""
    one = rate * np.array([[-1.0, 1, 0], [0, -1, 1], [0, 0, -1]])
    A = np.block([[one, np.zeros((3, 3))], [np.zeros((3, 3)), one]])
    C = np.zeros((2, 6))
    C[0, 0] = C[1, 3] = 1

    def of(k: Any) -> Any:
        B = ca.SX(6, 2)
        B[2, 0], B[5, 1] = rate * k, 6 * rate * k
        return A, B, C

    m = malta.robust_margin(malta.uncertain(of, {"k": 1.0}), -np.eye(2), {"k": (1.0, 1.02)})
    assert m.lower == pytest.approx(1 / 3 / 0.02, rel=1e-5)
    assert m.upper == pytest.approx(1 / 3 / 0.02, rel=1e-6)


def test_a_system_need_not_be_of_second_order() -> None:
    """x' = (p - 10) x + u has no positions and speeds: lost at p = 10."""
    p = ca.SX.sym("p")
    matrices = ca.Function(
        "f", [p], [ca.vertcat(ca.horzcat(p - 10, 1), ca.horzcat(0, -1)), ca.SX([0, 1]), ca.SX([[1, 0]])]
    )
    system = UncertainSystem(("p",), np.array([1.0]), matrices, ((-math.inf, math.inf),))
    m = malta.robust_margin(system, [[0.0]], {"p": (0.0, 2.0)})
    assert m.lower == pytest.approx(9, rel=1e-5)
    assert m.upper == pytest.approx(9, rel=1e-6)


@pytest.mark.slow_for("0.01")
@pytest.mark.parametrize("width", [1.0, 0.01])
def test_a_narrow_bump_is_enclosed(width: float) -> None:
    """x'' = -x - (1 - 2 e^-((p - 0.7) / width)^2) x': unstable within width sqrt(ln 2) of 0.7."""
    system = malta.uncertain(
        lambda p: ([[0, 1], [-1, -1 + 2 * ca.exp(-(((p - 0.7) / width) ** 2))]], [[0], [1]], [[1, 0]]),
        {"p": -0.5},
    )
    m = malta.robust_margin(system, [[0.0]], {"p": (-1.5, 0.5)})
    exact = 1.2 - width * math.sqrt(math.log(2))
    assert m.lower is not None
    assert m.lower <= exact * (1 + 1e-9)
    assert m.upper == pytest.approx(exact, rel=1e-6)
    assert m.upper / m.lower < 1.001


def test_what_cannot_be_enclosed_is_not_proven() -> None:
    system = malta.uncertain(lambda p: ([[ca.sign(p - 2)]], [[0]], [[1]]), {"p": 0.0})
    m = malta.robust_margin(system, [[0.0]], {"p": (-1.0, 1.0)})
    assert m.lower is None
    assert m.upper == pytest.approx(2, rel=1e-6)
    assert "sign" in m.reason
    assert str(m).startswith(f"nothing proven ({m.reason}), lost at 200.0")


def test_the_end_of_a_search_is_named() -> None:
    """A spring that is stable for every stiffness above zero: the margin ends where the stiffness may."""

    def spring(k: Any, d: Any) -> Any:
        return [[0, 1], [-k, -d]], [[0], [1]], [[1, 0]]

    limits = {"k": (0, math.inf), "d": (0, 7)}
    system = malta.uncertain(spring, {"k": 4.0, "d": 1.0}, limits=limits)
    words = {
        "up to t = 8, where k reaches its limit 0": {"k": (3.5, 4.5), "d": (0.9, 1.1)},
        "up to t = 6, where d reaches its limit 7": {"k": (3.5, 4.5), "d": (1.0, 2.0)},
        "up to t = 100": {"k": (4.0, 4.5)},
    }
    for searched, box in words.items():
        m = malta.robust_margin(system, [[0.0]], box)
        assert m.exhausted
        assert m.lower is not None
        assert m.lower == pytest.approx(float(searched.split()[4].strip(",")), rel=2e-4)
        assert str(m) == f"proven {m.proven.percent()}; no unstable machine found {searched}"


def test_algebraic_equations_are_solved_for_their_states() -> None:
    """A motor with its winding's current as an algebraic state: R i = u - K w, J w' = K i - b w."""
    descriptor = malta.uncertain(
        lambda R, J: (
            [[-0.1, 0.5], [-0.5, -R]], [[0], [1]], [[1, 0]], [[0]], [[J, 0], [0, 0]],
        ),
        {"R": 2.0, "J": 0.01},
    )  # fmt: skip
    plain = malta.uncertain(
        lambda R, J: ([[(-0.1 - 0.25 / R) / J]], [[0.5 / R / J]], [[1]]), {"R": 2.0, "J": 0.01}
    )
    law = control.ss([[-20.0]], [[1.0]], [[-150.0]], [[0.0]])
    box = {"R": 0.3, "J": 0.2}
    one, two = (malta.robust_margin(s, law, box) for s in (descriptor, plain))
    assert one.lower is not None
    assert two.lower is not None
    assert one.lower == pytest.approx(two.lower, rel=2e-3)
    assert one.upper == pytest.approx(two.upper, rel=1e-6)


@pytest.mark.parametrize(
    ("E", "A", "says"),
    [
        ([[1, 1], [0, 0]], [[-1, 0], [0, 1]], "as many of one"),
        ([[1, 0], [0, 0]], [[-1, 1], [1, 0]], "not singular"),
    ],
)
def test_algebraic_equations_of_a_higher_index_are_refused(E: Any, A: Any, says: str) -> None:
    with pytest.raises(InputError, match=says):
        malta.uncertain(lambda k: (A, [[k], [0]], [[1, 0]], [[0]], E), {"k": 1.0})


def test_descriptors_feedthrough_and_discrete_systems() -> None:
    """m x' = -x + u as E x' = ...; y = x + d u around u = -2 y; x+ = p x."""
    descriptor = malta.uncertain(lambda m: ([[-1]], [[1]], [[1]], [[0]], [[m]]), {"m": 1.0})
    found = malta.robust_margin(descriptor, [[-1.0]], {"m": (0.5, 1.5)})
    assert found.lower == pytest.approx(2, rel=1e-3)  # m = 0
    direct = malta.uncertain(lambda d: ([[-1]], [[1]], [[1]], [[d]]), {"d": 0.0})
    found = malta.robust_margin(direct, [[-2.0]], {"d": (-0.1, 0.1)})
    assert found.upper == pytest.approx(5, rel=1e-4)  # 1 + 2 d = 0
    assert found.lower == pytest.approx(5, rel=1e-3)
    discrete = malta.uncertain(lambda p: ([[p]], [[1]], [[1]]), {"p": 0.5}, sample_time=0.1)
    found = malta.robust_margin(discrete, [[0.0]], {"p": (0.4, 0.6)})
    assert found.upper == pytest.approx(5, rel=1e-6)
    assert found.lower == pytest.approx(5, rel=1e-5)


def test_a_statespace_and_affine_matrices_are_taken() -> None:
    """1 / (s + 1)^2 (1 + k) under an integrating control.StateSpace: two routes to one margin."""
    A0, B0, C0 = [[-1, 1], [0, -1]], [[0], [1]], [[1, 0]]
    affine = malta.uncertain((A0, B0, C0), {"k": 0.0}, terms={"k": (None, [[0], [1]], None)})
    traced = malta.uncertain(lambda p: (A0, [[0], [1 + p[0]]], C0), {"k": 0.0})
    law = control.tf([-1], [1, 0])  # u = -1/s y
    both = [malta.robust_margin(system, law, {"k": (-0.1, 0.1)}) for system in (affine, traced)]
    assert both[0].upper == both[1].upper == pytest.approx(10, rel=1e-6)  # 1 + k: 0 .. 2
    assert both[0].lower == pytest.approx(10, rel=1e-5)


@pytest.mark.slow
@settings(max_examples=8, deadline=None, derandomize=True)
@given(st.integers(0, 10_000))
def test_random_loops_are_stable_in_the_proven_box(seed: int) -> None:
    """Random plants of two or three parameters, continuous or sampled: 200 plants of each proven box by their poles."""
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(1, 4)), int(rng.integers(2, 4))
    A0, moves = rng.normal(size=(n, n)) - 2 * np.eye(n), rng.normal(size=(k, n, n))
    B, C, gain = rng.normal(size=(n, 1)), rng.normal(size=(1, n)), rng.normal()
    terms = {f"p{i}": (moves[i], None, None) for i in range(k)}
    system = malta.uncertain((A0, B, C), dict.fromkeys(terms, 0.0), terms=terms)
    T = None if rng.integers(2) else float(rng.uniform(0.01, 1))
    law = Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[gain]]), sample_time=T)

    def worst(p: Any) -> float:
        A = A0 + np.einsum("i,ijk->jk", p, moves)
        if T is None:
            return float(np.linalg.eigvals(A + gain * B @ C).real.max())
        sys = control.c2d(control.ss(A, B, C, 0), T)
        return float(np.abs(np.linalg.eigvals(sys.A + gain * sys.B @ sys.C)).max() - 1)

    assume(worst(np.zeros(k)) < -1e-3)
    m = malta.robust_margin(system, law, dict.fromkeys(terms, (-0.1, 0.1)), budget=malta.proof.Budget(2.0))
    assert m.lower is None or m.lower <= m.upper
    u = rng.uniform(-1, 1, (200, k))
    u[::2] = np.sign(u[::2])
    assert max(worst(0.1 * (m.lower or 0.0) * row) for row in u) < 1e-9
    if m.witness is not None:
        assert worst(np.array(list(m.witness.values())) * (1 + 1e-6)) > -1e-9


@pytest.mark.parametrize(
    ("source", "nominal", "part"),
    [
        (([[1.0]], [[1.0]]), {"k": 1.0}, "2 matrices"),
        (([[1.0]], [[1.0]], [[math.nan]]), {"k": 1.0}, "NaN or infinity"),
        (([[1.0, 2.0]], [[1.0]], [[1.0]]), {"k": 1.0}, "shape (1, 2)"),
        (([[1.0]], [[1.0]], [[1.0]]), {"k": math.inf}, "a finite number"),
        (([[1.0]], [[1.0]], [[1.0]]), {}, "no parameters"),
        (lambda a, b: ([[a]], [[b]], [[1]]), {"k": 1.0}, "a function of a b"),
    ],
)
def test_bad_matrices_get_one_sentence(source: Any, nominal: dict[str, float], part: str) -> None:
    with pytest.raises(InputError) as caught:
        malta.uncertain(source, nominal)
    assert part in str(caught.value)


def test_routh_in_exact_numbers() -> None:
    from flint import fmpq

    assert hurwitz([fmpq(1), fmpq(3), fmpq(3), fmpq(1)])
    assert not hurwitz([fmpq(10), fmpq(3), fmpq(3), fmpq(1)])
    assert not hurwitz([fmpq(9), fmpq(3), fmpq(3), fmpq(1)])  # on the axis
