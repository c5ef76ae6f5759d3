"""Cases of a kind, tried one after the other: by the tests with a fixed seed, by `make fuzz` with others."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from hypothesis import HealthCheck, Phase, given, note, seed, settings
from hypothesis.database import DirectoryBasedExampleDatabase

from fuzz.kinds import Kind

SEED = 20_260_101  # of the tests
MOST_TEXT = 2000  # characters of a case that is printed


def cases_of(
    kind: Kind,
    read: Callable[[Any], None],
    count: int,
    *,
    number: int = SEED,
    phases: Sequence[Phase] = tuple(Phase),
    database: DirectoryBasedExampleDatabase | None = None,
) -> Callable[[], None]:
    """A function that tries `count` cases; a case that fails is made small, printed, and raised."""
    chosen = settings(
        max_examples=count,
        deadline=None,
        database=database,
        phases=phases,
        suppress_health_check=list(HealthCheck),
        print_blob=True,
    )

    def tried(case: Any) -> None:
        note(repr(case)[:MOST_TEXT])
        read(case)

    return seed(number)(chosen(given(kind.cases)(tried)))
