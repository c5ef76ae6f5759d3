"""Sobol indices and tolerances over the box of a campaign."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run

import malta
from malta import gains
from malta.campaigns import studies as tolerance
from malta.campaigns.limits import limit_of
from malta.campaigns.plan import Plan
from malta.campaigns.result import Rate, rate
from malta.campaigns.run import campaign
from malta.campaigns.studies import (
    ALL_PARAMETERS,
    Index,
    Sensitivity,
    Tolerances,
    indices_of,
    sensitivity,
    sobol_points,
    spread_of,
    tolerances,
)

BOX = ("m", "K_A", "K_B")
SHAKY = "design/gains/table2.json"
QUICK = ("--spread", "10%", "--option", "fidelity=force")


def shaky(samples: int, spread: float = 0.1, **options: object) -> Plan:
    box = dict.fromkeys(BOX, spread)
    return Plan(gains.read(SHAKY), "stroke", box, samples=samples, options={"fidelity": "force", **options})


@pytest.fixture(scope="module")
def found() -> Tolerances:
    plan = shaky(256)
    return tolerances(plan, limit_of(plan, "touchdown"), 0.97)


@pytest.mark.slow
def test_a_largest_spread_is_that_of_a_campaign(found: Tolerances) -> None:
    """The same machines: a campaign with that spread has that very yield, and with 3 % more spread a smaller one."""
    assert [spread.name for spread in found.spreads] == [*BOX, ALL_PARAMETERS]
    assert found.today == campaign(found.plan).rate
    assert found.today.share < 0.97
    alone, together = found.spreads[2], found.spreads[-1]
    for spread, names in ((alone, ("K_B",)), (together, BOX)):
        assert 0 < spread.factor < 1
        for factor, keeps in ((spread.factor, True), (1.03 * spread.factor, False)):
            box = {name: 0.1 * (factor if name in names else 1) for name in BOX}
            flown = campaign(replace(found.plan, spread=box)).rate
            assert (flown.share >= 0.97) is keeps
            assert not keeps or flown == spread.within
    assert spread_of(found, alone) == pytest.approx(0.1 * alone.factor)
    assert math.isnan(spread_of(found, together))


@pytest.mark.slow
def test_a_parameter_that_does_not_matter_may_spread_as_far_as_it_exists() -> None:
    plan = Plan(gains.read(SHAKY), "stroke", {"I_zz": 0.1}, samples=64, options={"fidelity": "force"})
    (spread,) = tolerances(plan, limit_of(plan, "touchdown"), 1.0).spreads
    assert spread.factor == spread.widest == pytest.approx(9.5)


@pytest.mark.slow
def test_a_yield_that_the_others_lose_has_no_spread() -> None:
    plan = shaky(64, 0.4)
    spreads = tolerances(plan, limit_of(plan, "touchdown"), 0.999).spreads
    assert [(spread.factor, spread.within) for spread in spreads[:-1]] == [(0.0, None)] * 3
    assert 0 < spreads[-1].factor < 1


@pytest.mark.parametrize(("gap", "monotone"), [((2.0, 9.0), True), ((2.0, 3.5), False)])
def test_a_yield_that_comes_back_is_reported(gap: tuple[float, float], monotone: bool) -> None:
    def keeps(factor: float) -> Rate | None:
        return None if gap[0] < factor < gap[1] else rate(99, 100)

    spread = tolerance.largest_spread("m", keeps, 6.0, None)
    assert spread.factor == pytest.approx(2.0, abs=6 / 6 / 2**7)
    assert spread.factor <= 2.0
    assert spread.monotone is monotone


@pytest.fixture(scope="module")
def indices() -> Sensitivity:
    plan = shaky(2048, 0.02, noise=0.0)
    return sensitivity(plan, limit_of(plan, "deviation-y1", 20e-6))


def test_the_mass_alone_decides_the_thrust(indices: Sensitivity) -> None:
    """F = m a with the same a: all of the variance is the mass's, and the attraction has none of it."""
    m, K_A, _ = indices.of_merits["largest thrust"]
    assert m.first == pytest.approx(1, abs=0.1)
    assert m.total == pytest.approx(1, abs=0.1)
    assert abs(K_A.total) < 1e-3
    assert indices.factors == BOX
    assert indices.runs == 256 * 5


def test_indices_are_shares(indices: Sensitivity) -> None:
    for listed in (indices.of_yield, *indices.of_merits.values()):
        for index in listed:
            assert -2 * index.first_half - 0.05 <= index.first
            assert index.first - index.first_half <= index.total + index.total_half + 0.05
    assert 0 < indices.within.share < 1
    assert indices.within.runs == 512
    assert len(indices.of_yield) == 3


def test_indices_of_the_ishigami_function() -> None:
    """sin x1 + 7 sin^2 x2 + 0.1 x3^4 sin x1 over -pi .. pi, about a mean of 1e6: its indices in closed form."""
    x = 2 * math.pi * sobol_points(3, 2**13, 1) - math.pi
    values = 1e6 + np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])
    found = indices_of(values, 2**13, 1)
    for index, first, total in zip(found, (0.3139, 0.4424, 0.0), (0.5576, 0.4424, 0.2437), strict=True):
        assert index.first == pytest.approx(first, abs=0.02)
        assert index.total == pytest.approx(total, abs=0.01)
        assert 0 < index.first_half < 0.06
    assert indices_of(np.ones_like(values), 2**13, 1) == ()


def test_indices_of_the_g_function() -> None:
    """Sobol's product of |4 x - 2| and factors: all orders interact; nine of ten intervals of 95 % contain theirs."""
    weight = np.array([0.0, 1.0, 4.5, 9.0])
    share = 1 / (3 * (1 + weight) ** 2)
    variance = np.prod(1 + share) - 1
    total = np.array([share[k] * np.prod(1 + np.delete(share, k)) for k in range(4)]) / variance
    inside = []
    for seed in range(10):
        x = sobol_points(4, 2**10, seed)
        values = np.prod((np.abs(4 * x - 2) + weight) / (1 + weight), axis=1)
        for k, index in enumerate(indices_of(values, 2**10, seed)):
            inside.append(abs(index.first - share[k] / variance) < index.first_half)
            inside.append(abs(index.total - total[k]) < index.total_half)
            assert index.first == pytest.approx(share[k] / variance, abs=0.06)
            assert index.total == pytest.approx(total[k], abs=0.06)
    assert np.mean(inside) >= 0.9


@pytest.mark.slow
def test_noise_is_a_factor() -> None:
    """Held still, where the machine barely matters, the noise of a run decides its largest deviation."""
    options = {"fidelity": "force", "duration": 0.02}
    plan = Plan(gains.read(SHAKY), "hold", {"m": 0.001}, samples=4096, options=options)
    found = sensitivity(plan, limit_of(plan, "touchdown"))
    assert found.factors == ("m", "noise")
    assert found.of_yield == ()
    m, noise = found.of_merits["deviation x1"]
    assert isinstance(noise, Index)
    assert noise.total > 0.9
    assert m.total < 0.1


@pytest.mark.slow
def test_the_commands(run: Run, tmp_path: Path) -> None:
    common = ("campaign", SHAKY, *QUICK, "--out", tmp_path)
    code, out, err = run(*common, "--samples", "512", "--study", "sensitivity")
    assert code == 0
    assert (
        err == "malta: figures that some runs have no value of, as they were not completed, have no indices\n"
    )
    assert "Total indices" in out
    assert max(map(len, out.splitlines()[:-2])) <= 100
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"campaign.json", "sobol_touchdown.json", "sobol_touchdown.png"}
    document = json.loads((tmp_path / "sobol_touchdown.json").read_text(encoding="utf-8"))
    assert set(document["yield"]) == {"m", "K_A", "K_B", "K_D", "noise"}


@pytest.mark.slow
def test_a_tolerance_by_command(run: Run, tmp_path: Path) -> None:
    common = (
        "campaign",
        SHAKY,
        *QUICK,
        "--samples",
        "64",
        "--out",
        tmp_path,
        "--study",
        "tolerances",
        "--keep",
        "90%",
    )
    code, out, err = run(*common)
    assert (code, err) == (0, "")
    assert "Largest spreads that keep 90 % without touchdown" in out
    document = json.loads(run(*common, "--json").out)
    assert document["wanted"] == 0.9
    assert document["spreads"]["K_B"]["within"]["share"] >= 0.9
    stored = json.loads((tmp_path / "tolerance_touchdown.json").read_text())["spreads"]
    assert {name.replace(" ", "_"): spread for name, spread in stored.items()} == document["spreads"]


def test_studies_of_nothing_are_refused() -> None:
    plan = shaky(64, 0.0)
    limit = limit_of(plan, "touchdown")
    with pytest.raises(malta.InputError, match="nothing that varies"):
        tolerances(plan, limit, 0.9)
    with pytest.raises(malta.InputError, match="a yield above 0"):
        tolerances(shaky(64), limit, 1.2)
    with pytest.raises(malta.InputError, match="nothing that varies"):
        sensitivity(plan, limit)
    with pytest.raises(malta.InputError, match="at least 80 for 3 factors"):
        sensitivity(shaky(64, noise=0.0), limit)
    assert np.isfinite(limit.severity(campaign(plan).batch)).all()
