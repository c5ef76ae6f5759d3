"""An installed malta is whole: from a wheel, in an empty environment, in a folder of its own."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest
from conftest import ROOT
from page_examples import without_progress

README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = (ROOT / "docs" / "howto" / "commands.md").read_text(encoding="utf-8")
SOURCES = (
    "malta",
    "data",
    "design",
    "notebooks",
    "examples",
    "pyproject.toml",
    "setup.py",
    "MANIFEST.in",
    "README.md",
)
SHORTER = {  # commands of the page that take minutes, or a target, as the same commands with less to do
    "malta tune design/robust.toml": "malta tune design/robust.toml --check",
    "malta tune design/halbach_pid.toml": "malta tune design/halbach_pid.toml --generations 0 --front 0",
    "malta campaign design/gains/calibrated.json --spread 20%": "malta campaign design/gains/calibrated.json "
    "--spread 20% --samples 32 --out campaign",
    "malta simulate design/gains/calibrated.json --replay FOLDER:17": "malta simulate design/gains/calibrated.json "
    "--replay campaign:17",
    "malta campaign --status FOLDER": "malta campaign --status campaign",
    "malta campaign design/gains/table2.json --spread 5.5% --study rare": "malta campaign design/gains/table2.json "
    "--spread 20% --study rare --limit touchdown --samples 2000",
    "malta campaign design/gains/robust.json --study tolerances --keep 99% --limit published": "malta campaign "
    "design/gains/robust.json --study tolerances --keep 99% --limit published --samples 64",
    "malta export design/gains/robust.json --to fmu --platforms all": "malta export design/gains/robust.json --to fmu",
    "malta pil design/gains/robust.json --port /dev/ttyUSB0": "malta pil --help",
    "malta claims": "malta claims design/table2.toml",
}

OF_PAPERS = re.compile(r"malta claims|--scenario (force|errors)")  # commands that malta-papers has

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of programs of an environment that has the wheel and what it depends on, and nothing else."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    source.mkdir()
    for name in SOURCES:
        path = ROOT / name
        ignored = shutil.ignore_patterns("__pycache__")
        shutil.copytree(path, source / name, ignore=ignored) if path.is_dir() else shutil.copy(path, source)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet"]
    environment = os.environ | {"PIP_CONSTRAINT": ""}
    command = [*pip, "wheel", "--no-deps", "--wheel-dir", str(folder), str(source)]
    built = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    if built.returncode and "No matching distribution" in built.stderr:
        pytest.skip("no package index to fetch the build system from")
    assert built.returncode == 0, built.stderr
    shutil.copytree(
        ROOT / "papers", folder / "papers", ignore=shutil.ignore_patterns("__pycache__", "*.egg-info")
    )
    command = [*pip, "wheel", "--no-deps", "--wheel-dir", str(folder), str(folder / "papers")]
    subprocess.run(command, env=environment, capture_output=True, check=True, timeout=300)
    (wheel,) = folder.glob("malta-*.whl")
    venv.create(folder / "environment", with_pip=True)
    bin_ = folder / "environment" / "bin"
    pip[0] = str(bin_ / "python")
    constraints = ["--constraint", str(ROOT / "constraints.txt")]
    command = [*pip, "install", *constraints, str(wheel)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=900)
    assert done.returncode == 0, done.stderr
    return bin_


def own_environment() -> dict[str, str]:
    found = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    return found | {"MPLBACKEND": "agg", "OPENBLAS_NUM_THREADS": "1"}


def run(program: Path, folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(program / command[0]), *command[1:]],
        cwd=folder,
        env=own_environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=600,
    )


def assert_serves(program: Path, folder: Path, *command: str) -> None:
    """The command prints its address and serves the page until Ctrl-C."""
    whole = [str(program / command[0]), *command[1:], "--no-browser"]
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(whole, cwd=folder, env=own_environment(), **pipes) as server:
        assert server.stdout is not None
        with urlopen(server.stdout.readline().strip(), timeout=600) as page:
            assert page.status == 200
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=600) == 0


def test_the_readmes_lines_and_all_commands(program: Path, tmp_path: Path) -> None:
    """Five lines of Python, then every command, from a folder that has nothing."""
    code = re.search(r"```python\n(.*?)```", README, re.S)
    assert code is not None
    done = run(program, tmp_path, "python", "-c", code[1])
    assert (done.returncode, without_progress(done.stderr)) == (0, "")
    assert done.stdout.startswith("stable with hold, delay and current loops")
    every = re.findall(r"^(malta .*?)(?: +#.*)?$", COMMANDS, re.M)
    lines = [
        line for line in every if "rotor" not in line
    ]  # commands on a machine of one's own have a test of theirs
    assert len(lines) >= 12
    for line in lines:
        if line.startswith("malta app"):
            assert_serves(program, tmp_path, *shlex.split(line))
            continue
        done = run(program, tmp_path, *shlex.split(SHORTER.get(line, line)))
        extra = "--study sensitivity" in line and "pip install 'malta[sensitivity]'" in done.stderr
        if OF_PAPERS.search(line):
            assert "malta-papers: pip install ./papers" in done.stderr
            extra = True
        assert done.returncode == (2 if extra else 0), (line, done.stderr)
        assert "Traceback" not in done.stderr
    assert (tmp_path / "design" / "gains" / "table2.json").is_file()
    assert (tmp_path / "build" / "robust_margins.png").is_file()


def test_a_machine_of_ones_own(program: Path, tmp_path: Path) -> None:
    """`malta new`, its notebook and its design, verified and flown."""
    assert run(program, tmp_path, "malta", "new", "lev").returncode == 0
    folder = tmp_path / "lev"
    done = run(program, folder, "malta", "design")
    assert (done.returncode, without_progress(done.stderr)) == (0, "")
    for command in ("verify", "simulate"):
        done = run(program, folder, "malta", command, "design/gains/lev.json", "--machine", "lev.py")
        assert (done.returncode, without_progress(done.stderr)) == (0, "")
    done = run(program, folder, "python", "notebook.py")
    assert (done.returncode, without_progress(done.stderr)) == (0, "")
    assert "open-loop poles" in done.stdout


def test_the_rotor_of_the_examples(program: Path, tmp_path: Path) -> None:
    """As it comes with the wheel, in an empty folder: its PID designed, verified and flown."""
    where = run(
        program,
        tmp_path,
        "python",
        "-c",
        "from malta.files import shipped_path; print(shipped_path('examples', 'rotor'))",
    )
    folder = tmp_path / "rotor"
    shutil.copytree(where.stdout.strip(), folder)
    assert "shipped" in where.stdout
    done = run(program, folder, "malta", "design", "design/rotor_pid.toml")
    assert (done.returncode, without_progress(done.stderr)) == (0, "")
    assert "for all Omega in 0 .. 2094 rad/s" in " ".join(done.stdout.split())
    gains = ("design/gains/rotor_pid.json", "--machine", "rotor.py")
    for command in (("verify", *gains, "--no-proof"), ("simulate", *gains, "--scenario", "step")):
        done = run(program, folder, "malta", *command)
        assert (done.returncode, without_progress(done.stderr)) == (0, "")


def test_a_script_beside_a_checkout_imports_the_package(tmp_path: Path) -> None:
    """A folder malta beside a script, as a checkout is, would be a package without files of its own."""
    (tmp_path / "malta").mkdir()
    script = tmp_path / "script.py"
    script.write_text("import malta; print(malta.read_design.__name__)")
    ended = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert (ended.stdout, ended.stderr) == ("read_design\n", "")


def test_papers_are_found_once_they_are_installed(program: Path, tmp_path: Path) -> None:
    """The last test of this environment: the commands that it refused before."""
    (wheel,) = program.parents[1].glob("malta_papers-*.whl")
    command = [str(program / "python"), "-m", "pip", "--quiet", "install", "--no-deps", str(wheel)]
    subprocess.run(command, env=own_environment(), check=True, timeout=300)
    lines = [
        line for line in re.findall(r"^(malta .*?)(?: +#.*)?$", COMMANDS, re.M) if OF_PAPERS.search(line)
    ]
    assert len(lines) >= 3
    for line in lines:
        done = run(program, tmp_path, *shlex.split(SHORTER.get(line, line)))
        assert (done.returncode, "Traceback" in done.stderr) == (0, False), (line, done.stderr)
