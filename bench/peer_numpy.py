"""Many strokes by hand in numpy: arrays over the machines, in parts that fit the cache, on threads."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np
from peer_problem import Machine, Problem, Workload, problem

from malta.synthesis.controller import Controller

if TYPE_CHECKING:
    from malta.arrays import FloatArray

PART = 5000  # machines, at most


def polynomial(t: FloatArray, *coefficients: float) -> FloatArray:
    """Without a constant term, the highest first."""
    s = coefficients[0] * t
    for coefficient in coefficients[1:]:
        s += coefficient
        s *= t
    return s


def trig(a: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sine and cosine within 0.01 rad, as in peers/loop.h: a fifth of the time of numpy's own."""
    t = a * a
    s, c = polynomial(t, 1 / 120, -1 / 6), polynomial(t, -1 / 720, 1 / 24, -1 / 2)
    s *= a
    s += a
    c += 1
    return s, c


def sin_pi(u: FloatArray) -> FloatArray:
    near = np.rint(u)
    u -= near
    s = polynomial(
        u * u,
        -2.1133714397960184e-05,
        0.0004659870919775173,
        -0.007370364352718201,
        0.08214587882077493,
        -0.5992645288256148,
        2.550164039861884,
        -5.167712780049786,
    )
    s += 3.1415926535897927
    s *= u
    near *= 0.5
    near -= np.floor(near)
    near *= -4
    near += 1
    s *= near
    return s


def accelerations(
    c: Machine, body: FloatArray, f: FloatArray, q: FloatArray, da: FloatArray, db: FloatArray
) -> FloatArray:
    """Of x y z alpha beta; f as in peers/loop.h."""
    stiffness, tilt, lever, cogging, spin = body
    z = q[2]
    (sa, sb), (ca, cb) = trig(q[3:])
    n = np.array([sb, -cb * sa])
    k = stiffness * (q[:2] - z * n)
    force = f[:2] + k
    arm = lever * z
    mx, my = f[2:4] + tilt * n - arm * force
    mz = arm * f[4]
    turn = sb * da
    lean = spin - turn
    a = np.empty_like(q)
    a[:2] = force
    a[1] -= c.g
    k *= n
    a[2] = f[4] + cogging * sin_pi(z * c.wave + c.phase) - k[0] - k[1]
    a[3] = (sa * mz - ca * my - db * (lean - turn)) / cb
    a[4] = cb * (mx + da * lean) + sb * (sa * my + ca * mz)
    return a


def step(c: Machine, body: FloatArray, held: FloatArray, q: FloatArray, r: FloatArray, f: FloatArray) -> None:
    """A Runge-Kutta step, in place."""
    half = held + c.decay * f
    whole = held + c.decay * half
    da, db = r[3:]
    a1 = accelerations(c, body, f, q, da, db)
    q2 = q + 0.5 * r
    a2 = accelerations(c, body, half, q2, da + 0.5 * a1[3], db + 0.5 * a1[4])
    q2 += 0.25 * a1
    a3 = accelerations(c, body, half, q2, da + 0.5 * a2[3], db + 0.5 * a2[4])
    q += r
    a4 = accelerations(c, body, whole, q + 0.5 * a2, da + a3[3], db + a3[4])
    a2 += a3
    a1 += a2
    q += a1 / 6
    a1 += a2
    a1 += a4
    a1 /= 6
    r += a1
    f[:] = whole


def measured(c: Machine, q: FloatArray) -> FloatArray:
    """Where the mover's axis pierces the sensor planes."""
    (sa, sb), (ca, cb) = trig(q[3:])
    tilt = np.array([sb / cb / ca, -sa / ca])
    p = np.empty_like(q)
    p[:2] = q[:2] - (c.l_S + q[2]) * tilt
    p[2:4] = q[:2] + (c.l_S - q[2]) * tilt
    p[4] = q[2]
    return p


@np.errstate(over="ignore", invalid="ignore")  # of what has touched down
def fly(
    given: Problem, controller: Controller, bodies: FloatArray, deviation: FloatArray, seed: int
) -> tuple[FloatArray, FloatArray]:
    """A part of the machines: largest errors up to and with the sample of a touchdown; whether there was one."""
    c, law, count = given.machine, given.law, bodies.shape[1]
    rng = np.random.Generator(np.random.SFC64(seed))
    body, (to_sum, to_moment, to_thrust) = bodies[:5], bodies[5:]
    h, limit = law.Ts / c.substeps, controller.limits.force[:, None]
    correct = np.hstack([np.eye(10) - controller.L @ controller.Cd, controller.L])  # of xi_pred, y
    feedback = np.hstack([-controller.K, controller.Ki])  # of xi_hat, e
    predict = np.hstack([controller.Ad, controller.Bd])  # of xi_hat, v - v0
    q = np.repeat(given.start[:5, None], count, axis=1)
    r = np.repeat(h * given.start[6:11, None], count, axis=1)
    loads, f = given.v0[:, None], np.zeros((5, count))
    f[1], f[3], f[4] = to_sum * (loads[0] + loads[1]), to_moment * (loads[1] - loads[0]), to_thrust * loads[2]
    seen = np.zeros((15, count))  # xi_pred, y
    seen[:10] = given.start[[0, 1, 2, 3, 4, 6, 7, 8, 9, 10], None]
    known = np.zeros((15, count))  # xi_hat, e; or v - v0
    e, gate, v0, held = (
        np.zeros((5, count)),
        np.full((5, count), law.Ts),
        np.zeros((5, count)),
        np.empty((5, count)),
    )
    largest, flying = np.zeros((5, count)), np.ones(count, dtype=bool)
    for ref, feed in zip(given.p_ref[:, :, None], given.feed[:, :, None], strict=True):
        p = measured(c, q)
        np.maximum(largest, np.abs(p - ref), out=largest, where=flying)
        flying &= (p[0] ** 2 + p[1] ** 2 < c.r_max2) & (p[2] ** 2 + p[3] ** 2 < c.r_max2)
        if deviation.any():
            p += deviation * rng.standard_normal((5, count))
        u = (np.fmax(np.fmin(p[4], law.high), law.low) - law.low) * law.per_step  # high where it is no number
        i = np.minimum(u.astype(np.intp), law.last)
        u -= i
        row = law.rows.take(i, axis=0)
        v0[1], v0[3], v0[4] = row[:, 0] + u * row[:, 1], row[:, 2] + u * row[:, 3], row[:, 4] + u * row[:, 5]
        seen[10:] = p
        e += gate * (ref - p)
        np.matmul(correct, seen, out=known[:10])
        known[10:] = e
        wanted = feedback @ known + feed + v0
        v = np.clip(wanted, -limit, limit)
        gate = law.Ts * (v == wanted)
        np.subtract(v, v0, out=known[10:])
        np.matmul(predict, known, out=seen[:10])
        held[:2], held[2:4] = to_sum * (v[:2] + v[2:4]), to_moment * (v[2:4] - v[:2])
        held[4] = to_thrust * v[4]
        held *= 1 - c.decay
        for _ in range(c.substeps):
            step(c, body, held, q, r, f)
    return largest.T, ~flying


def many(work: Workload) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down."""
    given = problem(work)
    count, deviation = given.bodies.shape[1], work.sigma[:, None]
    size = min(PART, -(-count // (os.cpu_count() or 1)))
    parts = [np.ascontiguousarray(given.bodies[:, i : i + size]) for i in range(0, count, size)]
    seeds = np.random.SeedSequence(work.seed).generate_state(len(parts))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = list(
            pool.map(lambda part, own: fly(given, work.controller, part, deviation, int(own)), parts, seeds)
        )
    largest, touched = (np.concatenate(kind) for kind in zip(*done, strict=True))
    return largest, touched
