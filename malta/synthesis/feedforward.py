"""What the machine decides of a controller, whatever its law: feedforward, current loops, limits."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from malta.arrays import FloatArray
from malta.errors import CheckError, InputError
from malta.linear.sampling import sample, split_delay
from malta.model.actuator import Actuator
from malta.model.equilibrium import holding_commands, load_balance
from malta.model.linearize import LinearModel
from malta.model.places import off_stroke
from malta.model.plant import Plant
from malta.synthesis.controller import Commutation, Controller, CurrentLoop, Feedforward, Limits, holding_gain
from malta.synthesis.design_models import between_samples

V0_STEP = 0.25e-3  # m, longest step of the grid of v0(z)
V0_STEPS = 16  # at least, either way


def machine_part(
    model: LinearModel,
    Ts: float,
    delay: float,
    *,
    current_loop_delay: bool,
    position_feedforward: bool = False,
) -> dict[str, Any]:
    """What of a controller its machine decides, not its law.

    position_feedforward : feed forward the forces that hold the machine at its reference
    """
    plant, actuator = model.plant, model.plant.actuator
    coils = len(actuator.coils)
    forward = feedforward(model, Ts, delay)
    if position_feedforward:
        plant.require_second_order("position_feedforward")
        forward = replace(forward, position=holding_gain(model.A, model.B))
    return {
        "spec_sha256": "",
        "parameters": plant.parameters,
        "operating_point": (model.operating_point.x[list(plant.controlled)], model.operating_point.u),
        "sample_time": Ts,
        "forces": plant.inputs,
        "measurements": plant.outputs,
        "A": model.A,
        "B": model.B,
        "C": model.C,
        "feedforward": forward,
        "current_loop": current_loop_of(actuator, current_loop_delay=current_loop_delay),
        "limits": Limits(
            current=np.full(coils, actuator.current_limit),
            voltage=np.full(coils, actuator.voltage_limit),
            force=np.array(actuator.force_limit),
        ),
    }


def current_loop_of(actuator: Actuator, *, current_loop_delay: bool) -> CurrentLoop | None:
    """The current controllers of a machine; None where currents follow their commands at once.

    current_loop_delay : whether they are designed with the machine's dead time
    """
    if not math.isfinite(actuator.crossover):
        return None
    dead_time = actuator.loop_delay if current_loop_delay else 0.0
    return CurrentLoop(*pi_current_loop(actuator, dead_time), actuator.sample_time)


def pi_current_loop(actuator: Actuator, delay: float = 0.0) -> tuple[float, float]:
    """Kp (V/A) and Ki (V/(A s)) that give 1/(L s + R) e^(-s delay) its crossover and phase margin, exactly.

    |C G| = 1 and arg C G = margin - pi at s = j crossover. Cancelling the winding's pole instead would give 90
    degrees, which is not the paper's design.
    """
    w = actuator.crossover
    gain = abs(actuator.R + 1j * w * actuator.L)
    phase = actuator.phase_margin - math.pi + w * delay + math.atan2(w * actuator.L, actuator.R)
    Kp, Ki = gain * math.cos(phase), -w * gain * math.sin(phase)
    if not (Kp > 0 and Ki > 0):
        raise CheckError(
            f"current loop: no PI controller reaches a phase margin of {math.degrees(actuator.phase_margin):.0f} deg "
            f"at {w:.0f} rad/s with {delay * 1e6:.0f} us of delay"
        )
    return Kp, Ki


def feedforward(model: LinearModel, Ts: float, delay: float = 0, lead: float = 0.0) -> Feedforward:
    """v0 along the travel, inertias, and what a steady ramp takes where held currents pull back.

    With x = (q, w) at a sample, q going on by Ts P^-1 p*', and currents that are `delay` samples old, which were
    commutated for a place `lead` (s) ahead:
        Ad (0, w) + Bd (f - H (Ts delay - lead) p*') = (Ts P^-1 p*', w)
    """
    static, half = _about(model, static_feedforward(model.plant)), len(model.A) // 2
    if not model.E.any():
        return static
    model.plant.require_second_order("held currents")
    still = between_samples(model)
    Ad, Bd = sample(still.A, model.B, Ts)
    back = np.linalg.inv(model.C[:, :half])
    whole, part = split_delay(delay)
    moved = np.vstack([Ts * back, np.zeros_like(back)]) + Bd @ still.H * (Ts * whole - lead)
    if part:  # for which currents act that are a sample older
        moved += (Bd - sample(still.A, model.B, (1 - part) * Ts)[1]) @ still.H * Ts
    unknown = np.hstack([Ad[:, half:] - np.eye(2 * half)[:, half:], Bd])
    found = np.linalg.solve(unknown, moved)
    return replace(static, speed=found[half:], rate=found[:half] - back)


def commutate_ahead(controller: Controller, model: LinearModel) -> Controller:
    """The same controller, whose currents are those of the place where they will act on the way of the reference.

    The currents of a reading act from `delay` to `delay` + 1 samples later: in the middle of that time the reference
    has gone on by (delay + 1/2) Ts p*'. Feedforward is that of such currents; gains and loop stay the same.

    model : the design model of the controller

    Raises InputError for a machine whose currents do not depend on where it is, and for a law of errors.

    Example: `commutate_ahead(malta.gains.read("design/gains/planar.json"), model).commutation.lead`
    """
    plant, Ts = model.plant, controller.sample_time
    if not model.E.any():
        found = f"a {plant.name}, whose currents do not depend on where it is"
        raise InputError(controller.name, "commutation", found, "a machine with held currents")
    if controller.tracks == "errors":
        raise InputError(controller.name, "commutation", "a law of errors", "an LQG or a PID")
    predicts = controller.cost is not None  # the delay is in its design model
    delay = controller.delay if predicts else plant.actuator.delay(Ts)
    lead, old = (delay + 0.5) * Ts, controller.feedforward
    new = feedforward(model, Ts, delay, lead)
    return replace(
        controller,
        feedforward=replace(old, speed=new.speed, rate=new.rate if predicts else old.rate),
        commutation=Commutation(lead, between_samples(model).H),
    )


def _about(model: LinearModel, static: Feedforward) -> Feedforward:
    """The feedforward at a model's operating point, which may lie off the stroke.

    The law's states count from the states' zero, and its model holds them at q0 by -G^-1 k q0. These forces follow the
    reference, and v0(z) is what else holds the machine there.
    """
    plant, point = model.plant, model.operating_point
    beside = off_stroke(plant, point.x)
    if not beside:
        return static
    states = np.tile(plant.state(beside), (len(static.z_grid), 1))
    if plant.has_stroke:
        states[:, plant.stroke_state] = static.z_grid
    apart = plant.state(beside)[list(plant.controlled)]
    own: FloatArray
    if plant.second_order:
        position = holding_gain(model.A, model.B)
        own = position @ apart[: position.shape[1]]
    else:
        position = static.position
        own = -np.linalg.lstsq(model.B, model.A @ apart, rcond=None)[0]
    return replace(static, v0=holding_commands(plant, states) - own, position=position)


@lru_cache(maxsize=8)  # every controller of a machine has it; plants compare by identity
def static_feedforward(plant: Plant) -> Feedforward:
    """Inertias, and v0(z): the forces that hold the machine along its travel against gravity and cogging.

    Without a stroke v0 is a constant; it stands at two positions of a grid that nothing looks up.
    """
    m, p, rates = len(plant.inputs), len(plant.outputs), plant.coordinates
    if plant.has_stroke:
        half = max(V0_STEPS, round(plant.stroke.travel / V0_STEP))
        z_grid = np.linspace(-plant.stroke.travel, plant.stroke.travel, 2 * half + 1)
        along = np.tile(plant.state({}), (len(z_grid), 1))
        along[:, plant.stroke_state] = z_grid
        v0 = load_balance(plant, along)
    else:
        z_grid = np.array([0.0, 1.0])
        v0 = np.tile(holding_commands(plant, np.zeros((1, len(plant.states)))), (2, 1))
    return Feedforward(np.array(plant.inertia), np.zeros((m, p)), np.zeros((rates, p)), z_grid, v0)
