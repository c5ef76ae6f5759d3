"""The stroke by hand in C (peers/), compiled here for this processor: one machine, and many on vectors and threads."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from peer_problem import NO_SPIN, packed, problem

from malta.controller import Controller
from malta.data import plant_of
from malta.engine import feedforward_table
from malta.plants.tubular import Parameters

if TYPE_CHECKING:
    from malta.plant import FloatArray

SOURCES = Path(__file__).parent / "peers"
GCC = shutil.which("gcc")
if GCC is None:
    raise ImportError("no gcc")
FLAGS = "-std=gnu17 -O3 -march=native -ffp-contract=fast -fno-math-errno"
FLAGS += " -fno-trapping-math -fschedule-insns -fsched-pressure -Wno-psabi"


@cache
def _library(name: str) -> ctypes.CDLL:
    with tempfile.TemporaryDirectory() as scratch:
        library = Path(scratch) / f"{name}.so"
        command = [str(GCC), *FLAGS.split(), "-fopenmp", "-shared", "-fPIC", "-o", str(library)]
        subprocess.run([*command, str(SOURCES / f"{name}.c"), "-lm"], check=True)
        return ctypes.CDLL(str(library))


def _at(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


def single(
    par: Parameters,
    controller: Controller,
    p_ref: FloatArray,
    xi_ref: FloatArray,
    v_ff: FloatArray,
    *,
    substeps: int = 4,
) -> tuple[FloatArray, FloatArray]:
    """True outputs, k x 5, and states, k x 12, up to and with the sample of a contact."""
    given = problem(par, controller, p_ref, xi_ref, v_ff, substeps)
    machine, law = np.array(given.machine), packed(controller)
    body = np.ascontiguousarray(given.bodies[:, 0])
    p, x = np.empty((len(p_ref), 5)), np.empty((len(p_ref), 12))
    done = _library("single").single(
        _at(machine),
        _at(law),
        _at(given.law.rows),
        _at(body[:5]),
        _at(body[5:]),
        ctypes.c_double(NO_SPIN),
        _at(given.start),
        ctypes.c_int64(len(p_ref)),
        _at(given.p_ref),
        _at(given.feed),
        _at(p),
        _at(x),
    )
    return p[:done], x[:done]


def plain(
    par: Parameters,
    controller: Controller,
    p_ref: FloatArray,
    xi_ref: FloatArray,
    v_ff: FloatArray,
    *,
    substeps: int = 4,
) -> tuple[FloatArray, FloatArray]:
    """The same as `single`, from the equations as they stand in malta, with the system's plain -O3."""
    c, ff = controller, controller.feedforward
    h = c.sample_time / substeps
    wave, decay = 2 * np.pi / par.L_p, np.exp(-par.w_cc * h / 2)
    body = [par.m, par.I_xx, par.I_yy, par.I_zz, par.K_A, par.l_B, par.l_S, wave, par.phi_c, par.F_c, par.g]
    machine = np.array([*body, par.r_max, par.z_max, decay, h])
    matrices = (c.L, c.Cd, c.Ad, c.Bd, c.K, c.Ki, c.limits.force, np.array(c.sample_time))
    law = np.concatenate([np.ravel(M) for M in matrices])
    grid = feedforward_table(ff.z_grid, ff.v0)
    plant = plant_of(par)
    mechanical = dict(zip([s.name for s in plant.design_states], xi_ref[0].tolist(), strict=True))
    x0 = plant.at(**mechanical).x
    state = np.concatenate([x0, ff.at(x0[2]), xi_ref[0], np.zeros(10)])
    p, x = np.empty((len(p_ref), 5)), np.empty((len(p_ref), 12))
    done = _library("plain").plain(
        _at(machine),
        _at(law),
        ctypes.c_long(len(grid)),
        _at(grid),
        ctypes.c_long(len(p_ref)),
        ctypes.c_long(substeps),
        *(_at(np.ascontiguousarray(a)) for a in (p_ref, xi_ref, v_ff)),
        _at(state),
        _at(p),
        _at(x),
    )
    return p[:done], x[:done]


def many(
    par: Parameters,
    controller: Controller,
    factors: FloatArray,
    p_ref: FloatArray,
    xi_ref: FloatArray,
    v_ff: FloatArray,
    *,
    substeps: int = 4,
    noise: float = 0.0,
    seed: int = 0,
    scalar_noise: bool = False,
) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down."""
    given = problem(par, controller, p_ref, xi_ref, v_ff, substeps, factors)
    library = _library("many")
    machine, law = np.array(given.machine), packed(controller)
    count = len(factors)
    bodies = np.pad(given.bodies, ((0, 0), (0, -count % library.width())), mode="edge")
    start = np.concatenate([given.start[[0, 1, 2, 3, 4, 6, 7, 8, 9, 10]], given.v0])
    deviation = noise * np.array([par.s_r] * 4 + [par.s_z])
    largest, touched = np.empty((5, bodies.shape[1])), np.empty(bodies.shape[1], dtype=np.uint8)
    library.many(
        _at(machine),
        _at(law),
        _at(given.law.rows),
        _at(bodies),
        ctypes.c_int64(bodies.shape[1]),
        _at(start),
        ctypes.c_int64(len(p_ref)),
        _at(given.p_ref),
        _at(given.feed),
        ctypes.c_int(0 if not noise else 2 if scalar_noise else 1),
        ctypes.c_uint64(seed),
        _at(deviation),
        _at(largest),
        _at(touched),
    )
    return largest[:, :count].T, touched[:count].astype(bool)
