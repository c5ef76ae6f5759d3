"""The exported C flies: an engine of simulations whose control law is the compiled controller.

The machine, its sensors and the delay are those of every simulation, computed by CasADi's virtual machine; the law, the
current loops and what they remember are the C's. It reads what a controller reads, and nothing else.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.firmware.ctext import c_name
from malta.firmware.program import Precision
from malta.firmware.signals import CField, Target
from malta.firmware.sources import sources
from malta.model.plant import Plant
from malta.simulation.engine.compiled import library
from malta.simulation.engine.engines import Engine, evaluate, substeps_until
from malta.simulation.layout import (
    Layout,
    Setup,
    columns_of_row,
    command_size,
    layout_of,
    numbers_of,
    places_of,
    signals_of,
)
from malta.simulation.period import Period, period_of
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import Prepared, sensor_errors_of
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller

# The exported C, compiled on this computer and called from Python: `--controller c`, and tests.


REALS: dict[Precision, Any] = {"double": ctypes.c_double, "float": ctypes.c_float}
TUNABLES = ("_parameters.c",)  # of a controller that is tunable
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")


class Native(NamedTuple):
    """A compiled controller; its records are ctypes structures with arrays of the names in signals.py."""

    target: Target
    lib: Any
    name: str
    State: Any
    Reference: Any
    Inputs: Any
    Outputs: Any


@lru_cache(maxsize=16)
def compile_controller(t: Target) -> Native:
    """The controller's C, compiled. Raises InputError without a C compiler."""
    name = c_name(t.controller.name)
    files = sources(t, "", name)
    lib = compile_files(
        [files[f"{name}{end}"] for end in (".h", ".c", "_parts.c", *TUNABLES) if f"{name}{end}" in files]
    )
    real = REALS[t.precision]

    def record(title: str, fields: list[CField], more: tuple[tuple[str, Any], ...] = ()) -> Any:
        return record_type(title, (*((f.name, real * f.size) for f in fields if f.size), *more))

    Reference = record("Reference", t.reference_fields)
    addresses = ("z", "v0", "parameters") if t.tunable else ("z", "v0")
    table = (*((key, ctypes.c_void_p) for key in addresses), ("points", ctypes.c_int32))
    return Native(
        t,
        lib,
        name,
        record("State", t.state_fields, (("reference", Reference), *table)),
        Reference,
        record("Inputs", t.input_fields),
        record("Outputs", t.output_fields),
    )


@cache
def record_type(title: str, fields: tuple[tuple[str, Any], ...]) -> Any:
    """The ctypes structure of these fields: one type, so a controller compiled again takes the records of before."""
    return type(title, (ctypes.Structure,), {"_fields_": fields})


def compile_files(texts: Sequence[str]) -> Any:
    """The library of C files in this order, headers first. Raises InputError without a C compiler."""
    lib = library(re.sub(r'#include "\w+\.h"\n', "", "".join(texts)), 1, flags=FLAGS)
    if lib is None:
        raise InputError("export", "C compiler", "none that works", "cc, gcc or clang, or $CC")
    return lib


def call(native: Native, function: str, *arguments: Any) -> int:
    """Call a function of the controller with records and numbers."""
    given = [ctypes.byref(a) if isinstance(a, ctypes.Structure) else a for a in arguments]
    return int(getattr(native.lib, f"{native.name}_{function}")(*given))


def new_state(native: Native) -> Any:
    """A state at rest."""
    state = native.State()
    call(native, "init", state)
    return state


def write(record: Any, values: Mapping[str, Any]) -> None:
    """Put vectors into the arrays of a record."""
    for name, value in values.items():
        array = getattr(record, name)
        array[:] = np.asarray(value, dtype=float).ravel().tolist()


def view(record: Any, name: str) -> Any:
    """The array of a record as numpy sees it, in place."""
    return np.ctypeslib.as_array(getattr(record, name))


# (inputs, outputs, sample, steps missed before it) -> nothing: what runs at every sample; and what makes it for a state
Step = Callable[[Any, Any, int, int], None]
StepOf = Callable[[Native, Any], Step]
SERIES_COMPARED = ("p", "y", "xi_hat", "v", "current", "force", "i", "u", "i_phase", "duty")


def _own_step(native: Native, state: Any) -> Step:
    """The controller's own step."""
    step = getattr(native.lib, f"{native.name}_step")

    def run(inputs: Any, outputs: Any, _: int, __: int) -> None:
        step(ctypes.byref(state), ctypes.byref(inputs), ctypes.byref(outputs))

    return run


def engine_of_c(
    precision: Precision = "double", step_of: StepOf = _own_step
) -> Callable[[Prepared, Plant, float], Engine]:
    """Make the engine with which `malta.simulate` runs the exported C in place of the control law.

    The machine, its sensors and the delay are those of every simulation; the law, the current loops and their memory
    are the compiled controller's.

    precision : of the C, "double" or "float"
    step_of : makes what runs at every sample of a run, for the controller's state; by default the controller's own step

    Returns a function for the argument `engine` of `malta.simulate` and `malta.simulation.simulate_many`.

    Raises InputError without a C compiler, and for what the export does not have. That is another estimator, C at the
    measured position, axes that turn, forces known in advance, or an open loop.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> off = {"x": 20e-6}  # m
    >>> hold = malta.Scenario("hold", 2e-3, malta.references.hold, off, fidelity="force")
    >>> exported = malta.firmware.engine_of_c("double")
    >>> flown = malta.simulate(plant, controller, hold, engine=exported)
    >>> run = malta.simulate(plant, controller, hold)
    >>> flown.engine, bool(abs(flown.v - run.v).max() < 1e-9)  # N
    ('exported C, double', True)
    """
    sessions: dict[int, tuple[Any, Any, Step]] = {}

    def engine(ready: Prepared, now: Plant, substeps: float) -> Engine:
        return _engine(ready, now, substeps, precision, sessions, step_of)

    return engine


def _engine(
    ready: Prepared,
    now: Plant,
    substeps: float,
    precision: Precision,
    sessions: dict[int, tuple[Any, Any, Step]],
    step_of: StepOf,
) -> Engine:
    """The engine of a machine; one run has one state of the controller, also where the machine changes on the way."""
    simulation, inputs = ready.simulation, ready.inputs
    c, setup = simulation.controller, simulation.setup
    _require_exported(simulation.scenario, setup)
    excitation = simulation.scenario.excitation
    native = compile_controller(_target(c, precision, setup.fidelity, excitation is not None))
    forces = np.zeros((len(inputs.t), 0)) if excitation is None else excitation(inputs.t)
    sizes = layout_of(simulation.plant, c, setup)
    if id(inputs) not in sessions:
        sessions.clear()
        first_state = _first_state(native, sizes, ready)
        sessions[id(inputs)] = inputs, first_state, step_of(native, first_state)
    _, state, step = sessions[id(inputs)]
    machine = _machine(now, c, setup, substeps, sensor_errors_of(simulation.scenario))

    def run(
        first: int, begin: FloatArray, given: FloatArray, noise: FloatArray, fast: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        part = slice(first, first + len(given))
        beside = np.hstack([inputs.motion.ddp[part], forces[part]])
        flight = _ControllerFlight(native, state, step, sizes, machine, setup)
        return _fly(flight, first, begin, given, noise, fast, beside, substeps)

    return Engine(f"exported C, {precision}", run)


@lru_cache(maxsize=16)
def _target(c: Controller, precision: Precision, fidelity: Any, excited: bool) -> Target:
    return Target(c, precision, fidelity, excited=excited)


def _require_exported(scenario: Scenario, s: Setup) -> None:
    """InputError for a setup whose law is not the exported one."""
    for name, found in (
        ("estimator", s.outside),
        ("scheduled", s.scheduled),
        ("bearing_axes", s.turning),
        ("anticipated", s.anticipated),
        ("open_loop", s.open_loop),
    ):
        if found:
            raise InputError(scenario.where, name, "a law that is not exported", "the gain file's own law")


class _Machine(NamedTuple):
    """The functions of the simulated machine."""

    sense: ca.Function  # (state, given, noise) -> y and errors of currents
    record: ca.Function  # (state, given, y, outputs of the controller) -> row
    motion: Callable[[int], ca.Function]  # substeps -> (machine, held, given, fast noise) -> machine


@lru_cache(maxsize=8)
def _machine(
    plant: Plant, c: Controller, setup: Setup, substeps: float, errors: tuple[tuple[str, float], ...]
) -> _Machine:
    period = period_of(plant, c, setup, numbers_of(plant, c, substeps, dict(errors)), constant=True)
    return _Machine(
        period.sense, _record(plant, c, setup, period), cache(lambda count: _motion(period, count))
    )


def _motion(p: Period, count: int) -> ca.Function:
    """`count` substeps in one call."""
    machine, held = ca.MX.sym("machine", p.substep.size1_in(0)), ca.MX.sym("held", p.substep.size1_in(1))
    given = ca.MX.sym("given", p.substep.size1_in(2))
    jitter = ca.MX.sym("jitter", p.substep.size1_in(3), count)
    after = machine
    if count <= 16:
        for k in range(count):
            after = p.substep(after, held, given, jitter[:, k], ca.DM(0, 1))
    else:
        state, noise = ca.MX.sym("state", machine.numel()), ca.MX.sym("noise", p.substep.size1_in(3))
        fixed = ca.MX.sym("fixed", held.numel() + given.numel())
        parts = ca.vertsplit(fixed, [0, held.numel(), fixed.numel()])
        step = ca.Function("step", [state, noise, fixed], [p.substep(state, *parts, noise, ca.DM(0, 1))])
        after = step.mapaccum("steps", count)(machine, jitter, ca.repmat(ca.vertcat(held, given), 1, count))[
            :, -1
        ]
    return ca.Function("motion", [machine, held, given, ca.vec(jitter)], [ca.densify(after)])


_REPLACED_SERIES = ("xi_hat", "v", "saturated", "current", "met", "command")


def _record(plant: Plant, c: Controller, setup: Setup, p: Period) -> ca.Function:
    """(state, given, y, outputs) -> row: what the machine knows of a sample, and what the C commanded."""
    sizes = layout_of(plant, c, setup)
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    state, given = kind.sym("state", p.decide.size1_in(0)), kind.sym("given", p.decide.size1_in(1))
    y = kind.sym("y", p.decide.size1_in(2))
    count = command_size(plant, setup)
    widths = {
        "xi_hat": len(c.states),
        "v": len(c.forces),
        "saturated": len(c.forces),
        "current": sizes.row["current"],
    }
    out = {name: kind.sym(name, size) for name, size in (widths | {"met": 1, "command": count}).items()}
    own = p.decide(state, given, y, ca.DM.zeros(len(c.forces)), ca.DM(0, 1))[2]
    row = {name: own[place, 0] for name, place in columns_of_row(plant, c, setup).items()}
    row |= {name: out[name] for name in widths}
    row["met"] = ca.vertcat(out["met"], row["met"][1:, 0])
    if "u" in sizes.row:
        signals = signals_of(sizes, ca.SX)
        machine, inputs = signals.machine, signals.given
        V = machine["link"] * (1 - inputs["sag"] if setup.faulty else 1)
        drive = plant.drive
        if setup.fidelity == "dq":
            u = out["command"] * V
        else:
            u = drive.to_axes(machine["x"]) @ ((out["command"] - 0.5) * V)
            row["duty"] = out["command"]
        whole = [
            ca.vertcat(*machine.values(), *signals.controller.values()),
            ca.vertcat(*inputs.values()),
            out["command"],
        ]
        row["u"] = ca.Function("u", whole, [u])(state, given, out["command"])
    values = ca.vertcat(*(row[name] for name in sizes.row))
    return ca.Function("record", [state, given, y, ca.vertcat(*out.values())], [ca.densify(ca.cse(values))])


def _first_state(native: Native, sizes: Layout, ready: Prepared) -> Any:
    """The controller's state at the start of a run: what the simulation's own law would remember."""
    state = new_state(native)
    inputs, start = ready.inputs, ready.state
    reference = (inputs.motion.p[0], inputs.motion.dp[0], inputs.motion.ddp[0])
    for name, values in zip(("p", "dp", "ddp"), reference, strict=True):
        view(state.reference, name)[:] = values
    call(native, "start", state)
    known = places_of(sizes.controller, sum(sizes.machine.values()))
    for field in native.target.state_fields:
        if field.name in known and field.size:
            view(state, field.name)[:] = start[known[field.name]]
    machine = places_of(sizes.machine)
    if "i_last" in {f.name for f in native.target.state_fields}:
        view(state, "i_last")[:] = start[machine["i_phase" if "i_phase" in machine else "i"]]
    return state


class _ControllerFlight(NamedTuple):
    """A controller on its way with a machine."""

    native: Native
    state: Any
    step: Step
    sizes: Layout
    machine: _Machine
    setup: Setup


def _fly(
    f: _ControllerFlight,
    first: int,
    begin: FloatArray,
    given: FloatArray,
    noise: FloatArray,
    fast: FloatArray,
    beside: FloatArray,
    substeps: float,
) -> tuple[FloatArray, FloatArray]:
    """Samples of a run: the last state, and rows. `beside`: accelerations of the reference, then the excitation."""
    inputs, outputs = f.native.Inputs(), f.native.Outputs()
    held_state = np.array(begin, dtype=float)
    states = np.empty((len(given), len(held_state)))
    reads = np.empty((len(given), f.machine.sense.size1_out(0)))
    entries = {name: view(outputs, name) for name in _REPLACED_SERIES if hasattr(outputs, name)}
    if f.setup.fidelity == "force":
        entries["command"] = entries["current"]
    commands = np.empty((len(given), sum(entries[name].size for name in _REPLACED_SERIES)))
    places = places_of({**f.sizes.machine, **f.sizes.controller})
    around = places_of(f.sizes.given)
    machine = slice(0, sum(f.sizes.machine.values()))
    done = substeps_until(first, substeps)
    begin_substep = done
    lost = 0
    call_valid(inputs)
    for k, row in enumerate(given):
        states[k] = held_state
        read, _ = (x.ravel() for x in evaluate(f.machine.sense, held_state, row, noise[k], np.empty(0)))
        reads[k] = read
        missed = f.setup.faulty and row[around["missed"]][0]
        lost += int(missed)
        if not missed:
            _put(f, inputs, held_state, row, read, beside[k], places, around)
            f.step(inputs, outputs, first + k, lost)
            lost = 0
            for name in ("xi_pred", "e", "frozen", "u_integral", "u_limited"):
                if name in places:
                    held_state[places[name]] = view(f.state, name)
            if f.setup.faulty:
                held_state[places["command"]] = entries["command"]
        if f.setup.faulty:
            held_state[places["y_last"]] = read[: f.sizes.row["y"]]
        command = held_state[places["command"]] if missed else np.array(entries["command"], dtype=float)
        commands[k] = np.concatenate([entries[name] for name in _REPLACED_SERIES])
        commands[k, commands.shape[1] - len(command) :] = command
        queue = np.concatenate([held_state[places["under_way"]], command])
        held_state[places["under_way"]] = queue[len(command) :]
        end = substeps_until(first + k + 1, substeps)
        jitter = fast[done - begin_substep : end - begin_substep].ravel()
        motion, acting = f.machine.motion(end - done), queue[: len(command) * (2 if f.setup.fraction else 1)]
        held_state[machine] = evaluate(motion, held_state[machine], acting, row, jitter)[0].ravel()
        done = end
    rows = evaluate(f.machine.record.map(len(given)), states, given, reads, commands)[0]
    return held_state, rows


def call_valid(inputs: Any) -> None:
    """No sensor calls its reading invalid: faults of the sample before are over."""
    for name in ("y_valid", "i_valid"):
        if hasattr(inputs, name):
            view(inputs, name)[:] = 1


def _put(
    f: _ControllerFlight,
    inputs: Any,
    state: FloatArray,
    row: FloatArray,
    read: FloatArray,
    beside: FloatArray,
    places: dict[str, slice],
    around: dict[str, slice],
) -> None:
    """Give a sample's reference and readings to the controller."""
    reference = f.state.reference
    view(reference, "p")[:] = row[around["p_ref"]]
    view(reference, "dp")[:] = row[around["dp_ref"]]
    axes = len(view(reference, "ddp"))
    view(reference, "ddp")[:] = beside[:axes]
    if f.native.target.excited:
        view(inputs, "excitation")[:] = beside[axes:]
    outputs = f.sizes.row["y"]
    view(inputs, "y")[:] = read[:outputs]
    if f.native.target.driven:
        currents = state[places["i_phase" if "i_phase" in places else "i"]]
        view(inputs, "i")[:] = currents
        if f.setup.current_sensors and f.setup.fidelity == "phase":
            view(inputs, "i")[:] = currents + read[outputs:]
        sag = row[around["sag"]][0] if f.setup.faulty else 0.0
        view(inputs, "link")[:] = state[places["link"]] * (1 - sag)


@dataclass(frozen=True)
class SignalDifference:
    """How far a signal of two runs is apart at most, and the range of the signal."""

    name: str
    largest: float
    range: float

    @property
    def share(self) -> float:
        """The difference as a share of the range."""
        return self.largest / self.range if self.range else self.largest


def differences(
    run: Trajectory, other: Trajectory, names: Sequence[str] = SERIES_COMPARED
) -> list[SignalDifference]:
    """The largest differences of two runs' signals, over the samples that both have."""
    samples = min(len(run.t), len(other.t))
    found = []
    for name in names:
        one, two = getattr(run, name)[:samples], getattr(other, name)[:samples]
        if one.size:
            found.append(SignalDifference(name, float(np.abs(one - two).max()), float(np.abs(one).max())))
    return found
