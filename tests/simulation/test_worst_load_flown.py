"""The worst load of a size, flown: it reaches what the linear loop says, and no more than is proven."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

import malta
from malta.simulation.experiments.catalogue import experiments_of, series_of


def design(name: str) -> tuple[Any, Any]:
    controller = malta.gains.read(f"design/gains/{name}.json")
    return malta.plant_of(controller.parameters), controller


def fly(name: str, **options: Any) -> tuple[Any, dict[str, float]]:
    flown = malta.experiment("worst-load", *design(name), **options)
    return flown, {merit.key: merit.value for merit in flown.merits}


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("structured", {"on": "F_x", "output": "x1", "size": 2.0}),
        ("structured", {"on": "T_y", "output": "fx_B1", "size": 0.02}),
        ("tubular_pid", {"on": "F_y", "output": "touchdown at sensor plane 2", "size": 2.0}),
        ("halbach", {}),
    ],
)
def test_the_flight_reaches_what_the_linear_loop_says(name: str, options: dict[str, Any]) -> None:
    plant, controller = design(name)
    flown, found = fly(name, **options)
    assert not flown.failed
    assert 0.95 < found["share_of_bound"] < 1.03
    if options:
        loop = malta.loop(plant, controller)
        worst = malta.worst_waveform(loop, options["on"], options["output"], options["size"])
        assert found["bound"] == pytest.approx(worst.value + worst.error)
        assert flown.run.t[-1] == pytest.approx(worst.peak_time, abs=25 * worst.sample_time)


def test_at_the_size_that_is_proven_it_stays_within_what_is_proven() -> None:
    plant, controller = design("tubular_pid")
    safe = malta.safe_load(malta.loop(plant, controller), "F_x")
    _, found = fly("tubular_pid", on="F_x", output="x1", size=safe.limit, fidelity="force")
    proven, _ = safe.outputs["x1"]  # with noise of 6 times its rms, which this flight has not
    assert 0.75 * proven < found["reached"] < proven


def test_without_options_it_uses_at_most_half_of_a_clearance() -> None:
    flown, found = fly("calibrated")
    assert "worst F_x of 1 N for touchdown at sensor plane" in flown.cases[0].label
    assert found["reached"] < 0.5
    flown, found = fly("calibrated", on="T_x")
    assert "worst T_x of 100 mN m for touchdown" in flown.cases[0].label
    assert 0.2 < found["reached"] < 0.5


def test_a_machine_has_it_where_loads_act(run: Any) -> None:
    spec = malta.read_design("examples/ball/design/ball.toml")
    for known in (experiments_of(spec.plant), series_of(spec.plant)):
        assert [*known] == ["hold", "step", "disturbance", "worst-load"]
    free = dataclasses.replace(spec.plant, disturbances=())
    assert "worst-load" not in experiments_of(free)
    code, _, err = run(
        "simulate", "design/gains/robust.json", "--scenario", "worst-load", "--option", "on=F_q"
    )
    assert code == 2
    assert "on: found 'F_q', expected all, or one of F_x F_y F_z T_x T_y T_z" in err
