"""Starts from which the mover returns: bounds by hand, batches against single runs, the loss by rising currents."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

import malta
from malta import references
from malta.simulation.experiments import Experiment
from malta.simulation.scenario import Scenario
from malta_papers.tubular.capture import PLANES, RAYS, reach, recoverable

if TYPE_CHECKING:
    from malta.machines.tubular.plant import Parameters
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant

ROBUST = "design/gains/robust.json"
STILL = np.zeros(10)


# The bound


def test_the_bound_along_the_axes_by_hand(model: LinearModel, par: Parameters) -> None:
    """Attraction of a bearing against its force limit, K_A x = K_B I_max; tilted, K_A l_B beta."""
    furthest = par.K_B * par.I_max / par.K_A
    boundary = recoverable(model, ("x", "beta"), STILL)
    assert reach(boundary, (1, 0)) == pytest.approx(furthest, rel=1e-9)
    assert reach(boundary, (0, -1)) == pytest.approx(furthest / par.l_B, rel=1e-9)
    assert boundary.max(axis=0) == pytest.approx([furthest, furthest / par.l_B], rel=1e-9)


def test_weight_moves_the_bound_to_where_attraction_carries_it(model: LinearModel, par: Parameters) -> None:
    weight = STILL.copy()
    weight[6] = -par.g
    boundary = recoverable(model, ("y", "alpha"), weight)
    middle = par.m * par.g / (2 * par.K_A)
    furthest = par.K_B * par.I_max / par.K_A
    assert reach(boundary, (1, 0)) == pytest.approx(middle + furthest, rel=1e-9)
    assert reach(boundary, (-1, 0)) == pytest.approx(furthest - middle, rel=1e-9)


def test_the_bound_is_the_support_of_its_integral(model: LinearModel, par: Parameters) -> None:
    """Along any c the furthest point is sum_i limit_i integral |c e^(-lambda t) b_i| dt, here by quadrature."""
    boundary = recoverable(model, ("x", "beta"), STILL, directions=3600)
    poles = np.sqrt(np.diag(model.stiffness)[[0, 4]])
    t = np.linspace(0, 0.15, 20001)
    decay = np.exp(-np.outer(poles, t))
    # s = q + q' / lambda, so a force acts on it by 1 / (lambda m), with the bearings' arms -l_B and l_B on the tilt.
    arms = np.array([[1 / par.m, 1 / par.m], [-par.l_B / par.I_xx, par.l_B / par.I_xx]]) / poles[:, None]
    limit = par.K_B * par.I_max
    for angle in np.linspace(0, math.pi, 9):
        c = np.array([math.cos(angle) / 3e-3, math.sin(angle) / 0.06])
        wanted = sum(limit * np.trapezoid(np.abs((c * arms[:, i]) @ decay), t) for i in (0, 1))
        assert float((boundary @ c).max()) == pytest.approx(float(wanted), rel=1e-4)


def test_other_planes_are_refused(model: LinearModel) -> None:
    with pytest.raises(malta.CheckError, match="x and z have 1 separate unstable modes"):
        recoverable(model, ("x", "z"), STILL)


def test_reach_of_a_circle() -> None:
    angle = np.linspace(0, 2 * math.pi, 720, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    assert reach(circle, (0.3, -0.4)) == pytest.approx(2.0, rel=1e-4)
    assert math.isnan(reach(circle + 5, (-1.0, 0.0)))


# Many starts at once


def test_runs_of_a_batch_begin_where_they_are_told_to() -> None:
    """The same as one run after the other, with an observer that knows the start."""
    controller = malta.gains.read(ROBUST)
    plant = malta.plant_of(controller.parameters)
    starts = {"x": np.array([0.0, 1e-4, -5e-4, 3e-4]), "alpha": np.array([0.0, 0.0, 1e-4, 7e-3])}
    scenario = Scenario("hold", 0.02, references.hold)
    batch = malta.simulation.simulate_many(plant, controller, scenario, {}, starts=starts)
    for k, (x, alpha) in enumerate(zip(*starts.values(), strict=True)):
        one = Scenario("hold", 0.02, references.hold, start={"x": x, "alpha": alpha})
        run = malta.simulate(plant, controller, one)
        assert bool(batch.completed[k]) == run.verdict.completed
        error = run.p - run.reference
        assert batch.deviation[k] == pytest.approx(np.abs(error).max(axis=0), rel=1e-6, abs=1e-12)
        if run.verdict.completed:
            assert batch.last[k] == pytest.approx(error[-1], rel=1e-4, abs=1e-12)
    assert batch.completed.tolist() == [1, 1, 1, 0]  # the last start is beyond the clearance
    with pytest.raises(malta.InputError, match="changes"):
        malta.simulation.simulate_many(plant, controller, scenario, {"m": np.ones(3)}, starts=starts)
    with pytest.raises(malta.InputError, match="an unknown state"):
        malta.simulation.simulate_many(plant, controller, scenario, {}, starts={"xx": np.zeros(3)})


# The experiment


@pytest.fixture(scope="module")
def captured() -> Experiment:
    controller = malta.gains.read(ROBUST)
    return malta.experiment("capture", malta.plant_of(controller.parameters), controller, points=5)


def _merit(e: Experiment, label: str) -> float:
    return next(merit.value for merit in e.merits if merit.label == label)


def test_what_is_lost_is_the_rise_of_the_currents(captured: Experiment, par: Parameters) -> None:
    """Nothing is lost to the controller: a sample of delay and the rise of the current at the voltage limit remain.

    share = e^(-lambda Ts) integral lambda e^(-lambda t) i(t) / I_max dt, with i' = (V_max - R i) / L up to I_max.
    """
    t = np.linspace(0, 0.1, 200_001)
    i = np.minimum(par.V_max / par.R * (1 - np.exp(-t * par.R / par.L)), par.I_max)
    for ray, pole in (("x", 218.92), ("beta", 157.53)):
        share = math.exp(-pole * 50e-6) * np.trapezoid(pole * np.exp(-pole * t) * i / par.I_max, t)
        assert _merit(captured, f"{ray}: their ratio") == pytest.approx(float(share), rel=5e-3)
    assert _merit(captured, "starts inside the clearance that return") == 1.0


def test_maps_are_even_and_end_inside_the_bound(captured: Experiment) -> None:
    for plane in PLANES:
        found = captured.curves[f"map {' '.join(plane)}"]
        assert found.shape == (5, 5)
        assert found[2, 2] == 1
        if "y" not in plane:  # weight pulls along y
            assert np.array_equal(found, found[::-1, ::-1])
        assert found[0, 0] == found[0, -1] == 0
    up, down = (_merit(captured, f"{ray}: furthest start that returns") for ray in ("y up", "y down"))
    assert up - down == pytest.approx(2 * 0.36 * 9.81 / (2 * 8626.7), rel=0.2)
    for ray in RAYS:
        assert 0.85 < _merit(captured, f"{ray}: their ratio") < 1
    ends = {case.label: case.run.verdict.completed for case in captured.cases}
    assert ends == {"x, inside": True, "x, beyond": False, "beta, inside": True, "x, clearance": True}


@pytest.mark.parametrize("points", [2, 3.5, 1000])
def test_maps_of_other_sizes_are_refused(plant: Plant, points: Any) -> None:
    with pytest.raises(malta.InputError, match="points: found"):
        malta.experiment("capture", plant, malta.gains.read(ROBUST), points=points)


def test_without_a_compiler_it_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    controller = malta.gains.read(ROBUST)
    plant: Plant = malta.plant_of(controller.parameters)
    monkeypatch.setattr("malta.simulation.engine.engines.library", lambda *_, **__: None)
    unseen: dict[str, Any] = {"fidelity": "dq", "delay": 3}  # a shape that no other test has compiled
    with pytest.raises(malta.InputError, match="found no C compiler"):
        malta.experiment("capture", plant, controller, **unseen)
