"""Functions that machines share which differ in numbers alone: the same matrices as those traced for the numbers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import malta
from malta.model import traced
from malta.model.linearize import _derivatives

DESIGNS = ("robust", "planar", "halbach")


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) for name in DESIGNS])
def test_a_shared_function_has_the_matrices_of_numbers(name: str) -> None:
    par: Any = malta.read_design(f"design/{name}.toml").parameters
    plant = malta.plant_of(replace(par, m=1.07 * par.m))
    point = plant.at()
    shared = traced.trace(_derivatives, plant, None, False)
    alone = traced.trace(_derivatives, replace(plant), None, False)  # a copy is in no family
    assert len(shared.values) == 1
    assert not alone.values
    for own, other in zip(shared(point.x, point.u, point.u), alone(point.x, point.u, point.u), strict=True):
        np.testing.assert_allclose(own, other, rtol=1e-12, atol=1e-12 * np.abs(other).max(initial=0.0))


def test_machines_that_differ_in_numbers_are_traced_once() -> None:
    par: Any = malta.read("examples/ball/ball.toml")
    heavy, light = (malta.plant_of(replace(par, m=factor * par.m)) for factor in (1.5, 0.5))
    one, other = (traced.trace(_derivatives, plant, None, False) for plant in (heavy, light))
    assert one.function is other.function
    assert not np.allclose(np.array(one.values[0]), np.array(other.values[0]))


ROOT = """
from dataclasses import dataclass
import casadi as ca
import malta
from malta.model.parameters import si

@dataclass(frozen=True)
class Parameters:
    m: float = si("kg", above=0)
    e: float = si("1", at_least=0)
    preset: str = "custom"

def plant(par):
    x = ("q", "m"), ("q_dot", "m/s")
    return malta.model.Plant(
        name="root", parameters=par, states=tuple(malta.model.Signal(*s) for s in x),
        inputs=(malta.model.Signal("f", "N"),), outputs=(malta.model.Signal("q", "m"),),
        f=lambda x, u, w: ca.vertcat(x[1], (u[0] + ca.sqrt(par.e * x[0])) / par.m), h=lambda x, u: x[:1],
        actuator=malta.model.Actuator((malta.model.Signal("i", "A"),), (1.0,), current_limit=1.0), variant=plant,
    )
"""


def test_a_slope_that_numbers_alone_have_is_traced_for_the_numbers(tmp_path: Path) -> None:
    (tmp_path / "root.py").write_text(ROOT)
    module = malta.model.machines.machine(tmp_path / "root.py")
    plant = malta.plant_of(module.Parameters(m=1.0, e=0.0))
    assert malta.linearize(plant, plant.at()).A.tolist() == [
        [0.0, 1.0],
        [0.0, 0.0],
    ]  # of sqrt(e q) 0/0 where e is an input


def test_numbers_of_a_known_machine_that_make_a_function_of_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "root.py").write_text(ROOT.replace("ca.sqrt(par.e * x[0])", "x[0] * ca.sqrt(par.e - 1)"))
    module = malta.model.machines.machine(tmp_path / "root.py")
    assert malta.plant_of(module.Parameters(m=1.0, e=2.0)).name == "root"
    with pytest.raises(malta.InputError, match="root: f: found NaN"):
        malta.plant_of(module.Parameters(m=1.0, e=0.5))
