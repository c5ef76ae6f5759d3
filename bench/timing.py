"""What every benchmark is made of: a row, medians of calls in turn, peers that are installed."""

from __future__ import annotations

import importlib
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any, NamedTuple

from rich.console import Console
from rich.progress import track

PATIENCE = 10.0  # s, of counted runs of one call


class Result(NamedTuple):
    """A line of the table."""

    workload: str
    ours: float  # in `unit`
    peer: str
    theirs: float  # in `unit`; NaN where it does not apply
    wanted: str
    unit: str = "s"  # "": a count, of what the workload says


def medians(*calls: Callable[[], object], runs: int, what: str) -> list[float]:
    """Median seconds of each call, taken in turn after one warm-up of each; what takes long has fewer turns."""
    times: list[list[float]] = [[] for _ in calls]
    for run in track(range(runs + 1), what, console=Console(stderr=True), transient=True):
        for call, seconds in zip(calls, times, strict=True):
            if sum(seconds) > PATIENCE:
                continue
            start = time.perf_counter()
            call()
            if run or time.perf_counter() - start > PATIENCE:
                seconds.append(time.perf_counter() - start)
    return [statistics.median(seconds) for seconds in times]


def optional(*names: str) -> dict[str, Any]:
    """Peers whose compiler or library is here."""
    found = {}
    for name in names:
        try:
            found[name] = importlib.import_module(name)
        except ImportError as error:
            print(f"left out: {name} ({error})", file=sys.stderr)
    return found
