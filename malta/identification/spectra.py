"""The spectra of a log over whole periods of its excitation: lines, the noise between them, and what is curved.

What logs tell at the lines of their excitation: columns of the response from excitation to readings.

A line that excites one input gives one column of G there. Where other logs excite the other inputs at the same line,
as many logs as inputs give G without a model. Else a column is interpolated between its own lines, as its difference
to the prediction; what that may miss is taken from how well its own lines are interpolated from their neighbours.

Which parameter that was taken as known explains what a model leaves of a log.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from malta.errors import CheckError
from malta.firmware.signals import place_of_readings
from malta.identification.folding import FoldedSpectrum, fold
from malta.identification.log import Log, in_order, require_same_law
from malta.identification.prediction import NoiseModel, noise_between_lines, noise_covariances, without_spikes
from malta.identification.readers.stored import EvenTimes, StoredTable, store_rows
from malta.identification.response import STEP, ResponseModel, acting_parameters
from malta.identification.survey import READ, blocks_of, faults_of
from malta.model.parameters import twins_of

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.loops.loop import Loop
    from malta.model.plant import Plant

    IntArray = NDArray[np.integer[Any]]

SIGMA = 1.959963984540054  # half of a 95 % interval
TAIL_ROWS = 200_000  # at the end of a long log, that tell what is excited, and whether the loop is closed
PERIOD_ERROR = 1e-4  # of its largest value, by which an excitation may differ from period to period
NEIGHBOURS = 16  # bins between lines, nearest to a line, that tell the noise there
MIN_LINE_SHARE = 1e-6  # of the largest line of an excitation: what is above is a line
MIN_PERIODS = 3  # periods
WINDOW = 3  # lines to either side whose bins are taken together
MOTION_BAND_FACTOR = 2  # times the highest line: up to there motion counts that curvature multiplies
MAX_MISSING_CURRENTS = 1e-3  # of the currents that may be missing
MAX_MISSING_READINGS = 0.2  # of the readings that may be missing
MIN_CORRELATION_EIGENVALUE = 0.05  # of the excited inputs; 1 where none share a line
FEEDBACK = 1e-3  # of an excitation: commands that move by less beside it do not depend on readings


class Spectrum(NamedTuple):
    """Fourier coefficients of a log over whole periods, of bins 0 to half of the samples, with the lines."""

    outputs: ComplexArray  # of a long record a FoldedSpectrum, which is read by bins too
    currents: ComplexArray
    lines: IntArray  # bins that were excited
    axis: IntArray  # of each line, the input that it excites most
    turn: ComplexArray  # of each line, the excitation's phase as a number of size 1
    between: IntArray  # lines x NEIGHBOURS: the nearest bins with noise alone
    harmonics: IntArray  # multiples of 1 / period that were not excited, in the band of the lines
    rate: float  # rad/s of a bin
    periods: int  # of the excitation in the record: every so many bins is a harmonic
    source: str  # the log's
    weight: FloatArray  # of each output: 1 over the size of its coefficients above the lines


def require_log(log: Log, machine: str, sample_time: float) -> None:
    """Raise CheckError for a log of another machine, of another sample time, or with sensors that failed."""
    require_same_law(log, machine, sample_time)
    for sensor, words in faults_of(log).items():
        raise CheckError(f"{log.source}: sensor {sensor} {words}")


def whole_periods(log: Log, excitation: FloatArray, samples: int) -> tuple[int, int]:
    """How many samples at the end of a log are whole periods of its excitation, and how many periods.

    Raises CheckError for a log that was not excited, names no period, or is too short.
    """
    if not excitation.size or not np.abs(excitation).max(initial=0.0):
        raise CheckError(f"{log.source}: nothing was excited: its columns exc.* are missing or zero")
    if not log.period:
        raise CheckError(
            f"{log.source}: the excitation does not repeat itself: whole periods are needed, or a line "
            "'# period 1.0 s' in a .csv"
        )
    each = round(log.period / log.sample_time)
    if each < 2:
        raise CheckError(f"{log.source}: a period of {log.period:g} s is shorter than two samples")
    periods = samples // each
    if periods > MIN_PERIODS:
        periods -= 1  # the first one, in which the loop settles
    if periods < MIN_PERIODS:
        found = f"{samples * log.sample_time:.4g} s are {periods} periods of {log.period:g} s"
        raise CheckError(
            f"{log.source}: too short: {found}, at least {MIN_PERIODS} and one to settle are needed"
        )
    return each * periods, periods


def excited_lines(log: Log, D: ComplexArray, periods: int) -> IntArray:
    """The bins that an excitation D has. Raises CheckError where they are no multiples of 1 / period."""
    size = np.abs(D[1:])
    lines = 1 + np.flatnonzero((size > MIN_LINE_SHARE * size.max()).any(axis=1))
    if (lines % periods).any():
        raise _wrong_period(log)
    return lines


def _wrong_period(log: Log) -> CheckError:
    return CheckError(
        f"{log.source}: the excitation has not the period of {log.period:g} s that the log names"
    )


def require_independent(log: Log, D: ComplexArray) -> None:
    """Raise CheckError for inputs that are not excited independently of each other, as with lines that collide.

    D : lines x inputs, Fourier coefficients of the excitation
    """
    size = np.linalg.norm(D, axis=0)
    used = np.flatnonzero(size > MIN_LINE_SHARE * size.max())
    unit = D[:, used] / size[used]
    R = unit.conj().T @ unit
    least = float(np.linalg.eigvalsh(R)[0])
    if least < MIN_CORRELATION_EIGENVALUE:
        between = np.abs(R - np.eye(len(used)))
        a, b = np.unravel_index(int(between.argmax()), between.shape)
        one, other = (log.names("excitation")[used[k]] for k in (a, b))
        raise CheckError(
            f"{log.source}: the excitation of the inputs is not independent: their lines collide, and {one} and "
            f"{other} are correlated by {between[a, b]:.3f}; the smallest eigenvalue is {least:.2g}, "
            f"at least {MIN_CORRELATION_EIGENVALUE:g} is needed"
        )


def require_closed_loop(log: Log, pole: float) -> None:
    """Raise CheckError where commands do not depend on readings, and the machine's model is unstable: it lay on its
    touchdown bearings, or another law held it.

    pole : the largest real part of the model's poles, rad/s
    """
    if pole <= 0 or not log.names("v"):
        return
    v, sent = (np.asarray(log.columns[group][-TAIL_ROWS:]) for group in ("v", "excitation"))
    there = np.isfinite(v).any(axis=0)
    sent, own = sent[:, there], v[:, there] - sent[:, there]
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
    away = np.arange(-3 * NEIGHBOURS, 3 * NEIGHBOURS + 1)
    near = lines[:, None] + away
    free = (near > 0) & (near < top) & (near % periods != 0)
    order = np.argsort(np.where(free, np.abs(away), top), axis=1, kind="stable")[:, :NEIGHBOURS]
    return np.asarray(np.take_along_axis(near, order, axis=1))


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
    N, periods = whole_periods(log, last_excitation(log), len(y))
    excitation = whole(log, "excitation")
    if isinstance(excitation, StoredTable):
        sent = fold_excitation(log, excitation, N, periods)
        at = excited_lines(log, sent, 1)
        lines, sent = periods * at, sent[at]
        both = fold([y, i], N, periods, MOTION_BAND_FACTOR * int(at[-1]) + 5)
        of_readings, of_currents = both.columns(0, y.shape[1]), both.columns(y.shape[1], both.shape[1])
        outputs, currents = cast("ComplexArray", of_readings), cast("ComplexArray", of_currents)
        quiet = of_readings.quiet
    else:
        outputs, currents, D = (np.fft.rfft(table[len(y) - N :], axis=0) / N for table in (y, i, excitation))
        lines = excited_lines(log, D, periods)
        sent = D[lines]
        quiet = np.median(np.abs(outputs[len(outputs) // 2 :]), axis=0)
    require_independent(log, sent)
    axis = np.abs(sent).argmax(axis=1)  # the input that a line excites most
    pulse = sent[np.arange(len(lines)), axis]
    harmonics = np.setdiff1d(np.arange(lines[0], lines[-1] + 1, periods), lines)
    rate = 2 * np.pi / (N * log.sample_time)
    weight = 1 / np.maximum(quiet, 1e-300)
    return Spectrum(
        outputs,
        currents,
        lines,
        axis,
        pulse / np.abs(pulse),
        noise_bins(lines, periods, N // 2 + 1),
        harmonics,
        rate,
        periods,
        log.source,
        weight,
    )


def straighten(model: ResponseModel, s: Spectrum, theta: FloatArray) -> Spectrum:
    """The spectrum without what the machine's curvature adds at harmonics; see `ResponseModel.beyond_linear`.

    Products of two lines fall on other lines. Without this they were taken for the machine's linear response.
    """
    last = min(MOTION_BAND_FACTOR * int(s.lines[-1]) // s.periods, (len(s.outputs) - 1) // s.periods)
    places = s.periods * np.arange(last + 1)
    curved = model.beyond_linear(theta, s.outputs[places], s.currents[places], s.rate * s.periods)
    if isinstance(s.outputs, FoldedSpectrum):
        return s._replace(outputs=cast("ComplexArray", s.outputs.minus(places, curved)))
    outputs = np.array(s.outputs)
    outputs[places] -= curved
    return s._replace(outputs=outputs)


def last_excitation(log: Log) -> FloatArray:
    """The excitation at the end of a log: all of it where that is in memory."""
    table = log.columns.get("excitation", np.zeros((0, 0)))
    return np.asarray(table[-TAIL_ROWS:] if isinstance(table, StoredTable) else np.nan_to_num(table))


def fold_excitation(log: Log, table: StoredTable, N: int, periods: int) -> ComplexArray:
    """The coefficients of a long excitation at multiples of 1 / period.

    Raises CheckError for one that does not repeat itself with its period.
    """
    n, begin = N // periods, len(table) - N
    mean: FloatArray = np.zeros((n, table.shape[1]))
    for p in range(periods):
        mean = mean + table.rows(begin + p * n, begin + (p + 1) * n) / periods
    ends = (table.rows(begin, begin + n), table.rows(len(table) - n, len(table)))
    if max(float(np.abs(one - mean).max()) for one in ends) > PERIOD_ERROR * float(np.abs(mean).max()):
        raise _wrong_period(log)
    return np.asarray(np.fft.rfft(mean, axis=0) / n)


def in_axes(log: Log, plant: Plant) -> Log:
    """The log in the machine's order, with currents of the drive's axes where it has those of all phases."""
    log = in_order(log, plant)
    if plant.actuator.windings is None or log.names("i") != [s.name for s in plant.drive.phases]:
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
    missing = missing_shares(log, "y", y)
    if missing.size and missing.max() > MAX_MISSING_READINGS:
        name, share = log.names("y")[int(missing.argmax())], 100 * float(missing.max())
        raise CheckError(
            f"{log.source}: {share:.3g} % of the readings of {name} are missing, at most 20 % may be"
        )
    return without_spikes(np.asarray(y)) if robust else y


def missing_shares(log: Log, group: str, table: FloatArray) -> FloatArray:
    """The share of each column's values that is missing."""
    if not isinstance(table, StoredTable):
        return np.asarray(np.isnan(table).mean(axis=0))
    known = log.sensor_survey.missing if group in READ else {}
    return np.array([known.get(name, 0) / log.samples for name in log.names(group)])


def _at_even_times(log: Log, group: str) -> FloatArray:
    """The columns of a group, a row for each sample time; NaN where the log has none."""
    table = log.columns.get(group, np.zeros((log.samples, 0)))
    if isinstance(log.t, EvenTimes):
        return table
    k = np.round((log.t - log.t[0]) / log.sample_time).astype(int)
    if k[-1] == log.samples - 1:
        return table
    if k[-1] > (1 + MAX_MISSING_READINGS) * log.samples:
        raise CheckError(f"{log.source}: {k[-1] + 1 - log.samples} samples are missing in its gaps")
    whole = np.full((k[-1] + 1, table.shape[1]), np.nan)
    whole[k] = table
    return whole


def between_neighbours(table: FloatArray) -> FloatArray:
    """A table with missing entries on lines between their neighbours."""
    if isinstance(table, StoredTable):
        return fill_stored(table)
    if np.isfinite(table).all():
        return table
    t = np.arange(len(table))
    return np.column_stack([np.interp(t, t[np.isfinite(c)], c[np.isfinite(c)]) for c in table.T])


def fill_stored(table: StoredTable) -> FloatArray:
    """A long table with missing entries between their neighbours: itself where none are missing."""
    if all(np.isfinite(block).all() for block in blocks_of(table)):
        return cast("FloatArray", table)

    def blocks() -> Iterator[FloatArray]:
        before: FloatArray = np.zeros((0, table.shape[1]))
        part: FloatArray = before
        for block in blocks_of(table):
            part = np.concatenate([part, block])
            if np.isfinite(part[-1]).all():  # what is missing has a neighbour on either side
                filled = between_neighbours(np.concatenate([before, part]))[len(before) :]
                yield filled
                before, part = filled[-1:], part[:0]
        if len(part):
            yield between_neighbours(np.concatenate([before, part]))[len(before) :]

    return cast("FloatArray", store_rows(blocks(), table.shape[1], table.path))


def whole(log: Log, group: str) -> FloatArray:
    """The columns of a group with missing samples between their neighbours. Raises CheckError for many of them."""
    table = _at_even_times(log, group)
    missing = missing_shares(log, group, table)
    if missing.size and missing.max() > MAX_MISSING_CURRENTS:
        name, share = log.names(group)[int(missing.argmax())], 100 * float(missing.max())
        raise CheckError(
            f"{log.source}: {share:.3g} % of the values of {name} are missing, at most 0.1 % may be"
        )
    return between_neighbours(table) if missing.any() or not isinstance(table, StoredTable) else table


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


def noise_of(model: ResponseModel, s: Spectrum, theta: FloatArray, between: ComplexArray) -> NoiseModel:
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
    if model.plant.second_order and not model.plant.sensors.late:
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


MIN_LINE_POWER = 4.0  # over the noise, of the output that moves most; less is no excitation
MAX_MISSING_SAMPLES = 1e-3  # of the samples that may be missing


class SpectralLine(NamedTuple):
    """A line of a log: Fourier coefficients, and the covariance of that of y, p x p."""

    w: float
    d: ComplexArray
    y: ComplexArray
    v: ComplexArray  # empty: no commands in the log
    covariance: ComplexArray


def lines_of(log: Log, loop: Loop) -> list[SpectralLine]:
    """The lines of the last whole periods of a log. Raises CheckError for a log that tells nothing."""
    plant = loop.plant
    require_log(log, plant.name, loop.sample_time)
    log = in_order(log, plant)
    commands = (
        log.table("v", [s.name for s in plant.inputs]) if log.names("v") else np.zeros((log.samples, 0))
    )
    sent, y = (
        log.table(g, [s.name for s in of]) for g, of in (("excitation", plant.inputs), ("y", plant.outputs))
    )
    w, D, (Y, V), C = coefficients_of(log, sent, [y, commands])
    parts = zip(w.tolist(), D, Y, V, C[:, : y.shape[1], : y.shape[1]], strict=True)
    return [SpectralLine(*one) for one in parts]


def coefficients_of(
    log: Log, sent: FloatArray, tables: Sequence[FloatArray]
) -> tuple[FloatArray, ComplexArray, list[ComplexArray], ComplexArray]:
    """Lines of the last whole periods of a log, rad/s; coefficients there of its excitation and of tables, readings
    first; and the covariance of these by noise, all columns together. Raises CheckError for a log that tells nothing.
    """
    N, periods = whole_periods(log, last_excitation(log), log.samples)
    Z: Any
    if isinstance(sent, StoredTable):
        D = fold_excitation(log, sent, N, periods)
        at = excited_lines(log, D, 1)
        Z = fold([_fill(table, log) for table in tables], N, periods, int(at[-1]) + 5)
        lines, D = periods * at, D[at]
    else:
        D, *parts = (np.fft.rfft(_fill(table, log)[-N:], axis=0) / N for table in (sent, *tables))
        Z, lines = np.hstack(parts), excited_lines(log, D, periods)
        D = D[lines]
    C = _noise(Z, lines, periods)
    p = tables[0].shape[1]
    power = (np.abs(Z[lines][:, :p]) ** 2 / np.einsum("kpp->kp", C[:, :p, :p]).real.clip(1e-300)).max(axis=1)
    if np.median(power) < MIN_LINE_POWER:
        raise CheckError(f"{log.source}: the excitation does not rise above the noise at half of the lines")
    w = 2 * np.pi / (N * log.sample_time) * lines
    return w, D, np.split(Z[lines], np.cumsum([table.shape[1] for table in tables])[:-1], axis=1), C


def _fill(table: FloatArray, log: Log) -> FloatArray:
    """A table with missing samples between their neighbours. Raises CheckError for more than a few of them."""
    gaps = log.sensor_survey.gaps
    missing = int(sum((~np.isfinite(block)).any(axis=1).sum() for block in blocks_of(table))) + gaps
    if missing > MAX_MISSING_SAMPLES * log.samples or gaps:
        raise CheckError(f"{log.source}: {missing} samples are missing, at most 0.1 % may be, and no gaps")
    return between_neighbours(table)


def _noise(Y: ComplexArray, lines: Any, periods: int) -> ComplexArray:
    """Covariances of y at the lines: of the bins between multiples of 1 / period, nearest to a line.

    Where multiples that were not excited have more power than these bins, as by steps of a sensor or a machine that
    is not linear, the covariance is so many times as large (total variance; Pintelon and Schoukens, ch. 4).
    """
    C, _ = windowed_covariances(Y[noise_bins(lines, periods, len(Y))])
    others = np.setdiff1d(np.arange(lines[0], lines[-1], periods), lines)
    if len(others):
        near = np.abs(lines - others[:, None]).argmin(axis=1)
        quiet = np.einsum("kpp->kp", C[near]).real.clip(1e-300)  # 0 of commands without feedback
        ratio = (np.abs(Y[others]) ** 2 / quiet).mean(axis=0)
        grown = np.sqrt(np.maximum(ratio, 1.0))
        C = C * np.outer(grown, grown)
    return np.asarray(C)


class ResponseColumns(NamedTuple):
    """G at k frequencies, k x p x m, and the covariance of each column, k x m x p x p."""

    G: ComplexArray
    covariance: ComplexArray


def columns_of(lines: Sequence[SpectralLine], w: FloatArray, predicted: ComplexArray) -> ResponseColumns:
    """G at all lines: measured where it is, else interpolated as a difference to the prediction."""
    k, p, m = predicted.shape
    off = np.zeros((k, m, p), dtype=complex)
    C = np.zeros((k, m, p, p), dtype=complex)
    known = np.zeros((k, m), dtype=bool)
    for at, value in enumerate(w):
        here = [line for line in lines if line.w == value]
        D = np.array([line.d for line in here]).T  # m x experiments
        used = np.flatnonzero((np.abs(D) > MIN_LINE_SHARE * np.abs(D).max()).any(axis=1))
        if np.linalg.matrix_rank(D[used], tol=MIN_LINE_SHARE * np.abs(D).max()) < len(used):
            found = f"{value / (2 * np.pi):.4g} Hz excites {len(used)} inputs in {len(here)} logs"
            raise CheckError(f"measure: the line at {found}: one input a line, or a log for each input")
        inverse = np.linalg.pinv(D[used])  # experiments x inputs
        off[at, used] = (np.array([line.y for line in here]).T @ inverse).T - predicted[at][:, used].T
        weights = np.abs(inverse.T) ** 2
        C[at, used] = np.einsum("je,epq->jpq", weights, np.array([line.covariance for line in here]))
        known[at, used] = True
    for j in range(m):
        if known[:, j].sum() < 2:
            raise CheckError("measure: an input is excited at fewer than two lines")
        scale = predicted[:, :, j][:, np.abs(predicted[:, :, j]).mean(axis=0).argmax()]
        interpolate_columns(np.log(w), known[:, j], scale, off[:, j], C[:, j])
    return ResponseColumns(predicted + off.transpose(0, 2, 1), C)


def interpolate_columns(
    x: FloatArray, known: Any, scale: ComplexArray, off: ComplexArray, C: ComplexArray
) -> None:
    """Fill the rows of `off` (k x p) that are not known, and what that may miss into the covariances C, k x p x p.

    Between its lines a column's difference over `scale` is linear in x. A line that is interpolated from its two
    neighbours misses e; at a share t between lines at half of that distance it is t (1 - t) e, for a curve of second
    order. Below the first and above the last line the difference stays, and may be off by its slope.
    """
    own, lost = np.flatnonzero(known), np.flatnonzero(~known)
    if not len(lost):
        return
    r, at = off[own] / scale[own, None], x[own]
    missed = np.zeros_like(r)
    if len(own) > 2:
        share = ((at[1:-1] - at[:-2]) / (at[2:] - at[:-2]))[:, None]
        missed[1:-1] = r[1:-1] - (1 - share) * r[:-2] - share * r[2:]
        missed[0], missed[-1] = missed[1], missed[-2]
    right = np.clip(np.searchsorted(at, x[lost]), 1, len(own) - 1)
    t = ((x[lost] - at[right - 1]) / (at[right] - at[right - 1]))[:, None]
    inside = np.clip(t, 0.0, 1.0)
    slope = r[right] - r[right - 1]
    larger = np.maximum(np.abs(missed[right]), np.abs(missed[right - 1]))
    error = (inside * (1 - inside) * larger + np.abs(t - inside) * np.abs(slope)) * np.abs(scale[lost, None])
    off[lost] = scale[lost, None] * (r[right - 1] + inside * slope)
    left, there = own[right - 1], own[right]
    ratio = np.abs(scale[lost, None, None]) ** 2
    C[lost] = ratio * (
        (1 - inside[..., None]) ** 2 * C[left] / (np.abs(scale[left]) ** 2)[:, None, None]
        + inside[..., None] ** 2 * C[there] / (np.abs(scale[there]) ** 2)[:, None, None]
    )
    C[lost] += 2 * error[:, :, None] * error[:, None, :]  # either part of a complex number may have it whole


MAX_PARAMETER_CHANGE = 0.5  # of its value: a parameter that would have to change by more explains nothing
MIN_OWN_SLOPE = 1e-6  # of a slope: its part beside those of the estimated parameters

Explained = Mapping[str, tuple[float, float]]
"""By parameter: the change that explains most, as a share of its value or of a sensor's gain, and the share that it
explains."""


def sentence_of(explained: Explained) -> str:
    """The parameters that explain most, in words; "" where none was looked at."""
    best = max((share for _, share in explained.values()), default=0.0)
    parts = [f"{n} {100 * c:+.2g} %" for n, (c, share) in explained.items() if share > 0.9 * best]
    if best < 0.5:
        return "; no parameter by itself explains half of it" if explained else ""
    return f"; {' or '.join(parts)} would explain {100 * best:.0f} % of it"


def explained_at_lines(parts: Sequence[tuple[ResponseModel, Spectrum, FloatArray]]) -> Explained:
    """What a change of each parameter that is not estimated would explain of chi2, the estimated ones following it.

    To first order the residuals r move by u a with the change a. Of u and r only what is perpendicular to the slopes of
    the estimated parameters counts: a = -u'r / u'u, which takes (u'r)^2 / u'u off r'r. Shares are of what r'r has
    beyond noise.

    parts : of each log: the machine, the spectrum without curvature, and the parameters that were found, SI
    """
    plant, names = parts[0][0].plant, parts[0][0].names
    gains = (error.name for error in plant.sensors.errors if error.unit == "1")
    alone = ((twin,) for twin in twins_of(plant.parameters))  # a twin among others would not follow its twin
    found = {}
    for group in ((*acting_parameters(plant), *gains), *alone):
        others = [name for name in group if name not in names]
        if not others:
            continue
        columns = [_slopes(model, s, theta, others) for model, s, theta in parts]
        r, J = (np.concatenate(stacked) for stacked in zip(*columns, strict=True))
        Q = np.linalg.qr(J[:, : len(names)])[0]
        r = r - Q @ (Q.T @ r)
        beyond = float(r @ r) - (len(r) - len(names)) / 2
        for name, whole in zip(others, J[:, len(names) :].T, strict=True):
            u = whole - Q @ (Q.T @ whole)
            acts = np.linalg.norm(u) > MIN_OWN_SLOPE * np.linalg.norm(whole)
            if acts and beyond > 0 and abs(a := -float(u @ r / (u @ u))) < MAX_PARAMETER_CHANGE:
                found[name] = (a, min(1.0, a**2 * float(u @ u) / beyond))
    return found


def _slopes(
    model: ResponseModel, s: Spectrum, theta: FloatArray, others: Sequence[str]
) -> tuple[FloatArray, FloatArray]:
    """Residuals at the lines in standard deviations, and their slopes in shares of all parameters, both real."""
    W = weights_of(model, s, theta)
    par, twins = model.plant.parameters, twins_of(model.plant.parameters)
    own = dict(zip(model.names, theta.tolist(), strict=True))
    taken = [own.get(twins.get(name, ""), float(getattr(par, name, 0.0))) for name in others]
    whole, wide = np.array([*theta, *taken]), replace(model, names=(*model.names, *others))

    def white(at: FloatArray) -> FloatArray:
        e = white_residuals(wide, s, at, W).ravel()
        return np.concatenate([e.real, e.imag])

    steps = STEP * np.diag(np.where(whole == 0, 1.0, whole))
    return white(whole), np.array([(white(whole + h) - white(whole - h)) / (2 * STEP) for h in steps]).T
