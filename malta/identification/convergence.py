"""By how much the error of a stroke shrinks to the next one, proven over a box of parameters.

With the response T(p) of the stroke to thrust beside the law's, and that of the gain file's own machine, T_0, learning
with the gain a leaves

    e_(j+1) = (1 - a T(p) / T_0) e_j

of an error e_j that thrust can make. As a multiplication along frequency its norm is at most

    c = sup over w and p of |1 - a T(e^jwTs; p) / T_0(e^jwTs)|

on all time, and below 1 the error shrinks from stroke to stroke (Norrlof and Gunnarsson, Int. J. Control 75(14), 2002).
The supremum is the gain of one more command of the law, from one more reading w:

    w --> [ V ] --> sum of errors of the stroke --> ... --> z        V = z^-r B / T_0
    w --> [ z^-r B ] --> o --> e_out                                 |B| = 1 on the circle: the all-pass of those zeros
                    -a z ^                                           of T_0 that lie outside

so that `malta.worst_case_gain` encloses it. Wherever in a law of one reading and one force thrust enters, T(p) / T_0 is
the same; entering at a sum of errors takes away the zero of T_0 at z = 1. The states are those through which this sum
moves the stroke, by the structure of the matrices.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import linalg, signal

from malta.arrays import ComplexArray
from malta.errors import InputError
from malta.identification.strokes import FORCE
from malta.linear.branches import INTERVALS, Interval
from malta.linear.closed_loops import closed_loop
from malta.linear.interconnection import gain as of_gain, series
from malta.linear.system import System
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.loop import loop
from malta.model.plants import plant_of
from malta.proof.blocks.gain import Gain, worst_case_gain
from malta.proof.box import box_of
from malta.proof.groups import loop_of
from malta.synthesis.controller import Controller

TOLERANCE = 1e-2  # relative distance between the proven bound and the largest value found
MODEL_TOLERANCE = 1e-6  # by which V T_0 may miss z^-r B
CIRCLE_DISTANCE = 1e-9  # by which a zero of T_0 has to be off the circle


class StrokeLoop(NamedTuple):
    """The states through which one sum of errors moves the stroke, as a loop of their own."""

    system: UncertainSystem
    law: Compensator
    summed: int  # the law's state that is this sum
    stroke: int  # the reading of the stroke

    @property
    def response(self) -> System:
        """T_0 / (z - 1): from the sum to the stroke, of the nominal parameters."""
        Ts = self.law.sample_time
        assert Ts is not None
        (slopes,) = closed_loop(self.system, self.law, self.system.nominal)
        n = len(slopes)
        A, B, C = np.eye(n) + Ts * slopes, np.zeros((n, 1)), np.zeros((1, n))
        B[n - len(self.law.A) + self.summed] = 1
        out = self.system.every(self.system.nominal)[2][0][self.stroke]
        C[0, : len(out)] = out
        return System(A, B, C, np.zeros((1, 1)), None, Ts)


def contraction(controller: Controller, box: Mapping[str, float], *, time: float | None = None) -> Gain:
    """Prove by how much the error of a stroke shrinks to the next one, over a box: below 1 it shrinks.

        c = sup of |1 - 0.8 T(e^jwTs; p) / T_0(e^jwTs)|      over all frequencies and all parameters of the box

    bounds the 2-norm of what `next_stroke` leaves of an error that thrust can make, where it learns with its full
    gain. With a share s of this gain, 1 - s (1 - c) is the bound. It covers the linear sampled loop at the operating
    point with the slope of its loads there, not that of positions along the stroke. It does not cover saturation, noise
    that differs from stroke to stroke, or a response that goes on after the log has ended. By how much V misses the
    inverse of T_0 is proven too, and included.

    controller : the gain file
    box : parameters with shares of their values, as {"m": 0.2}
    time : s, longest search; None: 120

    Returns a Gain; its `upper` is the bound, None where nothing is proven, and `reason` says why.

    Raises InputError for a machine without a stroke, a law without sums of errors, and no or unknown parameters.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> found = malta.identification.contraction(controller, {"K_D": 0.2})
    >>> found.upper is not None and found.upper < 0.7
    True
    """
    plant = plant_of(controller.parameters)
    if not plant.has_stroke:
        found = f"a {plant.name}, which has no stroke"
        raise InputError("contraction", "machine", found, "a machine with a stroke")
    if not box:
        raise InputError("contraction", "box", "no parameter", 'parameters with shares, as {"m": 0.2}')
    system, law = loop(plant, controller).uncertain(tuple(box))
    if system.matrices.n_out() > 3:
        return _unproven("currents that depend on the position and are held are not covered")
    axis = _axis(system, law, plant.stroke_output)
    inverse = _inverse(axis)
    if inverse is None:
        return _unproven("the stroke's response has no inverse")
    missed = _bound_of_miss(axis, *inverse)
    if missed is None or not missed < MODEL_TOLERANCE:
        return _unproven("the inverse of the stroke's response is not proven to be near enough")
    learning, law = _learning_loop(axis, *inverse, FORCE)
    channel = (law.C.shape[0] - 1, law.B.shape[1] - 1)
    entries = _as_entries(learning, law, box)
    system, ranges = (learning, dict(box)) if entries is None else entries
    asked = partial(worst_case_gain, of="effort", channel=channel, tolerance=TOLERANCE)
    gain = asked(system, law, ranges, time=time)
    if entries is not None:
        gain = _at_corner(gain, learning, box, lambda corner, fixed: asked(corner, law, fixed))
    if gain.upper is None:
        return gain
    return replace(gain, upper=gain.upper + (1 + gain.upper) * missed / (1 - missed))


def _as_entries(
    system: UncertainSystem, law: Compensator, box: Mapping[str, float]
) -> tuple[UncertainSystem, dict[str, tuple[float, float]]] | None:
    """The system in those entries of its matrices that move over the box, and their intervals there.

    None where these are none, or not fewer than parameters. K_D / m is one entry: a box of two parameters is cut into
    far more pieces. The intervals contain all values of the box, so what is proven for them holds for it.
    """
    program = loop_of(system, law).program
    moves: list[bool] = []
    for name, _, operands, _ in program.steps:
        moves.append(name == "input" or any(moves[k] for k in operands))
    steps = sorted({k for entries in program.entries for _, _, k in entries if moves[k]})
    if not 0 < len(steps) < len(box):
        return None
    sides = box_of(system.names, system.nominal, system.limits, dict(box), {}, caller="contraction").sides(
        1.0
    )
    cells = program.cells([Interval(low, high) for low, high in sides.tolist()], INTERVALS)
    points = program.cells([Interval(x, x) for x in system.nominal.tolist()], INTERVALS)
    names = tuple(f"entry {k}" for k in steps)
    p, q = ca.SX.sym("p", len(system.names)), ca.SX.sym("q", len(steps))
    matrices = [ca.SX(M) for M in system.matrices.call([p])]
    for M, entries in zip(matrices, program.entries, strict=True):
        for i, j, k in entries:
            if moves[k]:
                M[i, j] = q[steps.index(k)]
    nominal = np.array([points[k].low for k in steps])
    made = UncertainSystem(names, nominal, ca.Function("entries", [q], matrices))
    return made, {name: (cells[k].low, cells[k].high) for name, k in zip(names, steps, strict=True)}


def _at_corner(
    gain: Gain, system: UncertainSystem, box: Mapping[str, float], ask: Callable[..., Gain]
) -> Gain:
    """The gain with the largest one of the box's corners: the entries of its own witness may be those of no machine."""
    shares = np.array([box[name] for name in system.names])
    corners = system.nominal * (1 + np.array(list(product((-1.0, 1.0), repeat=len(shares)))) * shares)
    flat = np.hstack([M.reshape(len(corners), -1) for M in system.every(corners)])
    _, first = np.unique(flat, axis=0, return_index=True)
    found = []
    for p in corners[first]:
        fixed = {name: (x, x) for name, x in zip(system.names, p.tolist(), strict=True)}
        found.append(ask(replace(system, nominal=p), fixed))
    best = max(found, key=lambda one: one.lower)
    witness = dict(zip(system.names, corners[first][found.index(best)].tolist(), strict=True))
    return replace(gain, lower=best.lower, frequency=best.frequency, witness=witness)


def _unproven(reason: str) -> Gain:
    return Gain(math.nan, None, math.nan, {}, 0, 0.0, reason)


def _axis(system: UncertainSystem, law: Compensator, stroke: int) -> StrokeLoop:
    """The loop of the states between a sum of errors and the stroke. Raises InputError for a law without sums."""
    program = loop_of(system, law).program
    A, B, C = (np.zeros(shape, dtype=bool) for shape in program.shapes[:3])
    for M, entries in zip((A, B, C), program.entries, strict=False):
        for i, j, _ in entries:
            M[i, j] = True
    n, k = len(A), len(law.A)
    u, y = n + k, n + k + B.shape[1]
    # Signal flow among states of the plant, those of the law, commands and readings: rows hang on columns.
    flow = np.zeros((y + len(C),) * 2, dtype=bool)
    flow[:n, :n], flow[:n, u:y], flow[n:u, n:u], flow[n:u, y:] = A, B, law.A != 0, law.B != 0
    flow[u:y, n:u], flow[u:y, y:], flow[y:, :n] = law.C != 0, law.D != 0, C
    sums = range(k - law.integrals, k)
    for i in sums:
        keep = _reachable(flow, n + i) & _reachable(flow.T, y + stroke)
        if keep[y + stroke] and keep[n + i]:
            break
    else:
        raise InputError(
            "contraction", "law", "no sum of errors that moves the stroke", "a law with integrals"
        )
    x, own, ins, outs = (np.flatnonzero(keep[a:b]) for a, b in ((0, n), (n, u), (u, y), (y, len(flow))))
    p = ca.SX.sym("p", len(system.names))
    matrices = [ca.SX(M) for M in system.matrices.call([p])[:3]]
    of = ((x, x), (x, ins), (outs, x))
    cut = [M[rows.tolist(), columns.tolist()] for M, (rows, columns) in zip(matrices, of, strict=True)]
    small = replace(system, matrices=ca.Function("axis", [p], cut))
    of_axis = replace(
        law, A=law.A[np.ix_(own, own)], B=law.B[np.ix_(own, outs)], C=law.C[np.ix_(ins, own)],
        D=law.D[np.ix_(ins, outs)], integrals=int((own >= k - law.integrals).sum()),
    )  # fmt: skip
    return StrokeLoop(small, of_axis, int(np.searchsorted(own, i)), int(np.searchsorted(outs, stroke)))


def _reachable(flow: NDArray[np.bool_], start: int) -> NDArray[np.bool_]:
    """Whether a signal reaches each of the others."""
    found = np.zeros(len(flow), dtype=bool)
    found[start] = True
    while (grown := found | flow[:, found].any(axis=1)).sum() > found.sum():
        found = grown
    return found


def _bound_of_miss(axis: StrokeLoop, inverse: System, passed: System) -> float | None:
    """A proven bound of |z^-r B - V T_0| over all frequencies; None where nothing is proven."""
    system, law = _learning_loop(axis, inverse, passed, 1.0)
    channel = (law.C.shape[0] - 1, law.B.shape[1] - 1)
    own = {name: (x, x) for name, x in zip(system.names, system.nominal.tolist(), strict=True)}
    return worst_case_gain(system, law, own, of="effort", channel=channel, tolerance=TOLERANCE).upper


def _inverse(axis: StrokeLoop) -> tuple[System, System] | None:
    """V and z^-r B, in floating point; None where there is no V."""
    of = axis.response
    n, r, answer = len(of.A), 1, of.B
    while not (of.C @ answer).any() and r < n:  # samples until the stroke answers: so many zeros are missing
        r, answer = r + 1, of.A @ answer
    zeros, poles = 1 + replace(of, A=of.A - np.eye(n)).zeros, np.linalg.eigvals(of.A).astype(complex)
    zeros = zeros[np.argsort(np.abs(zeros))[: n - r]]
    outside = np.abs(zeros) > 1
    if len(zeros) < n - r or (np.abs(np.abs(zeros) - 1) < CIRCLE_DISTANCE).any():
        return None
    far, at = zeros[outside].conj(), np.exp(1j * np.array([0.01, 0.02]) * np.pi)
    scale = (
        np.prod(at[:, None] - poles, axis=1) / np.prod(at[:, None] - zeros, axis=1) * of.response(at)[:, 0, 0]
    )
    kept = np.concatenate([zeros[~outside], 1 / far, np.zeros(r)])
    one = np.ones((1, 1))
    try:
        inverse = _filter(poles, kept, 1 / float((scale.mean() * np.prod(-far)).real))
        passed = _filter(zeros[outside], 1 / far, float((1 / np.prod(-far)).real))
    except ValueError:  # rounding has parted zeros or poles that are conjugate
        return None
    for _ in range(r):
        passed = series(passed, System(0 * one, one, one, 0 * one))
    return inverse, passed


def _filter(zeros: ComplexArray, poles: ComplexArray, gain: float) -> System:
    """As many zeros as poles, as sections of second order in z - 1: slow ones lie close to 1."""
    found = of_gain(np.full((1, 1), gain))
    if not len(poles):
        return found
    sections: Any = signal.zpk2sos(zeros, poles, 1.0)  # type: ignore[arg-type]  # complex ones in pairs
    for b0, b1, b2, _, a1, a2 in sections:
        c1, c2 = b1 - a1 * b0, b2 - a2 * b0
        A = np.array([[-1 - a1, -(1 + a1 + a2)], [1.0, 1.0]])
        section = System(A, np.array([[1.0], [0.0]]), np.array([[c1, c1 + c2]]), np.array([[b0]]))
        found = series(found, section)
    return found


def _learning_loop(
    axis: StrokeLoop, V: System, passed: System, share: float
) -> tuple[UncertainSystem, Compensator]:
    """The axis with one more reading w and one more command e_out = (z^-r B - share T V) w, both last."""
    system, c = axis.system, axis.law
    n, (m, q), more = len(c.A), c.D.shape, len(V.A) + len(passed.A)
    into = np.eye(n)[:, axis.summed : axis.summed + 1]
    A = linalg.block_diag(c.A, V.A, passed.A)
    A[:n, n : n + len(V.A)] = into @ V.C
    B = np.hstack([np.vstack([c.B, np.zeros((more, q))]), np.vstack([into @ V.D, V.B, passed.B])])
    C = linalg.block_diag(np.hstack([c.C, np.zeros((m, len(V.A)))]), passed.C)
    D = linalg.block_diag(c.D, passed.D)
    D[m, axis.stroke] = -share
    order = [*range(n - c.integrals), *range(n, n + more), *range(n - c.integrals, n)]
    law = replace(c, A=A[np.ix_(order, order)], B=B[order], C=C[:, order], D=D)
    p = ca.SX.sym("p", len(system.names))
    P, Q, R = (ca.SX(M) for M in system.matrices.call([p]))
    wider = [P, ca.horzcat(Q, ca.SX(P.shape[0], 1)), ca.vertcat(R, ca.SX(1, P.shape[0]))]
    return replace(system, matrices=ca.Function("learning", [p], wider)), law
