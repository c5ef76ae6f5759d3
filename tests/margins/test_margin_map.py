"""The margin map: its points stand for all machines of the proof's box, so that a lost machine is unstable there."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.app.files import Edit, open_design
from malta.app.picture import map_document, poles_document, solve
from malta.cli.options import read_uncertainty
from malta.margins.margin_map import margin_map_of, plane_of
from malta.margins.travel import travel_margin
from malta.proof.margin import Margin

BALL = ROOT / "examples/ball/design/ball.toml"
BOX = {"m": 0.2, "C": 0.2, "s": 0.1}


def ball() -> tuple[Any, Any]:
    spec = malta.read_design(BALL)
    return spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def check(plant: Any, controller: Any, box: Mapping[str, float], margin: Margin) -> None:
    """In every plane nothing inside the proven box is unstable, and the machine that is lost is."""
    assert margin.lower
    for names in itertools.combinations(box, 2):
        found = margin_map_of(plant, controller, names, box, margin=margin)
        X, Y = np.meshgrid(found.x_values, found.y_values)
        off = [np.abs(V - m) / h for V, m, h in zip((X, Y), found.nominal, found.half, strict=True)]
        assert found.growth[np.maximum(*off) <= margin.lower * (1 - 1e-9)].max() < 0, names
        assert found.beside == tuple(name for name in box if name not in names)
        plane = plane_of(plant, controller, names, box)
        if found.witness is not None:
            lost = plane.worst(*found.witness)
            assert lost.growth >= 0, names
            assert lost.poles.real.max() > -1e-3
            for name in names:
                assert lost.values[name] == pytest.approx(margin.witness[name])  # type: ignore[index]
        else:  # others alone reach it: no value of x and y goes as far
            assert margin.witness is not None
            at = [
                abs(margin.witness[n] - m) / h
                for n, m, h in zip(names, found.nominal, found.half, strict=True)
            ]
            assert max(at) < margin.upper * (1 - 1e-6)
        share = 0.99 * margin.lower
        inside = [m + share * h for m, h in zip(found.nominal, found.half, strict=True)]
        assert plane.worst(*inside).growth < 0


def test_a_lost_machine_is_unstable_in_every_plane() -> None:
    plant, controller = ball()
    check(plant, controller, BOX, travel_margin(plant, controller, BOX))


@pytest.mark.slow
@pytest.mark.parametrize("design", ["robust", "tubular_pid", "halbach_late"])
def test_a_lost_machine_of_a_shipped_design_is_unstable_in_every_plane(design: str) -> None:
    path = ROOT / f"design/gains/{design}.json"
    controller = malta.gains.read(path)
    plant = malta.plant_of(controller.parameters)
    box = read_uncertainty(path, None, plant.parameters)
    check(plant, controller, box, travel_margin(plant, controller, box))


@pytest.mark.slow
@pytest.mark.parametrize("design", ["robust", "tubular_pid", "halbach_pid"])
def test_a_click_on_the_cross_of_the_live_page_is_unstable(design: str) -> None:
    """The page draws the witness of its proof, and asks for the poles where it is clicked: both are of one box."""
    problem = solve(open_design(ROOT / f"design/{design}.toml").apply(Edit()))
    box = problem.spec.uncertainty
    margin = travel_margin(problem.plant, problem.controller, box)
    assert margin.witness is not None
    names = max(
        itertools.combinations(box, 2), key=lambda two: sum(margin.sensitivity.get(name, 0) for name in two)
    )
    drawn = map_document(problem, names, margin.upper)
    assert drawn["beside"].endswith("anywhere in the box")
    at = {name: margin.witness[name] for name in names}
    there = poles_document(problem, at)
    assert not there["stable"]
    assert set(there["beside"]) == set(box) - set(names)
    middle = poles_document(problem, dict(zip(names, drawn["nominal"], strict=True)))
    assert middle["stable"]


def test_the_other_parameters_are_named() -> None:
    plant, controller = ball()
    nominal = margin_map_of(plant, controller, ("m", "C"), BOX, others="nominal")
    whole = margin_map_of(plant, controller, ("m", "C"), BOX)
    assert nominal.beside_text == "s nominal"
    assert whole.beside_text == "s anywhere in the box"
    assert nominal.proven >= whole.proven  # of fewer machines
    for found in (nominal, whole):
        known = travel_margin(plant, controller, BOX if found is whole else {"m": 0.2, "C": 0.2})
        titles = "\n".join(text.get_text() for text in malta.report.margin_map(found).texts)
        assert found.beside_text in titles
        assert f"proven {known.proven.percent()} of the box" in titles
    with pytest.raises(malta.InputError, match="--others: found 'no', expected box or nominal"):
        margin_map_of(plant, controller, ("m", "C"), BOX, others="no")  # type: ignore[arg-type]
