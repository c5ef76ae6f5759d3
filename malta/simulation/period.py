"""One control period as it is simulated: sensors, control law, delay of its commands, current loops, machine.

Every engine runs these CasADi functions:

    given, noise --> [ sense ] --> y --> [ decide ] --> commands held --> [ substep ] x n --> machine
                        ^                 ^  |  ^                                                |
                        |        v0(z) ---+  |  +-- controller <--                               |
                        +--------------------|---------------------------------------------------+

The state is (machine, controller). Its entries depend on the fidelity, the model of how forces arise:

    force   currents of the coils follow their commands as first-order lags at the current loops' crossover, exactly
    dq      PI loops and windings in the axes of the transformation; voltage limit of the half-bridges, induced
            voltage and its feedforward, DC link
    phase   the same controllers on every winding: phase currents, duty cycles, star points; or the machine's own
            electronics, which run many times in a sample

    machine     x; then coil currents | axis currents, link voltage | phase currents, link voltage or electronics
    controller  xi_pred, e, frozen; PI integrals and their limits; last y and held commands (faults); commands under way

The delay stands between the control law and the coils in `force`, and between the current controllers and the
windings in `dq` and `phase`, as on the machine, where computation takes this time. Of a fraction of a sample, commands
begin to act within it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation import current_control
from malta.simulation.current_control import control_currents, keep_if_missed, reading_errors
from malta.simulation.layout import (
    Layout,
    LoopPlan,
    Setup,
    Symbols,
    electronics_of,
    held_size,
    layout_of,
    read_currents,
    signals_of,
    with_symbols,
)
from malta.simulation.readings import initial_readings, measurement, step_readings
from malta.synthesis.controller import Controller
from malta.synthesis.law import command_forces, freeze_moving, frozen_axes, interpolate, look_ahead
from malta.synthesis.linear_law import estimate_states, filter_reading, sum_errors

# Motion of the machine between two samples: one step of the classical Runge–Kutta method under held commands.


OPENING_TIME = 20e-6  # s, time constant with which the current of an open phase decays
SENSORS = ("lagged", "late", "clock")  # states of the machine that belong to its sensors


def advance(loop: LoopPlan, signals: Symbols, held: Any, jitter: Any) -> Any:
    """The machine's state after one Runge–Kutta step under held commands, or after one period of its electronics."""
    if loop.setup.fraction:
        loop, held = _acting_now(loop, signals, held)
    own = {name: value for name, value in signals.machine.items() if name not in SENSORS}
    moved = _move(loop, signals._replace(machine=own), held, jitter)
    after = step_readings(loop, signals.machine, moved[: len(loop.plant.states)])
    return ca.vertcat(moved, *(after[name] for name in signals.machine if name in SENSORS))


def _acting_now(loop: LoopPlan, signals: Symbols, held: Any) -> tuple[LoopPlan, Any]:
    """The commands that act in a step, and the loop with the length of the step.

    Some steps fill the fraction of the sample for which the older commands act, the others its rest: of the steps of
    an undivided sample each part has its share, at least one.
    """
    Ts, f = loop.numbers["control_time"], loop.setup.fraction
    steps = ca.floor(Ts / loop.numbers["substep"] + 0.5)
    older = ca.fmax(1, ca.fmin(steps - 1, ca.floor(f * steps + 0.5)))
    h_older = f * Ts / older
    first = signals.machine["clock"] < f * Ts - h_older / 2
    h_newer, size = (1 - f) * Ts / (steps - older), held.numel() // 2
    lengths = {"substep": ca.if_else(first, h_older, h_newer), "last_substep": h_newer}
    return loop._replace(numbers={**loop.numbers, **lengths}), ca.if_else(first, held[:size], held[size:])


def motion(loop: LoopPlan, signals: Symbols, x: Any, inputs: Any) -> Any:
    """x' under the inputs, the machine's loads and what acts from outside."""
    plant, s = loop.plant, loop.setup
    w = plant.load(x) + _outside(loop, signals)
    return plant.f(x, inputs, w + plant.contacts.bearing(x) if s.bearing else w)


def _outside(loop: LoopPlan, signals: Symbols) -> Any:
    """The disturbance; structural zeros, which cost nothing, where there is none."""
    return signals.given["w"] if loop.setup.disturbed else ca.SX(len(loop.plant.disturbances), 1)


def _move(loop: LoopPlan, signals: Symbols, held: Any, jitter: Any) -> Any:
    """The same without the sensors' states."""
    plant, s, h = loop.plant, loop.setup, loop.numbers["substep"]
    machine, given = signals.machine, signals.given
    x, fast = machine["x"], electronics_of(plant, s)
    if fast is not None:
        own = {name: machine[name] for name in fast.state}
        x, i, own = fast.move(
            x, machine["i_coil"], own, held, plant.load(x) + _outside(loop, signals), jitter
        )
        return ca.vertcat(x, i, *(own[name] for name in fast.state))
    if s.fidelity == "force":
        currents = _lagging_currents(plant.actuator.crossover, machine["i_coil"], held, h)
        half = len(plant.states) // 2 if plant.second_order else 0
        moved = runge_kutta(
            lambda x, n: motion(loop, signals, x, plant.actuator.forces(x, currents[n])), x, h, half
        )
        return ca.vertcat(moved, currents[2])
    n, count = len(plant.states), machine["i" if s.fidelity == "dq" else "i_phase"].numel()
    slope = _axis_slope if s.fidelity == "dq" else _phase_slope

    def rate(z: Any, _: int) -> Any:
        x, i, V = z[:n], z[n : n + count], z[n + count]
        forces, electrics = slope(plant, s, given, x, i, V, held)
        return ca.vertcat(motion(loop, signals, x, forces), electrics)

    return runge_kutta(rate, ca.vertcat(*machine.values()), h, n // 2 if plant.second_order else 0)


def half_step_decay(crossover: Any, h: Any) -> Any:
    """What is left of a current's deviation from its command after half a step h; 0 where currents follow at once."""
    at_once = isinstance(crossover, float) and math.isinf(crossover)
    return ca.SX(0) if at_once else ca.exp(-crossover * h / 2)


def _lagging_currents(crossover: Any, i: Any, held: Any, h: Any) -> list[Any]:
    """Currents at the beginning, the middle and the end of a step: i = held + (i_0 - held) e^(-w_c t), exactly."""
    if isinstance(crossover, float) and math.isinf(crossover):
        return [held] * 3
    lag, decay = i - held, half_step_decay(crossover, h)
    return [held + lag, held + decay * lag, held + decay**2 * lag]


def runge_kutta(rate: Callable[[Any, int], Any], z: Any, h: Any, positions: int = 0) -> Any:
    """z after one step h of the classical Runge–Kutta method of fourth order.

    rate : (z, half steps since the beginning: 0, 1 or 2) -> z'
    positions : number of leading entries of z whose rates are the next entries of z. Their update is written in
        accelerations (Nyström), which gives the same result in fewer operations.
    """
    q, w = z[:positions, 0], z[positions:, 0]  # columns, also of a single entry
    dq = w[:positions, 0]

    def slope(q: Any, w: Any, halves: int) -> Any:
        return rate(ca.vertcat(q, w), halves)[positions:, 0]

    k1 = slope(q, w, 0)
    middle = q + h / 2 * dq
    k2 = slope(middle, w + h / 2 * k1, 1)
    k3 = slope(middle + h * h / 4 * k1[:positions, 0], w + h / 2 * k2, 1)
    end = q + h * dq
    k4 = slope(end + h * h / 2 * k2[:positions, 0], w + h * k3, 2)
    late = k2 + k3
    early = k1 + late
    return ca.vertcat(end + h * h / 6 * early[:positions, 0], w + h / 6 * (early + late + k4))


def _axis_slope(
    plant: Plant, s: Setup, given: Mapping[str, Any], x: Any, i: Any, V: Any, m: Any
) -> tuple[Any, Any]:
    """Forces, and d/dt of axis currents and link voltage: L i' = m V - R i - emf, with the coupling of the axes."""
    drive, actuator = plant.drive, plant.actuator
    u = m * V * (1 - given["sag"] if s.faulty else 1)
    di = (u - actuator.R * i - drive.emf(x)) / actuator.L + drive.coupling(x, i)
    power = ca.dot(ca.DM(list(drive.weight)), u * i)
    return drive.force(i), ca.vertcat(di, current_control.link_slope(drive, V, power))


def _phase_slope(
    plant: Plant, s: Setup, given: Mapping[str, Any], x: Any, i: Any, V: Any, d: Any
) -> tuple[Any, Any]:
    """Forces, and d/dt of phase currents and link voltage. The voltage of a phase is u = (d - 1/2) V."""
    drive, actuator = plant.drive, plant.actuator
    u = (d - 0.5) * V * (1 - given["sag"] if s.faulty else 1)
    closed = 1 - given["open"] if s.faulty else ca.SX.ones(len(drive.phases))
    flowing = closed * i
    net = current_control.phase_voltages(
        drive, u - actuator.R * flowing - drive.to_phases(x) @ drive.emf(x), closed
    )
    # The arc is short: an open phase loses its current within a sample, and the other phases lose their part of it.
    lost = (1 - closed) * i
    for star in drive.stars if s.faulty else ():
        phases = list(star)
        lost[phases] += closed[phases] * ca.sum1(flowing[phases]) / ca.fmax(ca.sum1(closed[phases]), 1)
    di = net / actuator.L - lost / OPENING_TIME
    power = ca.dot(u, flowing)
    return drive.force(drive.to_axes(x) @ flowing), ca.vertcat(
        di, current_control.link_slope(drive, V, power)
    )


class Period(NamedTuple):
    """The functions of one control period; theta has no entries where all numbers are constants."""

    sense: ca.Function  # (state, given, noise, theta) -> y (then errors of read currents), position for v0(z)
    decide: ca.Function  # (state, given, y, v0, theta) -> controller, held, row
    substep: ca.Function  # (machine, held, given, fast noise, theta) -> machine
    theta: tuple[str, ...]  # names of the numbers, an entry for each
    columns: tuple[int, ...] | None = None  # entries of v0(z) that are not zero; None: all of them
    # With a working state, see integration_state.py, which `substep` takes and returns in place of the machine's:
    # (machine, held, theta) -> working, and (working, machine, held, theta) -> machine.
    enter: ca.Function | None = None
    leave: ca.Function | None = None


def period_of(
    plant: Plant,
    c: Controller,
    s: Setup,
    values: Mapping[str, ca.DM],
    *,
    constant: bool,
    shorten: Callable[[Any], Any] = ca.cse,
) -> Period:
    """The functions of one control period.

    values : every number of machine, controller and sensors, see numbers_of
    constant : True puts the numbers into the functions, which is faster on CasADi's virtual machine. False makes them
        the argument theta, so that one set of functions serves every machine and controller of the same shape.
    shorten : of their expressions; the same functions in more operations are had sooner without it
    """
    g: dict[str, Any] = {name: ca.SX(value) for name, value in values.items()}
    theta: Any = ca.SX(0, 1)
    names: tuple[str, ...] = ()
    if not constant:
        plant, g, theta = with_symbols(plant, values)
        names = tuple(name for name, symbol in g.items() for _ in range(symbol.nnz()))
    sizes = layout_of(plant, c, s)
    loop, signals = LoopPlan(plant, c, s, g), signals_of(sizes, ca.SX)
    machine, controller, given = signals
    state = ca.vertcat(*machine.values(), *controller.values())
    around = ca.vertcat(*given.values())
    outputs = len(plant.outputs)
    noise = ca.SX.sym("noise", outputs + read_currents(plant, s))
    held = ca.SX.sym("held", held_size(plant, s))
    fast = electronics_of(plant, s)
    jitter = ca.SX.sym("jitter", 0 if fast is None else fast.noises)

    measured = measurement(loop, machine, noise[:outputs])
    if s.faulty:
        measured = ca.if_else(given["stuck"], controller["y_last"], measured)
    first, last = g["grid_ends"][0], g["grid_ends"][1]
    at = ca.fmax(ca.fmin(measured[plant.stroke_output], last), first) if plant.has_stroke else first
    if s.current_sensors:
        measured = ca.vertcat(measured, reading_errors(loop, machine, noise[outputs:]))
    sense = ca.Function("sense", [state, around, noise, theta], shorten([ca.densify(measured), at]))

    moved = shorten(ca.densify(advance(loop, signals, held, jitter)))
    substep = ca.Function("substep", [ca.vertcat(*machine.values()), held, around, jitter, theta], [moved])
    return Period(sense, _decide_function(loop, theta, sizes, shorten), substep, names)


def columns_of(c: Controller) -> tuple[int, ...]:
    """The forces whose v0(z) is not zero at every point; below the rounding of the largest force is zero."""
    size, limit = np.abs(c.feedforward.v0).max(axis=0), np.abs(c.limits.force).max()
    return tuple(np.flatnonzero(size > np.finfo(float).eps * limit).tolist())


def without_zeros(p: Period, columns: tuple[int, ...]) -> Period:
    """The same functions where only these entries of v0(z) are not zero: the others drop out of the expressions."""
    state, given, y, v0, theta = p.decide.sx_in()
    known = ca.vertcat(*(v0[j] if j in columns else 0 for j in range(v0.numel())))
    decided = ca.cse(list(p.decide(state, given, y, known, theta)))
    return p._replace(decide=ca.Function("decide", [state, given, y, v0, theta], decided), columns=columns)


def chain(p: Period, c: Controller, substeps: int, block: int) -> ca.Function:
    """`block` samples in one call of CasADi's virtual machine: (state, inputs) -> (states, rows), a column a sample.

    inputs : given, noise, and the electronics' noise of all substeps, one below the other
    """
    state, given = ca.MX.sym("state", p.sense.size1_in(0)), ca.MX.sym("given", p.sense.size1_in(1))
    noise = ca.MX.sym("noise", p.sense.size1_in(2))
    jitters = [ca.MX.sym("jitter", p.substep.size1_in(3)) for _ in range(substeps)]
    inputs = ca.vertcat(given, noise, *jitters)
    S, U = ca.MX.sym("state", state.numel()), ca.MX.sym("inputs", inputs.numel())
    edges = np.cumsum([0, given.numel(), noise.numel(), *(j.numel() for j in jitters)]).tolist()
    given, noise, *jitters = ca.vertsplit(U, edges)
    measured, at = p.sense(S, given, noise, ca.DM(0, 1))
    # v0(z) is a table, and SX expressions have no look-up.
    table = ca.interpolant("table", "linear", [c.feedforward.z_grid], c.feedforward.v0.ravel())
    controller, held, row = p.decide(S, given, measured, table(at), ca.DM(0, 1))
    machine = S[: p.substep.size1_in(0)]
    for jitter in jitters:
        machine = p.substep(machine, held, given, jitter, ca.DM(0, 1))
    after = ca.vertcat(machine, controller)
    return ca.Function("step", [S, U], [after, ca.densify(row)]).mapaccum("chain", block)


@lru_cache(maxsize=32)
def initial_state_function(plant: Plant, c: Controller, s: Setup) -> ca.Function:
    """`initial_state` as a function of numbers: (x, xi_pred, current) -> state."""
    sizes = (len(plant.states), len(c.states), len(plant.actuator.coils))
    arguments = [ca.SX.sym(name, size) for name, size in zip(("x", "xi_pred", "current"), sizes, strict=True)]
    return ca.Function("initial", arguments, [initial_state(plant, c, s, *arguments)])


def initial_state(plant: Plant, c: Controller, s: Setup, x: Any, xi_pred: Any, current: Any) -> Any:
    """The state with the machine at x, coil currents `current` (A), and the observer at xi_pred.

    The current controllers are at rest: their integrals hold these currents, and the commands under way do too.
    """
    actuator, fast = plant.actuator, electronics_of(plant, s)
    x, current = ca.SX(x), ca.SX(current)
    values: dict[str, Any] = {"x": x, "i_coil": current, "xi_pred": xi_pred} | initial_readings(plant, s, x)
    values |= {"y_last": plant.h(x, 0), "command": current}
    if fast is not None:
        values |= fast.start(x, current) | {"command": fast.held(current, plant.h(x, 0))}
    elif s.fidelity != "force":
        drive = plant.drive
        i, e, T = drive.command(current), drive.emf(x), drive.to_phases(x)
        share = (actuator.R * i + e) / drive.link_voltage
        values |= {"i": i, "i_phase": T @ i, "u_integral": actuator.R * i, "link": drive.link_voltage}
        if s.turning:
            believed = plant_of(c.parameters)
            Q = believed.drive.turned(believed.actuator.forces(x, current))
            values["u_integral"] = Q @ values["u_integral"]
        values["command"] = share if s.fidelity == "dq" else 0.5 + T @ share
    values["under_way"] = ca.repmat(values["command"], s.delay, 1)
    sizes = layout_of(plant, c, s)
    state = {**sizes.machine, **sizes.controller}
    return ca.densify(ca.vertcat(*(values.get(name, ca.SX.zeros(size)) for name, size in state.items())))


def _decide_function(loop: LoopPlan, theta: Any, sizes: Layout, shorten: Callable[[Any], Any]) -> ca.Function:
    """The function `decide` of Period: in CasADi's SX; in MX where the controller looks something up in a table."""
    plant = loop.plant
    kind = ca.MX if plant_of(loop.controller.parameters).actuator.tabulated else ca.SX
    if kind is ca.MX:
        constants = {name: ca.MX(ca.DM(value)) for name, value in loop.numbers.items()}
        loop, theta = loop._replace(numbers=constants), ca.MX(0, 1)
    signals = signals_of(sizes, kind)
    machine, controller, given = signals
    outputs = len(plant.outputs)
    read = kind.sym("y", outputs + read_currents(plant, loop.setup))
    y, v0 = read[:outputs], kind.sym("v0", len(plant.inputs))
    x = machine["x"]
    after, command, row = _control_law(loop, signals, y, v0, read[outputs:])
    row = {"x": x, "p": plant.h(x, 0), "y": y, "contact": plant.contacts.contact(x)} | row
    decided = [
        ca.vertcat(*(after[name] for name in sizes.controller)),
        command,
        ca.vertcat(*(row[name] for name in sizes.row)),
    ]
    # Engines read every entry, so structural zeros are not allowed.
    decided = [ca.densify(values) for values in decided]
    state = ca.vertcat(*machine.values(), *controller.values())
    arguments = [state, ca.vertcat(*given.values()), read, v0, theta]
    if kind is ca.SX:
        return ca.Function("decide", arguments, shorten(decided))
    # The arguments of an MX function are symbols, so the signals are cut out of whole vectors.
    whole = [ca.MX.sym("state", *arguments[0].shape), ca.MX.sym("given", *arguments[1].shape)]
    pieces = []
    for vector, sizes_of in zip(whole, ({**sizes.machine, **sizes.controller}, sizes.given), strict=True):
        pieces += ca.vertsplit(vector, np.cumsum([0, *sizes_of.values()]).tolist())
    symbols = [*machine.values(), *controller.values(), *given.values()]
    decided = ca.substitute(decided, symbols, pieces)
    return ca.Function("decide", [*whole, read, v0, ca.MX.sym("theta", 0, 1)], decided)


def _control_law(
    loop: LoopPlan, signals: Symbols, y: Any, v0: Any, errors: Any
) -> tuple[dict[str, Any], Any, dict[str, Any]]:
    """The control law and the current controllers at measurements y and with errors of read currents.

    Returns the controller's state after this sample, the commands to hold, and entries of the row.
    """
    plant, c, s, g = loop
    machine, controller, given = signals
    C = _scheduled_C(c, y) if s.scheduled else None
    g = interpolate(g, c.schedule, given["p_ref"])
    p_ref, v_ff = given["p_ref"], given["v_ff"]
    taken = filter_reading(c.tracks, y, p_ref)
    xi_hat = given["xi_hat"] if s.outside else estimate_states(g, controller["xi_pred"], taken, C)
    if s.anticipated:  # like v0, these forces cancel a load and move nothing: the filter is not told of them
        v0 = v0 + given["v_known"]
    believed = plant_of(c.parameters)
    xi_ref = law_reference(c, believed, g, given)
    frozen_now = freeze_moving(g, controller["frozen"], given["dp_ref"])
    e = sum_errors(g, controller["e"], frozen_now, y, p_ref)
    xi_pred, saturated, v = command_forces(g, xi_hat, e, xi_ref, v_ff, v0)
    if s.open_loop:
        v, saturated = v_ff + v0, 0 * saturated  # open loop: no limit of the feedback is reached
    xi_pred, place = look_ahead(g, xi_pred, p_ref if s.open_loop else y, given["dp_ref"])
    after: dict[str, Any] = {"xi_pred": xi_pred, "e": e, "frozen": frozen_axes(g, saturated)}
    # The controller commutates with the machine of its gain file. The simulated machine limits the currents, and the
    # gain file does: the smaller limit counts.
    wanted = believed.actuator.currents(place, v)
    current, fast = limited_currents(plant, wanted, g["current_limit"]), electronics_of(plant, s)
    met = [ca.mmax(ca.fabs(current - wanted)) > 0]
    row: dict[str, Any] = {"xi_hat": xi_hat, "v": v, "saturated": saturated, "current": current}
    if fast is not None:
        command = keep_if_missed(s, signals, fast.held(current, place))
        electric_state = {name: machine[name] for name in fast.state}
        met.append(fast.met(electric_state))
        row |= {"i_phase": machine["i_coil"], "duty": fast.duty(electric_state)}
        row["force"] = plant.actuator.forces(machine["x"], machine["i_coil"])
    elif s.fidelity == "force":
        command = keep_if_missed(s, signals, current)
        row["force"] = plant.actuator.forces(machine["x"], machine["i_coil"])
    else:
        # A law of errors has no states: the measured outputs stand for them, moving as the reference does.
        known = xi_hat if c.tracks == "states" else state_reference(believed)(y, given["dp_ref"])
        command, electrics, more = control_currents(loop, signals, current, known, errors)
        after |= electrics
        row |= more
    row["met"] = ca.vertcat(*met)
    if s.faulty:
        after = {name: ca.if_else(given["missed"], controller[name], value) for name, value in after.items()}
        after |= {"y_last": y, "command": command}
    queue = ca.vertcat(controller["under_way"], command)
    size = command.numel()
    after["under_way"] = queue[size:, 0]  # a column, also where no entry is left
    return after, queue[: held_size(plant, s)], row


def limited_currents(plant: Plant, wanted: Any, limit: Any) -> Any:
    """Coil currents within the machine's own limits and those of a gain file.

    A machine may scale its currents together, which ends within its limit but for the last digit.
    """
    most = ca.fmin(limit, plant.actuator.current_limit)
    return ca.fmax(ca.fmin(plant.actuator.limited(wanted), most), -most)


def law_reference(c: Controller, believed: Plant, g: Mapping[str, Any], given: Mapping[str, Any]) -> Any:
    """xi*, the reference of the control law's states; 0 for a law of errors."""
    if c.tracks == "errors":
        return ca.DM(len(c.states), 1)
    p_ref, dp_ref, rates = given["p_ref"], given["dp_ref"], len(c.feedforward.rate)
    faster = ca.vertcat(ca.DM(len(c.A) - rates, 1), g["rate"] @ dp_ref)
    return ca.vertcat(state_reference(believed)(p_ref, dp_ref) + faster, given["v_past"])


@lru_cache(maxsize=16)
def state_reference(believed: Plant) -> ca.Function:
    """(p*, p*') -> reference of the mechanical states: P(z*)^-1 p* and its derivative.

    For a machine whose states are not (q, q'): the states at rest with the outputs p*.
    """
    p, dp = ca.SX.sym("p", len(believed.outputs)), ca.SX.sym("dp", len(believed.outputs))
    q = believed.position_of(p)
    states = ca.vertcat(q, ca.jtimes(q, p, dp)) if believed.second_order else q
    return ca.Function("q", [p, dp], [ca.densify(states)])


def _scheduled_C(c: Controller, y: Any) -> Any:
    """C of the controller's machine at rest at the measured stroke position."""
    believed = plant_of(c.parameters)
    x = ca.SX.sym("x", len(believed.states))
    rest = ca.SX.zeros(len(believed.states))
    if believed.has_stroke:
        rest[believed.stroke_state] = y[believed.stroke_output]
    C = ca.jacobian(believed.h(x, 0), x)[:, list(believed.controlled)]
    at = ca.substitute(C, x, rest)
    return ca.horzcat(at, ca.SX(at.shape[0], len(c.states) - at.shape[1]))
