"""What a requirement asks for and what was found, with the words and figures in which every page says it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from malta.bound import at_least, at_most
from malta.merits import ROOTS
from malta.synthesis.requirements import Figure, Verdict, judge_figure, ratio_of
from malta.units import FINE_UNITS, unit_factor


class Outcome(NamedTuple):
    """What is asked for and what was found, SI."""

    name: str
    asked: float | None  # None: as little as the others leave
    found: float
    unit: str
    how: str  # where the figure comes from
    at_least: bool = False  # asked for from below
    interval: tuple[float, float] | None = None  # 95 % confidence of a simulated figure

    @property
    def ratio(self) -> float:
        """How near its limit: at most 1 where it holds."""
        asked = math.inf if self.asked is None else self.asked
        return ratio_of(asked, self.found, at_least=self.at_least)

    @property
    def is_graded(self) -> bool:
        """Whether its figure says how near the limit is; a test that is passed has its bound as its figure."""
        return self.asked is not None and self.found != self.asked

    @property
    def nearness(self) -> str:
        """How near its limit, as a share of it that is never less; "" where nothing says so."""
        return at_most(self.ratio).percent() if self.is_graded else ""

    @property
    def verdict(self) -> Verdict:
        """Whether the bound holds; "undecided" where the interval of a simulated figure has the bound within."""
        return judge_figure(Figure(self.found, self.how, self.interval), self.asked, at_least=self.at_least)

    @property
    def holds(self) -> bool:
        """Whether the figure is within its bound; not where that is undecided."""
        return self.verdict == "holds"

    @property
    def words(self) -> str:
        """Its name, with that of its signal or load as it is: "peak sensitivity", "recovery F_x left"."""
        base, space, rest = self.name.partition(" ")
        return base.replace("_", " ") + space + rest

    @property
    def _scale(self) -> tuple[float, str]:
        """Factor from SI and unit that readers see: bandwidths in Hz, deviations in um."""
        if self.unit == "rad/s":
            return 1 / (2 * math.pi), "Hz"
        fine = FINE_UNITS.get(self.unit)
        return (1 / unit_factor(fine, "unit"), fine) if fine else ROOTS.get(self.unit, (1.0, self.unit))

    def text(self, value: float) -> str:
        """A value of it in the unit that readers see; a bandwidth has rad/s beside Hz, a margin is proven."""
        if self.name == "margin":
            return at_least(value).percent()
        factor, unit = self._scale
        more = f" ({value:.4g} rad/s)" if unit == "Hz" else ""
        return f"{value * factor:.4g} {unit}".removesuffix(" 1") + more

    @property
    def asked_text(self) -> str:
        """Its bound; "as little as possible" without one."""
        if self.asked is None:
            return "as little as possible"
        return f"{'>=' if self.at_least else '<='} {self._as_asked(self.asked)}"

    def _as_asked(self, bound: float) -> str:
        """A bound of it as the design file has it."""
        return f"{100 * bound:.10g} %" if self.name == "margin" else self.text(bound)

    @property
    def found_text(self) -> str:
        """What was found; of a mean over seeds with half the width of its interval."""
        if self.interval is None:
            return self.text(self.found)
        low, high = self.interval
        number, space, unit = self.text(self.found).partition(" ")
        return f"{number} ± {(high - low) / 2 * self._scale[0]:.2g}{space}{unit}"

    def __str__(self) -> str:
        found = f"{self.name} is {self.text(self.found)}"
        if self.asked is None:
            return f"{found}, asked for little"
        bound = "at least" if self.at_least else "at most"
        text = f"{found}, asked for {bound} {self._as_asked(self.asked)}"
        if self.verdict != "undecided" or self.interval is None:
            return text
        low, high = map(self.text, self.interval)
        return f"{text}, undecided between {low} and {high}"


def near_limits(outcomes: Iterable[Outcome], most: int) -> str:
    """Name the requirements that hold with least to spare; those of several signals that are as near stand together.

    >>> x, y = (Outcome(f"recovery {name} left", 1e-6, 0.5e-6, "m", "") for name in ("F_x", "F_y"))
    >>> near_limits([x, y, Outcome("payload", 0.2, 0.2, "kg", "flown", at_least=True)], 2)
    'recovery F_x F_y left 50.00 %'
    """
    held = sorted((one for one in outcomes if one.holds and one.is_graded), key=lambda one: -one.ratio)
    texts: dict[str, list[str]] = {}
    for one in held:
        texts.setdefault(one.nearness, []).append(one.name)
    found = [f"{words} {near}" for near, names in texts.items() for words in join_signals(names)]
    return ", ".join(found[:most])


def join_signals(names: Iterable[str]) -> list[str]:
    """Names of requirements as words, those that differ in their signal alone as one: "recovery F_x F_y left".

    >>> join_signals(["recovery F_x left", "axial_motion", "recovery F_y left"])
    ['recovery F_x F_y left', 'axial motion']
    """
    signals: dict[tuple[str, str], list[str]] = {}
    for name in names:
        base, *rest = name.split(" ", 2)
        signals.setdefault((base.replace("_", " "), "".join(rest[1:])), []).extend(rest[:1])
    return [" ".join(filter(None, (base, *own, tail))) for (base, tail), own in signals.items()]
