"""What a machine declares, looked at: `malta inspect`."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.model.currents import _clearance, _limits
from malta.model.parameters import units_of
from malta.model.plant import Plant, given_plant, has_feedthrough
from malta.model.readings import Observation, read_outputs, rooms_of, sensor_rows, symbols_of
from malta.model.soundness import (
    KINK,
    ROUNDING,
    kink_rows,
    motion_of,
    output_slopes,
    rests_of,
    uncontrolled_rows,
)
from malta.model.traced import trace
from malta.units import is_unit_of

PLACES, HALVINGS = 64, 12  # cells from rest to each end of a state, and how often one of them is halved


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
    plant = given_plant("inspect", plant)
    rows = [*sensor_rows(plant), *kink_rows(plant, plant.at().x), *uncontrolled_rows(plant, plant.at().x)]
    rows += [*_inverse_rows(plant), *_unit_rows(plant), *_idle_rows(plant)]
    return Inspection(plant.name, tuple(rows), tuple(_switches(plant)))


def _switches(plant: Plant) -> list[str]:
    """Of each position with a clearance: the nearest place beside rest where a slope changes."""
    found = []
    zero = np.zeros(len(plant.states))
    points = rests_of(plant, zero)
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
    call = trace(motion_of, plant, None, loaded)

    def values(places: FloatArray) -> FloatArray:
        x = np.tile(point.x, (len(places), 1))
        x[:, k] = places
        v = np.tile(point.v, (len(places), 1))
        return np.asarray(call.each(np.hstack([x, read_outputs(plant, *x), v]))[0].T)

    own, limits = np.concatenate([point.x, read_outputs(plant, point.x)[0]]), _limits(plant)
    pushed = np.array([np.concatenate([own, point.v + push]) for push in (0 * limits, *np.diag(limits))])
    made = call.each(pushed)[0].T
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
            stays = 0.5 < seen[-1] / seen[-4] < 2  # where curvature falls and rounding grows
            if min(seen[-4:]) > 10 * KINK and stays:
                return [float(place)]
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
    """Units that malta does not know, those of rates beside their positions, and of outputs beside their states."""
    groups = {name: getattr(plant, name) for name in ("states", "inputs", "outputs", "disturbances")}
    strange = {
        s.unit: (group, s) for group, of in groups.items() for s in of if not is_unit_of(s.unit, s.unit)
    }
    found = [
        Observation(group, f"{s.name} is in {unit!r}, which malta does not know", "a unit as N m or rad/s")
        for unit, (group, s) in strange.items()
    ]
    half = len(plant.states) // 2 if plant.second_order else 0
    for q, rate in zip(plant.states[:half], plant.states[half:], strict=False):
        if q.unit not in ("1", *strange) and not is_unit_of(rate.unit, f"{q.unit}/s"):
            of = f"{rate.name} in {rate.unit}, the rate of {q.name} in {q.unit}"
            found.append(Observation("states", of, f"{q.unit}/s"))
    slopes: Any = [] if has_feedthrough(plant) else np.abs(output_slopes(plant, plant.at().x))
    for y, row in zip(plant.outputs, slopes, strict=False):
        s = plant.states[int(np.argmax(row))]
        if abs(row.max() - 1) < ROUNDING and (row > ROUNDING).sum() == 1 and y.unit != s.unit:
            of = f"{y.name} in {y.unit} shows {s.name} in {s.unit} one to one"
            found.append(Observation("outputs", of, "one of the two units"))
    return found


def _idle_rows(plant: Plant) -> list[Observation]:
    """Arguments and parameters on which nothing of the machine depends."""
    idle = [("parameters", f"{name} changes nothing of the machine") for name in _idle_parameters(plant)]
    x, u, w, i = symbols_of(plant)
    rate, y, forces = plant.f(x, u, w), plant.h(x, u), plant.actuator.forces(x, i)
    asked: tuple[tuple[str, Any, Any, tuple[Any, ...]], ...] = (
        ("states", plant.states, x, (rate, y, plant.contacts.contact(x), plant.load(x), forces)),
        ("inputs", plant.inputs, u, (rate, y)),
        ("disturbances", plant.disturbances, w, (rate,)),
        ("actuator.coils", plant.actuator.coils, i, (forces,)),
    )
    for part, signals, symbol, outputs in asked:
        whole = type(symbol)(ca.vertcat(*outputs))
        acts = ca.which_depends(whole, symbol, 1, False) if len(signals) else []
        pairs = zip([s.name for s in signals], acts, strict=True)
        unused = [name for name, does in pairs if not (does or name in plant.uncontrolled)]
        idle += [(part, f"nothing depends on {name}") for name in unused]
    return [Observation(part, found, "leave it out, or let it act") for part, found in idle]


def _idle_parameters(plant: Plant) -> list[str]:
    """The parameters that change none of the machine's functions and numbers."""
    if plant.actuator.electronics is not None:  # which may use any, in functions that only simulations call
        return []
    before, found = _fingerprint(plant), list[str]()
    for name in units_of(plant.parameters):
        value = getattr(plant.parameters, name)
        for other in (value * (1 + 1e-3) or 1e-3, value * (1 - 1e-3) or -1e-3):
            try:
                after = _fingerprint(plant.variant(replace(plant.parameters, **{name: other})))
            except (InputError, CheckError):
                continue
            found += [name] if after == before else []
            break
    return found


def _fingerprint(plant: Plant) -> tuple[Any, ...]:
    """The values of a plant's functions at a place beside rest, and its numbers."""
    x, u, w, i = (np.cos(np.arange(1, s.numel() + 1)) for s in symbols_of(plant))
    a, numbers = plant.actuator, list[Any]()
    v, u, w, i = (ca.DM(one) for one in (u * _limits(plant), u, w, i))
    for share in (0.1, 1.5):  # beside rest, and beyond a contact
        at = ca.DM(share * x * rooms_of(plant))
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
