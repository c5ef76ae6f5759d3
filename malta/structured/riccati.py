"""H-infinity laws of full order: two Riccati equations for a generalized plant, mixed sensitivity, loop shaping.

    x' = A x + B1 w + B2 u,   z = C1 x + D11 w + D12 u,   y = C2 x + D21 w + D22 u,   u = K y

A stabilizing K with |T_zw| < gamma exists exactly when X >= 0 and Y >= 0 solve

    A'X + XA + Q - (X B + S) R^-1 (B'X + S') = 0    and its dual,    and    rho(X Y) < gamma^2

with R = D1'D1 - diag(gamma^2, 0), D1 = [D11 D12], S = C1'D1 (Glover and Doyle, Systems & Control Letters 11 (1988);
Zhou, Doyle and Glover, Robust and Optimal Control, theorem 17.1, whose letters these are). R is indefinite, which that
of a regulator is not; so they are solved here, by an ordered Schur form of their Hamiltonian matrices.

Laws of lower order: the states that matter least at input and output are left out, integrals are kept.

Source: B. C. Moore, Principal component analysis in linear systems, IEEE Trans. Automat. Contr. 26(1), 1981; the bound
of the error is that of D. F. Enns, CDC 1984, and K. Glover, Int. J. Control 39(6), 1984.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import linalg
from scipy.linalg import matrix_balance

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.linear.conversion import from_control
from malta.linear.diagrams import interconnect, lft
from malta.linear.interconnection import append, gain, series
from malta.linear.matrices import system_matrix
from malta.linear.peaks import peak_gain
from malta.linear.reduction import balanced_reduction
from malta.linear.system import System
from malta.processes import on_one_thread
from malta.synthesis.elements import CALLER

H_INFINITY = "h_infinity"
TOLERANCE = 1e-6  # relative, of the smallest gamma
GAMMA_RESERVE = 1e-3  # relative, above the smallest gamma: there the law's numbers stay small
RESIDUAL = 1e-6  # relative, of a Riccati equation
RANK = 1e-9
MAX_SIGN_STEPS = 60  # Newton converges in ten to twenty
MAX_GAMMA = 1e8  # gamma, beyond which no law is looked for


@display
@dataclass(frozen=True, eq=False)
class Synthesized:
    """An H-infinity law with what was checked of it.

    law : A, B, C and D of u = K y, as many states as the generalized plant
    gamma : the smallest for which the two equations have their solutions
    norm : of the closed loop with this law, by its Hamiltonian matrix; at most a thousandth above gamma
    w : rad/s, at which the norm is reached
    coupling : rho(X Y) / gamma^2 at the gamma of the law, below 1
    residual : the larger relative one of the equations

    >>> from malta import structured
    >>> D = [[0, 0, 0], [0, 0, 1], [0, 1, 0]]
    >>> P = [[0.0]], [[1.0, 0.0, 1.0]], [[1.0], [0.0], [1.0]], D
    >>> f"{structured.h_infinity(P, 1, 1).gamma:.4f}"  # sqrt 2
    '1.4142'
    """

    law: System
    gamma: float
    norm: float
    w: float
    coupling: float
    residual: float

    @property
    def description(self) -> Description:
        """Its checks."""
        rows = (
            ("closed loop", f"{self.norm:.6g} at {self.w:.4g} rad/s"),
            ("coupling", f"rho(X Y) = {self.coupling:.4g} gamma^2"),
            ("residual", f"{self.residual:.1e}"),
        )
        return Description(f"H-infinity law of {len(self.law.A)} states, gamma = {self.gamma:.6g}", rows)


class _Problem(NamedTuple):
    """A generalized plant with D12 = [0; 1], D21 = [0 1] and D22 = 0."""

    A: FloatArray
    B1: FloatArray
    B2: FloatArray
    C1: FloatArray
    C2: FloatArray
    D11: FloatArray

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """Inputs w and u, outputs z and y."""
        return self.B1.shape[1], self.B2.shape[1], len(self.C1), len(self.C2)


class _Solved(NamedTuple):
    gamma: float
    X: FloatArray
    Y: FloatArray
    F: FloatArray
    L: FloatArray
    residual: float

    @property
    def coupling(self) -> float:
        return float(np.abs(np.linalg.eigvals(self.X @ self.Y)).max(initial=0.0)) / self.gamma**2


@on_one_thread
def h_infinity(plant: Any, outputs: int, inputs: int) -> Synthesized:
    """Find the law u = K y with the smallest peak of the gain from w to z.

    plant : continuous control.StateSpace, or A, B, C and D, whose last inputs are u and whose last outputs are y
    outputs, inputs : numbers of y and of u

    Returns a Synthesized: `gamma` to six digits, and a law that reaches it to a thousandth, checked by the norm of its
    loop.

    Raises InputError for shapes that do not fit, inputs u that z does not weigh, outputs y without noise, and plants
    that no law stabilizes. Raises CheckError where the closed loop does not keep what the equations promise.

    >>> from malta import structured
    >>> D = [[0, 0, 0], [0, 0, 1], [0, 1, 0]]
    >>> P = [[0.0]], [[1.0, 0.0, 1.0]], [[1.0], [0.0], [1.0]], D
    >>> found = structured.h_infinity(P, 1, 1)
    >>> found.gamma < found.norm < 1.001 * found.gamma
    True
    """
    whole = _system_of(plant)
    p2, m2 = int(outputs), int(inputs)
    p1, m1 = len(whole.D) - p2, whole.D.shape[1] - m2
    if min(p1, m1, p2, m2) < 1:
        found = f"{len(whole.D)} outputs and {whole.D.shape[1]} inputs"
        raise InputError(H_INFINITY, "plant", found, f"more than {p2} outputs and {m2} inputs")
    own = whole.balanced
    problem, back = _normal(own, p2, m2)
    best = _smallest(problem)
    solved = _solve(problem, best * (1 + GAMMA_RESERVE))
    if solved is None:
        raise CheckError(f"{H_INFINITY}: the equations have no solution just above gamma = {best:.6g}")
    law = back(_central(problem, solved))
    norm, w = _check_norm(own, law, solved.gamma)
    return Synthesized(law, best, norm, w, solved.coupling, solved.residual)


def _system_of(plant: Any) -> System:
    """A, B, C and D of a continuous system. Raises InputError."""
    if getattr(plant, "dt", None) not in (None, 0):
        raise InputError(H_INFINITY, "plant", f"a sample time of {plant.dt} s", "a continuous system")
    if hasattr(plant, "dt"):
        return from_control(plant, H_INFINITY, "plant")
    try:
        A, B, C, D = (np.atleast_2d(np.asarray(M, dtype=float)) for M in plant)
        found = System(A, B, C, D)
        fits = all(np.isfinite(M).all() for M in found)
    except (TypeError, ValueError, IndexError):
        fits = False
    if not fits:
        raise InputError(H_INFINITY, "plant", "matrices that do not fit, or no numbers", "A, B, C and D")
    return found


def _normal(whole: System, p2: int, m2: int) -> tuple[_Problem, Callable[[System], System]]:
    """The plant in units of w, z, u and y in which D12 = [0; 1], D21 = [0 1]; and the law's way back.

    Raises InputError where D12 has no full column rank, or D21 no full row rank.
    """
    A, B, C, D = whole
    m1, p1 = D.shape[1] - m2, len(D) - p2
    D12, D21, D22 = D[:p1, m1:], D[p1:, :m1], D[p1:, m1:]
    U, s, V = np.linalg.svd(D12)
    if p1 < m2 or not s.min() > RANK * max(s.max(), 1e-300):
        raise InputError(
            H_INFINITY, "D12", "an input u that z does not weigh at once", "a weight of every input u"
        )
    of_z, of_u = np.roll(U, -m2, axis=1).T, V.T / s  # of_z D12 of_u = [0; 1]
    U, s, V = np.linalg.svd(D21)
    if m1 < p2 or not s.min() > RANK * max(s.max(), 1e-300):
        raise InputError(
            H_INFINITY, "D21", "an output y that w does not reach at once", "noise of every output y"
        )
    of_w, of_y = np.roll(V.T, -p2, axis=1), (U / s).T  # of_y D21 of_w = [0 1]
    problem = _Problem(
        A, B[:, :m1] @ of_w, B[:, m1:] @ of_u, of_z @ C[:p1], of_y @ C[p1:], of_z @ D[:p1, :m1] @ of_w
    )

    def back(K: System) -> System:
        B_K, C_K, D_K = K.B @ of_y, of_u @ K.C, of_u @ K.D @ of_y
        inner = np.linalg.inv(np.eye(m2) + D_K @ D22)  # u = K (y - D22 u)
        A_K = K.A - B_K @ D22 @ inner @ C_K
        return System(A_K, B_K @ (np.eye(p2) - D22 @ inner @ D_K), inner @ C_K, inner @ D_K)

    return problem, back


def _stable_graph(H: FloatArray) -> FloatArray | None:
    """X of which the columns of [1; X] span the space of the stable half of a Hamiltonian's poles; None: no such X.

    Where rounding moves poles across the axis while the Schur form is ordered, the sign function of H has no order to
    find: (sign(H) + 1) [1; X] = 0. Source: Roberts, Int. J. Control 32(4), 1980; Newton's steps are scaled by det H.
    """
    n, one = len(H) // 2, np.eye(len(H) // 2)
    T: Any = H
    Z: Any = None
    try:
        T, Z, stable = linalg.schur(H, output="real", sort="lhp")
    except linalg.LinAlgError:
        stable = int((np.linalg.eigvals(H).real < 0).sum())
    if stable != n or np.abs(linalg.eigvals(T).real).min() < 1e-11 * np.abs(T).max():
        return None
    try:
        if Z is not None:
            return np.asarray(np.linalg.solve(Z[:n, :n].T, Z[n:, :n].T).T)
        sign: Any = H
        for _ in range(MAX_SIGN_STEPS):
            c = math.exp(-np.linalg.slogdet(sign)[1] / (2 * n))
            after = (c * sign + np.linalg.inv(c * sign)) / 2
            moved, sign = np.linalg.norm(after - sign), after
            if moved < 1e-14 * np.linalg.norm(sign):
                break
    except (np.linalg.LinAlgError, OverflowError):
        return None
    left, right = np.vstack([sign[:n, n:], sign[n:, n:] + one]), np.vstack([sign[:n, :n] + one, sign[n:, :n]])
    return np.asarray(-linalg.lstsq(left, right)[0]) if np.isfinite(sign).all() else None


def _riccati(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray
) -> tuple[FloatArray, float] | None:
    """The stabilizing X >= 0 of A'X + XA + Q - (XB + S) R^-1 (B'X + S') = 0, R indefinite, and its residual."""
    n = len(A)
    if not n:
        return np.zeros((0, 0)), 0.0
    inner = np.linalg.solve(R, np.hstack([S.T, B.T]))
    G, own = B @ inner[:, n:], A - B @ inner[:, :n]
    H = system_matrix(own, -G, -(Q - S @ inner[:, :n]), -own.T)
    _, (scale, _) = matrix_balance(H, permute=False, separate=True)
    t = np.sqrt(scale[:n] / scale[n:])  # symplectic: states by t, costates by 1 / t
    t = 2.0 ** np.round(np.log2(t))
    D = np.concatenate([t, 1 / t])
    X = _stable_graph(H / D[:, None] * D)
    if X is None:
        return None
    X = (X + X.T) / 2 / np.outer(t, t)
    terms = [A.T @ X, X @ A, Q, -(X @ B + S) @ np.linalg.solve(R, B.T @ X + S.T)]
    residual = float(np.linalg.norm(sum(terms)) / max(sum(np.linalg.norm(term) for term in terms), 1e-300))
    unit = X * np.outer(t, t)
    if residual > RESIDUAL or np.linalg.eigvalsh(unit).min() < -1e-8 * max(np.abs(unit).max(), 1.0):
        return None
    return X, residual


def _solve(p: _Problem, gamma: float) -> _Solved | None:
    """The two equations at gamma; None where one has no solution, or where rho(X Y) is too large."""
    m1, m2, p1, p2 = p.sizes
    D12, D21 = np.eye(p1, m2, m2 - p1), np.eye(p2, m1, m1 - p2)
    across, down = p.D11[: p1 - m2], p.D11[:, : m1 - p2]
    floor = max(np.linalg.norm(M, 2) if M.size else 0.0 for M in (across, down))
    if not gamma > floor:
        return None
    B, C = np.hstack([p.B1, p.B2]), np.vstack([p.C1, p.C2])
    D1, D_1 = np.hstack([p.D11, D12]), np.vstack([p.D11, D21])
    R, Rt = D1.T @ D1, D_1 @ D_1.T
    R[:m1, :m1] -= gamma**2 * np.eye(m1)
    Rt[:p1, :p1] -= gamma**2 * np.eye(p1)
    x = _riccati(p.A, B, p.C1.T @ p.C1, R, p.C1.T @ D1)
    y = _riccati(p.A.T, C.T, p.B1 @ p.B1.T, Rt, p.B1 @ D_1.T)
    if x is None or y is None:
        return None
    X, Y = x[0], y[0]
    F = -np.linalg.solve(R, D1.T @ p.C1 + B.T @ X)
    L = -np.linalg.solve(Rt, (p.B1 @ D_1.T + Y @ C.T).T).T
    found = _Solved(gamma, X, Y, F, L, max(x[1], y[1]))
    return found if found.coupling < 1 else None


def _smallest(p: _Problem) -> float:
    """The smallest gamma, by bisection. Raises InputError where there is none."""
    high = 1.0
    while _solve(p, high) is None:
        high *= 4
        if high > MAX_GAMMA:
            wanted = "a plant that u stabilizes and y shows, without zeros on the imaginary axis"
            raise InputError(H_INFINITY, "plant", f"no law up to gamma = {MAX_GAMMA:.0e}", wanted)
    low = high / 4
    while low > 1e-12 and _solve(p, low) is not None:
        low, high = low / 4, low
    while high > (1 + TOLERANCE) * low and high > 1e-12:
        middle = math.sqrt(low * high) if low > 0 else high / 2
        low, high = (low, middle) if _solve(p, middle) is not None else (middle, high)
    return high


def _central(p: _Problem, s: _Solved) -> System:
    """The central law."""
    m1, m2, p1, p2 = p.sizes
    a, b, g2 = p1 - m2, m1 - p2, s.gamma**2
    D1111, D1112, D1121, D1122 = p.D11[:a, :b], p.D11[:a, b:], p.D11[a:, :b], p.D11[a:, b:]
    left = np.linalg.inv(g2 * np.eye(a) - D1111 @ D1111.T)
    right = np.linalg.inv(g2 * np.eye(b) - D1111.T @ D1111)
    D11 = -D1121 @ D1111.T @ left @ D1112 - D1122
    D12 = np.linalg.cholesky(np.eye(m2) - D1121 @ right @ D1121.T)
    D21 = np.linalg.cholesky(np.eye(p2) - D1112.T @ left @ D1112).T
    F12, F2 = s.F[b:m1], s.F[m1:]
    L12, L2 = s.L[:, a:p1], s.L[:, p1:]
    Z = np.linalg.inv(np.eye(len(p.A)) - s.Y @ s.X / g2)
    B2, C2 = Z @ (p.B2 + L12) @ D12, -D21 @ (p.C2 + F12)
    B1 = -Z @ L2 + B2 @ np.linalg.solve(D12, D11)
    C1 = s.F[m1:] + D11 @ np.linalg.solve(D21, C2) if len(F2) else C2[:0]
    A = p.A + np.hstack([p.B1, p.B2]) @ s.F + B1 @ np.linalg.solve(D21, C2)
    return System(A, B1, C1, D11)


def _check_norm(P: System, K: System, gamma: float) -> tuple[float, float]:
    """The norm of the closed loop. Raises CheckError where it has no solution, is unstable, or above gamma."""
    try:
        closed = lft(P, K)
    except InputError as error:
        raise CheckError(f"{H_INFINITY}: the loop has no solution at infinite frequency") from error
    growth = float(np.linalg.eigvals(closed.A).real.max(initial=-math.inf))
    if not growth < 0:
        raise CheckError(f"{H_INFINITY}: the closed loop has a pole with Re = {growth:.3g} 1/s")
    norm, w = peak_gain(closed)
    if not norm <= gamma * (1 + 1e-4):
        raise CheckError(f"{H_INFINITY}: the closed loop has a peak of {norm:.6g}, gamma is {gamma:.6g}")
    return norm, w


def mixed_sensitivity(plant: Any, of_error: Any, of_input: Any = None, of_output: Any = None) -> Synthesized:
    """Find the law of the errors with the smallest max over w of sigma([W1 S; W2 K S; W3 T]).

    plant : continuous control system G of u
    of_error, of_input, of_output : W1, W2 and W3, control systems of one signal or of all, or numbers; None: left out

    Returns a Synthesized, whose law takes the errors r - y: u = K (r - G u).

    Raises InputError as `h_infinity`, for weights of other numbers of signals, and without a weight of the input.

    >>> import control
    >>> from malta import structured
    >>> G = control.tf([200], [0.025, 1.0025, 10.1, 1])
    >>> W = control.tf([1 / 1.5, 10], [1, 1e-3])
    >>> found = structured.mixed_sensitivity(G, W, 1.0)
    >>> f"{found.gamma:.2f}"  # Skogestad and Postlethwaite, example 2.17: 1.37
    '1.37'
    """
    G = from_control(plant, "mixed_sensitivity", "plant")
    p, m = G.D.shape
    signals = {
        letter: tuple(f"{letter}{i}" for i in range(n))
        for letter, n in zip("reyu", (p, p, p, m), strict=True)
    }
    minus = replace(
        gain(np.hstack([np.eye(p), -np.eye(p)])), inputs=signals["r"] + signals["y"], outputs=signals["e"]
    )
    parts = [replace(G, inputs=signals["u"], outputs=signals["y"]), minus]
    for name, weight, letter in (
        ("of_error", of_error, "e"),
        ("of_input", of_input, "u"),
        ("of_output", of_output, "y"),
    ):
        if weight is None:
            continue
        size, W = len(signals[letter]), _weight_of(weight, name)
        if W.D.shape[1] == 1 and size > 1:
            W = append(*[W] * size)
        if W.D.shape[1] != size:
            raise InputError("mixed_sensitivity", name, f"{W.D.shape[1]} signals", f"1 or {size}")
        outputs = tuple(f"{name}{i}" for i in range(len(W.D)))
        parts.append(replace(W, inputs=signals[letter], outputs=outputs))
    read = [name for W in parts[2:] for name in W.outputs]
    whole = interconnect(parts, signals["r"] + signals["u"], [*read, *signals["e"]])
    return h_infinity(whole, p, m)


def _weight_of(weight: Any, field: str) -> System:
    """A control system, or a number."""
    return from_control(weight, CALLER, field) if hasattr(weight, "dt") else gain(np.array([[float(weight)]]))


@on_one_thread
def shape_loop(plant: Any, before: Any = 1.0, after: Any = 1.0) -> Synthesized:
    """Find the law that stands the largest uncertainty of normalized coprime factors of a shaped plant.

    The shaped plant is G_s = W2 G W1, K = W1 K_s W2. gamma is sqrt(1 + rho(X Z)) in closed form, without a search. The
    margin is 1 / gamma: K stabilizes (M + dM)^-1 (N + dN) for every |[dN dM]| below it, with G_s = M^-1 N.

    plant : continuous, strictly proper control system
    before, after : W1 and W2, control systems or numbers

    Returns a Synthesized, whose law takes the errors r - y: negative feedback. Its norm is that of the four transfer
    functions [K; 1] (1 + G K)^-1 [1 G] of the shaped plant.

    Raises InputError for a plant with D, and for equations without a solution.

    Source: McFarlane and Glover, A loop-shaping design procedure, IEEE TAC 37 (1992).

    >>> import control
    >>> from malta import structured
    >>> found = structured.shape_loop(control.tf([1], [1, 0]))  # 1 / s: gamma = sqrt 2
    >>> f"{found.gamma:.4f}"
    '1.4142'
    """
    G = from_control(plant, "shape_loop", "plant")
    W1, W2 = _shaping_weight(before, G.D.shape[1], "before"), _shaping_weight(after, len(G.D), "after")
    shaped = series(W1, G, W2)
    A, B, C, D = _system_of(shaped)
    if D.any():
        raise InputError("shape_loop", "plant", "a plant with D", "a strictly proper one")
    n, p, m = len(A), len(C), B.shape[1]
    x = _riccati(A, B, C.T @ C, np.eye(m), np.zeros((n, m)))
    z = _riccati(A.T, C.T, B @ B.T, np.eye(p), np.zeros((n, p)))
    if x is None or z is None:
        raise InputError(
            "shape_loop", "plant", "one that no law stabilizes", "a plant that u stabilizes and y shows"
        )
    X, Z = x[0], z[0]
    best = math.sqrt(1 + float(np.linalg.eigvals(X @ Z).real.max(initial=0.0)))
    gamma = best * (1 + GAMMA_RESERVE)
    inner = (1 - gamma**2) * np.eye(n) + X @ Z
    back = np.linalg.inv(inner.T)
    F = -B.T @ X
    own = System(A + B @ F + gamma**2 * back @ Z @ C.T @ C, gamma**2 * back @ Z @ C.T, F, np.zeros((m, p)))
    # w = (r, d): y = r - G (u + d); z = (u, y)
    direct = system_matrix(np.zeros((m, p + m)), np.eye(m), np.tile(np.eye(p, p + m), (2, 1)))
    four = System(A, np.hstack([np.zeros((n, p)), B, B]), np.vstack([np.zeros((m, n)), -C, -C]), direct)
    norm, w = _check_norm(four, own, gamma)
    coupling = float(np.abs(np.linalg.eigvals(X @ Z)).max(initial=0.0)) / (gamma**2 - 1)
    return Synthesized(series(W2, own, W1), best, norm, w, coupling, max(x[1], z[1]))


def _shaping_weight(one: Any, size: int, field: str) -> System:
    """A control system, or a number for all signals."""
    return from_control(one, "shape_loop", field) if hasattr(one, "dt") else gain(float(one) * np.eye(size))


INTEGRAL_POLE_RATE = 1.0  # rad/s: a pole below counts as an integral


def split_integrals(law: System) -> tuple[System, System]:
    """Split a continuous law into its integrals, with their poles at 0, and the rest, with D.

    Poles below 1 rad/s count as integrals. The sum of both is the law, but for these poles.

    >>> from malta.linear.system import System
    >>> import numpy as np
    >>> law = System(np.diag([0.0, -10.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    >>> integrals, rest = split_integrals(law)
    >>> integrals.A.tolist(), rest.A.round(6).tolist()
    ([[0.0]], [[-10.0]])
    """
    A, B, C, D = law.balanced
    S, Z, k = linalg.schur(A, sort=lambda re, im: bool(np.hypot(re, im) < INTEGRAL_POLE_RATE))
    V = Z.copy()
    V[:, k:] += Z[:, :k] @ linalg.solve_sylvester(S[:k, :k], -S[k:, k:], -S[:k, k:])
    A, B, C = np.linalg.solve(V, A @ V), np.linalg.solve(V, B), C @ V
    return System(0 * A[:k, :k], B[:k], C[:, :k], 0 * D), System(A[k:, k:], B[k:], C[:, k:], D)


def truncate(law: System, order: int) -> System:
    """Leave out states of a stable law, those of the smallest Hankel singular values sigma: balanced truncation.

        |G - G_r| <= 2 (sigma_(order+1) + ... + sigma_n)

    Raises InputError for an unstable law, and for an order that it does not have.

    >>> from malta.linear.system import System
    >>> import numpy as np
    >>> law = System(np.diag([-1.0, -100.0]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)))
    >>> truncate(law, 1).A.round(2).tolist()
    [[-1.04]]
    """
    if not 0 <= order <= len(law.A):
        raise InputError(CALLER, "order", str(order), f"0 to {len(law.A)}, of the law")
    if not law.stable:
        raise InputError(CALLER, "law", "an unstable one", "a stable one: split off its integrals")
    return balanced_reduction(law, order).system
