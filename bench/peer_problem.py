"""The stroke as plain arrays, for the peers that are written by hand: what does not depend on how a loop is run.

`stated` has the equations' own numbers; `problem` those of the reformulated ones. Either way the law's matrices fall
apart into (x, beta), (y, alpha) and z; what lies between them must be zero, and is left out.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.machines.tubular.plant import Parameters, plant
from malta.simulation.engine.compiled import feedforward_table
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.arrays import FloatArray

NO_SPIN = 0.0  # rad/s
MECHANICAL = [0, 1, 2, 3, 4, 6, 7, 8, 9, 10]  # of the twelve states: all but gamma's


class Workload(NamedTuple):
    """One controller and one reference, on one machine or, with `factors`, on many."""

    par: Parameters
    controller: Controller
    p_ref: FloatArray  # k x 5
    xi_ref: FloatArray  # k x 10
    v_ff: FloatArray  # k x 5
    factors: FloatArray | None = None  # count x 4, on m, K_A, K_B and K_D of `par`
    noise: float = 0.0  # in multiples of the sensors' own
    seed: int = 0
    substeps: int = 4

    @property
    def sigma(self) -> FloatArray:
        return self.noise * np.array(plant(self.par).sensors.noise)

    @property
    def varied(self) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """m, K_A, K_B and K_D of each machine."""
        by = np.ones((1, 4)) if self.factors is None else self.factors
        m, K_A, K_B, K_D = (by * [self.par.m, self.par.K_A, self.par.K_B, self.par.K_D]).T
        return m, K_A, K_B, K_D


class Stated(NamedTuple):
    """What the equations as they stand are given."""

    machines: FloatArray  # 17 x count, as Machine of peers/plain.h
    law: FloatArray  # as Law of peers/plain.h
    grid: FloatArray  # rows of z, v0 and its slope
    states: FloatArray  # 27 x count: the mover's, forces, xi


class Radial(NamedTuple):
    """The law of (x, beta) or (y, alpha): states position, angle and their rates, two forces, two measurements."""

    C: FloatArray  # 2 x 2, of position and angle
    L: FloatArray  # 4 x 2
    K: FloatArray  # 2 x 4
    Ki: FloatArray  # 2 x 2
    A: FloatArray  # 4 x 2, of position and its rate, or of angle and its rate
    B: FloatArray  # 4 x 2
    limit: FloatArray  # 2, N


class Axial(NamedTuple):
    """The law of z: states z, z_dot."""

    C: float
    L: FloatArray  # 2
    K: FloatArray  # 2
    Ki: float
    A: FloatArray  # z of z, z of z_dot, z_dot of z_dot
    B: FloatArray  # 2
    limit: float  # N


class Machine(NamedTuple):
    """What all machines share. The unit of time of the mover is a Runge-Kutta step."""

    l_S: float
    g: float
    wave: float  # cogging F_c sin(pi (wave z + phase))
    phase: float
    decay: float  # of the forces' lag in half a step
    r_max2: float
    z_max: float
    substeps: int


class Law(NamedTuple):
    """The law and its v0(z)."""

    x: Radial
    y: Radial
    z: Axial
    Ts: float
    K: FloatArray  # 5 x 10
    low: float  # of the grid of v0(z)
    high: float
    per_step: float  # intervals a metre
    last: int  # interval
    rows: FloatArray  # an interval each: value and slope of y1, y2, z, and two of padding


class Problem(NamedTuple):
    """One controller and one reference, and `count` machines."""

    machine: Machine
    law: Law
    # 8 x count, as Body and Forces of peers/loop.h: 2 K_A / m, 2 K_A l_B^2 / I, m / I, F_c / m, omega_z I_zz / I; what
    # a newton of the law adds to the sums over m, the moments over I, the thrust over m
    bodies: FloatArray
    start: FloatArray  # the mover's twelve states
    v0: FloatArray  # of y1, y2, z at the start
    p_ref: FloatArray  # k x 5
    feed: FloatArray  # k x 5, K xi* + v_ff


def stated(work: Workload) -> Stated:
    par, c, (m, K_A, K_B, K_D) = work.par, work.controller, work.varied
    believed, ff, h = c.parameters, c.feedforward, work.controller.sample_time / work.substeps
    assert isinstance(believed, Parameters)
    law_of(c)  # checks
    rows = (
        *(1 / m, 2 * K_A, 2 * K_A * par.l_B**2, K_B / believed.K_B, K_D / believed.K_D),
        *(
            1 / par.I_xx,
            par.I_zz / par.I_xx,
            par.l_B,
            par.l_S,
            2 * math.pi / par.L_p,
            par.phi_c,
            par.F_c,
            par.g,
        ),
        *(math.exp(-par.w_cc * h / 2), h, par.r_max**2, par.z_max),
    )
    machines = np.array([np.broadcast_to(row, m.shape) for row in rows])
    matrices = (c.L, c.Cd, c.Ad, c.Bd, c.K, c.Ki, c.limits.force, np.array(c.sample_time))
    states = np.zeros((27, len(m)))
    states[MECHANICAL] = work.xi_ref[0][:, None]
    states[12:17] = ff.at(float(work.xi_ref[0, 2]))[:, None] * machines[[3, 3, 3, 3, 4]]
    states[17:] = work.xi_ref[0][:, None]
    return Stated(
        machines, np.concatenate([np.ravel(M) for M in matrices]), feedforward_table(ff.z_grid, ff.v0), states
    )


def problem(work: Workload) -> Problem:
    """The numbers of peers/loop.h."""
    par, c, h = work.par, work.controller, work.controller.sample_time / work.substeps
    assert par.I_xx == par.I_yy, "gamma is left out"
    assert par.r_max < 0.007 * par.l_S, "sines and cosines are good for 0.01 rad"
    law, believed = law_of(c), c.parameters
    assert isinstance(believed, Parameters)
    assert (par.I_max, c.delay) == (believed.I_max, 0), "the law limits what the machine would"
    m, K_A, K_B, K_D = work.varied
    inertia, push = par.I_xx, K_B / believed.K_B * h**2
    bodies = [2 * K_A / m * h**2, 2 * K_A * par.l_B**2 / inertia * h**2, m / inertia, par.F_c / m * h**2]
    bodies += [
        NO_SPIN * par.I_zz / inertia * h + 0 * m,
        push / m,
        push * par.l_B / inertia,
        K_D / believed.K_D / m * h**2,
    ]
    start = np.zeros(12)
    start[MECHANICAL] = work.xi_ref[0]
    return Problem(
        machine=Machine(
            l_S=par.l_S,
            g=par.g * h**2,
            wave=2 / par.L_p,
            phase=par.phi_c / math.pi,
            decay=math.exp(-par.w_cc * h / 2),
            r_max2=par.r_max**2,
            z_max=par.z_max,
            substeps=work.substeps,
        ),
        law=law,
        bodies=np.array(bodies).reshape(8, -1),
        start=start,
        v0=c.feedforward.at(float(start[2]))[[1, 3, 4]],
        p_ref=np.ascontiguousarray(work.p_ref, dtype=float),
        feed=work.xi_ref @ law.K.T + work.v_ff,
    )


@lru_cache(maxsize=8)
def law_of(c: Controller) -> Law:
    """Once a controller; records compare by identity."""
    ff, believed = c.feedforward, c.parameters
    assert isinstance(believed, Parameters)
    constants = np.array([believed.K_B] * 4 + [2 * believed.K_D])
    assert np.allclose(c.limits.force, believed.I_max * constants, rtol=1e-15)
    steps = np.diff(ff.z_grid)
    assert np.ptp(steps) < 1e-12, "the table is looked up on an even grid"
    assert np.abs(ff.v0[:, [0, 2]]).max() < 1e-12, "gravity does not act along x"
    left = {name: np.array(getattr(c, name)) for name in ("Ad", "Bd", "Cd", "K", "Ki", "L")}
    x, y = (_radial(c, left, s, f) for s, f in (([0, 4, 5, 9], [0, 2]), ([1, 3, 6, 8], [1, 3])))
    z = _axial(c, left)
    assert not any(M.any() for M in left.values()), "couplings that are left out"
    v0 = ff.v0[:, [1, 3, 4]]
    rows = np.zeros((len(steps), 8))
    rows[:, 0:6:2], rows[:, 1:6:2] = v0[:-1], np.diff(v0, axis=0)
    return Law(
        x=x,
        y=y,
        z=z,
        Ts=c.sample_time,
        K=c.K,
        low=float(ff.z_grid[0]),
        high=float(ff.z_grid[-1]),
        per_step=float(1 / steps.mean()),
        last=len(steps) - 1,
        rows=rows,
    )


@lru_cache(maxsize=8)
def packed(c: Controller) -> FloatArray:
    """The numbers of `Law` in its order, without K and rows: 42 of x, 42 of y, 12 of z, 5."""
    law = law_of(c)
    return np.concatenate(
        [np.ravel(M) for M in (*law.x, *law.y, *law.z, law.Ts, law.low, law.high, law.per_step, law.last)]
    )


def _taken(M: FloatArray, rows: list[int], columns: list[int]) -> FloatArray:
    """A block of a matrix, which is zeroed there: in the end nothing may be left."""
    block = M[np.ix_(rows, columns)]
    M[np.ix_(rows, columns)] = 0
    return block


def _radial(c: Controller, left: dict[str, FloatArray], states: list[int], forces: list[int]) -> Radial:
    A = _taken(left["Ad"], states, states)
    pairs = [[j % 2, j % 2 + 2] for j in range(4)]
    assert not any(A[j, k] for j in range(4) for k in range(4) if k not in pairs[j])
    return Radial(
        C=_taken(left["Cd"], forces, states[:2]),
        L=_taken(left["L"], states, forces),
        K=_taken(left["K"], forces, states),
        Ki=_taken(left["Ki"], forces, forces),
        A=np.array([A[j, pair] for j, pair in enumerate(pairs)]),
        B=_taken(left["Bd"], states, forces),
        limit=c.limits.force[forces],
    )


def _axial(c: Controller, left: dict[str, FloatArray]) -> Axial:
    A = _taken(left["Ad"], [2, 7], [2, 7])
    assert A[1, 0] == 0
    return Axial(
        C=float(_taken(left["Cd"], [4], [2])[0, 0]),
        L=_taken(left["L"], [2, 7], [4]).ravel(),
        K=_taken(left["K"], [4], [2, 7]).ravel(),
        Ki=float(_taken(left["Ki"], [4], [4])[0, 0]),
        A=A[[0, 0, 1], [0, 1, 1]],
        B=_taken(left["Bd"], [2, 7], [4]).ravel(),
        limit=float(c.limits.force[4]),
    )
