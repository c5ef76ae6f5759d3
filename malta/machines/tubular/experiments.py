"""The experiments on MALTA.

stroke        the published move, Figs 12 and 13
hold          2000 samples at rest with sensor noise, Fig. 14 and Table III
tilt          a circle in sensor plane 1, sensor plane 2 held, Fig. 16 and eq. (21)
lift-off      from rest on the touchdown bearing, by each start-up estimator
payload       masses picked during a hold, and a stroke with them
thermal       a drifting support, seen by an outside laser and compensated, Fig. 15
disturbance   force and torque steps, vibration of the housing, compliance over frequency
faults        sensors, samples, a phase, the DC link: what survives and what touches down
drive-limits  the fastest stroke that the drive allows, against the sigmoid at the same peak current
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from malta.errors import InputError
from malta.model.plant import Plant, trim
from malta.simulation import references
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
from malta.simulation.noise import keys, normals
from malta.simulation.references import Motion, Profile, Reference
from malta.simulation.responses import (
    amplitude,
    compliance,
    sine_wrench,
    step_wrench,
)
from malta.simulation.scenario import ESTIMATORS, FEEDFORWARDS, Correction, Fault, Scenario
from malta.simulation.time_optimal import (
    FastestStroke,
    SigmoidStroke,
    fastest_stroke,
    sigmoid_at_peak_current,
)
from malta.simulation.trajectory import Trajectory, stroke_figures
from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

DISTANCE, RISE = 10e-3, 16.2e-3  # m, s from 10 to 90 %: the published stroke, Fig. 12


def stroke(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = DISTANCE,
    rise: float = RISE,
    profile: Profile = "logistic",
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The published stroke: tracking, radial deviation, currents, and K_D as the ratio of force and current."""
    wanted = _stroke_cases(plant, controller, distance=distance, rise=rise, profile=profile, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    return Experiment("stroke", "Does it follow the stroke?", cases, cases[0].merits, interrupted=cut)


def _stroke_cases(
    _: Plant, __: Controller, *, distance: float, rise: float, profile: Profile, **options: Any
) -> list[PlannedRun]:
    asked = {name: value for name, value in options.items() if name != "engine"}
    scenario = Scenario.stroke(distance, rise=rise, profile=profile, **asked)
    published = distance == DISTANCE and rise == RISE
    return [PlannedRun("stroke", scenario, partial(stroke_merits, published=published))]


def stroke_merits(run: Trajectory, *, published: bool = True) -> tuple[Merit, ...]:
    """Rise, overshoot, errors, drive constant, heat and efficiency; `published`: of the stroke that the paper shows."""
    f = stroke_figures(run)
    merits = [
        Merit("rise, 10-90 %", f.rise, "ms", "figure_12.rise_time"),
        Merit("overshoot", f.overshoot, "percent", "figure_12.overshoot", "at most"),
        Merit("axial error", f.axial_error, "mm", "figure_12.axial_error", "at most"),
    ]
    bound = "figure_13.radial_deviation"
    merits += [Merit(f"deviation {name}", value, "um", bound, "at most") for name, value in f.radial.items()]
    merits += [
        Merit("largest thrust", f.force, "N"),
        Merit("largest commanded current", f.current, "A"),
        Merit("drive constant per module, f / i", drive_constant(run), "N/A", "figure_12.drive_constant"),
        Merit("heat in the windings", float(run.copper_loss.sum()) * run.controller.sample_time, "J"),
    ]
    if run.u.size:
        merits += [
            Merit("efficiency while it accelerates", efficiency(run), "percent"),
            Merit("largest voltage of an axis", float(np.abs(run.u).max()), "V"),
            Merit("lowest voltage of the DC link", float(run.link.min()), "V"),
        ]
    return tuple(merits) if published else tuple(merit._replace(published="") for merit in merits)


def drive_constant(run: Trajectory) -> float:
    """Thrust over thrust current, N/A, for one of the windings that share it: the slope through all samples."""
    plant = run.plant
    unit = np.zeros(len(plant.inputs))
    unit[plant.thrust_input] = 1.0
    shares = np.flatnonzero(np.array(ca.DM(plant.drive.command(ca.DM(unit)))).ravel())
    i, f = run.axis_currents[:, shares[0]], run.force[:, plant.thrust_input]
    return float(i @ f / (i @ i)) / len(shares)


def efficiency(run: Trajectory) -> float:
    """Mechanical over electrical energy while the thrust drives the motion and the windings draw power.

    At most K_D / (4.5 K_ind) on MALTA, 66 %, because the two measured constants do not balance.
    """
    speed = run.x[:, len(run.plant.states) // 2 + run.plant.stroke_state]
    mechanical, electrical = run.force[:, run.plant.thrust_input] * speed, run.electrical_power
    driving = (mechanical > 0) & (electrical > 0)
    drawn = float(electrical[driving].sum())
    return float(mechanical[driving].sum()) / drawn if drawn else math.nan


def hold(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Rest at the middle with sensor noise: statistics of the last 2000 measured samples, and the true motion."""
    cases, cut = fly(plant, controller, _hold_cases(plant, controller, **options), progress, options)
    return Experiment("hold", "How still does it stand?", cases, cases[0].merits, interrupted=cut)


def _hold_cases(_: Plant, controller: Controller, **options: Any) -> list[PlannedRun]:
    scenario = scenario_of("hold", (RESTING + 6000) * controller.sample_time, references.hold, options)
    return [PlannedRun("hold", scenario, _rest_merits)]


RESTING = 2000  # samples, Table III


def _rest_merits(run: Trajectory) -> tuple[Merit, ...]:
    plant, y, p, v = run.plant, run.y[-RESTING:], run.p[-RESTING:], run.v[-RESTING:]
    names = [signal.name for signal in plant.outputs]
    bearings = [k for k in range(len(plant.inputs)) if k != plant.thrust_input]
    return (
        *(
            Merit(f"measured {n}, std", float(y[:, k].std()), "um", f"table_III.std.{n}")
            for k, n in enumerate(names)
        ),
        *(
            Merit(f"measured {n}, mean", float(y[:, k].mean()), "um", f"table_III.mean.{n}")
            for k, n in enumerate(names)
        ),
        *(Merit(f"true {n}, rms", rms(p[:, k]), "um") for k, n in enumerate(names)),
        Merit("bearing force, rms about its mean", rms((v - v.mean(axis=0))[:, bearings]), "N"),
    )


def tilt(
    plant: Plant,
    controller: Controller,
    *,
    radius: float = 200e-6,
    frequency: float = 2.0,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Eq. (21): a circle of `radius` (m) at `frequency` (Hz) in sensor plane 1, the other plane held at its centre.

    As the paper, and with the attraction at the reference fed forward.
    """
    wanted = _tilt_cases(plant, controller, radius=radius, frequency=frequency, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    return Experiment("tilt", "Does it tilt about sensor plane 2?", cases, (), interrupted=cut)


def _tilt_cases(
    _: Plant, __: Controller, *, radius: float, frequency: float, **options: Any
) -> list[PlannedRun]:
    kinds = [options["feedforward"]] if "feedforward" in options else list(FEEDFORWARDS)
    reference = partial(references.circle, radius=radius, frequency=frequency)
    merits = partial(_tilt_merits, settled=1 / frequency)
    return [
        PlannedRun(
            f"feedforward {kind}",
            scenario_of(
                "tilt", 2 / frequency, reference, {"start": AT_REST} | options | {"feedforward": kind}
            ),
            merits,
        )
        for kind in kinds
    ]


AT_REST = dict.fromkeys(("x", "y", "alpha", "beta", "x_dot", "y_dot", "alpha_dot", "beta_dot"), 0.0)


def _tilt_merits(run: Trajectory, settled: float) -> tuple[Merit, ...]:
    late = run.t >= min(settled, run.t[-1])
    error, bound = (run.p - run.reference)[late], ("um", "figure_16.deviation", "at most")
    return (
        Merit("SP2: largest deviation, true", float(np.hypot(error[:, 2], error[:, 3]).max()), *bound),
        Merit("SP2: largest deviation, measured", float(np.abs(run.y[late][:, 2:4]).max()), *bound),
        Merit("SP1: largest tracking error, true", float(np.hypot(error[:, 0], error[:, 1]).max()), "um"),
        Merit("largest bearing force", float(np.abs(run.v[:, :4]).max()), "N"),
    )


def lift_off(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """From rest on the touchdown bearing, without current; the observer takes the mover to be at the centre.

    One run for each start-up estimator, or the one that options name.
    """
    wanted = _lift_cases(plant, controller, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    current = break_away_current(plant, wanted[0].scenario.start)
    needed = Merit("current per module that lifts it, statics", current, "A")
    return Experiment("lift-off", "Does it rise from its bearing?", cases, (needed,), interrupted=cut)


def _lift_cases(plant: Plant, _: Controller, **options: Any) -> list[PlannedRun]:
    resting = rest_on_bearing(plant)
    kinds = [options["estimator"]] if "estimator" in options else list(ESTIMATORS)
    own = {"start": resting, "cold": True, "bearing": True}
    reference = partial(rise_from, start=resting)
    return [
        PlannedRun(
            kind, scenario_of("lift-off", 0.15, reference, own | options | {"estimator": kind}), _lift_merits
        )
        for kind in kinds
    ]


def rise_from(plant: Plant, start: Mapping[str, float], duration: float = 30e-3) -> Reference:
    """From where it rests to the centre, a quintic of `duration` (s)."""
    first = np.array(plant.h(ca.DM(plant.at(**start).x), 0)).ravel()

    def at(t: FloatArray) -> Motion:
        s, ds, dds = references.quintic(np.asarray(t) - duration / 2, duration / references.QUINTIC_DURATION)
        return Motion(np.outer(1 - s, first), np.outer(-ds, first), np.outer(-dds, first))

    return at


def rest_on_bearing(plant: Plant) -> dict[str, float]:
    """The state in which the mover lies on its touchdown bearings, without current."""
    names = [s.name for s in plant.states]
    downward = int(np.argmax(np.abs(np.array(ca.evalf(plant.load(ca.SX(ca.DM(plant.at().x)))))[:3, 0])))
    free = plant.states[downward].name
    x = ca.SX.sym("x", len(names))
    force = ca.Function(
        "force", [x], [plant.f(x, ca.SX.zeros(len(plant.inputs)), plant.load(x) + plant.bearing(x))]
    )

    def net(depth: float) -> float:
        return float(force(plant.at(**{free: -depth}).x)[len(names) // 2 + downward])

    edge = brentq(
        lambda depth: float(ca.evalf(plant.contact(ca.SX(ca.DM(plant.at(**{free: -depth}).x))))[0]) - 1, 0, 1
    )
    return {free: -float(brentq(net, edge, 1.5 * edge, xtol=1e-15))}


def break_away_current(plant: Plant, resting: Mapping[str, float]) -> float:
    """Current of each bearing axis, A, whose forces balance weight and attraction where the mover rests."""
    x, u = ca.SX.sym("x", len(plant.states)), ca.SX.sym("u", len(plant.inputs))
    rate = ca.Function(
        "rate", [x, u], [plant.f(x, u, plant.load(x)), ca.jacobian(plant.f(x, u, plant.load(x)), u)]
    )
    pull, G = (np.array(value) for value in rate(plant.at(**resting).x, 0))
    forces = np.linalg.lstsq(G, -pull, rcond=None)[0].ravel()
    return float(np.abs(forces / np.array(plant.actuator.force_constant)).max())


def _lift_merits(run: Trajectory) -> tuple[Merit, ...]:
    free = (run.contact[:, :2] < 1).all(axis=1)
    lifted = float(run.t[int(np.argmax(free))]) if free.any() else math.nan
    late = np.flatnonzero(np.abs(run.p[:, :4]).max(axis=1) > 20e-6)
    settled = float(run.t[late[-1]]) if len(late) and late[-1] + 1 < len(run.t) else math.nan
    return (
        Merit("off the bearing after", lifted, "ms"),
        Merit("within 20 um after", settled, "ms"),
        Merit("beyond the centre", max(float(run.p[:, [1, 3]].max()), 0.0), "um"),
        Merit("off its path", float(np.abs(run.p - run.reference)[:, :4].max()), "um"),
        Merit("largest bearing current", _bearing_current(run), "A"),
    )


def _bearing_current(run: Trajectory) -> float:
    """Largest acting current of a bearing axis, A."""
    others = [k for k in range(len(run.plant.inputs)) if k != run.plant.thrust_input]
    return float(np.abs(run.force[:, others] / np.array(run.plant.actuator.force_constant)[others]).max())


def payload(
    plant: Plant,
    controller: Controller,
    *,
    masses: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2),
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """A mass (kg) picked at the centre of gravity after 50 ms of a hold, carried, and moved through the stroke.

    The controller does not learn of it. The integrals have 0.45 s before the stroke begins.
    """
    reference = partial(late_stroke, wait=WAIT)
    wanted = []
    for extra in masses:
        own = {"changes": ((PICKED, {"m": plant.mass + extra}),), "bearing": True}
        scenario = scenario_of("payload", WAIT + 0.15, reference, own | options)
        wanted.append(PlannedRun(f"{extra * 1e3:.0f} g", scenario, _payload_merits))
    cases, cut = fly(plant, controller, wanted, progress, options)
    carried = max((m for m, c in zip(masses, cases, strict=False) if c.run.verdict.completed), default=0.0)
    merit = Merit("largest of these carried and moved", carried, "kg", "position_controller.payload")
    return Experiment("payload", "What can it pick and move?", cases, (merit,), interrupted=cut)


PICKED, WAIT = 0.05, 0.5  # s: the mass is picked, the stroke begins


def _payload_merits(run: Trajectory) -> tuple[Merit, ...]:
    error, axis = np.abs(run.p - run.reference), run.plant.stroke_output
    carrying, moving = (run.t >= PICKED) & (run.t < WAIT), run.t >= WAIT
    radial = [k for k in range(error.shape[1]) if k != axis]
    return (
        Merit("largest sag after the pick", float(error[carrying][:, radial].max(initial=0.0)), "um"),
        Merit("stroke: axial error", float(error[moving][:, axis].max(initial=0.0)), "mm"),
        Merit("stroke: radial deviation", float(error[moving][:, radial].max(initial=0.0)), "um"),
    )


def late_stroke(plant: Plant, wait: float, distance: float = DISTANCE) -> Reference:
    """Held at the start of the published stroke, which is half-way 50 ms after `wait` (s)."""
    return references.stroke(plant, -distance / 2, distance / 2, RISE, wait + 0.05)


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

    A laser on a support of its own reads the mover in sensor plane 2 every 10 ms with 0.1 um of noise; half of what it
    reads is taken off the reference of both planes.
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
        Merit("the same at the true speed", lag / faster, "um"),
    )
    curves = {"drift": moved(cases[0].run.t)}
    return Experiment("thermal", "Does it hold its place in space?", cases, found, curves, interrupted=cut)


def _thermal_merits(run: Trajectory, moved: Callable[[Any], Any], late: float) -> tuple[Merit, ...]:
    outside = (run.p[:, 2] + moved(run.t))[run.t >= min(late, run.t[-1])]
    return (
        Merit("largest deviation in space", float(np.abs(outside).max()), "um"),
        Merit("rms deviation in space", rms(outside), "um"),
    )


def _drift(t: Any, drift: float, duration: float) -> Any:
    return drift * np.asarray(t) / duration


class _Laser:
    """The outer loop of `thermal`: an integrator on what the laser reads."""

    def __init__(self, moved: Callable[[Any], Any], gain: float, columns: list[int], size: int) -> None:
        self.moved, self.gain, self.columns = moved, gain, columns
        self.offset, self.readings = np.zeros(size), 0

    def __call__(self, t: float, p: FloatArray) -> FloatArray:
        noise = 0.1e-6 * float(normals(keys(0, np.array([self.readings]))[0], 1, 1)[0, 0])
        self.readings += 1
        self.offset[self.columns] -= self.gain * (p[2] + float(self.moved(t)) + noise)
        return self.offset.copy()


def disturbance(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Steps of force and torque, vibration of the housing, sines of force; the linear loop's compliance beside them."""
    wanted = _disturbance_cases(plant, controller, **options)
    cases, cut = fly(plant, controller, wanted, progress, options)
    steps, sines = cases[:4], cases[4:]
    w = np.geomspace(0.01, 2000, 600) * 2 * math.pi
    curve = compliance(plant, controller, w)
    worst = int(curve.argmax())
    found = (
        Merit("largest compliance, x1 to F_x", float(curve[worst]), "um/N"),
        Merit("at", float(w[worst] / (2 * math.pi)), "Hz"),
        Merit("smallest dynamic stiffness", float(1 / curve[worst]), "N/um"),
    )
    curves = {
        "frequency": w / (2 * math.pi),
        "compliance": curve,
        "tones": np.array(TONES[: len(sines)]),
        "simulated": np.array(
            [case.merits[0].value / TONE_FORCE if case.run.verdict.completed else np.nan for case in sines]
        ),
    }
    return Experiment("disturbance", "How stiff is it?", steps, found, curves, interrupted=cut)


def _disturbance_cases(plant: Plant, _: Controller, **options: Any) -> list[PlannedRun]:
    names = [s.name for s in plant.disturbances]
    outputs = [s.name for s in plant.outputs]
    wanted: list[PlannedRun] = []
    for name, size, seen in (("F_x", 1.0, "x1"), ("F_z", 1.0, plant.stroke), ("T_y", 0.05, "x1")):
        push = partial(step_wrench, column=names.index(name), size=size, at=0.02, width=len(names))
        scenario = scenario_of("disturbance", 0.4, references.hold, QUIET | {"disturbance": push} | options)
        unit = plant.disturbances[names.index(name)].unit
        merits = partial(_step_merits, output=outputs.index(seen))
        wanted.append(PlannedRun(f"step of {size:g} {unit} {name}", scenario, merits))
    shake = partial(sine_wrench, column=names.index("F_y"), size=plant.mass, frequency=50.0, width=len(names))
    vibration = scenario_of("vibration", 0.3, references.hold, QUIET | {"disturbance": shake} | options)
    shaken = partial(_sine_merits, output=outputs.index("y1"), frequency=50.0)
    wanted.append(PlannedRun("housing shaken by 1 m/s2 at 50 Hz along y", vibration, shaken))
    for f in TONES:
        push = partial(sine_wrench, column=names.index("F_x"), size=TONE_FORCE, frequency=f, width=len(names))
        scenario = scenario_of(
            "sine", 2 * max(0.1, 4 / f), references.hold, QUIET | {"disturbance": push} | options
        )
        found = partial(_sine_merits, output=outputs.index("x1"), frequency=f)
        wanted.append(PlannedRun(f"{f:g} Hz", scenario, found))
    return wanted


TONES, TONE_FORCE = (5.0, 20.0, 60.0, 150.0, 400.0), 0.5  # Hz, N


def _step_merits(run: Trajectory, output: int) -> tuple[Merit, ...]:
    error = np.abs(run.p[:, output])
    return (
        Merit(f"largest deflection of {run.plant.outputs[output].name}", float(error.max()), "um"),
        Merit("left at the end", float(error[-1]), "um"),
    )


def _sine_merits(run: Trajectory, output: int, frequency: float) -> tuple[Merit, ...]:
    return (Merit(f"amplitude of {run.plant.outputs[output].name}", amplitude(run, output, frequency), "um"),)


def faults(
    plant: Plant,
    controller: Controller,
    *,
    during: str = "stroke",
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """Each fault strikes where the published stroke accelerates most, or during a hold. Touchdown bearings catch the
    mover; 0.25 s are left."""
    if during not in ("stroke", "hold"):
        raise InputError("simulate", "faults: during", repr(during), "stroke or hold")
    at, Ts = 0.05, controller.sample_time
    eps = Ts / 4  # faults begin and end between samples
    # A logistic of slope k accelerates most ln(2 + sqrt 3) / k before it is half-way; k = 2 ln 9 / rise.
    early = math.log(2 + math.sqrt(3)) * RISE / (2 * math.log(9))
    reference = partial(late_stroke, wait=at + early - 0.05) if during == "stroke" else references.hold
    sensor = plant.outputs[1].name
    phase = plant.drive.phases[_most_loaded(plant)].name
    listed: dict[str, tuple[Fault, ...]] = {
        "one sample lost": (Fault("lost sample", at - eps, at + Ts - eps),),
        "10 samples lost": (Fault("lost sample", at - eps, at + 10 * Ts - eps),),
        "50 samples lost": (Fault("lost sample", at - eps, at + 50 * Ts - eps),),
        "one control step missed": (Fault("missed step", at - eps, at + Ts - eps),),
        "10 control steps missed": (Fault("missed step", at - eps, at + 10 * Ts - eps),),
        "50 control steps missed": (Fault("missed step", at - eps, at + 50 * Ts - eps),),
        f"{sensor} stuck for 5 ms": (Fault("stuck sensor", at, at + 5e-3, sensor),),
        f"{sensor} stuck": (Fault("stuck sensor", at, math.inf, sensor),),
        f"{sensor} biased by 50 um": (Fault("biased sensor", at, math.inf, sensor, 50e-6),),
        "noise of all sensors x 10": tuple(
            Fault("noisy sensor", at, math.inf, s.name, 10.0) for s in plant.outputs
        ),
        f"phase {phase.removeprefix('i_')} open": (Fault("open phase", at, math.inf, phase),),
        "DC link sags by 50 % for 50 ms": (Fault("link sag", at, at + 50e-3, size=0.5),),
        "DC link sags by 90 % for 50 ms": (Fault("link sag", at, at + 50e-3, size=0.9),),
    }
    wanted = []
    for label, struck in listed.items():
        own: dict[str, Any] = {"faults": struck, "bearing": True} | options
        if any(fault.kind == "open phase" for fault in struck):
            own["fidelity"] = "phase"
        scenario = scenario_of("faults", 0.3, reference, own)
        wanted.append(PlannedRun(label, scenario, partial(_fault_merits, at=at)))
    cases, cut = fly(plant, controller, wanted, progress, options)
    survived = float(sum(case.run.verdict.completed for case in cases))
    merit = Merit(f"survived, of {len(cases)}", survived, "1")
    return Experiment("faults", "What does it survive?", cases, (merit,), interrupted=cut)


def _most_loaded(plant: Plant) -> int:
    """The phase that carries most at the middle, where the weight is held."""
    held = ca.DM(trim(plant).u / np.array(plant.actuator.force_constant))
    i = np.array(ca.DM(plant.drive.to_phases(ca.DM(plant.at().x)) @ plant.drive.command(held))).ravel()
    return int(np.abs(i).argmax())


def _fault_merits(run: Trajectory, at: float) -> tuple[Merit, ...]:
    others = [k for k in range(run.p.shape[1]) if k != run.plant.stroke_output]
    radial = np.abs(run.p[run.t >= min(at, run.t[-1])][:, others])
    after = run.verdict.time - at
    touched = after if after >= 0 and not run.verdict.completed else math.nan
    return (
        Merit("largest deviation", float(radial.max()), "um"),
        Merit("touchdown after", touched, "ms"),
        Merit("deviation at the end", float(radial[-1].max()), "um"),
    )


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
        Merit("rise, sigmoid over fastest", sigmoid.rise / best.rise, "1"),
        Merit("travel, sigmoid over fastest", sigmoid.travel_time(1e-3) / best.travel_time(1e-3), "1"),
    )
    curves = {"t": best.t, "z": best.z, "u": best.u, "i": best.i}
    return Experiment("drive-limits", "How fast could it be?", cases, merits, curves, interrupted=cut)


def _limit_strokes(
    plant: Plant, distance: float, current_share: float, voltage_share: float
) -> tuple[FastestStroke, SigmoidStroke]:
    shares: dict[str, Any] = {"voltage_share": voltage_share, "current_share": current_share}
    emf = induced_per_speed(plant)
    return (
        fastest_stroke(plant, distance, emf, **shares),
        sigmoid_at_peak_current(plant, distance, emf, **shares),
    )


def _limit_cases(
    best: FastestStroke, sigmoid: SigmoidStroke, distance: float, options: dict[str, Any]
) -> list[PlannedRun]:
    duration = max(0.1, 6 * sigmoid.rise)
    ends: dict[str, Any] = {"start": -distance / 2, "end": distance / 2}
    logistic = partial(references.stroke, **ends, rise=sigmoid.rise, centre=duration / 2)
    fast = partial(best.reference, centre=duration / 2)
    wanted: list[PlannedRun] = []
    for label, reference, found in (("fastest", fast, best), ("sigmoid", logistic, sigmoid)):
        scenario = scenario_of("drive-limits", duration, reference, QUIET | options)
        wanted.append(PlannedRun(label, scenario, partial(_limit_merits, found=found)))
    return wanted


def _limits(
    plant: Plant,
    _: Controller,
    *,
    distance: float,
    current_share: float,
    voltage_share: float,
    **options: Any,
) -> list[PlannedRun]:
    return _limit_cases(*_limit_strokes(plant, distance, current_share, voltage_share), distance, options)


def _limit_merits(run: Trajectory, found: FastestStroke | SigmoidStroke) -> tuple[Merit, ...]:
    return (
        Merit("reference: rise, 10-90 %", found.rise, "ms"),
        Merit("reference: 0.1 to 99.9 % of travel", found.travel_time(1e-3), "ms"),
        *stroke_merits(run, published=False),
    )


def induced_per_speed(plant: Plant) -> float:
    """Voltage induced in the thrust axes per speed of the stroke, V s/m."""
    rate = plant.states[len(plant.states) // 2 + plant.stroke_state].name
    return float(np.abs(np.array(ca.evalf(plant.drive.emf(ca.SX(ca.DM(plant.at(**{rate: 1.0}).x)))))).max())


EXPERIMENTS: dict[str, Callable[..., Experiment]] = {
    "stroke": stroke,
    "hold": hold,
    "tilt": tilt,
    "lift-off": lift_off,
    "payload": payload,
    "thermal": thermal,
    "disturbance": disturbance,
    "faults": faults,
    "drive-limits": drive_limits,
}
# Their cases ask the same of the machine from beginning to end.
CASES: dict[str, Callable[..., list[PlannedRun]]] = {
    "stroke": _stroke_cases,
    "hold": _hold_cases,
    "tilt": _tilt_cases,
    "lift-off": _lift_cases,
    "disturbance": _disturbance_cases,
    "drive-limits": _limits,
}
FINDINGS = ("payload", "disturbance", "faults")
ALONE = ("stroke", "hold", "tilt")
WORDS = {"stroke": "axial", "m": "radial", "thrust": "thrust", "N": "bearing force"}
STROKE_UNIT = "mm"
OPTION_UNITS = {
    "distance": "m",
    "rise": "s",
    "radius": "m",
    "frequency": "Hz",
    "masses": "kg",
    "drift": "m",
    "minute": "s",
}


def check(name: str, option: str, value: Any) -> None:
    """InputError for a number without a sense. A stroke's own are looked at where it is made."""
    if option in ("distance", "rise", "profile", "during"):
        return
    if not all(math.isfinite(v) and v for v in (value if option == "masses" else (value,))):
        raise InputError("simulate", f"{name}: {option}", repr(value), "finite, other than 0")


def bounds(scenario: str, options: Mapping[str, Any]) -> dict[str, str]:
    """What the paper prints of the published stroke."""
    asked = {"distance": DISTANCE, "rise": RISE, "profile": "logistic"}
    if scenario != "stroke" or any(options.get(name, value) != value for name, value in asked.items()):
        return {}
    return {
        "rise": "figure_12.rise_time",
        "overshoot": "figure_12.overshoot",
        "stroke": "figure_12.axial_error",
        "m": "figure_13.radial_deviation",
    }
