"""Controllers from and to control.StateSpace.

           +-----------------+
p* ---(+)->| s+ = A s + B u  |--> v          u = p* - y, negative feedback
       ^-  | v  = C s + D u  |
       y   +-----------------+
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import system_matrix
from malta.linear.system import System, balanced_units
from malta.model.data import plant_of
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import OperatingPoint, Plant, Signal, outputs_at
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller, linear_law
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
    A, B, C, D, Ts = _discrete(sys)
    p, m = len(plant.outputs), len(plant.inputs)
    if D.shape != (m, p):
        found, wanted = f"{D.shape[1]} inputs and {D.shape[0]} outputs", f"{p} errors and {m} forces"
        raise InputError(CALLER, "sys", found, f"{wanted} of the {plant.name}")
    if not all(np.isfinite(M).all() for M in (A, B, C, D)):
        raise InputError(CALLER, "sys", "NaN or infinity", "finite numbers")
    model = linearize(plant, plant.at() if point is None else point)
    return law_of_errors(System(A, B, C, D), sys.state_labels, model, Ts, name=name or sys.name)


def law_of_errors(
    law: System,
    labels: Sequence[str],
    model: LinearModel,
    Ts: float,
    *,
    name: str,
    position_feedforward: bool = False,
) -> Controller:
    """A sampled law s+ = A s + B u, v = C s + D u of the errors u = p* - y as a controller; labels: of its states."""
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


def _discrete(sys: Any) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
    """A, B, C, D and the sample time of a discrete system. Raises InputError."""
    wanted = 'a discrete control.StateSpace, as control.c2d(sys, Ts, "tustin") gives it'
    if not all(hasattr(sys, key) for key in ("A", "B", "C", "D", "dt", "state_labels")):
        raise InputError(CALLER, "sys", f"a {type(sys).__name__}", wanted)
    if sys.dt is True or not sys.dt:
        raise InputError(CALLER, "sys", f"dt = {sys.dt}", wanted)
    A, B, C, D = (np.asarray(M, dtype=float) for M in (sys.A, sys.B, sys.C, sys.D))
    return A, B, C, D, float(sys.dt)


def law_system(c: Controller) -> Any:
    """The control law without saturation as a discrete control.StateSpace with names.

    Inputs: the measurements by their names, then what they should be, as "z_ref", at rest (p*' = 0). Outputs: the
    forces, without v0, and of v_ff with what holds the machine there. Negative feedback is inside: v = F y + R p*, and
    the loop gain at the sensors is -P F.
    States: those of the controller, then its sums of errors, in units as named_system has them.
    """
    law, R = linear_law(c), set_point(c)
    sums = [f"{s.name}[i]" for s in c.measurements]
    inputs = [*(s.name for s in c.measurements), *reference_names(c)]
    forces = [s.name for s in c.forces]
    B, D = np.hstack([law.B_y, law.B_r @ R]), np.hstack([law.D_y, law.D_r @ R])
    made = named_system(c.name, inputs, forces, c.sample_time, law.A, B, law.C, D)
    made.set_states([*(s.name for s in c.states), *sums][: len(law.A)])
    return made


def named_system(
    name: str, inputs: list[str], outputs: list[str], Ts: float, A: Any, B: Any, C: Any, D: Any = 0
) -> Any:
    """A control.StateSpace, its states in balanced units: powers of two of SI.

    python-control's responses, by slycot's Hessenberg form, lose digits else: at 1 rad/s |S| of the planar motor's PID
    comes out 1800 times too large, and its LQG wrong by a hundredth.
    """
    import control  # imports matplotlib and takes a second: only where it is used

    D = np.zeros((len(C), B.shape[1])) + D
    t = balanced_units(A, B, C)
    return control.ss(
        A * t / t[:, None], B / t[:, None], C * t, D, Ts, name=name, inputs=inputs, outputs=outputs
    )


def reference_names(c: Controller) -> list[str]:
    """What the references of the measurements are called in systems."""
    return [f"{s.name}_ref" for s in c.measurements]


def set_point(c: Controller) -> FloatArray:
    """r = (p*, xi*, v_ff, v0) of the law by p* at rest, near the operating point.

    At rest the forces behind the lag of the design model are v_ff, and the stored forces are v_ff and what currents
    commutated for the reference make beside it, as in the references of a simulation.
    """
    n, m, p = len(c.states), len(c.forces), len(c.measurements)
    R = np.zeros((p + n + 2 * m, p))
    R[:p] = np.eye(p)
    if c.tracks == "states":
        plant = plant_of(c.parameters)
        y = ca.SX.sym("y", p)
        q = ca.densify(ca.jacobian(plant.position_of(y), y))
        here = outputs_at(plant, plant.point(c.operating_point[0]).x)
        X = np.array(ca.Function("X", [y], [q])(here))
        R[p : p + len(X)] = X
        v_ff, mechanical = R[p + n : p + n + m], len(c.A)
        if c.feedforward.position.size:
            v_ff[:] = c.feedforward.position @ X
        known = c.lagging + c.delay
        past = R[p + mechanical : p + mechanical + m * known].reshape(known, m, p)
        past[:] = v_ff
        if c.delay:
            newest = mechanical + m * (known - 1)
            past[c.lagging :] += c.Ad[newest : newest + m, : len(X)] @ X
    return R
