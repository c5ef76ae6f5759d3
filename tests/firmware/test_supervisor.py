"""The supervisor in C: states in order, no jumps, what each monitor does, and flights with it and without it."""

from __future__ import annotations

import ctypes
import math
import subprocess
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from test_firmware import WARNINGS

import malta
from malta.errors import InputError
from malta.firmware import supervised_flight
from malta.firmware.flight import call, compile_controller, new_state, view
from malta.firmware.program import Precision
from malta.firmware.signals import Target, fidelity_of
from malta.firmware.sources import phase_currents, sources
from malta.firmware.supervised_flight import compile_supervised
from malta.firmware.supervisor import (
    ENDLESS_SAMPLES,
    IN_FLIGHT,
    MONITORS,
    STATES,
    TIMES,
    TOUCH,
    TRANSITIONS,
    State,
    bounds_of,
    expected_readings,
    gains_without,
    monitors_of,
    prediction_correction,
    reference_limits,
    touch_bounds,
)
from malta.firmware.supervisor_text import (
    _NUMBERS,
    NUMBERS,
    monitor_lines,
    supervisor_members,
    supervisor_sources,
)
from malta.firmware.vectors import UNWATCHED_STATES, watch_lines, watch_table
from malta.machines.tubular.experiments.faults import MAX_LANDING_SPEED
from malta.simulation.engine.compiled import compiler

pytestmark = pytest.mark.usefixtures("proven_once")


@pytest.fixture(autouse=True)
def _with_compiler() -> None:
    if compiler() is None:
        pytest.skip("no C compiler")


def target(name: str, precision: Precision = "double") -> Target:
    c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    return Target(c, precision, fidelity_of(malta.plant_of(c.parameters)))


TARGETS = {name: target(name) for name in ("robust", "halbach", "tubular_pid")}
REST = (0.0, -0.6e-3, 0.0, -0.6e-3, 1e-3)


class Bench:
    """A supervisor with a machine that is where its reference wants it, or rests; noise in its sensors."""

    def __init__(self, name: str = "robust", seed: int = 1) -> None:
        self.t = TARGETS[name]
        self.s = compile_supervised(self.t)
        self.state, self.supervisor, self.request = (
            new_state(self.s.native),
            self.s.Supervisor(),
            self.s.Request(),
        )
        self.inputs, self.outputs = self.s.native.Inputs(), self.s.native.Outputs()
        self.rng, self.plant = np.random.default_rng(seed), self.t.believed
        self.rest = np.array(REST[: len(self.plant.outputs)])
        self._call("supervisor_init", self.supervisor)
        self.seen: list[str] = []
        self.forced: dict[str, Any] = {}
        self.step()  # requests count when they come

    def _call(self, function: str, *records: Any) -> None:
        getattr(self.s.native.lib, f"{self.s.native.name}_{function}")(*(ctypes.byref(r) for r in records))

    def fly(self) -> Bench:
        """Begin in operation, at zero."""
        rest = type(self.supervisor.rest)(*self.rest)
        take_over = getattr(self.s.native.lib, f"{self.s.native.name}_supervisor_take_over")
        take_over(ctypes.byref(self.supervisor), rest)
        self._call("start", self.state)
        return self

    def step(self, samples: int = 1, y: dict[int, float] | None = None, **given: Any) -> str:
        """So many samples with these readings in place of true ones; the state."""
        off = self.now in ("OFF", "OFFSETS", "SENSORS", "FAULT")
        for _ in range(samples):
            place = self.rest if off else view(self.state.reference, "p")
            noise, steps = np.array(self.plant.sensors.noise), np.array(self.plant.sensors.resolution)
            read = place + noise * self.rng.normal(size=len(noise))
            read = np.where(steps > 0, np.round(read / np.where(steps > 0, steps, 1)) * steps, read)
            for k, value in (y or {}).items():
                read[k] = value
            view(self.inputs, "y")[:], view(self.inputs, "y_valid")[:] = read, 1
            if self.t.driven:
                view(self.inputs, "i")[:] = given.get("i", self.currents(place))
                view(self.inputs, "i_valid")[:] = given.get("i_valid", 1)
                view(self.inputs, "link")[:] = given.get("link", 45.0)
            for field, forced in self.forced.items():
                if forced is not None:
                    values = view(self.inputs, field)
                    values[forced[0] % len(values)] = forced[1]
            for name in ("start", "operate", "land", "acknowledge", "missed", "stop", "sto"):
                setattr(self.request, name, given.get(name, 0))
            view(self.request.reference, "p")[0] = given.get("reference", 0.0)
            self._call(
                "supervisor_step", self.supervisor, self.state, self.inputs, self.request, self.outputs
            )
            off = self.now in ("OFF", "OFFSETS", "SENSORS", "FAULT")
            if not self.seen or self.seen[-1] != self.now:
                self.seen.append(self.now)
        return self.now

    def ask(self, entry: str, k: int, value: float, **given: Any) -> None:
        """One sample with an entry of the requested reference."""
        r = self.request.reference
        for name in ("p", "dp", "ddp"):
            view(r, name)[:] = 0.0
        view(r, "dp")[k] = given.pop("dp", 0.0)
        view(r, entry)[k] = value
        self.step(reference=float(view(r, "p")[0]), **given)

    def currents(self, place: Any) -> Any:
        """The currents of the sensors, which are those that were commanded a sample ago."""
        if (view(self.outputs, "current") == 0).all():
            return 0.0
        return np.array(self.phases(place, view(self.outputs, "current"))).ravel()

    @cached_property
    def phases(self) -> ca.Function:
        """(readings of the positions, commanded currents of the coils) -> currents of the sensors."""
        return phase_currents(self.t)

    @property
    def now(self) -> State:
        return list(STATES)[int(self.supervisor.state)]

    @property
    def monitor(self) -> str:
        return MONITORS[self.supervisor.monitor] if self.supervisor.monitor >= 0 else ""


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robust", "halbach", "tubular_pid"])
def test_states_follow_each_other_without_jumps(name: str) -> None:
    """From off to operation, through a landing to off: the reference is smooth and starts where the machine rests."""
    bench, Ts = Bench(name), TARGETS[name].controller.sample_time
    assert bench.step(20) == "OFF"
    assert not view(bench.outputs, "v").any()
    if bench.t.driven:
        assert (view(bench.outputs, "command") == 0.5).all()
    p, dp, v = [], [], []
    for k in range(7000):
        bench.step(start=int(k == 0), operate=1, land=int(k == 2000))
        if bench.supervisor.state in (NUMBERS["LIFT"], NUMBERS["SETTLE"], *range(5, 8)):
            p.append(view(bench.state.reference, "p").copy())
            dp.append(view(bench.state.reference, "dp").copy())
            v.append(view(bench.outputs, "v").copy())
    whole = ["OFF", "OFFSETS", "SENSORS", "LIFT", "SETTLE", "OPERATE", "LANDING", "OFF"]
    assert bench.seen == whole
    assert (
        np.abs(p[0] - bench.rest).max() < 4 * max(bench.plant.sensors.noise) / math.sqrt(TIMES.check) + 1e-9
    )
    assert np.abs(p[-1] - p[0]).max() < 1e-12
    steps, rates = np.diff(p, axis=0), np.array(dp)
    assert np.abs(steps - Ts * (rates[1:] + rates[:-1]) / 2).max() < 1e-9
    fastest = 5.78 * np.abs(p[0]).max() / (TIMES.lift * Ts) ** 2  # of a quintic
    assert np.abs(np.diff(rates, axis=0)).max() < 1.01 * Ts * fastest + 1e-12
    usual = np.abs(np.diff(v, axis=0)).max(axis=0)
    changes = [TIMES.lift - 1, TIMES.lift]
    assert all((np.abs(v[k + 1] - v[k]) <= usual + 1e-9).all() for k in changes)


def test_the_first_command_balances_the_machine_at_rest() -> None:
    """Weight and attraction at the bearing, and nothing else: a small share of the force limit."""
    bench = Bench()
    while bench.step(start=1) != "LIFT":
        pass
    limit = bench.t.controller.limits.force
    plant, par = bench.plant, bench.plant.parameters
    pull = 2 * par.K_A * 0.6e-3 + plant.stroke.mass * par.g  # type: ignore[attr-defined]
    v = view(bench.outputs, "v")
    assert v[1] + v[3] == pytest.approx(pull, rel=0.15)
    assert (np.abs(v) < 0.35 * limit).all()


STUCK = TARGETS["robust"]
LOST = bounds_of(STUCK).unbelieved


def test_a_reading_that_cannot_be_true_is_left_out_and_believed_again() -> None:
    for k, wrong in ((1, math.nan), (1, 1.0), (1, 50e-6), (4, math.inf)):
        bench = Bench().fly()
        bench.step(300)
        bench.step(5, y={k: wrong})
        assert bench.supervisor.unbelieved[k] == 5
        assert bench.monitor in ("NAN", "RANGE", "RATE")
        bench.step(3)
        assert (bench.now, bench.supervisor.unbelieved[k]) == ("OPERATE", 0)
        assert all(np.isfinite(view(bench.state, name)).all() for name in ("xi_pred", "e", "u_integral"))
        assert np.isfinite(view(bench.outputs, "command")).all()


@pytest.mark.slow
def test_a_sensor_that_stays_away_stops_the_stroke_and_lands() -> None:
    bench = Bench().fly()
    bench.step(300)
    assert bench.step(10, y={1: math.nan}) == "OPERATE"
    assert bench.step(1, y={1: math.nan}) == "HOLD"
    assert bench.step(LOST - 11, y={1: math.nan}) == "HOLD"
    assert bench.step(1, y={1: math.nan}) == "LANDING"
    assert (bench.monitor, bench.now) == ("UNBELIEVED", "LANDING")
    bench.step(TIMES.landing + TIMES.settle, y={1: math.nan})
    assert bench.now == "OFF"
    assert np.isfinite(view(bench.state, "xi_pred")).all()


def test_without_any_sensor_it_switches_off_until_acknowledged() -> None:
    bench = Bench().fly()
    bench.step(300)
    nothing = dict.fromkeys(range(5), math.nan)
    bench.step(LOST + 1, y=nothing)
    assert (bench.now, bench.monitor) == ("FAULT", "BLIND")
    assert (view(bench.outputs, "command") == 0.5).all()
    assert bench.step(50, start=1) == "FAULT"
    assert bench.step(acknowledge=1) == "OFF"
    assert bench.step(start=1) == "OFFSETS"


def test_a_landing_goes_on_where_no_sensor_is_believed_for_a_sample() -> None:
    """Off is a fall from wherever it is: only sensors that are believed tell that it rests."""
    bench = Bench().fly()
    bench.step(300)
    bench.step(100, land=1)
    bench.step(y=dict.fromkeys(range(5), math.nan))
    assert list(bench.supervisor.unbelieved) == [1] * 5
    assert bench.step(20) == "LANDING"


@pytest.mark.slow
def test_a_reference_reaches_its_place_before_operation_goes_on() -> None:
    """One that moves would fade to its request beyond the end of the travel."""
    bench = Bench().fly()
    view(bench.state.reference, "p")[4], view(bench.state.reference, "dp")[4] = 8e-3, 0.5
    bench._call("start", bench.state)
    seen: list[tuple[Any, ...]] = []
    for k in range(3000):
        bench.ask("p", 4, math.nan if k == 0 else -8e-3)
        seen.append((bench.now, *(float(view(bench.state.reference, name)[4]) for name in ("p", "dp"))))
    first = next(k for k, row in enumerate(seen) if row[0] == "OPERATE")
    assert first > TIMES.calm
    assert abs(seen[first - 1][2]) < 1e-3 * 0.5
    assert max(row[1] for row in seen) < 15e-3


def test_stuck_sensors_are_told_from_quiet_ones() -> None:
    """Equal readings of a radial sensor, more of a quiet one, of all sensors two: an hour of noise has no such row."""
    b = bounds_of(STUCK)
    assert b.stuck == (239, 104, 140, 131, 2)
    assert b.stale == 2
    bench = Bench().fly()
    bench.step(300)
    bench.step(b.stuck[1], y={1: 1e-6})
    assert bench.supervisor.unbelieved[1] == 0
    bench.step(3, y={1: 1e-6})
    assert (bench.monitor, bool(bench.supervisor.unbelieved[1])) == ("STUCK", True)
    bench = Bench().fly()
    bench.step(300)
    bench.step(4, y=dict.fromkeys(range(5), 1e-7))
    assert list(bench.supervisor.unbelieved) == [2] * 5
    assert bench.step(20) == "OPERATE"
    assert list(bench.supervisor.unbelieved) == [0] * 5


Acts = tuple[str, dict[str, Any], int, str, str]
ACTS: tuple[Acts, ...] = (
    ("three missed steps", {"missed": 3}, 1, "MISSED", "HOLD"),
    ("as many as unstable ones take to double", {"missed": LOST + 1}, 1, "MISSED", "LANDING"),
    ("a sagging link", {"link": 30.0}, 3, "LINK", "HOLD"),
    ("a link without a reading", {"link": math.nan}, 3, "LINK", "HOLD"),
    ("a link that stays down", {"link": 4.5}, 2000, "LINK", "LANDING"),
    ("a current beyond its limits", {"i": np.tile([11.0, -5.5, -5.5], 6)}, 3, "CURRENT", "FAULT"),
    ("a link with too much voltage", {"link": 55.0}, 3, "OVERVOLTAGE", "FAULT"),
    ("currents without a reading", {"i": math.nan}, 5, "CURRENT_LOST", "FAULT"),
    ("currents that are called invalid", {"i_valid": 0.0}, 5, "CURRENT_LOST", "FAULT"),
    ("currents whose validity is no number", {"i_valid": math.nan}, 5, "CURRENT_LOST", "FAULT"),
    ("an emergency stop", {"stop": 1}, 1, "STOP", "FAULT"),
    ("safe torque off", {"sto": 1}, 1, "STO", "FAULT"),
    ("a request that is no number", {"reference": math.nan}, 1, "REFERENCE", "HOLD"),
    ("a request out of reach", {"reference": 1.0}, 1, "REFERENCE", "HOLD"),
)


@pytest.mark.slow_for("a link that stays down")
@pytest.mark.parametrize(
    ("given", "samples", "monitor", "state"), [a[1:] for a in ACTS], ids=[a[0] for a in ACTS]
)
def test_each_monitor_acts_after_its_samples(
    given: dict[str, Any], samples: int, monitor: str, state: str
) -> None:
    bench = Bench().fly()
    bench.step(300)
    assert not any(bench.supervisor.acted)
    if samples > 1:
        bench.step(samples - 1, **given)
        assert bench.now != state
    bench.step(**given)
    assert (bench.now, bench.monitor) == (state, monitor)
    if state == "HOLD":
        bench.step(TIMES.calm + 2)
        assert bench.now == "OPERATE"


def acted(bench: Bench, key: str) -> list[int]:
    """How often the rows of a monitor acted."""
    return [n for n, row in zip(bench.supervisor.acted, monitors_of(bench.t), strict=True) if row.key == key]


def test_a_machine_that_does_not_answer_its_forces_is_held_and_landed() -> None:
    """A sum of errors of 1 m s keeps a force at its limit, and the readings do not follow; a filter sees it earlier."""
    bench = Bench().fly()
    bench.step(300)
    view(bench.state, "e")[1] = 1.0
    bench.step(50)
    assert (bench.now, bench.monitor) == ("HOLD", "INNOVATION")
    bench = Bench("tubular_pid").fly()
    bench.step(300)
    view(bench.state, "e")[1] = 1.0
    bench.step(199)
    assert bench.now == "OPERATE"
    bench.step(3)
    assert (bench.now, bench.monitor) == ("HOLD", "SATURATION")
    bench.step(800)
    assert (bench.now, bench.monitor) == ("LANDING", "SATURATION")


def test_a_filter_that_expects_other_readings_stops_the_stroke() -> None:
    bench = Bench().fly()
    bench.step(300)
    lasted = {"OPERATE": 0, "HOLD": 0}
    while bench.now in lasted:
        lasted[bench.now] += 1
        off = min(0.4e-6 * sum(lasted.values()), 20e-6)  # at once it would be a filter that is lost
        view(bench.state, "xi_pred")[:] = np.eye(15)[1] * off
        bench.step()
    assert 20 + 6 < lasted["OPERATE"] < 20 + 16  # over 8 deviations from the 11th sample on, with noise
    assert lasted["HOLD"] == 380
    assert bench.now == "LANDING"
    assert acted(bench, "INNOVATION")[0] == 2  # both sensors of y


def test_a_filter_that_is_off_its_readings_at_once_switches_off() -> None:
    """No reading leapt, and which one is right nothing tells: a fall is softer than what the law would do."""
    bench = Bench().fly()
    bench.step(300)
    for _ in range(8):
        view(bench.state, "xi_pred")[:] = np.eye(15)[1] * 20e-6
        bench.step()
    assert (bench.now, bench.monitor) == ("FAULT", "ASTRAY")


def test_a_filter_that_lost_its_way_switches_off() -> None:
    bench = Bench().fly()
    bench.step(300)
    view(bench.state, "xi_pred")[1] = 2e-3
    bench.step(6, y=dict.fromkeys(range(5), math.nan))
    assert (bench.now, bench.monitor) == ("FAULT", "ASTRAY")
    bench = Bench().fly()
    bench.step(300)
    view(bench.state, "e")[1] = 1.0
    bench.step(12, y={1: math.nan})
    assert (bench.now, bench.monitor) == ("FAULT", "HELPLESS")


@pytest.mark.slow
def test_near_its_bearing_it_lands() -> None:
    bench, bound = Bench().fly(), bounds_of(STUCK).touch
    assert bound[:4] == pytest.approx(0.7 * 0.6e-3, rel=1e-6)
    assert bound[4] == pytest.approx(15e-3, rel=1e-6)
    bench.step(1300, reference=0.3e-3)
    assert bench.now == "OPERATE"
    for y in np.arange(0.3e-3, 0.45e-3, 0.2e-6):  # so slowly that the filter follows
        bench.step(y={0: y}, reference=0.3e-3)
    assert list(STATES)[bench.supervisor.state] == "LANDING"
    assert sum(acted(bench, "TOUCH")) == 1


def test_it_starts_neither_with_offsets_nor_with_dead_sensors() -> None:
    bench = Bench()
    bench.step(start=1)
    bench.step(TIMES.offsets + 2, i=0.05)
    assert bench.now == "SENSORS"
    assert view(bench.supervisor, "offset") == pytest.approx(0.05)
    bench = Bench()
    bench.step(start=1)
    bench.step(TIMES.offsets + 2, i=0.2)
    assert (bench.now, bench.monitor) == ("FAULT", "OFFSET")
    bench = Bench()
    bench.step(start=1)
    bench.step(TIMES.offsets + 5 + 8 * TIMES.check, y={2: math.nan})
    assert (bench.now, bench.monitor) == ("FAULT", "UNREADY")


@pytest.mark.slow
def test_a_machine_that_does_not_settle_lands() -> None:
    bench = Bench()
    while bench.step(start=1, operate=1) != "SETTLE":
        pass
    for k in range(20 * TIMES.settle + 2):
        bench.step(y={1: (20 + k % 2) * 1e-6}, operate=1)
    assert bench.monitor == "UNSETTLED"
    assert bench.now == "LANDING"


@pytest.mark.slow
def test_a_machine_that_has_settled_waits_for_its_request() -> None:
    """Ten times as long as it may take to settle; what unsettles it then has all that time again."""
    bench = Bench()
    while bench.step(start=1) != "SETTLE":
        pass
    assert bench.step(200 * TIMES.settle) == "SETTLE"
    unsettled = {1: 20e-6}
    assert bench.step(10, y=unsettled) == "SETTLE"
    assert bench.step(2 * TIMES.settle, operate=1) == "OPERATE"


def test_counts_end_where_samples_stand_for_ever() -> None:
    """A machine that is off for days with sensors that are: 2^31 samples of 50 us are 30 hours."""
    bench = Bench()
    bench.step(y=dict.fromkeys(range(5), 0.0))
    bench.supervisor.unchanged, bench.supervisor.samples = ENDLESS_SAMPLES - 1, ENDLESS_SAMPLES - 1
    bench.supervisor.repeated[:] = [ENDLESS_SAMPLES - 1] * 5
    assert bench.step(3, y=dict.fromkeys(range(5), 0.0)) == "OFF"
    assert [bench.supervisor.unchanged, bench.supervisor.samples, *bench.supervisor.repeated] == [
        ENDLESS_SAMPLES
    ] * 7


def test_machines_have_the_monitors_that_make_sense() -> None:
    robust, halbach = ({row.key for row in monitors_of(TARGETS[name])} for name in ("robust", "halbach"))
    assert robust == set(MONITORS)
    currents = {"CURRENT", "OFFSET"} | {
        f"CURRENT_{key}" for key in ("LOST", "INFERRED", "SUM", "FROZEN", "ERROR", "EXCESS")
    }
    assert robust - halbach == currents | {"LINK", "OVERVOLTAGE"}
    assert len(monitor_lines(TARGETS["robust"])) == 1 + len(monitors_of(TARGETS["robust"]))
    assert {state for state, _, _ in TRANSITIONS} == set(STATES)


def test_bounds_follow_from_the_machine() -> None:
    """A jump is the fastest fall through the clearance, v = sqrt(4 a d) with all bearing forces, and noise."""
    t = TARGETS["robust"]
    b, par, Ts = bounds_of(t), t.believed.parameters, t.controller.sample_time
    m, inertia, l_B, l_S = (getattr(par, name) for name in ("m", "I_xx", "l_B", "l_S"))
    force = 5.2 * 5.0
    a = force * (abs(1 / m + l_B * l_S / inertia) + abs(1 / m - l_B * l_S / inertia))
    sigma = [math.hypot(0.41e-6 * share, 1e-6 / math.sqrt(12)) for share in (0.815, 1.137, 0.993, 1.022)]
    assert b.sigma[:4] == pytest.approx(sigma)
    assert b.jump[1] == pytest.approx(math.sqrt(4 * a * 0.42e-3) * Ts + 8 * math.sqrt(2) * sigma[1], rel=1e-4)
    assert b.stopping[4] == pytest.approx(0.1 * 2 * force / m)
    assert math.log(2) / (218.92 * Ts) == pytest.approx(LOST, abs=1)


def test_one_sensor_less_leaves_a_stable_filter() -> None:
    """At any place, with the machine's own derivatives there; without the stroke's sensor there is none."""
    t = TARGETS["robust"]
    gains, n = gains_without(t), len(t.controller.states)
    assert sorted(gains.L) == [0, 1, 2, 3]
    xi = ca.SX.sym("xi", n)
    jacobians = [ca.jacobian(f(t)(xi), xi) for f in (prediction_correction, expected_readings)]
    derivatives = ca.Function("derivatives", [xi], jacobians)
    worst = 0.0
    for z in np.linspace(-14e-3, 14e-3, 9):
        at = np.zeros(n)
        at[2] = z
        more, C = (np.array(value) for value in derivatives(at))
        near = int(np.abs(gains.places - z).argmin())
        for k, L in gains.L.items():
            assert not L[near][:, k].any()
            whole = (np.eye(n) - L[near] @ C) @ (t.controller.Ad + more)
            worst = max(worst, float(np.abs(np.linalg.eigvals(whole)).max()))
    assert 0.99 < worst < 1
    assert gains_without(TARGETS["tubular_pid"]).L == {}
    monitors = {m.key: m.reaction for m in monitors_of(TARGETS["tubular_pid"])}
    assert monitors["UNBELIEVED"] == "FAULT"


@pytest.mark.slow
def test_a_filter_without_a_sensor_keeps_what_it_knows_of_disturbances() -> None:
    """One radial sensor of a plane cannot see two forces: their estimates stay, the rest of the filter is stable."""
    t = Target(malta.gains.read(ROOT / "design" / "gains" / "robust_observer.json"))
    gains, c = gains_without(t), t.controller
    assert sorted(gains.L) == [0, 1, 2, 3]
    n = len(c.states) - len(c.forces)
    middle = len(gains.places) // 2
    for L in gains.L.values():
        assert not L[:, n:].any()
        whole = (np.eye(n) - L[middle][:n] @ c.Cd[:, :n]) @ c.Ad[:n, :n]
        assert np.abs(np.linalg.eigvals(whole)).max() < 1


@pytest.mark.slow
def test_a_sensor_that_sticks_in_a_hold_is_landed_without() -> None:
    """By the design that estimates disturbances too, and after a bounce nothing throws the mover across."""
    for name, during, most in (
        ("robust_observer", "hold", MAX_LANDING_SPEED),
        ("calibrated", "stroke", 0.26),
    ):
        c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
        e = malta.experiment(
            "supervised-faults", malta.plant_of(c.parameters), c, during=during, only="stuck"
        )
        assert e.cases[-1].merits[2].value < most


@pytest.mark.parametrize("delay", [0, 1, 2])
def test_one_sensor_less_where_the_model_has_a_delay(delay: int) -> None:
    """Of two masses with a spring: each sensor sees both. Stored forces have rows of zeros, which scale nothing."""
    A = [[0, 0, 1, 0], [0, 0, 0, 1], [50, 50, 0, 0], [50, 50, 0, 0]]
    plant = malta.linear_machine(A, np.eye(4)[:, 2:], np.eye(4)[:2], noise=1e-6, limit=10.0)
    w = malta.synthesis.weights(q=[1, 1, 1, 1], r=[1, 1], w=[1, 1], v=[1e-6, 1e-6])
    c = malta.lqg(malta.linearize(plant, plant.at()), w, 1e-3, delay=delay)
    assert len(c.states) == 4 + 2 * delay
    with np.errstate(all="raise"):
        assert sorted(gains_without(Target(c, fidelity="force")).L) == [0, 1]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "precision"), [("robust", "float"), ("halbach", "double")])
def test_no_compiler_warns(name: str, precision: Precision, tmp_path: Path) -> None:
    t, cc = target(name, precision), compiler()
    files = sources(t, "0" * 64, name) | supervisor_sources(t, name)
    for file, text in files.items():
        (tmp_path / file).write_text(text, encoding="utf-8")
    assert cc is not None
    command = [*cc, *WARNINGS, "-c", f"{name}_supervisor.c", "-o", "x.o"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=100)
    assert (done.returncode, done.stderr) == (0, "")
    code = files[f"{name}_supervisor.c"]
    assert not any(word in code for word in ("malloc", "math.h", "int8_t", "char "))
    assert code.count("switch (") == code.count("default:")


EDGE = tuple(
    (name, entry, k)
    for name in ("robust", "halbach")
    for entry in ("p", "dp", "ddp")
    for k in range(len(TARGETS[name].controller.measurements))
)


@pytest.mark.parametrize(("name", "entry", "k"), EDGE)
def test_references_end_at_their_limits(name: str, entry: str, k: int) -> None:
    """A request at a limit is accepted, by controller and supervisor; one ulp beyond it is refused."""
    t = TARGETS[name]
    bound = dict(zip(("p", "dp", "ddp"), reference_limits(t), strict=True))[entry][k]
    for sign in (1, -1):
        for value, accepted in ((sign * bound, 1), (sign * np.nextafter(bound, np.inf), 0)):
            native, state = compile_supervised(t).native, new_state(compile_supervised(t).native)
            before, r = bytes(state), native.Reference()
            view(r, entry)[k] = value
            assert call(native, "set_reference", state, r) == accepted
            assert (bytes(state) == before) == (not accepted)
        bench = Bench(name).fly()
        bench.step(300)
        ahead = {"p": "asked", "dp": "asked_rate"}
        if entry in ahead:  # as if it had come there
            view(bench.supervisor, ahead[entry])[k] = sign * bound
        bench.ask(entry, k, sign * bound)
        assert bench.now == "OPERATE"
        bench.ask(entry, k, sign * np.nextafter(bound, np.inf))
        assert (bench.monitor, bench.now) == ("REFERENCE", "HOLD")


def test_records_of_a_flight_fit_a_controller_compiled_again() -> None:
    """A flight without supervisor follows the records of one with it, which other compilations may have followed."""
    first = compile_supervised(TARGETS["robust"])
    compile_controller.cache_clear()
    compile_supervised.cache_clear()
    again = compile_supervised(TARGETS["robust"])
    state = new_state(again.native)
    state.reference = first.native.Reference()
    assert first.Supervisor is again.Supervisor


def test_limits_of_references_are_those_of_the_machine() -> None:
    """A tenth less than the way to a touchdown and than the travel; all that the forces can do."""
    limits = reference_limits(TARGETS["robust"])
    assert limits.position == pytest.approx([0.9 * 0.7 * 0.6e-3] * 4 + [0.9 * 15e-3], rel=1e-6)
    m = TARGETS["robust"].believed.stroke.mass
    assert limits.acceleration[4] == pytest.approx(2 * 5.2 * 5.0 / m)
    assert limits.speed[4] == pytest.approx(math.sqrt(4 * limits.acceleration[4] * 13.5e-3))


DECLARED = """[references]
position = { z = { value = 12, unit = "mm" } }
speed = { z = { value = 1.5, unit = "m / s" } }
acceleration = { z = { value = 100, unit = "m / s^2" }, x1 = { value = 20, unit = "m / s^2" } }

"""


def declared(folder: Path, text: str = DECLARED) -> malta.Spec:
    """The design of the flagship with limits of references."""
    own = (ROOT / "design" / "calibrated.toml").read_text(encoding="utf-8")
    own = own.replace("../data/", f"{ROOT}/data/")
    first = own.index("[")
    path = folder / "calibrated.toml"
    path.write_text(own[:first] + text + own[first:], encoding="utf-8")
    return malta.read_design(path)


@pytest.mark.slow
def test_limits_of_references_are_declared_in_the_design_file(tmp_path: Path) -> None:
    """They go with the gains in every form, and change no gain."""
    spec = declared(tmp_path)
    model = malta.linearize(spec.plant, spec.plant.at())
    c = malta.synthesize(spec, model)
    own = malta.gains.read(ROOT / "design" / "gains" / "calibrated.json")
    np.testing.assert_allclose(c.K, own.K, rtol=1e-9)
    for end in ("json", "npz", "mat"):
        malta.gains.write(c, malta.verify(model, c), tmp_path / f"gains.{end}")
        back = malta.gains.read(tmp_path / f"gains.{end}")
        limits, usual = reference_limits(Target(back)), reference_limits(Target(own))
        assert [row[4] for row in limits] == [12e-3, 1.5, 100.0]
        assert limits.acceleration[0] == 20.0
        np.testing.assert_array_equal(limits.position[:4], usual.position[:4])
    assert "0.012 m, 1.5 m/s, 100 m/s^2" in sources(Target(c), "", "own")["own.h"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            DECLARED.replace("z = { value = 12", "w = { value = 12"),
            "references.position.w: found an unknown output",
        ),
        (DECLARED.replace("1.5, unit", "-1.5, unit"), r"references.speed.z: found -1.5"),
        (DECLARED.replace('"m / s"', '"m"'), "references.speed.z"),
        (DECLARED.replace("speed", "velocity", 1), "references.velocity"),
    ],
)
def test_limits_of_references_that_are_none_are_refused(text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        declared(tmp_path, text)


def test_limits_of_references_beyond_the_machine_are_refused(tmp_path: Path) -> None:
    spec = declared(tmp_path, DECLARED.replace("value = 12", "value = 16"))
    c = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    with pytest.raises(InputError, match=r"references.position.z: found 0.016 m, expected at most 0.015"):
        reference_limits(Target(c))


@pytest.mark.slow
def test_a_step_of_the_reference_is_refused_and_then_faded_to_within_the_limits() -> None:
    """10 mm in one sample: the reference stops, and goes there when the request stays, no faster than the forces do."""
    bench = Bench().fly()
    bench.step(300)
    bench.ask("p", 4, 10e-3)
    assert (bench.monitor, bench.now) == ("REFERENCE", "HOLD")
    assert abs(view(bench.state.reference, "p")[4]) < 1e-9
    limits, found = reference_limits(TARGETS["robust"]), []
    for _ in range(6000):
        bench.ask("p", 4, 10e-3)
        found.append([view(bench.state.reference, name)[4] for name in ("p", "dp", "ddp")])
    p, dp, ddp = np.abs(np.array(found)).max(axis=0)
    assert bench.now == "OPERATE"
    assert p == pytest.approx(10e-3, rel=1e-6)
    assert dp <= 0.76 * limits.speed[4]
    assert ddp <= 0.76 * limits.acceleration[4]


@pytest.mark.parametrize("bad", [math.nan, math.inf, 31.6e-3])
def test_operation_does_not_begin_with_a_bad_request(bad: float) -> None:
    """In the sample of settle -> operate and at any other: it waits, and nothing that the supervisor knows changes."""
    bench = Bench()
    while bench.step(start=1) != "SETTLE":
        pass
    bench.step(2 * TIMES.settle)
    before = view(bench.state.reference, "p").copy()
    for _ in range(5):
        bench.ask("p", 4, bad, operate=1)
        assert bench.now == "SETTLE"
        assert all(np.isfinite(view(bench.supervisor, name)).all() for name in REALS_OF_SUPERVISOR)
    bench.ask("p", 4, 0.0, operate=1)
    assert bench.now == "OPERATE"
    assert np.abs(view(bench.state.reference, "p") - before).max() < 1e-9


REALS_OF_SUPERVISOR = [m.name for m in supervisor_members(STUCK) if m.kind == "real" and m.size]


@pytest.mark.slow
def test_no_number_of_the_supervisor_is_ever_anything_else() -> None:
    """Any numbers in readings, validity, currents, link and requests, in all states."""
    rng = np.random.default_rng(3)
    wild = np.array([math.nan, math.inf, -math.inf, 0.0, 1.0, -1.0, 1e30, 1e-30, 1e300, 5e-3])
    bench, seen = Bench(), set()
    for k in range(4000):
        often = rng.random() < 0.98
        for field in ("y", "i", "link"):
            pick = rng.choice(wild)
            bench.forced[field] = None if often else (int(rng.integers(18)), pick)
        reference = 0.0 if often else float(rng.choice(wild))
        flags: dict[str, Any] = {
            name: int(rng.random() < 0.3) for name in ("start", "operate", "acknowledge")
        }
        flags |= {name: int(rng.random() < 0.002) for name in ("land", "stop", "sto")}
        bench.step(reference=reference, missed=int(rng.random() < 0.01) * 2, **flags)
        seen.add(bench.now)
        values = [bench.supervisor.late, *(v for n in REALS_OF_SUPERVISOR for v in view(bench.supervisor, n))]
        assert np.isfinite(values).all(), k
        assert np.isfinite(view(bench.outputs, "command")).all()
        assert (np.abs(view(bench.outputs, "v")) <= bench.t.controller.limits.force * (1 + 1e-12)).all()
        assert bench.supervisor.enable == int(bench.now in IN_FLIGHT)
    assert {"OFF", "OFFSETS", "SENSORS", "FAULT"} <= seen


def test_a_frozen_current_is_found_when_its_command_moves() -> None:
    """All nine of a module, whose currents still add up to zero: the command leaves them."""
    bench = Bench().fly()
    bench.step(300)
    frozen = view(bench.inputs, "i").copy()
    for k in range(3000):
        z = 5e-3 * (1 - math.cos(k / 300))
        view(bench.request.reference, "p")[4] = z
        now = bench.currents(view(bench.state.reference, "p"))
        i = np.concatenate([frozen[:9], np.atleast_1d(now)[9:] if np.size(now) > 1 else np.zeros(9)])
        bench.ask("p", 4, z, i=i, dp=5e-3 * math.sin(k / 300) / 300 / bench.t.controller.sample_time)
        if bench.now == "FAULT":
            break
    assert (bench.monitor, bench.now, bench.supervisor.enable) == ("CURRENT_FROZEN", "FAULT", 0)


def test_one_wrong_current_shows_in_the_sum_of_its_star() -> None:
    bench = Bench().fly()
    bench.step(300)
    i = np.atleast_1d(bench.currents(view(bench.state.reference, "p"))) + np.zeros(18)
    i[4] += 0.25
    bench.step(4, i=i)
    assert bench.now == "OPERATE"
    bench.step(1, i=i)
    assert (bench.monitor, bench.now) == ("CURRENT_SUM", "LANDING")


def test_a_current_without_a_reading_is_known_by_its_star() -> None:
    """The step is that with the reading, to rounding; it lands. Two of a star are unknown: gates off."""
    for value, valid in ((math.nan, 1.0), (7.0, 0.0)):
        bench, whole = Bench().fly(), Bench().fly()
        for one in (bench, whole):
            one.step(300)
        i = np.array(bench.currents(view(bench.state.reference, "p")))
        i[4] = -i[3] - i[5]
        read, flags = i.copy(), np.ones(18)
        read[4], flags[4] = value, valid
        for k in range(4):
            bench.step(i=read, i_valid=flags)
            whole.step(i=i)
            command, expected = (view(b.outputs, "command") for b in (bench, whole))
            assert command == pytest.approx(expected, abs=1e-9), k
        assert bench.now == "OPERATE"
        bench.step(i=read, i_valid=flags)
        assert (bench.monitor, bench.now) == ("CURRENT_INFERRED", "LANDING")
        read[5], flags[5] = value, valid
        bench.step(5, i=read, i_valid=flags)
        assert (bench.monitor, bench.now) == ("CURRENT_LOST", "FAULT")


@pytest.mark.parametrize(("read", "least", "state"), [(0.0, 100, "LANDING"), (7.0, 50, "FAULT")])
def test_a_current_below_its_command_lands_and_one_beyond_it_is_off(
    read: float, least: int, state: str
) -> None:
    """Without the 3.5 A that are commanded it lands after 100 samples; 3.5 A more turn it off."""
    bench = Bench().fly()
    bench.step(300)
    samples = 0
    while bench.now == "OPERATE":
        wanted = np.zeros(len(bench.outputs.current))
        wanted[0] = 3.5
        view(bench.supervisor, "current")[:] = wanted
        noise = 1e-4 * (samples % 2)  # A; currents are not frozen
        bench.step(i=np.array(bench.phases(np.zeros(5), wanted * read / 3.5 + noise)).ravel())
        samples += 1
        assert samples < 200
    assert (bench.now, bench.monitor) == (state, "CURRENT_ERROR" if read < 3.5 else "CURRENT_EXCESS")
    assert samples >= least


@pytest.mark.slow
def test_a_sensor_that_sticks_in_a_lift_is_found_while_the_reference_goes_16_deviations() -> None:
    """And none is ignored in a lift and a landing without a fault."""
    bench = Bench()
    while bench.now != "LIFT":
        bench.step(start=1)
        bench.step()
    bench.step(450)
    held, began = float(view(bench.inputs, "y")[1]), float(view(bench.state.reference, "p")[1])
    for _ in range(40):
        bench.step(y={1: held})
        if bench.supervisor.unbelieved[1] > 0:
            break
    gone = abs(float(view(bench.state.reference, "p")[1]) - began)
    assert 15e-6 > gone > 16 * bounds_of(bench.t).sigma[1] > 8e-6
    healthy = Bench(seed=2)
    stuck = [row.key for row in monitors_of(healthy.t)].index("STUCK")
    while healthy.now != "OPERATE":
        healthy.step(start=1, operate=1)
        healthy.step(operate=1)
    healthy.step(6000, land=1)
    assert healthy.seen[-2:] == ["LANDING", "OFF"]
    assert healthy.supervisor.acted[stuck] == 0


def test_nothing_starts_without_a_link_or_with_too_much() -> None:
    for link, monitor in ((0.0, "LINK"), (30.0, "LINK"), (math.nan, "LINK"), (60.0, "OVERVOLTAGE")):
        bench = Bench()
        bench.step(start=1, link=link)
        bench.step(3, link=link)
        assert (bench.monitor, bench.now) == (monitor, "FAULT")
    bench = Bench()
    while bench.step(start=1) != "LIFT":
        pass
    bench.step(3, link=20.0)
    assert (bench.monitor, bench.now) == ("LINK", "LANDING")


def test_start_and_acknowledge_count_when_they_come() -> None:
    """Held together from the beginning they start nothing, and restart nothing after a fault."""
    bench = Bench()
    bench._call("supervisor_init", bench.supervisor)
    assert bench.step(300, start=1, acknowledge=1) == "OFF"
    bench.step()
    assert bench.step(start=1, acknowledge=1) == "OFFSETS"
    bench = Bench().fly()
    bench.step(300)
    assert bench.supervisor.enable == 1
    assert bench.step(stop=1, start=1, acknowledge=1) == "FAULT"
    assert bench.supervisor.enable == 0
    assert bench.step(500, start=1, acknowledge=1) == "FAULT"
    bench.step()
    assert bench.step(stop=1, acknowledge=1) == "FAULT"  # still pressed
    bench.step()
    assert bench.step(acknowledge=1) == "OFF"
    assert bench.step(start=1, sto=1) == "OFF"


def test_overruns_are_counted_inside() -> None:
    """Every third sample late by one: no row of single misses acts, the share does."""
    bench = Bench().fly()
    bench.step(300)
    for k in range(200):
        bench.step(missed=int(k % 3 == 0))
        if bench.now == "HOLD":
            break
    assert (bench.monitor, bench.now) == ("OVERRUN", "HOLD")
    assert bench.supervisor.overruns == k // 3 + 1


@pytest.mark.parametrize("name", ["robust", "halbach", "tubular_pid"])
def test_every_cell_of_the_table_of_monitors_has_a_reaction_or_a_reason(name: str) -> None:
    table = watch_table(TARGETS[name])
    assert set(table) == {row.key for row in monitors_of(TARGETS[name])}
    for key, cells in table.items():
        assert all(cells.values()), key
        for state in STATES:
            watched = any(row.key == key and state in row.states for row in monitors_of(TARGETS[name]))
            assert cells[state].startswith("(") == (not watched)
    reasons = {reason for keys, _, reason in UNWATCHED_STATES for key in keys if key in table}
    assert len(watch_lines(TARGETS[name])) == 3 + len(table) + len(reasons)


def test_it_says_so_where_there_is_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervised_flight, "compiler", lambda: None)
    c = TARGETS["robust"].controller
    with pytest.raises(InputError, match="expected a C compiler: cc"):
        malta.experiment("commissioning", malta.plant_of(c.parameters), c)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["robust", "robust_observer", "tubular_pid", "table2", "calibrated"])
def test_commissioning_completes(name: str) -> None:
    """Every design rises from its bearing, moves and lands; the command stays smooth, the landing slow."""
    c = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    e = malta.experiment("commissioning", malta.plant_of(c.parameters), c)
    found = {merit.label: merit.value for merit in e.merits}
    states = e.curves["state"][np.flatnonzero(np.diff(e.curves["state"], prepend=-1))]
    assert [list(STATES)[int(k)] for k in states] == [
        *("OFF", "OFFSETS", "SENSORS", "LIFT", "SETTLE", "OPERATE", "LANDING", "OFF")
    ]
    assert e.run.verdict.completed
    assert found["largest jump of a force between states in flight"] < 2.5
    assert found["meets its bearing in the landing at"] < 0.02
    if name == "robust":
        assert found["off its reference, at zero and in operation"] < 3e-6


@pytest.mark.slow
@pytest.mark.parametrize(("during", "counts"), [("stroke", (2, 0, 3)), ("hold", (1, 0, 3))])
def test_it_prevents_touchdowns(during: str, counts: tuple[int, int, int]) -> None:
    """Crashes at over 0.1 m/s become landings; a link that sags by 90 % in a stroke is flown through."""
    c = TARGETS["robust"].controller
    e = malta.experiment("supervised-faults", malta.plant_of(c.parameters), c, during=during)
    assert tuple(merit.value for merit in e.merits) == counts
    speeds = {case.label: case.merits[2].value for case in e.cases}
    assert speeds["y1 stuck"] > 0.1
    assert speeds["y1 stuck (s)"] < MAX_LANDING_SPEED
    assert speeds["y1 biased by 50 um (s)"] < 0.01
    assert math.isnan(speeds["DC link sags by 90 % for 50 ms (s)"])
    assert not e.failed


def test_faults_are_chosen_by_a_word_and_fly_with_their_own_engine() -> None:
    c = TARGETS["robust"].controller
    for engine in (malta.firmware.engine_of_c(), "virtual machine"):
        with pytest.raises(InputError, match="expected auto"):
            malta.experiment("commissioning", malta.plant_of(c.parameters), c, engine=engine)
    with pytest.raises(InputError, match="only"):
        malta.experiment("supervised-faults", malta.plant_of(c.parameters), c, only="lunch")


@pytest.mark.slow
def test_a_cushioned_clearance_is_used_up_at_a_share_of_it() -> None:
    """Contact is linear in a reading: radial ones are at TOUCH of where they would be without a touchdown bearing."""
    plant = malta.plant_of(TARGETS["robust"].controller.parameters)
    hard = touch_bounds(replace(plant, contacts=replace(plant.contacts, cushioned=(False,) * 3)))
    assert touch_bounds(plant) / hard == pytest.approx([TOUCH, TOUCH, TOUCH, TOUCH, 1], rel=1e-6)


def test_fades_bound_the_derivatives_of_their_polynomials() -> None:
    """Moves are quintic, with 3/4 of speed and acceleration; a rate ends with (1 - u)^3 (u + 3 u^2)."""
    u = np.linspace(0, 1, 10001)
    quintic = np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    ending = np.polynomial.Polynomial([1, -1]) ** 3 * np.polynomial.Polynomial([0, 1, 3])
    assert _NUMBERS["fade_speed"] == pytest.approx(abs(quintic.deriv()(u)).max() / 0.75, rel=1e-6)
    assert _NUMBERS["fade_acceleration"] == pytest.approx(abs(quintic.deriv(2)(u)).max() / 0.75, rel=1e-6)
    largest = abs(ending.deriv(2)(u)).max()
    assert largest <= _NUMBERS["fade_rate"] < 1.01 * largest
