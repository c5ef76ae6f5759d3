"""The text of a proven margin, or of any bound: what is proven is rounded down, where a loop is lost is rounded up.

Both have the same digits.
"""

from __future__ import annotations

import math
from decimal import ROUND_CEILING, ROUND_FLOOR, Context, Decimal
from typing import NamedTuple

DIGITS = 4  # of a bound that is no share
PLACES = 2  # behind the point of a share in percent
EXACT_CONTEXT = Context(prec=700)  # holds the product of any two numbers


class Bound(NamedTuple):
    """A bound that is shown, rounded to the side that says less: read as a number it never says more than `value`.

    value : SI; None where nothing is proven
    rounding : of the last digit, `decimal.ROUND_FLOOR` or `decimal.ROUND_CEILING`
    endless : word for an infinite one

    >>> at_least(0.99999).percent(), at_most(1.00001).percent(), at_most(2.10542).text()
    ('99.99 %', '100.01 %', '2.106')
    """

    value: float | None
    rounding: str
    endless: str

    def percent(self, factor: float = 1.0, unit: str = " %") -> str:
        """It as a share, times a factor: `99.62 %`; unit: "" for a column that is headed with it."""
        if word := self._word:
            return word
        return str(self._round(self._times(100 * factor), -PLACES)) + unit

    def text(self, digits: int = DIGITS, factor: float = 1.0) -> str:
        """It with so many digits, in a unit that has `factor` to one of SI."""
        if word := self._word:
            return word
        number = self._times(factor)
        return f"{float(self._round(number, number.adjusted() + 1 - digits)):.{digits}g}"

    @property
    def _word(self) -> str:
        if self.value is None:
            return "nothing"
        return "" if math.isfinite(self.value) else "none" if math.isnan(self.value) else self.endless

    def _times(self, factor: float) -> Decimal:
        """The shortest decimals that read back as the value, 0.9962 for 0.9962, times a factor without rounding."""
        return EXACT_CONTEXT.multiply(Decimal(repr(float(self.value or 0.0))), Decimal(repr(float(factor))))

    def _round(self, number: Decimal, power: int) -> Decimal:
        return number.quantize(Decimal(1).scaleb(power), self.rounding, EXACT_CONTEXT)


def at_least(value: float | None) -> Bound:
    """A bound from below, as a proven margin.

    >>> at_least(0.9962).percent(), at_least(3.49999).text(), at_least(None).percent()
    ('99.62 %', '3.499', 'nothing')
    """
    return Bound(value, ROUND_FLOOR, "any")


def at_most(value: float | None) -> Bound:
    """A bound from above, as the margin at which a loop is lost or a proven peak.

    >>> at_most(0.9962).percent(), at_most(float("inf")).percent()
    ('99.62 %', 'not found')
    """
    return Bound(value, ROUND_CEILING, "not found")
