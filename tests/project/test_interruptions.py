"""Ctrl-C on real processes, and lines that say how far work is."""

from __future__ import annotations

import json
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

import malta
from malta.cli import output
from malta.interrupts import watch_interrupts
from malta.work import count_work, current_meter, is_stopped, share_time
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
    said = [line for line in err.splitlines() if not PROGRESS.fullmatch(line)]
    return process.returncode, [line for line in said if not line.endswith("once more ends at once")]


NOTHING = "interrupted; nothing was written"
COMMANDS: tuple[tuple[tuple[str, ...], str], ...] = (
    (
        ("verify", ROBUST, "--json"),
        r"interrupted; (proven [\d.]+ %, lost at .*|what is known by then is above)",
    ),
    (("claims", "--json"), r"interrupted; missing are .*"),
    (
        ("design", "--out", "OUT", "--figures", "OUT"),
        r"interrupted; \d+ of \d+ designs are whole; gain files stand as they were of .*",
    ),
    (
        ("excite", ROBUST, "--periods", "150", "--log", "OUT/log.npz"),
        r"interrupted; (the flight ended .*|what is .*)",
    ),
    (("learn", ROBUST, "--strokes", "500"), r"interrupted; \d+ of 500 strokes were flown"),
    (
        ("campaign", TABLE2, "--samples", "1000000", "--yes", "--out", "OUT"),
        r"interrupted after \d+ of 1000000 runs, which .* keeps; the same command goes on",
    ),
    (
        ("tune", "design/robust.toml", "--out", "OUT"),
        r"interrupted; .*robust.toml is the best design by then; .* goes on from .*robust_trials.jsonl",
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
    code, said = interrupted(wait, *(a.replace("OUT", str(tmp_path)) for a in arguments))
    assert code == 130
    said = [line for line in said if "not judged" not in line]  # what there was no time for
    assert len(said) <= 1  # none where Python itself had not begun
    known = f"malta: ({sentence}|{NOTHING}|interrupted)"
    assert all(re.fullmatch(known, line) for line in said), said
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
        with output.work_until("margins", None) as work:
            work.bound(2.5, 3.5)
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


def test_the_first_ctrl_c_ends_searches_with_what_they_know_and_the_second_all(
    capsys: pytest.CaptureFixture[str],
) -> None:
    motor = malta.uncertain(lambda a, b: ([[-a]], [[b]], [[1.0]]), {"a": 1.0, "b": 1.0})

    def search() -> malta.proof.Margin:
        return malta.robust_margin(motor, [[0.5]], {"a": 0.1, "b": 0.1})

    with output.work_until("searching", None) as work:
        assert search().lower == pytest.approx(10 / 3, rel=1e-3)  # b / 2 = a: 1 + t / 10 = 2 (1 - t / 10)
        signal.raise_signal(signal.SIGINT)
        assert is_stopped()
        assert search().lower is None  # and raises nothing
        assert "Ctrl-C: ending with what is known" in said_by(capsys)[0]
    assert len(work.pressed) == 1

    def press_twice() -> None:
        with output.work_until("searching", None) as work:
            signal.raise_signal(signal.SIGINT)
            work.note("so far 3")
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(typer.Exit):
        press_twice()
    assert capsys.readouterr().err.splitlines()[-1] == "malta: interrupted; so far 3"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_verification_that_has_no_time_has_all_but_the_proofs(run: Run) -> None:
    code, out, err = run("verify", TABLE2, "--time", "1e-9", "--json")
    whole = json.loads(run("verify", TABLE2, "--no-proof", "--json").out)
    found = json.loads(out)
    assert code == 0
    assert "the search of the margin ended early" in err
    assert found["robust"]["travel"]["lower"] is None
    assert found["robust"]["gang_of_four"] == whole["robust"]["gang_of_four"]
    for key in ("poles_rad_per_s", "bandwidth_rad_per_s", "peak_sensitivity", "recovery"):
        assert found[key] == whole[key]


def test_a_search_that_has_no_time_writes_its_first_design_and_says_what_is_open(
    run: Run, tmp_path: Path
) -> None:
    code, out, err = run("tune", "examples/ball/design/ball.toml", "--out", tmp_path, "--time", "1e-9")
    assert (code, out) == (0, f"wrote {tmp_path / 'ball.toml'}\n")
    assert re.search(
        r"ball.toml: no time was left to judge margin .*; malta tune .*ball.toml --check does", err
    )
    assert malta.read_design(tmp_path / "ball.toml").search
    code, _, err = run("tune", "examples/ball/design/ball.toml", "--check", "--time", "1e-9")
    assert code == 0
    assert "no time was left to judge margin" in err
    code, out, err = run("tune", "design/structured.toml", "--out", tmp_path, "--time", "1e-9")
    assert (code, out.splitlines()[-1]) == (0, f"wrote {tmp_path / 'structured.toml'}")
    assert "structured.toml: no time was left to judge margin peak_sensitivity" in err
    assert malta.read_design(tmp_path / "structured.toml").structure is not None
    for seconds in ("0", "nan", "-1"):
        code, _, err = run("tune", "examples/ball/design/ball.toml", "--out", tmp_path, "--time", seconds)
        assert (code, err.count("\n")) == (2, 1)
        assert err.startswith(f"malta: --time: found {seconds}, expected seconds above 0")


def test_a_design_without_time_is_shown_and_leaves_its_gain_files(run: Run, tmp_path: Path) -> None:
    files = "examples/ball/design/ball.toml", "examples/ball/design/ball_pid.toml"
    code, out, err = run(
        "design", *files, "--out", tmp_path, "--figures", tmp_path, "--time", "1e-9", "--json"
    )
    (found,) = json.loads(out)["designs"]
    assert (code, found["design"], found["files"]) == (0, "ball", [])
    assert found["stable"]  # and its poles and peaks are known
    assert err.endswith(
        f"the time is up; 0 of 2 designs are whole; gain files stand as they were of {' '.join(files)}\n"
    )
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_work_on_the_bench_without_time_hands_over_what_it_knows(run: Run, tmp_path: Path) -> None:
    """An excitation is flown for a portion; strokes end after the first; a log is identified at its lines."""
    log, short = tmp_path / "log.npz", ("--period", "0.2", "--periods", "12", "--band", "10..400")
    code, out, err = run("excite", ROBUST, *short, "--log", log, "--time", "1e-9", "--json")
    assert (code, json.loads(out)["files"]) == (0, [str(log)])
    assert err == f"malta: the time is up; the flight ended at 1 s, and {log} has 4 of 12 periods\n"
    found = tmp_path / "found.toml"
    code, out, err = run("identify", ROBUST, log, "-p", "K_A", "--out", found, "--time", "1e-9", "--json")
    (K_A,) = json.loads(out)["parameters"].values()
    assert (code, K_A["low"] < 8627.0 < K_A["high"], found.exists()) == (0, True, False)
    assert err.endswith(f"the time is up; values and intervals are those of then; {found} is not written\n")
    code, out, err = run("learn", ROBUST, "--strokes", "9", "--time", "1e-9", "--json")
    assert (code, len(json.loads(out)["axial_error_m"])) == (0, 1)
    assert err == "malta: the time is up; 1 of 9 strokes were flown\n"


def test_claims_without_time_name_what_is_missing(run: Run, tmp_path: Path) -> None:
    code, out, err = run("claims", "design/halbach_pid.toml", "--time", "1e-9", "--json")
    assert (code, json.loads(out)["ledgers"]) == (0, [])
    assert err == "malta: the time is up; missing are all claims of halbach_pid\n"
    page = tmp_path / "page.md"
    page.write_text((ROOT / "docs" / "claims" / "halbach.md").read_text(encoding="utf-8"), encoding="utf-8")
    code, _, err = run("claims", "--update", page, "--time", "1e-9")
    assert (code, err) == (0, f"malta: the time is up; {page} stands as it was\n")


def test_a_comparison_shares_its_time_between_its_designs() -> None:
    """What one design leaves is the next one's; the margins have a part of it."""
    with count_work(math.inf, 100.0) as meter:
        for n, spent_by_one in enumerate((40.0, 0.0, 0.0)):
            with share_time(1 / (3 - n)):
                own = current_meter.get()
                assert own is not None
                left = meter.deadline - time.monotonic()
                assert own.deadline - time.monotonic() == pytest.approx(left / (3 - n), rel=1e-3)
            meter.deadline -= spent_by_one  # as if it had taken so long
    with share_time(0.5):
        assert current_meter.get() is None  # no limit outside


def test_what_a_library_makes_of_ctrl_c_is_ctrl_c_again() -> None:
    """CasADi turns it into NotImplementedError where it converts arrays: the campaign then lost what was done."""

    def pressed(error: Exception, *kept: type[BaseException]) -> None:
        with watch_interrupts(*kept):
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise error from None

    with pytest.raises(KeyboardInterrupt):
        pressed(NotImplementedError("wrong number or type of arguments"))
    with pytest.raises(typer.Exit):
        pressed(typer.Exit(130), typer.Exit)
    with pytest.raises(ValueError, match="its own"), watch_interrupts():  # nothing was pressed
        raise ValueError("its own")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
