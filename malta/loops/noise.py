"""What the sensors' noise and steps leave at rest: covariances of linear loops."""

from __future__ import annotations

import numpy as np

from malta.arrays import FloatArray
from malta.loops.sampled_loops import SampledLoop
from malta.model.plant import Plant
from malta.synthesis.requirements import NoiseRms


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
    variance: FloatArray = np.array(plant.sensors.noise) ** 2 + np.array(plant.sensors.resolution) ** 2 / 12
    return variance


def noise_of(loop: SampledLoop, plant: Plant) -> NoiseRms:
    """Compute the rms of the true outputs and of the commanded forces from the sensors' noise and steps."""
    return _noise_from(loop, noise_variance(plant), len(plant.inputs))


def budget_of(loop: SampledLoop, plant: Plant) -> NoiseRms:
    """Compute which sensors the noise at rest comes from: shares of each variance, p x p of motion, m x p of force.

    A row without noise is zero.
    """
    V = noise_variance(plant)
    parts = [_noise_from(loop, V * alone, len(plant.inputs)) for alone in np.eye(len(V))]
    return NoiseRms(_shares([part.motion for part in parts]), _shares([part.force for part in parts]))


def _shares(sizes: list[FloatArray]) -> FloatArray:
    """The share of each part in the sum of squares, a column for each part."""
    squares = np.array(sizes).T ** 2
    whole = squares.sum(axis=1, keepdims=True)
    found: FloatArray = np.divide(squares, whole, out=np.zeros_like(squares), where=whole > 0)
    return found


def _noise_from(loop: SampledLoop, V: FloatArray, m: int) -> NoiseRms:
    """The noise at rest from sensors of these variances; of m forces, behind which a loop may hand on readings."""
    c = loop.control
    noise = np.vstack([loop.Bd @ c.D_y, c.B_y])
    X, n = covariance(loop.closed, noise * V @ noise.T), len(loop.Ad)
    command = np.hstack([c.D_y @ loop.Cd, c.C])
    out = np.diag(loop.outputs @ X[:n, :n] @ loop.outputs.T)
    force = np.diag(command @ X @ command.T + c.D_y * V @ c.D_y.T)[:m]
    return NoiseRms(np.sqrt(out), np.sqrt(force))
