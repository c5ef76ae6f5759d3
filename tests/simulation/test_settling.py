"""A rest before the reference begins: what is flown, what counts, what commands say."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import Run

import malta
from malta.simulation.engine.batch import record_run
from malta.simulation.experiments.catalogue import settling_option

if TYPE_CHECKING:
    from pathlib import Path

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.simulation.engine.digest import Batch
    from malta.synthesis.controller import Controller

REST, ROBUST, TABLE2 = 0.02, "design/gains/robust.json", "design/gains/table2.json"


def _machine(file: str = ROBUST) -> tuple[Plant, Controller]:
    controller = malta.gains.read(file)
    return malta.plant_of(controller.parameters), controller


def _push(t: FloatArray, at: float) -> FloatArray:
    return np.where(t[:, None] >= at, [0.0, 1.0, 0.0, 0.0, 0.0, 0.0], 0.0)


@pytest.mark.slow
def test_a_rest_is_the_same_stroke_begun_later() -> None:
    """Two routes: a settled stroke, and a longer run whose stroke, load and change of the machine come later."""
    plant, controller = _machine()
    middle: dict[str, Any] = {"rise": 16.2e-3, "profile": "quintic"}
    late = partial(malta.references.stroke, start=-5e-3, end=5e-3, centre=0.05 + REST, **middle)
    settled, whole = (
        scenario.replace(
            noise=1.0,
            seed=4,
            disturbance=partial(_push, at=begin + 0.05),
            changes=((begin + 0.03, {"m": 0.4}),),
        )
        for scenario, begin in (
            (malta.Scenario.stroke(settle=REST, **middle), 0.0),
            (malta.Scenario("late", 0.1 + REST, late), REST),
        )
    )
    run, longer = (malta.simulate(plant, controller, scenario) for scenario in (settled, whole))
    assert (run.t[0], len(run.t), len(longer.t)) == (0.0, 2000, 2400)
    assert run.verdict[:2] == ("completed", 0.1)
    for name in ("p", "y", "v", "i", "reference"):
        np.testing.assert_allclose(getattr(run, name), getattr(longer, name)[400:], rtol=0, atol=1e-9)
    figures = malta.simulation.stroke_figures(run)
    assert figures.axial_error == pytest.approx(np.abs(longer.p - longer.reference)[400:, 4].max(), rel=1e-9)


def _figures(run: malta.simulation.Trajectory) -> dict[str, Any]:
    error = run.p - run.reference
    return {
        "duration": run.verdict.time,
        "completed": run.verdict.completed,
        "deviation": np.abs(error).max(axis=0),
        "rms": np.sqrt((error**2).mean(axis=0)),
        "force": np.abs(run.v).max(axis=0),
        "contact": run.contact.max(axis=0),
        "rise": malta.simulation.stroke_figures(run).rise,
        "overshoot": malta.simulation.stroke_figures(run).overshoot,
        "last": error[-1],
    }


@pytest.mark.slow_for("False")
@pytest.mark.parametrize("bearing", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_figures_of_many_machines_are_of_the_stroke_alone(bearing: bool) -> None:
    """Machines of table2 that settle, touch down in the stroke, and touch down before it."""
    plant, controller = _machine(TABLE2)
    scenario = malta.Scenario.stroke(settle=0.2, noise=1.0, bearing=bearing)
    pull = {"K_A": np.array([1.0, 1.1, 1.2, 1.3]) * plant.parameters.K_A}  # type: ignore[attr-defined]
    batch: Batch = malta.simulation.simulate_many(plant, controller, scenario, pull)
    assert batch.completed[0] == 1
    assert batch.duration.min() < 0 < batch.duration.max() == 0.1
    for k in range(len(pull["K_A"])):
        machine, own = malta.simulation.replay_run(plant, scenario, pull, k)
        for name, wanted in _figures(malta.simulate(machine, controller, own)).items():
            found = getattr(batch, name)[k]
            if name == "last" and bearing and not batch.completed[k]:
                continue  # after a bearing's touch the batch keeps the last sample before it
            np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-12, err_msg=f"{name} {k}")


def test_noise_of_parts_and_recordings_go_on_across_the_beginning() -> None:
    plant, controller = _machine(TABLE2)
    scenario = malta.Scenario.stroke(duration=0.03, rise=4e-3, settle=REST, noise=1.0)
    changes, parts = {"m": np.full(2, 0.36)}, np.array([[5, 9, 2], [1, 1, 1]])
    batch = malta.simulation.simulate_many(plant, controller, scenario, changes, noise=parts)
    run = malta.simulate(plant, controller, replace(scenario, run=(5, 9, 2)))
    np.testing.assert_allclose(batch.deviation[0], np.abs(run.p - run.reference).max(axis=0), rtol=1e-6)
    recorded = record_run(plant, controller, scenario, changes, 0, noise=parts)
    if recorded is not None:  # with a C compiler
        assert (recorded.t[0], len(recorded.t)) == (0.0, 600)
        np.testing.assert_allclose(recorded.p, run.p, rtol=0, atol=1e-9)


def test_a_rest_takes_off_what_v0_does_not_know() -> None:
    """A mover 20 % heavier: the integrals of the flagship carry the rest of the weight before the stroke."""
    plant, controller = _machine()
    masses = {"m": np.array([1.2 * plant.stroke.mass])}
    at_once, settled = (
        malta.simulation.simulate_many(plant, controller, malta.Scenario.stroke(settle=rest), masses)
        .deviation[0, :4]
        .max()
        for rest in (0.0, 0.3)
    )
    assert at_once > 4e-6
    assert settled < 0.5e-6


def test_what_may_settle() -> None:
    for wrong in (-0.1, float("nan"), float("inf")):
        with pytest.raises(malta.InputError, match="settle"):
            malta.Scenario.stroke(settle=wrong)
    with pytest.raises(malta.InputError, match="at most"):
        malta.simulate(*_machine(), malta.Scenario.stroke(settle=1e4))
    plant, law = _machine()
    assert settling_option("stroke", plant, law) == {"settle": 0.3}
    assert settling_option("hold", plant, law) == {}


def test_a_heavier_sphere_rests_before_its_step() -> None:
    """It falls with v0 of another mass; a campaign begins where the sum of errors holds it."""
    spec = malta.read_design("examples/ball/design/ball.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    par: Any = spec.parameters
    heavy = malta.plant_of(replace(par, m=1.1 * par.m))
    option = settling_option("step", spec.plant, law)
    assert option == {"settle": 0.4}
    off = []
    for settle in (0.0, option["settle"]):
        run = malta.experiment("step", heavy, law, settle=settle).run
        off.append(np.abs(run.p[run.t < 0.03]).max())  # the step is at 40 ms
    assert off[0] > 30e-6
    assert off[1] < 1e-6


@pytest.mark.slow
def test_commands_settle(run: Run, tmp_path: Path) -> None:
    """Yields after 300 ms at rest unless another rest is asked for; rare events and single runs without."""
    code, out, _ = run("simulate", ROBUST, "--option", "settle=20ms", "--set", "m=0.4", "--json")
    assert code == 0
    assert json.loads(out)["verdict"]["time_s"] == 0.1
    quick = ("campaign", TABLE2, "--samples", "8", "--option", "fidelity=force", "--spread", "1%")
    for options, rest in (((), 0.3), (("--option", "settle=0"), 0), (("--option", "settle=20ms"), 0.02)):
        folder = tmp_path / f"rest_{rest}"
        assert run(*quick, *options, "--out", folder)[0] == 0
        asked = json.loads((folder / "campaign.json").read_text())["scenario"]["options"]
        assert asked.get("settle") == rest
