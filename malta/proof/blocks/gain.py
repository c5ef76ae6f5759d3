"""The largest gain of a loop anywhere in a box of parameters: a peak of sensitivity that no plant exceeds.

A gain stays below G exactly when the loop is robustly stable against one more complex block, of size 1 / G, from the
gain's output to its input. This fictitious block is the last one of polydisc.py.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from malta.arguments import positive
from malta.arrays import ComplexArray, FloatArray
from malta.bound import Bound, at_least, at_most
from malta.budget import Budget, in_rounds
from malta.display import Description, display, quantity
from malta.errors import InputError
from malta.linear.open_loops import responses
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.processes import on_one_thread
from malta.proof.blocks import (
    At,
    Block,
    Channels,
    Dynamic,
    Expanded,
    Weight,
    blocks_of,
    channels_of,
    check_blocks,
    probe,
    shape_of,
    weight_of,
)
from malta.proof.blocks.polydisc import PolydiscPart, Size, is_zero_free, parts_of
from malta.proof.blocks.transfer import (
    GainPeak,
    LoopSignals,
    climb,
    frequencies,
    mu_bound,
    patterns,
    performance,
    transfer,
)
from malta.proof.box import Box, box_of, within_branches
from malta.proof.groups import loop_of
from malta.proof.loss import first_loss
from malta.proof.margin import NOT_BEGUN, Margin, Ranges, unproven
from malta.proof.polynomial.enclosure import NO_COEFFICIENTS, Unproven
from malta.proof.problem import OfLoop, is_nominal_stable
from malta.proof.robust import law_of, problem_of
from malta.work import WorkUp, answer_in_time, is_past, work_limit

# Unmodelled dynamics beside real parameters: stable blocks Delta_k with |Delta_k(jw)| <= t |W_k(jw)|.
#
# The loop loses stability at the smallest t with det(1 - M(jw; p) Delta) = 0 for some p of box(t), some Delta of that
# size and some frequency; for one block alone that is |W M| = 1 / t. polydisc.py proves the determinant free of zeros
# for smaller t.


DYNAMIC_TOLERANCE = 1e-3
# Bounds that are tried, in multiples of the tolerance.
DYNAMIC_STEPS = (1, 3, 10, 30, 100, 300, 1000, 3000, 10_000)
ROUNDS = 3
ROUNDS_OF_SECANT = 40
SEARCH = 0.4  # share of the work for the search of a loss; the rest is for the proof


@on_one_thread
@answer_in_time(NOT_BEGUN)
def dynamic_margin(
    system: UncertainSystem,
    compensator: Compensator | Any,
    ranges: Ranges,
    dynamic: Dynamic | Sequence[Dynamic],
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float = DYNAMIC_TOLERANCE,
    time: float | None = None,
) -> Margin:
    """Prove how far real parameters and blocks of unmodelled dynamics may deviate together before the loop is unstable.

    The weights of the blocks grow with t as the ranges of the parameters do. This is robstab with ureal and ultidyn.

    system : the uncertain system, from `malta.uncertain`
    compensator : u = F y (positive feedback): a Compensator, a control.StateSpace, or a gain matrix
    ranges : of the parameters, as in `malta.robust_margin`; may be empty
    dynamic : a block, or up to four that act in this order, at most one of them full
    over : intervals that do not grow with t, in SI
    tolerance : relative distance between the proven bound and the loss that was found
    time : s, longest search, which then returns the bounds found so far; None: as long as 120 units of work take

    Returns a Margin. `witness` holds the parameters; the blocks' sizes there are `t |W|` at `frequency`.

    Raises InputError as `malta.robust_margin` does, for channels that the loop does not have and for invalid weights.

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> found = malta.dynamic_margin(motor, [[-2.0]], {}, malta.proof.Dynamic(0.5))
    >>> round(found.upper, 3)  # |T| = 2 / 3 at w = 0
    3.0
    """
    begun = clock.monotonic()
    law, box = question_of("dynamic_margin", system, compensator, ranges, over)
    check_effort("dynamic_margin", tolerance, time)
    blocks = blocks_of(system, dynamic, "dynamic_margin")
    if not blocks:
        raise InputError("dynamic_margin", "dynamic", "no block", "at least one malta.proof.Dynamic")
    asked = BlockLoop.of(system, law, box, blocks, "dynamic_margin")
    if asked.unstable():
        reason = "the nominal loop is unstable"
        return Margin(0.0, 0.0, None, None, {}, {}, (), clock.monotonic() - begun, reason)

    def ask(until: float, _: bool) -> tuple[GainPeak | None, float | None, str]:
        lost = _loss(asked, SEARCH * until)
        t = math.inf if lost is None else _size(asked, lost)
        return lost, *_prove_dynamic(asked, min(t, asked.box.limit), tolerance, until)

    settled = ("", system.approximate)  # reasons for which more work proves no more
    with np.errstate(all="ignore"):  # a cell with infinite bounds excludes nothing
        (lost, lower, reason), ended = in_rounds(
            Budget(time=time), ask, lambda x: x[1] or 0.0 if x[-1] not in settled else math.inf
        )
    took, names = clock.monotonic() - begun, box.names
    reason = system.reason(reason if reason in settled else ended.explain(reason))
    if lost is None:
        return Margin(lower, math.inf, None, None, {}, {}, (), took, reason, box.searched, ended.work)
    t, witness = _size(asked, lost), dict(zip(names, lost.p.tolist(), strict=True))
    moved = dict(zip(names, (lost.p - box.nominal).tolist(), strict=True))
    return Margin(lower, t, lost.frequency, witness, moved, {}, (), took, reason, "", ended.work)


@dataclass(frozen=True, eq=False)
class BlockLoop:
    """A loop with complex blocks, over a box of parameters."""

    system: UncertainSystem
    law: Compensator
    box: Box
    blocks: tuple[Block, ...]
    problem: OfLoop  # without the blocks
    with_blocks: OfLoop  # whose last parameters are entries of these blocks, perhaps among those of others
    entries: tuple[list[int], ...]  # of each block: their numbers

    @classmethod
    def of(
        cls, system: UncertainSystem, law: Compensator, box: Box, blocks: Sequence[Block], where: str
    ) -> BlockLoop:
        """The loop of a system and a compensator with blocks.

        Raises InputError for blocks that cannot be combined.
        """
        check_blocks(blocks, where)
        problem = problem_of(system, law)
        scaled = tuple(_scale_probe(system, law, box.nominal, b, problem) for b in blocks)
        first, one = len(system.names), scaled[0]
        if len(scaled) == 1 and one.kind in ("multiplicative", "feedback") and not one.full:
            wide = _in_each_channel(system, law, one.at)
            return cls(system, law, box, scaled, problem, wide, ([first + one.rows[0]],))
        ends = np.cumsum([first, *(len(b.entries) for b in scaled)]).tolist()
        entries = tuple(list(range(*pair)) for pair in pairwise(ends))
        wide = OfLoop(loop_of(*probe(system, law, scaled)))
        return cls(system, law, box, scaled, problem, wide, entries)

    def unstable(self) -> bool:
        """Whether the nominal loop is unstable anywhere in the intervals that do not grow."""
        return bool((self.problem.instability(self.box.nominal_places()) >= 0).any())

    def transfer(self, p: FloatArray, w: FloatArray) -> ComplexArray:
        """M at parameters p and frequencies w (rad/s), its rows times the blocks' weights: k x columns x rows.

        p : one row, or a row for each frequency
        """
        if p.ndim == 1 and len(w) > 1:
            found = _signals_on_grid(self.system, self.law, p.tobytes(), w.tobytes())
        else:
            found = LoopSignals(responses(self.system, self.law, p, w))
        M = transfer(found, self.blocks)
        scale = np.array([b.weight.at(w) for b in self.blocks for _ in b.columns])
        return np.asarray(M * scale.T[:, :, None])

    def stable(self) -> bool:
        """Whether the nominal loop is proven stable."""
        return is_nominal_stable(self.problem, self.box)

    def sizes(self, share: float) -> list[Size]:
        """The size of each block on cells, as a function: share times its weight."""
        T = self.law.sample_time

        def on(weight: Weight, cells: FloatArray, scale: int) -> Expanded:
            return weight.on(cells, scale, T).times(share)

        return [partial(on, b.weight) for b in self.blocks]

    def parts(self, reach: float, shares: Sequence[float], until: float) -> list[PolydiscPart]:
        """The groups' polynomials over box(reach), for blocks of these shares of their weights.

        Raises Unproven when they cannot be enclosed.
        """
        if self.system.approximate:
            raise Unproven(self.system.approximate)
        most = [share * b.weight.most for share, b in zip(shares, self.blocks, strict=True)]
        try:
            with work_limit(until):
                blocks = list(zip(self.blocks, self.entries, strict=True))
                return parts_of(self.with_blocks, blocks, self.box, reach, most)
        except WorkUp as error:
            raise Unproven(NO_COEFFICIENTS) from error

    def starts(self, t: float, chosen: FloatArray) -> list[FloatArray]:
        """The parameters in box(t) at relative places `chosen` (rows, -1 to 1)."""
        sides = self.box.near_sides(t)
        return [sides.mean(axis=1) + x * (sides[:, 1] - sides[:, 0]) / 2 for x in chosen]


@lru_cache(maxsize=64)  # searches of several gains begin at the same places; records compare by identity
def _signals_on_grid(system: UncertainSystem, law: Compensator, p: bytes, w: bytes) -> LoopSignals:
    return LoopSignals(responses(system, law, np.frombuffer(p), np.frombuffer(w)))


@lru_cache(maxsize=8)  # gains of several channels need the same families; records compare by identity
def _in_each_channel(system: UncertainSystem, law: Compensator, at: At) -> OfLoop:
    """The loop with a block 1 + Delta in each channel at the sensors or at the forces."""
    count = dict(zip(("sensors", "forces"), shape_of(system), strict=True))[at]
    one = weight_of(1.0, "probe")
    return OfLoop(
        loop_of(*probe(system, law, [Block("feedback", at, (i,), (i,), one) for i in range(count)]))
    )


def _scale_probe(
    system: UncertainSystem, law: Compensator, nominal: FloatArray, b: Block, problem: OfLoop
) -> Block:
    """A block with its unit scaled by a power of two to about the loop's own gain."""
    if b.kind in ("multiplicative", "feedback"):
        return b
    M = transfer(LoopSignals(responses(system, law, nominal, frequencies(problem, nominal))), [b])
    size = float(np.abs(M[np.isfinite(M)]).max(initial=0.0))
    return replace(b, unit=2.0 ** -min(max(round(1 + math.log2(size)), -500), 500)) if size > 0 else b


def question_of(
    caller: str, system: Any, compensator: Any, ranges: Any, over: Any
) -> tuple[Compensator, Box]:
    """The compensator as a record, and the box. Raises InputError as robust_margin does."""
    law = law_of(system, compensator, caller)
    none = {} if over is None else over
    box = box_of(system.names, system.nominal, system.limits, ranges, none, empty=True, caller=caller)
    box = within_branches(box, system)
    if not box.most > 0:
        raise InputError(caller, "over", f"intervals within which {box.ends}", "narrower ones")
    return law, box


def check_effort(caller: str, tolerance: Any, time: Any) -> None:
    """Raise InputError unless the tolerance lies between 0 and 1 and the time is positive or None."""
    positive(caller, "tolerance", tolerance, below=1.0)
    if time is not None:
        positive(caller, "time", time, endless=True)


def _size(asked: BlockLoop, place: GainPeak) -> float:
    """The smallest t whose box and blocks contain the parameters and blocks of a peak."""
    return max(float(asked.box.margin(place.p)), 1 / place.value if place.value > 0 else math.inf)


def _loss(asked: BlockLoop, until: float) -> GainPeak | None:
    """The peak at the smallest t for which a loss of stability was found; None within the limits of the parameters."""
    box, every = asked.box, patterns(len(asked.box.names))
    seen: list[GainPeak] = []

    def value(p: FloatArray, w: FloatArray) -> FloatArray:
        return mu_bound(asked.transfer(p, w), asked.blocks)[0]

    def peak(t: float, chosen: FloatArray) -> GainPeak:
        starts = [box.nominal, *asked.starts(t, chosen)]
        found = climb(value, asked.problem, box.near_sides(t), starts, until)
        seen.append(found)
        return found

    def nearest() -> GainPeak:
        return min(seen, key=lambda place: _size(asked, place))

    peak(0.0, every)
    if (box.down + box.up).any():
        high = min(_size(asked, nearest()), asked.box.limit)
        if (asked.problem.instability(np.array(asked.starts(high, every))) >= 0).any():
            with work_limit(until):
                t, w, p = first_loss(asked.problem, box, high)  # by the parameters alone
            if p is not None and w is not None:
                seen.append(GainPeak(1 / t, w, p))
                high = t
        top = peak(high, every)
        for _ in range(ROUNDS):
            if top.value * high < 1 or is_past(until):
                break
            _narrow(peak, high, _pattern(box, high, top.p), until)
            high = _size(asked, nearest())
            top = peak(high, every)
            if top.value * high < 1 + 1e-9:
                break
    best = nearest()
    return best if math.isfinite(_size(asked, best)) else None


def _narrow(
    peak: Callable[[float, FloatArray], GainPeak], high: float, chosen: FloatArray, until: float
) -> None:
    """Search the t with t |M| = 1 below `high`, where t |M| > 1, by secants in log t."""

    def excess(x: float) -> float:
        return math.log(max(peak(math.exp(x), chosen).value, 1e-300)) + x

    above = math.log(high)
    below = above - math.log(2)
    at_above, at_below = excess(above), excess(below)
    while at_below >= 0 and not is_past(until):
        above, at_above = below, at_below
        below -= math.log(2)
        at_below = excess(below)
    for _ in range(ROUNDS_OF_SECANT):
        if not at_below < 0 <= at_above or above - below < 1e-11 or is_past(until):
            return
        share = min(max(at_above / (at_above - at_below), 0.02), 0.98)
        x = above - share * (above - below)
        here = excess(x)
        if here < 0:
            below, at_below, at_above = x, here, at_above / 2
        else:
            above, at_above, at_below = x, here, at_below / 2
        if abs(here) < 1e-10:
            return


def _pattern(box: Box, t: float, p: FloatArray) -> FloatArray:
    """The relative place of p in box(t), -1 to 1, and the middle: two rows."""
    sides = box.near_sides(t)
    half = (sides[:, 1] - sides[:, 0]) / 2
    x = np.where(half > 0, (p - sides.mean(axis=1)) / np.where(half > 0, half, 1), 0)
    return np.array([np.clip(x, -1, 1), 0 * x])


def _prove_dynamic(
    asked: BlockLoop, upper: float, tolerance: float, until: float
) -> tuple[float | None, str]:
    """The largest t for which stability is proven, and the reason when there is none."""
    parts: list[PolydiscPart] = []
    reason = asked.system.approximate
    for step in DYNAMIC_STEPS if not reason else ():
        if is_past(until):
            break
        t = upper / (1 + step * tolerance)
        try:
            parts = parts or asked.parts(t, [t] * len(asked.blocks), until)
        except Unproven as error:
            reason = str(error)
            continue
        if is_zero_free(parts, t, asked.sizes(t), until)[0]:
            return (t, "") if asked.stable() else (None, "the nominal loop is not proven stable")
    return None, reason or "not settled"


Of = Literal["sensitivity", "complementary", "compliance", "effort"]

TOLERANCE = 3e-3  # relative distance between the proven bound and the largest gain found
STEPS = (1, 3, 10, 30, 100, 300, 1000)  # bounds that are tried, in multiples of the tolerance
ZERO_GAIN = 1e-12  # a gain below this counts as zero, and one of the bounds ZERO_GAIN_BOUNDS is proven
ZERO_GAIN_BOUNDS = (1e-12, 1e-9, 1e-6, 1e-3, 1.0)


@display
@dataclass(frozen=True, eq=False)
class Gain:
    """The largest gain of a closed loop over a box of parameters and all frequencies.

    lower : the gain that `witness` reaches
    upper : proven bound; None when nothing is proven, and `reason` says why
    frequency : rad/s, of the gain at the witness
    witness : parameters of the gain `lower`, SI
    cells : number of cells that were searched
    seconds : s, time of the search
    reason : why nothing, or less than asked for, is proven

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> box = {"k": 0.5}  # k from 0.5 to 1.5
    >>> found = malta.worst_case_gain(motor, [[-2]], box, of="compliance", channel=(0, 0))
    >>> f"{found.lower:.3f} at k = {found.witness['k']}"  # k / (s + 1 + 2 k)
    '0.375 at k = 1.5'
    """

    lower: float
    upper: float | None
    frequency: float
    witness: Mapping[str, float]
    cells: int
    seconds: float
    reason: str = ""

    @property
    def reached(self) -> Bound:
        """`lower` as it is shown."""
        return at_least(self.lower)

    @property
    def proven(self) -> Bound:
        """`upper` as it is shown."""
        return at_most(self.upper)

    def __str__(self) -> str:
        high = unproven(self.reason) if self.upper is None else f"proven below {self.proven.text()}"
        return f"{self.reached.text()} at {self.frequency:.4g} rad/s, {high}"

    @property
    def description(self) -> Description:
        """The reached and the proven bound, and the witness."""
        reached = ", ".join(f"{name} = {value:.4g}" for name, value in self.witness.items())
        return Description(
            f"Gain: {self}", (("reached at", reached), ("searched in", quantity(self.seconds, "s")))
        )


@on_one_thread
@answer_in_time(Gain(0.0, None, math.nan, {}, 0, 0.0, NOT_BEGUN.reason))
def worst_case_gain(
    system: UncertainSystem,
    compensator: Compensator | Any,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    of: Of = "sensitivity",
    at: At = "sensors",
    channel: Channels | tuple[Channels, Channels] | None = 0,
    dynamics: Dynamic | Sequence[Dynamic] = (),
    tolerance: float = TOLERANCE,
    time: float | None = None,
) -> Gain:
    """Prove the largest gain of a closed loop over all parameters of a box and all frequencies, as wcgain gives it.

    With L around the loop from the channel back to it, the other channels closed, and u = F y:

        sensitivity    S = 1 / (1 - L)       compliance  (1 - P F)^-1 P, from a force on the plant to a sensor
        complementary  T = L / (1 - L)       effort      F (1 - P F)^-1, from a sensor's noise to a command

    system : the uncertain system, from `malta.uncertain`
    compensator : u = F y (positive feedback): a Compensator, a control.StateSpace, or a gain matrix
    ranges : of the parameters, as in `malta.robust_margin`; the box is the modelled one, t = 1
    over : intervals beside the box, in SI
    of : "sensitivity", "complementary", "compliance" or "effort"; forces of a sampled loop are held for a sample
    at : "sensors" or "forces", of S and T
    channel : counted from 0; several of them as a tuple, all as None: the largest singular value; of compliance
        (sensors, forces), of effort (forces, sensors)
    dynamics : blocks of unmodelled dynamics, of their full size, beside the parameters
    tolerance : relative distance between the proven bound and the gain that was found
    time : s, longest search, which then returns the bounds found so far; None: as long as 120 units of work take

    Returns a Gain: a number for S and T, output units over input units for compliance and effort.

    Raises InputError as `malta.robust_margin` does, and for channels that the loop does not have.

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> found = malta.worst_case_gain(motor, [[-2.0]], {"k": 0.5}, of="complementary")
    >>> round(found.lower, 4), found.upper is not None  # T = 2 k / (s + 1 + 2 k)
    (0.75, True)
    """
    begun = clock.monotonic()
    law, box = question_of("worst_case_gain", system, compensator, ranges, over)
    last = _performance_block(system, of, at, channel)
    check_effort("worst_case_gain", tolerance, time)
    if not box.most > 1:
        raise InputError("worst_case_gain", "ranges", "a box that reaches a limit", "one within the limits")
    blocks = [*blocks_of(system, dynamics, "worst_case_gain"), last]
    asked = BlockLoop.of(system, law, box, blocks, "worst_case_gain")
    if asked.unstable():
        reason = "the nominal loop is unstable"
        return Gain(math.inf, None, math.nan, {}, 0, clock.monotonic() - begun, reason)

    def ask(until: float, _: bool) -> tuple[GainPeak, float | None, int, str]:
        found = _largest(asked, SEARCH * until)
        return found, *_prove(asked, found.value, tolerance, until)

    settled = ("", system.approximate)
    with np.errstate(all="ignore"):  # a cell with infinite bounds excludes nothing
        budget = Budget(time=time)
        ((lower, w, p), upper, cells, reason), ended = in_rounds(
            budget, ask, lambda x: 0.0 if x[-1] not in settled else math.inf
        )
    named, took = dict(zip(box.names, p.tolist(), strict=True)), clock.monotonic() - begun
    reason = system.reason(reason if reason in settled else ended.explain(reason))
    return Gain(lower, upper, w, named, cells, took, reason)


def _performance_block(system: UncertainSystem, of: Of, at: At, channel: Any) -> Block:
    """The fictitious block of a gain. Raises InputError for unknown gains and channels."""
    if of not in ("sensitivity", "complementary", "compliance", "effort") or at not in ("sensors", "forces"):
        expected = "sensitivity, complementary, compliance or effort; sensors or forces"
        raise InputError("worst_case_gain", "of, at", f"{of}, {at}", expected)
    counts = dict(zip(("sensors", "forces"), shape_of(system), strict=True))
    one = weight_of(1.0, "worst_case_gain")
    if of in ("sensitivity", "complementary"):
        picked = tuple(range(counts[at])) if channel is None else channel
        channels = channels_of(picked, counts[at], at, "worst_case_gain")
        return Block("feedback" if of == "sensitivity" else "multiplicative", at, channels, channels, one)
    names = ("sensors", "forces") if of == "compliance" else ("forces", "sensors")
    both = tuple(tuple(range(counts[name])) for name in names) if channel is None else channel
    if not isinstance(both, tuple) or len(both) != 2:
        raise InputError("worst_case_gain", "channel", repr(channel), f"({names[0]}, {names[1]}) of {of}")
    read, driven = (
        channels_of(c, counts[name], name, "worst_case_gain") for c, name in zip(both, names, strict=True)
    )
    return Block(of, "sensors", driven, read, one)  # type: ignore[arg-type]


def _largest(asked: BlockLoop, until: float) -> GainPeak:
    """The largest gain that a search finds until the work is up; infinite at an unstable plant of the box."""

    def value(p: FloatArray, w: FloatArray) -> FloatArray:
        return performance(asked.transfer(p, w), asked.blocks)

    starts = asked.starts(1.0, patterns(len(asked.box.names)))
    worst = asked.problem.instability(np.array(starts))
    if worst.max() >= 0:
        p = starts[int(worst.argmax())]
        return GainPeak(math.inf, asked.problem.critical_frequency(p), p)
    return climb(value, asked.problem, asked.box.near_sides(1.0), starts, until)


def _prove(asked: BlockLoop, lower: float, tolerance: float, until: float) -> tuple[float | None, int, str]:
    """The smallest bound that is proven, the number of cells, and the reason when nothing is proven."""
    if not math.isfinite(lower):
        return None, 0, "the box holds an unstable loop"
    try:
        parts = asked.parts(1.0, [*[1.0] * (len(asked.blocks) - 1), 1 / max(lower, 1e-300)], until)
    except Unproven as error:
        return None, 0, str(error)
    count, last = 0, len(asked.blocks) - 1
    for bound in (
        [lower * (1 + step * tolerance) for step in STEPS] if lower > ZERO_GAIN else ZERO_GAIN_BOUNDS
    ):
        sizes = [*asked.sizes(1.0)[:last], asked.sizes(1 / bound)[last]]
        found, cells = is_zero_free(parts, 1 + 1e-9, sizes, until)
        count += cells
        if found:
            return (
                (bound, count, "")
                if asked.stable()
                else (None, count, "the nominal loop is not proven stable")
            )
        if is_past(until):
            break
    return None, count, "not settled: the box may hold an unstable loop"
