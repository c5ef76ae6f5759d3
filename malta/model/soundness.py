"""Why a linear model is not the machine's: readings, slopes that differ on both sides, states that were left out.

A linear loop is that of the machine where x' = f(x, forces(x, currents(y, v)), load(x)) and y = h(x) have one slope at
rest. It is another machine's where the slopes of both sides differ, where y has a part of u, where h(0) is not 0, and
where states that were left out as `uncontrolled` close a loop with the motion.

Slopes are those of steps 2 t, t, t / 2 and t / 4 to each side, whose curvature is extrapolated away.
"""

from __future__ import annotations

from contextlib import suppress
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError
from malta.model.currents import _limits
from malta.model.equilibrium import balance, with_command
from malta.model.linearize import _derivatives
from malta.model.plant import Plant
from malta.model.readings import MIN_SHARE, RATE, Observation, read_outputs, rooms_of, sensor_rows, symbols_of
from malta.model.traced import trace

KINK = 1e-3  # of a slope, by which those of both sides differ
SIZES = np.reshape((2.0, 1.0, 0.5, 0.25), (-1, 1, 1))  # of the steps to each side
NOISES, ROOM_SHARE = 3.0, 1e-5  # steps: of the noise of a reading, of the room to the first contact
ROUNDING = 1e-9
CLOSE_STEPS = 0.25 * (1 + 0.01 * np.arange(8))  # their third differences are rounding
ROUNDING_SHARE = 12.0  # a slope's error by rounding, in third differences of values
MAX_LENGTHENINGS = 4  # of a step that rounding loses, each to ten times


@lru_cache(maxsize=64)  # plants compare by identity
def unproven(plant: Plant, at: tuple[float, ...]) -> str:
    """Why nothing is proven of a plant's linear model at the states `at`, in a sentence; "": it is the machine's."""
    x = np.array(at)
    with np.errstate(all="ignore"):  # of parameters beyond what can be computed, which linearization says
        rows = (*sensor_rows(plant), *kink_rows(plant, x), *uncontrolled_rows(plant, x))
    return next((str(row) for row in rows if row.unproven), "")


def motion_of(plant: Plant, _: None, loaded: bool) -> tuple[list[Any], list[Any]]:
    """(x, y, v) -> x' under the currents of v for the reading y, and h(x)."""
    kind = ca.MX if plant.actuator.tabulated else ca.SX
    x, y, v = (
        kind.sym(n, len(s)) for n, s in zip("xyv", (plant.states, plant.outputs, plant.inputs), strict=True)
    )
    w = plant.load(x) if loaded else kind.zeros(len(plant.disturbances))
    rate = plant.f(x, plant.actuator.forces(x, plant.actuator.currents(y, v)), w)
    return [ca.vertcat(x, y, v)], [ca.densify(ca.vertcat(rate, plant.h(x, kind.zeros(len(plant.inputs)))))]


def rests_of(plant: Plant, x: FloatArray) -> list[tuple[bool, Any]]:
    """The machine at rest at these states without its loads, and under them where something holds it."""
    found: list[tuple[bool, Any]] = []
    with suppress(CheckError):
        found.append((False, with_command(plant, plant.point(x[list(plant.controlled)]))))
    with suppress(CheckError):
        if not ca.vertcat(plant.load(symbols_of(plant)[0])).is_zero():
            found.append((True, balance(plant, x)))
    return found


def kink_rows(plant: Plant, x: FloatArray) -> list[Observation]:
    """The first kink at rest."""
    for loaded, point in rests_of(plant, x):
        kink = _kink(plant, point, loaded)
        if kink:
            at = ", ".join(f"{s.name} = {v:g}" for s, v in zip(plant.states, x, strict=True) if v) or "rest"
            found = f"a kink at {at}, slope of {kink}"
            part = "load" if loaded else "f" if "'" in kink.partition(" ")[0] else "h"
            return [Observation(part, found, "one slope there, or rest beside the switch", True)]
    return []


def _kink(plant: Plant, point: Any, loaded: bool) -> str:
    """The largest kink at an operating point, in words; "": none."""
    n = len(plant.states)
    steps = _steps(plant, point)
    moving = [k for k in range(len(steps)) if k >= n or k in plant.controlled]
    mixed = np.random.default_rng(0).choice([-1.0, 1.0], (3, len(steps))) * steps
    mixed[:, [k for k in range(n) if k not in plant.controlled]] = 0
    along = np.vstack([np.diag(steps)[moving], mixed])
    z = np.concatenate([point.x, read_outputs(plant, point.x)[0], point.v])
    sides, found, lost = _kinks(plant, loaded, z, along)
    for _ in range(MAX_LENGTHENINGS):  # steps that rounding loses, as one of 1e-8 Pa beside 1e5 Pa
        if not lost.any():
            break
        along[lost] *= 10
        sides, found, lost = _kinks(plant, loaded, z, along)
    if not found.any():
        return ""
    found[len(moving) :] *= KINK**2  # one signal is named rather than several
    d, k = np.unravel_index(int(found.argmax()), found.shape)
    names = [s.name for s in (*plant.states, *plant.outputs, *plant.inputs)]
    single = d < len(moving)
    slopes = (side[d, k] / (along[d, moving[d]] if single else 1.0) for side in sides)
    of = f"{names[k]}'" if k < n else names[k]
    words = (of, names[moving[d]] if single else "several signals", *slopes)
    return "{} along {} is {:.4g} to the left and {:.4g} to the right".format(*words)


def _kinks(plant: Plant, loaded: bool, z: FloatArray, along: FloatArray) -> tuple[Any, FloatArray, Any]:
    """Slopes to the left and right along some steps, the share by which they differ, and the steps that are lost.

    The shares are 0 where there is no kink. A step is lost where rounding hides or makes a kink: third differences of
    points that are close to each other show it.
    """
    shifts = np.concatenate([np.outer(SIZES, (1.0, -1.0)).ravel(), CLOSE_STEPS])
    rows = np.vstack([z, *(z + shift * along for shift in shifts)])
    values = trace(motion_of, plant, None, loaded).each(rows)[0].T
    moved = (values[1:] - values[0]).reshape(len(shifts), len(along), -1)
    if not np.isfinite(values).all():
        return (moved[0], moved[0]), np.zeros_like(moved[0]), np.zeros(len(along), bool)
    both = moved[: -len(CLOSE_STEPS)].reshape(len(SIZES), 2, *moved.shape[1:])
    right, left = both[:, 0] / SIZES, -both[:, 1] / SIZES
    jump = right - left
    weights = np.array([1 / 3, -2.0, 8 / 3])  # of steps h, h / 2, h / 4: terms of h and h^2 are gone
    coarse, fine = (np.tensordot(weights, jump[k : k + 3], 1) for k in (0, 1))
    size = np.maximum(np.abs(right[-1]), np.abs(left[-1]))
    ratio = np.divide(fine, coarse, out=np.zeros_like(fine), where=coarse != 0)
    steep = [np.diff(side, axis=0) for side in (right, left)]  # of a jump or a root they grow as steps shrink
    grows = [(d[2] * d[1] > 0) & (d[1] * d[0] > 0) & (np.abs(d[2]) > np.abs(d[0])) for d in steep]
    growth = np.max([np.abs(d[2]) * is_growing for d, is_growing in zip(steep, grows, strict=True)], axis=0)
    least = np.maximum(KINK * size, MIN_SHARE * size.max(axis=0))
    is_kink = (np.abs(fine) > least) & (ratio > 0.3) & (ratio < 3) | (growth > least)
    rounding = ROUNDING_SHARE * np.abs(np.diff(moved[-len(CLOSE_STEPS) :], 3, axis=0)).max(axis=0)
    share = np.where(is_kink, np.maximum(np.abs(fine), growth) / np.maximum(size, 1e-300), 0)
    return (left[-1], right[-1]), share, (rounding > least).any(axis=1)


def _steps(plant: Plant, point: Any) -> FloatArray:
    """The steps of states, readings and commands: what noise moves, or a little of the room."""
    noise = np.array(ca.DM(plant.sensors.deviations)).ravel()
    slopes = np.abs(output_slopes(plant, point.x))
    x = ROOM_SHARE * rooms_of(plant)
    if plant.second_order:
        half, seen = len(x) // 2, slopes > 0
        shown = np.divide(noise[:, None], slopes, out=np.zeros_like(slopes), where=seen).max(
            axis=0, initial=0
        )
        x[:half] = np.maximum(x[:half], NOISES * shown[:half])
        x[half:] = RATE * x[:half]
    y = np.maximum(NOISES * noise, slopes @ x)
    y = np.where(y > 0, y, ROOM_SHARE)
    return np.concatenate([x, y, ROOM_SHARE * np.maximum(_limits(plant), np.abs(point.v))])


def output_slopes(plant: Plant, x: FloatArray) -> FloatArray:
    """dh/dx by differences."""
    step = ROOM_SHARE * rooms_of(plant)
    both = read_outputs(plant, *(x + np.diag(step)), *(x - np.diag(step)))
    return np.asarray((both[: len(x)] - both[len(x) :]).T / (2 * step))


def uncontrolled_rows(plant: Plant, x: FloatArray) -> list[Observation]:
    """States that were left out, that the motion or an input reaches, and that act back on the motion."""
    keep = list(plant.controlled)
    out = [k for k in range(len(plant.states)) if k not in keep]
    for loaded, point in rests_of(plant, x) if out else ():
        A, B, *_ = trace(_derivatives, plant, None, loaded)(point.x, point.u, point.v)
        acts = np.abs(A) > ROUNDING * np.sqrt(np.abs(A).max(axis=0) * np.abs(A).max(axis=1)[:, None])
        pushed = (np.abs(B[out]) > ROUNDING * np.abs(B).max()).any(axis=1)
        reached = acts[np.ix_(out, keep)].any(axis=1) | pushed
        for _ in out:
            reached = reached | (acts[np.ix_(out, out)] & reached).any(axis=1)
        back = acts[np.ix_(keep, out)].any(axis=0) & reached
        if back.any():
            name = plant.states[out[int(back.argmax())]].name
            found = f"{name} is moved by what is controlled and acts back on it"
            return [Observation("uncontrolled", found, f"{name} among the controlled states", True)]
    return []
