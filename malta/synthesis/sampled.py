"""The design model between samples: currents that are held, forces behind the lag of the current loops."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from malta.synthesis.riccati import (
    add_lags,
    delay_inputs,
    sample,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


class Linear(Protocol):
    """xi' = A xi + B v + E (y_k - p), p = C xi: a LinearModel, or the part of one that nothing joins to the rest."""

    @property
    def A(self) -> FloatArray: ...
    @property
    def B(self) -> FloatArray: ...
    @property
    def C(self) -> FloatArray: ...
    @property
    def E(self) -> FloatArray: ...


class Lagged(NamedTuple):
    """A linear model whose forces follow their commands as first-order lags, and are states after x."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    E: FloatArray


def with_lags(model: Linear, rate: float) -> Lagged:
    """The model with lags rate / (s + rate) before its inputs, rate in rad/s."""
    A, B = add_lags(model.A, model.B, rate)
    C = np.hstack([model.C, np.zeros((len(model.C), B.shape[1]))])
    return Lagged(A, B, C, np.zeros((len(A), len(C))))


class Held(NamedTuple):
    """A machine between samples, its currents held: x' = A x + B (v + H y_k), y_k the last reading."""

    A: FloatArray
    H: FloatArray  # m x p, N/m


def held(model: Linear) -> Held:
    """What a linear model is between samples; E is in the reach of the inputs."""
    if not model.E.any():
        return Held(model.A, np.zeros((model.B.shape[1], len(model.C))))
    return Held(model.A - model.E @ model.C, np.linalg.lstsq(model.B, model.E, rcond=None)[0])


def gain_at_rest(K: FloatArray, n: int, known: int) -> FloatArray:
    """K of the n / 2 positions where forces are what is commanded: v = -K q - K_f v, m x n / 2.

    known : blocks of forces under way among the states, after n mechanical states
    """
    m = len(K)
    under_way = K[:, n : n + m * known].reshape(m, known, m).sum(axis=1)
    return np.asarray(np.linalg.solve(np.eye(m) + under_way, K[:, : n // 2]))


def sampled_model(model: Linear, Ts: float, delay: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Ad, Bd, Cd under held currents, with the forces of the last `delay` samples as states."""
    still = held(model)
    Ad, Bd = delay_inputs(*sample(still.A, model.B, Ts), delay)
    n, pull = len(model.A), still.H @ model.C
    if delay:
        Ad[-len(pull) :, :n] = pull
    else:
        Ad = Ad + Bd @ pull
    return Ad, Bd, np.hstack([model.C, np.zeros((len(model.C), len(Ad) - n))])


class Gains(NamedTuple):
    """The sampled design model with its gains, as the controller runs them."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    K: FloatArray
    Ki: FloatArray
    L: FloatArray
