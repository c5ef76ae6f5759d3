"""Root locus of any loop: the closed-loop poles over a parameter of the machine, or over a factor of the loop gain.

Every sample is a set of eigenvalues. From sample to sample each pole goes to the one that the motion so far leads to,
with the least sum of distances (assignment): conjugates stay conjugate, and pairs meet and part on the real axis. An
interval in which a pole moves far is halved. The values at which the loop becomes stable or unstable are found by
bisection.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from scipy import optimize

from malta.arrays import ComplexArray, FloatArray
from malta.errors import CheckError, InputError, require_known
from malta.linear.matrices import eigenvalues
from malta.loops.linear_loops import LinearLoop, Place, linear_loop
from malta.model.parameters import units_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller

Indices = np.ndarray[tuple[int], np.dtype[np.intp]]

GAIN = "gain"  # the name of the factor of the loop gain
SAMPLES = 41
MAX_SAMPLES = 121  # samples with those of halved intervals
MAX_GAIN_SAMPLES = 401  # the same, where a sample costs no new model of the machine
MAX_POLE_MOVE = 0.12  # how far a pole may move from sample to sample, of its distance from zero
SLOW_POLE_SHARE = 1e-4  # of the fastest rate: poles that may move as far as one of this rate
DELAY = 0.02  # |z| of poles that count as pure delay
MIN_INTERVAL = 1e-4  # of the range: intervals that are not halved
ROUNDING = 1e-13  # of the fastest rate: growth that counts as none
REAL_POLE_TOLERANCE = (
    1e-7  # of the fastest rate: smaller imaginary parts are rounding, as of a double real pole
)
CROSSING_ACCURACY = 1e-8  # of the range: the accuracy of the values at which stability changes


@dataclass(frozen=True, eq=False)
class RootLocus:
    """Closed-loop poles over a parameter. Poles in rad/s; of sampled loops ln(z) / T, NaN for those of pure delay."""

    name: str
    parameter: str
    channel: str | None  # whose gain it is; None: all
    unit: str
    values: FloatArray  # k, ascending
    poles: ComplexArray  # k x n, a column for each branch
    nominal: float
    nominal_poles: ComplexArray
    changes: tuple[float, ...]  # values at which the loop becomes stable or unstable
    sample_time: float | None  # s; None: continuous


@on_one_thread
def root_locus(
    source: Any,
    controller: Any = None,
    *,
    parameter: str = GAIN,
    span: tuple[float, float] | None = None,
    channel: str | None = None,
    at: Place = "sensors",
    progress: Callable[[float], None] | None = None,
) -> RootLocus:
    """The root locus of a loop.

    source, controller : as `linear_loop` takes them; for a parameter of the machine, a plant and its controller
    parameter : of the machine, by name; or "gain", a factor of the loop gain
    span : lowest and highest value, SI; None: half and one and a half of the nominal value, of the gain 0.1 and 10
    progress : takes the share that is done, 0 to 1
    channel : the channel whose gain is changed, the others as they are; None: all
    at : where the gain is changed, "sensors" or "forces"

    Raises InputError for an unknown parameter, an invalid range, and a value that the machine cannot have.

    >>> import control
    >>> found = root_locus(control.tf([1], [1, 3, 2, 0]), span=(1, 10))
    >>> [round(value, 3) for value in found.changes]
    [6.0]
    """
    loop = linear_loop(source, controller)
    matrix, nominal, unit = _family(source, controller, loop, parameter, (channel, at))
    usual = (0.1, 10.0) if parameter == GAIN else (0.5 * nominal, 1.5 * nominal)
    low, high = span or usual
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise InputError(
            "root locus", parameter, f"{low:g} to {high:g}", "a range from a lower to a higher value"
        )
    most = MAX_GAIN_SAMPLES if parameter == GAIN else MAX_SAMPLES
    first = _values(low, high, nominal, wide=parameter == GAIN)
    values, found = _follow_branches(_count_calls(matrix, most, progress), first, most, loop.sample_time)
    return RootLocus(
        loop.name,
        parameter,
        channel if parameter == GAIN else None,
        unit,
        values,
        _in_rates(found, loop.sample_time),
        nominal,
        loop.closed_poles,
        stability_changes(matrix, values, found, loop.sample_time),
        loop.sample_time,
    )


Matrix = Callable[[float], "ComplexArray"]  # of a value: the eigenvalues of the closed loop, in differences


def _count_calls(matrix: Matrix, most: int, progress: Callable[[float], None] | None) -> Matrix:
    """The same function, which says after each new value how many of at most `most` there were."""
    if progress is None:
        return matrix
    seen: set[float] = set()

    def call(value: float) -> ComplexArray:
        found = matrix(value)
        seen.add(value)
        progress(min(len(seen) / most, 1.0))
        return found

    return call


def _family(
    source: Any, controller: Any, loop: LinearLoop, parameter: str, where: tuple[str | None, Place]
) -> tuple[Matrix, float, str]:
    """The eigenvalues by value, the nominal value and its unit."""
    if parameter == GAIN:
        channel, at = where
        names = [s.name for s in (loop.outputs if at == "sensors" else loop.inputs)]
        require_known([] if channel is None else [channel], names, "root locus", "channel")
        chosen = np.array([channel in (None, name) for name in names])
        return cache(lambda k: eigenvalues(loop.closed_loop(np.where(chosen, k, 1.0), at).A)), 1.0, "1"
    plant, law = source if isinstance(source, tuple) else (source, controller)
    if not isinstance(plant, Plant):
        raise InputError(
            "root locus", parameter, "a loop without a machine", f"{GAIN!r}, or a plant and its controller"
        )
    units = units_of(plant.parameters)
    require_known([parameter], [GAIN, *units], "root locus", "parameter")
    nominal = float(getattr(plant.parameters, parameter))
    return cache(lambda value: _of_machine(plant, law, parameter, value)), nominal, units[parameter]


def _of_machine(plant: Plant, controller: Controller, parameter: str, value: float) -> ComplexArray:
    """The eigenvalues with another value of a parameter; the controller stays."""
    try:
        changed = plant_of(replace(plant.parameters, **{parameter: value}))
        return linear_loop(changed, controller).closed_eigenvalues()
    except InputError as error:
        raise InputError("root locus", parameter, f"{value:g}", error.expected) from error
    except CheckError as error:
        raise InputError(
            "root locus", parameter, f"{value:g} ({error})", "a machine that can be held"
        ) from error


def _values(low: float, high: float, nominal: float, *, wide: bool) -> FloatArray:
    """Values from low to high, of which one is the nominal one where it lies between."""
    if wide and high > 0:
        start = low if low > 0 else high * 1e-4
        values = np.geomspace(start, high, SAMPLES)
        values = np.append(low, values) if low < start else values
    else:
        values = np.linspace(low, high, SAMPLES)
    return np.unique(np.append(values, nominal)) if low < nominal < high else values


def _follow_branches(
    matrix: Matrix, values: FloatArray, most: int, T: float | None
) -> tuple[FloatArray, ComplexArray]:
    """All samples with their eigenvalues in the order of the branches; intervals are halved where poles move far."""
    known = values.tolist()
    found = _in_order([matrix(value) for value in known])
    while len(known) < most:
        moved = np.abs(np.diff(found, axis=0)) / _sizes(found, T)
        worst = moved.max(axis=1, initial=0.0)
        worst[np.diff(known) < MIN_INTERVAL * (known[-1] - known[0])] = 0.0
        far = np.argsort(-worst)[: most - len(known)]
        far = np.sort(far[worst[far] > MAX_POLE_MOVE])
        if not len(far):
            break
        for k in reversed(far.tolist()):
            known.insert(k + 1, (known[k] + known[k + 1]) / 2)
        found = _in_order([matrix(value) for value in known])
    return np.array(known), found


def _sizes(found: ComplexArray, T: float | None) -> FloatArray:
    """The distance from zero frequency of the poles before each motion; in the plane of z also that from z = 0.

    Poles next to pure delay have no size: they may move at will.
    """
    size = np.maximum(np.abs(found[:-1]), np.abs(found[1:]))
    size = np.maximum(size, SLOW_POLE_SHARE * size.max(initial=1e-300))
    if T is None:
        return np.asarray(size)
    z = np.maximum(np.abs(1 + T * found[:-1]), np.abs(1 + T * found[1:]))
    return np.asarray(np.where(z < DELAY, np.inf, np.minimum(size, z / T)))


def _in_order(sets: list[ComplexArray]) -> ComplexArray:
    """Sets of eigenvalues as rows, each entry after the one in the row before from which it came."""
    rows = [sets[0]]
    for found in sets[1:]:
        ahead = rows[-1] if len(rows) < 2 else 2 * rows[-1] - rows[-2]
        rows.append(_continue_branches(rows[-1], ahead, found))
    return np.array(rows)


def _continue_branches(last: ComplexArray, ahead: ComplexArray, found: ComplexArray) -> ComplexArray:
    """Eigenvalues in the order of the branches: conjugates stay conjugate, and pairs meet and part on the real axis.

    Upper poles go to upper ones, real ones to real ones, lower ones where the conjugates of their partners go. What one
    row has more of pairs than the other, the nearest two real poles of the other take or give.
    """
    cost = np.abs(ahead[:, None] - found) + np.abs(last[:, None] - found)
    (upper, lower, real), (up, low, flat) = _split_pairs(last), _split_pairs(found)
    target = np.empty(len(last), dtype=int)
    while len(upper) > len(up):  # a pair meets
        i, r = _nearest_two(cost[np.ix_(upper, flat)])
        target[[upper[i], lower[i]]] = flat[list(r)]
        upper, lower, flat = np.delete(upper, i), np.delete(lower, i), np.delete(flat, r)
    while len(up) > len(upper):  # two real poles part
        i, r = _nearest_two(cost[np.ix_(real, up)].T)
        target[real[list(r)]] = up[i], low[i]
        up, low, real = np.delete(up, i), np.delete(low, i), np.delete(real, r)
    chosen = optimize.linear_sum_assignment(cost[np.ix_(upper, up)])[1]
    target[upper], target[lower] = up[chosen], low[chosen]
    target[real] = flat[optimize.linear_sum_assignment(cost[np.ix_(real, flat)])[1]]
    return np.asarray(found[target])


def _split_pairs(poles: ComplexArray) -> tuple[Indices, Indices, Indices]:
    """Indices of the upper poles, of their conjugates in the same order, and of the real ones, by rounding."""
    level = REAL_POLE_TOLERANCE * float(np.abs(poles).max(initial=0.0))
    upper, lower = np.flatnonzero(poles.imag > level), np.flatnonzero(poles.imag < -level)
    apart = np.abs(poles[upper].conj()[:, None] - poles[lower])
    return upper, lower[optimize.linear_sum_assignment(apart)[1]], np.flatnonzero(np.abs(poles.imag) <= level)


def _nearest_two(cost: FloatArray) -> tuple[int, tuple[int, int]]:
    """The pair (a row), and the two real poles (columns) that it becomes at the least cost."""
    two = np.argsort(cost, axis=1)[:, :2]
    best = int(np.argmin(np.take_along_axis(cost, two, axis=1).sum(axis=1)))
    return best, (int(two[best, 0]), int(two[best, 1]))


def _in_rates(found: ComplexArray, T: float | None) -> ComplexArray:
    """Eigenvalues in rad/s, NaN for those of pure delay."""
    if T is None:
        return found
    gone = np.abs(1 + T * found) < 1e-6
    return np.asarray(np.where(gone, complex(np.nan, np.nan), np.log1p(T * np.where(gone, 0, found)) / T))


def _growth(found: ComplexArray, T: float | None) -> float:
    """The growth of the worst eigenvalue, 1/s: positive where unstable."""
    return float((found.real + 0.5 * (T or 0.0) * np.abs(found) ** 2).max(initial=-math.inf))


def stability_changes(
    matrix: Matrix, values: FloatArray, found: ComplexArray, T: float | None
) -> tuple[float, ...]:
    """The values at which the worst pole crosses the boundary of stability; rounding on it is no crossing."""
    least = ROUNDING * (float(np.abs(found).max(initial=0.0)) + (0.0 if T is None else 1 / T))
    worst = [_growth(row, T) for row in found]
    made = []
    for k in range(len(values) - 1):
        if worst[k] * worst[k + 1] < 0 and max(abs(worst[k]), abs(worst[k + 1])) > least:
            root: Any = optimize.brentq(
                lambda value: _growth(matrix(value), T), values[k], values[k + 1],
                xtol=CROSSING_ACCURACY * (values[-1] - values[0]),
            )  # fmt: skip
            made.append(float(root))
    return tuple(made)
