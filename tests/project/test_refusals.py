"""Refusals that fuzzing asked for: short sentences, no trace of what was refused, limits of delays, steps and runs."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Run, one_sentence, refusal

import malta
from malta.campaigns import store
from malta.campaigns.plan import Plan
from malta.campaigns.run import campaign
from malta.campaigns.store import block_name, seal
from malta.errors import MAX_SENTENCE_LENGTH, InputError, shorten
from malta.files import file_exists
from malta.model.sensors import MOST_DELAY
from malta.simulation.experiments import PlannedRun, fly_all
from malta.simulation.scenario import Scenario
from malta.tuning.search import Journal
from malta.units import to_si

pytestmark = pytest.mark.usefixtures("proven_once")

TABLE2 = "design/gains/table2.json"
LONG = "w" * 5000


# Sentences


@pytest.mark.parametrize(
    ("where", "field", "found", "expected"),
    [
        ("a.toml", "x", LONG, "1"),
        ("a.toml", "x", "1", LONG),
        ("a.toml", LONG, LONG, LONG),
        (f"/home/{LONG}/a.toml", LONG, "1", "2"),
        ("a.toml", "", "\x00" * 400, "\u202e" * 400),
    ],
)
def test_a_sentence_has_at_most_300_characters(where: str, field: str, found: str, expected: str) -> None:
    error = InputError(where, field, found, expected)
    assert len(str(error)) <= MAX_SENTENCE_LENGTH == 300
    assert str(error).isprintable()
    assert "a.toml: " in str(error)
    assert f": found {error.found}, expected {error.expected}" in str(error)
    again = InputError("b.toml", error.field, error.found, error.expected)  # as a reader that knows the file
    assert len(str(again)) <= MAX_SENTENCE_LENGTH


def test_a_short_sentence_is_whole() -> None:
    found, expected = "f" * 100, "e" * 150
    assert str(InputError("a", "b", found, expected)) == f"a: b: found {found}, expected {expected}"


def test_what_is_left_out_is_in_the_middle() -> None:
    assert shorten("0123456789", 10) == "0123456789"
    assert shorten("0123456789x", 10) == "01234...9x"
    assert shorten("/a/long/folder/of/mine.toml", 15, head=0.25) == "/a/...mine.toml"


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (["simulate"], "Missing argument 'GAINS'; see malta simulate --help"),
        (["simulate", TABLE2, "--nothing"], "No such option: --nothing"),
        (["simulate", TABLE2, "--seed", "x"], "--seed: found 'x', expected a whole number"),
        (["simulate", TABLE2, "--seed"], "--seed"),
        (
            ["tune", "a.toml", "--front", "-1"],
            "--front: found '-1', expected a number greater than or equal to 0",
        ),
        (["log", "a\x00b"], "LOG: found 'a\\x00b', embedded null byte, expected a value without it"),
        (["design", "a\x00b"], "DESIGN: found 'a\\x00b', embedded null byte, expected a value without it"),
        (["zzz"], "No such command 'zzz'; see malta --help"),
        ([LONG], "No such command 'www"),
        ([""], "No such command ''"),
    ],
)
def test_arguments_that_are_wrong_are_one_sentence(run: Run, arguments: list[str], found: str) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    sentence = one_sentence(err)
    assert found in sentence
    assert len(sentence) <= MAX_SENTENCE_LENGTH


def test_no_arguments_get_the_help(run: Run) -> None:
    code, _, err = run()
    assert code == 2
    assert "Usage: malta" in err


def test_too_little_memory_is_one_sentence(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise MemoryError

    monkeypatch.setattr("malta.gains.read", fail)
    code, out, err = run("simulate", TABLE2)
    assert (code, out) == (1, "")
    assert one_sentence(err) == "more was asked for than this computer has memory for"


# Names that no file can have


@pytest.mark.parametrize("name", [LONG, "a\x00b", f"{LONG}/x.toml"])
def test_a_name_that_no_file_can_have_is_none(name: str) -> None:
    assert not file_exists(Path(name))


@pytest.mark.parametrize("machine", [f"{LONG}.toml", f"{LONG}.py"])
def test_a_design_whose_machine_has_no_possible_name_is_refused(tmp_path: Path, machine: str) -> None:
    text = Path("design/table2.toml").read_text(encoding="utf-8")
    path = tmp_path / "mine.toml"
    path.write_text(text.replace("../data/tubular.toml", machine), encoding="utf-8")
    with pytest.raises(InputError):
        malta.read_design(path)


# Limits


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        (["simulate", TABLE2, "--option", "delay=1000000000"], "delay: found 1000000000 samples"),
        (["simulate", TABLE2, "--set", "T_d=1"], "machine: dead time: found 19999.5 samples"),
        (["verify", TABLE2, "--set", "T_d=1", "--no-proof"], "machine: dead time: found 19999.5 samples"),
        (["verify", TABLE2, "--set", "T_s=1", "--no-proof"], "dead time of its sensors: found 20000 samples"),
        (
            ["simulate", "design/gains/halbach.json", "--set", "f_pwm=1e12"],
            "periods of the electronics in a sample",
        ),
        (
            ["simulate", TABLE2, "--scenario", "payload", "--option", f"masses={','.join(['1g'] * 3000)}"],
            "runs: found 3000 of 3.9e+07 samples in all",
        ),
    ],
)
def test_what_would_not_end_is_refused(run: Run, arguments: list[str], found: str) -> None:
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert found in one_sentence(err)


def test_the_longest_delay_is_simulated(run: Run) -> None:
    assert MOST_DELAY == 100
    code, _, err = run("simulate", TABLE2, "--option", f"delay={MOST_DELAY + 1}")
    assert code == 2
    assert one_sentence(err).endswith("found 101 samples, expected at most 100")


def test_runs_of_the_longest_series_together_are_too_many() -> None:
    controller = malta.gains.read(TABLE2)
    one = PlannedRun("a", Scenario("hold", 150.0, malta.references.hold), lambda _: ())
    with pytest.raises(InputError, match=r"runs: found 2 of 6e\+06 samples in all"):
        fly_all([(malta.plant_of(controller.parameters), controller, one)] * 2, None, {})


@pytest.mark.parametrize("digits", ["9" * 21, "9" * 5000])
def test_a_run_of_countless_digits_is_refused(run: Run, digits: str) -> None:
    code, _, err = run("simulate", TABLE2, "--replay", f"nowhere:{digits}")
    assert code == 2
    assert "expected FOLDER:RUN" in one_sentence(err)


# Files


def test_a_refused_campaign_leaves_nothing(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    command = ["campaign", TABLE2, "--samples", "8", "--out", folder, "--option", "profile=cubic"]
    code, out, err = run(*command)
    assert (code, out) == (2, "")
    assert "profile: found 'cubic'" in one_sentence(err)
    assert list(tmp_path.iterdir()) == []
    folder.mkdir()
    (folder / "note.txt").write_text("mine")
    assert run(*command)[0] == 2
    assert [path.name for path in folder.iterdir()] == ["note.txt"]


def test_a_refused_campaign_leaves_what_is_done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a scheduler does not answer any more."""
    controller = malta.gains.read(TABLE2)
    quick = {"fidelity": "force", "duration": 0.01, "rise": 3e-3}
    plan = Plan(controller, spread={"m": 0.1}, samples=16, options=quick)
    fly = store.fly

    def once(plan: Plan, first: int, *rest: Any) -> Any:
        if first:
            raise InputError("campaign", "cluster", "nothing", "an answer")
        return fly(plan, first, *rest)

    monkeypatch.setattr("malta.campaigns.run.fly", once)
    with pytest.raises(InputError, match="an answer"):
        campaign(plan, tmp_path, block=8)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == {"campaign.json", block_name(0)}
    with pytest.raises(InputError, match="an answer"):  # a manifest of an earlier call stays too
        campaign(plan, tmp_path, block=8)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    (tmp_path / block_name(0)).unlink()
    monkeypatch.setattr("malta.campaigns.run.fly", lambda plan, _, *rest: once(plan, 8, *rest))
    with pytest.raises(InputError, match="an answer"):
        campaign(plan, tmp_path, block=8)
    assert [path.name for path in tmp_path.iterdir()] == ["campaign.json"]


def test_a_block_whose_names_are_none_is_flown_again(tmp_path: Path) -> None:
    controller = malta.gains.read(TABLE2)
    quick = {"fidelity": "force", "duration": 0.01, "rise": 3e-3}
    plan = Plan(controller, spread={"m": 0.1}, samples=8, options=quick)
    campaign(plan, tmp_path)
    path = tmp_path / block_name(0)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "seal"}
    arrays["names"] = np.array("m")
    buffer = io.BytesIO()
    np.savez(buffer, **arrays, seal=np.array(seal(arrays, 0)))
    path.write_bytes(buffer.getvalue())
    assert campaign(plan, tmp_path).damaged == (path,)


def _end_all(value: float, arrays: dict[str, Any]) -> None:
    """All runs diverged, and left this value as every figure that may have any."""
    arrays |= {name: np.zeros_like(arrays[name]) for name in ("completed", "duration")}
    arrays["verdict"] = np.ones_like(arrays["verdict"])
    for name in ("deviation", "rms", "force", "contact", "last"):
        arrays[name] = np.full_like(arrays[name], value)
    arrays |= {name: np.full_like(arrays[name], np.nan) for name in ("rise", "overshoot")}


def _put_everywhere(name: str, value: float, arrays: dict[str, Any]) -> None:
    arrays[name] = np.full_like(arrays[name], value)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "damaged"),
    [
        (partial(_end_all, np.nan), False),
        (partial(_end_all, 1e308), False),
        (partial(_put_everywhere, "deviation", 5e-324), False),
        (partial(_put_everywhere, "deviation", 1e308), True),
        (partial(_put_everywhere, "contact", 1e30), True),
    ],
)
def test_whatever_a_run_can_leave_is_drawn(
    run: Run, tmp_path: Path, change: Callable[[dict[str, Any]], None], damaged: bool
) -> None:
    """Without a warning of numpy or matplotlib; figures that no run can leave are flown again."""
    command = ["campaign", TABLE2, "--samples", "8", "--spread", "m=20%", "--out", tmp_path]
    assert run(*command)[0] == 0
    path = tmp_path / block_name(0)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files if name != "seal"}
    change(arrays)
    buffer = io.BytesIO()
    np.savez(buffer, **arrays, seal=np.array(seal(arrays, 0)))
    path.write_bytes(buffer.getvalue())
    code, _, err = run(*command)
    assert (code, bool(err)) == (0, damaged)


def _run_arrays() -> dict[str, Any]:
    inputs = malta.plant_of(malta.gains.read(TABLE2).parameters).inputs
    headings = [f"{s.name} [{s.unit}]" for s in inputs]
    t = np.linspace(0, 1, 50)
    return {
        "t": t,
        "y": np.zeros((50, 1)),
        "y_columns": np.array(["z [m]"]),
        "v": np.zeros((50, len(headings))),
        "v_columns": np.array(headings),
    }


@pytest.mark.parametrize(
    ("name", "array", "found"),
    [
        ("t", np.array(["a"] * 50), "t: found an array of <U1, (50,)"),
        ("t", np.zeros((50, 2)), "t: found an array of float64, (50, 2)"),
        ("t", np.float64(1), "t: found "),
        ("v", np.array([["a"] * 5] * 50), "v: found an array of <U1, (50, 5), expected numbers, (50, 5)"),
        ("v", np.zeros((49, 5)), "v: found an array of float64, (49, 5), expected numbers, (50, 5)"),
        ("y_columns", np.array([1.0]), "y_columns: found no headings, expected those of y"),
        ("v_columns", np.array("x"), "v_columns: found no headings, expected those of v"),
    ],
)
def test_a_log_of_other_arrays_is_refused(tmp_path: Path, name: str, array: Any, found: str) -> None:
    path = tmp_path / "log.npz"
    np.savez(path, **_run_arrays())
    assert malta.identification.read_log(path).samples == 50
    np.savez(path, **_run_arrays() | {name: array})
    assert found in str(refusal(lambda: malta.identification.read_log(path), path))


@pytest.mark.parametrize(
    "line",
    ["1", "null", "[]", '["a"]', '["a", 1]', '[["a"], {}]', '[1, {}]', '["a", {"m": "x"}]', "[" * 99_999, '["a'],
)  # fmt: skip
def test_trials_that_are_none_are_tried_again(tmp_path: Path, line: str) -> None:
    path = tmp_path / "trials.jsonl"
    head, whole = json.dumps({"malta-tune": 1, "problem": "p"}), '["b", {"margin": 3.0, "motion": Infinity}]'
    path.write_text("\n".join([head, line, whole, ""]), encoding="utf-8")
    journal = Journal(path, "p", restart=False)
    assert journal.known == {"b": {"margin": 3.0, "motion": np.inf}}
    assert path.read_text(encoding="utf-8") == f"{head}\n{whole}\n"


HUGE = f"{'km^9 ' * 6}m / ({'m^9 ' * 5}m^9)"  # 1e162 m


@pytest.mark.parametrize(
    "unit",
    [
        *("2 m", "m^12 / m^11", "m^99", "m^-12", "((((m))))", "1 " * 100 + "m"),
        *(HUGE, "m + m", "m.real", "kg", "Hz", "(", "1/"),
    ],
)  # fmt: skip
def test_what_is_no_unit_of_a_length_is_refused(unit: str) -> None:
    """Numbers, high powers, deep parentheses, long texts, sizes beyond all measure, other dimensions."""
    with pytest.raises(InputError, match=r"x\.unit: found .*, expected a unit of m"):
        to_si(1.0, unit, "m", "a.toml", "x")


def test_products_of_units_are_read() -> None:
    assert to_si(1.0, "(((m)))", "m", "a.toml", "x") == 1.0
    assert to_si(1.0, "m^9 / m^8", "m", "a.toml", "x") == 1.0
