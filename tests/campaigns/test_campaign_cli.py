"""`malta campaign` and `malta simulate --replay`: what they print and keep, also when they are killed."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run
from page_examples import without_progress
from typer.testing import CliRunner

from malta.cli import main as cli
from malta.simulation.engine import compiled

pytestmark = pytest.mark.usefixtures("proven_once")

GAINS = "design/gains/calibrated.json"
SHAKY = "design/gains/table2.json"
QUICK = ("--option", "fidelity=force", "--option", "rise=3ms")


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without figures, which take longer than so few runs."""
    monkeypatch.setattr("malta.cli.campaign.draw_figures", lambda *_: [])


def _sentence(err: str) -> str:
    assert "Traceback" not in err
    err = without_progress(err)
    assert err.count("\n") == 1
    return err.removeprefix("malta: ").rstrip("\n")


def _blocks(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("runs_*.npz"))}


@pytest.mark.slow
def test_a_campaign_is_shown_kept_and_read_again(run: Run, tmp_path: Path) -> None:
    arguments = ("campaign", SHAKY, "--samples", "64", "--spread", "60%", "--sensor", "offset_y2=5um")
    code, out, err = run(*arguments, "--out", tmp_path)
    assert (code, err) == (0, "")
    assert max(map(len, out.splitlines()[:-4])) <= 100
    assert out.startswith(f"{SHAKY}: stroke, fidelity dq, 64 of 64 machines\n")
    assert "m K_A K_B K_D ±60 %, offset_y2 ±5 µm; latin-hypercube, seed 0" in out
    for text in (
        "completed within the published bounds",
        "touchdown at sensor plane 1",
        "<= 20",
        "The worst runs",
    ):
        assert text in out
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"campaign.json", "runs_00000000.npz", "distributions.png", "yield.png", "worst.png"}
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")}
    assert run(*arguments, "--out", tmp_path)[:2] == (0, out)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.npz")} == before


@pytest.mark.slow
def test_json_holds_what_the_table_shows(run: Run, tmp_path: Path) -> None:
    code, out, _ = run(
        "campaign", SHAKY, "--samples", "64", "--spread", "60%", "--worst", "3", "--out", tmp_path, "--json"
    )
    content = json.loads(out)
    assert code == 0
    assert content["yield"]["passed"] == content["ends"]["completed"]
    assert sum(content["ends"].values()) == content["runs"] == 64
    assert content["yield"]["low"] < content["yield"]["share"] < content["yield"]["high"]
    assert content["manifest"]["spread"] == {"m": 0.6, "K_A": 0.6, "K_B": 0.6, "K_D": 0.6}
    assert content["merits"]["deviation_y1_m"]["published"] == pytest.approx(20e-6)
    marks = content["merits"]["rise_s"]
    assert marks["p5"] < marks["p50"] < marks["p95"] <= marks["p99"] <= marks["largest"]
    assert len(content["worst"]) == 3
    worst = content["worst"][0]
    assert worst["replay"] == f"{tmp_path}:{worst['run']}"
    code, out, err = run(
        "simulate", SHAKY, "--replay", worst["replay"], "--out", tmp_path / "again", "--json"
    )
    again = json.loads(out)
    assert code == 1
    assert worst["end"] in _sentence(err)
    assert again["verdict"] == {"name": worst["end"], "time_s": worst["time_s"], "signal": ""}
    stem = f"table2_stroke_run_{worst['run']}"
    assert {path.name for path in (tmp_path / "again").iterdir()} == {f"{stem}.npz", f"{stem}.png"}
    with np.load(tmp_path / "again" / f"{stem}.npz") as series:
        deviation = np.abs(series["p"] - series["reference"]).max(axis=0)
    assert deviation.tolist() == list(worst["deviation"].values())  # to the bit


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("spread", "box"),
    [
        ((), {"m": 0.2, "K_A": 0.2, "K_B": 0.2, "K_D": 0.2}),
        (("20%",), {"m": 0.2, "K_A": 0.2, "K_B": 0.2, "K_D": 0.2}),
        (("0.1",), {"m": 0.1, "K_A": 0.1, "K_B": 0.1, "K_D": 0.1}),
        (("m=10%",), {"m": 0.1}),
        (("m=10%", "K_A=0.2"), {"m": 0.1, "K_A": 0.2}),
        (("5%", "R=30%", "m=0%"), {"m": 0, "K_A": 0.05, "K_B": 0.05, "K_D": 0.05, "R": 0.3}),
    ],
)
def test_spreads_are_for_all_or_by_name(
    run: Run, tmp_path: Path, spread: tuple[str, ...], box: dict[str, float]
) -> None:
    options = [part for text in spread for part in ("--spread", text)]
    run("campaign", GAINS, "--samples", "1", *QUICK, *options, "--out", tmp_path)
    assert json.loads((tmp_path / "campaign.json").read_text(encoding="utf-8"))["spread"] == box


def _beside_the_engine(err: str) -> list[str]:
    """The notes but for that of a computer without a C compiler."""
    return [line for line in err.splitlines() if not line.startswith("malta: no C compiler")]


@pytest.mark.usefixtures("undrawn")
def test_each_campaign_has_a_folder_of_its_own(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gains = Path(GAINS).absolute()
    monkeypatch.chdir(tmp_path)
    for seed in ("0", "1", "1"):
        code, out, err = run("campaign", gains, "--samples", "2", *QUICK, "--seed", seed)
        assert (code, _beside_the_engine(err)) == (0, [])
        assert "published" not in out  # of another rise
    assert len(list((tmp_path / "build" / "campaigns").iterdir())) == 2


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_options_of_the_run_reach_it(run: Run, tmp_path: Path) -> None:
    run(
        *("campaign", GAINS, "--samples", "2", "--scenario", "tilt", "--case", "feedforward attraction"),
        *(
            "--option",
            "fidelity=force",
            "--option",
            "noise=2",
            "--option",
            "quantize=true",
            "--option",
            "delay=2",
            "--option",
            "substeps=2",
            "--seed",
            "7",
        ),
        *("--set", "m=0.5", "--sampler", "sobol", "--out", tmp_path),
    )
    manifest = json.loads((tmp_path / "campaign.json").read_text(encoding="utf-8"))
    assert manifest["scenario"] == {
        "name": "tilt",
        "case": "feedforward attraction",
        "options": {"fidelity": "force", "noise": 2, "quantize": True, "delay": 2, "substeps": 2},
    }
    assert manifest["machine"]["parameters"]["m"] == 0.5
    assert (manifest["seed"], manifest["sampler"]) == (7, "sobol")
    code, out, _ = run("simulate", GAINS, "--replay", f"{tmp_path}:1", "--engine", "virtual-machine")
    assert code == 0
    assert "tilt: feedforward attraction" in out


REFUSED: dict[str, tuple[tuple[str, ...], str]] = {
    "no share": (
        ("--spread", "wide"),
        "--spread: found 'wide', expected a share, either way, as 20% or m=10%",
    ),
    "an interval": (("--spread", "m=1..2"), "--spread: found 'm=1..2', expected a share, either way"),
    "two in one": (("--spread", "m=5% K_A=2%"), "for several parameters the option several times"),
    "two shares": (
        ("--spread", "10%", "--spread", "20%"),
        "--spread: found 10% and 20%, expected one share for all",
    ),
    "a unit": (("--spread", "m=10g"), "--spread: m.unit: found 'g', expected no unit, or %"),
    "no such parameter": (("--spread", "mass=10%"), "--spread: mass: found an unknown parameter"),
    "all of it": (("--spread", "100%"), "found 100 %, expected from 0 % to less than 100 %"),
    "no such sensor error": (("--sensor", "gain_q=2%"), "--sensor: gain_q: found an unknown sensor error"),
    "no samples": (("--samples", "0"), "samples: found 0, expected a whole number of at least 1"),
    "a scenario in flight": (("--scenario", "payload"), "found 'payload', which changes the machine"),
    "no scenario": (("--scenario", "loop"), "found 'loop', expected one of stroke"),
    "no sampler": (("--sampler", "dice"), "sampler: found 'dice', expected one of latin-hypercube, sobol"),
    "no case": (("--case", "third"), "stroke: case: found 'third', expected one of stroke"),
    "another's option": (
        ("--scenario", "hold", "--option", "rise=3ms"),
        "rise: found an option of another scenario",
    ),
    "no workers": (("--workers", "0"), "workers: found 0, expected at least 1"),
    "workers of two kinds": (
        ("--workers", "2", "--cluster", "tcp://127.0.0.1:1"),
        "workers: found 2, expected none with a cluster",
    ),
    "a file": (("--out", "README.md"), "README.md"),
    "an unwritable folder": (("--out", "/proc/here"), "/proc/here"),
}


@pytest.mark.parametrize(("options", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_cannot_be_flown_is_one_sentence(
    run: Run, tmp_path: Path, options: tuple[str, ...], sentence: str
) -> None:
    out = () if "--out" in options else ("--out", str(tmp_path / "out"))
    code, shown, err = run("campaign", GAINS, "--samples", "8", "--option", "fidelity=force", *out, *options)
    assert (code, shown) == (2, "")
    assert sentence in _sentence(err)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("undrawn")
def test_a_folder_of_another_campaign_is_one_sentence(run: Run, tmp_path: Path) -> None:
    run("campaign", GAINS, "--samples", "2", *QUICK, "--out", tmp_path)
    code, out, err = run("campaign", GAINS, "--samples", "3", *QUICK, "--out", tmp_path)
    assert (code, out) == (2, "")
    assert "samples: found 2: another campaign, expected 3" in _sentence(err)


@pytest.mark.usefixtures("undrawn")
def test_a_damaged_block_is_named(run: Run, tmp_path: Path) -> None:
    arguments = ("campaign", GAINS, "--samples", "2", *QUICK, "--out", tmp_path)
    code, first, _ = run(*arguments)
    block = tmp_path / "runs_00000000.npz"
    whole = block.read_bytes()
    block.write_bytes(whole[:-9])
    code, again, err = run(*arguments)
    assert (code, again) == (0, first)
    assert _beside_the_engine(err) == [f"malta: {block}: a damaged block, flown again"]
    assert block.read_bytes() == whole


REPLAYS: dict[str, tuple[tuple[str, ...], str]] = {
    "no run": (("{}",), "expected FOLDER:RUN"),
    "no number": (("{}:last",), "expected FOLDER:RUN"),
    "beyond the last": (("{}:2",), "run: found 2, expected 0 to 1"),
    "no such folder": (("{}/nowhere:0",), "no such file"),
    "other options": (
        ("{}:0", "--option", "noise=2", "--set", "m=0.4"),
        "found --option, --set too, expected none",
    ),
    "another scenario": (("{}:0", "--scenario", "stroke"), "found --scenario too"),
    "no engine": (("{}:0", "--engine", "steam"), "engine: found 'steam'"),
}


@pytest.mark.usefixtures("undrawn")
def test_what_is_no_run_of_a_campaign_is_one_sentence(run: Run, tmp_path: Path) -> None:
    run("campaign", GAINS, "--samples", "2", *QUICK, "--out", tmp_path)
    for options, sentence in REPLAYS.values():
        code, out, err = run("simulate", GAINS, "--replay", *(text.format(tmp_path) for text in options))
        assert (code, out) == (2, ""), options
        assert sentence in _sentence(err)
    code, _, err = run("simulate", SHAKY, "--replay", f"{tmp_path}:0")
    assert code == 2
    assert "found a campaign of calibrated" in _sentence(err)


# As from a terminal, where Ctrl-C is not ignored.
START = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "from malta.cli.main import main; main()"
)


def _malta(*arguments: str | Path) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", START, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _wait_for_block(process: subprocess.Popen[Any], folder: Path) -> None:
    """Until two blocks are kept, and others are not."""
    for _ in range(6000):
        if len(list(folder.glob("runs_*.npz"))) >= 2:
            return
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    raise AssertionError("no block within a minute")


MANY = ("--samples", "10240", "--option", "fidelity=force", "--spread", "20%", "--sensor", "gain_x1=2%")


@pytest.mark.usefixtures("undrawn")
@pytest.mark.slow
def test_a_killed_campaign_goes_on_where_it_was(run: Run, tmp_path: Path) -> None:
    """SIGKILL in the middle, then the same command: bit for bit what an undisturbed one finds."""
    arguments = ("campaign", GAINS, *MANY, "--option", "quantize=true", "--out")
    process = _malta(*arguments, tmp_path / "killed")
    _wait_for_block(process, tmp_path / "killed")
    process.send_signal(signal.SIGKILL)
    process.communicate()
    kept = _blocks(tmp_path / "killed")
    assert 2 <= len(kept) < 10
    assert run(*arguments, tmp_path / "killed", "--workers", "1")[0] == 0
    assert run(*arguments, tmp_path / "whole", "--workers", "3")[0] == 0
    found = _blocks(tmp_path / "killed")
    assert len(found) == 10
    assert found == _blocks(tmp_path / "whole")
    assert {name: found[name] for name in kept} == kept


@pytest.mark.slow
def test_ctrl_c_keeps_and_shows_what_is_done(tmp_path: Path) -> None:
    process = _malta("campaign", GAINS, *MANY, "--out", tmp_path)
    _wait_for_block(process, tmp_path)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    done = 1024 * len(_blocks(tmp_path))
    assert process.returncode == 130, err
    assert f"{done} of 10240 machines" in out
    assert "The worst runs" in out
    assert _sentence(err) == (
        f"interrupted after {done} of 10240 runs, which {tmp_path} keeps; the same command goes on"
    )


@pytest.mark.usefixtures("undrawn")
def test_a_campaign_that_has_no_time_ends_after_a_block_and_goes_on(run: Run, tmp_path: Path) -> None:
    arguments = ("campaign", GAINS, "--samples", "1025", *QUICK, "--out", tmp_path)
    code, _, err = run(*arguments, "--time", "1e-9")
    assert code == 0
    assert (
        _sentence(err) == f"ended after 1024 of 1025 runs, which {tmp_path} keeps; the same command goes on"
    )
    code, out, err = run(*arguments, "--time", "1e9")
    assert (code, err) == (0, "")
    assert "1025 of 1025 machines" in out
    code, _, err = run(*arguments, "--time", "1", "--study", "rare")
    assert (code, _sentence(err)) == (
        2,
        "--time: found --study rare, expected one of them: a study ends by itself",
    )


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_without_a_compiler_it_says_so(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from malta.simulation.engine import compiled
    from malta.simulation.engine.engines import engine_of, library_of

    monkeypatch.setattr(compiled, "compiler", lambda: None)
    for memory in (library_of, engine_of):
        memory.cache_clear()
    code, _, err = run("campaign", GAINS, "--samples", "2", *QUICK, "--out", tmp_path)
    for memory in (library_of, engine_of):
        memory.cache_clear()
    assert code == 0
    assert "no C compiler" in _sentence(err)


@pytest.mark.slow
def test_help_shows_an_example_and_no_cluster_is_imported() -> None:
    result = CliRunner().invoke(cli.app, ["campaign", "--help"])
    assert result.exit_code == 0
    assert "Example:" in result.output
    assert "--replay" in CliRunner().invoke(cli.app, ["simulate", "--help"]).output
    code = "import sys, malta; malta.campaign, malta.campaigns.Plan; sys.exit('distributed' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.slow
def test_the_exported_c_flies_in_a_campaign(run: Run, tmp_path: Path) -> None:
    """The same machines and noise: the figures of the law's own campaign to 1e-9, and a replay of a run."""
    if compiled.compiler() is None:
        pytest.skip("no C compiler")
    gains, found = "design/gains/robust.json", {}
    common = ("--samples", "8", "--json")
    for law in ("own", "c", "c-float"):
        code, out, err = run("campaign", gains, *common, "--controller", law, "--out", tmp_path / law)
        assert code == 0, err
        found[law] = json.loads(out)
    merits = {law: document["merits"] for law, document in found.items()}
    for name, own in merits["own"].items():
        assert merits["c"][name]["largest"] == pytest.approx(own["largest"], rel=1e-9, abs=1e-15), name
    assert found["c"]["ends"] == found["own"]["ends"]
    assert [found[law]["engines"] for law in ("c", "c-float")] == [
        ["exported C, double"],
        ["exported C, float"],
    ]
    assert len({document["folder"] for document in found.values()}) == 3
    code, out, err = run("simulate", gains, "--replay", f"{tmp_path / 'c'}:3")
    assert code == 0, err
    code, _, err = run("campaign", gains, "--controller", "rust")
    assert code == 2
    assert "campaign: controller: found 'rust', expected one of own, c, c-float" in err
