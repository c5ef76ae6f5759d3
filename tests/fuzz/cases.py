"""Cases: a sound file, and what is changed in it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st

from fuzz.edits import CUTS, EDITS, Cut, Edit
from fuzz.oracle import Defect

ROOT = Path(__file__).parents[2]


class Case(NamedTuple):
    """A sound file with edits of its tables, cuts of its bytes, and whether its seal is made anew."""

    base: str
    edits: tuple[Edit, ...] = ()
    cuts: tuple[Cut, ...] = ()
    sealed: bool = True


def cases(bases: Sequence[str], *, tables: bool = True) -> st.SearchStrategy[Case]:
    """Cases with one to four changes; `tables`: of the tables too, where the kind has them."""
    some_edits = st.lists(EDITS, min_size=1, max_size=4).map(tuple)
    some_cuts = st.lists(CUTS, min_size=1, max_size=3).map(tuple)
    base, seals = st.sampled_from(tuple(bases)), st.sampled_from((True, True, True, True, False))
    by_bytes = st.builds(Case, base, st.just(()), some_cuts, seals)
    if not tables:
        return by_bytes
    by_tables = st.builds(Case, base, some_edits, st.just(()), seals)
    return st.one_of(by_tables, by_tables, by_tables, by_bytes)


def require_finite(controller: Any) -> None:
    for name in ("A", "B", "C", "Ad", "Bd", "Cd", "K", "Ki", "L", "sample_time", "operating_point"):
        values = getattr(controller, name)
        for part in values if isinstance(values, tuple) else (values,):
            if not np.isfinite(part).all():
                raise Defect(f"{name} was read as {part}")
