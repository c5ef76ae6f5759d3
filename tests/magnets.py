"""Magnets whose `currents` know more or less of their forces: the inverse, that of the middle, a slope, three coils."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

import malta

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.model.plant import Plant


@dataclass(frozen=True)
class Bench:
    """A mass before a magnet, with knobs for how wrong its currents are."""

    m: float = malta.model.si("kg", above=0)
    C: float = malta.model.si("N m^2/A^2", above=0)
    g0: float = malta.model.si("m", above=0)
    bias: float = malta.model.si("A", at_least=0)
    k: float = malta.model.si("N/m")  # spring, negative: a permanent magnet
    preload: float = malta.model.si("N")
    I_max: float = malta.model.si("A", above=0)
    lag: float = malta.model.si("s", at_least=0, shapes=True)  # of the sensors
    dead_time: float = malta.model.si("s", at_least=0, shapes=True)  # from measurement to force
    kind: str = "knows"
    preset: str = "custom"


def plant(par: Any) -> Plant:
    """The machine of these parameters, by its kind."""
    return two_coils(par) if par.kind == "three coils" else bench(par)


def bench(par: Any) -> Plant:
    """One magnet that pulls: u = C (bias + i)^2 / (g0 - x)^2; `currents` knows the gap, the middle, or a slope."""
    slope = 2 * par.C * max(par.bias, 1.0) / par.g0**2 if isinstance(par.bias, float) else 1.0

    def currents(y: Any, v: Any) -> Any:
        if par.kind == "knows":
            return ca.sqrt(v / par.C) * (par.g0 - y) - par.bias
        if par.kind == "middle":
            return ca.sqrt(v / par.C) * par.g0 - par.bias
        return v / slope

    return malta.model.Plant(
        name=f"bench that {par.kind}",
        parameters=par,
        variant=bench,
        states=(malta.model.Signal("x", "m"), malta.model.Signal("x_dot", "m/s")),
        inputs=(malta.model.Signal("f", "N"),),
        outputs=(malta.model.Signal("y", "m"),),
        disturbances=(malta.model.Signal("w", "N"),),
        f=lambda x, u, w: ca.vertcat(x[1], (u + w - par.k * x[0]) / par.m),
        h=lambda x, _: x[0],
        load=lambda _: -9.81 * par.m,
        preload=lambda _: ca.DM([par.preload]),
        actuator=malta.model.Actuator(
            (malta.model.Signal("i", "A"),),
            (),
            par.I_max,
            force_limit=(40.0,),
            dead_time=par.dead_time,
            currents=currents,
            forces=lambda x, i: par.C * (par.bias + i) ** 2 / (par.g0 - x[0]) ** 2,
        ),
        sensors=malta.model.Sensors(lag=(par.lag,)),
    )


BENCH = Bench(m=0.5, C=3e-5, g0=4e-3, bias=1.5, k=-200.0, preload=4.905, I_max=6.0, lag=0.0, dead_time=0.0)


def two_coils(par: Any) -> Plant:
    """Three coils for a force and a torque, whose shares of the force depend on the position, with a wrong inverse."""
    share = [[1.0, 1.0, 1.0], [1.0, 0.0, -0.6]]

    def forces(x: Any, i: Any) -> Any:
        return (ca.DM(share) + 40 * x[0] * ca.DM([[0, 1, 0], [2, 0, 1]])) @ (par.C * 1e5 * (i + 0.3 * i**2))

    right = np.linalg.pinv(np.array(share))
    return malta.model.Plant(
        name="three coils",
        parameters=par,
        variant=two_coils,
        states=tuple(
            malta.model.Signal(n, u)
            for n, u in (("z", "m"), ("a", "rad"), ("z_dot", "m/s"), ("a_dot", "rad/s"))
        ),
        inputs=(malta.model.Signal("f", "N"), malta.model.Signal("t", "N m")),
        outputs=(malta.model.Signal("p", "m"), malta.model.Signal("b", "rad")),
        disturbances=(malta.model.Signal("w", "N"),),
        f=lambda x, u, w: ca.vertcat(x[2:], (u[0] + w) / par.m - par.k * x[0], (u[1] + 0.02 * x[1]) / 1e-3),
        h=lambda x, _: x[:2],
        load=lambda _: -9.81 * par.m,
        preload=lambda _: ca.DM([par.preload, 0.1]),
        actuator=malta.model.Actuator(
            tuple(malta.model.Signal(f"i{k}", "A") for k in range(3)),
            (),
            current_limit=60.0,
            force_limit=(40.0, 20.0),
            dead_time=par.dead_time,
            currents=lambda y, v: ca.DM(right) @ v / (par.C * 1e5) * (1 + 10 * y[0]),
            forces=forces,
        ),
        sensors=malta.model.Sensors(lag=(par.lag, 0.5 * par.lag)),
    )


MACHINES: dict[str, tuple[Callable[[Any], Plant], Bench, dict[str, float]]] = {
    "inverse": (bench, BENCH, {"x": 1e-3}),
    "middle": (bench, replace(BENCH, kind="middle"), {"x": 1e-3}),
    "slope": (bench, replace(BENCH, kind="slope", bias=2.5), {"x": -0.7e-3}),
    "three coils": (two_coils, replace(BENCH, kind="three coils"), {"z": 0.8e-3, "a": 0.01}),
}
