"""`malta export --to c` and `malta simulate --controller c`, as a user calls them."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT, one_sentence
from exported import of_each_kind

import malta
from malta.firmware.ctext import c_name
from malta.firmware.export import folder_files
from malta.firmware.flight import differences, engine_of_c
from malta.firmware.signals import Target
from malta.firmware.sources import comment, sources
from malta.simulation.engine import compiled

if TYPE_CHECKING:
    from conftest import Run

    from malta.firmware.program import Precision

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

GAINS = "design/gains/halbach.json"


def build_and_test(folder: Path) -> str:
    """What the recorded vectors' program prints, built as the folder's Makefile does."""
    if shutil.which("make") is None or compiled.compiler() is None:
        pytest.skip("no make, or no C compiler")
    done = subprocess.run(
        ["make", "-s", "-C", str(folder), "all", "test"], check=False, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout


@pytest.mark.slow_for("double")
@pytest.mark.parametrize("precision", ["double", pytest.param("float", marks=pytest.mark.slow)])
def test_export_writes_a_folder_whose_test_passes(run: Run, tmp_path: Path, precision: str) -> None:
    folder = tmp_path / "c"
    code, out, err = run("export", GAINS, "--precision", precision, "--out", folder)
    assert code == 0
    assert ("proving the margin" in err) == (precision == "float")
    names = {path.name for path in folder.iterdir()}
    assert {"halbach.h", "halbach.c", "halbach_parts.c", "halbach_test.c", "halbach_example.c"} < names
    assert {"Makefile", "CMakeLists.txt", "REPORT.md", "halbach_supervisor.c", "halbach_supervisor.h"} < names
    assert out.count("wrote ") == len(names)
    said = build_and_test(folder).splitlines()
    assert re.fullmatch(r"pass: 4 vectors of 60 samples, checksum [0-9a-f]{8}", said[-1])
    done = subprocess.run([str(folder / "halbach_example")], check=False, timeout=600)
    assert done.returncode == 0
    header = (folder / "halbach.h").read_text(encoding="utf-8")
    sha256 = json.loads((ROOT / GAINS).read_text(encoding="utf-8"))["sha256"]
    assert f'#define HALBACH_GAINS_SHA256 "{sha256}"' in header
    assert f"typedef {precision} halbach_real;" in header
    report = (folder / "REPORT.md").read_text(encoding="utf-8")
    assert ("% is proven for the sampled loop" in report) == (precision == "float")
    assert "| nan" not in report


@pytest.mark.slow
@pytest.mark.parametrize(("part", "fmi"), [("controller", "2"), ("loop", "3")])
def test_export_writes_an_fmu(run: Run, tmp_path: Path, part: str, fmi: str) -> None:
    if compiled.compiler() is None:
        pytest.skip("no C compiler")
    file = tmp_path / "mine.fmu"
    code, out, err = run("export", GAINS, "--to", "fmu", "--part", part, "--fmi", fmi, "--out", file)
    assert (code, out, err) == (0, f"wrote {file}\n", "")
    with zipfile.ZipFile(file) as archive:
        names = archive.namelist()
        description = archive.read("modelDescription.xml").decode()
    assert f'fmiVersion="{fmi}.0"' in description
    assert any(name.startswith("binaries/") for name in names)
    sources_of = {name for name in names if name.startswith("sources/")}
    assert any(name.endswith("_controller.c") for name in sources_of), sorted(names)


@pytest.mark.slow
def test_json_lists_the_files(run: Run, tmp_path: Path) -> None:
    code, out, err = run("export", GAINS, "--out", tmp_path / "c", "--json")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert (found["gains"], found["to"], len(found["files"])) == (GAINS, "c", 11)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--precision", "half"), "--precision: found 'half', expected double or float"),
        (("--to", "rust"), "--to: found 'rust', expected c or fmu"),
        (
            ("--to", "fmu", "--part", "motor"),
            "--part: found 'motor', expected controller or supervised or machine or loop",
        ),
        (("--to", "c", "--part", "loop"), "--part: found loop of a folder of C, expected --to fmu"),
        (("--to", "fmu", "--fmi", "1"), "--fmi: found 1, expected 2 or 3"),
        (("--to", "fmu", "--precision", "float"), "--precision: found float of an FMU, expected double"),
        (("--to", "fmu", "--fma"), "--fma: found an FMU, expected --to c"),
        (("--until", "volts"), "--until: found 'volts', expected currents or duty-cycles"),
        (("--out", "/dev/null"), "/dev/null: found a file of that name, expected a folder, new or empty"),
        (("--out", "/proc/no"), "expected a place to write the file to"),
    ],
)
def test_what_cannot_be_exported_is_a_sentence(run: Run, arguments: tuple[str, ...], sentence: str) -> None:
    code, out, err = run("export", GAINS, *arguments)
    assert (code, out) == (2, "")
    assert one_sentence(err).endswith(sentence)


def test_a_folder_with_files_is_left_alone(run: Run, tmp_path: Path) -> None:
    (tmp_path / "mine.c").write_text("int x;", encoding="utf-8")
    code, _, err = run("export", GAINS, "--out", tmp_path)
    assert code == 2
    assert "a folder with files in it, expected one that is new or empty" in one_sentence(err)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.c"]


def test_duty_cycles_need_windings(run: Run, tmp_path: Path) -> None:
    code, _, err = run("export", "design/gains/planar.json", "--until", "duty-cycles", "--out", tmp_path)
    assert code == 2
    assert "a planar without a model of its current loops, expected an export down to currents" in err
    code, _, err = run("export", "design/gains/nothing.json")
    assert code == 2
    assert "no such file" in one_sentence(err)


def test_duty_cycles_need_current_loops() -> None:
    c = replace(malta.gains.read("design/gains/robust.json"), current_loop=None)
    with pytest.raises(malta.InputError, match="no current loops, expected an export down to currents"):
        Target(c, "double", "phase")
    assert Target(c, "double", "force").driven is False


def test_names_in_a_gain_file_are_only_comments() -> None:
    """Whoever names a signal: the text stays within its comment, and the file's name a C identifier."""
    assert comment("x */ system() /* \\") == "x * / system() / * /"
    c = malta.gains.read(GAINS)
    c = replace(c, name="stdint", forces=(c.forces[0]._replace(name='f */ #error "out" /*'),))
    files = sources(Target(c, "double", "force"), "")
    assert set(files) == {"m_stdint.h", "m_stdint.c", "m_stdint_parts.c"}
    for text in files.values():
        code = re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL)
        assert '#error "out"' not in code


@pytest.mark.slow
def test_simulate_flies_the_c(run: Run) -> None:
    if compiled.compiler() is None:
        pytest.skip("no C compiler")
    gains, given = "design/gains/robust.json", ("--option", "noise=1", "--controller", "c")
    code, out, err = run("simulate", gains, *given)
    assert code == 0, err
    rows = dict(re.findall(r"^ ?(\w+) +\S+ +(\S+) +\S+ *$", out, flags=re.MULTILINE))
    assert {"p", "y", "xi_hat", "v", "current", "i", "u"} <= set(rows)
    assert max(float(rows[name]) for name in ("p", "y", "xi_hat", "v", "current", "i", "u")) < 1e-12
    code, out, err = run("simulate", gains, *given, "--json")
    double, single = json.loads(out)["exported"]
    assert (double["precision"], single["precision"]) == ("double", "float")
    assert 1e-9 < single["signals"]["v"]["largest"] / single["signals"]["v"]["range"] < 1e-4


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--controller", "fortran"), "--controller: found 'fortran', expected own, or c"),
        (
            ("--controller", "c", "--engine", "compiled"),
            "compiled beside --controller c, expected one of the two",
        ),
        (("--controller", "c", "--option", "scheduled=true"), "scheduled: found a law that is not exported"),
        (
            ("--controller", "c", "--option", "estimator=kalman"),
            "estimator: found a law that is not exported",
        ),
    ],
)
def test_what_cannot_fly_is_a_sentence(run: Run, arguments: tuple[str, ...], sentence: str) -> None:
    code, out, err = run("simulate", "design/gains/robust.json", *arguments)
    assert (code, out) == (2, "")
    assert sentence in one_sentence(err)


@pytest.mark.slow
def test_without_a_compiler_the_c_does_not_fly(
    run: Run, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(compiled, "compiler", lambda: None)
    malta.firmware.flight.compile_controller.cache_clear()
    code, _, err = run("simulate", "design/gains/table2.json", "--controller", "c")
    assert code == 2
    assert "C compiler: found none that works" in one_sentence(err)
    assert run("export", GAINS, "--out", tmp_path / "c")[0] == 0  # the folder needs none


@pytest.mark.slow
def test_a_machine_that_changes_keeps_its_controller() -> None:
    """Mass and reference change on the way, samples are lost: still the simulation's law to 1e-12."""
    if compiled.compiler() is None:
        pytest.skip("no C compiler")
    c = malta.gains.read("design/gains/calibrated.json")
    plant = malta.plant_of(c.parameters)
    faults: Any = (
        malta.simulation.Fault("lost sample", 0.01, 0.0102),
        malta.simulation.Fault("missed step", 0.012, 0.0121),
        malta.simulation.Fault("link sag", 0.015, 0.02, size=0.3),
    )
    scenario = malta.Scenario.stroke(
        5e-3,
        duration=0.03,
        fidelity="phase",
        noise=1.0,
        faults=faults,
        changes=((0.012, {"m": 0.5}),),
        quantize=True,
    )
    own = malta.simulate(plant, c, scenario, engine="virtual machine")
    flown = malta.simulate(plant, c, scenario, engine=engine_of_c())
    assert len(flown.t) == len(own.t)
    # Of a step that is missed, the simulation records what the law would have commanded, and the C what it last did.
    names = ("p", "y", "force", "i_phase", "duty")
    assert max(d.share for d in differences(own, flown, names)) < 1e-12
    assert np.abs(own.p - own.reference).max() > 1e-6


@pytest.mark.slow
def test_names_of_other_files_and_targets_are_left_to_them(tmp_path: Path) -> None:
    """Headers of C's library beside an include folder, and a target that CMake has itself."""
    assert [c_name(name) for name in ("limits", "Features", "time", "test")] == [
        "m_limits",
        "m_features",
        "m_time",
        "test",
    ]
    cmake = shutil.which("cmake")
    if cmake is None or compiled.compiler() is None:
        pytest.skip("no cmake, or no C compiler")
    c = replace(malta.gains.read(GAINS), name="test")
    for file, text in folder_files(Target(c, "double", "force"), "", proof=False).items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    command = [cmake, "-B", str(tmp_path / "build"), "-S", str(tmp_path)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("name", "precision"), of_each_kind())
def test_a_design_of_each_kind_exports(name: str, precision: Precision, tmp_path: Path) -> None:
    """Vectors pass, the example moves and lands; in single precision the margin of rounded coefficients is proven."""
    gains, single = ROOT / "design" / "gains" / f"{name}.json", precision == "float"
    malta.export_c(gains, tmp_path, precision=precision, proof=single)
    if compiled.compiler() is not None:
        assert build_and_test(tmp_path).splitlines()[-1].startswith("pass: ")
        example = subprocess.run([str(tmp_path / f"{name}_example")], check=False, timeout=600)
        assert example.returncode == 0  # it has moved and landed
    report = (tmp_path / "REPORT.md").read_text(encoding="utf-8")
    assert ("With the coefficients that single precision holds" in report) == single
    assert ("% is proven" in report) == single


@pytest.mark.slow
def test_the_report_counts_by_the_clock_of_the_processor(tmp_path: Path, run: Run) -> None:
    """The share of a sample is that of instructions over the clock: a tenth of the clock, ten times the share."""
    found = []
    for clock in ("2MHz", "0.2 MHz", None):
        out = tmp_path / str(clock)
        options = () if clock is None else ("--clock", clock)
        code, _, err = run("export", "design/gains/halbach.json", "--no-proof", "--out", out, *options)
        assert (code, err) == (0, "")
        text = (out / "REPORT.md").read_text(encoding="utf-8")
        found.append(re.findall(r"at ([\d.]+) MHz, one a clock|([\d.]+) % \|$", text, re.MULTILINE))
    assert [rows[0][0] for rows in found] == ["2", "0.2", "667"]
    for slow, slower in zip(found[0][1:], found[1][1:], strict=True):
        assert float(slower[1]) == pytest.approx(10 * float(slow[1]), abs=0.6)


@pytest.mark.parametrize("clock", ["fast", "0MHz", "nanHz", "5kg", "2000GHz", "-3Hz"])
def test_a_clock_that_is_none_is_one_sentence(tmp_path: Path, run: Run, clock: str) -> None:
    code, out, err = run("export", "design/gains/halbach.json", "--out", tmp_path / "c", "--clock", clock)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "clock" in err
    assert not (tmp_path / "c").exists()
    code, _, err = run("export", "design/gains/halbach.json", "--to", "fmu", "--clock", "1MHz")
    assert (code, "1MHz of an FMU" in err) == (2, True)
