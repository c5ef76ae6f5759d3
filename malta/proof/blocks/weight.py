"""The size of unmodelled dynamics: a weight W(s), expanded on intervals of frequency.

On a cell (branch, from, to) of the search, x = x0 + h t with -1 <= t <= 1 is v / 2^scale or its inverse, and

    W = W_0 + W_1 t + rest,

as the quotient of Taylor's expansions of numerator and denominator. v is the frequency of a continuous loop; of a
sampled one v = tan(w T / 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.proof.arguments import describe, is_number

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray


class Expanded(NamedTuple):
    """W on cells: W_0 + W_1 t, and a bound of the error."""

    value: ComplexArray
    slope: ComplexArray
    rest: FloatArray

    def times(self, share: float) -> Expanded:
        return Expanded(share * self.value, share * self.slope, share * self.rest * (1 + 1e-12))


@dataclass(frozen=True, eq=False)
class Weight:
    """W = num / den, coefficients in s, the lowest power first."""

    num: FloatArray
    den: FloatArray

    @property
    def most(self) -> float:
        """An upper bound of |W| at all frequencies; infinite when it is not a number."""
        return float(abs(self.num[0] / self.den[0])) if len(self.den) == 1 else math.inf

    def at(self, w: FloatArray) -> FloatArray:
        """|W(jw)|."""
        s = 1j * np.asarray(w, dtype=float)
        return np.abs(np.polyval(self.num[::-1], s) / np.polyval(self.den[::-1], s))

    def on(self, cells: FloatArray, scale: int, T: float | None) -> Expanded:
        """W on cells (rows of branch, from, to) in units of 2^scale; T: sample time, s."""
        x, h = (cells[:, 2] + cells[:, 1]) / 2, (cells[:, 2] - cells[:, 1]) / 2 * (1 + 1e-12)
        none = np.zeros(len(cells), dtype=complex)
        if len(self.den) == 1:
            return Expanded(none + self.num[0] / self.den[0], none, none.real)
        inverse = cells[:, 0] == 1
        if T is not None:
            unit = np.where(inverse, 2.0**-scale, 2.0**scale)
            v, end = x * unit, (np.abs(x) + h) * unit
            z = np.where(inverse, math.pi / 2 - np.arctan(v), np.arctan(v)) * 2 / T
            slope = none + h * unit / (1 + v**2) * 2 / T * np.where(inverse, -1, 1)
            bent = (h * unit) ** 2 * end / (1 + np.maximum(v - h * unit, 0) ** 2) ** 2 * 2 / T
            num, den = self.num * _turns(self.num, 0), self.den * _turns(self.den, 0)
            return _quotient(num, den, z, slope.astype(complex), bent)
        found = [
            _quotient(num * _turns(num, power, turn), den * _turns(den, power, turn), x, h + 0j, none.real)
            for num, den, power, turn in (
                (self.num, self.den, scale, 1j),
                (self.num[::-1], self.den[::-1], -scale, -1j),
            )
        ]
        return Expanded(*(np.where(inverse, high, low) for low, high in zip(*found, strict=True)))


def _turns(c: FloatArray, power: int, turn: complex = 1j) -> ComplexArray:
    """s^k = (turn 2^power)^k x^k."""
    k = np.arange(len(c))
    return np.asarray(turn**k * 2.0 ** (power * k))


def _quotient(
    num: ComplexArray, den: ComplexArray, z: FloatArray, slope: ComplexArray, bent: FloatArray
) -> Expanded:
    """num / den at z + slope t + rest, |rest| <= bent."""
    n, d = _taylor(num, z, slope, bent), _taylor(den, z, slope, bent)
    value = n.value / d.value
    rate = (n.slope - value * d.slope) / d.value
    room = np.abs(d.value) - np.abs(d.slope) - d.rest
    left = n.rest + np.abs(value) * d.rest + np.abs(rate) * (np.abs(d.slope) + d.rest)
    with np.errstate(divide="ignore", invalid="ignore"):
        return Expanded(value, rate, np.where(room > 0, left / room, np.inf) * (1 + 1e-9))


def _taylor(c: ComplexArray, z: FloatArray, slope: ComplexArray, bent: FloatArray) -> Expanded:
    """A polynomial at z + slope t + rest; higher terms and rounding in the bound."""
    far = np.abs(slope) + bent
    derived, terms = np.polynomial.Polynomial(c), list[Any]()
    for m in range(len(c)):
        terms.append(derived(z) / math.factorial(m))
        derived = derived.deriv()
    first = terms[1] if len(terms) > 1 else 0 * terms[0]
    rest = np.abs(first) * bent + sum(np.abs(x) * far ** (m + 2) for m, x in enumerate(terms[2:]))
    rounding = 1e-13 * np.polynomial.polynomial.polyval(np.abs(z) + far, np.abs(c))
    return Expanded(np.asarray(terms[0], dtype=complex), first * slope, rest * (1 + 1e-12) + rounding)


def weight_of(weight: Any, where: str) -> Weight:
    """W as a record. Raises InputError for anything but a positive number or a stable, proper W(s)."""
    expected = "a number above zero, or a transfer function"
    if is_number(weight):
        if not float(weight) > 0:
            raise InputError(where, "weight", describe(weight), expected)
        return Weight(np.array([float(weight)]), np.ones(1))
    if type(weight).__name__ == "StateSpace":
        weight = _transfer_function(weight)
    try:
        single = np.shape(weight.num)[:2] == (1, 1) or (len(weight.num), len(weight.num[0])) == (1, 1)
        num, den = (np.asarray(c[0][0], dtype=float) for c in (weight.num, weight.den))
        with np.errstate(all="ignore"):
            stable, continuous = bool((weight.poles().real < 0).all()), not weight.dt
    except (AttributeError, TypeError, ValueError, IndexError, np.linalg.LinAlgError):
        raise InputError(where, "weight", describe(weight), expected) from None
    if not single:
        raise InputError(where, "weight", "several inputs or outputs", "one of each")
    num, den = np.trim_zeros(num, "f"), np.trim_zeros(den, "f")
    known = len(num) and np.isfinite([*num, *den]).all()
    if not (known and stable and continuous and len(num) <= len(den)):
        raise InputError(where, "weight", "not stable, not proper or discrete", "a stable, proper one in s")
    return Weight(np.concatenate([np.zeros(len(den) - len(num)), num])[::-1], den[::-1])


def _transfer_function(weight: Any) -> Any:
    import control

    return control.ss2tf(weight)
