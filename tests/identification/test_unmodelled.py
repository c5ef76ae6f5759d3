"""What a log leaves as unmodelled dynamics: a sphere whose sensor reads a mode, in equations of its own."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from ball_bench import Sphere, fly
from conftest import Run
from hypothesis import given, settings, strategies as st

import malta
from malta.identification.data_file import read_identified, write_data
from malta.identification.unmodelled import margin_with_left
from malta.linear.compensators import compensator_of
from malta.linear.covering import covering_weight
from malta.margins.unmodelled import unmodelled_margin
from malta.proof.groups import loop_of, sensor_groups
from malta.proof.margin import NOT_BEGUN
from malta.work import count_work

if TYPE_CHECKING:
    from malta.identification import Identified
    from malta.synthesis.controller import Controller

KNOWN = {"m": (0.1, 1e-5), "s": (5e-3, 5e-7), "I_0": (1.5, 1e-4)}
WIDE = Sphere(share=0.05, zeta=0.3)
NARROW = Sphere(share=0.02, zeta=0.01)


@pytest.fixture(scope="module")
def law() -> Controller:
    spec = malta.read_design("examples/ball/design/ball.toml")
    return malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def found_of(law: Controller, sphere: Sphere, seed: int = 0) -> Identified:
    loop = malta.loop(malta.plant_of(law.parameters), law)
    plan = malta.excite(loop, motion=40e-6, period=0.5, periods=6, band=(4.0, 800.0), lines=24)
    log = fly(law, plan.signal, plan.duration, sphere, seed)
    return malta.identify(law, log, parameters=["C"], known=KNOWN, in_time=False)


@pytest.fixture(scope="module")
def wide(law: Controller) -> Identified:
    return found_of(law, WIDE)


def deviation(sphere: Sphere, found: Identified, w: Any) -> Any:
    """|Delta| of a sphere against the identified one, at its 95 % interval about one part in a thousand."""
    C = float(found.values[found.names.index("C")])
    G, own = (one.response(w, 2e-4) for one in (sphere, replace(sphere, C=C, share=0.0)))
    return np.abs(G / own - 1)


@pytest.mark.slow
def test_the_weight_lies_over_the_true_mode_and_the_proof_holds_the_true_loop(
    law: Controller, wide: Identified
) -> None:
    left = wide.unmodelled
    assert wide.refusal == ""
    assert left is not None
    assert left.between == ""
    W, true = left.weight(np.pi / law.sample_time), deviation(WIDE, wide, left.w)
    assert (W.poles().real < 0).all()
    assert (W.zeros().real < 0).all()
    assert (true <= left.bound).all()
    assert (left.bound <= np.abs(W(1j * left.w))).all()
    assert true.max() > 0.08  # the mode is told: the bound is not of noise alone
    assert (left.bound < 1.3 * true + 2e-3)[left.w > 2 * np.pi * 300].all()
    ranges = {"C": float(wide.total[0] / wide.values[0])}
    whole = margin_with_left(wide.plant, law, ranges, left, wide.joint)
    assert whole.covers
    assert WIDE.radius(law) < 1
    assert "4 to 800 Hz" in whole.assumed
    # A mode so large that the true loop is lost has to leave what is proven.
    shares = np.geomspace(0.1, 1e3, 200)
    lost = next(x for x in shares if replace(WIDE, share=-x).radius(law) >= 1)
    w = np.geomspace(1.0, np.pi / law.sample_time, 3000)
    reach = (deviation(replace(WIDE, share=-lost), wide, w) / np.abs(W(1j * w))).max()
    assert whole.margin.lower is not None
    assert reach > whole.margin.lower > 1
    much = margin_with_left(wide.plant, law, ranges, left._replace(bound=1e3 * left.bound), wide.joint)
    assert not much.covers
    assert much.verdict.startswith("dynamics that the log does not exclude make the loop unstable")


@pytest.mark.slow
def test_a_mode_between_the_lines_is_refused(law: Controller) -> None:
    found = found_of(law, NARROW)
    assert found.unmodelled is not None
    with pytest.raises(malta.CheckError, match="between 636 and 800 Hz what is left turns by more than 90"):
        margin_with_left(found.plant, law, {"C": 0.01}, found.unmodelled, 1.0)


@pytest.mark.slow
def test_a_data_file_keeps_the_bound_and_verify_proves_it(
    law: Controller, wide: Identified, tmp_path: Path, run: Run
) -> None:
    gains, data = tmp_path / "ball.json", tmp_path / "ball.toml"
    malta.gains.write(law, malta.verify(wide.plant, law), gains)
    write_data(wide, data, gains=str(gains), known=KNOWN)
    read, left = read_identified(data), wide.unmodelled
    assert left is not None
    assert read.unmodelled is not None
    for name in ("w", "bound", "sizes"):
        assert getattr(read.unmodelled, name) == pytest.approx(getattr(left, name), rel=1e-8)
    said = run("verify", gains, "--identified", data, "--json")
    assert said.code == 0, said.err
    part = json.loads(said.out)["robust"]["unmodelled"]
    assert part["covers"]
    assert part["lower"] > part["needed"] >= 1
    text = data.read_text()
    for old, new, field in (("bound = [", "bound = [-1, ", "bound"), ("sizes = [", "sizes = [0, ", "sizes")):
        data.write_text(text.replace(old, new))
        with pytest.raises(malta.InputError, match=f"identified.unmodelled.{field}"):
            read_identified(data)
    data.write_text(text.replace('between = ""', 'between = "between 5 and 6 Hz: a mode"'))
    said = run("verify", gains, "--identified", data)
    assert said.code == 1
    assert "between 5 and 6 Hz: a mode" in said.err


@pytest.mark.slow
@settings(max_examples=10, deadline=None)
@given(st.integers(0, 10_000))
def test_weights_are_stable_of_minimum_phase_and_over_their_bounds(seed: int) -> None:
    random = np.random.default_rng(seed)
    w = np.sort(10 ** random.uniform(0, 4, 12))
    bound = 10 ** random.uniform(-3, 0) * np.abs(1 + 1j * w / 10 ** random.uniform(0, 4))
    bound *= np.exp(0.3 * random.normal(size=12))
    W = covering_weight(w, bound)
    ratio = np.abs(W(1j * w)) / bound
    assert ratio.min() == pytest.approx(1, abs=1e-6)
    assert ratio.min() >= 1
    assert ratio.max() < 8
    assert all((roots.real < 0).all() for roots in (W.poles(), W.zeros()))
    assert len(W.num[0][0]) == len(W.den[0][0]) <= 5
    with pytest.raises(malta.InputError, match="sizes above 0"):
        covering_weight(w, 0 * bound)


@pytest.mark.slow
def test_a_full_block_is_as_harmful_as_that_around_the_worst_group() -> None:
    """Two loops side by side, and one that acts on the other: sensors part only without any coupling."""

    def loops(coupling: float) -> Any:
        return malta.uncertain(
            lambda k: ([[-1.0, 0.0], [coupling, -3.0]], [[k, 0.0], [0.0, 1.0]], np.eye(2)), {"k": 1.0}
        )

    F = np.diag([-2.0, -1.5])
    parted, joined = (loop_of(loops(x), compensator_of(F, 2, 2)) for x in (0.0, 0.5))
    assert sensor_groups(parted) == [(0,), (1,)]
    assert sensor_groups(joined) == [(0, 1)]
    full = malta.dynamic_margin(loops(0.0), F, {"k": 0.2}, malta.proof.Dynamic(0.3, channel=(0, 1)))
    alone = [
        malta.dynamic_margin(loops(0.0), F, {"k": 0.2}, malta.proof.Dynamic(0.3, channel=i)) for i in (0, 1)
    ]
    assert full.upper == pytest.approx(min(m.upper for m in alone), rel=1e-6)
    # A share of the weight is a smaller weight, alone and in a full block.
    lesser = malta.proof.Dynamic(0.3, channel=(0, 1), shares=(0.25, 1.0))
    small = malta.dynamic_margin(loops(0.0), F, {"k": 0.2}, lesser)
    of_one = malta.dynamic_margin(loops(0.0), F, {"k": 0.2}, malta.proof.Dynamic(0.075, channel=0))
    assert small.upper == pytest.approx(min(of_one.upper, alone[1].upper), rel=1e-6)
    assert small.lower is not None
    assert 0.99 * small.upper < small.lower <= small.upper
    for wrong in ((1.0,), (0.0, 1.0)):
        with pytest.raises(malta.InputError, match="2 numbers above 0"):
            malta.dynamic_margin(loops(0.0), F, {}, malta.proof.Dynamic(0.3, channel=(0, 1), shares=wrong))


def test_where_the_clock_leaves_nothing_nothing_is_proven(law: Controller) -> None:
    """`malta verify --identified DATA --time 20` whose margin took the time says so, and shows what it has."""
    plant, one = malta.plant_of(law.parameters), np.ones(1)
    with count_work(math.inf, 0.0):
        found = unmodelled_margin(plant, law, {"m": 0.1}, 0.02, one, one)
    assert (found.lower, found.reason) == (None, NOT_BEGUN.reason)


@pytest.mark.slow
def test_the_block_of_five_readings_of_malta_is_proven_group_by_group() -> None:
    controller = malta.gains.read("design/gains/robust.json")
    plant, sizes = malta.plant_of(controller.parameters), 2.0 ** np.array([-15, -15, -14, -15, -12])
    same, less = np.ones(5), np.array([0.25, 0.25, 0.25, 0.25, 1.0])
    all_alike, of_z = (
        unmodelled_margin(plant, controller, {"K_A": 0.01}, 0.02, sizes, s) for s in (same, less)
    )
    for found in (all_alike, of_z):
        assert found.lower is not None
        assert 5 < found.lower <= found.upper < 40
    # The radial loops are lost first where all may deviate alike, and z where they may by less.
    assert of_z.upper > all_alike.upper
    assert of_z.frequency is not None
    assert all_alike.frequency is not None
    assert of_z.frequency < 0.5 * all_alike.frequency
