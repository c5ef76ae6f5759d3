"""The drive around the mover: three fidelities against each other, windings, limits, energy, sensors, faults."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final, Literal

import casadi as ca
import numpy as np
import pytest
from conditions import EPS
from hypothesis import given, settings, strategies as st

import malta
from malta import references
from malta.machines.tubular import drive as windings, plant as tubular
from malta.simulation.engine.engines import engine_of
from malta.simulation.inputs import initial_values, inputs_of
from malta.simulation.layout import FIDELITIES, Fidelity, layout_of
from malta.simulation.period import initial_state
from malta.simulation.references import Motion
from malta.simulation.scenario import Correction, Fault, Scenario, Simulation, setup_of
from malta.simulation.steps import steps_of

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

Ts = 50e-6  # s, of every design here
FORCE_AXES = [1, 2, 4, 7, 8, 10]  # 0q, dd and qd of both modules: what (17) and (18) make forces of
# Equal to the compiled engine (test_engine.py), and no compilation for a single run.
VIRTUAL: Final = "virtual machine"


@pytest.fixture(scope="module")
def calibrated(designs: dict[str, Design]) -> Design:
    return designs["calibrated"]


def _hold(duration: float, at: Mapping[str, float] | None = None, **options: Any) -> Scenario:
    return Scenario("hold", duration, lambda plant: references.hold(plant, **(at or {})), **options)


def _ramp(speed: float, duration: float, **options: Any) -> Scenario:
    """Along the axis at constant speed, through the middle half-way."""

    def reference(_: Plant) -> references.Reference:
        def at(t: FloatArray) -> Motion:
            p, dp = np.zeros((len(t), 5)), np.zeros((len(t), 5))
            p[:, 4], dp[:, 4] = speed * (t - duration / 2), speed
            return Motion(p, dp, np.zeros_like(p))

        return at

    return Scenario("ramp", duration, reference, **options)


def _short_stroke(**options: Any) -> Scenario:
    """Hard on the drive: it starts at 5 cm/s and asks for 9 A, at 45 V nearly half the link."""
    return Scenario.stroke(5e-3, rise=6e-3, duration=0.04, **options)


def _close(found: Any, expected: Any, rtol: float = 0.0, atol: float = 0.0) -> None:
    np.testing.assert_allclose(found, expected, rtol=rtol, atol=atol)


def _with(design: Design, **parameters: float) -> Plant:
    return malta.plant_of(replace(design.spec.parameters, **parameters))


def _under_way(run: malta.simulation.Trajectory, series: FloatArray) -> FloatArray:
    """What the half-bridges do at each sample: what was commanded one sample of computation before."""
    assert run.plant.actuator.delay(Ts) == 1
    return np.vstack([series[:1], series[:-1]])


def _step_by_step(plant: Plant, c: Controller, scenario: Scenario) -> dict[str, FloatArray]:
    """The state of machine and controller before every sample."""
    setup = setup_of(plant, c, scenario)
    simulation = Simulation(plant, c, scenario, setup)
    t, _, given_ = inputs_of(simulation)
    start = [ca.DM(a) for a in initial_values(simulation, given_[0])]
    state = np.array(ca.evalf(initial_state(plant, c, setup, *start))).ravel()
    engine = engine_of(plant, c, setup, steps_of(plant, c, scenario))
    states = []
    for k in range(len(t)):
        states.append(state)
        state, _ = engine.run(
            k, state, given_[k : k + 1], np.zeros((1, len(plant.outputs))), np.zeros((0, 0))
        )
    sizes = layout_of(plant, c, setup)
    names = {**sizes.machine, **sizes.controller}
    columns = np.split(np.array(states), np.cumsum([*names.values()])[:-1], axis=1)
    return dict(zip(names, columns, strict=True))


# The fidelities


def test_axes_and_phases_are_the_same_drive(calibrated: Design) -> None:
    """A 10 mm stroke in dq and on 18 windings: radially within 15 nm, axially within 0.15 um of 10 mm, the currents
    that make forces within 0.5 mA.

    They differ because phase voltages stand still for a sample while the axes turn on: what was asked for in q lies 1.5
    samples behind, up to 10 mrad or 0.2 V in d, where the loop leaves some 20 mA that make no force.
    """
    dq, phase = (
        malta.simulate(calibrated.plant, calibrated.controller, Scenario.stroke(10e-3, fidelity=fidelity))
        for fidelity in ("dq", "phase")
    )
    apart = np.abs(dq.p - phase.p).max(axis=0)
    assert apart[:4].max() < 15e-9
    assert apart[4] < 0.15e-6
    currents = np.abs(dq.i - phase.i).max(axis=0)
    assert currents[FORCE_AXES].max() < 0.5e-3
    behind = math.pi / 15e-3 * np.abs(phase.x[:, 8]).max() * 1.5 * Ts
    assert behind == pytest.approx(10.6e-3, rel=0.05)
    assert 10e-3 < currents[[0, 6]].max() < behind * np.abs(phase.u[:, 1]).max() / calibrated.plant.actuator.R
    assert np.abs(dq.link - phase.link).max() < 20e-6
    assert np.abs(phase.i[:, FORCE_AXES]).max() > 2


def test_forces_are_the_same_at_rest_and_lag_alike_in_motion(calibrated: Design) -> None:
    """A current loop is a lag of 3000 rad/s to the position loop: at rest to a microvolt of drive force; in a stroke
    the thrust differs by up to a tenth of its largest value, the path by 2 % of its length."""
    rest, stroke = (
        [
            malta.simulate(calibrated.plant, calibrated.controller, replace(scenario, fidelity=fidelity))
            for fidelity in ("force", "dq")
        ]
        for scenario in (_hold(0.02, {"z": 3e-3}), Scenario.stroke(10e-3))
    )
    assert np.abs(rest[0].force - rest[1].force).max() < 1e-6
    assert np.abs(rest[0].x - rest[1].x)[:, :3].max() < 1e-12
    thrust, path = (np.abs(getattr(stroke[0], s) - getattr(stroke[1], s))[:, 4] for s in ("force", "p"))
    assert 0.02 < thrust.max() / np.abs(stroke[0].force[:, 4]).max() < 0.12
    assert path.max() / 10e-3 < 0.02


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_at_rest_currents_are_the_static_forces_over_their_constants(
    calibrated: Design, par: tubular.Parameters, fidelity: Fidelity
) -> None:
    """z = 3 mm: cogging on 0q of both modules, the weight on qd by the lever rule, nothing else."""
    z = 3e-3
    run = malta.simulate(calibrated.plant, calibrated.controller, _hold(0.01, {"z": z}, fidelity=fidelity))
    drive = -par.F_c * math.sin(2 * math.pi * z / par.L_p) / (2 * par.K_D)
    weight = par.m * par.g / (2 * par.l_B) / par.K_B
    lower, upper = weight * (par.l_B - z), weight * (par.l_B + z)
    expected = [0, drive, 0, 0, lower, 0, 0, drive, 0, 0, upper, 0]
    _close(run.i, np.tile(expected, (len(run.t), 1)), atol=1e-6)
    _close(run.u, par.R * run.i, atol=3e-6)
    assert run.copper_loss == pytest.approx(
        par.R * (2 * 4.5 * drive**2 + 2.25 * (lower**2 + upper**2)), rel=1e-5
    )


@pytest.mark.parametrize("delay", [0, 1, 3])
def test_axes_are_sampled_windings_under_a_sampled_law(
    calibrated: Design, par: tubular.Parameters, delay: int
) -> None:
    """A step of 5 um in x1, by hand: u = Kp e + integral (backward Euler) + K_ind z', and windings that take it up
    `delay` samples later, held, as exp(-R t / L) has it."""
    c = calibrated.controller
    run = malta.simulate(
        calibrated.plant,
        c,
        _hold(6e-3, {"x1": 5e-6}, start={"x": 0.0, "beta": 0.0}, delay=delay),
        engine=VIRTUAL,
    )
    decay = math.exp(-par.R / par.L * Ts)
    k = 2  # dd of module 1
    wanted = run.v[:, 0] / par.K_B
    error = wanted - run.i[:, k]
    assert c.current_loop is not None
    integral = c.current_loop.Ki * Ts * np.cumsum(error)
    _close(run.u[:, k], c.current_loop.Kp * error + integral, atol=1e-9)
    acting = np.concatenate([np.zeros(delay), run.u[: len(run.u) - delay, k]])
    expected = decay * run.i[:-1, k] + (1 - decay) / par.R * acting[:-1]
    _close(run.i[1:, k], expected, atol=2e-6)  # the link sags by microvolts meanwhile
    _close(run.force[:, 0], par.K_B * run.i[:, k], atol=1e-12)
    assert np.abs(run.i[:, k]).max() > 0.01
    assert run.verdict.completed


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_the_feedforward_takes_the_induced_voltage_off_the_current_loop(
    calibrated: Design, fidelity: Fidelity
) -> None:
    """At 0.5 m/s 0.87 V are induced. Known to the controller, they move the thrust's current by less than 1 mA; on a
    machine that induces twice as much the loop has to find the rest: 68 mA, for a few milliseconds."""
    moved = []
    for K_ind in (1.74, 2 * 1.74):
        plant = _with(calibrated, K_ind=K_ind)
        run = malta.simulate(plant, calibrated.controller, _ramp(0.5, 0.02, fidelity=fidelity))
        behind = run.i[2:, 1] - run.v[:-2, 4] / 10.4  # what was wanted when the current could last follow
        moved.append(np.abs(behind).max())
        assert np.abs(behind[-20:]).max() < 1e-3
        assert run.u[-1, 1] == pytest.approx(
            0.5 * K_ind + 2.2 * run.i[-1, 1], abs=0.02
        )  # L i' of the cogging
    assert moved[0] < 1e-3
    assert moved[1] == pytest.approx(68e-3, rel=0.02)


# Limits


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_half_the_link_is_all_there_is_and_the_drive_lives_with_it(
    calibrated: Design, fidelity: Fidelity
) -> None:
    """12 V instead of 45 V: limited for an eighth of the stroke, no phase beyond V/2, and it still arrives."""
    weak = _with(calibrated, V_dc=12.0)
    scenario = replace(_short_stroke(fidelity=fidelity), duration=0.08)
    run = malta.simulate(weak, calibrated.controller, scenario)
    if fidelity == "dq":
        assert run.u.shape == (len(run.t), 12)
        theta = np.linspace(0, 2 * math.pi, 25)
        T = np.vstack([np.array(ca.DM(windings.to_phases(a))) for a in theta])
        largest = np.abs(run.u[:, :6] @ T.T).max(axis=1)
        assert np.abs(largest / run.link[:, 0]).max() <= 0.5 + 1e-9
    else:
        largest = np.abs(run.duty - 0.5).max(axis=1) * run.link[:, 0]
        assert largest.max() <= 6.0
        assert 0 <= run.duty.min() < 4 * EPS
        assert 1 - 4 * EPS < run.duty.max() <= 1
    assert largest.max() > 5
    assert run.verdict.completed
    assert np.abs(run.p - run.reference)[:, 4].max() > 1e-3
    assert np.abs(run.p - run.reference)[-1, 4] < 0.25e-3
    assert np.abs(run.p[:, :4]).max() < 0.3e-3


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_integrals_of_limited_axes_wait(calibrated: Design, fidelity: Fidelity) -> None:
    """No integral moves on while its axis is limited, and every one moves when it is free."""
    weak = _with(calibrated, V_dc=12.0)
    states = _step_by_step(weak, calibrated.controller, _short_stroke(fidelity=fidelity))
    limited, moved = states["u_limited"][:-1] > 0, np.diff(states["u_integral"], axis=0)
    assert 0.05 < limited[:, 1].mean() < 0.5
    assert not moved[limited].any()
    assert (moved[:, 1] != 0)[~limited[:, 1]].all()
    # Waiting, it never asks for more than the winding's resistance needs at the limit of what the link can drive.
    assert np.abs(states["u_integral"]).max() < 6
    assert (limited[:, :6] == limited[:, :1]).all()  # a module waits as one
    if fidelity == "dq":
        assert np.abs(states["link"] - 12).max() < 0.3


def test_quantized_sensors_and_real_half_bridges_cost_less_than_a_micrometre(calibrated: Design) -> None:
    run = malta.simulate(
        calibrated.plant,
        calibrated.controller,
        Scenario.stroke(10e-3, fidelity="phase", real_pwm=True, quantize=True),
        engine=VIRTUAL,
    )
    ideal = malta.simulate(calibrated.plant, calibrated.controller, Scenario.stroke(10e-3, fidelity="phase"))
    counted = (run.duty + 2e-3 * np.sign(run.i_phase)) * 1000
    _close(counted, np.round(counted), atol=1e-9)
    _close(run.y[:, :4] * 1e6, np.round(run.y[:, :4] * 1e6), atol=1e-9)
    assert np.abs(run.y - run.p)[:, :4].max() <= 0.5e-6 + 1e-15
    assert np.array_equal(run.y[:, 4], run.p[:, 4])
    assert 1e-8 < np.abs(run.p - ideal.p)[:, :4].max() < 1e-6


def _through_zero_force(plant: Plant) -> references.Reference:
    """Up and down where the attraction carries the weight, so that the bearing forces pass through zero."""
    w, middle, size = 2 * math.pi * 10, 205e-6, 100e-6

    def at(t: FloatArray) -> references.Motion:
        motion = references.Motion(*(np.zeros((len(t), len(plant.outputs))) for _ in range(3)))
        for column in (1, 3):
            motion.p[:, column] = middle + size * np.sin(w * t)
            motion.dp[:, column] = size * w * np.cos(w * t)
            motion.ddp[:, column] = -size * w**2 * np.sin(w * t)
        return motion

    return at


@pytest.mark.parametrize("seed", [0, 1])
def test_axes_that_turn_with_the_force_shake_where_it_passes_zero(calibrated: Design, seed: int) -> None:
    """(18) as printed: near zero force the angle is any angle, and the integrals are turned with it.

    They are small there, so what it costs is some 12 % of the sideways force's noise, not the levitation.
    """
    sideways = {}
    for axes in ("fixed", "turning"):
        scenario = Scenario(
            "through zero",
            0.4,
            _through_zero_force,
            noise=1.0,
            seed=seed,
            feedforward="attraction",
            bearing_axes=axes,
        )
        run = malta.simulate(calibrated.plant, calibrated.controller, scenario)
        assert run.verdict.completed
        assert np.abs(run.force[2000:, [1, 3]]).min() < 0.01
        sideways[axes] = run.force[2000:, [0, 2]].std()
    assert 1.05 < sideways["turning"] / sideways["fixed"] < 1.25


def test_turning_axes_are_the_fixed_ones_while_the_force_keeps_its_direction(calibrated: Design) -> None:
    """(18) as printed: nothing changes under the weight alone; a sideways step turns the axes, and what the integrals
    held for the weight then points elsewhere: y moves, which it does not in fixed axes."""
    runs = {
        (at, axes): malta.simulate(
            calibrated.plant,
            calibrated.controller,
            _hold(0.02, {"x1": at, "x2": at}, start={"x": 0.0}, bearing_axes=axes),
            engine=VIRTUAL,
        )
        for at in (0.0, 20e-6)
        for axes in ("fixed", "turning")
    }
    still, moved = ([runs[at, axes].p for axes in ("fixed", "turning")] for at in (0.0, 20e-6))
    assert np.abs(still[0] - still[1]).max() < 1e-14
    sideways = [np.abs(p[:, [1, 3]]).max() for p in moved]
    assert sideways[0] < 1e-9
    assert sideways[1] > 50 * sideways[0]


# Energy


def _integral(series: FloatArray) -> float:
    return float(np.trapezoid(series, dx=Ts))


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_the_link_balances(calibrated: Design, par: tubular.Parameters, fidelity: Fidelity) -> None:
    """Change of C V^2 / 2 = what the supply gave - what the windings took, to 1e-4 of it, over a stroke; and that is
    heat, magnetic energy and what the induced voltage took (coupling carries no power)."""
    drive = calibrated.plant.drive
    run = malta.simulate(calibrated.plant, calibrated.controller, Scenario.stroke(10e-3, fidelity=fidelity))
    V, weight = run.link[:, 0], np.array(drive.weight)
    if fidelity == "dq":
        share, i, w = _under_way(run, run.u / run.link), run.i, weight
    else:
        share, i, w = _under_way(run, run.duty - 0.5), run.i_phase, np.ones(18)
    # Within a sample the share of the link is held, while link voltage and currents move.
    power = (share[:-1] * (i * V[:, None])[:-1] + share[:-1] * (i * V[:, None])[1:]) @ w / 2
    taken = power.sum() * Ts
    given_ = _integral(V * np.maximum(par.V_dc - V, 0) / par.R_dc)
    stored = par.C_dc / 2 * (V[-1] ** 2 - V[0] ** 2)
    assert stored == pytest.approx(given_ - taken, abs=1e-4 * taken)
    assert taken > 1  # J
    assert V.min() < 44.95
    heat = _integral(run.copper_loss)
    induced = _integral(4.5 * par.K_ind * run.x[:, 8] * (run.i[:, 1] + run.i[:, 7]))
    magnetic = par.L / 2 * (run.i[-1] ** 2 - run.i[0] ** 2) @ weight
    assert heat + induced + magnetic == pytest.approx(taken, rel=1e-4)


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_electrical_power_is_what_goes_into_the_windings(
    calibrated: Design, par: tubular.Parameters, fidelity: Fidelity
) -> None:
    """A step of 20 um at standstill: at every sample the power is that of the voltages that act then, which the
    currents of this sample and the next tell; not of those that are commanded for later."""
    run = malta.simulate(
        calibrated.plant,
        calibrated.controller,
        _hold(5e-3, {"x1": 20e-6}, start={"x": 0.0, "beta": 0.0}, fidelity=fidelity),
    )
    decay = math.exp(-par.R / par.L * Ts)
    acting = par.R * (run.i[1:] - decay * run.i[:-1]) / (1 - decay)
    power = (acting * run.i[:-1]) @ np.array(calibrated.plant.drive.weight)
    assert np.ptp(power) > 0.05  # W, on top of what carries the weight
    _close(run.electrical_power[:-1], power, atol=0.01 * np.ptp(power))


def test_copper_loss_is_the_same_in_phases_axes_and_forces(calibrated: Design) -> None:
    """18 currents that add to zero in six stars are twelve axes: R i^2 over the phases = weighted over the axes."""
    runs = {
        fidelity: malta.simulate(
            calibrated.plant, calibrated.controller, Scenario.stroke(10e-3, fidelity=fidelity)
        )
        for fidelity in FIDELITIES
    }
    phase = runs["phase"]
    weighted = 2.2 * phase.i**2 @ np.array(calibrated.plant.drive.weight)
    _close(phase.copper_loss, weighted, rtol=1e-12)
    assert phase.copper_loss.max() > 100
    assert np.abs(phase.i_phase.reshape(-1, 6, 3).sum(axis=2)).max() < 1e-13
    energy = {fidelity: _integral(run.copper_loss) for fidelity, run in runs.items()}
    assert energy["phase"] == pytest.approx(energy["dq"], rel=1e-4)
    assert energy["force"] == pytest.approx(energy["dq"], rel=0.1)


# Faults


def _held_command(run: malta.simulation.Trajectory, column: int) -> FloatArray:
    """What each force followed from sample to sample, recovered from its exact lag."""
    decay = math.exp(-3000 * Ts)
    return np.asarray((run.force[1:, column] - decay * run.force[:-1, column]) / (1 - decay))


def test_a_missed_step_holds_the_command_before(calibrated: Design) -> None:
    """Steps 40 to 42 miss their time: forces keep following command 39, and the controller stands still."""
    missed = (Fault("missed step", 40 * Ts, 43 * Ts),)
    start = {"x": 0.0, "beta": 0.0}
    scenario = _hold(
        5e-3, {"x1": 20e-6}, start=start, fidelity="force", delay=0, substeps=4
    )  # as with faults
    whole, late = (
        malta.simulate(calibrated.plant, calibrated.controller, replace(scenario, faults=f), engine=VIRTUAL)
        for f in ((), missed)
    )
    followed = _held_command(late, 0)
    assert followed[:40] == pytest.approx(late.v[:40, 0], abs=1e-9)
    assert followed[40:43] == pytest.approx([late.v[39, 0]] * 3, abs=1e-9)
    assert followed[43:] == pytest.approx(late.v[43:-1, 0], abs=1e-9)
    assert np.array_equal(late.x[:41], whole.x[:41])
    assert np.abs(late.x[41:] - whole.x[41:]).max() > 0
    # The prediction of step 40 is still there at 43: xi_hat - L (y - Cd xi_pred) with the same xi_pred.
    c = calibrated.controller
    eye = np.eye(10) - c.L @ c.Cd
    predicted = [np.linalg.solve(eye, late.xi_hat[k] - c.L @ late.y[k]) for k in (40, 41, 42, 43)]
    for later in predicted[1:]:
        _close(later, predicted[0], atol=1e-12)


def test_a_lost_sample_is_the_one_before(calibrated: Design) -> None:
    """All sensors, noise and all, from sample 40 to 44; then they are as they would have been."""
    lost = (Fault("lost sample", 40 * Ts, 45 * Ts),)
    run = malta.simulate(
        calibrated.plant, calibrated.controller, _hold(5e-3, noise=1.0, faults=lost), engine=VIRTUAL
    )
    healthy = _hold(5e-3, noise=1.0, substeps=4)  # as with faults
    whole = malta.simulate(calibrated.plant, calibrated.controller, healthy, engine=VIRTUAL)
    assert np.array_equal(run.y[40:45], np.tile(run.y[39], (5, 1)))
    noise = whole.y - whole.p
    others = [k for k in range(len(run.y)) if not 40 <= k < 45]
    _close((run.y - run.p)[others], noise[others], atol=1e-18)
    assert np.array_equal(run.p[:40], whole.p[:40])


def test_a_sensor_may_stick_be_biased_or_noisy_and_only_that_one(calibrated: Design) -> None:
    """In y exactly, while it lasts: y1 stands still, x2 is 3 um off, x1 has five times its noise."""
    faults = (
        Fault("stuck sensor", 10 * Ts, 20 * Ts, "y1"),
        Fault("biased sensor", 30 * Ts, 40 * Ts, "x2", 3e-6),
        Fault("noisy sensor", 50 * Ts, 60 * Ts, "x1", 5.0),
    )
    run, whole = (
        malta.simulate(
            calibrated.plant, calibrated.controller, _hold(4e-3, noise=1.0, faults=f), engine=VIRTUAL
        )
        for f in (faults, ())
    )
    expected = whole.y - whole.p  # the noise does not depend on the run
    expected[30:40, 2] += 3e-6
    expected[50:60, 0] *= 5
    expected[10:20, 1] = run.y[9, 1] - run.p[10:20, 1]
    _close(run.y - run.p, expected, atol=1e-18)
    assert np.array_equal(run.y[10:20, 1], np.repeat(run.y[9, 1], 10))
    assert run.verdict.completed


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_a_sagging_link_has_so_much_less_voltage(
    calibrated: Design, par: tubular.Parameters, fidelity: Fidelity
) -> None:
    """Half of it is gone from sample 60 on: the command under way drives half of what it should, once; then the duty
    cycles make up for it."""
    z = 3e-3
    sag = (Fault("link sag", 60 * Ts, 120 * Ts, size=0.5),)
    scenario = _hold(8e-3, {"z": z}, faults=sag, fidelity=fidelity)
    run = malta.simulate(calibrated.plant, calibrated.controller, scenario, engine=VIRTUAL)
    decay = math.exp(-par.R / par.L * Ts)
    k, before = 4, run.i[59, 4]
    assert run.i[60, k] == pytest.approx(before, abs=1e-7)
    assert run.i[61, k] == pytest.approx(decay * before + (1 - decay) * before / 2, abs=1e-7)
    link = run.link[:, 0]  # what is left of it
    assert link[59:61] == pytest.approx([45, 22.5], abs=0.01)
    acting = (run.u[:, k] / link)[:-2] * link[1:-1]
    expected = decay * run.i[1:-1, k] + (1 - decay) / par.R * acting
    _close(run.i[2:, k], expected, atol=1e-6)
    assert np.abs(run.i[120:, k] - before).max() > 1e-3  # and once too much when it comes back
    assert np.abs(run.p[:, :4]).max() < 0.2e-6


@pytest.mark.parametrize("at", [0.0, 5e-3])
def test_an_open_phase_carries_nothing_and_its_star_still_adds_to_zero(calibrated: Design, at: float) -> None:
    """Phase i_12_1, open from the start or opened while 20 mA flow in it: within a millisecond 0, the two that are
    left are in series."""
    fault = (Fault("open phase", at, what="i_12_1"),)
    scenario = _hold(0.012, {"z": 2e-3}, fidelity="phase", faults=fault)
    run = malta.simulate(calibrated.plant, calibrated.controller, scenario, engine=VIRTUAL)
    opened = [s.name for s in calibrated.plant.drive.phases].index("i_12_1")
    later = run.t > at + 1e-3
    assert np.abs(run.i_phase[later, opened]).max() < 1e-12
    stars = run.i_phase.reshape(-1, 6, 3).sum(axis=2)
    assert np.abs(stars[later]).max() < 1e-9
    if at:
        assert np.abs(run.i_phase[run.t < at, opened]).max() > 0.01
    assert run.verdict.completed
    assert np.abs(run.p - run.reference).max() < 15e-6
    assert np.abs(run.i_phase[-1]).max() > 0.1


def test_an_open_phase_needs_phases(calibrated: Design) -> None:
    for fidelity in ("force", "dq"):
        scenario = _hold(1e-3, fidelity=fidelity, faults=(Fault("open phase", 0.0, what="i_11_1"),))
        with pytest.raises(
            malta.InputError,
            match=f"faults: found an open phase at fidelity {fidelity}, expected fidelity phase",
        ):
            malta.simulate(calibrated.plant, calibrated.controller, scenario)
    with pytest.raises(malta.InputError, match="real_pwm: found fidelity dq, expected fidelity phase"):
        _hold(1e-3, real_pwm=True)


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no such sensor": ({"faults": (Fault("stuck sensor", 0.0, what="q"),)}, "one of x1 y1 x2 y2 z"),
    "no such phase": (
        {"faults": (Fault("open phase", 0.0, what="q"),), "fidelity": "phase"},
        "one of i_11_1",
    ),
    "no such fault": ({"faults": (Fault("earthquake", 0.0),)}, "earthquake"),  # type: ignore[arg-type]
    "more than the link": ({"faults": (Fault("link sag", 0.0, size=1.0),)}, "a share from 0 to 1"),
    "a fault without a time": ({"faults": (Fault("lost sample", math.nan),)}, "nan"),
    "no such parameter": ({"changes": ((1e-3, {"q": 1.0}),)}, "changes.q: found an unknown parameter"),
    "no machine": ({"changes": ((1e-3, {"m": -1.0}),)}, "m: found -1.0 kg"),
    "a change without a time": ({"changes": ((math.nan, {"m": 0.4}),)}, "nan"),
    "no such error": ({"sensor_errors": {"gain_q": 0.1}}, "gain_q"),
    "an error that is none": ({"sensor_errors": {"gain_x1": math.nan}}, "nan"),
    "an outer loop without a rate": ({"correction": Correction(math.nan, lambda _t, _p: np.zeros(5))}, "nan"),
    "an outer loop of three": ({"correction": Correction(1e-3, lambda _t, _p: np.zeros(3))}, "correction"),
}


@pytest.mark.parametrize(("options", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_simulated_is_refused_in_a_sentence(
    calibrated: Design, options: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(malta.InputError) as caught:
        malta.simulate(calibrated.plant, calibrated.controller, _hold(2e-3, **options), engine=VIRTUAL)
    assert sentence in str(caught.value)


# Touchdown bearings


def _rest(par: Any) -> float:
    """How far below the clearance a mover rests: m g + 2 K_A (r + delta) = 2 k_t delta."""
    return float((par.m * par.g + 2 * par.K_A * par.r_max) / (2 * par.k_t - 2 * par.K_A))


def _energy(plant: Plant, par: Any, run: malta.simulation.Trajectory) -> FloatArray:
    """Kinetic and potential, J, and what the bearings are compressed by."""
    x = ca.SX.sym("x", 12)
    energy = np.array(ca.Function("energy", [x], [tubular.energy(par, x)]).map(len(run.t))(run.x.T)).ravel()
    beyond = [np.maximum(np.hypot(run.p[:, k], run.p[:, k + 1]) - par.r_max, 0) for k in (0, 2)]
    assert plant.parameters == par
    return np.asarray(energy + par.k_t / 2 * (beyond[0] ** 2 + beyond[1] ** 2))


DROPS = {
    "level": {"y": -0.5e-3},
    "from the ceiling's side": {"y": 0.3e-3},
    "tilted": {"x": 0.1e-3, "y": -0.3e-3, "alpha": 1e-3, "beta": -2e-3},
}


@pytest.mark.parametrize("start", DROPS.values(), ids=DROPS)
def test_a_mover_without_current_loses_energy_until_it_rests_on_its_bearings(
    calibrated: Design, start: dict[str, float]
) -> None:
    """Gravity and attraction drop it on the bearings; what it loses on a touch it never regains. Without friction only
    what is level comes to rest: where weight and attraction compress the bearings, by 3.49 um."""
    idle = _with(calibrated, I_max=1e-12, F_c=0.0)
    par: Any = idle.parameters
    run = malta.simulate(
        idle,
        calibrated.controller,
        _hold(0.1, start=start, cold=True, bearing=True, fidelity="force"),
        engine=VIRTUAL,
    )
    energy = _energy(idle, par, run)
    touching = run.contact[:, :2].max(axis=1) >= 1
    assert touching.any()
    assert run.verdict.name.startswith("touchdown at sensor plane")
    assert run.verdict.time == run.t[touching.argmax()]
    assert np.diff(energy).max() < 1e-6 * (energy[0] - energy[-1])
    free = ~(touching[1:] | touching[:-1])
    assert np.abs(np.diff(energy)[free]).max(initial=0) < 1e-9 * (energy[0] - energy[-1])
    assert np.abs(run.contact[:, :2]).max() < 1.1
    if set(start) == {"y"}:
        side = math.copysign(1.0, start["y"])
        weight = par.m * par.g * -side  # on the ceiling's side the attraction carries it
        rest = (weight + 2 * par.K_A * par.r_max) / (2 * par.k_t - 2 * par.K_A)
        assert run.p[-1, 1] * side - par.r_max == pytest.approx(rest, abs=1e-12)
        if side < 0:
            assert rest == pytest.approx(_rest(par)) == pytest.approx(3.486e-6, abs=1e-9)
        assert np.abs(run.x[-1, 6:]).max() < 1e-9


@pytest.mark.slow
def test_without_bearings_a_touch_ends_the_run(calibrated: Design) -> None:
    idle = _with(calibrated, I_max=1e-12)
    scenario = _hold(0.1, start={"y": -0.5e-3}, cold=True, fidelity="force")
    ended, resting = (
        malta.simulate(idle, calibrated.controller, replace(scenario, bearing=b), engine=VIRTUAL)
        for b in (False, True)
    )
    assert ended.verdict.name == resting.verdict.name == "touchdown at sensor plane 1"
    assert ended.verdict.time == pytest.approx(resting.verdict.time, abs=1.5 * Ts)
    assert len(ended.t) < len(resting.t) == 2000


@settings(deadline=None)
@given(
    place=st.lists(st.floats(-0.65e-3, 0.65e-3), min_size=4, max_size=4),
    rate=st.lists(st.floats(-0.5, 0.5), min_size=4, max_size=4),
    z=st.floats(-15e-3, 15e-3),
)
def test_bearings_push_inwards_and_never_pull(
    calibrated: Design, par: tubular.Parameters, place: list[float], rate: list[float], z: float
) -> None:
    """The wrench, resolved into a force at each plane: along -r, k_t delta + d_t delta' or nothing."""
    plant = calibrated.plant
    p, dp = ca.DM([*place, z]), np.array(rate)
    x = np.zeros(12)
    x[:5] = np.array(plant.position_of(p)).ravel()
    # Rates of the four radial outputs at rest along the axis: p' = P(z) q' to the tilt's second order.
    l_1, l_2 = float(-(par.l_S + z)), float(par.l_S - z)
    x[[6, 10]] = np.linalg.solve([[1, l_1], [1, l_2]], dp[[0, 2]])
    x[[7, 9]] = np.linalg.solve([[1, -l_1], [1, -l_2]], dp[[1, 3]])
    wrench = np.array(ca.evalf(plant.contacts.bearing(ca.SX(x)))).ravel()
    true = np.array(plant.h(ca.DM(x), 0)).ravel()
    # F = F_1 + F_2 and T = sum of (r_i - r, l_i) x F_i, both without an axial part.
    T_y, T_x = wrench[4], wrench[3]
    levers = np.array([[1.0, 1.0], [l_1, l_2]])
    f_x = np.linalg.solve(levers, np.array([wrench[0], T_y]))
    f_y = np.linalg.solve(levers, np.array([wrench[1], -T_x]))
    assert wrench[2] == 0
    for k in (0, 1):
        r, F = true[2 * k : 2 * k + 2], np.array([f_x[k], f_y[k]])
        delta = math.hypot(*r) - par.r_max
        approach = float(r @ dp[2 * k : 2 * k + 2]) / math.hypot(*r) if r.any() else 0.0
        push = max(par.k_t * delta + par.d_t * approach, 0.0) if delta > 0 else 0.0
        speed = math.hypot(*dp[2 * k : 2 * k + 2])  # known to the tilt's second order
        terms = par.k_t * max(delta, 0.0) + par.d_t * speed  # which may nearly cancel
        _close(F, -push * r / max(math.hypot(*r), 1e-12), rtol=3e-3, atol=1e-6 + 3e-4 * terms * (delta > 0))
        assert F @ r <= 1e-9


# Sensors with errors of their own


def test_gains_and_offsets_stand_between_the_mover_and_its_measurement(calibrated: Design) -> None:
    errors = {
        "gain_x1": 0.01,
        "gain_y2": -0.02,
        "offset_x1": 2e-6,
        "offset_y1": -3e-6,
        "hall_amplitude": 0.01,
    }
    run = malta.simulate(
        calibrated.plant,
        calibrated.controller,
        _short_stroke(sensor_errors=errors, fidelity="force"),
        engine=VIRTUAL,
    )
    gain, offset = np.array([1.01, 1, 1, 0.98]), np.array([2e-6, -3e-6, 0, 0])
    _close(run.y[:, :4], gain * run.p[:, :4] + offset, atol=1e-18)
    k = math.pi / 15e-3
    error = 0.01 * np.sin(2 * k * run.p[:, 4]) / (2 * k)
    _close(run.y[:, 4] - run.p[:, 4], error, atol=0.01**2 / k)
    assert np.abs(error).max() > 15e-6
    # The controller believes its sensors: from the offset on the mover makes for where they read zero.
    assert run.p[-1, 0] < -0.5e-6
    assert run.p[-1, 1] > 0.5e-6


def test_perfect_sensors_of_their_own_are_the_outputs(calibrated: Design) -> None:
    """A stroke with all errors zero is the stroke that measures p itself; Hall sensors see tilts in second order."""
    none: tuple[Mapping[str, float] | None, ...] = (None, {})
    runs = [
        malta.simulate(
            calibrated.plant,
            calibrated.controller,
            _short_stroke(sensor_errors=e, fidelity="force"),
            engine=VIRTUAL,
        )
        for e in none
    ]
    assert np.abs(runs[1].y - runs[1].p).max() < 1e-11
    _close(runs[1].x, runs[0].x, atol=1e-9 * np.abs(runs[0].x).max())


# Machines that change, outer loops


def test_a_change_at_the_start_is_another_machine(calibrated: Design) -> None:
    scenario = _short_stroke(fidelity="force")
    changed = malta.simulate(
        calibrated.plant, calibrated.controller, replace(scenario, changes=((0.0, {"m": 0.4}),))
    )
    heavy = malta.simulate(_with(calibrated, m=0.4), calibrated.controller, scenario)
    assert np.array_equal(changed.x, heavy.x)


@pytest.mark.parametrize("fidelity", ["force", "dq"])
def test_what_is_picked_up_weighs_from_then_on(calibrated: Design, fidelity: Fidelity) -> None:
    """0.1 kg at 10 ms: not a bit differs before; then it falls with what 0.981 N does to 0.46 kg, and is caught."""
    scenario = _hold(0.02, fidelity=fidelity)
    before, after = (
        malta.simulate(calibrated.plant, calibrated.controller, replace(scenario, changes=changes))
        for changes in ((), ((0.01, {"m": 0.46}),))
    )
    k = 200
    assert np.array_equal(after.x[: k + 1], before.x[: k + 1])
    assert np.array_equal(after.v[: k + 1], before.v[: k + 1])
    fall = (after.x[:, 7] - before.x[:, 7])[k : k + 3]
    assert fall == pytest.approx(-0.1 * 9.81 / 0.46 * Ts * np.arange(3), rel=0.03, abs=1e-12)
    assert after.p[:, 1].min() < -5e-6
    assert after.v[-1, [1, 3]].sum() > 1.05 * before.v[-1, [1, 3]].sum()


def test_several_changes_take_effect_in_their_order(calibrated: Design) -> None:
    """Picked up and put down again, however they are listed; one after the end never happens."""
    up, down, late = (3e-3, {"m": 0.46}), (4e-3, {"m": 0.36}), (1.0, {"m": 9.0})
    scenario = _hold(8e-3, fidelity="force")
    runs = [
        malta.simulate(calibrated.plant, calibrated.controller, replace(scenario, changes=changes))
        for changes in ((up, down), (late, down, up), (up,))
    ]
    assert np.array_equal(runs[0].x, runs[1].x)
    assert np.array_equal(runs[0].x[:81], runs[2].x[:81])
    assert not np.array_equal(runs[0].x[82], runs[2].x[82])


def _corrected(
    design: Design, update: Callable[[float, FloatArray], FloatArray], every: float = 1e-3
) -> malta.simulation.Trajectory:
    scenario = _hold(0.02, fidelity="force", correction=Correction(every, update))
    return malta.simulate(design.plant, design.controller, scenario)


def test_an_outer_loop_moves_the_reference_at_its_own_rate(calibrated: Design) -> None:
    """Called every millisecond with what is true then; what it returns is added to p*, not to what it added before."""
    calls: list[tuple[float, FloatArray]] = []

    def update(t: float, p: FloatArray) -> FloatArray:
        calls.append((t, p))
        return np.array([1e-6 * len(calls), 0, 0, 0, 0])

    run = _corrected(calibrated, update)
    assert [t for t, _ in calls] == pytest.approx(1e-3 * np.arange(1, 20))
    for t, p in calls:
        assert np.array_equal(p, run.p[round(t / Ts) - 1])
    _close(run.reference[:, 0], 1e-6 * np.floor(run.t / 1e-3 + 1e-9), atol=1e-18)
    assert not run.reference[:, 1:].any()
    assert run.p[-1, 0] > 5e-6


def test_an_outer_loop_that_asks_for_nothing_changes_nothing(calibrated: Design) -> None:
    run = _corrected(calibrated, lambda _t, p: np.zeros_like(p))
    plain = malta.simulate(calibrated.plant, calibrated.controller, _hold(0.02, fidelity="force"))
    assert np.array_equal(run.x, plain.x)


@pytest.mark.slow
def test_an_outer_loop_that_sees_the_truth_corrects_a_sensor(calibrated: Design) -> None:
    """5 um of offset: with the sensor alone the mover goes where it reads zero; a laser that integrates takes most of
    that back."""
    options: dict[str, Any] = {"fidelity": "force", "sensor_errors": {"offset_x1": 5e-6, "offset_x2": 5e-6}}
    total = np.zeros(5)

    def laser(_: float, p: FloatArray) -> FloatArray:
        total[:] -= 0.1 * p
        return total.copy()

    def off(correction: Correction | None) -> float:
        scenario = _hold(0.1, correction=correction, **options)
        run = malta.simulate(calibrated.plant, calibrated.controller, scenario, engine=VIRTUAL)
        return float(np.abs(run.p[-1, [0, 2]]).max())

    alone, corrected = off(None), off(Correction(2e-3, laser))
    assert alone > 3e-6
    assert corrected < 0.2 * alone


# The filter, the integrator and the computation


def test_a_scheduled_filter_measures_where_the_mover_is(calibrated: Design) -> None:
    """Tilted by 0.2 mrad: P(z) of z = 0 takes a tilt at z = 5 mm for a shift of z alpha = 1 um, P(z) of the measured z
    does not; at z = 0 the two are one."""
    errors = {}
    for z in (0.0, 5e-3):
        for scheduled in (False, True):
            scenario = _hold(
                0.02,
                {"z": z},
                start={"z": z, "alpha": 2e-4, "beta": -1e-4},
                scheduled=scheduled,
                fidelity="force",
            )
            run = malta.simulate(calibrated.plant, calibrated.controller, scenario, engine=VIRTUAL)
            error = run.xi_hat[:, :2] - run.x[:, :2]
            errors[z, scheduled] = np.abs(error).max()
    assert errors[0.0, True] == pytest.approx(errors[0.0, False], rel=1e-6)
    assert errors[5e-3, False] > 0.8e-6
    assert errors[5e-3, False] > 10 * errors[5e-3, True]


@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_the_integrator_has_fourth_order_with_windings_too(calibrated: Design, fidelity: Fidelity) -> None:
    """Each halving divides the errors of places and currents by 16; four steps a sample leave a picometre, 1 nA."""
    runs = {
        n: malta.simulate(
            calibrated.plant, calibrated.controller, Scenario.stroke(10e-3, fidelity=fidelity, substeps=n)
        )
        for n in (1, 2, 4, 16)
    }
    for series, largest in (("p", 1e-12), ("i", 1e-10)):
        errors = [np.abs(getattr(runs[n], series) - getattr(runs[16], series)).max() for n in (1, 2, 4)]
        assert errors[0] / errors[1] == pytest.approx(16, rel=0.1)
        assert errors[1] / errors[2] == pytest.approx(16, rel=0.1)
        assert errors[2] < largest


@pytest.mark.slow_for("phase")
@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_nothing_happens_before_the_computation_is_done(calibrated: Design, fidelity: Fidelity) -> None:
    """A step of the reference at t = 0: what holds the mover flows on for `delay` samples to the bit of its trim, and
    the first sample after it the new command acts. Without a word the machine's own delay holds: 75 us, one sample."""
    scenario = _hold(1e-3, {"x1": 5e-6}, start={"x": 0.0, "beta": 0.0}, fidelity=fidelity)
    for delay in (0, 1, 2, 4):
        run = malta.simulate(
            calibrated.plant, calibrated.controller, replace(scenario, delay=delay), engine=VIRTUAL
        )
        pushed = np.abs(run.force[:, 0]) > 1e-9
        assert pushed.argmax() == delay + 1
        own = malta.simulate(calibrated.plant, calibrated.controller, scenario, engine=VIRTUAL)
        assert np.array_equal(run.x, own.x) == (delay == 1)


@pytest.mark.slow_for("dq")
@pytest.mark.parametrize("fidelity", ["dq", "phase"])
def test_the_smaller_limit_counts_of_the_machine_and_of_its_gain_file(
    designs: dict[str, Design], fidelity: Literal["dq", "phase"]
) -> None:
    """Voltages of 2 V and currents of 0.5 A, where the stroke takes 6.6 V and 2.6 A."""
    plant, c = designs["calibrated"].plant, designs["calibrated"].controller
    scenario = malta.Scenario.stroke(fidelity=fidelity)
    weak = plant.variant(replace(plant.parameters, V_max=2.0))
    cautious = replace(c, limits=replace(c.limits, voltage=np.full(5, 2.0)))
    free, by_machine, by_file = (
        malta.simulate(*pair, scenario) for pair in ((plant, c), (weak, c), (plant, cautious))
    )
    assert _largest_phase_voltage(free, fidelity) > 5
    assert _largest_phase_voltage(by_machine, fidelity) == pytest.approx(2, rel=1e-9)
    np.testing.assert_array_equal(by_machine.x, by_file.x)
    careful = replace(c, limits=replace(c.limits, current=np.full(5, 0.5)))
    run = malta.simulate(plant, careful, scenario)
    assert np.abs(run.current).max() == 0.5
    assert run.limits == ("current limit",)


def _largest_phase_voltage(run: malta.simulation.Trajectory, fidelity: str) -> float:
    """V, of all phases; from the axes their upper bound, by which they are limited."""
    if fidelity == "phase":
        return float(np.abs((run.duty - 0.5) * run.link).max())
    return max(float(ca.mmax(run.plant.drive.peak(ca.DM(u)))) for u in run.u)
