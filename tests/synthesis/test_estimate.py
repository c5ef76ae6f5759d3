"""Kalman filters that start knowing nothing: against Riccati's equation, in a lift-off, and on what is no number."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import pytest

import malta
from malta import gains, references
from malta.simulation.scenario import ESTIMATORS, Estimator, Fault, Scenario
from malta.simulation.trajectory import Trajectory
from malta.synthesis.riccati import dare

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray
    from malta.machines.tubular import plant as tubular
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

Ts = 50e-6
# Equal to the compiled engine (test_engine.py), and no compilation for a single run.
VIRTUAL: Final = "virtual machine"
# Which measurements enter which of the ten states at z = 0: x beta, y alpha, z and their rates.
GROUPS = ((("x1", "x2"), (0, 4, 5, 9)), (("y1", "y2"), (1, 3, 6, 8)), (("z",), (2, 7)))


@pytest.fixture(scope="module")
def calibrated(designs: dict[str, Design]) -> Design:
    return designs["calibrated"]


def _hold(samples: int, estimator: Estimator, **options: Any) -> Scenario:
    return Scenario(
        "hold",
        samples * Ts,
        lambda plant: references.hold(plant),
        **{"fidelity": "force", "estimator": estimator} | options,
    )


def _gain(design: Design, c: Controller, estimator: Estimator, samples: int) -> FloatArray:
    """What the filter makes of a measurement at its last sample, column by column: each sensor 1 um off there, once."""
    names = [s.name for s in c.measurements]
    at = (samples - 1.5) * Ts

    def ends(*sensors: str) -> FloatArray:
        faults = tuple(Fault("biased sensor", at, what=sensor, size=1e-6) for sensor in sensors)
        run = malta.simulate(design.plant, c, _hold(samples, estimator, faults=faults))
        assert run.verdict.completed
        return np.asarray(run.xi_hat[-1])

    gain = np.zeros((10, 5))
    plain = ends()
    for k in (0, 1):
        moved = (ends(*(sensors[k] for sensors, _ in GROUPS if k < len(sensors))) - plain) / 1e-6
        for sensors, rows in GROUPS:
            if k < len(sensors):
                gain[list(rows), names.index(sensors[k])] = moved[list(rows)]
    return gain


def _steady(c: Controller) -> FloatArray:
    """The filter's gain of Riccati's equation, with the covariances that the filters are given."""
    assert c.noise is not None
    W, V = c.Bd * c.noise.process @ c.Bd.T, np.diag(c.noise.sensor)
    P = dare(c.Ad.T, c.Cd.T, W, V).X
    return np.asarray(np.linalg.solve(c.Cd @ P @ c.Cd.T + V, c.Cd @ P).T)


RADIAL = [0, 1, 3, 4, 5, 6, 8, 9]


@pytest.mark.slow
@pytest.mark.parametrize("discretization", ["zoh", "sampled-data"])
def test_the_gain_settles_at_riccatis(calibrated: Design, discretization: Any) -> None:
    """After 20 ms the radial gains, measured on the running filter, are the solution's to 1e-8. Under a zero-order hold
    that is the gain file's L; "sampled-data" spreads the force noise over the sample, which moves L by 1e-6."""
    c = malta.lqg(calibrated.model, calibrated.spec.weights, Ts, discretization)
    expected = _steady(c)
    found = _gain(calibrated, c, "kalman", 400)
    size = np.abs(expected).max(axis=0)[:4]
    assert (np.abs(found - expected)[:, :4].max(axis=0) < 1e-8 * size).all()
    apart = np.abs(found - c.L)[:, :4].max() / size.max()
    assert apart < (1e-8 if discretization == "zoh" else 5e-6)
    assert discretization == "zoh" or apart > 1e-7


@pytest.mark.slow
def test_the_axial_gain_settles_too(calibrated: Design) -> None:
    """With 1e4 times the force noise its slow pair is ten times as fast: 600 samples then settle it to 1e-6."""
    weights = calibrated.spec.weights
    wide = replace(weights, process_variance=1e4 * weights.process_variance)
    c = malta.lqg(calibrated.model, wide, Ts, "zoh")
    run, biased = (
        malta.simulate(calibrated.plant, c, _hold(600, "kalman", faults=faults))
        for faults in ((), (Fault("biased sensor", 598.5 * Ts, what="z", size=1e-6),))
    )
    found = (biased.xi_hat[-1] - run.xi_hat[-1])[[2, 7]] / 1e-6
    assert found == pytest.approx(c.L[[2, 7], 4], rel=1e-6)


@pytest.mark.slow
def test_the_extended_filter_is_the_linear_one_where_the_machine_is_linear(calibrated: Design) -> None:
    """In x and beta, which neither gravity nor cogging moves, at the centre: the same gain to 1e-8."""
    expected = _steady(calibrated.controller)
    found = _gain(calibrated, calibrated.controller, "extended", 400)
    rows = [0, 4, 5, 9]
    np.testing.assert_allclose(found[rows][:, [0, 2]], expected[rows][:, [0, 2]], rtol=1e-7)
    # Gravity on a tilted mover, and z into alpha, couple a little into y and alpha.
    rows = [1, 3, 6, 8]
    np.testing.assert_allclose(found[rows][:, [1, 3]], expected[rows][:, [1, 3]], rtol=5e-3)


@pytest.mark.parametrize("estimator", ["kalman", "extended"])
def test_it_starts_with_what_two_measurements_tell(calibrated: Design, estimator: Estimator) -> None:
    """After the first sample: positions as measured, no speed. After the second the speed is all but their difference:
    its variance was 2 s^2 / Ts^2, against s^2 / Ts^2 of a measurement's, so two thirds of it are believed at first."""
    run = malta.simulate(calibrated.plant, calibrated.controller, _hold(3, estimator, noise=1.0, cold=True))
    at = np.array(calibrated.plant.position_of(run.y[0])).ravel()
    assert run.xi_hat[0, :5] == pytest.approx(at, abs=1e-12)
    assert not np.abs(run.xi_hat[0, 5:]).any()
    x = run.xi_hat[:, [0, 4]]
    measured = np.array([np.array(calibrated.plant.position_of(y)).ravel()[[0, 4]] for y in run.y])
    speed = (measured[1] - measured[0]) / Ts
    share = run.xi_hat[1, [5, 9]] / speed
    assert share == pytest.approx([0.5, 0.5], abs=0.1)
    assert np.abs(x[1] - measured[1]).max() < np.abs(measured[1] - measured[0]).max()


# Lift-off


def _rest(par: tubular.Parameters) -> float:
    """y of a mover at rest on its bearings, m: weight and attraction compress them."""
    return -par.r_max - (par.m * par.g + 2 * par.K_A * par.r_max) / (2 * par.k_t - 2 * par.K_A)


def _lift_off(
    plant: Plant, controller: Controller, par: tubular.Parameters, estimator: Estimator, **options: Any
) -> Trajectory:
    scenario = _hold(500, estimator, start={"y": _rest(par)}, cold=True, bearing=True, **options)
    return malta.simulate(plant, controller, scenario, engine=VIRTUAL)


@pytest.mark.slow
@pytest.mark.parametrize(("fidelity", "passes"), [("force", 0.25e-3), ("dq", 0.15e-3)])
def test_a_lift_off_overshoots_little_with_a_filter_that_starts_wide(
    calibrated: Design, par: tubular.Parameters, fidelity: Any, passes: float
) -> None:
    """From rest at -0.6 mm without current: the steady-state filter, which expects the mover at the centre, throws it
    0.2 to 0.3 mm beyond; with either of the others it stays within 25 um. Integrals of 1 s, which hardly fill."""
    controller, beyond = gains.read("design/gains/calibrated_slow.json"), {}
    for estimator in ESTIMATORS:
        run = _lift_off(calibrated.plant, controller, par, estimator, fidelity=fidelity, noise=1.0)
        assert run.verdict.completed
        assert run.contact[0].max() > 1
        assert run.contact[-100:, :2].max() < 0.1
        beyond[estimator] = run.p[:, [1, 3]].max()
    assert beyond["steady-state"] > passes
    assert max(beyond["kalman"], beyond["extended"]) < 25e-6


@pytest.mark.slow
def test_only_the_extended_filter_knows_what_holds_a_mover_at_rest(
    calibrated: Design, par: tubular.Parameters
) -> None:
    """A controller that may use no force: the mover stays on its bearings. The linear filters take it to be falling,
    by up to 0.2 m/s; the extended one knows the bearings, and that it stands."""
    c = calibrated.controller
    idle = replace(c, limits=replace(c.limits, force=np.full(5, 1e-9)))
    speeds, places = {}, {}
    for estimator in ESTIMATORS:
        run = malta.simulate(
            calibrated.plant,
            idle,
            _hold(200, estimator, start={"y": _rest(par)}, cold=True, bearing=True),
            engine=VIRTUAL,
        )
        assert run.verdict.name == "not lifted"
        assert np.abs(run.x[:, 7]).max() < 1e-10
        speeds[estimator] = np.abs(run.xi_hat[:, 6]).max()
        places[estimator] = abs(run.xi_hat[-1, 1] - _rest(par))
    assert speeds["extended"] < 1e-9
    assert places["extended"] < 1e-12
    assert min(speeds["kalman"], speeds["steady-state"]) > 0.05
    assert min(places["kalman"], places["steady-state"]) > 50e-6


# In flight


@pytest.mark.slow_for("kalman", "extended")
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_every_filter_flies_a_stroke(calibrated: Design, estimator: Estimator) -> None:
    """5 mm in 6 ms with noise, on the drive in dq: within what the paper allows of a slower one, and each estimates the
    places better than they are measured."""
    scenario = Scenario.stroke(5e-3, rise=6e-3, duration=0.04, estimator=estimator, noise=1.0)
    run = malta.simulate(calibrated.plant, calibrated.controller, scenario, engine=VIRTUAL)
    assert run.verdict.completed
    assert np.abs(run.p[:, :4]).max() < 5e-6
    assert np.abs(run.p - run.reference)[:, 4].max() < 0.7e-3
    error = (run.xi_hat - run.x[:, list(calibrated.plant.controlled)])[200:]
    places = np.sqrt((error[:, :2] ** 2).mean(axis=0))
    assert places.max() < 0.5e-6 / math.sqrt(2) / 2


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["kalman", "extended"])
def test_filters_of_a_design_with_delay_know_what_is_under_way(
    calibrated: Design, estimator: Estimator
) -> None:
    """Forces sent but not yet acting stand in the estimate, the oldest first; after a step the estimate is as good."""
    c = malta.lqg(calibrated.model, calibrated.spec.weights, Ts, "sampled-data", 2)
    run = malta.simulate(
        calibrated.plant,
        c,
        Scenario.stroke(5e-3, rise=10e-3, duration=0.02, fidelity="force", delay=2, estimator=estimator),
        engine=VIRTUAL,
    )
    assert run.verdict.completed
    v0 = np.array([c.feedforward.at(z) for z in run.y[:, 4]])
    sent = run.v - v0
    np.testing.assert_allclose(run.xi_hat[2:, 10:15], sent[:-2], rtol=0, atol=1e-9)
    np.testing.assert_allclose(run.xi_hat[2:, 15:20], sent[1:-1], rtol=0, atol=1e-9)
    assert not run.xi_hat[0, 10:].any()


@pytest.mark.slow_for("0.002-1e+30-extended")
@pytest.mark.parametrize("estimator", ["kalman", "extended"])
@pytest.mark.parametrize("size", [math.nan, math.inf, 1e30, 1e308])
@pytest.mark.parametrize("at", [0.0, 40 * Ts])
def test_a_filter_that_is_lost_ends_its_run_with_a_verdict(
    calibrated: Design, estimator: Estimator, size: float, at: float
) -> None:
    """A sensor that says no number, or an absurd one: no warning, no error; and never "completed" before the end."""
    faults = (Fault("biased sensor", at, what="x1", size=size),)
    run = malta.simulate(calibrated.plant, calibrated.controller, _hold(100, estimator, faults=faults))
    assert run.verdict.name in ("diverged", "touchdown at sensor plane 1", "touchdown at sensor plane 2")
    assert at <= run.verdict.time == run.t[-1]
    assert len(run.x) == len(run.t) == len(run.v)


@pytest.mark.slow_for("extended")
@pytest.mark.parametrize("estimator", ["kalman", "extended"])
def test_a_filter_sees_what_the_sensors_of_a_changed_machine_say(
    calibrated: Design, estimator: Estimator
) -> None:
    """A frame that is knocked at 2 ms moves the sensor planes of a tilted mover by 5 mm: y changes, and the estimate
    with it, at that sample."""
    scenario = _hold(42, estimator, start={"beta": 5e-5})
    changes = ((2e-3, {"l_S": 98.75e-3}),)
    knocked, plain = (
        malta.simulate(calibrated.plant, calibrated.controller, replace(scenario, changes=c))
        for c in (changes, ())
    )
    assert np.array_equal(knocked.y[:40], plain.y[:40])
    assert np.abs(knocked.y[40] - plain.y[40]).max() > 1e-8
    assert np.abs(knocked.xi_hat[40] - plain.xi_hat[40]).max() > 1e-10
