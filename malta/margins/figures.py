"""Figures of merit of a loop: identifiers with units, words, and which way is better. One table of meanings.

Headlines of reports, columns of comparisons, the live page and JSON documents take their figures from here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from malta.display import micro, number
from malta.identifiers import identifier
from malta.units import in_unit

Better = Literal["high", "low", ""]  # "": neither
Scope = Literal[
    "loop", "box", "machine"
]  # what two designs share for a comparison of the figure to make sense
PLAIN = (1e-2, 1e6)  # sizes of numbers that are written without a power of ten
ROOTS = {"m s^0.5": (1e6, "um s^0.5"), "rad s^0.5": (1e6, "urad s^0.5")}  # no products of whole powers
# ISO 14839-3: upper limits of the peak sensitivity
ZONES = ((3.0, "A"), (4.0, "B"), (5.0, "C"), (np.inf, "D"))
BANDWIDTHS = {
    "sigma_max_T": "last -3 dB of sigma_max(T)",
    "sigma_min_T": "first -3 dB of sigma_min(T)",
    "crossover_max": "last 0 dB of sigma_max(L)",
    "w_n_max": "regulator's fastest natural frequency",
    "w_n_min": "regulator's slowest natural frequency",
}


class Meaning(NamedTuple):
    """What a kind of figures is."""

    group: str
    better: Better
    scope: Scope
    unit: str = "1"  # for display


MEANINGS: dict[str, Meaning] = {
    "stable": Meaning("stability and margins", "high", "loop"),
    "margin_proven": Meaning("stability and margins", "high", "box", "percent"),
    "margin_lost_at": Meaning("stability and margins", "high", "box", "percent"),
    "disk": Meaning("stability and margins", "high", "loop"),
    "disk_of": Meaning("stability and margins", "high", "machine"),
    "phase_margin": Meaning("stability and margins", "high", "loop", "deg"),
    "delay_margin": Meaning("stability and margins", "high", "loop", "us"),
    "mass_margin": Meaning("stability and margins", "high", "machine", "kg"),
    "payload": Meaning("stability and margins", "high", "machine", "kg"),
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
    "job_lower": Meaning("main job", "low", "machine"),
    "job_higher": Meaning("main job", "high", "machine"),
    "job": Meaning("main job", "", "machine"),
    "requirements": Meaning("requirements", "high", "machine"),
    "undecided": Meaning("requirements", "", "machine"),
    "at_most": Meaning("requirements", "low", "machine"),
    "at_least": Meaning("requirements", "high", "machine"),
}
GROUPS = tuple(dict.fromkeys(meaning.group for meaning in MEANINGS.values()))


class LoopFigure(NamedTuple):
    """A figure of merit of a design."""

    kind: str  # of MEANINGS
    key: str  # identifier with its unit
    label: str
    value: float  # SI
    unit: str  # for display
    factor: float  # from SI to it
    signal: str = ""  # in the label, of a figure that each signal has
    bound: float | None = None  # that the design file asks for, SI

    @property
    def meaning(self) -> Meaning:
        """What figures of this kind are."""
        return MEANINGS[self.kind]

    @property
    def text(self) -> str:
        """The value in its unit, with four digits."""
        if self.kind == "stable":
            return "yes" if self.value else "NO"
        if math.isnan(self.value):
            return "none"
        if math.isinf(self.value):
            return "any"
        return four_digits(self.factor * self.value)

    @property
    def heading(self) -> str:
        """The label with the unit in brackets."""
        shown = {"percent": "%", "1": ""}.get(self.unit, micro(self.unit))
        return f"{self.label} [{shown}]" if shown else self.label


def figure(
    kind: str,
    name: str,
    label: str,
    value: float,
    unit: str = "",
    signal: str = "",
    bound: float | None = None,
) -> LoopFigure:
    """The figure of a kind: `name` is its key without a unit; `unit` for display, if not that of its kind."""
    unit = unit or MEANINGS[kind].unit
    factor, shown = ROOTS[unit] if unit in ROOTS else (in_unit(1.0, unit), unit)
    return LoopFigure(kind, identifier(name, unit), label, float(value), shown, factor, signal, bound)


def four_digits(value: float) -> str:
    """A number with four digits; far from one with its power of ten.

    >>> four_digits(0.5), four_digits(4.7e-7)
    ('0.5000', '4.7e-07')
    """
    rounded = float(f"{value:.4g}")
    return number(rounded) if PLAIN[0] <= abs(value) < PLAIN[1] or not value else f"{rounded:g}"


def best_of(figures: Sequence[LoopFigure | None]) -> tuple[bool, ...]:
    """Which designs are better than some other: those that share the best value, none where all are as good.

    Values that are written with the same digits are as good as each other.
    """
    known = [one for one in figures if one is not None and not math.isnan(one.value)]
    if len(known) < 2 or not known[0].meaning.better:
        return tuple(False for _ in figures)
    pick = max if known[0].meaning.better == "high" else min
    best = pick(known, key=lambda one: one.value).text
    if all(one.text == best for one in known):
        return tuple(False for _ in figures)
    return tuple(one is not None and one.text == best for one in figures)


def zone(peak: float) -> str:
    """ISO 14839-3 zone of a peak sensitivity: A below 3 (9.5 dB), B below 4, C below 5, D above."""
    return next(name for limit, name in ZONES if peak < limit or limit == np.inf)
