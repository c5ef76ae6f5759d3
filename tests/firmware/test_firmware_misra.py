"""MISRA C:2012: cppcheck finds no rule in an exported folder but those that malta gives a reason for."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from exported import PRECISIONS, require, root_text, run, target, texts, write_folder

from malta.firmware import export
from malta.firmware.export import DEVIATIONS
from malta.firmware.program import Precision
from malta.firmware.sources import ring_sources, sources
from malta.firmware.xcp import XcpPort

pytestmark = pytest.mark.first

CHECKS = ("--addon=misra", "--enable=warning,style,performance,portability", "--std=c99", "--quiet")
SECONDS = 600.0  # for a file, on a computer with much else to do
DESIGNS = ("halbach_pid", "robust_observer", "planar")  # the kinds of laws and machines
GCC = "-D__GNUC__=12"  # one of the compilers that the guards tell apart; without it each is looked at in turn


@pytest.mark.slow
def test_deviations_are_those_with_a_reason(tmp_path: Path) -> None:
    """Each file alone, as two programs share a folder; a deviation that no longer exists leaves the list too."""
    require("cppcheck")
    folder = write_folder("halbach", "double", tmp_path)
    found = set()
    for path in sorted(folder.glob("*.c")):
        for file, rule in deviations(path):
            of = {d.rule for d in DEVIATIONS if file.endswith(d.files)}
            assert rule in of, f"{file} deviates from {rule}"
            found.add(rule)
    assert found == {d.rule for d in DEVIATIONS}


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNS)
def test_designs_of_each_kind_deviate_from_nothing_else(name: str, tmp_path: Path) -> None:
    """The C of a controller of each kind."""
    require("cppcheck")
    folder = write_folder(name, "float", tmp_path)
    for path in (folder / f"{name}{end}.c" for end in ("", "_parts", "_supervisor")):
        for file, rule in deviations(path, GCC):
            of = {d.rule for d in DEVIATIONS if file.endswith(d.files)}
            assert rule in of, f"{file} deviates from {rule}"


@pytest.mark.slow
@pytest.mark.parametrize("precision", PRECISIONS)
def test_roots_deviate_from_nothing(precision: Precision, tmp_path: Path) -> None:
    """The small folder of the other test has none."""
    require("cppcheck")
    (tmp_path / "root.c").write_text(root_text(precision), encoding="utf-8")
    assert deviations(tmp_path / "root.c") == []


@pytest.mark.slow
@pytest.mark.parametrize("name", ["halbach", "planar"])
def test_rings_deviate_from_nothing(name: str, tmp_path: Path) -> None:
    """The C of a ring buffer; macros of its header are for the caller (2.5)."""
    require("cppcheck")
    t = replace(target(name, "float"), logged=1.0)
    for file, text in (sources(t, "0" * 64, name) | ring_sources(t, "0" * 64, name)).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    assert {rule for _, rule in deviations(tmp_path / f"{name}_log.c", GCC)} == {"2.5"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robust", "halbach"])
def test_wirings_and_slaves_deviate_from_nothing_else(name: str, tmp_path: Path) -> None:
    """What tries the wiring, commits parameters and answers a calibration tool."""
    require("cppcheck")
    t = replace(target(name, "float"), tunable=True, xcp=XcpPort(), wiring=name == "robust")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "costs", lambda _: [])
        for file, text in export.folder_files(t, "0" * 64, proof=False).items():
            (tmp_path / file).write_text(text, encoding="utf-8")
    for end in ("_supervisor.c", "_parameters.c", "_xcp.c"):
        for file, rule in deviations(tmp_path / f"{name}{end}", GCC):
            of = {d.rule for d in DEVIATIONS if file.endswith(d.files)}
            assert rule in of, f"{file} deviates from {rule}"


def deviations(path: Path, *options: str) -> list[tuple[str, str]]:
    """Names of files and rules, as cppcheck finds them; without its addon the test is skipped."""
    command = ["cppcheck", *CHECKS, *options, "--template={file} {id}"]
    command += ["--suppress=missingIncludeSystem", path.name]
    done = run(command, path.parent, SECONDS)
    if "misra" in done.stdout:
        pytest.skip(done.stdout.splitlines()[0])
    found: list[tuple[str, str]] = re.findall(r"^(\S+) (?:misra-c2012-)?(\S+)$", done.stderr, re.MULTILINE)
    return found


def test_the_report_has_the_deviations() -> None:
    report = texts("halbach", "double")["REPORT.md"]
    for d in DEVIATIONS:
        assert f"| {d.rule} | `*{d.files}` | {d.reason} |" in report
