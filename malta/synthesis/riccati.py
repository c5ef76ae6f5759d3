"""Riccati equations, scaled, solved by python-control and checked.

control.care and control.dare find X of a scaled equation, by scipy (their method "scipy", whether or not slycot is
there). Where nothing goes into a gain file scipy is asked itself, which saves the import: to the bit the same X.

python-control, by scipy or slycot, is not indifferent to units. Positions in micrometres and sensor variances of
1e-13 m2 beside forces of newtons spread the Hamiltonian over twenty decades. Of 300 random systems in units over
twelve decades, control.care and control.dare refuse 4 and 1 %, and return 2 % of the gains wrong by more than 1 %,
silently (slycot: 20, 32 and 15 %): scipy balances the pencil, and never looks at X. So R is made the identity, the
states are scaled until the Hamiltonian is balanced and then until X has a diagonal of ones, and time is counted in
its largest entry. What error is left, `_refine` takes off; where that moves X by more than the condition of the
equation allows, X is asked for another way, or refused. Systems that do not touch each other are solved one by one,
so that gains between them are exactly zero.

The gains are those of control.lqr, dlqr, lqe and dlqe where these keep their digits. For the shipped designs in SI
units the regulators agree to 1e-7 and better, the filters of dlqe to 1e-3; lqe refuses the planar motor. The filters
agree to 1e-9, too, once a state counts in its standard deviation after a prediction, and a sensor in that of its
noise: X then has a diagonal of ones.
"""

from __future__ import annotations

from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from malta.errors import CheckError, InputError
from malta.linear.matrices import eigenvalues, system_matrix

if TYPE_CHECKING:
    from malta.arrays import FloatArray

Solver = Literal[
    "python-control", "scipy"
]  # who finds X; the first is imported where it is asked, in two seconds

RESIDUAL = 1e-9  # largest accepted relative residual of a Riccati equation
LIBRARY_ROUNDING = 1e-8  # of the terms of an equation, beyond what the condition explains
REFINED_RESIDUAL = 1e-13  # above it a solution is refined; rounding leaves less than a tenth of it
EPS = float(np.finfo(float).eps)
STEPS = 8  # of Newton's at most; each squares the error
ROUNDING = 1e-16  # couplings below this, relative to what else acts on and from both ends, are none
LAST_SCALE_CHANGE = 1e-3  # the last change of scales that are rounded to powers of two
DOUBLINGS = 64  # at most: sums of 2^64 samples


class RiccatiSolution(NamedTuple):
    """X, the optimal gain, and the relative residual that X leaves."""

    X: FloatArray
    K: FloatArray
    residual: float


class _Equation(NamedTuple):
    """A Riccati equation on state scales t: x = t x_scaled. X and the weights count in `unit`."""

    A: FloatArray
    B: FloatArray
    Q: FloatArray
    R: FloatArray
    t: FloatArray
    unit: float
    discrete: bool


class _ScaledSolution(NamedTuple):
    """A solution of a scaled equation, its gain, A - B K, and the relative residual."""

    equation: _Equation
    X: FloatArray
    K: FloatArray
    closed: FloatArray
    residual: float


def care(
    A: FloatArray,
    B: FloatArray,
    Q: FloatArray,
    R: FloatArray,
    what: str = "CARE",
    *,
    N: FloatArray | None = None,
    solver: Solver = "scipy",
) -> RiccatiSolution:
    """Solve A'X + XA - (XB + N) R^-1 (B'X + N') + Q = 0 for the stabilizing X; K = R^-1 (B'X + N').

    The Kalman filter is the dual: care(A.T, C.T, W, V).K.T with intensities W, V. X >= 0 where [Q N; N' R] >= 0; other
    weights, as of games and of passive systems, may have a stabilizing X, which may then be indefinite.

    A, Q : n x n, B, N : n x m, R : m x m
    Raises InputError (shapes, NaN, R not > 0) and CheckError (no stabilizing solution, residual above 1e-9, a solver
    whose X is further off than the condition allows, X not >= 0 where the weights are); `what` opens the message.
    """
    return _by_parts(
        A, B, Q, R, np.zeros_like(B) if N is None else N, _RiccatiTask(what, solver, discrete=False)
    )


def dare(
    A: FloatArray,
    B: FloatArray,
    Q: FloatArray,
    R: FloatArray,
    N: FloatArray | None = None,
    what: str = "DARE",
    *,
    solver: Solver = "scipy",
) -> RiccatiSolution:
    """Solve the discrete Riccati equation for the cost sum x'Qx + 2 x'Nu + u'Ru; u = -Kx, the stabilizing one.

    R may be singular, as what an input moves costs, too: R + B'XB > 0.

    A, Q : n x n, B, N : n x m, R : m x m. Raises as `care`.
    """
    S = np.zeros_like(B) if N is None else N
    _check_shapes(A, B, Q, R, S, what)
    if not _is_definite(R):
        return _with_known_cost(A, B, Q, R, S, _RiccatiTask(what, solver, discrete=True))
    return _by_parts(A, B, Q, R, S, _RiccatiTask(what, solver, discrete=True))


class _RiccatiTask(NamedTuple):
    """What an equation is for, as messages say it, who solves it, and of which kind it is."""

    what: str
    solver: Solver
    discrete: bool


def _with_known_cost(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, N: FloatArray, task: _RiccatiTask
) -> RiccatiSolution:
    """The solution as X0 + Y, with X0 such that R + B'X0B > 0: the equation of Y has this as its weight of inputs.

    x+'X0 x+ - x'X0 x is a sum that ends at rest, so it changes no optimum.
    """
    with np.errstate(all="ignore"):
        t = _balance(A - np.eye(len(A)), B @ B.T, Q)
    one = np.diag(1 / t**2)
    size = np.abs(B.T @ one @ B).max()
    X0 = one * ((np.abs(R).max() or np.abs(Q * np.outer(t, t)).max()) / size if size else 1.0)
    R1 = _symmetric(R + B.T @ X0 @ B)
    if not _is_definite(R1):
        expected = "R > 0, or R + B'XB > 0"
        raise InputError(task.what, "R", "a matrix that is not positive definite", expected)
    Y = _by_parts(A, B, _symmetric(Q + A.T @ X0 @ A - X0), R1, N + A.T @ X0 @ B, task)
    X = X0 + Y.X
    terms = [A.T @ X @ A, -X, -(A.T @ X @ B + N) @ Y.K, Q]
    residual = float(np.linalg.norm(sum(terms)) / sum(np.linalg.norm(term) for term in terms))
    if not residual <= RESIDUAL:
        raise CheckError(f"{task.what}: the relative residual is {residual:.1e}, allowed {RESIDUAL:.0e}")
    return RiccatiSolution(X, Y.K, residual)


@np.errstate(all="ignore")  # what overflows fails its check below
def _by_parts(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, N: FloatArray, task: _RiccatiTask
) -> RiccatiSolution:
    X, K, residual = np.zeros_like(A), np.zeros_like(B.T), 0.0
    for i, j in _parts(A, B, Q, R, N, task.what):
        ii, ij = np.ix_(i, i), np.ix_(i, j)
        U = np.linalg.cholesky(_symmetric(R[np.ix_(j, j)]))
        B0 = linalg.solve_triangular(U, B[ij].T, lower=True).T  # the input weight is the identity
        S = linalg.solve_triangular(U, N[ij].T, lower=True).T
        A0, Q0 = A[ii] - B0 @ S.T, Q[ii] - S @ S.T  # the cross term, absorbed into u + S'x
        found = _solution_of(B0.shape, A0.tobytes(), B0.tobytes(), Q0.tobytes(), task)
        t, unit = found.equation.t, found.equation.unit
        X[ii] = found.X * unit / np.outer(t, t)
        K[np.ix_(j, i)] = linalg.solve_triangular(U.T, found.K / t + S.T, lower=False)
        residual = max(residual, found.residual)
    return RiccatiSolution(X, K, residual)


# A slider moves one weight: the equations of other axes, and the filter's, are the same.
@lru_cache(maxsize=64)
def _solution_of(shape: tuple[int, int], a: bytes, b: bytes, q: bytes, task: _RiccatiTask) -> _ScaledSolution:
    """The first solution that is as good as rounding allows, or else the best; R is the identity."""
    A, B, Q = (np.frombuffer(entries).reshape(shape[0], -1) for entries in (a, b, q))
    candidates: list[_ScaledSolution] = []
    failures: list[Exception] = []
    what, discrete = task.what, task.discrete
    balanced = _balance(A - discrete * np.eye(len(A)), B @ B.T, Q)
    for way in (_symplectic, _bilinear) if discrete else (_hamiltonian,):
        t = balanced
        try:
            for last in (False, True):
                equation = _on_scales(t, A, B, Q, discrete=discrete)
                X = way(equation, task.solver)
                t = t if last else _unit_diagonal(t, X * equation.unit)
            given = _evaluate(equation, X)
            found = _refine(given)
            _compare(given, found, task.solver)
        except (ValueError, CheckError) as error:
            failures.append(error)
            continue
        candidates.append(found)
        if found.residual <= REFINED_RESIDUAL:
            break
    if not candidates:
        first = failures[0]
        said = (
            str(first)
            if isinstance(first, CheckError)
            else f"no stabilizing solution ({_first_sentence(first)})"
        )
        raise CheckError(f"{what}: {said}") from first
    found = min(candidates, key=lambda candidate: candidate.residual)
    _check(found, what, definite=np.linalg.eigvalsh(Q).min() >= -1e-12 * np.abs(Q).max())
    return found


def _library_solution(
    solver: Solver, A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, *, discrete: bool
) -> FloatArray:
    """X as a library finds it. The equation is scaled: neither of them does that."""
    if solver == "scipy":
        return np.asarray(
            (linalg.solve_discrete_are if discrete else linalg.solve_continuous_are)(A, B, Q, R)
        )
    import control

    return np.asarray((control.dare if discrete else control.care)(A, B, Q, R, method="scipy")[0])


def _hamiltonian(equation: _Equation, solver: Solver) -> FloatArray:
    """X from the stable subspace of the Hamiltonian; time counts in the largest entry of A."""
    A, B, Q, R = equation[:4]
    rate = np.abs(A).max() or 1.0
    return _library_solution(solver, A / rate, B / np.sqrt(rate), Q / rate, R, discrete=False)


def _symplectic(equation: _Equation, solver: Solver) -> FloatArray:
    """X from a basis of the stable subspace of a pencil, [I; X] times some matrix.

    X counts in units of Q. Where weights are weak or samples short Q is small beside X, and the I beside this X: the
    ratio is lost in digits. scipy balances the pencil once more and so returns to these units from any other.
    """
    return _library_solution(solver, *equation[:4], discrete=True)


def _bilinear(equation: _Equation, solver: Solver) -> FloatArray:
    """X as that of a continuous equation, z = (1 + s) / (1 - s): where poles are close to 1 it keeps their digits.

        A_c = (A - I) V,  B_c = sqrt(2) V B H^-1/2,  Q_c = 2 V' Q V,  V = (A + I)^-1,  H = I + B' V' Q V B

    with the cross term N_c = -sqrt(2) V' Q V B H^-1/2: both have the same costs, so the same X, which
    counts in the unit on which its diagonal is of ones.
    """
    A, B, one = equation.A, equation.B, np.eye(len(equation.A))
    Q, V = equation.Q * equation.unit, np.linalg.inv(A + one)
    G = V @ B
    U = np.linalg.cholesky(np.eye(B.shape[1]) + G.T @ Q @ G)
    G = np.sqrt(2) * linalg.solve_triangular(U, G.T, lower=True).T
    N = -V.T @ Q @ G
    F, W = (A - one) @ V - G @ N.T, _symmetric(2 * V.T @ Q @ V - N @ N.T)
    found = _Equation(F, G, W, np.eye(B.shape[1]), equation.t, 1.0, discrete=False)
    return _hamiltonian(found, solver) / equation.unit


def _compare(given: _ScaledSolution, found: _ScaledSolution, solver: Solver) -> None:
    """CheckError where refining has moved X by more than the condition of the equation allows."""
    if found is given:
        return
    apart = np.linalg.norm(given.X - found.X, 2) / np.linalg.norm(found.X, 2)
    if apart <= LIBRARY_ROUNDING:  # a condition is 1 or more
        return
    allowed = LIBRARY_ROUNDING * _condition(found)
    if not apart <= allowed:
        said = f"the solution of {solver} is {apart:.1e} from its refinement"
        raise CheckError(f"{said}, and the condition of the equation allows {allowed:.1e}")


def _condition(found: _ScaledSolution) -> float:
    """How many times a relative change of the terms of the equation changes X, relative to X.

    The Lyapunov operator of A - B K takes what the terms change by to what X does (Kenney, Hewer, SIAM J. Control
    Optim. 28(1), 1990); its inverse's norm is that of its answer to the identity.
    """
    A, B, Q, R, _, _, discrete = found.equation
    X, closed = found.X, found.closed
    size = partial(np.linalg.norm, ord=2)
    back = size(lyapunov(closed, np.eye(len(A)), discrete=discrete))
    pushed = size(B @ np.linalg.solve(R + discrete * B.T @ X @ B, B.T)) * size(X)
    terms = (1 + size(A)) ** 2 + pushed * size(closed) ** 2 if discrete else 2 * size(A) + pushed
    return float(back * (terms + size(Q) / size(X)))


def _refine(found: _ScaledSolution) -> _ScaledSolution:
    """Newton's steps (Kleinman, IEEE Trans. Autom. Control 13(1), 1968), where and while they lower the residual.

    A step solves the Lyapunov equation of the loop that X closes. From a gain that does not stabilize, Newton's
    iteration ends anywhere: what it ends in has to stabilize by more than rounding, or is not taken.
    """
    A, B, Q, R, _, _, discrete = found.equation
    best = found
    for _ in range(0 if found.residual <= REFINED_RESIDUAL else STEPS):
        X, K = best.X, best.K
        F = A - discrete * np.eye(len(A)) - B @ K  # of x+ - x: its products with X are as small as Q
        left = F.T @ X + X @ F + K.T @ R @ K + Q + discrete * F.T @ X @ F
        better = _evaluate(found.equation, X + lyapunov(best.closed, _symmetric(left), discrete=discrete))
        if not better.residual < best.residual:  # or NaN
            break
        best = better
    return best if best is found or _stands(best) else found


def _stands(found: _ScaledSolution) -> bool:
    """Whether the closed loop stays stable when rounding moves it: rounding of A - B K, and of Q through X and K."""
    A, B, Q, R, _, _, discrete = found.equation
    size, closed = np.linalg.norm, found.closed
    P = size(lyapunov(closed, np.eye(len(A)), discrete=discrete))
    dX = size(lyapunov(closed, np.diag(np.abs(Q).sum(1)), discrete=discrete))  # zeros of Q are exact
    held = size(closed) if discrete else 1.0
    G = B @ np.linalg.solve(R + discrete * B.T @ found.X @ B, B.T)
    moved = EPS * (size(A) + size(B) * size(found.K) + size(G) * dX * held)
    return bool(2 * moved * held * P < 1)


def lyapunov(F: FloatArray, M: FloatArray, *, discrete: bool) -> FloatArray:
    """P of F'PF - P + M = 0, or of F'P + PF + M = 0: the sum of F'^k M F^k, doubled (Smith, 1968).

    Infinite or NaN where F is not stable.
    """
    if not discrete:  # Cayley's transform has the same P
        poles = eigenvalues(F)
        if not poles.real.max() < 0:
            return np.full_like(F, np.nan)
        fast, slow = np.abs(poles).max(), np.abs(poles).min()
        rate = np.sqrt(fast * max(slow, EPS * fast)) * np.eye(len(F))
        V = np.linalg.inv(rate - F)
        F, M = (rate + F) @ V, 2 * V.T @ M @ V * rate.max()
    P = M
    for _ in range(DOUBLINGS):
        step = F.T @ P @ F
        P, F = P + step, F @ F
        if not np.linalg.norm(step) > EPS * np.linalg.norm(P):  # or NaN
            break
    return _symmetric(P)


def _on_scales(t: FloatArray, A: FloatArray, B: FloatArray, Q: FloatArray, *, discrete: bool) -> _Equation:
    Q1 = _symmetric(Q) * np.outer(t, t)
    unit = (np.abs(Q1).max() or 1.0) if discrete else 1.0
    return _Equation(
        A * t / t[:, None], B / t[:, None], Q1 / unit, np.eye(B.shape[1]) / unit, t, unit, discrete
    )


def _evaluate(equation: _Equation, X: FloatArray) -> _ScaledSolution:
    """The gain of X and the residual that it leaves, relative to the terms of the equation."""
    A, B, Q, R = equation[:4]
    X = _symmetric(X)
    if equation.discrete:
        K = np.linalg.solve(R + B.T @ X @ B, B.T @ X @ A)
        terms = [A.T @ X @ A, -X, -(A.T @ X @ B) @ K, Q]
    else:
        K = B.T @ X
        terms = [A.T @ X, X @ A, -K.T @ K, Q]
    size = sum(np.linalg.norm(term) for term in terms)
    residual = float(np.nan_to_num(np.linalg.norm(sum(terms)) / size, nan=np.inf)) if size else 0.0
    return _ScaledSolution(equation, X, K, A - B @ K, residual)


def _parts(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, N: FloatArray, what: str
) -> list[tuple[NDArray[np.int_], NDArray[np.int_]]]:
    """The states and inputs of each subsystem that nothing joins to the others, once the arguments are checked."""
    _check_shapes(A, B, Q, R, N, what)
    if not _is_definite(R):
        raise InputError(what, "R", "a matrix that is not positive definite", "R > 0")
    n, m = B.shape
    count, label = sparse.csgraph.connected_components(_touch(A, B, Q, R, N), directed=False)
    parts = [(np.flatnonzero(label[:n] == k), np.flatnonzero(label[n:] == k)) for k in range(count)]
    if any(not len(i) or not len(j) for i, j in parts):  # a state without input, an input without state
        return [(np.arange(n), np.arange(m))]
    return parts


def _check_shapes(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, N: FloatArray, what: str
) -> None:
    n, m = B.shape
    named = {"A": (A, (n, n)), "B": (B, (n, m)), "Q": (Q, (n, n)), "R": (R, (m, m)), "N": (N, (n, m))}
    for name, (M, shape) in named.items():
        if M.shape != shape:
            raise InputError(what, name, f"shape {M.shape}", f"{shape}, as B is {B.shape}")
        if not np.isfinite(M).all():
            raise InputError(what, name, "NaN or infinity", "finite numbers")
    for name, M in (("Q", Q), ("R", R)):
        if np.abs(M - M.T).max() > 1e-12 * np.abs(M).max():
            raise InputError(what, name, "an unsymmetric matrix", "a symmetric one")


def _is_definite(R: FloatArray) -> bool:
    """Whether R > 0, its inputs in any units."""
    r = np.sqrt(np.where(np.diag(R) > 0, np.diag(R), 1))
    return bool(np.linalg.eigvalsh(R / np.outer(r, r)).min() > 0)


def _touch(A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, N: FloatArray) -> NDArray[np.bool_]:
    """Which states and inputs act on each other by more than rounding, in balanced units.

    What a model's trigonometry leaves of exact zeros, 1e-20 of the loop's own stiffness, joins nothing.
    """
    r = np.sqrt(np.diag(R))
    t = _balance(A, (B / r) @ (B / r).T, Q)
    scaled = np.abs(system_matrix(A * t / t[:, None], B / r / t[:, None], N.T * t / r[:, None]))
    weights = np.abs(linalg.block_diag(Q, R))
    own = np.sqrt(np.diag(weights))  # zero beside an entry: indefinite, and joined
    large = np.sqrt(np.outer(scaled.max(axis=1, initial=0), scaled.max(axis=0, initial=0)))
    return np.asarray((scaled > ROUNDING * large) | (weights > ROUNDING * np.outer(own, own)))


def _balance(A: FloatArray, G: FloatArray, Q: FloatArray) -> FloatArray:
    """State scales t (x = t x_scaled) that balance the Hamiltonian [[A, -G], [-Q, -A']].

    Osborne's iteration, restricted to the scalings that keep it Hamiltonian.
    """
    a, g, q = ((np.abs(M) ** 2) for M in (A - np.diag(np.diag(A)), G, Q))
    s = np.ones(len(A))  # t^2
    for _ in range(100):
        r = 1 / s
        falls, grows = (a @ s + g @ r) * r, (r @ a + s @ q) * s  # sums of squares, with t
        # G_ii and Q_ii change with t_i^2, squared here: with the fourth root of off-diagonal entries they oscillate.
        step = np.sqrt(np.sqrt(np.where((falls > 0) & (grows > 0), falls / grows, 1.0)))
        s = s * step
        if np.abs(step - 1).max(initial=0.0) < LAST_SCALE_CHANGE:
            break
    t = np.sqrt(s)
    return _powers_of_two(t)


def _unit_diagonal(t: FloatArray, X: FloatArray) -> FloatArray:
    """Scales on which X, solved on the scales t, has a diagonal of ones: it is then found to most digits.

    Balance alone leaves X large where weights are weak and the regulator only mirrors the unstable poles.
    """
    diagonal = np.diag(X)
    return _powers_of_two(t / np.sqrt(np.where(diagonal > 0, diagonal, 1)))


def _symmetric(M: FloatArray) -> FloatArray:
    return (M + M.T) / 2


def _powers_of_two(t: FloatArray) -> FloatArray:
    return np.asarray(np.exp2(np.round(np.log2(t))))  # scaling by them adds no rounding


def _check(found: _ScaledSolution, what: str, *, definite: bool) -> None:
    poles = eigenvalues(found.closed)
    discrete = found.equation.discrete
    excess = np.abs(poles).max() - 1 if discrete else poles.real.max()
    rounding = 4 * EPS if discrete else _rounding_of_poles(found)  # a pole this close may be on either side
    if not found.residual <= RESIDUAL:
        raise CheckError(f"{what}: the relative residual is {found.residual:.1e}, allowed {RESIDUAL:.0e}")
    if not excess < -rounding:
        raise CheckError(f"{what}: the closed loop is not stable (excess {excess:.1e})")
    if definite and np.linalg.eigvalsh(found.X).min() < -1e-9 * np.abs(found.X).max():
        raise CheckError(f"{what}: the solution is not positive semidefinite")


def _rounding_of_poles(found: _ScaledSolution) -> float:
    """How far rounding of A and B K may move the slowest pole of A - B K: |y'| (|A| + |B| |K|) |x| / |y'x|; a double
    pole at most, and the largest pole's at least."""
    A, B = found.equation[:2]
    modes: Any = linalg.eig(found.closed, left=True)  # its stubs know two results
    poles, left, right = modes
    k = int(poles.real.argmax())
    y, x = left[:, k], right[:, k]
    size = np.abs(A) + np.abs(B) @ np.abs(found.K)
    moved = (np.abs(y) @ size @ np.abs(x)) / max(abs(y.conj() @ x), EPS**0.5)
    return 4 * EPS * max(float(moved), float(np.abs(poles).max()))


def _first_sentence(error: Exception) -> str:
    return str(error).split(";")[0].split(". ")[0].rstrip(".")
