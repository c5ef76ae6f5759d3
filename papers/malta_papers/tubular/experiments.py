"""Experiments on MALTA that its paper shows or leaves open.

thermal       a drifting support, seen by an outside laser and compensated, Fig. 15
carrier       the stator moves sideways, its acceleration fed forward or not, Sec. IV-A
drive-limits  the fastest stroke that the drive allows, against the sigmoid at the same peak current
record-v0     v0(z) recorded by a slow stroke or from a log, beside the computed one
capture       displacements and tilts from which the mover returns, beside what the force limit allows
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta import InputError, references
from malta.arrays import FloatArray
from malta.machines.tubular import experiments as machine
from malta.machines.tubular.experiments.strokes import DISTANCE, delayed_stroke, stroke_merits
from malta.model import Plant
from malta.simulation import Experiment, Trajectory
from malta.simulation.experiments import NO_NOISE, Merit, PlannedRun, Progress, fly, rms, scenario_of
from malta.simulation.readings import keys, normals
from malta.simulation.scenario import Correction
from malta.synthesis import Controller
from malta_papers.tubular.capture import capture
from malta_papers.tubular.recording import record_v0

if TYPE_CHECKING:
    from malta.simulation.experiments.time_optimal import FastestStroke, SigmoidStroke


def thermal(
    plant: Plant,
    controller: Controller,
    *,
    drift: float = 65e-6,
    minute: float = 60.0,
    faster: float = 30.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The support drifts sideways by `drift` (m) over `minute` (s), run `faster` times as fast.

    A laser on a fixed support reads the mover's position in sensor plane 2 every 10 ms with 0.1 um of noise; half of
    each reading is subtracted from the reference of both planes.
    """
    duration, every, gain = minute / faster, 10e-3, 0.5
    moved = partial(_drift, drift=drift, duration=duration)
    merits = partial(_thermal_merits, moved=moved, late=duration / 10)
    wanted = []
    for label, share in (("compensated", gain), ("not compensated", 0.0)):
        laser = _Laser(moved, share, [0, 2], len(plant.outputs))
        scenario = scenario_of(
            "thermal", duration, references.hold, {"correction": Correction(every, laser)} | options
        )
        wanted.append(PlannedRun(label, scenario, merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    lag = drift / duration * every / gain
    found = (
        Merit("drift of the support", drift, "um", "thermal.drift"),
        Merit("lag if the mover goes where it is sent", lag, "um"),
        Merit("the same at the true speed", lag / faster, "um", key="lag_at_true_speed"),
    )
    curves = {"drift": moved(cases[0].run.t)}
    return Experiment("thermal", "Does it hold its place in space?", cases, found, curves, interrupted=cut)


def _thermal_merits(run: Trajectory, moved: Callable[[Any], Any], late: float) -> tuple[Merit, ...]:
    """Deviation in space from `late` (s) on."""
    outside = (run.p[:, 2] + moved(run.t))[run.t >= min(late, run.t[-1])]
    return (
        Merit("largest deviation in space", float(np.abs(outside).max()), "um"),
        Merit("rms deviation in space", rms(outside), "um"),
    )


def _drift(t: Any, drift: float, duration: float) -> Any:
    """Displacement of the support, m, at the times t."""
    return drift * np.asarray(t) / duration


class _Laser:
    """The outer loop of `thermal`: it integrates the laser's readings into an offset of the reference."""

    def __init__(self, moved: Callable[[Any], Any], gain: float, columns: list[int], size: int) -> None:
        self.moved, self.gain, self.columns = moved, gain, columns
        self.offset, self.readings = np.zeros(size), 0

    def __call__(self, t: float, p: FloatArray) -> FloatArray:
        noise = 0.1e-6 * float(normals(keys(0, np.array([self.readings]))[0], 1, 1)[0, 0])
        self.readings += 1
        self.offset[self.columns] -= self.gain * (p[2] + float(self.moved(t)) + noise)
        return self.offset.copy()


# MALTA on a carrier that accelerates sideways, with and without radial feedforward of the known acceleration.
#
# Sec. IV-A: the first four components of v_FF can counter "any known radial disturbances, e.g. when the MALTA is
# moved with parallel kinematics in pick-and-place robots". Reading: the stator moves along x by a known quintic, from
# rest to rest; seen from the stator, the inertial force -m a acts at the mover's centre of gravity. The acceleration
# is known at the sample at which it acts, not before.


BEGIN, TIME_AFTER = 0.02, 0.08  # s, before and after the carrier's move


FED_SHARES = {"not fed forward": 0.0, "fed forward": 1.0, "90 % fed forward": 0.9}  # of the acceleration


def carrier(
    plant: Plant,
    controller: Controller,
    *,
    carried: float = 0.1,
    within: float = 0.2,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The carrier moves sideways by `carried` (m) in `within` (s): at rest and during the published stroke, with the
    inertial force fed forward and without."""
    wanted = carrier_cases(plant, controller, carried=carried, within=within, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    t = np.arange(0, wanted[0].scenario.duration, controller.sample_time)
    acceleration = carrier_acceleration(t, carried, within)
    found = (
        Merit("largest acceleration of the carrier", float(np.abs(acceleration).max()), "m/s^2"),
        Merit("largest inertial force", float(plant.stroke.mass * np.abs(acceleration).max()), "N"),
    )
    curves = {"t": t, "acceleration": acceleration}
    return Experiment("carrier", "Does it ride along?", cases, found, curves, interrupted=cut)


def carrier_cases(
    plant: Plant, _: Controller, *, carried: float, within: float, **options: Any
) -> list[PlannedRun]:
    """The runs of `carrier`: at rest, and during the published stroke."""
    duration = BEGIN + within + TIME_AFTER
    wanted = []
    for place, reference in (("rest", references.hold), ("stroke", partial(delayed_stroke, wait=BEGIN))):
        for label, share in FED_SHARES.items():
            acts = partial(inertial_wrench, plant=plant, carried=carried, within=within)
            own: dict[str, Any] = {"disturbance": acts}
            own |= {"anticipated": partial(acts, share=share)} if share else {}
            scenario = scenario_of("carrier", duration, reference, own | options)
            wanted.append(PlannedRun(f"{place}, {label}", scenario, _carrier_merits))
    return wanted


def carrier_acceleration(t: FloatArray, carried: float, within: float) -> FloatArray:
    """Acceleration of the carrier at the times t, m/s^2: a quintic from rest to rest that begins at BEGIN."""
    _, __, shape = references.quintic(
        np.asarray(t) - BEGIN - within / 2, within / references.QUINTIC_DURATION
    )
    return carried * shape


def inertial_wrench(
    t: FloatArray, plant: Plant, carried: float, within: float, share: float = 1.0
) -> FloatArray:
    """The wrench on the mover as seen from the carrier, or a share of it, at the times t."""
    wrench = np.zeros((len(t), len(plant.disturbances)))
    column = [s.name for s in plant.disturbances].index("F_x")
    wrench[:, column] = -share * plant.stroke.mass * carrier_acceleration(t, carried, within)
    return wrench


def _carrier_merits(run: Trajectory) -> tuple[Merit, ...]:
    """Radial deviation and the bearing currents."""
    error, axis = run.p - run.reference, run.plant.stroke_output
    radial = error[:, [k for k in range(error.shape[1]) if k != axis]]
    bearings = [k for k in range(len(run.plant.inputs)) if k != run.plant.thrust_input]
    constant = np.array(run.plant.actuator.force_constant)[bearings]
    return (
        Merit("radial deviation", float(np.abs(radial).max()), "um"),
        Merit("rms of x1", rms(error[:, 0]), "um"),
        Merit("largest bearing current", float(np.abs(run.v[:, bearings] / constant).max()), "A"),
    )


# The fastest stroke that the drive allows.


def drive_limits(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = DISTANCE,
    current_share: float = 0.8,
    voltage_share: float = 0.7,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The fastest stroke within shares of the current and voltage limits (the rest is the feedback's), and the sigmoid
    whose peak current is the same."""
    best, sigmoid = _limit_strokes(plant, distance, current_share, voltage_share)
    wanted = _limit_cases(best, sigmoid, distance, options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    merits = (
        Merit("current limit used", current_share * plant.actuator.current_limit, "A"),
        Merit("voltage limit used", voltage_share * plant.actuator.voltage_limit, "V"),
        Merit("fastest stroke, from rest to rest", best.duration, "ms"),
        Merit("rise, sigmoid over fastest", sigmoid.rise / best.rise, "1", better=""),
        Merit(
            "travel, sigmoid over fastest", sigmoid.travel_time(1e-3) / best.travel_time(1e-3), "1", better=""
        ),
    )
    curves = {"t": best.t, "z": best.z, "u": best.u, "i": best.i}
    return Experiment("drive-limits", "How fast could it be?", cases, merits, curves, interrupted=cut)


@lru_cache(maxsize=16)  # the optimum takes a second, and every design of a machine has the same
def _limit_strokes(
    plant: Plant, distance: float, current_share: float, voltage_share: float
) -> tuple[FastestStroke, SigmoidStroke]:
    """The fastest stroke within shares of current and voltage, and the sigmoid of the same peak current."""
    # With scipy's integrators, for these experiments alone.
    from malta.simulation import fastest_stroke
    from malta.simulation.experiments.time_optimal import sigmoid_at_peak_current

    shares: dict[str, Any] = {"voltage_share": voltage_share, "current_share": current_share}
    emf = induced_per_speed(plant)
    return (
        fastest_stroke(plant, distance, emf, **shares),
        sigmoid_at_peak_current(plant, distance, emf, **shares),
    )


def _limit_cases(
    best: FastestStroke, sigmoid: SigmoidStroke, distance: float, options: dict[str, Any]
) -> list[PlannedRun]:
    """The runs of `drive-limits` for these two strokes."""
    duration = max(0.1, 6 * sigmoid.rise)
    ends: dict[str, Any] = {"start": -distance / 2, "end": distance / 2}
    logistic = partial(references.stroke, **ends, rise=sigmoid.rise, centre=duration / 2)
    fast = partial(best.reference, centre=duration / 2)
    wanted: list[PlannedRun] = []
    for label, reference, found in (("fastest", fast, best), ("sigmoid", logistic, sigmoid)):
        scenario = scenario_of("drive-limits", duration, reference, NO_NOISE | options)
        wanted.append(PlannedRun(label, scenario, partial(_limit_merits, found=found)))
    return wanted


def drive_limit_cases(
    plant: Plant,
    _: Controller,
    *,
    distance: float,
    current_share: float,
    voltage_share: float,
    **options: Any,
) -> list[PlannedRun]:
    """The runs of `drive-limits` for a campaign."""
    return _limit_cases(*_limit_strokes(plant, distance, current_share, voltage_share), distance, options)


def _limit_merits(run: Trajectory, found: FastestStroke | SigmoidStroke) -> tuple[Merit, ...]:
    """Rise and travel time of the reference, and the figures of the stroke."""
    return (
        Merit("reference: rise, 10-90 %", found.rise, "ms", better=""),
        Merit(
            "reference: 0.1 to 99.9 % of travel",
            found.travel_time(1e-3),
            "ms",
            key="reference_travel_time",
            better="",
        ),
        *stroke_merits(run, published=False),
    )


def induced_per_speed(plant: Plant) -> float:
    """Induced voltage of the thrust axes over the speed of the stroke, V s/m."""
    rate = plant.states[len(plant.states) // 2 + plant.stroke_state].name
    return float(np.abs(np.array(ca.evalf(plant.drive.emf(ca.SX(ca.DM(plant.at(**{rate: 1.0}).x)))))).max())


EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "thermal": thermal,
    "drive-limits": drive_limits,
    "record-v0": record_v0,
    "carrier": carrier,
    "capture": capture,
}
CASES: dict[str, Callable[..., list[PlannedRun]]] = {
    "drive-limits": drive_limit_cases,
    "carrier": carrier_cases,
}
MAX_POINTS = 201  # of a side of a map
MIN_STROKE_TIME, MAX_STROKE_TIME = 0.5, 60.0  # s, of one way of the slow stroke
FINDINGS = ("carrier", "capture")
OPTION_UNITS = {"drift": "m", "minute": "s", "carried": "m", "within": "s", "way": "s", "phase_error": "rad"}


def check(name: str, option: str, value: Any) -> None:
    """Raise InputError for a number outside the range of an option. Logs check themselves."""
    if option == "points" and not (isinstance(value, int) and 3 <= value <= MAX_POINTS):
        expected = f"a whole number from 3 to {MAX_POINTS}"
        raise InputError("simulate", f"{name}: points", f"{value:g}", expected)
    if option == "way" and not MIN_STROKE_TIME <= value <= MAX_STROKE_TIME:
        expected = f"a time from {MIN_STROKE_TIME:g} to {MAX_STROKE_TIME:g} s"
        raise InputError("simulate", f"{name}: way", f"{value:g} s", expected)
    if option == "log" or (option == "phase_error" and value == 0):  # no machines with displaced cogging
        return
    machine.check(name, option, value)
