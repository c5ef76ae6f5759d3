"""A quick upper bound of a robust margin: eigenvalues of the loop along rays from the nominal parameters.

The rays go to the corners of the box, at the ends and in the middle of what does not grow with the margin, as the
travel. A set of parameters that makes the loop unstable bounds the margin from above. Nothing is proven
by rays along which the loop stays stable: that is what `robust_margin` is for.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.proof.uncertain import Compensator, UncertainSystem, critical_frequency, instability

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

CORNERS = 5  # parameters up to which every corner has a ray; of more, as many corners are drawn
FARTHEST = 20.0  # multiples of the box
LEVELS = (0.125, 0.25, 0.5, 0.75, 1.0)  # shares of a ray at which a first loss of stability is looked for
HALVINGS = 12
ROUNDS = 8  # of corrections by other rays


class RayBound(NamedTuple):
    """The smallest multiple of the box at which a ray leaves stability, and the parameters there.

    upper : infinite where the loop stays stable along all rays
    ray : what `ray_bound` may begin with at the next design
    """

    upper: float
    at: Mapping[str, float]  # SI
    frequency: float | None  # rad/s, of the pole that crosses
    ray: int | None


@dataclass(frozen=True, eq=False)
class _Rays:
    """Rays p(t) = start + t step in the parameters of a loop, each up to an end."""

    loop: tuple[UncertainSystem, Compensator]
    start: FloatArray  # rays x parameters
    step: FloatArray
    end: FloatArray

    def unstable(self, t: FloatArray, chosen: list[int]) -> FloatArray:
        """The real part of the worst pole on the chosen rays at t, 1/s."""
        rows = self.start[chosen] + t[:, None] * self.step[chosen]
        return instability(*self.loop, rows)


def ray_bound(
    loops: Sequence[tuple[UncertainSystem, Compensator]],
    ranges: Mapping[str, float],
    over: Mapping[str, tuple[float, float]],
    first: int | None = None,
) -> RayBound:
    """Bound a margin from above by eigenvalues along rays: some hundred of them, in a fraction of a tenth of a second.

    loops, over : as `travel.travel_loops` returns them
    ranges : relative half range of each parameter, by name
    first : the ray that bounded a neighbouring design, which is then tried first

    Example: `ray_bound(*travel_loops(plant, controller, ("m",)), {"m": 0.2})` with over as the third argument
    """
    sets = [_rays_of(loop, ranges, over) for loop in loops]
    owner = [(k, ray) for k, rays in enumerate(sets) for ray in range(len(rays.end))]
    if any((rays.unstable(np.zeros(1), [0]) >= 0).any() for rays in sets):
        return RayBound(0.0, {}, None, None)
    best, found = math.inf, None
    if first is not None and first < len(owner):
        best = _leave(sets, owner[first])
        found = first if best < math.inf else None
    if found is None:
        best, found = _first_level(sets, owner)
    for _ in range(ROUNDS if found is not None else 0):
        worse = _most_unstable(sets, owner, best * (1 - 1e-3))
        if worse is None or worse == found:
            break
        best, found = min((best, found), (_leave(sets, owner[worse], best), worse))
    if found is None:
        return RayBound(math.inf, {}, None, None)
    k, ray = owner[found]
    system, law = sets[k].loop
    p = sets[k].start[ray] + best * sets[k].step[ray]
    at = dict(zip(system.names, p.tolist(), strict=True))
    return RayBound(best, at, critical_frequency(system, law, p), found)


def _rays_of(
    loop: tuple[UncertainSystem, Compensator],
    ranges: Mapping[str, float],
    over: Mapping[str, tuple[float, float]],
) -> _Rays:
    """The rays to corners from each place of `over`, up to the limits of the parameters."""
    system, names = loop[0], list(loop[0].names)
    places = []
    for ends in itertools.islice(
        itertools.product(*([low, high, (low + high) / 2] for low, high in over.values())), 9
    ):
        place = system.nominal.copy()
        place[[names.index(name) for name in over]] = ends
        places.append(place)
    free = [names.index(name) for name in ranges]
    directions = _corners(len(free))
    step = np.zeros((len(directions), len(names)))
    step[:, free] = directions * np.abs(system.nominal[free]) * np.array(list(ranges.values()))
    start, steps = np.repeat(places, len(step), axis=0), np.tile(step, (len(places), 1))
    limits = np.array(system.limits or [(-math.inf, math.inf)] * len(names))
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(steps > 0, limits[:, 1] - start, np.where(steps < 0, start - limits[:, 0], np.inf))
        reach = np.where(steps == 0, np.inf, room / np.abs(steps)).min(axis=1)
    return _Rays(loop, start, steps, np.minimum(0.999 * reach, FARTHEST))


def _corners(count: int) -> FloatArray:
    """The corners of a box in units of its half ranges; of many parameters a few of them, always the same."""
    if count <= CORNERS:
        return np.array(list(itertools.product((1.0, -1.0), repeat=count)))
    return np.random.default_rng(0).choice([1.0, -1.0], (2**CORNERS, count))


def _leave(sets: Sequence[_Rays], which: tuple[int, int], unstable_at: float = math.inf) -> float:
    """Where a ray leaves stability, by halving; infinite where it is stable at its end."""
    rays, ray = sets[which[0]], [which[1]]
    low, high = 0.0, min(float(rays.end[which[1]]), unstable_at)
    if rays.unstable(np.array([high]), ray)[0] < 0:
        return math.inf
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if rays.unstable(np.array([middle]), ray)[0] >= 0 else (middle, high)
    return high


def _first_level(sets: Sequence[_Rays], owner: Sequence[tuple[int, int]]) -> tuple[float, int | None]:
    """Where the most unstable ray of the first level with an unstable one leaves stability; infinite, and None."""
    farthest = max(float(rays.end.max()) for rays in sets)
    for share in LEVELS:
        worst = _most_unstable(sets, owner, share * farthest)
        if worst is not None:
            return _leave(sets, owner[worst], share * farthest), worst
    return math.inf, None


def _most_unstable(sets: Sequence[_Rays], owner: Sequence[tuple[int, int]], t: float) -> int | None:
    """The ray with the worst pole at t, or at its end where that is nearer; None where all are stable there."""
    grown = np.concatenate(
        [rays.unstable(np.minimum(t, rays.end), list(range(len(rays.end)))) for rays in sets]
    )
    worst = int(grown.argmax())
    return worst if len(owner) and grown[worst] >= 0 else None
