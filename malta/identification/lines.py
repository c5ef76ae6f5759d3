"""What logs tell at the lines of their excitation: columns of the response from excitation to readings.

A line that excites one input gives one column of G there. Where other logs excite the other inputs at the same line,
as many logs as inputs give G without a model. Else a column is interpolated between its own lines, as its difference
to the prediction; what that may miss is taken from how well its own lines are interpolated from their neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.errors import CheckError
from malta.identification.spectra import (
    EXCITED,
    between_neighbours,
    excited_lines,
    noise_bins,
    require_log,
    whole_periods,
    windowed_covariances,
)

if TYPE_CHECKING:
    from malta.identification.log import Log
    from malta.loops.loop import Loop
    from malta.model.plant import ComplexArray, FloatArray

LOUD = 4.0  # power at the lines over the noise, of the output that moves most; less is no excitation
MISSING = 1e-3  # of the samples that may be missing


class Line(NamedTuple):
    """A line of a log: Fourier coefficients, and the covariance of that of y, p x p."""

    w: float
    d: ComplexArray
    y: ComplexArray
    v: ComplexArray  # empty: no commands in the log
    covariance: ComplexArray


def lines_of(log: Log, loop: Loop) -> list[Line]:
    """The lines of the last whole periods of a log. Raises CheckError for a log that tells nothing."""
    plant = loop.plant
    require_log(log, plant.name, loop.sample_time)
    N, periods = whole_periods(
        log, np.nan_to_num(log.columns.get("excitation", np.zeros((1, 1)))), log.samples
    )
    commands = (
        log.table("v", [s.name for s in plant.inputs]) if log.names("v") else np.zeros((log.samples, 0))
    )
    tables = (
        log.table("excitation", [s.name for s in plant.inputs]),
        log.table("y", [s.name for s in plant.outputs]),
        commands,
    )
    D, Y, V = (np.fft.rfft(_filled(table, log)[-N:], axis=0) / N for table in tables)
    lines = excited_lines(log, D, periods)
    C = _noise(Y, lines, periods)
    power = (np.abs(Y[lines]) ** 2 / np.einsum("kpp->kp", C).real).max(axis=1)
    if np.median(power) < LOUD:
        raise CheckError(f"{log.source}: the excitation does not rise above the noise at half of the lines")
    rate = 2 * np.pi / (N * log.sample_time)
    return [Line(rate * k, D[k], Y[k], V[k], c) for k, c in zip(lines.tolist(), C, strict=True)]


def _filled(table: FloatArray, log: Log) -> FloatArray:
    """A table with missing samples between their neighbours. Raises CheckError for more than a few of them."""
    bad = ~np.isfinite(table)
    missing = int(bad.any(axis=1).sum()) + log.survey.gaps
    if missing > MISSING * log.samples or log.survey.gaps:
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
        ratio = (np.abs(Y[others]) ** 2 / np.einsum("kpp->kp", C[near]).real).mean(axis=0)
        grown = np.sqrt(np.maximum(ratio, 1.0))
        C = C * np.outer(grown, grown)
    return np.asarray(C)


class Columns(NamedTuple):
    """G at k frequencies, k x p x m, and the covariance of each column, k x m x p x p."""

    G: ComplexArray
    covariance: ComplexArray


def columns_of(lines: Sequence[Line], w: FloatArray, predicted: ComplexArray) -> Columns:
    """G at all lines: measured where it is, else interpolated as a difference to the prediction."""
    k, p, m = predicted.shape
    off = np.zeros((k, m, p), dtype=complex)
    C = np.zeros((k, m, p, p), dtype=complex)
    known = np.zeros((k, m), dtype=bool)
    for at, value in enumerate(w):
        here = [line for line in lines if line.w == value]
        D = np.array([line.d for line in here]).T  # m x experiments
        used = np.flatnonzero((np.abs(D) > EXCITED * np.abs(D).max()).any(axis=1))
        if np.linalg.matrix_rank(D[used], tol=EXCITED * np.abs(D).max()) < len(used):
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
    return Columns(predicted + off.transpose(0, 2, 1), C)


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
