"""Peaks of noise over a time: against samples of the same sequence, and against an hour of flights."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.linear.matrices import covariance
from malta.loops.loop import Loop
from malta.loops.noise import noise_of, noise_variance
from malta.synthesis.controller import Controller


@pytest.fixture(scope="module")
def controller() -> Controller:
    return malta.gains.read(ROOT / "design" / "gains" / "robust.json")


@pytest.fixture(scope="module")
def loop(controller: Controller) -> Loop:
    return malta.loop(malta.plant_of(controller.parameters), controller)


def test_sequences_stay_below_their_peaks_at_least_as_often_as_asked(loop: Loop) -> None:
    """500 runs of the linear loop, 300 samples each, from its stationary state on."""
    s, rng, runs, samples = loop.sampled, np.random.default_rng(0), 500, 300
    noise = np.vstack([s.Bd @ s.control.D_y, s.control.B_y]) * np.sqrt(noise_variance(loop.plant))
    size, along = np.linalg.eigh(covariance(s.closed, noise @ noise.T))
    x, n = along * np.sqrt(np.maximum(size, 0)) @ rng.standard_normal((len(size), runs)), len(s.Ad)
    motion, force = np.zeros((2, len(s.outputs), runs))
    for _ in range(samples):
        drawn = rng.standard_normal((noise.shape[1], runs))
        read = s.Cd @ x[:n] + np.sqrt(noise_variance(loop.plant))[:, None] * drawn
        np.maximum(motion, np.abs(s.outputs @ x[:n]), out=motion)
        sent = s.control.D_y @ read + s.control.C @ x[n:]
        np.maximum(force, np.abs(sent[: len(force)]), out=force)
        x = s.closed @ x + noise @ drawn
    for probability in (0.5, 0.9):
        peaks = malta.loops.noise_peaks(loop, samples * loop.controller.sample_time, probability)
        deviation = np.sqrt(probability * (1 - probability) / runs)
        for found, level in ((motion, peaks.motion), (force, peaks.force)):
            below = (found < level[:, None]).mean(axis=1)
            assert (
                below > probability - 5 * deviation
            ).all()  # rises come in clumps, where they are not rare
        assert below[:4] == pytest.approx(probability, abs=5 * deviation)


def test_one_sample_has_the_normal_distribution(loop: Loop) -> None:
    """Within 1.96 rms with 95 %, and further the longer it lasts."""
    one = malta.loops.noise_peaks(loop, 1e-9, 0.95)
    rms = noise_of(loop.sampled, loop.plant)
    samples = 2 * 0.05  # a level of one sample, and a rise above it after that
    assert one.motion / rms.motion == pytest.approx(1.96, abs=samples)
    day, hour = (malta.loops.noise_peaks(loop, t).motion for t in (86400.0, 3600.0))
    assert (day > hour).all()
    assert (hour > 5 * rms.motion).all()


@pytest.mark.slow
def test_an_hour_of_flights_stays_within(loop: Loop, controller: Controller) -> None:
    """900 nonlinear flights of 4 s, sensors without steps: their largest motion between the levels of 1 and 99 %."""
    sensors = replace(loop.plant.sensors, resolution=(0.0,) * len(loop.plant.outputs))
    plant = replace(loop.plant, sensors=sensors)
    largest = np.zeros(len(plant.outputs))
    for seed in range(900):
        hold = malta.Scenario("hold", 4.0, malta.references.hold, noise=1.0, seed=seed)
        largest = np.maximum(largest, np.abs(malta.simulate(plant, controller, hold).p).max(axis=0))
    smooth = malta.loop(plant, controller)
    low, high = (malta.loops.noise_peaks(smooth, 3600.0, p).motion for p in (0.01, 0.99))
    assert (low < largest).all()
    assert (largest < high).all()


@pytest.mark.parametrize(
    ("options", "field"), [({"seconds": 0.0}, "seconds"), ({"probability": 1.0}, "probability")]
)
def test_no_time_and_no_chance_are_refused(loop: Loop, options: dict[str, Any], field: str) -> None:
    with pytest.raises(malta.InputError, match=field):
        malta.loops.noise_peaks(loop, **options)
