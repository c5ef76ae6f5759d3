"""MISRA C:2012: cppcheck finds no rule in an exported folder but those that malta gives a reason for."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from exported import PRECISIONS, require, root_text, run, texts, write_folder

from malta.firmware.elementary import Precision
from malta.firmware.misra import DEVIATIONS

CHECKS = ("--addon=misra", "--enable=warning,style,performance,portability", "--std=c99", "--quiet")
SECONDS = 200.0


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_deviations_are_those_with_a_reason(precision: Precision, tmp_path: Path) -> None:
    """Each file alone, as two programs share a folder; a deviation that no longer exists leaves the list too."""
    require("cppcheck")
    folder = write_folder("halbach", precision, tmp_path)
    found = set()
    for path in sorted(folder.glob("*.c")):
        for file, rule in deviations(path):
            of = {d.rule for d in DEVIATIONS if file.endswith(d.files)}
            assert rule in of, f"{file} deviates from {rule}"
            found.add(rule)
    assert found == {d.rule for d in DEVIATIONS}


@pytest.mark.parametrize("precision", PRECISIONS)
def test_roots_deviate_from_nothing(precision: Precision, tmp_path: Path) -> None:
    """The small folder of the other test has none."""
    require("cppcheck")
    (tmp_path / "root.c").write_text(root_text(precision), encoding="utf-8")
    assert deviations(tmp_path / "root.c") == []


def deviations(path: Path) -> list[tuple[str, str]]:
    """Names of files and rules, as cppcheck finds them; without its addon the test is skipped."""
    command = ["cppcheck", *CHECKS, "--template={file} {id}", "--suppress=missingIncludeSystem", path.name]
    done = run(command, path.parent, SECONDS)
    if "misra" in done.stdout:
        pytest.skip(done.stdout.splitlines()[0])
    found: list[tuple[str, str]] = re.findall(r"^(\S+) (?:misra-c2012-)?(\S+)$", done.stderr, re.MULTILINE)
    return found


def test_the_report_has_the_deviations() -> None:
    report = texts("halbach", "double")["REPORT.md"]
    for d in DEVIATIONS:
        assert f"| {d.rule} | `*{d.files}` | {d.reason} |" in report
