"""What designs can be asked for: requirements of every machine, a machine's own, and what fails."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT, refusal

import malta
from malta.loops.noise import noise_of
from malta.loops.sampled_loops import machine_loop
from malta.machines.tubular.requirements import REQUIREMENTS
from malta.synthesis.requirements import GENERIC_REQUIREMENTS, requirements_for
from malta.synthesis.spec import Loads, Pid, Spec
from malta.tuning.groups import figures_of, groups_of
from malta.tuning.judging import judge
from malta.tuning.search import Effort, at_least_of, merge, model_and_controller


def motor_file(folder: Path, *lines: str) -> Path:
    """The linear motor's LQG with a specification."""
    text = (ROOT / "design" / "halbach.toml").read_text(encoding="utf-8")
    text = text.replace('"../data/', f'"{(ROOT / "data").as_posix()}/')
    path = folder / "motor.toml"
    path.write_text("\n".join([text, "[specification]", *lines, ""]), encoding="utf-8")
    return path


MOTION = 'motion = { x = { value = 5, unit = "um" } }'
FORCE = 'force_noise = { F_x = { value = 0.1, unit = "mN" } }'


def test_every_machine_can_bound_its_outputs_and_inputs_one_by_one(tmp_path: Path) -> None:
    spec = malta.read_design(motor_file(tmp_path, "peak_sensitivity = 3", MOTION, FORCE))
    assert spec.specification == {"peak_sensitivity": 3.0, "motion x": 5e-6, "force_noise F_x": 1e-4}
    rows = {(r.name, r.how): r for r in judge(spec)}
    noise = noise_of(machine_loop(*model_and_controller(spec)), spec.plant)
    assert rows["motion x", "covariance"].found == pytest.approx(noise.motion[0], rel=1e-12)
    assert rows["force_noise F_x", "covariance"].found == pytest.approx(noise.force[0], rel=1e-12)
    assert rows["motion x", "covariance"].holds
    assert not rows["force_noise F_x", "covariance"].holds
    assert rows["force_noise F_x", "covariance"].unit == "N"
    assert len(rows) == len(spec.specification)


def test_a_machines_own_replace_generic_ones_of_their_name(tmp_path: Path) -> None:
    motor = malta.read_design(motor_file(tmp_path, MOTION)).plant
    assert list(requirements_for(motor).values()) == list(GENERIC_REQUIREMENTS)
    tubular = malta.read_design(ROOT / "design" / "robust.toml").plant
    known = requirements_for(tubular)
    assert known["force_noise"] in REQUIREMENTS
    assert {"margin", "motion", "payload"} < known.keys()
    assert len(known) == len(GENERIC_REQUIREMENTS) + len(REQUIREMENTS) - 1


@pytest.mark.parametrize(
    ("line", "field", "found"),
    [
        ('payload = { value = 1, unit = "kg" }', "specification.payload", "an unknown requirement"),
        (MOTION.replace("x =", "F_x ="), "specification.motion.F_x", "an unknown signal"),
        (MOTION.replace("um", "N"), "specification.motion.x.unit", "'N'"),
        ('motion = { value = 5, unit = "um" }', "specification.motion.value", "5"),
        ("noise_motion = {}", "specification.noise_motion", "a requirement of a PID"),
        ("motion = {}", "specification", "nothing to reach"),
    ],
)
def test_what_a_machine_cannot_be_asked_for_gets_one_sentence(
    tmp_path: Path, line: str, field: str, found: str
) -> None:
    path = motor_file(tmp_path, line)
    error = refusal(lambda: malta.read_design(path), path)
    assert error.field == field
    assert error.found.startswith(found)


@pytest.fixture(scope="module")
def robust() -> Spec:
    return malta.read_design(ROOT / "design" / "robust.toml")


@pytest.mark.slow
def test_a_search_sees_bounds_of_single_signals(robust: Spec) -> None:
    """Mirror images are told apart where their bounds differ, and only there."""
    asked = {"motion x1": 1e-6, "motion y1": 1e-6, "motion z": 1e-5}
    par: Any = robust.parameters
    alike = replace(robust, parameters=replace(par, n_x1=1.0, n_y1=1.0, n_x2=1.0, n_y2=1.0))
    groups = groups_of(replace(alike, specification=asked))
    assert [len(g.outputs) for g in groups] == [2, 2, 1]
    assert len({g.picture for g in groups}) == 2
    figures = [figures_of(robust, g, robust.weights, 0) for g in groups]
    assert figures[0]["motion x1"] == pytest.approx(figures[0]["radial_motion"], rel=1e-9)
    assert figures[1]["motion y1"] == pytest.approx(figures[0]["motion x1"], rel=1e-9)
    assert figures[2]["motion z"] == figures[2]["axial_motion"]
    uneven = groups_of(replace(robust, specification=asked | {"motion y1": 2e-6}))
    assert len({g.picture for g in uneven}) == 3


@pytest.mark.slow
def test_a_search_sees_a_filter_that_observes_forces(robust: Spec) -> None:
    """In place of integrals: the figures of a trial are those of the judged design."""
    weights = replace(robust.weights, q_i=np.zeros(5), drift_variance=np.full(5, 1e-3))
    asked = {name: robust.specification[name] for name in ("radial_motion", "axial_motion", "force_noise")}
    spec = replace(robust, law=weights, specification=asked, pause=())
    figures = merge([figures_of(spec, g, weights, 0) for g in groups_of(spec)], at_least_of(spec.plant))
    rows = {r.name: r.found for r in judge(spec) if r.how == "covariance"}
    assert figures["thrust_noise"] > 0
    for name in asked:
        assert figures[name] == pytest.approx(rows[name], rel=1e-3)
    plain = replace(weights, drift_variance=robust.weights.drift_variance)
    without = [figures_of(spec, g, plain, 0) for g in groups_of(spec)]
    assert figures["force_noise"] > 1.001 * without[0]["force_noise"]


def test_what_an_unstable_loop_does_not_have_fails(robust: Spec) -> None:
    hasty = replace(
        robust.weights,
        process_variance=robust.weights.process_variance * 1e10,
        q_base=robust.weights.q_base / 1000,
    )
    rows = judge(replace(robust, law=hasty))
    assert {r.name for r in rows} == robust.specification.keys()
    fallen = {r.name: r for r in rows if r.how == "unstable loop"}
    assert not any(r.holds for r in rows if r.name != "bandwidth")
    assert fallen["payload"].found == 0
    assert math.isinf(fallen["radial_motion"].found)
    assert np.all([r.ratio == math.inf for r in fallen.values()])


def test_an_unknown_requirement_made_in_code_gets_one_sentence(robust: Spec) -> None:
    error = refusal(lambda: judge(replace(robust, specification={"margni": 3.0})), robust.path)
    assert (error.field, error.found) == ("specification.margni", "an unknown requirement")


FLOATER = """
from dataclasses import dataclass

import casadi as ca

from malta.model.parameters import si
from malta.model.actuator import Actuator
from malta.model.plant import Plant, Signal
from malta.model.sensors import Sensors
from malta.synthesis.requirements import Figure, Requirement


@dataclass(frozen=True)
class Parameters:
    m: float = si("kg", above=0)
    k: float = si("N/m", above=0)
    preset: str = "data"


def plant(par):
    def f(x, u, w):
        return ca.vertcat(x[1], (par.k * x[0] + u) / par.m)

    return Plant(
        name="floater", parameters=par,
        states=(Signal("y", "m"), Signal("y_dot", "m/s")), inputs=(Signal("F", "N"),), outputs=(Signal("y", "m"),),
        f=f, h=lambda x, u: x[0], actuator=Actuator((Signal("i", "A"),), (10.0,), 5.0),
        variant=plant, sensors=Sensors(noise=(1e-6,)),
    )


def gain(design, asked, signal):
    return [Figure(float(design.controller.K[0, 0]), "the gain itself")]


REQUIREMENTS = (Requirement("stiffness", gain, "N/m", at_least=True, needs_stability=False),)
"""

FLOATER_DESIGN = """
name = "floater"
summary = "LQG"
machine = "floater.toml"
preset = "data"
sample_time = { value = 100, unit = "us" }
delay = 0
discretization = "sampled-data"
current_loop_delay = false
uncertainty = { m = 0.2, k = 0.2 }

[operating_point]

[weights]
state = { y = 1, y_dot = 0 }
input = { F = 1 }
integral = { y = 1 }

[bases]
state = { y = { value = 50, unit = "um" }, y_dot = { value = 1, unit = "m/s" } }
input = "SI"
integral = { y = { value = 1, unit = "um s" } }

[noise]
process = { F = { value = 1, unit = "N" } }
sensor = { y = { value = 1, unit = "um" } }

[specification]
margin = 1
motion = { y = { value = 2, unit = "um" } }
stiffness = { value = 25, unit = "N/mm" }

[search.numbers]
position = { vary = ["bases.state.y"], low = 5, high = 500, unit = "um" }
"""


@pytest.mark.slow
def test_a_machine_of_ones_own_without_a_stroke_is_tuned_for_its_own_requirement(tmp_path: Path) -> None:
    (tmp_path / "floater.py").write_text(FLOATER, encoding="utf-8")
    quantity = '{{ value = {}, unit = "{}", tag = "assumed", source = "test" }}'
    data = f'machine = "floater.py"\n[parameters]\nm = {quantity.format(1, "kg")}\nk = {quantity.format(1, "N/mm")}\n'
    (tmp_path / "floater.toml").write_text(data, encoding="utf-8")
    (tmp_path / "design.toml").write_text(FLOATER_DESIGN, encoding="utf-8")
    spec = malta.read_design(tmp_path / "design.toml")
    assert spec.specification == {"margin": 1.0, "motion y": 2e-6, "stiffness": 25e3}
    (group,) = groups_of(spec)
    quick = figures_of(spec, group, spec.weights, 0)
    rows = {(r.name, r.how): r for r in judge(spec)}
    assert quick["margin"] == pytest.approx(rows["margin", "proven over the travel"].found, rel=5e-3)
    assert quick["motion y"] == pytest.approx(rows["motion y", "covariance"].found, rel=1e-6)
    own = rows["stiffness", "the gain itself"]
    assert own.ratio == pytest.approx(25e3 / own.found, rel=1e-12)
    found = malta.tune(spec, effort=Effort(generations=0, polish=5, front=0))
    assert found.trials > 3
    assert {r.name for r in found.requirements} == spec.specification.keys()
    gains = Pid(np.array([5e3]), np.array([5e4]), np.array([60.0]), 0.0)
    loads = Loads((1.0,), (0.0,), (1e-6,))
    calm = {
        r.name: r
        for r in judge(replace(spec, law=gains, loads=loads, specification={"noise_motion y": 1e-5}))
    }
    assert 0 < calm["load_error y"].found < 1e-3
    assert calm["noise_motion y"].holds


def test_generic_code_names_no_machines_requirements() -> None:
    own = {r.name for r in REQUIREMENTS} - {r.name for r in GENERIC_REQUIREMENTS}
    assert len(own) == 8
    names = re.compile(rf"\b({'|'.join(sorted(own))})\b")
    for folder in ("synthesis", "tuning", "report"):
        for file in (ROOT / "malta" / folder).rglob("*.py"):
            found = names.findall(file.read_text(encoding="utf-8"))
            allowed = {"payload"}  # a margin in kg, and the example of how to write a requirement
            assert set(found) <= allowed, file


LOADS = """
[specification.recovery.F_x]
largest = { value = 20, unit = "um" }
left = [
    { value = 10, unit = "um", after = { value = 100, unit = "ms" } },
    { value = 9, unit = "um", after = { value = 0.3, unit = "s" } },
]
anywhere = { largest = { value = 25, unit = "um" } }

[specification.recovery.bearing]
load = { F_y = { value = 1, unit = "N" }, T_x = { value = 45, unit = "mN m" } }
load_slope = { T_x = { value = 1, unit = "N m / m" } }
outputs = ["y1", "y2"]
largest = { value = 12, unit = "um" }
anywhere = { largest = { value = 13, unit = "um" } }

[specification.recovery.F_z]
largest = { value = 0.5, unit = "mm" }
"""


def robust_file(folder: Path, specification: str) -> Path:
    """The flagship with a specification of its own."""
    text = (ROOT / "design" / "robust.toml").read_text(encoding="utf-8")
    text = text.replace('"../data/', f'"{(ROOT / "data").as_posix()}/')
    path = folder / "robust.toml"
    path.write_text(text[: text.index("[specification]")] + specification, encoding="utf-8")
    return path


@pytest.mark.slow
def test_loads_from_outside_are_bounded_and_the_search_sees_them_as_the_judge_does(tmp_path: Path) -> None:
    spec = malta.read_design(robust_file(tmp_path, LOADS))
    names = [f"recovery F_x {what}" for what in ("largest", "left 0.1 s", "left 0.3 s", "largest anywhere")]
    assert list(spec.specification) == [
        *names,
        "recovery bearing largest",
        "recovery bearing largest anywhere",
        "recovery F_z largest",
    ]
    assert spec.specification["recovery F_x left 0.1 s"] == pytest.approx(1e-5)
    bearing = spec.recovery["bearing largest"]
    assert bearing.load == pytest.approx((0, 1, 0, 0.045, 0, 0))
    assert bearing.outputs == ("y1", "y2")
    assert bearing.load_at(15e-3) == pytest.approx((0, 1, 0, 0.060, 0, 0))
    rows = {r.name: r for r in judge(spec)}
    (pushed,) = malta.loops.recovery(spec.plant, model_and_controller(spec)[1], {"": {"F_x": 1.0}})
    assert rows[names[0]].found == pytest.approx(max(d.largest for d in pushed.outputs), rel=1e-9)
    assert rows[names[2]].found == pytest.approx(max(d.left[1] for d in pushed.outputs), rel=1e-9)
    assert rows[names[3]].found > 1.02 * rows[names[0]].found
    assert "at" in rows[names[3]].how
    assert rows[names[0]].holds
    assert rows["recovery F_x left 0.1 s"].unit == "m"
    groups = groups_of(spec)
    assert len({g.picture for g in groups}) == 3  # no longer mirror images: their bounds differ
    figures = merge([figures_of(spec, g, spec.weights, 0) for g in groups], at_least_of(spec.plant))
    for name in spec.specification:  # groups do not see how gravity couples a stroke to a tilt
        assert figures[name] == pytest.approx(rows[name].found, rel=1e-2), name


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("recovery.F_x]", "recovery.F_w]", "recovery.F_w.load"),
        ("F_y = {", "F_w = {", "recovery.bearing.load.F_w"),
        ("load_slope = { T_x", "load_slope = { T_w", "recovery.bearing.load_slope.T_w"),
        ('"y1", "y2"', '"y1", "w"', "recovery.bearing.outputs"),
        ('value = 20, unit = "um"', 'value = 20, unit = "N"', "recovery.F_x.largest.unit"),
        ('value = 20, unit = "um"', 'value = 0, unit = "um"', "recovery.F_x.largest"),
        ('unit = "ms"', 'unit = "m"', "recovery.F_x.left[0].after.unit"),
        ("{ largest = { value = 25", "{ largst = { value = 25", "recovery.F_x.anywhere.largst"),
        ('anywhere = { largest = { value = 25, unit = "um" } }', "anywhere = {}", "recovery.F_x.anywhere"),
        ("F_y = { value = 1,", "F_y = { value = 0,", None),
    ],
)
def test_a_wrong_load_gets_one_sentence(tmp_path: Path, old: str, new: str, field: str | None) -> None:
    assert old in LOADS
    path = robust_file(tmp_path, LOADS.replace(old, new))
    if field is None:  # a torque alone is a load, too
        assert malta.read_design(path).recovery["bearing largest"].load[1] == 0
        return
    assert refusal(lambda: malta.read_design(path), path).field == f"specification.{field}"


def test_a_pid_is_judged_by_loads_too(tmp_path: Path) -> None:
    text = (ROOT / "design" / "halbach_pid.toml").read_text(encoding="utf-8")
    text = text.replace('"../data/', f'"{(ROOT / "data").as_posix()}/')
    text = text[: text.index("[specification]")] if "[specification]" in text else text
    path = tmp_path / "motor.toml"
    bound = '[specification.recovery.F_x]\nlargest = { value = 1, unit = "mm" }\n'
    path.write_text(f"{text}\n{bound}", encoding="utf-8")
    row = next(r for r in judge(malta.read_design(path)) if r.name.startswith("recovery"))
    assert row.found == pytest.approx(1221e-6, rel=1e-3)
    assert not row.holds
