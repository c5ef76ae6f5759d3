"""The fastest stroke that the drive's limits allow, and the sigmoid of the same peak current to compare it with.

    minimize T    subject to    z' = v,   v' = a(z, v, k i),   L i' = u - R i - K_ind v,
                                |i| <= i_max,   |u| <= u_max,   |u'| <= 2 u_max / Ts,
                                and rest at both ends: v = 0, i holds the load, u = R i

a is the plant's own equation of the stroke axis, cogging included. i and u are the axis quantities of one module, and k
is the thrust of all modules over i. The current controllers, with period Ts, take at least one period to move u from
limit to limit. So u is continuous, i and z'' are smooth, and the optimum does not depend on the mesh.

Transcription: Hermite–Simpson collocation (fourth order), u linear in each interval, |i| limited at the Bézier points
of its cubics and so between the nodes too. The mesh divides the free T in fixed shares: without cogging, the strokes of
a given T are then a convex set. IPOPT solves the problem; the mesh is refined where u changes, and the problem solved
again, until T converges.

The model neglects the voltage that the moving axes of a winding induce in each other, at right angles to u. A
voltage_share below 1 leaves room for this voltage, and a current_share below 1 leaves room for the controller.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from scipy.integrate import solve_ivp

from malta.arrays import FloatArray, readonly
from malta.display import Curves, Description, display, quantity
from malta.errors import CheckError, InputError
from malta.model.plant import Plant
from malta.simulation import references

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

ROUNDS = 8  # meshes, at most
MAX_LAST_CHANGE = 5e-4  # share of T by which the last mesh may still change T
TOLERANCE = 1e-3  # of a state's range and of the current limit, between the nodes
IPOPT = {"print_level": 0, "sb": "yes", "max_iter": 500, "mu_strategy": "adaptive"}


@display
@dataclass(frozen=True, eq=False)
class FastestStroke:
    """A stroke at the nodes of its mesh, at rest at the first and at the last node; u is linear between nodes."""

    t: FloatArray  # s, from 0
    z: FloatArray  # m
    v: FloatArray  # m/s
    a: FloatArray  # m/s2
    i: FloatArray  # A
    u: FloatArray  # V

    def __post_init__(self) -> None:
        for name in ("t", "z", "v", "a", "i", "u"):
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def duration(self) -> float:
        """T, s."""
        return float(self.t[-1])

    @property
    def rise(self) -> float:
        """10 to 90 % of the travel, s."""
        return self.travel_time(0.1)

    def travel_time(self, share: float) -> float:
        """From `share` of the travel to 1 - `share`, s."""
        _check_share(share)
        return self._time_at(1 - share) - self._time_at(share)

    @cached_property
    def path(self) -> PPoly:
        """z(t), m: quintics through z, v and a at the nodes, so that the second derivative is continuous."""
        nodes = np.column_stack([self.z, self.v, self.a])
        from scipy.interpolate import BPoly, PPoly  # here: it takes long to load

        return PPoly.from_bernstein_basis(BPoly.from_derivatives(self.t, nodes))

    def reference(self, plant: Plant, centre: float) -> references.Reference:
        """The stroke as a reference: half-way at `centre` (s), at rest outside; the other outputs stay at zero.

        The feedforward m z'' + v0(z) of a gain file is then the optimum's thrust k i: z'' contains the effect of
        cogging, and v0(z) cancels it. A Scenario takes `partial(stroke.reference, centre=0.05)`.
        """
        start = centre - self._time_at(0.5)
        return partial(_motion, self.path, start, plant.stroke_output, len(plant.outputs))

    def _time_at(self, share: float) -> float:
        """The time (s) at which the mover reaches a share of the travel."""
        level = self.z[0] + share * (self.z[-1] - self.z[0])
        return float(self.path.solve(level, extrapolate=False)[0])

    @property
    def description(self) -> Description:
        """Its duration and its largest speed, acceleration, current and voltage."""
        units = {"v": "m/s", "a": "m/s2", "i": "A", "u": "V"}
        rows = [
            ("rise, 10-90 %", quantity(self.rise, "s")),
            ("travel", quantity(self.z[-1] - self.z[0], "m")),
        ]
        rows += [
            (f"largest {name}", quantity(float(np.abs(getattr(self, name)).max()), unit))
            for name, unit in units.items()
        ]
        curves = Curves(
            self.t,
            "time [s]",
            {"z": self.z / self.z[-1], "i": self.i / np.abs(self.i).max()},
            "share of the largest [1]",
        )
        return Description(f"FastestStroke of {quantity(self.duration, 's')}", tuple(rows), curves)


@dataclass(frozen=True)
class SigmoidStroke:
    """A stroke along the logistic of references.py."""

    rise: float  # s, 10 to 90 %
    current: float  # A, peak
    voltage: float  # V, peak

    def travel_time(self, share: float) -> float:
        """From `share` of the travel to 1 - `share`, s."""
        _check_share(share)
        return self.rise * math.log(1 / share - 1) / math.log(9)


def fastest_stroke(
    plant: Plant,
    distance: float,
    emf_constant: float,
    *,
    voltage_share: float = 1.0,
    current_share: float = 1.0,
    intervals: int = 150,
) -> FastestStroke:
    """Find the stroke that takes the least time within the drive's limits of current and voltage, and of its slew.

        minimize T    subject to    z'' = a(z, z', k i),   L i' = u - R i - K_ind z',
                                    |i| <= i_max,   |u| <= u_max,   |u'| <= 2 u_max / Ts

    IPOPT solves the collocated problem on meshes that are refined until T converges; the optimum is then integrated
    between the nodes and compared.

    plant : the machine, with a stroke and current loops
    distance : m, either sign, symmetric about the middle
    emf_constant : K_ind, induced voltage of one module's axis over speed, V s/m
    voltage_share : of the actuator's limit, above 0, at most 1
    current_share : of the actuator's limit, above 0, at most 1
    intervals : of the mesh

    Returns a FastestStroke: t (s), z (m), v (m/s), a (m/s2), i (A), u (V) at the nodes, with `rise` and `duration` (s).

    Raises InputError for arguments that do not fit the plant. Raises CheckError without an optimum, when the last mesh
    still changes T by 0.05 %, or when the equations, integrated between the nodes, miss the next one or the limits.

    >>> import malta
    >>> parameters = malta.read("data/tubular.toml")
    >>> plant = malta.plant_of(parameters)
    >>> fastest = malta.simulation.fastest_stroke(plant, 10e-3, parameters.K_ind)
    >>> f"{fastest.duration * 1e3:.1f} ms, 10 to 90 % in {fastest.rise * 1e3:.1f} ms"
    '17.4 ms, 10 to 90 % in 9.3 ms'
    """
    i_max, u_max = _limits(plant, distance, emf_constant, voltage_share, current_share)
    if not (isinstance(intervals, int) and 20 <= intervals <= 2000):
        raise InputError("stroke", "intervals", repr(intervals), "a whole number from 20 to 2000")
    actuator, k = plant.actuator, plant.actuator.force_constant[plant.thrust_input]
    z, v, i, u = (ca.SX.sym(name) for name in "zviu")
    slope = (u - actuator.R * i - emf_constant * v) / actuator.L
    rate = ca.Function("rate", [ca.vertcat(z, v, i, u)], [ca.vertcat(v, _axis(plant)(z, v, k * i), slope)])
    z_ends, rest = np.array([-distance / 2, distance / 2]), np.zeros(2)
    i_ends = _current(plant, z_ends, rest, rest)
    ends = np.array([z_ends, rest, i_ends, actuator.R * i_ends])
    # First guess of T: bang-bang at a current that the voltage allows, plus terms of inductance and induced voltage.
    i_typical = i_max * u_max / (u_max + actuator.R * i_max)
    T = 2 * math.sqrt(abs(distance) * plant.stroke.mass / (k * i_typical))
    T += (4 * actuator.L * i_typical + emf_constant * abs(distance)) / u_max
    scale = np.array([abs(distance), 2 * abs(distance) / T, i_max, u_max])
    s: FloatArray = np.linspace(0, 1, intervals + 1)
    guess = np.array([s**2 * (3 - 2 * s) - 0.5, 3 * s * (1 - s), 1 - 2 * s, 0 * s]) * scale[:, None]
    solve = partial(_optimum, rate, ends, scale, actuator.sample_time)
    s, x, T = _solve_on_refined_meshes(solve, s, math.copysign(1, distance) * guess, T)
    _check(rate, T * s, x, scale)
    a = np.array(rate(x))[1]
    a[[0, -1]] = 0.0  # exactly at rest
    return FastestStroke(T * s, x[0], x[1], a, x[2], x[3])


def sigmoid_at_peak_current(
    plant: Plant,
    distance: float,
    emf_constant: float,
    *,
    voltage_share: float = 1.0,
    current_share: float = 1.0,
) -> SigmoidStroke:
    """The logistic stroke whose peak current, for inertia and cogging, is the limit. Arguments as of fastest_stroke.

    Raises InputError for arguments that do not fit the plant, CheckError when the stroke needs more than the voltage.
    """
    i_max, u_max = _limits(plant, distance, emf_constant, voltage_share, current_share)
    grid = np.linspace(-4, 4, 20_001)  # in rises: 2e-8 of the way lies outside

    def demand(rise: float) -> tuple[FloatArray, FloatArray]:
        s, ds, dds = references.logistic(grid * rise, rise)
        v = distance * ds
        return _current(plant, distance * (s - 0.5), v, distance * dds), v

    def excess(rise: float) -> float:
        return float(np.abs(demand(rise)[0]).max()) - i_max

    # Without a load, |z''| peaks at d (2 ln 9 / rise)^2 / (6 sqrt 3). The load moves the rise between two bounds.
    held, k = _holding_current(plant, distance), plant.actuator.force_constant[plant.thrust_input]
    inertia = plant.stroke.mass * abs(distance) * (2 * math.log(9)) ** 2 / (6 * math.sqrt(3) * k)
    quickest, slowest = math.sqrt(inertia / (i_max + held)), math.sqrt(inertia / (i_max - held))
    from scipy.optimize import brentq  # here: it takes long to load

    rise = float(brentq(excess, 0.999 * quickest, 1.001 * slowest, xtol=1e-12))
    i, v = demand(rise)
    u = plant.actuator.L * np.gradient(i, grid * rise) + plant.actuator.R * i + emf_constant * v
    stroke = SigmoidStroke(rise, float(np.abs(i).max()), float(np.abs(u).max()))
    if not stroke.voltage <= u_max:
        raise CheckError(
            f"sigmoid: the stroke at {i_max:g} A takes {stroke.voltage:.3g} V, more than {u_max:.3g} V"
        )
    return stroke


def _optimum(
    rate: ca.Function,
    ends: FloatArray,
    scale: FloatArray,
    Ts: float,
    s: FloatArray,
    guess: FloatArray,
    T_guess: float,
) -> tuple[FloatArray, float]:
    """x and T on the nodes s (shares of T), from a guess. x holds z, v, i and u, a column for each node."""
    opti, n = ca.Opti(), len(s) - 1
    inner, T = opti.variable(4, n - 1), opti.variable()  # x over scale, T over its guess
    x = ca.horzcat(ends[:, 0] / scale, inner, ends[:, 1] / scale)
    h = T_guess * T * ca.DM(np.diff(s)).T

    def slopes(columns: ca.MX) -> ca.MX:
        return ca.diag(1 / scale[:3]) @ rate(ca.diag(scale) @ columns)

    x0, x1, f = x[:, :-1], x[:, 1:], slopes(x)
    f0, f1, H = f[:, :-1], f[:, 1:], ca.repmat(h, 3, 1)
    middle = (x0 + x1) / 2 + ca.vertcat(H / 8 * (f0 - f1), ca.MX(1, n))
    opti.minimize(T)
    opti.subject_to(T >= 1e-3)
    opti.subject_to(ca.vec((x1 - x0)[:3, :] - H / 6 * (f0 + 4 * slopes(middle) + f1)) == 0)
    # With the ends, these points span the hull of the cubic i.
    bezier = (x0[2, :] + h / 3 * f0[2, :], x1[2, :] - h / 3 * f1[2, :])
    for limited in (inner[2:, :], *bezier):
        opti.subject_to(opti.bounded(-1, ca.vec(limited), 1))
    for change in ((x1 - x0)[3, :], (x0 - x1)[3, :]):
        opti.subject_to(ca.vec(change - 2 / Ts * h) <= 0)
    opti.set_initial(inner, guess[:, 1:-1] / scale[:, None])
    opti.set_initial(T, 1)
    opti.solver("ipopt", {"print_time": False}, IPOPT)
    with suppress(RuntimeError):  # the status says more
        opti.solve()
    if opti.return_status() != "Solve_Succeeded":
        raise CheckError(f"fastest stroke: IPOPT ended with {opti.return_status()}")
    return scale[:, None] * np.array(opti.value(x)), T_guess * float(opti.value(T))


def _solve_on_refined_meshes(
    solve: Callable[[FloatArray, FloatArray, float], tuple[FloatArray, float]],
    s: FloatArray,
    x: FloatArray,
    T: float,
) -> tuple[FloatArray, FloatArray, float]:
    """Nodes, x and T on the first mesh that changes T by less than MAX_LAST_CHANGE. CheckError after ROUNDS meshes."""
    x, T = solve(s, x, T)
    for _ in range(ROUNDS - 1):
        # The same number of nodes: half of them spread over T, half over the changes of u.
        change = np.abs(np.diff(x[3]))
        weight = np.concatenate([[0.0], np.cumsum(np.diff(s) + change / change.sum())])
        finer = np.interp(np.linspace(0, 1, len(s)), weight / weight[-1], s)
        guess = np.array([np.interp(finer, s, row) for row in x])
        s, T_before = finer, T
        x, T = solve(s, guess, T)
        if abs(T - T_before) <= MAX_LAST_CHANGE * T:
            return s, x, T
    raise CheckError(f"fastest stroke: T still changes after {ROUNDS} meshes")


def _check(rate: ca.Function, t: FloatArray, x: FloatArray, scale: FloatArray) -> None:
    """Integrate from each node to the next. CheckError for gaps at the nodes, or a current beyond its limit."""
    h, n = np.diff(t), len(t) - 1

    def slopes(s: float, flat: FloatArray) -> FloatArray:
        u = (1 - s) * x[3, :-1] + s * x[3, 1:]
        return np.asarray(h * np.array(rate(np.vstack([flat.reshape(3, n), u])))).ravel()

    run = solve_ivp(slopes, (0, 1), x[:3, :-1].ravel(), rtol=1e-8, atol=1e-10, t_eval=np.linspace(0, 1, 11))
    between = run.y.reshape(3, n, -1)
    gap = float((np.abs(between[:, :, -1] - x[:3, 1:]).sum(axis=1) / scale[:3]).max())
    beyond = float(np.abs(between[2]).max()) / scale[2] - 1
    if not (run.success and gap <= TOLERANCE and beyond <= TOLERANCE):
        raise CheckError(
            f"fastest stroke: with {n} intervals, what lies between the nodes misses them by {gap:.2g} and the "
            f"current limit by {beyond:.2g}, {TOLERANCE:g} is allowed"
        )


def _limits(
    plant: Plant, distance: float, emf_constant: float, voltage_share: float, current_share: float
) -> tuple[float, float]:
    """i_max (A) and u_max (V). InputError for arguments out of range, or limits that cannot hold the load."""
    if not 0 < abs(distance) <= 2 * plant.stroke.travel:
        expected = f"one other than 0 m within the travel of +-{plant.stroke.travel} m"
        raise InputError("stroke", "distance", f"{distance} m", expected)
    if not 0 <= emf_constant < math.inf:
        raise InputError("stroke", "emf_constant", f"{emf_constant} V s/m", "a finite number, 0 or more")
    for name, share in (("voltage_share", voltage_share), ("current_share", current_share)):
        if not 0 < share <= 1:
            raise InputError("stroke", name, str(share), "a share above 0, at most 1")
    i_max, u_max = current_share * plant.actuator.current_limit, voltage_share * plant.actuator.voltage_limit
    held = _holding_current(plant, distance)
    if not (held < i_max and plant.actuator.R * held < u_max):
        expected = f"more than holds the load on the way: {held:.3g} A, {plant.actuator.R * held:.3g} V"
        raise InputError("stroke", "limits", f"{i_max:.3g} A, {u_max:.3g} V", expected)
    return i_max, u_max


def _check_share(share: float) -> None:
    """InputError for a share of the travel outside 0 to 0.5."""
    if not 0 < share < 0.5:
        raise InputError("travel_time", "share", str(share), "a share of the travel above 0, below 0.5")


def _axis(plant: Plant) -> ca.Function:
    """(z, v, F) -> z'' of the stroke under its load, other states zero. InputError where other inputs act along it."""
    z, v, u = ca.SX.sym("z"), ca.SX.sym("v"), ca.SX.sym("u", len(plant.inputs))
    x, rate = ca.SX.zeros(len(plant.states)), plant.stroke_state + len(plant.states) // 2
    x[plant.stroke_state], x[rate] = z, v
    acceleration = plant.f(x, u, plant.load(x))[rate]
    F = u[plant.thrust_input]
    others = ca.vertcat(*(u[j] for j in range(u.numel()) if j != plant.thrust_input))
    if ca.depends_on(acceleration, others):
        found, expected = "an axis that other inputs push", f"{plant.stroke.thrust} alone"
        raise InputError(plant.name, plant.stroke.name, found, expected)
    return ca.Function("axis", [z, v, F], [acceleration])


def _current(plant: Plant, z: FloatArray, v: FloatArray, a: FloatArray) -> FloatArray:
    """i (A) that accelerates the mover by `a`: z'' is affine in the thrust, with the slope 1 / m."""
    free = np.array(_axis(plant)(z[None], v[None], 0.0)).ravel()
    return np.asarray(plant.stroke.mass * (a - free) / plant.actuator.force_constant[plant.thrust_input])


def _holding_current(plant: Plant, distance: float) -> float:
    """The largest |i| (A) that is needed to hold the load along the way."""
    z = distance * np.linspace(-0.5, 0.5, 2001)
    return float(np.abs(_current(plant, z, 0 * z, 0 * z)).max())


def _motion(path: PPoly, start: float, axis: int, outputs: int, t: FloatArray) -> references.Motion:
    """The motion of output `axis` along a path that begins at `start` (s)."""
    s = np.clip(np.asarray(t) - start, path.x[0], path.x[-1])
    moving = (s > path.x[0]) & (s < path.x[-1])
    motion = [np.zeros((len(s), outputs)) for _ in range(3)]
    for order, column in enumerate(motion):
        column[:, axis] = np.where(moving | (order == 0), path(s, nu=order), 0.0)
    return references.Motion(*motion)
