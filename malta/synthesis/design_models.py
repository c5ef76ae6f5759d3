"""The design model between samples: currents that are held, forces behind the lag of the current loops."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.linear.sampling import add_lags, sample, split_delay
from malta.linear.system import System
from malta.synthesis.filters import Linear


def with_lags(model: Linear, rate: float) -> System:
    """The model with lags rate / (s + rate) before its inputs, rate in rad/s; these forces are states after x."""
    A, B = add_lags(model.A, model.B, rate)
    C = np.hstack([model.C, np.zeros((len(model.C), B.shape[1]))])
    return System(A, B, C, np.zeros((len(C), B.shape[1])))


class Held(NamedTuple):
    """A machine between samples, its currents held: x' = A x + B (v + H y_k), y_k the last reading."""

    A: FloatArray
    H: FloatArray  # m x p, N/m


def between_samples(model: Linear) -> Held:
    """What a linear model is between samples; E is in the reach of the inputs."""
    if model.E is None or isinstance(model, System) or not model.E.any():
        return Held(model.A, np.zeros((model.B.shape[1], len(model.C))))
    return Held(model.A - model.E @ model.C, np.linalg.lstsq(model.B, model.E, rcond=None)[0])


def sampled_model(model: Linear, Ts: float, delay: float = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ad, Bd, Cd under held currents, with the forces of the last `delay` samples as states."""
    still = between_samples(model)
    Ad, Bd = sample(still.A, model.B, Ts, delay)
    n, pull = len(model.A), still.H @ model.C
    if split_delay(delay)[0]:
        Ad[-len(pull) :, :n] = pull
    else:
        Ad[:, :n] = Ad[:, :n] + Bd @ pull
    return Ad, Bd, np.hstack([model.C, np.zeros((len(model.C), len(Ad) - n))])
