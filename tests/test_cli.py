"""The command line: what it prints and writes, its exit codes, and one sentence for everything that is wrong."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from malta import cli

ROOT = Path(__file__).parents[1]
TABLE2, CALIBRATED = "design/gains/table2.json", "design/gains/calibrated.json"
WIDTH = 100
HEAVY = ("numpy", "scipy", "casadi", "control", "matplotlib", "pydantic", "pint", "rich")
GAINS = ("table2.json", "table2.mat", "table2.npz")

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run `malta ARGUMENTS`: exit code, standard output, standard error."""

    def runs(*arguments: str | Path) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["malta", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        code = ended.value.code
        return (code if isinstance(code, int) else int(code is not None)), out, err

    return runs


def project(folder: Path, *changes: tuple[str, str], machine: tuple[tuple[str, str], ...] = ()) -> Path:
    """A project with the machine's data and one design, table2; texts replaced, each of which stands there once."""
    (folder / "design").mkdir()
    shutil.copytree(ROOT / "data", folder / "data")
    for name, edits in (("design/table2.toml", changes), ("data/tubular.toml", machine)):
        text = (ROOT / name).read_text(encoding="utf-8")
        for old, new in edits:
            assert text.count(old) == 1, old
            text = text.replace(old, new)
        (folder / name).write_text(text, encoding="utf-8")
    return folder / "design" / "table2.toml"


def old_gains(folder: Path) -> dict[Path, bytes]:
    """Files in the place of gain files, and what is in them."""
    folder.mkdir(parents=True)
    old = {folder / name: f"old {name}".encode() for name in GAINS}
    for path, content in old.items():
        path.write_bytes(content)
    return old


def numbers(content: Any) -> list[float]:
    """Every number in a JSON document; null counts as NaN."""
    if isinstance(content, dict):
        return [number for entry in content.values() for number in numbers(entry)]
    if isinstance(content, list):
        return [number for entry in content for number in numbers(entry)]
    if content is None:
        return [math.nan]
    return [float(content)] if isinstance(content, (int, float)) else []


def one_sentence(err: str) -> str:
    """The one line on standard error, without the name of the program."""
    assert "Traceback" not in err
    assert err.startswith("malta: ")
    assert err.count("\n") == 1
    return err.removeprefix("malta: ").rstrip("\n")


# --- help ---


@pytest.mark.parametrize("command", ["design", "verify", "simulate"])
def test_help_of_each_command_shows_an_example(command: str) -> None:
    result = CliRunner().invoke(cli.app, [command, "--help"])
    assert result.exit_code == 0
    assert re.search(rf"Example: +malta {command} design/", result.output)
    assert "--json" in result.output


def test_examples_in_the_help_can_be_run(run: Run, tmp_path: Path) -> None:
    for command in ("verify", "simulate"):
        text = " ".join(CliRunner().invoke(cli.app, [command, "--help"]).output.split())
        found = re.search(r"Example: malta (.*?) (?:Arguments|Options)", text)
        assert found is not None
        arguments = [str(tmp_path) if a == "build" else a for a in found[1].split()]
        assert run(*arguments)[::2] == (0, "")


def test_help_names_commands_and_exit_codes() -> None:
    result = CliRunner().invoke(cli.app, ["--help"])
    assert result.exit_code == 0
    for expected in ("design", "verify", "simulate", "Exit codes: 0", "1 a check failed", "2 bad input"):
        assert expected in " ".join(result.output.split())


@pytest.mark.parametrize("arguments", ["--help", "design --help", "simulate --help", "verify nothing.json"])
def test_help_waits_for_no_numerics(arguments: str) -> None:
    heavy = HEAVY if "help" in arguments else ("casadi", "matplotlib")
    program = (
        "import sys\nimport malta.cli\n"
        "try:\n    malta.cli.main()\nexcept SystemExit:\n    pass\n"
        "print(sorted(set(sys.modules) & set(sys.argv[-1].split(','))))"
    )
    if "help" not in arguments:
        program = "import sys\nimport malta.cli\nprint(sorted(set(sys.modules) & set(sys.argv[-1].split(','))))"
        heavy = HEAVY
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments.split()],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert heavy
    assert done.stdout


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
    written = sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))
    assert written == [
        *(f"figures/{name}_stroke.png" for name in ("calibrated", "table2")),
        *(f"gains/{name}.{suffix}" for name in ("calibrated", "table2") for suffix in ("json", "mat", "npz")),
    ]
    for name in written:
        assert (folder / name).name in printed
    assert (folder / "figures" / "table2_stroke.png").read_bytes().startswith(b"\x89PNG")
