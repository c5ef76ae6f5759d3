"""Unmodelled dynamics beside real parameters: published margins, norms by another route, weights, bad input."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
from along_travel import at_place
from published_cases import ROBSTAB, Loop, pid

import malta
from malta import dynamic_margin, gains
from malta.errors import InputError
from malta.linear.open_loops import responses
from malta.margins.travel import travel_loops
from malta.model.plants import plant_of
from malta.proof import Dynamic


def robstab() -> malta.proof.UncertainSystem:
    """18 / (s^2 + 1.8 s + k): the example of robstab's reference page."""
    return malta.uncertain(ROBSTAB[0].matrices, ROBSTAB[0].nominal)


@pytest.mark.slow
@pytest.mark.parametrize(("case", "k"), [(ROBSTAB[0], 3.603), (ROBSTAB[1], -1.630)])
def test_a_parameter_and_dynamics_of_robstab(case: Loop, k: float) -> None:
    """MATLAB's reference page of robstab prints 1.5960 .. 1.5993 for k +-40 % and 50 % of dynamics; and with 25 %."""
    m, expected = dynamic_margin(robstab(), case.law, case.box, Dynamic(case.dynamics)), case.margin
    assert m.lower is not None
    assert 0.998 * expected <= m.lower <= expected <= m.upper * (1 + 1e-9)
    assert m.upper == pytest.approx(expected, rel=1e-8)
    assert m.witness is not None
    assert m.witness["k"] == pytest.approx(k, abs=2e-3)


def test_dynamics_of_a_resonance_alone() -> None:
    """RobustAndOptimalControl.jl, test_uncertainty: the reciprocal of an H-infinity norm, 1 / 1.1861."""
    s = malta.uncertain(lambda d: ([[0, 1], [-1, -d]], [[0], [1]], [[1, 0]]), {"d": 0.2})
    m = dynamic_margin(s, pid(1, 2, 0.9, 0.1), {}, Dynamic(0.2))
    assert m.upper == pytest.approx(1 / 1.1861225121, rel=1e-8)
    assert m.frequency == pytest.approx(1.4352, rel=1e-3)
    assert m.lower is not None
    assert 0.998 * m.upper <= m.lower <= m.upper


def test_feedback_dynamics_are_one_over_the_peak_of_s() -> None:
    s, C = robstab(), pid(2.3, 3, 0.38, 0.001)
    m = dynamic_margin(s, C, {}, Dynamic(0.5, kind="feedback"))
    w = np.geomspace(1e-2, 1e4, 200_001)
    P = 18 / ((1j * w) ** 2 + 1.8j * w + 10)
    peak = float(np.abs(1 / (1 - P * C(1j * w))).max())
    assert m.upper == pytest.approx(2 / peak, rel=1e-6)
    assert m.lower is not None
    assert 0.99 / peak * 2 <= m.lower <= m.upper


@pytest.mark.slow
def test_a_weight_that_rises_with_frequency() -> None:
    """|W T| on a fine grid, over the values of k that the margin allows; the smallest loss is the bound's."""
    s, C, W = robstab(), pid(2.3, 3, 0.38, 0.001), control.tf([0.5, 0.1], [0.1, 1])
    m = dynamic_margin(s, C, {"k": 0.4}, Dynamic(W))
    assert m.lower is not None
    assert m.lower <= m.upper <= 1.01 * m.lower
    w = np.geomspace(1e-2, 1e4, 50_001)
    own, weight = C(1j * w), W(1j * w)
    for t in (m.lower, m.upper):
        worst = 0.0
        for k in 10 + 4 * t * np.linspace(-1, 1, 41):
            L = 18 / ((1j * w) ** 2 + 1.8j * w + k) * own
            worst = max(worst, float(np.abs(weight * L / (1 - L)).max()))
        assert (worst * t < 1) == (t == m.lower) or worst * t == pytest.approx(1, abs=2e-3)


@pytest.mark.slow
def test_dynamics_of_a_machine_over_its_travel() -> None:
    """MALTA's flagship with 20 % of dynamics at the axial sensor: nothing within the proven set closes |W T| t >= 1."""
    c = gains.read("design/gains/robust.json")
    plant = plant_of(c.parameters)
    box = {"m": 0.2, "K_A": 0.2}
    ((s, law),), over = travel_loops(plant, c, tuple(box))
    m = dynamic_margin(s, law, box, Dynamic(0.2, channel=4), over)
    assert m.lower is not None
    assert 1 < m.lower <= m.upper <= 1.1 * m.lower
    assert law.sample_time is not None
    rng, w = np.random.default_rng(3), np.geomspace(10, np.pi / law.sample_time, 400)
    for _ in range(60):
        shares = m.lower * 0.2 * rng.uniform(-1, 1, 3)[:2]
        p = at_place(s, shares, float(rng.uniform(-plant.stroke.travel, plant.stroke.travel)))
        P, _, _, F = responses(s, law, p, w)
        eye = np.eye(P.shape[1])  # of sensors and currents
        T = np.linalg.inv(eye - P @ F) - eye
        assert m.lower * 0.2 * np.abs(T[:, 4, 4]).max() < 1


def test_an_unstable_loop_has_no_margin() -> None:
    m = dynamic_margin(robstab(), [[1.0]], {"k": 0.4}, Dynamic(0.5))
    assert (m.lower, m.upper) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("dynamic", "says"),
    [
        (Dynamic(0.0), "above zero"),
        (Dynamic("large"), "a number above zero, or a transfer function"),
        (Dynamic(control.tf([1, 0], [1])), "stable, proper"),
        (Dynamic(control.tf([1], [1, -1])), "stable, proper"),
        (Dynamic(control.tf([1], [1, 0.5], 0.1)), "stable, proper"),
        (Dynamic(0.5, channel=3), "sensors are counted from 0"),
        (Dynamic(0.5, at="here"), "sensors or forces"),  # type: ignore[arg-type]
    ],
)
def test_bad_input_gets_one_sentence(dynamic: Dynamic, says: str) -> None:
    more: dict[str, Any] = {"k": 0.4}
    with pytest.raises(InputError, match=says):
        dynamic_margin(robstab(), pid(2.3, 3, 0.38, 0.001), more, dynamic)


def test_a_singular_E_at_the_end_of_a_box_is_met_by_no_traceback() -> None:
    """m x' = -3 x + u with m from 0 on: the search of a peak evaluates the ends of its box."""
    light = malta.uncertain(lambda m: ([[-3.0]], [[1.0]], [[1.0]], [[0.0]], [[m]]), {"m": 1.0})
    ranges = {"m": (0.0, 2.0)}
    peak = malta.worst_case_gain(light, [[-0.3]], ranges)
    assert peak.upper is None
    assert peak.reached.value == pytest.approx(1, rel=1e-3)  # |S| rises from 3 / 3.3 to 1 beyond the pole
    found = malta.dynamic_margin(light, [[-0.3]], ranges, malta.proof.Dynamic(0.01))
    assert found.upper > 1
