"""The parts of a control period as CasADi functions of named vectors, from the expressions that simulations run.

    sense       (raw readings, validity) -> y: readings that cannot be true give way to what the filter expects
    decide      (state, reference, y, v0, currents, link) -> (state, forces, currents, duty cycles)

v0(z) is looked up between the two, see controller.c. step.py has each piece alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.firmware.blocks import Staged, staged_function
from malta.firmware.calibration import law_arguments, law_symbols
from malta.firmware.program import as_written
from malta.firmware.signals import CField, Target, reading_ranges
from malta.model.equations import note, recorded_equations
from malta.model.places import place_states
from malta.model.table_look_ups import recorded_look_ups
from malta.simulation.current_control import control_currents
from malta.simulation.layout import LoopPlan, Symbols, electronics_of, numbers_of
from malta.simulation.period import law_reference, limited_currents, state_reference
from malta.synthesis.controller import lag_shares
from malta.synthesis.law import command_forces, freeze_moving, frozen_axes, interpolate, look_ahead
from malta.synthesis.linear_law import estimate_states, filter_reading, sum_errors

ASTRAY_FACTOR = 1e3  # times the reach of a reading: supervisors call a filter astray long before
LINK_RANGE = (0.05, 4.0)  # readings of the link's voltage that are believed, in multiples of the nominal one


def symbols(fields: Sequence[CField]) -> dict[str, Any]:
    """Symbols of fields by name."""
    return {field.name: ca.SX.sym(field.name, field.size) for field in fields}


def named_function(name: str, arguments: dict[str, Any], results: dict[str, Any]) -> ca.Function:
    """A function with named, dense arguments and results."""
    given = {key: ca.densify(value) for key, value in results.items()}
    return ca.Function(name, list(arguments.values()), list(given.values()), list(arguments), list(given))


def numbers(t: Target) -> dict[str, Any]:
    """Every number of the law and of its machine, by name, as expressions take them; symbols of what is tunable."""
    values = {name: ca.SX(value) for name, value in numbers_of(t.believed, t.controller, 1).items()}
    return values | law_symbols(t)


def sense(t: Target) -> Staged:
    """(xi_pred, p, raw y, y_valid) -> (y_used, refused), and where the currents will read a table.

    A reading is refused that its sensor calls invalid, that is no number, or beyond all that the machine can reach; the
    filter then goes on by its model. Comparisons with a NaN are false, so no reading poisons the state. What the filter
    expects is bounded by ASTRAY_FACTOR times that reach: an unstable model alone would leave all numbers behind.
    """
    c = t.controller
    a = symbols(
        [
            *(f for f in t.state_fields if f.name == "xi_pred"),
            *(f for f in t.reference_fields if f.name == "p" or (f.name == "dp" and t.look_ups)),
            *(f for f in t.input_fields if f.name in ("y", "y_valid")),
        ]
    )
    reach = reading_ranges(t.believed)
    most = ca.DM(ASTRAY_FACTOR * reach)
    with recorded_equations() as equations:
        expected = interpolate(numbers(t), c.schedule, a["p"])["Cd"] @ a["xi_pred"]
        if c.tracks == "errors":
            expected = a["p"]
        bounded = ca.fmax(ca.fmin(expected, most), -most)
        used, refused = gate(a["y"], a["y_valid"], reach, bounded)
        instead = "Cd xi_pred" if c.tracks == "states" else "p"
        meaning = (
            f"y_used = y where it may be used, else {instead} within +-{ASTRAY_FACTOR:g} r; refused: not used"
        )
        note("gate", meaning, y_used=used, refused=refused)
        results = {"y_used": used, "refused": refused}
        if t.look_ups:
            _, place = look_ahead(numbers(t), a["xi_pred"], used, a["dp"])
            results["table_at"] = places_in_table(t, place)
            note("places", "table_at: where the currents read their table", table_at=results["table_at"])
    return staged_function("sense", a, results, equations)


def gate(raw: Any, valid: Any, ranges: FloatArray, instead: Any) -> tuple[Any, Any]:
    """Readings, others in place of refused ones; and 1 where one was refused."""
    used, refused = [], []
    for k, most in enumerate(ranges):
        inside = ca.logic_and(raw[k] <= float(most), raw[k] >= -float(most))
        accepted = ca.logic_and(valid[k] > 0.5, inside)  # a NaN is no yes
        used.append(ca.if_else(accepted, raw[k], instead[k]))
        refused.append(ca.logic_not(accepted))
    return ca.vertcat(*used), ca.vertcat(*refused)


def decide(t: Target) -> Staged:
    """(state, reference, y, v0, currents, link) -> (state, outputs): the rest of a control period.

    It consists of the functions of synthesis/controller.py and simulation/current_control.py, as a simulation does.
    """
    state, reference = symbols(t.state_fields), symbols(t.reference_fields)
    read = symbols([f for f in t.input_fields if f.name in ("i", "i_valid", "link", "excitation")])
    y, v0 = ca.SX.sym("y_used", len(t.controller.measurements)), ca.SX.sym("v0", len(t.controller.forces))
    table = ca.SX.sym("table", table_size(t))
    with recorded_equations() as equations:
        sums = Sums(t, state)
        after, out, place = _decided_forces(t, state, reference | read, y, v0, sums)
        wanted, out["current"] = currents(t, place, out["v"], table)
        out["met"] = ca.mmax(ca.fabs(out["current"] - wanted)) > 0
        note("meet", "met: a current is not i_wanted", met=out["met"])
        if t.has_set_points:
            out["command"] = set_points(t, out["current"], place)
        elif t.driven:
            at_rest = state_reference(t.believed)(y, reference["dp"])
            known = out["xi_hat"] if t.controller.tracks == "states" else at_rest
            out["command"], electric = drive_currents(t, numbers(t), state, read, out["current"], known, sums)
            after |= electric
    after |= sums.rests
    results = {f.name: after.get(f.name, state[f.name]) for f in t.state_fields}
    results |= {f.name: out[f.name] for f in t.output_fields if f.name in out}
    arguments = {
        **state,
        **reference,
        "y_used": y,
        "v0": v0,
        **({"table": table} if t.look_ups else {}),
        **read,
        **law_arguments(t),
    }
    results = {(f"{name}_next" if name in state else name): value for name, value in results.items()}
    return staged_function("decide", arguments, results, equations)


def _decided_forces(
    t: Target, state: dict[str, Any], reference: dict[str, Any], y: Any, v0: Any, sums: Sums
) -> tuple[dict[str, Any], dict[str, Any], Any]:
    """The law: the state after the sample, the outputs down to forces, and the place for which currents commutate."""
    c, plant = t.controller, t.believed
    p, dp = reference["p"], reference["dp"]
    g = interpolate(numbers(t), c.schedule, p)
    note("reference_states", "q_ref = (q*, dq*), which is at rest at p", q_ref=state_reference(plant)(p, dp))
    v_ff = feedforward(t, p, dp, reference["ddp"])
    v_past, memory = recall(t, state.get("memory"), v_ff, p, dp)
    xi_ref = law_reference(c, plant, g, {"p_ref": p, "dp_ref": dp, "v_past": v_past})
    note("law_reference", "xi_ref = (q*, dq* + rate dp, memory of forces under way)", xi_ref=xi_ref)
    if t.excited:  # after v_past: the filter knows these forces, the reference does not
        v_ff = _add_excitation(t, v_ff, reference["excitation"])
    xi_hat = estimate_states(g, state["xi_pred"], filter_reading(c.tracks, y, p), None, sums.add_to_states)
    frozen = freeze_moving(g, state["frozen"], dp)
    e = sum_errors(g, state["e"], frozen, y, p, sums.add_to_errors)
    xi_pred, saturated, v = command_forces(g, xi_hat, e, xi_ref, v_ff, v0)
    xi_pred, place = look_ahead(g, sums.predict(xi_pred, xi_hat), y, dp)
    ahead = "" if c.commutation is None else " + Bd lead pull dp"
    note("predict", f"xi_pred = Ad xi_hat + Bd (v - v0){ahead}", xi_pred=xi_pred, **sums.rest("xi_rest"))
    waits, square = frozen_axes(g, saturated), len(c.forces) == len(c.measurements)
    meaning = "frozen = saturated" if square else "frozen: a force of its column of Ki is saturated"
    note("wait", meaning, frozen=waits)
    after = {"xi_pred": xi_pred, "e": e, "frozen": waits}
    if memory is not None:
        note("remember", "memory: forces under way are a sample older", memory=memory)
        after["memory"] = memory
    return after, {"xi_hat": xi_hat, "v": v, "saturated": saturated}, place


def _add_excitation(t: Target, v_ff: Any, excitation: Any) -> Any:
    """The forces that are fed forward with an excitation; what is no number or beyond a limit is none."""
    most = ca.DM(np.array(t.controller.limits.force))
    used = ca.if_else(ca.fabs(excitation) <= most, excitation, 0)
    note("excite", "v_beside = v_ff + excitation, where that is within the limits", v_beside=v_ff + used)
    return v_ff + used


class Sums:
    """How the sums of a sample take what is added: plainly in double precision, compensated (Kahan) in single.

    At e = 1e-4 a float moves in steps of 7e-12; Ts (p* - y) is smaller for errors below 73 nm at 20 kHz, and the sum
    would stand still. What rounding took away is kept beside the sum and added at the next sample.
    """

    def __init__(self, t: Target, state: dict[str, Any]) -> None:
        self.t, self.state = t, state
        self.rests: dict[str, Any] = {}

    def add_to_errors(self, total: Any, more: Any) -> Any:
        e = self._add(total, more, "e_rest", range(total.numel()))
        note("sum_errors", "e = e + Ts (p - y_used), where no axis waits", e=e, **self.rest("e_rest"))
        return e

    def add_to_voltages(self, total: Any, more: Any) -> Any:
        u = self._add(total, more, "u_rest", range(total.numel()))
        meaning = "u_integral = u_integral + Ki Ts epsilon, where the axis does not wait"
        note("integrate_currents", meaning, u_integral=u, **self.rest("u_rest"))
        return u

    def add_to_states(self, total: Any, more: Any) -> Any:
        if self.t.controller.tracks == "errors":  # its states are summed up in `predict`
            xi_hat, reading = total + more, "y_used - p"
        else:
            xi_hat, reading = self._add(total, more, "xi_rest", self.t.summing_states), "y_used"
        meaning = f"xi_hat = xi_pred + L ({reading} - Cd xi_pred)"
        note("estimate", meaning, xi_hat=xi_hat, **self.rest("xi_rest"))
        return xi_hat

    def rest(self, name: str) -> dict[str, Any]:
        """What rounding took, by the name of its field; nothing where sums are plain."""
        return {name: self.rests[name]} if name in self.rests else {}

    def predict(self, xi_pred: Any, xi_hat: Any) -> Any:
        """The states of the next sample: those of a law of errors as sums, xi_hat + (Ad - 1) xi_hat, as 1 - 1e-6 is no
        number of single precision."""
        c = self.t.controller
        if c.tracks != "errors" or not self.t.compensated:
            return xi_pred
        slow = self.t.summing_states
        change = ca.sparsify(ca.DM(c.Ad - np.eye(len(c.Ad)))) @ xi_hat
        sums = self._add(xi_hat, change, "xi_rest", slow)
        return ca.vertcat(*(sums[k] if k in slow else xi_pred[k] for k in range(xi_pred.numel())))

    def _add(self, total: Any, more: Any, rest: str, entries: Sequence[int]) -> Any:
        total, more = ca.densify(ca.SX(total)), ca.densify(ca.SX(more))
        plain = total + more
        if not self.t.compensated or not entries:
            return plain
        kept = ca.SX.zeros(total.numel())
        with as_written():
            for k in entries:
                wanted = more[k] + self.state[rest][k]
                found = total[k] + wanted
                kept[k] = wanted - (found - total[k])
                plain[k] = found
        self.rests[rest] = kept
        return plain


def feedforward(t: Target, p: Any, dp: Any, ddp: Any) -> Any:
    """v_ff = inertia p*'' + speed p*' + position q*, the forces that the reference takes."""
    ff = t.controller.feedforward
    v = ca.sparsify(ca.DM(ff.inertias)) @ ddp + ca.sparsify(ca.DM(ff.speed)) @ dp
    if ff.position.size:
        states = state_reference(t.believed)(p, dp)
        v += ca.sparsify(ca.DM(ff.position)) @ states[: ff.position.shape[1]]
    note("feedforward", "v_ff = inertia ddp + speed dp + position q*", v_ff=v)
    return v


def recall(t: Target, memory: Any, v_ff: Any, p: Any, dp: Any) -> tuple[Any, Any]:
    """References of the forces under way, and the memory of the next sample: see inputs.sample_inputs.

    The memory holds the forces behind the lag, the stored forces, and the feedforward of as many samples.
    """
    c, m = t.controller, len(t.controller.forces)
    if c.tracks == "errors":
        return ca.SX(0, 1), memory
    zeros = ca.SX.zeros(m * c.observed)
    if memory is None:
        return zeros, None
    lagging, d = c.lagging, c.stored
    edges = (0, m * lagging, m * (lagging + d), memory.numel())
    lag, stored, forward = (memory[a:b, 0] for a, b in pairwise(edges))  # columns, where they are empty too
    after: list[Any] = []
    if lagging:
        decay, queue = float(c.Ad[len(c.A), len(c.A)]), ca.vertcat(forward, v_ff)
        taken = [share * queue[m * (d - age) : m * (d - age + 1), 0] for age, share in lag_shares(c)]
        after.append(sum(taken[1:], taken[0]) + decay * lag)
    if d:
        n = len(c.A)
        newest = n + m * (lagging + d - 1)
        pull = ca.sparsify(ca.DM(c.Ad[newest : newest + m, :n]))
        now = v_ff + pull @ state_reference(t.believed)(p, dp)
        if c.commutation is not None:
            now += ca.sparsify(ca.DM(c.commutation.lead * c.commutation.pull)) @ dp
        after += [stored[m:, 0], now]
        if lagging:
            after += [forward[m:, 0], v_ff]
    return ca.vertcat(lag, stored, zeros), ca.vertcat(*after)


def table_size(t: Target) -> int:
    """How many values of a table the currents of a sample take."""
    return sum(one.values.numel() for one in t.look_ups)


def places_in_table(t: Target, place: Any) -> Any:
    """(u, v) of each reading of the table, where the currents are commutated for `place`."""
    with recorded_look_ups() as found, recorded_equations():  # whose notes are of the symbols of this call
        t.believed.actuator.currents(place, ca.SX.sym("v", len(t.controller.forces)))
    return ca.vertcat(*(x for one in found for x in (one.u, one.v)))


def currents(t: Target, place: Any, v: Any, table: Any) -> tuple[Any, Any]:
    """Coil currents that make the forces v where the machine is, as wanted and within their limits.

    table : the values that are read at `places_in_table`; none for most machines
    """
    unread = recorded_equations() if t.look_ups else nullcontext()  # values before they are looked up
    with recorded_look_ups() as found, unread:
        wanted = ca.SX(t.believed.actuator.currents(place, v))
    if found:
        wanted = ca.substitute(wanted, ca.vertcat(*(one.values for one in found)), table)
    meaning = "i_wanted: currents that make v where y_used says that the machine is"
    note("currents", meaning, wanted.numel(), i_wanted=wanted)
    limit = law_symbols(t).get("current_limit", ca.SX(ca.DM(t.controller.limits.current)))
    current = limited_currents(t.believed, wanted, limit)
    note(
        "limit_currents",
        "current = i_wanted within limits.current and the machine's own limit",
        current=current,
    )
    return wanted, current


def set_points(t: Target, current: Any, place: Any) -> Any:
    """Set points of the machine's own electronics for coil currents, commutated for `place`."""
    electronics = electronics_of(t.believed, t.setup)
    assert electronics is not None
    command = electronics.held(current, place)
    note("set_points", "command: what the electronics hold until the next sample", command=command)
    return command


def drive_currents(
    t: Target,
    g: dict[str, Any],
    state: dict[str, Any],
    read: dict[str, Any],
    current: Any,
    known: Any,
    sums: Sums,
) -> tuple[Any, dict[str, Any]]:
    """Duty cycles (or voltages of axes) for these currents, and the state of the current loops after the sample."""
    c, plant, drive = t.controller, t.believed, t.believed.drive
    most = 4 * max(plant.actuator.current_limit, float(np.max(c.limits.current)))
    i, _ = gate(read["i"], read["i_valid"], np.full(read["i"].numel(), most), state["i_last"])
    low, high = (share * drive.link_voltage for share in LINK_RANGE)
    usable = ca.logic_and(read["link"] >= low, read["link"] <= high)
    V = ca.if_else(usable, read["link"], state["link_last"])
    note("read_currents", "i_last = i, link_last = link, each where it may be used", i_last=i, link_last=V)
    machine = {"i_phase": i, "i": i, "link": V, "x": ca.SX.zeros(len(plant.states))}
    loops = {name: state[name] for name in ("u_integral", "u_limited")}
    # A tunable record has the product of gain and sample time: rounded once, as where it is a constant.
    if t.tunable:
        g = g | {"control_time": ca.SX(1)}
    command, after, _ = control_currents(
        LoopPlan(plant, c, t.setup, g),
        Symbols(machine, loops, {}),
        current,
        known,
        None,
        sums.add_to_voltages,
    )
    return command, after | {"i_last": i, "link_last": V}


def state_at(t: Target) -> Staged:
    """(p, dp, ddp, v0) -> state: the filter knows the machine to follow the reference, which has been so before."""
    reference = symbols(t.reference_fields)
    v0 = ca.SX.sym("v0", len(t.controller.forces))
    with recorded_equations() as equations:
        state = _state_on_reference(t, reference, v0)
        note("rest", "all others are zero", **state)
    return staged_function(
        "state_at", {**reference, "v0": v0}, {f"{k}_next": v for k, v in state.items()}, equations
    )


def _state_on_reference(t: Target, reference: dict[str, Any], v0: Any) -> dict[str, Any]:
    """The state by name, on a reference that has been so before."""
    c, plant = t.controller, t.believed
    state: dict[str, Any] = {f.name: ca.SX.zeros(f.size) for f in t.state_fields}
    p, dp = reference["p"], reference["dp"]
    if c.tracks == "states":
        v_ff = feedforward(t, p, dp, reference["ddp"])
        if "memory" in state:
            m, ahead = len(c.forces), c.lagging + c.stored
            trial = ca.SX.zeros(state["memory"].numel())
            _, after = recall(t, trial, v_ff, p, dp)
            newest = after[m * (ahead - 1) : m * ahead, 0] if c.stored else v_ff
            state["memory"] = ca.vertcat(
                *([v_ff] if c.lagging else []),
                *[newest] * c.stored,
                *([v_ff] * c.stored if c.lagging else []),
            )
        v_past, _ = recall(t, state.get("memory"), v_ff, p, dp)
        if "memory" in state:
            note("remember", "memory: this reference has been so before", memory=state["memory"])
        state["xi_pred"] = ca.vertcat(state_reference(plant)(p, dp), v_past)
        note("expect", "xi_pred = (q*, dq*, memory of forces under way)", xi_pred=state["xi_pred"])
    if t.driven:
        drive, x = plant.drive, place_states(plant, state_reference(plant)(p, dp))
        i = drive.command(plant.actuator.currents(p, v0))
        state["u_integral"] = plant.actuator.R * i
        note("hold_currents", "u_integral = R i_axes of the currents for v0", u_integral=state["u_integral"])
        state["i_last"] = drive.to_phases(x) @ i if t.fidelity == "phase" else i
        note("flow", "i_last = T_phases i_axes", i_last=state["i_last"])
        state["link_last"] = ca.SX(drive.link_voltage)
    return state
