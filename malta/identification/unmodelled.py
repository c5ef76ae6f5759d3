"""What a log leaves of an identified machine, as a bound of unmodelled dynamics at the lines of its excitation.

The machine reads Y = (1 + Delta) G(theta) I + noise. A line k tells of Delta, in the direction in which it moves
the readings,

    |Delta'(jw_k)|  <=  (|e_k| + band_k) / |G I|_k ,      e_k = Y_k - G(theta, w_k) I_k,    Delta = diag(shares) Delta'

with the readings G I over `sizes` and e over `sizes` and `shares`: a sensor that is known less well has a larger share.
Noise is within its bands at all lines at once with 95 %. G is the machine with the identified parameters alone: what
imperfections of a bench explain beside them is left here too, as no proof has them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import gammaincinv

from malta.errors import CheckError
from malta.identification.spectra import residuals_of, straighten, windowed_covariances
from malta.linear.covering import covering_weight
from malta.loops.windings import LAST_STAGE, CurrentLoops
from malta.margins.unmodelled import UnmodelledMargin, unmodelled_margin

if TYPE_CHECKING:
    from typing import Any

    from malta.arrays import ComplexArray, FloatArray
    from malta.identification.response import ResponseModel
    from malta.identification.spectra import Spectrum
    from malta.model.plant import Plant
    from malta.proof.margin import Ranges
    from malta.synthesis.controller import Controller

CONFIDENCE = 0.95  # that noise is below its band at all lines at once
TOLD = 2.0  # bands: what is left and larger is told by a line
PEAK = 3.0  # times both neighbours of its axis: a resonance is narrower than the lines are apart
FULL = 1.0  # to which the bound rises above the last line, as its frequency
OCTAVE = 2.0


class Unmodelled(NamedTuple):
    """A bound of Delta', |Y - G I| over |G I|, at the excited lines.

    w : of the lines, rad/s, rising
    bound : of |Delta| there, beside noise
    sizes : of each output, SI, powers of two: in these the readings are one vector
    shares : of the bound, by which each output may deviate; the largest is 1
    between : why the bound does not hold between lines; "": nothing speaks against it
    """

    w: FloatArray
    bound: FloatArray
    sizes: FloatArray
    shares: FloatArray
    between: str

    def weight(self, highest: float) -> Any:
        """W(s) over the bound at all lines, and what is assumed beyond them.

        Below the first line the bound stays; above the last one it rises as the frequency up to 1.

        highest : up to which it has to hold, rad/s
        """
        low, high = self.w[0], self.w[-1]
        first = float(self.bound[self.w <= OCTAVE * low].max())
        last = float(self.bound[self.w >= high / OCTAVE].max())
        beyond = np.geomspace(high, highest, 6)[1:] if highest > high else np.zeros(0)
        risen = np.minimum(last * beyond / high, max(FULL, last))
        return covering_weight(
            np.concatenate([[low / 10], self.w, beyond]), np.concatenate([[first], self.bound, risen])
        )


def residual_bound(parts: Sequence[tuple[ResponseModel, Spectrum, FloatArray]]) -> Unmodelled:
    """The bound of unmodelled dynamics that logs leave.

    parts : of each log its machine with the identified parameters alone, its spectrum, and the parameters' values, SI
    """
    found = [_at_lines(*part) for part in parts]
    power = np.mean([(np.abs(y) ** 2).mean(axis=0) for y, _, _, _ in found], axis=0)
    sizes = np.exp2(np.round(np.log2(np.maximum(power, 1e-300)) / 2))
    beside = np.mean(
        [(np.abs(e) ** 2).mean(axis=0) + np.einsum("kpp->kp", C).real.mean(axis=0) for _, _, e, C in found],
        axis=0,
    )
    shares = np.sqrt(beside) / sizes
    shares = np.exp2(np.round(np.log2(shares / shares.max())))
    count = sum(len(y) for y, _, _, _ in found)
    level = 1 - (1 - CONFIDENCE) / count
    w, bounds, between = [], [], ""
    for (_, s, _), (_, predicted, left, C) in zip(parts, found, strict=True):
        widths = sizes * shares
        scaled = C / np.outer(widths, widths)
        band = np.sqrt(gammaincinv(C.shape[1], level) * np.linalg.eigvalsh(scaled)[:, -1])
        moved = np.linalg.norm(predicted / sizes, axis=1)
        w.append(s.rate * s.lines)
        bounds.append((np.linalg.norm(left / widths, axis=1) + band) / moved)
        between = between or _modes_between(s, predicted / sizes, left / widths, band)
    at, order = np.concatenate(w), np.argsort(np.concatenate(w), kind="stable")
    return Unmodelled(at[order], np.concatenate(bounds)[order], sizes, shares, between)


def _at_lines(
    model: ResponseModel, spectrum: Spectrum, theta: FloatArray
) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
    """Outputs at the lines, what is predicted of them, what is left, and the covariance of noise."""
    s = straighten(model, spectrum, theta)
    found = residuals_of(model, s, theta)
    predicted = np.einsum(
        "kpm,km->kp", model.response(theta, s.rate * s.lines), s.currents[s.lines], optimize=True
    )
    return s.outputs[s.lines], predicted, found.lines, windowed_covariances(found.between)[0]


def _modes_between(s: Spectrum, predicted: ComplexArray, left: ComplexArray, band: FloatArray) -> str:
    """Why a resonance may lie between neighbouring lines of an input; "": nothing speaks for one.

    Through a resonance Delta turns by 180 degrees, and is largest there; through a zero it is smallest.
    """
    for axis in np.unique(s.axis):
        at = np.flatnonzero(s.axis == axis)
        main = int(np.abs(predicted[at]).sum(axis=0).argmax())
        delta, told = left[at] / predicted[at, main, None], np.linalg.norm(left[at], axis=1) > TOLD * band[at]
        size, f = np.linalg.norm(delta, axis=1), s.rate * s.lines[at] / (2 * np.pi)
        beside = np.concatenate([[0.0], size, [0.0]])
        for k in range(len(at) - 1):
            turns = told[k] and told[k + 1] and (delta[k].conj() @ delta[k + 1]).real < 0
            if turns and beside[k] <= size[k] and beside[k + 3] <= size[k + 1]:
                return (
                    f"between {f[k]:.4g} and {f[k + 1]:.4g} Hz what is left turns by more than 90 degrees where it is "
                    "largest: a mode may lie there, larger than at the lines. Excite lines between them (--band)"
                )
        for k in range(1, len(at) - 1):
            if told[k] and size[k] > PEAK * max(size[k - 1], size[k + 1]):
                return (
                    f"at {f[k]:.4g} Hz what is left is {size[k] / max(size[k - 1], size[k + 1]):.2g} times that of "
                    "both neighbouring lines: a mode may be larger between them. Excite lines near it (--band)"
                )
    return ""


def margin_with_left(
    plant: Plant,
    controller: Controller,
    ranges: Ranges,
    left: Unmodelled,
    needed: float,
    current_loops: CurrentLoops = LAST_STAGE,
    *,
    time: float | None = None,
) -> UnmodelledMargin:
    """The margin of an identified machine with its intervals and all that its log leaves, as dynamics of any phase.

    ranges : half of each parameter's interval, as a share
    left : the bound that the log gives
    needed : times the intervals, that hold all parameters together
    time : s, longest search of each group of sensors

    Raises CheckError where the bound does not hold between the lines.
    """
    if left.between:
        raise CheckError(f"the bound of unmodelled dynamics is not proven of: {left.between}")
    highest = float(np.pi / controller.sample_time)
    W = left.weight(highest)
    margin = unmodelled_margin(
        plant, controller, ranges, W, left.sizes, left.shares, current_loops, time=time
    )
    at = [left.w[0], math.sqrt(left.w[0] * left.w[-1]), left.w[-1], highest]
    low, high = left.w[[0, -1]] / (2 * np.pi)
    assumed = (
        f"|W| covers the {len(left.w)} lines from {low:.4g} to {high:.4g} Hz, each in the direction that it excites, "
        "with 95 %; that it holds between and outside of them and in all directions, and that current loops, dead "
        "times and the law are those of the gain file; at the operating point"
    )
    sizes = {w: float(abs(W(1j * w))) for w in at}
    return UnmodelledMargin(margin, sizes, len(W.den[0][0]) - 1, needed, assumed)
