"""Figures of merit: a value with its unit, what it means, which way is better, and what bounds it.

Loops, runs, experiments and campaigns list their figures as these records, which terminal, JSON documents, pages,
comparisons and the live page render. Nothing else says which of two values is better.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import field, fields
from typing import Any, Literal, NamedTuple

from malta.bound import Bound, at_least, at_most
from malta.display import RADIANS, display, frequency, micro, number
from malta.units import distinct, identifier, in_unit

Better = Literal["high", "low", ""]  # "": neither
Scope = Literal["loop", "box", "machine"]  # what two designs share where a comparison makes sense
PLAIN_SIZES = (1e-2, 1e6)  # sizes of numbers that are written without a power of ten
ROOTS = {"m s^0.5": (1e6, "um s^0.5"), "rad s^0.5": (1e6, "urad s^0.5")}  # no products of whole powers


class Meaning(NamedTuple):
    """What a kind of figures is."""

    group: str
    better: Better
    scope: Scope
    unit: str = "1"  # for display
    bound: Callable[[float], Bound] | None = None  # of a figure that is one


MEANINGS: dict[str, Meaning] = {
    "stable": Meaning("stability and margins", "high", "loop"),
    "margin_proven": Meaning("stability and margins", "high", "box", "percent", at_least),
    "margin_lost_at": Meaning("stability and margins", "high", "box", "percent", at_most),
    "disk": Meaning("stability and margins", "high", "loop"),
    "disk_of": Meaning("stability and margins", "high", "machine"),
    "phase_margin": Meaning("stability and margins", "high", "loop", "deg"),
    "delay_margin": Meaning("stability and margins", "high", "loop", "us"),
    "mass_margin": Meaning("stability and margins", "high", "machine", "kg", at_least),
    "payload": Meaning("stability and margins", "high", "machine", "kg", at_least),
    "peak_s": Meaning("sensitivity", "low", "loop"),
    "peak_s_of": Meaning("sensitivity", "low", "machine"),
    "peak_t": Meaning("sensitivity", "low", "loop"),
    "bandwidth": Meaning("bandwidth and poles", "high", "loop", "rad/s"),
    "natural": Meaning("bandwidth and poles", "", "loop", "rad/s"),
    "slowest_pole": Meaning("bandwidth and poles", "high", "loop", "rad/s"),
    "damping": Meaning("bandwidth and poles", "high", "loop"),
    "motion": Meaning("noise at rest", "low", "machine"),
    "command": Meaning("noise at rest", "low", "machine"),
    "load_moves": Meaning("a constant load from outside", "low", "machine"),
    "load_settles": Meaning("a constant load from outside", "low", "machine", "s"),
    "compliance": Meaning("a constant load from outside", "low", "machine"),
    "job": Meaning("main job", "low", "machine"),
    "yield": Meaning("campaign", "high", "box", "percent"),
    "runs": Meaning("campaign", "low", "box"),
    "requirements": Meaning("requirements", "high", "machine"),
    "undecided": Meaning("requirements", "", "machine"),
    "at_most": Meaning("requirements", "low", "machine"),
    "at_least": Meaning("requirements", "high", "machine"),
    "proven": Meaning("requirements", "high", "machine", "percent", at_least),
}
FREQUENCIES = ("bandwidth", "natural", "slowest_pole", "at_most", "at_least")  # kinds whose rad/s are such
GROUPS = tuple(dict.fromkeys(meaning.group for meaning in MEANINGS.values()))


@display
class Merit(NamedTuple):
    """A figure of merit.

    label : its words
    value : SI
    unit : for display
    published : key of the paper's value in data/published/; "": none
    relation : of ours to the published, or to the bound: "about" or "at most"
    key : its name in documents, without a unit; "": the words of the label
    better : "high" or "low", or "" where neither is
    kind : of MEANINGS
    signal : in the label, of a figure that each signal has
    bound : that is asked for or published, SI; None: none
    note : where or how it was found, for a reader
    """

    label: str
    value: float
    unit: str
    published: str = ""
    relation: str = "about"
    key: str = ""
    better: Better = "low"
    kind: str = "job"
    signal: str = ""
    bound: float | None = None
    note: str = ""

    @property
    def identifier(self) -> str:
        """The key of the figure in JSON documents, with its SI unit: `rise_s`."""
        return identifier(self.key or self.label, self.unit)

    @property
    def meaning(self) -> Meaning:
        """What figures of this kind are."""
        return MEANINGS[self.kind]

    @property
    def is_frequency(self) -> bool:
        """Whether its rad/s are those of a frequency or a pole, which stand in Hz too; not those of a turn."""
        return self.unit == "rad/s" and self.kind in FREQUENCIES

    @property
    def text(self) -> str:
        """The value in its unit, with four digits; a frequency in Hz too."""
        if self.kind == "stable":
            return "yes" if self.value else "NO"
        if self.meaning.bound is not None:
            shown = self.meaning.bound(self.value)
            return shown.percent(unit="") if self.unit == "percent" else shown.text()
        if math.isnan(self.value):
            return "none"
        if math.isinf(self.value):
            return "any"
        if self.is_frequency:
            return frequency(self.value)
        factor, _ = ROOTS.get(self.unit) or (in_unit(1.0, self.unit), "")
        return four_digits(factor * self.value)

    @property
    def heading(self) -> str:
        """The label with the unit in brackets."""
        unit = RADIANS if self.is_frequency else ROOTS[self.unit][1] if self.unit in ROOTS else self.unit
        shown = {"percent": "%", "1": ""}.get(unit, micro(unit))
        return f"{self.label} [{shown}]" if shown else self.label

    def phrase(self, digits: int = 3) -> str:
        """The value with its unit, for a sentence; so many digits unless it is a bound."""
        unit = {"percent": " %", "1": ""}.get(self.unit, f" {micro(self.unit)}")
        bound = self.meaning.bound is not None
        return (self.text if bound else number(in_unit(self.value, self.unit), digits)) + unit

    def __str__(self) -> str:
        unit = "%" if self.unit == "percent" else self.unit
        return f"{self.label} {in_unit(self.value, self.unit):.3g} {unit}"


def figure(
    kind: str,
    key: str,
    label: str,
    value: float,
    unit: str = "",
    signal: str = "",
    bound: float | None = None,
    note: str = "",
) -> Merit:
    """The figure of a kind, which says what is better; `unit` for display, if not that of its kind."""
    unit, better = unit or MEANINGS[kind].unit, MEANINGS[kind].better
    return Merit(label, float(value), unit, "", "about", key, better, kind, signal, bound, note)


def four_digits(value: float) -> str:
    """A number with four digits; far from one with its power of ten.

    >>> four_digits(0.5), four_digits(4.7e-7)
    ('0.5000', '4.7e-07')
    """
    rounded = float(f"{value:.4g}")
    return number(rounded) if PLAIN_SIZES[0] <= abs(value) < PLAIN_SIZES[1] or not value else f"{rounded:g}"


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
