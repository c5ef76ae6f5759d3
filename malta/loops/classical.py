"""Classical margins of one loop at nominal parameters: disks, delays and the gang of four."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from malta.proof.responses import find_peaks, responses
from malta.proof.uncertain import Compensator, UncertainSystem, instability

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

ROUNDS = 60  # of the balance of a matrix at most
BALANCED = 1e-9  # relative difference of norms of rows and columns


Response = Callable[["FloatArray"], tuple["ComplexArray", "ComplexArray"]]


class Nominal(NamedTuple):
    """A nominal loop y = P u, u = F y by its responses, positive feedback.

    response : frequencies w (rad/s) -> P, k x p x m, and F, k x m x p
    stable : whether the loop is stable
    sample_time : s; None: continuous
    """

    response: Response
    stable: bool
    sample_time: float | None

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
        dict(zip(sensors, gang_of_four(P, F), strict=True)),
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
            Q = F @ P
        elif kind == "sensors":
            Q = P @ F
        else:
            zero = np.zeros((len(w), P.shape[1], P.shape[1])), np.zeros((len(w), F.shape[1], F.shape[1]))
            Q = np.block([[zero[0], P], [F, zero[1]]])
        return np.asarray(_balanced_norm(_disk_matrix(Q))[:, None])

    (mu,), (at,) = find_peaks(sizes, loop.frequencies)
    return Disk(kind, float(1 / mu), float(at))


def disk_margins_alone(loop: Nominal, sensors: Sequence[str]) -> list[Disk]:
    """The symmetric disk margin of each sensor alone, in the order of the rows of y."""

    def sizes(w: FloatArray) -> FloatArray:
        P, F = loop.response(w)
        return np.asarray(np.abs(np.einsum("kii->ki", _disk_matrix(P @ F))[:, : len(sensors)]))

    peaks = zip(*find_peaks(sizes, loop.frequencies), strict=True)
    return [
        Disk(f"{name} alone", float(1 / mu), float(at)) for name, (mu, at) in zip(sensors, peaks, strict=True)
    ]


def _disk_matrix(Q: ComplexArray) -> ComplexArray:
    eye = np.eye(Q.shape[-1])
    return np.asarray(np.linalg.inv(eye - Q) - eye / 2)


def _balanced_norm(M: ComplexArray) -> FloatArray:
    """sigma_max of D M D^-1, D diagonal so that norms of rows and columns agree (Osborne): an upper bound of mu."""
    size = np.abs(M)
    d = np.ones(size.shape[:2])
    off = size * (1 - np.eye(size.shape[-1]))
    for _ in range(ROUNDS):
        scaled = off * d[:, :, None] / d[:, None, :]
        rows, columns = np.sqrt((scaled**2).sum(2)), np.sqrt((scaled**2).sum(1))
        both = (rows > 0) & (columns > 0)
        ratio = np.where(both, columns / np.where(both, rows, 1), 1)
        d = d * ratio**0.25
        if np.abs(ratio - 1).max(initial=0.0) < BALANCED:
            break
    return np.asarray(np.linalg.svd(M * d[:, :, None] / d[:, None, :], compute_uv=False)[:, 0])


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
        Q = F @ P if at == "forces" else P @ F
        S = np.linalg.inv(np.eye(Q.shape[-1]) - Q)
        return np.asarray(np.abs(np.einsum("kii->ki", S)))

    return float(find_peaks(sizes, loop.frequencies)[0].max())


def gang_of_four(P: ComplexArray, F: ComplexArray) -> list[tuple[float, ...]]:
    """For each sensor i the largest |S_ii|, |T_ii|, |(S P)_ij| (m/N) and |(F S)_ji| (N/m) over frequency."""
    S = np.linalg.inv(np.eye(P.shape[1]) - P @ F)
    T = np.eye(P.shape[1]) - S
    compliance, noise = np.abs(S @ P), np.abs(F @ S)
    return [
        (
            float(np.abs(S[:, i, i]).max()),
            float(np.abs(T[:, i, i]).max()),
            float(compliance[:, i].max()),
            float(noise[:, :, i].max()),
        )
        for i in range(P.shape[1])
    ]
