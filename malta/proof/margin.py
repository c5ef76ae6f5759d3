"""The result of a proof: a margin with its bounds, its witness and its certificate."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from malta.bound import Bound, at_least, at_most
from malta.display import Description, display, quantity
from malta.work import MORE_WORK, NO_TIME

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.proof.multipliers.structured import MultiplierProof

Ranges = Mapping[str, "float | tuple[float, float] | list[float]"]
Progress = Callable[[float, float], None]  # called with the lower and upper bound so far


@dataclass(frozen=True, eq=False)
class Certificate:
    """The proof of the lower bound for one group of states on one part of the box: zero is excluded on each cell."""

    cells: int  # number of cells that were searched
    frequencies: tuple[float, float]  # rad/s, covered without a gap
    intervals: FloatArray  # of each cell: branch (0: of x, 1: of 1 / x), from, to; s = j x 2^scale
    boxes: FloatArray  # of each cell: ends of the parameters, as shares of the part of the box
    directions: FloatArray  # angle of c, rad: Re(conj(c) f) > 0 on the cell
    sides: FloatArray  # the part of the box: parameters x 2
    inverted: tuple[bool, ...]  # parameters whose shares are of 1 / p
    scale: int
    multipliers: MultiplierProof | None = (
        None  # what a proof by multipliers is, without cells of the kind above
    )


@display
@dataclass(frozen=True, eq=False)
class Margin:
    """A robust stability margin in multiples of the modelled box of parameters.

    lower : proven: no parameters within `lower` times the box make the loop unstable; None when nothing is proven, and
        `reason` says why
    upper : reached by `witness`; infinite when no admissible parameters make the loop unstable
    frequency : rad/s, of the loss of stability at the witness; None without one
    witness : parameters with which the loop is at its limit of stability, SI; None without one
    moved : the witness minus the nominal values, SI
    sensitivity : share of each parameter in the margin; the shares add up to 1
    certificate : cells and directions of the proof; or multipliers, which `malta.proof.multipliers.checked` checks
        again. `malta.proof.write_certificate` writes a proof as a file
    seconds : s, time of the search
    work : units of work that the search took, which do not depend on the computer
    reason : why nothing, or less than asked for, is proven
    idle : parameters of the box on which the loop does not depend: nothing is said of them
    searched : how far no unstable parameters were found, where `upper` is infinite

    >>> import malta
    >>> def cubic(k):  # stable from -1 to 8
    ...     return [1, 3, 3, 1 + k]
    >>> found = malta.proof.margin_of_polynomial(cubic, {"k": 0.5}, {"k": 1})
    >>> f"proven {found.lower:.2f}, lost at k = {found.witness['k']:.2f}"
    'proven 4.00, lost at k = -1.00'
    """

    lower: float | None
    upper: float
    frequency: float | None
    witness: Mapping[str, float] | None
    moved: Mapping[str, float]
    sensitivity: Mapping[str, float]
    certificate: tuple[Certificate, ...] = field(repr=False)
    seconds: float
    reason: str = ""
    searched: str = ""
    work: float = 0.0
    idle: tuple[str, ...] = ()

    @property
    def proven(self) -> Bound:
        """`lower` as it is shown."""
        return at_least(self.lower)

    @property
    def lost(self) -> Bound:
        """`upper` as it is shown."""
        return at_most(self.upper)

    @property
    def time_up(self) -> bool:
        """Whether the search ended with its work or its time, before anything was proven: more may prove more."""
        return self.lower is None and self.reason.endswith(MORE_WORK)

    @property
    def exhausted(self) -> bool:
        """Whether no loss of stability was found within the limits of the parameters (a mass above zero)."""
        return math.isinf(self.upper)

    @property
    def cells(self) -> int:
        """How many cells the proof has."""
        return sum(proof.cells for proof in self.certificate)

    def __str__(self) -> str:
        low = f"proven {self.proven.percent()}" if self.lower else unproven(self.reason)
        rest = f"; does not depend on {' '.join(self.idle)}" if self.idle and self.lower else ""
        if self.exhausted:
            return f"{low}; no unstable machine found {self.searched}".rstrip() + rest
        where = "" if self.frequency is None else f" at {self.frequency:.4g} rad/s"
        return f"{low}, lost at {self.lost.percent()}{where}{rest}"

    @property
    def description(self) -> Description:
        """The proven and the reached bound, and the witness."""
        rows = [("searched in", quantity(self.seconds, "s"))]
        if self.witness is not None:
            rows.insert(
                0, ("lost at", ", ".join(f"{name} = {value:.4g}" for name, value in self.witness.items()))
            )
        if self.sensitivity:
            rows.insert(
                1, ("shares", ", ".join(f"{name} {100 * x:.0f} %" for name, x in self.sensitivity.items()))
            )
        return Description(f"Margin: {self}", tuple(rows))


# Begins the reason of a loop that is stable, and of which nothing is said.
IDLE_TEXT = "the loop does not depend on"


def unproven(reason: str) -> str:
    """The words for a bound that is not proven."""
    return f"nothing proven ({reason})" if reason else "nothing proven"


NOT_PROVEN = Margin(None, math.inf, None, None, {}, {}, (), 0.0, "not asked")
NOT_WRITTEN_TEXT = f"the clock ended the search before the model was written out, more time {MORE_WORK}"
NOT_WRITTEN = replace(NOT_PROVEN, reason=NOT_WRITTEN_TEXT)
NOT_BEGUN = replace(NOT_PROVEN, reason=f"{NO_TIME}, more {MORE_WORK}")
