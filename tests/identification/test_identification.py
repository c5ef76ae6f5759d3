"""Excitation, identification, learning: figures against the simulated truth, and every refusal."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from conftest import Run

import malta
from malta.firmware.signals import Target
from malta.firmware.step import started_state, step_function, zero_reference
from malta.identification import ExcitationPlan, Identified, Log
from malta.identification.data_file import read_identified, write_data
from malta.identification.excite import model_at, predicted_spectra
from malta.identification.prediction import NoiseModel, predict
from malta.identification.response import ResponseModel
from malta.identification.spectra import spectrum_of, straighten
from malta.machines.tubular.plant import plant as tubular
from malta.model.plant import Signal
from malta.simulation.multisine import interleaved_multisine

pytestmark = pytest.mark.first

if TYPE_CHECKING:
    from malta.model.plant import Plant

ROBUST = "design/gains/robust.json"
TRUE = {"K_A": 9000.0, "K_B": 5.0, "K_D": 5.5}
ASKED = ["K_A", "K_B", "K_D", "I_xx"]
CONTROLLER = malta.gains.read(ROBUST)
SHORT = {"period": 0.5, "periods": 4, "band": (4.0, 400.0)}


@pytest.fixture(scope="module")
def plant() -> Plant:
    return malta.plant_of(CONTROLLER.parameters)


@pytest.fixture(scope="module")
def plan(plant: Plant) -> ExcitationPlan:
    return malta.excite(malta.loop(plant, CONTROLLER), **SHORT)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def log(plan: ExcitationPlan) -> Log:
    return malta.identification.log_of(excited(plan, TRUE))


@pytest.fixture(scope="module")
def found(log: Log) -> Identified:
    return malta.identify(CONTROLLER, log, parameters=ASKED)


def changed(values: dict[str, float]) -> Plant:
    par: Any = CONTROLLER.parameters
    return malta.plant_of(replace(par, **values))


def excited(plan: ExcitationPlan, values: dict[str, float], **options: Any) -> malta.simulation.Trajectory:
    scenario = malta.Scenario.excited(plan.signal, plan.duration, **options)
    run = malta.simulate(changed(values), CONTROLLER, scenario)
    assert run.verdict.completed
    return run


def with_columns(log: Log, **tables: Any) -> Log:
    return replace(log, columns={**log.columns, **tables}, sha256="")


def test_a_multisine_has_its_lines_and_no_others() -> None:
    signal = interleaved_multisine(0.5, 4.0, 200.0, inputs=3, lines=10)
    d = signal(np.arange(1000) * 0.5e-3)
    size = np.abs(np.fft.rfft(d, axis=0)) / 500
    found = np.zeros_like(size)
    found[signal.lines.astype(int), signal.axis.astype(int)] = 1
    assert size == pytest.approx(found, abs=1e-9)
    # Ten cosines in phase have a crest factor of sqrt(20) = 4.5.
    assert (signal.crest_factor < 2.2).all()
    with pytest.raises(malta.InputError, match="multiples of 1 / period from 4 to 10 Hz"):
        interleaved_multisine(0.5, 4.0, 10.0, inputs=3, lines=10)


def test_a_flight_as_planned_stays_in_the_window(plan: ExcitationPlan, log: Log) -> None:
    """Also of a machine that is not quite the gain file's; the window is not so wide that it says nothing."""
    off = np.abs(log.columns["y"] - log.columns["y"].mean(axis=0)).max(axis=0)
    window, motion = (np.array(list(one.values())) for one in (plan.window, plan.motion))
    assert (off < window).all()
    assert (window < 10e-6 + 3 * motion + 6 * np.array([0, 0, 0, 0, 15e-6])).all()


@pytest.mark.slow
def test_the_linear_loop_predicts_the_flight(plant: Plant, plan: ExcitationPlan) -> None:
    """Motion, currents and commands at the lines, against the simulation without noise."""
    run = excited(plan, {}, noise=0.0, quantize=False)
    N = round(2 * plan.signal.period / CONTROLLER.sample_time)
    bins = 2 * plan.signal.lines.astype(int)
    loop = malta.loop(plant, CONTROLLER)
    found = predicted_spectra(loop, model_at(loop, ("K_A",)), plan.signal)
    for flown, predicted in ((run.p, found.y), (run.v, found.v), (run.i, found.i)):
        measured = 2 * np.fft.rfft(flown[-N:], axis=0)[bins] / N
        assert np.abs(measured - predicted).max() < 5e-3 * np.abs(predicted).max()
    moved = np.abs(run.p[-N:] - run.p[-N:].mean(axis=0)).max(axis=0)
    assert moved == pytest.approx(list(plan.motion.values()), rel=0.03)


def test_parameters_are_within_their_intervals(found: Identified, plan: ExcitationPlan) -> None:
    truth = np.array([TRUE.get(name, 1.3805e-3) for name in ASKED])
    assert found.refusal == ""
    assert (np.abs(found.values - truth) < 2 * found.half_widths).all()
    assert (found.half_widths / truth < [1e-3, 1e-3, 0.02, 2e-3]).all()
    assert 0.7 < found.chi2 < found.limit
    assert found.plant.parameters.I_yy == found.plant.parameters.I_xx  # type: ignore[attr-defined]
    # What was predicted before the flight, without the parameters' correlations with others that were held.
    assert found.half_widths[0] / truth[0] < 1.5 * plan.accuracy["K_A"]


@pytest.mark.slow
def test_without_names_those_are_found_that_the_log_tells(log: Log) -> None:
    found = malta.identify(CONTROLLER, log, in_time=False)
    assert not found.dropped.keys() & set(found.names)
    assert {"K_A", "K_B", "K_D", "I_xx"} <= set(found.names)
    assert found.held["l_B"] == 0.04456
    assert "R" not in found.held
    assert found.held["m"] == 0.36


@pytest.mark.slow
def test_only_ratios_are_found_without_a_mass(log: Log) -> None:
    with pytest.raises(malta.CheckError, match=r"only ratios of .*Name one as known, as --known m=0.36"):
        malta.identify(CONTROLLER, log, parameters=[*ASKED, "m", "F_c"])
    start = {name: 1.25 * getattr(CONTROLLER.parameters, name) for name in [*ASKED, "F_c"]}
    heavier = malta.identify(
        CONTROLLER, log, parameters=[*ASKED, "F_c"], known={"m": 0.45}, start=start, in_time=False
    )
    lighter = malta.identify(CONTROLLER, log, parameters=[*ASKED, "F_c"], in_time=False)
    assert (np.abs(heavier.values - 1.25 * lighter.values) < 0.5 * heavier.half_widths).all()


@pytest.mark.slow
def test_a_known_mass_on_a_second_flight_gives_the_mass(plan: ExcitationPlan) -> None:
    own, loaded = (malta.identification.log_of(excited(plan, {**TRUE, "m": m})) for m in (0.38, 0.48))
    asked = ["K_A", "K_B", "m", "I_xx"]
    found = malta.identification.weigh(
        CONTROLLER, own, loaded, {"m": 0.1}, parameters=asked, known={"K_D": 5.5}
    )
    assert found.refusal == ""
    assert (np.abs(found.values - [9000.0, 5.0, 0.38, 1.3805e-3]) < 2 * found.half_widths).all()
    assert (found.half_widths / found.values < 5e-3).all()
    with pytest.raises(malta.InputError, match="what the second log's machine has more"):
        malta.identification.weigh(CONTROLLER, own, loaded, {"m": 0.0})


@pytest.mark.slow
def test_no_mass_is_found_in_two_logs_that_are_alike(log: Log) -> None:
    with pytest.raises(
        malta.CheckError, match=r"m is not told: .* is the second log that of another machine"
    ):
        malta.identification.weigh(CONTROLLER, log, log, {"m": 0.1})


@pytest.mark.slow
@pytest.mark.parametrize("known", [{"I_xx": 1.45e-3, "I_yy": 1.45e-3}, {"l_S": 0.09}, {"K_D": 5.2}])
def test_a_wrong_model_is_refused(log: Log, known: dict[str, float]) -> None:
    found = malta.identify(CONTROLLER, log, parameters=["K_A", "K_B"], known=known)
    assert "does not explain the log" in found.refusal


@pytest.mark.slow
def test_the_order_of_columns_does_not_matter(log: Log, found: Identified) -> None:
    """A bench's file has columns in an order of its own, and no column for an axis that was not excited."""
    turned = {
        group: np.roll(np.arange(log.columns[group].shape[1]), 2) for group in ("y", "v", "i", "excitation")
    }
    columns = {group: log.columns[group][:, order] for group, order in turned.items()}
    signals = {group: tuple(log.signals[group][k] for k in order) for group, order in turned.items()}
    other = replace(log, columns={**log.columns, **columns}, signals={**log.signals, **signals})
    same = malta.identify(CONTROLLER, other, parameters=ASKED, in_time=False)
    # Sums in another order end the least squares, whose slopes are differences, a thousandth of a deviation away.
    assert same.values == pytest.approx(found.values, rel=1e-5)
    assert malta.identification.replay_law(CONTROLLER, other).same
    lines = malta.measure(CONTROLLER, other).w
    assert len(lines) == len(malta.measure(CONTROLLER, log).w)


@pytest.mark.slow
def test_a_refusal_names_the_parameter_that_explains_it(log: Log) -> None:
    wrong = malta.identify(CONTROLLER, log, parameters=ASKED, known={"l_S": 0.09})
    change, share = wrong.explained["l_S"]
    assert abs(change - (CONTROLLER.parameters.l_S / 0.09 - 1)) < 0.005  # type: ignore[attr-defined]
    assert share > 0.8
    assert " or l_S +4" in wrong.refusal
    late = with_columns(log, i=np.vstack([log.columns["i"][:1], log.columns["i"][:-1]]))
    skewed = malta.identify(CONTROLLER, late, parameters=["K_A", "K_B"])
    # No parameter of the machine explains half of it: a skew of a sample does.
    assert max(share for _, share in skewed.explained.values()) < 0.5
    assert skewed.explanation is not None
    assert skewed.explanation.causes[0].name == "skew"
    assert skewed.explanation.causes[0].value == pytest.approx(-50e-6, abs=1e-6)


@pytest.mark.slow
def test_a_parameter_that_differs_from_its_twin_is_found_where_it_is_named(plan: ExcitationPlan) -> None:
    true = {"I_xx": 1.40e-3, "I_yy": 1.36e-3}
    uneven = malta.identification.log_of(excited(plan, true))
    asked = ["K_A", "K_B", "I_xx"]
    alike = malta.identify(CONTROLLER, uneven, parameters=asked)
    assert "; I_yy -" in alike.refusal
    apart = malta.identify(CONTROLLER, uneven, parameters=[*asked, "I_yy"])
    assert apart.refusal == ""
    assert apart.in_time is not None
    assert (np.abs(apart.values[2:] - list(true.values())) < 1.5 * apart.half_widths[2:]).all()
    assert (np.abs(apart.in_time.values[2:] - list(true.values())) < 1.5 * apart.half_widths[2:]).all()


@pytest.mark.slow
def test_currents_that_are_a_sample_late_are_refused(log: Log) -> None:
    late = with_columns(log, i=np.roll(log.columns["i"], 1, axis=0))
    assert malta.identify(CONTROLLER, late, parameters=ASKED).chi2 > 10


@pytest.mark.slow
def test_logs_that_tell_nothing_are_refused(log: Log) -> None:
    y, k = log.columns["y"], log.samples
    stuck, clipped, missing = np.array(y), np.clip(y, -12e-6, 12e-6), np.array(y)
    stuck[k // 2 :, 1] = stuck[k // 2, 1]
    missing[::4] = np.nan
    short = replace(log, t=log.t[: k // 4], columns={name: c[: k // 4] for name, c in log.columns.items()})
    sent = np.array(log.columns["excitation"])
    quiet = {name: log.columns[name] for name in ("v", "i")} | {"excitation": 0 * sent}
    colliding = np.array(sent)
    colliding[:, 2] = -2 * sent[:, 0]
    refused = {
        r"not independent: their lines collide, and fx_B1 and fx_B2 are correlated by 1.000": with_columns(
            log, excitation=colliding
        ),
        r"an open loop: .* unstable \(pole at 2[12]\d.\d rad/s": with_columns(
            log, v=sent + np.array([0, 3.5, 0, 3.5, 0])
        ),
        "y1 is stuck": with_columns(log, y=stuck),
        "x1 is clipped": with_columns(log, y=clipped),
        r"25 % of the readings of \w+ are missing": with_columns(log, y=missing),
        "too short": short,
        "nothing was excited": with_columns(log, **quiet),
        "a log of machine rotor": replace(log, machine="rotor"),
        "the law's are": replace(log, sample_time=1e-4),
        "has not the period": replace(log, period=0.45),
        "shorter than two samples": replace(log, period=1e-9),
    }
    for text, bad in refused.items():
        with pytest.raises(malta.CheckError, match=text):
            malta.identify(CONTROLLER, bad, parameters=ASKED)
    strange = replace(log, signals={**log.signals, "i": tuple(Signal(f"{k}", "A") for k in range(12))})
    with pytest.raises(malta.InputError, match="run excited: 0: found a current that the machine has not"):
        malta.identify(CONTROLLER, strange, parameters=ASKED)
    with pytest.raises(malta.InputError, match="unknown parameter"):
        malta.identify(CONTROLLER, log, parameters=["K_X"])
    with pytest.raises(malta.CheckError, match="R do not act"):
        malta.identify(CONTROLLER, log, parameters=["K_A", "R"])


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"lines": 0}, "lines: found 0, expected a number above 0"),
        ({"period": 1e9}, "samples of all, expected at most 5e.07"),
        ({"periods": 10**9}, "samples of all, expected at most 5e.07"),
        ({"band": (400.0, 2.0)}, "band: found 400 to 2 Hz, expected rising"),
        ({"motion": -1e-6}, "motion: found -1e-06, expected a number above 0"),
        ({"motion": "20um"}, "motion: found '20um', expected a number above 0"),
        ({"force": 1j}, "force: found 1j, expected a number above 0"),
    ],
)
def test_an_excitation_that_cannot_be_is_refused(plant: Plant, options: dict[str, Any], says: str) -> None:
    with pytest.raises(malta.InputError, match=says):
        malta.excite(malta.loop(plant, CONTROLLER), **options)


def test_a_machine_without_limits_is_excited_by_a_size_alone() -> None:
    """Without a size nothing says how large an excitation may be."""
    cart = malta.linear_machine([[0, 1], [4, 0]], [[0], [1]], [[1, 0]], outputs=["y [m]"], noise=1e-6)
    weights = malta.synthesis.weights(q=[100, 1], r=[1], w=[1], v=[1e-12], q_i=[1])
    loop = malta.loop(cart, malta.lqg(malta.linearize(cart, cart.at()), weights, Ts=1e-2))
    with pytest.raises(malta.InputError, match="none, and a machine without limits, expected a force"):
        malta.excite(loop)
    assert malta.excite(loop, motion=1e-3).motion["y"] == pytest.approx(1e-3)


def test_estimates_at_the_lines_and_in_time_agree(found: Identified) -> None:
    assert found.in_time is not None
    assert np.abs(list(found.differences.values())).max() < 2.5
    sigma = np.sqrt(np.diag(found.in_time.covariance))
    assert sigma == pytest.approx(found.half_widths / 1.96, rel=0.3)
    truth = np.array([TRUE.get(name, 1.3805e-3) for name in ASKED])
    assert (np.abs(found.in_time.values - truth) < 4 * sigma).all()
    assert found.in_time.rms == pytest.approx(np.ones(5), abs=0.15)
    apart = replace(found, in_time=replace(found.in_time, values=1.02 * found.in_time.values))
    assert "standard deviations apart, at most 3 is noise" in apart.refusal


@pytest.mark.slow
def test_digits_that_a_csv_lacks_move_nothing(log: Log, found: Identified) -> None:
    """The search ends where the likelihood does, not where differences of it are lost in rounding."""
    rounded = {group: np.round(log.columns[group], 12) for group in "yi"}
    again = malta.identify(CONTROLLER, with_columns(log, **rounded), parameters=ASKED, in_time=False)
    sigma = np.sqrt(np.diag(found.covariance))
    assert np.abs((again.values - found.values) / sigma).max() < 2e-3


@pytest.mark.slow
def test_prediction_errors_are_least_wherever_the_search_begins(log: Log, found: Identified) -> None:
    assert found.in_time is not None
    sigma = np.sqrt(np.diag(found.covariance))
    y, i = log.columns["y"], log.columns["i"]
    mean = y.mean(axis=0), i.mean(axis=0)
    plant = malta.plant_of(CONTROLLER.parameters)
    model = ResponseModel(plant, found.names, tuple(log.names("i")), *mean, log.sample_time)
    noise = NoiseModel(np.diff(y, axis=0).var(axis=0) / 2, found.in_time.process**2)
    ends = [predict(model, found.values + off * sigma, noise, i, y) for off in (0.0, 3.0, -3.0)]
    for end in ends[1:]:
        assert np.abs((end.values - ends[0].values) / sigma).max() < 0.01
        assert np.allclose(np.sqrt(np.diag(end.covariance)), np.sqrt(np.diag(ends[0].covariance)), rtol=1e-3)


@pytest.mark.slow
def test_missing_readings_are_filled_in(log: Log, found: Identified) -> None:
    """5 % of the rows, and of one sensor 5 % more: intervals grow by little, and what is found stays."""
    y, random = np.array(log.columns["y"]), np.random.default_rng(1)
    y[random.random(len(y)) < 0.05] = np.nan
    y[random.random(len(y)) < 0.05, 0] = np.nan
    part = malta.identify(CONTROLLER, with_columns(log, y=y), parameters=ASKED)
    assert part.refusal == ""
    assert part.in_time is not None
    assert part.in_time.missing == np.isnan(y).sum()
    assert (np.abs(part.values - found.values) < found.half_widths).all()
    assert part.half_widths == pytest.approx(found.half_widths, rel=0.25)


@pytest.mark.slow
def test_outliers_move_nothing(log: Log, found: Identified) -> None:
    y, random = np.array(log.columns["y"]), np.random.default_rng(1)
    for column in range(5):
        k = random.choice(len(y), 60, replace=False)
        y[k, column] += 20e-6 * random.standard_t(2, 60)
    spoilt = with_columns(log, y=y)
    plain = malta.identify(CONTROLLER, spoilt, parameters=ASKED)
    robust = malta.identify(CONTROLLER, spoilt, parameters=ASKED, robust=True)
    assert plain.half_widths[0] > 2 * found.half_widths[0]
    assert robust.half_widths == pytest.approx(found.half_widths, rel=0.25)
    assert (np.abs(robust.values - found.values) < found.half_widths).all()


@pytest.mark.slow
def test_a_torque_that_the_model_lacks_is_named_and_moves_no_parameter(plan: ExcitationPlan) -> None:
    """z m g about x, as of weights that are not where the forces are."""

    def variant(par: Any) -> Plant:
        whole = tubular(par)

        def load(x: Any) -> Any:
            return whole.load(x) + ca.vertcat(0, 0, 0, par.m * par.g * x[2], 0, 0)

        return replace(whole, load=load, variant=variant)

    scenario = malta.Scenario.excited(plan.signal, plan.duration)
    run = malta.simulate(variant(CONTROLLER.parameters), CONTROLLER, scenario)
    found = malta.identify(CONTROLLER, malta.identification.log_of(run), parameters=ASKED)
    assert found.chi2 > 5
    assert found.explanation is not None
    first = found.explanation.causes[0]
    assert "stiffness_alpha_z" in (first.name, *first.alike)
    truth = np.array([getattr(CONTROLLER.parameters, name) for name in ASKED])
    assert (np.abs(found.values - truth) < found.total).all()
    # A single parameter that would explain it as well makes a loop that was not measured.
    wrong = malta.identify(CONTROLLER, found.log, parameters=[*ASKED, "hall_amplitude"])
    assert (
        "does not have the loop that was measured" in wrong.refusal
        or abs(wrong.values[2] - 5.2) < wrong.total[2]
    )


@pytest.mark.slow
def test_curvature_is_taken_off_the_lines(plant: Plant, plan: ExcitationPlan) -> None:
    """Without noise: what the linear response leaves is what lever arms that move with the stroke add."""
    log = malta.identification.log_of(excited(plan, {}, noise=0.0, quantize=False))
    s = spectrum_of(log, log.columns["y"], log.columns["i"])
    y, i = s.outputs[0].real, s.currents[0].real
    model = ResponseModel(plant, ("K_A",), tuple(log.names("i")), y, i, log.sample_time)

    def left(spectrum: Any) -> float:
        e = spectrum.outputs - np.einsum(
            "kpm,km->kp", model.response(model.start, s.rate * np.arange(len(spectrum.outputs))), s.currents
        )
        return float(np.abs(e[s.lines, :4]).max())

    assert left(s) > 0.3e-9
    assert left(straighten(model, s, model.start)) < 0.02 * left(s)


@pytest.mark.slow
def test_errors_of_sensors_are_parameters_too(plan: ExcitationPlan) -> None:
    run = excited(plan, {}, sensor_errors={"gain_x1": 0.02})
    found = malta.identify(CONTROLLER, malta.identification.log_of(run), parameters=["K_A", "gain_x1"])
    assert found.refusal == ""
    assert found.values[1] == pytest.approx(0.02, abs=1e-3)
    taken_as_right = malta.identify(CONTROLLER, found.log, parameters=["K_A"])
    change, share = taken_as_right.explained["gain_x1"]
    assert change == pytest.approx(0.02, abs=1e-3)
    assert share > 0.9


def test_the_data_file_keeps_intervals(found: Identified, tmp_path: Path) -> None:
    path = write_data(found, tmp_path / "found.toml", gains=ROBUST, known={})
    data = read_identified(path)
    assert found.values[0] == data.parameters.K_A
    assert list(data.shares) == ["I_xx", "K_A", "K_B", "K_D"]
    assert data.shares["K_A"] == pytest.approx(found.total[0] / found.values[0], rel=1e-9)
    assert data.joint == pytest.approx(3.0802 / 1.95996, rel=1e-4)  # sqrt of chi2 of 4 at 95 %
    with pytest.raises(malta.InputError, match=r"suffix '.json', expected .toml"):
        write_data(found, tmp_path / "found.json", gains=ROBUST, known={})
    with pytest.raises(malta.InputError, match="parameters with an interval"):
        read_identified("data/tubular.toml")


@pytest.mark.slow
def test_a_law_replays_its_own_log_and_no_other() -> None:
    run = malta.simulate(changed({"m": 0.4}), CONTROLLER, malta.Scenario.stroke(10e-3, noise=1.0))
    log = malta.identification.log_of(run)
    found = malta.identification.replay_law(CONTROLLER, log)
    assert found.same
    assert found.rms["x1"] == pytest.approx(np.std(run.y[1000:, 0] - run.p[1000:, 0]), rel=0.3)
    # A mover that is 11 % heavier takes more thrust than the filter predicts; the axes that hold it show nothing.
    assert found.rms["z"] > 1.2 * found.own["z"] > 0.9 * found.rms["x1"]
    assert "the innovation of z has" in found.refusal
    assert found.explained["m"] == pytest.approx((0.4 / 0.36 - 1, 1.0), abs=0.03)
    other = malta.identification.replay_law(malta.gains.read("design/gains/calibrated.json"), log)
    assert not other.same
    assert other.difference["f_D"] > 0.01
    assert "another law or other gains flew" in other.refusal


@pytest.mark.slow
def test_a_replay_refuses_what_its_law_did_not_fly() -> None:
    """Sensors with half of their noise, in steps, have innovations that are correlated otherwise."""
    stroke = malta.Scenario.stroke(10e-3, noise=1.0, quantize=True, seed=3)
    logs = [
        malta.identification.log_of(malta.simulate(changed({}), CONTROLLER, stroke.replace(noise=noise)))
        for noise in (1.0, 0.4)
    ]
    log = logs[0]
    assert malta.identification.replay_law(CONTROLLER, log).refusal == ""
    coloured = malta.identification.replay_law(CONTROLLER, logs[1])
    assert (
        "not as white as that of the gain file's machine: autocorrelations differ by 0." in coloured.refusal
    )
    holes = np.array(log.columns["y"])
    holes[7, 1] = np.nan
    for text, bad in {
        "samples are missing": with_columns(log, y=holes),
        "missing, and a law": with_columns(log, excitation=log.columns["excitation"] * np.nan),
        "a log of machine rotor": replace(log, machine="rotor"),
        "the law's are": replace(log, sample_time=1e-4),
    }.items():
        with pytest.raises(malta.CheckError, match=text):
            malta.identification.replay_law(CONTROLLER, bad)


def test_excited_flights_are_replayed_too(log: Log) -> None:
    part = replace(log, t=log.t[:4000], columns={name: table[:4000] for name, table in log.columns.items()})
    found = malta.identification.replay_law(CONTROLLER, part)
    assert max(found.at_once.values()) < 1e-9


@pytest.mark.slow
def test_exported_laws_take_an_excitation(plan: ExcitationPlan) -> None:
    """The compiled C flies the multisine as the law does, and its log is replayed; what is no force is none."""
    scenario = malta.Scenario.excited(plan.signal, 0.05)
    flown = malta.simulate(changed({}), CONTROLLER, scenario, engine=malta.firmware.engine_of_c())
    run = malta.simulate(changed({}), CONTROLLER, scenario)
    assert np.abs(flown.v - run.v).max() < 1e-9
    assert np.ptp(plan.signal(run.t), axis=0).max() > 1
    assert malta.identification.replay_law(CONTROLLER, malta.identification.log_of(flown)).same
    with pytest.raises(malta.InputError, match="excitation"):
        malta.simulate(changed({}), CONTROLLER, malta.Scenario.excited(lambda t: np.zeros((len(t), 2)), 0.01))


def test_an_excitation_that_is_no_force_is_none() -> None:
    t = Target(CONTROLLER, fidelity="force", excited=True)
    step, reference, p = step_function(t), zero_reference(t), len(CONTROLLER.measurements)
    limit = np.array(CONTROLLER.limits.force)

    def forces(excitation: Any) -> Any:
        readings = {"y": np.zeros(p), "y_valid": np.ones(p), "excitation": excitation}
        return step(started_state(t, reference), reference, readings)[1]["v"]

    none = forces(np.zeros(p))
    for bad in (np.nan, np.inf, -np.inf, 1.01 * limit):
        assert (forces(np.zeros(p) + bad) == none).all()
    assert forces(0.01 * limit) - none == pytest.approx(0.01 * limit, rel=1e-9)


@pytest.mark.slow
def test_commands_from_excitation_to_data_file(run: Run, tmp_path: Path) -> None:
    flown, data = tmp_path / "flown.npz", tmp_path / "found.toml"
    short = ("--period", "0.5", "--periods", "3", "--band", "4..400", "--motion", "40um")
    said = run(
        "excite", ROBUST, *short, "--set", "K_A=9000", "--log", flown, "--out", tmp_path / "d.csv", "--json"
    )
    assert json.loads(said.out)["files"] == [str(tmp_path / "d.csv"), str(flown)]
    said = run("identify", ROBUST, flown, "-p", "K_A", "-p", "K_B", "-o", data, "--json")
    assert said.code == 0
    found = json.loads(said.out)
    assert found["parameters"]["K_A"]["low"] < 9000 + 5 < found["parameters"]["K_A"]["high"] + 10
    said = run("identify", ROBUST, flown, "-p", "K_A", "--known", "I_xx=1.6e-3", "-o", tmp_path / "none.toml")
    assert said.code == 1
    assert "chi2 / dof" in said.err
    assert not (tmp_path / "none.toml").exists()
    assert run("verify", ROBUST, "--identified", data, "--no-proof").code == 0
    said = run("verify", ROBUST, "--identified", data, "--uncertain", "10%", "--no-proof")
    assert (said.code, "one of them" in said.err) == (2, True)


@pytest.mark.slow
def test_the_field_of_the_planar_motor_is_found() -> None:
    """Forces of its held currents change with the place, so far that chi2 / dof is 676 where that is left out."""
    controller = malta.gains.read("design/gains/planar.json")
    plant = malta.plant_of(controller.parameters)
    plan = malta.excite(malta.loop(plant, controller), period=0.5, periods=4, band=(4.0, 200.0), lines=8)
    par: Any = controller.parameters
    true = {"B_r": 1.15, "I_x": 0.27, "I_y": 0.27, "I_z": 0.53}
    scenario = malta.Scenario.excited(plan.signal, plan.duration).replace(fidelity="force")
    run = malta.simulate(malta.plant_of(replace(par, **true)), controller, scenario)
    found = malta.identify(controller, malta.identification.log_of(run), parameters=["B_r", "I_x", "I_z"])
    assert found.refusal == ""
    assert (np.abs(found.values - [1.15, 0.27, 0.53]) < 2.5 * found.half_widths).all()
    assert (found.half_widths / found.values < 1e-3).all()


@pytest.mark.slow
def test_coil_positions_of_the_planar_motor_are_found_where_they_are_named() -> None:
    """Its field, each inertia, the coils' pitch and height: without a name of the pitch the refusal gives it."""
    controller = malta.gains.read("design/gains/planar.json")
    plant = malta.plant_of(controller.parameters)
    plan = malta.excite(malta.loop(plant, controller), period=0.25, periods=4, band=(4.0, 400.0))
    par: Any = controller.parameters
    true = {"B_r": 1.1, "I_x": 0.25, "I_y": 0.28, "I_z": 0.55, "r_z": 0.011, "coil_pitch": 0.0946}
    scenario = malta.Scenario.excited(plan.signal, plan.duration).replace(fidelity="force")
    run = malta.simulate(malta.plant_of(replace(par, **true)), controller, scenario)
    log = malta.identification.log_of(run)
    found = malta.identify(controller, log, parameters=list(true), in_time=False)
    assert found.refusal == ""
    off = (found.values - list(true.values())) / found.half_widths
    assert (np.abs(off) < 1.5).all()
    assert found.half_widths[0] / found.values[0] < 1e-3
    held = malta.identify(controller, log, parameters=list(true)[:-1])
    assert held.chi2 > 10 * held.limit
    assert held.explanation is not None
    assert [one.name for one in held.explanation.causes] == ["coil_pitch"]
    assert held.explained["coil_pitch"][1] > 0.8


@pytest.mark.slow
def test_stiffness_and_force_constant_of_a_rotor_are_found() -> None:
    spec = malta.read_design("examples/rotor/design/rotor.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    par: Any = spec.plant.parameters
    true = np.array([1.05 * par.k_s, 0.97 * par.k_i])
    plan = malta.excite(malta.loop(spec.plant, controller), period=0.5, periods=4, band=(4.0, 400.0), lines=8)
    scenario = malta.Scenario.excited(plan.signal, plan.duration).replace(fidelity="force", noise=1.0)
    run = malta.simulate(spec.plant.variant(replace(par, k_s=true[0], k_i=true[1])), controller, scenario)
    found = malta.identify(controller, malta.identification.log_of(run), parameters=["k_s", "k_i"])
    assert found.refusal == ""
    assert (np.abs(found.values - true) < 2 * found.half_widths).all()
    assert (found.half_widths / true < 4e-3).all()


@pytest.mark.slow
def test_intervals_cover(plant: Plant) -> None:
    """95 % intervals of 3 parameters over 14 machines: 42 of them, at least 36 hold the truth."""
    plan = malta.excite(malta.loop(plant, CONTROLLER), **SHORT)  # type: ignore[arg-type]
    random, inside, late = np.random.default_rng(7), 0, 0
    for k in range(14):
        values = {
            name: getattr(plant.parameters, name) * random.uniform(0.9, 1.1) for name in ("K_A", "K_B", "K_D")
        }
        run = excited(plan, values, seed=7, run=k)
        found = malta.identify(CONTROLLER, malta.identification.log_of(run), parameters=list(values))
        assert found.refusal == ""
        assert found.in_time is not None
        inside += int((np.abs(found.values - list(values.values())) < found.half_widths).sum())
        half = 1.96 * np.sqrt(np.diag(found.in_time.covariance))
        late += int((np.abs(found.in_time.values - list(values.values())) < half).sum())
    assert 36 <= inside <= 42
    assert 36 <= late <= 42


@pytest.fixture(scope="module")
def warm(plan: ExcitationPlan) -> Log:
    """The log of a machine with warm windings, and voltages that act a sample later than the gain file says."""
    return malta.identification.log_of(excited(plan, {**TRUE, "R": 2.6, "L": 2.5e-3}, delay=2))


@pytest.mark.slow
def test_the_drive_is_identified_from_voltages_and_currents(warm: Log) -> None:
    found = malta.identification.identify_windings(CONTROLLER, warm)
    assert found.refusal == ""
    assert found.chi2 == pytest.approx(1, abs=0.2)
    truth = {"R": 2.6, "L": 2.5e-3, "dead time": 125e-6}
    for name, (one, believed) in found.estimates.items():
        assert abs(one.value - truth[name]) < 2 * one.half
        assert one.half < 6e-4 * truth[name]  # 5.1e-4 of the dead time where this was measured
        assert believed == {"R": 2.2, "L": 2.8e-3, "dead time": 75e-6}[name]
    # |Kp + Ki/(jw)| / |R + jwL| = 1, and 50 us more of dead time take off w 50 us
    loop, w = CONTROLLER.current_loop, found.crossover
    assert loop is not None
    s = 1j * w
    gain = (loop.Kp + loop.Ki / s) / (2.6 + 2.5e-3 * s) * np.exp(-s * 125e-6)
    assert (abs(gain), np.angle(gain) + np.pi) == pytest.approx((1, found.phase_margin), rel=1e-3)


@pytest.mark.slow
def test_voltages_that_do_not_act_as_logged_are_refused(warm: Log) -> None:
    """Half-bridges that lose a share of each voltage at its sign, as by dead time."""
    u = warm.columns["u"]
    lossy = with_columns(warm, u=u + 0.2 * np.sign(u))
    found = malta.identification.identify_windings(CONTROLLER, lossy)
    assert found.refusal.startswith("chi2 / dof of the currents is")
    with pytest.raises(
        malta.InputError, match=r"run excited: u: found no voltages .* expected columns as u_0d1"
    ):
        malta.identification.identify_windings(
            CONTROLLER,
            replace(
                warm,
                signals={**warm.signals, "u": ()},
                columns={**warm.columns, "u": warm.columns["u"][:, :0]},
            ),
        )
    planar = malta.gains.read("design/gains/planar.json")
    with pytest.raises(malta.InputError, match="windings: found a planar"):
        malta.identification.identify_windings(planar, warm)
