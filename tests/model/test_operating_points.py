"""Operating points of machines whose `currents` is not the inverse of `forces`: commands, slopes, limits, refusals."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from magnets import BENCH, MACHINES, bench, two_coils

import malta
from malta.linear.expressions import program
from malta.loops.parametric_loops import machine_system
from malta.loops.parametric_plants import of_plant
from malta.loops.rest import Unknowns, solve_rows
from malta.loops.sampled_loops import loaded_model, machine_loop
from malta.model.equilibrium import with_command
from malta.model.plant import OperatingPoint
from malta.simulation.experiments.payloads import held_payload
from malta.simulation.linear_run import linear_run

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.arrays import FloatArray
    from malta.model.plant import Plant

pytestmark = pytest.mark.usefixtures("proven_once")


DIFFERENT = {"C": 1.2, "g0": 0.85, "m": 1.2}  # what a controller may believe instead, relative


def rate(
    plant: Plant, believed: Plant, x: FloatArray, y: FloatArray, v: FloatArray, *, loaded: bool
) -> FloatArray:
    """x' of the whole chain from a command v at a reading y."""
    u = plant.actuator.forces(ca.DM(x), believed.actuator.currents(ca.DM(y), ca.DM(v)))
    w = plant.load(ca.DM(x)) if loaded else ca.DM.zeros(len(plant.disturbances))
    return np.array(ca.DM(ca.vertcat(plant.f(ca.DM(x), u, w)))).ravel()


def slopes(function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float) -> FloatArray:
    """The derivative by differences of fourth order, one column for each entry."""
    columns = []
    for e in np.eye(len(at)) * step:
        columns.append(
            (8 * (function(at + e) - function(at - e)) - function(at + 2 * e) + function(at - 2 * e)) / 12
        )
    return np.array(columns).T / step


@pytest.mark.parametrize("loaded", [False, True])
@pytest.mark.parametrize("differ", [False, True])
@pytest.mark.parametrize("name", MACHINES)
def test_the_linear_model_is_the_derivative_of_the_chain(name: str, differ: bool, loaded: bool) -> None:
    """A, B and E by differences of f(x, forces(x, currents(y, v)), w) where its command v converged."""
    make, par, at = MACHINES[name]
    plant = make(par)
    other = replace(par, **{key: getattr(par, key) * by for key, by in DIFFERENT.items()})
    believed = make(other) if differ else plant
    point = malta.trim(plant, **at) if loaded else plant.at(**at)
    model = malta.linearize(plant, point, believed if differ else None)
    x, v = model.operating_point.x, model.operating_point.v
    assert v is not None
    y = np.array(plant.h(ca.DM(x), 0)).ravel()
    wanted = np.array(ca.DM(plant.f(ca.DM(x), ca.DM(point.u), plant.load(ca.DM(x)) if loaded else 0))).ravel()
    np.testing.assert_allclose(rate(plant, believed, x, y, v, loaded=loaded), wanted, rtol=1e-10, atol=1e-9)

    def read(z: FloatArray) -> FloatArray:
        return np.array(plant.h(ca.DM(z), 0)).ravel()

    A = slopes(lambda z: rate(plant, believed, z, read(z), v, loaded=loaded), x, 1e-6)
    B = slopes(lambda c: rate(plant, believed, x, y, c, loaded=loaded), v, 1e-3)
    E = slopes(lambda r: rate(plant, believed, x, r, v, loaded=loaded), y, 1e-6)
    for ours, theirs in ((model.A, A), (model.B, B), (model.E, E)):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-8 * np.abs(A).max())


def _with(plant: Plant, **functions: Any) -> Plant:
    """The machine with other functions of its actuator."""
    return replace(plant, actuator=replace(plant.actuator, **functions))


@pytest.mark.parametrize("name", MACHINES)
def test_trim_is_at_rest_with_the_forces_that_its_command_makes(name: str) -> None:
    """f(x, forces(x, currents(h(x), v)), load) is rounding, and the point's inputs are those of its command."""
    make, par, at = MACHINES[name]
    plant = make(par)
    point = malta.trim(plant, **at)
    assert point.v is not None
    y = np.array(plant.h(ca.DM(point.x), 0)).ravel()
    assert abs(rate(plant, plant, point.x, y, point.v, loaded=True)).max() < 1e-9
    made = np.array(
        plant.actuator.forces(ca.DM(point.x), plant.actuator.currents(ca.DM(y), ca.DM(point.v)))
    ).ravel()
    np.testing.assert_allclose(point.u, made, rtol=1e-12, atol=1e-12)
    exact = name == "inverse"
    assert np.allclose(point.u, point.v, rtol=1e-9) == exact


@pytest.mark.parametrize(
    ("q", "stiffness", "per_force"),
    [(0.0, 14667.3, 10.0), (1e-3, 16888.7, 10.9697), (2e-3, 21121.6, 13.1385)],
)
def test_the_ball_off_its_middle(q: float, stiffness: float, per_force: float) -> None:
    """Where k_i i makes another force than is commanded: slopes at the current that carries the weight."""
    ball = malta.read_design("examples/ball/design/ball.toml").plant
    model = malta.linearize(ball, malta.trim(ball, q=q))
    assert model.A[1, 0] == pytest.approx(stiffness, abs=0.06)
    assert model.B[1, 0] == pytest.approx(per_force, abs=1e-4)
    assert model.operating_point.u[0] == pytest.approx(0.981, rel=1e-12)


def test_a_controller_with_other_parameters_commands_another_force() -> None:
    """Its current for v is that of its own constants: v = v* C'/C (g0'/g0)^2 makes the machine's weight."""
    plant = bench(BENCH)
    believed = bench(replace(BENCH, C=1.2 * BENCH.C, bias=1.5))
    held = malta.trim(plant)
    model = malta.linearize(plant, held, believed)
    assert model.operating_point.v == pytest.approx(held.u * 1.2, rel=1e-10)
    assert model.operating_point.u == pytest.approx(held.u, rel=1e-10)


def test_no_command_is_said_where_the_forces_exist() -> None:
    """An input would hold the mass, but the currents of no command make one that pushes."""
    pushed = bench(replace(BENCH, k=20e3))  # at x = -1 mm the spring pushes with 20 N, the weight with 4.9
    with pytest.raises(malta.CheckError, match=r"no command holds the state x = -0.001 m: x_dot changes at"):
        malta.trim(pushed, x=-1e-3)
    with pytest.raises(malta.CheckError, match="no input holds the state x_dot"):
        malta.trim(pushed, x_dot=0.1)


def test_limits_that_bind_are_named() -> None:
    """Of a force, of a current, and a machine's own `limited`."""
    with pytest.raises(malta.CheckError, match=r"current i = .* A is limited to 0.1 A"):
        malta.trim(bench(replace(BENCH, I_max=0.1)), x=-2e-3)
    heavy = replace(BENCH, m=5.0, I_max=1e3)
    with pytest.raises(malta.CheckError, match=r"command f = 49.05 N is beyond its limit of 40 N"):
        malta.trim(bench(heavy))
    one_way = _with(bench(BENCH), limited=lambda i: ca.fmax(i, 0))
    with pytest.raises(malta.CheckError, match=r"the current i = -.* A is limited to 0 A"):
        malta.trim(replace(one_way, load=lambda _: -0.5))


def test_a_missing_preload_is_named() -> None:
    """Currents sqrt(v) have no slope at v = 0."""
    for kind in ("knows", "middle"):
        plant = bench(replace(BENCH, preload=0.0, kind=kind))
        with pytest.raises(
            malta.CheckError, match=r"no finite slope at the command f = 0 N: .* needs a `preload`"
        ):
            malta.linearize(plant, plant.at())
    pushing = bench(replace(BENCH, preload=-1.0))
    with pytest.raises(malta.CheckError, match=r"no command makes its `preload` \[-1.0\]"):
        malta.linearize(pushing, pushing.at())


def test_a_command_is_found_from_another_start() -> None:
    """Where the currents of the wanted force are not defined, shares of the limits are tried."""
    plant = bench(BENCH)
    shifted = _with(plant, currents=lambda y, v: plant.actuator.currents(y, v - 10))
    point = malta.trim(shifted, x=1e-3)
    assert point.v == pytest.approx(malta.trim(plant, x=1e-3).u + 10, rel=1e-9)


def test_the_command_of_a_point_is_kept() -> None:
    """Two commands hold a mass whose force is even in them: a model begins at the point's own."""
    plant = bench(replace(BENCH, kind="slope", bias=0.0, I_max=40.0))
    here = malta.trim(plant)
    assert here.v is not None
    mirror = OperatingPoint(here.x, here.u, loaded=True, v=-here.v)
    assert malta.linearize(plant, mirror).B[1, 0] == pytest.approx(
        -malta.linearize(plant, here).B[1, 0], rel=1e-9
    )
    assert with_command(plant, mirror).v == pytest.approx(-here.v, rel=1e-9)


PROVEN = {  # a machine, what its controller believes otherwise, and whether its command is a formula of the parameters
    "inverse": (True, True),
    "middle": (True, True),
    "slope": (True, True),
    "three coils": (True, True),
}


@pytest.mark.parametrize("differ", [False, True])
@pytest.mark.parametrize("name", MACHINES)
def test_a_model_in_parameters_is_the_linear_model_at_each(name: str, differ: bool) -> None:
    """Rest follows the parameters: the command that holds the machine under its loads, whatever they are."""
    make, par, at = MACHINES[name]
    names = ("m", "C", "g0") if make is bench else ("m", "C")
    plant = make(par)
    believed = make(replace(par, C=1.2 * par.C, g0=0.85 * par.g0)) if differ else plant
    system = of_plant(plant, names, at=at, believed=believed)
    assert (system.approximate == "") == PROVEN[name][differ]
    rng = np.random.default_rng(3)
    for _ in range(5):
        values = {key: getattr(par, key) * rng.uniform(0.8, 1.2) for key in names}
        other = make(replace(par, **values))
        model = malta.linearize(other, malta.trim(other, **at), believed)
        A, B, C = system.at(np.array([list(values.values())]))
        np.testing.assert_allclose(A[0], model.A, rtol=0, atol=1e-9 * np.abs(model.A).max())
        np.testing.assert_allclose(B[0], model.B, rtol=0, atol=1e-9 * np.abs(model.B).max())
        np.testing.assert_array_equal(C[0], model.C)


@pytest.mark.parametrize("q", [0.0, 1e-3])
def test_the_ball_in_parameters_off_its_middle(q: float) -> None:
    """Its command solves a quadratic equation, and the right one of two roots."""
    ball = malta.read_design("examples/ball/design/ball.toml").plant
    names = ("m", "C", "s", "I_0")
    system = of_plant(ball, names, at={"q": q}, believed=ball)
    assert system.approximate == ""
    par: Any = ball.parameters
    values = {"m": 0.08, "C": 2.3e-5, "s": 5.6e-3, "I_0": 1.3}
    other = ball.variant(replace(par, **values))
    model = malta.linearize(other, malta.trim(other, q=q), ball)
    A, B, _ = system.at(np.array([list(values.values())]))
    np.testing.assert_allclose(A[0], model.A, rtol=1e-12)
    np.testing.assert_allclose(B[0], model.B, rtol=1e-12)


@pytest.mark.slow
def test_a_command_that_is_no_formula_is_proven_as_a_root() -> None:
    """Three coils under a weight: the margin is where the poles of the model at its own balance are lost."""
    make, par, at = MACHINES["three coils"]
    plant = make(par)
    system = of_plant(plant, ("m", "C"), at=at, believed=plant)
    assert (system.approximate, program(system.matrices).implicit) == ("", True)
    A, B, _ = (M[0] for M in system.at(system.nominal))
    inverse, w, fast = np.linalg.inv(B[2:]), 60.0, 2e3  # PD with a fast filter
    K, D, one = inverse @ (A[2:, :2] + w**2 * np.eye(2)), 1.4 * w * inverse, np.eye(2)
    law = malta.proof.Compensator(-fast * one, fast * one, fast * D, -K - fast * D)

    def worst(t: float) -> float:
        other = make(replace(par, C=(1 + 0.2 * t) * par.C))
        model = malta.linearize(other, malta.trim(other, **at), plant)
        closed = np.block([[model.A + model.B @ law.D @ model.C, model.B @ law.C], [law.B @ model.C, law.A]])
        return float(np.linalg.eigvals(closed).real.max())

    found = malta.robust_margin(system, law, {"C": 0.2})
    lower = found.lower or 0.0
    assert worst(0.999 * lower) < 0
    if np.isfinite(found.upper):
        assert worst(1.001 * found.upper) > 0
        assert lower > 0.998 * found.upper
    else:
        assert "nothing holds it at rest within the limit" in found.searched


def test_what_no_root_is_proven_of_is_said() -> None:
    """Fewer equations than commands, and an operation without enclosure: searched in floating point, not proven."""
    p, r = ca.SX.sym("p"), ca.SX.sym("r", 2)
    unknowns = Unknowns(r, np.array([0.5, 0.75]), p, np.array([1.0]))
    wide = solve_rows(r[0] ** 2 + r[1] - p, unknowns, [])
    assert wide.why == "several commands balance the machine"
    both = solve_rows(ca.vertcat(r[0] + ca.floor(r[0]) * r[1] - p / 2, r[1] ** 3 - 0.75**3 * p), unknowns, [])
    assert both.why == "the equations of rest have floor, which has no enclosure"
    for found in (wide, both):
        assert program(ca.Function("r", [p], [found.values])).foreign
        near = np.array(ca.Function("r", [p], [found.values])(1.0)).ravel()
        np.testing.assert_allclose(near, unknowns.near, rtol=1e-12)


def test_the_check_says_where_currents_are_no_inverse() -> None:
    """Along each clearance, for commands within the limits: of the ball at the end of its way, of others nowhere."""
    ball = malta.read_design("examples/ball/design/ball.toml").plant
    found = ball.check()
    assert not found.exact
    (worst,) = found.mismatches
    par: Any = ball.parameters
    i = worst.command * par.s**2 / (4 * par.C * par.I_0)
    made = par.C * (
        ((par.I_0 + i) / (par.s - worst.place)) ** 2 - ((par.I_0 - i) / (par.s + worst.place)) ** 2
    )
    assert abs(worst.place) == pytest.approx(par.q_max, rel=1e-5)
    assert worst.made == pytest.approx(made, rel=1e-12)
    assert worst.share == pytest.approx(abs(made - worst.command) / ball.actuator.force_limit[0], rel=1e-12)
    assert len(str(found).splitlines()) == 2
    linear = _with(ball, forces=lambda _, i: 4 * par.C * par.I_0 / par.s**2 * i)
    assert linear.check().exact
    assert str(linear.check()) == "ball: `currents` is the inverse of `forces` along q"


def test_the_check_names_commands_without_currents() -> None:
    """A magnet that only pulls; and a machine without clearances is looked at where it stands."""
    found = bench(BENCH).check()
    assert found.exact
    assert found.undefined == "no currents for f = -15.09 N"
    wrong = str(two_coils(BENCH).check())
    assert "is not the inverse" in wrong
    assert len(wrong.splitlines()) <= 10


@pytest.fixture(scope="module")
def off_centre(tmp_path_factory: pytest.TempPathFactory) -> malta.Spec:
    """The ball's design 1 mm above its middle."""
    folder = tmp_path_factory.mktemp("off") / "ball"
    shutil.copytree("examples/ball", folder, ignore=shutil.ignore_patterns("build", "gains", "__pycache__"))
    file = folder / "design" / "ball.toml"
    text = file.read_text(encoding="utf-8")
    place = 'operating_point = { q = { value = 1, unit = "mm" } }'
    file.write_text(text.replace("operating_point = {}", place), encoding="utf-8")
    return malta.read_design(file)


def test_a_design_off_the_stroke_stands_where_it_is_designed(off_centre: malta.Spec) -> None:
    """Its feedforward holds the ball there, runs are about it, and the linear run is the simulation's."""
    ball = off_centre.plant
    model = malta.linearize(ball, ball.at(**off_centre.operating_point))
    controller = malta.synthesize(off_centre, model)
    assert controller.operating_point[0].tolist() == [1e-3, 0.0]
    hold = controller.feedforward.v0[0] + controller.feedforward.position @ [1e-3]
    assert hold == pytest.approx(malta.trim(ball, q=1e-3).v, rel=1e-12)
    still = malta.experiment("hold", ball, controller, noise=0.0)
    assert np.abs(still.run.p - 1e-3).max() < 1e-12
    step = malta.experiment("step", ball, controller, size=20e-6)
    assert step.run.p[-1, 0] == pytest.approx(1.02e-3, abs=1e-7)
    loop = machine_loop(model, controller)
    linear = linear_run(loop, controller, step.run.scenario)
    np.testing.assert_allclose(linear.p[:, 0], step.run.p[:, 0], rtol=0, atol=0.5e-6)


def test_a_design_off_the_stroke_is_proven_at_the_slopes_there(off_centre: malta.Spec) -> None:
    """The machine's loop has the slopes at the current that carries the weight; the witness is near the margin."""
    ball = off_centre.plant
    model = malta.linearize(ball, ball.at(**off_centre.operating_point))
    controller = malta.synthesize(off_centre, model)
    loaded = loaded_model(ball, 0.0, (("q", 1e-3),))
    assert loaded.A[1, 0] == pytest.approx(16888.7, abs=0.1)
    system, _ = machine_system(ball, controller, ("m", "C"), off_centre.operating_point)
    A, B, _ = (M[0] for M in system.at(system.nominal))
    np.testing.assert_allclose(A, loaded.A, rtol=1e-12)
    np.testing.assert_allclose(B, loaded.B, rtol=1e-12)
    robust = malta.verify(model, controller, off_centre.uncertainty).robust
    assert robust is not None
    assert robust.lower is not None
    assert robust.lower == pytest.approx(robust.upper, rel=2e-3)


def test_a_moving_operating_point_is_refused_in_one_sentence(off_centre: malta.Spec) -> None:
    """A speed is a state, but nothing rests there."""
    ball = off_centre.plant
    with pytest.raises(
        malta.CheckError, match=r"no input holds the state q_dot = 0.1 m/s: q changes at 0.1 m/s"
    ):
        malta.synthesize(off_centre, malta.linearize(ball, ball.at(q_dot=0.1)))


@pytest.mark.slow
def test_a_payload_ends_where_no_command_carries_it() -> None:
    """Currents that are clipped at 2.5 A make C (bias + 2.5 A)^2 / g0^2 = 30 N at most."""

    def clipped(par: Any) -> Plant:
        plant = bench(par)
        weak = _with(plant, currents=lambda y, v: ca.fmin(plant.actuator.currents(y, v), 2.5))
        return replace(weak, variant=clipped)

    most = BENCH.C * 4.0**2 / BENCH.g0**2
    assert held_payload(clipped(BENCH)) == pytest.approx(most / 9.81 - BENCH.m, rel=1e-6)
