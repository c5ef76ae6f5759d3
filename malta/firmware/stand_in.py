"""What stands in for a machine in the exported example and test: it is where its reference is, with noisy sensors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.firmware.ctext import c_number, function_text
from malta.firmware.lowering import lower
from malta.firmware.program import program_of
from malta.firmware.signals import place_of_readings
from malta.firmware.supervisor import JUMP, bounds_of, reading_deviations, reference_limits

if TYPE_CHECKING:
    from malta.firmware.signals import Target

UNEVEN_SHARE = 1e-3  # of the bound of the currents of a star: noise of a current sensor
ROOM = 2.0  # by which an example's stroke stays below the limits of references
QUINTIC_SPEED, QUINTIC_ACCELERATION = 1.3, 4.0  # largest, of a quintic: way / rise, way / rise^2, 10 to 90 %
SHORTEST_RISE = 20  # samples


def stand_in_context(t: Target, name: str) -> dict[str, Any]:
    """What stand_in.c is filled with. name : the controller's"""
    found: dict[str, Any] = {
        "noise": ", ".join(c_number(float(v), t.precision) for v in reading_deviations(t.believed)),
        "noise_step": c_number(2.0**-15, t.precision),
    }
    if not t.driven:
        return found
    program = program_of(lower(phase_currents(t), t.precision))
    return found | {
        "phases": function_text(program, name, t.precision, static=True),
        "stand_in_root": any(o.op == "SQRT" for o in program.operations),
        "current_noise": c_number(UNEVEN_SHARE * bounds_of(t).uneven, t.precision),
    }


def phase_currents(t: Target) -> ca.Function:
    """(readings of the positions, commanded currents of the coils) -> i, what the current sensors read then."""
    plant, drive = t.believed, t.believed.drive
    y, current = ca.SX.sym("y", len(plant.outputs)), ca.SX.sym("current", len(plant.actuator.coils))
    axes = drive.command(current)
    i = ca.densify(drive.to_phases(place_of_readings(plant, y)) @ axes if t.fidelity == "phase" else axes)
    return ca.Function("phases", [y, current], [i], ["y", "current"], ["i"])


def example_stroke(t: Target) -> tuple[float, float]:
    """End in m and rise in s of an example's stroke: a tenth of the travel, within half of all limits of references.

    A filter knows forces and the stand-in does not: it then moves by so little in a sample that it is no innovation.
    """
    k, Ts = t.believed.stroke_output, t.controller.sample_time
    limits = reference_limits(t)
    way = min(t.believed.travel / 10, limits.position[k] / ROOM)
    speed, acceleration = limits.speed[k] / ROOM, limits.acceleration[k] / ROOM
    by_acceleration = float(np.sqrt(QUINTIC_ACCELERATION * way / acceleration))
    rise = max(SHORTEST_RISE * Ts, QUINTIC_SPEED * way / speed, by_acceleration, 0.02)
    if t.controller.tracks == "states":
        sigma = float(bounds_of(t).sigma[k])
        way = min(way, JUMP / ROOM * sigma * rise / (QUINTIC_SPEED * Ts))
    return way, rise
