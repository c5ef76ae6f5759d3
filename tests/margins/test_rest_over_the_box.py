"""What is proven is the machine that hangs there: at rest under its loads, at every value of its parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from along_travel import at_place
from magnets import MACHINES
from scipy.linalg import expm

import malta
from malta.linear.closed_loops import closed_loop
from malta.loops.parametric_loops import machine_system
from malta.model import Actuator, Plant, Sensors, Signal, check_parameters, si
from malta.proof.box import box_of, within_branches

if TYPE_CHECKING:
    from pathlib import Path

    from malta.synthesis.controller import Controller

Case = tuple[
    Plant, "Controller", dict[str, float], dict[str, Any]
]  # a machine, its law, a box, and where it rests
TS = 2e-4


@dataclass(frozen=True)
class Axis:
    """A mass on one axis before magnets of stiffness k, under its weight, a spring and a drag."""

    m: float = si("kg", above=0)
    k: float = si("N/m")  # of the magnets, beside the force of the current
    s: float = si("N/m")  # of a spring
    d: float = si("N s/m")  # of a drag
    C: float = si("N/A", above=0)
    I_max: float = si("A", above=0)
    place: str = "load"  # where spring and drag are declared
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "axis.Parameters")


AXIS = Axis(0.4, 900.0, 250.0, 3.0, 8.0, 5.0)


def plant(par: Any) -> Plant:
    """The machine, with spring and drag in its load or in f."""
    in_load = par.place == "load"

    def pull(x: Any) -> Any:
        return -par.s * x[0] - par.d * x[1]

    return Plant(
        name="axis",
        parameters=par,
        variant=plant,
        states=(Signal("q", "m"), Signal("q_dot", "m/s")),
        inputs=(Signal("f", "N"),),
        outputs=(Signal("y", "m"),),
        disturbances=(Signal("w", "N"),),
        f=lambda x, u, w: ca.vertcat(x[1], (u + w + (0 if in_load else pull(x))) / par.m),
        h=lambda x, _: x[0],
        load=lambda x: -9.81 * par.m + (pull(x) if in_load else 0 * x[0]),
        actuator=Actuator(
            (Signal("i", "A"),), (par.C,), par.I_max, dead_time=1.5 * TS,
            currents=lambda _, v: v / par.C, forces=lambda x, i: par.C * i + par.k * x[0],
        ),
        sensors=Sensors(noise=(1e-6,)),
    )  # fmt: skip


def law_of(machine: Plant, q: float = 0.0) -> Controller:
    weights = malta.synthesis.weights([1e8, 1e4], [1.0], [1e-2], [1e-12])
    return malta.lqg(malta.linearize(machine, machine.at(q=q)), weights, TS, delay=1)


def test_a_spring_is_a_spring_in_f_and_in_load() -> None:
    """Its slope and the drag's act in the loop, wherever they are declared: the same margin to rounding."""
    box = {"m": 0.2, "s": 0.5, "d": 0.5, "k": 0.1}
    one, two = plant(AXIS), plant(replace(AXIS, place="f"))
    law = law_of(two)
    found = [malta.robust_margin(malta.loop(machine, law, q=1e-4), box) for machine in (one, two)]
    assert found[0].lower == pytest.approx(found[1].lower, rel=1e-6)
    assert found[0].upper == pytest.approx(found[1].upper, rel=1e-6)
    stiff = plant(replace(AXIS, s=0.0, d=0.0))
    assert (
        malta.robust_margin(malta.loop(stiff, law, q=1e-4), {"k": 0.1}).upper
        < 0.96 * malta.robust_margin(malta.loop(one, law, q=1e-4), {"k": 0.1}).upper
    )


def test_a_box_ends_where_nothing_holds_the_machine() -> None:
    """C I_max = 40 N carry 40 / 9.81 kg at q = 0: the answer says so, and proves nothing beyond."""
    light = plant(replace(AXIS, k=30.0))
    found = malta.robust_margin(malta.loop(light, law_of(light)), {"m": (0.4, 0.5)})
    most = 40 / 9.81
    assert found.lower == pytest.approx((most - 0.4) / 0.1, rel=1e-3)
    assert (found.lower or 0.0) <= (most - 0.4) / 0.1
    assert found.exhausted
    assert "nothing holds it at rest within the limit of" in found.searched
    assert f"m = {most:.3g}"[:8] in found.searched
    with pytest.raises(malta.CheckError, match="nothing holds"):
        _ = malta.loop(light, law_of(light), parameters={"m": 1.001 * most}).stable
    heavy = plant(replace(AXIS, m=4.2))
    with pytest.raises(malta.CheckError, match="nothing holds"):
        _ = malta.loop(heavy, law_of(light)).stable
    nothing = malta.robust_margin(malta.loop(heavy, law_of(light)), {"m": 0.1})
    assert (nothing.lower, "nothing holds it at rest" in nothing.reason) == (None, True)


def test_the_ball_under_its_weight() -> None:
    """300 g between two magnets: by its own equilibrium at each corner, and the eigenvalues of its own period."""
    spec = malta.read_design("examples/ball/design/ball.toml")
    par: Any = replace(spec.plant.parameters, m=0.3)
    ball = malta.plant_of(par)
    c = malta.lqg(
        malta.linearize(ball, ball.at()),
        malta.synthesis.weights(q=[1.0, 1e-3], r=[1.0], w=[1e-2], v=[4e-12]),
        Ts=TS,
    )
    command = 4 * par.C * par.I_0 / par.s**2  # N/A, as the law believes

    def radius(p: Any) -> float:
        i = p.m * p.g * p.s**2 / (4 * p.C * p.I_0)
        stiffness, gain = 4 * p.C * (p.I_0**2 + i**2) / p.s**3 / p.m, 4 * p.C * p.I_0 / p.s**2 / command / p.m
        held = expm(np.array([[0, 1, 0], [stiffness, 0, gain], [0, 0, 0]]) * TS)
        closed = np.zeros((4, 4))
        F, G = held[:2, :2], held[:2, 2:]
        L, K = c.L, c.K
        now = np.hstack([L @ np.array([[1.0, 0.0]]), np.eye(2) - L @ c.Cd])  # xi_hat of (x, xi)
        closed[:2] = np.hstack([F, np.zeros((2, 2))]) - G @ K @ now
        closed[2:] = (c.Ad - c.Bd @ K) @ now
        return float(np.abs(np.linalg.eigvals(closed)).max())

    low, high = 0.0, 9.0
    for _ in range(40):
        t = (low + high) / 2
        corner = replace(par, m=par.m * (1 + 0.1 * t), C=par.C * (1 - 0.1 * t))
        low, high = (t, high) if radius(corner) < 1 else (low, t)
    found = malta.robust_margin(malta.loop(ball, c), {"m": 0.1, "C": 0.1})
    assert found.lower == pytest.approx(low, rel=2e-3)
    assert (found.lower or 0.0) <= low * (1 + 1e-6)


@pytest.mark.parametrize("box", [{"m": 0.1}, {"m": 0.1, "R": 0.1}])
def test_a_current_at_rest_follows_the_weight(box: dict[str, float]) -> None:
    """A magnet 2 mm off its middle, whose current is a state: at each mass the current that holds it."""
    spec = malta.read_design("examples/magnet/design/scheduled.toml")
    machine = spec.plant
    law = malta.synthesize(spec, malta.linearize(machine, machine.at()))
    at: dict[str, Any] = {"q": 2e-3, "i": float(machine.position_of([2e-3])[2])}
    found = malta.robust_margin(malta.loop(machine, law, **at), box)
    assert found.lower is not None
    assert found.witness is not None
    assert found.lower == pytest.approx(found.upper, rel=1e-3)
    radii = []
    for share in (0.999, 1.001):
        lost = {k: v - found.moved[k] * (1 - share) for k, v in found.witness.items()}
        there = malta.plant_of(replace(machine.parameters, **lost))
        rest: dict[str, Any] = {"q": 2e-3, "i": float(there.position_of([2e-3])[2])}
        radii.append(np.abs(np.linalg.eigvals(malta.loop(there, law, **rest).matrix)).max())
    assert radii[0] < 1 < radii[1]


def test_the_slope_of_v0_along_the_travel_is_that_of_the_table() -> None:
    """Robust's loop over the travel, at a place, is its loop at that place: cogging against v0, cell by cell."""
    c = malta.gains.read("design/gains/robust.json")
    tubular = malta.plant_of(c.parameters)
    system, law = machine_system(tubular, c, ("m", "K_A", "z"), {})
    assert system.derived is not None
    for z in (0.0, 2.1e-3, -9e-3, 15e-3):
        for name, (low, high) in system.derived.intervals.items():
            assert low <= system.derived.at(z)[name] <= high
        (over,) = closed_loop(system, law, at_place(system, np.zeros(0), z))
        there, own = machine_system(tubular, c, ("m", "K_A"), {"z": z})
        (here,) = closed_loop(there, own, there.nominal)
        ours, theirs = (np.linalg.eigvals(np.eye(len(M)) + c.sample_time * M) for M in (over, here))
        assert max(np.abs(ours - pole).min() for pole in theirs) < 1e-9


def random_axis(rng: np.random.Generator) -> Case:
    par = Axis(
        m=float(rng.uniform(0.1, 2)), k=float(rng.uniform(-500, 3000)), s=float(rng.uniform(-400, 900)),
        d=float(rng.uniform(-1, 5)), C=float(rng.uniform(5, 40)), I_max=float(rng.uniform(4, 20)),
    )  # fmt: skip
    q, box = float(rng.uniform(-2e-3, 2e-3)), {"m": 0.1, "k": 0.1, "s": 0.2, "C": 0.1}
    return plant(par), law_of(plant(replace(par, m=1.1 * par.m)), q), box, {"q": q}


def magnet(name: str) -> Case:
    make, par, at = MACHINES[name]
    par = replace(par, dead_time=1.5 * TS)
    believed = make(replace(par, C=1.1 * par.C))
    weights = malta.synthesis.weights([1e8, 1e4], [1.0], [1e-2], [1e-12], q_i=[1e9])
    law = malta.lqg(malta.linearize(believed, believed.at(**at)), weights, TS, delay=1)
    return make(par), law, {"m": 0.1, "C": 0.1, "k": 0.1}, at


def check_box(machine: Case, points: int, rng: np.random.Generator) -> float:
    """The loop of malta.loop, loads on, is stable anywhere in the proven box, and lost beyond a witness."""
    own, law, box, at = machine
    nominal = malta.loop(own, law, **at)
    try:
        if not nominal.stable:
            return 0.0
    except malta.CheckError:
        return 0.0
    found = malta.robust_margin(nominal, box)
    if found.lower is None:
        return 0.0
    values = {name: getattr(own.parameters, name) for name in box}
    for k in range(points):
        share = rng.uniform(-1, 1, len(box)) if k % 2 else rng.choice([-1.0, 1.0], len(box))
        moved = {
            name: v + 0.999 * found.lower * box[name] * abs(v) * x
            for (name, v), x in zip(values.items(), share.tolist(), strict=True)
        }
        assert malta.loop(own, law, parameters=moved, **at).stable
    if found.witness is not None:
        beyond = {name: v + 1.01 * found.moved[name] for name, v in values.items()}
        with_rest = True
        try:
            stable = malta.loop(own, law, parameters=beyond, **at).stable
        except malta.CheckError:
            with_rest, stable = False, False
        assert not stable or not with_rest
    return found.lower


@pytest.mark.parametrize("name", ["middle", "inverse", pytest.param("slope", marks=pytest.mark.slow)])
def test_what_is_proven_of_a_magnet_is_its_loop(name: str) -> None:
    assert check_box(magnet(name), 12, np.random.default_rng(1)) > 0


def test_what_is_proven_of_an_axis_is_its_loop() -> None:
    rng = np.random.default_rng(2)
    proven = [check_box(random_axis(rng), 8, rng) for _ in range(6)]
    assert sum(x > 0 for x in proven) >= 4


def saturating(par: Any) -> Plant:
    """The ball of the examples, whose iron saturates: its current at rest solves an equation that has no formula."""
    ball = BALL.variant(par)

    def pull(x: Any, i: Any) -> Any:
        own = 2 * ca.tanh(i / 2)
        up, down = (par.I_0 + own) / (par.s - x[0]), (par.I_0 - own) / (par.s + x[0])
        return par.C * (up**2 - down**2)

    return replace(ball, variant=saturating, actuator=replace(ball.actuator, forces=pull))


BALL = malta.read_design("examples/ball/design/ball.toml").plant


@pytest.mark.parametrize(
    "box",
    [
        {"m": 0.1},
        pytest.param({"C": 0.1}, marks=pytest.mark.slow),
        pytest.param({"m": 0.05, "C": 0.05}, marks=pytest.mark.slow),
    ],
    ids=" ".join,
)
def test_a_rest_that_is_no_formula_is_proven_as_it_is(box: dict[str, float]) -> None:
    """300 g before iron that saturates: what is proven is the loop at each own balance, and lost beyond a witness."""
    own = saturating(replace(BALL.parameters, m=0.3))
    weights = malta.synthesis.weights([1.0, 1e-3], [1.0], [1e-2], [4e-12])
    law = malta.lqg(malta.linearize(own, own.at()), weights, TS)
    assert check_box((own, law, box, {}), 20, np.random.default_rng(4)) > 0.3
    if len(box) == 1:
        found = malta.robust_margin(malta.loop(own, law), box)
        assert (found.lower or 0.0) > 0.998 * found.upper


@pytest.mark.slow
def test_what_is_proven_of_any_machine_is_its_loop() -> None:
    """16 machines with springs, drags and weights in their loads, laws of another mass, 200 points of each box."""
    rng = np.random.default_rng(3)
    proven = [check_box(random_axis(rng), 200, rng) for _ in range(16)]
    assert sum(x > 0 for x in proven) >= 10
    assert math.isfinite(max(proven))


@pytest.mark.slow
def test_what_is_too_dear_to_enclose_is_named(tmp_path: Path) -> None:
    """A rotor whose weight adds m / k_s to the stiffness of its bearings: left out of three parameters, and said."""
    spec = malta.read_design("examples/rotor/design/rotor.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    system, own = malta.loop(spec.plant, law).uncertain(("m", "k_s", "k_i"))
    assert system.left_out.startswith("without the slopes")
    assert "nothing holds it at rest within the limit of i_Ay" in system.ends  # limits at rest are in it
    found = malta.robust_margin(system, own, {"m": 0.1})
    assert found.lower is not None
    assert found.reason.startswith(system.left_out)
    with pytest.raises(malta.CheckError, match="no certificate: the margin is without the slopes"):
        malta.proof.write_certificate(tmp_path / "c.json", [(system, own)], {"m": 0.1}, None, found)


@pytest.mark.slow
def test_a_rotor_is_proven_under_its_weight() -> None:
    """One parameter, with the slope m / k_i that its weight makes; the loops of flights agree on either side."""
    spec = malta.read_design("examples/rotor/design/rotor.toml")
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    system, own = malta.loop(spec.plant, law).uncertain(("m",))
    assert system.left_out == ""
    found = malta.robust_margin(system, own, {"m": 0.1})
    assert found.lower is not None
    assert 0.998 * found.upper < found.lower <= found.upper
    assert found.witness is not None
    par: Any = spec.plant.parameters
    for share, stable in ((0.999 * found.lower / found.upper, True), (1.001, False)):
        m = par.m + share * (found.witness["m"] - par.m)
        there = spec.plant.variant(replace(par, m=m))
        assert malta.loop(there, law).stable is stable


def test_a_box_of_commutated_forces_ends_where_the_weight_exceeds_them() -> None:
    """The planar motor: m g B_r0 / B_r is what the law commands, at most the limit of F_z."""
    c = malta.gains.read("design/gains/planar_pid.json")
    planar = malta.plant_of(c.parameters)
    system, _ = machine_system(planar, c, ("m", "B_r"), {})
    box = within_branches(
        box_of(system.names, system.nominal, system.limits, {"m": 0.1, "B_r": 0.1}, {}), system
    )
    par: Any = planar.parameters
    times = planar.actuator.force_limit[[one.name for one in planar.inputs].index("F_z")] / (par.m * par.g)
    assert box.most == pytest.approx((times - 1) / (times + 1) / 0.1, rel=1e-6)
    assert box.ends.startswith("nothing holds it at rest within the limit of F_z (m = ")
