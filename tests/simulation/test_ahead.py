"""Commutation for the place where the currents will act: what it takes off a move, and what it leaves as it is."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pytest
from conftest import ROOT, refusal

import malta
from malta import gains
from malta.gains.encodings import content_sha256
from malta.gains.writing import document
from malta.loops.sampled_laws import machine_law
from malta.loops.sampled_loops import machine_loop
from malta.machines.planar import motions
from malta.model.fingerprint import fingerprint
from malta.model.plants import plant_of
from malta.simulation.engine.compiled import compiler
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Commutation
from malta.synthesis.feedforward import commutate_ahead
from malta.synthesis.linear_law import linear_law

if TYPE_CHECKING:
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant
    from malta.simulation.trajectory import Trajectory
    from malta.synthesis.controller import Controller

NAMES = ("planar", "planar_pid", "halbach", "halbach_pid", "halbach_late")
ANGLES = ("phi", "theta", "psi")


class Pair(NamedTuple):
    """A shipped controller, and the same with currents for the place where they will act."""

    plant: Plant
    model: LinearModel
    usual: Controller
    ahead: Controller


def pair(name: str) -> Pair:
    c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    plant = plant_of(c.parameters)
    model = malta.linearize(plant, plant.point(c.operating_point[0]))
    return Pair(plant, model, c, commutate_ahead(c, model))


@pytest.fixture(scope="module")
def pairs() -> dict[str, Pair]:
    return {name: pair(name) for name in NAMES}


def fly_steps(p: Pair, c: Controller) -> Trajectory:
    """The paper's steps of the planar motor, from (6, 4) mm."""
    moves: dict[str, Any] = {"place": motions.PLACE, "gap": 50e-6, "lift": 1e-3, "distance": 10e-3}
    wanted = motions.step_cases(p.plant, c, **moves)[0]
    return simulate(p.plant, c, wanted.scenario, engine="virtual machine")


def deviations(run: Trajectory) -> dict[str, float]:
    """The largest deviation of each output from the reference, um and urad."""
    error = 1e6 * np.abs(run.p - run.reference).max(axis=0)
    return dict(zip((s.name for s in run.plant.outputs), error.tolist(), strict=True))


# What it takes off


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planar", "planar_pid"])
def test_angles_of_the_step_are_those_of_the_hold_alone(pairs: dict[str, Pair], name: str) -> None:
    """phi 0.81 -> 0.009 urad, theta 0.18 -> 0.003, psi 0.14 -> 0.002: what is left is the hold of 200 us."""
    p = pairs[name]
    usual, ahead = (deviations(fly_steps(p, c)) for c in (p.usual, p.ahead))
    assert [usual[n] for n in ANGLES] == pytest.approx(
        {"planar": (0.806, 0.184, 0.138), "planar_pid": (0.876, 0.145, 0.085)}[name], rel=0.02
    )
    assert [ahead[n] for n in ANGLES] == pytest.approx(
        {"planar": (0.0089, 0.0028, 0.0018), "planar_pid": (0.0103, 0.0027, 0.0024)}[name], rel=0.1
    )
    assert ahead["x"] < 1e-5 < 1e-4 < usual["x"]
    assert ahead["y"] < usual["y"]
    assert ahead["z"] < 1.01 * usual["z"]


@pytest.mark.slow
@pytest.mark.parametrize("samples", [1.0, 2.0])
def test_half_a_sample_more_or_less_is_twenty_times_as_much(pairs: dict[str, Pair], samples: float) -> None:
    """The lead is a sample of computation and half a hold; nothing is tuned."""
    p = pairs["planar"]
    assert p.ahead.commutation is not None
    assert p.ahead.commutation.lead == pytest.approx(1.5 * p.usual.sample_time, rel=1e-12)
    other = Commutation(samples * p.usual.sample_time, p.ahead.commutation.pull)
    assert deviations(fly_steps(p, replace(p.ahead, commutation=other)))["phi"] > 20 * 0.0089


@pytest.mark.slow
def test_the_filter_has_to_know(pairs: dict[str, Pair]) -> None:
    """Without `pull` the filter takes the missing force for a disturbance: phi 0.11 urad, twelve times as much."""
    p = pairs["planar"]
    assert p.ahead.commutation is not None
    deaf = Commutation(p.ahead.commutation.lead, 0 * p.ahead.commutation.pull)
    assert deviations(fly_steps(p, replace(p.ahead, commutation=deaf)))["phi"] == pytest.approx(
        0.113, abs=0.01
    )


def test_what_a_ramp_takes_is_friction_alone(pairs: dict[str, Pair]) -> None:
    """Halbach: 38 or 96 N s/m against the spring of the held angle; ahead 9.42, and b is 9.41. Planar: 10.5 -> 0.04."""
    for name, usual in (("halbach", 38.43), ("halbach_late", 96.46), ("halbach_pid", 38.43)):
        assert pairs[name].usual.feedforward.speed[0, 0] == pytest.approx(usual, abs=0.01)
        assert pairs[name].ahead.feedforward.speed[0, 0] == pytest.approx(9.42, abs=0.01)
    assert np.abs(pairs["planar"].usual.feedforward.speed).max() == pytest.approx(10.5, abs=0.1)
    assert np.abs(pairs["planar"].ahead.feedforward.speed).max() < 0.05


def test_a_late_laser_turns_the_forces_less(pairs: dict[str, Pair]) -> None:
    """At 5 mm/s the angle of a reading is 82 ms old on average: the vertical force is off by 0.37 %, not by 0.79 %."""
    p = pairs["halbach_late"]
    off = []
    for c in (p.usual, p.ahead):
        run = malta.experiment("ramp", p.plant, c, speeds=(5e-3,), adc_noise=False, noise=0.0)
        (case,) = run.cases
        off.append(100 * case.merits[3].value)
        assert case.merits[0].value < 1e-6
    assert off == pytest.approx([0.79, 0.37], abs=0.03)


# What it leaves


@pytest.mark.parametrize("name", NAMES)
def test_the_loop_is_the_same(pairs: dict[str, Pair], name: str) -> None:
    """What margins are proven of: the reference's rate is not fed back."""
    p = pairs[name]
    for one, other in (
        (linear_law(p.usual), linear_law(p.ahead)),
        (machine_law(p.plant, p.usual), machine_law(p.plant, p.ahead)),
    ):
        for key in ("A", "C"):
            np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    loops = [machine_loop(p.model, c) for c in (p.usual, p.ahead)]
    np.testing.assert_array_equal(loops[0].closed, loops[1].closed)


@pytest.mark.slow_for("planar")
@pytest.mark.parametrize("name", ["planar", "halbach"])
def test_flights_at_rest_are_the_same(pairs: dict[str, Pair], name: str) -> None:
    """Noise and a force from outside, no bit changes: the loop that flies is the one that is proven."""
    p = pairs[name]
    hold = Scenario("hold", 60 * p.usual.sample_time, malta.references.hold, noise=1.0)
    pushed = replace(hold, fidelity="force", disturbance=partial(push, width=len(p.plant.disturbances)))
    one, other = (simulate(p.plant, c, pushed, engine="virtual machine") for c in (p.usual, p.ahead))
    assert np.ptp(one.p) > 0
    np.testing.assert_array_equal(one.x, other.x)
    np.testing.assert_array_equal(one.current, other.current)


def push(t: Any, width: int) -> Any:
    """0.1 N or N m on every axis from the tenth sample on."""
    return np.where(np.arange(len(t))[:, None] > 10, 0.1, 0.0) * np.ones(width)


@pytest.mark.slow  # two proofs
def test_the_margin_is_the_same(pairs: dict[str, Pair]) -> None:
    p, spec = pairs["halbach"], malta.read_design(ROOT / "design" / "halbach.toml")
    one, other = (malta.verify(p.model, c, spec.uncertainty) for c in (p.usual, p.ahead))
    assert one.robust is not None
    assert other.robust is not None
    assert one.robust.lower is not None  # a search by the clock ends where the clock says
    assert one.robust.lower == pytest.approx(other.robust.lower, rel=1e-3)


@pytest.mark.skipif(compiler() is None, reason="no C compiler")
def test_compiled_is_the_virtual_machine(pairs: dict[str, Pair]) -> None:
    p = pairs["halbach"]
    distance: dict[str, Any] = {"speeds": (20e-3,), "fidelity": "force", "noise": 0.0}
    flown = [
        malta.experiment("ramp", p.plant, p.ahead, engine=engine, **distance).run
        for engine in ("compiled", "virtual machine")
    ]
    np.testing.assert_allclose(flown[0].p, flown[1].p, rtol=0, atol=1e-12)


# Files


def design_file(tmp_path: Path, name: str, text: str) -> Path:
    """A shipped design with more text before it, beside its machine."""
    path = tmp_path / f"{name}.toml"
    shipped = (ROOT / "design" / f"{name}.toml").read_text(encoding="utf-8")
    path.write_text(text + shipped.replace('"../data/', f'"{(ROOT / "data").as_posix()}/'), encoding="utf-8")
    return path


@pytest.mark.parametrize("name", ["halbach", "planar_pid"])
def test_design_files_ask_for_it(tmp_path: Path, pairs: dict[str, Pair], name: str) -> None:
    """A word of the design file; what it says by default changes no older design."""
    p = pairs[name]
    spec = malta.read_design(design_file(tmp_path, name, 'commutation = "predicted"\n'))
    made = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    assert made.commutation is not None
    assert p.ahead.commutation is not None
    assert made.commutation.lead == p.ahead.commutation.lead
    np.testing.assert_allclose(made.commutation.pull, p.ahead.commutation.pull, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(made.K, p.usual.K, rtol=1e-6, atol=1e-6)
    usual = malta.read_design(design_file(tmp_path, name, 'commutation = "measured"\n'))
    assert usual.sha256 == p.usual.spec_sha256 != spec.sha256
    assert fingerprint(p.usual) != fingerprint(p.ahead)
    with refused(
        lambda: malta.read_design(design_file(tmp_path, name, 'commutation = "guessed"\n'))
    ) as error:
        assert error.field == "commutation"


def refused(call: Any) -> Any:
    """The InputError of a call, as a context."""
    from contextlib import nullcontext

    with pytest.raises(malta.InputError) as caught:
        call()
    return nullcontext(caught.value)


def test_a_machine_whose_currents_know_no_place_is_refused(tmp_path: Path) -> None:
    path = design_file(tmp_path, "table2", 'commutation = "predicted"\n')
    spec = malta.read_design(path)
    model = malta.linearize(spec.plant, spec.plant.at())
    error = refusal(lambda: malta.synthesize(spec, model), path)
    assert error.field == "commutation"
    assert "do not depend on where it is" in str(error)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".json", ".npz", ".mat"])
def test_gain_files_hold_it(tmp_path: Path, pairs: dict[str, Pair], suffix: str) -> None:
    """Version 2, with lead and pull; files without it keep version 1 and their bytes."""
    p, path = pairs["planar_pid"], tmp_path / f"ahead{suffix}"
    margins = malta.verify(p.model, p.ahead)
    gains.write(p.ahead, margins, path)
    back = gains.read(path)
    assert back.commutation is not None
    assert p.ahead.commutation is not None
    assert back.commutation.lead == p.ahead.commutation.lead
    np.testing.assert_array_equal(back.commutation.pull, p.ahead.commutation.pull)
    assert fingerprint(back) == fingerprint(p.ahead)
    content = document(p.ahead, margins)
    assert (content["version"], content["law"]["tracks"]) == (2, "states")
    usual = document(replace(p.usual, braking=np.zeros(0)), margins)
    assert usual["version"] == 1
    assert "commutation" not in usual


@pytest.mark.parametrize(
    ("damage", "field"),
    [
        (lambda d: d["commutation"].update(lead=0.0), "commutation.lead"),
        (lambda d: d["commutation"].update(pull=[[1.0]]), "commutation.pull"),
        (lambda d: d["commutation"].pop("pull"), "commutation.pull"),
        (lambda d: (d.pop("law"), d.update(version=1)), "commutation"),
    ],
)
def test_damaged_gain_files_are_refused(
    tmp_path: Path, pairs: dict[str, Pair], damage: Any, field: str
) -> None:
    p, path = pairs["planar_pid"], tmp_path / "ahead.json"
    content = document(p.ahead, malta.verify(p.model, p.ahead))
    damage(content)
    content["sha256"] = content_sha256(content)
    path.write_text(json.dumps(content), encoding="utf-8")
    assert refusal(lambda: gains.read(path), path).field == field
