"""How a certificate splits a loop: groups of states, the sizes in which couplings between these count least, and v."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from flint import arb
from scipy import linalg, sparse

from malta.proof.box import Box
from malta.proof.certificate.checked_file import Loop
from malta.proof.certificate.checked_loop import SIDES, Polynomial, Table, balanced, height, split

SMALL = 1e-11  # relative, of couplings that may be rounding


def groups_of(loop: Loop, t: dict[str, Table], box: Box) -> list[dict[str, Any]]:
    """States that act on one another.

    A group is only acted on by those before it; or couplings that are rounding are left between groups.
    """
    n, count = loop.states, loop.states + len(loop.law[0])
    at = [arb(x) for x in box.nominal.tolist()]
    size = np.full((count, count), -np.inf)
    for name, (row, column) in SIDES.items():
        for (i, j), r in t[name].items():
            size[n * row + i, n * column + j] = max(height(r.at(at)), -1000.0)
    touch = np.isfinite(size)
    _, (scales, _) = linalg.matrix_balance(np.exp2(size), permute=False, separate=True)
    size += np.log2(scales) - np.log2(scales)[:, None]
    level = (size.max(axis=1)[:, None] + size.max(axis=0)[None, :]) / 2
    large = touch & (size > math.log2(SMALL) + level)
    if loop.held:
        for i, j in t["A"]:
            large[i, j] = True
    number, label = sparse.csgraph.connected_components(touch, directed=True, connection="strong")
    _, apart = sparse.csgraph.connected_components(large, directed=False)
    if any(len(set(apart[label == g].tolist())) > 1 for g in range(number)):
        order, label = list(dict.fromkeys(apart.tolist())), apart
    else:
        order = _ordered(touch, label, number)
    members = [np.flatnonzero(label == g).tolist() for g in order]
    return [
        {
            "states": [i for i in own if i < n],
            "own": [i - n for i in own if i >= n],
            "inverted": [False] * len(box.names),
            "parts": [],
        }
        for own in members
    ]


def units_of(read: Callable[[], Loop], described: dict[str, Any], box: Box) -> list[int]:
    """log2 of sizes of the states in which couplings between groups count least."""
    loop = read()
    n, best = loop.states, (math.inf, [0] * (loop.states + len(loop.law[0])))
    polynomials = split(loop)
    if not any(f.dust for f in polynomials):
        return best[1]
    at = [
        [arb(1 / x if inv else x) for x, inv in zip(box.nominal.tolist(), f.group.inverted, strict=True)]
        for f in polynomials
    ]
    for share in (0.0, 0.25, 0.5, 0.75):
        units = [0] * len(best[1])
        for f, v in zip(polynomials, at, strict=True):
            for i, d in zip(f.group.members(n), _lengths(f, v, share), strict=True):
                units[i] = d
        for _ in range(4):
            described["units"] = units
            ratios = [_ratio(f, v) for f, v in zip(split(read()), at, strict=True)]
            best = min(best, (max(ratios), list(units)))
            for f, ratio in zip(polynomials, ratios, strict=True):
                for i in f.group.members(n):
                    units[i] += round((ratio - min(ratios)) / 2)
    return best[1]


def _lengths(f: Polynomial, v: list[Any], share: float) -> list[int]:
    """log2 of the states' sizes where |g| has a place among the sizes of the entries."""
    m, dynamic = f.sizes(v)
    known = sorted(height(x) for row in m for x in row if x > 0)
    g = known[int(share * (len(known) - 1))]
    logs = [
        (i, j, max(height(x), g) if i == j and dynamic[i] else height(x))
        for i, row in enumerate(m)
        for j, x in enumerate(row)
        if x > 0 or (i == j and dynamic[i])
    ]
    d = [0.0] * len(m)
    for _ in range(8):
        d = balanced(len(m), logs, d)
    own = len(f.group.own)
    return [round(x) for x in (*d[: len(f.group.states)], *d[len(d) - own :])]


def _ratio(f: Polynomial, v: list[Any]) -> float:
    """log2 of how large couplings between groups are beside the coefficients."""
    return max(
        (height(b) - height(a) for a, b in zip(f.at(v), f.moved(v), strict=False) if b > 0), default=-1000.0
    )


def _ordered(touch: Any, label: Any, number: int) -> list[int]:
    """Strongly connected groups, each acted on by those before it alone."""
    left, order = set(range(number)), []
    while left:
        ready = sorted(
            g
            for g in left
            if not any((label[touch[i]] == h).any() for i in np.flatnonzero(label == g) for h in left - {g})
        )
        order += ready
        left -= set(ready)
    return order


def divides(f: Polynomial, i: int) -> bool:
    """Whether the entries are polynomials of 1 / p_i, as of an inertia; q takes other denominators."""
    found = list(f.tables["A"].values())
    below = [{m[i] for m in r.den.monoms()} for r in found]
    return any(max(b) > 0 for b in below) and all(
        len(b) == 1 and r.num.degrees()[i] <= max(b) for r, b in zip(found, below, strict=True)
    )
