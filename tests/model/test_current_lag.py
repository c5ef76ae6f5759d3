"""The lag of the current loops in the design model: forces as states."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import control
import numpy as np
import pytest
from conftest import ROOT, refusal
from scipy import linalg

import malta
from malta.errors import InputError
from malta.linear.matrices import add_integrals, eigenvalues
from malta.linear.sampling import delay_inputs, sample, sample_cost
from malta.loops.sampled_loops import machine_loop, sampled_loop
from malta.simulation.inputs import lagging_references
from malta.synthesis.controller import Controller
from malta.synthesis.design_models import with_lags
from malta.synthesis.lqg import gains, lqg
from malta.synthesis.regulators import integrals_of
from malta.synthesis.separation import controller_poles
from malta.synthesis.spec import Spec
from malta.synthesis.weighting import weights

if TYPE_CHECKING:
    from pathlib import Path

    from malta.model.linearize import LinearModel

TS = 50e-6


class Made(NamedTuple):
    """The flagship's weights on a design model with a lag and a sample of delay."""

    spec: Spec
    model: LinearModel
    controller: Controller


@pytest.fixture(scope="module")
def made() -> Made:
    spec = replace(malta.read_design(ROOT / "design" / "robust.toml"), current_lag=True, delay=1)
    model = malta.linearize(spec.plant, spec.plant.at())
    return Made(spec, model, malta.synthesize(spec, model))


def test_the_gains_are_those_of_the_model_with_lags_and_delay(made: Made) -> None:
    """By scipy on the sampled model: 10 mechanical states, 5 lagging and 5 stored forces, 5 integrals."""
    c, w, rate = made.controller, made.spec.weights, made.spec.plant.actuator.crossover
    A, B, _, _ = with_lags(made.model, rate)
    Ad, Bd = delay_inputs(*sample(A, B, TS), 1)
    np.testing.assert_allclose(c.Ad, Ad, rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(c.Bd, Bd, rtol=1e-12, atol=1e-300)
    names = [s.name for s in c.states]
    assert names[9:11] == ["beta_dot", "fx_B1[i]"]
    assert names[15:] == [f"{s.name}[k-1]" for s in c.forces]
    assert (c.lagging, c.delay, c.observed) == (1, 1, 0)
    Q, N, R = sample_cost(A, B, linalg.block_diag(w.Q, np.zeros((5, 5))), w.R, TS)
    zeros = np.zeros((5, 5))
    Q_i = integrals_of(made.model, w).weight * TS
    full = np.block([[Q, N, np.zeros((15, 5))], [N.T, R - w.R * TS, zeros], [np.zeros((5, 20)), Q_i]])
    Ai, Bi = add_integrals(c.Ad, c.Bd, c.Cd, TS)
    X, _, _ = control.dare(Ai, Bi, full, w.R * TS, method="scipy")
    K = np.linalg.solve(w.R * TS + Bi.T @ X @ Bi, Bi.T @ X @ Ai)
    np.testing.assert_allclose(c.K, K[:, :20], rtol=1e-4, atol=1e-4 * np.abs(c.K).max())
    np.testing.assert_allclose(c.Ki, -K[:, 20:], rtol=1e-4, atol=1e-4 * np.abs(c.Ki).max())


def test_the_filter_knows_the_forces_from_the_commands(made: Made) -> None:
    without = malta.synthesize(replace(made.spec, current_lag=False, delay=0), made.model)
    np.testing.assert_array_equal(made.controller.L[:10], without.L)
    assert not made.controller.L[10:].any()


def test_the_machines_loop_is_the_design_model_closed(made: Made) -> None:
    """On the design's own machine, without its loads, regulator and filter separate: the model is exact."""
    model = malta.linearize(made.spec.plant, made.spec.plant.at())
    closed = np.sort(
        np.abs(eigenvalues(sampled_loop(model, made.controller, delay=1, current_loops="lag").closed))
    )
    regulator, observer = controller_poles(made.controller)
    apart = np.sort(np.abs(np.concatenate([regulator, observer])))
    np.testing.assert_allclose(closed[-30:], apart[-30:], atol=1e-6)
    assert np.abs(eigenvalues(machine_loop(model, made.controller).closed)).max() < 1


def test_a_constant_disturbance_is_taken_off_by_an_observer_too(made: Made) -> None:
    w = made.spec.weights
    observing = replace(w, q_i=np.zeros(5), drift_variance=np.full(5, 1e-3))
    c = lqg(made.model, observing, TS, delay=1, current_lag=True)
    assert (c.lagging, c.delay, c.observed) == (1, 1, 1)
    found = malta.loops.recovery(made.spec.plant, c)[0].outputs[0]
    assert abs(found.final) < 1e-6 * found.largest
    assert math.isfinite(found.settled)


def test_the_gain_file_says_so(made: Made, tmp_path: Path) -> None:
    margins = malta.verify(made.model, made.controller)
    files = [tmp_path / f"lag{suffix}" for suffix in (".json", ".npz", ".mat")]
    malta.gains.write(made.controller, margins, *files)
    for file in files:
        back = malta.gains.read(file)
        assert back.states == made.controller.states
        np.testing.assert_array_equal(back.K, made.controller.K)
        assert (back.lagging, back.delay) == (1, 1)
    content = json.loads(files[0].read_text(encoding="utf-8"))
    assert content["version"] == 2
    assert content["law"] == {"tracks": "states", "coordinates": "positions", "pause": [0, 0, 0, 0, 0.02]}


def test_where_there_is_no_such_lag_it_is_refused(made: Made, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="backward-euler"):
        lqg(made.model, made.spec.weights, TS, "backward-euler", current_lag=True)
    ball = malta.linear_machine([[0, 1], [900, 0]], [[0], [2]], [[1, 0]])
    w = weights([1e4, 1], [1], [1e-2], [1e-12])
    with pytest.raises(InputError, match="follow their commands at once"):
        lqg(malta.linearize(ball, ball.at()), w, TS, current_lag=True)
    for name in ("halbach", "halbach_pid"):
        text = (ROOT / "design" / f"{name}.toml").read_text(encoding="utf-8")
        text = text.replace('"../data/', f'"{(ROOT / "data").as_posix()}/')
        path = tmp_path / f"{name}.toml"
        path.write_text(f"current_lag = true\n{text}", encoding="utf-8")
        if name == "halbach_pid":
            assert refusal(lambda: malta.read_design(path), path).field == "current_lag"  # noqa: B023
        else:
            spec = malta.read_design(path)
            with pytest.raises(InputError, match="current_lag"):
                malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def test_the_references_of_lagging_forces_are_what_the_model_makes_of_the_commands(made: Made) -> None:
    c, rng = made.controller, np.random.default_rng(1)
    v = rng.normal(size=(60, 5))
    n = len(c.A)
    xi = np.concatenate([np.zeros(n), v[0], v[0]])  # at rest before
    found = []
    for command in v:
        found.append(xi[n : n + 5])
        xi = np.concatenate([np.zeros(n), (c.Ad @ xi + c.Bd @ command)[n:]])
    np.testing.assert_allclose(lagging_references(c, v), found, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["steady-state", "kalman", "extended"])
def test_a_stroke_goes_as_with_the_flagship(made: Made, estimator: str) -> None:
    """The references of all states follow the stroke: what is left is cogging and gravity's coupling."""
    scenario = malta.Scenario.stroke(fidelity="force", noise=0.0, quantize=False, estimator=estimator)
    figures = malta.simulation.stroke_figures(malta.simulate(made.spec.plant, made.controller, scenario))
    shipped = malta.gains.read(ROOT / "design" / "gains" / "robust.json")
    flown = malta.simulation.stroke_figures(malta.simulate(made.spec.plant, shipped, scenario))
    assert figures.axial_error < 1.2 * flown.axial_error
    assert max(figures.radial.values()) < 1.2 * max(flown.radial.values())


def test_gains_without_a_lag_are_as_they_were() -> None:
    """A design file that says nothing of a lag keeps its gains and its fingerprint."""
    spec = malta.read_design(ROOT / "design" / "calibrated.toml")
    shipped = malta.gains.read(ROOT / "design" / "gains" / "calibrated.json")
    assert spec.sha256 == shipped.spec_sha256
    model = malta.linearize(spec.plant, spec.plant.at())
    found = gains(model, spec.weights, spec.sample_time, spec.discretization, 0)
    np.testing.assert_allclose(found.K, shipped.K, rtol=1e-9, atol=1e-9 * np.abs(shipped.K).max())
