"""Uncertain systems in series, side by side, in parallel, in feedback: those of python-control, and their margins."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import control
import numpy as np
import pytest
from conftest import refusal

import malta
from malta.proof import append, feedback, parallel, random_systems, series

if TYPE_CHECKING:
    from collections.abc import Callable

W = np.geomspace(0.1, 100, 7)
LEAD = control.tf([40, 800], [1, 80])
RANDOM = control.ss([[-1.0, 2], [0, -3]], [[1, 0], [2, 1]], [[1, 1], [0, 2]], [[0.5, 0], [0, 0.2]])


def mass() -> Any:
    return malta.uncertain(lambda m: ([[0, 1], [0, 0]], [[0], [1 / m]], [[1, 0]]), {"m": 0.1})


def compensator(**options: Any) -> Any:
    law = control.ss(-LEAD)
    return malta.proof.Compensator(law.A, law.B, law.C, law.D, **options)


def coupled(m: Any, k: Any) -> Any:
    """Two inputs and outputs, a direct path that depends on k, and a mass in E."""
    return [[0, 1], [-k, -1]], [[0, 1], [1, k]], [[1, 0], [0, 1]], [[0, 0.1 * k], [0.3, 0]], [[1, 0], [0, m]]


def two_by_two() -> Any:
    return malta.uncertain(coupled, {"m": 2.0, "k": 3.0}, limits={"m": (0, np.inf)})


@pytest.mark.parametrize(
    ("made", "known"),
    [
        (lambda a, b: series(a, b), lambda a, b: b * a),
        (lambda a, b: series(b, a, b), lambda a, b: b * a * b),
        (lambda a, b: parallel(a, b), lambda a, b: a + b),
        (lambda a, b: append(a, b), lambda a, b: control.append(a, b)),
        (lambda a, b: feedback(a, b), lambda a, b: control.feedback(a, b)),
        (lambda a, b: feedback(b, a, 1), lambda a, b: control.feedback(b, a, 1)),
        (lambda a, _: feedback(a, np.eye(2) / 3), lambda a, _: control.feedback(a, np.eye(2) / 3)),
    ],
)
def test_connections_are_those_of_known_systems(made: Callable[..., Any], known: Callable[..., Any]) -> None:
    system = two_by_two()
    whole = made(system, RANDOM)
    for m, k in np.random.default_rng(1).uniform(0.5, 4, (4, 2)).tolist():
        one, other = whole.state_space(m=m, k=k), known(system.state_space(m=m, k=k), RANDOM)
        np.testing.assert_allclose(one(1j * W), other(1j * W), rtol=1e-9, atol=1e-12)
    assert whole.limits == ((0, np.inf), (-np.inf, np.inf))


def test_the_margin_of_a_closed_system_is_that_of_its_loop() -> None:
    loop = malta.robust_margin(mass(), -LEAD, {"m": 0.5})
    closed = malta.robust_margin(feedback(mass(), LEAD), [[0.0]], {"m": 0.5})
    assert loop.lower is not None
    assert closed.lower == pytest.approx(loop.lower, rel=2e-3)
    assert closed.upper == pytest.approx(loop.upper, rel=2e-3)


def test_a_lag_in_series_is_the_lag_of_a_compensator() -> None:
    one = malta.robust_margin(mass(), compensator(lag=500.0), {"m": 0.5})
    other = malta.robust_margin(series(control.tf([500], [1, 500]), mass()), -LEAD, {"m": 0.5})
    assert one.lower is not None
    assert other.lower == pytest.approx(one.lower, rel=1e-3)


def test_a_compensator_is_its_state_space_in_a_connection() -> None:
    law = malta.proof.Compensator(RANDOM.A, RANDOM.B, RANDOM.C, RANDOM.D)
    one, other = (feedback(two_by_two(), K).state_space(m=3, k=2) for K in (law, RANDOM))
    np.testing.assert_array_equal(one(1j * W), other(1j * W))


def test_sampled_systems_keep_their_period() -> None:
    system = malta.uncertain(lambda k: ([[k]], [[1]], [[1]]), {"k": 0.5}, sample_time=0.1)
    closed = feedback(system, control.tf([0.3], [1, -0.2], 0.1))
    assert closed.sample_time == 0.1
    expected = control.feedback(control.ss([[0.7]], [[1]], [[1]], 0, 0.1), control.tf([0.3], [1, -0.2], 0.1))
    np.testing.assert_allclose(sorted(closed.state_space(k=0.7).poles()), sorted(expected.poles()))


def test_random_systems_lie_in_their_box_and_stay_the_same() -> None:
    drawn = random_systems(mass(), 200, {"m": (0.05, 0.2)}, seed=3)
    masses = np.array([1 / one.B[1, 0] for one in drawn])
    assert masses.min() > 0.05
    assert masses.max() < 0.2
    assert (masses < 0.1).any()
    assert (masses > 0.1).any()
    again = random_systems(mass(), 200, {"m": (0.05, 0.2)}, seed=3)
    assert all(np.array_equal(one.B, other.B) for one, other in zip(drawn, again, strict=True))


def test_a_connection_is_a_machine() -> None:
    plant = malta.linear_machine(series(control.tf([500], [1, 500]), mass()), name="lagging")
    poles = np.linalg.eigvals(malta.linearize(plant, plant.at()).A)
    assert sorted(poles.real) == pytest.approx([-500, 0, 0])


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (lambda: series(LEAD, LEAD), "series: systems: found no uncertain system"),
        (
            lambda: series(mass(), np.eye(2)),
            "series: system 2: found 2 inputs, expected as many as the 1 output",
        ),
        (lambda: parallel(mass(), np.eye(2)), r"parallel: system 2: found shape \(2, 2\)"),
        (lambda: feedback(mass(), np.eye(2)), r"feedback: law: found shape \(2, 2\)"),
        (lambda: feedback(mass(), LEAD, 2), "feedback: sign: found 2"),
        (lambda: series(mass(), control.tf([1], [1, 0.5], 0.1)), "sample_time: found 0.1 s, continuous"),
        (lambda: series(mass(), control.tf([1], [1, 0.5], True)), "dt: found True"),
        (
            lambda: series(mass(), malta.uncertain(lambda m: ([[m]], [[1]], [[1]]), {"m": 2.0})),
            "m: found nominal",
        ),
        (
            lambda: feedback(malta.uncertain(lambda k: ([[k]], [[1]], [[1]], [[1]]), {"k": 1.0}), [[-1.0]]),
            "a solution",
        ),
        (lambda: series(mass(), "lead"), "compensator: law"),
        (lambda: series(compensator(delay=2), mass()), "law: found a Compensator with a delay of 2 samples"),
        (lambda: feedback(mass(), compensator(lag=500.0)), "law: found a Compensator with .* a lag of 500"),
        (lambda: series(compensator(sample_time=0.1), mass()), "sample_time: found 0.1 s, continuous"),
        (lambda: mass().state_space(k=1), "state_space: k: found an unknown parameter"),
        (lambda: mass().state_space(m=0), "state_space: matrices: found no value"),
        (lambda: random_systems(mass(), 0, {"m": 0.1}), "count: found 0"),
        (lambda: random_systems(LEAD, 1, {"m": 0.1}), "system: found"),
        (lambda: random_systems(two_by_two(), 1, {"m": 1.5}), "a box in which m reaches its limit 0"),
    ],
)
def test_connections_that_do_not_fit_get_one_sentence(made: Callable[[], Any], sentence: str) -> None:
    with pytest.raises(malta.InputError, match=sentence):
        made()


def test_a_large_algebraic_loop_is_refused() -> None:
    n = 5
    system = malta.uncertain(
        lambda k: (ca.SX.eye(n), ca.SX.eye(n), ca.SX.eye(n), k * ca.SX.eye(n)), {"k": 0.5}
    )
    assert (
        "an algebraic loop of 5 signals"
        in refusal(lambda: feedback(system, np.eye(n)), Path("feedback")).found
    )


def test_connected_by_names_is_connected_by_hand() -> None:
    """A loop by names has the answer of `feedback`; what nothing feeds, doubles or does not exist is refused."""
    plant = malta.uncertain(
        lambda m, k: ([[0, 1], [-k / m, -0.2]], [[0], [1 / m]], [[1, 0]]), {"m": 0.1, "k": 2.0}
    )
    law = control.tf([3, 40], [1, 60], inputs="e", outputs="u")
    error = control.summing_junction(["r", "-y"], "e")
    by_names = malta.proof.interconnect([error, law, (plant, "u", "y")], ["r", "u"], ["y", "u"])
    by_hand = malta.proof.feedback(plant, law)
    w = np.array([0.1, 1.0, 7.0, 80.0])
    for values in ({"m": 0.1, "k": 2.0}, {"m": 0.05, "k": 9.0}):
        one, two = by_names.state_space(**values), by_hand.state_space(**values)
        found = one.frequency_response(w).complex
        assert found[0, 1] == pytest.approx(np.ravel(two.frequency_response(w).complex), rel=1e-9)
        K = np.ravel(control.ss(law).frequency_response(w).complex)
        assert found[0, 0] == pytest.approx(found[0, 1] * K, rel=1e-9)  # r reaches the plant by the law
        assert found[1, 0] == pytest.approx(K * (1 - found[0, 0]), rel=1e-9)  # the law's own output
    for systems, inputs, outputs, word in (
        ([(plant, "u", "y")], "r", "y", "inputs"),
        ([(plant, "u", "y"), law], "u", "y", "that nothing feeds"),
        ([(plant, "u", "y"), (plant, "u", "y")], "u", "y", "differ"),
        ([(plant, ["u", "v"], "y")], "u", "y", "1 and 1 of them"),
    ):
        with pytest.raises(malta.InputError, match=word):
            malta.proof.interconnect(systems, inputs, outputs)
