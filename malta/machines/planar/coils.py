"""Coil models of the planar motor: the exact wrench of a coil, the paper's formulas, and its bilinear table.

A coil model is a function (x, y, z) -> wrench of 1 A in a level coil there, about its own centre of force, in CasADi
or numpy: `Analytical` is the paper's (17)-(24), `Table` its bilinear table, `field.Series` the Fourier series. Equation
numbers are those of the paper named in plant.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.machines.planar.field import (
    COIL_ORDER,
    ODD_X,
    ODD_Y,
    Series,
    Shape,
    unit_series,
)
from malta.model.lookup import look_up
from malta.model.plant import (
    readonly,
)

if TYPE_CHECKING:
    from malta.machines.planar.plant import Parameters
    from malta.model.plant import FloatArray


CoilModel = Callable[[Any, Any, Any], Any]
LEAST = 4e-5  # share of the largest harmonic's force at z = 0: `simulation_model` leaves out smaller ones


def shape_of(par: Parameters) -> Shape:
    """The parameters that the harmonics are computed from."""
    return Shape(par.tau_n, par.w_c, par.h_c, par.l_c, par.r_c, par.h_m, par.upright)


def simulation_model(par: Parameters, order: int = COIL_ORDER) -> Series:
    """`exact_model` without the harmonics below LEAST: 22 of 144 are left, at every height.

    It changes a coil's force by up to 0.2 of 8200 mN/A at a height of 1 mm, and by 0.9 of 9900 mN/A on the magnets.
    """
    whole = unit_series(shape_of(par), order)
    few = whole.above(LEAST * float(np.abs(whole.G[:3]).max()), 0.0)
    return replace(few, scale=par.N_c * par.B_r)


def controller_model(par: Parameters) -> CoilModel:
    """The controller's coil model: (17)-(24) for `order` 1, else the series up to it; a table of it if `cells`."""
    model = model_of_order(par, int(par.order))
    return table(par, model, int(par.cells)) if par.cells else model


def model_of_order(par: Parameters, order: int) -> CoilModel:
    """(17)-(24) for the order 1, else the series up to the order."""
    return Analytical(par) if order == 1 else simulation_model(par, order)


@dataclass(frozen=True)
class Analytical:
    """Eqs (17)-(24) for 1 A, the fundamental alone, T about the coil's own centre of force.

    B_xy = B_z / sqrt(2), as the field has no curl. B_z is the flux density at the working height, so C_z counts from
    there.
    NOTE: (16) integrates from 0 to h_c; the coil is at p_z to p_z + h_c. (21) prints -y_k F_z, it is
    -x_k F_z; the lever arms of (20)-(22) are applied in `wrench_matrix`, for every coil model. The rectangles of (23)
    and (24) overlap at the corners: C_1 - C_2, the torque about a coil's own centre, is 3.8 times a rounded coil's.
    """

    par: Parameters

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """F_x F_y F_z T_x T_y T_z for 1 A, as `Series`."""
        par, fn = self.par, np if isinstance(x, np.ndarray) else ca
        k = math.pi / par.tau_n
        C_z = -math.expm1(-k * par.h_c) / k * fn.exp(-k * (z - par.h))
        J = par.N_c / (par.w_c * par.h_c)
        s_w, c_w = math.sin(k * par.w_c / 2), math.cos(k * par.w_c / 2)
        s_l, c_l = math.sin(k * par.l_c / 2), math.cos(k * par.l_c / 2)
        C_1 = 2 / k * par.l_c * s_w * s_l * par.C
        C_2 = (par.l_c**2 * c_l * s_w + par.l_c * par.w_c * c_w * s_l) * par.C
        F, T = C_z * J * par.B_z * C_1, C_z * J * par.B_z * (C_1 - C_2) / k  # sqrt(2) B_xy = B_z
        s_x, s_y = fn.sin(k * x), fn.sin(k * y)
        parts = [F * s_x, -F * s_y, F * (fn.cos(k * x) - fn.cos(k * y)), T * s_y, T * s_x, 0 * F * s_x]
        return np.stack(parts, axis=-1) if fn is np else ca.vertcat(*parts)


def exact_model(par: Parameters, order: int = COIL_ORDER) -> Series:
    """The exact wrench of the rounded coil in the whole field, all harmonics up to `order`."""
    return replace(unit_series(shape_of(par), order), scale=par.N_c * par.B_r)


def compensation(par: Parameters, model: CoilModel) -> float:
    """C of (23), (24) for which `Analytical` fits the forces of a coil model at the working height in least squares."""
    x, y, z = _quarter(par, 24)
    mine, data = Analytical(par)(x, y, z)[..., :3], model(x, y, z)[..., :3]
    return float(par.C * (mine * data).sum() / (mine * mine).sum())


def _quarter(par: Parameters, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Region I of Fig. 3, x and y from 0 to tau_n in n steps, at the working height."""
    x, y = np.meshgrid(*[np.linspace(0, par.tau_n, n + 1)] * 2, indexing="ij")
    return x, y, np.full_like(x, par.h)


@dataclass(frozen=True, eq=False)
class Table:
    """Bilinear interpolation (25)-(29) over a quarter period.

    Parities give the other quarters, the factor e^(-pi z / tau_n) gives other heights.


    NOTE: (27) prints the weights of f(x_i, y_j+1) and f(x_i+1, y_j) in each other's place, and "uv" for t u.
    """

    tau_n: float  # m
    z: float  # height of the nodes, m
    nodes: FloatArray  # (n + 1) x (n + 1) x 6: N/A and N m/A
    cells: FloatArray  # n^2 x 4 x 6, the corners of each cell

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """F_x F_y F_z T_x T_y T_z for 1 A, as `Series`; from CasADi for MX, and for SX where look-ups are recorded."""
        if not isinstance(x, np.ndarray):
            return self._traced(x, y, z)
        n = len(self.nodes) - 1
        u = np.array([x.ravel(), y.ravel()]) * (n / self.tau_n) % (2 * n)
        beyond = (u > n).view(np.int8)
        u = n - np.abs(u - n)
        cell = np.minimum(u.astype(int), n - 1)
        part = np.empty((2, 2, u.shape[1]))  # shares of the nodes before and after, in x and in y
        part[1] = u - cell
        part[0] = 1 - part[1]
        weights = (
            part[:, None, 0] * part[:, 1] * np.exp(-math.pi / self.tau_n * (z.ravel() - self.z))
        ).reshape(4, -1)
        values = (weights.T[:, None] @ self.cells[cell[0] * n + cell[1]])[:, 0]
        return (values * _SIGNS[beyond[0], beyond[1]]).reshape(*x.shape, 6)

    def _traced(self, x: Any, y: Any, z: Any) -> Any:
        n = len(self.nodes) - 1
        places, signs = [], []
        for p in (x, y):
            u = p * (n / self.tau_n)
            u -= 2 * n * ca.floor(u / (2 * n))
            places.append(n - ca.fabs(u - n))
            signs.append(ca.if_else(u > n, -1, 1))
        sign = [(signs[0] if a else 1) * (signs[1] if b else 1) for a, b in zip(ODD_X, ODD_Y, strict=True)]
        return look_up(self.nodes, *places) * ca.vertcat(*sign) * ca.exp(-math.pi / self.tau_n * (z - self.z))


_SIGNS = np.array(
    [[[(-1.0) ** (i * a + j * b) for a, b in zip(ODD_X, ODD_Y, strict=True)] for j in (0, 1)] for i in (0, 1)]
)


def table(par: Parameters, model: CoilModel, n: int) -> Table:
    """Sample a coil model at the nodes of an n x n grid over the quarter, at the working height.

    Raises InputError for samples without the parities that the other three quarters follow from, for samples that are
    not finite, and without a cell.
    """
    if not n >= 1:
        raise InputError("planar.table", "n", f"{n}", "at least one cell")
    nodes = np.asarray(model(*_quarter(par, n)), dtype=float)
    if nodes.shape != (n + 1, n + 1, 6) or not np.isfinite(nodes).all():
        raise InputError(
            "planar.table", "model", f"values of shape {nodes.shape}", "six finite numbers at every node"
        )
    size = np.abs(nodes[..., :3]).max()
    # An odd function is zero at its mirror lines, which are at 0 and at tau_n.
    edges = [nodes[[0, -1]][:, :, np.array(ODD_X) == 1], nodes[:, [0, -1]][:, :, np.array(ODD_Y) == 1]]
    left = max(float(np.abs(edge).max()) for edge in edges)
    if not left <= 1e-6 * size:
        raise InputError(
            "planar.table", "model", f"{left:.3g} on a mirror line", "zero, as its mirror image has"
        )
    corners = [nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]]
    cells = np.stack(corners, axis=2).reshape(n * n, 4, 6)
    return Table(par.tau_n, par.h, readonly(nodes), readonly(cells))
