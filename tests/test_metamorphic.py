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


@pytest.mark.parametrize("mass", [1e-5, 1.0, 1e5, 1e9])
def test_masses_may_stand_in_E(mass: float) -> None:
    """The coefficients of det(s E - A) carry det E, and so do their bounds."""
    divided = malta.robust_margin(*chain(1.0, explicit=False), {"k": 0.5}, time=10.0)
    there = malta.robust_margin(*chain(mass, explicit=True), {"k": 0.5}, time=10.0)
    assert divided.lower is not None
    assert there.lower is not None
    assert there.lower <= divided.upper * (1 + 1e-9)
    assert there.lower == pytest.approx(divided.lower, rel=1e-3)
