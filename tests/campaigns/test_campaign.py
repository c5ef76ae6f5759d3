"""Campaigns: what is drawn, what is kept and found again, and that every run is the one that `simulate` makes of it."""

from __future__ import annotations

import json
import math
import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from conftest import assert_folds, printed, refusal
from flight import CASES, EXPERIMENTS
from hypothesis import given, settings, strategies as st

import malta
from malta import campaign as function, report
from malta.campaigns.plan import SAMPLERS, Plan, box_of, draw_machines, planned_run
from malta.campaigns.result import Campaign, figures_of, rate, runs_within_bounds
from malta.campaigns.run import SLOW_BLOCK, campaign, replay
from malta.campaigns.store import MANIFEST, block_name, read_plan
from malta.campaigns.summary import worst_of
from malta.report import figures
from malta.simulation.engine import compiled
from malta.simulation.engine.digest import Batch, verdicts
from malta.simulation.engine.engines import engine_of, library_of
from malta.simulation.experiments.catalogue import cases_of
from malta.writing import temporary_name

if TYPE_CHECKING:
    from conftest import Design

    from malta.synthesis.controller import Controller

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]
MODULE: Any = sys.modules["malta.campaigns.run"]
BOX = {"m": 0.2, "K_A": 0.2, "K_D": 0.2, "K_B": 0.2}
SHORT: dict[str, Any] = {"fidelity": "force", "duration": 0.02, "rise": 3e-3}
SIZES = (8, 24, 1024)  # runs in a block


@pytest.fixture(scope="module")
def controller(designs: dict[str, Design]) -> Controller:
    return designs["calibrated"].controller


@pytest.fixture(scope="module")
def shaky(designs: dict[str, Design]) -> Controller:
    return designs["table2"].controller


def _plan(controller: Controller, samples: int = 40, **changed: Any) -> Plan:
    wanted: dict[str, Any] = {
        "spread": BOX,
        "sensor_spread": {"gain_x1": 0.02, "offset_y2": 5e-6},
        "samples": samples,
        "options": SHORT,
    }
    return Plan(controller, **wanted | changed)


def _same(one: Campaign, other: Campaign, tolerance: float = 0.0) -> None:
    assert np.array_equal(one.index, other.index)
    assert np.array_equal(one.values, other.values)
    for name in Batch.__dataclass_fields__:
        a, b = getattr(one.batch, name), getattr(other.batch, name)
        size = np.abs(b[np.isfinite(b)]).max(initial=0)
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * size, err_msg=name)


def _files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


# --- what is drawn ---


def test_the_name_is_the_function() -> None:
    assert function is campaign is malta.campaign
    assert malta.campaigns.Plan is Plan


@pytest.mark.slow
@settings(max_examples=30, deadline=None)
@given(
    shares=st.dictionaries(st.sampled_from(["m", "K_A", "K_B", "R", "l_S"]), st.floats(0, 0.99), min_size=1),
    samples=st.integers(1, 70),
    seed=st.integers(0, 2**40),
    sampler=st.sampled_from(SAMPLERS),
)
def test_machines_lie_in_the_box(
    controller: Controller, shares: dict[str, float], samples: int, seed: int, sampler: Any
) -> None:
    """Within it on every axis; the same plan draws the same, however its box is written down."""
    plan = Plan(controller, "hold", shares, {}, samples, seed, sampler)
    found = draw_machines(plan)
    assert found.values.shape == (samples, len(shares))
    for name, share in shares.items():
        middle = getattr(controller.parameters, name)
        assert (np.abs(found.changes[name] / middle - 1) <= share + 1e-12).all()
    again = replace(plan, spread=dict(reversed(shares.items())))
    assert again.identity == plan.identity
    assert np.array_equal(draw_machines(again).values, found.values)


@pytest.mark.slow
def test_a_latin_hypercube_has_one_machine_in_each_row_and_column(controller: Controller) -> None:
    plan = _plan(controller, 100)
    found = draw_machines(plan)
    assert found.names == ("m", "K_A", "K_B", "K_D", "gain_x1", "offset_y2")
    middle = [getattr(controller.parameters, name) for name in found.names[:4]] + [0, 0]
    half = [0.2 * m for m in middle[:4]] + [0.02, 5e-6]
    place = ((found.values - middle) / half + 1) / 2
    for column in place.T:
        assert sorted((100 * column).astype(int).tolist()) == list(range(100))


def test_a_sobol_sequence_is_balanced_and_its_beginning_is_kept(controller: Controller) -> None:
    """64 points: as many in each quarter of each plane; 50 are the first 50 of 64."""
    plan = _plan(controller, 64, sampler="sobol")
    high = draw_machines(plan).values > np.median(draw_machines(plan).values, axis=0)
    for i in range(high.shape[1]):
        for j in range(i):
            assert (high[:, i] & high[:, j]).sum() == 16
    assert np.array_equal(
        draw_machines(_plan(controller, 50, sampler="sobol")).values, draw_machines(plan).values[:50]
    )
    assert draw_machines(_plan(controller, 1, sampler="sobol")).values.shape == (1, 6)


def test_seeds_and_samplers_draw_other_machines(controller: Controller) -> None:
    plans = [_plan(controller), _plan(controller, seed=1), _plan(controller, sampler="sobol")]
    assert len({plan.identity for plan in plans}) == 3
    assert len({float(draw_machines(plan).values[0, 0]) for plan in plans}) == 3


@pytest.mark.parametrize("named", [("I_xx",), ("I_yy",), ("I_xx", "I_yy")])
def test_twins_move_together(controller: Controller, named: tuple[str, ...]) -> None:
    plan = _plan(controller, 8, spread=dict.fromkeys(named, 0.1), sensor_spread={})
    found = draw_machines(plan)
    assert len(found.names) == 1
    assert np.array_equal(found.changes["I_xx"], found.changes["I_yy"])
    assert np.ptp(found.changes["I_xx"]) > 1e-4
    assert campaign(plan).completed.all()


def test_the_box_of_a_gain_file_is_its_own(published: dict[str, Any], tmp_path: Path) -> None:
    assert box_of("design/gains/calibrated.json") == BOX
    content = json.loads(Path("design/gains/calibrated.json").read_text(encoding="utf-8"))
    content["verification"]["robust"] = None
    plain = tmp_path / "plain.json"
    plain.write_text(json.dumps(content), encoding="utf-8")
    assert box_of(plain, published) == BOX
    assert "--spread NAME=10%" in str(refusal(lambda: box_of(plain), plain))


def test_whole_numbers_and_a_journey_change_no_plan(controller: Controller) -> None:
    """noise 1 or 1.0, pickled or not: the same identity; another option, gain or machine: another one."""
    plan = _plan(controller, options=SHORT | {"noise": 1})
    assert plan.identity == _plan(controller).identity
    assert pickle.loads(pickle.dumps(plan)).identity == plan.identity
    others = [
        _plan(controller, options=SHORT | {"noise": 2.0}),
        _plan(controller, parameters=replace(controller.parameters, m=0.5)),
        _plan(replace(controller, K=controller.K * (1 + 1e-15))),
        _plan(controller, 41),
        _plan(controller, spread=BOX | {"m": 0.21}),
    ]
    assert len({plan.identity, *(other.identity for other in others)}) == 6


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no such parameter": (
        {"spread": {"mass": 0.1}},
        "spread mass: found an unknown parameter, expected one of m",
    ),
    "a negative share": (
        {"spread": {"m": -0.1}},
        "spread m: found -10 %, expected from 0 % to less than 100 %",
    ),
    "all of it": ({"spread": {"m": 1.0}}, "spread m: found 100 %"),
    "NaN": ({"spread": {"m": math.nan}}, "spread m: found nan %"),
    "a delay": ({"spread": {"T_d": 0.1}}, "spread T_d: found another one for each run"),
    "of nothing": ({"spread": {"phi_c": 0.1}}, "spread phi_c: found phi_c = 0"),
    "twins apart": ({"spread": {"I_xx": 0.1, "I_yy": 0.2}}, "spread I_yy: found another one than I_xx's"),
    "no spread": ({"spread": {}, "sensor_spread": {}}, "spread: found nothing"),
    "no such sensor error": (
        {"sensor_spread": {"gain_q": 0.1}},
        "sensor gain_q: found an unknown sensor error",
    ),
    "a negative sensor error": ({"sensor_spread": {"gain_x1": -1.0}}, "sensor gain_x1: found -1"),
    "an endless sensor error": ({"sensor_spread": {"gain_x1": math.inf}}, "sensor gain_x1: found inf"),
    "no samples": ({"samples": 0}, "samples: found 0"),
    "half a sample": ({"samples": 1.5}, "samples: found 1.5"),
    "too many": ({"samples": 10**10}, "samples: found 10000000000, expected at most 1000000000"),
    "a negative seed": ({"seed": -1}, "seed: found -1"),
    "a sampler": ({"sampler": "dice"}, "sampler: found 'dice', expected one of latin-hypercube, sobol"),
    "a scenario": ({"scenario": "loop"}, "scenario: found 'loop', expected one of stroke"),
    "a case": (
        {"scenario": "tilt", "case": "x", "options": {}},
        "tilt: case: found 'x', expected one of feedforward",
    ),
    "an estimator": (
        {"scenario": "hold", "options": {"estimator": "kalman"}},
        "estimator: found 'kalman', expected steady-state",
    ),
    "an option": ({"options": {"speed": 1}}, "speed: found an unknown option"),
    "an option of its own": ({"options": {"seed": 1}}, "options: seed: found 1, expected none"),
    "a negative noise": ({"options": {"noise": -1.0}}, "noise: found -1.0"),
}


@pytest.mark.parametrize(("changed", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_plan_is_refused_in_a_sentence(
    controller: Controller, changed: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(malta.InputError) as caught:
        _plan(controller, **changed)
    assert sentence in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.slow_for("hold", "lift-off", "disturbance", "drive-limits", "carrier")
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_scenario_is_flown_or_refused(controller: Controller, name: str) -> None:
    """Those of CASES complete, and a run of each comes back with the digest of the block; others are refused."""
    options = {"fidelity": "force"} | ({"frequency": 20.0} if name == "tilt" else {})
    if name not in CASES:
        with pytest.raises(malta.InputError, match="which changes the machine or the reference in flight"):
            Plan(controller, name, BOX, options=options)
        return
    plan = Plan(controller, name, BOX, {"gain_x1": 0.01}, samples=8, options=options)
    found = campaign(plan)
    assert found.completed.all()
    single = replay(plan, 5)
    _assert_replayed(found, 5, single)
    assert single.question.startswith(name)


@pytest.mark.slow_for("lift-off", "disturbance", "carrier")
@pytest.mark.parametrize("name", CASES)
def test_cases_are_those_that_the_experiment_flies(designs: dict[str, Design], name: str) -> None:
    design = designs["calibrated"]
    options: dict[str, Any] = {"fidelity": "force", "duration": 1e-3}
    wanted = cases_of(name, design.plant, design.controller, **options)
    flown = malta.experiment(name, design.plant, design.controller, **options)
    labels = [case.label for case in wanted]
    assert labels[: len(flown.cases)] == [
        case.label for case in flown.cases
    ]  # tones become points of a curve
    for case, of_experiment in zip(wanted, flown.cases, strict=False):
        one, other = case.scenario, of_experiment.run.scenario
        for field in ("name", "duration", "noise", "quantize", "estimator", "feedforward", "cold", "bearing"):
            assert getattr(one, field) == getattr(other, field)
        assert dict(one.start) == dict(other.start)


def test_a_case_is_chosen_by_its_label(controller: Controller) -> None:
    first = Plan(controller, "tilt", BOX)
    other = Plan(controller, "tilt", BOX, case="feedforward attraction")
    assert planned_run(first).scenario.feedforward == "axial"
    assert planned_run(other).scenario.feedforward == "attraction"
    assert (
        first.identity == Plan(controller, "tilt", BOX, case="feedforward axial").identity != other.identity
    )


# --- runs ---


def _assert_replayed(found: Campaign, row: int, single: malta.simulation.Experiment) -> None:
    """To the bit; the mean of squares is summed in another order."""
    run, batch = single.run, found.batch
    error = run.p - run.reference
    assert run.engine == ("virtual machine" if compiled.compiler() is None else "compiled")
    assert run.verdict.name == verdicts(run.plant)[int(batch.verdict[row])]
    assert run.verdict.time == batch.duration[row]
    for name, wanted in {
        "deviation": np.abs(error).max(axis=0),
        "force": np.abs(run.v).max(axis=0),
        "contact": run.contact.max(axis=0),
        "saturated": run.saturated.mean(axis=0),
    }.items():
        assert np.array_equal(getattr(batch, name)[row], wanted), name
    np.testing.assert_allclose(batch.rms[row], np.sqrt((error**2).mean(axis=0)), rtol=1e-12, atol=1e-20)


@pytest.mark.slow
def test_runs_do_not_depend_on_blocks_workers_or_company(controller: Controller, tmp_path: Path) -> None:
    """To the bit: blocks of 8, of 24 and of all, on one thread and on three, kept or not, and the blocks' bytes too."""
    plan = _plan(controller, 60)
    first = campaign(plan)
    assert first.index.tolist() == list(range(60))
    for size in SIZES:
        for workers in (1, 3):
            _same(first, campaign(plan, tmp_path / f"{size}_{workers}", block=size, workers=workers))
        assert _files(tmp_path / f"{size}_1") == _files(tmp_path / f"{size}_3")
    longer = campaign(_plan(controller, 60, options=SHORT | {"noise": 0.0}))
    assert not np.array_equal(first.batch.rms, longer.batch.rms)


def test_without_spread_and_noise_all_are_the_nominal_machine(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    plan = _plan(design.controller, 16, spread={"m": 0.0}, sensor_spread={}, options=SHORT | {"noise": 0.0})
    found = campaign(plan)
    assert (np.ptp(found.batch.deviation, axis=0) == 0).all()
    alone = malta.simulate(design.plant, design.controller, planned_run(plan).scenario)
    wanted = np.abs(alone.p - alone.reference).max(axis=0)
    np.testing.assert_allclose(found.batch.deviation[7], wanted, rtol=0, atol=1e-15)


@pytest.mark.slow
def test_runs_that_touch_down_are_replayed_to_the_sample(shaky: Controller) -> None:
    """`table2` on machines up to 60 % off: every way to end, each as the single run ends; noise and sensors too."""
    plan = Plan(shaky, "stroke", dict.fromkeys(BOX, 0.6), {"offset_y2": 5e-6}, samples=64)
    found = campaign(plan)
    assert 5 < found.rate.passed < 59
    assert sum(found.ends.values()) == 64
    names = np.array(verdicts(plan.plant))[found.batch.verdict.astype(int)]
    for end in found.ends:
        row = int(np.flatnonzero(names == end)[-1])
        single = replay(plan, row)
        _assert_replayed(found, row, single)
        assert single.run.scenario.run == row
        assert single.run.scenario.sensor_errors == {"offset_y2": found.values[row, -1]}
        flown: Any = single.run.plant.parameters
        assert flown.m == found.values[row, 0]
    assert len(found.ends) >= 3
    with pytest.raises(malta.InputError, match="run: found 64, expected 0 to 63"):
        replay(plan, 64)
    with pytest.raises(malta.InputError, match="engine: found 'steam', expected one of auto"):
        replay(plan, 0, engine=cast("Any", "steam"))


@pytest.mark.slow
def test_sensors_in_steps_are_replayed_to_the_bit(controller: Controller) -> None:
    """A last digit may move a reading by a whole step, and that the mover by nanometres: not in a replay, and only
    there. The virtual machine, by itself, agrees to a step."""
    plan = _plan(controller, 11, options=SHORT | {"quantize": True, "duration": 0.1, "rise": 16e-3})
    found, told = campaign(plan), list[float]()
    for row in (0, 7, 8, 10):
        _assert_replayed(found, row, replay(plan, row, progress=told.append))
    assert told == sorted(told[: len(told) // 4]) * 4
    alone = replay(plan, 10, engine="virtual machine").run
    assert alone.engine == "virtual machine"
    np.testing.assert_allclose(
        found.batch.deviation[10], np.abs(alone.p - alone.reference).max(axis=0), rtol=0, atol=1e-6
    )


def test_an_odd_number_of_samples_is_recorded_whole(controller: Controller) -> None:
    plan = _plan(controller, 3, options=SHORT | {"duration": 401 * 50e-6})
    single = replay(plan, 2)
    assert len(single.run.t) == 401
    _assert_replayed(campaign(plan), 2, single)
    own = malta.simulate(single.run.plant, controller, single.run.scenario)
    for name in ("x", "y", "v", "xi_hat", "force"):
        size = np.abs(getattr(own, name)).max(axis=0)
        np.testing.assert_allclose(
            getattr(single.run, name), getattr(own, name), rtol=0, atol=1e-10 * size.max()
        )


@pytest.mark.slow
def test_a_wider_box_has_a_lower_yield(shaky: Controller) -> None:
    shares = []
    for share in (0.05, 0.3, 0.6):
        plan = Plan(shaky, "stroke", dict.fromkeys(BOX, share), samples=96, options={"fidelity": "force"})
        shares.append(campaign(plan).rate.share)
    assert shares[0] == 1
    assert shares[0] > shares[1] > shares[2] > 0


# --- what was found ---


@pytest.mark.slow
def test_the_interval_is_clopper_and_pearsons() -> None:
    """Closed forms at the ends; coverage of a share of 0.9 in 100 runs by summing the binomial."""
    assert rate(10_000, 10_000).low == pytest.approx(0.025 ** (1 / 10_000), abs=1e-12)
    assert rate(10_000, 10_000).high == 1
    assert rate(0, 20).high == pytest.approx(1 - 0.025 ** (1 / 20), abs=1e-12)
    covered = 0.0
    for k in range(101):
        found = rate(k, 100)
        if found.low <= 0.9 <= found.high:
            covered += math.comb(100, k) * 0.9**k * 0.1 ** (100 - k)
    assert 0.95 <= covered < 0.99
    assert math.isnan(rate(0, 0).share)


@pytest.mark.slow
def test_figures_count_completed_runs_and_bounds_of_the_published_stroke(
    shaky: Controller, published: dict[str, Any]
) -> None:
    plan = Plan(shaky, "stroke", dict.fromkeys(BOX, 0.6), samples=64)
    found = campaign(plan)
    listed = {figure.label: figure for figure in figures_of(found, published)}
    assert listed["deviation y1"].merit.bound == pytest.approx(20e-6)
    assert listed["rise, 10-90 %"].merit.relation == "about"
    for figure in listed.values():
        assert np.isnan(figure.values[~found.completed]).all()
    within = runs_within_bounds(found, published)
    assert within is not None
    for row in range(64):
        limits = [(f, f.merit.bound) for f in listed.values() if f.merit.relation == "at most"]
        assert within[row] == all(f.values[row] <= bound for f, bound in limits if bound is not None)
    assert runs_within_bounds(found) is None
    other = campaign(Plan(shaky, "stroke", {"m": 0.0}, samples=8, options={"distance": 2e-3}))
    assert runs_within_bounds(other, published) is None
    worst = worst_of(found, 64)
    ended = [row for row in worst if not found.completed[row]]
    assert worst[: len(ended)] == ended
    assert np.diff(found.batch.duration[ended]).min() >= 0


def test_worst_of_those_that_completed_are_closest_to_a_touch(controller: Controller) -> None:
    found = campaign(_plan(controller, 64, sensor_spread={}))
    worst = worst_of(found, 1)[0]
    assert found.batch.contact[worst, :2].max() == found.batch.contact[:, :2].max()
    assert worst_of(found, 0) == []


# --- the folder ---


def test_what_is_done_is_read(
    controller: Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, told = _plan(controller), list[float]()
    first = campaign(plan, tmp_path, block=16, progress=told.append)
    assert sorted(told) == told
    assert told[-1] == 1
    before = _files(tmp_path)
    assert set(before) == {MANIFEST, *(block_name(k) for k in (0, 16, 32))}
    monkeypatch.setattr(MODULE, "fly", None)
    again = campaign(plan, tmp_path)  # with the blocks that the folder has
    _same(first, again)
    assert again.folder == tmp_path
    assert not again.damaged
    assert _files(tmp_path) == before
    assert read_plan(tmp_path, controller).identity == plan.identity


def test_an_interruption_keeps_what_is_done(
    controller: Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C in the second block; then the rest."""
    plan = _plan(controller)
    fly = MODULE.fly

    def interrupted(plan: Plan, first: int, *arguments: Any) -> Any:
        if first == 16:
            raise KeyboardInterrupt
        return fly(plan, first, *arguments)

    with monkeypatch.context() as patch:
        patch.setattr(MODULE, "fly", interrupted)
        cut = campaign(plan, tmp_path, block=16)
    assert cut.interrupted
    assert cut.index.tolist() == list(range(16))
    assert cut.rate.runs == 16
    whole = campaign(plan, tmp_path)
    assert not whole.interrupted
    _same(whole, campaign(plan))


def test_an_interruption_that_a_library_drops_is_noticed(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while something is called that swallows it: the campaign ends with that block, here and in a thread."""
    plan, fly, before = _plan(controller), MODULE.fly, signal.getsignal(signal.SIGINT)

    def deaf(*arguments: Any) -> Any:
        with suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1)
        return fly(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(MODULE, "fly", deaf)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            cut = campaign(plan, block=16)
        finally:
            signal.signal(signal.SIGINT, before)
    assert cut.interrupted
    assert cut.index.tolist() == list(range(16))
    with ThreadPoolExecutor(1) as pool:  # where no signal may be handled
        assert not pool.submit(campaign, plan).result().interrupted


def test_an_interruption_before_anything_is_done(
    controller: Controller, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(MODULE, "fly", interrupted)
    found = campaign(_plan(controller))
    assert found.interrupted
    assert len(found.index) == 0
    assert found.batch.deviation.shape == (0, 5)
    assert math.isnan(found.rate.share)
    assert worst_of(found, 3) == []


def _cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def _flipped(data: bytes) -> bytes:
    at = data.index(b"deviation.npy") + 200
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize("damage", [_cut, _flipped, lambda _: b"", lambda _: b"not a block"])
def test_a_damaged_block_is_named_and_flown_again(
    controller: Controller, tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    plan = _plan(controller)
    first = campaign(plan, tmp_path, block=16)
    before, path = _files(tmp_path), tmp_path / block_name(16)
    path.write_bytes(damage(before[path.name]))
    again = campaign(plan, tmp_path)
    assert again.damaged == (path,)
    _same(first, again)
    assert _files(tmp_path) == before


def test_blocks_in_each_others_place_are_flown_again(controller: Controller, tmp_path: Path) -> None:
    """Whole, and of this campaign, but of other runs."""
    plan = _plan(controller)
    campaign(plan, tmp_path, block=16)
    before = _files(tmp_path)
    (tmp_path / block_name(0)).write_bytes(before[block_name(16)])
    assert campaign(plan, tmp_path).damaged == (tmp_path / block_name(0),)
    assert _files(tmp_path) == before


def test_a_block_of_another_campaign_is_refused(controller: Controller, tmp_path: Path) -> None:
    plan, other = _plan(controller), _plan(controller, seed=1)
    campaign(plan, tmp_path / "one", block=16)
    campaign(other, tmp_path / "two", block=16)
    path = tmp_path / "one" / block_name(16)
    foreign = (tmp_path / "two" / block_name(16)).read_bytes()
    path.write_bytes(foreign)
    assert "a block of another campaign" in str(refusal(lambda: campaign(plan, tmp_path / "one"), path))
    assert path.read_bytes() == foreign


@pytest.mark.parametrize(
    ("changed", "key"),
    [
        ({"samples": 41}, "samples: found 40"),
        ({"seed": 3}, "seed: found 0"),
        ({"spread": BOX | {"m": 0.1}}, "spread.m: found 0.2"),
        ({"spread": {"m": 0.2}}, "spread.K_A: found 0.2"),
        ({"options": SHORT | {"noise": 2.0}}, "scenario.options.noise: found 1"),
        ({"sampler": "sobol"}, "sampler: found latin-hypercube"),
        ({"sensor_spread": {}}, "sensor_spread.gain_x1: found 0.02"),
    ],
)
def test_a_folder_of_another_campaign_is_refused(
    controller: Controller, tmp_path: Path, changed: dict[str, Any], key: str
) -> None:
    campaign(_plan(controller), tmp_path)
    before, path = _files(tmp_path), tmp_path / MANIFEST
    error = refusal(lambda: campaign(_plan(controller, **changed), tmp_path), path)
    assert f"{key}: another campaign" in str(error)
    assert _files(tmp_path) == before


def test_a_campaign_of_another_controller_is_refused(
    controller: Controller, shaky: Controller, tmp_path: Path
) -> None:
    campaign(_plan(controller), tmp_path)
    path = tmp_path / MANIFEST
    assert "gains.name" in str(refusal(lambda: campaign(_plan(shaky), tmp_path), path))
    assert "a campaign of calibrated" in str(refusal(lambda: read_plan(tmp_path, shaky), path))


MANIFESTS: dict[str, Callable[[dict[str, Any]], Any]] = {
    "a list": lambda _: [1, 2],
    "a number": lambda _: 3,
    "nothing": lambda _: {},
    "another schema": lambda m: m | {"schema": "malta-gains"},
    "another version": lambda m: m | {"version": 2},
    "no block size": lambda m: {k: v for k, v in m.items() if k != "block"},
    "an odd block size": lambda m: m | {"block": 12},
    "a block size in words": lambda m: m | {"block": "many"},
    "no scenario": lambda m: {k: v for k, v in m.items() if k != "scenario"},
    "a scenario in words": lambda m: m | {"scenario": "stroke"},
    "another version of malta": lambda m: m | {"malta": "9"},
    "another machine": lambda m: m | {"machine": m["machine"] | {"name": "other"}},
    "a mass in words": lambda m: m | {"machine": m["machine"] | {"parameters": {"m": "heavy"}}},
    "a parameter that is none": lambda m: m | {"machine": m["machine"] | {"parameters": {"mass": 1.0}}},
    "a spread of all": lambda m: m | {"spread": {"m": 2.0}},
    "a spread of words": lambda m: m | {"spread": {"m": "wide"}},
    "spreads in a list": lambda m: m | {"spread": [1, 2]},
}


@pytest.mark.parametrize("edit", MANIFESTS.values(), ids=MANIFESTS)
def test_a_manifest_that_is_none_is_refused(
    controller: Controller, tmp_path: Path, edit: Callable[[dict[str, Any]], Any]
) -> None:
    plan = _plan(controller, 8)
    campaign(plan, tmp_path)
    path = tmp_path / MANIFEST
    path.write_text(json.dumps(edit(json.loads(path.read_text(encoding="utf-8")))), encoding="utf-8")
    refusal(lambda: read_plan(tmp_path, controller), path)
    refusal(lambda: campaign(plan, tmp_path), path)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_a_manifest_that_is_no_json_is_refused(
    controller: Controller, tmp_path: Path, content: bytes
) -> None:
    path = tmp_path / MANIFEST
    path.write_bytes(content)
    refusal(lambda: campaign(_plan(controller, 8), tmp_path), path)
    assert path.read_bytes() == content


def test_blocks_without_a_manifest_are_refused(controller: Controller, tmp_path: Path) -> None:
    plan = _plan(controller, 8)
    campaign(plan, tmp_path)
    (tmp_path / MANIFEST).unlink()
    assert "runs_00000000.npz without campaign.json" in str(
        refusal(lambda: campaign(plan, tmp_path), tmp_path)
    )
    with pytest.raises(malta.InputError, match="no such file, expected a campaign's manifest"):
        read_plan(tmp_path, plan.controller)


def test_a_folder_that_is_none_is_refused(controller: Controller, tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine", encoding="utf-8")
    for place in (file, file / "below", Path("/proc/nowhere")):
        with pytest.raises(malta.InputError) as caught:
            campaign(_plan(controller, 8), place)
        assert str(place) in str(caught.value)
    assert file.read_text(encoding="utf-8") == "mine"


def test_a_folder_that_may_not_be_looked_into_is_refused(
    controller: Controller, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbidden(*_: Any) -> bool:
        raise PermissionError(13, "Permission denied")

    plan = _plan(controller, 8)
    monkeypatch.setattr(Path, "exists", forbidden)
    with pytest.raises(
        malta.InputError, match="found Permission denied, expected a folder to keep a campaign in"
    ):
        campaign(plan, tmp_path)


def test_what_a_killed_process_left_is_no_obstacle(controller: Controller, tmp_path: Path) -> None:
    """Half a block under a temporary name, by a process that had the same number: as in a container, started anew."""
    stale = temporary_name(tmp_path / block_name(0))
    stale.write_bytes(b"half")
    assert campaign(_plan(controller, 8), tmp_path).completed.all()
    assert not stale.exists()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"workers": 0}, "workers: found 0, expected at least 1"),
        ({"block": 12}, "block: found 12 runs, expected a multiple of 8"),
        ({"block": -8}, "block: found -8 runs"),
        ({"workers": 2, "cluster": "tcp://127.0.0.1:1"}, "workers: found 2, expected none with a cluster"),
    ],
)
def test_arguments_that_are_none_are_refused(
    controller: Controller, arguments: dict[str, Any], sentence: str
) -> None:
    with pytest.raises(malta.InputError) as caught:
        campaign(_plan(controller, 8), **arguments)
    assert sentence in str(caught.value)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As on a system without one."""
    monkeypatch.setattr(compiled, "compiler", lambda: None)
    remembered = (library_of, engine_of)
    for memory in remembered:
        memory.cache_clear()
    yield
    for memory in remembered:
        memory.cache_clear()


@pytest.mark.slow
def test_without_a_compiler_the_campaign_is_the_same(
    controller: Controller, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    plan = _plan(controller, 3, options=SHORT | {"duration": 0.01})
    compiled = campaign(plan)
    assert compiled.engines == ("compiled",)
    request.getfixturevalue("no_compiler")
    plain = campaign(plan, tmp_path)
    assert plain.engines == ("virtual machine",)
    _same(compiled, plain, tolerance=1e-12)
    assert json.loads((tmp_path / MANIFEST).read_text(encoding="utf-8"))["block"] == SLOW_BLOCK
    single = replay(plan, 2).run
    assert single.engine == "virtual machine"
    assert np.array_equal(plain.batch.deviation[2], np.abs(single.p - single.reference).max(axis=0))


# --- figures and tables ---


def _texts(figure: Any) -> list[str]:
    import matplotlib.text

    return [text.get_text() for text in figure.findobj(matplotlib.text.Text)]


@pytest.mark.slow
def test_figures_have_units_and_published_bounds(shaky: Controller, published: dict[str, Any]) -> None:
    plan = Plan(shaky, "stroke", dict.fromkeys(BOX, 0.6), {"offset_y2": 5e-6}, samples=64)
    found = campaign(plan)
    texts = _texts(figures.distributions_figure(found, published))
    for text in (
        "rise, 10-90 % [ms]",
        "overshoot [%]",
        "deviation [µm]",
        "largest thrust [N]",
        "share of runs [%]",
    ):
        assert text in texts
    assert texts.count("published bound") == 3
    assert texts.count("published") == 1
    assert "published bound" not in _texts(figures.distributions_figure(found))
    shown = figures.yield_figure(found, published)
    texts = _texts(shown)
    for text in ("m [kg]", "K_A [N/m]", "offset_y2 [µm]", "touchdown at sensor plane 1"):
        assert text in texts
    for axes in shown.axes[:5]:  # shares of every bin make up all of its runs
        tops = [patch.get_y() + patch.get_height() for patch in axes.patches]  # type: ignore[attr-defined]
        assert max(tops) == pytest.approx(100)
    texts = _texts(figures.worst_figure(found, published))
    assert "largest radial deviation [µm]" in texts
    assert any(text.startswith(f"run {found.index[worst_of(found, 1)[0]]}\n") for text in texts)


@pytest.mark.slow
def test_figures_and_tables_of_little_are_drawn(
    shaky: Controller, published: dict[str, Any], tmp_path: Path
) -> None:
    """One run; none that completes; nothing that varies."""
    for plan in (
        Plan(shaky, "hold", {"m": 0.0}, samples=1, options={"duration": 1e-3}),
        Plan(shaky, "stroke", {"K_A": 0.01}, samples=8, parameters=replace(shaky.parameters, K_A=3e4)),
        Plan(shaky, "hold", {"m": 0.1}, samples=3, options={"duration": 1e-3, "noise": 0.0}),
    ):
        found = campaign(plan)
        report.campaign(found, tmp_path, published)
        assert {path.name for path in tmp_path.iterdir()} == {"distributions.png", "yield.png", "worst.png"}
        tables = report.campaign_tables(found, published)
        assert len(printed(tables).splitlines()) > 5
        assert_folds(tables, 80, 60, 40)


@pytest.mark.slow
def test_the_same_campaign_gives_the_same_pictures(controller: Controller, tmp_path: Path) -> None:
    found = campaign(_plan(controller, 16))
    for name in ("a", "b"):
        report.campaign(found, tmp_path / name)
    for name in report.CAMPAIGN_FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
