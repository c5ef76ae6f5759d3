"""A law that is scheduled over the reference of an output: what it is, its loop and its proof, its files, its C."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest

import malta
from malta.firmware.signals import Target
from malta.gains.certified import origin_of
from malta.gains.encodings import content_sha256, encode
from malta.linear.closed_loops import instability
from malta.linear.sampling import sample
from malta.loops.parametric_loops import machine_system
from malta.margins.scheduled_loops import loops_between_places
from malta.margins.travel import travel_margin
from malta.margins.worst_case import worst_sensitivities
from malta.simulation.references import Motion
from malta.synthesis.controller import Controller
from malta.synthesis.law import law, law_at, point_at
from malta.synthesis.schedule import SCHEDULED_MATRICES, Schedule

MAGNET = "examples/magnet/design/scheduled.toml"
RISE = 0.1  # s


@pytest.fixture(scope="module")
def spec() -> malta.synthesis.Spec:
    return malta.read_design(MAGNET)


@pytest.fixture(scope="module")
def controller(spec: Any) -> Controller:
    return malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def _along(low: float, high: float) -> malta.Scenario:
    """From one place to another."""

    def course(t: np.ndarray) -> Motion:
        s, ds, dds = malta.references.quintic(t - 0.15, RISE)
        return Motion(
            low + (high - low) * s[:, None], (high - low) * ds[:, None], (high - low) * dds[:, None]
        )

    return malta.Scenario("along", 0.35, lambda _: course, noise=1.0, fidelity="force", settle=0.1)


def _rest(plant: malta.model.Plant, place: float) -> dict[str, Any]:
    x = point_at(plant, np.zeros(len(plant.states)), "y", place).x
    return dict(zip([s.name for s in plant.states], x.tolist(), strict=True))


def test_a_schedule_of_equal_matrices_is_the_fixed_law_to_the_bit(spec: Any, controller: Controller) -> None:
    assert controller.schedule is not None
    matrices: dict[str, Any] = {k: np.array([getattr(controller, k)] * 5) for k in SCHEDULED_MATRICES}
    equal = replace(controller.schedule, **matrices)
    runs = [
        malta.simulate(spec.plant, replace(controller, schedule=one), _along(-1e-3, 1e-3))
        for one in (equal, None)
    ]
    assert np.array_equal(runs[0].x, runs[1].x)
    assert np.array_equal(runs[0].v, runs[1].v)


def test_matrices_are_linear_between_places_and_constant_beyond(controller: Controller) -> None:
    """Of the law's own expression, at references across all places."""
    schedule = controller.schedule
    assert schedule is not None
    f, n = law(controller), len(controller.states)
    for r in (-5e-3, -3e-3, -2.2e-3, 0.0, 1e-3, 1.7e-3, 3e-3, 4e-3):
        K, L, Cd = (
            np.array([np.interp(r, schedule.places, M) for M in getattr(schedule, name).reshape(5, -1).T])
            for name in ("K", "L", "Cd")
        )
        args: dict[str, Any] = {name: np.zeros(f.size1_in(i)) for i, name in enumerate(f.name_in())}
        args |= {"xi_pred": np.arange(1.0, n + 1) * 1e-4, "y": [r], "p_ref": [r], "frozen": [1]}
        found = f(**args)
        hat = args["xi_pred"] + L * (r - Cd @ args["xi_pred"])
        assert np.array(found["xi_hat"]).ravel() == pytest.approx(hat, rel=1e-12)
        limit = controller.limits.force
        assert np.array(found["v"]).ravel() == pytest.approx(np.clip(-K @ hat, -limit, limit), rel=1e-12)


def test_the_machine_follows_where_the_fixed_law_is_unstable(spec: Any, controller: Controller) -> None:
    plant, near = spec.plant, _rest(spec.plant, 3e-3)
    fixed = replace(controller, schedule=None)
    assert not malta.loop(plant, fixed, **near).stable
    assert malta.loop(plant, controller, **near).stable
    run = malta.simulate(plant, controller, _along(-3e-3, 3e-3))
    assert run.verdict.completed
    assert abs(run.p[-1, 0] - 3e-3) < 1e-4


@pytest.mark.slow
def test_the_engines_and_the_c_code_fly_the_same(spec: Any, controller: Controller) -> None:
    """The C is written from the expressions of the simulation: a sum may be taken in another order."""
    scenario = _along(-3e-3, 3e-3)
    runs = [
        malta.simulate(spec.plant, controller, scenario, engine=engine)
        for engine in ("auto", "virtual machine", malta.firmware.engine_of_c())
    ]
    for run in runs[1:]:
        assert np.abs(run.p - runs[0].p).max() < 1e-15  # m
        assert np.abs(run.v - runs[0].v).max() < 1e-10  # V


def test_the_loop_between_places_is_that_of_the_law_there(spec: Any, controller: Controller) -> None:
    """The system and the law of the proof, closed by hand, beside the machine's own loop, at random places."""
    plant, rng = spec.plant, np.random.default_rng(4)
    cells = loops_between_places(plant, controller, ("R", "m"), "lag")
    assert not isinstance(cells, str)
    for system, F, (low, high) in cells:
        for r in rng.uniform(low, high, 3):
            R, m = plant.parameters.R * rng.uniform(0.8, 1.2), plant.parameters.m * rng.uniform(0.9, 1.1)
            A, B, C, D = (M[0] for M in system.explicit(np.array([R, m, r])))
            A, B = sample(A, B, controller.sample_time)
            around = np.linalg.inv(np.eye(len(F.D)) - F.D @ D)
            from_x, from_law = around @ F.D @ C, around @ F.C
            whole = np.block(
                [[A + B @ from_x, B @ from_law], [F.B @ (C + D @ from_x), F.A + F.B @ D @ from_law]]
            )
            heavy = plant.variant(replace(plant.parameters, R=R, m=m))
            at = _rest(heavy, float(r))
            alone, law_there = machine_system(heavy, controller, [], at, "lag")
            own = np.exp(instability(alone, law_there, np.zeros((1, 0)))[0] * controller.sample_time)
            assert np.abs(np.linalg.eigvals(whole)).max() == pytest.approx(own, rel=1e-9)


@pytest.mark.slow
def test_the_margin_holds_at_random_places(spec: Any, controller: Controller) -> None:
    """Of two laws that share the filter, so that one channel is enough; and the witness is unstable at its place."""
    plant = spec.plant
    schedule = controller.schedule
    assert schedule is not None
    few = Schedule(
        "y", 0, schedule.places[1:3],
        **{k: np.array([getattr(schedule, k)[1]] * 2) for k in ("Ad", "Bd", "Cd", "L")},
        **{k: getattr(schedule, k)[1:3] for k in ("K", "Ki")},
    )  # fmt: skip
    own = replace(controller, **few.at(0.0), schedule=few)
    margin = travel_margin(plant, own, {"R": 0.2}, time=60)
    assert margin.lower is not None
    assert margin.lower > 1
    rng = np.random.default_rng(1)
    for _ in range(20):
        R = plant.parameters.R * (1 + 0.2 * min(margin.lower, 4.9) * rng.uniform(-1, 1))
        at = _rest(plant, float(rng.uniform(-1e-3, 1e-3)))
        assert malta.loop(plant, own, parameters={"R": R}, **at).stable


def test_nothing_is_proven_where_the_law_is_unstable_at_a_place(spec: Any, controller: Controller) -> None:
    """The fixed law as a schedule of equal matrices: lost at the near end."""
    assert controller.schedule is not None
    matrices: dict[str, Any] = {k: np.array([getattr(controller, k)] * 2) for k in SCHEDULED_MATRICES}
    equal = Schedule("y", 0, np.array([2e-3, 3e-3]), **matrices)
    margin = travel_margin(spec.plant, replace(controller, schedule=equal), {"R": 0.2}, time=20)
    assert not margin.lower
    assert margin.upper == 0


@pytest.mark.parametrize("suffix", malta.gains.SUFFIXES)
def test_gain_files_hold_the_matrices_of_all_places(
    spec: Any, controller: Controller, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"scheduled{suffix}"
    report = malta.verify(malta.linearize(spec.plant, spec.plant.at()), controller)
    malta.gains.write(controller, report, path)
    found = malta.gains.read(path)
    assert found.schedule is not None
    assert controller.schedule is not None
    assert found.schedule.variable == "y"
    for name in ("places", *SCHEDULED_MATRICES):
        assert np.array_equal(getattr(found.schedule, name), getattr(controller.schedule, name))


def _with_changed_file(spec: Any, controller: Controller, path: Path, change: Any) -> None:
    report = malta.verify(malta.linearize(spec.plant, spec.plant.at()), controller)
    content = malta.gains.document(controller, report)
    change(content)
    content["sha256"] = content_sha256(content)
    path.write_bytes(encode(content, path))


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("variable", "z", "one of y"),
        ("places", [0.0, -1.0, 1.0, 2.0, 3.0], "rising places"),
        ("K", None, "those beside it"),
    ],
)
def test_a_gain_file_with_another_schedule_is_refused(
    spec: Any, controller: Controller, tmp_path: Path, key: str, value: Any, said: str
) -> None:
    def change(content: dict[str, Any]) -> None:
        table = content["schedule"]
        table[key] = (1.01 * np.array(table[key])).tolist() if value is None else value

    path = tmp_path / "changed.json"
    _with_changed_file(spec, controller, path, change)
    with pytest.raises(malta.InputError, match=said):
        malta.gains.read(path)


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        ({"schedule.variable": "z"}, "schedule.variable: found 'z', expected one of y"),
        ({"schedule.places": [1, 0]}, "schedule.places: .*, expected places that rise"),
        ({"schedule.unit": "N"}, "schedule.places"),
        ({"schedule.places": [1, 2]}, "one within the places"),
        ({"search": {"numbers": {}}}, "no search is scheduled"),
        ({"commutation": "predicted"}, "commutation|currents do not depend"),
    ],
)
def test_what_no_schedule_can_be_is_refused_in_a_sentence(entries: dict[str, Any], said: str) -> None:
    with pytest.raises(malta.InputError, match=said):  # noqa: PT012  reading or designing refuses
        spec = malta.read_design(MAGNET, entries=entries)
        malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


def test_laws_that_no_schedule_takes_are_refused(controller: Controller) -> None:
    cart = malta.linear_machine([[0, 1], [0, 0]], [[0], [1]], [[1, 0]])
    lead = control.c2d(control.ss(control.tf([200, 1000], [1 / 50, 1])), 1e-3, "tustin")
    errors = malta.synthesis.controller_of(lead, cart, name="lead")
    schedule_laws = malta.synthesis.schedule_laws
    variable = errors.measurements[0].name
    with pytest.raises(malta.InputError, match="an LQG or a PID"):
        schedule_laws([errors, errors], variable)
    with pytest.raises(malta.InputError, match="a plain LQG or PID"):
        schedule_laws([controller, controller], "y")
    fixed = replace(controller, schedule=None)
    with pytest.raises(malta.InputError, match="an output: y"):
        schedule_laws([fixed, fixed], "z")
    with pytest.raises(malta.InputError, match="two rising places"):
        schedule_laws([fixed, fixed], "y")
    with pytest.raises(malta.InputError, match="another sample time"):
        schedule_laws([fixed, replace(fixed, sample_time=1e-3)], "y")


@pytest.mark.slow
def test_laws_of_held_currents_are_refused() -> None:
    held = malta.gains.read("design/gains/planar.json")
    with pytest.raises(malta.InputError, match="currents do not depend"):
        malta.synthesis.schedule_laws([held, held], held.measurements[0].name)


def test_what_a_scheduled_law_does_not_have_is_refused(spec: Any, controller: Controller) -> None:
    plant = spec.plant
    for scenario in (
        replace(_along(-1e-3, 1e-3), estimator="kalman"),
        replace(_along(-1e-3, 1e-3), scheduled=True),
    ):
        with pytest.raises(malta.InputError, match="beside a law that is scheduled"):
            malta.simulate(plant, controller, scenario)
    with pytest.raises(malta.InputError, match="worst_case: scheduled"):
        worst_sensitivities(plant, controller, {"R": 0.2})
    with pytest.raises(malta.InputError, match="for a certificate"):
        origin_of("scheduled.json", plant, controller, "lag", 5)
    with pytest.raises(malta.InputError, match="one set of gains"):
        Target(controller, fidelity="force", tunable=True)


def test_a_pid_is_scheduled_by_its_gains_alone() -> None:
    """Its filter is the same everywhere: one channel for each force."""
    spec = malta.read_design("examples/ball/design/ball_pid.toml")
    plant = spec.plant
    models = [malta.linearize(plant, plant.at(q=q)) for q in (-1e-3, 1e-3)]
    laws = [
        malta.synthesize(one, model)
        for one, model in zip((spec.replace({"pid.Kp.f": 6e3}), spec), models, strict=True)
    ]
    found = malta.synthesis.schedule_laws(laws, "y")
    cells = loops_between_places(plant, found, ("m",), "lag")
    assert not isinstance(cells, str)
    ((system, F, _),) = cells
    assert F.D.shape == (2, 2)
    x = plant.state({"q": -1e-3})
    assert np.array_equal(law_at(found, plant, x).K, laws[0].K)
    assert float(ca.DM(system.matrices(ca.DM([0.1, 0.0]))[3])[1, 1]) == 0.5
