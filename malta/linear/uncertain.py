"""A linear system with uncertain parameters and its compensator: their records, poles and frequency responses.

x' = A(p) x + B(p) u,  y = C(p) x        derived from a plant's CasADi model, parameters by name
u = H F y                                 a control law F, and the lag, hold and delay H before the plant
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy import sparse

from malta.arguments import number
from malta.arrays import ComplexArray, FloatArray
from malta.errors import InputError, require_known
from malta.linear.sampling import add_lags, delay_inputs, sample, split_delay
from malta.linear.system import System

DOMAIN_END_TEXT = "a root or a branch of the model ends"


@dataclass(frozen=True, eq=False)
class StateGroup:
    """States of the system and of the compensator that close a loop by themselves.

    inputs : the states on which inputs act, when these are fewer than the inputs; else None
    """

    states: tuple[int, ...]
    own: tuple[int, ...]
    inputs: tuple[int, ...] | None


@dataclass(frozen=True, eq=False)
class Derived:
    """Parameters that are functions of another one, whose values a proof takes apart: any within their intervals."""

    of: str  # the parameter that they follow
    values: Callable[[float], FloatArray]
    intervals: Mapping[str, tuple[float, float]]  # by name, over the whole range of that parameter

    def at(self, value: float) -> dict[str, float]:
        """Their values by name."""
        return dict(zip(self.intervals, self.values(value).tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class UncertainSystem:
    """A linear system in parameters by name: E(p) x' = A(p) x + B(p) u, y = C(p) x + D(p) u.

    names : of the parameters, in the order of p
    nominal : their values, SI
    matrices : a casadi.Function p -> A, B, C, or with D, or with D and E; their structure is read from the expressions
    limits : of each parameter, (above, below), exclusive; none: infinite
    sample_time : s, of a discrete system, with x+ in place of x'; None: continuous
    approximate : why the matrices are no exact functions, so that nothing is proven of them; "": they are
    positive : a casadi.Function p -> values that are above zero wherever `matrices` hold; None: they hold everywhere
    ends : what happens where each of these is not, in words
    derived : the last parameters, where these follow another one
    left_out : what of a machine the matrices have not, in words; "": nothing

    >>> import malta
    >>> def motor(J, b):
    ...     return [[0, 1], [0, -b / J]], [[0], [1 / J]], [[1, 0]]
    >>> system = malta.uncertain(motor, {"J": 2e-3, "b": 0.1})
    >>> A, B, C = system.at([[1e-3, 0.1], [2e-3, 0.1]])  # at two rows of parameters
    >>> A[:, 1, 1].tolist()
    [-100.0, -50.0]
    """

    names: tuple[str, ...]
    nominal: FloatArray
    matrices: ca.Function
    limits: tuple[tuple[float, float], ...] = ()
    sample_time: float | None = None
    approximate: str = ""
    positive: ca.Function | None = None
    ends: tuple[str, ...] = ()
    derived: Derived | None = None
    left_out: str = ""

    def reason(self, own: str) -> str:
        """The reason of an answer about this system, with what the system leaves out of its machine.

        own : why nothing, or less than asked for, is proven; "": as much is
        """
        return "; ".join(filter(None, (self.left_out, own)))

    def spread(self, over: Mapping[str, tuple[float, float]]) -> dict[str, tuple[float, float]]:
        """The intervals of some parameters, with those of the parameters that follow one of them.

        over : intervals by name, SI
        """
        more = self.derived.intervals if self.derived is not None and self.derived.of in over else {}
        return {**more, **over}

    def at(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B and C at k rows of parameters: arrays of k matrices each.

        p : k x parameters, in the order of `names`
        """
        A, B, C, *_ = self.every(p)
        return A, B, C

    def every(self, p: FloatArray) -> list[FloatArray]:
        """All matrices at k rows of parameters: D and E too, where there are any.

        p : k x parameters, in the order of `names`
        """
        rows, made = np.atleast_2d(p), []
        for i, found in enumerate(self.matrices.map(len(rows)).call([rows.T])):
            pattern = self.matrices.sparsity_out(i)
            matrix = np.zeros((len(rows), *pattern.shape))
            matrix[:, *pattern.get_triplet()] = np.reshape(found.nonzeros(), (len(rows), pattern.nnz()))
            made.append(matrix)
        return made

    def explicit(self, p: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """E^-1 A, E^-1 B, C and D at k rows of parameters.

        p : k x parameters, in the order of `names`

        Raises numpy.linalg.LinAlgError where E is singular.
        """
        A, B, C, *more = self.every(p)
        D = more[0] if more else np.zeros((len(A), C.shape[1], B.shape[2]))
        if len(more) > 1:
            both = np.linalg.solve(more[1], np.concatenate([A, B], axis=2))
            A, B = both[:, :, : A.shape[2]], both[:, :, A.shape[2] :]
        return A, B, C, D

    def state_space(self, **values: float) -> Any:
        """Make the known system at values of parameters, a control.StateSpace.

        values : by name, SI; nominal ones of the others

        Raises InputError for unknown parameters, values that are no numbers, and a system without a value there.

        >>> import malta
        >>> motor = malta.uncertain(lambda J: ([[-0.1 / J]], [[1 / J]], [[1]]), {"J": 2e-3})
        >>> motor.state_space(J=1e-3).poles().real.tolist()
        [-100.0]
        """
        p = self.nominal.copy()
        for name, value in values.items():
            require_known([name], self.names, "state_space", found="an unknown parameter")
            p[self.names.index(name)] = number("state_space", name, value)
        try:
            found = [M[0] for M in self.explicit(p)]
        except np.linalg.LinAlgError:  # E is singular
            found = [np.full((1, 1), np.nan)]
        if not all(np.isfinite(M).all() for M in found):
            raise InputError("state_space", "matrices", "no value there", "parameters within their limits")
        A, B, C, D = found
        return System(A, B, C, D, None, self.sample_time).to_control()


@dataclass(frozen=True, eq=False)
class Compensator:
    """A linear law u = F y: x+ = A x + B y, u = C x + D y, with positive feedback; x' for x+ in continuous time.

    Between u and the plant stand a delay, a zero-order hold when sampled, and a first-order lag
    w_c / (s + w_c) when `lag` is given. The last states are plain integrals.

    A : n x n
    B : n x p, measurements
    C : m x n, forces
    D : m x p
    integrals : number of the last states that are plain integrals
    sample_time : s; None: continuous
    delay : samples between u and the plant, also a fraction of one before a continuous plant
    lag : w_c, rad/s; None: no lag

    >>> import malta
    >>> import numpy as np
    >>> one, Ts = np.eye(1), 1e-3  # PI: u = -2 y - 50 sum of Ts y
    >>> law = malta.proof.Compensator(one, Ts * one, -50 * one, -2 * one, 1, Ts, delay=1)
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> f"{malta.robust_margin(motor, law, {'k': 0.2}).lower:.2f}"
    '5.00'
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    integrals: int = 0
    sample_time: float | None = None
    delay: float = 0
    lag: float | None = None


def difference_form(c: Compensator) -> tuple[FloatArray, FloatArray]:
    """A and B of x', or of (x+ - x) / T for a sampled law."""
    T = c.sample_time
    return (c.A, c.B) if T is None else ((c.A - np.eye(len(c.A))) / T, c.B / T)


def closed_loop(system: UncertainSystem, c: Compensator, p: FloatArray) -> FloatArray:
    """State matrices of the closed loop at k rows of parameters; of sampled loops (A - 1) / T.

    The states are those of plant, lags, stored inputs and compensator.
    """
    return _close(c, *system.at(p), *difference_form(c), c.C, c.D)


def _close(
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
        A, B = _store_inputs(A @ Phi / T, Phi @ B / T, _newest(A, B, c), c)
    n = A.shape[-1]
    whole = np.zeros((len(A), n + len(F_A), n + len(F_A)))
    whole[:, :n, :n], whole[:, :n, n:], whole[:, n:, n:] = A, B @ F_C, F_A
    whole[:, :n, :outputs] += B @ F_D @ C
    whole[:, n:, :outputs] = F_B @ C
    return whole


def _newest(A: FloatArray, B: FloatArray, c: Compensator) -> FloatArray | None:
    """What inputs leave in the last 1 - f of a sample, in differences, f the fraction of delay; None without one."""
    T, part = c.sample_time, split_delay(c.delay)[1]
    return None if T is None or not part else sample(A, B, (1 - part) * T)[1] / T


def _store_inputs(
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
        closed = _close(c, A[:, x][:, :, x], into, C[:, :, x], *law, out, through)
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


# Frequency responses of a loop's parts, and the peaks and crossings of what is computed from them.


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
        A, B = _store_inputs(A, B, None if newest is None else newest[0, :, :m], law)
        C, D = np.hstack([C, D, np.zeros((q, len(A) - n - m))]), np.zeros((q, m))
    return System(A, B, C, D), System(*difference_form(law), law.C, law.D)


NUDGE = 1e-9  # of the way to the nominal parameters
Sides = tuple["FloatArray", "FloatArray", "FloatArray", "FloatArray", "FloatArray | None"]


@lru_cache(maxsize=4)  # an ascent moves p or w and returns; records compare by identity
def _plant(system: UncertainSystem, law: Compensator, p: bytes) -> Sides:
    """A, B, C and D from commands and from forces on the plant to sensors and forces; in differences when sampled.

    They are stacks, for each row of parameters. With a fraction of a sample of delay, what `_newest` says follows.
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
    return A @ Phi / T, Phi @ into / T, out, through, _newest(A, into, law)


@lru_cache(maxsize=4)
def _law(law: Compensator, w: bytes) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """s, or (z - 1) / T when sampled; z^-d of d whole samples; and F: at frequencies w."""
    T = law.sample_time
    s: ComplexArray = 1j * np.frombuffer(w)
    turned = np.ones_like(s)
    if T is not None:
        turned, s = np.exp(-s * T * split_delay(law.delay)[0]), np.expm1(s * T) / T
    F_A, F_B = difference_form(law)
    F = law.C @ _resolvent(s, F_A[None], F_B[None]) + law.D
    return s, turned, np.asarray(F, dtype=complex)
