"""Figures of a design that the claims on MALTA are about: from its experiments, margins and model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from malta.campaigns.run import Yields, main_campaign, yields_of
from malta.loops.loop import loop_of_model
from malta.loops.time_domain import PLACES, Deviation, noise_of, recovery
from malta.machines.tubular.experiments.disturbances import hold
from malta.machines.tubular.experiments.strokes import delayed_stroke
from malta.margins.loop_report import LoopReport
from malta.margins.verify import compensators
from malta.model.data import published_value
from malta.model.linearize import LinearModel, linearize
from malta.proof.parametric_plants import of_plant
from malta.proof.robust import robust_margin
from malta.report.ledger import Chance, proven_share, run_design
from malta.simulation.current_control import link_voltage, open_loop_gain
from malta.simulation.engine.compiled import compiler
from malta.simulation.experiments import Experiment, Progress
from malta.simulation.experiments.bounds import flown_payload, held_payload, largest_mass
from malta.simulation.experiments.catalogue import experiment
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import StrokeFigures, stroke_figures
from malta.synthesis.controller import Controller
from malta.synthesis.lqg import lqr
from malta.synthesis.riccati import add_integrals
from malta.synthesis.spec import Spec
from malta.synthesis.tunable_lqg import calibrate

if TYPE_CHECKING:
    from malta.campaigns.result import Rate
    from malta.model.plant import FloatArray, Plant


EXPERIMENT_NAMES = ("stroke", "hold", "tilt", "thermal")
MACHINES, FEW = 1_000, 200  # of the yields, with and without a C compiler
FEWER = 0.5  # share of them that fly without rest before, and with more feedforward
PUSH = 1.8  # of the inertia: what the heaviest machines with the weakest drive lack, within the error of the others
SEEDS = 16  # of rests: the motion of a slow design moves by a fifth from one to the next
NOISY, FLIGHTS = ("tilt", "thermal"), 5  # experiments whose figures are means over seeds; how many
IMPLIED_RATIO = 4.0  # K1 / k at which the LQR stands the published 300 % of a 20 % box


@dataclass(frozen=True, eq=False)
class Evidence:
    """A design, its margins, its experiments and some more runs for the claims."""

    spec: Spec
    model: LinearModel
    controller: Controller
    margins: LoopReport
    K: FloatArray | None  # gain of the LQR without integrals; None: a PID
    experiments: Mapping[str, Experiment]
    uncompensated: StrokeFigures  # of the stroke with cogging left out of v0(z)
    braked: float  # m/s, published speed from which the mover is braked into the DC link
    growth: float  # m, thermal growth of the published arm
    published: Mapping[str, Any]
    strokes: Strokes  # of MACHINES that differ, after SETTLE at rest
    unsettled: Strokes  # of fewer, from the first sample on
    pushed: Strokes  # of fewer, with PUSH times the inertia fed forward
    rests: Mapping[str, Chance]  # figures of merit of the hold: root mean squares over SEEDS
    flights: Mapping[tuple[str, int], Chance]  # first figures of the cases of NOISY: means over FLIGHTS seeds


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> Evidence:
    """Design a controller, prove its margins and run the experiments, and a stroke without cogging in v0(z)."""
    plant = spec.plant
    model, controller, margins, experiments = run_design(spec, EXPERIMENT_NAMES, progress)
    v0 = controller.feedforward.v0.copy()
    v0[:, plant.thrust_input] = 0
    without = replace(controller, feedforward=replace(controller.feedforward, v0=v0))
    slow = simulate(plant, without, Scenario("stroke", 0.4, partial(delayed_stroke, wait=0.0)))
    machines = MACHINES if compiler() else FEW
    return Evidence(
        spec,
        model,
        controller,
        margins,
        lqr(model, spec.weights) if spec.kind == "LQG" else None,
        experiments,
        stroke_figures(slow),
        published_value(published, "dc_link.speed"),
        published_value(published, "thermal.length") * published_value(published, "thermal.strain"),
        published,
        fly_strokes(controller, spec, published, machines=machines, settle=True),
        fly_strokes(controller, spec, published, machines=round(FEWER * machines), settle=False),
        fly_strokes(
            with_inertia(controller, PUSH), spec, published, machines=round(FEWER * machines), settle=True
        ),
        rests_of_seeds(plant, controller, range(SEEDS)),
        flights_of_seeds(plant, controller, range(FLIGHTS)),
    )


class Strokes(NamedTuple):
    """Strokes of many machines: yields, and the largest radial deviation of each that completed it, m."""

    yields: Yields
    median: float
    largest: float


def with_inertia(controller: Controller, factor: float) -> Controller:
    """The controller that feeds forward so many times the inertia: the same loop, another reference of forces."""
    old = controller.feedforward
    return replace(controller, feedforward=replace(old, inertia=factor * np.asarray(old.inertia)))


def fly_strokes(
    controller: Controller, spec: Spec, published: Mapping[str, Any], *, machines: int, settle: bool
) -> Strokes:
    """The strokes of machines drawn from the design's uncertainty, after a rest or from the first sample on."""
    flown = main_campaign(controller, spec, machines, settle=settle)
    axis = spec.plant.stroke_output
    radial = np.delete(flown.batch.deviation[flown.completed], axis, axis=1).max(axis=1)
    return Strokes(yields_of(flown, published, spec), float(np.median(radial)), float(radial.max()))


def mean_of_seeds(values: Sequence[float]) -> Chance:
    """The mean of one value for each seed, with Student's interval."""
    scatter = float(np.std(values, ddof=1)) / math.sqrt(len(values))
    return Chance(float(np.mean(values)), float(stdtrit(len(values) - 1, 0.975)) * scatter)


def rests_of_seeds(plant: Plant, controller: Controller, seeds: Sequence[int]) -> dict[str, Chance]:
    """The figures of merit of rests with other noise, by their labels: root mean squares over the seeds."""
    each = [{m.label: m.value for m in hold(plant, controller, seed=seed).merits} for seed in seeds]
    squares = {label: mean_of_seeds([one[label] ** 2 for one in each]) for label in each[0]}
    roots = {label: math.sqrt(square) for label, square in squares.items()}
    return {
        label: Chance(root, squares[label].half / (2 * root) if root else 0.0)
        for label, root in roots.items()
    }


def flights_of_seeds(
    plant: Plant, controller: Controller, seeds: Sequence[int]
) -> dict[tuple[str, int], Chance]:
    """The first figure of each case of NOISY, by experiment and case: means over the seeds."""
    found: dict[tuple[str, int], Chance] = {}
    for name in NOISY:
        flown = [experiment(name, plant, controller, seed=seed).cases for seed in seeds]
        for case in range(len(flown[0])):
            found[name, case] = mean_of_seeds([cases[case].merits[0].value for cases in flown])
    return found


def pole(name: str, e: Evidence) -> float:
    """Square root of a diagonal element of the stiffness, by its position's name, rad/s."""
    names = [s.name for s in e.model.plant.design_states]
    return math.sqrt(max(float(e.model.stiffness.diagonal()[names.index(name)]), 0.0))


def pole_change(e: Evidence) -> float:
    """Relative change of the fastest open-loop pole from the middle to the end of the travel."""
    plant = e.model.plant
    middle, end = (
        np.linalg.eigvals(linearize(plant, plant.at(z=z)).A).real.max() for z in (0.0, plant.travel)
    )
    return float(end / middle - 1)


def stiffness_ratio(e: Evidence) -> float:
    """Stiffness of the LQR along x over that of the attraction; NaN for a PID."""
    if e.K is None:
        return math.nan
    half = len(e.model.stiffness)
    return float((e.model.force_map @ e.K[:, :half])[0, 0] / e.model.stiffness[0, 0])


def is_solved_for_ratio(e: Evidence) -> bool:
    """Whether the bases of a design are those that `calibrate` solves for K1 / k = IMPLIED_RATIO."""
    if e.spec.kind != "LQG":
        return False
    plant = e.model.plant
    solved = calibrate(linearize(plant, plant.at()), e.spec.weights, IMPLIED_RATIO).q_base
    half = len(solved) // 2
    radial = [k for k, s in enumerate(plant.design_states[:half]) if s.name != plant.stroke]
    return bool(np.allclose(e.spec.weights.q_base[radial], solved[radial], rtol=1e-4))


def full_state_share(e: Evidence) -> float:
    """Proven margin of the LQR with all states measured, as a share of the design's uncertainty; NaN for a PID."""
    if e.K is None:
        return math.nan
    law, states = compensators(e.model.plant, e.controller)["LQR"]
    system = of_plant(e.model.plant, list(e.spec.uncertainty), at=e.spec.operating_point, states=states)
    return proven_share(robust_margin(system, law, e.spec.uncertainty))


def slowest_radial(e: Evidence) -> float:
    """The slowest pole of the regulator with integrals in which x1 takes part, rad/s; NaN for a PID."""
    if e.K is None:
        return math.nan
    A, B = add_integrals(e.controller.Ad, e.controller.Bd, e.controller.Cd, e.controller.sample_time)
    values, shapes = np.linalg.eig(A - B @ np.hstack([e.controller.K, -e.controller.Ki]))
    part = np.abs(shapes[len(e.controller.Ad)]) > 1e-9 * np.abs(shapes).max(axis=0)
    return float((np.log(values[part]) / e.controller.sample_time).real.max())


def axial_deviation(e: Evidence) -> Deviation:
    """What a constant 1 N along z from outside does to z: the sampled loop under its loads, at the operating point."""
    plant = e.model.plant
    (pushed,) = recovery(plant, e.controller, {"axial": {"F_z": 1.0}})
    return pushed.outputs[plant.stroke_output]


def current_loop_margin(e: Evidence) -> tuple[float, float]:
    """Crossover, rad/s, and phase margin, rad, of the current loop with the gain file's Kp and Ki."""
    loop, actuator = e.controller.current_loop, e.model.plant.actuator
    if loop is None:
        return math.nan, math.nan
    delay = actuator.loop_delay if e.spec.current_loop_delay else 0.0

    def gain(w: float) -> complex:
        return complex(open_loop_gain(actuator, loop.Kp, loop.Ki, delay, np.array([w]))[0])

    crossover = float(brentq(lambda w: abs(gain(w)) - 1, 1.0, 1e5))
    return crossover, math.pi + float(np.angle(gain(crossover)))


def link_rise(e: Evidence) -> float:
    """Rise of the DC link's voltage, V, when the mover is braked from the published speed."""
    par: Any = e.spec.parameters
    return float(link_voltage(par.V_dc, par.C_dc, par.m * e.braked**2 / 2) - par.V_dc)


def yield_share(kind: str, strokes: str, e: Evidence) -> Chance:
    """A share of the machines that differ, by a field of Yields; NaN without bounds.

    strokes : "strokes", "unsettled" or "pushed"
    """
    found: Rate | None = getattr(getattr(e, strokes).yields, kind)
    return Chance(math.nan, math.nan) if found is None else Chance(found.share, (found.high - found.low) / 2)


def published_stroke(e: Evidence) -> StrokeFigures:
    """Figures of the stroke of Fig. 12."""
    return stroke_figures(e.experiments["stroke"].run)


def stroke_across(e: Evidence) -> float:
    """Largest deviation of x1 and x2 during the stroke, m."""
    return max(published_stroke(e).radial[name] for name in ("x1", "x2"))


def carried_weight(e: Evidence) -> float:
    """Sum of the vertical bearing forces at the end of the stroke, N."""
    v = e.experiments["stroke"].run.v[-1]
    return float(v[1] + v[3])


def precise_payload(known: bool, e: Evidence) -> float:
    """The largest payload, kg, with which the stroke keeps the bounds of Figs 12 and 13, by bisection.

    known : the controller feeds its weight and inertia forward
    """
    bounds = {
        "stroke: overshoot": published_value(e.published, "figure_12.overshoot"),
        "stroke: axial error": published_value(e.published, "figure_12.axial_error"),
        "stroke: radial deviation": published_value(e.published, "figure_13.radial_deviation"),
    }
    plant, controller = e.model.plant, e.controller

    def kept(mass: float) -> bool:
        (case,) = experiment("payload", plant, controller, masses=(mass,), known=known).cases
        within = (merit.value <= bounds.get(merit.label, math.inf) for merit in case.merits)
        return bool(case.run.verdict.completed and all(within))

    return largest_mass(kept, held_payload(plant))[0]


def carried_payload(e: Evidence) -> float:
    """The largest payload, kg, that is picked, carried and moved without touchdown, by bisection."""
    plant = e.model.plant
    return flown_payload(plant, e.controller, held_payload(plant))[0]


def true_radial(e: Evidence) -> Chance:
    """Largest rms of the true radial motion at rest, m."""
    return max(e.rests[f"true {name}, rms"] for name in ("x1", "y1", "x2", "y2"))


def measured_at_rest(name: str, e: Evidence) -> Chance:
    """Standard deviation of an output's measurements at rest, m."""
    return e.rests[f"measured {name}, std"]


def mean_at_rest(name: str, e: Evidence) -> Chance:
    """Size of the mean of an output's measurements at rest, m."""
    return e.rests[f"measured {name}, mean"]


def noise_forces(e: Evidence) -> tuple[float, float]:
    """Rms of the worst commanded bearing force and of the thrust at rest, N: covariance of the linear loop."""
    plant = e.model.plant
    force = noise_of(loop_of_model(e.model, e.controller).sampled, plant).force
    return float(np.delete(force, plant.thrust_input).max()), float(force[plant.thrust_input])


def load_deviation(name: str, after: float | None, e: Evidence) -> float:
    """How far a load of LOADS moves an output, m: at most, or from `after` (s) on; at the operating point."""
    plant, par = e.model.plant, e.spec.parameters
    load = {key: size(par) for key, size in LOADS[name].items()}
    (found,) = recovery(plant, e.controller, {name: load}, after=() if after is None else (after,))
    return max(d.largest if after is None else d.left[0] for d in found.outputs)


# N and N m by disturbance, of the parameters: 1 N at a point of the mover.
LOADS: dict[str, dict[str, Callable[[Any], float]]] = {
    "centre of gravity": {"F_x": lambda _: 1.0},
    "bearing": {"F_x": lambda _: 1.0, "T_y": lambda par: par.l_B},
}


def axis_coupling(e: Evidence) -> float:
    """What a bearing's force does to the other bearing's sensor, over what the other's own does; worst of the travel.

    Accelerations C B of the linear model, without attraction: both are the larger, the faster the motion.
    """
    plant, worst = e.model.plant, 0.0
    for z in np.linspace(-plant.travel, plant.travel, PLACES):
        model = linearize(plant, plant.at(z=float(z)))
        half = len(model.A) // 2
        moved = np.abs(model.C[:, :half] @ model.force_map)
        own = np.diag(moved)
        worst = max(worst, float((moved / own[:, None] - np.eye(half)).max()))
    return worst
