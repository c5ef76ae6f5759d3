"""The Halbach motor as the pipeline sees it: its record, its commutation, and its electronics period by period."""

from __future__ import annotations

import math
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st

import malta
from malta.machines.halbach import electronics, electronics as motor, plant as halbach
from malta.machines.halbach.electronics import IDEAL_ELECTRONICS, REAL_ELECTRONICS, Options
from malta.machines.halbach.plant import Parameters
from malta.model.drive import Electronics
from malta.model.parameters import shape_parameters
from malta.model.plant import Plant, symbolic

if TYPE_CHECKING:
    from malta.arrays import FloatArray

State = dict[str, Any]
PLACE = st.floats(-50e-3, 50e-3)
FORCE = st.floats(-10, 10)
OPTIONS = [
    REAL_ELECTRONICS,
    IDEAL_ELECTRONICS,
    *(replace(REAL_ELECTRONICS, pwm=pwm) for pwm in ("exact", "fine")),
    replace(REAL_ELECTRONICS, adc_steps=False),
    replace(REAL_ELECTRONICS, adc_noise=False),
    *(replace(REAL_ELECTRONICS, mean_of=n) for n in (1, 2, 7)),
    *(replace(REAL_ELECTRONICS, pwm=pwm, current_loops=False) for pwm in ("plain", "exact", "fine")),
]
FAULTY: dict[str, Any] = {"r_a": 0.9, "r_b": 0.95, "r_c": 1.25, "a_a": 0.8, "a_b": 1.1, "a_c": 1.05}


@pytest.fixture(scope="module", params=["identified", "emf"])
def par(request: pytest.FixtureRequest) -> Parameters:
    parameters: Parameters = malta.read("data/halbach.toml", preset=request.param)
    return parameters


@pytest.fixture(scope="module")
def plant(par: Parameters) -> Plant:
    return halbach.plant(par)


def _flat(value: Any) -> FloatArray:
    return np.array(ca.DM(value), dtype=float).ravel()


# The record


def test_signals_and_numbers_of_the_record(par: Parameters, plant: Plant) -> None:
    assert [s.name for s in plant.states] == ["x", "x_dot"]
    assert [s.name for s in plant.actuator.coils] == ["i_a", "i_b", "i_c"]
    assert (plant.stroke.thrust, plant.stroke.name, plant.stroke_state, plant.thrust_input) == (
        "F_x",
        "x",
        0,
        0,
    )
    assert plant.sensors.noise[0] == pytest.approx(115.5e-9, rel=1e-3)  # of +-200 nm, uniform
    assert plant.sensors.uniform
    assert plant.actuator.crossover == pytest.approx(451, rel=1e-3)
    assert plant.actuator.force_limit == (2.0,)
    assert plant.actuator.voltage_limit == 6.0
    assert shape_parameters(par) == {"f_pwm": par.f_pwm, "T_laser": par.T_laser, "latency": 0}
    for latency in (0, 1):
        late = halbach.plant(replace(par, latency=latency))
        assert late.actuator.delay(par.T_laser) == latency


def test_functions_of_the_record_give_finite_numbers(plant: Plant) -> None:
    x, i = ca.DM([1e-3, 0.02]), ca.DM([1.0, -3.0, 2.0])
    values = [
        plant.f(x, ca.DM([0.3]), ca.DM([-0.1])),
        plant.h(x, 0),
        plant.load(x),
        plant.position_of(ca.DM([1e-3])),
        plant.preload(x),
        plant.actuator.currents(ca.DM([1e-3]), ca.DM([0.3])),
        plant.actuator.forces(x, i),
        plant.actuator.limited(i),
        plant.contacts.contact(x),
        plant.contacts.bearing(x),
        plant.sensors.sense(x, ca.DM([1e-6])),
    ]
    assert [len(_flat(v)) for v in values] == [2, 1, 1, 1, 1, 3, 1, 3, 1, 1, 1]
    assert all(np.isfinite(_flat(v)).all() for v in values)


@given(x=PLACE, v=FORCE)
def test_currents_make_the_force_they_are_made_for(x: float, v: float) -> None:
    plant = halbach.plant(malta.read("data/halbach.toml"))
    i = plant.actuator.currents(ca.DM([x]), ca.DM([v]))
    np.testing.assert_allclose(_flat(plant.actuator.forces(ca.DM([x, 0.3]), i)), [v], rtol=0, atol=1e-12)
    assert abs(_flat(i).sum()) < 1e-13


@given(i=st.lists(st.floats(-60, 60), min_size=2, max_size=2))
def test_limited_currents_keep_their_ratio_and_their_sum(i: list[float]) -> None:
    plant = halbach.plant(malta.read("data/halbach.toml"))
    wanted = np.array([*i, -sum(i)])
    found = _flat(plant.actuator.limited(ca.DM(wanted)))
    assert np.abs(found).max() <= plant.actuator.current_limit * (1 + 1e-15)
    assert abs(found.sum()) < 1e-13
    if np.abs(wanted).max() <= plant.actuator.current_limit:
        assert (found == wanted).all()
    np.testing.assert_allclose(np.cross(found, wanted), 0, atol=1e-10)


def test_motion_about_any_place(par: Parameters, plant: Plant) -> None:
    x, u, w = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("w")
    f = plant.f(x, u, w)
    J = ca.Function("J", [x, u, w], [ca.jacobian(f, ca.vertcat(x, u, w))])(ca.DM([7e-3, 0.2]), 1, 2)
    expected = np.array([[0.0, 1, 0, 0], [0, -par.b / par.m, 1 / par.m, 1 / par.m]])
    np.testing.assert_allclose(np.array(J), expected, rtol=1e-15)


@pytest.mark.parametrize("place", [0.0, 3.3e-3, -20e-3])
@pytest.mark.parametrize("error", [0.0, 0.1, -0.2])
def test_held_currents_are_a_spring(par: Parameters, plant: Plant, place: float, error: float) -> None:
    """H = + k F_z at the last reading, in the ratio of the true to the believed motor constant."""
    believed = halbach.plant(replace(par, A=par.A * (1 + error)))
    model = malta.linearize(plant, plant.at(x=place), believed)
    ratio = 1 / (1 + error)
    H = par.k * par.F_z * ratio
    np.testing.assert_allclose(model.A, np.array([[0.0, 1], [0, -par.b / par.m]]), rtol=1e-13, atol=1e-10)
    assert model.B.ravel() == pytest.approx([0, ratio / par.m])
    assert model.E.ravel() == pytest.approx([0, H / par.m])
    assert model.C.tolist() == [[1, 0]]
    # The same from forces and currents by differences.
    d = 1e-7
    i = [believed.actuator.currents(ca.DM([place + s * d]), ca.DM([0])) for s in (-1, 1)]
    F = [_flat(plant.actuator.forces(ca.DM([place, 0]), one))[0] for one in i]
    assert (F[1] - F[0]) / (2 * d) == pytest.approx(H, rel=1e-6)
    assert H * (1 + error) == pytest.approx(motor.stiffness(par, par.F_z))


def test_a_weak_phase_leaves_a_stiffness_that_goes_with_the_place(par: Parameters) -> None:
    """What commutation of a sound motor does not cancel of a motor with one weak magnet, where it is held still."""
    true, believed, d = halbach.plant(replace(par, a_a=0.9)), halbach.plant(par), 1e-7
    slopes = []

    def made(x: float, v: float) -> float:
        return float(
            _flat(true.actuator.forces(ca.DM([x, 0]), believed.actuator.currents(ca.DM([x]), ca.DM([v]))))[0]
        )

    for place in np.linspace(0, math.pi / par.k, 7):
        model = malta.linearize(true, true.at(x=place), believed)
        bias = made(place, 0.0)
        still = -bias / (made(place, 1.0) - bias)
        F = [made(x, still) for x in (place - d, place + d)]
        slopes.append(model.A[1, 0] * par.m)
        assert slopes[-1] == pytest.approx((F[1] - F[0]) / (2 * d), abs=1e-4)
    assert max(slopes) > 50 > -50 > min(slopes)  # N/m, beside a spring of 1055 N/m


# Electronics


def _arrays(state: State) -> dict[str, FloatArray]:
    return {name: _flat(value) for name, value in state.items()}


def _random(
    par: Parameters, o: Options, seed: int
) -> tuple[FloatArray, FloatArray, dict[str, FloatArray], FloatArray]:
    """x, i, state of the electronics and what they are told: anything that may be."""
    rng = np.random.default_rng(seed)
    x: FloatArray = np.array([0.04, 0.1]) * rng.standard_normal(2)
    i: FloatArray = 3 * rng.standard_normal(3)
    i -= i.mean()
    rings = rng.integers(0, 4096, (2, o.mean_of)).astype(float)
    state: dict[str, FloatArray] = {"duty": rng.uniform(0, 1, 3), "met": np.zeros(2)}
    if o.current_loops:
        state |= {
            "u": rng.standard_normal(2),
            "sums": rings.sum(axis=1),
            "ring_a": rings[0],
            "ring_b": rings[1],
        }
    angle = par.k * x[0] + 0.1 * rng.standard_normal()
    told: FloatArray = np.array([*(2 * rng.standard_normal(2)), math.cos(angle), math.sin(angle)])
    return x, i, state, told


def _period(e: Electronics) -> ca.Function:
    """`move_reference` as a function of flat vectors: (x, i, states, told, w, noise) -> (x, i, states)."""
    x, i, w, noise = (ca.SX.sym(n, k) for n, k in (("x", 2), ("i", 3), ("w", 1), ("noise", e.noises)))
    told, s = (
        ca.SX.sym("told", len(e.set_points)),
        {name: ca.SX.sym(name, size) for name, size in e.state.items()},
    )
    after_x, after_i, after = e.move(x, i, s, told, w, noise)
    assert list(after) == list(e.state)
    states = ca.vertcat(*(after[name] for name in e.state))
    return ca.Function("period", [x, i, ca.vertcat(*s.values()), told, w, noise], [after_x, after_i, states])


def _by_hand(
    par: Parameters,
    o: Options,
    x: FloatArray,
    i: FloatArray,
    s: dict[str, FloatArray],
    told: FloatArray,
    noise: FloatArray,
) -> tuple[FloatArray, FloatArray, dict[str, FloatArray]]:
    """One period in numbers, from the paper's (1), (6) and (8), written without anything of the module."""
    angles = math.atan2(told[3], told[2]) - np.array([0, 1, -1]) * 2 * math.pi / 3
    P = np.array([np.cos(angles), np.sin(angles)])
    R, step = par.R, 2 * par.I_adc / par.codes
    after, met = dict(s), np.zeros(2)
    if o.current_loops:
        read = i[:2] + (par.s_adc * noise if o.adc_noise else 0)
        codes = (read + par.I_adc) / step
        codes = np.clip(np.floor(codes + 0.5) if o.adc_steps else codes, 0, par.codes)
        met[1] = (np.abs(read) > par.I_adc).any()
        after["ring_a"], after["ring_b"] = (
            np.append(s["ring_a"][1:], codes[0]),
            np.append(s["ring_b"][1:], codes[1]),
        )
        after["sums"] = np.array([after["ring_a"].sum(), after["ring_b"].sum()])
        a, b = after["sums"] / o.mean_of * step - par.I_adc
        e = told[:2] - P @ [a, b, -a - b]
        w = (math.pi / 2 - par.pm_cc) * par.f_pwm / (1 + o.mean_of / 2)
        V = 2 / 3 * P.T @ (s["u"] + w * par.L * e)
    else:
        V = 2 / 3 * P.T @ (R * told[:2])
    wanted = 0.5 + V / par.V_dc
    duty = np.clip(wanted, 0, 1)
    met[0] = (duty != wanted).any()
    if o.current_loops:
        after["u"] = s["u"] + (0 if met[0] else w * R / par.f_pwm * e)
    if o.pwm != "exact":
        steps = par.counts if o.pwm == "plain" else par.V_dc / par.dV_fine
        duty = np.minimum(np.floor(duty * steps + 0.5) / steps, 1)
    after |= {"duty": duty, "met": np.maximum(s["met"], met)}
    u = par.V_dc * (s["duty"] - 0.5)
    r, share = np.array([par.r_a, par.r_b, par.r_c]), np.array([par.a_a, par.a_b, par.a_c])

    def rate(z: FloatArray) -> FloatArray:
        linked = share * np.cos(par.k * z[0] - np.array([0, 1, -1]) * 2 * math.pi / 3)
        drop = u - R * r * z[2:] - par.K_e * z[1] * linked
        return np.array(
            [z[1], (par.A * linked @ z[2:] - par.b * z[1] + 0.3) / par.m, *(drop - drop.mean()) / par.L]
        )

    z, h = np.append(x, i), 1 / par.f_pwm
    k1 = rate(z)
    k2 = rate(z + h / 2 * k1)
    k3 = rate(z + h / 2 * k2)
    z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + h * k3))
    return z[:2], z[2:], after


@pytest.mark.parametrize("o", OPTIONS, ids=str)
def test_a_period_against_one_written_out_in_numbers(par: Parameters, o: Options) -> None:
    faulty = replace(par, **FAULTY)
    e = electronics.electronics(faulty, o)
    assert e.noises == (2 if o.current_loops and o.adc_noise else 0)
    period = _period(e)
    for seed in range(20):
        x, i, s, told = _random(par, o, seed)
        noise = np.random.default_rng(seed).standard_normal(2)
        found = period(x, i, np.concatenate([s[name] for name in e.state]), told, 0.3, noise[: e.noises])
        x, i, s = _by_hand(faulty, o, x, i, s, told, noise)
        expected = [x, i, np.concatenate([s[name] for name in e.state])]
        for value, by_hand in zip(found, expected, strict=True):
            np.testing.assert_allclose(_flat(value), by_hand, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("o", OPTIONS, ids=str)
def test_300_periods_against_the_ones_written_out(par: Parameters, o: Options) -> None:
    faulty = replace(par, **FAULTY)
    e = electronics.electronics(faulty, o)
    x, i, s, told = _random(par, o, 0)
    told[:2] /= 3
    z = [x, i, np.concatenate([s[name] for name in e.state])]
    noise = np.random.default_rng(1).standard_normal((300, 2))
    period = _period(e)
    for row in noise:
        z = [_flat(v) for v in period(*z, told, 0.3, row[: e.noises])]
        x, i, s = _by_hand(faulty, o, x, i, s, told, row)
    for value, by_hand in zip(z, [x, i, np.concatenate([s[name] for name in e.state])], strict=True):
        np.testing.assert_allclose(value, by_hand, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e-3])
def test_what_loops_are_told(par: Parameters, plant: Plant, offset: float) -> None:
    """PlannedRun Id and Iq, and the Park angle; an error of the reading is one of the angle, k times as large."""
    y = plant.sensors.sense(ca.DM([2e-3, 0]), ca.DM([offset]))
    told = electronics.electronics(par).held(plant.actuator.currents(y, ca.DM(0.7)), y)
    angle = par.k * (2e-3 + offset)
    expected = [0.7 / par.A, par.F_z / par.A, math.cos(angle), math.sin(angle)]
    np.testing.assert_allclose(_flat(told), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("o", OPTIONS, ids=str)
def test_it_starts_with_rolling_means_full_of_what_flows(par: Parameters, plant: Plant, o: Options) -> None:
    i = plant.actuator.currents(ca.DM([2e-3]), ca.DM([0]))
    e = electronics.electronics(par, o)
    found = _arrays(e.start(ca.DM([2e-3, 0]), i))
    assert {name: len(value) for name, value in found.items()} == dict(e.state)
    assert found["met"].tolist() == [0, 0]
    duty = 0.5 + par.R * _flat(i) / par.V_dc
    np.testing.assert_allclose(
        found["duty"], duty, rtol=0, atol=0.5 * 6e-3 / 12 if o.pwm != "exact" else 1e-12
    )
    if o.current_loops:
        np.testing.assert_allclose(found["u"], [0, par.R * par.F_z / par.A], rtol=0, atol=1e-12)
        for phase, ring in enumerate(("ring_a", "ring_b")):
            assert np.ptp(found[ring]) == 0
            assert found["sums"][phase] == pytest.approx(o.mean_of * found[ring][0])
            flowing = found[ring][0] * 2 * par.I_adc / par.codes - par.I_adc
            assert flowing == pytest.approx(_flat(i)[phase], abs=0.0051 if o.adc_steps else 1e-12)


@pytest.mark.parametrize("loops", [True, False])
def test_it_starts_in_a_steady_state(par: Parameters, loops: bool) -> None:
    """With exact parts nothing moves; with loops not even where windings are unequal."""
    o = replace(IDEAL_ELECTRONICS, current_loops=loops)
    p = replace(par, r_a=0.9, r_c=1.3) if loops else par
    e, machine = electronics.electronics(p, o), halbach.plant(p)
    y = ca.DM([4e-3])
    x, i = ca.DM([4e-3, 0]), machine.actuator.currents(y, ca.DM([0]))
    state, told = e.start(x, i), e.held(i, y)
    period = _period(e)
    at = [_flat(x), _flat(i), np.concatenate([_flat(state[name]) for name in e.state])]
    z = at
    for _ in range(500):
        z = [_flat(v) for v in period(*z, told, 0, np.zeros(0))]
    for now, before in zip(z, at, strict=True):
        np.testing.assert_allclose(now, before, rtol=1e-9, atol=1e-9)


@pytest.mark.slow
def test_limits_are_kept_in_mind(par: Parameters) -> None:
    e = electronics.electronics(par, IDEAL_ELECTRONICS)
    period, place = _period(e), ca.DM([0.0])
    machine = halbach.plant(par)
    for forces, flags in (
        ((0.0, 5.0), [0, 0]),
        ((40.0, 0.0), [1, 0]),
        ((60.0, 0.0), [1, 1]),
        ((0.0, 60.0), [1, 1]),
    ):
        i = motor.phase_currents(par, 0.0, *forces)
        far = ca.DM(i) if flags[1] else machine.actuator.currents(place, ca.DM([0]))
        state = e.start(ca.DM([0, 0]), far)
        z = [np.zeros(2), _flat(far), np.concatenate([_flat(state[name]) for name in e.state])]
        for _ in range(3):
            z = [_flat(v) for v in period(*z, e.held(i, place), 0, np.zeros(0))]
        names = np.split(z[2], np.cumsum(list(e.state.values()))[:-1])
        after = dict(zip(e.state, names, strict=True))
        assert _flat(e.met(after)).tolist() == flags
        assert np.isfinite(np.concatenate(z)).all()
        assert ((_flat(e.duty(after)) >= 0) & (_flat(e.duty(after)) <= 1)).all()
        for _ in range(400):  # met once, met for good
            z = [_flat(v) for v in period(*z, e.held(0 * i, place), 0, np.zeros(0))]
        after = dict(zip(e.state, np.split(z[2], np.cumsum(list(e.state.values()))[:-1]), strict=True))
        assert _flat(e.met(after)).tolist() == flags


def _symbols(par: Parameters) -> tuple[Parameters, list[Any], list[float]]:
    names = [f.name for f in fields(par) if "unit" in f.metadata and f.name not in shape_parameters(par)]
    symbols = {name: ca.SX.sym(name) for name in names}
    return symbolic(par, symbols), list(symbols.values()), [getattr(par, name) for name in names]


def test_plant_in_symbols_of_its_parameters(par: Parameters) -> None:
    numeric = replace(par, **FAULTY)
    record, symbols, values = _symbols(numeric)
    x, u, w = ca.DM([1e-3, 0.02]), ca.DM([0.3]), ca.DM([-0.1])
    i = ca.DM([18.0, -30.0, 12.0])

    def all_of(plant: Plant) -> Any:
        a = plant.actuator
        numbers = (*a.force_limit, *a.force_constant, a.current_limit, a.voltage_limit, a.R, a.L, a.crossover)
        numbers += (
            a.phase_margin,
            a.sample_time,
            a.dead_time,
            *plant.sensors.noise,
            *plant.sensors.resolution,
            *plant.inertia,
        )
        numbers += (plant.stroke.mass, plant.stroke.travel)
        made = (
            plant.f(x, u, w),
            plant.actuator.currents(x[0], u),
            plant.actuator.forces(x, i),
            plant.actuator.limited(i),
            plant.contacts.contact(x),
        )
        return ca.vertcat(*made, *numbers)

    found = ca.Function("found", symbols, [all_of(halbach.plant(record))])(*values)
    np.testing.assert_allclose(_flat(found), _flat(all_of(halbach.plant(numeric))), rtol=1e-14)


@pytest.mark.parametrize("o", OPTIONS, ids=str)
def test_electronics_in_symbols_of_the_parameters(par: Parameters, o: Options) -> None:
    numeric = replace(par, **FAULTY)
    record, symbols, values = _symbols(numeric)
    build = halbach.plant(record).actuator.electronics
    assert build is not None
    e = build(o)
    x, i, state, told = _random(par, o, 5)
    noise = ca.DM([0.4, -1.2])[: e.noises]

    def all_of(e: Electronics) -> Any:
        after = e.move(
            ca.DM(x), ca.DM(i), {k: ca.DM(v) for k, v in state.items()}, ca.DM(told), ca.DM([0.3]), noise
        )
        start = e.start(ca.DM(x), ca.DM(i))
        assert list(start) == list(after[2]) == list(e.state)
        parts = (*after[:2], *after[2].values(), *start.values(), e.held(ca.DM(i), ca.DM([1e-3])))
        return ca.vertcat(*parts)

    assert isinstance(e.period, float)
    found = ca.Function("found", symbols, [all_of(e)])(*values)
    np.testing.assert_allclose(
        _flat(found), _flat(all_of(electronics.electronics(numeric, o))), rtol=1e-12, atol=1e-12
    )


def test_bad_options_are_refused_in_one_sentence(par: Parameters) -> None:
    refused: list[tuple[Any, str]] = [
        (lambda: Options(pwm="coarse"), "pwm: found 'coarse', expected one of exact, plain, fine"),  # type: ignore[arg-type]
        (lambda: Options(mean_of=0), "mean_of: found 0, expected 1 to 4096 samples"),
        (lambda: Options(mean_of=True), "mean_of: found True, expected 1 to 4096 samples"),
        (lambda: Options(mean_of=2.5), "mean_of: found 2.5, expected 1 to 4096 samples"),  # type: ignore[arg-type]
        (lambda: Options(current_loops="no"), "current_loops: found 'no', expected True or False"),  # type: ignore[arg-type]
        (lambda: replace(par, latency=2), "latency: found 2, expected 0 or 1 readings of the laser"),
        (lambda: replace(par, latency=0.5), "latency: found 0.5, expected 0 or 1"),
        (lambda: replace(par, F_z=-1.0), "F_z: found -1.0 N, expected a finite number of at least 0 in N"),
        (lambda: replace(par, r_a=0.0), "r_a: found 0.0 1, expected a finite number above 0"),
        (lambda: replace(par, pm_cc=2.0), "pm_cc: found 115 deg, expected less than 90 deg"),
    ]
    for call, sentence in refused:
        with pytest.raises(malta.InputError) as caught:
            call()
        assert sentence in str(caught.value)
