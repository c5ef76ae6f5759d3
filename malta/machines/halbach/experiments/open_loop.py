"""The Halbach motor without feedback: stairs beside those under position control, and the linear servo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.machines.halbach import electronics, motor
from malta.machines.halbach.electronics import IDEAL, Pwm
from malta.machines.halbach.experiments.lift import FASTER, move_reference
from malta.model.plant import Plant
from malta.simulation.experiments import (
    QUIET,
    Experiment,
    Merit,
    PlannedRun,
    Progress,
    fly,
    rms,
    scenario_of,
)
from malta.simulation.references import Motion, Reference
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller
from malta.synthesis.riccati import sample

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


PWMS: Mapping[Pwm, str] = {"plain": "plain PWM", "fine": "high-resolution PWM"}
STAIR, LEVELS, STAY = 10e-6, 5, 100  # m, height of a stair; number of levels; readings on each


def stairs(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = STAIR,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Steps of 10 um, 5.5 s each: open loop and position control, with plain and with high-resolution PWM."""
    Ts = controller.sample_time
    reference = partial(stairs_reference, distance=distance, Ts=Ts)
    merits = partial(_stairs_merits, distance=distance)
    wanted = []
    for law in ("open loop", "position control"):
        for pwm, name in PWMS.items():
            parts = replace(IDEAL, pwm=pwm, current_loops=False)
            own = {"fidelity": "phase", "electronics": parts, "open_loop": law == "open loop"}
            scenario = scenario_of("stairs", LEVELS * STAY * Ts, reference, QUIET | own | options)
            wanted.append(PlannedRun(f"{law}, {name}", scenario, merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    believed: Any = controller.parameters
    printed = {"plain": "smallest_motion", "fine": "smallest_motion_fine"}
    found = []
    for pwm, name in PWMS.items():
        longest = float(electronics.dead_zones(believed, believed.F_z, pwm)[1].max())
        found.append(Merit(f"longest dead zone, {name}", longest, "um", f"open_loop.{printed[pwm]}"))
    return Experiment("stairs", "How small a motion can it make?", cases, tuple(found), interrupted=cut)


def stairs_reference(_: Plant, distance: float, Ts: float) -> Reference:
    """Stairs of `distance` (m), STAY readings long."""

    def at(t: FloatArray) -> Motion:
        p = distance * np.minimum(np.floor(np.asarray(t) / (STAY * Ts) + 1e-6), LEVELS - 1)[:, None]
        return Motion(p, 0 * p, 0 * p)

    return at


def positions_at_rest(run: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Mean and peak to peak of the position in the last second on each stair, m."""
    x = np.full(LEVELS * STAY, np.nan)
    x[: len(run.p)] = run.p[:, 0]
    late = x.reshape(LEVELS, STAY)[:, -STAY // 5 :]
    return late.mean(axis=1), np.ptp(late, axis=1)


def _stairs_merits(run: Trajectory, distance: float) -> tuple[Merit, ...]:
    """Heights of the stairs, the largest error of a stair, and the largest motion on one."""
    stands, swings = positions_at_rest(run)
    return (
        Merit("smallest stair", float(np.diff(stands).min()), "um", better="high"),
        Merit("largest stair", float(np.diff(stands).max()), "um", better=""),
        Merit("off its stair by", float(np.abs(stands - distance * np.arange(LEVELS)).max()), "um"),
        Merit("swing, peak to peak", float(swings.max()), "um"),
    )


IDENTIFIED, LASTS = 2e-3, 6.0  # m, s: step and duration of the identification
F_MOST = 1e4  # N, largest F_z to ask for: far beyond any supply, far from the largest float


def identify(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = IDENTIFIED,
    F_z: float = 1.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A step of the open loop at a vertical force of `F_z` (N), beside the linear servo (5) that was fitted to one."""
    par: Any = plant.parameters
    believed: Any = controller.parameters
    fast = controller.sample_time / FASTER
    commanding = replace(controller, sample_time=fast, parameters=replace(believed, F_z=F_z))
    own = {
        "fidelity": "phase",
        "electronics": replace(IDEAL, current_loops=False),
        "open_loop": True,
        "delay": 0,
    }
    scenario = scenario_of(
        "identify",
        LASTS,
        partial(move_reference, distance=distance, rise=0.0, begin=0.0),
        QUIET | own | options,
    )
    wanted = PlannedRun("motor", replace(scenario, start={"x": 0.0}), lambda _: ())
    (case,), cut = fly(plant, commanding, [wanted], progress, options)
    E, G = sample(*motor.servo(par, F_z, distance), fast)
    states = [np.zeros(2)]
    for _ in case.run.t[1:]:
        states.append(E @ states[-1] + G[:, 0] * distance)
    linear = np.array(states)[:, 0]
    off = linear - case.run.p[:, 0]
    merits = (
        Merit("linear servo off by, rms", rms(off), "mm"),
        Merit(
            "the same in the first 2 s", rms(off[case.run.t < 2]), "mm", key="linear_servo_off_by_rms_early"
        ),
        Merit("secant stiffness", motor.stiffness(par, F_z, distance), "N/m", "servo.K", better="high"),
        Merit("tangent stiffness", motor.stiffness(par, F_z), "N/m", better="high"),
    )
    return Experiment(
        "identify",
        "Is the motor a linear servo?",
        (case._replace(merits=merits),),
        merits,
        {"linear": linear},
        cut,
    )
