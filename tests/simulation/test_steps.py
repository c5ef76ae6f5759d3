"""Runge-Kutta steps are as many as the stated integration error needs."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import malta
from malta.errors import InputError
from malta.gains.file import content_of
from malta.simulation import experiments, simulate as flights
from malta.simulation.experiments.catalogue import experiments_of
from malta.simulation.layout import fidelities
from malta.simulation.steps import INTEGRATION_ERROR, KINKED_STEPS, choose_steps, steps_of

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.simulation.trajectory import Trajectory
    from malta.synthesis.controller import Controller

MACHINES = ("calibrated", "halbach", "planar")  # a design of each
NAMES = {name: list(experiments_of(malta.plant_of(malta.gains.read(f"design/gains/{name}.json").parameters)))
         for name in MACHINES}  # fmt: skip
EXPERIMENTS = [(design, name) for design, names in NAMES.items() for name in names]


def _design(name: str) -> tuple[Plant, Controller]:
    controller = malta.gains.read(f"design/gains/{name}.json")
    return malta.plant_of(controller.parameters), controller


def _error(run: Trajectory) -> float:
    """Of a flight beside one with 16 times the steps."""
    count = 16 * steps_of(run.plant, run.controller, run.scenario)
    other = malta.simulate(run.plant, run.controller, run.scenario.replace(substeps=count, accuracy=None))
    k = min(len(run.p), len(other.p))
    return float(np.abs(run.p[:k] - other.p[:k]).max())


@pytest.mark.parametrize(("name", "fidelity", "count"), [
    ("calibrated", "force", 1), ("calibrated", "dq", 1), ("calibrated", "phase", 1), ("robust", "force", 1),
    ("planar", "force", 1), ("halbach", "force", 144),
])  # fmt: skip
def test_a_stroke_is_within_its_stated_error(name: str, fidelity: Any, count: int) -> None:
    """Of lags and windings one step a sample errs less; of current loops that settle within a sample 144 do."""
    plant, c = _design(name)
    run = malta.simulate(plant, c, malta.Scenario.stroke(10e-3, fidelity=fidelity))
    assert steps_of(plant, c, run.scenario) == pytest.approx(count, abs=count // 20)
    assert run.integration_error == INTEGRATION_ERROR
    assert _error(run) < INTEGRATION_ERROR
    assert dict(run.description.rows)["integration error"].startswith("below 1e-09 m")


@pytest.mark.slow
@pytest.mark.parametrize(("design", "name"), EXPERIMENTS)
def test_every_experiment_is_within_its_stated_error(
    monkeypatch: pytest.MonkeyPatch, design: str, name: str
) -> None:
    """Beside 16 times the steps. Readings are without steps, as one that is rounded the other way is another reading
    however small the error, and laws in double precision."""
    runs: list[Trajectory] = []

    def fly(*given: Any, **options: Any) -> Trajectory:
        runs.append(flights.simulate(*given, **options))
        return runs[-1]

    monkeypatch.setattr(experiments, "simulate", fly)
    plant, c = _design(design)
    malta.experiment(name, plant, c, quantize=False)
    stated = [run.integration_error for run in runs]
    most = max(steps_of(run.plant, run.controller, run.scenario) for run in runs)
    first = runs.copy()
    runs.clear()
    malta.experiment(name, plant, c, quantize=False, substeps=16 * most)
    assert len(first) == len(runs) > 0
    for run, finer, error in zip(first, runs, stated, strict=True):
        if math.isfinite(error) and run.engine == "compiled":
            assert error == INTEGRATION_ERROR
            assert np.abs(run.p - finer.p).max() < INTEGRATION_ERROR, run.scenario.name


@pytest.mark.parametrize("name", ["robust", "planar"])
def test_machines_at_the_corners_of_the_box_are_within_it(name: str) -> None:
    """Each takes as many steps as the gain file's own machine, in every fidelity."""
    plant, c = _design(name)
    box = content_of(Path(f"design/gains/{name}.json"))[0].uncertainty or {}
    corners = list(product((-1, 1), repeat=len(box)))
    corners = corners[:: max(1, len(corners) // 3)]  # some of up to 2^6, the lowest among them
    for fidelity, signs in product(fidelities(plant), corners):
        own = {key: getattr(plant.parameters, key) for key in box}
        moved = {
            key: own[key] * (1 + sign * min(box[key], 0.25)) for key, sign in zip(box, signs, strict=True)
        }
        corner = plant.variant(replace(plant.parameters, **moved))
        run = malta.simulate(corner, c, malta.Scenario.stroke(10e-3, fidelity=fidelity))
        assert choose_steps(corner, c, run.scenario) == choose_steps(plant, c, run.scenario)
        assert _error(run) < INTEGRATION_ERROR


def test_a_machine_unlike_the_gain_files_has_steps_of_its_own() -> None:
    """Current loops 30 times as fast are no slow lag in a sample any more."""
    plant, c = _design("calibrated")
    par: Any = plant.parameters
    fast = plant.variant(replace(par, w_cc=30 * par.w_cc))
    run = malta.simulate(fast, c, malta.Scenario.stroke(10e-3, fidelity="force"))
    assert steps_of(fast, c, run.scenario) > 4
    assert _error(run) < INTEGRATION_ERROR


def test_a_wanted_error_is_met() -> None:
    plant, c = _design("halbach")
    counts = []
    for wanted in (1e-6, 1e-8, 1e-10):
        run = malta.simulate(plant, c, malta.Scenario.stroke(10e-3, fidelity="force", accuracy=wanted))
        assert run.integration_error == wanted
        assert _error(run) < wanted
        counts.append(steps_of(plant, c, run.scenario))
    ratios = np.diff(np.log10(counts))
    assert ratios == pytest.approx(
        [0.5, 0.5], abs=0.1
    )  # a hundredth of the error costs 100^(1/4) times the steps


def test_an_error_that_no_number_of_steps_reaches_names_the_smallest() -> None:
    plant, c = _design("calibrated")
    stroke = malta.Scenario.stroke(10e-3, fidelity="force", accuracy=1e-20)
    with pytest.raises(
        InputError, match=r"accuracy: found 1e-20, expected at least \d\S*e-1[3-6], the smallest"
    ):
        malta.simulate(plant, c, stroke)


def test_what_has_no_stated_error_says_so() -> None:
    """Steps that were given, electronics of their own pace, and the time after a touchdown."""
    plant, c = _design("calibrated")
    given = malta.simulate(plant, c, malta.Scenario.stroke(10e-3, substeps=2))
    assert math.isnan(given.integration_error)
    dropped = malta.Scenario("drop", 0.02, malta.references.hold, {"x": 280e-6, "x_dot": 0.5}, bearing=True)
    fallen = malta.simulate(plant, c, dropped)
    assert fallen.contact.max() > 1
    assert math.isnan(fallen.integration_error)
    assert steps_of(plant, c, dropped) == KINKED_STEPS
    halbach, law = _design("halbach")
    own = malta.Scenario.stroke(10e-3, fidelity="phase")
    assert math.isnan(malta.simulate(halbach, law, own).integration_error)
    with pytest.raises(InputError, match="accuracy: found 1e-12, expected none beside electronics"):
        malta.simulate(halbach, law, own.replace(accuracy=1e-12))
    with pytest.raises(InputError, match="one of the two"):
        own.replace(accuracy=1e-12, substeps=2)
