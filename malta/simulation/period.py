"""One control period of machine and controller, as CasADi functions: everything that simulates is made of them.

    given, noise --> [ sense ] --> y --> [ decide ] --> commands held --> [ substep ] x n --> machine
                        ^                 ^  |  ^                                                |
                        |        v0(z) ---+  |  +-- controller <--                               |
                        +--------------------|---------------------------------------------------+

The state is (machine, controller). What stands in them depends on the fidelity, i.e. on what makes the forces:

    force   currents of the coils follow their commands as first-order lags at the current loops' crossover, exactly
    dq      PI loops and windings in the axes of the transformation; voltage limit of the half-bridges, induced
            voltage and its feedforward, DC link
    phase   the same controllers, on every winding: phase currents, duty cycles, star points; or the machine's own
            electronics, where these run many times in a sample

    machine     x; then coil currents | axis currents, link voltage | phase currents, link voltage or electronics
    controller  xi_pred, e, frozen; PI integrals and their limits; last y and held commands (faults); commands under way

The one sample of delay stands between the control law and the coils in `force`, and between the current
controllers and the windings in `dq` and `phase`, where computation really takes its time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import casadi as ca
import numpy as np

from malta.model.data import (
    plant_of,
    shaping,
    twins_of,
    units_of,
)
from malta.model.plant import Electronics, Plant, symbolic
from malta.simulation import inverter
from malta.synthesis.controller import (
    Controller,
    CurrentLoop,
    commanded,
    estimated,
    filtered,
    gains_of,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

Fidelity = Literal["force", "dq", "phase"]
FIDELITIES: tuple[Fidelity, ...] = get_args(Fidelity)


@dataclass(frozen=True)
class Setup:
    """What shapes the functions of a simulation; all else are numbers."""

    fidelity: Fidelity
    delay: int  # samples between measurement and command
    quantize: bool = False  # sensors in steps
    disturbed: bool = False  # an external wrench
    bearing: bool = False  # touchdown bearings push back
    sensed: bool = False  # sensors with their own errors, Hall sensors for the stroke
    faulty: bool = False  # held measurements, missed steps, open phases, sagging link
    scheduled: bool = False  # C(z) of the measured z in the filter
    real_pwm: bool = False  # duty cycles in steps, dead time
    turning: bool = False  # current controllers in axes that turn with the forces, as printed
    outside: bool = False  # the estimate comes from outside
    open_loop: bool = False  # no feedback: what is fed forward, commutated for the reference
    electronics: Any = None  # options of the machine's own electronics


class Layout(NamedTuple):
    """Names and sizes, in order."""

    machine: dict[str, int]
    controller: dict[str, int]
    given: dict[str, int]  # per sample, the same for every machine
    row: dict[str, int]  # what one sample leaves behind


class Parts(NamedTuple):
    """The functions of one control period; theta is empty where all numbers are constants."""

    sense: ca.Function  # (state, given, noise, theta) -> y, position for v0(z)
    decide: ca.Function  # (state, given, y, v0, theta) -> controller, held, row
    substep: ca.Function  # (machine, held, given, fast noise, theta) -> machine
    theta: tuple[str, ...]  # names of the numbers, an entry for each


@lru_cache(maxsize=64)
def layout(plant: Plant, c: Controller, s: Setup) -> Layout:
    """What stands where."""
    n, m, p = len(c.states), len(c.forces), len(c.measurements)
    coils, fast = len(plant.actuator.coils), electronics_of(plant, s)
    axes, phases = _windings(plant)
    driven = s.fidelity != "force" and fast is None
    electric_state: dict[str, int] = {"i_coil": coils}
    if fast is not None:
        electric_state |= fast.state
    elif s.fidelity != "force":
        electric_state = {"i": axes, "link": 1} if s.fidelity == "dq" else {"i_phase": phases, "link": 1}
    held = _held(plant, s)
    controller = {"xi_pred": n, "e": p, "frozen": p}
    if driven:
        controller |= {"u_integral": axes, "u_limited": axes}
    if s.faulty:
        controller |= {"y_last": p, "command": held}
    controller |= {"under_way": held * s.delay}
    given = {"p_ref": p, "dp_ref": p, "v_ff": m}
    given["v_past"] = n - len(c.A) if c.tracks == "states" else 0  # and zero for disturbances
    if s.disturbed:
        given |= {"w": len(plant.disturbances)}
    if s.faulty:
        given |= {"stuck": p, "missed": 1, "sag": 1, "open": phases if s.fidelity == "phase" else 0}
    if s.outside:
        given |= {"xi_hat": n}
    row = {"x": len(plant.states), "p": p, "y": p, "xi_hat": n, "v": m, "force": m, "saturated": p}
    row |= {"contact": len(plant.contacts), "current": coils, "met": 1 + (len(fast.flags) if fast else 0)}
    if driven:
        row |= {"i": axes, "u": axes, "link": 1}
    if s.fidelity == "phase":
        row |= dict.fromkeys(("i_phase", "duty"), phases if driven else coils)
    return Layout({"x": len(plant.states)} | electric_state, controller, given, row)


def numbers(
    plant: Plant, c: Controller, substeps: float, errors: Mapping[str, float] | None = None
) -> dict[str, ca.DM]:
    """Every number of machine, controller and sensors, by name."""
    fixed = shaping(plant.parameters)
    machine = {k: ca.DM(getattr(plant.parameters, k)) for k in units_of(plant.parameters) if k not in fixed}
    loop = c.current_loop or CurrentLoop(0.0, 0.0, 0.0)
    known = dict.fromkeys((signal.name for signal in plant.sensor_errors), 0.0) | dict(errors or {})
    return {
        **{f"machine.{name}": ca.DM(value) for name, value in machine.items()},
        **gains_of(c),
        "Kp": ca.DM(loop.Kp),
        "Ki_current": ca.DM(loop.Ki),
        "rate": ca.DM(c.feedforward.rate),
        "grid_ends": ca.DM([c.feedforward.z_grid[0], c.feedforward.z_grid[-1]]),
        "substep": ca.DM(c.sample_time / substeps),
        "errors": ca.DM(list(known.values())),
    }


def flat(values: Mapping[str, ca.DM]) -> FloatArray:
    """The nonzeros of every number, in order: theta."""
    return np.concatenate([np.array(value.nonzeros(), dtype=float) for value in values.values()])


def parts(plant: Plant, c: Controller, s: Setup, values: Mapping[str, ca.DM], *, constant: bool) -> Parts:
    """The functions of one control period.

    constant: with the numbers in them, which is faster on CasADi's virtual machine; otherwise they are arguments, and
    one set of functions serves every machine and controller of the same shape.
    """
    g: dict[str, Any] = {name: ca.SX(value) for name, value in values.items()}
    theta: Any = ca.SX(0, 1)
    names: tuple[str, ...] = ()
    if not constant:
        plant, g, theta = numbered(plant, values)
        names = tuple(name for name, symbol in g.items() for _ in range(symbol.nnz()))
    sizes = layout(plant, c, s)
    machine, controller, given = (_symbols(part, ca.SX) for part in sizes[:3])
    state = ca.vertcat(*machine.values(), *controller.values())
    around = ca.vertcat(*given.values())
    noise, held = ca.SX.sym("noise", len(plant.outputs)), ca.SX.sym("held", _held(plant, s))
    fast = electronics_of(plant, s)
    jitter = ca.SX.sym("jitter", 0 if fast is None else fast.noises)
    x = machine["x"]

    measured = _measured(plant, s, g, x, noise)
    if s.faulty:
        measured = ca.if_else(given["stuck"], controller["y_last"], measured)
    first, last = g["grid_ends"][0], g["grid_ends"][1]
    at = ca.fmax(ca.fmin(measured[plant.stroke_output], last), first) if plant.has_stroke else first
    sense = ca.Function("sense", [state, around, noise, theta], ca.cse([ca.densify(measured), at]))

    moved = ca.cse(ca.densify(_moved(plant, s, g, machine, given, held, jitter)))
    substep = ca.Function("substep", [ca.vertcat(*machine.values()), held, around, jitter, theta], [moved])
    return Parts(sense, _decide(plant, c, s, g, theta, sizes), substep, names)


def _decide(
    plant: Plant, c: Controller, s: Setup, g: Mapping[str, Any], theta: Any, sizes: Layout
) -> ca.Function:
    """The function `decide` of Parts: in CasADi's SX; in MX where the controller looks something up in a table."""
    kind = ca.MX if plant_of(c.parameters).tabulated else ca.SX
    if kind is ca.MX:
        g, theta = {name: ca.MX(ca.DM(value)) for name, value in g.items()}, ca.MX(0, 1)
    machine, controller, given = (_symbols(part, kind) for part in sizes[:3])
    y, v0 = kind.sym("y", len(plant.outputs)), kind.sym("v0", len(plant.inputs))
    x = machine["x"]
    after, command, row = _decided(plant, c, s, g, machine, controller, given, y, v0)
    row = {"x": x, "p": plant.h(x, 0), "y": y, "contact": plant.contact(x)} | row
    decided = [
        ca.vertcat(*(after[name] for name in sizes.controller)),
        command,
        ca.vertcat(*(row[name] for name in sizes.row)),
    ]
    decided = [ca.densify(values) for values in decided]  # engines read every entry: no zero may be left out
    state = ca.vertcat(*machine.values(), *controller.values())
    arguments = [state, ca.vertcat(*given.values()), y, v0, theta]
    if kind is ca.SX:
        return ca.Function("decide", arguments, ca.cse(decided))
    # Functions of MX take symbols: the parts are cut out of whole vectors.
    whole = [ca.MX.sym("state", *arguments[0].shape), ca.MX.sym("given", *arguments[1].shape)]
    pieces = []
    for vector, sizes_of in zip(whole, ({**sizes.machine, **sizes.controller}, sizes.given), strict=True):
        pieces += ca.vertsplit(vector, np.cumsum([0, *sizes_of.values()]).tolist())
    symbols = [*machine.values(), *controller.values(), *given.values()]
    decided = ca.substitute(decided, symbols, pieces)
    return ca.Function("decide", [*whole, y, v0, ca.MX.sym("theta", 0, 1)], decided)


def numbered(plant: Plant, values: Mapping[str, ca.DM]) -> tuple[Plant, dict[str, Any], Any]:
    """The machine with a symbol for every number, the symbols by name, and all of them: theta."""
    g = {name: ca.SX.sym(name, value.sparsity()) for name, value in values.items()}
    theta = ca.vertcat(*(ca.vertcat(*symbol.nonzeros()) for symbol in g.values()))
    return plant.variant(_symbolic_parameters(plant, g)), g, theta


def initial(plant: Plant, c: Controller, s: Setup, x: Any, xi_pred: Any, current: Any) -> Any:
    """State with the machine at x, these currents of the coils (A) flowing, and the observer at xi_pred."""
    actuator, fast = plant.actuator, electronics_of(plant, s)
    x, current = ca.SX(x), ca.SX(current)
    values: dict[str, Any] = {"x": x, "i_coil": current, "xi_pred": xi_pred}
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
            Q = believed.drive.turned(believed.forces(x, current))
            values["u_integral"] = Q @ values["u_integral"]
        values["command"] = share if s.fidelity == "dq" else 0.5 + T @ share
    values["under_way"] = ca.repmat(values["command"], s.delay, 1)
    sizes = layout(plant, c, s)
    state = {**sizes.machine, **sizes.controller}
    return ca.densify(ca.vertcat(*(values.get(name, ca.SX.zeros(size)) for name, size in state.items())))


@lru_cache(maxsize=32)
def initial_state(plant: Plant, c: Controller, s: Setup) -> ca.Function:
    """`initial` as a function of numbers: (x, xi_pred, current) -> state."""
    sizes = (len(plant.states), len(c.states), len(plant.actuator.coils))
    arguments = [ca.SX.sym(name, size) for name, size in zip(("x", "xi_pred", "current"), sizes, strict=True)]
    return ca.Function("initial", arguments, [initial(plant, c, s, *arguments)])


def chained(p: Parts, c: Controller, substeps: int, block: int) -> ca.Function:
    """A block of samples on CasADi's virtual machine: (state, inputs) -> (states, rows).

    inputs = given, noise, and the fast noise of all substeps.
    """
    state, given = ca.MX.sym("state", p.sense.size1_in(0)), ca.MX.sym("given", p.sense.size1_in(1))
    noise = ca.MX.sym("noise", p.sense.size1_in(2))
    jitters = [ca.MX.sym("jitter", p.substep.size1_in(3)) for _ in range(substeps)]
    inputs = ca.vertcat(given, noise, *jitters)
    S, U = ca.MX.sym("state", state.numel()), ca.MX.sym("inputs", inputs.numel())
    edges = np.cumsum([0, given.numel(), noise.numel(), *(j.numel() for j in jitters)]).tolist()
    given, noise, *jitters = ca.vertsplit(U, edges)
    measured, at = p.sense(S, given, noise, ca.DM(0, 1))
    # v0(z) is a table, which scalar expressions cannot look up.
    table = ca.interpolant("table", "linear", [c.feedforward.z_grid], c.feedforward.v0.ravel())
    controller, held, row = p.decide(S, given, measured, table(at), ca.DM(0, 1))
    machine = S[: p.substep.size1_in(0)]
    for jitter in jitters:
        machine = p.substep(machine, held, given, jitter, ca.DM(0, 1))
    after = ca.vertcat(machine, controller)
    return ca.Function("step", [S, U], [after, ca.densify(row)]).mapaccum("chain", block)


def electronics_of(plant: Plant, s: Setup) -> Electronics | None:
    """The machine's own electronics, where a setup has them."""
    if s.fidelity != "phase" or plant.electronics is None:
        return None
    return plant.electronics(s.electronics)


def fidelities(plant: Plant) -> tuple[Fidelity, ...]:
    """The fidelities that there are of a machine."""
    if plant.windings is not None:
        return FIDELITIES
    return ("force",) if plant.electronics is None else ("force", "phase")


def _windings(plant: Plant) -> tuple[int, int]:
    """Axes and phases of the drive."""
    drive = plant.windings
    return (0, 0) if drive is None else (len(drive.axes), len(drive.phases))


def _symbols(sizes: Mapping[str, int], kind: Any) -> dict[str, Any]:
    return {name: kind.sym(name, size) for name, size in sizes.items()}


def _symbolic_parameters(plant: Plant, g: Mapping[str, Any]) -> Any:
    par, fixed = plant.parameters, shaping(plant.parameters)
    symbols = {name: g[f"machine.{name}"] for name in units_of(par) if name not in fixed}
    return symbolic(par, symbols | {name: symbols[twin] for name, twin in twins_of(par).items()})


def _held(plant: Plant, s: Setup) -> int:
    fast = electronics_of(plant, s)
    if fast is not None:
        return fast.held_size
    axes, phases = _windings(plant)
    return {"force": len(plant.actuator.coils), "dq": axes, "phase": phases}[s.fidelity]


def _measured(plant: Plant, s: Setup, g: Mapping[str, Any], x: Any, noise: Any) -> Any:
    y = (plant.sense(x, g["errors"]) if s.sensed else plant.h(x, 0)) + noise
    if not s.quantize:
        return y
    steps = plant.resolution
    return ca.vertcat(
        *(
            y[i] if _is_zero(step) else ca.if_else(step > 0, step * ca.floor(y[i] / step + 0.5), y[i])
            for i, step in enumerate(steps)
        )
    )


def _is_zero(step: Any) -> bool:
    return isinstance(step, float | int) and step == 0


def _decided(
    plant: Plant,
    c: Controller,
    s: Setup,
    g: Mapping[str, Any],
    machine: Mapping[str, Any],
    controller: Mapping[str, Any],
    given: Mapping[str, Any],
    y: Any,
    v0: Any,
) -> tuple[dict[str, Any], Any, dict[str, Any]]:
    """The control law and the current controllers: controller state after, commands to hold, their part of the row."""
    C = _scheduled_C(c, y) if s.scheduled else None
    p_ref, v_ff = given["p_ref"], given["v_ff"]
    taken = filtered(c.tracks, y, p_ref)
    xi_hat = given["xi_hat"] if s.outside else estimated(g, controller["xi_pred"], taken, C)
    believed = plant_of(c.parameters)
    xi_ref = _law_reference(c, believed, g, given)
    e_now, frozen_now = controller["e"], controller["frozen"]
    xi_pred, e, frozen, v = commanded(g, xi_hat, e_now, frozen_now, y, p_ref, xi_ref, v_ff, v0)
    if s.open_loop:
        v, frozen = v_ff + v0, 0 * frozen  # no limit of the feedback is met
    after: dict[str, Any] = {"xi_pred": xi_pred, "e": e, "frozen": frozen}
    # The gain file's machine turns forces into currents, the simulated one limits those and makes its own forces.
    place = p_ref if s.open_loop else y
    wanted = believed.currents(place, v)
    current, fast = plant.limited(wanted), electronics_of(plant, s)
    met = [ca.mmax(ca.fabs(current - wanted)) > 0]
    row: dict[str, Any] = {"xi_hat": xi_hat, "v": v, "saturated": frozen, "current": current}
    if fast is not None:
        command = _held_if_missed(s, given, controller, fast.held(current, place))
        electric_state = {name: machine[name] for name in fast.state}
        met.append(fast.met(electric_state))
        row |= {"i_phase": machine["i_coil"], "duty": fast.duty(electric_state)}
        row["force"] = plant.forces(machine["x"], machine["i_coil"])
    elif s.fidelity == "force":
        command = _held_if_missed(s, given, controller, current)
        row["force"] = plant.forces(machine["x"], machine["i_coil"])
    else:
        # A law of errors knows no states: what is measured, moving as the reference does.
        known = xi_hat if c.tracks == "states" else state_reference(believed)(y, given["dp_ref"])
        command, electrics, more = _current_control(
            plant, c, s, g, machine, controller, given, current, known
        )
        after |= electrics
        row |= more
    row["met"] = ca.vertcat(*met)
    if s.faulty:
        after = {name: ca.if_else(given["missed"], controller[name], value) for name, value in after.items()}
        after |= {"y_last": y, "command": command}
    queue = ca.vertcat(controller["under_way"], command)
    size = command.numel()
    after["under_way"] = queue[size:, 0]  # a column, also where nothing is left of a single entry
    return after, queue[:size], row


def _law_reference(c: Controller, believed: Plant, g: Mapping[str, Any], given: Mapping[str, Any]) -> Any:
    """xi*: what the states of the law should be; 0 of a law of errors."""
    if c.tracks == "errors":
        return ca.DM(len(c.states), 1)
    p_ref, dp_ref, rates = given["p_ref"], given["dp_ref"], len(c.feedforward.rate)
    faster = ca.vertcat(ca.DM(len(c.A) - rates, 1), g["rate"] @ dp_ref)
    return ca.vertcat(state_reference(believed)(p_ref, dp_ref) + faster, given["v_past"])


@lru_cache(maxsize=16)
def state_reference(believed: Plant) -> ca.Function:
    """(p*, p*') -> (P(z*)^-1 p*, its derivative): what the mechanical states should be.

    Of a machine whose states are not (q, q') the states at rest with the outputs p*.
    """
    p, dp = ca.SX.sym("p", len(believed.outputs)), ca.SX.sym("dp", len(believed.outputs))
    q = believed.position_of(p)
    states = ca.vertcat(q, ca.jtimes(q, p, dp)) if believed.second_order else q
    return ca.Function("q", [p, dp], [ca.densify(states)])


def _scheduled_C(c: Controller, y: Any) -> Any:
    """C at the measured stroke position, on the believed machine at rest there."""
    believed = plant_of(c.parameters)
    x = ca.SX.sym("x", len(believed.states))
    rest = ca.SX.zeros(len(believed.states))
    if believed.has_stroke:
        rest[believed.stroke_state] = y[believed.stroke_output]
    C = ca.jacobian(believed.h(x, 0), x)[:, list(believed.controlled)]
    at = ca.substitute(C, x, rest)
    return ca.horzcat(at, ca.SX(at.shape[0], len(c.states) - at.shape[1]))


def _current_control(
    plant: Plant,
    c: Controller,
    s: Setup,
    g: Mapping[str, Any],
    machine: Mapping[str, Any],
    controller: Mapping[str, Any],
    given: Mapping[str, Any],
    current: Any,
    known: Any,
) -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """PI controllers of the axes, integrals by backward Euler, waiting where the half-bridges are at their limit.

    They run once a control period, as on the machine, where both have 50 us. known: the states that they believe in.
    """
    believed, drive = plant_of(c.parameters), plant.drive
    estimate = ca.SX.zeros(len(believed.states))  # where the controller takes the machine to be
    for k, index in enumerate(believed.controlled):
        estimate[index] = known[k]
    V = machine["link"] * (
        1 - given["sag"] if s.faulty else 1
    )  # measured: the modulators know of a sag at once
    if s.fidelity == "dq":
        i, i_phase = machine["i"], None
    else:
        i_phase = machine["i_phase"]
        i = believed.drive.to_axes(estimate) @ i_phase
    error = believed.drive.command(current) - i
    Q = believed.drive.turned(believed.forces(estimate, current)) if s.turning else ca.SX.eye(len(drive.axes))
    waiting = controller["u_limited"]
    integral = controller["u_integral"] + g["Ki_current"] * g["control_time"] * (1 - waiting) * (Q @ error)
    u = g["Kp"] * error + Q.T @ integral + believed.drive.emf(estimate)
    row: dict[str, Any] = {"link": V, "i": i}
    if s.fidelity == "dq":
        command, limited = inverter.modulation(drive, u, V)
        command = _held_if_missed(s, given, controller, command)
        row |= {"u": command * V, "force": drive.force(i)}
    else:
        u_phase = believed.drive.to_phases(estimate) @ u
        command, limits = inverter.duty_cycles(drive, u_phase, V, i_phase, real_pwm=s.real_pwm)
        limited = ca.vertcat(*_axes_limited(drive, limits))
        command = _held_if_missed(s, given, controller, command)
        T = drive.to_axes(machine["x"])  # where the machine is, whatever the controller takes it to be
        true, applied = T @ i_phase, T @ ((command - 0.5) * V)
        row |= {"u": applied, "force": drive.force(true), "i": true, "i_phase": i_phase, "duty": command}
    return command, {"u_integral": integral, "u_limited": limited}, row


def _held_if_missed(s: Setup, given: Mapping[str, Any], controller: Mapping[str, Any], command: Any) -> Any:
    return ca.if_else(given["missed"], controller["command"], command) if s.faulty else command


def _axes_limited(drive: Any, limits: Any) -> list[Any]:
    """An axis waits when any phase of its group is limited."""
    share = len(drive.phases) // len(drive.groups)
    flags: list[Any] = [0] * len(drive.axes)
    for k, group in enumerate(drive.groups):
        anyone = ca.mmax(limits[k * share : (k + 1) * share])
        for axis in group:
            flags[axis] = anyone
    return flags


def _moved(
    plant: Plant,
    s: Setup,
    g: Mapping[str, Any],
    machine: Mapping[str, Any],
    given: Mapping[str, Any],
    held: Any,
    jitter: Any,
) -> Any:
    """One Runge–Kutta step of the machine under held commands, or a period of its electronics."""
    h = g["substep"]
    outside = (
        given["w"] if s.disturbed else ca.SX(len(plant.disturbances), 1)
    )  # structural zeros cost nothing

    def motion(x: Any, inputs: Any) -> Any:
        w = plant.load(x) + outside
        return plant.f(x, inputs, w + plant.bearing(x) if s.bearing else w)

    x, fast = machine["x"], electronics_of(plant, s)
    if fast is not None:
        own = {name: machine[name] for name in fast.state}
        x, i, own = fast.move(x, machine["i_coil"], own, held, plant.load(x) + outside, jitter)
        return ca.vertcat(x, i, *(own[name] for name in fast.state))
    if s.fidelity == "force":
        currents = _lagging(plant.actuator.crossover, machine["i_coil"], held, h)
        half = len(plant.states) // 2 if plant.second_order else 0
        moved = runge_kutta(lambda x, n: motion(x, plant.forces(x, currents[n])), x, h, half)
        return ca.vertcat(moved, currents[2])
    n, count = len(plant.states), machine["i" if s.fidelity == "dq" else "i_phase"].numel()
    slope = _axis_slope if s.fidelity == "dq" else _phase_slope

    def rate(z: Any, _: int) -> Any:
        x, i, V = z[:n], z[n : n + count], z[n + count]
        forces, electrics = slope(plant, s, given, x, i, V, held)
        return ca.vertcat(motion(x, forces), electrics)

    return runge_kutta(rate, ca.vertcat(*machine.values()), h, n // 2 if plant.second_order else 0)


def _lagging(crossover: Any, i: Any, held: Any, h: Any) -> list[Any]:
    """Currents at the beginning, the middle and the end of a step, exactly: i = held + (i_0 - held) e^(-w_c t)."""
    if isinstance(crossover, float) and math.isinf(crossover):
        return [held] * 3
    lag, decay = i - held, ca.exp(-crossover * h / 2)
    return [held + lag, held + decay * lag, held + decay**2 * lag]


def runge_kutta(rate: Callable[[Any, int], Any], z: Any, h: Any, positions: int = 0) -> Any:
    """One step of the classical method, fourth order. rate: (z, half steps since the beginning: 0, 1 or 2) -> z'.

    positions : how many entries stand first whose rates are the entries that follow them. What the method does to them
        is written in accelerations, as Nyström did: the same numbers in fewer operations.
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
    """Forces, and the slopes of axis currents and link voltage."""
    drive, actuator = plant.drive, plant.actuator
    u = m * V * (1 - given["sag"] if s.faulty else 1)
    di = (u - actuator.R * i - drive.emf(x)) / actuator.L + drive.coupling(x, i)
    power = ca.dot(ca.DM(list(drive.weight)), u * i)
    return drive.force(i), ca.vertcat(di, inverter.link_slope(drive, V, power))


def _phase_slope(
    plant: Plant, s: Setup, given: Mapping[str, Any], x: Any, i: Any, V: Any, d: Any
) -> tuple[Any, Any]:
    """Forces, and the slopes of phase currents and link voltage. Phase-wise u = (d - 1/2) V."""
    drive, actuator = plant.drive, plant.actuator
    u = (d - 0.5) * V * (1 - given["sag"] if s.faulty else 1)
    closed = 1 - given["open"] if s.faulty else ca.SX.ones(len(drive.phases))
    flowing = closed * i
    net = inverter.phase_voltages(drive, u - actuator.R * flowing - drive.to_phases(x) @ drive.emf(x), closed)
    # An open phase loses its current within a sample, and so do the others what they carried for it: the arc is short.
    lost = (1 - closed) * i
    for star in drive.stars if s.faulty else ():
        phases = list(star)
        lost[phases] += closed[phases] * ca.sum1(flowing[phases]) / ca.fmax(ca.sum1(closed[phases]), 1)
    di = net / actuator.L - lost / OPENING
    power = ca.dot(u, flowing)
    return drive.force(drive.to_axes(x) @ flowing), ca.vertcat(di, inverter.link_slope(drive, V, power))


OPENING = 20e-6  # s, time constant with which the current of an opened phase dies
