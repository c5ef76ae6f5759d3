"""`malta loads`: what it prints is what `malta.margins.load_limits` proves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Run, one_sentence
from jsonschema import Draft202012Validator

import malta
from malta.cli.documents.published import schema_of
from malta.cli.loads import read_load

STRUCTURED = "design/gains/structured.json"


def test_the_table_has_what_is_proven_why_it_ends_and_what_it_is_of(run: Run) -> None:
    code, out, _ = run("loads", STRUCTURED, "--load", "F_x", "--load", "T_z")
    text = " ".join(out.split())
    assert code == 0
    assert "F_x 17.16 N fx_B2 may reach its limit" in text
    assert "42.6 N" in text
    assert "T_z nothing a load that moves none of the" in text
    assert "forces as fidelity=force flies them at z = 0 m" in text
    assert "at most 6 times their noise" in text
    assert "Left out: induced voltages, voltage limits and the DC link" in text


@pytest.mark.slow
def test_the_document_has_the_figures_of_the_record(run: Run, tmp_path: Path) -> None:
    picture = tmp_path / "loads.svg"
    code, out, _ = run("loads", STRUCTURED, "--load", "F_x", "--out", picture, "--json")
    found = json.loads(out)
    Draft202012Validator(schema_of("loads-output")).validate(found)
    assert (code, found["files"], picture.stat().st_size > 1000) == (0, [str(picture)], True)
    controller = malta.gains.read(STRUCTURED)
    record = malta.safe_load(malta.loop(malta.plant_of(controller.parameters), controller), "F_x")
    (one,) = found["loads"]
    assert (one["proven"], one["ends"]) == (record.limit, record.ends)
    assert {x["name"]: x["value"] for x in one["outputs"]} == {k: x for k, (x, _) in record.outputs.items()}
    assert one["course"]["used"][-1] == max(x["share"] for x in one["clearances"])
    assert one["linear_touches"] == pytest.approx(42.64, rel=1e-3)


@pytest.mark.slow
def test_a_box_and_another_machine_leave_less(run: Run) -> None:
    def proven(*arguments: str) -> float:
        code, out, _ = run("loads", STRUCTURED, "--load", "F_x", "--json", *arguments)
        assert code == 0
        return float(json.loads(out)["loads"][0]["proven"])

    nominal = proven()
    assert proven("--uncertain", "m=5%") < nominal
    assert proven("--set", "K_A=11000") < nominal
    assert proven("--noise", "20") < nominal


def test_without_time_nothing_is_proven_and_said_so(run: Run) -> None:
    code, out, _ = run("loads", STRUCTURED, "--time", "1e-9")
    assert code == 0
    assert out.count("no time was left for it") >= 5
    assert out.count("nothing   ") == 6


def test_a_picture_of_nothing_is_a_note(run: Run, tmp_path: Path) -> None:
    picture = tmp_path / "loads.png"
    code, _, err = run("loads", STRUCTURED, "--load", "T_z", "--out", picture)
    assert (code, picture.exists()) == (0, False)
    assert "is not drawn: no load is proven that uses a clearance of a contact" in err


def test_loads_are_read_by_name_in_shares_and_several_at_once() -> None:
    assert read_load("F_x") == "F_x"
    assert read_load("F_x=1, T_y=-45mm") == {"F_x": 1.0, "T_y": -0.045}
    assert read_load("F_x+F_y=2") == ["F_x", {"F_y": 2.0}]


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--load", "F_q"), 2, "disturbance: found 'F_q', expected one of F_x F_y F_z T_x T_y T_z"),
        (("--load", "F_x=a"), 2, "--load: F_x: found 'F_x=a', expected a name, or shares as F_x=1,T_y=-45mm"),
        (("--load", "F_x=1,F_x=2"), 2, "--load: F_x: found"),
        (("--noise", "-1"), 2, "noise: found -1"),
        (("--uncertain", "q=5%"), 2, "--uncertain: q: found an unknown parameter"),
        (("--out", "loads.txt"), 2, "loads.txt: found suffix '.txt'"),
        (("--set", "K_A=3e5"), 1, f"{STRUCTURED}: the loop (machine) is unstable, |lambda| = 1."),
    ],
)
def test_what_is_wrong_is_one_sentence(run: Run, arguments: tuple[str, ...], code: int, says: str) -> None:
    found, out, err = run("loads", STRUCTURED, *arguments)
    assert (found, out) == (code, "")
    assert says in one_sentence(err)
