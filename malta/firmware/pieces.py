"""The pieces of a control period that are usable alone, and all functions of an export together.

calibrate          y = gain raw + offset
hall_position      z of the sine and the cosine of two Hall sensors half a pole apart
positions          y -> q
filter, law        xi_hat from a reading; forces within their limits, and what the filter expects next
sum_errors         e += Ts (p* - y), where no axis waits
feedforward        forces of a reference;  reference_states: what the states are on it
currents           forces -> coil currents where the machine is;  set_points: those of a machine's own electronics
current_control    PI current loops: currents, readings and link voltage -> voltages of axes or duty cycles
to_axes, to_phases, induced_voltage    dq transformations and the voltages that motion induces
logistic, quintic  shares of a stroke with their rates
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import casadi as ca

from malta.firmware.calibration import law_arguments
from malta.firmware.lowering import lower
from malta.firmware.parts import (
    Sums,
    currents,
    decide_function,
    drive_currents,
    feedforward,
    named_function,
    numbers,
    places_in_table,
    sense_function,
    state_function,
    symbols,
    table_size,
)
from malta.firmware.signals import Field, Target, input_fields, reference_fields, state_fields
from malta.model.plant import Plant
from malta.simulation import references
from malta.simulation.layout import electronics_of
from malta.simulation.period import state_reference
from malta.synthesis.controller import commanded, estimated, filtered, freeze_moving, sum_errors


def parts_of(t: Target) -> dict[str, ca.Function]:
    """All functions of an export by name, lowered: `sense` and `decide`, then the pieces that are usable alone."""
    functions = [sense_function(t), decide_function(t), state_function(t), *pieces(t)]
    return {f.name(): lower(f, t.precision) for f in functions}


def pieces(t: Target) -> list[ca.Function]:
    """The pieces of a control period that are usable alone."""
    return [*_law_pieces(t), *_current_pieces(t), *strokes(), *_transformations(t.believed)]


def _law_pieces(t: Target) -> list[ca.Function]:
    """From readings to forces."""
    c, plant = t.controller, t.believed
    g = numbers(t)
    n, m, outputs = len(c.states), len(c.forces), len(c.measurements)
    sizes = {
        "raw": outputs,
        "gain": outputs,
        "offset": outputs,
        "y": outputs,
        "e": outputs,
        "frozen": outputs,
    }
    sizes |= {"xi_pred": n, "xi_hat": n, "xi_ref": n, "v_ff": m, "v0": m}
    x = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    reference = symbols(reference_fields(t))
    p, dp, ddp = reference.values()

    def some(*names: str) -> dict[str, Any]:
        return {name: x[name] for name in names}

    following, saturated, v = commanded(g, x["xi_hat"], x["e"], x["xi_ref"], x["v_ff"], x["v0"])
    xi_hat = estimated(g, x["xi_pred"], filtered(c.tracks, x["y"], p))
    e = sum_errors(g, x["e"], freeze_moving(g, x["frozen"], dp), x["y"], p)
    known = state_reference(plant)(p, dp)
    return [
        named_function("calibrate", some("raw", "gain", "offset"), {"y": x["gain"] * x["raw"] + x["offset"]}),
        named_function("positions", some("y"), {"q": plant.position_of(x["y"])}),
        named_function("feedforward", reference, {"v_ff": feedforward(t, p, dp, ddp)}),
        named_function("reference_states", {"p": p, "dp": dp}, {"states": known}),
        named_function(
            "filter", {**some("xi_pred", "y"), "p": p, **law_arguments(t, "L")}, {"xi_hat": xi_hat}
        ),
        named_function("sum_errors", {**some("e", "frozen", "y"), "p": p, "dp": dp}, {"e_next": e}),
        named_function(
            "law",
            some("xi_hat", "e", "xi_ref", "v_ff", "v0") | law_arguments(t, "K", "Ki", "force_limit"),
            {"v": v, "saturated": saturated, "xi_pred_next": following},
        ),
    ]


def _current_pieces(t: Target) -> list[ca.Function]:
    """From forces to currents, and from currents to what is commanded."""
    c, plant = t.controller, t.believed
    y, v = ca.SX.sym("y", len(c.measurements)), ca.SX.sym("v", len(c.forces))
    table, current = ca.SX.sym("table", table_size(t)), ca.SX.sym("current", len(plant.actuator.coils))
    read = ({"table": table} if t.look_ups else {}) | law_arguments(t, "current_limit")
    found = [named_function("currents", {"y": y, "v": v, **read}, {"current": currents(t, y, v, table)[1]})]
    if t.look_ups:
        found.append(named_function("places", {"y": y}, {"table_at": places_in_table(t, y)}))
    electronics = electronics_of(plant, t.setup)
    if electronics is not None:
        command = electronics.held(current, y)
        found.append(named_function("set_points", {"current": current, "y": y}, {"command": command}))
    elif t.driven:
        found.append(_current_control(t, current))
    return found


def _current_control(t: Target, current: Any) -> ca.Function:
    """The PI current loops alone; `states` are those of the machine's design model, estimated or of the readings."""
    names = ("u_integral", "u_limited", "i_last", "link_last", "u_rest")
    state = symbols(_chosen(state_fields(t), names))
    read = symbols(_chosen(input_fields(t), ("i", "i_valid", "link")))
    known = ca.SX.sym("states", len(t.controller.A))
    g = numbers(t)
    sums = Sums(t, state)
    command, after = drive_currents(t, g, state, read, current, known, sums)
    after = {f"{name}_next": value for name, value in (after | sums.rests).items()}
    return named_function(
        "current_control",
        {"current": current, "states": known, **state, **read, **law_arguments(t, "Kp", "Ki_current")},
        {"command": command, **after},
    )


def _chosen(fields: Sequence[Field], names: Sequence[str]) -> list[Field]:
    """The fields of these names."""
    return [field for field in fields if field.name in names]


def _transformations(plant: Plant) -> list[ca.Function]:
    """Axes from phases and back, of a machine with windings, and the position of two Hall sensors half a pole apart."""
    if plant.windings is None:
        return []
    drive, x = plant.windings, ca.SX.sym("x", len(plant.states))
    i_phase, u = ca.SX.sym("i_phase", len(drive.phases)), ca.SX.sym("u", len(drive.axes))
    sine, cosine, z, pole = (ca.SX.sym(name) for name in ("sine", "cosine", "z_last", "pole"))
    angle = ca.atan2(sine, cosine)
    turns = (z * math.pi / pole - angle) / (2 * math.pi)
    return [
        named_function("to_axes", {"x": x, "i_phase": i_phase}, {"i": drive.to_axes(x) @ i_phase}),
        named_function("to_phases", {"x": x, "u": u}, {"u_phase": drive.to_phases(x) @ u}),
        named_function("induced_voltage", {"x": x}, {"e": drive.emf(x)}),
        named_function(
            "hall_position",
            {"sine": sine, "cosine": cosine, "z_last": z, "pole": pole},
            {"z": (angle + 2 * math.pi * ca.floor(turns + 0.5)) * pole / math.pi},
        ),
    ]


def strokes() -> list[ca.Function]:
    """Shares of a stroke, with rate and acceleration, from the time since its middle: see simulation/references.py."""
    time, rise = ca.SX.sym("t"), ca.SX.sym("rise")
    arguments = {"t": time, "rise": rise}
    names = ("share", "rate", "acceleration")
    logistic = references.logistic(time, rise, ca.tanh)
    quintic = references.quintic(time, rise, lambda u, low, high: ca.fmin(ca.fmax(u, low), high))
    return [
        named_function("logistic", arguments, dict(zip(names, logistic, strict=True))),
        named_function("quintic", arguments, dict(zip(names, quintic, strict=True))),
    ]
