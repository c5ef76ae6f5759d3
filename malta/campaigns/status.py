"""The status of a campaign: which of its blocks a folder has, also while another process adds some."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from malta.campaigns.store import MANIFEST, read_blocks, read_manifest, read_plan
from malta.campaigns.summary import UNBOUNDED, Bounds, Summary
from malta.campaigns.survey import Sum

if TYPE_CHECKING:
    from malta.simulation.experiments import Progress
    from malta.synthesis.controller import Controller

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
