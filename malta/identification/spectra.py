"""The spectra of a log over whole periods of its excitation: lines, the noise between them, and what is curved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.errors import CheckError
from malta.firmware.signals import place_of_readings
from malta.identification.log import Log, require_same_law
from malta.identification.prediction import (
    Noise,
    noise_between_lines,
    noise_covariances,
    without_spikes,
)
from malta.identification.response import ResponseModel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import ComplexArray, FloatArray, Plant

    IntArray = NDArray[np.integer[Any]]

SIGMA = 1.959963984540054  # half of a 95 % interval
NEIGHBOURS = 16  # bins between lines, nearest to a line, that tell the noise there
EXCITED = 1e-6  # of the largest line of an excitation: what is above is a line
FEWEST = 3  # periods
WINDOW = 3  # lines to either side whose bins are taken together
WIDER = 2  # times the highest line: up to there motion counts that curvature multiplies
REPAIRED = 1e-3  # of the currents that may be missing
FILLED = 0.2  # of the readings that may be missing
INDEPENDENT = 0.05  # smallest eigenvalue of the correlation of the excited inputs; 1 where none share a line
FEEDBACK = 1e-3  # of an excitation: commands that move by less beside it do not depend on readings


class Spectrum(NamedTuple):
    """Fourier coefficients of a log over whole periods, of bins 0 to half of the samples, with the lines."""

    outputs: ComplexArray
    currents: ComplexArray
    lines: IntArray  # bins that were excited
    axis: IntArray  # of each line, the input that it excites most
    turn: ComplexArray  # of each line, the excitation's phase as a number of size 1
    between: IntArray  # lines x NEIGHBOURS: the nearest bins with noise alone
    harmonics: IntArray  # multiples of 1 / period that were not excited, in the band of the lines
    rate: float  # rad/s of a bin
    periods: int  # of the excitation in the record: every so many bins is a harmonic
    source: str  # the log's
    weight: (
        FloatArray  # of each output: 1 over the size of its coefficients above the lines, where nothing moves
    )


def require_log(log: Log, machine: str, sample_time: float) -> None:
    """Raise CheckError for a log of another machine, of another sample time, or with sensors that failed."""
    require_same_law(log, machine, sample_time)
    for what in ("stuck", "clipped"):
        for sensor, count in getattr(log.survey, what).items():
            raise CheckError(f"{log.source}: sensor {sensor} is {what} in {count} of {log.samples} samples")


def whole_periods(log: Log, excitation: FloatArray, samples: int) -> tuple[int, int]:
    """How many samples at the end of a log are whole periods of its excitation, and how many periods.

    Raises CheckError for a log that was not excited, names no period, or is too short.
    """
    if not excitation.size or not np.abs(excitation).max(initial=0.0):
        raise CheckError(f"{log.source}: nothing was excited: its columns exc.* are missing or zero")
    if not log.period:
        raise CheckError(
            f"{log.source}: no period of the excitation is given: a line '# period 1.0 s' in a .csv"
        )
    each = round(log.period / log.sample_time)
    periods = samples // each
    if periods > FEWEST:
        periods -= 1  # the first one, in which the loop settles
    if periods < FEWEST:
        found = f"{samples * log.sample_time:.4g} s are {periods} periods of {log.period:g} s"
        raise CheckError(f"{log.source}: too short: {found}, at least {FEWEST} and one to settle are needed")
    return each * periods, periods


def excited_lines(log: Log, D: ComplexArray, periods: int) -> IntArray:
    """The bins that an excitation D has. Raises CheckError where they are no multiples of 1 / period."""
    size = np.abs(D[1:])
    lines = 1 + np.flatnonzero((size > EXCITED * size.max()).any(axis=1))
    if (lines % periods).any():
        raise CheckError(
            f"{log.source}: the excitation has not the period of {log.period:g} s that the log names"
        )
    return lines


def require_independent(log: Log, D: ComplexArray) -> None:
    """Raise CheckError for inputs that are not excited independently of each other, as with lines that collide.

    D : lines x inputs, Fourier coefficients of the excitation
    """
    size = np.linalg.norm(D, axis=0)
    used = np.flatnonzero(size > EXCITED * size.max())
    unit = D[:, used] / size[used]
    R = unit.conj().T @ unit
    least = float(np.linalg.eigvalsh(R)[0])
    if least < INDEPENDENT:
        between = np.abs(R - np.eye(len(used)))
        a, b = np.unravel_index(int(between.argmax()), between.shape)
        one, other = (log.names("excitation")[used[k]] for k in (a, b))
        raise CheckError(
            f"{log.source}: the excitation of the inputs is not independent: their lines collide, and {one} and "
            f"{other} are correlated by {between[a, b]:.3f}; the smallest eigenvalue is {least:.2g}, "
            f"at least {INDEPENDENT:g} is needed"
        )


def require_closed_loop(log: Log, pole: float) -> None:
    """Raise CheckError where commands do not depend on readings, and the machine's model is unstable: it lay on its
    touchdown bearings, or another law held it.

    pole : the largest real part of the model's poles, rad/s
    """
    if pole <= 0 or not log.names("v"):
        return
    sent = log.columns["excitation"]
    own = log.columns["v"] - sent
    moved, size = np.nanstd(own, axis=0), np.nanstd(sent, axis=0)
    share = moved[size > 0] / size[size > 0]
    if len(share) and share.max() < FEEDBACK:
        raise CheckError(
            f"{log.source}: an open loop: beside the excitation commands move by {share.max():.2g} of it, a law's move "
            f"by {FEEDBACK:g} at least, and the machine is unstable (pole at {pole:.4g} rad/s)"
        )


def noise_bins(lines: IntArray, periods: int, count: int) -> IntArray:
    """Of each line, the NEIGHBOURS nearest of `count` bins that are no multiples of 1 / period: noise alone."""
    top = min(count, int(lines[-1]) + 4 * periods)
    free = np.setdiff1d(np.arange(1, top), np.arange(0, top, periods))
    return np.asarray(free[np.argsort(np.abs(free - lines[:, None]), axis=1)[:, :NEIGHBOURS]])


def windowed_covariances(between: ComplexArray) -> tuple[ComplexArray, FloatArray]:
    """Covariances at the lines of what stands between them, lines x bins x p, and the number of bins behind each."""
    each = np.einsum("kma,kmb->kab", between, between.conj())
    sums = np.concatenate([np.zeros_like(each[:1]), each.cumsum(axis=0)])
    k = np.arange(len(each))
    first, last = np.maximum(k - WINDOW, 0), np.minimum(k + WINDOW + 1, len(each))
    counts = between.shape[1] * (last - first)
    return (sums[last] - sums[first]) / counts[:, None, None], counts.astype(float)


def spectrum_of(log: Log, y: FloatArray, i: FloatArray) -> Spectrum:
    """The spectra of the last whole periods of a log. Raises CheckError for a log that tells nothing."""
    excitation = whole(log, "excitation")
    N, periods = whole_periods(log, excitation, len(y))
    outputs, currents, D = (np.fft.rfft(table[len(y) - N :], axis=0) / N for table in (y, i, excitation))
    lines = excited_lines(log, D, periods)
    require_independent(log, D[lines])
    axis = np.abs(D[lines]).argmax(axis=1)  # the input that a line excites most
    pulse = D[lines, axis]
    harmonics = np.setdiff1d(np.arange(lines[0], lines[-1] + 1, periods), lines)
    rate = 2 * np.pi / (N * log.sample_time)
    quiet = np.median(np.abs(outputs[len(outputs) // 2 :]), axis=0)
    weight = 1 / np.maximum(quiet, 1e-300)
    return Spectrum(
        outputs,
        currents,
        lines,
        axis,
        pulse / np.abs(pulse),
        noise_bins(lines, periods, len(D)),
        harmonics,
        rate,
        periods,
        log.source,
        weight,
    )


def straightened(model: ResponseModel, s: Spectrum, theta: FloatArray) -> Spectrum:
    """The spectrum without what the machine's curvature adds at harmonics; see `ResponseModel.beyond_linear`.

    Products of two lines fall on other lines. Without this they were taken for the machine's linear response.
    """
    last = min(WIDER * int(s.lines[-1]) // s.periods, (len(s.outputs) - 1) // s.periods)
    places = s.periods * np.arange(last + 1)
    outputs = np.array(s.outputs)
    outputs[places] -= model.beyond_linear(theta, s.outputs[places], s.currents[places], s.rate * s.periods)
    return s._replace(outputs=outputs)


def in_axes(log: Log, plant: Plant) -> Log:
    """The log with the currents of the drive's axes, where it has those of all its phases; else the log as it is."""
    if plant.windings is None or log.names("i") != [s.name for s in plant.drive.phases]:
        return log
    y, i = ca.SX.sym("y", len(plant.outputs)), ca.SX.sym("i", len(plant.drive.phases))
    turned = ca.Function("axes", [y, i], [plant.drive.to_axes(place_of_readings(plant, y)) @ i])
    table = log.table("y", [s.name for s in plant.outputs])
    axes = np.array(turned.map(log.samples)(table.T, log.columns["i"].T)).T
    columns = {**log.columns, "i": axes}
    return replace(log, columns=columns, signals={**log.signals, "i": tuple(plant.drive.axes)})


def readings(log: Log, *, robust: bool) -> FloatArray:
    """The measured outputs at even times, NaN where one is missing, or sticks out where outliers are looked for."""
    y = _at_even_times(log, "y")
    missing = float(np.isnan(y).any(axis=1).mean())
    if missing > FILLED:
        raise CheckError(
            f"{log.source}: {100 * missing:.3g} % of the samples of y are missing, at most 20 % may be"
        )
    return without_spikes(y) if robust else y


def _at_even_times(log: Log, group: str) -> FloatArray:
    """The columns of a group, a row for each sample time; NaN where the log has none."""
    table = log.columns.get(group, np.zeros((log.samples, 0)))
    k = np.round((log.t - log.t[0]) / log.sample_time).astype(int)
    if k[-1] == log.samples - 1:
        return table
    if k[-1] > (1 + FILLED) * log.samples:
        raise CheckError(f"{log.source}: {k[-1] + 1 - log.samples} samples are missing in its gaps")
    whole = np.full((k[-1] + 1, table.shape[1]), np.nan)
    whole[k] = table
    return whole


def between_neighbours(table: FloatArray) -> FloatArray:
    """A table with missing entries on lines between their neighbours."""
    if np.isfinite(table).all():
        return table
    t = np.arange(len(table))
    return np.column_stack([np.interp(t, t[np.isfinite(c)], c[np.isfinite(c)]) for c in table.T])


def whole(log: Log, group: str) -> FloatArray:
    """The columns of a group with missing samples between their neighbours. Raises CheckError for many of them."""
    table = _at_even_times(log, group)
    missing = float(np.isnan(table).any(axis=1).mean())
    if missing > REPAIRED:
        raise CheckError(
            f"{log.source}: {100 * missing:.3g} % of the samples of {group} are missing, at most 0.1 % may be"
        )
    return between_neighbours(table)


class Residuals(NamedTuple):
    """e = Y - G I - T c at some bins, with the c of least squares at lines and between them: bins x p each."""

    lines: ComplexArray
    between: ComplexArray  # lines x NEIGHBOURS x p
    harmonics: ComplexArray  # those that were asked for


def residuals_of(
    model: ResponseModel, s: Spectrum, theta: FloatArray, harmonics: Sequence[int] | IntArray = ()
) -> Residuals:
    """The residuals of parameters theta; `harmonics` are bins beside the lines and those between them.

    What noise leaves in the states from the begin of the record to its end acts at all bins alike. It is fitted and
    taken off, as it would correlate the residuals of all lines.
    """
    kinds = (s.lines, s.between.ravel(), np.asarray(harmonics, dtype=int))
    bins = np.concatenate(kinds)
    G, T = model.responses(theta, s.rate * bins)
    e = s.outputs[bins] - np.einsum("kpm,km->kp", G, s.currents[bins])
    fitted = len(bins) - len(harmonics)
    rows = (T[:fitted] * s.weight[:, None]).reshape(-1, T.shape[2])
    size = np.linalg.norm(rows, axis=0)
    rows = rows / np.where(size > 0, size, 1.0)
    right = (e[:fitted] * s.weight).ravel()
    normal, moments = (rows.conj().T @ rows).real, (rows.conj().T @ right).real
    c = np.linalg.lstsq(normal, moments, rcond=1e-12)[0] / np.where(size > 0, size, 1.0)
    e = e - T @ c
    lines, between, others = np.split(e, np.cumsum([len(kind) for kind in kinds])[:2])
    return Residuals(lines, between.reshape(*s.between.shape, -1), others)


def noise_of(model: ResponseModel, s: Spectrum, theta: FloatArray, between: ComplexArray) -> Noise:
    """The noise of sensors and process by the residuals between the lines, see `Residuals`."""
    bins, places = np.unique(s.between.ravel(), return_index=True)
    e = between.reshape(-1, between.shape[2])[places]
    samples = round(2 * np.pi / (s.rate * model.sample_time))
    return noise_between_lines(model, theta, s.rate * bins, e, samples)


def weights_of(model: ResponseModel, s: Spectrum, theta: FloatArray) -> ComplexArray:
    """W at each line, so that W e has unit variance in every entry: the residuals between the lines are noise.

    The inverse of a covariance that is estimated from n bins is too large by n / (n - p). Noise that peaks within a few
    lines, as at a resonance of held currents, is divided by the shape of sensors' and process noise first.
    """
    e = residuals_of(model, s, theta).between
    shape: ComplexArray = np.tile(np.eye(e.shape[2], dtype=complex), (len(s.lines), 1, 1))
    if model.plant.second_order and model.plant.sensors is None:
        noise = noise_of(model, s, theta, e)
        at = np.column_stack([s.lines, s.between])  # lines x (1 + NEIGHBOURS)
        factors = np.linalg.cholesky(noise_covariances(model, theta, noise, s.rate * at.ravel()))
        shapes = np.linalg.inv(factors).reshape(*at.shape, *factors.shape[1:])
        shape, e = shapes[:, 0], (shapes[:, 1:] @ e[..., None])[..., 0]
    C, counts = windowed_covariances(e)
    p = C.shape[1]
    return np.asarray(
        np.linalg.inv(np.linalg.cholesky(C)) @ shape * np.sqrt((counts - p) / counts)[:, None, None]
    )


def white_residuals(model: ResponseModel, s: Spectrum, theta: FloatArray, W: ComplexArray) -> ComplexArray:
    """Residuals at the lines in standard deviations, lines x p; squares sum up to chi2 with twice as many entries."""
    return np.asarray(np.einsum("kab,kb->ka", W, residuals_of(model, s, theta).lines))


def distortion_of(model: ResponseModel, s: Spectrum, theta: FloatArray) -> float:
    """The mean power of e at harmonics that were not excited, over that of the noise; NaN where there are none."""
    if not len(s.harmonics):
        return float("nan")
    e = residuals_of(model, s, theta, s.harmonics)
    C, _ = windowed_covariances(e.between)
    nearest = np.abs(s.lines - s.harmonics[:, None]).argmin(axis=1)
    solved = np.linalg.solve(C[nearest], e.harmonics[..., None])[..., 0]
    return float((e.harmonics.conj() * solved).real.sum() / e.harmonics.size)


def whiteness_of(parts: Sequence[ComplexArray], spectra: Sequence[Spectrum]) -> float:
    """The correlation of neighbouring lines of one axis, over its standard deviation where they are independent."""
    total, count = 0.0, 0
    for white, s in zip(parts, spectra, strict=True):
        for axis in np.unique(s.axis):
            own = white[s.axis == axis] / s.turn[s.axis == axis][:, None]
            total += float((own[1:].conj() * own[:-1]).real.sum())
            count += own[1:].size
    return total / float(np.sqrt(max(count, 1) / 2))
