"""A machine of one's own: its experiments, words, units and figures, found by its name."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import refusal

import malta
from malta import report
from malta.campaigns.result import bounds_of
from malta.margins.travel import NO_EXTENT
from malta.model import machines
from malta.model.parts import parts_of, require_part
from malta.model.plant import Signal
from malta.model.signal_groups import inputs_of, lateral_outputs, outputs_of, stroke_unit
from malta.report import figures
from malta.simulation.experiments import Case, Experiment, Merit, PlannedRun, fly, scenario_of
from malta.simulation.experiments.catalogue import cases_of, main_job, options_of
from malta.simulation.references import hold

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Design

    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller


def rest(
    plant: Plant,
    controller: Controller,
    *,
    wait: float = 0.01,
    often: int = 1,
    twice: bool = False,
    axes: tuple[float, ...] = (1.0,),
    how: str = "still",
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> Experiment:
    """Rest."""
    wanted = [
        PlannedRun(how, scenario_of("rest", wait * often, hold, options), lambda _: (Merit("a", 1.0, "1"),))
    ]
    cases, cut = fly(plant, controller, wanted * (2 if twice else len(axes)), progress, options)
    return Experiment("rest", "Does it rest?", cases, cases[0].merits, interrupted=cut)


@pytest.fixture
def toy(designs: dict[str, Design], monkeypatch: pytest.MonkeyPatch) -> Plant:
    """MALTA under another name, with one experiment and no word for anything."""
    ours = machines._installed_machines()
    monkeypatch.setattr(machines, "_installed_machines", lambda: ours | {"toy": "malta.machines.toy.plant"})
    tubular, model = machines.machine("tubular"), ModuleType("malta.machines.toy.plant")
    vars(model).update(Parameters=tubular.Parameters, plant=tubular.plant)
    monkeypatch.setitem(sys.modules, model.__name__, model)
    monkeypatch.setitem(
        sys.modules, "malta.machines.toy.experiments", SimpleNamespace(EXPERIMENTS={"rest": rest})
    )
    return replace(designs["calibrated"].plant, name="toy")


def test_parts_of_a_machine_are_found_by_its_name(toy: Plant) -> None:
    found = [require_part(part, "tubular").__name__ for part in ("experiments", "figures", "claims")]
    own = [f"malta.machines.tubular.{name}" for name in ("experiments", "figures")]
    assert found == [*own, "malta_papers.tubular.claims"]
    assert parts_of("figures", toy.name) == (None, None)
    error = refusal(lambda: require_part("claims", "toy"), Path("claims"))
    assert (error.field, error.found) == ("machine", "'toy'")
    assert "tubular" in error.expected
    assert "__init__" not in error.expected


def test_what_a_module_lacks_is_not_taken_for_a_machine_that_is_not_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "toy").mkdir()
    (tmp_path / "toy" / "claims.py").write_text("import nothing_of_that_name\n")
    (tmp_path / "toy" / "plant.py").write_text("Parameters = plant = dict\n")
    ours = machines._installed_machines()
    monkeypatch.setattr(machines, "_installed_machines", lambda: ours | {"toy": "malta.machines.toy.plant"})
    package = sys.modules["malta.machines"]
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    with pytest.raises(ModuleNotFoundError, match="nothing_of_that_name"):
        parts_of("claims", "toy")


def test_an_experiment_of_another_machine_is_flown(toy: Plant, designs: dict[str, Design]) -> None:
    controller = designs["calibrated"].controller
    assert main_job(toy) == "rest"
    assert options_of("rest", toy) == {
        "wait": 0.01,
        "often": 1,
        "twice": False,
        "axes": (1.0,),
        "how": "still",
    }
    found = malta.experiment("rest", toy, controller, often=2, noise=0.0)
    assert len(found.run.t) == 400
    assert found.run.scenario.noise == 0
    assert not found.failed
    ended = replace(found.run, verdict=found.run.verdict._replace(name="touchdown"))
    assert replace(found, cases=(Case("a", ended, ()),)).failed  # no finding of its own
    refused: tuple[tuple[str, Any, str], ...] = (
        ("wait", "a", "a number"),
        ("often", True, "a number"),
        ("twice", 1.0, "true or false"),
        ("axes", 1.0, "numbers"),
        ("axes", (), "numbers"),
        ("rise", 1.0, "one of axes how often twice wait .*"),
    )
    for option, value, expected in refused:
        with pytest.raises(malta.InputError, match=f"rest: {option}: found .*, expected {expected}"):
            malta.experiment("rest", toy, controller, **{option: value})
    with pytest.raises(malta.InputError, match="found 'stroke', expected one of rest"):
        malta.experiment("stroke", toy, controller)
    with pytest.raises(malta.InputError, match="'rest', which changes the machine"):
        cases_of("rest", toy, controller)


@pytest.mark.slow
def test_without_a_figure_of_its_own_an_experiment_has_that_of_its_first_run(
    toy: Plant, designs: dict[str, Design], tmp_path: Path
) -> None:
    controller = designs["calibrated"].controller
    found = malta.experiment("rest", toy, controller, twice=True)
    figure = report.experiment_figure(found)
    assert figure.get_suptitle().endswith("Does it rest? still, one of 2")
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert labels == [
        "x1 y1 x2 y2, off reference [µm]",
        "commanded force [N]",
        "z, off reference [µm]",
        "clearance used up [%]",
    ]
    report.stroke_figure(found.run, path=tmp_path / "run.svg")
    assert (tmp_path / "run.svg").stat().st_size > 10_000
    with pytest.raises(malta.InputError, match="'lunch', expected one of rest, worst-load, run"):
        report.experiment_figure(replace(found, name="lunch"))


@pytest.mark.slow
def test_angles_and_torques_have_panels_and_units_of_their_own(
    toy: Plant, designs: dict[str, Design], tmp_path: Path
) -> None:
    """The same numbers, read as two positions, two angles and the stroke; three forces and two torques."""
    run = malta.experiment("rest", toy, designs["calibrated"].controller).run
    outputs = [Signal(s.name, "rad" if s.name.endswith("2") else "m") for s in toy.outputs]
    inputs = [Signal(s.name, "N m" if s.name.endswith("2") else "N") for s in toy.inputs]
    turning = replace(toy, outputs=tuple(outputs), inputs=tuple(inputs))
    assert [(g.name, g.fine, g.columns) for g in outputs_of(turning)] == [
        ("z", "um", (4,)),
        ("x1 y1", "um", (0, 1)),
        ("x2 y2", "urad", (2, 3)),
    ]
    assert [(g.name, g.unit) for g in inputs_of(turning)] == [
        ("f_D", "N"),
        ("fx_B1 fy_B1", "N"),
        ("fx_B2 fy_B2", "N m"),
    ]
    e = Experiment("run", "A run", (Case("a", replace(run, plant=turning), ()),), ())
    figure = report.experiment_figure(e)
    labels = [axes.get_ylabel() for axes in figure.axes if axes.get_visible()]
    assert labels == [
        "x1 y1, off reference [µm]",
        "x2 y2, off reference [µrad]",
        "commanded force [N]",
        "commanded torque [N m]",
        "z, off reference [µm]",
        "clearance used up [%]",
    ]
    assert "x2 y2 " in figure.texts[-1].get_text()
    figures.save(figure, tmp_path / "run.png")
    free = replace(turning, contacts=malta.model.Contacts())
    alone = report.experiment_figure(replace(e, cases=(Case("a", replace(run, plant=free), ()),)))
    assert alone.axes[5].get_ylabel() == "currents, from least to largest [A]"


def test_the_words_of_a_machine(plant: Plant, toy: Plant) -> None:
    assert [group.name for group in outputs_of(plant)] == ["axial", "radial"]
    assert [group.name for group in inputs_of(plant)] == ["thrust", "bearing force"]
    assert (stroke_unit(plant), stroke_unit(toy)) == ("mm", "um")
    one = replace(toy, outputs=(toy.outputs[0],), stroke=malta.model.Stroke("x1"))
    assert [group.name for group in lateral_outputs(one)] == ["x1"]


def test_only_what_the_paper_shows_has_its_bounds(toy: Plant, plant: Plant) -> None:
    plan: Any = SimpleNamespace(plant=plant, scenario="stroke", options={"noise": 1.0})
    assert set(bounds_of(plan)) == {"rise", "overshoot", "stroke", "m"}
    plan.options = {"rise": 0.02}
    assert bounds_of(plan) == {}
    plan.plant, plan.options = toy, {}
    assert bounds_of(plan) == {}


def test_the_gang_of_four_of_angles_says_its_units(toy: Plant) -> None:
    from conftest import printed

    angles = replace(toy, outputs=(Signal("x1", "m"), Signal("a", "rad")))
    gang = {"x1": (1.0, 1.0, 2e-6, 3e6), "a": (1.0, 1.0, 4e-6, 5e6)}
    found: Any = SimpleNamespace(gang=gang, extent=NO_EXTENT, plant=angles)
    text = printed(report.gang_table(found))
    for cell in ("2.000 µm/N", "3.000 N/µm", "4.000 µrad/(N m)", "5.000 N m/µrad"):
        assert cell in text
    volts = replace(toy, outputs=(Signal("y", "V"), Signal("a", "m/s^2")), inputs=(Signal("u", "V"),))
    found = SimpleNamespace(gang={"y": (1, 1, 0.2439, 104), "a": gang["a"]}, extent=NO_EXTENT, plant=volts)
    (line,) = [line for line in printed(report.gang_table(found)).splitlines() if " y " in line]
    assert line.split()[-2:] == ["0.2439", "104.0"]  # V/V has no unit
    found = SimpleNamespace(gang={"x1": gang["x1"]}, extent=NO_EXTENT, plant=toy)
    assert "from force |SP| [µm/N]" in printed(report.gang_table(found))
    found.gang["x1"] = (1.0, 1.0, 8.14e-8, 4321.0)  # a stiff machine, and a soft one
    assert {"0.08140", "0.00432"} <= set(printed(report.gang_table(found)).split())


def test_poles_of_damped_and_of_stable_machines(designs: dict[str, Design]) -> None:
    from conftest import printed

    model = designs["calibrated"].model
    A = model.A.copy()
    half = len(A) // 2
    A[half:, :half] = -A[half:, :half]
    assert "218.92j" in printed(report.poles_table(replace(model, A=A), None))
    A[half + 2, half + 2] = -2.5
    text = printed(report.poles_table(replace(model, A=A), None))
    assert "-2.5" in text
    assert "±218.9j" in text
    assert np.all(model.A[half:, half:] == 0)
