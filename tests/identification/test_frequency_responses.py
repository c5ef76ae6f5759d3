"""Frequency responses in and out: python-control's FRD, analysers' tables, and what is refused of them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import Run

import malta
from malta.identification import (
    FrequencyResponse,
    compare_response,
    read_response,
    responses_of,
    write_responses,
)
from malta.identification.measure import loop_curves

GAINS = "design/gains/tubular_pid.json"
CONTROLLER = malta.gains.read(GAINS)
W = 2 * np.pi * np.geomspace(5, 2000, 40)


@pytest.fixture(scope="module")
def predicted() -> FrequencyResponse:
    loop = malta.loop(malta.plant_of(CONTROLLER.parameters), CONTROLLER)
    return FrequencyResponse("S x1", W, loop_curves(loop, W)[0][:, 0])


def written(path: Path, heading: str, *columns: object, separator: str = ",") -> Path:
    rows = np.column_stack([np.asarray(one) for one in columns])
    lines = [heading, *(separator.join(f"{x:.12g}" for x in row) for row in rows.tolist())]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_tables_of_analysers_are_read(predicted: FrequencyResponse, tmp_path: Path) -> None:
    G, f = predicted.values, W / (2 * np.pi)
    phase = np.unwrap(np.angle(G))
    forms = {
        "frequency [Hz],S x1 re,S x1 im": (f, G.real, G.imag),
        "Frequency (Hz),Magnitude (dB),Phase (deg)": (f, 20 * np.log10(np.abs(G)), np.degrees(phase)),
        "Freq [kHz],Gain,Phase [rad]": (f / 1e3, np.abs(G), phase),
        "omega [rad/s],Real,Imag": (W, G.real, G.imag),
    }
    for heading, columns in forms.items():
        read = read_response(written(tmp_path / "a.csv", heading, *columns), "S x1")
        assert read.w == pytest.approx(W, rel=1e-9)
        assert read.values == pytest.approx(G, rel=1e-9)
    path = tmp_path / "a.csv"
    path.write_text(path.read_text().replace(",", ";").replace(".", ","))
    assert read_response(path).values == pytest.approx(G, rel=1e-9)


@pytest.mark.slow
def test_responses_go_out_and_come_back(predicted: FrequencyResponse, tmp_path: Path) -> None:
    import control

    frd = predicted.to_control()
    assert isinstance(frd, control.FrequencyResponseData)
    assert frd(1j * W[7]) == pytest.approx(predicted.values[7])
    other = FrequencyResponse("T x1", W, 1 - predicted.values)
    path = write_responses({"S x1": predicted, "T x1": other}, tmp_path / "both.csv")
    assert read_response(path, "T x1").values == pytest.approx(other.values, rel=1e-9)
    with pytest.raises(malta.InputError, match="found 2 responses, expected one of 'S x1' 'T x1'"):
        read_response(path)
    with pytest.raises(malta.InputError, match="the same ones"):
        write_responses({"a": predicted, "b": FrequencyResponse("b", 2 * W, W + 0j)}, path)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("a,b,c\n1,2,3\n2,3,4\n", "expected one of frequencies"),
        ("frequency [Hz],a,b\n1,2,3\n2,3,4\n", "expected a pair of re and im"),
        ("frequency [Hz],magnitude\n1,2\n2,3\n", "expected a pair of re and im"),
        ("frequency [Hz],re,im\n1,2,3\n", "expected 2 to"),
        ("frequency [Hz],re,im\n2,2,3\n1,3,4\n", "row 2 of numbers: found a frequency that does not rise"),
        ("frequency [Hz],re,im\n0,2,3\n1,3,4\n", "row 1 of numbers: found a frequency that does not rise"),
        ("frequency [Hz],re,im\n1,2,nan\n2,3,4\n3,4,5\n", "no finite number"),
        ("frequency [Hz],mag [dB],phase\n1,2,3\n2,1e9,4\n3,4,5\n", "no finite number"),
        ("frequency [m],re,im\n1,2,3\n2,3,4\n", "expected Hz, kHz, MHz or rad/s"),
        ("", "expected"),
    ],
)  # fmt: skip
def test_bad_tables_are_refused_in_a_sentence(text: str, says: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(malta.InputError, match=says) as refused:
        read_response(path)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_response_is_judged_by_the_machine(predicted: FrequencyResponse) -> None:
    same = compare_response(CONTROLLER, predicted)
    assert same.refusal == ""
    assert same.error.max() < 1e-12
    wrong = FrequencyResponse("S x1", W, 1.2 * predicted.values)
    assert compare_response(CONTROLLER, wrong).refusal.startswith("|S x1| at ")
    assert compare_response(CONTROLLER, wrong, uncertainty={"K_B": 0.2}).machines > 30
    turned = FrequencyResponse("", W, -predicted.values)
    assert "has the other sign" in compare_response(CONTROLLER, turned, "S x1").refusal
    with pytest.raises(malta.InputError, match="expected one of 'S x1'"):
        compare_response(CONTROLLER, predicted, "S q")
    high = FrequencyResponse("S x1", np.array([10.0, 1e6]), np.ones(2, dtype=complex))
    with pytest.raises(malta.InputError, match="frequencies below 1e\\+04 Hz"):
        compare_response(CONTROLLER, high)


def test_the_machine_alone_is_that_of_its_loop() -> None:
    """P of a command by the loop's pieces, S P = S times it, and by the responses of the nominal loop."""
    loop = malta.loop(malta.plant_of(CONTROLLER.parameters), CONTROLLER)
    P, _ = loop.nominal.response(W)
    curves = loop_curves(loop, W)
    assert curves[4] == pytest.approx(P, rel=1e-6, abs=1e-9 * np.abs(P).max())
    assert curves[3] == pytest.approx(loop.sensitivity(W) @ P, rel=1e-5, abs=1e-8 * np.abs(P).max())
    one = FrequencyResponse("P x1/fx_B1", W, P[:, 0, 0])
    assert compare_response(CONTROLLER, one).error.max() < 1e-5


@pytest.mark.slow
def test_an_identified_machine_writes_its_responses(tmp_path: Path, run: Run) -> None:
    """They are those of the loop with its parameters, at the lines."""
    believed = malta.plant_of(CONTROLLER.parameters)
    true = believed.variant(replace(believed.parameters, K_A=9000.0))
    plan = malta.excite(malta.loop(believed, CONTROLLER), period=0.5, periods=4, band=(4, 400))
    flight = malta.simulate(true, CONTROLLER, malta.Scenario.excited(plan.signal, plan.duration))
    path = malta.identification.write_log(malta.identification.log_of(flight), tmp_path / "log.npz")
    out = tmp_path / "found.csv"
    said = run("identify", GAINS, path, "-p", "K_A", "-p", "K_B", "-o", out)
    assert said.code == 0, said.err
    found = read_response(out, "S x1")
    assert compare_response(CONTROLLER, found, parameters=true.parameters).error.max() < 0.01
    assert compare_response(CONTROLLER, found).error.max() > 0.02
    assert found.to_control().ninputs == 1


@pytest.mark.slow
def test_measured_responses_are_written_and_compared(tmp_path: Path, run: Run) -> None:
    plant = malta.plant_of(CONTROLLER.parameters)
    plan = malta.excite(malta.loop(plant, CONTROLLER), period=0.5, periods=4, band=(4, 400))
    flight = malta.simulate(plant, CONTROLLER, malta.Scenario.excited(plan.signal, plan.duration))
    log = malta.identification.log_of(flight)
    measured = malta.measure(CONTROLLER, log)
    assert len(responses_of(measured)) == 3 * 5 + 25
    path = malta.identification.write_log(log, tmp_path / "log.npz")
    said = run("measure", GAINS, path, "--out", tmp_path / "all.csv")
    assert said.code == 0, said.err
    said = run("measure", GAINS, "--response", tmp_path / "all.csv", "--of", "S x1", "--json")
    assert said.code == 0, said.err
    found = json.loads(said.out)
    assert found["response"] == "S x1"
    assert max(found["error"]) < 0.1
    assert np.array(found["measured"]) == pytest.approx(measured.S.size[:, 0], rel=1e-9)
    assert run("measure", GAINS, "--response", tmp_path / "all.csv", "--of", "SP x1/fx_B1").code == 0
    assert run("measure", GAINS, "--response", tmp_path / "all.csv").code == 2
    said = run("measure", GAINS, "--response", tmp_path / "all.csv", "--of", "L z")
    assert "L z: measured beside predicted" in said.out
