"""One step of the exported controller in Python: what the C computes, in the arithmetic of either precision."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.firmware.blocks import Staged, staged_function, staged_program
from malta.firmware.calibration import law_arguments, law_values
from malta.firmware.period_functions import (
    Sums,
    currents,
    decide,
    drive_currents,
    feedforward,
    numbers,
    places_in_table,
    sense,
    set_points,
    state_at,
    symbols,
    table_size,
)
from malta.firmware.program import Program, evaluate, fuse
from malta.firmware.signals import CField, Target
from malta.model.equations import note, recorded_equations
from malta.model.plant import Plant
from malta.model.table_look_ups import interpolate
from malta.simulation import references
from malta.simulation.period import state_reference
from malta.synthesis.law import command_forces, freeze_moving
from malta.synthesis.linear_law import estimate_states, filter_reading, sum_errors

# The pieces of a control period that are usable alone, and all functions of an export together.
#
# calibrate          y = gain raw + offset
# hall_position      z of the sine and the cosine of two Hall sensors half a pole apart
# positions          y -> q
# filter, law        xi_hat from a reading; forces within their limits, and what the filter expects next
# sum_errors         e += Ts (p* - y), where no axis waits
# feedforward        forces of a reference;  reference_states: what the states are on it
# currents           forces -> coil currents where the machine is;  set_points: those of a machine's own electronics
# current_control    PI current loops: currents, readings and link voltage -> voltages of axes or duty cycles
# to_axes, to_phases, induced_voltage    dq transformations and the voltages that motion induces
# logistic, quintic  shares of a stroke with their rates


def parts_of(t: Target) -> dict[str, Staged]:
    """All functions of an export by name: `sense` and `decide`, then the pieces that are usable alone."""
    return {s.plain.name(): s for s in (sense(t), decide(t), state_at(t), *pieces(t))}


def pieces(t: Target) -> list[Staged]:
    """The pieces of a control period that are usable alone."""
    return [*_law_pieces(t), *_current_pieces(t), *strokes(), *_transformations(t.believed)]


def _piece(
    name: str, arguments: dict[str, Any], compute: Callable[..., dict[str, Any]], equation: str = ""
) -> Staged:
    """A piece that computes its results from its arguments; `equation` gives those that no note names."""
    with recorded_equations() as equations:
        results = compute(**arguments)
        note("result", equation, **results)
    return staged_function(name, arguments, results, equations)


def _law_pieces(t: Target) -> list[Staged]:
    """From readings to forces."""
    c, plant, g = t.controller, t.believed, numbers(t)
    n, m, outputs = len(c.states), len(c.forces), len(c.measurements)
    sizes = dict.fromkeys(("raw", "gain", "offset", "y", "e", "frozen"), outputs)
    sizes |= {"xi_pred": n, "xi_hat": n, "xi_ref": n, "v_ff": m, "v0": m}
    reference = symbols(t.reference_fields)

    def some(*names: str) -> dict[str, Any]:
        return {
            name: reference[name] if name in reference else ca.SX.sym(name, sizes[name]) for name in names
        }

    def law(xi_hat: Any, e: Any, xi_ref: Any, v_ff: Any, v0: Any, **_: Any) -> dict[str, Any]:
        following, saturated, v = command_forces(g, xi_hat, e, xi_ref, v_ff, v0)
        return {"v": v, "saturated": saturated, "xi_pred_next": following}

    return [
        _piece("calibrate", some("raw", "gain", "offset"), _calibrate, "y = gain raw + offset"),
        _piece(
            "positions", some("y"), lambda y: {"q": plant.position_of(y)}, "q: the place at which y is read"
        ),
        _piece("feedforward", reference, lambda p, dp, ddp: {"v_ff": feedforward(t, p, dp, ddp)}),
        _piece(
            "reference_states",
            some("p", "dp"),
            lambda p, dp: {"states": state_reference(plant)(p, dp)},
            "states = (q*, dq*), which is at rest at p",
        ),
        _piece(
            "filter",
            some("xi_pred", "y", "p") | law_arguments(t, "L"),
            lambda xi_pred, y, p, **_: {
                "xi_hat": estimate_states(g, xi_pred, filter_reading(c.tracks, y, p))
            },
            f"xi_hat = xi_pred + L ({'y - p' if c.tracks == 'errors' else 'y'} - Cd xi_pred)",
        ),
        _piece(
            "sum_errors",
            some("e", "frozen", "y", "p", "dp"),
            lambda e, frozen, y, p, dp: {"e_next": sum_errors(g, e, freeze_moving(g, frozen, dp), y, p)},
            "e_next = e + Ts (p - y), where no axis waits",
        ),
        _piece(
            "law",
            some("xi_hat", "e", "xi_ref", "v_ff", "v0") | law_arguments(t, "K", "Ki", "force_limit"),
            law,
            "xi_pred_next = Ad xi_hat + Bd (v - v0)",
        ),
    ]


def _calibrate(raw: Any, gain: Any, offset: Any) -> dict[str, Any]:
    return {"y": gain * raw + offset}


def _current_pieces(t: Target) -> list[Staged]:
    """From forces to currents, and from currents to what is commanded."""
    c, plant = t.controller, t.believed
    y, v = ca.SX.sym("y", len(c.measurements)), ca.SX.sym("v", len(c.forces))
    table, current = ca.SX.sym("table", table_size(t)), ca.SX.sym("current", len(plant.actuator.coils))
    given = {"y": y, "v": v, **({"table": table} if t.look_ups else {})} | law_arguments(t, "current_limit")
    found = [
        _piece("currents", given, lambda y, v, table=table, **_: {"current": currents(t, y, v, table)[1]})
    ]
    if t.look_ups:
        meaning = "table_at: where the currents at y read their table"
        found.append(_piece("places", {"y": y}, lambda y: {"table_at": places_in_table(t, y)}, meaning))
    if t.has_set_points:
        given = {"current": current, "y": y}
        found.append(_piece("set_points", given, lambda current, y: {"command": set_points(t, current, y)}))
    elif t.driven:
        found.append(_current_control(t, current))
    return found


def _current_control(t: Target, current: Any) -> Staged:
    """The PI current loops alone; `states` are those of the machine's design model, estimated or of the readings."""
    names = ("u_integral", "u_limited", "i_last", "link_last", "u_rest")
    state = symbols(_choose_fields(t.state_fields, names))
    read = symbols(_choose_fields(t.input_fields, ("i", "i_valid", "link")))
    known = ca.SX.sym("states", len(t.controller.A))

    def control(**_: Any) -> dict[str, Any]:
        sums = Sums(t, state)
        command, after = drive_currents(t, numbers(t), state, read, current, known, sums)
        return {"command": command} | {f"{name}_next": value for name, value in (after | sums.rests).items()}

    own = law_arguments(t, "Kp", "Ki_current")
    return _piece("current_control", {"current": current, "states": known, **state, **read, **own}, control)


def _choose_fields(fields: Sequence[CField], names: Sequence[str]) -> list[CField]:
    """The fields of these names."""
    return [field for field in fields if field.name in names]


def _transformations(plant: Plant) -> list[Staged]:
    """Axes from phases and back, of a machine with windings, and the position of two Hall sensors half a pole apart."""
    if plant.actuator.windings is None:
        return []
    drive, x = plant.actuator.windings, ca.SX.sym("x", len(plant.states))
    i_phase, u = ca.SX.sym("i_phase", len(drive.phases)), ca.SX.sym("u", len(drive.axes))
    hall = {name: ca.SX.sym(name) for name in ("sine", "cosine", "z_last", "pole")}
    return [
        _piece(
            "to_axes",
            {"x": x, "i_phase": i_phase},
            lambda x, i_phase: {"i": drive.to_axes(x) @ i_phase},
            "i = T_axes i_phase",
        ),
        _piece(
            "to_phases",
            {"x": x, "u": u},
            lambda x, u: {"u_phase": drive.to_phases(x) @ u},
            "u_phase = T_phases u",
        ),
        _piece(
            "induced_voltage", {"x": x}, lambda x: {"e": drive.emf(x)}, "e: the voltages that motion induces"
        ),
        _piece("hall_position", hall, _hall_position, "z = pole / pi (angle of (cosine, sine) + 2 pi turns)"),
    ]


def _hall_position(sine: Any, cosine: Any, z_last: Any, pole: Any) -> dict[str, Any]:
    """The position that is nearest to the last one, of two Hall sensors half a pole apart."""
    angle = ca.atan2(sine, cosine)
    turns = (z_last * math.pi / pole - angle) / (2 * math.pi)
    return {"z": (angle + 2 * math.pi * ca.floor(turns + 0.5)) * pole / math.pi}


def strokes() -> list[Staged]:
    """Shares of a stroke, with rate and acceleration, from the time since its middle: see simulation/references.py."""
    arguments = {"t": ca.SX.sym("t"), "rise": ca.SX.sym("rise")}

    def logistic(t: Any, rise: Any) -> dict[str, Any]:
        return dict(zip(_SHARE, references.logistic(t, rise, ca.tanh), strict=True))

    def quintic(t: Any, rise: Any) -> dict[str, Any]:
        found = references.quintic(t, rise, lambda u, low, high: ca.fmin(ca.fmax(u, low), high))
        return dict(zip(_SHARE, found, strict=True))

    return [
        _piece(
            "logistic",
            arguments,
            logistic,
            "share = (1 + tanh(2 ln(3) t / rise)) / 2, with rate and acceleration",
        ),
        _piece("quintic", arguments, quintic, "share = s^3 (10 - 15 s + 6 s^2), with rate and acceleration"),
    ]


_SHARE = ("share", "rate", "acceleration")
Vectors = dict[str, Any]
Step = Callable[[Vectors, Mapping[str, Any], Mapping[str, Any]], tuple[Vectors, Vectors]]


@lru_cache(maxsize=16)
def programs_of(t: Target) -> dict[str, Program]:
    """The programs of all functions of an export, by name."""
    found = {name: staged_program(s, t.precision) for name, s in parts_of(t).items()}
    return {name: fuse(p) for name, p in found.items()} if t.fused else found


def look_up(t: Target, z: Any) -> Any:
    """v0(z), N, linear between the points of the gain file and constant beyond them."""
    real, ff = t.real, t.controller.feedforward
    grid, v0 = ff.z_grid.astype(real), ff.v0.astype(real)
    at = np.clip(real(z), grid[0], grid[-1])
    k = min(int(np.searchsorted(grid, at, side="right")) - 1, len(grid) - 2)
    share = (at - grid[k]) / (grid[k + 1] - grid[k])
    return (real(1) - share) * v0[k] + share * v0[k + 1]


def _v0(t: Target, outputs: Any) -> Any:
    """v0 where the outputs are; that of the first point for a machine without a stroke."""
    grid = t.controller.feedforward.z_grid
    return look_up(t, outputs[t.believed.stroke_output] if t.believed.has_stroke else grid[0])


def read_table(t: Target, places: Any) -> Any:
    """The values of the table at (u, v), (u, v), ..., one reading after the other; none without a table."""
    real = t.real
    if not t.look_ups:
        return np.zeros(0, dtype=real)
    nodes = t.look_ups[0].nodes.astype(real)
    return np.concatenate([interpolate(nodes, u, v) for u, v in np.reshape(places, (-1, 2))])


def first_state(t: Target) -> Vectors:
    """The state that `init` leaves: at rest, knowing nothing."""
    real = t.real
    state = {f.name: np.zeros(f.size, dtype=real) for f in t.state_fields if f.size}
    if t.driven:
        state["link_last"] = np.array([t.believed.drive.link_voltage], dtype=real)
    return state


def started_state(t: Target, reference: Mapping[str, Any]) -> Vectors:
    """The state that `start` leaves: of a machine that follows the reference."""
    found = evaluate(programs_of(t)["state_at"], {**reference, "v0": _v0(t, reference["p"])}, t.precision)
    return {name.removesuffix("_next"): value for name, value in found.items() if value.size}


def step_function(t: Target) -> Step:
    """(state, reference, readings) -> (state, outputs): one step, by the names of signals.py."""
    sense, decide = programs_of(t)["sense"], programs_of(t)["decide"]
    none = {f.name: np.zeros(0) for f in t.state_fields if not f.size}
    law = law_values(t)

    def step(
        state: Vectors, reference: Mapping[str, Any], readings: Mapping[str, Any]
    ) -> tuple[Vectors, Vectors]:
        known = {**none, **state, **reference, **readings, **law}
        sensed = evaluate(sense, known, t.precision)
        table = read_table(t, sensed.pop("table_at", None))
        decided = evaluate(
            decide, {**known, **sensed, "v0": _v0(t, sensed["y_used"]), "table": table}, t.precision
        )
        after = {
            name.removesuffix("_next"): v for name, v in decided.items() if name.endswith("_next") and v.size
        }
        return after, sensed | {name: v for name, v in decided.items() if not name.endswith("_next")}

    return step


def zero_reference(t: Target) -> Vectors:
    """A reference at rest at zero."""
    return {f.name: np.zeros(f.size) for f in t.reference_fields}
