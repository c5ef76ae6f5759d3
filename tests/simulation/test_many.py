"""Many machines at once: each run is the one that `simulate` makes of it, whatever company it has."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import malta
from malta import references
from malta.simulation.engine import compiled
from malta.simulation.engine.batch import record_run, replay_run, simulate_many
from malta.simulation.engine.digest import Batch, verdicts
from malta.simulation.engine.engines import engine_of, library_of
from malta.simulation.flown_strokes import stroke_figures
from malta.simulation.layout import FIDELITIES, Fidelity
from malta.simulation.readings import keys, normals, starts_of_parts
from malta.simulation.scenario import Correction, Fault, Scenario
from malta.simulation.trajectory import Trajectory

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray

FIGURES = tuple(Batch.__dataclass_fields__)


@pytest.fixture(scope="module")
def calibrated(designs: dict[str, Design]) -> Design:
    return designs["calibrated"]


def _stroke(**options: Any) -> Scenario:
    return Scenario.stroke(4e-3, rise=6e-3, duration=0.03, noise=1.0, **options)


def _hold(duration: float = 0.01, **options: Any) -> Scenario:
    return Scenario("hold", duration, lambda plant: references.hold(plant, z=1e-3), **options)


def _spread(design: Design, runs: int, share: float = 0.2, seed: int = 0) -> dict[str, FloatArray]:
    """Everything in the paper's box, and the current loops, each machine by itself."""
    rng, par = np.random.default_rng(seed), design.spec.parameters
    return {
        name: getattr(par, name) * rng.uniform(1 - share, 1 + share, runs)
        for name in ("m", "K_A", "K_B", "K_D", "w_cc", "R", "L", "K_ind")
    }


def _expected(run: Trajectory) -> dict[str, Any]:
    """What a batch says of a run, from its trajectory."""
    stroke, error = stroke_figures(run), run.p - run.reference
    return {
        "duration": run.verdict.time,
        "completed": float(run.verdict.completed),
        "deviation": np.abs(error).max(axis=0),
        "rms": np.sqrt((error**2).mean(axis=0)),
        "force": np.abs(run.v).max(axis=0),
        "contact": run.contact.max(axis=0),
        "rise": stroke.rise,
        "overshoot": stroke.overshoot,
        "saturated": run.saturated.mean(axis=0),
        "verdict": verdicts(run.plant).index(run.verdict.name),
        "last": error[-1],
    }


def _assert_replayed(
    design: Design,
    batch: Batch,
    scenario: Scenario,
    changes: Mapping[str, FloatArray],
    first: int = 0,
    expected: Callable[[Trajectory], dict[str, Any]] = _expected,
) -> list[Trajectory]:
    """Every figure of every run to 1e-12 of the largest of its kind."""
    runs = [
        malta.simulate(machine, design.controller, scenario_k)
        for machine, scenario_k in (
            replay_run(design.plant, scenario, changes, first + k, first) for k in range(len(batch.duration))
        )
    ]
    figures = [expected(run) for run in runs]
    for name in FIGURES:
        wanted = np.array([row[name] for row in figures])
        size = max(np.abs(wanted[np.isfinite(wanted)]).max(initial=0), 1e-9)
        np.testing.assert_allclose(getattr(batch, name), wanted, rtol=0, atol=1e-12 * size, err_msg=name)
    return runs


def _same(a: Batch, b: Batch, chosen: Any = slice(None), tolerance: float = 0.0) -> None:
    for name in FIGURES:
        one, other = getattr(a, name)[chosen], getattr(b, name)
        size = np.abs(other[np.isfinite(other)]).max(initial=0)
        np.testing.assert_allclose(one, other, rtol=0, atol=tolerance * size, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_each_run_is_what_simulate_makes_of_it(calibrated: Design, fidelity: Fidelity) -> None:
    """Eleven machines, no multiple of the eight that share a register, with noise: deviation, rise, overshoot, force,
    contact and rms are those of the trajectory; so the lanes draw the very noise of `normals`."""
    changes = _spread(calibrated, 11)
    scenario = _stroke(fidelity=fidelity, seed=5, quantize=True)
    batch = simulate_many(calibrated.plant, calibrated.controller, scenario, changes)
    runs = _assert_replayed(calibrated, batch, scenario, changes)
    assert batch.completed.all()
    assert len(np.unique(batch.deviation[:, 4])) == 11
    assert batch.deviation.shape == (11, 5)
    assert np.ptp(batch.overshoot) > 1e-4
    assert np.ptp(batch.rise) > 0.1e-3
    drawn = normals(keys(5, np.array([3]))[0], len(runs[3].t), 5) * calibrated.plant.sensors.noise
    assert np.abs(runs[3].y - runs[3].p - drawn)[:, 4].max() < 1e-18


@pytest.mark.parametrize("runs", [1, 7, 8, 9])
def test_any_number_of_runs(calibrated: Design, runs: int) -> None:
    changes = _spread(calibrated, runs)
    batch = simulate_many(calibrated.plant, calibrated.controller, _stroke(fidelity="force"), changes)
    assert all(len(getattr(batch, name)) == runs for name in FIGURES)
    _assert_replayed(calibrated, batch, _stroke(fidelity="force"), changes)


def test_workers_do_not_matter(calibrated: Design) -> None:
    """To the bit: one thread, three, one for each core."""
    changes = _spread(calibrated, 37)
    told: list[float] = []
    batches = [
        simulate_many(
            calibrated.plant,
            calibrated.controller,
            _stroke(fidelity="force"),
            changes,
            workers=workers,
            progress=told.append,
        )
        for workers in (1, 3, None)
    ]
    for other in batches[1:]:
        _same(batches[0], other)
    assert told[-1] == 1
    assert told.count(1.0) == 3
    assert all(0 < share <= 1 for share in told)


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(st.data())
def test_company_does_not_matter(calibrated: Design, data: st.DataObject) -> None:
    """Part of a campaign from any run on, with its indices: the same figures, but for a last digit where lanes share
    their way through a sine."""
    changes = _spread(calibrated, 20)
    scenario = _stroke(fidelity="force")
    whole = simulate_many(calibrated.plant, calibrated.controller, scenario, changes)
    begin = data.draw(st.integers(0, 19))
    end = data.draw(st.integers(begin + 1, 20))
    part = simulate_many(
        calibrated.plant,
        calibrated.controller,
        scenario,
        {name: values[begin:end] for name, values in changes.items()},
        first=begin,
    )
    _same(whole, part, slice(begin, end), tolerance=1e-12)


def test_order_does_not_matter_without_noise(calibrated: Design) -> None:
    changes = _spread(calibrated, 19)
    order = np.random.default_rng(3).permutation(19)
    scenario = replace(_stroke(fidelity="force"), noise=0.0)
    sorted_, shuffled = (
        simulate_many(calibrated.plant, calibrated.controller, scenario, c)
        for c in (changes, {name: values[order] for name, values in changes.items()})
    )
    _same(sorted_, shuffled, order, tolerance=1e-12)


def test_a_seed_is_another_campaign_and_a_run_another_noise(calibrated: Design) -> None:
    """The same machine eight times: eight deviations; the same seed again: the same eight."""
    changes = {"m": np.full(8, 0.36)}

    def deviations(seed: int) -> FloatArray:
        scenario = _hold(fidelity="force", noise=1.0, seed=seed)
        return simulate_many(calibrated.plant, calibrated.controller, scenario, changes).deviation

    first = deviations(0)
    assert len(np.unique(first[:, 0])) == 8
    assert np.array_equal(first, deviations(0))
    assert not np.isin(deviations(1)[:, 0], first[:, 0]).any()


def test_rms_under_noise_is_the_covariance_of_a_single_machine(calibrated: Design) -> None:
    """64 runs of 20 ms and one of 1.28 s: the same radial rms within what so few independent samples allow."""
    plant, c = calibrated.plant, calibrated.controller
    many = simulate_many(plant, c, _hold(0.02, fidelity="force", noise=1.0), {"m": np.full(64, 0.36)})
    long = malta.simulate(plant, c, _hold(1.28, fidelity="force", noise=1.0))
    alone = np.sqrt(((long.p - long.reference)[:, :4] ** 2).mean(axis=0))
    assert np.sqrt((many.rms[:, :4] ** 2).mean(axis=0)) == pytest.approx(alone, rel=0.25)
    assert 20e-9 < alone.min() < alone.max() < 0.3e-6


def test_runs_that_touch_down_stop_there(designs: dict[str, Design]) -> None:
    """`table2` with twice its mass: some touch down in mid-stroke, in company of those that do not; their figures end
    with them."""
    design = designs["table2"]
    changes = {"m": np.linspace(0.3, 0.8, 12)}
    scenario = Scenario.stroke(10e-3, duration=0.08, fidelity="force")
    batch = simulate_many(design.plant, design.controller, scenario, changes)
    runs = _assert_replayed(design, batch, scenario, changes)
    fallen = batch.completed == 0
    assert 3 <= fallen.sum() <= 9
    assert {run.verdict.name for run, f in zip(runs, fallen, strict=True) if f} == {
        "touchdown at sensor plane 1"
    }
    assert (batch.duration[fallen] < 0.07).all()
    assert np.abs(batch.duration[~fallen] - 0.08).max() < 1e-12
    assert (batch.contact[fallen].max(axis=1) >= 1).all()
    assert (batch.contact[~fallen].max(axis=1) < 1).all()
    assert np.isnan(batch.rise[fallen]).all()
    assert (np.diff(batch.rise[:3]) > 1e-3).all()  # the heavier the slower


def test_runs_that_end_in_no_numbers_are_not_completed(calibrated: Design) -> None:
    """Attraction beyond all bounds, clearance too: NaN in one lane, and its neighbours fly on."""
    endless = malta.plant_of(replace(calibrated.spec.parameters, r_max=1e300, z_max=1e300))
    changes = {"K_A": np.array([8626.7, 1e14, 8626.7])}
    scenario = replace(_hold(0.02, fidelity="force", start={"y": 1e-6}), disturbance=None, substeps=4)
    batch = simulate_many(endless, calibrated.controller, scenario, changes)
    assert batch.completed.tolist() == [1, 0, 1]
    assert 0 < batch.duration[1] < 0.02
    lost = malta.simulate(*_replay(endless, calibrated, scenario, changes, 1))
    assert lost.verdict.name == "diverged"
    assert batch.duration[1] == pytest.approx(lost.verdict.time, abs=2 * 50e-6)
    assert [verdicts(endless)[int(k)] for k in batch.verdict] == ["completed", "diverged", "completed"]
    assert np.array_equal(batch.deviation[0], batch.deviation[2])


@pytest.mark.slow
def test_each_run_has_its_own_sensor_errors(calibrated: Design) -> None:
    """Gains, an offset and Hall sensors that differ from run to run, over the scenario's; without changes too."""
    rng = np.random.default_rng(7)
    errors = {
        "gain_x1": rng.uniform(-0.02, 0.02, 9),
        "offset_y2": rng.uniform(-5e-6, 5e-6, 9),
        "hall_phase": rng.uniform(-0.03, 0.03, 9),
    }
    scenario = _stroke(fidelity="force", sensor_errors={"offset_y2": 1.0, "hall_amplitude": 0.01})
    many = partial(simulate_many, calibrated.plant, calibrated.controller, scenario, sensor_errors=errors)
    changes = _spread(calibrated, 9)
    for varied, batch in ((changes, many(changes)), ({}, many({}))):
        runs = [
            malta.simulate(machine, calibrated.controller, scenario_k)
            for machine, scenario_k in (
                replay_run(calibrated.plant, scenario, varied, k, sensor_errors=errors) for k in range(9)
            )
        ]
        wanted = np.array([np.abs(run.p - run.reference).max(axis=0) for run in runs])
        np.testing.assert_allclose(batch.deviation, wanted, rtol=0, atol=1e-12 * wanted.max())
        assert runs[4].scenario.sensor_errors == {
            "hall_amplitude": 0.01,
            **{name: column[4] for name, column in errors.items()},
        }
        assert np.ptp(wanted[:, 3]) > 1e-6  # the offset is followed
    with pytest.raises(malta.InputError, match="gain_q: found an unknown error"):
        many(changes, sensor_errors={"gain_q": np.zeros(9)})
    with pytest.raises(malta.InputError, match="gain_x1: found NaN or infinity"):
        many(changes, sensor_errors={"gain_x1": np.full(9, math.nan)})
    with pytest.raises(malta.InputError, match="as many values of each parameter"):
        many(changes, sensor_errors={"gain_x1": np.zeros(8)})


@pytest.mark.slow
def test_how_a_lift_off_ends(calibrated: Design) -> None:
    """Too little current to lift it in two of three runs, named as the single run names it."""
    scenario = Scenario(
        "lift-off",
        0.03,
        lambda plant: references.hold(plant),
        start={"y": -0.6035e-3},
        cold=True,
        bearing=True,
        fidelity="force",
    )
    changes = {"I_max": np.array([0.5, 8.0, 1.0])}
    batch = simulate_many(calibrated.plant, calibrated.controller, scenario, changes)
    names = [verdicts(calibrated.plant)[int(k)] for k in batch.verdict]
    assert names == ["not lifted", "completed", "not lifted"]
    for k, name in enumerate(names):
        machine, scenario_k = replay_run(calibrated.plant, scenario, changes, k)
        run = malta.simulate(machine, calibrated.controller, scenario_k)
        assert run.verdict.name == name
        np.testing.assert_allclose(batch.saturated[k], run.saturated.mean(axis=0), atol=1e-12)
    assert batch.saturated[0].max() > 0.01


def _replay(
    plant: Any, design: Design, scenario: Scenario, changes: dict[str, FloatArray], k: int
) -> tuple[Any, Any, Any]:
    machine, scenario_k = replay_run(plant, scenario, changes, k)
    return machine, design.controller, scenario_k


def test_a_hold_has_no_rise(calibrated: Design) -> None:
    batch = simulate_many(
        calibrated.plant, calibrated.controller, _hold(fidelity="force"), {"m": np.full(3, 0.36)}
    )
    assert np.isnan(batch.rise).all()
    assert np.isnan(batch.overshoot).all()
    assert batch.completed.all()


@pytest.mark.parametrize(
    "name", ["s_r", "n_x2", "s_z", "dp", "I_max", "z_max", "I_zz", "phi_c", "L_p", "r_max"]
)
def test_every_parameter_counts(calibrated: Design, name: str) -> None:
    """What is no term of the equations counts too: noise and steps of the sensors are the run's own."""
    value = getattr(calibrated.spec.parameters, name)
    other = {"I_max": 1.0, "phi_c": 1.0, "dp": 5e-6, "L_p": 16e-3}.get(name, 1.5 * value)
    changes = {name: np.array([value, other])}
    scenario = _stroke(fidelity="force", quantize=True)
    batch = simulate_many(calibrated.plant, calibrated.controller, scenario, changes)
    runs = _assert_replayed(calibrated, batch, scenario, changes)
    if name not in ("z_max", "I_zz", "r_max"):
        assert np.abs(runs[1].y - runs[0].y).max() > 1e-9


def test_a_delay_of_its_own_is_refused(calibrated: Design) -> None:
    """It shapes the functions, so that one library cannot serve runs of different delays: not ignored, but refused."""
    changes = {"T_d": np.array([75e-6, 225e-6])}
    with pytest.raises(malta.InputError, match="T_d"):
        simulate_many(calibrated.plant, calibrated.controller, _stroke(fidelity="force"), changes)


def test_a_lift_off_is_a_scenario_for_many(calibrated: Design) -> None:
    """From rest on the touchdown bearings, which hold: a touch does not end a run that has them."""
    scenario = Scenario(
        "lift-off",
        0.02,
        lambda plant: references.hold(plant),
        start={"y": -0.6035e-3},
        cold=True,
        bearing=True,
        fidelity="force",
    )
    changes = {"m": 0.36 * np.array([0.9, 1.0, 1.1])}
    batch = simulate_many(calibrated.plant, calibrated.controller, scenario, changes)

    def expected(run: Trajectory) -> dict[str, Any]:
        error = run.p - run.reference
        return {
            "duration": run.verdict.time,
            "completed": float(run.verdict.completed),
            "deviation": np.abs(error).max(axis=0),
            "rms": np.sqrt((error**2).mean(axis=0)),
            "force": np.abs(run.v).max(axis=0),
            "contact": run.contact.max(axis=0),
            "rise": math.nan,
            "overshoot": np.nan,
            "saturated": run.saturated.mean(axis=0),
            "last": run.p[-1] - run.reference[-1],
            "verdict": verdicts(run.plant).index(run.verdict.name),
        }

    runs = _assert_replayed(calibrated, batch, scenario, changes, expected=expected)
    assert all(run.verdict.completed for run in runs)


@pytest.mark.slow
def test_parts_of_a_run_have_the_noise_of_other_runs(calibrated: Design) -> None:
    """One run's noise in all parts is that run's; other noise in the last third changes nothing before it."""
    changes, scenario = _spread(calibrated, 3), _stroke(fidelity="force", seed=3)
    plant, controller = calibrated.plant, calibrated.controller
    own = np.repeat(np.arange(3)[:, None], 7, axis=1)
    _same(
        simulate_many(plant, controller, scenario, changes, noise=own),
        simulate_many(plant, controller, scenario, changes),
    )
    parts = np.array([[4, 4, 4], [4, 4, 9], [2, 7, 1]])
    batch = simulate_many(plant, controller, scenario, changes, noise=parts)
    runs = []
    for k, row in enumerate(parts):
        machine, scenario_k = replay_run(plant, scenario, changes, k)
        runs.append(malta.simulate(machine, controller, replace(scenario_k, run=tuple(row.tolist()))))
        np.testing.assert_allclose(batch.deviation[k], _expected(runs[k])["deviation"], rtol=1e-9)
        recorded = record_run(plant, controller, scenario, changes, k, noise=parts)
        if recorded is not None:
            np.testing.assert_array_equal(
                abs(recorded.p - recorded.reference).max(axis=0), batch.deviation[k]
            )
    noise = [run.y - run.p for run in runs]
    third = starts_of_parts(len(noise[0]), 3)[2]
    np.testing.assert_allclose(noise[1][:third], noise[0][:third], rtol=0, atol=1e-18)
    assert (np.abs(noise[1] - noise[0])[third:] > 1e-9).any(axis=1).mean() > 0.99
    with pytest.raises(malta.InputError, match="runs x parts"):
        simulate_many(plant, controller, scenario, changes, noise=parts[:2])


def test_indices_beyond_the_first_are_replayed(calibrated: Design) -> None:
    changes = _spread(calibrated, 3)
    scenario = _stroke(fidelity="force")
    batch = simulate_many(calibrated.plant, calibrated.controller, scenario, changes, first=1000)
    _assert_replayed(calibrated, batch, scenario, changes, first=1000)
    machine, again = replay_run(calibrated.plant, scenario, changes, 1002, first=1000)
    assert again.run == 1002
    assert machine.parameters == replace(
        calibrated.spec.parameters, **{name: float(values[2]) for name, values in changes.items()}
    )


def test_a_batch_is_read_only(calibrated: Design) -> None:
    batch = simulate_many(
        calibrated.plant, calibrated.controller, _hold(fidelity="force"), {"m": np.array([0.36])}
    )
    with pytest.raises(ValueError, match="read-only"):
        batch.deviation[0, 0] = 1.0


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """As on a system without one."""
    monkeypatch.setattr(compiled, "compiler", lambda: None)
    remembered = (library_of, engine_of)
    for memory in remembered:
        memory.cache_clear()
    yield
    for memory in remembered:
        memory.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["stroke", "hold", "touchdown"])
def test_without_a_compiler_the_batch_is_the_same(
    designs: dict[str, Design], request: pytest.FixtureRequest, kind: str
) -> None:
    design = designs["table2" if kind == "touchdown" else "calibrated"]
    scenario = {
        "stroke": _stroke(fidelity="force"),
        "hold": _hold(fidelity="force", noise=1.0),
        "touchdown": Scenario.stroke(10e-3, duration=0.06, fidelity="force"),
    }[kind]
    changes = {"m": np.array([0.36, 0.4, 0.75])}
    told: list[float] = []
    compiled = simulate_many(design.plant, design.controller, scenario, changes, first=2)
    request.getfixturevalue("no_compiler")
    plain = simulate_many(design.plant, design.controller, scenario, changes, first=2, progress=told.append)
    _same(compiled, plain, tolerance=1e-12)
    assert told == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert (compiled.completed.all()) == (kind != "touchdown")


REFUSED: dict[str, tuple[Any, str]] = {
    "NaN": ({"m": np.array([0.36, math.nan])}, "m: found nan kg, expected a finite number above 0 in kg"),
    "infinity": ({"m": np.array([math.inf, 0.36])}, "m: found inf kg"),
    "a negative mass": ({"m": np.array([0.36, -0.1, 0.4])}, "m: found -0.1 kg"),
    "no resistance": ({"R": np.array([2.2, 0.0])}, "R: found 0.0 ohm"),
    "no such parameter": (
        {"mass": np.array([0.36])},
        "mass: found an unknown parameter, expected one of m I_xx",
    ),
    "the preset": ({"preset": np.array([1.0])}, "preset: found an unknown parameter"),
    "other lengths": (
        {"m": np.full(3, 0.36), "K_A": np.full(2, 8e3)},
        "found {'m': 3, 'K_A': 2}, expected as many values of each parameter",
    ),
    "nothing": ({}, "changes: found nothing"),
    "no runs": ({"m": np.array([])}, "m"),
    "a table": ({"m": np.full((3, 2), 0.36)}, "m"),
    "words": ({"m": np.array(["heavy"])}, "m"),
    "half of a pair": ({"I_xx": np.array([1.3e-3, 1.4e-3])}, "I_yy: found values unlike I_xx"),
}


@pytest.mark.parametrize(("changes", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_is_no_set_of_machines_is_refused_in_a_sentence(
    calibrated: Design, changes: Any, sentence: str
) -> None:
    with pytest.raises(malta.InputError) as caught:
        simulate_many(calibrated.plant, calibrated.controller, _hold(fidelity="force"), changes)
    assert sentence in str(caught.value)


def test_pairs_that_change_together_are_not_refused(calibrated: Design) -> None:
    changes = {name: 1.38e-3 * np.array([0.9, 1.1]) for name in ("I_xx", "I_yy")}
    scenario = _stroke(fidelity="force")
    batch = simulate_many(calibrated.plant, calibrated.controller, scenario, changes)
    _assert_replayed(calibrated, batch, scenario, changes)


@pytest.mark.parametrize("workers", [0, -1])
def test_a_number_of_workers_is_at_least_one(calibrated: Design, workers: int) -> None:
    with pytest.raises(malta.InputError, match="workers"):
        simulate_many(
            calibrated.plant,
            calibrated.controller,
            _hold(fidelity="force"),
            {"m": np.array([0.36])},
            workers=workers,
        )


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"faults": (Fault("lost sample", 0.0),)}, "faults"),
        ({"changes": ((0.0, {"m": 0.4}),)}, "changes"),
        ({"correction": Correction(1e-3, lambda _t, p: 0 * p)}, "correction"),
        ({"estimator": "kalman"}, "estimator"),
    ],
    ids=["faults", "changes", "an outer loop", "another estimator"],
)
def test_what_is_for_one_machine_is_refused(calibrated: Design, options: dict[str, Any], field: str) -> None:
    with pytest.raises(malta.InputError, match=f"scenario hold: {field}: found .* in a campaign"):
        simulate_many(calibrated.plant, calibrated.controller, _hold(**options), {"m": np.array([0.36, 0.4])})
