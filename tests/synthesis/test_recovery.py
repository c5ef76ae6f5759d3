"""Constant loads from outside: the linear answer against the simulated machine, and against compliance."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from conftest import ROOT, assert_folds, printed

import malta
from malta.errors import CheckError, InputError
from malta.loops.sampled_loops import disturbance_map
from malta.loops.time_domain import furthest, load_vector, recovery
from malta.model.linearize import linearize
from malta.report.figures.margins import recovery_figure
from malta.report.tables.design import recovery_table
from malta.simulation import experiments as responses
from malta.synthesis.step_response import step_response

if TYPE_CHECKING:
    from conftest import Run

    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller


class Machine(NamedTuple):
    """A gain file on its machine."""

    plant: Plant
    controller: Controller


def machine_of(name: str) -> Machine:
    controller = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    return Machine(malta.plant_of(controller.parameters), controller)


@pytest.fixture(scope="module", params=["table2", "calibrated"])
def design(request: pytest.FixtureRequest) -> Machine:
    return machine_of(request.param)


@pytest.fixture(scope="module")
def calibrated() -> Machine:
    return machine_of("calibrated")


@pytest.mark.slow
def test_the_answer_is_that_of_the_samples_one_by_one() -> None:
    """An oscillator with a slow pole beside it, over every octave of the grid."""
    M = np.diag([0.0, 0.0, 0.9995])
    M[:2, :2] = 0.99 * np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    g, C = np.array([[1.0, 0.0], [0.0, 2.0], [1e-3, 0.0]]), np.array([[1.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    found = step_response(M, g, C, 1e-3)
    assert len(found.t) < 20_000
    x, exact = np.zeros((3, 2)), []
    for _ in range(round(found.t[-1] / 1e-3) + 1):
        exact.append(C @ x)
        x = M @ x + g
    k = np.round(found.t / 1e-3).astype(int)
    np.testing.assert_allclose(found.y, np.array(exact)[k], atol=1e-10)
    np.testing.assert_allclose(found.final, np.array(exact)[-1], atol=1e-7)
    sizes = np.array([1.0, -3.0])
    np.testing.assert_allclose(found.of(sizes).y[..., 0], np.array(exact)[k] @ sizes, atol=1e-10)
    some = np.abs(np.array(exact))
    np.testing.assert_allclose(found.largest, some.max(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found.left(0.2), some[200:].max(axis=0), rtol=1e-12)
    assert found.left(1e9) == pytest.approx(np.abs(found.final))


def test_settling_is_the_last_time_outside_and_never_where_a_deviation_stays() -> None:
    stays = step_response(np.array([[0.9]]), np.array([[1.0]]), np.array([[1.0]]), 1e-3)
    assert stays.final[0, 0] == pytest.approx(10)
    assert math.isinf(stays.within(0.01)[0, 0])
    M = np.diag([0.9, 0.8])  # 1 / (1 - 0.9) - 2 / (1 - 0.8) = 0
    pulse = step_response(M, np.array([[1.0], [-2.0]]), np.array([[1.0, 1.0]]), 1.0)
    assert abs(pulse.final[0, 0]) < 1e-12
    y = np.abs(pulse.y[:, 0, 0])
    assert pulse.within(0.01)[0, 0] == np.flatnonzero(y > 0.01 * y.max())[-1] + 1
    with pytest.raises(CheckError, match="unstable loop"):
        step_response(np.array([[1.0]]), np.eye(1), np.eye(1), 1.0)


def test_an_integrating_loop_comes_back_and_its_sum_is_the_compliance_at_rest(design: Machine) -> None:
    """|y(jw) / w_load(jw)| / w goes to the integral of the step's answer."""
    pushed = malta.loop(design.plant, design.controller).sampled
    answer = pushed.answer()
    for k, name in enumerate(("F_x", "F_y", "F_z")):
        load = load_vector(design.plant, name, {name: 1.0})
        one = answer.of(load)
        area = np.asarray(np.trapezoid(one.y[:, :, 0], one.t, axis=0))
        slowest = 1 / one.t[-1]
        G = pushed.compliance(np.array([slowest]), load)[0] / slowest
        moved = int(np.argmax(np.abs(area)))
        assert abs(G[moved]) == pytest.approx(abs(area[moved]), rel=2e-2), k
        assert np.abs(one.final).max() < 1e-6 * one.largest.max()


def test_compliance_is_that_of_the_experiments_where_holding_a_load_does_not_matter(design: Machine) -> None:
    w = np.array([5.0, 50.0, 500.0])
    pushed = malta.loop(design.plant, design.controller).sampled
    ours = np.abs(pushed.compliance(w, load_vector(design.plant, "x", {"F_x": 1.0}))[:, 0])
    theirs = responses.compliance(design.plant, design.controller, w, 0, "F_x")
    np.testing.assert_allclose(ours, theirs, rtol=1e-2)


def test_a_pid_without_an_integral_gives_way_by_its_compliance_at_rest() -> None:
    plant, c = machine_of("halbach_pid")
    springy = replace(c, Ki=np.zeros_like(c.Ki))
    (found,) = recovery(plant, springy)
    (d,) = found.outputs
    assert math.isinf(d.settled)
    G = malta.loop(plant, springy).sampled.compliance(np.array([1e-6]), np.array([1.0]))
    assert d.final == pytest.approx(float(G[0, 0].real), rel=1e-6)
    assert d.left[-1] >= abs(d.final) > 1e-6


def test_a_load_at_a_point_is_the_sum_of_its_disturbances(calibrated: Machine) -> None:
    plant, c = calibrated
    par: Any = plant.parameters
    arm = par.l_B
    loads = {"bearing 1": {"F_x": 2.0, "T_y": -2.0 * arm}}
    (found,) = recovery(plant, c, loads, after=(0.05,))
    pushed = malta.loop(plant, c).sampled.answer()
    sum_of = 2 * pushed.y[:, :, 0] - 2 * arm * pushed.y[:, :, 4]
    assert found.outputs[0].largest == pytest.approx(np.abs(sum_of[:, 0]).max(), rel=1e-12)
    assert found.load == loads["bearing 1"]
    assert len(found.outputs[0].left) == 1
    half = recovery(plant, c, {"bearing 1": {"F_x": 1.0, "T_y": -arm}}, after=(0.05,))[0]
    assert found.outputs[0].largest == pytest.approx(2 * half.outputs[0].largest, rel=1e-9)
    with pytest.raises(InputError, match=r"F_w.*F_x F_y F_z T_x T_y T_z"):
        recovery(plant, c, {"wrong": {"F_w": 1.0}})


@pytest.mark.parametrize("name", ["F_x", "F_z"])
def test_the_nonlinear_machine_answers_alike(calibrated: Machine, name: str) -> None:
    """Small loads: 10 mN from outside on the simulated machine, at its trim, with exact sensors."""
    (plant, c), size, at = calibrated, 1e-2, 5e-3
    column = [s.name for s in plant.disturbances].index(name)

    def push(t: np.ndarray) -> np.ndarray:
        return responses.step_wrench(t, column, size, at, len(plant.disturbances))

    scenario = malta.Scenario(
        "push", 0.12, malta.references.hold, noise=0.0, quantize=False, disturbance=push
    )
    run = malta.simulate(plant, c, scenario)
    answer = malta.loop(plant, c).sampled.answer().of(load_vector(plant, name, {name: size}))
    first = round(at / c.sample_time)
    moved = run.p[first:] - run.p[first]
    y = answer.y[: len(moved), :, 0]
    assert len(y) == len(moved)
    assert np.abs(moved - y).max() < 2e-3 * np.abs(y).max()


@pytest.mark.slow_for("planar_pid")
@pytest.mark.parametrize("file", ["halbach", "halbach_pid", "planar", "planar_pid"])
def test_every_machine_has_a_table_of_80_columns(file: str) -> None:
    plant, c = machine_of(file)
    found = recovery(plant, c)
    rows = furthest(found)
    assert [r.name for r, _ in rows] == [s.name for s in plant.disturbances]
    assert all(0 < d.largest < 1e-2 for _, d in rows)
    # A load's own unit: a force moves a distance, a torque turns.
    assert all((d.unit == "rad") == r.name.startswith("T") for r, d in rows)
    lines = printed(recovery_table(found, plant), 80).splitlines()
    assert_folds(recovery_table(found, plant), 80, 60, 40)
    assert sum(line.strip().startswith("1 N") for line in lines) == len(rows)


@pytest.mark.parametrize("name", ["robust", "robust_observer"])
def test_the_flagship_carries_a_load_in_a_tenth_of_a_second(name: str) -> None:
    """With sums of errors, and with observed forces of disturbance in their place."""
    found = {r.name: d for r, d in furthest(recovery(*machine_of(name)))}
    assert found["F_x"].largest < 10e-6
    assert found["F_z"].largest < 140e-6
    assert found["F_x"].left[0] <= 1e-6
    assert found["F_x"].left[1] < 0.02e-6
    assert found["F_z"].left[0] < 6.5e-6
    assert max(d.settled for d in found.values()) < 0.2
    assert "T_z" not in found  # no input of the machine's turns it about its axis, nor does a sensor see it


def test_disturbances_are_forces_on_the_masses(calibrated: Machine) -> None:
    par: Any = calibrated.plant.parameters
    B = disturbance_map(linearize(calibrated.plant, calibrated.plant.at()))
    assert B.shape == (10, 6)
    assert B[5, 0] == pytest.approx(1 / par.m)
    assert B[8, 3] == pytest.approx(1 / par.I_xx)
    assert not B[:5].any()


@pytest.mark.slow
def test_verify_prints_loads_and_writes_them_as_json(run: Run) -> None:
    gains = str(ROOT / "design" / "gains" / "halbach.json")
    said = run("verify", gains, "--no-proof")
    assert said.code == 0
    assert "1 N F_x" in said.out
    document = json.loads(run("verify", gains, "--no-proof", "--json").out)
    (one,) = document["recovery"]
    assert one["load"] == {"F_x": 1.0}
    assert one["outputs"]["x"]["largest"] == pytest.approx(1443e-6, rel=1e-3)
    assert [left["after_s"] for left in one["outputs"]["x"]["left"]] == [0.1, 0.3]


@pytest.mark.parametrize("file", ["robust", "halbach", "planar"])
def test_the_figure_of_loads_shows_what_the_table_says(file: str) -> None:
    """Each line's height is the largest deviation, each compliance's that of its peak; axes have units."""
    plant, c = machine_of(file)
    found = recovery(plant, c)
    figure = recovery_figure(plant, c, found)
    heights = {
        name: float(np.abs(line.get_ydata()).max())
        for axes in figure.axes[::2]
        for line in axes.get_lines()
        for name in str(line.get_label()).split(", ")  # loads with the same answer share a line
    }
    for load, output in furthest(found):
        assert heights[f"{load.name}: {output.output}"] == pytest.approx(1e6 * output.largest, rel=1e-9)
    for axes in figure.axes:
        assert axes.get_lines()
        assert axes.get_xlabel() in ("time [ms]", "frequency [Hz]")
        assert "µ" in axes.get_ylabel()
