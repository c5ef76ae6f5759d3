"""A reference followed by the linear loop of a machine: what a simulation shows, in milliseconds and without limits.

    X+ = M X + G r + E w,   p = C X,   v = K X + D r        X = (machine, law), r = (p*, xi*, v_ff, v0), w loads

The loop is `malta.loop`: hold, delay, current loops, late sensors, loads against v0(z) at the
trim. Forces that saturate, sums of errors that wait, and what changes along the way are left to `simulate`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.loops.sampled_loops import SampledLoop
from malta.model.places import outputs_at
from malta.model.plants import plant_of
from malta.simulation.engine.engines import evaluate
from malta.simulation.inputs import feedforward, motion_of, past_forces
from malta.simulation.period import state_reference
from malta.simulation.references import Motion
from malta.simulation.scenario import Scenario
from malta.synthesis.controller import Controller

MAX_SAMPLES = 20_000  # samples


class LinearRun(NamedTuple):
    """A reference and its answer, one row a sample, SI."""

    t: FloatArray  # s, k
    reference: FloatArray  # k x p
    p: FloatArray  # k x p, true outputs
    v: FloatArray  # k x m, commanded forces beside those that hold the machine at its operating point


def linear_run(loop: SampledLoop, controller: Controller, scenario: Scenario) -> LinearRun:
    """Follow the reference of a scenario with the linear loop, which starts at rest on the reference, under its loads.

    loop : `malta.loop(machine, controller).sampled`

    Raises InputError for more than MAX_SAMPLES samples.
    """
    c, law, plant = controller, loop.control, plant_of(controller.parameters)
    samples = max(1, round(scenario.duration / c.sample_time))
    if samples > MAX_SAMPLES:
        raise InputError(scenario.where, "duration", f"{samples} samples", f"at most {MAX_SAMPLES}")
    t = np.arange(samples) * c.sample_time
    motion = motion_of(scenario, plant, c, t)
    here = outputs_at(plant, plant.point(c.operating_point[0]).x)
    r = law_references(c, motion, here)
    closed, driven = loop.closed, r @ np.vstack([loop.Bd @ law.D_r, law.B_r]).T
    n, m = len(loop.Ad), len(c.forces)
    with np.errstate(all="ignore"):  # an unstable loop runs away
        rest = solve_rest(closed, driven[0])
        if scenario.disturbance is not None and loop.pushed is not None:
            driven[:, :n] += np.asarray(scenario.disturbance(t)) @ loop.pushed.T
        X = _follow(closed, driven, rest)
        p = here + X[:, :n] @ loop.outputs.T
        v = X @ np.hstack([law.D_y @ loop.Cd, law.C])[:m].T + r @ law.D_r[:m].T
    return LinearRun(t, motion.p, p, v)


BLOCK = 32  # samples that are stepped through at once


def _follow(closed: FloatArray, driven: FloatArray, state: FloatArray) -> FloatArray:
    """X+ = M X + d from a state, one row a sample.

    The states within a block are those from zero, all blocks at once, and what its first state grows to.
    """
    samples, n = driven.shape
    blocks = -(-samples // BLOCK)
    d = np.zeros((blocks, BLOCK, n))
    d.reshape(-1, n)[:samples] = driven
    powers, X = [np.eye(n)], np.zeros((blocks, BLOCK, n))
    for k in range(1, BLOCK):
        powers.append(closed @ powers[-1])
        X[:, k] = X[:, k - 1] @ closed.T + d[:, k - 1]
    whole, across = closed @ powers[-1], X[:, -1] @ closed.T + d[:, -1]
    first = np.empty((blocks, n))
    for k in range(blocks):
        first[k] = state
        state = whole @ state + across[k]
    X += (first @ np.concatenate(powers).T).reshape(X.shape)
    return np.asarray(X.reshape(-1, n)[:samples])


def solve_rest(closed: FloatArray, driven: FloatArray) -> FloatArray:
    """The states of which X = M X + G r, for a reference that stands still."""
    left = np.eye(len(closed)) - closed
    try:
        return np.linalg.solve(left, driven)
    except np.linalg.LinAlgError:  # an integral that nothing reads
        return np.asarray(np.linalg.lstsq(left, driven, rcond=None)[0])


def law_references(c: Controller, motion: Motion, here: FloatArray) -> FloatArray:
    """r = (p*, xi*, v_ff, v0) at every sample, as deviations from the operating point; v0 follows the readings."""
    v_ff, hold = feedforward(c, motion), c.feedforward.position
    if hold.size:  # at the operating point it is no deviation
        v_ff = v_ff - c.operating_point[0][: hold.shape[1]] @ hold.T
    zeros, p = np.zeros_like(v_ff), motion.p - here
    if c.tracks == "errors":
        return np.hstack([p, np.zeros((len(p), len(c.states))), v_ff, zeros])
    rest, rates = state_reference(plant_of(c.parameters)), len(c.feedforward.rate)
    states = evaluate(rest.map(len(p)), motion.p, motion.dp)[0] - np.array(rest(here, 0)).ravel()
    if rates:
        states[:, len(c.A) - rates :] += motion.dp @ c.feedforward.rate.T
    return np.hstack([p, states, past_forces(c, motion, v_ff), v_ff, zeros])
