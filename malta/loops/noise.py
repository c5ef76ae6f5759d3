"""What the sensors' noise and steps leave at rest: covariances of linear loops."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.arguments import positive
from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.linear.matrices import covariance
from malta.loops.sampled_loops import SampledLoop
from malta.model.plant import Plant
from malta.roots import sign_change
from malta.synthesis.requirements import NoiseRms

if TYPE_CHECKING:
    from malta.loops.loop import Loop

MOST_DEVIATIONS = 40.0  # rms, beyond which no level is rare enough to be looked for
LEVEL_ACCURACY = 1e-9  # of a level, rms


class NoisePeaks(NamedTuple):
    """Sizes that noise at rest stays below, by output and by input.

    motion : p, of the true outputs, m or rad
    force : m, of the commands, N or N m

    >>> import malta
    >>> controller = malta.gains.read("design/gains/table2.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> malta.loops.noise_peaks(loop, seconds=1.0).motion.shape
    (5,)
    """

    motion: FloatArray
    force: FloatArray


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
    (out, force), _ = _variances(loop, V)
    return NoiseRms(np.sqrt(out), np.sqrt(force[:m]))


def _variances(
    loop: SampledLoop, V: FloatArray
) -> tuple[tuple[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]:
    """Variances of true outputs and of commands, and the covariances of each with its next sample."""
    c, n = loop.control, len(loop.Ad)
    noise = np.vstack([loop.Bd @ c.D_y, c.B_y])
    X = covariance(loop.closed, noise * V @ noise.T)
    moving = np.hstack([loop.outputs, np.zeros((len(loop.outputs), len(X) - n))])
    command = np.hstack([c.D_y @ loop.Cd, c.C])
    next_X, sent = loop.closed @ X, c.D_y * V

    def along(rows: FloatArray, table: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("ij,jk,ik->i", rows, table, rows))

    now = along(moving, X), along(command, X) + np.einsum("ij,ij->i", sent, c.D_y)
    later = along(moving, next_X), along(command, next_X) + np.einsum("ij,ij->i", command @ noise, sent)
    return now, later


def noise_peaks(loop: Loop, seconds: float = 3600.0, probability: float = 0.99) -> NoisePeaks:
    """Compute which sizes the motion and the commands of a machine at rest stay below for so long, as likely as asked.

        exp(-2 N p(a)) (1 - 2 Phi(-a / s)) = probability,       p(a) = 2 T(a / s, sqrt((1 - r) / (1 + r)))

    N samples, each of which rises above a with the chance p; T is Owen's function, s the rms and r the correlation with
    the next sample. Rises above a rare level come independently of each other (S. O. Rice, Bell Syst. Tech. J. 24,
    1945, for samples in place of a continuous signal). The sensors' noise is Gaussian, and their steps count as noise
    of q^2 / 12: a machine that rests within one step moves less. The loop is linear and at rest.

    loop : of a machine and a law that tracks nothing
    seconds : how long, s
    probability : that no sample is larger

    Returns NoisePeaks of the true outputs, SI, and of the commands, N or N m.

    Raises InputError for a time or a probability that is none, CheckError for an unstable loop.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> peaks = malta.loops.noise_peaks(loop, seconds=3600.0)
    >>> [f"{1e6 * a:.2f} um" for a in peaks.motion[:2]]
    ['0.74 um', '0.90 um']
    """
    positive("noise_peaks", "seconds", seconds)
    positive("noise_peaks", "probability", probability, below=1)
    if not loop.stable:
        raise CheckError("noise_peaks: the loop is unstable: its motion grows without an end")
    sampled = loop.sampled
    now, later = _variances(sampled, noise_variance(loop.plant))
    samples = max(seconds / loop.controller.sample_time, 1.0)
    peaks = [np.array([_peak(v, c, samples, probability) for v, c in zip(*both, strict=True)])
             for both in zip(now, later, strict=True)]  # fmt: skip
    return NoisePeaks(peaks[0], peaks[1][: len(loop.plant.inputs)])


def _peak(variance: float, following: float, samples: float, probability: float) -> float:
    """The level that a Gaussian sequence stays within over so many samples."""
    if variance <= 0:
        return 0.0
    from scipy.special import log_ndtr, owens_t  # which no report at rest needs

    r = min(max(following / variance, -1 + 1e-12), 1 - 1e-12)
    slope = math.sqrt((1 - r) / (1 + r))

    def surplus(a: float) -> float:
        inside = math.log(-math.expm1(log_ndtr(-a) + math.log(2)))
        return float(inside - 4 * samples * owens_t(a, slope) - math.log(probability))

    return math.sqrt(variance) * sign_change(surplus, LEVEL_ACCURACY, MOST_DEVIATIONS, LEVEL_ACCURACY)
