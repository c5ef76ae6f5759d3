"""The experiments: published figures, hand formulas, the linear loop as a second route, limits, faults, Ctrl-C."""

from __future__ import annotations

import inspect
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from flight import EXPERIMENTS
from scipy import stats
from scipy.linalg import expm

import malta
from malta import references
from malta.loops.sampled_loops import machine_loop, sampled_loop
from malta.machines.tubular.experiments import disturbances as forces, disturbances as rest, lifting, strokes
from malta.model.plants import plant_of
from malta.model.printed import published_value
from malta.simulation.experiments import Case, Experiment, Merit, compliance
from malta.simulation.experiments.catalogue import experiment
from malta.simulation.scenario import ESTIMATORS, Fault, Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory, Verdict
from malta.synthesis.regulators import lqr
from malta_papers.tubular.experiments import induced_per_speed

pytestmark = pytest.mark.first

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant

Flown = Callable[..., Experiment]
QUIET: dict[str, Any] = {"noise": 0.0, "quantize": False, "sensor_errors": None}
LINEAR: dict[str, Any] = QUIET | {"fidelity": "force"}  # what the linear loop describes
STRUCK = 1000  # sample at which the faults strike


@pytest.fixture(scope="module")
def flown(designs: dict[str, Design]) -> Flown:
    """An experiment on a shipped design, each flown once."""
    kept: dict[tuple[str, str, str], Experiment] = {}

    def fly(design: str, name: str, **options: Any) -> Experiment:
        key = (design, name, repr(sorted(options.items())))
        if key not in kept:
            kept[key] = experiment(name, designs[design].plant, designs[design].controller, **options)
        return kept[key]

    return fly


def _merit(merits: tuple[Merit, ...], label: str) -> float:
    return next(merit.value for merit in merits if merit.label == label)


def _case(found: Experiment, label: str) -> Case:
    return next(case for case in found.cases if case.label == label)


def _column(plant: Plant, wrench: str) -> int:
    return [s.name for s in plant.disturbances].index(wrench)


# What the paper prints is written once


def test_defaults_are_the_published_figures(plant: Plant, published: dict[str, Any]) -> None:
    def default(name: str, parameter: str) -> Any:
        return inspect.signature(EXPERIMENTS[name]).parameters[parameter].default

    for found, key in (
        (default("stroke", "distance"), "figure_12.stroke"),
        (default("stroke", "rise"), "figure_12.rise_time"),
        (strokes.RISE, "figure_12.rise_time"),
        (inspect.signature(strokes.delayed_stroke).parameters["distance"].default, "figure_12.stroke"),
        (default("drive-limits", "distance"), "figure_12.stroke"),
        (default("tilt", "radius"), "figure_16.radius"),
        (default("thermal", "drift"), "thermal.drift"),
        (max(default("payload", "masses")), "position_controller.payload"),
        (plant.stroke.travel, "travel.z_ss"),
        (plant.sensors.resolution[0], "figure_14.resolution"),
        (plant.actuator.crossover, "current_controller.crossover"),
        (plant.actuator.phase_margin, "current_controller.phase_margin"),
    ):
        assert found == pytest.approx(published_value(published, key), rel=1e-12), key
    assert default("tilt", "frequency") == published["figure_16"]["frequency"]["value"]  # Hz, not rad/s
    assert published["table_III"]["samples"] == rest.REST_SAMPLES


@pytest.mark.slow_for("payload", "thermal")
@pytest.mark.parametrize("name", ["stroke", "hold", "tilt", "payload", "thermal"])
def test_what_a_merit_is_compared_with_is_in_the_published_data(
    flown: Flown, published: dict[str, Any], name: str
) -> None:
    found = flown("calibrated", name)
    merits = [*found.merits, *(merit for case in found.cases for merit in case.merits)]
    keys = {merit.published for merit in merits} - {""}
    assert keys
    for key in keys:
        assert math.isfinite(published_value(published, key))


# Stroke


def test_the_stroke_keeps_what_the_paper_prints(
    design: Design, flown: Flown, published: dict[str, Any]
) -> None:
    found = flown(design.spec.name, "stroke")
    assert found.run.verdict.completed
    bounds = [m for m in found.merits if m.relation == "at most"]
    assert len(bounds) == 6
    for merit in bounds:
        assert 0 <= merit.value <= published_value(published, merit.published), merit.label
    for label in ("rise, 10-90 %", "drive constant per module, f / i"):
        merit = next(m for m in found.merits if m.label == label)
        assert merit.value == pytest.approx(published_value(published, merit.published), rel=0.05)
    assert max(_merit(found.merits, f"deviation {name}") for name in ("x1", "x2")) < 1e-15
    assert min(_merit(found.merits, f"deviation {name}") for name in ("y1", "y2")) > 0.3e-6


@pytest.mark.parametrize("fidelity", ["force", "dq", "phase"])
def test_the_drive_constant_is_read_back(design: Design, flown: Flown, fidelity: str) -> None:
    """f / i is the K_D of Table IV in whatever makes the force, and follows the machine, not the belief."""
    found = flown(design.spec.name, "stroke", fidelity=fidelity)
    read = _merit(found.merits, "drive constant per module, f / i")
    assert read == pytest.approx(design.plant.parameters.K_D, rel=1e-9)  # type: ignore[attr-defined]
    weaker = plant_of(replace(design.spec.parameters, K_D=4.7))
    other = experiment("stroke", weaker, design.controller, fidelity=fidelity)
    assert strokes.drive_constant(other.run) == pytest.approx(4.7, rel=1e-9)


def test_heat_is_the_same_in_phases_and_in_axes(design: Design, flown: Flown) -> None:
    """Sum of R i^2 over 18 windings, and R times 9/2 and 9/4 of those of the axes: two runs, and one twice."""
    phase, dq = (flown(design.spec.name, "stroke", fidelity=kind) for kind in ("phase", "dq"))
    label = "heat in the windings"
    assert _merit(phase.merits, label) == pytest.approx(_merit(dq.merits, label), rel=1e-3)
    run = phase.run
    in_axes = run.plant.actuator.R * run.i**2 @ np.array(run.plant.drive.weight)
    assert run.copper_loss == pytest.approx(in_axes, rel=1e-9)
    held = run.plant.actuator.R * 2 * 2.25 * (run.plant.stroke.mass * 9.81 / 2 / 5.2) ** 2  # the weight alone
    assert run.copper_loss[0] == pytest.approx(held, rel=0.05)
    assert _merit(dq.merits, label) > 10 * held * 0.1


def test_efficiency_is_what_the_energies_make_it(design: Design, flown: Flown) -> None:
    """Electrical = heat + change of L i^2 / 2 + 4.5 K_ind / K_D of the mechanical: K_D is no power balance's.

    So no stroke can pass K_D / (4.5 K_ind) = 66 %. The right side knows no voltage.
    """
    run = flown(design.spec.name, "stroke").run
    par: Any = run.plant.parameters
    weight, Ts = np.array(run.plant.drive.weight), run.controller.sample_time
    power = run.force[:, 4] * run.x[:, 8]
    driving = (power > 0) & (run.electrical_power > 0)
    mechanical = float(power[driving].sum()) * Ts
    heat = float(run.copper_loss[driving].sum()) * Ts
    stored = np.gradient(par.L / 2 * run.i**2 @ weight)
    apart = 4.5 * par.K_ind / par.K_D
    drawn = heat + apart * mechanical + float(stored[driving].sum())
    found = strokes.efficiency(run)
    assert found == pytest.approx(mechanical / drawn, rel=0.01)
    assert 0.05 < found < 1 / apart < 1
    assert apart == pytest.approx(1.506, abs=5e-4)
    # Kinetic energy at the peak of the logistic, 0.678 m/s, is what the thrust puts in.
    assert mechanical == pytest.approx(par.m * 0.678**2 / 2, rel=0.1)


def test_a_stroke_and_back_is_drawn_as_heat(design: Design, flown: Flown) -> None:
    """From rest to rest nothing is kept: all that the windings draw is heat."""
    run = flown(design.spec.name, "stroke").run
    power = run.force[:, 4] * run.x[:, 8]
    assert abs(power.sum()) < 1e-3 * np.abs(power).sum()
    assert run.electrical_power.sum() == pytest.approx(run.copper_loss.sum(), rel=0.01)
    assert 44.8 < run.link.min() < run.link[0] == 45


def test_a_stroke_backwards_is_the_mirrored_stroke(design: Design, flown: Flown) -> None:
    """The machine is even in z: modules and sensor planes change places.

    So do the gains of table2. The filter of `calibrated` trusts y2 more than y1, as Table III does: 4 %.
    """
    there, back = (flown(design.spec.name, "stroke", distance=d) for d in (10e-3, -10e-3))
    for a, b in (
        ("rise, 10-90 %", "rise, 10-90 %"),
        ("axial error", "axial error"),
        ("deviation y1", "deviation y2"),
        ("deviation y2", "deviation y1"),
        ("heat in the windings", "heat in the windings"),
    ):
        even = design.spec.name == "table2" or not a.startswith("deviation")
        assert _merit(there.merits, a) == pytest.approx(_merit(back.merits, b), rel=1e-5 if even else 0.05)


def test_another_stroke_is_not_compared_with_the_published_one(flown: Flown) -> None:
    for options in ({"distance": 8e-3}, {"rise": 20e-3}):
        assert not any(merit.published for merit in flown("calibrated", "stroke", **options).merits)
    assert any(merit.published for merit in flown("calibrated", "stroke").merits)


# Hold


class Rest(NamedTuple):
    """What the linear loop predicts of a hold from rest, for the samples that are looked at."""

    white: FloatArray  # m, rms of a measurement's own noise, steps included
    true: FloatArray  # m, rms of the outputs
    mean: FloatArray  # m, standard error of the mean of the measurements


@pytest.fixture(scope="module")
def rests(designs: dict[str, Design]) -> dict[str, Rest]:
    return {name: _rest(design) for name, design in designs.items()}


def _rest(design: Design) -> Rest:
    """The Lyapunov recursion of the closed loop under sensor noise, from zero: its slow integrals are not stationary
    after 0.4 s. The sum of the last 2000 measurements is carried along as five more states."""
    stage, plant = machine_loop(design.model, design.controller), design.plant
    white = np.square(plant.sensors.noise) + np.square(plant.sensors.resolution) / 12
    A, n = stage.closed, len(stage.closed)
    B = np.vstack([stage.Bd @ stage.control.D_y, stage.control.B_y])
    C = np.hstack([stage.Cd, np.zeros((5, len(stage.control.A)))])
    P, W = np.zeros((n, n)), B @ np.diag(white) @ B.T
    for _ in range(6000):
        P = A @ P @ A.T + W
    A = np.block([[A, np.zeros((n, 5))], [C, np.eye(5)]])
    B = np.vstack([B, np.eye(5)])
    P, W = np.pad(P, (0, 5)), B @ np.diag(white) @ B.T
    true = np.zeros(5)
    for _ in range(rest.REST_SAMPLES):
        true += np.diag(C @ P[:n, :n] @ C.T)
        P = A @ P @ A.T + W
    samples = rest.REST_SAMPLES
    return Rest(np.sqrt(white), np.sqrt(true / samples), np.sqrt(np.diag(P)[n:]) / samples)


def test_measured_is_noise_and_steps_and_motion(design: Design, flown: Flown) -> None:
    """A sensor reads the nearest step of noise and motion about its mean: at rest in the middle of a step, 1 um beside
    0.35 um, it reads less than std^2 = noise^2 + motion^2 + step^2 / 12."""
    found, p = flown(design.spec.name, "hold"), flown(design.spec.name, "hold").run.p[-2000:]
    plant = design.plant
    for k, signal in enumerate(plant.outputs):
        measured = _merit(found.merits, f"measured {signal.name}, std")
        sigma = math.hypot(plant.sensors.noise[k], p[:, k].std())
        expected = _stepped(p[:, k].mean(), sigma, plant.sensors.resolution[k])
        assert measured == pytest.approx(expected, rel=0.1)
    assert _stepped(0.0, 0.35e-6, 1e-6) < 0.9 * math.hypot(0.35e-6, 1e-6 / math.sqrt(12))
    assert found.run.y[:, :4] == pytest.approx(np.round(found.run.y[:, :4], 6), abs=1e-12)


def _stepped(mean: float, sigma: float, step: float) -> float:
    """The standard deviation of the multiple of `step` that is nearest to a normal variable."""
    if not step:
        return sigma
    k = np.arange(-20, 21)
    share = np.diff(stats.norm.cdf((np.arange(-20, 22) - 0.5) * step, mean, sigma))
    return step * math.sqrt(share @ k**2 - (share @ k) ** 2)


def test_means_are_within_their_standard_errors(design: Design, flown: Flown, rests: dict[str, Rest]) -> None:
    """The mean over 0.1 s is chance: no more than the loop's own slow motion. The printed means are as small.

    The noise of x1, a third of its step, smooths the steps least: the slow motion of table2 is 2.5 times that of steps
    that are noise, by 64 seeds.
    """
    error = rests[design.spec.name].mean
    scaled = []
    for seed in range(8):
        found = flown(design.spec.name, "hold", seed=seed, fidelity="force")
        means = [_merit(found.merits, f"measured {s.name}, mean") for s in design.plant.outputs]
        scaled.append(np.array(means) / error)
    assert np.abs(scaled).max() < 5
    first, *others = np.sqrt(np.mean(np.square(scaled), axis=0))
    assert 0.5 < first < 3.2
    assert 0.5 < np.sqrt(np.mean(np.square(others))) < 1.5


def test_the_true_motion_is_the_linear_loops(design: Design, flown: Flown, rests: dict[str, Rest]) -> None:
    names = [s.name for s in design.plant.outputs]
    runs = [flown(design.spec.name, "hold", seed=seed, fidelity="force") for seed in range(16)]
    found = [[_merit(run.merits, f"true {name}, rms") for name in names] for run in runs]
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    near = (
        0.3 if design.spec.name == "calibrated" else 0.9
    )  # steps beside little noise push what integrates slowly
    assert rms == pytest.approx(rests[design.spec.name].true, rel=near)
    assert rms[:4].max() < 0.3e-6  # the sensors show up to 0.54 um


def test_without_noise_nothing_moves(design: Design, flown: Flown) -> None:
    found = flown(design.spec.name, "hold", **QUIET)
    assert np.abs(found.run.p).max() < 1e-11
    assert _merit(found.merits, "bearing force, rms about its mean") < 1e-8


# Tilt


def _circling(design: Design, *, attraction: bool, radius: float = 200e-6, frequency: float = 2.0) -> Any:
    """Largest errors in sensor planes 1 and 2, m, on the linear loop in its steady state."""
    model, c = design.model, design.controller
    stage = sampled_loop(model, c, delay=1, current_loops="lag")
    w = 2 * math.pi * frequency
    p = radius * np.array([1, -1j, 0, 0, 0])  # cos, sin
    symbol = ca.SX.sym("p", 5)
    position_of = ca.Function("J", [symbol], [ca.jacobian(design.plant.position_of(symbol), symbol)])
    q = np.array(position_of(0)) @ p
    v_ff = -np.linalg.solve(model.force_map, model.stiffness @ q) if attraction else np.zeros(5)
    r = np.concatenate([p, q, 1j * w * q, v_ff, np.zeros(5)])
    B = np.vstack([stage.Bd @ stage.control.D_r, stage.control.B_r])
    z = np.exp(1j * w * c.sample_time) * np.eye(len(stage.closed))
    state = np.linalg.solve(z - stage.closed, B @ r)
    error = stage.Cd @ state[: len(stage.Ad)] - p
    turned = (error * np.exp(1j * np.linspace(0, 2 * math.pi, 720))[:, None]).real
    return np.hypot(turned[:, [0, 2]], turned[:, [1, 3]]).max(axis=0)


@pytest.mark.parametrize("kind", ["axial", "attraction"])
def test_the_circle_errs_as_the_linear_loop_does(design: Design, flown: Flown, kind: str) -> None:
    found = flown(design.spec.name, "tilt", **LINEAR)
    merits = _case(found, f"feedforward {kind}").merits
    plane_1, plane_2 = _circling(design, attraction=kind == "attraction")
    assert _merit(merits, "SP1: largest tracking error, true") == pytest.approx(plane_1, rel=0.01)
    # In the second turn the integrals of `calibrated` still settle: 0.5 um of 200.
    assert _merit(merits, "SP2: largest deviation, true") == pytest.approx(plane_2, abs=0.6e-6)


@pytest.mark.parametrize(("name", "ratio"), [("table2", 2.0), ("calibrated_slow", 4.0)])
def test_without_the_attraction_the_mover_goes_too_far(plant: Plant, name: str, ratio: float) -> None:
    """K1 / (K1 - k) of what is asked until the integrals take it back: twice as far, or 4/3."""
    spec, law = malta.read_design(f"design/{name}.toml"), malta.gains.read(f"design/gains/{name}.json")
    model = malta.linearize(plant, plant.at())
    stiffness = (model.force_map @ lqr(model, spec.weights)[:, :5])[0, 0]
    assert stiffness / model.stiffness[0, 0] == pytest.approx(ratio, rel=1e-4)
    run = _case(experiment("tilt", plant, law), "feedforward axial").run
    gain = np.hypot(run.p[:, 0], run.p[:, 1]) / 200e-6
    first = gain[(run.t > 10e-3) & (run.t < 60e-3)].max()
    assert first == pytest.approx(ratio / (ratio - 1), rel=0.01)
    last = gain[run.t > 0.5]
    if name == "table2":  # its integrals settle in minutes
        assert last == pytest.approx(2.0, rel=0.01)
    else:
        assert 1.15 < last.min() < last.max() < 1.30


def test_integrals_as_fast_as_figure_16_asks_follow_the_circle(
    plant: Plant, flown: Flown, published: dict[str, Any]
) -> None:
    """The law as printed: 0.1 s of integrals in place of 1 s bring plane 2 within 4 um, plane 1 five times nearer."""
    slow = experiment("tilt", plant, malta.gains.read("design/gains/calibrated_slow.json"))
    labels = ("SP2: largest deviation, true", "SP1: largest tracking error, true")
    fitted, before = (
        [_merit(_case(found, "feedforward axial").merits, label) for label in labels]
        for found in (flown("calibrated", "tilt"), slow)
    )
    assert fitted == pytest.approx([3.63e-6, 9.75e-6], rel=0.03)
    assert before == pytest.approx([12.3e-6, 52.5e-6], rel=0.03)
    assert fitted[0] < published_value(published, "figure_16.deviation") < before[0]


def test_the_printed_law_keeps_the_published_bound_if_fitted_and_the_attraction_always(
    design: Design, flown: Flown, published: dict[str, Any]
) -> None:
    bound = published_value(published, "figure_16.deviation")
    axial, attraction = flown(design.spec.name, "tilt").cases
    label = "SP2: largest deviation, true"
    if design.spec.name == "calibrated":  # is fitted on it
        assert 0.8 * bound < _merit(axial.merits, label) < bound
    else:
        assert _merit(axial.merits, label) > 1.5 * bound
    assert _merit(attraction.merits, label) < 1e-6 < bound
    assert _merit(attraction.merits, "SP2: largest deviation, measured") <= bound
    assert all(case.run.verdict.completed for case in (axial, attraction))
    limit = 1.5e-6 if design.spec.name == "calibrated" else 3e-6
    assert _merit(attraction.merits, "SP1: largest tracking error, true") < limit


# Lift-off


def test_rest_on_the_bearing_is_an_equilibrium(plant: Plant, par: Any) -> None:
    """Two bearings of k_t carry m g and what 2 K_A pulls: penetration (m g + 2 K_A r_max) / (2 k_t - 2 K_A)."""
    resting = lifting.rest_on_bearing(plant)
    assert list(resting) == ["y"]
    pull = 2 * par.K_A
    depth = (par.m * par.g + pull * par.r_max) / (2 * par.k_t - pull)
    assert -resting["y"] - par.r_max == pytest.approx(depth, rel=1e-9)
    assert depth == pytest.approx(3.49e-6, abs=0.01e-6)
    x = ca.SX.sym("x", 12)
    rate = ca.Function("rate", [x], [plant.f(x, ca.SX.zeros(5), plant.load(x) + plant.contacts.bearing(x))])
    assert np.abs(np.array(rate(plant.at(**resting).x))).max() < 1e-9


def test_the_current_that_lifts_is_what_statics_need(plant: Plant, par: Any) -> None:
    """(2 K_A r + m g) / (2 K_B) = 1.34 A, a quarter of the limit; the attraction is three quarters of it."""
    resting = lifting.rest_on_bearing(plant)
    found = lifting.break_away_current(plant, resting)
    assert found == pytest.approx((2 * par.K_A * -resting["y"] + par.m * par.g) / (2 * par.K_B), rel=1e-12)
    assert found == pytest.approx(1.34, abs=0.005)
    free = plant_of(replace(par, K_A=0.0))  # only its weight
    down = lifting.rest_on_bearing(free)
    assert -down["y"] - par.r_max == pytest.approx(par.m * par.g / (2 * par.k_t), rel=1e-6)
    assert lifting.break_away_current(free, down) == pytest.approx(par.m * par.g / (2 * par.K_B))


@pytest.mark.slow
def test_every_estimator_lifts_the_mover(design: Design, flown: Flown) -> None:
    found = flown(design.spec.name, "lift-off")
    assert tuple(case.label for case in found.cases) == ESTIMATORS
    assert not found.failed
    needed = found.merits[0].value
    for case in found.cases:
        run = case.run
        assert run.p[0, 1] < -0.6e-3
        assert run.contact[0, :2].min() > 1 > run.contact[-1].max()
        assert np.abs(run.p[-1, :4]).max() < 10e-6
        current = _merit(case.merits, "largest bearing current")
        assert needed < current < design.plant.actuator.current_limit
        # With less than the static need it stays on the bearing, which gives way by 3.5 um.
        enough = int(np.argmax(run.force[:, [1, 3]].sum(axis=1) / (2 * 5.2) > needed))
        assert 10 < enough < _merit(case.merits, "off the bearing after") / 50e-6
        assert run.p[: enough + 1, [1, 3]].max() < -0.5995e-3
        assert 20e-3 < _merit(case.merits, "within 20 um after") < 60e-3


@pytest.mark.slow
def test_an_observer_that_knows_nothing_pays_for_the_start(flown: Flown) -> None:
    """Cold, the steady-state filter takes the mover to fly: table2 overshoots by a third of the clearance, calibrated
    needs three times the current. The Kalman filters begin with a measurement, and wait longer before they lift: the
    integrals of calibrated, which grow as they wait, take it beyond the centre by 54 um."""
    for name in ("table2", "calibrated"):
        steady, kalman, extended = flown(name, "lift-off").cases
        off = [_merit(case.merits, "off the bearing after") for case in (steady, kalman, extended)]
        assert off == sorted(off)
        assert off[1] > 3 * off[0]
        beyond = [_merit(case.merits, "beyond the centre") for case in (steady, kalman, extended)]
        current = [_merit(case.merits, "largest bearing current") for case in (steady, kalman, extended)]
        assert max(beyond[1:]) < (25e-6 if name == "table2" else 60e-6)
        assert max(current[1:]) < 1.7
        if name == "table2":
            assert beyond[0] > 8 * beyond[1] > 8 * beyond[2]
            assert beyond[0] == pytest.approx(198e-6, rel=0.05)
        else:
            assert current[0] > 2.8 * max(current[1:])
            # Its first jump falls back by 0.2 mm before it follows, and hardly passes the centre.
            climbed = int(np.argmax(steady.run.p[:200, 1]))
            assert np.min(steady.run.p[climbed:600, 1]) < steady.run.p[climbed, 1] - 0.2e-3
            assert beyond[0] < 5e-6


def test_the_rise_is_a_quintic_to_the_centre(plant: Plant) -> None:
    reference = lifting.rise_reference(plant, {"y": -0.6e-3})
    t = np.arange(0, 40e-3, 1e-5)
    p, dp, ddp = reference(t)
    assert p[0] == pytest.approx([0, -0.6e-3, 0, -0.6e-3, 0], abs=1e-15)
    assert np.abs(p[t > 30e-3]).max() < 1e-15
    assert p[1500] == pytest.approx(p[0] / 2, abs=1e-12)
    assert np.gradient(p[:, 1], t)[1:-1] == pytest.approx(dp[1:-1, 1], abs=1e-4 * dp.max())
    assert np.gradient(dp[:, 1], t)[1:-1] == pytest.approx(ddp[1:-1, 1], abs=2e-3 * ddp.max())


# Payload


def _pushed(
    model: LinearModel, design: Design, wrench: str, size: float, samples: int, at: float = 0.0
) -> FloatArray:
    """Outputs of the linear loop after a step of force: the machine under a hold, exactly, by one more state.

    at : z of the force's point; the model's own
    """
    plant, c = model.plant, design.controller
    x, u, w = ca.SX.sym("x", 12), ca.SX.sym("u", 5), ca.SX.sym("w", 6)
    slope = ca.Function("B", [x, u, w], [ca.jacobian(plant.f(x, u, w), w)])
    B_w = np.array(slope(plant.at(z=at).x, 0, 0))[list(plant.controlled), _column(plant, wrench)] * size
    stage = sampled_loop(model, c, delay=1, current_loops="lag")
    A = np.zeros((16, 16))
    A[:10, :10], A[:10, 10:15], A[:10, 15] = model.A, model.B, B_w
    A[10:15, 10:15] = -plant.actuator.crossover * np.eye(5)
    push = np.zeros(len(stage.closed))
    push[:15] = expm(A * c.sample_time)[:15, 15]
    state, trace = np.zeros(len(push)), np.empty((samples, 5))
    for k in range(samples):
        trace[k] = stage.Cd @ state[: len(stage.Ad)]
        state = stage.closed @ state + push
    return trace


@pytest.mark.slow_for(
    "table2-0.05",
    "table2-0.1",
    "table2-0.15",
    "table2-0.2",
    "calibrated-0.05",
    "calibrated-0.1",
    "calibrated-0.15",
)
@pytest.mark.parametrize("extra", [0.05, 0.1, 0.15, 0.2])
def test_a_picked_mass_sags_as_the_linear_loop_predicts(design: Design, flown: Flown, extra: float) -> None:
    """The weight of the mass as a step of force on the heavier mover, at z = -5 mm where it is picked."""
    heavy = plant_of(replace(design.spec.parameters, m=design.plant.stroke.mass + extra))
    model = malta.linearize(heavy, heavy.at(z=-5e-3))
    sag = np.abs(_pushed(model, design, "F_y", -extra * 9.81, 9000, -5e-3)[:, :4]).max()
    case = _case(flown(design.spec.name, "payload", **LINEAR), f"{extra * 1e3:.0f} g")
    carried = case.run.verdict.completed
    assert carried == (sag < 0.6e-3)
    if carried:
        assert _merit(case.merits, "largest sag after the pick") == pytest.approx(sag, rel=1e-3)
        # Full state feedback would give m g / (K1 - k); the observer, which takes the weight for motion, is softer.
        stiff = (design.model.force_map @ lqr(design.model, design.spec.weights)[:, :5])[0, 0]
        alone = extra * 9.81 / (design.plant.stroke.mass * (stiff - design.model.stiffness[0, 0]))
        assert 2.5 < sag / alone < 10


def test_what_is_carried(design: Design, flown: Flown) -> None:
    """0.2 kg with `calibrated`, the most that is tried; table2 sags onto its bearing with more than 0.1 kg."""
    found = flown(design.spec.name, "payload")
    carried = {"table2": 0.1, "calibrated": 0.2}[design.spec.name]
    assert _merit(found.merits, "largest of these carried and moved") == pytest.approx(carried)
    assert [case.run.verdict.completed for case in found.cases] == [
        mass <= carried for mass in (0.05, 0.1, 0.15, 0.2)
    ]
    assert not found.failed
    sags = [_merit(case.merits, "largest sag after the pick") for case in found.cases]
    errors = [_merit(case.merits, "stroke: axial error") for case in found.cases]
    assert sags == sorted(sags)
    assert errors == sorted(errors)
    for case in found.cases:
        if not case.run.verdict.completed:
            assert case.run.verdict.name == "touchdown at sensor plane 1"
            assert 0.06 < case.run.verdict.time < 0.09


@pytest.mark.slow_for("table2")
def test_a_known_mass_hardly_sags_and_does_not_overshoot(design: Design) -> None:
    """Weight and inertia are fed forward: 0.2 kg sag by 142 um with `calibrated` and overshoot by 14 % unknown."""
    plant, controller = design.plant, design.controller
    for known in (False, True):
        flown = malta.experiment("payload", plant, controller, masses=(0.2,), known=known, **QUIET)
        case = flown.cases[0]
        sag = _merit(case.merits, "largest sag after the pick")
        assert (sag < 5e-6) == known
        if case.run.verdict.completed:
            assert (_merit(case.merits, "stroke: overshoot") < 0.005) == known
    weight = lifting.payload_wrench(np.array([0.0, 0.06, 0.54]), plant, 0.2)
    assert weight[0].tolist() == [0.0] * 6
    assert weight[1:, 1] == pytest.approx([-0.2 * 9.81] * 2)
    assert weight[2, 2] < -1  # N, while the stroke accelerates


def test_before_the_pick_nothing_moves(design: Design, flown: Flown) -> None:
    for options, limit in ((QUIET, 1e-11), ({}, 1e-6)):
        for case in flown(design.spec.name, "payload", **options).cases:
            run = case.run
            before = run.t <= lifting.PICKING_TIME
            assert np.abs(run.p - run.reference)[before][:, :4].max() < limit
            after = (run.t > lifting.PICKING_TIME + 5e-3) & (run.t < 0.1)
            assert np.abs(run.p)[after][:, [1, 3]].max() > 15e-6
            assert np.abs(run.p)[after][:, [0, 2]].max() < 2e-6  # weight does not push sideways


def test_the_integrals_lift_the_mass_again(flown: Flown) -> None:
    """After 0.45 s `calibrated` holds 0.2 kg within a tenth of the sag; table2's integrals take minutes."""
    for name, low, high in (("calibrated", 0.0, 0.1), ("table2", 0.85, 1.0)):
        case = _case(flown(name, "payload", **QUIET), "100 g")
        held = np.abs(case.run.p[case.run.t < lifting.WAIT][-1, [1, 3]]).max()
        share = held / _merit(case.merits, "largest sag after the pick")
        assert low < share < high


# Thermal


def test_the_lag_of_the_outer_loop(design: Design, flown: Flown) -> None:
    """An integrator with gain g every T follows a ramp of rate r by r T / g, read before it acts.

    That takes the mover to go where it is sent. `calibrated` does, within its integrals' time; table2 goes twice as
    far, which doubles the outer loop's gain and halves its lag.
    """
    found = flown(design.spec.name, "thermal")
    lag = _merit(found.merits, "lag if the mover goes where it is sent")
    assert lag == pytest.approx(65e-6 / 2.0 * 10e-3 / 0.5)
    assert _merit(found.merits, "the same at the true speed") == pytest.approx(lag / 30)
    run = found.cases[0].run
    outside = run.p[:, 2] + found.curves["drift"]
    read = outside[199::200][100:]  # what the laser sees, in the second half
    assert len(read) == 100
    gain = {"table2": 2.0, "calibrated": 1.0}[design.spec.name]
    assert read.mean() == pytest.approx(lag / gain, abs=0.05e-6)


def test_compensation_keeps_the_place_in_space(
    design: Design, flown: Flown, published: dict[str, Any]
) -> None:
    compensated, alone = flown(design.spec.name, "thermal").cases
    drift = published_value(published, "thermal.drift")
    label = "largest deviation in space"
    assert _merit(alone.merits, label) == pytest.approx(drift, abs=1e-6)
    assert _merit(compensated.merits, label) < 2e-6
    assert not alone.run.reference.any()
    # The reference goes against the drift: all the way, or half of it where the mover goes twice as far.
    asked = compensated.run.reference[-1, [0, 2]] * {"table2": 2.0, "calibrated": 1.0}[design.spec.name]
    assert asked == pytest.approx([-drift, -drift], rel=0.05)


def test_both_planes_move_alike(design: Design, flown: Flown) -> None:
    """The reference shifts x1 and x2 together: the mover does not tilt, nor move along y."""
    run = flown(design.spec.name, "thermal").cases[0].run
    assert np.array_equal(run.reference[:, 0], run.reference[:, 2])
    tilted = run.p[:, 0] - run.p[:, 2]
    assert abs(tilted.mean()) < 0.05e-6
    assert np.abs(tilted).max() < 1.2e-6
    assert np.abs(run.p[:, [1, 3]]).max() < 1.2e-6
    quiet = flown(design.spec.name, "thermal", **QUIET).cases[0].run
    assert np.abs(quiet.p[:, 0] - quiet.p[:, 2]).max() < 5e-9


def test_the_lag_grows_with_the_speed(flown: Flown) -> None:
    slow = flown("calibrated", "thermal", **QUIET)
    fast = flown("calibrated", "thermal", faster=60.0, **QUIET)
    left = []
    for found in (slow, fast):
        outside = found.run.p[:, 2] + found.curves["drift"]
        left.append(outside[len(outside) // 2 :].mean())
    assert left[1] / left[0] == pytest.approx(2.0, rel=0.03)
    assert len(fast.run.t) == 20_000


# Disturbance


@pytest.mark.slow_for("table2")
def test_simulated_sines_are_on_the_compliance_curve(design: Design, flown: Flown) -> None:
    """With windings, link and current controllers, which the linear loop has as well, to 0.1 %."""
    found = flown(design.spec.name, "disturbance")
    tones = found.curves["tones"]
    assert tones.tolist() == list(forces.TONES)
    curve = compliance(design.plant, design.controller, 2 * math.pi * tones)
    assert found.curves["simulated"] == pytest.approx(curve, rel=1e-3)


def test_compliance_ends_as_a_free_mass(design: Design) -> None:
    """At 1 and 2 kHz 1 / (m w^2); a force on the centre of gravity turns nothing."""
    w = 2 * math.pi * np.array([1000.0, 2000.0])
    found = compliance(design.plant, design.controller, w)
    assert found * design.plant.stroke.mass * w**2 == pytest.approx([1, 1], rel=0.005)
    assert compliance(design.plant, design.controller, w, output=2) == pytest.approx(found, rel=1e-3)
    assert compliance(design.plant, design.controller, w, output=4).max() < 1e-12 * found.max()
    along = compliance(design.plant, design.controller, w, output=4, wrench="F_z")
    assert along * design.plant.stroke.mass * w**2 == pytest.approx([1, 1], rel=0.005)


def test_compliance_begins_at_zero_as_the_integrals_say(design: Design) -> None:
    """Slowly, v = -K xi_hat + Ki e carries the force, and the observer takes p = 0 and v for motion: xi_hat = M v.

    So e = Ki^-1 (1 + K M) v with v = -F / 2 on both modules, and p = w e.
    """
    c = design.controller
    kept = np.eye(10) - c.L @ c.Cd
    M = np.linalg.solve(np.eye(10) - kept @ c.Ad, kept @ c.Bd)
    v = np.array([-0.5, 0, -0.5, 0, 0])
    e = np.linalg.solve(c.Ki, v + c.K @ (M @ v))
    w = np.array([1e-5, 1e-4])
    found = compliance(design.plant, design.controller, w)
    assert found == pytest.approx(w * abs(e[0]), rel=0.02)
    assert found[0] < 0.02 * compliance(design.plant, design.controller, np.array([10.0, 40.0])).max()


def test_the_largest_compliance_is_on_the_curve(design: Design, flown: Flown) -> None:
    found = flown(design.spec.name, "disturbance")
    worst = _merit(found.merits, "largest compliance, x1 to F_x")
    at = 2 * math.pi * _merit(found.merits, "at")
    around = compliance(design.plant, design.controller, at * np.array([0.9, 1.0, 1.1]))
    assert around[1] == pytest.approx(worst, rel=1e-9)
    assert around.max() <= worst * (1 + 1e-6)
    assert _merit(found.merits, "smallest dynamic stiffness") * worst == pytest.approx(1)
    expected = {"table2": 399e-6, "calibrated": 44.3e-6}[design.spec.name]
    assert worst == pytest.approx(expected, rel=0.01)


@pytest.mark.slow
def test_steps_are_the_linear_loops(design: Design, flown: Flown) -> None:
    case = flown(design.spec.name, "disturbance", **LINEAR).cases[0]
    assert case.label == "step of 1 N F_x"
    linear = np.abs(_pushed(design.model, design, "F_x", 1.0, 7600)[:, 0])
    deflection = _merit(case.merits, "largest deflection of x1")
    assert deflection == pytest.approx(linear.max(), rel=1e-3)
    assert _merit(case.merits, "left at the end") == pytest.approx(linear[-1], rel=1e-2)


def test_a_push_along_the_stroke_begins_as_a_free_mass(design: Design, flown: Flown) -> None:
    """F / m before anything answers. table2, next to no stiffness along z, drifts to the end stop."""
    case = flown(design.spec.name, "disturbance").cases[1]
    assert case.label == "step of 1 N F_z"
    run = case.run
    at = 400
    t = run.t[at : at + 41] - run.t[at]
    z = run.p[at : at + 41, 4] - run.p[at, 4]
    assert np.abs(run.p[: at + 1, 4]).max() < 1e-11
    assert z[10:21] == pytest.approx(t[10:21] ** 2 / (2 * design.plant.stroke.mass), rel=0.01)
    if design.spec.name == "table2":
        assert run.verdict.name == "axial end stop"
        free = math.sqrt(2 * 15e-3 * design.plant.stroke.mass)
        assert free < run.verdict.time - 0.02 < 1.1 * free
    else:
        assert run.verdict.completed
        assert _merit(case.merits, "left at the end") < 0.05 * _merit(case.merits, "largest deflection of z")


def test_steps_end_as_found(flown: Flown) -> None:
    """0.05 N m is 20 % of what the bearings' 5 A can do at l_B; table2 touches down with it.

    At either sensor plane: the mover tilts about its middle, and both are equally far.
    """
    ends = {
        name: [case.run.verdict.name.rstrip(" 12") for case in flown(name, "disturbance").cases]
        for name in ("table2", "calibrated")
    }
    assert ends == {
        "table2": ["completed", "axial end stop", "touchdown at sensor plane", "completed"],
        "calibrated": ["completed"] * 4,
    }
    assert not flown("table2", "disturbance").failed


def _shaken(t: FloatArray, size: float, mass: float) -> FloatArray:
    wrench = np.zeros((len(t), 6))
    wrench[:, 1] = size * mass * np.sin(2 * math.pi * 50 * t)
    return wrench


def test_vibration_is_linear_in_the_housings_acceleration(design: Design, flown: Flown) -> None:
    """m a on the mover; ten times the acceleration, ten times the motion; and m a times the compliance."""
    (case,) = [c for c in flown(design.spec.name, "disturbance").cases if "shaken" in c.label]
    found = _merit(case.merits, "amplitude of y1")
    w = np.array([2 * math.pi * 50])
    curve = compliance(design.plant, design.controller, w, output=1, wrench="F_y")
    assert found == pytest.approx(design.plant.stroke.mass * float(curve[0]), rel=2e-3)
    sizes = []
    for size in (1.0, 10.0):
        push = partial(_shaken, size=size, mass=design.plant.stroke.mass)
        scenario = Scenario("shaken", 0.3, references.hold, disturbance=push, **QUIET)
        run = simulate(design.plant, design.controller, scenario)
        sizes.append(float(np.abs(run.p[run.t > 0.2, 1]).max()))
    assert sizes[1] / sizes[0] == pytest.approx(10, rel=2e-3)
    assert sizes[0] == pytest.approx(found, rel=0.02)


# Faults


ENDS = {
    "one sample lost": True,
    "10 samples lost": True,
    "50 samples lost": True,
    "one control step missed": True,
    "10 control steps missed": True,
    "50 control steps missed": True,
    "y1 stuck for 5 ms": True,
    "y1 stuck": False,
    "y1 biased by 50 um": True,
    "noise of all sensors x 10": True,
    "phase 21_1 open": False,
    "DC link sags by 50 % for 50 ms": True,
    "DC link sags by 90 % for 50 ms": True,
}


@pytest.mark.slow_for("table2")
def test_what_survives_a_hold(design: Design, flown: Flown) -> None:
    """At rest the mover needs little of its sensors and of its link for a few milliseconds.

    It falls as e^(219 t): 1.7 times as far after 50 samples, of less than a micrometre. Lost for good, a sensor brings
    it down in tens of milliseconds, from noise alone.
    """
    found = flown(design.spec.name, "faults", during="hold")
    assert {case.label: case.run.verdict.completed for case in found.cases} == ENDS
    assert found.merits[0].value == 11
    assert not found.failed
    for case in found.cases:
        touched = _merit(case.merits, "touchdown after")
        if case.run.verdict.completed:
            assert math.isnan(touched)
        else:
            assert case.run.contact[:, :2].max() > 1
            assert 0.005 < touched < 0.25
            assert 0.5e-3 < _merit(case.merits, "largest deviation") < 0.63e-3
        if "lost" in case.label or "missed" in case.label or "sags" in case.label or "5 ms" in case.label:
            assert _merit(case.merits, "largest deviation") < 4e-6
            assert _merit(case.merits, "deviation at the end") < 1e-6


def test_before_it_strikes_a_fault_is_not_there(design: Design, flown: Flown) -> None:
    """Bit for bit what the same functions give when the fault never comes; after, not."""
    kinds: dict[str, dict[str, Any]] = {
        "listed": {"faults": (Fault("lost sample", 1.0),)},
        "phase": {"faults": (Fault("open phase", 1.0, what="i_11_1"),), "fidelity": "phase"},
        "noise": {},
    }
    real: dict[str, Any] = {"noise": 1.0, "quantize": True, "sensor_errors": {}, "bearing": True}
    whole = {
        kind: simulate(
            design.plant, design.controller, Scenario("faults", 0.3, references.hold, **(real | options))
        )
        for kind, options in kinds.items()
    }
    for case in flown(design.spec.name, "faults", during="hold").cases:
        kind = "phase" if "phase" in case.label else "noise" if "bias" in case.label else "listed"
        run, other = case.run, whole["noise" if "noise" in case.label else kind]
        assert np.array_equal(run.x[: STRUCK + 1], other.x[: STRUCK + 1]), case.label
        assert np.array_equal(run.y[:STRUCK], other.y[:STRUCK]), case.label
        # A reading may be lost that the steps of the sensors would have repeated anyhow, but not in z.
        assert not np.array_equal(run.x[STRUCK + 1 :], other.x[STRUCK + 1 :]), case.label


@pytest.mark.slow
def test_a_biased_sensor_moves_the_mover_as_the_linear_loop_does(design: Design, flown: Flown) -> None:
    """50 um too much in y1. Where the integrals are quick, y1 goes where the sensor shows zero, and y2 stays; without
    them, table2 makes eight times the bias of it."""
    stage = sampled_loop(design.model, design.controller, delay=1, current_loops="lag")
    step = np.vstack([stage.Bd @ stage.control.D_y, stage.control.B_y])[:, 1] * 50e-6
    state, trace = np.zeros(len(step)), np.empty((5000, 5))
    for k in range(5000):
        trace[k] = stage.Cd @ state[: len(stage.Ad)]
        state = stage.closed @ state + step
    linear = np.abs(trace[:, :4])
    case = _case(flown(design.spec.name, "faults", during="hold", **LINEAR), "y1 biased by 50 um")
    assert _merit(case.merits, "largest deviation") == pytest.approx(linear.max(), rel=1e-3)
    assert _merit(case.merits, "deviation at the end") == pytest.approx(linear[-1].max(), rel=1e-3)
    windings = _case(flown(design.spec.name, "faults", during="hold"), "y1 biased by 50 um")
    assert _merit(windings.merits, "largest deviation") == pytest.approx(linear.max(), rel=0.1)
    if design.spec.name == "calibrated":
        assert trace[-1, 1] == pytest.approx(-50e-6, rel=0.15)
        assert abs(trace[-1, 3]) < 5e-6
    else:
        assert 7 < linear[-1].max() / 50e-6 < 9


def test_noise_times_ten_is_ten_times_the_noise(design: Design, flown: Flown) -> None:
    run = _case(flown(design.spec.name, "faults", during="hold"), "noise of all sensors x 10").run
    noise = run.y - run.p
    before, after = noise[:STRUCK].std(axis=0), noise[STRUCK:].std(axis=0)
    steps = np.array(design.plant.sensors.resolution) / math.sqrt(12)
    assert before == pytest.approx(
        np.hypot(design.plant.sensors.noise, steps), rel=0.15
    )  # x1 rests in the middle of a step
    assert after == pytest.approx(np.hypot(10 * np.array(design.plant.sensors.noise), steps), rel=0.05)


def test_a_stuck_sensor_repeats_itself(design: Design, flown: Flown) -> None:
    found = flown(design.spec.name, "faults", during="hold")
    for label, samples in (("y1 stuck for 5 ms", 100), ("50 samples lost", 50), ("one sample lost", 1)):
        y = _case(found, label).run.y
        columns = [1] if "stuck" in label else [0, 1, 2, 3, 4]
        held = y[STRUCK : STRUCK + samples][:, columns]
        assert (held == y[STRUCK - 1, columns]).all()
        assert not np.array_equal(y[STRUCK + samples :][:50], np.tile(y[STRUCK - 1], (50, 1)))
    stuck = _case(found, "y1 stuck").run.y
    assert (stuck[STRUCK:, 1] == stuck[STRUCK - 1, 1]).all()


@pytest.mark.parametrize(("sag", "survives"), [(0.9, True), (0.98, False)])
def test_a_link_that_cannot_carry_the_weight_drops_the_mover(
    design: Design, sag: float, survives: bool
) -> None:
    """R m g / (2 K_B) = 0.75 V hold the weight: 10 % of 45 V have 2.25 V for it, 2 % have 0.45 V."""
    par: Any = design.plant.parameters
    held = par.R * par.m * par.g / (2 * par.K_B)
    assert (held < (1 - sag) * par.V_dc / 2) == survives
    fault = Fault("link sag", 0.05, 0.1, size=sag)
    scenario = Scenario("sag", 0.2, references.hold, faults=(fault,), bearing=True)
    run = simulate(design.plant, design.controller, scenario)
    assert run.verdict.completed == survives
    lowest = run.p[:, [1, 3]].min()
    assert lowest > -2e-6 if survives else lowest < -0.6e-3


def test_the_open_phase_of_the_list_carries_the_weight(designs: dict[str, Design], flown: Flown) -> None:
    """Windings 21 and 31 hold the mover up at z = 0; without one of them it falls in some 10 ms. 11 has no part in it:
    noise winds up the integrals that it leaves without a winding, and touchdown comes late."""
    design = designs["calibrated"]
    names = [s.name for s in design.plant.drive.phases]
    listed = _case(flown("calibrated", "faults", during="hold"), "phase 21_1 open").run
    carried = abs(listed.i_phase[STRUCK - 100, names.index("i_21_1")])
    assert carried == pytest.approx(
        design.plant.stroke.mass * 9.81 / 2 / 5.2 * math.sin(2 * math.pi / 3), rel=0.05
    )
    assert 0.005 < listed.verdict.time - 0.05 < 0.025
    assert np.abs(listed.i_phase[STRUCK + 10 :, names.index("i_21_1")]).max() < 1e-6
    idle = Scenario(
        "open",
        0.1,
        references.hold,
        faults=(Fault("open phase", 0.05, what="i_11_1"),),
        bearing=True,
        fidelity="phase",
    )
    assert simulate(design.plant, design.controller, idle).verdict.completed


def test_a_fault_during_the_stroke_is_harder_to_bear(design: Design, flown: Flown) -> None:
    """It strikes where the reference accelerates most; a link of a tenth then has no thrust and no levitation left."""
    moving, resting = (flown(design.spec.name, "faults", **o) for o in ({}, {"during": "hold"}))
    run = moving.cases[0].run
    acceleration = np.gradient(np.gradient(run.reference[:, 4], run.t), run.t)
    assert run.t[acceleration.argmax()] == pytest.approx(0.05, abs=0.2e-3)
    for label in ("50 samples lost", "50 control steps missed", "y1 stuck for 5 ms"):
        sizes = [_merit(_case(found, label).merits, "largest deviation") for found in (moving, resting)]
        assert sizes[0] > 1.5 * sizes[1]
    sag = "DC link sags by 90 % for 50 ms"
    assert _case(resting, sag).run.verdict.completed
    assert not _case(moving, sag).run.verdict.completed


# Drive limits


def test_the_fastest_stroke_stays_within_the_machine(design: Design, flown: Flown) -> None:
    """The plan keeps its shares of 5 A and 22.5 V; the simulated drive keeps the limits themselves."""
    found = flown(design.spec.name, "drive-limits")
    actuator, drive = design.plant.actuator, design.plant.drive
    assert not found.failed
    assert np.abs(found.curves["i"]).max() <= 0.8 * actuator.current_limit * (1 + 1e-6)
    assert np.abs(found.curves["u"]).max() <= 0.7 * actuator.voltage_limit * (1 + 1e-6)
    assert found.merits[0].value == pytest.approx(4.0)
    assert found.merits[1].value == pytest.approx(15.75)
    symbol = ca.SX.sym("u", len(drive.axes))
    peak = ca.Function("peak", [symbol], [drive.peak(symbol)])
    for case in found.cases:
        run = case.run
        assert np.abs(run.i).max() < actuator.current_limit
        assert np.abs(run.current).max() < actuator.current_limit
        phases = np.array(peak.map(len(run.u))(run.u.T)).max(axis=0)
        assert (phases <= run.link[:, 0] / 2 * (1 + 1e-9)).all()
        assert run.link.min() > 44.8


def test_the_fastest_stroke_is_faster(design: Design, flown: Flown) -> None:
    """By a quarter in rise, by more than half from end to end, for the same peak current."""
    found = flown(design.spec.name, "drive-limits")
    fastest, sigmoid = found.cases
    for label in ("reference: rise, 10-90 %", "rise, 10-90 %"):
        assert 1.15 < _merit(sigmoid.merits, label) / _merit(fastest.merits, label) < 1.3
    travel = [_merit(case.merits, "reference: 0.1 to 99.9 % of travel") for case in (fastest, sigmoid)]
    assert travel[1] / travel[0] == pytest.approx(_merit(found.merits, "travel, sigmoid over fastest"))
    assert travel[1] / travel[0] > 2
    assert travel[0] < _merit(found.merits, "fastest stroke, from rest to rest")
    # The sigmoid's 0.1 to 99.9 % is ln 999 / ln 9 of its rise, and its rise follows from the peak current.
    rise = _merit(sigmoid.merits, "reference: rise, 10-90 %")
    assert travel[1] == pytest.approx(rise * math.log(999) / math.log(9))
    par: Any = design.plant.parameters
    peak = 10e-3 * (2 * math.log(9) / rise) ** 2 / (6 * math.sqrt(3)) * par.m / (2 * par.K_D)
    assert peak == pytest.approx(4.0, rel=0.02)  # cogging is the rest
    # Faster than 2 sqrt(d / a) nothing is, with the force of the share.
    force = 0.8 * design.plant.actuator.force_limit[4]
    assert _merit(found.merits, "fastest stroke, from rest to rest") > 2 * math.sqrt(10e-3 * par.m / force)


def test_limit_merits_are_not_compared_with_the_paper(flown: Flown) -> None:
    for case in flown("calibrated", "drive-limits").cases:
        assert not any(merit.published for merit in case.merits)


def test_induced_voltage_per_speed_is_the_machines(plant: Plant, par: Any) -> None:
    assert induced_per_speed(plant) == pytest.approx(par.K_ind, rel=1e-12)


# By name


def _refused(design: Design, name: str, /, **options: Any) -> malta.InputError:
    with pytest.raises(malta.InputError) as caught:
        experiment(name, design.plant, design.controller, **options)
    error = caught.value
    assert str(error).isprintable()
    assert f"found {error.found}, expected {error.expected}" in str(error)
    return error


def test_what_an_experiment_does_not_take_is_refused(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    unknown = _refused(design, "jump")
    assert (unknown.where, unknown.field, unknown.found) == ("simulate", "scenario", "'jump'")
    assert unknown.expected == "one of " + ", ".join(EXPERIMENTS)
    for name, option in (("hold", "rise"), ("stroke", "masses"), ("tilt", "drift"), ("faults", "radius")):
        other = _refused(design, name, **{option: 1.0})
        assert (other.where, other.field) == ("simulate", f"{name}: {option}")
        assert "option" in other.found
    assert _refused(design, "hold", rise=1.0).expected == "none of its own"
    assert _refused(design, "thermal", rise=1.0).expected == "drift faster minute"
    for name in ("stroke", "hold", "lift-off", "faults"):
        wrong = _refused(design, name, fidelity="ideal")
        assert (wrong.where, wrong.field) == (f"scenario {name}", "fidelity")
        assert wrong.expected == "one of force, dq, phase"
        wrong = _refused(design, name, estimator="none")
        assert (wrong.field, wrong.found) == ("estimator", "'none'")
    assert _refused(design, "tilt", feedforward="all").field == "feedforward"
    assert _refused(design, "stroke", distance=0.0).field == "distance"
    assert _refused(design, "payload", masses=(-0.5,)).field == "m"
    assert _refused(design, "drive-limits", current_share=2.0).field == "current_share"
    for name, option, value in (
        ("tilt", "frequency", 0),
        ("tilt", "radius", math.nan),
        ("thermal", "faster", 0.0),
        ("payload", "masses", ()),
        ("stroke", "rise", "a"),
        ("hold", "noise", "a"),
        ("stroke", "reference", references.hold),
        ("hold", "foo", 1),
        ("faults", "during", "lunch"),
    ):
        assert option in _refused(design, name, **{option: value}).field
    assert _refused(design, "hold", foo=1).found == "an unknown option"


@pytest.mark.slow
def test_every_experiment_bears_its_name_and_tells_its_progress(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    for name in EXPERIMENTS:
        shares: list[float] = []
        options: dict[str, Any] = (
            {"estimator": "steady-state"} if name == "lift-off" else {}
        )  # others take seconds
        options |= {"points": 5} if name == "capture" else {}
        options |= {"only": "10"} if name == "supervised-faults" else {}
        options |= {"duration": 0.05} if name == "commissioning" else {}
        found = experiment(name, design.plant, design.controller, progress=shares.append, **options)
        assert found.name == name
        assert found.question.endswith("?")
        assert shares == sorted(shares)
        assert shares[-1] == pytest.approx(1.0)
        assert shares[0] > 0


@pytest.mark.slow
def test_options_reach_every_run(flown: Flown) -> None:
    for name in ("stroke", "hold", "tilt", "payload", "disturbance"):
        found = flown("calibrated", name, seed=5, fidelity="force")
        for case in found.cases:
            assert case.run.scenario.seed == 5
            assert case.run.scenario.fidelity == "force"
    assert [case.label for case in flown("calibrated", "tilt", feedforward="axial").cases] == [
        "feedforward axial"
    ]
    labels = [case.label for case in flown("calibrated", "lift-off", estimator="steady-state").cases]
    assert labels == ["steady-state"]


def _ended(run: Trajectory, name: str, time: float = 0.1) -> Case:
    return Case("a case", replace(run, verdict=Verdict(name, time)), ())


def test_failure_is_a_run_that_should_not_have_ended(flown: Flown) -> None:
    run = flown("calibrated", "stroke").run
    good, bad = _ended(run, "completed"), _ended(run, "touchdown at sensor plane 1", 0.0724)
    for name in EXPERIMENTS:
        finding = name in ("payload", "disturbance", "faults", "carrier", "capture", "supervised-faults")
        assert Experiment(name, "?", (good, bad), ()).failed is not finding
        assert not Experiment(name, "?", (good, good), ()).failed
    assert Experiment("stroke", "?", (good,), ()).outcome == "completed at 0.1 s"
    assert Experiment("stroke", "?", (bad,), ()).outcome == "touchdown at sensor plane 1 at 0.0724 s"
    two = Experiment("faults", "?", (good, bad, bad), ())
    assert two.outcome == "2 of 3 runs not completed (a case: touchdown at sensor plane 1 at 0.0724 s)"
    assert two.run is good.run
    assert not two.interrupted
    stopped = Experiment("hold", "?", (good,), (), interrupted=True)
    assert (stopped.failed, stopped.outcome) == (False, "interrupted after 1 runs")


class _Stop:
    """Ctrl-C when this share is done."""

    def __init__(self, share: float) -> None:
        self.share = share

    def __call__(self, share: float) -> None:
        if share >= self.share:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_ctrl_c_keeps_what_was_computed(
    designs: dict[str, Design], flown: Flown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules["malta.simulation.simulate"], "PORTION", 1000)  # samples between looks
    design = designs["calibrated"]
    for name, share, cases, samples in (
        ("hold", 0.45, 1, 4000),  # 8000 samples, stopped at the first look after 45 %
        ("thermal", 0.25, 1, 20_000),
        ("thermal", 0.75, 2, 20_000),
        ("payload", 0.6, 3, 6000),
        ("tilt", 0.7, 2, 8000),
    ):
        found = experiment(name, design.plant, design.controller, progress=_Stop(share))
        assert found.interrupted
        assert len(found.cases) == cases
        whole = flown("calibrated", name)
        for case, other in zip(found.cases[:-1], whole.cases, strict=False):
            assert case.run.verdict.completed
            assert np.array_equal(case.run.p, other.run.p)
            assert case.merits == other.merits
        run, other = found.cases[-1].run, whole.cases[cases - 1]
        assert run.verdict == Verdict("interrupted", run.t[-1])
        assert len(run.t) == samples
        series = (run.p, run.y, run.x, run.v, run.i, run.u, run.reference, run.contact, run.xi_hat, run.link)
        assert {len(part) for part in series} == {samples}
        assert np.array_equal(run.p, other.run.p[:samples])
        assert "interrupted at" in found.outcome
        assert [m.label for m in found.cases[-1].merits] == [m.label for m in other.merits]


def test_a_plan_of_other_design_data_is_flown_as_well(designs: dict[str, Design]) -> None:
    """The controller is known by its record alone: a lighter machine flies the same experiment."""
    design = designs["calibrated"]
    lighter = plant_of(replace(design.spec.parameters, m=0.33))
    found = experiment("stroke", lighter, design.controller)
    assert not found.failed
    assert found.run.plant.stroke.mass == pytest.approx(0.33)
    assert _merit(found.merits, "axial error") < 0.6e-3
