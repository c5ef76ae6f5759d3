"""Schemas of files: shipped files fit, damaged ones do not, and what a schema refuses the reader refuses too."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from conftest import ROOT
from hypothesis import HealthCheck, given, settings, strategies as st
from jsonschema import Draft202012Validator

import malta
from fuzz.edits import EDITS, edited
from fuzz.gain_files import gain_document, signed
from malta.cli.export import schema as schema_command
from malta.gains.encodings import decode
from malta.schemas import SCHEMAS, schema
from malta.tables import load_toml

pytestmark = pytest.mark.usefixtures("proven_once")

DESIGN_FILES = [*(ROOT / "design").glob("*.toml"), *ROOT.glob("examples/*/design/*.toml")]
DATA_FILES = [*(ROOT / "data").glob("*.toml"), *ROOT.glob("examples/*/*.toml")]
GAIN_FILES = [
    path for path in (ROOT / "design" / "gains").glob("*.*") if path.stem in ("table2", "halbach_late")
]
LARGE_GAIN_FILES = sorted({*(ROOT / "design" / "gains").glob("*.*")} - {*GAIN_FILES})


def faults(name: str, content: Any, plant: malta.model.Plant | None = None) -> list[str]:
    found = Draft202012Validator(schema(name, plant)).iter_errors(content)
    return [f"{error.json_path}: {error.message[:200]}" for error in found]


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_schema_is_one(name: str) -> None:
    found = schema(name)
    Draft202012Validator.check_schema(found)
    assert found == json.loads(json.dumps(found))
    assert found["title"] == f"malta {name} file"


@pytest.mark.parametrize("path", DESIGN_FILES, ids=lambda path: path.stem)
def test_design_files_fit(path: Path) -> None:
    """Both schemas: of any machine, and of the one that the file names."""
    content = load_toml(path)
    assert faults("design", content) == []
    assert faults("design", content, malta.read_design(path).plant) == []


@pytest.mark.parametrize("path", DATA_FILES, ids=lambda path: path.stem)
def test_data_files_fit(path: Path) -> None:
    content = load_toml(path)
    assert faults("data", content) == []
    assert faults("data", content, malta.plant_of(malta.read(path))) == []


@pytest.mark.parametrize("path", GAIN_FILES, ids=lambda path: path.name)
def test_gain_files_fit(path: Path) -> None:
    """In all encodings: .npz and .mat hold the same tables."""
    assert faults("gain", decode(path)) == []


@pytest.mark.slow
@pytest.mark.parametrize("path", LARGE_GAIN_FILES, ids=lambda path: path.name)
def test_all_gain_files_fit(path: Path) -> None:
    assert faults("gain", decode(path)) == []


def test_a_gain_file_of_plain_matrices_fits() -> None:
    assert faults("gain", gain_document("linear")) == []


Change = Callable[[dict[str, Any]], object]
DAMAGED: dict[str, tuple[str, str, Change]] = {
    "unknown key": ("design", "robust", lambda c: c.update(colour="red")),
    "no sample time": ("design", "robust", lambda c: c.pop("sample_time")),
    "no weights": ("design", "robust", lambda c: c.pop("weights")),
    "weights beside a PID": ("design", "halbach_pid", lambda c: c.update(weights={})),
    "a number for a quantity": ("design", "robust", lambda c: c.update(sample_time=50e-6)),
    "a unit forgotten": ("design", "robust", lambda c: c["sample_time"].pop("unit")),
    "another discretization": ("design", "robust", lambda c: c.update(discretization="tustin")),
    "a long delay": ("design", "robust", lambda c: c.update(delay=11)),
    "uncertainty of 100 %": ("design", "halbach_pid", lambda c: c["uncertainty"].update(m=1.0)),
    "correlation of 1": ("design", "robust", lambda c: c["noise"]["correlation"].update(x=1)),
    "a published text": ("design", "table2", lambda c: c.update(summary={"published": "table_I.unit"})),
    "a published table of tables": (
        "design",
        "table2",
        lambda c: c.update(weights={"published": "table_II"}),
    ),
    "a text for a switch": ("design", "robust", lambda c: c.update(current_lag="yes")),
    "a range from 0": ("design", "robust", lambda c: c["search"]["numbers"]["tilt"].update(low=0)),
    "a name with a slash": ("design", "robust", lambda c: c.update(name="a/b")),
    "a value without source": ("data", "tubular", lambda c: c["parameters"]["m"].pop("source")),
    "an unknown tag": ("data", "tubular", lambda c: c["parameters"]["m"].update(tag="guessed")),
    "no machine": ("data", "tubular", lambda c: c.pop("machine")),
    "a text for a number": ("data", "halbach", lambda c: c["parameters"]["m"].update(value="1.2")),
    "no gains": ("gain", "table2", lambda c: c.pop("gains")),
    "a row that is a number": ("gain", "table2", lambda c: c["gains"].update(K=[1.0])),
    "version 3": ("gain", "table2", lambda c: c.update(version=3)),
    "a law in version 1": ("gain", "table2", lambda c: c.update(law={"tracks": "states"})),
    "a key of editors": ("gain", "table2", lambda c: c.update({"$schema": "gain.json"})),
    "sample time of 0": ("gain", "table2", lambda c: c.update(sample_time=0)),
}


def shipped(name: str, stem: str) -> dict[str, Any]:
    if name == "gain":
        return json.loads(json.dumps(gain_document(stem)))  # type: ignore[no-any-return]
    return load_toml(ROOT / name / f"{stem}.toml")


def read_back(name: str, stem: str, content: dict[str, Any], folder: Path) -> object:
    """Read a file of this content; a design file names the machine where it stands."""
    if name == "gain":
        path = folder / "gain.json"
        path.write_text(json.dumps(signed(content)))
        return malta.gains.read(path)
    if content.get("machine") == shipped(name, stem).get("machine") and name == "design":
        content = content | {"machine": str(ROOT / "data" / Path(content["machine"]).name)}
    path = folder / "file.toml"
    path.write_text(tomlkit.dumps(content))
    return malta.read_design(path) if name == "design" else malta.read(path)


@pytest.mark.parametrize("damage", DAMAGED)
def test_damaged_files_are_refused_by_schema_and_reader(damage: str, tmp_path: Path) -> None:
    name, stem, change = DAMAGED[damage]
    content = shipped(name, stem)
    change(content)
    assert faults(name, content)
    with pytest.raises(malta.InputError):
        read_back(name, stem, content, tmp_path)


def check_edits(name: str, stem: str, count: int, folder: Path) -> int:
    """Damage a shipped file at random, and require that the reader refuses what the schema refuses; how many."""
    refused = 0
    original, known = shipped(name, stem), Draft202012Validator(schema(name))

    @settings(
        max_examples=count,
        deadline=None,
        database=None,
        derandomize=True,
        suppress_health_check=[*HealthCheck],
    )
    @given(st.lists(EDITS, min_size=1, max_size=2))
    def check(edits: list[Any]) -> None:
        nonlocal refused
        content = edited(original, edits)
        if not isinstance(content, dict):
            return
        try:
            text = json.dumps(content) if name == "gain" else tomlkit.dumps(content)
            text.encode()
            content = json.loads(text) if name == "gain" else tomllib.loads(text)
        except Exception:  # what the format cannot hold
            return
        if known.is_valid(content):
            return
        refused += 1
        with pytest.raises(malta.InputError):
            read_back(name, stem, content, folder)

    check()
    return refused


@pytest.mark.slow_for("data-halbach")
@pytest.mark.parametrize(
    ("name", "stem"), [("design", "halbach_pid"), ("data", "halbach"), ("gain", "halbach")]
)
def test_what_the_schema_refuses_the_reader_refuses(name: str, stem: str, tmp_path: Path) -> None:
    assert check_edits(name, stem, 12, tmp_path) > 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "stem"),
    [("design", "robust"), ("design", "halbach_pid"), ("data", "tubular"), ("gain", "linear")],
)
def test_whatever_the_schema_refuses_the_reader_refuses(name: str, stem: str, tmp_path: Path) -> None:
    assert check_edits(name, stem, 100, tmp_path) > 20


def test_schemas_of_a_machine_know_its_names() -> None:
    """A name that the machine does not have is a fault, and a signal that is missing too."""
    spec = malta.read_design(ROOT / "design" / "robust.toml")
    content = load_toml(spec.path)
    content["weights"]["state"]["gamma"] = content["weights"]["state"].pop("x")
    content["uncertainty"] = {"mass": 0.2}
    content["specification"]["payloads"] = content["specification"].pop("payload")
    assert len(faults("design", content)) == 0
    places = {fault.split(":")[0] for fault in faults("design", content, spec.plant)}
    assert places == {"$.weights.state", "$.uncertainty", "$.specification"}
    data = load_toml(ROOT / "data" / "tubular.toml")
    data["parameters"]["mass"] = data["parameters"].pop("m")
    assert faults("data", data) == []
    assert len(faults("data", data, spec.plant)) == 1


@pytest.mark.parametrize("name", ["design", "data"])
def test_the_example_of_a_page_fits(name: str) -> None:
    page = (ROOT / "docs" / "formats" / f"{name}.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert faults(name, tomllib.loads(example)) == []


def test_the_command_knows_machines(capsys: pytest.CaptureFixture[str]) -> None:
    schema_command("design", Path("data/halbach.toml"))
    plant = malta.plant_of(malta.read("data/halbach.toml"))
    assert json.loads(capsys.readouterr().out) == schema("design", plant)


def test_unknown_schemas_are_refused() -> None:
    with pytest.raises(malta.InputError, match="gain, design, data"):
        schema("gains")
    plant = malta.plant_of(malta.read(ROOT / "data" / "halbach.toml"))
    with pytest.raises(malta.InputError, match="design, data"):
        schema("gain", plant)


def test_every_entry_says_what_it_holds() -> None:
    def silent(node: dict[str, Any], at: str) -> list[str]:
        found = []
        for key, inner in node.get("properties", {}).items():
            found += [] if "description" in inner else [f"{at}.{key}"]
        return found

    for name in SCHEMAS:
        found = schema(name)
        tables = {name: found} | found["$defs"]
        assert [place for at, table in tables.items() for place in silent(table, at)] == []
