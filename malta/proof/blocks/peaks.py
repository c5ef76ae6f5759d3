"""The largest gain over a box of parameters and all frequencies: a grid at corners, and ascents from there.

The result is the gain of one plant of the box, so it is a lower bound; it need not be the largest gain.
"""

from __future__ import annotations

import itertools
import math
import time as clock
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.model.plant import readonly

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray
    from malta.proof.problem import OfLoop

CORNERS = 32
PLACES = 4  # starts of ascents at most
AROUND = np.array([0.5, 0.8, 0.9, 0.95, 0.98, 1.0, 1.02, 1.05, 1.1, 1.25, 2.0])
ENDS = (0.01, 100.0)  # beyond the slowest and the fastest pole
FAR_ENDS = (1e-5, 1e4)  # that stand for zero and for infinity
GRID = 80
STEP = 1e-8  # of relative places and log frequencies, for slopes
AHEAD = 0.02 / 4.0 ** np.arange(7)  # log frequencies either way that an ascent looks at last
REAL = 1e-3  # share of |s| below which an imaginary part shows no peak: of a real pole it is rounding

Value = Callable[["FloatArray", "FloatArray"], "FloatArray"]  # of p, or rows of p, and of rows of w


class Peak(NamedTuple):
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
    known = np.concatenate([np.abs(s), np.abs(s.imag[np.abs(s.imag) > REAL * np.abs(s)])])
    known = known[np.isfinite(known) & (known > 0)]
    top = _top(problem)
    if not len(known):
        known = np.array([1.0])
    wide = np.geomspace(known.min() * ENDS[0], min(known.max() * ENDS[1], top), GRID)
    far = np.array([known.min(), known.max()]) * FAR_ENDS
    w = np.unique(np.concatenate([wide, far, (known[:, None] * AROUND).ravel()]))
    return readonly(np.append(w[w < top], top) if math.isfinite(top) else w)


def _top(problem: OfLoop) -> float:
    """The Nyquist frequency of a loop, rad/s; infinite for a continuous loop."""
    T = problem.loop.law.sample_time
    return math.inf if T is None else math.pi / T


def climb(
    value: Value, problem: OfLoop, sides: FloatArray, starts: Sequence[FloatArray], until: float = math.inf
) -> Peak:
    """The largest value found within the sides of a box (P x 2) until a time, from the best places of some starts."""
    places: list[Peak] = []
    for p in starts:
        if places and clock.monotonic() > until:
            break
        w = frequencies(problem, p)
        v = value(p, w)
        inner = np.flatnonzero((v >= np.append(v[1:], -np.inf)) & (v >= np.append(-np.inf, v[:-1])))
        places += [Peak(float(v[k]), float(w[k]), p) for k in inner[np.argsort(v[inner])[-3:]]]
    places.sort(key=lambda place: -place.value)
    if not math.isfinite(places[0].value):
        return places[0]
    top = _top(problem)
    best = places[0]
    for place in places[: min(PLACES, len(starts))]:
        if clock.monotonic() > until:
            break
        best = max(best, _uphill(value, place, sides, top, until), key=lambda found: found.value)
    return best


def _uphill(value: Value, place: Peak, sides: FloatArray, top: float, until: float) -> Peak:
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
        found = value(p, w)
        k = int(np.where(np.isnan(found), -np.inf, found).argmax())
        if found[k] > best.value:
            best = Peak(float(found[k]), float(w[k]), p[k])
        return np.where(np.isfinite(found), -np.log(np.maximum(found, 1e-300)), -700.0)

    bounds = np.array([(0.0, 1.0)] * len(free) + [(-3.0, 3.0)])

    def slopes(z: FloatArray) -> tuple[float, FloatArray]:
        h = np.where(z + STEP > bounds[:, 1], -STEP, STEP)
        found = losses(np.vstack([z, z + np.diag(h)]))
        return float(found[0]), (found[1:] - found[0]) / h

    def coordinates(of: Peak) -> FloatArray:
        x = np.clip((of.p[free] - low) / width, 0, 1)
        return np.append(x, math.log(of.frequency / place.frequency))

    def stop(z: Any) -> None:
        del z
        if clock.monotonic() > until:
            raise StopIteration

    optimize.minimize(
        slopes, coordinates(place), jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 60},
        callback=stop,
    )  # type: ignore[call-overload]  # fmt: skip
    for half in AHEAD:
        losses(coordinates(best) + np.linspace(-half, half, 9)[:, None] * np.eye(len(free) + 1)[-1])
    return best
