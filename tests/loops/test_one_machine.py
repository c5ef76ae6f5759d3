"""One machine: the loop that is designed, proven and judged is the derivative of the loop that is simulated.

d(state after a control period) / d(state)    at rest, default fidelity, by CasADi: tests/flight.py
machine_loop                                  windings, PI controllers, delay, hold, loads, sensors: exactly sampled
machine_system                                the same with parameters by name: what margins are proven of
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from flight import default_of, derivative_at_rest, poles
from magnets import MACHINES

import malta
from malta import gains
from malta.linear.closed_loops import closed_loop, instability
from malta.loops.parametric_loops import LOADS_LEFT_OUT, machine_system
from malta.loops.sampled_loops import loaded_model, machine_loop
from malta.margins.travel import place_margin
from malta.model.parameters import twins_of
from malta.simulation.experiments.witness import settle_feedforward

if TYPE_CHECKING:
    from malta.arrays import ComplexArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

TUBULAR = ("table2", "calibrated", "robust", "robust_observer", "tubular_pid")
OTHERS = ("halbach", "halbach_late", "halbach_pid", "planar", "planar_pid")
BOXES = {
    "tubular": ("m", "K_A", "K_B", "K_D"),
    "halbach": ("m", "A", "b"),
    "planar": ("m", "I_x", "I_z", "B_r"),
}
SAME = 1e-6  # of a pole, or of 1 rad/s


def shipped(name: str) -> tuple[Plant, Controller]:
    c = gains.read(f"design/gains/{name}.json")
    return malta.plant_of(c.parameters), c


def varied(plant: Plant, names: tuple[str, ...], values: Any) -> Plant:
    """The machine with other parameters; twins have one value."""
    own = dict(zip(names, np.asarray(values).tolist(), strict=True))
    own |= {name: own[twin] for name, twin in twins_of(plant.parameters).items() if twin in own}
    return malta.plant_of(replace(plant.parameters, **own))


def stiff(plant: Plant) -> Plant:
    """The machine at a link whose voltage does not answer to what it carries."""
    if not hasattr(plant.parameters, "C_dc"):
        return plant
    return malta.plant_of(replace(plant.parameters, C_dc=1e6 * plant.parameters.C_dc))


def along(plant: Plant, share: float) -> dict[str, float]:
    return {plant.stroke.name: share * plant.stroke.travel} if plant.has_stroke else {}


def distance(ours: ComplexArray, flown: ComplexArray) -> float:
    """The largest distance of one of our poles from the nearest pole that flies, as a share of it or of 1 rad/s."""
    return max(float(np.abs(flown - s).min() / max(1.0, abs(s))) for s in ours)


def check_machine_loop(plant: Plant, c: Controller, share: float) -> None:
    at = along(plant, share)
    ours = machine_loop(loaded_model(plant, at.get(plant.stroke.name, 0.0)), c)
    flown = derivative_at_rest(plant, c, plant.at(**at).x)
    assert distance(poles(ours.closed, c.sample_time), poles(flown, c.sample_time)) < SAME


def check_proven_loop(plant: Plant, c: Controller, names: tuple[str, ...], values: Any, share: float) -> None:
    """The loop of a proof at these parameters and the flight of that machine, both under their loads.

    The flight has nothing of what the loop leaves out: the sag of the link, which docs/howto/margin.md names, and the
    loads where the system says that it is without their slopes.
    """
    at = along(plant, share)
    system, law = machine_system(plant, c, names, at)
    (ours,) = closed_loop(system, law, np.array(values))
    there = stiff(varied(plant, names, values))
    if system.left_out:
        assert system.left_out == LOADS_LEFT_OUT
        there = there.variant(replace(there.parameters, g=0.0))
    flown = derivative_at_rest(there, c, there.at(**at).x)
    T = c.sample_time
    assert distance(poles(np.eye(len(ours)) + T * ours, T), poles(flown, T)) < SAME


@pytest.mark.slow
@pytest.mark.parametrize("name", TUBULAR)
def test_the_loop_under_load_is_the_derivative_of_the_flight(name: str) -> None:
    plant, c = shipped(name)
    for share in (0.0, 0.37):
        check_machine_loop(plant, c, share)


@pytest.mark.parametrize("name", [n for n in OTHERS if "planar" not in n])
def test_the_loop_of_lagging_currents_is_the_derivative_of_the_flight(name: str) -> None:
    check_machine_loop(*shipped(name), 0.37)


@pytest.mark.slow
@pytest.mark.parametrize("name", TUBULAR)
def test_the_proven_loop_is_the_derivative_of_the_flight(name: str) -> None:
    plant, c = shipped(name)
    names = BOXES[plant.name]
    nominal = np.array([getattr(plant.parameters, n) for n in names])
    check_proven_loop(plant, c, names, nominal, 0.0)
    check_proven_loop(plant, c, names, nominal * [0.85, 1.15, 0.9, 1.1], 0.61)


@pytest.mark.slow_for("rotor-at2")
@pytest.mark.parametrize(("file", "at"), [("ball", {"q": 0.8e-3}), ("ball", {}), ("rotor", {})])
def test_the_loops_of_the_examples_are_the_derivatives_of_their_flights(
    file: str, at: dict[str, float]
) -> None:
    """At nominal parameters under load, and the loop that is proven at parameters of the box."""
    spec = malta.read_design(f"examples/{file}/design/{file}.toml")
    c = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at(**at)))
    ours = machine_loop(loaded_model(spec.plant, 0.0, tuple(at.items())), c)
    flown = derivative_at_rest(spec.plant, c, spec.plant.at(**at).x)
    assert distance(poles(ours.closed, c.sample_time), poles(flown, c.sample_time)) < SAME
    if at:
        return
    names, rng = tuple(spec.uncertainty), np.random.default_rng(5)
    nominal = np.array([getattr(spec.plant.parameters, n) for n in names])
    for share in rng.uniform(-1, 1, (3, len(names))):
        check_proven_loop(spec.plant, c, names, nominal * (1 + 0.2 * share), 0.0)


def bench_loop(
    name: str, delay: float, lag: float, wrong: float
) -> tuple[Plant, Controller, dict[str, float]]:
    """A bench off its middle and an LQG that believes in other magnets: C times `wrong`."""
    make, par, at = MACHINES[name]
    Ts = 2e-4
    par = replace(
        par, kind="three coils" if name == "three coils" else par.kind, lag=lag, dead_time=(delay + 0.5) * Ts
    )
    believed = make(replace(par, C=par.C * wrong, g0=par.g0 * (2 - wrong)))
    p = len(believed.outputs)
    weights = malta.synthesis.weights(
        [1e8] * p + [1e4] * p, [1.0] * p, [1e-2] * p, [1e-12] * p, q_i=[1e9 * (lag == 0)] * p
    )
    return make(par), malta.lqg(malta.linearize(believed, believed.at(**at)), weights, Ts, delay=delay), at


@pytest.mark.slow_for("three coils-2-0.0-1.15")
@pytest.mark.parametrize(
    ("delay", "lag", "wrong"),
    [(0, 0.0, 1.0), (1, 2e-4, 1.0), (2, 0.0, 1.15), (1.3, 1e-4, 0.9), (0.999, 0.0, 0.9)],
)
@pytest.mark.parametrize("name", MACHINES)
def test_the_loop_of_any_magnet_is_the_derivative_of_its_flight(
    name: str, delay: float, lag: float, wrong: float
) -> None:
    """Nonlinear forces, currents that are no inverse, coils to spare, sensors with a lag, a controller that errs."""
    plant, c, at = bench_loop(name, delay, lag, wrong)
    ours = machine_loop(loaded_model(plant, 0.0, tuple(at.items())), c)
    flown = derivative_at_rest(plant, c, plant.at(**at).x)
    if lag:  # the simulated lag is of second order in its step
        flown = (4 * derivative_at_rest(plant, c, plant.at(**at).x, 80) - flown) / 3
    assert distance(poles(ours.closed, c.sample_time), poles(flown, c.sample_time)) < SAME


@pytest.mark.parametrize("name", MACHINES)
def test_the_proven_loop_of_any_magnet_is_the_derivative_of_its_flight(name: str) -> None:
    """In its parameters, under spring and weight."""
    plant, c, at = bench_loop(name, 1, 0.0, 1.1)
    par: Any = plant.parameters
    names, nominal = ("m", "C", "g0"), np.array([par.m, par.C, par.g0])
    system, law = machine_system(plant, c, names, at)
    for share in np.random.default_rng(11).uniform(-1, 1, (5, 3)):
        values = nominal * (1 + 0.2 * share)
        (ours,) = closed_loop(system, law, values[None])
        there = varied(plant, names, values)
        flown = derivative_at_rest(there, c, there.at(**at).x)
        T = c.sample_time
        assert distance(poles(np.eye(len(ours)) + T * ours, T), poles(flown, T)) < SAME


@pytest.mark.slow
def test_one_loop_answers_all_questions() -> None:
    """Machine x law x operating point x parameters: the same matrix, poles, margins and curves by every way."""
    plant, c = shipped("calibrated")
    heavy = varied(plant, ("m",), [0.6])
    one = malta.loop(plant, c, parameters={"m": 0.6}, z=5e-3)
    np.testing.assert_array_equal(one.matrix, malta.loop(heavy, c, z=5e-3).matrix)
    assert malta.loop(plant, c, z=5e-3) is malta.loop(plant, c, z=5e-3)
    assert one.stable
    assert one.left_out == ""
    curves = malta.loops.loop_curves(one)
    assert distance(one.poles, curves.poles["closed_loop"]) < 1e-9
    w = np.array([10.0, 300.0, 3000.0])
    responses = malta.loops.loop_curves(one, w=w).responses
    np.testing.assert_allclose(one.loop_gain(w), responses.L, rtol=0, atol=1e-7 * np.abs(responses.L).max())
    np.testing.assert_allclose(one.sensitivity(w), responses.S, rtol=0, atol=1e-7)
    np.testing.assert_allclose(one.sampled.sensitivity(w), responses.S, rtol=0, atol=1e-7)
    box = {"K_A": 0.2, "K_B": 0.2}
    ours, there = malta.robust_margin(one, box), place_margin(heavy, c, box, 5e-3)
    assert ours.upper == pytest.approx(there.upper, rel=1e-9)
    assert ours.lower == pytest.approx(there.lower, rel=2e-3)
    moved = one.sampled.answer().largest[0, 0]
    for found in (malta.loops.recovery(one), malta.loops.recovery(heavy, c, position=5e-3)):
        assert found[0].outputs[0].largest == moved
    systems = malta.loops.loop_systems(one)
    assert distance(one.poles, np.log(systems.S.poles()) * 20e3) < 1e-6
    with pytest.raises(malta.InputError, match="found one beside a Loop"):
        malta.loops.recovery(one, c)


def test_what_a_loop_leaves_out_is_said() -> None:
    assert "PI" in malta.loop(*shipped("robust"), current_loops="lag").left_out
    assert "electronics" in malta.loop(*shipped("halbach")).left_out
    assert "(braking)" in malta.loop(*shipped("planar")).left_out


@pytest.mark.parametrize("name", ["halbach_pid", "planar_pid"])
def test_held_currents_are_no_forces_of_the_classical_figures(name: str) -> None:
    """What hangs on a reading besides the forces belongs to the machine: as in the curves, which are computed alone."""
    one = malta.loop(*shipped(name))
    found, responses = one.classical, malta.loops.loop_curves(one).responses
    for i, sizes in enumerate(found.gang.values()):
        curves = (responses.S[:, i, i], responses.T[:, i, i], responses.SP[:, i], responses.FS[:, :, i])
        assert sizes == pytest.approx([np.abs(curve).max() for curve in curves], rel=2e-2)
    m = responses.S_forces.shape[-1]
    disk = 1 / np.linalg.norm(responses.S_forces - np.eye(m) / 2, 2, axis=(1, 2)).max()
    assert disk <= 1.001 * found.disks[0].size  # a balanced norm is no larger
    if m == 1:
        assert found.disks[0].size == pytest.approx(disk, rel=1e-3)
    assert found.disks[2].size <= min(one.size for one in found.disks[:2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameters": {"q": 1.0}}, "loop: q: found an unknown parameter"),
        ({"parameters": {"m": -1.0}}, "m: found -1.0 kg"),
        ({"w": 1.0}, "w: found an unknown state"),
        ({"z": math.nan}, "z: found nan"),
        ({"current_loops": "p"}, "current_loops: found 'p', expected lag or pi"),
    ],
)
def test_a_loop_that_is_none_is_refused(options: Any, message: str) -> None:
    with pytest.raises(malta.InputError, match=message):
        malta.loop(*shipped("robust"), **options)


def test_a_loop_of_another_machine_is_refused() -> None:
    with pytest.raises(malta.InputError, match="found one of x, expected one of the tubular"):
        malta.loop(shipped("robust")[0], shipped("halbach")[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["robust", "robust_observer", "tubular_pid", "halbach", "halbach_pid", "planar_pid"]
)
def test_witnesses_fly(name: str) -> None:
    """The nonlinear machine under its loads, towards the parameters of its loss: at 0.97 it comes to rest, at 1.03 it
    leaves. Deviations so small that nothing saturates, as long as the linear loop takes to tell."""
    plant, c = shipped(name)
    names = BOXES[plant.name]
    margin = place_margin(plant, c, dict.fromkeys(names, 0.1), 0.0)
    system, law = machine_system(plant, c, names, along(plant, 0.0))
    nominal, small = system.nominal, {"m": 1e-7, "rad": 1e-6}
    start = {s.name: small[s.unit] for s in plant.design_states if s.unit in small}
    ends = []
    for share in (0.97, 1.03):
        values = nominal + share * np.array([margin.moved.get(n, 0.0) for n in names])
        rate = float(instability(system, law, values[None])[0])
        assert np.sign(rate) == np.sign(share - 1)
        there = varied(plant, names, values)
        duration = min(max(12 / abs(rate), 400 * c.sample_time), 20.0)
        hold = malta.Scenario("witness", duration, malta.references.hold, start, fidelity=default_of(plant))
        run = malta.simulate(there, settle_feedforward(c, there, there.at(**along(there, 0.0)).x), hold)
        tenth = len(run.p) // 10
        off = np.abs(run.p - run.reference).max(axis=1)
        ends.append(
            math.inf if not run.verdict.completed else off[-tenth:].max() / off[2 * tenth : 3 * tenth].max()
        )
    assert ends[0] < 0.9
    assert ends[1] > 1.1


@pytest.mark.slow
@pytest.mark.parametrize("name", TUBULAR + OTHERS)
def test_the_derivative_of_the_flight_anywhere_in_box_and_travel(name: str) -> None:
    plant, c = shipped(name)
    names, rng = BOXES[plant.name], np.random.default_rng(7)
    nominal = np.array([getattr(plant.parameters, n) for n in names])
    places = rng.uniform(-1, 1, 1 if plant.name == "planar" else 3)
    for share, spread in zip(places, rng.uniform(-1, 1, (len(places), len(names))), strict=True):
        check_machine_loop(plant, c, share)
        check_proven_loop(plant, c, names, nominal * (1 + 0.2 * spread), share)


@pytest.mark.slow
@pytest.mark.parametrize("place", [-2.2e-3, 0.0, 1.5e-3, 3e-3])
def test_the_loop_of_a_schedule_is_the_derivative_of_the_flight_at_its_reference(place: float) -> None:
    """No slope of a matrix is in it, whatever the sums of errors hold there: the reference chooses the matrices."""
    spec = malta.read_design("examples/magnet/design/scheduled.toml")
    plant = spec.plant
    c = malta.synthesize(spec, malta.linearize(plant, plant.at()))
    at = {"q": place, "i": float(plant.position_of([place])[2])}
    ours = machine_loop(loaded_model(plant, 0.0, tuple(at.items())), c)
    flown = derivative_at_rest(plant, c, plant.at(**at).x)
    assert distance(poles(ours.closed, c.sample_time), poles(flown, c.sample_time)) < SAME
