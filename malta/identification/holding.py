"""What holds the machine along a part of its stroke, from the log of a slow stroke: v0(z) of the thrust."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import BSpline

from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.learn import believed_thrust
from malta.identification.log import Log, reference_spline, require_same_law
from malta.model.data import plant_of
from malta.synthesis.feedforward import V0_STEPS

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.synthesis.controller import Controller

SLOW = 0.02  # of the thrust's limit, that the inertia may take
SHORTEST = 2.0  # spacings of the spline's knots, that a stroke has to cover
DEGREE = 5  # of the splines in z: four derivatives are smooth


@display
@dataclass(frozen=True, eq=False)
class LearnedV0:
    """What a slow stroke taught about the thrust that holds the machine.

    z : m, points of the gain file's table within the stroke, ascending
    change : N, what is added to v0 of the thrust there
    deviation : N, its standard deviations by the noise of the position sensor
    controller : the law with the new table

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> rough = plant.variant(dataclasses.replace(plant.parameters, F_c=0.9))
    >>> stroke = malta.Scenario.stroke(10e-3, rise=0.15, noise=1.0, settle=0.3)
    >>> log = malta.identification.log_of(malta.simulate(rough, controller, stroke))
    >>> found = malta.identification.learn_v0(controller, log)
    >>> bool(0.3 < abs(found.change).max() < 0.5)  # 0.4 N more cogging
    True
    """

    z: FloatArray
    change: FloatArray
    deviation: FloatArray
    controller: Controller

    @property
    def description(self) -> Description:
        """Where the table changes, and by how much."""
        rows = (
            ("places", f"{1e3 * self.z[0]:.3g} to {1e3 * self.z[-1]:.3g} mm"),
            ("change", f"{self.change.min():.3g} to {self.change.max():.3g} N"),
            ("standard deviation", f"{self.deviation.max():.2g} N at most"),
        )
        return Description(f"v0(z) learned for {self.controller.name!r}", rows)


def learn_v0(controller: Controller, log: Log) -> LearnedV0:
    """Learn the thrust that holds the machine along a slow stroke, and write it into the gain file's table v0(z).

        sum of phi_i (f - v0(z)) - m sum of phi_i'' z = sum over j of c_j sum of phi_i phi_j,   v0 += sum of c_j phi_j

    with the thrust f that the law believes the measured currents to make (without currents in the log: its command),
    splines phi_j(z*(t)) along the reference, which are instruments, and the sum of phi z'' by parts: readings are not
    differentiated. Friction is in it unless the log goes there and back. Law, filter and exported C read the table at
    the reading of the stroke; outside of the places that the log has seen the change goes on as at the last of them.
    A second log under the new gain file corrects what is left. Learn the force constant first, as m z'' counts.

    controller : the gain file that flew
    log : of a slow stroke, or several, that begins and ends at rest; whole or a part of the travel

    Returns a LearnedV0; its controller is named NAME_learned.

    Raises InputError for a machine without a stroke, a log that moves too little or too fast; CheckError for missing
    samples and a log of another machine.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> stroke = malta.Scenario.stroke(10e-3, rise=0.15, noise=1.0, settle=0.3)
    >>> log = malta.identification.log_of(malta.simulate(plant, controller, stroke))
    >>> found = malta.identification.learn_v0(controller, log)
    >>> bool(abs(found.change).max() < 0.1)  # the table was right
    True
    """
    plant = plant_of(controller.parameters)
    if not plant.has_stroke:
        raise InputError(
            "learn", "machine", f"a {plant.name}, which has no stroke", "a machine with a stroke"
        )
    require_same_law(log, plant.name, controller.sample_time)
    stroke, k, table = plant.stroke, plant.thrust_input, controller.feedforward
    z, f = log.table("y", [stroke])[:, 0], believed_thrust(plant, log)
    if not (np.isfinite(z).all() and np.isfinite(f).all()) or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing")
    t = controller.sample_time * np.arange(log.samples)
    way = reference_spline(log, [stroke], controller.sample_time)
    z_ref, speed, slope = (way(t, order)[:, 0] for order in range(3))
    inertia = plant.mass * float(np.abs(slope).max())
    if inertia > SLOW * controller.limits.force[k]:
        found = f"a stroke that accelerates the mover by {inertia:.3g} N"
        raise InputError(
            log.source, f"ref.{stroke}", found, f"at most {SLOW * controller.limits.force[k]:.3g} N"
        )
    phi = _splines(float(z_ref.min()), float(z_ref.max()), plant.travel / V0_STEPS, log.source)
    at, bent = phi(z_ref), phi(z_ref, 2) * speed[:, None] ** 2 + phi(z_ref, 1) * slope[:, None]
    missing = f - np.interp(z, table.z_grid, table.v0[:, k])
    normal = np.linalg.inv(at.T @ at)
    c = normal @ (at.T @ missing - plant.mass * bent.T @ z)
    inside = (table.z_grid >= z_ref.min()) & (table.z_grid <= z_ref.max())
    places = phi(np.clip(table.z_grid, z_ref.min(), z_ref.max()))
    noise = float(
        np.hypot(plant.noise[plant.stroke_output], plant.resolution[plant.stroke_output] / np.sqrt(12))
    )
    scatter = plant.mass * noise * np.linalg.norm(places @ normal @ bent.T, axis=1)
    v0 = table.v0.copy()
    v0[:, k] += places @ c
    taught = replace(controller, name=f"{controller.name}_learned", feedforward=replace(table, v0=v0))
    return LearnedV0(table.z_grid[inside], (places @ c)[inside], scatter[inside], taught)


def _splines(low: float, high: float, step: float, source: str) -> BSpline:
    """Splines in z with knots about a step apart, m. Raises InputError for a stroke that is too short."""
    if high - low < SHORTEST * step:
        found = f"a stroke of {1e3 * (high - low):.3g} mm"
        raise InputError(source, "reference", found, f"at least {1e3 * SHORTEST * step:.3g} mm")
    inner = np.linspace(low, high, round((high - low) / step) + 1)
    knots = np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])
    return BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)
