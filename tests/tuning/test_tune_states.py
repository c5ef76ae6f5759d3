"""Tuning machines whose states are not (q, q'): quick figures are the verified ones, intervals of `over` count."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.linear.matrices import eigenvalues
from malta.loops.noise import noise_of
from malta.loops.sampled_loops import machine_loop
from malta.margins.verify import machine_report
from malta.model import Signal
from malta.report.figures.drawing import front_lines
from malta.synthesis.spec import Spec
from malta.tuning.groups import figures_of, groups_of
from malta.tuning.search import Effort
from malta.tuning.tune import problem_sha256
from malta.units import to_si

DESIGNS = ("magnet", "with_current")  # square, and with two outputs for one input
OVER = {"L_s": (0.01, 0.04)}


def spec_of(name: str, asked: dict[str, float], folder: Path = ROOT / "examples" / "magnet") -> Spec:
    return replace(malta.read_design(folder / "design" / f"{name}.toml"), specification=asked)


@pytest.fixture(scope="module")
def widened(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The magnet's folder, of a machine that is proven for any of these values of L_s."""
    folder = shutil.copytree(ROOT / "examples" / "magnet", tmp_path_factory.mktemp("over") / "magnet")
    text = (folder / "magnet.py").read_text(encoding="utf-8")
    with_over = text.replace("        actuator=", f"        over={OVER},\n        actuator=")
    (folder / "magnet.py").write_text(with_over, encoding="utf-8")
    return Path(folder)


def figures(spec: Spec) -> dict[str, float]:
    (group,) = groups_of(spec)
    return figures_of(spec, group, spec.weights, spec.delay)


@pytest.mark.parametrize("name", DESIGNS)
def test_quick_figures_are_those_of_verify(name: str) -> None:
    spec = spec_of(name, {"bandwidth": 10.0, "peak_sensitivity": 3.0, "motion y": 1e-5})
    found = figures(spec)
    model = malta.linearize(spec.plant, spec.plant.at())
    report = machine_report(model, malta.synthesize(spec, model))
    assert found["bandwidth"] == pytest.approx(min(report.bandwidth.values()), rel=1e-6)
    assert found["bandwidth"] > 1
    peaks = [value for key, value in report.peak_sensitivity.items() if key != "sigma_max"]
    assert found["peak_sensitivity"] == pytest.approx(max(peaks), rel=1e-3)


@pytest.mark.parametrize("name", DESIGNS)
def test_one_number_is_tuned(name: str) -> None:
    spec = spec_of(name, {"bandwidth": 10.0, "peak_sensitivity": 3.0})
    (entry,) = [f"bases.integral.{s.name}" for s in spec.plant.outputs[:1]]
    searched = malta.synthesis.spec.Variable("integral", (entry,), 0.5e-6, 1e-5, "m s")
    found = malta.tune(replace(spec, search=(searched,), delays=(1,)), effort=Effort(1, 3, 0))
    assert found.trial.figures["bandwidth"] > 1


def test_the_margin_of_a_trial_is_that_of_the_worst_value_of_its_intervals(widened: Path) -> None:
    """It is lost at a corner of the box with L_s at an end, by the eigenvalues of the machine's own loop."""
    alone = spec_of("magnet", {"margin": 1.0})
    spec = spec_of("magnet", {"margin": 1.0}, widened)
    found = figures(spec)["margin"]
    assert found < 0.99 * figures(alone)["margin"]
    law = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))

    def radius(t: float) -> float:
        sizes = []
        for signs in (
            np.array(np.meshgrid(*[(-1, 1)] * len(spec.uncertainty))).reshape(len(spec.uncertainty), -1).T
        ):
            for L_s in OVER["L_s"]:
                values = {
                    key: getattr(spec.parameters, key) * (1 + t * share * sign)
                    for (key, share), sign in zip(spec.uncertainty.items(), signs, strict=True)
                }
                plant = malta.plant_of(replace(spec.parameters, **values, L_s=L_s))
                closed = machine_loop(malta.linearize(plant, plant.at()), law).closed
                sizes.append(np.abs(eigenvalues(closed)).max())
        return float(max(sizes))

    assert radius(0.98 * found) < 1 < radius(1.02 * found)


@pytest.mark.parametrize("name", ["car", "spindle"])
def test_a_trial_sees_lag_and_dead_time_of_sensors(name: str) -> None:
    """Half a sample of dead time, and lags: peaks and motions of the outputs are those of the machine's own loop."""
    folder = ROOT / "tests" / "foreign" / name
    spec = malta.read_design(folder / "design" / f"{name}.toml")
    found, plant = figures(spec), spec.plant
    model = malta.linearize(plant, plant.at())
    law = malta.synthesize(spec, model)
    peaks = machine_report(model, law).stages[0].peak_sensitivity
    assert found["peak_sensitivity"] == pytest.approx(max(peaks[s.name] for s in plant.outputs), rel=1e-8)
    motion = noise_of(malta.loop(plant, law).sampled, plant).motion[0]
    assert found[f"motion {plant.outputs[0].name}"] == pytest.approx(float(motion), rel=1e-8)
    prompt = replace(spec, parameters=replace(spec.parameters, **({"T_s" if name == "car" else "T_f": 0.0})))
    assert figures(prompt)["peak_sensitivity"] < 0.999 * found["peak_sensitivity"]


def test_other_intervals_are_another_search(widened: Path) -> None:
    asked = {"margin": 1.0}
    assert problem_sha256(spec_of("magnet", asked)) != problem_sha256(spec_of("magnet", asked, widened))


@pytest.mark.parametrize(
    ("unit", "shown"), [("V", (1e3, "mV")), ("A", (1.0, "A")), ("m/s^2", (1.0, "m/s^2"))]
)
def test_the_front_shows_motions_of_any_unit(unit: str, shown: tuple[float, str]) -> None:
    """Its table and its picture: a search whose bound was in mV ended in a KeyError, with nothing written."""
    plant = spec_of("with_current", {}).plant
    plant = replace(plant, outputs=(plant.outputs[0], Signal("i_y", unit)))
    assert front_lines(plant, ["motion i_y"], "motion") == [("motion i_y", "i_y", *shown)]


@pytest.mark.parametrize(("unit", "turns"), [("Hz", "turn/s"), ("kHz", "kturn/s")])
def test_a_frequency_without_its_angle_is_answered_with_turns(unit: str, turns: str) -> None:
    with pytest.raises(malta.InputError, match=f"found '{unit}', expected a unit of rad/s, as {turns}$"):
        to_si(1.0, unit, "rad/s", "design.toml", "bandwidth")
    assert to_si(1.0, turns, "rad/s", "", "") == pytest.approx(2 * np.pi * (1e3 if unit == "kHz" else 1))
