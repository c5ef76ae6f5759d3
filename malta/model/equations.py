"""Equations of expressions by name: `note` says what a result is, and what writes firmware records it.

The expressions stay as they are: a note names values that are computed anyway, in the words of the gain file.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar

T = TypeVar("T")


class Equation(NamedTuple):
    """A step of a computation."""

    block: str  # what the step does, as an identifier
    text: str  # the equation, in plain letters
    values: dict[str, Any]  # the results by name
    times: int = 1  # of equal computations, one after the other in each result


_recorded: ContextVar[list[Equation] | None] = ContextVar("_recorded", default=None)


@contextmanager
def recorded_equations() -> Iterator[list[Equation]]:
    """Within, notes are put into the list, in the order of the computation.

    >>> with recorded_equations() as found:
    ...     note("double", "y = 2 x", y=[2.0])
    >>> found[0].text
    'y = 2 x'
    """
    with collect(_recorded) as found:
        yield found


@contextmanager
def collect(variable: ContextVar[list[T] | None]) -> Iterator[list[T]]:
    """A new list in the variable, until the end of the block."""
    found: list[T] = []
    token = variable.set(found)
    try:
        yield found
    finally:
        variable.reset(token)


def is_recording() -> bool:
    """Whether notes are recorded."""
    return _recorded.get() is not None


def note(block: str, text: str, times: int = 1, /, **values: Any) -> None:
    """Say which equation gave these results; nothing happens where nobody records.

    block : what the step does, as an identifier; text : the equation; values : the results by name
    times : how often the same is done with other numbers, where each result is that many equal parts
    """
    known = _recorded.get()
    if known is not None:
        known.append(Equation(block, text, values, times))
