"""What a controller believes of its machine: the poles of regulator and filter on the model that it was designed on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from malta.arrays import ComplexArray
from malta.linear.matrices import add_integrals, eigenvalues
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


def fixed_laws(c: Controller) -> tuple[Controller, ...]:
    """The laws of one set of matrices that a controller has: itself, or those at the places of its schedule."""
    if c.schedule is None:
        return (c,)
    return tuple(replace(c, **matrices, schedule=None) for matrices in map(c.schedule.at, c.schedule.places))


@on_one_thread
def unstable_gain(c: Controller) -> tuple[str, float] | None:
    """The name of a gain that leaves the controller's own model unstable, and the worst |lambda|; None: all are stable.

    A PID or a law of errors has no model: loops/own_model.py judges it on the machine that it names.
    """
    if c.cost is None:
        return None
    found = (unstable_pole(dict(zip("KL", controller_poles(law), strict=True))) for law in fixed_laws(c))
    return next((one for one in found if one is not None), None)


def unstable_pole(poles: Mapping[str, ComplexArray]) -> tuple[str, float] | None:
    """The first gain with a pole that is not inside the unit circle, and its worst |lambda|."""
    radii = {name: float(np.abs(of).max()) for name, of in poles.items()}
    return next(((name, radius) for name, radius in radii.items() if not radius < 1), None)
