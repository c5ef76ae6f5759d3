"""The limits in SECURITY.md are those of the code."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

from malta import files, tables, units
from malta.campaigns import plan
from malta.checker import check, file as checked_file
from malta.cli import output
from malta.gains import encodings
from malta.identification import log_files
from malta.model import sensors
from malta.simulation import inputs, scenario
from malta.simulation.engine import compiled

TEXT = (Path(__file__).parents[2] / "SECURITY.md").read_text(encoding="utf-8")
LIMITS = {
    "a file": files.LARGEST,
    "a log": log_files.LARGEST,
    "a certificate": checked_file.LARGEST,
    "elements of a MAT-file, decompressed": encodings.LARGEST,
    "members of an archive": tables.MANY,
    "tables in tables": tables.DEEPEST,
    "a unit": units.LONGEST,
    "a delay": sensors.MOST_DELAY,
    "steps in a sample": scenario.MOST_SUBSTEPS,
    "runs of a series together": inputs.LONGEST,
    "runs of a campaign": plan.MOST,
    "a compilation": compiled.PATIENCE,
    "the check of a certificate": inspect.signature(check.check).parameters["seconds"].default,
}


def test_the_limits_are_those_of_the_code() -> None:
    rows = re.findall(r"^\| (.+?) \| ([\d,]+)[^|]* \|$", TEXT, re.MULTILINE)
    assert {name: float(number.replace(",", "")) for name, number in rows} == LIMITS


def test_the_patience_is_that_of_the_code() -> None:
    assert "more than ten minutes" in TEXT
    assert output.LONGEST == 600
