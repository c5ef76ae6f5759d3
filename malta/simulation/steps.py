"""Runge-Kutta steps in a sample: as many as the wanted integration error needs, found by step doubling.

Short flights, the pilots, are flown with n and with 2 n steps: forces at their limits, and the machine half a
clearance off its place, in the middle and near both ends of its stroke. The outputs differ by 15/16 of the error of n
steps. The first n whose error is a share 1 / RESERVE of what is wanted is taken: longer flights and machines near the
pilots' may err more.

A method of fourth order needs motions without kinks, and pilots have no faults. Where touchdown bearings push back or
faults may occur, there are at least KINKED_STEPS steps; no error is stated of flights with a contact or an opened
phase. None is of a mover that falls either: no loop corrects its errors.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, lru_cache, partial

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.model.parameters import acting_names, shape_parameters
from malta.model.plant import Plant, given_plant
from malta.model.plants import plant_of
from malta.simulation.divergence import rooms_in, rooms_of
from malta.simulation.engine.engines import engine_of, evaluate
from malta.simulation.inputs import initial_values, inputs_of
from malta.simulation.layout import Setup, columns_of_row, electronics_of, noise_scales
from malta.simulation.period import initial_state_function
from malta.simulation.references import Motion, Reference
from malta.simulation.scenario import MOST_SUBSTEPS, Scenario, Simulation, setup_of
from malta.synthesis.controller import Controller

INTEGRATION_ERROR = 1e-9  # m or rad, that is wanted unless a scenario has its own
NOISE_SHARE = 1e-3  # of the noise of outputs in other units counts as much
RESERVE = 10.0  # of the pilots' error
KINKED_STEPS = 4  # steps in a sample
MOST_TRIED = 1024  # steps in a sample
PILOT_SAMPLES = 160
PULSES = 8  # samples with forces at their limits, first one way, then the other
ROOM = 0.8  # share of the stroke within which pilots fly
OFF_PLACE = 0.5  # share of the clearance
NEARBY = 0.25  # share by which numbers of a machine differ that takes as many steps


@dataclass(frozen=True)
class Steps:
    """Runge-Kutta steps in a sample.

    count : of them
    error : bound of the integration error of the outputs, m or rad; of an output in another unit, in 1e6 of its noise.
        NaN: not estimated
    """

    count: int
    error: float


def choose_steps(plant: Plant, c: Controller, s: Scenario) -> Steps:
    """Return the Runge-Kutta steps in a sample of a scenario, and a bound of their error.

    plant : the machine; one near the gain file's takes as many steps
    c : its controller
    s : the scenario; its `substeps` are taken as they are, its `accuracy` is the wanted error

    Raises InputError for an `accuracy` that no number of steps reaches, with the smallest error that was found.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> malta.simulation.choose_steps(plant, controller, malta.Scenario.stroke(10e-3))
    Steps(count=1, error=1e-09)
    """
    plant = given_plant("choose_steps", plant)
    return _steps_of_setup(plant, c, setup_of(plant, c, s), s)


def steps_of(plant: Plant, c: Controller, s: Scenario) -> int:
    """Runge–Kutta steps in a sample, as `choose_steps` has them."""
    return choose_steps(plant, c, s).count


def substeps_of(plant: Plant, c: Controller, setup: Setup, s: Scenario) -> float:
    """Substeps of the simulation in a sample: Runge–Kutta steps, or periods of the machine's electronics.

    Raises InputError for more than MOST_SUBSTEPS, and as `choose_steps` does.
    """
    fast = electronics_of(plant, setup)
    if fast is None:
        return _steps_of_setup(plant, c, setup, s).count
    if s.accuracy is not None:
        raise InputError(s.where, "accuracy", f"{s.accuracy:g}", "none beside electronics of their own pace")
    count = c.sample_time / fast.period
    if count > MOST_SUBSTEPS:
        found = f"{count:.3g} periods of the electronics in a sample"
        raise InputError(s.where, "substeps", found, f"at most {MOST_SUBSTEPS}")
    return count


def stated_error(run: Simulation) -> float:
    """The bound of a completed flight's integration error, as in `Steps`; NaN where none is known."""
    plant, c, s, setup = run
    opened = setup.faulty and s.fidelity == "phase"
    if s.substeps is not None or opened or electronics_of(plant, setup) is not None:
        return math.nan
    return _steps_of_setup(plant, c, setup, s).error


def _steps_of_setup(plant: Plant, c: Controller, setup: Setup, s: Scenario) -> Steps:
    least = 2 if setup.fraction else 1
    if s.substeps is not None:
        return Steps(max(least, s.substeps), math.nan)
    least = KINKED_STEPS if setup.bearing or setup.faulty else least
    believed = plant_of(c.parameters)
    wanted = INTEGRATION_ERROR if s.accuracy is None else s.accuracy
    machine = believed if _is_near(plant, believed) else plant
    kept = (s.fidelity, s.delay, s.scheduled, s.bearing_axes)
    found = _search(machine, c, kept, wanted)
    if s.accuracy is not None and found.error > wanted:
        expected = f"at least {found.error:.2g}, the smallest error found, with {found.count} steps a sample"
        raise InputError(s.where, "accuracy", f"{wanted:g}", expected)
    return replace(found, count=max(least, found.count))


@lru_cache(maxsize=64)
def _is_near(plant: Plant, other: Plant) -> bool:
    """Whether two machines are of the same kind, and all numbers of one are within NEARBY of those of the other."""
    if plant is other:
        return True
    par, like = plant.parameters, other.parameters
    if type(par) is not type(like) or shape_parameters(par) != shape_parameters(like):
        return False
    pairs = [(getattr(par, name), getattr(like, name)) for name in {*acting_names(par), *acting_names(like)}]
    return all(abs(one - base) <= NEARBY * abs(base) for one, base in pairs)


@lru_cache(maxsize=64)
def _search(plant: Plant, c: Controller, kept: tuple[str, float | None, bool, str], wanted: float) -> Steps:
    """The least steps found whose error is `wanted`, or else those of the smallest error.

    kept : of the scenario: fidelity, delay, scheduled and bearing_axes, which act on the motion within a sample
    """
    names = ("fidelity", "delay", "scheduled", "bearing_axes")
    pilots = _pilots(plant, c, dict(zip(names, kept, strict=True)))
    noise = np.asarray(plant.sensors.noise, dtype=float)
    other = np.array([signal.unit not in ("m", "rad") for signal in plant.outputs]) & (noise > 0)
    sizes = np.where(other, noise * NOISE_SHARE / INTEGRATION_ERROR, 1.0)
    flights = cache(lambda count: [_fly(pilot, count) / sizes for pilot in pilots])

    def error(count: int) -> float:
        pairs = zip(flights(count), flights(2 * count), strict=True)
        return 16 / 15 * RESERVE * max(_largest_difference(*pair) for pair in pairs)

    return _first_below(error, wanted)


def _first_below(error: Callable[[int], float], wanted: float) -> Steps:
    """The steps of the first of some numbers whose error is `wanted`, or else those of the smallest error."""
    best, count = Steps(1, math.inf), 1
    while count <= MOST_TRIED:
        found = error(count)
        if found <= wanted:
            return Steps(count, wanted)
        if found > 0.6 * best.error and count >= 16:  # rounding, or no fourth order
            break
        best = min(best, Steps(count, found), key=lambda one: one.error)
        more = (found / wanted) ** 0.25 if wanted else math.inf
        count = math.ceil(count * min(4.0, max(1.25, more)))
    return best


def _largest_difference(one: FloatArray, other: FloatArray) -> float:
    """Of two flights, as long as both last."""
    k = min(len(one), len(other))
    return float(np.abs(one[:k] - other[:k]).max(initial=0.0))


def _pilots(plant: Plant, c: Controller, fields: dict[str, object]) -> list[Simulation]:
    """Flights whose integration errors are compared."""
    limit = np.nan_to_num(np.asarray(c.limits.force, dtype=float), posinf=0.0)
    ends = c.feedforward.z_grid[[0, -1]].tolist() if plant.has_stroke else []
    found = []
    for k, end in enumerate([0.0, *ends]):
        place, sign = ROOM * end, (-1.0) ** k
        push = partial(_pulses, forces=sign * limit * (-1.0) ** np.arange(len(limit)), Ts=c.sample_time)
        start = _off_place(plant, place, sign)
        reference = partial(_rest, place=place)
        time = PILOT_SAMPLES * c.sample_time
        found.append(Scenario("pilot", time, reference, start, excitation=push).replace(**fields))
    return [Simulation(plant, c, pilot, setup_of(plant, c, pilot)) for pilot in found]


def _rest(plant: Plant, place: float) -> Reference:
    """A reference at rest at a place of the stroke."""

    def motion(t: FloatArray) -> Motion:
        p = np.zeros((len(t), len(plant.outputs)))
        if plant.has_stroke:
            p[:, plant.stroke_output] = place
        return Motion(p, np.zeros_like(p), np.zeros_like(p))

    return motion


def _pulses(t: FloatArray, forces: FloatArray, Ts: float) -> FloatArray:
    sample = np.round(t / Ts)[:, None]
    return np.where(sample < PULSES, (-1.0) ** sample, 0.0) * forces


def _off_place(plant: Plant, place: float, sign: float) -> dict[str, float]:
    """Positions beside the stroke that take OFF_PLACE of the clearance left at a place; none without contacts."""
    if not plant.contacts.names:
        return {}
    names = [state.name for state in plant.design_states]
    names = names[: len(names) // 2] if plant.second_order else names
    stroke = {plant.stroke.name: place} if plant.has_stroke else {}
    beside = [name for name in names if name not in stroke]
    states = ca.SX.sym("x", len(plant.states))
    share = ca.Function("share", [states], [ca.mmax(ca.densify(plant.contacts.contact(states)))])

    def off(size: float) -> dict[str, float]:
        return {name: sign * (-1.0) ** k * size for k, name in enumerate(beside)}

    def taken(size: float) -> float:
        return float(share(plant.state(stroke | off(size))))

    size, most = 1e-9, OFF_PLACE + (1 - OFF_PLACE) * taken(0.0)
    while taken(2 * size) < most and size < 1.0:
        size *= 2
    return off(size) if size < 1.0 else {}


def _fly(run: Simulation, count: int) -> FloatArray:
    """The outputs of a pilot with so many steps in a sample, k x p, until a contact or a divergence."""
    plant, c, _, setup = run
    inputs = inputs_of(run)
    start = initial_state_function(plant, c, setup)
    state = evaluate(start, *initial_values(run, inputs.given[0]))[0].ravel()
    still = np.zeros((len(inputs.t), len(noise_scales(plant, setup))))
    engine = engine_of(plant, c, setup, count)
    _, rows = engine.run(0, state, inputs.given, still, np.zeros((count * len(inputs.t), 0)))
    columns, rooms = columns_of_row(plant, c, setup), rooms_of(run, inputs)
    over = ~np.isfinite(rows).all(axis=1) | (rows[:, columns["contact"]] >= 1).any(axis=1)
    if rooms.size:
        over |= (rooms_in(run, rows, inputs.given[: len(rows)], rooms) >= 1).any(axis=1)
    flown = int(over.argmax()) if over.any() else len(rows)
    return rows[:flown, columns["p"]]
