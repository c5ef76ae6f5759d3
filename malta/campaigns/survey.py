"""Run a campaign of any size: blocks are simulated, stored, added to the summary, and forgotten."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from malta.campaigns.result import gather
from malta.campaigns.run import Session, campaign_folder, run_blocks
from malta.campaigns.summary import UNBOUNDED, Bounds, Summary, join, summary_of

if TYPE_CHECKING:
    from malta.campaigns.block import Block
    from malta.campaigns.plan import Plan
    from malta.simulation.experiments import Progress


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
    >>> plan = malta.Plan(controller, "hold", {"m": 0.1}, samples=16, options=short)
    >>> rate = malta.summarize(plan, workers=1).rate
    >>> f"{rate.passed} of {rate.runs}; with 95 % confidence above {rate.low:.2f}"
    '16 of 16; with 95 % confidence above 0.79'
    """
    session = Session(workers, cluster, block, progress)
    with campaign_folder(plan, folder, session) as (place, size):
        found = Sum(plan, size, bounds)
        ending = run_blocks(plan, place, size, session, found)
    return replace(found.state[0], **ending._asdict(), folder=place)
