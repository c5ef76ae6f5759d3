"""The loop as it is measured: S, T, compliance and open loop at every sensor with bands, beside what is predicted.

Excitation d, law and machine are   v = F y + F_d d,   y = P v,   so that

    Y = G D,   G = S P F_d        and   S P = G F_d^-1,   S = I + S P F,   T = I - S,   l_i = 1 / S_ii - 1

in which F and F_d are those of the gain file, exactly, and only G is measured: S is linear in it, so that feedback
biases nothing and noise goes straight into bands (indirect method; Pintelon and Schoukens, System Identification, 2nd
ed., ch. 2 and 7).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from malta.arrays import ComplexArray, FloatArray
from malta.display import Curves, Description, display
from malta.errors import InputError
from malta.identification.excite import MAX_SAMPLES, Cut, ExcitationPlan, cut_loop, excite, sensor_noise
from malta.identification.log import Log
from malta.identification.spectra import (
    MIN_PERIODS,
    SIGMA,
    ResponseColumns,
    SpectralLine,
    columns_of,
    lines_of,
)
from malta.loops.classical import Disk, disk_sizes
from malta.loops.loop import Loop, loop
from malta.margins.loop_report import zone
from malta.model.parameters import box_words, units_of
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller, given_law

LAW_TOLERANCE = 0.02  # of a command at the lines, by which the law of the gain file may miss it
SAMPLES = 32  # machines at random in the box, beside its corners
MAX_TUBE_ERROR = 0.03  # of its width, by which a sampled tube may be too narrow on either side
MAX_MODEL_ERROR = 0.02  # of a predicted magnitude without a tube, by which a linear loop may miss the machine
CORNERS = 6  # parameters of which all corners are taken


class Curve(NamedTuple):
    """A response at k frequencies, measured and predicted: arrays k x channels.

    measured : complex
    deviation : standard deviation of the measured magnitude: noise, distortion and interpolation
    predicted : complex, of the machine in the gain file
    low, high : least and largest predicted magnitude over the uncertainty
    """

    measured: ComplexArray
    deviation: FloatArray
    predicted: ComplexArray
    low: FloatArray
    high: FloatArray

    def at(self, *channel: int) -> Curve:
        """The curve of one channel: arrays of k."""
        one: Any = (slice(None), *channel)
        return Curve(*(table[one] for table in self))

    @property
    def size(self) -> FloatArray:
        """The measured magnitude."""
        return np.abs(self.measured)

    def outside(self, factor: float) -> FloatArray:
        """By how many bands the magnitude is outside of the tube, above 0 where it is; `factor` deviations a band."""
        width = self.high - self.low
        room = np.where(width > 0, MAX_TUBE_ERROR * width, MAX_MODEL_ERROR * self.high)
        off = np.maximum(self.low - self.size, self.size - self.high) - room
        return np.asarray(off / np.maximum(factor * self.deviation, 1e-300) - 1)


@display
@dataclass(frozen=True, eq=False)
class Measurement:
    """The loop of a machine as measured, and as predicted over the uncertainty of its parameters.

    source : the logs
    sensors, forces : names
    w : k frequencies, rad/s
    S, T, L : of each sensor: sensitivity, complementary one and open loop, the others closed; k x p
    compliance : S P, m/N and its like, k x p x m
    largest : sigma_max(S), k x 1
    disks : disk margins of each sensor alone and of all at once, at the lines, with their 95 % lower ends
    machines : how many machines of the box the tube is of: sampled, not proven
    box : share of each parameter at the box's faces
    law : by how much the commands at the lines miss those of the gain file, as a share; NaN: no commands in the log
    experiments : logs; with as many as inputs nothing is interpolated

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> plan = malta.excite(
    ...     malta.loop(plant, controller), period=0.5, periods=4, band=(4, 400)
    ... )
    >>> run = malta.simulate(
    ...     plant, controller, malta.Scenario.excited(plan.signal, plan.duration)
    ... )
    >>> found = malta.measure(
    ...     controller, malta.identification.log_of(run), uncertainty={"K_A": 0.2}
    ... )
    >>> found.refusal, found.zones["x1"]
    ('', 'A')
    """

    source: str
    sensors: tuple[str, ...]
    forces: tuple[str, ...]
    w: FloatArray
    S: Curve
    T: Curve
    L: Curve
    compliance: Curve
    largest: Curve
    disks: tuple[tuple[Disk, float], ...]
    machines: int
    box: Mapping[str, float]
    law: float
    experiments: int

    @property
    def peaks(self) -> dict[str, tuple[float, float, float]]:
        """By sensor: the largest measured |S| at a line, the upper end of all 95 % bands, and its frequency, rad/s."""
        found = {}
        for i, name in enumerate(self.sensors):
            k = int(self.S.size[:, i].argmax())
            high = (self.S.size + SIGMA * self.S.deviation)[:, i].max()
            found[name] = (float(self.S.size[k, i]), float(high), float(self.w[k]))
        return found

    @property
    def zones(self) -> dict[str, str]:
        """The zone of ISO 14839-3 of each sensor, by the upper end of its largest |S|."""
        return {name: zone(high) for name, (_, high, _) in self.peaks.items()}

    @property
    def factor(self) -> float:
        """Deviations of a band that holds |S| and |T| at all lines and sensors together with 95 %."""
        return float(norm.isf(0.025 / (2 * self.S.size.size)))

    @property
    def refusal(self) -> str:
        """Why the machine is not as predicted: another law, or |S| or |T| outside of the tube; "": it is."""
        if self.law > LAW_TOLERANCE:
            return (
                f"another law flew, or at its limits: commands at the lines miss those of the gain file by "
                f"{100 * self.law:.2g} %"
            )
        off = {name: getattr(self, name).outside(self.factor) for name in ("S", "T")}
        name = max(off, key=lambda key: float(off[key].max()))
        k, i = np.unravel_index(int(off[name].argmax()), off[name].shape)
        if off[name][k, i] <= 0:
            return ""
        one: Curve = getattr(self, name)
        return (
            f"|{name}| of {self.sensors[i]} at {self.w[k] / (2 * np.pi):.4g} Hz is {one.size[k, i]:.3g} +- "
            f"{self.factor * one.deviation[k, i]:.2g}, predicted {one.low[k, i]:.3g} to {one.high[k, i]:.3g}"
        )

    @property
    def description(self) -> Description:
        """The verdict, peaks with zones and disk margins."""
        peaks = ", ".join(f"{name} {p:.3g} {self.zones[name]}" for name, (p, _, _) in self.peaks.items())
        all_at_once, low = self.disks[-1]
        rows = (
            ("verdict", self.refusal or "as predicted"),
            ("largest |S|", peaks),
            ("disk margin", f"{all_at_once.size:.3g} of all sensors, at least {low:.3g} with 95 %"),
            ("predicted", f"{self.machines} machines, sampled: {box_words(self.box) or 'no uncertainty'}"),
        )
        tops = {"measured": self.largest.size[:, 0], "predicted": np.abs(self.largest.predicted[:, 0])}
        curves = Curves(self.w, "frequency [rad/s]", tops, "sigma_max(S) [1]", logarithmic=True)
        return Description(f"Loop as measured in {self.source!r}", rows, curves)


def measure(
    controller: Controller,
    *logs: Log,
    parameters: Any = None,
    uncertainty: Mapping[str, float] | None = None,
    seed: int = 0,
) -> Measurement:
    """Measure the loop from logs under a periodic excitation, and judge it by what is predicted over a box.

    The machine is held at the controller's operating point. Of a machine whose currents are commutated for the last
    reading and held, the loop is cut at the law's reading; commutation belongs to the machine.

    controller : the gain file that was running
    logs : with the excitation, whole periods of it; as many as inputs that excite each line in different inputs, or
        one whose lines excite one input each
    parameters : of the machine that is predicted; None: those of the controller
    uncertainty : by parameter: half width of the box as a share; None or {}: none
    seed : of the sampled machines

    Returns a Measurement, also where its `refusal` says that the machine is not as predicted.

    Raises InputError for signals or parameters of another machine. Raises CheckError for logs that tell nothing: too
    short, without a periodic excitation, lines of several inputs in too few logs, below the noise.

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> plan = malta.excite(
    ...     malta.loop(plant, controller), period=0.5, periods=4, band=(4, 400)
    ... )
    >>> strong = plant.variant(
    ...     dataclasses.replace(plant.parameters, K_B=8.0)
    ... )  # outside of the box
    >>> run = malta.simulate(
    ...     strong, controller, malta.Scenario.excited(plan.signal, plan.duration)
    ... )
    >>> found = malta.measure(
    ...     controller, malta.identification.log_of(run), uncertainty={"K_B": 0.2}
    ... )
    >>> found.refusal.startswith("|S| of"), 2.2 < found.peaks["x1"][0] < 2.6
    (True, True)
    """
    controller = given_law("measure", controller)
    if not logs:
        raise InputError("measure", "logs", "none", "at least one log")
    plant = plant_of(controller.parameters if parameters is None else parameters)
    predicted = loop(plant, controller)
    box = dict(uncertainty or {})
    loops = machines_of(predicted, box, seed)
    lines = [found for log in logs for found in lines_of(log, predicted)]
    w = np.unique(np.array([line.w for line in lines]))
    cut = cut_loop(predicted, w)
    columns = columns_of(lines, w, cut.G)
    names = tuple(s.name for s in plant.outputs), tuple(s.name for s in plant.inputs)
    machines = [cut_loop(one, w) for one in loops]
    (S, T, L, SP, largest), deviation = _curves(columns, cut, machines)
    source = ", ".join(log.source for log in logs)
    law = _law_misses(lines, cut, w)
    disks = _disks(sensitivity_of(columns, cut), deviation, w, names[0])
    return Measurement(source, *names, w, S, T, L, SP, largest, disks, len(machines), box, law, len(logs))


@display
@dataclass(frozen=True, eq=False)
class MeasurementPlan:
    """What will be flown to measure a loop, and how well it will be known, by the linear loop.

    excitations : a flight each; with as many as inputs nothing is interpolated
    sensors : names
    w : k frequencies, rad/s
    S : predicted sensitivity of each sensor, k x p
    half_width : of the 95 % band of |S|, k x p; of the machine in the gain file, where interpolation misses nothing
    coherence : by sensor: with the excitation within a period, at the lines of the input that moves it most

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> plan = malta.identification.plan_measurement(loop, width=0.02)
    >>> 30 < plan.excitations[0].periods < 60, bool(plan.worst < 0.02)
    (True, True)
    """

    excitations: tuple[ExcitationPlan, ...]
    sensors: tuple[str, ...]
    w: FloatArray
    S: ComplexArray
    half_width: FloatArray
    coherence: Mapping[str, FloatArray]

    @property
    def worst(self) -> float:
        """The largest half width of a band, as a share of |S|, or of 1 where |S| is less."""
        return float((self.half_width / np.maximum(np.abs(self.S), 1.0)).max())

    @property
    def duration(self) -> float:
        """Of all flights, s."""
        return sum(one.duration for one in self.excitations)

    @property
    def description(self) -> Description:
        """What flies, how far it moves, and how wide the bands will be."""
        signal = self.excitations[0].signal
        motion = max(max(one.motion.values()) for one in self.excitations)
        rows = (
            ("flights", f"{len(self.excitations)}, {self.duration:g} s in all"),
            ("lines", f"{len(signal.lines)} from {signal.frequencies[0]:g} to {signal.frequencies[-1]:g} Hz"),
            ("motion", f"{motion:.3g} at most, SI"),
            ("bands", f"{100 * self.worst:.2g} % of |S| at most"),
            ("coherence", f"{min(one.min() for one in self.coherence.values()):.4f} at least, of a period"),
        )
        return Description("Plan of a measurement", rows)


def plan_measurement(
    loop: Loop, *, width: float | None = None, separate: bool = False, **options: Any
) -> MeasurementPlan:
    """Plan the runs that measure a loop: excitation, length, and the bands and coherence to expect of them.

    Noise and steps n of the sensors leave S n in the readings. Its Fourier coefficients have the covariance
    S diag(sigma^2) S^H / N in N samples, which goes through `measure` as a log's own does.

    loop : the machine under its controller
    width : half of the widest 95 % band as a share of |S|, or of 1 where |S| is less; None: as the periods give it
    separate : whether each line shall excite each input, in as many runs as inputs
    options : of `malta.excite`: force, current, motion, period, periods, band, lines, seed

    Returns a MeasurementPlan.

    Raises InputError as `malta.excite`, and for a width that is not above 0.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> loop = malta.loop(malta.plant_of(controller.parameters), controller)
    >>> plan_measurement = malta.identification.plan_measurement
    >>> plan = plan_measurement(loop, separate=True, motion=10e-6, periods=4)
    >>> len(plan.excitations), plan.duration
    (5, 25.0)
    """
    if width is not None and not (np.isfinite(width) and width > 0):
        raise InputError("measure", "width", f"{width:g}", "a share above 0")
    found = _plan_flights(loop, separate=separate, **options)
    if width is None:
        return found
    while True:
        first = found.excitations[0]
        periods = max(MIN_PERIODS, int(np.ceil(min(first.periods * (found.worst / width) ** 2, 1e12))))
        samples = periods * first.signal.period / loop.sample_time
        if samples > MAX_SAMPLES:
            raise InputError(
                "measure", "width", f"{samples:.3g} samples for it", f"at most {MAX_SAMPLES:g}: excite more"
            )
        # Where no size is given, curvature is kept beside the noise: a longer flight is excited less.
        found = _plan_flights(loop, separate=separate, **options | {"periods": periods})
        if found.worst <= width * (1 + 1e-9):
            return found


def _plan_flights(loop: Loop, *, separate: bool, **options: Any) -> MeasurementPlan:
    """The flights of these options, and what they will tell."""
    plant = loop.plant
    shifts = range(len(plant.inputs) if separate else 1)
    plans = tuple(excite(loop, **options, shift=k) for k in shifts)
    w = 2 * np.pi * plans[0].signal.frequencies
    cut, k = cut_loop(loop, w), np.arange(len(w))
    S, G = cut.S, cut.G
    samples = plans[0].periods * round(plans[0].signal.period / loop.sample_time)
    noisy = S * sensor_noise(plant)
    C = noisy @ noisy.conj().transpose(0, 2, 1) / samples
    variance = np.einsum("kpp->kp", C).real * plans[0].periods
    lines, moved = [], np.zeros((len(plant.inputs), *S.shape[:2]))
    for plan in plans:
        d = np.zeros((len(w), len(plant.inputs)), dtype=complex)
        d[k, plan.signal.axis.astype(int)] = plan.signal.amplitude * np.exp(1j * plan.signal.phase) / 2
        y = np.einsum("kpm,km->kp", G, d)
        moved[plan.signal.axis.astype(int), k] = np.abs(y) ** 2
        nothing = np.zeros(0, dtype=complex)
        lines += [
            SpectralLine(at, *one) for at, *one in zip(w.tolist(), d, y, [nothing] * len(w), C, strict=True)
        ]
    curve = _curves(columns_of(lines, w, G), cut, [cut])[0][0]
    coherence, sensors = {}, tuple(s.name for s in plant.outputs)
    for i, name in enumerate(sensors):
        power = moved[moved[:, :, i].sum(axis=1).argmax(), :, i]
        own = power > 0
        coherence[name] = power[own] / (power[own] + variance[own, i])
    return MeasurementPlan(plans, sensors, w, curve.measured, SIGMA * curve.deviation, coherence)


def machines_of(
    predicted: Loop, box: Mapping[str, float], seed: int, samples: int | None = None
) -> list[Loop]:
    """The machine, and those at the corners and at random places of the box, all under the same law."""
    par = predicted.plant.parameters
    names, shares = list(box), np.array(list(box.values()))
    for name in names:
        if name not in units_of(par):
            expected = "one of " + " ".join(units_of(par))
            raise InputError("measure", f"uncertainty.{name}", "an unknown parameter", expected)
    if not names:
        return [predicted]
    corners = list(product((-1.0, 1.0), repeat=len(names))) if len(names) <= CORNERS else []
    random = np.random.default_rng(seed).uniform(-1, 1, (SAMPLES if samples is None else samples, len(names)))
    places = np.vstack([np.array(corners).reshape(-1, len(names)), random])
    found, at = [predicted], dict[str, Any](predicted.at)
    for place in places:
        values = {
            name: float(getattr(par, name)) * (1 + share)
            for name, share in zip(names, shares * place, strict=True)
        }
        found.append(loop(predicted.plant, predicted.controller, parameters=values, **at))
    return found


def _curves(columns: ResponseColumns, cut: Cut, machines: Sequence[Cut]) -> tuple[list[Curve], FloatArray]:
    """S, T and L of each sensor, S P, and sigma_max(S): measured, predicted, and their tube; and deviations of S.

    Those are of a part of each entry of S, k x p x p.
    """
    into = np.linalg.inv(cut.F_d)
    M = into @ cut.F
    S = sensitivity_of(columns, cut)
    variances = np.einsum("kjpp->kpj", columns.covariance).real
    s, dev = np.einsum("kpp->kp", S), np.sqrt(variances @ np.abs(M) ** 2 / 2)
    dev_s = np.einsum("kpp->kp", dev)
    dev_c = np.sqrt(variances @ np.abs(into) ** 2 / 2)
    u, sigma, vh = np.linalg.svd(S)
    along = np.einsum("kp,kjpq,kq->kj", u[:, :, 0].conj(), columns.covariance, u[:, :, 0]).real
    dev_top = np.sqrt((along * np.abs(np.einsum("kjp,kp->kj", M, vh[:, 0].conj())) ** 2).sum(axis=1) / 2)
    found = (s, 1 - s, 1 / s - 1, columns.G @ into, sigma[:, :1].astype(complex))
    deviations = (dev_s, dev_s, dev_s / np.abs(s) ** 2, dev_c, dev_top[:, None])
    curves = []
    tubes = zip(*(_predict_responses(one) for one in machines), strict=True)
    for value, deviation, same in zip(found, deviations, tubes, strict=True):
        sizes = np.abs(np.array(same))
        curves.append(Curve(value, deviation, same[0], sizes.min(axis=0), sizes.max(axis=0)))
    return curves, dev


def sensitivity_of(columns: ResponseColumns, cut: Cut) -> ComplexArray:
    """S = I + G F_d^-1 F as measured, k x p x p."""
    return np.asarray(np.eye(columns.G.shape[1]) + columns.G @ np.linalg.solve(cut.F_d, cut.F))


def loop_curves(loop: Loop, w: FloatArray) -> tuple[ComplexArray, ...]:
    """S, T and L of each sensor, k x p, and S P and P, k x p x m, of a loop at frequencies below Nyquist's, rad/s."""
    cut = cut_loop(loop, w)
    return *_predict_responses(cut)[:4], cut.P


def _predict_responses(cut: Cut) -> tuple[ComplexArray, ...]:
    """S, T and L of each sensor, S P, and sigma_max(S), of a loop."""
    S = cut.S
    s = np.einsum("kpp->kp", S)
    return s, 1 - s, 1 / s - 1, S @ cut.P, np.linalg.norm(S, 2, axis=(1, 2))[:, None].astype(complex)


def _disks(
    S: ComplexArray, deviation: FloatArray, w: FloatArray, sensors: Sequence[str]
) -> tuple[tuple[Disk, float], ...]:
    """The disk margin of each sensor alone and of all at once, at the lines, with the lower end of its 95 % band."""
    sizes = [1 / np.abs(S[:, i, i] - 0.5) for i in range(len(sensors))]
    offs = [deviation[:, i, i] for i in range(len(sensors))]
    sizes.append(disk_sizes(S))
    offs.append(np.linalg.norm(deviation, axis=(1, 2)))
    names, found = [*(f"{name} alone" for name in sensors), "sensors"], []
    for name, size, off in zip(names, sizes, offs, strict=True):
        disk = Disk(name, float(size.min()), float(w[size.argmin()]))
        found.append((disk, float((size / (1 + SIGMA * off * size)).min())))
    return tuple(found)


def _law_misses(lines: Sequence[SpectralLine], cut: Cut, w: FloatArray) -> float:
    """The rms of V - F Y - F_d D over that of V, of all lines; NaN without commands."""
    if not len(lines[0].v):
        return float("nan")
    off, all_of = 0.0, 0.0
    for line in lines:
        k = int(np.searchsorted(w, line.w))
        v = cut.F[k] @ line.y + cut.F_d[k] @ line.d
        off += float((np.abs(line.v - v) ** 2).sum())
        all_of += float((np.abs(line.v) ** 2).sum())
    return float(np.sqrt(off / max(all_of, 1e-300)))
