"""The transfer M from the outputs of complex blocks to their inputs, and the smallest blocks that destabilize it.

With F the compensator, G_y and G_d the plant from commands (lag, hold and delay included) and from forces on it, H the
commands behind lag, hold and delay, and S = (1 - G_y F)^-1, outputs and commands follow from what is added to sensors
(w_y), to commands (w_u) and to forces on the plant (w_d):

    y = S (G_y F w_y + G_y w_u + G_d w_d),        u = (1 - F G_y)^-1 F (w_y + G_y w_u + G_d w_d)

It is computed from frequency responses, a route of its own beside the polynomials that the proofs use.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray, readonly
from malta.linear.open_loops import ResponseMatrices
from malta.proof.blocks import Block
from malta.work import is_past

if TYPE_CHECKING:
    from malta.proof.problem import OfLoop

STEPS = 24  # of the power iteration
STARTS = 3
ROUNDS = 40
ZOOMS = 7
CALL, VALUE = 9e-4, 5e-6  # work of values, and of each of them


@dataclass(frozen=True, eq=False)
class LoopSignals:
    """The signals of a loop from additions to sensors, to commands and from forces on the plant, side by side."""

    of: ResponseMatrices

    @cached_property
    def y(self) -> ComplexArray:
        """The outputs: S (G_y F, G_y, G_d)."""
        r = self.of
        # solved for on either side: about integrators G and F are huge, and an inverse times them has lost all digits
        loop = r.G_y @ r.F
        return np.asarray(
            np.linalg.solve(np.eye(loop.shape[-1]) - loop, np.concatenate([loop, r.G_y, r.G_d], axis=2))
        )

    @cached_property
    def u(self) -> ComplexArray:
        """The commands: (1 - F G)^-1 F (1, G_y, G_d)."""
        r, (q, m) = self.of, self.of.G_y.shape[1:]
        law_reads = np.concatenate([np.broadcast_to(np.eye(q), (len(r.F), q, q)), r.G_y, r.G_d], axis=2)
        return np.asarray(np.linalg.solve(np.eye(m) - r.F @ r.G_y, r.F @ law_reads))


def transfer(signals: LoopSignals, blocks: Sequence[Block]) -> ComplexArray:
    """M from the outputs of the blocks, in their order, to their inputs: frequencies x columns x rows."""
    q, m = signals.of.G_y.shape[1:]
    total = sum(len(b.rows) for b in blocks)
    into = np.zeros((q + 2 * m, total))
    passed = {0: np.zeros((q, total)), q: np.zeros((m, total))}  # additions to a signal by earlier blocks
    found, k = [], 0
    for b in blocks:
        own, rows, columns = slice(k, k + len(b.rows)), list(b.rows), list(b.columns)
        k += len(rows)
        first = q + m if b.kind == "compliance" else q if b.kind in _LOOPS and b.at == "forces" else 0
        into[[first + i for i in rows], own] = np.diag(b.entering)
        if b.kind == "feedback":  # it reads its own addition
            passed[first][rows, own] += np.diag(b.entering)
        reads_u = b.kind in ("additive", "effort") or (b.kind in _LOOPS and b.at == "forces")
        signal = signals.u if reads_u else signals.y
        if b.kind == "additive":
            signal = signals.of.H @ signal
        beside = passed[first][columns].copy() if b.kind in _LOOPS else 0.0
        found.append((signal[:, columns], beside))
        if b.kind in ("multiplicative", "additive"):
            passed[first][rows, own] += np.diag(b.entering)
    return np.concatenate([z @ into + d for z, d in found], axis=1)


_LOOPS = ("multiplicative", "feedback")


def mu_bound(M: ComplexArray, blocks: Sequence[Block]) -> tuple[FloatArray, ComplexArray]:
    """A lower bound of mu, and Delta of size one that has it: det(1 - M Delta / mu) = 0.

    M: k x columns x rows; Delta: k x rows x columns, of blocks on the diagonal. One block has the largest singular
    value. Several have the spectral radius of M Delta, Delta of dyads of norm one, which never exceeds mu, after the
    power iteration of Packard, Fan and Doyle (1988) from a few starts.
    """
    finite = np.asarray(np.isfinite(M).all(axis=(1, 2)))
    M = np.where(finite[:, None, None], M, 0)
    if M.shape[1:] == (1, 1):
        size = np.abs(M)
        return np.where(finite, size[:, 0, 0], np.inf), np.where(
            size > 0, M.conj() / np.maximum(size, 1e-300), 1
        )
    if len(blocks) == 1:
        u, s, vh = np.linalg.svd(M, full_matrices=False)
        return np.where(finite, s[:, 0], np.inf), _adjoint(vh[:, :1]) @ _adjoint(u[:, :, :1])
    if M.shape[1:] == (2, 2) and len(blocks) == 2:
        of_two, delta = _of_two(M)
        return np.where(finite, of_two, np.inf), delta
    starts = np.exp(2j * np.pi * np.random.default_rng(0).random((STARTS, 1, M.shape[2], 1)))
    starts[0] = 1
    b = (starts * np.ones((1, len(M), 1, 1))).reshape(-1, M.shape[2], 1)  # all starts side by side
    tiled = np.tile(M, (STARTS, 1, 1))
    back, w = _adjoint(tiled), np.ones_like(b)
    for _ in range(STEPS):
        a = _unit(tiled @ b)
        w = _unit(back @ _balance(a, w, blocks)[0])
        b = _balance(a, w, blocks)[1]
    made = _dyads(a, w, blocks)
    size = np.abs(np.linalg.eigvals(tiled @ made)).max(axis=1).reshape(STARTS, -1)
    best = size.argmax(axis=0), np.arange(len(M))
    return np.where(finite, size[best], np.inf), made.reshape(STARTS, len(M), *made.shape[1:])[best]


def _of_two(M: ComplexArray) -> tuple[FloatArray, ComplexArray]:
    """Two scalar blocks 1 and e^(j x): the largest eigenvalue of M Delta, by a grid of x that is narrowed."""
    middle, half = np.zeros(len(M)), np.pi
    a, d, det = M[:, :1, 0], M[:, 1:, 1], np.linalg.det(M)[:, None]
    for _ in range(ZOOMS):
        x = middle[:, None] + half * np.linspace(-1, 1, 33)
        turn = np.exp(1j * x)
        trace = (a + d * turn) / 2
        root = np.sqrt(trace**2 - det * turn)
        size = np.maximum(np.abs(trace + root), np.abs(trace - root))
        at = size.argmax(axis=1)[:, None]
        middle, half = np.take_along_axis(x, at, axis=1)[:, 0], half / 12
    delta = np.zeros_like(M)
    delta[:, 0, 0], delta[:, 1, 1] = 1, np.exp(1j * middle)
    return np.take_along_axis(size, at, axis=1)[:, 0], delta


def _adjoint(M: ComplexArray) -> ComplexArray:
    return np.asarray(M.conj().swapaxes(1, 2))


def _unit(v: ComplexArray) -> ComplexArray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=1, keepdims=True), 1e-300))


def _parts(blocks: Sequence[Block]) -> list[tuple[slice, slice]]:
    """The rows and columns of each block, as slices."""
    rows = np.cumsum([0, *(len(b.rows) for b in blocks)]).tolist()
    columns = np.cumsum([0, *(len(b.columns) for b in blocks)]).tolist()
    return [(slice(*i), slice(*j)) for i, j in zip(pairwise(rows), pairwise(columns), strict=True)]


def _balance(a: ComplexArray, w: ComplexArray, blocks: Sequence[Block]) -> tuple[ComplexArray, ComplexArray]:
    """Scale a to the norms of w block by block, and w to those of a."""
    rows, columns = [len(b.rows) for b in blocks], [len(b.columns) for b in blocks]
    read, given = _norms(a, columns), _norms(w, rows)
    return a * np.repeat(given / read, columns, axis=1), w * np.repeat(read / given, rows, axis=1)


def _norms(v: ComplexArray, counts: list[int]) -> FloatArray:
    """Norms of the parts of a vector, `counts` entries each."""
    first = np.cumsum([0, *counts[:-1]])
    return np.maximum(np.sqrt(np.add.reduceat(np.abs(v) ** 2, first, axis=1)), 1e-300)


def _dyads(a: ComplexArray, w: ComplexArray, blocks: Sequence[Block]) -> ComplexArray:
    """Delta_k = w_k a_k^* of norm one."""
    made = np.zeros((len(a), w.shape[1], a.shape[1]), dtype=complex)
    for i, j in _parts(blocks):
        made[:, i, j] = _unit(w[:, i]) @ _adjoint(_unit(a[:, j]))
    return made


def performance(M: ComplexArray, blocks: Sequence[Block]) -> FloatArray:
    """A lower bound of the last block's gain, the others of size one: g where mu of M with the last rows over g is one.

    g mu(g) rises to it; it is infinite where the others close a loop by themselves.
    """
    if len(blocks) == 1:
        return mu_bound(M, blocks)[0]
    if M.shape[1:] == (2, 2) and len(blocks) == 2:
        return _behind_one(M)
    _, last = _parts(blocks)[-1]
    without = M[:, : last.start, : _parts(blocks)[-1][0].start]
    g = mu_bound(M[:, last, _parts(blocks)[-1][0]], blocks[-1:])[0]
    for _ in range(ROUNDS):
        scaled = M.copy()
        scaled[:, last] /= np.maximum(g, 1e-300)[:, None, None]
        grown = mu_bound(scaled, blocks)[0]
        g = g * np.maximum(grown, 1.0)
        if (grown < 1 + 1e-10).all():
            break
    return np.where(mu_bound(without, blocks[:-1])[0] >= 1, np.inf, g)


def _behind_one(M: ComplexArray) -> FloatArray:
    """The largest |M_22 + M_21 M_12 delta / (1 - M_11 delta)| with |delta| <= 1: a disc, from that of delta."""
    with np.errstate(divide="ignore", invalid="ignore"):
        room = 1 - np.abs(M[:, 0, 0]) ** 2
        joined = M[:, 1, 0] * M[:, 0, 1] / room
        size = np.abs(M[:, 1, 1] + joined * np.conj(M[:, 0, 0])) + np.abs(joined)
    return np.where((room > 0) & np.isfinite(size), size, np.inf)


# The largest gain over a box of parameters and all frequencies: a grid at corners, and ascents from there.
#
# The result is the gain of one plant of the box, so it is a lower bound; it need not be the largest gain.


CORNERS = 32
PLACES = 4  # starts of ascents at most
PEAK_FACTORS = np.array([0.5, 0.8, 0.9, 0.95, 0.98, 1.0, 1.02, 1.05, 1.1, 1.25, 2.0])
ENDS = (0.01, 100.0)  # beyond the slowest and the fastest pole
LIMIT_FREQUENCIES = (1e-5, 1e4)  # that stand for zero and for infinity
GRID = 80
STEP = 1e-8  # of relative places and log frequencies, for slopes
ASCENT_STEPS = 0.02 / 4.0 ** np.arange(7)  # log frequencies either way that an ascent looks at last
MIN_IMAGINARY_SHARE = 1e-3  # of |s|: a smaller imaginary part shows no peak; of a real pole it is rounding

Value = Callable[["FloatArray", "FloatArray"], "FloatArray"]  # of p, or rows of p, and of rows of w


class GainPeak(NamedTuple):
    value: float
    frequency: float  # rad/s
    p: FloatArray


def patterns(count: int) -> FloatArray:
    """Relative places in a box (-1 to 1) at which ascents start: the middle and corners, CORNERS at most."""
    if 2**count <= CORNERS:
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=count))).reshape(-1, count)
    else:
        corners = np.random.default_rng(0).choice((-1.0, 1.0), (CORNERS, count))
    return np.vstack([np.zeros((1, count)), corners])


def frequencies(problem: OfLoop, p: FloatArray) -> FloatArray:
    """Frequencies that show a loop's peaks: between its slowest and its fastest pole and about each of them, rad/s."""
    return _frequencies(problem, p.tobytes())


@lru_cache(maxsize=64)  # searches of several gains begin at the same places; problems compare by identity
def _frequencies(problem: OfLoop, place: bytes) -> FloatArray:
    with np.errstate(all="ignore"):
        s: ComplexArray = problem.poles(np.frombuffer(place))
    known = np.concatenate([np.abs(s), np.abs(s.imag[np.abs(s.imag) > MIN_IMAGINARY_SHARE * np.abs(s)])])
    known = known[np.isfinite(known) & (known > 0)]
    top = _top(problem)
    if not len(known):
        known = np.array([1.0])
    wide = np.geomspace(known.min() * ENDS[0], min(known.max() * ENDS[1], top), GRID)
    far = np.array([known.min(), known.max()]) * LIMIT_FREQUENCIES
    w = np.unique(np.concatenate([wide, far, (known[:, None] * PEAK_FACTORS).ravel()]))
    return readonly(np.append(w[w < top], top) if math.isfinite(top) else w)


def _top(problem: OfLoop) -> float:
    """The Nyquist frequency of a loop, rad/s; infinite for a continuous loop."""
    T = problem.loop.law.sample_time
    return math.inf if T is None else math.pi / T


def climb(
    value: Value, problem: OfLoop, sides: FloatArray, starts: Sequence[FloatArray], until: float
) -> GainPeak:
    """The largest value found within the sides of a box (P x 2) until the work is up, from the best of some starts."""
    places: list[GainPeak] = []
    for p in starts:
        w = frequencies(problem, p)
        if is_past(until, CALL + VALUE * len(w)) and places:
            break
        v = value(p, w)
        inner = np.flatnonzero((v >= np.append(v[1:], -np.inf)) & (v >= np.append(-np.inf, v[:-1])))
        places += [GainPeak(float(v[k]), float(w[k]), p) for k in inner[np.argsort(v[inner])[-3:]]]
    places.sort(key=lambda place: -place.value)
    if not math.isfinite(places[0].value):
        return places[0]
    top = _top(problem)
    best = places[0]
    for place in places[: min(PLACES, len(starts))]:
        if is_past(until):
            break
        best = max(best, _uphill(value, place, sides, top, until), key=lambda found: found.value)
    return best


def _uphill(value: Value, place: GainPeak, sides: FloatArray, top: float, until: float) -> GainPeak:
    """Ascend from a place to the next maximum, by L-BFGS in parameters and log frequency, then in frequency alone."""
    from scipy import optimize  # here: it takes long to import, and few commands need it

    free = np.flatnonzero(sides[:, 1] > sides[:, 0])
    low, width = sides[free, 0], sides[free, 1] - sides[free, 0]
    best = place

    def losses(z: FloatArray) -> FloatArray:
        """The losses at rows of relative places and log frequencies."""
        nonlocal best
        p = np.tile(place.p, (len(z), 1))
        p[:, free] = np.clip(low + width * np.clip(z[:, :-1], 0, 1), *sides[free].T)
        w = np.minimum(place.frequency * np.exp(z[:, -1]), top)
        is_past(price=CALL + VALUE * len(w))
        found = value(p, w)
        k = int(np.where(np.isnan(found), -np.inf, found).argmax())
        if found[k] > best.value:
            best = GainPeak(float(found[k]), float(w[k]), p[k])
        return np.where(np.isfinite(found), -np.log(np.maximum(found, 1e-300)), -700.0)

    bounds = np.array([(0.0, 1.0)] * len(free) + [(-3.0, 3.0)])

    def slopes(z: FloatArray) -> tuple[float, FloatArray]:
        h = np.where(z + STEP > bounds[:, 1], -STEP, STEP)
        found = losses(np.vstack([z, z + np.diag(h)]))
        return float(found[0]), (found[1:] - found[0]) / h

    def coordinates(of: GainPeak) -> FloatArray:
        x = np.clip((of.p[free] - low) / width, 0, 1)
        return np.append(x, math.log(of.frequency / place.frequency))

    def stop(z: Any) -> None:
        del z
        if is_past(until):
            raise StopIteration

    optimize.minimize(
        slopes, coordinates(place), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60},
        callback=stop,
    )  # type: ignore[call-overload]  # fmt: skip
    for half in ASCENT_STEPS:
        losses(coordinates(best) + np.linspace(-half, half, 9)[:, None] * np.eye(len(free) + 1)[-1])
    return best
