"""What the Halbach motor's DSP resolves: ends of the high-resolution PWM, fixed-point angles, current samples."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.machines.halbach import electronics, electronics as motor
from malta.machines.halbach.electronics import DEAD_ENDS, IDEAL_ELECTRONICS, IQ_BITS, Options
from malta.machines.halbach.plant import Parameters
from malta.model.plants import plant_of
from malta.model.printed import published_value
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.simulation.trajectory import Trajectory
from malta_papers.halbach import claims

GAINS = "design/gains/{}.json"
PLACE = 0.3e-3  # m, where angles and voltages lie between steps


@pytest.fixture(scope="module")
def par() -> Parameters:
    parameters: Parameters = malta.read("data/halbach.toml")
    return parameters


@pytest.fixture(scope="module")
def paper(par: Parameters) -> Any:
    """The part of the evidence that needs no design."""
    printed = malta.model.read_published("data/halbach.toml")
    return SimpleNamespace(par=par, value=lambda key: published_value(printed, key))


def hold(name: str, options: Options, readings: int = 300, **changes: Any) -> Trajectory:
    """A motor at rest at PLACE, without noise of the laser."""
    c = malta.gains.read(GAINS.format(name))
    reference = partial(malta.references.hold, x=PLACE)
    scenario = Scenario("hold", readings * c.sample_time, reference, fidelity="phase", electronics=options)
    return simulate(plant_of(c.parameters), c, replace(scenario, **changes))


# Ends of the high-resolution PWM


def test_fine_steps_end_before_0_and_100_percent(par: Parameters) -> None:
    """Within 3 counts of either end duty cycles are whole counts; from there on, and by default, nothing changes."""
    counts = np.array([0.0, 0.4, 0.6, 2.05, 2.9, 3.0, 3.3, 1000.3, 2044.7, 2045.0, 2045.3, 2047.6])
    V = par.V_dc * (counts / par.counts - 0.5)
    fine, plain = (np.array(electronics.modulate(par, ca.DM(V), pwm)[0]).ravel() for pwm in ("fine", "plain"))
    ended = np.array(electronics.modulate(par, ca.DM(V), "fine", DEAD_ENDS)[0]).ravel()
    inside = np.minimum(counts, 2048 - counts) < 3
    np.testing.assert_allclose(ended[inside] * 2048, np.floor(counts[inside] + 0.5), rtol=0, atol=1e-9)
    np.testing.assert_allclose(ended[inside], plain[inside], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(ended[~inside], fine[~inside])
    assert np.abs(fine - counts / 2048).max() * par.V_dc < par.dV_fine / 2 + 1e-12


@pytest.mark.slow
def test_the_working_point_of_the_paper_is_far_from_the_ends(par: Parameters) -> None:
    """At 5 N duty cycles are 32.7 to 67.3 %; the fine steps reach to 14.42 of the supply's 14.46 N."""
    assert electronics.largest_fine_force(par, 0) == pytest.approx(14.4603, abs=1e-4)
    most = electronics.largest_fine_force(par)
    assert most == pytest.approx(14.4179, abs=1e-4)
    V = par.R * motor.phase_currents(par, math.pi / 2 / par.k, 0, most)
    assert float(ca.mmax(motor.duty_cycles(par, V))) == pytest.approx(1 - 3 / 2048, rel=1e-12)
    places = np.linspace(0, math.pi / par.k, 400)
    for F_z in (5.0, 0.9999 * most):
        np.testing.assert_array_equal(
            electronics.resting_points(par, places, F_z, "fine", DEAD_ENDS),
            electronics.resting_points(par, places, F_z, "fine"),
        )


@pytest.mark.slow
def test_the_ends_cost_eight_times_in_place_and_a_hundred_times_in_force(par: Parameters) -> None:
    """At 14.45 N. A phase near its limit makes the vertical force, so the place is hardly off: 90 nm, not 2.5 um."""
    places = np.linspace(0, math.pi / 3 / par.k, 1001)

    def off(pwm: electronics.Pwm, ends: int) -> tuple[float, float]:
        points = electronics.resting_points(par, places, claims.DEAD_FORCE, pwm, ends)
        F = points[:, 1] / claims.DEAD_FORCE
        return 1e9 * float(np.abs(points[:, 0] - places).max()), 1e6 * float(np.abs(F - 1).max())

    assert off("fine", 0) == pytest.approx((11.6, 2.4), rel=0.03)
    assert off("fine", DEAD_ENDS) == pytest.approx((90, 324), rel=0.05)
    assert off("plain", 0) == pytest.approx((2530, 534), rel=0.03)


@pytest.mark.slow
def test_the_ends_in_flight() -> None:
    """At 5 N the ends of the paper's DSP change no bit of a flight. Ends that meet leave the plain PWM's steps."""
    voltages = replace(IDEAL_ELECTRONICS, current_loops=False)
    plain, fine, ended, met = (
        hold("halbach", options, 100, open_loop=True)
        for options in (
            replace(voltages, pwm="plain"),
            replace(voltages, pwm="fine"),
            replace(voltages, pwm="fine", dead_ends=DEAD_ENDS),
            replace(voltages, pwm="fine", dead_ends=1024),
        )
    )
    np.testing.assert_array_equal(fine.duty, ended.duty)
    np.testing.assert_array_equal(fine.p, ended.p)
    np.testing.assert_allclose(met.duty, plain.duty, rtol=0, atol=1e-12)
    assert abs(fine.p[-1, 0] - PLACE) < 35e-9 < 1e-6 < abs(met.p[-1, 0] - PLACE)


# Fixed-point angles


@pytest.mark.parametrize("bits", [12, 24])
def test_fixed_point_angles_are_off_by_half_a_step(par: Parameters, bits: int) -> None:
    """Half a step of 24 bits is 0.89 nm of position: below the paper's 1 nm. Cosine and sine add half a step each."""
    x = np.random.default_rng(0).uniform(-50e-3, 50e-3, 4000)
    c, s = np.array(electronics.fixed_point_angle(par, ca.DM(x).T, bits))
    error = np.angle((c + 1j * s) * np.exp(-1j * par.k * x)) / par.k
    half = math.pi / par.k / 2**bits
    assert 0.95 * half < np.abs(error).max() < half * (1 + 1.5 / math.pi)
    np.testing.assert_array_equal(c * 2**bits, np.round(c * 2**bits))
    assert half == pytest.approx({12: 3.635e-6, 24: 0.887e-9}[bits], rel=1e-3)


@pytest.mark.slow
def test_fixed_point_angles_at_rest() -> None:
    """The PID never rests: 0.7 nm rms with 24 bits, and 250 times as much with 16. The LQG comes to rest."""
    worst = {}
    for name, bits in (("halbach_pid", IQ_BITS), ("halbach_pid", 16), ("halbach", IQ_BITS)):
        run = hold(name, replace(IDEAL_ELECTRONICS, angle_bits=bits))
        worst[name, bits] = 1e9 * float((run.p[40:, 0] - PLACE).std())
    assert 0.2 < worst["halbach_pid", IQ_BITS] < 1.0
    assert 100 < worst["halbach_pid", 16] / worst["halbach_pid", IQ_BITS] < 500
    assert worst["halbach", IQ_BITS] < 0.05
    exact = hold("halbach_pid", IDEAL_ELECTRONICS)
    assert 1e9 * float((exact.p[40:, 0] - PLACE).std()) < 0.01


def test_the_forces_that_are_wanted_have_no_angle_in_them(par: Parameters) -> None:
    """Id* and Iq* are F / A whatever the angle's bits, so the angle's error turns the currents."""
    i, y = motor.phase_currents(par, PLACE, 0.5, 5.0), ca.DM([PLACE])
    for bits in (None, 8):
        held = electronics.electronics(par, Options(angle_bits=bits)).held(i, y)
        np.testing.assert_allclose(np.array(held)[:2, 0] * par.A, [0.5, 5.0], rtol=0, atol=1e-12)
        turned = math.atan2(float(held[3]), float(held[2])) - par.k * PLACE
        assert (abs(turned) > 1e-3) == (bits == 8)


# Current samples


def test_range_of_current_samples(par: Parameters, paper: Any) -> None:
    """The printed 0.12 A is the range of 177 samples; 32 have 0.092 A. Both by drawing samples, too."""
    count = round(claims.samples_of_range(paper))
    assert count == 177
    rng = np.random.default_rng(1)
    for n, wanted in ((count, 0.12), (32, 0.0919)):
        noisy = 1.234 + par.s_adc * rng.standard_normal((2000, n))
        codes = np.array(electronics.sample_current(par, noisy, steps=True)[0])
        drawn = float(np.ptp(codes, axis=1).mean()) * electronics.adc_step(par)
        assert electronics.expected_range(par, n) == pytest.approx(wanted, abs=3e-4)
        assert drawn == pytest.approx(wanted, rel=0.02)


def test_bits_of_the_rolling_mean(paper: Any) -> None:
    """White noise: log2 sqrt(32) = 2.5. The paper's own figures, 22 and 3.2 mA, are 2.8; its text says two."""
    assert claims.bits_of_mean(paper) == pytest.approx(2.5, abs=0.03)
    ratio = paper.value("current_sampling.noise") / paper.value("current_sampling.noise_of_mean")
    assert math.log2(ratio) == pytest.approx(2.78, abs=0.01)


@pytest.mark.slow
def test_rows_of_the_ledger(paper: Any) -> None:
    """The new rows that need no flight, by their subjects."""
    rows = {row.subject: row for row in claims.rows()}
    for subject, value in (
        ("more air gap that costs a tenth of A, (2)", 0.49934e-3),
        ("current sensor: range of 32 samples", 0.0919),
        ("samples that range over the printed 0.12 A", 177),
        ("bits that the rolling mean adds", 2.49),
        ("vertical force up to which PWM steps are fine", 14.418),
        ("at 14.45 N, in the dead ends: rest off by", 89.8e-9),
        ("at 14.45 N, if there were none: rest off by", 11.6e-9),
    ):
        assert rows[subject].value(paper) == pytest.approx(value, rel=5e-3)


# Refusals


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"dead_ends": -1}, "dead_ends: found -1, expected 0 to 1024 counts"),
        ({"dead_ends": True}, "dead_ends: found True"),
        ({"dead_ends": 1.5}, "dead_ends: found 1.5"),
        ({"angle_bits": 3}, "angle_bits: found 3, expected None, or 4 to 48 bits"),
        ({"angle_bits": 24.5}, "angle_bits: found 24.5"),
    ],
)
def test_bad_options_are_refused_in_one_sentence(options: dict[str, Any], sentence: str) -> None:
    with pytest.raises(malta.InputError) as caught:
        Options(**options)
    assert sentence in str(caught.value)
