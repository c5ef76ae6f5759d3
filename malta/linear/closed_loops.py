"""The closed loop of an uncertain system and its compensator at rows of parameters: matrices and poles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from malta.arrays import ComplexArray, FloatArray
from malta.linear.sampling import add_lags, delay_inputs, sample, split_delay
from malta.linear.uncertain import Compensator, StateGroup, UncertainSystem


def difference_form(c: Compensator) -> tuple[FloatArray, FloatArray]:
    """A and B of x', or of (x+ - x) / T for a sampled law."""
    T = c.sample_time
    return (c.A, c.B) if T is None else ((c.A - np.eye(len(c.A))) / T, c.B / T)


def closed_loop(system: UncertainSystem, c: Compensator, p: FloatArray) -> FloatArray:
    """State matrices of the closed loop at k rows of parameters; of sampled loops (A - 1) / T.

    The states are those of plant, lags, stored inputs and compensator.
    """
    return close_loop(c, *system.at(p), *difference_form(c), c.C, c.D)


def close_loop(
    c: Compensator, A: FloatArray, B: FloatArray, C: FloatArray,
    F_A: FloatArray, F_B: FloatArray, F_C: FloatArray, F_D: FloatArray,
) -> FloatArray:  # fmt: skip
    """State matrices of closed loops, of stacks of plants and of a law, with lag, hold and delay of the compensator.

    The plant is in differences: slow poles lie close to 1, where the A of x+ = A x has lost their digits.
    """
    outputs = C.shape[-1]
    if c.lag is not None:
        A, B = add_lags(A, B, c.lag)
    if c.sample_time is not None:
        n, T = A.shape[-1], c.sample_time
        _, Phi = sample(A, np.eye(n), T)  # (e^AT - 1) / T = A Phi / T
        A, B = store_inputs(A @ Phi / T, Phi @ B / T, newest_inputs(A, B, c), c)
    n = A.shape[-1]
    whole = np.zeros((len(A), n + len(F_A), n + len(F_A)))
    whole[:, :n, :n], whole[:, :n, n:], whole[:, n:, n:] = A, B @ F_C, F_A
    whole[:, :n, :outputs] += B @ F_D @ C
    whole[:, n:, :outputs] = F_B @ C
    return whole


def newest_inputs(A: FloatArray, B: FloatArray, c: Compensator) -> FloatArray | None:
    """What inputs leave in the last 1 - f of a sample, in differences, f the fraction of delay; None without one."""
    T, part = c.sample_time, split_delay(c.delay)[1]
    return None if T is None or not part else sample(A, B, (1 - part) * T)[1] / T


def store_inputs(
    A: FloatArray, B: FloatArray, newest: FloatArray | None, c: Compensator
) -> tuple[FloatArray, FloatArray]:
    """A system in differences behind the delay of a sampled compensator; stored inputs follow x, the oldest first."""
    n, T = A.shape[-1], float(c.sample_time or 0)
    A, B = delay_inputs(A, B, c.delay, newest)
    stored = np.arange(n, A.shape[-1])  # delay_inputs gives the next values of these
    if len(stored):
        B = B / T if newest is None else np.concatenate([B[..., :n, :], B[..., n:, :] / T], axis=-2)
        A[..., n:, :] = A[..., n:, :] / T
    A[..., stored, stored] -= 1 / T
    return A, B


def _poles(
    system: UncertainSystem, c: Compensator, p: FloatArray, groups: Sequence[StateGroup]
) -> ComplexArray:
    """The poles of the closed loop at k rows of parameters, group by group; of sampled loops (lambda - 1) / T."""
    A, B, C = system.at(p)
    F_A, F_B = difference_form(c)
    found = []
    for g in groups:
        x, own = list(g.states), list(g.own)
        law = F_A[np.ix_(own, own)], F_B[own]
        if not x:
            found.append(np.broadcast_to(np.linalg.eigvals(law[0]), (len(A), len(own))))
            continue
        into, through, out = B[:, x], c.D, c.C[:, own]
        if g.inputs is not None:  # forces on these states in place of the inputs
            rows = B[:, list(g.inputs)]
            into, through, out = np.eye(len(x))[:, [x.index(i) for i in g.inputs]], rows @ through, rows @ out
        closed = close_loop(c, A[:, x][:, :, x], into, C[:, :, x], *law, out, through)
        found.append(np.linalg.eigvals(closed))
    return np.concatenate(found, axis=1)


def instability(
    system: UncertainSystem, c: Compensator, p: FloatArray, groups: Sequence[StateGroup] = ()
) -> FloatArray:
    """The real part of the worst pole at k rows of parameters, 1/s; of sampled loops ln|lambda| / T.

    groups : states that close loops by themselves; none: the whole loop
    """
    poles = _poles(system, c, p, groups) if groups else _eigenvalues(closed_loop(system, c, p))
    if c.sample_time is not None:
        T = c.sample_time
        grown = (2 * T * poles.real + T**2 * np.abs(poles) ** 2).max(axis=1)  # |lambda|^2 - 1
        return np.asarray(np.log1p(np.maximum(grown, -1 + 1e-15)) / (2 * T))
    return np.asarray(poles.real.max(axis=1))


def _eigenvalues(matrices: FloatArray) -> ComplexArray:
    """The eigenvalues of k matrices of one structure: of each set of states that act on each other by itself."""
    joined = (matrices != 0).any(axis=0)
    count, label = sparse.csgraph.connected_components(joined, connection="strong")
    sets = [np.flatnonzero(label == k) for k in range(count)]
    return np.concatenate([np.linalg.eigvals(matrices[:, i[:, None], i]) for i in sets], axis=1)


def critical_frequency(system: UncertainSystem, c: Compensator, p: FloatArray) -> float:
    """The frequency of the worst pole at one row of parameters, rad/s."""
    (poles,) = np.linalg.eigvals(closed_loop(system, c, p))
    T = c.sample_time
    return worst_frequency(poles if T is None else T * poles, T)


def worst_frequency(poles: ComplexArray, T: float | None) -> float:
    """The frequency of the worst of some poles, rad/s; of sampled loops these are z - 1."""
    if T is None:
        return float(abs(poles[poles.real.argmax()].imag))
    z = 1 + poles
    return float(abs(np.angle(z[np.abs(z).argmax()])) / T)
