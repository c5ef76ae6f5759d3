"""Loops of machines with held currents anywhere in their travel: each axis alone, and a bound of their coupling.

Without Z, E and B b^-1 - 1 (held_currents.py) the sampled loop is M0 = diag(M_g): groups of a few axes, whose
determinants are multi-affine in the b_i. The loop is M0 - e(z). On |z| = 1 it is regular if for some weights d > 0

    sum_i |(M0^-1)_ji| sum_k |e_ik| d_k < d_j   for every state j.

This holds for every y and for every share of e, so all of these loops are as stable as M0 at the nominal values. The
states of an axis are its position q, its rate q' and the acceleration a = b v stored for a sample; the compensator has
the states xi; k is the part of Z that each axis keeps to itself (`stiff`):

    q+, q'+ = Phi0 (q, q') + Gamma0 (a + k q) + e,   e = Gamma0 W (q, q', a) + (V (q, q', a), 0),
    Gamma0 = (T^2 / 2, T)

M0^-1 e is expanded along frequency; W and V are bounded over the part of the box that a cell is in. Gains that differ
from zero by rounding alone are bounded by coefficients.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from flint import arb
from scipy import linalg, sparse

from malta.arrays import FloatArray
from malta.linear.expressions import NotAnalytic
from malta.linear.uncertain import Compensator
from malta.proof.box import Box
from malta.proof.exclusion import BoxPart, CellBounds, growth_over, on_boxes
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.polynomial.family import Family, scale_of
from malta.proof.problem import Problem, Traits, physical
from malta.proof.weak_coupling.axes import AxisGroup, axes_of, members_of, state_matrix, stiff_axes
from malta.proof.weak_coupling.held_currents import HeldMachine, MatrixBounds, dominating_solution
from malta.work import is_past

GAIN_TOLERANCE = 1e-11  # gains of a compensator below this, relative, may be rounding and do not join groups
MAX_GROUP_AXES = 4  # axes of a group
COEFFICIENT_LOOSENESS = 1e4  # how much larger bounds by coefficients are, about
LIMIT = 0.3  # of the rows, where weights are chosen
PARTS = 256  # of a box, of which weights reach as many as they can
SWEEP = 50  # frequencies at which weights are chosen
FLOOR = 1e-6  # of what was seen, so that all weights are positive
TERMS = 10  # of series in the stiffness
ROUNDING_FACTOR = 1 + 1e-9
GRID = 8  # parts of each side of a box on which couplings are bounded
MAX_BOX_PARTS = 4000  # such parts
BOUNDS, PERRON = 1.6e-3, 1.4e-2  # work of the bounds over a part, and of a try of weights
CORNERS = 6  # parameters whose corners are all looked at for weights


@dataclass(frozen=True, eq=False)
class Coupling:
    """Bounds of e over a box, and the weights d.

    W, V : axes x states; rest : states x states, of gains that were dropped; weights : of the states
    """

    W: FloatArray
    V: FloatArray
    rest: FloatArray
    weights: FloatArray
    T: float

    def onto_group(
        self, g: AxisGroup, N: FloatArray, off: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The coupling to a group: M0^-1 e in rows of q, q' and a; bounds by coefficients; errors of the first.

        N, off : adjugates, K x states x states x nodes, and bounds of their errors
        """
        n, r = len(self.W), len(g.axes)
        members, axes, T = members_of(g, n), list(g.axes), self.T
        d = self.weights[members][:, None]
        by_state = (self.rest @ self.weights)[members] * ROUNDING_FACTOR / d
        through = _response_to_moves(N, r, T)
        loose = _response_to_moves(off, r, T)
        own = self.forces(axes, self.weights) / d
        scaled, loose = through * own[..., None], loose * own * ROUNDING_FACTOR
        beyond = ((np.abs(N).max(axis=3) + off) * by_state).sum(axis=2)
        size = (np.abs(scaled).max(axis=3) + loose).sum(axis=2)
        more = np.maximum(
            beyond[:, : 3 * r].max(axis=1), (beyond + size)[:, 3 * r :].max(axis=1, initial=0.0)
        )
        return scaled[:, : 3 * r], more * ROUNDING_FACTOR, loose[:, : 3 * r].max(axis=(1, 2))

    def forces(self, axes: Sequence[int], weights: FloatArray) -> FloatArray:
        """W d, V d of some axes: what is forced on them and what moves them, for other weights d as well."""
        return np.concatenate([(M @ weights)[list(axes)] for M in (self.W, self.V)]) * ROUNDING_FACTOR


def _response_to_moves(N: FloatArray, r: int, T: float) -> FloatArray:
    """The response to forces on the axes and to moves of their positions, from the response N to moves of states."""
    q, rate = N[:, :, :r], N[:, :, r : 2 * r]
    return np.concatenate([q * (T**2 / 2) + rate * T, q], axis=2)


@dataclass(frozen=True, eq=False)
class _CoupledGroup:
    """A group's polynomial over a box with the coupling to the other groups, which is computed when first used.

    coupling : over a part of the box
    """

    group: AxisGroup
    sides: FloatArray
    plain: Family
    coupling: Callable[[FloatArray], Coupling]

    @cached_property
    def families(self) -> tuple[Family, Family, tuple[int, ...]]:
        """The polynomial with bounds by coefficients; M0^-1 e as a family; its rows x inputs x nodes."""
        f = self.plain
        _, _, N, off = self.group.over(self.sides)
        main, more, off = self.coupling(self.sides).onto_group(self.group, N, off)
        K, rows, inputs, nodes = main.shape
        beside = Family((rows * inputs, *f.shape), main.reshape(K, -1), off, f.exponents, f.scale)
        return replace(f, radius=f.radius + more), beside, (rows, inputs, nodes)

    def on(self, cells: FloatArray, boxes: FloatArray) -> CellBounds:
        family, beside, shape = self.families
        f = on_boxes(family, cells, boxes)
        whole = np.broadcast_to([0.0, 1.0], (len(cells), 1, 2))
        e = on_boxes(beside, cells, np.concatenate([whole, boxes], axis=1), family)
        size = sum(np.abs(t) for t in e.terms) + e.radius[:, None]
        share = self._shares(boxes)[:, None, :, None]
        discs = (size.reshape(len(cells), *shape) * share).sum(axis=2).max(axis=1) * ROUNDING_FACTOR
        return CellBounds(list(f.terms), f.radius, f.lasting, discs.astype(complex), [])

    def _shares(self, boxes: FloatArray) -> FloatArray:
        """The forces on the group in boxes over those in the whole box: boxes x inputs."""
        whole = self.coupling(self.sides)
        most = whole.forces(self.group.axes, whole.weights)
        snapped = np.stack([np.floor(boxes[..., 0] * GRID), np.ceil(boxes[..., 1] * GRID)], axis=2) / GRID
        unique, index = np.unique(snapped, axis=0, return_inverse=True)
        low, high = self.sides.T
        pad = 1e-12 * np.abs(self.sides).max(axis=1)
        found = []
        for own in unique:
            inside = low[:, None] + own * (high - low)[:, None] + pad[:, None] * [-1, 1]
            here = self.coupling(inside).forces(self.group.axes, whole.weights)
            with np.errstate(invalid="ignore"):
                found.append(np.where(here < most, here / most * ROUNDING_FACTOR, 1))
        return np.array(found)[index.ravel()]


def _part(g: AxisGroup, coupling: Callable[[FloatArray], Coupling], sides: FloatArray, box: Box) -> BoxPart:
    """A group's polynomial over a box, with its coupling."""
    values, radius, _, _ = g.over(sides)
    with np.errstate(divide="ignore"):
        scale = scale_of(np.log2(np.abs(values).max(axis=1)) + np.array(g.heights))
    exponents = tuple(h + scale * k for k, h in enumerate(g.heights))
    shape = tuple(d + 1 for d in g.degrees_over(sides))
    family = Family(shape, values, radius, exponents, scale)
    group: Any = g  # a part uses `inverted` alone
    around = _CoupledGroup(g, sides, family, coupling).on
    return BoxPart(group, sides, family, growth_over(sides, g.inverted, box), around)


@dataclass(frozen=True, eq=False)
class HeldLoop:
    """A loop with held currents and a sample of delay, anywhere in its travel: a Problem for `margin_of`.

    law : the compensator without its delay; places : the loops at places of the travel, for the loss of stability
    """

    machine: HeldMachine
    law: Compensator
    places: Problem

    @property
    def T(self) -> float:
        assert self.law.sample_time is not None
        return self.law.sample_time

    @cached_property
    def groups(self) -> tuple[AxisGroup, ...]:
        """The axes in groups that share loops.

        Raises Unproven for a group of more than MAX_GROUP_AXES axes, and for states of the law outside all groups.
        """
        n, label = len(self.machine.lead), _labels(self.law)
        if not set(label[n:].tolist()) <= set(label[:n].tolist()):
            raise Unproven("states of the compensator that act on no axis")
        found = []
        for k in dict.fromkeys(label[:n].tolist()):
            axes = tuple(i for i in range(n) if label[i] == k)
            if len(axes) > MAX_GROUP_AXES:
                raise Unproven(f"{len(axes)} axes in one loop")
            own = tuple(i for i in range(len(self.law.A)) if label[n + i] == k)
            found.append(axes_of(self.machine, self.law, axes, own))
        return tuple(found)

    @property
    def traits(self) -> Traits:
        return Traits(enclose=self.enclose)

    @property
    def loops(self) -> tuple[None]:
        return (None,)

    def instability(self, rows: FloatArray) -> FloatArray:
        return self.places.instability(rows)

    def critical_frequency(self, p: FloatArray) -> float:
        return self.places.critical_frequency(p)

    def physical(self, x: float) -> float:
        return physical(x, self.T)

    def parts(self, p: Sequence[Any], *, neglect: bool = True) -> list[tuple[Any, tuple[Any, ...]]]:
        del p, neglect
        return [(g, ()) for g in self.groups]

    def enclose(self, box: Box, reach: float) -> list[BoxPart]:
        """The groups with their coupling over box(reach). Raises NotAnalytic or Unproven when it has no bounds."""
        sides = box.sides(reach)
        whole, known = self._bounds(sides), dict[bytes, Coupling]()

        def coupling(inside: FloatArray) -> Coupling:
            """Over a part of the box; over the whole where nothing better is known."""
            if not known:
                known[sides.tobytes()] = Coupling(*whole, self._weights(box, reach), self.T)
            if (key := inside.tobytes()) not in known:
                found = known[sides.tobytes()]
                if len(known) < MAX_BOX_PARTS:
                    is_past(price=BOUNDS)
                    with suppress(NotAnalytic):
                        W, V, _ = self._bounds(inside)
                        found = replace(found, W=W, V=V)
                known[key] = found
            return known[key]

        return [_part(g, coupling, sides, box) for g in self.groups]

    def _bounds(self, sides: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """W, V and the dropped gains over a box. Raises NotAnalytic."""
        return self._coupling_within(
            self.machine.bounds([arb(low).union(arb(high)) for low, high in sides.tolist()])
        )

    def _coupling_within(self, bounds: MatrixBounds) -> tuple[FloatArray, FloatArray, FloatArray]:
        """W, V and the dropped gains within bounds of the machine. Raises NotAnalytic."""
        loose = [i for i in range(len(bounds.Z)) if i not in self._stiff]
        bounds.beside[loose, loose] = bounds.Z[loose, loose]
        with np.errstate(over="ignore", invalid="ignore"):  # bounds that overflow are refused
            return coupling_bounds(bounds, self.T, self._dropped_gains)

    @cached_property
    def _stiff(self) -> set[int]:
        return {i for g in self.groups for i in stiff_axes(self.machine, g.axes)}

    # coupling

    @cached_property
    def _dropped_gains(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """|A|, |B|, |C|, |D| of the compensator between groups."""
        law = self.law
        own, axis = np.zeros(len(law.A), dtype=int), np.zeros(len(law.C), dtype=int)
        for k, g in enumerate(self.groups):
            own[list(g.own)], axis[list(g.axes)] = k, k

        def mask_groups(M: FloatArray, rows: FloatArray, columns: FloatArray) -> FloatArray:
            return np.where(rows[:, None] != columns[None], np.abs(M), 0)

        return (
            mask_groups(law.A, own, own), mask_groups(law.B, own, axis),
            mask_groups(law.C, axis, own), mask_groups(law.D, axis, axis),
        )  # fmt: skip

    def _weights(self, box: Box, reach: float) -> FloatArray:
        """Weights for which |M0^-1| |e| at corners has no row above LIMIT up to a box as large as possible.

        The proof is valid for any positive weights; the choice decides how far it reaches.
        """
        best, rho = self._perron(box.sides(0.0), math.inf)
        if rho >= LIMIT:
            return best
        low, high, step = 0, PARTS, 0  # of the box: from its end down in steps that double, then between two
        while high - low > 1 and not is_past(price=PERRON):
            k = (low + high) // 2 if low else max(PARTS - step, 1)
            found, rho = self._perron(box.sides(reach * k / PARTS), LIMIT)
            if rho < LIMIT:
                low, best = k, found
            else:
                high = k
            step = max(1, 2 * step)
        return best

    def _perron(self, sides: FloatArray, most: float) -> tuple[FloatArray, float]:
        """Perron's vector and value of |M0^-1| |e| at corners, sampled frequencies; infinite where M0 is unstable.

        The value only grows with each corner, so that none is looked at where it is beyond `most`.
        """
        n = len(self.machine.lead)
        seen = np.zeros((3 * n + len(self.law.A),) * 2)
        known: dict[Any, tuple[FloatArray, FloatArray] | None] = {}
        vector: FloatArray = np.ones(len(seen))
        rho = math.inf
        corners = _corners(sides)
        for count, p in enumerate(corners, 1):
            try:
                W, V, rest = self._coupling_within(self.machine.bounds_near(p))
            except NotAnalytic:
                return np.ones(len(seen)), math.inf
            forces = np.vstack([W, V])
            for g in self.groups:
                members, r = members_of(g, n), len(g.axes)
                at = g.values_at(p)
                if (g.axes, at) not in known:
                    known[g.axes, at] = self._responses(g, at)
                if (found := known[g.axes, at]) is None:
                    return np.ones(len(seen)), math.inf
                moves, G = found
                one = (moves @ forces[[*g.axes, *(n + i for i in g.axes)]]).max(axis=0)
                one += (G @ rest[members]).max(axis=0) * COEFFICIENT_LOOSENESS
                one[3 * r :] *= COEFFICIENT_LOOSENESS
                seen[members] = np.maximum(seen[members], one)
            if count == len(corners) or (math.isfinite(most) and not count & (count - 1)):
                vector, rho = _perron_of(seen)
                if rho >= most:
                    break
        return vector, rho

    def _responses(self, g: AxisGroup, values: tuple[float, ...]) -> tuple[FloatArray, FloatArray] | None:
        """|M0^-1| of a group to its forces and moves and to all, at frequencies; None where M0 is unstable."""
        r, stiff = len(g.axes), stiff_axes(self.machine, g.axes)
        k = dict(zip(stiff, values[r:], strict=True))
        A = state_matrix(self.law, g.axes, g.own, values[:r], [k.get(i, 0.0) for i in g.axes])
        poles = np.linalg.eigvals(A)
        if not np.abs(poles).max() < 1:
            return None
        angles = np.abs(np.angle(poles[np.abs(poles) > 0.3]))
        z = np.exp(1j * np.concatenate([np.geomspace(1e-3, 1, SWEEP) * np.pi, angles]))
        G = np.linalg.inv(z[:, None, None] * np.eye(len(A)) - A)
        return np.abs(_response_to_moves(G, r, self.T)), np.abs(G)


def _perron_of(M: FloatArray) -> tuple[FloatArray, float]:
    """Perron's vector and value of a matrix without negative entries."""
    balanced, (units, _) = linalg.matrix_balance(M, permute=False, separate=True)
    balanced = balanced + FLOOR * balanced.max()
    d: FloatArray = np.ones(len(M))
    for _ in range(100):
        d = balanced @ d
        d = d / d.max()
    return np.exp2(np.round(8 * np.log2(d * units)) / 8), float((balanced @ d / d).max())


def _corners(sides: FloatArray) -> FloatArray:
    """The corners of a box, or some of very many: one row for each."""
    count = len(sides)
    if count <= CORNERS:
        chosen = np.array(list(itertools.product((0, 1), repeat=count)))
    else:
        chosen = np.random.default_rng(0).integers(0, 2, (2**CORNERS, count))
    return np.unique(sides[np.arange(count), chosen], axis=0)


def _labels(law: Compensator) -> Any:
    """The group of each axis and of each state of the compensator."""
    n, k = len(law.C), len(law.A)

    def is_joined(M: FloatArray) -> Any:
        size = np.abs(M)
        if not size.size:
            return size > 0
        return size > GAIN_TOLERANCE * np.sqrt(
            size.max(axis=1, keepdims=True) * size.max(axis=0, keepdims=True)
        )

    touch = np.zeros((n + k, n + k), dtype=bool)
    touch[:n, :n], touch[:n, n:] = is_joined(law.D), is_joined(law.C)
    touch[n:, :n], touch[n:, n:] = is_joined(law.B), is_joined(law.A)
    return sparse.csgraph.connected_components(touch, directed=False)[1]


def coupling_bounds(
    bounds: MatrixBounds, T: float, dropped: tuple[FloatArray, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Bounds of W, of V and of the compensator's dropped gains, from those of the machine.

    X = Z - E C is the stiffness of held currents, |X| <= |Z| + |E|. With Gamma(X) = (sum X^k T^(2k + 2) / (2k + 2)!,
    sum X^k T^(2k + 1) / (2k + 1)!), and e_q the part of e in q+,

        e = Gamma(X) (Z q + B b^-1 a - E (q - r)) - Gamma0 a + (Phi(X) - Phi0) q'
        q - r = (T q' + T^2 / 2 a + e_q) / z

    for k = 0; else e has Gamma0 k q less, which is in M0.

    This has a solution for all |z| >= 1, because |Gamma E| has no eigenvalue of one or more (`dominating_solution`):
    e is analytic there, and a stable loop stays stable. The second row of e is T W; V is the first row less T / 2 times
    the second, term by term of the series.
    """
    Z, beside, E, shares, b = bounds
    n = len(Z)
    X, eye = Z + E, np.eye(n)
    size = float(X.sum(axis=1).max(initial=0.0)) * T**2
    if not size < 0.5:
        raise NotAnalytic("a stiffness that is fast beside the sample time")
    tail, power = size**TERMS * T**2, eye
    # of Gamma(X) - Gamma0 both parts, and what is not along Gamma0; over T where these are rates
    less, short, skew, late = np.full((4, n, n), tail)
    for k in range(1, TERMS):
        power = power @ X
        term = power * (T ** (2 * k + 2) / math.factorial(2 * k + 2))
        less += term
        short += term * (2 * k + 2)
        skew += term * k
        late += term * ((2 * k + 2) * (2 * k - 1) / 2)
    less, short, skew, late = (M * ROUNDING_FACTOR for M in (less, short, skew, late))
    q, rate, a = (slice(k * n, (k + 1) * n) for k in range(3))
    W = np.hstack([Z, E * T, shares + E * (T**2 / 2), np.zeros((n, len(dropped[0])))]) * ROUNDING_FACTOR
    driven = W.copy()  # with a itself, which Gamma(X) - Gamma0 acts on
    driven[:, a] += eye
    up = W * (T**2 / 2) + less @ driven
    up[:, rate] += short / T
    whole = eye * (T**2 / 2) + less  # of Gamma(X), the first part
    moved = dominating_solution(whole @ E * ROUNDING_FACTOR, up * ROUNDING_FACTOR)
    W[:, q] = beside * ROUNDING_FACTOR
    W = W + (short @ driven + (eye * T**2 + short) @ E @ moved) / T**2
    W[:, rate] += whole @ X / T
    V = skew @ driven + skew @ E @ moved
    V[:, rate] += late / T
    rest = np.zeros((3 * n + len(dropped[0]),) * 2)
    rest[a, 3 * n :], rest[a, q] = b[:, None] * dropped[2], b[:, None] * dropped[3]
    rest[3 * n :, 3 * n :], rest[3 * n :, q] = dropped[0], dropped[1]
    return W * ROUNDING_FACTOR, V * ROUNDING_FACTOR, rest * ROUNDING_FACTOR
