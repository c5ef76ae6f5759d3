"""An excitation of all axes at once, and what it will do and find, before anything flies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

from malta.arguments import describe, is_number
from malta.arrays import ComplexArray, FloatArray
from malta.display import Description, display, quantity
from malta.errors import InputError
from malta.identification.response import (
    ResponseModel,
    axes_of,
    candidates,
    deviations,
    information,
    require_parameters,
    well_found,
)
from malta.model.equilibrium import trim
from malta.model.places import outputs_at
from malta.model.plant import OperatingPoint, Plant
from malta.simulation.multisine import Multisine, interleaved_multisine

if TYPE_CHECKING:
    from malta.loops.loop import Loop

HIGHEST_LINE = 400.0  # Hz: the highest line, where the loop's band and the samples allow it
BAND_FACTORS = (0.8, 10.0)  # times the band of the fastest output, between which the highest line is
RATE_SHARE = 0.25  # of the sampling rate, above which no line is: motion between samples is as good as seen
DECADES = 200.0  # times the lowest line: the highest one
TURNS = 2.0  # of the lowest line in a period
LINES = 12  # of each input
PERIODS = 10
MIN_SHARE, GRID = 1e-5, 500  # of the Nyquist frequency, and points from there on, by which a band is found
SHARE = 0.5  # of its value: a parameter that is found worse is not asked for by itself
NOISE_FLOOR = 1e-9  # m or rad: noise of a sensor that has none
MAX_SAMPLES = 5e7  # samples of a flight
MAX_MOTION, MAX_DEVIATION = (
    2.0,
    5.0,
)  # times the largest motion, deviations of noise: beyond both another machine flies
CURRENT = 0.1  # of the current limit: the amplitude where none is given
CURVATURE_DEVIATIONS = 100.0  # of the noise at the lines: what curvature adds is computed to a percent
COMMAND = 0.5  # of the force limits, which commands keep within there, with the forces that hold the machine


@display
@dataclass(frozen=True, eq=False)
class ExcitationPlan:
    """A multisine for a loop, and what is predicted of it from the linear loop.

    signal : the multisine
    periods : that are logged, after one in which the loop settles
    motion : by output: largest deviation, SI
    window : by output: twice that and five deviations of its noise, SI: a reading beyond it should end the run
    current : by measured current: largest deviation from the current at rest, A
    command : by input: the largest command, with the one that holds the machine, as a share of its limit
    accuracy : by parameter: half of the 95 % interval that the log will give, as a share of its value
    unit : of the currents, V where voltages are the commands

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> plan = malta.excite(loop, period=0.5, periods=4, band=(4, 400))
    >>> plan.duration
    2.5
    """

    signal: Multisine
    periods: int
    motion: Mapping[str, float]
    window: Mapping[str, float]
    current: Mapping[str, float]
    command: Mapping[str, float]
    accuracy: Mapping[str, float]
    unit: str = "A"

    @property
    def duration(self) -> float:
        """Of the run, s: the logged periods and one before them."""
        return (self.periods + 1) * self.signal.period

    @property
    def description(self) -> Description:
        """What moves how far, what flows, and what will be found."""
        f, crest = self.signal.frequencies, self.signal.crest_factor
        rows = [
            ("lines", f"{len(f)} from {f[0]:g} to {f[-1]:g} Hz, period {self.signal.period:g} s"),
            ("crest factor", f"{np.nanmin(crest):.2f} .. {np.nanmax(crest):.2f}"),
            ("motion", ", ".join(f"{name} {value:.3g}" for name, value in self.motion.items())),
            ("current", f"{quantity(max(self.current.values()), self.unit)} at most beside that at rest"),
            ("command", f"{100 * max(self.command.values()):.3g} % of a limit at most"),
        ]
        rows += [(name, f"+-{100 * share:.2g} %") for name, share in self.accuracy.items()]
        return Description(f"Excitation of {self.duration:g} s", tuple(rows))


def excite(
    loop: Loop,
    *,
    force: float | None = None,
    current: float | None = None,
    motion: float | None = None,
    period: float | None = None,
    periods: int = PERIODS,
    band: tuple[float, float] | None = None,
    lines: int = LINES,
    parameters: Sequence[str] = (),
    seed: int = 0,
    shift: int = 0,
) -> ExcitationPlan:
    """Design an excitation of all axes at once, and predict from the linear loop what it does and what it will find.

    Each input has lines of its own, evenly spread in log f, with phases of a low crest factor. The amplitude of an axis
    is the same at all of its lines. Where none is given, the band follows that of the loop, see `default_band`. A
    period has two turns of the lowest line and room for all lines, in whole samples.

    loop : the machine under its controller, where it is held
    force : largest force of each input, N or N m
    current : largest current beside the one at rest, A; where no size is given 10 % of its limit, and commands within
        half of the force limits, and what the machine's curvature adds at the lines within 100 deviations of the noise
    motion : largest deviation of any output in m or rad, or of any at all where all have one unit, SI; of several
        limits the strictest counts, and commands stay within the force limits
    period : s; None: by the band
    periods : that are logged
    band : Hz, lowest and highest line; None: by the loop
    lines : of each input
    parameters : whose accuracy is predicted; (): those that will be found to 50 %, but for masses and lengths
    seed : of the phases
    shift : by how many inputs the lines are dealt later; as many plans as inputs excite each line in each of them

    Returns an ExcitationPlan.

    Raises InputError for a band with too few lines or above half of the sampling rate, unknown parameters, a motion of
    a machine with none, and an unstable loop. A machine without limits is refused where no size is given.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> plan = malta.excite(loop, motion=10e-6)
    >>> f"{1e6 * max(plan.motion.values()):.1f} um, K_A to {plan.accuracy['K_A']:.2%}"
    '10.0 um, K_A to 0.13%'
    """
    from malta.loops.loop import Loop

    if not isinstance(loop, Loop):
        raise InputError("excite", "loop", describe(loop), "a Loop, as malta.loop(plant, controller) gives")
    plant, m = loop.plant, len(loop.plant.inputs)
    given = {"force": force, "current": current, "motion": motion, "period": period}
    band = _require(loop, given, {"periods": periods, "lines": lines}, band)
    if period is None:
        least = max(TURNS / band[0], TURNS * lines * m / (band[1] - band[0]))
        period = float(np.ceil(least / loop.sample_time - 1e-9) * loop.sample_time)
    _require_length(loop, period, periods)
    signal = interleaved_multisine(period, *band, inputs=m, lines=lines, seed=seed, shift=shift)
    limit = np.array(plant.actuator.force_limit)
    size = np.where(np.isfinite(limit), limit, 1.0)  # N or N m, of the unit signal
    share = np.minimum(limit, np.inf if force is None else force) / size
    by_default = force is None and current is None and motion is None
    unit = replace(signal, amplitude=(size / signal.peak)[signal.axis.astype(int)])
    model = model_at(loop, (*parameters,) or candidates(plant))
    found = predicted_spectra(loop, model, unit)
    axis = unit.axis.astype(int)
    kept, least = (COMMAND, COMMAND / 2) if by_default else (1.0, 0.01)  # of limits, which cut commands off
    room = np.maximum(kept * limit - np.abs(np.asarray(_rest_point(loop).v)), least * limit)
    limits = [(found.v / room, 1.0)] if np.isfinite(limit).any() else []
    if by_default:
        current = CURRENT * plant.actuator.current_limit
    moved = slice(None) if motion is None else _moving_outputs(plant)
    sizes = ((found.i, current), (found.y[:, moved], motion))
    limits += [(part, most) for part, most in sizes if most is not None and np.isfinite(most)]
    for spectrum, most in limits:  # each input alone, then all together
        share = np.minimum(share, most / np.maximum(_peaks(unit, spectrum).max(axis=1), 1e-300))
    if not np.isfinite(share).all():
        expected = "a force, a current or a motion"
        raise InputError("excite", "force", "none, and a machine without limits", expected)
    for spectrum, most in limits:
        share = share * min(1.0, most / _together(unit, spectrum * share[axis][:, None]).max())
    while (
        by_default and _curvature_share(model, unit, found.times(share[axis]), periods) > CURVATURE_DEVIATIONS
    ):
        share = 0.8 * share
    signal = replace(unit, amplitude=unit.amplitude * share[axis])
    return _plan(loop, model, signal, periods, found.times(share[axis]), named=bool(parameters))


def motion_unit(plant: Plant) -> str:
    """The unit that a motion is given in: the one of what it bounds; m of angles beside positions."""
    units = {plant.outputs[k].unit for k in _moving_outputs(plant)}
    return units.pop() if len(units) == 1 else "m"


def _moving_outputs(plant: Plant) -> list[int]:
    """The outputs that a motion bounds: those in m or rad; all of one unit. Raises InputError for others."""
    units = dict.fromkeys(s.unit for s in plant.outputs)
    moved = [k for k, s in enumerate(plant.outputs) if len(units) == 1 or s.unit in ("m", "rad")]
    if not moved:
        expected = "outputs in m or rad, or all in one unit; else a force or a current"
        raise InputError("excite", "motion", f"a machine with outputs in {', '.join(units)}", expected)
    return moved


class Cut(NamedTuple):
    """A loop at k frequencies, cut at the law's reading: v = F y + F_d d, y = P v."""

    P: ComplexArray  # k x p x m
    F: ComplexArray  # k x m x p
    F_d: ComplexArray  # k x m x m

    @property
    def S(self) -> ComplexArray:
        """(I - P F)^-1."""
        return np.asarray(np.linalg.inv(np.eye(self.P.shape[1]) - self.P @ self.F))

    @property
    def G(self) -> ComplexArray:
        """S P F_d, from excitation to readings."""
        return np.asarray(self.S @ self.P @ self.F_d)


def cut_loop(loop: Loop, w: FloatArray) -> Cut:
    """The machine, the law and how an excitation enters it, at frequencies w, rad/s; w below the Nyquist frequency."""
    sampled, m = loop.sampled_forces, len(loop.plant.inputs)
    law, z = sampled.control, np.exp(1j * w * loop.sample_time)[:, None, None]
    fed = slice(-2 * m, -m)  # of the law's references: the forces that are fed forward
    p = len(sampled.Cd)
    P = sampled.Cd @ np.linalg.solve(z * np.eye(len(sampled.Ad)) - sampled.Ad, sampled.Bd)
    if P.shape[2] > m:  # the readings that currents are commutated for
        P = np.linalg.solve(np.eye(p) - P[..., m:], P[..., :m])
    into = np.hstack([law.B_y, law.B_r[:, fed]])
    F = law.C[:m] @ np.linalg.solve(z * np.eye(len(law.A)) - law.A, into)
    F = F + np.hstack([law.D_y[:m], law.D_r[:m, fed]])
    return Cut(np.asarray(P, dtype=complex), F[..., :p], F[..., p:])


def default_band(loop: Loop) -> tuple[float, float]:
    """The lowest and the highest line of an excitation, Hz, where none is given.

    The band of an output ends at the highest frequency with |T| = 0.7. The highest line is at 400 Hz, or where that is
    not within 0.8 to 10 times the band of the fastest output at the nearer of these, and at a quarter of the sampling
    rate at most. The lowest one is 200 times lower, or at half of the band of the slowest output where that is lower.

    >>> import malta
    >>> from malta.identification.excite import default_band
    >>> for name in ("robust", "halbach"):  # samples of 50 us and of 55 ms
    ...     controller = malta.gains.read(f"design/gains/{name}.json")
    ...     low, high = default_band(malta.loop(malta.plant_of(controller.parameters), controller))
    ...     print(f"{low:.2g} to {high:.3g} Hz")
    2 to 400 Hz
    0.023 to 4.55 Hz
    """
    bands = output_bands(loop)
    high = min(
        max(HIGHEST_LINE, BAND_FACTORS[0] * bands.max()),
        BAND_FACTORS[1] * bands.max(),
        RATE_SHARE / loop.sample_time,
    )
    return float(min(high / DECADES, bands.min() / 2)), float(high)


def output_bands(loop: Loop) -> FloatArray:
    """By output: the highest frequency with |T| = 0.7, the others closed, Hz; of a peak below 1: with 0.7 of that."""
    w = np.geomspace(MIN_SHARE, 1.0, GRID) * np.pi / loop.sample_time
    S = cut_loop(loop, w).S
    T = np.abs(1 - np.einsum("kpp->kp", S))
    wide = np.sqrt(0.5) * np.minimum(1.0, T.max(axis=0)) <= T
    last = len(w) - 1 - wide[::-1].argmax(axis=0)
    return np.asarray(w[last] / (2 * np.pi))


def model_at(loop: Loop, names: Sequence[str]) -> ResponseModel:
    """The response of a loop's machine where it is held."""
    plant, point = loop.plant, _rest_point(loop)
    y = outputs_at(plant, point.x)
    coils = ca.DM(plant.actuator.currents(ca.DM(y), ca.DM(point.v)))
    i = np.array(
        coils if plant.actuator.windings is None else ca.evalf(ca.densify(plant.drive.command(coils)))
    ).ravel()
    currents = tuple(s.name for s in axes_of(plant))
    return ResponseModel(plant, require_parameters(plant, names), currents, y, i, loop.sample_time)


class Spectra(NamedTuple):
    """Amplitudes at the lines: of outputs, of currents and of commands, k x signals."""

    y: ComplexArray
    i: ComplexArray
    v: ComplexArray

    def times(self, share: FloatArray) -> Spectra:
        """Those of a signal whose lines are so many times as large."""
        return Spectra(*(part * share[:, None] for part in self))


def predicted_spectra(loop: Loop, model: ResponseModel, signal: Multisine) -> Spectra:
    """What a signal d does in the linear loop: y = P v, v = F y + F_d d, where the filter knows d as sent.

    The currents are those of least squares that move the machine so.
    """
    w, m = 2 * np.pi * signal.frequencies, len(loop.plant.inputs)
    d = np.zeros((len(w), m), dtype=complex)
    d[np.arange(len(w)), signal.axis.astype(int)] = signal.amplitude * np.exp(1j * signal.phase)
    cut = cut_loop(loop, w)
    Y = np.einsum("kpm,km->kp", cut.G, d)
    V = np.einsum("kvp,kp->kv", cut.F, Y) + np.einsum("kvm,km->kv", cut.F_d, d)
    G = model.response(model.start, w)
    return Spectra(Y, np.einsum("kmp,kp->km", np.linalg.pinv(G), Y), V)


def _curvature_share(model: ResponseModel, signal: Multisine, found: Spectra, periods: int) -> float:
    """What the machine's curvature adds at the lines over the noise there of so many periods: of the worst output."""
    lines = signal.lines.astype(int)
    whole = np.zeros((2 * lines[-1] + 1, found.y.shape[1] + found.i.shape[1]), dtype=complex)
    whole[0], whole[lines] = np.concatenate([model.y, model.i]), np.hstack([found.y, found.i]) / 2
    y, i = np.split(whole, [found.y.shape[1]], axis=1)
    added = model.beyond_linear(model.start, y, i, 2 * np.pi / signal.period)[lines]
    samples = periods * signal.period / model.sample_time
    return float((np.sqrt((np.abs(added) ** 2).mean(axis=0) * samples) / sensor_noise(model.plant)).max())


def sensor_noise(plant: Plant) -> FloatArray:
    """The standard deviation of each sensor's noise and steps, SI."""
    return np.asarray(np.maximum(plant.sensors.deviations, NOISE_FLOOR))


def _peaks(signal: Multisine, spectrum: ComplexArray) -> FloatArray:
    """The largest value of each column under the lines of each input alone, inputs x columns."""
    axis = signal.axis.astype(int)
    own = (spectrum * (axis == j)[:, None] for j in range(signal.inputs))
    return np.array([_together(signal, one) for one in own])


def _together(signal: Multisine, spectrum: ComplexArray) -> FloatArray:
    """The largest value of each column within a period."""
    samples = 16 * int(signal.lines[-1])
    whole = np.zeros((samples // 2 + 1, spectrum.shape[1]), dtype=complex)
    whole[signal.lines.astype(int)] = spectrum * samples / 2
    return np.asarray(np.abs(np.fft.irfft(whole, samples, axis=0)).max(axis=0))


def _plan(
    loop: Loop, model: ResponseModel, signal: Multisine, periods: int, found: Spectra, *, named: bool
) -> ExcitationPlan:
    """The plan of a signal with what it does in the linear loop."""
    plant = loop.plant
    samples = round(periods * signal.period / loop.sample_time)
    noise = sensor_noise(plant)
    motion = _together(signal, found.y)
    variance = noise[None] ** 2 / samples * np.ones((len(found.y), 1))
    slopes = model.slopes(model.start, 2 * np.pi * signal.frequencies)
    F = information(slopes, found.i / 2, variance)
    chosen = list(range(len(model.names))) if named else well_found(F, model.names, SHARE / 1.96)
    sigma = deviations(F[np.ix_(chosen, chosen)])
    most = (_together(signal, found.v) + np.abs(np.asarray(_rest_point(loop).v))) / np.array(
        plant.actuator.force_limit
    )
    outputs, inputs = [s.name for s in plant.outputs], [s.name for s in plant.inputs]
    return ExcitationPlan(
        signal,
        periods,
        motion=dict(zip(outputs, motion.tolist(), strict=True)),
        window=dict(zip(outputs, (MAX_MOTION * motion + MAX_DEVIATION * noise).tolist(), strict=True)),
        current=dict(zip(model.currents, _together(signal, found.i).tolist(), strict=True)),
        command=dict(zip(inputs, most.tolist(), strict=True)),
        accuracy={model.names[k]: 1.96 * float(s) for k, s in zip(chosen, sigma, strict=True)},
        unit=axes_of(plant)[0].unit,
    )


def _rest_point(loop: Loop) -> OperatingPoint:
    """The machine at rest where the loop is."""
    return trim(loop.plant, **{name: value for name, value in loop.at.items() if value})


def _require(
    loop: Loop, sizes: Mapping[str, float | None], counts: Mapping[str, int], band: tuple[float, float] | None
) -> tuple[float, float]:
    """The band, by default that of the loop. Raises InputError for what no excitation can be."""
    for name, value in {**sizes, **counts}.items():
        if value is not None and not (is_number(value) and value > 0):
            raise InputError("excite", name, describe(value), "a number above 0")
    if not loop.stable:
        raise InputError("excite", "loop", "an unstable one", "a loop that holds its machine")
    nyquist = 0.5 / loop.sample_time
    if band is None:
        return default_band(loop)
    if not 0 < band[0] < band[1] < nyquist:
        raise InputError("excite", "band", f"{band[0]:g} to {band[1]:g} Hz", f"rising, below {nyquist:g} Hz")
    return band


def _require_length(loop: Loop, period: float, periods: int) -> None:
    """Raise InputError for a flight that is too long, and a period that is no whole number of samples."""
    whole = period / loop.sample_time
    if (periods + 1) * whole > MAX_SAMPLES:
        raise InputError(
            "excite", "periods", f"{(periods + 1) * whole:.3g} samples of all", f"at most {MAX_SAMPLES:g}"
        )
    if abs(whole - round(whole)) > 1e-6:
        raise InputError("excite", "period", f"{whole:g} samples", "a whole number of samples")
