"""Random loops with light damping, and grids that are dense about every pole."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import linalg

from malta.linear.sampling import delay_inputs, sample
from malta.linear.system import System

if TYPE_CHECKING:
    from malta.arrays import ComplexArray, FloatArray


class Drawn(NamedTuple):
    """L = C (s - A)^-1 B, in differences when sampled, with negative feedback of 1; its poles, open and closed."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    T: float | None
    poles: ComplexArray  # of the closed loop and of L, rad/s

    @property
    def S(self) -> System:
        return System(self.A - self.B @ self.C, self.B, -self.C, np.eye(len(self.C)))

    def gain(self, w: FloatArray) -> ComplexArray:
        s = 1j * w if self.T is None else np.expm1(1j * w * self.T) / self.T
        return np.asarray(
            np.concatenate(
                [
                    self.C @ np.linalg.solve(some[:, None, None] * np.eye(len(self.A)) - self.A, self.B + 0j)
                    for some in np.array_split(s, max(len(s) // 4000, 1))
                ]
            )
        )

    def grid(self) -> FloatArray:
        """1200 points within 40 half-widths of every pole, 800 within 3, and 20 000 over eight decades."""
        top = 1e5 if self.T is None else math.pi / self.T
        x = np.concatenate([np.linspace(-40, 40, 1201), np.linspace(-3, 3, 801)])
        own = [abs(p.imag) + x * abs(p.real) for p in self.poles if p.imag >= 0]
        w = np.unique(np.concatenate([np.geomspace(1e-3, top, 20_001), *own]))
        return w[(w > 0) & (w <= top * (1 - 1e-9))]


def _modes(rng: np.random.Generator, count: int, p: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Modes with a damping of 1e-6 to 3 %, some as close as 1e-6, and a slow pole for each channel."""
    w, z = 10 ** rng.uniform(0, 3.5, count), 10 ** rng.uniform(-6, -1.5, count)
    for k in range(1, count):
        if rng.random() < 0.3:
            w[k] = w[k - 1] * (1 + 10 ** rng.uniform(-6, -2))
    A = np.zeros((2 * count, 2 * count))
    B, C = np.zeros((2 * count, p)), np.zeros((p, 2 * count))
    for k in range(count):
        A[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = [[0, w[k]], [-w[k], -2 * z[k] * w[k]]]
        size = 2 * z[k] * 10 ** rng.uniform(-1.5, 0.3)
        B[2 * k + 1], C[:, 2 * k] = rng.normal(size=p), size * rng.normal(size=p)
        C[:, 2 * k + 1] = size * rng.normal(size=p) * (rng.random() < 0.5)
    slow = 10 ** rng.uniform(-1, 2, p)
    return (
        linalg.block_diag(A, -np.diag(slow)),
        np.vstack([B, np.diag(5 * rng.normal(size=p))]),
        np.hstack([C, np.eye(p)]),
    )


def drawn_loop(seed: int) -> Drawn:
    """A stable loop of up to 40 states: of one to three channels, continuous, sampled, or sampled and late."""
    rng = np.random.default_rng(seed)
    while True:
        p, kind = int(rng.choice([1, 1, 2, 3])), int(rng.integers(3))
        A, B, C = _modes(rng, int(rng.integers(1, 17)), p)
        T = None
        if kind:
            T = 10 ** rng.uniform(-4.5, -3.2)
            Ad, Bd = delay_inputs(*sample(A, B, T), int(rng.integers(1, 4)) if kind == 2 else 0)
            C = np.hstack([C, np.zeros((p, len(Ad) - C.shape[1]))])
            A, B = (Ad - np.eye(len(Ad))) / T, Bd / T
        closed, own = np.linalg.eigvals(A - B @ C), np.linalg.eigvals(A)
        growth = closed.real if T is None else closed.real + T / 2 * np.abs(closed) ** 2
        if len(A) <= 40 and (growth < 0).all():
            both = np.concatenate([closed, own])
            if T is not None:
                both = np.log1p(T * both[np.abs(1 + T * both) > 1e-6]) / T
            return Drawn(A, B, C, T, both)
