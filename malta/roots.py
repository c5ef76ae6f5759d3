"""Where a function of one number changes its sign."""

from __future__ import annotations

import sys
from collections.abc import Callable

STEPS = 200  # at most


def sign_change(f: Callable[[float], float], low: float, high: float, width: float = 0.0) -> float:
    """Find where a continuous function changes its sign, to `width` or to the last digits.

    By regula falsi; an end that stays twice counts half (Illinois), and every fourth step halves the interval.
    scipy.optimize, which has a search like it, takes 0.1 s to load.

    Raises ValueError for ends of the same sign.

    >>> f"{sign_change(lambda x: x * x - 2, 0.0, 2.0):.14f}"
    '1.41421356237310'
    """
    ends, values = [low, high], [f(low), f(high)]
    if values[0] * values[1] > 0:
        raise ValueError(f"no change of sign from {low} to {high}")
    weights, moved = list(values), -1
    for step in range(STEPS):
        least = max(width, 2 * sys.float_info.epsilon * max(map(abs, ends)))
        if 0.0 in values or ends[1] - ends[0] <= least:
            break
        falsi = (ends[0] * weights[1] - ends[1] * weights[0]) / (weights[1] - weights[0])
        middle = min(
            max(falsi, ends[0] + least / 2), ends[1] - least / 2
        )  # a root near one end: just beyond it
        if step % 4 == 3 or not ends[0] < middle < ends[1]:
            middle = (ends[0] + ends[1]) / 2
        value = f(middle)
        k = int((value > 0) == (values[1] > 0))  # the end that moves
        weights[1 - k] *= 0.5 if k == moved else 1.0
        ends[k], values[k], weights[k], moved = middle, value, value, k
    return ends[int(abs(values[1]) <= abs(values[0]))]
