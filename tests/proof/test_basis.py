"""Coordinates do not matter: a rotor on magnetic bearings in those of its centre, of its bearings, or others."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np
import pytest
from flint import arb, fmpq

import malta
from malta.linear.expressions import EXACT_ARITHMETIC
from malta.proof.groups import loop_of
from malta.proof.robust import in_plain_basis, law_of, problem_of

L_A, L_B, I_T, I_P = 0.241, 0.139, 6e-2, 8e-4  # m, m, kg m^2, kg m^2
BEARINGS = np.array([[1, 0, 0, L_A], [0, 1, -L_A, 0], [1, 0, 0, -L_B], [0, 1, L_B, 0]])
NOMINAL = {"m": 2.3, "k_s": 144e3, "k_i": 38.0, "Omega": 1000.0}
FASTEST = 20000 * math.pi / 30  # rad/s
RANGES = {"m": 0.1, "k_s": 0.1, "k_i": 0.1}


def rotor(T: Any) -> malta.proof.UncertainSystem:
    """m x'' = F about the centre of gravity, in the coordinates q = T (x, y, alpha, beta)."""
    back = np.linalg.inv(T)
    reads = BEARINGS @ back

    def f(m: Any, k_s: Any, k_i: Any, Omega: Any) -> Any:
        spin = ca.SX(4, 4)
        spin[2, 3], spin[3, 2] = -I_P * Omega, I_P * Omega
        by_mass = ca.DM(T) @ ca.diag(ca.vertcat(1 / m, 1 / m, 1 / I_T, 1 / I_T))
        K, G = by_mass @ (k_s * ca.DM(BEARINGS.T @ reads)), by_mass @ spin @ ca.DM(back)
        A = ca.vertcat(ca.horzcat(ca.SX(4, 4), ca.SX.eye(4)), ca.horzcat(K, G))
        B = ca.vertcat(ca.SX(4, 4), by_mass @ (k_i * ca.DM(BEARINGS.T)))
        return A, B, ca.horzcat(ca.DM(reads), ca.DM(4, 4))

    return malta.uncertain(f, NOMINAL)


def derivative_law(T: float | None = None) -> malta.proof.Compensator:
    """Proportional and filtered derivative, from each sensor to the bearing beside it."""
    gain, late, one = 2.5 * 144e3 / 38, 1e-4, np.eye(4)
    rate = gain / 500 / late
    if T is None:
        return malta.proof.Compensator(-one / late, one / late, rate * one, -(gain + rate) * one)
    keep = math.exp(-T / late)
    return malta.proof.Compensator(keep * one, (1 - keep) * one, rate * one, -(gain + rate) * one, 0, T)


def coordinates() -> list[Any]:
    rng = np.random.default_rng(3)
    anywhere = rng.integers(-4, 5, (4, 4)) + 0.25 * np.eye(4)
    return [np.eye(4), BEARINGS, anywhere]


@pytest.mark.parametrize("T", [None, 1e-4])
def test_degrees_are_those_of_the_centre_of_gravity(T: float | None) -> None:
    found = []
    for where in coordinates():
        system = rotor(where)
        law = law_of(system, derivative_law(T))
        ((f, moves),) = problem_of(system, law).parts([arb(x) for x in system.nominal.tolist()])
        assert moves == ()
        found.append((f.degrees, f.inverted))
    assert found[0][0] == ((2, 4, 4, 2) if T is None else (None, None, 4, None))
    for degrees, inverted in found[1:]:
        assert inverted == found[0][1]
        assert degrees[0] == found[0][0][0]  # 4 in the mass with the same loop in coordinates of the bearings


def test_the_loop_in_another_basis_is_the_same_loop() -> None:
    """The characteristic polynomials agree exactly, at random rational parameters and for random loops."""
    rng = np.random.default_rng(5)
    changed = 0
    for _ in range(8):
        where, back = rng.integers(-3, 4, (4, 4)) + 0.5 * np.eye(4), rng.integers(-3, 4, (4, 4))
        if abs(np.linalg.det(where)) < 0.1:
            continue
        system = _in_masses(where, back)
        loop = loop_of(system, law_of(system, -0.1 * np.ones((1, 1))))
        other = in_plain_basis(loop)
        changed += other is not loop
        p = [fmpq(int(k), 7) for k in rng.integers(1, 30, 2)]
        one, two = (
            _polynomial(each.program.run(p, EXACT_ARITHMETIC), each.descriptor) for each in (loop, other)
        )
        assert one == two
    assert changed > 3


def _in_masses(where: Any, force: Any) -> malta.proof.UncertainSystem:
    inverse = np.linalg.inv(where)

    def f(m: Any, k: Any) -> Any:
        A = ca.DM(where) @ ca.vertcat(
            ca.horzcat(0, 0, 1, 0),
            ca.horzcat(0, 0, 0, 1),
            ca.horzcat(-k / m, 0, -1, 0),
            ca.horzcat(1, -2, 0, -k),
        )
        return A @ ca.DM(inverse), ca.DM(force[:, :1]), ca.DM(force[:1])

    return malta.uncertain(f, {"m": 2.0, "k": 3.0})


def _polynomial(entries: Any, descriptor: bool) -> list[Any]:
    """The coefficients of det(s I - A - b c g), for a rational gain g."""
    from flint import fmpq_mat

    assert not descriptor
    A, B, C = ({(i, j): x for i, j, x in matrix} for matrix in entries[:3])
    closed = [
        [
            A.get((i, j), fmpq(0)) + fmpq(1, 3) * B.get((i, 0), fmpq(0)) * C.get((0, j), fmpq(0))
            for j in range(4)
        ]
        for i in range(4)
    ]
    return list(fmpq_mat(closed).charpoly().coeffs())


@pytest.mark.slow
def test_the_margin_of_a_gyroscopic_rotor_is_found_in_any_coordinates() -> None:
    """At rest two planes reach k_i gain = k_s together: (1 - t / 10) 2.5 = 1 + t / 10."""
    truth, where = 1.5 / 0.35, coordinates()[-1]
    found = malta.robust_margin(
        rotor(where), derivative_law(), RANGES, {"Omega": (0, FASTEST)}, budget=malta.proof.Budget(60)
    )
    assert found.lower is not None
    assert found.lower <= truth
    assert found.lower == pytest.approx(truth, rel=0.01)


def test_a_loop_in_plain_coordinates_is_left_alone() -> None:
    system = rotor(np.eye(4))
    loop = loop_of(system, derivative_law())
    assert in_plain_basis(loop) is loop
