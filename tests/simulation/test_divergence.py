"""Runs of machines without contacts end when they leave the travel or the scale of their experiment."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.arrays import FloatArray
from malta.model import Actuator, Plant, Sensors, Signal
from malta.model.stroke import Stroke
from malta.simulation.divergence import free_outputs
from malta.simulation.engine.batch import replay_run, simulate_many
from malta.simulation.engine.digest import verdicts
from malta.simulation.experiments.catalogue import cases_of

WEIGHTS = malta.synthesis.weights(q=[1e9, 0], r=[1], w=[1], v=[1e-12])
SOFT, STIFF = 2e4, 2e6  # 1/s2, of the machine that the law is for, and of one that it does not hold


def _spring(**details: Any) -> tuple[Plant, Any]:
    """A mass on a negative spring k without contacts, and a law that holds it at k = SOFT."""
    terms = {"k": [[[0, 0], [1, 0]]]}
    given: dict[str, Any] = {"limit": 40.0, "noise": 1e-7} | details
    p = malta.linear_machine(
        [[0, 1], [0, 0]], [[0], [10]], [[1, 0]], nominal={"k": SOFT}, terms=terms, **given
    )
    return p, malta.lqg(malta.linearize(p, p.at()), WEIGHTS, Ts=1e-4)


def _other(p: Plant, k: float) -> Plant:
    return malta.plant_of(replace(p.parameters, k=k))


@pytest.mark.parametrize("engine", ["auto", "virtual machine"])
def test_an_unstable_machine_without_contacts_has_diverged(engine: Any) -> None:
    """With time and signal, at a thousand times the step, in both engines."""
    p, c = _spring()
    scenario = cases_of("step", p, c, size=1e-5)[0].scenario
    assert malta.simulate(p, c, scenario, engine=engine).verdict.completed
    run = malta.simulate(_other(p, STIFF), c, scenario, engine=engine)
    assert (run.verdict.name, run.verdict.signal) == ("diverged", "y1")
    assert str(run.verdict).startswith("diverged (y1) at 0.0")
    assert 0 < run.verdict.time < 0.05
    off = np.abs(run.p - run.reference).max(axis=1)
    assert (off[:-1] < 1e-2).all()
    assert 1e-2 <= off[-1] < 2e-2


@pytest.mark.parametrize("kind", ["step", "disturbance", "hold"])
def test_every_lane_of_a_campaign_knows(kind: str) -> None:
    """Unstable machines are not completed; stable ones beside them keep their digits; replays end alike."""
    p, c = _spring()
    scenario = replace(cases_of(kind, p, c)[0].scenario, noise=1.0)
    k: FloatArray = np.array([SOFT, STIFF, SOFT, 2 * STIFF])
    assert [malta.loop(_other(p, one), c).stable for one in k] == [True, False, True, False]
    batch = simulate_many(p, c, scenario, {"k": k})
    assert [verdicts(p)[int(n)] for n in batch.verdict] == ["completed", "diverged", "completed", "diverged"]
    alone = simulate_many(p, c, scenario, {"k": np.full(4, SOFT)})
    assert np.array_equal(alone.deviation[2], batch.deviation[2])
    other, own = replay_run(p, scenario, {"k": k}, 1)
    end = malta.simulate(other, c, own).verdict
    assert end.name == "diverged"
    assert batch.duration[1] == pytest.approx(end.time, abs=2e-4)


def test_an_experiment_and_its_share_count_the_divergence() -> None:
    p, c = _spring()
    found = malta.experiment("step", _other(p, STIFF), c, size=1e-5)
    assert found.failed
    assert found.figures[0].value == 0
    assert "diverged (y1)" in found.outcome


def test_states_of_any_scale_that_the_experiment_asks_for_are_no_divergence() -> None:
    """A push that moves the mass by far more than a thousand times its sensor's noise."""
    p, c = _spring(noise=1e-12, limit=400.0)
    run = malta.experiment("disturbance", p, c, size=30.0).run
    assert np.abs(run.p).max() > 1e3 * 1e-9
    assert run.verdict.completed


def test_travel_ends_a_run_that_no_contact_ends() -> None:
    """A stroke beyond the travel of a machine that declares one and has no end stops."""
    p, c = _spring(states=["y1", "rate"])
    travelling = replace(p, stroke=Stroke("y1", "u1", travel=2e-4))
    scenario = malta.Scenario("far", 0.1, lambda _: malta.references.hold(p), fidelity="force")
    assert free_outputs(travelling) == (0,)

    def push(t: FloatArray) -> FloatArray:
        return np.full((len(t), 1), 10.0)

    pushed = replace(scenario, disturbance=push)
    inside, beyond = (malta.simulate(one, c, pushed).verdict for one in (p, travelling))
    assert inside.completed
    assert (beyond.name, beyond.signal) == ("diverged", "y1")


def test_shipped_machines_are_bounded_by_their_contacts() -> None:
    for name in ("tubular", "planar", "halbach"):
        assert free_outputs(malta.plant_of(malta.read(f"data/{name}.toml"))) == ()


def test_only_outputs_that_no_contact_sees_are_free() -> None:
    p, _ = _spring()
    stop = malta.model.Contacts(("stop",), contact=lambda x: ca.fabs(x[0]) / 1e-3, cushioned=(False,))
    assert free_outputs(replace(p, contacts=stop)) == ()
    assert isinstance(p.actuator, Actuator)
    assert isinstance(p.sensors, Sensors)
    assert p.outputs[0] == Signal("y1", "1")
