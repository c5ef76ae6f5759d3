"""Every command with its defaults on every shipped design: it ends with exit code 0, and with figures that hold."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from conftest import ROOT, Run, one_sentence

import malta
from malta.identification import measure as measuring
from malta.identification.commission import general_steps, steps_of
from malta.identification.excite import default_band, output_bands
from malta.identification.learn import own_stroke
from malta.identification.log import log_of
from malta.identification.log_files import read_log
from malta.identification.prediction import current_shares
from malta.identification.response import Flow
from malta.identification.strokes import stroke_of

pytestmark = pytest.mark.usefixtures("proven_once")

GAINS = sorted((ROOT / "design" / "gains").glob("*.json"))
EXAMPLES = sorted((ROOT / "examples").glob("*/design/*.toml"))
DESIGNS = {path.stem: path for path in (*GAINS, *EXAMPLES)}
# Without machines under a law that another has too, for what takes long: weights alone take no other way.
KINDS = [name for name in DESIGNS if name not in ("table2", "calibrated_slow", "halbach_calm")]
FAR = 2.0  # halves of a 95 % interval: once in ten thousand intervals by chance
NOISY = 4.0  # standard deviations


def some_fast(*fast: str) -> list[Any]:
    """All designs: those that are named in the fast tests, the others in the slow ones."""
    return [pytest.param(name, marks=[] if name in fast else [pytest.mark.slow]) for name in DESIGNS]


class Shipped(NamedTuple):
    """A shipped design: its gain file, and the options that name its machine."""

    gains: Path
    machine: tuple[str, ...]

    @property
    def controller(self) -> Any:
        return malta.gains.read(self.gains)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("shipped")


@cache
def _shipped(name: str, folder: Path) -> Shipped:
    """The gain file as it is shipped; of an example, which ships its design, a new one without a proof."""
    path = DESIGNS[name]
    if path.suffix == ".json":
        return Shipped(path, ())
    spec = malta.read_design(path)
    model = malta.linearize(spec.plant, spec.plant.at())
    controller = malta.synthesize(spec, model)
    made = folder / f"{name}.json"
    malta.gains.write(controller, malta.verify(model, controller), made)
    example = path.parents[1]
    return Shipped(made, ("--machine", str(example / f"{example.name}.py")))


@pytest.fixture
def shipped(folder: Path) -> Any:
    return lambda name: _shipped(name, folder)


@pytest.mark.parametrize("name", some_fast("halbach_pid", "ball"))
def test_an_excitation_follows_the_band_and_the_samples(name: str, shipped: Any) -> None:
    """Within a quarter of the sampling rate, over the band of every output, with commands within half of the limits."""
    controller = shipped(name).controller
    loop = malta.loop(malta.plant_of(controller.parameters), controller)
    bands, (low, high) = output_bands(loop), default_band(loop)
    assert low <= bands.min() / 2
    assert high <= 0.25 / controller.sample_time
    assert 0.8 * bands.max() <= high * 1.001 <= 10 * bands.max() or math.isclose(
        high, 0.25 / loop.sample_time
    )
    plan = malta.excite(loop)
    assert 2 / low <= plan.signal.period * 1.001
    assert len(plan.signal.lines) == 12 * len(loop.plant.inputs)
    assert max(plan.command.values()) <= 0.5 + 1e-9


@pytest.mark.parametrize(("Ts", "high"), [(20e-6, 400.0), (1e-3, 250.0), (10e-3, 25.0)])
def test_a_machine_of_any_sample_time_has_an_excitation(Ts: float, high: float) -> None:
    """A cart under an LQG of some 100 Hz, slower where samples are: at most a quarter of their rate is excited."""
    w = min(0.3 / Ts, 2 * math.pi * 100)
    cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], noise=(1e-7,))
    weights = malta.synthesis.weights(q=[w**4, 0], r=[1], w=[w**4 * 1e-8], v=[1e-8])
    law = malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=Ts)
    low, found = default_band(malta.loop(cart, law))
    assert found == pytest.approx(high, rel=0.01)
    assert low <= found / 200


@pytest.mark.parametrize("name", some_fast("halbach", "halbach_late", "robust")[: len(GAINS)])
def test_a_stroke_follows_the_thrust_the_samples_and_the_band(name: str, shipped: Any) -> None:
    """Its acceleration takes 5 to 25 % of the thrust's limit, which `malta learn` asks for, or it is the machine's."""
    controller = shipped(name).controller
    plant = malta.plant_of(controller.parameters)
    scenario = stroke_of(plant, controller)
    t = controller.sample_time * np.arange(scenario.samples(controller.sample_time))
    motion = scenario.reference(plant)(t)
    most = np.abs(motion.ddp[:, plant.stroke_output]).max() * plant.stroke.mass
    share = most / controller.limits.force[plant.thrust_input]
    assert 0.05 < share < (0.6 if plant.name == "tubular" else 0.2501)
    moving = np.abs(motion.dp[:, plant.stroke_output]) > 1e-6 * np.abs(motion.dp).max()
    assert moving.sum() >= 20


@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize("lag", [0.01, 1.0, 30.0])
def test_shares_of_a_current_have_its_moments(steps: int, lag: float) -> None:
    """By quadrature: a double integrator that RK4 moves by these shares ends where the lagging current moves it."""
    f = current_shares(Flow(lag, 0.0, 1.0), steps)[:-1].reshape(steps, 3)
    s = (np.arange(200_000) + 0.5) / 200_000
    share = (1 - np.exp(-lag * s)) / (1 - np.exp(-lag))
    speed = f @ [1 / 6, 4 / 6, 1 / 6] / steps
    place = (f @ [1 / 6, 2 / 6, 0] / steps**2).sum() + (np.cumsum(speed) - speed).sum() / steps
    assert speed.sum() == pytest.approx(share.mean(), rel=1e-6)
    assert place == pytest.approx(((1 - s) * share).mean(), rel=1e-6)


def test_shares_go_from_held_to_even() -> None:
    assert not current_shares(Flow(math.inf, 0.0, 1.0), 2).any()
    assert current_shares(Flow(0.0, 0.0, 1.0), 1) == pytest.approx([0.0, 0.5, 1.0, 0.5])
    assert current_shares(Flow(2e-3, 0.0, 1.0), 1) == pytest.approx([0.0, 0.5, 1.0, 0.5], abs=1e-3)


@pytest.mark.parametrize("name", DESIGNS)
def test_every_machine_has_a_checklist(name: str, shipped: Any, run: Run) -> None:
    one = shipped(name)
    plant = malta.plant_of(one.controller.parameters)
    listed = run("commission", one.gains, *one.machine, "--plan")
    assert listed.code == 0
    names = [step.name for step in steps_of(plant, {})]
    assert all(f" {name} " in listed.out for name in names)
    assert {"noise", "loop"} < set(names)
    assert ("stroke" in names) == plant.has_stroke
    assert [step.name for step in general_steps(plant, {})][:2] == ["still", "noise"]


@pytest.fixture
def few_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tubes of `measure` by four machines in the box: their width is another test's."""
    monkeypatch.setattr(measuring, "SAMPLES", 4)
    monkeypatch.setattr(measuring, "CORNERS", 0)


@pytest.mark.slow
@pytest.mark.usefixtures("few_machines")
@pytest.mark.parametrize("name", KINDS)
def test_the_bench_of_every_machine(name: str, shipped: Any, run: Run, tmp_path: Path) -> None:
    """excite, log, identify, replay and measure on their defaults: a machine is found in its own log."""
    one, log = shipped(name), tmp_path / "excited.npz"
    assert run("excite", one.gains, *one.machine, "--log", log).code == 0
    looked = run("log", log, "--json")
    survey = json.loads(looked.out)
    assert (looked.code, survey["findings"]) == (0, [])
    assert survey["samples"] >= 11 * 12  # periods of at least as many samples as lines
    said = run("identify", one.gains, log, *one.machine, "--json")
    assert (said.code, said.err) == (0, "")
    found = json.loads(said.out)
    assert 1 - 5 * math.sqrt(2 / found["dof"]) < found["chi2_per_dof"] < found["chi2_limit"]
    par = one.controller.parameters
    for parameter, told in found["parameters"].items():
        true = float(getattr(par, parameter))
        assert abs(told["value"] - true) < FAR * (told["high"] - told["low"]) / 2 + 3e-5 * abs(true), (
            parameter
        )
    assert run("replay", one.gains, log, *one.machine).code == 0
    measured = run("measure", one.gains, log, *one.machine, "--json")
    assert measured.code == 0
    assert run("measure", one.gains, *one.machine, "--plan").code == 0


@pytest.mark.slow
@pytest.mark.usefixtures("few_machines")
@pytest.mark.parametrize("name", KINDS)
def test_the_first_day_of_every_machine(name: str, shipped: Any, run: Run, tmp_path: Path) -> None:
    """commission, then learn from its stroke: the gain file's own machine passes, with the thrust that is expected."""
    one = shipped(name)
    said = run("commission", one.gains, *one.machine, "--out", tmp_path, "--json")
    document = json.loads(said.out)
    assert (said.code, document["passed"], document["left"]) == (0, True, [])
    controller = one.controller
    plant = malta.plant_of(controller.parameters)
    findings = {f["name"]: f for step in document["steps"] for f in step["findings"]}
    for signal, noise, step in zip(plant.outputs, plant.sensors.noise, plant.sensors.resolution, strict=True):
        measured = findings[f"noise of {signal.name}"]
        least = noise / (1.05 if plant.sensors.uniform else 1.0) - 2 * measured["half"]
        assert least <= measured["value"] <= 1.5 * math.hypot(noise, step)
    if not plant.has_stroke:
        refused = run("learn", one.gains, tmp_path / "loop.npz", *one.machine)
        assert refused.code == 2
        assert "no stroke" in one_sentence(refused.err)
        return
    learned = run("learn", one.gains, tmp_path / "stroke.npz", "--json")
    told = json.loads(learned.out)
    assert learned.code == 0
    assert abs(told["factor"] - 1) < NOISY * told["deviation"] + 2e-3
    assert told["parameter"] == {"tubular": "K_D", "halbach": "A", "planar": ""}[plant.name]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["halbach", "planar"])
def test_a_weak_drive_is_told_whatever_holds_the_machine(name: str, shipped: Any) -> None:
    """A 5 % weaker force constant takes 1 / 0.95 of the thrust, where held currents pull like a spring too."""
    controller = shipped(name).controller
    plant = malta.plant_of(controller.parameters)
    constant = {"halbach": "A", "planar": "B_r"}[name]
    weak: Any = replace(controller.parameters, **{constant: 0.95 * getattr(controller.parameters, constant)})
    log = log_of(malta.simulate(malta.plant_of(weak), controller, stroke_of(plant, controller)))
    found = malta.learn(controller, log)
    assert found.factor == pytest.approx(1 / 0.95, abs=5e-3)
    own = log_of(malta.simulate(plant, controller, stroke_of(plant, controller).replace(settle=0.0)))
    error = np.abs(own_stroke(controller, own).columns["y"] - own.columns["y"]).max()
    assert error < 1e-3 * plant.stroke.travel


@pytest.mark.slow
@pytest.mark.parametrize("name", DESIGNS)
def test_a_log_of_the_main_job_is_replayed(name: str, shipped: Any, run: Run, tmp_path: Path) -> None:
    """simulate --log, log and replay: the commands are those of the law, which innovations of a run without noise fit.

    The steps of the planar motor have corners, at which derivatives of samples are not those that the law was given:
    another law, says replay. Those of the Halbach motor fly with the noise of its current sensors, which the machine of
    the gain file has none of where replay flies it.
    """
    one, log = shipped(name), tmp_path / "run.npz"
    assert run("simulate", one.gains, *one.machine, "--log", log, "--out", tmp_path).code == 0
    assert run("log", log).code == 0
    assert read_log(log).samples > 20
    replayed = run("replay", one.gains, log, *one.machine)
    said = {"planar": "another law", "halbach": "times that of the gain file's machine"}
    machine = malta.plant_of(one.controller.parameters).name
    if replayed.code:
        assert said[machine] in one_sentence(replayed.err)
    else:
        assert machine != "planar"


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_what_is_drawn_compared_and_exported_of_every_machine(
    name: str, shipped: Any, run: Run, tmp_path: Path
) -> None:
    """plot, compare, export and campaign: a picture, no figure that differs from itself, C, and whole machines."""
    one = shipped(name)
    assert run("plot", one.gains, "bode", *one.machine, "--out", tmp_path).code == 0
    assert len(list(tmp_path.glob("*bode*"))) == 1
    assert run("compare", one.gains, one.gains, *one.machine).code == 0
    assert run("export", one.gains, *one.machine, "--no-proof", "--out", tmp_path / "c").code == 0
    assert any(path.suffix == ".c" for path in (tmp_path / "c").rglob("*"))
    if name in {path.stem for path in GAINS}:  # the others were written without their uncertainty
        flown = run("campaign", one.gains, "--samples", "8", "--spread", "1%", "--out", tmp_path / "runs")
        assert (flown.code, "8 of 8 machines" in " ".join(flown.out.split())) == (0, True)
