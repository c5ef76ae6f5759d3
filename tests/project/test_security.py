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
    "a file": files.MAX_FILE_BYTES,
    "a log": log_files.MAX_LOG_BYTES,
    "a certificate": checked_file.MAX_BYTES,
    "elements of a MAT-file, decompressed": encodings.MAX_DECOMPRESSED_BYTES,
    "members of an archive": tables.MAX_MEMBERS,
    "tables in tables": tables.MAX_DEPTH,
    "a unit": units.MAX_UNIT_LENGTH,
    "a delay": sensors.MOST_DELAY,
    "steps in a sample": scenario.MOST_SUBSTEPS,
    "runs of a series together": inputs.MAX_SAMPLES,
    "runs of a campaign": plan.MAX_RUNS,
    "a compilation": compiled.PATIENCE,
    "the check of a certificate": inspect.signature(check.check).parameters["seconds"].default,
}


def test_the_limits_are_those_of_the_code() -> None:
    rows = re.findall(r"^\| (.+?) \| ([\d,]+)[^|]* \|$", TEXT, re.MULTILINE)
    assert {name: float(number.replace(",", "")) for name, number in rows} == LIMITS


def test_the_patience_is_that_of_the_code() -> None:
    assert "more than ten minutes" in TEXT
    assert output.UNCONFIRMED_TIME == 600
