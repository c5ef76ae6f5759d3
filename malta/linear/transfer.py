"""A transfer function as a system with all of its poles: those that zeros cancel, too.

    G(s) = k  product of sections (s - z) / (s - p) or g / (s - p), of one or two poles each, the fastest first

The sections are in series, so that A is block triangular and the poles stand on its diagonal: those of wide spectra and
of clusters keep their digits, and a pole that a zero cancels stays a state. Roots are those of the coefficients as they
are, computed with enough digits. A sampled function gives them in differences, where slow poles lie close to 0.
"""

from __future__ import annotations

import cmath
import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from flint import acb, acb_poly, arb, ctx, fmpq, fmpq_poly

from malta.errors import InputError
from malta.linear.interconnection import append, connect, gain, series
from malta.linear.minimal import minimal
from malta.linear.system import System

BITS = 512  # of roots and sections
ROUNDING = 1e-12  # of a pole: what its growth may be by the rounding of coefficients
ZERO = 1e-300  # stands for zero in ratios
POLE_DISTANCE = 1e-6  # relative distance of poles that are the same, to the rounding of coefficients


def realize(num: Sequence[Sequence[Any]], den: Sequence[Sequence[Any]], dt: float | None = None) -> System:
    """The system of a matrix of transfer functions, coefficients of the highest power first.

    num, den : one row for each output, one polynomial for each input
    dt : s, sample time of functions of z; the system is in differences then, of the variable (z - 1) / dt

    Entries of one column, or of one row, share states where all of their poles are the same. Where poles that grow
    still come out more often than in any entry, the system is made minimal.

    Raises InputError for improper and complex ones, and where poles that grow would be lost.

    >>> from malta.linear.transfer import realize
    >>> hidden = realize([[[1.0, -1.0]]], [[[1.0, 1.0, -2.0]]])  # (s - 1) / (s - 1) / (s + 2)
    >>> sorted(hidden.poles.real.tolist())
    [-2.0, 1.0]
    """
    with ctx.workprec(BITS):
        entries = [
            [_polynomials(n, d, dt) for n, d in zip(*row, strict=True)] for row in zip(num, den, strict=True)
        ]
        by_column = _group(entries, columns=True)
        by_row = _group(entries, columns=False)
    found = by_row if len(by_row.A) < len(by_column.A) else by_column
    if len(entries) * len(entries[0]) > 1:
        found = _without_copies(found, entries, dt or 0.0)
    if not all(np.isfinite(M).all() for M in found):
        raise InputError("TransferFunction", "num, den", "numbers that overflow", "coefficients of like size")
    return found


Polynomial = Any  # a flint.fmpq_poly


def _polynomials(num: Any, den: Any, dt: float | None) -> tuple[Polynomial, Polynomial]:
    """Both with exact coefficients; of z in the variable (z - 1) / dt."""
    made = []
    for coefficients in (num, den):
        values = np.atleast_1d(np.asarray(coefficients))
        if np.iscomplexobj(values) or not np.isfinite(values.astype(float)).all():
            kind = "complex coefficients" if np.iscomplexobj(values) else "NaN or infinity"
            raise InputError("TransferFunction", "num, den", kind, "finite real coefficients")
        exact = fmpq_poly([_exact(x) for x in values[::-1]])
        made.append(exact if dt is None else exact(fmpq_poly([1, _exact(dt)])))
    if not made[1]:
        raise InputError("TransferFunction", "den", "0", "a polynomial that is not 0")
    if made[0].degree() > made[1].degree():
        found = f"more zeros than poles, {made[0].degree()} over {made[1].degree()}"
        raise InputError("TransferFunction", "num", found, "a proper one")
    return made[0], made[1]


def _exact(x: Any) -> fmpq:
    return fmpq(*float(x).as_integer_ratio())


def _group(entries: list[list[tuple[Polynomial, Polynomial]]], *, columns: bool) -> System:
    """The system of all entries; those of one column, or row, with the same poles share their states."""
    p, m = len(entries), len(entries[0])
    lines = [[(i, j) for j in range(m)] for i in range(p)]
    if columns:
        lines = [list(line) for line in zip(*lines, strict=True)]
    parts, into, out = [], [], []
    for line in lines:
        groups: dict[str, list[tuple[int, int]]] = {}
        for i, j in line:
            den = entries[i][j][1]
            groups.setdefault(str(den / den.leading_coefficient()), []).append((i, j))
        for places in groups.values():
            several = [entries[i][j] for i, j in places]
            one = (
                _sections(*several[0]) if len(places) == 1 else _chain([n for n, _ in several], several[0][1])
            )
            if not columns and len(places) > 1:
                A, B, C, D = one
                one = System(A.T, C.T, B.T, D.T)
            parts.append(one)
            into += list(dict.fromkeys(j for _, j in places))
            out += list(dict.fromkeys(i for i, _ in places))
    whole = append(*parts)
    return connect(whole, np.zeros(whole.D.shape[::-1]), np.eye(m)[into], np.eye(p)[:, out])


def _without_copies(found: System, entries: list[list[tuple[Polynomial, Polynomial]]], dt: float) -> System:
    """The system, minimal where poles that grow are in it more often than in any entry.

    An entry that cancels such a pole keeps the states as they are. Raises InputError where minimal states lose one.
    """
    every = [entry for row in entries for entry in row]
    with ctx.workprec(BITS):
        poles = [np.array([_round(p) for p in _roots(den)]) for _, den in every]
        growing = [
            (p, num)
            for (num, _), own in zip(every, poles, strict=True)
            for p in own
            if p.real + 0.5 * dt * abs(p) ** 2 >= -ROUNDING * abs(p)
        ]
        hidden = any(_cancels(num, p) for p, num in growing)

    def times(of: Any, p: complex) -> int:
        return int((np.abs(np.asarray(of) - p) <= POLE_DISTANCE * abs(p)).sum())

    wanted = [(p, max(times(own, p) for own in poles)) for p, _ in growing]
    if hidden or all(times(found.poles, p) == count for p, count in wanted):
        return found
    smaller = minimal(found).system
    if any(times(smaller.poles, p) < count for p, count in wanted):
        several = "poles that grow, in several entries"
        raise InputError("TransferFunction", "den", several, "a control.StateSpace, which has their states")
    return smaller


def _cancels(num: Polynomial, p: complex) -> bool:
    """Whether a numerator is zero at a pole, to the rounding of its coefficients."""
    sizes = [float(abs(arb(c))) * abs(p) ** k for k, c in enumerate(num.coeffs())]
    return abs(_round(acb_poly([acb(c) for c in num.coeffs()])(acb(p)))) <= POLE_DISTANCE * sum(sizes)


def _roots(polynomial: Polynomial) -> list[acb]:
    return [root for root, times in polynomial.complex_roots() for _ in range(times)]


def _round(x: acb) -> complex:
    """A number as a double one; a part that may be zero is zero."""
    return complex(*(0.0 if part.contains(0) else float(part.mid()) for part in (x.real, x.imag)))


def _split_roots(polynomial: Polynomial) -> tuple[list[list[acb]], list[acb]]:
    """Pairs of conjugate roots, and real roots, the largest first."""
    roots = sorted(_roots(polynomial), key=lambda r: -abs(_round(r)))
    return [[r, r.conjugate()] for r in roots if r.imag > 0], [r for r in roots if r.imag == 0]


def _sections(num: Polynomial, den: Polynomial) -> System:
    """One transfer function as sections in series, each with zeros near its poles."""
    pairs, reals = _split_roots(den)
    zero_pairs, zeros = _split_roots(num) if num else ([], [])
    joined = 2 * max(len(zero_pairs) - len(pairs), 0)  # real poles that a pair of zeros needs
    poles = pairs + [reals[k : k + 2] for k in range(0, joined, 2)] + [[p] for p in reals[joined:]]
    taken: list[list[acb]] = [[] for _ in poles]
    for left in (zero_pairs, [[z] for z in zeros]):
        while left:
            free = [k for k, own in enumerate(poles) if len(own) - len(taken[k]) >= len(left[0])]
            near = {(i, k): _apart(left[i], poles[k]) for i in range(len(left)) for k in free}
            i, k = min(near, key=lambda pair: near[pair])
            taken[k] += left.pop(i)
    order = sorted(range(len(poles)), key=lambda k: -abs(_round(poles[k][0])))
    size = num.coeffs()[-1] / den.coeffs()[-1] if num else fmpq(0)
    made = []
    for own, of in ((poles[i], taken[i]) for i in order):
        g = _unit(own)
        n = _times([acb(g) ** (len(own) - len(of))], *([-z, acb(1)] for z in of))
        direct = len(of) == len(own)
        if direct:
            n = [a - b for a, b in zip(n, _times(*([-p, acb(1)] for p in own)), strict=True)]
        size /= fmpq(*g.as_integer_ratio()) ** (len(own) - len(of))
        made.append(_section(own, n, g, float(direct)))
    found = series(gain(np.eye(1)), *made)
    return System(found.A, found.B, float(arb(size)) * found.C, float(arb(size)) * found.D)


def _apart(zeros: list[acb], poles: list[acb]) -> float:
    """How far a zero is from the nearest pole, in ratios: gains of the sections stay as near 1 as they can."""
    logs = ([cmath.log(_round(x) or ZERO) for x in roots] for roots in (zeros[:1], poles))
    return min(abs(z - p) for z, p in itertools.product(*logs))


def _chain(nums: list[Polynomial], den: Polynomial) -> System:
    """Several numerators over one denominator: one chain of sections without zeros, read by all outputs.

    Division by the sections from the last to the first leaves what each output reads of them (Newton's form).
    """
    pairs, reals = _split_roots(den)
    poles = sorted([*pairs, *([p] for p in reals)], key=lambda own: -abs(_round(own[0])))
    units = [_unit(own) for own in poles]
    starts = np.cumsum([0, *(len(own) for own in poles)])
    n = int(starts[-1])
    A, B, C, D = np.zeros((n, n)), np.zeros((n, 1)), np.zeros((len(nums), n)), np.zeros((len(nums), 1))
    for k, (own, g) in enumerate(zip(poles, units, strict=True)):
        at = slice(starts[k], starts[k + 1])
        section = _section(own, [acb(1)], g, 0.0)
        A[at, at] = section.A
        if k:
            last = starts[k] - 1 if len(poles[k - 1]) == 1 or poles[k - 1][0].imag == 0 else starts[k] - 2
            A[at, last] = section.B[:, 0]
        else:
            B[at] = section.B
    for i, num in enumerate(nums):
        lead = den.coeffs()[-1]
        through = num.coeffs()[n] / lead if num.degree() == n else fmpq(0)
        D[i, 0] = float(arb(through))
        rest = acb_poly([acb(c) for c in ((num - through * den) / lead).coeffs()])
        before = np.cumsum([0, *(len(own) * math.log2(g) for own, g in zip(poles, units, strict=True))])
        for k in reversed(range(len(poles))):
            rest, left = divmod(rest, acb_poly(_times(*([-p, acb(1)] for p in poles[k]))))
            scale = acb(2) ** -int(before[k])
            C[i, starts[k] : starts[k + 1]] = _section(
                poles[k], [c * scale for c in left.coeffs()], units[k], 0.0
            ).C[0]
    return System(A, B, C, D)


def _unit(poles: list[acb]) -> float:
    """A power of two near the size of some poles."""
    size = abs(_round(poles[0]))
    return 2.0 ** round(math.log2(size)) if size else 1.0


def _times(*factors: list[acb]) -> list[acb]:
    """The coefficients of a product of polynomials, lowest first."""
    found = acb_poly([1])
    for one in factors:
        found = found * acb_poly(one)
    return list(found.coeffs())


def _section(poles: list[acb], n: list[acb], g: float, direct: float) -> System:
    """direct + (n_1 s + n_0) / ((s - p_1) (s - p_2)), or of one pole; states in units in which they are near u.

    States: g / (s - p); of two real poles then g^2 / both; of a pair g^2 / both and g (s - Re p) / both.
    """
    n0, n1 = (acb(n[k]) if k < len(n) else acb(0) for k in (0, 1))
    p, q = poles[0], poles[-1]
    B, none = [g, 0.0][: len(poles)], acb(0)
    if len(poles) == 1:
        A, C = [[p]], [n0 / g]
    elif p.imag == 0:
        A, C = [[p, none], [acb(g), q]], [n1 / g, (n0 + n1 * q) / g**2]
    else:
        A, B = [[acb(p.real), acb(g)], [acb(-(p.imag**2) / g), acb(p.real)]], [0.0, g]
        C = [(n0 + n1 * p.real) / g**2, n1 / g]
    made = ([[_round(x).real for x in row] for row in M] for M in (A, [C]))
    A_made, C_made = (np.array(M) for M in made)
    return System(A_made, np.array(B)[:, None], C_made, np.array([[direct]]))
