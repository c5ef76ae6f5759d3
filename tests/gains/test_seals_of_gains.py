"""What stands between a gain file and its reader, on a shipped file whose seal is renewed after every change."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import refusal

import malta
from malta import gains
from malta.gains import encodings
from malta.gains.schema import GainFile

SHIPPED = Path("design/gains/table2.json")
Change = Callable[[dict[str, Any]], Any]


def _written(folder: Path, change: Change) -> Path:
    """The shipped document with a change, and with the sha256 that its reader computes."""
    document = copy.deepcopy(encodings.decode(SHIPPED))
    change(document)
    try:
        read = GainFile.model_validate(document).model_dump(by_alias=True, exclude_unset=True)
    except ValueError:
        read = document
    path = folder / "changed.json"
    path.write_text(json.dumps(document | {"sha256": encodings.content_sha256(read)}), encoding="utf-8")
    return path


def _put(table: str, key: str, value: Any, document: dict[str, Any]) -> None:
    document[table][key] = value


def _scale(table: str, key: str, factor: float, document: dict[str, Any]) -> None:
    rows = document[table][key]
    document[table][key] = [
        [factor * x for x in row] if isinstance(row, list) else factor * row for row in rows
    ]


def _turn(document: dict[str, Any]) -> None:
    rows = document["signals"]["forces"]
    rows[0], rows[1] = rows[1], rows[0]


def _twice(document: dict[str, Any]) -> None:
    document["feedforward"]["z_grid"][1] = document["feedforward"]["z_grid"][0]


def _brake(error: float, k: int, document: dict[str, Any]) -> None:
    document |= {"version": 2, "law": {"tracks": "states", "braking": [error * (n == k) for n in range(5)]}}


CHANGES: dict[str, tuple[Change, str]] = {
    "another schema": (lambda d: d.update(schema="other"), "schema"),
    "another version": (lambda d: d.update(version=3), "version"),
    "gains that do not stabilize": (partial(_scale, "gains", "K", -1.0), "gains.K"),
    "a filter that does not converge": (partial(_scale, "gains", "L", -1.0), "gains.L"),
    "two equal positions": (_twice, "feedforward.z_grid"),
    "a limit of zero": (partial(_put, "limits", "force", [0.0] * 5), "limits.force"),
    "a variance of zero": (partial(_put, "noise", "sensor", [0.0] * 5), "noise.sensor"),
    "a weight of zero on an input": (partial(_put, "cost", "input", [0.0] * 5), "cost.input"),
    "a negative weight": (partial(_put, "cost", "state", [-1.0] * 10), "cost.state"),
    "forces in another order": (_turn, "signals.forces"),
    "no sample time": (lambda d: d.update(sample_time=0.0), "sample_time"),
    "NaN": (partial(_put, "operating_point", "u", [float("nan")] * 5), "operating_point.u.0"),
    "infinity": (partial(_put, "limits", "voltage", [float("inf")] * 5), "limits.voltage.0"),
    "braking below 0": (partial(_brake, -1e-3, 4), "law.braking"),
    "braking of a sensor beside the centre": (partial(_brake, 1e-3, 0), "law.braking"),
    "an unknown key": (partial(_put, "design", "note", "mine"), "design.note"),
    "an unknown table": (lambda d: d.update(notes={}), "notes"),
}


def test_an_unchanged_document_is_read(tmp_path: Path) -> None:
    assert gains.read(_written(tmp_path, lambda _: None)).name == "table2"


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_document_is_refused_behind_its_seal(tmp_path: Path, name: str) -> None:
    change, field = CHANGES[name]
    path = _written(tmp_path, change)
    assert refusal(lambda: gains.read(path), path).field == field


NAMES = ["../../mine", "/etc/mine", "a/b", "a\\b", "..", ".mine", "", " ", "a\x00b", "a\nb", "w" * 81]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_leads_to_another_folder_is_refused(tmp_path: Path, name: str) -> None:
    """Figures, time series and campaigns have names and folders with the name in a gain file."""
    path = _written(tmp_path, partial(_put, "design", "name", name))
    assert refusal(lambda: gains.read(path), path).field == "design.name"


@pytest.mark.parametrize("name", NAMES)
def test_a_machine_whose_name_leads_to_another_folder_is_refused(tmp_path: Path, name: str) -> None:
    """Published figures are looked for by the name of a machine."""
    plant = malta.linear_machine([[0, 1], [100, -1]], [[0], [2]], [[1, 0]], name="my cart (2.1)")
    model = malta.linearize(plant, plant.at())
    controller = malta.lqg(
        model, malta.synthesis.weights([10, 1], [1], [1e-2], [1e-8], q_i=[10]), 1e-3, name="my LQG"
    )
    document = gains.document(controller, malta.verify(model, controller))
    document["plant"]["preset"] = name
    path = tmp_path / "mine.json"
    path.write_bytes(encodings.encode(document | {"sha256": encodings.content_sha256(document)}, path))
    assert refusal(lambda: gains.read(path), path).field.startswith("plant.")
    document["plant"]["preset"] = "my cart (2.1)"
    path.write_bytes(encodings.encode(document | {"sha256": encodings.content_sha256(document)}, path))
    assert gains.read(path).name == "my LQG"


def test_a_name_that_could_not_be_read_is_not_written(tmp_path: Path) -> None:
    controller = gains.read(SHIPPED)
    plant = malta.plant_of(controller.parameters)
    margins = malta.verify(malta.linearize(plant, plant.at()), controller)
    with pytest.raises(malta.InputError, match=r"design\.name"):
        gains.write(replace(controller, name="../mine"), margins, tmp_path / "mine.json")
    assert list(tmp_path.iterdir()) == []


def test_matrices_of_another_machine_are_refused(tmp_path: Path) -> None:
    """A table plant.linear is of machines from plain matrices alone."""
    one = {"A": [[0.0]], "B": [[1.0]], "C": [[1.0]]}
    signals = [{"name": "x", "unit": "1"}]
    linear: dict[str, Any] = {
        "states": signals,
        "inputs": signals,
        "outputs": signals,
        "matrices": one,
        "terms": None,
    }
    linear |= {"limit": None, "noise": [0.0], "dead_time": 0.0}

    def change(document: dict[str, Any]) -> None:
        document["plant"]["linear"] = linear
        document |= {"version": 2, "law": {"tracks": "states"}}

    path = _written(tmp_path, change)
    error = refusal(lambda: gains.read(path), path)
    assert (error.field, error.found) == ("plant.linear", "matrices of a tubular")


def test_a_last_digit_without_a_new_seal_is_refused(tmp_path: Path) -> None:
    document = encodings.decode(SHIPPED)
    document["gains"]["K"][0][0] *= 1 + 1e-12
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(document), encoding="utf-8")
    assert refusal(lambda: gains.read(path), path).field == "sha256"


def test_a_key_that_stands_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "changed.json"
    path.write_text('{"schema": "malta-gains", ' + SHIPPED.read_text(encoding="utf-8")[1:], encoding="utf-8")
    assert "schema stands twice" in str(refusal(lambda: gains.read(path), path))


def test_a_mat_whose_header_has_another_hash_is_refused(tmp_path: Path) -> None:
    """The document in it is the shipped one, to the bit."""
    data = SHIPPED.with_suffix(".mat").read_bytes()
    header = data[: encodings.MAT_HEADER]
    other = header.replace(hashlib.sha256(data[encodings.MAT_HEADER :]).hexdigest().encode(), b"0" * 64)
    assert other != header
    path = tmp_path / "changed.mat"
    path.write_bytes(other + data[encodings.MAT_HEADER :])
    assert "does not hold the sha256" in str(refusal(lambda: gains.read(path), path))
