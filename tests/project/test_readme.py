"""The README's example runs, and the tables of claims, on its pages, show what the code computes."""

from __future__ import annotations

import re
from functools import partial

import pytest
from conftest import ROOT
from scipy.stats import binomtest

import malta
from malta.campaigns.result import yields_of
from malta.campaigns.run import main_campaign
from malta_papers.ledger import find_tables
from malta_papers.tubular.claims import SOURCE
from malta_papers.tubular.quantities import FEWER_SHARE, MACHINES

pytestmark = pytest.mark.usefixtures("proven_once")

README = (ROOT / "README.md").read_text(encoding="utf-8")
DESIGNS = {
    "tubular": ("table2", "calibrated", "robust", "tubular_pid"),
    "halbach": ("halbach_late", "halbach", "halbach_pid", "halbach_calm"),
    "planar": ("planar", "planar_pid"),
}
OBSERVED = ("robust_observer",)  # a table of its own on the page of its machine
PAGES = {name: (ROOT / "docs" / "claims" / f"{name}.md").read_text(encoding="utf-8") for name in DESIGNS}
DRAWN = "machines ±20 %"  # rows of machines drawn at random: shares, and deviations
FEW, LEARNERS = 240, 8  # machines here, and those that fly twice
TIMED = "K(p) and pseudo-inverse"  # rows that are measured on the computer that computes them
# Rows of a limit cycle's size: the last bit of the arithmetic decides which part of it the samples meet (92 to 109).
CYCLES = "three times as fast, filter without"
ROUNDING = 1e-9  # figures below it are what floating point leaves


@pytest.mark.slow
def test_the_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    block = re.search(r"```python\n(.*?)```", README, re.S)
    assert block is not None
    assert len(block[1].split("\n")) - block[1].count("\n\n") - 1 == 5
    exec(block[1], {})
    assert capsys.readouterr().out.startswith("stable with hold, delay and current loops")


def _cells(table: str) -> dict[str, list[str]]:
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return {row[0]: row[1:] for row in rows}


def _shown(title: str, designs: tuple[str, ...]) -> dict[str, list[str]]:
    """The table of these designs on the page of a machine, under the title of its ledger."""
    page = PAGES[title.split(",")[0]]
    header = "| claim | published | " + " | ".join(f"`{name}`" for name in designs) + " | verdict |"
    start = page.index(header, page.index(f"## {title}\n"))
    return _cells((page + "\n")[start : (page + "\n").index("\n\n", start)])


def test_the_headlines_are_rows_of_the_pages() -> None:
    start = README.index("| claim | design |")
    lines = README[start : README.index("\n\n", start)].splitlines()[2:]
    assert len(lines) > 5
    for line in lines:
        claim, design, published, ours, verdict = (cell.strip() for cell in line.strip("|").split("|"))
        (machine,) = [name for name, designs in DESIGNS.items() if design.strip("`") in designs]
        first = find_tables(PAGES[machine], machine)[0]
        row = _cells(PAGES[machine][first.start : first.end])[claim]
        column = DESIGNS[machine].index(design.strip("`"))
        said = dict(part.split(": ", 1) for part in row[-1].split("; ") if part.startswith(DESIGNS[machine]))
        assert (published, ours) == (row[0], row[1 + column])
        assert said.get(design.strip("`"), row[-1]).startswith(verdict)


def _is_noisy(machine: str, subject: str) -> bool:
    """Noise, steps of sensors, limit cycles: the last bit of the arithmetic decides where a sample falls."""
    noisy = ("at rest", "tilt", "thermal: left")
    return machine == "halbach" or subject.startswith(noisy)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("machine", "designs"),
    [
        pytest.param("tubular", DESIGNS["tubular"], id="tubular"),
        pytest.param("tubular", OBSERVED, marks=pytest.mark.slow, id="observed"),
        pytest.param("halbach", DESIGNS["halbach"], marks=pytest.mark.slow, id="halbach"),
        pytest.param("planar", DESIGNS["planar"], marks=pytest.mark.slow, id="planar"),
    ],
)
def test_the_table_of_claims_is_computed(
    machine: str, designs: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Yields, of MACHINES on the pages, are computed of FEW: they lie within the interval of these."""
    monkeypatch.setattr("malta_papers.tubular.quantities.MACHINES", FEW)
    monkeypatch.setattr("malta_papers.tubular.quantities.LEARNERS", LEARNERS)
    specs = [malta.read_design(f"design/{name}.toml") for name in designs]
    ledger = malta.ledger(specs, malta.model.read_published(f"data/{machine}.toml"))
    found, shown = _cells(ledger.markdown()), _shown(ledger.title, designs)
    assert list(shown) == list(found)
    assert len(found) > 35
    for subject, cells in found.items():
        assert shown[subject][0] == cells[0]
        if subject.startswith(TIMED):
            continue
        numbers = [[_number(cell) for cell in row[1:-1]] for row in (shown[subject], cells)]
        if subject.startswith(DRAWN):
            count = (
                round(FEWER_SHARE * FEW) if "no rest before" in subject or "fed forward" in subject else FEW
            )
            count = LEARNERS if "first stroke" in subject or "second stroke" in subject else count
            within = partial(_is_of_sample, count) if "[%]" in subject else _is_as_large
            assert [within(*pair) for pair in zip(*numbers, strict=True)] == [True] * len(numbers[0])
            continue
        if _is_noisy(machine, subject) and None not in numbers[0]:
            # A mean of noise around zero has no size of its own, but that of its scatter.
            assert numbers[0] == pytest.approx(numbers[1], rel=0.2, abs=0.3 if "mean of" in subject else 0.02)
        elif subject.startswith(CYCLES):
            shown_size, found_size = (row[0] for row in numbers)
            assert shown_size is not None
            assert found_size == pytest.approx(shown_size, rel=0.5)
        elif not all(n is not None and abs(n) < ROUNDING for row in numbers for n in row):
            assert shown[subject][1:] == cells[1:]


def _is_as_large(shown: float | None, found: float | None) -> bool:
    """Whether a median or a largest deviation is about that of fewer machines, whose largest is smaller."""
    return shown is not None and found is not None and 0.3 * shown <= found <= 1.5 * shown


def _is_of_sample(count: int, shown: float | None, found: float | None) -> bool:
    """Whether a share in percent lies in the interval, 99.9 %, of a share of `count` machines; no share, no sample."""
    if shown is None or found is None:
        return shown is found
    low, high = binomtest(round(found / 100 * count), count).proportion_ci(0.999, method="exact")
    return bool(low - 1e-3 <= shown / 100 <= high + 1e-3)


@pytest.mark.slow
def test_yields_of_the_flagship_are_those_of_all_machines() -> None:
    """All of them; the last digits of the arithmetic decide for machines at a bound."""
    shown = _shown(f"tubular, {SOURCE}", DESIGNS["tubular"])
    published = malta.model.read_published("data/tubular.toml")
    for name in ("robust",):
        k = DESIGNS["tubular"].index(name)
        controller = malta.gains.read(f"design/gains/{name}.json")
        spec = malta.read_design(f"design/{name}.toml")
        found = yields_of(main_campaign(controller, spec, MACHINES), published, spec)
        within = shown[f"{DRAWN}: stroke within the published bounds [%]"][1 + k]
        assert found.published is not None
        assert _number(within) == pytest.approx(100 * found.published.share, abs=0.2)
        completed = shown[f"{DRAWN}: stroke without touchdown [%]"][1 + k]
        assert _number(completed) == pytest.approx(100 * found.completed.share, abs=0.2)


def _number(cell: str) -> float | None:
    try:
        return float(cell.partition(" ±")[0])  # with or without an interval
    except ValueError:
        return None
