"""The mover's first bending mode: a tube of the printed mass and inertias."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import malta
from malta.machines.tubular import bending
from malta.margins.travel import travel_loops


@pytest.fixture(scope="module")
def par() -> Any:
    return malta.read("data/tubular.toml")


def test_the_tube_has_the_printed_mass_and_inertias(par: Any) -> None:
    t, R = bending.tube(par), bending.radius()
    m = t.density * math.pi * (R**2 - t.bore**2) * t.length
    assert m == pytest.approx(0.360)
    assert m * (R**2 + t.bore**2) / 2 == pytest.approx(4.7707e-5)
    assert m * (3 * (R**2 + t.bore**2) + t.length**2) / 12 == pytest.approx(1.3805e-3)
    assert (t.bore, t.length) == pytest.approx((9.10e-3, 212.7e-3), rel=1e-3)
    assert bending.first_bending(par, 160e9) == pytest.approx(21885, rel=1e-3)
    assert bending.first_bending(par, 40e9) == pytest.approx(bending.first_bending(par, 160e9) / 2)


def test_the_shape_is_that_of_a_free_beam(par: Any) -> None:
    """Mean square 1, no momentum, nodes at 22.42 % of the length from the ends: between bearings and sensors."""
    L = bending.tube(par).length
    y = np.array([bending.shape(par, z) for z in np.linspace(-L / 2, L / 2, 2001)])
    assert np.mean(y**2) == pytest.approx(1, rel=5e-3)
    assert np.mean(y) == pytest.approx(0, abs=2e-3)
    assert bending.shape(par, L * (0.5 - 0.22416)) == pytest.approx(0, abs=1e-3)
    assert bending.shape(par, par.l_B) < 0 < bending.shape(par, par.l_S)


@pytest.mark.slow
def test_a_stiff_mover_keeps_the_margin_of_robust_and_a_soft_one_may_not() -> None:
    controller = malta.gains.read("design/gains/robust.json")
    own: Any = controller.parameters
    ((system, law),), over = travel_loops(malta.plant_of(own), controller, ("m",))
    proven = []
    for E in (30e9, 160e9):
        block = bending.bending_block(own, system, (0, 2), bending.first_bending(own, E), 0.005)
        proven.append(malta.dynamic_margin(system, law, {}, block, over=over).lower)
    assert proven == pytest.approx([0.0466, 1.734], rel=0.01)
