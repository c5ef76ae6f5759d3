"""The loss of stability along lines through a box, by the poles in floating point: estimates, no proofs."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.errors import CheckError
from malta.linear.closed_loops import critical_frequency, instability
from malta.linear.expressions import NotAnalytic
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.proof.exclusion.witness import Zero, gradients
from malta.work import is_past

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.proof.box import Box
    from malta.proof.exclusion import BoxPart
    from malta.proof.problem import Problem

    Loss = tuple[float, float | None, FloatArray | None]  # t, w, p

STEP = 1e-6  # of a range, for slopes of the worst root
LOSS_ACCURACY = 2.0**-40  # of a step of the grid, to which a loss is narrowed down
ROUNDS = 6  # from corner to corner
CALL = 2e-4  # work of a call for poles, beside that of each row
CORNERS = 64  # of a box that are looked at before its families are made


def corner_loss(problem: Problem, box: Box, reach: float) -> float | None:
    """The first t up to `reach` at which a corner of the box is unstable, by the poles.

    The estimate comes from above; infinite without a loss. None where the box has more than CORNERS, and where the work
    is up.
    """
    sides = [
        [rate for rate in (-down, up) if rate] or [0.0]
        for down, up in zip(box.down.tolist(), box.up.tolist(), strict=True)
    ]
    if math.prod(map(len, sides)) > CORNERS:
        return None
    corners = np.array(list(itertools.product(*sides)))
    rays = [(place, corner) for place in box.nominal_places()[:3] for corner in corners]
    low, high = 0.0, reach
    for steps in (np.geomspace(1e-2, 1, 10), *[np.linspace(0, 1, 6)[1:]] * 3):
        for t in (low + (high - low) * steps).tolist():
            if is_past():
                return None
            rows = np.array([place + t * corner for place, corner in rays])
            bad = _instability(problem, rows, -math.inf) >= 0
            if bad.any():
                break
            low = t
        else:
            return math.inf
        high = t
        rays = [ray for ray, lost in zip(rays, bad, strict=True) if lost]
    return high


def first_loss(problem: Problem, box: Box, reach: float) -> Loss:
    """The first loss of stability along the diagonals of the box, by the poles: t, w (rad/s) and p; else infinity.

    The nearest that is found until the work is up.
    """
    free = [i for i in range(len(box.names)) if box.down[i] + box.up[i] > 0]
    signs = np.array(list(itertools.islice(itertools.product((-1, 1), repeat=len(free)), 256)))
    best: Loss = (math.inf, None, None)
    for place in box.nominal_places()[:27]:
        best = _nearer(problem, place, _uphill(problem, box, place), reach, best)
        best = _improve_corner(problem, box, place, best)
        for sign in signs:
            if is_past():
                return best
            d = np.zeros(len(box.names))
            d[free] = np.where(sign > 0, box.up[free], -box.down[free])
            best = _nearer(problem, place, d, reach, best)
        best = _improve_corner(problem, box, place, best)
    return best


def loss_beside(problem: Problem, box: Box, witness: FloatArray, proven: float, reach: float) -> Loss:
    """The first loss up to `reach` towards the witness of another loop, or at a corner near it; else infinity.

    proven : t up to which the box is known to be stable
    """
    place = box.nominal_places()[0]
    d = (witness - place) / max(float(box.margin(witness)), 1e-300)
    found = _nearer(problem, place, d, reach, (math.inf, None, None), proven)
    return _improve_corner(problem, box, place, found, proven)


def _nearer(
    problem: Problem, place: FloatArray, d: FloatArray, reach: float, best: Loss, proven: float = 0.0
) -> Loss:
    """The first loss along a direction if it is nearer than the best one, else that one."""
    t = _along(problem, place, d, min(reach, best[0]), proven)
    if not t < best[0]:
        return best
    p = place + t * d
    return t, _critical(problem, p, place), p


def _improve_corner(problem: Problem, box: Box, place: FloatArray, best: Loss, proven: float = 0.0) -> Loss:
    """Move a loss to the corner that the slopes of the worst root point to, as long as t decreases."""
    for _ in range(ROUNDS):
        t, _, p = best
        if p is None or not np.isfinite(t) or is_past():
            break
        d = _uphill(problem, box, p)
        nearer = _along(problem, place, d, t, proven)
        if not nearer < t * (1 - 1e-9):
            break
        there = place + nearer * d
        best = (nearer, _critical(problem, there, place), there)
    return best


def corner_of(problem: Problem, box: Box, p: FloatArray) -> FloatArray:
    """The corner that the slopes of the worst root point to, of the box with p on its edge; p when it is stable."""
    d = _uphill(problem, box, p)
    corner = np.where(box.down + box.up > 0, box.nominal + float(box.margin(p)) * d, p)
    return corner if float(_instability(problem, corner[None], -math.inf)[0]) > 0 else p


def _uphill(problem: Problem, box: Box, p: FloatArray) -> FloatArray:
    """The side of box(1), for each parameter, towards which the worst root moves outwards."""
    steps = STEP * (box.up + box.down)
    rows = p + np.diag(steps)[steps > 0]
    with np.errstate(all="ignore"):
        slopes = np.zeros(len(p))
        slopes[steps > 0] = _instability(problem, rows, 0.0) - _instability(problem, p[None], 0.0)
    return np.where(slopes > 0, box.up, -box.down)


def _critical(problem: Problem, p: FloatArray, place: FloatArray) -> float | None:
    """The frequency of the worst root (rad/s), just beyond p when the loop has none at p (a mass of zero)."""
    for share in (1.0, 1 + 1e-9, 1 + 1e-6):
        try:
            found = problem.critical_frequency(place + share * (p - place))
        except (CheckError, np.linalg.LinAlgError, NotAnalytic):
            continue
        if np.isfinite(found):
            return found
    return None


def _instability(problem: Problem, rows: FloatArray, unknown: float) -> FloatArray:
    """The distance of the worst root beyond the boundary; `unknown` for all rows when one of them has no loop."""
    is_past(price=CALL + problem.traits.poles * len(rows))
    try:
        return np.asarray(problem.instability(rows))
    except (CheckError, np.linalg.LinAlgError, NotAnalytic):
        return np.full(len(rows), unknown)


def _along(problem: Problem, p: FloatArray, d: FloatArray, reach: float, proven: float = 0.0) -> float:
    """The first t of a grid up to `reach` at which p + t d is unstable, narrowed down; infinite for none.

    proven : t up to which the line is known to be stable
    """

    def rates(t: FloatArray) -> FloatArray:
        return _instability(problem, p + t[:, None] * d, -math.inf)

    if proven:
        grid = np.linspace(min(proven, reach), reach, 4)
    else:
        grid = np.unique(np.concatenate([np.geomspace(1e-3, 1, 24) * reach, np.linspace(0, reach, 41)[1:]]))
    bad = rates(grid) >= 0
    if not bad.any():
        return math.inf
    k = int(bad.argmax())
    low, high = (float(grid[k - 1]) if k else 0.0), float(grid[k])
    if is_past():
        return high
    return narrow_loss(lambda t: float(rates(np.array([t]))[0]), low, high, LOSS_ACCURACY * (high - low))


WITNESS_DISTANCE = 1e-9  # of a loss of stability: how far beyond the boundary its witness is


def narrow_loss(rate: Callable[[float], float], low: float, high: float, width: float) -> float:
    """The least t that was seen with rate(t) >= 0, between a stable `low` and an unstable `high`; Brent's method.

    A share of WITNESS_DISTANCE further where it is unstable there too: at the boundary itself, rounding decides on
    another computer.

    width : to which it is narrowed down
    """
    from scipy import optimize  # which takes a while to read

    seen = high

    def looked(t: float) -> float:
        nonlocal seen
        found = rate(t)
        seen = min(seen, t) if found >= 0 else seen
        return found if math.isfinite(found) else math.copysign(1.0, found)

    with suppress(ValueError):  # it is unstable at the lower end, too
        optimize.brentq(looked, low, high, xtol=width, maxiter=60, disp=False)
    further = seen * (1 + WITNESS_DISTANCE)
    return further if further < high and rate(further) >= 0 else seen


# A quick upper bound of a robust margin: eigenvalues of the loop along rays from the nominal parameters.
#
# The rays go to the corners of the box, at the ends and in the middle of what does not grow with the margin, as the
# travel. A set of parameters that makes the loop unstable bounds the margin from above. Nothing is proven
# by rays along which the loop stays stable: that is what `robust_margin` is for.


RAYS_TO_CORNERS = 5  # parameters up to which every corner has a ray; of more, as many corners are drawn
MAX_BOX_FACTOR = 20.0  # multiples of the box
LEVELS = (0.125, 0.25, 0.5, 0.75, 1.0)  # shares of a ray at which a first loss of stability is looked for
RAY_RESOLUTION = 2.0**-13  # of a ray, to which a loss of stability is narrowed down
NEIGHBOUR_DISTANCE = 0.02  # of the margin of a neighbouring design: how near that of a design is expected
RAY_ROUNDS = 8  # of corrections by other rays


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
    first: tuple[int, float] | None = None,
) -> RayBound:
    """Bound a margin from above by eigenvalues along rays: some hundred of them, in a fraction of a tenth of a second.

    loops, over : as `travel.travel_loops` returns them
    ranges : relative half range of each parameter, by name
    first : the ray that bounded a neighbouring design, which is then tried first, and its margin

    Example: `ray_bound(*travel_loops(plant, controller, ("m",)), {"m": 0.2})` with over as the third argument
    """
    sets = [_rays_of(loop, ranges, over) for loop in loops]
    owner = [(k, ray) for k, rays in enumerate(sets) for ray in range(len(rays.end))]
    if any((rays.unstable(np.zeros(1), [0]) >= 0).any() for rays in sets):
        return RayBound(0.0, {}, None, None)
    best, found = math.inf, None
    if first is not None and first[0] < len(owner):
        best = _leave(sets, owner[first[0]], near=first[1])
        found = first[0] if best < math.inf else None
    if found is None:
        best, found = _first_level(sets, owner)
    for _ in range(RAY_ROUNDS if found is not None else 0):
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
    return _Rays(loop, start, steps, np.minimum(0.999 * reach, MAX_BOX_FACTOR))


def _corners(count: int) -> FloatArray:
    """The corners of a box in units of its half ranges; of many parameters a few of them, always the same."""
    if count <= RAYS_TO_CORNERS:
        return np.array(list(itertools.product((1.0, -1.0), repeat=count)))
    return np.random.default_rng(0).choice([1.0, -1.0], (2**RAYS_TO_CORNERS, count))


def _leave(
    sets: Sequence[_Rays], which: tuple[int, int], unstable_at: float = math.inf, near: float = math.nan
) -> float:
    """Where a ray leaves stability, the nearest unstable t that was seen; infinite where it is stable at its end.

    near : where it may be, which is looked at first
    """
    rays, ray = sets[which[0]], which[1]
    end = min(float(rays.end[ray]), unstable_at)
    about = np.array([near * (1 - NEIGHBOUR_DISTANCE), near * (1 + NEIGHBOUR_DISTANCE)])
    if about[1] < end and (rays.unstable(about, [ray, ray]) >= 0).tolist() == [False, True]:
        low, high = about.tolist()
    elif rays.unstable(np.array([end]), [ray])[0] < 0:
        return math.inf
    else:
        low, high = 0.0, end
    return narrow_loss(
        lambda t: float(rays.unstable(np.array([t]), [ray])[0]), low, high, RAY_RESOLUTION * end
    )


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


# Witnesses confirmed by the poles of the loop, and the share of each parameter in them.


BISECTIONS = 16  # of the way to a witness
UNBISECTED_DISTANCE = 1e-5  # relative, beyond a zero: poles that become unstable within it take no bisection


def confirm(problem: Problem, box: Box, zero: Zero, part: BoxPart) -> Loss | None:
    """The t, frequency and p just beyond a zero at which the poles are unstable; None where they stay stable."""
    p = part.growth.parameters(zero.u)
    w = problem.physical(zero.frequency(part.family))
    stable = 1.0
    for share in 1 + 10.0 ** np.arange(-9, -0.9, 0.5):
        there = box.stretch(p, share)
        if _is_unstable(problem, there):
            if problem.traits.is_bounded:  # the zero is that of uncoupled axes
                p = corner_of(problem, box, there)
                there = box.stretch(p, _first_unstable(problem, box, p, 0.95, 1.0))
                return float(box.margin(there)), w, there
            if share > 1 + UNBISECTED_DISTANCE:  # a double zero, which is found to the root of rounding
                share = _first_unstable(problem, box, p, stable, float(share))
                there = box.stretch(p, share)
            return float(zero.t * share), w, there
        stable = float(share)
    return None


def _first_unstable(problem: Problem, box: Box, p: FloatArray, low: float, high: float) -> float:
    """The share of the way to p, between low and high, from which on the loop is unstable: bisected."""
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if _is_unstable(problem, box.stretch(p, middle)) else (middle, high)
    return high


def _is_unstable(problem: Problem, p: FloatArray) -> bool:
    """Whether the poles at p are unstable; False where the loop has no poles there."""
    try:
        return bool(problem.instability(p[None])[0] > 0)
    except (CheckError, np.linalg.LinAlgError):
        return False


def contributions(zero: Zero, part: BoxPart, names: tuple[str, ...]) -> dict[str, float]:
    """The share of each parameter in reaching the boundary: d ln(margin) = -sum of share x d ln(range).

    Along f(jw, p) = 0 the margin moves by Im(conj(f_w) f_p dp); at the witness all parameters pull the same way.
    """
    g = part.growth
    p = g.parameters(zero.u)
    moved = np.where(g.grows, p - g.nominal, 0)
    by_u, by_x = gradients(part.family, zero)
    slope = g.slopes(zero.u)
    pulls = by_u / np.where(slope == 0, 1, slope) * moved
    size = pulls.real if zero.x == 0 else (np.conj(by_x) * pulls).imag
    total = size.sum()
    used = [i for i in range(len(p)) if abs(moved[i]) > 1e-9 * abs(p[i]) and size[i] != 0]
    return {names[i]: float(size[i] / total) for i in used} if total else {}
