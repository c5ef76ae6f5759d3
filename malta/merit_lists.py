"""Figures of merit side by side: those of a result's fields, in groups, by their keys, and the best of several."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import field, fields
from typing import Any

from malta.merits import MEANINGS, Better, Merit
from malta.units import distinct

GROUPS = tuple(dict.fromkeys(meaning.group for meaning in MEANINGS.values()))


def find_best(figures: Sequence[Merit | None]) -> tuple[bool, ...]:
    """Which designs are better than some other: those that share the best value, none where all are as good.

    Values that are written with the same digits are as good as each other.
    """
    known = [one for one in figures if one is not None and not math.isnan(one.value)]
    if len(known) < 2 or not known[0].better:
        return tuple(False for _ in figures)
    pick = max if known[0].better == "high" else min
    best = pick(known, key=lambda one: one.value).text
    if all(one.text == best for one in known):
        return tuple(False for _ in figures)
    return tuple(one is not None and one.text == best for one in figures)


def in_groups(figures: Iterable[Merit]) -> tuple[Merit, ...]:
    """Figures in the order of their groups."""
    return tuple(sorted(figures, key=lambda one: GROUPS.index(one.meaning.group)))


def by_identifier(figures: Iterable[Merit]) -> dict[str, Merit]:
    """Figures by their identifiers, of which none comes twice.

    >>> [*by_identifier([Merit("rise", 0.01, "ms"), Merit("rise", 0.02, "ms")])]
    ['rise_s', 'rise_s_2']
    """
    listed = list(figures)
    return dict(zip(distinct(one.identifier for one in listed), listed, strict=True))


def merit_field(
    label: str, unit: str, relation: str = "about", *, better: Better = "low", key: str = ""
) -> Any:
    """Declare a field of a result that is a figure of merit, SI, or a mapping of such by signal.

    label : its words; "{}" in it is the name of the signal
    unit : for display
    relation : of a value to one that a paper publishes
    better : which way is better
    key : name in documents, without a unit
    """
    return field(metadata={"merit": Merit(label, math.nan, unit, "", relation, key, better)})


def reported_merits(record: Any) -> dict[str, Merit]:
    """The figures of merit of a result by the names of their fields, of a mapping with a dot and the signal.

    >>> from dataclasses import dataclass
    >>> @dataclass(frozen=True)
    ... class Stroke:
    ...     rise: float = reported("rise, 10-90 %", "ms")
    ...     radial: Mapping[str, float] = reported("deviation {}", "um")
    >>> [str(one) for one in reported_merits(Stroke(0.0158, {"x1": 3e-6})).values()]
    ['rise, 10-90 % 15.8 ms', 'deviation x1 3 um']
    """
    return dict(_merits_of(record))


def _merits_of(record: Any) -> Iterator[tuple[str, Merit]]:
    for one in fields(record):
        merit, value = one.metadata.get("merit"), getattr(record, one.name)
        if merit is None:
            continue
        if isinstance(value, Mapping):
            for signal, part in value.items():
                yield (
                    f"{one.name}.{signal}",
                    merit._replace(label=merit.label.format(signal), value=part, signal=signal),
                )
        else:
            yield one.name, merit._replace(value=value)
