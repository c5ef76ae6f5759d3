"""Commutation of the planar motor: the wrench of sixteen coil currents, and the currents of a wrench.

W = K(p) i is the wrench of the coil currents about the centre of gravity, in the frame of the magnets; for a level
mover also in its own. Equation numbers are those of the paper named in plant.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from itertools import product
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import CheckError, InputError
from malta.machines.planar.field import (
    CoilModel,
    CoilShape,
    FieldTable,
    Series,
    controller_model,
    model_of_order,
    shape_of,
    simulation_model,
)
from malta.machines.planar.parameters import Parameters
from malta.model.equations import Equation, is_recording, note, recorded_equations
from malta.model.rigid_body import rotation

STEPS = (-1.5, -0.5, 0.5, 1.5)  # coil pitches from the mover's centre, along x and y
MAX_CONDITION = 10.0  # of K(p): 2.4 with a pitch of 16/3 tau_n, 20 and more with a bad one


# Parameters of K(p) that harmonics do not depend on.
_FACTORS = ("coil_pitch", "r_z", "h", "N_c", "B_r", "B_z", "C")


def factors_of(par: Parameters) -> Any:
    """The last argument of `forces_function`: a column of parameters."""
    return ca.vertcat(*(getattr(par, name) for name in _FACTORS))


def _symbols(shape: CoilShape) -> tuple[Any, Any]:
    """Parameters of this shape with symbols for all of _FACTORS, and the column of these symbols."""
    symbols = {name: ca.SX.sym(name) for name in _FACTORS}
    return SimpleNamespace(**shape._asdict() | symbols), ca.vertcat(*symbols.values())


@lru_cache(maxsize=8)  # a third of a second, for all parameters of a shape
def forces_function(shape: CoilShape) -> ca.Function:
    """(x, i, factors) -> W: the wrench of coil currents on the mover in the state x, tilt included."""
    par, factors = _symbols(shape)
    x, i = ca.SX.sym("x", 12), ca.SX.sym("i", 16)
    W = wrench_matrix(par, simulation_model(par), _place(par, x), x[3:6]) @ i
    return ca.Function("forces", [x, i, factors], [ca.cse(W)])


@lru_cache(maxsize=8)
def _currents_function(shape: CoilShape, order: int) -> ca.Function:
    """(y, W, factors) -> i: coil currents of least loss for a wrench, by a coil model without a table."""
    par, factors = _symbols(shape)
    y, W = ca.SX.sym("y", 6), ca.SX.sym("W", 6)
    i = currents(ca.cse(wrench_matrix(par, model_of_order(par, order), _place(par, y))), W)
    return ca.Function("currents", [y, W, factors], [ca.cse(i)])


@lru_cache(maxsize=8)
def _noted_currents(shape: CoilShape, order: int) -> tuple[ca.Function, tuple[Equation, ...]]:
    """The same with all results of its equations: (y, W, factors) -> i and these; the equations."""
    par, factors = _symbols(shape)
    y, W = ca.SX.sym("y", 6), ca.SX.sym("W", 6)
    with recorded_equations() as equations:
        i = currents(ca.cse(wrench_matrix(par, model_of_order(par, order), _place(par, y))), W)
    results = [ca.vec(ca.densify(value)) for e in equations for value in e.values.values()]
    return ca.Function("currents", [y, W, factors], ca.cse([i, *results])), tuple(equations)


def _noting_currents(par: Parameters, y: Any, W: Any) -> Any:
    """i of `_currents_function`, with a note of each equation."""
    function, equations = _noted_currents(shape_of(par), int(par.order))
    i, *results = function.call([y, W, factors_of(par)])
    for e in equations:
        note(e.block, e.text, e.times, **{name: results.pop(0) for name in e.values})
    return i


def _place(par: Parameters, y: Any) -> Any:
    """The position p = (x, y, height above the magnets) in states or outputs y."""
    return ca.vertcat(y[:2], par.h + y[2])


def current_law(par: Parameters, *, numbers: bool) -> Callable[[Any, Any], Any]:
    """(y, W) -> i by the coil model that `order` and `cells` name.

    numbers : the parameters are numbers. The function of symbols raises CheckError if it needs a table.
    """
    if not par.cells:

        def by_function(y: Any, W: Any) -> Any:
            if isinstance(W, ca.SX) and is_recording():
                return _noting_currents(par, y, W)
            return _currents_function(shape_of(par), int(par.order))(y, W, factors_of(par))

        return by_function
    if numbers:
        model = controller_model(par)
        looked_up = decoupling(par, model)

        def by_table(y: Any, W: Any) -> Any:
            if isinstance(W, ca.SX):  # of firmware, which records where the table is read
                return currents(wrench_matrix(par, model, _place(par, y)), W)
            return looked_up(_place(par, y), W)

        return by_table

    def refuse(_y: Any, _W: Any) -> Any:
        raise CheckError("planar: a table holds numbers: where parameters are symbols, cells has to be 0")

    return refuse


def coil_centres(par: Parameters) -> FloatArray:
    """(x_k, y_k, r_z), the coils' centres of force relative to the centre of gravity, 16 x 3, m: eq. (3)."""
    steps = np.array(STEPS) * par.coil_pitch
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    return np.stack([x, y, np.full(16, par.r_z)], axis=-1)


@lru_cache(maxsize=16)
def _arms(par: Parameters) -> tuple[FloatArray, FloatArray]:
    """Arms of the coils, and matrices that turn wrenches about a coil into those about the centre of gravity."""
    arms = coil_centres(par)
    levers = np.tile(np.eye(6), (16, 1, 1))
    for lever, arm in zip(levers, arms, strict=True):
        lever[3:, :3] = np.cross(arm, np.eye(3)).T
    return readonly(arms), readonly(levers)


def wrench_matrix(par: Parameters, model: CoilModel, p: Any, q_r: Any = None) -> Any:
    """K(p) of (33), 6 x 16: N/A and N m/A, about the centre of gravity, in the frame of the magnets.

    p : x y z, numpy or CasADi, m; q_r : angles of tilt, CasADi, rad. Tilt moves the coils, and each is treated as level
    at its new place: that has the stiffness against tilt from the arms, but not the 2 to 6 % within a coil.
    NOTE: (33) prints F_z3 in column 2.
    """
    if isinstance(p, np.ndarray):
        return _wrench_matrices(par, model, check_position(par, p))
    columns, xs, ys = [], {}, {}
    for a, b in product(STEPS, STEPS):  # parameters may be symbols here
        arm = ca.vertcat(a * par.coil_pitch, b * par.coil_pitch, par.r_z)
        rows = ca.diag(arm) if q_r is None else ca.diag(arm) @ rotation(q_r)
        at = ca.sum1(rows).T
        # Decays over a column's rise, a row's and the mover's height are factors, each for several coils.
        heights = (p[2] + rows[2, 2] - par.r_z, rows[0, 2], rows[1, 2])
        z: Any = heights if q_r is not None and isinstance(model, Series) else p[2] + at[2] - par.r_z
        xs[a], ys[b] = p[0] + at[0], p[1] + at[1]
        own = model(xs[a], ys[b], z)
        columns.append(ca.vertcat(own[:3], own[3:] + ca.cross(at, own[:3])))
    K = ca.horzcat(*columns)
    if isinstance(model, Series) and q_r is None:
        model.note_shared(list(xs.values()), list(ys.values()), z)
    note("wrench_matrix", "K: wrench of 1 A in each coil, column by column", len(columns), K=K)
    return K


def _wrench_matrices(par: Parameters, model: CoilModel, p: FloatArray) -> FloatArray:
    """K of level movers at positions p (..., 3): (..., 6, 16)."""
    arms, levers = _arms(par)
    at = arms + p[..., None, :]
    K: FloatArray = (levers @ model(at[..., 0], at[..., 1], at[..., 2] - par.r_z)[..., None])[..., 0]
    return K.swapaxes(-1, -2)


def currents(K: Any, W: Any, weights: Any = None) -> Any:
    """(34), (35): the coil currents i, A, with K i = W and the least sum of weights i^2. numpy or CasADi.

    weights : of the 16 coils, 1 by default; a coil of infinite weight is not used
    Raises, from numpy: InputError (a wrench that is not finite, a weight that is not positive) and CheckError where K
    has not full rank, so that the currents would not give the wrench.
    """
    if not isinstance(K, np.ndarray):
        KD = K if weights is None else K @ ca.diag(1 / weights)
        KK = KD @ K.T
        if not isinstance(K, ca.SX):
            return KD.T @ ca.solve(KK, W)
        note("normal_matrix", "KK = K K', column by column, its upper triangle", KK=KK)
        L = ca.chol(KK).T
        note("root", "root: lower triangle with root root' = KK, column by column", root=L)
        multipliers = ca.solve(L.T, ca.solve(L, W))
        note("solve", "KK multipliers = v", multipliers=multipliers)
        return KD.T @ multipliers
    if not np.isfinite(W).all():
        raise InputError("planar", "W", f"{W}", "a finite wrench")
    if weights is not None and not (np.asarray(weights) > 0).all():
        raise InputError("planar", "weights", f"{weights}", "a positive weight for every coil")
    KD = K if weights is None else K / weights
    try:
        i = KD.T @ np.linalg.solve(KD @ K.T, W)
    except np.linalg.LinAlgError:
        i = np.full(K.shape[1], np.nan)
    if not np.abs(K @ i - W).max() <= 1e-9 * np.abs(W).max():
        raise CheckError(
            "planar: K(p) is singular: no coil currents give this wrench at this position and coil pitch"
        )
    return i


def limit_currents(par: Parameters, i: Any) -> Any:
    """Coil currents within I_max, scaled together so that the wrench keeps its direction: numpy or CasADi."""
    if isinstance(i, np.ndarray):
        return i / max(1.0, float(np.abs(i).max()) / par.I_max)
    return i / ca.fmax(1, ca.mmax(ca.fabs(i)) / par.I_max)


def check_position(par: Parameters, p: FloatArray) -> FloatArray:
    """The position p = x y z, m, if the models are valid there. Raises InputError for a coordinate outside."""
    limits = {"x": (-par.xy_max, par.xy_max), "y": (-par.xy_max, par.xy_max), "z": (0.0, par.z_max)}
    for (name, (low, high)), value in zip(limits.items(), p, strict=True):
        if not low <= value <= high:
            raise InputError("planar", name, f"{value:.6g} m", f"a position from {low:g} to {high:g} m")
    return p


def condition_numbers(par: Parameters, model: CoilModel, n: int = 12) -> FloatArray:
    """Condition numbers of K(p) over a period in x and y, n x n, infinite where K is singular.

    Torques are divided by the mover's radius of gyration, sqrt(I_x / m), so that accelerations are compared.
    """
    steps = np.arange(n) * 2 * par.tau_n / n
    scale = np.array([1.0] * 3 + [math.sqrt(par.m / par.I_x)] * 3)[:, None]
    p = np.stack([*np.meshgrid(steps, steps, indexing="ij"), np.full((n, n), par.h)], axis=-1)
    check_position(par, p[-1, -1])
    s = np.linalg.svd(scale * _wrench_matrices(par, model, p), compute_uv=False)
    regular = s[..., -1] > 1e-12 * s[..., 0]
    ratios: FloatArray = np.divide(s[..., 0], s[..., -1], out=np.full((n, n), np.inf), where=regular)
    return ratios


def check_pitch(par: Parameters, model: CoilModel) -> float:
    """The worst condition of K(p) over a period.

    Raises CheckError if it is above MAX_CONDITION: then the coils cannot give every wrench at every position.
    """
    worst = float(condition_numbers(par, model).max())
    if not worst <= MAX_CONDITION:
        ratio = par.coil_pitch / par.tau_n
        found = "is singular" if worst == np.inf else f"has a condition of {worst:.3g}"
        raise CheckError(
            f"planar: with a coil pitch of {par.coil_pitch:.6g} m = {ratio:.4g} tau_n, K(p) {found}, allowed is"
            f" {MAX_CONDITION:g}: the coils' phases do not give forces and torques in every direction at every position"
        )
    return worst


def decoupling(par: Parameters, model: CoilModel) -> ca.Function:
    """(p, W) -> i, eqs (31)-(35) as one CasADi function, to be called, compiled or written as C.

    A function of SX symbols, or of MX with a Table. It does not check the position: it has no branch and no exception.
    """
    if isinstance(model, FieldTable):
        P, N = ca.MX.sym("p", 3), ca.MX.sym("W", 6)
        K, V = ca.SX.sym("K", 6, 16), ca.SX.sym("W", 6)
        solve = ca.Function("solve", [K, V], [ca.cse(currents(K, V))])
        return ca.Function("decoupling", [P, N], [solve(wrench_matrix(par, model, P), N)], ["p", "W"], ["i"])
    p, W = ca.SX.sym("p", 3), ca.SX.sym("W", 6)
    i = ca.cse(currents(ca.cse(wrench_matrix(par, model, p)), W))
    return ca.Function("decoupling", [p, W], [i], ["p", "W"], ["i"])
