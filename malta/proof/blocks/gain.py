"""The largest gain of a loop anywhere in a box of parameters: a peak of sensitivity that no plant exceeds.

A gain stays below G exactly when the loop is robustly stable against one more complex block, of size 1 / G, from the
gain's output to its input. This fictitious block is the last one of polydisc.py.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from malta.display import Description, display, quantity
from malta.errors import InputError
from malta.proof.blocks.blocks import (
    At,
    Block,
    Channels,
    Dynamic,
    blocks_of,
    channels_of,
    shape_of,
)
from malta.proof.blocks.dynamic import (
    SEARCH,
    Blocks,
    check_effort,
    question_of,
)
from malta.proof.blocks.peaks import Peak, climb, patterns
from malta.proof.blocks.polydisc import is_zero_free
from malta.proof.blocks.transfer import performance
from malta.proof.blocks.weight import weight_of
from malta.proof.margin import unproven
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.robust import deadline
from malta.proof.uncertain import Compensator, UncertainSystem
from malta.threads import on_one_thread

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.proof.margin import Ranges

Of = Literal["sensitivity", "complementary", "compliance", "effort"]

TOLERANCE = 3e-3  # relative distance between the proven bound and the largest gain found
STEPS = (1, 3, 10, 30, 100, 300, 1000)  # bounds that are tried, in multiples of the tolerance
LEAST = 1e-12  # a gain below this counts as zero, and one of the bounds NOTHING is proven
NOTHING = (1e-12, 1e-9, 1e-6, 1e-3, 1.0)


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

    def __str__(self) -> str:
        high = unproven(self.reason) if self.upper is None else f"proven below {self.upper:.4g}"
        return f"{self.lower:.4g} at {self.frequency:.4g} rad/s, {high}"

    @property
    def description(self) -> Description:
        """The reached and the proven bound, and the witness."""
        reached = ", ".join(f"{name} = {value:.4g}" for name, value in self.witness.items())
        return Description(
            f"Gain: {self}", (("reached at", reached), ("searched in", quantity(self.seconds, "s")))
        )


@on_one_thread
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
    time : s, longest search, which then returns the bounds found so far; None: 120

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
    asked = Blocks.of(system, law, box, blocks, "worst_case_gain")
    if asked.unstable():
        reason = "the nominal loop is unstable"
        return Gain(math.inf, None, math.nan, {}, 0, clock.monotonic() - begun, reason)
    until = deadline(begun, time)

    with np.errstate(all="ignore"):  # a cell with infinite bounds excludes nothing
        lower, w, p = _largest(asked, begun + SEARCH * (until - begun))
        upper, cells, reason = _prove(asked, lower, tolerance, until)
    named = dict(zip(box.names, p.tolist(), strict=True))
    return Gain(lower, upper, w, named, cells, clock.monotonic() - begun, reason)


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


def _largest(asked: Blocks, until: float) -> Peak:
    """The largest gain that a search until a time finds; infinite at an unstable plant of the box."""

    def value(p: FloatArray, w: FloatArray) -> FloatArray:
        return performance(asked.transfer(p, w), asked.blocks)

    starts = asked.starts(1.0, patterns(len(asked.box.names)))
    worst = asked.problem.instability(np.array(starts))
    if worst.max() >= 0:
        p = starts[int(worst.argmax())]
        return Peak(math.inf, asked.problem.critical_frequency(p), p)
    return climb(value, asked.problem, asked.box.near_sides(1.0), starts, until)


def _prove(asked: Blocks, lower: float, tolerance: float, until: float) -> tuple[float | None, int, str]:
    """The smallest bound that is proven, the number of cells, and the reason when nothing is proven."""
    if not math.isfinite(lower):
        return None, 0, "the box holds an unstable loop"
    try:
        parts = asked.parts(1.0, [*[1.0] * (len(asked.blocks) - 1), 1 / max(lower, 1e-300)], until)
    except Unproven as error:
        return None, 0, str(error)
    count, last = 0, len(asked.blocks) - 1
    for bound in [lower * (1 + step * tolerance) for step in STEPS] if lower > LEAST else NOTHING:
        sizes = [*asked.sizes(1.0)[:last], asked.sizes(1 / bound)[last]]
        found, cells = is_zero_free(parts, 1 + 1e-9, sizes, until)
        count += cells
        if found:
            return (
                (bound, count, "")
                if asked.stable()
                else (None, count, "the nominal loop is not proven stable")
            )
        if clock.monotonic() > until:
            break
    return None, count, "not settled: the box may hold an unstable loop"
