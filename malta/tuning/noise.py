"""What the sensors' noise and steps leave at rest: covariances of linear loops."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from malta.synthesis.requirements import Noise

if TYPE_CHECKING:
    from malta.margins.loops import Loop
    from malta.model.plant import FloatArray, Plant


def covariance(A: FloatArray, W: FloatArray) -> FloatArray:
    """Solve X = A X A' + W by doubling, for a stable A (n x n); slow poles next to 1 take some thirty steps."""
    X, A = W, A.copy()
    for _ in range(60):
        more = A @ X @ A.T
        X, A = X + more, A @ A
        if np.abs(np.diag(more)).max() <= 1e-12 * np.abs(np.diag(X)).max():
            break
    return X


def noise_variance(plant: Plant) -> FloatArray:
    """Return the variance of one measurement of each output: the sensors' noise, and q^2 / 12 of their steps."""
    variance: FloatArray = np.array(plant.noise) ** 2 + np.array(plant.resolution) ** 2 / 12
    return variance


def noise_of(loop: Loop, plant: Plant) -> Noise:
    """Compute the rms of the true outputs and of the commanded forces from the sensors' noise and steps."""
    c, V = loop.control, noise_variance(plant)
    noise = np.vstack([loop.Bd @ c.D_y, c.B_y])
    X, n = covariance(loop.closed, noise * V @ noise.T), len(loop.Ad)
    command = np.hstack([c.D_y @ loop.Cd, c.C])
    out = np.diag(loop.outputs @ X[:n, :n] @ loop.outputs.T)
    return Noise(np.sqrt(out), np.sqrt(np.diag(command @ X @ command.T + c.D_y * V @ c.D_y.T)))
