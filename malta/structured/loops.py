"""The loops that a law is tuned on, a plant closed by a structure between named signals, and their figures.

    x' = A x + B u + B_w w,  y = C x + D u + D_w w,  u = K (p* - y) + d

Of a sampled plant s is that of z = (1 + s T/2) / (1 - s T/2). In it a law sampled by Tustin's rule is the continuous
law, and peaks and stability are those of the sampled loop, exactly; the frequency w stands for tan(w T/2) / (T/2).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError
from malta.linear.conversion import from_control
from malta.linear.peaks import gains_at, level_frequencies, peak_gain, response_at
from malta.linear.system import System
from malta.synthesis.elements import CALLER
from malta.synthesis.structure import INPUT_CHANNELS, OUTPUT_CHANNELS

# Figures of a stable linear system with their exact derivatives: peaks of its gain, its noise, its poles.
#
#     peak    max over w of sigma_max(G(jw)): a level is exceeded between frequencies at which a Hamiltonian matrix has
#             eigenvalues jw (Boyd, Balakrishnan and Kabamba), so that no grid can miss a peak
#     noise   sqrt(tr C X C'),  A X + X A' + B B' = 0
#     poles   Re(lambda), with the left and right eigenvectors
#
# All are differentiated by a matrix M that acts as A + B2 M C2 does: the output of each derivative has the shape of M.


ROUNDS = 9  # of the refinement of a peak
POINTS = 9  # in each of them
SHARES = (0.7, 0.85, 0.95, 0.99)  # of the largest gain: maxima are looked for between their crossings


class SingularPeak(NamedTuple):
    """A local maximum of the largest singular value, with the vectors that belong to it."""

    w: float  # rad/s, or infinite
    value: float
    left: ComplexArray
    right: ComplexArray


def peaks_of(system: System) -> list[SingularPeak]:
    """The local maxima of a stable system's gain that come near the largest one.

    One that rises above a share of the largest, between places where the gain is below it, is found for certain: these
    places are eigenvalues of a Hamiltonian matrix.
    """
    system = system.balanced
    best, where = peak_gain(system)
    if not math.isfinite(best) or best == 0.0:
        return []
    scale = where if 0 < where < math.inf else _middle_of(system)
    poles = np.linalg.eigvals(system.A) if len(system.A) else np.zeros(0)
    levels = [level_frequencies(system, share * best) for share in SHARES] if len(poles) else []
    w = np.concatenate([np.abs(poles), [where], *levels])
    at = np.unique(np.concatenate([[0.0, math.pi], 2 * np.arctan(w / scale)]))
    angle = np.unique(np.concatenate([at, (at[1:] + at[:-1]) / 2]))
    sizes = gains_at(system, _frequency(angle, scale))
    before, after = np.append(-np.inf, sizes[:-1]), np.append(sizes[1:], -np.inf)
    tops = np.flatnonzero((sizes >= before) & (sizes > after) & (sizes > SHARES[0] * best))
    low, high = angle[np.maximum(tops - 1, 0)], angle[np.minimum(tops + 1, len(angle) - 1)]
    found = [_peak_at(system, w) for w in _refine(system, low, high, scale).tolist()]
    if not found or max(peak.value for peak in found) < best * (1 - 1e-6):
        found.append(_peak_at(system, where))
    return found


def _middle_of(system: System) -> float:
    """A frequency amid those of a system's poles, rad/s."""
    sizes = np.abs(np.linalg.eigvals(system.A)) if len(system.A) else np.zeros(0)
    sizes = sizes[sizes > 0]
    return float(np.exp(np.log(sizes).mean())) if len(sizes) else 1.0


def _frequency(angle: FloatArray, scale: float) -> FloatArray:
    """The frequencies w = scale tan(angle / 2), rad/s; at pi infinite."""
    w = scale * np.tan(np.minimum(angle, math.pi) / 2)
    return np.where(angle >= math.pi - 1e-12, np.inf, w)


def _refine(system: System, low: FloatArray, high: FloatArray, scale: float) -> FloatArray:
    """The frequency of the largest gain between each two angles."""
    rows = np.arange(len(low))
    where = high
    for _ in range(ROUNDS):
        angle = np.linspace(low, high, POINTS, axis=1)
        sizes = gains_at(system, _frequency(angle.ravel(), scale)).reshape(angle.shape)
        k = sizes.argmax(axis=1)
        where = angle[rows, k]
        low, high = angle[rows, np.maximum(k - 1, 0)], angle[rows, np.minimum(k + 1, POINTS - 1)]
    return _frequency(where, scale)


def _peak_at(system: System, w: float) -> SingularPeak:
    U, s, V = np.linalg.svd(response_at(system, np.array([w]))[0])
    return SingularPeak(w, float(s[0]), U[:, 0], V[0].conj())


class LawPorts(NamedTuple):
    """How a matrix M acts on a system: A + B2 M C2, B1 + B2 M D21, C1 + D12 M C2, D11 + D12 M D21."""

    B2: FloatArray
    C2: FloatArray
    D12: FloatArray
    D21: FloatArray


def gain_slope(system: System, by: LawPorts, peak: SingularPeak, weight: complex = 1.0) -> FloatArray:
    """The derivative of |weight| sigma_max(G(jw)) by M at a peak, whose frequency needs none: inputs of M x outputs."""
    into, out = by.D12.astype(complex), by.D21.astype(complex)
    if math.isfinite(peak.w) and len(system.A):
        resolvent = 1j * peak.w * np.eye(len(system.A)) - system.A
        into = into + system.C @ np.linalg.solve(resolvent, by.B2.astype(complex))
        out = out + by.C2 @ np.linalg.solve(resolvent, system.B.astype(complex))
    left = (peak.left.conj() * weight) @ into
    return np.real(np.outer(left, out @ peak.right))


def noise(system: System, by: LawPorts | None = None) -> tuple[float, FloatArray | None]:
    """The root of the sum of squares of a stable system's impulse responses (its H2 norm), and its derivative by M.

    Raises CheckError for a system with D, whose output has no variance under white noise.
    """
    if np.abs(system.D).max(initial=0.0) > 0:
        raise CheckError("white noise reaches an output at once: its variance is infinite")
    A, B, C, _ = system
    X = linalg.solve_continuous_lyapunov(A, -B @ B.T)
    value = math.sqrt(max(float(np.trace(C @ X @ C.T)), 0.0))
    if by is None or value == 0.0:
        return value, None if by is None else np.zeros((by.B2.shape[1], len(by.C2)))
    Y = linalg.solve_continuous_lyapunov(A.T, -C.T @ C)
    slope = (by.B2.T @ Y + by.D12.T @ C) @ X @ by.C2.T + by.B2.T @ Y @ B @ by.D21.T
    return value, np.asarray(slope / value)


class Pole(NamedTuple):
    """An eigenvalue of A + B2 M C2, and its derivative by M; of a pair the one with Im >= 0."""

    value: complex
    slope: ComplexArray


def poles_of(A: FloatArray, B2: FloatArray, C2: FloatArray, count: int = 0) -> list[Pole]:
    """The eigenvalues of A + B2 M C2 with their derivatives, those that decay slowest first; count: 0 for all."""
    found_eig: Any = linalg.eig(A, left=True, right=True)
    values, left, right = found_eig
    order = [k for k in np.argsort(-values.real) if values[k].imag >= 0]
    found = []
    for k in order[:count] if count else order:
        y, x = left[:, k].conj(), right[:, k]
        overlap = y @ x
        if abs(overlap) < 1e-14:  # a defective pair: its derivative is infinite
            overlap = 1e-14
        found.append(Pole(complex(values[k]), np.outer(y @ B2, C2 @ x) / overlap))
    return found


# The loops: a plant closed by a structure, between named signals.


INTEGRAL = 1e-9  # of a law's largest entry: a pole of that size is an integral
ROUNDING = 1e-14  # of the largest entry of A: growth within it is rounding
JOINS = 1e-12  # of the largest entries of its row and column: smaller ones are rounding


@dataclass(frozen=True, eq=False)
class TunedPlant:
    """A linear plant that a law is tuned on.

    name : of the model, as "nominal" or its parameters in words
    plane : inputs u, then disturbances w; outputs y; of a sampled plant in the s of Tustin's rule
    inputs, outputs, disturbances : names
    sample_time : s; None: continuous
    goals : whether all goals hold here; else stability alone
    """

    name: str
    plane: System
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    disturbances: tuple[str, ...] = ()
    sample_time: float | None = None
    goals: bool = True


def model_of(
    name: str,
    system: System,
    inputs: Sequence[str],
    outputs: Sequence[str],
    *,
    disturbances: Sequence[str] = (),
    sample_time: float | None = None,
    goals: bool = True,
) -> TunedPlant:
    """Make a model of matrices, of x+ where there is a sample time. Raises InputError for an eigenvalue -1 of those."""
    plane = system if sample_time is None else to_plane(system, sample_time)
    return TunedPlant(
        name, plane.balanced, tuple(inputs), tuple(outputs), tuple(disturbances), sample_time, goals
    )


def to_plane(system: System, Ts: float) -> System:
    """x+ = A x + B u in the s of z = (1 + s Ts/2) / (1 - s Ts/2). Raises InputError for an eigenvalue -1."""
    A, B, C, D = system
    one = np.eye(len(A))
    try:
        back = np.linalg.inv(one + A)
    except np.linalg.LinAlgError as error:
        raise InputError(CALLER, "plant", "a pole z = -1", "a sampled plant without one") from error
    return System(2 / Ts * back @ (A - one), 4 / Ts * back @ back @ B, C, D - C @ back @ B)


def models_of_systems(plants: Any) -> list[TunedPlant]:
    """The models of one control system or of several with the same signals. Raises InputError for others."""
    given = list(plants) if isinstance(plants, list | tuple) else [plants]
    found: list[TunedPlant] = []
    for k, plant in enumerate(given):
        own = from_control(
            plant, CALLER, "plant", expected="a system of python-control with states, or several"
        )
        name = getattr(plant, "name", "") if len(given) == 1 else f"model {k + 1}"
        found.append(model_of(name, own, own.inputs, own.outputs, sample_time=own.dt))
    first = found[0]
    for other in found[1:]:
        if (other.inputs, other.outputs, other.sample_time) != (
            first.inputs,
            first.outputs,
            first.sample_time,
        ):
            expected = "the same signals and sample time in all of them"
            raise InputError(CALLER, "plant", f"{other.name} beside {first.name}", expected)
    return found


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A model closed by a law: everything between all signals, and how the law's matrices act on it.

    Inputs: references, loads on the forces, disturbances. Outputs: errors, outputs, the law's forces, acting forces.
    """

    model: TunedPlant
    theta: FloatArray  # [D C; B A] of the law

    @cached_property
    def _open(self) -> tuple[System, LawPorts, FloatArray]:
        A, B_all, C, D_all = self.model.plane
        p, m = len(self.model.outputs), len(self.model.inputs)
        n, k = len(A), len(self.theta) - m
        B, D, w = B_all[:, :m], D_all[:, :m], B_all.shape[1] - m
        B1 = np.hstack([np.zeros((n, p)), B_all])
        y = np.hstack([np.zeros((p, p)), D_all])
        e = np.hstack([np.eye(p), -D_all])
        load = np.hstack([np.zeros((m, p)), np.eye(m), np.zeros((m, w))])
        direct = np.vstack([e, y, np.zeros_like(load), load])
        out = np.vstack([-C, C, np.zeros((2 * m, n))])
        through = np.vstack([-D, D, np.eye(m), np.eye(m)])

        def wide(M: FloatArray, rows: int, columns: int) -> FloatArray:
            whole = np.zeros((M.shape[0] + rows, M.shape[1] + columns))
            whole[: M.shape[0], : M.shape[1]] = M
            return whole

        B2, C2 = wide(B, k, k), wide(-C, k, k)
        B2[n:, m:], C2[p:, n:] = np.eye(k), np.eye(k)
        by = LawPorts(B2, C2, wide(through, 0, k), wide(e, k, 0))
        return System(wide(A, k, k), wide(B1, k, 0), wide(out, 0, k), direct), by, wide(-D, k, k)

    @cached_property
    def _acting(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """M = (1 - theta D22)^-1 theta and the factors of dM = left dtheta right. Raises CheckError without one."""
        _, _, D22 = self._open
        try:
            left = np.linalg.inv(np.eye(len(self.theta)) - self.theta @ D22)
        except np.linalg.LinAlgError as error:
            raise CheckError(f"{self.model.name}: 1 + L is singular at infinite frequency") from error
        right = np.eye(self.theta.shape[1]) + D22 @ left @ self.theta
        return left @ self.theta, left, right

    @cached_property
    def whole(self) -> tuple[System, LawPorts]:
        """The closed loop between all signals, and its channels for derivatives."""
        (A, B1, C1, D11), by, _ = self._open
        M, _, _ = self._acting
        closed = System(
            A + by.B2 @ M @ by.C2, B1 + by.B2 @ M @ by.D21, C1 + by.D12 @ M @ by.C2, D11 + by.D12 @ M @ by.D21
        )
        return closed, LawPorts(by.B2, by.C2, by.D12, by.D21)

    def slope(self, by_M: FloatArray) -> FloatArray:
        """The derivative by theta, from that by M."""
        _, left, right = self._acting
        return np.asarray(left.T @ by_M @ right.T)

    def part(self, rows: Sequence[int], columns: Sequence[int]) -> tuple[System, LawPorts]:
        """The loop between some signals: only states that the inputs reach and that the outputs see."""
        (A, B, C, D), by = self.whole
        B, C, D = B[:, list(columns)], C[list(rows)], D[np.ix_(rows, columns)]
        joined = self._joined
        x = np.flatnonzero(_reach(joined, B.any(axis=1)) & _reach(joined.T, C.any(axis=0)))
        channels = LawPorts(by.B2[x], by.C2[:, x], by.D12[list(rows)], by.D21[:, list(columns)])
        return System(A[np.ix_(x, x)], B[x], C[:, x], D), channels

    @cached_property
    def _joined(self) -> NDArray[np.bool_]:
        size = np.abs(self.whole[0].A)
        least = JOINS * np.sqrt(np.outer(size.max(axis=1, initial=0.0), size.max(axis=0, initial=0.0)))
        return size > least

    @cached_property
    def groups(self) -> list[NDArray[np.int_]]:
        """States that nothing joins to each other."""
        count, label = sparse.csgraph.connected_components(self._joined, directed=False)
        return [np.flatnonzero(label == k) for k in range(count)]

    @cached_property
    def growth(self) -> float:
        """The largest Re of a pole; below 0 where the loop is stable."""
        A = self.whole[0].A
        return max(
            (float(np.linalg.eigvals(A[np.ix_(x, x)]).real.max()) for x in self.groups), default=-math.inf
        )

    @property
    def stable(self) -> bool:
        """Whether all poles decay by more than rounding makes of undamped ones."""
        return self.growth < -ROUNDING * float(np.abs(self.whole[0].A).max(initial=0.0))

    def poles(self, count: int = 0) -> list[Pole]:
        """The poles with their derivatives by M, each group by itself; count of each, the slowest first, 0: all."""
        (A, _, _, _), by = self.whole
        return [pole for x in self.groups for pole in poles_of(A[np.ix_(x, x)], by.B2[x], by.C2[:, x], count)]

    def law_poles(self) -> list[Pole]:
        """The poles of the law with their derivatives by theta, without those at 0, its integrals."""
        m, p = len(self.model.inputs), len(self.model.outputs)
        A = self.theta[m:, p:]
        B2, C2 = np.eye(len(self.theta))[m:], np.eye(self.theta.shape[1])[:, p:]
        size = float(np.abs(A).max(initial=0.0))
        return [pole for pole in poles_of(A, B2, C2) if abs(pole.value) > INTEGRAL * size] if size else []

    def rows(self, signals: Any) -> list[int]:
        """The outputs of these names. Raises InputError for unknown ones."""
        m = self.model
        return _pick(
            signals, dict(zip(OUTPUT_CHANNELS, (m.outputs, m.outputs, m.inputs, m.inputs), strict=True))
        )

    def columns(self, signals: Any) -> list[int]:
        """The inputs of these names. Raises InputError for unknown ones."""
        m = self.model
        return _pick(signals, dict(zip(INPUT_CHANNELS, (m.outputs, m.inputs, m.disturbances), strict=True)))


def _reach(joined: Any, start: Any) -> Any:
    """The states that others drive, from some: joined[i, j] where state j drives state i."""
    found = start.copy()
    while True:
        more = found | joined[:, found].any(axis=1)
        if (more == found).all():
            return found
        found = more


def _pick(signals: Any, known: dict[str, tuple[str, ...]]) -> list[int]:
    """Numbers of the signals "kind" or "kind name"."""
    every = [f"{kind} {name}" for kind, names in known.items() for name in names]
    found = []
    for signal in [signals] if isinstance(signals, str) else list(signals):
        own = [k for k, name in enumerate(every) if name == signal or name.partition(" ")[0] == signal]
        if not own:
            raise InputError(CALLER, "signal", repr(signal), "one of " + ", ".join([*known, *every]))
        found += own
    return found
