"""Field of the planar motor's magnets and the wrench it puts on a coil: exact Fourier series, quadrature over the legs.

The magnets are a 2-D Halbach array of equal height, relative permeability 1, without iron and without edges. Its own
axes x', y' lie at 45 degrees to x, y; poles alternate every tau = sqrt(2) tau_n along them. Above its top face, z = 0,

    B = -grad sum b / K cos(m k x) cos(n k y) e^(-K z),    k = pi / tau_n, K = k sqrt(m^2 + n^2), m + n odd.

A north pole stands at (tau_n, 0): with it a current that is positive counter-clockwise, seen from above, gives the
signs of (17)-(24). Equation numbers are those of the paper named in plant.py.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import InputError
from malta.machines.planar.parameters import COIL_ORDER, Parameters
from malta.model.equations import note
from malta.model.table_look_ups import look_up

ORDER = 60  # of the field: the last harmonic has decayed to 2e-5 at z = 1 mm
# Harmonic orders in x and y are `sin` (1) or `cos` (0) in the coil's position: mirroring the coil at x = 0 turns the
# signs of F_x, T_y and T_z, mirroring it at y = 0 those of F_y, T_x and T_z.
ODD_X = (1, 0, 0, 0, 1, 1)
ODD_Y = (0, 1, 0, 1, 0, 1)


class CoilShape(NamedTuple):
    """The parameters that harmonics are computed from; turns and remanence are 1, as they are factors of the wrench."""

    tau_n: float
    w_c: float
    h_c: float
    l_c: float
    r_c: float
    h_m: float
    upright: float
    N_c: float = 1.0
    B_r: float = 1.0


class Modes(NamedTuple):
    """Harmonics of the field: orders and the amplitude of B_z at z = 0."""

    m: FloatArray
    n: FloatArray
    b: FloatArray  # T
    k: float  # wave number of the fundamental, rad/m

    @property
    def K(self) -> FloatArray:
        """Decay of each harmonic with height, 1/m."""
        return self.k * np.hypot(self.m, self.n)


def modes(par: Parameters | CoilShape, order: int = ORDER) -> Modes:
    """Harmonics up to `order` in x and in y.

    Along x' and y' every kind of block is a product of two alternating square waves, of harmonics a, b = 1, 3, 5, ...:
    s(a) cos for the upright blocks, q(a) sin for the lying ones. Each slab of magnetization (A cos cos upright,
    -P sin cos and -Q cos sin lying) gives B_z = B_r / 2 (1 - e^(-K h_m)) (A + (alpha P + beta Q) / K).
    """
    tau = math.sqrt(2) * par.tau_n
    a, b = (odd.astype(float) for odd in np.meshgrid(*[np.arange(1, 2 * order + 2, 2)] * 2, indexing="ij"))
    alpha, beta = a * math.pi / tau, b * math.pi / tau
    K = np.hypot(alpha, beta)

    def s(j: FloatArray) -> FloatArray:
        return 4 / (math.pi * j) * np.sin(j * math.pi * par.upright / 2)

    def q(j: FloatArray) -> FloatArray:
        return 4 / (math.pi * j) * np.sin(j * math.pi / 2) * np.sin(j * math.pi * (1 - par.upright) / 2)

    rise = s(a) * s(b) + (alpha * q(a) * s(b) + beta * s(a) * q(b)) / K
    B_z = par.B_r / 2 * -np.expm1(-K * par.h_m) * rise
    amplitude = np.zeros((order + 1, order + 1))
    # cos(alpha x') cos(beta y') is half the sum of two waves of orders (a +- b) / 2 and (a -+ b) / 2 in x and y.
    for sign in (1, -1):
        m, n = np.abs(a + sign * b).astype(int) // 2, np.abs(a - sign * b).astype(int) // 2
        kept = (m <= order) & (n <= order)
        np.add.at(amplitude, (m[kept], n[kept]), 0.5 * B_z[kept] * (-1.0) ** m[kept])
    m, n = np.nonzero(amplitude)
    n_b = (readonly(n.astype(float)), readonly(amplitude[m, n]))
    return Modes(readonly(m.astype(float)), *n_b, k=math.pi / par.tau_n)


def fundamental(par: Parameters, B_z: float) -> Modes:
    """The field of (17)-(24), of amplitude B_z at z = 0: -B_z / 2 (cos k x - cos k y) e^(-k z)."""
    m, n, b = np.array([1.0, 0.0]), np.array([0.0, 1.0]), np.array([-B_z / 2, B_z / 2])
    return Modes(readonly(m), readonly(n), readonly(b), math.pi / par.tau_n)


def flux_density(field: Modes, points: FloatArray) -> FloatArray:
    """B at points (..., 3) above the magnets, T."""
    x, y, z = (points[..., i, None] for i in range(3))
    kx, ky = field.m * field.k, field.n * field.k
    decay = field.b * np.exp(-field.K * z)
    s_x, c_x, s_y, c_y = np.sin(kx * x), np.cos(kx * x), np.sin(ky * y), np.cos(ky * y)
    parts = (kx / field.K * s_x * c_y, ky / field.K * c_x * s_y, c_x * c_y)
    return np.stack([(decay * part).sum(-1) for part in parts], axis=-1)


class Winding(NamedTuple):
    """The current of a coil: nodes of a quadrature over its plan, about its centre."""

    x: FloatArray  # m
    y: FloatArray
    j_x: FloatArray  # direction of the current times the area that the node stands for, m^2
    j_y: FloatArray


def winding(par: Parameters | CoilShape, *, rectangles: bool = False, nodes: int = 64) -> Winding:
    """A coil of uniform current density: four legs and four round corners of inner radius r_c, l_c between axes.

    rectangles: the four l_c x w_c rectangles of (23) and (24), which overlap at the corners.
    """
    s, w_s = _gauss(nodes)
    r, w_r = _gauss(max(8, nodes // 4))
    straight = par.l_c if rectangles else par.l_c - par.w_c - 2 * par.r_c
    # The leg at x > 0 carries its current along +y, the corner after it turns it to -x; the others are turned copies.
    along, across = (grid.ravel() for grid in np.meshgrid(s * straight, r * par.w_c, indexing="ij"))
    area = np.outer(w_s * straight, w_r * par.w_c).ravel()
    leg = (par.l_c / 2 + across, along, 0 * area, area)
    pieces = [leg]
    if not rectangles:
        angle, radius = np.meshgrid((s + 0.5) * math.pi / 2, par.r_c + (r + 0.5) * par.w_c, indexing="ij")
        area = np.outer(w_s * math.pi / 2, w_r * par.w_c) * radius
        c, s_ = np.cos(angle), np.sin(angle)
        corner = (straight / 2 + radius * c, straight / 2 + radius * s_, -area * s_, area * c)
        pieces.append(tuple(part.ravel() for part in corner))
    turned = []
    for x, y, j_x, j_y in pieces:
        for _ in range(4):
            turned.append((x, y, j_x, j_y))
            x, y, j_x, j_y = -y, x, -j_y, j_x
    return Winding(*(readonly(np.concatenate(part)) for part in zip(*turned, strict=True)))


def _gauss(nodes: int) -> tuple[FloatArray, FloatArray]:
    """Gauss-Legendre nodes and weights from -1/2 to 1/2."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    return x / 2, w / 2


def centre_of_force(par: Parameters | CoilShape) -> float:
    """Height of the centre of the fundamental's force above a coil's lower face, m: the reference of r_z."""
    k = math.pi / par.tau_n
    return 1 / k - par.h_c / math.expm1(k * par.h_c)


def quadrature(
    par: Parameters, field: Modes, coil: Winding, position: FloatArray, turn: FloatArray | None = None
) -> FloatArray:
    """(12), (13) for 1 A in one coil by quadrature: F and T about the coil's centre of force, in the coil's frame.

    position : of the coil's axis and of its lower face, if level, m
    turn : rotation R_RI of a tilted coil about its centre of force
    """
    z, w_z = _gauss(12)
    R = np.eye(3) if turn is None else turn
    shape = (len(z), len(coil.x))
    local = np.stack(
        [
            np.broadcast_to(coil.x, shape),
            np.broadcast_to(coil.y, shape),
            np.broadcast_to(((z + 0.5) * par.h_c - centre_of_force(par))[:, None], shape),
        ],
        axis=-1,
    )
    centre = position + np.array([0, 0, centre_of_force(par)])
    density = (
        par.N_c / (par.w_c * par.h_c) * np.multiply.outer(w_z * par.h_c, np.stack([coil.j_x, coil.j_y], -1))
    )
    J = np.concatenate([density, np.zeros((*shape, 1))], axis=-1)
    F = np.cross(J, flux_density(field, centre + local @ R) @ R.T)
    return np.concatenate([F.sum((0, 1)), np.cross(local, F).sum((0, 1))])


@dataclass(frozen=True, eq=False)
class Series:
    """Wrench of 1 A in a level coil, about its centre of force: exact within the harmonics of the field.

    Component c is `scale` times the sum of G[c] e^(-K z) sin or cos(m k x) sin or cos(n k y), see ODD_X and ODD_Y.
    """

    m: FloatArray
    n: FloatArray
    k: float  # rad/m
    K: FloatArray  # 1/m
    G: FloatArray  # 6 x harmonics at z = 0; times scale, N/A and N m/A
    scale: Any = 1.0  # a CasADi symbol where turns or remanence are

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """F_x F_y F_z T_x T_y T_z: CasADi's 6-vector, or (..., 6) of numpy arrays x, y, z of one shape.

        In CasADi z may be a tuple of heights that add up: coils in a row share the decay over those they share.
        """
        if isinstance(x, np.ndarray):
            decay = self.scale * np.exp(-np.multiply.outer(z, self.K))
            X, Y = np.multiply.outer(x, self.k * self.m), np.multiply.outer(y, self.k * self.n)
            X_, Y_ = (np.cos(X) * decay, np.sin(X) * decay), (np.cos(Y), np.sin(Y))
            return np.stack(
                [(X_[i] * Y_[j]) @ g for g, i, j in zip(self.G, ODD_X, ODD_Y, strict=True)], axis=-1
            )
        heights = z if isinstance(z, tuple) else (z,)
        X, parts = self._waves(x), list[Any]([0] * 6)
        for m, sums in self._rows(self._waves(y), self._decays(heights)):
            parts = [part + X[m][odd] * sum_n for part, odd, sum_n in zip(parts, ODD_X, sums, strict=True)]
        return self.scale * ca.vertcat(*parts)

    def _waves(self, v: Any) -> list[tuple[Any, Any]]:
        return _multiples(self.k * v, int(max(*self.m, *self.n)))

    def _decays(self, heights: tuple[Any, ...]) -> dict[float, Any]:
        return {K: math.prod(ca.exp(-K * height) for height in heights) for K in self.K.tolist()}

    def _rows(self, Y: list[tuple[Any, Any]], decays: dict[float, Any]) -> Iterator[tuple[int, list[Any]]]:
        """Sums over n for each m: they are the same for all coils of one y."""
        for m in range(int(self.m.max()) + 1):
            sums: list[Any] = [0] * 6
            for h in np.flatnonzero(self.m == m):
                waves = [decays[self.K[h]] * wave for wave in Y[int(self.n[h])]]
                for c in np.flatnonzero(self.G[:, h]):
                    sums[c] += self.G[c, h] * waves[ODD_Y[c]]
            yield m, sums

    def note_shared(self, xs: list[Any], ys: list[Any], z: Any) -> None:
        """Name what the coils of a grid share. xs, ys : places of its rows and columns, m; z : height of all, m"""
        decays = self._decays((z,))
        note(
            "decays",
            "decays = e^(-kappa z) of the field's harmonics",
            len(decays),
            decays=ca.vertcat(*decays.values()),
        )
        for name, places in (("x", xs), ("y", ys)):
            waves = [ca.vertcat(*(w for pair in self._waves(v)[1:] for w in pair)) for v in places]
            meaning = f"waves_{name} = cos, sin of 1, 2, 3 ... times k {name}, of each row of coils"
            note(f"waves_{name}", meaning, len(waves), **{f"waves_{name}": ca.vertcat(*waves)})
        rows = [
            [s for _, sums in self._rows(self._waves(v), decays) for s in sums if not isinstance(s, int)]
            for v in ys
        ]
        meaning = "sums = harmonics of one multiple of k x: decays times waves_y, of each row of coils"
        note("sums", meaning, len(rows), sums=ca.vertcat(*(s for row in rows for s in row)))

    def above(self, force: float, z: float) -> Series:
        """The series without harmonics whose forces are below `force` (N/A) at the height z, and without such torques.

        The three forces of a harmonic are kept or left out together, so that the field has no curl and no divergence.
        A torque counts as a force at three pole pitches, the size of a coil: the arms of the coils' forces are as long.
        """
        size = np.abs(self.scale * self.G * np.exp(-self.K * z))
        kept = size[:3].max(axis=0) >= force
        G = np.where(np.vstack([[kept] * 3, size[3:] >= force * 3 * math.pi / self.k]), self.G, 0.0)[:, kept]
        return Series(self.m[kept], self.n[kept], self.k, self.K[kept], readonly(G), self.scale)


def _multiples(angle: Any, order: int) -> list[tuple[Any, Any]]:
    """(cos, sin) of 0, 1, ..., order times an angle, by Chebyshev's recurrence: two calls of libm."""
    c, s = ca.cos(angle), ca.sin(angle)
    found: list[tuple[Any, Any]] = [(1, 0), (c, s)]
    for _ in range(order - 1):
        (c_i, s_i), (c_j, s_j) = found[-2:]
        found.append((2 * c * c_j - c_i, 2 * c * s_j - s_i))
    return found


@lru_cache(maxsize=8)
def unit_series(shape: CoilShape, order: int) -> Series:
    """The whole field's harmonics up to `order`, for one turn and one tesla."""
    return series(shape, modes(shape, order), winding(shape))


def series(par: Parameters | CoilShape, field: Modes, coil: Winding) -> Series:
    """(12), (13) harmonic by harmonic: plan by quadrature, height in closed form, position by addition theorems.

    Terms that vanish for a coil of four-fold symmetry are left out.
    """
    m, n, K = field.m[:, None], field.n[:, None], field.K
    kappa = np.hypot(m, n)
    x, y, j_x, j_y = coil
    X, Y = field.k * m * x, field.k * n * y
    s_x, c_x, s_y, c_y = np.sin(X), np.cos(X), np.sin(Y), np.cos(Y)
    plan = [
        -j_y * s_x * c_y,
        j_x * c_x * s_y,
        j_x * n / kappa * c_x * s_y - j_y * m / kappa * s_x * c_y,
        y * (j_x * n / kappa * c_x * c_y + j_y * m / kappa * s_x * s_y),
        x * (j_x * n / kappa * s_x * s_y + j_y * m / kappa * c_x * c_y),
        -(x * j_x + y * j_y) * s_x * s_y,
    ]
    G = np.array([part.sum(-1) for part in plan])
    # Integrals over the height of e^(-K z) and of (z - centre of force) e^(-K z).
    zeroth = -np.expm1(-K * par.h_c) / K
    first = (1 / K - centre_of_force(par)) * zeroth - par.h_c * np.exp(-K * par.h_c) / K
    torque = np.array([-G[1], G[0]]) * first
    G = G * zeroth
    G[3:5] += torque
    G *= par.N_c / (par.w_c * par.h_c) * field.b
    G[np.abs(G) < 1e-13 * np.abs(G).max()] = 0  # these are zero by symmetry, but for rounding
    kept = np.abs(G).max(axis=0) > 0
    m_n = readonly(field.m[kept]), readonly(field.n[kept])
    return Series(*m_n, k=field.k, K=readonly(K[kept]), G=readonly(G[:, kept]))


# Coil models of the planar motor: the exact wrench of a coil, the paper's formulas, and its bilinear table.
#
# A coil model is a function (x, y, z) -> wrench of 1 A in a level coil there, about its own centre of force, in
# CasADi or numpy: `Analytical` is the paper's (17)-(24), `FieldTable` its bilinear table, `field.Series` the Fourier
# series. Equation numbers are those of the paper named in plant.py.


CoilModel = Callable[[Any, Any, Any], Any]
MIN_HARMONIC_SHARE = 4e-5  # of the largest harmonic's force at z = 0: `simulation_model` leaves out less


def shape_of(par: Parameters) -> CoilShape:
    """The parameters that the harmonics are computed from."""
    return CoilShape(par.tau_n, par.w_c, par.h_c, par.l_c, par.r_c, par.h_m, par.upright)


def simulation_model(par: Parameters, order: int = COIL_ORDER) -> Series:
    """`exact_model` without the harmonics below MIN_HARMONIC_SHARE: 22 of 144 are left, at every height.

    It changes a coil's force by up to 0.2 of 8200 mN/A at a height of 1 mm, and by 0.9 of 9900 mN/A on the magnets.
    """
    whole = unit_series(shape_of(par), order)
    few = whole.above(MIN_HARMONIC_SHARE * float(np.abs(whole.G[:3]).max()), 0.0)
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
class FieldTable:
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
            return self._trace(x, y, z)
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

    def _trace(self, x: Any, y: Any, z: Any) -> Any:
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


def table(par: Parameters, model: CoilModel, n: int) -> FieldTable:
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
    return FieldTable(par.tau_n, par.h, readonly(nodes), readonly(cells))
