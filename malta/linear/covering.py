"""A weight of low order that lies over given sizes: the transfer function that stands for what is known at lines.

W = g (1 + s/z) / (1 + s/p), or with pairs of zeros and poles: stable, of minimum phase, and proper either way. g is the
smallest gain with |W(jw_k)| >= bound_k at all k; zeros and poles make the mean of log |W(jw_k)| / bound_k small.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize

from malta.errors import InputError

if TYPE_CHECKING:
    from malta.arrays import FloatArray

MAX_PAIRS = 2  # of zeros and poles, where the bounds need them
GAIN_OF_ORDER = 0.1  # of the mean log excess, that a higher order has to take off
SLACK = 1e-9  # over the bounds, so that rounding does not take W below
DAMPING = (0.05, 5.0)  # of pairs
EVALUATIONS = 600  # of a search, for each of its variables


def covering_weight(w: FloatArray, bound: FloatArray) -> Any:
    """Find a weight W(s) of low order with |W(jw_k)| >= bound_k at all given frequencies.

    w : k frequencies, rad/s
    bound : sizes there, above 0

    Returns a control.TransferFunction: a constant, of first order, or with up to two pairs of zeros and poles; the
    lowest order that lies as tightly as the next one.

    Raises InputError for values that are not finite and above zero.

    >>> import numpy as np
    >>> from malta.linear.covering import covering_weight
    >>> w = np.geomspace(1, 1000, 20)
    >>> bound = 0.1 * np.abs(1 + 1j * w / 30)
    >>> W = covering_weight(w, bound)
    >>> ratio = np.abs(W(1j * w)) / bound
    >>> bool(ratio.min() >= 1), bool(ratio.max() < 1.1)
    (True, True)
    """
    import control  # imports matplotlib and takes a second: only where it is used

    w, bound = np.asarray(w, dtype=float).ravel(), np.asarray(bound, dtype=float).ravel()
    if not (
        w.size == bound.size > 0 and np.isfinite([w, bound]).all() and (w > 0).all() and (bound > 0).all()
    ):
        raise InputError("covering_weight", "bound", "no, unequal or infinite values", "sizes above 0 at w")
    unit = float(np.exp(np.log(w).mean()))
    s, b = 1j * w / unit, np.log(bound)

    def excess(num: FloatArray, den: FloatArray) -> tuple[float, float]:
        """The mean log excess, and the log of the gain that it takes."""
        off = np.log(np.abs(np.polyval(num, s) / np.polyval(den, s))) - b
        return float(off.mean() - off.min()), float(-off.min())

    one = np.ones(1)
    best: tuple[float, FloatArray, FloatArray] = (excess(one, one)[0], one, one)
    for start in _starts(np.abs(s)):
        found = _fit(excess, start, np.abs(s))
        if found[0] < best[0] - GAIN_OF_ORDER:
            best = found
    _, num, den = best
    num = num * math.exp(excess(num, den)[1]) * (1 + SLACK)
    # back to rad/s: coefficients of the highest power first
    return control.tf(*(c / unit ** np.arange(len(c) - 1, -1, -1.0) for c in (num, den)))


def _starts(w: FloatArray) -> list[FloatArray]:
    """Of each order the logarithms with which a search begins: a zero and a pole, or pairs with their dampings."""
    low, high = math.log(w.min()), math.log(w.max())
    ends = [np.array([low + 0.7 * (high - low), high]), np.array([low + 0.3 * (high - low), low])]
    pairs = [
        np.concatenate([[x - 0.2, 0.0, x, -1.0] for x in np.linspace(low, high, n + 2)[1:-1]])
        for n in range(1, MAX_PAIRS + 1)
    ]
    top = np.array([low + 0.6 * (high - low), 0.0, high, 0.0])
    return [*ends, top, *pairs]


def _fit(excess: Any, start: FloatArray, w: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """The mean log excess, and numerator and denominator of unit gain at zero, from a start on."""
    ends = math.log(w.min() / 10), math.log(w.max() * 10)

    def polynomials(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        at = np.exp(np.clip(x, *ends))
        if len(x) == 2:
            return np.array([1 / at[0], 1.0]), np.array([1 / at[1], 1.0])
        num, den = np.ones(1), np.ones(1)
        for k in range(0, len(x), 4):
            zeta = np.clip(np.exp(x[[k + 1, k + 3]]), *DAMPING)
            num = np.polymul(num, [1 / at[k] ** 2, 2 * zeta[0] / at[k], 1.0])
            den = np.polymul(den, [1 / at[k + 2] ** 2, 2 * zeta[1] / at[k + 2], 1.0])
        return num, den

    limit: Any = {"maxfev": EVALUATIONS * len(start), "xatol": 1e-3, "fatol": 1e-4}

    def mean(x: Any) -> float:
        return float(excess(*polynomials(x))[0])

    found: Any = minimize(mean, start, method="Nelder-Mead", options=limit)
    num, den = polynomials(found.x)
    return float(found.fun), num, den
