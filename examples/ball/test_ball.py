"""The sphere's equations and its controller, each against a second way to the number."""

from pathlib import Path

import numpy as np
import pytest

import malta

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def spec() -> malta.Spec:
    return malta.read_design(HERE / "design" / "ball.toml")


def test_open_loop_poles_are_those_of_the_negative_stiffness(spec: malta.Spec) -> None:
    par = spec.parameters
    k_s = 4 * par.C * par.I_0**2 / par.s**3
    poles = malta.linearize(spec.plant, spec.plant.at()).sys.poles()
    assert np.sort(poles.real) == pytest.approx([-np.sqrt(k_s / par.m), np.sqrt(k_s / par.m)], rel=1e-9)


def test_the_weight_is_fed_forward(spec: malta.Spec) -> None:
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    assert controller.feedforward.v0[0, 0] == pytest.approx(spec.parameters.m * spec.parameters.g, rel=1e-12)


def test_the_loop_is_stable_in_twice_the_box_and_carries_a_load(spec: malta.Spec) -> None:
    model = malta.linearize(spec.plant, spec.plant.at())
    controller = malta.synthesize(spec, model)
    margin = malta.verify(model, controller, spec.uncertainty).robust
    assert margin is not None
    assert margin.lower is not None
    assert margin.lower > 2
    push = malta.experiment("disturbance", spec.plant, controller, size=0.1)
    left = np.abs(push.run.p[-1, 0])
    assert push.run.verdict.completed
    assert left < 0.1 * np.abs(push.run.p).max()
