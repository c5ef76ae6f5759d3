"""The stroke by hand in C (peers/), compiled here for this processor: one machine, and many on vectors and threads."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from peer_problem import MECHANICAL, NO_SPIN, Stated, Workload, packed, problem, stated

from malta.simulation.readings import keys

if TYPE_CHECKING:
    from malta.arrays import FloatArray

SOURCES = Path(__file__).parent / "peers"
GCC = shutil.which("gcc")
if GCC is None:
    raise ImportError("no gcc")
FLAGS = "-std=gnu17 -O3 -march=native -mtune=generic -ffp-contract=fast -fno-math-errno"
FLAGS += " -fno-trapping-math -fschedule-insns -fsched-pressure -Wno-psabi"


@cache
def _library(name: str) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as scratch:
        library = Path(scratch) / f"{name}.so"
        command = [str(GCC), *FLAGS.split(), "-fopenmp", "-shared", "-fPIC", "-o", str(library)]
        subprocess.run([*command, str(SOURCES / f"{name}.c"), "-lmvec", "-lm"], check=True)
        return ctypes.CDLL(str(library))


def _at(array: np.ndarray) -> ctypes.c_void_p:
    """Its address, which keeps it alive."""
    return array.ctypes.data_as(ctypes.c_void_p)


def single(work: Workload) -> tuple[FloatArray, FloatArray]:
    """True outputs, k x 5, and states, k x 12, up to and with the sample of a contact."""
    given = problem(work)
    machine, law = np.array(given.machine), packed(work.controller)
    body = np.ascontiguousarray(given.bodies[:, 0])
    p, x = _series(work)
    done = _library("single").single(
        _at(machine),
        _at(law),
        _at(given.law.rows),
        _at(body[:5]),
        _at(body[5:]),
        ctypes.c_double(NO_SPIN),
        _at(given.start),
        ctypes.c_int64(len(p)),
        _at(given.p_ref),
        _at(given.feed),
        _at(p),
        _at(x),
    )
    return p[:done], x[:done]


def plain(work: Workload) -> tuple[FloatArray, FloatArray]:
    """The same as `single`, from the equations as they stand in malta."""
    given = stated(work)
    p, x = _series(work)
    done = _library("plain").plain(
        _at(np.ascontiguousarray(given.machines[:, 0])),
        *_asked(work, given),
        _at(np.ascontiguousarray(given.states[:, 0])),
        _at(p),
        _at(x),
    )
    return p[:done], x[:done]


def plain_many(work: Workload) -> tuple[FloatArray, FloatArray]:
    """The same as `many`, from the equations as they stand in malta, with malta's own noise."""
    given, library = stated(work), _library("plain_many")
    count = given.machines.shape[1]
    machines, states = (
        np.pad(rows, ((0, 0), (0, -count % library.width())), mode="edge")
        for rows in (given.machines, given.states)
    )
    largest, touched = _found(machines.shape[1])
    matrices, points, grid, *rest = _asked(work, given)
    library.many(
        _at(machines),
        matrices,
        points,
        grid,
        ctypes.c_long(machines.shape[1]),
        *rest,
        _at(states),
        _at(keys(work.seed, np.arange(machines.shape[1]))),
        _at(work.sigma),
        _at(largest),
        _at(touched),
    )
    return largest[:, :count].T, touched[:count].astype(bool)


def many(work: Workload, *, scalar_noise: bool = False) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down."""
    given, library = problem(work), _library("many")
    machine, law = np.array(given.machine), packed(work.controller)
    count = given.bodies.shape[1]
    bodies = np.pad(given.bodies, ((0, 0), (0, -count % library.width())), mode="edge")
    start = np.concatenate([given.start[MECHANICAL], given.v0])
    largest, touched = _found(bodies.shape[1])
    library.many(
        _at(machine),
        _at(law),
        _at(given.law.rows),
        _at(bodies),
        ctypes.c_int64(bodies.shape[1]),
        _at(start),
        ctypes.c_int64(len(given.p_ref)),
        _at(given.p_ref),
        _at(given.feed),
        ctypes.c_int(0 if not work.noise else 2 if scalar_noise else 1),
        ctypes.c_uint64(work.seed),
        _at(work.sigma),
        _at(largest),
        _at(touched),
    )
    return largest[:, :count].T, touched[:count].astype(bool)


def _series(work: Workload) -> tuple[FloatArray, FloatArray]:
    return np.empty((len(work.p_ref), 5)), np.empty((len(work.p_ref), 12))


def _found(count: int) -> tuple[FloatArray, np.ndarray]:
    return np.empty((5, count)), np.empty(count, dtype=np.uint8)


def _asked(work: Workload, given: Stated) -> tuple[Any, ...]:
    """Law, grid, samples, steps and references."""
    rows = (np.ascontiguousarray(a, dtype=float) for a in (work.p_ref, work.xi_ref, work.v_ff))
    counts = (ctypes.c_long(n) for n in (len(given.grid), len(work.p_ref), work.substeps))
    points, samples, substeps = counts
    return _at(given.law), points, _at(given.grid), samples, substeps, *(_at(a) for a in rows)
