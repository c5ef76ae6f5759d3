"""An electromagnetic suspension on a flexible guideway: eight states, six sensors, magnets driven by voltage.

A body with heave and pitch over a span with one mode; two magnets whose force saturates, F = C r^2 / (1 + (k_B r)^2)
with r = i / gap. Gaps are read late, body accelerations and currents at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np
import pytest

import malta
from malta.linear.closed_loops import instability
from malta.loops.parametric_loops import machine_system
from malta.model import Actuator, Plant, Sensors, Signal, check_parameters, si

if TYPE_CHECKING:
    from malta.synthesis.controller import Controller

TS = 5e-4


@dataclass(frozen=True)
class Suspension:
    """The parameters of a unit and its span."""

    m: float = si("kg", above=0)
    J: float = si("kg m^2", above=0)
    b: float = si("m", above=0)
    C: float = si("N m^2/A^2", above=0)
    s: float = si("m", above=0)
    k_B: float = si("m/A", at_least=0)
    R: float = si("ohm", above=0)
    m_g: float = si("kg", above=0)
    w_g: float = si("rad/s", above=0)
    z_g: float = si("1", at_least=0)
    U_max: float = si("V", above=0)
    preset: str = "custom"

    def __post_init__(self) -> None:
        check_parameters(self, "suspension.Parameters")


UNIT = Suspension(650.0, 150.0, 0.5, 1.222e-3, 10e-3, 2e-4, 1.0, 3e4, 6.5 * 2 * np.pi, 0.01, 200.0)


def plant(par: Any) -> Plant:
    """The unit at rest a gap s below its span, which the weight holds still."""
    weight = par.m * 9.81
    slope = ca.sqrt(weight / 2 / (par.C - weight / 2 * par.k_B**2))  # the r of half the weight
    held = par.s * slope

    def gaps(x: Any) -> Any:
        return ca.vertcat(par.s - x[0] - par.b * x[1] + x[2], par.s - x[0] + par.b * x[1] + x[2])

    def pull(x: Any) -> Any:
        r = (held + x[6:8]) / gaps(x)
        return par.C * r**2 / (1 + (par.k_B * r) ** 2)

    def rates(x: Any, u: Any, w: Any) -> Any:
        gap, i, F = gaps(x), held + x[6:8], pull(x)
        opening = ca.vertcat(-x[3] - par.b * x[4] + x[5], -x[3] + par.b * x[4] + x[5])
        return ca.vertcat(
            x[3:6],
            (F[0] + F[1] + w[0]) / par.m,
            (par.b * (F[0] - F[1]) + w[1]) / par.J,
            -(F[0] + F[1] - weight) / par.m_g - 2 * par.z_g * par.w_g * x[5] - par.w_g**2 * x[2],
            (u - par.R * i + 2 * par.C * i / gap**2 * opening) * gap / (2 * par.C),
        )

    def read(x: Any, _: Any) -> Any:
        gap, F = gaps(x), pull(x)
        heave, pitch = (F[0] + F[1] - weight) / par.m, par.b * (F[0] - F[1]) / par.J
        return ca.vertcat(par.s - gap, heave + par.b * pitch, heave - par.b * pitch, x[6:8])

    def rest(y: Any) -> Any:
        heave, pitch = (y[0] + y[1]) / 2, (y[0] - y[1]) / (2 * par.b)
        return ca.vertcat(heave, pitch, 0, 0, 0, 0, -slope * y[0], -slope * y[1])

    named = [("z", "m"), ("theta", "rad"), ("w_t", "m"), ("z_dot", "m/s"), ("theta_dot", "rad/s"), ("w_t_dot", "m/s"),
             ("i_1", "A"), ("i_2", "A")]  # fmt: skip
    read_as = [("y_1", "m"), ("y_2", "m"), ("a_1", "m/s^2"), ("a_2", "m/s^2"), ("c_1", "A"), ("c_2", "A")]
    voltages = (Signal("u_1", "V"), Signal("u_2", "V"))
    return Plant(
        name="suspension", parameters=par, variant=plant,
        states=tuple(Signal(*one) for one in named), inputs=voltages, outputs=tuple(Signal(*one) for one in read_as),
        disturbances=(Signal("F", "N"), Signal("M", "N m")),
        f=rates, h=read, load=lambda _: ca.vertcat(-weight, 0), position_of=rest,
        preload=lambda x: par.R * (held + x[6:8]),
        actuator=Actuator(voltages, (1.0, 1.0), current_limit=par.U_max, dead_time=1.5 * TS),
        sensors=Sensors(lag=(3e-4, 3e-4, 0.0, 0.0, 0.0, 0.0), noise=(1e-5, 1e-5, 0.05, 0.05, 0.02, 0.02)),
    )  # fmt: skip


@lru_cache(maxsize=1)
def designed() -> tuple[Plant, Controller]:
    machine = plant(UNIT)
    q = [1e6, 2.5e5, 0, 1 / 0.03**2, 1 / 0.06**2, 0, 0, 0]
    weights = malta.synthesis.weights(
        q,
        [1 / 50**2] * 2,
        [25.0] * 2,
        [1e-10, 1e-10, 0.01, 0.01, 4e-4, 4e-4],
        q_i=[1 / 3e-4**2] * 2 + [0.0] * 4,
    )
    return machine, malta.lqg(malta.linearize(machine, machine.at()), weights, TS, delay=1)


def stable(values: dict[str, Any]) -> bool:
    """Whether the loop of the unit with other parameters is stable at rest under its loads."""
    machine, law = designed()
    return malta.loop(machine.variant(replace(UNIT, **values)), law).stable


@pytest.mark.parametrize(
    "box",
    [
        pytest.param({"m": 0.2}, marks=pytest.mark.slow),
        pytest.param({"C": 0.1}, marks=pytest.mark.slow),
        {"w_g": 0.2},
        pytest.param({"w_g": 0.2, "m": 0.02, "C": 0.01}, marks=pytest.mark.slow),
    ],
)
def test_a_suspension_is_proven_at_rest_under_its_weight(box: dict[str, float]) -> None:
    """Its currents at rest follow mass and force constant; 100 machines of the box, and beyond the witness."""
    machine, law = designed()
    system, own = machine_system(machine, law, tuple(box), {})
    assert (system.approximate, system.left_out) == ("", "")
    found = malta.robust_margin(system, own, box, budget=malta.proof.Budget(work=60))
    assert found.lower is not None
    assert found.lower <= found.upper <= 1.15 * found.lower
    assert found.witness is not None
    rng = np.random.default_rng(3)
    nominal, shares = system.nominal, np.array(list(box.values()))
    signs = np.vstack([np.sign(rng.uniform(-1, 1, (50, len(box)))), rng.uniform(-1, 1, (50, len(box)))])
    p = nominal * (1 + 0.999 * found.lower * shares * signs)
    assert instability(system, own, p).max() < 0
    assert all(stable(dict(zip(box, values, strict=True))) for values in p[:8].tolist())
    beyond = {
        name: x + 1.01 * (found.witness[name] - x) for name, x in zip(box, nominal.tolist(), strict=True)
    }
    assert not stable(beyond)
