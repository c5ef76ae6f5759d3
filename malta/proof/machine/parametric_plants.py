"""The design model of a plant at a position along its stroke, or along all of it, in parameters by name."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.errors import InputError
from malta.model.equilibrium import commanded
from malta.model.parameters import shape_parameters, twins_of, units_of
from malta.model.plant import Plant, position_in, readonly, symbolic
from malta.model.sensors import LateSensors, with_lags
from malta.proof.arguments import describe
from malta.proof.branches import without_branches
from malta.proof.expressions import NotAnalytic, program
from malta.proof.machine.commands import command_of
from malta.proof.machine.windings import Windings, with_windings
from malta.proof.polynomial import compact
from malta.proof.polynomial.rational import Ratio, TooLarge
from malta.proof.uncertain import (
    UncertainSystem,
    is_commutated,
    lower_limit,
    model_of,
    upper_limit,
)

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

LONGEST = 20_000  # operations up to which a model is expanded


def of_plant(
    plant: Plant,
    names: Sequence[str],
    *,
    at: Mapping[str, float] | None = None,
    states: bool = False,
    believed: Plant | None = None,
    held: FloatArray | None = None,
    late: bool = False,
    windings: Windings | None = None,
) -> UncertainSystem:
    """The design model of a plant at a position, in parameters by name, where its preload acts at every value of them.

    names : parameters; the stroke itself may be one of them, with the position as its nominal value
    at : the states that are not zero, SI
    states : whether y contains the states after the outputs
    believed : the machine with the controller's parameters; None: the plant itself
    held : the gain H of currents that are held between samples (`held_gain`): the inputs are v + H y, and the reading y
        is a further input when the parameters change its gain
    late : whether the outputs are read behind the lags of the plant's sensors, as further states
    windings : these are states, too: inputs are their voltages, and their currents are further outputs (windings.py)

    The inputs are commanded forces: the controller commutates with its own parameters, and the currents produce forces
    with the plant's parameters. The command at which the preload acts is a function of the parameters (commands.py);
    where it is none that a proof could use, the system says so (`approximate`).

    Raises InputError for unknown names and for parameters that set the size of the model.
    """
    par = plant.parameters
    _check_names(plant, names)
    if believed is not None and believed.tabulated:
        found = "a controller that looks up a table"
        raise InputError("uncertain", "believed", found, "one whose currents are a formula")
    x0 = plant.at(**(at or {})).x
    position = position_in(plant, x0)
    own_states = tuple((name, x) for name, x in (at or {}).items() if name != plant.stroke)
    of = model_of(plant, believed or plant, tuple(name for name in names if name != plant.stroke), own_states)
    p = ca.SX.sym("p", len(names))
    own = [k for k, name in enumerate(names) if name != plant.stroke]
    z = p[names.index(plant.stroke)] if plant.stroke in names else position
    nominal = [position if name == plant.stroke else getattr(par, name) for name in names]
    short, positive, why = None, None, ""
    if is_commutated(plant) or not program(of).rational:
        short = _expanded_matrices(of, p, z, np.array(nominal, dtype=float), held)
    if short is not None:
        A, B, C, above = short
        positive = ca.Function("positive", [p], [above]) if above.numel() else None
    else:
        acting = of(p[own], z, ca.DM.zeros(len(plant.inputs)))[-1]
        q = ca.SX.sym("v", len(plant.inputs))
        chain = ca.Function("chain", [p, q], [of(p[own], z, q)[4]])
        wanted = commanded(plant, plant.at(**(at or {})), believed).v
        v, why = command_of(chain, p, acting, np.array(nominal, dtype=float), np.asarray(wanted))
        A, B, C, E = of(p[own], z, v)[:4]
        if held is not None:
            A, left = A - E @ C, E - B @ ca.DM(held)
            B = ca.horzcat(B, left)
    if late:
        A, B, C = with_lags(_sensors_in(plant, p, names), A, B, C)
    if windings is not None:
        point = ca.SX(x0)
        if plant.has_stroke:
            point[plant.stroke_state] = z
        A, B, C = with_windings(_in_symbols(plant, p, names), windings, point, A, B, C)
    if states:
        C = ca.vertcat(C, ca.DM.eye(len(plant.controlled)))
    bounds = {f.name: (lower_limit(f.metadata), upper_limit(f.metadata)) for f in fields(par)}
    limits = tuple(bounds.get(name, (-math.inf, math.inf)) for name in names)
    matrices = ca.Function("matrices", [p], [A, B, C])
    if short is None:
        matrices, positive = without_branches(matrices, nominal)
    return UncertainSystem(
        tuple(names), readonly(nominal), matrices, limits=limits, approximate=why, positive=positive
    )


def _sensors_in(plant: Plant, p: Any, names: Sequence[str]) -> LateSensors | None:
    """The sensors of a plant in symbols p of these parameters.

    Raises InputError for an uncertain lag whose nominal value is none.
    """
    uncertain = [name for name in names if name != plant.stroke]
    if plant.sensors is None and all(getattr(plant.parameters, name) for name in uncertain):
        return None  # no uncertain parameter is a lag of 0 s
    sensors = _in_symbols(plant, p, names).sensors
    nominal = [] if plant.sensors is None else plant.sensors.lagging
    if sensors is not None and sensors.lagging != nominal:
        raise InputError(
            "uncertain", "sensors", "an uncertain lag of 0 s", "one above 0 s, set in the machine"
        )
    return sensors


def _in_symbols(plant: Plant, p: Any, names: Sequence[str]) -> Plant:
    """The plant with symbols p for these parameters; twins share a symbol."""
    symbols = {name: p[k] for k, name in enumerate(names) if name != plant.stroke}
    twins = {name: symbols[twin] for name, twin in twins_of(plant.parameters).items() if twin in symbols}
    machine: Plant = plant.variant(symbolic(plant.parameters, twins | symbols))
    return machine


def _check_names(plant: Plant, names: Any) -> None:
    """Raise InputError unless the names are those of parameters that may be symbols, or of the stroke."""
    known = [*units_of(plant.parameters), *((plant.stroke,) if plant.has_stroke else ())]
    if not isinstance(names, tuple | list):
        raise InputError("uncertain", "names", describe(names), "names of parameters, as a tuple or a list")
    for name in names:
        if name not in known:
            raise InputError("uncertain", f"{name}", "an unknown parameter", "one of " + " ".join(known))
    for name in set(names) & set(shape_parameters(plant.parameters)):
        raise InputError("uncertain", name, "a parameter that shapes the model", "one that enters it")


def _expanded_matrices(
    of: ca.Function, p: Any, z: Any, nominal: FloatArray, held: FloatArray | None
) -> tuple[Any, Any, Any, Any] | None:
    """A, B and C of held currents as short rational functions of p, and what is above zero where these hold.

    None when they are not such functions.
    """
    k, m = p.numel(), of.numel_in(2)
    q = ca.SX.sym("q", k + m)
    fixed = isinstance(z, float)
    place = z if fixed else ca.substitute([z], [p], [q[:k]])[0]
    own = [i for i in range(k) if fixed or not ca.is_equal(p[i], z)]
    outputs = of(q[own], place, q[k:])
    model = ca.Function("model", [q], list(outputs))
    if model.n_instructions() > LONGEST:
        return None
    scales = np.concatenate([nominal, np.array(model(np.r_[nominal, np.zeros(m)])[-1]).ravel()])
    try:
        s, tables, above = compact.expand_matrices(model, scales)
    except (TooLarge, NotAnalytic):
        return None
    A, B, C, E, made, ratio, preload = tables
    zero = Ratio(s.context.constant(0))
    acting = {k + i: preload.get((i, 0), zero) for i in range(m)}
    left = {i: acting[k + i] - compact.substitute(s, made.get((i, 0), zero), acting) for i in range(m)}
    slope = {at: compact.substitute(s, r, acting) for at, r in ratio.items()}
    if not all((slope[at] - r).is_zero() for at, r in ratio.items()):
        return None  # one step finds the command of a chain that is affine in it, and of no other
    ratio = slope
    moved = compact.solution(
        s, ratio, left, m
    )  # what has to be wanted beyond the preload so that the preload acts
    wanted = {k + i: acting[k + i] + moved[i] for i in range(m)}
    A, B, C, E = ({at: compact.substitute(s, r, wanted) for at, r in t.items()} for t in (A, B, C, E))
    n, outputs = of.size1_out(0), of.size1_out(2)
    rest: compact.Table = {}
    if held is not None:
        carried = compact.product(E, C)
        A = compact.drop_rounding(s, compact.difference(A, carried), scales, A, carried)
        gains = {(i, j): s.constant(float(x)) for (i, j), x in np.ndenumerate(held) if x}
        rest = compact.drop_rounding(s, compact.difference(E, compact.product(B, gains)), scales, E)
    held_above = {(i, 0): compact.substitute(s, r, wanted) for i, r in enumerate(above)}
    if not compact.is_free_of_functions(s, (A, B, C, rest, held_above)):
        return None
    b = compact.matrix_of(B, (n, m), p)
    if rest:
        b = ca.horzcat(b, compact.matrix_of(rest, (n, outputs), p))
    a, c = compact.matrix_of(A, (n, n), p), compact.matrix_of(C, (outputs, n), p)
    return a, b, c, ca.vertcat(*(compact.expression(r, p) for r in held_above.values()))
