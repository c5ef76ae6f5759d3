"""The time at which a search ends: all its long steps look at it, also those that know nothing of searches.

A step whose result can be had in part asks `is_late`, and returns what it has; any other calls `check_time`.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_end: ContextVar[float] = ContextVar("end", default=math.inf)


class TimeUp(Exception):
    """The time of a search was up within a step that has no partial result."""


@contextmanager
def time_limit(end: float) -> Iterator[None]:
    """Within the block the time is up at `end`, a time.monotonic(), if it is not up before."""
    token = _end.set(min(end, _end.get()))
    try:
        yield
    finally:
        _end.reset(token)


def is_late(cost: float = 0.0) -> bool:
    """Whether the time is up, or would be after a step that takes `cost` seconds."""
    return time.monotonic() + cost > _end.get()


def check_time(cost: float = 0.0) -> None:
    """Raise TimeUp when the time is up, or would be after a step that takes `cost` seconds."""
    if is_late(cost):
        raise TimeUp
