"""A carrier that accelerates: countering forces by hand, and what the feedforward of a known acceleration takes off."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import pytest

import malta
from malta import references
from malta.simulation.experiments import Experiment
from malta.simulation.inputs import countering_forces
from malta.simulation.scenario import Scenario
from malta_papers.tubular.experiments import BEGIN, carrier_acceleration, inertial_wrench

if TYPE_CHECKING:
    from malta.machines.tubular.plant import Parameters
    from malta.model.plant import Plant

ROBUST = "design/gains/robust.json"


def test_the_carrier_goes_as_far_as_it_should() -> None:
    t = np.arange(0, 0.3, 1e-5)
    a = carrier_acceleration(t, 0.1, 0.2)
    speed = np.cumsum(a) * 1e-5
    assert speed[-1] == pytest.approx(0, abs=1e-6)
    assert speed.sum() * 1e-5 == pytest.approx(0.1, rel=1e-4)
    assert not a[t < BEGIN].any()
    assert not a[t > BEGIN + 0.2001].any()
    assert np.abs(a).max() == pytest.approx(10 / 3**0.5 * 0.1 / 0.2**2, rel=1e-5)


@pytest.mark.parametrize("z", [0.0, 5e-3, -12e-3])
def test_countering_forces_by_hand(plant: Plant, par: Parameters, z: float) -> None:
    """A force at the centre of gravity on two bearings with the arms l_B + z and l_B - z; a torque, and thrust."""
    motion = references.hold(plant, z=z)(np.zeros(4))
    wrench = np.zeros((4, 6))
    wrench[0, 0], wrench[1, 1], wrench[2, 2], wrench[3, 4] = 3.0, -2.0, 1.0, 0.1
    v = countering_forces(plant, motion, wrench)
    far, near = (par.l_B - z) / (2 * par.l_B), (par.l_B + z) / (2 * par.l_B)
    arm = 0.1 / (2 * par.l_B)
    wanted = np.zeros((4, 5))
    wanted[0, [0, 2]] = -3 * far, -3 * near
    wanted[1, [1, 3]] = 2 * far, 2 * near
    wanted[2, 4] = -1
    wanted[3, [0, 2]] = arm, -arm
    np.testing.assert_allclose(v, wanted, atol=1e-12)
    assert not countering_forces(plant, motion, np.zeros((4, 6))).any()


@pytest.fixture(scope="module")
def carried() -> Experiment:
    controller = malta.gains.read(ROBUST)
    return malta.experiment("carrier", malta.plant_of(controller.parameters), controller)


def test_what_is_known_is_taken_off(carried: Experiment) -> None:
    """All of it but delay and lag of the forces; a tenth is left where the acceleration is known to 90 %."""
    off = {case.label: case.merits[1].value for case in carried.cases}
    for place in ("rest", "stroke"):
        assert off[f"{place}, fed forward"] < 0.02 * off[f"{place}, not fed forward"]
        share = off[f"{place}, 90 % fed forward"] / off[f"{place}, not fed forward"]
        assert share == pytest.approx(0.1, abs=0.01)
    assert carried.merits[1].value == pytest.approx(0.36 * carried.merits[0].value, rel=1e-12)


def test_the_filter_is_not_told_of_forces_that_move_nothing() -> None:
    """The estimate of the speed stays next to the truth, and so the mover next to its place."""
    controller = malta.gains.read("design/gains/calibrated.json")
    plant = malta.plant_of(controller.parameters)
    acts = partial(inertial_wrench, plant=plant, carried=0.1, within=0.2)
    scenario = Scenario("carrier", 0.3, references.hold, disturbance=acts, anticipated=acts)
    run = malta.simulate(plant, controller, scenario)
    assert run.verdict.completed
    assert np.abs(run.p[:, :4]).max() < 5e-6
    assert np.abs(run.xi_hat[:, 5] - run.x[:, 6]).max() < 1e-3


def test_other_estimators_and_shapes_are_refused(plant: Plant) -> None:
    controller = malta.gains.read(ROBUST)
    acts = partial(inertial_wrench, plant=plant, carried=0.1, within=0.2)
    for options in (
        {"anticipated": acts, "estimator": "kalman"},
        {"anticipated": lambda t: np.zeros((len(t), 5))},
    ):
        with pytest.raises(malta.InputError) as caught:
            malta.simulate(plant, controller, Scenario("carrier", 0.01, references.hold, **options))
        assert caught.value.field == "anticipated"
