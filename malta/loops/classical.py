"""Classical margins of one loop at nominal parameters: disks, delays and the gang of four."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.display import display
from malta.linear.interconnection import append, connect, series
from malta.linear.matrices import eigenvalues
from malta.linear.peaks import (
    Crossing,
    Peak,
    about_poles,
    gain_crossings,
    in_plane,
    joined_channels,
    largest_gain,
    level_frequencies,
    of_plane,
    part_of,
    peak_gain,
    response_at,
)
from malta.linear.system import System

ROUNDS = 60  # of the balance of a matrix at most
BALANCE_TOLERANCE = 1e-9  # relative difference of norms of rows and columns
# Of a row or column, relative: a matrix with entries on one side of its diagonal alone is scaled down to that.
LEAST_NORM = 1e-9
LEVELS = 12  # of a disk of several channels at most
INNER_POINTS = np.linspace(0.0, 1.0, 9)  # of an interval between two levels
RISE = 1e-7  # relative, above the smallest disk that was found, at which its search ends


def cut_loop(P: System, F: System) -> System:
    """The closed loop y = P u + n, u = F y + d, from (n, d) to (y, u): the sensitivities and the gang of four.

        [ S    S P      ]      S = (1 - P F)^-1
        [ F S  S_forces ]      S_forces = (1 - F P)^-1

    Raises InputError where 1 - P F is singular at infinite frequency.
    """
    p, m = P.D.shape
    crossed = np.zeros((m + p, p + m))
    crossed[:m, p:], crossed[m:, :p] = np.eye(m), np.eye(p)
    closed = connect(append(P, F), crossed, crossed, np.eye(p + m), "loop")
    return replace(closed, D=closed.D + np.eye(p + m))


@dataclass(frozen=True, eq=False)
class Nominal:
    """A nominal loop y = P u, u = F y, positive feedback, by matrices; of sampled loops in differences.

    P : from the inputs u to the sensors
    F : the law
    stable : whether the loop is stable
    sample_time : s; None: continuous
    forces : how many of the inputs u, the first ones, are forces of the law; None: all. The others, as currents that
        are held for a sample, hang on readings: at the forces they are part of the machine
    """

    P: System
    F: System
    stable: bool
    sample_time: float | None
    forces: int | None = None

    @property
    def sensors(self) -> range:
        """The channels of `closed` at the sensors."""
        return range(len(self.P.C))

    @property
    def inputs(self) -> range:
        """The channels of `closed` at the forces."""
        p, m = len(self.P.C), self.P.B.shape[1] if self.forces is None else self.forces
        return range(p, p + m)

    @cached_property
    def closed(self) -> System:
        """The closed loop of `cut_loop`, in balanced units; of a sampled one in the s of Tustin's rule."""
        return in_plane(cut_loop(self.P, self.F), self.sample_time).balanced

    def frequency(self, v: float) -> float:
        """rad/s, of a frequency of the plane."""
        return float(of_plane(np.array(v), self.sample_time))

    @cached_property
    def open(self) -> System:
        """The loop gain P F at the sensors, positive feedback; of a sampled loop in the s of Tustin's rule."""
        return in_plane(series(self.F, self.P), self.sample_time).balanced

    def response(self, w: FloatArray) -> tuple[ComplexArray, ComplexArray]:
        """P, k x p x m, and F, k x m x p, at frequencies w, rad/s."""
        T, s = self.sample_time, np.asarray(1j * np.asarray(w, dtype=float))
        if T is not None:
            s = np.asarray(np.expm1(s * T) / T)
        return self.P.response(s), self.F.response(s)

    def sensitivity(self, channel: int) -> System:
        """S of one channel of `closed`, the others closed."""
        return part_of(self.closed, [channel], [channel])


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
    # by sensor: largest |S|, |T|, |S P| (m/N), |F S| (N/m), see gang_of_four
    gang: dict[str, tuple[float, ...]]


def classical_margins(loop: Nominal, sensors: Sequence[str], units: Sequence[str] = ()) -> Classical:
    """The disk margins, delay margins and the gang of four of a stable loop.

    sensors : names of the rows of y
    units : of the forces u; (): they are alike
    """
    kinds: tuple[Kind, ...] = ("forces", "sensors", "forces and sensors")
    disks = [disk_margin(loop, kind) for kind in kinds] + disk_margins_alone(loop, sensors)
    return Classical(
        tuple(disks),
        dict(zip(sensors, delay_margins(loop), strict=True)),
        dict(zip(sensors, gang_of_four(loop, units), strict=True)),
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


Kind = Literal["forces", "sensors", "forces and sensors"]


def disk_margin(loop: Nominal, kind: Kind) -> Disk:
    """The symmetric disk margin of the nominal loop, of all channels at once, each with its own factor.

    With the loop's positive feedback Q, factors (1 + d/2) / (1 - d/2) keep it stable while |d| < 1 / mu(M),
    M = (1 - Q)^-1 - 1/2 (Seiler, Packard, Gahinet 2020). For several channels mu is bounded above by a balanced
    D M D^-1, at each frequency the lower of its own balance and that of the peak, so the margin is a lower bound; for
    one channel it is exact.
    """
    chosen = {"forces": [*loop.inputs], "sensors": [*loop.sensors]}
    channels = chosen.get(kind, [*loop.sensors, *loop.inputs])
    found = [
        _largest_mu(disk_system(part_of(loop.closed, own, own)))
        for own in joined_channels(loop.closed, channels)
    ]
    mu, at = max(found)
    return Disk(kind, 1 / mu, loop.frequency(at))


def disk_system(S: System) -> System:
    """S - 1/2."""
    return replace(S, D=S.D - np.eye(len(S.D)) / 2)


def _largest_mu(M: System) -> Peak:
    """The largest balanced norm over frequency, and where: of one channel exact, else by levels at fixed scales.

    The norm with the scales of one frequency bounds mu at all of them: where it is below the largest that was found,
    nothing is missed.
    """
    if len(M.D) == 1:
        return peak_gain(M)
    M = M.balanced

    def sizes(w: FloatArray) -> FloatArray:
        return balanced_norm(response_at(M, w))

    w = np.concatenate([[0.0, np.inf], about_poles(eigenvalues(M.A))])
    found = sizes(w)
    best, where = float(found.max()), float(w[found.argmax()])
    for _ in range(LEVELS):
        d = balance_scales(response_at(M, np.array([where])))[0]
        scaled = System(M.A, M.B / d, M.C * d[:, None], M.D * d[:, None] / d)
        ends = level_frequencies(scaled, best * (1 + RISE))
        if not len(ends):
            break
        ends = np.concatenate([ends[:1] / 2, ends, 2 * ends[-1:]])
        w = (ends[:-1, None] + np.diff(ends)[:, None] * INNER_POINTS).ravel()
        found = sizes(w)
        if not found.max() > best * (1 + RISE):
            break
        best, where = float(found.max()), float(w[found.argmax()])
    return Peak(best, where)


def loop_at_forces(P: ComplexArray, F: ComplexArray, forces: int | None) -> ComplexArray:
    """The loop from forces to forces, positive feedback: what else hangs on readings belongs to the machine."""
    m = P.shape[-1] if forces is None else forces
    P_m, F_m = P[..., :m], F[:, :m]
    if m < F.shape[1]:
        P_m = np.linalg.solve(np.eye(P.shape[1]) - P[..., m:] @ F[:, m:], P_m)
    return np.asarray(F_m @ P_m)


def disk_margins_alone(loop: Nominal, sensors: Sequence[str]) -> list[Disk]:
    """The symmetric disk margin of each sensor alone, in the order of the rows of y."""
    peaks = [peak_gain(disk_system(loop.sensitivity(i))) for i in loop.sensors]
    return [
        Disk(f"{name} alone", 1 / mu, loop.frequency(at))
        for name, (mu, at) in zip(sensors, peaks, strict=True)
    ]


def disk_sizes(S: ComplexArray) -> FloatArray:
    """The disk margin of all channels at once at each frequency, from sensitivities S, k x p x p: a lower bound."""
    return np.asarray(1 / balanced_norm(S - np.eye(S.shape[-1]) / 2))


def balance_scales(M: ComplexArray) -> FloatArray:
    """The d, k x n, with which norms of rows and columns of d_i M_ij / d_j agree (Osborne)."""
    size = np.abs(M)
    d = np.ones((*size.shape[:2], 1))
    off = (size * (1 - np.eye(size.shape[-1]))) ** 2
    turned = np.ascontiguousarray(off.swapaxes(1, 2))
    least = LEAST_NORM * np.einsum("kii->ki", size).max(axis=1)[:, None, None] + np.finfo(float).tiny
    for _ in range(ROUNDS):
        squares = d**2
        rows, columns = np.sqrt(squares * (off @ (1 / squares))), np.sqrt(turned @ squares / squares)
        ratio = np.maximum(columns, least) / np.maximum(rows, least)
        d = d * ratio**0.25
        if np.abs(ratio - 1).max(initial=0.0) < BALANCE_TOLERANCE:
            break
    return np.asarray(d[..., 0])


def balanced_norm(M: ComplexArray) -> FloatArray:
    """sigma_max of D M D^-1 with the scales of `balance_scales`: an upper bound of mu, k of k matrices."""
    d = balance_scales(M)
    return np.asarray(np.linalg.svd(M * d[:, :, None] / d[:, None], compute_uv=False)[:, 0])


def delay_margins(loop: Nominal) -> list[float]:
    """The delay margin of each sensor with the others closed, s: the smallest phi(w) / w at its gain crossovers.

    Infinite for a channel without a crossover.
    """
    return [phase_and_delay(crossings_at(loop, i))[2] for i in loop.sensors]


def crossings_at(loop: Nominal, channel: int) -> tuple[Crossing, ...]:
    """The gain crossings of one channel of `loop.closed`, the others closed, rad/s."""
    found = gain_crossings(loop.sensitivity(channel).balanced)
    return tuple(Crossing(loop.frequency(w), value) for w, value in found)


def gang_of_four(loop: Nominal, units: Sequence[str] = ()) -> list[tuple[float, ...]]:
    """For each sensor i the largest |S_ii|, |T_ii|, |(S P)_ij| (m/N) and |(F S)_ji| (N/m) over frequency.

    units : of the forces; of unlike ones j are those in the unit of the axis: force i, or the last; (): they are alike
    """

    def peak(row: int, columns: Iterable[int], *, turned: bool = False) -> float:
        pairs = (((column, row) if turned else (row, column)) for column in columns)
        return largest_gain(part_of(loop.closed, [k], [j]) for k, j in pairs).value

    found: list[tuple[float, ...]] = []
    for i in loop.sensors:
        S = loop.sensitivity(i)
        T = replace(S, D=S.D - 1)
        both = peak_gain(S).value, peak_gain(T).value
        own = units[min(i, len(units) - 1)] if units else ""
        alike = [
            j for j, unit in zip(loop.inputs, units or [own] * len(loop.inputs), strict=False) if unit == own
        ]
        found.append((*both, peak(i, alike), peak(i, alike, turned=True)))
    return found


def phase_and_delay(crossings: Sequence[Crossing]) -> tuple[float, float, float, float]:
    """The smallest turn (rad) and the shortest delay (s) that reach -1, each with its frequency."""
    turns, delays = [], []
    for w, value in crossings:
        lag = float(np.mod(np.angle(value) + np.pi, 2 * np.pi))
        turns.append((min(lag, 2 * np.pi - lag), w))
        delays.append((lag / w, w))
    none = (math.inf, math.nan)
    return *min(turns, default=none), *min(delays, default=none)
