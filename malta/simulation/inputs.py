"""Inputs of every sample of a scenario: reference, feedforward, disturbances, faults and noise; and the first state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from itertools import accumulate
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.places import off_stroke, outputs_at, place_states, position_in
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation import references
from malta.simulation.engine.engines import evaluate
from malta.simulation.layout import electronics_of, layout_of, noise_scales
from malta.simulation.period import state_reference
from malta.simulation.readings import keys, normals, normals_of_parts
from malta.simulation.references import Motion
from malta.simulation.scenario import FeedforwardChoice, Scenario, Simulation
from malta.synthesis.controller import Controller, holding_gain, lag_shares

# Forces that counter a disturbance known in advance, as the acceleration of a carrier under the machine.


def countering_forces(believed: Plant, motion: Motion, wrench: FloatArray) -> FloatArray:
    """The forces v that cancel a wrench w at the reference: G_v(x*) v = -G_w(x*) w in the least-squares sense, k x m.

    believed : the machine as the controller knows it; x' = f(x, v, w) with G_v = df/dv, G_w = df/dw at rest
    wrench : k x disturbances, N and N m; what no input reaches stays
    """
    states = evaluate(state_reference(believed).map(len(wrench)), motion.p, motion.dp)[0]
    moved = np.abs(wrench).any(axis=1)
    v = np.zeros((len(wrench), len(believed.inputs)))
    if moved.any():
        n, m, d = len(believed.controlled), len(believed.inputs), len(believed.disturbances)
        by_v, by_w = evaluate(_effects(believed).map(int(moved.sum())), states[moved])
        # A row of the result is a matrix, column by column.
        G_v, G_w = by_v.reshape(-1, m, n).swapaxes(1, 2), by_w.reshape(-1, d, n).swapaxes(1, 2)
        v[moved] = -np.einsum("kmn,knd,kd->km", np.linalg.pinv(G_v), G_w, wrench[moved])
    return v


@lru_cache(maxsize=16)
def _effects(plant: Plant) -> ca.Function:
    """Controlled states -> df/dv and df/dw of these states, each as one column."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    chosen = list(plant.controlled)
    controlled = kind.sym("x", len(chosen))
    x = place_states(plant, controlled)
    v, w = kind.sym("v", len(plant.inputs)), kind.sym("w", len(plant.disturbances))
    rate = plant.f(x, v, w)[chosen]
    by_v, by_w = (ca.densify(ca.vec(ca.densify(ca.jacobian(rate, u)))) for u in (v, w))
    still = [kind.zeros(len(plant.inputs)), kind.zeros(len(plant.disturbances))]
    by_v, by_w = ca.substitute([by_v, by_w], [v, w], still)
    return ca.Function("effects", [controlled], [ca.densify(by_v), ca.densify(by_w)])


MAX_SAMPLES = 4_000_000  # samples: 200 s at 20 kHz, 2 GB of trajectory


class Inputs(NamedTuple):
    """Inputs of k samples."""

    t: FloatArray  # s, k
    motion: references.Motion  # the reference
    given: FloatArray  # k x inputs of a sample, in the order of layout_of(...).given


def inputs_of(run: Simulation) -> Inputs:
    """The inputs of every sample of a simulation. Raises InputError for more than MAX_SAMPLES samples."""
    scenario, Ts = run.scenario, run.controller.sample_time
    samples = scenario.samples(Ts)
    if samples > MAX_SAMPLES:
        raise InputError(scenario.where, "duration", f"{samples} samples", f"at most {MAX_SAMPLES}")
    before = scenario.settling_samples(Ts)
    t = np.arange(-before, samples - before) * Ts
    motion = motion_of(scenario, run.plant, run.controller, np.maximum(t, 0.0))
    if before:  # at rest before the reference begins
        rest = t[:, None] < 0
        motion = motion._replace(dp=np.where(rest, 0.0, motion.dp), ddp=np.where(rest, 0.0, motion.ddp))
    return Inputs(t, motion, sample_inputs(run, motion, t))


def motion_of(scenario: Scenario, plant: Plant, c: Controller, t: FloatArray) -> references.Motion:
    """The reference of a scenario, about the outputs of the controller's operating point without its stroke."""
    motion = scenario.reference(plant)(t)
    believed = plant_of(c.parameters)
    beside = off_stroke(believed, believed.point(c.operating_point[0]).x)
    if not beside:
        return motion
    here, zero = (outputs_at(believed, believed.state(at)) for at in (beside, {}))
    return motion._replace(p=motion.p + (here - zero))


def sample_inputs(run: Simulation, motion: references.Motion, t: FloatArray) -> FloatArray:
    """The inputs of the samples at t for a reference, in the order of layout_of(...).given.

    v_past holds the forces behind the lag of the design model, then the stored forces of the samples before: the
    feedforward, and the force that currents commutated for the reference add to it, which is in the row of the newest
    stored force in Ad, and ahead of the reference as the controller's `commutation` says.
    """
    plant, c, scenario, setup = run
    v_ff = feedforward(c, motion, scenario.feedforward)
    parts = {"p_ref": motion.p, "dp_ref": motion.dp, "v_ff": v_ff}
    past = past_forces(c, motion, v_ff)
    if past.shape[1]:
        parts["v_past"] = past
    sizes = layout_of(plant, c, setup).given
    if scenario.excitation is not None:  # after v_past: the filter knows these forces, the reference does not
        parts["v_ff"] = v_ff + _forces(scenario, "excitation", t, len(plant.inputs))
    if scenario.disturbance is not None:
        parts["w"] = _forces(scenario, "disturbance", t, len(plant.disturbances))
    if scenario.anticipated is not None:
        known = _forces(scenario, "anticipated", t, len(plant.disturbances))
        parts["v_known"] = countering_forces(plant_of(c.parameters), motion, known)
    if setup.faulty:
        parts |= _fault_flags(plant, scenario, sizes, t)
    parts |= {name: np.zeros((len(t), size)) for name, size in sizes.items() if name not in parts}
    return np.hstack([parts[name] for name in sizes])


def past_forces(c: Controller, motion: references.Motion, v_ff: FloatArray) -> FloatArray:
    """References of the states that hold forces, k x such states: lagging forces, stored forces, disturbances."""
    stored = v_ff
    if c.stored:
        n, m = len(c.A), len(c.forces)
        newest = n + m * (c.lagging + c.stored - 1)
        states = evaluate(state_reference(plant_of(c.parameters)).map(len(v_ff)), motion.p, motion.dp)[0]
        stored = v_ff + _in_order(c.Ad[newest : newest + m, :n], states)
        if c.commutation is not None:
            stored += _in_order(c.commutation.lead * c.commutation.pull, motion.dp)
    past = [_earlier(stored, age) for age in range(c.stored, 0, -1)]
    if c.lagging:
        past.insert(0, lagging_references(c, v_ff))
    if c.observed:
        past.append(np.zeros_like(v_ff))
    return np.hstack(past) if past else np.zeros((len(v_ff), 0))


def lagging_references(c: Controller, v_ff: FloatArray) -> FloatArray:
    """The forces behind the lag of the design model while v_ff is commanded, k x m; at rest before the first sample."""
    decay = _decay(c)
    taken = [share * _earlier(v_ff, age)[:-1] for age, share in lag_shares(c)]
    given = np.vstack([v_ff[:1], sum(taken[1:], taken[0])])
    # One by one, as in the exported C: a solver of LAPACK rounds as the kernels of BLAS do.
    columns = (
        accumulate(column, lambda last, now: now + decay * last) if any(column) else column  # most are zero
        for column in given.T.tolist()
    )
    return np.array([list(column) for column in columns]).T


def _earlier(v: FloatArray, samples: int) -> FloatArray:
    """The rows of some samples before; the first one before the beginning."""
    return np.vstack([np.repeat(v[:1], samples, axis=0), v])[: len(v)]


def _decay(c: Controller) -> float:
    """The share of a lagging force that is left after a sample."""
    return float(c.Ad[len(c.A), len(c.A)])


def samples_of_memory(c: Controller) -> int:
    """Samples after which a command no longer shows in the references of the states."""
    return c.stored + (math.ceil(math.log(1e-12) / math.log(_decay(c))) if c.lagging else 0)


def feedforward(c: Controller, motion: references.Motion, choice: FeedforwardChoice = "own") -> FloatArray:
    """Feedforward forces v_ff = inertia p*'' + speed p*' + position q*, N, k x m.

    choice : "own", as the gain file has it; "axial", without the forces that hold the mover at q*; "attraction", with
        those, -G^-1 k q* of the gain file's model q'' = k q + G v

    Without them, a mover under attraction k and feedback K1 goes to K1 / (K1 - k) of its reference, twice as far at
    K1 = 2 k, until the integrals correct it.
    """
    believed = plant_of(c.parameters)
    v_ff = _in_order(c.feedforward.inertias, motion.ddp) + _in_order(c.feedforward.speed, motion.dp)
    hold = c.feedforward.position
    if choice == "attraction":
        believed.require_second_order("feedforward attraction")
        hold = holding_gain(c.A, c.B)
    if hold.size and choice != "axial":
        states = evaluate(state_reference(believed).map(len(motion.p)), motion.p, motion.dp)[0]
        v_ff += _in_order(hold, states)
    return v_ff


def _in_order(M: FloatArray, rows: FloatArray) -> FloatArray:
    """M x of each row x, whose terms are added one by one, as in the exported C: kernels of BLAS round otherwise."""
    return np.asarray(sum((rows[:, [k]] * M[:, k] for k in range(M.shape[1])), np.zeros((len(rows), len(M)))))


def _forces(
    scenario: Scenario, name: Literal["disturbance", "anticipated", "excitation"], t: FloatArray, width: int
) -> FloatArray:
    """Forces of the scenario at t, k x width. Raises InputError for another shape, or NaN."""
    forces = np.asarray(getattr(scenario, name)(t), dtype=float)
    shape = (len(t), width)
    if forces.shape != shape or not np.isfinite(forces).all():
        raise InputError(scenario.where, name, f"shape {forces.shape}", f"finite, shape {shape}")
    return forces


def _signal_index(scenario: Scenario, kind: str, name: str, known: tuple[Any, ...]) -> int:
    """The index of a signal by its name; InputError for an unknown one."""
    names = [signal.name for signal in known]
    if name not in names:
        raise InputError(scenario.where, kind, repr(name), "one of " + " ".join(names))
    return names.index(name)


def _fault_flags(
    plant: Plant, scenario: Scenario, sizes: Mapping[str, int], t: FloatArray
) -> dict[str, FloatArray]:
    """Inputs of the faults, k x size each: stuck sensors, missed steps, the share that the link sags, open phases."""
    flags: dict[str, FloatArray] = {
        name: np.zeros((len(t), sizes[name])) for name in ("stuck", "missed", "sag", "open")
    }
    for fault in scenario.faults:
        during = (t >= fault.at) & (t < fault.until)
        if fault.kind == "lost sample":
            flags["stuck"][during] = 1
        elif fault.kind == "stuck sensor":
            flags["stuck"][during, _signal_index(scenario, fault.kind, fault.what, plant.outputs)] = 1
        elif fault.kind == "missed step":
            flags["missed"][during] = 1
        elif fault.kind == "link sag":
            if not 0 <= fault.size < 1:
                raise InputError(scenario.where, fault.kind, f"{fault.size:g}", "a share from 0 to 1")
            flags["sag"][during] = fault.size
        elif fault.kind == "open phase":
            flags["open"][during, _signal_index(scenario, fault.kind, fault.what, plant.drive.phases)] = 1
    return flags


def sensor_noise(run: Simulation, stages: list[tuple[int, Plant]], t: FloatArray) -> FloatArray:
    """Noise of the sensors of outputs and phase currents, k x sensors, in their units, with biases and noise of faults.

    stages : (first sample, machine), as the machine's parameters and so its noise may change on the way
    """
    plant, _, scenario, setup = run
    drawn: FloatArray = np.zeros((len(t), len(noise_scales(plant, setup))))
    if scenario.noise:
        drawn = normals_of_parts(keys(scenario.seed, np.atleast_1d(scenario.run)), *drawn.shape)
        if plant.sensors.uniform:
            from scipy.special import erf  # here: it takes long to load

            drawn = math.sqrt(3) * erf(drawn / math.sqrt(2))
        for k, (first, now) in enumerate(stages):
            last = stages[k + 1][0] if k + 1 < len(stages) else len(t)
            drawn[first:last] *= scenario.noise * np.array(noise_scales(now, setup))
    for fault in scenario.faults:
        if fault.kind in ("biased sensor", "noisy sensor"):
            column = _signal_index(scenario, fault.kind, fault.what, plant.outputs)
            during = (t >= fault.at) & (t < fault.until)
            if fault.kind == "noisy sensor":
                drawn[during, column] *= fault.size
            else:
                drawn[during, column] += fault.size
    return drawn


def electronics_noise(run: Simulation, periods: int) -> FloatArray:
    """Standard normal numbers for the electronics, a row for each of their periods."""
    fast, scenario = electronics_of(run.plant, run.setup), run.scenario
    if fast is None or not fast.noises:
        return np.zeros((periods, 0))
    return normals(keys(scenario.seed, -1 - np.atleast_1d(scenario.run))[0], periods, fast.noises)


def initial_values(run: Simulation, first: FloatArray) -> tuple[FloatArray, ...]:
    """x, xi_pred and the currents of the coils (A) at the start; `first` is the first row of the inputs.

    The machine moves along the reference, but for the states that the scenario starts elsewhere. Unless the start is
    cold, the observer knows this state and the currents make v0.
    """
    plant, c, scenario, _ = run
    p, n = len(plant.outputs), len(c.states)
    believed = plant_of(c.parameters)
    design = [s.name for s in plant.design_states]
    moving = evaluate(state_reference(believed), first[:p], first[p : 2 * p])[0].ravel()
    x = plant.state(dict(zip(design, moving.tolist(), strict=True)) | dict(scenario.start))
    xi_pred, current = np.zeros(n), np.zeros(len(plant.actuator.coils))
    if not scenario.cold:
        if c.tracks == "states":
            xi_pred[: len(design)] = x[list(plant.controlled)]
        held, hold = c.feedforward.at(position_in(plant, x)), c.feedforward.position
        if hold.size:
            held = held + hold @ moving[: hold.shape[1]]
        n, m, known = len(design), len(held), c.lagging + c.stored
        if known:  # the forces of the samples before, with currents commutated for this position
            newest = n + m * (known - 1)
            pull = c.Ad[newest : newest + m, :n] @ (xi_pred[:n] - moving)
            stored = first[2 * p + m :][: m * known]
            xi_pred[n : n + m * known] = stored + np.tile(pull, known)
        current[:] = evaluate(_holding_currents(plant, believed), x, held)[0].ravel()
    return x, xi_pred, current


@lru_cache(maxsize=16)
def _holding_currents(plant: Plant, believed: Plant) -> ca.Function:
    """(x, v) -> coil currents (A) that the controller commands for forces v while the machine is at x."""
    kind = ca.MX if believed.actuator.tabulated else ca.SX
    x, v = kind.sym("x", len(plant.states)), kind.sym("v", len(plant.inputs))
    return ca.Function("currents", [x, v], [ca.densify(believed.actuator.currents(plant.h(x, 0), v))])
