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
    Runs,
    Subset,
    _genealogical_cov,
    rare_event,
    read_design_point,
    replay_design_point,
    subset_simulation,
    write_event,
)
from malta.campaigns.result import runs_within_bounds
from malta.campaigns.run import campaign, runs_within_specification
from malta.simulation.readings import keys

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

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


def noisy(seed: int, share: float) -> Callable[[FloatArray, NDArray[np.int64]], FloatArray]:
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


def assert_agrees(found: list[Subset], expected: float) -> None:
    """The mean to three standard errors, and the scatter over seeds as large as the coefficient of variation."""
    p, cov = np.array([f.probability for f in found]), np.array([f.cov for f in found])
    assert all(f.reached for f in found)
    assert abs(p.mean() - expected) < 3 * p.std(ddof=1) / np.sqrt(len(p))
    assert 0.65 < np.log(p).std(ddof=1) / np.sqrt(np.log1p(cov**2).mean()) < 1.5
    inside = [low <= expected <= high for low, high in (f.interval() for f in found)]
    assert np.mean(inside) >= 0.8


def test_a_known_probability_of_1e_7() -> None:
    found = [subset_simulation(linear, 4, samples=2000, seed=seed) for seed in range(25)]
    assert_agrees(found, norm.sf(BETA))
    one = found[0]
    assert len(one.levels) == 7 or len(one.levels) == 8
    assert one.simulated < 2000 * len(one.levels)
    assert one.plain > 1e7
    assert one.failures.severity.min() >= 1
    assert [level.threshold for level in one.levels] == sorted(level.threshold for level in one.levels)
    assert all(0.25 < level.acceptance < 0.65 for level in one.levels[1:])


def test_a_failure_in_every_direction() -> None:
    assert_agrees([subset_simulation(radial, 3, samples=2000, seed=seed) for seed in range(25)], 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 1.0])
def test_noise_may_cause_the_event(share: float) -> None:
    """Also alone: its parts are the dimensions then."""
    found = [subset_simulation(noisy(seed, share), 2, 50, samples=2000, seed=seed) for seed in range(25)]
    assert_agrees(found, norm.sf(BETA))


def test_what_is_not_rare_is_plain_sampling() -> None:
    found = subset_simulation(lambda u, _: u[:, 0] + 0.5, 1, samples=1000)
    assert len(found.levels) == 1
    assert found.simulated == 1000
    assert found.cov == pytest.approx(np.sqrt((1 - found.probability) / found.probability / 1000), rel=1e-9)
    assert found.plain == pytest.approx(1000)
    assert found.probability == pytest.approx(norm.sf(0.5), abs=0.05)


def test_no_failure_is_a_bound_and_no_number() -> None:
    found = subset_simulation(lambda u, _: 0.9 * np.tanh(u[:, 0]), 1, samples=200)
    assert not found.reached
    assert len(found.failures.severity) == 0
    assert len(found.levels) == LEVELS - 1
    assert 0.85 < found.worst < 0.9
    assert found.interval()[1] < 1e-7


def test_severities_that_seldom_differ() -> None:
    """Zero in most runs, as commands that are seldom limited; and a mere indicator, which is refused."""
    found = [
        subset_simulation(lambda u, _: np.maximum(u[:, 0] - 1.5, 0) / 2.5, 1, samples=1000, seed=seed)
        for seed in range(25)
    ]
    assert_agrees(found, norm.sf(4))
    with pytest.raises(malta.InputError, match="the same value in"):
        subset_simulation(lambda u, _: np.where(u[:, 0] > 4, 1.0, 0.0), 1, samples=1000)
    with pytest.raises(malta.InputError, match="at least 100"):
        subset_simulation(linear, 1, samples=99)


def test_ctrl_c_leaves_a_bound() -> None:
    calls = 0

    def severity(u: FloatArray, noise: NDArray[np.int64]) -> FloatArray:
        nonlocal calls
        calls += 1
        if calls == 15:
            raise KeyboardInterrupt
        return linear(u, noise)

    found = subset_simulation(severity, 4, samples=1000)
    assert found.interrupted
    assert not found.reached
    assert [round(level.share, 2) for level in found.levels] == [0.1, 0.1]
    assert found.interval()[0] < 0.01 < found.interval()[1]


def test_limits_are_those_of_the_campaign() -> None:
    plan = shaky(0.3, 256)
    found = campaign(plan)
    published = malta.published("data/tubular.toml")
    touched = limit_of(plan, "touchdown").severity(found.batch)
    np.testing.assert_array_equal(touched < 1, found.completed)
    assert 0 < found.completed.mean() < 1
    far = limit_of(plan, "deviation-y1", 20e-6).severity(found.batch)
    np.testing.assert_array_equal(far < 1, found.completed & (found.batch.deviation[:, 1] <= 20e-6))
    y1 = found.batch.deviation[found.completed, 1]
    np.testing.assert_allclose(far[found.completed], y1 / 20e-6, rtol=1e-12)
    bounds = malta.campaigns.limits.Bounds(published)
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
    limit = limit_of(found.plan, "specification", bounds=malta.campaigns.limits.Bounds(spec=spec))
    within = runs_within_specification(found, spec)
    assert within is not None
    assert 0 < within.sum() < 64
    np.testing.assert_array_equal(limit.severity(found.batch) < 1, within)


def test_the_design_point_comes_again(tmp_path: Path) -> None:
    """Machine, noise and verdict, from a file, to the bit by the compiled engine; workers do not matter."""
    plan = shaky(0.08, 200)
    limit = limit_of(plan, "touchdown")
    event = rare_event(plan, limit, workers=1)
    assert event.found.levels == rare_event(plan, limit, workers=3).found.levels
    assert len(event.found.levels) > 1
    assert event.design_point is not None
    path = write_event(event, tmp_path)
    point = read_design_point(path, plan)
    assert point == event.design_point
    again = replay_design_point(plan, point)
    assert (again.run.verdict.name, again.run.verdict.time) == (point.end, point.time)
    assert point.end.startswith("touchdown")
    for name in BOX:
        middle = getattr(plan.parameters, name)
        assert 0 < abs(point.values[name] / middle - 1) < 0.08
    path.write_text(path.read_text().replace('"noise": [', '"noise": [-1, '))
    with pytest.raises(malta.InputError, match="damaged or foreign"):
        read_design_point(path, plan)


@pytest.mark.slow
def test_a_touchdown_as_probable_as_by_plain_sampling() -> None:
    """Near 3e-3, by 60 000 plain runs and by ten subset simulations of a tenth as many."""
    plan = shaky(0.065, 60_000, seed=99)
    limit = limit_of(plan, "touchdown")
    touched = float((~campaign(plan).completed).mean())
    found = [rare_event(replace(plan, samples=2000, seed=seed), limit).found for seed in range(10)]
    p = np.array([f.probability for f in found])
    error = np.hypot(p.std(ddof=1) / np.sqrt(len(p)), np.sqrt(touched / plan.samples))
    assert 5e-4 < touched < 1e-2
    assert abs(p.mean() - touched) < 3 * error
    assert 0.5 < p.std(ddof=1) / p.mean() / np.mean([f.cov for f in found]) < 2


@pytest.mark.slow
def test_noise_alone_is_as_probable_as_by_plain_sampling() -> None:
    """No parameter varies; 0.3545 um along x1 in 50 ms at rest, in one run of a thousand."""
    options = {"fidelity": "force", "duration": 0.05}
    controller = gains.read("design/gains/calibrated.json")
    plan = Plan(controller, "hold", {"m": 0.0}, samples=100_000, seed=99, options=options)
    limit = limit_of(plan, "deviation-x1", 0.3545e-6)
    plain = float((limit.severity(campaign(plan).batch) >= 1).mean())
    found = [rare_event(replace(plan, samples=2000, seed=seed), limit).found for seed in range(10)]
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
    quick = ("--spread", "9%", "--option", "fidelity=force", "--samples", "200")
    common = ("campaign", SHAKY, *quick, "--out", tmp_path)
    code, out, err = run(*common, "--study", "rare", "--limit", "touchdown")
    assert (code, err) == (0, "")
    assert f"--replay {tmp_path}:rare_touchdown" in out
    assert {path.name for path in tmp_path.iterdir()} == {"campaign.json", "rare_touchdown.json"}
    document = json.loads(run(*common, "--study", "rare", "--limit", "touchdown", "--json").out)
    assert document["low"] < document["probability"] < document["high"]
    assert f"{document['probability']:.3g}" in out
    code, _, err = run("simulate", SHAKY, "--replay", f"{tmp_path}:rare_touchdown")
    assert code == 1
    assert document["design_point"]["end"] in err
    code, out, _ = run(*common, "--study", "rare", "--limit", "help")
    assert code == 0
    assert "deviation-y1=VALUE" in out
    code, out, err = run(
        *common[:3], "3%", *common[4:-1], tmp_path / "b", "--study", "rare", "--limit", "deviation-y1=0.8mm"
    )
    assert code == 0
    assert "below" in out
    assert "no run failed: deviation y1 above 800 um or an earlier end has a probability below" in err


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--study", "rare", "--limit", "deviation-y1=20kg"), "--limit: deviation-y1.unit: found 'kg'"),
        (("--study", "rare", "--limit", "deviation-y1=far"), "expected a number with its unit"),
        (
            ("--study", "rare", "--limit", "collision"),
            "--limit: found 'collision', expected one of touchdown",
        ),
        (
            ("--rare", "touchdown", "--sobol"),
            "found --rare and --sobol, expected one study",
        ),
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


def test_descendants_of_one_run_alone_say_nothing() -> None:
    """All survivors of one first run: cov near 1; each of another one: 0."""
    none = np.zeros((50, 0))
    alike = Runs(none, none.astype(np.int64), np.ones(50), np.zeros(50, dtype=np.int64))
    apart = alike._replace(ancestor=np.arange(50))
    assert _genealogical_cov(alike, 50) == pytest.approx(math.sqrt(1 - 1 / 50))
    assert _genealogical_cov(apart, 50) == 0
