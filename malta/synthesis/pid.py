"""PID controllers of single axes: each output with the input of its index, or each coordinate of the centre of gravity.

    decentralized        v_k = PID of p_k* - y_k: a sensor and the actuator beside it, whatever the others do
    centre-of-gravity    v = G^-1 a,  a_k = PID of q_k* - q_k,  q = P^-1 y, G the inputs' accelerations of q

Both are K, Ki and L of the same control law, and a gain file holds them as these matrices: of a decentralized PID Ki is
diagonal, and so are both halves of K times P^-1.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import linalg

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.model.linearize import LinearModel
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.feedforward import machine_part
from malta.synthesis.filters import Gains
from malta.synthesis.spec import Pid, PidAxes, require_pairs


class PidAxisSet(NamedTuple):
    """What each of k axes measures, and the inputs that act for it: s = of_outputs p = of_positions q, v = inputs f."""

    of_outputs: FloatArray  # k x p
    of_positions: FloatArray  # k x n/2
    inputs: FloatArray  # m x k


@on_one_thread
def pid(
    model: LinearModel,
    terms: Pid,
    Ts: float,
    *,
    name: str = "pid",
    current_loop_delay: bool = True,
    position_feedforward: bool = False,
) -> Controller:
    """Make a PID controller of each axis: an output with the input of its index, or a coordinate with all inputs.

    v = Kp (p* - y) + Ki e + Kd (p*' - d),  d+ = a d + (1 - a) (y - y_last) / Ts,  a = e^(-Ts / filter)

    The filter is Ts a / (1 - a) behind p*', so Kd would push with that time's Kd p*'': the feedforward takes it off.

    Raises InputError for an invalid sample time, more or fewer terms than inputs, states that are not
    positions and their rates; CheckError where the inputs cannot accelerate each coordinate by itself.
    """
    if not (math.isfinite(Ts) and Ts > 0):
        raise InputError("pid", "Ts", f"{Ts} s", "a sample time above 0 s")
    plant, half = model.plant, len(model.A) // 2
    plant.require_second_order("pid")
    require_pairs(plant)
    if len(terms.Kp) != len(plant.inputs):
        raise InputError("pid", "Kp", f"{len(terms.Kp)} gains", f"{len(plant.inputs)}, one for each input")
    part = machine_part(
        model,
        Ts,
        plant.actuator.delay(Ts),
        current_loop_delay=current_loop_delay,
        position_feedforward=position_feedforward,
    )
    # Differences of readings are the mean rate between them, whatever the rate at the readings is.
    axes, still = axes_of(model, terms.axes), part["feedforward"]
    part["feedforward"] = replace(
        still,
        rate=np.zeros((half, len(plant.outputs))),
        inertia=still.inertia - _lagging_inertia(terms, Ts, axes),
    )
    return Controller(
        **part,
        **pid_gains(model.C[:, :half], terms, Ts, axes)._asdict(),
        name=name,
        states=plant.design_states,
        cost=None,
        noise=None,
    )


def axes_of(model: LinearModel, axes: PidAxes) -> PidAxisSet:
    """Find the axes of a PID on a machine.

    Raises CheckError where the inputs cannot accelerate each coordinate by itself.
    """
    half = len(model.A) // 2
    P, one = model.C[:, :half], np.eye(half)
    if axes == "decentralized":
        return PidAxisSet(np.eye(len(P)), P, np.eye(model.B.shape[1]))
    try:
        return PidAxisSet(np.linalg.inv(P), one, np.linalg.inv(model.force_map))
    except np.linalg.LinAlgError as error:
        raise CheckError(f"pid: axes at the centre of gravity of a {model.plant.name}: {error}") from error


def _lagging_inertia(terms: Pid, Ts: float, axes: PidAxisSet) -> FloatArray:
    """What each input pushes per unit of its output's p*'', as filtered rates lag, kg or kg m^2."""
    a = _decay(terms, Ts)
    pushed = axes.inputs @ ((terms.Kd * Ts * a / (1 - a))[:, None] * axes.of_outputs)
    return np.asarray(np.diag(pushed))


def _decay(terms: Pid, Ts: float) -> FloatArray:
    """a = e^(-Ts / filter) of each axis; 0 for plain differences."""
    return np.array([math.exp(-Ts / time) if time else 0.0 for time in terms.filters])


def pid_gains(P: FloatArray, terms: Pid, Ts: float, axes: PidAxisSet) -> Gains:
    """A PID as the control law runs it, for positions q with p = P q: these and their rates come from the outputs.

    The rate of each axis has its own filter: in positions that is M^-1 diag(a) M, with s = M q.
    """
    n, M, a = len(P), axes.of_positions, _decay(terms, Ts)
    back = np.linalg.inv(M)
    # a_0 is taken out: what is equal on all axes passes through M^-1 M without rounding.
    rates = a[0] * np.eye(n) + back @ ((a - a[0])[:, None] * M)
    return Gains(
        Ad=linalg.block_diag(np.eye(n), rates),
        Bd=np.zeros((2 * n, n)),
        Cd=np.hstack([P, np.zeros((n, n))]),
        K=axes.inputs @ np.hstack([terms.Kp[:, None] * M, terms.Kd[:, None] * M]),
        Ki=axes.inputs @ (terms.Ki[:, None] * axes.of_outputs),
        L=np.vstack([np.linalg.inv(P), back @ (((1 - a) / Ts)[:, None] * axes.of_outputs)]),
    )


def law_of_outputs(terms: Pid, axes: PidAxisSet, outputs: Sequence[int]) -> tuple[Pid, PidAxisSet]:
    """The axes that some outputs belong to, alone: their terms, and the axes with these outputs for positions."""
    own = np.array(outputs)
    k = np.flatnonzero(axes.of_outputs[:, own].any(axis=1))
    W = axes.of_outputs[np.ix_(k, own)]
    few = replace(terms, Kp=terms.Kp[k], Ki=terms.Ki[k], Kd=terms.Kd[k], filter=terms.filters[k])
    return few, PidAxisSet(W, W, axes.inputs[np.ix_(own, k)])
