"""A machine about its rest: its loop, and what it adds to its linear model while its signals stay in a set.

    x' = f(x, forces(x, i), w + load(x)),   i = currents(y + e, v), held, with the lag of its current loops

Second slopes over a set bound what is not linear in it. Where rates are affine in currents, currents that lag make what
their commands make, on an average over these, so that rates are functions of held readings and commands.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from flint import arb

from malta.arrays import FloatArray
from malta.linear.balls import POINTS
from malta.linear.branches import INTERVALS, SPANS, Interval, is_identity_within, without_branches
from malta.linear.expressions import MatrixProgram, program
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.loop import Loop
from malta.loops.parametric_plants import held_gain, in_symbols
from malta.loops.sampled_laws import with_held_currents
from malta.loops.sampled_loops import commanded_model, feedforward_slope
from malta.model.currents import is_commutated
from malta.model.plant import Plant, total_delay
from malta.model.plants import plant_of
from malta.proof.impulse_bounds import EPS, UP, Enclosed
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.safe_set import DisturbedLoop, Remainders, SignalNorms
from malta.synthesis.controller import Controller
from malta.synthesis.linear_law import LinearLaw, linear_law, with_slope

ROUNDING = 1e-9  # of a law at rest
WIDENING = 1.15  # times a set, over which second slopes are bounded for all sets that are near


class SignalSlices(NamedTuple):
    """Where the signals of a machine's functions are: states, coil currents, the load, readings and commands."""

    states: slice
    currents: slice
    load: slice
    readings: slice
    commands: slice
    aside: slice  # states that the law leaves alone, then parameters


class MachineAtRest(NamedTuple):
    """A machine about its rest, and its loop."""

    source: Loop
    system: UncertainSystem
    at: SignalSlices
    slopes: MatrixProgram  # deviations -> rates and readings, their slopes and their second slopes; see machine_at_rest
    by_load: FloatArray  # what a unit of each disturbance adds to the rates
    currents: MatrixProgram  # deviations -> slopes of the held currents
    positive: MatrixProgram | None  # above zero where these hold
    contacts: MatrixProgram
    limited: ca.Function  # currents -> currents within their limits
    current: FloatArray  # at rest
    command: FloatArray  # at rest
    law: _LawAtRest
    aside: tuple[int, ...]  # uncontrolled states that act on the others

    def is_moved(self, shares: FloatArray) -> bool:
        """Whether each of some loads, disturbances x loads, moves a controlled state."""
        return bool((self.by_load @ shares).any(axis=0).all())

    def under(self, shares: FloatArray, starts: FloatArray | None = None) -> DisturbedLoop:
        """The loop under loads, and from deviations of its states.

        shares : disturbances x loads
        starts : n x starts, of the controlled states, which the law knows; None: it begins at rest
        """
        b = self.by_load @ shares
        n, size, law = len(b), self.system.matrices.size1_out(0), self.law.compensator
        b = np.pad(b, ((0, size - n), (0, 0)))
        begun = np.zeros((size + len(law.A), 0 if starts is None else starts.shape[1]))
        if starts is not None:
            begun[:n] = starts
            begun[n:size] = _read_late(self.source.plant, self.source.model.C @ starts)
            if self.source.controller.tracks == "states":
                begun[size : size + n] = starts
        noise = np.asarray(self.source.plant.sensors.noise, dtype=float)
        return DisturbedLoop(self.system, law, b, len(self.command), self.law.rows, noise, begun)


def _read_late(plant: Plant, readings: FloatArray) -> FloatArray:
    """The states of the sensors' lags where readings have stood still."""
    return readings[[k for k, lag in enumerate(plant.sensors.lag) if lag]]


def _is_affine_in_currents(plant: Plant) -> bool:
    """Whether rates are, so that currents that lag make what their commands make, on an average over these."""
    sizes = len(plant.states), len(plant.actuator.coils), len(plant.disturbances)
    x, i, w = (ca.SX.sym(name, size) for name, size in zip("xiw", sizes, strict=True))
    return not any(ca.which_depends(ca.vertcat(plant.f(x, plant.actuator.forces(x, i), w)), i, 2, True))


@lru_cache(maxsize=4)  # loops compare by identity
def machine_at_rest(source: Loop, names: tuple[str, ...] = ()) -> MachineAtRest:
    """A machine about its rest.

    names : of parameters that may differ from those of the loop's machine

    Raises Unproven for a machine whose functions are not enclosed.
    """
    plant, given = source.plant, source.controller
    if source.current_loops != "lag":
        source = Loop(plant, given, source.at, "lag")
    model = commanded_model(source.model, given)
    believed, point = plant_of(given.parameters), model.operating_point
    currents_of = believed.actuator.currents
    if plant.actuator.tabulated or believed.actuator.tabulated:
        raise Unproven("currents from a table, which are not enclosed")
    command, x0, keep = np.asarray(point.v, dtype=float), ca.DM(point.x), list(plant.controlled)
    y0 = plant.h(x0, ca.DM(point.u))
    i0 = ca.DM(currents_of(y0, ca.DM(command)))
    bent = math.isfinite(plant.actuator.crossover) and not _is_affine_in_currents(plant)
    states = _acting_aside(plant, i0)
    sizes = (
        len(keep),
        i0.numel() * bent,
        len(plant.disturbances),
        len(model.C),
        len(command),
        len(states),
        len(names),
    )
    ends = [0, *itertools.accumulate(sizes)]
    at = SignalSlices(*itertools.starmap(slice, itertools.pairwise(ends[:-1])))
    s, x = ca.SX.sym("s", ends[-1]), ca.SX(x0)
    own = {name: getattr(plant.parameters, name) + s[ends[-2] + k] for k, name in enumerate(names)}
    machine = in_symbols(plant, own) if own else plant
    _require_acting(machine, own)
    x[keep] += s[at.states]
    x[list(states)] += s[at.aside]
    at = at._replace(aside=slice(at.aside.start, ends[-1]))
    wanted = currents_of(y0 + s[at.readings], ca.DM(command) + s[at.commands])
    i = i0 + s[at.currents] if bent else wanted
    w = s[at.load] + machine.load(x)
    rates = machine.f(x, machine.actuator.forces(x, i), w)
    rows = [rates[keep], machine.h(x, ca.DM(point.u)) - y0, *((wanted - i0,) if bent else ())]
    functions = [ca.densify(ca.vertcat(*rows)), ca.densify(wanted - i0)]
    contacts = ca.densify(ca.SX(machine.contacts.contact(x)))
    _require_use(
        ca.vertcat(functions[0], contacts), s, dict(zip(names, range(ends[-2], ends[-1]), strict=True))
    )
    smooth, positive = without_branches(ca.Function("machine", [s], functions), [0.0] * s.numel())
    g, wanted = smooth.call([s])
    second = ca.vertcat(*(ca.hessian(row, s)[0] for row in ca.vertsplit(g)))
    slopes = program(ca.Function("slopes", [s], ca.cse([g, ca.jacobian(g, s), second])))
    coil = ca.SX.sym("i", i0.numel())
    system, _ = source.uncertain(())
    held = held_gain(believed, source.at) if is_commutated(believed) else None
    law = _law(source, command, held, handed=system.matrices.size2_out(1) > len(command))
    by_load = enclose_matrices(slopes.only((1,)), np.zeros(s.numel()))[1].mid[: len(keep), at.load]
    return MachineAtRest(
        source, system, at, slopes, by_load,
        program(ca.Function("currents", [s], ca.cse([ca.jacobian(wanted, s)]))),
        None if positive is None else program(positive),
        program(ca.Function("contacts", [s], [contacts])),
        ca.Function("limited", [coil], [ca.densify(plant.actuator.limited(coil))]),
        np.array(i0, dtype=float).ravel(), command, law, states,
    )  # fmt: skip


def _acting_aside(plant: Plant, i0: Any) -> tuple[int, ...]:
    """Uncontrolled states that act on controlled ones, on readings or on contacts."""
    x, w = ca.SX.sym("x", len(plant.states)), ca.SX.sym("w", len(plant.disturbances))
    rates = plant.f(x, plant.actuator.forces(x, i0), w + plant.load(x))
    own = list(plant.controlled)
    every = ca.SX(ca.vertcat(rates[own, 0], plant.h(x, 0), plant.contacts.contact(x)))
    acts = np.unique(ca.jacobian(every, x).sparsity().get_triplet()[1])
    return tuple(int(k) for k in acts if k not in own)


def _require_acting(machine: Plant, own: Mapping[str, Any]) -> None:
    """Raise Unproven for parameters that act on what is a number here, as the lag of a current loop."""
    actuator, sensors, coil = machine.actuator, machine.sensors, ca.SX.sym("i", len(machine.actuator.coils))
    fixed = {
        "the current loops' lag": actuator.crossover,
        "a dead time": ca.vertcat(actuator.dead_time, actuator.computation_time, sensors.dead_time),
        "the sensors' lag": ca.vertcat(*sensors.lag),
        "the limits of currents": ca.substitute(
            ca.SX(actuator.limited(coil)), coil, ca.SX.zeros(coil.numel())
        ),
    }
    for name, symbol in own.items():
        for what, value in fixed.items():
            if ca.depends_on(ca.SX(value), ca.vertcat(*ca.symvar(symbol))):
                raise Unproven(f"{name} acts on {what}, which is taken as known")


def _require_use(functions: Any, s: Any, names: Mapping[str, int]) -> None:
    """Raise Unproven for parameters, by their places in s, on which nothing depends: of a drive that is left out."""
    used = set(ca.jacobian(functions, s).sparsity().get_triplet()[1])
    for name, place in names.items():
        if place not in used:
            raise Unproven(f"{name} acts on none of the functions that are bounded")


class _LawAtRest(NamedTuple):
    """The law of a loop in the coordinates that it computes in, so that what it estimates can be asked for."""

    compensator: Compensator
    rows: tuple[FloatArray, FloatArray]  # of (y, its states): commands, then estimates of the axes that brake
    held: FloatArray  # the gain of held currents: commands + held y act
    offset: FloatArray  # by which v0 misses the commands at rest, where no sum of errors makes up for it
    braking: FloatArray  # errors from which the axes brake


def _law(source: Loop, command: FloatArray, held: FloatArray | None, *, handed: bool) -> _LawAtRest:
    """The law with its hold, delay and lags. Raises Unproven for a law of errors that brakes."""
    c, plant = source.controller, source.plant
    law = with_slope(linear_law(c), feedforward_slope(plant, c, source.at))
    axes, k = np.flatnonzero(c.braking), len(law.A)
    if len(axes) and c.tracks != "states":
        raise Unproven("a law of errors that brakes")
    of_y, of_law = c.L[axes], np.zeros((len(axes), k))
    if len(axes):
        of_law[:, : len(c.states)] = np.eye(len(c.states))[axes] - of_y @ c.Cd
    rows = np.vstack([law.D_y, of_y]), np.vstack([law.C, of_law])
    design = source.model.operating_point.x[list(plant.controlled)]
    missed = np.asarray(command) - c.feedforward.at_rest(place_of(source), design)
    offset = _left_over(law, missed, c)
    law = with_held_currents(law, held, len(c.measurements) if handed else 0)
    lag = plant.actuator.crossover if math.isfinite(plant.actuator.crossover) else None
    delay = total_delay(plant, c.sample_time)
    made = Compensator(law.A, law.B_y, law.C, law.D_y, 0, c.sample_time, delay, lag)
    H = np.zeros((len(c.forces), len(c.measurements))) if held is None else held
    return _LawAtRest(made, rows, H, offset, np.asarray(c.braking[axes]))


def _left_over(law: LinearLaw, missed: FloatArray, c: Controller) -> FloatArray:
    """What commands lack at rest beyond v0, where the law's own states do not hold it."""
    k = len(law.A)
    settled = np.vstack([np.eye(k) - law.A, law.C])
    state = np.linalg.lstsq(settled, np.concatenate([np.zeros(k), missed]), rcond=None)[0]
    moves = np.abs(settled[:k] @ state) > ROUNDING * (np.abs(law.A) @ np.abs(state) + 1e-30)
    lacks = np.abs(missed - law.C @ state) > ROUNDING * c.limits.force
    return np.asarray(np.abs(missed) if moves.any() else np.where(lacks, np.abs(missed), 0.0))


def place_of(source: Loop) -> float:
    """Where a loop is along the stroke, m; 0 for a machine without one."""
    return source.at.get(source.plant.stroke.name, 0.0) if source.plant.has_stroke else 0.0


def enclose_matrices(model: MatrixProgram, half: FloatArray) -> list[Enclosed]:
    """The matrices of a program within half widths about zero, entry by entry. Raises Unproven."""
    balls = [arb(-x).union(arb(x)) for x in half.tolist()]
    found = []
    for shape, own in zip(model.shapes, model.run(balls, POINTS), strict=True):
        mid, rad = np.zeros((2, *shape))
        for i, j, ball in own:
            one = arb(ball)
            mid[i, j] = float(one.mid())
            rad[i, j] = float(one.rad()) * UP + EPS * abs(mid[i, j])
        if not np.isfinite([mid, rad]).all():
            raise Unproven("a machine that is not finite in the set")
        found.append(Enclosed(mid, rad))
    return found


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What a machine adds to its linear model about its rest."""

    machine: MachineAtRest
    shares: FloatArray  # disturbances x loads
    norms: SignalNorms
    noise: float
    aside: FloatArray
    clearance: float = 1.0  # largest share of each that may be used; 1: what touches ends it
    known: list[tuple[FloatArray, FloatArray]] = field(default_factory=list)  # second slopes over sets

    @cached_property
    def here(self) -> tuple[Enclosed, Enclosed]:
        """The machine's functions at rest, and their slopes."""
        slopes = self.machine.slopes.only((0, 1))
        g, J, _ = enclose_matrices(slopes, np.zeros(slopes.inputs))
        return g, J

    @cached_property
    def errors(self) -> FloatArray:
        """Of readings, by noise and by resolution: 2 x p."""
        sensors = self.machine.source.plant.sensors
        return np.array([self.noise * np.asarray(sensors.noise), np.asarray(sensors.resolution) / 2])

    @cached_property
    def unlike(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """By how much slopes differ from the linear model's: of rates, by states; by commands; by readings."""
        m, (_, J), at = self.machine, self.here, self.machine.at
        n, k, (A, B, _) = at.states.stop, len(m.command), self.norms.matrices
        rates, A = slice(0, n), A.part(range(n), range(n))
        x = _columns(J, at.states)
        of_x = np.abs(x.mid[rates] - A.mid) + x.rad[rates] + A.rad
        found = []
        for columns, into in ((at.commands, np.eye(k)), (at.readings, m.law.held)):
            wanted = B.mid[:n, :k] @ into
            if columns is at.readings and B.mid.shape[1] > k:
                wanted = wanted + B.mid[:n, k:]
            made, sizes = self._slopes_by(columns)
            apart = np.abs(made.mid - wanted) + made.rad + 1e-14 * (sizes + np.abs(wanted))
            found.append(apart + B.rad[:n, :k] @ np.abs(into))
        return of_x, found[0], found[1]

    def _slopes_by(self, columns: slice) -> tuple[Enclosed, FloatArray]:
        """What commands or readings make of rates, through currents of their own where there are any; and its size."""
        (_, J), at = self.here, self.machine.at
        n, own = at.states.stop, _columns(J, columns)
        if at.currents.stop == at.currents.start:
            return Enclosed(own.mid[:n], own.rad[:n]), np.abs(own.mid[:n])
        i, coils = _columns(J, at.currents), slice(len(J.mid) - (at.currents.stop - at.currents.start), None)
        through, size = np.abs(i.mid[:n]) + i.rad[:n], np.abs(own.mid[coils])
        rad = through @ own.rad[coils] + i.rad[:n] @ size
        return Enclosed(i.mid[:n] @ own.mid[coils], rad), through @ size

    def widths(self, X: float, Z: FloatArray) -> FloatArray:
        """Half widths of the signals of the machine's functions in a set, without currents."""
        m, at, n = self.machine, self.machine.at, self.norms.rates.shape[1]
        half = np.zeros(m.slopes.inputs)
        half[at.states], half[at.aside] = Z[: at.states.stop], self.aside
        half[at.load] = X * np.abs(self.shares).sum(axis=1)
        p = self.errors.shape[1]
        half[at.readings] = Z[n : n + p] + self.errors.sum(axis=0)
        half[at.commands] = Z[n + p : n + p + len(m.command)]
        return UP * half

    def remainders(self, X: float, Z: FloatArray) -> Remainders:
        """What is added while signals stay within Z. Raises Unproven where something saturates or brakes."""
        m, (_, J), at = self.machine, self.here, self.machine.at
        n, coils = at.states.stop, at.currents.stop - at.currents.start
        half = self.widths(X, Z)
        over = half[at.commands] + np.abs(m.command) >= m.source.controller.limits.force
        if over.any():
            names = [s.name for s in m.source.plant.inputs]
            raise Unproven(f"{names[int(over.argmax())]} may reach its limit")
        if (Z[len(Z) - len(m.law.braking) :] >= m.law.braking).any():
            raise Unproven("the law may brake")
        sizes = np.abs(J.mid) + J.rad
        # Readings are those of held currents; what h adds to them is an error of these too.
        coils, C = at.currents.stop - at.currents.start, m.source.model.C
        readings, held = slice(n, n + len(C)), slice(n + len(C), None)
        apart = np.abs(J.mid[readings, at.states] - C) + J.rad[readings, at.states]
        off = self._remainder_of(half, readings) + apart @ half[at.states]
        half[at.readings] += UP * off
        self._require_limits(half)
        bent = self._remainder_of(half, held)
        half[at.currents] = UP * (sizes[held] @ half + bent)
        of_x, of_v, of_y = self.unlike
        rates = self._remainder_of(half, slice(0, n)) + of_x @ half[at.states]
        rates += of_v @ half[at.commands] + of_y @ half[at.readings]
        rates += (J.rad + 8 * EPS * np.abs(J.mid))[:n, at.load] @ half[at.load]
        if coils:
            rates += sizes[:n, at.currents] @ bent
        whole = np.zeros(self.norms.rates.shape[1])
        whole[:n] = UP * rates
        return Remainders(
            whole, UP * (self.errors[1] + off), UP * (m.law.offset + self._table_error(half[at.readings]))
        )

    def _remainder_of(self, half: FloatArray, rows: slice) -> FloatArray:
        """What some rows of the machine's functions have beside their slopes at rest, by other states too."""
        g, J = self.here
        by_aside = np.abs(J.mid[rows, self.machine.at.aside]) + J.rad[rows, self.machine.at.aside]
        curved = (self._second_slopes(half)[rows] @ half) @ half / 2
        found = np.abs(g.mid[rows, 0]) + g.rad[rows, 0] + curved
        return np.asarray(UP * (found + by_aside @ half[self.machine.at.aside]))

    def _second_slopes(self, half: FloatArray) -> FloatArray:
        """Sizes of the second slopes of each row over a set, or over a slightly larger one that is known."""
        for wide, size in reversed(self.known):
            if (half <= wide).all() and (wide <= WIDENING**2 * half).all():
                return size
        wide = WIDENING * half
        (_, _, H) = enclose_matrices(self.machine.slopes.only((2,)), wide)
        size = UP * (np.abs(H.mid) + H.rad).reshape(-1, len(half), len(half))
        self.known.append((wide, size))
        return size

    def _table_error(self, read: FloatArray) -> FloatArray:
        """How far v0 of a reading, which is a table, is from its slope at rest."""
        plant, forward = self.machine.source.plant, self.machine.source.controller.feedforward
        if not plant.has_stroke:
            return np.zeros(len(self.machine.command))
        z, r = place_of(self.machine.source), float(read[plant.stroke_output])
        inside = [x for x in forward.z_grid.tolist() if abs(x - z) < r]
        slope, here = forward.slope(z), forward.at(z)
        apart = [np.abs(forward.at(x) - here - slope * (x - z)) for x in (z - r, *inside, z + r)]
        return np.asarray(np.max(apart, axis=0) + 8 * EPS * np.abs(forward.v0).max(axis=0))

    def _require_limits(self, half: FloatArray) -> None:
        """Raise Unproven where a limit of a current, or another branch of the machine, may be reached."""
        m = self.machine
        (J,) = enclose_matrices(m.currents, half)
        own = UP * ((np.abs(J.mid) + J.rad) @ half + EPS * np.abs(m.current))
        if not is_identity_within(m.limited, list(zip(m.current - own, m.current + own, strict=True))):
            raise Unproven("a current may reach its limit")
        sides = [Interval(-x, x) for x in half.tolist()]
        above = () if m.positive is None else m.positive.run(sides, INTERVALS)[0]
        if any(not one.low > 0 for _, _, one in above):
            raise Unproven("another branch of the machine's functions may be reached")

    def clearances(self, X: float, T: FloatArray) -> FloatArray:
        """The share of each clearance that is used at most. Raises Unproven."""
        half = self.widths(X, T)
        (own,) = self.machine.contacts.run([Interval(-x, x) for x in half.tolist()], SPANS)
        found = np.zeros(self.machine.contacts.shapes[0][0])
        for i, _, x in own:
            found[i] = x.high
        return found


def _columns(M: Enclosed, part: slice) -> Enclosed:
    return Enclosed(M.mid[:, part], M.rad[:, part])
