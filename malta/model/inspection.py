"""What a machine declares and its linear model does not have: `malta inspect`, and why nothing is proven of it.

A linear loop is that of the machine where x' = f(x, forces(x, currents(y, v)), load(x)) and y = h(x) have one slope at
rest. It is another machine's where the slopes of both sides differ, where y has a part of u, where h(0) is not 0, and
where states that were left out as `uncontrolled` close a loop with the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.model.equilibrium import balance, trace, with_command
from malta.model.linearize import _clearance, _derivatives, _limits
from malta.model.parameters import units_of
from malta.model.plant import Plant, has_feedthrough
from malta.model.signals import Signal
from malta.units import is_unit_of

KINK = 1e-3  # of a slope, by which those of both sides differ
MIN_SHARE = 1e-6  # of the largest change of a row: smaller ones are rounding
SIZES = (2.0, 1.0, 0.5, 0.25)  # of the steps to each side
NOISES, ROOM_SHARE = 3.0, 1e-5  # steps: of the noise of a reading, of the room to the first contact
RATE = 100.0  # 1/s, from the step of a position to that of its rate
PLACES, HALVINGS = 64, 12  # cells from rest to each end of a state, and how often one of them is halved
ROUNDING = 1e-9


class Observation(NamedTuple):
    """What was found of a part of a machine, what to have there, and whether nothing is proven because of it."""

    part: str
    found: str
    change: str
    unproven: bool = False

    def __str__(self) -> str:
        return f"{self.part}: {self.found}: {self.change}"


@display
@dataclass(frozen=True)
class Inspection:
    """What was looked at in a machine, and what was found.

    machine : its name
    rows : what to change, one line each
    switches : of each position with a clearance: where its slopes change nearest to rest, in words

    >>> import malta
    >>> malta.inspect(malta.read_design("examples/ball/design/ball.toml").plant).proves
    True
    """

    machine: str
    rows: tuple[Observation, ...]
    switches: tuple[str, ...]

    @property
    def proves(self) -> bool:
        """Whether proofs of its linear model are proofs of the machine."""
        return not any(row.unproven for row in self.rows)

    @property
    def description(self) -> Description:
        """Its rows, and the nearest switches."""
        found = [(row.part, f"{row.found}: {row.change}") for row in self.rows]
        end = f"{len(self.rows)} to look at" if self.rows else "nothing to change"
        return Description(
            f"Machine {self.machine!r}: {end}", (*found, *(("switch", s) for s in self.switches))
        )


def inspect(plant: Plant) -> Inspection:
    """Look at what a machine declares: does it act, do its parts agree, is its linear model the machine's at rest.

    plant : the machine

    Returns an Inspection: a row for each thing to change, and the nearest switch of each position.

    Raises InputError for a machine whose functions cannot be evaluated.

    >>> import malta
    >>> malta.inspect(malta.read_design("examples/ball/design/ball.toml").plant)
    Machine 'ball': 1 to look at
      actuator.currents  not the inverse of `forces` along q, by 103 % of the lim...
      switch             q: none from -0.002 to 0.002 m
    """
    rows = [*_sensor_rows(plant), *_kink_rows(plant, plant.at().x), *_uncontrolled_rows(plant, plant.at().x)]
    rows += [*_inverse_rows(plant), *_unit_rows(plant), *_idle_rows(plant)]
    return Inspection(plant.name, tuple(rows), tuple(_switches(plant)))


@lru_cache(maxsize=64)  # plants compare by identity
def unproven(plant: Plant, at: tuple[float, ...]) -> str:
    """Why nothing is proven of a plant's linear model at the states `at`, in a sentence; "": it is the machine's."""
    x = np.array(at)
    with np.errstate(all="ignore"):  # of parameters beyond what can be computed, which linearization says
        rows = (*_sensor_rows(plant), *_kink_rows(plant, x), *_uncontrolled_rows(plant, x))
    return next((str(row) for row in rows if row.unproven), "")


@lru_cache(maxsize=64)
def require_readings(plant: Plant) -> None:
    """Raise InputError for readings that laws and simulations do not have: see `_sensor_rows`."""
    for row in _sensor_rows(plant):
        raise InputError(plant.name, row.part, row.found, row.change)


def _sensor_rows(plant: Plant) -> list[Observation]:
    """Readings that follow u at once, that are not 0 at 0, and positions that readings do not give back."""
    if has_feedthrough(plant):
        return [
            Observation(
                "h",
                "y follows u at once",
                "h(x) of states alone; a current that a sensor sees is a state",
                True,
            )
        ]
    found, keep, zero = [], list(plant.controlled), np.zeros(len(plant.states))
    sizes = _rooms(plant)
    at_rest, moved = _read(plant, zero)[0], zero.copy()
    q = keep[: plant.coordinates or None]
    moved[q] = 1e-3 * sizes[q] * np.cos(np.arange(1, len(q) + 1))
    y = _read(plant, moved)[0]
    if not (np.isfinite(at_rest).all() and np.isfinite(y).all()):
        return []
    for k, signal in enumerate(plant.outputs):
        if abs(at_rest[k]) > MIN_SHARE * max(abs(y - at_rest).max(), abs(at_rest[k])) and at_rest[k]:
            offset = f"{at_rest[k]:.4g} {signal.unit}"
            found.append(
                Observation(
                    "h",
                    f"h(0) is {offset} of {signal.name}",
                    "subtract it in h: laws take y = 0 at x = 0",
                    True,
                )
            )
    if found:
        return found
    x = _place(plant, y)
    again = _read(plant, x)[0]  # of a state at rest
    twice = _read(plant, _place(plant, again))[0]
    off = np.abs(twice - again)
    if (off > MIN_SHARE * np.abs(again).max()).any():
        k = int(off.argmax())
        signal = plant.outputs[k]
        words = f"h(position_of(y)) is {twice[k]:.4g} where {signal.name} is {again[k]:.4g} {signal.unit}"
        found.append(Observation("position_of", words, "the inverse of h at rest", True))
    return found


def _read(plant: Plant, *x: FloatArray) -> FloatArray:
    """The readings at rest at some states, a row for each."""
    return np.asarray(trace(_readings, plant).each(np.array(x))[0].T)


def _readings(plant: Plant, _: None) -> tuple[list[Any], list[Any]]:
    x, u = _symbols(plant)[:2]
    return [x], [ca.densify(ca.vertcat(plant.h(x, type(x).zeros(u.numel()))))]


def _place(plant: Plant, y: FloatArray) -> FloatArray:
    """The states at rest for readings."""
    position = np.array(ca.DM(plant.position_of(ca.DM(y))), dtype=float).ravel()
    x = np.zeros(len(plant.states))
    x[list(plant.controlled[: len(position)])] = position
    return x


@lru_cache(maxsize=64)
def _rooms(plant: Plant) -> FloatArray:
    """How far each state may go, SI, to a factor of 2: to the first contact, else 1e-3; rates by RATE."""
    n, far = len(plant.states), 2.0 ** np.arange(-30, 21)
    rooms = np.full(n, 1e-3)
    if plant.contacts.names:
        places = np.vstack([s * np.eye(n)[k] for k in range(n) for s in far])
        touched = trace(_contact, plant).each(places)[0].max(axis=0).reshape(n, -1) >= 1
        inside = ~touched[:, 0] & touched.any(axis=1)
        rooms[inside] = far[touched.argmax(axis=1)[inside] - 1]
    if plant.second_order:
        rooms[n // 2 :] = RATE * rooms[: n // 2]
    return rooms


def _contact(plant: Plant, _: None) -> tuple[list[Any], list[Any]]:
    x = _symbols(plant)[0]
    return [x], [ca.densify(ca.vertcat(plant.contacts.contact(x)))]


# Slopes on both sides, by differences: of steps 2 t, t, t / 2 and t / 4, whose curvature is extrapolated away.


class Kink(NamedTuple):
    """The two slopes of an entry of x' or of y in a direction."""

    of: str
    along: str
    left: float
    right: float

    def __str__(self) -> str:
        return f"slope of {self.of} along {self.along} is {self.left:.4g} to the left and {self.right:.4g} to the right"


def _motion(plant: Plant, _: None, loaded: bool) -> tuple[list[Any], list[Any]]:
    """(x, y, v) -> x' under the currents of v for the reading y, and h(x)."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    x, y, v = (
        kind.sym(n, len(s)) for n, s in zip("xyv", (plant.states, plant.outputs, plant.inputs), strict=True)
    )
    w = plant.load(x) if loaded else kind.zeros(len(plant.disturbances))
    rate = plant.f(x, plant.actuator.forces(x, plant.actuator.currents(y, v)), w)
    return [ca.vertcat(x, y, v)], [ca.densify(ca.vertcat(rate, plant.h(x, kind.zeros(len(plant.inputs)))))]


def _points(plant: Plant, x: FloatArray) -> list[tuple[bool, Any]]:
    """The machine at rest at these states without its loads, and under them where something holds it."""
    found = []
    symbol = _symbols(plant)[0]
    for loaded in (False, True) if not ca.vertcat(plant.load(symbol)).is_zero() else (False,):
        try:
            point = (
                balance(plant, x) if loaded else with_command(plant, plant.point(x[list(plant.controlled)]))
            )
        except CheckError:
            continue
        found.append((loaded, point))
    return found


def _kink_rows(plant: Plant, x: FloatArray) -> list[Observation]:
    """A row for the first kink at rest."""
    for loaded, point in _points(plant, x):
        kink = _kink(plant, point, loaded)
        if kink is not None:
            where = (
                ", ".join(f"{s.name} = {v:g}" for s, v in zip(plant.states, x, strict=True) if v) or "rest"
            )
            return [
                Observation(
                    "f" if not loaded else "load",
                    f"a kink at {where}, {kink}",
                    "one slope there, or rest beside the switch",
                    True,
                )
            ]
    return []


def _kink(plant: Plant, point: Any, loaded: bool) -> Kink | None:
    """The largest kink at an operating point."""
    n = len(plant.states)
    steps = _steps(plant, point)
    moving = [k for k in range(len(steps)) if k >= n or k in plant.controlled]
    mixed = np.random.default_rng(0).choice([-1.0, 1.0], (3, len(steps))) * steps
    mixed[:, [k for k in range(n) if k not in plant.controlled]] = 0
    along = np.vstack([np.diag(steps)[moving], mixed])
    z = np.concatenate([point.x, _read(plant, point.x)[0], point.v])
    shifts = np.array([s * size for size in SIZES for s in (1.0, -1.0)])
    rows = np.vstack([z, *(z + shift * along for shift in shifts)])
    values = trace(_motion, plant, None, loaded).each(rows)[0].T
    if not np.isfinite(values).all():
        return None
    moved = (values[1:] - values[0]).reshape(len(SIZES), 2, len(along), -1)
    right, left = moved[:, 0] / np.reshape(SIZES, (-1, 1, 1)), -moved[:, 1] / np.reshape(SIZES, (-1, 1, 1))
    jump = right - left
    weights = np.array([1 / 3, -2.0, 8 / 3])  # of steps h, h / 2, h / 4: terms of h and h^2 are gone
    coarse, fine = (np.tensordot(weights, jump[k : k + 3], 1) for k in (0, 1))
    size = np.maximum(np.abs(right[-1]), np.abs(left[-1]))
    ratio = np.divide(fine, coarse, out=np.zeros_like(fine), where=coarse != 0)
    steep = [np.diff(side, axis=0) for side in (right, left)]  # of a jump or a root they grow as steps shrink
    grows = np.any(
        [(d[2] * d[1] > 0) & (d[1] * d[0] > 0) & (np.abs(d[2]) > np.abs(d[0])) for d in steep], axis=0
    )
    growth = np.maximum(np.abs(steep[0][2]), np.abs(steep[1][2])) * grows
    least = np.maximum(KINK * size, MIN_SHARE * size.max(axis=0))
    is_kink = (np.abs(fine) > least) & (ratio > 0.3) & (ratio < 3) | (growth > least)
    if not is_kink.any():
        return None
    sharp = np.where(is_kink, np.maximum(np.abs(fine), growth) / np.maximum(size, 1e-300), 0)
    sharp[len(moving) :] *= KINK**2  # one signal is named rather than several
    d, k = np.unravel_index(int(sharp.argmax()), fine.shape)
    names = [s.name for s in (*plant.states, *plant.outputs, *plant.inputs)]
    step = steps[moving[d]] if d < len(moving) else 1.0
    of = f"{names[k]}'" if k < n else names[k]
    return Kink(
        of,
        names[moving[d]] if d < len(moving) else "several states",
        float(left[-1][d, k] / step),
        float(right[-1][d, k] / step),
    )


def _steps(plant: Plant, point: Any) -> FloatArray:
    """The steps of states, readings and commands: what noise moves, or a little of the room."""
    noise = np.array(ca.DM(plant.sensors.deviations)).ravel()
    slopes = np.abs(_slopes(plant, point.x))
    x = ROOM_SHARE * _rooms(plant)
    if plant.second_order:
        shown = np.divide(noise[:, None], slopes, out=np.zeros_like(slopes), where=slopes > 0).max(
            axis=0, initial=0
        )
        half = len(x) // 2
        x[:half] = np.maximum(x[:half], NOISES * shown[:half])
        x[half:] = RATE * x[:half]
    y = np.maximum(NOISES * noise, slopes @ x)
    y = np.where(y > 0, y, ROOM_SHARE)
    return np.concatenate([x, y, ROOM_SHARE * np.maximum(_limits(plant), np.abs(point.v))])


def _slopes(plant: Plant, x: FloatArray) -> FloatArray:
    """dh/dx by differences."""
    step = ROOM_SHARE * _rooms(plant)
    both = _read(plant, *(x + np.diag(step)), *(x - np.diag(step)))
    return np.asarray((both[: len(x)] - both[len(x) :]).T / (2 * step))


def _switches(plant: Plant) -> list[str]:
    """Of each position with a clearance: the nearest place beside rest where a slope changes."""
    found = []
    zero = np.zeros(len(plant.states))
    points = _points(plant, zero)
    for k in plant.controlled[: plant.coordinates] if points else ():
        signal, ends = plant.states[k], [_clearance(plant, k, s) for s in (-1.0, 1.0)]
        if not (ends[0] < ends[1]):
            continue
        places = [at for end in ends for at in _switch_towards(plant, points[-1], k, end)]
        low, high = ends
        text = f"none from {low:.4g} to {high:.4g} {signal.unit}"
        if places:
            text = f"at {min(places, key=abs):.4g} {signal.unit}, {'at' if not min(places, key=abs) else 'beside'} rest"
        found.append(f"{signal.name}: {text}")
    return found


def _switch_towards(plant: Plant, at: tuple[bool, Any], k: int, end: float) -> list[float]:
    """The first place between rest and an end of a state where a slope changes, if any."""
    loaded, point = at
    call = trace(_motion, plant, None, loaded)

    def values(places: FloatArray) -> FloatArray:
        x = np.tile(point.x, (len(places), 1))
        x[:, k] = places
        return np.asarray(
            call.each(np.hstack([x, _read(plant, *x), np.tile(point.v, (len(places), 1))]))[0].T
        )

    own = np.concatenate([point.x, _read(plant, point.x)[0]])
    pushed = [
        np.concatenate([own, point.v + push]) for push in (0 * _limits(plant), *np.diag(_limits(plant)))
    ]
    made = call.each(np.array(pushed))[0].T
    least = KINK * np.abs(made[1:] - made[0]).max(axis=0) / abs(end)  # slopes that count beside the commands

    def bends(places: FloatArray) -> FloatArray:
        """How much slopes differ at each inner place, of the larger one."""
        slopes = np.diff(values(places), axis=0) / np.diff(places)[:, None]
        size = np.maximum(np.maximum(np.abs(slopes[1:]), np.abs(slopes[:-1])), least)
        return np.asarray((np.abs(np.diff(slopes, axis=0)) / np.maximum(size, 1e-300)).max(axis=1))

    h = end / PLACES
    grid = np.arange(1, PLACES) * h
    with np.errstate(all="ignore"):
        found = np.nan_to_num(bends(np.r_[0.0, grid, end]))
        for place in grid[found > KINK][:8]:
            width, seen = h, []
            for _ in range(HALVINGS):
                near = place + np.arange(-4, 5) * width / 4
                bend = np.nan_to_num(bends(near))
                place, width = near[1:-1][int(bend.argmax())], width / 2
                seen.append(bend.max())
            if (
                min(seen[-4:]) > 10 * KINK and 0.5 < seen[-1] / seen[-4] < 2
            ):  # curvature falls, rounding grows
                return [float(place)]
    return []


def _uncontrolled_rows(plant: Plant, x: FloatArray) -> list[Observation]:
    """States that were left out, that the motion or an input reaches, and that act back on the motion."""
    keep = list(plant.controlled)
    out = [k for k in range(len(plant.states)) if k not in keep]
    for loaded, point in _points(plant, x) if out else ():
        A, B, *_ = trace(_derivatives, plant, None, loaded)(point.x, point.u, point.v)
        size = np.abs(A) > ROUNDING * np.sqrt(np.abs(A).max(axis=0) * np.abs(A).max(axis=1)[:, None])
        reached = size[np.ix_(out, keep)].any(axis=1) | (np.abs(B[out]) > ROUNDING * np.abs(B).max()).any(
            axis=1
        )
        for _ in out:
            reached = reached | (size[np.ix_(out, out)] & reached).any(axis=1)
        back = size[np.ix_(keep, out)].any(axis=0) & reached
        if back.any():
            name = plant.states[out[int(back.argmax())]].name
            return [
                Observation(
                    "uncontrolled",
                    f"{name} is moved by what is controlled and acts back on it",
                    f"{name} among the controlled states",
                    True,
                )
            ]
    return []


def _inverse_rows(plant: Plant) -> list[Observation]:
    """Currents that do not make the forces that are commanded."""
    if plant.actuator.tabulated:
        return []
    check = plant.check()
    worst = max(check.mismatches, key=lambda m: m.share)
    if check.exact:
        return []
    words = f"not the inverse of `forces` along {worst.state.name}, by {100 * worst.share:.3g} % of the limit"
    return [Observation("actuator.currents", words, "right where that is meant; `Plant.check` says where")]


def _unit_rows(plant: Plant) -> list[Observation]:
    """Units that malta does not know, and rates whose unit is not that of their position per second."""
    groups = {
        "states": plant.states,
        "inputs": plant.inputs,
        "outputs": plant.outputs,
        "disturbances": plant.disturbances,
    }
    strange = {
        s.unit: (group, s.name) for group, of in groups.items() for s in of if not is_unit_of(s.unit, s.unit)
    }
    found = [
        Observation(group, f"malta does not know the unit {unit!r} of {name}", "a unit as N m or rad/s")
        for unit, (group, name) in strange.items()
    ]
    if plant.second_order:
        half = len(plant.states) // 2
        for q, rate in zip(plant.states[:half], plant.states[half:], strict=True):
            if q.unit != "1" and not is_unit_of(rate.unit, f"{q.unit}/s"):
                found.append(
                    Observation(
                        "states",
                        f"{rate.name} in {rate.unit}, the rate of {q.name} in {q.unit}",
                        f"{q.unit}/s",
                    )
                )
    if has_feedthrough(plant):
        return found
    slopes = _slopes(plant, plant.at().x)
    for y, row in zip(plant.outputs, slopes, strict=True):
        only = np.flatnonzero(np.abs(row) > ROUNDING)
        if len(only) == 1 and abs(abs(row[only[0]]) - 1) < ROUNDING and y.unit != plant.states[only[0]].unit:
            s = plant.states[only[0]]
            found.append(
                Observation(
                    "outputs",
                    f"{y.name} in {y.unit} shows {s.name} in {s.unit} one to one",
                    "one of the two units",
                )
            )
    return found


def _idle_rows(plant: Plant) -> list[Observation]:
    """Arguments and parameters on which nothing of the machine depends."""
    found, own = list[Observation](), units_of(plant.parameters)
    known = plant.actuator.electronics is None  # which may use any, in functions that only simulations call
    before = _fingerprint(plant) if known else ()
    for field in fields(plant.parameters) if known else ():
        if field.name not in own:
            continue
        value = getattr(plant.parameters, field.name)
        for other in (value * (1 + 1e-3) or 1e-3, value * (1 - 1e-3) or -1e-3):
            try:
                after = _fingerprint(plant.variant(replace(plant.parameters, **{field.name: other})))
            except (InputError, CheckError):
                continue
            if after == before:
                found.append(
                    Observation(
                        "parameters",
                        f"{field.name} changes nothing of the machine",
                        "leave it out, or let it act",
                    )
                )
            break
    return found + _idle_arguments(plant)


def _idle_arguments(plant: Plant) -> list[Observation]:
    """Inputs, disturbances, coils and states of which nothing depends."""
    x, u, w, i = _symbols(plant)
    rate = ca.vertcat(plant.f(x, u, w))
    y = plant.h(x, u)
    made, touched = plant.actuator.forces(x, i), ca.vertcat(plant.contacts.contact(x))
    asked: tuple[tuple[str, tuple[Signal, ...], Any, tuple[Any, ...]], ...] = (
        ("states", plant.states, x, (rate, y, touched, plant.load(x), made)),
        ("inputs", plant.inputs, u, (rate, y)),
        ("disturbances", plant.disturbances, w, (rate,)),
        ("actuator.coils", plant.actuator.coils, i, (made,)),
    )
    found = []
    for part, signals, symbol, outputs in asked:
        acts = np.array([s.name in plant.uncontrolled for s in signals])
        for one in outputs:
            if ca.vertcat(one).numel() and isinstance(one, ca.SX | ca.MX):
                acts |= np.array(ca.which_depends(ca.vertcat(one), symbol, 1, False), dtype=bool)
        found += [
            Observation(part, f"nothing depends on {s.name}", "leave it out, or let it act")
            for s, acting in zip(signals, acts, strict=True)
            if not acting
        ]
    return found


def _symbols(plant: Plant) -> list[Any]:
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    sizes = (len(plant.states), len(plant.inputs), len(plant.disturbances), len(plant.actuator.coils))
    return [kind.sym(name, size) for name, size in zip("xuwi", sizes, strict=True)]


def _fingerprint(plant: Plant) -> tuple[Any, ...]:
    """The values of a plant's functions at a place beside rest, and its numbers."""
    x, u, w, i = (np.cos(np.arange(1, s.numel() + 1)) for s in _symbols(plant))
    a, numbers = plant.actuator, list[Any]()
    v, u, w, i = (ca.DM(one) for one in (u * _limits(plant), u, w, i))
    for share in (0.1, 1.5):  # beside rest, and beyond a contact
        at = ca.DM(share * x * _rooms(plant))
        y = plant.h(at, u)
        made = [plant.f(at, v, w), y, plant.load(at), a.currents(y, v), a.forces(at, i), plant.preload(at)]
        made += [plant.contacts.contact(at), plant.contacts.bearing(at), plant.position_of(y)]
        numbers += [tuple(np.array(ca.DM(one), dtype=float).ravel().tolist()) for one in made]
    groups = (a, plant.sensors, plant.stroke, *((a.windings,) if a.windings is not None else ()))
    for group in groups:
        numbers += [
            repr(getattr(group, f.name)) for f in fields(group) if not callable(getattr(group, f.name))
        ]
    return (*numbers, plant.inertia, plant.over)
