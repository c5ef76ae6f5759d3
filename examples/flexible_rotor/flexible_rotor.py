"""A flexible rotor on two radial magnetic bearings: the matrices of a finite element model, reduced to its modes.

A machine of a user's own: malta knows it by this file alone, which flexible_rotor.toml names. In this folder,

    python beam.py                     matrices.csv from the rotor's dimensions, and its published frequencies

law.py has the control law and the search that found it, analysis.py what an engineer of rotors asks: whirl, unbalance,
separation margins, and a bound of what the modes leave out. docs/howto/flexible_rotor.md shows them.

matrices.csv has M, G and K of the free rotor in one plane, a displacement and a slope of each node in turn; beam.py
wrote it, and any other program may. The rotor stands upright, turns with the speed Omega, and is the same in x and y:

    M x'' + Omega G y' + K x = f_x,      M y'' - Omega G x' + K y = f_y

With x = Phi q, Phi the two rigid modes and four bending modes at rest, this is

    q_x'' + 2 zeta W q_x' + Omega g q_y' + kappa W^2 q_x = Phi' f_x,      g = Phi' G Phi,  W = diag(w_k)

The magnets stand at the ends, the sensors 100 mm further in. Each axis of a bearing has two magnets, one with the bias
plus the control current i, the other with the bias less i; their force is that of examples/rotor:

    F = k_i i (a + b) / 2 + k_s g_0 (1 + i^2 / i_b^2) (a - b) / 4,   a = 1 / (1 - d / g_0)^2,  b = 1 / (1 + d / g_0)^2
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from scipy import linalg

from malta import InputError
from malta.model import Actuator, Contacts, Plant, Sensors, Signal, check_parameters, si

FILE = Path(__file__).resolve().parent / "matrices.csv"
NODE = 0.1  # m, between two nodes of matrices.csv
MAGNETS, SENSORS, DISCS = (0, 15), (1, 14), (5, 10)  # nodes
BENDING = 4  # modes that are kept


@dataclass(frozen=True)
class Parameters:
    """Physical parameters, SI; where each comes from is said in flexible_rotor.toml."""

    kappa: float = si("1", above=0)  # share of the bending stiffness
    zeta: float = si("1", above=0)  # damping ratio of the bending modes
    k_s: float = si("N/m", above=0)  # negative stiffness of a bearing axis
    k_i: float = si("N/A", above=0)  # its force per control current
    g_0: float = si("m", above=0)  # air gap
    I_max: float = si("A", above=0)  # limit of the control current
    c_r: float = si("m", above=0)  # clearance in the retainer bearings
    U_L: float = si("kg m", at_least=0)  # unbalance of the left disc
    U_R: float = si("kg m", at_least=0)  # of the right one
    theta_u: float = si("rad")  # angle between the two
    s_n: float = si("m", at_least=0)  # sensor noise, rms of a sample
    T_d: float = si("s", at_least=0, shapes=True)  # dead time from measurement to force
    Omega: float = si("rad/s", at_least=0)  # speed
    Omega_max: float = si("rad/s", above=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "flexible_rotor.Parameters")
        if not self.Omega <= self.Omega_max:
            found, most = f"{self.Omega:g} rad/s", f"at most Omega_max, {self.Omega_max:g} rad/s"
            raise InputError("flexible_rotor.Parameters", "Omega", found, most)


class Modes(NamedTuple):
    """Modes of the free rotor at rest, of mass one: frequencies (rad/s), shapes at all nodes, and what they meet."""

    w: Any
    shapes: Any  # displacements and slopes x modes
    gyroscopic: Any  # modes x modes
    magnets: Any  # displacements: 2 x modes
    sensors: Any
    discs: Any


def read_matrices(path: Path = FILE) -> tuple[Any, Any, Any]:
    """M, G and K from rows (row, column, M, G, K) of the upper triangle."""
    rows = np.loadtxt(path, delimiter=",", skiprows=1)
    n = int(rows[:, 1].max()) + 1
    i, j = rows[:, 0].astype(int), rows[:, 1].astype(int)
    found = np.zeros((3, n, n))
    found[:, i, j] = found[:, j, i] = rows[:, 2:].T
    return found[0], found[1], found[2]


@cache
def modes(count: int) -> Modes:
    """Two rigid modes (at the centre of gravity, and about it) and this many bending modes."""
    M, G, K = read_matrices()
    n = len(M)
    moved, turned = np.tile([1.0, 0.0], n // 2), np.zeros(n)
    turned[::2], turned[1::2] = NODE * np.arange(n // 2), 1.0
    turned -= (turned @ M @ moved) / (moved @ M @ moved) * moved
    values, bent = linalg.eigh(K, M, subset_by_index=[2, count + 1])
    bent *= np.sign(bent[0])
    rigid = [v / np.sqrt(v @ M @ v) for v in (moved, turned)]
    shapes = np.column_stack([*rigid, bent])
    w = np.sqrt(np.concatenate([[0.0, 0.0], values]))
    at = (shapes[[2 * k for k in nodes]] for nodes in (MAGNETS, SENSORS, DISCS))
    return Modes(w, shapes, shapes.T @ G @ shapes, *at)


AXES = ("Ax", "Bx", "Ay", "By")
DISTURBANCES = tuple(Signal(f"F_{name}", "N") for name in ("Lx", "Rx", "Ly", "Ry"))


def both(matrix: Any) -> Any:
    """The matrix of one plane for x and y."""
    return ca.DM(np.kron(np.eye(2), matrix))


def plant(par: Parameters, bending: int = BENDING) -> Plant:
    """The rotor on its bearings, with this many bending modes. Every proof covers all speeds up to Omega_max."""
    m, n = modes(bending), 2 * (bending + 2)
    names = ("r1", "r2", *(f"b{k + 1}" for k in range(bending)))
    lever, reading, discs = both(m.magnets), both(m.sensors), both(m.discs)
    upright = both(np.vstack([np.linalg.inv(m.sensors[:, :2]), np.zeros((bending, 2))]))
    return Plant(
        name="flexible_rotor",
        parameters=par,
        states=tuple(
            Signal(f"{name}_{plane}{end}", unit)
            for end, unit in (("", "m kg^0.5"), ("_dot", "m kg^0.5/s"))
            for plane in "xy"
            for name in names
        ),
        inputs=tuple(Signal(f"f_{axis}", "N") for axis in AXES),
        outputs=tuple(Signal(f"s_{axis}", "m") for axis in AXES),
        disturbances=DISTURBANCES,
        f=lambda x, u, w: motion(par, m, x, lever.T @ u + discs.T @ w),
        h=lambda x, _: reading @ x[:n],
        position_of=lambda y: upright @ y,
        actuator=Actuator(
            coils=tuple(Signal(f"i_{axis}", "A") for axis in AXES),
            force_constant=(par.k_i,) * 4,
            current_limit=par.I_max,
            dead_time=par.T_d,
            forces=lambda x, i: magnets(par, lever @ x[:n], i),
        ),
        contacts=Contacts(
            names=("retainer bearing A", "retainer bearing B"), contact=lambda x: used(par, lever @ x[:n])
        ),
        sensors=Sensors(noise=(par.s_n,) * 4),
        over={"Omega": (0.0, par.Omega_max)},
        variant=lambda other: plant(other, bending),
    )


def motion(par: Parameters, m: Modes, x: Any, push: Any) -> Any:
    """x' under forces on the modes."""
    n = 2 * len(m.w)
    q, rate, g = x[:n], x[n:], ca.DM(m.gyroscopic)
    turning = par.Omega * ca.vertcat(-(g @ rate[n // 2 :]), g @ rate[: n // 2])
    w = ca.DM(np.tile(m.w, 2))
    return ca.vertcat(rate, push + turning - 2 * par.zeta * w * rate - par.kappa * w**2 * q)


def magnets(par: Parameters, d: Any, i: Any) -> Any:
    """Forces of the bearings, N, at the displacements d there (m) and control currents i (A)."""
    bias, a, b = par.k_s * par.g_0 / par.k_i, 1 / (1 - d / par.g_0) ** 2, 1 / (1 + d / par.g_0) ** 2
    return par.k_i * i * (a + b) / 2 + par.k_s * par.g_0 / 4 * (1 + (i / bias) ** 2) * (a - b)


def used(par: Parameters, d: Any) -> Any:
    """Share of the clearance that is used up in each retainer bearing; they stand at the magnets."""
    return ca.vertcat(*(ca.sqrt(d[k] ** 2 + d[k + 2] ** 2) for k in (0, 1))) / par.c_r


def unbalance(par: Parameters, speed: Any) -> Any:
    """Amplitudes of the forces on the discs, N, of x + j y that turns as e^(j speed t)."""
    return np.array([par.U_L, par.U_R * np.exp(1j * par.theta_u)])[:, None] * np.atleast_1d(speed) ** 2
