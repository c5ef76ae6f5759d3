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
from malta.campaigns.plan import Plan, varied_names
from malta.campaigns.store import figure_shapes
from malta.display import Description, display
from malta.model.plant import readonly
from malta.simulation.digest import Batch, verdicts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

CONFIDENCE = 0.95  # of the interval about a share


@display
@dataclass(frozen=True, eq=False)
class Campaign:
    """The result of a campaign: a row of figures for each run that was simulated. SI.

    plan : the plan of the campaign
    index : number of each run in the plan
    names : of the values that vary: parameters, then errors of the sensors
    values : the values that vary, runs x names, SI
    batch : figures of the runs, see `malta.Batch`
    engines : which simulated them: "compiled" or "virtual machine"
    interrupted : whether Ctrl-C ended the campaign; it has the runs of the blocks before
    damaged : files of blocks that could not be read; their runs were simulated again
    folder : where the blocks are stored; None: nowhere

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> short = {"duration": 0.01}  # s
    >>> plan = malta.Plan(controller, "hold", {"m": 0.1}, samples=5, options=short)
    >>> found = malta.campaign(plan, workers=1)
    >>> found.names, found.values.shape, found.ends
    (('m',), (5, 1), {'completed': 5})
    """

    plan: Plan
    index: NDArray[np.int64]
    names: tuple[str, ...]
    values: FloatArray
    batch: Batch
    engines: tuple[str, ...]
    interrupted: bool = False
    damaged: tuple[Path, ...] = ()
    folder: Path | None = None

    @property
    def completed(self) -> NDArray[np.bool_]:
        """True for each run that reached the end of the scenario."""
        return np.asarray(self.batch.completed == 1)

    @property
    def ends(self) -> dict[str, int]:
        """Number of runs by the name of their verdict."""
        counts = np.bincount(self.batch.verdict.astype(int), minlength=len(verdicts(self.plan.plant)))
        return {name: int(n) for name, n in zip(verdicts(self.plan.plant), counts, strict=True) if n}

    @property
    def rate(self) -> Rate:
        """Share of the runs that were completed."""
        return rate(int(self.completed.sum()), len(self.index))

    @property
    def description(self) -> Description:
        """Its plan, its ends and its yield."""
        ends = ", ".join(f"{name} {count}" for name, count in self.ends.items())
        rows = (
            ("varied", " ".join(self.names) or "nothing"),
            ("ends", ends or "none"),
            ("completed", str(self.rate)),
            ("engines", " ".join(self.engines)),
        )
        title = f"Campaign of {self.plan.controller.name!r} in {self.plan.scenario!r}"
        return Description(f"{title}: {len(self.index)} of {self.plan.samples} machines", rows)


def gather(plan: Plan, done: Mapping[int, Block]) -> Campaign:
    """The campaign of the blocks that are done, by their first runs, in order of the runs."""
    order = sorted(done)
    blocks = [done[first] for first in order]
    index = np.concatenate(
        [
            np.empty(0, np.int64),
            *(np.arange(k, k + len(b.values)) for k, b in zip(order, blocks, strict=True)),
        ]
    )
    index.flags.writeable = False
    names = varied_names(plan)
    return Campaign(
        plan,
        index,
        names,
        readonly(np.concatenate([b.values for b in blocks]) if blocks else np.empty((0, len(names)))),
        _join(plan, [b.batch for b in blocks]),
        tuple(sorted({b.engine for b in blocks})),
    )


def _join(plan: Plan, batches: list[Batch]) -> Batch:
    """The runs of several batches in one."""
    columns = {
        name: [getattr(batch, name) for batch in batches] or [np.empty((0, *shape))]
        for name, shape in figure_shapes(plan).items()
    }
    return Batch(**{name: np.concatenate(column) for name, column in columns.items()})


class Rate(NamedTuple):
    """A share of runs with its two-sided interval (Clopper-Pearson) at CONFIDENCE."""

    passed: int
    runs: int
    share: float  # passed / runs; NaN without runs
    low: float
    high: float

    def __str__(self) -> str:
        share, low, high = (f"{100 * x:.4g}" for x in (self.share, self.low, self.high))
        return f"{self.passed} of {self.runs}: {share} %, {100 * CONFIDENCE:g} % interval {low} .. {high} %"


def rate(count: int, runs: int) -> Rate:
    """The rate count / runs with its interval, which contains the true rate with a probability of CONFIDENCE or more.

    >>> rate(99, 100).low
    0.9455...
    """
    if not runs:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low, high = binomtest(count, runs).proportion_ci(CONFIDENCE, method="exact")
    return Rate(count, runs, count / runs, float(low), float(high))
