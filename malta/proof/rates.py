"""A parameter that varies while the loop runs: stability for every course whose rate stays below a bound, proven.

    x' = (A_0 + p A_1) x + B u,  y = C x,      a sampled law, and p(t) anywhere in an interval with |p'| <= rate

A margin over an interval of p is one of every frozen p. For one that moves there is V = xi' P(p) xi of the loop's state
xi at the samples, P piecewise linear in p. With the frozen loop xi+ = Phi(p) xi,

    Phi(p)' P(p) Phi(p) <= (1 - g) P(p),      -d P(p) <= dP/dp <= d P(p)      on every piece of the interval

V falls in every sample where (sqrt(1 - g) + e)^2 exp(rate T d) < 1, e the change of Phi, in the norm of P, by the
motion of p within a sample. g is proven at the ends of a piece, and between them by the second derivative: a matrix
function is no further from its chord than h^2/8 sup |F''|. All is in balls; floating point only chooses P.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import casadi as ca
import numpy as np
from flint import arb, arb_mat
from scipy import linalg

from malta.arguments import interval, positive
from malta.arrays import FloatArray
from malta.bound import at_least
from malta.display import Description, display, quantity
from malta.errors import InputError, require_known
from malta.linear.expressions import NotAnalytic
from malta.linear.sampling import split_delay
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.processes import on_one_thread
from malta.proof.polynomial.enclosure import precision
from malta.proof.robust import law_of
from malta.work import count_work, is_past, work_limit

CALLER = "prove_rate"
BITS = 128
UNIT_TOLERANCE = 1e-3  # relative size of what rounding may leave of units
MIN_PIECE_SHARE = 2.0**-12  # part of the interval that one piece has at least
SHARES = (0.8, 0.5, 0.2)  # of the slowest decay, which V has at the nodes
WORK = 60.0  # units of work, of a search
PIECE = 7e-7  # work of a piece, times the cube of its states


@display
@dataclass(frozen=True)
class RateBound:
    """How fast a parameter may vary, proven.

    name : of the parameter
    low, high : its interval, SI
    rate : proven bound of |dp/dt|, SI; None: nothing proven
    decay : proven decay of xi at every frozen value, 1/s; None: nothing proven
    pieces : of P along the interval
    seconds : s
    reason : why nothing is proven; "": it is

    >>> from malta.proof.rates import RateBound
    >>> print(RateBound("Omega", 0.0, 400.0, 125.0, 2.0, 8, 1.0))
    Omega in 0 .. 400: proven for every course with |dOmega/dt| up to 125
    """

    name: str
    low: float
    high: float
    rate: float | None
    decay: float | None
    pieces: int
    seconds: float
    reason: str = ""

    def __str__(self) -> str:
        head = f"{self.name} in {self.low:g} .. {self.high:g}: "
        if self.rate is None:
            return head + f"nothing proven ({self.reason})"
        return head + f"proven for every course with |d{self.name}/dt| up to {at_least(self.rate).text()}"

    @property
    def description(self) -> Description:
        """The bound, the decay and how it was found."""
        rows = [("pieces", f"{self.pieces}"), ("found in", quantity(self.seconds, "s"))]
        if self.decay is not None:
            rows.insert(0, ("decay when frozen", f"{at_least(self.decay).text()} 1/s"))
        return Description(str(self), tuple(rows))


@dataclass(frozen=True, eq=False)
class _Loop:
    """xi+ = (L + N [n rows of e^((M_0 + p M_1) T)] R) xi; N puts n rows on top."""

    M: tuple[Any, Any]  # balls
    L: Any
    R: Any  # xi -> (x, u)
    n: int
    T: float

    def at(self, p: float) -> Any:
        """Phi in balls."""
        M = self.M[0] + self.M[1] * arb(p)
        return add_on_top(self.L, (M * arb(self.T)).exp() * self.R, self.n)


class CellOfLoop(NamedTuple):
    """Phi of p in balls, within an interval of p."""

    at: Callable[[float], Any]
    low: float
    high: float


class Changes(NamedTuple):
    """Bounds of how Phi changes within an interval of p, in the units of a piece."""

    spread: float  # by a change of e^(M T) of size one
    first: float  # within a sample, by a p that moves at rate one, to first order
    bent: float  # of Phi'' in p


class Norms(Protocol):
    """Bounds of how Phi changes."""

    speed: float  # of e^(M t) in its units, 1/s
    slope: float  # of M with p

    def changes(self, X: Any, back: Any, low: float, high: float) -> Changes:
        """Within an interval, in the units X; a sample that begins in it ends less than its width beyond."""
        ...


@dataclass(frozen=True, eq=False)
class MovingLoop:
    """A frozen sampled loop xi+ = Phi(p) xi along an interval of p.

    cells : the intervals within which Phi is one smooth function of p, in order
    norms : P -> bounds of changes of Phi, in units in which P is about one
    T : sample time, s
    """

    cells: tuple[CellOfLoop, ...]
    norms: Callable[[Any], Norms]
    T: float

    def at(self, p: float) -> Any:
        """Phi in balls."""
        return next(cell for cell in self.cells if p <= cell.high).at(p)


class _Piece(NamedTuple):
    """What is proven between two values of p."""

    width: float
    fall: float  # g
    slope: float  # d
    spread: float  # of the change within a sample: |N e R| <= spread |e| in the norm of P
    first: float  # of the change within a sample at rate one, to first order


@on_one_thread
def prove_rate(
    system: UncertainSystem,
    compensator: Compensator | Any,
    name: str,
    over: tuple[float, float],
    *,
    time: float | None = None,
) -> RateBound:
    """Prove how fast one parameter may vary within an interval while the sampled loop stays exponentially stable.

    The bound holds for every course p(t) in the interval with |p'| below it, also within samples; the other parameters
    are at their nominal values. It is sufficient: a faster course need not be unstable.

    system : of `malta.uncertain`, continuous, without D and E, whose A is affine in p; B and C do not depend on it
    compensator : a sampled law u = F y (positive feedback), perhaps with a delay, without a lag
    name : of the parameter
    over : its interval, SI
    time : s, longest search; None: as long as 60 units of work take

    Returns a RateBound; its rate is None, with the reason, where nothing is proven.

    Raises InputError for other systems, laws and names.

    Source: the piecewise linear V is that of parameter-dependent quadratic stability, W. J. Rugh, J. S. Shamma,
    "Research on gain scheduling", Automatica 36, 2000.

    >>> import malta
    >>> import control
    >>> damped = lambda k: ([[0, 1], [-k, -1]], [[0], [1]], [[1, 0]])
    >>> spring = malta.uncertain(damped, {"k": 2.0})
    >>> law = control.ss([], [], [], [[-1.0]], 0.01)  # u = -y: a stiffness from 2 to 4
    >>> found = malta.proof.prove_rate(spring, law, "k", (1.0, 3.0))
    >>> found.rate > 2.0, found.rate < 3.0  # N/m/s
    (True, True)
    """
    low, high = interval(CALLER, "over", over)
    if time is not None:
        positive(CALLER, "time", time)
    with precision(BITS):
        loop = _loop_of(system, law_of(system, compensator, CALLER), name)
        norms = partial(_Units, loop, max(abs(low), abs(high)))
        return rate_bound(MovingLoop((CellOfLoop(loop.at, low, high),), norms, loop.T), name, time)


def rate_bound(loop: MovingLoop, name: str, time: float | None) -> RateBound:
    """The bound of a loop over all its cells, in a search of WORK, or of a time (s)."""
    low, high, begun = loop.cells[0].low, loop.cells[-1].high, clock.monotonic()
    work = WORK if time is None else math.inf
    with precision(BITS), count_work(work, time), work_limit(work):
        reason = "the loop is unstable at a frozen value"
        for share in SHARES:
            found = _pieces(loop, low, high, share)
            if not isinstance(found, str):
                pieces, norms = found
                rate = _rate(pieces, loop, norms)
                decay = -math.log1p(-min(piece.fall for piece in pieces)) / (2 * loop.T)
                return RateBound(name, low, high, rate, decay, len(pieces), clock.monotonic() - begun)
            reason = found
    return RateBound(name, low, high, None, None, 0, clock.monotonic() - begun, reason)


def _loop_of(system: UncertainSystem, law: Compensator, name: str) -> _Loop:
    """The loop in balls. Raises InputError for what the proof does not cover."""
    require_known([name], system.names, CALLER, "name")
    if law.sample_time is None or system.sample_time is not None or law.lag is not None:
        raise InputError(
            CALLER, "compensator", "another loop", "a continuous system under a sampled law without a lag"
        )
    if split_delay(law.delay)[1]:
        raise InputError(CALLER, "compensator.delay", f"{law.delay:g} samples", "whole samples")
    p = ca.SX(ca.DM(system.nominal))
    p[system.names.index(name)] = q = ca.SX.sym("q")
    made = [ca.SX(M) for M in system.matrices.call([p])]
    if len(made) > 3 or ca.depends_on(ca.veccat(*made[1:]), q):
        raise InputError(
            CALLER, "system", f"B, C, D or E that depend on {name}, or D or E", "A alone that does"
        )
    slope = ca.jacobian(ca.vec(made[0]), q)
    if ca.depends_on(slope, q):
        raise InputError(CALLER, "system", f"an A that is not affine in {name}", "A_0 + p A_1")
    parts = ca.Function("parts", [q], [*made, ca.reshape(slope, made[0].shape)])(0)
    A, B, C, A1 = (np.array(ca.DM(M)) for M in parts)
    plain = _close_loop(A, A1, B, C, law)
    with np.errstate(all="ignore"):
        _, (t, _) = linalg.matrix_balance(
            middle(plain.at(float(system.nominal[system.names.index(name)]))), permute=False, separate=True
        )
    n, own = len(A), len(A) + split_delay(law.delay)[0] * B.shape[1]
    x, u, s = t[:n], 2.0 ** np.round(np.log2(t[n:own]).mean()) if own > n else 1.0, t[own:]
    # Powers of two: exact.
    law = replace(law, A=law.A * s / s[:, None], B=law.B / s[:, None], C=law.C * s / u, D=law.D / u)
    return _close_loop(A * x / x[:, None], A1 * x / x[:, None], B * u / x[:, None], C * x, law)


def _close_loop(A: FloatArray, A1: FloatArray, B: FloatArray, C: FloatArray, law: Compensator) -> _Loop:
    """States: those of the plant, stored inputs from the oldest, those of the law."""
    (n, m), k, d = B.shape, len(law.A), split_delay(law.delay)[0]
    size, own = n + m * d + k, n + m * d
    out = [[arb(0)] * size for _ in range(m)]  # of the law
    _put(out, 0, 0, ball(law.D) * ball(C))
    _put(out, 0, own, ball(law.C))
    L = [[arb(0)] * size for _ in range(size)]
    R = [[arb(int(i == j)) for j in range(size)] for i in range(n)]
    if d:
        R += [[arb(int(n + i == j)) for j in range(size)] for i in range(m)]
        for i in range(m * (d - 1)):
            L[n + i][n + m + i] = arb(1)
        L[own - m : own] = out
    else:
        R += out
    _put(L, own, 0, ball(law.B) * ball(C))
    _put(L, own, own, ball(law.A))
    M0, M1 = np.zeros((n + m, n + m)), np.zeros((n + m, n + m))
    M0[:n, :n], M0[:n, n:], M1[:n, :n] = A, B, A1
    assert law.sample_time is not None
    return _Loop((ball(M0), ball(M1)), arb_mat(L), arb_mat(R), n, law.sample_time)


def ball(M: FloatArray) -> Any:
    return arb_mat(len(M), M.shape[1], [arb(float(x)) for x in M.ravel()])


def add_on_top(L: Any, rows: Any, n: int) -> Any:
    """L with the first n of other rows added to its own."""
    own, top = L.tolist(), rows.tolist()[:n]
    return arb_mat(
        [[a + b for a, b in zip(*pair, strict=True)] for pair in zip(own, top, strict=False)] + own[n:]
    )


def _put(rows: list[list[Any]], i: int, j: int, M: Any) -> None:
    """Write a matrix into rows, from (i, j) on."""
    for k, row in enumerate(M.tolist()):
        rows[i + k][j : j + len(row)] = row


def middle(M: Any) -> FloatArray:
    return np.array([[float(x.mid()) for x in row] for row in M.tolist()]).reshape(M.nrows(), M.ncols())


def _size(M: Any) -> float:
    """An upper bound of the largest singular value: Frobenius' norm."""
    return float(sum((x * x for x in M.entries()), arb(0)).sqrt().upper()) * (1 + 1e-12)


def _is_positive(F: Any) -> bool:
    """Whether a symmetric matrix of balls is positive definite: near one after a congruence, by its rows."""
    try:
        X = ball(np.linalg.inv(np.linalg.cholesky(middle(F))).T)
    except np.linalg.LinAlgError:
        return False
    rows = (X.transpose() * F * X).tolist()
    return all(
        bool(sum((abs(x - int(i == j)) for j, x in enumerate(row)), arb(0)) < 1) for i, row in enumerate(rows)
    )


@dataclass(frozen=True, eq=False)
class _Choice:
    """P(p) in floating point: of the frozen loop with a faster clock, from one Q."""

    loop: MovingLoop
    Q: FloatArray
    scale: float  # of Phi, above 1

    @classmethod
    def of(cls, loop: MovingLoop, low: float, high: float, share: float) -> _Choice | None:
        """None where a frozen loop is unstable."""
        frozen = [middle(loop.at(p)) for p in np.linspace(low, high, 9)]
        radius = max(np.abs(np.linalg.eigvals(Phi)).max() for Phi in frozen)
        if not radius < 1:
            return None
        _, V = np.linalg.eig(frozen[len(frozen) // 2])
        back = np.linalg.pinv(V)
        acts = np.abs(back @ (frozen[-1] - frozen[0]) @ V)  # of p on modes, scaled so that it is small
        _, (size, _) = linalg.matrix_balance(acts + 1e-9 * acts.max() + 1e-300, permute=False, separate=True)
        back = back / size[:, None]
        return cls(loop, (back.conj().T @ back).real, radius**-share)

    def at(self, Phi: Any) -> Any:
        """P as balls of no width; symmetric."""
        P = linalg.solve_discrete_lyapunov(self.scale * middle(Phi).T, self.Q)
        return ball((P + P.T) / 2)


def _pieces(loop: MovingLoop, low: float, high: float, share: float) -> tuple[list[_Piece], Norms] | str:
    """The pieces of the interval, each proven; else why not."""
    choice = _Choice.of(loop, low, high, share)
    if choice is None:
        return "the loop is unstable at a frozen value"
    known, nodes = dict[tuple[float, float], Any](), dict[float, Any]()

    def node(cell: CellOfLoop, p: float) -> tuple[Any, Any]:
        if (cell.low, p) not in known:
            known[cell.low, p] = Phi = cell.at(p)
            nodes.setdefault(p, choice.at(Phi))  # P is one where two cells meet
        return known[cell.low, p], nodes[p]

    g = float(1 - choice.scale**-1.5)  # of what P has at its nodes, 1 - scale^-2
    norms = loop.norms(choice.at(loop.at((low + high) / 2)))
    found, stack = list[_Piece](), [(cell, cell.low, cell.high) for cell in reversed(loop.cells)]
    while stack:
        cell, a, b = stack.pop()
        if is_past(price=PIECE * node(cell, a)[0].nrows() ** 3):
            return "the work was up"
        piece = _prove(norms, g, (a, b), node(cell, a), node(cell, b))
        if piece is not None:
            found.append(piece)
        elif b - a < MIN_PIECE_SHARE * (high - low):
            return f"no piece was proven at {a:g}"
        else:
            stack += [(cell, (a + b) / 2, b), (cell, a, (a + b) / 2)]
    return found, norms


class _Units:
    """Units of x in which A is about as large as its frequencies, and norms there.

    The change of x at the end of a sample by a change of p is the integral of e^(A (T - s)) A_1 x(s), twice so for the
    second derivative, and |x(s)| <= e^(|A| s) (|x| + T |B u|).
    """

    def __init__(self, loop: _Loop, most: float, P: Any) -> None:
        self.n, self.T = loop.n, loop.T
        n = loop.n
        self.U = ball(np.linalg.inv(np.linalg.cholesky(middle(P)[:n, :n])).T)
        self.back = self.U.inv()
        A, A1 = (self.back * _part(M, n, n) * self.U for M in loop.M)
        self.slope = spectral(A1)
        self.speed = spectral(A) + most * self.slope
        top, rest = loop.R.tolist()[:n], loop.R.tolist()[n:]
        drive = arb_mat([row[n:] for row in loop.M[0].tolist()[:n]])
        self.reads = self.back * arb_mat(top), self.back * drive * arb_mat(rest) * arb(loop.T)

    def changes(self, X: Any, back: Any, low: float, high: float) -> Changes:  # noqa: ARG002
        """The same in every interval."""
        into = spectral(_part(back, back.nrows(), self.n) * self.U)
        spread = into * sum(spectral(read * X) for read in self.reads)
        grown, T = math.exp(self.speed * self.T), self.T
        return Changes(spread, spread * grown * self.slope * T**2, spread * (T * self.slope) ** 2 * grown)


def _part(M: Any, rows: int, columns: int) -> Any:
    return arb_mat([row[:columns] for row in M.tolist()[:rows]])


def spectral(M: Any) -> float:
    """An upper bound of the largest singular value, close to it."""
    near = float(np.linalg.norm(middle(M), 2)) * (1 + 1e-6) + 1e-300
    n = M.ncols()
    gram = arb_mat([[arb(near) ** 2 * int(i == j) for j in range(n)] for i in range(n)]) - M.transpose() * M
    return near if _is_positive(gram) else _size(M)


def _prove(
    norms: Norms, g: float, ends: tuple[float, float], one: tuple[Any, Any], two: tuple[Any, Any]
) -> _Piece | None:
    """The piece between two nodes (Phi, P) at its ends; None where it is not proven."""
    h = ends[1] - ends[0]
    (Phi_a, P_a), (Phi_b, P_b) = one, two
    P, D = (P_a + P_b) * arb(0.5), (P_b - P_a) * (arb(1) / arb(h))
    try:
        X = ball(np.linalg.inv(np.linalg.cholesky(middle(P))).T)  # units in which P is one, but for rounding
    except np.linalg.LinAlgError:
        return None
    back = X.inv()
    d = float(np.abs(linalg.eigvalsh(middle(D), middle(P))).max()) * (1 + 1e-6) + 1e-12
    if h * d / 2 > 0.5 or not all(_is_positive(P * arb(d) + D * arb(sign)) for sign in (1, -1)):
        return None
    wide = math.sqrt((1 + h * d / 2) / (1 - h * d / 2)) * (1 + 1e-9)  # of norms within the piece
    off = _size(X.transpose() * P * X - ball(np.eye(P.nrows())))
    if off > UNIT_TOLERANCE:
        return None
    near = math.sqrt((1 + off) / (1 - off)) * (1 + 1e-9)  # norms in P over those in X
    try:
        spread, first, bent = (near * size for size in norms.changes(X, back, *ends))
    except NotAnalytic:  # of a piece that is too wide
        return None
    chord = near * _size(back * (Phi_b - Phi_a) * X) / h + h / 2 * bent
    size = wide + h**2 / 8 * bent
    pi = 1 + h * d / 2
    curved = (2 * bent * pi * size + 2 * chord**2 * pi + 4 * chord * d * size) * h**2 / 8 * (1 + 1e-9)
    for Phi, own in ((Phi_a, P_a), (Phi_b, P_b)):
        if not _is_positive(own * (1 - arb(g)) - Phi.transpose() * own * Phi - P * arb(curved)):
            return None
    return _Piece(h, g, d / (1 - h * d / 2), spread * wide, first * wide)


def _rate(pieces: list[_Piece], loop: MovingLoop, norms: Norms) -> float:
    """The largest rate found for which V falls in every sample.

    What the motion of p within a sample changes beyond the first order is at most y^2 e^y / 2, y = rate T^2 slope.
    """
    T = loop.T
    steep = [max(p.slope for p in pieces[max(k - 1, 0) : k + 2]) for k in range(len(pieces))]

    def falls(rate: float) -> bool:
        y = rate * T**2 * norms.slope
        beyond = math.exp(norms.speed * T + y) * y**2 / 2 * (1 + 1e-9)
        return rate * T <= min(p.width for p in pieces) and all(
            (math.sqrt(1 - p.fall) + rate * p.first + p.spread * beyond) ** 2 * math.exp(rate * T * d)
            < 1 - 1e-12
            for p, d in zip(pieces, steep, strict=True)
        )

    low, high = 0.0, max(p.fall for p in pieces) / (T * max(max(steep), 1e-300))
    while high - low > 1e-3 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if falls(middle) else (low, middle)
    return low
