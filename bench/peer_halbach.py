"""The Halbach motor by hand in plain Python floats: position law, current loops, sensors, half-bridges and motor.

The arithmetic is malta's, the real electronics' with every quantizer on; the noise is given. Written to be read.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import erf

from malta.machines.halbach.electronics import MEAN_SAMPLES, current_loop
from malta.machines.halbach.plant import Parameters
from malta.simulation.readings import keys, normals

if TYPE_CHECKING:
    from collections.abc import Sequence

    from malta.model.plant import Plant
    from malta.simulation.scenario import Scenario
    from malta.synthesis.controller import Controller

PHASES = (0.0, 2 * math.pi / 3, -2 * math.pi / 3)
TURNED = [(math.cos(p), math.sin(p)) for p in PHASES]
Vector = list[float]


class Row(NamedTuple):
    """At a reading of the laser."""

    x: float  # m
    speed: float  # m/s
    y: float  # m, as read
    F: float  # N, commanded
    currents: Vector  # A


class Law:
    """A controller's law of one input and one output, in filter form, with nothing but sums of products."""

    def __init__(self, c: Controller, x0: float) -> None:
        self.Ad, self.K, self.Cd = c.Ad.tolist(), c.K[0].tolist(), c.Cd[0].tolist()
        self.Bd, self.L = c.Bd[:, 0].tolist(), c.L[:, 0].tolist()
        self.Ki, self.T, self.limit = float(c.Ki[0, 0]), c.sample_time, float(c.limits.force[0])
        self.inertia, self.drag = float(c.feedforward.inertia[0]), float(c.feedforward.speed[0, 0])
        self.faster = 1 + float(c.feedforward.rate[0, 0])
        self.xi = [x0] + [0.0] * (len(self.Ad) - 1)
        self.e, self.limited = 0.0, False

    def __call__(self, y: float, wanted: Sequence[float]) -> float:
        """The force for a reading, where position, speed and acceleration are wanted."""
        p, dp, ddp = wanted
        if not self.limited:
            self.e += self.T * (p - y)
        off = y - dot(self.Cd, self.xi)
        now = [xi + gain * off for xi, gain in zip(self.xi, self.L, strict=True)]
        target = [p, self.faster * dp] + [0.0] * (len(now) - 2)
        fed = self.inertia * ddp + self.drag * dp
        F = dot(self.K, [t - xi for t, xi in zip(target, now, strict=True)]) + self.Ki * self.e + fed
        given = max(min(F, self.limit), -self.limit)
        self.limited = given != F
        self.xi = [dot(row, now) + b * given for row, b in zip(self.Ad, self.Bd, strict=True)]
        return given


def dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def given(plant: Plant, c: Controller, s: Scenario) -> tuple[list[Any], Vector, list[Any]]:
    """What `run` takes, as a scenario has it: the reference, malta's noise of the laser, and of the current sensors."""
    count = round(s.duration / c.sample_time)
    motion = s.reference(plant)(np.arange(count) * c.sample_time)
    uniform = math.sqrt(3) * erf(normals(keys(s.seed, np.atleast_1d(s.run))[0], count, 1) / math.sqrt(2))
    periods = _periods(count, c)
    noise = normals(keys(s.seed, -1 - np.atleast_1d(s.run))[0], periods, 2)
    return np.hstack(motion).tolist(), (uniform[:, 0] * plant.sensors.noise[0]).tolist(), noise.tolist()


def _periods(readings: int, c: Controller) -> int:
    """PWM periods before a reading, which begins with the first period after it."""
    par = c.parameters
    assert isinstance(par, Parameters)
    return math.ceil(readings * c.sample_time * par.f_pwm - 1e-6)


def run(c: Controller, wanted: Sequence[Any], laser: Sequence[float], noise: Sequence[Any]) -> list[Row]:
    """From rest at the first of the positions; a row for each reading.

    wanted : position, speed, acceleration at each reading
    laser : error of each reading, m
    noise : of two current samples in each PWM period, standard normal
    """
    par = c.parameters
    assert isinstance(par, Parameters)
    A, k, R, L, V_dc, h = par.A, par.k, par.R, par.L, par.V_dc, 1 / par.f_pwm
    loops, code_step = current_loop(par, MEAN_SAMPLES), 2 * par.I_adc / par.codes
    duty_step = 1 / par.counts

    def park(cosine: float, sine: float, phases: Vector) -> tuple[float, float]:
        d = sum((cosine * C + sine * S) * i for (C, S), i in zip(TURNED, phases, strict=True))
        q = sum((sine * C - cosine * S) * i for (C, S), i in zip(TURNED, phases, strict=True))
        return d, q

    def unpark(cosine: float, sine: float, d: float, q: float) -> Vector:
        return [2 / 3 * ((cosine * C + sine * S) * d + (sine * C - cosine * S) * q) for C, S in TURNED]

    def modulated(V: Vector) -> tuple[Vector, bool]:
        asked = [0.5 + v / V_dc for v in V]
        inside = [min(max(d, 0.0), 1.0) for d in asked]
        duty = [min(math.floor(d / duty_step + 0.5) * duty_step, 1.0) for d in inside]
        return duty, inside != asked

    def sampled(i: float) -> float:
        return min(max(math.floor((i + par.I_adc) / code_step + 0.5), 0.0), par.codes)

    def rates(x: float, v: float, i: Vector, V: Vector) -> tuple[float, float, Vector]:
        linked = [math.cos(k * x - p) for p in PHASES]
        drop = [u - R * j - par.K_e * v * g for u, j, g in zip(V, i, linked, strict=True)]
        star = sum(drop) / 3
        F = A * dot(linked, i)
        return v, (F - par.b * v) / par.m, [(u - star) / L for u in drop]

    def moved(x: float, v: float, i: Vector, V: Vector) -> tuple[float, float, Vector]:
        def at(step: float, slope: tuple[float, float, Vector]) -> tuple[float, float, Vector]:
            dx, dv, di = slope
            return x + step * dx, v + step * dv, [j + step * dj for j, dj in zip(i, di, strict=True)]

        k1 = rates(x, v, i, V)
        k2 = rates(*at(h / 2, k1), V)
        k3 = rates(*at(h / 2, k2), V)
        k4 = rates(*at(h, k3), V)
        mean = [
            (a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(*(s[:2] for s in (k1, k2, k3, k4)), strict=True)
        ]
        di = [(a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(k1[2], k2[2], k3[2], k4[2], strict=True)]
        return at(h, (mean[0], mean[1], di))

    x, v = float(wanted[0][0]), 0.0
    law, rows = Law(c, x), []
    cosine, sine = math.cos(k * x), math.sin(k * x)
    i = unpark(cosine, sine, 0.0, par.F_z / A)
    u_d, u_q = park(cosine, sine, [R * j for j in i])
    duty, _ = modulated(unpark(cosine, sine, u_d, u_q))
    rings = [[sampled(j)] * MEAN_SAMPLES for j in i[:2]]
    sums = [sum(ring) for ring in rings]
    period = 0
    for n, (asked, error) in enumerate(zip(wanted, laser, strict=True)):
        y = math.floor((x + error) / par.dx + 0.5) * par.dx
        F = law(y, asked)
        rows.append(Row(x, v, y, F, i))
        cosine, sine = math.cos(k * y), math.sin(k * y)
        until = _periods(n + 1, c)
        while period < until:
            oldest = period % MEAN_SAMPLES
            for ring, (j, jitter) in enumerate(zip(i[:2], noise[period], strict=True)):
                code = sampled(j + par.s_adc * jitter)
                sums[ring] += code - rings[ring][oldest]
                rings[ring][oldest] = code
            a, b = (total / MEAN_SAMPLES * code_step - par.I_adc for total in sums)
            d, q = park(cosine, sine, [a, b, -a - b])
            e_d, e_q = F / A - d, par.F_z / A - q
            wanted_V = unpark(cosine, sine, u_d + loops.Kp * e_d, u_q + loops.Kp * e_q)
            after, limited = modulated(wanted_V)
            if not limited:
                u_d += loops.Ki * h * e_d
                u_q += loops.Ki * h * e_q
            x, v, i = moved(x, v, i, [V_dc * (share - 0.5) for share in duty])
            duty, period = after, period + 1
    return rows
