"""Records pickle: a plant as its parameters and what was changed beside, what holds plants as they are."""

from __future__ import annotations

import multiprocessing
import pickle
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.model import Plant, Sensors

pytestmark = pytest.mark.usefixtures("proven_once")

HOLD = malta.Scenario("hold", 10e-3, malta.references.hold, fidelity="force")


def again(record: Any) -> Any:
    return pickle.loads(pickle.dumps(record))


def machines() -> dict[str, tuple[Plant, malta.Controller]]:
    """Of this package, of a user's file, of matrices."""
    shipped = malta.gains.read(ROOT / "design" / "gains" / "halbach_pid.json")
    spec = malta.read_design(ROOT / "examples" / "ball" / "design" / "ball.toml")
    cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], noise=1e-6)
    weights = malta.synthesis.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8])
    return {
        "halbach": (malta.plant_of(shipped.parameters), shipped),
        "ball": (spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))),
        "cart": (cart, malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=1e-3)),
    }


NAMES = ("halbach", "ball", "cart")


@pytest.mark.parametrize("name", NAMES)
def test_every_record_pickles(name: str) -> None:
    plant, law = machines()[name]
    model = malta.linearize(plant, plant.at())
    loop, report, run = malta.loop(plant, law), malta.verify(model, law), malta.simulate(plant, law, HOLD)
    assert again(plant) is plant
    assert again(law).K.tolist() == law.K.tolist()
    assert again(model).A.tolist() == model.A.tolist()
    assert again(model).plant is plant
    assert np.array_equal(again(loop).poles, loop.poles)
    assert again(report).peak_sensitivity == report.peak_sensitivity
    assert np.array_equal(again(run).y, run.y)
    job = next(iter(malta.simulation.experiments.catalogue.experiments_of(plant)))
    if name == "ball":
        found = malta.experiment(job, plant, law)
        assert again(found).cases[0].merits == found.cases[0].merits


@pytest.mark.parametrize("name", NAMES)
def test_a_changed_plant_keeps_its_changes(name: str) -> None:
    """Fields and entries of groups, of the machine's own plant or of one that is built outside of the cache."""
    own = machines()[name][0]
    for plant in (own, own.variant(own.parameters)):
        late = replace(plant, name="late", sensors=replace(plant.sensors, lag=(2e-3,) * len(plant.outputs)))
        back = again(late)
        assert (back.name, back.sensors.lag) == ("late", late.sensors.lag)
        assert back.sensors.noise == plant.sensors.noise
        x, u, w = (np.full(len(s), 1e-4) for s in (plant.states, plant.inputs, plant.disturbances))
        assert np.array_equal(np.array(ca.DM(back.f(ca.DM(x), ca.DM(u), ca.DM(w)))),
                              np.array(ca.DM(late.f(ca.DM(x), ca.DM(u), ca.DM(w)))))  # fmt: skip


def test_other_parameters_are_another_plant() -> None:
    plant: Any = machines()["ball"][0]
    heavy = plant.variant(replace(plant.parameters, m=2 * plant.parameters.m))
    assert again(heavy).parameters.m == 2 * plant.parameters.m


def test_a_function_of_its_own_is_no_silent_loss() -> None:
    plant: Any = machines()["ball"][0]
    pushed = replace(plant, load=lambda x: 0 * x[0] - 1)
    with pytest.raises((pickle.PicklingError, AttributeError)):
        again(pushed)
    aside = replace(plant, sensors=Sensors(sense=lambda x, _: x[0] + 1))
    with pytest.raises((pickle.PicklingError, AttributeError)):
        again(aside)


def fastest(plant: Plant) -> float:
    return float(np.linalg.eigvals(malta.linearize(plant, plant.at()).A).real.max())


def test_a_pool_works_over_plants() -> None:
    plant: Any = machines()["ball"][0]
    masses = [0.5, 1.0, 2.0]
    plants = [plant.variant(replace(plant.parameters, m=m * plant.parameters.m)) for m in masses]
    with multiprocessing.get_context("fork").Pool(2) as pool:
        found = pool.map(fastest, plants)
    assert found == pytest.approx([fastest(one) for one in plants])
