"""Many strokes by hand in JAX: one machine, vmapped, scanned over the samples and compiled by XLA."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from peer_problem import Machine, Workload, packed, problem

if TYPE_CHECKING:
    from malta.arrays import FloatArray

jax.config.update("jax_enable_x64", True)
# Read at the first computation: without it XLA computes anew for every result what several of them share.
FLAGS = (os.environ.get("XLA_FLAGS"), "--xla_backend_extra_options=xla_cpu_use_multi_output_fusion")
os.environ["XLA_FLAGS"] = " ".join(flag for flag in FLAGS if flag)

PART = 1250  # machines, that their numbers fit the cache


class State(NamedTuple):
    """Of one machine; the arithmetic is that of peers/loop.h."""

    q: Any
    r: Any
    f: Any
    x_law: Any
    y_law: Any
    z_law: Any
    most: Any
    flying: Any


def trig(a: Any) -> tuple[Any, Any, Any]:
    """Sine, cosine and secant to the last bit within 0.01 rad."""
    t = a * a
    w = t * (-1 / 2 + t * (1 / 24 + t * (-1 / 720)))
    return a + a * t * (-1 / 6 + t * (1 / 120)), 1 + w, 1 - w * (1 - w * (1 - w))


def sin_pi(u: Any) -> Any:
    near = jnp.rint(u)
    r = u - near
    t = r * r
    s = 0.0004659870919775173 + t * -2.1133714397960184e-05
    for coefficient in (
        -0.007370364352718201,
        0.08214587882077493,
        -0.5992645288256148,
        2.550164039861884,
        -5.167712780049786,
        3.1415926535897927,
    ):
        s = coefficient + t * s
    half = 0.5 * near
    return r * s * (1 - 4 * (half - jnp.floor(half)))


def accelerations(c: Machine, body: Any, f: Any, q: Any, da: Any, db: Any) -> Any:
    """Of x y z alpha beta."""
    stiffness, tilt, lever, cogging, spin = body
    x, y, z, alpha, beta = q
    (sa, ca, _), (sb, cb, sec) = trig(alpha), trig(beta)
    n0, n1 = sb, -(cb * sa)
    kx, ky = stiffness * (x - z * n0), stiffness * (y - z * n1)
    Fx, Fy, arm = f[0] + kx, f[1] + ky, lever * z
    mx, my, mz = f[2] + tilt * n0 - arm * Fx, f[3] + tilt * n1 - arm * Fy, arm * f[4]
    turn = sb * da
    lean = spin - turn
    return (
        Fx,
        Fy - c.g,
        f[4] + cogging * sin_pi(z * c.wave + c.phase) - kx * n0 - ky * n1,
        (sa * mz - ca * my - db * (lean - turn)) * sec,
        cb * (mx + da * lean) + sb * (sa * my + ca * mz),
    )


def plus(a: Any, s: float, b: Any) -> Any:
    return tuple(p + s * q for p, q in zip(a, b, strict=True))


def step(c: Machine, body: Any, held: Any, moving: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    """A Runge-Kutta step: positions, rates, forces."""
    q, r, f = moving
    half = plus(held, c.decay, f)
    whole = plus(held, c.decay, half)
    da, db = r[3:]
    a1 = accelerations(c, body, f, q, da, db)
    q2 = plus(q, 0.5, r)
    a2 = accelerations(c, body, half, q2, da + 0.5 * a1[3], db + 0.5 * a1[4])
    a3 = accelerations(c, body, half, plus(q2, 0.25, a1), da + 0.5 * a2[3], db + 0.5 * a2[4])
    q = plus(q, 1.0, r)
    a4 = accelerations(c, body, whole, plus(q, 0.5, a2), da + a3[3], db + a3[4])
    middle = plus(a2, 1.0, a3)
    early = plus(a1, 1.0, middle)
    return plus(q, 1 / 6, early), plus(r, 1 / 6, plus(early, 1.0, plus(middle, 1.0, a4))), whole


def measured(c: Machine, q: Any) -> Any:
    """Where the mover's axis pierces the sensor planes."""
    x, y, z, alpha, beta = q
    (sa, _, sec_a), (sb, _, sec_b) = trig(alpha), trig(beta)
    tilt_x, tilt_y = sb * sec_b * sec_a, -(sa * sec_a)
    below, above = c.l_S + z, c.l_S - z
    return x - below * tilt_x, y - below * tilt_y, x + above * tilt_x, y + above * tilt_y, z


def radial(g: Any, Ts: Any, s: Any, y: Any, p_ref: Any, feed: Any, v0: Any) -> tuple[Any, Any]:
    """The law of (x, beta) or (y, alpha): memory, two commands. Memory: estimates, integrals, Ts or 0."""
    xi, e, gate = s[:4], s[4:6], s[6:]
    C, L, K, Ki, A, B = (
        g[at : at + size].reshape(shape)
        for at, size, shape in (
            (0, 4, (2, 2)),
            (4, 8, (4, 2)),
            (12, 8, (2, 4)),
            (20, 4, (2, 2)),
            (24, 8, (4, 2)),
            (32, 8, (4, 2)),
        )
    )
    i = [y[k] - C[k, 0] * xi[0] - C[k, 1] * xi[1] for k in range(2)]
    hat = [xi[k] + L[k, 0] * i[0] + L[k, 1] * i[1] for k in range(4)]
    e = [e[k] + gate[k] * (p_ref[k] - y[k]) for k in range(2)]
    w = [feed[k] + Ki[k, 0] * e[0] + Ki[k, 1] * e[1] + v0[k] for k in range(2)]
    w = [w[k] - sum(K[k, j] * hat[j] for j in range(4)) for k in range(2)]
    v = [jnp.clip(w[k], -g[40 + k], g[40 + k]) for k in range(2)]
    u = [v[k] - v0[k] for k in range(2)]
    xi = tuple(
        A[k, 0] * hat[k % 2] + A[k, 1] * hat[k % 2 + 2] + B[k, 0] * u[0] + B[k, 1] * u[1] for k in range(4)
    )
    return (*xi, *e, *(jnp.where(v[k] == w[k], Ts, 0.0) for k in range(2))), v


def axial(g: Any, Ts: Any, s: Any, y: Any, p_ref: Any, feed: Any, v0: Any) -> tuple[Any, Any]:
    """The law of z."""
    s0, s1, e, gate = s
    C, L0, L1, K0, K1, Ki, A0, A1, A2, B0, B1, limit = (g[k] for k in range(12))
    i = y - C * s0
    z, dz = s0 + L0 * i, s1 + L1 * i
    e += gate * (p_ref - y)
    wanted = feed + Ki * e - K0 * z - K1 * dz + v0
    v = jnp.clip(wanted, -limit, limit)
    u = v - v0
    return (A0 * z + A1 * dz + B0 * u, A2 * dz + B1 * u, e, jnp.where(v == wanted, Ts, 0.0)), v


def looked_up(law: Any, rows: Any, z: Any) -> list[Any]:
    _Ts, low, high, per_step, last = (law[96 + k] for k in range(5))
    u = (jnp.clip(z, low, high) - low) * per_step
    i = jnp.minimum(u, last).astype(int)
    row = rows[i]
    return [row[2 * k] + (u - i) * row[2 * k + 1] for k in range(3)]


def sample(
    c: Machine, substeps: int, law: Any, rows: Any, plant: Any, s: State, p_ref: Any, feed: Any, noise: Any
) -> State:
    """One machine: errors count up to and with the sample of a touchdown."""
    body, (to_sum, to_moment, to_thrust), Ts = plant[:5], plant[5:], law[96]
    p = measured(c, s.q)
    most = tuple(
        jnp.where(s.flying, jnp.maximum(s.most[k], jnp.abs(p[k] - p_ref[k])), s.most[k]) for k in range(5)
    )
    flying = s.flying & (p[0] ** 2 + p[1] ** 2 < c.r_max2) & (p[2] ** 2 + p[3] ** 2 < c.r_max2)
    y = [p[k] + noise[k] for k in range(5)]
    v0 = looked_up(law, rows, y[4])
    x_law, x = radial(law[:42], Ts, s.x_law, y[0:3:2], p_ref[0:3:2], feed[0:3:2], (0.0, 0.0))
    y_law, v = radial(law[42:84], Ts, s.y_law, y[1:4:2], p_ref[1:4:2], feed[1:4:2], v0)
    z_law, thrust = axial(law[84:96], Ts, s.z_law, y[4], p_ref[4], feed[4], v0[2])
    command = [to_sum * (x[0] + x[1]), to_sum * (v[0] + v[1])]
    command += [to_moment * (x[1] - x[0]), to_moment * (v[1] - v[0]), to_thrust * thrust]
    held = [(1 - c.decay) * force for force in command]
    moving = (s.q, s.r, s.f)
    for _ in range(substeps):
        moving = step(c, body, held, moving)
    return State(*moving, x_law, y_law, z_law, most, flying)


def begun(c: Machine, law: Any, start: Any, v0: Any, plant: Any) -> State:
    h, Ts = law[96] / c.substeps, law[96]
    _, _, _, _, _, to_sum, to_moment, to_thrust = plant
    f = (0.0, to_sum * (v0[0] + v0[1]), 0.0, to_moment * (v0[1] - v0[0]), to_thrust * v0[2])
    x, y, z = (tuple(start[k] for k in places) for places in ((0, 4, 6, 10), (1, 3, 7, 9), (2, 8)))
    q, r = tuple(start[k] for k in range(5)), tuple(h * start[6 + k] for k in range(5))
    tail = (0.0, 0.0, Ts, Ts)
    return State(q, r, f, (*x, *tail), (*y, *tail), (*z, 0.0, Ts), (0.0,) * 5, True)


def fly(
    c: Machine,
    substeps: int,
    noisy: bool,
    law: Any,
    rows: Any,
    plants: Any,
    start: Any,
    v0: Any,
    p_ref: Any,
    feed: Any,
    deviation: Any,
    key: Any,
) -> tuple[Any, Any]:
    """All machines: largest errors, count x 5, and whether there was no touchdown."""
    one = jax.vmap(partial(sample, c, substeps, law, rows), in_axes=(0, 0, None, None, 0))
    state = jax.vmap(partial(begun, c, law, start, v0))(plants)

    def at(state: State, given: Any) -> tuple[State, None]:
        k, ref, fed = given
        if noisy:
            noise = deviation[:, None] * jax.random.normal(
                jax.random.fold_in(key, k), (5, len(plants[0])), jnp.float32
            )
        else:
            noise = jnp.zeros((5, len(plants[0])))
        return one(plants, state, ref, fed, tuple(noise)), None

    state, _ = lax.scan(at, state, (jnp.arange(len(p_ref)), p_ref, feed))
    return jnp.stack(state.most, 1), state.flying


compiled = jax.jit(fly, static_argnames=("substeps", "noisy"))


def many(work: Workload) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down."""
    given = problem(work)
    fixed = (given.start, given.v0, given.p_ref, given.feed, work.sigma)
    key = jax.random.key(work.seed, impl="rbg")
    count = given.bodies.shape[1]
    bodies = np.pad(given.bodies, ((0, 0), (0, -count % PART)), mode="edge")

    def part(first: int) -> tuple[FloatArray, FloatArray]:
        plants = tuple(bodies[:, first : first + PART])
        own = jax.random.fold_in(key, first)
        largest, flying = compiled(
            given.machine,
            work.substeps,
            work.noise > 0,
            packed(work.controller),
            given.law.rows,
            plants,
            *fixed,
            own,
        )
        return np.asarray(largest), np.asarray(flying)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        done = list(pool.map(part, range(0, count, PART)))
    largest, flying = (np.concatenate(kind)[:count] for kind in zip(*done, strict=True))
    return largest, ~flying
