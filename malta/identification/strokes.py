"""Learning from stroke to stroke: the thrust over time that the next stroke is sent beside the law's.

The error of stroke j in its patterns is c_j = x_j + n_j: what repeats, x_j, and what noise of the sensors does behind
the feedback, n_j. The next stroke is sent what corrects A_j c_j, so that with M = T(p) / T_0, the machine's response
over the gain file's,

    x_(j+1) = x_j - M A_j (x_j + n_j),     A_j = diag(a_k),     0 <= a_k <= 0.8

- a_k = P_k / (P_k + N_k) is the gain of a Kalman filter over strokes for each pattern, at most 0.8 and at most that of
  the stroke before, with the variances P_k of what repeats and N_k of the noise. For M = 1 it leaves (1 - a_k)^2 P_k +
  a_k^2 N_k <= P_k: the expected square of no pattern grows.
- What is proven of all machines of a box: where `contraction` is c <= 1, the sum of a_k x_k^2 grows from no stroke to
  the next one, without noise, whatever the gains are. For D = (A / 0.8)^(1/2) and w = D x, D x_(j+1) =
  (I - 0.8 D M D) D x_j, and as |w - 0.8 M w|^2 <= c^2 |w|^2 says w'(M + M')w >= 0.8 |M w|^2 + (1 - c^2) |w|^2 / 0.8,

      |(I - 0.8 D M D) x|^2 <= |x|^2 - 0.8 w'(M + M')w + 0.64 |M w|^2 <= |x|^2 - (1 - c^2) |w|^2

  Gains that do not rise do not raise this sum either. With a_k = 0.8 throughout, errors shrink by c.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline
from scipy.optimize import isotonic_regression
from scipy.signal import fftconvolve

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.excite import cut_loop, output_bands
from malta.identification.learn import learn
from malta.identification.log import Log, log_of, require_same_law, sample_excitation
from malta.identification.replay import reference_motion
from malta.loops.loop import Loop, loop
from malta.model.parts import attribute_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta.synthesis.controller import Controller, given_law
from malta.work import is_stopped

FORCE = 0.8  # of what the model says is missing, that the next stroke is sent at most
KNOTS_PER_PERIOD = 4.0  # knots of the force in a period of the highest frequency of the reference
POWER = 0.999  # of the acceleration of the reference: it is below that frequency
MIN_PATTERN_FORCE = 3e-3  # of the force that moves the stroke most: forces that move it less are no patterns
CHANCE = 2.0  # standard deviations, above which an error is more than noise
ROUNDS = 4  # strokes of the gain file's own machine, without noise: they leave some 0.2^4 of its error
DEFAULT_THRUST_SHARE = 0.25  # of the thrust's limit, by a stroke of a machine without a rise of its own
MIN_RISE_SAMPLES = 20  # samples of its rise, at least
LOGISTIC_RISE = 2 * math.log(9) / 108**0.25  # s, rise of a logistic move by 1 m with 1 m/s2 at most
MAX_SAMPLES = 20_000  # samples of a stroke's log


def stroke_of(plant: Plant, controller: Controller, distance: float | None = None) -> Scenario:
    """A stroke that teaches something of the thrust, after a rest: with the machine's own RISE of its experiments.

    Without one the stroke takes a quarter of the thrust's limit at most, and its rise 20 samples and two turns of the
    highest frequency that its loop follows (|T| = 0.7), at least. The rest takes ten such turns, 0.3 s at least.

    plant : the machine, with a stroke
    controller : the gain file
    distance : m; None: two thirds of the way from the middle to an end

    >>> import malta
    >>> from malta.identification.strokes import stroke_of
    >>> controller = malta.gains.read("design/gains/halbach.json")  # samples of 55 ms
    >>> scenario = stroke_of(malta.plant_of(controller.parameters), controller)
    >>> round(scenario.duration / controller.sample_time)  # of six times the rise
    120
    """
    believed = plant_of(controller.parameters)
    turn = 1 / float(output_bands(loop(believed, controller))[believed.stroke_output])
    distance = 2 * plant.stroke.travel / 3 if distance is None else distance
    rise = None
    if attribute_of(plant, "experiments", "RISE") is None:
        most = DEFAULT_THRUST_SHARE * controller.limits.force[believed.thrust_input] / believed.stroke.mass
        rise = max(
            MIN_RISE_SAMPLES * controller.sample_time,
            2 * turn,
            LOGISTIC_RISE * math.sqrt(abs(distance) / most),
        )
    driven: dict[str, Any] = {} if plant.actuator.windings is not None else {"fidelity": "force"}
    return Scenario.stroke(distance, rise=rise, settle=max(0.3, 10 * turn), **driven)


@dataclass(frozen=True, eq=False)
class ThrustPatterns:
    """The patterns of thrust over the time of a stroke from which the force that is missing is made.

    B : samples x knots, cubic splines of thrust that begin and end with zero
    U, s, V : of the linear loop's error that they make, H B = U diag(s) V', where H is the lower triangular Toeplitz
        matrix of its response from thrust to stroke; without s below 3 permille of the largest
    noise : of each pattern of the error, its variance under white noise of variance 1 of the readings, which S shapes
    white : variance of one sample of the error from the same noise
    """

    B: FloatArray
    U: FloatArray
    s: FloatArray
    V: FloatArray
    noise: FloatArray
    white: float


def thrust_patterns(believed: Loop, reference: FloatArray) -> ThrustPatterns:
    """The patterns for a loop and a reference of the stroke at its samples, m."""
    N, k = len(reference), believed.plant.stroke_output
    B = _splines(believed.sample_time, reference)
    w = 2 * np.pi * np.fft.rfftfreq(2 * N, believed.sample_time)
    cut = cut_loop(believed, w[1:-1])
    G = np.zeros(len(w), dtype=complex)
    G[1:-1] = cut.G[:, k, believed.plant.thrust_input]
    moved = fftconvolve(B, np.fft.irfft(G, 2 * N)[:N, None], axes=0)[:N]
    U, s, Vt = np.linalg.svd(moved, full_matrices=False)
    kept = s >= MIN_PATTERN_FORCE * s[0]
    U = U[:, kept]
    power = np.abs(np.pad(cut.S[:, k, k], 1, mode="edge")) ** 2 / N  # of both halves of the circle
    power[[0, -1]] /= 2
    noise = power @ np.abs(np.fft.rfft(U, 2 * N, axis=0)) ** 2
    return ThrustPatterns(B, U, s[kept], Vt[kept].T, noise, float(power.sum()))


def _splines(Ts: float, reference: FloatArray) -> FloatArray:
    """Cubic splines, KNOTS_PER_PERIOD to a period of the highest frequency of the reference's acceleration."""
    N = len(reference)
    t, f = Ts * np.arange(N), np.fft.rfftfreq(N, Ts)
    power = np.cumsum(np.abs(np.fft.rfft(make_interp_spline(t, reference, k=5)(t, 2))) ** 2)
    highest = f[int(np.searchsorted(power, POWER * power[-1]))]
    count = max(8, round(N * Ts * highest * KNOTS_PER_PERIOD))
    knots = np.concatenate([np.zeros(3), np.linspace(0, N * Ts, min(count, N // 4) + 1), np.full(3, N * Ts)])
    return np.asarray(BSpline.design_matrix(t, knots, 3).toarray()[:, 1:-1])


@dataclass(frozen=True, eq=False)
class NextStroke:
    """The thrust beside the law's that the next stroke is sent, and what was known when it was chosen.

    thrust : k, N, at the samples of the log
    error : m, rms of the error of the last stroke
    patterns : how many patterns of its error rose above the noise
    noise : m, standard deviation of the readings' own noise, as the log shows it
    gains : a_k of each pattern; 0.8 where no log's error was more than noise
    left : m2, variance that is expected of each pattern of the next stroke's error
    """

    thrust: FloatArray
    error: float
    patterns: int
    noise: float
    gains: FloatArray
    left: FloatArray


def next_stroke(
    controller: Controller, log: Log, patterns: ThrustPatterns | None = None, before: NextStroke | None = None
) -> NextStroke:
    """What the next stroke is sent beside the law's thrust, from the log of the one before.

        d_(j+1) = d_j + B (H B)^+ U A_j U' e_j

    with the error e of the readings, the thrust d that was sent (the log's excitation), patterns B and the linear
    loop's response H. This is the lifted form of iterative learning (Bristow, Tharayil, Alleyne, IEEE Control Systems
    26(3), 2006). A_j has the gains of a Kalman filter over strokes, as at the top of this module. The log shows the
    noise where no pattern of thrust can move the mover. The filter of the law has to know d as sent, as
    `Scenario(excitation=...)` has it.

    controller : the gain file that was running
    log : of a stroke that begins and ends at rest
    patterns : of this law and reference, `thrust_patterns`; None: computed
    before : what the stroke before was found to leave; None: nothing is known, and the log alone weighs

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
    controller = given_law("next_stroke", controller)
    plant = plant_of(controller.parameters)
    require_same_law(log, plant.name, controller.sample_time)
    if log.samples > MAX_SAMPLES:
        raise InputError(
            log.source, "t", f"{log.samples} samples", f"one stroke, at most {MAX_SAMPLES} samples"
        )
    reference, y = (log.table(group, [plant.stroke.name])[:, 0] for group in ("reference", "y"))
    if not np.isfinite(y).all() or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing")
    found = thrust_patterns(loop(plant, controller), reference) if patterns is None else patterns
    sent: FloatArray = np.zeros(log.samples)
    if plant.stroke.thrust in log.names("excitation"):
        sent = log.table("excitation", [plant.stroke.thrust])[:, 0]
    e = reference - y
    seen = found.U.T @ e
    beside = float(((e - found.U @ seen) ** 2).sum())
    variance = max(beside, 1e-300) / (len(e) * found.white - float(found.noise.sum()))
    noise = variance * found.noise
    expected, most = (0 * noise, np.full(len(seen), FORCE)) if before is None else (before.left, before.gains)
    gains, left = correction(seen, noise, expected, most)
    more = found.B @ (found.V @ (gains * seen / found.s))
    above = int((np.abs(seen) > CHANCE * np.sqrt(noise)).sum())
    size = float(np.sqrt((e**2).mean()))
    return NextStroke(
        sent + more, size, above, float(np.sqrt(variance)), gains if gains.any() else most, left
    )


def correction(
    seen: FloatArray, noise: FloatArray, expected: FloatArray, most: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Gains a_k of the patterns, and the variance that a correction by them is expected to leave.

        a_k = min(P_k / (P_k + N_k), a_k of the stroke before)

    P is what was expected, until the squares of what is seen, over P + N, sum to more than chance: then it is what
    they show, c^2 - N, made to fall with k by least squares, as thrust moves later patterns less.

    seen : c, m, the patterns of an error
    noise : N, m2, their variance by noise
    expected : P, m2, before this stroke; zeros: nothing is expected
    most : the gains before
    """
    count = len(seen)
    if (seen**2 / (expected + noise)).sum() > count + CHANCE * np.sqrt(2 * count):
        expected = np.maximum(isotonic_regression(seen**2 - noise, increasing=False).x, 0)
    gains = np.minimum(expected / (expected + noise), most)
    return gains, (1 - gains) ** 2 * expected + gains**2 * noise


def own_thrust(controller: Controller, flown: Scenario, patterns: ThrustPatterns) -> FloatArray:
    """The thrust beside the law's that the gain file's own machine needs to follow a stroke, N, at its samples.

    It is learned from strokes of the model without noise, and makes up for the delay and the current loops: a lab's
    machine need not teach what the model knows. Raises CheckError where the first correction does not shrink its error:
    then no machine learns from stroke to stroke by this response.
    """
    plant, Ts = plant_of(controller.parameters), controller.sample_time
    thrust: FloatArray = np.zeros(len(patterns.B))
    errors: list[float] = []
    for _ in range(ROUNDS):
        sent = sample_excitation(Ts, plant, thrust)
        run = simulate(plant, controller, flown.replace(noise=0.0, quantize=False, excitation=sent))
        log = log_of(run)
        e = (log.table("reference", [plant.stroke.name]) - log.table("y", [plant.stroke.name]))[:, 0]
        seen = patterns.U.T @ e
        errors.append(float(np.linalg.norm(seen)) / len(e) ** 0.5)
        if len(errors) == 2 and not errors[1] < errors[0]:
            grown = f"{1e6 * errors[0]:.3g} to {1e6 * errors[1]:.3g} um rms"
            raise CheckError(
                f"{controller.name}: an error of its own machine grows from {grown} as it learns"
            )
        thrust = thrust + FORCE * patterns.B @ (patterns.V @ (seen / patterns.s))
    return thrust


def first_thrust(controller: Controller, log: Log) -> FloatArray:
    """`own_thrust` of a law for the reference of a log, N: what the first stroke under this law is sent beside it."""
    plant = plant_of(controller.parameters)
    motion = reference_motion(log, [s.name for s in plant.outputs], controller.sample_time)
    flown = Scenario("stroke", log.samples * controller.sample_time, lambda _: motion)
    reference = log.table("reference", [plant.stroke.name])[:, 0]
    return own_thrust(controller, flown, thrust_patterns(loop(plant, controller), reference))


@display
@dataclass(frozen=True, eq=False)
class LearnedStrokes:
    """Strokes of a simulated machine, each sent what the ones before taught.

    axial_error : m, the largest true error of each stroke
    without_noise : m, the same of each stroke simulated again without noise of the sensors, and of the next one
    patterns : of each stroke, how many patterns of its error rose above the noise
    thrust : k, N: what the next stroke would be sent beside the law's
    controller : the law with the force constant that the first stroke taught

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> found = malta.identification.learn_strokes(plant, controller, strokes=3)
    >>> found.without_noise[3] < 0.2 * found.axial_error[0]
    True
    """

    axial_error: tuple[float, ...]
    without_noise: tuple[float, ...]
    patterns: tuple[int, ...]
    thrust: FloatArray
    controller: Controller

    @property
    def description(self) -> Description:
        """The error of each stroke."""
        rows = [(f"stroke {k + 1}", f"{1e6 * e:.3g} um") for k, e in enumerate(self.axial_error)]
        rows.append(("the next one without noise", f"{1e6 * self.without_noise[-1]:.3g} um"))
        return Description(f"Strokes of {self.controller.name!r}", tuple(rows))


def learn_strokes(
    plant: Plant,
    controller: Controller,
    *,
    strokes: int = 6,
    distance: float | None = None,
    noise: float = 1.0,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> LearnedStrokes:
    """Fly one and the same stroke again and again, and learn from each log what the next one is sent.

    The first stroke teaches the force constant (`learn`). The second one is sent what the gain file's own machine would
    miss with it, behind delay and current loops (`own_thrust`). Each from the second on teaches the thrust over time
    that is missing still (`next_stroke`): cogging, what holds the mover on its way. Before each it rests (`stroke_of`).

    plant : the machine, which may differ from the gain file's
    controller : the gain file
    strokes : how many
    distance : m; None: two thirds of the way from the middle to an end
    noise : of the sensors, in multiples; 0: without their steps too
    seed : of the noise of the first stroke
    progress : called with the share of the strokes that is done

    Returns a LearnedStrokes.

    Raises InputError as `learn` does, CheckError for a stroke that ends early.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> found = malta.identification.learn_strokes(plant, controller, strokes=2)
    >>> len(found.axial_error)
    2
    """
    controller = given_law("learn_strokes", controller)
    if strokes < 1:
        raise InputError("learn", "strokes", str(strokes), "1 or more")
    scenario = stroke_of(plant, controller, distance).replace(noise=noise, quantize=noise > 0)
    still = scenario.replace(noise=0.0, quantize=False)
    first = _fly(plant, controller, scenario.replace(seed=seed), None)
    errors, quiet, counts = [first], [_fly(plant, controller, still, None) if noise else first], [0]
    log = log_of(first)
    law = learn(controller, log).controller
    reference = log.table("reference", [plant.stroke.name])[:, 0]
    patterns = thrust_patterns(loop(plant_of(law.parameters), law), reference)
    thrust, after = own_thrust(law, scenario, patterns), None
    for k in range(1, strokes):
        if is_stopped():
            break
        if progress is not None:
            progress(k / strokes)
        run = _fly(plant, law, scenario.replace(seed=seed + k), thrust)
        errors.append(run)
        quiet.append(_fly(plant, law, still, thrust) if noise else run)
        after = next_stroke(law, log_of(run), patterns, after)
        thrust, counts = after.thrust, [*counts, after.patterns]
    quiet.append(_fly(plant, law, still, thrust))
    flown, still_left = (tuple(stroke_figures(run).axial_error for run in runs) for runs in (errors, quiet))
    return LearnedStrokes(flown, still_left, tuple(counts), thrust, law)


def _fly(plant: Plant, law: Controller, flown: Scenario, thrust: FloatArray | None) -> Trajectory:
    """A stroke with a thrust beside the law's. Raises CheckError where it ends early."""
    sent = None if thrust is None else sample_excitation(law.sample_time, plant, thrust)
    run = simulate(plant, law, flown.replace(excitation=sent))
    if not run.verdict.completed:
        raise CheckError(f"a stroke: {run.verdict}")
    return run
