"""What a controller believes of its machine: the poles of regulator and filter on the model that it was designed on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from malta.arrays import ComplexArray
from malta.linear.sampling import add_integrals, eigenvalues
from malta.loops.loop import loop_of_model
from malta.model.linearize import linearize
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller


def controller_poles(c: Controller) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues in z of regulator and filter on the controller's own model (separation principle).

    The regulator has no poles for observed disturbance forces, which only the filter estimates.
    """
    k = len(c.Ad) - c.observed * len(c.forces)
    A, B, K = c.Ad[:k, :k], c.Bd[:k], c.K[:, :k]
    if c.integrating:
        summed = list(c.summed)
        A, B = add_integrals(A, B, c.Cd[summed, :k], c.sample_time)
        K = np.hstack([K, -c.Ki[:, summed]])
    return eigenvalues(A - B @ K), eigenvalues((np.eye(len(c.Ad)) - c.L @ c.Cd) @ c.Ad)


@on_one_thread
def unstable_gain(c: Controller) -> tuple[str, float] | None:
    """The name of a gain that leaves the controller's own model unstable, and the worst |lambda|; None: all are stable.

    An LQG is judged by its regulator and its filter. A PID or a law of errors has no model and is judged on the machine
    that it names.
    """
    if c.schedule is not None:
        fixed = (replace(c, **matrices, schedule=None) for matrices in map(c.schedule.at, c.schedule.places))
        return next((found for found in map(unstable_gain, fixed) if found is not None), None)
    if c.cost is None:
        plant = plant_of(c.parameters)
        model = linearize(plant, plant.point(c.operating_point[0]))
        found = {"K": eigenvalues(loop_of_model(model, c).matrix)}
    else:
        found = dict(zip("KL", controller_poles(c), strict=True))
    for name, poles in found.items():
        radius = float(np.abs(poles).max())
        if not radius < 1:
            return name, radius
    return None
