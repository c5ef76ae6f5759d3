"""Where the margin goes, from full state feedback to the machine's own loop; and the classical margins of that loop.

    LQR -> LQI -> LQG -> LQGI -> with current loops -> sampled: the gain file's own gains, with hold and delay

A PID has the last one alone; without weights on integrals the second and the fourth are left out.

The first five are continuous, synthesized from the cost and the noise that the file names. Each has its parametric
margin (robust.py) and its peak sensitivity: at the forces for state feedback, where the LQR promises at most 1, at the
sensors for output feedback, as ISO 14839-3 measures it.
Everything here is the design model at a position, without preload: what loads add is in verify's last stage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.margins.extent import NOWHERE, Extent, extent_of, standing
from malta.margins.plants import of_plant
from malta.margins.robust import Margin, robust_margin
from malta.margins.uncertain import (
    Compensator,
    UncertainSystem,
    instability,
    responses,
)
from malta.margins.verify import (
    EACH,
    NOT_PROVEN,
    PLACES,
    CurrentLoops,
    course_enters,
    covers_travel,
    largest,
    loop_at,
    machine_law,
    place_margin,
    places_along,
    travel_margin,
)
from malta.model.data import plant_of
from malta.model.linearize import linearize
from malta.model.parameters import units_of
from malta.model.plant import Plant, position_at
from malta.synthesis.controller import Controller
from malta.synthesis.lqg import (
    kalman,
    lqi,
    lqr,
    weights_of,
)
from malta.threads import on_one_thread

if TYPE_CHECKING:
    from malta.model.plant import ComplexArray, FloatArray

SAMPLED = "sampled"  # the last link: the machine's own loop


@dataclass(frozen=True, eq=False)
class Link:
    """One stage of the chain."""

    name: str
    margin: Margin
    peak: float  # largest |S_ii|; NaN where unstable
    broken_at: Literal["forces", "sensors"]  # where S is taken


@dataclass(frozen=True)
class Disk:
    """A loop stands any factor (1 + d/2) / (1 - d/2) with |d| < size in each channel that it names."""

    channels: str
    size: float
    frequency: float  # rad/s

    @property
    def gain(self) -> float:
        """The factor of gain that it stands, up or down; infinite from size 2 on."""
        return (1 + self.size / 2) / (1 - self.size / 2) if self.size < 2 else float("inf")

    @property
    def phase(self) -> float:
        """rad"""
        return float(2 * np.arctan(self.size / 2))


@dataclass(frozen=True)
class Place:
    """Figures at a position of the stroke, the worse of both sides: the machine is even in it, a law need not be.

    A machine without a stroke has its places along the first parameter of `plant.over`, as the speed of a rotor.
    """

    position: float  # SI: m, or the unit of that parameter
    margin: Margin
    peak: float
    disk: float  # all forces and sensors at once; NaN where unstable, as the peak and the delay
    delay: float  # s


@dataclass(frozen=True, eq=False)
class Robustness:
    """What `robustness` found of a controller on a machine."""

    chain: tuple[Link, ...]
    travel: Margin  # the last link, anywhere in `extent`, in one proof
    # The smallest or largest of `places`; none where one of them is unstable:
    disks: tuple[Disk, ...]
    delay: Mapping[str, float]  # s, that each sensor's loop stands alone, the others closed
    gang: Mapping[str, tuple[float, ...]]  # by sensor: |S|, |T|, m/N, N/m: largest in its row
    # Proven anywhere in the extent, in multiples of the range:
    tolerance: Mapping[str, tuple[Margin, Margin]]  # each parameter alone, down and up
    payload: Margin | None  # in kg; None for a machine without a mass m
    places: tuple[Place, ...]  # along the course; in a travel everything is even
    extent: Extent = NOWHERE  # what the proof covers beside the uncertainty


def compensators(
    plant: Plant, controller: Controller, current_loops: CurrentLoops = "lag"
) -> dict[str, tuple[Compensator, bool]]:
    """The stages by name, and whether they feed back the states; `plant` is the machine, which has the delays."""
    own = {SAMPLED: (machine_law(plant, controller, current_loops), False)}
    if controller.cost is None:
        return own
    believed, weights = plant_of(controller.parameters), weights_of(controller)
    model = linearize(believed, believed.point(controller.operating_point[0]))
    A, B, C, K, L = model.A, model.B, model.C, lqr(model, weights), kalman(model, weights)
    n, p, m = len(A), len(C), B.shape[1]
    half = believed.coordinates
    to_modes = np.linalg.inv(C[:, :half]) if p == half else np.eye(p)
    back = np.linalg.inv(to_modes)
    stages: dict[str, tuple[Compensator, bool]] = {
        "LQR": (
            Compensator(
                np.zeros((0, 0)), np.zeros((0, p + n)), np.zeros((m, 0)), np.hstack([np.zeros((m, p)), -K])
            ),
            True,
        )
    }
    integral = bool(weights.q_i.any())
    K_i, Ki = lqi(model, weights) if integral else (K, np.zeros((m, p)))
    if integral:  # e' = -y, in the coordinates of the modes
        e = np.hstack([-to_modes, np.zeros((p, n))])
        D = np.hstack([np.zeros((m, p)), -K_i])
        stages["LQI"] = Compensator(np.zeros((p, p)), e, Ki @ back, D, integrals=p), True
    stages["LQG"] = Compensator(A - B @ K - L @ C, L, -K, np.zeros((m, p))), False
    last = stages["LQG"][0]
    if integral:
        observer = np.block([[A - B @ K_i - L @ C, B @ Ki @ back], [np.zeros((p, n + p))]])
        last = Compensator(
            observer, np.vstack([L, -to_modes]), np.hstack([-K_i, Ki @ back]), np.zeros((m, p)), integrals=p
        )
        stages["LQGI"] = last, False
    if np.isfinite(plant.actuator.crossover):
        stages["+ current loops"] = replace(last, lag=plant.actuator.crossover), False
    return stages | own


@on_one_thread
def robustness(
    plant: Plant,
    controller: Controller,
    uncertainty: Mapping[str, float],
    *,
    current_loops: CurrentLoops = "lag",
    progress: Callable[[float], None] | None = None,
    bounds: Callable[[float, float], None] | None = None,
    time: float | None = None,
    proof: bool = True,
) -> Robustness:
    """Parametric and classical margins of a controller on a machine.

    uncertainty : relative half range of each parameter, e.g. {"m": 0.2}; the margins count in it
    current_loops : lag, as verify takes them, or pi, the sampled controllers of the gain file on the windings
    bounds : called with the bounds of the margin over the travel so far
    time : s, of each proof over the travel; proof: whether there is any

    Raises InputError for unknown parameters or none.
    """
    if not uncertainty:
        raise InputError("robustness", "uncertainty", "no parameters", 'some, as {"m": 0.2}')
    steps = iter(range(1, 100))
    total = 8 + 2 * len(uncertainty) + len(PLACES)

    def done() -> None:
        if progress is not None:
            progress(min(1.0, next(steps) / total))

    names = list(uncertainty)
    every = [*names, *({"m"} & set(units_of(plant.parameters)) - set(names))]
    at = position_at(plant, plant.point(controller.operating_point[0]).x)
    extent = extent_of(plant, every)
    position = standing(plant, extent, at)
    believed = plant_of(controller.parameters)
    along = places_along(plant, controller, tuple(every), current_loops)
    whole = covers_travel(plant, controller, tuple(every), current_loops)
    moves = course_enters(plant, controller, tuple(every), current_loops)
    proven = cache(lambda z: place_margin(plant, controller, uncertainty, z, current_loops, every))

    def here(z: float) -> Margin:  # the operating point is one of the places
        return proven(z if moves else 0.0)

    links = []
    stages = compensators(plant, controller, current_loops)
    for name, (law, states) in stages.items():
        if name == SAMPLED:
            system, law = loop_at(plant, controller, tuple(every), position, current_loops)
            margin = here(position) if proof else NOT_PROVEN
        else:
            system = of_plant(plant, names, states=states, at=at, believed=believed)
            margin = robust_margin(system, law, uncertainty, time=time) if proof else NOT_PROVEN
        links.append(Link(name, margin, _peak(system, law, states), "forces" if states else "sensors"))
        done()

    known: dict[tuple[object, float | None], Margin] = {}

    def anywhere(
        ranges: Mapping[str, float | tuple[float, float]],
        longest: float | None,
        report: Callable[[float, float], None] | None = None,
    ) -> Margin:
        key = tuple(ranges.items()), longest  # a payload of 1 kg may be the range of the mass
        if key not in known:
            known[key] = travel_margin(
                plant, controller, ranges, current_loops, every, time=longest, progress=report
            )
        done()
        return known[key]

    travel = anywhere(uncertainty, time, bounds) if proof else NOT_PROVEN
    brief = time if whole else min(time or EACH, EACH)
    tolerance = {}
    for name, share in uncertainty.items() if proof else ():
        nominal = getattr(plant.parameters, name)
        down = anywhere({name: (nominal * (1 - share), nominal)}, brief)
        tolerance[name] = down, anywhere({name: (nominal, nominal * (1 + share))}, brief)
    payload = None
    if proof and "m" in units_of(plant.parameters):
        m: float = getattr(plant.parameters, "m")  # noqa: B009  a machine's own field
        payload = anywhere({"m": (m, m + 1.0)}, brief)
    sensors = [s.name for s in plant.outputs]
    places: list[Place] = []
    classical: list[_Classical | None] = []
    for positions in along:
        loops = [loop_at(plant, controller, tuple(every), z, current_loops) for z in positions]
        asked = positions if whole else positions[:1]  # a place takes as long as a travel there
        margin = _smallest([here(z) for z in asked]) if proof else NOT_PROVEN
        peaks, sides = [], []
        for system, law in loops:
            peaks.append(_peak(system, law, states=False))
            sides.append(_classical(system, law, sensors) if _stable(system, law) else None)
        classical += sides
        disk, delay = np.nan, np.nan
        if all(sides):
            both = _worst([found for found in sides if found is not None])
            disk, delay = both.disks[2].size, min(both.delay.values())
        places.append(Place(positions[0], margin, float(np.max(peaks)), disk, delay))
        done()
    worst = _worst([found for found in classical if found is not None]) if all(classical) else None
    return Robustness(
        tuple(links),
        travel,
        worst.disks if worst else (),
        worst.delay if worst else dict.fromkeys(sensors, float("nan")),
        worst.gang if worst else {},
        tolerance,
        payload,
        tuple(places),
        extent,
    )


def _smallest(found: list[Margin]) -> Margin:
    """The smallest lower and the smallest upper bound of margins that all shall hold."""
    lower = None if any(m.lower is None for m in found) else min(m.lower or 0.0 for m in found)
    reason = "; ".join(dict.fromkeys(m.reason for m in found if m.reason))
    return replace(min(found, key=lambda m: m.upper), lower=lower, reason=reason)


class _Classical(NamedTuple):
    """Margins without parameters at one position, or the worst of several."""

    disks: tuple[Disk, ...]
    delay: dict[str, float]
    gang: dict[str, tuple[float, ...]]


def _classical(system: UncertainSystem, law: Compensator, sensors: list[str]) -> _Classical:
    w = _frequencies(law)
    P, F = _at_nominal(system, law, w)
    disks = [disk_margin(system, law, kind) for kind in ("forces", "sensors", "forces and sensors")]
    for k, name in enumerate(sensors):
        disks.append(replace(disk_margin(system, law, "sensors", only=k), channels=f"{name} alone"))
    delays = delay_margins(P @ F, w).tolist()
    return _Classical(
        tuple(disks), dict(zip(sensors, delays, strict=True)), dict(zip(sensors, _gang(P, F), strict=True))
    )


def _worst(found: list[_Classical]) -> _Classical:
    disks = tuple(min(same, key=lambda d: d.size) for same in zip(*(one.disks for one in found), strict=True))
    first = found[0]
    return _Classical(
        disks,
        {name: min(one.delay[name] for one in found) for name in first.delay},
        {
            name: tuple(max(values) for values in zip(*(one.gang[name] for one in found), strict=True))
            for name in first.gang
        },
    )


def disk_margin(
    system: UncertainSystem,
    law: Compensator,
    kind: Literal["forces", "sensors", "forces and sensors"],
    only: int | None = None,
) -> Disk:
    """The symmetric disk margin of the nominal loop: all channels at once, each with its own factor, or one alone.

    Factors (1 + d/2) / (1 - d/2) in the signals of Q, around which the loop is closed, leave it stable while
    |d| < 1 / mu(M), M = (1 - Q)^-1 - 1/2 (Seiler, Packard, Gahinet 2020). mu is bounded above by a balanced D M D^-1,
    so several channels stand at least this much; one channel is exact.
    """
    w = _frequencies(law)

    def sizes(w: FloatArray) -> FloatArray:
        P, F = _at_nominal(system, law, w)
        if kind == "forces":
            Q = F @ P
        elif kind == "sensors":
            Q = P @ F
        else:
            zero = np.zeros((len(w), P.shape[1], P.shape[1])), np.zeros((len(w), F.shape[1], F.shape[1]))
            Q = np.block([[zero[0], P], [F, zero[1]]])
        eye = np.eye(Q.shape[-1])
        M = np.linalg.inv(eye - Q) - eye / 2
        mu = _balanced(M) if only is None else np.abs(M[:, only, only])
        return np.asarray(mu[:, None])

    (mu,), (at,) = largest(sizes, w)
    channels = kind if only is None else f"{kind[:-1]} {only + 1}"
    return Disk(channels, float(1 / mu), float(at))


def _balanced(M: ComplexArray) -> FloatArray:
    """sigma_max of D M D^-1 with the diagonal D that equals rows and columns (Osborne): an upper bound of mu."""
    size = np.abs(M)
    d = np.ones(size.shape[:2])
    off = size * (1 - np.eye(size.shape[-1]))
    for _ in range(60):
        scaled = off * d[:, :, None] / d[:, None, :]
        rows, columns = np.sqrt((scaled**2).sum(2)), np.sqrt((scaled**2).sum(1))
        both = (rows > 0) & (columns > 0)
        d = d * np.where(both, columns / np.where(both, rows, 1), 1) ** 0.25
    return np.asarray(np.linalg.svd(M * d[:, :, None] / d[:, None, :], compute_uv=False)[:, 0])


def delay_margins(L: ComplexArray, w: FloatArray) -> FloatArray:
    """The delay that each channel stands alone, s: min of phi(w) / w over the gain crossovers, the others closed.

    L : k x p x p, y = L y around the loop. Infinite where a channel has no crossover.
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


def _frequencies(law: Compensator) -> FloatArray:
    top = 1e5 if law.sample_time is None else np.pi / law.sample_time
    return np.geomspace(1e-2, top, 400)


def _at_nominal(
    system: UncertainSystem, law: Compensator, w: FloatArray
) -> tuple[ComplexArray, ComplexArray]:
    return responses(system, law, system.nominal, w)


def _stable(system: UncertainSystem, law: Compensator) -> bool:
    return bool(instability(system, law, system.nominal)[0] < 0)


def _peak(system: UncertainSystem, law: Compensator, states: bool) -> float:
    """Largest |S_ii|, at the forces of state feedback, else at the sensors."""
    if not _stable(system, law):
        return float("nan")

    def sizes(w: FloatArray) -> FloatArray:
        P, F = _at_nominal(system, law, w)
        Q = F @ P if states else P @ F
        S = np.linalg.inv(np.eye(Q.shape[-1]) - Q)
        return np.asarray(np.abs(np.einsum("kii->ki", S)))

    return float(largest(sizes, _frequencies(law))[0].max())


def _gang(P: ComplexArray, F: ComplexArray) -> list[tuple[float, ...]]:
    """For each sensor: |S_ii|, |T_ii|, the largest |(S P)_ij| (m/N) and |(F S)_ji| (N/m)."""
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
