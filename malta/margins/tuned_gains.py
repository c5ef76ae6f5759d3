"""How far the feedback gains of a controller may be tuned while the margin of its machine stays proven.

Factors k on the rows of K and Ki, one for the forces of each axis, are parameters of the proof beside the machine's.
The filter knows the forces that are commanded, k times those of the design, so a factor on the machine's inputs would
be another loop. An echo makes k a parameter of the system: further states c of the system take what the design's gains
command, v_n, within a sample, and the law reads k c at the next one:

    c' = -a c + a v_n,  e^(-a Ts) = 2e-22         v(i) = v_1(i) + k c(i + 1),  v_1: by gains of 1, which stay

The commands of a sample act on the machine a sample later, which is the time that the echo takes: at sample i + 1 the
law does what was left to be done with v(i). At k = 1 the loop is the machine's own, but for 2e-22 of an old echo.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import casadi as ca
import numpy as np

from malta.budget import Budget
from malta.linear.matrices import system_matrix
from malta.linear.system import System
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.feedforward_along import slopes_along
from malta.loops.windings import LAST_STAGE, chosen_loops, current_control, force_modes, windings_of
from malta.margins.travel import travel_loops
from malta.model.currents import is_commutated
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.proof.box import box_of
from malta.proof.groups import groups, loop_of
from malta.proof.margin import Ranges
from malta.proof.robust import robust_margin
from malta.synthesis.controller import Controller
from malta.synthesis.linear_law import linear_law, with_forces_read

FACTOR = "gain factor"  # the name of the further parameter
MAX_SCATTER = 0.2  # share by which gains may scatter at most: nothing beyond is looked at
MAX_RATE = 50.0  # a Ts
WORK = 600.0  # of the search
TOLERANCE = 0.02  # relative distance between the proven bound and the witness


class GainBox(NamedTuple):
    """What is proven of gains: rows of K and Ki times a factor of each axis within 1 +- share, other gains as designed.

    share : None where nothing is proven
    axes : of each, the forces by index
    reason : why nothing is proven; "": it is
    searched : whether the search found the end; False: nothing beyond was looked at
    """

    share: float | None
    axes: tuple[tuple[int, ...], ...] = ()
    reason: str = ""
    searched: bool = True


@on_one_thread
def gain_box(plant: Plant, controller: Controller, uncertainty: Ranges) -> GainBox:
    """The largest scatter of the gains, at most MAX_SCATTER, within which the loop is proven stable over the box.

    plant : the machine
    uncertainty : shares of the machine's parameters, as in a design file; all hold at once, anywhere in the travel

    Example: `gain_box(plant, controller, {"m": 0.2}).share`
    """
    reason = _unfit(plant, controller, uncertainty)
    if reason:
        return GainBox(None, (), reason)
    along, over = travel_loops(plant, controller, tuple(uncertainty))
    if len(along) > 1:
        return GainBox(None, (), "its model along the travel is too long to be enclosed")
    system, law = tuned_loop(plant, controller, along[0][0])
    sides = box_of(system.names, system.nominal, system.limits, uncertainty, {}, caller="gain_box")
    box = {
        name: (float(v - down), float(v + up))
        for name, v, down, up in zip(sides.names, sides.nominal, sides.down, sides.up, strict=True)
        if name in uncertainty
    }
    found = robust_margin(
        system, law, {FACTOR: MAX_SCATTER}, {**over, **box}, tolerance=TOLERANCE, budget=Budget(WORK)
    )
    if found.lower is None:
        return GainBox(None, (), found.reason or "the loop is not stable for the whole uncertainty")
    forces, first = len(controller.forces), system.matrices.size1_out(0) - len(controller.forces)
    split = (tuple(j for j in range(forces) if first + j in g.states) for g in groups(loop_of(system, law)))
    axes = tuple(axis for axis in split if axis)
    return GainBox(min(found.lower, 1.0) * MAX_SCATTER, axes, searched=found.lower < 1 and not found.reason)


def _unfit(plant: Plant, c: Controller, uncertainty: Ranges) -> str:
    """Why the proof does not know a loop of this kind; "": it does."""
    believed = plant_of(c.parameters)
    if not uncertainty:
        return "the gain file has no uncertainty"
    if c.tracks != "states":
        return "a law of errors has no gains K and L"
    if chosen_loops(plant, c, LAST_STAGE) != "pi" or plant.actuator.delay(c.sample_time) != 1:
        return "its commands do not act a sample later by PI current loops"
    if is_commutated(believed) or plant.sensors.late:
        return "its currents are held for a reading, or its sensors read late"
    if (np.abs(c.Ki) == 1).any():
        return "an entry of Ki is 1, which no factor changes"
    return ""


def _open_law(c: Controller) -> System:
    """The law with the tuned part of its forces as an input q after y, and an output v_n before the fixed part v_1.

    Steps 1 to 6 of synthesis/controller.py, deviations alone: states xi_pred, and e where it is fed back.
    """
    n, m, p, Ts = len(c.states), len(c.forces), len(c.measurements), c.sample_time
    summed = list(c.summed)
    sums = len(summed)
    hat = np.hstack([np.eye(n) - c.L @ c.Cd, np.zeros((n, sums))]), c.L
    total = np.hstack([np.zeros((sums, n)), np.eye(sums)]), -Ts * np.eye(p)[summed]
    unity = np.where(np.abs(c.K) == 1, c.K, 0.0)
    Ki = c.Ki[:, summed]
    C, D = (-(c.K - unity) @ x + Ki @ e for x, e in zip(hat, total, strict=True))
    C_1, D_1 = (-unity @ x for x in hat)
    A, B = (np.vstack([c.Ad @ x + c.Bd @ one, e]) for x, one, e in zip(hat, (C_1, D_1), total, strict=True))
    B, none = np.hstack([B, np.vstack([c.Bd, np.zeros((sums, m))])]), np.zeros((m, m))
    return System(A, B, np.vstack([C, C_1]), system_matrix(D, none, D_1, none), None, Ts)


def tuned_loop(plant: Plant, c: Controller, system: UncertainSystem) -> tuple[UncertainSystem, Compensator]:
    """The machine with its echoes and one more parameter, and the law in its current loops, a sample behind."""
    m, p, Ts = len(c.forces), len(c.measurements), c.sample_time
    believed = plant_of(c.parameters)
    windings = windings_of(plant, believed, plant.at(), force_modes(believed))
    k, law = current_control(c, windings, plant.at()), _open_law(c)
    R, S, n = windings.R, windings.modes, len(law.A)
    slope, gain, one = k.loop.Ki * Ts, k.loop.Kp + k.loop.Ki * Ts, np.eye(m)
    emf = np.zeros((m, n)), np.zeros((m, p))
    if len(k.emf[0]):
        emf[0][:, : k.emf[0].shape[1]], emf[1][:] = k.emf
    (C_n, C_1), (D_n, D_1), law_B = np.split(law.C, 2), np.split(law.D[:, :p], 2), law.B[:, :p]
    B_q = np.vstack([law.B[:, p:], slope * S])
    # v0 that follows the position is read behind the outputs, see feedforward_along.py
    slopes = slopes_along(plant, c) if plant.stroke.name in system.names else None
    if slopes is not None:
        read, still = with_forces_read(linear_law(c), slopes.forces, m), np.zeros((m, len(slopes.forces)))
        law_B, D_1 = np.hstack([law_B, read.B_y[:, p:]]), np.hstack([D_1, read.D_y[:, p:]])
        D_n, emf, p = np.hstack([D_n, still]), (emf[0], np.hstack([emf[1], still])), p + len(slopes.forces)
    # as with_current_control: inputs y and phi, further states I, outputs w
    A = system_matrix(law.A, None, slope * S @ C_1, one)
    B = system_matrix(law_B, np.zeros((n, m)), slope * S @ D_1, -slope * one)
    C = np.hstack([gain * S @ C_1 + emf[0], one]) / R
    D = np.hstack([gain * S @ D_1 + emf[1], -gain * one]) / R
    C_n, D_n = np.hstack([C_n, np.zeros((m, m))]), np.hstack([D_n, np.zeros((m, m))])
    none = np.zeros((m, m))
    behind = Compensator(  # states without q, and w without q
        system_matrix(A, None, C, none),
        system_matrix(B, A @ B_q, D, C @ B_q),
        system_matrix(np.zeros((m, len(A))), one, C_n, none),
        system_matrix(np.zeros((m, p + m)), gain * S / R, D_n, C_n @ B_q),
        sample_time=Ts,
    )
    parameters, rate = ca.SX.sym("p", len(system.names) + 1), MAX_RATE / Ts
    plain, echo = system.matrices(parameters[:-1]), ca.SX.eye(m)
    echoes = (-rate * echo, rate * echo, parameters[-1] * echo)
    matrices = [ca.sparsify(ca.diagcat(M, own)) for M, own in zip(plain, echoes, strict=True)]
    # a limit of the factor that is just beyond MAX_SCATTER ends the search there
    limits = (*system.limits, (1 - 1.01 * MAX_SCATTER, 1 + 1.01 * MAX_SCATTER))
    names, nominal = (*system.names, FACTOR), np.append(system.nominal, 1.0)
    whole = ca.Function("matrices", [parameters], matrices)
    above = [] if system.positive is None else [system.positive(parameters[:-1])]
    positive = ca.Function("positive", [parameters], above) if above else None
    return replace(
        system, names=names, nominal=nominal, matrices=whole, limits=limits, positive=positive
    ), behind
