"""The result of a campaign: a row of figures for each run, and the share of the runs that were completed."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.stats import binomtest

from malta.campaigns.block import Block
from malta.campaigns.plan import Plan, draw_machines
from malta.campaigns.store import figure_shapes
from malta.model.plant import readonly
from malta.simulation.digest import Batch, verdicts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray


@dataclass(frozen=True, eq=False)
class Campaign:
    """What a campaign found: a row for each run that was flown. SI."""

    plan: Plan
    index: NDArray[np.int64]  # of each run
    names: tuple[str, ...]  # of what was varied: parameters, then errors of the sensors
    values: FloatArray  # runs x names, SI
    batch: Batch
    engines: tuple[str, ...]  # what flew them: "compiled" or "virtual machine"
    interrupted: bool = False  # by Ctrl-C: the runs are those of the blocks that were done
    damaged: tuple[Path, ...] = ()  # blocks that could not be read, and were flown again
    folder: Path | None = None

    @property
    def completed(self) -> NDArray[np.bool_]:
        """True where the run went to its end."""
        return np.asarray(self.batch.completed == 1)

    @property
    def ends(self) -> dict[str, int]:
        """How often runs ended in which way, by the names of simulate.Verdict."""
        counts = np.bincount(self.batch.verdict.astype(int), minlength=len(verdicts(self.plan.plant)))
        return {name: int(n) for name, n in zip(verdicts(self.plan.plant), counts, strict=True) if n}

    @property
    def rate(self) -> Rate:
        """Share of the runs that were completed."""
        return rate(int(self.completed.sum()), len(self.index))


def gather(
    plan: Plan,
    done: Mapping[int, Block],
    parts: Mapping[int, int],
    place: Path | None,
    damaged: tuple[Path, ...],
    interrupted: bool,
) -> Campaign:
    order = sorted(done)
    blocks = [done[first] for first in order]
    index = np.concatenate([np.empty(0, np.int64), *(np.arange(k, k + parts[k]) for k in order)])
    index.flags.writeable = False
    names = draw_machines(plan).names
    return Campaign(
        plan,
        index,
        names,
        readonly(np.concatenate([b.values for b in blocks]) if blocks else np.empty((0, len(names)))),
        _join(plan, [b.batch for b in blocks]),
        tuple(sorted({b.engine for b in blocks})),
        interrupted,
        damaged,
        place,
    )


def _join(plan: Plan, batches: list[Batch]) -> Batch:
    columns = {
        name: [getattr(batch, name) for batch in batches] or [np.empty((0, *shape))]
        for name, shape in figure_shapes(plan).items()
    }
    return Batch(**{name: np.concatenate(column) for name, column in columns.items()})


CONFIDENCE = 0.95  # of the interval about a share


class Rate(NamedTuple):
    """A share of runs with its two-sided interval (Clopper-Pearson) at CONFIDENCE."""

    passed: int
    runs: int
    share: float  # NaN of no runs
    low: float
    high: float


def rate(count: int, runs: int) -> Rate:
    """A share with the interval that holds the true one at least CONFIDENCE of the time."""
    if not runs:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low, high = binomtest(count, runs).proportion_ci(CONFIDENCE, method="exact")
    return Rate(count, runs, count / runs, float(low), float(high))
