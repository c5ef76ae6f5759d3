"""Laws that are tuned until a proof closes: goals that hold, a search that other searches do not beat, refusals."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import control
import numpy as np
import pytest
from conftest import ROOT
from scipy import optimize

import malta
from malta import structured
from malta.structured.loops import models_of_systems
from malta.structured.search import Task, random_starts, rate_of, search
from malta.synthesis.structure import Structure, places_of

if TYPE_CHECKING:
    from malta.linear.uncertain import UncertainSystem

J1, J2 = 1e-6, 1.15e-7  # kg m^2; MathWorks, Robust Tuning of Positioning System


def positioning() -> UncertainSystem:
    """A motor and its load behind a shaft that bends: angle of the load by torque."""

    def plant(b1: float, b2: float, b12: float, k: float) -> tuple[Any, ...]:
        A = [
            [0, 1, 0, 0],
            [-k / J1, -(b1 + b12) / J1, k / J1, b12 / J1],
            [0, 0, 0, 1],
            [k / J2, b12 / J2, -k / J2, -(b2 + b12) / J2],
        ]
        return A, [[0], [1 / J1], [0], [0]], [[0, 0, 1, 0]]

    return malta.uncertain(plant, {"b1": 1e-6, "b2": 1e-6, "b12": 5e-7, "k": 0.013})


RANGES = {"b1": 0.5, "b2": 0.5, "b12": 0.5, "k": 0.25}


def lead_and_notch(**values: float) -> structured.Element:
    law = structured.gain("k", 5e-5) * structured.lead("lead", 5.0, 500.0)
    bounds = {"frequency": (300.0, 1e4), "depth": (1e-4, 1.0), "damping": (1e-3, 1.0)}
    return (law * structured.notch("notch", 380.0, 0.05, 0.8, bounds=bounds)).at(values)


SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def body() -> UncertainSystem:
    """A levitated body: m x'' = k x + f."""
    return malta.uncertain(
        lambda m, k: ([[0, 1], [k / m, 0]], [[0], [1 / m]], [[1, 0]]), {"m": 1.0, "k": 1000.0}
    )


@SLOW
def test_a_proof_closes_that_the_first_law_does_not_have(body: UncertainSystem) -> None:
    law = structured.pid("axis", Kp=1500.0, Kd=15.0, filter=3e-3)
    goals = [structured.sensitivity(1.9)]
    ranges = {"m": 0.2, "k": 0.2}
    first = structured.tune(body, law, goals, ranges=ranges, margin=0.1, sample_time=1e-3, delay=1, starts=1)
    found = structured.tune(
        body, law, goals, ranges=ranges, margin=4.5, over_box=True, sample_time=1e-3, delay=1, starts=1
    )
    assert first.margin is not None
    assert first.margin.upper < 4.5
    assert found.closed
    assert found.margin is not None
    assert found.margin.lower is not None
    assert found.margin.lower >= 4.5
    (peak,) = found.peaks.values()
    assert peak.upper is not None
    assert peak.upper <= 1.9
    assert "Proven: the loop is stable" in found.certificate
    # The proof by another way: the law in malta.robust_margin and malta.worst_case_gain, at the same hold and delay.
    A, B, C, D = found.sampled
    again = malta.proof.Compensator(A, -B, C, -D, sample_time=1e-3, delay=1)
    margin = malta.robust_margin(body, again, ranges)
    assert margin.lower == pytest.approx(found.margin.lower, rel=1e-6)


def test_a_proof_that_does_not_close_says_so(body: UncertainSystem) -> None:
    """Poles of at most 800 rad/s hold no stiffness of 200 kN/m: the law that meets the goals stands, unproven."""
    law = structured.pid("axis", Kp=3000.0, Kd=60.0, filter=1e-3)
    goals = [structured.sensitivity(1.5), structured.poles(fastest=800.0)]
    found = structured.tune(body, law, goals, ranges={"k": 0.2}, margin=1000.0, starts=1)
    assert not found.closed
    assert "the proof does not close" in found.certificate
    assert max(found.reached.values()) <= 1


@SLOW
def test_what_was_found_holds_on_the_loop_itself() -> None:
    goals = [structured.disk_margin(0.9), structured.soft(structured.gain_limit("load", "output", 1e-3))]
    law = structured.pid("axis", Kp=2000.0, Ki=2000.0, Kd=30.0, filter=2e-3)
    plant = control.c2d(control.ss([[0, 1], [1000, 0]], [[0], [1]], [[1, 0]], 0), 1e-3)
    found = structured.tune(plant, law, goals, starts=1)
    K = control.ss(*found.sampled, 1e-3)
    S = control.feedback(1, plant * K)
    assert control.linfnorm(S - 0.5)[0] <= 1 / 0.9 * (1 + 1e-6)
    points = np.exp(
        1e-3j * np.geomspace(1e-2, 3e3, 4000)
    )  # a flat peak, of which control.linfnorm may miss a hundredth
    largest = np.abs((plant * S)(points)).max()
    assert largest == pytest.approx(1e-3 * found.reached["gain load -> output"], rel=1e-4)
    assert "Nothing is proven" in found.certificate


@SLOW
def test_starts_meet_and_no_other_search_finds_less() -> None:
    """A lead and a gain for 1 / s^2: least effort of the lead at a disk margin; Nelder and Mead go on from there."""
    (model,) = models_of_systems(control.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], 0))
    law = structured.gain("k", 3.0) * structured.lead("lead", 0.5, 10.0)
    structure = Structure(places_of(law, model.inputs, model.outputs))
    goals = (structured.disk_margin(0.7), structured.soft(structured.gain_limit("load", "output", 1.0)),
             structured.soft(structured.gain_limit("reference", "force", 30.0)))  # fmt: skip
    task = Task(structure, goals, (model,), rate_of(model))
    found = [search(task, [x]) for x in random_starts(structure, 2, 1)]
    assert [look.soft for look in found] == pytest.approx([found[0].soft] * 2, rel=2e-3)
    best = min(found, key=lambda look: look.merit)

    def merit(x: np.ndarray) -> float:
        look = task.look(x)
        return 1e3 if look is None else look.merit

    beside = optimize.minimize(merit, best.x, method="Nelder-Mead", options={"maxfev": 60})
    assert beside.fun > best.merit * (1 - 2e-3)


@pytest.mark.slow
def test_the_positioning_system_of_mathworks_is_proven_over_its_box() -> None:
    """Laws of docs/howto/structured.md: |S| below 1.3 for every stiffness and damping, where the nominal one has 8."""
    robust = {
        "k.value": 6.907e-5, "lead.zero": 1.6407, "lead.pole": 260.03,
        "notch.frequency": 377.74, "notch.depth": 0.0078568, "notch.damping": 0.71245,
    }  # fmt: skip
    A, B, C, D = lead_and_notch(**robust).system
    law = malta.proof.Compensator(A, -B, C, -D)
    found = malta.worst_case_gain(positioning(), law, RANGES)
    assert found.upper is not None
    assert found.upper < 1.3
    nominal = {
        "k.value": 8.0426e-5, "lead.zero": 1.7952, "lead.pole": 860.61,
        "notch.frequency": 358.41, "notch.depth": 0.042484, "notch.damping": 0.61949,
    }  # fmt: skip
    A, B, C, D = lead_and_notch(**nominal).system
    assert malta.worst_case_gain(positioning(), malta.proof.Compensator(A, -B, C, -D), RANGES).lower > 8


@pytest.mark.slow
def test_a_machine_has_its_own_loop(tmp_path: Path) -> None:
    """The models of a machine under load are the loop of `malta verify`, to the digits of its peaks."""
    controller = malta.gains.read(ROOT / "design" / "gains" / "tubular_pid.json")
    plant = malta.plant_of(controller.parameters)
    radial = structured.pid("radial", Kp=98.41e3, Ki=8108e3, Kd=111.45, filter=0.12e-3)
    axial = structured.pid("axial", Kp=11.6e3, Ki=437e3, Kd=54.4, filter=1.3e-3)
    law = {"x1": radial, "y1": radial, "x2": radial, "y2": radial, "z": axial}
    goals = [structured.sensitivity(2.3, channels=["x1", "x2", "z"])]
    found = structured.tune(plant, law, goals, sample_time=50e-6, places=[{"z": 5e-3}], starts=1)
    assert found.controller is not None
    S = malta.loop(plant, found.controller, z=5e-3).sensitivity(np.geomspace(10, 6e4, 4000))
    peak = max(float(np.abs(S[:, k, k]).max()) for k in (0, 2, 4))
    assert peak == pytest.approx(2.3 * found.reached["sensitivity 2.3"], rel=1e-3)
    assert found.order == 10
    margins = malta.verify(plant, found.controller)
    malta.gains.write(found.controller, margins, tmp_path / "law.json")
    again = malta.gains.read(tmp_path / "law.json")
    assert np.array_equal(
        malta.loop(plant, again, z=5e-3).matrix, malta.loop(plant, found.controller, z=5e-3).matrix
    )


def test_a_certificate_rounds_to_its_safe_side(body: UncertainSystem) -> None:
    law = structured.gain("stiffness", 1.0) * structured.pid("axis", Kp=1389.97, Kd=20.0, filter=1e-3)
    found = structured.tune(body, law, [], ranges={"k": 0.2}, margin=1.9, starts=1)
    assert found.margin is not None
    assert found.margin.lower == pytest.approx(389.97 / 200, rel=1e-4)
    assert "within 194.98 % of their ranges" in found.certificate


FIXED = control.ss([[1, 0], [0, -1]], [[0], [1]], [[1, 1]], 0)  # no input moves the pole at 1
PLAIN = control.tf([1], [1, 1])
LAW = structured.gain("k", 1.0)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: structured.tune(FIXED, LAW, []), r"cannot move the pole 1"),
        (lambda: structured.tune(control.tf([1], [1, 0, -1]), LAW, [], starts=2), "slowest pole still grows"),
        (lambda: structured.tune(PLAIN, LAW, [], ranges={"k": 0.2}), "malta.uncertain"),
        (lambda: structured.tune(PLAIN, LAW, [structured.gain_limit("load x", "output", 1.0)]), "one of reference"),
        (lambda: structured.tune(PLAIN, {"z": LAW}, []), "an element of z"),
        (lambda: structured.tune(PLAIN, LAW, [], margin=2.0), "ranges of parameters to prove"),
        (lambda: structured.tune(PLAIN, LAW, [], delay=1), "uncertain system alone"),
        (lambda: structured.tune(object(), LAW, []), "a system of python-control"),
        (lambda: structured.pid("a", 1.0, Kd=1.0), "no sampled law has a plain rate"),
        (lambda: structured.lead("a", -1.0, 2.0), "above 0"),
        (lambda: structured.notch("a", 1.0, 0.5, 0.5, bounds={"depth": (0.6, 1)}), "within 0.6"),
        (lambda: structured.gain("a", 1.0, bounds={"size": (0, 1)}), "some of value"),
        (lambda: structured.gain("a", 1.0) * structured.gain("a", 2.0), "one parameter twice"),
        (lambda: structured.transfer("a", [1, 0, 0], [1, 1]), "denominator's order"),
        (lambda: structured.states("a", ([[1.0]], [[1.0]], [[1.0]], [[0.0, 1.0]])), "that fit"),
        (lambda: structured.sensitivity(0.9), "Bode"),
        (lambda: structured.disk_margin(2.5), "between 0 and 2"),
        (lambda: structured.poles(), "a decay above 0"),
        (lambda: structured.tracking(-1.0), "above 0"),
        (lambda: structured.gain_limit("load", "output", 1.0, weight=control.tf([1], [1, -1])), "stable one"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_sentence(make: Callable[[], object], words: str) -> None:
    with pytest.raises(malta.InputError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_goals_that_contradict_each_other_are_named() -> None:
    """A gain k moves the pole 10 to 10 - k: |S| at rest is 10 / (k - 10), and k is at most 15."""
    plant = control.tf([1], [1, -10])
    goals = [structured.sensitivity(1.1), structured.poles(fastest=5.0)]
    with pytest.raises(malta.CheckError, match="poles of fastest") as caught:
        structured.tune(plant, structured.gain("k", 14.0), goals, starts=1)
    assert "sensitivity 1.1" in str(caught.value)
