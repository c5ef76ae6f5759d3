"""Verification: poles, sensitivities and bandwidths against loops whose figures are known."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import control
import numpy as np
import pytest

import malta
from malta.gains.writing import require_stable
from malta.linear.matrices import eigenvalues
from malta.loops.sampled_loops import machine_loop, sampled_loop
from malta.margins.loop_report import BANDWIDTHS, zone

if TYPE_CHECKING:
    from pathlib import Path

    from conftest import Design

pytestmark = pytest.mark.usefixtures("proven_once")


def test_stages_cost_sensitivity(design: Design) -> None:
    """Lags and delay make it worse. PI controllers may be better than their lag, which is slower."""
    peaks = [stage.peak_sensitivity["sigma_max"] for stage in design.margins.stages]
    assert peaks[0] < min(peaks[1:])
    assert [stage.name for stage in design.margins.stages] == ["sampled", "+ current loops", "machine"]


def test_calibrated_stays_in_zone_A(designs: dict[str, Design]) -> None:
    margins = designs["calibrated"].margins
    assert {zone(value) for value in margins.peak_sensitivity.values()} == {"A"}


@pytest.mark.parametrize(
    ("peak", "name"), [(1.0, "A"), (2.999, "A"), (3.0, "B"), (4.0, "C"), (5.0, "D"), (90.0, "D")]
)
def test_zones_of_iso_14839_3(peak: float, name: str) -> None:
    assert zone(peak) == name


@pytest.mark.slow
def test_the_peak_is_the_h_infinity_norm(design: Design) -> None:
    """The zoomed grid against a frequency sweep a hundred times as dense."""
    stage = machine_loop(design.model, design.controller)
    w = np.geomspace(1e-2, np.pi / 50e-6, 24_000)
    S = stage.sensitivity(w)
    dense = np.linalg.svd(S, compute_uv=False)[:, 0].max()
    assert design.margins.peak_sensitivity["sigma_max"] == pytest.approx(dense, rel=1e-5)
    for i, sensor in enumerate(("x1", "y1", "x2", "y2", "z")):
        assert design.margins.peak_sensitivity[sensor] == pytest.approx(np.abs(S[:, i, i]).max(), rel=1e-5)


def test_the_sampled_machine_is_python_controls(design: Design) -> None:
    """Hold and current loops by control.c2d, delay by powers of z: the same frequency response and poles."""
    A, B, C = design.model.A, design.model.B, design.model.C
    w_c = design.plant.actuator.crossover
    machine = control.ss(A, B, C, np.zeros((5, 5))) * control.ss(
        -w_c * np.eye(5), w_c * np.eye(5), np.eye(5), 0 * np.eye(5)
    )
    sampled = control.c2d(machine, 50e-6, "zoh")
    stage = sampled_loop(design.model, design.controller, delay=2, current_loops="lag")
    law = stage.control
    controller = control.ss(law.A, law.B_y, law.C, law.D_y, 50e-6)
    for w in (10.0, 300.0, 4000.0):
        z = np.exp(1j * w * 50e-6)
        expected = -sampled(z) @ controller(z) / z**2
        assert stage.loop_gain(np.array([w]))[0] == pytest.approx(expected, rel=1e-6, abs=1e-7)
    for delay in (0, 1):
        plain = sampled_loop(design.model, design.controller, delay=delay)
        # S = (I + L)^-1 has the closed-loop poles as its own: the determinant vanishes there
        pole = max(eigenvalues(plain.closed), key=lambda p: abs(p.imag))
        P = plain.Cd @ np.linalg.solve(pole * np.eye(len(plain.Ad)) - plain.Ad, plain.Bd)
        F = plain.control.C @ np.linalg.solve(
            pole * np.eye(len(plain.control.A)) - plain.control.A, plain.control.B_y
        )
        F = F + plain.control.D_y
        assert abs(np.linalg.det(np.eye(5) - P @ F)) < 1e-6


def test_bandwidths_have_definitions_and_order(design: Design) -> None:
    found = design.margins.bandwidth
    assert set(found) == set(BANDWIDTHS)
    assert found["sigma_min_T"] < found["sigma_max_T"]
    assert found["w_n_min"] < found["w_n_max"]
    stage = machine_loop(design.model, design.controller)
    T = np.eye(5) - stage.sensitivity(np.array([found["sigma_max_T"], found["sigma_min_T"]]))
    sizes = np.linalg.svd(T, compute_uv=False)
    assert sizes[0, 0] == pytest.approx(np.sqrt(0.5), rel=2e-3)
    assert sizes[1, -1] == pytest.approx(np.sqrt(0.5), rel=2e-3)
    L = stage.loop_gain(np.array([found["crossover_max"]]))
    assert np.linalg.svd(L, compute_uv=False)[0, 0] == pytest.approx(1, rel=2e-3)


def test_an_unstable_loop_is_reported_and_refused(designs: dict[str, Design]) -> None:
    design = designs["table2"]
    stiff = malta.plant_of(replace(design.spec.parameters, K_A=3 * 8626.7))
    margins = malta.verify(malta.linearize(stiff, stiff.at()), design.controller)
    assert not margins.stable
    assert np.isnan(margins.peak_sensitivity["sigma_max"])
    assert margins.poles.closed_loop.real.max() > 0
    assert str(margins).startswith("UNSTABLE")
    with pytest.raises(malta.CheckError, match=r"table2: the loop \(sampled\) is unstable"):
        require_stable(margins, "table2")


def test_table2_tolerates_a_third_of_the_published_uncertainty_with_its_observer(
    designs: dict[str, Design],
) -> None:
    """The 20 % box is left at about 33 % of it (K_A up, K_B down), where the LQR alone would reach 167 %."""
    design = designs["table2"]

    def stable(share: float) -> bool:
        par = design.spec.parameters
        worst = replace(par, K_A=8626.7 * (1 + 0.2 * share), K_B=5.2 * (1 - 0.2 * share))
        plant = malta.plant_of(worst)
        model = malta.linearize(plant, plant.at())
        return bool(np.abs(eigenvalues(sampled_loop(model, design.controller).closed)).max() < 1)

    assert stable(0.32)
    assert not stable(0.35)


def test_margins_print_in_engineers_units(designs: dict[str, Design]) -> None:
    text = str(designs["calibrated"].margins)
    assert text.startswith("stable with hold, delay and current loops")
    assert " rad/s)" in text
    assert " Hz (" in text
    assert " dB)" in text
    assert "uncertainty: m K_A K_D K_B ±20 %" in text
    assert "robust over the travel: proven 162.78 %, lost at 162.79 % at 95.72 rad/s" in text
    assert max(map(len, text.splitlines())) <= 100


def test_poles_are_sorted_and_read_only(design: Design) -> None:
    poles = design.margins.poles
    for name in ("open_loop", "regulator", "filter", "closed_loop"):
        values = getattr(poles, name)
        assert (np.diff(values.real) >= -1e-6).all()
        with pytest.raises(ValueError, match="read-only"):
            values[0] = 0


@pytest.mark.slow
def test_the_machine_has_its_own_delay(designs: dict[str, Design]) -> None:
    """T_d counts the hold's half sample: 75 us at 20 kHz is one whole sample more, and half a one at 13.3 kHz."""
    design = designs["calibrated"]
    assert design.plant.actuator.delay(50e-6) == 1
    delays = [design.plant.actuator.delay(Ts) for Ts in (75e-6, 150e-6, 25e-6)]
    assert delays == pytest.approx([0.5, 0, 2.5], rel=1e-12)
    slow = malta.plant_of(replace(design.spec.parameters, T_d=275e-6))
    margins = malta.verify(malta.linearize(slow, slow.at()), design.controller)
    assert margins.peak_sensitivity["sigma_max"] > 1.003 * design.margins.peak_sensitivity["sigma_max"]
    run = malta.simulate(slow, design.controller, malta.Scenario.stroke())
    late = malta.simulate(design.plant, design.controller, malta.Scenario.stroke(delay=5))
    assert run.p == pytest.approx(late.p, abs=1e-12)


def test_cogging_that_v0_does_not_cancel_shows(designs: dict[str, Design]) -> None:
    """Ten times the assumed cogging: more slope than table2's axial loop can hold, little to the calibrated one."""
    stable = {}
    for name, design in designs.items():
        rough = malta.plant_of(replace(design.spec.parameters, F_c=5.0))
        stable[name] = malta.verify(malta.linearize(rough, rough.at()), design.controller).stable
    assert stable == {"table2": False, "calibrated": True}


def test_force_constants_shape_the_natural_frequency(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    stronger = malta.plant_of(replace(design.spec.parameters, K_B=8.0))
    model = malta.linearize(stronger, stronger.at())
    closed = (model.force_map * np.array([8 / 5.2] * 4 + [1])) @ design.controller.K[:, :5] - model.stiffness
    expected = np.sqrt(np.linalg.eigvals(closed).real.max())
    assert malta.verify(model, design.controller).bandwidth["w_n_max"] == pytest.approx(expected, rel=1e-9)


def test_an_unstable_design_is_for_no_file(designs: dict[str, Design], tmp_path: Path) -> None:
    design = designs["table2"]
    stiff = malta.plant_of(replace(design.spec.parameters, K_A=3 * 8626.7))
    margins = malta.verify(malta.linearize(stiff, stiff.at()), design.controller)
    for suffix in malta.gains.SUFFIXES:
        with pytest.raises(malta.CheckError, match="unstable"):
            malta.gains.write(design.controller, margins, tmp_path / f"a{suffix}")
    assert not list(tmp_path.iterdir())


def test_names_of_the_version_before_say_what_to_write() -> None:
    spec = malta.read_design("examples/ball/design/ball.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    with pytest.warns(DeprecationWarning, match=r"malta\.Margins goes: write malta\.margins\.LoopReport"):
        assert malta.Margins is malta.margins.LoopReport
    with pytest.warns(DeprecationWarning, match="stages=True"):
        found = malta.robustness(spec.plant, controller, {"m": 0.2}, proof=False)
    assert [link.name for link in found.chain] == ["LQR", "LQI", "LQG", "LQGI", "sampled"]


def test_a_loop_is_verified_by_its_file_its_controller_or_its_machine() -> None:
    gains = "design/gains/halbach.json"
    controller = malta.gains.read(gains)
    plant = malta.plant_of(controller.parameters)
    ways = [
        malta.verify(gains, stages=False, proof=False),
        malta.verify(controller),
        malta.verify(plant, controller),
    ]
    assert len({way.peak_sensitivity["x"] for way in ways}) == 1
    for wrong in ((plant,), (controller, controller)):
        with pytest.raises(
            malta.InputError, match="a gain file, a controller, or a machine and its controller"
        ):
            malta.verify(*wrong)


@pytest.mark.parametrize("interval", [(-50, 50), [-50, 50], (0, 50), (-50, 0)])
def test_intervals_have_stages_and_print(interval: tuple[float, float]) -> None:
    """A parameter whose value is 0 varies over an interval; a share of it is refused."""
    terms = {"k": [[[0, 0], [1, 0]]]}
    p = malta.linear_machine([[0, 1], [100, 0]], [[0], [1]], [[1, 0]], nominal={"k": 0}, terms=terms)
    model = malta.linearize(p, p.at())
    c = malta.lqg(model, malta.synthesis.weights(q=[1e4, 1], r=[1], w=[1], v=[1e-8]), Ts=1e-3)
    quick, found = (malta.verify(model, c, {"k": interval}, stages=stages) for stages in (False, True))
    assert quick.robust is not None
    assert found.robust is not None
    assert quick.robust.lower == found.robust.lower
    words = f"uncertainty: k {interval[0]} to {interval[1]}"
    assert words in str(found)
    assert words in str(quick)
    sides = dict(zip(("down", "up"), found.tolerance["k"], strict=True))
    for side, at in zip(sides.values(), interval, strict=True):
        assert (side.lower is None) == (at == 0)
    with pytest.raises(malta.InputError, match=r"uncertainty\.k: found the interval"):
        malta.gains.document(c, found)
    with pytest.raises(malta.InputError, match=r"k: found a share of 0\.5 of its value, which is 0"):
        malta.verify(model, c, {"k": 0.5})
