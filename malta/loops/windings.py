"""The current loops as they run: the PI controllers of a gain file on the machine's windings, in units of forces.

    phi = M^+ i                                             axis currents, as the forces that are commanded for them
    L phi' = R_0 w - R phi - M^+ emf(x)                     w held for a sample: the windings of `Drive`
    R_0 w = Kp (v - phi) + I + M^+ emf(x_hat),              I+ = I + Ki T (v - phi)

M is the commutation of the controller's own machine at its operating point, axes x forces, R_0 the nominal resistance.
The controllers act alike in every axis, so that axes beside those of M are not excited. Under load the currents draw
power and the voltage V of the link answers: C V' = (V_0 - V) / R_s - P / V, with held duty cycles.

What `simulate` flies by default is this, see the test of its derivative. Machines without windings have first-order
lags at the crossover of their current loops, in simulations as well as here.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.errors import CheckError, InputError
from malta.linear.matrices import system_matrix
from malta.linear.sampling import delay_inputs, sample, sample_within
from malta.linear.uncertain import Compensator
from malta.model.currents import is_commutated
from malta.model.linearize import linearize
from malta.model.places import outputs_at
from malta.model.plant import OperatingPoint, Plant
from malta.model.plants import plant_of
from malta.model.traced import trace

if TYPE_CHECKING:
    from malta.synthesis.controller import Controller, CurrentLoop
    from malta.synthesis.linear_law import LinearLaw


CurrentLoops = Literal["lag", "pi"]
LAST_STAGE: CurrentLoops = "pi"  # the last stage: the loop that simulations fly by default
AXIS_TOLERANCE = 1e-9  # of the largest entry: what a map onto the commanded axes may leave


class WindingModel(NamedTuple):
    """The windings of a machine in units of forces."""

    R: float  # ohm, R_0
    modes: FloatArray  # coordinates of phi, m x m
    axes: FloatArray  # modes M^+, m x axes


class CurrentControl(NamedTuple):
    """The current controllers of a gain file and the windings that they see."""

    loop: CurrentLoop
    windings: WindingModel
    emf: tuple[FloatArray, FloatArray]  # M^+ emf(x_hat) of the law's states and of y; without rows: none


def chosen_loops(plant: Plant, controller: Controller, current_loops: CurrentLoops = "pi") -> CurrentLoops:
    """The model of the current loops: the PI controllers where a machine has windings and a gain file has them.

    Raises InputError for other words than lag and pi.
    """
    if current_loops not in get_args(CurrentLoops):
        raise InputError("verify", "current_loops", repr(current_loops), "lag or pi")
    return (
        "pi"
        if current_loops == "pi"
        and not _missing_current_loops(plant, controller)
        and _has_driven_windings(plant, controller)
        else "lag"
    )


def _has_driven_windings(plant: Plant, controller: Controller) -> bool:
    return plant.actuator.windings is not None and controller.current_loop is not None


BRAKING_TEXT = "the limited speed at which far errors are approached (braking)"


def left_out(plant: Plant, controller: Controller, current_loops: CurrentLoops = "pi") -> str:
    """What the machine's loop leaves out; "": nothing that simulations fly by default."""
    found = (
        _missing_current_loops(plant, controller, current_loops),
        BRAKING_TEXT if controller.braking.any() else "",
    )
    return ", and ".join(filter(None, found))


def _missing_current_loops(plant: Plant, controller: Controller, current_loops: CurrentLoops = "pi") -> str:
    """What it leaves out of the current loops."""
    if current_loops == "lag" and _has_driven_windings(plant, controller):
        return "the PI current controllers, for which first-order lags at their crossover stand"
    if plant.actuator.electronics is not None and plant.actuator.windings is None:
        return "the electronics' own current controllers, for which first-order lags at their crossover stand"
    if _has_driven_windings(plant, controller) and is_commutated(plant_of(controller.parameters)):
        return "PI current loops of currents that depend on the reading, for which first-order lags stand"
    return ""


@lru_cache(maxsize=16)  # plants compare by identity
def force_modes(believed: Plant) -> FloatArray:
    """Coordinates of forces in which a machine's positions move one by one at its centre: q'' = modes v, m x m."""
    half, m = believed.coordinates, len(believed.inputs)
    return linearize(believed, believed.at()).force_map if half == m else np.eye(m)


def windings_of(plant: Plant, believed: Plant, point: OperatingPoint, modes: FloatArray) -> WindingModel:
    """The windings at an operating point, as the controller's own machine commands them.

    Raises CheckError for a drive that induces voltages in axes that no force commands.
    """
    M = axis_map(believed, point)
    into = np.linalg.pinv(M)
    for machine in (plant, believed):
        slope = emf_slope(machine, point.x)
        if np.abs(slope - M @ into @ slope).max() > AXIS_TOLERANCE * np.abs(slope).max(initial=0.0):
            raise CheckError(
                f"{plant.name}: voltages are induced in axes of the drive that no force commands"
            )
    return WindingModel(float(plant.actuator.R), modes, modes @ into)


def current_control(controller: Controller, windings: WindingModel, point: OperatingPoint) -> CurrentControl:
    """The current controllers of a gain file at an operating point of the machine."""
    assert controller.current_loop is not None
    believed = plant_of(controller.parameters)
    slope = windings.axes @ emf_slope(believed, point.x)[:, list(believed.controlled)]
    return CurrentControl(
        controller.current_loop, windings, _estimate_slopes(controller, believed, slope, point.x)
    )


@lru_cache(maxsize=16)  # several parts of a loop need it; records compare by identity
def axis_map(plant: Plant, point: OperatingPoint) -> FloatArray:
    """M: the slope of the commanded axis currents by the commanded forces, axes x forces."""
    return readonly(trace(_axis_slope, plant)(point.x, _command(point))[0])


def _axis_slope(plant: Plant, _believed: None) -> tuple[list[Any], list[Any]]:
    """(x, v) -> M."""
    x, v = ca.SX.sym("x", len(plant.states)), ca.SX.sym("v", len(plant.inputs))
    axes = plant.drive.command(plant.actuator.currents(plant.h(x, 0), v))
    return [x, v], [ca.densify(ca.jacobian(axes, v))]


def _command(point: OperatingPoint) -> FloatArray:
    """The forces that are commanded at an operating point."""
    return point.u if point.v is None else point.v


def emf_slope(plant: Plant, x: FloatArray) -> FloatArray:
    """The slope of the induced voltages by the states, axes x states."""
    return np.asarray(trace(_emf_slope, plant)(x)[0])


def _emf_slope(plant: Plant, _believed: None) -> tuple[list[Any], list[Any]]:
    """x -> the slope."""
    x = ca.SX.sym("x", len(plant.states))
    return [x], [ca.densify(ca.jacobian(plant.drive.emf(x), x))]


def estimated_rows(slope: FloatArray, L: FloatArray, Cd: FloatArray) -> tuple[FloatArray, FloatArray]:
    """slope x_hat of xi_pred and of y, x_hat = xi_pred + L (y - Cd xi_pred): slope is of the first states."""
    n = slope.shape[1]
    return slope @ (np.eye(len(L))[:n] - L[:n] @ Cd), slope @ L[:n]


def _estimate_slopes(
    c: Controller, believed: Plant, slope: FloatArray, x: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """slope x_hat of the law's states and of y."""
    if not slope.any():
        return np.zeros((0, 0)), np.zeros((0, 0))
    if c.tracks == "states":
        return estimated_rows(slope, c.L, c.Cd)
    y = ca.SX.sym("y", len(c.measurements))
    here = outputs_at(believed, x)
    q = believed.position_of(y)
    P = np.array(ca.Function("P", [y], [ca.densify(ca.jacobian(q, y))])(here))
    direct = slope[:, : len(P)] @ P
    return (np.zeros((len(slope), 0)), direct) if direct.any() else (np.zeros((0, 0)), np.zeros((0, 0)))


def with_windings(plant: Plant, k: WindingModel, x: Any, A: Any, B: Any, C: Any) -> tuple[Any, Any, Any]:
    """A, B and C (CasADi) with the windings: states (x, phi), inputs w, outputs (y, phi).

    plant : the machine, whose parameters may be symbols
    x : its states at the operating point
    A, B, C : of the states of the design model, and then of the readings of late sensors; inputs are forces
    """
    z, kind, m = ca.SX.sym("x", len(plant.states)), ca.SX, len(k.modes)
    R, L = plant.actuator.R, plant.actuator.L
    (emf,) = ca.substitute([ca.jacobian(plant.drive.emf(z), z)], [z], [kind(x)])
    induced = ca.DM(k.axes) @ emf[:, list(plant.controlled)]
    induced = ca.horzcat(induced, kind(m, A.shape[1] - induced.shape[1]))
    acting = kind(B) @ ca.DM(np.linalg.inv(k.modes))
    return (
        system_matrix(kind(A), acting, -induced / L, -R / L * kind.eye(m)),
        ca.vertcat(kind(*B.shape), k.R / L * kind.eye(m)),
        ca.diagcat(kind(C), kind.eye(m)),
    )


def with_estimated_emf(law: LinearLaw, emf: tuple[FloatArray, FloatArray]) -> LinearLaw:
    """The law with M^+ emf(x_hat) as further outputs: rows of its first states and of its first inputs y."""
    C, D = emf
    D = np.hstack([D, np.zeros((len(D), law.D_y.shape[1] - D.shape[1]))])
    C = np.hstack([C, np.zeros((len(C), len(law.A) - C.shape[1]))]) if len(C) else np.zeros((0, len(law.A)))
    D = D if len(D) else np.zeros((0, law.D_y.shape[1]))
    return law._replace(
        C=np.vstack([law.C, C]),
        D_y=np.vstack([law.D_y, D]),
        D_r=np.vstack([law.D_r, np.zeros((len(C), law.D_r.shape[1]))]),
    )


def forecast_as_forces(law: LinearLaw, k: CurrentControl, Ts: float) -> LinearLaw:
    """The law whose forces contain those that make the current controllers answer with the voltages that it forecasts.

    The controllers make u of forces by Kp + Ki Ts z / (z - 1) = (gain z - Kp) / (z - 1), so that a voltage e takes
    forces of (z - 1) / (gain z - Kp) e. The zero of the controllers becomes a pole of the law, which it cancels.
    """
    both, m, gain = with_estimated_emf(law, k.emf), len(law.C), k.loop.Kp + k.loop.Ki * Ts
    C_e, D_e, a = both.C[m:] / gain, both.D_y[m:] / gain, k.loop.Kp / gain
    rows = np.flatnonzero(np.hstack([C_e, D_e]).any(axis=1))
    C_e, D_e, into = C_e[rows], D_e[rows], np.eye(m)[:, rows]
    r = law.B_r.shape[1]
    return law._replace(
        A=system_matrix(law.A, None, (a - 1) * C_e, a * np.eye(len(rows))),
        B_y=np.vstack([law.B_y, (a - 1) * D_e]),
        B_r=np.vstack([law.B_r, np.zeros((len(rows), r))]),
        C=np.hstack([law.C + into @ C_e, into]),
        D_y=law.D_y + into @ D_e,
    )


class Caught(NamedTuple):
    """Readings C x that are taken some time (s) after each sample; of the sampled machine they are states."""

    C: FloatArray
    time: float

    def add_to(
        self, machine: tuple[FloatArray, FloatArray], Ts: float, delay: float
    ) -> tuple[FloatArray, FloatArray]:
        """A and B of a machine, sampled, with what was caught in the last sample behind its states."""
        (Ad, Bd), (x, u) = sample(*machine, Ts, delay), sample_within(*machine, Ts, delay, self.time)
        C = np.hstack([self.C, np.zeros((len(self.C), len(x) - self.C.shape[1]))])
        return system_matrix(Ad, None, C @ x, np.zeros((len(C),) * 2)), np.vstack([Bd, C @ u])


def sample_driven(
    machine: tuple[FloatArray, FloatArray, FloatArray],
    loop: CurrentLoop,
    R: float,
    Ts: float,
    delay: float,
    share: FloatArray | None = None,
    caught: Caught | None = None,
) -> tuple[FloatArray, FloatArray]:
    """The machine behind its current controllers, sampled: from forces v, and then from voltages M^+ emf(x_hat).

    machine : A, B of w, and the matrix of phi of the continuous machine with its windings
    R : ohm, R_0
    share : of w in the last state, the link's voltage, which a duty cycle counts in; None: that is no state
    caught : readings that are taken within a sample; None: none are

    States are those of the machine, of w under way, readings that were caught, and the integrals I.
    """
    A, B, phi = machine
    m = B.shape[1]
    Ad, Bd = sample(A, B, Ts, delay) if caught is None else caught.add_to((A, B), Ts, delay)
    read = np.zeros((m, len(Ad)))
    read[:, : len(A)] = -(loop.Kp + loop.Ki * Ts) / R * phi
    if share is not None:
        read[:, len(A) - 1] -= share
    sums = np.zeros((m, len(Ad)))
    sums[:, : len(A)] = -loop.Ki * Ts * phi
    one, gain = np.eye(m), loop.Kp + loop.Ki * Ts
    closed = system_matrix(Ad + Bd @ read, Bd / R, sums, one)
    return closed, system_matrix(gain / R * Bd, Bd / R, loop.Ki * Ts * one)


def with_current_control(c: Compensator, k: CurrentControl, late: int = 0) -> Compensator:
    """The law (v, M^+ emf(x_hat)) in series with the current controllers: inputs (y, phi), outputs w.

    late : samples by which y is read late; phi is read at once
    """
    c, Ts = _read_late(c, late), c.sample_time
    assert Ts is not None
    R, S = k.windings.R, k.windings.modes
    m, slope, gain = len(S), k.loop.Ki * Ts, k.loop.Kp + k.loop.Ki * Ts
    C, C_e, D, D_e = S @ c.C[:m], c.C[m:], S @ c.D[:m], c.D[m:]
    if not len(C_e):
        C_e, D_e = np.zeros_like(C), np.zeros_like(D)
    one, p = np.eye(m), D.shape[1]
    A = system_matrix(c.A, None, slope * C, one)
    B = system_matrix(c.B, None, slope * D, -slope * one)
    order = _before_integrals(len(c.A), m, c.integrals)
    return replace(
        c,
        A=A[np.ix_(order, order)],
        B=B[order].reshape(len(order), p + m),
        C=np.hstack([gain * C + C_e, one])[:, order] / R,
        D=np.hstack([gain * D + D_e, -gain * one]) / R,
        lag=None,
    )


def _read_late(c: Compensator, late: int) -> Compensator:
    """The law with readings that are `late` samples old."""
    if not late:
        return c
    stored = c.B.shape[1] * late
    A, B = delay_inputs(c.A, c.B, late)
    C = np.hstack([c.C, c.D, np.zeros((len(c.C), stored - c.D.shape[1]))])
    order = _before_integrals(len(c.A), stored, c.integrals)
    return replace(c, A=A[np.ix_(order, order)], B=B[order], C=C[:, order], D=np.zeros_like(c.D))


def _before_integrals(n: int, added: int, integrals: int) -> list[int]:
    """The order of n states with `added` ones behind them that takes the last `integrals` of the n to the end."""
    return [*range(n - integrals), *range(n, n + added), *range(n - integrals, n)]


class DcLink(NamedTuple):
    """The voltage of the link under load, as it answers and acts: deviations about rest."""

    rate: float  # 1/s, of V' in V
    by_phi: FloatArray  # of V' in phi, V/(N s)
    by_w: FloatArray  # of V' in w
    share: FloatArray  # of w in V: u / V at rest, in forces over R_0


def link_at_rest(plant: Plant, k: WindingModel, point: OperatingPoint, M: FloatArray) -> DcLink | None:
    """The link of a machine that holds its loads; None where no current flows, and the link has no part in the loop."""
    drive, R = plant.drive, plant.actuator.R
    y = plant.h(ca.DM(point.x), 0)
    i = np.array(ca.DM(drive.command(plant.actuator.currents(y, ca.DM(_command(point)))))).ravel()
    u, weight = R * i, np.array(drive.weight)
    power, Rs, V0 = float(weight @ (u * i)), drive.supply_resistance, drive.link_voltage
    if power == 0:
        return None
    if not 4 * Rs * power < V0**2:
        raise CheckError(f"{plant.name}: the supply cannot hold the machine's loads")
    V = (V0 + math.sqrt(V0**2 - 4 * Rs * power)) / 2
    C = drive.link_capacitance
    share = k.axes @ u / (k.R * V)
    return DcLink(-1 / (Rs * C), -(weight * u) @ M / (C * V), -(weight * i) @ M * k.R / (C * V), share)
