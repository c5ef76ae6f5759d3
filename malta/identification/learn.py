"""What one stroke teaches about the next one: the thrust that a command makes, and what holds the machine on its way.

v0(z), the thrust that holds it along a part of its stroke, is learned from the log of a slow stroke.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.imperfections import COMMON_GAIN, GAIN, KNOWN_SHARES
from malta.identification.log import Log, log_of, reference_spline, require_currents, require_same_law
from malta.identification.replay import reference_motion
from malta.identification.signal_checks import driven_currents
from malta.identification.spectra import SIGMA
from malta.loops.loop import loop
from malta.model.parameters import symbolic_names
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.engine.engines import evaluate
from malta.simulation.scenario import Scenario
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller, given_law
from malta.synthesis.feedforward import V0_STEPS

INERTIA_SHARE = 0.02  # of the thrust's limit, that the inertia may take
MIN_KNOT_SPACINGS = 2.0  # spacings of the spline's knots, that a stroke has to cover
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

    with the thrust f that the law computes from the measured currents (without currents in the log: its command).
    The splines phi_j(z*(t)) along the reference are instruments. The sum of phi z'' is taken by parts: readings are
    not differentiated. Friction is in it unless the log goes there and back. Law, filter and exported C read the table
    at the reading of the stroke. Outside of the positions in the log, the change is that at the last of them.
    A second log under the new gain file corrects what is left. Learn the force constant first, as m z'' counts.

    controller : the gain file that was running
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
    controller = given_law("learn_v0", controller)
    plant = plant_of(controller.parameters)
    if not plant.has_stroke:
        raise InputError(
            "learn", "machine", f"a {plant.name}, which has no stroke", "a machine with a stroke"
        )
    require_same_law(log, plant.name, controller.sample_time)
    stroke, k, table = plant.stroke.name, plant.thrust_input, controller.feedforward
    z, f = log.table("y", [stroke])[:, 0], believed_thrust(plant, log)
    if not (np.isfinite(z).all() and np.isfinite(f).all()) or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing")
    t = controller.sample_time * np.arange(log.samples)
    way = reference_spline(log, [stroke], controller.sample_time)
    z_ref, speed, slope = (way(t, order)[:, 0] for order in range(3))
    inertia = plant.stroke.mass * float(np.abs(slope).max())
    if inertia > INERTIA_SHARE * controller.limits.force[k]:
        found = f"a stroke that accelerates the mover by {inertia:.3g} N"
        raise InputError(
            log.source, f"ref.{stroke}", found, f"at most {INERTIA_SHARE * controller.limits.force[k]:.3g} N"
        )
    phi = _splines(float(z_ref.min()), float(z_ref.max()), plant.stroke.travel / V0_STEPS, log.source)
    at, bent = phi(z_ref), phi(z_ref, 2) * speed[:, None] ** 2 + phi(z_ref, 1) * slope[:, None]
    missing = f - np.interp(z, table.z_grid, table.v0[:, k])
    normal = np.linalg.inv(at.T @ at)
    c = normal @ (at.T @ missing - plant.stroke.mass * bent.T @ z)
    inside = (table.z_grid >= z_ref.min()) & (table.z_grid <= z_ref.max())
    places = phi(np.clip(table.z_grid, z_ref.min(), z_ref.max()))
    noise = float(plant.sensors.deviations[plant.stroke_output])
    scatter = plant.stroke.mass * noise * np.linalg.norm(places @ normal @ bent.T, axis=1)
    v0 = table.v0.copy()
    v0[:, k] += places @ c
    taught = replace(controller, name=f"{controller.name}_learned", feedforward=replace(table, v0=v0))
    return LearnedV0(table.z_grid[inside], (places @ c)[inside], scatter[inside], taught)


def _splines(low: float, high: float, step: float, source: str) -> BSpline:
    """Splines in z with knots about a step apart, m. Raises InputError for a stroke that is too short."""
    if high - low < MIN_KNOT_SPACINGS * step:
        found = f"a stroke of {1e3 * (high - low):.3g} mm"
        raise InputError(source, "reference", found, f"at least {1e3 * MIN_KNOT_SPACINGS * step:.3g} mm")
    inner = np.linspace(low, high, round((high - low) / step) + 1)
    knots = np.concatenate([[low] * DEGREE, inner, [high] * DEGREE])
    return BSpline(knots, np.eye(len(knots) - DEGREE - 1), DEGREE)


MIN_THRUST_SHARE = 0.05  # of the thrust's limit, that a stroke has to take
FACTORS = (0.5, 2.0)  # of the thrust, beyond which something else is wrong
LOAD_SHARE = 0.005  # of the thrust's limit, or a quarter of what v0 spans where that is more: an unknown load
WAVES = (0.5, 8.0)  # of such a load, in the stroke
FULL = 0.999  # of the limit of the thrust: at its limit


@display
@dataclass(frozen=True, eq=False)
class Learned:
    """What a stroke taught.

    factor : command that was needed over the command that the law's machine needs; above 1 where the drive is weaker
    deviation : standard deviation of the factor by the noise of the position sensor
    load : N, amplitude of a load along the stroke that v0(z) lacks: a quarter of what v0 spans, or 0.5 % of the limit
    by_load : how far such a load moves the factor at the worst wave length and phase
    at_limit : share of the samples in which the thrust was at its limit
    demand : largest thrust that the stroke takes of this machine, over its limit with the new constant
    parameter : the force constant of the thrust, by name; "": none scales the thrust alone, and none was named
    before, after : its value in the gain file, and the value from the log, SI; 0 without a parameter
    controller : the law with that value

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> weak = plant.variant(dataclasses.replace(plant.parameters, K_D=4.68))  # 10 % less
    >>> stroke = malta.Scenario.stroke(10e-3, noise=1.0)
    >>> log = malta.identification.log_of(malta.simulate(weak, controller, stroke))
    >>> found = malta.learn(controller, log)
    >>> found.before, bool(abs(found.after - 4.68) < 0.05)
    (5.2, True)
    """

    factor: float
    deviation: float
    load: float
    by_load: float
    at_limit: float
    demand: float
    parameter: str
    before: float
    after: float
    controller: Controller

    @property
    def half(self) -> float:
        """Half of the 95 % interval of the factor, by noise and an unknown load along the stroke."""
        return float(np.hypot(SIGMA * self.deviation, self.by_load))

    @property
    def half_after(self) -> float:
        """Half of the total 95 % interval of the new value, SI: mass and gains of sensors are as uncertain as usual.

        They move the constant and not the factor, since the law believes the same ones. Friction moves neither: along a
        stroke that begins and ends at rest, its sum with a_ref vanishes.
        """
        known = SIGMA * np.sqrt(KNOWN_SHARES["kg"] ** 2 + 2 * (GAIN**2 + COMMON_GAIN**2))
        return float(abs(self.after) * np.hypot(self.half / self.factor, known))

    @property
    def limits(self) -> str:
        """What the limit of the thrust has to say; "": nothing."""
        if not self.at_limit and self.demand < 1:
            return ""
        was = (
            f"the thrust was at its limit in {100 * self.at_limit:.2g} % of the samples"
            if self.at_limit
            else ""
        )
        will = f"the same stroke takes {100 * self.demand:.3g} % of the limit" if self.demand >= 1 else ""
        return "; ".join(part for part in (was, will) if part)

    @property
    def description(self) -> Description:
        """The factor and the force constant."""
        rows = (
            ("thrust", f"{self.factor:.4f} +- {self.half:.2g} times the command that was expected"),
            (
                self.parameter or "no parameter by itself",
                f"{self.before:.5g} -> {self.after:.5g} +- {self.half_after:.2g}",
            ),
        )
        return Description(f"Learned for {self.controller.name!r}", rows)


def learn(controller: Controller, log: Log, *, parameter: str = "") -> Learned:
    """Learn one factor of the thrust from the log of a stroke, and write it into what the law believes.

        g = sum of (f - v0) a_ref / (m sum of z'' a_ref)

    with the thrust f that the law computes from the measured currents (without currents in the log: its command). v0(z)
    holds the mover at its reading. The acceleration a_ref of the reference is an instrument: neither noise nor the
    error of the stroke biases g. The sum of z'' a_ref is that of z a_ref'', by parts.
    Where currents are held between readings, the factor of the model's own stroke beside 1 is taken off g.
    The law commutates with a force constant K, and its filter predicts from the force that it believes to send. So
    K / g corrects both, where another inertia in the feedforward corrects only one.

    controller : the gain file that was running
    log : of a stroke
    parameter : the force constant of the thrust; "": found by its effect on the machine

    Returns a Learned; its controller has the new constant, or is the given one where no parameter scales the thrust
    alone, as where magnets make all forces.

    Raises InputError for a machine without a stroke, and for a log without one; CheckError for a factor out of reason,
    a thrust that was at its limit, and a log of another machine.

    >>> import dataclasses, malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> weak = plant.variant(dataclasses.replace(plant.parameters, K_D=4.68))  # 10 % less
    >>> stroke = malta.Scenario.stroke(10e-3, noise=1.0)
    >>> log = malta.identification.log_of(malta.simulate(weak, controller, stroke))
    >>> found = malta.learn(controller, log)
    >>> found.parameter, f"{found.factor:.2f}"
    ('K_D', '1.11')
    """
    controller = given_law("learn", controller)
    believed = plant_of(controller.parameters)
    if not believed.has_stroke:
        raise InputError(
            "learn", "machine", f"a {believed.name}, which has no stroke", "a machine with a stroke"
        )
    require_same_law(log, believed.name, controller.sample_time)
    name = parameter or thrust_constant(believed)
    if name and name not in symbolic_names(believed.parameters):
        known = " ".join(symbolic_names(believed.parameters))
        raise InputError("learn", name, "an unknown parameter", f"one of {known}")
    factor, by_noise, by_load = _thrust_factor(controller, believed, log)
    if loop(believed, controller).sampled_forces.Bd.shape[1] > len(believed.inputs):
        factor += 1 - _thrust_factor(controller, believed, own_stroke(controller, log))[0]
    deviation = factor * float(np.array(believed.sensors.noise)[believed.stroke_output]) * by_noise
    if not FACTORS[0] < factor < FACTORS[1]:
        found = f"{log.source}: the stroke took {factor:.3g} times the thrust that was expected"
        raise CheckError(f"{found}: more than a force constant is wrong")
    par: Any = controller.parameters
    before = after = float(getattr(par, name)) if name else 0.0
    limits, taught = controller.limits, controller
    if name:
        after = before / factor
        par = replace(par, **{name: after})
        # The limit is that of the current: a drive that is weaker has less force.
        now, then = (np.array(one.actuator.force_limit) for one in (plant_of(par), believed))
        finite = np.isfinite(now) & np.isfinite(then)
        grown = np.divide(now, then, out=np.ones(len(now)), where=finite & (then > 0))
        limits = replace(limits, force=limits.force * grown)
        taught = replace(controller, name=f"{controller.name}_learned", parameters=par, limits=limits)
    k, v0 = believed.thrust_input, controller.feedforward.v0
    load = max(LOAD_SHARE * controller.limits.force[k], float(np.ptp(v0[:, k])) / 4)
    sent = np.abs(log.table("v", [believed.stroke.thrust])[:, 0]) if log.names("v") else np.zeros(1)
    at_limit = float((sent >= FULL * controller.limits.force[k]).mean())
    largest = believed.stroke.mass * float(np.abs(_acceleration(controller, believed, log)).max())
    demand = (largest + float(np.abs(v0[:, k]).max())) * (1 if name else factor) / float(limits.force[k])
    return Learned(
        factor, deviation, float(load), float(load * by_load), at_limit, demand, name, before, after, taught
    )


def _acceleration(controller: Controller, believed: Plant, log: Log) -> FloatArray:
    """z'' of the reference of the stroke at its samples, m/s2."""
    t = controller.sample_time * np.arange(log.samples)
    return np.asarray(reference_spline(log, [believed.stroke.name], controller.sample_time)(t, 2)[:, 0])


def own_stroke(controller: Controller, log: Log) -> Log:
    """The gain file's own machine on the reference of a log, without noise.

    Where currents are held that are commutated for the last reading, they pull like a spring as soon as it moves.
    """
    plant = plant_of(controller.parameters)
    motion = reference_motion(log, [s.name for s in plant.outputs], controller.sample_time)
    scenario = Scenario("stroke", log.samples * controller.sample_time, lambda _: motion, fidelity="force")
    return log_of(simulate(plant, controller, scenario))


def thrust_constant(plant: Plant) -> str:
    """The parameter that scales the thrust of a current and no other force; "" where there is none."""
    own, k = np.array(plant.actuator.force_constant), plant.thrust_input
    for name in symbolic_names(plant.parameters):
        value = float(getattr(plant.parameters, name))
        if not value or not len(own):
            continue
        try:
            par: Any = replace(plant.parameters, **{name: 1.01 * value})
            ratio = np.array(plant.variant(par).actuator.force_constant) / own
        except (InputError, CheckError):  # a value that the machine cannot have
            continue
        wanted = np.where(np.arange(len(own)) == k, 1.01, 1.0)
        if np.allclose(ratio, wanted, rtol=1e-9):
            return name
    return ""


def _thrust_factor(controller: Controller, believed: Plant, log: Log) -> tuple[float, float, float]:
    """g of `learn`, its relative deviation by white noise of 1 m in z, and how far a wave of 1 N along z moves it.

    Raises InputError for a log without a stroke, and CheckError for missing samples.
    """
    stroke, thrust, Ts = believed.stroke.name, believed.thrust_input, controller.sample_time
    z_ref, z = log.table("reference", [stroke])[:, 0], log.table("y", [stroke])[:, 0]
    f = believed_thrust(believed, log)
    if not (np.isfinite(z).all() and np.isfinite(f).all()) or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing")
    t = Ts * np.arange(len(z_ref))
    a = _acceleration(controller, believed, log)
    largest = float(np.abs(a).max())
    if believed.stroke.mass * largest < MIN_THRUST_SHARE * controller.limits.force[thrust]:
        found = f"{largest:.3g} m/s2 at most in ref.{stroke}"
        raise InputError(log.source, "reference", found, "a stroke that takes 5 % of the thrust's limit")
    # By parts: a_ref and its slope vanish at both ends of a stroke.
    curved = make_interp_spline(t, a, k=5)(t, 2)
    along = float((z - z_ref) @ curved / (a @ a))
    table = controller.feedforward
    beyond = f - np.interp(z, table.z_grid, table.v0[:, thrust])
    moved = believed.stroke.mass * (1 + along) * float(a @ a)
    waves = np.geomspace(*WAVES, 40) * 2 * np.pi / max(float(np.ptp(z_ref)), 1e-300)
    by_load = float(np.abs(np.exp(1j * waves[:, None] * z_ref) @ a).max()) / abs(moved)
    return float(beyond @ a) / moved, float(np.linalg.norm(curved)) / float(a @ a), by_load


def believed_thrust(believed: Plant, log: Log) -> FloatArray:
    """The thrust that the law believes the measured currents to make, N; its command where no current is measured."""
    if believed.actuator.windings is None or not log.names("i"):
        return np.asarray(log.table("v", [believed.stroke.thrust])[:, 0])
    axes = [s.name for s in believed.drive.axes]
    i = ca.SX.sym("i", len(axes))
    thrust = ca.densify(believed.drive.force(i)[believed.thrust_input])
    acting = [axes[k] for k in ca.jacobian(thrust, i).sparsity().get_triplet()[1]]
    require_currents(log, axes, [name for name in driven_currents(believed) if name in acting])
    whole = np.zeros((log.samples, len(axes)))
    for k, name in enumerate(log.names("i")):
        whole[:, axes.index(name)] = log.columns["i"][:, k]
    force = ca.Function("force", [i], [thrust])
    return evaluate(force.map(len(whole)), whole)[0][:, 0]
