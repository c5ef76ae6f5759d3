"""Sums of errors that wait, weights by position, readings that correlate with accelerations."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import control
import numpy as np
import pytest
from conftest import ROOT, refusal
from scipy import linalg

import malta
from malta import gains
from malta.errors import InputError
from malta.linear.sampling import sample, sample_noise
from malta.loops.sampled_loops import machine_loop
from malta.synthesis.filters import kalman, positions_from
from malta.synthesis.lqg import lqg
from malta.synthesis.regulators import integrals_of, lqi
from malta.synthesis.sampled_filters import sampled_filter
from malta.synthesis.spec import Spec
from malta.synthesis.weighting import Weights, weights_of

if TYPE_CHECKING:
    from pathlib import Path

    from malta.model.linearize import LinearModel
    from malta.synthesis.controller import Controller

TS = 50e-6


class Flagship(NamedTuple):
    spec: Spec
    model: LinearModel
    controller: Controller


@pytest.fixture(scope="module")
def flagship() -> Flagship:
    spec = malta.read_design(ROOT / "design" / "robust.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    return Flagship(spec, model, gains.read(ROOT / "design" / "gains" / "robust.json"))


# --- by position ---


def test_weights_of_the_sensors_errors_as_weights_of_the_positions(flagship: Flagship) -> None:
    """Equal weights w at both sensor planes are 2 w on x and 2 l_S^2 w on the tilt: the same law by either way."""
    spec, model, _ = flagship
    calibrated = malta.read_design(ROOT / "design" / "calibrated.toml").weights
    par = spec.parameters
    w = 1 / np.array([150e-6] * 4 + [30e-6]) ** 2
    by_sensor = replace(calibrated, q_i=w, q_i_base=np.ones(5), process_variance=np.full(5, 4.0))
    l_S, l_B, m, I = par.l_S, par.l_B, par.m, par.I_xx  # type: ignore[attr-defined]  # noqa: E741
    by_position = replace(
        by_sensor,
        coordinates="positions",
        q_i=np.array([2 * w[0], 2 * w[0], w[4], 2 * l_S**2 * w[0], 2 * l_S**2 * w[0]]),
        process_variance=4.0 * np.array([2 / m**2, 2 / m**2, 1 / m**2, 2 * l_B**2 / I**2, 2 * l_B**2 / I**2]),
    )
    one, other = (lqg(model, weights, TS) for weights in (by_sensor, by_position))
    for name in ("K", "Ki", "L"):
        expected = getattr(one, name)
        np.testing.assert_allclose(
            getattr(other, name), expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max()
        )
    assert weights_of(other).coordinates == "positions"


def test_integrals_of_positions_by_python_control(flagship: Flagship) -> None:
    spec, model, _ = flagship
    w = spec.weights
    K, Ki = lqi(model, w)
    half = 5
    A = np.block(
        [[model.A, np.zeros((10, 5))], [-np.linalg.inv(model.C[:, :half]) @ model.C, np.zeros((5, 5))]]
    )
    gain = control.lqr(
        A, np.vstack([model.B, np.zeros((5, 5))]), linalg.block_diag(w.Q, w.Q_i), w.R, method="scipy"
    )[0]
    np.testing.assert_allclose(K, gain[:, :10], rtol=1e-5, atol=1e-6 * np.abs(K).max())
    to_positions = positions_from(model)
    np.testing.assert_allclose(Ki, -gain[:, 10:] @ to_positions, rtol=1e-5, atol=1e-6 * np.abs(Ki).max())
    assert integrals_of(model, w).weight.shape == (5, 5)


# --- correlation ---


def test_the_filter_of_correlated_noise_has_the_smallest_covariance(flagship: Flagship) -> None:
    """The error's covariance under noise drawn with the correlation, by a sum over 4000 samples: less than without."""
    spec, model, _ = flagship
    w = spec.weights
    assert w.correlation.min() > 0.25
    G = np.vstack([np.zeros((5, 5)), np.eye(5)])
    Ad, Gd = sample(model.A, G, TS)
    W = sample_noise(model.A, G * (w.process_variance * TS) @ G.T, TS)
    M = np.linalg.inv(model.C[:, :5])
    sigma_q = np.sqrt(np.diag(M @ np.diag(w.sensor_variance) @ M.T))
    S = Gd @ np.diag(w.correlation * np.sqrt(w.process_variance) * sigma_q) @ model.C[:, :5].T
    V = np.diag(w.sensor_variance)

    def error(L: np.ndarray) -> np.ndarray:
        """Variance of x - xi_hat: e = (I - L C)(Ad e_last + w) - L n, E[w n'] = S."""
        left = np.eye(10) - L @ model.C
        noise = left @ W @ left.T + L @ V @ L.T - left @ S @ L.T - L @ S.T @ left.T
        return np.diag(linalg.solve_discrete_lyapunov(left @ Ad, noise))

    best = sampled_filter(model, w, TS, 0, integrated=True)
    ignorant = sampled_filter(model, replace(w, correlation=np.zeros(5)), TS, 0, integrated=True)
    assert (error(best) < error(ignorant)).all()
    rng = np.random.default_rng(0)
    for _ in range(5):
        assert (error(best) <= error(best * (1 + 1e-3 * rng.normal(size=best.shape))) * (1 + 1e-9)).all()


def test_the_sampled_filter_of_short_samples_is_the_continuous_one(flagship: Flagship) -> None:
    spec, model, _ = flagship
    w, short = spec.weights, 1e-8
    scaled = replace(w, sensor_variance=w.sensor_variance, process_variance=w.process_variance)
    continuous = kalman(model, scaled)
    sampled = sampled_filter(model, scaled, short, 0, integrated=True) / short
    np.testing.assert_allclose(sampled, continuous, rtol=2e-2, atol=2e-3 * np.abs(continuous).max())


def test_no_correlation_is_the_filter_as_it_was(flagship: Flagship) -> None:
    spec, model, _ = flagship
    w = spec.weights
    none = sampled_filter(model, replace(w, correlation=np.zeros(0)), TS, 0, integrated=True)
    zeros = sampled_filter(model, replace(w, correlation=np.zeros(5)), TS, 0, integrated=True)
    np.testing.assert_array_equal(none, zeros)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"coordinates": "modes"}, "coordinates"),
        ({"correlation": np.full(5, 1.0)}, "correlation"),
        ({"correlation": np.full(4, 0.5)}, "correlation"),
        ({"coordinates": "signals"}, "correlation"),
    ],
)
def test_weights_by_position_refuse_what_is_none(
    flagship: Flagship, change: dict[str, object], field: str
) -> None:
    with pytest.raises(InputError) as caught:
        replace(flagship.spec.weights, **change)  # type: ignore[arg-type]
    assert caught.value.field == field


def test_positions_need_as_many_measurements() -> None:
    """Two masses, one sensor."""
    A = np.block([[np.zeros((2, 2)), np.eye(2)], [np.array([[-1.0, 1], [1, -1]]), np.zeros((2, 2))]])
    chain = malta.linear_machine(A, [[0], [0], [1], [0]], [[1, 0, 0, 0]])
    one = np.ones
    w = Weights(one(4), one(4), one(1), one(1), one(2), one(2), one(2), one(1), np.zeros(0), "positions")
    with pytest.raises(InputError, match="measurements that give all positions"):
        lqg(malta.linearize(chain, chain.at()), w, 1e-3)


# --- the design file, the gain file ---


def test_the_gain_file_keeps_what_is_new(flagship: Flagship, tmp_path: Path) -> None:
    spec, model, shipped = flagship
    files = [tmp_path / f"robust{suffix}" for suffix in (".json", ".npz", ".mat")]
    gains.write(shipped, malta.verify(model, shipped), *files)
    for file in files:
        back = gains.read(file)
        assert back.pause.tolist() == [0, 0, 0, 0, 20e-3]
        assert back.cost is not None
        assert back.noise is not None
        assert back.cost.coordinates == "positions"
        np.testing.assert_array_equal(back.noise.correlation, spec.weights.correlation)
        np.testing.assert_array_equal(back.feedforward.position, shipped.feedforward.position)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ('coordinates = "positions"', 'coordinates = "modes"', "coordinates"),
        ('coordinates = "positions"', 'coordinates = "signals"', ""),
        ('pause = { z = { value = 20, unit = "mm/s" } }', 'pause = { z = { value = 3, unit = "mm" } }', "pause.z"),
        ('pause = { z = { value = 20, unit = "mm/s" } }', 'pause = { w = { value = 3, unit = "mm/s" } }', "pause.w"),
        ('pause = { z = { value = 20, unit = "mm/s" } }', 'pause = { z = { value = 0, unit = "mm/s" } }', "pause.z"),
        ("correlation = { x = 0.89746", "correlation = { x = 1.5", "noise.correlation.x"),
    ],
)  # fmt: skip
def test_a_wrong_entry_gets_one_sentence(tmp_path: Path, old: str, new: str, field: str) -> None:
    text = (ROOT / "design" / "robust.toml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    text = text.replace('"../data/', f'"{(ROOT / "data").as_posix()}/').replace(old, new)
    path = tmp_path / "robust.toml"
    path.write_text(text, encoding="utf-8")
    assert refusal(lambda: malta.read_design(path), path).field.startswith(field)


def test_a_pause_without_sums_is_refused(tmp_path: Path) -> None:
    text = (ROOT / "design" / "robust_observer.toml").read_text(encoding="utf-8")
    text = text.replace('"../data/', f'"{(ROOT / "data").as_posix()}/')
    path = tmp_path / "observer.toml"
    path.write_text('pause = { z = { value = 20, unit = "mm/s" } }\n' + text, encoding="utf-8")
    spec = malta.read_design(path)
    found = refusal(lambda: malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at())), path)
    assert found.field == "pause"


# --- the pause ---


@pytest.mark.slow
def test_sums_wait_while_the_reference_moves(flagship: Flagship) -> None:
    """A heavier machine with a weaker drive: without the pause the stroke charges the sum of axial errors."""
    spec, _, shipped = flagship
    par = spec.parameters
    other = malta.plant_of(replace(par, m=1.2 * par.m, K_D=0.8 * par.K_D))  # type: ignore[attr-defined]
    eager = replace(shipped, pause=np.zeros(0))
    overshoot = [
        malta.simulation.stroke_figures(
            malta.simulate(other, c, malta.Scenario.stroke(noise=0.0, quantize=False))
        ).overshoot
        for c in (shipped, eager)
    ]
    assert overshoot[0] < 0.8 * overshoot[1]


def test_a_reference_at_rest_is_answered_as_without_a_pause(flagship: Flagship) -> None:
    spec, _, shipped = flagship
    scenario = malta.Scenario("hold", 0.02, malta.simulation.references.hold, noise=1.0)
    runs = [malta.simulate(spec.plant, c, scenario) for c in (shipped, replace(shipped, pause=np.zeros(0)))]
    np.testing.assert_array_equal(runs[0].p, runs[1].p)


def test_both_engines_wait_alike(flagship: Flagship, monkeypatch: pytest.MonkeyPatch) -> None:
    from malta.simulation.engine import compiled as compiling

    spec, _, shipped = flagship
    scenario = replace(malta.Scenario.stroke(noise=0.0, quantize=False, fidelity="force"), duration=0.08)
    compiled = malta.simulate(spec.plant, shipped, scenario)
    monkeypatch.setattr(compiling, "compiler", lambda: None)
    interpreted = malta.simulate(spec.plant, shipped, scenario)
    assert np.abs(compiled.p - interpreted.p).max() < 1e-9 * np.abs(compiled.p).max()
    assert compiled.p[:, 4].max() > 4e-3


@pytest.mark.slow
@pytest.mark.parametrize("z", [-15e-3, 0.0, 15e-3])
def test_the_loop_whose_sums_wait_stands_the_box_too(flagship: Flagship, z: float) -> None:
    """While the sums wait, the axial loop is the one without them: stable at every corner of 350 %."""
    spec, _, shipped = flagship
    Ki = shipped.Ki.copy()
    Ki[:, 4] = 0
    waiting = replace(shipped, Ki=Ki)
    corners = np.array(np.meshgrid(*[(-1, 1)] * 4)).reshape(4, -1).T
    for signs in corners:
        values = {
            n: getattr(spec.parameters, n) * (1 + 0.7 * s)
            for n, s in zip(("m", "K_A", "K_D", "K_B"), signs, strict=True)
        }
        plant = malta.plant_of(replace(spec.parameters, **values))
        closed = machine_loop(malta.linearize(plant, plant.at(z=z)), waiting).closed
        assert np.abs(np.linalg.eigvals(closed)).max() < 1
