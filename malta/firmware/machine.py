"""The machine of a gain file as C: what a simulation without noise computes between two samples, in double precision.

    place    (p_ref, dp_ref, offset) -> x: the states that the reference gives, moved by an offset
    begin    (x, v0) -> (state, under_way, u_integral): at rest or in motion at x, with the currents that make v0
    substep  (state, command, w) -> state: one step of Runge and Kutta, or one period of the machine's electronics
    read     (state) -> outputs, readings, currents, forces, contact, x
    shift    (xi_pred, offset) -> xi_pred: the filter knows the offset

They come from the expressions of period.py, lowered as the controller's are. v0(z) is looked up in C.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from typing import Any

import casadi as ca
import numpy as np

from malta.firmware.ctext import c_number, function_text, signature
from malta.firmware.export import call_text, comment, number_rows, render, root_context
from malta.firmware.lowering import lower
from malta.firmware.parts import named_function, symbols
from malta.firmware.program import Program, program_of
from malta.firmware.signals import Field, Target, current_readings, output_fields
from malta.model.plant import Plant, Signal
from malta.simulation import references
from malta.simulation.layout import Layout, Setup, layout_of, numbers_of, places_of, read_currents
from malta.simulation.period import Period, initial_state, period_of, state_reference
from malta.simulation.scenario import Scenario, setup_of, substeps_of

TINY = 1e-6  # share of a substep that rounding may add, see engines.substeps_until
OWN = ("begin", "substep", "read")  # functions that only the machine's text calls


@dataclass(frozen=True, eq=False)
class Machine:
    """The machine that a gain file knows, under the commands of its exported controller; a Target refuses tables."""

    target: Target

    @property
    def plant(self) -> Plant:
        return self.target.believed

    @cached_property
    def scenario(self) -> Scenario:
        """The scenario whose functions the machine consists of: no noise, a wrench where the machine has one."""
        wrench = (
            (lambda t: np.zeros((len(t), len(self.plant.disturbances)))) if self.plant.disturbances else None
        )
        return Scenario("machine", 1.0, references.hold, fidelity=self.target.fidelity, disturbance=wrench)

    @cached_property
    def setup(self) -> Setup:
        return setup_of(self.plant, self.target.controller, self.scenario)

    @cached_property
    def sizes(self) -> Layout:
        return layout_of(self.plant, self.target.controller, self.setup)

    @cached_property
    def substeps(self) -> float:
        """Substeps in a sample, which may be no whole number."""
        return substeps_of(self.plant, self.target.controller, self.setup, self.scenario)

    @cached_property
    def state_size(self) -> int:
        return sum(self.sizes.machine.values())

    @cached_property
    def period(self) -> Period:
        c = self.target.controller
        numbers = numbers_of(self.plant, c, self.substeps)
        return period_of(self.plant, c, self.setup, numbers, constant=True)


def command_field(t: Target) -> Field:
    """What the controller commands and the machine takes: duty cycles, shares, set points, or currents of coils."""
    fields = {f.name: f for f in output_fields(t)}
    return fields.get("command", fields["current"])


def wrench_fields(m: Machine) -> list[Field]:
    """Forces and torques from outside; none for a machine without disturbances."""
    return [Field("w", m.plant.disturbances, "from outside")] if m.plant.disturbances else []


def state_field(m: Machine, name: str, meaning: str) -> Field:
    return Field(name, m.plant.states, meaning)


def reading_fields(m: Machine) -> list[Field]:
    """What is known of the machine at a sample; the last field is its whole state of motion."""
    plant = m.plant
    fields = [Field("p", plant.outputs, "true outputs"), Field("y", plant.outputs, "readings of the sensors")]
    if m.target.driven:
        fields += [
            Field("i", current_readings(m.target), "currents as they are read"),
            Field("link", (Signal("V_link", "V"),), "voltage of the DC link"),
        ]
    else:
        fields.append(Field("i_coil", plant.actuator.coils, "currents of the coils"))
    contacts = tuple(Signal(name, "1") for name in plant.contacts)
    return [
        *fields,
        Field("force", plant.inputs, "forces that act"),
        Field("contact", contacts, "used share of each clearance, 1 at contact"),
        state_field(m, "x", "state of motion"),
    ]


def machine_functions(m: Machine) -> dict[str, ca.Function]:
    """The functions above by name, before they are lowered."""
    found = [_place(m), _begin(m), _substep(m), _read(m), _shift(m)]
    return {f.name(): f for f in found}


def machine_programs(m: Machine) -> dict[str, Program]:
    """The programs of the functions, by name."""
    return {name: program_of(lower(f, "double")) for name, f in machine_functions(m).items()}


def _place(m: Machine) -> ca.Function:
    plant = m.plant
    p, dp = (ca.SX.sym(name, len(plant.outputs)) for name in ("p_ref", "dp_ref"))
    offset = ca.SX.sym("offset", len(plant.states))
    x = ca.SX(offset)
    moving = state_reference(plant)(p, dp)
    for k, index in enumerate(plant.controlled):
        x[index] = moving[k] + offset[index]
    return named_function("place", {"p_ref": p, "dp_ref": dp, "offset": offset}, {"x": x})


def _begin(m: Machine) -> ca.Function:
    plant, c = m.plant, m.target.controller
    x, v0 = ca.SX.sym("x", len(plant.states)), ca.SX.sym("v0", len(c.forces))
    current = plant.currents(plant.h(x, 0), v0)
    whole = initial_state(plant, c, m.setup, x, ca.SX.zeros(len(c.states)), current)
    parts = _split(whole, {**m.sizes.machine, **m.sizes.controller})
    results = {
        "state": ca.vertcat(*(parts[name] for name in m.sizes.machine)),
        "under_way": parts["under_way"],
        "u_integral": parts.get("u_integral", ca.SX(0, 1)),
    }
    return named_function("begin", {"x": x, "v0": v0}, results)


def _substep(m: Machine) -> ca.Function:
    p = m.period
    state, command = ca.SX.sym("state", m.state_size), ca.SX.sym("command", p.substep.size1_in(1))
    given = {name: ca.SX.zeros(size) for name, size in m.sizes.given.items()}
    wrench = symbols(wrench_fields(m))
    around = ca.vertcat(*(given | wrench).values())
    after = p.substep(state, command, around, ca.SX.zeros(p.substep.size1_in(3)), ca.SX(0, 1))
    return named_function("substep", {"state": state, "command": command, **wrench}, {"state_next": after})


def _read(m: Machine) -> ca.Function:
    p, plant, sizes = m.period, m.plant, m.sizes
    state, outputs = ca.SX.sym("state", m.state_size), len(plant.outputs)
    whole = ca.vertcat(state, ca.SX.zeros(sum(sizes.controller.values())))
    given = ca.SX.zeros(sum(sizes.given.values()))
    measured, _ = p.sense(whole, given, ca.SX.zeros(outputs + read_currents(plant, m.setup)), ca.SX(0, 1))
    row = _split(p.decide(whole, given, measured, ca.SX.zeros(len(plant.inputs)), ca.SX(0, 1))[2], sizes.row)
    known = _split(state, sizes.machine)
    read = row | known | {"y": measured[:outputs]}
    if m.setup.current_sensors and m.target.driven:
        errors = measured[outputs:]
        dq = m.target.fidelity == "dq"
        read["i"] = known["i"] + plant.drive.to_axes(known["x"]) @ errors if dq else known["i_phase"] + errors
    elif m.target.driven:
        read["i"] = known["i" if m.target.fidelity == "dq" else "i_phase"]
    return named_function("read", {"state": state}, {f.name: read[f.name] for f in reading_fields(m)})


def _shift(m: Machine) -> ca.Function:
    """As inputs.initial_values: forces that are under way come from currents commutated for the place of the mover."""
    c, plant = m.target.controller, m.plant
    xi_pred, offset = ca.SX.sym("xi_pred", len(c.states)), ca.SX.sym("offset", len(plant.states))
    after = ca.SX(xi_pred)
    if c.tracks == "states":
        n, forces, known = len(plant.controlled), len(c.forces), c.lagging + c.delay
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


def machine_sources(m: Machine, name: str, functions: tuple[str, ...]) -> dict[str, str]:
    """<name>.h and <name>.c with these of the functions. name : a C identifier"""
    programs = machine_programs(m)
    context = _context(m, {key: programs[key] for key in functions}, name)
    return {f"{name}.{end}": render(f"fmu_machine.{end}", context) for end in ("h", "c")}


def _context(m: Machine, programs: Mapping[str, Program], name: str) -> dict[str, Any]:
    plant, c = m.plant, m.target.controller

    command = command_field(m.target)
    places = {
        "state": "s->state",
        "state_next": "s->state",
        "under_way": "s->under_way",
        "command": "acting",
        "u_integral": "u_integral",
        "v0": "v0",
        "w": "w",
        **{f.name: f"r->{f.name}" for f in reading_fields(m)},
    }
    ff = c.feedforward
    return {
        "name": name,
        "NAME": name.upper(),
        "machine": comment(plant.name),
        "version": version("malta"),
        "period": f"{c.sample_time * 1e6:g} us",
        "substeps": c_number(m.substeps, "double"),
        "tiny": c_number(TINY, "double"),
        "state": m.state_size,
        "states": len(plant.states),
        "held": command.size,
        "delay": m.setup.delay,
        "wrench": sum(f.size for f in wrench_fields(m)),
        "forces": len(c.forces),
        "volts": m.sizes.controller.get("u_integral", 0),
        "at": f"x[{plant.stroke_state}]" if plant.has_stroke else c_number(ff.z_grid[0], "double"),
        "points": len(ff.z_grid),
        "z_rows": number_rows(ff.z_grid, 6, "double"),
        "v0_rows": number_rows(ff.v0, len(c.forces), "double"),
        "reads": [f for f in reading_fields(m) if f.size],
        "functions": "\n".join(
            function_text(p, name, "double", static=key in OWN) for key, p in programs.items()
        ),
        "declarations": [signature(p, name) for key, p in programs.items() if key not in OWN],
        "call_begin": call_text(programs["begin"], name, places | {"x": "x"}),
        "call_substep": call_text(programs["substep"], name, places),
        "call_read": call_text(programs["read"], name, places),
        "root": any(o.op == "SQRT" for p in programs.values() for o in p.operations),
        **root_context("double"),
    }
