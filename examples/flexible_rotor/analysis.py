"""What an engineer of rotors asks of the loop: whirl, unbalance, separation margins, and what the modes leave out."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

import malta

from . import flexible_rotor

if TYPE_CHECKING:
    from malta.model import Plant
    from malta.synthesis import Controller

LIMITS = tomllib.loads((Path(__file__).parent / "source" / "limits.toml").read_text(encoding="utf-8"))
ISO_14839_2 = {name: one["value"] / 100 for name, one in LIMITS["zones"].items()}  # of the clearance
HALF_POWER = math.sqrt(0.5)


def at_speed(plant: Plant, speed: float) -> Plant:
    """The same rotor at another speed, rad/s."""
    par: Any = plant.parameters
    return plant.variant(replace(par, Omega=speed, Omega_max=max(speed, par.Omega_max)))


def whirl(plant: Plant, controller: Controller | None, speed: float) -> Any:
    """Poles at a speed, 1/s: of the sampled loop, or of the free rotor without bearings."""
    machine = at_speed(plant, speed)
    if controller is not None:
        return malta.loop(machine, controller).poles
    par: Any = machine.parameters
    free = plant.variant(replace(par, k_s=1e-6))
    return np.linalg.eigvals(malta.linearize(free, free.at()).A)


class Response(NamedTuple):
    """Amplitudes of the unbalance, m, speeds x ends A and B; forward circles, alike in x and y."""

    speeds: Any  # rad/s
    sensors: Any
    magnets: Any  # where the retainer bearings stand
    forces: Any  # N, of the bearings


def unbalance_response(plant: Plant, controller: Controller, speeds: Any) -> Response:
    """Of the linear sampled loop: y = S y_0, y_0 the free motion of the open rotor under the forces on the discs.

    The bearings' forces are those that y - y_0 asks for; both without the steps of the hold.
    """
    rows: list[list[Any]] = [[], [], []]
    for speed in speeds:
        machine = at_speed(plant, float(speed))
        model, n = malta.linearize(machine, machine.at()), len(plant.states)
        x, w = ca.SX.sym("x", n), ca.SX.sym("w", 4)
        f = machine.f(x, ca.DM.zeros(4), w)
        B_w = np.array(ca.DM(ca.Function("B", [x, w], [ca.jacobian(f, w)])(0, 0)))
        one = flexible_rotor.unbalance(machine.parameters, speed)[:, 0]
        push = np.concatenate([one, -1j * one])
        inverse = np.linalg.inv(1j * speed * np.eye(n) - model.A)
        free = inverse @ B_w @ push
        y = malta.loop(machine, controller).sensitivity(np.array([speed]))[0] @ model.C @ free
        drive = inverse @ model.B
        u = np.linalg.solve(model.C @ drive, y - model.C @ free)
        motion = free + drive @ u
        lever = np.array(flexible_rotor.both(flexible_rotor.modes((n // 4) - 2).magnets))
        for row, value in zip(rows, (y, lever @ motion[: n // 2], u), strict=True):
            row.append(np.abs(value[:2]))
    return Response(np.asarray(speeds), *map(np.array, rows))


class Critical(NamedTuple):
    """A peak of the unbalance response, and the separation margins of API 617."""

    speed: float  # rad/s
    amplification: float  # AF = N_c / (N_2 - N_1), the half-power points about it
    margin: float  # distance from the range of operation, share of its end
    required: float  # share; 0 of a critically damped peak


def criticals(response: Response, operation: tuple[float, float]) -> list[Critical]:
    """The peaks of both sensors that fall to half power on both sides, each with what API 617 asks for."""
    found = []
    speeds = response.speeds
    for a in response.sensors.T:
        for k in np.flatnonzero((a[1:-1] > a[:-2]) & (a[1:-1] >= a[2:])) + 1:
            under = a < HALF_POWER * a[k]
            left, right = np.flatnonzero(under[:k]), np.flatnonzero(under[k:])
            if not (len(left) and len(right)):
                continue
            AF = float(speeds[k] / (speeds[k + right[0]] - speeds[left[-1]]))
            low, high = operation
            apart = (low - speeds[k]) / low if speeds[k] < low else (speeds[k] - high) / high
            asked = required_margin(AF, "above" if speeds[k] > high else "below")
            found.append(Critical(float(speeds[k]), AF, float(apart), asked))
    return sorted(found)


def required_margin(AF: float, side: str) -> float:
    """The separation margin that source/limits.toml has of a peak "below" or "above" the range of operation."""
    known = LIMITS["separation"]
    if not known["least"]["value"] < AF:
        return 0.0
    base, most = (known[side][name]["value"] for name in ("base", "most"))
    asked = base + known["scale"]["value"] * (1 - 1 / (AF - known["offset"]["value"]))
    return float(min(most, asked)) / 100


def zone(share: float) -> str:
    """The zone of ISO 14839-2 of a displacement, as a share of the clearance."""
    return next((name for name, below in ISO_14839_2.items() if share < below), "D")


# What four bending modes leave out: all others of the finite element model, from the magnets to the sensors,
#
#     R(jw) = Phi_s Z^-1 Phi_m',      Z = W^2 - w^2 + 2 j w zeta W -+ w Omega g,
#
# in forward and backward whirl. For any matrix T with N = Herm(T Z) > 0,
#
#     |R|^2 <= |Phi_s N^-1 Phi_s'| |Phi_m T' N^-1 T Phi_m'|,      x' N x = Re x' T Phi_m' f for Z x = Phi_m' f.
#
# T is the inverse of the unitary factor of Z in the middle of a cell of frequency and speed; N over the cell is above
# that in the middle less what Z changes by. So a cell is covered, not sampled.


ROUNDING = 1e-12  # of the size of Z, allowed for floating point


class RestBound(NamedTuple):
    """A weight that bounds the rest at every frequency and speed."""

    share: float  # largest |R| / |W| that is not excluded, below 1
    cells: int


def bound_rest(
    par: Any, weight: Any, *, kept: int = flexible_rotor.BENDING, lowest: float = 1.0
) -> RestBound:
    """Cover all frequencies and speeds with cells on which |R| < |W| is shown, halving cells until it is.

    weight : W(s), a control.TransferFunction whose |W| rises with frequency

    Raises malta.CheckError where a cell shrinks without a proof.
    """
    m = flexible_rotor.modes(30)
    k = kept + 2
    w_k, g = m.w[k:], m.gyroscopic[k:, k:]
    magnets, sensors = m.magnets[:, k:], m.sensors[:, k:]
    top, gyro = 4 * w_k.max(), float(np.linalg.norm(g, 2))

    def size(a: float, b: float, low: float, high: float) -> float:
        w, Omega = (a + b) / 2, (low + high) / 2
        Z = np.diag(w_k**2 - w**2 + 2j * w * par.zeta * w_k) + w * Omega * g
        U, s, V = np.linalg.svd(Z)
        T = (U @ V).conj().T
        half = (b - a) / 2
        off = half * (2 * w + half) + 2 * half * par.zeta * w_k.max()
        off += (
            gyro * (b * max(abs(low), abs(high)) - w * abs(Omega) if b > a else 0.0)
            + gyro * b * (high - low) / 2
        )
        N = (V.conj().T * s) @ V - (off + ROUNDING * s[0]) * np.eye(len(s))
        least, own = np.linalg.eigh(N)
        if least[0] <= 0:
            return math.inf
        left, right = sensors @ own / np.sqrt(least), (own.conj().T @ T @ magnets.T) / np.sqrt(least)[:, None]
        return float(np.linalg.norm(left, 2) * np.linalg.norm(right, 2))

    def W(w: float) -> float:
        return abs(complex(weight(1j * w)))

    # Above the top every mode is far below: |Z| >= w^2 - w_max^2 - w Omega |g|.
    above = top**2 - w_k.max() ** 2 - top * par.Omega_max * gyro
    largest = float(np.linalg.norm(sensors, 2) * np.linalg.norm(magnets, 2) / above / W(top))
    stack, count = (
        [(0.0, lowest, -par.Omega_max, par.Omega_max), (lowest, top, -par.Omega_max, par.Omega_max)],
        0,
    )
    while stack:
        a, b, low, high = stack.pop()
        share = size(a, b, low, high) / W(a)
        count += 1
        if share < 1:
            largest = max(largest, share)
        elif (b - a) < 1e-7 * b:
            raise malta.CheckError(f"the rest: |R| < |W| is not shown at {a:g} rad/s")
        elif b * gyro * (high - low) > (b - a) * 2 * b:
            middle = (low + high) / 2
            stack += [(a, b, low, middle), (a, b, middle, high)]
        else:
            middle = math.sqrt(a * b) if a else b / 2
            stack += [(a, middle, low, high), (middle, b, low, high)]
    return RestBound(largest, count)
