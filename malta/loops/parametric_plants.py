"""The design model of a plant at a position along its stroke, or along all of it, in parameters by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arguments import describe
from malta.arrays import FloatArray, readonly
from malta.errors import InputError, require_known
from malta.linear import rational_tables
from malta.linear.branches import without_branches
from malta.linear.expressions import NotAnalytic, program
from malta.linear.rational import Ratio, Table, TooLarge, product, symbolic as rational_functions
from malta.linear.uncertain import DOMAIN_END_TEXT, UncertainSystem
from malta.loops.rest import Condition, Formula, command_of, limits_at_rest, rest_of
from malta.loops.windings import WindingModel, with_windings
from malta.model.currents import is_commutated
from malta.model.equilibrium import balance, with_command
from malta.model.linearize import jacobians, linearize
from malta.model.parameters import shape_parameters, twins_of, units_of
from malta.model.places import position_at, position_in
from malta.model.plant import Plant, symbolic
from malta.model.sensors import Sensors, with_lags
from malta.model.soundness import unproven
from malta.work import check_clock

MAX_MODEL_OPERATIONS = 20_000  # operations up to which a model is expanded


def of_plant(
    plant: Plant,
    names: Sequence[str],
    *,
    at: Mapping[str, float] | None = None,
    states: bool = False,
    believed: Plant | None = None,
    held: FloatArray | None = None,
    late: bool = False,
    windings: WindingModel | None = None,
    loaded: bool = True,
) -> UncertainSystem:
    """The linear model of a plant at rest at a position under its loads, in parameters by name.

    At every value of them states, inputs and commands are those that hold the machine there (see rest.py): what the
    position leaves open is solved for. The system ends where a current, a force or the balance itself comes to its end.

    names : parameters; the stroke itself may be one of them, with the position as its nominal value
    at : the states that are not zero, SI
    states : whether y contains the states after the outputs
    believed : the machine with the controller's parameters; None: the plant itself
    held : the gain H of currents that are held between samples (`held_gain`): the inputs are v + H y, and the reading y
        is a further input when the parameters change its gain
    late : whether the outputs are read behind the lags of the plant's sensors, as further states
    windings : these are states, too: inputs are their voltages, and their currents are further outputs (windings.py)
    loaded : False: the design model, in which the preload acts in place of the loads

    The inputs are commanded forces: the controller commutates with its own parameters, and the currents produce forces
    with the plant's parameters. What holds the machine is a function of the parameters;
    where it is none that a proof could use, the system says so (`approximate`).

    Raises InputError for unknown names and for parameters that set the size of the model.
    """
    par = plant.parameters
    check_names(plant, names)
    if believed is not None and believed.actuator.tabulated:
        found = "a controller that looks up a table"
        raise InputError("uncertain", "believed", found, "one whose currents are a formula")
    x0 = plant.at(**(at or {})).x
    position = position_in(plant, x0)
    own_states = tuple((name, x) for name, x in (at or {}).items() if name != plant.stroke.name)
    along = tuple(name for name in names if name != plant.stroke.name)
    of = model_of(plant, believed or plant, along, own_states, loaded)
    rest = rest_model(plant, along, own_states, loaded)
    check_clock()
    p = ca.SX.sym("p", len(names))
    own = [k for k, name in enumerate(names) if name != plant.stroke.name]
    symbols = {names[k]: p[k] for k in own}
    z = p[names.index(plant.stroke.name)] if plant.stroke.name in names else position
    nominal = [position if name == plant.stroke.name else getattr(par, name) for name in names]
    short, why, conditions = None, rest.why, _conditions_of(rest, p[own], z)
    if is_commutated(plant) or not program(of).rational:
        short = _expanded_matrices(of, p, z, np.array(nominal, dtype=float), held)
    check_clock()
    if short is not None:
        A, B, C, above, v = short
        conditions += [Condition(one, DOMAIN_END_TEXT) for one in ca.vertsplit(above)]
    else:
        acting = of(p[own], z, ca.DM.zeros(len(plant.inputs)))[-1]
        q = ca.SX.sym("v", len(plant.inputs))
        chain = ca.Function("chain", [p, q], [of(p[own], z, q)[4]])
        wanted = _command_at(plant, x0, believed, loaded)
        command = command_of(chain, p, acting, np.array(nominal, dtype=float), wanted)
        v, why = command.values, why or command.why
        conditions += command.conditions
        A, B, C, E = of(p[own], z, v)[:4]
        if held is not None:
            A, left = A - E @ C, E - B @ ca.DM(held)
            B = ca.horzcat(B, left)
    if loaded and not why and v is not None:
        machine = in_symbols(plant, symbols)
        conditions += limits_at_rest(machine, believed or plant, rest.function(p[own], z)[0], v)
    if late:
        A, B, C = with_lags(_sensors_in(plant, symbols), A, B, C)
    if windings is not None:
        x = rest.function(p[own], z)[0]
        A, B, C = with_windings(in_symbols(plant, symbols), windings, x, A, B, C)
    if states:
        C = ca.vertcat(C, ca.DM.eye(len(plant.controlled)))
    matrices = ca.Function("matrices", [p], [A, B, C])
    if short is None:
        matrices, above = without_branches(matrices, nominal)
        branches = [] if above is None else ca.vertsplit(above(p))
        conditions += [Condition(one, DOMAIN_END_TEXT) for one in branches]
    positive = (
        ca.Function("positive", [p], [ca.vertcat(*(c.above for c in conditions))]) if conditions else None
    )
    why = unproven(plant, tuple(x0.tolist())) or why
    return UncertainSystem(
        tuple(names), readonly(nominal), matrices,
        limits=declared_limits(par, names), approximate=why, positive=positive, ends=tuple(c.ends for c in conditions),
    )  # fmt: skip


MIN_DEAR_STATES = 6  # of a machine, from which on a parameter and its inverse in one entry are dear
MAX_DEAR_PARAMETERS = (
    2  # of such a machine, which take a minute or two; three take more places than there is work for
)


def is_dear(system: UncertainSystem) -> bool:
    """Whether an entry of A has a parameter and its inverse, as a stiffness that the weight changes: c k / m + d m / k.

    Neither p nor 1 / p makes polynomials of such matrices, and each parameter takes some ten places.
    """
    if len(system.names) <= MAX_DEAR_PARAMETERS:
        return False
    if system.matrices.size1_out(0) < MIN_DEAR_STATES or not program(system.matrices).rational:
        return False
    try:
        A = rational_functions(program(system.matrices)).entries[0]
    except (TooLarge, NotAnalytic):
        return False
    for r in A.values():
        if r.den is None:
            continue
        powers, below = zip(*r.num.monoms(), strict=True), zip(*r.den.monoms(), strict=True)
        for own, under in zip(powers, below, strict=True):
            if min(own) < min(under) and max(own) > max(under):
                return True
    return False


def _command_at(plant: Plant, x: FloatArray, believed: Plant | None, loaded: bool) -> FloatArray:
    """The command at rest at nominal parameters. Raises CheckError where none holds the machine."""
    point = balance(plant, x) if loaded else plant.at(**position_at(plant, x))
    return np.asarray(with_command(plant, point, believed).v)


def _conditions_of(rest: RestModel, p: Any, z: Any) -> list[Condition]:
    """What is above zero where the machine has its rest."""
    above = rest.function(p, z)[2]
    return [Condition(one, ends) for one, ends in zip(ca.vertsplit(above), rest.ends, strict=True)]


def _sensors_in(plant: Plant, symbols: Mapping[str, Any]) -> Sensors:
    """The sensors of a plant in symbols of some parameters.

    Raises InputError for an uncertain lag whose nominal value is none.
    """
    if not plant.sensors.late and all(getattr(plant.parameters, name) for name in symbols):
        return plant.sensors  # no uncertain parameter is a lag of 0 s
    sensors = in_symbols(plant, symbols).sensors
    if isinstance(sensors.dead_time, ca.SX):
        raise InputError("uncertain", "sensors.dead_time", "an uncertain time", "a number; lags may vary")
    if sensors.lagging != plant.sensors.lagging:
        raise InputError(
            "uncertain", "sensors", "an uncertain lag of 0 s", "one above 0 s, set in the machine"
        )
    return sensors


def check_names(plant: Plant, names: Any) -> None:
    """Raise InputError unless the names are those of parameters that may be symbols, or of the stroke."""
    known = [*units_of(plant.parameters), *((plant.stroke.name,) if plant.has_stroke else ())]
    if not isinstance(names, tuple | list):
        raise InputError("uncertain", "names", describe(names), "names of parameters, as a tuple or a list")
    require_known(names, known, "uncertain", found="an unknown parameter")
    for name in set(names) & set(shape_parameters(plant.parameters)):
        raise InputError("uncertain", name, "a parameter that shapes the model", "one that enters it")


def _expanded_matrices(
    of: ca.Function, p: Any, z: Any, nominal: FloatArray, held: FloatArray | None
) -> tuple[Any, Any, Any, Any, Any] | None:
    """A, B and C of held currents as short rational functions of p, what is above zero where these hold, and v at rest.

    None when they are not such functions; v alone: when it is none.
    """
    k, m = p.numel(), of.numel_in(2)
    q = ca.SX.sym("q", k + m)
    fixed = isinstance(z, float)
    place = z if fixed else ca.substitute([z], [p], [q[:k]])[0]
    own = [i for i in range(k) if fixed or not ca.is_equal(p[i], z)]
    outputs = of(q[own], place, q[k:])
    model = ca.Function("model", [q], list(outputs))
    if model.n_instructions() > MAX_MODEL_OPERATIONS:
        return None
    scales = np.concatenate([nominal, np.array(model(np.r_[nominal, np.zeros(m)])[-1]).ravel()])
    try:
        s, tables, above = rational_tables.expand_matrices(model, scales)
    except (TooLarge, NotAnalytic):
        return None
    A, B, C, E, made, ratio, preload = tables
    zero = Ratio(s.context.constant(0))
    acting = {k + i: preload.get((i, 0), zero) for i in range(m)}
    left = {
        i: acting[k + i] - rational_tables.substitute(s, made.get((i, 0), zero), acting) for i in range(m)
    }
    slope = {at: rational_tables.substitute(s, r, acting) for at, r in ratio.items()}
    if not all((slope[at] - r).is_zero() for at, r in ratio.items()):
        return None  # one step finds the command of a chain that is affine in it, and of no other
    ratio = slope
    moved = rational_tables.solution(s, ratio, left, m)  # what is wanted beyond the preload for it to act
    wanted = {k + i: acting[k + i] + moved[i] for i in range(m)}
    A, B, C, E = ({at: rational_tables.substitute(s, r, wanted) for at, r in t.items()} for t in (A, B, C, E))
    n, outputs = of.size1_out(0), of.size1_out(2)
    rest: Table = {}
    if held is not None:
        carried = product(E, C)
        A = rational_tables.drop_rounding(s, rational_tables.difference(A, carried), scales, A, carried)
        gains = {(i, j): s.constant(float(x)) for (i, j), x in np.ndenumerate(held) if x}
        rest = rational_tables.drop_rounding(s, rational_tables.difference(E, product(B, gains)), scales, E)
    held_above = {(i, 0): rational_tables.substitute(s, r, wanted) for i, r in enumerate(above)}
    if not rational_tables.is_free_of_functions(s, (A, B, C, rest, held_above)):
        return None
    b = rational_tables.matrix_of(B, (n, m), p)
    if rest:
        b = ca.horzcat(b, rational_tables.matrix_of(rest, (n, outputs), p))
    a, c = rational_tables.matrix_of(A, (n, n), p), rational_tables.matrix_of(C, (outputs, n), p)
    above_zero = ca.vertcat(*(rational_tables.expression(r, p) for r in held_above.values()))
    command = {(i, 0): wanted[k + i] for i in range(m)}
    v = (
        rational_tables.matrix_of(command, (m, 1), p)
        if rational_tables.is_free_of_functions(s, (command,))
        else None
    )
    return a, b, c, above_zero, v


def held_gain(plant: Plant, states: Mapping[str, float]) -> FloatArray:
    """The gain H of held currents at these states, from E = B H: v + H y acts (forces x sensors)."""
    check_clock()
    model = linearize(plant, plant.at(**states))
    return np.asarray(np.linalg.lstsq(model.B, model.E, rcond=None)[0])


def in_symbols(plant: Plant, symbols: Mapping[str, Any]) -> Plant:
    """The plant with symbols for some parameters; twins share a symbol."""
    twins = {name: symbols[twin] for name, twin in twins_of(plant.parameters).items() if twin in symbols}
    machine: Plant = plant.variant(symbolic(plant.parameters, {**twins, **symbols}))
    return machine


class RestModel(NamedTuple):
    """Rest as a function of parameters and of the position along the stroke."""

    function: ca.Function  # (p, z) -> states, inputs that act, and what is above zero where there is a rest
    ends: tuple[str, ...]  # what happens where it is not
    why: str  # why it is not exact; "": it is


@lru_cache(maxsize=16)  # plants compare by identity, and are built once for their parameters
def rest_model(
    plant: Plant, names: tuple[str, ...], at: tuple[tuple[str, float], ...] = (), loaded: bool = True
) -> RestModel:
    """Where the machine rests under its loads; of the design model, at the states `at` with its preload."""
    p, z = ca.SX.sym("p", len(names)), ca.SX.sym("z")
    machine = in_symbols(plant, dict(zip(names, ca.vertsplit(p), strict=True)) if names else {})
    x = ca.SX(plant.state(dict(at)))
    if plant.has_stroke:
        x[plant.stroke_state] = z
    if loaded:
        nominal = np.array([*(getattr(plant.parameters, name) for name in names), 0.0])
        rest = balance(plant, plant.state(dict(at)))
        x, found = rest_of(plant, machine, x, ca.vertcat(p, z), nominal, rest)
    else:
        found = Formula(ca.SX(machine.preload(x)))
    above = ca.vertcat(*(c.above for c in found.conditions))
    parts = [x, found.values, above]
    function = ca.Function("rest", [p, z], ca.cse([ca.densify(ca.SX(part)) for part in parts]))
    return RestModel(function, tuple(c.ends for c in found.conditions), found.why)


@lru_cache(maxsize=16)  # plants compare by identity, and are built once for their parameters
def model_of(
    plant: Plant,
    believed: Plant,
    names: tuple[str, ...],
    at: tuple[tuple[str, float], ...] = (),
    loaded: bool = True,
) -> ca.Function:
    """The linear model as a CasADi function of parameters, position along the stroke and commands v.

    at : the other states that are not zero
    loaded : whether the loads act; without them it is the design model, which has the preload in their place

    Its outputs are those of `jacobians` on the controlled states (A, B, C, E, forces, their ratio), at rest, and the
    inputs that act there.
    """
    p, z, v = ca.SX.sym("p", len(names)), ca.SX.sym("z"), ca.SX.sym("v", len(plant.inputs))
    own = dict(zip(names, ca.vertsplit(p), strict=True)) if names else {}
    machine = in_symbols(plant, own)
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    point, acting, _ = rest_model(plant, names, at, loaded).function(p, z)
    check_clock()
    w = machine.load(x) if loaded else ca.SX.zeros(len(plant.disturbances))
    found = jacobians(machine, believed, x, u, v, w)
    check_clock()
    A, B, C, E, made, ratio = ca.substitute(list(found), [x, u], [point, acting])
    keep = list(plant.controlled)
    parts = [A[keep, keep], B[keep, :], C[:, keep], E[keep, :], made, ratio, acting]
    return ca.Function("model", [p, z, v], ca.cse([ca.densify(part) for part in parts]))


def declared_limits(par: Any, names: Sequence[str]) -> tuple[tuple[float, float], ...]:
    """The exclusive limits of parameters by name; infinite ones of the stroke."""
    bounds = {f.name: limits_of(f.metadata) for f in fields(par)}
    return tuple(bounds.get(name, (-math.inf, math.inf)) for name in names)


def limits_of(declared: Mapping[str, Any]) -> tuple[float, float]:
    """The exclusive limits of a declared parameter; for `at_least` the float just below."""
    above, least, below = (declared.get(key) for key in ("above", "at_least", "below"))
    found = [] if above is None else [float(above)]
    found += [] if least is None else [math.nextafter(float(least), -math.inf)]
    return max(found, default=-math.inf), math.inf if below is None else float(below)
