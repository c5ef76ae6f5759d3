"""The JSON documents of the commands keep to the schemas that are published of them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from conftest import Run
from jsonschema import Draft202012Validator

import malta
from malta.cli.documents.published import ALL_SCHEMAS, MODELS, schema_of as schema
from malta.report.ledger import Ledger, LedgerClaim
from malta.units import distinct, identifier, unit_factor, unit_suffix

pytestmark = [pytest.mark.usefixtures("proven_once"), pytest.mark.first]

TABLE2, HALBACH = "design/gains/table2.json", "design/gains/halbach.json"
FEW: dict[str, dict[str, Any]] = {"capture": {"points": 5}, "supervised-faults": {"only": "stuck"}}
SI = re.compile(r"(_(1|s2?|m2?|A|rad|Hz|N|J|W|V|kg|share|per|samples))+$")


def document(said: tuple[int, str, str], name: str) -> dict[str, Any]:
    """The one document on standard output, which fits the schema of its name."""
    _, out, _ = said
    content: dict[str, Any] = json.loads(out, parse_constant=lambda word: pytest.fail(word))
    assert list(content)[:2] == ["schema", "version"]
    version = {"rare-output": 2}.get(name, 1)
    assert (content["schema"], content["version"]) == (f"malta-{name}", version)
    Draft202012Validator(schema(name)).validate(content)
    for key in _keys(content):
        assert key.isidentifier(), key
    return content


def _keys(content: Any) -> list[str]:
    """Every key of a document, but of the manifest, which has its own format."""
    if isinstance(content, dict):
        inner = [key for name, value in content.items() if name != "manifest" for key in _keys(value)]
        return [*content, *inner]
    return [key for value in content for key in _keys(value)] if isinstance(content, list) else []


@pytest.mark.slow_for("design")
@pytest.mark.parametrize("name", ALL_SCHEMAS)
def test_every_schema_is_one(name: str) -> None:
    found = schema(name)
    Draft202012Validator.check_schema(found)
    assert found["$schema"] == "https://json-schema.org/draft/2020-12/schema"
    if name in MODELS:
        assert found["properties"]["schema"]["const"] == f"malta-{name}"
        assert set(found["required"]) == set(found["properties"])
        assert found["additionalProperties"] is False


def test_the_command_prints_them(run: Run) -> None:
    assert run("schema").out.split() == list(ALL_SCHEMAS)
    assert json.loads(run("schema", "check-output").out) == schema("check-output")
    said = run("schema", "chekc-output")
    assert said.code == 2
    assert said.err.startswith("malta: schema: found 'chekc-output', expected one of gain, design, data, ")


@pytest.mark.slow
@pytest.mark.parametrize("gains", ["halbach", "planar_pid"])
def test_verify(run: Run, gains: str) -> None:
    found = document(run("verify", f"design/gains/{gains}.json", "--no-proof", "--json"), "verify-output")
    assert found["peak_sensitivity"].keys() == {"sampled", "current_loops", "machine"}
    assert found["robust"]["travel"]["lower"] is None
    assert all(disk["phase_rad"] < 3.15 for disk in found["robust"]["disks"])


@pytest.mark.slow
def test_verify_as_json_and_as_tables_has_the_figures_of_the_record(run: Run) -> None:
    """Figures of a shipped design; those of frequencies agree with 400 000 of them to 2e-5."""
    gains = "design/gains/halbach.json"
    found = document(run("verify", gains, "--no-proof", "--json"), "verify-output")
    record = malta.verify(gains, proof=False)
    robust = found["robust"]
    assert found["bandwidth_rad_per_s"] == {
        k: pytest.approx(v, rel=1e-9) for k, v in record.bandwidth.items()
    }
    assert found["bandwidth_rad_per_s"]["sigma_max_T"] == pytest.approx(21.488504, rel=1e-6)
    peaks = [link["peak_sensitivity"] for link in robust["chain"]]
    assert peaks == pytest.approx([link.peak for link in record.chain], rel=1e-9)
    assert peaks == pytest.approx([1.0, 1.278983, 1.3213626, 1.8511865], rel=1e-6)
    assert [link["stage"] for link in robust["chain"]] == ["LQR", "LQG", "+ current loops", "sampled"]
    disk = {"size": 0.7671829, "gain": 2.2446013, "phase_rad": 0.7325631, "frequency_rad_per_s": 20.591044}
    assert robust["disks"][0] == {"channels": "forces"} | {
        k: pytest.approx(v, rel=1e-5) for k, v in disk.items()
    }
    gang = {"S": 1.8511865, "T": 1.0, "SP": 0.00211222785, "FS": 4396.68}
    assert robust["gang_of_four"]["x"] == {"unit": "m"} | {
        k: pytest.approx(v, rel=1e-5) for k, v in gang.items()
    }
    assert robust["delay_s"] == {"x": pytest.approx(0.07316993, rel=1e-5)}
    (moved,) = [one["outputs"]["x"] for one in found["recovery"][:1]]
    assert (moved["settled_s"], moved["largest"]) == pytest.approx((0.825, 1.44345e-3), rel=1e-4)
    assert moved["left"][1] == {"after_s": 0.3, "value": pytest.approx(9.5567e-4, rel=1e-4)}
    tables = run("verify", gains, "--no-proof").out
    for text in ("21.5", "1.28", "0.767", "73170 µs", "0.825"):
        assert text in tables


@pytest.mark.slow
def test_verify_of_an_unstable_loop_has_nulls(run: Run) -> None:
    said = run("verify", TABLE2, "--set", "K_A=5e4", "--no-proof", "--json")
    assert said.code == 1
    found = document(said, "verify-output")
    assert found["bandwidth_rad_per_s"]["sigma_max_T"] is None
    assert found["stable"] is False


@pytest.mark.slow
def test_simulate(run: Run) -> None:
    found = document(run("simulate", TABLE2, "--json"), "simulate-output")
    merits = found["merits"]
    assert merits["rise_s"] == pytest.approx(0.0158, abs=1e-3)
    assert merits["drive_constant_N_per_A"] == pytest.approx(5.2)
    assert all(SI.search(key) for key in merits)
    for key, value in found["stroke"].items():
        if key in merits:
            assert merits[key] == value
    heavy = run("simulate", TABLE2, "--set", "m=0.56", "--json")
    assert document(heavy, "simulate-output")["stroke"]["rise_s"] is None


@pytest.mark.slow
def test_campaign_and_its_status(run: Run, tmp_path: Path) -> None:
    common = ("campaign", TABLE2, "--out", tmp_path, "--json")
    found = document(run(*common, "--samples", "4", "--spread", "5%"), "campaign-output")
    assert (found["samples"], found["runs"], found["interrupted"]) == (4, 4, False)
    assert found["worst"][0]["deviation"].keys() == {"x1_m", "y1_m", "x2_m", "y2_m", "z_m"}
    assert "rise_s" in found["merits"]
    seen = document(run("campaign", TABLE2, "--status", tmp_path, "--json"), "status-output")
    assert {key: seen[key] for key in ("merits", "yield", "ends")} == {
        key: found[key] for key in ("merits", "yield", "ends")
    }


def test_claims(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    claim = LedgerClaim("poles [rad/s]", "1", ("2",), "not reproduced; so", "differs")
    ledger = Ledger("tubular", "A. Author", ("a",), (claim,), ("a",))
    monkeypatch.setattr("malta.cli.pages.compute_ledgers", lambda *_: [ledger])
    found = document(run("claims", "design/table2.toml", "--json"), "claims-output")
    assert found["ledgers"][0]["reproducing"] == ["a"]
    assert found["ledgers"][0]["claims"][0] == claim._asdict() | {"ours": ["2"]}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        (
            "rare-output",
            ["--study", "rare", "--limit", "deviation-y1=1nm", "--spread", "60%", "--samples", "2000"],
        ),
        ("sobol-output", ["--study", "sensitivity", "--spread", "60%", "--samples", "128"]),
        (
            "tolerance-output",
            ["--study", "tolerances", "--keep", "90%", "--spread", "20%", "--samples", "64"],
        ),
    ],
)
def test_studies(run: Run, tmp_path: Path, name: str, arguments: list[str]) -> None:
    found = document(run("campaign", TABLE2, *arguments, "--out", tmp_path, "--json"), name)
    assert found["gains"] == TABLE2


@pytest.mark.slow
def test_the_others(run: Run, tmp_path: Path) -> None:
    said = run("design", "design/calibrated.toml", "--json", "--out", tmp_path, "--figures", tmp_path)
    assert document(said, "design-output")["designs"][0]["merits"]["rise_s"] > 0
    certificate = tmp_path / "c.json"
    said = run("verify", HALBACH, "--uncertain", "m=10%", "--certificate", certificate, "--json")
    assert document(said, "verify-output")["robust"]["travel"]["lower"] > 1
    same = ("--gains", HALBACH, "--uncertain", "m=10%")
    assert document(run("check", certificate, *same, "--json"), "check-output")["compared"]
    document(run("export", HALBACH, "--out", tmp_path / "c", "--json"), "export-output")
    document(run("report", HALBACH, "--no-proof", "--out", tmp_path / "r.html", "--json"), "report-output")
    assert (
        document(run("tune", "examples/ball/design/ball.toml", "--check", "--json"), "tune-output")["search"]
        is None
    )


@pytest.mark.slow
@pytest.mark.parametrize("gains", ["calibrated", "halbach", "planar"])
def test_every_scenario(run: Run, gains: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from malta import gains as gain_files
    from malta.model.plants import plant_of
    from malta.simulation.experiments import catalogue

    def quick(name: str, plant: Any, c: Any, **options: Any) -> Any:
        return experiment(name, plant, c, **(options | FEW.get(name, {})))

    experiment = catalogue.experiment
    monkeypatch.setattr(catalogue, "experiment", quick)
    file = f"design/gains/{gains}.json"
    for name in catalogue.experiments_of(plant_of(gain_files.read(file).parameters)):
        found = document(run("simulate", file, "--scenario", name, "--json", "--yes"), "simulate-output")
        assert found["scenario"] == name


@pytest.mark.parametrize(
    "unit", ["ms", "um", "um/N", "N/um", "mm/s", "m/s^2", "N m", "urad", "kg m^2", "N/A", "Hz", "rad/s", "J"]
)
def test_the_end_of_a_key_is_the_si_unit(unit: str) -> None:
    words = unit_suffix(unit).replace("_per_", "/").replace("_", " ").replace("2", "^2")
    assert unit_factor(words, "unit") == 1
    assert unit_factor(unit, "unit") != 1 or words == unit


def test_identifiers() -> None:
    assert identifier("rise, 10-90 %", "ms") == "rise_s"
    assert identifier("SP2: largest deviation, true", "um") == "SP2_largest_deviation_true_m"
    assert identifier("50 % of it", "1") == "_50_of_it"
    assert identifier("größte Kraft", "N") == "größte_Kraft_N"
    assert identifier("<b>", "percent") == "b_share"
    assert identifier("", "1") == "figure"
    assert distinct(["a", "a", "b", "a"]) == ["a", "a_2", "b", "a_3"]
