"""Multisines: periodic excitations with lines that belong to one axis each, so that all axes are excited at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import InputError

STARTS = 3  # random phases for each axis
NORMS = (4, 8, 32)  # of the signal that are minimized


@dataclass(frozen=True, eq=False)
class Multisine:
    """A sum of cosines of whole multiples of 1 / period; each line excites one axis.

        d_j(t) = sum over the lines k of axis j of amplitude_k cos(2 pi lines_k t / period + phase_k)

    period : s
    lines : k, whole multiples of 1 / period, in order
    axis : k, index of the input that a line excites
    amplitude : k, N or N m
    phase : k, rad
    inputs : number of inputs

    Raises InputError for lines that are not whole, positive, different and in order.

    >>> import malta, numpy as np
    >>> lines, axis, size = np.array([3, 7]), np.array([0, 1]), np.ones(2)
    >>> one = malta.simulation.Multisine(1.0, lines, axis, size, np.zeros(2), inputs=2)
    >>> one(np.array([0.0, 0.5])).round(9).tolist()
    [[1.0, 1.0], [-1.0, -1.0]]
    """

    period: float
    lines: FloatArray
    axis: FloatArray
    amplitude: FloatArray
    phase: FloatArray
    inputs: int

    def __post_init__(self) -> None:
        for name in ("lines", "axis", "amplitude", "phase"):
            object.__setattr__(self, name, readonly(getattr(self, name)))
        whole = np.array_equal(self.lines, np.round(self.lines))
        if not (len(self.lines) and whole and self.lines[0] > 0 and (np.diff(self.lines) > 0).all()):
            expected = "whole multiples of 1 / period above 0, each once, in order"
            raise InputError("multisine", "lines", str(self.lines.tolist())[:80], expected)

    def __call__(self, t: FloatArray) -> FloatArray:
        """Forces at times t (s, shape (k,)), k x inputs."""
        d = np.zeros((len(t), self.inputs))
        turn = 2 * np.pi * np.asarray(t) / self.period
        for line, axis, amplitude, phase in zip(
            self.lines, self.axis.astype(int), self.amplitude, self.phase, strict=True
        ):
            d[:, axis] += amplitude * np.cos(line * turn + phase)
        return d

    @property
    def frequencies(self) -> FloatArray:
        """Of the lines, Hz."""
        return self.lines / self.period

    @property
    def peak(self) -> FloatArray:
        """The largest force of each input within a period, N or N m."""
        return np.asarray(np.abs(self._period()).max(axis=0))

    @property
    def crest_factor(self) -> FloatArray:
        """Largest value over rms, of each input; NaN of an input without lines."""
        d = self._period()
        rms = np.sqrt((d**2).mean(axis=0))
        return np.asarray(np.abs(d).max(axis=0) / np.where(rms > 0, rms, np.nan))

    def _period(self) -> FloatArray:
        samples = 16 * int(self.lines[-1])
        return self(np.arange(samples) * self.period / samples)


def interleaved_multisine(
    period: float, low: float, high: float, *, inputs: int, lines: int, seed: int = 0, shift: int = 0
) -> Multisine:
    """A multisine of amplitude 1: lines evenly spaced in log f, dealt to the inputs in turn, phases of a low crest.

    period : s
    low, high : Hz
    inputs : number of inputs
    lines : of each input
    seed : of the random phases
    shift : by how many inputs the deal begins later; signals of shifts 0, 1, ... excite each line in each input

    Each input has its lines spread over the whole band. From random phases on, ever higher norms of the signal are
    minimized (Guillaume, Schoukens, Pintelon and Kollar, IEEE Trans. Instrum. Meas. 40(6), 1991).

    Raises InputError for a band that has too few multiples of 1 / period.

    >>> signal = interleaved_multisine(1.0, 2.0, 200.0, inputs=2, lines=10)
    >>> len(signal.lines), bool((signal.crest_factor < 2.0).all())
    (20, True)
    """
    first, last = max(1, round(low * period)), round(high * period)
    wanted = lines * inputs
    if last - first + 1 < wanted:
        found = f"{max(0, last - first + 1)} multiples of 1 / period from {low:g} to {high:g} Hz"
        raise InputError(
            "excitation", "lines", found, f"at least {wanted}, {lines} of each of {inputs} inputs"
        )
    chosen = _spread_lines(first, last, wanted)
    axis = (np.arange(wanted, dtype=float) + shift) % inputs
    phase = np.zeros(wanted)
    random = np.random.default_rng(seed)
    for j in range(inputs):
        phase[axis == j] = _low_crest_phases(chosen[axis == j], random)
    return Multisine(period, chosen, axis, np.ones(wanted), phase, inputs)


def _spread_lines(first: int, last: int, count: int) -> FloatArray:
    """`count` different whole numbers, evenly spaced in their logarithm as far as whole numbers allow it."""
    found = np.round(np.geomspace(first, last, count))
    for k in range(1, count):  # at the low end neighbours may be the same
        found[k] = max(found[k], found[k - 1] + 1)
    for k in range(count - 1, -1, -1):
        found[k] = min(found[k], last - (count - 1 - k))
    return found


def _low_crest_phases(lines: FloatArray, random: np.random.Generator) -> FloatArray:
    """Phases of cosines of amplitude 1 with a low crest factor, rad: the norms of NORMS, one after the other."""
    from scipy.optimize import minimize  # here: it takes long to load

    samples = 1 << int(np.ceil(np.log2(6 * lines[-1])))
    places = lines.astype(int)

    def signal(phase: FloatArray) -> FloatArray:
        spectrum = np.zeros(samples // 2 + 1, dtype=complex)
        spectrum[places] = np.exp(1j * phase)
        return np.asarray(np.fft.irfft(spectrum, samples)) * samples / 2

    def norm(phase: FloatArray, n: int) -> tuple[float, FloatArray]:
        """ln of the n-norm, and its slope in the phases."""
        d = signal(phase)
        most = np.abs(d).max()
        powers = (d / most) ** (n - 1)
        total = float(powers @ d) / most
        # d changes by the real part of i e^(i phase) times the line's wave.
        slope = -np.imag(np.exp(1j * phase) * np.conj(np.fft.rfft(powers)[places]))
        return float(np.log(most)) + float(np.log(total)) / n, slope / (most * total)

    best, lowest = np.zeros(len(lines)), np.inf
    for phase in random.uniform(0, 2 * np.pi, (STARTS, len(lines))):
        for n in NORMS:
            phase = minimize(norm, phase, args=(n,), jac=True, method="BFGS", options={"maxiter": 60}).x
        peak = float(np.abs(signal(phase)).max())
        if peak < lowest:
            best, lowest = phase, peak
    return best
