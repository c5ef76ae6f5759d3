"""Enclosures of the characteristic function f(s; p) of a loop, over boxes of parameters and intervals of frequency.

    f(s; p) = det( N(s; p) - B(p) H(s) F(s) C(s; p) ),   N = s^2 - s A22 - A21  (or s - A)

Along frequency every quantity is c + g e with e in [-1, 1] and a disk that holds the rest (first-order Taylor models).
Along the parameters f is a polynomial: its Bernstein coefficients over a box hold its values there.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg

from malta.uncertain import Compensator, UncertainSystem, differences

if TYPE_CHECKING:
    from malta.plant import ComplexArray, FloatArray

GUARD = 1e-9  # what floating point may err, in an angle
ROUNDING = 1e-11  # relative to the terms of f; 1e-13 is seen


@dataclass(frozen=True, eq=False)
class Block:
    """One factor of the characteristic function: some positions of the plant, some states of the compensator."""

    system: UncertainSystem
    own: Compensator  # restricted to the states of this group
    states: tuple[int, ...]  # of the plant: positions where it is of second order


@dataclass(frozen=True, eq=False)
class Taylor:
    """Values on intervals: c + g e + (a disk of radius r), e in [-1, 1] along the interval. Complex arrays, r real."""

    c: ComplexArray
    g: ComplexArray
    r: FloatArray

    def __add__(self, other: Any) -> Taylor:
        if isinstance(other, Taylor):
            return Taylor(self.c + other.c, self.g + other.g, self.r + other.r)
        return Taylor(self.c + other, self.g, self.r)

    def __mul__(self, other: Any) -> Taylor:
        if not isinstance(other, Taylor):
            return Taylor(self.c * other, self.g * other, self.r * np.abs(other))
        a, b = self, other
        spread = (np.abs(a.g) + a.r) * (np.abs(b.g) + b.r)
        return Taylor(a.c * b.c, a.c * b.g + a.g * b.c, np.abs(a.c) * b.r + a.r * np.abs(b.c) + spread)

    __radd__, __rmul__ = __add__, __mul__

    def __neg__(self) -> Taylor:
        return Taylor(-self.c, -self.g, self.r)

    def __sub__(self, other: Any) -> Taylor:
        return self.__add__(-other)

    def __getitem__(self, key: Any) -> Taylor:
        return Taylor(self.c[key], self.g[key], self.r[key])

    def size(self) -> FloatArray:
        """Largest absolute value."""
        return np.asarray(np.abs(self.c) + np.abs(self.g) + self.r)

    def conj(self) -> Taylor:
        return Taylor(self.c.conj(), self.g.conj(), self.r)

    def inverse(self) -> Taylor:
        """1/c - g/c^2 e, off by at most |g|^2 / (|c|^2 min |c + g e|); infinite where zero is near."""
        size = np.abs(self.c)
        along = np.where(self.g == 0, 0, -self.c / np.where(self.g == 0, 1, self.g)).real
        nearest = np.abs(self.c + self.g * np.clip(along, -1, 1))
        curved = np.abs(self.g) ** 2 / (size**2 * nearest)
        disk = np.where(nearest > self.r, self.r / (nearest * (nearest - self.r)), np.inf)
        return Taylor(1 / self.c, -self.g / self.c**2, curved + np.where(self.r == 0, 0, disk))

    def mapped(self, matrix: Any, rule: str) -> Taylor:
        """Linear in it: einsum of constants with it."""
        return Taylor(
            np.einsum(rule, matrix, self.c),
            np.einsum(rule, matrix, self.g),
            np.einsum(rule, np.abs(matrix), self.r),
        )


class Frequencies(NamedTuple):
    """s = sigma / tau on intervals, homogeneous so that infinity is a number; what a sampled loop has at z."""

    sigma: Taylor
    tau: Taylor
    scale: Taylor  # that f is multiplied by, once a position, for the integrators: s, (z - 1) / T or 1
    delta: Taylor | None  # (z - 1) / T of a sampled loop


def frequencies(c: Compensator, cells: FloatArray) -> Frequencies:
    """cells: rows of branch, from, to. Branch 0 counts in w, branch 1 in 1/w."""
    branch, middle, half = cells[:, 0], cells[:, 1:].mean(axis=1), np.diff(cells[:, 1:])[:, 0] / 2
    zero, one = np.zeros(len(cells)), np.ones(len(cells))
    low = branch == 0
    sigma = Taylor(1j * np.where(low, middle, 1), 1j * np.where(low, half, 0), zero)
    tau = Taylor(np.where(low, 1.0, middle) + 0j, np.where(low, 0.0, half) + 0j, zero)
    scale, delta = Taylor(one + 0j, zero + 0j, zero), None
    if c.sample_time is not None:
        T = c.sample_time
        turn = np.exp(1j * middle * T)
        delta = Taylor(np.expm1(1j * middle * T) / T, 1j * half * turn, T * half**2 / 2)
    if c.integrals:
        scale = delta or Taylor(np.where(low, sigma.c, 1), np.where(low, sigma.g, 0), zero)
    return Frequencies(sigma, tau, scale, delta)


def response(c: Compensator, f: Frequencies, cells: FloatArray) -> Taylor:
    """scale x F on the intervals: cells x inputs x outputs.

    Of sampled laws C (delta - (A - 1) / T)^-1 B / T + D: as differences, so that slow poles keep their digits.
    """
    k = len(c.A) - c.integrals
    A, B, S, into, back = _triangular(c)

    def wide(t: Taylor) -> Taylor:
        return t[:, None, None]

    def constant(M: Any) -> Taylor:
        M = np.asarray(M, dtype=complex)[None]
        return Taylor(M, 0 * M, np.zeros(M.shape))

    summed = constant(B[k:])  # scale x what the sums are
    if f.delta is not None:
        sigma, tau = f.delta, Taylor(np.ones_like(f.tau.c), 0 * f.tau.c, 0 * f.tau.r)
    else:
        sigma, tau = f.sigma, f.tau
        # e = B y / s; times s on branch 0, as it is on branch 1
        low = cells[:, 0] == 0
        once = Taylor(np.where(low, 1, -1j * tau.c), np.where(low, 0, -1j * tau.g), np.zeros(len(cells)))
        summed = wide(once) * summed
    driven = wide(f.scale) * constant(into @ B[:k]) + summed.mapped(into @ A[:k, k:], "ij,wjl->wil")
    driven = wide(tau) * driven
    rows: list[Taylor] = [driven[:, :0]] * k
    for i in reversed(range(k)):
        x = driven[:, i]
        for j in range(i + 1, k):
            if S[i, j] != 0:
                x = x + (tau[:, None] * rows[j]) * S[i, j]
        rows[i] = x * (sigma - tau * S[i, i]).inverse()[:, None]
    total = wide(f.scale) * constant(c.D)
    if k:
        stacked = Taylor(
            *(np.stack([getattr(row, name) for row in rows], axis=1) for name in ("c", "g", "r"))
        )
        total = total + stacked.mapped(c.C[:, :k] @ back, "ij,wjl->wil")
    if c.integrals:
        total = total + summed.mapped(c.C[:, k:], "ij,wjl->wil")
    return total


@lru_cache(maxsize=64)  # of records that compare by identity
def _triangular(c: Compensator) -> tuple[FloatArray, FloatArray, ComplexArray, ComplexArray, ComplexArray]:
    """A, B of differences, the Schur form of A without its sums, to its coordinates and back; balanced first."""
    k, (A, B) = len(c.A) - c.integrals, differences(c)
    balanced, (units, _) = linalg.matrix_balance(A[:k, :k], permute=False, separate=True)
    S, Q = linalg.schur(balanced, output="complex")
    return A, B, S, Q.conj().T / units, units[:, None] * Q


def actuator(c: Compensator, f: Frequencies, cells: FloatArray, order: int) -> Taylor | None:
    """H: lag, hold, delay. None where nothing stands between.

    A hold's images at W = w + 2 pi k / T are in it as a free mass has them, (w / W)^order H(W) summed over k: the free
    mass sampled exactly. What stiffness and damping add is in `_images`.
    """
    T = c.sample_time
    if T is None:
        return None if c.lag is None else (f.sigma + f.tau * c.lag).inverse() * f.tau * c.lag
    assert f.delta is not None
    middle, half = cells[:, 1:].mean(axis=1), np.diff(cells[:, 1:])[:, 0] / 2
    # (e^jwT - 1) / (jwT) = e^ja sin(a)/a, a = wT/2; every derivative of order n is below T^n / (n + 1)
    a = middle * T / 2
    small = a < 1e-4
    safe = np.where(small, 1, a)
    shape = np.where(small, 1 - a**2 / 6, np.sin(safe) / safe)
    slope = np.where(small, -a / 3, (np.cos(safe) - np.sin(safe) / safe) / safe)
    turn = np.exp(1j * a)
    step = Taylor(turn * shape, T / 2 * turn * (slope + 1j * shape) * half, T**2 / 6 * half**2)
    once = step.inverse()  # s / delta: a sampled integrator, times s
    z = f.delta * T + 1.0
    H = once if order == 1 else once * once * (z + 1.0) * 0.5
    if c.lag is not None:  # by partial fractions of lag / (s^order (s + lag))
        s, pole = f.sigma * (1 / c.lag), math.exp(-c.lag * T)
        own = s * (1 - pole) * (z - pole).inverse()
        H = H - own if order == 1 else H - s * (once - own)
    late = c.delay * T
    turned = np.exp(-1j * middle * late)
    return H * Taylor(turned, -1j * late * half * turned, (late * half) ** 2 / 2)


def _images(c: Compensator, M: Matrices, cells: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bounds of the rest of a hold's images, cells x positions x positions: E of C0 (H + E) and of s C1 (H + E / s).

    N(jW)^-1 N(jw) - (w/W)^2 = (1 + X)^-1 (j w (1 - w/W) N1 + (1 - w^2/W^2) N0) / W^2,  X = j N1 / W + N0 / W^2
    """
    T = c.sample_time
    assert T is not None
    low, high = cells[:, 1], cells[:, 2]
    turns = 2 * np.pi / T * np.arange(1, 41)
    W = np.hstack([turns - high[:, None], turns + low[:, None]])  # at least
    held = 2 * np.abs(np.sin(np.minimum(high * T / 2, np.pi / 2)))[:, None] / (W * T)
    if c.lag is not None:
        held = held * c.lag / np.hypot(W, c.lag)
    N0 = 1.5 * np.abs(M.N0).max(axis=0)  # the half for what lies between the nodes
    nearest = np.pi / T
    if M.N1 is None:
        moved, X = np.broadcast_to(2 * N0, (len(cells), *N0.shape)), N0 / nearest
    else:
        N1 = 1.5 * np.abs(M.N1).max(axis=0)
        moved, X = N0 + 2 * high[:, None, None] * N1, N1 / nearest + N0 / nearest**2
    if np.abs(np.linalg.eigvals(X)).max() >= 1:
        return np.full(moved.shape, np.inf), np.full(moved.shape, np.inf)
    moved = np.linalg.inv(np.eye(len(X)) - X) @ moved
    # 1.1 for the images beyond 40, which are below a tenth of the sum
    shares = (1.1 * (held / W**power).sum(axis=1)[:, None, None] for power in (M.order, 1))
    E0, E1 = (np.asarray(share * moved) for share in shares)
    return E0, E1


@dataclass(frozen=True, eq=False)
class Matrices:
    """N, B, C of a group at rows of parameters: rows x ... each."""

    N0: FloatArray  # N = s^2 - s N1 - N0, or s - N0
    N1: FloatArray | None
    B: FloatArray
    C0: FloatArray  # C = C0 + s C1
    C1: FloatArray | None
    stiffest: float  # 1/s, no pole of the plant is further out

    @property
    def order(self) -> int:
        return 1 if self.N1 is None else 2


def matrices_of(block: Block, p: FloatArray) -> Matrices:
    A, B, C = block.system.at(p)
    q = np.array(block.states)
    far = 1.5 * float(np.abs(np.linalg.eigvals(A)).max())
    if not block.system.second_order:
        return Matrices(A[:, q][:, :, q], None, B[:, q], C[:, :, q], None, far)
    d = q + A.shape[1] // 2
    C1 = C[:, :, d]
    return Matrices(A[:, d][:, :, q], A[:, d][:, :, d], B[:, d], C[:, :, q], C1 if C1.any() else None, far)


def characteristic(c: Compensator, M: Matrices, cells: FloatArray) -> tuple[Taylor, FloatArray]:
    """f on the intervals at the rows of parameters: cells x rows; and how far a hold's images move it at any: cells."""
    f = frequencies(c, cells)
    bare = response(c, f, cells)

    def wide(t: Taylor) -> Taylor:
        return t[:, None, None, None]

    def driven(order: int) -> Taylor:
        H = actuator(c, f, cells, order)
        return bare if H is None else H[:, None, None] * bare

    G = driven(M.order)

    def through(G: Taylor, C: FloatArray) -> Taylor:
        """B G C, as one product of all its terms."""
        paths = np.einsum("jak,jlb->kljab", M.B, C)
        flat, shape = paths.reshape(-1, M.B[:, :, 0].size * C.shape[2]), (len(cells), *paths.shape[2:])
        entries = [part.reshape(len(cells), -1) for part in (G.c, G.g, G.r)]
        sizes = np.abs(flat)
        return Taylor(
            *(
                (part @ weights).reshape(shape)
                for part, weights in zip(entries, (flat, flat, sizes), strict=True)
            )
        )

    eye = np.eye(M.N0.shape[1])[None, None]
    if M.N1 is None:
        F = (
            wide(f.scale * f.sigma) * eye
            - wide(f.scale * f.tau) * M.N0[None]
            - through(f.tau[:, None, None] * G, M.C0)
        )
    else:
        squared = f.tau * f.tau
        F = wide(f.scale * f.sigma * f.sigma) * eye - wide(f.scale * squared) * M.N0[None]
        if M.N1.any():
            F = F - wide(f.scale * f.sigma * f.tau) * M.N1[None]
        F = F - through(squared[:, None, None] * G, M.C0)
        if M.C1 is not None:
            F = F - through((f.sigma * f.tau)[:, None, None] * driven(1), M.C1)
    # rounding, relative to the terms
    s, C0 = f.sigma.size()[:, None, None, None], np.abs(M.C0)[None]
    C1 = None if M.C1 is None else np.abs(M.C1)[None]
    inward = np.abs(M.B) @ bare.size()[:, None]
    terms = inward @ (C0 if C1 is None else C0 + s * C1)
    own = f.scale.size()[:, None, None, None] * (s**M.order * eye + np.abs(M.N0))
    F = Taylor(F.c, F.g, F.r + ROUNDING * (own + terms))
    if c.sample_time is None:
        return _determinant(F), np.zeros(len(cells))
    E0, E1 = (E[:, None] for E in _images(c, M, cells))
    rest = inward @ (C0 @ E0 if C1 is None else C0 @ E0 + C1 @ E1)
    if rest.shape[-1] == 1:  # a factor of the output: f keeps its degrees
        return Taylor(F.c, F.g, F.r + rest)[..., 0, 0], np.zeros(len(cells))
    # elsewhere they couple what the plant does not; 1.5 of each matrix for what lies between the rows
    most, moved = 1.5 * F.size().max(axis=1), 2.25 * rest.max(axis=1)
    return _determinant(F), _determinant(Taylor(most + 0j, 0j * most, moved), signed=False).r


def _determinant(F: Taylor, *, signed: bool = True) -> Taylor:
    """By expansion along the first row: the matrices are small. Not signed: the permanent."""
    n = F.c.shape[-1]
    if n == 1:
        return F[..., 0, 0]
    total: Taylor | None = None
    for k in range(n):
        rest = [j for j in range(n) if j != k]
        term = F[..., 0, k] * _determinant(F[..., 1:, :][..., rest], signed=signed)
        total = term if total is None else total + (-term if signed and k % 2 else term)
    assert total is not None
    return total


class Polynomial(NamedTuple):
    """f p^poles is a polynomial of these degrees in the parameters."""

    degrees: tuple[int, ...]
    poles: tuple[int, ...]  # powers of each parameter that clear its denominators


def polynomial(block: Block, names: Sequence[str], sides: FloatArray) -> Polynomial | str:
    """Degrees of f in each parameter, found from its values and checked; a sentence where it is none.

    Chebyshev coefficients along a parameter vanish beyond its degree: to 1e-10, at three frequencies.
    """
    rng = np.random.default_rng(1)
    u = np.cos(np.pi * (np.arange(9) + 0.5) / 9)
    moving = [i for i, (low, high) in enumerate(sides) if low < high]
    rows = np.repeat(rng.uniform(sides[:, 0], sides[:, 1], (len(moving), 3, len(sides))), 9, axis=1)
    for k, i in enumerate(moving):
        rows[k, :, i] = np.tile(sides[i].mean() + np.diff(sides[i])[0] / 2 * u, 3)
    values = characteristic_values(block, rows.reshape(-1, len(sides))).reshape(-1, len(moving), 3, 9)
    powers = sorted((degree + power, power) for degree in range(6) for power in range(4))
    into = np.polynomial.chebyshev.chebvander(u, 8) / 9
    degrees, poles = [0] * len(sides), [0] * len(sides)
    for k, i in enumerate(moving):
        for total, power in powers:
            terms = np.abs((values[:, k] * rows[k, :, i].reshape(3, 9) ** power) @ into)
            if (terms[..., total - power + 1 :].max(axis=-1) <= 1e-10 * terms.max(axis=-1)).all():
                degrees[i], poles[i] = total - power, power
                break
        else:
            return f"{names[i]} enters neither as a polynomial of degree 5 nor over a power of itself"
    return Polynomial(tuple(degrees), tuple(poles))


def characteristic_values(block: Block, rows: FloatArray, w: FloatArray | None = None) -> ComplexArray:
    """f at frequencies and rows of parameters; without w at three frequencies over the range that matters."""
    M, c = matrices_of(block, rows), block.own
    if w is None:
        end = np.pi / c.sample_time if c.sample_time is not None else 1e3
        w = np.array([0.003, 0.03, 0.3]) * end
    return characteristic(c, M, np.column_stack([0 * w, w, w]))[0].c


def nodes(degree: int) -> FloatArray:
    return (1 - np.cos(np.pi * np.arange(degree + 1) / max(degree, 1))) / 2


def bernstein(degree: int, u: FloatArray) -> FloatArray:
    """Bernstein polynomials at u: ... x (degree + 1)."""
    i = np.arange(degree + 1)
    binomial = np.array([math.comb(degree, k) for k in i], dtype=float)
    u = np.asarray(u)[..., None]
    return np.asarray(binomial * u**i * (1 - u) ** (degree - i))


class Enclosure(NamedTuple):
    """Bernstein coefficients of f p^poles over the whole box, on intervals of frequency: cells x (degrees + 1)."""

    block: Block
    shape: tuple[int, ...]
    weights: FloatArray  # p^poles at the nodes
    matrices: Matrices  # at the nodes
    inverse: tuple[FloatArray, ...]  # values at nodes -> Bernstein coefficients, one matrix a parameter
    rows: FloatArray  # the nodes
    sides: FloatArray  # of the box: parameters x 2
    nominal: FloatArray


def enclosure(block: Block, nominal: FloatArray, sides: FloatArray, poly: Polynomial) -> Enclosure:
    axes = [
        low + (high - low) * nodes(d) if d else np.array([own])
        for (low, high), d, own in zip(sides, poly.degrees, nominal, strict=True)
    ]
    rows = np.array(list(itertools.product(*axes)))
    inverse = tuple(np.linalg.inv(bernstein(d, nodes(d))) if d else np.ones((1, 1)) for d in poly.degrees)
    weights = np.prod(rows ** np.array(poly.poles), axis=1)
    sizes = tuple(d + 1 for d in poly.degrees)
    return Enclosure(block, sizes, weights, matrices_of(block, rows), inverse, rows, sides, nominal)


def coefficients(e: Enclosure, cells: FloatArray) -> Taylor:
    with np.errstate(all="ignore"):  # intervals that are too wide have no bound: they are split
        f, images = characteristic(e.block.own, e.matrices, cells)
        f = f * e.weights
        f = along(Taylor(f.c, f.g, f.r + 1e-14 * np.abs(f.c)), e.shape, [m[None] for m in e.inverse])
        return Taylor(f.c, f.g, f.r + (images * 1.5 * np.abs(e.weights).max())[:, None])


def along(f: Taylor, shape: tuple[int, ...], matrices: Sequence[FloatArray]) -> Taylor:
    """A matrix along each parameter: cells x (degree + 1) x (degree + 1) each, or one for all cells."""

    def turn(values: Any, *, sizes: bool) -> Any:
        array = values.reshape(-1, *shape)
        for axis, M in enumerate(matrices, start=1):
            if shape[axis - 1] == 1:
                continue
            M = np.abs(M) if sizes else M
            moved = np.moveaxis(array, axis, -1)
            flat = moved.reshape(len(moved), -1, shape[axis - 1])
            array = np.moveaxis((flat @ M.swapaxes(-1, -2)).reshape(moved.shape), -1, axis)
        return array.reshape(len(array), -1)

    return Taylor(turn(f.c, sizes=False), turn(f.g, sizes=False), turn(f.r, sizes=True))


def excludes_zero(f: Taylor) -> Any:
    """Whether the points c +- g with their disks lie within an open half plane: rows.

    Seen from zero they then fill less than half a turn.
    """
    middle = f.c.mean(axis=1, keepdims=True)
    points = np.concatenate([f.c - f.g, f.c + f.g], axis=1)
    radius = np.concatenate([f.r, f.r], axis=1) + ROUNDING * np.abs(f.c).max(axis=1, keepdims=True)
    size = np.abs(points)
    with np.errstate(all="ignore"):
        half = np.arcsin(np.where(size > radius, radius / size, 1))
        angle = np.angle(points / middle)
    span = (angle + half).max(axis=1) - (angle - half).min(axis=1)
    fine = np.isfinite(f.r).all(axis=1) & (size > radius).all(axis=1) & (middle[:, 0] != 0)
    return fine & (span < np.pi - GUARD)


def products(e: Enclosure, rows: FloatArray) -> FloatArray:
    """Products of Bernstein polynomials at parameters: rows x coefficients."""
    total = np.ones((len(rows), 1))
    for i, size in enumerate(e.shape):
        if size > 1:
            u = (rows[:, i] - e.sides[i, 0]) / (e.sides[i, 1] - e.sides[i, 0])
            total = (total[:, :, None] * bernstein(size - 1, u)[:, None, :]).reshape(len(rows), -1)
    return total


def restrictions(shape: tuple[int, ...], boxes: FloatArray) -> Sequence[FloatArray]:
    """Bernstein coefficients over the whole box -> over parts of it, for each parameter: cells x d x d."""
    found: list[FloatArray] = []
    for axis, size in enumerate(shape):
        if size == 1:
            found.append(np.ones((1, 1, 1)))
            continue
        u = nodes(size - 1)
        low, high = boxes[:, axis, :1], boxes[:, axis, 1:]
        found.append(np.linalg.inv(bernstein(size - 1, u)) @ bernstein(size - 1, low + (high - low) * u))
    return found


def cover(c: Compensator, stiffest: float) -> FloatArray:
    """Intervals from zero to the Nyquist frequency, or to infinity: rows of branch, from, to."""
    top = np.pi / c.sample_time if c.sample_time is not None else 64 * (stiffest + 1)
    edges = top * 2.0 ** np.arange(-24, 1)
    cells = np.column_stack([0 * edges, np.r_[0, edges[:-1]], edges])
    return cells if c.sample_time is not None else np.vstack([cells, [1, 0, 1 / top]])
