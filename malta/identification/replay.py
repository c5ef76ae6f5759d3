"""The law on a logged machine's readings: does it command what was logged, and are its innovations white?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.log import Log, reference_spline, require_same_law
from malta.model.data import plant_of
from malta.simulation.inputs import Inputs, initial_values, sample_inputs
from malta.simulation.layout import layout_of
from malta.simulation.period import law_reference
from malta.simulation.references import Motion
from malta.simulation.scenario import Scenario, Simulation, simulation_of
from malta.synthesis.controller import (
    Controller,
    commanded,
    estimated,
    filtered,
    freeze_moving,
    gains_of,
    look_ahead,
    sum_errors,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

SAME = 1e-6  # of a force's limit: commands that differ by less are the same, in files of nine digits too
SETTLED = 0.5  # of a log, after which the start of the filter is forgotten
LAGS = 20  # samples, over which innovations are tested
BLOCK = 1000  # samples in one call


@display
@dataclass(frozen=True, eq=False)
class LawReplay:
    """A law that ran on logged readings.

    v : k x m, what it commands
    innovation : k x p, reading less the filter's prediction
    difference : by input: the largest difference to the logged command, N or N m, in the second half of the log
    at_once : by input: the same from the first sample on
    rms : by output: of the innovation in the second half, SI
    expected : by output: noise and steps of the machine's sensors, SI
    whiteness : by output: the largest autocorrelation of the innovation over 20 samples, in standard deviations
    same : whether all commands are the logged ones, but for rounding

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> found = malta.identification.replay_law(
    ...     controller, malta.identification.log_of(run)
    ... )
    >>> found.v.shape, found.innovation.shape
    ((2000, 5), (2000, 5))
    """

    v: FloatArray
    innovation: FloatArray
    difference: Mapping[str, float]
    at_once: Mapping[str, float]
    rms: Mapping[str, float]
    expected: Mapping[str, float]
    whiteness: Mapping[str, float]
    same: bool

    @property
    def description(self) -> Description:
        """Whether the commands are those of the log, and how large the innovations are."""
        rows = [("commands", "as logged" if self.same else "others than logged")]
        rows += [(f"{name} differs by", f"{value:.2g}") for name, value in self.difference.items()]
        return Description(f"Replay of {len(self.v)} samples", tuple(rows))


def replay_law(controller: Controller, log: Log) -> LawReplay:
    """Run a law on logged readings and compare what it commands, sample by sample.

    The filter starts at rest at the first reference, as a run of `malta.simulate` does; a log that begins in flight
    agrees once that start is forgotten, which the second half of the log shows. Derivatives of the reference are taken
    from its samples.

    controller : the gain file
    log : with measured outputs, commands and reference

    Returns a LawReplay.

    Raises InputError for a log without these columns, CheckError for another machine, another sample time or missing
    samples.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> malta.identification.replay_law(controller, malta.identification.log_of(run)).same
    True
    """
    plant = plant_of(controller.parameters)
    require_same_law(log, plant.name, controller.sample_time)
    y = log.table("y", [s.name for s in plant.outputs])
    v = log.table("v", [s.name for s in plant.inputs])
    if not (np.isfinite(y).all() and np.isfinite(v).all()) or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing, and a law cannot run on")
    simulation, inputs = _inputs(controller, log)
    commands, innovation = _run(simulation, inputs, y)
    half = int(SETTLED * len(y))
    off = np.abs(commands - v)
    late = innovation[half:]
    names, forces = [s.name for s in plant.outputs], [s.name for s in plant.inputs]
    noise = np.sqrt(np.array(plant.noise) ** 2 + np.array(plant.resolution) ** 2 / 12)
    largest = off[half:].max(axis=0)
    return LawReplay(
        commands,
        innovation,
        difference=dict(zip(forces, largest.tolist(), strict=True)),
        at_once=dict(zip(forces, off.max(axis=0).tolist(), strict=True)),
        rms=dict(zip(names, np.sqrt((late**2).mean(axis=0)).tolist(), strict=True)),
        expected=dict(zip(names, noise.tolist(), strict=True)),
        whiteness={name: whiteness(column) for name, column in zip(names, late.T, strict=True)},
        same=bool((largest <= SAME * controller.limits.force).all()),
    )


def whiteness(values: FloatArray) -> float:
    """The largest autocorrelation of a series over LAGS samples, in standard deviations of a white one."""
    centred = values - values.mean()
    power = float(centred @ centred)
    if power == 0 or len(centred) <= LAGS + 1:
        return 0.0
    lags = [abs(float(centred[k:] @ centred[:-k])) / power for k in range(1, LAGS + 1)]
    return max(lags) * float(np.sqrt(len(centred)))


def _inputs(controller: Controller, log: Log) -> tuple[Simulation, Inputs]:
    """What the law was given at every sample, from the reference and the excitation of a log."""
    plant, Ts = plant_of(controller.parameters), controller.sample_time
    p = log.table("reference", [s.name for s in plant.outputs])
    t = Ts * np.arange(log.samples)
    spline = reference_spline(log, [s.name for s in plant.outputs], Ts)
    motion = Motion(p, spline(t, 1), spline(t, 2))
    sent = log.columns.get("excitation", np.zeros((log.samples, 0)))
    excitation = (lambda _: sent) if sent.any() else None

    def reference(_: Any) -> Any:
        return lambda _: motion

    scenario = Scenario("replay", log.samples * Ts, reference, fidelity="force", excitation=excitation)
    simulation = simulation_of(plant, controller, scenario)
    return simulation, Inputs(t, motion, sample_inputs(simulation, motion, t))


def _run(simulation: Simulation, inputs: Inputs, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Commands and innovations of the law on readings y."""
    plant, c, _, _ = simulation
    p, n = len(plant.outputs), len(c.states)
    _, xi, _ = initial_values(simulation, inputs.given[0])
    z = y[:, plant.stroke_output] if plant.has_stroke else np.zeros(len(y))
    table = c.feedforward
    v0 = np.column_stack([np.interp(z, table.z_grid, column) for column in table.v0.T])
    state = np.concatenate([xi, np.zeros(2 * p)])
    given = np.hstack([inputs.given, y, v0])
    chain = _law_chain(simulation)
    rows = []
    for first in range(0, len(y), BLOCK):
        block = given[first : first + BLOCK]
        padded = np.vstack([block, np.repeat(block[-1:], BLOCK - len(block), axis=0)])
        states, out = chain(state, padded.T)
        state = np.array(states)[:, len(block) - 1]
        rows.append(np.array(out)[:, : len(block)].T)
    table_of_rows = np.vstack(rows)
    if table_of_rows.shape[1] != len(c.forces) + p:
        raise InputError("replay", "law", f"{n} states", "those of the gain file")
    return table_of_rows[:, : len(c.forces)], table_of_rows[:, len(c.forces) :]


@lru_cache(maxsize=4)
def _law_chain(simulation: Simulation) -> ca.Function:
    """BLOCK samples of the law: (xi_pred, e, frozen; given, y, v0) -> states, (v, innovation)."""
    plant, c, _, setup = simulation
    p, n, m = len(plant.outputs), len(c.states), len(c.forces)
    sizes = layout_of(plant, c, setup).given
    state = ca.SX.sym("state", n + 2 * p)
    given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    y, v0 = ca.SX.sym("y", p), ca.SX.sym("v0", m)
    g = {name: ca.SX(value) for name, value in (gains_of(c) | {"rate": ca.DM(c.feedforward.rate)}).items()}
    xi_pred, e, frozen = state[:n], state[n : n + p], state[n + p :]
    taken = filtered(c.tracks, y, given["p_ref"])
    xi_hat = estimated(g, xi_pred, taken)
    waiting = freeze_moving(g, frozen, given["dp_ref"])
    sums = sum_errors(g, e, waiting, y, given["p_ref"])
    xi_ref = law_reference(c, plant_of(c.parameters), g, given)
    after, saturated, v = commanded(g, xi_hat, sums, xi_ref, given["v_ff"], v0)
    after, _ = look_ahead(g, after, y, given["dp_ref"])
    innovation = taken - g["Cd"] @ xi_pred
    inputs = ca.vertcat(*given.values(), y, v0)
    step = ca.Function(
        "step",
        [state, inputs],
        [ca.densify(ca.vertcat(after, sums, saturated)), ca.densify(ca.vertcat(v, innovation))],
    )
    return step.mapaccum("replay", BLOCK)
