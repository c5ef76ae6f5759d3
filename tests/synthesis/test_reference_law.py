"""The program on the page of gain files, plain numpy, commands what malta's engine and the exported C command."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT
from exported import controller, target
from reference_law import REACH, Drive, Law

import malta
from malta.firmware import period_functions
from malta.firmware.flight import call, compile_controller, new_state, view, write
from malta.firmware.signals import Target, reading_ranges
from malta.simulation.engine.compiled import compiler
from malta.simulation.references import Motion

if TYPE_CHECKING:
    from pathlib import Path

    from malta.arrays import FloatArray
    from malta.synthesis.controller import Controller

# A law of errors stands in gain.md alone.
NAMES = sorted({path.stem for path in (ROOT / "design" / "gains").glob("*.json")} - {"structured"})
STEPS, FEW = 2000, 200
TOLERANCE = 1e-9  # of the largest force, of a duty cycle
Values = dict[str, Any]
Step = Callable[[Values], Values]  # what is given at a sample -> what is commanded
SLOW = pytest.mark.slow


def own_step(name: str) -> Step:
    """The law of the page, and the drive of a machine that it has one of."""
    path = ROOT / "design" / "gains" / f"{name}.json"
    law, drive = Law(path), Drive(path) if target(name, "double").driven else None

    def step(given: Values) -> Values:
        found = law.step(given["y"], given["y_valid"], given["p"], given["dp"], given["ddp"])
        if drive is not None:
            i, valid, V = given["i"], given["i_valid"], given["link"][0]
            found |= drive.step(found["v"], found["xi_hat"], i, valid, V)
        return found

    return step


def step_of_engine(t: Target) -> Step:
    """The expressions of every simulation, as CasADi computes them; no text of C, none of its forms of functions."""
    sense, decide = period_functions.sense(t).plain, period_functions.decide(t).plain
    ff = t.controller.feedforward
    state = {f.name: np.zeros(f.size) for f in t.state_fields}
    if t.driven:
        state["link_last"] += t.believed.drive.link_voltage

    def evaluate(function: Any, values: Values) -> Values:
        found = function.call([values[key] for key in function.name_in()])
        return {key: np.array(value).ravel() for key, value in zip(function.name_out(), found, strict=True)}

    def step(given: Values) -> Values:
        sensed = evaluate(sense, given | state)
        v0 = ff.at(sensed["y_used"][t.believed.stroke_output])
        found = sensed | evaluate(decide, given | state | {"y_used": sensed["y_used"], "v0": v0})
        state.update({key: found[f"{key}_next"] for key in state})
        return found

    return step


def step_of_c(t: Target) -> Step:
    """The compiled controller."""
    native = compile_controller(t)
    state, inputs, outputs = new_state(native), native.Inputs(), native.Outputs()

    def step(given: Values) -> Values:
        write(state.reference, {key: given[key] for key in ("p", "dp", "ddp")})
        write(inputs, {key: given[key] for key in ("y", "y_valid", *(("i", "i_valid", "link") * t.driven))})
        call(native, "step", state, inputs, outputs)
        return {key: view(outputs, key).copy() for key, _ in outputs._fields_}

    return step


def most_accelerations(c: Controller) -> FloatArray:
    """Of each output, what the largest force gives it; 1 where no inertia is known."""
    inertia = c.feedforward.inertia
    return np.where(inertia > 0, c.limits.force / np.fmax(inertia, 1e-9), 1.0)


def samples(t: Target, count: int) -> Iterator[Values]:
    """Readings about references that jump, forces on either side of their limits; some readings are none."""
    rng, reach, c = np.random.default_rng(11), reading_ranges(t.believed), t.controller
    p: FloatArray = np.zeros(len(reach))
    size, scale, bad = len(reach), 1.0, (math.nan, math.inf, -math.inf, 1e30)
    # Errors that the law answers with the largest forces, and accelerations that take them.
    stiff = np.min(c.limits.force[:, None] / (np.abs(c.K @ c.L) + 1e-30), axis=0)
    heavy = most_accelerations(c)
    for k in range(count):
        if k % 60 == 0:  # calm or rough for a while
            scale = 10 ** rng.uniform(-4, 0)
            p = np.clip(p + scale * reach * rng.uniform(-1, 1, size), -0.6 * reach, 0.6 * reach)
        lost, given = rng.random(size), {"p": p}
        y = p + np.minimum(scale * stiff, reach / 4) * rng.normal(size=size)
        y = np.where(lost < 0.01, rng.choice(bad, size), y)
        edge = reach * rng.choice([-1, 1]) * rng.choice([1, 1 + 1e-15])  # inside, and just beyond
        given["y"] = np.where((lost > 0.01) & (lost < 0.02), edge, y)
        given["y_valid"] = np.where(lost > 0.99, rng.choice([0.0, math.nan, 0.5], size), 1.0)
        given["dp"] = 0.1 * scale * rng.normal(size=size)  # the pauses of sums are 0.02 m/s
        given["ddp"] = 2 * scale * heavy * rng.normal(size=size)
        if t.driven:
            lost = rng.random(18)
            given["i"] = np.where(
                lost < 0.01, rng.choice([math.nan, 20.1, -math.inf], 18), rng.normal(size=18)
            )
            given["i_valid"] = 1.0 * (lost < 0.99)
            links = {45.0: 0.9, 12.0: 0.06, math.nan: 0.02, 2.2: 0.01, 181.0: 0.01}
            given["link"] = rng.choice(list(links), size=1, p=list(links.values()))
        yield given


def compare(name: str, other: Step, count: int) -> None:
    """The same samples to both: forces, currents and duty cycles agree, and all flags."""
    t, mine = target(name, "double"), own_step(name)
    limit, shares = t.controller.limits.force, np.zeros(3)
    for k, given in enumerate(samples(t, count)):
        found, expected = mine(given), other(given)
        assert np.abs((found["v"] - expected["v"]) / limit).max() < TOLERANCE, k
        for key in ("saturated", "refused"):
            assert np.array_equal(found[key], expected[key] != 0), (k, key)
        shares[:2] += np.array([found["saturated"].mean(), found["refused"].any()]) / count
        if t.driven:
            assert np.abs(found["current"] - expected["current"]).max() < TOLERANCE, k
            assert np.abs(found["command"] - expected["command"]).max() < TOLERANCE, k
            assert found["met"] == (expected["met"][0] != 0), k
            shares[2] += (np.abs(found["command"] - 0.5).max() > 0.4999) / count
    checked = 2 + t.driven
    assert ((shares > 0.002) & (shares < 0.99))[:checked].all(), shares


@pytest.mark.slow_for("robust", "table2")
@pytest.mark.parametrize("name", ["robust", "table2", "halbach_late"])
def test_a_few_samples_are_those_of_the_engine(name: str) -> None:
    compare(name, step_of_engine(target(name, "double")), FEW)


@SLOW
@pytest.mark.parametrize("name", NAMES)
def test_forces_and_duty_cycles_are_those_of_the_engine(name: str) -> None:
    compare(name, step_of_engine(target(name, "double")), STEPS)


@pytest.mark.slow_for("halbach_late")
@pytest.mark.parametrize("name", [n if n == "halbach_late" else pytest.param(n, marks=SLOW) for n in NAMES])
def test_forces_and_duty_cycles_are_those_of_the_c(name: str) -> None:
    if compiler() is None:
        pytest.skip("no C compiler")
    compare(name, step_of_c(target(name, "double")), STEPS)


@SLOW
def test_what_a_filter_expects_without_readings_is_bounded() -> None:
    """All readings are lost: an unstable model that goes on alone meets the bound, and both stay together."""
    t = target("robust", "double")
    mine, other, none, far = own_step("robust"), step_of_engine(t), np.zeros(5), 0.0
    given = {"p": none, "dp": none, "ddp": none}
    given |= {"i": np.zeros(18), "i_valid": np.ones(18), "link": np.array([45.0])}
    for k in range(STEPS):  # the last that is read is a speed of 2.4 m/s, which no force can stop
        given |= {"y": none + 1.2e-4 * k, "y_valid": none + (k < 10)}
        found, expected = mine(given), other(given)
        far = max(far, np.abs(found["xi_hat"][:2]).max())
        np.testing.assert_allclose(found["xi_hat"], expected["xi_hat"], rtol=1e-6, atol=1e-9, err_msg=str(k))
    assert far > 1000 * REACH["tubular"][0]


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=SLOW) if n.startswith("planar") else n for n in NAMES]
)
def test_a_simulation_commands_the_same_forces(name: str) -> None:
    """From its readings alone, with all outputs on their way: the memory that it begins with, too."""
    c = controller(name)
    w = 2 * math.pi / (FEW * c.sample_time)
    sizes = np.array([1.0, 1.1, 1.2, 1.3, 1.4, 1.5])[: len(c.forces)] * np.fmin(
        reading_ranges(malta.plant_of(c.parameters)) / 50, 0.2 * most_accelerations(c) / w**2
    )

    def motion(t: FloatArray) -> Motion:
        at = w * t[:, None] + 0.5
        return Motion(sizes * np.sin(at), sizes * w * np.cos(at), -sizes * w**2 * np.sin(at))

    plant, lasts = malta.plant_of(c.parameters), FEW * c.sample_time
    scenario = malta.Scenario("wave", lasts, lambda _: motion, noise=1.0, fidelity="force")
    run, law = malta.simulate(plant, c, scenario), Law(ROOT / "design" / "gains" / f"{name}.json")
    p, dp, ddp = motion(run.t)
    law.start(p[0], dp[0], ddp[0])
    sure = np.ones(len(c.measurements))
    v = np.array([law.step(y, sure, *at)["v"] for y, *at in zip(run.y, p, dp, ddp, strict=True)])
    assert len(v) >= FEW
    assert (np.abs(v - run.v) < TOLERANCE * c.limits.force).all()
    assert np.ptp(v, axis=0).min() > 0.001 * c.limits.force.min()


def test_ranges_of_readings_are_those_of_the_page() -> None:
    """To the last digit, in the text and in the program."""
    page = (ROOT / "docs" / "formats" / "gain.md").read_text(encoding="utf-8")
    for name in NAMES:
        plant = malta.plant_of(controller(name).parameters)
        found = reading_ranges(plant).tolist()
        assert found == REACH[plant.name]
        assert all(f"`{value!r}`" in page for value in found)


def test_what_the_program_does_not_have_is_refused(tmp_path: Path) -> None:
    text = (ROOT / "design" / "gains" / "robust.json").read_text(encoding="utf-8")
    path = tmp_path / "errors.json"
    path.write_text(text.replace('"tracks": "states"', '"tracks": "errors"'), encoding="utf-8")
    with pytest.raises(ValueError, match=r"law\.tracks"):
        Law(path)
