"""The commands that hold a machine at rest: against its loads, and against what its magnets pull with.

A controller commands v, its coils carry currents(h(x), v), and these make the inputs u = forces(x, i) of the machine:

    v -> i = currents(h(x), v) -> u = forces(x, i) -> x' = f(x, u, w + load(x))

`currents` need not be the inverse of `forces`, and the controller may have it from other parameters than the machine's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.model.currents import command_symbols, currents_at, currents_of
from malta.model.plant import OperatingPoint, Plant, given_plant
from malta.model.traced import Traced, trace

Equations = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
STEPS = 60
HALVINGS = 30
MIN_DECREASE = 1e-4  # of what a step of its length promises
ROUNDING = 1e-14  # of the terms of a residual


class EquilibriumRows(NamedTuple):
    """Rows of unknowns, and what is left of each row's equations where these are not solved; else zeros."""

    values: FloatArray
    left: FloatArray


def solve(
    equations: Equations, starts: Sequence[FloatArray], scales: FloatArray, still: float, share: float
) -> EquilibriumRows:
    """Solve r(v) = 0 in each row, from the first of several starts that leads to a solution.

    Each step solves the linearized equations in the least-squares sense, with the smallest change of v / scales, and
    is halved until the residual falls. Where nothing is solved, the values are those of the smallest residual.

    still : a residual that is zero, unless the scales of v make all of it small
    share : the same, of the sum of |dr/dv| |v|
    """
    values, residual = np.array(starts[0]), np.zeros(0)
    open_rows = np.ones(len(values), dtype=bool)
    smallest = np.full(len(values), np.inf)
    for start in starts:
        found, r, J = _descend(equations, start, scales, open_rows)
        residual = residual if residual.size else np.full(r.shape, np.nan)
        sizes = _sizes(J, scales)
        with np.errstate(invalid="ignore"):
            room = np.maximum(
                share * (np.abs(J) @ np.abs(found)[..., None])[..., 0], np.minimum(still, 1e-6 * sizes)
            )
            room = np.where(sizes > 0, room, still)
            solved = (np.abs(r) <= room).all(axis=1) | (r == 0).all(axis=1)
        merit = np.where(np.isfinite(r).all(axis=1), np.abs(r).max(axis=1, initial=0.0), np.inf)
        better = open_rows & (solved | (merit < smallest) | np.isnan(residual).all(axis=1))
        values[better], residual[better], smallest[better] = found[better], r[better], merit[better]
        residual[open_rows & solved] = 0.0
        open_rows &= ~solved
        if not open_rows.any():
            break
    return EquilibriumRows(values, residual)


def _sizes(J: FloatArray, scales: FloatArray) -> FloatArray:
    """How much each residual changes where each unknown changes by its scale; k x rows."""
    return np.asarray(np.abs(J) @ scales)


def _descend(
    equations: Equations, start: FloatArray, scales: FloatArray, rows: np.typing.NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Newton's method for some rows from one start, until no step makes the residual smaller."""
    v = np.array(start)
    r, J = equations(v)
    active = rows & np.isfinite(r).all(axis=1) & r.any(axis=1)
    for _ in range(STEPS):
        sizes = _sizes(J, scales)
        active &= np.isfinite(sizes).all(axis=1)
        terms = (np.abs(J) @ np.maximum(np.abs(v), scales)[..., None])[..., 0]
        active &= (np.abs(r) > ROUNDING * np.where(np.isfinite(terms), terms, 0.0)).any(axis=1)
        if not active.any():
            break
        weights = _weights(sizes)
        steps = np.zeros_like(v)
        steps[active] = scales * _least_squares(
            weights[active, :, None] * J[active] * scales, weights[active] * r[active]
        )
        v, r, J, moved = _search(equations, (v, r, J), steps, weights, active)
        active &= moved & r.any(axis=1)
    return v, r, J


def _weights(sizes: FloatArray) -> FloatArray:
    """What makes the residuals of each row alike; zero for those that no unknown changes."""
    floor = np.maximum(sizes, 1e-13 * sizes.max(axis=1, keepdims=True, initial=0.0))
    weights = np.divide(1.0, floor, out=np.zeros_like(floor), where=floor > 0)
    return np.where(sizes == 0, 0.0, weights)


def _least_squares(A: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest x of k equations A x = b, in the least-squares sense, as `numpy.linalg.lstsq` finds each.

    A : k x r x n, b : k x r
    """
    U, size, Vt = np.linalg.svd(A, full_matrices=False)
    kept = size > np.finfo(float).eps * max(A.shape[1:]) * size.max(axis=1, keepdims=True, initial=0.0)
    along = np.divide((b[:, None] @ U)[:, 0], size, out=np.zeros_like(size), where=kept)
    return np.asarray((along[:, None] @ Vt)[:, 0])


def _search(
    equations: Equations,
    at: tuple[FloatArray, FloatArray, FloatArray],
    steps: FloatArray,
    weights: FloatArray,
    active: np.typing.NDArray[np.bool_],
) -> tuple[FloatArray, FloatArray, FloatArray, np.typing.NDArray[np.bool_]]:
    """Halve the step of each active row until its weighted residual falls; rows that cannot improve stay."""
    v, r, J = (np.array(part) for part in at)
    moved, before = np.zeros_like(active), np.linalg.norm(weights * r, axis=1)
    length = 1.0
    for _ in range(HALVINGS):
        trying = active & ~moved
        if not trying.any():
            break
        tried = np.where(trying[:, None], v - length * steps, v)
        r_new, J_new = equations(tried)
        with np.errstate(invalid="ignore"):
            after = np.linalg.norm(weights * np.where(np.isfinite(r_new), r_new, np.inf), axis=1)
            falls = trying & (after < (1 - MIN_DECREASE * length) * before)
        v[falls], r[falls], J[falls] = tried[falls], r_new[falls], J_new[falls]
        moved |= falls
        length /= 2
    return v, r, J, moved


MAX_REST_RATE = 1e-9  # m/s, rad/s, m/s2 or rad/s2: a machine that changes by less is at rest
SHARE = 1e-10  # of the rates that the inputs make: rounding
LIMIT_ROUNDING = 1e-9  # of a limit
MIN_STATES = 32  # at rest, from which on a function of the entries that are not zero is worth its trace
STARTS = (1.0, 0.3, 0.1, 0.01)  # of the limits of the commands, from where a balance is searched at last


def trim(plant: Plant, /, **positions: float) -> OperatingPoint:
    """Find the command that holds the machine at rest at these states against its loads.

    Solves 0 = f(x, u, load(x)), u = forces(x, currents(h(x), v)), for v by a damped Newton method. Where several
    commands hold the machine, this is the one nearest to the inputs. Accelerations of uncontrolled states are left: a
    mover whose centre of gravity is off its axis rolls.

    plant : the machine
    positions : states by name, SI; the others are zero

    Returns an OperatingPoint with the inputs u that act and the command v that makes them.

    Raises InputError for unknown states, CheckError when no input or no command holds the machine there, or none
    within its limits of forces and currents.

    >>> import malta
    >>> ball = malta.read_design("examples/ball/design/ball.toml").plant
    >>> held = malta.trim(ball, q=1e-3)
    >>> held.u.round(3).tolist(), held.v.round(3).tolist()  # N: acting, commanded
    ([0.981], [-0.523])
    """
    plant = given_plant("trim", plant)
    point = balance(plant, plant.state(positions))
    excess = exceeded_limit(plant, point)
    if excess:
        raise CheckError(
            f"{plant.name}: nothing holds {_name_state(plant, point.x)} within its limits: {excess}"
        )
    return point


def balance(plant: Plant, x: FloatArray) -> OperatingPoint:
    """The operating point at rest under the loads, within the limits or beyond them: see `trim`."""
    u = _hold(plant, x[None, :])[0]
    return with_command(plant, OperatingPoint(x, u, loaded=True))


def with_command(plant: Plant, point: OperatingPoint, believed: Plant | None = None) -> OperatingPoint:
    """The operating point with the command v at which its inputs act, and the inputs that v makes.

    Solves f(x, forces(x, currents(h(x), v)), w) = f(x, u, w) for v, with the currents of `believed`, but for the
    accelerations of uncontrolled states.

    plant : the machine
    believed : the machine with the controller's parameters; None: the plant itself

    Raises CheckError when no command has the effect of the inputs.
    """
    before = [] if point.v is None else [point.v[None, :]]
    (v,), (u,) = _commands(plant, believed, point.x[None, :], point.u[None, :], before, loaded=point.loaded)
    return OperatingPoint(point.x, u, point.loaded, v)


def exceeded_limit(plant: Plant, point: OperatingPoint) -> str:
    """The limit of forces or currents that a point with a command exceeds, in words; "": none."""
    assert point.v is not None
    for s, v, most in zip(plant.inputs, point.v.tolist(), plant.actuator.force_limit, strict=False):
        if abs(v) > most * (1 + LIMIT_ROUNDING):
            return f"the command {s.name} = {v:.4g} {s.unit} is beyond its limit of {most:.4g} {s.unit}"
    wanted = trace(_currents_wanted, plant)(point.x, point.v)[0].ravel()
    carried = np.array(ca.evalf(ca.vertcat(plant.actuator.limited(ca.DM(wanted))))).ravel()
    carried = np.clip(carried, -plant.actuator.current_limit, plant.actuator.current_limit)
    missed = np.abs(carried - wanted)
    k = int(missed.argmax())
    if missed[k] <= LIMIT_ROUNDING * np.abs(wanted).max():
        return ""
    coil = plant.actuator.coils[k]
    return f"the current {coil.name} = {wanted[k]:.4g} {coil.unit} is limited to {carried[k]:.4g} {coil.unit}"


def load_balance(plant: Plant, states: FloatArray) -> FloatArray:
    """The commands that cancel the loads alone at rest: f(x, u, load(x)) = f(x, 0, 0); one row for each row of states.

    The controller balances the other forces, as the pull of a magnetic bearing off its centre.

    Raises CheckError when no command cancels the loads.
    """
    u = _hold(plant, states, loads_alone=True)
    return _commands(plant, None, states, u, [], loaded=True)[0]


def holding_commands(plant: Plant, states: FloatArray) -> FloatArray:
    """The commands whose currents hold the machine at rest at these states, whatever its magnets pull with there.

    Raises CheckError when no commands hold it.
    """
    return _commands(plant, None, states, _hold(plant, states), [], loaded=True)[0]


def _name_state(plant: Plant, x: FloatArray) -> str:
    """A state in words: "q = 0.001 m"."""
    entries = [f"{s.name} = {v:.4g} {s.unit}" for s, v in zip(plant.states, x.tolist(), strict=True) if v]
    return f"the state {', '.join(entries)}" if entries else "it at rest at its states' zero"


def _rates_of(plant: Plant, x: Any, u: Any, w: Any) -> Any:
    """f(x, u, w) with zeros for accelerations that no input holds."""
    rate = ca.densify(plant.f(x, u, w))
    if plant.second_order:
        for index in set(range(len(plant.states) // 2, len(plant.states))) - set(plant.controlled):
            rate[index] = 0
    return rate


def rates_at_rest(plant: Plant, x: Any, u: Any) -> Any:
    """f(x, u, load(x)) with zeros for accelerations that no input holds: zero at rest."""
    return _rates_of(plant, x, u, plant.load(x))


def _hold(plant: Plant, states: FloatArray, *, loads_alone: bool = False) -> FloatArray:
    """The inputs that hold the machine at rest, or that cancel its loads alone; one row for each row of states."""
    left = trace(_rates_left, plant, None, loads_alone)
    depends = np.unique(np.concatenate([left.function.jac_sparsity(k, 0).get_triplet()[1] for k in (0, 1)]))
    # A load that is the same along the stroke is balanced once.
    _, first, same = np.unique(states[:, depends.astype(int)], axis=0, return_index=True, return_inverse=True)
    start = np.zeros((len(first), len(plant.inputs)))
    found = solve(_equations(left, states[first]), [start], _scales(plant), MAX_REST_RATE, SHARE)
    _require_solved(plant, found.left, "input", states[first])
    return found.values[same]


def _rates_left(plant: Plant, _believed: None, loads_alone: bool) -> tuple[list[Any], list[Any]]:
    """(x, u) -> rates at rest under the loads, or what the loads alone make of them, and their slope by u."""
    m, w = len(plant.inputs), len(plant.disturbances)
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", m)
    rate = rates_at_rest(plant, x, u)
    if loads_alone:
        rate -= _rates_of(plant, x, ca.SX.zeros(m), ca.SX.zeros(w))
    return [x, u], [rate, ca.jacobian(rate, u)]


def _commands(
    plant: Plant,
    believed: Plant | None,
    states: FloatArray,
    inputs: FloatArray,
    before: Sequence[FloatArray],
    *,
    loaded: bool,
) -> tuple[FloatArray, FloatArray]:
    """The commands that have the effect of these inputs, and the inputs that they make; a row for each state.

    before : commands to start from, beside the inputs and shares of the limits
    """
    made = trace(_inputs_of, plant, believed)
    sizes = np.maximum(np.abs(inputs), scales := _scales(plant))

    def near(acting: FloatArray) -> Any:
        return np.abs(acting - inputs) <= 1e-12 * sizes

    if loaded and not before:
        here = (
            made
            if len(states) < MIN_STATES
            else trace(_inputs_of, plant, believed, _used_in(states), _used_in(inputs))
        )
        if near(here.each(states, inputs)[0].T).all():
            return inputs, inputs  # the currents of a command make just what it commands
    equations = _equations(trace(_effect_missed, plant, believed, loaded), np.hstack([states, inputs]))
    rough = np.where(inputs < 0, -1.0, 1.0) * scales
    starts = [
        *before,
        inputs if loaded else _nearer(made, states, inputs),
        inputs,
        np.zeros_like(inputs),
        *(s * share * rough for share in STARTS for s in (1.0, -1.0)),
    ]
    found = solve(equations, starts, scales, MAX_REST_RATE, SHARE)
    _require_solved(plant, found.left, "command", states, inputs if not loaded else None)
    acting = made.each(states, found.values)[0].T
    return found.values, np.where(near(acting), inputs, acting)


def _used_in(rows: FloatArray) -> tuple[float, ...]:
    """1 for columns that are not zero throughout, 0 for others."""
    return tuple(rows.any(axis=0).astype(float).tolist())


def _inputs_of(
    plant: Plant, believed: Plant | None, states: tuple[float, ...] = (), commands: tuple[float, ...] = ()
) -> tuple[list[Any], list[Any]]:
    """(x, v) -> inputs that the currents of v make; of the states and the commands alone that are used, if any are."""
    symbols = command_symbols(plant, believed)
    x, v = (one * ca.DM(used) if used else one for one, used in zip(symbols, (states, commands), strict=True))
    return symbols, [ca.cse(ca.densify(plant.actuator.forces(x, currents_at(plant, believed, x, v))))]


def _currents_wanted(plant: Plant, believed: Plant | None) -> tuple[list[Any], list[Any]]:
    """(x, v) -> the currents of v, A."""
    x, v, i = currents_of(plant, believed)
    return [x, v], [ca.densify(i)]


def _effect_missed(plant: Plant, believed: Plant | None, loaded: bool) -> tuple[list[Any], list[Any]]:
    """((x, u), v) -> rates under the currents of v without those under the inputs u, and their slope by v."""
    x, v, i = currents_of(plant, believed)
    kind = type(x)
    w = plant.load(x) if loaded else kind.zeros(len(plant.disturbances))
    u = kind.sym("u", len(plant.inputs))
    left = _rates_of(plant, x, ca.densify(plant.actuator.forces(x, i)), w) - _rates_of(plant, x, u, w)
    return [ca.vertcat(x, u), v], [left, ca.jacobian(left, v)]


def _nearer(made: Traced, states: FloatArray, inputs: FloatArray) -> FloatArray:
    """The inputs as a command, or zero where that makes inputs which are nearer to these."""
    off = [
        np.abs(made.each(states, command)[0].T - inputs).sum(axis=1)
        for command in (np.zeros_like(inputs), inputs)
    ]
    nearer = np.isfinite(off[0]) & ~(off[1] <= off[0])
    return np.where(nearer[:, None], 0.0, inputs)


def _equations(residual: Traced, rows: FloatArray) -> Equations:
    """The residual and its slope by the unknown, row by row of what is given."""

    def evaluate(values: FloatArray) -> tuple[FloatArray, FloatArray]:
        r, J = residual.each(rows, values)
        return r.T, J.reshape(-1, len(rows), values.shape[1]).swapaxes(0, 1)

    return evaluate


def _scales(plant: Plant) -> FloatArray:
    """The limits of the inputs; ones where some have none."""
    limits = np.array(plant.actuator.force_limit, dtype=float)
    whole = len(limits) == len(plant.inputs) and np.isfinite(limits).all() and (limits > 0).all()
    return limits if whole else np.ones(len(plant.inputs))


def _require_solved(
    plant: Plant, left: FloatArray, what: str, states: FloatArray, preload: FloatArray | None = None
) -> None:
    """Raise CheckError for the first state with a rate that is left."""
    for row, (x, rate) in enumerate(zip(states, left, strict=True)):
        if (rate == 0).all():
            continue
        k = int(np.nanargmax(np.abs(rate))) if np.isfinite(rate).any() else 0
        found = f"{plant.states[k].name} changes at {rate[k]:.3g} {plant.states[k].unit}/s"
        if preload is None:
            raise CheckError(f"{plant.name}: no {what} holds {_name_state(plant, x)}: {found}")
        missed = f"no command makes its `preload` {preload[row].tolist()} at {_name_state(plant, x)}: {found} otherwise"
        raise CheckError(f"{plant.name}: {missed}")
