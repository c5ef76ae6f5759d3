"""Machines that malta was not written for go through every command, as their owners would type them.

None of them has states (q, q'). They have sensors in volts, one of them bent, flux and acceleration among the outputs,
an integrator and no position, more sensors than actuators and the reverse, inputs of unlike units, and sensors that
read late.
"""

from __future__ import annotations

import json
import pickle
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, Run, forget_machines, one_sentence, printed

import malta
from malta.app.session import Session
from malta.firmware.agreement import require_same_law
from malta.firmware.fmu import build_fmu
from malta.firmware.signals import Target
from malta.firmware.supervisor import bounds_of, monitors_of
from malta.firmware.supervisor_text import supervisor_sources
from malta.identification.commission import general_steps
from malta.identification.excite import cut_loop, model_at
from malta.loops.curves import loop_curves
from malta.margins.verify import machine_report
from malta.model.places import holdable_outputs
from malta.model.sensors import Sensors
from malta.simulation.experiments.catalogue import default_step

HERE = ROOT / "tests" / "foreign"
NAMES = ("car", "disk", "flywheel", "hybrid", "maglev", "spindle")
SENSORS = {"car": 3, "disk": 1, "flywheel": 2, "hybrid": 3, "maglev": 3, "spindle": 2}


@cache
def _law(name: str) -> Any:
    spec = malta.read_design(HERE / name / "design" / f"{name}.toml")
    return spec, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Where all six are, with gain files without a proof."""
    shutil.copytree(HERE, tmp_path / "own", ignore=shutil.ignore_patterns("__pycache__", "*.pyc"))
    monkeypatch.chdir(tmp_path / "own")
    yield tmp_path / "own"
    forget_machines()
    _law.cache_clear()  # its machines are those of modules that are forgotten


def _gains(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a machine is where its owner is; its gain file."""
    monkeypatch.chdir(folder / name)
    monkeypatch.setenv("MALTA_MACHINE", f"{name}.py")
    spec = malta.read_design(f"design/{name}.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    law = malta.synthesize(spec, model)
    file = Path("design") / "gains" / f"{name}.json"
    file.parent.mkdir(exist_ok=True)
    malta.gains.write(law, malta.verify(model, law), file)
    return file


@pytest.mark.parametrize("name", NAMES)
def test_a_machine_is_inspected_and_its_export_is_its_law(name: str) -> None:
    """No pairs (q, q'), nothing to change, and C that makes the same over the whole ranges of the readings."""
    spec, law = _law(name)
    plant = spec.plant
    assert not plant.second_order
    assert (len(plant.outputs), law.K.shape[0]) == (SENSORS[name], len(plant.inputs))
    assert malta.inspect(plant).proves
    assert malta.loop(plant, law).stable
    require_same_law(Target(law, "double", "force"))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_is_flown_exported_and_its_c_tests_itself(
    name: str, folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    gains = _gains(name, folder, monkeypatch)
    for scenario in ("hold", "step"):
        assert run("simulate", gains, "--scenario", scenario, "--out", "build").code == 0
    spread = f"{next(iter(_law(name)[0].uncertainty))}=2%"
    flown = run(
        "campaign", gains, "--samples", "8", "--spread", spread, "--scenario", "step", "--out", "runs"
    )
    assert (flown.code, "8 of 8 machines" in " ".join(flown.out.split())) == (0, True)
    compared = run("simulate", gains, "--scenario", "step", "--controller", "c", "--json")
    assert compared.code == 0
    double, *_ = json.loads(compared.out)["exported"]
    assert all(s["largest"] < 1e-11 * s["range"] for s in double["signals"].values() if s["range"])
    for precision in ("double", "float"):
        out = folder / precision
        assert run("export", gains, "--no-proof", "--precision", precision, "--out", out).code == 0
        made = subprocess.run(
            ["make", "-s", "-C", out, "test", "CFLAGS=-O2 -Werror -Wall -Wextra -ffp-contract=off"],
            capture_output=True,
            text=True,
            check=False,
        )
        assert made.returncode == 0, made.stdout + made.stderr
    for part in ("controller", "machine", "loop"):
        assert run("export", gains, "--to", "fmu", "--part", part, "--out", f"{part}.fmu").code == 0


@pytest.mark.parametrize("name", NAMES)
def test_its_fmu_flies_as_it_is_simulated(name: str, tmp_path: Path) -> None:
    """Machine and law as one FMU, in another program, under a load that steps: the outputs of `simulate`."""
    fmpy = pytest.importorskip("fmpy")
    spec, law = _law.__wrapped__(name)  # anew: other tests forget the machines of their folders
    plant = spec.plant
    pushed = malta.experiment("disturbance", plant, law, noise=0.0, quantize=False)
    halved = {"disk": " of 80 mN", "flywheel": " of 300 mN m", "hybrid": " of 600 mN"}  # of the way to a stop
    assert pushed.cases[0].label == plant.disturbances[0].name + halved.get(name, "")
    run = pushed.run
    push = run.scenario.disturbance
    assert push is not None
    assert run.verdict.completed
    n = min(len(run.t), 400)
    motion, w = run.scenario.reference(plant)(run.t), push(run.t)
    columns = [("time", run.t[:n]), *((f"w.{s.name}", w[:n, k]) for k, s in enumerate(plant.disturbances))]
    for kind in ("p", "dp", "ddp"):
        columns += [
            (f"{kind}_ref.{s.name}", getattr(motion, kind)[:n, k]) for k, s in enumerate(plant.outputs)
        ]
    signals = np.array(
        list(zip(*(c for _, c in columns), strict=True)), [(label, float) for label, _ in columns]
    )
    path = tmp_path / "loop.fmu"
    path.write_bytes(build_fmu(Target(law, "double", "force"), "5" * 64, part="loop", fmi=2).content)
    names = [f"p.{s.name}" for s in plant.outputs]
    found = fmpy.simulate_fmu(
        str(path), stop_time=run.t[n - 1], output_interval=law.sample_time, input=signals, output=names
    )
    assert len(found) == n
    for k, column in enumerate(names):
        np.testing.assert_allclose(
            found[column], run.p[:n, k], rtol=0, atol=1e-10 * np.abs(run.p[:n, k]).max()
        )


@pytest.mark.slow
def test_each_case_of_a_table_stands_in_its_unit() -> None:
    """A step of a temperature in K, and one of a reading of milliamperes: nothing is 0 but what is."""
    spec, law = _law("hybrid")
    text = printed(malta.report.experiment_table(malta.experiment("step", spec.plant, law, time=0.2)))
    assert [line.split()[-1] for line in text.splitlines() if "left at the end [mA]" in line] != ["0"]
    assert "left at the end [mK]" in text
    held = malta.experiment("hold", spec.plant, law, time=0.2)
    (row,) = [
        line for line in printed(malta.report.experiment_table(held)).splitlines() if "y_q, rms" in line
    ]
    assert "y_q, rms [mA]" in row
    assert 0 < float(row.split()[-1]) < 5e-3


@pytest.mark.slow
def test_a_supervisor_lands_by_what_tells_a_place() -> None:
    """Temperature and flux meet nothing: where the gap is lost, they do not say that the machine has landed."""
    _, law = _law("hybrid")
    t = Target(law, "double", "force")
    samples = {row.reaction: row.samples for row in monitors_of(t) if row.key == "UNBELIEVED"}
    assert samples["HOLD"] < samples["LAND"] == bounds_of(t).unbelieved == 9
    text = supervisor_sources(t, "law")["law_supervisor.c"]
    assert "there = (near_touch[k] < 1e+17) ? 1 : there;" in text


def test_gains_between_unlike_units_are_not_compared() -> None:
    """The largest |S P| and |F S| of a sensor are those of the inputs whose unit stands beside them."""
    spec, law = _law("hybrid")
    loop = malta.loop(spec.plant, law)
    r = loop_curves(spec.plant, law).responses
    for k, found in enumerate(loop.classical.gang.values()):
        own = min(k, 1)  # V, then W
        assert found[2] == pytest.approx(np.abs(r.SP[:, k, own]).max(), rel=1e-3)
        assert found[3] == pytest.approx(np.abs(r.FS[:, own, k]).max(), rel=1e-3)


def test_the_first_day_is_within_the_limits_of_its_coils() -> None:
    """A valve of 40 mA does not take 1 A."""
    spec, _ = _law("hybrid")
    small = replace(spec.plant, actuator=replace(spec.plant.actuator, current_limit=0.04))
    (noise,) = [step for step in general_steps(small, {}) if step.name == "noise"]
    assert (noise.needs, noise.aborts) == ("mover out or clamped, 4 mV dc in each coil", "more than 8 mV")


@pytest.mark.slow
def test_a_motion_is_one_of_outputs_that_move(
    folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a car the deflection, not its accelerations; volts where all are volts; temperatures are none."""
    spec, law = _law("car")
    plan = malta.excite(malta.loop(spec.plant, law), motion=1e-3)
    assert plan.motion["y_d"] == pytest.approx(1e-3, rel=1e-3)
    spec, law = _law("hybrid")
    with pytest.raises(malta.InputError, match="outputs in K, T, A, expected outputs in m or rad"):
        malta.excite(malta.loop(spec.plant, law), motion=1e-3)
    gains = _gains("spindle", folder, monkeypatch)
    assert run("excite", gains, "--motion", "20mV", "--json").code == 0
    assert "expected a unit of V" in run("excite", gains, "--motion", "20um").err
    planned = run("measure", gains, "--plan", "--motion", "0.02V")
    assert (planned.code, " --motion 20mV --log" in planned.out) == (0, True)
    assert "expected a unit of V" in run("measure", gains, "--plan", "--motion", "20um").err


def test_a_motion_that_no_command_reaches_ends_at_the_limits() -> None:
    """A valve of 10 V is not asked for more: what is cut off is none of the linear loop's."""
    spec, law = _law("car")
    assert max(malta.excite(malta.loop(spec.plant, law), motion=10.0).command.values()) < 1.0 + 1e-6


@pytest.mark.parametrize(("name", "box"), [("car", {"m_s": 0.2}), ("spindle", {"C": 0.1})])
def test_a_margin_of_system_and_law_is_that_of_the_loop_with_its_late_sensors(
    name: str, box: dict[str, float]
) -> None:
    spec, law = _law(name)
    whole = malta.robust_margin(malta.loop(spec.plant, law), box)
    pair = malta.robust_margin(malta.uncertain(spec.plant, [*box]), law, box)
    assert whole.lower is not None
    assert pair.lower == pytest.approx(whole.lower, rel=2e-3)


def test_curves_and_loops_that_were_looked_at_are_pickled() -> None:
    """As they are handed to other processes."""
    spec, law = _law("disk")
    curves, loop = malta.loops.loop_curves(spec.plant, law), malta.loop(spec.plant, law)
    assert loop.classical.gang
    again, _ = pickle.loads(pickle.dumps((curves, loop)))
    assert np.array_equal(again.responses.S, curves.responses.S)


def test_a_law_of_another_machine_is_refused() -> None:
    """Readings and commands of a law are those of the machine, wherever both are given."""
    plant, law = _law("car")[0].plant, _law("maglev")[1]
    said = "found one of y_G y_B a, expected one of the car, y_d a_s a_u"
    for asked in (
        lambda: malta.verify(plant, law),
        lambda: malta.verify(malta.linearize(plant, plant.at()), law),
        lambda: malta.loops.loop_curves(plant, law),
    ):
        with pytest.raises(malta.InputError, match=said):
            asked()


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_is_found_in_its_own_log(
    name: str, folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """excite, log, identify, replay and measure: within 95 % intervals, doubled, and at the noise that is declared."""
    gains = _gains(name, folder, monkeypatch)
    assert run("excite", gains, "--log", "log.npz").code == 0
    assert run("log", "log.npz").code == 0
    said = run("identify", gains, "log.npz", "--json")
    assert (said.code, said.err) == (0, "")
    found = json.loads(said.out)
    assert found["chi2_per_dof"] < found["chi2_limit"]
    par = malta.gains.read(gains).parameters
    for parameter, told in found["parameters"].items():
        true = float(getattr(par, parameter))
        assert abs(told["value"] - true) < told["high"] - told["low"], parameter
    assert run("replay", gains, "log.npz").code == 0
    assert run("measure", gains, "log.npz", "--out", "measured.png").code == 0
    assert run("measure", gains, "--plan").code == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_it_is_designed_judged_tuned_and_reported(
    name: str, folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder / name)
    monkeypatch.setenv("MALTA_MACHINE", f"{name}.py")
    assert run("inspect", f"{name}.py").code == 0
    assert run("design").code == 0
    gains = Path("design") / "gains" / f"{name}.json"
    assert run("verify", gains, "--no-worst-case").code == 0
    tuned = run("tune", f"design/{name}.toml", "--generations", "1", "--front", "0", "--out", "build/tuned")
    assert (tuned.code in (0, 1), (Path("build/tuned") / f"{name}.toml").exists()) == (True, True)
    assert run("plot", gains, "bode", "sigma", "step", "load", "--out", "build").code == 0
    assert run("compare", gains, gains).code == 0
    assert run("report", gains, "--out", "build/report.html").code == 0
    assert run("commission", gains, "--plan").code == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_the_page_of_it_answers(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder / name)
    session = Session(folder / name / "design" / f"{name}.toml", folder)
    for worker in session._workers.values():
        worker.close()
    opened = session.answer({"ask": "open"})
    assert opened["fields"]
    found = session.answer({"ask": "evaluate", "number": 1, "values": {}})
    found |= session.answer({"ask": "rest", "number": 1}) if found.get("missing") else {}
    assert found["stable"]
    assert len(found["frequency"]["S"]) == SENSORS[name]


@pytest.mark.slow
def test_a_double_integrator_with_place_and_speed_tests_its_own_export(tmp_path: Path, run: Run) -> None:
    """Two outputs for one force, and no sums of errors: the speed is no reference's while the place moves."""
    cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0], [0, 1]], noise=(1e-6, 1e-6), limit=10)
    model = malta.linearize(cart, cart.at())
    law = malta.lqg(model, malta.synthesis.weights(q=[1e4, 0], r=[1], w=[1], v=[1e-8, 1e-8]), Ts=1e-3)
    malta.gains.write(law, malta.verify(model, law), tmp_path / "law.json")
    assert run("export", tmp_path / "law.json", "--no-proof", "--out", tmp_path / "c").code == 0
    made = subprocess.run(
        ["make", "-s", "-C", tmp_path / "c", "test"], capture_output=True, text=True, check=False
    )
    assert (made.returncode, "pass: " in made.stdout) == (0, True), made.stdout


def test_an_accelerometer_beside_an_ideal_actuator_is_one_sentence() -> None:
    """h with a part of the command: what the design and its proof do not have is said, and how to model it."""
    spec, _ = _law("car")
    plant = spec.plant
    direct = replace(plant, h=lambda x, u: plant.h(x, u) + u[0], sensors=Sensors())
    with pytest.raises((malta.InputError, malta.CheckError)) as refused:
        malta.linearize(direct, direct.at())
    assert "\n" not in str(refused.value)
    assert "h" in str(refused.value)


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.9])
def test_a_sensor_that_reads_within_a_sample_is_identified_as_it_is_simulated(share: float) -> None:
    """Dead times of no whole samples, of commands and of readings: the response is that of the loop that is flown."""
    spec, _ = _law("car")
    Ts = spec.sample_time
    par: Any = spec.parameters
    late = malta.plant_of(replace(par, T_s=share * Ts, T_d=(0.5 + share) * Ts))
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    loop = malta.loop(late, law)
    w = 2 * np.pi * np.array([0.7, 3.0, 20.0, 111.0])
    commands = cut_loop(loop, w).P  # from the law's command to its reading
    found = model_at(loop, ("k_s",)).response(model_at(loop, ("k_s",)).start, w)
    # The current at a sample is the command of the sample before, since the delay is less than one.
    delayed = found * np.exp(-1j * w * Ts)[:, None, None]
    np.testing.assert_allclose(delayed, commands, rtol=1e-6, atol=1e-9 * np.abs(commands).max())


@pytest.mark.parametrize("name", ["car", "maglev"])
def test_singular_values_are_those_of_readings_in_their_noise(name: str) -> None:
    """Against the sensitivity at the peak, scaled by hand; no bandwidth is at half of the sampling rate."""
    spec, law = _law(name)
    model = malta.linearize(spec.plant, spec.plant.at())
    report = machine_report(model, law)
    (stage,) = report.stages
    S = malta.loop(spec.plant, law).sampled.sensitivity(np.array([stage.peak_frequency]))[0]
    noise = spec.plant.sensors.deviations
    largest = np.linalg.svd(S * noise / noise[:, None], compute_uv=False)[0]
    assert stage.peak_sensitivity["sigma_max"] == pytest.approx(largest, rel=1e-3)
    assert largest < 20
    assert report.bandwidth["sigma_max_T"] < 0.5 * np.pi / spec.sample_time


def test_what_no_constant_holds_is_not_stepped(
    run: Run, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flux and acceleration at rest are what they are; a step is within what its sensor reads."""
    held = {name: [_law(name)[0].plant.outputs[k].name for k in _held(name)] for name in NAMES}
    assert held == {
        "car": ["y_d"],
        "disk": ["y"],
        "flywheel": ["y_w"],
        "hybrid": ["y_T", "y_q"],
        "maglev": ["y_G"],
        "spindle": ["s_A", "s_B"],
    }
    assert default_step(_law("disk")[0].plant, 0) == pytest.approx(0.5)  # V, of 5 V; the clearance is 1000 V
    gains = _gains("maglev", folder, monkeypatch)
    refused = run("simulate", gains, "--scenario", "step", "--option", "output=a")
    assert refused.code == 2
    assert "a, which no constant holds at rest, expected all, or one of y_G" in one_sentence(refused.err)
    pushed = run("simulate", gains, "--scenario", "disturbance", "--option", "on=w")
    assert pushed.code == 0
    assert all(f"{output} moves by" in pushed.out for output in ("y_G", "y_B", "a"))


def _held(name: str) -> tuple[int, ...]:
    return holdable_outputs(_law(name)[0].plant)
