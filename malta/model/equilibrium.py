"""The inputs that hold a machine at rest: against its loads, and against what its magnets pull with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from malta.errors import CheckError
from malta.model.plant import OperatingPoint, Plant

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


def trim(plant: Plant, /, **positions: float) -> OperatingPoint:
    """Find the inputs that hold the machine at rest at these states against its loads.

    Solves 0 = f(x, u, load(x)) for u, in the least-squares sense, by Newton's method. Accelerations of uncontrolled
    states are left: a mover whose centre of gravity is off its axis rolls.

    plant : the machine
    positions : states by name, SI; the others are zero

    Returns an OperatingPoint.

    Raises InputError for unknown states, CheckError when no input holds the machine there.

    >>> import malta
    >>> ball = malta.read_design("examples/ball/design/ball.toml").plant
    >>> malta.trim(ball, q=0.5e-3).u.round(3).tolist()  # N: the weight of 100 g
    [0.981]
    """
    x = plant.at(**positions).x
    return OperatingPoint(x, _hold(plant, x[None, :])[0], loaded=True)


def load_balance(plant: Plant, states: FloatArray) -> FloatArray:
    """The inputs that cancel the loads alone at rest: f(x, u, load(x)) = f(x, 0, 0); one row for each row of states.

    The controller balances the other forces, as the pull of a magnetic bearing off its centre.

    Raises CheckError when no input cancels the loads.
    """
    return _hold(plant, states, loads_alone=True)


def holding_forces(plant: Plant) -> FloatArray:
    """The forces v to command at the states' zero, so that their currents hold the machine there at rest.

    Solves 0 = f(0, forces(0, currents(h(0), v)), load(0)) by Newton's method, in the least-squares sense. A plant that
    is written about a point off its centre is thus held there, whatever its magnets pull with.

    Raises CheckError when no forces hold it.
    """
    kind = ca.MX if plant.tabulated else ca.SX
    x, v = kind(ca.DM.zeros(len(plant.states))), kind.sym("v", len(plant.inputs))
    i = plant.currents(plant.h(x, kind.zeros(len(plant.inputs))), v)
    rate = ca.densify(plant.f(x, plant.forces(x, i), plant.load(x)))
    residual = ca.Function("residual", [v], [rate, ca.jacobian(rate, v)])

    def rates(forces: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = (np.array(value) for value in residual(forces[0]))
        return r.T, J[None]

    (forces,) = _inputs_at_rest(plant, rates, ["it at rest"], steps=30)
    return np.asarray(forces)


def _hold(plant: Plant, states: FloatArray, *, loads_alone: bool = False) -> FloatArray:
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    rate = plant.f(x, u, plant.load(x))
    if loads_alone:
        rate -= plant.f(x, ca.SX.zeros(len(plant.inputs)), ca.SX.zeros(len(plant.disturbances)))
    if plant.second_order:
        for index in set(range(len(plant.states) // 2, len(plant.states))) - set(plant.controlled):
            rate[index] = 0  # an acceleration that no input holds
    size, count = len(plant.inputs), len(states)
    residual = ca.Function("residual", [x, u], [rate, ca.jacobian(rate, u)]).map(count)

    def rates(forces: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = (np.array(value) for value in residual(states.T, forces.T))
        return r.T, J.reshape(-1, count, size).swapaxes(0, 1)

    held = [f"the state {state.tolist()}" for state in states]
    # f is affine in the inputs of most machines: the second step only polishes
    return _inputs_at_rest(plant, rates, held, steps=2)


def _inputs_at_rest(
    plant: Plant,
    rates: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
    held: Sequence[str],
    *,
    steps: int,
) -> FloatArray:
    """The inputs where the rates vanish, by at most so many steps of Newton's method; one row for each state.

    rates : rows of inputs -> rows of rates, and their derivatives by the inputs

    Raises CheckError, which names what is `held`, when some rate is left.
    """
    u = np.zeros((len(held), len(plant.inputs)))
    moving = np.ones(len(held), dtype=bool)
    for _ in range(steps):
        r, J = rates(u)
        moving &= r.any(axis=1) & np.isfinite(r).all(axis=1)
        for k in np.flatnonzero(moving):
            u[k] -= np.linalg.lstsq(J[k], r[k], rcond=None)[0]
    left = np.abs(rates(u)[0]).max(axis=1)
    for what, most in zip(held, left.tolist(), strict=True):
        if not most <= 1e-9:  # m/s, rad/s, m/s2 or rad/s2
            found = f"it changes at up to {most:.3g} (SI) a second"
            raise CheckError(f"{plant.name}: no input holds {what}: {found}")
    return u
