"""Run a campaign of any size: blocks are simulated, stored, added to the summary, and forgotten."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from malta.campaigns.result import gather
from malta.campaigns.run import Session, campaign_folder, run_blocks
from malta.campaigns.store import MANIFEST, Block, read_blocks, read_manifest, read_plan
from malta.campaigns.summary import UNBOUNDED, Bounds, Summary, join, summary_of

if TYPE_CHECKING:
    from malta.campaigns.plan import Plan
    from malta.simulation.experiments import Progress
    from malta.synthesis.controller import Controller


class Sum:
    """The summary of the blocks so far, and which ones they are."""

    def __init__(self, plan: Plan, size: int, bounds: Bounds) -> None:
        self.size = size  # runs in a block
        # One pair, so that Ctrl-C between two statements leaves no block that is counted and not noted.
        self.state = summary_of(gather(plan, {}), bounds), 0  # a bit for each block

    def __setitem__(self, first: int, block: Block) -> None:
        summary, noted = self.state
        own = summary_of(gather(summary.plan, {first: block}), summary.bounds)
        self.state = join(summary, own), noted | 1 << first // self.size

    def __contains__(self, first: object) -> bool:
        return isinstance(first, int) and bool(self.state[1] >> first // self.size & 1)


def summarize(
    plan: Plan,
    folder: str | Path | None = None,
    bounds: Bounds = UNBOUNDED,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    block: int | None = None,
    progress: Progress | None = None,
) -> Summary:
    """Simulate all runs of a plan, or those that its folder does not have yet, and return what they have in common.

    As `malta.campaign`, but in memory that does not grow with the runs: a million of them fit.

    plan : the plan of the campaign
    folder : stores every block as soon as it is done, and the manifest; None: nothing is written
    bounds : figures of a paper and the design whose bounds the summary counts
    workers : threads on this machine; None: one for each core
    cluster : address of a Dask scheduler, as tcp://host:8786, whose workers simulate the blocks
    block : runs in a block, a multiple of 8; a folder that has a campaign keeps its own number
    progress : called now and then with the share of the runs that is done, 0 to 1

    Returns a Summary. After Ctrl-C it is of the blocks that are done, and says `interrupted`.

    Raises InputError as `malta.campaign`, for any number of runs.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> short = {"duration": 0.01}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "hold", {"m": 0.1}, samples=16, options=short
    ... )
    >>> rate = malta.campaigns.summarize(plan, workers=1).rate
    >>> f"{rate.passed} of {rate.runs}; with 95 % confidence above {rate.low:.2f}"
    '16 of 16; with 95 % confidence above 0.79'
    """
    session = Session(workers, cluster, block, progress)
    with campaign_folder(plan, folder, session) as (place, size):
        found = Sum(plan, size, bounds)
        ending = run_blocks(plan, place, size, session, found)
    return replace(found.state[0], **ending._asdict(), folder=place)


# The status of a campaign: which of its blocks a folder has, also while another process adds some.


RECENT = 50  # blocks whose times tell the pace
QUIET = 30.0  # s without a new block, after which nobody seems to simulate any
PATIENCE = 5.0  # paces without a new block, likewise


@dataclass(frozen=True)
class Status:
    """How far a campaign is."""

    blocks: int  # sound ones in the folder
    of: int
    size: int  # runs in a block
    stored: int  # bytes of the blocks
    pace: float | None  # s from one block to the next, the median of the last ones; None for fewer than two
    age: float | None  # s since the last block; None without one
    summary: Summary  # of the blocks that are done; `damaged` lists the files that are not sound

    @property
    def running(self) -> bool:
        """Whether blocks are missing and the last one is so young that a process seems to simulate the next."""
        return (
            self.blocks < self.of
            and self.age is not None
            and self.age < max(QUIET, PATIENCE * (self.pace or 0))
        )

    @property
    def left(self) -> float | None:
        """Seconds that the rest takes at the pace of the last blocks; None where nothing runs or little is done."""
        return self.pace * (self.of - self.blocks) if self.running and self.pace is not None else None


def status(
    folder: str | Path,
    controller: Controller,
    bounds: Bounds = UNBOUNDED,
    progress: Progress | None = None,
) -> Status:
    """The status of the campaign in a folder. Every block is read and its seal checked; nothing is written.

    Raises InputError for a folder without a campaign, and for one of another controller.

        found = status("build/campaigns/mass", malta.gains.read("design/gains/calibrated.json"))
        print(found.blocks, found.of, found.summary.rate)
    """
    place = Path(folder)
    _, size = read_manifest(place / MANIFEST)
    plan = read_plan(place, controller)
    parts = {first: min(size, plan.samples - first) for first in range(0, plan.samples, size)}
    total = Sum(plan, size, bounds)
    damaged, times, stored = [], [], 0
    for first, path, block in read_blocks(place, plan, parts):
        if block is None:
            damaged.append(path)
            continue
        total[first] = block
        file = path.stat()
        times.append(file.st_mtime)
        stored += file.st_size
        if progress is not None:
            progress((first + parts[first]) / plan.samples)
    times.sort()
    gaps = np.diff(times[-RECENT - 1 :])
    return Status(
        len(times),
        len(parts),
        size,
        stored,
        float(np.median(gaps)) if len(gaps) else None,
        max(time.time() - times[-1], 0.0) if times else None,
        replace(total.state[0], damaged=tuple(damaged), folder=place),
    )
