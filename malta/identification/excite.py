"""An excitation of all axes at once, and what it will do and find, before anything flies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import casadi as ca
import numpy as np

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
from malta.model.plant import outputs_at
from malta.simulation.inputs import Multisine, interleaved_multisine

if TYPE_CHECKING:
    from malta.loops.loop import Loop

BAND = (2.0, 400.0)  # Hz
LINES = 12  # of each input
PERIODS = 10
SHARE = 0.5  # of its value: a parameter that is found worse is not asked for by itself
QUIET = 1e-9  # m or rad: noise of a sensor that has none
LONGEST = 5e7  # samples of a flight
WIDE, FAR = 2.0, 5.0  # times the largest motion, deviations of the noise: beyond both another machine flies
CURRENT = 0.1  # of the current limit: the amplitude where none is given


@display
@dataclass(frozen=True, eq=False)
class ExcitationPlan:
    """A multisine for a loop, and what is predicted of it from the linear loop.

    signal : the multisine
    periods : that are logged, after one in which the loop settles
    motion : by output: largest deviation, SI
    window : by output: twice that and five deviations of its noise, SI: a reading beyond it should end the flight
    current : by measured current: largest deviation from the current at rest, A
    command : by input: the largest command, with the one that holds the machine, as a share of its limit
    accuracy : by parameter: half of the 95 % interval that the log will give, as a share of its value

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
            ("current", f"{quantity(max(self.current.values()), 'A')} at most beside that at rest"),
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
    period: float = 1.0,
    periods: int = PERIODS,
    band: tuple[float, float] = BAND,
    lines: int = LINES,
    parameters: Sequence[str] = (),
    seed: int = 0,
    shift: int = 0,
) -> ExcitationPlan:
    """Design an excitation of all axes at once, and predict from the linear loop what it does and what it will find.

    Each input has lines of its own, evenly spread in log f, with phases of a low crest factor. The amplitude of an axis
    is the same at all of its lines.

    loop : the machine under its controller, where it is held
    force : largest force of each input, N or N m
    current : largest current beside the one at rest, A; 10 % of its limit where no size is given
    motion : largest deviation of any output, m or rad; of several limits the strictest counts
    period : s
    periods : that are logged
    band : Hz, lowest and highest line
    lines : of each input
    parameters : whose accuracy is predicted; (): those that will be found to 50 %, but for masses and lengths
    seed : of the phases
    shift : by how many inputs the lines are dealt later; as many plans as inputs excite each line in each of them

    Returns an ExcitationPlan.

    Raises InputError for a band with too few lines or above half of the sampling rate, unknown parameters, and an
    unstable loop.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> plan = malta.excite(loop, motion=10e-6)
    >>> f"{1e6 * max(plan.motion.values()):.1f} um, K_A to {plan.accuracy['K_A']:.2%}"
    '10.0 um, K_A to 0.13%'
    """
    sizes = {"force": force, "current": current, "motion": motion, "period": period}
    _require(loop, sizes, {"periods": periods, "lines": lines}, band)
    plant, m = loop.plant, len(loop.plant.inputs)
    signal = interleaved_multisine(period, *band, inputs=m, lines=lines, seed=seed, shift=shift)
    limit = np.array(plant.actuator.force_limit)
    wanted = np.full(m, np.inf if force is None else force)
    if force is None and current is None and motion is None:
        current = CURRENT * plant.actuator.current_limit
    unit = replace(signal, amplitude=(limit / signal.peak)[signal.axis.astype(int)])
    model = model_at(loop, (*parameters,) or candidates(plant))
    found = predicted_spectra(loop, model, unit)
    share, axis = np.minimum(wanted / limit, 1.0), unit.axis.astype(int)
    limits = [(part, most) for part, most in ((found.i, current), (found.y, motion)) if most is not None]
    for spectrum, most in limits:  # each input alone, then all together
        share = np.minimum(share, most / np.maximum(_peaks(unit, spectrum).max(axis=1), 1e-300))
    for spectrum, most in limits:
        share = share * min(1.0, most / _together(unit, spectrum * share[axis][:, None]).max())
    signal = replace(unit, amplitude=unit.amplitude * share[axis])
    return _plan(loop, model, signal, periods, found.times(share[axis]), named=bool(parameters))


def model_at(loop: Loop, names: Sequence[str]) -> ResponseModel:
    """The response of a loop's machine where it is held."""
    plant = loop.plant
    at = {name: value for name, value in loop.at.items() if value}
    point = trim(plant, **at)
    y = outputs_at(plant, point.x)
    coils = ca.DM(plant.currents(ca.DM(y), ca.DM(point.v)))
    i = np.array(
        coils if plant.windings is None else ca.evalf(ca.densify(plant.drive.command(coils)))
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
    sampled = loop.sampled_forces
    law, z = sampled.control, np.exp(1j * w * loop.sample_time)[:, None, None]
    fed = slice(-2 * m, -m)  # of the law's references: the forces that are fed forward
    P = sampled.Cd @ np.linalg.solve(z * np.eye(len(sampled.Ad)) - sampled.Ad, sampled.Bd)
    states = np.linalg.solve(z * np.eye(len(law.A)) - law.A, np.hstack([law.B_y, law.B_r[:, fed]]))
    F = law.C @ states + np.hstack([law.D_y, law.D_r[:, fed]])
    own, sent = F[..., : P.shape[1]], np.einsum("kvm,km->kv", F[..., P.shape[1] :], d)
    moved = np.einsum("kpv,kv->kp", P, sent)
    Y = np.linalg.solve(np.eye(P.shape[1]) - P @ own, moved[..., None])[..., 0]
    V = np.einsum("kvp,kp->kv", own, Y) + sent
    G = model.response(model.start, w)
    return Spectra(Y, np.einsum("kmp,kp->km", np.linalg.pinv(G), Y), V[:, :m])


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
    noise = np.hypot(plant.noise, np.array(plant.resolution) / np.sqrt(12))
    motion = _together(signal, found.y)
    variance = np.maximum(noise, QUIET)[None] ** 2 / samples * np.ones((len(found.y), 1))
    slopes = model.slopes(model.start, 2 * np.pi * signal.frequencies)
    F = information(slopes, found.i / 2, variance)
    chosen = list(range(len(model.names))) if named else well_found(F, model.names, SHARE / 1.96)
    sigma = deviations(F[np.ix_(chosen, chosen)])
    held = trim(plant, **{name: value for name, value in loop.at.items() if value}).v
    assert held is not None
    most = (_together(signal, found.v) + np.abs(held)) / np.array(plant.actuator.force_limit)
    outputs, inputs = [s.name for s in plant.outputs], [s.name for s in plant.inputs]
    return ExcitationPlan(
        signal,
        periods,
        motion=dict(zip(outputs, motion.tolist(), strict=True)),
        window=dict(zip(outputs, (WIDE * motion + FAR * noise).tolist(), strict=True)),
        current=dict(zip(model.currents, _together(signal, found.i).tolist(), strict=True)),
        command=dict(zip(inputs, most.tolist(), strict=True)),
        accuracy={model.names[k]: 1.96 * float(s) for k, s in zip(chosen, sigma, strict=True)},
    )


def _require(
    loop: Loop, sizes: Mapping[str, float | None], counts: Mapping[str, int], band: tuple[float, float]
) -> None:
    """Raise InputError for what no excitation can be."""
    for name, value in {**sizes, **counts}.items():
        if value is not None and not (np.isfinite(value) and value > 0):
            raise InputError("excite", name, str(value), "a number above 0")
    period = sizes["period"] or 0.0
    samples = (counts["periods"] + 1) * period / loop.sample_time
    if samples > LONGEST:
        raise InputError("excite", "periods", f"{samples:.3g} samples of all", f"at most {LONGEST:g}")
    nyquist, whole = 0.5 / loop.sample_time, period / loop.sample_time
    if not 0 < band[0] < band[1] < nyquist:
        raise InputError("excite", "band", f"{band[0]:g} to {band[1]:g} Hz", f"rising, below {nyquist:g} Hz")
    if abs(whole - round(whole)) > 1e-6:
        raise InputError("excite", "period", f"{whole:g} samples", "a whole number of samples")
    if not loop.stable:
        raise InputError("excite", "loop", "an unstable one", "a loop that holds its machine")
