"""Forces that counter a disturbance known in advance, as the acceleration of a carrier under the machine."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from malta.simulation.engines import evaluate
from malta.simulation.period import state_reference

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Plant
    from malta.simulation.references import Motion


def countering_forces(believed: Plant, motion: Motion, wrench: FloatArray) -> FloatArray:
    """The forces v that cancel a wrench w at the reference: G_v(x*) v = -G_w(x*) w in the least-squares sense, k x m.

    believed : the machine as the controller knows it; x' = f(x, v, w) with G_v = df/dv, G_w = df/dw at rest
    wrench : k x disturbances, N and N m; what no input reaches stays
    """
    states = evaluate(state_reference(believed).map(len(wrench)), motion.p, motion.dp)[0]
    moved = np.abs(wrench).any(axis=1)
    v = np.zeros((len(wrench), len(believed.inputs)))
    if moved.any():
        n, m, d = len(believed.controlled), len(believed.inputs), len(believed.disturbances)
        by_v, by_w = evaluate(_effects(believed).map(int(moved.sum())), states[moved])
        # A row of the result is a matrix, column by column.
        G_v, G_w = by_v.reshape(-1, m, n).swapaxes(1, 2), by_w.reshape(-1, d, n).swapaxes(1, 2)
        v[moved] = -np.einsum("kmn,knd,kd->km", np.linalg.pinv(G_v), G_w, wrench[moved])
    return v


@lru_cache(maxsize=16)
def _effects(plant: Plant) -> ca.Function:
    """Controlled states -> df/dv and df/dw of these states, each as one column."""
    kind = ca.MX if plant.tabulated else ca.SX
    chosen = list(plant.controlled)
    controlled = kind.sym("x", len(chosen))
    x = kind.zeros(len(plant.states))
    x[chosen] = controlled
    v, w = kind.sym("v", len(plant.inputs)), kind.sym("w", len(plant.disturbances))
    rate = plant.f(x, v, w)[chosen]
    by_v, by_w = (ca.densify(ca.vec(ca.densify(ca.jacobian(rate, u)))) for u in (v, w))
    still = [kind.zeros(len(plant.inputs)), kind.zeros(len(plant.disturbances))]
    by_v, by_w = ca.substitute([by_v, by_w], [v, w], still)
    return ca.Function("effects", [controlled], [ca.densify(by_v), ca.densify(by_w)])
