"""Gains of a PID: load errors by two ways, a search that no grid beats, bounds that hold, wishes that are wrong."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT, Run, refusal
from scipy import linalg

import malta
from malta.linear.sampling import sample, sample_noise
from malta.loops.sampled_loops import machine_loop
from malta.machines.halbach import electronics, plant as halbach
from malta.synthesis.spec import Pid
from malta.tuning import outcomes, pid
from malta.tuning.design_text import design_text
from malta.tuning.judging import judge
from malta.tuning.pid import close_loop, goal_value, parts_of
from malta.tuning.pid_loop import loads_of, loop_figures, whole_machine
from malta.tuning.search import Effort, Journal, TrialSearch, model_and_controller, separate
from malta.tuning.tune import problem_sha256, tune as tuned

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from malta.margins.loop_report import LoopReport
    from malta.model.linearize import LinearModel
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec
    from malta.tuning.tune import TuningResult

pytestmark = pytest.mark.usefixtures("proven_once")

HALBACH = """
name = "motor_pid"
summary = "PID"
machine = "{data}/halbach.toml"
preset = "identified"
sample_time = {{ value = 55, unit = "ms" }}
current_loop_delay = true
operating_point = {{}}
uncertainty = {{}}

[pid]
Kp = {{ F_x = {{ value = 300, unit = "N/m" }} }}   # of the position
Ki = {{ F_x = {{ value = 800, unit = "N/m/s" }} }}
Kd = {{ F_x = {{ value = 16, unit = "N s/m" }} }}
filter = {{ value = 5, unit = "ms" }}

[cost]
load = {{ F_x = {{ value = 1, unit = "N" }} }}
force_noise = {{ F_x = {{ value = 2.157, unit = "mN" }} }}

[specification]
peak_sensitivity = 1.8
noise_motion = {{ x = {{ value = 3, unit = "um" }} }}

[search.numbers]
stiffness = {{ vary = ["pid.Kp.F_x"], low = 50, high = 5000, unit = "N/m" }}
integral = {{ vary = ["pid.Ki.F_x"], low = 0.1, high = 30, unit = "N/mm/s" }}
damping = {{ vary = ["pid.Kd.F_x"], low = 2, high = 200, unit = "N s/m" }}
"""

AXES = {"F_x": 20.0, "F_y": 20.0, "F_z": 20.0, "T_x": 0.268, "T_y": 0.268, "T_z": 0.533}  # kg, kg m^2


def planar_text() -> str:
    """Six equal axes, a search of the height."""

    def table(name: str, factor: float, force: str, torque: str) -> str:
        units = {axis: force if axis.startswith("F") else torque for axis in AXES}
        rows = (f'{a} = {{ value = {factor * size!r}, unit = "{units[a]}" }}' for a, size in AXES.items())
        return "\n".join([f"[{name}]", *rows, ""])

    return "\n".join(
        [
            'name = "mover_pid"',
            'summary = "six PIDs"',
            f'machine = "{(ROOT / "data" / "planar.toml").as_posix()}"',
            'preset = "pitch_16_3"',
            'sample_time = { value = 200, unit = "us" }',
            "current_loop_delay = true",
            "operating_point = {}",
            "uncertainty = {}",
            table("pid.Kp", 200.0**2, "N/m", "N m/rad"),
            table("pid.Ki", 200.0**3 / 5, "N/m/s", "N m/rad/s"),
            table("pid.Kd", 360.0, "N s/m", "N m s/rad"),
            '[pid.filter]\nvalue = 50\nunit = "us"',
            table("cost.load", 0.5, "N", "N m"),
            "[specification]",
            "peak_sensitivity = 1.6",
            'noise_motion = { z = { value = 0.1, unit = "um" } }',
            "[search.numbers]",
            'stiffness = { vary = ["pid.Kp.F_z"], low = 5e5, high = 3e7, unit = "N/m" }',
            'integral = { vary = ["pid.Ki.F_z"], low = 3e7, high = 3e10, unit = "N/m/s" }',
            'damping = { vary = ["pid.Kd.F_z"], low = 3e3, high = 1e5, unit = "N s/m" }',
        ]
    )


def motor_file(folder: Path, *changes: tuple[str, str]) -> Path:
    text = HALBACH.format(data=(ROOT / "data").as_posix())
    for old, new in changes:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "motor_pid.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def motor(tmp_path_factory: pytest.TempPathFactory) -> Spec:
    return malta.read_design(motor_file(tmp_path_factory.mktemp("motor")))


@pytest.fixture(scope="module")
def mover(tmp_path_factory: pytest.TempPathFactory) -> Spec:
    path = tmp_path_factory.mktemp("mover") / "mover_pid.toml"
    path.write_text(planar_text(), encoding="utf-8")
    return malta.read_design(path)


@pytest.fixture(scope="module")
def found(motor: Spec) -> TuningResult:
    return tuned(motor)


def terms_of(spec: Spec) -> Pid:
    assert spec.pid is not None
    return spec.pid


def figures_of(spec: Spec) -> dict[str, float]:
    """Of the whole machine."""
    model, controller = model_and_controller(spec)
    return loop_figures(
        spec, whole_machine(model, controller, loads_of(spec)), machine_loop(model, controller)
    )


def search_of(spec: Spec) -> TrialSearch:
    (part,) = parts_of(whole_machine(*model_and_controller(spec), loads_of(spec)))

    def compute(design: Spec) -> dict[str, float]:
        return loop_figures(spec, part, close_loop(part, terms_of(design), spec.sample_time))

    return TrialSearch(spec, (0, 1, 2), 0, Journal(None, "", restart=False), compute)


def goal(search: TrialSearch, u: Any) -> float:
    return goal_value(search, u, ["x"])


# --- figures ---


@pytest.mark.slow_for("mover")
@pytest.mark.parametrize("name", ["motor", "mover"])
def test_the_load_error_is_the_sum_over_a_simulated_step(name: str, request: pytest.FixtureRequest) -> None:
    """A force as one more state of the machine between samples, which holds still, and ten thousand samples."""
    spec: Spec = request.getfixturevalue(name)
    model, controller = model_and_controller(spec)
    machine, Ts = machine_loop(model, controller), spec.sample_time
    n, m = model.B.shape
    closed, figures = machine.closed, figures_of(spec)
    still = linalg.expm(np.block([[model.A - model.E @ model.C, model.B], [np.zeros((m, n + m))]]) * Ts)
    for k, (output, load) in enumerate(zip(spec.plant.outputs, loads_of(spec).load, strict=True)):
        x, total = np.zeros(len(closed)), 0.0
        for _ in range(10_000):
            total += Ts * x[k] ** 2
            x = closed @ x
            x[:n] += still[:n, n + k] * load
        assert abs(x[k]) < 1e-12 * math.sqrt(total)
        assert figures[f"load_error {output.name}"] == pytest.approx(math.sqrt(total), rel=1e-8)


def test_the_motion_from_noise_by_two_ways(motor: Spec) -> None:
    """The motor's own model, where currents follow at once; a PID that takes plain differences."""
    par, Ts = motor.parameters, motor.sample_time
    assert isinstance(par, halbach.Parameters)
    assert loads_of(motor).force_noise[0] == pytest.approx(
        math.sqrt(electronics.force_noise(par) / Ts), rel=1e-3
    )
    assert loads_of(motor).sensor_noise[0] == pytest.approx(par.n_laser / math.sqrt(3), rel=1e-5)
    Kp, Ki, Kd = 340.0, 923.3, 16.43  # three poles of the motor between readings at one place
    spring = par.k * par.F_z  # of the Park angle that is held
    A, B = np.array([[0, 1], [-spring / par.m, -par.b / par.m]]), np.array([[0], [1 / par.m]])
    E, G = sample(A, B, Ts)
    pull = np.array([1 - E[0, 0], -E[1, 0]])  # of where the spring hangs from
    proportional = Kp + Ki * Ts + Kd / Ts
    M = np.zeros((4, 4))  # position, speed, sum of errors, last reading
    M[:2, :2] = E + np.outer(pull - proportional * G[:, 0], [1, 0])
    M[:2, 2:] = G @ [[Ki, Kd / Ts]]
    M[2, [0, 2]], M[3, 0] = (-Ts, 1), 1
    reading = np.array([*(pull - proportional * G[:, 0]), -Ts, 1])
    pushed = linalg.block_diag(sample_noise(A, B @ B.T, Ts) * electronics.force_noise(par), np.zeros((2, 2)))
    noise = pushed + np.outer(reading, reading) * par.n_laser**2 / 3
    quick = replace(par, L=par.L / 100, pm_cc=0.1)
    terms = Pid(np.array([Kp]), np.array([Ki]), np.array([Kd]), 0.0)
    ours = figures_of(replace(motor, law=terms, parameters=quick))["noise_motion x"]
    assert ours == pytest.approx(math.sqrt(linalg.solve_discrete_lyapunov(M, noise)[0, 0]), rel=0.02)


@pytest.mark.slow_for("mover")
@pytest.mark.parametrize("name", ["motor", "mover"])
def test_parts_have_the_figures_of_the_whole_machine(name: str, request: pytest.FixtureRequest) -> None:
    spec: Spec = request.getfixturevalue(name)
    model, controller = model_and_controller(spec)
    parts = parts_of(whole_machine(model, controller, loads_of(spec)))
    expected = [(0,)] if name == "motor" else [(0, 4), (1, 3), (2,), (5,)]  # a tilt turns the lifting force
    assert [part.outputs for part in parts] == expected
    quick: dict[str, float] = {}
    for part in parts:
        quick |= loop_figures(spec, part, close_loop(part, terms_of(spec), spec.sample_time))
    whole = figures_of(spec)
    assert quick.keys() == whole.keys()
    for key, value in whole.items():
        assert quick[key] == pytest.approx(value, rel=1e-7), key
    peaks = malta.verify(model, controller).peak_sensitivity
    for output in spec.plant.outputs:
        assert quick[f"peak_sensitivity {output.name}"] == pytest.approx(peaks[output.name], rel=1e-5)


def test_an_unstable_loop_has_no_figures(motor: Spec) -> None:
    hasty = replace(motor, law=replace(terms_of(motor), Kp=np.array([1e5])))
    assert figures_of(hasty) == {}
    search = search_of(motor)
    assert goal(search, np.ones(3)) == 1e3
    assert goal(search, np.full(3, 1.5)) == 1e3 + 1.5
    rows = {r.name: r for r in judge(hasty)}
    assert not any(r.holds for r in rows.values())
    assert str(rows["load_error x"]) == "load_error x is inf um s^0.5, asked for little"


# --- the search ---


@pytest.mark.slow
def test_no_grid_beats_what_is_found(motor: Spec, found: TuningResult) -> None:
    """All of the cube, and a finer grid about the place."""
    search = search_of(motor)
    best, own = search_of(found.spec), found.trial.values
    assert search.values(best.start) == own
    least = math.log(found.trial.figures["load_error x"])
    assert goal(search, best.start) == pytest.approx(least, abs=1e-9)
    coarse = itertools.product(np.linspace(0.05, 0.95, 8), repeat=3)
    fine = (best.start + np.array(d) for d in itertools.product((-0.02, -0.004, 0.0, 0.004, 0.02), repeat=3))
    values = [goal(search, np.array(u)) for u in itertools.chain(coarse, fine)]
    assert min(values) > least - 1e-4
    assert sorted(values)[100] > least + 0.01


def test_the_bounds_hold_where_it_counts(found: TuningResult) -> None:
    rows = {r.name: r for r in found.requirements}
    assert list(rows) == ["load_error x", "noise_motion x", "peak_sensitivity"]
    assert found.reached
    assert found.binding.name == "peak_sensitivity"
    assert found.binding.ratio == pytest.approx(1, abs=1e-4)
    assert rows["load_error x"].asked is None
    assert rows["load_error x"].found == pytest.approx(435e-6, rel=1e-3)
    assert rows["noise_motion x"].found == pytest.approx(2.77e-6, rel=0.01)
    assert found.front == ()


@pytest.mark.slow
def test_a_tighter_bound_on_motion_costs_load_error(motor: Spec, found: TuningResult) -> None:
    asked = {**motor.specification, "noise_motion x": 2.3e-6}
    calm = tuned(replace(motor, specification=asked), effort=Effort(generations=5))
    assert calm.reached
    ratios = {r.name: r.ratio for r in calm.requirements}
    assert ratios["noise_motion x"] == pytest.approx(1, abs=1e-4)
    assert calm.trial.figures["load_error x"] > 1.1 * found.trial.figures["load_error x"]


@pytest.mark.slow
def test_a_search_that_was_interrupted_ends_where_it_would_have(motor: Spec, tmp_path: Path) -> None:
    quick = Effort(generations=2, polish=10)
    whole = tuned(motor, tmp_path / "whole.jsonl", effort=quick)
    journal = tmp_path / "cut.jsonl"
    calls = itertools.count()

    def stop(_: float) -> None:
        if next(calls) == 70:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tuned(motor, journal, effort=quick, progress=stop)
    lines = journal.read_text(encoding="utf-8").splitlines()
    assert 50 < len(lines) < whole.trials
    journal.write_text("\n".join([*lines[:-1], lines[-1][:20]]), encoding="utf-8")  # while it was written
    again = tuned(motor, journal, effort=quick)
    assert (again.trial, again.requirements, again.trials) == (whole.trial, whole.requirements, whole.trials)
    other = replace(motor, loads=replace(loads_of(motor), load=(2.0,)))
    assert problem_sha256(other) != problem_sha256(motor)


@pytest.mark.slow
def test_an_axis_of_six_is_searched_by_itself(mover: Spec) -> None:
    """The height alone: the others stay as they are, and are computed once."""
    found = tuned(mover, effort=Effort(generations=5))
    assert found.reached
    assert {name.split()[1] for name in found.trial.figures} == {s.name for s in mover.plant.outputs}
    rows = {r.name: r for r in found.requirements}
    before = figures_of(mover)
    assert rows["load_error z"].found < 0.05 * before["load_error z"]
    assert rows["load_error x"].found == pytest.approx(before["load_error x"], rel=1e-6)
    assert rows["peak_sensitivity"].ratio == pytest.approx(1, abs=1e-4)
    assert rows["load_error phi"].unit == "rad s^0.5"
    old, new = terms_of(mover), terms_of(found.spec)
    assert np.flatnonzero(old.Ki != new.Ki).tolist() == [2]


@pytest.mark.slow
def test_a_shared_filter_joins_all_axes(mover: Spec, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = mover.search[0]._replace(name="filter", entries=("pid.filter",), low=1.0, high=1e3, unit="us")
    spec = replace(mover, search=(*mover.search, shared))
    seen = []

    def looked_at(*given: Any) -> Any:
        seen.append(separate(*given))
        return seen[-1]

    monkeypatch.setattr(pid, "separate", looked_at)
    found = tuned(spec, effort=Effort(generations=0, polish=0))
    assert seen == [[((0, 1, 2, 3), tuple(range(count)))] for count in (4, 6)]  # parts, outputs
    assert {name.split()[1] for name in found.trial.figures} == {s.name for s in mover.plant.outputs}
    assert found.trial.values[3] == 50.0


def test_bandwidth_and_margin_are_judge(motor: Spec, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = {**motor.specification, "bandwidth": 8.0, "margin": 1.0}
    spec = replace(motor, specification=asked, uncertainty={"m": 0.1})

    def proven(model: LinearModel, controller: Controller, box: Mapping[str, float]) -> LoopReport:
        assert box == {"m": 0.1}
        bound: Any = SimpleNamespace(lower=1.25)
        return replace(linear_report(model, controller), robust=bound)

    linear_report: Callable[..., LoopReport] = vars(outcomes)["linear_report"]
    monkeypatch.setattr(outcomes, "linear_report", proven)
    rows = {r.name: r for r in judge(spec)}
    assert rows["margin"].ratio == 0.8
    assert rows["bandwidth"].at_least
    assert "bandwidth" in figures_of(spec)
    search = search_of(replace(spec, specification=asked | {"bandwidth": 40.0}))
    assert goal(search, search.start) > goal(search_of(motor), search.start)


def test_what_is_found_is_written_with_everything_else_kept(
    motor: Spec, found: TuningResult, tmp_path: Path
) -> None:
    target = tmp_path / "deep" / "motor_pid.toml"
    target.parent.mkdir()
    target.write_text(design_text(motor, found.trial, target), encoding="utf-8")
    again = malta.read_design(target)
    for name in ("Kp", "Ki", "Kd"):
        assert (getattr(terms_of(again), name) == getattr(terms_of(found.spec), name)).all(), name
    assert (again.loads, again.specification, again.search) == (
        motor.loads,
        motor.specification,
        motor.search,
    )
    assert "# of the position" in target.read_text(encoding="utf-8")


# --- the design file ---

COST = 'load = { F_x = { value = 1, unit = "N" } }'
NOISE = 'force_noise = { F_x = { value = 2.157, unit = "mN" } }'
MOTION = 'noise_motion = { x = { value = 3, unit = "um" } }'
SEARCH = "[search.numbers]"


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        (COST, "", "cost.load"),
        (COST, COST.replace("F_x", "F_z"), "cost.load"),
        (COST, COST.replace('"N"', '"m"'), "cost.load.F_x.unit"),
        (COST, COST.replace("value = 1", "value = 0"), "cost.load.F_x"),
        (COST, COST.replace("value = 1", "value = -1"), "cost.load.F_x"),
        (COST, COST + "\nloads = 1", "cost.loads"),
        (NOISE, NOISE.replace("2.157", "nan"), "cost.force_noise.F_x.value"),
        (NOISE, NOISE.replace("F_x", "x"), "cost.force_noise"),
        (NOISE, 'sensor_noise = { x = { value = 1, unit = "N" } }', "cost.sensor_noise.x.unit"),
        (MOTION, MOTION.replace("x =", "y ="), "specification.noise_motion.y"),
        (MOTION, MOTION.replace('"um"', '"N"'), "specification.noise_motion.x.unit"),
        (MOTION, MOTION.replace("value = 3", "value = 0"), "specification.noise_motion.x"),
        (MOTION, 'force_noise = { value = 1, unit = "N" }', "specification.force_noise"),
        (MOTION, "lift_off = true", "specification.lift_off"),
        ("peak_sensitivity = 1.8\n" + MOTION, "", "specification"),
        ("value = 800,", "value = 0,", "cost.load"),
        (SEARCH, "[search]\ndelay = [1]\n" + SEARCH, "search.delay"),
        ("stiffness = { vary = ", 'stiffness = { vary = ["pid.Ka.F_x"] } #', "search.numbers.stiffness"),
        ("50, high = 5000, unit", "50, high = 5000, u", "search.numbers.stiffness"),
    ],
)
def test_a_wrong_wish_gets_one_sentence(tmp_path: Path, old: str, new: str, field: str) -> None:
    path = motor_file(tmp_path, (old, new))
    assert refusal(lambda: malta.read_design(path), path).field.startswith(field)


def test_a_cost_belongs_to_a_pid_and_a_pid_with_wishes_needs_one(tmp_path: Path) -> None:
    path = motor_file(tmp_path, ("[cost]\n" + COST + "\n" + NOISE, ""))
    without = malta.read_design(path)
    assert without.loads is None
    for use in (partial(tuned, without), partial(judge, without)):
        error = refusal(use, path)
        assert (error.field, error.found) == ("cost", "nothing")
    lqg = (ROOT / "design" / "robust.toml").read_text(encoding="utf-8")
    lqg = lqg.replace("../data", (ROOT / "data").as_posix())
    path = tmp_path / "robust.toml"
    path.write_text(lqg + '\n[cost]\nload = { f_D = { value = 1, unit = "N" } }\n', encoding="utf-8")
    assert refusal(lambda: malta.read_design(path), path).field == "cost"
    wish = '[specification]\nnoise_motion = { z = { value = 1, unit = "um" } }'
    path.write_text(lqg.replace("[specification]", wish), encoding="utf-8")
    assert refusal(lambda: malta.read_design(path), path).field == "specification.noise_motion"


def test_cost_does_not_shape_the_gains(tmp_path: Path, motor: Spec) -> None:
    other = malta.read_design(motor_file(tmp_path, ("value = 1, ", "value = 2, ")))
    assert other.sha256 == motor.sha256
    assert loads_of(other).load == (2.0,)
    given = motor_file(tmp_path, (NOISE, 'sensor_noise = { x = { value = 0.5, unit = "um" } }'))
    loads = loads_of(malta.read_design(given))
    assert loads.force_noise == (0.0,)
    assert loads.sensor_noise == pytest.approx((5e-7,))


# --- the command ---


@pytest.fixture
def run(run: Run) -> Run:
    """Run `malta tune ARGUMENTS`."""
    return partial(run, "tune")


@pytest.mark.slow
def test_the_command_finds_gains_and_judges_them(run: Any, tmp_path: Path) -> None:
    path, out = motor_file(tmp_path), tmp_path / "out"
    code, text, err = run(path, "--check")
    assert code == 1
    assert "not reached: peak_sensitivity is" in err
    assert all(
        words in text
        for words in ("load error x", "as little as possible", "noise motion x", "peak sensitivity")
    )
    code, text, err = run(path, "--out", out, "--generations", "1")
    assert (code, err) == (0, "")
    assert sorted(p.name for p in out.iterdir()) == ["motor_pid.toml", "motor_pid_trials.jsonl"]
    code, text, err = run(out / "motor_pid.toml", "--check", "--json")
    assert (code, err) == (0, "")
    rows = {r["name"]: r for r in json.loads(text)["requirements"]}
    assert rows["load_error x"]["asked"] is None
    assert rows["peak_sensitivity"]["ratio"] == pytest.approx(1, abs=1e-4)


@pytest.mark.slow_for("halbach_pid")
@pytest.mark.parametrize("name", ["halbach_pid", pytest.param("planar_pid", marks=pytest.mark.slow)])
def test_the_shipped_gains_are_those_that_the_search_ends_with(name: str) -> None:
    """Every bound holds, and no polish from there finds a load error that is smaller by 0.1 %."""
    spec = malta.read_design(ROOT / "design" / f"{name}.toml")
    rows = {r.name: r for r in judge(spec)}
    assert rows["peak_sensitivity"].asked == 1.8
    assert rows["peak_sensitivity"].ratio == pytest.approx(1, abs=1e-4)
    assert all(r.holds for r in rows.values())
    again = tuned(spec, effort=Effort(generations=0, polish=10))
    for output in spec.plant.outputs:
        key = f"load_error {output.name}"
        assert rows[key].found == pytest.approx(again.trial.figures[key], rel=1e-3)
