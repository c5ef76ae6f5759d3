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

    law = malta.Compensator(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.2]]), sample_time=0.5
    )
    return malta.uncertain(matrices, {"k": 1.0}), law


@pytest.mark.slow
@pytest.mark.parametrize("mass", [1e-5, 1.0, 1e5, 1e9])
def test_masses_may_stand_in_E(mass: float) -> None:
    """The coefficients of det(s E - A) carry det E, and so do their bounds."""
    divided = malta.robust_margin(*chain(1.0, explicit=False), {"k": 0.5}, time=10.0)
    there = malta.robust_margin(*chain(mass, explicit=True), {"k": 0.5}, time=10.0)
    assert divided.lower is not None
    assert there.lower is not None
    assert there.lower <= divided.upper * (1 + 1e-9)
    assert there.lower == pytest.approx(divided.lower, rel=1e-3)


@pytest.mark.parametrize("unit", [1e-6, 1.0, 1e6])
def test_an_uncertain_mass_in_E(unit: float) -> None:
    """The mass is a parameter of E, whose determinant every bound carries, in any unit."""

    def matrices(m: Any, k: Any) -> Any:
        import casadi as ca

        A = ca.blockcat([[0, 1], [-k, -0.1 * unit]])
        return A, ca.DM([[0], [unit]]), ca.DM([[1, 0]]), ca.DM(1, 1), ca.diag(ca.vertcat(1, m))

    law = malta.Compensator(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.2]]), sample_time=0.5
    )
    system = malta.uncertain(matrices, {"m": unit, "k": unit})
    found = malta.robust_margin(system, law, {"m": 0.2, "k": 0.2}, time=10.0)
    assert found.lower is not None
    assert found.witness is not None
    assert found.lower <= found.upper <= found.lower * 1.01
    # k = 0.2 is where the spring no longer holds against the push
    assert found.upper == pytest.approx(4.0, rel=1e-3)
