"""Campaigns of any size: one summary whatever the order of blocks, the same as of the arrays, in flat memory."""

from __future__ import annotations

import io
import sys
import tracemalloc
import weakref
from collections.abc import Callable
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rich.console import Console

import malta
from malta import report
from malta.campaigns import summary, summary as sketch
from malta.campaigns.plan import SAMPLERS, Plan, draw_machines
from malta.campaigns.result import Campaign, figures_of, gather, runs_within_bounds, yields_of
from malta.campaigns.run import (
    BLOCK,
    FILES,
    LARGE_BLOCK,
    RunExecution,
    Sum,
    block_size,
    campaign,
    replay,
    summarize,
)
from malta.campaigns.store import MANIFEST, RunBlock, block_name, figure_shapes, fly
from malta.campaigns.summary import RunLimits, Summary, join, summary_of, worst_of, worst_runs
from malta.simulation.engine.digest import Batch, verdicts

if TYPE_CHECKING:
    from conftest import Design

    from malta.synthesis.controller import Controller

pytestmark = pytest.mark.usefixtures("proven_once")
MODULE: Any = sys.modules["malta.campaigns.run"]
BOX = dict.fromkeys(("m", "K_A", "K_D", "K_B"), 0.6)
QUICK = {"fidelity": "force", "duration": 0.01, "rise": 3e-3}


@pytest.fixture(scope="module")
def shaky(designs: dict[str, Design]) -> Controller:
    return designs["table2"].controller


@pytest.fixture(scope="module")
def plan(shaky: Controller) -> Plan:
    return Plan(shaky, "stroke", BOX, {"offset_y2": 5e-6}, samples=208)


@pytest.fixture(scope="module")
def bounds(published: dict[str, Any]) -> RunLimits:
    return RunLimits(published, malta.read_design("design/robust.toml"))


@pytest.fixture(scope="module")
def flown(plan: Plan, tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    return campaign(plan, tmp_path_factory.mktemp("flown"), block=16)


def _content(found: Summary) -> dict[str, Any]:
    """All numbers of a summary, to the bit."""
    return {
        "runs": (found.runs, found.verdicts.tolist(), found.within, found.specified, found.engines),
        "bands": found.bands.tolist(),
        "merits": [
            (m.label, m.within, m.total, m.squares, m.sketch.count, m.sketch.smallest, m.sketch.largest)
            for m in found.listed
        ],
        "values": [np.sort(np.concatenate([*m.sketch.values, [np.inf]])).tobytes() for m in found.listed],
        "counts": [{k: v.tobytes() for k, v in m.sketch.counts.items()} for m in found.listed],
        "worst": [
            found.kept.index.tobytes(),
            found.kept.values.tobytes(),
            *(getattr(found.kept.batch, name).tobytes() for name in Batch.__dataclass_fields__),
        ],
    }


def _page(found: Campaign | Summary, bounds: RunLimits) -> str:
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(report.campaign_tables(found, bounds.published, 7, bounds.spec))
    return console.export_text()


def _blocks(flown: Campaign, size: int) -> list[RunBlock]:
    return [
        RunBlock(
            flown.values[k : k + size],
            Batch(**{n: getattr(flown.batch, n)[k : k + size] for n in Batch.__dataclass_fields__}),
            "compiled",
        )
        for k in range(0, len(flown.index), size)
    ]


@pytest.mark.slow
def test_a_summary_of_blocks_is_that_of_the_arrays(
    flown: Campaign, bounds: RunLimits, tmp_path: Path
) -> None:
    """Read from the folder and simulated anew; tables too, and pictures to the byte."""
    wanted = summary_of(flown, bounds)
    assert flown.folder is not None
    for found in (
        summarize(flown.plan, flown.folder, bounds),
        summarize(flown.plan, bounds=bounds, block=64),
    ):
        one, other = _content(found), _content(wanted)
        merits = one.pop("merits"), other.pop("merits")
        assert one == other
        for mine, theirs in zip(*merits, strict=True):  # sums are rounded in each block
            assert mine[:2] + mine[4:] == theirs[:2] + theirs[4:]
            assert [float(x) for x in mine[2:4]] == pytest.approx([float(x) for x in theirs[2:4]], rel=1e-12)
        assert _page(found, bounds) == _page(flown, bounds)
        assert found.yields == yields_of(flown, *bounds)
    report.campaign(flown, tmp_path / "a", bounds.published)
    report.campaign(summarize(flown.plan, flown.folder, bounds), tmp_path / "b", bounds.published)
    for name in report.CAMPAIGN_FILES:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_summary_by_hand(flown: Campaign, bounds: RunLimits) -> None:
    found = summary_of(flown, bounds)
    assert found.ends == flown.ends
    assert found.rate == flown.rate
    within = runs_within_bounds(flown, bounds.published)
    assert within is not None
    assert found.within == within.sum()
    for merit, figure in zip(found.merits, figures_of(flown, bounds.published), strict=True):
        values = figure.values[np.isfinite(figure.values)]
        assert merit.label == figure.label
        assert np.array_equal(merit.percentiles([5, 50, 99]), np.percentile(values, [5, 50, 99]))
        assert merit.mean == pytest.approx(values.mean(), rel=1e-13)
        assert merit.standard_deviation == pytest.approx(values.std(), rel=1e-9, abs=1e-15)
        assert merit.within == figure.within.sum()
        assert [one.value for one in merit.figures((50,))] == [np.median(values)]
    shares = {one.label: one for one in found.figures}
    assert (shares["completed"].value, shares["completed"].better) == (found.rate.share, "high")
    rise = shares["rise, 10-90 %, median"]
    assert (rise.better, rise.relation, rise.meaning.group) == ("low", "about", "campaign")
    names, limited = verdicts(flown.plan.plant), flown.batch.saturated.max(axis=1) > 0
    ways = dict(zip(summary.ways_to_end(flown.plan), found.bands[0], strict=True))  # over m
    assert ways[summary.WITHIN_BOUNDS_TEXT].sum() == found.within
    assert ways[summary.LIMITED_TEXT].sum() == (flown.completed & limited & ~within).sum()
    for code, name in enumerate(names[1:], start=1):
        assert ways[name].sum() == (flown.batch.verdict == code).sum()
    m = flown.values[:, 0] / flown.plan.parameters.m
    assert np.array_equal(found.bands[0].sum(axis=0), np.histogram(m, np.linspace(0.4, 1.6, 11))[0])


@pytest.mark.parametrize("few", [False, True])
def test_blocks_join_in_any_order_to_the_bit(
    flown: Campaign, bounds: RunLimits, monkeypatch: pytest.MonkeyPatch, few: bool
) -> None:
    """Also where values are counted and most of the worst runs are dropped."""
    if few:
        monkeypatch.setattr(sketch, "MAX_EXACT_VALUES", 40)
        monkeypatch.setattr(summary, "KEPT_RUNS", 9)
    parts = [
        summary_of(gather(flown.plan, {16 * k: block}), bounds) for k, block in enumerate(_blocks(flown, 16))
    ]
    wanted = _content(reduce(join, parts))
    assert _content(reduce(join, parts))["worst"] == _content(summary_of(flown, bounds))["worst"]
    page = _page(reduce(join, parts), bounds)
    assert ("percentiles of the completed runs, within 0.006 % of their values" in page) == few
    rng = np.random.default_rng(1)
    for _ in range(5):
        left = [parts[k] for k in rng.permutation(len(parts))]
        while len(left) > 1:  # pairs anywhere, as a tree
            one = left.pop(int(rng.integers(len(left))))
            k = int(rng.integers(len(left)))
            left[k] = join(left[k], one)
        assert _content(left[0]) == wanted


def test_the_worst_runs_are_those_of_all(flown: Campaign, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 208 runs some ended early; each list, also where few runs are kept, by sorting all of them."""
    done, contact = flown.completed, flown.batch.contact
    closest = -(contact - np.percentile(contact[done], 50, axis=0)).max(axis=1)
    order = np.lexsort((flown.index, np.where(done, closest, flown.batch.duration), done))
    assert 10 < (~done).sum() < 150
    assert worst_of(flown, 208) == order.tolist()
    monkeypatch.setattr(summary, "KEPT_RUNS", 180)
    whole = reduce(
        join, [summary_of(gather(flown.plan, {16 * k: b})) for k, b in enumerate(_blocks(flown, 16))]
    )
    assert worst_runs(whole, 180).index.tolist() == order[:180].tolist()
    assert len(worst_runs(whole, 999).index) == 180


# --- memory ---


def _invented(kept: list[weakref.ref[Any]] | None = None) -> Callable[..., RunBlock]:
    """A `fly` that invents figures, faster than any simulation."""

    def fly(plan: Plan, first: int, count: int, *_: Any) -> RunBlock:
        rng = np.random.default_rng(first)
        columns = {name: rng.uniform(0.1, 1, (count, *shape)) for name, shape in figure_shapes(plan).items()}
        columns["completed"] = (rng.uniform(size=count) < 0.9).astype(float)
        columns["verdict"] = np.where(columns["completed"] == 1, 0.0, 3.0)
        columns["duration"] *= 0.01
        batch = Batch(**columns)
        if kept is not None:
            kept.append(weakref.ref(batch))
            assert sum(ref() is not None for ref in kept) <= 2
        return RunBlock(draw_machines(plan, first, count).values, batch, "compiled")

    return fly


@pytest.mark.slow
def test_no_block_stays_in_memory(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """While one is simulated, at most the one before is alive; and while they are read again."""
    made: list[weakref.ref[Any]] = []
    monkeypatch.setattr(MODULE, "fly", _invented(made))
    small = Plan(plan.controller, "stroke", BOX, samples=160)
    found = summarize(small, tmp_path, block=8)
    assert found.runs == 160
    assert len(made) == 20
    assert not any(ref() is not None for ref in made)
    assert _content(summarize(small, tmp_path)) == _content(found)
    assert len(made) == 20


@pytest.mark.slow
def test_memory_does_not_grow_with_the_runs(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    """Three times the runs: less than a tenth more, where their figures alone would be twice as many bytes."""
    monkeypatch.setattr(MODULE, "fly", _invented())
    monkeypatch.setattr(sketch, "MAX_EXACT_VALUES", 2000)
    monkeypatch.setattr(summary, "KEPT_RUNS", 50)
    peaks = []
    for samples in (4000, 12_000):
        wanted = Plan(plan.controller, "stroke", BOX, samples=samples)
        tracemalloc.start()
        summarize(wanted, block=400)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


def test_blocks_grow_with_the_campaign(plan: Plan) -> None:
    sizes = {
        samples: block_size(Plan(plan.controller, "stroke", BOX, samples=samples), RunExecution())
        for samples in (1, 10_000, FILES * BLOCK, FILES * BLOCK + 1, 1_000_000, 100_000_000)
    }
    assert [*sizes.values()] == [BLOCK, BLOCK, BLOCK, 2 * BLOCK, 4 * BLOCK, LARGE_BLOCK]


@pytest.mark.slow
def test_the_last_run_of_a_hundred_million_is_simulated_alone(shaky: Controller) -> None:
    """Its block of eight, and the run again, without a design of all in memory."""
    count = 100_000_000
    for sampler in SAMPLERS:
        plan = Plan(shaky, "stroke", BOX, samples=count, sampler=sampler, options=QUICK)
        block = fly(plan, count - 8, 8)
        single = replay(plan, count - 1).run
        assert np.array_equal(block.batch.deviation[7], np.abs(single.p - single.reference).max(axis=0))
        assert single.scenario.run == count - 1


def test_more_runs_than_arrays_take_are_refused(plan: Plan) -> None:
    large = Plan(plan.controller, "stroke", BOX, samples=10_000_001)
    with pytest.raises(malta.InputError, match=r"at most 10000000 in memory; malta\.campaigns\.summarize"):
        campaign(large)


# --- interruptions ---


@pytest.mark.slow
def test_ctrl_c_anywhere_counts_every_block_once(
    plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a block is counted, and after it: the file is there, and so are its runs; then the rest."""
    monkeypatch.setattr(MODULE, "fly", _invented())
    add = Sum.__setitem__
    wanted = _content(summarize(plan, block=16))
    for name, late in (("early", False), ("late", True)):

        def interrupted(self: Sum, first: int, block: RunBlock, late: bool = late) -> None:
            once = first == 64 and first not in self and not (tmp_path / "pressed").exists()
            if late or not once:
                add(self, first, block)
            if once:
                (tmp_path / "pressed").touch()
                raise KeyboardInterrupt

        with monkeypatch.context() as patch:
            patch.setattr(Sum, "__setitem__", interrupted)
            cut = summarize(plan, tmp_path / name, block=16)
        (tmp_path / "pressed").unlink()
        assert cut.interrupted
        assert cut.runs == 80
        assert {path.name for path in (tmp_path / name).iterdir()} == {
            MANIFEST,
            *(block_name(16 * k) for k in range(5)),
        }
        whole = summarize(plan, tmp_path / name)
        assert not whole.interrupted
        assert _content(whole) == wanted
