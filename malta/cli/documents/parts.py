"""Parts that several documents share: ends of runs, shares of runs, files."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from operator import attrgetter
from typing import Annotated, Any, ClassVar, Protocol, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from malta.identifiers import distinct

Number = Annotated[float | None, Field(description="null where it is not finite, or where there is none")]
Files = Annotated[list[str], Field(description="files that the command wrote")]
Shares = Annotated[
    dict[str, float],
    Field(
        description="half range of each parameter, as a share of it, or in SI for a difference or an offset"
    ),
]


UNIT = re.compile(r"_(?:rad_per_s|rad|share|kg|s|N|A)$")  # at the end of a key


class Part(BaseModel):
    """A table of a document, which renders a record: a key has the record's field of its name, without its unit."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, json_schema_serialization_defaults_required=True
    )
    READS: ClassVar[Mapping[str, str]] = {}  # keys of other names -> the field, as "run.verdict"

    @classmethod
    def fields_of(cls, record: Any) -> dict[str, Any]:
        """What a record has of the keys."""
        found = {}
        for key in cls.model_fields:
            path = cls.READS.get(key) or (key if hasattr(record, key) else UNIT.sub("", key))
            if key in cls.READS or hasattr(record, path):
                value = attrgetter(path)(record)
                found[key] = value.tolist() if hasattr(value, "tolist") else value  # an array
        return found

    @classmethod
    def of(cls, record: Any, **given: Any) -> Self:
        """The table of a record; `given` are keys that it does not have, or has in another form."""
        return cls.model_validate(cls.fields_of(record) | given)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, record: Any) -> Any:
        return record if isinstance(record, Mapping | Part) else cls.fields_of(record)


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
