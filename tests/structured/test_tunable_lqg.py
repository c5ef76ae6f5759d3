"""An LQG whose weights are tuned: malta's own gains, slopes beside differences, a search, refusals."""

from __future__ import annotations

from dataclasses import replace

import control
import numpy as np
import pytest
from conftest import ROOT

import malta
from malta import structured
from malta.structured.loops import models_of_systems
from malta.synthesis import weights
from malta.synthesis.regulators import integrals_of
from malta.synthesis.structure import Structure, places_of

BODY = [[0.0, 1.0], [100.0, 0.0]], [[0.0], [1.0]], [[1.0, 0.0]]
WEIGHTS = weights(q=[1e6, 0], r=[1], w=[1e-2], v=[1e-12], q_i=[1e7])


def structure_of(law: structured.Element) -> Structure:
    m, p = law.system.D.shape
    return Structure(places_of(law, [f"u{k}" for k in range(m)], [f"y{k}" for k in range(p)]))


def test_gains_are_those_of_the_lqg_with_the_same_weights() -> None:
    spec = malta.read_design(ROOT / "design" / "table2.toml")
    model = malta.linearize(spec.plant, spec.plant.at(**spec.operating_point))
    law = structured.lqg("lqg", model, spec.weights).system
    n, summed = len(model.A), integrals_of(model, spec.weights).outputs
    (K, Ki), L = malta.synthesis.lqi(model, spec.weights), malta.synthesis.kalman(model, spec.weights)
    assert law.D.shape == (len(model.plant.inputs), len(model.plant.outputs))
    assert not law.D.any()
    for found, own in ((law.C[:, :n], K), (law.C[:, n:], Ki[:, summed]), (law.B[:n], L)):
        np.testing.assert_allclose(found, own, rtol=1e-9, atol=1e-9 * np.abs(own).max())
    np.testing.assert_array_equal(law.B[n:], np.eye(len(model.C))[summed])
    np.testing.assert_allclose(law.A[:n, :n], model.A - model.B @ K - L @ model.C, rtol=1e-9, atol=1e-6)


def test_poles_of_the_loop_are_those_of_the_regulator_and_of_the_filter() -> None:
    A, B, C = (np.array(M) for M in BODY)
    law = structured.lqg("lqg", BODY, weights([1e6, 0], [1], [1e-2], [1e-6], q_i=[1e7]))
    closed = control.feedback(control.ss(A, B, C, 0) * control.ss(*law.system), 1).poles()
    whole = np.block([[A, np.zeros((2, 1))], [-C, 0]])
    _, _, regulator = control.lqr(whole, np.vstack([B, [[0]]]), np.diag([1e6, 0, 1e7]), 1)
    _, _, estimator = control.lqe(A, B, C, 1e-2, 1e-6)
    expected = np.sort_complex(np.concatenate([regulator, estimator]))
    np.testing.assert_allclose(np.sort_complex(closed), expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m", "p"), [(2, 1, 1), (4, 2, 1), (3, 2, 2)])
def test_slopes_are_those_of_differences(n: int, m: int, p: int) -> None:
    """Of an LQG with and without integrals, and of one behind a lead, whose numbers stand beside its gains."""
    rng = np.random.default_rng(n)
    model = rng.normal(size=(n, n)), rng.normal(size=(n, m)), rng.normal(size=(p, n))
    q, r, w, v = (10 ** rng.uniform(-1, 1, size=k) for k in (n, m, m, p))
    q[0] = 0.0
    law = structured.lqg("lqg", model, weights(q, r, w, v, q_i=np.eye(p)[0] if m > 1 else None))
    if m == 1:
        law = structured.lead("lead", 3.0, 30.0) * law
    structure = structure_of(law)
    x, h = 0.3 * rng.normal(size=len(structure.parameters)), 1e-4
    theta, slope = structure.theta(x)
    for k, step in enumerate(h * np.eye(len(x))):
        differences = (structure.theta(x + step)[0] - structure.theta(x - step)[0]) / (2 * h)
        own = slope[:, k].reshape(theta.shape, order="F")
        np.testing.assert_allclose(own, differences, rtol=1e-5, atol=1e-6 * np.abs(own).max())


def test_parameters_are_sizes_and_a_weight_of_zero_has_none() -> None:
    law = structured.lqg("lqg", BODY, WEIGHTS, bounds={"input.u0": (0.5, 2.0)})
    assert law.values == pytest.approx(
        {
            "lqg.state.x0": 1e-3,
            "lqg.integral.y0": 10**-3.5,
            "lqg.input.u0": 1.0,
            "lqg.process.u0": 0.1,
            "lqg.sensor.y0": 1e-6,
        }
    )
    changed = law.at({"lqg.state.x0": 2e-3}).system
    own = structured.lqg("own", BODY, weights([2.5e5, 0], [1], [1e-2], [1e-12], q_i=[1e7])).system
    np.testing.assert_allclose(changed.C, own.C, rtol=1e-12)
    assert np.exp(structure_of(law).bounds[2]) == pytest.approx([0.5, 2.0])


def test_common_factors_of_weights_change_nothing() -> None:
    """Only ratios matter, of the cost and of the noise: slopes along them vanish."""
    structure = structure_of(structured.lqg("lqg", BODY, WEIGHTS))
    theta, slope = structure.theta(np.zeros(5))
    for direction in ([1, 1, 1, 0, 0], [0, 0, 0, 1, 1]):
        moved = slope @ np.array(direction, dtype=float)
        assert np.abs(moved).max() < 1e-9 * np.abs(slope).max()
    assert np.abs(slope).max() > 0.01 * np.abs(theta).max()


@pytest.mark.slow
def test_weights_are_found_that_hold_a_peak_and_a_noise() -> None:
    """From weights whose loop peaks at 2.2: goals on |S| and noise of the force hold, and the law is still an LQG."""
    plant = control.c2d(control.ss(*BODY, 0), 1e-3)
    (model,) = models_of_systems(plant)
    start = structured.lqg("lqg", BODY, weights([1e4, 0], [1], [1e-2], [1e-8]))
    goals = [
        structured.sensitivity(1.6),
        structured.soft(structured.noise_limit({f"reference {model.outputs[0]}": 1e-6}, "force", 1e-3)),
    ]
    found = structured.tune(plant, start, goals, starts=1)
    assert found.reached["sensitivity 1.6"] == pytest.approx(1.0, abs=6e-3)
    one = [found.values[f"lqg.{key}"] for key in ("state.x0", "input.u0", "process.u0", "sensor.y0")]
    asked = weights([one[0] ** -2, 0], [one[1] ** -2], [one[2] ** 2], [one[3] ** 2])
    cart = malta.linear_machine(*BODY)
    lqg = malta.linearize(cart, cart.at())
    np.testing.assert_allclose(found.law.C, malta.synthesis.lqr(lqg, asked), rtol=1e-9)
    np.testing.assert_allclose(found.law.B, malta.synthesis.kalman(lqg, asked), rtol=1e-9)


@pytest.mark.parametrize(
    ("model", "weights", "words"),
    [
        (BODY, weights([1, 1, 1], [1], [1], [1]), r"lqg\.q.*3 entries"),
        (BODY, weights([1, 1], [1, 1], [1], [1]), r"lqg\.r.*2 entries"),
        (BODY, weights([1, 1], [1], [1], [1, 1]), r"lqg\.q_i|sensor_variance"),
        (([[0, 1], [100, 0]], [[0], [0]], [[1, 0]]), weights([1, 1], [1], [1], [1]), "no force moves the mode"),
        (([[0, 1], [100, 0]], [[0], [1]], [[0, 0]]), weights([1, 1], [1], [1], [1]), "no sensor sees the mode"),
        (([[0, 1], [0, 0]], [[0], [1]], [[1, 0]]), weights([0, 0], [1], [1], [1]), "LQR: .*weights whose LQG"),
        (control.tf([1, 1], [1, 2]), weights([1], [1], [1], [1]), "without D"),
        (([[0, 1]], [[1]], [[1]]), weights([1], [1], [1], [1]), "matrices that fit"),
    ],
)  # fmt: skip
def test_what_has_no_lqg_is_refused_in_one_sentence(
    model: object, weights: malta.synthesis.Weights, words: str
) -> None:
    model = control.ss(model) if hasattr(model, "num") else model
    with pytest.raises(malta.InputError, match=words):
        structured.lqg("lqg", model, weights)


def test_weights_of_positions_and_observed_disturbances_are_refused() -> None:
    spec = malta.read_design(ROOT / "design" / "robust.toml")
    with pytest.raises(malta.InputError, match="found positions, expected weights of signals"):
        structured.lqg("lqg", malta.linearize(spec.plant, spec.plant.at()), spec.weights)
    drifting = replace(weights([1, 1], [1], [1], [1]), drift_variance=np.ones(1))
    with pytest.raises(malta.InputError, match="found a drift"):
        structured.lqg("lqg", BODY, drifting)
