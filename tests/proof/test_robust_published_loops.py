"""Robust stability margins and worst-case gains of feedback loops whose answers are published.

Margins are in multiples of the ranges. Each number was found a second time by other means: by hand, by roots where one
vertex decides (proven by Hurwitz determinants), by scans of frequency and parameter where a complex uncertainty does.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import published_cases as cases
import pytest
from test_robust_published import bracketed

import malta

if TYPE_CHECKING:
    from published_cases import Loop

    from malta.proof import UncertainSystem


def system_of(case: Loop) -> UncertainSystem:
    return malta.uncertain(case.matrices, case.nominal, limits=case.limits)


def test_two_carts_of_robstab() -> None:
    """MATLAB, Robust Stability and Worst-Case Gain: 2.8826 .. 2.8864 at 575.034 rad/s, k = 1.5773, m = 0.4227."""
    case = cases.CARTS
    m = malta.robust_margin(system_of(case), case.law, case.box)
    bracketed(m, case.margin, 1e-8)
    assert m.lower is not None
    assert m.upper - m.lower < 2.8864 - 2.8826
    assert m.frequency == pytest.approx(575.0339, rel=1e-3)
    assert m.witness == pytest.approx({"m1": 0.4227, "m2": 0.4227, "k": 1.5773}, rel=1e-3)


def test_acc_benchmark() -> None:
    """Wie and Bernstein 1992: k in 0.5 .. 2 about 1, met by the nominal law in Rocchetta, Crespo and Kenny 2019.

    One parameter, so the roots alone tell the margin: k = 0.43535 at 0.748 rad/s, and k = 3.905 above.
    """
    case = cases.ACC_BENCHMARK
    m = malta.robust_margin(system_of(case), case.law, case.box)
    bracketed(m, case.margin)
    assert m.frequency == pytest.approx(0.74807, rel=1e-3)
    m = malta.robust_margin(system_of(case), case.law, {"k": (1.0, 2.0)})
    bracketed(m, 2.904789227)


def test_spinning_satellite() -> None:
    """Skogestad and Postlethwaite, Multivariable Feedback Control, 3.7.1, after Doyle: 1 / sqrt(101) for both torques.

    Either torque alone may grow without end. det = s^2 + (2 + e1 + e2) s + 1 + e1 + e2 + 101 e1 e2.
    """
    case = cases.SATELLITE
    s = system_of(case)
    m = malta.robust_margin(s, case.law, case.box)
    bracketed(m, case.margin)
    assert m.frequency == pytest.approx(0, abs=1e-6)
    alone = malta.robust_margin(s, case.law, {"e1": (-0.5, 0.5)})
    bracketed(alone, 2)  # the gain of one loop, down to -1
    more = malta.robust_margin(s, case.law, {"e1": (0.0, 1.0)})
    assert more.upper == math.inf
    assert more.lower is not None
    assert more.lower >= 99


def test_guaranteed_margins_for_LQG_regulators() -> None:
    """There are none: Doyle 1978, IEEE TAC 23. With q = sigma = 60 both gains are 10: up to 1.01, down to 0.92975."""
    case = cases.DOYLE
    s, law = system_of(case), case.law
    m = malta.robust_margin(s, law, {"m": (1.0, 1.1)})
    bracketed(m, 0.1)
    assert m.frequency == pytest.approx(0, abs=1e-6)
    bracketed(malta.robust_margin(s, law, {"m": (0.9, 1.0)}), (1 - 0.929745773666) / 0.1)
    bracketed(malta.robust_margin(s, law, case.box), case.margin)


# What follows by hand


@pytest.mark.parametrize("tau", [1e-9, 1e-4, 1.0, 1e4, 1e9])
def test_three_lags_in_any_unit_of_time(tau: float) -> None:
    """k / (tau s + 1)^3 with u = -y is lost at k = 8, w = sqrt(3) / tau."""
    s = malta.uncertain(
        lambda k: (
            [[-1 / tau, 0, 0], [1 / tau, -1 / tau, 0], [0, 1 / tau, -1 / tau]],
            [[k / tau], [0], [0]],
            [[0, 0, 1]],
        ),
        {"k": 1.0},
    )
    m = malta.robust_margin(s, [[-1.0]], {"k": (1.0, 2.0)})
    bracketed(m, 7)
    assert m.frequency == pytest.approx(math.sqrt(3) / tau, rel=1e-3)


@pytest.mark.parametrize(("fast", "slow"), [(1.0, 1.0), (1e3, 1.0), (1.0, 1e3), (1e6, 1e-3)])
def test_two_loops_that_share_a_gain(fast: float, slow: float) -> None:
    """k / (s / a + 1)^3 and 6 k / (s / b + 1)^3, nothing between them: the second is lost at k = 8 / 6."""

    def both(k: Any) -> Any:
        lags = np.eye(3, k=-1) - np.eye(3)
        A = np.block([[fast * lags, np.zeros((3, 3))], [np.zeros((3, 3)), slow * lags]])
        B = [[fast * k if i == 0 else 0, 6 * slow * k if i == 3 else 0] for i in range(6)]
        return A, B, np.eye(6)[[2, 5]]

    m = malta.robust_margin(malta.uncertain(both, {"k": 1.0}), -np.eye(2), {"k": (1.0, 2.0)})
    bracketed(m, 1 / 3)
    assert m.frequency == pytest.approx(math.sqrt(3) * slow, rel=1e-3)


def test_a_time_constant_down_to_zero() -> None:
    """MATLAB Answers 350709: 1 / (tau s + 1), tau in 0.75 .. 1.5 about 1. robstab answered 3; it is 4, at tau = 0."""
    s = malta.uncertain(lambda tau: ([[-1]], [[1]], [[1]], [[0]], [[tau]]), {"tau": 1.0})
    bracketed(malta.robust_margin(s, [[0.0]], {"tau": (0.75, 1.5)}), 4)


def test_two_gains_of_a_damped_satellite() -> None:
    """RobustAndOptimalControl.jl, test_uncertainty: sqrt(2), as det = 1 + (1 + e1) (1 + e2) at w = 0."""
    s = malta.uncertain(
        lambda e1, e2: ([[0, 1], [-1, -1]], [[1 + e1, 0], [0, 1 + e2]], [[1, 1], [0, 1]]),
        {"e1": 0.0, "e2": 0.0},
    )
    m = malta.robust_margin(s, -np.eye(2), {"e1": (-1.0, 1.0), "e2": (-1.0, 1.0)})
    bracketed(m, math.sqrt(2))
