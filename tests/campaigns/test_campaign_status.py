"""`malta campaign --status`: how far a campaign is, what is damaged, and when it ends."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from conftest import Run

import malta
from malta.campaigns.plan import Plan
from malta.campaigns.run import campaign, status
from malta.campaigns.store import MANIFEST, block_name, noted_gains

if TYPE_CHECKING:
    pass

pytestmark = pytest.mark.usefixtures("proven_once")
GAINS = "design/gains/calibrated.json"
SHAKY = "design/gains/table2.json"
COMMON = ("--samples", "40", "--option", "fidelity=force", "--option", "rise=3ms", "--spread", "20%")


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without figures, which take longer than so few runs; four blocks and eight runs."""
    monkeypatch.setattr("malta.cli.campaign.draw_figures", lambda *_: [])
    monkeypatch.setattr("malta.campaigns.run.BLOCK", 8)


def _touch(folder: Path, ages: dict[int, float]) -> None:
    """Make blocks that old, in seconds, by their first runs."""
    for first, age in ages.items():
        at = time.time() - age
        os.utime(folder / block_name(first), (at, at))


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_whole_campaign_has_the_tables_that_it_ended_with(run: Run, tmp_path: Path) -> None:
    code, whole, _ = run("campaign", GAINS, *COMMON, "--out", tmp_path)
    assert code == 0
    before = {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()}
    code, out, err = run("campaign", "--status", tmp_path)
    assert (code, err) == (0, "")
    first, *rest = out.splitlines()
    stored = sum(path.stat().st_size for path in tmp_path.glob("*.npz")) / 1e6
    assert first == f"{tmp_path}: 5 of 5 blocks of 8 runs, {stored:.1f} MB, 0 damaged"
    assert rest == whole.replace(GAINS, str(Path(GAINS).absolute())).splitlines()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.iterdir()} == before


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_half_a_campaign_that_runs_and_one_that_does_not(run: Run, tmp_path: Path) -> None:
    """Two blocks of five, one of them damaged later: 4 s apart, and young or old."""
    run("campaign", GAINS, *COMMON, "--out", tmp_path)
    for first in (24, 32):
        (tmp_path / block_name(first)).unlink()
    _touch(tmp_path, {0: 11.0, 8: 7.0, 16: 3.0})
    document = json.loads(run("campaign", GAINS, "--status", tmp_path, "--json")[1])
    assert document["blocks"] | {"bytes": 0} == {"done": 3, "all": 5, "runs": 8, "bytes": 0}
    assert document["running"]
    assert document["pace_s"] == pytest.approx(4, abs=0.1)
    assert document["left_s"] == pytest.approx(8, abs=0.2)
    assert (document["runs"], document["yield"]["passed"], document["damaged"]) == (24, 24, [])
    assert document["yield"]["low"] == pytest.approx(0.025 ** (1 / 24))
    assert document["manifest"]["spread"] == {"m": 0.2, "K_A": 0.2, "K_B": 0.2, "K_D": 0.2}
    assert document["percentiles"] == {"exact": True, "relative_error": 0}
    _, out, _ = run("campaign", "--status", tmp_path)
    assert re.search(
        r"^running: the last block came [\d.]+ s ago, about [78][\d.]* s left$", out, re.MULTILINE
    )
    assert "24 of 40 machines" in out

    damaged = tmp_path / block_name(8)
    damaged.write_bytes(damaged.read_bytes()[:-9])
    _touch(tmp_path, {0: 7300.0, 16: 7200.0})
    code, out, err = run("campaign", "--status", tmp_path)
    assert code == 0
    assert err == f"malta: {damaged}: a damaged block, which the campaign will fly again\n"
    assert "2 of 5 blocks of 8 runs" in out
    assert "1 damaged" in out
    assert "not running: the last block came 2 h ago; the same command goes on\n" in out
    assert "16 of 40 machines" in out
    run("campaign", GAINS, *COMMON, "--out", tmp_path)
    assert "5 of 5 blocks" in run("campaign", "--status", tmp_path)[1]


def test_a_campaign_without_a_block(run: Run, tmp_path: Path) -> None:
    """Just begun, by a program that noted no gain file: it is named, and the same as by the library."""
    controller = malta.gains.read(GAINS)
    plan = Plan(controller, spread={"m": 0.1}, samples=8, options={"fidelity": "force", "duration": 0.01})
    campaign(plan, tmp_path)
    (tmp_path / block_name(0)).unlink()
    code, out, err = run("campaign", "--status", tmp_path)
    assert (code, out) == (2, "")
    assert "gains_file: found none noted, expected the campaign's gain file as an argument" in err
    code, out, err = run("campaign", GAINS, "--status", tmp_path)
    assert (code, err) == (0, "")
    assert out.splitlines()[1] == "not running; the same command goes on"
    assert "0 of 8 machines" in out
    found = status(tmp_path, controller)
    assert (found.blocks, found.of, found.pace, found.age, found.left, found.running) == (
        *(0, 1),
        *(None, None, None, False),
    )


def _line(err: str) -> str:
    assert "Traceback" not in err
    assert err.count("\n") == 1
    return err


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_what_has_no_status_is_one_sentence(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    run("campaign", GAINS, *COMMON, "--out", folder)
    for arguments, sentence in (
        (("--status", tmp_path), "campaign.json: found no such file, expected a campaign's manifest"),
        (("--status", tmp_path / "none"), "no such file"),
        (("--status", "README.md"), "README.md"),
        ((SHAKY, "--status", folder), "found a campaign of calibrated"),
        (("--status", folder, "--samples", "9", "--set", "m=1"), "found --samples, --set too, expected none"),
        (("--samples", "9"), "GAINS: found nothing, expected a gain file, or --status FOLDER"),
    ):
        code, out, err = run("campaign", *arguments)
        assert (code, out) == (2, ""), arguments
        assert sentence in _line(err)
    manifest = folder / MANIFEST
    content = json.loads(manifest.read_text(encoding="utf-8"))
    assert noted_gains(folder) == Path(GAINS).absolute()
    edits: list[tuple[Any, str]] = [
        (content | {"gains_file": 3}, "none noted"),
        (content | {"gains_file": "/nowhere.json"}, "no such file"),
        (
            {k: v for k, v in content.items() if k != "sampler_version"},
            "sampler_version: found nothing: another",
        ),
        ([], "a damaged or foreign file"),
    ]
    for edited, sentence in edits:
        manifest.write_text(json.dumps(edited), encoding="utf-8")
        code, out, err = run("campaign", "--status", folder)
        assert (code, out) == (2, "")
        assert sentence in _line(err)


@pytest.mark.slow
def test_a_campaign_is_looked_at_while_it_runs(run: Run, tmp_path: Path) -> None:
    """Blocks come and no look disturbs them: what it says only grows, and the end is that of any other campaign."""
    many = ("--samples", "10240", "--option", "fidelity=force", "--spread", "20%")
    command = [sys.executable, "-m", "malta", "campaign", GAINS, *many, "--out", str(tmp_path), "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    seen = []
    while process.poll() is None:
        if (tmp_path / MANIFEST).exists():
            seen.append(json.loads(run("campaign", GAINS, "--status", tmp_path, "--json")[1]))
    ended = json.loads(process.communicate()[0])
    assert process.returncode == 0
    runs = [look["runs"] for look in seen]
    assert runs == sorted(runs)
    assert any(0 < n < 10240 for n in runs)
    assert all(look["running"] for look in seen if 0 < look["runs"] < 10240)
    assert not any(look["damaged"] for look in seen)
    last = json.loads(run("campaign", GAINS, "--status", tmp_path, "--json")[1])
    assert {k: last[k] for k in ("merits", "ends", "yield", "worst")} == {
        k: ended[k] for k in ("merits", "ends", "yield", "worst")
    }


def test_the_pace_is_that_of_the_last_blocks(tmp_path: Path) -> None:
    """A night between two sessions is no pace."""
    controller = malta.gains.read(GAINS)
    plan = Plan(controller, spread={"m": 0.1}, samples=48, options={"fidelity": "force", "duration": 0.01})
    campaign(plan, tmp_path, block=8)
    (tmp_path / block_name(40)).unlink()
    _touch(tmp_path, {0: 40_004.0, 8: 40_002.0, 16: 4.0, 24: 2.0, 32: 0.0})
    found = status(tmp_path, controller)
    assert found.pace == pytest.approx(2, abs=0.1)
    assert found.left == pytest.approx(2, abs=0.1)
    assert isinstance(found.summary, malta.campaigns.Summary)
