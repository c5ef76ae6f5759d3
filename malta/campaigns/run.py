"""Run a campaign, on this machine or on a cluster, and simulate single runs of it again.

    Plan -> fly() block by block -> Campaign, which has the figures of every run
                                 -> Summary, which has those of no run

Every block is stored as soon as it is done. A campaign that was interrupted goes on with the blocks that are missing,
and a campaign that is complete is read from its folder.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from malta.campaigns.plan import PRECISIONS, Machines, Plan, draw_machines, planned_run
from malta.campaigns.result import Campaign, gather
from malta.campaigns.store import (
    MANIFEST,
    RunBlock,
    block_name,
    encode_block,
    fly,
    forget_folder,
    open_folder,
    read_blocks,
    read_manifest,
    read_plan,
)
from malta.campaigns.summary import NO_BOUNDS, RunLimits, Summary, join, summary_of
from malta.errors import InputError
from malta.files import file_exists
from malta.firmware.flight import engine_of_c
from malta.interrupts import watch_interrupts
from malta.simulation.engine import compiled
from malta.simulation.engine.batch import record_run, replay_run
from malta.simulation.engine.engines import EngineChoice
from malta.simulation.experiments import Experiment, Progress
from malta.simulation.experiments.catalogue import main_job, settling_option, single_run
from malta.simulation.simulate import EngineOf
from malta.synthesis.controller import Controller
from malta.synthesis.spec import Spec
from malta.work import is_stopped
from malta.writing import replace_files

BLOCK = 1024  # runs in a block: a fraction of a second of work
LARGE_BLOCK = 16_384  # of a large campaign: seconds of work, 5 MB in a file, some 50 MB while it is simulated
SLOW_BLOCK = 32  # without a C compiler
FILES = 256  # blocks that a campaign has before they grow
IN_MEMORY = 10_000_000  # runs whose figures `campaign` returns: 3 GB


class RunExecution(NamedTuple):
    """How the runs that are missing are simulated."""

    workers: int | None = None  # threads on this machine; None: one for each core
    cluster: str | None = None  # address of a Dask scheduler, as tcp://host:8786
    block: int | None = None  # runs in a block; None: see `block_size`
    progress: Progress | None = None  # called now and then with the share of the runs that is done


class Ending(NamedTuple):
    """How a session ended."""

    interrupted: bool  # by Ctrl-C
    damaged: tuple[Path, ...]  # files of blocks that could not be read; their runs were simulated again


class BlockSink(Protocol):
    """What takes the blocks of a campaign, by their first runs, and knows which ones it has: a dict, or a sum."""

    def __setitem__(self, first: int, block: RunBlock, /) -> None: ...

    def __contains__(self, first: object, /) -> bool: ...


def campaign(
    plan: Plan,
    folder: str | Path | None = None,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    block: int | None = None,
    progress: Progress | None = None,
) -> Campaign:
    """Simulate all runs of a plan, or those that its folder does not have yet, and return the figures of each run.

    plan : the plan of the campaign
    folder : stores every block as soon as it is done, and the manifest; None: nothing is written
    workers : threads on this machine; None: one for each core
    cluster : address of a Dask scheduler, as tcp://host:8786, whose workers simulate the blocks
    block : runs in a block, a multiple of 8; a folder that has a campaign keeps its own number
    progress : called now and then with the share of the runs that is done, 0 to 1

    Returns a Campaign. After Ctrl-C it has the blocks that are done, and says `interrupted`.

    Raises InputError for more than IN_MEMORY runs, which `malta.campaigns.summarize` takes, for a folder that has
    another campaign or cannot be written to, and for a scheduler that does not answer. Completed blocks stay in the
    folder.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> short = {"duration": 0.01}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "hold", {"m": 0.1}, samples=5, options=short
    ... )
    >>> found = malta.campaign(plan, workers=1)
    >>> found.rate.passed, found.rate.runs
    (5, 5)
    >>> bool((found.batch.contact < 0.1).all())  # of the clearances
    True
    """
    if plan.samples > IN_MEMORY:
        expected = f"at most {IN_MEMORY} in memory; malta.campaigns.summarize needs none for its runs"
        raise InputError("campaign", "samples", str(plan.samples), expected)
    done: dict[int, RunBlock] = {}
    session = RunExecution(workers, cluster, block, progress)
    with campaign_folder(plan, folder, session) as (place, size):
        ending = run_blocks(plan, place, size, session, done)
    return replace(gather(plan, done), **ending._asdict(), folder=place)


@contextmanager
def campaign_folder(
    plan: Plan, folder: str | Path | None, session: RunExecution, gains: Path | None = None
) -> Iterator[tuple[Path | None, int]]:
    """The folder of a campaign, with its manifest, and the number of runs in a block.

    gains : file of the controller, which the manifest of a new folder notes

    Where an InputError ends the campaign before it has a block, the manifest that was made here is deleted again.
    """
    size = block_size(plan, session)
    if folder is None:
        yield None, size
        return
    place = Path(folder)
    fresh = not file_exists(place / MANIFEST)
    size = open_folder(place, plan, size, gains)
    try:
        yield place, size
    except InputError:
        if fresh and not list(place.glob("runs_*.npz")):
            forget_folder(place)
        raise


def run_blocks(plan: Plan, place: Path | None, size: int, session: RunExecution, done: BlockSink) -> Ending:
    """Put all blocks of a plan into `done`: those that a folder has, then those that are missing, as they are flown.

    A block is forgotten here once `done` has it and the folder too.
    """
    parts = parts_of(plan, size)
    damaged: list[Path] = []
    runs = 0

    def report(more: float) -> None:
        if session.progress is not None:
            session.progress((runs + more) / plan.samples)

    try:
        with watch_interrupts() as pressed:
            left = dict(parts)
            if place is not None:
                for first, path, found in read_blocks(place, plan, parts):
                    if found is None:
                        damaged.append(path)
                        continue
                    done[first] = found
                    runs += left.pop(first)
                    report(0)
            for first, new in _fly_blocks(plan, left, session, report):
                if place is not None:
                    replace_files({place / block_name(first): encode_block(new, plan, first)})
                done[first] = new
                runs += parts[first]
                report(0)
                if pressed or is_stopped():
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        if place is not None:  # the last block may be in the folder and not yet in `done`
            missing = {first: count for first, count in parts.items() if first not in done}
            for first, _, found in read_blocks(place, plan, missing):
                if found is not None:
                    done[first] = found
        return Ending(True, tuple(damaged))
    return Ending(False, tuple(damaged))


def parts_of(plan: Plan, size: int) -> dict[int, int]:
    """The blocks of a plan: first run -> number of runs."""
    return {first: min(size, plan.samples - first) for first in range(0, plan.samples, size)}


def block_size(plan: Plan, session: RunExecution) -> int:
    """Runs in a block: BLOCK, doubled up to LARGE_BLOCK where a campaign would have more than FILES blocks.

    Raises InputError for workers beside a cluster, and for numbers out of range.
    """
    workers, cluster, block, _ = session
    if cluster is not None and workers is not None:
        raise InputError("campaign", "workers", str(workers), "none with a cluster, which has its own")
    if workers is not None and workers < 1:
        raise InputError("campaign", "workers", str(workers), "at least 1")
    size = block or (BLOCK if plan.law == "own" and (compiled.compiler() or cluster) else SLOW_BLOCK)
    if size < 1 or size % compiled.MOST_LANES:
        raise InputError("campaign", "block", f"{size} runs", f"a multiple of {compiled.MOST_LANES}")
    while not block and BLOCK <= size < LARGE_BLOCK and plan.samples > FILES * size:
        size *= 2
    return size


def _fly_blocks(
    plan: Plan, left: Mapping[int, int], session: RunExecution, report: Progress
) -> Iterator[tuple[int, RunBlock]]:
    """(first run, block) for every block that is left, as soon as it is done.

    left : first run -> number of runs
    report : called with the number of runs that are done of the block that is under way
    """
    if session.cluster is not None and left:
        from malta.campaigns.dask import blocks  # dask.distributed is an extra

        yield from blocks(session.cluster, plan, left)
        return
    for first, count in left.items():
        yield first, fly(plan, first, count, session.workers, partial(_report_runs, report, count))


def _report_runs(report: Progress, count: int, share: float) -> None:
    report(share * count)


def replay(
    plan: Plan, index: int, *, engine: EngineChoice | EngineOf = "auto", progress: Progress | None = None
) -> Experiment:
    """Simulate one run of a campaign again, with all its time series.

    Machine, errors of the sensors and noise are those of the campaign, to the bit, and so are the series.

    engine : "virtual machine" needs no C compiler; its last digits differ from those of the campaign

    Raises InputError for an index that the plan does not have.
    """
    if not 0 <= index < plan.samples:
        raise InputError("campaign", "run", str(index), f"0 to {plan.samples - 1}")
    if not callable(engine) and engine not in get_args(EngineChoice):
        raise InputError("campaign", "engine", repr(engine), "one of " + ", ".join(get_args(EngineChoice)))
    first = index // compiled.LANES * compiled.LANES
    machines = draw_machines(plan, first, min(compiled.LANES, plan.samples - first))
    return replay_machine(plan, machines, index, first=first, engine=engine, progress=progress)


def replay_machine(
    plan: Plan,
    machines: Machines,
    index: int,
    noise: NDArray[np.int64] | None = None,
    *,
    first: int = 0,
    engine: EngineChoice | EngineOf = "auto",
    progress: Progress | None = None,
) -> Experiment:
    """Simulate a plan's run on machine `index` with all its time series.

    machines : those of the runs from `first` on, a multiple of LANES; noise : theirs, as in `simulate_many`
    """
    planned = planned_run(plan)
    changes, errors = machines.changes, machines.sensor_errors
    plant, scenario = replay_run(plan.plant, planned.scenario, changes, index, first, errors)
    if noise is not None:
        scenario = replace(scenario, run=tuple(noise[index - first].tolist()))
    own = planned._replace(scenario=scenario)
    if plan.law != "own" and engine == "auto":
        engine = engine_of_c(PRECISIONS[plan.law])
    if engine == "virtual machine" or callable(engine):
        return single_run(plan.scenario, plant, plan.controller, own, engine, progress)
    run = record_run(
        plan.plant,
        plan.controller,
        planned.scenario,
        changes,
        index,
        first=first,
        sensor_errors=errors,
        noise=noise,
        progress=progress,
    )
    return single_run(plan.scenario, plant, plan.controller, own, engine, progress, run)


# The main job of a machine on machines that differ.


MACHINES = 4_000  # a share of 1 % is known to 0.3 %


def main_campaign(
    controller: Controller,
    spec: Spec,
    machines: int = MACHINES,
    *,
    settle: bool = True,
    progress: Progress | None = None,
) -> Campaign:
    """The campaign of a machine's main job over machines drawn at random from the design's uncertainty.

    settle : machines come to rest before, as long as the machine's SETTLE says; False: they begin with what v0 lacks
        for them, and with empty integrals
    """
    return campaign(main_plan(controller, spec, machines, settle=settle), progress=progress)


def main_plan(controller: Controller, spec: Spec, machines: int = MACHINES, *, settle: bool = True) -> Plan:
    """The plan of `main_campaign`."""
    job = main_job(spec.plant)
    options = settling_option(job, spec.plant, controller) if settle else {}
    return Plan(controller, job, dict(spec.uncertainty), samples=machines, options=options)


# A campaign of any size: blocks are simulated, stored, added to the summary, and forgotten.


class Sum:
    """The summary of the blocks so far, and which ones they are."""

    def __init__(self, plan: Plan, size: int, bounds: RunLimits) -> None:
        self.size = size  # runs in a block
        # One pair, so that Ctrl-C between two statements leaves no block that is counted and not noted.
        self.state = summary_of(gather(plan, {}), bounds), 0  # a bit for each block

    def __setitem__(self, first: int, block: RunBlock) -> None:
        summary, noted = self.state
        own = summary_of(gather(summary.plan, {first: block}), summary.bounds)
        self.state = join(summary, own), noted | 1 << first // self.size

    def __contains__(self, first: object) -> bool:
        return isinstance(first, int) and bool(self.state[1] >> first // self.size & 1)


def summarize(
    plan: Plan,
    folder: str | Path | None = None,
    bounds: RunLimits = NO_BOUNDS,
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
    session = RunExecution(workers, cluster, block, progress)
    with campaign_folder(plan, folder, session) as (place, size):
        found = Sum(plan, size, bounds)
        ending = run_blocks(plan, place, size, session, found)
    return replace(found.state[0], **ending._asdict(), folder=place)


# The status of a campaign: which of its blocks a folder has, also while another process adds some.


PACE_BLOCKS = 50  # blocks whose times tell the pace
STALL_TIME = 30.0  # s without a new block, after which nobody seems to simulate any
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
            and self.age < max(STALL_TIME, PATIENCE * (self.pace or 0))
        )

    @property
    def left(self) -> float | None:
        """Seconds that the rest takes at the pace of the last blocks; None where nothing runs or little is done."""
        return self.pace * (self.of - self.blocks) if self.running and self.pace is not None else None


def status(
    folder: str | Path,
    controller: Controller,
    bounds: RunLimits = NO_BOUNDS,
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
    parts = parts_of(plan, size)
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
    gaps = np.diff(times[-PACE_BLOCKS - 1 :])
    return Status(
        len(times),
        len(parts),
        size,
        stored,
        float(np.median(gaps)) if len(gaps) else None,
        max(time.time() - times[-1], 0.0) if times else None,
        replace(total.state[0], damaged=tuple(damaged), folder=place),
    )
