"""From which states a supervisor brings its machine back: flights of its C with the C of the machine, side by side."""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from malta.errors import InputError
from malta.firmware.ctext import c_numbers
from malta.firmware.flight import compile_files
from malta.firmware.machine import (
    FirmwareMachine,
    command_field,
    machine_sources,
    noise_channels,
    wrench_fields,
)
from malta.firmware.signals import Target, deepest_target
from malta.firmware.sources import head_context, render
from malta.firmware.supervised_flight import supervised_texts
from malta.firmware.supervisor import bounds_of
from malta.synthesis.controller import Controller

CALM_SAMPLES = 200  # at the end, in which a machine that is back is at rest


def recoverable(
    c: Controller, x: npt.ArrayLike, *, within: float = 0.3, noise: float = 1.0, seed: int = 1
) -> npt.NDArray[np.bool_]:
    """From which states the supervisor of a controller brings its machine back to rest at the centre.

    True: the exported C, which takes over at x, and the C of the nonlinear machine of the gain file, which begins at x
    without current, fly for `within` seconds; no contact is met, the gates stay on, and over the last CALM_SAMPLES the
    true outputs are within what a settled machine may be off (monitors' `settled`). The reference begins at the first
    readings, with the rates of the outputs at x, and goes to zero within its limits. False: otherwise, and where x is
    in contact already.

    This is a simulation of each state, not a proof: nothing follows for states between those that are asked for, for
    other parameters, loads, faults, or noise than of this seed.

    c : of a gain file
    x : ... x n states of the machine in SI units, in the order of plant.states: positions, angles, and their rates
    within : s
    noise : of the sensors, in multiples of the machine's own; without noise a supervisor takes sensors for stuck
    seed : of the noise

    Returns the answers in the shape of x without its last axis.

    Raises InputError for states that are no finite numbers or of another size, without a C compiler, and for a machine
    that cannot be exported.

    >>> import numpy as np
    >>> import malta
    >>> c = malta.gains.read("design/gains/robust.json")
    >>> x = np.zeros((3, 12))
    >>> x[:, 2], x[:, 8] = 5e-3, [0.1, 0.5, 2.0]  # m and m/s along the stroke
    >>> malta.firmware.recoverable(c, x, within=0.1).tolist()
    [True, True, False]
    """
    t = deepest_target(c)
    m = FirmwareMachine(t)
    states = np.asarray(x, dtype=float)
    size = len(m.plant.states)
    if not states.ndim or states.shape[-1] != size or not np.isfinite(states).all():
        found = "states that are no finite numbers" if states.shape[-1:] == (size,) else f"{states.shape}"
        raise InputError("recoverable", "x", found, f"finite numbers, ... x {size}")
    rows = np.ascontiguousarray(states.reshape(-1, size))
    rates = np.ascontiguousarray([_rates(t)(row).full().ravel() for row in rows])
    par = np.array([float(getattr(m.plant.parameters, name)) for name in m.parameters])
    well = np.zeros(len(rows))
    samples = max(round(within / c.sample_time), CALM_SAMPLES)
    arrays = [a.ctypes.data_as(ctypes.c_void_p) for a in (rows, rates, par)]
    numbers = ctypes.c_double(noise), ctypes.c_double(seed), ctypes.c_int32(samples)
    _library(t).own_reenter(len(rows), *arrays, *numbers, well.ctypes.data_as(ctypes.c_void_p))
    return np.asarray(well.reshape(states.shape[:-1]) > 0)


@lru_cache(maxsize=16)
def _rates(t: Target) -> ca.Function:
    """x -> rates of the outputs, as the machine moves without forces from outside."""
    plant = t.believed
    x = ca.SX.sym("x", len(plant.states))
    rate = plant.f(x, ca.DM(plant.at().u), ca.DM.zeros(len(plant.disturbances)))
    return ca.Function("rates", [x], [ca.densify(ca.jtimes(plant.h(x, ca.DM(plant.at().u)), x, rate))])


@lru_cache(maxsize=16)
def _library(t: Target) -> Any:
    """Controller, supervisor, machine and their flights in one library."""
    m, command = FirmwareMachine(t), command_field(t)
    machine = machine_sources(m, "own_machine", ("begin", "substep", "read"))
    context = head_context(t, "own") | {
        "plant": "own_machine",
        "outputs": len(t.controller.measurements),
        "settled": c_numbers(bounds_of(t).settled, "double"),
        "wrench": sum(f.size for f in wrench_fields(m)),
        "noises": noise_channels(m),
        "volts": m.sizes.controller.get("u_integral", 0),
        "states": len(m.plant.states),
        "driven": t.driven,
        "currents": len(t.current_readings) if t.driven else 0,
        "contacts": len(m.plant.contacts.names),
        "held": command.size,
        "command": command.name,
        "delay": m.setup.delay,
        "calm": CALM_SAMPLES,
    }
    texts = [machine[name] for name in ("own_machine.h", "own_machine.c") if name in machine]
    return compile_files([*supervised_texts(t, "own"), *texts, render("reentry.c", context)])
