"""The largest gain of a channel anywhere in a box of parameters: a peak of sensitivity that no plant exceeds.

With f(s) the loop's characteristic polynomial, a channel's gain is N(s) / f(s), where N follows from the loop with
twice the gain in that channel: det is affine in a gain of rank one, so that

    S = (2 f - f_2) / f,        T = (f_2 - f) / f.

|N / f| < G on the box and at all frequencies where no point of f's cells comes within |N| / G of zero: the exclusion of
the margin, with a disc about each Bernstein coefficient. It is robust stability against a fictitious complex gain.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from flint import arb
from scipy import optimize

from malta.errors import InputError
from malta.margins.box import Box, box_of
from malta.margins.enclosure import TooWide, Unproven, over_box
from malta.margins.exclusion import Growth, advance, growth_over, start
from malta.margins.family import Family, aligned, combined
from malta.margins.frequency import cover
from malta.margins.loop import B, C, Group, Loop
from malta.margins.robust import law_of, problem_of
from malta.margins.search import Job, halves
from malta.margins.witness import coefficients_at, rows_at
from malta.uncertain import Compensator, UncertainSystem, responses

if TYPE_CHECKING:
    from malta.margins.problem import OfLoop, Polynomial
    from malta.margins.robust import Ranges
    from malta.plant import FloatArray

Channel = Literal["sensors", "forces"]
Kind = Literal["sensitivity", "complementary"]

TOLERANCE = 3e-3  # how close the proven bound comes to the largest gain found, relative
STEPS = (1, 3, 10, 30, 100, 300, 1000)  # multiples of the tolerance that are tried
MOST_CELLS = 60_000
PATCHES = 64
GRID = 400  # frequencies
CORNERS = 48
LOW = 1e-9  # rad/s, that stands for zero


@dataclass(frozen=True, eq=False)
class Gain:
    """The largest gain over a box. lower: reached by `witness`; upper: proven, None where nothing is (`reason`)."""

    lower: float
    upper: float | None
    frequency: float  # rad/s
    witness: Mapping[str, float]  # SI
    cells: int
    seconds: float
    reason: str = ""

    def __str__(self) -> str:
        high = "nothing proven" if self.upper is None else f"proven below {self.upper:.4g}"
        return f"{self.lower:.4g} at {self.frequency:.4g} rad/s, {high}"


@dataclass(frozen=True, eq=False)
class Pair:
    """f and N over a part of the box; no N of groups that the channel does not act on."""

    f: Family
    N: Family | None
    growth: Growth


def worst_case_gain(
    system: UncertainSystem,
    compensator: Compensator | Any,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    of: Kind = "sensitivity",
    at: Channel = "sensors",
    channel: int = 0,
    tolerance: float = TOLERANCE,
    time: float | None = None,
) -> Gain:
    """The largest |S| or |T| of one channel over all parameters of a box and all frequencies, as wcgain gives it.

    Parameters
    ----------
    compensator, ranges, over : as robust_margin takes them; the box is the modelled one, t = 1
    of : sensitivity S = 1 / (1 - L) or complementary sensitivity T = L / (1 - L), L around the loop from the channel
        back to it, the other channels closed
    at, channel : sensors or forces, counted from 0
    tolerance : how close the proven bound shall come to the gain that was found, relative
    time : s, after which what stands is returned

    Raises InputError as robust_margin does, and for channels that the loop does not have.

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> found = malta.worst_case_gain(motor, [[-2.0]], {"k": 0.5}, of="complementary")
    >>> round(found.lower, 4), found.upper is not None  # T = 2 k / (s + 1 + 2 k)
    (0.75, True)
    """
    begun = clock.monotonic()
    law = law_of(system, compensator)
    box = box_of(system.names, system.nominal, system.limits, ranges, over or {})
    until = math.inf if time is None else begun + time
    asked = Question(box, of, at, channel, tolerance, until)
    asked.check(system, of)
    if not box.most > 1:
        raise InputError("worst_case_gain", "ranges", "a box that reaches a limit", "one within the limits")
    one, two = problem_of(system, law), problem_of(system, doubled(law, at, channel))
    if (one.instability(box.standing()) >= 0).any():
        return Gain(
            math.inf, None, math.nan, {}, 0, clock.monotonic() - begun, "the nominal loop is unstable"
        )
    try:
        with np.errstate(all="ignore"):  # what is not finite excludes nothing
            pairs = pairs_of(one, two, asked)
    except Unproven as error:
        lower, w, p = _response(system, law, asked, box.nominal, [])
        return Gain(lower, None, w, _named(box, p), 0, clock.monotonic() - begun, str(error))
    starts = [climbed(pair, one) for pair in pairs if pair.N is not None]
    lower, w, p = _response(system, law, asked, box.nominal, starts)
    with np.errstate(all="ignore"):
        upper, cells = _proven(pairs, lower, asked)
    reason = "" if upper is not None else "not settled: the box may hold an unstable loop"
    if upper is not None and not Job(one, box, 1e-3, True, until, MOST_CELLS, None).stable():
        upper, reason = None, "the nominal loop is not proven stable"
    return Gain(lower, upper, w, _named(box, p), cells, clock.monotonic() - begun, reason)


@dataclass(frozen=True, eq=False)
class Question:
    box: Box
    of: Kind
    at: Channel
    channel: int
    tolerance: float
    until: float

    def check(self, system: UncertainSystem, kind: str) -> None:
        """Raise InputError for channels and kinds that there are not."""
        if system.matrices.n_out() != 3 or system.sample_time is not None:
            found = "D or E, or discrete time"
            raise InputError("channel", "system", found, "A, B, C alone in continuous time")
        outputs, inputs = system.matrices.size1_out(2), system.matrices.size2_out(1)
        known = kind in ("sensitivity", "complementary", "multiplicative", "feedback")
        if self.at not in ("sensors", "forces") or not known:
            expected = "sensitivity or complementary, multiplicative or feedback; sensors or forces"
            raise InputError("channel", "kind, at", f"{kind}, {self.at}", expected)
        if not 0 <= self.channel < (outputs if self.at == "sensors" else inputs):
            raise InputError("channel", "channel", f"{self.channel}", f"one of the {self.at}, from 0")
        if not self.tolerance > 0:
            raise InputError("channel", "tolerance", f"{self.tolerance}", "a number above zero")


def _named(box: Box, p: FloatArray) -> dict[str, float]:
    return dict(zip(box.names, p.tolist(), strict=True))


def doubled(law: Compensator, at: Channel, channel: int) -> Compensator:
    """The compensator with twice the gain in one channel."""
    B, C, D = law.B.copy(), law.C.copy(), law.D.copy()
    if at == "sensors":
        B[:, channel] *= 2
        D[:, channel] *= 2
    else:
        C[channel] *= 2
        D[channel] *= 2
    return replace(law, B=B, C=C, D=D)


def pairs_of(one: OfLoop, two: OfLoop, asked: Question, reach: float = 1.0) -> list[Pair]:
    """f and N of the group that the channel acts on, over parts of box(reach). Raises Unproven."""
    sides = asked.box.sides(reach)
    p = [arb(a).union(arb(b)) for a, b in sides.tolist()]
    first, second = one.parts(p), two.parts(p)
    if _members(first) != _members(second):
        raise Unproven("the channel joins groups of states")
    found: list[Pair] = []
    touched = 0
    for (f, moves), (g, other) in zip(first, second, strict=True):
        acts = _acts(one.loop, f.group, asked)  # type: ignore[attr-defined]
        touched += acts
        todo = [sides]
        while todo:
            own = todo.pop()
            try:
                families = over_box(f, own, moves, asked.until), over_box(g, own, other, asked.until)
            except TooWide as error:
                if len(todo) + len(found) >= PATCHES:
                    raise Unproven(str(error)) from error
                todo += halves(own, error.axis, float(asked.box.nominal[error.axis]))
                continue
            found.append(_pair(*families, f, own, asked, acts=acts, neglects=bool(moves or other)))
    if touched > 1:
        raise Unproven("the channel acts on several groups of states")
    return found


def _members(parts: Any) -> list[Any]:
    return [(f.group.states, f.group.own, f.group.inputs) for f, _ in parts]


def _acts(loop: Loop, group: Group, asked: Question) -> bool:
    """Whether the channel reads or drives states of a group anywhere, by the expressions and not by their values."""
    which, side = (C, 0) if asked.at == "sensors" else (B, 1)
    entries = loop.program.entries[which] if loop.symbolic is None else loop.symbolic.entries[which]
    return any(at[side] == asked.channel and at[1 - side] in group.states for at in entries)


def _pair(
    f: Family, g: Family, of: Polynomial, sides: FloatArray, asked: Question, *, acts: bool, neglects: bool
) -> Pair:
    f, g = aligned(f, g)
    N = None
    if acts:
        N = combined(f, g, 2.0, -1.0) if asked.of == "sensitivity" else combined(f, g, -1.0, 1.0)
    if (
        neglects
    ):  # what couplings taken as zero do with the fictitious gain closed: entries grow as with twice the gain
        share = np.exp2(np.clip(np.array(g.exponents) - np.array(f.exponents), -1000, 1000))
        f = replace(f, radius=f.radius + 2 * share * g.radius)
    return Pair(f, N, growth_over(sides, of.inverted, asked.box))


# the largest gain that is found


def climbed(
    pair: Pair, problem: OfLoop, t: float = 1.0, weighted: Callable[[FloatArray], FloatArray] | None = None
) -> tuple[FloatArray, float]:
    """p in box(t) and rad/s of a large |N / f|, times a weight: the best of a grid, and uphill from there."""
    f, N, growth = pair.f, pair.N, pair.growth
    assert N is not None
    share = np.exp2(np.array(N.exponents) - np.array(f.exponents))

    def gain(u: FloatArray, x: FloatArray) -> FloatArray:
        a, b = coefficients_at(f, u)[0], coefficients_at(N, u)[0] * share
        rows = rows_at(f, 0, x)
        size = np.abs(rows @ b) / np.maximum(np.abs(rows @ a), 1e-300)
        if weighted is not None:
            size = size * weighted(np.array([problem.physical(float(v)) for v in np.ldexp(x, f.scale)]))
        return np.asarray(size)

    inner = cover(f)
    inner = inner[(inner[:, 0] == 0) & (inner[:, 1] > 0)]
    x = np.geomspace(inner[0, 1], inner[-1, 2], GRID) if len(inner) else np.ones(1)
    sides = growth.inside(t)
    sides[np.array(f.shape) == 1] = 0.5
    rng = np.random.default_rng(0)
    corners = [sides[np.arange(len(sides)), rng.integers(0, 2, len(sides))] for _ in range(CORNERS)]
    places = [(u, gain(u, x)) for u in np.unique([sides.mean(axis=1), *corners], axis=0)]
    u, sizes = max(places, key=lambda place: float(place[1].max()))
    k = int(sizes.argmax())
    if float(gain(u, np.zeros(1))[0]) > 0.999 * float(sizes[k]):  # at w = 0
        return growth.parameters(u), 0.0

    def loss(z: FloatArray) -> float:
        u = np.clip(z[:-1], sides[:, 0], sides[:, 1])
        return -math.log(max(float(gain(u, np.exp(z[-1:]))[0]), 1e-300))

    z0 = np.append(u, math.log(x[k]))
    bounds = [*(tuple(side) for side in sides.tolist()), (z0[-1] - 2, z0[-1] + 2)]
    found = optimize.minimize(
        loss, z0, method="L-BFGS-B", bounds=bounds, options={"ftol": 1e-15, "gtol": 1e-10}
    )
    z = np.asarray(found.x) if found.fun <= loss(z0) else z0
    polished = optimize.minimize_scalar(
        lambda y: loss(np.append(z[:-1], y)), bounds=(z[-1] - 0.05, z[-1] + 0.05), method="bounded",
        options={"xatol": 1e-10},
    )  # fmt: skip
    if polished.fun < loss(z):
        z = np.append(z[:-1], polished.x)
    u = np.clip(z[:-1], sides[:, 0], sides[:, 1])
    return growth.parameters(u), problem.physical(float(np.ldexp(math.exp(z[-1]), f.scale)))


def gain_at(system: UncertainSystem, law: Compensator, asked: Question, p: FloatArray, w: float) -> float:
    """The channel's gain by frequency responses of plant and compensator."""
    P, F = responses(system, law, p, np.array([max(w, LOW)]))
    L = P @ F if asked.at == "sensors" else F @ P
    S = np.linalg.inv(np.eye(L.shape[1]) - L[0])[asked.channel, asked.channel]
    return float(abs(S if asked.of == "sensitivity" else S - 1))


def _response(
    system: UncertainSystem,
    law: Compensator,
    asked: Question,
    nominal: FloatArray,
    starts: list[tuple[FloatArray, float]],
) -> tuple[float, float, FloatArray]:
    """The gain at the places found, by frequency responses of plant and compensator: gain, rad/s, p."""
    top = math.pi / law.sample_time if law.sample_time is not None else 1e6
    places = starts or [(nominal, w) for w in np.geomspace(1e-6 * top, 0.999 * top, 300)]
    best = (0.0, math.nan, nominal)
    for p, w in places:
        size = gain_at(system, law, asked, p, min(w, top))
        if size > best[0]:
            best = (size, float(w), p)
    return best


# what no plant exceeds


def _proven(pairs: list[Pair], lower: float, asked: Question) -> tuple[float | None, int]:
    """The smallest bound of those tried that holds for all pairs, and the cells that were looked at."""
    count = 0
    for step in STEPS:
        bound = max(lower, 1e-9) * (1 + step * asked.tolerance)
        found, cells = _excluded(pairs, bound, asked.until)
        count += cells
        if found:
            return bound, count
        if clock.monotonic() > asked.until:
            break
    return None, count


def _excluded(pairs: list[Pair], bound: float, until: float) -> tuple[bool, int]:
    """Whether |N| < bound |f| on all cells."""
    count = 0
    for pair in pairs:
        done, cells = excluded(pair, 1 + 1e-9, lambda cells: np.full(len(cells), 1 / bound), until)
        count += cells
        if not done:
            return False, count
    return True, count


def excluded(
    pair: Pair, target: float, share: Callable[[FloatArray], FloatArray], until: float
) -> tuple[bool, int]:
    """Whether share |N| < |f| on all cells of box(target), share by the cell; and the cells that were looked at."""
    search = replace(start(pair.f, pair.growth, target), beside=pair.N, share=share)
    while not search.finished:
        if search.count > MOST_CELLS or clock.monotonic() > until:
            return False, search.count
        advance(search)
    return True, search.count
