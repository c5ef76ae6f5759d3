"""Spectra of long records by blocks: at multiples of 1 / period and beside them, which is all that lines need.

A record of P periods of n samples has the Fourier coefficient of bin q P + r

    X = 1/(P n) sum over k of e^(-2 pi j (q + r/P) k / n) F_r[k]
    F_r[k] = sum over p of e^(-2 pi j r p / P) x[p n + k]

So P periods are folded into one for each r, a product of matrices while they are read, and a transform of n samples
gives all q. Nothing is approximated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from malta.arrays import ComplexArray, FloatArray

MOST_BESIDE = 8  # bins to either side of a multiple of 1 / period
BATCH_BYTES = 16_000_000  # of periods that are folded together


@dataclass(frozen=True, eq=False)
class FoldedSpectrum:
    """Fourier coefficients of a record at bins near multiples of 1 / period: spectrum[bins] as of an array.

    periods : of the record: every so many bins is a multiple
    bins : of the whole spectrum, 0 to half of the samples
    table : multiples x (2 beside + 1) x columns
    quiet : by column: the median size of the coefficients beside multiples in the upper half of all bins
    """

    periods: int
    bins: int
    table: ComplexArray
    quiet: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Of the whole spectrum."""
        return self.bins, self.table.shape[2]

    def __len__(self) -> int:
        return self.bins

    def __getitem__(self, bins: Any) -> ComplexArray:
        """The coefficients at bins. Raises IndexError for one that is not near a multiple."""
        k = np.asarray(bins)
        beside = self.table.shape[1] // 2
        multiple = (k + self.periods // 2) // self.periods
        r = k - multiple * self.periods
        if (np.abs(r) > beside).any():
            raise IndexError("a bin that is not near a multiple of 1 / period")
        return np.asarray(self.table[multiple, r + beside])

    def minus(self, bins: Any, values: ComplexArray) -> FoldedSpectrum:
        """The same spectrum less values at bins."""
        table, beside = np.array(self.table), self.table.shape[1] // 2
        table[np.asarray(bins) // self.periods, beside] -= values
        return replace(self, table=table)

    def columns(self, first: int, end: int) -> FoldedSpectrum:
        """That of some columns."""
        return replace(self, table=self.table[:, :, first:end], quiet=self.quiet[first:end])


def fold(tables: Sequence[Any], samples: int, periods: int, top: int = 0) -> FoldedSpectrum:
    """The spectrum of the last samples of tables, whose columns stand side by side.

    samples : whole periods
    top : the highest multiple that is kept; 0: all
    """
    n, begin = samples // periods, len(tables[0]) - samples
    beside = min(MOST_BESIDE, periods // 2)
    width = sum(table.shape[1] for table in tables)
    turns = 2j * np.pi / periods * np.outer(np.arange(beside + 1), np.arange(periods))
    weights = np.exp(-turns)
    stacked = np.vstack([weights.real, weights.imag[1:]])  # r = 0 is real
    folded = np.zeros((2 * beside + 1, n * width))
    batch = max(1, BATCH_BYTES // (8 * n * width))
    for p in range(0, periods, batch):
        count = min(batch, periods - p)
        rows = slice(begin + p * n, begin + (p + count) * n)
        block = np.concatenate([np.asarray(table[rows], dtype=float) for table in tables], axis=1)
        folded += stacked[:, p : p + count] @ np.nan_to_num(block).reshape(count, n * width)
    last = n // 2
    kept = min(top, last) if top else last
    found = np.zeros((kept + 1, 2 * beside + 1, width), dtype=complex)
    sizes: list[FloatArray] = []
    for r in range(beside + 1):
        part = folded[r] + (1j * folded[beside + r] if r else 0.0)
        part = part.reshape(n, width) * np.exp(-2j * np.pi * r / periods * np.arange(n) / n)[:, None]
        X = np.fft.fft(part, axis=0) / samples
        found[:, beside + r] = X[: kept + 1]
        # Of real signals the bin q P - r is that of (n - q) P + r, conjugated.
        found[:, beside - r] = X[-np.arange(kept + 1)].conj()
        if r:
            sizes.append(np.abs(X[last // 2 : last]))
    quiet = np.median(np.concatenate(sizes), axis=0)
    return FoldedSpectrum(periods, samples // 2 + 1, found, quiet)
