"""Exported FMUs, simulated by fmpy: the bits of the exported C, and the flight of malta.simulate."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.errors import InputError
from malta.firmware import fmu as module
from malta.firmware.flight import FLAGS
from malta.firmware.fmu import PARTS, Part, build_fmu, unit_of
from malta.firmware.machine import FirmwareMachine, command_field
from malta.firmware.program import Precision
from malta.firmware.signals import Target, fidelity_of
from malta.firmware.supervised_flight import Flown, Requests, supervised_engine
from malta.firmware.supervisor import MONITORS, STATES
from malta.firmware.supervisor_text import NUMBERS
from malta.machines.tubular.experiments.lifting import rest_on_bearing
from malta.simulation import references
from malta.simulation.engine.compiled import compiler
from malta.simulation.steps import KINKED_STEPS, choose_steps

pytestmark = pytest.mark.usefixtures("proven_once")

fmpy = pytest.importorskip("fmpy")
if compiler() is None:
    pytest.skip("no C compiler", allow_module_level=True)

SHA256 = "5" * 64
WARNINGS = ("-Werror", "-Wall", "-Wextra", "-Wpedantic", "-Wshadow", "-Wconversion", "-Wundef")
BOTH = pytest.mark.parametrize("fmi", [2, pytest.param(3, marks=pytest.mark.slow)])


@lru_cache
def target(name: str, precision: Precision = "double", fidelity: Any = None) -> Target:
    c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    return Target(c, precision, fidelity or fidelity_of(malta.plant_of(c.parameters)))


@lru_cache
def content(t: Target, part: Part, fmi: int) -> bytes:
    fmu = build_fmu(t, SHA256, part=part, fmi=fmi)
    assert fmu.note == ""
    return fmu.content


class Unit:
    """An instance of an FMU; its groups of variables are vectors."""

    def __init__(self, folder: Path) -> None:
        from fmpy.fmi2 import FMU2Slave
        from fmpy.fmi3 import FMU3Slave

        d = fmpy.read_model_description(folder, validate=False)
        self.second = d.fmiVersion == "2.0"
        kind = FMU2Slave if self.second else FMU3Slave
        self.fmu = kind(
            guid=d.guid,
            unzipDirectory=str(folder),
            modelIdentifier=d.coSimulation.modelIdentifier,
            instanceName="unit",
        )
        self.fmu.instantiate()
        self.step = float(d.defaultExperiment.stepSize)
        self.samples = 0.0
        self.groups: dict[str, list[int]] = {}
        for v in d.modelVariables:
            group = v.name.split(".")[0]
            self.groups.setdefault(group, []).append(v.valueReference)
            if group != v.name:
                self.groups[v.name] = [v.valueReference]

    def set(self, group: str, values: Any) -> None:
        call = self.fmu.setReal if self.second else self.fmu.setFloat64
        call(self.groups[group], np.ravel(values).tolist())

    def get(self, group: str) -> Any:
        call = self.fmu.getReal if self.second else self.fmu.getFloat64
        return np.array(call(self.groups[group]))

    def refer(self, motion: Any, k: int) -> None:
        for name in ("p", "dp", "ddp"):
            self.set(f"{name}_ref", getattr(motion, name)[k])

    def begin(self) -> None:
        if self.second:
            self.fmu.setupExperiment(startTime=0.0)
            self.fmu.enterInitializationMode()
        else:
            self.fmu.enterInitializationMode(startTime=0.0)

    def start(self) -> None:
        self.fmu.exitInitializationMode()

    def advance(self, samples: float = 1) -> None:
        self.fmu.doStep(self.samples * self.step, samples * self.step)
        self.samples += samples


@pytest.fixture
def instance(tmp_path: Path) -> Iterator[Callable[..., Unit]]:
    """Makes instances of FMUs, and frees them."""
    units: list[Unit] = []

    def make(t: Target, part: Part, fmi: int, again: bool = False) -> Unit:
        folder = tmp_path / f"{part}{fmi}"
        if not again:
            with zipfile.ZipFile(io.BytesIO(content(t, part, fmi))) as archive:
                archive.extractall(folder)
        units.append(Unit(folder))
        return units[-1]

    yield make
    for unit in units:
        unit.fmu.freeInstance()


def scenario(t: Target, **options: Any) -> malta.Scenario:
    """A stroke, without noise, in the steps of an FMU's machine, whose master may push it as it likes."""
    plant = t.believed
    if plant.name == "tubular":
        s = malta.Scenario.stroke(10e-3, fidelity=t.fidelity, duration=0.1, **options)
        return s.replace(substeps=max(KINKED_STEPS, choose_steps(plant, t.controller, s).count))
    if plant.has_stroke:
        rise = 40 * t.controller.sample_time
        return malta.Scenario.stroke(1e-3, fidelity=t.fidelity, rise=rise, duration=3 * rise, **options)
    return malta.Scenario("hold", 0.02, references.hold, fidelity=t.fidelity, **options)


def silent(t: Target) -> malta.model.Plant:
    """The machine without noise of its electronics."""
    par: Any = t.believed.parameters
    return t.believed.variant(replace(par, s_adc=0.0)) if t.has_set_points else t.believed


def fly(unit: Unit, run: Any, motion: Any) -> float:
    """The largest distance of a loop from a run, m."""
    far = 0.0
    for k in range(len(run.t)):
        far = max(far, float(np.abs(unit.get("p") - run.p[k]).max()))
        unit.refer(motion, k)
        unit.advance()
    return far


FLIGHTS = [
    ("halbach_late", None, 3),
    *(
        pytest.param(*case, marks=pytest.mark.slow)
        for case in (("halbach", None, 2), ("robust", None, 3), ("robust", "dq", 2), ("tubular_pid", None, 2))
    ),
]


@pytest.mark.slow_for("halbach_late-None-3")
@pytest.mark.parametrize(("name", "fidelity", "fmi"), FLIGHTS)
def test_loop_and_pair_fly_as_simulated(
    name: str, fidelity: Any, fmi: int, instance: Callable[..., Unit]
) -> None:
    """One FMU of both; two that a master steps one after the other; and a controller with the exported C's bits."""
    t = target(name, "double", fidelity)
    s, plant = scenario(t), silent(t)
    run = malta.simulate(plant, t.controller, s)
    flown = malta.simulate(plant, t.controller, s, engine=malta.firmware.engine_of_c())
    assert run.verdict.completed
    motion = s.reference(plant)(run.t)
    loop = instance(t, "loop", fmi)
    loop.begin()
    loop.refer(motion, 0)
    loop.start()
    assert fly(loop, run, motion) < 1e-12

    one, other, alone = instance(t, "controller", fmi), instance(t, "machine", fmi), None
    alone = instance(t, "controller", fmi, again=True)
    for unit in (one, alone):
        unit.begin()
        unit.refer(motion, 0)
        unit.start()
    other.begin()
    other.set("x_start", run.x[0])
    other.start()
    far, command = 0.0, command_field(t).name
    for k in range(len(run.t)):
        far = max(far, float(np.abs(other.get("p") - run.p[k]).max()))
        for unit, values in ((one, other.get), (alone, lambda group, k=k: known(flown, t, group, k))):
            unit.refer(motion, k)
            for group in ("y", "i", "link") if t.driven else ("y",):
                unit.set(group, values(group))
            unit.advance()
        other.set(command, one.get(command))
        other.advance()
        for group in ("v", "current", "xi_hat"):
            assert np.array_equal(alone.get(group), getattr(flown, group)[k]), (group, k)
        if t.fidelity == "phase" and t.driven:
            np.testing.assert_allclose(alone.get("command"), flown.duty[k], rtol=0, atol=1e-14)
    assert far < 1e-12


def known(run: Any, t: Target, group: str, k: int) -> Any:
    """What a controller read at a sample of a run."""
    return getattr(run, "i_phase" if group == "i" and t.fidelity == "phase" else group)[k]


def fly_loop(instance: Callable[..., Unit], t: Target, s: malta.Scenario, run: Any) -> float:
    """How far the exported loop is from a run of a scenario, from its first sample on."""
    motion = s.reference(t.believed)(run.t)
    loop = instance(t, "loop", 2)
    loop.begin()
    loop.refer(motion, 0)
    loop.start()
    return fly(loop, run, motion)


@pytest.mark.slow
def test_single_precision_flies_as_the_exported_c(instance: Callable[..., Unit]) -> None:
    t = target("robust", "float")
    s = scenario(t)
    flown = malta.simulate(t.believed, t.controller, s, engine=malta.firmware.engine_of_c("float"))
    assert fly_loop(instance, t, s, flown) < 1e-9


@pytest.mark.parametrize("T_d", [61e-6, pytest.param(90e-6, marks=pytest.mark.slow)])
def test_commands_begin_to_act_within_a_sample(T_d: float, instance: Callable[..., Unit]) -> None:
    """Of 0.72 and 1.3 samples of computation; a machine alone takes the commands of the run."""
    c = target("robust").controller
    par: Any = c.parameters
    t = Target(replace(c, parameters=replace(par, T_d=T_d)), "double", "dq")
    s = scenario(t)
    run = malta.simulate(t.believed, t.controller, s)
    usual = malta.simulate(target("robust").believed, c, s)
    assert fly_loop(instance, t, s, run) < 1e-12
    assert np.abs(run.p - usual.p[: len(run.p)]).max() > 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", ["phase", "dq"])
def test_sensors_with_lag_dead_time_and_offsets_are_part_of_the_machine(
    fidelity: Any, instance: Callable[..., Unit]
) -> None:
    c = target("robust").controller
    par: Any = c.parameters
    late = replace(c, parameters=replace(par, T_s=80e-6, tau_s=30e-6, d_i=0.01))
    t = Target(late, "double", fidelity)
    s = scenario(t)
    run = malta.simulate(t.believed, late, s)
    ideal = malta.simulate(target("robust").believed, c, s)
    assert fly_loop(instance, t, s, run) < 1e-12
    assert np.abs(run.p - ideal.p[: len(run.p)]).max() > 1e-7


@pytest.mark.slow_for("robust-m")
@pytest.mark.parametrize(
    ("name", "parameter"),
    [
        ("robust", "m"),
        *(pytest.param("robust", key, marks=pytest.mark.slow) for key in ("I_yy", "K_A", "l_S", "R", "s_z")),
        pytest.param("halbach", "A", marks=pytest.mark.slow),
    ],
)
def test_a_machine_with_another_parameter_flies_as_simulated(
    name: str, parameter: str, instance: Callable[..., Unit]
) -> None:
    """One of them 10 % larger than the gain file's, and noise of the sensors."""
    t = target(name)
    par: Any = silent(t).parameters
    value = 1.1 * getattr(par, parameter)
    other = t.believed.variant(replace(par, **{parameter: value}))
    noise = 0.0 if other.sensors.uniform else 1.0
    s = scenario(t, noise=noise, seed=3)
    run = malta.simulate(other, t.controller, s)
    usual = malta.simulate(silent(t), t.controller, s)
    motion = s.reference(other)(run.t)
    loop = instance(t, "loop", 2)
    loop.begin()
    loop.set(f"machine.{parameter}", [value])
    if noise:
        loop.set("noise", [1.0])
        loop.set("seed", [3.0])
    loop.refer(motion, 0)
    loop.start()
    assert fly(loop, run, motion) < 1e-12
    assert np.abs(run.p - usual.p[: len(run.p)]).max() > 1e-9


@pytest.mark.slow
def test_a_machine_changes_in_flight_as_simulated(instance: Callable[..., Unit]) -> None:
    """A payload of 0.1 kg that is picked up: a parameter that is set between steps."""
    t = target("robust")
    par: Any = t.believed.parameters
    heavier = par.m + 0.1
    s = malta.Scenario("payload", 0.02, references.hold, fidelity="phase", changes=((0.005, {"m": heavier}),))
    run = malta.simulate(t.believed, t.controller, s)
    loop = instance(t, "loop", 3)
    loop.begin()
    loop.start()
    far = 0.0
    for k, time in enumerate(run.t):
        if time >= 0.005:
            loop.set("machine.m", [heavier])
        far = max(far, float(np.abs(loop.get("p") - run.p[k]).max()))
        loop.advance()
    assert float(np.abs(run.p).max()) > 5e-6
    assert far < 1e-12


def commission(supervised: Unit, machine: Unit, samples: int) -> tuple[Any, Any]:
    """States and readings of a supervisor's flight from rest: started, and asked to land after 350 ms."""
    states, places = [], []
    for k in range(samples):
        states.append(int(supervised.get("supervisor.state")[0]))
        places.append(machine.get("p"))
        for group in ("y", "i", "link"):
            supervised.set(group, machine.get(group))
        supervised.set("request.start", [float(k == 1)])
        supervised.set("request.operate", [1.0])
        supervised.set("request.land", [float(k >= 7000)])
        supervised.advance()
        machine.set("command", supervised.get("command"))
        machine.advance()
    return np.array(states), np.array(places)


@pytest.mark.slow
def test_a_supervisor_lifts_its_machine_off_the_bearing_and_lands_it(instance: Callable[..., Unit]) -> None:
    """Two FMUs from rest on the touchdown bearing: the flight of the simulation with the exported supervisor."""
    t = target("robust")
    start = rest_on_bearing(t.believed) | {"z": 0.0}
    s = malta.Scenario(
        "lift",
        0.6,
        references.hold,
        start=start,
        cold=True,
        bearing=True,
        fidelity="phase",
        noise=1.0,
        seed=5,
    )
    flights: list[Flown] = []
    engine = supervised_engine(flights, Requests(land=0.35))
    run = malta.simulate(t.believed, t.controller, s, engine=engine)
    supervised, machine = instance(t, "supervised", 3), instance(t, "machine", 3)
    supervised.begin()
    supervised.start()
    machine.begin()
    machine.set("x_start", run.x[0])
    machine.set("cold", [1.0])
    machine.set("noise", [1.0])
    machine.set("seed", [5.0])
    machine.start()
    states, places = commission(supervised, machine, len(run.t))
    passed = [int(state) for state in states[np.flatnonzero(np.diff(states, prepend=-1))]]
    names = ["OFF", "OFFSETS", "SENSORS", "LIFT", "SETTLE", "OPERATE", "LANDING", "OFF"]
    assert [list(STATES)[state] for state in passed] == names
    assert machine.get("contact")[0] > 1  # it lies on its bearing again
    assert np.abs(places[0][[1, 3]] - places[-1][[1, 3]]).max() < 2e-6
    flying = states == NUMBERS["OPERATE"]
    assert np.abs(places[flying][:, :4]).max() < 5e-6
    assert np.abs(places - run.p).max() < 1e-9


@pytest.mark.slow
def test_a_supervisor_takes_over_a_machine_that_flies(instance: Callable[..., Unit]) -> None:
    t = target("robust")
    supervised, machine = instance(t, "supervised", 2), instance(t, "machine", 2)
    supervised.begin()
    supervised.set("flying", [1.0])
    supervised.start()
    machine.begin()
    machine.set("noise", [1.0])
    machine.start()
    assert int(supervised.get("supervisor.state")[0]) == NUMBERS["OPERATE"]
    assert int(supervised.get("supervisor.enable")[0]) == 1
    for k in range(200):
        for group in ("y", "i", "link"):
            supervised.set(group, machine.get(group))
        supervised.set("request.sto", [float(k == 199)])
        supervised.advance()
        machine.set("command", supervised.get("command"))
        machine.advance()
    assert np.abs(machine.get("p")[:4]).max() < 5e-6
    assert int(supervised.get("supervisor.state")[0]) == NUMBERS["FAULT"]
    assert int(supervised.get("supervisor.monitor")[0]) == MONITORS.index("STO")
    assert int(supervised.get("supervisor.enable")[0]) == 0
    assert np.array_equal(supervised.get("command"), np.full(18, 0.5))


@pytest.mark.slow
def test_a_wrench_and_another_start_act_as_simulated(instance: Callable[..., Unit]) -> None:
    t = target("robust")
    push = np.array([0.0, 2.0, 0.0, 0.0, 0.01, 0.0])
    s = malta.Scenario(
        "push",
        0.02,
        references.hold,
        start={"y": 20e-6},
        fidelity="phase",
        disturbance=lambda times: np.outer(times >= 0.005, push),
    )
    run = malta.simulate(t.believed, t.controller, s)
    loop = instance(t, "loop", 3)
    loop.begin()
    loop.set("offset", [20e-6 if state.name == "y" else 0.0 for state in t.believed.states])
    loop.start()
    far = 0.0
    for k, time in enumerate(run.t):
        far = max(far, float(np.abs(loop.get("p") - run.p[k]).max()))
        loop.set("w", push if time >= 0.005 else 0 * push)
        loop.advance()
    assert float(np.abs(run.p).max()) > 15e-6
    assert far < 1e-12


@pytest.mark.slow
def test_a_master_that_steps_both_at_once_makes_the_delay_itself(instance: Callable[..., Unit]) -> None:
    """With late = 0: commands act one sample after they are computed, as they do with late = 1 one after the other."""
    t = target("robust")
    push = np.array([0.0, 2.0, 0.0, 0.0, 0.01, 0.0])
    s = malta.Scenario(
        "push", 0.01, references.hold, fidelity="phase", disturbance=lambda k: np.outer(k >= 0.002, push)
    )
    run = malta.simulate(t.believed, t.controller, s)
    controller, machine = instance(t, "controller", 3), instance(t, "machine", 3)
    controller.begin()
    controller.start()
    machine.begin()
    machine.set("late", [0.0])
    machine.start()
    far, command = 0.0, np.empty(0)
    for k, time in enumerate(run.t):
        far = max(far, float(np.abs(machine.get("p") - run.p[k]).max()))
        for group in ("y", "i", "link"):
            controller.set(group, machine.get(group))
        if k:  # before, the machine holds the commands that it starts with
            machine.set("command", command)
        machine.set("w", push if time >= 0.002 else 0 * push)
        controller.advance()
        machine.advance()
        command = controller.get("command")
    assert float(np.abs(run.p).max()) > 5e-6
    assert far < 1e-12


@pytest.mark.slow_for("2")
@BOTH
def test_fmpy_simulates_a_stroke(fmi: int, tmp_path: Path) -> None:
    """The whole way of an importing tool: a file, inputs as signals, a table of outputs."""
    t = target("halbach")
    s = scenario(t)
    run = malta.simulate(silent(t), t.controller, s)
    motion = s.reference(t.believed)(run.t)
    columns = [("time", run.t), *((f"{n}_ref.x", getattr(motion, n)[:, 0]) for n in ("p", "dp", "ddp"))]
    columns.append(("w.F_x", np.zeros(len(run.t))))
    signals = np.array(
        list(zip(*(c for _, c in columns), strict=True)), dtype=[(n, float) for n, _ in columns]
    )
    path = tmp_path / "loop.fmu"
    path.write_bytes(content(t, "loop", fmi))
    found = fmpy.simulate_fmu(
        str(path),
        stop_time=run.t[-1],
        output_interval=t.controller.sample_time,
        input=signals,
        output=["p.x", "contact.left_the_travel", "y_used.x"],
    )
    assert len(found) == len(run.t)
    assert np.abs(found["p.x"] - run.p[:, 0]).max() < 1e-12
    assert 0 < found["contact.left_the_travel"].max() < 1


@pytest.mark.slow_for(
    "robust-phase-2-controller", "robust-phase-2-supervised", "robust-phase-2-machine", "robust-phase-2-loop"
)
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(
    ("name", "fidelity", "fmi"),
    [
        ("robust", "phase", 2),
        pytest.param("robust", "phase", 3, marks=pytest.mark.slow),
        pytest.param("halbach", "phase", 2, marks=pytest.mark.slow),
        pytest.param("robust", "dq", 3, marks=pytest.mark.slow),
        pytest.param("tubular_pid", "force", 2, marks=pytest.mark.slow),
    ],
)
def test_validation_finds_nothing(
    name: str, fidelity: Any, part: Part, fmi: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Here without a binary, of which a sentence tells."""
    from fmpy.validation import validate_fmu

    monkeypatch.setattr(module, "shared_library", lambda *_: None)
    path = tmp_path / "unit.fmu"
    content, note = build_fmu(target(name, "float", fidelity), SHA256, part=part, fmi=fmi)
    path.write_bytes(content)
    assert "without a binary, because no C compiler works here" in note
    assert validate_fmu(str(path)) == []
    d = fmpy.read_model_description(path)
    units = {u.name: u.baseUnit for u in d.unitDefinitions}
    assert (units["N"].kg, units["N"].m, units["N"].s) == (1, 1, -2)
    causalities = {v.name: (v.causality, v.variability, v.unit) for v in d.modelVariables}
    if part != "machine" and name == "robust":
        assert causalities["v.f_D"] == ("output", "discrete", "N")
    if part in ("machine", "loop") and name == "robust":
        assert causalities["p.z"] == ("output", "continuous", "m")
        assert causalities["w.T_z"] == ("input", "continuous", "N m")


@pytest.mark.slow
def test_the_same_gain_file_gives_the_same_bytes() -> None:
    t, other = target("halbach"), target("halbach_late")
    again = build_fmu(Target(t.controller, "double", t.fidelity), SHA256, part="loop", fmi=2)
    assert again.content == content(t, "loop", 2)
    tokens = []
    for data in (content(t, "loop", 2), content(t, "loop", 3), content(other, "loop", 3)):
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}
            assert archive.namelist() == sorted(archive.namelist())
        tokens.append(fmpy.read_model_description(io.BytesIO(data)).guid)
    assert len(set(tokens)) == 3
    assert all(len(token) == 64 for token in tokens)


@BOTH
def test_states_are_taken_put_back_written_and_read(fmi: int, instance: Callable[..., Unit]) -> None:
    t = target("halbach")
    loop, twin = instance(t, "loop", fmi), instance(t, "loop", fmi, again=True)
    calls = ["getFMUState", "setFMUState", "serializeFMUState", "deserializeFMUState", "freeFMUState"]
    take, put, write, read, free = (
        getattr(
            loop.fmu,
            c if fmi == 3 else c.replace("deserialize", "deSerialize").replace("State", "state"),
            None,
        )
        or getattr(loop.fmu, c)
        for c in calls
    )
    for unit in (loop, twin):
        unit.begin()
        unit.start()
        unit.set("p_ref", [1e-4])
        unit.advance()
    loop.advance()
    state = take()
    data = write(state)
    twin.advance(2)
    loop.advance()
    later = loop.get("x")
    assert np.array_equal(later, twin.get("x"))
    put(state)
    assert not np.array_equal(loop.get("x"), later)
    loop.samples -= 1
    loop.advance()
    assert np.array_equal(loop.get("x"), later)
    free(state)
    other = read(data)
    put(other)
    loop.samples -= 1
    loop.advance()
    assert np.array_equal(loop.get("x"), later)
    free(other)
    loop.fmu.reset()
    loop.samples = 0
    loop.begin()
    loop.start()
    assert loop.get("time")[0] == 0
    assert not np.array_equal(loop.get("x"), later)
    for _ in range(2):
        loop.set("p_ref", [1e-4])
        loop.advance()
    loop.advance()
    assert np.array_equal(loop.get("x"), later)
    loop.fmu.terminate()


@pytest.mark.slow_for("2")
@BOTH
def test_what_cannot_be_is_refused_with_a_message(
    fmi: int, instance: Callable[..., Unit], capfd: pytest.CaptureFixture[str]
) -> None:
    from fmpy.fmi1 import FMICallException

    t = target("halbach")
    machine = instance(t, "machine", fmi)
    machine.groups["none"] = [10_000]

    def give_infinity() -> None:
        machine.set("command", [np.inf] * 4)
        machine.advance()

    def check(message: str, action: Callable[[], object]) -> None:
        machine.samples = 0
        with pytest.raises(FMICallException):
            action()
        assert message in capfd.readouterr().out

    check("a step outside of the simulation", machine.advance)
    check("a parameter that is no finite number", lambda: machine.set("x_start", [np.nan, 0]))
    check("a parameter out of its range", lambda: machine.set("machine.m", [-1.0]))
    check("a parameter out of its range", lambda: machine.set("cold", [2.0]))
    check("a value reference that no variable has", lambda: machine.set("none", [0.0]))
    check("a value reference that no variable has", lambda: machine.get("none"))
    check("only inputs and parameters can be set", lambda: machine.set("p", [0.0]))
    machine.begin()
    machine.start()
    check("a parameter is fixed", lambda: machine.set("x_start", [0, 0]))
    check("shorter than a thousandth of the sample time", lambda: machine.advance(1e-4))
    check("shorter than a thousandth of the sample time", lambda: machine.advance(-1))
    check("an input command that is no finite number", give_infinity)
    check("an initialization after the start", machine.begin)
    kind = type(machine.fmu)
    impostor = kind(
        guid="another",
        unzipDirectory=machine.fmu.unzipDirectory,
        modelIdentifier=machine.fmu.modelIdentifier,
        instanceName="impostor",
    )
    with pytest.raises(Exception, match="instantiate"):
        impostor.instantiate()


@pytest.mark.slow_for("2")
@BOTH
def test_gains_are_parameters_of_a_tunable_controller(fmi: int, instance: Callable[..., Unit]) -> None:
    """Set before the start and between two steps; the force is that of the estimate by these gains."""
    from fmpy.fmi1 import FMICallException

    t = replace(target("halbach"), tunable=True)
    unit = instance(t, "controller", fmi)
    K = unit.get("K")
    assert list(K) == [v for v in np.ravel(t.controller.K) if abs(v) != 1]
    unit.set("K.F_x_x", [1.05 * K[0]])
    unit.begin()
    unit.start()
    for scale in (1.05, 0.95):
        unit.set("K", [scale * K[0], K[1]])
        unit.set("y", [1e-4])
        unit.advance()
        x, rate, disturbance = unit.get("xi_hat")
        assert unit.get("v")[0] == pytest.approx(-(scale * K[0] * x + K[1] * rate + disturbance), rel=1e-12)
    with pytest.raises(FMICallException):
        unit.set("K", [1.2 * K[0], K[1]])


@pytest.mark.slow
def test_no_reading_poisons_the_controller(instance: Callable[..., Unit]) -> None:
    """NaN as a reading and as a reference: a step on it commands finite forces, and the next readings count again."""
    t = target("halbach")
    unit, other = instance(t, "controller", 2), instance(t, "controller", 2, again=True)
    for u in (unit, other):
        u.begin()
        u.start()
    unit.set("y", [np.nan])
    unit.set("p_ref", [np.inf])
    unit.advance()
    assert unit.get("refused")[0] == 1
    assert np.isfinite(unit.get("v")).all()
    unit.set("y", [1e-4])
    unit.advance()
    assert unit.get("refused")[0] == 0
    assert np.isfinite(unit.get("v")).all()
    assert unit.get("v")[0] != 0
    assert other.get("v")[0] == 0  # instances know nothing of each other


@pytest.mark.slow
@pytest.mark.parametrize(("part", "fmi"), [("controller", 2), ("machine", 2), ("loop", 3), ("supervised", 3)])
def test_no_compiler_warns_and_fmpy_builds_the_binary_anew(part: Part, fmi: int, tmp_path: Path) -> None:
    from fmpy.build import build_platform_binary

    with zipfile.ZipFile(io.BytesIO(content(target("robust"), part, fmi))) as archive:
        archive.extractall(tmp_path)
    cc = compiler()
    assert cc is not None
    for path in sorted((tmp_path / "sources").glob("*.c")):
        command = [*cc, *FLAGS, *WARNINGS, "-c", str(path), "-o", str(tmp_path / "object")]
        done = subprocess.run(command, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[:2000]
    (binary,) = (tmp_path / "binaries").glob("*/*")
    binary.unlink()
    if shutil.which("cmake") is None:
        pytest.skip("no cmake")
    (tmp_path / "build").mkdir()
    build_platform_binary(tmp_path, build_dir=tmp_path / "build", all_warnings=True)
    unit = Unit(tmp_path)
    unit.begin()
    unit.start()
    unit.advance()
    assert binary.exists()
    unit.fmu.freeInstance()


def test_bad_input_gets_a_sentence() -> None:
    t = target("halbach")
    with pytest.raises(InputError, match="fmi: found 1, expected 2 or 3"):
        build_fmu(t, SHA256, fmi=1)
    planar = target("planar").controller
    par: Any = planar.parameters
    with_table = Target(replace(planar, parameters=replace(par, cells=8)), "double", "force")
    with pytest.raises(InputError, match="whose currents come from a table, expected the controller alone"):
        build_fmu(with_table, SHA256, part="machine")
    part: Any = "rotor"
    with pytest.raises(InputError, match="part: found 'rotor', expected one of controller, supervised"):
        build_fmu(t, SHA256, part=part)


def test_a_machine_takes_as_many_substeps_as_a_simulation() -> None:
    assert FirmwareMachine(target("robust")).substeps == 4
    assert FirmwareMachine(target("halbach")).substeps == pytest.approx(805.664, abs=1e-3)


@pytest.mark.slow_for(
    "planar_pid-machine",
    "planar_pid-loop",
    "robust-machine",
    "robust-loop",
    "tubular_pid-machine",
    "tubular_pid-loop",
)
@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("name", ["halbach", "planar_pid", "robust", "tubular_pid"])
def test_every_signal_has_a_name_and_a_unit_to_wire(name: str, part: Part) -> None:
    """Words in place of numbers, as `command.cos_kx`; a number without a dimension says so."""
    for v in unit_of(target(name), part).variables:
        assert re.fullmatch(r"[A-Za-z]\w*(\.[A-Za-z]\w*)?", v.name), v.name
        assert v.unit, v.name
        assert "set point" not in v.name


@BOTH
def test_a_machine_without_parameters_flies_as_simulated(fmi: int, instance: Callable[..., Unit]) -> None:
    """Known matrices: the parts machine and loop have no group of the machine's parameters."""
    plant = malta.linear_machine([[0, 1], [100, 0]], [[0], [1]], [[1, 0]])
    weights = malta.synthesis.weights(q=[1e4, 1], r=[1], w=[1], v=[1e-8])
    t = Target(malta.lqg(malta.linearize(plant, plant.at()), weights, Ts=1e-3, name="law"), "double", "force")
    hold = malta.Scenario("hold", 0.1, references.hold, {"x1": 1e-3}, fidelity="force")
    run = malta.simulate(plant, t.controller, hold)
    motion = references.hold(plant)(run.t)
    loop, machine = instance(t, "loop", fmi), instance(t, "machine", fmi)
    assert "machine" not in machine.groups
    loop.begin()
    loop.set("offset", run.x[0])
    loop.refer(motion, 0)
    loop.start()
    assert fly(loop, run, motion) < 1e-12


@pytest.mark.parametrize("fmi", [2, 3])
def test_steps_may_be_shorter_than_a_sample_or_end_within_it(fmi: int, instance: Callable[..., Unit]) -> None:
    """Inputs act from the beginning of their sample on, and what they do is seen at its end: the same to the bit."""
    t = target("halbach")
    whole, parts = instance(t, "loop", fmi), instance(t, "loop", fmi, again=True)
    for unit in (whole, parts):
        unit.begin()
        unit.start()
    for k in range(3):
        whole.set("p_ref", [1e-4 * k])
        whole.advance()
    parts.set("p_ref", [0.0])
    parts.advance(0.25)
    parts.set("p_ref", [1e-4])  # in time for the second sample, too late for the first
    parts.advance(0.25)
    assert np.array_equal(parts.get("x"), np.array([0.0, 0.0]))
    parts.advance(1.0)
    parts.set("p_ref", [2e-4])
    parts.advance(0.5)
    state = parts.get("x")
    parts.advance(0.3)
    assert np.array_equal(parts.get("x"), state)
    parts.advance(0.7)
    assert parts.get("time")[0] == pytest.approx(whole.get("time")[0], rel=1e-12)
    assert np.array_equal(parts.get("x"), whole.get("x"))
    assert np.array_equal(parts.get("v"), whole.get("v"))


def test_open_gates_end_the_currents_and_an_end_stop_pushes_back(instance: Callable[..., Unit]) -> None:
    """Commanded to push, with gates off from 2 ms on: the mover coasts into its end stop, and comes back."""
    t = target("robust")
    machine = instance(t, "machine", 3)
    par: Any = t.believed.parameters
    machine.begin()
    machine.set("x_start", [0, 0, 13e-3, 0, 0, 0, 0, 0, 1.0, 0, 0, 0])
    machine.set("cold", [1.0])
    machine.start()
    machine.set("command", 0.5 + 0.2 * np.sin(np.arange(18)))
    machine.advance(40)
    assert np.abs(machine.get("i")).max() > 0.5
    machine.set("gates", [0.0])
    machine.advance()
    assert not machine.get("i").any()
    assert np.abs(machine.get("force")).max() < 1e-9
    z, speed = [], []
    for _ in range(200):
        machine.advance()
        z.append(machine.get("x")[2])
        speed.append(machine.get("x")[8])
    assert par.z_max < max(z) < par.z_max + 1e-3
    assert min(speed) < -0.05
    assert z[-1] < par.z_max
    machine.set("gates", [1.0])
    machine.advance(5)
    assert np.abs(machine.get("i")).max() > 0.01
