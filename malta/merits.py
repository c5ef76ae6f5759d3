"""Figures of merit: a value with its unit, what it means, which way is better, and what bounds it.

Loops, runs, experiments and campaigns list their figures as these records, which terminal, JSON documents, pages,
comparisons and the live page render. Nothing else says which of two values is better.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, NamedTuple

from malta.bound import Bound, at_least, at_most
from malta.display import RADIANS, display, frequency, micro, number
from malta.units import identifier, in_unit

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
    "load_any": Meaning("a load of any waveform", "low", "machine", bound=at_most),
    "load_safe": Meaning("a load of any waveform", "high", "machine", bound=at_least),
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
        factor, _ = ROOTS.get(self.unit) or (in_unit(1.0, self.unit), "")
        if self.meaning.bound is not None:
            shown = self.meaning.bound(self.value)
            return shown.percent(unit="") if self.unit == "percent" else shown.text(factor=factor)
        if math.isnan(self.value):
            return "none"
        if math.isinf(self.value):
            return "never" if self.kind == "load_settles" else "any"
        if self.is_frequency:
            return frequency(self.value)
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
