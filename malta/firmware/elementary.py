"""Elementary functions as polynomials of basic operations: every processor that adds by IEEE 754 gets the same bits.

Every C library rounds its sine in its own way. Here a function consists of +, -, *, /, comparisons and choices, of
which the standard fixes each bit, in an order that no compiler changes unless it is told to (-ffast-math, contraction).

    function     domain             largest error: double     float
    sine         |x| <= 1e5, 1e3    2.3e-16, absolute         1.2e-7
    cosine       |x| <= 1e5, 1e3    2.3e-16, absolute         1.2e-7
    exponential  -87 .. 87          2.5e-16, relative         1.3e-7; beyond the domain the value at its end
    arctangent   of y / x, any      4.5e-16, absolute         2.4e-7
    floor        |x| < 2^51, 2^22   0                         0

Arguments and results are CasADi SX; call these functions within `as_written()`, or CasADi cancels what rounding needs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import reduce
from typing import Any, Literal

import casadi as ca

Precision = Literal["double", "float"]
EDGE = 87.0  # of the exponential's domain: e^87 is the largest power of e that a float holds


@contextmanager
def as_written() -> Iterator[None]:
    """CasADi keeps expressions as they are written: (x + s) - s does not become x."""
    before = ca.GlobalOptions.getSimplificationOnTheFly()
    ca.GlobalOptions.setSimplificationOnTheFly(False)
    try:
        yield
    finally:
        ca.GlobalOptions.setSimplificationOnTheFly(before)


@dataclass(frozen=True)
class Elementary:
    """The functions of one precision; coefficients are minimax polynomials (Remez), rounded to that precision."""

    shift: float  # 1.5 times 2 to the bits of the significand: adding it rounds to a whole number
    pi: tuple[float, ...]  # parts that add up to pi, of so few bits that a whole number times a part is exact
    ln2: tuple[float, ...]
    sines: tuple[float, ...]  # (sin(r) / r - 1) / r^2 in powers of r^2, |r| up to pi/2
    exponentials: tuple[float, ...]  # (e^r - 1 - r) / r^2 in powers of r, |r| up to ln(2) / 2
    arctangents: tuple[float, ...]  # (atan(r) / r - 1) / r^2 in powers of r^2, |r| up to tan(pi/8)

    def rounded(self, x: Any) -> Any:
        """The nearest whole number; halves go to the even one."""
        return (x + self.shift) - self.shift

    def floor(self, x: Any) -> Any:
        """The largest whole number that is not above x."""
        n = self.rounded(x)
        return ca.if_else(x < n, n - 1, n)

    def sine(self, x: Any) -> Any:
        """sin(x) = (-1)^n sin(x - n pi) with the nearest n."""
        return self._wave(x, self.rounded(x * (1 / math.pi)), 0.0)

    def cosine(self, x: Any) -> Any:
        """cos(x) = sin(x + pi/2) = (-1)^n sin(x - (n - 1/2) pi)."""
        return self._wave(x, self.rounded(x * (1 / math.pi) + 0.5), 0.5)

    def _wave(self, x: Any, n: Any, half: float) -> Any:
        turns = n - half if half else n
        r = reduce(lambda rest, part: rest - turns * part, self.pi, x)
        odd = n * 0.5 - self.rounded(n * 0.5)  # -1/2 or 1/2 for odd n, else 0
        t = r * r
        return (r + r * (t * polynomial(self.sines, t))) * (1 - 8 * (odd * odd))

    def exponential(self, x: Any) -> Any:
        """e^x = 2^n e^(x - n ln 2) with the nearest n; x is taken within the domain."""
        x = ca.fmax(ca.fmin(x, EDGE), -EDGE)
        n = self.rounded(x * (1 / math.log(2)))
        r = reduce(lambda rest, part: rest - n * part, self.ln2, x)
        return (1 + (r + r * r * polynomial(self.exponentials, r))) * _power_of_two(n)

    def arctangent(self, y: Any, x: Any) -> Any:
        """The angle of the point (x, y), in [-pi, pi]; 0 at the origin."""
        a, b = ca.fabs(y), ca.fabs(x)
        low, high = ca.fmin(a, b), ca.fmax(a, b)
        q = low / ca.if_else(high > 0, high, 1)
        steep = q > math.tan(math.pi / 8)
        r = ca.if_else(steep, (q - 1) / (q + 1), q)
        t = r * r
        angle = ca.if_else(steep, math.pi / 4, 0) + (r + r * (t * polynomial(self.arctangents, t)))
        angle = ca.if_else(a > b, math.pi / 2 - angle, angle)
        angle = ca.if_else(x < 0, math.pi - angle, angle)
        return ca.if_else(y < 0, -angle, angle)


def polynomial(coefficients: tuple[float, ...], t: Any) -> Any:
    """Horner's scheme; the coefficient of the lowest power first."""
    return reduce(lambda value, c: c + t * value, coefficients[-2::-1], ca.SX(coefficients[-1]))


def _power_of_two(n: Any) -> Any:
    """2^n for a whole number n, |n| < 128, as a product of powers for the binary digits of |n|."""
    left, factor = ca.fabs(n), ca.SX(1)
    for digit in range(6, -1, -1):
        up = 2.0 ** (2**digit)
        has = left >= 2**digit
        factor *= ca.if_else(has, ca.if_else(n < 0, 1 / up, up), 1)
        left -= ca.if_else(has, 2**digit, 0)
    return factor


ELEMENTARY: dict[Precision, Elementary] = {
    "double": Elementary(
        shift=1.5 * 2**52,
        pi=(3.1415926534682512, 1.2154201012607932e-10, 4.044532497591901e-21),
        ln2=(0.6931471806019545, -4.200915072890502e-11, 2.0941744292700725e-21),
        sines=(
            *(-0.16666666666666666, 0.008333333333333316, -0.00019841269841254982, 2.755731921916461e-06),
            *(-2.505210761710018e-08, 1.605897731537374e-10, -7.643970286287713e-13, 2.731443529317799e-15),
        ),
        exponentials=(
            *(0.5000000000000001, 0.16666666666666674, 0.04166666666662382, 0.00833333333332212),
            *(0.0013888888917367593, 0.00019841269886848863, 2.4801521057447296e-05, 2.755724205886447e-06),
            *(2.762020173029291e-07, 2.5110149838822772e-08),
        ),
        arctangents=(
            *(-0.33333333333333254, 0.19999999999903234, -0.14285714266830954, 0.11111109679581514),
            *(-0.0909085382136565, 0.07691076011426169, -0.06649815716362417, 0.057374725614175615),
            *(-0.04486805174954979, 0.022794521873363453),
        ),
    ),
    "float": Elementary(
        shift=1.5 * 2**23,
        pi=(3.1416015625, -8.907169103622437e-06, -1.7411032e-09),
        ln2=(0.693115234375, 3.1948089599609375e-05, -1.9046542e-09),
        sines=(-0.16666666, 0.0083332425, -0.00019822776, 2.6348505e-06),
        exponentials=(0.5, 0.16666576, 0.041666374, 0.008363235, 0.0013941204),
        arctangents=(-0.3333333, 0.19999558, -0.14264451, 0.10748238, -0.06464761),
    ),
}
