"""The stroke by hand for numba: one machine; and many, on threads and in lanes that LLVM makes vectors of.

The same arithmetic as in C (peers/loop.h), where what is left out is said.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numba
import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple
from peer_problem import NO_SPIN, Machine, Workload, packed, problem

if TYPE_CHECKING:
    from malta.arrays import FloatArray

LANES = 32  # machines to a block; 8 would be unrolled and not vectorized
Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(**options: Any) -> Callable[[Function], Function]:
    decorator: Callable[[Function], Function] = numba.njit(
        fastmath={"contract"}, error_model="numpy", nogil=True, **options
    )
    return decorator


njit = compiled(forceinline=True)  # a call would keep the lanes from being vectorized


class Law(NamedTuple):
    """In the order of `packed`, scalars and tuples of them: to count views of arrays costs more than the law."""

    x: Any
    y: Any
    z: Any
    Ts: float
    low: float
    high: float
    per_step: float
    last: float


@njit
def unpacked(machine: FloatArray, law: FloatArray) -> tuple[Machine, Law]:
    c = Machine(
        machine[0], machine[1], machine[2], machine[3], machine[4], machine[5], machine[6], int(machine[7])
    )
    x, y, z = radial_of(law[:42]), radial_of(law[42:84]), to_fixed_tuple(law[84:96], 12)
    return c, Law(x, y, z, law[96], law[97], law[98], law[99], law[100])


@njit
def radial_of(law: FloatArray) -> Any:
    return (
        to_fixed_tuple(law[:4], 4),
        to_fixed_tuple(law[4:12], 8),
        to_fixed_tuple(law[12:20], 8),
        to_fixed_tuple(law[20:24], 4),
        to_fixed_tuple(law[24:32], 8),
        to_fixed_tuple(law[32:40], 8),
        to_fixed_tuple(law[40:], 2),
    )


@njit
def trig(a: float) -> tuple[float, float, float]:
    """Sine, cosine and secant to the last bit within 0.01 rad, half as much again as the air gap allows."""
    t = a * a
    w = t * (-1 / 2 + t * (1 / 24 + t * (-1 / 720)))
    return a + a * t * (-1 / 6 + t * (1 / 120)), 1 + w, 1 - w * (1 - w * (1 - w))


@njit
def sin_pi(u: float) -> float:
    """An odd polynomial (error 4e-16) between the zeros, the sign by the zero's parity."""
    near: float = np.rint(u)
    r = u - near
    t = r * r
    t2 = t * t
    s = 3.1415926535897927 + t * -5.167712780049786 + t2 * (2.550164039861884 + t * -0.5992645288256148)
    late = 0.0004659870919775173 + t * -2.1133714397960184e-05
    s += t2 * t2 * (0.08214587882077493 + t * -0.007370364352718201 + t2 * late)
    even: float = 2 * np.floor(0.5 * near)
    return r * s * (1 - 2 * (near - even))


@njit
def accelerations(
    c: Machine, body: Any, f: Any, q: Any, alpha: Any, beta: Any, da: float, db: float
) -> tuple[Any, float]:
    """Of x y z alpha beta; and sin(beta) alpha'."""
    stiffness, tilt, lever, cogging, spin = body
    x, y, z, _, _ = q
    sa, ca, _ = alpha
    sb, cb, sec = beta
    n0, n1 = sb, -(cb * sa)
    kx, ky = stiffness * (x - z * n0), stiffness * (y - z * n1)
    Fx, Fy, arm = f[0] + kx, f[1] + ky, lever * z
    mx, my, mz = f[2] + tilt * n0 - arm * Fx, f[3] + tilt * n1 - arm * Fy, arm * f[4]
    turn = sb * da
    lean = spin - turn
    a = (
        Fx,
        Fy - c.g,
        f[4] + cogging * sin_pi(z * c.wave + c.phase) - kx * n0 - ky * n1,
        (sa * mz - ca * my - db * (lean - turn)) * sec,
        cb * (mx + da * lean) + sb * (sa * my + ca * mz),
    )
    return a, turn


@njit
def plus(a: Any, s: float, b: Any) -> Any:
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2], a[3] + s * b[3], a[4] + s * b[4]


@njit
def step(c: Machine, body: Any, command: Any, q: Any, r: Any, f: Any) -> tuple[Any, Any, Any, float]:
    """A Runge-Kutta step: positions, rates, forces, and by how much gamma lags behind the spin."""
    held = plus(command, -c.decay, command)
    half = plus(held, c.decay, f)
    whole = plus(held, c.decay, half)
    da, db = r[3], r[4]
    a1, turn1 = accelerations(c, body, f, q, trig(q[3]), trig(q[4]), da, db)
    q2 = plus(q, 0.5, r)
    da2, db2 = da + 0.5 * a1[3], db + 0.5 * a1[4]
    a2, turn2 = accelerations(c, body, half, q2, trig(q2[3]), trig(q2[4]), da2, db2)
    q3 = plus(q2, 0.25, a1)
    da3, db3 = da + 0.5 * a2[3], db + 0.5 * a2[4]
    a3, turn3 = accelerations(c, body, half, q3, trig(q3[3]), trig(q3[4]), da3, db3)
    q = plus(q, 1.0, r)
    q4 = plus(q, 0.5, a2)
    a4, turn4 = accelerations(c, body, whole, q4, trig(q4[3]), trig(q4[4]), da + a3[3], db + a3[4])
    middle = plus(a2, 1.0, a3)
    early = plus(a1, 1.0, middle)
    r = plus(r, 1 / 6, plus(early, 1.0, plus(middle, 1.0, a4)))
    return plus(q, 1 / 6, early), r, whole, (turn1 + turn4 + 2 * (turn2 + turn3)) * (1 / 6)


@njit
def measured(c: Machine, q: Any) -> Any:
    """Where the mover's axis pierces the sensor planes."""
    x, y, z, _, _ = q
    sa, _, sec_a = trig(q[3])
    sb, _, sec_b = trig(q[4])
    tilt_x, tilt_y = sb * sec_b * sec_a, -(sa * sec_a)
    below, above = c.l_S + z, c.l_S - z
    return x - below * tilt_x, y - below * tilt_y, x + above * tilt_x, y + above * tilt_y, z


@njit
def touches(c: Machine, p: Any) -> bool:
    return not (p[0] * p[0] + p[1] * p[1] < c.r_max2 and p[2] * p[2] + p[3] * p[3] < c.r_max2)


@njit
def radial(g: Any, Ts: float, s: Any, y: Any, p_ref: Any, feed: Any, v0: Any) -> tuple[Any, float, float]:
    """The law of (x, beta) or (y, alpha): memory, two commands. Memory: estimates, integrals, Ts or 0."""
    s0, s1, s2, s3, e0, e1, gate0, gate1 = s
    C, L, K, Ki, A, B, limit = g
    i0 = y[0] - C[0] * s0 - C[1] * s1
    i1 = y[1] - C[2] * s0 - C[3] * s1
    h0 = s0 + L[0] * i0 + L[1] * i1
    h1 = s1 + L[2] * i0 + L[3] * i1
    h2 = s2 + L[4] * i0 + L[5] * i1
    h3 = s3 + L[6] * i0 + L[7] * i1
    e0 += gate0 * (p_ref[0] - y[0])
    e1 += gate1 * (p_ref[1] - y[1])
    w0 = feed[0] + Ki[0] * e0 + Ki[1] * e1 + v0[0]
    w1 = feed[1] + Ki[2] * e0 + Ki[3] * e1 + v0[1]
    w0 -= K[0] * h0 + K[1] * h1 + K[2] * h2 + K[3] * h3
    w1 -= K[4] * h0 + K[5] * h1 + K[6] * h2 + K[7] * h3
    c0, c1 = clamp(w0, limit[0]), clamp(w1, limit[1])
    u0, u1 = c0 - v0[0], c1 - v0[1]
    memory = (
        A[0] * h0 + A[1] * h2 + B[0] * u0 + B[1] * u1,
        A[2] * h1 + A[3] * h3 + B[2] * u0 + B[3] * u1,
        A[4] * h0 + A[5] * h2 + B[4] * u0 + B[5] * u1,
        A[6] * h1 + A[7] * h3 + B[6] * u0 + B[7] * u1,
        e0,
        e1,
        Ts if c0 == w0 else 0.0,
        Ts if c1 == w1 else 0.0,
    )
    return memory, c0, c1


@njit
def axial(g: Any, Ts: float, s: Any, y: float, p_ref: float, feed: float, v0: float) -> tuple[Any, float]:
    """The law of z."""
    s0, s1, e, gate = s
    C, L0, L1, K0, K1, Ki, A0, A1, A2, B0, B1, limit = g
    i = y - C * s0
    z, dz = s0 + L0 * i, s1 + L1 * i
    e += gate * (p_ref - y)
    wanted = feed + Ki * e - K0 * z - K1 * dz + v0
    v = clamp(wanted, limit)
    u = v - v0
    return (A0 * z + A1 * dz + B0 * u, A2 * dz + B1 * u, e, Ts if v == wanted else 0.0), v


@njit
def clamp(a: float, limit: float) -> float:
    return limit if a > limit else -limit if a < -limit else a


@njit
def looked_up(law: Law, rows: FloatArray, z: float) -> tuple[float, float, float]:
    z = z if z > law.low else law.low  # low where it is no number
    u = (min(z, law.high) - law.low) * law.per_step
    i = int(min(u, law.last))
    u -= i
    return rows[i, 0] + u * rows[i, 1], rows[i, 2] + u * rows[i, 3], rows[i, 4] + u * rows[i, 5]


@njit
def control(
    law: Law, x: Any, y: Any, z: Any, p: Any, p_ref: Any, feed: Any, v0: Any, to: Any
) -> tuple[Any, Any, Any, Any]:
    """One sample of the law: memories, and what the forces head for."""
    refs, feeds = (p_ref[0], p_ref[2]), (feed[0], feed[2])
    x, x1, x2 = radial(law.x, law.Ts, x, (p[0], p[2]), refs, feeds, (0.0, 0.0))
    refs, feeds = (p_ref[1], p_ref[3]), (feed[1], feed[3])
    y, y1, y2 = radial(law.y, law.Ts, y, (p[1], p[3]), refs, feeds, (v0[0], v0[1]))
    z, thrust = axial(law.z, law.Ts, z, p[4], p_ref[4], feed[4], v0[2])
    return (
        x,
        y,
        z,
        (to[0] * (x1 + x2), to[0] * (y1 + y2), to[1] * (x2 - x1), to[1] * (y2 - y1), to[2] * thrust),
    )


@njit
def begun(c: Machine, law: Law, plant: FloatArray, start: FloatArray, v0: FloatArray) -> Any:
    """Body, worth of a newton; positions, rates, forces; memories of the law."""
    h, Ts = law.Ts / c.substeps, law.Ts
    to = (plant[5], plant[6], plant[7])
    q = (start[0], start[1], start[2], start[3], start[4])
    r = (h * start[6], h * start[7], h * start[8], h * start[9], h * start[10])
    f = (0.0, to[0] * (v0[0] + v0[1]), 0.0, to[1] * (v0[1] - v0[0]), to[2] * v0[2])
    x = (start[0], start[4], start[6], start[10], 0.0, 0.0, Ts, Ts)
    y = (start[1], start[3], start[7], start[9], 0.0, 0.0, Ts, Ts)
    z = (start[2], start[8], 0.0, Ts)
    return (plant[0], plant[1], plant[2], plant[3], plant[4]), to, q, r, f, x, y, z


@njit
def row(table: FloatArray, k: int) -> Any:
    return table[k, 0], table[k, 1], table[k, 2], table[k, 3], table[k, 4]


@compiled()
def fly(
    machine: FloatArray,
    gains: FloatArray,
    rows: FloatArray,
    plant: FloatArray,
    omega_z: float,
    start: FloatArray,
    v0: FloatArray,
    p_ref: FloatArray,
    feed: FloatArray,
    p: FloatArray,
    x: FloatArray,
) -> int:
    """One machine, up to a contact: the samples done."""
    c, law = unpacked(machine, gains)
    body, to, q, r, f, mx, my, mz = begun(c, law, plant, start, v0)
    gamma, per_second = start[5], c.substeps / law.Ts
    for k in range(len(p)):
        y = measured(c, q)
        for i in range(5):
            p[k, i] = y[i]
            x[k, i] = q[i]
            x[k, 6 + i] = r[i] * per_second
        x[k, 5] = gamma
        x[k, 11] = omega_z - trig(q[4])[0] * x[k, 9]
        if touches(c, y) or abs(y[4]) >= c.z_max:
            return k + 1
        loads = looked_up(law, rows, y[4])
        mx, my, mz, command = control(law, mx, my, mz, y, row(p_ref, k), row(feed, k), loads, to)
        gamma += law.Ts * omega_z
        for _ in range(c.substeps):
            q, r, f, turned = step(c, body, command, q, r, f)
            gamma -= turned
    return len(p)


# Rows of a block's numbers, a lane each: one array, so that LLVM sees without a check what does not overlap.
BODY, TO, Q, R, F, X_LAW, Y_LAW, Z_LAW, COMMAND, P, V0, MOST, FLYING, STREAM, SIZE, NOISE, ROWS = np.cumsum(
    [0, 5, 3, 5, 5, 5, 8, 8, 4, 5, 5, 3, 5, 1, 4, 1, 10]
).tolist()


@njit
def got(s: FloatArray, first: int, i: int) -> Any:
    return s[first, i], s[first + 1, i], s[first + 2, i], s[first + 3, i], s[first + 4, i]


@njit
def put(s: FloatArray, first: int, i: int, values: Any) -> None:
    s[first, i], s[first + 1, i], s[first + 2, i], s[first + 3, i], s[first + 4, i] = values


@njit
def law_of(s: FloatArray, first: int, i: int) -> Any:
    return *got(s, first, i), s[first + 5, i], s[first + 6, i], s[first + 7, i]


@njit
def put_law(s: FloatArray, first: int, i: int, values: Any) -> None:
    put(s, first, i, values[:5])
    s[first + 5, i], s[first + 6, i], s[first + 7, i] = values[5], values[6], values[7]


@njit
def larger(most: Any, weight: float, p: Any, ref: Any) -> Any:
    return (
        max(most[0], weight * abs(p[0] - ref[0])),
        max(most[1], weight * abs(p[1] - ref[1])),
        max(most[2], weight * abs(p[2] - ref[2])),
        max(most[3], weight * abs(p[3] - ref[3])),
        max(most[4], weight * abs(p[4] - ref[4])),
    )


@njit
def left(word: Any, by: int) -> Any:
    return (word << np.uint64(by)) | (word >> np.uint64(64 - by))


@njit
def draw(s: FloatArray, words: Any, z: int) -> None:
    """Two rows of standard normals: xoshiro256++ and Box-Muller, 32 bits each for radius and angle."""
    low = np.uint64(0xFFFFFFFF)
    for i in range(LANES):
        s0, s1, s2, s3 = words[STREAM, i], words[STREAM + 1, i], words[STREAM + 2, i], words[STREAM + 3, i]
        word = left(s0 + s3, 23) + s0
        s2 ^= s0
        s3 ^= s1
        words[STREAM, i], words[STREAM + 1, i] = s0 ^ s3, s1 ^ s2
        words[STREAM + 2, i], words[STREAM + 3, i] = s2 ^ (s1 << np.uint64(17)), left(s3, 45)
        s[SIZE, i] = np.float64(np.int64(word >> np.uint64(32))) + 0.5
        s[z, i] = np.float64(np.int64(word & low)) * 2**-31 - 1
    for i in range(LANES):  # size = m 2^k, m from sqrt(1/2) to sqrt(2)
        k = np.int64(words[SIZE, i] - np.uint64(0x3FE6A09E667F3BCD)) >> 52
        words[SIZE, i] -= np.uint64(k << 52)
        s[z + 1, i] = np.float64(k)
    for i in range(LANES):
        m = s[SIZE, i] - 1  # log by a polynomial, error 2e-7
        late = 0.19884252 + m * (-0.17212471 + m * (0.16338027 + m * -0.10378417))
        log = m * (0.99999992 + m * (-0.50000344 + m * (0.33335607 + m * (-0.24971558 + m * late))))
        radius = np.sqrt(-2 * min(log + 0.6931471805599453 * (s[z + 1, i] - 32), 0.0))
        a = s[z, i]
        s[z, i], s[z + 1, i] = radius * sin_pi(a), radius * sin_pi(a + 0.5)


@njit
def disturb(s: FloatArray, first: int, deviation: FloatArray) -> None:
    for j in numba.literal_unroll((0, 1, 2, 3, 4)):
        size = deviation[j]
        for i in range(LANES):
            s[P + j, i] += size * s[first + j, i]


@compiled()
def fly_block(
    machine: FloatArray,
    gains: FloatArray,
    rows: FloatArray,
    plants: FloatArray,
    start: FloatArray,
    v0: FloatArray,
    p_ref: FloatArray,
    feed: FloatArray,
    deviation: FloatArray,
    scalar_noise: bool,
    state: Any,
    largest: FloatArray,
    touched: Any,
) -> None:
    """Up to LANES machines: largest errors up to and with the sample of a touchdown; whether there was one."""
    c, law = unpacked(machine, gains)
    s, noisy = np.zeros((ROWS, LANES)), deviation.any()
    words = s.view(np.uint64)
    words[STREAM : STREAM + 4] = state
    for i in range(LANES):
        plant = plants[min(i, len(plants) - 1)]
        body, to, q, r, f, mx, my, mz = begun(c, law, plant, start, v0)
        put(s, BODY, i, body)
        s[TO, i], s[TO + 1, i], s[TO + 2, i] = to
        put(s, Q, i, q)
        put(s, R, i, r)
        put(s, F, i, f)
        put_law(s, X_LAW, i, mx)
        put_law(s, Y_LAW, i, my)
        s[Z_LAW, i], s[Z_LAW + 1, i], s[Z_LAW + 2, i], s[Z_LAW + 3, i] = mz
        s[FLYING, i] = 1
    for k in range(len(p_ref)):
        ref, fed = row(p_ref, k), row(feed, k)
        for i in range(LANES):
            p, flying = measured(c, got(s, Q, i)), s[FLYING, i]
            put(s, P, i, p)
            put(s, MOST, i, larger(got(s, MOST, i), flying, p, ref))
            s[FLYING, i] = 0.0 if touches(c, p) else flying
        if scalar_noise:
            for j in range(5):
                for i in range(LANES):
                    s[P + j, i] += deviation[j] * np.random.standard_normal()  # noqa: NPY002 - numba's own
        elif noisy and k % 2 == 0:
            for z in numba.literal_unroll((0, 2, 4, 6, 8)):
                draw(s, words, NOISE + z)
            disturb(s, NOISE, deviation)
        elif noisy:
            disturb(s, NOISE + 5, deviation)
        for i in range(LANES):  # apart from the rest: LLVM does not vectorize a loop that looks up
            s[V0, i], s[V0 + 1, i], s[V0 + 2, i] = looked_up(law, rows, s[P + 4, i])
        for i in range(LANES):
            mz = (s[Z_LAW, i], s[Z_LAW + 1, i], s[Z_LAW + 2, i], s[Z_LAW + 3, i])
            loads, to = (s[V0, i], s[V0 + 1, i], s[V0 + 2, i]), (s[TO, i], s[TO + 1, i], s[TO + 2, i])
            mx, my, mz, command = control(
                law, law_of(s, X_LAW, i), law_of(s, Y_LAW, i), mz, got(s, P, i), ref, fed, loads, to
            )
            put_law(s, X_LAW, i, mx)
            put_law(s, Y_LAW, i, my)
            s[Z_LAW, i], s[Z_LAW + 1, i], s[Z_LAW + 2, i], s[Z_LAW + 3, i] = mz
            put(s, COMMAND, i, command)
        for _ in range(c.substeps):
            for i in range(LANES):
                q, r, f, _turned = step(
                    c, got(s, BODY, i), got(s, COMMAND, i), got(s, Q, i), got(s, R, i), got(s, F, i)
                )
                put(s, Q, i, q)
                put(s, R, i, r)
                put(s, F, i, f)
    for i in range(len(plants)):
        for j in range(5):
            largest[i, j] = s[MOST + j, i]
        touched[i] = s[FLYING, i] == 0


@compiled(parallel=True)
def fly_all(
    machine: FloatArray,
    gains: FloatArray,
    rows: FloatArray,
    plants: FloatArray,
    start: FloatArray,
    v0: FloatArray,
    p_ref: FloatArray,
    feed: FloatArray,
    deviation: FloatArray,
    scalar_noise: bool,
    states: Any,
    largest: FloatArray,
    touched: Any,
) -> None:
    for b in numba.prange(len(states)):
        part = slice(b * LANES, (b + 1) * LANES)
        state = states[b]
        if scalar_noise:
            np.random.seed(np.uint32(state[0, 0]))  # noqa: NPY002
        fly_block(
            machine,
            gains,
            rows,
            plants[part],
            start,
            v0,
            p_ref,
            feed,
            deviation,
            scalar_noise,
            state,
            largest[part],
            touched[part],
        )


def single(work: Workload) -> tuple[FloatArray, FloatArray]:
    """True outputs, k x 5, and states, k x 12, up to and with the sample of a contact."""
    given = problem(work)
    p, x = np.empty((len(given.p_ref), 5)), np.empty((len(given.p_ref), 12))
    done = fly(
        np.array(given.machine),
        packed(work.controller),
        given.law.rows,
        np.ascontiguousarray(given.bodies[:, 0]),
        NO_SPIN,
        given.start,
        given.v0,
        given.p_ref,
        given.feed,
        p,
        x,
    )
    return p[:done], x[:done]


def many(work: Workload, *, scalar_noise: bool = False) -> tuple[FloatArray, FloatArray]:
    """Largest |p - p*| of each machine, count x 5, and whether it touched down.

    scalar_noise: from numba's own np.random, one number at a time
    """
    given = problem(work)
    count = given.bodies.shape[1]
    largest, touched = np.empty((count, 5)), np.empty(count, dtype=bool)
    blocks = (count + LANES - 1) // LANES
    fly_all(
        np.array(given.machine),
        packed(work.controller),
        given.law.rows,
        np.ascontiguousarray(given.bodies.T),
        given.start,
        given.v0,
        given.p_ref,
        given.feed,
        work.sigma,
        scalar_noise and work.noise > 0,
        np.random.default_rng(work.seed).integers(2**64, size=(blocks, 4, LANES), dtype=np.uint64),
        largest,
        touched,
    )
    return largest, touched
