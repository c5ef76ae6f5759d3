"""Synthesis: the ways to a sampled controller, feedforward, calibration, and refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import malta
from malta.synthesis.design_models import sampled_model
from malta.synthesis.feedforward import pi_current_loop, static_feedforward
from malta.synthesis.separation import controller_poles

if TYPE_CHECKING:
    from conftest import Design

    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant
    from malta.synthesis.spec import Discretization


@pytest.mark.slow
def test_the_three_ways_agree_as_the_sample_time_falls(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    K, Ki = malta.synthesis.lqi(design.model, design.spec.weights)
    ways: tuple[Discretization, ...] = ("backward-euler", "zoh", "sampled-data")
    for way in ways:
        errors = []
        for Ts in (20e-6, 10e-6):
            c = malta.lqg(design.model, design.spec.weights, Ts, way)
            errors.append(
                max(np.abs(c.K - K).max() / np.abs(K).max(), np.abs(c.Ki - Ki).max() / np.abs(Ki).max())
            )
        if way == "backward-euler":
            assert errors == [0, 0]
        else:
            assert errors[0] < 0.02
            assert errors[0] / errors[1] == pytest.approx(2, abs=0.1)


def test_integrated_weights_and_noise_differ_from_sampled_ones(designs: dict[str, Design]) -> None:
    """zoh and sampled-data differ in second order of Ts (weights) and third (noise): little at 50 us, much at 4 ms."""
    design = designs["calibrated"]

    def difference(Ts: float) -> tuple[float, float]:
        a, b = (malta.lqg(design.model, design.spec.weights, Ts, way) for way in ("zoh", "sampled-data"))
        return np.abs(a.K - b.K).max() / np.abs(a.K).max(), np.abs(a.L - b.L).max() / np.abs(a.L).max()

    fine, twice, coarse = difference(50e-6), difference(100e-6), difference(4e-3)
    assert twice[0] / fine[0] == pytest.approx(4, abs=0.2)
    assert twice[1] / fine[1] == pytest.approx(8, abs=0.4)
    assert coarse[0] > 0.05
    assert coarse[1] > 0.15


def test_delay_appends_named_states(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    c = malta.lqg(design.model, design.spec.weights, 50e-6, "sampled-data", 2)
    assert c.delay == 2
    assert [s.name for s in c.states][:10] == [s.name for s in design.plant.design_states]
    assert [s.name for s in c.states][10:12] == ["fx_B1[k-2]", "fy_B1[k-2]"]
    assert [s.name for s in c.states][-1] == "f_D[k-1]"
    assert c.K.shape == (5, 20)
    assert not c.L[10:].any()
    Ad, Bd, Cd = sampled_model(design.model, 50e-6, 2)
    assert np.array_equal(c.Ad, Ad)
    assert np.array_equal(c.Bd, Bd)
    assert np.array_equal(c.Cd, Cd)


def test_static_feedforward_balances_gravity_and_cogging(plant: Plant) -> None:
    table = static_feedforward(plant)
    par = plant.parameters
    m, g, l_B, F_c, L_p = (getattr(par, name) for name in ("m", "g", "l_B", "F_c", "L_p"))
    z = table.z_grid
    expected = np.zeros((len(z), 5))
    expected[:, 1] = m * g * (l_B - z) / (2 * l_B)
    expected[:, 3] = m * g * (l_B + z) / (2 * l_B)
    expected[:, 4] = -F_c * np.sin(2 * np.pi * z / L_p)
    assert table.v0 == pytest.approx(expected, abs=1e-12)
    # between the points: linear interpolation errs by (2 pi / L_p)^2 h^2 / 8 of the amplitude
    middle = (z[:-1] + z[1:]) / 2
    error = np.interp(middle, z, table.v0[:, 4]) + F_c * np.sin(2 * np.pi * middle / L_p)
    assert np.abs(error).max() < 2e-3 * F_c


def test_calibrate_refuses_what_has_no_answer(
    model: LinearModel, plant: Plant, designs: dict[str, Design]
) -> None:
    weights = designs["table2"].spec.weights
    with pytest.raises(malta.InputError, match="stiffness_ratio: found 2, expected more than 2"):
        malta.synthesis.calibrate(model, weights, 2.0)
    coupled = malta.linearize(plant, plant.at(z=10e-3))
    with pytest.raises(malta.InputError, match="decoupled"):
        malta.synthesis.calibrate(coupled, weights, 4.0)


@pytest.mark.parametrize(("ratio", "axial"), [(2.5, 0.5), (4.0, 1.0), (6.0, 2.0)])
def test_calibrate_reaches_any_stiffness(
    model: LinearModel, designs: dict[str, Design], ratio: float, axial: float
) -> None:
    weights = malta.synthesis.calibrate(model, designs["table2"].spec.weights, ratio, axial)
    K1 = np.diag(model.force_map @ malta.synthesis.lqr(model, weights)[:, :5])
    k = np.diag(model.stiffness)
    radial = [0, 1, 3, 4]
    assert K1[radial] / k[radial] == pytest.approx([ratio] * 4, rel=1e-9)
    assert np.sqrt(K1[2]) == pytest.approx(axial * np.sqrt(ratio - 1) * 218.92, rel=1e-4)


def test_current_loop_without_solution_is_refused(plant: Plant) -> None:
    with pytest.raises(malta.CheckError, match="no PI controller"):
        pi_current_loop(plant.actuator, delay=1e-3)


def test_arguments_are_checked(model: LinearModel, designs: dict[str, Design]) -> None:
    weights = designs["calibrated"].spec.weights
    with pytest.raises(malta.InputError, match="Ts"):
        malta.lqg(model, weights, 0.0)
    with pytest.raises(malta.InputError, match="Ts"):
        malta.lqg(model, weights, float("nan"))
    with pytest.raises(malta.InputError, match="Ts: found '50us' s, expected a sample time above 0 s"):
        malta.lqg(model, weights, "50us")  # type: ignore[arg-type]
    with pytest.raises(malta.InputError, match="delay"):
        malta.lqg(model, weights, 50e-6, "backward-euler", 1)
    with pytest.raises(malta.InputError, match="delay"):
        malta.lqg(model, weights, 50e-6, "zoh", -1)
    with pytest.raises(malta.InputError, match="discretization: found 'tustin'"):
        malta.lqg(model, weights, 50e-6, "tustin")  # type: ignore[arg-type]
    short = replace(weights, q=weights.q[:9], q_base=weights.q_base[:9])
    with pytest.raises(malta.InputError, match="q: found 9 entries, expected 10"):
        malta.lqg(model, short, 50e-6)


def test_weights_refuse_what_is_no_weight(designs: dict[str, Design]) -> None:
    weights = designs["table2"].spec.weights
    for field, value in (("q", -1.0), ("r", 0.0), ("q_base", 0.0), ("sensor_variance", np.nan)):
        with pytest.raises(malta.InputError, match=f"Weights: {field}: found"):
            replace(weights, **{field: np.full(len(getattr(weights, field)), value)})  # type: ignore[arg-type]
    with pytest.raises(malta.InputError, match="bases"):
        replace(weights, q_base=weights.q_base[:4])
    with pytest.raises(malta.InputError, match="weights: r: found 'small', expected a vector"):
        malta.synthesis.weights(q=[1.0], r="small", w=[1.0], v=[1.0])
    with pytest.raises(malta.InputError, match="weights: q: found complex numbers"):
        malta.synthesis.weights(q=[1j], r=[1.0], w=[1.0], v=[1.0])


@pytest.mark.slow
def test_any_operating_point_can_be_designed_for(plant: Plant, designs: dict[str, Design]) -> None:
    """Off the centre the modes couple; the design stays stable on the machine over the travel."""
    for z in (-15e-3, -7.3e-3, 15e-3):
        model = malta.linearize(plant, plant.at(z=z))
        controller = malta.lqg(model, designs["calibrated"].spec.weights, 50e-6)
        margins = malta.verify(model, controller)
        assert margins.stable
        assert margins.peak_sensitivity["sigma_max"] < 3
        assert controller.operating_point[0][2] == z


def test_bases_of_a_tenth_of_a_micrometre_are_no_overflow(designs: dict[str, Design]) -> None:
    """Weights of 1e14 beside a sample of 50 us: integrated in units of their largest."""
    design = designs["calibrated"]
    fine = replace(design.spec.weights, q_base=design.spec.weights.q_base / 500)
    sharp = malta.lqg(design.model, fine, 50e-6)
    near = malta.lqg(design.model, fine, 50e-6, "zoh")
    assert np.abs(sharp.K).max() > 10 * np.abs(design.controller.K).max()
    assert np.abs(sharp.K - near.K).max() < 0.35 * np.abs(near.K).max()


@pytest.mark.parametrize(("Ts", "scale"), [(4e-3, 1.0), (5e-4, 0.1)])
def test_delay_can_be_designed_for_at_any_sample_time(
    designs: dict[str, Design], Ts: float, scale: float
) -> None:
    """What Van Loan's integral leaves beside the stored force stays positive semidefinite."""
    design = designs["calibrated"]
    weights = replace(design.spec.weights, q_base=design.spec.weights.q_base * scale)
    regulator, observer = controller_poles(malta.lqg(design.model, weights, Ts, "sampled-data", 1))
    assert np.abs(regulator).max() < 1
    assert np.abs(observer).max() < 1


def test_a_model_with_its_loads_is_not_designed_on(plant: Plant, designs: dict[str, Design]) -> None:
    """v0(z) cancels them already."""
    loaded = malta.linearize(plant, malta.trim(plant, z=0.0))
    with pytest.raises(malta.InputError, match="model: found a model at its trim"):
        malta.lqg(loaded, designs["calibrated"].spec.weights, 50e-6)


def test_calibrate_needs_an_unstable_first_mode(plant: Plant, designs: dict[str, Design]) -> None:
    free = malta.plant_of(replace(plant.parameters, K_A=0.0))
    with pytest.raises(malta.InputError, match="an unstable first mode"):
        malta.synthesis.calibrate(malta.linearize(free, free.at()), designs["table2"].spec.weights, 4.0)
    with pytest.raises(malta.InputError, match="axial_ratio: found -1, expected more than 0"):
        malta.synthesis.calibrate(designs["table2"].model, designs["table2"].spec.weights, 4.0, -1.0)
    for times, found in (
        ((0.1, 1.0), "2 times, expected one, or one for each of 5 outputs"),
        ((1, 1, 1, 1, 0), "0"),
    ):
        with pytest.raises(malta.InputError, match=f"integral_time: found {found}"):
            malta.synthesis.calibrate(
                designs["table2"].model, designs["table2"].spec.weights, 4.0, integral_time=times
            )


def test_arrays_of_a_controller_are_read_only(designs: dict[str, Design]) -> None:
    c = designs["calibrated"].controller
    for array in (c.K, c.limits.force, c.feedforward.v0, c.feedforward.z_grid, c.operating_point[0]):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    assert repr(c) == "Controller('calibrated', preset 'table1', 10 states, 5 forces, 20 kHz, delay 0)"


def test_feedforward_between_and_beyond_its_points(designs: dict[str, Design]) -> None:
    ff = designs["calibrated"].controller.feedforward
    assert ff.at(0.0) == pytest.approx(ff.v0[60])
    assert ff.at(1.0) == pytest.approx(ff.v0[-1])
    step = 0.1e-3
    assert ff.slope(0.1e-3) == pytest.approx((ff.at(0.2e-3) - ff.at(0.2e-3 - step)) / step)
    assert not ff.slope(16e-3).any()
