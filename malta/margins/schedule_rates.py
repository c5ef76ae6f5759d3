"""How fast the reference of a scheduled law may move: a parameter of machine and law that varies, as in proof/rates.py.

Between samples x' = A(p) x + B(p) v, while the law has the p of the sample: xi+ = Phi(p) xi and what the motion of p
within the sample changes, Phi = L(p) + N e^(M(p) T) R(p), M = [[A, B], [0, 0]], R: xi -> (x, v). The law may be another
function of p from interval to interval, as that of a schedule, but Phi is continuous. Phi'' is enclosed on each piece
in balls: the exponential of [[M, M', M''/2], [0, M, M'], [0, 0, M]] T has e^(M T) and its derivatives in its first row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from flint import acb, arb, arb_mat
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.balls import BALLS
from malta.linear.expressions import MatrixProgram, NotAnalytic, program
from malta.linear.matrices import system_matrix
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.margins.scheduled_loops import loops_between_places
from malta.model.plant import Plant
from malta.processes import on_one_thread
from malta.proof.polynomial.enclosure import precision
from malta.proof.rates import (
    BITS,
    CellOfLoop,
    Changes,
    MovingLoop,
    RateBound,
    add_on_top,
    ball,
    middle,
    rate_bound,
    spectral,
)
from malta.synthesis.controller import Controller

CALLER = "rate_of_cells"
SAMPLE = 4  # parts of a sample in which e^(M s) is enclosed
COURSE_INTERVALS = 64  # intervals in which norms over the whole course are taken
Interval = tuple[float, float]


@on_one_thread
def rate_of_cells(
    cells: Sequence[tuple[UncertainSystem, Compensator, Interval]], *, time: float | None = None
) -> RateBound:
    """Prove how fast the only parameter of some loops may vary along their intervals.

    cells : continuous systems in one parameter, perhaps with D, without E; sampled laws without delay and lag, whose
        first outputs are the inputs that D does not lead back; and intervals that follow each other
    time : s, longest search; None: as long as 60 units of work take

    Returns a RateBound; its rate is None, with the reason, where nothing is proven.

    Raises InputError for other systems and laws.
    """
    for system, law, _ in cells:
        plain = law.sample_time is not None and law.lag is None and not law.delay
        if len(system.names) != 1 or system.matrices.n_out() > 4 or not plain:
            expected = "continuous systems in one parameter under sampled laws without delay and lag"
            raise InputError(CALLER, "cells", "other loops", expected)
    name, low, high = cells[0][0].names[0], cells[0][2][0], cells[-1][2][1]
    with precision(BITS):
        try:
            own = _cells_of(cells)
            along = tuple(CellOfLoop(cell.at, cell.low, cell.high) for cell in own)
            loop = MovingLoop(along, partial(_MovingNorms, own), own[0].T)
            return rate_bound(loop, name, time)
        except NotAnalytic as error:
            return RateBound(name, low, high, None, None, 0, 0.0, f"no enclosure: {error}")


@dataclass(frozen=True, eq=False)
class _Cell:
    """M, L and R with their first two derivatives as instructions, within an interval."""

    parts: MatrixProgram  # of p: M, M', M'', L, L', L'', R, R', R''
    low: float
    high: float
    n: int
    T: float

    def every(self, p: Any) -> list[Any]:
        """The nine matrices in balls."""
        found = []
        for shape, entries in zip(self.parts.shapes, self.parts.run([acb(p)], BALLS), strict=True):
            table = [[arb(0)] * shape[1] for _ in range(shape[0])]
            for i, j, z in entries:
                if not z.is_finite():
                    raise NotAnalytic("a division by what may be zero")
                table[i][j] = z.real
            found.append(arb_mat(table))
        return found

    def at(self, p: float) -> Any:
        """Phi in balls."""
        M, _, _, L, _, _, R, _, _ = self.every(arb(p))
        return add_on_top(L, (M * arb(self.T)).exp() * R, self.n)

    def curvature(self, p: Any) -> tuple[Any, Any]:
        """Phi'' and R over a ball p."""
        M, M1, M2, _, _, L2, R, R1, R2 = self.every(p)
        k = M.nrows()
        whole = [[arb(0)] * (3 * k) for _ in range(3 * k)]
        for at, part in enumerate((M, M1, M2 * arb(0.5))):
            for row in range(3 - at):
                for i, line in enumerate(part.tolist()):
                    whole[row * k + i][(row + at) * k : (row + at + 1) * k] = line
        top = (arb_mat(whole) * arb(self.T)).exp().tolist()[:k]
        E, E1, half = (arb_mat([line[at * k : (at + 1) * k] for line in top]) for at in range(3))
        return add_on_top(L2, half * R * arb(2) + E1 * R1 * arb(2) + E * R2, self.n), R


def _cells_of(cells: Sequence[tuple[UncertainSystem, Compensator, Interval]]) -> list[_Cell]:
    """The loops as instructions, in units of xi in which the middle one is balanced."""
    middle_cell = cells[len(cells) // 2]
    plain, T, n = _expressions(*middle_cell[:2], None)
    a, b = middle_cell[2]
    M, L, R = (np.array(ca.DM(x)) for x in plain(a / 2 + b / 2)[:3])
    Phi = L.copy()
    Phi[:n] += (linalg.expm(M * T) @ R)[:n]
    _, (units, _) = linalg.matrix_balance(Phi, permute=False, separate=True)
    return [
        _Cell(program(_expressions(system, law, units)[0]), low, high, n, T)
        for system, law, (low, high) in cells
    ]


class _MovingNorms:
    """Norms of M and M' over the whole course, in units of (x, v) in which inputs move states as states do."""

    def __init__(self, own: Sequence[_Cell], P: Any) -> None:
        self.own, n = own, own[0].n
        M = middle(own[0].every(arb(own[0].low))[0])
        X = np.linalg.inv(np.linalg.cholesky(middle(P)[:n, :n])).T
        back = np.linalg.inv(X)
        inputs = np.linalg.norm(back @ M[:n, n:], axis=0)
        rate = np.linalg.norm(back @ M[:n, :n] @ X, 2)
        size = np.where(inputs > 0, rate / np.where(inputs > 0, inputs, 1), 1.0)
        self.X = ball(X)
        self.U = ball(linalg.block_diag(X, np.diag(size)))
        self.back = self.U.inv()
        self.speed = self.slope = 0.0
        for cell in own:
            edges = np.linspace(cell.low, cell.high, COURSE_INTERVALS + 1).tolist()
            for a, b in pairwise(edges):
                whole, first, *_ = cell.every(_between(a, b))
                self.speed = max(self.speed, spectral(self.back * whole * self.U))
                self.slope = max(self.slope, spectral(self.back * first * self.U))

    def changes(self, X: Any, back: Any, low: float, high: float) -> Changes:
        """Within an interval, in the units X."""
        cell = next(cell for cell in self.own if cell.low <= low and high <= cell.high)
        second, R = cell.curvature(_between(low, high))
        onto = arb_mat([row[: cell.n] for row in back.tolist()])
        spread = spectral(onto * self.X) * spectral(self.back * R * X)
        return Changes(spread, self._first(cell, (low, high), onto, R * X), spectral(back * second * X))

    def _first(self, cell: _Cell, ends: Interval, onto: Any, begins: Any) -> float:
        """T^2/2 times a bound of |N e^(M (T - s)) M' e^(M s) R| for all s in a sample.

        p moves s at most until s: the integral of s is T^2/2. It stays within a width of the interval.
        """
        low, high, n, T = *ends, cell.n, cell.T
        M, slope, *_ = cell.every(_between(2 * low - high, 2 * high - low))
        most = 0.0
        for k in range(SAMPLE):
            a, b = T * k / SAMPLE, T * (k + 1) / SAMPLE
            after = (M * _between(T - b, T - a)).exp()
            after = onto * arb_mat(after.tolist()[:n])
            most = max(most, spectral(after * slope * (M * _between(a, b)).exp() * begins))
        return most * T**2 / 2 * (1 + 1e-9)


def _between(a: float, b: float) -> Any:
    """A ball with all numbers between a and b."""
    return arb((a + b) / 2, (b - a) / 2 * (1 + 1e-9) + 1e-300)


def _expressions(
    system: UncertainSystem, law: Compensator, units: FloatArray | None
) -> tuple[ca.Function, float, int]:
    """p -> M, L and R, with their derivatives where units of xi are given (powers of two); T, and the number of x.

    D leads outputs of the law back to its inputs; u = (1 - D_c D)^-1 (D_c C x + C_c s) is a finite sum.
    """
    q = ca.SX.sym("q")
    A, B, C, *rest = (ca.SX(M) for M in system.matrices.call([q]))
    D = rest[0] if rest else ca.SX(C.shape[0], B.shape[1])
    n, k, T = A.shape[0], len(law.A), law.sample_time
    F_A, F_B, F_C, F_D = (ca.sparsify(ca.DM(M)) for M in (law.A, law.B, law.C, law.D))
    around = power = ca.SX.eye(B.shape[1])
    through = ca.sparsify(F_D @ D)
    for _ in range(B.shape[1]):
        power = ca.sparsify(power @ through)
        around = around + power
    if ca.sparsify(power @ through).nnz():
        raise InputError(CALLER, "law", "a direct path around the loop", "one that ends")
    u = around @ ca.horzcat(F_D @ C, F_C)
    y = ca.horzcat(C, ca.SX(C.shape[0], k)) + D @ u
    acting = [j for j in range(B.shape[1]) if B[:, j].nnz()]
    M = system_matrix(A, B[:, acting])
    L = ca.vertcat(ca.SX(n, n + k), ca.horzcat(ca.SX(k, n), ca.SX(F_A)) + F_B @ y)
    R = system_matrix(ca.SX.eye(n), ca.SX(n, k), u[acting, :n], u[acting, n:])
    assert T is not None
    if units is None:
        return ca.Function("parts", [q], [ca.densify(x) for x in (M, L, R)]), T, n
    t = ca.DM(units)
    z = ca.vertcat(t[:n], ca.DM.ones(len(acting)))
    scaled = (
        ca.diag(1 / z) @ M @ ca.diag(z),
        ca.diag(1 / t) @ L @ ca.diag(t),
        ca.diag(1 / z) @ R @ ca.diag(t),
    )
    found = []
    for x in scaled:
        first = ca.reshape(ca.jacobian(ca.vec(ca.densify(x)), q), x.shape)
        second = ca.reshape(ca.jacobian(ca.vec(ca.densify(first)), q), x.shape)
        found += [x, first, second]
    return ca.Function("parts", [q], ca.cse([ca.SX(x) for x in found])), T, n


def schedule_rate(plant: Plant, controller: Controller, *, time: float | None = None) -> RateBound:
    """Prove how fast the reference of a schedule may move while the loop stays exponentially stable.

    The machine has its nominal parameters and is where its reference is; deviations from there are small. The bound is
    sufficient: a faster reference need not be unstable.

    plant : the machine
    controller : its controller, with a schedule
    time : s, longest search; None: as long as 60 units of work take

    Returns a RateBound of the scheduled output, per second; its rate is None, with the reason, where nothing is proven.

    Raises InputError for a controller without a schedule.

    >>> import malta
    >>> spec = malta.read_design("examples/magnet/design/scheduled.toml")
    >>> law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> print(malta.margins.schedule_rate(spec.plant, law))  # m/s
    y in -0.003 .. 0.003: proven for every course with |dy/dt| up to 0.003339
    """
    schedule = controller.schedule
    if schedule is None:
        raise InputError("schedule_rate", controller.name, "a law of one set of matrices", "a scheduled law")
    cells = loops_between_places(plant, controller, (), "lag")
    if isinstance(cells, str):
        low, high = schedule.places[[0, -1]].tolist()
        return RateBound(schedule.variable, low, high, None, None, 0, 0.0, cells)
    return rate_of_cells(cells, time=time)
