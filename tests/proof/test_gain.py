"""Worst-case gains: closed forms, frequency responses of random plants, and bad input."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest
from along_travel import at_place
from hypothesis import given, settings, strategies as st

import malta
from malta import gains
from malta.errors import InputError
from malta.linear.open_loops import responses
from malta.margins.travel import travel_loops
from malta.margins.worst_case import worst_sensitivities
from malta.model.plants import plant_of
from malta.proof.blocks import Block, gain, weight_of
from malta.proof.blocks.gain import BlockLoop
from malta.proof.blocks.transfer import GainPeak, LoopSignals, frequencies, patterns, transfer
from malta.proof.polynomial.family import align, combine, family
from malta.proof.robust import problem_of


def first_order(k: float = 1.0) -> malta.proof.UncertainSystem:
    return malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": k})


def test_a_gain_in_closed_form() -> None:
    """T = 2 k / (s + 1 + 2 k): largest at w = 0 and the largest k, 3/4; |S| rises to 1."""
    T = malta.worst_case_gain(first_order(), [[-2.0]], {"k": 0.5}, of="complementary")
    assert T.upper is not None
    assert 0.745 < T.lower <= 0.75 <= T.upper < 0.755
    S = malta.worst_case_gain(first_order(), [[-2.0]], {"k": 0.5})
    assert S.upper is not None
    assert 0.99 < S.lower <= 1 <= S.upper < 1.01


def test_a_resonance_in_closed_form() -> None:
    """S = (s^2 + c s + k) / (s^2 + c s + k + 1): at the smallest c and k, on a fine grid of frequencies."""
    s = malta.uncertain(lambda k, c: ([[0, 1], [-k, -c]], [[0], [1]], [[1, 0]]), {"k": 1.0, "c": 0.2})
    m = malta.worst_case_gain(s, [[-1.0]], {"k": 0.3, "c": 0.5}, tolerance=1e-3)
    w = np.linspace(1.2, 1.4, 200_001)
    ks = np.linspace(0.7, 1.3, 61)
    found = max(float(np.abs((k - w**2 + 0.1j * w) / (k + 1 - w**2 + 0.1j * w)).max()) for k in ks)
    assert m.upper is not None
    assert m.lower == pytest.approx(found, rel=1e-6)
    assert found <= m.upper <= 1.002 * found
    assert m.witness == pytest.approx({"k": 0.7, "c": 0.1}, rel=1e-6)


def test_nothing_uncertain_is_the_norm_of_python_control() -> None:
    """A box of nearly no width: the H-infinity norm of S, by slycot's or scipy's own way."""
    plant, K = control.tf([18], [1, 1.8, 10]), control.tf([2.3, 3], [0.1, 1])
    s = malta.uncertain(lambda k: ([[0, 1], [-k, -1.8]], [[0], [18]], [[1, 0]]), {"k": 10.0})
    m = malta.worst_case_gain(s, -K, {"k": 1e-9})
    w = np.geomspace(0.1, 1e3, 100_001)
    size = np.abs(control.frequency_response(control.feedback(1, plant * K), w).frdata).max()
    assert m.upper is not None
    assert m.lower == pytest.approx(float(size), rel=1e-6)
    assert size <= m.upper <= 1.004 * size


@pytest.mark.slow
@pytest.mark.parametrize("at", ["sensors", "forces"])
def test_no_machine_of_the_box_exceeds_what_is_proven(at: Any) -> None:
    """The flagship anywhere in its travel: 60 machines at corners and within, on a grid of frequencies."""
    c = gains.read("design/gains/robust.json")
    plant = plant_of(c.parameters)
    box = {"m": 0.2, "K_A": 0.2, "K_D": 0.2, "K_B": 0.2}
    ((s, law),), over = travel_loops(plant, c, tuple(box), "pi")
    m = malta.worst_case_gain(s, law, box, over, at=at, channel=4)
    assert m.upper is not None
    assert m.lower <= m.upper <= 1.04 * m.lower
    assert law.sample_time is not None
    rng, w, worst = np.random.default_rng(1), np.geomspace(100, math.pi / law.sample_time, 200), 0.0
    for _ in range(60):
        shares = np.array([*box.values()]) * np.clip(rng.uniform(-2, 2, 4), -1, 1)
        p = at_place(s, shares, float(rng.uniform(-plant.stroke.travel, plant.stroke.travel)))
        P, _, _, F = responses(s, law, p, w)
        Q = P @ F if at == "sensors" else F @ P  # with currents among the sensors
        S = np.linalg.inv(np.eye(Q.shape[-1]) - Q)
        worst = max(worst, float(np.abs(S[:, 4, 4]).max()))
    assert 0.8 * m.lower < worst <= m.upper


def test_integrators_on_both_sides_of_a_gain_take_no_digits() -> None:
    """S and F S of the flagship at its forces fall as s^3 and s^2, though plant and law reach 1e40 on the way."""
    c = gains.read("design/gains/robust.json")
    plant = plant_of(c.parameters)
    ((s, law),), _ = travel_loops(plant, c, ("m", "K_A"), "pi")
    blocks = [
        Block("feedback", "forces", tuple(range(5)), tuple(range(5)), weight_of(1.0, "test")),
        Block("effort", "sensors", (0,), tuple(range(5)), weight_of(1.0, "test")),
    ]
    w, p = np.geomspace(1e-17, 10, 50), s.nominal.copy()
    p[:2] *= [0.8, 1.2]
    M = transfer(LoopSignals(responses(s, law, p, w)), blocks)
    S, effort = np.linalg.norm(M[:, :5, :5], axis=(1, 2)), np.linalg.norm(M[:, 5:, 5], axis=1)
    assert S.max() < 1e-3
    assert S[w < 1e-4].max() < 1e-6
    assert effort[:-10] == pytest.approx(effort[-10], rel=1e-2)


def test_no_frequency_is_the_rounding_of_a_real_pole() -> None:
    """The flagship at all corners of its box: nothing below the slowest pole's own far end, where 1 / 0 is rounding."""
    c = gains.read("design/gains/robust.json")
    ((s, law),), _ = travel_loops(plant_of(c.parameters), c, ("m", "K_A", "K_D", "K_B"), "pi")
    problem = problem_of(s, law)
    for x in patterns(5):
        p = at_place(s, 0.2 * x[:4], 0.015 * float(x[4]))
        slowest = np.abs(problem.poles(p)).min()
        assert 1e-9 * slowest < frequencies(problem, p).min() < slowest


@pytest.mark.slow
def test_radial_sensors_of_the_flagship_have_one_worst_sensitivity() -> None:
    """Four sensors of a round body about the same axis: their worst |S| is one figure, up to the gains' rounding."""
    c = gains.read("design/gains/robust.json")
    box = {"m": 0.2, "K_A": 0.2, "K_D": 0.2, "K_B": 0.2}
    found = worst_sensitivities(plant_of(c.parameters), c, box)
    for name in ("y1", "x2", "y2"):
        assert found[name].lower == pytest.approx(found["x1"].lower, rel=1e-6)
        assert found[name].upper == pytest.approx(found["x1"].upper, rel=1e-3)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000))
def test_random_loops_stay_below_what_is_proven(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, b, c = -np.eye(3) * 2 + rng.normal(size=(3, 3)) * 0.4, rng.normal(size=(3, 1)), rng.normal(size=(1, 3))
    s = malta.uncertain(lambda k, d: (A - d * np.eye(3), k * b, c), {"k": 1.0, "d": 0.5})
    m = malta.worst_case_gain(s, [[0.3]], {"k": 0.4, "d": 0.5}, time=5.0)
    if m.upper is None:
        assert m.reason
        return
    w = np.geomspace(1e-2, 1e2, 300)
    for k, d in rng.uniform([0.6, 0.25], [1.4, 0.75], (30, 2)):
        law = malta.proof.Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[0.3]]))
        P, _, _, F = responses(s, law, np.array([k, d]), w)
        assert (np.abs(1 / (1 - (P @ F)[:, 0, 0])) <= m.upper).all()


def test_a_channel_that_acts_nowhere_but_off_the_nominal() -> None:
    """S = (s + 1) / (s + 1 + 2 k) with k = 0 nominal: one there, 1 / 0.6 where k = -0.2."""
    s = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 0.0})
    for at in ("sensors", "forces"):
        m = malta.worst_case_gain(s, [[-2.0]], {"k": (-0.2, 0.2)}, at=at)
        assert m.upper is None or m.upper >= 1 / 0.6
        assert m.lower == pytest.approx(1 / 0.6, rel=1e-6)


def test_families_add_up() -> None:
    from flint import fmpq

    f = family([2, 1], [False, False], [[fmpq(1), fmpq(2)], [fmpq(3), fmpq(5)]])
    g = family([3, 1], [False, False], [[fmpq(x * x), fmpq(1000 * x)] for x in (1, 2, 4)])
    f, g = align(f, g)
    assert f.shape == g.shape == (3, 1)
    N = combine(f, g, 2.0, -1.0)
    middle = np.array([0.25, 0.5, 0.25])  # Bernstein's basis of degree 2 at 1/2
    for k, value in enumerate((2 * 2 - 4, 2 * 3.5 - 2000)):
        unit = 2.0 ** (N.exponents[k] - N.scale * k)
        assert abs(N.values[k] @ middle * unit - value) <= N.radius[k] * unit + 1e-12 * abs(value)


def test_an_unstable_box_has_no_bound() -> None:
    m = malta.worst_case_gain(first_order(), [[0.8]], {"k": 0.5})
    assert m.upper is None
    assert m.reason


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"channel": 1}, "sensors are counted from 0"),
        ({"of": "gain"}, "compliance or effort"),
        ({"at": "here"}, "sensors or forces"),
        ({"tolerance": 0.0}, "above zero and below 1"),
        ({"of": "compliance"}, "\\(sensors, forces\\) of compliance"),
        ({"of": "effort", "channel": (0, 1)}, "sensors are counted from 0"),
        ({"channel": (0, 0)}, "each of the sensors once"),
        ({"dynamics": ["much"]}, "malta.proof.Dynamic, one or a list"),
    ],
)
def test_bad_input_gets_one_sentence(more: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        malta.worst_case_gain(first_order(), [[-2.0]], {"k": 0.5}, **more)


@pytest.mark.slow
def test_a_search_that_missed_the_largest_gain_leads_to_no_bound_below_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """T = 2 k / (s + 1 + 2 k) is 0.7436 at 90 % of the way to the end of the box and 0.75 there."""
    found = GainPeak(0.7438, 0.0, np.array([1.4505]))
    monkeypatch.setattr(gain, "_largest", lambda *_: found)
    T = malta.worst_case_gain(first_order(), [[-2.0]], {"k": 0.5}, of="complementary", tolerance=1e-4)
    assert T.upper is None or T.upper >= 0.75


@pytest.mark.slow
def test_no_bound_is_proven_of_a_loop_whose_stability_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(BlockLoop, "stable", lambda _: False)
    T = malta.worst_case_gain(first_order(), [[-2.0]], {"k": 0.5}, of="complementary")
    assert (T.upper, T.reason) == (None, "the nominal loop is not proven stable")
    m = malta.dynamic_margin(first_order(), [[-2.0]], {"k": 0.5}, malta.proof.Dynamic(0.1))
    assert (m.lower, m.reason) == (None, "the nominal loop is not proven stable")


def test_a_peak_without_a_proof_has_the_zone_that_it_reached() -> None:
    """2.22 lies in zone A, and nobody knows whether that is all."""
    reached = gain.Gain(2.22, None, 3.0, {}, 0, 0.0, "not settled")
    lost = gain.Gain(math.inf, None, math.nan, {}, 0, 0.0, "the nominal loop is unstable")
    table = malta.report.worst_case_table({"x": reached, "y": lost})
    rows = list(zip(*(map(str, column.cells) for column in table.columns), strict=True))
    assert rows == [
        ("x", "2.22", "3.000 (0.477)", "nothing proven", "A or worse"),
        ("y", "unstable", "", "nothing proven", "D"),
    ]
