"""PID controllers: one of each output with the input of the same index."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import linalg

from malta.errors import InputError
from malta.model.linearize import LinearModel
from malta.synthesis.controller import Controller
from malta.synthesis.feedforward import machine_part
from malta.synthesis.sampled import Gains
from malta.synthesis.spec import Pid
from malta.threads import on_one_thread

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


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
    """A PID controller of each output with the input of the same index.

    v = Kp (p* - y) + Ki e + Kd (p*' - d),  d+ = a d + (1 - a) (y - y_last) / Ts,  a = e^(-Ts / filter)

    Raises InputError for a sample time that is none, terms of another number than the inputs, states that are not
    positions and their rates.
    """
    if not (math.isfinite(Ts) and Ts > 0):
        raise InputError("pid", "Ts", f"{Ts} s", "a sample time above 0 s")
    plant, half = model.plant, len(model.A) // 2
    plant.require_second_order("pid")
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
    part["feedforward"] = replace(part["feedforward"], rate=np.zeros((half, len(plant.outputs))))
    return Controller(
        **part,
        **pid_gains(model.C[:, :half], terms, Ts)._asdict(),
        name=name,
        states=plant.design_states,
        cost=None,
        noise=None,
    )


def pid_gains(P: FloatArray, terms: Pid, Ts: float) -> Gains:
    """A PID as the control law runs it, for positions q with p = P q: these and their rates come from the outputs."""
    n, back, a = len(P), np.linalg.inv(P), math.exp(-Ts / terms.filter) if terms.filter else 0.0
    return Gains(
        Ad=linalg.block_diag(np.eye(n), a * np.eye(n)),
        Bd=np.zeros((2 * n, n)),
        Cd=np.hstack([P, np.zeros((n, n))]),
        K=np.hstack([terms.Kp[:, None] * P, terms.Kd[:, None] * P]),
        Ki=np.diag(terms.Ki),
        L=np.vstack([back, (1 - a) / Ts * back]),
    )
