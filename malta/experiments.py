"""The experiments on a levitated machine, each by name: what is run, and its figures of merit.

An experiment is a function (plant, controller, **options) -> Experiment. Options are fields of simulate.Scenario that
replace the experiment's own (fidelity, noise, seed, estimator, ...), and those that its signature names.

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
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
from scipy.optimize import brentq

from malta import references
from malta.controller import Controller
from malta.errors import InputError
from malta.fastest import FastestStroke, SigmoidStroke, fastest_stroke, sigmoid_at_peak_current
from malta.linearize import linearize
from malta.noise import keys, normals
from malta.plant import Plant
from malta.references import Motion, Reference
from malta.simulate import (
    ESTIMATORS,
    FEEDFORWARDS,
    RISE,
    Correction,
    Fault,
    Scenario,
    Trajectory,
    simulate,
    stroke_figures,
)
from malta.verify import machine_loop

if TYPE_CHECKING:
    from malta.plant import FloatArray

Progress = Callable[[float], None]
REAL: dict[str, Any] = {
    "noise": 1.0,
    "quantize": True,
    "sensor_errors": {},
}  # sensors as built, no errors of their own
QUIET: dict[str, Any] = {"noise": 0.0, "quantize": False, "sensor_errors": None}


class Merit(NamedTuple):
    """A figure of merit: SI value, the unit to show it in, and where the paper prints its own."""

    label: str
    value: float
    unit: str
    published: str = ""  # key of data/published/
    relation: str = "about"  # of ours to the published: "about" or "at most"


class Case(NamedTuple):
    """One of several runs of an experiment."""

    label: str
    run: Trajectory
    merits: tuple[Merit, ...]


@dataclass(frozen=True, eq=False)
class Experiment:
    """What an experiment found."""

    name: str
    question: str
    cases: tuple[Case, ...]
    merits: tuple[Merit, ...]
    curves: Mapping[str, FloatArray] = field(default_factory=dict)  # what is drawn beside the runs

    @property
    def run(self) -> Trajectory:
        """The first run."""
        return self.cases[0].run

    @property
    def completed(self) -> bool:
        """Whether every run came to its end."""
        return all(case.run.verdict.completed for case in self.cases)


def stroke(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """The published stroke: tracking, radial deviation, currents, and K_D as the ratio of force and current."""
    run = simulate(plant, controller, Scenario.stroke(**options), progress=progress)
    merits = stroke_merits(run)
    return Experiment("stroke", "Does it follow the stroke?", (Case("stroke", run, merits),), merits)


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
    """Mechanical over electrical energy while the thrust drives the motion and the windings draw power."""
    speed = run.x[:, len(run.plant.states) // 2 + run.plant.stroke_state]
    mechanical, electrical = run.force[:, run.plant.thrust_input] * speed, run.electrical_power
    driving = (mechanical > 0) & (electrical > 0)
    drawn = float(electrical[driving].sum())
    return float(mechanical[driving].sum()) / drawn if drawn else math.nan


def hold(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Rest at the middle with sensor noise: statistics of the last 2000 measured samples, and the true motion."""
    samples, settle = 2000, 6000
    duration = (samples + settle) * controller.sample_time
    run = simulate(
        plant, controller, _scenario("hold", duration, references.hold, options), progress=progress
    )
    last_y, last_p = run.y[-samples:], run.p[-samples:]
    merits = []
    for k, signal in enumerate(plant.outputs):
        merits.append(
            Merit(
                f"measured {signal.name}, std",
                float(last_y[:, k].std()),
                "um",
                f"table_III.std.{signal.name}",
            )
        )
    for k, signal in enumerate(plant.outputs):
        merits.append(
            Merit(
                f"measured {signal.name}, mean",
                float(last_y[:, k].mean()),
                "um",
                f"table_III.mean.{signal.name}",
            )
        )
    for k, signal in enumerate(plant.outputs):
        merits.append(Merit(f"true {signal.name}, rms", _rms(last_p[:, k]), "um"))
    radial = [k for k in range(len(plant.inputs)) if k != plant.thrust_input]
    merits.append(
        Merit(
            "bearing force, rms about its mean",
            _rms(run.v[-samples:, radial] - run.v[-samples:, radial].mean(axis=0)),
            "N",
        )
    )
    return Experiment("hold", "How still does it stand?", (Case("hold", run, tuple(merits)),), tuple(merits))


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
    kinds = [options.pop("feedforward")] if "feedforward" in options else list(FEEDFORWARDS)
    duration = 2 / frequency
    reference = partial(references.circle, radius=radius, frequency=frequency)
    cases = []
    for n, kind in enumerate(kinds):
        scenario = _scenario("tilt", duration, reference, {"start": AT_REST, "feedforward": kind} | options)
        run = simulate(plant, controller, scenario, progress=_share(progress, n, len(kinds)))
        settled = run.t >= min(duration / 2, run.t[-1])
        error = (run.p - run.reference)[settled]
        bound = ("um", "figure_16.deviation", "at most")
        merits = (
            Merit("SP2: largest deviation, true", float(np.hypot(error[:, 2], error[:, 3]).max()), *bound),
            Merit("SP2: largest deviation, measured", float(np.abs(run.y[settled][:, 2:4]).max()), *bound),
            Merit("SP1: largest tracking error, true", float(np.hypot(error[:, 0], error[:, 1]).max()), "um"),
            Merit("largest bearing force", float(np.abs(run.v[:, :4]).max()), "N"),
        )
        cases.append(Case(f"feedforward {kind}", run, merits))
    return Experiment("tilt", "Does it tilt about sensor plane 2?", tuple(cases), ())


AT_REST = dict.fromkeys(("x", "y", "alpha", "beta", "x_dot", "y_dot", "alpha_dot", "beta_dot"), 0.0)


def lift_off(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """From rest on the touchdown bearing, without current; the observer takes the mover to be at the centre.

    One run for each start-up estimator, or the one that options name.
    """
    resting = rest_on_bearing(plant)
    kinds = [options.pop("estimator")] if "estimator" in options else list(ESTIMATORS)
    needed = break_away_current(plant, resting)
    cases = []
    for n, kind in enumerate(kinds):
        own = {"start": resting, "cold": True, "bearing": True, "estimator": kind}
        scenario = _scenario("lift-off", 0.15, partial(rise_from, start=resting), own | options)
        run = simulate(plant, controller, scenario, progress=_share(progress, n, len(kinds)))
        cases.append(Case(kind, run, _lift_merits(run)))
    merits = (Merit("current per module that lifts it, statics", needed, "A"),)
    return Experiment("lift-off", "Does it rise from its bearing?", tuple(cases), merits)


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
    cases = []
    wait, picked = 0.5, 0.05
    for n, extra in enumerate(masses):
        change = ((picked, {"m": plant.mass + extra}),)
        reference = partial(late_stroke, wait=wait)
        scenario = _scenario(
            "payload", wait + 0.15, reference, {"changes": change, "bearing": True} | options
        )
        run = simulate(plant, controller, scenario, progress=_share(progress, n, len(masses)))
        error = np.abs(run.p - run.reference)
        carrying, moving = (run.t >= picked) & (run.t < wait), run.t >= wait
        merits = [Merit("largest sag after the pick", float(error[carrying][:, :4].max(initial=0.0)), "um")]
        if moving.any():
            merits += [
                Merit("stroke: axial error", float(error[moving][:, plant.stroke_output].max()), "mm"),
                Merit("stroke: radial deviation", float(error[moving][:, :4].max()), "um"),
            ]
        cases.append(Case(f"{extra * 1e3:.0f} g", run, tuple(merits)))
    carried = max((m for m, c in zip(masses, cases, strict=True) if c.run.verdict.completed), default=0.0)
    merits_all = (Merit("largest of these carried and moved", carried, "kg", "position_controller.payload"),)
    return Experiment("payload", "What can it pick and move?", tuple(cases), merits_all)


def late_stroke(plant: Plant, wait: float, distance: float = 10e-3) -> Reference:
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
    duration = minute / faster
    cases = []
    moved = partial(_drift, drift=drift, duration=duration)
    for n, (label, gain) in enumerate((("compensated", 0.5), ("not compensated", 0.0))):
        laser = _Laser(moved, gain, [k for k in range(4) if k % 2 == 0], len(plant.outputs))
        scenario = _scenario(
            "thermal", duration, references.hold, {"correction": Correction(10e-3, laser)} | options
        )
        run = simulate(plant, controller, scenario, progress=_share(progress, n, 2))
        outside = run.p[:, 2] + moved(run.t)
        late = run.t > duration / 10
        merit = Merit("largest deviation in space", float(np.abs(outside[late]).max()), "um")
        cases.append(Case(label, run, (merit, Merit("rms deviation in space", _rms(outside[late]), "um"))))
    lag = drift / duration * 10e-3 / 0.5
    merits = (
        Merit("drift of the support", drift, "um"),
        Merit("lag of the outer loop at this speed", lag, "um"),
        Merit("lag of the outer loop at the true speed", lag / faster, "um"),
    )
    return Experiment(
        "thermal", "Does it hold its place in space?", tuple(cases), merits, {"drift": moved(cases[0].run.t)}
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
    """Steps of force and torque, sines of force, vibration of the housing; the linear loop's compliance beside them."""
    steps = {"F_x": 1.0, "F_z": 1.0, "T_y": 0.05}
    tones = (5.0, 20.0, 60.0, 150.0, 400.0)
    total, done = len(steps) + len(tones) + 1, 0
    names = [s.name for s in plant.disturbances]
    seen = {"F_x": 0, "F_z": plant.stroke_output, "T_y": 0}
    cases = []
    for name, size in steps.items():
        push = partial(_step_wrench, column=names.index(name), size=size, at=0.02, width=len(names))
        scenario = _scenario(
            "disturbance",
            0.4,
            references.hold,
            QUIET | {"disturbance": push} | options,
        )
        run = simulate(plant, controller, scenario, progress=_share(progress, done, total))
        error = np.abs(run.p[:, seen[name]])
        unit = plant.disturbances[names.index(name)].unit
        merits = (
            Merit(f"largest deflection of {plant.outputs[seen[name]].name}", float(error.max()), "um"),
            Merit("left after 0.38 s", float(error[-1]), "um"),
        )
        cases.append(Case(f"step of {size:g} {unit} {name}", run, merits))
        done += 1
    found = []
    for f in tones:
        push = partial(_sine_wrench, column=names.index("F_x"), size=0.5, frequency=f, width=len(names))
        length = max(0.1, 4 / f) + max(0.1, 4 / f)
        scenario = _scenario("sine", length, references.hold, QUIET | {"disturbance": push} | options)
        run = simulate(plant, controller, scenario, progress=_share(progress, done, total))
        found.append(_amplitude(run, 0, f) / 0.5)
        done += 1
    shake = partial(
        _sine_wrench, column=names.index("F_y"), size=plant.mass * 1.0, frequency=50.0, width=len(names)
    )
    run = simulate(
        plant,
        controller,
        _scenario(
            "vibration",
            0.3,
            references.hold,
            QUIET | {"disturbance": shake} | options,
        ),
        progress=_share(progress, done, total),
    )
    vibration = Merit("amplitude of y1", _amplitude(run, 1, 50.0), "um")
    cases.append(Case("housing shaken by 1 m/s2 at 50 Hz along y", run, (vibration,)))
    w = np.geomspace(0.01, 2000, 600) * 2 * math.pi
    curve = compliance(plant, controller, w)
    worst = int(curve.argmax())
    merits_all = (
        Merit("largest compliance, x1 to F_x", float(curve[worst]), "um/N"),
        Merit("at", float(w[worst] / (2 * math.pi)), "Hz"),
        Merit("smallest dynamic stiffness", float(1 / curve[worst]), "N/um"),
    )
    curves = {
        "frequency": w / (2 * math.pi),
        "compliance": curve,
        "tones": np.array(tones),
        "simulated": np.array(found),
    }
    return Experiment("disturbance", "How stiff is it?", tuple(cases), merits_all, curves)


def compliance(
    plant: Plant, controller: Controller, w: FloatArray, output: int = 0, wrench: str = "F_x"
) -> FloatArray:
    """|S(j w) G_w(j w)|, m/N: from a force on the centre of gravity to an output, on the linear loop of the machine.

    S is the sampled loop's sensitivity at the sensors, G_w the open machine's response to the force between samples.
    """
    point = plant.at(
        **dict(
            zip([s.name for s in plant.design_states], controller.operating_point[0].tolist(), strict=True)
        )
    )
    model = linearize(plant, point)
    loop = machine_loop(model, controller)
    x, w_ext = ca.SX.sym("x", len(plant.states)), ca.SX.sym("w", len(plant.disturbances))
    rate = plant.f(x, ca.SX(point.u), w_ext)
    column = [s.name for s in plant.disturbances].index(wrench)
    B = np.array(ca.Function("B", [x, w_ext], [ca.jacobian(rate, w_ext)])(point.x, 0))[
        list(plant.controlled), column
    ]
    S = loop.sensitivity(w)
    eye = np.eye(len(model.A))
    G = np.array([model.C @ np.linalg.solve(1j * wk * eye - model.A, B) for wk in w])
    return np.asarray(np.abs(np.einsum("kij,kj->ki", S, G)[:, output]))


def _step_wrench(t: FloatArray, column: int, size: float, at: float, width: int) -> FloatArray:
    wrench = np.zeros((len(t), width))
    wrench[t >= at, column] = size
    return wrench


def _sine_wrench(t: FloatArray, column: int, size: float, frequency: float, width: int) -> FloatArray:
    wrench = np.zeros((len(t), width))
    wrench[:, column] = size * np.sin(2 * math.pi * frequency * t)
    return wrench


def _amplitude(run: Trajectory, output: int, frequency: float) -> float:
    """Amplitude of an output at a frequency (Hz), over the last whole periods of the second half of a run."""
    Ts = run.controller.sample_time
    period = 1 / frequency
    periods = max(1, int(len(run.t) / 2 * Ts / period))
    last = round(periods * period / Ts)
    t, p = run.t[-last:], run.p[-last:, output]
    basis = np.column_stack(
        [
            np.sin(2 * math.pi * frequency * t),
            np.cos(2 * math.pi * frequency * t),
            np.ones(len(t)),
            t - t.mean(),
        ]
    )
    fit = np.linalg.lstsq(basis, p, rcond=None)[0]
    return float(math.hypot(fit[0], fit[1]))


def faults(
    plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Each fault strikes a hold after 50 ms; touchdown bearings catch the mover. 0.25 s are left."""
    at, Ts = 0.05, controller.sample_time
    eps = Ts / 4  # faults begin and end between samples
    sensor = plant.outputs[1].name
    phase = plant.drive.phases[0].name
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
    cases = []
    for n, (label, struck) in enumerate(listed.items()):
        own: dict[str, Any] = {"faults": struck, "bearing": True} | options
        if any(fault.kind == "open phase" for fault in struck):
            own["fidelity"] = "phase"
        run = simulate(
            plant,
            controller,
            _scenario("faults", 0.3, references.hold, own),
            progress=_share(progress, n, len(listed)),
        )
        after = run.t >= at
        merits = (
            Merit("largest deviation", float(np.abs(run.p[after][:, :4]).max()), "um"),
            Merit("touchdown after", run.verdict.time - at if not run.verdict.completed else math.nan, "ms"),
            Merit("deviation at the end", float(np.abs(run.p[-1, :4]).max()), "um"),
        )
        cases.append(Case(label, run, merits))
    survived = sum(case.run.verdict.completed for case in cases)
    return Experiment(
        "faults",
        "What does it survive?",
        tuple(cases),
        (Merit(f"survived, of {len(cases)}", float(survived), "1"),),
    )


def drive_limits(
    plant: Plant,
    controller: Controller,
    *,
    distance: float = 10e-3,
    current_share: float = 0.8,
    voltage_share: float = 0.9,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """The fastest stroke within shares of the current and voltage limits (the rest is the feedback's), and the sigmoid
    whose peak current is the same."""
    shares: dict[str, Any] = {"voltage_share": voltage_share, "current_share": current_share}
    emf = induced_per_speed(plant)
    best = fastest_stroke(plant, distance, emf, **shares)
    sigmoid = sigmoid_at_peak_current(plant, distance, emf, **shares)
    duration = max(0.1, 6 * sigmoid.rise)
    ends: dict[str, Any] = {"start": -distance / 2, "end": distance / 2}
    logistic = partial(references.stroke, **ends, rise=sigmoid.rise, centre=duration / 2)
    wanted: dict[str, tuple[Callable[[Plant], Reference], tuple[Merit, ...]]] = {
        "fastest": (partial(best.reference, centre=duration / 2), _travel(best)),
        "sigmoid": (logistic, _travel(sigmoid)),
    }
    cases = []
    for n, (label, (reference, merits)) in enumerate(wanted.items()):
        scenario = _scenario("drive-limits", duration, reference, QUIET | options)
        run = simulate(plant, controller, scenario, progress=_share(progress, n, 2))
        cases.append(Case(label, run, (*merits, *stroke_merits(run, published=False))))
    merits = (
        Merit("current limit used", current_share * plant.actuator.current_limit, "A"),
        Merit("voltage limit used", voltage_share * plant.actuator.voltage_limit, "V"),
        Merit("fastest stroke, from rest to rest", best.duration, "ms"),
        Merit("rise, sigmoid over fastest", sigmoid.rise / best.rise, "1"),
        Merit("travel, sigmoid over fastest", sigmoid.travel_time(1e-3) / best.travel_time(1e-3), "1"),
    )
    curves = {"t": best.t, "z": best.z, "u": best.u, "i": best.i}
    return Experiment("drive-limits", "How fast could it be?", tuple(cases), merits, curves)


def _travel(found: FastestStroke | SigmoidStroke) -> tuple[Merit, ...]:
    return (
        Merit("reference: rise, 10-90 %", found.rise, "ms"),
        Merit("reference: 0.1 to 99.9 % of travel", found.travel_time(1e-3), "ms"),
    )


def induced_per_speed(plant: Plant) -> float:
    """Voltage induced in the thrust axes per speed of the stroke, V s/m."""
    rate = plant.states[len(plant.states) // 2 + plant.stroke_state].name
    return float(np.abs(np.array(ca.evalf(plant.drive.emf(ca.SX(ca.DM(plant.at(**{rate: 1.0}).x)))))).max())


def _scenario(
    name: str, duration: float, reference: Callable[[Plant], Reference], options: Mapping[str, Any]
) -> Scenario:
    """An experiment's scenario: real sensors unless the options say otherwise."""
    return replace(Scenario(name, duration, reference), **(REAL | dict(options)))


def _share(progress: Progress | None, done: int, total: int) -> Progress | None:
    return None if progress is None else lambda share: progress((done + share) / total)


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


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


def experiment(
    name: str, plant: Plant, controller: Controller, *, progress: Progress | None = None, **options: Any
) -> Experiment:
    """Run an experiment by name. Raises InputError for an unknown one, or an option that it does not take."""
    if name not in EXPERIMENTS:
        raise InputError("simulate", "scenario", repr(name), "one of " + ", ".join(EXPERIMENTS))
    return EXPERIMENTS[name](plant, controller, progress=progress, **options)
