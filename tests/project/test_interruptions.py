"""Ctrl-C on real processes, and lines that say how far work is."""

from __future__ import annotations

import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer
from conftest import ROOT, Run
from page_examples import PROGRESS

from malta.cli import output
from malta.writing import noting_files, replace_files

TABLE2, ROBUST = "design/gains/table2.json", "design/gains/robust.json"


@pytest.fixture(autouse=True)
def own_handler() -> Iterator[None]:
    """Ctrl-C raises KeyboardInterrupt, also where the tests run in the background of a shell, which ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def spent(process: subprocess.Popen[str]) -> float:
    """Seconds of processor time of a process, which others do not lengthen; infinite where it has ended."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except FileNotFoundError:
        return math.inf
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def interrupted(wait: float, *arguments: str | Path) -> tuple[int, list[str]]:
    """Run `malta ARGUMENTS`, press Ctrl-C after some seconds of its own: exit code, sentences but those of progress.

    Ctrl-C is pressed again after a while, as users do: while files are read, a library may drop it.
    """
    command = [sys.executable, "-m", "malta", *map(str, arguments)]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment, cwd=ROOT
    )
    if not Path("/proc/self/stat").exists():
        time.sleep(wait)
    while process.poll() is None and spent(process) < wait:
        time.sleep(0.02)
    if process.poll() is not None:
        process.communicate()
        pytest.skip("the command had ended")
    process.send_signal(signal.SIGINT)
    try:
        _, err = process.communicate(timeout=5)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=600)
    return process.returncode, [line for line in err.splitlines() if not PROGRESS.fullmatch(line)]


NOTHING = "interrupted; nothing was written"
COMMANDS: tuple[tuple[tuple[str, ...], str], ...] = (
    (("verify", ROBUST, "--json"), r"interrupted; (proven [\d.]+ %, lost at .*|nothing proven)"),
    (("claims", "--json"), NOTHING),
    (("design", "--out", "OUT", "--figures", "OUT"), r"interrupted; complete: .*; all other files stand .*"),
    (
        ("campaign", TABLE2, "--samples", "100000", "--yes", "--out", "OUT"),
        r"interrupted after \d+ of 100000 runs, which .* keeps; the same command goes on",
    ),
    (
        ("tune", "design/robust.toml", "--out", "OUT"),
        r"interrupted; the same command goes on from .*robust_trials.jsonl",
    ),
    (("simulate", TABLE2, "--scenario", "capture", "--option", "points=201", "--yes"), "interrupted: .*"),
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wait", "arguments", "sentence"),
    [(0.3, *COMMANDS[0]), *((wait, *command) for wait in (0.7, 4.0) for command in COMMANDS)],
)
def test_ctrl_c_says_what_stands(
    wait: float, arguments: tuple[str, ...], sentence: str, tmp_path: Path
) -> None:
    code, said = interrupted(wait, *(str(tmp_path) if a == "OUT" else a for a in arguments))
    assert code == 130
    assert len(said) <= 1  # none where Python itself had not begun
    known = f"malta: ({sentence}|{NOTHING}|interrupted)"
    assert all(re.fullmatch(known, line) for line in said)
    assert not [path for path in tmp_path.rglob(".*") if path.is_file()]  # half-written


@pytest.mark.slow
def test_a_piped_proof_says_how_far_it_is_and_prints_one_document() -> None:
    command = [sys.executable, "-m", "malta", "verify", ROBUST, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    lines = done.stderr.splitlines()
    assert len(lines) >= 2
    assert all(PROGRESS.fullmatch(line) for line in lines)
    assert any("proven 3" in line for line in lines)
    assert done.stdout.startswith("{")


def said_by(capsys: pytest.CaptureFixture[str]) -> list[str]:
    """The next lines on standard error, however long the machine takes for them."""
    lines: list[str] = []
    while not lines:
        time.sleep(0.02)
        lines = capsys.readouterr().err.splitlines()
    return lines


def test_work_speaks_when_it_reports_and_when_it_does_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(output, "PATIENCE", 0.0)
    monkeypatch.setattr(output, "INTERVAL", 0.05)
    with output.progress_on("sorting") as work:
        silent = said_by(capsys)
        work.report(0.25)
        work.bound(0.5, float("inf"))
        said_by(capsys)  # perhaps of before the bound
        last = said_by(capsys)[-1]
    assert silent
    assert re.fullmatch(
        r"malta: sorting: proven 50\.00 %, lost at not found, 25 %, [\d.e-]+ s, about [\d.e-]+ s left", last
    )
    with output.progress_on("nothing"):
        pass
    monkeypatch.setattr(output, "PATIENCE", 10.0)
    with output.progress_on("quick work") as work:
        work.report(0.5)
    assert "quick" not in capsys.readouterr().err


def test_ctrl_c_that_a_library_drops_is_pressed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    def wait(seconds: float, *, insists: bool) -> None:
        with output.progress_on("sorting", insists=insists) as work:
            work.pressed.append(0.0)  # long ago
            time.sleep(seconds)

    monkeypatch.setattr(output, "INTERRUPT_TIME", 0.05)
    with pytest.raises(KeyboardInterrupt):
        wait(60, insists=True)
    wait(0.4, insists=False)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_in_the_c_code_of_a_library_is_an_interruption(capsys: pytest.CaptureFixture[str]) -> None:
    """CasADi ends with SystemError, "returned a result with an exception set", whose cause is Ctrl-C."""

    def margins(cause: BaseException | None) -> None:
        with output.margin_progress("margins") as (_, bound):
            bound(2.5, 3.5)
            raise SystemError from cause

    with pytest.raises(typer.Exit) as ended:
        margins(KeyboardInterrupt())
    assert ended.value.exit_code == 130
    assert capsys.readouterr().err == "malta: interrupted; proven 250.00 %, lost at 350.00 %\n"
    for cause in (None, ValueError()):
        with pytest.raises(SystemError):
            margins(cause)


def test_an_interruption_waits_until_all_files_are_in_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C between two files of one design."""
    targets = {tmp_path / name: name.encode() for name in ("a.json", "b.json", "c.json")}
    renamed, replace = [], Path.replace

    def slowly(self: Path, target: Path) -> Path:
        renamed.append(target)
        if len(renamed) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", slowly)
    with noting_files() as written, pytest.raises(KeyboardInterrupt):
        replace_files(targets)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == targets
    assert written == list(targets)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_ctrl_c_names_the_files_that_are_complete(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def written_then_cut(*_: object, **__: object) -> None:
        replace_files({tmp_path / "done.json": b"{}"})
        raise KeyboardInterrupt

    def cut(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("malta.gains.certified.check", cut)
    said = run("check", "nothing.json")
    assert said == (130, "", "malta: interrupted; nothing was written\n")
    monkeypatch.setattr("malta.gains.certified.check", written_then_cut)
    said = run("check", "nothing.json")
    stands = f"complete: {tmp_path / 'done.json'}; all other files stand as they were"
    assert said.err == f"malta: interrupted; {stands}\n"
