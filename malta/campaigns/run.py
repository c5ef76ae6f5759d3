"""Run a campaign, on this machine or on a cluster, and simulate single runs of it again.

    Plan -> fly() block by block -> Campaign

Every block is stored as soon as it is done. A campaign that was interrupted goes on with the blocks that are missing,
and a campaign that is complete is read from its folder.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, get_args

from malta.campaigns.block import Block, fly
from malta.campaigns.plan import Plan, draw_machines, planned_run
from malta.campaigns.result import Campaign, gather
from malta.campaigns.store import block_name, encode_block, open_folder, read_blocks
from malta.errors import InputError
from malta.files import replace_files
from malta.simulation import compiled
from malta.simulation.batch import record_run, replayed
from malta.simulation.catalogue import single_run
from malta.simulation.engines import EngineChoice
from malta.simulation.experiments import Experiment, Progress

BLOCK = 1024  # runs in a block: a fraction of a second of work
SLOW_BLOCK = 32  # without a C compiler


def campaign(
    plan: Plan,
    folder: str | Path | None = None,
    *,
    workers: int | None = None,
    cluster: str | None = None,
    block: int | None = None,
    progress: Progress | None = None,
) -> Campaign:
    """Simulate all runs of a plan, or those that its folder does not have yet.

    folder : stores every block as soon as it is done, and the manifest; None: nothing is written
    workers : threads on this machine; None: one for each core
    cluster : address of a Dask scheduler, as tcp://host:8786, whose workers simulate the blocks
    block : runs in a block, a multiple of 8; a folder that has a campaign keeps its own number
    progress : called now and then with the share of the runs that is done

    After Ctrl-C the result has the blocks that are done, and says `interrupted`.

    Raises InputError for a folder that has another campaign or cannot be written to, and for a scheduler that does not
    answer; blocks that are done stay in the folder.

        plan = malta.Plan(malta.gains.read("design/gains/calibrated.json"), spread={"m": 0.1}, samples=1000)
        print(malta.campaign(plan, "build/campaigns/mass").rate)
    """
    size = _block_size(block, workers, cluster)
    place = None if folder is None else Path(folder)
    if place is not None:
        size = open_folder(place, plan, size)
    parts = {first: min(size, plan.samples - first) for first in range(0, plan.samples, size)}
    done: dict[int, Block] = {}
    damaged: list[Path] = []
    interrupted = False
    try:
        with _watch_interrupts() as pressed:
            if place is not None:
                damaged += read_blocks(place, plan, parts, done)
            left = {first: count for first, count in parts.items() if first not in done}
            runs = plan.samples - sum(left.values())

            def report(more: float) -> None:
                if progress is not None:
                    progress((runs + more) / plan.samples)

            for first, new in _fly_blocks(plan, left, workers, cluster, report):
                if place is not None:
                    replace_files({place / block_name(first): encode_block(new, plan, first)})
                done[first] = new
                runs += parts[first]
                report(0)
                if pressed:
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        interrupted = True
        if place is not None:  # the last block may be in the folder and not yet in `done`
            read_blocks(place, plan, {k: n for k, n in parts.items() if k not in done}, done)
    found = gather(plan, done)
    return replace(found, interrupted=interrupted, damaged=tuple(damaged), folder=place)


def _block_size(block: int | None, workers: int | None, cluster: str | None) -> int:
    """Runs in a block. Raises InputError for workers beside a cluster, and for numbers out of range."""
    if cluster is not None and workers is not None:
        raise InputError("campaign", "workers", str(workers), "none with a cluster, which has its own")
    if workers is not None and workers < 1:
        raise InputError("campaign", "workers", str(workers), "at least 1")
    size = block or (BLOCK if compiled.compiler() or cluster else SLOW_BLOCK)
    if size < 1 or size % compiled.LANES:
        raise InputError("campaign", "block", f"{size} runs", f"a multiple of {compiled.LANES}")
    return size


@contextmanager
def _watch_interrupts() -> Iterator[list[int]]:
    """A list that is no longer empty after Ctrl-C: libraries under the campaign may drop the KeyboardInterrupt."""
    before, pressed = signal.getsignal(signal.SIGINT), list[int]()
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield pressed
        return
    handle: Callable[[int, FrameType | None], Any] = before

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(number)
        handle(number, frame)

    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


def _fly_blocks(
    plan: Plan, left: Mapping[int, int], workers: int | None, cluster: str | None, report: Progress
) -> Iterator[tuple[int, Block]]:
    """(first run, block) for every block that is left, as soon as it is done.

    left : first run -> number of runs
    report : called with the number of runs that are done of the block that is under way
    """
    if cluster is not None and left:
        from malta.campaigns.dask import blocks  # dask.distributed is an extra

        yield from blocks(cluster, plan, left)
        return
    for first, count in left.items():
        yield first, fly(plan, first, count, workers, partial(_report_runs, report, count))


def _report_runs(report: Progress, count: int, share: float) -> None:
    report(share * count)


def replay(
    plan: Plan, index: int, *, engine: EngineChoice = "auto", progress: Progress | None = None
) -> Experiment:
    """Simulate one run of a campaign again, with all its time series.

    Machine, errors of the sensors and noise are those of the campaign, to the bit, and so are the series.

    engine : "virtual machine" needs no C compiler; its last digits differ from those of the campaign

    Raises InputError for an index that the plan does not have.
    """
    if not 0 <= index < plan.samples:
        raise InputError("campaign", "run", str(index), f"0 to {plan.samples - 1}")
    if engine not in get_args(EngineChoice):
        raise InputError("campaign", "engine", repr(engine), "one of " + ", ".join(get_args(EngineChoice)))
    first = index // compiled.LANES * compiled.LANES
    machines = draw_machines(plan, first, min(compiled.LANES, plan.samples - first))
    planned, changes, errors = planned_run(plan), machines.changes, machines.sensor_errors
    plant, scenario = replayed(plan.plant, planned.scenario, changes, index, first, errors)
    own = planned._replace(scenario=scenario)
    if engine == "virtual machine":
        return single_run(plan.scenario, plant, plan.controller, own, engine, progress)
    run = record_run(
        plan.plant,
        plan.controller,
        planned.scenario,
        changes,
        index,
        first=first,
        sensor_errors=errors,
        progress=progress,
    )
    return single_run(plan.scenario, plant, plan.controller, own, engine, progress, run)
