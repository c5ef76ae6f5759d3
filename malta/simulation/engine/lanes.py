"""Many machines side by side in the lanes of a processor: their numbers in its order, and the calls of the engine."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from malta.arrays import FloatArray
from malta.simulation.engine.compiled import LANES, address_of


class Numbers(NamedTuple):
    """Numbers of machines and controller: the same for all machines, but for some that are each machine's own."""

    same: FloatArray
    places: NDArray[np.int_]  # of those that are each machine's own
    own: FloatArray  # groups x numbers x LANES


class Lanes(NamedTuple):
    """Machines of a batch in groups of LANES: every array is groups x numbers x LANES, keys are groups x LANES.

    A run changes `states` and `digests` in place.
    """

    theta: FloatArray | Numbers  # numbers of machine and controller; an array: all are each machine's own
    states: FloatArray
    sigma: FloatArray  # standard deviations of the sensors' noise
    keys: NDArray[np.uint64]  # of the noise
    digests: FloatArray


class Shared(NamedTuple):
    """Inputs that all machines of a batch share."""

    given: FloatArray  # samples x inputs of a sample
    table: FloatArray  # of v0(z), see feedforward_table
    substeps: int  # Runge–Kutta steps in a sample
    uniform: bool  # noise of the sensors is uniform, not normal
    foreseen: FloatArray | None = None  # what `foreseen` computes of them; None: every call does


def arrange_in_lanes(rows: FloatArray, groups: int) -> FloatArray:
    """Rows of machines, or one row of all, as groups x numbers x LANES; copies of the last fill the last group."""
    if len(rows) == 1:
        return repeat_in_lanes(rows[0], {}, groups)
    lanes, whole = np.empty((groups, rows.shape[1], LANES)), len(rows) // LANES
    lanes[:whole] = rows[: whole * LANES].reshape(whole, LANES, rows.shape[1]).swapaxes(1, 2)
    if whole < groups:
        rest = rows[whole * LANES :]
        lanes[whole] = np.concatenate([rest, np.repeat(rows[-1:], LANES - len(rest), axis=0)]).T
    return lanes


def repeat_in_lanes(same: FloatArray, own: Mapping[int, FloatArray], groups: int) -> FloatArray:
    """Numbers of machines as groups x numbers x LANES: the same for all but for those that are each machine's own.

    own : a number for each machine, by index
    """
    lanes = np.broadcast_to(same[:, None], (groups, len(same), LANES)).copy()
    lanes[:, list(own)] = numbers_in_lanes(same, own, groups).own
    return lanes


def numbers_in_lanes(same: FloatArray, own: Mapping[int, FloatArray], groups: int) -> Numbers:
    """The numbers of `repeat_in_lanes`; only those that are each machine's own take memory for every machine."""
    lanes = np.empty((groups, len(own), LANES))
    for k, column in enumerate(own.values()):
        lanes[:, k] = np.pad(column, (0, groups * LANES - len(column)), mode="edge").reshape(groups, LANES)
    return Numbers(same, np.array(list(own), dtype=np.int_), lanes)


def _numbers_of(theta: FloatArray | Numbers, chosen: slice) -> tuple[Any, ...]:
    """The numbers of some groups as the engine takes them; the addresses keep their arrays alive."""
    if not isinstance(theta, Numbers):
        theta = Numbers(np.zeros(theta.shape[1]), np.arange(theta.shape[1]), theta)
    same, places, own = (
        array.ctypes.data_as(ctypes.c_void_p) for array in (theta.same, theta.places, theta.own[chosen])
    )
    return same, ctypes.c_long(len(theta.places)), places, own


def foresee_samples(lib: ctypes.CDLL, lanes: Lanes, shared: Shared) -> FloatArray:
    """What all machines of a batch share at every sample, samples x numbers: see instructions.py."""
    call = partial(lib.foresee_all, ctypes.c_long(len(shared.given)), *_numbers_of(lanes.theta, slice(0, 1)))
    numbers = np.empty((len(shared.given), call(address_of(shared.given), None)))
    call(address_of(shared.given), address_of(numbers))
    return numbers


class TimeSpan(NamedTuple):
    """A part of the time of all runs, which has noise of its own."""

    samples: slice
    keys: NDArray[np.uint64]  # groups x LANES
    then: Callable[[FloatArray], None] | None = None  # what is done with the digests after it, in place


def run_many(
    lib: ctypes.CDLL, chosen: slice, lanes: Lanes, shared: Shared, parts: Sequence[TimeSpan] | None = None
) -> None:
    """Simulate the `chosen` groups of machines; their states and digests change in place.

    parts : of the time, one after the other; None: all samples with the keys of the lanes
    """
    numbers = _numbers_of(lanes.theta, chosen)
    states, sigma, digests = (
        address_of(array[chosen]) for array in (lanes.states, lanes.sigma, lanes.digests)
    )
    groups, rows = ctypes.c_long(len(lanes.states[chosen])), ctypes.c_long(len(shared.table))
    substeps, uniform = ctypes.c_long(shared.substeps), ctypes.c_long(shared.uniform)
    table = address_of(shared.table)
    ahead = foresee_samples(lib, lanes, shared) if shared.foreseen is None else shared.foreseen
    for samples, keys, then in parts or [TimeSpan(slice(None), lanes.keys)]:
        given = shared.given[samples]
        lib.run_many(
            groups,
            ctypes.c_long(len(given)),
            substeps,
            *numbers,
            rows,
            table,
            states,
            address_of(given),
            address_of(ahead[samples]),
            uniform,
            sigma,
            address_of(keys[chosen]),
            digests,
        )
        if then is not None:
            then(lanes.digests[chosen])
