"""The question of a margin and what is known of its answer, which every route of a proof reads and adds to."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from malta.proof.exclusion.witness import Zero
from malta.work import is_past, work_done

if TYPE_CHECKING:
    from malta.proof.box import Box
    from malta.proof.exclusion import BoxPart, CellSearch
    from malta.proof.exclusion.hurwitz import Signs
    from malta.proof.margin import Progress
    from malta.proof.multipliers.structured import Structured
    from malta.proof.problem import Problem

    Searches = list[tuple[BoxPart, CellSearch]]

DEAR_WORK = 3.0  # work of families beyond which their boxes grow in small steps
# of the work for families, by the number of parameters, the last for MIN_MANY_PARAMETERS
SHARES = (0.6, 0.6, 0.6, 0.6, 0.4, 0.3)
PATIENT_SHARE, PATIENT_DEAR_SHARE = 0.8, 0.1  # of the work, for families of a patient search
HOLD_SHARE = 0.12  # of many parameters under a hold, where each family takes long
MIN_MANY_PARAMETERS = 5  # parameters from which on multipliers come before many cells
MIN_MANY_CHEAP_PARAMETERS = 11  # whose cells are cheap


@dataclass(eq=False)
class Standing:
    """What is known of a margin while it is searched: bounds, work, the cells that are left. It changes in place."""

    progress: Progress | None
    lower: float = 0.0
    upper: float = math.inf
    work: float = 0.0
    searches: Searches = field(default_factory=list)

    def report(self, lower: float, upper: float) -> None:
        self.lower, self.upper, self.work = max(self.lower, lower), min(self.upper, upper), work_done()
        if self.progress is not None:
            self.progress(self.lower, self.upper)

    def where(self, problem: Problem) -> str:
        """The frequency of the cell that resists, in words."""
        if not self.searches:
            return ""
        worst = min((s for _, s in self.searches), key=lambda s: s.lower)
        cell = worst.hardest() or worst.first()
        if cell is None:
            return ""
        x = Zero(0.0, cell.branch, sum(cell.interval) / 2, np.zeros(0)).frequency(worst.family)
        return f", near {problem.physical(x):.6g} rad/s"


@dataclass(frozen=True, eq=False)
class Question:
    """The margin that is asked for, and what its search may take.

    fixed : whether the tolerance was asked for; end : of the work of the question
    patient : whether all of the work is used, where no earlier round settled the question
    standing : what is known so far, for whoever stops the search
    """

    problem: Problem
    box: Box
    tolerance: float
    fixed: bool
    end: float
    most_cells: int
    patient: bool
    standing: Standing

    @property
    def _count(self) -> int:
        """The number of parameters whose ranges grow."""
        return int((self.box.down + self.box.up > 0).sum())

    @property
    def is_many(self) -> bool:
        """Whether the parameters are so many that multipliers come before many cells."""
        return self._count >= (
            MIN_MANY_CHEAP_PARAMETERS if self.problem.traits.is_cheap else MIN_MANY_PARAMETERS
        )

    @property
    def share(self) -> float:
        """The share of the work that families may take where there are multipliers beside them."""
        if self.patient:
            return PATIENT_SHARE
        is_dear = self.is_many and self.problem.traits.is_held
        return HOLD_SHARE if is_dear else SHARES[min(self._count, MIN_MANY_PARAMETERS)]

    @property
    def dear(self) -> float:
        """Work of families beyond which their boxes grow in small steps."""
        return max(DEAR_WORK, PATIENT_DEAR_SHARE * self.end) if self.patient else DEAR_WORK

    def is_late(self) -> bool:
        return is_past(self.end)


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known of a margin so far.

    tolerance : as asked for, or finer; stands : the proven bound; upper, zero : the nearest witness
    structured, signs : proofs without cells of frequency, by multipliers and by Hurwitz's determinant
    """

    tolerance: float
    structured: Structured | None
    signs: Signs | None = None
    stands: float = 0.0
    upper: float = math.inf
    zero: tuple[Zero, BoxPart] | None = None
    reasons: tuple[str, ...] = ()

    def because(self, reason: str) -> Findings:
        return replace(self, reasons=(*self.reasons, reason))

    def nearer(self, part: BoxPart, zero: Zero | None) -> Findings:
        """The zero is kept when it is nearer than the nearest so far."""
        if zero is None or not zero.t < self.upper:
            return self
        return replace(self, upper=zero.t, zero=(zero, part))

    def target(self, reach: float) -> float:
        return min(reach, self.upper * (1 - self.tolerance))

    @property
    def beside(self) -> float:
        """The bound that is proven without cells of frequency."""
        return max((proof.lower for proof in (self.structured, self.signs) if proof is not None), default=0.0)

    def is_near(self, lower: float, q: Question) -> bool:
        """Whether a bound is as close to the witness as was asked for."""
        return lower >= self.upper * (1 - q.tolerance)

    def is_settled(self, q: Question) -> bool:
        return self.beside >= min(self.upper, q.box.limit) * (1 - q.tolerance)

    def is_covered(self, q: Question, reach: float) -> bool:
        """Whether as much is proven beside the cells as those of box(reach) can prove."""
        return self.is_settled(q) or self.beside >= self.target(reach)

    def report(self, q: Question, t: float) -> Findings:
        """box(t) is proven: the caller is told of it."""
        stands = max(self.stands, t)
        q.standing.report(stands, self.upper)
        return replace(self, stands=stands)
