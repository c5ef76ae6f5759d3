"""Loads under which nothing is touched and nothing saturates: of the nonlinear machine, against its flights."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from magnets import MACHINES

import malta
from malta.linear.branches import is_identity_within
from malta.linear.expressions import NotAnalytic
from malta.margins.surroundings import Surroundings, machine_at_rest
from malta.proof.safe_set import signal_norms
from malta.simulation.experiments.witness import settle_feedforward

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.loops.loop import Loop
    from malta.margins.safe_loads import SafeLoad

TS = 2e-4


def loop_of(name: str) -> Loop:
    controller = malta.gains.read(f"design/gains/{name}.json")
    return malta.loop(malta.plant_of(controller.parameters), controller, current_loops="lag")


def flown(
    loop: Loop, load: Callable[[Any], Any], seconds: float, machine: Any = None, start: Any = None
) -> tuple[Any, Any, Any]:
    """Largest deviation of each output, share of each limit and of the clearances, in a flight."""
    plant = machine or loop.plant
    y0 = np.array(ca.DM(plant.h(ca.DM(loop.model.operating_point.x), 0))).ravel()
    hold = malta.Scenario(
        "load", seconds, malta.references.hold, start or {}, disturbance=load, noise=1.0, fidelity="force"
    )
    # From rest: the law's sums of errors hold the nominal machine.
    settled = settle_feedforward(loop.controller, loop.plant, loop.model.operating_point.x)
    run = malta.simulate(plant, settled, hold)
    forces = np.abs(run.v).max(axis=0) / loop.controller.limits.force
    return np.abs(run.p - y0).max(axis=0), forces, run.contact.max(initial=0.0)


def adversaries(loop: Loop, load: str, size: float) -> list[tuple[Callable[[Any], Any], float]]:
    """The worst loads of the linear loop for each output and command, and four that switch at random."""
    signals = [s.name for s in (*loop.plant.outputs, *loop.plant.inputs)]
    worst = [malta.worst_waveform(loop, load, name, size) for name in signals]
    found: list[Any] = [(one.load, min(one.peak_time + 0.02, 1.0)) for one in worst if len(one.w)]
    shares = worst[0].shares
    for seed in range(4):
        rng = np.random.default_rng(seed)
        ends = np.cumsum(rng.exponential(10.0 ** rng.uniform(-3, -1), 400))
        found.append(
            (
                lambda t, ends=ends: (
                    (size * np.where(np.searchsorted(ends, t) % 2, -1.0, 1.0))[:, None] * shares
                ),
                0.3,
            )
        )
    return found


def require_within(loop: Loop, found: SafeLoad, load: str, machine: Any = None, start: Any = None) -> Any:
    """The largest share of each bound that adversaries reach."""
    assert found.limit is not None
    outputs = np.array([x for x, _ in found.outputs.values()])
    reached = np.zeros(len(outputs))
    for adversary, seconds in adversaries(loop, load, found.limit):
        moved, forces, touched = flown(loop, adversary, seconds, machine, start)
        assert (moved <= outputs).all()
        assert (forces <= list(found.forces.values())).all()
        assert touched <= max(found.used.values(), default=0.0)
        reached = np.maximum(reached, moved / np.maximum(outputs, 1e-30))
    return reached


@pytest.mark.parametrize(
    ("name", "load"),
    [
        ("tubular_pid", "F_x"),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in (("robust", "F_x"), ("structured", "T_y"))),
    ],
)
def test_adversaries_reach_the_bound_and_never_exceed_it(name: str, load: str) -> None:
    loop = loop_of(name)
    found = malta.safe_load(loop, load)
    assert "may reach its limit" in found.ends
    assert found.beyond < 1.003 * found.limit  # type: ignore[operator]
    assert require_within(loop, found, load).max() > 0.95


@pytest.mark.slow
def test_where_touching_ends_it_a_load_of_three_percent_more_touches() -> None:
    loop = loop_of("calibrated")
    found = malta.safe_load(loop, "F_x")
    assert "touchdown at sensor plane" in found.ends
    most = max(
        flown(loop, load, seconds)[2] for load, seconds in adversaries(loop, "F_x", 1.03 * found.beyond)
    )
    assert most >= 1


def test_a_linear_machine_has_the_norm_of_its_loop() -> None:
    """Nothing is added to the linear model: the bound is the l1 norm of worst_waveform, and saturation ends it."""
    cart = malta.linear_machine(
        [[0, 1], [900.0, -0.1]], [[0], [2]], [[1, 0]], states=["z [m]", "v [m/s]"], limit=5.0, dead_time=1e-4
    )
    law = malta.lqg(
        malta.linearize(cart, cart.at()),
        malta.synthesis.weights([1e6, 1e2], [1], [1], [1e-12], q_i=[1e8]),
        TS,
    )
    loop = malta.loop(cart, law)
    found = malta.safe_load(loop, "d_u1")
    by_norm = {name: malta.worst_waveform(loop, "d_u1", name, found.limit or 0.0) for name in ("y1", "u1")}
    bound = found.outputs["y1"][0]
    assert by_norm["y1"].value <= bound <= 1.01 * (by_norm["y1"].value + by_norm["y1"].error)
    assert by_norm["u1"].value == pytest.approx(5.0, rel=0.03)
    assert found.forces["u1"] == pytest.approx(1.0, rel=0.02)


@pytest.mark.parametrize("kind", list(MACHINES))
@pytest.mark.parametrize(
    ("lag", "dead_time"), [(0.0, 0.0), pytest.param(1e-4, 2.6e-4, marks=pytest.mark.slow)]
)
def test_machines_before_magnets(kind: str, lag: float, dead_time: float) -> None:
    """Forces that are no inverse of the currents, weights, late sensors and late forces, off the middle."""
    make, par, place = MACHINES[kind]
    machine = make(replace(par, lag=lag, dead_time=dead_time))
    n = len(machine.states) // 2
    weights = malta.synthesis.weights([1e8] * n + [1e3] * n, [1] * n, [1e-2] * n, [1e-12] * n, q_i=[1e11] * n)
    law = malta.lqg(malta.linearize(machine, machine.at(**place)), weights, TS)
    at: Any = place
    loop = malta.loop(machine, law, **at)
    found = malta.safe_load(loop, "w")
    assert found.limit is not None, found.ends
    assert found.limit > 0.01
    assert require_within(loop, found, "w", start=place).max() > 0.3


@pytest.mark.slow
def test_parameters_anywhere_in_a_box_and_on_their_way() -> None:
    loop, box = loop_of("robust"), dict.fromkeys(("m", "K_A", "K_B", "K_D"), 0.05)
    found = malta.safe_load(loop, "F_x", box)
    assert 8 < (found.limit or 0.0) < (malta.safe_load(loop, "F_x").limit or 0.0)
    par = loop.plant.parameters
    for signs in ((1, 1, -1, 1), (-1, 1, -1, -1), (1, -1, 1, 1)):
        corner = {name: (1 + 0.05 * sign) * getattr(par, name) for name, sign in zip(box, signs, strict=True)}
        machine = malta.plant_of(replace(par, **corner))
        require_within(loop, found, "F_x", machine)
    wide = malta.safe_load(loop, "F_x", dict.fromkeys(box, 0.5))
    assert wide.limit is None
    assert wide.ends


def test_what_is_taken_as_known_cannot_be_in_the_box() -> None:
    loop = loop_of("robust")
    cases = {
        "w_cc": "the current loops' lag",
        "I_max": "the limits of currents",
        "R": "acts on none of the functions",
    }
    for name, says in cases.items():
        found = malta.safe_load(loop, "F_x", {name: 0.1})
        assert (found.limit, says in found.ends) == (None, True), found.ends


def test_more_noise_leaves_less() -> None:
    loop = loop_of("robust")
    limits = [malta.safe_load(loop, "F_x", noise=noise).limit or 0.0 for noise in (0.0, 6.0, 20.0)]
    assert limits[0] > limits[1] > limits[2] > 0
    assert (malta.safe_load(loop, "F_x", aside={"gamma_dot": 500.0}).limit or 0.0) < limits[1]


@pytest.mark.slow
def test_a_planar_motor_whose_law_brakes() -> None:
    loop = loop_of("planar")
    found = malta.safe_load(loop, "F_z")
    assert require_within(loop, found, "F_z").max() > 0.85


def test_a_load_at_a_point_is_the_sum_of_its_shares() -> None:
    loop = loop_of("structured")
    pushed = malta.safe_load(loop, {"F_x": 1.0, "T_y": 0.045})
    plain, turned = (malta.safe_load(loop, name).limit or 0.0 for name in ("F_x", "T_y"))
    assert 1 / (pushed.limit or 1.0) <= 1.01 * (1 / plain + 0.045 / turned)


def test_bad_input_is_one_sentence() -> None:
    loop = loop_of("robust")
    cases: list[tuple[Any, dict[str, Any], str]] = [
        ("F_q", {}, "safe_load: disturbance"),
        ("F_x", {"noise": -1.0}, "safe_load: noise: found -1"),
        ("F_x", {"aside": -1.0}, "safe_load: aside"),
        ("F_x", {"aside": {"gamma": 1.0}}, "gamma"),
        ("F_x", {"ranges": {"q": 0.1}}, "q: found an unknown parameter"),
        ("F_x", {"ranges": {"z": (0.0, 1e-3)}}, "z: found the stroke"),
        ("F_x", {"ranges": 0.1}, "ranges: found 0.1, expected values by name"),
    ]
    for load, options, says in cases:
        with pytest.raises(malta.InputError, match=says):
            malta.safe_load(loop, load, **options)
    with pytest.raises(malta.InputError, match="a Loop, from"):
        malta.safe_load(loop.plant, "F_x")  # type: ignore[arg-type]
    assert "none of the controlled states" in malta.safe_load(loop, "T_z").ends


def test_an_unstable_loop_bears_nothing() -> None:
    robust = loop_of("robust")
    found = malta.safe_load(malta.loop(robust.plant, robust.controller, parameters={"K_A": 3e5}), "F_x")
    assert found.ends == "the loop is unstable"
    assert (found.limit, str(found).startswith("Nothing is proven of any F_x")) == (None, True)


def test_limits_that_scale_are_the_currents_themselves_below_them() -> None:
    i = ca.SX.sym("i", 3)
    scale = ca.Function("limited", [i], [i / ca.fmax(1, ca.mmax(ca.fabs(i)) / 4)])
    clip = ca.Function("limited", [i], [ca.fmax(ca.fmin(i, 4), -4)])
    for limited in (scale, clip):
        assert is_identity_within(limited, [(-3.0, 3.9)] * 3)
        assert not is_identity_within(limited, [(-3.0, 3.9), (-4.1, 1.0), (0.0, 1.0)])
    turned = ca.Function("limited", [i], [i[[1, 0, 2]]])
    assert not is_identity_within(turned, [(-1.0, 1.0)] * 3)
    with pytest.raises(NotAnalytic):
        is_identity_within(ca.Function("limited", [i], [ca.floor(i)]), [(-1.0, 1.0)] * 3)


def test_norms_are_those_of_the_loop_that_runs() -> None:
    """Of readings' errors by the sampled loop's own matrices; of states between samples by places within one."""
    loop = loop_of("structured")
    machine, s = machine_at_rest(loop), loop.sampled
    norms = signal_norms(machine.under(np.eye(6, 1)))
    c, n, p = s.control, norms.rates.shape[1], len(s.Cd)
    rows, state = np.hstack([c.D_y @ s.Cd, c.C]), np.vstack([s.Bd @ c.D_y, c.B_y])
    found = np.abs(c.D_y)
    for _ in range(20_000):
        found, state = found + np.abs(rows @ state), s.closed @ state
    of_commands = norms.readings[n + p : n + p + len(c.C)]
    assert (of_commands >= found * (1 - 1e-6)).all()
    assert (of_commands <= 1.01 * found + 1e-9 * found.max()).all()
    slow = loop_of("halbach")
    between = signal_norms(machine_at_rest(slow).under(np.ones((1, 1)))).load
    moved = malta.worst_waveform(slow, "F_x", "x", 1.0)
    assert (
        moved.value <= between[2] <= 1.1 * moved.value
    )  # a reading of 55 ms, whose load is bounded in parts
    assert between[0] > 1.2 * between[2]  # of the state, at any time


def test_second_slopes_grow_with_the_set() -> None:
    make, par, place = MACHINES["slope"]
    machine = make(par)
    weights = malta.synthesis.weights([1e8, 1e3], [1], [1e-2], [1e-12], q_i=[1e11])
    at: Any = place
    loop = malta.loop(machine, malta.lqg(malta.linearize(machine, machine.at(**at)), weights, TS), **at)
    rest = machine_at_rest(loop)
    near = Surroundings(rest, np.ones((1, 1)), signal_norms(rest.under(np.ones((1, 1)))), 6.0, np.zeros(0))
    signals = len(near.norms.load)
    small, large = (near.remainders(0.1, np.full(signals, 1e-6 * size)).rates[1] for size in (1, 100))
    assert large > 1.05e4 * small  # of second order at least


def test_limits_of_forces_end_it_before_those_of_currents() -> None:
    loop = loop_of("structured")
    limits = replace(loop.controller.limits, force=0.5 * loop.controller.limits.force)
    weak = malta.loop(loop.plant, replace(loop.controller, limits=limits))
    found, whole = malta.safe_load(weak, "F_x"), malta.safe_load(loop, "F_x")
    assert found.ends == whole.ends == "fx_B2 may reach its limit"
    assert (found.limit or 0.0) < 0.5 * (whole.limit or 0.0)


def test_a_weight_that_may_change_is_a_load() -> None:
    """Half of g more or less is a constant load of m g / 2 beside the one that is asked for."""
    loop = loop_of("structured")
    par: Any = loop.plant.parameters
    limits = [malta.safe_load(loop, "F_y", box).limit or 0.0 for box in (None, {"g": 0.5})]
    assert limits[0] - limits[1] == pytest.approx(0.5 * par.m * par.g, rel=0.03)


def test_the_readmes_load_is_proven() -> None:
    text = Path("README.md").read_text(encoding="utf-8")
    said = re.search(r"any load of up to ([\d.]+) N from the side", text)
    assert said is not None
    limit = malta.safe_load(loop_of("robust"), ("F_x", "F_y")).limit or 0.0  # in any direction
    assert float(said[1]) <= limit < 1.02 * float(said[1])


def test_loads_of_their_own_waveforms_add() -> None:
    """Two on one axis are one of twice the size; across each other they are no more than both."""
    loop = loop_of("structured")
    alone = malta.safe_load(loop, "F_x").limit or 0.0
    twice = malta.safe_load(loop, ["F_x", {"F_x": 1.0}])
    assert twice.limit == pytest.approx(alone / 2, rel=0.01)
    assert twice.disturbance == "F_x and 1 F_x"
    across = malta.safe_load(loop, ("F_x", "F_y"))
    assert alone / 2 < (across.limit or 0.0) <= alone
    with pytest.raises(malta.InputError, match="found no load"):
        malta.safe_load(loop, [])


@pytest.mark.parametrize("name", ["structured", "robust"])
def test_starts_within_what_is_proven_come_back(name: str) -> None:
    loop, box = loop_of(name), {"x": 2e-5, "x_dot": 1e-3, "beta": 1e-4}
    found = malta.safe_start(loop, box)
    assert 0.2 < (found.limit or 0.0) < found.beyond
    assert "may reach its limit" in found.ends
    outputs, most = np.array([x for x, _ in found.outputs.values()]), 0.0
    for signs in itertools.product((-1.0, 0.2, 1.0), repeat=3):
        start = {
            key: sign * (found.limit or 0.0) * x for sign, (key, x) in zip(signs, box.items(), strict=True)
        }
        moved, forces, _ = flown(loop, lambda t: np.zeros((len(t), 6)), 0.2, None, start)
        assert (moved <= outputs).all()
        assert (forces <= list(found.forces.values())).all()
        most = max(most, float(forces.max()))
    assert most > 0.5  # of a limit: noise and all signs at once leave this


def test_a_start_that_is_none_is_refused() -> None:
    loop = loop_of("robust")
    for start, says in (
        ({}, "distances from rest"),
        ({"q": 1.0}, "q"),
        ({"x": -1.0}, "found -1"),
        ({"x": 0.0}, "above 0"),
    ):
        with pytest.raises(malta.InputError, match=says):
            malta.safe_start(loop, start)


def test_errors_name_the_function_that_was_called() -> None:
    with pytest.raises(malta.InputError, match="safe_start: noise: found -1"):
        malta.safe_start(loop_of("robust"), {"x": 1e-5}, noise=-1.0)
