"""Curves, margins, steps and root loci of any loop, against python-control, analysis and malta's own other routes."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

import control
import numpy as np
import pytest
from conftest import ROOT
from flight import default_of

import malta
from malta.loops.curves import LoopCurves, loop_curves, respond
from malta.loops.linear_loops import linear_loop
from malta.loops.locus import root_locus, stability_changes
from malta.loops.steps import loop_steps, step_figures
from malta.simulation.references import Motion
from malta.synthesis.step_response import StepResponse

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

s = control.tf("s")
CONTINUOUS = {
    "third order": 1 / (s * (s + 1) * (s + 2)),
    "double integrator and lead": 20 * (s + 1) / (s**2 * (s / 30 + 1) ** 2),
    "resonance": 0.2 * (s + 1) / ((s**2 + 0.02 * s + 1) * (s / 20 + 1)),
    "delay": control.tf(*control.pade(0.2, 6)) * 1.5 / (s + 0.5),
}
UNSTABLE = {
    "first order": 3 / (s - 1),
    "two unstable poles": 30 * (s + 2) ** 2 / ((s - 1) * (s - 2) * (s / 50 + 1)),
    "both sides": 6 / ((s - 1) * (s / 20 + 1)),
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_margins_are_those_of_python_control(name: str) -> None:
    L = CONTINUOUS[name]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a fallback to interpolation
        gain, phase, distance, at_gain, at_phase, _ = control.stability_margins(L)
    found = loop_curves(L).margins[0]
    assert found.gain[1] == pytest.approx(gain, rel=1e-6)
    assert math.degrees(found.phase) == pytest.approx(phase, rel=1e-6)
    assert found.modulus == pytest.approx(distance, rel=1e-4)
    assert found.phase_frequency == pytest.approx(at_phase, rel=1e-6)
    if math.isfinite(gain):
        assert found.gain_frequency[1] == pytest.approx(at_gain, rel=1e-6)


def test_an_unstable_plant_has_a_margin_on_both_sides() -> None:
    """k / (s - 1) is stable for k > 1, so that 3 / (s - 1) bears a third of its gain and any more."""
    first = loop_curves(UNSTABLE["first order"]).margins[0]
    assert list(first.gain) == [pytest.approx(1 / 3, rel=1e-9), math.inf]
    assert first.gain_frequency[0] == 0
    assert first.phase == pytest.approx(math.atan(math.sqrt(8)), rel=1e-9)  # at w = sqrt(8)
    sampled = control.tf([0.5], [1, -1.2, 0], 0.1)  # z^2 - 1.2 z + k / 2: stable for 0.4 < k < 2
    found = loop_curves(sampled).margins[0]
    assert list(found.gain) == [pytest.approx(0.4, rel=1e-9), pytest.approx(2, rel=1e-9)]
    assert (found.encirclements, found.unstable_poles) == (1, 1)


def test_a_weak_integrator_crosses_far_below_the_poles() -> None:
    """k / (s (s + 1)) has |L| = 1 at k and 90 degrees there, however small k is."""
    found = loop_curves(1e-9 / (s * (s + 1))).margins[0]
    assert found.phase_frequency == pytest.approx(1e-9, rel=1e-6)
    assert found.phase == pytest.approx(math.pi / 2, rel=1e-6)
    assert found.delay == pytest.approx(math.pi / 2 * 1e9, rel=1e-6)


@pytest.mark.parametrize("rate", [1e-9, 1e9])
def test_slow_and_fast_transfer_functions_keep_their_states(rate: float) -> None:
    """2 / (p (p + 1)) at p = s / rate: control.ss alone leaves no state of the slow one."""
    found = loop_curves(control.tf([2 * rate**2], [1, rate, 0])).margins[0]
    assert found.phase_frequency == pytest.approx(1.2496 * rate, rel=1e-3)
    assert math.degrees(found.phase) == pytest.approx(38.668, rel=1e-3)
    x = 1 + math.sqrt(2)  # |S|^2 = (x^2 + x) / (x^2 - 3 x + 4), x = (w / rate)^2, is largest there
    assert found.peak_sensitivity**2 == pytest.approx((x**2 + x) / (x**2 - 3 * x + 4), rel=1e-4)


@pytest.mark.parametrize("gain", [0.0, 2.0])
@pytest.mark.parametrize("dt", [0, 0.1])
def test_a_gain_without_states_is_a_loop(gain: float, dt: float) -> None:
    """Its answer to a step is there at once; no warning of log 0 either."""
    loop = linear_loop(control.ss([], [], [], [[gain]], dt))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        margins, answer = loop_curves(loop).margins[0], loop_steps(loop).references
    assert margins.gain == (0.0, math.inf)
    assert margins.peak_sensitivity == pytest.approx(1 / (1 + gain))
    assert np.allclose(answer.y[:, 0, 0], gain / (1 + gain))
    figures = step_figures(answer, 0, 0)
    assert figures.settling == 0


def test_many_frequencies_have_the_responses_of_each_alone() -> None:
    """By a Schur form, and by a solution at each: two ways, of a plant with integrators beside fast poles."""
    A = np.diag([0.0, -1e4, -3.0, 0.0]) + np.diag([1.0, 50.0, 0.0], 1) + np.diag([0.0, -20.0, 0.0], -1)
    plant = linear_loop(control.ss(A, np.eye(4)[:, :2], np.eye(4)[1:3], np.zeros((2, 2)))).plant
    at = 1j * np.geomspace(1e-6, 1e6, 100)
    alone = np.concatenate([plant.response(at[[k]]) for k in range(len(at))])
    np.testing.assert_allclose(plant.response(at), alone, rtol=1e-9, atol=1e-12 * np.abs(alone).max())
    assert linear_loop(control.ss([], [], [], [[2.0]])).plant.response(at).shape == (100, 1, 1)


def test_a_pole_that_no_number_tells_from_the_frequency_is_no_error() -> None:
    found = linear_loop(control.ss([[0, 1], [0, 0]], [[0], [1]], [[1, 0]], [[0]])).plant.response(
        np.zeros(2, dtype=complex)
    )
    assert np.isnan(found).all()


def test_a_pole_on_the_axis_is_no_crossing() -> None:
    """Im L changes its sign through infinity at s = j; the poles of s^2 + 1 + k (s + 0.5) / 5 decay for every k > 0."""
    found = loop_curves(0.2 * (s + 0.5) / (s**2 + 1)).margins[0]
    assert found.gain == (0.0, math.inf)
    assert not found.phase_crossings


def test_the_gain_margin_of_a_sampled_loop_may_lie_at_the_nyquist_frequency() -> None:
    found = loop_curves(control.tf([0.8], [1, -1], 0.01)).margins[0]  # |1 - 0.8 k| < 1
    assert found.gain[1] == pytest.approx(2.5, rel=1e-9)
    assert found.gain_frequency[1] == pytest.approx(math.pi / 0.01)


@pytest.mark.parametrize(
    ("L", "stable"), [(([1], [1, 0]), False), (([0.1], [1, 1]), False)], ids=["closed", "open"]
)
def test_a_pole_at_the_nyquist_frequency_is_no_error(L: Any, stable: bool) -> None:
    """1 / z has its closed loop's pole at z = -1; 0.1 / (z + 1) its own there, and that of the closed loop beyond."""
    curves = loop_curves(control.tf(*L, 0.1))
    (found,) = curves.margins
    assert curves.stable == found.stable == stable
    assert math.isnan(found.delay)


def test_a_loop_without_states_has_its_margins() -> None:
    """L = -1/2: S = 2, unstable from twice the gain on."""
    (found,) = loop_curves(control.ss([], [], [], [[-0.5]])).margins
    assert (found.gain, found.peak_sensitivity) == ((0.0, 2.0), 2.0)
    assert found.disk.size == pytest.approx(2 / 3, rel=1e-12)


def winding(L: Any) -> int:
    """Counterclockwise turns of L(jw) about -1 on a dense grid; L has no poles on the axis."""
    w = np.geomspace(1e-4, 1e5, 40_000)
    phase = np.unwrap(np.angle(1 + L(1j * w)))
    return round(float(phase[-1] - phase[0]) / math.pi)


@pytest.mark.parametrize("name", [*UNSTABLE, "resonance", "delay"])
def test_encirclements_are_those_of_the_curve(name: str) -> None:
    L = (UNSTABLE | CONTINUOUS)[name]
    found = loop_curves(L).margins[0]
    assert found.encirclements == winding(L)
    assert found.unstable_poles == int((L.poles().real > 0).sum())
    assert found.stable == (found.encirclements == found.unstable_poles)


@pytest.mark.parametrize("L", [0.5 / (s - 1), 100 / (s * (s + 1) * (s + 2))], ids=["too little", "too much"])
def test_an_unstable_loop_has_no_margins_but_crossings(L: Any) -> None:
    curves = loop_curves(L)
    found = curves.margins[0]
    assert not curves.stable
    assert not found.stable
    assert all(math.isnan(v) for v in (*found.gain, found.phase, found.delay, found.modulus, found.disk.size))
    assert found.encirclements - found.unstable_poles == -int((curves.loop.closed_poles.real > 0).sum())


def test_integrators_in_series_count_as_stable() -> None:
    found = loop_curves(10 * (s + 1) ** 2 / s**3).margins[0]
    assert (found.encirclements, found.unstable_poles) == (0, 0)
    assert list(found.gain) == [pytest.approx(0.05, rel=1e-6), math.inf]


@pytest.mark.parametrize("seed", range(12))
def test_gain_margins_bound_the_stable_factors(seed: int) -> None:
    """Random loops of two channels: eigenvalues are stable within both factors and unstable just beyond."""
    rng = np.random.default_rng(seed)
    n, discrete = 4, seed % 2
    A = rng.normal(size=(n, n)) - 0.5 * np.eye(n)
    K = rng.normal(size=(2, n))
    plant = control.ss(A, rng.normal(size=(n, 2)), K, np.zeros((2, 2)))
    gain, *_ = control.lqr(plant.A, plant.B, np.eye(n), 0.3 * np.eye(2))
    L = control.ss(plant.A, plant.B, gain, 0 if discrete else 0.05 * np.eye(2))
    L = control.c2d(L, 0.03) if discrete else L
    curves = loop_curves(L)
    if not curves.stable:
        return
    for i, margins in enumerate(curves.margins):
        for factor, side in zip(margins.gain, (1, -1), strict=True):
            if 0 < factor < math.inf:
                for shift, stable in ((1e-4 * side, True), (-1e-4 * side, False)):
                    factors = np.ones(2)
                    factors[i] = factor * (1 + shift)
                    poles = curves.loop.poles_of(curves.loop.closed_loop(factors, "sensors").A)
                    assert (poles.real.max() < 0) == stable
        low, high = max(margins.gain[0], 0.02), min(margins.gain[1], 50)
        for factor in np.geomspace(low * 1.001, high * 0.999, 9):
            factors = np.ones(2)
            factors[i] = factor
            assert curves.loop.poles_of(curves.loop.closed_loop(factors, "sensors").A).real.max() < 0


def test_the_delay_margin_ends_stability() -> None:
    L = 2 * (s + 1) / s**2
    found = loop_curves(L).margins[0]
    for share, stable in ((0.98, True), (1.02, False)):
        late = L * control.tf(*control.pade(share * found.delay, 8))
        assert loop_curves(late).stable == stable


# --- machines ---


class Machine(NamedTuple):
    """A shipped machine with its controller."""

    plant: Plant
    controller: Controller


def shipped(name: str) -> Machine:
    controller = malta.gains.read(ROOT / "design" / "gains" / f"{name}.json")
    return Machine(malta.plant_of(controller.parameters), controller)


@pytest.fixture(scope="module")
def machine() -> Machine:
    return shipped("calibrated")


@pytest.fixture(scope="module")
def curves(machine: Machine) -> LoopCurves:
    return loop_curves(*machine)


def same(found: Any, wanted: Any, tolerance: float = 1e-7) -> bool:
    return bool(np.abs(found - wanted).max() <= tolerance * np.abs(wanted).max())


@pytest.mark.parametrize("name", ["calibrated", pytest.param("planar_pid", marks=pytest.mark.slow)])
def test_responses_are_those_of_the_systems(name: str) -> None:
    plant, controller = shipped(name)
    systems = malta.loops.loop_systems(plant, controller)
    w = np.array([30.0, 500.0, 4000.0])
    found = respond(linear_loop(plant, controller), w)
    z = np.exp(1j * w * controller.sample_time)
    for own, key in ((found.L, "L"), (found.S, "S"), (found.T, "T"), (found.L_forces, "L_forces"),
                     (found.S_forces, "S_forces"), (found.T_forces, "T_forces")):  # fmt: skip
        for k, point in enumerate(z):
            assert same(own[k], getattr(systems, key)(point), 1e-6), key
    for k, point in enumerate(z):
        P, F = systems.P(point), systems.F(point)
        assert same(found.SP[k], np.linalg.solve(np.eye(len(P)) - P @ F, P), 1e-6)
        assert same(found.FS[k], F @ found.S[k], 1e-6)
    pushed, load = malta.loop(plant, controller).sampled, np.eye(len(plant.disturbances))[2]
    assert same(found.compliance[:, :, 2], pushed.compliance(w, load))
    assert np.array_equal(respond(linear_loop(systems), w).L, found.L)


def test_peaks_are_those_of_verify(machine: Machine, curves: LoopCurves) -> None:
    plant, controller = machine
    found = malta.verify(malta.linearize(plant, plant.at()), controller)
    for margins in curves.margins:
        assert margins.peak_sensitivity == pytest.approx(found.peak_sensitivity[margins.channel], rel=1e-4)
    largest = curves.singular_values(curves.responses.S)[:, 0].max()
    assert largest == pytest.approx(found.peak_sensitivity["sigma_max"], rel=1e-3)
    poles = found.poles.closed_loop
    assert same(np.sort_complex(curves.poles["closed_loop"]), np.sort_complex(poles), 1e-6)


def test_delay_margins_are_those_of_the_tables(machine: Machine, curves: LoopCurves) -> None:
    """By the loop of the curves, and by that of the report."""
    found = malta.loop(*machine).classical
    assert [m.delay for m in curves.margins] == pytest.approx([*found.delay.values()], rel=1e-6)
    assert [m.disk.size for m in curves.margins] == pytest.approx([d.size for d in found.disks[3:]], rel=1e-6)


def test_delay_margins_are_between_points_of_the_grid(curves: LoopCurves) -> None:
    """By interpolation of phase and size between two frequencies."""
    w, alone = curves.w, curves.responses.alone("sensors")
    for margins, L in zip(curves.margins, alone.T, strict=True):
        size, phase = np.log(np.abs(L)), np.unwrap(np.angle(L))
        k = np.flatnonzero(np.sign(size[1:]) != np.sign(size[:-1]))
        share = size[k] / (size[k] - size[k + 1])
        at = w[k] * (w[k + 1] / w[k]) ** share
        angle = phase[k] + share * (phase[k + 1] - phase[k])
        assert margins.delay == pytest.approx((np.mod(angle + np.pi, 2 * np.pi) / at).min(), rel=1e-3)


def test_the_grid_ends_at_the_nyquist_frequency_and_has_the_peaks(curves: LoopCurves) -> None:
    assert curves.w[-1] == pytest.approx(curves.nyquist)
    assert (np.diff(curves.w) > 0).all()
    for i, margins in enumerate(curves.margins):
        assert np.abs(curves.responses.S[:, i, i]).max() == pytest.approx(margins.peak_sensitivity, rel=2e-3)
    resonant = loop_curves(CONTINUOUS["resonance"])
    w = np.geomspace(0.9, 1.1, 20_001)
    largest = np.abs(CONTINUOUS["resonance"](1j * w)).max()
    assert np.abs(resonant.responses.L).max() == pytest.approx(largest, rel=5e-3)


def test_zeros_are_those_of_python_control() -> None:
    L = CONTINUOUS["double integrator and lead"] * (s**2 + 0.3 * s + 9) / (s + 4) ** 2
    found, expected = (
        sorted(zeros, key=lambda zero: zero.imag) for zeros in (loop_curves(L).zeros, L.zeros())
    )
    assert found == pytest.approx(expected, rel=1e-6)


def test_a_pair_of_systems_is_a_plant_and_its_controller() -> None:
    P, C = control.ss(1 / (s * (s + 1))), control.ss(5 * (s + 2) / (s + 20))
    curves = loop_curves(P, C)
    w = curves.w
    point, gain = P(1j * w), C(1j * w)
    assert same(curves.responses.SP[:, 0, 0], point / (1 + point * gain))
    assert same(-curves.responses.FS[:, 0, 0], gain / (1 + point * gain))
    assert [load.name for load in curves.loop.loads] == ["u[0]"]
    assert curves.margins[0].phase == pytest.approx(loop_curves(P * C).margins[0].phase, rel=1e-8)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((3.0,), "a float"),
        ((control.tf([1], [1, 1]), control.tf([1], [1, 1], 0.1)), "dt"),
        ((control.ss(-np.eye(2), np.eye(2), [[1.0, 0.0]], np.zeros((1, 2))),), "2 inputs and 1 outputs"),
        ((s,), "a TransferFunction"),
        ((malta.linear_machine([[0]], [[1]], [[1]]),), "a Plant"),
    ],
    ids=["number", "sample times", "not square", "improper", "plant alone"],
)
def test_what_is_no_loop_is_refused(arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises(malta.InputError, match=message):
        loop_curves(*arguments)


# --- steps ---


@pytest.mark.parametrize("name", ["third order", "double integrator and lead"])
def test_steps_are_those_of_python_control(name: str) -> None:
    closed = control.feedback(CONTINUOUS[name], 1)
    answer = loop_steps(linear_loop(CONTINUOUS[name])).references
    t = np.linspace(0, answer.t[1500], 400)
    wanted = control.step_response(closed, t).outputs
    assert np.interp(t, answer.t, answer.y[:, 0, 0]) == pytest.approx(wanted, abs=2e-3)
    found, info = step_figures(answer, 0, 0), control.step_info(closed, SettlingTimeThreshold=0.02)
    assert 100 * found.overshoot == pytest.approx(info["Overshoot"], abs=0.5)
    assert found.rise == pytest.approx(info["RiseTime"], rel=0.05)
    assert found.settling == pytest.approx(info["SettlingTime"], rel=0.05)


def test_a_rise_is_read_between_samples() -> None:
    """10 % at 1 + 0.05/0.45 s, 90 % at 2 + 0.4/0.5 s."""
    y = np.array([0.0, 0.05, 0.5, 1.0, 1.0]).reshape(-1, 1, 1)
    assert step_figures(StepResponse(np.arange(5.0), y, np.ones((1, 1))), 0, 0).rise == pytest.approx(
        2.8 - 1 - 1 / 9
    )


def test_loads_are_those_of_recovery(machine: Machine) -> None:
    answer = loop_steps(linear_loop(*machine)).loads
    for column, found in enumerate(malta.loops.recovery(*machine)):
        for k, deviation in enumerate(found.outputs):
            largest = float(answer.largest[k, column])
            assert largest == pytest.approx(deviation.largest, rel=1e-6, abs=1e-15)


def test_a_law_that_stores_forces_ends_at_its_reference() -> None:
    """Without sums of errors, by an observed force alone; the stored force is that of the place to be held."""
    answer = loop_steps(linear_loop(*shipped("halbach_late"))).references
    assert answer.final[0, 0] == pytest.approx(1, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "output", "size"), [("halbach_late", 0, 1e-5), ("halbach_pid", 0, 1e-5), ("robust", 0, 1e-7)]
)
def test_steps_are_those_of_the_simulated_machine(name: str, output: int, size: float) -> None:
    """A small step, from the fourth sample on: held currents, stored forces, forces that hold against attraction."""
    plant, controller = shipped(name)
    T, first = controller.sample_time, 4

    def jump(_: Plant) -> Any:
        def at(t: Any) -> Motion:
            p = np.zeros((len(t), len(plant.outputs)))
            p[:, output] = np.where(np.asarray(t) > (first - 0.5) * T, size, 0.0)
            return Motion(p, 0 * p, 0 * p)

        return at

    run = malta.simulate(plant, controller, malta.Scenario("step", 120 * T, jump, fidelity=default_of(plant)))
    wanted = (run.p[first:, output] - run.p[0, output]) / size
    answer = loop_steps(linear_loop(plant, controller)).references.y[: len(wanted), output, output]
    assert np.abs(answer - wanted).max() < 3e-3


def test_an_unstable_loop_is_followed_while_it_grows() -> None:
    answer = loop_steps(linear_loop(0.5 / (s - 1))).references  # y = -(1 - e^(t/2)), growing
    assert answer.y[:, 0, 0] == pytest.approx(np.expm1(answer.t / 2), rel=1e-6, abs=1e-9)
    assert math.isnan(step_figures(answer, 0, 0).final)
    assert answer.y.max() > 100


# --- root loci ---


def test_every_sample_of_a_locus_is_a_set_of_eigenvalues() -> None:
    L = CONTINUOUS["third order"]
    found = root_locus(L, span=(0, 20))
    for k in (0, len(found.values) // 2, len(found.values) - 1):
        wanted = control.feedback(float(found.values[k]) * L, 1).poles() if found.values[k] else L.poles()
        assert np.sort_complex(found.poles[k].round(6)) == pytest.approx(
            np.sort_complex(wanted.round(6)), abs=1e-5
        )
    assert list(found.changes) == pytest.approx([6], rel=1e-7)
    assert np.abs(np.diff(found.poles, axis=0)).max() < 0.4


def test_the_locus_of_the_gain_changes_at_the_gain_margins(machine: Machine) -> None:
    found = root_locus(*machine, channel="z", span=(0.01, 20))
    margins = loop_curves(*machine).margins[4]
    assert found.changes == pytest.approx([k for k in margins.gain if 0.01 < k < 20], rel=1e-5)


@pytest.mark.slow
def test_the_locus_of_a_parameter_has_the_nominal_machine(machine: Machine) -> None:
    found = root_locus(*machine, parameter="m", span=(0.2, 0.6))
    k = int(np.flatnonzero(found.values == found.nominal)[0])
    kept = found.poles[k][np.isfinite(found.poles[k])]
    assert same(np.sort_complex(kept), np.sort_complex(found.nominal_poles), 1e-9)
    assert found.unit == "kg"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameter": "mass"}, "'mass', expected one of gain m"),
        ({"parameter": "m", "span": (2.0, 1.0)}, "2 to 1"),
        ({"parameter": "m", "span": (-1.0, 1.0)}, "-1, expected a finite number above 0 in kg"),
        ({"channel": "q"}, "'q', expected one of x1"),
    ],
    ids=["unknown", "backwards", "impossible", "channel"],
)
def test_loci_of_nothing_are_refused(machine: Machine, options: dict[str, Any], message: str) -> None:
    with pytest.raises(malta.InputError, match=message):
        root_locus(*machine, **options)


def test_a_pole_that_stays_on_the_boundary_changes_no_stability() -> None:
    """z^2 + (0.02 k - 2 cos 0.3) z + 1 has both roots at |z| = 1 for every k from 0.1 to 10."""
    L = control.tf([0.02, 0], [1, -2 * math.cos(0.3), 1], 0.01)
    assert root_locus(L).changes == ()


def test_stability_that_changes_from_sample_to_sample() -> None:
    """Every interval has its own change, the last one too."""

    def poles(value: float) -> Any:
        return np.array([math.cos(math.pi * value) + 0j])

    values = np.arange(4.0)
    found = stability_changes(poles, values, np.array([poles(v) for v in values]), None)
    assert found == pytest.approx((0.5, 1.5, 2.5), abs=1e-6)
