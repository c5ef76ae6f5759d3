"""What strokes teach about the next one: the thrust that a command makes, and the thrust that was missing."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.signal import fftconvolve

from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.log import Log, log_of, reference_spline, require_same_law, sample_excitation
from malta.identification.measure import cut_loop
from malta.loops.loop import Loop, loop
from malta.model.data import plant_of
from malta.model.parameters import symbolic_names
from malta.simulation.engine.engines import evaluate
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import stroke_figures

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Plant
    from malta.simulation.trajectory import Trajectory
    from malta.synthesis.controller import Controller

SMALLEST = 0.05  # of the thrust's limit, that a stroke has to take
FACTORS = (0.5, 2.0)  # of the thrust, beyond which something else is wrong
FORCE = 0.8  # of what the model says is missing, that the next stroke is sent
LEAST = 0.25  # of that, where the error is noise
FINE = 4.0  # knots of the force in a period of the highest frequency of the reference
POWER = 0.999  # of the acceleration of the reference: it is below that frequency
WEAK = 3e-3  # of the force that moves the stroke most: forces that move it less are no patterns
NOISE = 2.0  # standard deviations, above which a pattern of the error is counted
LONGEST = 20_000  # samples of a stroke's log


@display
@dataclass(frozen=True, eq=False)
class Learned:
    """What a stroke taught.

    factor : command that was needed over the command that the law's machine needs; above 1 where the drive is weaker
    deviation : standard deviation of the factor by the noise of the position sensor
    parameter : the force constant of the thrust, by name
    before, after : its value in the gain file, and the value that the log tells, SI
    controller : the law with that value

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> weak = plant.variant(dataclasses.replace(plant.parameters, K_D=4.68))  # 10 % less
    >>> stroke = malta.Scenario.stroke(10e-3, noise=1.0)
    >>> log = malta.identification.log_of(malta.simulate(weak, controller, stroke))
    >>> found = malta.learn(controller, log)
    >>> found.before, bool(abs(found.after - 4.68) < 0.05)
    (5.2, True)
    """

    factor: float
    deviation: float
    parameter: str
    before: float
    after: float
    controller: Controller

    @property
    def description(self) -> Description:
        """The factor and the force constant."""
        rows = (
            (
                "thrust",
                f"{self.factor:.4f} +- {1.96 * self.deviation:.2g} times the command that was expected",
            ),
            (self.parameter, f"{self.before:.5g} -> {self.after:.5g}"),
        )
        return Description(f"Learned for {self.controller.name!r}", rows)


def learn(controller: Controller, log: Log, *, parameter: str = "") -> Learned:
    """Learn one factor of the thrust from the log of a stroke, and write it into what the law believes.

        g = sum of (f - v0) a_ref / (m sum of z'' a_ref)

    with the thrust f that the law believes the measured currents to make (without currents in the log: its command),
    the force v0(z) that holds the mover at its reading, and the acceleration a_ref of the reference, which is an
    instrument: neither noise nor the error of the stroke biases g. The sum of z'' a_ref is that of z a_ref'', by parts.
    The law commutates with a force constant K, and its filter predicts from the force that it believes to send; so
    K / g corrects both, where another inertia in the feedforward corrects only one.

    controller : the gain file that flew
    log : of a stroke
    parameter : the force constant of the thrust; "": found by its effect on the machine

    Returns a Learned; its controller has the new constant.

    Raises InputError for a machine without a stroke, and for a log without one; CheckError for a factor out of reason.

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> weak = plant.variant(dataclasses.replace(plant.parameters, K_D=4.68))  # 10 % less
    >>> stroke = malta.Scenario.stroke(10e-3, noise=1.0)
    >>> log = malta.identification.log_of(malta.simulate(weak, controller, stroke))
    >>> found = malta.learn(controller, log)
    >>> found.parameter, f"{found.factor:.2f}"
    ('K_D', '1.11')
    """
    believed = plant_of(controller.parameters)
    if not believed.has_stroke:
        raise InputError(
            "learn", "machine", f"a {believed.name}, which has no stroke", "a machine with a stroke"
        )
    name = parameter or thrust_constant(believed)
    if name not in symbolic_names(believed.parameters):
        known = " ".join(symbolic_names(believed.parameters))
        raise InputError("learn", name, "an unknown parameter", f"one of {known}")
    a, curved, along, beyond = _stroke(controller, believed, log)
    m = believed.mass
    factor = float(beyond @ a / (m * (1 + along) * (a @ a)))
    noise = float(np.array(believed.noise)[believed.stroke_output])
    deviation = factor * noise * float(np.linalg.norm(curved)) / float(a @ a)
    if not FACTORS[0] < factor < FACTORS[1]:
        found = f"{log.source}: the stroke took {factor:.3g} times the thrust that was expected"
        raise CheckError(f"{found}: more than a force constant is wrong")
    before = float(getattr(believed.parameters, name))
    par: Any = replace(controller.parameters, **{name: before / factor})
    taught = replace(controller, name=f"{controller.name}_learned", parameters=par)
    return Learned(factor, deviation, name, before, before / factor, taught)


def thrust_constant(plant: Plant) -> str:
    """The parameter that scales the thrust of a current and no other force. Raises InputError where there is none."""
    own, k = np.array(plant.actuator.force_constant), plant.thrust_input
    for name in symbolic_names(plant.parameters):
        value = float(getattr(plant.parameters, name))
        if not value or not len(own):
            continue
        try:
            par: Any = replace(plant.parameters, **{name: 1.01 * value})
            ratio = np.array(plant.variant(par).actuator.force_constant) / own
        except (InputError, CheckError):  # a value that the machine cannot have
            continue
        wanted = np.where(np.arange(len(own)) == k, 1.01, 1.0)
        if np.allclose(ratio, wanted, rtol=1e-9):
            return name
    raise InputError(
        "learn", "parameter", "no parameter that scales the thrust alone", "its name: --parameter"
    )


def _stroke(
    controller: Controller, believed: Plant, log: Log
) -> tuple[FloatArray, FloatArray, float, FloatArray]:
    """a_ref (m/s2), a_ref'' (m/s4), the part of z'' - a_ref along a_ref as a share of it, and f - v0 (N).

    Raises InputError for a log without a stroke, and CheckError for missing samples.
    """
    stroke, thrust, Ts = believed.stroke, believed.thrust_input, controller.sample_time
    z_ref, z = log.table("reference", [stroke])[:, 0], log.table("y", [stroke])[:, 0]
    f = believed_thrust(believed, log)
    if not (np.isfinite(z).all() and np.isfinite(f).all()) or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing")
    t = Ts * np.arange(len(z_ref))
    a = reference_spline(log, [stroke], Ts)(t, 2)[:, 0]
    largest = float(np.abs(a).max())
    if believed.mass * largest < SMALLEST * controller.limits.force[thrust]:
        found = f"{largest:.3g} m/s2 at most in ref.{stroke}"
        raise InputError(log.source, "reference", found, "a stroke that takes 5 % of the thrust's limit")
    # By parts: a_ref and its slope vanish at both ends of a stroke.
    curved = make_interp_spline(t, a, k=5)(t, 2)
    along = float((z - z_ref) @ curved / (a @ a))
    table = controller.feedforward
    return a, curved, along, f - np.interp(z, table.z_grid, table.v0[:, thrust])


def believed_thrust(believed: Plant, log: Log) -> FloatArray:
    """The thrust that the law believes the measured currents to make, N; its command where no current is measured."""
    if believed.windings is None or not log.names("i"):
        return np.asarray(log.table("v", [believed.thrust])[:, 0])
    axes = [s.name for s in believed.drive.axes]
    whole = np.zeros((log.samples, len(axes)))
    for k, name in enumerate(log.names("i")):
        if name not in axes:
            raise InputError(
                log.source, name, "a current that the machine has not", "one of " + " ".join(axes)
            )
        whole[:, axes.index(name)] = log.columns["i"][:, k]
    i = ca.SX.sym("i", len(axes))
    force = ca.Function("force", [i], [ca.densify(believed.drive.force(i)[believed.thrust_input])])
    return evaluate(force.map(len(whole)), whole)[0][:, 0]


# Learning from stroke to stroke: the thrust over time that the next stroke is sent beside the law's.


@dataclass(frozen=True, eq=False)
class ThrustPatterns:
    """The patterns of thrust over the time of a stroke from which the force that is missing is made.

    B : samples x knots, cubic splines of thrust that begin and end with zero
    U, s, V : of the linear loop's error that they make, H B = U diag(s) V', where H is the lower triangular Toeplitz
        matrix of its response from thrust to stroke; without s below 3 permille of the largest
    """

    B: FloatArray
    U: FloatArray
    s: FloatArray
    V: FloatArray


def thrust_patterns(believed: Loop, reference: FloatArray) -> ThrustPatterns:
    """The patterns for a loop and a reference of the stroke at its samples, m."""
    B = _splines(believed.sample_time, reference)
    U, s, Vt = np.linalg.svd(_moved(believed, B), full_matrices=False)
    kept = s >= WEAK * s[0]
    return ThrustPatterns(B, U[:, kept], s[kept], Vt[kept].T)


def _splines(Ts: float, reference: FloatArray) -> FloatArray:
    """Cubic splines whose knots are FINE to a period of the highest frequency of the reference's acceleration."""
    N = len(reference)
    t, f = Ts * np.arange(N), np.fft.rfftfreq(N, Ts)
    power = np.cumsum(np.abs(np.fft.rfft(make_interp_spline(t, reference, k=5)(t, 2))) ** 2)
    highest = f[int(np.searchsorted(power, POWER * power[-1]))]
    count = max(8, round(N * Ts * highest * FINE))
    knots = np.concatenate([np.zeros(3), np.linspace(0, N * Ts, min(count, N // 4) + 1), np.full(3, N * Ts)])
    return np.asarray(BSpline.design_matrix(t, knots, 3).toarray()[:, 1:-1])


def _moved(of: Loop, B: FloatArray) -> FloatArray:
    """H B: how the stroke of a loop moves under patterns of thrust, samples x patterns."""
    N, plant = len(B), of.plant
    w = 2 * np.pi * np.fft.rfftfreq(2 * N, of.sample_time)
    G = np.zeros(len(w), dtype=complex)
    G[1:-1] = cut_loop(of, w[1:-1]).G[:, plant.stroke_output, plant.thrust_input]
    return np.asarray(fftconvolve(B, np.fft.irfft(G, 2 * N)[:N, None], axes=0)[:N])


@dataclass(frozen=True, eq=False)
class NextStroke:
    """The thrust beside the law's that the next stroke is sent.

    thrust : k, N, at the samples of the log
    error : m, rms of the error of the last stroke
    patterns : how many patterns of its error rose above the noise
    noise : m, rms of an error that is noise and steps of the sensor alone
    """

    thrust: FloatArray
    error: float
    patterns: int
    noise: float


def next_stroke(controller: Controller, log: Log, patterns: ThrustPatterns | None = None) -> NextStroke:
    """What the next stroke is sent beside the law's thrust, from the log of the one before.

        d_(j+1) = d_j + 0.8 a_j B (H B)^+ e_j,     a_j = max(1/4, 1 - K sigma^2 / |U' e_j|^2)

    with the error e of the readings, the thrust d that was sent (the log's excitation), K patterns B and the linear
    loop's response H (lifted form of iterative learning; Bristow, Tharayil, Alleyne, IEEE Control Systems 26(3), 2006).
    The share a_j is that of the patterns' error which is not noise of the sensor, sigma (James and Stein): near the end
    strokes are averaged. As it is one number for all patterns, `contraction` proves by how much errors shrink. The
    filter has to know d as sent, as `Scenario(excitation=...)` has it.

    controller : the gain file that flew
    log : of a stroke that begins and ends at rest
    patterns : of this law and reference, `thrust_patterns`; None: computed

    Returns a NextStroke.

    Raises InputError for a log that is too long, CheckError for another machine's and for missing samples.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(10e-3, noise=1.0))
    >>> log = malta.identification.log_of(run)
    >>> found = malta.identification.next_stroke(controller, log)
    >>> found.thrust.shape, found.patterns > 0
    ((2000,), True)
    """
    plant = plant_of(controller.parameters)
    require_same_law(log, plant.name, controller.sample_time)
    if log.samples > LONGEST:
        raise InputError(log.source, "t", f"{log.samples} samples", f"one stroke, at most {LONGEST} samples")
    reference, y = (log.table(group, [plant.stroke])[:, 0] for group in ("reference", "y"))
    if not np.isfinite(y).all() or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing")
    found = thrust_patterns(loop(plant, controller), reference) if patterns is None else patterns
    sent: FloatArray = np.zeros(log.samples)
    if plant.thrust in log.names("excitation"):
        sent = log.table("excitation", [plant.thrust])[:, 0]
    k = plant.stroke_output
    sigma = float(np.hypot(plant.noise[k], plant.resolution[k] / np.sqrt(12)))
    e = reference - y
    seen = found.U.T @ e
    share = max(LEAST, 1 - len(seen) * sigma**2 / max(float(seen @ seen), 1e-300))
    more = found.B @ (found.V @ (seen / found.s))
    size = float(np.sqrt((e**2).mean()))
    return NextStroke(sent + FORCE * share * more, size, int((np.abs(seen) > NOISE * sigma).sum()), sigma)


@display
@dataclass(frozen=True, eq=False)
class LearnedStrokes:
    """Strokes of a simulated machine, each sent what the ones before taught.

    axial_error : m, the largest true error of each stroke
    repeatable : m, the same of the next stroke without noise of the sensors: what learning has left
    patterns : of each stroke, how many patterns of its error rose above the noise
    thrust : k, N: what the next stroke would be sent beside the law's
    controller : the law with the force constant that the first stroke taught

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> found = malta.identification.learn_strokes(plant, controller, strokes=4)
    >>> found.axial_error[3] < 0.4 * found.axial_error[0]
    True
    """

    axial_error: tuple[float, ...]
    repeatable: float
    patterns: tuple[int, ...]
    thrust: FloatArray
    controller: Controller

    @property
    def description(self) -> Description:
        """The error of each stroke."""
        rows = [(f"stroke {k + 1}", f"{1e6 * e:.3g} um") for k, e in enumerate(self.axial_error)]
        rows.append(("the next one without noise", f"{1e6 * self.repeatable:.3g} um"))
        return Description(f"Strokes of {self.controller.name!r}", tuple(rows))


def learn_strokes(
    plant: Plant,
    controller: Controller,
    *,
    strokes: int = 6,
    distance: float = 10e-3,
    noise: float = 1.0,
    seed: int = 0,
) -> LearnedStrokes:
    """Fly one and the same stroke again and again, and learn from each log what the next one is sent.

    The first stroke teaches the force constant (`learn`), each of the following ones the thrust over time that is
    missing (`next_stroke`): feedforward behind the delay, cogging, what holds the mover on its way. Before each the
    mover rests for 0.3 s.

    plant : the machine, which may differ from the gain file's
    controller : the gain file
    strokes : how many
    distance : m
    noise : of the sensors, in multiples; 0: without their steps too
    seed : of the noise of the first stroke

    Returns a LearnedStrokes.

    Raises InputError as `learn` does, CheckError for a stroke that ends early.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> found = malta.identification.learn_strokes(plant, controller, strokes=2)
    >>> len(found.axial_error)
    2
    """
    if strokes < 1:
        raise InputError("learn", "strokes", str(strokes), "1 or more")
    law, patterns = controller, None
    errors, counts = [], []
    scenario = Scenario.stroke(distance, noise=noise, quantize=noise > 0, settle=0.3)
    thrust: FloatArray = np.zeros(
        scenario.samples(law.sample_time) - scenario.settling_samples(law.sample_time)
    )

    def fly(flown: Scenario, name: str) -> Trajectory:
        sent = sample_excitation(law.sample_time, plant, thrust) if thrust.any() else None
        run = simulate(plant, law, flown.replace(excitation=sent))
        if not run.verdict.completed:
            raise CheckError(f"{name}: {run.verdict.name} at {run.verdict.time:.4g} s")
        return run

    for k in range(strokes):
        run = fly(scenario.replace(seed=seed + k), f"stroke {k + 1}")
        errors.append(stroke_figures(run).axial_error)
        log = log_of(run)
        if k == 0:
            law = learn(law, log).controller
            counts.append(0)
            continue
        if patterns is None:
            reference = log.table("reference", [plant.stroke])[:, 0]
            patterns = thrust_patterns(loop(plant_of(law.parameters), law), reference)
        after = next_stroke(law, log, patterns)
        thrust, counts = after.thrust, [*counts, after.patterns]
    still = fly(scenario.replace(noise=0.0, quantize=False), "the next stroke without noise")
    return LearnedStrokes(tuple(errors), stroke_figures(still).axial_error, tuple(counts), thrust, law)
