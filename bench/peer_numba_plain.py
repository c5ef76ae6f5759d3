"""Many strokes in numba as one writes them: a loop over the machines in prange, malta's equations as they stand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numba
import numpy as np
from peer_problem import Workload, stated

if TYPE_CHECKING:
    from malta.arrays import FloatArray

Function = TypeVar("Function", bound=Callable[..., Any])
njit: Callable[[Function], Function] = numba.njit(fastmath=True, error_model="numpy")
parallel: Callable[[Function], Function] = numba.njit(fastmath=True, error_model="numpy", parallel=True)


@njit
def rate(c: FloatArray, s: FloatArray, f: FloatArray, d: FloatArray) -> None:
    inv_m, K_A2, moment, _, _, inv_I, ratio, l_B, _, wave, phase, F_c, g = c[:13]
    sa, ca, sb, cb, z = math.sin(s[3]), math.cos(s[3]), math.sin(s[4]), math.cos(s[4]), s[2]
    n0, n1 = sb, -cb * sa
    pull0, pull1 = K_A2 * (s[0] - z * n0), K_A2 * (s[1] - z * n1)
    Fx, Fy = f[0] + f[2] + pull0, f[1] + f[3] + pull1
    Fz = f[4] - (pull0 * n0 + pull1 * n1) + F_c * math.sin(wave * z + phase)
    Mx = l_B * (f[2] - f[0]) + moment * n0 - z * Fx
    My = l_B * (f[3] - f[1]) + moment * n1 - z * Fy
    Mz = -z * f[4]
    T1, T2 = -(ca * My + sa * Mz), cb * Mx - sb * (ca * Mz - sa * My)
    da, db = s[9], s[10]
    turn, omega = sb * da, cb * da
    lean = ratio * (turn + s[11]) - turn
    for i in range(6):
        d[i] = s[6 + i]
    d[6], d[7], d[8] = Fx * inv_m, Fy * inv_m - g, Fz * inv_m
    d[9], d[10] = (T1 * inv_I - db * (lean - turn)) / cb, T2 * inv_I + omega * lean
    d[11] = -omega * db - sb * d[9]


@njit
def step(c: FloatArray, v: FloatArray, s: FloatArray, f: FloatArray, work: FloatArray) -> None:
    """A Runge–Kutta step; forces follow their commands as exact lags."""
    k1, k2, k3, k4, mid, forces = work
    decay, h = c[13], c[14]
    half, whole = forces[:5], forces[5:10]
    for i in range(5):
        half[i] = v[i] + decay * (f[i] - v[i])
        whole[i] = v[i] + decay * (half[i] - v[i])
    rate(c, s, f, k1)
    for i in range(12):
        mid[i] = s[i] + h / 2 * k1[i]
    rate(c, mid, half, k2)
    for i in range(12):
        mid[i] = s[i] + h / 2 * k2[i]
    rate(c, mid, half, k3)
    for i in range(12):
        mid[i] = s[i] + h * k3[i]
    rate(c, mid, whole, k4)
    for i in range(12):
        s[i] += h / 6 * (k1[i] + 2 * (k2[i] + k3[i]) + k4[i])
    for i in range(5):
        f[i] = whole[i]


@njit
def measure(c: FloatArray, s: FloatArray, p: FloatArray) -> None:
    l_S = c[8]
    slope_x = math.tan(s[4]) / math.cos(s[3])
    slope_y = -math.tan(s[3])
    p[0], p[1] = s[0] - (l_S + s[2]) * slope_x, s[1] - (l_S + s[2]) * slope_y
    p[2], p[3], p[4] = s[0] + (l_S - s[2]) * slope_x, s[1] + (l_S - s[2]) * slope_y, s[2]


@parallel
def fly(
    machines: FloatArray,
    states: FloatArray,
    L: FloatArray,
    Cd: FloatArray,
    Ad: FloatArray,
    Bd: FloatArray,
    K: FloatArray,
    Ki: FloatArray,
    limit: FloatArray,
    Ts: float,
    substeps: int,
    grid: FloatArray,
    p_ref: FloatArray,
    xi_ref: FloatArray,
    v_ff: FloatArray,
    sigma: FloatArray,
    z_grid: FloatArray,
    largest: FloatArray,
    touched: FloatArray,
) -> None:
    for machine in numba.prange(len(machines)):
        c = machines[machine]
        s, f, xi = states[machine, :12], states[machine, 12:17], states[machine, 17:]
        y, e, free, v0, v, hat = np.empty(5), np.zeros(5), np.ones(5), np.empty(5), np.empty(5), np.empty(10)
        work, top = np.empty((6, 12)), len(grid) - 2
        for k in range(len(p_ref)):
            measure(c, s, y)
            if y[0] ** 2 + y[1] ** 2 >= c[15] or y[2] ** 2 + y[3] ** 2 >= c[15] or abs(y[4]) >= c[16]:
                touched[machine] = 1
            for j in range(5):
                largest[machine, j] = max(largest[machine, j], abs(y[j] - p_ref[k, j]))
                y[j] += sigma[j] * np.random.standard_normal()  # noqa: NPY002 - numba's own
                e[j] += Ts * free[j] * (p_ref[k, j] - y[j])
            if touched[machine]:
                break
            for i in range(10):
                hat[i] = xi[i]
            for j in range(5):
                innovation = y[j]
                for i in range(10):
                    innovation -= Cd[j, i] * xi[i]
                for i in range(10):
                    hat[i] += L[i, j] * innovation
            at = min(max(np.searchsorted(z_grid, y[4]) - 1, 0), top)
            for j in range(5):
                v0[j] = grid[at, 1 + j] + (y[4] - grid[at, 0]) * grid[at, 6 + j]
                wanted = v_ff[k, j] + v0[j]
                for i in range(10):
                    wanted += K[j, i] * (xi_ref[k, i] - hat[i])
                for i in range(5):
                    wanted += Ki[j, i] * e[i]
                v[j] = max(min(wanted, limit[j]), -limit[j])
                free[j] = 1.0 if v[j] == wanted else 0.0
            for i in range(10):
                xi[i] = 0.0
                for j in range(10):
                    xi[i] += Ad[i, j] * hat[j]
                for j in range(5):
                    xi[i] += Bd[i, j] * (v[j] - v0[j])
            for j in range(5):
                v[j] *= c[3] if j < 4 else c[4]
            for _ in range(substeps):
                step(c, v, s, f, work)


def many(work: Workload) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down."""
    given, c = stated(work), work.controller
    count = given.machines.shape[1]
    largest, touched = np.zeros((count, 5)), np.zeros(count)
    fly(
        np.ascontiguousarray(given.machines.T),
        np.ascontiguousarray(given.states.T),
        np.array(c.L),
        np.array(c.Cd),
        np.array(c.Ad),
        np.array(c.Bd),
        np.array(c.K),
        np.array(c.Ki),
        np.array(c.limits.force),
        c.sample_time,
        work.substeps,
        given.grid,
        np.array(work.p_ref),
        np.array(work.xi_ref),
        np.array(work.v_ff),
        work.sigma,
        np.ascontiguousarray(given.grid[:, 0]),
        largest,
        touched,
    )
    return largest, touched
