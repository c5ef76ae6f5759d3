"""References of requests by the exported supervisor: as its C flies them, and unchanged where they are feasible."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from exported import controller, require
from test_supervisor_search import AXIAL, FLIGHT, rig

import malta
from malta.errors import InputError
from malta.firmware.supervisor import reference_limits
from malta.simulation.references import Motion


@pytest.fixture(autouse=True)
def _with_compiler() -> None:
    require("gcc")


def along_stroke(places: Any, rates: Any = 0.0, bends: Any = 0.0) -> Motion:
    rows = [np.zeros((len(places), 5)) for _ in range(3)]
    for row, values in zip(rows, (places, rates, bends), strict=True):
        row[:, AXIAL] = values
    return Motion(*rows)


def test_a_feasible_stroke_passes_to_the_bit() -> None:
    c = controller("robust")
    plant = malta.plant_of(c.parameters)
    stroke = malta.references.stroke(plant, 0.0, 10e-3, 0.02, 0.05)
    t = c.sample_time * np.arange(3000)
    for asked, found in zip(stroke(t), malta.firmware.limit_reference(c, stroke)(t), strict=True):
        assert np.array_equal(asked, found)


def test_places_alone_and_what_no_machine_follows_stay_within_the_limits() -> None:
    """A ramp of places, a jump back and forth and a sine beyond the travel: they stop in time, and end where asked."""
    c = controller("robust")
    limits, t = reference_limits(rig().t), c.sample_time * np.arange(4000)
    ends = limits.position[AXIAL], limits.speed[AXIAL], limits.acceleration[AXIAL]
    requests = {
        "ramp": np.minimum(1.0 * t, 13e-3),
        "jump": np.where((t / 0.03).astype(int) % 2 == 0, 13e-3, -13e-3),
        "sine": 20e-3 * np.sin(2 * np.pi * 10 * t),
    }
    for name, places in requests.items():
        found = malta.firmware.limit_reference(c, partial(lambda p, _: along_stroke(p), places))(t)
        p, dp = found.p[:, AXIAL], found.dp[:, AXIAL]
        assert np.abs(p).max() <= ends[0], name
        assert np.abs(dp).max() <= ends[1], name
        assert np.abs(np.diff(dp)).max() <= ends[2] * c.sample_time * (1 + 1e-9), name
        apart = np.diff(p) - c.sample_time * (dp[1:] + dp[:-1]) / 2
        assert np.abs(apart).max() < ends[2] * c.sample_time**2 / 2, name
    assert (
        malta.firmware.limit_reference(c, lambda _: along_stroke(requests["ramp"]))(t).p[-1, AXIAL] == 13e-3
    )


def test_it_is_what_the_supervisor_flies() -> None:
    """The references of a supervised flight with strokes, once it follows them."""
    rows = rig().trace(rig().begin(stroke=FLIGHT, rise=0.02, end=8e-3), 0.15)
    flown = rows[rows[:, 0] > 0.135]
    t = flown[:, 0]
    u = (t - FLIGHT) / 0.02
    turn, back = np.floor(u), np.floor(u) % 2 == 1
    u, A, T = u - turn, np.where(back, -8e-3, 8e-3), 0.02
    p = np.where(back, 8e-3, 0) + A * (u**3 * (10 - u * (15 - 6 * u)))
    rates = A / T * (30 * u * u * (1 - u) ** 2), A / T**2 * (60 * u * (1 - u) * (1 - 2 * u))
    found = malta.firmware.limit_reference(controller("robust"), lambda _: along_stroke(p, *rates))(t)
    assert np.abs(found.p[:-1] - flown[:-1, 12:17]).max() < 1e-15


def test_a_simulation_follows_it() -> None:
    """10 mm at once: simulated, the mover follows the stroke that this becomes within 30 um."""
    c = controller("robust")
    plant = malta.plant_of(c.parameters)

    def jump(t: Any) -> Motion:
        return along_stroke(np.where(t > 0, 10e-3, 0.0))

    def limited(_: Any) -> Any:
        return malta.firmware.limit_reference(c, jump)

    run = malta.simulate(plant, c, malta.Scenario("jump", 0.05, limited))
    assert run.t[-1] > 0.0499
    assert np.abs(run.p[-1, AXIAL] - 10e-3) < 1e-4
    asked = malta.firmware.limit_reference(c, jump)(run.t)
    assert 0 < np.abs(run.p - asked.p)[:, AXIAL].max() < 1e-3


def test_times_that_are_none_get_a_sentence() -> None:
    with pytest.raises(InputError, match="limit_reference: t: found other times"):
        malta.firmware.limit_reference(controller("robust"), lambda t: along_stroke(t))(np.array([np.nan]))
