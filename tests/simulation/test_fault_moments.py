"""Faults at random moments of a flight, with the supervisor and without it."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest
from conftest import ROOT
from figure_checks import defects, texts_of

import malta
from malta.errors import InputError
from malta.firmware.supervisor import MONITORS
from malta.machines.tubular.experiment_figures import supervised_faults_figure
from malta.machines.tubular.experiments.faults import (
    KINDS,
    MAX_LANDING_SPEED,
    PHASES,
    FaultOutcome,
    draw_blows,
    totals_of,
)
from malta.simulation.engine.compiled import compiler
from malta.simulation.experiments import Case, Experiment
from malta.synthesis.controller import Controller

OVER = 1.1  # a current loop passes its limit by that while it settles
FALL = 0.18  # m/s, at which a mover without forces meets its bearing
OFF = {"safe torque off", "all currents lost", "link reads 130 %"}  # faults that leave it nothing but to fall
PUSHING = {"sensor stuck"}  # a law that follows what stands still pushes
PUSHED = 0.1  # m/s


@pytest.fixture(autouse=True)
def _compiler() -> None:
    if compiler() is None:
        pytest.skip("no C compiler")


@cache
def robust() -> Controller:
    return malta.gains.read(ROOT / "design" / "gains" / "robust.json")


def fly(**options: Any) -> Experiment:
    c = robust()
    return malta.experiment("supervised-faults", malta.plant_of(c.parameters), c, **options)


def outcomes(e: Experiment) -> dict[str, list[FaultOutcome]]:
    return {label: [FaultOutcome(*row) for row in rows] for label, rows in e.curves.items()}


@pytest.mark.slow
def test_a_lost_current_is_a_landing() -> None:
    """The sum of its star tells it; in a lift, which is the first phase."""
    shares: list[float] = []
    e = fly(moments=1, only="lost", progress=shares.append)
    assert list(e.curves) == ["sensor lost", "one current lost", "all currents lost"]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    (row,) = outcomes(e)["one current lost"]
    assert row.speed < 5e-3
    assert MONITORS[int(row.monitor)] == "CURRENT_INFERRED"
    assert 0.2 < row.safe < 0.25
    (row,) = outcomes(e)["all currents lost"]
    assert row.current_alone > 5.0 > row.current
    assert not e.failed


def test_moments_are_in_turn_in_all_phases_and_do_not_depend_on_other_classes() -> None:
    plant = malta.plant_of(robust().parameters)
    drawn = [blow for _, blow in draw_blows(plant, KINDS, 8, seed=3)]
    for n, kind in enumerate(KINDS):
        some = [blow for _, blow in draw_blows(plant, [kind], 5, seed=3)]
        assert [(b.at, b.sensor, b.current, b.sign) for b in some] == [
            (b.at, b.sensor, b.current, b.sign) for b in drawn[8 * n : 8 * n + 5]
        ]
        assert [b.phase for b in some] == [*PHASES, next(iter(PHASES))]
    assert len({b.at for b in drawn}) == len(drawn)
    assert all(PHASES[b.phase][0] <= b.at <= PHASES[b.phase][1] for b in drawn)
    assert {b.scale for b in drawn if b.sensor == plant.stroke_output} == {10.0}
    assert [b.at for _, b in draw_blows(plant, KINDS[:1], 5, seed=4)] != [b.at for b in drawn[:5]]


@pytest.mark.slow
def test_its_figure_has_a_mark_for_each_moment_and_no_defects() -> None:
    plant, rng = malta.plant_of(robust().parameters), np.random.default_rng(1)
    hold = malta.Scenario("hold", 2e-3, malta.references.hold)
    run = malta.simulate(plant, robust(), hold)
    rows = {kind.label: rng.uniform(0.01, 0.3, (5, len(FaultOutcome._fields))) for kind in KINDS}
    for n, found in enumerate(rows.values()):
        found[:, -1] = n
        found[0, -2] = math.nan  # it flies on
    merits = totals_of(rows)
    e = Experiment("supervised-faults", "?", (Case("worst", run, merits[:1]),), merits, rows)
    figure = supervised_faults_figure(e)
    assert defects(figure) == []
    for panel, of_class in zip(figure.axes, (2, 2, 1), strict=True):
        marks = [line for line in panel.lines if line.get_linestyle() == "None" and np.size(line.get_xdata())]
        assert len(marks) == of_class * len(KINDS)
    assert "sensor lost\n(touch)" in texts_of(figure)
    assert f"fastest contact alone {1e3 * merits[3].value:.0f} mm/s" in " ".join(texts_of(figure))


@pytest.mark.slow
def test_it_ends_with_what_it_has_after_ctrl_c() -> None:
    def stop(share: float) -> None:
        if share > 0.6:
            raise KeyboardInterrupt

    e = fly(moments=2, only="torque", progress=stop)
    assert e.cut
    assert len(e.curves["safe torque off"]) == 1
    assert e.outcome == "interrupted after 1 runs"


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"moments": -1}, "moments"),
        ({"moments": 1.5}, "moments"),
        ({"moments": 10**9}, "moments"),
        ({"moments": 1, "only": "lunch"}, "only"),
        ({"moments": 1, "during": "hold"}, "during"),
        ({"moments": 1, "fidelity": "dq"}, "fidelity"),
        ({"moments": 1, "engine": "virtual machine"}, "engine"),
    ],
)
def test_what_it_cannot_fly_gets_a_sentence(options: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        fly(**options)


@pytest.mark.slow
def test_no_supervised_fault_is_worse_than_a_fall() -> None:
    """Every class in every phase: no touchdown but by faults that leave no forces or push by themselves, and currents
    within their limit but for the settling of their loops."""
    e = fly(moments=len(PHASES), seed=1)
    limit = malta.plant_of(robust().parameters).actuator.current_limit
    found = outcomes(e)
    assert list(found) == [kind.label for kind in KINDS]
    for label, rows in found.items():
        for row in rows:
            assert row.current <= OVER * limit, label
            bound = (
                FALL
                if label in OFF
                else PUSHED
                if label in PUSHING
                else max(MAX_LANDING_SPEED, 1.1 * row.speed_alone)
            )
            assert row.speed < bound, label
            assert row.speed < FALL, label
            assert math.isnan(row.safe) or row.safe < 0.27, label
    alone = np.array([row.speed_alone for rows in found.values() for row in rows])
    assert alone.max() > 0.1
