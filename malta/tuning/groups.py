"""The groups of a machine's states that close loops by themselves, and the linear figures of a trial's loops.

The figures come from the machine's own loop (hold, delay, current loops):

    margin             box of the parameters at which a corner of it becomes unstable, at the middle and the ends of the
                       stroke, at the value and the ends of each interval of `plant.over`
    peak sensitivity   largest |S_ii|; bandwidth: the smallest of those of verify's definitions that bind every group
    motion, noise      discrete Lyapunov equation with the sensors' noise and the steps' q^2 / 12

What the requirements make of them is theirs: Requirement.estimate.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.linear.matrices import covariance
from malta.linear.peaks import largest_gain
from malta.linear.sampling import add_lags, sample
from malta.loops.bandwidths import in_sizes, last_crossover, reading_sizes, tracked_band
from malta.loops.classical import Nominal
from malta.loops.clearances import Clearance
from malta.loops.noise import noise_variance
from malta.loops.parametric_plants import of_plant
from malta.loops.sampled_loops import SampledLoop, disturbance_map, pad, push_through, stored_readings
from malta.loops.windings import (
    Caught,
    WindingModel,
    emf_slope,
    estimated_rows,
    sample_driven,
    windings_of,
    with_estimated_emf,
    with_windings,
)
from malta.model.equilibrium import trim
from malta.model.linearize import LinearModel, linearize
from malta.model.places import position_in
from malta.model.plant import Plant
from malta.model.sensors import split_dead_time, with_lags
from malta.synthesis.controller import CurrentLoop, holding_gain
from malta.synthesis.feedforward import current_loop_of, static_feedforward
from malta.synthesis.filters import Gains, gain_at_rest
from malta.synthesis.linear_law import LinearLaw, linear_law_of
from malta.synthesis.lqg import gains
from malta.synthesis.requirements import NoiseRms, Requirement, TrialFigures, requirements_for
from malta.synthesis.spec import Spec
from malta.synthesis.step_response import StepResponse, step_response
from malta.synthesis.weighting import Weights
from malta.tuning.touches import asked_loads, largest_trial_load, touched_contacts

# The sampled machine at the corners of its box of parameters, and where each corner of the growing box is lost.


Indices = NDArray[np.int_]
STEP = 0.15  # of the multiples of the box at which the machine is sampled; linear between them
CORNER_FACTOR = 1.3  # times the smallest margin, beyond which no corner is looked at


@dataclass(frozen=True, eq=False)
class SampledMachine:
    """Sampled machines with hold, delay, current loops and late sensors; leading axes are corners of the box."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray  # of the readings
    true: FloatArray  # of the outputs
    caught: tuple[int, Caught] | None = None  # readings within a sample, and the first of their states

    def close(self, F: LinearLaw) -> FloatArray:
        """Close the loops with a law, without its references."""
        n, k = self.Ad.shape[-1], len(F.A)
        M = np.zeros((*self.Ad.shape[:-2], n + k, n + k))
        M[..., :n, :n], M[..., :n, n:] = self.Ad + self.Bd @ F.D_y @ self.Cd, self.Bd @ F.C
        M[..., n:, :n], M[..., n:, n:] = F.B_y @ self.Cd, F.A
        return M


def corner_margins(table: SampledMachine, F: LinearLaw) -> FloatArray:
    """Multiples of the box at which each corner becomes unstable; at most CORNER_FACTOR times the smallest."""
    every = np.arange(table.Ad.shape[1])
    top = STEP * (len(table.Ad) - 1)
    smallest = _first_lost(table, F, every, (0.0, top), 13)
    far = min(max(CORNER_FACTOR * smallest, STEP), top)
    found = np.full(len(every), far)
    low, high = np.full(len(every), smallest), found.copy()
    near = every[_is_lost(table, F, every, far)]
    for _ in range(9 if len(near) else 0):  # all that are near at once, each between its own bounds
        t = (low[near] + high[near]) / 2
        lost = _is_lost(table, F, near, t)
        high[near[lost]], low[near[~lost]] = t[lost], t[~lost]
    found[near] = low[near]
    return found


def _first_lost(
    table: SampledMachine, F: LinearLaw, which: Indices, between: tuple[float, float], halvings: int
) -> float:
    """Where the first of some corners is lost, a multiple of the box."""
    low, high = between
    for _ in range(halvings):
        t = (low + high) / 2
        lost = _is_lost(table, F, which, t)
        if lost.any():
            high, which = t, which[lost]  # the others are lost later
        else:
            low = t
    return low


def _is_lost(table: SampledMachine, F: LinearLaw, which: Indices, t: float | FloatArray) -> NDArray[np.bool_]:
    """Which of some corners are unstable at t times the box, one t for all or one each."""
    t = np.broadcast_to(np.asarray(t), which.shape)
    k = np.minimum((t / STEP).astype(int), len(table.Ad) - 2)
    share = (t / STEP - k)[:, None, None]
    tables = table.Ad, table.Bd, table.Cd, table.true
    between = SampledMachine(*((1 - share) * M[k, which] + share * M[k + 1, which] for M in tables))
    lost: NDArray[np.bool_] = np.abs(np.linalg.eigvals(between.close(F))).max(axis=1) >= 1
    return lost


class MachinePart(NamedTuple):
    """Continuous states of a machine that close loops by themselves: x' = A x + B v, p = C x.

    read : of the readings, where sensors lag, behind states that A has then
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    read: FloatArray = np.zeros((0, 0))

    @property
    def E(self) -> FloatArray:
        """Nothing is held between samples here: `groups_of` refuses other machines."""
        return np.zeros((len(self.A), len(self.C)))


class Driven(NamedTuple):
    """The windings of a machine and the current controllers that drive them."""

    windings: WindingModel
    loop: CurrentLoop
    induced: FloatArray  # M^+ emf(x): inputs x states


class StrokePlace(NamedTuple):
    """The nominal machine at a position of its stroke, with its loads at their trim, and loads from outside."""

    position: float  # m
    machine: SampledMachine
    slope: FloatArray  # of v0(z): inputs x outputs
    pushed: FloatArray  # what unit disturbances leave in the machine's states in a sample


@dataclass(frozen=True, eq=False)
class TuningGroup:
    """Some states, inputs and outputs of the machine that close loops by themselves."""

    states: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    model: MachinePart
    nominal: SampledMachine  # with its loads, at their trim
    slope: FloatArray  # of v0(z), which acts against them: inputs x outputs
    forecast: FloatArray  # of induced voltages, that current controllers take off: inputs x states, or none
    corners: SampledMachine | None  # levels x corners
    variance: FloatArray  # of a measurement, m2
    places: tuple[StrokePlace, ...]  # where loads act from outside: operating point and ends; or none
    role: tuple[Any, ...]  # what the requirements see in it: stroke, thrust, bounds of its signals
    requirements: tuple[tuple[str, str, Requirement], ...]  # figure, signal, requirement, with an estimate
    contacts: tuple[Clearance, ...]  # that its states move, where loads are asked for that touch nothing

    @property
    def picture(self) -> tuple[Any, ...]:
        """Equal for mirror images: nothing here depends on the signs of coordinates."""
        parts = (np.abs(M).round(12) for M in self.model)
        forecast = np.abs(self.forecast).round(12).tobytes()
        return (*(M.tobytes() for M in parts), self.variance.tobytes(), forecast, self.role)

    def part(self, w: Weights) -> Weights:
        """Pick the weights of the group's states, inputs and outputs."""
        i, j, o = (list(index) for index in (self.states, self.inputs, self.outputs))
        e, f = o, j
        if w.coordinates == "positions":
            half = len(w.q) // 2
            e = f = [k for k in i if k < half]
        drift = w.drift_variance[f] if w.drift_variance.size else w.drift_variance
        correlation = w.correlation[f] if w.correlation.size else w.correlation
        return Weights(
            w.q[i], w.q_base[i], w.r[j], w.r_base[j], w.q_i[e], w.q_i_base[e],
            w.process_variance[f], w.sensor_variance[o], drift, w.coordinates, correlation,
        )  # fmt: skip


def groups_of(spec: Spec) -> list[TuningGroup]:
    """Find the groups of a design's machine, each with what its trials need.

    Raises InputError for a machine whose currents are held between samples, and for one that has states which no input
    or sensor reaches.
    """
    plant = spec.plant
    model = linearize(plant, plant.at(**spec.operating_point))
    if model.E.any():
        what = f"a {plant.name}, whose currents are held between samples"
        raise InputError(
            spec.path, "search", what, "a PID, or a machine whose forces do not depend on where it is"
        )
    loaded = linearize(plant, trim(plant, **spec.operating_point))
    position = spec.operating_point.get(plant.stroke.name, 0.0)
    along = sorted({position, -plant.stroke.travel, plant.stroke.travel}) if plant.has_stroke else []
    beside = {name: x for name, x in spec.operating_point.items() if name != plant.stroke.name}
    positions = [{plant.stroke.name: z} | beside for z in along] or [beside]
    slope = _slope(plant, position)
    names = tuple(spec.uncertainty)
    proven = "margin" in spec.specification
    driven = _driven_windings(spec)
    windings = None if driven is None else driven.windings
    systems = (
        [
            of_plant(plant, (*names, *_intervals(spec)), at=place, windings=windings, loaded=False)
            for place in positions
        ]
        if proven
        else []
    )
    trims = _loaded_places(spec)
    held = _with_windings(spec, driven, MachinePart(loaded.A, loaded.B, model.C))
    found = []
    for i, j, o in _components(spec, positions):
        part = MachinePart(model.A[np.ix_(i, i)], model.B[np.ix_(i, j)], model.C[np.ix_(o, i)])
        forecast = np.zeros((0, 0)) if driven is None else driven.induced[np.ix_(j, i)]
        nominal = _sample(spec, driven, _cut(spec, driven, held, (i, j, o)), forecast)
        places = tuple(_place(spec, driven, *at, (i, j, o), forecast) for at in trims)
        found.append(
            TuningGroup(
                tuple(i.tolist()),
                tuple(j.tolist()),
                tuple(o.tolist()),
                part,
                nominal,
                slope[np.ix_(j, o)],
                forecast if forecast.any() else np.zeros((0, 0)),
                _corners(spec, driven, systems, (i, j, o), forecast) if systems else None,
                noise_variance(plant)[o],
                places,
                (*_role(spec, j, o), *_pushes(spec, o, places)),
                _estimates(spec),
                touched_contacts(spec, loaded.operating_point.x, i.tolist()),
            )
        )
    return found


def _components(spec: Spec, positions: Sequence[Mapping[str, float]]) -> list[tuple[Any, Any, Any]]:
    """States, inputs and outputs that nothing joins to the others at any of these positions of the stroke."""
    plant = spec.plant
    n, m, p = len(plant.design_states), len(plant.inputs), len(plant.outputs)
    touch = np.zeros((n + m + p,) * 2, dtype=bool)
    for place in positions:
        at = linearize(plant, plant.at(**place))
        touch[:n, :n] |= at.A != 0
        touch[:n, n : n + m] |= at.B != 0
        touch[n + m :, :n] |= at.C != 0
    count, label = sparse.csgraph.connected_components(touch, directed=False)
    found = []
    for k in range(count):
        i, j, o = (
            np.flatnonzero(label[part] == k) for part in (slice(n), slice(n, n + m), slice(n + m, None))
        )
        if not (len(i) and len(j) and len(o)):
            raise InputError(
                spec.path, "machine", "states that no input or sensor reaches", "another machine"
            )
        found.append((i, j, o))
    return found


def _role(spec: Spec, inputs: Any, outputs: Any) -> tuple[Any, ...]:
    """What differs between mirror images where requirements tell their signals apart."""
    plant, asked = spec.plant, spec.specification
    names = [plant.inputs[j].name for j in inputs], [plant.outputs[o].name for o in outputs]
    bounds = tuple(
        tuple(
            sorted((key.partition(" ")[0], value) for key, value in asked.items() if key.endswith(f" {name}"))
        )
        for some in names
        for name in some
    )
    if not plant.has_stroke:
        return bounds
    return plant.stroke_output in outputs, plant.thrust_input in inputs, bounds


def _slope(plant: Plant, position: float) -> FloatArray:
    """dv0/dp at a position of the stroke, m x p."""
    slope = np.zeros((len(plant.inputs), len(plant.outputs)))
    if plant.has_stroke:
        slope[:, plant.stroke_output] = static_feedforward(plant).slope(position)
    return slope


def _loaded_places(spec: Spec) -> list[tuple[LinearModel, FloatArray]]:
    """The machine at its trims where it is asked what loads do, each with the slope of v0."""
    plant = spec.plant
    along: list[Mapping[str, float]] = [spec.operating_point] if spec.recovery or asked_loads(spec) else []
    if any(bound.anywhere for bound in spec.recovery.values()):
        along += [{plant.stroke.name: -plant.stroke.travel}, {plant.stroke.name: plant.stroke.travel}]
    return [
        (linearize(plant, trim(plant, **at)), _slope(plant, at.get(plant.stroke.name, 0.0))) for at in along
    ]


def is_driven(spec: Spec) -> bool:
    """Whether current controllers drive windings in the design's loop."""
    return _driven_windings(spec) is not None


def _driven_windings(spec: Spec) -> Driven | None:
    """The windings of a machine that current controllers drive, as in its own loop; None for lagging currents."""
    plant = spec.plant
    loop = current_loop_of(plant.actuator, current_loop_delay=spec.current_loop_delay)
    if plant.actuator.windings is None or loop is None:
        return None
    point = plant.at(**spec.operating_point)
    windings = windings_of(plant, plant, point, np.eye(len(plant.inputs)))
    return Driven(windings, loop, windings.axes @ emf_slope(plant, point.x)[:, list(plant.controlled)])


def _with_windings(spec: Spec, driven: Driven | None, whole: MachinePart) -> MachinePart:
    """The machine with its windings between samples; unchanged for lagging currents."""
    if driven is None:
        return whole
    x = spec.plant.at(**spec.operating_point).x
    return MachinePart(
        *(np.array(ca.DM(M)) for M in with_windings(spec.plant, driven.windings, x, *whole[:3]))
    )


def _cut(spec: Spec, driven: Driven | None, whole: MachinePart, group: tuple[Any, Any, Any]) -> MachinePart:
    """A group's part of the machine, with the lags of its sensors.

    Of each input of a machine with windings the current is a state and an output.
    """
    i, j, o = group
    sensors = spec.plant.sensors
    lags = replace(sensors, lag=tuple(sensors.lag[k] for k in o)) if len(sensors.lagging) else None
    if driven is not None:
        i, o = np.append(i, len(spec.plant.design_states) + j), np.append(o, len(spec.plant.outputs) + j)
    part = MachinePart(whole.A[np.ix_(i, i)], whole.B[np.ix_(i, j)], whole.C[np.ix_(o, i)])
    if lags is None or not len(lags.lagging):
        return part
    A, B, read = (np.array(ca.DM(M)) for M in with_lags(lags, part.A, part.B, part.C))
    return MachinePart(A, B, pad(part.C, len(A)), read)


def _place(
    spec: Spec,
    driven: Driven | None,
    model: LinearModel,
    slope: FloatArray,
    group: tuple[Any, Any, Any],
    forecast: FloatArray,
) -> StrokePlace:
    """The group's part of a place."""
    i, j, o = group
    whole = _with_windings(spec, driven, MachinePart(model.A, model.B, model.C))
    part = _cut(spec, driven, whole, group)
    machine = _sample(spec, driven, part, forecast)
    B_w = disturbance_map(model)[i]
    pushed = push_through(part.A, B_w, spec.sample_time, len(machine.Ad), machine.caught)
    return StrokePlace(
        position_in(model.plant, model.operating_point.x), machine, slope[np.ix_(j, o)], pushed
    )


def _pushes(spec: Spec, outputs: Any, places: Sequence[StrokePlace]) -> tuple[Any, ...]:
    """What differs between mirror images where loads from outside are bounded: loads, bounds, places."""
    names = {spec.plant.outputs[k].name for k in outputs}
    bounds = []
    for bound in spec.recovery.values():
        push = np.abs([place.pushed @ bound.load_at(place.position) for place in places]).round(15)
        if push.any() and names & set(bound.outputs):
            bounds.append((bound.after or 0.0, bound.anywhere, bound.limit, push.tobytes()))
    names_of_loads = [s.name for s in spec.plant.disturbances]
    for key, name, size in asked_loads(spec):
        push = np.abs(places[0].pushed[:, names_of_loads.index(name)]).round(15)
        if push.any():
            bounds.append((math.inf, False, size, key.encode() + push.tobytes()))
    machines = (np.abs(place.machine.Ad).round(12).tobytes() for place in places)
    return (*sorted(bounds), *machines)


def _estimates(spec: Spec) -> tuple[tuple[str, str, Requirement], ...]:
    """The figures of a trial: every requirement of the machine with an estimate; of signals, those asked for."""
    found = []
    for name, requirement in requirements_for(spec.plant).items():
        if requirement.estimate is None:
            continue
        if requirement.form in ("number", "switch"):
            found.append((name, "", requirement))
        for key in spec.specification:
            base, _, signal = key.partition(" ")
            if signal and base == name:
                found.append((key, signal, requirement))
    return tuple(found)


def _sample(spec: Spec, driven: Driven | None, part: MachinePart, forecast: FloatArray) -> SampledMachine:
    """A part behind its current loops and sensors: from forces, and with a forecast from voltages beside them."""
    actuator, (A, B, C, read), Ts = spec.plant.actuator, part, spec.sample_time
    m, delay, count = B.shape[1], actuator.delay(Ts), len(C) - (0 if driven is None else B.shape[1])
    read = (read if read.size else C)[:count]
    late, rest = split_dead_time(spec.plant.sensors.dead_time, Ts)
    caught = Caught(read, Ts - rest) if rest else None
    if driven is not None:
        Ad, Bd = sample_driven((A, B, C[-m:]), driven.loop, driven.windings.R, Ts, delay, caught=caught)
        Bd = Bd if forecast.any() else Bd[:, :m]
    else:
        if math.isfinite(actuator.crossover):
            A, B = add_lags(A, B, actuator.crossover)
        Ad, Bd = sample(A, B, Ts, delay) if caught is None else caught.add_to((A, B), Ts, delay)
    first = len(Ad) - count - (0 if driven is None else m)
    Cd = pad(read, len(Ad)) if caught is None else np.eye(len(Ad))[first : first + count]
    if late:
        Ad, Bd, Cd = stored_readings(Ad, Bd, Cd, late)
    at = None if caught is None else (first, caught._replace(C=pad(read, len(part.A))))
    return SampledMachine(Ad, Bd, Cd, pad(C[:count], len(Ad)), at)


def _intervals(spec: Spec) -> dict[str, tuple[float, ...]]:
    """The value and both ends of each interval that proofs cover, of parameters that are not uncertain."""
    plant = spec.plant
    return {
        name: tuple(sorted({*ends, float(getattr(plant.parameters, name))}))
        for name, ends in plant.over.items()
        if name not in spec.uncertainty
    }


def _corners(
    spec: Spec, driven: Driven | None, systems: list[Any], group: tuple[Any, Any, Any], forecast: FloatArray
) -> SampledMachine:
    """The machine at every corner of growing boxes, those that differ in this group."""
    signs = np.array(list(itertools.product((-1, 1), repeat=len(spec.uncertainty))))
    share = np.array(list(spec.uncertainty.values()))
    levels = np.arange(0.0, min(1 / share) - STEP / 3, STEP)
    made: dict[bytes, list[SampledMachine]] = {}  # machines that are mirror images have the same poles: once
    for system in systems:
        for corner, values in itertools.product(signs, itertools.product(*_intervals(spec).values())):
            grown = system.nominal[: len(share)] * (1 + np.outer(levels, share * corner))
            rows = np.hstack([grown, np.tile(values, (len(levels), 1))])
            wholes = [MachinePart(*matrices) for matrices in zip(*system.at(rows), strict=True)]
            parts = [_cut(spec, driven, whole, group) for whole in wholes]
            key = b"".join(np.abs(M).round(9).tobytes() for part in parts for M in part)
            if key not in made:
                made[key] = [_sample(spec, driven, part, forecast) for part in parts]
    names = "Ad", "Bd", "Cd", "true"
    stacked = (np.array([[getattr(m, name) for m in one] for one in made.values()]) for name in names)
    Ad, Bd, Cd, true = (M.swapaxes(0, 1) for M in stacked)
    return SampledMachine(Ad, Bd, Cd, true)


def figures_of(spec: Spec, group: TuningGroup, weights: Weights, delay: float) -> dict[str, float]:
    """Compute the linear figures of a group in a trial, by requirement; none where its loop is unstable.

    Beside the margin stands that of every corner, "margin 3": a search that sees one alone runs into the next.
    """
    try:
        with np.errstate(all="ignore"):
            g = gains(
                group.model, group.part(weights), spec.sample_time, spec.discretization, delay, spec.lag
            )
    except CheckError:
        return {}
    return figures_of_gains(spec, group, g)


def figures_of_gains(spec: Spec, group: TuningGroup, g: Gains) -> dict[str, float]:
    """Compute the linear figures of a group under gains, by requirement; none where its loop is unstable."""
    Ts = spec.sample_time
    law = linear_law_of(g, Ts)
    steady = _with_forecast(group, g, law._replace(D_y=law.D_y + group.slope))
    closed = group.nominal.close(steady)
    if not (np.isfinite(closed).all() and np.abs(np.linalg.eigvals(closed)).max() < 1):
        return {}
    alone = len(group.outputs) == len(spec.plant.outputs)
    known = 0
    if spec.pid is None:
        known = (len(g.Ad) - len(group.states)) // len(group.inputs) - bool(spec.weights.drift_variance.size)
    resting = known if spec.current_lag else 0
    w_n = _natural_frequency(group, g, resting) if spec.plant.second_order else math.inf
    sizes = reading_sizes(spec.plant, None if spec.pid is not None else spec.weights.sensor_variance)
    peak, bandwidth = _response(group, steady, Ts, sizes, w_n=w_n, alone=alone)
    pushed = [_pushed_loop(group, place, g, law) for place in group.places]
    try:
        answers = tuple(
            (place.position, _answer(place, *one, Ts))
            for place, one in zip(group.places, pushed, strict=True)
        )
    except CheckError:
        return {}
    margins = None if group.corners is None else corner_margins(group.corners, _with_forecast(group, g, law))
    trial = TrialFigures(
        plant=spec.plant,
        outputs=group.outputs,
        inputs=group.inputs,
        model=group.model,
        noise=_noise(group, steady, closed),
        margin=None if margins is None else float(margins.min()),
        peak_sensitivity=peak,
        bandwidth=bandwidth,
        answers=answers,
        recovery=spec.recovery,
        follow=_follower(spec, group, g, closed, known),
        largest_load=partial(_largest_load, spec.plant, group, pushed),
    )
    figures = {}
    for name, signal, requirement in group.requirements:
        assert requirement.estimate is not None
        value = requirement.estimate(trial, signal)
        if value is not None:
            figures[name] = value
    if margins is not None:
        figures |= {f"margin {k}": value for k, value in enumerate(margins.tolist())}
    return figures


def _follower(
    spec: Spec, group: TuningGroup, g: Gains, closed: FloatArray, known: int
) -> Callable[[float, FloatArray, ComplexArray], ComplexArray]:
    """`TrialFigures.follow` of a trial.

    closed : of the nominal machine and the law
    known : blocks of forces behind the lag and of the delay among the states of the law
    """
    Ts, Bd = spec.sample_time, group.nominal.Bd[:, : len(group.inputs)]

    def follow(w: float, p: FloatArray, x: ComplexArray) -> ComplexArray:
        v_ff = np.zeros(Bd.shape[1], dtype=complex)
        if spec.position_feedforward:
            v_ff = holding_gain(group.model.A, group.model.B) @ x[: len(x) // 2]
        xi = np.zeros(len(g.Ad), dtype=complex)
        xi[: len(x)] = x
        xi[len(x) :][: known * len(v_ff)] = np.tile(v_ff, known)  # slow beside lag and delay
        v = g.K @ xi + Ts * g.Ki @ p + v_ff
        driven = np.concatenate([Bd @ v, g.Bd @ v, Ts * p])[: len(closed)]
        states = np.linalg.solve(np.exp(1j * w * Ts) * np.eye(len(closed)) - closed, driven)
        return np.asarray(group.nominal.true @ states[: group.nominal.true.shape[1]])

    return follow


def _with_forecast(group: TuningGroup, g: Gains, law: LinearLaw) -> LinearLaw:
    """The law with the induced voltages that it forecasts as further outputs, where there are any."""
    return with_estimated_emf(law, estimated_rows(group.forecast, g.L, g.Cd)) if group.forecast.size else law


def _pushed_loop(
    group: TuningGroup, place: StrokePlace, g: Gains, law: LinearLaw
) -> tuple[FloatArray, FloatArray]:
    """The closed loop of a group at a place, and what unit loads from outside leave in its states."""
    closed = place.machine.close(_with_forecast(group, g, law._replace(D_y=law.D_y + place.slope)))
    return closed, pad(place.pushed.T, len(closed)).T


def _largest_load(
    plant: Plant,
    group: TuningGroup,
    pushed: Sequence[tuple[FloatArray, FloatArray]],
    disturbance: str,
    limit: float,
) -> float | None:
    """`TrialFigures.largest_load` of a trial, at the operating point."""
    k = [s.name for s in plant.disturbances].index(disturbance)
    closed, left = pushed[0]
    return largest_trial_load(group.contacts, closed, left[:, k], len(group.states), limit)


def _answer(place: StrokePlace, closed: FloatArray, pushed: FloatArray, Ts: float) -> StepResponse:
    """Outputs of a group under a unit step of each load from outside. Raises CheckError for an unstable loop."""
    return step_response(closed, pushed, pad(place.machine.true, len(closed)), Ts)


def _response(
    group: TuningGroup, law: LinearLaw, Ts: float, sizes: FloatArray | None, *, w_n: float, alone: bool
) -> tuple[float, float]:
    """Peak sensitivity and bandwidth, rad/s; w_n: the smallest natural frequency, infinite where there is none.

    sizes : of all readings, see `reading_sizes`

    Of several groups, the loop gain's last crossing is that of the widest: it binds a group that stands alone.
    """
    machine = SampledLoop(group.nominal.Ad, group.nominal.Bd, group.nominal.Cd, law, Ts)
    cut = in_sizes(Nominal(*machine.systems, True, Ts), sizes, group.outputs)
    bandwidth = min(tracked_band(cut, min(len(group.outputs), len(group.inputs)))[0], w_n)
    if alone:
        bandwidth = min(bandwidth, last_crossover(cut))
    return largest_gain(cut.sensitivity(i) for i in cut.sensors).value, bandwidth


def _natural_frequency(group: TuningGroup, g: Gains, known: int) -> float:
    """The smallest natural frequency of q'' = (k - G K1) q, rad/s; known: blocks of forces under way, at rest."""
    n = len(group.states)
    half = n // 2
    stiffness = group.model.B[half:] @ gain_at_rest(g.K, n, known) - group.model.A[half:, :half]
    return math.sqrt(max(float(np.linalg.eigvals(stiffness).real.min()), 0.0))


def _noise(group: TuningGroup, law: LinearLaw, closed: FloatArray) -> NoiseRms:
    """Rms of the group's outputs and commands."""
    noise = np.vstack([group.nominal.Bd @ law.D_y, law.B_y])
    X = covariance(closed, noise * group.variance @ noise.T)
    k = len(group.nominal.Ad)
    out = group.nominal.true @ X[:k, :k] @ group.nominal.true.T
    command = np.hstack([law.D_y @ group.nominal.Cd, law.C])
    force = np.diag(command @ X @ command.T + law.D_y * group.variance @ law.D_y.T)[: len(group.inputs)]
    return NoiseRms(np.sqrt(np.diag(out)), np.sqrt(force))
