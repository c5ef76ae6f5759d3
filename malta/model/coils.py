"""Currents for forces where a machine has more coils than forces: v = T i, T of m rows and c > m columns.

    i = R^-1 T' (T R^-1 T')^-1 v        of all currents that make v, those of least loss i' R i
    min i' R i,  T i = v,  |i_k| <= I_k      the same within limits of the currents, a quadratic program
    max s,  T i = s d,  |i_k| <= I_k         the largest force along d, a linear program

A coil that has failed carries no current: its column is left out, and the others make the force, if they can.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import null_space
from scipy.optimize import linprog, nnls

from malta.arrays import FloatArray, readonly
from malta.display import display
from malta.errors import CheckError, InputError

CALLER = "allocation"
MAX_CONDITION = 1e8  # condition of T that is taken for full rank, its rows scaled
ACCURACY = 1e-7  # of forces that a program found, relative


@display
@dataclass(frozen=True, eq=False)
class Allocation:
    """The currents of c coils for m forces, of `malta.model.allocation`.

    matrix : T, forces by currents, m x c, N/A or N m/A
    resistance : of the coils, c, ohm; only their ratios count
    failed : coils that carry no current, from 0
    gain : currents by forces of least loss, c x m, A/N

    >>> import malta
    >>> malta.model.allocation([[2, 2]], resistance=[1, 3]).gain.round(9).tolist()
    [[0.375], [0.125]]
    """

    matrix: FloatArray
    resistance: FloatArray
    failed: tuple[int, ...]
    gain: FloatArray

    @cached_property
    def _rows(self) -> FloatArray:
        """The largest entry of each row of T, by which programs are scaled; of full rank: none is zero."""
        return np.asarray(np.abs(self.matrix).max(axis=1))

    def currents(self, v: Any) -> Any:
        """Compute the currents of least loss: what `Plant.currents` needs, A.

        v : m forces, numbers or CasADi symbols

        They may exceed limits; `limited` stays within them, at the cost of a program for each v.
        """
        if isinstance(v, ca.SX | ca.MX | ca.DM):
            return ca.sparsify(ca.DM(self.gain)) @ v
        return self.gain @ np.asarray(v, dtype=float)

    def limited(self, v: ArrayLike, limit: float | ArrayLike) -> FloatArray:
        """Compute the currents of least loss within limits, A.

        v : m forces
        limit : A, of each coil or one for all

        Raises CheckError where no currents within the limits make v, and InputError for other shapes.
        """
        wanted, most = self._forces(v), self._limits(limit)
        reach = self._largest(wanted, most)
        if reach < 1:
            raise CheckError(
                f"{CALLER}: the coils make {100 * reach:.3g} % of this force within their limits"
            )
        # w = sqrt(R) i is the shortest that makes v, and z in the null space, of least length: Lawson and Hanson's LDP.
        weight = 1 / np.sqrt(self.resistance / self.resistance.max())
        least, null = self.gain @ wanted, null_space(self.matrix * weight / self._rows[:, None])
        bounded = np.isfinite(most)
        unit = max(float(np.abs(least).max()), float(most[bounded].max(initial=0.0)), 1e-300)
        G = (weight[:, None] * null)[bounded]
        room = np.concatenate([(most + least)[bounded], (most - least)[bounded]]) / unit
        E = np.vstack([np.vstack([G, -G]).T, -room])
        u, _ = nnls(E, np.eye(len(E))[-1])
        r = E @ u - np.eye(len(E))[-1]
        i: FloatArray = np.clip(least - unit * weight * (null @ r[:-1]) / r[-1], -most, most)
        self._require(i, wanted)
        return i

    def largest(self, direction: ArrayLike, limit: float | ArrayLike) -> float:
        """Find the largest multiple of a direction of forces within limits of the currents; infinite without limits.

        direction : m forces
        limit : A, of each coil or one for all

        Raises InputError for other shapes, and a direction of zeros.
        """
        d = self._forces(direction)
        if not d.any():
            raise InputError(CALLER, "direction", "zeros", "a force")
        return self._largest(d, self._limits(limit))

    def _largest(self, d: FloatArray, most: FloatArray) -> float:
        if not d.any() or np.isinf(most).all():
            return math.inf
        rows, finite = self._rows, most[np.isfinite(most) & (most > 0)]
        if not finite.size:
            return 0.0 if not np.isinf(most).any() else math.inf
        unit = float(finite.max())  # A: the program is scaled by it and by the rows of T
        size = float(np.abs(d / rows).max()) / unit
        equal = np.column_stack([self.matrix / rows[:, None], -d / rows / unit / size])
        bounds = [(-one / unit, one / unit) for one in most.tolist()] + [(0, None)]
        found: Any = linprog([0.0] * len(most) + [-1.0], A_eq=equal, b_eq=np.zeros(len(d)), bounds=bounds)
        if found.status == 3:
            return math.inf
        if not found.success:
            raise CheckError(f"{CALLER}: the linear program ended with: {found.message}")
        s = float(found.x[-1]) / size
        self._require(found.x[:-1] * unit, s * d)
        return s

    def _require(self, i: FloatArray, v: FloatArray) -> None:
        """Raise CheckError unless the currents make the forces."""
        left = float(np.abs((self.matrix @ i - v) / self._rows).max())
        if not left <= ACCURACY * max(float(np.abs(i).max()), float(np.abs(v / self._rows).max())):
            raise CheckError(f"{CALLER}: the currents that were found miss the forces by {left:.2g} A")

    def _forces(self, v: ArrayLike) -> FloatArray:
        found = np.asarray(v, dtype=float)
        if found.shape != self.matrix.shape[:1] or not np.isfinite(found).all():
            raise InputError(CALLER, "v", repr(v)[:60], f"{len(self.matrix)} finite forces")
        return found

    def _limits(self, limit: float | ArrayLike) -> FloatArray:
        given = np.asarray(limit, dtype=float)
        if given.shape not in ((), self.resistance.shape) or not (given >= 0).all():
            raise InputError(
                CALLER, "limit", repr(limit)[:60], f"a limit of at least 0, or {len(self.resistance)} of them"
            )
        most = np.broadcast_to(given, self.resistance.shape).copy()
        most[list(self.failed)] = 0.0
        return most


def allocation(
    matrix: ArrayLike, resistance: float | ArrayLike = 1.0, failed: Iterable[int] = ()
) -> Allocation:
    """Make the currents of least loss for the forces of a machine with more coils than forces.

    matrix : T, forces by currents, m x c, N/A or N m/A
    resistance : of each coil or one for all, ohm
    failed : coils that carry no current, from 0

    Returns an Allocation, whose `currents` a machine takes for its own.

    Raises InputError for shapes and numbers that do not fit, and CheckError, which names the force, where the coils
    that are left cannot make every force.

    >>> import malta
    >>> corners = [
    ...     [1, 1, 1, 1],
    ...     [1, 1, -1, -1],
    ...     [-1, 1, 1, -1],
    ... ]  # lift, roll and pitch of four coils, N/A
    >>> plate = malta.model.allocation(corners)
    >>> plate.currents([4, 0, 0]).round(9).tolist()  # A
    [1.0, 1.0, 1.0, 1.0]
    >>> limping = malta.model.allocation(corners, failed=[0])
    >>> " ".join(f"{abs(i):.3f}" for i in limping.currents([4, 0, 0]))  # A
    '0.000 2.000 0.000 2.000'
    >>> [round(coils.largest([1, 0, 0], limit=3), 6) for coils in (plate, limping)]
    [12.0, 6.0]
    """
    T = np.asarray(matrix, dtype=float)
    if T.ndim != 2 or not T.size or not np.isfinite(T).all():
        raise InputError(CALLER, "matrix", f"shape {T.shape}", "finite forces by currents, m x c")
    c = T.shape[1]
    R = np.asarray(resistance, dtype=float)
    if R.shape not in ((), (c,)) or not ((R > 0) & np.isfinite(R)).all():
        raise InputError(CALLER, "resistance", repr(resistance)[:60], f"a number above 0, or {c} of them")
    lost = sorted(set(failed))
    for k in lost:
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or not 0 <= k < c:
            raise InputError(CALLER, "failed", repr(k), f"coils from 0 to {c - 1}")
    conductance = 1 / np.broadcast_to(R, (c,))
    conductance[lost] = 0.0
    _require_full_rank(T[:, conductance > 0], lost)
    rows, root = np.abs(T).max(axis=1), np.sqrt(conductance / conductance.max())
    gain = root[:, None] * np.linalg.pinv(T / rows[:, None] * root) / rows
    gain[lost] = 0.0
    left = np.abs((T @ gain * rows - np.diag(rows)) / rows[:, None]).max()
    if not left < ACCURACY:
        raise CheckError(f"{CALLER}: the currents of least loss miss the forces by {left:.2g} of them")
    return Allocation(readonly(T), readonly(np.broadcast_to(R, (c,))), tuple(map(int, lost)), readonly(gain))


def _require_full_rank(T: FloatArray, lost: list[int]) -> None:
    """Raise CheckError, which names the force that is lost, unless the coils make every force."""
    rows = np.abs(T).max(axis=1, initial=0.0)
    left = "the coils" if not lost else "the coils that are left"
    if (rows == 0).any():
        raise CheckError(f"{CALLER}: {left} do not make force {int(np.argmin(rows)) + 1} at all")
    U, s, _ = np.linalg.svd(T / rows[:, None], full_matrices=True)
    if T.shape[1] < len(T) or s[-1] * MAX_CONDITION < s[0]:
        worst = U[:, -1] / rows
        worst = np.where(
            np.abs(worst) < 1e-9 * np.abs(worst).max(), 0.0, worst / worst[np.abs(worst).argmax()]
        )
        share = " ".join(f"{x:.3g}" for x in worst)
        raise CheckError(
            f"{CALLER}: {left} make no force with the shares {share}: one coil or more is missing"
        )
