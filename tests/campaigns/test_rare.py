"""Rare events: known probabilities, plain sampling on a real machine, and design points that come again."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import Run
from scipy.stats import chi2, norm

import malta
from malta import gains
from malta.campaigns.limits import limit_of, merits_of, slug
from malta.campaigns.plan import Plan
from malta.campaigns.rare import (
    LEVELS,
    REPETITIONS,
    Level,
    LevelRuns,
    RareEventEstimate,
    Subset,
    rare_event,
    read_design_point,
    repeated_subset_simulation,
    replay_design_point,
    write_event,
)
from malta.campaigns.result import runs_within_bounds, runs_within_specification
from malta.campaigns.run import campaign
from malta.campaigns.store import seal
from malta.campaigns.summary import RunLimits
from malta.simulation.readings import keys

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.arrays import FloatArray
    from malta.campaigns.rare import Severity
    from malta.simulation.engine.digest import Batch

BOX = ("m", "K_A", "K_B", "K_D")
SHAKY = "design/gains/table2.json"
BETA = 5.2  # of a limit state with a probability of 1e-7


def shaky(spread: float, samples: int, seed: int = 0) -> Plan:
    """The main job of a design that touches down where its machine differs by some percent; forces as lags."""
    box = dict.fromkeys(BOX, spread)
    return Plan(gains.read(SHAKY), "stroke", box, samples=samples, seed=seed, options={"fidelity": "force"})


def linear(u: FloatArray, _: NDArray[np.int64]) -> FloatArray:
    found: FloatArray = u.sum(axis=1) / np.sqrt(u.shape[1]) / BETA
    return found


def noisy(seed: int, share: float) -> Severity:
    """The same limit state, with a share of its variance from the noise of 50 parts."""

    def severity(u: FloatArray, noise: NDArray[np.int64]) -> FloatArray:
        parts = noise.shape[1]
        drawn = keys(seed, noise * parts + np.arange(parts)).astype(float) / 2**64
        z: FloatArray = norm.ppf(drawn).sum(axis=1) / np.sqrt(parts)
        found: FloatArray = np.sqrt(1 - share) * linear(u, noise) + np.sqrt(share) * z / BETA
        return found

    return severity


def radial(u: FloatArray, _: NDArray[np.int64]) -> FloatArray:
    found: FloatArray = (u**2).sum(axis=1) / chi2.isf(1e-6, u.shape[1])
    return found


def estimates(
    severity: Severity, dimensions: int, count: int = 25, parts: int = 1
) -> list[RareEventEstimate]:
    """Of the smallest effort that is allowed, each by a seed of its own."""
    return [
        repeated_subset_simulation(severity, dimensions, parts, samples=2000, seed=seed)
        for seed in range(count)
    ]


def assert_agrees(found: list[RareEventEstimate], expected: float) -> None:
    """The mean to three standard errors and a bias, and intervals that contain the probability."""
    p = np.array([f.probability for f in found])
    assert all(f.reached for f in found)
    assert abs(p.mean() - expected) < 3 * p.std(ddof=1) / np.sqrt(len(p)) + 0.15 * expected
    assert np.mean([low <= expected <= high for low, high in (f.interval() for f in found)]) >= 0.8


@pytest.mark.slow
def test_a_known_probability_of_1e_7() -> None:
    found = estimates(linear, 4)
    assert_agrees(found, norm.sf(BETA))
    event = found[0]
    assert event.failures.severity.min() >= 1
    assert event.simulated == sum(one.simulated for one in event.repetitions)
    assert event.plain > 1e7
    assert len({one.probability for one in event.repetitions}) == REPETITIONS
    for one in event.repetitions:
        assert len(one.levels) == 7 or len(one.levels) == 8
        assert one.simulated < 500 * len(one.levels)
        assert [level.threshold for level in one.levels] == sorted(level.threshold for level in one.levels)
        assert all(0.2 < level.acceptance < 0.7 for level in one.levels[1:])


@pytest.mark.slow
def test_a_failure_in_every_direction() -> None:
    assert_agrees(estimates(radial, 3), 1e-6)


def test_an_interval_by_hand() -> None:
    """Of 1, 2, 3 and 6 in a million: mean and variance of their logarithms by hand, t(3) of a table."""
    none = LevelRuns(np.zeros((1, 0)), np.zeros((1, 1), np.int64), np.ones(1))
    some = [
        Subset((Level(0.5, 0.1, math.nan), Level(1.0, 1e-5 * n, 0.4)), 900, none, 0.9, 500)
        for n in (1, 2, 3, 6)
    ]
    found = RareEventEstimate(tuple(some))
    mean, variance = math.log(1e-6) + math.log(36) / 4, 0.562468
    half = 3.18245 * math.sqrt(variance / 4 + variance**2 / 6)
    assert found.probability == pytest.approx(math.exp(mean + variance / 2), rel=1e-4)
    assert found.interval() == pytest.approx(
        [found.probability * math.exp(x) for x in (-half, half)], rel=1e-4
    )


def line(p: float) -> Severity:
    return lambda u, _: u.sum(axis=1) / np.sqrt(u.shape[1]) / norm.isf(p)


def union(p: float) -> Severity:
    return lambda u, _: np.abs(u[:, 0]) / norm.isf(p / 2)


def corner(p: float) -> Severity:
    return lambda u, _: u[:, :2].min(axis=1) / norm.isf(math.sqrt(p))


@pytest.mark.slow
def test_intervals_keep_what_they_promise() -> None:
    """Of 95 %, over 100 estimates of the smallest effort; the probability is off by less than its own interval."""
    covered = {}
    for p in (1e-2, 1e-3, 1e-5):
        for state, dimensions in ((line, 10), (union, 2), (corner, 2)):
            found = estimates(state(p), dimensions, 100)
            low, high = np.array([one.interval() for one in found]).T
            covered[p, state.__name__] = float(np.mean((low <= p) & (p <= high)))
            assert (
                abs(np.mean([one.probability for one in found]) / p - 1)
                < {1e-2: 0.06, 1e-3: 0.1, 1e-5: 0.25}[p]
            )
    assert all(0.9 <= share <= 0.99 for share in covered.values()), covered
    assert 0.93 <= np.mean(list(covered.values())) <= 0.98, covered


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_noise_may_cause_the_event(share: float) -> None:
    """Also alone: its parts are the dimensions then."""
    found = [
        repeated_subset_simulation(noisy(seed, share), 2, 50, samples=2000, seed=seed) for seed in range(25)
    ]
    assert_agrees(found, norm.sf(BETA))


def test_no_noise_is_drawn_twice() -> None:
    """Within a repetition or by two of them."""
    drawn: list[NDArray[np.int64]] = []

    def severity(u: FloatArray, noise: NDArray[np.int64]) -> FloatArray:
        drawn.append(np.unique(noise))
        return linear(u, noise)

    found = repeated_subset_simulation(severity, 2, samples=2000)
    firsts = [noise for noise in drawn if len(noise) == 500]  # of the repetitions
    assert len(np.unique(np.concatenate(firsts))) == 500 * REPETITIONS
    assert len(np.unique(np.concatenate(drawn))) > 0.9 * found.simulated / 10


def test_what_is_not_rare_is_plain_sampling() -> None:
    found = repeated_subset_simulation(lambda u, _: u[:, 0] + 0.5, 1, samples=2000)
    assert [len(one.levels) for one in found.repetitions] == [1] * REPETITIONS
    assert found.simulated == 2000
    assert found.cov == pytest.approx(np.sqrt((1 - found.probability) / found.probability / 2000), rel=1e-9)
    assert found.plain == pytest.approx(2000)
    assert found.probability == pytest.approx(norm.sf(0.5), abs=0.04)
    low, high = found.interval()
    assert low < found.probability < high < low + 0.05
    always = repeated_subset_simulation(lambda u, _: 2 + 0 * u[:, 0], 1, samples=2000)
    assert always.probability == 1
    assert 0.99 < always.interval()[0] < 1


def test_no_failure_is_a_bound_and_no_number() -> None:
    found = repeated_subset_simulation(lambda u, _: 0.9 * np.tanh(u[:, 0]), 1, samples=2000)
    assert not found.reached
    assert len(found.failures.severity) == 0
    assert [len(one.levels) for one in found.repetitions] == [LEVELS - 1] * REPETITIONS
    assert 0.85 < found.worst < 0.9
    assert found.plain == math.inf
    assert 1e-9 < found.interval()[1] < 1e-7


def test_a_failure_that_one_repetition_finds_is_a_bound() -> None:
    """A region in which only the first repetition fails, by its runs' noise: nothing is known but the largest bound."""
    found = repeated_subset_simulation(
        lambda u, noise: np.where((noise[:, 0] < 2**40) & (u[:, 0] > 2), 1.0, 0.9 * np.tanh(u[:, 0])),
        1,
        samples=2000,
    )
    assert [one.reached for one in found.repetitions] == [True, False, False, False]
    assert not found.reached
    assert found.interval()[1] > norm.sf(2)


@pytest.mark.slow
def test_severities_that_seldom_differ() -> None:
    """Zero in most runs, as commands that are seldom limited; and a mere indicator, which is refused."""
    assert_agrees(estimates(lambda u, _: np.maximum(u[:, 0] - 1.5, 0) / 2.5, 1), norm.sf(4))
    with pytest.raises(malta.InputError, match="the same value in"):
        repeated_subset_simulation(lambda u, _: np.where(u[:, 0] > 4, 1.0, 0.0), 1, samples=4000)
    with pytest.raises(malta.InputError, match="at least 2000: 4 repetitions of 500"):
        repeated_subset_simulation(linear, 1, samples=1999)


@pytest.mark.slow
def test_limits_are_those_of_the_campaign() -> None:
    plan = shaky(0.3, 256)
    found = campaign(plan)
    published = malta.model.read_published("data/tubular.toml")
    touched = limit_of(plan, "touchdown").severity(found.batch)
    np.testing.assert_array_equal(touched < 1, found.completed)
    assert 0 < found.completed.mean() < 1
    far = limit_of(plan, "deviation-y1", 20e-6).severity(found.batch)
    np.testing.assert_array_equal(far < 1, found.completed & (found.batch.deviation[:, 1] <= 20e-6))
    y1 = found.batch.deviation[found.completed, 1]
    np.testing.assert_allclose(far[found.completed], y1 / 20e-6, rtol=1e-12)
    bounds = RunLimits(published)
    outside = limit_of(plan, "published", bounds=bounds).severity(found.batch)
    np.testing.assert_array_equal(outside < 1, runs_within_bounds(found, published))
    assert slug("rise, 10-90 %") == "rise" in merits_of(plan)
    for arguments, sentence in (
        (("deviation-y1",), "no bound"),
        (("deviation-y1", 0.0), "above 0"),
        (("touchdown", 1.0), "a bound of 1"),
        (("specification",), "no [specification] of it"),
        (("collision",), "one of touchdown, published"),
    ):
        with pytest.raises(malta.InputError) as caught:
            limit_of(plan, *arguments)
        assert sentence in str(caught.value)


def test_a_specification_is_a_limit() -> None:
    spec = malta.read_design("design/robust.toml")
    box = dict.fromkeys(BOX, 0.2)
    found = campaign(Plan(gains.read("design/gains/robust.json"), "stroke", box, samples=64))
    limit = limit_of(found.plan, "specification", bounds=RunLimits(spec=spec))
    within = runs_within_specification(found, spec)
    assert within is not None
    assert 0 < within.sum() < 64
    np.testing.assert_array_equal(limit.severity(found.batch) < 1, within)


QUICK = {"fidelity": "force", "duration": 0.02}


@pytest.mark.slow
def test_the_design_point_comes_again(tmp_path: Path) -> None:
    """Machine, noise and verdict, from a file, to the bit by the compiled engine; workers do not matter."""
    plan = replace(shaky(0.2, 2000), options=QUICK)
    limit = limit_of(plan, "deviation-y1", 500e-6)
    event = rare_event(plan, limit, workers=1)
    assert len(event.found.repetitions[0].levels) > 1
    same = rare_event(plan, limit, workers=3).found
    np.testing.assert_array_equal(event.found.failures.u, same.failures.u)
    assert event.design_point is not None
    path = write_event(event, tmp_path)
    point = read_design_point(path, plan)
    assert point == event.design_point
    again = replay_design_point(plan, point)
    assert (again.run.verdict.name, again.run.verdict.time) == (point.end, point.time)
    for name in BOX:
        middle = getattr(plan.parameters, name)
        assert 0 < abs(point.values[name] / middle - 1) < 0.2
    path.write_text(path.read_text().replace('"noise": [', '"noise": [-1, '))
    with pytest.raises(malta.InputError, match="damaged or foreign"):
        read_design_point(path, plan)


@pytest.mark.slow
def test_an_interrupted_study_goes_on(tmp_path: Path) -> None:
    """With the repetitions that are done; damaged ones, and those of another limit, are simulated again."""
    plan = replace(shaky(0.2, 2000), options=QUICK)
    limit, calls = limit_of(plan, "deviation-y1", 500e-6), 0

    def counting(batch: Batch) -> FloatArray:
        nonlocal calls
        calls += 1
        if calls == last:
            raise KeyboardInterrupt
        return limit.severity(batch)

    watched = replace(limit, severity=counting)
    last = 0
    whole = rare_event(plan, watched).found
    each, last, calls = calls // REPETITIONS, calls, 0
    with pytest.raises(KeyboardInterrupt):
        rare_event(plan, watched, tmp_path)
    kept = sorted(tmp_path.glob("rare_*.npz"))
    assert 1 <= len(kept) < REPETITIONS
    last = calls = 0
    shares: list[float] = []
    again = rare_event(plan, watched, tmp_path, progress=shares.append).found
    assert calls <= each * (REPETITIONS - len(kept)) + each
    for ours, first in zip(again.repetitions, whole.repetitions, strict=True):
        np.testing.assert_array_equal(ours.levels, first.levels)
        np.testing.assert_array_equal(ours.failures.noise, first.failures.noise)
    assert again.interval() == whole.interval()
    assert shares == sorted(shares)
    assert shares[-1] == 1
    kept[0].write_bytes(kept[0].read_bytes()[:-100])
    assert rare_event(plan, limit, tmp_path).found.interval() == whole.interval()
    for name, value in (("worst", 0.5), ("limit", "touchdown")):  # changed, and of another limit
        arrays = dict(np.load(kept[0])) | {name: np.array(value)}
        del arrays["seal"]
        broken = "0" * 64 if name == "worst" else seal(arrays, 0)
        np.savez(kept[0], **arrays, seal=np.array(broken))
        calls = 0
        assert rare_event(plan, watched, tmp_path).found.interval() == whole.interval()
        assert calls == each


@pytest.mark.slow
def test_a_touchdown_as_probable_as_by_plain_sampling() -> None:
    """Near 3e-3, by 40 000 plain runs and by four estimates of a sixth as many: most of their intervals contain it."""
    plan = shaky(0.065, 40_000, seed=99)
    limit = limit_of(plan, "touchdown")
    touched = float((~campaign(plan).completed).mean())
    found = [rare_event(replace(plan, samples=2000, seed=seed), limit).found for seed in range(4)]
    p = np.array([f.probability for f in found])
    error = np.hypot(p.std(ddof=1) / np.sqrt(len(p)), np.sqrt(touched / plan.samples))
    assert 5e-4 < touched < 1e-2
    assert abs(p.mean() - touched) < 3 * error
    assert sum(low < touched < high for low, high in (f.interval() for f in found)) >= 3


@pytest.mark.slow
def test_noise_alone_is_as_probable_as_by_plain_sampling() -> None:
    """No parameter varies; 0.3545 um along x1 in 50 ms at rest, in one run of a thousand."""
    options = {"fidelity": "force", "duration": 0.05}
    controller = gains.read("design/gains/calibrated_slow.json")
    plan = Plan(controller, "hold", {"m": 0.0}, samples=50_000, seed=99, options=options)
    limit = limit_of(plan, "deviation-x1", 0.3545e-6)
    plain = float((limit.severity(campaign(plan).batch) >= 1).mean())
    found = [rare_event(replace(plan, samples=2000, seed=seed), limit).found for seed in range(4)]
    p = np.array([f.probability for f in found])
    assert 4e-4 < plain < 2e-3
    assert abs(p.mean() - plain) < 3 * np.hypot(
        p.std(ddof=1) / np.sqrt(len(p)), np.sqrt(plain / plan.samples)
    )


@pytest.mark.slow
def test_a_touchdown_of_one_in_a_million() -> None:
    """Only machines in one corner of the box touch down: plain sampling of the corner alone has enough of them."""
    spread, edge = (
        0.055,
        0.9,
    )  # the corner: m and K_A beyond 0.9 of their spreads above the middle, K_B as far below
    controller = gains.read(SHAKY)
    plan = Plan(controller, "stroke", dict.fromkeys(BOX, spread), samples=4000)
    limit = limit_of(plan, "touchdown")
    found = rare_event(plan, limit).found
    place = 2 * norm.cdf(found.failures.u) - 1
    assert (place[:, :3] * [1, 1, -1]).min() > edge + 0.01
    signs = {"m": 1, "K_A": 1, "K_B": -1}
    own = {name: getattr(plan.parameters, name) for name in signs}
    middle = {name: own[name] * (1 + sign * spread * (1 + edge) / 2) for name, sign in signs.items()}
    box = {name: own[name] * spread * (1 - edge) / 2 / middle[name] for name in signs} | {"K_D": spread}
    corner = Plan(
        controller, "stroke", box, samples=30_000, parameters=replace(controller.parameters, **middle)
    )
    flown = campaign(corner)
    touched = int((~flown.completed).sum())
    plain = ((1 - edge) / 2) ** 3 * touched / corner.samples
    assert touched > 100
    assert 5e-7 < plain < 2e-6
    assert abs(found.probability / plain - 1) < 3 * np.hypot(found.cov, touched**-0.5)


@pytest.mark.slow
def test_the_command(run: Run, tmp_path: Path) -> None:
    quick = ("--spread", "20%", "--option", "fidelity=force", "--samples", "2000")
    common = ("campaign", SHAKY, *quick, "--out", tmp_path)
    code, out, err = run(*common, "--study", "rare", "--limit", "touchdown")
    assert (code, err) == (0, "")
    assert f"--replay {tmp_path}:rare_touchdown" in out
    assert {path.name for path in tmp_path.iterdir()} == {
        "campaign.json",
        "rare_touchdown.json",
        *(f"rare_touchdown_{k}.npz" for k in range(REPETITIONS)),
    }
    document = json.loads(run(*common, "--study", "rare", "--limit", "touchdown", "--json").out)
    assert document["low"] < document["probability"] < document["high"]
    assert f"{document['probability']:.3g}" in out
    code, _, err = run("simulate", SHAKY, "--replay", f"{tmp_path}:rare_touchdown")
    assert code == 1
    assert document["design_point"]["end"] in err
    code, out, _ = run(*common, "--study", "rare", "--limit", "help")
    assert code == 0
    assert "deviation-y1=VALUE" in out


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--study", "rare", "--limit", "deviation-y1=20kg"), "--limit: deviation-y1.unit: found 'kg'"),
        (("--study", "rare", "--limit", "deviation-y1=far"), "expected a number with its unit"),
        (
            ("--study", "rare", "--limit", "collision"),
            "--limit: found 'collision', expected one of touchdown",
        ),
        (("--rare", "touchdown", "--sobol"), "found --rare and --sobol, expected one study"),
        (("--limit", "published"), "--limit: found 'published', expected it with --study"),
        (("--study", "many"), "--study: found 'many', expected one of rare, sensitivity, tolerances"),
        (("--study", "tolerances"), "found no --keep"),
        (("--study", "rare", "--limit", "touchdown", "--cluster", "tcp://x:1"), "--cluster too"),
        (
            ("--study", "rare", "--limit", "touchdown", "--spread", "m=0%", "--option", "noise=0"),
            "nothing random",
        ),
        (("--study", "tolerances", "--keep", "0%"), "expected a yield above 0 %"),
    ],
)
def test_a_study_that_is_none_is_one_sentence(
    run: Run, tmp_path: Path, options: tuple[str, ...], sentence: str
) -> None:
    code, out, err = run("campaign", SHAKY, "--samples", "200", *options, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert sentence in err
    assert err.count("\n") == 1
