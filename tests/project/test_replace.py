"""Designs and scenarios with other numbers, in one call."""

from __future__ import annotations

import math
from typing import Any

import pytest

import malta

BALL = "examples/ball/design/ball.toml"


def test_a_design_with_one_other_weight() -> None:
    """One number in one call: its square where the law has a variance, another hash, other gains."""
    spec = malta.read_design(BALL)
    quieter = spec.replace({"noise.sensor.y": 2e-6, "bases.input.f": 1.0}, name="quieter")
    assert quieter.weights.sensor_variance.tolist() == pytest.approx([4e-12])
    assert quieter.weights.r_base.tolist() == [1.0]
    assert quieter.weights.q_base.tolist() == spec.weights.q_base.tolist()
    assert (quieter.name, spec.name) == ("quieter", "ball")
    assert len({spec.sha256, quieter.sha256, spec.replace(delay=2).sha256, spec.replace(delay=3).sha256}) == 4
    model = malta.linearize(spec.plant, spec.plant.at())
    own, other = (malta.synthesize(one, model) for one in (spec, quieter))
    assert float(other.K[0, 0]) > 1.5 * float(own.K[0, 0])


@pytest.mark.parametrize(
    ("numbers", "fields", "words"),
    [
        ({"bases.state.nothing": 1.0}, {}, "one of bases.state: q q_dot"),
        ({"bases.nothing": 1.0}, {}, "an entry as bases.state.x"),
        ({"noise.drift.f": 1.0}, {}, "leaves out"),
        ({"bases.state.q": math.nan}, {}, "finite and above 0"),
        ({}, {"nothing": 1}, "a field that a design lacks"),
        ({}, {"sha256": "0"}, "a field that a design lacks"),
    ],
)
def test_what_a_design_cannot_be_is_a_sentence(numbers: Any, fields: Any, words: str) -> None:
    with pytest.raises(malta.InputError, match=words):
        malta.read_design(BALL).replace(numbers, **fields)


def test_weights_with_one_other_field() -> None:
    """Every digit counts in the hash of a design, not those that numpy prints."""
    spec = malta.read_design(BALL)
    base = spec.weights.q_base
    near = spec.weights.replace(q_base=base * (1 + 1e-12))
    assert near.q_base.tolist() != base.tolist()
    assert near.r_base.tolist() == spec.weights.r_base.tolist()
    assert len({spec.replace(law=law).sha256 for law in (spec.weights, near, near.replace())}) == 2
    for fields in ({"nothing": 1}, {"q_base": [math.nan, 1.0]}):
        with pytest.raises(malta.InputError, match=next(iter(fields))):
            spec.weights.replace(**fields)


def test_a_scenario_with_other_fields() -> None:
    stroke = malta.Scenario.stroke(10e-3)
    assert stroke.replace(noise=1.0, seed=3).duration == stroke.duration
    for fields in ({"nothing": 1}, {"noise": -1.0}, {"fidelity": "none"}):
        with pytest.raises(malta.InputError, match=next(iter(fields))):
            stroke.replace(**fields)
