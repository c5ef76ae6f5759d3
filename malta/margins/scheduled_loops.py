"""The loop of a scheduled law between two of its places, where the reference is one more parameter of the proof.

There the matrices of the law are M_a + s (M_b - M_a), s = (r - a) / (b - a). Proofs take a law of constant matrices, so
each change M_b - M_a that acts on a signal q of the law is led through the machine's side, as one more input and output
of gain s:

    law:  eta = (M_b - M_a) q,   M q = M_a q + tau        machine:  tau = s eta
    or:   eta = q,               M q = M_a q + (M_b - M_a) tau

The machine, too, is at rest where the output is at r: its states count from there, and r is a parameter beside its own.
"""

from __future__ import annotations

import keyword
import math
from collections.abc import Mapping
from dataclasses import fields, make_dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.linear.matrices import system_matrix
from malta.linear.sampling import split_delay
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.parametric_plants import of_plant
from malta.loops.windings import CurrentLoops, chosen_loops
from malta.model.parameters import si, units_of
from malta.model.plant import Plant, total_delay
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller


class ScheduleCell(NamedTuple):
    """The loop between two places: its system and law, and the interval of the output, SI."""

    system: UncertainSystem
    law: Compensator
    interval: tuple[float, float]


@lru_cache(maxsize=8)  # several margins need the same loops; records compare by identity
def loops_between_places(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops
) -> list[ScheduleCell] | str:
    """The loops between the places of a controller's schedule, in parameters by name; or why there are none."""
    schedule = controller.schedule
    assert schedule is not None
    variable = schedule.variable
    if chosen_loops(plant, controller, current_loops) == "pi":
        return "current controllers on windings"
    if not variable.isidentifier() or keyword.iskeyword(variable) or variable in units_of(plant.parameters):
        return f"{variable!r} is no name for one more parameter"
    delay, part = split_delay(total_delay(plant, controller.sample_time))
    if part:
        return f"a delay of {delay + part:g} samples, which are not whole"
    found = []
    for a, b in schedule.cells:
        there, believed = (
            plant_along(one, variable, (a + b) / 2) for one in (plant, plant_of(controller.parameters))
        )
        system = of_plant(there, [*names, variable], believed=believed, late=True)
        law, channels = law_between(controller, schedule.at(a), schedule.at(b), delay)
        found.append(
            ScheduleCell(_with_channels(system, plant.actuator.crossover, (a, b), channels), law, (a, b))
        )
    return found


def plant_along(plant: Plant, variable: str, place: float) -> Plant:
    """The same machine, its states and readings from rest where an output is at a place, a parameter of its name."""
    unit = next(s.unit for s in plant.outputs if s.name == variable)
    own = type(plant.parameters)
    record: Any = make_dataclass(
        own.__name__, [(variable, float, si(unit, default=place))], bases=(own,), frozen=True, eq=True
    )
    values = {f.name: getattr(plant.parameters, f.name) for f in fields(plant.parameters)}
    return _move_plant(plant, variable, record(**values))


def _move_plant(plant: Plant, variable: str, par: Any) -> Plant:
    """The machine of these parameters, moved to the place that one of them says."""
    base = plant.variant(par)
    k, n = [s.name for s in base.outputs].index(variable), len(base.states)
    y = ca.SX.zeros(len(base.outputs))
    y[k] = getattr(par, variable)
    q = ca.vertcat(base.position_of(y))
    rest = ca.SX.zeros(n)
    for i, index in enumerate(base.controlled[: q.numel()]):
        rest[index] = q[i]

    def there(x: Any) -> Any:
        return x + rest

    return replace(
        base,
        parameters=par,
        variant=lambda other: _move_plant(plant, variable, other),
        f=lambda x, u, w: base.f(there(x), u, w),
        h=lambda x, u: base.h(there(x), u) - y,
        load=lambda x: base.load(there(x)),
        preload=lambda x: base.preload(there(x)),
        actuator=replace(
            base.actuator,
            forces=lambda x, i: base.actuator.forces(there(x), i),
            currents=lambda read, v: base.actuator.currents(read + y, v),
        ),
        stroke=replace(base.stroke, name="", thrust=""),
        over={},
    )


def law_between(
    c: Controller, one: Mapping[str, FloatArray], two: Mapping[str, FloatArray], delay: int
) -> tuple[Compensator, int]:
    """The law between two places, u = (v, eta) from (y, tau), its forces delayed; and the number of channels.

    one, two : the matrices at the places
    delay : samples
    """
    n, m, p, T = len(c.states), len(c.forces), len(c.measurements), c.sample_time
    sums = sorted({k for M in (one, two) for k in np.flatnonzero(M["Ki"].any(axis=0)).tolist()})
    states, most = n + len(sums) + m * delay, 2 * n + m + p
    rows = np.eye(states + p + most)  # signals as rows of what multiplies (states, y, tau)
    xi, e, stored, y, tau = np.split(rows, np.cumsum([n, len(sums), m * delay, p]))
    changes: list[FloatArray] = []

    def product(signal: FloatArray, *keys: str) -> FloatArray:
        M, change = (np.hstack([at[key] for key in keys]) for at in (one, two))
        change = change - M
        rows_of, columns_of = (np.flatnonzero(change.any(axis=axis)) for axis in (1, 0))
        # as few channels as the change has rows or columns
        into, out = change[rows_of], np.eye(len(M))[:, rows_of]
        if len(columns_of) < len(rows_of):
            into, out = np.eye(len(signal))[columns_of], change[:, columns_of]
        own = tau[len(changes) : len(changes) + len(into)]
        changes.extend(into @ signal)
        return np.asarray(M @ signal + out @ own)

    total = np.zeros((p, len(rows)))
    total[sums] = e - T * y[sums]
    hat = xi + product(y - product(xi, "Cd"), "L")
    v = product(np.vstack([-hat, total]), "K", "Ki")
    xi_next = product(np.vstack([hat, v]), "Ad", "Bd")
    queue = np.vstack([stored, v])
    after, count = np.vstack([xi_next, total[sums], queue[m:]]), len(changes)
    out = np.vstack([queue[:m], *changes]) if changes else queue[:m]
    read = states + p + count
    return Compensator(
        after[:, :states], after[:, states:read], out[:, :states], out[:, states:read], sample_time=T
    ), count


def _with_channels(
    system: UncertainSystem, crossover: float, cell: tuple[float, float], channels: int
) -> UncertainSystem:
    """The system, its inputs behind a lag where there is one, with channels of gain s; r is its last parameter.

    crossover : of the lag, rad/s; inf: none
    """
    a, b = cell
    p = ca.SX.sym("p", len(system.names))
    A, B, C = (ca.SX(M) for M in system.matrices.call([p]))
    m, outputs = B.shape[1], C.shape[0]
    if math.isfinite(crossover):
        A = system_matrix(A, B, None, -crossover * ca.SX.eye(m))
        B = ca.vertcat(ca.SX(B.shape[0], m), crossover * ca.SX.eye(m))
        C = ca.horzcat(C, ca.SX(outputs, m))
    n, share = A.shape[0], (p[-1] - a) / (b - a)
    matrices = [A, ca.horzcat(B, ca.SX(n, channels)), ca.vertcat(C, ca.SX(channels, n))]
    if channels:
        matrices.append(ca.diagcat(ca.SX(outputs, m), share * ca.SX.eye(channels)))
    nominal = np.array(system.nominal)
    nominal[-1] = (a + b) / 2
    return replace(system, nominal=readonly(nominal), matrices=ca.Function("matrices", [p], matrices))
