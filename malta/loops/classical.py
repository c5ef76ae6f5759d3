"""Classical margins of one loop at nominal parameters: disks, delays and the gang of four."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.display import display
from malta.linear.uncertain import Compensator, UncertainSystem, find_peaks, instability, responses

ROUNDS = 60  # of the balance of a matrix at most
BALANCED = 1e-9  # relative difference of norms of rows and columns


Response = Callable[["FloatArray"], tuple["ComplexArray", "ComplexArray"]]


class Nominal(NamedTuple):
    """A nominal loop y = P u, u = F y by its responses, positive feedback.

    response : frequencies w (rad/s) -> P, k x p x m, and F, k x m x p
    stable : whether the loop is stable
    sample_time : s; None: continuous
    forces : how many of the inputs u, the first ones, are forces of the law; None: all. The others, as currents that
        are held for a sample, hang on readings: at the forces they are part of the machine
    """

    response: Response
    stable: bool
    sample_time: float | None
    forces: int | None = None

    @property
    def frequencies(self) -> FloatArray:
        """A grid up to the Nyquist frequency, rad/s."""
        return np.geomspace(1e-2, 1e5 if self.sample_time is None else np.pi / self.sample_time, 400)


def remembered(response: Response) -> Response:
    """The same responses, each grid of frequencies computed once: every margin begins with the same."""
    known: dict[bytes, tuple[ComplexArray, ComplexArray]] = {}

    def lookup(w: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        key = w.tobytes()
        if key not in known:
            known[key] = response(w)
        return known[key]

    return lookup


def nominal_loop(system: UncertainSystem, law: Compensator) -> Nominal:
    """A loop at its nominal parameters."""

    @remembered
    def response(w: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        r = responses(system, law, system.nominal, w)
        return r.G_y, r.F

    stable = bool(instability(system, law, system.nominal)[0] < 0)
    return Nominal(response, stable, law.sample_time)


@dataclass(frozen=True)
class Disk:
    """A symmetric disk margin: factors (1 + d/2) / (1 - d/2) with |d| < size in the channels keep the loop stable."""

    channels: str
    size: float
    frequency: float  # rad/s

    @property
    def gain(self) -> float:
        """The gain margin, a factor up or down; infinite from size 2 on."""
        return (1 + self.size / 2) / (1 - self.size / 2) if self.size < 2 else float("inf")

    @property
    def phase(self) -> float:
        """The phase margin, rad."""
        return float(2 * np.arctan(self.size / 2))


@display
class Classical(NamedTuple):
    """The classical margins of one loop, or the worst of several loops."""

    disks: tuple[Disk, ...]
    delay: dict[str, float]  # s, by sensor
    gang: dict[str, tuple[float, ...]]  # by sensor: largest |S|, |T|, |S P| (m/N), |F S| (N/m)


def classical_margins(loop: Nominal, sensors: Sequence[str]) -> Classical:
    """The disk margins, delay margins and the gang of four of a stable loop; `sensors` names the rows of y."""
    w = loop.frequencies
    P, F = loop.response(w)
    disks = [disk_margin(loop, kind) for kind in ("forces", "sensors", "forces and sensors")]
    disks += disk_margins_alone(loop, sensors)
    delays = delay_margins(P @ F, w).tolist()
    return Classical(
        tuple(disks),
        dict(zip(sensors, delays, strict=True)),
        dict(zip(sensors, gang_of_four(P, F, loop.forces), strict=True)),
    )


def worst_of(margins: Sequence[Classical | None]) -> Classical | None:
    """The worst margins of several loops; None where one of them has none."""
    found = [one for one in margins if one is not None]
    if len(found) < len(margins):
        return None
    disks = tuple(min(same, key=lambda d: d.size) for same in zip(*(one.disks for one in found), strict=True))
    first = found[0]
    return Classical(
        disks,
        {name: min(one.delay[name] for one in found) for name in first.delay},
        {
            name: tuple(max(values) for values in zip(*(one.gang[name] for one in found), strict=True))
            for name in first.gang
        },
    )


def disk_margin(loop: Nominal, kind: Literal["forces", "sensors", "forces and sensors"]) -> Disk:
    """The symmetric disk margin of the nominal loop, of all channels at once, each with its own factor.

    With the loop's positive feedback Q, factors (1 + d/2) / (1 - d/2) keep it stable while |d| < 1 / mu(M),
    M = (1 - Q)^-1 - 1/2 (Seiler, Packard, Gahinet 2020). For several channels mu is bounded above by a balanced
    D M D^-1, so the margin is a lower bound; for one channel it is exact.
    """

    def sizes(w: FloatArray) -> FloatArray:
        P, F = loop.response(w)
        if kind == "forces":
            Q = loop_at_forces(P, F, loop.forces)
        elif kind == "sensors":
            Q = P @ F
        else:
            P_m, F_m, held = _divided(P, F, loop.forces)
            Q = np.block([[held, P_m], [F_m, np.zeros((len(w), F_m.shape[1], F_m.shape[1]))]])
        return np.asarray(balanced_norm(_disk_matrix(Q))[:, None])

    (mu,), (at,) = find_peaks(sizes, loop.frequencies)
    return Disk(kind, float(1 / mu), float(at))


def _divided(
    P: ComplexArray, F: ComplexArray, forces: int | None
) -> tuple[ComplexArray, ComplexArray, ComplexArray]:
    """P and F of the forces alone, and what readings do to outputs besides."""
    m = P.shape[-1] if forces is None else forces
    return P[..., :m], F[:, :m], P[..., m:] @ F[:, m:]


def loop_at_forces(P: ComplexArray, F: ComplexArray, forces: int | None) -> ComplexArray:
    """The loop from forces to forces, positive feedback: what else hangs on readings belongs to the machine."""
    P_m, F_m, held = _divided(P, F, forces)
    if F_m.shape[1] < F.shape[1]:
        P_m = np.linalg.solve(np.eye(P.shape[1]) - held, P_m)
    return np.asarray(F_m @ P_m)


def disk_margins_alone(loop: Nominal, sensors: Sequence[str]) -> list[Disk]:
    """The symmetric disk margin of each sensor alone, in the order of the rows of y."""

    def sizes(w: FloatArray) -> FloatArray:
        P, F = loop.response(w)
        return np.asarray(np.abs(np.einsum("kii->ki", _disk_matrix(P @ F))[:, : len(sensors)]))

    peaks = zip(*find_peaks(sizes, loop.frequencies), strict=True)
    return [
        Disk(f"{name} alone", float(1 / mu), float(at)) for name, (mu, at) in zip(sensors, peaks, strict=True)
    ]


def disk_sizes(S: ComplexArray) -> FloatArray:
    """The disk margin of all channels at once at each frequency, from sensitivities S, k x p x p: a lower bound."""
    return np.asarray(1 / balanced_norm(S - np.eye(S.shape[-1]) / 2))


def _disk_matrix(Q: ComplexArray) -> ComplexArray:
    eye = np.eye(Q.shape[-1])
    return np.asarray(np.linalg.inv(eye - Q) - eye / 2)


def balanced_norm(M: ComplexArray) -> FloatArray:
    """sigma_max of D M D^-1, D diagonal so that norms of rows and columns agree (Osborne): an upper bound of mu."""
    size = np.abs(M)
    d = np.ones((*size.shape[:2], 1))
    off = (size * (1 - np.eye(size.shape[-1]))) ** 2
    turned = np.ascontiguousarray(off.swapaxes(1, 2))
    for _ in range(ROUNDS):
        squares = d**2
        rows, columns = np.sqrt(squares * (off @ (1 / squares))), np.sqrt(turned @ squares / squares)
        both = (rows > 0) & (columns > 0)
        ratio = np.where(both, columns / np.where(both, rows, 1), 1)
        d = d * ratio**0.25
        if np.abs(ratio - 1).max(initial=0.0) < BALANCED:
            break
    return np.asarray(np.linalg.svd(M * d / d.swapaxes(1, 2), compute_uv=False)[:, 0])


def delay_margins(L: ComplexArray, w: FloatArray) -> FloatArray:
    """The delay margin of each channel with the others closed, s: the smallest phi(w) / w at its gain crossovers.

    L : k x p x p, the loop y = L y at the frequencies w (rad/s). Infinite for a channel without a crossover.
    """
    eye = np.eye(L.shape[-1])
    S = np.einsum("kii->ki", np.linalg.inv(eye - L))
    alone = 1 / S - 1  # the open loop of one channel, negative feedback
    size = np.log(np.abs(alone))
    phase = np.unwrap(np.angle(alone), axis=0)
    found = np.full(L.shape[-1], np.inf)
    for i in range(len(found)):
        k = np.flatnonzero(np.sign(size[1:, i]) != np.sign(size[:-1, i]))
        share = size[k, i] / (size[k, i] - size[k + 1, i])
        at = w[k] * (w[k + 1] / w[k]) ** share
        angle = phase[k, i] + share * (phase[k + 1, i] - phase[k, i])
        if len(k):
            found[i] = (np.mod(angle + np.pi, 2 * np.pi) / at).min()
    return found


def peak_sensitivity(loop: Nominal, at: Literal["forces", "sensors"]) -> float:
    """The largest |S_ii| over all frequencies and channels at nominal parameters; NaN for an unstable loop."""
    if not loop.stable:
        return float("nan")

    def sizes(w: FloatArray) -> FloatArray:
        P, F = loop.response(w)
        Q = loop_at_forces(P, F, loop.forces) if at == "forces" else P @ F
        S = np.linalg.inv(np.eye(Q.shape[-1]) - Q)
        return np.asarray(np.abs(np.einsum("kii->ki", S)))

    return float(find_peaks(sizes, loop.frequencies)[0].max())


def gang_of_four(P: ComplexArray, F: ComplexArray, forces: int | None = None) -> list[tuple[float, ...]]:
    """For each sensor i the largest |S_ii|, |T_ii|, |(S P)_ij| (m/N) and |(F S)_ji| (N/m) over frequency.

    forces : how many of the inputs are forces, as in `Nominal`
    """
    S = np.linalg.inv(np.eye(P.shape[1]) - P @ F)
    T = np.eye(P.shape[1]) - S
    P_m, F_m, _ = _divided(P, F, forces)
    compliance, noise = np.abs(S @ P_m), np.abs(F_m @ S)
    return [
        (
            float(np.abs(S[:, i, i]).max()),
            float(np.abs(T[:, i, i]).max()),
            float(compliance[:, i].max()),
            float(noise[:, :, i].max()),
        )
        for i in range(P.shape[1])
    ]


# The margins of one channel at a time, the others closed, at exact crossings; of unstable open loops as well.
#
# l = T_ii / S_ii        what channel i sees around itself, negative feedback
# 1 + k l(jw) = 0        at the factors k = -1 / l where l is real and negative: 0, the Nyquist frequency and
#                        infinity among them. The nearest below and above 1 bound the stable ones.


FARTHEST = 1e6  # factors of gain beyond which a margin counts as infinite
STEPS = 6  # of the false position at each crossing
PEAKS = 2  # parabolas through the three values about each peak


class Crossing(NamedTuple):
    """A place at which |l| = 1 or l is real and negative."""

    frequency: float  # rad/s
    value: complex  # l there


@dataclass(frozen=True)
class ChannelMargins:
    """The classical margins of one channel, the others closed. NaN for an unstable loop.

    The loop is stable for every factor of gain in `gain` and for none next to it: an open loop that is unstable has a
    lower bound as well. Encirclements of -1 are counted counterclockwise, over negative and positive frequencies.
    """

    channel: str
    stable: bool  # the closed loop
    gain: tuple[float, float]  # factors; 0 and inf where nothing bounds them
    gain_frequency: tuple[float, float]  # rad/s; NaN where nothing bounds them
    phase: float  # rad, the smallest turn of either sign; inf without a gain crossing
    phase_frequency: float  # rad/s
    delay: float  # s; inf without a gain crossing
    delay_frequency: float  # rad/s
    disk: Disk  # symmetric
    peak_sensitivity: float  # max |S_ii|; its inverse is the modulus margin
    peak_frequency: float  # rad/s
    unstable_poles: int  # with this channel open; poles on the axis count as stable
    encirclements: int  # unstable_poles minus those of the closed loop
    gain_crossings: tuple[Crossing, ...]  # |l| = 1
    phase_crossings: tuple[Crossing, ...]  # l < 0

    @property
    def modulus(self) -> float:
        """The modulus margin, the shortest distance of l(jw) from -1: 1 / max |S_ii|."""
        return 1 / self.peak_sensitivity


class Seen(NamedTuple):
    """What channels see: l and S_ii at frequencies, k x channels each."""

    w: FloatArray  # rad/s, ascending; the last is the Nyquist frequency of a sampled loop
    loop: ComplexArray
    S: ComplexArray


See = Callable[["FloatArray"], Seen]


def find_crossings(see: See, seen: Seen) -> tuple[list[list[Crossing]], list[list[Crossing]]]:
    """Gain and phase crossings of each channel between the frequencies of `seen`, by false position."""
    turn = seen.loop.imag
    with np.errstate(divide="ignore"):
        size = np.log(np.abs(seen.loop))
    behind = (seen.loop.real[1:] < 0) | (seen.loop.real[:-1] < 0)
    found: list[tuple[list[list[Crossing]], Any, bool]] = []
    channels = seen.loop.shape[1]
    for values, also, phase in ((size, True, False), (turn, behind, True)):
        ends = np.sign(values[:-1]) * np.sign(values[1:]) < 0
        found.append(([[] for _ in range(channels)], np.argwhere(ends & also), phase))
    rows = [(k, i, phase) for _, where, phase in found for k, i in where.tolist()]
    if rows:
        k, i, phase = np.array(rows).T
        w, values = _false_position(see, seen, k, i, phase == 1)
        for at, value, channel, of_phase in zip(w.tolist(), values.tolist(), i, phase, strict=True):
            if not math.isnan(at) and (not of_phase or value.real < 0):
                found[of_phase][0][channel].append(Crossing(at, value))
    return found[0][0], found[1][0]


def _false_position(
    see: See, seen: Seen, k: FloatArray, i: FloatArray, phase: FloatArray
) -> tuple[FloatArray, ComplexArray]:
    """Roots of log|l_i|, or of Im l_i where `phase`, in the intervals k of the grid (Illinois); and l there.

    NaN where the sign changes at a pole on the axis: there the measure grows instead of vanishing.
    """

    def measure(values: ComplexArray) -> FloatArray:
        with np.errstate(divide="ignore"):
            return np.where(phase, values.imag, np.log(np.abs(values)))

    rows = np.arange(len(k))
    a, b = np.log(seen.w[k]), np.log(seen.w[k + 1])
    f, g = measure(seen.loop[k, i]), measure(seen.loop[k + 1, i])
    largest = np.maximum(np.abs(f), np.abs(g))
    kept = np.zeros(len(k))  # the end that stayed: -1 a, 1 b
    for _ in range(STEPS):
        x = np.where(f == g, (a + b) / 2, b - g * (b - a) / np.where(f == g, 1, g - f))
        values = see(np.exp(x)).loop[rows, i]
        h = measure(values)
        left = h * f > 0
        g = np.where(left & (kept == 1), g / 2, np.where(left, g, h))
        f = np.where(~left & (kept == -1), f / 2, np.where(left, h, f))
        a, b, kept = np.where(left, x, a), np.where(left, b, x), np.where(left, 1.0, -1.0)
    return np.where(np.abs(h) > largest, np.nan, np.exp(x)), values


def find_tops(see: See, seen: Seen, measure: Callable[[Seen], FloatArray]) -> tuple[FloatArray, FloatArray]:
    """The largest measure of each channel and its frequency, between the frequencies of `seen` as well."""
    values = measure(seen)
    k = values.argmax(axis=0)
    rows = np.arange(values.shape[1])
    best, at = values[k, rows], seen.w[k]
    inner = np.clip(k, 1, max(len(seen.w) - 2, 1))
    if len(seen.w) < 3:
        return best, at
    x = np.log(np.stack([seen.w[inner + d] for d in (-1, 0, 1)]))
    y = np.stack([values[inner + d, rows] for d in (-1, 0, 1)])
    for _ in range(PEAKS):
        edge = 1e-3 * (x[2] - x[0])
        tip = np.clip(_vertex(x, y), x[0] + edge, x[2] - edge)
        found = measure(see(np.exp(tip)))[rows, rows]
        better = found > best
        best, at = np.where(better, found, best), np.where(better, np.exp(tip), at)
        x, y = _about_top(x, y, tip, found)
    return best, at


def _vertex(x: FloatArray, y: FloatArray) -> FloatArray:
    """The top of the parabolas through three points each (3 x n); the middle point where there is none."""
    left, right = (y[1] - y[0]) / (x[1] - x[0]), (y[2] - y[1]) / (x[2] - x[1])
    bend = (right - left) / (x[2] - x[0])
    safe = np.where(bend < 0, bend, -1)
    return np.asarray(np.where(bend < 0, (x[0] + x[1]) / 2 - left / (2 * safe), x[1]))


def _about_top(
    x: FloatArray, y: FloatArray, tip: FloatArray, found: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The highest of four points with its neighbours, columns of 3 x n; points that coincide are moved apart."""
    tip = np.where(np.abs(tip - x[1]) < 1e-9, x[1] + 1e-3 * (x[2] - x[1]), tip)
    order = np.argsort(np.vstack([x, tip]), axis=0)
    x, y = (
        np.take_along_axis(np.vstack([x, tip]), order, 0),
        np.take_along_axis(np.vstack([y, found]), order, 0),
    )
    middle = np.clip(y.argmax(axis=0), 1, 2)
    pick = np.stack([middle - 1, middle, middle + 1])
    return np.take_along_axis(x, pick, 0), np.take_along_axis(y, pick, 0)


def gain_range(crossings: list[Crossing]) -> tuple[tuple[float, float], tuple[float, float]]:
    """The factors about 1 that no crossing lies between, and the frequencies of both bounds."""
    factors = [(-1 / c.value.real, c.frequency) for c in crossings if c.value.real < 0]
    below = max((f for f in factors if 1 / FARTHEST < f[0] < 1), default=(0.0, math.nan))
    above = min((f for f in factors if 1 <= f[0] < FARTHEST), default=(math.inf, math.nan))
    return (below[0], above[0]), (below[1], above[1])


def phase_and_delay(crossings: list[Crossing]) -> tuple[float, float, float, float]:
    """The smallest turn (rad) and the shortest delay (s) that reach -1, each with its frequency."""
    turns, delays = [], []
    for w, value in crossings:
        lag = float(np.mod(np.angle(value) + np.pi, 2 * np.pi))
        turns.append((min(lag, 2 * np.pi - lag), w))
        delays.append((lag / w, w))
    none = (math.inf, math.nan)
    return *min(turns, default=none), *min(delays, default=none)


def margins_of_channel(
    name: str,
    crossings: tuple[list[Crossing], list[Crossing]],
    tops: tuple[tuple[float, float], tuple[float, float]],
    unstable: tuple[int, int],
) -> ChannelMargins:
    """The margins of a channel from its crossings, largest |S - 1/2| and |S|, and unstable poles, open and closed."""
    (half, half_at), (peak, peak_at) = tops
    stable = unstable[1] == 0
    nan = math.nan
    values: dict[str, Any] = dict.fromkeys(("phase", "phase_frequency", "delay", "delay_frequency"), nan)
    gain, at = (nan, nan), (nan, nan)
    if stable:
        gain, at = gain_range(crossings[1])
        values = dict(zip(values, phase_and_delay(crossings[0]), strict=True))
    return ChannelMargins(
        channel=name,
        stable=stable,
        gain=gain,
        gain_frequency=at,
        **values,
        disk=Disk(name, 1 / half if stable else nan, half_at if stable else nan),
        peak_sensitivity=peak if stable else nan,
        peak_frequency=peak_at if stable else nan,
        unstable_poles=unstable[0],
        encirclements=unstable[0] - unstable[1],
        gain_crossings=tuple(crossings[0]),
        phase_crossings=tuple(crossings[1]),
    )
