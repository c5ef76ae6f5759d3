"""A, k and l from a load cell's record, Sec. 2.1: they come back, intervals hold, bad records do not pass."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

import malta
from malta.machines.halbach import electronics
from malta.machines.halbach.load_cell import CELL_NOISE, fit_motor_law, simulated_record
from malta.machines.halbach.plant import Parameters
from malta.model.plants import plant_of
from malta_papers.halbach.experiments import identify

PAR: Parameters = malta.read("data/halbach.toml")
CURRENTS = np.array([0.0, -0.3593, 0.3593])


def record(x: Any, i: Any = CURRENTS) -> Any:
    """Forces by the motor law as the machine has it."""
    currents = np.broadcast_to(i, (len(x), 3))
    return np.array(
        [np.array(electronics.forces(PAR, a, b)).ravel() for a, b in zip(x, currents, strict=True)]
    )


def test_the_published_constants_come_back_from_the_simulated_record() -> None:
    """1.6067 N/A, 211.0001 rad/m and 29.778 mm, within intervals of a thousandth and less."""
    fit = fit_motor_law(*simulated_record(plant_of(PAR)))
    for value, half, printed, width in (
        (fit.A, fit.A_half, 1.6067, 1.1e-3),
        (fit.k, fit.k_half, 211.0001, 48e-3),
        (fit.pitch, fit.pitch_half, 29.778e-3, 6.8e-6),
    ):
        assert abs(value - printed) < 2 * half
        assert half == pytest.approx(width, rel=0.1)
    assert fit.rms == pytest.approx(CELL_NOISE, rel=0.15)
    assert abs(fit.origin) < 50e-6


@pytest.mark.slow
def test_intervals_hold_what_they_promise() -> None:
    """Of 60 records 95 %, give or take: at least 51 by the binomial law with one chance in 1000."""
    fits = [fit_motor_law(*simulated_record(plant_of(PAR), seed)) for seed in range(60)]
    assert sum(abs(fit.A - PAR.A) < fit.A_half for fit in fits) >= 51
    assert sum(abs(fit.k - PAR.k) < fit.k_half for fit in fits) >= 51


@pytest.mark.parametrize("span", [0.4, 1.0, 2.5])
@pytest.mark.parametrize("start", [-30e-3, 0.0, 0.2])
def test_any_record_of_half_a_pitch_and_more_tells(span: float, start: float) -> None:
    """Without noise, wherever the record's zero is, at random places, with currents that change on the way."""
    rng = np.random.default_rng(3)
    x = np.sort(rng.uniform(0, span * 2 * math.pi / PAR.k, 60))
    i = rng.uniform(-2, 2, (60, 3))
    i -= i.mean(axis=1, keepdims=True)  # star point
    fit = fit_motor_law(x + start, i, record(x, i))
    assert (fit.A, fit.k) == pytest.approx((PAR.A, PAR.k), rel=1e-6)
    assert fit.pitch == pytest.approx(2 * math.pi / PAR.k, rel=1e-6)
    off = math.remainder(fit.origin - start, fit.pitch)
    assert abs(off) < 1e-7
    assert abs(fit.origin - (x + start).mean()) < 0.51 * fit.pitch


def test_unequal_phases_are_no_motor_law_with_its_intervals() -> None:
    """Magnets of a phase at 0.8: the residuals say that something else is there than the cell's noise."""
    weak = plant_of(malta.read("data/halbach.toml")).variant(PAR)
    x, _, _ = simulated_record(weak)
    i = np.stack([np.sin(9e2 * x), np.cos(9e2 * x), -np.sin(9e2 * x) - np.cos(9e2 * x)], axis=1)
    F = record(x, i * [0.8, 1.0, 1.0])
    assert fit_motor_law(x, i, F).rms > 5 * CELL_NOISE
    assert fit_motor_law(x, i, record(x, i)).rms < 1e-6


X = np.linspace(0, 50e-3, 100)


@pytest.mark.parametrize(
    ("x", "i", "F", "sentence"),
    [
        (X[:7], CURRENTS, record(X[:7]), "7 places, currents (3,), forces (7, 2), expected n >= 8 places"),
        (X, CURRENTS[:2], record(X), "currents (2,)"),
        (X, CURRENTS, record(X)[:, :1], "forces (100, 1)"),
        (X, CURRENTS, record(X)[:50], "forces (50, 2)"),
        (X[0], CURRENTS, record(X), "1 places, currents (3,), forces (100, 2)"),
        (X, 0 * CURRENTS, record(X), "no current"),
        (0 * X, CURRENTS, record(X), "one place"),
        (X, CURRENTS, record(X) * math.nan, "NaN"),
    ],
)
def test_bad_records_are_refused_in_one_sentence(x: Any, i: Any, F: Any, sentence: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        fit_motor_law(x, i, F)
    assert sentence in str(caught.value)
    assert str(caught.value).isprintable()


def test_places_may_be_a_column() -> None:
    assert fit_motor_law(X[:, None], CURRENTS, record(X)) == fit_motor_law(X, CURRENTS, record(X))


def test_a_motor_that_the_noise_of_the_cell_hides_is_identified_without_its_law() -> None:
    weak = plant_of(dataclasses.replace(PAR, A=1e-3))
    e = identify(weak, malta.gains.read("design/gains/halbach.json"))
    found = {merit.label: merit.value for merit in e.merits}
    assert all(math.isnan(value) for label, value in found.items() if label.startswith("load cell"))
    assert math.isfinite(found["secant stiffness"])


def test_noise_is_no_motor() -> None:
    noise = np.random.default_rng(0).standard_normal((100, 2))
    for F in (noise, 0 * noise):
        with pytest.raises(malta.CheckError, match="no motor law explains half of the record of 100 places"):
            fit_motor_law(X, CURRENTS, F)
