"""The machine of a gain file as C: what a simulation computes between two samples, in double precision.

    place    (p_ref, dp_ref, offset) -> x: the states that the reference gives, moved by an offset
    begin    (x, v0, cold, par) -> (state, under_way, u_integral): at x, with the currents that make v0, or with none
    substep  (state, command, w, par) -> state: one step of Runge and Kutta, or one period of the machine's electronics
    read     (state, normals, par) -> outputs, readings, currents, forces, contact, x
    shift    (xi_pred, offset) -> xi_pred: the filter knows the offset

`par` are the machine's parameters: those of the gain file at first, of which a co-simulation may change each. `normals`
are normal numbers, the noise of the sensors over its standard deviation. Touchdown bearings and end stops push
back. The functions come from the expressions of period.py, lowered as the controller's are. v0(z) is looked up in C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from malta.firmware.ctext import c_number, c_numbers, function_text, signature
from malta.firmware.period_functions import named_function, symbols
from malta.firmware.program import Program, build_program, lower
from malta.firmware.signals import CField, Target
from malta.firmware.sources import call_text, comment, head_context, number_rows, render, root_context
from malta.firmware.supervisor_text import off_command
from malta.model.parameters import acting_names, twins_of, units_of
from malta.model.plant import Plant, Signal, symbolic
from malta.simulation import references
from malta.simulation.layout import (
    Layout,
    Setup,
    electronics_of,
    held_size,
    layout_of,
    noise_scales,
    numbers_of,
    places_of,
    read_currents,
)
from malta.simulation.period import Period, initial_state, period_of, state_reference
from malta.simulation.readings import COSINE, LOGARITHM, SINE
from malta.simulation.scenario import Scenario, Simulation, simulation_of
from malta.simulation.steps import KINKED_STEPS, substeps_of

SUBSTEP_ROUNDING = 1e-6  # share of a substep that rounding may add, see engines.substeps_until
WAVES = {"logarithm": LOGARITHM, "cosine": COSINE, "sine": SINE}  # polynomials of the noise
OWN_FUNCTIONS = ("begin", "substep", "read")  # functions that only the machine's text calls


@dataclass(frozen=True, eq=False)
class FirmwareMachine:
    """The machine that a gain file knows, under the commands of its exported controller; a Target refuses tables."""

    target: Target

    @property
    def plant(self) -> Plant:
        return self.target.believed

    @cached_property
    def simulation(self) -> Simulation:
        """The simulation whose functions the machine consists of: a wrench and touchdown bearings where it has them."""
        wrench = (
            (lambda t: np.zeros((len(t), len(self.plant.disturbances)))) if self.plant.disturbances else None
        )
        scenario = Scenario(
            "machine",
            1.0,
            references.hold,
            fidelity=self.target.fidelity,
            disturbance=wrench,
            bearing=any(self.plant.contacts.cushioned),
        )
        return simulation_of(self.plant, self.target.controller, scenario)

    @property
    def setup(self) -> Setup:
        return self.simulation.setup

    @cached_property
    def sizes(self) -> Layout:
        return layout_of(self.plant, self.target.controller, self.setup)

    @cached_property
    def substeps(self) -> float:
        """Substeps in a sample, which may be no whole number."""
        count = substeps_of(self.plant, self.target.controller, self.setup, self.simulation.scenario)
        return max(KINKED_STEPS, count)  # loads of a master have kinks, as contacts have

    @cached_property
    def state_size(self) -> int:
        return sum(self.sizes.machine.values())

    @cached_property
    def numbers(self) -> dict[str, ca.DM]:
        """Every number of the loop by name."""
        return numbers_of(self.plant, self.target.controller, self.substeps)

    @cached_property
    def symbols(self) -> dict[str, Any]:
        """A symbol for each parameter of the machine, but for those that set the length of a substep."""
        names = [name for name in acting_names(self.plant.parameters) if not self._sets_substeps(name)]
        return {name: ca.SX.sym(name) for name in names}

    def _sets_substeps(self, name: str) -> bool:
        if electronics_of(self.plant, self.setup) is None:
            return False
        par: Any = self.plant.parameters
        other = self.plant.variant(symbolic(par, {name: 1.01 * getattr(par, name)}))
        given = (self.target.controller, self.setup, self.simulation.scenario)
        return substeps_of(other, *given) != self.substeps

    @cached_property
    def variable(self) -> Plant:
        """The machine with these symbols in place of its parameters."""
        return self.plant.variant(symbolic(self.plant.parameters, self.symbols))

    @cached_property
    def period(self) -> Period:
        """The functions of a control period. Twins, which would share a symbol, are told apart by their last digit."""
        par: Any = self.plant.parameters
        apart = {name: float(np.nextafter(getattr(par, name), np.inf)) for name in twins_of(par)}
        plant = self.plant.variant(replace(par, **apart))
        return period_of(plant, self.target.controller, self.setup, self.numbers, constant=False)

    @cached_property
    def theta(self) -> Any:
        """The numbers of `period`: symbols of the machine's parameters, all others constant."""
        values = {name: ca.SX(value) for name, value in self.numbers.items()}
        values |= {f"machine.{name}": symbol for name, symbol in self.symbols.items()}
        return ca.vertcat(*(ca.vertcat(*value.nonzeros()) for value in values.values()))

    @cached_property
    def parameters(self) -> tuple[str, ...]:
        """The parameters that its start, its motion or its readings depend on."""
        results = [e for _, _, found in _varying_functions(self) for e in found.values()]
        depends = ca.which_depends(ca.vertcat(*results), ca.vertcat(*self.symbols.values()))
        return tuple(name for name, acts in zip(self.symbols, depends, strict=True) if acts)


def command_field(t: Target) -> CField:
    """What the controller commands and the machine takes: duty cycles, shares, set points, or currents of coils."""
    fields = {f.name: f for f in t.output_fields}
    return fields.get("command", fields["current"])


def wrench_fields(m: FirmwareMachine) -> list[CField]:
    """Forces and torques from outside; none for a machine without disturbances."""
    return [CField("w", m.plant.disturbances, "from outside")] if m.plant.disturbances else []


def noise_channels(m: FirmwareMachine) -> int:
    """Normal numbers of a sample; none for sensors with uniform noise, which a master adds to the readings."""
    return 0 if m.plant.sensors.uniform else len(m.plant.outputs) + read_currents(m.plant, m.setup)


def state_field(m: FirmwareMachine, name: str, meaning: str) -> CField:
    return CField(name, m.plant.states, meaning)


def parameter_field(m: FirmwareMachine) -> CField:
    """The parameters that a co-simulation may change."""
    units = units_of(m.plant.parameters)
    signals = tuple(Signal(name, units[name]) for name in m.parameters)
    return CField("machine", signals, "parameter of the machine")


def reading_fields(m: FirmwareMachine) -> list[CField]:
    """What is known of the machine at a sample; the last field is its whole state of motion."""
    plant = m.plant
    fields = [
        CField("p", plant.outputs, "true outputs"),
        CField("y", plant.outputs, "readings of the sensors"),
    ]
    if m.target.driven:
        fields += [
            CField("i", m.target.current_readings, "currents as they are read"),
            CField("link", (Signal("V_link", "V"),), "voltage of the DC link"),
        ]
    else:
        fields.append(CField("i_coil", plant.actuator.coils, "currents of the coils"))
    contacts = tuple(Signal(name, "1") for name in plant.contacts.names)
    return [
        *fields,
        CField("force", plant.inputs, "forces that act"),
        CField("contact", contacts, "used share of each clearance, 1 at contact"),
        state_field(m, "x", "state of motion"),
    ]


def machine_functions(m: FirmwareMachine) -> dict[str, ca.Function]:
    """The functions above by name, before they are lowered."""
    par = ca.vertcat(*(m.symbols[name] for name in m.parameters))
    varying = [
        named_function(name, given | {"par": par}, found) for name, given, found in _varying_functions(m)
    ]
    return {f.name(): f for f in [_place(m), *varying, _shift(m)]}


def _varying_functions(m: FirmwareMachine) -> list[tuple[str, dict[str, Any], dict[str, Any]]]:
    """Name, arguments and results of the functions that depend on the machine's parameters."""
    return [("begin", *_begin(m)), ("substep", *_substep(m)), ("read", *_read(m))]


def machine_programs(m: FirmwareMachine) -> dict[str, Program]:
    """The programs of the functions, by name."""
    return {name: build_program(lower(f, "double")) for name, f in machine_functions(m).items()}


def _place(m: FirmwareMachine) -> ca.Function:
    plant = m.plant
    p, dp = (ca.SX.sym(name, len(plant.outputs)) for name in ("p_ref", "dp_ref"))
    offset = ca.SX.sym("offset", len(plant.states))
    x = ca.SX(offset)
    moving = state_reference(plant)(p, dp)
    for k, index in enumerate(plant.controlled):
        x[index] = moving[k] + offset[index]
    return named_function("place", {"p_ref": p, "dp_ref": dp, "offset": offset}, {"x": x})


def _begin(m: FirmwareMachine) -> tuple[dict[str, Any], dict[str, Any]]:
    plant, c = m.variable, m.target.controller
    x, v0, cold = ca.SX.sym("x", len(plant.states)), ca.SX.sym("v0", len(c.forces)), ca.SX.sym("cold")
    current = (1 - cold) * m.plant.actuator.currents(plant.h(x, 0), v0)
    whole = initial_state(plant, c, m.setup, x, ca.SX.zeros(len(c.states)), current)
    parts = _split(whole, {**m.sizes.machine, **m.sizes.controller})
    return {"x": x, "v0": v0, "cold": cold}, {
        "state": ca.vertcat(*(parts[name] for name in m.sizes.machine)),
        "under_way": parts["under_way"],
        "u_integral": parts.get("u_integral", ca.SX(0, 1)),
    }


def _substep(m: FirmwareMachine) -> tuple[dict[str, Any], dict[str, Any]]:
    p = m.period
    state, command = ca.SX.sym("state", m.state_size), ca.SX.sym("command", p.substep.size1_in(1))
    given = {name: ca.SX.zeros(size) for name, size in m.sizes.given.items()}
    wrench = symbols(wrench_fields(m))
    around = ca.vertcat(*(given | wrench).values())
    after = p.substep(state, command, around, ca.SX.zeros(p.substep.size1_in(3)), m.theta)
    return {"state": state, "command": command, **wrench}, {"state_next": after}


def _read(m: FirmwareMachine) -> tuple[dict[str, Any], dict[str, Any]]:
    p, plant, sizes = m.period, m.plant, m.sizes
    state, outputs = ca.SX.sym("state", m.state_size), len(plant.outputs)
    normals = ca.SX.sym("normals", noise_channels(m))
    whole = ca.vertcat(state, ca.SX.zeros(sum(sizes.controller.values())))
    given = ca.SX.zeros(sum(sizes.given.values()))
    noise = ca.SX.zeros(outputs + read_currents(plant, m.setup))
    if noise_channels(m):
        noise = ca.vertcat(*noise_scales(m.variable, m.setup)) * normals
    measured, _ = p.sense(whole, given, noise, m.theta)
    row = _split(p.decide(whole, given, measured, ca.SX.zeros(len(plant.inputs)), m.theta)[2], sizes.row)
    known = _split(state, sizes.machine)
    read = row | known | {"y": measured[:outputs]}
    if m.setup.current_sensors and m.target.driven:
        errors = measured[outputs:]
        dq = m.target.fidelity == "dq"
        turned = m.variable.drive.to_axes(known["x"]) @ errors if dq else errors
        read["i"] = known["i" if dq else "i_phase"] + turned
    elif m.target.driven:
        read["i"] = known["i" if m.target.fidelity == "dq" else "i_phase"]
    return {"state": state, "normals": normals}, {f.name: read[f.name] for f in reading_fields(m)}


def _shift(m: FirmwareMachine) -> ca.Function:
    """As inputs.initial_values: forces that are under way come from currents commutated for the place of the mover."""
    c, plant = m.target.controller, m.plant
    xi_pred, offset = ca.SX.sym("xi_pred", len(c.states)), ca.SX.sym("offset", len(plant.states))
    after = ca.SX(xi_pred)
    if c.tracks == "states":
        n, forces, known = len(plant.controlled), len(c.forces), c.lagging + c.stored
        moved = offset[list(plant.controlled)]
        after[:n] += moved
        if known:
            newest = n + forces * (known - 1)
            pull = ca.sparsify(ca.DM(c.Ad[newest : newest + forces, :n])) @ moved
            after[n : n + forces * known] += ca.repmat(pull, known, 1)
    return named_function("shift", {"xi_pred": xi_pred, "offset": offset}, {"xi_pred_next": after})


def _split(vector: Any, sizes: Mapping[str, int]) -> dict[str, Any]:
    """The parts of a vector by name."""
    return {name: vector[place, 0] for name, place in places_of(sizes).items()}


def machine_sources(m: FirmwareMachine, name: str, functions: tuple[str, ...]) -> dict[str, str]:
    """<name>.h and <name>.c with these of the functions. name : a C identifier"""
    programs = machine_programs(m)
    context = _context(m, {key: programs[key] for key in functions}, name)
    return {f"{name}.{end}": render(f"fmu_machine.{end}", context) for end in ("h", "c")}


def _context(m: FirmwareMachine, programs: Mapping[str, Program], name: str) -> dict[str, Any]:
    plant, c = m.plant, m.target.controller

    command = command_field(m.target)
    electric = next(name for name in ("i", "i_phase", "i_coil") if name in m.sizes.machine)
    flowing = places_of(m.sizes.machine)[electric]
    places = {
        "state": "s->state",
        "state_next": "s->state",
        "under_way": "s->under_way",
        "command": "acting",
        "u_integral": "u_integral",
        "v0": "v0",
        "w": "w",
        "par": "par",
        "cold": "&cold",
        "normals": "normals",
        **{f.name: f"r->{f.name}" for f in reading_fields(m)},
    }
    ff = c.feedforward
    return head_context(m.target, name) | {
        "machine": comment(plant.name),
        "period": f"{c.sample_time * 1e6:g} us",
        "substeps": c_number(m.substeps, "double"),
        "tiny": c_number(SUBSTEP_ROUNDING, "double"),
        "state": m.state_size,
        "states": len(plant.states),
        "held": command.size,
        "acting": held_size(plant, m.setup),
        "delay": m.setup.delay,
        "off": c_numbers(off_command(m.target) or [0.0] * command.size, "double"),
        "flowing": {"at": flowing.start, "size": flowing.stop - flowing.start},
        "wrench": sum(f.size for f in wrench_fields(m)),
        "forces": len(c.forces),
        "volts": m.sizes.controller.get("u_integral", 0),
        "parameters": len(m.parameters),
        "noises": noise_channels(m),
        "at": f"x[{plant.stroke_state}]" if plant.has_stroke else c_number(ff.z_grid[0], "double"),
        "points": len(ff.z_grid),
        "z_rows": number_rows(ff.z_grid, 6, "double"),
        "v0_rows": number_rows(ff.v0, len(c.forces), "double"),
        "reads": [f for f in reading_fields(m) if f.size],
        "functions": "\n".join(
            function_text(p, name, "double", static=key in OWN_FUNCTIONS) for key, p in programs.items()
        ),
        "declarations": [signature(p, name) for key, p in programs.items() if key not in OWN_FUNCTIONS],
        "call_begin": call_text(programs["begin"], name, places | {"x": "x"}),
        "call_substep": call_text(programs["substep"], name, places),
        "call_read": call_text(programs["read"], name, places),
        **{key: c_numbers(values, "float") for key, values in WAVES.items()},
        "root": noise_channels(m) > 0 or any(o.op == "SQRT" for p in programs.values() for o in p.operations),
        **root_context("double"),
    }
