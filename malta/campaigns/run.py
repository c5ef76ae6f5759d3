"""A campaign: one scenario on thousands of machines, simulated block by block and kept in a folder.

    Plan -> fly() block by block, here or on a cluster -> Campaign

Every block is kept as soon as it is done, so that a campaign that was ended in the middle goes on where it was, and one
that is done is read.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
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
from malta.simulation.engines import EngineChoice
from malta.simulation.experiments import Experiment, Progress, single_run

BLOCK = 1024  # runs in a block, a fraction of a second of work


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
    """Fly a plan, or what is left of it.

    folder : keeps every block as soon as it is done, and the manifest; None: nothing is written
    workers : threads on this machine; None: one for each core
    cluster : address of a Dask scheduler, as tcp://host:8786, whose workers fly the blocks
    block : runs in a block, a multiple of 8; a folder that was begun keeps its own
    progress : told the share that is done, now and then

    Ctrl-C keeps what is done: the result says `interrupted`. Raises InputError for a folder that holds another campaign
    or cannot be written to, and for a scheduler that does not answer; blocks that are done stand.
    """
    if cluster is not None and workers is not None:
        raise InputError("campaign", "workers", str(workers), "none with a cluster, which has its own")
    if workers is not None and workers < 1:
        raise InputError("campaign", "workers", str(workers), "at least 1")
    size = block or (BLOCK if compiled.compiler() or cluster else SLOW_BLOCK)
    if size < 1 or size % compiled.LANES:
        raise InputError("campaign", "block", f"{size} runs", f"a multiple of {compiled.LANES}")
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

            def told(more: float) -> None:
                if progress is not None:
                    progress((runs + more) / plan.samples)

            for first, new in _fly_blocks(plan, left, workers, cluster, told):
                if place is not None:
                    replace_files({place / block_name(first): encode_block(new, plan)})
                done[first] = new
                runs += parts[first]
                told(0)
                if pressed:
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        interrupted = True
        if place is not None:  # one may have been kept, and not yet counted
            read_blocks(place, plan, {k: n for k, n in parts.items() if k not in done}, done)
    return gather(plan, done, parts, place, tuple(damaged), interrupted)


@contextmanager
def _watch_interrupts() -> Iterator[list[int]]:
    """Ctrl-C, noted as it comes: libraries that are called while it comes now and then drop the exception."""
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
    plan: Plan, left: Mapping[int, int], workers: int | None, cluster: str | None, told: Progress
) -> Iterator[tuple[int, Block]]:
    """Blocks as they are done; `told` the runs of those that are not."""
    if cluster is not None and left:
        from malta.campaigns.dask import blocks  # dask.distributed is an extra

        yield from blocks(cluster, plan, left)
        return
    for first, count in left.items():
        yield first, fly(plan, first, count, workers, partial(_report_runs, told, count))


def _report_runs(told: Progress, count: int, share: float) -> None:
    told(share * count)


def replay(
    plan: Plan, index: int, *, engine: EngineChoice = "auto", progress: Progress | None = None
) -> Experiment:
    """One run of a campaign with all its time series: the same machine, sensor errors and noise, to the bit.

    engine : "virtual machine" gives the run by itself, without the C compiler, whose last digits differ
    """
    if not 0 <= index < plan.samples:
        raise InputError("campaign", "run", str(index), f"0 to {plan.samples - 1}")
    if engine not in get_args(EngineChoice):
        raise InputError("campaign", "engine", repr(engine), "one of " + ", ".join(get_args(EngineChoice)))
    machines, wanted = draw_machines(plan), planned_run(plan)
    changes, errors = machines.changes, machines.sensor_errors
    plant, scenario = replayed(plan.plant, wanted.scenario, changes, index, sensor_errors=errors)
    wanted = wanted._replace(scenario=scenario)
    if engine == "virtual machine":
        return single_run(plan.scenario, plant, plan.controller, wanted, engine, progress)
    run = record_run(
        plan.plant,
        plan.controller,
        planned_run(plan).scenario,
        changes,
        index,
        sensor_errors=errors,
        progress=progress,
    )
    return single_run(plan.scenario, plant, plan.controller, wanted, engine, progress, run)
