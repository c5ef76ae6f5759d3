"""The controller as a linear law: a system from measurements and references at rest to forces."""

from __future__ import annotations

import math
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.linear.matrices import balanced_units
from malta.model.machines import build_plant
from malta.model.places import outputs_at
from malta.model.plant import total_delay
from malta.synthesis.controller import Controller
from malta.synthesis.linear_law import linear_law


def law_system(c: Controller) -> Any:
    """The control law without saturation as a discrete control.StateSpace with names.

    Inputs: the measurements by their names, then what they should be, as "z_ref", at rest (p*' = 0). Outputs: the
    forces, without v0, and of v_ff with what holds the machine there. Negative feedback is inside: v = F y + R p*, and
    the loop gain at the sensors is -P F.
    States: those of the controller, then its sums of errors, in balanced units.
    """
    import control  # imports matplotlib and takes a second: only where it is used

    law, R = linear_law(c), set_point(c)
    sums = [f"{s.name}[i]" for s in c.measurements]
    inputs = [*(s.name for s in c.measurements), *reference_names(c)]
    forces = [s.name for s in c.forces]
    B, D = np.hstack([law.B_y, law.B_r @ R]), np.hstack([law.D_y, law.D_r @ R])
    states = [*(s.name for s in c.states), *sums][: len(law.A)]
    t = balanced_units(law.A, B, law.C)
    names = {"states": states} if len(t) else {}
    matrices = (law.A * t / t[:, None], B / t[:, None], law.C * t, D)
    return control.ss(*matrices, c.sample_time, name=c.name, inputs=inputs, outputs=forces, **names)


def compensator_fields(c: Controller) -> dict[str, Any]:
    """The fields of the compensator that a proof has for the law: with hold, all delay of the machine, and its lag.

    Raises InputError for a law that is scheduled.
    """
    if c.schedule is not None:
        raise InputError(
            c.name, "compensator", "a scheduled law", "a law of one set of gains, or a malta.loop"
        )
    law, plant = linear_law(c), build_plant(c.parameters)
    actuator = plant.actuator
    lag = float(actuator.crossover) if math.isfinite(actuator.crossover) else None
    sums = 0 if c.observed else len(c.summed)
    Ts = c.sample_time
    held = {"sample_time": Ts, "delay": total_delay(plant, Ts), "lag": lag}
    return {"A": law.A, "B": law.B_y, "C": law.C, "D": law.D_y, "integrals": sums, **held}


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
        plant = build_plant(c.parameters)
        y = ca.SX.sym("y", p)
        q = ca.densify(ca.jacobian(plant.position_of(y), y))
        here = outputs_at(plant, plant.point(c.operating_point[0]).x)
        X = np.array(ca.Function("X", [y], [q])(here))
        R[p : p + len(X)] = X
        v_ff, mechanical = R[p + n : p + n + m], len(c.A)
        if c.feedforward.position.size:
            v_ff[:] = c.feedforward.position @ X
        known = c.lagging + c.stored
        past = R[p + mechanical : p + mechanical + m * known].reshape(known, m, p)
        past[:] = v_ff
        if c.stored:
            newest = mechanical + m * (known - 1)
            past[c.lagging :] += c.Ad[newest : newest + m, : len(X)] @ X
    return R
