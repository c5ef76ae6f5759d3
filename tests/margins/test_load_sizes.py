"""How large each load on a machine may be: all at once as one after the other, beside the linear loop."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from figure_checks import defects

import malta
from malta.loops.loop import Loop
from malta.loops.waveforms import largest_load, used_clearances
from malta.margins.load_sizes import COURSE_SHARES, load_limits
from malta.work import NO_TIME, WorkEnd, count_work


@cache
def loop_of(name: str) -> Loop:
    controller = malta.gains.read(f"design/gains/{name}.json")
    return malta.loop(malta.plant_of(controller.parameters), controller)


@pytest.mark.slow
def test_all_loads_at_once_are_proven_as_each_alone() -> None:
    """Norms of all loads end where the slowest is known: up to the search's tolerance they are those of each."""
    loop = loop_of("structured")
    asked: list[Any] = ["F_x", "T_z", ("F_x", "F_y"), {"F_x": 1.0, "T_y": 0.045}]
    found = load_limits(loop, asked)
    for one, load in zip(found, asked, strict=True):
        alone = malta.safe_load(loop, load)
        assert one.safe.ends == alone.ends
        assert (one.safe.limit or 0.0) == pytest.approx(alone.limit or 0.0, rel=5e-3)
        assert one.safe.disturbance == alone.disturbance
    assert [one.safe.disturbance for one in found[1:]] == ["T_z", "F_x and F_y", "1 F_x, 0.045 T_y"]
    touches, contact = largest_load(loop, "F_x")
    assert (found[0].touches, found[0].contact) == (touches, contact)
    assert math.isinf(found[1].touches)
    assert math.isnan(found[2].touches)  # of several waveforms no ascent is known
    assert "linear loop touches from 42.6 N" in " ".join(str(found[0]).split())


def test_the_largest_load_touches_the_contact_that_it_names() -> None:
    """The search ranks contacts: every other one is used less by that load."""
    loop = loop_of("calibrated")
    for load in ("F_y", "T_y"):
        size, contact = largest_load(loop, load)
        (used,) = used_clearances(loop, load, np.array([size]))
        names = loop.plant.contacts.names
        assert used[names.index(contact)] == pytest.approx(1.0, abs=1e-5)
        assert used.max() <= 1 + 1e-5


@pytest.mark.slow
def test_the_use_of_clearance_grows_with_the_load_and_lies_above_that_of_the_linear_loop() -> None:
    (found, other) = load_limits(loop_of("calibrated"), ["F_x", "F_y"], courses=True)
    course = found.course
    assert course is not None
    assert other.course is None  # one of each unit
    assert len(course.sizes) == len(COURSE_SHARES)
    assert course.sizes[-1] == found.safe.limit
    assert (np.diff(course.used) > 0).all()
    assert found.furthest is not None
    assert 0.97 < course.used[-1] == found.furthest[1] < 1  # touching ends it
    linear = np.interp(course.sizes[1:], *course.linear)
    assert (course.used[1:] > linear).all()
    assert course.linear[1][-1] == pytest.approx(1.0, abs=1e-3)
    figure = malta.report.load_limits_figure((found, other), "calibrated")
    assert defects(figure) == []
    with pytest.raises(malta.InputError, match="courses: found none"):
        malta.report.load_limits_figure((other,), "calibrated")


def test_where_the_time_is_up_nothing_is_proven_of_what_is_left() -> None:
    with count_work(math.inf, None, WorkEnd(at=-math.inf)):
        (found,) = load_limits(loop_of("structured"), ["F_y"])
    assert (found.safe.limit, found.safe.ends) == (None, NO_TIME)


def test_what_is_no_load_is_refused() -> None:
    with pytest.raises(malta.InputError, match="loads: found none, expected a load"):
        load_limits(loop_of("structured"), [])
    with pytest.raises(malta.InputError, match="a Loop, from"):
        load_limits(loop_of("structured").plant)  # type: ignore[arg-type]
