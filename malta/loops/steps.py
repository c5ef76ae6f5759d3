"""Answers of a loop to steps of its references and to constant forces, and their figures."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from malta.arrays import FloatArray
from malta.linear.matrices import system_matrix
from malta.linear.sampling import sample
from malta.linear.system import System
from malta.loops.linear_loops import LinearLoop
from malta.processes import on_one_thread
from malta.synthesis.step_response import StepResponse, step_response

SETTLED_SHARE = 0.02  # of the final value, or of the largest one where the answer returns to zero
SAMPLE_SHARE = 0.05  # of the fastest time constant: a sample of a continuous loop
MAX_GROWTH = 1e3  # how far the answer of an unstable loop grows
SAMPLES = 2000  # of the answer of an unstable loop


class StepFigures(NamedTuple):
    """What is read off a step response. NaN where the loop is unstable or the answer returns to zero."""

    rise: float  # s, 10 to 90 % of the final value
    overshoot: float  # share of the final value
    settling: float  # s, from which it stays within 2 %; inf: never
    peak: float  # the value furthest from zero, with its sign
    peak_time: float  # s
    final: float


class LoopSteps(NamedTuple):
    """Answers of the true outputs: p outputs x p references, p outputs x d loads."""

    references: StepResponse
    loads: StepResponse


@on_one_thread
def loop_steps(loop: LinearLoop) -> LoopSteps:
    """The answers of a loop to a unit step of each reference, and of each load.

    An unstable loop is followed until its fastest growing mode has grown a thousandfold; its final values are NaN.

    >>> import control
    >>> answer = loop_steps(linear_loop(control.tf([4], [1, 1, 0]))).references
    >>> round(step_figures(answer, 0, 0).overshoot, 3)
    0.444
    """
    system, T = loop.closed_loop(), loop.sample_time
    M, g, dt = _sample_system(loop, system, T)
    if loop.stable:
        found = step_response(M, g, system.C, dt)
        found = StepResponse(found.t, found.y + system.D, found.final + system.D)
    else:
        found = _respond_for_a_while(loop, M, g, system, dt)
    p = len(loop.outputs)
    return LoopSteps(
        StepResponse(found.t, found.y[..., :p], found.final[:, :p]),
        StepResponse(found.t, found.y[..., p:], found.final[:, p:]),
    )


def _sample_system(loop: LinearLoop, system: System, T: float | None) -> tuple[FloatArray, FloatArray, float]:
    """The closed loop from sample to sample: M, g and the time between samples."""
    if T is not None:
        return np.eye(len(system.A)) + T * system.A, T * system.B, T
    fastest = float(np.abs(loop.closed_poles).max(initial=0.0)) or 1.0
    return *sample(system.A, system.B, SAMPLE_SHARE / fastest), SAMPLE_SHARE / fastest


def _respond_for_a_while(
    loop: LinearLoop, M: FloatArray, g: FloatArray, system: System, dt: float
) -> StepResponse:
    """The answer of an unstable loop over a finite time."""
    growth = max(float(loop.closed_poles.real.max()), 1e-3 * float(np.abs(loop.closed_poles).max()))
    stride = max(1, round(math.log(MAX_GROWTH) / growth / dt / SAMPLES))
    n, w = g.shape
    one = system_matrix(M, g, None, np.eye(w))
    step, out = np.linalg.matrix_power(one, stride), np.hstack([system.C, system.D])
    count = max(2, min(SAMPLES, math.ceil(math.log(MAX_GROWTH) / growth / dt / stride)))
    state, found = np.vstack([np.zeros((n, w)), np.eye(w)]), []
    for _ in range(count):
        found.append(out @ state)
        state = step @ state
    t = stride * dt * np.arange(count)
    return StepResponse(t, np.array(found), np.full((len(system.C), w), np.nan))


def step_figures(answer: StepResponse, output: int, column: int) -> StepFigures:
    """Rise, overshoot, settling and peak of one output after one step."""
    t, y, final = answer.t, answer.y[:, output, column], float(answer.final[output, column])
    k = int(np.abs(y).argmax())
    peak, largest = float(y[k]), float(np.abs(y[k]))
    nan = math.nan
    if math.isnan(final):
        return StepFigures(nan, nan, nan, peak, float(t[k]), nan)
    returns = abs(final) < 1e-6 * max(largest, 1e-300)
    band = SETTLED_SHARE * (largest if returns else abs(final))
    outside = np.flatnonzero(np.abs(y - final) > band)
    settling = 0.0 if not len(outside) else _settling_time(t, np.abs(y - final), band, int(outside[-1]))
    if returns:
        return StepFigures(nan, nan, settling, peak, float(t[k]), final)
    share = y / final
    rise = _first(t, share, 0.9) - _first(t, share, 0.1)
    return StepFigures(rise, max(0.0, float(share.max()) - 1), settling, peak, float(t[k]), final)


def _first(t: FloatArray, share: FloatArray, level: float) -> float:
    """When a line first reaches a level, between samples; NaN where it never does."""
    above = np.flatnonzero(share >= level)
    if not len(above):
        return math.nan
    k = int(above[0])
    if k == 0:
        return float(t[0])
    return float(t[k - 1] + (t[k] - t[k - 1]) * (level - share[k - 1]) / (share[k] - share[k - 1]))


def _settling_time(t: FloatArray, away: FloatArray, band: float, last: int) -> float:
    """When a deviation enters its band for good, between samples; infinite where it ends outside."""
    if last + 1 >= len(t):
        return math.inf
    high, low = float(away[last]), float(away[last + 1])
    return float(t[last] + (t[last + 1] - t[last]) * (high - band) / (high - low))
