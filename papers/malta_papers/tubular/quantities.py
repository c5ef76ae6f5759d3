"""Figures of a design that the claims on MALTA are about: from its experiments, margins and model."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import brentq
from scipy.special import stdtrit

from malta import (
    CheckError,
    InputError,
    Scenario,
    Spec,
    campaign,
    experiment,
    learn,
    linearize,
    plant_of,
    read,
    robust_margin,
    simulate,
    uncertain,
)
from malta.campaigns import Plan
from malta.campaigns.result import rate, yields_of
from malta.campaigns.run import replay
from malta.files import shipped_path
from malta.identification import log_of
from malta.loops import recovery
from malta.machines.tubular.drive import AXES, to_axes
from malta.machines.tubular.experiments.disturbances import hold
from malta.machines.tubular.experiments.strokes import SETTLE, delayed_stroke, stroke_merits
from malta.margins import LoopReport
from malta.model import LinearModel
from malta.model.printed import published_value
from malta.proof import Compensator
from malta.simulation import Experiment, Trajectory, stroke_figures
from malta.simulation.current_control import link_voltage, open_loop_gain
from malta.simulation.engine.compiled import compiler
from malta.simulation.experiments import Progress
from malta.simulation.experiments.payloads import flown_payload, held_payload, largest_mass
from malta.synthesis import Controller, calibrate, lqr
from malta.synthesis.feedforward import static_feedforward
from malta_papers.ledger import Chance, bandwidth, proven_share, run_design

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.campaigns.result import Rate, Yields
    from malta.loops.time_domain import Deviation
    from malta.machines.tubular.parameters import Parameters
    from malta.model import Plant
    from malta.simulation.flown_strokes import StrokeFigures

EXPERIMENT_NAMES = ("stroke", "hold", "tilt", "thermal")
MACHINES, SAMPLE = 1_000, 200  # of the yields, with and without a C compiler
FEWER_SHARE = 0.5  # share of them that fly without rest before, and with more feedforward
PUSH = 1.8  # of the inertia: what the heaviest machines with the weakest drive lack, within the error of the others
PLACES = 9  # along the travel
SEEDS = 16  # of rests: the motion of a slow design moves by a fifth from one to the next
NOISY_RUNS, FLIGHTS = ("tilt", "thermal"), 5  # experiments whose figures are means over seeds; how many
IMPLIED_RATIO = 4.0  # K1 / k at which the LQR stands the published 300 % of a 20 % box


@dataclass(frozen=True, eq=False)
class TubularEvidence:
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
    noisy: Mapping[str, Chance]  # the same, with the current sensors' noise of Table II(a)
    flights: Mapping[
        tuple[str, int], Chance
    ]  # first figures of the cases of NOISY_RUNS: means over FLIGHTS seeds


def evidence(spec: Spec, published: Mapping[str, Any], progress: Progress | None = None) -> TubularEvidence:
    """Design a controller, prove its margins and run the experiments, and a stroke without cogging in v0(z)."""
    plant = spec.plant
    model, controller, margins, experiments = run_design(spec, EXPERIMENT_NAMES, progress)
    v0 = controller.feedforward.v0.copy()
    v0[:, plant.thrust_input] = 0
    without = replace(controller, feedforward=replace(controller.feedforward, v0=v0))
    slow = simulate(plant, without, Scenario("stroke", 0.4, partial(delayed_stroke, wait=0.0)))
    machines = MACHINES if compiler() else SAMPLE
    fewer = round(FEWER_SHARE * machines)
    return TubularEvidence(
        spec,
        model,
        controller,
        margins,
        lqr(model, spec.weights, solver="scipy") if spec.kind == "LQG" else None,
        experiments,
        stroke_figures(slow),
        published_value(published, "dc_link.speed"),
        published_value(published, "thermal.length") * published_value(published, "thermal.strain"),
        published,
        fly_strokes(controller, spec, published, machines=machines, settle=True),
        fly_strokes(controller, spec, published, machines=fewer, settle=False),
        fly_strokes(with_inertia(controller, PUSH), spec, published, machines=fewer, settle=True),
        rests_of_seeds(plant, controller, range(SEEDS)),
        rests_of_seeds(with_noise_of_currents(plant), controller, range(SEEDS)),
        flights_of_seeds(plant, controller, range(FLIGHTS)),
    )


def with_noise_of_currents(plant: Plant) -> Plant:
    """The plant with current sensors as noisy as Table II(a) asks for."""
    noise = read(shipped_path("data", "tubular.toml"), "table1_currents").s_i
    return plant_of(replace(plant.parameters, s_i=noise))


def current_reading(axis: str, modules: int, e: TubularEvidence) -> float:
    """Variance of the force, N^2, that the readings of an axis of AXES stand for while a current is held.

    K^2 |row of (16)|^2 s_i^2 mean |S|^2: a sensor reads its noise and what the sampled current loop makes of it.

    modules : whose thrust constant K_D stands for the reading together; 0: that of a bearing, K_B
    """
    par: Any = with_noise_of_currents(e.spec.plant).parameters
    loop, Ts = e.controller.current_loop, e.controller.sample_time
    assert loop is not None
    z, pole = np.exp(1j * np.pi * (np.arange(4000) + 0.5) / 4000), math.exp(-par.R * Ts / par.L)
    open_loop = (loop.Kp + loop.Ki * Ts * z / (z - 1)) * (1 - pole) / par.R / (z * (z - pole))
    row = np.array(ca.evalf(to_axes(ca.MX(0.0))))[AXES.index(axis)]
    constant = modules * par.K_D if modules else par.K_B
    return float((constant * par.s_i) ** 2 * (row @ row) * np.mean(np.abs(1 / (1 + open_loop)) ** 2))


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
    """The strokes of machines drawn from the design's uncertainty, after a rest or from the first sample on.

    Raises KeyboardInterrupt where Ctrl-C cut the campaign short.
    """
    flown = campaign(plan_of(controller, spec, machines, settle=settle))
    if flown.interrupted:
        raise KeyboardInterrupt
    axis = spec.plant.stroke_output
    radial = np.delete(flown.batch.deviation[flown.completed], axis, axis=1).max(axis=1)
    return Strokes(yields_of(flown, published, spec), float(np.median(radial)), float(radial.max()))


def plan_of(controller: Controller, spec: Spec, machines: int, *, settle: bool) -> Plan:
    """Strokes of machines drawn at random from the design's uncertainty, after a rest or from the first sample on."""
    options = {"settle": SETTLE} if settle else {}
    return Plan(controller, "stroke", dict(spec.uncertainty), samples=machines, options=options)


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
    """The first figure of each case of NOISY_RUNS, by experiment and case: means over the seeds."""
    found: dict[tuple[str, int], Chance] = {}
    for name in NOISY_RUNS:
        flown = [experiment(name, plant, controller, seed=seed).cases for seed in seeds]
        for case in range(len(flown[0])):
            found[name, case] = mean_of_seeds([cases[case].merits[0].value for cases in flown])
    return found


def pole(name: str, e: TubularEvidence) -> float:
    """Square root of a diagonal element of the stiffness, by its position's name, rad/s."""
    names = [s.name for s in e.model.plant.design_states]
    return math.sqrt(max(float(e.model.stiffness.diagonal()[names.index(name)]), 0.0))


def pole_change(e: TubularEvidence) -> float:
    """Relative change of the fastest open-loop pole from the middle to the end of the travel."""
    plant = e.model.plant
    middle, end = (
        np.linalg.eigvals(linearize(plant, plant.at(z=z)).A).real.max() for z in (0.0, plant.stroke.travel)
    )
    return float(end / middle - 1)


def stiffness_ratio(e: TubularEvidence) -> float:
    """Stiffness of the LQR along x over that of the attraction; NaN for a PID."""
    if e.K is None:
        return math.nan
    half = len(e.model.stiffness)
    return float((e.model.force_map @ e.K[:, :half])[0, 0] / e.model.stiffness[0, 0])


def is_solved_for_ratio(e: TubularEvidence) -> bool:
    """Whether the bases of a design are those that `calibrate` solves for K1 / k = IMPLIED_RATIO."""
    if e.spec.kind != "LQG":
        return False
    plant = e.model.plant
    solved = calibrate(linearize(plant, plant.at()), e.spec.weights, IMPLIED_RATIO).q_base
    half = len(solved) // 2
    radial = [k for k, s in enumerate(plant.design_states[:half]) if s.name != plant.stroke.name]
    return bool(np.allclose(e.spec.weights.q_base[radial], solved[radial], rtol=1e-4))


def full_state_share(e: TubularEvidence) -> float:
    """Proven margin of the LQR with all states measured, as a share of the design's uncertainty; NaN for a PID."""
    if e.K is None:
        return math.nan
    m, p, n = len(e.K), len(e.model.C), e.K.shape[1]
    fed_back = np.hstack([np.zeros((m, p)), -e.K])  # of [y, x]
    law = Compensator(np.zeros((0, 0)), np.zeros((0, p + n)), np.zeros((m, 0)), fed_back)
    system = uncertain(
        e.model.plant, list(e.spec.uncertainty), at=e.spec.operating_point, states=True, loaded=False
    )
    return proven_share(robust_margin(system, law, e.spec.uncertainty))


def slowest_radial(e: TubularEvidence) -> float:
    """The slowest pole of the regulator with integrals in which x1 takes part, rad/s; NaN for a PID."""
    if e.K is None:
        return math.nan
    Ad, Bd, summed = e.controller.Ad, e.controller.Bd, -e.controller.sample_time * e.controller.Cd
    A = np.block([[Ad, np.zeros(summed.T.shape)], [summed @ Ad, np.eye(len(summed))]])
    B = np.vstack([Bd, summed @ Bd])
    values, shapes = np.linalg.eig(A - B @ np.hstack([e.controller.K, -e.controller.Ki]))
    part = np.abs(shapes[len(e.controller.Ad)]) > 1e-9 * np.abs(shapes).max(axis=0)
    return float((np.log(values[part]) / e.controller.sample_time).real.max())


def axial_deviation(e: TubularEvidence) -> Deviation:
    """What a constant 1 N along z from outside does to z: the sampled loop under its loads, at the operating point."""
    plant = e.model.plant
    (pushed,) = recovery(plant, e.controller, {"axial": {"F_z": 1.0}})
    return pushed.outputs[plant.stroke_output]


def current_loop_margin(e: TubularEvidence) -> tuple[float, float]:
    """Crossover, rad/s, and phase margin, rad, of the current loop with the gain file's Kp and Ki."""
    loop, actuator = e.controller.current_loop, e.model.plant.actuator
    if loop is None:
        return math.nan, math.nan
    delay = actuator.loop_delay if e.spec.current_loop_delay else 0.0

    def gain(w: float) -> complex:
        return complex(open_loop_gain(actuator, loop.Kp, loop.Ki, delay, np.array([w]))[0])

    crossover = float(brentq(lambda w: abs(gain(w)) - 1, 1.0, 1e5))
    return crossover, math.pi + float(np.angle(gain(crossover)))


def link_rise(e: TubularEvidence) -> float:
    """Rise of the DC link's voltage, V, when the mover is braked from the published speed."""
    par: Any = e.spec.parameters
    return float(link_voltage(par.V_dc, par.C_dc, par.m * e.braked**2 / 2) - par.V_dc)


def yield_share(kind: str, strokes: str, e: TubularEvidence) -> Chance:
    """A share of the machines that differ, by a field of Yields; NaN without bounds.

    strokes : "strokes", "unsettled" or "pushed"
    """
    found: Rate | None = getattr(getattr(e, strokes).yields, kind)
    return Chance(math.nan, math.nan) if found is None else Chance(found.share, (found.high - found.low) / 2)


def machine_deviation(which: str, strokes: str, e: TubularEvidence) -> float:
    """A radial deviation of machines that differ, m; `which` and `strokes` are fields of Strokes and of Evidence."""
    found: float = getattr(getattr(e, strokes), which)
    return found


def published_stroke(e: TubularEvidence) -> StrokeFigures:
    """Figures of the stroke of Fig. 12."""
    return stroke_figures(e.experiments["stroke"].run)


def stroke_across(e: TubularEvidence) -> float:
    """Largest deviation of x1 and x2 during the stroke, m."""
    return max(published_stroke(e).radial[name] for name in ("x1", "x2"))


def stroke_speed(e: TubularEvidence) -> float:
    """Largest axial speed during the stroke, m/s."""
    plant = e.model.plant
    rate = len(plant.states) // 2 + plant.stroke_state
    return float(np.abs(e.experiments["stroke"].run.x[:, rate]).max())


def cogging_share(e: TubularEvidence) -> float:
    """The cogging of two like modules 2 l_B apart over twice one's, of period L_p: |cos(2 pi l_B / L_p)|."""
    par: Any = e.spec.parameters
    return abs(math.cos(2 * math.pi * par.l_B / par.L_p))


def carried_weight(run: Trajectory) -> float:
    """Sum of the vertical bearing forces at the end of a run, N."""
    return float(run.v[-1, 1] + run.v[-1, 3])


def precise_payload(known: bool, e: TubularEvidence) -> float:
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


def carried_payload(e: TubularEvidence) -> float:
    """The largest payload, kg, that is picked, carried and moved without touchdown, by bisection."""
    plant = e.model.plant
    return flown_payload(plant, e.controller, held_payload(plant))[0]


def true_radial(e: TubularEvidence) -> Chance:
    """Largest rms of the true radial motion at rest, m."""
    return max(e.rests[f"true {name}, rms"] for name in ("x1", "y1", "x2", "y2"))


def at_rest(rests: str, label: str, e: TubularEvidence) -> Chance:
    """A figure of merit of the hold by its label, m; `rests` is the field of Evidence, with or without noise."""
    found: Chance = getattr(e, rests)[label]
    return found


def noise_forces(e: TubularEvidence) -> tuple[float, float]:
    """Rms of the worst commanded bearing force and of the thrust at rest, N: covariance of the linear loop."""
    plant = e.model.plant
    assert e.margins.noise is not None  # the loop is stable
    force = e.margins.noise.force
    return float(np.delete(force, plant.thrust_input).max()), float(force[plant.thrust_input])


def load_deviation(name: str, after: float | None, e: TubularEvidence) -> float:
    """How far a load of LOADS moves an output, m: at most, or from `after` (s) on; at the operating point."""
    found = _load_answers(name, after, e)
    return max(d.largest if after is None else d.left[0] for d in found)


def any_load_deviation(name: str, e: TubularEvidence) -> float:
    """How far any waveform of a load of LOADS moves an output at most, m; at the operating point."""
    return max(d.any_waveform for d in _load_answers(name, None, e))


def _load_answers(name: str, after: float | None, e: TubularEvidence) -> list[Deviation]:
    """What a load of LOADS does to the outputs, along x and along y."""
    plant, par = e.model.plant, e.spec.parameters
    loads = {
        axis: {key: size(par) for key, size in load.items()}
        for axis, load in zip("xy", LOADS[name], strict=True)
    }
    found = recovery(plant, e.controller, loads, after=() if after is None else (after,))
    return [d for one in found for d in one.outputs]


# N and N m by disturbance, of the parameters: 1 N at a point of the mover, along x and along y.
LOADS: dict[str, tuple[dict[str, Callable[[Any], float]], ...]] = {
    "centre of gravity": ({"F_x": lambda _: 1.0}, {"F_y": lambda _: 1.0}),
    "bearing": (
        {"F_x": lambda _: 1.0, "T_y": lambda par: par.l_B},
        {"F_y": lambda _: 1.0, "T_x": lambda par: -par.l_B},
    ),
}


def axis_coupling(e: TubularEvidence) -> float:
    """What a bearing's force does to the other bearing's sensor, over what the other's own does; worst of the travel.

    Accelerations C B of the linear model, without attraction: both are the larger, the faster the motion.
    """
    plant, worst = e.model.plant, 0.0
    for z in np.linspace(-plant.stroke.travel, plant.stroke.travel, PLACES):
        model = linearize(plant, plant.at(z=float(z)))
        half = len(model.A) // 2
        moved = np.abs(model.C[:, :half] @ model.force_map)
        own = np.diag(moved)
        worst = max(worst, float((moved / own[:, None] - np.eye(half)).max()))
    return worst


def bandwidth_over_pole(definition: str, e: TubularEvidence) -> float:
    """The bandwidth by one of the definitions in BANDWIDTHS over the largest unstable pole of the design model."""
    return bandwidth(definition, e) / float(e.model.sys.poles().real.max())


def braking_power(e: TubularEvidence) -> float:
    """Mechanical power, W, at the published speed and the force limit of the thrust; no losses, as in the paper."""
    actuator = e.model.plant.actuator
    return actuator.force_limit[e.model.plant.thrust_input] * e.braked


def braking_resistance(e: TubularEvidence) -> float:
    """The largest resistance, ohm, that takes the braking power at the link voltage after the published rise."""
    return (e.spec.plant.drive.link_voltage + link_rise(e)) ** 2 / braking_power(e)


def capacitance_beside_brake(e: TubularEvidence) -> float:
    """The capacitance, F, in which the energy of one control period makes the published rise.

    C ((V + rise)^2 - V^2) / 2 = P Ts: the resistor is switched on at the sample after the link rises above V.
    """
    V, rise = e.spec.plant.drive.link_voltage, link_rise(e)
    return 2 * braking_power(e) * e.controller.sample_time / ((V + rise) ** 2 - V**2)


@lru_cache(maxsize=8)  # several rows need it; records of evidence compare by identity
def _capture_merits(e: TubularEvidence) -> dict[str, float]:
    """Figures of merit of the experiment capture, SI, with the smallest maps; none without a C compiler."""
    if compiler() is None:
        return {}
    found = experiment("capture", e.spec.plant, e.controller, points=3)
    return {merit.label: merit.value for merit in found.merits}


def capture_merit(label: str, e: TubularEvidence) -> float:
    """A figure of merit of the experiment capture, SI; NaN without a C compiler."""
    return _capture_merits(e).get(label, math.nan)


# Fig. 13 by a machine that is not ideal: what is carried at z = 5 mm, and what moves x1 and x2.
#
# The paper measures 3.25 N of vertical bearing force, where m g is 3.53 N, and up to 20 um in x1 and x2 during a
# stroke, where its model has none. Its text blames irregular fields of the modules and unequal magnets of the mover.
# Our reading:
#
#     e_y     the magnetic centre lies below the sensors' centre, so that attraction carries the rest of the weight:
#             m g + 2 K_A e_y = 3.25 N. v0(z) knows of it: the paper records v0 at rest.
#     d_i     the current sensors have offsets. Seen from the mover they turn with pi z / L_p, so their forces change
#             during a stroke of 10 mm, two thirds of a pole, in x and in y. How much depends on the signs. And, or:
#     c_x     the line of thrust passes the centre of gravity at this distance, so thrust tilts the mover. Of magnets at
#             the radius a whose strength differs by +-s around the mover, thrust acts s a / 2 off the axis.
#
# Nothing else here moves x during a stroke: modules that differ leave the mirror x -> -x, and the pull of an offset
# e_x is constant in the plane of each module, whatever z is. A centre of gravity that is off by mass does not stay
# beside the axis: at rest the mover rolls until it hangs, as in plant.py.


RADIAL_OUTPUTS = (0, 2)  # x1 and x2
FIRST_TRY = {"d_i": 10e-3, "c_x": 0.1e-3}  # A, m: deviations grow in proportion
WAIT = {"d_i": 0.5, "c_x": 0.0}  # s before the stroke: integrals take off an offset, and an unbalance rolls


class Figure13(NamedTuple):
    """The stroke of Fig. 13 with an offset magnetic centre, and with one more cause of deviations in x. SI."""

    offset: float  # e_y, m
    causes: dict[str, float]  # d_i, A, and c_x, m: each alone moves the mover as far as in the figure
    centred: Trajectory  # with e_y alone
    moved: dict[str, Trajectory]  # with each cause besides


def magnetic_offset(par: Parameters, carried: float) -> float:
    """The offset e_y, m, with which the bearings carry so much of the weight (N): m g + 2 K_A e_y = carried."""
    return (carried - par.m * par.g) / (2 * par.K_A)


def radial_deviation(run: Trajectory, outputs: tuple[int, ...] = (0, 1, 2, 3), start: float = 0.0) -> float:
    """Largest deviation of some of x1 y1 x2 y2 from `start` (s) on, m."""
    return float(np.abs(run.p - run.reference)[run.t >= start][:, outputs].max())


def figure_13(controller: Controller, carried: float, deviation: float) -> Figure13:
    """Solve for the offset and for each cause that reproduce Fig. 13 under a controller.

    carried : sum of the vertical bearing forces at the end of the stroke, N
    deviation : the largest of x1 y1 x2 y2, m
    """
    par: Any = controller.parameters
    centred = replace(par, e_y=magnetic_offset(par, carried))
    v0 = static_feedforward(plant_of(centred)).v0
    informed = replace(controller, feedforward=replace(controller.feedforward, v0=v0))

    def stroke(wait: float = 0.0, **cause: float) -> Trajectory:
        scenario = Scenario("stroke", wait + 0.1, partial(delayed_stroke, wait=wait))
        return simulate(plant_of(replace(centred, **cause)), informed, scenario)

    causes, moved = {}, {}
    for name, first in FIRST_TRY.items():
        per_unit = radial_deviation(stroke(WAIT[name], **{name: first}), start=WAIT[name]) / first
        causes[name] = deviation / per_unit
        moved[name] = stroke(WAIT[name], **{name: causes[name]})
    return Figure13(centred.e_y, causes, stroke(), moved)


@lru_cache(maxsize=8)  # several rows need it; records of evidence compare by identity
def solved_figure_13(e: TubularEvidence) -> Figure13:
    """Fig. 13 solved for under a design's controller."""
    weight, deviation = (
        published_value(e.published, f"figure_13.{name}") for name in ("weight", "radial_deviation")
    )
    return figure_13(e.controller, weight, deviation)


# The stroke that learns: the same machines with the design's gain file, and with the force constant that it taught.


LEARNERS = 30  # machines that fly both strokes


@lru_cache(maxsize=8)  # two rows need it; records of evidence compare by identity
def _teach(e: TubularEvidence) -> tuple[Rate, Rate]:
    """The machines whose first and whose second stroke keep the published bounds; what does not fly on teaches none."""
    plan = plan_of(e.controller, e.spec, LEARNERS, settle=True)
    kept = [0, 0]
    for index in range(LEARNERS):
        run = replay(plan, index).cases[0].run
        kept[0] += _within_published(run, e)
        try:
            law = learn(e.controller, log_of(run)).controller
        except (CheckError, InputError):
            continue
        after = simulate(run.plant, law, run.scenario.replace(seed=run.scenario.seed + 1))
        kept[1] += _within_published(after, e)
    return rate(kept[0], LEARNERS), rate(kept[1], LEARNERS)


def _within_published(run: Trajectory, e: TubularEvidence) -> bool:
    """Whether a stroke was completed within the bounds of Figs 12 and 13."""
    if not run.verdict.completed:
        return False
    bounded = (m for m in stroke_merits(run) if m.published and m.relation == "at most")
    return all(m.value <= published_value(e.published, m.published) for m in bounded)


def taught_share(stroke: int, e: TubularEvidence) -> Chance:
    """The share of LEARNERS machines whose stroke of this number, 0 or 1, keeps the published bounds."""
    found = _teach(e)[stroke]
    return Chance(found.share, (found.high - found.low) / 2)
