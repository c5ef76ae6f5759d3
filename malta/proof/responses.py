"""Frequency responses of a loop's parts, and the peaks and crossings of what is computed from them."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import sparse

from malta.proof.uncertain import Compensator, UncertainSystem, difference_form
from malta.synthesis.riccati import add_lags, sample

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import ComplexArray, FloatArray


FEW = 32  # frequencies at which a system is solved as a whole


class Responses(NamedTuple):
    """Frequency responses, one matrix for each frequency."""

    G_y: ComplexArray  # k x p x m: commands -> sensors, with lag, hold and delay
    G_d: ComplexArray  # k x p x m: forces on the plant -> sensors
    H: ComplexArray  # k x m x m: commands -> forces
    F: ComplexArray  # k x m x p: sensors -> commands


def responses(system: UncertainSystem, law: Compensator, p: FloatArray, w: FloatArray) -> Responses:
    """The responses of system and compensator at frequencies w, rad/s.

    p : one row of parameters, or a row for each frequency

    G(s) = C (s E - A)^-1 B + D behind a lag w_c / (s + w_c); of a sampled loop the exact discrete system under a
    zero-order hold at z = e^(j w T), times z^-delay. Differences (z - 1) / T keep the digits of slow modes.
    """
    A, B, C, D = _plant(system, law, np.asarray(p, dtype=float).tobytes())
    s, turned, F = _law(law, np.asarray(w, dtype=float).tobytes())
    m, q = len(law.D), C.shape[1] - len(law.D)
    G = (C @ _resolvent(s, A, B) + D) * turned[:, None, None]
    return Responses(G[:, :q, :m], G[:, :q, m:], G[:, q:, :m], F)


def _resolvent(s: ComplexArray, A: FloatArray, B: FloatArray) -> ComplexArray:
    """(s - A)^-1 B at each s, of one system or of one for each s; parts of a system without couplings one by one."""
    n = A.shape[-1]
    found = np.zeros((len(s), n, B.shape[-1]), dtype=complex)
    parts = [np.arange(n)]
    if len(s) > FEW:
        count, label = sparse.csgraph.connected_components((A != 0).any(axis=0), directed=False)
        parts = [np.flatnonzero(label == k) for k in range(count)]
    for x in parts:
        used = np.flatnonzero((B[:, x] != 0).any(axis=(0, 1)))
        own = s[:, None, None] * np.eye(len(x)) - A[:, x[:, None], x]
        found[:, x[:, None], used] = np.linalg.solve(own, B[:, x[:, None], used])
    return found


Sides = tuple["FloatArray", "FloatArray", "FloatArray", "FloatArray"]


@lru_cache(maxsize=4)  # an ascent moves p or w and returns; records compare by identity
def _plant(system: UncertainSystem, law: Compensator, p: bytes) -> Sides:
    """A, B, C and D from commands and from forces on the plant to sensors and forces; in differences when sampled.

    They are stacks, for each row of parameters.
    """
    names = len(system.names)
    A, B, C, D = system.explicit(np.frombuffer(p).reshape(-1, names) if names else np.zeros((1, 0)))
    rows, n, m = B.shape
    k, q = n if law.lag is None else n + m, C.shape[1]
    into, out, through = (np.zeros((rows, *shape)) for shape in ((k, 2 * m), (q + m, k), (q + m, 2 * m)))
    into[:, :n, m:], out[:, :q, :n], through[:, :q, m:] = B, C, D
    if law.lag is None:
        into[:, :n, :m], through[:, :q, :m], through[:, q:, :m] = B, D, np.eye(m)
    else:
        A, into[:, :, :m] = add_lags(A, B, law.lag)
        out[:, :q, n:], out[:, q:, n:] = D, np.eye(m)
    T = law.sample_time
    if T is None:
        return A, into, out, through
    if system.sample_time is not None:
        return (A - np.eye(A.shape[-1])) / T, into / T, out, through
    _, Phi = sample(A, np.eye(A.shape[-1]), T)  # (e^AT - 1) / T = A Phi / T
    return A @ Phi / T, Phi @ into / T, out, through


@lru_cache(maxsize=4)
def _law(law: Compensator, w: bytes) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """s, or (z - 1) / T when sampled; z^-delay; and F: at frequencies w."""
    T = law.sample_time
    s: ComplexArray = 1j * np.frombuffer(w)
    turned = np.ones_like(s)
    if T is not None:
        turned, s = np.exp(-s * T * law.delay), np.expm1(s * T) / T
    F_A, F_B = difference_form(law)
    F = law.C @ _resolvent(s, F_A[None], F_B[None]) + law.D
    return s, turned, np.asarray(F, dtype=complex)


def find_peaks(
    sizes: Callable[[FloatArray], FloatArray],
    w: FloatArray,
    values: FloatArray | None = None,
    own: Callable[[FloatArray, NDArray[np.int_]], FloatArray] | None = None,
) -> tuple[FloatArray, FloatArray]:
    """The largest value of each column of sizes(w) (k x n) over the frequencies w, and where it lies (rad/s).

    The grid is refined three times around each peak. values : sizes(w), where they are known; own : own(w, k) is
    column k[j] at w[j] alone, where that is less work than sizes(w)
    """
    values = (sizes(w) if values is None else values).T
    around = np.tile(w, (len(values), 1))
    for _ in range(3):
        k = values.argmax(axis=1)
        rows = np.arange(len(k))
        low, high = around[rows, np.maximum(k - 1, 0)], around[rows, np.minimum(k + 1, around.shape[1] - 1)]
        around = np.geomspace(low, high, 17, axis=1)
        if own is None:
            values = sizes(around.ravel()).reshape(*around.shape, -1)[rows, :, rows]
        else:
            values = own(around.ravel(), np.repeat(rows, around.shape[1])).reshape(around.shape)
    return values.max(axis=1), around[rows, values.argmax(axis=1)]


def crossing_frequency(w: FloatArray, size: FloatArray, level: float, *, last: bool = False) -> float:
    """The frequency at which `size` falls below `level` for the first or the last time, rad/s.

    It is interpolated on a log-log line between grid points: 0 when `size` never reaches the level, the last entry of
    w when it never falls below.
    """
    falls = np.flatnonzero((size[:-1] >= level) & (size[1:] < level))
    if not len(falls):
        return float(w[-1] if size[-1] >= level else 0.0)
    k = falls[-1 if last else 0]
    (a, b), (wa, wb) = np.log(size[k : k + 2] / level), np.log(w[k : k + 2])
    return float(np.exp(wa + (wb - wa) * a / (a - b)))
