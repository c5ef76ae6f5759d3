"""Calibration against simulated truths, and the checklist: limits, journal, signature, page."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from conftest import Run

import malta
from malta.errors import CheckError, InputError
from malta.identification import calibration, measure as measuring
from malta.identification.calibration import Interval95
from malta.identification.commission import (
    JOURNAL,
    Bench,
    Check,
    StepFinding,
    commission,
    judge_noise,
    read_journal,
    steps_of,
)
from malta.identification.log import log_of
from malta.identification.noise import dc_log, noise_table, process_noise
from malta.machines.tubular import bench as tubular
from malta.model.equilibrium import trim
from malta.model.places import outputs_at
from malta.report.page.binder import binder_page, binder_text, step_pictures
from malta.report.page.sections import Illustration

if TYPE_CHECKING:
    from collections.abc import Sequence

ROBUST = "design/gains/robust.json"
CONTROLLER = malta.gains.read(ROBUST)
PLANT = malta.plant_of(CONTROLLER.parameters)
TRUE = {"K_A": 9000.0, "F_c": 0.6, "phi_c": 0.3, "e_x": 8e-6, "e_y": -5e-6}
ERRORS = {"gain_x1": 0.02, "offset_x1": 5e-6, "hall_amplitude": 0.01, "hall_phase": 0.005}


@cache
def bench(*, errors: bool = True) -> Bench:
    par: Any = CONTROLLER.parameters
    return Bench(CONTROLLER, malta.plant_of(replace(par, **TRUE)), ERRORS if errors else {}, 0)


def found_in(step: str, *, errors: bool = True) -> dict[str, Interval95]:
    one = next(one for one in steps_of(PLANT, {}) if one.name == step)
    return {
        finding.name: finding.found for finding in one.judge(CONTROLLER, one.record(bench(errors=errors)))
    }


def holds(found: Interval95, truth: float, times: float = 1.5) -> bool:
    """Whether a truth is near an interval of 95 %: 1.5 times it has 99.7 %."""
    return abs(found.value - truth) < times * found.half


def a_log(t: Any, **columns: tuple[list[str], Any]) -> malta.identification.Log:
    signals = {
        g: tuple(malta.model.Signal(n, "m" if g == "y" else "N") for n in names)
        for g, (names, _) in columns.items()
    }
    return malta.identification.Log(
        "made", "", "", float(t[1]), 0.0, t, {g: table for g, (_, table) in columns.items()}, signals
    )


@pytest.mark.slow
def test_a_ring_tells_gains_cross_talk_and_offsets() -> None:
    """Intervals of five figures over 30 runs: 150 of them, of which 95 % hold the truth."""
    E, offset, r, inside = np.array([[1.03, 0.01], [0.01, 0.98]]), np.array([4e-6, -7e-6]), 0.6e-3, 0
    truth = [0.03, -0.02, 0.01, *offset]
    t = 1e-3 * np.arange(2000)
    for seed in range(30):
        angle = 20 * t + 0.3 * np.sin(5 * t)
        p = r * np.column_stack([np.cos(angle), np.sin(angle)])
        y = p @ E.T + offset + np.random.default_rng(seed).normal(0, 1e-6, p.shape)
        found = calibration.ring(a_log(t, y=(["a", "b"], y)), ("a", "b"), r)
        inside += sum(holds(one, value, 1.0) for one, value in zip(found, truth, strict=True))
    assert 134 <= inside <= 149
    with pytest.raises(CheckError, match=r"leaves 1.. degrees of the ring out"):
        calibration.ring(a_log(t[:200], y=(["a", "b"], y[:200])), ("a", "b"), r)


@pytest.mark.slow
def test_quadrature_needs_a_period_and_finds_its_errors() -> None:
    inside, phase = 0, np.linspace(0, 6.5, 1500)
    for seed in range(30):
        noise = np.random.default_rng(seed).normal(0, 5e-3, (2, len(phase)))
        cosine = 2 * (np.cos(phase) + 0.01 + noise[0])
        found = calibration.quadrature(cosine, 2 * (1.05 * np.sin(phase - 0.02) - 0.02 + noise[1]))
        inside += sum(holds(e, v, 1.0) for e, v in zip(found, (0.05, -0.02, 0.01, -0.02), strict=True))
    assert 106 <= inside <= 119
    with pytest.raises(CheckError, match="degrees of a period"):
        calibration.quadrature(np.cos(phase[:900]), np.sin(phase[:900]))


def test_rest_is_judged_by_its_noise_and_not_by_what_rolls() -> None:
    t, random = 1e-4 * np.arange(4000), np.random.default_rng(1)
    y = 5e-6 + random.normal(0, 1e-6, (4000, 1))
    log = a_log(t, y=(["a"], y + 20e-6 * np.sin(30 * t)[:, None]))
    mean, deviation = calibration.at_rest(log)["a"]
    assert holds(deviation, 1e-6)
    assert deviation.half < 5e-8
    assert holds(mean, 5e-6)
    with pytest.raises(InputError, match="no such columns"):
        calibration.at_rest(log, "i")
    with pytest.raises(CheckError, match="100 samples, at least 200"):
        calibration.at_rest(a_log(t[:100], y=(["a"], y[:100])))


def test_polarity_is_the_sign_of_a_slope() -> None:
    t, random = 1e-3 * np.arange(2000), np.random.default_rng(2)
    u = np.sign(np.cos(2 * np.pi * 25 * t))[:, None]
    y = -3e-6 * u + random.normal(0, 1e-6, u.shape)
    found = calibration.slope(a_log(t, y=(["a"], y), v=(["f"], u)), ("v", "f"), "a")
    assert (holds(found, -3e-6), found.unit) == (True, "m/N")
    assert found.value < -10 * found.half
    with pytest.raises(CheckError, match="f has no pulses"):
        calibration.slope(a_log(t, y=(["a"], y), v=(["f"], u * (t > 1)[:, None])), ("v", "f"), "a")


@pytest.mark.slow
def test_the_ring_of_the_machine_reads_its_sensors() -> None:
    found = found_in("ring")
    for name, truth in (
        ("gain of x1", 0.02),
        ("gain of y2", 0.0),
        ("offset of x1", 5e-6),
        ("offset of y1", 0.0),
    ):
        assert holds(found[name], truth)
    assert all(
        found[f"{s} by f{s[0]}_B{s[1]}"].value > found[f"{s} by f{s[0]}_B{s[1]}"].half for s in ("x1", "y2")
    )
    hall = found_in("hall")
    assert holds(hall["hall amplitude"], 0.01)
    assert holds(hall["hall phase"], 0.005)


@pytest.mark.slow
def test_polarity_centre_cogging_and_fall_of_the_machine() -> None:
    thrust = found_in("polarity")["z'' by f_D"]
    assert thrust.value == pytest.approx(1 / 0.36, rel=0.05)
    centre = found_in("centre", errors=False)
    for name, truth in (("x1", 8e-6), ("y1", -5e-6), ("x2", 8e-6), ("y2", -5e-6)):
        assert centre[f"magnetic centre, {name}"].value == pytest.approx(truth, abs=0.2e-6)
    assert centre["K_A / K_B over the gain file's"].value == pytest.approx(9000 / 8626.7, rel=3e-3)
    cogging = found_in("cogging")
    assert holds(cogging["cogging"], 0.6)
    assert holds(cogging["phase of the cogging"], 0.3)
    assert holds(found_in("drop")["unstable pole over the gain file's"], math.sqrt(9000 / 8626.7))


def made_steps(limit: float, flown: list[str]) -> tuple[Check, ...]:
    """Two steps that record without a machine, and note that they did; the second has a limit.

    A limit may be a whole number: the journal that keeps it stays the one that was signed.
    """

    def record(name: str, _: Bench) -> malta.identification.Log:
        flown.append(name)
        return a_log(1e-3 * np.arange(400), y=(["a"], np.random.default_rng(0).normal(0, 1, (400, 1))))

    def judge(high: float, _: Any, log: malta.identification.Log) -> Sequence[StepFinding]:
        return [StepFinding("noise", calibration.at_rest(log)["a"][1], 0, high)]

    from functools import partial

    return tuple(
        Check(name, f"Is {name} quiet?", "nothing", "nothing", partial(record, name), partial(judge, high))
        for name, high in (("one", math.inf), ("two", limit))
    )


def test_a_day_goes_on_where_it_stopped(tmp_path: Path) -> None:
    flown: list[str] = []
    first = commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(0.5, flown))
    assert (first.passed, [e.passed for e in first.entries]) == (False, [True, False])
    again = commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(2.0, flown))
    assert (again.passed, again.kept, flown) == (True, ("one",), ["one", "two", "two"])
    assert again.signature != first.signature
    assert read_journal(tmp_path / JOURNAL) == (again, again.signature)
    assert "two passed" in str(again)
    # A log that was changed is recorded anew; another machine begins anew.
    (tmp_path / "one.npz").write_bytes(b"changed")
    assert commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(2.0, flown)).kept == ("two",)
    assert commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(2.0, flown), seed=1).kept == ()


def test_a_journal_that_was_written_over_is_refused(tmp_path: Path) -> None:
    commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(0.5, []))
    journal = tmp_path / JOURNAL
    journal.write_text(journal.read_text().replace('"high": 0.5', '"high": 5.0'))
    with pytest.raises(InputError, match="signature"):
        commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(0.5, []))
    for text in ("{}", "[]", "no", '{"entries": [1]}', 100_000 * "["):
        journal.write_text(text)
        with pytest.raises(InputError, match="no journal"):
            read_journal(journal)


def test_logs_are_in_a_folder(tmp_path: Path) -> None:
    for place in (tmp_path / "nowhere", ROBUST):
        with pytest.raises(InputError, match="no such folder"):
            commission(ROBUST, CONTROLLER, tmp_path, logs=place)


def test_logs_of_a_bench_are_judged_and_waited_for(tmp_path: Path) -> None:
    steps = made_steps(2.0, [])
    malta.identification.write_log(steps[0].record(bench()), tmp_path / "one.csv")
    done = commission(ROBUST, CONTROLLER, tmp_path / "day", steps=steps, logs=tmp_path)
    assert [entry.passed for entry in done.entries] == [True, False]
    assert "waits for" in done.entries[1].refusal
    text, page = binder_text(done), binder_page(done).html
    for said in (done.signature, "waits for", "two: Is two quiet? FAILED", done.entries[0].sha256):
        assert said in text
    assert done.signature in page


def test_the_binder_shows_what_was_logged(tmp_path: Path) -> None:
    """Signals of one unit share a panel; a log that is gone has no picture."""
    done = commission(ROBUST, CONTROLLER, tmp_path, steps=made_steps(2.0, []))
    (tmp_path / "two.npz").unlink()
    pictures = step_pictures(done, CONTROLLER, {})
    assert [*pictures] == ["one"]
    (picture,) = pictures["one"]
    assert isinstance(picture, Illustration)
    (axes,) = picture.draw().axes
    low, high = axes.get_ylim()
    assert low < -2 < 2 < high < 6  # of 400 readings, sigma 1 m
    assert binder_page(done, pictures).html.count("<figure>") == 1


def test_a_missing_log_is_left_out_or_its_step_gone_alone(tmp_path: Path) -> None:
    """What the journal has of other steps stays; a name that no step has is refused with those that there are."""
    steps, day = made_steps(2.0, []), tmp_path / "day"
    malta.identification.write_log(steps[1].record(bench()), tmp_path / "two.csv")
    done = commission(ROBUST, CONTROLLER, day, steps=steps, logs=tmp_path, skip=["one"])
    assert ([entry.name for entry in done.entries], done.left) == (["two"], ("one",))
    assert done.failed is None
    assert not done.passed
    malta.identification.write_log(steps[0].record(bench()), tmp_path / "one.csv")
    done = commission(ROBUST, CONTROLLER, day, steps=steps, logs=tmp_path, only=["one"])
    assert ([entry.name for entry in done.entries], done.kept) == (["one", "two"], ("two",))
    assert done.passed
    (tmp_path / "one.csv").unlink()
    failed = commission(ROBUST, CONTROLLER, day, steps=steps, logs=tmp_path, only=["one"])
    assert ([entry.passed for entry in failed.entries], failed.kept) == ([False, True], ("two",))
    malta.identification.write_log(steps[0].record(bench()), tmp_path / "one.csv")
    assert commission(ROBUST, CONTROLLER, day, steps=steps, logs=tmp_path, only=["one"]).passed
    with pytest.raises(InputError, match="--step: found 'on', expected one of one two"):
        commission(ROBUST, CONTROLLER, day, steps=steps, only=["on"])


def test_a_finding_holds_where_all_of_its_interval_does() -> None:
    assert StepFinding("a", Interval95(1.0, 0.1), 0.9, 1.2).holds
    assert not StepFinding("a", Interval95(1.0, 0.3), 0.9, 1.2).holds
    assert not StepFinding("a", Interval95(math.nan, 0.0), 0.0, 1.0).holds


def test_noise_of_phase_currents_is_that_of_the_forces() -> None:
    """By (16) of white noise in each phase: 2/3 in a bearing axis, sqrt(2)/3 in a thrust axis of each module."""
    par: Any = replace(PLANT.parameters, s_i=14e-3)
    found = process_noise(malta.plant_of(par), dc_log(malta.plant_of(par), "robust", 5e-5, seed=3))
    assert list(found) == [s.name for s in PLANT.inputs]
    for name in ("fx_B1", "fy_B1", "fx_B2", "fy_B2"):
        assert holds(found[name], par.K_B * 2 / 3 * par.s_i)
    assert holds(found["f_D"], par.K_D * math.sqrt(2) * math.sqrt(2) / 3 * par.s_i)


def test_noise_of_coil_currents_is_that_of_the_forces_where_the_machine_is_held() -> None:
    """A log of coils whose forces are not linear: the slope of the ball's force at the current that holds it."""
    malta.machine("examples/ball/ball.py")
    ball = malta.plant_of(malta.read("examples/ball/ball.toml"))
    t, random = 1e-4 * np.arange(20_000), np.random.default_rng(0)
    coils = tuple(s.name for s in ball.actuator.coils)
    i = 1.0 + random.normal(0, 2e-3, (len(t), len(coils)))
    log = a_log(t, y=(["y"], 0 * t[:, None]))
    log = replace(log, columns={**log.columns, "i": i}, signals={**log.signals, "i": ball.actuator.coils})
    (found,) = process_noise(ball, log).values()
    point = trim(ball)
    held = ca.DM(ball.actuator.currents(ca.DM(outputs_at(ball, point.x)), ca.DM(point.v)))
    ends = [float(ca.DM(ball.actuator.forces(ca.DM(point.x), held + way * 1e-6))) for way in (1, -1)]
    assert holds(found, abs(ends[0] - ends[1]) / 2e-6 * 2e-3)


def test_a_machine_without_current_sensors_says_so() -> None:
    ((only, found),) = found_in("noise").items()
    assert PLANT.drive.sensors is None
    assert only == "no current sensors: the largest process noise that the gain file has"
    assert found.unit == "N"


def test_the_noise_that_is_written_is_read_by_a_design(tmp_path: Path) -> None:
    process = {s.name: Interval95(0.05 + 0.001 * k, 0.0, "N") for k, s in enumerate(PLANT.inputs)}
    sensor = {s.name: Interval95(1e-7 * (k + 1), 0.0, "m") for k, s in enumerate(PLANT.outputs)}
    text = Path("design/table2.toml").read_text().replace("../data", str(Path("data").resolve()))
    begin, end = text.index("[noise]"), text.index("sensor = { published")
    rest = text[end:].partition("\n")[2]
    path = tmp_path / "measured.toml"
    path.write_text(text[:begin] + noise_table(process, sensor, "made") + rest)
    spec: Any = malta.read_design(path)
    weights = spec.law
    assert np.sqrt(weights.process_variance) == pytest.approx([e.value for e in process.values()], rel=1e-4)
    assert np.sqrt(weights.sensor_variance) == pytest.approx([e.value for e in sensor.values()], rel=1e-4)


@pytest.mark.slow
def test_closed_current_loops_have_the_noise_of_table_ii() -> None:
    """13.8 mA in each sensor: 9.71 mA in a bearing axis (2.55e-3 N^2) and 6.77 mA in a thrust axis, within 2 %."""
    par: Any = replace(PLANT.parameters, s_i=13.8e-3)
    step = next(one for one in steps_of(PLANT, {}) if one.name == "noise")
    log = step.record(Bench(CONTROLLER, malta.plant_of(par), {}, 0))
    axes = {name: deviation for name, (_, deviation) in calibration.at_rest(log, "i", still=True).items()}
    for name, wanted in (("i_dd1", 9.71e-3), ("i_qd2", 9.71e-3), ("i_0q1", 6.77e-3), ("i_0q2", 6.77e-3)):
        assert axes[name].value == pytest.approx(wanted, rel=0.02)
    found = {finding.name: finding.found for finding in step.judge(CONTROLLER, log)}
    for name in ("fx_B1", "fy_B1", "fx_B2", "fy_B2"):
        assert found[f"noise of {name}"].value ** 2 == pytest.approx(2.55e-3, rel=0.04)


@pytest.mark.slow
def test_commission_from_the_shell(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measuring, "SAMPLES", 4)
    monkeypatch.setattr(measuring, "CORNERS", 0)
    listed = run("commission", ROBUST, "--plan").out
    assert all(step.name in listed for step in tubular.steps({}))
    failed = run("commission", ROBUST, "--sensor", "gain_x1=0.1", "--out", tmp_path / "bad", "--json")
    assert (failed.code, "step ring failed" in failed.err) == (1, True)
    assert json.loads(failed.out)["left"][0] == "hall"
    said = run("commission", ROBUST, "--set", "K_A=9000", "--out", tmp_path / "day", "--json")
    document = json.loads(said.out)
    assert (said.code, document["passed"], document["left"]) == (0, True, [])
    assert document["signature"] in (tmp_path / "day" / "binder.txt").read_text()
    assert run("commission", ROBUST, "--sensor", "gain_q=1").code == 2


@pytest.mark.parametrize(
    ("gains", "said"),
    [
        ("robust", "an export with --wiring tries"),
        ("halbach", "an export with --wiring --until currents tries"),
        ("planar", ""),
    ],
)
def test_the_plan_names_an_export_that_there_is(gains: str, said: str, run: Run) -> None:
    """`malta export --wiring` refuses `planar`, and `halbach` down to set points."""
    listed = " ".join(run("commission", f"design/gains/{gains}.json", "--plan").out.split())
    assert said in listed
    assert ("--wiring" in listed) == bool(said)


def test_a_log_at_rest_without_a_sensor_is_refused() -> None:
    """A bench's file may lack a column: it is named."""
    scenario = malta.Scenario("still", 0.1, malta.references.hold, noise=1.0)
    log = malta.identification.log_of(malta.simulate(PLANT, CONTROLLER, scenario))
    cut = replace(
        log,
        signals={**log.signals, "y": log.signals["y"][:3]},
        columns={**log.columns, "y": log.columns["y"][:, :3]},
    )
    with pytest.raises(InputError, match="y2: found no such column of y, expected one of x1 y1 x2"):
        judge_noise(CONTROLLER, cut)


def test_mistakes_in_a_benchs_logs_are_named(tmp_path: Path) -> None:
    """Swapped columns, a sign, another unit, and the log of another step are refused whatever a step looks at."""
    plan = malta.excite(malta.loop(PLANT, CONTROLLER), period=0.25, periods=3, band=(8, 400))
    right = log_of(malta.simulate(PLANT, CONTROLLER, malta.Scenario.excited(plan.signal, plan.duration)))
    y = right.columns["y"]
    tables = {"right": y, "swapped": y[:, [1, 0, 2, 3, 4]], "turned": y * [1, 1, 1, 1, -1], "scaled": 1e6 * y}
    for name, table in tables.items():
        found = replace(right, columns={**right.columns, "y": table})
        malta.identification.write_log(found, tmp_path / f"{name}.npz")
    (tmp_path / "copied.npz").write_bytes((tmp_path / "right.npz").read_bytes())
    said = {}
    for name in (*tables, "copied"):
        chosen = dict.fromkeys(("right", name))
        steps = [Check(step, "Is it so?", "", "", lambda _: right, lambda *_: []) for step in chosen]
        done = commission(ROBUST, CONTROLLER, tmp_path / name, steps=steps, logs=tmp_path)
        said[name] = done.entries[-1].refusal
    assert said.pop("right") == ""
    for name, words in (
        ("swapped", "are x1 and y1 swapped?"), ("turned", "z: found the other sign"), ("scaled", "a million times"),
        ("copied", "it is the log of step right"),
    ):  # fmt: skip
        assert words in said[name]
