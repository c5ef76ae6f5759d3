"""The ledger: complete, its verdicts follow from its numbers, and its numbers follow by another route."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.linalg import expm, solve_discrete_lyapunov

import malta
from malta import references
from malta.loops.sampled_loops import machine_loop
from malta.machines.tubular.experiments.disturbances import REST_SAMPLES
from malta.model.plants import plant_of
from malta.model.printed import PublishedFigure, half_of_last_digit, published_figure, published_value
from malta.report.ledger import Ledger, LedgerClaim
from malta.simulation.engine.compiled import compiler
from malta.simulation.experiments import AS_BUILT, step_wrench
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.units import in_unit
from malta_papers import ledger as claims
from malta_papers.ledger import Chance, Row, is_reproduced
from malta_papers.tubular import claims as tubular, quantities as tubular_evidence
from malta_papers.tubular.quantities import (
    EXPERIMENT_NAMES,
    SEEDS,
    TubularEvidence,
    is_solved_for_ratio,
    mean_of_seeds,
)

if TYPE_CHECKING:
    from conftest import Design

    from malta.machines.tubular.plant import Parameters

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

NAMES = ("table2", "calibrated")

# Published figures without a row of their own, and why.
INPUTS = {
    **dict.fromkeys(
        ("table_II.state", "table_II.input", "table_II.integral", "table_II.sensor_noise"),
        "what the designs are made of, see test_table_II_is_what_is_designed_with",
    ),
    "table_I.digits": "how the table is printed",
    "table_III.samples": "an input of the hold, see test_experiments",
    "table_III.mean": "chance over 0.1 s; that ours are as small is tested in test_experiments",
    "travel.z_ss": "an input: the range of the row on the poles over +-15 mm",
    "position_controller.uncertainty": "an input of both design files",
    "dc_link.speed": "an input of the row on the link's rise",
    "figure_1.shaft": "an input of the mover's first bending mode, see test_tubular_bending",
    "figure_12.stroke": "an input of the stroke, see test_experiments",
    "figure_14.resolution": "an input: the sensors' steps, see test_experiments",
    "figure_16.radius": "an input of the tilt, see test_experiments",
    "figure_16.frequency": "an input of the tilt, see test_experiments",
    "thermal.length": "an input of the row on the arm's growth",
    "thermal.strain": "an input of the row on the arm's growth",
}
TWINS = {"table_I.poles.y": "table_I.poles.x", "table_I.poles.beta": "table_I.poles.alpha"} | {
    f"table_II.process_noise.{name}": "table_II.process_noise.fx_B1" for name in ("fy_B1", "fx_B2", "fy_B2")
}
# one row for all of them


class Found(NamedTuple):
    """A ledger of both designs, made once, with what it was made from."""

    ledger: Ledger
    evidence: tuple[TubularEvidence, ...]
    shares: tuple[float, ...]
    values: dict[tuple[str, str], float]  # what `value` has computed: some rows bisect

    def claim(self, start: str) -> LedgerClaim:
        """The only claim whose subject begins so."""
        (claim,) = [c for c in self.ledger.claims if c.subject.startswith(start)]
        return claim

    def value(self, start: str, name: str) -> float:
        """What a row computes for a design, in the row's unit."""
        if (start, name) not in self.values:
            (row,) = [r for r in tubular.rows() if r.subject.startswith(start)]
            value = in_unit(row.value(self.evidence[NAMES.index(name)]), row.unit)
            self.values[start, name] = value
        return self.values[start, name]


@pytest.fixture(scope="module")
def found(designs: dict[str, Design], published: dict[str, Any]) -> Found:
    made: list[TubularEvidence] = []
    shares: list[float] = []
    compute = tubular.evidence

    def kept(*arguments: Any) -> TubularEvidence:
        made.append(compute(*arguments))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tubular, "evidence", kept)
        patch.setattr(tubular_evidence, "MACHINES", 256)
        patch.setattr(tubular_evidence, "LEARNERS", 3)
        ledger = malta.ledger([designs[name].spec for name in NAMES], published, shares.append)
    return Found(ledger, tuple(made), tuple(shares), {})


def _figures(table: Mapping[str, Any], above: str = "") -> Iterator[str]:
    """The dotted key of every number in the published data."""
    for key, entry in table.items():
        name = above + key
        if isinstance(entry, Mapping):
            yield from [name] if "value" in entry else _figures(entry, name + ".")
        elif isinstance(entry, int | float):
            yield name


# Complete


def test_every_published_figure_has_a_row(published: dict[str, Any]) -> None:
    figures = list(_figures(published))
    assert len(figures) > 70
    rows = {row.published for row in tubular.rows() if isinstance(row.published, str)}
    for key in figures:
        excepted = any(key == name or key.startswith(name + ".") for name in INPUTS)
        assert (TWINS.get(key, key) in rows) != excepted, key
    assert rows <= set(figures)
    for name in INPUTS:
        assert any(key == name or key.startswith(name + ".") for key in figures), f"{name} is no longer there"


def test_twins_are_one_figure(published: dict[str, Any], designs: dict[str, Design]) -> None:
    k = np.diag(designs["table2"].model.stiffness)
    for twin, row in TWINS.items():
        assert published_value(published, twin) == published_value(published, row)
    assert k[0] == pytest.approx(k[1], rel=1e-12)
    assert k[3] == pytest.approx(k[4], rel=1e-12)


def test_table_II_is_what_is_designed_with(published: dict[str, Any], designs: dict[str, Design]) -> None:
    for name in NAMES:
        spec = designs[name].spec
        for table, weights in (
            ("state", spec.weights.q),
            ("input", spec.weights.r),
            ("integral", spec.weights.q_i),
        ):
            assert weights.tolist() == list(published["table_II"][table].values())
        assert dict(spec.uncertainty) == published["position_controller"]["uncertainty"]
    sensors = [entry["value"] for entry in published["table_II"]["sensor_noise"].values()]
    assert designs["table2"].spec.weights.sensor_variance.tolist() == pytest.approx(sensors, rel=1e-12)


def test_rows_are_well_formed(published: dict[str, Any]) -> None:
    rows = tubular.rows()
    assert len({row.subject for row in rows}) == len(rows)
    for row in rows:
        assert row.relation in ("equal", "at most", "at least")
        assert row.note or not row.by_construction, row.subject  # which says by what
        assert row.form.format(1.0)
        assert math.isfinite(in_unit(1.0, row.unit))
        if isinstance(row.published, str):
            assert math.isfinite(published_value(published, row.published))


@pytest.mark.parametrize("machine", ["tubular", "halbach", "planar"])
def test_what_the_paper_calls_about_is_marked(machine: str) -> None:
    """`about` and no other words: the rule asks the file, not a text."""
    content = malta.model.read_published(f"data/{machine}.toml")
    for key in _figures(content):
        entry: Any = content
        for part in key.split("."):
            entry = entry[part]
        if not isinstance(entry, Mapping):
            continue
        assert set(entry) <= {"value", "unit", "about", "text", "digits"}, key
        assert entry.get("about", True) is True, key
        text = entry.get("text", "")
        assert not any(word in text.split() for word in ("about", "around", "approximately")), key


# Verdicts follow from numbers


def _row(relation: str = "equal", form: str = "{:.2f}", note: str = "", why: str = "") -> Row:
    return Row("a figure", form, lambda _: math.nan, 1.0, relation, note, why)


def _about(target: float) -> PublishedFigure:
    return PublishedFigure(target, 1e-3 * abs(target), about=True)


@pytest.mark.parametrize(
    ("off", "word", "about"),
    [
        (0.0, "reproduced", "reproduced"),
        (0.00099, "reproduced", "reproduced"),
        (0.00101, "within 1 %", "reproduced"),
        (0.0499, "within 5 %", "reproduced"),
        (0.0501, "within 6 %", "within 6 %"),
        (0.0599, "within 6 %", "within 6 %"),
        (0.1001, "within 11 %", "within 11 %"),
        (0.1999, "within 20 %", "within 20 %"),
        (0.2001, "not reproduced", "not reproduced"),
        (10.0, "not reproduced", "not reproduced"),
    ],
)
def test_only_an_about_is_5_percent_wide(off: float, word: str, about: str) -> None:
    """All others are as wide as half of their last printed digit, here a thousandth of them."""
    for target in (1.0, 400.0, 1e-6, -3.0):
        for sign in (1, -1):
            value = target * (1 + sign * off)
            assert claims.verdict_word(_row(), _about(target), value) == about
            assert claims.verdict_word(_row(), _about(target)._replace(about=False), value) == word


@pytest.mark.parametrize(
    ("entry", "half", "about"),
    [
        ({"value": 25.67, "unit": "N"}, 0.005, False),
        ({"value": 205, "unit": "N/m", "about": True}, 0.5, True),
        ({"value": 2.62e-5, "unit": "V"}, 0.5e-7, False),
        ({"value": 1e-4, "unit": "A"}, 0.5e-4, False),
        ({"value": 16.2, "unit": "ms"}, 0.05e-3, False),
        ({"value": 300, "unit": "percent"}, 0.5e-2, False),
        ({"value": 0.0, "unit": "um", "digits": 2}, 0.5e-8, False),
        ({"value": -0.003, "unit": "urad"}, 0.5e-9, False),
    ],
)
def test_printed_digits_are_those_of_the_file(entry: dict[str, Any], half: float, about: bool) -> None:
    found = published_figure({"some": {"figure": entry}}, "some.figure")
    assert found.value == published_value({"some": {"figure": entry}}, "some.figure")
    assert found.half == pytest.approx(half, rel=1e-12)
    assert found.about == about


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        (
            {"value": math.nan, "unit": "N"},
            "data/published: some.figure: found nan in N, expected a number with a unit",
        ),
        ({"value": math.inf, "unit": "N"}, "found inf in N"),
        ({"value": True, "unit": "N"}, "found True in N"),
        (
            {"value": 2.0, "unit": "N", "digits": "2"},
            "some.figure.digits: found '2', expected decimals, at most 20",
        ),
        ({"value": 2.0, "unit": "N", "digits": 400}, "found 400"),
    ],
)
def test_a_figure_that_is_none_is_refused(entry: dict[str, Any], sentence: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        published_value({"some": {"figure": entry}}, "some.figure")
    assert sentence in str(caught.value)


@pytest.mark.parametrize(
    ("shown", "target", "printed", "half"),
    [
        ("±{:.2f} rad/s", 218.92, "±218.92", 0.005),
        ("{:.0e} urad", 3e-12, "0.000003", 5e-7),
        ("{:.1f} deg", math.pi / 2, "90.0", 0.05),
        ("proven percent", 3.0, "300", 0.5),
        ("{:.0f}", -4.0, "-4", 0.5),
        ("{:.2f} um", 0.0, "0.00", 0.005),
    ],
)
def test_what_the_text_implies_has_the_digits_that_are_shown(
    shown: str, target: float, printed: str, half: float
) -> None:
    row = Row("a figure", shown, lambda _: math.nan, target)
    figure, text = claims._print_published(row, {})
    assert text == printed
    assert figure.half == pytest.approx(half)


def test_digits_of_a_table_hold_for_its_figures(published: dict[str, Any]) -> None:
    assert published_figure(published, "table_I.poles.z") == PublishedFigure(0.0, 0.005)


def test_a_figure_of_chance_agrees_within_its_interval() -> None:
    target = PublishedFigure(0.3883, 0.5e-4)
    for value, half, agrees in ((0.38, 0.01, True), (0.38, 0.001, False), (0.40, 0.011, False)):
        assert is_reproduced(target, Chance(value, half)) == agrees
        assert not is_reproduced(target, value)


@given(value=st.floats(-1e3, 1e3), target=st.floats(-1e3, 1e3))
def test_at_most_is_at_most(value: float, target: float) -> None:
    for relation, sign in (("at most", 1), ("at least", -1)):
        word = claims.verdict_word(_row(relation), PublishedFigure(sign * target, 0.05), sign * value)
        assert word.startswith("not reproduced") == (value > target)
        assert (word == "reproduced") == (
            value <= target and is_reproduced(PublishedFigure(target, 0.05), value)
        )


@pytest.mark.parametrize(
    ("relation", "bound", "value", "word"),
    [
        ("at most", 0.83, 0.043, "smaller, x 19"),
        ("at most", 0.83, 0.0868, "smaller, x 9.6"),
        ("at most", 0.83, 0.826, "reproduced"),
        ("at most", 0.83, 0.82, "smaller, x 1.02"),
        ("at most", 0.83, 0.0, "smaller, x > 1000"),
        ("at most", 0.83, -0.02, "on the other side of zero"),
        ("at most", 4.0, 12.3, "not reproduced: larger, x 3.1"),
        ("at most", 4.0, 4.002, "not reproduced: larger, x 1.01"),
        ("at least", 6.08, 380.0, "larger, x 62"),
        ("at least", -0.081, -0.004, "smaller, x 20"),
        ("at least", -0.003, -0.805, "not reproduced: larger, x 268"),
        ("at least", 0.2, 0.1, "not reproduced: smaller, x 2.0"),
    ],
)
def test_a_bound_says_how_far_it_is(relation: str, bound: float, value: float, word: str) -> None:
    assert claims.verdict_word(_row(relation), PublishedFigure(bound, 0.005), value) == word


@pytest.mark.parametrize(
    ("relation", "value", "word"),
    [
        ("equal", 1.0, "by construction"),
        ("equal", 1.01, "by construction, within 1 %"),
        ("equal", 1.12, "by construction, within 12 %"),
        ("equal", 1.3, "not reproduced"),
        ("at most", 0.5, "by construction"),
        ("at most", 1.5, "not reproduced: larger, x 1.5"),
        ("equal", math.nan, "not reproduced"),
    ],
)
def test_what_is_so_by_construction_still_has_to_agree(relation: str, value: float, word: str) -> None:
    assert claims.verdict_word(_row(relation), ONE, value, by_construction=True) == word


def test_what_is_beside_is_not_compared() -> None:
    for value in (1e-9, 1.0, 1e9):
        assert claims.verdict_word(_row("beside"), ONE, value, by_construction=True) == "not compared"


@given(digits=st.integers(0, 4), value=st.floats(0, 1e4), target=st.floats(0, 1e4))
def test_equal_is_every_printed_digit(digits: int, value: float, target: float) -> None:
    """Ours, rounded to the digits printed, is the figure; a tie may go either way."""
    text = f"{target:.{digits}f}"
    printed = PublishedFigure(float(text), half_of_last_digit(text))
    off = abs(value - printed.value) / printed.half
    if abs(off - 1) > 1e-6:
        assert (claims.verdict_word(_row(), printed, value) == "reproduced") == (off < 1)
        assert (f"{value:.{digits}f}" == text) == (off < 1)
    assert claims.verdict_word(_row(), printed, target) == "reproduced"


@pytest.mark.parametrize("relation", ["at most", "equal"])
def test_what_was_not_reached_is_not_reproduced(relation: str) -> None:
    """NaN: the stroke of a run that touched down has no rise."""
    assert claims.verdict_word(_row(relation), ONE, math.nan) == "not reproduced"


ONE = PublishedFigure(1.0, 0.005)


def _judge(row: Row, values: Sequence[float], built: Sequence[bool] = (False,) * 3) -> str:
    """The verdict on figures of designs a, b, c, whose published value is 1.00."""
    words = [
        claims.verdict_word(row, ONE, v, by_construction=one) for v, one in zip(values, built, strict=False)
    ]
    return claims.verdict_of(row, words, "abc"[: len(values)])


def test_the_verdict_of_several_designs() -> None:
    def verdict(*values: float, note: str = "", why: str = "") -> str:
        return _judge(_row(note=note, why=why), values)

    assert verdict(1.0, 1.004) == "reproduced"
    assert verdict(1.0, note="read so") == "reproduced; read so"
    assert verdict(1.0, 1.004, note="read so", why="bad") == "reproduced; read so"  # no reason is needed
    assert verdict(1.04, note="so", why="so") == "within 4 %; so"
    assert verdict(2.0, 3.0, why="bad") == "not reproduced; bad"
    assert verdict(1.0, 2.0, why="bad") == "a: reproduced; b: not reproduced; bad"
    assert verdict(1.1, 1.15, why="bad") == "a: within 10 %; b: within 15 %; bad"
    assert verdict(1.0, 1.1, 2.0, note="so", why="bad") == (
        "a: reproduced; b: within 10 %; c: not reproduced; so; bad"
    )
    assert verdict(math.nan, 1.0) == "a: not reproduced; b: reproduced"
    built = _judge(_row(note="so"), (1.0, 1.0, 2.0), (True, False, True))
    assert built == "a: by construction; b: reproduced; c: not reproduced; so"

    def bound(*values: float) -> str:
        return _judge(_row("at most"), values)

    assert bound(0.5, 0.125) == "smaller, x 2.0, x 8.0"
    assert bound(0.5, 0.996) == "a: smaller, x 2.0; b: reproduced"
    assert bound(4.0, 2.0) == "not reproduced: larger, x 4.0, x 2.0"
    assert bound(0.5, 2.0) == "a: smaller, x 2.0; b: not reproduced: larger, x 2.0"


@pytest.mark.parametrize(
    ("verdicts", "word"),
    [
        (["reproduced"], "reproduced"),
        (["reproduced", "within 7 %"], "near"),
        (["smaller, x 19", "reproduced"], "kept"),
        (["on the other side of zero"], "kept"),
        (["by construction", "by construction, within 7 %"], "input"),
        (["by construction", "reproduced"], "reproduced"),
        (["not compared"], "beside"),
        (["not reproduced", "not reproduced: larger, x 3.1"], "differs"),
        (["not reproduced", "by construction"], "partly"),
    ],
)
def test_a_claim_has_one_word(verdicts: list[str], word: str) -> None:
    assert claims.word_of(verdicts) == word


def test_only_designs_that_are_meant_to_reproduce_a_paper_are_judged(published: dict[str, Any]) -> None:
    """The figures of the others stand there; of the machine alone, of inputs and beside, any design is judged."""
    found: Any = [
        SimpleNamespace(spec=SimpleNamespace(name=name, kind="LQG")) for name in ("table2", "robust")
    ]
    values = {"table2": 16.2e-3, "robust": 20e-3}
    row = Row("rise", "{:.1f} ms", lambda e: values[e.spec.name], "figure_12.rise_time", why="so")

    def claim(names: Sequence[str], meant: Sequence[str] = ("table2",), **changes: Any) -> tuple[str, str]:
        chosen = [e for e in found if e.spec.name in names]
        line = claims.claim_of(row._replace(**changes), chosen, published, meant)
        assert line.ours == tuple(f"{1e3 * values[name]:.1f}" for name in names)
        return line.verdict, line.word

    assert claim(["table2", "robust"]) == ("reproduced", "reproduced")
    assert claim(["robust"], note="noted") == ("of another design; noted", "other")
    assert claim(["robust"], of_machine=True) == ("not reproduced; so", "differs")
    assert claim(["robust"], by_construction=True) == ("not reproduced; so", "differs")
    assert claim(["robust"], relation="beside") == ("not compared", "beside")
    assert claim(["table2", "robust"], designs=("robust",)) == ("not reproduced; so", "differs")
    assert claim(["table2", "robust"], ("table2", "robust"))[1] == "partly"


@pytest.mark.slow
def test_a_claim_shows_its_figures(found: Found, published: dict[str, Any]) -> None:
    values = iter([16.2e-3, math.nan, 17e-3, 17e-3])

    def claim(**changes: Any) -> LedgerClaim:
        row = Row("rise", "{:.2f} ms", lambda _: next(values), "figure_12.rise_time")
        return claims.claim_of(row._replace(**changes), found.evidence, published, NAMES)

    assert claim() == LedgerClaim(
        "rise [ms]", "16.2", ("16.20", "–"), "table2: reproduced; calibrated: not reproduced", "partly"
    )
    at_most = claim(relation="at most", published="figure_13.radial_deviation", shown="{:.0f} um")
    assert at_most == LedgerClaim(
        "rise [µm]", "≤ 20", ("17000", "17000"), "not reproduced: larger, x 850", "differs"
    )
    values = iter([0.5, 0.25] * 3)
    assert claim(published=None, shown="{:.2f} percent", note="so") == LedgerClaim(
        "rise [%]", "–", ("50.00", "25.00"), "ours: so", "ours"
    )
    assert claim(published=0.5, shown="±{:.1f}") == LedgerClaim(
        "rise", "±0.5", ("±0.5", "±0.2"), "table2: reproduced; calibrated: not reproduced", "partly"
    )
    assert claim(published=None, shown="{:.2f} deg").ours == (
        f"{math.degrees(0.5):.2f}",
        f"{math.degrees(0.25):.2f}",
    )


@pytest.mark.slow
def test_a_figure_that_is_not_published_is_missed(found: Found) -> None:
    row = next(r for r in tubular.rows() if r.published == "figure_12.rise_time")
    with pytest.raises(malta.InputError) as caught:
        claims.claim_of(row, found.evidence, {"figure_12": {}}, NAMES)
    assert (caught.value.where, caught.value.field) == ("data/published", "figure_12.rise_time")


def test_designs_of_another_machine_are_refused(
    published: dict[str, Any], designs: dict[str, Design]
) -> None:
    other: Any = SimpleNamespace(plant=SimpleNamespace(name="rotary"), path=Path("design/rotary.toml"))
    with pytest.raises(malta.InputError) as caught:
        malta.ledger([designs["table2"].spec, other], published)
    error = caught.value
    assert str(error).isprintable()
    assert (error.where, error.field, error.found) == ("design/rotary.toml", "machine", "rotary")
    with pytest.raises(malta.InputError, match=r"expected one of .*tubular.* that has claims"):
        malta.ledger([other], published)


# The ledger as it stands


@pytest.mark.slow
def test_the_table_has_a_line_for_each_claim(found: Found) -> None:
    assert (found.ledger.machine, found.ledger.designs) == ("tubular", NAMES)
    lines = found.ledger.markdown().split("\n")
    assert lines.pop() == ""
    assert len(lines) == len(found.ledger.claims) + 2 == len(tubular.rows()) + 2
    assert {line.count("|") for line in lines} == {len(NAMES) + 4}
    assert lines[0] == "| claim | published | `table2` | `calibrated` | verdict |"
    assert set(lines[1]) == {"|", "-"}
    for line, claim in zip(lines[2:], found.ledger.claims, strict=True):
        assert line.startswith(f"| {claim.subject} | ")
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        assert cells == [claim.subject, claim.published, *claim.ours, claim.verdict]
        assert all(cells)
        assert line.isprintable()


@pytest.mark.slow
def test_the_work_is_told(found: Found) -> None:
    shares = found.shares
    assert list(shares) == sorted(shares)
    assert 0 < shares[0] < 0.2
    assert shares[-1] == pytest.approx(1.0)


@pytest.mark.slow
def test_a_reason_stands_beside_whatever_is_not_reproduced(found: Found) -> None:
    rows = {row.subject: row for row in tubular.rows()}
    for claim in found.ledger.claims:
        row = next(r for s, r in rows.items() if claim.subject.startswith(s + " [") or claim.subject == s)
        if "not reproduced" in claim.verdict:
            assert row.why, claim.subject
        if "not reproduced" in claim.verdict or "within " in claim.verdict.partition("; ")[0]:
            assert claim.verdict.endswith(row.why)
        if row.published is None:
            assert claim.published == "–"
            assert claim.verdict.startswith("ours: ")


BOTH, FIRST, SECOND = (
    "reproduced",
    "calibrated: not reproduced",
    "table2: not reproduced; calibrated: within ",
)
BUILT, SOLVED = "by construction; ", "table2: not reproduced; calibrated: by construction"
VERDICTS: dict[str, str | tuple[str, ...]] = {
    "poles of x, y": BUILT,
    "poles of alpha, beta": BUILT,
    "poles of z": BUILT,
    "change of the poles": "smaller, x 1.9; ",
    "LQR: stiffness over attraction": SOLVED,
    "LQR: share of the 20 % box": SOLVED,
    "bandwidth: last −3 dB": "table2: within 13 %; " + FIRST,
    "bandwidth: last 0 dB": SECOND,
    "bandwidth: regulator's fastest": SECOND,
    "current loops: crossover": BUILT,
    "current loops: phase margin": BUILT,
    "DC link": BUILT,
    "stroke: rise": "table2: by construction, within 1 %; calibrated: by construction, within 3 %; ",
    "stroke: overshoot": "smaller, x 6.7, x > 1000",
    "stroke: axial error": "smaller, x 7.2, x 7.0",
    "stroke: radial deviation": "smaller, x 8.2, x 57",
    "stroke: deviation of x1": BUILT,
    "stroke: f/i": BUILT,
    "stroke, cogging not compensated: rise": SOLVED,
    "stroke, cogging not compensated: error": "table2: not reproduced: larger, x 9.0; calibrated: smaller, x 3.1",
    "weight carried": "within 9 %; ",
    "at rest: x1": "table2: by construction, within ",
    "at rest, current sensors noisy: x1": "not reproduced; ",
    "tilt: SP2 deviates": "table2: not reproduced: larger, x 1.7; calibrated: by construction; ",
    "tilt: SP2, attraction": "smaller, x ",
    "thermal: growth": BUILT,
    "at rest: z measured": "by construction, within 3 %; ",
    "at rest: y1 measured": (
        "by construction, within 2 %; ",
        "table2: by construction, within 3 %; calibrated: by",
    ),
    "payload picked": "table2: not reproduced: smaller, x 1.7; calibrated: larger, x 5.3; ",
}


@pytest.mark.slow
def test_what_a_design_was_solved_for_is_found_by_its_bases(found: Found) -> None:
    """K1 / k = 4 of other bases would be a finding; of bases that were solved for 4 it is none."""
    first, second = found.evidence
    assert (is_solved_for_ratio(first), is_solved_for_ratio(second)) == (False, True)
    weights = second.spec.weights
    stiffer: Any = SimpleNamespace(kind="LQG", weights=replace(weights, q_base=weights.q_base * 0.99))
    assert not is_solved_for_ratio(replace(second, spec=stiffer))


@pytest.mark.slow
@pytest.mark.parametrize("start", list(VERDICTS))
def test_the_verdicts(found: Found, start: str) -> None:
    assert found.claim(start).verdict.startswith(
        VERDICTS[start]
    )  # of a tuple, any: noise follows the rounding


# The figures by another route


@pytest.mark.slow
def test_poles_by_hand(found: Found, par: Parameters) -> None:
    """sqrt(2 K_A / m), sqrt(2 K_A l_B^2 / I_xx); and Table IV's K_A as the note has it."""
    x, alpha = (math.sqrt(2 * par.K_A * arm) for arm in (1 / par.m, par.l_B**2 / par.I_xx))
    assert found.claim("poles of x, y").ours == (f"±{x:.2f}",) * 2 == ("±218.92",) * 2
    assert found.claim("poles of alpha").ours == (f"±{alpha:.2f}",) * 2 == ("±157.53",) * 2
    assert found.claim("poles of z").ours == ("±0.00",) * 2
    assert f"{math.sqrt(2 * 8330 / par.m):.2f}" in found.claim("poles of x, y").verdict
    # Off the middle (l_B^2 + z^2) and -z couple the two: the product of the poles stays, their sum grows.
    k, arm, z = 2 * par.K_A, par.l_B**2 + par.z_max**2, par.z_max
    S = np.array([[k / par.m, -k * z / par.m], [-k * z / par.I_xx, k * arm / par.I_xx]])
    largest = math.sqrt(np.linalg.eigvals(S).real.max())
    for name in NAMES:
        assert found.value("change of the poles", name) == pytest.approx(100 * (largest / x - 1), rel=1e-6)


@pytest.mark.slow
def test_the_stiffness_ratio_is_the_scalar_riccati_equations(found: Found) -> None:
    """K1 / k = 1 + sqrt(1 + q / (r_eff k^2)) with k = 2 K_A, r_eff = r / 2, whatever the rate weighs."""
    for name, expected in zip(NAMES, (2.0, 4.0), strict=True):
        spec = found.evidence[NAMES.index(name)].spec
        par: Any = spec.parameters
        q = spec.weights.q[0] / spec.weights.q_base[0] ** 2
        r = spec.weights.r[0] / spec.weights.r_base[0] ** 2 / 2
        by_hand = 1 + math.sqrt(1 + q / (r * (2 * par.K_A) ** 2))
        assert found.value("LQR: stiffness over attraction", name) == pytest.approx(by_hand, rel=1e-6)
        assert by_hand == pytest.approx(expected, abs=5e-4)


@pytest.mark.slow
def test_the_full_state_share_follows_from_the_ratio(found: Found) -> None:
    """Stable while (1 - s) K1 > (1 + s) k: the corner s = (n - 1) / (n + 1) is n = 2: 167 %, n = 4: 300 % of 20 %."""
    for name, expected in zip(NAMES, ("166.66", "299.99"), strict=True):
        n = found.value("LQR: stiffness over attraction", name)
        by_hand = 100 * (n - 1) / (n + 1) / 0.2
        assert found.value("LQR: share of the 20 % box", name) == pytest.approx(by_hand, rel=1e-4)
        assert found.claim("LQR: share").ours[NAMES.index(name)] == expected


def _radius(design: Design, share: float) -> float:
    """Spectral radius of the sampled loop, its matrices written out: mass and attraction up, bearing force down by a
    share of 20 %; hold, current loops as lags, one sample of delay, filter, integrals."""
    c, h = design.controller, design.controller.sample_time
    par: Any = design.spec.parameters
    K_A, weaker, l_B, l_S = par.K_A * (1 + 0.2 * share), 1 - 0.2 * share, par.l_B, par.l_S
    inertia = np.array([par.m * (1 + 0.2 * share)] * 3 + [par.I_xx] * 2)[:, None]
    V = [[1, 0, 1, 0, 0], [0, 1, 0, 1, 0], [0, 0, 0, 0, 1], [0, l_B, 0, -l_B, 0], [-l_B, 0, l_B, 0, 0]]
    A, B = np.zeros((15, 15)), np.zeros((15, 5))
    A[:5, 5:10] = np.eye(5)
    A[5:10, :5] = np.diag([1, 1, 0, l_B**2, l_B**2]) * 2 * K_A / inertia
    A[5:10, 10:] = V / inertia
    A[10:, 10:], B[10:] = -par.w_cc * np.eye(5), par.w_cc * np.diag([weaker] * 4 + [1.0])
    held = expm(np.vstack([np.hstack([A, B]), np.zeros((5, 20))]) * h)
    C = np.zeros((5, 15))
    C[:, :5] = [[1, 0, 0, 0, -l_S], [0, 1, 0, l_S, 0], [1, 0, 0, 0, l_S], [0, 1, 0, -l_S, 0], [0, 0, 1, 0, 0]]
    kept = np.eye(10) - c.L @ c.Cd
    v_y, v_xi, v_e = -c.K @ c.L - h * c.Ki, -c.K @ kept, c.Ki  # of y, xi_pred and e
    rows: Any = [
        [held[:15, :15], held[:15, 15:], np.zeros((15, 10)), np.zeros((15, 5))],
        [v_y @ C, np.zeros((5, 5)), v_xi, v_e],
        [(c.Ad @ c.L + c.Bd @ v_y) @ C, np.zeros((10, 5)), c.Ad @ kept + c.Bd @ v_xi, c.Bd @ v_e],
        [-h * C, np.zeros((5, 5)), np.zeros((5, 10)), np.eye(5)],
    ]
    return float(np.abs(np.linalg.eigvals(np.block(rows))).max())


WITHOUT_COGGING = 33.43  # %, of table2


@pytest.mark.slow
def test_the_share_on_the_machine_by_hand(found: Found, designs: dict[str, Design]) -> None:
    """33 and 163 %: the largest eigenvalue of matrices written out leaves the unit circle there, m, K_A up, K_B down.

    The matrices have current loops as lags. In table2 the mode that leaves is at rest, in `calibrated` at 96 rad/s,
    where lags differ from PI loops by half a percent of the box.
    """
    assert found.value("the same, sampled, with observer", NAMES[0]) == 0.0  # under its cogging
    for name, expected in zip(NAMES, (WITHOUT_COGGING, 162.78), strict=True):
        share = max(found.value("the same, sampled, with observer", name), WITHOUT_COGGING) / 100
        assert _radius(designs[name], 0.98 * share) < 1 < _radius(designs[name], 1.02 * share)
        assert 100 * share == pytest.approx(expected, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ["force", "dq"])
@pytest.mark.parametrize(("beyond", "grows"), [(0.93, False), (1.1, True)])
def test_the_share_on_the_machine_simulated(
    found: Found, designs: dict[str, Design], fidelity: Any, beyond: float, grows: bool
) -> None:
    """Inside, 0.1 um off centre decays; outside it grows, with windings as with lags: no fast mode leaves."""
    for name, design in designs.items():
        share = beyond * max(found.value("the same, sampled, with observer", name), WITHOUT_COGGING) / 100
        par: Any = design.spec.parameters
        up, down = 1 + 0.2 * share, 1 - 0.2 * share
        corner = replace(par, m=par.m * up, K_A=par.K_A * up, K_B=par.K_B * down, g=0.0, F_c=0.0)
        alone = replace(design.controller.feedforward, v0=0 * design.controller.feedforward.v0)
        start = {"x": 1e-7, "beta": 1e-6}
        scenario = Scenario("corner", 1.0, references.hold, start, fidelity=fidelity)
        run = simulate(plant_of(corner), replace(design.controller, feedforward=alone), scenario)
        size = np.abs(run.p[:, [0, 2]]).max(axis=1)
        early, late = size[5000:10_000].max(), size[15_000:].max()
        assert run.verdict.completed
        assert (late > 1.5 * early) == grows
        assert (late < early / 1.5) != grows


@pytest.mark.slow
def test_bandwidths_are_where_the_loop_has_them(found: Found, designs: dict[str, Design]) -> None:
    for name, design in designs.items():
        stage = machine_loop(design.model, design.controller)
        w_T, w_L = (found.value(f"bandwidth: last {kind} dB", name) for kind in ("−3", "0"))
        around = np.array([0.97, 1.0, 1.03])
        T = np.linalg.svd(np.eye(5) - stage.sensitivity(w_T * around), compute_uv=False)[:, 0]
        L = np.linalg.svd(stage.loop_gain(w_L * around), compute_uv=False)[:, 0]
        assert T[0] > math.sqrt(0.5) > T[2]
        assert L[0] > 1 > L[2]
        beyond = np.geomspace(1.03, 20, 60)
        later = np.linalg.svd(np.eye(5) - stage.sensitivity(w_T * beyond), compute_uv=False)[:, 0]
        assert later.max() < math.sqrt(0.5)
        # K1 of the regulator with integrals, less what pulls, over the mass.
        K = design.controller.K
        inertial = np.diag(design.model.force_map @ K[:, :5] - design.model.stiffness)
        assert found.value("bandwidth: regulator's fastest", name) == pytest.approx(
            math.sqrt(inertial.max()), rel=1e-6
        )


@pytest.mark.slow
def test_the_peak_sensitivity_is_on_the_circle_that_it_should_be(
    found: Found, designs: dict[str, Design]
) -> None:
    for name, design in designs.items():
        w = np.geomspace(0.1, 2e4, 4000)
        S = machine_loop(design.model, design.controller).sensitivity(w)
        peaks = np.abs(np.einsum("kii->ki", S)).max(axis=0)
        peak = found.value("peak sensitivity", name)
        assert peaks.max() == pytest.approx(peak, rel=2e-3)
        assert int(peaks.argmax()) == {"table2": 4, "calibrated": 1}[name]  # z, y1
        assert (peak < 3) == (name == "calibrated")


@pytest.mark.slow
def test_current_loops_by_hand(found: Found, designs: dict[str, Design]) -> None:
    """|Kp - j Ki / w| = |R + j w L| at the crossover; the phase there, with the dead time that was designed for."""
    for name, dead_time in zip(NAMES, (0.0, 75e-6), strict=True):
        par: Any = designs[name].spec.parameters
        loop = designs[name].controller.current_loop
        assert loop is not None
        Kp, Ki = loop.Kp, loop.Ki
        w = found.value("current loops: crossover", name)
        assert math.hypot(Kp, Ki / w) == pytest.approx(math.hypot(par.R, w * par.L), rel=1e-9)
        phase = -math.atan2(Ki / w, Kp) - math.atan2(w * par.L, par.R) - w * dead_time
        assert found.value("current loops: phase margin", name) == pytest.approx(180 + math.degrees(phase))
        assert w == pytest.approx(3000, rel=1e-6)
    assert found.claim("current loops: phase margin").ours == ("60.0", "60.0")


def test_the_current_sensors_noise_is_that_of_table_II(published: dict[str, Any]) -> None:
    """The data's 13.8 mA by another route: Lyapunov's equation of a sampled PI loop with a sample of delay."""
    par, law = (
        malta.read("data/tubular.toml", "table1_currents"),
        malta.gains.read("design/gains/calibrated.json"),
    )
    loop, h = law.current_loop, law.sample_time
    assert loop is not None
    pole, Kp, Ki = math.exp(-par.R * h / par.L), loop.Kp, loop.Ki * h
    # Current, sum of errors and the voltage that waits; n is the noise of the reading.
    A = np.array([[pole, 0, (1 - pole) / par.R], [-Ki, 1, 0], [-Kp - Ki, 1, 0]])
    P = solve_discrete_lyapunov(A, np.outer([0, Ki, Kp + Ki], [0, Ki, Kp + Ki]))
    reads = math.sqrt(1 + P[0, 0])
    assert reads == pytest.approx(1.055, abs=5e-4)
    # (16): 2/3 cos around and along the machine, 1/3 for the zero sequence: 2/3 and sqrt(2)/3 of a phase's noise.
    printed = published["table_II"]["process_noise"]
    bearing = math.sqrt(printed["fx_B1"]["value"]) / par.K_B / (2 / 3 * reads)
    thrust = math.sqrt(printed["f_D"]["value"]) / (2 * par.K_D) / (math.sqrt(2) / 3 * reads)
    assert par.s_i == pytest.approx(bearing, rel=2e-3)
    assert par.s_i == pytest.approx(thrust, rel=0.02)
    evidence: Any = SimpleNamespace(spec=malta.read_design("design/calibrated.toml"), controller=law)
    for axis, modules, one in (("dd", 0, par.K_B * 2 / 3), ("0q", 2, 2 * par.K_D * math.sqrt(2) / 3)):
        found = tubular_evidence.current_reading(axis, modules, evidence)
        assert found == pytest.approx((one * reads * par.s_i) ** 2, rel=1e-4)


def test_cogging_of_two_modules_by_hand() -> None:
    """sin at both modules' middles, summed: near six poles apart 98 % are left, at 5.5 and 6.5 poles nothing."""
    par: Any = malta.read("data/tubular.toml")
    z = np.linspace(0, par.L_p, 400)

    def left(distance: float) -> float:
        both = sum(np.sin(2 * np.pi * (z + side * distance / 2) / par.L_p) for side in (-1, 1))
        return float(np.abs(both).max() / 2)

    evidence: Any = SimpleNamespace(spec=malta.read_design("design/table2.toml"))
    assert tubular_evidence.cogging_share(evidence) == pytest.approx(left(2 * par.l_B), abs=1e-4)
    assert left(2 * par.l_B) == pytest.approx(0.98, abs=5e-3)
    assert max(left(82.5e-3), left(97.5e-3)) < 1e-9


@pytest.mark.slow
def test_the_fastest_of_the_stroke_is_that_of_the_sigmoid(found: Found) -> None:
    """Fig. 12(c): 2 ln 9 / 16.2 ms times a quarter of 10 mm, and what a loop makes of it."""
    sigmoid = 10e-3 / 4 * 2 * math.log(9) / 16.2e-3
    assert sigmoid == pytest.approx(0.678, abs=1e-3)
    for name in NAMES:
        assert found.value("stroke: largest speed", name) == pytest.approx(sigmoid, rel=0.03)


def test_table_III_with_noisy_currents_decides_for_the_stiffer_design(published: dict[str, Any]) -> None:
    """13.8 mA in each phase: `calibrated` reads a third more than Table III, `robust` 9 % more at most."""
    over = {}
    for name in ("calibrated", "robust"):
        law = malta.gains.read(f"design/gains/{name}.json")
        plant = tubular_evidence.with_noise_of_currents(plant_of(law.parameters))
        rests = tubular_evidence.rests_of_seeds(plant, law, range(4))
        printed = published["table_III"]["std"]
        over[name] = [
            1e6 * rests[f"measured {k}, std"] / printed[k]["value"] - 1 for k in ("x1", "y1", "x2", "y2")
        ]
    assert np.mean(over["calibrated"]) > 0.2
    assert min(over["calibrated"]) > 0.1
    assert max(map(abs, over["robust"])) < 0.13


@pytest.mark.slow
def test_the_link_by_hand(found: Found) -> None:
    """0.5 * 0.36 kg * (5 m/s)^2 = 4.5 J into 88 mF at 45 V: 1.12 V; the linear estimate E / (C V) is 1.14 V."""
    rise = math.sqrt(45**2 + 2 * 4.5 / 88e-3) - 45
    assert found.claim("DC link").ours == (f"{rise:.2f}",) * 2 == ("1.12",) * 2
    assert pytest.approx(1.136, abs=5e-4) == 4.5 / (88e-3 * 45)


@pytest.mark.slow
def test_what_the_notes_say_is_so(found: Found, designs: dict[str, Design]) -> None:
    par: Any = designs["table2"].spec.parameters
    assert f"{2 * math.pi / par.L_p * par.F_c:.0f} N/m" in found.claim("1 N along z").verdict
    assert par.F_c == 0.5
    weight = found.claim("weight carried")
    assert weight.ours == (f"{par.m * par.g:.2f}",) * 2 == ("3.53",) * 2
    for evidence in found.evidence:  # statics at z = 5 mm: (l_B + z) / (2 l_B) of it on module 2
        v = evidence.experiments["stroke"].run.v[-1]
        assert v[3] / (v[1] + v[3]) == pytest.approx((par.l_B + 5e-3) / (2 * par.l_B), rel=0.02)
    assert found.claim("thermal: growth").ours == ("65", "65")
    for name in NAMES:
        for sensor in ("x1", "y1", "x2", "y2"):
            published = {"x1": 0.3883, "y1": 0.5579, "x2": 0.4827, "y2": 0.4956}[sensor]
            near = 0.05 if name == "calibrated" else 0.35  # slow integrals: not in the middle of a step
            assert found.value(f"at rest: {sensor}", name) == pytest.approx(published, rel=near)
        assert found.value("at rest: z", name) == pytest.approx(par.s_z * 1e6, rel=0.05)
        assert found.value("at rest: radial", name) < 0.8 * par.s_r * 1e6


@pytest.mark.slow
def test_the_slowest_radial_pole_is_among_the_regulators(found: Found) -> None:
    for name, evidence in zip(NAMES, found.evidence, strict=True):
        slowest = found.value("slowest radial pole", name)
        assert np.abs(evidence.margins.poles.regulator.real - slowest).min() < 1e-6 + 1e-6 * abs(slowest)
        assert slowest < 0
    assert found.value("slowest radial pole", "table2") == pytest.approx(-0.0010, abs=5e-5)
    # Minutes in table2; in `calibrated`, whose bases make them count, a sixth of a second.
    assert 60 < -1 / found.value("slowest radial pole", "table2") < 3600
    assert -1 / found.value("slowest radial pole", "calibrated") < 0.2


@pytest.mark.slow
def test_cogging_pushes_a_soft_axis_aside(found: Found) -> None:
    """F_c |sin| at 5 mm is 0.43 N: `calibrated` yields to it by a sixth of a millimetre, table2 beyond its stops."""
    held = 0.5 * abs(math.sin(2 * math.pi * 5 / 15))
    for name in NAMES:
        sag = held * found.value("1 N along z", name)  # mm
        error = found.value("stroke, cogging not compensated: error", name)
        with_v0 = found.value("stroke: axial error", name)
        if name == "calibrated":
            assert 0.1 < sag < 0.2
            assert with_v0 < error < 0.6
        else:
            assert sag > 15  # beyond the end stop
            assert error > 5


@pytest.mark.slow
def test_what_a_newton_along_z_meets_is_what_the_machine_does(found: Found) -> None:
    """The simulated mover, with lags as the linear loop has them and without noise; not 1 / K[z, z], 19 um."""
    second = found.evidence[1]
    K_z = second.controller.K[second.model.plant.thrust_input, second.model.plant.stroke_state]
    push = partial(step_wrench, column=2, size=0.1, at=0.0, width=6)
    scenario = Scenario("push", 0.2, references.hold, fidelity="force", disturbance=push)
    run = simulate(second.spec.plant, second.controller, scenario)
    moved = 10 * np.abs(run.p - run.reference)[:, second.model.plant.stroke_output].max()
    assert 1e3 * moved == pytest.approx(found.value("1 N along z", "calibrated"), rel=0.02)
    assert moved > 15 / K_z
    for name in NAMES:
        ratio = found.value("the same at the worst frequency", name) / found.value("1 N along z", name)
        assert 1 < ratio < 2


@pytest.mark.slow
def test_a_payload_is_moved_as_the_stroke_is_published(found: Found) -> None:
    """The largest that keeps all bounds of Figs 12 and 13, and 10 % more does not; overshoot is one of them."""
    bounds = {"stroke: overshoot": 0.015, "stroke: axial error": 0.6e-3, "stroke: radial deviation": 20e-6}
    for start, known in (("payload moved within", False), ("the same, its weight", True)):
        mass, design = found.value(start, "calibrated"), found.evidence[1]
        assert (mass > 0.2) == known
        for share in (1.0, 1.1):
            options: dict[str, Any] = {"masses": (share * mass,), "known": known}
            flown = malta.experiment("payload", design.spec.plant, design.controller, **options)
            kept = [m.value <= bounds.get(m.label, math.inf) for m in flown.cases[0].merits]
            assert all(kept) == (share == 1.0)
    assert found.value("payload moved within", "calibrated") == pytest.approx(0.02, abs=0.01)
    # Without bounds the trials do not end at the published 0.2 kg.
    carried = [found.value("payload picked", name) for name in NAMES]
    assert carried == pytest.approx([0.116, 1.056], rel=0.05)


@pytest.mark.slow
def test_figures_are_those_of_the_experiments(found: Found) -> None:
    """What a user sees of `malta simulate` is what the ledger says."""
    for name, evidence in zip(NAMES, found.evidence, strict=True):
        assert set(evidence.experiments) == set(EXPERIMENT_NAMES)
        for start, experiment, label in (
            ("stroke: f/i", "stroke", "drive constant per module, f / i"),
            ("stroke: rise", "stroke", "rise, 10-90 %"),
            ("stroke: overshoot", "stroke", "overshoot"),
            ("stroke: axial error", "stroke", "axial error"),
        ):
            merit = next(m for m in evidence.experiments[experiment].merits if m.label == label)
            assert found.value(start, name) == pytest.approx(in_unit(merit.value, merit.unit), rel=1e-12)
        for start, experiment, number, label in (
            ("tilt: SP2 deviates", "tilt", 0, "feedforward axial"),
            ("tilt: SP2, attraction", "tilt", 1, "feedforward attraction"),
            ("thermal: left", "thermal", 0, "compensated"),
        ):
            case = evidence.experiments[experiment].cases[number]
            assert case.label == label
            figure = evidence.flights[experiment, number]  # the experiment is that of one of the seeds
            assert found.value(start, name) == pytest.approx(1e6 * figure)
            assert case.merits[0].value == pytest.approx(figure, abs=5 * figure.half)
        assert "largest deviation" in evidence.experiments["thermal"].cases[0].merits[0].label
        assert evidence.experiments["tilt"].cases[0].merits[0].label == "SP2: largest deviation, true"


@pytest.mark.slow
def test_figures_of_chance_show_their_interval(found: Found) -> None:
    """Student's interval of a mean, and of a mean square; what is no chance has none."""
    values = [3.0, 4.0, 5.0]
    figure = mean_of_seeds(values)
    assert (figure, figure.half) == pytest.approx((4.0, 4.302653 / math.sqrt(3)), rel=1e-6)
    (row,) = [c for c in found.ledger.claims if c.subject.startswith("at rest: radial motion")]
    for cell, e in zip(row.ours, found.evidence, strict=True):
        rest = max(e.rests[f"true {name}, rms"] for name in ("x1", "y1", "x2", "y2"))
        assert cell == f"{1e6 * rest:.3f} ±{1e6 * rest.half:.3f}"
        assert 0 < rest.half < 0.3 * rest
    shares = [c for c in found.ledger.claims if c.subject.startswith("machines ±20 %: stroke")]
    assert all(" ±" in cell for c in shares for cell in c.ours if cell != "–")
    (poles,) = [c for c in found.ledger.claims if c.subject.startswith("change of the poles")]
    assert not any("±" in cell for cell in poles.ours)


@pytest.mark.slow
def test_a_rest_before_the_stroke_takes_radial_deviations_off(found: Found) -> None:
    """`calibrated`: a third in the median; table2, whose integrals take minutes, loses more of its machines instead."""
    first, second = found.evidence
    assert second.strokes.median < 0.4 * second.unsettled.median
    assert first.strokes.yields.completed.share < first.unsettled.yields.completed.share


@pytest.mark.slow
def test_releases_are_those_of_the_experiment(found: Found) -> None:
    """The force limit decides, not the gains: 0.91 of what it allows, and every start inside the bearings returns."""
    if compiler() is None:
        pytest.skip("needs a C compiler")
    for name in NAMES:
        assert found.value("released downwards: share", name) == pytest.approx(91.5, abs=1.5)
        assert found.value("released anywhere", name) == 100
        assert found.value("released aside, downwards", name) < found.value("released aside, along x", name)


@pytest.mark.slow
def test_rests_are_those_of_many_seeds(found: Found) -> None:
    """The mean square over seeds, of runs made one by one."""
    for name, e in zip(NAMES, found.evidence, strict=True):
        y = [
            malta.simulate(e.spec.plant, e.controller, rest_scenario(seed)).y[-REST_SAMPLES:].std(axis=0)
            for seed in range(SEEDS)
        ]
        for k, output in enumerate(("x1", "y1", "x2", "y2", "z")):
            expected = np.sqrt(np.mean(np.square(y), axis=0))[k]
            assert found.value(f"at rest: {output}", name) == pytest.approx(1e6 * expected, rel=1e-9)


def rest_scenario(seed: int) -> Scenario:
    return replace(Scenario("hold", (REST_SAMPLES + 6000) * 50e-6, references.hold), seed=seed, **AS_BUILT)


@pytest.mark.slow
def test_the_rule_of_thumb_by_hand(found: Found) -> None:
    """The paper asks for twice the largest unstable pole, 218.92 rad/s, and has 400 rad/s itself."""
    for name in NAMES:
        for kind in ("−3", "0"):
            ratio = found.value(f"bandwidth over unstable pole: last {kind} dB", name)
            assert ratio * 218.92 == pytest.approx(found.value(f"bandwidth: last {kind} dB", name), rel=1e-4)
    claim = found.claim("bandwidth over unstable pole: last −3")
    assert claim.verdict.startswith("table2: within 12 %; calibrated: not reproduced; ")
    assert claim.published == f"≈ {400 / 218.92:.2f}"
    assert found.claim("bandwidth over unstable pole: last 0").verdict.startswith(
        "table2: not reproduced; calibrated: within "
    )


@pytest.mark.slow
def test_the_braking_resistor_holds_the_link(found: Found) -> None:
    """Braked at the force limit from 5 m/s, the resistor switched by the sample: the link stays below 46.12 V."""
    resistance = found.value("braking resistor: largest resistance", "calibrated")
    capacitance = found.value("braking resistor: capacitance", "calibrated") * 1e-3
    link, speed, highest, fine = 45.0, 5.0, 45.0, 50
    while speed > 0:
        on = link > 45.0
        for _ in range(fine):
            speed -= 52 / 0.36 * 50e-6 / fine
            link += (52 * speed / link - on * link / resistance) / capacitance * 50e-6 / fine
        highest = max(highest, link)
    assert 45 + 0.9 * 1.12 < highest < 45 + 1.01 * 1.12
    assert found.claim("braking resistor: capacitance").published == "≤ 88"


@pytest.mark.slow
def test_means_at_rest_are_of_the_order_that_the_paper_prints(
    found: Found, published: dict[str, Any]
) -> None:
    printed = {name: abs(entry["value"]) for name, entry in published["table_III"]["mean"].items()}
    note = found.claim("at rest, mean of z").verdict
    assert f"{max(printed[name] for name in ('x1', 'y1', 'x2', 'y2')):.2f} radially" in note
    assert f"{printed['z']:.2f} along z" in note
    for name, size in printed.items():
        assert found.value(f"at rest, mean of {name}", "calibrated") < 1
        assert size < 1
        mean = found.evidence[1].rests[f"measured {name}, mean"]
        assert found.value(f"at rest, mean of {name}", "calibrated") == pytest.approx(1e6 * mean)
