"""Modules that differ, an offset magnetic centre, growing attraction, a mover out of balance: physics and defaults."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from conftest import Run, one_sentence
from hypothesis import given, settings, strategies as st

import malta
from malta.gains.encodings import content_sha256
from malta.machines.tubular import plant as tubular
from malta.machines.tubular.drive import SIDES, attraction, potential
from malta.machines.tubular.experiments.strokes import delayed_stroke
from malta.machines.tubular.plant import centre_of_gravity
from malta.model.parameters import acting_names, differences, values_of
from malta.model.plants import plant_of
from malta.model.rigid_body import rotation
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta_papers.tubular.quantities import WAIT, Figure13, carried_weight, figure_13, radial_deviation

if TYPE_CHECKING:
    from malta.arrays import FloatArray

GAINS = Path("design/gains/calibrated.json")
NAMES = ("dK_A", "dK_B", "kappa", "e_x", "e_y", "c_x", "c_y")  # of modules and mover
SIZE = np.array([3e-4, 3e-4, 1e-2, 3e-2, 3e-2, 1.0, 0.1, 0.1, 0.5, 3.0, 3.0, 20.0])
seeds = st.integers(0, 2**32 - 1)


def unlike(seed: int, **fixed: float) -> Any:
    """MALTA with modules, centres and a balance that are all different, at random."""
    rng = np.random.default_rng(seed)
    largest = {"dK_A": 0.3, "dK_B": 0.3, "kappa": 2.0} | dict.fromkeys(NAMES[3:], 3e-4)
    drawn = {name: float(rng.uniform(-1, 1) * size) for name, size in largest.items()}
    drawn["kappa"] = abs(drawn["kappa"])
    return replace(malta.read("data/tubular.toml"), **(drawn | fixed))


def numeric(function: Any, *sizes: int) -> Any:
    """A CasADi expression as a function of numpy arrays."""
    arguments = [ca.SX.sym("a", size) for size in sizes]
    made = ca.Function("numeric", arguments, [ca.densify(function(*arguments))])
    return lambda *values: np.array(made(*values)).squeeze()


def rate_of(par: Any) -> Any:
    """(x, u) -> x' under the machine's own loads."""
    plant = tubular.plant(par)
    return numeric(lambda x, u: plant.f(x, u, plant.load(x)), 12, 5)


# --- defaults: the machine of the paper ---


def test_the_matrices_in_the_gain_files_are_still_those_of_the_machine() -> None:
    """But for rounding: nothing that is new enters the ideal machine."""
    for name in ("table2", "calibrated", "robust"):
        controller = malta.gains.read(f"design/gains/{name}.json")
        plant = plant_of(controller.parameters)
        model = malta.linearize(plant, plant.point(controller.operating_point[0]))
        for key in "ABC":
            np.testing.assert_allclose(getattr(model, key), getattr(controller, key), rtol=1e-14, atol=0)


def test_the_ideal_machine_has_no_symbol_and_no_line_of_a_file_for_what_it_lacks() -> None:
    par = malta.read("data/tubular.toml")
    listed = json.loads(GAINS.read_text(encoding="utf-8"))["plant"]["parameters"]
    assert not set(NAMES) & ({*acting_names(par)} | {*values_of(par)} | {*listed})
    assert set(NAMES) - {"kappa"} == set(differences(par)) & set(NAMES)
    assert "dK_A" in acting_names(replace(par, dK_A=0.1))


def test_a_gain_file_lists_what_is_not_ideal_and_is_read_back(tmp_path: Path) -> None:
    spec = malta.read_design("design/calibrated.toml")
    plant = plant_of(replace(spec.parameters, dK_A=0.05, e_y=-1.6e-5))
    model = malta.linearize(plant, plant.at(z=0.0))
    controller = malta.synthesize(replace(spec, parameters=plant.parameters), model)
    path = tmp_path / "unlike.json"
    malta.gains.write(controller, malta.verify(model, controller), path)
    listed = json.loads(path.read_text(encoding="utf-8"))["plant"]["parameters"]
    assert listed["dK_A"] == {"value": 0.05, "unit": "1"}
    assert "dK_B" not in listed
    read: Any = malta.gains.read(path).parameters
    assert (read.dK_A, read.e_y, read.dK_B) == (0.05, -1.6e-5, 0.0)


def test_a_gain_file_may_list_a_default(tmp_path: Path) -> None:
    content = json.loads(GAINS.read_text(encoding="utf-8"))
    content["plant"]["parameters"]["kappa"] = {"value": 0.0, "unit": "1"}
    content["sha256"] = content_sha256(content)
    (tmp_path / "listed.json").write_text(json.dumps(content), encoding="utf-8")
    read = malta.gains.read(tmp_path / "listed.json")
    assert read.parameters == malta.gains.read(GAINS).parameters


# --- physics ---


@pytest.mark.slow
@settings(deadline=None, max_examples=25)
@given(seed=seeds)
def test_motion_is_lagranges_of_the_energy(seed: int) -> None:
    """d/dt (dT/dq') - dT/dq + dV/dq = 0 with T and V from `energy`, without a wrench or frame: all accelerations."""
    par, rng = unlike(seed), np.random.default_rng(seed)
    free: Any = replace(par, K_A=0.0, g=0.0, F_c=0.0)

    def residual(x: Any, ddq: Any) -> Any:
        dq = x[6:]
        T = tubular.energy(free, x)
        V = tubular.energy(par, x) - T
        momentum = ca.gradient(T, x)[6:]
        slope = ca.jacobian(momentum, x)
        gradient = ca.gradient(V - T, x)[:6]
        inertia = slope[:, 6:] @ ddq
        return ca.vertcat(inertia + slope[:, :6] @ dq + gradient, inertia)

    x = rng.uniform(-SIZE, SIZE)
    found = numeric(residual, 12, 6)(x, rate_of(par)(x, np.zeros(5))[6:])
    assert abs(found[:6]).max() < 1e-11 * max(1.0, abs(found[6:]).max())


@pytest.mark.slow
@settings(deadline=None, max_examples=25)
@given(seed=seeds)
def test_forces_feed_in_their_power_where_they_act(seed: int) -> None:
    """dE/dt = forces at the modules times the velocity of the axis there; wrenches act at the centre of gravity."""
    par, rng = unlike(seed), np.random.default_rng(seed)
    plant = tubular.plant(par)
    x, u, w = rng.uniform(-SIZE, SIZE), rng.uniform(-20, 20, 5), rng.uniform(-1, 1, 3)
    rate = numeric(lambda x, u, w: plant.f(x, u, plant.load(x) + ca.vertcat(w, 0, 0, 0)), 12, 5, 3)(x, u, w)
    slope = numeric(lambda x: ca.gradient(tubular.energy(par, x), x), 12)(x)

    def velocity(place: Any) -> FloatArray:
        moved: FloatArray = numeric(lambda x: ca.jtimes(place(x), x, ca.vertcat(x[6:], ca.SX(6, 1))), 12)(x)
        return moved

    levers = (-(par.l_B + x[2]), par.l_B - x[2])
    fed: Any = 0.0
    for l_i, force in zip(levers, ([*u[:2], u[4] / 2], [*u[2:4], u[4] / 2]), strict=True):
        fed += velocity(lambda x, l_i=l_i: x[:3] + l_i * rotation(x[3:6])[2, :].T) @ np.array(force)
    fed += w @ velocity(lambda x: x[:3] + centre_of_gravity(par, x[3:6]))
    parts = slope * rate
    assert parts.sum() == pytest.approx(fed, abs=1e-11 * abs(parts).sum())


@pytest.mark.slow
@settings(deadline=None, max_examples=25)
@given(seed=seeds)
def test_swapped_modules_are_the_mirror_image(seed: int) -> None:
    """z -> -z exchanges the modules; x -> -x turns the offsets along x round."""
    par, rng = unlike(seed), np.random.default_rng(seed)
    x, u = rng.uniform(-SIZE, SIZE), rng.uniform(-20, 20, 5)
    here = rate_of(par)(x, u)
    along, across = np.tile([1, 1, -1, -1, -1, 1.0], 2), np.tile([-1, 1, 1, 1, -1, -1.0], 2)
    swapped = rate_of(replace(par, dK_A=-par.dK_A, dK_B=-par.dK_B))(along * x, np.r_[u[2:4], u[:2], -u[4]])
    np.testing.assert_allclose(along * swapped, here, rtol=0, atol=1e-11 * abs(here).max())
    mirrored: Any = replace(par, e_x=-par.e_x, c_x=-par.c_x)
    there = rate_of(mirrored)(across * x, np.array([-1, 1, -1, 1, 1]) * u)
    np.testing.assert_allclose(across * there, here, rtol=0, atol=1e-11 * abs(here).max())


@pytest.mark.slow
@settings(deadline=None, max_examples=20)
@given(seed=seeds)
def test_linear_model_equals_finite_differences(seed: int) -> None:
    """A and B of modules that differ, at rest anywhere along the travel, against central differences of the motion."""
    par, rng = unlike(seed), np.random.default_rng(seed)
    plant = tubular.plant(par)
    model = malta.linearize(plant, plant.at(z=float(rng.uniform(-0.015, 0.015))))
    point = model.operating_point
    rate = numeric(lambda x, u: plant.f(x, u, ca.SX(6, 1)), 12, 5)
    for state in (
        5,
        11,
    ):  # A leaves the roll out, and rightly: nothing that it keeps depends on the roll there
        step = 1e-3 * (np.arange(12) == state)
        change = rate(point.x + step, point.u) - rate(point.x - step, point.u)
        assert abs(change[list(plant.controlled)]).max() < 1e-12
    keep = list(plant.controlled)
    for k, state in enumerate(keep):
        step = 2e-7 * (np.arange(12) == state)
        slope = (rate(point.x + step, point.u) - rate(point.x - step, point.u)) / 4e-7
        np.testing.assert_allclose(slope[keep], model.A[:, k], rtol=0, atol=1e-6 * abs(model.A).max())
    for k in range(5):
        push = (np.arange(5) == k) * 1.0
        slope = rate(point.x, point.u + push) - rate(point.x, point.u)
        np.testing.assert_allclose(slope[keep], model.B[:, k], rtol=0, atol=1e-10 * abs(model.B).max())


def test_a_controller_of_ideal_modules_commands_other_forces_on_unlike_ones() -> None:
    """K_B of the modules: currents for equal modules make (1 -+ dK_B) of the forces."""
    par = malta.read("data/tubular.toml")
    ideal, real = plant_of(par), plant_of(replace(par, dK_B=0.1))
    model = malta.linearize(real, real.at(z=0.0), ideal)
    np.testing.assert_allclose(
        model.B, malta.linearize(ideal, ideal.at()).B * [0.9, 0.9, 1.1, 1.1, 1], rtol=1e-12
    )
    currents = np.arange(1.0, 13)
    forces = np.array(real.drive.force(ca.DM(currents))).ravel()
    np.testing.assert_allclose(forces[:4], 5.2 * np.array([0.9 * 3, 0.9 * 5, 1.1 * 9, 1.1 * 11]), rtol=1e-12)


def test_the_offset_of_the_magnets_is_a_load() -> None:
    """The centred machine is at rest at the sensors' centre; the pull of an offset stands in v0, beside the weight."""
    par: Any = replace(malta.read("data/tubular.toml"), e_x=5e-6, e_y=-1.6e-5, dK_A=0.1)
    plant = plant_of(par)
    assert not np.array(plant.f(ca.DM(plant.at(z=3e-3).x), 0, 0)).any()
    u = malta.trim(plant, z=0.0).u
    weight = par.m * par.g / 2
    np.testing.assert_allclose(u[:4], [
        *(0.9 * par.K_A * 5e-6, weight + 0.9 * par.K_A * -1.6e-5),
        *(1.1 * par.K_A * 5e-6, weight + 1.1 * par.K_A * -1.6e-5),
    ], rtol=1e-12)  # fmt: skip


def test_attraction_grows_as_poles_do_whose_pull_is_the_inverse_square_of_the_gap() -> None:
    """kappa = 2 (r_max / g)^2 against 1 / (g - r)^2 - 1 / (g + r)^2; and the force is the slope of its potential."""
    gap = 2e-3
    par: Any = replace(malta.read("data/tubular.toml"), kappa=2 * (0.6e-3 / gap) ** 2)
    r = 1e-4
    poles = par.K_A * gap**3 / 4 * (1 / (gap - r) ** 2 - 1 / (gap + r) ** 2)
    grown = float(attraction(par, 1, ca.DM([r, 0]))[0])
    assert grown == pytest.approx(poles, rel=2e-5)  # 3 (r / g)^4 is left
    assert abs(par.K_A * r / poles - 1) > 4e-3
    P = ca.SX.sym("P", 2)
    unequal = unlike(3)
    for side in SIDES:
        force = ca.Function(
            "F", [P], [attraction(unequal, side, P), -ca.gradient(potential(unequal, side, P), P)]
        )
        direct, slope = force([2e-4, -1e-4])
        np.testing.assert_allclose(np.array(direct), np.array(slope), rtol=1e-12)


def test_a_mover_out_of_balance_hangs_as_a_pendulum() -> None:
    """It rolls about its axis, which the modules hold: no input is asked to hold the roll."""
    par: Any = replace(malta.read("data/tubular.toml"), c_y=-2e-4)
    hanging = plant_of(par)
    u = malta.trim(hanging).u
    slope = numeric(lambda x: ca.jacobian(hanging.f(x, ca.DM(u), hanging.load(x)), x), 12)(np.zeros(12))
    assert -slope[11, 5] == pytest.approx(par.m * par.g * 2e-4 / par.I_zz, rel=1e-9)
    aside: Any = replace(par, c_x=1e-4)
    roll = par.m * par.g * 1e-4 / (par.I_zz + par.m * 5e-8)  # rad/s2 about an axis that is held
    held = malta.trim(plant_of(aside)).u
    assert abs(held[0] + held[2]) == pytest.approx(par.m * roll * 2e-4, rel=1e-9)
    assert par.m * par.g - held[1] - held[3] == pytest.approx(par.m * roll * 1e-4, rel=1e-9)


# --- Fig. 13 ---


@pytest.fixture(scope="module")
def controller() -> malta.synthesis.Controller:
    return malta.gains.read(GAINS)


@pytest.fixture(scope="module")
def figure(controller: malta.synthesis.Controller) -> Figure13:
    return figure_13(controller, 3.25, 20e-6)


def test_an_offset_of_the_magnetic_centre_carries_what_the_paper_measures(figure: Figure13) -> None:
    """3.25 N of m g = 3.53 N at z = 5 mm, with the magnetic centre 16.3 um below the sensors'."""
    assert figure.offset == pytest.approx((3.25 - 0.36 * 9.81) / (2 * 8626.7), rel=1e-12)
    assert -17e-6 < figure.offset < -16e-6
    assert carried_weight(figure.centred) == pytest.approx(3.25, abs=1e-3)
    assert float(figure.centred.p[-1, 4]) == pytest.approx(5e-3, abs=0.1e-3)
    assert radial_deviation(figure.centred, (0, 2)) < 1e-12


def test_thrust_off_the_centre_of_gravity_moves_x_as_far_as_the_paper_measures(figure: Figure13) -> None:
    """20 um in x1, x2, and little in y1, y2, where thrust passes the centre of gravity by 0.6 mm."""
    assert 0.5e-3 < figure.causes["c_x"] < 0.7e-3
    run = figure.moved["c_x"]
    assert run.verdict.completed
    assert radial_deviation(run, (0, 2)) == pytest.approx(20e-6, rel=0.02)
    assert radial_deviation(run, (1, 3)) < 3e-6


def test_offsets_of_current_sensors_move_the_mover_as_far(figure: Figure13) -> None:
    """A percent of the current range is enough, with 20 um in y and half of that in x."""
    assert 0.03 < figure.causes["d_i"] < 0.06
    run, start = figure.moved["d_i"], WAIT["d_i"]
    assert radial_deviation(run, start=start) == pytest.approx(20e-6, rel=0.02)
    assert radial_deviation(run, (0, 2), start) > 5e-6
    assert abs(run.p[np.searchsorted(run.t, start), :4]).max() < 1e-6  # at rest before the stroke


@pytest.mark.parametrize("changes", [{"dK_A": 0.1, "dK_B": 0.1}, {"e_x": 1.7e-5, "dK_A": 0.1, "kappa": 0.5}])
def test_modules_that_differ_leave_x_alone_during_a_stroke(
    controller: Any, changes: dict[str, float]
) -> None:
    """By the mirror x -> -x; and the pull of an offset e_x is constant in the planes of the modules."""
    plant = plant_of(replace(controller.parameters, **changes))
    wait = 2.0 if "e_x" in changes else 0.0  # until the integrals carry the pull
    run = simulate(plant, controller, Scenario("stroke", wait + 0.1, partial(delayed_stroke, wait=wait)))
    moved = run.p[run.t >= wait][:, [0, 2]]
    assert np.ptp(moved, axis=0).max() < 0.05e-6
    assert np.ptp(run.p[run.t >= wait][:, 1]) > 0.3e-6  # y moves


# --- simulation, campaigns, command line ---


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ["force", "dq"])
def test_both_engines_agree_on_unlike_modules(controller: Any, fidelity: Any) -> None:
    plant = plant_of(unlike(5, c_x=1e-4, c_y=-2e-4, dK_B=0.1, e_x=2e-5, e_y=1e-5))
    scenario = Scenario.stroke(10e-3, rise=16.2e-3, fidelity=fidelity)
    one, two = (simulate(plant, controller, scenario, engine=e) for e in ("compiled", "virtual machine"))
    assert one.verdict.completed
    np.testing.assert_allclose(one.p, two.p, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_a_campaign_draws_modules_that_differ(controller: Any) -> None:
    """Spreads of differences are in their own unit, about 0; a run of the batch is the machine simulated alone."""
    plan = malta.campaigns.Plan(
        controller,
        spread={"m": 0.1, "dK_A": 0.05, "e_y": 2e-5, "c_x": 1e-4},
        samples=16,
        options={"fidelity": "force"},
    )
    from malta.campaigns.plan import draw_machines, planned_run

    drawn = draw_machines(plan)
    assert abs(drawn.changes["dK_A"]).max() <= 0.05
    assert np.ptp(drawn.changes["e_y"]) > 3e-5
    scenario = planned_run(plan).scenario
    batch = malta.simulation.simulate_many(plan.plant, controller, scenario, drawn.changes)
    for k in (0, 7):
        own: Any = {name: float(values[k]) for name, values in drawn.changes.items()}
        run = simulate(plant_of(replace(controller.parameters, **own)), controller, replace(scenario, run=k))
        np.testing.assert_allclose(
            abs(run.p - run.reference).max(axis=0), batch.deviation[k], rtol=1e-6, atol=1e-12
        )
    assert len({*batch.deviation[:, 0].tolist()}) == 16


def test_a_campaign_of_nothing_but_defaults_runs(controller: Any) -> None:
    batch = malta.simulation.simulate_many(
        plant_of(controller.parameters),
        controller,
        Scenario.stroke(1e-2, fidelity="force"),
        {"dK_A": np.zeros(3)},
    )
    assert batch.completed.all()


@pytest.mark.slow
def test_set_on_the_command_line(run: Run) -> None:
    said = run("simulate", GAINS, "--set", "dK_A=5%", "--set", "e_y=-16.3um", "--json")
    assert said.code == 0, said.err
    for text, found in (("dK_A=1.5", "dK_A"), ("kappa=-1", "kappa"), ("e_y=2kg", "e_y")):
        said = run("simulate", GAINS, "--set", text)
        assert said.code == 2
        assert found in one_sentence(said.err)


@pytest.mark.slow
def test_spread_on_the_command_line(run: Run, tmp_path: Path) -> None:
    said = run(
        "campaign", GAINS, "--samples", "8", "--spread", "dK_A=3%", "--spread", "e_x=10um",
        "--option", "fidelity=force", "--out", tmp_path, "--json",
    )  # fmt: skip
    assert said.code == 0, said.err
    assert json.loads(said.out)["manifest"]["spread"] == {"dK_A": 0.03, "e_x": 1e-5}
