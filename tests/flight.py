"""The derivative of a simulated control period at rest: what flies, against which the linear loop is tested."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.linalg import matrix_balance

import malta
from malta.machines.tubular import experiments
from malta.simulation.experiments import catalogue
from malta.simulation.experiments.worst_load import WORST_LOAD
from malta.simulation.layout import fidelities, layout_of, numbers_of, places_of
from malta.simulation.period import chain, initial_state, period_of
from malta.simulation.scenario import setup_of
from malta.simulation.steps import steps_of
from malta_papers.tubular import experiments as printed

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.model.plant import Plant
    from malta.simulation.layout import Fidelity
    from malta.synthesis.controller import Controller


# Of MALTA, with those of its paper and of every machine, as a user has them.
EXPERIMENTS = experiments.EXPERIMENTS | printed.EXPERIMENTS | {WORST_LOAD: catalogue.EXPERIMENTS[WORST_LOAD]}
CASES = experiments.CASES | printed.CASES | {WORST_LOAD: catalogue.CASES[WORST_LOAD]}


def default_of(plant: Plant) -> Fidelity:
    """The fidelity in which simulations run unless another is asked for."""
    return "dq" if "dq" in fidelities(plant) else "force"


def derivative_at_rest(plant: Plant, c: Controller, position: FloatArray, least: int = 40) -> FloatArray:
    """The state matrix of a control period at rest: default fidelity, noise and quantizers off.

    position : the states of the machine there
    least : Runge-Kutta steps in a sample, so that their error is far below 1e-6 of every pole
    """
    rest = malta.Scenario("rest", 0.1, malta.references.hold, fidelity=default_of(plant))
    s = setup_of(plant, c, rest)
    count = max(least, 16 * steps_of(plant, c, rest) if plant.actuator.electronics else 0)
    p = period_of(plant, c, s, numbers_of(plant, c, count), constant=True)
    period, sizes = chain(p, c, count, 1), layout_of(plant, c, s)
    S, U = ca.MX.sym("S", period.size1_in(0)), ca.MX.sym("U", period.size1_in(1))
    after = period(S, U)[0]
    asks = places_of(sizes.given)["p_ref"]
    step = ca.Function("step", [S, U], [after, ca.jacobian(after, S), ca.jacobian(after, U)[:, asks]])
    where = places_of({**sizes.machine, **sizes.controller})
    y = np.array(ca.DM(plant.h(ca.DM(position), 0))).ravel()
    given = np.zeros(period.size1_in(1))
    given[asks] = y
    state = _start(plant, c, s, position)
    fixed = [where["x"].start + k for k, x in enumerate(plant.states) if x.name in plant.uncontrolled]
    fixed += [
        k
        for name in ("frozen", "u_limited")
        if name in where
        for k in range(*where[name].indices(len(state)))
    ]
    keep = np.setdiff1d(np.arange(len(state)), fixed)
    to_y = np.zeros((len(y), len(state)))
    x = ca.SX.sym("x", len(plant.states))
    to_y[:, where["x"]] = ca.Function("C", [x], [ca.densify(ca.jacobian(plant.h(x, 0), x))])(position)
    for k in range(12):
        found, J, by_reference = (np.array(M) for M in step(state, given))
        A: FloatArray = J[np.ix_(keep, keep)]
        left = np.column_stack([found.ravel() - state, by_reference])[keep]
        _, (scale, _) = matrix_balance(A, permute=False, separate=True)
        still = np.eye(len(keep)) - A * scale / scale[:, None]
        change = scale[:, None] * np.linalg.lstsq(still, left / scale[:, None], rcond=1e-14)[0]
        state[keep] += change[:, 0]
        off = y - np.array(ca.DM(plant.h(ca.DM(state[where["x"]]), 0))).ravel()
        if k > 4 and np.abs(off).max() < 1e-11:
            break
        # A law without integrals rests beside its reference.
        more = np.linalg.lstsq(to_y[:, keep] @ change[:, 1:], off, rcond=None)[0]
        given[asks] += more
        state[keep] += change[:, 1:] @ more
    return A


def _start(plant: Plant, c: Controller, s: Any, position: FloatArray) -> FloatArray:
    """The state of machine and controller near rest."""
    hold = malta.trim(plant, **{x.name: v for x, v in zip(plant.states, position.tolist(), strict=True)}).u
    current = malta.plant_of(c.parameters).actuator.currents(plant.h(ca.DM(position), 0), ca.DM(hold))
    known = np.zeros(len(c.states))
    if c.tracks == "states":
        known[: len(c.A)] = position[list(plant.controlled)]
    return np.array(
        ca.evalf(initial_state(plant, c, s, ca.DM(position), ca.DM(known), ca.DM(current)))
    ).ravel()


def poles(matrix: FloatArray, Ts: float) -> ComplexArray:
    """The poles of a sampled state matrix in rad/s, ln(z) / Ts, without those of pure delay."""
    found = np.linalg.eigvals(matrix).astype(complex)
    return np.asarray(np.log(found[np.abs(found) > 1e-3]) / Ts)
