"""Frequency responses of an uncertain loop's parts, and the systems that peaks and crossings are computed from."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import sparse

from malta.arrays import ComplexArray, FloatArray
from malta.linear.closed_loops import difference_form, newest_inputs, store_inputs
from malta.linear.sampling import add_lags, sample, split_delay
from malta.linear.system import System
from malta.linear.uncertain import Compensator, UncertainSystem

MAX_DIRECT_FREQUENCIES = 32  # frequencies at which a system is solved as a whole


class ResponseMatrices(NamedTuple):
    """Frequency responses, one matrix for each frequency."""

    G_y: ComplexArray  # k x p x m: commands -> sensors, with lag, hold and delay
    G_d: ComplexArray  # k x p x m: forces on the plant -> sensors
    H: ComplexArray  # k x m x m: commands -> forces
    F: ComplexArray  # k x m x p: sensors -> commands


def responses(system: UncertainSystem, law: Compensator, p: FloatArray, w: FloatArray) -> ResponseMatrices:
    """The responses of system and compensator at frequencies w, rad/s.

    p : one row of parameters, or a row for each frequency

    G(s) = C (s E - A)^-1 B + D behind a lag w_c / (s + w_c); of a sampled loop the exact discrete system under a
    zero-order hold at z = e^(j w T), times z^-delay. Differences (z - 1) / T keep the digits of slow modes.
    """
    A, B, C, D, newest = _plant(system, law, np.asarray(p, dtype=float).tobytes())
    s, turned, F = _law(law, np.asarray(w, dtype=float).tobytes())
    m, q = len(law.D), C.shape[1] - len(law.D)
    if newest is not None and law.sample_time is not None:
        # What was commanded a sample before acts for the fraction of the delay.
        older = np.exp(-1j * np.asarray(w, dtype=float) * law.sample_time)[:, None, None]
        B, D = newest + (B - newest) * older, D * older
    G = (C @ _resolvent(s, A, B) + D) * turned[:, None, None]
    return ResponseMatrices(G[:, :q, :m], G[:, :q, m:], G[:, q:, :m], F)


def _resolvent(s: ComplexArray, A: FloatArray, B: FloatArray) -> ComplexArray:
    """(s - A)^-1 B at each s, of one system or of one for each s; parts of a system without couplings one by one."""
    n = A.shape[-1]
    found = np.zeros((len(s), n, B.shape[-1]), dtype=complex)
    parts = [np.arange(n)]
    if len(s) > MAX_DIRECT_FREQUENCIES:
        count, label = sparse.csgraph.connected_components((A != 0).any(axis=0), directed=False)
        parts = [np.flatnonzero(label == k) for k in range(count)]
    for x in parts:
        used = np.flatnonzero((B[:, x] != 0).any(axis=(0, 1)))
        own = s[:, None, None] * np.eye(len(x)) - A[:, x[:, None], x]
        found[:, x[:, None], used] = np.linalg.solve(own, B[:, x[:, None], used])
    return found


def open_systems(system: UncertainSystem, law: Compensator, p: FloatArray) -> tuple[System, System]:
    """y = P u, with lag, hold and delay, and u = F y at one row of parameters; in differences when sampled."""
    m, T = len(law.D), law.sample_time
    *plant, newest = _plant(system, law, np.asarray(p, dtype=float).tobytes())
    A, B, C, D = (M[0] for M in plant)
    q, n = len(C) - m, len(A)
    B, C, D = B[:, :m], C[:q], D[:q, :m]
    if T is not None and law.delay:
        A, B = store_inputs(A, B, None if newest is None else newest[0, :, :m], law)
        C, D = np.hstack([C, D, np.zeros((q, len(A) - n - m))]), np.zeros((q, m))
    return System(A, B, C, D), System(*difference_form(law), law.C, law.D)


NUDGE = 1e-9  # of the way to the nominal parameters
Sides = tuple["FloatArray", "FloatArray", "FloatArray", "FloatArray", "FloatArray | None"]


@lru_cache(maxsize=4)  # an ascent moves p or w and returns; records compare by identity
def _plant(system: UncertainSystem, law: Compensator, p: bytes) -> Sides:
    """A, B, C and D from commands and from forces on the plant to sensors and forces; in differences when sampled.

    Stacks, for each row of parameters. With a fraction of a sample of delay, what `newest_inputs` says follows.
    """
    names = len(system.names)
    places = np.frombuffer(p).reshape(-1, names) if names else np.zeros((1, 0))
    try:
        A, B, C, D = system.explicit(places)
    except np.linalg.LinAlgError:  # a search meets a singular E, as at an end of its box: beside it
        A, B, C, D = system.explicit(places + NUDGE * (system.nominal - places))
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
        return A, into, out, through, None
    if system.sample_time is not None:
        return (A - np.eye(A.shape[-1])) / T, into / T, out, through, None
    _, Phi = sample(A, np.eye(A.shape[-1]), T)  # (e^AT - 1) / T = A Phi / T
    return A @ Phi / T, Phi @ into / T, out, through, newest_inputs(A, into, law)


@lru_cache(maxsize=4)
def _law(law: Compensator, w: bytes) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """s, or (z - 1) / T when sampled; z^-d of d whole samples; and F: at frequencies w."""
    T = law.sample_time
    own, back = np.unique(np.frombuffer(w), return_inverse=True)  # rows share frequencies
    s: ComplexArray = 1j * own
    turned = np.ones_like(s)
    if T is not None:
        turned, s = np.exp(-s * T * split_delay(law.delay)[0]), np.expm1(s * T) / T
    F_A, F_B = difference_form(law)
    F = law.C @ _resolvent(s, F_A[None], F_B[None]) + law.D
    return s[back], turned[back], np.asarray(F[back], dtype=complex)
