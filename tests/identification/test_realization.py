"""Linear models of logs alone, against machines of other equations: poles, delay, responses, laws, and refusals.

- A model is that of two coupled masses on negative springs, which a law of two channels holds, from its log.
- Over many logs the mean error is as small as its scatter allows, though commands follow from noise.
- Continuous and sampled responses give the poles that they were made of, stable and unstable.
- A law that is designed on the model holds the machine itself.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from conftest import Run, one_sentence
from scipy.linalg import expm

import malta
from malta.identification import FrequencyResponse, Log, log_files, log_of, read_log, read_response, write_log
from malta.identification.readers.stored import StoredTable
from malta.model import Signal
from malta.synthesis.law_system import law_system

T, PERIOD = 1e-3, 1000  # s, samples
M, K = np.diag([0.5, 0.8]), np.array([[-9000.0, 1500.0], [1500.0, -6000.0]])  # kg, N/m
D, INTO = np.array([[1.0, -0.5], [-0.5, 1.5]]), np.array([[1.0, 0.1], [0.0, 1.2]])  # N s/m, 1
A = np.block([[np.zeros((2, 2)), np.eye(2)], [-np.linalg.solve(M, K), -np.linalg.solve(M, D)]])
B = np.vstack([np.zeros((2, 2)), np.linalg.solve(M, INTO)])
POLES = np.sort(np.linalg.eigvals(A).real)
GAINS = "design/gains/tubular_pid.json"


def sampled() -> tuple[Any, Any]:
    """The same machine under a hold."""
    whole = expm(np.block([[A, B], [np.zeros((2, 6))]]) * T)
    return whole[:4, :4], whole[:4, 4:]


def record(seed: int, *, noise: float = 1e-6, periods: int = 8, inputs: tuple[int, ...] = (0, 1)) -> Log:
    """The machine under a PD law of each reading, forces a sample late, with cosines beside them."""
    Ad, Bd = sampled()
    rng, k = np.random.default_rng(seed), np.arange(PERIOD)
    lines = np.unique(np.round(np.geomspace(2, 200, 24)).astype(int))
    sent = np.zeros((PERIOD, 2))
    for n, line in enumerate(lines):
        wave = np.cos(2 * np.pi * line * k / PERIOD + rng.uniform(0, 2 * np.pi))
        sent[:, inputs[n % len(inputs)]] += 0.8 * wave
    x, before, late = np.zeros(4), np.zeros(2), np.zeros(2)
    y, v = np.zeros((2, PERIOD * periods, 2))
    errors = noise * rng.standard_normal(y.shape)
    for j in range(len(y)):
        y[j] = x[:2] + errors[j]
        v[j] = -np.array([16e3, 14e3]) * y[j] - np.array([110.0, 150.0]) * (y[j] - before) / T
        v[j] += sent[j % PERIOD]
        x, before, late = Ad @ x + Bd @ late, y[j], v[j]
    assert np.abs(y).max() < 1e-2
    columns = {"y": y, "v": v, "excitation": np.tile(sent, (periods, 1))}
    forces = Signal("f1", "N"), Signal("f2", "N")
    signals = {"y": (Signal("a", "m"), Signal("b", "m")), "v": forces, "excitation": forces}
    return Log("hidden", "", "", T, PERIOD * T, T * np.arange(len(y)), columns, signals)


def true_response(w: Any) -> Any:
    """From commands to readings by the sampled matrices, the delay included: k x 2 x 2."""
    Ad, Bd = sampled()
    z = np.exp(1j * np.asarray(w) * T)[:, None, None]
    return (np.linalg.solve(z * np.eye(4) - Ad, Bd) / z)[:, :2]


def test_poles_delay_and_response_are_those_of_the_machine() -> None:
    found = malta.realize(record(0))
    assert found.order == 4
    assert found.gap > 20
    assert found.poles.real == pytest.approx(POLES, rel=1e-3)
    assert found.delay == pytest.approx(T, rel=0.1)
    w = 2 * np.pi * np.geomspace(2, 200, 30)
    assert np.abs(found.response(w) / true_response(w) - 1)[:, (0, 1), (0, 1)].max() < 0.02
    assert 0.4 < found.chi2 < 1.5
    model = malta.linearize(found.plant, found.plant.at())
    assert np.sort(np.linalg.eigvals(model.A).real) == pytest.approx(found.poles.real)
    assert model.A[:2] == pytest.approx(np.eye(4)[2:])  # positions, then their rates
    assert len(malta.realize(record(0, noise=0.0, periods=5)).plant.states) == 6  # the delay's too
    fresh = found.validate(record(1))
    assert fresh.refusal == ""
    assert min(fresh.fit.values()) > 99.5
    other = replace(record(1), columns={**record(1).columns, "v": 1.5 * record(1).columns["v"]})
    assert "beside noise, at most 20 % are asked" in found.validate(other).refusal


def test_feedback_of_noise_biases_nothing() -> None:
    """Of 24 logs with noise of 10 um, a tenth of the motion: mean errors within 3.5 of their deviations."""
    poles = [malta.realize(record(k, noise=1e-5), 4, delay=T).poles.real for k in range(24)]
    off = np.mean(poles, axis=0) - POLES
    deviation = np.std(poles, axis=0, ddof=1) / np.sqrt(len(poles))
    assert (np.abs(off) < 3.5 * deviation).all()
    assert (deviation < 1e-3 * np.abs(POLES)).all()  # so that a bias of 0.3 % fails


def test_logs_that_excite_an_input_each_are_taken_together() -> None:
    found = malta.realize([record(0, inputs=(0,)), record(1, inputs=(1,))])
    assert found.poles.real == pytest.approx(POLES, rel=1e-3)
    other = replace(record(0, periods=4), sample_time=2 * T, period=2 * T * PERIOD)
    with pytest.raises(malta.InputError, match="another sample time, expected those of hidden"):
        malta.realize([record(0, periods=4), other])


def test_a_log_that_stays_in_its_file_gives_the_same_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_log(record(0, periods=5), tmp_path / "log.npz")
    known = malta.realize(read_log(path))
    monkeypatch.setattr(log_files, "MOST_IN_MEMORY", 1000)
    monkeypatch.setattr(log_files, "SMALL_ARRAY", 100)
    long = read_log(path)
    assert isinstance(long.columns["y"], StoredTable)
    found = malta.realize(long)
    assert found.poles == pytest.approx(known.poles, rel=1e-6)
    assert found.delay == pytest.approx(known.delay, rel=1e-4)


def test_a_law_of_the_model_holds_the_machine() -> None:
    """Its loop by the machine's own equations, apart from malta's."""
    found = malta.realize(record(2))
    weights = malta.synthesis.weights(q=[1e6, 1e6, 0, 0], r=[1, 1], w=[1e-2] * 2, v=[1e-12] * 2)
    law = malta.lqg(found.plant, weights, Ts=T, delay=1)
    loop = malta.loop(found.plant, law)
    assert loop.stable
    assert (malta.robust_margin(loop, {"gain": 0.2}).lower or 0) > 1
    system = law_system(law)  # v = F y, and references
    Ad, Bd, C = *sampled(), np.eye(2, 4)
    F, G, H, J = system.A, system.B[:, :2], system.C, system.D[:, :2]
    n = len(F)
    closed = np.block(
        [
            [Ad, np.zeros((4, n)), Bd],
            [G @ C, F, np.zeros((n, 2))],
            [J @ C, H, np.zeros((2, 2))],  # the forces of the next sample
        ]
    )
    assert np.abs(np.linalg.eigvals(closed)).max() < 0.95


@pytest.mark.parametrize("dt", [None, T])
def test_responses_of_python_control(dt: float | None) -> None:
    import control

    w = np.geomspace(5, 2000, 40)
    Ad, Bd = sampled()
    s, F, G = (1j * w, A, B) if dt is None else (np.exp(1j * w * T), Ad, Bd)
    values = np.linalg.solve(s[:, None, None] * np.eye(4) - F, G)[:, :2]
    frd = control.frd(values.transpose(1, 2, 0), w, *([] if dt is None else [dt]))
    found = malta.realize(frd)
    assert (found.order, found.system.dt) == (4, dt)
    assert found.poles.real == pytest.approx(POLES, rel=1e-6)
    assert found.delay < 1e-9
    back = found.system.to_control()
    assert np.sort_complex(back.poles()) == pytest.approx(np.sort_complex(found.system.poles))


def test_an_order_without_a_gap_has_to_be_named() -> None:
    """Half an integrator has no number of states; three states with noise of 1 % have a gap."""
    w, rng = np.geomspace(1, 100, 30), np.random.default_rng(0)
    half = FrequencyResponse("G", w, (1j * w) ** -0.5)
    with pytest.raises(malta.CheckError, match="no gap that tells an order: name one"):
        malta.realize(half)
    assert malta.realize(half, 5).fit["y"] > 95
    three = 1 / (1j * w + 20) / ((1j * w) ** 2 + 2j * w + 900)
    found = malta.realize(FrequencyResponse("G", w, three * (1 + 0.01 * rng.standard_normal(30))))
    assert (found.order, found.gap > 10, found.fit["y"] > 98) == (3, True, True)


def test_what_tells_no_model_is_refused_in_a_sentence() -> None:
    log, w = record(0, periods=4), np.geomspace(1, 100, 10)
    line = FrequencyResponse("G", w, 1 / (1j * w + 5))
    none = {key: table for key, table in log.columns.items() if key != "excitation"}
    both = {**log.columns, "v": log.columns["v"][:, [0, 0]]}
    cases: tuple[tuple[Callable[[], Any], str], ...] = (
        (lambda: malta.realize(record), "source: found"),
        (lambda: malta.realize([]), "source: found"),
        (lambda: malta.realize(log, inputs="u"), "inputs: found no columns of 'u', expected v"),
        (lambda: malta.realize(log, inputs="i"), "inputs: found no columns of 'i'"),
        (lambda: malta.realize(log, 0), "order: found 0, expected 1 to"),
        (lambda: malta.realize(log, cast("Any", 2.5)), "order: found 2.5"),
        (lambda: malta.realize(log, 4, delay=-1.0), "delay: found -1.0, expected a time of 0 s or more"),
        (lambda: malta.realize(FrequencyResponse("G", w[:2], w[:2] + 0j)), "more lines than 2"),
        (lambda: malta.realize(FrequencyResponse("G", w, np.full(10, np.nan))), "expected finite values"),
        (lambda: malta.realize(FrequencyResponse("G", 0 * w, 1 / (1j * w + 5))), "at rising frequencies"),
        (lambda: malta.realize(FrequencyResponse("G", w, 1e300 / (1j * w + 5))), "expected finite values"),
        (lambda: malta.realize(FrequencyResponse("G", w, np.ones(9, dtype=complex))), "out of range"),
        (lambda: malta.realize(replace(log, columns={**log.columns, "y": 0 * log.columns["y"]})), "noise"),
        (lambda: malta.realize(log, 3).plant, "a pole at half the sampling rate: name another order"),
        (lambda: malta.realize(line).validate(log), "expected those of G"),
        (lambda: malta.realize(replace(log, columns=none)), "nothing was excited"),
        (lambda: malta.realize(replace(log, columns=both)), "do not move independently"),
        (lambda: malta.realize(FrequencyResponse("G", w, 0j * w)), "an output not at all"),
    )
    for refused, says in cases:
        with pytest.raises((malta.InputError, malta.CheckError), match=says) as found:
            refused()
        assert "\n" not in str(found.value)


def test_the_command_refuses_in_a_sentence(run: Run) -> None:
    for options, says in (
        (("--order", "many"), "--order: found 'many', expected a number of states, or auto"),
        (("--order", "4", "-p", "K_A"), "--order: found -p beside it"),
        (("--order", "4", "--record", "all"), "--order: found --record beside it"),
        (("--order", "4", "-o", "model.toml"), "model.toml: found suffix '.toml', expected .csv"),
    ):
        refused = run("identify", GAINS, "log.npz", *options)
        assert (refused.code, says in one_sentence(refused.err)) == (2, True)


@pytest.mark.slow
def test_the_command_prints_and_writes_a_model(tmp_path: Path, run: Run) -> None:
    """Of the tubular machine: its unstable poles by its linearization, and its response by the loop."""
    controller = malta.gains.read(GAINS)
    plant = malta.plant_of(controller.parameters)
    plan = malta.excite(malta.loop(plant, controller), period=0.5, periods=6, band=(4, 400))
    scenario = replace(malta.Scenario.excited(plan.signal, plan.duration), noise=1.0)
    logs = [
        write_log(log_of(malta.simulate(plant, controller, replace(scenario, seed=k))), tmp_path / f"{k}.npz")
        for k in (1, 2)
    ]
    out = tmp_path / "model.csv"
    options = ("--order", "auto", "--validate", logs[1], "-o", out)
    said = run("identify", GAINS, logs[0], *options)
    assert said.code == 0, said.err
    assert "10; singular values fall" in said.out
    found = json.loads(run("identify", GAINS, logs[0], *options, "--json").out)
    assert (found["order"], found["refusal"], min(found["fresh_fit"].values()) > 85) == (10, "", True)
    z = np.linalg.eigvals(np.array(found["A"])).astype(complex)
    poles = np.log(z).real / found["sample_time_s"]
    model = malta.linearize(plant, plant.at())
    stiff = np.sort(np.linalg.eigvals(model.A).real)[-4:]
    assert np.sort(poles)[-4:] == pytest.approx(stiff, rel=0.03)
    assert len(read_response(out, "P x1/fx_B1").w) == 60
    turned = run("identify", GAINS, logs[0], "--order", "3", "--validate", logs[1])
    assert turned.code == 1
    assert "beside noise" in one_sentence(turned.err)
