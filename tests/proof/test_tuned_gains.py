"""Gains as parameters of the proof: the tuned loop is that of a controller with these gains, and stays stable."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from along_travel import at_place
from exported import controller

import malta
from malta.linear.closed_loops import closed_loop, instability
from malta.loops.parametric_loops import machine_system
from malta.margins.travel import travel_loops
from malta.margins.tuned_gains import MAX_SCATTER, GainBox, gain_box, tuned_loop
from malta.proof.groups import groups, loop_of
from malta.synthesis.controller import Controller

pytestmark = pytest.mark.usefixtures("proven_once")

BOX = {"m": 0.2, "K_A": 0.2, "K_D": 0.2, "K_B": 0.2}


def scaled(c: Controller, factors: Any) -> Controller:
    """The controller with rows of K and Ki times a factor each, but for entries that are 1 or -1."""
    rows = np.asarray(factors, dtype=float)[:, None]
    return replace(c, K=np.where(np.abs(c.K) == 1, c.K, rows * c.K), Ki=rows * c.Ki)


@pytest.mark.parametrize("name", ["tubular_pid", "robust", "robust_observer"])
@pytest.mark.parametrize("factor", [0.8, 1.0, 1.2])
def test_the_tuned_loop_has_the_poles_of_a_controller_with_these_gains(name: str, factor: float) -> None:
    """And, of the echoes and of what is a sample behind, poles that end within a sample."""
    c = controller(name)
    plant = malta.plant_of(c.parameters)
    along, _ = travel_loops(plant, c, tuple(BOX))
    system = along[0][0]
    tuned, law = tuned_loop(plant, c, system)
    p = np.append(1.1 * system.nominal, factor)
    _, other = machine_system(plant, scaled(c, [factor] * 5), (*BOX, "z"), {})
    wanted = np.linalg.eigvals(closed_loop(system, other, p[:-1])[0])
    found = np.linalg.eigvals(closed_loop(tuned, law, p)[0])
    apart = [np.abs(found - pole).min() / max(abs(pole), 1.0) for pole in wanted]
    assert max(apart) < 1e-7
    assert instability(tuned, law, p[None]) == pytest.approx(
        instability(system, other, p[None, :-1]), rel=1e-6
    )
    assert len(groups(loop_of(tuned, law))) == 3


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("halbach", "its commands do not act a sample later by PI current loops"),
        pytest.param(
            "planar", "its commands do not act a sample later by PI current loops", marks=pytest.mark.slow
        ),
    ],
)
def test_a_loop_of_another_kind_gets_its_reason(name: str, reason: str) -> None:
    c = controller(name)
    assert gain_box(malta.plant_of(c.parameters), c, {"m": 0.1}) == GainBox(None, (), reason)
    assert gain_box(malta.plant_of(c.parameters), c, {}).reason == "the gain file has no uncertainty"


@pytest.mark.slow
def test_gains_of_a_pid_may_scatter_while_the_loop_stays_stable() -> None:
    """Proven for the whole box over the travel; machines and factors of each axis at random, and at corners, agree."""
    c = controller("tubular_pid")
    plant = malta.plant_of(c.parameters)
    found = gain_box(plant, c, BOX)
    assert (found.reason, found.searched) == ("", False)
    assert found.share is not None
    assert (
        MAX_SCATTER / 2 <= found.share <= MAX_SCATTER
    )  # half of it is proven first, and all of it where there is time
    assert found.axes == ((0, 2), (1, 3), (4,))
    (system, _), *_ = travel_loops(plant, c, tuple(BOX))[0]
    rng = np.random.default_rng(1)
    for _ in range(40):
        share = found.share * rng.uniform(-1, 1, 3)
        share = np.sign(share) * found.share if rng.uniform() < 0.5 else share
        factors = np.ones(5)
        for axis, value in zip(found.axes, share, strict=True):
            factors[list(axis)] += value
        _, law = machine_system(plant, scaled(c, factors), (*BOX, "z"), {})
        z = float(rng.uniform(-plant.stroke.travel, plant.stroke.travel))
        p = at_place(system, 0.2 * np.sign(rng.uniform(-1, 1, len(BOX))), z)
        assert instability(system, law, p[None])[0] < 0
