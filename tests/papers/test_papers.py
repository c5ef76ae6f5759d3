"""malta with its papers and without them: what is found by entry points, and what is said where there are none."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from conftest import ROOT, Run

import malta
from malta.machines.tubular import experiments as own
from malta.model.parts import Part, attribute_of, parts_of, require_ledger, values_of
from malta.simulation.experiments.catalogue import check_of, experiments_of, main_job, series_of
from malta.simulation.experiments.worst_load import WORST_LOAD
from malta_papers import ledger
from malta_papers.tubular import experiments as printed

HIDDEN = """
import importlib.metadata as metadata, sys
found = metadata.entry_points
metadata.entry_points = lambda **asked: () if asked.get("group") == "malta.papers" else found(**asked)
sys.modules["malta_papers"] = None  # to import it is an error
from malta.__main__ import main
main()
"""
INSTALL = "malta-papers: pip install ./papers in a checkout of malta"


def alone(folder: Path, *arguments: str) -> tuple[int, str, str]:
    """Exit code and outputs of the program where no distribution compares with papers."""
    done = subprocess.run(
        [sys.executable, "-c", HIDDEN, *arguments],
        cwd=folder,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("claims",), "claims: papers: found no distribution"),
        (("claims", "design/halbach_pid.toml", "--json"), "claims: papers: found no distribution"),
        (("claims", "--update", "docs/claims/tubular.md"), "claims: papers: found no distribution"),
        (("simulate", "design/gains/halbach.json", "--scenario", "force"), "scenario: found 'force'"),
        (("campaign", "design/gains/calibrated.json", "--scenario", "carrier"), "found 'carrier'"),
    ],
)
def test_what_papers_have_is_refused_without_them(arguments: tuple[str, ...], said: str) -> None:
    code, out, err = alone(ROOT, *arguments)
    assert (code, out) == (2, "")
    assert said in err
    assert INSTALL in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.slow
def test_what_an_owner_does_needs_no_papers(tmp_path: Path) -> None:
    """Design, verification and main job of each machine; its page, its own experiments and the published figures."""
    gains = ROOT / "design" / "gains"
    for name, asked in (("calibrated", "hold"), ("halbach", "ramp"), ("planar_pid", "jump")):
        code, out, err = alone(tmp_path, "simulate", f"{gains / name}.json", "--scenario", asked, "--json")
        assert code == 0, err
        assert json.loads(out)["scenario"] == asked
    code, out, err = alone(tmp_path, "simulate", f"{gains / 'halbach'}.json")
    assert code == 0, err
    code, out, err = alone(tmp_path, "claims", "--help")
    assert (code, err) == (0, "")
    assert "Print the ledger" in out
    code, out, err = alone(tmp_path, "schema", "claims-output")
    assert code == 0, err


def test_experiments_of_a_paper_stand_beside_the_machines_own(run: Run) -> None:
    plant = malta.read_design("design/calibrated.toml").plant
    assert list(experiments_of(plant)) == [*own.EXPERIMENTS, *printed.EXPERIMENTS, WORST_LOAD]
    assert list(series_of(plant)) == [*own.CASES, *printed.CASES, WORST_LOAD]
    assert main_job(plant) == "stroke"
    assert attribute_of(plant, "experiments", "FINDINGS") == (*own.FINDINGS, *printed.FINDINGS)
    assert attribute_of(plant, "experiments", "OPTION_UNITS")["drift"] == "m"
    assert [check_of(name, plant) for name in ("hold", "capture", WORST_LOAD)] == [
        own.check,
        printed.check,
        None,
    ]
    for option, value, limit in (("points=2", "2", "3 to 201"), ("points=0", "0", "3 to 201")):
        code, _, err = run(
            "simulate", "design/gains/calibrated.json", "--scenario", "capture", "--option", option
        )
        assert (code, f"found {value}, expected a whole number from {limit}" in err) == (2, True)


def test_no_name_stands_in_both() -> None:
    """What a paper adds to a table of the machine takes nothing from it."""
    tables: tuple[tuple[Part, str], ...] = (
        *(("experiments", name) for name in ("EXPERIMENTS", "CASES", "OPTION_UNITS")),
        ("figures", "FIGURES"),
    )
    for machine in ("calibrated", "halbach", "planar"):
        plant = malta.read_design(f"design/{machine}.toml").plant
        for part, name in tables:
            assert sum(map(len, values_of(plant, part, name))) == len(attribute_of(plant, part, name))


def test_parts_are_the_machines_own_then_its_papers() -> None:
    assert require_ledger() is ledger
    found = parts_of("experiments", "planar")
    assert [part and part.__name__ for part in found] == [
        "malta.machines.planar.experiments",
        "malta_papers.planar.experiments",
    ]
    assert parts_of("claims", "planar")[0] is None
    assert parts_of("requirements", "tubular")[1] is None
    assert parts_of("claims", "ledger") == (None, None)  # a name of the group that is no machine


def test_both_distributions_have_one_version() -> None:
    """A release is of both: papers/ may use what malta does not promise to anybody else."""
    own, printed = (
        tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
        for folder in (ROOT, ROOT / "papers")
    )
    assert own["version"] == printed["version"]
    assert f"malta=={own['version']}" in printed["dependencies"]
