"""A campaign: one scenario on thousands of machines, flown block by block and kept in a folder.

    Plan -> fly() block by block, here or on a cluster -> Campaign

Every block is kept as soon as it is done, so that a campaign that was ended in the middle goes on where it was, and one
that is done is read.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from malta.campaigns.plan import Plan as Plan
from malta.campaigns.plan import drawn, fingerprint, wanted_of
from malta.campaigns.statistics import Rate, rate
from malta.campaigns.store import (
    MANIFEST,
    Block,
    block_name,
    encoded,
    opened,
    read_block,
    read_manifest,
    require_same,
    shapes,
    short,
)
from malta.errors import InputError
from malta.files import replace_files
from malta.model.plant import readonly
from malta.simulation import compiled
from malta.simulation.batch import is_compiled, recorded_run, replayed, simulate_many
from malta.simulation.digest import Batch, verdicts
from malta.simulation.engines import EngineChoice
from malta.simulation.experiments import Experiment, flown
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

BLOCK = 1024  # runs in a block, a fraction of a second of work
SLOW_BLOCK = 32  # without a C compiler

Progress = Callable[[float], None]


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


def fly(
    plan: Plan, first: int, count: int, workers: int | None = None, progress: Progress | None = None
) -> Block:
    """Simulate runs `first` to `first + count` of a plan. `first` is a multiple of the lanes of the engine."""
    machines = drawn(plan)
    scenario, part = wanted_of(plan).scenario, slice(first, first + count)
    batch = simulate_many(
        plan.plant,
        plan.controller,
        scenario,
        {name: column[part] for name, column in machines.changes.items()},
        sensor_errors={name: column[part] for name, column in machines.sensor_errors.items()},
        first=first,
        workers=workers,
        progress=progress,
    )
    compiled = is_compiled(plan.plant, plan.controller, scenario)
    return Block(machines.values[part], batch, "compiled" if compiled else "virtual machine")


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
        size = opened(place, plan, size)
    parts = {first: min(size, plan.samples - first) for first in range(0, plan.samples, size)}
    done: dict[int, Block] = {}
    damaged: list[Path] = []
    interrupted = False
    try:
        with _noted() as pressed:
            if place is not None:
                damaged += _read(place, plan, parts, done)
            left = {first: count for first, count in parts.items() if first not in done}
            runs = plan.samples - sum(left.values())

            def told(more: float) -> None:
                if progress is not None:
                    progress((runs + more) / plan.samples)

            for first, new in _flown_blocks(plan, left, workers, cluster, told):
                if place is not None:
                    replace_files({place / block_name(first): encoded(new, plan)})
                done[first] = new
                runs += parts[first]
                told(0)
                if pressed:
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        interrupted = True
        if place is not None:  # one may have been kept, and not yet counted
            _read(place, plan, {k: n for k, n in parts.items() if k not in done}, done)
    return _gathered(plan, done, parts, place, tuple(damaged), interrupted)


@contextmanager
def _noted() -> Iterator[list[int]]:
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


def _read(place: Path, plan: Plan, parts: Mapping[int, int], done: dict[int, Block]) -> list[Path]:
    """Put the blocks of a folder into `done`; the files of those that are damaged."""
    damaged = []
    for first, count in parts.items():
        path = place / block_name(first)
        if not path.exists():
            continue
        found = read_block(path, plan, first, count)
        if found is None:
            damaged.append(path)
        else:
            done[first] = found
    return damaged


def _flown_blocks(
    plan: Plan, left: Mapping[int, int], workers: int | None, cluster: str | None, told: Progress
) -> Iterator[tuple[int, Block]]:
    """Blocks as they are done; `told` the runs of those that are not."""
    if cluster is not None and left:
        from malta.campaigns.dask import blocks  # dask.distributed is an extra

        yield from blocks(cluster, plan, left)
        return
    for first, count in left.items():
        yield first, fly(plan, first, count, workers, partial(_told, told, count))


def _told(told: Progress, count: int, share: float) -> None:
    told(share * count)


def _gathered(
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
    names = drawn(plan).names
    return Campaign(
        plan,
        index,
        names,
        readonly(np.concatenate([b.values for b in blocks]) if blocks else np.empty((0, len(names)))),
        _joined(plan, [b.batch for b in blocks]),
        tuple(sorted({b.engine for b in blocks})),
        interrupted,
        damaged,
        place,
    )


def _joined(plan: Plan, batches: list[Batch]) -> Batch:
    columns = {
        name: [getattr(batch, name) for batch in batches] or [np.empty((0, *shape))]
        for name, shape in shapes(plan).items()
    }
    return Batch(**{name: np.concatenate(column) for name, column in columns.items()})


def read_plan(folder: str | Path, controller: Controller) -> Plan:
    """The plan of the campaign in a folder. Raises InputError when it is not of this controller."""
    path = Path(folder) / MANIFEST
    content, _ = read_manifest(path)
    own = fingerprint(controller)
    try:
        gains, scenario, machine = content["gains"], content["scenario"], content["machine"]
        if gains["sha256"] != own:
            found = f"a campaign of {gains['name']}, sha256 {short(gains['sha256'])}"
            raise InputError(path, "gains", found, f"one of {controller.name}, sha256 {short(own)}")
        values = {name: float(value) for name, value in machine["parameters"].items()}
        plan = Plan(
            controller,
            scenario["name"],
            content["spread"],
            content["sensor_spread"],
            content["samples"],
            content["seed"],
            content["sampler"],
            replace(controller.parameters, **values, preset=machine["preset"]),
            scenario["case"],
            scenario["options"],
        )
    except InputError as error:
        raise InputError(path, error.field, error.found, error.expected) from error
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            path, "", f"a damaged or foreign file ({error})", "the manifest of a campaign"
        ) from error
    require_same(path, content, plan.manifest)
    return plan


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
    machines, wanted = drawn(plan), wanted_of(plan)
    changes, errors = machines.changes, machines.sensor_errors
    plant, scenario = replayed(plan.plant, wanted.scenario, changes, index, sensor_errors=errors)
    wanted = wanted._replace(scenario=scenario)
    if engine == "virtual machine":
        return flown(plan.scenario, plant, plan.controller, wanted, engine, progress)
    run = recorded_run(
        plan.plant,
        plan.controller,
        wanted_of(plan).scenario,
        changes,
        index,
        sensor_errors=errors,
        progress=progress,
    )
    return flown(plan.scenario, plant, plan.controller, wanted, engine, progress, run)
