"""Peaks and crossings of linear systems, which no grid of frequencies can miss: eigenvalues say where they are.

    level     a singular value of G(jw) is g      where a Hamiltonian matrix has the eigenvalue jw
              (Boyd, Balakrishnan and Kabamba 1989; Bruinsma and Steinbuch 1990)
    |l| = 1   Re S(jw) = 1/2                      zeros of S(s) + S(-s) - 1,   l = 1 / S - 1
    l real    Im S(jw) = 0                        zeros of S(s) - S(-s)

A sampled system is looked at in the s of Tustin's rule, z = (1 + s T/2) / (1 - s T/2): there the unit circle is the
imaginary axis, and w stands for tan(w T/2) / (T/2), exactly. Eigenvalues have errors, so that each only says where to
look: the response at its frequency, and between two of them, decides.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from malta.arrays import ComplexArray, FloatArray
from malta.linear.matrices import eigenvalues, system_matrix
from malta.linear.system import System

RISE = 1e-7  # relative, above the largest gain that was found, at which a search ends
NYQUIST_GAP = 1e-7  # relative: how far from a pole on it the plane's end is looked at
JOINS = 1e-15  # of the largest entries of its row and column: smaller ones are rounding
NEAR_AXIS = 1e-4  # |Re| of an eigenvalue over its size, up to which it may lie on the imaginary axis
EIGENVALUE_DISTANCE = 1e-10  # relative: eigenvalues of that distance are one, of jw and of -jw
LEVELS = 30  # that are tried at most
DIRECT = 0.05  # of S: a value at infinite frequency that one may divide by
GENERIC_PLACE = 0.7390851332  # of a mean frequency: a place on the axis that is no zero
ASIDE = np.exp(
    np.multiply.outer([-0.3, 0.3], 4.0 ** -np.arange(7)).ravel()
)  # factors by which a top is looked for
FLAT_SHARE = 1e-4  # of a peak, up to which the curve about it is a parabola
ROOT_DISTANCE = 1e-6  # of a candidate's frequency: how far from it a root is looked for first
STEPS = 60  # of a root by bisection and secants at most
ROOT = 1e-13  # relative width of the interval at which a root is known
MIN_SINGULAR_VALUE = 1e-300  # a singular value whose logarithm is taken
RESPONSE_ROUNDING = 1e-13  # of S - 1/2 and of S: what rounding leaves of a response


class Peak(NamedTuple):
    """The largest gain of a system over all frequencies."""

    value: float
    frequency: float  # rad/s, or infinite


class Crossing(NamedTuple):
    """A place at which |l| = 1 or l is real and negative."""

    frequency: float  # rad/s
    value: complex  # l there


def in_plane(system: System, sample_time: float | None) -> System:
    """A system in differences, (x+ - x) / T = A x + B u, in the s of Tustin's rule; a continuous one as it is.

    s = R (z - 1) / T with R = (1 + A T/2)^-1, which keeps the digits of slow poles. A pole z = -1 has no place
    there: it is seen beside, at NYQUIST_GAP of the sample time less.
    """
    if sample_time is None or not len(system.A):
        return system
    A, B, C, D = system
    one, half = np.eye(len(A)), sample_time / 2
    try:
        R = np.linalg.inv(one + half * A)
    except np.linalg.LinAlgError:
        half *= 1 - NYQUIST_GAP
        R = np.linalg.inv(one + half * A)
    into = R @ B
    return System(R @ A, R @ into, C, D - half * C @ into)


def of_plane(v: FloatArray, sample_time: float | None) -> FloatArray:
    """The frequencies, rad/s, for which those of the plane stand."""
    return v if sample_time is None else np.asarray(2 / sample_time * np.arctan(v * sample_time / 2))


def part_of(system: System, rows: Sequence[int], columns: Sequence[int]) -> System:
    """From some inputs to some outputs, without states that the inputs do not reach or the outputs do not see.

    The system is in balanced units: what is rounding beside the largest entries of its row and column joins nothing.
    """
    A, B, C, D = system
    n = len(A)
    whole = np.abs(system_matrix(A, B[:, columns], C[rows], D[np.ix_(rows, columns)]))
    joined = _joins(whole)
    reached, seen = joined[:n, n:].any(axis=1), joined[n:, :n].any(axis=0)
    for graph, marks in ((joined[:n, :n], reached), (joined[:n, :n].T, seen)):
        for _ in range(n):
            more = graph[:, marks].any(axis=1) & ~marks
            if not more.any():
                break
            marks |= more
    x = np.flatnonzero(reached & seen)
    return System(A[np.ix_(x, x)], B[x][:, columns], C[rows][:, x], D[np.ix_(rows, columns)])


def response_at(system: System, w: FloatArray) -> ComplexArray:
    """G(jw) at k frequencies in rad/s, infinite ones among them: k x outputs x inputs."""
    found = np.broadcast_to(system.D.astype(complex), (len(w), *system.D.shape)).copy()
    finite = np.isfinite(w)
    if len(system.A) and finite.any():
        resolvent = 1j * w[finite, None, None] * np.eye(len(system.A)) - system.A
        try:
            found[finite] += system.C @ np.linalg.solve(resolvent, system.B.astype(complex))
        except np.linalg.LinAlgError:  # a frequency on a pole
            found[finite] = system.response(1j * w[finite])
    return found


def gains_at(system: System, w: FloatArray) -> FloatArray:
    """The largest singular value of G(jw) at k frequencies, infinite ones among them."""
    G = response_at(system, w)
    if 1 in G.shape[1:]:
        return np.asarray(np.linalg.norm(G, axis=(1, 2)))
    return np.asarray(np.linalg.norm(G, 2, axis=(1, 2)))


def _on_axis(eigenvalues: ComplexArray) -> FloatArray:
    """The frequencies of those eigenvalues that may lie on the imaginary axis, in order."""
    found = eigenvalues[np.isfinite(eigenvalues)]
    w = np.sort(np.abs(found.imag[np.abs(found.real) <= NEAR_AXIS * np.abs(found)]))
    return w[np.append(True, np.diff(w) > EIGENVALUE_DISTANCE * w[1:])] if len(w) else w


def level_frequencies(system: System, level: float) -> FloatArray:
    """The frequencies at which a singular value of G may be equal to a level, in order; of a balanced system."""
    A, B, C, D = system
    if not len(A):
        return np.zeros(0)
    R = D.T @ D - level**2 * np.eye(B.shape[1])
    S = D @ D.T - level**2 * np.eye(len(C))
    try:
        own = A - B @ np.linalg.solve(R, D.T @ C)
        over, under = B @ np.linalg.solve(R, B.T), C.T @ np.linalg.solve(S, C)
        H = system_matrix(own, -level * over, level * under, -own.T)
    except np.linalg.LinAlgError:  # the level is reached at infinite frequency
        return np.zeros(0)
    return _on_axis(np.linalg.eigvals(H)) if np.isfinite(H).all() else np.zeros(0)


def about_poles(poles: ComplexArray) -> FloatArray:
    """Frequencies at which poles make resonances: |p|, Im p, and of light damping sqrt(Im^2 - Re^2)."""
    inner = np.sqrt(np.maximum(poles.imag**2 - poles.real**2, 0.0))
    return np.unique(np.concatenate([np.abs(poles), np.abs(poles.imag), inner]))


def largest_gain(systems: Iterable[System]) -> Peak:
    """The largest gain of several stable systems, and where it lies; of none zero."""
    best = Peak(0.0, 0.0)
    for system in systems:
        best = max(best, peak_gain(system, above=best.value))
    return best


def peak_gain(system: System, above: float = 0.0) -> Peak:
    """The largest gain of a stable system over all frequencies, and where it lies; of a plane, there.

    above : a gain up to which nothing is asked: any lower one may be returned then

    Its levels rise from gains that were found, until the Hamiltonian matrix has no imaginary eigenvalues at RISE above
    the last one (Bruinsma and Steinbuch).
    """
    if not len(system.A):
        return Peak(float(np.linalg.norm(system.D, 2)), 0.0)
    system = system.balanced
    w = np.concatenate([[0.0, np.inf], about_poles(eigenvalues(system.A))])
    sizes = gains_at(system, w)
    if not np.isfinite(sizes).all():
        return Peak(math.inf, float(w[~np.isfinite(sizes)][0]))
    best, where = float(sizes.max()), float(w[sizes.argmax()])
    if best == 0.0:
        return Peak(best, where)
    for _ in range(LEVELS):
        ends = level_frequencies(system, max(best, above) * (1 + RISE))
        if not len(ends):
            break
        w = np.concatenate([ends, np.sqrt(ends[1:] * ends[:-1]), ends[:1] / 2, 2 * ends[-1:]])
        sizes = gains_at(system, w)
        k = int(sizes.argmax())
        higher = float(sizes[k]) > max(best, above) * (1 + RISE)
        if float(sizes[k]) > best:
            best, where = float(sizes[k]), float(w[k])
        if not higher:
            break
    return _to_top(system, Peak(best, where)) if best > above else Peak(best, where)


def _to_top(system: System, peak: Peak) -> Peak:
    """The top beside a peak: of a slow flat one beside fast poles eigenvalues do not tell the last digits."""
    best, where = peak
    if not 0 < where < math.inf:
        return peak
    for _ in range(LEVELS):
        w = where * ASIDE
        sizes = gains_at(system, w)
        k = int(sizes.argmax())
        if not sizes[k] > best:
            break
        best, where = float(sizes[k]), float(w[k])
    return Peak(best, where)


def smooth_peak(system: System) -> float:
    """The largest gain of a stable system of one input and output, as a search wants it: it changes smoothly.

    It is the top of the widest parabola that hardly falls, through the peak that was found and gains beside it.
    """
    top, where = peak_gain(system)
    if not 0 < where < math.inf:
        return top
    left, right = np.split(gains_at(system.balanced, where * ASIDE), 2)
    bend, fall = 2 * top - left - right, top - np.minimum(left, right)
    k = np.flatnonzero((bend > 0) & (fall < FLAT_SHARE * top))
    return top + float((left[k[0]] - right[k[0]]) ** 2 / (8 * bend[k[0]])) if len(k) else top


def joined_channels(system: System, channels: Sequence[int]) -> list[list[int]]:
    """The channels in sets that nothing joins, each its input and output: the norm of all is the largest of a set."""
    n, c = len(system.A), len(channels)
    square = system.part(channels, channels)
    whole = np.abs(system_matrix(square.A, square.B, square.C, square.D))
    label = sparse.csgraph.connected_components(_joins(whole), directed=False)[1][n : n + c]
    return [[channels[i] for i in np.flatnonzero(label == k).tolist()] for k in np.unique(label)]


def _joins(sizes: FloatArray) -> NDArray[np.bool_]:
    """Which entries of a matrix in balanced units are more than rounding beside the largest of row and column."""
    largest = sizes.max(axis=1, initial=0.0)[:, None] * sizes.max(axis=0, initial=0.0)
    return np.asarray(sizes**2 > JOINS**2 * largest)


# Crossings of one channel's loop l = 1 / S - 1, from a realization of its sensitivity S.


def gain_crossings(S: System) -> list[Crossing]:
    """The places with |l| = 1, by frequency. S may be unstable."""
    gain = _roots(S, _axis_zeros(S, mirrored=1.0), lambda s: s.real - 0.5)
    return [Crossing(w, 1 / s - 1) for w, s in gain]


def phase_crossings(S: System) -> list[Crossing]:
    """The places at which l is real and negative, by frequency: zero and infinity among them. S may be unstable."""
    inner = _roots(S, _axis_zeros(S, mirrored=-1.0), lambda s: s.imag)
    low, high = _at_ends(S)
    places = [(0.0, low), *inner, (math.inf, high)]
    return [
        Crossing(w, complex(1 / s.real - 1))
        for w, s in places
        if abs(s.real) > RESPONSE_ROUNDING and 1 / s.real - 1 < 0
    ]


def _at_ends(S: System) -> list[complex]:
    """S at zero and infinite frequency; 0 where it has no finite value, as with an integrator in the closed loop."""
    values = []
    for w in (0.0, np.inf):
        value = complex(response_at(S, np.array([w]))[0, 0, 0])
        values.append(value if np.isfinite(value) else 0j)
    return values


def _axis_zeros(S: System, mirrored: float) -> FloatArray:
    """The frequencies at which S(jw) + S(-jw) - 1 or S(jw) - S(-jw) may be zero, in order.

    Where the sum is not zero at infinite frequency they are eigenvalues of A - B C / D. Else, with s = s0 + 1 / x, they
    are those of D' - C N (x + N)^-1 N B, N = (s0 - A)^-1 and D' the value at s0, which is not zero.
    """
    n = len(S.A)
    if not n:
        return np.zeros(0)
    A = linalg.block_diag(S.A, -S.A)
    B, C = np.vstack([S.B, S.B]), np.hstack([S.C, -mirrored * S.C])
    D = complex(2 * S.D[0, 0] - 1) if mirrored > 0 else 0j
    if abs(D) > DIRECT * (1 + abs(S.D[0, 0])):
        return _on_axis(eigenvalues(A - B @ C / D.real))
    sizes = np.abs(np.linalg.eigvals(S.A))
    middle = float(np.exp(np.log(np.maximum(sizes, sizes.max() * 1e-6 + 1e-300)).mean()))
    places = 1j * middle * GENERIC_PLACE * np.array([1.0, 7.0, 0.13])
    values = D + (C @ np.linalg.solve(places[:, None, None] * np.eye(2 * n) - A, B.astype(complex)))[:, 0, 0]
    k = int(np.abs(values).argmax())
    if not abs(values[k]) > RESPONSE_ROUNDING * (1 + np.abs(S.D).max()):
        return np.zeros(0)
    N = np.linalg.inv(places[k] * np.eye(2 * n) - A)
    x = np.linalg.eigvals(-N + (N @ B) @ (C @ N) / values[k])
    with np.errstate(all="ignore"):
        return _on_axis(places[k] + 1 / x[x != 0])


def _roots(
    S: System, candidates: FloatArray, measure: Callable[[ComplexArray], FloatArray]
) -> list[tuple[float, complex]]:
    """The zeros of a measure of S(jw) and S there: near candidates, and between the middles of their gaps.

    None where the measure has nothing but rounding on both sides.
    """
    c = candidates[(candidates > 0) & np.isfinite(candidates)]
    if not len(c):
        return []
    middle = np.concatenate([c[:1] / 2, np.sqrt(c[1:] * c[:-1]), 2 * c[-1:]])
    beside = np.minimum(ROOT_DISTANCE * c, np.minimum(c - middle[:-1], middle[1:] - c) / 2)
    w = np.unique(np.concatenate([middle, c - beside, c + beside]))
    values = response_at(S, w)[:, 0, 0]
    y = measure(values)
    seen = np.abs(y) > RESPONSE_ROUNDING * (1 + np.abs(values))
    k = np.flatnonzero((y[1:] * y[:-1] < 0) & (seen[1:] | seen[:-1]))
    if not len(k):
        return []
    at = false_position(lambda x: measure(response_at(S, x)[:, 0, 0]), (w[k], y[k]), (w[k + 1], y[k + 1]))
    return list(zip(at.tolist(), response_at(S, at)[:, 0, 0].tolist(), strict=True))


Ends = tuple["FloatArray", "FloatArray"]


def false_position(measure: Callable[[FloatArray], FloatArray], low: Ends, high: Ends) -> FloatArray:
    """A root of a measure in each interval, from its ends and the values there, which differ in sign (Illinois)."""
    (a, f), (b, g) = low, high
    kept = np.zeros(len(a))  # the end that stayed: -1 a, 1 b
    x = a
    for _ in range(STEPS):
        x = np.where(f == g, (a + b) / 2, b - g * (b - a) / np.where(f == g, 1, g - f))
        h = measure(x)
        left = h * f > 0
        g = np.where(left & (kept == 1), g / 2, np.where(left, g, h))
        f = np.where(~left & (kept == -1), f / 2, np.where(left, h, f))
        a, b, kept = np.where(left, x, a), np.where(left, b, x), np.where(left, 1.0, -1.0)
        if (((b - a) <= ROOT * b) | (h == 0)).all():
            break
    return x
