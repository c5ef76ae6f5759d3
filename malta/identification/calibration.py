"""Calibration: what a log of the first day tells of sensors, coils and magnets, each figure with a 95 % interval.

Intervals come from batches: a record is cut into BATCHES stretches, whose figures vary as much as noise, drift and
correlation make them. Where a least-squares fit has several parameters, each stretch is left out in turn (jackknife,
linear in what it moves; MacKinnon and White, Journal of Econometrics 29(3), 1985). What is systematic, as a ring's
radius, is not in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import least_squares
from scipy.stats import t as student

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.model.equilibrium import trim
from malta.model.places import outputs_at
from malta.model.plant import Plant

if TYPE_CHECKING:
    from malta.identification.log import Log

BATCHES = 20
MIN_BATCH_SAMPLES = 10  # samples of a batch
GAP = np.pi / 2  # largest stretch of a ring without readings, rad
STEP = 1e-5  # m or rad: for the slope of the forces that hold a machine
TURN = 0.8  # of a period, that a run along a wave takes at least


class Interval95(NamedTuple):
    """A figure with its 95 % interval.

    value : SI
    half : half of the interval, SI
    unit : SI
    """

    value: float
    half: float
    unit: str = "1"

    def __str__(self) -> str:
        return f"{self.value:.5g} +- {self.half:.2g}{'' if self.unit == '1' else f' {self.unit}'}"


def at_rest(log: Log, group: str = "y", *, still: bool = False) -> dict[str, tuple[Interval95, Interval95]]:
    """The mean and the standard deviation of each signal of a log at rest.

    The deviation is that of successive readings, sigma^2 = mean of (y_k+1 - y_k)^2 / 2, so that a mover which still
    rolls is no noise (von Neumann, Annals of Mathematical Statistics 12(4), 1941). On the touchdown bearing without
    current they are offset and noise of position sensors, and offsets of current sensors.

    log : at rest
    group : of columns: "y", "i" or another
    still : whether nothing but noise moves the signals: the deviation is the plain one, with what is slow in it

    Raises InputError for a log without the group, CheckError for one that is too short or has missing samples.

    >>> import malta
    >>> from malta.identification.calibration import at_rest
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> still = malta.Scenario("still", 0.2, malta.references.hold, noise=1.0)
    >>> log = malta.identification.log_of(
    ...     malta.simulate(malta.plant_of(controller.parameters), controller, still)
    ... )
    >>> mean, deviation = at_rest(log)["z"]
    >>> abs(deviation.value - 15e-6) < 2 * deviation.half, deviation.unit
    (True, 'm')
    """
    if not log.names(group):
        raise InputError(log.source, group, "no such columns", "a log with them")
    found = {}
    for signal, values in zip(log.signals[group], log.columns[group].T, strict=True):
        parts = _batches(values, log.source)
        mean = Interval95(float(values.mean()), _half(parts.mean(axis=1)), signal.unit)
        variance = parts.var(axis=1, ddof=1) if still else (np.diff(parts, axis=1) ** 2).mean(axis=1) / 2
        deviation = float(np.sqrt(variance.mean()))
        spread = _half(variance) / max(2 * deviation, 1e-300)
        found[signal.name] = (mean, Interval95(deviation, spread, signal.unit))
    return found


def _batches(values: FloatArray, source: str) -> FloatArray:
    """The values in BATCHES rows. Raises CheckError for too few, and for missing ones."""
    each = len(values) // BATCHES
    if each < MIN_BATCH_SAMPLES:
        raise CheckError(
            f"{source}: {len(values)} samples, at least {BATCHES * MIN_BATCH_SAMPLES} are needed"
        )
    if not np.isfinite(values).all():
        raise CheckError(f"{source}: samples are missing")
    return np.asarray(values[: BATCHES * each].reshape(BATCHES, each))


def _half(parts: FloatArray) -> float:
    """Half of the 95 % interval of a mean from that of its batches."""
    return float(student.ppf(0.975, len(parts) - 1) * parts.std(ddof=1) / np.sqrt(len(parts)))


def fit_clustered(slopes: FloatArray, e: FloatArray) -> FloatArray:
    """Halves of the 95 % intervals of parameters fitted by least squares, with residuals e and their slopes in them."""
    size = np.linalg.norm(slopes, axis=0)
    parts = np.array_split(np.arange(len(e)), BATCHES)
    J = [slopes[k] / size for k in parts]
    whole = sum(one.T @ one for one in J)
    moved = [np.linalg.pinv(whole - one.T @ one) @ (one.T @ e[k]) for one, k in zip(J, parts, strict=True)]
    variance = (BATCHES - 1) / BATCHES * (np.array(moved) ** 2).sum(axis=0)
    return np.asarray(student.ppf(0.975, BATCHES - 1) * np.sqrt(variance) / size)


def _fit_ellipse(
    points: FloatArray, shape: Callable[[FloatArray], FloatArray], start: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Parameters of an ellipse o + M n, |n| = 1, and halves of their intervals: the first two are o, `shape` makes M.

    The radial deviation |M^-1 (y - o)| - 1 is minimized; noise that is small beside the ellipse does not bias it.
    """

    def off(theta: FloatArray) -> FloatArray:
        n = np.linalg.solve(shape(theta), (points - theta[:2]).T)
        return np.asarray(np.hypot(*n) - 1)

    found = least_squares(off, start, x_scale=np.maximum(np.abs(start), np.ptp(points) / 2), xtol=1e-14)
    return found.x, fit_clustered(np.asarray(found.jac), np.asarray(found.fun))


class RingCalibration(NamedTuple):
    """Errors of two sensors across each other, from a run along a ring: y = o + (1 + E) p, E symmetric.

    A turn of both sensors about the axis shows on no ring; so cross talk is its symmetric part.
    """

    gain_x: Interval95  # of E
    gain_y: Interval95
    cross: Interval95
    offset_x: Interval95
    offset_y: Interval95


def ring(log: Log, pair: Sequence[str], radius: float) -> RingCalibration:
    """Calibrate two sensors from a run in which the mover rolls along a ring of a known radius.

    log : of the run; the pace does not matter
    pair : names of the two outputs
    radius : of the mover's axis on the ring, m, with what its bearing gives way

    Raises InputError for unknown outputs, CheckError where the ring is not gone all around.
    """
    if len(pair) != 2 or not (np.isfinite(radius) and radius > 0):
        raise InputError("ring", "pair, radius", f"{list(pair)}, {radius:g} m", "two outputs, above 0 m")
    y = log.table("y", list(pair))
    y = y[np.isfinite(y).all(axis=1)]
    middle = (y.min(axis=0) + y.max(axis=0)) / 2
    angles = np.sort(np.arctan2(*(y - middle).T))
    gap = float(np.diff(np.concatenate([angles, angles[:1] + 2 * np.pi])).max())
    if gap > GAP:
        raise CheckError(f"{log.source}: the run leaves {np.degrees(gap):.0f} degrees of the ring out")
    size = np.ptp(y, axis=0) / 2 / radius
    start = np.array([*middle, *size, 0.0])

    def shape(theta: FloatArray) -> FloatArray:
        return radius * np.array([[theta[2], theta[4]], [theta[4], theta[3]]])

    theta, half = _fit_ellipse(y, shape, start)
    ends = zip(theta - [0, 0, 1, 1, 0], half, ("m", "m", "1", "1", "1"), strict=True)
    o_x, o_y, g_x, g_y, c = (Interval95(float(a), float(b), unit) for a, b, unit in ends)
    return RingCalibration(g_x, g_y, c, o_x, o_y)


class Quadrature(NamedTuple):
    """Errors of two signals a quarter of a period apart: c = c_0 + A cos t, s = s_0 + (1 + a) A sin(t + phi)."""

    amplitude: Interval95  # a
    phase: Interval95  # phi, rad
    offset_cosine: Interval95  # c_0 / A
    offset_sine: Interval95


def quadrature(cosine: FloatArray, sine: FloatArray) -> Quadrature:
    """Calibrate two signals in quadrature, as of Hall sensors, from a run over a period.

    After Heydemann, Applied Optics 20(19), 1981; the ellipse is fitted by its radial deviations.

    Raises CheckError where the run is shorter than a period.

    >>> import numpy as np
    >>> from malta.identification.calibration import quadrature
    >>> t, noise = (
    ...     np.linspace(0, 7, 2000),
    ...     np.random.default_rng(0).normal(0, 1e-3, (2, 2000)),
    ... )
    >>> found = quadrature(np.cos(t) + noise[0], 1.02 * np.sin(t + 0.01) + noise[1])
    >>> f"{found.amplitude.value:.3f} {found.phase.value:.3f}"
    '0.020 0.010'
    """
    points = np.column_stack([cosine, sine])
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    angles = np.unwrap(np.arctan2(*(points - middle).T[::-1]))
    if np.ptp(angles) < TURN * 2 * np.pi:
        raise CheckError(f"quadrature: the run covers {np.degrees(np.ptp(angles)):.0f} degrees of a period")

    def shape(theta: FloatArray) -> FloatArray:
        A, size, phi = theta[2], theta[3], theta[4]
        return np.array([[A, 0.0], [size * np.sin(phi), size * np.cos(phi)]])

    start = np.array([*middle, *(np.ptp(points, axis=0) / 2), 0.0])
    theta, half = _fit_ellipse(points, shape, start)
    A = float(theta[2])
    return Quadrature(
        Interval95(float(theta[3]) / A - 1, float(np.hypot(half[3], half[2] * theta[3] / A)) / A),
        Interval95(float(theta[4]), float(half[4]), "rad"),
        Interval95(float(theta[0]) / A, float(half[0]) / A),
        Interval95(float(theta[1]) / A, float(half[1]) / A),
    )


def slope(log: Log, current: tuple[str, str], output: str, *, free: bool = False) -> Interval95:
    """How an output follows a current or a command: its sign is the polarity of the coils.

    y = c + k u in each batch where the mover rests against something, as the ring along which a force turns; pulses or
    turns should come in each batch.

    log : with pulses
    current : group and name, as ("i", "i_dd1") or ("v", "fx_B1")
    output : name of the measured output
    free : whether the mover is free to accelerate there: k is that of y'' = k u, 1 / m of a force

    Raises InputError for unknown names, CheckError without pulses.
    """
    group, name = current
    u = _batches(log.table(group, [name])[:, 0], log.source)
    y = _batches(log.table("y", [output])[:, 0], log.source)
    if free:
        u = np.cumsum(np.cumsum(u, axis=1), axis=1) * log.sample_time**2
    shape = np.vander(np.linspace(-1, 1, u.shape[1]), 3 if free else 1)
    u, y = (values - (shape @ np.linalg.lstsq(shape, values.T, rcond=None)[0]).T for values in (u, y))
    power = (u**2).sum(axis=1)
    if not power.min() > 1e-3 * power.max():
        raise CheckError(f"{log.source}: {name} has no pulses throughout")
    parts = (u * y).sum(axis=1) / power
    above = f"{_unit(log, 'y', output)}/s^2" if free else _unit(log, "y", output)
    return Interval95(float(parts.mean()), _half(parts), f"{above}/{_unit(log, group, name)}")


def _unit(log: Log, group: str, name: str) -> str:
    return log.signals[group][log.names(group).index(name)].unit


class Centre(NamedTuple):
    """Where the magnets of a machine pull to no side, as its sensors read it, and how hard they pull beside it."""

    centre: dict[str, Interval95]  # by output, SI
    stiffness: Interval95  # over that of the machine in the gain file, with its force constants


def magnetic_centre(log: Log, plant: Plant) -> Centre:
    """Find the magnetic centre from a slow motion about the middle: v = v_0 + k B (y - e), k and e by least squares.

    v_0 holds the weight at the centre and B is the slope of the forces that hold the believed machine; thrust and
    stroke are left out. Accelerations of the motion are taken for small.

    log : of a slow motion in all outputs beside the stroke, as a circle of 1 Hz
    plant : the machine that the law believes

    Raises InputError for other signals, CheckError where the motion is too small to tell.
    """
    y = log.table("y", [s.name for s in plant.outputs])
    v = log.table("v", [s.name for s in plant.inputs])
    outputs = [k for k in range(y.shape[1]) if not plant.has_stroke or k != plant.stroke_output]
    inputs = [k for k in range(v.shape[1]) if not plant.has_stroke or k != plant.thrust_input]
    v_0, B = _holding_forces(plant)
    B = B[np.ix_(inputs, outputs)]
    y, v = (
        np.column_stack([_batches_of(c, 10) for c in table.T])
        for table in (y[:, outputs], v[:, inputs] - v_0[inputs])
    )
    along = y @ B.T
    rows = np.concatenate([along[:, :, None], np.broadcast_to(-B, (len(y), *B.shape))], axis=2)
    slopes = rows.reshape(-1, 1 + len(outputs))
    theta = np.linalg.lstsq(slopes, v.ravel(), rcond=None)[0]
    e = v.ravel() - slopes @ theta
    half = fit_clustered(slopes, e)
    k = float(theta[0])
    if not k > 5 * half[0]:
        raise CheckError(f"{log.source}: the motion is too small to tell where the magnets pull")
    centre = theta[1:] / k
    spread = np.hypot(half[1:] / k, centre * half[0] / k)
    names, units = [plant.outputs[j].name for j in outputs], [plant.outputs[j].unit for j in outputs]
    found = {
        n: Interval95(float(a), float(b), u) for n, a, b, u in zip(names, centre, spread, units, strict=True)
    }
    return Centre(found, Interval95(k, float(half[0])))


def _batches_of(values: FloatArray, each: int) -> FloatArray:
    """Means of so many samples."""
    whole = len(values) // each * each
    return np.asarray(values[:whole].reshape(-1, each).mean(axis=1))


def _holding_forces(plant: Plant) -> tuple[FloatArray, FloatArray]:
    """The forces that hold a machine at its centre, and their slope in the outputs, m x p."""
    names = [plant.states[k].name for k in plant.controlled]

    def forces(y: FloatArray) -> FloatArray:
        q = np.array(ca.DM(plant.position_of(ca.DM(y)))).ravel()
        at: dict[str, Any] = dict(zip(names, q.tolist(), strict=False))
        return np.asarray(trim(plant, **at).v, dtype=float)

    zero = outputs_at(plant, plant.at().x)
    steps = STEP * np.eye(len(zero))
    return forces(zero), np.column_stack([(forces(zero + h) - forces(zero - h)) / (2 * STEP) for h in steps])


def unstable_pole(log: Log, output: str) -> Interval95:
    """The pole of a free fall from rest, rad/s: y = a + b cosh(s t) + c sinh(s t), which is that of K / m.

    log : of a fall without current, from its begin until just before the touchdown
    output : that falls

    Raises InputError for an unknown output, CheckError where nothing falls.
    """
    y, t = log.table("y", [output])[:, 0], log.t - log.t[0]
    span = float(np.ptp(y))
    noise = float(np.diff(y).std())
    if len(y) < BATCHES or not span > 20 * noise:
        raise CheckError(f"{log.source}: {output} does not fall: it moves by {span:.3g} in {t[-1]:.3g} s")

    def curve(theta: FloatArray) -> FloatArray:
        return np.asarray(theta[1] + theta[2] * np.cosh(theta[0] * t) + theta[3] * np.sinh(theta[0] * t) - y)

    s = 3.0 / t[-1]
    start = np.array([s, y[0], (y[-1] - y[0]) / np.cosh(3.0), 0.0])
    found = least_squares(curve, start, x_scale=[s, span, span, span], xtol=1e-14)
    half = fit_clustered(np.asarray(found.jac), np.asarray(found.fun))
    return Interval95(float(found.x[0]), float(half[0]), "rad/s")


def wave(log: Log, plant: Plant, period: float) -> tuple[Interval95, Interval95]:
    """Amplitude and phase of a force along the stroke that the thrust holds: -f = A sin(2 pi z / period + phi).

    log : of a slow stroke over a period, as of the record of v0(z)
    plant : the machine
    period : m

    Raises InputError for a machine without a stroke, CheckError where the stroke is shorter than a period.
    """
    if not plant.has_stroke:
        raise InputError("wave", "machine", f"a {plant.name}, which has no stroke", "one with a stroke")
    z, f = log.table("y", [plant.stroke.name])[:, 0], log.table("v", [plant.stroke.thrust])[:, 0]
    if np.ptp(z) < TURN * period:
        raise CheckError(f"{log.source}: a stroke of {np.ptp(z):.3g} m, a period is {period:g} m")
    turn = 2 * np.pi * z / period
    rows = -np.column_stack([np.sin(turn), np.cos(turn), np.ones(len(z))])
    theta = np.linalg.lstsq(rows, f, rcond=None)[0]
    half = fit_clustered(rows, f - rows @ theta)
    size = float(np.hypot(theta[0], theta[1]))
    spread = float(np.hypot(theta[0] * half[0], theta[1] * half[1])) / size
    across = float(np.hypot(theta[1] * half[0], theta[0] * half[1])) / size**2
    return Interval95(size, spread, "N"), Interval95(float(np.arctan2(theta[1], theta[0])), across, "rad")
