"""Uncertain systems and sampled laws against models made otherwise."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

import malta
from malta.errors import InputError
from malta.linear.closed_loops import closed_loop, critical_frequency, instability
from malta.linear.open_loops import responses
from malta.loops.sampled_laws import machine_law
from malta.loops.sampled_loops import sampled_loop
from malta.loops.uncertain_models import uncertain
from malta.proof.robust import robust_margin

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.plant import Plant

NAMES = ("m", "K_A", "K_D", "K_B", "l_B", "l_S", "I_xx")


def linear(plant: Plant, z: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    model = malta.linearize(plant, malta.trim(plant, z=z))
    return model.A, model.B, model.C


@pytest.mark.parametrize("z", [0.0, 7e-3])
def test_matrices_are_those_of_a_machine_with_these_parameters(design: Design, z: float) -> None:
    """The controller divides by its own force constants: B grows with the machine's."""
    plant = design.plant
    system = uncertain(plant, NAMES, at={"z": z})
    assert system.nominal.tolist() == [getattr(plant.parameters, name) for name in NAMES]
    rng = np.random.default_rng(0)
    for p in (system.nominal, *(system.nominal * rng.uniform(0.7, 1.4, (4, len(NAMES))))):
        values = dict(zip(NAMES, p.tolist(), strict=True))
        other = malta.plant_of(replace(plant.parameters, **values, I_yy=values["I_xx"]))
        A, B, C = linear(other, z)
        gain = np.array(other.actuator.force_constant) / np.array(plant.actuator.force_constant)
        for found, expected in zip(system.at(p), (A, B * gain, C), strict=True):
            assert found.shape == (1, *expected.shape)
            assert found[0] == pytest.approx(expected, rel=1e-12, abs=1e-12 * np.abs(expected).max())


def test_the_position_is_a_parameter_too(design: Design) -> None:
    system = uncertain(design.plant, ["z", "m"], at={"z": 2e-3})
    assert system.nominal.tolist() == [2e-3, 0.36]
    rows = np.array([[0.0, 0.36], [5e-3, 0.4], [-15e-3, 0.3]])
    matrices = system.at(rows)
    for k, (z, m) in enumerate(rows.tolist()):
        other = malta.plant_of(replace(design.plant.parameters, m=m))
        for found, expected in zip(matrices, linear(other, z), strict=True):
            assert found[k] == pytest.approx(expected, rel=1e-12, abs=1e-9)
    with_states = uncertain(design.plant, ["m"], states=True).at(np.array([0.3]))[2][0]
    assert with_states[5:] == pytest.approx(np.eye(10))
    assert system.limits == ((-np.inf, np.inf), (0.0, np.inf))


def test_a_machine_that_the_controller_does_not_know(designs: dict[str, Design]) -> None:
    """K_B = 4 N/A where the controller believes in 5.2: the same loop as verify's."""
    design = designs["calibrated"]
    weak = malta.plant_of(replace(design.spec.parameters, K_B=4.0))
    law = machine_law(weak, design.controller, "lag")
    system = uncertain(weak, ["m"], believed=design.plant)
    expected = sampled_loop(
        malta.linearize(weak, malta.trim(weak)), design.controller, delay=1, current_loops="lag"
    )
    w = np.geomspace(1, 6e4, 30)
    P, _, _, F = responses(system, law, system.nominal, w)
    assert np.linalg.inv(np.eye(5) - P @ F) == pytest.approx(expected.sensitivity(w), rel=1e-6, abs=1e-8)


def test_an_unknown_parameter_is_named(plant: Plant) -> None:
    with pytest.raises(InputError, match="K_X: found an unknown parameter, expected one of m "):
        uncertain(plant, ["m", "K_X"])


def test_the_closed_loop_is_verifys(design: Design) -> None:
    """Poles, sensitivity and spectral radius of the sampled machine, by the other route."""
    law = machine_law(design.plant, design.controller, "lag")
    system = uncertain(design.plant, ["m", "K_A"], at={"z": 4e-3})
    model = malta.linearize(design.plant, malta.trim(design.plant, z=4e-3))
    expected = sampled_loop(model, design.controller, delay=1, current_loops="lag")
    (ours,) = closed_loop(system, law, system.nominal)
    z = np.sort_complex(1 + 50e-6 * np.linalg.eigvals(ours))
    radius = float(np.abs(np.linalg.eigvals(expected.closed)).max())
    assert len(z) == len(expected.closed)
    assert np.abs(z).max() == pytest.approx(radius, abs=1e-9)
    assert instability(system, law, system.nominal)[0] == pytest.approx(
        np.log(radius) / 50e-6, rel=1e-5, abs=1e-5
    )
    w = np.geomspace(1, 6e4, 30)
    P, _, _, F = responses(system, law, system.nominal, w)
    assert np.abs(-P @ F - expected.loop_gain(w)).max() < 1e-6


def test_the_worst_pole_has_a_frequency(designs: dict[str, Design]) -> None:
    design = designs["calibrated"]
    law, system = (
        machine_law(design.plant, design.controller, "lag"),
        uncertain(design.plant, ["m", "K_A", "K_B"]),
    )
    m = robust_margin(system, law, {"m": 0.2, "K_A": 0.2, "K_B": 0.2})
    assert m.witness is not None
    p = np.array([m.witness[name] for name in system.names])
    assert critical_frequency(system, law, p) == pytest.approx(m.frequency, rel=1e-3)
