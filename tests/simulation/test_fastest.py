"""The fastest stroke: other routes to its duration, its limits, conservation, and the reference that comes of it.

R = K_ind = F_c = 0     T = 2 (t_a + t_j) + Ts / 2,  t_j = i_max L / u_max,  d = a t_a (t_a + t_j),  a = k i_max / m
Ts -> 0                 single shooting on five arcs: u_max, i_max, -u_max, -i_max, u_max
L, Ts -> 0, u_max large T -> 2 sqrt(d / a)
impulse                 integral of (k i + cogging) = 0
energy                  integral of u i = integral of (R i^2 + K_ind v i) + L i^2 / 2 at the ends
"""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import simpson, solve_ivp
from scipy.optimize import fsolve

import malta
from malta.machines.tubular import plant as tubular
from malta.model.equilibrium import load_balance
from malta.simulation.experiments import time_optimal as fastest
from malta.simulation.experiments.time_optimal import FastestStroke, fastest_stroke, sigmoid_at_peak_current
from malta.synthesis.feedforward import static_feedforward

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.arrays import FloatArray
    from malta.model.plant import Plant

DISTANCE = 10e-3  # m


def with_actuator(plant: Plant, **changes: float) -> Plant:
    return replace(plant, actuator=replace(plant.actuator, **changes))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def smooth(par: tubular.Parameters) -> Plant:
    """The machine without cogging."""
    return tubular.plant(replace(par, F_c=0.0))


@pytest.fixture(scope="module")
def stroke(plant: Plant, par: tubular.Parameters) -> FastestStroke:
    return fastest_stroke(plant, DISTANCE, par.K_ind)


def bang_bang(plant: Plant, distance: float = DISTANCE) -> float:
    """2 sqrt(d / a), s: the current jumps, nothing cogs."""
    return 2 * math.sqrt(distance * plant.stroke.mass / plant.actuator.force_limit[plant.thrust_input])


def shooting(par: tubular.Parameters, distance: float) -> float:
    """T (s) of five arcs whose switching times meet the end; u may jump. The equations by hand."""
    k, wave = 2 * par.K_D, 2 * math.pi / par.L_p

    def arc(
        y: FloatArray, u: float | None, duration: float, until: float | None = None
    ) -> tuple[FloatArray, float]:
        def rate(_: float, y: FloatArray) -> list[float]:
            z, v, i = y
            cogging = par.F_c * math.sin(wave * z + par.phi_c)
            slope = 0.0 if u is None else (u - par.R * i - par.K_ind * v) / par.L
            return [v, (k * i + cogging) / par.m, slope]

        def reached(_: float, y: FloatArray) -> float:
            return float(y[2]) - (until or 0.0)

        reached.terminal = True  # type: ignore[attr-defined]
        events = None if until is None else reached
        run = solve_ivp(rate, (0, duration), y, method="DOP853", rtol=1e-10, atol=1e-12, events=events)
        return run.y[:, -1], float(run.t[-1])

    def held(z: float) -> float:
        return -par.F_c * math.sin(wave * z + par.phi_c) / k

    def end(times: FloatArray) -> tuple[FloatArray, float]:
        y, T = np.array([-distance / 2, 0.0, held(-distance / 2)]), 0.0
        for u, duration, until in (
            (par.V_max, 1.0, par.I_max),
            (None, times[0], None),
            (-par.V_max, 1.0, -par.I_max),
            (None, times[1], None),
            (par.V_max, times[2], None),
        ):
            y, took = arc(y, u, duration, until)
            T += took
        return (y - [distance / 2, 0.0, held(distance / 2)]) / [distance, 1.0, par.I_max], T

    first = bang_bang(tubular.plant(par), distance) / 2 - 1e-3

    def miss_of(times: FloatArray) -> FloatArray:
        return end(times)[0]

    times = fsolve(miss_of, [first, first, 0.5e-3], xtol=1e-10)
    miss, T = end(times)
    assert np.abs(miss).max() < 1e-8
    return T


@pytest.mark.slow
def test_malta_against_the_sigmoid_of_the_same_current(
    plant: Plant, par: tubular.Parameters, stroke: FastestStroke
) -> None:
    sigmoid = sigmoid_at_peak_current(plant, DISTANCE, par.K_ind)
    assert stroke.duration == pytest.approx(17.394e-3, rel=1e-3)
    assert stroke.rise == pytest.approx(9.260e-3, rel=1e-3)
    assert stroke.travel_time(1e-3) == pytest.approx(16.092e-3, rel=1e-3)
    assert sigmoid.rise == pytest.approx(11.394e-3, rel=1e-3)
    assert sigmoid.travel_time(1e-3) == pytest.approx(35.815e-3, rel=1e-3)
    assert sigmoid.current == pytest.approx(par.I_max, rel=1e-9)
    assert sigmoid.voltage == pytest.approx(12.81, rel=1e-3)  # of 22.5 V: the winding does not limit it


@pytest.mark.slow
@pytest.mark.parametrize("distance", [DISTANCE, 25e-3])
def test_shooting_on_switching_times_takes_as_long(par: tubular.Parameters, distance: float) -> None:
    ideal = shooting(par, distance)
    plant = tubular.plant(par)
    quick = fastest_stroke(with_actuator(plant, sample_time=1e-6), distance, par.K_ind)
    assert quick.duration == pytest.approx(ideal, rel=1e-4)
    real = fastest_stroke(plant, distance, par.K_ind).duration
    assert ideal < real < 1.005 * ideal  # what the controllers' period costs


@pytest.mark.slow
@pytest.mark.parametrize("period", [10e-6, 50e-6, 400e-6])
def test_without_resistance_the_closed_form(smooth: Plant, period: float) -> None:
    plant = with_actuator(smooth, R=0.0, sample_time=period)
    drive = plant.actuator
    a = drive.force_limit[plant.thrust_input] / plant.stroke.mass
    t_j = drive.current_limit * drive.L / drive.voltage_limit
    t_a = -t_j / 2 + math.sqrt(t_j**2 / 4 + DISTANCE / a)
    stroke = fastest_stroke(plant, DISTANCE, 0.0)
    assert stroke.duration == pytest.approx(2 * (t_a + t_j) + period / 2, rel=2e-4)
    assert np.abs(stroke.v).max() == pytest.approx(a * t_a, rel=1e-3)


@pytest.mark.slow
def test_bang_bang_is_the_limit_of_an_ideal_drive(smooth: Plant, par: tubular.Parameters) -> None:
    limit = bang_bang(smooth)
    excess = []
    for ideal in (1, 3, 10):  # times the voltage, a part of the inductance and of the period
        drive = smooth.actuator
        plant = with_actuator(
            smooth,
            voltage_limit=drive.voltage_limit * ideal,
            L=drive.L / ideal,
            sample_time=drive.sample_time / ideal,
        )
        excess.append(fastest_stroke(plant, DISTANCE, par.K_ind).duration / limit - 1)
    assert excess[0] > 0.03
    assert excess[0] > 3 * excess[1] > 9 * excess[2] > 0
    assert excess[2] < 1e-3


@pytest.mark.slow
def test_a_finer_mesh_takes_as_long(plant: Plant, par: tubular.Parameters, stroke: FastestStroke) -> None:
    for intervals in (100, 300):
        other = fastest_stroke(plant, DISTANCE, par.K_ind, intervals=intervals)
        assert other.duration == pytest.approx(stroke.duration, rel=3e-4)
        assert other.rise == pytest.approx(stroke.rise, rel=3e-4)


@pytest.mark.slow
@settings(max_examples=3, deadline=None)
@given(distance=st.floats(1e-4, 0.03), voltage_share=st.floats(0.2, 0.9), current_share=st.floats(0.2, 0.9))
def test_more_of_a_limit_never_takes_longer(
    plant: Plant, par: tubular.Parameters, distance: float, voltage_share: float, current_share: float
) -> None:
    def duration(**shares: float) -> float:
        return fastest_stroke(plant, distance, par.K_ind, intervals=100, **shares).duration

    T = duration(voltage_share=voltage_share, current_share=current_share)
    assert duration(voltage_share=1.0, current_share=current_share) < 1.001 * T
    assert duration(voltage_share=voltage_share, current_share=1.0) < 1.001 * T
    assert bang_bang(plant, distance) / 1.05 < T  # cogging may help


@pytest.mark.slow
def test_backwards_is_the_mirror_image(smooth: Plant, par: tubular.Parameters, stroke: FastestStroke) -> None:
    there, back = (fastest_stroke(smooth, d, par.K_ind, intervals=80) for d in (DISTANCE, -DISTANCE))
    assert back.duration == pytest.approx(there.duration, rel=1e-6)
    assert back.z == pytest.approx(-there.z, abs=1e-5)
    there, back = (
        fastest_stroke(tubular.plant(replace(par, F_c=5.0, phi_c=phi)), d, par.K_ind, intervals=80)
        for d, phi in ((DISTANCE, 1.0), (-DISTANCE, -1.0))
    )
    assert back.duration == pytest.approx(there.duration, rel=1e-4)
    assert abs(there.duration / stroke.duration - 1) > 1e-2


@pytest.mark.slow
def test_the_limits_hold_between_the_nodes_too(
    plant: Plant, par: tubular.Parameters, stroke: FastestStroke
) -> None:
    assert np.abs(stroke.u).max() <= par.V_max * (1 + 1e-6)
    assert np.abs(stroke.u).max() > 0.9999 * par.V_max
    assert np.abs(np.diff(stroke.u) / np.diff(stroke.t)).max() <= 2 * par.V_max / par.T_cc * (1 + 1e-6)
    run = flown(plant, par, stroke)
    current = run.sol(np.linspace(0, stroke.duration, 5001))[-1]
    assert 0.9999 * par.I_max < np.abs(current).max() < 1.0001 * par.I_max


@pytest.mark.slow
def test_the_whole_machine_arrives(plant: Plant, par: tubular.Parameters, stroke: FastestStroke) -> None:
    end = flown(plant, par, stroke).y[:, -1]
    assert end[2] == pytest.approx(DISTANCE / 2, abs=1e-4 * DISTANCE)
    assert end[8] == pytest.approx(0.0, abs=1e-3 * stroke.v.max())
    assert end[12] == pytest.approx(stroke.i[-1], abs=1e-3 * par.I_max)
    assert np.abs(np.delete(end, [2, 8, 12])).max() < 1e-9


def flown(plant: Plant, par: tubular.Parameters, stroke: FastestStroke) -> Any:
    """All six degrees of freedom and the current, under the stroke's voltage and the bearing forces that hold."""
    grid = np.linspace(-plant.stroke.travel, plant.stroke.travel, 3)
    holding = load_balance(plant, np.array([plant.at(z=z).x for z in grid]))[:, :4]  # linear in z

    def rate(t: float, y: FloatArray) -> FloatArray:
        x, i = y[:12], y[12]
        bearing = [np.interp(x[2], grid, column) for column in holding.T]
        xd = np.array(plant.f(x, np.array([*bearing, 2 * par.K_D * i]), plant.load(x))).ravel()
        u = np.interp(t, stroke.t, stroke.u)
        return np.append(xd, (u - par.R * i - par.K_ind * x[8]) / par.L)

    y = np.zeros(13)
    y[[2, 12]] = -DISTANCE / 2, stroke.i[0]
    step = stroke.duration / 300
    return solve_ivp(rate, (0, stroke.duration), y, dense_output=True, max_step=step, rtol=1e-7, atol=1e-10)


def test_impulse_and_energy_balance(par: tubular.Parameters, stroke: FastestStroke) -> None:
    """On the path between the nodes: i from z'', u from i."""
    t = np.unique(
        np.concatenate([np.linspace(a, b, 11) for a, b in zip(stroke.t[:-1], stroke.t[1:], strict=True)])
    )
    z, v, a, jerk = (stroke.path(t, nu=n) for n in range(4))
    wave, k = 2 * math.pi / par.L_p, 2 * par.K_D
    cogging = par.F_c * np.sin(wave * z + par.phi_c)
    i = (par.m * a - cogging) / k
    assert abs(simpson(k * i + cogging, t)) < 1e-6 * par.m * v.max()
    assert abs(simpson(k * i * v, t)) < 1e-5 * par.m * v.max() ** 2  # cogging is the same at both ends
    u = np.interp(t, stroke.t, stroke.u)
    heat, work = simpson(par.R * i**2, t), simpson(par.K_ind * v * i, t)
    stored = par.L / 2 * (i[-1] ** 2 - i[0] ** 2)
    assert simpson(u * i, t) == pytest.approx(heat + work + stored, rel=1e-3)
    assert 0.85 < heat / (par.R * par.I_max**2 * stroke.duration) < 1  # at the limit nearly all the time
    assert np.abs(jerk).max() < k / par.m * 2 * par.V_max / par.L  # no jumps of the current


def test_the_reference_is_smooth_and_at_rest_outside(plant: Plant, stroke: FastestStroke) -> None:
    reference = stroke.reference(plant, 0.05)
    t, h = np.linspace(0.03, 0.07, 40_001, retstep=True)
    p, dp, ddp = (part[:, 4] for part in reference(t))
    assert np.abs((p[2:] - p[:-2]) / (2 * h) - dp[1:-1]).max() < 1e-6 * dp.max()
    assert np.abs((dp[2:] - dp[:-2]) / (2 * h) - ddp[1:-1]).max() < 1e-3 * ddp.max()
    assert np.abs(np.diff(ddp)).max() < 0.02 * ddp.max()
    assert p[[0, -1]].tolist() == pytest.approx([-DISTANCE / 2, DISTANCE / 2], abs=1e-15)
    rest = (t < 0.05 - 0.51 * stroke.duration) | (t > 0.05 + 0.51 * stroke.duration)
    assert rest.any()
    assert np.ptp(p[t < 0.041]) == pytest.approx(0.0, abs=1e-15)
    assert not dp[rest].any()
    assert not ddp[rest].any()
    assert reference(np.array([0.05])).p[0, 4] == pytest.approx(0.0, abs=1e-12)
    assert not any(part[:, :4].any() for part in reference(t))
    assert ddp.max() == pytest.approx(stroke.a.max(), rel=1e-3)


def test_the_feedforward_of_a_gain_file_is_the_optimal_thrust(
    plant: Plant, par: tubular.Parameters, stroke: FastestStroke
) -> None:
    half = float(stroke.path.solve(0.0, extrapolate=False)[0])
    motion = stroke.reference(plant, half)(stroke.t)
    v0 = static_feedforward(plant)
    thrust = par.m * motion.ddp[:, 4] + [v0.at(float(z))[4] for z in motion.p[:, 4]]
    assert thrust == pytest.approx(2 * par.K_D * stroke.i, abs=2e-3 * par.F_c)  # v0(z) is a table


def test_a_stroke_and_its_reference_pickle(plant: Plant, stroke: FastestStroke) -> None:
    reference = partial(stroke.reference, centre=0.05)(plant)
    t = np.linspace(0.04, 0.06, 50)
    assert (pickle.loads(pickle.dumps(reference))(t).ddp == reference(t).ddp).all()
    assert pickle.loads(pickle.dumps(stroke)).rise == stroke.rise
    with pytest.raises(ValueError, match="read-only"):
        stroke.z[0] = 0.0


@pytest.mark.slow
def test_the_sigmoid_without_cogging_is_the_closed_form(smooth: Plant, par: tubular.Parameters) -> None:
    kappa = math.sqrt(2 * par.K_D * par.I_max / par.m * 6 * math.sqrt(3) / DISTANCE)
    sigmoid = sigmoid_at_peak_current(smooth, DISTANCE, par.K_ind)
    assert sigmoid.rise == pytest.approx(2 * math.log(9) / kappa, rel=1e-6)
    assert sigmoid.travel_time(1e-3) == pytest.approx(2 * math.log(999) / kappa, rel=1e-6)
    half = sigmoid_at_peak_current(smooth, DISTANCE, par.K_ind, current_share=0.5)
    assert half.rise == pytest.approx(sigmoid.rise * math.sqrt(2), rel=1e-6)
    back = sigmoid_at_peak_current(smooth, -DISTANCE, par.K_ind)
    assert (back.rise, back.voltage) == pytest.approx((sigmoid.rise, sigmoid.voltage), rel=1e-9)


@pytest.mark.slow
def test_the_sigmoid_is_told_when_the_voltage_is_short(plant: Plant, par: tubular.Parameters) -> None:
    with pytest.raises(malta.CheckError, match=r"takes 12\.8 V, more than 11\.2 V"):
        sigmoid_at_peak_current(plant, DISTANCE, par.K_ind, voltage_share=0.5)


@pytest.mark.parametrize("function", [fastest_stroke, sigmoid_at_peak_current])
@pytest.mark.parametrize(
    ("given", "match"),
    [
        ({"distance": 0.0}, r"stroke: distance: found 0\.0 m, expected one other than 0 m within the travel"),
        ({"distance": 0.031}, r"distance: found 0\.031 m"),
        ({"distance": math.nan}, "distance: found nan m"),
        ({"emf_constant": -1.0}, r"emf_constant: found -1\.0 V s/m, expected a finite number, 0 or more"),
        ({"voltage_share": 0.0}, r"voltage_share: found 0\.0, expected a share above 0, at most 1"),
        ({"current_share": 1.1}, r"current_share: found 1\.1"),
        ({"current_share": 0.009}, r"limits: found 0\.045 A, 22\.5 V, expected more than holds the load"),
    ],
)
def test_the_impossible_is_refused(
    function: Callable[..., object], plant: Plant, given: dict[str, float], match: str
) -> None:
    with pytest.raises(malta.InputError, match=match):
        function(plant, **{"distance": DISTANCE, "emf_constant": 1.74} | given)


def test_meshes_shares_and_axes_are_refused(plant: Plant, stroke: FastestStroke) -> None:
    with pytest.raises(malta.InputError, match="intervals: found 3, expected a whole number from 20 to 2000"):
        fastest_stroke(plant, DISTANCE, 1.74, intervals=3)
    with pytest.raises(malta.InputError, match=r"share: found 0\.5"):
        stroke.travel_time(0.5)
    with pytest.raises(
        malta.InputError, match="x: found an axis that other inputs push, expected fx_B1 alone"
    ):
        fastest_stroke(replace(plant, stroke=replace(plant.stroke, name="x", thrust="fx_B1")), 1e-4, 0.0)


@pytest.mark.slow
def test_an_answer_that_fails_its_check_is_none(
    plant: Plant, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(malta.CheckError, match="T still changes after 8 meshes"):
        fastest_stroke(with_actuator(plant, L=2.8e-5), DISTANCE, 1.74, intervals=20)
    monkeypatch.setattr(fastest, "TOLERANCE", 0.0)
    with pytest.raises(malta.CheckError, match=r"what lies between the nodes misses them by \d"):
        fastest_stroke(plant, DISTANCE, 1.74, intervals=50)
    monkeypatch.setitem(fastest.IPOPT, "max_iter", 2)
    with pytest.raises(malta.CheckError, match="IPOPT ended with Maximum_Iterations_Exceeded"):
        fastest_stroke(plant, DISTANCE, 1.74)
    assert capfd.readouterr() == ("", "")
