"""Plant at an operating point -> linear model, by CasADi's exact derivatives.

xi' = A xi + B v,   p = C xi          eq. (19), xi = (q, q') without the uncontrolled states

Between samples the machine moves on, while the currents commutated for the last reading y_k are held:

xi' = A xi + B v + E (y_k - C xi)     E = 0 when forces do not depend on the position
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import CheckError, InputError
from malta.linear.system import System
from malta.model.equilibrium import with_command
from malta.model.plant import OperatingPoint, Plant, given_plant
from malta.model.readings import require_readings
from malta.model.traced import trace

ROUNDING = 1e-14  # of a slope, beside the others of its row and column


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel:
    """The linear model of a machine about an operating point: xi' = A xi + B v + E (y_k - C xi), p = C xi.

    y_k is the last reading: currents that are held between samples pull back to the place that they were made for.

    plant : the machine
    operating_point : the point
    A : n x n
    B : n x m, forces
    C : p x n
    E : n x p; zeros where nothing is held

    >>> import malta
    >>> plant = malta.plant_of(malta.read("data/tubular.toml"))
    >>> model = malta.linearize(plant, plant.at(z=0.0))
    >>> model.A.shape, model.B.shape
    ((10, 10), (10, 5))
    >>> f"{model.stiffness[0, 0] ** 0.5:.0f} rad/s"  # the unstable pole of x
    '219 rad/s'
    """

    plant: Plant
    operating_point: OperatingPoint
    A: FloatArray
    B: FloatArray
    C: FloatArray
    E: FloatArray

    def __post_init__(self) -> None:
        for name in "ABCE":
            object.__setattr__(self, name, readonly(getattr(self, name)))

    def __repr__(self) -> str:
        where = {
            s.name: v for s, v in zip(self.plant.states, self.operating_point.x.tolist(), strict=True) if v
        }
        kind = "trim" if self.operating_point.loaded else "no preload"
        return f"LinearModel({self.plant.name!r} at {where or 'the centre'}, {kind}, {len(self.A)} states)"

    @cached_property
    def sys(self) -> Any:
        """The model as a control.StateSpace with named states, inputs and outputs."""
        return self.system.to_control(self.plant.name)

    @property
    def system(self) -> System:
        """The model as a system with the names of its signals."""
        signals = self.plant.design_states, self.plant.inputs, self.plant.outputs
        names = (tuple(s.name for s in of) for of in signals)
        return System(self.A, self.B, self.C, np.zeros((len(self.C), self.B.shape[1])), None, None, *names)

    @property
    def stiffness(self) -> FloatArray:
        """The lower left block of A, q'' per q (1/s2): M^-1 S in the paper. Raises InputError for other states."""
        self.plant.require_second_order("stiffness")
        n = len(self.A) // 2
        return self.A[n:, :n]

    @property
    def force_map(self) -> FloatArray:
        """The lower half of B, q'' per v (1/kg): M^-1 V in the paper. Raises InputError for other states."""
        self.plant.require_second_order("force_map")
        return self.B[len(self.A) // 2 :]


def linearize(plant: Plant, point: OperatingPoint, believed: Plant | None = None) -> LinearModel:
    """Linearize x' = f(x, u, w), y = h(x, u), u = forces(x, currents(y, v)) at an operating point.

    The inputs of the model are commands: A, B and E are slopes of the whole chain from a command to the rates. They are
    taken at the command v that makes the inputs of the point, whatever the controller believes.

    At `plant.at(z=...)` the loads are left out, because v0(z) cancels them. At `trim(plant, z=...)` they act, and the
    model has the slopes of the loads and of the inputs that balance them. For the tubular machine these are m g / Ixx
    from z to alpha'' and the slope of the cogging in z''. Off the centre there is z f_D / Ixx in alpha'' and beta''.

    plant : the machine
    point : the operating point, from `plant.at`, `plant.point` or `malta.trim`
    believed : the machine with the controller's parameters; None: the plant itself. The inputs are the forces that the
        controller commands with these parameters.

    Returns a LinearModel, exact derivatives by CasADi; its operating point has the command v.

    Raises InputError when the point has the wrong size. Raises CheckError when no command makes its inputs or the
    Jacobian is not finite: without a `preload`, currents sqrt(v) have no slope at v = 0.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> model = malta.linearize(spec.plant, spec.plant.at())
    >>> sorted(model.sys.poles().real.round(1).tolist())  # rad/s
    [-120.0, 120.0]
    """
    plant = given_plant("linearize", plant)
    n, m = len(plant.states), len(plant.inputs)
    if point.x.shape != (n,) or point.u.shape != (m,):
        raise InputError(
            plant.name, "operating point", f"x {point.x.shape}, u {point.u.shape}", f"x ({n},), u ({m},)"
        )
    if not np.isfinite(point.x).all() or not np.isfinite(point.u).all():
        raise CheckError(f"{plant.name}: a state or a `preload` is not finite: x = {point.x}, u = {point.u}")

    require_readings(plant)
    point = with_command(plant, point, believed)
    derivatives = trace(_derivatives, plant, believed, point.loaded)
    A, B, C, E, _, ratio = derivatives(point.x, point.u, point.v)
    keep = list(plant.controlled)
    A, B, C, E = A[np.ix_(keep, keep)], _without_rounding(B[keep]), C[:, keep], E[keep]
    if not np.isfinite(ratio).all():
        raise CheckError(_without_slope(plant, point))
    if not all(np.isfinite(M).all() for M in (A, B, C, E)):
        raise CheckError(f"{plant.name}: the linear model is not finite at x = {point.x.tolist()}")
    return LinearModel(plant, point, A, B, C, E)


def _derivatives(plant: Plant, believed: Plant | None, loaded: bool) -> tuple[list[Any], list[Any]]:
    """(x, u, v) -> what `jacobians` returns, under the loads or without them."""
    kind = ca.MX if (believed or plant).actuator.tabulated else ca.SX
    sizes = {"x": len(plant.states), "u": len(plant.inputs), "v": len(plant.inputs)}
    x, u, v = (kind.sym(name, size) for name, size in sizes.items())
    w = plant.load(x) if loaded else kind.zeros(len(plant.disturbances))
    return [x, u, v], list(jacobians(plant, believed, x, u, v, w))


def _without_rounding(B: FloatArray) -> FloatArray:
    """B with zeros where forces(currents(v)) left what rounding makes, beside the largest of the row and the column."""
    size = np.abs(B)
    rows, columns = (np.sqrt(size.max(axis=k, keepdims=True, initial=0)) for k in (1, 0))
    return np.where(size > ROUNDING * rows * columns, B, 0.0)


def _without_slope(plant: Plant, point: OperatingPoint) -> str:
    """Why the currents have no slope, in a sentence."""
    assert point.v is not None
    at = ", ".join(
        f"{s.name} = {v:.4g} {s.unit}" for s, v in zip(plant.inputs, point.v.tolist(), strict=True)
    )
    found = f"{plant.name}: `currents` has no finite slope at the command {at}"
    if point.loaded:
        return f"{found}, which holds the machine"
    return f"{found}: the plant needs a `preload`, x -> inputs that act at its operating point"


def jacobians(
    plant: Plant, believed: Plant | None, x: Any, u: Any, v: Any, w: Any
) -> tuple[Any, Any, Any, Any, Any, Any]:
    """A, B, C and E for all states, the forces on the machine, and their ratio to the commands: expressions of x, u, v.

    The inputs u act; the controller commands the forces v, and their currents make the inputs. B contains the slope of
    what they make: 1 where `currents` is the inverse of `forces` and the controller has the machine's parameters. A
    contains the stiffness that commutation does not cancel: of coordinates that it ignores, as the tilt of a planar
    motor, or of parameters that differ.
    """
    C = ca.jacobian(plant.h(x, u), x)
    kind = type(x)
    y, i = kind.sym("y", C.shape[0]), kind.sym("i", len(plant.actuator.coils))
    made, wanted = plant.actuator.forces(x, i), (believed or plant).actuator.currents(y, v)
    here = ca.densify(plant.h(x, u))  # a coil may be zero always: substitute asks for equal patterns
    carried = ca.densify(ca.substitute([wanted], [y], [here])[0])

    def at(expression: Any) -> Any:
        return ca.substitute([expression], [y, i], [here, carried])[0]

    from_i, rate = ca.jacobian(made, i), plant.f(x, u, w)
    G, ratio = ca.jacobian(rate, u), at(from_i @ ca.jacobian(wanted, v))
    turned = at(from_i @ ca.jacobian(wanted, y))  # slope of the forces in the reading
    A = ca.jacobian(rate, x) + G @ (at(ca.jacobian(made, x)) + turned @ C)
    return A, G @ ratio, C, G @ turned, at(made), ratio
