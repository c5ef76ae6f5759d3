"""How far any reference within limits of its position, speed and acceleration drives an error or a force."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from malta.arguments import describe, positive
from malta.arrays import FloatArray, readonly
from malta.errors import CheckError, InputError, require_known
from malta.linear.impulses import impulses
from malta.loops.loop import Loop
from malta.loops.windings import chosen_loops
from malta.model.places import outputs_at
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.simulation.inputs import samples_of_memory
from malta.simulation.linear_run import law_references, solve_rest
from malta.simulation.references import Motion

CALLER = "worst_request"
BLOCKS = 600  # of a response, in each of which the worst request has one acceleration
MOVED = 0.1  # of the limit of position: 8 times the share of it by which a request may turn within a block
STEP = 1e-5  # m or rad, of a reference by which the law is asked how it takes references


class WorstRequest(NamedTuple):
    """The request within limits that drives a signal furthest, and what no request exceeds.

    value : the largest that this request makes, SI
    upper : what no request within the limits exceeds at samples, SI, computed
    unit : of both
    t : s, of the samples of the request, which begins at rest; the last one is the peak
    motion : p, p' and p'' of the reference at these times, beside the operating point, 3 x k, SI
    """

    value: float
    upper: float
    unit: str
    t: FloatArray
    motion: FloatArray


@on_one_thread
def worst_request(loop: Loop, reference: str, output: str, limits: Sequence[float]) -> WorstRequest:
    """Find the request within limits that drives a signal furthest, and bound what any of them does.

        y = sum of h_i p''(k - i) + c p,      |p| <= limits[0], |p'| <= limits[1], |p''| <= limits[2]

    h is the answer to an acceleration of one sample, with the law's feedforward. The largest y is that of a linear
    program in speeds and positions, whose multipliers bound it for all requests. p'' changes at samples, p' is its sum
    and p that of mean speeds: as the exported supervisor makes references, beside the last sample of an approach.

    loop : from `malta.loop`
    reference : an output that is asked to move about the operating point, from rest
    output : "error z" of an output beside its reference, or a command, which is beside that of rest
    limits : of position, speed and acceleration, SI

    Returns a WorstRequest, of the linear loop at samples: no command or voltage reaches its limit, and no axis brakes.

    Raises InputError for signals that the machine does not have, limits that are not above zero, a speed at which sums
    of errors wait, and a law of errors or a commutation whose currents take the reference's speed; CheckError for an
    unstable loop. Source: duality of linear programs, S. Boyd and L. Vandenberghe, Convex Optimization, 2004, 5.2.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/tubular_pid.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> found = malta.worst_request(loop, "z", "error z", (0.01, 0.5, 20.0))
    >>> f"at most {1e6 * found.upper:.1f} um, {1e6 * found.value:.1f} um reached"
    'at most 110.0 um, 109.5 um reached'
    """
    if not isinstance(loop, Loop):
        raise InputError(CALLER, "loop", describe(loop), "a Loop, from malta.loop")
    c, signals = loop.controller, [*loop.plant.outputs, *loop.plant.inputs]
    names, p = [s.name for s in signals], len(loop.plant.outputs)
    require_known([reference], names[:p], CALLER, "reference")
    require_known([output], [*(f"error {name}" for name in names[:p]), *names[p:]], CALLER, "output")
    if not isinstance(limits, Sequence) or len(limits) != 3:
        raise InputError(CALLER, "limits", describe(limits), "three: of position, speed and acceleration")
    P, V, A = (positive(CALLER, f"limits[{i}]", x) for i, x in enumerate(limits))
    j, k = names.index(reference), names.index(output.removeprefix("error "))
    if c.pause.size and 0 < c.pause[j] < V:
        raise InputError(CALLER, "limits[1]", f"{V:g}", f"at most {c.pause[j]:g}, where sums of errors wait")
    if c.commutation or (c.tracks == "errors" and chosen_loops(loop.plant, c, loop.current_loops) == "pi"):
        raise InputError(CALLER, "loop", "currents that follow the reference's speed", "a law without them")
    if not loop.stable:
        raise CheckError(f"{c.name}: an unstable loop moves without limit")
    value, upper, motion = _solve(_answer(loop, j, k), (P, V, A), loop.sample_time)
    t = loop.sample_time * np.arange(motion.shape[1])
    return WorstRequest(value, upper, signals[k].unit, readonly(t), readonly(motion))


class _Answer(NamedTuple):
    """A signal under a reference: y = sum of response_i p''(k - i) + to_speed p' + to_place p."""

    response: FloatArray
    to_speed: float
    to_place: float
    tail: float  # at most the sum of what the response has after its end


def _answer(loop: Loop, j: int, k: int) -> _Answer:
    """The answer of an error or a command to a reference, once the law has forgotten what was before."""
    c, s, T, p = loop.controller, loop.sampled, loop.sample_time, len(loop.plant.outputs)
    law, M, size, believed = s.control, s.closed, samples_of_memory(c) + 3, plant_of(c.parameters)
    here, age = outputs_at(believed, believed.point(c.operating_point[0]).x), np.arange(size)

    def given(*rows: FloatArray) -> FloatArray:
        """What the law is given per unit of a motion, one row a sample."""
        scale, still = STEP / float(np.abs(rows[0]).max()), np.zeros((3, size, p))
        moving = still.copy()
        moving[:, :, j] = scale * np.array(rows)
        asked, rest = (law_references(c, Motion(here + x[0], x[1], x[2]), here) for x in (moving, still))
        return np.asarray((asked - rest) / scale)

    ones, zeros = np.ones(size), np.zeros(size)
    place = given(ones, zeros, zeros)[-1]
    speed = given(T * age, ones, zeros)[-1] - T * age[-1] * place
    moved = T**2 * np.where(age > 0, age - 0.5, 0), T * (age > 0), (age == 1).astype(float)
    r, into = given(*moved), np.vstack([s.Bd @ law.D_r, law.B_r])
    row, direct = np.pad(s.outputs, ((0, 0), (0, len(M) - len(s.Ad))))[k % p], np.zeros(r.shape[1])
    if k >= p:
        row, direct = np.hstack([law.D_y @ s.Cd, law.C])[k - p], law.D_r[k - p]
    X_p = solve_rest(M, into @ place)
    X_v = solve_rest(M, into @ speed - T * X_p)
    to_place, to_speed = row @ X_p + direct @ place - (k == j), row @ X_v + direct @ speed
    x, first = np.zeros(len(M)), []
    for now, p_now, v_now in zip(r, *moved[:2], strict=True):
        first.append(row @ x + direct @ now - ((k == j) + to_place) * p_now - to_speed * v_now)
        x = M @ x + into @ now
    left = impulses(M, row[None], (x - X_p * T**2 * (size - 0.5) - X_v * T)[:, None], np.zeros((1, 1)))
    response = np.concatenate([first[1:], left.values[0, 1:]])
    return _Answer(response, float(to_speed), float(to_place), float(left.tail[0]))


def _solve(y: _Answer, limits: tuple[float, float, float], T: float) -> tuple[float, float, FloatArray]:
    """The largest y of a request with one acceleration in each block, a bound of all requests, and this request."""
    from scipy import optimize, sparse  # 0.2 s to load

    (P, V, A), reached = limits, np.cumsum(np.abs(y.response))
    h = np.pad(y.response, (0, int(np.ceil(V / (A * T))) + 1))  # it may begin by gaining speed
    fine = np.searchsorted(reached, np.linspace(0, reached[-1], BLOCKS)[:-1])
    count = np.clip(len(h) * T / np.sqrt(MOVED * P / A), BLOCKS // 4, 4 * BLOCKS)
    edges = np.unique([*fine.tolist(), *np.linspace(0, len(h), int(count)).astype(int).tolist()])
    n, B = np.diff(edges), len(edges) - 1
    here, older = sparse.eye(B, B + 1), sparse.eye(B, B + 1, k=1)  # of speeds or positions, the newest first
    apart, mean, H = here - older, sparse.diags(T * n / 2) @ (here + older), np.add.reduceat(h, edges[:-1])
    cost = np.concatenate([(H / (T * n)) @ apart, np.zeros(B + 1)])
    cost[[0, B + 1]] += y.to_speed, y.to_place
    cost *= np.repeat([V, P], B + 1)  # all speeds and positions are shares of their limits
    scale = float(np.abs(cost).max()) or 1.0
    turns: Any = sparse.hstack([sparse.vstack([apart, -apart]), sparse.csr_matrix((2 * B, B + 1))])
    moves: Any = sparse.hstack([-V / P * mean, apart])
    found, steps = list[Any](), np.tile(A * T / V * n, 2)
    for end in (1, 0):  # the bound is of all speeds before the response, the request begins at rest
        bounds = [*[(-1, 1)] * B, (-end, end), *[(-1, 1)] * (B + 1)]
        found.append(optimize.linprog(-cost / scale, turns, steps, moves, np.zeros(B), bounds))
    if failed := [one.message for one in found if one.status]:
        raise CheckError(f"the linear program of requests has no answer: {failed[0]}")
    block, middle = np.repeat(np.arange(B), n), np.repeat(edges[:-1] + (n - 1) / 2, n)
    up, down = -scale / V * found[0].ineqlin.marginals.reshape(2, B)
    slow = -scale / P * found[0].eqlin.marginals[block]
    c = (H / n - T * (up - down))[block] - T**2 * slow * (np.arange(len(h)) - middle)
    by_speed = np.diff(c, prepend=-T * y.to_speed, append=0.0) / T
    by_speed += T / 2 * (np.append(slow, 0) + np.append(0, slow))
    by_place = np.diff(slow, prepend=y.to_place, append=0.0)
    upper = A * (np.abs(h - c).sum() + y.tail) + V * np.abs(by_speed).sum() + P * np.abs(by_place).sum()
    u, start = V * found[1].x[: B + 1], P * found[1].x[-1]
    a = (-np.diff(u) / (T * n))[block][::-1]
    speed = np.cumsum(T * np.append(0, a))
    place = start + np.append(0, np.cumsum(T / 2 * (speed[1:] + speed[:-1])))
    motion = np.array([place, speed, np.append(0, a)])
    # Positions are bounded at the ends of blocks.
    within = min(1.0, *(limits / np.abs(motion).max(axis=1).clip(1e-300)))
    return -within * scale * float(found[1].fun), float(upper), within * motion
