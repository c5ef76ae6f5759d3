"""The Halbach linear motor: the paper's figures, and our checks of its physics."""

from __future__ import annotations

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy.integrate import solve_ivp

import malta
from malta.gains.encodings import content_sha256
from malta.machines.halbach import electronics, electronics as motor, plant as halbach
from malta.machines.halbach.parameters import GAP, Parameters
from malta.model.parameters import values_of
from malta.model.printed import published_value
from malta.synthesis.design_models import sampled_model

if TYPE_CHECKING:
    from malta.arrays import FloatArray

GAINS = Path("design/gains/halbach.json")
F_Z = 5.0  # N, of all figures of the paper's Section 5
CURRENT = st.floats(-5, 5)
PLACE = st.floats(-50e-3, 50e-3)
FORCE = st.floats(-10, 10)


@pytest.fixture(scope="module")
def par() -> Parameters:
    """As identified: the friction holds the damping of the induced voltage."""
    parameters: Parameters = malta.read("data/halbach.toml")
    return parameters


@pytest.fixture(scope="module")
def emf() -> Parameters:
    """The same motor, with the induced voltage."""
    parameters: Parameters = malta.read("data/halbach.toml", preset="emf")
    return parameters


@pytest.fixture(scope="module")
def printed() -> dict[str, Any]:
    return malta.model.read_published("data/halbach.toml")


def _array(value: Any) -> FloatArray:
    return np.array(ca.DM(value))


def _flat(value: Any) -> FloatArray:
    return _array(value).ravel()


# Data


def test_the_two_presets_hold_the_same_damping(par: Parameters, emf: Parameters) -> None:
    assert motor.emf_damping(par) == 0
    assert motor.emf_damping(emf) == pytest.approx(3.87, abs=0.005)
    assert emf.b + motor.emf_damping(emf) == pytest.approx(par.b, rel=1e-5)
    assert emf.b == pytest.approx(5.54, abs=0.005)
    assert emf.K_e == emf.A
    assert motor.emf_damping(emf) / par.b == pytest.approx(0.41, abs=0.005)


def test_derived_data_agree_with_what_is_printed(par: Parameters, printed: dict[str, Any]) -> None:
    def value(key: str) -> float:
        return published_value(printed, key)

    assert 2 * math.pi / par.k == pytest.approx(value("motor.pitch"), rel=1e-5)
    assert par.f_pwm == pytest.approx(value("pwm.frequency"), abs=10)
    assert electronics.pwm_step(par, "plain") == pytest.approx(5.859e-3, abs=5e-7)
    assert round(electronics.pwm_step(par, "plain"), 3) == value("pwm.step")
    assert round(electronics.adc_step(par), 2) == value("current_sampling.step")
    micro_edge = par.V_dc * value("pwm.micro_edge") * par.f_pwm
    assert micro_edge == pytest.approx(
        2.637e-5, rel=1e-3
    )  # the printed 2.62e-5 V is 0.6 % less than its own 150 ps
    assert electronics.pwm_step(par, "fine") == pytest.approx(micro_edge, rel=1e-2)


# The motor law and its transform


@given(x=PLACE, d=CURRENT, q=CURRENT)
def test_the_two_transforms_are_inverse_among_currents_of_a_star(x: float, d: float, q: float) -> None:
    P, U = _array(motor.park(x, 211.0001)), _array(motor.unpark(x, 211.0001))
    np.testing.assert_allclose(P @ U, np.eye(2), rtol=0, atol=1e-14)
    np.testing.assert_allclose(U @ P, np.eye(3) - 1 / 3, rtol=0, atol=1e-14)
    np.testing.assert_allclose(U, np.linalg.pinv(P), rtol=0, atol=1e-14)
    i = U @ [d, q]
    assert abs(i.sum()) < 1e-14
    # Not amplitude-invariant: Id and Iq are 1.5 x the amplitude, and the squares sum as 3/2 of the phases'.
    assert i @ i == pytest.approx(2 / 3 * (d**2 + q**2), abs=1e-13)
    assert np.hypot(d, q) == pytest.approx(1.5 * math.sqrt(2 / 3 * i @ i), abs=1e-13)


@given(x=PLACE, F_x=FORCE, F_z=FORCE)
def test_currents_make_the_forces_they_are_made_for(x: float, F_x: float, F_z: float) -> None:
    par = malta.read("data/halbach.toml")
    i = motor.phase_currents(par, x, F_x, F_z)
    np.testing.assert_allclose(_flat(motor.forces(par, x, i)), [F_x, F_z], rtol=0, atol=1e-13)


def test_motor_constant_at_another_air_gap(par: Parameters, printed: dict[str, Any]) -> None:
    """(2): A e^(-k z_0). Nothing changes at the printed gap, 0.1 mm more takes 2.09 % and 0.499 mm more a tenth."""
    assert par.z_0 == GAP == pytest.approx(published_value(printed, "motor.air_gap"), rel=1e-12)
    assert float(motor.motor_constant(par)) == par.A
    at = {
        gap: float(motor.motor_constant(replace(par, z_0=gap))) / par.A
        for gap in (0.3e-3, 0.5e-3, 0.89934e-3)
    }
    assert list(at.values()) == pytest.approx([1.021324, 0.979121, 0.9], rel=1e-6)
    assert at[0.3e-3] * at[0.5e-3] == pytest.approx(1, rel=1e-12)


def test_forces_at_another_air_gap(par: Parameters, emf: Parameters) -> None:
    """Who does not know of 0.1 mm more gap gets 2.09 % less of both forces; who does gets what is commanded."""
    wide = replace(par, z_0=0.5e-3)
    for believed, share in ((par, 0.979121), (wide, 1.0)):
        i = motor.phase_currents(believed, 2e-3, 1.5, F_Z)
        np.testing.assert_allclose(_flat(motor.forces(wide, 2e-3, i)), [share * 1.5, share * F_Z], rtol=1e-6)
    # The induced voltage has the same factor, or power would come from nowhere.
    assert motor.emf_damping(replace(emf, z_0=0.5e-3)) == pytest.approx(0.979121**2 * motor.emf_damping(emf))
    i, v = np.array([1.0, -2.5, 1.5]), 0.3
    wide = replace(emf, z_0=0.5e-3)
    rate = _flat(motor.rates(wide, [1e-3, v, *i], ca.DM(3)))
    F_x = _flat(motor.forces(wide, 1e-3, i))[0]
    assert wide.R * i @ i + wide.L * i @ rate[2:] + F_x * v == pytest.approx(0, abs=1e-9)


def test_lift_of_many_positions(par: Parameters) -> None:
    rng = np.random.default_rng(0)
    x, i = 0.05 * rng.standard_normal(5), rng.standard_normal((5, 3))
    expected = [_flat(motor.forces(par, *pair))[1] for pair in zip(x, i, strict=True)]
    np.testing.assert_allclose(motor.vertical_force(par, x, i), expected, rtol=1e-14)


def test_figure_2(par: Parameters, printed: dict[str, Any]) -> None:
    i = [published_value(printed, f"figure_2.I_{p}") for p in "abc"]
    pitch = 2 * math.pi / par.k
    F = np.array([_flat(motor.forces(par, x, i)) for x in np.linspace(0, pitch, 361)])
    waves = np.fft.rfft(F[:-1], axis=0) / 180
    assert np.abs(waves[1]) == pytest.approx(published_value(printed, "figure_2.force"), rel=1e-3)
    assert np.abs(waves[2:]).max() < 1e-12
    apart = np.degrees(np.angle(waves[1, 1] / waves[1, 0]))
    assert abs(apart) == pytest.approx(90, abs=1e-9)


@given(
    x=PLACE,
    v=st.floats(-1, 1),
    i_a=CURRENT,
    i_b=CURRENT,
    V=st.lists(st.floats(-6, 6), min_size=3, max_size=3),
)
def test_power_balance(x: float, v: float, i_a: float, i_b: float, V: list[float]) -> None:
    """Electrical power is heat, magnetic and mechanical power; where the star point floats does not matter."""
    par = malta.read("data/halbach.toml", preset="emf")
    i = np.array([i_a, i_b, -i_a - i_b])
    rate = _flat(motor.rates(par, [x, v, *i], ca.DM(V)))
    F_x = _flat(motor.forces(par, x, i))[0]
    assert rate[:2] == pytest.approx([v, (F_x - par.b * v) / par.m])
    assert i @ V == pytest.approx(par.R * i @ i + par.L * i @ rate[2:] + F_x * v, abs=1e-9)
    lifted = _flat(motor.rates(par, [x, v, *i], ca.DM(V) + 3.0))
    np.testing.assert_allclose(rate, lifted, rtol=0, atol=1e-9)
    assert abs(rate[2:].sum()) < 1e-9


def test_one_step_a_period_is_enough(emf: Parameters) -> None:
    state, V = np.array([1e-3, 0.2, 1.0, -2.0, 1.0]), ca.DM([3, -1, 2])
    symbol = ca.SX.sym("s", 5)
    rates = ca.Function("rates", [symbol], [motor.rates(emf, symbol, V)])
    exact = solve_ivp(
        lambda _, s: rates(s).full().ravel(), (0, 1 / emf.f_pwm), state, rtol=1e-12, atol=1e-14
    ).y[:, -1]
    np.testing.assert_allclose(_flat(motor.advance(emf, state, V)), exact, rtol=1e-7, atol=1e-8)


# Servo system


def test_stiffness_is_the_secant_of_the_identification(par: Parameters, printed: dict[str, Any]) -> None:
    displacement, F_z = published_value(printed, "servo.step"), published_value(printed, "servo.F_z")
    assert motor.stiffness(par, F_z, displacement) == pytest.approx(204.8, abs=0.5)
    assert motor.stiffness(par, F_z, displacement) == pytest.approx(
        published_value(printed, "servo.K"), abs=0.5
    )
    assert motor.stiffness(par, F_z) == pytest.approx(211.0, abs=0.05)


def _sampled(p: Parameters, delay: int = 0) -> tuple[FloatArray, FloatArray, FloatArray]:
    plant = halbach.plant(p)
    return sampled_model(malta.linearize(plant, plant.at()), p.T_laser, delay)


def test_held_angle_makes_another_plant_than_a_mass_with_friction(par: Parameters, emf: Parameters) -> None:
    def poles(p: Parameters) -> list[float]:
        return sorted(np.linalg.eigvals(_sampled(p)[0]).real)

    assert poles(par) == [pytest.approx(0.509, abs=1e-3), pytest.approx(1)]
    assert poles(replace(par, F_z=0.0)) == [pytest.approx(0.871, abs=5e-4), pytest.approx(1)]  # no spring
    # Current loops work against the induced voltage: its damping is lost.
    assert poles(emf) == [pytest.approx(0.547, abs=1e-3), pytest.approx(1)]


@pytest.mark.parametrize("late", [0, 1])
def test_design_model_is_the_motor_law_about_the_last_reading(par: Parameters, late: int) -> None:
    """Small motions of m x'' = F_x(held currents, x) - b x', integrated, against the matrices."""
    Ad, Bd, Cd = _sampled(par, late)
    x, v, last, F = 2e-6, 3e-5, 1.2e-6, 2e-3
    i = _flat(motor.phase_currents(par, last if late else x, F, F_Z))

    def rate(_: float, s: FloatArray) -> list[float]:
        F_x = _flat(motor.forces(par, s[0], i))[0]
        return [s[1], (F_x - par.b * s[1]) / par.m]

    exact = solve_ivp(rate, (0, par.T_laser), [x, v], rtol=1e-10, atol=1e-16).y[:, -1]
    pull = par.k * F_Z  # N/m: what is stored is the force, and where the spring hangs from
    xi = np.array([x, v, F + pull * last][: len(Ad)])
    found = Ad @ xi + Bd[:, 0] * F
    np.testing.assert_allclose(found[:2], exact, rtol=1e-5)
    assert (Cd @ xi)[0] == x
    if late:
        assert found[2] == pytest.approx(F + pull * x)


# Electronics


def test_duty_cycles(par: Parameters, printed: dict[str, Any]) -> None:
    x = np.linspace(0, 2 * math.pi / par.k, 721)
    duty = np.array([_flat(motor.duty_cycles(par, par.R * motor.phase_currents(par, r, 0, F_Z))) for r in x])
    assert 100 * np.array([duty.min(), duty.max()]) == pytest.approx([32.7, 67.3], abs=0.05)
    assert np.abs(duty.sum(axis=1) - 1.5).max() < 1e-14
    limit = published_value(printed, "pwm.current")
    ends = _flat(motor.duty_cycles(par, par.R * ca.DM([-limit, limit])))
    assert ends == pytest.approx([published_value(printed, f"pwm.duty_{end}") for end in ("low", "high")])


@given(V=st.lists(st.floats(-9, 9), min_size=3, max_size=3))
def test_duty_cycles_come_in_steps_and_within_0_to_1(V: list[float]) -> None:
    par = malta.read("data/halbach.toml")
    wanted = 0.5 + np.array(V) / par.V_dc
    for pwm, step in (("plain", 1 / 2048), ("fine", par.dV_fine / par.V_dc)):
        d, limited = electronics.modulate(par, ca.DM(V), pwm)  # type: ignore[arg-type]
        inside = np.clip(wanted, 0, 1)
        assert np.abs(_flat(d) - inside).max() <= step / 2 + 1e-15
        part = _flat(d) / step
        assert ((np.abs(part - np.round(part)) < 1e-6) | (_flat(d) == 1)).all()
        assert bool(limited) == bool((wanted != inside).any())


def test_current_sampling(par: Parameters, printed: dict[str, Any]) -> None:
    for i, code in ((-20.625, 0), (20.625, 4095), (0.006, 2048), (-0.006, 2047), (30.0, 4095)):
        found, out = electronics.sample_current(par, i, steps=True)
        assert (float(found), bool(out)) == (code, abs(i) > 20.625)
    white = par.s_adc / math.sqrt(published_value(printed, "current_sampling.samples"))
    assert white == pytest.approx(3.9e-3, abs=5e-5)
    assert (
        published_value(printed, "current_sampling.noise_of_mean") < white
    )  # the paper's mean filters better


def test_smallest_motion_of_the_open_loop(par: Parameters, printed: dict[str, Any]) -> None:
    plain, fine = (electronics.dead_zones(par, F_Z, pwm)[1].max() for pwm in ("plain", "fine"))
    assert plain == pytest.approx(15.3e-6, rel=0.03)
    assert plain == pytest.approx(published_value(printed, "open_loop.smallest_motion"), rel=0.03)
    assert fine == pytest.approx(69e-9, rel=0.03)
    # The paper's 700 nm is ten times too large: the motion goes as the step of the voltage, 15 um x 26.2 uV / 5.86 mV.
    assert published_value(printed, "open_loop.smallest_motion_fine") / fine == pytest.approx(10, rel=0.05)


def test_dead_zones_are_where_duty_cycles_stand_still(par: Parameters) -> None:
    starts, lengths = electronics.dead_zones(par, F_Z, "plain")
    assert lengths.sum() == pytest.approx(2 * math.pi / par.k)
    for k in (lengths.argmax(), 100, 1000):
        inside = starts[k] + lengths[k] * np.array([0.001, 0.3, 0.6, 0.999])
        assert np.ptp(electronics.resting_positions(par, inside, F_Z, "plain")) < 1e-12
        around = starts[k] + lengths[k] * np.array([-0.001, 0.5, 1.001])
        assert np.abs(np.diff(electronics.resting_positions(par, around, F_Z, "plain"))).min() > 1e-9


STAIRS = (
    0.0,
    13.39,
    13.39,
    26.74,
    40.17,
)  # um, of 10 um steps from 0: the second step is dead, as in Fig. 7a


def test_stairs_of_the_open_loop(par: Parameters, printed: dict[str, Any]) -> None:
    stair = published_value(printed, "open_loop.stair")
    places = electronics.resting_positions(par, stair * np.arange(5), F_Z, "plain")
    assert 1e6 * places == pytest.approx(STAIRS, abs=0.005)
    fine = electronics.resting_positions(par, stair * np.arange(5), F_Z, "fine")
    assert np.abs(fine - stair * np.arange(5)).max() < 35e-9


def test_current_of_a_motion_of_1_um(par: Parameters, printed: dict[str, Any]) -> None:
    step = published_value(printed, "sensitivity.displacement")
    i = [motor.phase_currents(par, x, 0, F_Z) for x in (0, step)]
    assert np.abs(_flat(i[1] - i[0])).max() == pytest.approx(4.4e-4, rel=0.01)
    # The paper's 1e-4 A would make the 6 mA of one PWM step a motion of 60 um, four times its own 15 um.
    by_the_paper = 6e-3 / published_value(printed, "sensitivity.current") * step
    assert by_the_paper > 3.9 * published_value(printed, "open_loop.smallest_motion")


@pytest.mark.parametrize("mean_of", [1, 32])
def test_current_loop_has_its_phase_margin(par: Parameters, mean_of: int) -> None:
    gains, delay = electronics.current_loop(par, mean_of), electronics.current_delay(par, mean_of)
    w = gains.Kp / par.L
    loop = (gains.Kp + gains.Ki / (1j * w)) / (1j * w * par.L + par.R) * np.exp(-1j * w * delay)
    assert abs(loop) == pytest.approx(1)
    assert math.pi + np.angle(loop) == pytest.approx(par.pm_cc)
    spring = math.sqrt(motor.stiffness(par, F_Z) / par.m)
    assert w == pytest.approx({1: 5113, 32: 451}[mean_of], rel=1e-3)
    assert w > 25 * spring


# Faults


WINDING = st.floats(0.6, 1.6)


@pytest.mark.slow
@given(winding=st.tuples(WINDING, WINDING, WINDING), x=PLACE)
def test_unequal_windings_lower_the_force_more_under_position_control(
    winding: tuple[float, float, float], x: float
) -> None:
    """At rest, without current loops: F_z = A V_q |Y e_q| in the open loop, A V_q / Z_qq under position control.

    Y is the admittance in the axes of the reference, symmetric and positive, so 1 / Z_qq <= Y_qq <= |Y e_q|: the paper
    has the position controller above the open loop, by 25 %.
    """
    G = np.diag(1 / np.array(winding)) - np.outer(1 / np.array(winding), 1 / np.array(winding)) / sum(
        1 / w for w in winding
    )
    P = _array(motor.park(x, 211.0001))
    Y = P @ G @ (2 / 3 * P.T)
    open_loop, position = np.hypot(*Y[:, 1]), 1 / np.linalg.inv(Y)[1, 1]
    assert position <= open_loop * (1 + 1e-12)


# Refusals


def test_bad_input_is_refused_in_one_sentence(par: Parameters) -> None:
    refused: list[tuple[Any, str]] = [
        (lambda: replace(par, A=math.nan), "halbach.Parameters: A: found nan"),
        (lambda: replace(par, m=-1.0), "m: found -1.0 kg, expected a finite number above 0"),
        (
            lambda: electronics.resting_positions(par, 0.0, 20.0, "plain"),
            "settled: found 20 N at 0 m, expected forces of 0 to 14.5 N",
        ),
        (lambda: electronics.resting_positions(par, 0.0, -5.0, "plain"), "settled: found -5 N"),
        (lambda: electronics.resting_positions(par, math.nan, 5.0, "plain"), "settled: found 5 N at nan m"),
        (lambda: electronics.dead_zones(par, F_Z, "exact"), "dead_zones: found pwm 'exact' at 5 N"),
        (lambda: electronics.dead_zones(par, 0.0, "plain"), "dead_zones: found pwm 'plain' at 0 N"),
    ]
    for call, sentence in refused:
        with pytest.raises(malta.InputError) as caught:
            call()
        assert sentence in str(caught.value)


def test_every_parameter_says_where_it_is_from() -> None:
    for preset in ("identified", "emf", "late"):
        par = malta.read("data/halbach.toml", preset=preset)
        assert par.preset == preset
        assert {f.name for f in fields(par) if "unit" in f.metadata} == {
            f.name for f in fields(Parameters) if f.name != "preset"
        }


# Files of the time before


def test_gain_files_without_the_air_gap_are_read_and_stay_as_they_are(tmp_path: Path) -> None:
    """A parameter that came later is in a gain file only where it differs from its default."""
    content = json.loads(GAINS.read_text(encoding="utf-8"))
    read = malta.gains.read(GAINS).parameters
    assert "z_0" not in content["plant"]["parameters"]
    assert set(values_of(read)) == set(content["plant"]["parameters"])
    assert {"z_0"} == set(values_of(replace(read, z_0=0.5e-3))) - set(values_of(read))

    content["plant"]["parameters"]["z_0"] = {"value": 0.5e-3, "unit": "m"}
    content["sha256"] = content_sha256({k: v for k, v in content.items() if k != "sha256"})
    path = tmp_path / "wide.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    found: Any = malta.gains.read(path).parameters
    assert found.z_0 == 0.5e-3

    del content["plant"]["parameters"]["k"]
    content["sha256"] = content_sha256({k: v for k, v in content.items() if k != "sha256"})
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(malta.InputError, match=r"plant\.parameters: found k missing"):
        malta.gains.read(path)
