"""The planar motor's current decoupling by hand in numpy: a bilinear table, a loop over the coils, numpy's pinv."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from malta.machines.planar.field import FieldTable
from malta.machines.planar.plant import Parameters

if TYPE_CHECKING:
    from malta.arrays import FloatArray

ODD = np.array([[1, 0, 0, 0, 1, 1], [0, 1, 0, 1, 0, 1]])  # F_x F_y F_z T_x T_y T_z, about x and about y


def coils(par: Parameters) -> FloatArray:
    """Arms of the sixteen coils, 16 x 3."""
    steps = (-1.5, -0.5, 0.5, 1.5)
    return np.array([[a * par.coil_pitch, b * par.coil_pitch, par.r_z] for a in steps for b in steps])


def currents(
    par: Parameters, table: FieldTable, arms: FloatArray, p: FloatArray, W: FloatArray
) -> FloatArray:
    """(25)-(29), (31)-(35): i = K(p)^+ W with the weights of (27) mended."""
    n = len(table.nodes) - 1
    decay = math.exp(-math.pi / table.tau_n * (p[2] - table.z))
    K = np.empty((6, 16))
    for k, arm in enumerate(arms):
        places, signs = [], np.ones(6)
        for axis in range(2):
            u = (p[axis] + arm[axis]) / table.tau_n * n % (2 * n)
            if u > n:
                u = 2 * n - u
                signs = signs * (1 - 2 * ODD[axis])
            places.append(u)
        i, j = (min(int(u), n - 1) for u in places)
        t, u = places[0] - i, places[1] - j
        f = table.nodes
        own = (1 - t) * (1 - u) * f[i, j] + t * (1 - u) * f[i + 1, j]
        own = (own + (1 - t) * u * f[i, j + 1] + t * u * f[i + 1, j + 1]) * signs * decay
        K[:3, k] = own[:3]
        K[3:, k] = own[3:] + np.cross(arm, own[:3])
    return np.asarray(np.linalg.pinv(K) @ W)
