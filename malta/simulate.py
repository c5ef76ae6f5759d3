"""Nonlinear machine + gain file + scenario -> trajectory.

The plant is integrated by Runge–Kutta steps between samples, its forces following their commands as first-order lags
(exactly); at every sample the control law of controller.py runs. Both are CasADi functions, chained into one call for a
block of samples. The controller is known only by its gain file's record; the plant may have other parameters.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta import references
from malta.controller import Controller, law
from malta.data import plant_of
from malta.errors import InputError
from malta.files import replace_files
from malta.plant import Plant, readonly
from malta.references import Profile, Reference

if TYPE_CHECKING:
    from malta.plant import FloatArray

LONGEST = 4_000_000  # samples: 200 s at 20 kHz, 2 GB of trajectory
BLOCK = 250  # samples in one call of the chained function
RISE = 16.2e-3  # s, 10-90 %: the published stroke, Fig. 12


@dataclass(frozen=True, eq=False)
class Scenario:
    """What is asked of the machine, and what it has to stand."""

    name: str
    duration: float  # s
    reference: Callable[[Plant], Reference]
    start: Mapping[str, float] = field(default_factory=dict)  # states (SI) unlike the reference's first
    disturbance: Callable[[FloatArray], FloatArray] | None = None  # t (k,) -> wrench, k x 6, N and N m
    noise: float = 0.0  # sensor noise in multiples of the plant's
    quantize: bool = False  # sensors resolve what the plant's do
    seed: int = 0
    delay: int | None = None  # samples between measurement and force; None: the machine's own
    substeps: int = 4  # Runge–Kutta steps a sample

    def __post_init__(self) -> None:
        for name, low, whole in (
            ("duration", 1e-12, False),
            ("noise", 0, False),
            ("substeps", 1, True),
            ("delay", 0, True),
            ("seed", 0, True),
        ):
            value = getattr(self, name)
            if whole and value is not None and not isinstance(value, int):
                raise InputError(f"scenario {self.name}", name, repr(value), "a whole number")
            if value is not None and not (math.isfinite(value) and value >= low):
                raise InputError(
                    f"scenario {self.name}", name, str(value), "a number above 0" if low else "0 or more"
                )

    @classmethod
    def stroke(
        cls,
        distance: float = 10e-3,
        *,
        rise: float = RISE,
        profile: Profile = "logistic",
        duration: float | None = None,
        noise: float = 0.0,
        quantize: bool = False,
        seed: int = 0,
        delay: int | None = None,
    ) -> Scenario:
        """Move by `distance` (m), symmetrically about the middle, in `rise` (s, 10-90 %). Figs 12 and 13.

        duration : s; None gives six times the rise, at least 0.1 s, so that the move is whole
        """
        references.check_rise(rise)
        duration = max(0.1, 6 * rise) if duration is None else duration
        if not (math.isfinite(distance) and distance != 0):
            raise InputError("stroke", "distance", f"{distance} m", "a finite distance other than 0 m")
        reference = partial(
            references.stroke,
            start=-distance / 2,
            end=distance / 2,
            rise=rise,
            centre=duration / 2,
            profile=profile,
        )
        return cls("stroke", duration, reference, noise=noise, quantize=quantize, seed=seed, delay=delay)


class Verdict(NamedTuple):
    """How a simulation ended: "completed", "diverged", or what was touched; and when (s)."""

    name: str
    time: float

    @property
    def completed(self) -> bool:
        return self.name == "completed"


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Labelled time series, one row a sample, up to the verdict. SI."""

    plant: Plant
    controller: Controller
    scenario: Scenario
    verdict: Verdict
    t: FloatArray  # k
    reference: FloatArray  # k x p
    p: FloatArray  # k x p, true outputs
    y: FloatArray  # k x p, measured
    x: FloatArray  # k x states, true
    xi_hat: FloatArray  # k x n, estimated
    v: FloatArray  # k x m, commanded forces, N
    force: FloatArray  # k x m, acting forces, N
    saturated: FloatArray  # k x m, 1 where the command was limited

    def __post_init__(self) -> None:
        for name in ("t", "reference", "p", "y", "x", "xi_hat", "v", "force", "saturated"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def current(self) -> FloatArray:
        """Commanded currents, A, k x m: v over the force constants that the controller believes in."""
        return np.asarray(self.v / np.array(plant_of(self.controller.parameters).actuator.force_constant))


def simulate(plant: Plant, controller: Controller, scenario: Scenario) -> Trajectory:
    """Run a scenario. Touchdown and divergence end it early and are named in the verdict, not raised.

    Raises InputError when plant and controller do not belong together or the scenario does not fit the plant.
    """
    believed = plant_of(controller.parameters)
    if (plant.inputs, plant.outputs) != (believed.inputs, believed.outputs):
        raise InputError("simulate", "controller", f"gains of a {believed.name}", f"gains of a {plant.name}")
    delay = plant.actuator.delay(controller.sample_time) if scenario.delay is None else scenario.delay
    samples = max(1, round(scenario.duration / controller.sample_time))
    if samples > LONGEST:
        raise InputError(f"scenario {scenario.name}", "duration", f"{samples} samples", f"at most {LONGEST}")
    t = np.arange(samples) * controller.sample_time
    motion = scenario.reference(plant)(t)
    inputs = np.hstack(
        [motion.p, *state_references(believed, controller, motion), *_surroundings(plant, scenario, t)]
    )
    chain = chain_of(
        plant,
        controller,
        delay,
        scenario.substeps,
        min(BLOCK, samples),
        quantize=scenario.quantize,
        disturbed=scenario.disturbance is not None,
    )
    block = chain.size2_in(1)
    state = _start(plant, believed, controller, scenario, inputs[0], delay)
    layout = _columns(plant, controller)
    table = np.empty((samples, sum(size for _, size in layout)))
    verdict = Verdict("completed", scenario.duration)
    done = 0
    while done < samples:
        count = min(block, samples - done)
        state = _run(chain, state, inputs[done : done + count], table[done : done + count])
        end = _first_stop(plant, table[done : done + count])
        if end is not None:
            done += end[0] + 1
            verdict = Verdict(end[1], float(t[done - 1]))
            break
        done += count
    columns = np.split(table[:done], np.cumsum([size for _, size in layout]), axis=1)
    named = {name: column for (name, _), column in zip(layout, columns, strict=False) if name != "contact"}
    return Trajectory(plant, controller, scenario, verdict, t=t[:done], reference=motion.p[:done], **named)


@lru_cache(maxsize=8)  # building takes as long as a run; records compare by identity, so no hit is stale
def chain_of(
    plant: Plant, c: Controller, delay: int, substeps: int, block: int, *, quantize: bool, disturbed: bool
) -> ca.Function:
    """`_step` chained over a block of samples: (state, inputs) -> (states, rows)."""
    return _step(plant, c, delay, substeps, quantize=quantize, disturbed=disturbed).mapaccum("chain", block)


def _run(chain: ca.Function, state: FloatArray, given: FloatArray, table: FloatArray) -> FloatArray:
    """Run a block and fill its rows of the table; the state after it. A short last block is padded."""
    padding = chain.size2_in(1) - len(given)
    states, rows = _evaluate(chain, state, np.vstack([given, np.repeat(given[-1:], padding, axis=0)]))
    table[:] = rows[: len(table)]
    last: FloatArray = states[len(table) - 1]
    return last


def _evaluate(function: ca.Function, *arguments: FloatArray) -> list[FloatArray]:
    """Call a dense CasADi function on numpy's own memory, a row for each of its columns: no conversion to DM."""
    results = [np.empty(function.size_out(i)[::-1]) for i in range(function.n_out())]
    buffer, evaluate = function.buffer()
    inputs = [np.ascontiguousarray(array, dtype=float) for array in arguments]
    for i, array in enumerate(inputs):
        buffer.set_arg(i, array.data)
    for i, array in enumerate(results):
        buffer.set_res(i, array.data)
    evaluate()
    return results


def _columns(plant: Plant, controller: Controller) -> list[tuple[str, int]]:
    """What one sample leaves behind, in order."""
    m, p = len(plant.inputs), len(plant.outputs)
    return [
        ("x", len(plant.states)),
        ("p", p),
        ("y", p),
        ("xi_hat", len(controller.states)),
        ("v", m),
        ("force", m),
        ("saturated", m),
        ("contact", len(plant.contacts)),
    ]


def _motion(plant: Plant, Ts: float, substeps: int, *, disturbed: bool) -> ca.Function:
    """One sample of the machine: (x, force, v, w) -> (x, force), v held.

    The forces' lag is solved exactly, force = v + (force_0 - v) e^(-w_c t); the mover takes `substeps` Runge–Kutta
    steps.
    """
    x0, force, v = (
        ca.SX.sym(name, size)
        for name, size in (("x", len(plant.states)), ("force", len(plant.inputs)), ("v", len(plant.inputs)))
    )
    w = ca.SX.sym("w", len(plant.disturbances) if disturbed else 0)
    outside = w if disturbed else ca.SX(len(plant.disturbances), 1)  # structural zeros cost nothing

    def rate(x: ca.SX, f: ca.SX) -> ca.SX:
        return plant.f(x, f, plant.load(x) + outside)

    h = Ts / substeps
    decay = math.exp(-plant.actuator.crossover * h / 2)
    x, lag = x0, force - v
    for _ in range(substeps):
        f0, f1, f2 = v + lag, v + decay * lag, v + decay**2 * lag
        k1 = rate(x, f0)
        k2 = rate(x + h / 2 * k1, f1)
        k3 = rate(x + h / 2 * k2, f1)
        k4 = rate(x + h * k3, f2)
        x, lag = x + h / 6 * (k1 + 2 * (k2 + k3) + k4), decay**2 * lag
    return ca.Function("motion", [x0, force, v, w], [x, v + lag])


def _step(
    plant: Plant, c: Controller, delay: int, substeps: int, *, quantize: bool, disturbed: bool
) -> ca.Function:
    """(state, inputs) -> (state after a sample, row of `_columns`), for mapaccum.

    state = x, force, xi_pred, e, frozen, forces under way (the oldest first)
    inputs = p*, xi*, v_ff, noise, wrench
    """
    m, p, n = len(plant.inputs), len(plant.outputs), len(c.states)
    x, force, xi_pred, e, frozen, under_way = (
        ca.SX.sym("s", size) for size in (len(plant.states), m, n, p, p, m * delay)
    )
    p_ref, xi_ref, v_ff, noise, w = (
        ca.SX.sym("u", size) for size in (p, n, m, p, len(plant.disturbances) if disturbed else 0)
    )
    v0 = ca.SX.sym("v0", m)
    true = plant.h(x, force)
    y = _quantized(true + noise, plant.resolution) if quantize else true + noise
    xi_pred_next, e_next, frozen_next, v, xi_hat = law(c)(xi_pred, e, frozen, y, p_ref, xi_ref, v_ff, v0)
    # The gain file's force constants turn forces into currents, the machine limits those and makes its own forces.
    current = v / np.array(plant_of(c.parameters).actuator.force_constant)
    limit = plant.actuator.current_limit
    commanded = ca.fmax(ca.fmin(current, limit), -limit) * np.array(plant.actuator.force_constant)
    queue = ca.vertcat(under_way, commanded)
    x_next, force_next = _motion(plant, c.sample_time, substeps, disturbed=disturbed)(x, force, queue[:m], w)
    state = ca.vertcat(x, force, xi_pred, e, frozen, under_way)
    given = ca.vertcat(p_ref, xi_ref, v_ff, noise, w)
    state_next = ca.vertcat(x_next, force_next, xi_pred_next, e_next, frozen_next, queue[m:])
    row = ca.vertcat(x, true, y, xi_hat, v, force, frozen_next, plant.contact(x))
    rest = ca.Function("rest", [state, given, v0], [state_next, row])
    # v0(z) is a table, which scalar expressions cannot look up: only the look-up is left outside of them.
    grid = c.feedforward.z_grid
    position = y[plant.stroke_output]
    where = ca.Function("where", [state, given], [ca.fmax(ca.fmin(position, grid[-1]), grid[0])])
    table = ca.interpolant("table", "linear", [grid], c.feedforward.v0.ravel())
    S, U = ca.MX.sym("state", state.numel()), ca.MX.sym("given", given.numel())
    return ca.Function("step", [S, U], rest(S, U, table(where(S, U))))


def _quantized(y: ca.SX, resolution: tuple[float, ...]) -> ca.SX:
    return ca.vertcat(*(r * ca.floor(y[i] / r + 0.5) if r else y[i] for i, r in enumerate(resolution)))


def state_references(
    believed: Plant, c: Controller, motion: references.Motion
) -> tuple[FloatArray, FloatArray]:
    """xi* = (P(z*)^-1 p*, its derivative, the stored feedforward) and v_ff = mass z*'' on the thrust."""
    p, dp = ca.SX.sym("p", len(c.measurements)), ca.SX.sym("dp", len(c.measurements))
    q = believed.position_of(p)
    inverse = ca.Function("inverse", [p, dp], [ca.densify(ca.vertcat(q, ca.jtimes(q, p, dp)))])
    (xi_ref,) = _evaluate(inverse.map(len(motion.p)), motion.p, motion.dp)
    v_ff = np.zeros((len(motion.p), len(c.forces)))
    v_ff[:, believed.thrust_input] = c.feedforward.mass * motion.ddp[:, believed.stroke_output]
    past = [np.vstack([np.repeat(v_ff[:1], age, axis=0), v_ff[:-age]]) for age in range(c.delay, 0, -1)]
    return np.hstack([xi_ref, *past]), v_ff


def _surroundings(plant: Plant, scenario: Scenario, t: FloatArray) -> list[FloatArray]:
    """Sensor noise, and the external wrench if there is one."""
    rng = np.random.default_rng(scenario.seed)
    noise = scenario.noise * np.array(plant.noise) * rng.standard_normal((len(t), len(plant.outputs)))
    if scenario.disturbance is None:
        return [noise]
    wrench = np.asarray(scenario.disturbance(t), dtype=float)
    shape = (len(t), len(plant.disturbances))
    if wrench.shape != shape or not np.isfinite(wrench).all():
        raise InputError(
            f"scenario {scenario.name}", "disturbance", f"shape {wrench.shape}", f"finite, shape {shape}"
        )
    return [noise, wrench]


def _start(
    plant: Plant, believed: Plant, c: Controller, scenario: Scenario, first: FloatArray, delay: int
) -> FloatArray:
    """On the reference and moving with it, or as the scenario says; the observer knows it, and v0 acts."""
    p, n = len(plant.outputs), len(c.states)
    design = [s.name for s in plant.design_states]
    rest = dict(zip(design, first[p : p + len(design)], strict=True)) | dict(scenario.start)
    x = plant.at(**rest).x
    xi_pred = np.zeros(n)
    xi_pred[: len(design)] = x[list(plant.controlled)]
    position = float(np.array(plant.h(ca.DM(x), 0))[plant.stroke_output, 0])
    ratio = np.array(plant.actuator.force_constant) / np.array(believed.actuator.force_constant)
    v0 = ratio * c.feedforward.at(position)
    return np.concatenate([x, v0, xi_pred, np.zeros(2 * p), np.tile(v0, delay)])


def _first_stop(plant: Plant, part: FloatArray) -> tuple[int, str] | None:
    """The first sample of a block at which the machine touches something or its state is no number."""
    contact = part[:, -len(plant.contacts) :]
    lost = np.atleast_1d(~np.isfinite(part).all(axis=1))
    stopped = np.flatnonzero(lost | (contact >= 1).any(axis=1))
    if not len(stopped):
        return None
    k = int(stopped[0])
    return k, "diverged" if lost[k] else plant.contacts[int(contact[k].argmax())]


@dataclass(frozen=True)
class StrokeFigures:
    """What the published figures say of a stroke. SI."""

    rise: float  # s, 10 to 90 % of the true position; NaN when it was not reached
    overshoot: float  # beyond the end, as a share of the stroke
    axial_error: float  # m, largest |z* - z|
    radial: Mapping[str, float]  # m, largest deviation of each radial output
    force: float  # N, largest commanded thrust
    current: float  # A, largest commanded current of any axis


def stroke_figures(run: Trajectory) -> StrokeFigures:
    """Rise, overshoot, tracking error and radial deviation of a stroke."""
    names = [s.name for s in run.plant.outputs]
    axis = run.plant.stroke_output
    z, z_ref = run.p[:, axis], run.reference[:, axis]
    start, end = z_ref[0], z_ref[-1]
    share = (z - start) / (end - start)
    error = np.abs(run.p - run.reference)
    done = run.verdict.completed
    return StrokeFigures(
        rise=_reached(run.t, share, 0.9) - _reached(run.t, share, 0.1) if done else math.nan,
        overshoot=max(float(share.max()) - 1, 0.0),
        axial_error=float(error[:, axis].max()),
        radial={name: float(error[:, i].max()) for i, name in enumerate(names) if i != axis},
        force=float(np.abs(run.v[:, run.plant.thrust_input]).max()),
        current=float(np.abs(run.current).max()),
    )


def _reached(t: FloatArray, share: FloatArray, level: float) -> float:
    k = int(np.argmax(np.asarray(share) >= level))
    if k == 0:
        return math.nan
    return float(np.interp(level, share[k - 1 : k + 1], t[k - 1 : k + 1]))


def save(run: Trajectory, path: str | Path) -> Path:
    """Write the time series as .npz: t, and a named array for every kind of signal with the names of its columns."""
    path = Path(path)
    columns = {
        "reference": run.plant.outputs,
        "p": run.plant.outputs,
        "y": run.plant.outputs,
        "x": run.plant.states,
        "xi_hat": run.controller.states,
        "v": run.plant.inputs,
        "force": run.plant.inputs,
        "saturated": run.plant.inputs,
    }
    arrays: dict[str, Any] = {"t": run.t, "verdict": np.array([run.verdict.name])}
    for name, signals in columns.items():
        arrays[name] = getattr(run, name)
        arrays[f"{name}_columns"] = np.array([f"{s.name} [{s.unit}]" for s in signals])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    replace_files({path: buffer.getvalue()})
    return path
