"""A mode of light damping in a sampled loop: its peak, its disk, its gain and delay margins, and its stability."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest
from light_loops import drawn_loop

import malta
from malta.linear.system import System
from malta.loops.classical import Nominal, balanced_norm, disk_margin

Ts = 1e-4
LEAD = control.c2d(control.ss(control.tf([20.0, 3 * 2e3], [1 / 6000.0, 1])), Ts, "tustin")
MODE = 2 * math.pi * 333.3  # rad/s


def machine(zeta: float, target: float) -> Any:
    """0.1 kg on a negative stiffness of 2 N/mm; its mode brings the loop gain at MODE to about -target."""
    m, k, c = 0.1, 2e3, 1.0
    s = 1j * MODE
    hold = (1 - np.exp(-s * Ts)) / (s * Ts)
    adds = target / (LEAD(np.exp(s * Ts)) * hold) - 1 / (m * s * s + c * s - k)
    a, b = -adds.imag * 2 * zeta * MODE**2, adds.real * 2 * zeta * MODE
    A = [[0, 1, 0, 0], [0, -c / m, 0, 0], [0, 0, 0, 1], [0, 0, -(MODE**2), -2 * zeta * MODE]]
    by_k = [[0] * 4, [1 / m, 0, 0, 0], [0] * 4, [0] * 4]
    return malta.linear_machine(
        A, [[0], [1 / m], [0], [1.0]], [[1, 0, a, b]],
        name="flex", limit=40.0, noise=1e-6, nominal={"k": k}, terms={"k": [by_k]},
    )  # fmt: skip


def late(plant: Any, samples: int) -> float:
    """The largest |z| of the loop with so many samples more of delay."""
    model = malta.linearize(plant, plant.at())
    loop = control.c2d(control.ss(model.A, model.B, model.C, 0), Ts) * LEAD
    for _ in range(samples):
        loop = loop * control.ss([[0]], [[1]], [[1]], [[0]], Ts)
    return float(np.abs(np.linalg.eigvals(loop.A - loop.B @ loop.C)).max())


def sensitivity(plant: Any) -> Any:
    """S on a grid of 20 000 frequencies within 1 % of the mode."""
    model = malta.linearize(plant, plant.at())
    loop = control.c2d(control.ss(model.A, model.B, model.C, 0), Ts) * LEAD
    w = MODE * (1 + np.linspace(-0.01, 0.01, 20_001))
    return 1 / (1 + loop(np.exp(1j * w * Ts)))


def test_verify_sees_a_mode_of_one_percent() -> None:
    plant = machine(1e-2, -0.85)
    model = malta.linearize(plant, plant.at())
    law = malta.synthesis.controller_of(LEAD, plant, name="lead")
    S, found = sensitivity(plant), malta.verify(model, law, {"k": 0.1}, stages=True)
    peak, disk = np.abs(S).max(), 1 / np.abs(S - 0.5).max()
    assert peak == pytest.approx(6.69, rel=1e-3)
    assert found.peak_sensitivity["y1"] == pytest.approx(peak, rel=1e-5)
    assert found.disks[0].size == pytest.approx(disk, rel=1e-5)
    (margins,) = malta.loops.loop_curves(malta.loop(plant, law)).margins
    assert margins.peak_sensitivity == pytest.approx(peak, rel=1e-5)
    for factor, stable in ((0.999, True), (1.001, False)):
        wide = control.ss(
            LEAD.A, LEAD.B, factor * margins.gain[1] * LEAD.C, factor * margins.gain[1] * LEAD.D, Ts
        )
        louder = malta.synthesis.controller_of(wide, plant, name="louder")
        assert malta.verify(model, louder).stable == stable


def test_the_delay_margin_is_that_of_the_mode() -> None:
    """10 samples more are stable, 11 are not, and 20 are again."""
    plant = machine(3e-3, 1.5)
    law = malta.synthesis.controller_of(LEAD, plant, name="lead")
    found = malta.verify(malta.linearize(plant, plant.at()), law, {"k": 0.01}, stages=True)
    assert [late(plant, samples) < 1 for samples in (10, 11, 20)] == [True, False, True]
    assert 10 < found.delay["y1"] / Ts < 11


@pytest.mark.parametrize(
    ("w", "zeta"), [(1000.0, 1e-4), (1000.0, 1e-6), (3.3, 1e-4), (3.3, 1e-5), (137.0, 1e-6)]
)
def test_curves_have_the_margins_of_a_narrow_mode(w: float, zeta: float) -> None:
    mode = control.ss(control.tf([2 * zeta * w * 0.9, 0], [1, 2 * zeta * w, w * w]))
    L = control.ss(control.tf([0.5], [1, 1])) - mode
    found = malta.loops.loop_curves(L)
    x = w + np.concatenate([np.linspace(-40, 40, 10_000), np.linspace(-2, 2, 20_001)]) * zeta * w
    x = np.unique(x)
    G = L(1j * x)
    at = np.flatnonzero((np.diff(np.sign(G.imag)) != 0) & (G.real[1:] < 0))
    (margins,) = found.margins
    assert margins.peak_sensitivity == pytest.approx(np.abs(1 / (1 + G)).max(), rel=1e-5)
    share = G.imag[at] / (G.imag[at] - G.imag[at + 1])
    real = G.real[at] + share * (G.real[at + 1] - G.real[at])
    assert margins.gain[1] == pytest.approx((-1 / real).min(), rel=1e-6)
    drawn = np.abs(found.responses.S[:, 0, 0]).max()
    assert drawn == pytest.approx(margins.peak_sensitivity, rel=1e-3)


def check_disks(seed: int) -> None:
    """The disk of all sensors at once is that of the largest balanced norm on a dense grid, never above it."""
    drawn = drawn_loop(seed)
    p, w = len(drawn.C), drawn.grid()
    plant = System(drawn.A, drawn.B, drawn.C, np.zeros((p, p)))
    law = System(np.zeros((0, 0)), np.zeros((0, p)), np.zeros((p, 0)), -np.eye(p))
    found = disk_margin(Nominal(plant, law, True, drawn.T), "sensors").size
    S = np.linalg.inv(np.eye(p) + drawn.gain(w))
    seen = 1 / balanced_norm(S - np.eye(p) / 2).max()
    assert (1 - 3e-4) * seen <= found <= (1 + 1e-6) * seen


@pytest.mark.parametrize("seed", [3])
def test_no_disk_is_missed(seed: int) -> None:
    check_disks(seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 160))
def test_no_disk_of_sixty_is_missed(seed: int) -> None:
    check_disks(seed)
