"""Parts that several documents share: ends of runs, shares of runs, files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, Protocol

from pydantic import BaseModel, ConfigDict, Field

from malta.identifiers import distinct

if TYPE_CHECKING:
    from malta.campaigns.result import Rate
    from malta.simulation.verdict import Verdict

Number = Annotated[float | None, Field(description="null where it is not finite, or where there is none")]
Files = Annotated[list[str], Field(description="files that the command wrote")]
Shares = Annotated[
    dict[str, float],
    Field(
        description="half range of each parameter, as a share of it, or in SI for a difference or an offset"
    ),
]


class Part(BaseModel):
    """A table of a document."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, json_schema_serialization_defaults_required=True
    )


class End(Part):
    """How a run ended, and when."""

    name: str = Field(description='"completed", "diverged", "interrupted" or the contact that was touched')
    time_s: Number


class ShareOfRuns(Part):
    """A share of runs with its 95 % interval (Clopper-Pearson)."""

    passed: int
    runs: int
    share: Number
    low: Number
    high: Number


class Labelled(Protocol):
    """A figure of merit."""

    @property
    def identifier(self) -> str:
        """Its key."""

    @property
    def value(self) -> float:
        """SI."""


def end_of(verdict: Verdict) -> End:
    """The end of a run."""
    return End(name=verdict.name, time_s=verdict.time)


def share_of(rate: Rate) -> ShareOfRuns:
    """A share of runs."""
    return ShareOfRuns(**rate._asdict())


def merits_of(merits: Iterable[Labelled]) -> dict[str, Number]:
    """Figures of merit by their identifiers."""
    listed = list(merits)
    names = distinct(merit.identifier for merit in listed)
    return {name: merit.value for name, merit in zip(names, listed, strict=True)}


def words_of(label: str) -> str:
    """A label as a key: `+ current loops` is current_loops."""
    return "_".join(re.findall(r"\w+", label))


def with_keys(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table whose keys are labels, with keys that are identifiers."""
    return dict(zip(distinct(map(words_of, table)), table.values(), strict=True))
