"""Groups of machines on several threads: each takes the next call of the engine until none is left."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from typing import Any, NamedTuple

from malta.simulation.compiled import Lanes, Part, Shared, run_many

WORK = 2_000_000  # substeps of the groups in one call of the engine, at most: a fraction of a second
LOOK = 0.1  # s from one report of progress to the next


class Work(NamedTuple):
    """The runs of a batch, ready for the compiled engine; the lanes' keys are those of the parts."""

    lanes: Lanes
    shared: Shared
    parts: Sequence[Part]


def run_groups(lib: Any, work: Work, workers: int, progress: Callable[[float], None] | None) -> None:
    """Simulate all groups of machines on several threads; the digests change in place."""
    lanes, shared, parts = work
    groups, done = len(lanes.states), list[int]()
    most = max(1, WORK // (len(shared.given) * shared.substeps))
    if len(parts) <= 2:  # a run, and perhaps the rest before it
        calls = _calls(groups, workers, 1, min(16, most))
    else:  # calls of short parts: the more groups in each, the less it counts
        step = min(64, -(-groups // workers), most)
        calls = _calls(groups, workers, step, step)

    def run() -> None:
        while True:
            try:
                chosen = calls.popleft()
            except IndexError:
                return
            run_many(lib, chosen, lanes, shared, parts)
            done.append(chosen.stop - chosen.start)

    with ThreadPoolExecutor(workers) as pool:
        running = {pool.submit(run) for _ in range(min(workers, len(calls)))}
        try:
            while running:  # to wake up for every call takes time from the workers
                ended, running = wait(running, LOOK, FIRST_EXCEPTION)
                for thread in ended:
                    thread.result()
                if progress is not None and done and calls:
                    progress(sum(done) / groups)
        except BaseException:
            calls.clear()
            raise
    if progress is not None:
        progress(1.0)


def _calls(groups: int, workers: int, least: int, most: int) -> deque[slice]:
    """Groups of each call of the engine: at most `most`, and towards the end fewer, so that threads end together."""
    calls, first = deque[slice](), 0
    while first < groups:
        size = max(least, min(most, (groups - first) // (2 * workers)))
        calls.append(slice(first, min(first + size, groups)))
        first += size
    return calls
