"""A magnetically levitated planar motor: sixteen coils on a mover above a 2-D Halbach array of magnets.

Source: F. Xing, B. Kou, L. Zhang, X. Yin, Y. Zhou, "Design of a Control System for a Maglev Planar Motor Based on
Two-Dimension Linear Interpolation", 2017; equation and table numbers are its own.
State: x y z, the angles phi theta psi of eq. (7), and their rates. x, y lie in the plane of the magnets, gravity is
along -z. W = K(p) i is the wrench of the coil currents about the centre of gravity, in the frame of the magnets; for a
level mover also in its own.

Heights: the plant's state z counts from the working height par.h, so that z = 0 is the air gap of Table 1. Coil models
and the functions of a position p take the height of the coils' lower faces above the magnets, of a level mover.

A coil model is a function (x, y, z) -> wrench of 1 A in a level coil there, about its own centre of force, in CasADi
or numpy: `Analytical` is the paper's (17)-(24), `Table` its bilinear table, `planar_field.Series` the Fourier series.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from itertools import product
from numbers import Real
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import CheckError, InputError
from malta.machines.planar.field import (
    COIL_ORDER,
    ODD_X,
    ODD_Y,
    Series,
    Shape,
    centre_of_force,
    unit_series,
)
from malta.model.data import check_parameters, si
from malta.model.plant import (
    Actuator,
    Plant,
    Signal,
    readonly,
    traced,
)
from malta.model.rigidbody import (
    acceleration,
    principal,
    rotation,
    turned,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI; where each comes from is said in data/planar.toml."""

    tau_n: float = si("m", above=0, shapes=True)  # pole pitch along x and y
    w_c: float = si("m", above=0, shapes=True)  # width of a coil's leg
    h_c: float = si("m", above=0, shapes=True)  # height of a coil
    l_c: float = si("m", above=0, shapes=True)  # length of a leg, and distance of opposite legs' axes
    r_c: float = si("m", at_least=0, shapes=True)  # inner corner radius of a coil
    N_c: float = si("1", above=0)  # turns
    h_m: float = si("m", above=0, shapes=True)  # thickness of the magnets
    B_r: float = si("T", above=0)  # their remanence, relative permeability 1
    upright: float = si(
        "1", above=0, shapes=True
    )  # width of the upright blocks in their own pole pitch, sqrt(2) tau_n
    h: float = si("m", above=0)  # air gap: the working height
    B_z: float = si("T", above=0)  # flux density that (17)-(24) count with, at the working height
    C: float = si("1", above=0)  # harmonic compensation factor of (23), (24)
    coil_pitch: float = si("m", above=0)  # of the 4 x 4 coils
    r_z: float = si("m")  # centre of gravity to the coils' centre of force
    w_m: float = si("m", above=0)  # width of the mover's square plate
    m: float = si("kg", above=0)  # mover with coils
    I_x: float = si("kg m^2", above=0)
    I_y: float = si("kg m^2", above=0, twin="I_x")
    I_z: float = si("kg m^2", above=0)
    g: float = si("m/s^2", at_least=0)
    F_max: float = si("N", above=0)  # limit of each commanded force
    T_max: float = si("N m", above=0)  # limit of each commanded torque
    I_max: float = si("A", above=0)  # limit of each coil current
    T_s: float = si("s", above=0, shapes=True)  # control period
    T_d: float = si("s", at_least=0, shapes=True)  # dead time of computation and hold
    xy_max: float = si("m", above=0)  # travel in the plane, either way
    z_max: float = si("m", above=0)  # greatest height
    s_p: float = si("m", at_least=0)  # position sensor noise, rms of a sample
    s_a: float = si("rad", at_least=0)  # angle sensor noise, rms of a sample
    order: float = si("1", at_least=1, shapes=True)  # harmonics of the controller's coil model; 1: (17)-(24)
    cells: float = si(
        "1", at_least=0, shapes=True
    )  # of its table over tau_n, along x and along y; 0: no table
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "planar.Parameters")
        if self.upright >= 1:
            raise InputError("planar.Parameters", "upright", f"{self.upright}", "a share below 1")
        straight = self.l_c - self.w_c - 2 * self.r_c
        if not straight > 0:
            raise InputError(
                "planar.Parameters", "r_c", f"{self.r_c} m", f"a corner that fits legs {self.l_c} m apart"
            )
        if not self.coil_pitch >= self.l_c + self.w_c:
            found, coil = f"{self.coil_pitch} m", self.l_c + self.w_c
            raise InputError(
                "planar.Parameters", "coil_pitch", found, f"at least {coil:.6g} m, the width of a coil"
            )
        if not self.z_max > self.h:
            raise InputError("planar.Parameters", "z_max", f"{self.z_max} m", f"more than h, {self.h} m")
        if not (self.order <= COIL_ORDER and self.order == int(self.order)):
            expected = f"a whole number from 1 to {COIL_ORDER}"
            raise InputError("planar.Parameters", "order", f"{self.order:g}", expected)
        if self.cells != int(self.cells):
            raise InputError("planar.Parameters", "cells", f"{self.cells:g}", "a whole number")


CoilModel = Callable[[Any, Any, Any], Any]

POSITIONS = tuple(Signal(n, "m") for n in "xyz") + tuple(Signal(n, "rad") for n in ("phi", "theta", "psi"))
RATES = tuple(Signal(f"{s.name}_dot", f"{s.unit}/s") for s in POSITIONS)
WRENCH = tuple(Signal(f"F_{a}", "N") for a in "xyz") + tuple(Signal(f"T_{a}", "N m") for a in "xyz")
CURRENTS = tuple(Signal(f"i_{k}", "A") for k in range(1, 17))
SENSOR_ERRORS = tuple(Signal(f"offset_{s.name}", s.unit) for s in POSITIONS)
CONTACTS = ("touchdown on the magnets", "above the greatest height", "left the magnet array")

STEPS = (-1.5, -0.5, 0.5, 1.5)  # coil pitches from the mover's centre, along x and y
LEAST = 4e-5  # of the largest term's force on the magnets: what `simulated` leaves out
WORST = 10.0  # largest accepted condition of K(p): 2.4 with a pitch of 16/3 tau_n, 20 and more with a bad one


def plant(par: Parameters) -> Plant:
    """The mover under the wrench of its coils; sixteen currents, found for the position as if the mover were level.

    Raises CheckError when the coils cannot give every wrench: see `check_pitch`. Parameters that are symbols are not
    checked: they stand for those of a record that was.
    """
    numbers = all(isinstance(getattr(par, f.name), Real | str) for f in fields(par))
    if numbers:
        check_pitch(par, simulated(par))
    x, u, w = ca.SX.sym("x", 12), ca.SX.sym("u", 6), ca.SX.sym("w", 6)
    return Plant(
        name="planar",
        parameters=par,
        states=POSITIONS + RATES,
        inputs=WRENCH,
        outputs=POSITIONS,
        disturbances=WRENCH,
        uncontrolled=(),
        f=traced("f", [x, u, w], motion(par, x, u, w)),
        h=lambda x, _: x[:6],
        load=lambda _: load(par),
        position_of=lambda y: y,
        preload=lambda _: -load(par),
        currents=_commutation(par, numbers=numbers),
        forces=lambda x, i: _forces(_shape(par))(x, i, _entering(par)),
        limited=lambda i: limited(par, i),
        tabulated=par.cells > 0,
        actuator=Actuator(
            coils=CURRENTS,
            force_limit=(par.F_max, par.F_max, par.F_max, par.T_max, par.T_max, par.T_max),
            force_constant=(),
            current_limit=par.I_max,
            voltage_limit=math.inf,
            R=0.0,
            L=0.0,
            crossover=math.inf,
            phase_margin=0.0,
            sample_time=par.T_s,
            loop_delay=0.0,
            dead_time=par.T_d,
        ),
        windings=None,
        electronics=None,
        contacts=CONTACTS,
        contact=lambda x: contact(par, x),
        cushioned=(False, False, False),
        bearing=lambda _: ca.DM.zeros(6),
        sense=lambda x, errors: x[:6] + errors,
        sensor_errors=SENSOR_ERRORS,
        noise=(par.s_p, par.s_p, par.s_p, par.s_a, par.s_a, par.s_a),
        uniform=False,
        resolution=(0.0,) * 6,
        inertia=(par.m, par.m, par.m, par.I_x, par.I_y, par.I_z),
        mass=par.m,
        thrust="F_y",
        stroke="y",
        travel=par.xy_max,
        variant=plant,
    )


def load(par: Parameters) -> Any:
    """Gravity, as a wrench at the centre of gravity."""
    return ca.vertcat(0, 0, -par.m * par.g, 0, 0, 0)


def contact(par: Parameters, x: Any) -> Any:
    """Shares of the way from the working height to the magnets and to z_max, and of xy_max: 1 at contact.

    Touchdown is that of the lowest corner of a plate w_m wide in the plane of the coils' lower faces.
    """
    up = rotation(x[3:6])[:, 2]  # the vertical in the mover's frame
    below = par.r_z - centre_of_force(par)  # centre of gravity to that plane
    sunk = below * (1 - up[2]) + par.w_m / 2 * (ca.fabs(up[0]) + ca.fabs(up[1])) - x[2]
    beyond = ca.fmax(ca.fabs(x[0]), ca.fabs(x[1])) / par.xy_max
    return ca.vertcat(sunk / par.h, x[2] / (par.z_max - par.h), beyond)


_ENTERING = ("coil_pitch", "r_z", "h", "N_c", "B_r", "B_z", "C")  # what K(p) takes besides the Shape


def _entering(par: Parameters) -> Any:
    return ca.vertcat(*(getattr(par, name) for name in _ENTERING))


def _shape(par: Parameters) -> Shape:
    return Shape(par.tau_n, par.w_c, par.h_c, par.l_c, par.r_c, par.h_m, par.upright)


def _symbols(shape: Shape) -> tuple[Any, Any]:
    """A stand-in for parameters of this shape, with symbols for those that enter, and their vector."""
    symbols = {name: ca.SX.sym(name) for name in _ENTERING}
    return SimpleNamespace(**shape._asdict() | symbols), ca.vertcat(*symbols.values())


@lru_cache(maxsize=8)  # a third of a second, for all parameters of a shape
def _forces(shape: Shape) -> ca.Function:
    """(x, i, entering) -> W: what coil currents do to the mover where it is, tilted."""
    par, entering = _symbols(shape)
    x, i = ca.SX.sym("x", 12), ca.SX.sym("i", 16)
    W = wrench_matrix(par, simulated(par), _place(par, x), x[3:6]) @ i
    return ca.Function("forces", [x, i, entering], [ca.cse(W)])


@lru_cache(maxsize=8)
def _currents(shape: Shape, order: int) -> ca.Function:
    """(y, W, entering) -> i, without a table."""
    par, entering = _symbols(shape)
    y, W = ca.SX.sym("y", 6), ca.SX.sym("W", 6)
    i = currents(ca.cse(wrench_matrix(par, _harmonics(par, order), _place(par, y))), W)
    return ca.Function("currents", [y, W, entering], [ca.cse(i)])


def _place(par: Parameters, y: Any) -> Any:
    """p, with the height above the magnets, of states or outputs."""
    return ca.vertcat(y[:2], par.h + y[2])


def _commutation(par: Parameters, *, numbers: bool) -> Callable[[Any, Any], Any]:
    """(y, W) -> i by the coil model that `order` and `cells` name."""
    if not par.cells:
        return lambda y, W: _currents(_shape(par), int(par.order))(y, W, _entering(par))
    if numbers:
        look_up = decoupling(par, believed(par))
        return lambda y, W: look_up(_place(par, y), W)

    def refused(_y: Any, _W: Any) -> Any:
        raise CheckError("planar: a table holds numbers: where parameters are symbols, cells has to be 0")

    return refused


def simulated(par: Parameters, order: int = COIL_ORDER) -> Series:
    """`truth` without the terms below LEAST: 22 of 144 harmonics, whatever the height.

    At 1 mm a coil's force changes by up to 0.2 of 8200 mN/A, on the magnets by 0.9 of 9900.
    """
    whole = unit_series(_shape(par), order)
    few = whole.above(LEAST * float(np.abs(whole.G[:3]).max()), 0.0)
    return replace(few, scale=par.N_c * par.B_r)


def believed(par: Parameters) -> CoilModel:
    """The controller's coil model: (17)-(24) with `order` 1, else as many harmonics; sampled in a table of `cells`."""
    model = _harmonics(par, int(par.order))
    return table(par, model, int(par.cells)) if par.cells else model


def _harmonics(par: Parameters, order: int) -> CoilModel:
    return Analytical(par) if order == 1 else simulated(par, order)


@dataclass(frozen=True)
class Analytical:
    """Eqs (17)-(24) for 1 A, the fundamental alone, T about the coil's own centre of force.

    With B_xy = B_z / sqrt(2): a field without curl has no other. B_z is the flux density at the working height, so C_z
    counts from there. NOTE: (16) integrates from 0 to h_c; the coil is at p_z to p_z + h_c. (21) prints -y_k F_z, it is
    -x_k F_z; the lever arms of (20)-(22) are applied in `wrench_matrix`, for every coil model. The rectangles of (23)
    and (24) overlap at the corners: C_1 - C_2, the torque about a coil's own centre, is 3.8 times a rounded coil's.
    """

    par: Parameters

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """F_x F_y F_z T_x T_y T_z, as Series gives them."""
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


def truth(par: Parameters, order: int = COIL_ORDER) -> Series:
    """The exact wrench of the rounded coil in the whole field."""
    return replace(unit_series(_shape(par), order), scale=par.N_c * par.B_r)


def compensation(par: Parameters, model: CoilModel) -> float:
    """C of (23), (24) that fits the forces of a coil model at the working height best, in least squares."""
    x, y, z = _quarter(par, 24)
    mine, data = Analytical(par)(x, y, z)[..., :3], model(x, y, z)[..., :3]
    return float(par.C * (mine * data).sum() / (mine * mine).sum())


def _quarter(par: Parameters, n: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Region I of Fig. 3, x and y from 0 to tau_n in n steps, at the working height."""
    x, y = np.meshgrid(*[np.linspace(0, par.tau_n, n + 1)] * 2, indexing="ij")
    return x, y, np.full_like(x, par.h)


@dataclass(frozen=True, eq=False)
class Table:
    """Bilinear interpolation (25)-(29) over a quarter period; parities give the rest, e^(-pi z / tau_n) the height.

    NOTE: (27) prints the weights of f(x_i, y_j+1) and f(x_i+1, y_j) in each other's place, and "uv" for t u.
    """

    tau_n: float  # m
    z: float  # height of the nodes, m
    nodes: FloatArray  # (n + 1) x (n + 1) x 6: N/A and N m/A
    cells: FloatArray  # n^2 x 4 x 6, the corners of each cell

    def __call__(self, x: Any, y: Any, z: Any) -> Any:
        """F_x F_y F_z T_x T_y T_z, as Series gives them; CasADi MX only, as SX has no tables."""
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
        grid = list(np.linspace(0, n, n + 1))
        values = self.nodes.transpose(1, 0, 2).ravel()  # CasADi counts the first axis fastest
        table = ca.interpolant("table", "linear", [grid, grid], values, {"lookup_mode": ["exact", "exact"]})
        places, signs = [], []
        for p in (x, y):
            u = p * (n / self.tau_n)
            u -= 2 * n * ca.floor(u / (2 * n))
            places.append(n - ca.fabs(u - n))
            signs.append(ca.if_else(u > n, -1, 1))
        sign = [(signs[0] if a else 1) * (signs[1] if b else 1) for a, b in zip(ODD_X, ODD_Y, strict=True)]
        return table(ca.vertcat(*places)) * ca.vertcat(*sign) * ca.exp(-math.pi / self.tau_n * (z - self.z))


_SIGNS = np.array(
    [[[(-1.0) ** (i * a + j * b) for a, b in zip(ODD_X, ODD_Y, strict=True)] for j in (0, 1)] for i in (0, 1)]
)


def table(par: Parameters, model: CoilModel, n: int) -> Table:
    """Sample a coil model at the nodes of an n x n grid over the quarter, at the working height.

    Raises InputError where the samples do not have the parities that the other three quarters are made with.
    """
    if not n >= 1:
        raise InputError("planar.table", "n", f"{n}", "at least one cell")
    nodes = np.asarray(model(*_quarter(par, n)), dtype=float)
    if nodes.shape != (n + 1, n + 1, 6) or not np.isfinite(nodes).all():
        raise InputError(
            "planar.table", "model", f"values of shape {nodes.shape}", "six finite numbers at every node"
        )
    size = np.abs(nodes[..., :3]).max()
    # What is odd about 0 is zero there, and at tau_n too, where the next period's mirror stands.
    edges = [nodes[[0, -1]][:, :, np.array(ODD_X) == 1], nodes[:, [0, -1]][:, :, np.array(ODD_Y) == 1]]
    left = max(float(np.abs(edge).max()) for edge in edges)
    if not left <= 1e-6 * size:
        raise InputError(
            "planar.table", "model", f"{left:.3g} on a mirror line", "zero, as its mirror image has"
        )
    corners = [nodes[:-1, :-1], nodes[:-1, 1:], nodes[1:, :-1], nodes[1:, 1:]]
    cells = np.stack(corners, axis=2).reshape(n * n, 4, 6)
    return Table(par.tau_n, par.h, readonly(nodes), readonly(cells))


def coil_centres(par: Parameters) -> FloatArray:
    """(x_k, y_k, r_z) of the coils' centres of force from the centre of gravity, 16 x 3: eq. (3)."""
    steps = np.array(STEPS) * par.coil_pitch
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps, indexing="ij"))
    return np.stack([x, y, np.full(16, par.r_z)], axis=-1)


@lru_cache(maxsize=16)
def _arms(par: Parameters) -> tuple[FloatArray, FloatArray]:
    """The coils' arms, and 16 matrices 6 x 6 that move their wrenches from their own centres to that of gravity."""
    arms = coil_centres(par)
    levers = np.tile(np.eye(6), (16, 1, 1))
    for lever, arm in zip(levers, arms, strict=True):
        lever[3:, :3] = np.cross(arm, np.eye(3)).T
    return readonly(arms), readonly(levers)


def wrench_matrix(par: Parameters, model: CoilModel, p: Any, q_r: Any = None) -> Any:
    """K(p) of (33), 6 x 16: N/A and N m/A, about the centre of gravity, in the frame of the magnets.

    p : x y z, numpy or CasADi; q_r : CasADi angles. With them the coils go where the tilted mover takes them, each as
    if it were level itself: the stiffness against tilt that the arms make is there, the 2 to 6 % within a coil are not.
    NOTE: (33) prints F_z3 in column 2.
    """
    if isinstance(p, np.ndarray):
        arms, levers = _arms(par)
        at = arms + checked(par, p)
        K: FloatArray = (levers @ model(at[:, 0], at[:, 1], at[:, 2] - par.r_z)[..., None])[..., 0].T
        return K
    columns = []
    for a, b in product(STEPS, STEPS):  # parameters may be symbols here
        arm = ca.vertcat(a * par.coil_pitch, b * par.coil_pitch, par.r_z)
        rows = ca.diag(arm) if q_r is None else ca.diag(arm) @ rotation(q_r)
        at = ca.sum1(rows).T
        # Decays over a column's rise, a row's and the mover's height are factors, each for several coils.
        heights = (p[2] + rows[2, 2] - par.r_z, rows[0, 2], rows[1, 2])
        z: Any = heights if q_r is not None and isinstance(model, Series) else p[2] + at[2] - par.r_z
        own = model(p[0] + at[0], p[1] + at[1], z)
        columns.append(ca.vertcat(own[:3], own[3:] + ca.cross(at, own[:3])))
    return ca.horzcat(*columns)


def currents(K: Any, W: Any, weights: Any = None) -> Any:
    """(34), (35): the coil currents i with K i = W that have the least sum of weights i^2. A.

    weights : of the 16 coils, 1 each; an infinite one leaves its coil out. numpy or CasADi.
    Raises, from numpy: InputError (a wrench that is not finite, a weight that is not positive) and CheckError where K
    has not full rank, so that the currents would not give the wrench.
    """
    if not isinstance(K, np.ndarray):
        KD = K if weights is None else K @ ca.diag(1 / weights)
        L = ca.chol(KD @ K.T).T if isinstance(K, ca.SX) else None
        return KD.T @ (ca.solve(KD @ K.T, W) if L is None else ca.solve(L.T, ca.solve(L, W)))
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


def limited(par: Parameters, i: Any) -> Any:
    """Coil currents within I_max, scaled together so that the wrench keeps its direction: numpy or CasADi."""
    if isinstance(i, np.ndarray):
        return i / max(1.0, float(np.abs(i).max()) / par.I_max)
    return i / ca.fmax(1, ca.mmax(ca.fabs(i)) / par.I_max)


def checked(par: Parameters, p: FloatArray) -> FloatArray:
    """A position x y z where the models hold. InputError names the coordinate that is outside."""
    limits = {"x": (-par.xy_max, par.xy_max), "y": (-par.xy_max, par.xy_max), "z": (0.0, par.z_max)}
    for (name, (low, high)), value in zip(limits.items(), p, strict=True):
        if not low <= value <= high:
            raise InputError("planar", name, f"{value:.6g} m", f"a position from {low:g} to {high:g} m")
    return p


def conditioning(par: Parameters, model: CoilModel, n: int = 12) -> FloatArray:
    """Condition numbers of K(p) over a period in x and y, n x n, infinite where K is singular.

    Torques count at the mover's radius of gyration, sqrt(I_x / m): accelerations are compared.
    """
    steps = np.arange(n) * 2 * par.tau_n / n
    scale = np.array([1.0] * 3 + [math.sqrt(par.m / par.I_x)] * 3)[:, None]
    found = np.empty((n, n))
    for a, x in enumerate(steps):
        for b, y in enumerate(steps):
            s = np.linalg.svd(scale * wrench_matrix(par, model, np.array([x, y, par.h])), compute_uv=False)
            found[a, b] = s[0] / s[-1] if s[-1] > 1e-12 * s[0] else np.inf
    return found


def check_pitch(par: Parameters, model: CoilModel) -> float:
    """The worst condition of K(p) over a period. CheckError says when the coils cannot give six forces and torques."""
    worst = float(conditioning(par, model).max())
    if not worst <= WORST:
        ratio = par.coil_pitch / par.tau_n
        found = "is singular" if worst == np.inf else f"has a condition of {worst:.3g}"
        raise CheckError(
            f"planar: with a coil pitch of {par.coil_pitch:.6g} m = {ratio:.4g} tau_n, K(p) {found}, allowed is"
            f" {WORST:g}: the coils' phases do not give forces and torques in every direction at every position"
        )
    return worst


def motion(par: Parameters, x: Any, W: Any, w: Any) -> Any:
    """x' of the mover under the coils' wrench W and an outer wrench w, gravity in it: (36)-(38) with exact angles.

    `x` is a CasADi SX symbol of 12; both wrenches are about the centre of gravity, in the frame of the magnets.
    NOTE: (39) prints roll twice, and (36) leaves out the products of rates; with them the angles are those of eq. (7).
    """
    inertia = (par.I_x, par.I_y, par.I_z)
    T_B = turned(principal(x[3:6], inertia), W[3:] + w[3:])
    q_t_ddot, q_r_ddot = acceleration(par.m, inertia, x[3:6], x[9:12], W[:3] + w[:3], T_B)
    return ca.vertcat(x[6:12], q_t_ddot, q_r_ddot)


def dynamics(par: Parameters, model: CoilModel) -> ca.Function:
    """(x, i, w) -> x': the mover under its coil currents and gravity, with the coils where tilt puts them.

    x holds the height above the magnets, w is what acts besides.
    """
    x, i, w = ca.SX.sym("x", 12), ca.SX.sym("i", 16), ca.SX.sym("w", 6)
    rate = motion(par, x, wrench_matrix(par, model, x[:3], x[3:6]) @ i, w + load(par))
    return ca.Function("dynamics", [x, i, w], [ca.cse(rate)], ["x", "i", "w"], ["dx"])


def hover(par: Parameters, model: CoilModel, p: FloatArray) -> FloatArray:
    """The coil currents that hold the level mover at p: A."""
    weight = np.array([0, 0, par.m * par.g, 0, 0, 0])
    return np.asarray(currents(wrench_matrix(par, model, checked(par, p)), weight))


def linear(f: ca.Function, x: FloatArray, i: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A = df/dx, 12 x 12, and B = df/di, 12 x 16, at held currents: the stiffness of the field stands in A."""
    at = [ca.DM(x), ca.DM(i), ca.DM.zeros(6)]
    symbols = f.sx_in()
    rate = f(*symbols)
    jacobians = ca.Function(
        "jacobians", symbols, [ca.jacobian(rate, symbols[0]), ca.jacobian(rate, symbols[1])]
    )
    A, B = (np.array(value) for value in jacobians(*at))
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        raise CheckError("planar: the linear model is not finite at this position")
    return A, B


def decoupling(par: Parameters, model: CoilModel) -> ca.Function:
    """(p, W) -> i, eqs (31)-(35) as one CasADi function, to be called, compiled or written as C.

    In SX where the coil model is, in MX with a Table. Positions are not checked here: no branch, no exception.
    """
    if isinstance(model, Table):
        P, N = ca.MX.sym("p", 3), ca.MX.sym("W", 6)
        K, V = ca.SX.sym("K", 6, 16), ca.SX.sym("W", 6)
        solve = ca.Function("solve", [K, V], [ca.cse(currents(K, V))])
        return ca.Function("decoupling", [P, N], [solve(wrench_matrix(par, model, P), N)], ["p", "W"], ["i"])
    p, W = ca.SX.sym("p", 3), ca.SX.sym("W", 6)
    i = ca.cse(currents(ca.cse(wrench_matrix(par, model, p)), W))
    return ca.Function("decoupling", [p, W], [i], ["p", "W"], ["i"])
