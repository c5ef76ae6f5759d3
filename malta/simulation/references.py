"""References: outputs that a machine shall follow, with their derivatives.

A reference is a function of time (s, shape (k,)) that returns p*, its first and its second derivative, each k x p in
the order of the plant's outputs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.model.machines import attribute_of
from malta.model.plant import Plant

if TYPE_CHECKING:
    from malta.model.plant import FloatArray

Profile = Literal["logistic", "quintic"]
RISE = 20e-3  # s, of machines without a RISE of their own


class Motion(NamedTuple):
    """p*, p*' and p*'' at k times, each k x p: m, m/s, m/s2."""

    p: FloatArray
    dp: FloatArray
    ddp: FloatArray


Reference = Callable[["FloatArray"], Motion]


def logistic(
    t: Any, rise: Any, tanh: Callable[[Any], Any] = np.tanh
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """s = 1 / (1 + e^(-k t)), centred at t = 0, from 10 to 90 % in `rise` (s): k = 2 ln 9 / rise.

    tanh : of numpy, or CasADi's for expressions
    """
    k = 2 * math.log(9) / rise
    s = 0.5 * (1 + tanh(k * t / 2))  # 1 / (1 + e^(-k t)) without overflow
    ds = k * s * (1 - s)
    return s, ds, k * ds * (1 - 2 * s)


def quintic(
    t: Any, rise: Any, clip: Callable[[Any, Any, Any], Any] = np.clip
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """s = 10 u^3 - 15 u^4 + 6 u^5, u from 0 to 1, centred at t = 0, from 10 to 90 % in `rise` (s).

    At rest outside; the whole move takes QUINTIC_DURATION times `rise`. clip : of numpy, or one for expressions
    """
    T = QUINTIC_DURATION * rise
    u = clip(t / T + 0.5, 0, 1)
    return (
        u**3 * (10 + u * (6 * u - 15)),
        30 * (u * (1 - u)) ** 2 / T,
        60 * u * (1 - u) * (1 - 2 * u) / T**2,
    )


QUINTIC_DURATION = 1 / (1 - 2 * 0.24663645328846656)  # 10 u^3 - 15 u^4 + 6 u^5 = 0.1 at u = 0.2466

PROFILES: dict[str, Callable[[Any, Any], tuple[FloatArray, FloatArray, FloatArray]]] = {
    "logistic": logistic,
    "quintic": quintic,
}


def stroke(
    plant: Plant, start: float, end: float, rise: float | None, centre: float, profile: Profile = "logistic"
) -> Reference:
    """A move of the stroke axis from `start` to `end` (m), half-way at `centre` (s); the other outputs stay at zero.

    rise : s, 10-90 %; None: the machine's own, RISE of its experiments, or 20 ms

    Raises InputError for an unknown profile, a rise out of range, and positions beyond the travel.
    """
    if profile not in PROFILES:
        raise InputError("stroke", "profile", repr(profile), "one of " + ", ".join(PROFILES))
    if rise is None:
        rise = float(attribute_of(plant, "experiments", "RISE", RISE))
    check_rise(rise)
    axis = plant.stroke_output
    for name, value in (("start", start), ("end", end)):
        if not abs(value) <= plant.travel:
            raise InputError(
                "stroke", name, f"{value} m", f"a position within the travel of +-{plant.travel} m"
            )

    def at(t: FloatArray) -> Motion:
        scales = PROFILES[profile](np.asarray(t) - centre, rise)
        motion = [np.zeros((len(s), len(plant.outputs))) for s in scales]
        for column, s, offset in zip(motion, scales, (start, 0.0, 0.0), strict=True):
            column[:, axis] = offset + (end - start) * s
        return Motion(*motion)

    return at


def check_rise(rise: float) -> None:
    """InputError for a rise outside 1e-6 to 1e6 s."""
    if not 1e-6 <= rise <= 1e6:
        raise InputError("stroke", "rise", f"{rise} s", "a time from 1e-6 to 1e6 s")


def hold(plant: Plant, **outputs: float) -> Reference:
    """Constant outputs (SI); those without a value stay at zero. Raises InputError for unknown names.

    malta.Scenario("hold", 0.1, partial(malta.references.hold, x1=1e-6))
    """
    names = [s.name for s in plant.outputs]
    for name in outputs:
        if name not in names:
            raise InputError("hold", name, "an unknown output", "one of " + " ".join(names))
    p = np.array([outputs.get(name, 0.0) for name in names])

    def at(t: FloatArray) -> Motion:
        zeros = np.zeros((len(t), len(p)))
        return Motion(zeros + p, zeros, zeros)

    return at


def circle(plant: Plant, radius: float, frequency: float) -> Reference:
    """A circle of the first two outputs, of `radius` (m) at `frequency` (Hz); the others stay at zero."""
    w = 2 * math.pi * frequency

    def at(t: FloatArray) -> Motion:
        c, s = np.cos(w * np.asarray(t)), np.sin(w * np.asarray(t))
        motion = [np.zeros((len(c), len(plant.outputs))) for _ in range(3)]
        for columns, (along_x, along_y) in zip(
            motion, ((c, s), (-w * s, w * c), (-(w**2) * c, -(w**2) * s)), strict=True
        ):
            columns[:, 0], columns[:, 1] = radius * along_x, radius * along_y
        return Motion(*motion)

    return at
