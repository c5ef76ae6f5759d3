"""The command line: what it prints and writes, its exit codes, and one sentence for everything that is wrong."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run, numbers, one_sentence
from page_examples import without_progress
from typer.testing import CliRunner

import malta
from malta import gains
from malta.__main__ import HELP
from malta.cli import main as cli
from malta.cli.main import renew
from malta.cli.options import SCENARIO_FIELDS, design_files, read_options
from malta.errors import InputError
from malta.model.plant import Plant
from malta.report.ledger import Ledger
from malta.synthesis.spec import Spec

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

ROOT = Path(__file__).parents[2]
TABLE2, CALIBRATED = "design/gains/table2.json", "design/gains/calibrated.json"
WIDTH = 100
HEAVY = ("casadi", "control", "matplotlib", "numpy", "pint", "scipy")
NAMES = ("table2.json", "table2.mat", "table2.npz")
BALL = "examples/ball/design/ball.toml"  # designed in a tenth of the time
BALLS = ("ball.json", "ball.mat", "ball.npz")

TS = 'sample_time = { value = 50, unit = "us" }'
INPUT_BASES = 'input = "SI"'
PROCESS = 'process = { published = "table_II.process_noise" }'
STATE = 'state = { published = "table_II.state" }'
SUMMARY = 'summary = "'
INTEGRAL = 'integral = { published = "table_II.integral" }'
R_MAX = "r_max  = { value = 0.6,"

FORCES = ("fx_B1", "fy_B1", "fx_B2", "fy_B2", "f_D")


def project(
    folder: Path, design: tuple[str, str], machine: tuple[str, str] = ("", ""), base: str = "table2"
) -> Path:
    """A project with the machine's data and a shipped design, a text replaced in each; the design file."""
    (folder / "design").mkdir()
    shutil.copytree(ROOT / "data", folder / "data")
    for name, (old, new) in ((f"design/{base}.toml", design), ("data/tubular.toml", machine)):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new) if old else text, encoding="utf-8")
    return folder / "design" / f"{base}.toml"


def forces(value: str) -> str:
    """An inline table of newtons, one for each force."""
    return "{ " + ", ".join(f'{name} = {{ value = {value}, unit = "N" }}' for name in FORCES) + " }"


def old_gains(folder: Path, names: tuple[str, ...] = NAMES) -> dict[Path, bytes]:
    """Files in the place of gain files, and what is in them."""
    folder.mkdir(parents=True)
    old = {folder / name: f"old {name}".encode() for name in names}
    for path, content in old.items():
        path.write_bytes(content)
    return old


# --- what is beside the command ---


@pytest.mark.slow
def test_a_closed_standard_error_loses_sentences_and_no_work(tmp_path: Path) -> None:
    command = f"exec '{sys.executable}' -m malta simulate '{ROOT / CALIBRATED}' --out build 2>&-"
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, stdout=subprocess.PIPE, text=True, check=True)
    assert "completed" in done.stdout
    assert list((tmp_path / "build").iterdir())


def test_data_of_a_machine_among_designs_are_named_and_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = project(tmp_path, ("", ""))
    shutil.copy(ROOT / "data" / "tubular.toml", file.with_name("heavy_machine.toml"))
    monkeypatch.chdir(tmp_path)
    assert design_files("design", None) == [Path("design/table2.toml")]
    assert (
        capsys.readouterr().err
        == "malta: design/heavy_machine.toml: data of a machine, no design: left out\n"
    )
    named = [Path("design/heavy_machine.toml")]
    assert design_files("design", named) == named


# --- help ---


@pytest.mark.parametrize("command", ["design", "verify", "simulate"])
def test_help_of_each_command_shows_an_example(command: str) -> None:
    result = CliRunner().invoke(cli.app, [command, "--help"])
    assert result.exit_code == 0
    assert re.search(rf"Example: +malta {command} design/", result.output)
    assert "--json" in result.output


@pytest.mark.slow_for("simulate")
@pytest.mark.parametrize("command", [pytest.param("verify", marks=pytest.mark.slow), "simulate"])
def test_example_in_the_help_runs(run: Run, tmp_path: Path, command: str) -> None:
    text = " ".join(CliRunner().invoke(cli.app, [command, "--help"]).output.split())
    example = re.search(r"Example: malta (.*?) (?:Arguments|Options)", text)
    assert example is not None
    arguments = [str(tmp_path) if a == "build" else a for a in example[1].split()]
    code, out, err = run(*arguments)
    assert (code, err) == (0, "")
    assert "m=0.56" in out


def test_help_names_commands_and_exit_codes() -> None:
    result = CliRunner().invoke(cli.app, ["--help"])
    assert result.exit_code == 0
    text = " ".join(result.output.split())
    assert (
        "Exit codes: 0 fine; 1 a check failed (unstable, touched down), old gain files stand; 2 bad input"
        in text
    )
    assert re.search(r"Commands: design .* verify .* simulate ", text)


@pytest.mark.slow_for("arguments1", "arguments2")
@pytest.mark.parametrize("arguments", [["--help"], ["design", "--help"], ["simulate", "--help"]])
def test_help_imports_nothing_heavy(arguments: list[str]) -> None:
    heavy = (
        (*HEAVY, "pydantic") if arguments == ["--help"] else HEAVY
    )  # the parser of a command checks with pydantic
    program = f"""
import sys
from malta.cli.main import main
try:
    main()
except SystemExit as ended:
    print("exit", ended.code, "loaded", *sorted(set(sys.modules) & set({heavy})))
"""
    command = [sys.executable, "-c", program, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    assert done.stdout.splitlines()[-1] == "exit 0 loaded"
    assert "Usage: " in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["verify", TABLE2],
        ["campaign", TABLE2, "--samples", "8", "--seed", "1"],
        ["simulate", TABLE2, "--scenario", "hold", "--out", "."],
        ["export", TABLE2, "--out", "c"],
    ],
    ids=lambda arguments: arguments[0],
)
def test_commands_on_gain_files_import_no_library_of_synthesis(arguments: list[str], tmp_path: Path) -> None:
    """What a design of an LQG needs two seconds of processor time to import stays there."""
    program = """
import sys
from malta.cli.main import main
try:
    main()
except SystemExit as ended:
    print("exit", ended.code, *sorted(set(sys.modules) & {"control", "filterpy", "slycot"}))
"""
    named = [str(ROOT / one) if one.startswith("design/") else one for one in arguments]
    command = [sys.executable, "-c", program, *named]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True, cwd=tmp_path)
    assert done.stdout.splitlines()[-1] == "exit 0", done.stderr


@pytest.mark.slow
def test_a_simulation_imports_what_it_needs_alone() -> None:
    """Modules that take long to import stay out of the commands that do without them."""
    program = """
import sys
from malta.cli.main import main
try:
    main()
except SystemExit as ended:
    late = {"control", "filterpy", "jinja2", "matplotlib.pyplot", "scipy.optimize", "scipy.signal", "scipy.stats"}
    print("exit", ended.code, "loaded", *sorted(set(sys.modules) & late))
"""
    command = [sys.executable, "-c", program, "simulate", TABLE2, "--option", "fidelity=force"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=True)
    assert done.stdout.splitlines()[-1] == "exit 0 loaded"


# --- design ---


@pytest.fixture(scope="module")
def designed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Both shipped designs, made into a folder, and what was printed."""
    folder = tmp_path_factory.mktemp("designed")
    files = [str(ROOT / "design" / name) for name in ("table2.toml", "calibrated.toml")]
    options = ["--out", str(folder / "gains"), "--figures", str(folder / "figures")]
    result = CliRunner().invoke(cli.app, ["design", *files, *options])
    assert result.exit_code == 0, result.output
    return folder, result.stdout


def test_design_writes_gain_files_and_figures(designed: tuple[Path, str]) -> None:
    folder, printed = designed
    written = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert written == {
        *(f"figures/{name}_stroke.png" for name in ("table2", "calibrated")),
        *(f"gains/{name}.{form}" for name in ("table2", "calibrated") for form in ("json", "mat", "npz")),
    }
    assert [name for name in written if str(folder / name) not in printed] == []
    assert (folder / "figures" / "table2_stroke.png").read_bytes().startswith(b"\x89PNG")


def test_designed_gains_can_be_read(designed: tuple[Path, str]) -> None:
    folder, _ = designed
    found = [gains.read(path) for path in sorted((folder / "gains").iterdir())]
    assert [controller.name for controller in found] == ["calibrated"] * 3 + ["table2"] * 3


def test_design_prints_table_I_beside_ours(designed: tuple[Path, str]) -> None:
    _, printed = designed
    rows = [line.split() for line in printed.splitlines()]
    ours = [row[2:] for row in rows if row[:2] == ["ours,", "±"]]
    assert ours == [["218.92", "218.92", "0.00", "157.53", "157.53"]] * 2
    assert [row[3:] for row in rows if row[:2] == ["Table", "I,"]] == ours


def test_design_prints_bandwidths_sensitivities_and_stroke(designed: tuple[Path, str]) -> None:
    _, printed = designed
    stroke = "\nDoes it follow the stroke?\n"
    for title in ("Bandwidth by definition", "Peak sensitivity (ISO 14839-3", stroke, "overshoot [%]"):
        assert printed.count(title) == 2, title
    assert "calibrated: Table II's weights on bases" in printed


def test_design_prints_at_most_100_columns(designed: tuple[Path, str]) -> None:
    _, printed = designed
    lines = [line for line in printed.splitlines() if not line.startswith("wrote ")]  # paths stay whole
    assert max(map(len, lines)) <= WIDTH


def test_design_names_each_file_on_a_line_of_its_own(designed: tuple[Path, str]) -> None:
    folder, printed = designed
    wrote = [line.removeprefix("wrote ") for line in printed.splitlines() if line.startswith("wrote ")]
    assert sorted(wrote) == sorted(str(path) for path in folder.rglob("*") if path.is_file())


@pytest.mark.slow
@pytest.mark.parametrize("summary", ["word " * 60, "w" * 250])
def test_long_texts_are_wrapped_and_paths_are_not(run: Run, tmp_path: Path, summary: str) -> None:
    file = project(tmp_path, (SUMMARY, f"{SUMMARY}{summary}"))
    out = tmp_path / ("o" * WIDTH)
    code, printed, err = run("design", file, "--out", out, "--figures", out)
    assert (code, err) == (0, "")
    lines = printed.splitlines()
    wrote = [line for line in lines if line.startswith("wrote ")]
    files = [*(out / f"table2.{form}" for form in ("json", "npz", "mat")), out / "table2_stroke.png"]
    assert wrote == [f"wrote {path}" for path in files]
    assert max(len(line) for line in lines if line not in wrote) <= WIDTH


@pytest.mark.slow
def test_design_as_json_holds_finite_numbers(run: Run, tmp_path: Path) -> None:
    code, out, err = run(
        "design", "design/calibrated.toml", "--json", "--out", tmp_path / "g", "--figures", tmp_path / "f"
    )
    assert (code, err) == (0, "")
    (result,) = json.loads(out)["designs"]
    found = numbers(result)
    assert len(found) > 60
    assert all(map(math.isfinite, found))
    assert result["design"] == "calibrated"
    assert result["stable"] is True
    assert result["verdict"] == {"name": "completed", "time_s": 0.1, "signal": ""}
    assert [Path(file).is_file() for file in result["files"]] == [True] * 4


@pytest.mark.slow
def test_design_without_names_takes_the_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project(tmp_path, ("", ""))
    monkeypatch.chdir(tmp_path)
    code, out, err = run("design")
    assert (code, err) == (0, "")
    assert sorted(path.name for path in (tmp_path / "design" / "gains").iterdir()) == list(NAMES)
    assert (tmp_path / "build" / "table2_stroke.png").is_file()
    assert "wrote design/gains/table2.json" in out


@pytest.mark.slow_for("a huge integral-table2", "a huge integral-calibrated")
@pytest.mark.parametrize("base", ["table2", "calibrated"])
@pytest.mark.parametrize(
    ("design", "code", "found"),
    [
        ((TS, 'sample_time = { value = 10, unit = "s" }'), 1, "overflow"),
        ((PROCESS, f"process = {forces('1e200')}"), 2, "noise.process.fx_B1: found inf"),
        ((PROCESS, f"process = {forces('1e-200')}"), 2, "noise.process.fx_B1: found 0"),
        ((INTEGRAL, "integral = { x1 = 1e100, y1 = 1, x2 = 1, y2 = 1, z = 1 }"), 1, "LQI: "),
        ((INPUT_BASES, f"input = {forces('1e200')}"), 2, "bases: found [1e+200, "),
        ((INPUT_BASES, f"input = {forces('1e-200')}"), 2, "bases: found [1e-200, "),
        ((INPUT_BASES, 'input = "metric"'), 2, "bases.input: found 'metric'"),
        (("delay = 0 ", 'delay = 0\n"a\\nb" = 3 '), 2, "a b: found an unknown key"),
    ],
    ids=["10 s", "loud", "silent", "a huge integral", "large bases", "small bases", "metric", "two lines"],
)
def test_design_that_cannot_be_computed_names_its_file(
    run: Run, tmp_path: Path, base: str, design: tuple[str, str], code: int, found: str
) -> None:
    file = project(tmp_path, design, base=base)
    found_code, out, err = run("design", file, "--figures", tmp_path / "figures")
    assert (found_code, out) == (code, "")
    sentence = one_sentence(err)
    assert sentence.startswith(f"{file}: ")
    assert found in sentence
    assert not (tmp_path / "design" / "gains").exists()


@pytest.mark.slow_for("touches down", "no solution")
@pytest.mark.parametrize(
    ("design", "machine", "found"),
    [
        ((TS, 'sample_time = { value = 5, unit = "ms" }'), ("", ""), "is unstable, |lambda| = 1."),
        (("", ""), (R_MAX, "r_max  = { value = 0.001,"), "touchdown at sensor plane"),
        ((INTEGRAL, "integral = { x1 = 1e100, y1 = 1, x2 = 1, y2 = 1, z = 1 }"), ("", ""), "LQI: "),
    ],
    ids=["unstable", "touches down", "no solution"],
)
def test_failing_design_leaves_old_gains(
    run: Run, tmp_path: Path, design: tuple[str, str], machine: tuple[str, str], found: str
) -> None:
    file = project(tmp_path, design, machine)
    old = old_gains(tmp_path / "gains")
    code, out, err = run("design", file, "--out", tmp_path / "gains", "--figures", tmp_path / "figures")
    assert (code, out) == (1, "")
    assert one_sentence(err).startswith(f"{file}: ")
    assert found in one_sentence(err)
    assert {path: path.read_bytes() for path in old} == old
    assert sorted(path.name for path in (tmp_path / "gains").iterdir()) == list(NAMES)
    assert not (tmp_path / "figures").exists()


@pytest.mark.slow
def test_figures_that_cannot_be_written_leave_old_gains(run: Run, tmp_path: Path) -> None:
    old = old_gains(tmp_path / "gains", BALLS)
    (tmp_path / "file").write_bytes(b"not a folder")
    blocked = tmp_path / "file" / "figures"
    code, out, err = run("design", BALL, "--out", tmp_path / "gains", "--figures", blocked)
    assert (code, out) == (2, "")
    assert one_sentence(err).startswith(f"{blocked}/ball_hold.png: found ")
    assert {path: path.read_bytes() for path in old} == old
    assert sorted(path.name for path in (tmp_path / "gains").iterdir()) == list(BALLS)


@pytest.mark.slow
def test_gains_that_cannot_be_written_leave_the_old_figure(run: Run, tmp_path: Path) -> None:
    figures = tmp_path / "figures"
    figures.mkdir()
    (figures / "ball_hold.png").write_bytes(b"old")
    (tmp_path / "gains" / "ball.mat").mkdir(parents=True)
    code, _, err = run("design", BALL, "--out", tmp_path / "gains", "--figures", figures)
    assert code == 2
    assert one_sentence(err).startswith(f"{tmp_path / 'gains' / 'ball.mat'}: found a folder of that name")
    assert (figures / "ball_hold.png").read_bytes() == b"old"
    assert [path.name for path in (tmp_path / "gains").iterdir()] == ["ball.mat"]


@pytest.mark.slow
def test_numbers_that_no_gain_file_may_have_are_those_of_the_design(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file that the simulation is tried with is nobody's business."""

    def refuse(path: Path) -> None:
        raise InputError(path, "feedforward.v0", "up to [9.0]", "at most limits.force, [8.0]")

    monkeypatch.setattr("malta.gains.stable.read_stable", refuse)
    code, _, err = run("design", "design/table2.toml", "--out", tmp_path, "--figures", tmp_path)
    said = "design/table2.toml: feedforward.v0: found up to [9.0], expected at most limits.force, [8.0]"
    assert (code, one_sentence(err)) == (2, said)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_gains_are_replaced_by_a_design_that_ends_well_and_by_no_other(run: Run, tmp_path: Path) -> None:
    """The regulator without integrals, of which the page prints the poles, has no solution here."""
    names = ("x", "y", "z", "alpha", "beta")
    zeros = ", ".join(f"{name} = 0" for name in (*names, *(f"{name}_dot" for name in names)))
    file = project(tmp_path, (STATE, f"state = {{ {zeros} }}"))
    old = old_gains(tmp_path / "gains")
    code, _, _ = run("design", file, "--out", tmp_path / "gains", "--figures", tmp_path / "figures")
    replaced = [path.read_bytes() != content for path, content in old.items()]
    assert (code, replaced) in ((0, [True] * 3), (1, [False] * 3))


@pytest.mark.slow
def test_two_designs_of_one_name_do_not_overwrite_each_other(run: Run, tmp_path: Path) -> None:
    first = shutil.copytree(ROOT / "examples" / "ball", tmp_path, dirs_exist_ok=True) / "design" / "ball.toml"
    second = first.with_name("second.toml")
    second.write_text(first.read_text(encoding="utf-8").replace("value = 200,", "value = 160,"))
    code, out, err = run("design", first, second, "--json", "--figures", tmp_path / "figures")
    assert code == 2
    assert one_sentence(err) == f"{second}: name: found 'ball', expected another name than that of {first}"
    assert [result["design"] for result in json.loads(out)["designs"]] == ["ball"]
    assert gains.read(tmp_path / "design" / "gains" / "ball.json").sample_time == 200e-6


@pytest.mark.slow
def test_bad_design_file_does_not_stop_the_others(run: Run, tmp_path: Path) -> None:
    bad = project(tmp_path, (TS, 'sample_time = { value = 50, unit = "um" }'))
    options = ("--json", "--out", tmp_path / "gains", "--figures", tmp_path / "figures")
    code, out, err = run("design", bad, "design/table2.toml", *options)
    assert code == 2
    assert one_sentence(err) == f"{bad}: sample_time.unit: found 'um', expected a unit of s"
    assert [result["design"] for result in json.loads(out)["designs"]] == ["table2"]
    assert sorted(path.name for path in (tmp_path / "gains").iterdir()) == list(NAMES)


def test_bad_input_outweighs_a_failed_check(run: Run, tmp_path: Path) -> None:
    unstable = project(tmp_path, (TS, 'sample_time = { value = 5, unit = "ms" }'))
    for files in ((unstable, "nothing.toml"), ("nothing.toml", unstable)):
        code, out, err = run("design", *files, "--out", tmp_path / "gains", "--figures", tmp_path / "figures")
        assert (code, out) == (2, "")
        assert [line.startswith("malta: ") for line in err.splitlines()] == [True, True]


# --- verify ---


@pytest.mark.slow
def test_verify_prints_poles_bandwidths_and_sensitivities(run: Run) -> None:
    code, out, err = run("verify", TABLE2, "--no-proof")
    assert (code, err) == (0, "")
    assert out.startswith(f"{TABLE2}: table2, tubular, preset table1\n")
    assert "218.92   218.92   0.00   157.53   157.53" in out
    assert "6.93" in out
    assert max(map(len, out.splitlines())) <= WIDTH


@pytest.mark.slow
def test_all_forms_of_a_gain_file_verify_alike(run: Run) -> None:
    results = []
    for suffix in ("json", "npz", "mat"):
        code, out, _ = run("verify", f"design/gains/table2.{suffix}", "--json", "--no-proof")
        results.append((code, json.loads(out) | {"gains": ""}))
    assert results == [results[0]] * 3
    assert results[0][0] == 0


@pytest.mark.slow
def test_verify_of_an_unstable_machine_fails_after_printing(run: Run) -> None:
    code, out, err = run("verify", CALIBRATED, "--set", "K_A=50000")
    assert code == 1
    assert "is unstable, |lambda| = 1." in one_sentence(err)
    assert "Peak sensitivity" in out
    code, out, err = run("verify", CALIBRATED, "--set", "K_A=50000", "--json")
    result = json.loads(out)
    assert (code, result["stable"], result["bandwidth_rad_per_s"]["sigma_max_T"]) == (1, False, None)
    assert all(math.isfinite(number) for number in numbers(result["poles_rad_per_s"]))


@pytest.mark.slow
def test_verify_counts_the_force_constants_of_the_machine(run: Run) -> None:
    code, out, err = run("verify", TABLE2, "--set", "K_B=2.6", "--uncertain", "K_B=20%")
    assert code == 1
    assert re.fullmatch(
        rf"{TABLE2}: the loop \(sampled\) is unstable, \|lambda\| = 1\.0\d+", one_sentence(err)
    )
    assert "Peak sensitivity" in out
    peaks = []
    for change in ("K_B=5.2", "K_B=5.0"):
        code, out, _ = run("verify", CALIBRATED, "--json", "--set", change, "--no-proof")
        assert code == 0
        peaks.append(json.loads(out)["peak_sensitivity"]["sampled"]["x1"])
    assert peaks[0] != pytest.approx(peaks[1], rel=1e-3)


@pytest.mark.parametrize("change", ["m=1e-300", "K_A=1e300", "w_cc=1e300", "K_B=1e300", "l_B=1e200"])
def test_verify_of_a_machine_beyond_computing_is_one_sentence(run: Run, change: str) -> None:
    code, out, err = run("verify", TABLE2, "--set", change)
    assert (code, out) == (1, "")
    assert re.search("overflow|not finite|no input holds|no command makes", one_sentence(err))


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments", [("verify", ROOT / TABLE2, "--no-proof"), ("design", "design/table2.toml")]
)
def test_published_data_without_a_figure_of_a_table_names_it(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str | Path, ...]
) -> None:
    project(tmp_path, ("", ""))
    file = tmp_path / "data" / "published" / "tubular.toml"
    text = file.read_text(encoding="utf-8")
    assert "{ x = 218.92, " in text
    file.write_text(text.replace("{ x = 218.92, ", "{ "), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("malta.files.PACKAGE", tmp_path / "malta")
    code, _, err = run(*arguments)
    assert code == 2
    assert "published: table_I.poles.x: found nothing, expected " in one_sentence(err)
    assert not (tmp_path / "design" / "gains").exists()


@pytest.mark.slow
def test_what_the_paper_does_not_print_is_not_shown(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    project(tmp_path, ("", ""))
    file = tmp_path / "data" / "published" / "tubular.toml"
    text = file.read_text(encoding="utf-8")
    for table in ("table_I", "position_controller"):
        text, count = re.subn(rf"(?m)^\[{table}\].*\n(?:[^\n\[]*\n)+?\n", "", text, count=1)
        assert count == 1
    file.write_text(text, encoding="utf-8")
    monkeypatch.setattr("malta.files.PACKAGE", tmp_path / "malta")
    code, out, err = run("verify", ROOT / TABLE2, "--no-proof")
    assert (code, err) == (0, "")
    assert "218.92" in out
    assert "Table I," not in out
    assert "published, without a definition" not in out


@pytest.mark.slow
def test_verify_of_a_changed_machine_says_so(run: Run) -> None:
    code, out, _ = run("verify", CALIBRATED, "--set", "m=0.56", "--set", "l_B=45mm", "--no-proof")
    assert code == 0
    assert out.splitlines()[0].endswith("preset table1 m=0.56 l_B=45mm")
    assert "Table I," not in out  # the printed poles are of another machine


# --- simulate ---


def test_simulate_prints_the_stroke_beside_the_published_one(run: Run) -> None:
    code, out, err = run("simulate", TABLE2)
    assert (code, err) == (0, "")
    rows = [line.split() for line in out.splitlines()]
    assert ["rise,", "10-90", "%", "[ms]", "16.13", "16.2"] in rows
    assert out.startswith(f"{TABLE2}: stroke, fidelity dq -> completed at 0.1 s\n")
    assert max(map(len, out.splitlines())) <= WIDTH


@pytest.mark.slow
def test_simulate_wraps_long_texts_and_keeps_paths(run: Run, tmp_path: Path) -> None:
    path = tmp_path / f"{'w' * 120}.json"
    shutil.copy(ROOT / TABLE2, path)
    out = tmp_path / ("o" * WIDTH)
    code, printed, err = run("simulate", path, "--set", "m=0.36", "--out", out)
    assert (code, err) == (0, "")
    lines = printed.splitlines()
    wrote = [line for line in lines if line.startswith("wrote ")]
    assert wrote == [f"wrote {out}/table2_stroke.{form}" for form in ("npz", "png")]
    assert max(len(line) for line in lines if line not in wrote) <= WIDTH


def test_simulate_as_json_holds_finite_numbers(run: Run) -> None:
    code, out, err = run("simulate", TABLE2, "--json", "--option", "noise=1", "--option", "quantize=true")
    assert (code, err) == (0, "")
    result = json.loads(out)
    found = numbers(result)
    assert len(found) > 30  # merits of experiment and case, the stroke, and when it ended
    assert (result["engine"], result["fidelity"]) == ("compiled", "dq")
    assert all(map(math.isfinite, found))
    assert result["verdict"] == {"name": "completed", "time_s": 0.1, "signal": ""}
    assert result["files"] == []


def test_heavy_machine_touches_down_with_table2(run: Run) -> None:
    code, out, err = run("simulate", TABLE2, "--set", "m=0.56")
    assert code == 1
    assert re.fullmatch(rf"{TABLE2}: stroke: touchdown at sensor plane 1 at 0\.0\d+ s", one_sentence(err))
    assert "m=0.56 -> touchdown at sensor plane 1 at 0.0" in " ".join(out.split())


def test_touchdown_as_json_is_said_in_the_verdict(run: Run) -> None:
    code, out, err = run("simulate", TABLE2, "--set", "m=0.56", "--json")
    result = json.loads(out)
    assert (code, result["verdict"]["name"]) == (1, "touchdown at sensor plane 1")
    assert result["stroke"]["rise_s"] is None
    assert one_sentence(err)


@pytest.mark.slow
def test_simulate_writes_figure_and_time_series(run: Run, tmp_path: Path) -> None:
    assert run("simulate", CALIBRATED, "--out", tmp_path / "new" / "folder")[::2] == (0, "")
    folder = tmp_path / "new" / "folder"
    assert sorted(path.name for path in folder.iterdir()) == [
        "calibrated_stroke.npz",
        "calibrated_stroke.png",
    ]
    assert (folder / "calibrated_stroke.png").read_bytes().startswith(b"\x89PNG")
    with np.load(folder / "calibrated_stroke.npz", allow_pickle=False) as content:
        assert content["t"].shape == (2000,)
        assert content["p_columns"].tolist() == ["x1 [m]", "y1 [m]", "x2 [m]", "y2 [m]", "z [m]"]
        assert content["p"][-1, 4] == pytest.approx(5e-3, abs=1e-4)
        assert content["verdict"].tolist() == ["completed"]


def test_change_with_a_unit_is_the_same_change(run: Run) -> None:
    outputs = [
        run("simulate", CALIBRATED, "--json", "--set", m)[:2] for m in ("m=0.56", "m=560g", " m = 0.56 kg ")
    ]
    assert outputs == [outputs[0]] * 3
    assert outputs[0] != run("simulate", CALIBRATED, "--json")[:2]


def test_noise_repeats_with_its_seed(run: Run) -> None:
    noisy = ("simulate", CALIBRATED, "--json", "--option", "noise=1", "--seed")
    assert run(*noisy, "3") == run(*noisy, "3")
    assert run(*noisy, "3") != run(*noisy, "4")


@pytest.mark.slow
def test_options_of_the_stroke_are_taken(run: Run) -> None:
    def stroke(*options: str) -> dict[str, float]:
        code, out, _ = run("simulate", CALIBRATED, "--json", *options)
        assert code == 0
        found: dict[str, float] = json.loads(out)["stroke"]
        return found

    plain = stroke()
    assert (
        stroke("--option", "rise=16.2ms", "--option", "distance=10mm", "--option", "profile=logistic")
        == plain
    )
    assert stroke("--option", "rise=32.4ms")["rise_s"] == pytest.approx(2 * plain["rise_s"], rel=0.1)
    assert stroke("--option", "distance=5mm")["force_N"] == pytest.approx(plain["force_N"] / 2, rel=0.1)
    assert stroke("--option", "profile=quintic")["force_N"] != plain["force_N"]
    assert stroke("--option", "delay=1") == plain  # the machine's own
    assert stroke("--option", "delay=6")["error_along"] > 1.01 * plain["error_along"]


def test_the_scenarios_of_the_machine_are_listed(run: Run) -> None:
    from flight import CASES, EXPERIMENTS

    for command, names in (("simulate", EXPERIMENTS), ("campaign", CASES)):
        code, out, err = run(command, CALIBRATED, "--scenario", "help")
        assert (code, err) == (0, "")
        assert max(map(len, out.splitlines())) <= WIDTH
        own, _, general = out.partition("Every scenario takes")
        assert [line.split()[0] for line in own.splitlines()[4:] if line[:2].strip()] == list(names)
        assert [line.split()[0] for line in general.splitlines()[1:]] == list(SCENARIO_FIELDS)
    assert "radius=0.0002 m" in out


def test_options_of_the_version_before_become_what_replaces_them(capsys: pytest.CaptureFixture[str]) -> None:
    old = ["g.json", "--distance", "5", "--rise=3", "--no-quantize", "--tolerance", "99%", "--delay"]
    new = ["--option", "distance=5mm", "--option", "rise=3ms", "--option", "quantize=false"]
    assert renew(old) == ["g.json", *new, "--study", "tolerances", "--keep", "99%", "--delay"]
    said = capsys.readouterr().err.splitlines()
    assert said[0] == "malta: --distance goes with the next version: write --option distance=5mm"
    assert len(said) == 4
    assert renew(["g.json", "--sobol", "--json"]) == ["g.json", "--study", "sensitivity", "--json"]
    with pytest.raises(InputError, match="malta learn GAINS --strokes N"):
        renew(["g.json", "--strokes", "3"])


OLD = {
    "estimator": "kalman",
    "feedforward": "attraction",
    "bearing_axes": "turning",
    "delay": "2",
    "substeps": "3",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in SCENARIO_FIELDS if name not in ("settle", "accuracy")])
def test_a_general_option_is_that_of_its_old_flag(run: Run, name: str) -> None:
    """--option delay=2 for --delay 2: options of the version before work, and say what to write."""
    value = (OLD | {"fidelity": "dq", "noise": "2"}).get(name)
    flag = f"--{name.replace('_', '-')}"
    case = (
        () if name == "fidelity" else ("--option", f"fidelity={'phase' if name == 'real_pwm' else 'force'}")
    )
    old = (flag,) if value is None else (flag, value)
    new = ("--option", f"{name}={value or 'true'}")
    command = ("simulate", CALIBRATED, "--json", "--scenario", "hold", *case)
    found = [run(*command, *given) for given in (old, new)]
    assert found[0][:2] == found[1][:2]
    assert found[0].code == 0
    assert one_sentence(found[0].err) == f"{flag} goes with the next version: write {' '.join(new)}"


@pytest.mark.parametrize(
    ("text", "value"),
    [("delay=2", 2), ("substeps=3", 3), ("quantize=true", True), ("bearing=false", False),
     ("feedforward=attraction", "attraction"), ("bearing_axes=turning", "turning")],
)  # fmt: skip
def test_every_scenario_takes_general_options(plant: Plant, text: str, value: object) -> None:
    assert read_options([text], "hold", plant) == {text.partition("=")[0]: value}
    for wrong in (text, f"{text.partition('=')[0]}="):
        with pytest.raises(InputError):
            read_options([text, wrong], "hold", plant)


def test_a_size_has_the_unit_of_its_signals() -> None:
    plant = malta.read_design(ROOT / "examples/magnet/design/with_current.toml").plant
    read = partial(read_options, plant=plant)
    assert read(["size=50um", "time=20ms"], "step") == {"size": 50e-6, "time": 0.02}
    assert read(["size=700mN"], "disturbance") == read(["size=0.7"], "worst-load") == {"size": 0.7}
    with pytest.raises(InputError, match=r"--option: size\.unit: found 'mV', expected a unit of m"):
        read(["size=50mV"], "step")
    hybrid = malta.read_design(ROOT / "tests/foreign/hybrid/design/hybrid.toml").plant
    with pytest.raises(InputError, match="signals that have one in common, by output=NAME or on=NAME"):
        read_options(["size=50mA"], "disturbance", hybrid)
    load = hybrid.disturbances[0]
    assert read_options([f"size=50m{load.unit}", f"on={load.name}"], "disturbance", hybrid)["size"] == 0.05


def test_the_help_of_the_file_is_the_help_of_the_commands() -> None:
    """No library that reads arguments is imported for it."""
    program = "import sys, malta.__main__ as m; m.main(); assert 'typer' not in sys.modules"
    for arguments in (["-m", "malta", "--help", "--help"], ["-c", program, "--help"]):
        run = subprocess.run([sys.executable, *arguments], capture_output=True, text=True, check=True)
        assert HELP.read_text(encoding="ascii") == run.stdout, f"malta --help --help > {HELP}"


@pytest.mark.parametrize("command", [c.__name__ for group in cli.GROUPS.values() for c in group])
def test_help_has_less_than_fifty_lines_of_eighty_columns(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    lines = CliRunner().invoke(cli.app, [command, "--help"]).output.splitlines()
    assert len(lines) < 50
    assert max(map(len, lines)) <= 80


@pytest.mark.slow
def test_options_of_a_scenario_come_with_their_units(run: Run) -> None:
    def lifted(masses: str) -> dict[str, Any]:
        code, out, err = run("simulate", CALIBRATED, "--json", "--scenario", "payload", "--option", masses)
        assert (code, err) == (0, "")
        found: dict[str, Any] = json.loads(out)
        return found

    assert [case["label"] for case in lifted("masses=50g, 0.12")["cases"]] == ["50 g", "120 g"]
    quick = (
        "simulate",
        CALIBRATED,
        "--json",
        "--scenario",
        "tilt",
        "--option",
        "feedforward=axial",
        "--option",
    )
    circles = [run(*quick, f"radius={radius}")[1] for radius in ("0.1mm", "1e-4", "100 um")]
    assert circles == [circles[0]] * 3
    assert circles[0] != run(*quick, "radius=0.2mm")[1]
    held = run("simulate", CALIBRATED, "--json", "--scenario", "faults", "--option", "during=hold")
    assert held == run("simulate", CALIBRATED, "--json", "--scenario", "faults", "--option", "during=hold")


@pytest.mark.slow
def test_a_scenario_of_several_runs_writes_each_and_one_figure(run: Run, tmp_path: Path) -> None:
    code, out, err = run("simulate", CALIBRATED, "--scenario", "tilt", "--out", tmp_path)
    assert (code, err) == (0, "")
    assert max(map(len, (line for line in out.splitlines() if not line.startswith("wrote ")))) <= WIDTH
    names = sorted(path.name for path in tmp_path.iterdir())
    runs = [f"calibrated_tilt_feedforward_{kind}.npz" for kind in ("attraction", "axial")]
    assert names == ["calibrated_tilt.png", *runs]


@pytest.mark.slow
def test_findings_are_no_failures(run: Run) -> None:
    """Faults that end in touchdown are what was asked for; a lift-off that does not lift is a failure."""
    code, out, err = run("simulate", TABLE2, "--scenario", "payload", "--json")
    assert (code, err) == (0, "")
    cases = {case["label"]: case for case in json.loads(out)["cases"]}
    assert cases["200 g"]["verdict"]["name"].startswith("touchdown")
    assert cases["50 g"]["verdict"]["name"] == "completed"
    code, _, err = run(
        "simulate", TABLE2, "--scenario", "lift-off", "--option", "estimator=kalman", "--set", "I_max=0.5"
    )
    assert code == 1
    assert "lift-off: not lifted at 0.1499 s" in one_sentence(err)


def test_sensor_errors_are_taken(run: Run) -> None:
    def held(*options: str) -> float:
        code, out, _ = run("simulate", CALIBRATED, "--scenario", "hold", "--json", *options)
        assert code == 0
        value: float = json.loads(out)["merits"]["true_x1_rms_m"]
        return value

    assert held("--sensor", "offset_x1=20um", "--sensor", "gain_y1=2%") > 15e-6 > 1e-6 > held()


def test_the_number_of_substeps_comes_with_an_error(run: Run) -> None:
    code, out, _ = run("simulate", CALIBRATED, "--option", "fidelity=force", "--option", "substeps=1")
    assert code == 0
    estimate = re.search(r"integration error, estimated: (\S+) m", out)
    assert estimate is not None
    assert 1e-13 < float(estimate[1]) < 1e-10


def test_without_a_compiler_it_says_so(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    from malta.simulation.engine import compiled
    from malta.simulation.engine.engines import engine_of, library_of

    monkeypatch.setattr(compiled, "compiler", lambda: None)
    for cached in (library_of, engine_of):
        cached.cache_clear()
    code, out, err = run("simulate", CALIBRATED)
    assert (code, "completed" in out) == (0, True)
    assert one_sentence(err).startswith("no C compiler: simulated on CasADi's virtual machine")
    code, _, err = run("simulate", CALIBRATED, "--engine", "compiled")
    assert code == 2
    assert "engine: found no C compiler that works" in one_sentence(err)
    for cached in (library_of, engine_of):
        cached.cache_clear()


@pytest.mark.slow
def test_ctrl_c_leaves_what_was_computed(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    module = sys.modules["malta.simulation.simulate"]
    looked = 0
    judged = module.judge

    def interrupted(*arguments: Any) -> Any:
        nonlocal looked
        looked += 1
        if looked == 3:
            raise KeyboardInterrupt
        return judged(*arguments)

    monkeypatch.setattr(module, "PORTION", 1000)
    monkeypatch.setattr(module, "judge", interrupted)
    code, out, err = run("simulate", CALIBRATED, "--scenario", "hold", "--out", tmp_path)
    assert code == 130
    assert "interrupted at 0.09" in one_sentence(err)
    with np.load(tmp_path / "calibrated_hold.npz") as archive:
        assert len(archive["t"]) == 2000
    assert "measured x1, std" in out


@pytest.mark.slow
def test_claims_prints_the_ledger(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a table, as JSON and as Markdown; it is computed once, as nothing but its form differs."""
    computed: list[Ledger] = []

    def once(specs: Sequence[Spec], *of: Any) -> Ledger:
        assert [spec.name for spec in specs] == ["halbach"]
        if not computed:
            computed.append(compute(specs, *of))
        return computed[0]

    compute = malta.ledger
    monkeypatch.setattr("malta.report.ledger.ledger", once)
    code, out, err = run("claims", "design/halbach.toml")
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines())) <= WIDTH
    assert out.startswith("Published numbers and ours: halbach, L. C. Díaz-Pérez et al.")
    assert "204.8  reproduced" in out
    assert "not reproduced" not in out
    assert len(out.splitlines()) == 4 + len(computed[0].claims)
    code, out, err = run("claims", "design/halbach.toml", "--why")
    assert max(map(len, out.splitlines())) <= WIDTH
    assert "  not reproduced; " in out
    code, out, err = run("claims", "design/halbach.toml", "--json")
    assert (code, err) == (0, "")
    (ledger,) = json.loads(out)["ledgers"]
    assert (ledger["machine"], ledger["designs"]) == ("halbach", ["halbach"])
    ours = {claim["subject"]: claim["ours"] for claim in ledger["claims"]}
    assert ours["stiffness at 1 N: secant over 2 mm [N/m]"] == ["204.8"]
    code, out, err = run("claims", "design/halbach.toml", "--markdown")
    heading, empty, header = out.splitlines()[:3]
    assert (heading, empty) == (f"### halbach, {ledger['source']}", "")
    assert header == "| claim | published | `halbach` | verdict |"


# --- bad input ---


@pytest.mark.slow_for(
    "design examples/ball/design/ball.toml --out pyproject.toml/gains-pyproject.toml/gains/ball.json-a place"
)
@pytest.mark.parametrize(
    ("arguments", "found", "expected"),
    [
        ("design nothing.toml", "nothing.toml: found no such file", "a TOML file"),
        ("design design", "design: found Is a directory", "a readable TOML file"),
        ("design data/tubular.toml", "data/tubular.toml: default_preset: found an unknown key", "name"),
        (f"design {BALL} --out pyproject.toml/gains", "pyproject.toml/gains/ball.json", "a place"),
        ("verify nothing.json", "nothing.json: found no such file", "a gain file"),
        ("verify nothing.txt", "nothing.txt: found suffix '.txt'", "one of .json, .npz, .mat"),
        ("verify pyproject.toml", "pyproject.toml: found suffix '.toml'", "one of .json, .npz, .mat"),
        ("verify TABLE2 --set K_A=-1", "--set: K_A: found -1", "a finite number of at least 0 in N/m"),
        ("simulate nothing.json", "nothing.json: found no such file", "a gain file"),
        ("simulate TABLE2 --scenario orbit", "scenario: found 'orbit'", "one of stroke, hold, tilt"),
        ("simulate TABLE2 --scenario hold --option rise=3ms", "rise: found an option of another scenario", "none"),
        ("simulate TABLE2 --scenario faults --option during=lunch", "faults: during: found 'lunch'", "stroke or hold"),
        ("simulate TABLE2 --option foo=1", "stroke: foo: found an unknown option", "distance profile rise"),
        ("simulate TABLE2 --option masses=50g", "stroke: masses: found an option of another scenario", "distance"),
        ("simulate TABLE2 --option distance", "--option: found 'distance'", "NAME=VALUE"),
        ("simulate TABLE2 --option distance=far", "--option: distance: found 'far'", "a number"),
        ("simulate TABLE2 --option distance=3kg", "--option: distance.unit: found 'kg'", "a unit of m"),
        ("simulate TABLE2 --option rise=5ms --option rise=6ms", "rise: found '6ms' for the second", "it once"),
        ("simulate TABLE2 --scenario orbit --option a=1", "scenario: found 'orbit'", "one of stroke, hold, tilt"),
        ("campaign TABLE2 --scenario hold --option radius=1", "radius: found an option of another", "none of its"),
        ("simulate TABLE2 --option fidelity=exact", "fidelity: found 'exact'", "one of force, dq, phase"),
        ("simulate TABLE2 --option estimator=ukf", "estimator: found 'ukf'", "one of steady-state, kalman, extended"),
        ("simulate TABLE2 --engine jit", "engine: found 'jit'", "one of auto, compiled, virtual machine"),
        ("simulate TABLE2 --option real_pwm=true", "real_pwm: found fidelity dq", "fidelity phase"),
        ("simulate TABLE2 --option substeps=0", "substeps: found 0", "a number above 0"),
        ("simulate TABLE2 --sensor gain_q=1", "--sensor: gain_q: found an unknown sensor error", "gain_x1"),
        ("simulate TABLE2 --sensor gain_x1=1mm", "--sensor: gain_x1.unit: found 'mm'", "no unit, or %"),
        ("claims nothing.toml", "nothing.toml: found no such file", "a TOML file"),
        ("simulate TABLE2 --set q=1", "--set: q: found an unknown parameter", "one of m I_xx I_yy"),
        ("simulate TABLE2 --set preset=1", "--set: preset: found an unknown parameter", "one of m I_xx I_yy"),
        ("simulate TABLE2 --set m=abc", "--set: found 'm=abc'", "NAME=VALUE, as m=0.56"),
        ("simulate TABLE2 --set m", "--set: found 'm'", "NAME=VALUE, as m=0.56"),
        ("simulate TABLE2 --set m=nan", "--set: found 'm=nan'", "NAME=VALUE"),
        ("simulate TABLE2 --set m=3m", "--set: m.unit: found 'm'", "a unit of kg"),
        ("simulate TABLE2 --set w_cc=3000Hz", "--set: w_cc.unit: found 'Hz'", "a unit of rad/s"),
        ("simulate TABLE2 --set m=3xyz", "--set: m.unit: found 'xyz'", "a unit of kg"),
        ("simulate TABLE2 --set m=-1", "--set: m: found -1", "a finite number above 0 in kg"),
        ("simulate TABLE2 --set m=0", "--set: m: found 0", "a finite number above 0 in kg"),
        ("simulate TABLE2 --set m=1e999", "--set: m: found inf kg", "a finite number above 0 in kg"),
        ("simulate TABLE2 --option profile=cubic", "profile: found 'cubic'", "one of logistic, quintic"),
        ("simulate TABLE2 --option rise=0ms", "rise: found 0.0 s", "a time from 1e-6 to 1e6 s"),
        ("simulate TABLE2 --option rise=nanms", "rise: found 'nanms'", "a number"),
        ("simulate TABLE2 --option rise=1e-300ms", "rise: found 1.0", "a time from 1e-6 to 1e6 s"),
        ("simulate TABLE2 --option rise=1e300ms", "rise: found 1e+297 s", "a time from 1e-6 to 1e6 s"),
        ("simulate TABLE2 --option rise=-16.2ms", "rise: found -0.0162 s", "a time from 1e-6 to 1e6 s"),
        ("simulate TABLE2 --option distance=40mm", "start: found -0.02 m", "travel of +-0.015 m"),
        ("simulate TABLE2 --option distance=nanmm", "distance: found 'nanmm'", "a number"),
        ("simulate TABLE2 --option distance=0mm", "distance: found 0.0 m", "a finite distance other than 0 m"),
        ("simulate TABLE2 --option noise=inf", "noise: found 'inf'", "a number"),
        ("simulate TABLE2 --option noise=-1", "noise: found -1.0", "0 or more"),
        ("simulate TABLE2 --option delay=-1", "delay: found -1", "0 or more"),
        ("simulate TABLE2 --seed -1", "seed: found -1", "0 or more"),
        ("simulate TABLE2 --set z_max=1mm", "start: found -0.005 m", "travel of +-0.001 m"),
        ("simulate TABLE2 --out pyproject.toml/x", "pyproject.toml/x/table2_stroke.npz: found", "a place"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence(run: Run, arguments: str, found: str, expected: str) -> None:
    code, out, err = run(*arguments.replace("TABLE2", TABLE2).split(" "))
    assert code == 2
    assert out == ""
    said, _, wanted = one_sentence(err).partition(", expected ")
    assert found in said
    assert expected in wanted


def test_damaged_gain_file_is_one_sentence(run: Run, tmp_path: Path) -> None:
    for name in NAMES:
        path = tmp_path / name
        path.write_bytes((ROOT / "design" / "gains" / name).read_bytes()[:5000])
        for command in ("verify", "simulate"):
            code, out, err = run(command, path)
            assert (code, out) == (2, "")
            assert one_sentence(err).startswith(f"{path}: found a damaged or foreign file (")


def test_edited_gain_file_is_refused(run: Run, tmp_path: Path) -> None:
    path = tmp_path / "table2.json"
    text = (ROOT / TABLE2).read_text()
    path.write_text(text.replace('"value": 0.36,', '"value": 0.37,', 1))
    code, out, err = run("simulate", path)
    assert (code, out) == (2, "")
    assert one_sentence(err).startswith(
        f"{path}: sha256: found content that was changed or damaged, expected "
    )


@pytest.mark.slow
def test_design_that_cannot_be_written_leaves_old_gains(run: Run, tmp_path: Path) -> None:
    old = old_gains(tmp_path / "gains", BALLS)
    blocked = tmp_path / "gains" / "ball.mat"
    blocked.unlink()
    blocked.mkdir()
    del old[blocked]
    code, out, err = run("design", BALL, "--out", tmp_path / "gains", "--figures", tmp_path / "f")
    assert (code, out) == (2, "")
    assert one_sentence(err).startswith(f"{blocked}: found a folder of that name, expected a place")
    assert {path: path.read_bytes() for path in old} == old
    assert sorted(path.name for path in (tmp_path / "gains").iterdir()) == list(BALLS)


def test_no_design_files_at_all(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = run("design")
    assert (code, out) == (2, "")
    assert one_sentence(err).startswith("design: found no design files (*.toml) here, expected ")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ("simulate TABLE2 --seed one", "--seed: found 'one'"),
        ("simulate TABLE2 --speed 3", "--speed"),
        ("simulate TABLE2 --set", "--set"),
        ("verify", "GAINS"),
        ("fly", "fly"),
    ],
)
def test_wrong_usage_names_the_option(run: Run, arguments: str, named: str) -> None:
    code, out, err = run(*arguments.replace("TABLE2", TABLE2).split())
    assert (code, out) == (2, "")
    assert "Traceback" not in err
    assert named in err.splitlines()[-1]


# --- as a program ---


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code", "lines"),
    [
        (["verify", "nothing.json"], 2, 1),
        (["simulate", TABLE2, "--set", "m=0.56"], 1, 1),
        (["verify", TABLE2, "--no-proof"], 0, 0),
    ],
)
def test_program_ends_with_the_exit_code(arguments: list[str], code: int, lines: int) -> None:
    program = [sys.executable, "-c", "from malta.cli.main import main; main()", *arguments]
    done = subprocess.run(program, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == code
    assert len(without_progress(done.stderr).splitlines()) == lines
    assert max(map(len, done.stdout.splitlines()), default=0) <= WIDTH


@pytest.mark.slow
def test_terminal_without_greek_letters_shows_the_page(tmp_path: Path) -> None:
    file = project(tmp_path, (SUMMARY, f"{SUMMARY}weights α and Σ, "))
    command = [
        sys.executable,
        "-W",
        "error",
        "-c",
        "from malta.cli.main import main; main()",
        "design",
        str(file),
    ]
    environment = os.environ | {"PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        command, cwd=tmp_path, env=environment, capture_output=True, timeout=600, check=False
    )
    assert (done.returncode, without_progress(done.stderr.decode("ascii"))) == (0, "")
    assert b"table2: weights ? and ?, the paper's weights" in done.stdout
    assert (tmp_path / "design" / "gains" / "table2.json").is_file()


def test_version(run: Run) -> None:
    assert run("--version") == (0, f"malta {version('malta')}\n", "")


@pytest.mark.slow
def test_python_runs_the_package_as_the_program() -> None:
    command = [sys.executable, "-W", "error", "-m", "malta", "check", "nothing.json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert one_sentence(done.stderr).startswith("nothing.json: found ")


def test_published_figures_are_found_from_any_folder(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gains = Path("design/gains/calibrated.json").resolve()
    monkeypatch.chdir(tmp_path)
    code, out, err = run("simulate", gains)
    assert (code, err) == (0, "")
    assert "<=" in out


@pytest.mark.slow
@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
@pytest.mark.parametrize("buffered", ["", "1"])
def test_full_device_is_refused_in_a_sentence(buffered: str) -> None:
    environment = os.environ | {"PYTHONUNBUFFERED": buffered}
    command = [sys.executable, "-m", "malta", "--version"]
    sentence = b"malta: standard output: found No space left on device, expected a place to write to\n"
    with Path("/dev/full").open("wb") as full:
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, env=environment, check=False)
        assert (ended.returncode, ended.stderr) == (2, sentence)
        command = [sys.executable, "-m", "malta", "check", "nothing"]
        assert subprocess.run(command, stdout=full, stderr=full, env=environment, check=False).returncode == 2


def test_reader_that_has_read_enough_is_no_error() -> None:
    line = f"{sys.executable} -m malta --help | head -1"
    ended = subprocess.run(["sh", "-c", line], capture_output=True, text=True, check=False)
    assert (ended.stdout.count("Usage"), ended.stderr) == (1, "")
    read, write = os.pipe()
    os.close(read)
    for arguments in (["--version"], ["verify", "--help"], ["schema", "verify-output"]):
        command = [sys.executable, "-m", "malta", *arguments]
        closed = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, check=False)
        assert (closed.returncode, closed.stderr) == (0, b"")
    os.close(write)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("simulate", TABLE2, "--seed", "x"), "--seed: found 'x', expected a whole number"),
        (("campaign", TABLE2, "--samples", "1.5"), "--samples: found '1.5', expected a whole number"),
        (("pil", TABLE2, "--port", "p", "--timeout", "y"), "--timeout: found 'y', expected a number"),
        (
            ("tune", "design/robust.toml", "--generations", "-1"),
            "--generations: found '-1', expected a number greater than or equal to 0",
        ),
    ],
)
def test_numbers_that_are_none_get_a_sentence(arguments: tuple[str, ...], sentence: str, run: Run) -> None:
    code, _, err = run(*arguments)
    assert (code, err) == (2, f"malta: {sentence}; see malta {arguments[0]} --help\n")


@pytest.mark.parametrize("command", ["", "verify", "campaign"])
def test_a_short_word_asks_for_help(command: str) -> None:
    whole, short = (CliRunner().invoke(cli.app, [*command.split(), word]).output for word in ("--help", "-h"))
    assert whole == short
    assert whole.startswith("Usage:")


@pytest.mark.parametrize("name", ["control", "malta", "numpy", "json", "class", "spec", "notebook", "par"])
def test_a_new_machine_takes_no_name_that_its_files_need(
    name: str, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A folder of that name would stand before the module, or a line of the notebook means something else."""
    monkeypatch.chdir(tmp_path)
    code, out, err = run("new", name)
    assert (code, out, list(tmp_path.iterdir())) == (2, "", [])
    assert one_sentence(err).startswith(
        f"malta new: NAME: found {name!r}, which Python, the module or the notebook has"
    )
