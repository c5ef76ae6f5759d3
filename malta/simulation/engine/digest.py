"""Digests: figures of a run that are updated at every sample, and the batch that is made of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray, readonly
from malta.display import Description, display
from malta.model.plant import Plant
from malta.simulation.divergence import free_outputs, strokes, used_rooms
from malta.simulation.layout import flatten, layout_of, numbers_of
from malta.simulation.readings import NOISE_SAMPLES_AT_ONCE

LEVELS = (0.1, 0.9)  # shares of a stroke between which its rise is measured
MAX_FIGURE = 1e30  # of a run that was completed, SI


@display
@dataclass(frozen=True, eq=False)
class Batch:
    """Figures of each run of a batch, a row for each. SI.

    duration : s, until the end or the first contact; below 0 for a run that ended while it settled
    completed : 1 or 0
    deviation : runs x outputs, largest `|p - p*|`
    rms : runs x outputs, root mean square of p - p*
    force : runs x inputs, N, largest `|v|`
    contact : runs x contacts, largest share of each clearance; 1: touch
    rise : s, 10-90 % of the stroke; NaN when it was not reached
    overshoot : beyond the end, as a share of the stroke; NaN when the run ended early
    saturated : runs x inputs, share of the samples whose command was limited
    verdict : index into the plant's verdicts; 0: completed
    last : runs x outputs, p - p* at the last sample, or before the first contact

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> hold = malta.Scenario("hold", 5e-3, malta.references.hold, start={"x": 20e-6})
    >>> masses = {"m": [0.3, 0.4]}
    >>> batch = malta.simulation.simulate_many(plant, controller, hold, masses, workers=1)
    >>> batch.completed.tolist(), batch.deviation.shape, batch.force.shape
    ([1.0, 1.0], (2, 5), (2, 5))
    """

    duration: FloatArray
    completed: FloatArray
    deviation: FloatArray
    rms: FloatArray
    force: FloatArray
    contact: FloatArray
    rise: FloatArray
    overshoot: FloatArray
    saturated: FloatArray
    verdict: FloatArray
    last: FloatArray

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            object.__setattr__(self, name, readonly(getattr(self, name)))

    @property
    def description(self) -> Description:
        """The ends of its runs, and their largest figures."""
        ranges = {name: np.asarray(getattr(self, name)) for name in ("deviation", "rms", "force", "contact")}
        rows = [("completed", f"{int(self.completed.sum())} of {len(self.completed)} runs")]
        for name, values in ranges.items():
            if values.size:
                rows.append((f"largest {name}", " ".join(f"{x:.3g}" for x in values.max(axis=0))))
        return Description(f"Batch of {len(self.completed)} runs, SI", tuple(rows))


def verdicts(plant: Plant) -> tuple[str, ...]:
    """Names of the verdicts that a run may end with; the first is that of success."""
    return ("completed", "diverged", "not lifted", *plant.contacts.names)


def digest_sizes(plant: Plant) -> dict[str, int]:
    """Names and sizes of the numbers of a digest, in order."""
    p, m = len(plant.outputs), len(plant.inputs)
    return {
        "alive": 1,
        "start": 1,  # of the stroke: constant
        "scale": 1,  # 1 / length of the stroke, or 0: constant
        "rooms": len(free_outputs(plant)) + strokes(plant),  # 1 / what ends the run as diverged: constant
        "samples": 1,
        "reached": len(LEVELS),  # sample at which each level was reached, -1 before
        "below": len(LEVELS),  # share of the stroke one sample before
        "above": len(LEVELS),  # share of the stroke at that sample
        "share": 1,
        "largest_share": 1,
        "deviation": p,
        "squares": p,
        "force": m,
        "limited": m,
        "contact": len(plant.contacts.names),
        "resting": 1,  # 1 where the mover rests on its touchdown bearings at the start
        "touching": 1,  # 1 where it touches them at the end
        "touched": 1,  # sample at which it first touched them, -1 before
        "culprit": 1,  # index of the first contact, -1 before
        "last": p,
    }


def first_digest(plant: Plant, p_ref: FloatArray, rooms: FloatArray) -> FloatArray:
    """The digest before the first sample of a reference p_ref, k x p; the stroke is that of the leading output.

    rooms : from `rooms_of`
    """
    start, end = p_ref[0, plant.leading_output], p_ref[-1, plant.leading_output]
    scale = 1 / (end - start) if end != start else 0
    known = {"alive": 1.0, "start": start, "scale": scale, "reached": -1.0, "touched": -1.0, "culprit": -1.0}
    parts = [
        np.full(size, known.get(name, 0.0)) for name, size in digest_sizes(plant).items() if name != "rooms"
    ]
    return np.concatenate([*parts[:3], rooms, *parts[3:]])


def restart(digests: FloatArray, first: FloatArray, sizes: Mapping[str, int]) -> None:
    """Begin the figures of runs anew at t = 0, after they have settled, in place: groups x numbers x LANES.

    Runs that ended before keep theirs; samples are counted on.

    first : from `first_digest`
    """
    rows = dict(zip(sizes, np.split(np.arange(len(first)), np.cumsum([*sizes.values()])[:-1]), strict=True))
    lasting = ("alive", "samples", "resting", "touching", "touched", "culprit")
    anew = np.concatenate([rows[name] for name in sizes if name not in lasting])
    flying = digests[:, rows["alive"]] == 1
    digests[:, anew] = np.where(flying, first[anew, None], digests[:, anew])


@lru_cache(maxsize=16)
def digest_function(shape: Any) -> ca.Function:
    """(digest, row, given, theta) -> digest after one more sample. The first contact ends its updates."""
    kept, row, given, arguments = _symbols(shape)
    after = _digest(shape, kept, row, given, lambda now, before: ca.if_else(kept["alive"], now, before))
    left, used = (
        used_rooms(shape.plant, row["p"], given["p_ref"], kept["rooms"]),
        _largest_share(row["contact"]),
    )
    most = _largest_share(ca.vertcat(ca.fmax(kept["contact"], row["contact"]), left))
    alive = kept["alive"]  # 0 after the first contact: nothing else changes then
    after |= {
        "alive": ca.logic_and(alive, most < 1),
        "samples": kept["samples"] + alive,
        "culprit": ca.if_else(
            ca.logic_and(ca.logic_and(alive, kept["culprit"] < 0), used >= 1),
            _index_of_largest(row["contact"]) if shape.plant.contacts.names else -1,
            kept["culprit"],
        ),
    }
    if shape.setup.bearing:
        touching = used >= 1
        ends = [row["contact"][i] for i, held in enumerate(shape.plant.contacts.cushioned) if not held]
        after["alive"] = ca.logic_and(alive, _largest_share(ca.vertcat(*ends, left)) < 1)
        first = kept["samples"] == 0
        after["resting"] = ca.if_else(first, touching, kept["resting"])
        after["touching"] = ca.if_else(alive, touching, kept["touching"])
        now = ca.logic_and(touching, kept["touched"] < 0)
        after["touched"] = ca.if_else(now, kept["samples"], kept["touched"])
    result = ca.vertcat(*(after.get(name, kept[name]) for name in kept))
    return ca.Function("digest", arguments, [ca.densify(result)])


@lru_cache(maxsize=16)
def cruise_functions(shape: Any) -> tuple[ca.Function, ...]:
    """Whether nothing happens in a sample, and the update of the digest if so: the same as that of digest_function.

    Nothing happens: the run flies without contact, no command is limited and no level of the stroke is reached.
    Empty for a setup with touchdown bearings, whose digests change at contacts too.
    """
    if shape.setup.bearing:
        return ()
    kept, row, given, arguments = _symbols(shape)
    after = _digest(shape, kept, row, given, lambda now, _: now) | {"samples": kept["samples"] + 1}
    reached = ca.logic_and(kept["reached"] < 0, after["share"] >= ca.DM(LEVELS))
    events = ca.mmax(ca.vertcat(row["saturated"], reached))
    left = used_rooms(shape.plant, row["p"], given["p_ref"], kept["rooms"])
    near = _largest_share(ca.vertcat(row["contact"], left))
    premise = ca.logic_and(ca.logic_and(kept["alive"], near < 1), events <= 0)
    idle = ("limited", "reached", "below", "above")
    result = ca.vertcat(*(kept[name] if name in idle else after.get(name, kept[name]) for name in kept))
    return (
        ca.Function("cruises", arguments, [premise]),
        ca.Function("cruise", arguments, [ca.densify(result)]),
    )


def _symbols(shape: Any) -> tuple[Any, ...]:
    """Symbols of the digest, the row and the sample's inputs by name, and the arguments of a digest's function."""
    plant, c, setup = shape.plant, shape.controller, shape.setup
    sizes = layout_of(plant, c, setup)
    parts = [
        {name: ca.SX.sym(name, size) for name, size in part.items()}
        for part in (digest_sizes(plant), sizes.row, sizes.given)
    ]
    theta = ca.SX.sym("theta", len(flatten(numbers_of(plant, c, 1))))
    return *parts, [*(ca.vertcat(*part.values()) for part in parts), theta]


def _digest(shape: Any, kept: Any, row: Any, given: Any, alive: Callable[[Any, Any], Any]) -> dict[str, Any]:
    """What a sample changes in the digest of a run that flies.

    alive : (value after the sample, another) -> the first where no contact ended the run
    """
    error = alive(row["p"] - given["p_ref"], 0)
    share = (row["p"][shape.plant.leading_output] - kept["start"]) * kept["scale"]
    now = ca.logic_and(alive(kept["reached"] < 0, 0), share >= ca.DM(LEVELS))
    return {
        "reached": ca.if_else(now, kept["samples"], kept["reached"]),
        "below": ca.if_else(now, kept["share"], kept["below"]),
        "above": ca.if_else(now, share, kept["above"]),
        "share": share,
        "largest_share": alive(ca.fmax(kept["largest_share"], share), kept["largest_share"]),
        "deviation": ca.fmax(kept["deviation"], ca.fabs(error)),
        "squares": kept["squares"] + error**2,
        "last": alive(error, kept["last"]),
        "force": ca.fmax(kept["force"], alive(ca.fabs(row["v"]), 0)),
        "limited": kept["limited"] + alive(row["saturated"], 0),
        "contact": alive(ca.fmax(kept["contact"], row["contact"]), kept["contact"]),
    }


@lru_cache(maxsize=16)
def recorder_function(shape: Any) -> ca.Function:
    """A digest that consists of the last rows: as many as the engine draws noise for at once."""
    sizes = layout_of(shape.plant, shape.controller, shape.setup)
    width, given = sum(sizes.row.values()), sum(sizes.given.values())
    kept, row = ca.SX.sym("kept", NOISE_SAMPLES_AT_ONCE * width), ca.SX.sym("row", width)
    theta = ca.SX.sym("theta", len(flatten(numbers_of(shape.plant, shape.controller, 1))))
    arguments = [kept, row, ca.SX.sym("given", given), theta]
    return ca.Function("digest", arguments, [ca.vertcat(kept[width:], row)])


def batch_of(kept: FloatArray, samples: int, Ts: float, sizes: Mapping[str, int], settled: int = 0) -> Batch:
    """The batch of digests after the last sample, runs x numbers.

    samples, settled : of each run, and those of them before t = 0
    """
    columns = dict(zip(sizes, np.split(kept, np.cumsum([*sizes.values()])[:-1], axis=1), strict=True))
    count = columns["samples"][:, 0]
    resting, touching, touched = (columns[name][:, 0] for name in ("resting", "touching", "touched"))
    held = np.where(resting == 1, touching == 0, touched < 0)
    completed = (columns["alive"][:, 0] == 1) & np.isfinite(kept).all(axis=1) & (count == samples) & held
    flown = np.maximum(np.where(count > settled, count - settled, count), 1)[:, None]
    end = np.where((count == samples) & (resting == 0) & (touched >= 0), touched, np.maximum(count - 1, 0))
    reached, below, above = (columns[name] for name in ("reached", "below", "above"))
    with np.errstate(divide="ignore", invalid="ignore"):
        first, last = np.where(
            reached > 0, reached - 1 + (np.array(LEVELS) - below) / (above - below), np.nan
        ).T
    # "share" also changes after the end, so it says nothing about divergence.
    told = np.hstack([columns[name] for name in ("deviation", "squares", "contact")])
    verdict = np.select(
        [completed, ~np.isfinite(told).all(axis=1), resting == 1, columns["culprit"][:, 0] >= 0],
        [0, 1, 2, 3 + columns["culprit"][:, 0]],
        1,
    )
    return Batch(
        duration=(np.where(completed, samples, end) - settled) * Ts,
        completed=completed,
        deviation=columns["deviation"],
        rms=np.sqrt(columns["squares"] / flown),
        force=columns["force"],
        contact=columns["contact"],
        rise=np.where(completed, (last - first) * Ts, np.nan),
        overshoot=np.where(
            completed & (columns["scale"][:, 0] != 0),
            np.maximum(columns["largest_share"][:, 0] - 1, 0),
            np.nan,
        ),
        saturated=columns["limited"] / flown,
        verdict=verdict,
        last=columns["last"],
    )


def _largest_share(contact: Any) -> Any:
    """The largest share of a clearance that is taken; 0 for a machine without contacts."""
    return ca.mmax(contact) if contact.numel() else ca.SX(0)


def _index_of_largest(values: Any) -> Any:
    """Index of the largest entry; of equal ones the first."""
    found, index = values[0], ca.SX(0)
    for k in range(1, values.numel()):
        index = ca.if_else(values[k] > found, k, index)
        found = ca.fmax(found, values[k])
    return index
