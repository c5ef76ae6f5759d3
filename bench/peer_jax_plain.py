"""Many strokes in JAX as one writes them: one machine scanned over its samples, vmapped and jitted, in double."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from peer_problem import Workload, stated

if TYPE_CHECKING:
    from malta.arrays import FloatArray

jax.config.update("jax_enable_x64", True)


def rate(c: Any, s: Any, f: Any) -> Any:
    inv_m, K_A2, moment, _, _, inv_I, ratio, l_B, _, wave, phase, F_c, g = c[:13]
    x, y, z, alpha, beta, _, _, _, _, da, db, dg = s
    sa, ca, sb, cb = jnp.sin(alpha), jnp.cos(alpha), jnp.sin(beta), jnp.cos(beta)
    n0, n1 = sb, -cb * sa
    pull0, pull1 = K_A2 * (x - z * n0), K_A2 * (y - z * n1)
    Fx, Fy = f[0] + f[2] + pull0, f[1] + f[3] + pull1
    Fz = f[4] - (pull0 * n0 + pull1 * n1) + F_c * jnp.sin(wave * z + phase)
    Mx = l_B * (f[2] - f[0]) + moment * n0 - z * Fx
    My = l_B * (f[3] - f[1]) + moment * n1 - z * Fy
    Mz = -z * f[4]
    T1, T2 = -(ca * My + sa * Mz), cb * Mx - sb * (ca * Mz - sa * My)
    turn, omega = sb * da, cb * da
    lean = ratio * (turn + dg) - turn
    dda = (T1 * inv_I - db * (lean - turn)) / cb
    ddb = T2 * inv_I + omega * lean
    accelerations = jnp.stack([Fx * inv_m, Fy * inv_m - g, Fz * inv_m, dda, ddb, -omega * db - sb * dda])
    return jnp.concatenate([s[6:], accelerations])


def step(c: Any, v: Any, moving: tuple[Any, Any]) -> tuple[Any, Any]:
    """A Runge–Kutta step; forces follow their commands as exact lags."""
    s, f = moving
    decay, h = c[13], c[14]
    half = v + decay * (f - v)
    whole = v + decay * (half - v)
    k1 = rate(c, s, f)
    k2 = rate(c, s + h / 2 * k1, half)
    k3 = rate(c, s + h / 2 * k2, half)
    k4 = rate(c, s + h * k3, whole)
    return s + h / 6 * (k1 + 2 * (k2 + k3) + k4), whole


def measure(c: Any, s: Any) -> Any:
    slope = jnp.stack([jnp.tan(s[4]) / jnp.cos(s[3]), -jnp.tan(s[3])])
    return jnp.concatenate([s[:2] - (c[8] + s[2]) * slope, s[:2] + (c[8] - s[2]) * slope, s[2:3]])


def fly(law: Any, grid: Any, substeps: int, given: Any, sigma: Any, c: Any, state: Any, key: Any) -> Any:
    """One machine: largest errors up to and with the sample of a touchdown, and whether there was none."""
    L, Cd, Ad, Bd, K, Ki, limit, Ts = law

    def sample(carry: Any, given: Any) -> Any:
        s, f, xi, e, frozen, largest, flying = carry
        p_ref, xi_ref, v_ff, noise = given
        p = measure(c, s)
        largest = jnp.where(flying, jnp.maximum(largest, jnp.abs(p - p_ref)), largest)
        flying &= (p[0] ** 2 + p[1] ** 2 < c[15]) & (p[2] ** 2 + p[3] ** 2 < c[15]) & (jnp.abs(p[4]) < c[16])
        y = p + sigma * noise
        e = e + Ts * (1 - frozen) * (p_ref - y)
        hat = xi + L @ (y - Cd @ xi)
        v0 = jnp.stack([jnp.interp(y[4], grid[:, 0], grid[:, 1 + j]) for j in range(5)])
        wanted = K @ (xi_ref - hat) + Ki @ e + v_ff + v0
        v = jnp.clip(wanted, -limit, limit)
        xi = Ad @ hat + Bd @ (v - v0)
        force = v * jnp.stack([c[3], c[3], c[3], c[3], c[4]])
        s, f = lax.fori_loop(0, substeps, lambda _, moving: step(c, force, moving), (s, f))
        return (s, f, xi, e, (v != wanted) * 1.0, largest, flying), None

    zero = jnp.zeros(5)
    noise = jax.random.normal(key, (len(given[0]), 5))
    first = (state[:12], state[12:17], state[17:], zero, zero, zero, True)
    (*_, largest, flying), _ = lax.scan(sample, first, (*given, noise))
    return largest, flying


@partial(jax.jit, static_argnames="substeps")
def compiled(
    law: Any, grid: Any, substeps: int, given: Any, sigma: Any, machines: Any, states: Any, keys: Any
) -> Any:
    one = partial(fly, law, grid, substeps, given, sigma)
    return jax.vmap(one)(machines, states, keys)


def many(work: Workload) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down."""
    given, c = stated(work), work.controller
    keys = jax.random.split(jax.random.key(work.seed), given.machines.shape[1])
    largest, flying = compiled(
        (c.L, c.Cd, c.Ad, c.Bd, c.K, c.Ki, c.limits.force, c.sample_time),
        given.grid,
        work.substeps,
        (work.p_ref, work.xi_ref, work.v_ff),
        work.sigma,
        given.machines.T,
        given.states.T,
        keys,
    )
    return np.asarray(largest), ~np.asarray(flying)
