"""A sphere between magnets in equations of its own, whose sensor reads a mode beside it that malta does not know.

    m q'' = k_s q + k_i i,    eta'' + 2 zeta w eta' + w^2 eta = k_i i / m,    y = q + share eta

Nothing of malta's model, simulation or drive is used; of the gain file only the matrices of the law. Currents
follow a reading at once and are held.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm

from malta.identification import Log
from malta.model.plant import Signal
from malta.synthesis.linear_law import linear_law

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray
    from malta.simulation.multisine import Multisine
    from malta.synthesis.controller import Controller

NOISE = 10e-9  # m, rms of a reading


@dataclass(frozen=True)
class Sphere:
    """SI; the mode: how much of it the sensor reads, its frequency, its damping."""

    m: float = 0.1
    C: float = 2e-5
    s: float = 5e-3
    I_0: float = 1.5
    share: float = 0.0
    w: float = 2 * np.pi * 700
    zeta: float = 0.1

    @property
    def k_i(self) -> float:
        return 4 * self.C * self.I_0 / self.s**2

    @property
    def k_s(self) -> float:
        return 4 * self.C * self.I_0**2 / self.s**3

    def matrices(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B, C of (q, q', eta, eta') from the current to the reading."""
        A = np.zeros((4, 4))
        A[0, 1] = A[2, 3] = 1.0
        A[1, 0], A[3, 2], A[3, 3] = self.k_s / self.m, -(self.w**2), -2 * self.zeta * self.w
        B = np.array([0.0, self.k_i / self.m, 0.0, self.k_i / self.m])
        return A, B, np.array([1.0, 0.0, self.share, 0.0])

    def step(self, Ts: float) -> tuple[FloatArray, FloatArray]:
        """The states a sample later by the states and by a current that is held."""
        A, B, _ = self.matrices()
        E = expm(np.block([[A, B[:, None]], [np.zeros((1, 5))]]) * Ts)
        return E[:4, :4], E[:4, 4]

    def response(self, w: FloatArray, Ts: float) -> ComplexArray:
        """From the samples of the current to those of the reading, at frequencies in rad/s."""
        A, B = self.step(Ts)
        turn = np.exp(1j * w * Ts)[:, None, None] * np.eye(4)
        x = np.linalg.solve(turn - A, np.broadcast_to(B[:, None], (len(w), 4, 1)))[..., 0]
        return np.asarray(x @ self.matrices()[2])

    def radius(self, c: Controller) -> float:
        """The spectral radius of the closed loop."""
        (A, B), C, law = self.step(c.sample_time), self.matrices()[2], linear_law(c)
        fed = np.hstack(
            [A + np.outer(B, law.D_y[0, 0] * C) / believed(c), np.outer(B, law.C[0]) / believed(c)]
        )
        whole = np.vstack([fed, np.hstack([np.outer(law.B_y[:, 0], C), law.A])])
        return float(np.abs(np.linalg.eigvals(whole)).max())


def believed(c: Controller) -> float:
    """k_i of the gain file, N/A."""
    par = c.parameters
    return float(4 * par.C * par.I_0 / par.s**2)  # type: ignore[attr-defined]


def fly(c: Controller, signal: Multisine, duration: float, sphere: Sphere, seed: int = 0) -> Log:
    """The log of an excitation of a sphere under the law of a gain file."""
    Ts, law, random = c.sample_time, linear_law(c), np.random.default_rng(seed)
    n = round(duration / Ts)
    d = signal(Ts * np.arange(n))
    (A, B), C = sphere.step(Ts), sphere.matrices()[2]
    into, out = law.B_r[:, -2:-1], law.D_r[:1, -2:-1]
    x, xi = np.zeros(4), np.zeros(len(law.A))
    Y, V, flown = np.zeros((n, 1)), np.zeros((n, 1)), np.zeros((n, 1))
    for k in range(n):
        y = C @ x + NOISE * random.standard_normal()
        v = law.C[:1] @ xi + law.D_y[:1, 0] * y + out[:, 0] * d[k]
        xi = law.A @ xi + law.B_y[:, 0] * y + into[:, 0] * d[k]
        Y[k], V[k], flown[k] = y, v, v / believed(c)
        x = A @ x + B * flown[k, 0]
    if not np.isfinite(x).all() or np.abs(Y).max() > 1e-3:
        raise AssertionError("the sphere touched a magnet")
    newton, columns = (Signal("f", "N"),), {"y": Y, "v": V, "i": flown, "excitation": d}
    signals = {"y": (Signal("y", "m"),), "v": newton, "i": (Signal("i", "A"),), "excitation": newton}
    return Log("rig", "ball", c.name, Ts, signal.period, Ts * np.arange(n), columns, signals)
