"""Controllers from and to control.StateSpace.

           +-----------------+
p* ---(+)->| s+ = A s + B u  |--> v          u = p* - y, negative feedback
       ^-  | v  = C s + D u  |
       y   +-----------------+
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from malta.errors import InputError
from malta.linear.conversion import from_control
from malta.linear.matrices import system_matrix
from malta.linear.system import System
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import OperatingPoint, Plant, Signal
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.feedforward import machine_part

CALLER = "controller_of"
ERROR = "[e]"  # what follows a measurement's name in the name of its last error


@on_one_thread
def controller_of(
    sys: Any, plant: Plant, point: OperatingPoint | None = None, *, name: str = ""
) -> Controller:
    """Make a controller from a discrete linear system of the errors u = p* - y, as H-infinity synthesis gives it.

    A continuous system is sampled first, as by control.c2d(sys, Ts, "tustin"). When an input saturates, the states go
    on as if it did not: what integrates in such a law winds up. The loads are cancelled by v0 as in every controller.

    sys : discrete control.StateSpace, from the errors of the plant's outputs to its inputs; its dt is the sample time.
        Of a system F from measurements to forces, v = F y, hand over -F.
    plant : the machine
    point : where the machine is linearized; None: plant.at()
    name : of the design; "": that of the system

    Returns a Controller, for verification, export and simulation as any other.

    Raises InputError for another number of inputs and outputs, a system that is not discrete, NaN or infinity.

    >>> import control, malta
    >>> cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    >>> lead = control.ss(control.tf([200, 1000], [1 / 50, 1]))
    >>> lead = control.c2d(lead, 1e-3, "tustin")
    >>> controller = malta.synthesis.controller_of(lead, cart, name="lead")
    >>> model = malta.linearize(cart, cart.at())
    >>> controller.sample_time, malta.verify(model, controller).stable
    (0.001, True)
    """
    wanted = 'a discrete control.StateSpace, as control.c2d(sys, Ts, "tustin") gives it'
    if hasattr(sys, "dt") and (sys.dt is True or not sys.dt):
        raise InputError(CALLER, "sys", f"dt = {sys.dt}", wanted)
    law = from_control(sys, CALLER, "sys", expected=wanted)
    p, m = len(plant.outputs), len(plant.inputs)
    if law.D.shape != (m, p):
        found, shape = f"{law.D.shape[1]} inputs and {law.D.shape[0]} outputs", f"{p} errors and {m} forces"
        raise InputError(CALLER, "sys", found, f"{shape} of the {plant.name}")
    model = linearize(plant, plant.at() if point is None else point)
    return law_of_errors(law, model, sys.dt, name=name or getattr(sys, "name", ""))


def law_of_errors(
    law: System, model: LinearModel, Ts: float, *, name: str, position_feedforward: bool = False
) -> Controller:
    """A sampled law s+ = A s + B u, v = C s + D u of the errors u = p* - y as a controller."""
    A, B, C, D = law
    plant, n, (m, p) = model.plant, len(A), D.shape
    part = machine_part(
        model,
        Ts,
        plant.actuator.delay(Ts),
        current_loop_delay=True,
        position_feedforward=position_feedforward,
    )
    # xi* = 0: there are no rates at the samples for the feedforward to correct.
    part["feedforward"] = replace(part["feedforward"], rate=np.zeros_like(part["feedforward"].rate))
    labels = law.states or [f"x[{i}]" for i in range(n)]
    states = (Signal(label, "1") for label in labels)
    return Controller(
        **part,
        name=name,
        states=(*states, *(Signal(s.name + ERROR, s.unit) for s in plant.outputs)),
        Ad=system_matrix(A, -B),
        Bd=np.zeros((n + p, m)),
        Cd=np.zeros((p, n + p)),
        K=np.hstack([-C, D]),
        Ki=np.zeros((m, p)),
        L=np.vstack([np.zeros((n, p)), np.eye(p)]),
        cost=None,
        noise=None,
        tracks="errors",
    )
