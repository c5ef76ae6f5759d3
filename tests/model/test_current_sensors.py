"""Sensors of the phase currents: noise, offsets and steps, in the drives that simulate windings."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.machines.tubular.drive import SIGNS
from malta.model.plants import plant_of
from malta.simulation.engine.batch import record_run
from malta.simulation.layout import noise_scales
from malta.simulation.scenario import Scenario, setup_of
from malta.simulation.simulate import simulate

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.simulation.trajectory import Trajectory

ELECTRIC = ("dq", "phase")
SMALL = 1e-12  # A


@pytest.fixture(scope="module")
def controller() -> malta.synthesis.Controller:
    return malta.gains.read("design/gains/calibrated.json")


def held(controller: Any, engine: Any = "auto", duration: float = 0.02, **changes: Any) -> Trajectory:
    """A hold at the middle: parameters of the machine by name, else options of the scenario."""
    names = {"s_i", "d_i", "q_i"} & set(changes)
    own: Any = {name: changes.pop(name) for name in names}
    scenario = Scenario("hold", duration, malta.references.hold, **changes)
    return simulate(plant_of(replace(controller.parameters, **own)), controller, scenario, engine=engine)


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ELECTRIC)
def test_both_engines_agree(controller: Any, fidelity: Any) -> None:
    """Without steps, whose edges turn rounding into steps."""
    own: Any = {"s_i": 0.02, "d_i": 0.01, "fidelity": fidelity, "noise": 1.0}
    one, two = (held(controller, engine, **own) for engine in ("compiled", "virtual machine"))
    np.testing.assert_allclose(one.p, two.p, rtol=0, atol=1e-14)
    assert one.verdict.completed


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ELECTRIC)
def test_ideal_sensors_are_the_limit(controller: Any, fidelity: Any) -> None:
    ideal = held(controller, fidelity=fidelity)
    for name in ("d_i", "q_i"):
        almost = held(controller, fidelity=fidelity, **{name: SMALL})
        np.testing.assert_allclose(almost.p, ideal.p, rtol=0, atol=1e-14)
        assert (almost.p != ideal.p).any()
    noisy, not_noisy = (held(controller, fidelity=fidelity, noise=1.0, **{n: SMALL}) for n in ("s_i", "d_i"))
    np.testing.assert_allclose(noisy.p, not_noisy.p, rtol=0, atol=1e-14)


@pytest.mark.slow
def test_currents_that_follow_at_once_have_no_sensors(controller: Any) -> None:
    """At fidelity force currents are lags of their commands: the bits are those of ideal sensors."""
    one, two = (held(controller, fidelity="force", noise=1.0, s_i=s) for s in (0.0, 0.1))
    assert (one.p == two.p).all()


@pytest.mark.slow
def test_noise_of_the_sensors_is_that_of_their_axes(controller: Any) -> None:
    """The voltage of an axis jumps by Kp times the noise that its transformation leaves of 9 phases."""
    plant = plant_of(replace(controller.parameters, s_i=0.05))
    rows = np.array([
        held(controller, duration=1e-4, s_i=0.05, noise=1.0, fidelity="dq", run=k).u[0] for k in range(400)
    ])  # fmt: skip
    quiet = held(controller, duration=1e-4, fidelity="dq").u[0]
    loop = controller.current_loop
    T = np.array(ca.DM(ca.evalf(ca.SX(plant.drive.to_axes(ca.SX(ca.DM(plant.at().x)))))))
    expected = (loop.Kp + loop.Ki * loop.sample_time) * 0.05 * np.sqrt((T**2).sum(axis=1))
    spread = np.sqrt(((rows - quiet) ** 2).mean(axis=0))
    # The sensors of the outputs add what the law makes of their noise.
    outputs = np.array([
        held(controller, duration=1e-4, noise=1.0, fidelity="dq", run=k).u[0] for k in range(400)
    ])  # fmt: skip
    both = np.sqrt(expected**2 + ((outputs - quiet) ** 2).mean(axis=0))
    np.testing.assert_allclose(spread, both, rtol=0.12)


def test_offsets_show_in_every_axis(controller: Any) -> None:
    """The integrals bring the currents that are read to their commands, so the true ones are off by the offsets."""
    plant = plant_of(replace(controller.parameters, d_i=0.01))
    T = ca.DM(ca.evalf(ca.SX(plant.drive.to_axes(ca.SX(ca.DM(plant.at().x))))))
    axes: FloatArray = np.array(T @ ca.DM(list(SIGNS))).ravel() * 0.01
    with_force = [k for k, axis in enumerate(plant.drive.axes) if not axis.name.startswith("i_0d")]
    assert abs(axes[with_force]).min() > 3e-3
    assert sum(SIGNS) == 0
    run = held(controller, duration=0.5, d_i=0.01, fidelity="dq")
    command = np.array(plant.drive.command(ca.DM(run.current[-1]))).ravel()
    np.testing.assert_allclose(run.i[-1], command - axes, rtol=0, atol=2e-4)


def test_steps_bound_the_error_of_a_reading(controller: Any) -> None:
    """A coarse converter leaves the mover moving by more than a fine one, and holds it."""
    wander = [
        held(controller, duration=0.1, q_i=q, fidelity="phase").p[1000:, :4].std() for q in (0.005, 0.05)
    ]
    assert 0 < wander[0] < wander[1] < 10e-6


@pytest.mark.slow
def test_lanes_draw_the_noise_of_one_run_alone(controller: Any) -> None:
    """The batch, the run alone, and the recorded lane: the same sensors, the same noise."""
    par: Any = replace(controller.parameters, s_i=0.02, d_i=0.005)
    plant, scenario = plant_of(par), Scenario("hold", 0.02, malta.references.hold, noise=1.0, fidelity="dq")
    changes = {"m": np.linspace(0.35, 0.37, 9)}
    assert len(noise_scales(plant, setup_of(plant, controller, scenario))) == 5 + 18
    batch = malta.simulation.simulate_many(plant, controller, scenario, changes)
    for k in (0, 8):
        own = simulate(plant_of(replace(par, m=float(changes["m"][k]))), controller, replace(scenario, run=k))
        np.testing.assert_allclose(abs(own.p - own.reference).max(axis=0), batch.deviation[k], rtol=1e-9)
        recorded = record_run(plant, controller, scenario, changes, k)
        if recorded is not None:
            assert (abs(recorded.p - recorded.reference).max(axis=0) == batch.deviation[k]).all()


def test_sensors_may_become_worse_on_the_way(controller: Any) -> None:
    """A change of the machine's parameters during a run: ideal before it, noisy from then on."""
    run = held(controller, duration=0.02, noise=1.0, fidelity="dq", changes=((0.01, {"s_i": 0.1}),))
    same = held(controller, duration=0.02, noise=1.0, fidelity="dq", changes=((0.01, {"m": 0.36}),))
    step = np.abs(np.diff(run.u[:, 2])) - 0.0
    assert step[210:].std() > 5 * step[10:190].std()
    assert same.verdict.completed
