"""What a log at constant speed tells of the unbalance, and the forces beside the law's that take its response away.

The line at the speed is a line like any other: the machine's model turns measured currents into motion there, and what
is left is the unbalance's. Forces sent beside the law's at that line leave the loop as it is, |S| and margin too.
"""

from __future__ import annotations

import cmath
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

import malta
from malta.errors import CheckError, InputError
from malta.identification.excite import cut_loop
from malta.model.equilibrium import trim

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.identification import Log
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

TURNS = 20  # of the rotor at least
LEARNED = 0.8  # of what is left, that the next forces take away
TURNING = np.array(
    [[1, 0], [-1j, 0], [0, 1j], [0, 1]]
)  # force and torque -> F_x, F_y, T_x, T_y of cos(Omega t)


class Unbalance(NamedTuple):
    """The unbalance of a rotor: eccentricity and its plane (m), where its angle is at t = 0 (rad), and what its model
    leaves of the synchronous motion, as a share."""

    e_u: float
    l_u: float
    angle: float
    left: float


def phasors(log: Log, group: str, speed: float) -> ComplexArray:
    """Amplitudes a of a group's columns at a speed, rad/s: Re(a exp(j speed t)), over a log's last whole turns."""
    each = 2 * np.pi / (speed * log.sample_time)
    turns = int(log.samples / each)
    if turns < TURNS:
        raise CheckError(f"{log.source}: {turns} turns, {TURNS} at least tell a line")
    count = round(turns * each)
    angle = speed * log.t[-count:]
    rows = np.column_stack([np.cos(angle), -np.sin(angle), np.ones(count)])
    c, s, _ = np.linalg.lstsq(rows, log.columns[group][-count:], rcond=None)[0]
    return np.asarray(c + 1j * s)


def identify_unbalance(plant: Plant, log: Log) -> Unbalance:
    """The unbalance from measured currents and positions at the speed of the plant's parameters.

    Y = C (j Omega - A)^-1 (B_i I + W w), the currents I held between samples, about the place that carries the weight.
    """
    par: Any = plant.parameters
    if not par.Omega > 0:
        raise InputError("unbalance", "Omega", f"{par.Omega:g} rad/s", "a rotor that turns")
    place = trim(plant)
    x, i, w = (ca.SX.sym("signal", size) for size in (8, 4, 4))
    moved = plant.f(x, plant.actuator.forces(x, i), w + plant.load(x))
    slopes = ca.Function("slopes", [x, i, w], [ca.jacobian(moved, v) for v in (x, i, w)])
    A, B, W = (np.array(m) for m in slopes(place.x, place.v / par.k_i, np.zeros(4)))
    half = par.Omega * log.sample_time / 2
    held = np.sin(half) / half * cmath.exp(-1j * half)
    C = malta.linearize(plant, plant.at()).C
    inner = C @ np.linalg.inv(1j * par.Omega * np.eye(8) - A)
    y = phasors(log, "y", par.Omega)
    e = y - inner @ B @ phasors(log, "i", par.Omega) * held
    seen = inner @ W @ TURNING
    found, *_ = np.linalg.lstsq(seen, e, rcond=None)
    force, torque = found
    left = float(np.linalg.norm(e - seen @ found) / np.linalg.norm(e))
    return Unbalance(
        float(abs(force) / (par.m * par.Omega**2)), float((torque / force).real), cmath.phase(force), left
    )


def next_forces(plant: Plant, controller: Controller, log: Log) -> ComplexArray:
    """Amplitudes of the forces to be sent next beside the law's: those of the log less LEARNED of what moves it.

    The loop answers a force d at the speed with G d, G = S P F_d: so d - 0.8 G^-1 Y leaves a fifth of Y, if the model
    is right, and less than Y as long as G is not off by more than itself.
    """
    speed: float = getattr(plant.parameters, "Omega")  # noqa: B009
    cut = cut_loop(malta.loop(plant, controller), np.array([speed]))
    sent = phasors(log, "excitation", speed) if log.names("excitation") else np.zeros(4)
    return np.asarray(sent - LEARNED * np.linalg.solve(cut.G[0], phasors(log, "y", speed)))


def turning_forces(amplitudes: ComplexArray, speed: float) -> Callable[[Any], FloatArray]:
    """The forces at times t, k x 4, as a scenario's `excitation`."""
    return lambda t: np.asarray((amplitudes * np.exp(1j * speed * np.asarray(t))[..., None]).real)
