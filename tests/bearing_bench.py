"""A lab's machine in equations of its own, with imperfections that malta does not know: logs with a hidden truth.

Five degrees of freedom of a magnetic bearing with a thrust axis, windings behind PI loops with a dead time, position
sensors with gains, cross talk, lag and noise. Nothing of malta's model, simulation or drive is used; of the gain file
only the matrices of the law, which runs on the bench as it is. Many machines run side by side.

    q = (x, y, z, alpha, beta), small angles; x at the plane s of the stator is x + (s - z) beta, y there is
    y - (s - z) alpha
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.identification import Log
from malta.model.plant import Signal
from malta.synthesis.linear_law import linear_law

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.simulation.multisine import Multisine
    from malta.synthesis.controller import Controller

TS = 50e-6  # s
NOISE = np.array([0.33e-6, 0.47e-6, 0.41e-6, 0.42e-6, 15e-6])  # m, rms of a reading
STEPS = np.array([1e-6, 1e-6, 1e-6, 1e-6, 0.0])  # m, of a reading
CURRENTS = ("i_0q1", "i_dd1", "i_qd1", "i_0q2", "i_dd2", "i_qd2")
READINGS = ("x1", "y1", "x2", "y2", "z")
FORCES = ("fx_B1", "fy_B1", "fx_B2", "fy_B2", "f_D")


@dataclass(frozen=True)
class Truth:
    """A machine and its bench, SI. The first line is what data files know of; all else is an imperfection."""

    m: float = 0.36
    I_xx: float = 1.3805e-3
    K_A: float = 8626.7
    K_B: float = 5.2
    K_D: float = 5.2
    F_c: float = 0.5
    phi_c: float = 0.0
    l_B: float = 44.56e-3
    l_S: float = 93.75e-3
    dK_A: float = 0.0
    dK_B: float = 0.0
    I_yy: float = 0.0  # more than I_xx, as a share
    frame: float = 0.0  # rad, by which the radial sensors are turned about the axis
    cross: FloatArray = field(default_factory=lambda: np.zeros((5, 5)))  # of forces
    lag: float = 0.0  # s, of the radial sensors
    e_x: float = 0.0  # magnetic centre, m
    e_y: float = 0.0
    friction: float = 0.0  # N s/m, along x, y and z
    c_x: float = 0.0  # centre of gravity, m
    c_y: float = 0.0
    sag: float = 0.0  # torque about x of z, in m g
    skew: float = 0.0  # samples by which the currents of the log are older than its readings
    gains: FloatArray = field(default_factory=lambda: np.zeros(5))  # of the position sensors, less 1
    R: float = 2.2
    L: float = 2.8e-3


def draw(seed: int, **fixed: Any) -> Truth:
    """A realistic machine: imperfections of 0.2 to 1 %, about half of those of the list, at random."""
    random = np.random.default_rng(seed)

    def size(full: float, low: float = 0.2) -> float:
        present = random.random() < 0.6
        return float(present * full * random.uniform(low, 1) * random.choice([-1, 1]))

    cross = 2e-3 * random.uniform(-1, 1, (5, 5)) * (1 - np.eye(5)) * (random.random() < 0.6)
    given: dict[str, Any] = {
        "K_A": 8626.7 * random.uniform(0.95, 1.05),
        "K_B": 5.2 * random.uniform(0.95, 1.05),
        "K_D": 5.2 * random.uniform(0.95, 1.05),
        "I_xx": 1.3805e-3 * random.uniform(0.95, 1.05),
        "m": 0.36 * (1 + size(5e-3)),
        "dK_A": size(5e-3),
        "dK_B": size(3e-3),
        "I_yy": size(3e-3),
        "frame": size(3e-3),
        "cross": cross,
        "lag": abs(size(20e-6)),
        "e_x": size(20e-6),
        "e_y": size(20e-6),
        "friction": abs(size(1.0)),
        "c_x": size(0.2e-3),
        "c_y": size(0.2e-3),
        "skew": abs(size(1.0, 0.3)),
        "gains": np.array([size(1e-2) for _ in range(4)] + [0.0]),
        "R": 2.2 * random.uniform(0.95, 1.1),
    }
    return Truth(**{**given, **fixed})


def _linear(t: Truth) -> tuple[FloatArray, FloatArray]:
    """A and B of (q, q') and the six currents about the middle, without what is curved."""
    K1, K2 = t.K_A * (1 - t.dK_A), t.K_A * (1 + t.dK_A)
    B1, B2 = t.K_B * (1 - t.dK_B), t.K_B * (1 + t.dK_B)
    M = np.diag([t.m, t.m, t.m, t.I_xx, t.I_xx * (1 + t.I_yy)])
    lever = t.l_B
    K = np.zeros((5, 5))
    K[0, [0, 4]], K[4, [0, 4]] = (K1 + K2, lever * (K2 - K1)), (lever * (K2 - K1), lever * lever * (K1 + K2))
    K[1, [1, 3]], K[3, [1, 3]] = (
        (K1 + K2, -lever * (K2 - K1)),
        (-lever * (K2 - K1), lever * lever * (K1 + K2)),
    )
    K[2, 2] = t.F_c * 2 * np.pi / 15e-3 * np.cos(t.phi_c)
    K[3, 2] = t.sag * t.m * 9.81
    D = -t.friction * np.diag([1.0, 1, 1, 0, 0])
    # Forces fx1 fy1 fx2 fy2 f_D of the currents, then their wrench.
    own = np.zeros((5, 6))
    own[[0, 1, 2, 3], [1, 2, 4, 5]] = B1, B1, B2, B2
    own[4, [0, 3]] = t.K_D
    acts = np.array(
        [
            [1, 0, 1, 0, 0],
            [0, 1, 0, 1, 0],
            [0, 0, 0, 0, 1],
            [0, lever, 0, -lever, -t.c_y],
            [-lever, 0, lever, 0, t.c_x],
        ]
    )
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((5, 5)), np.eye(5)], [inverse @ K, inverse @ D]])
    return A, np.vstack([np.zeros((5, 6)), inverse @ acts @ (np.eye(5) + t.cross) @ own])


def _exact(
    A: FloatArray, B: FloatArray, rate: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A sample of x' = A x + B i + a: x+ = Ad x + B0 i + B1 u + Bc a, where i goes towards u with a rate."""
    from scipy.linalg import expm

    n, m = B.shape
    W = np.zeros((n + 2 * m + n,) * 2)
    W[:n, :n], W[:n, n : n + m], W[:n, n + 2 * m :] = A, B, np.eye(n)
    W[n : n + m, n : n + m], W[n : n + m, n + m : n + 2 * m] = -rate * np.eye(m), rate * np.eye(m)
    E = expm(W * TS)[:n]
    return E[:, :n], E[:, n : n + m], E[:, n + m : n + 2 * m], E[:, n + 2 * m :]


def fly(c: Controller, signal: Multisine, duration: float, truths: list[Truth], seed: int = 0) -> list[Log]:
    """The logs of an excitation of machines under the law of a gain file."""
    n, many, random = round(duration / TS), len(truths), np.random.default_rng(seed)
    law, m = linear_law(c), 5
    d = signal(TS * np.arange(n))
    v0 = np.array([np.interp(0.0, c.feedforward.z_grid, column) for column in c.feedforward.v0.T])
    into = np.hstack([law.B_y, law.B_r[:, -2 * m : -m], law.B_r[:, -m:]])
    out = np.hstack([law.D_y[:m], law.D_r[:m, -2 * m : -m], law.D_r[:m, -m:]])
    step = np.vstack([np.hstack([law.A, into]), np.hstack([law.C[:m], out])])
    linear = [_linear(t) for t in truths]
    parts = [_exact(*one, t.R / t.L) for one, t in zip(linear, truths, strict=True)]
    whole = np.array([np.hstack(p) for p in parts])  # many x 10 x (10 + 6 + 6 + 10)
    cut = np.array([np.hstack([A, B])[5:] for A, B in linear])
    believed = 1 / np.array([5.2, 5.2, 5.2, 5.2, 10.4])
    to_axes = [4, 0, 1, 4, 2, 3]  # force that each axis makes
    get = {
        name: np.array([getattr(t, name) for t in truths])
        for name in (
            "m",
            "I_xx",
            "K_A",
            "F_c",
            "phi_c",
            "l_B",
            "l_S",
            "e_x",
            "e_y",
            "frame",
            "lag",
            "skew",
            "R",
            "L",
            "dK_A",
        )
    }
    gains = np.array([t.gains for t in truths])
    decay, held = np.exp(-get["R"] / get["L"] * TS)[:, None], 1 / get["R"][:, None]
    tau = np.maximum(get["lag"], 1e-9)[:, None] / TS  # a position goes evenly from sample to sample
    slower = np.exp(-1 / tau)
    newest = 1 - (1 - slower) * tau
    last = np.zeros((many, 4))
    older = np.exp(-get["R"] / get["L"] * TS * (1 - get["skew"]))[:, None]
    w_cc, pm = 3000.0, np.radians(60)
    lag_pi = np.tan(np.pi - np.arctan(w_cc * 2.8e-3 / 2.2) - w_cc * 75e-6 - pm)
    kp = np.hypot(2.2, w_cc * 2.8e-3) / np.hypot(1, lag_pi)
    ki = kp * w_cc * lag_pi
    noise = random.normal(size=(n, many, 5)) * NOISE
    off = random.normal(size=(n, many, 6)) * 1e-3
    xi = np.zeros((len(law.A), many))
    x, i, integral, u = (np.zeros((many, k)) for k in (10, 6, 6, 6))
    i[:] = (v0 * believed)[to_axes]
    integral[:] = 2.2 * i
    u[:] = 2.2 * i
    slow = np.zeros((many, 4))
    Y, V, flown = np.empty((n, many, 5)), np.empty((n, many, 5)), np.empty((n, many, 6))
    flown[0] = i
    for k in range(n):
        z, a, b = x[:, 2], x[:, 3], x[:, 4]
        near, far = -(get["l_S"] + z), get["l_S"] - z
        p = np.column_stack([x[:, 0] + near * b, x[:, 1] - near * a, x[:, 0] + far * b, x[:, 1] - far * a])
        slow = slower * slow + (1 - slower - newest) * last + newest * p
        last = p
        turned = slow + get["frame"][:, None] * np.column_stack(
            [slow[:, 1], -slow[:, 0], slow[:, 3], -slow[:, 2]]
        )
        y = np.column_stack([turned, z]) * (1 + gains) + noise[k]
        y[:, :4] = np.round(y[:, :4] / 1e-6) * 1e-6
        loads = [np.interp(y[:, 4], c.feedforward.z_grid, column) for column in c.feedforward.v0.T]
        given = np.vstack([xi, y.T, np.repeat(d[k][:, None], many, axis=1), *(one[None] for one in loads)])
        given = step @ given
        xi, v = given[: len(xi)], given[len(xi) :].T
        Y[k], V[k] = y, v
        wanted = (v * believed)[:, to_axes]
        e = wanted - i
        integral = integral + ki * TS * e
        following = kp * e + integral
        # What the linear part has not: levers that move with the stroke, cogging, thrust on a tilted mover, loads.
        acts = np.matmul(cut[:, :, 10:], i[:, :, None])[:, :, 0]
        more = np.zeros((many, 10))
        F = acts[:, :2] * get["m"][:, None] + 2 * get["K_A"][:, None] * x[:, :2]
        pull = 2 * get["K_A"] * z
        thrust = acts[:, 2] * get["m"]
        more[:, 5], more[:, 6] = -pull * b / get["m"], pull * a / get["m"] - 9.81
        more[:, 5] -= 2 * get["K_A"] * get["e_x"] / get["m"]
        more[:, 6] -= 2 * get["K_A"] * get["e_y"] / get["m"]
        wave = 2 * np.pi / 15e-3
        more[:, 7] = (
            get["F_c"] / get["m"] * (np.sin(wave * z + get["phi_c"]) - wave * z * np.cos(get["phi_c"]))
        )
        F_x = F[:, 0] - pull * b - 2 * get["K_A"] * get["e_x"]
        F_y = F[:, 1] + pull * a - 2 * get["K_A"] * get["e_y"]
        rest = 2 * get["K_A"] * get["l_B"] * get["dK_A"]
        more[:, 8] = (z * F_y + z * a * thrust + rest * get["e_y"]) / get["I_xx"]
        more[:, 9] = (-z * F_x + z * b * thrust - rest * get["e_x"]) / get["I_xx"]
        aim = u * held
        now = np.concatenate([x, i, aim, more], axis=1)
        x = np.matmul(whole, now[:, :, None])[:, :, 0]
        flown[min(k + 1, n - 1)] = aim + (i - aim) * older  # at the next sample, less the skew
        i = aim + (i - aim) * decay
        u = following
    if not np.isfinite(x).all() or np.abs(Y[:, :, :4]).max() > 0.5e-3:
        raise AssertionError("a machine touched down")
    return [_log(c, signal, d, Y[:, j], V[:, j], flown[:, j] + off[:, j]) for j in range(many)]


def _log(c: Controller, signal: Multisine, d: FloatArray, y: FloatArray, v: FloatArray, i: FloatArray) -> Log:
    forces = tuple(Signal(name, "N") for name in FORCES)
    signals = {
        "y": tuple(Signal(name, "m") for name in READINGS),
        "v": forces,
        "i": tuple(Signal(name, "A") for name in CURRENTS),
        "excitation": forces,
    }
    columns = {"y": y, "v": v, "i": i, "excitation": d}
    return Log("rig", "tubular", c.name, TS, signal.period, TS * np.arange(len(y)), columns, signals)
