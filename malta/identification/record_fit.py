"""Parameters from any record of a closed loop, without a periodic excitation: prediction errors in time alone.

    minimize over theta, the first state and constant loads      sum over outputs j of N ln rms(e_j)

e are the innovations of `prediction`: what no earlier reading tells, so that what the law makes of noise biases nothing
(L. Ljung, System Identification, 2nd ed., ch. 8 and 13). No lines of an excitation tell noise from motion: it is sought
beside the parameters, a variance r of each sensor, and accelerations with one ratio to these for all positions,

    q_j = ratio r_j       r_j: variance of position j as the sensors tell it; ratio in 1/s^4
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from scipy.optimize import minimize_scalar

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.identification.prediction import NoiseModel, Predicted, information_of, innovations_of, predict
from malta.identification.response import ResponseModel
from malta.work import is_stopped

RATIOS = (2.0, 16.0)  # log10 of the ratio of accelerations to positions, 1/s^4, where it is sought
RATIO_ACCURACY = 0.1  # of the logarithm
MAX_ROUNDS = 5  # of noise and parameters in turn
SETTLED_STEP = 0.1  # standard deviations by which parameters move in the last round
LAGS = 20  # samples, over which innovations are tested
MAX_CORRELATION = 0.15  # of innovations with what came before: a larger one is no noise
CHANCE = 5.0  # standard deviations of a correlation that is none by chance
MIN_SAMPLES = 200
MIN_SKEW_GAIN = 0.01  # of the innovations' size, by which they fall where the currents are moved by a sample


@dataclass(frozen=True, eq=False)
class RecordFit:
    """Parameters from the prediction errors of a record, and what is left in these.

    predicted : parameters and figures of the filter
    noise : variances of sensors and accelerations with which the innovations are most likely
    innovations : k x p, over their expected size; NaN where a reading is missing or an outlier
    currents : k x currents, A, as measured
    skew : samples by which the currents would have to move for a better prediction; 0: none

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> log = malta.identification.log_of(run)
    >>> found = malta.identification.identify_record(controller, log, parameters=["K_D"])
    >>> found.record.skew, found.record.innovations.shape
    (0, (2000, 5))
    """

    predicted: Predicted
    noise: NoiseModel
    innovations: FloatArray
    currents: FloatArray
    skew: int

    @cached_property
    def correlations(self) -> FloatArray:
        """Of innovations with those of the same output before, and with earlier currents: lags x pairs."""
        e = np.nan_to_num(self.innovations)
        e = (e - e.mean(axis=0)) / e.std(axis=0)
        i = self.currents - self.currents.mean(axis=0)
        i = i[:, i.std(axis=0) > 0]
        i = i / i.std(axis=0)
        rows = []
        for lag in range(1, LAGS + 1):
            own, earlier = e[lag:], i[:-lag]
            rows.append(np.append((own * e[:-lag]).mean(axis=0), own.T @ earlier / len(own)))
        return np.array(rows)

    @property
    def correlation(self) -> float:
        """The largest of them."""
        return float(np.abs(self.correlations).max())

    @property
    def covariance(self) -> FloatArray:
        """Of the parameters, SI; innovations that are correlated tell less: 1 + 2 sum |r_l| times as much."""
        own = np.abs(self.correlations[:, : self.innovations.shape[1]])
        own[own < 3 / math.sqrt(len(self.currents))] = 0.0
        return np.asarray((1 + 2 * own.sum(axis=0).max()) * self.predicted.covariance)

    @property
    def refusal(self) -> str:
        """Why the model does not explain the record; "": it does."""
        if self.skew:
            late = "late" if self.skew < 0 else "early"
            return f"currents are a sample {late} beside the readings: moved by one they predict these better"
        if self.correlation > max(MAX_CORRELATION, CHANCE / math.sqrt(len(self.currents))):
            return (
                f"prediction errors are correlated by {self.correlation:.2f} with what came before, at most "
                f"{MAX_CORRELATION:g} is noise: the machine's model lacks something"
            )
        return ""


def start_information(model: ResponseModel, i: FloatArray, y: FloatArray, source: str) -> FloatArray:
    """The Fisher information of the parameters in units of their scales, with the sensors' noise and little else.

    Raises CheckError for a record that is too short.
    """
    _require_length(y, source)
    noise = _noise(model, model.start, _first_variances(model, y), sum(RATIOS) / 2)
    return information_of(model, noise, i, y, source) * np.outer(model.scale, model.scale)


def _require_length(y: FloatArray, source: str) -> None:
    if len(y) < MIN_SAMPLES:
        raise CheckError(f"{source}: too short: {len(y)} samples, at least {MIN_SAMPLES} are needed")


def fit_record(
    model: ResponseModel, i: FloatArray, y: FloatArray, *, source: str, robust: bool = False
) -> RecordFit:
    """Parameters of a machine from any record of it under control.

    model : the machine where the record was made, with its parameters' names and start; of states (q, q')
    i : k x currents, as measured, A
    y : k x p, SI; NaN where a reading is missing
    source : of the record, for errors
    robust : Student's likelihood with 4 degrees of freedom in place of the normal one

    Raises CheckError for a record that is too short, and a filter that does not follow it.
    """
    _require_length(y, source)

    def found_with(theta: FloatArray, noise: NoiseModel, currents: FloatArray) -> Predicted:
        return predict(model, theta, noise, currents, y, source=source, robust=robust)

    def found_at(theta: FloatArray, r: FloatArray, ratio: float) -> Predicted:
        return found_with(theta, _noise(model, theta, r, ratio), i)

    r, theta, span = _first_variances(model, y), model.start, RATIOS
    for _ in range(MAX_ROUNDS):
        ratio = _likeliest_ratio(partial(found_at, theta, r), span)
        noise = _noise(model, theta, r, ratio)
        found = found_with(theta, noise, i)
        moved = np.abs(found.values - theta) / np.sqrt(np.diag(found.covariance))
        theta, r, span = found.values, r * found.rms**2, (ratio - 1.0, ratio + 1.0)
        if (moved < SETTLED_STEP).all() or is_stopped():
            break
    shifts = () if is_stopped() else (-1, 1)
    better = {0: _cost(found)} | {
        shift: _cost(found_with(theta, noise, _moved_rows(i, shift))) for shift in shifts
    }
    skew = min(better, key=lambda shift: better[shift])
    gain = (_cost(found) - better[skew]) / len(found.rms)
    left = innovations_of(model, found, noise, i, y)
    return RecordFit(found, noise, left, i, skew if gain > MIN_SKEW_GAIN else 0)


def _cost(found: Predicted) -> float:
    """Minus the logarithm of the likelihood per sample, but for a constant."""
    return float(np.log(found.expected * found.rms).sum())


def _likeliest_ratio(run: Callable[[float], Predicted], span: tuple[float, float]) -> float:
    """The logarithm of the ratio within a span with which innovations are most likely."""

    def cost(x: float) -> float:
        try:
            return math.inf if is_stopped() else _cost(run(x))  # then the first one that was tried is taken
        except CheckError:
            return math.inf

    return float(minimize_scalar(cost, bounds=span, method="bounded", options={"xatol": RATIO_ACCURACY}).x)


def _noise(model: ResponseModel, theta: FloatArray, r: FloatArray, ratio: float) -> NoiseModel:
    """Variances of sensors, and of accelerations as 10^ratio times those of positions."""
    _, _, C, _ = model.matrices(theta)
    n = len(model.plant.controlled) // 2
    return NoiseModel(r, 10**ratio * ((np.linalg.pinv(C[:, :n]) ** 2) @ r))


def _first_variances(model: ResponseModel, y: FloatArray) -> FloatArray:
    """Those of the machine's sensors; of a sensor without noise from its readings' second differences."""
    declared = np.asarray(model.plant.sensors.deviations, dtype=float) ** 2
    rough = np.nanvar(np.diff(y, 2, axis=0), axis=0) / 6
    return np.where(declared > 0, declared, np.maximum(rough, 1e-12 * np.nanvar(y, axis=0)))


def _moved_rows(table: FloatArray, shift: int) -> FloatArray:
    """A table later by so many samples; the ends stay."""
    return table[np.clip(np.arange(len(table)) - shift, 0, len(table) - 1)]
