"""Robustness problems whose margins are published: what the tests assert and the benchmark times, each written once.

Margins are in multiples of the box; where a source errs, tests/proof/test_robust_published.py says why. Written in
plain Python and numpy, as a user has them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import control
import numpy as np

Coefficients = Callable[..., list[Any]]
Box = Mapping[str, tuple[float, float]]


class Polynomial(NamedTuple):
    """A characteristic polynomial."""

    name: str
    margin: float
    coefficients: Coefficients  # of the parameters by name; highest power first
    box: Box
    nominal: Mapping[str, float] | None = None  # None: the middle of the box


class Loop(NamedTuple):
    """A plant with parameters, and a control law u = F y."""

    name: str
    margin: float
    matrices: Callable[..., Any]  # of the parameters by name: A, B, C
    nominal: Mapping[str, float]
    law: Any  # control.StateSpace, control.TransferFunction or a matrix
    box: Mapping[str, float | tuple[float, float]]  # a share of the nominal value, or an interval
    limits: Mapping[str, tuple[float, float]] | None = None  # what the parameters can be at all
    divides: tuple[str, ...] = ()  # parameters that the matrices divide by
    dynamics: float = 0.0  # size of unmodelled dynamics, multiplicative, at the sensor


# Polynomials


DE_GASTON_SAFONOV = Polynomial(
    "de Gaston and Safonov",
    3.4173955,
    lambda q1, q2, q3: [1, q2 + q3 + 10, q2 * q3 + 10 * (q2 + q3), 10 * q2 * q3 + q1, 2 * q1],
    {"q1": (720, 880), "q2": (3.8, 4.2), "q3": (5.7, 6.3)},
)
HANDBOOK_7_3_2 = Polynomial(
    "Handbook 7.3.2",
    1.0898639714,
    lambda q1, q2, q3: [1, q1**4 * q2**4 - q1**4 - q2**4 * q3],
    {"q1": (1.15, 1.65), "q2": (1.3, 1.7), "q3": (0.6, 1.0)},
)
HANDBOOK_7_3_3 = Polynomial(
    "Handbook 7.3.3",
    0.8175290489,
    lambda q1, q2, q3: [
        16,
        16 * q1 - 24,
        78 - 9.625 * q1 - 16 * q2,
        19 * q1 + 8 * q2 + q3 - 44,
        12 - 4 * q1 - q2 + q3,
    ],
    {"q1": (2.0, 2.5), "q2": (1.0, 2.0), "q3": (0.0, 3.0)},
)


def _vicino_tesi_milanese(q1: Any, q2: Any, q3: Any, q4: Any, q5: Any) -> list[Any]:
    return [
        q3**2 * q2 * (4 * q2 + 7 * q1),
        7 * q4 * q3**2 * q2 - 64.918 * q3**2 * q2 + 380.067 * q3 * q2 + 3 * q5 * (q2 + q1),
        3 * (-9.81 * q3 * q2 * (q2 + q1) - 4.312 * q3**2 * q2 + 264.896 * q3 * q2 + q4 * q5 - 9.274 * q5),
        0.2 * (-147.15 * q4 * q3 * q2 + 1364.67 * q3 * q2 - 27.72 * q5),
        54.387 * q3 * q2,
    ]


VICINO_TESI_MILANESE = Polynomial(
    "Vicino et al.",
    6.274633,
    _vicino_tesi_milanese,
    {"q1": (9, 11), "q2": (0.9, 1.1), "q3": (0.9, 1.1), "q4": (0.19, 0.21), "q5": (0.045, 0.055)},
)


def bus(v: Any, m: Any) -> list[Any]:
    """A bus guided by a wire: velocity in m/s, mass in t."""
    v2m2, v2m, vm = v * v * m * m, v * v * m, v * m
    return [
        v2m2,
        50 * v2m2 + 1080 * vm,
        1250 * v2m2 + 16.8 * v2m + 53.9e3 * vm + 270e3,
        15.6e3 * v2m2 + 840 * v2m + 1.35e6 * vm + 13.5e6,
        1.45e6 * v2m + 16.8e6 * vm + 338e6,
        6.93e6 * v2m + 911e6 * v + 4220e6,
        5.72e6 * v2m + 113e6 * v * v + 4250e6 * v,
        528e6 * v * v + 3640e6 * v,
        453e6 * v * v,
    ]


BUS = Polynomial("bus, Handbook 7.3.5", 0.9887712283, bus, {"v": (3, 32), "m": (5, 35)})


def island(r: float) -> Coefficients:
    """Ackermann, Kaesbauer and Muench 1991: unstable inside the circle of radius r about (1, 1), stable around it."""
    return lambda q1, q2: [1, q1 + q2 + 1, q1 + q2 + 3, 1 + r * r + 6 * (q1 + q2) + 2 * q1 * q2]


def island_by_a_side(r: float) -> Polynomial:
    """The side q1 = 1.4 - 1.1 t of the box meets the circle."""
    box = {"q1": (0.3, 2.5), "q2": (0.0, 1.7)}
    return Polynomial(f"island of radius {r:g}", (0.4 - r) / 1.1, island(r), box)


# Loops


def _carts(m1: Any, m2: Any, k: Any) -> Any:
    """Two masses and a spring, a force on the first, the position of the second."""
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [-k / m1, k / m1, 0, 0], [k / m2, -k / m2, 0, 0]]
    return A, [[0], [0], [1 / m1], [0]], [[0, 1, 0, 0]]


_LEAD = control.ss(control.tf([1, 1], [0.001, 1]))
_ONES = {"m1": 1.0, "m2": 1.0, "k": 1.0}
_POSITIVE = dict.fromkeys(_ONES, (0.0, math.inf))
CARTS = Loop(
    "two carts",
    2.886359369,
    _carts,
    _ONES,
    -100 * _LEAD * _LEAD * _LEAD,
    dict.fromkeys(_ONES, 0.2),
    limits=_POSITIVE,
    divides=("m1", "m2"),
)
ACC_BENCHMARK = Loop(
    "ACC benchmark",
    (1 - 0.43535122268) / 0.5,
    _carts,
    _ONES,
    control.tf([0.1324, -0.3533, -0.6005, -0.0728], [0.5503, 1.4175, 2.6531, 2.4802, 1.0]),
    {"k": (0.5, 2.0)},
    limits=_POSITIVE,
)


def _satellite(e1: Any, e2: Any) -> Any:
    """Coupled rates, and torques that are a little more or less than asked for."""
    return [[0, 10], [-10, 0]], [[1 + e1, 0], [0, 1 + e2]], [[1, 10], [-10, 1]]


SATELLITE = Loop(
    "spinning satellite",
    1 / math.sqrt(101),
    _satellite,
    {"e1": 0.0, "e2": 0.0},
    -np.eye(2),
    {"e1": (-1.0, 1.0), "e2": (-1.0, 1.0)},
)


def _doyle() -> Loop:
    gain, A = 10.0, np.array([[1.0, 1], [0, 1]])
    B, C, K = np.array([[0.0], [1]]), np.array([[1.0, 0]]), np.full((1, 2), gain)
    law = control.ss(A - B @ K - K.T @ C, K.T, -K, 0)
    return Loop("Doyle's LQG", 0.1, lambda m: (A, [[0], [m]], C), {"m": 1.0}, law, {"m": 0.1})


DOYLE = _doyle()


def pid(Kp: float, Ki: float, Kd: float, Tf: float) -> control.TransferFunction:
    """-(Kp + Ki / s + Kd s / (Tf s + 1)): MATLAB's pid, fed back."""
    return -(control.tf([Kp], [1]) + control.tf([Ki], [1, 0]) + control.tf([Kd, 0], [Tf, 1]))


def _oscillator(k: Any) -> Any:
    """18 / (s^2 + 1.8 s + k)."""
    return [[0, 1], [-k, -1.8]], [[0], [18]], [[1, 0]]


def robstab(dynamics: float, margin: float) -> Loop:
    """The example of robstab's reference page, with unmodelled dynamics of this size."""
    name = f"robstab, dynamics {100 * dynamics:g} %"
    law = pid(2.3, 3, 0.38, 0.001)
    return Loop(name, margin, _oscillator, {"k": 10.0}, law, {"k": 0.4}, dynamics=dynamics)


ROBSTAB = (robstab(0.5, 1.599258325), robstab(0.25, 2.907434278))

CASES: tuple[Polynomial | Loop, ...] = (
    DE_GASTON_SAFONOV,
    HANDBOOK_7_3_2,
    HANDBOOK_7_3_3,
    VICINO_TESI_MILANESE,
    BUS,
    island_by_a_side(0.1),
    island_by_a_side(1e-3),
    CARTS,
    ACC_BENCHMARK,
    SATELLITE,
    DOYLE,
    *ROBSTAB,
)
