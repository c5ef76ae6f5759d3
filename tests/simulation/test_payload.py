"""The payload: what statics and flight leave of the mass margin of the linear loop."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import pytest
from conftest import Run

import malta
from malta import gains
from malta.model.plants import plant_of
from malta.simulation.experiments.payloads import FINENESS, flown_payload, held_payload, payload
from malta.synthesis.requirements import Payload

pytestmark = pytest.mark.usefixtures("proven_once")


@pytest.mark.slow
def test_statics_by_hand() -> None:
    """At the end of the travel the nearer of the two bearings carries (l_B + z) / (2 l_B) of the weight."""
    c = gains.read("design/gains/calibrated.json")
    par: Any = c.parameters
    share = (par.l_B + par.z_max) / (2 * par.l_B)
    by_hand = par.K_B * par.I_max / share / par.g - par.m
    assert held_payload(plant_of(par)) == pytest.approx(by_hand, rel=1e-6)
    assert 3.5 < by_hand < 3.7
    assert held_payload(plant_of(replace(par, I_max=0.5))) == pytest.approx(
        0.1 * (by_hand + par.m) - par.m, rel=1e-6
    )
    assert held_payload(plant_of(replace(par, I_max=0.3))) == 0
    assert held_payload(plant_of(replace(par, g=0.0))) == math.inf


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "low", "high"), [("table2", 0.1, 0.15), ("calibrated", 1.0, 1.1), ("robust", 2.5, 3.0)]
)
def test_flight_is_bisected(name: str, low: float, high: float) -> None:
    c = gains.read(f"design/gains/{name}.json")
    plant = plant_of(c.parameters)
    found = payload(plant, c)
    assert found is not None
    assert low < found.carried < found.dropped < high < found.held
    assert found.dropped - found.carried <= FINENESS * found.dropped
    picked = malta.experiment("payload", plant, c, masses=(found.carried, found.dropped))
    assert [case.run.verdict.completed for case in picked.cases] == [True, False]


def test_what_is_held_may_be_carried() -> None:
    c = gains.read("design/gains/calibrated.json")
    assert flown_payload(plant_of(c.parameters), c, 0.05) == (0.05, math.inf)


@pytest.mark.slow
def test_machines_without_an_experiment_of_it() -> None:
    """The planar motor's lift is limited; the Halbach motor's table carries the weight."""
    c = gains.read("design/gains/planar.json")
    par: Any = c.parameters
    found = payload(plant_of(par), c)
    assert found is not None
    assert found.held == pytest.approx(par.F_max / par.g - par.m, rel=1e-3)
    assert math.isnan(found.carried)
    c = gains.read("design/gains/halbach.json")
    found = payload(plant_of(c.parameters), c)
    assert found is not None
    assert (found.held, found.dropped) == (math.inf, math.inf)


@pytest.mark.slow
def test_verify_calls_a_mass_margin_by_its_name(run: Run) -> None:
    code, out, _ = run("verify", "design/gains/calibrated_slow.json", "--no-worst-case")
    assert code == 0
    shown = {
        name: [float(number) for number in re.findall(r"[\d.]+", line.partition(name)[2])]
        for line in out.splitlines()
        for name in ("mass margin, linear loop", "payload held at rest", "payload in flight")
        if name in line
    }
    (margin,), (held,), (carried, dropped) = shown.values()
    assert carried < dropped < held <= margin  # which ends where the forces hold no more


@pytest.mark.slow
def test_a_payload_has_the_digits_that_tell_it_from_what_was_dropped() -> None:
    spec = malta.read_design("examples/ball/design/ball.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    for carried, dropped, shown in ((2.611, 2.614, "2.611 kg, not 2.614"), (0.73, math.inf, "0.73 kg")):
        table = malta.report.tolerance_table(replace(found, payload=Payload(3.6, carried, dropped)))
        assert shown in map(str, table.columns[2].cells)
