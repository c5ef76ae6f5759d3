"""The largest load that a machine bears whatever its waveform, as a theorem of its nonlinear model."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from malta.arguments import by_name, describe, number
from malta.arrays import FloatArray
from malta.bound import Bound, at_least, at_most
from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError, require_known
from malta.linear.expressions import NotAnalytic
from malta.loops.loop import Loop
from malta.loops.parametric_plants import check_names, declared_limits
from malta.loops.waveforms import load_shares
from malta.margins.surroundings import MachineAtRest, Surroundings, machine_at_rest
from malta.processes import on_one_thread
from malta.proof.box import box_of
from malta.proof.margin import Ranges
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.safe_set import held_set, signal_norms
from malta.work import NO_TIME, WorkUp, is_stopped

Load = str | Mapping[str, float]

CALLER = "safe_load"
START = "times"  # the unit of a multiple of a start
NOISE = 6.0  # times its rms, that an error of a reading is at most
ASIDE = 1.0  # SI, of a state that the law leaves alone, at most
SEARCH_TOLERANCE = 0.002  # share of a load, between what is proven and what is not
LEAST_SHARE = 1e-6  # of the load where the linear loop touches or saturates


@display
@dataclass(frozen=True, eq=False)
class SafeLoad:
    """A load below which nothing is touched and nothing saturates, whatever its waveform.

    disturbance : the load, as it was asked for
    unit : of the load
    limit : largest size that is proven, SI, rounded down; None: nothing is proven
    beyond : a larger size at which `ends` stopped the proof, SI
    ends : what happens, or may, at `beyond`
    noise : errors of readings are at most so many times their rms, and half a resolution
    aside : how far states that the law leaves alone are from rest at most, SI, by name with their units
    outputs : of each output by name, how far it goes at most under `limit`, with its unit
    used : of each contact by name, the share of its clearance that is used at most
    forces : of each command by name, the share of its limit
    clearance : the largest share of a clearance that was allowed; 1: what touches ends it
    """

    disturbance: str
    unit: str
    limit: float | None
    beyond: float
    ends: str
    noise: float
    aside: Mapping[str, tuple[float, str]]
    outputs: Mapping[str, tuple[float, str]]
    used: Mapping[str, float]
    forces: Mapping[str, float]
    clearance: float = 1.0

    @property
    def proven(self) -> Bound:
        """The largest size that is proven, as it is shown."""
        return at_least(self.limit)

    @property
    def description(self) -> Description:
        """The bound, how far it lets signals go, and what ends it."""
        if self.limit is None:
            any_ = "" if self.unit == START else "any "
            return Description(f"Nothing is proven of {any_}{self.disturbance}", (("reason", self.ends),))
        rows = [("not proven", f"at {self.beyond:.4g} {self.unit}: {self.ends}")]
        rows.append(("of", "the nonlinear machine from rest, with forces as commanded"))
        rows.append(("while", f"readings are off by at most {self.noise:g} times their noise"))
        rows += [
            ("while", f"{name} is at most {quantity(x, unit)}") for name, (x, unit) in self.aside.items()
        ]
        for what, shares in (("of its limit", self.forces), ("of its clearance", self.used)):
            if shares:
                name = max(shares, key=lambda one: shares[one])
                rows.append((name, f"at most {at_most(shares[name]).percent()} {what}"))
        rows += [
            (name, f"at most {at_most(x).text()} {unit}") for name, (x, unit) in self.outputs.items() if x
        ]
        asked = f"{self.proven.text()} {self.unit}"
        if self.unit == START:
            title = f"From {asked} {self.disturbance} nothing is touched, nothing saturates"
        else:
            more = f"uses more than {100 * self.clearance:g} % of a clearance or"
            does = "touches or" if self.clearance == 1 else more
            title = f"No {self.disturbance} of at most {asked} {does} saturates anything"
        return Description(title, tuple(rows))


@on_one_thread
def safe_load(
    loop: Loop,
    disturbance: Load | Sequence[Load],
    ranges: Ranges | None = None,
    *,
    noise: float = NOISE,
    aside: float | Mapping[str, float] = ASIDE,
    clearance: float = 1.0,
) -> SafeLoad:
    """Prove how large a load may be, whatever its waveform, before the nonlinear machine may touch or saturate.

        x' = f(x, forces(x, i), w + load(x)),   |w(t)| <= limit,   from rest

    The linear loop's l1 norms bound the motion, and what the machine is beside its linear model is a further load,
    bounded over the set of states that the motion stays in: a set that is mapped into itself. Within it forces and
    currents stay within their limits, so that the law is linear, and no contact is touched.

    loop : from `malta.loop`
    disturbance : a load by name, N or N m; a load at a point as {"F_x": 1, "T_y": -0.045}, of which the limit is the
        multiple; several of them, each at most the limit with a waveform of its own
    ranges : of parameters, as in `malta.robust_margin`: they may be anywhere in this box, and move in it. None: nominal
    noise : what the linear loop makes of the sensors' noise is at most so many times its rms, in each signal; errors of
        readings by their resolution are within half of it
    aside : how far states that the law leaves alone and that act on the others are from rest at most, SI, as the roll
        of a shaft; one number, or by name
    clearance : the largest share of each clearance that may be used, as that of `malta.model.vibration_preset`

    Returns a SafeLoad, of the machine with forces as `fidelity="force"` flies them: what its coils are held at, through
    the lags of its current loops. Induced voltages and the DC link's are not in it.

    Raises InputError for a load that the machine has not, for `noise` below 0, and for a share that is none.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/structured.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> found = malta.safe_load(loop, "F_x")
    >>> f"any F_x of {found.proven.text()} N: beyond, {found.ends}"
    'any F_x of 17.16 N: beyond, fx_B2 may reach its limit'
    """
    if not isinstance(loop, Loop):
        raise InputError(CALLER, "loop", describe(loop), "a Loop, from malta.loop")
    ((found, _),) = answers(loop, [disturbance], ranges, noise=noise, aside=aside, clearance=clearance)
    return found


def answers(
    loop: Loop,
    disturbances: Sequence[Load | Sequence[Load]],
    ranges: Ranges | None = None,
    *,
    noise: float = NOISE,
    aside: float | Mapping[str, float] = ASIDE,
    clearance: float = 1.0,
) -> Iterator[tuple[SafeLoad, Surroundings | None]]:
    """`safe_load` of several loads, whose norms are computed at once, each with what it was proven in.

    Where the time is up, nothing is proven of those that are left. Raises InputError as `safe_load`.
    """
    if not 0 < number(CALLER, "clearance", clearance) <= 1:
        raise InputError(CALLER, "clearance", f"{clearance:g}", "a share above 0 and up to 1")
    none = np.zeros((len(loop.model.A), 0))
    asked = [_SizeQuestion(*_loads_of(loop, one), none) for one in disturbances]
    for what, near in zip(asked, _surroundings(CALLER, loop, asked, ranges, noise, aside), strict=True):
        if isinstance(near, Surroundings):
            near = replace(near, clearance=clearance)
        found = replace(_answer_to(what, near, noise), clearance=clearance)
        yield found, near if isinstance(near, Surroundings) and found.limit is not None else None


def _loads_of(loop: Loop, disturbance: Load | Sequence[Load]) -> tuple[str, str, FloatArray]:
    """The name, the unit and the shares of a load, or of several at once. Raises InputError."""
    asked = disturbance if isinstance(disturbance, tuple | list) else [disturbance]
    loads = [load_shares(loop.plant, one, CALLER) for one in asked]
    if not loads:
        raise InputError(CALLER, "disturbance", "no load", "one or more")
    return " and ".join(map(_load_text, asked)), loads[0][0], np.column_stack([one for _, one in loads])


def _load_text(load: Any) -> str:
    """A load in words: its name, or its shares, as `1 F_x, -0.045 T_y`."""
    return load if isinstance(load, str) else ", ".join(f"{share:g} {name}" for name, share in load.items())


@on_one_thread
def safe_start(
    loop: Loop,
    start: Mapping[str, float],
    ranges: Ranges | None = None,
    *,
    noise: float = NOISE,
    aside: float | Mapping[str, float] = ASIDE,
) -> SafeLoad:
    """Prove from where the nonlinear machine comes back to rest without touching or saturating anything.

    start : how far states may be from rest, either way and all at once, SI, by name: a position and its speed
    loop, ranges, noise, aside : as in `malta.safe_load`

    Returns a SafeLoad whose `limit` is the multiple of the start that is proven. The law knows the state, its sums of
    errors are settled, and earlier commands were those of rest.

    Raises InputError for states that the design model has not, and otherwise as `malta.safe_load`.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/structured.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> found = malta.safe_start(loop, {"x": 2e-5, "x_dot": 1e-3})
    >>> f"{found.proven.text()} times 20 um and 1 mm/s"
    '1.161 times 20 um and 1 mm/s'
    """
    if not isinstance(loop, Loop):
        raise InputError("safe_start", "loop", describe(loop), "a Loop, from malta.loop")
    signals = loop.plant.design_states
    if not isinstance(start, Mapping) or not start:
        raise InputError("safe_start", "start", describe(start), "distances from rest by name of a state")
    require_known(start, [s.name for s in signals], "safe_start", "start")
    sizes = {s: number("safe_start", f"start.{s.name}", start[s.name]) for s in signals if s.name in start}
    if not any(sizes.values()) or min(sizes.values()) < 0:
        raise InputError("safe_start", "start", f"{min(sizes.values()):g}", "distances above 0")
    starts = np.eye(len(signals))[:, [signals.index(s) for s in sizes]] * list(sizes.values())
    name = " and ".join(f"{s.name} {quantity(x, s.unit)}" for s, x in sizes.items())
    none = np.zeros((len(loop.plant.disturbances), 0))
    what = _SizeQuestion(name, START, none, starts)
    (near,) = _surroundings("safe_start", loop, [what], ranges, noise, aside)
    return _answer_to(what, near, noise)


class _SizeQuestion(NamedTuple):
    """What the largest multiple is asked of: a load or a start."""

    name: str
    unit: str
    shares: FloatArray  # disturbances x loads
    starts: FloatArray  # states x starts


def _surroundings(
    caller: str,
    loop: Loop,
    asked: Sequence[_SizeQuestion],
    ranges: Ranges | None,
    noise: float,
    aside: float | Mapping[str, float],
) -> list[Surroundings | str]:
    """The machine about its rest under each load, or why nothing is proven of it. Raises InputError.

    The norms of all loads are computed at once; all questions have the starts of the first one.
    """
    size = number(caller, "noise", noise)
    if size < 0:
        raise InputError(caller, "noise", f"{size:g}", "0 or more")
    try:
        widths = _half_widths(caller, loop, ranges)
        machine = machine_at_rest(loop, tuple(ranges or ()))
        apart = np.concatenate([_aside(caller, machine, aside), widths])
        moved = [machine.is_moved(q.shares) for q in asked]
        loads = [q.shares for q, is_moved in zip(asked, moved, strict=True) if is_moved]
        norms = signal_norms(machine.under(np.hstack(loads), asked[0].starts)) if loads else None
    except (Unproven, CheckError, NotAnalytic, WorkUp) as error:
        return [_reason_of(error)] * len(asked)
    found: list[Surroundings | str] = []
    first, end = 0, sum(shares.shape[1] for shares in loads)
    for q, is_moved in zip(asked, moved, strict=True):
        if norms is None or not is_moved:
            found.append("a load that moves none of the controlled states")
            continue
        own = [*range(first, first + q.shares.shape[1]), *range(end, norms.loads.shape[1])]
        first += q.shares.shape[1]
        found.append(Surroundings(machine, q.shares, norms.of_loads(own), size, apart))
    return found


def _answer_to(what: _SizeQuestion, near: Surroundings | str, noise: float) -> SafeLoad:
    """The largest multiple that is proven."""
    reason = near if isinstance(near, str) else ""
    try:
        if isinstance(near, Surroundings) and not is_stopped():
            return _record(near, (what.name, what.unit), _search(near))
    except (Unproven, CheckError, NotAnalytic, WorkUp) as error:
        reason = _reason_of(error)
    return SafeLoad(what.name, what.unit, None, 0.0, reason or NO_TIME, noise, {}, {}, {}, {})


def _reason_of(error: Exception) -> str:
    return NO_TIME if isinstance(error, WorkUp) else str(error)


def _half_widths(caller: str, loop: Loop, ranges: Ranges | None) -> FloatArray:
    """How far parameters are from their nominal values at most. Raises InputError."""
    if not ranges:
        return np.zeros(0)
    plant = loop.plant
    names = tuple(by_name(caller, "ranges", ranges, '{"m": 0.05}'))
    check_names(plant, names)
    if plant.stroke.name in names:
        raise InputError(
            caller, plant.stroke.name, "the stroke", "a parameter: one place of the stroke is asked for"
        )
    nominal = np.array([getattr(plant.parameters, name) for name in names], dtype=float)
    limits = declared_limits(plant.parameters, names)
    sides = box_of(names, nominal, limits, ranges, {}, caller=caller).sides(1.0)
    return np.asarray(np.abs(sides - nominal[:, None]).max(axis=1))


def _aside(caller: str, machine: MachineAtRest, given: float | Mapping[str, float]) -> FloatArray:
    """Half widths of the states that the law leaves alone. Raises InputError."""
    names = [machine.source.plant.states[k].name for k in machine.aside]
    if isinstance(given, Mapping):
        require_known(given, names, caller, "aside")
        found = [number(caller, f"aside.{name}", given.get(name, ASIDE)) for name in names]
    else:
        found = [number(caller, "aside", given)] * len(names)
    if any(x < 0 for x in found):
        raise InputError(caller, "aside", f"{min(found):g}", "0 or more")
    return np.array(found)


class _Found(NamedTuple):
    """The largest load that is proven, with its signals; and what ends the proof beyond."""

    size: float
    bounds: FloatArray
    used: FloatArray
    beyond: float
    ends: str


def _search(near: Surroundings) -> _Found:
    """Halve between a load that is proven and one that saturates the linear loop. Raises Unproven for none at all."""
    machine, norms = near.machine, near.norms
    p, n = near.errors.shape[1], norms.rates.shape[1]
    room = machine.source.controller.limits.force - np.abs(machine.command)
    with np.errstate(divide="ignore"):
        high = float((room / norms.load[n + p : n + p + len(room)]).min())
    if not 0 < high < math.inf:
        raise Unproven("commands that the load does not move, or that are at their limits at rest")
    low, ends = 0.0, "a command may reach its limit"
    found = bounds_under(near, 0.0)
    while high - low > SEARCH_TOLERANCE * high and high > LEAST_SHARE * room.max():
        X = (low + high) / 2
        try:
            found, low = bounds_under(near, X), X
        except (Unproven, NotAnalytic) as error:
            high, ends = X, str(error)
    return _Found(low, *found, high, ends)


def bounds_under(near: Surroundings, X: float) -> tuple[FloatArray, FloatArray]:
    """How far signals go under a load of at most X, and shares of clearances. Raises Unproven where one is used up."""
    T = held_set(near.norms, near.noise * near.norms.noise, X, lambda Z: near.remainders(X, Z))
    used = near.clearances(X, T)
    if (used >= near.clearance).any():
        name = near.machine.source.plant.contacts.names[int((used >= near.clearance).argmax())]
        more = f"use more than {100 * near.clearance:g} % of its clearance"
        raise Unproven(f"{name} may {'be touched' if near.clearance == 1 else more}")
    return T, used


def _record(near: Surroundings, what: tuple[str, str], found: _Found) -> SafeLoad:
    machine, plant = near.machine, near.machine.source.plant
    n = near.norms.rates.shape[1]
    p, m = len(plant.outputs), len(machine.command)
    limits, left_alone = machine.source.controller.limits.force, [plant.states[k] for k in machine.aside]
    forces = (np.abs(machine.command) + found.bounds[n + p : n + p + m]) / limits
    return SafeLoad(
        what[0], what[1], found.size, found.beyond, found.ends, near.noise,
        {s.name: (x, s.unit) for s, x in zip(left_alone, near.aside.tolist(), strict=False)},
        {s.name: (x, s.unit) for s, x in zip(plant.outputs, found.bounds[n : n + p].tolist(), strict=True)},
        dict(zip(plant.contacts.names, found.used.tolist(), strict=True)),
        {s.name: x for s, x in zip(plant.inputs, forces.tolist(), strict=True)},
    )  # fmt: skip
