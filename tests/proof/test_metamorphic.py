"""Proofs do not move with what a loop does not feel: masses on either side of E, rows scaled, units."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import malta


def chain(mass: float, *, explicit: bool) -> tuple[Any, Any]:
    """Three bodies in a chain of springs k, sampled every 0.5 s, pushed by 0.2 y from the third position to the first
    force; the springs, dampers and gains grow with the mass, so that every mass has the same poles."""
    m = mass

    def matrices(k: Any) -> Any:
        import casadi as ca

        K = m * k * ca.DM([[2, -1, 0], [-1, 2, -1], [0, -1, 2]])
        D = 0.05 * m * ca.DM([[2, -1, 0], [-1, 2, -1], [0, -1, 2]])
        if not explicit:
            K, D = K / m, D / m
        A = ca.blockcat([[ca.SX(3, 3), ca.SX.eye(3)], [-K, -D]])
        B = ca.SX(6, 1)
        B[3] = m if explicit else 1
        C = ca.DM([[0, 0, 1, 0, 0, 0]])
        if not explicit:
            return A, B, C
        return A, B, C, ca.DM(1, 1), ca.diag(ca.DM([1, 1, 1, m, m, m]))

    law = malta.proof.Compensator(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.2]]), sample_time=0.5
    )
    return malta.uncertain(matrices, {"k": 1.0}), law


@pytest.mark.slow
@pytest.mark.parametrize("mass", [1e-5, 1.0, 1e5, 1e9])
def test_masses_may_stand_in_E(mass: float) -> None:
    """The coefficients of det(s E - A) carry det E, and so do their bounds."""
    divided = malta.robust_margin(*chain(1.0, explicit=False), {"k": 0.5}, budget=malta.proof.Budget(10.0))
    there = malta.robust_margin(*chain(mass, explicit=True), {"k": 0.5}, budget=malta.proof.Budget(10.0))
    assert divided.lower is not None
    assert there.lower is not None
    assert there.lower <= divided.upper * (1 + 1e-9)
    assert there.lower == pytest.approx(divided.lower, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_an_uncertain_mass_in_E(unit: float) -> None:
    """The mass is a parameter of E, whose determinant every bound carries, in any unit."""

    def matrices(m: Any, k: Any) -> Any:
        import casadi as ca

        A = ca.blockcat([[0, 1], [-k, -0.1 * unit]])
        return A, ca.DM([[0], [unit]]), ca.DM([[1, 0]]), ca.DM(1, 1), ca.diag(ca.vertcat(1, m))

    law = malta.proof.Compensator(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.2]]), sample_time=0.5
    )
    system = malta.uncertain(matrices, {"m": unit, "k": unit})
    found = malta.robust_margin(system, law, {"m": 0.2, "k": 0.2}, budget=malta.proof.Budget(10.0))
    assert found.lower is not None
    assert found.witness is not None
    assert found.lower <= found.upper <= found.lower * 1.01
    # k = 0.2 is where the spring no longer holds against the push
    assert found.upper == pytest.approx(4.0, rel=1e-3)


def weakly_coupled(E: Any, sample_time: float | None) -> tuple[Any, Any]:
    """Two loops whose slow pole, 5e-13 / s, leaves them to a coupling of 1e-13 k: lost at k = 10, and rows times E."""

    def matrices(k: Any) -> Any:
        import casadi as ca

        A = np.kron(np.eye(2), [[-1, 1 - 1e-12], [1, -1]])
        B = ca.SX(4, 2)
        B[0, 0], B[2, 1] = k, k
        C = ca.DM([[1, 0, 0, 0], [0, 0, 1, 0]])
        return ca.DM(E @ A), ca.mtimes(ca.DM(E), B), C, ca.DM(2, 2), ca.DM(E)

    law = malta.proof.Compensator(
        np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((2, 0)), np.array([[0, 1e-13], [1e-13, 0]]),
        sample_time=sample_time,
    )  # fmt: skip
    return malta.uncertain(matrices, {"k": 1.0}), law


@pytest.mark.slow_for("mass-None", "mass-1.0")
@pytest.mark.parametrize("sample_time", [None, 1.0])
@pytest.mark.parametrize(
    "E", [np.eye(4) * 1e9, np.kron(np.eye(2), [[1, 1e3], [0, 1]])], ids=["mass", "mixed"]
)
def test_neglected_couplings_carry_the_descriptor(E: Any, sample_time: float | None) -> None:
    """The coefficients of a sampled loop carry det E as those of a continuous one do, and E may mix the rows."""
    found = malta.robust_margin(
        *weakly_coupled(E, sample_time), {"k": (0.5, 1.5)}, budget=malta.proof.Budget(0.7)
    )
    assert found.lower is None or found.lower < 18.5


@pytest.mark.slow
def test_neglected_couplings_carry_denominators() -> None:
    """Lost at 1e-13 k = 1e-12 h, k = 5: rows with denominators are multiplied by them, bounds of couplings too."""

    def matrices(k: Any, p: Any) -> Any:
        import casadi as ca

        h, A = 500 / p, ca.SX(4, 4)
        for i in (0, 2):
            A[i, i], A[i, i + 1], A[i + 1, i], A[i + 1, i + 1] = 1 - h, h * (1 - 1e-12), h, 1 - h
            A[i, 2 - i] = 1e-13 * k
        return A, ca.DM.zeros(4, 1), ca.DM.zeros(1, 4)

    system = malta.uncertain(matrices, {"k": 1.0, "p": 1000.0}, sample_time=1.0)
    found = malta.robust_margin(system, [[0.0]], {"k": (0.0, 2.0)}, budget=malta.proof.Budget(0.7))
    assert found.lower is None or found.lower < 4.01


def test_a_nominal_loop_is_stable_with_all_its_couplings() -> None:
    """Poles of 6e-17 and -1.4e-16 where a coupling of 1.5e-16 meets a damping of 1.1e-16: splits are of rounding alone.

    Floating point sees no unstable pole, and over a box up to k = 1e6 the coupling is not neglected.
    """
    damping = 2.0**-53

    def matrices(k: Any) -> Any:
        import casadi as ca

        B = ca.SX(4, 2)
        B[0, 0], B[2, 1] = k, k
        return np.kron(np.eye(2), [[-1, 1 - damping], [1, -1]]), B, np.eye(4)[[0, 2]]

    gain = 1.5 * damping * np.array([[0, 1.0], [1, 0]])
    found = malta.robust_margin(
        malta.uncertain(matrices, {"k": 1.0}), gain, {"k": (0.9, 1e6)}, budget=malta.proof.Budget(1.0)
    )
    assert not found.lower


@pytest.mark.parametrize("unit", [1e-9, 1e9])
def test_units_of_a_sampled_system(unit: float) -> None:
    """Bounds of e^(A T) are found in balanced units."""

    def proven(unit: float) -> float | None:
        def matrices(k: Any) -> Any:
            return [[-0.1, unit], [-k / unit, -0.2]], [[0], [1 / unit]], [[1, 0]]

        system = malta.uncertain(matrices, {"k": 1.0})
        law = malta.proof.Compensator(
            np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.3]]), sample_time=0.5
        )
        return malta.robust_margin(system, law, {"k": 0.2}, budget=malta.proof.Budget(10.0)).lower

    assert proven(1.0) is not None
    assert proven(unit) == pytest.approx(proven(1.0), rel=1e-6)
