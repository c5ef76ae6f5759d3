"""The rotor of the examples: its unbalance from a log, and its synchronous response learned away."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.identification import Log
from malta.model.machines import machine
from malta.model.parts import attribute_of

FOLDER = ROOT / "examples" / "rotor"
SPEED, E_U, L_U = 800.0, 1.2e-6, 0.03


@pytest.fixture(scope="module")
def rotor() -> dict[str, Any]:
    """The design's machine at SPEED, another rotor's unbalance on the true one, and the example's functions."""
    machine(FOLDER / "rotor.py")
    spec = malta.read_design(FOLDER / "design" / "rotor.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    par: Any = spec.plant.parameters
    plant = malta.plant_of(replace(par, Omega=SPEED))
    true = malta.plant_of(replace(par, Omega=SPEED, e_u=E_U, l_u=L_U))
    own = {name: attribute_of(plant, MODULE, name) for name in NAMES}
    return own | {"plant": plant, "true": true, "controller": controller}


MODULE: Any = "synchronous"  # beside rotor.py
NAMES = ("identify_unbalance", "next_forces", "phasors", "turning_forces")


def flown(rotor: dict[str, Any], sent: Any = None, noise: float = 1.0) -> Log:
    """A log of 0.3 s at SPEED with the unbalance, and forces beside the law's."""
    turning = attribute_of(rotor["plant"], "experiments", "rotating")
    excitation = None if sent is None else rotor["turning_forces"](sent, SPEED)
    scenario = malta.Scenario(
        "turning", 0.3, malta.references.hold, fidelity="force", noise=noise, excitation=excitation,
        disturbance=lambda t: turning(rotor["true"], t),
    )  # fmt: skip
    run = malta.simulate(rotor["true"], rotor["controller"], scenario)
    assert run.verdict.completed
    return malta.identification.log_of(run)


def test_the_unbalance_is_found_by_size_plane_and_angle(rotor: dict[str, Any]) -> None:
    found = rotor["identify_unbalance"](rotor["plant"], flown(rotor))
    assert found.e_u == pytest.approx(E_U, rel=0.02)
    assert found.l_u == pytest.approx(L_U, abs=2e-3)
    # A simulation holds the wrench between samples: half of one late.
    assert found.angle == pytest.approx(-SPEED * rotor["controller"].sample_time / 2, abs=0.01)
    assert found.left < 0.02


def test_the_synchronous_response_is_learned_away(rotor: dict[str, Any]) -> None:
    """By 90 % in two steps; the law is the same, so |S| is: below 3, zone A of ISO 14839-3."""
    log = flown(rotor)
    first = np.abs(rotor["phasors"](log, "y", SPEED))
    for _ in range(2):
        log = flown(rotor, rotor["next_forces"](rotor["plant"], rotor["controller"], log))
    last = np.abs(rotor["phasors"](log, "y", SPEED))
    assert (last < 0.1 * first).all()
    S = malta.loop(rotor["plant"], rotor["controller"]).sensitivity(np.geomspace(5, 2e4, 400))
    assert 1 < np.abs(np.einsum("kii->ki", S)).max() < 3


def test_few_turns_tell_no_line(rotor: dict[str, Any]) -> None:
    log = flown(rotor)
    short = replace(log, t=log.t[:500], columns={name: table[:500] for name, table in log.columns.items()})
    with pytest.raises(malta.CheckError, match="turns, 20 at least"):
        rotor["phasors"](short, "y", SPEED)
    with pytest.raises(malta.InputError, match="a rotor that turns"):
        rotor["identify_unbalance"](malta.plant_of(replace(rotor["plant"].parameters, Omega=0.0)), log)
