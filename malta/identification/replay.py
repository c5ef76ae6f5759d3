"""The law on a logged machine's readings: does it command what was logged, and are its innovations white?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import CheckError, InputError
from malta.identification.log import Log, in_order, reference_spline, require_same_law, sample_excitation
from malta.identification.response import acting_parameters
from malta.identification.spectra import MAX_PARAMETER_CHANGE, sentence_of
from malta.model.parameters import twins_of
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.simulation.engine.sample_loops import SampleLoop, loop_of
from malta.simulation.inputs import Inputs, initial_values, sample_inputs
from malta.simulation.layout import layout_of
from malta.simulation.period import law_reference
from malta.simulation.references import Motion
from malta.simulation.scenario import Scenario, Simulation, simulation_of
from malta.simulation.simulate import simulate
from malta.synthesis.controller import Controller, given_law
from malta.synthesis.law import command_forces, freeze_moving, frozen_axes, gains_of, interpolate, look_ahead
from malta.synthesis.linear_law import estimate_states, filter_reading, sum_errors

COMMAND_TOLERANCE = 1e-6  # of a force's limit, which files of nine digits keep too
SETTLED_SHARE = 0.5  # of a log, after which the start of the filter is forgotten
LAGS = 20  # samples, over which innovations are tested
MAX_INNOVATION_RATIO = 1.2  # to the innovations of the gain file's own machine; beyond, a log's are refused
MAX_CORRELATION_DIFFERENCE = 0.1  # of autocorrelations; 6 standard deviations where that is more
NOISELESS_SHARE = 0.1  # of what noise adds to an innovation: with less it counts as without noise
STEP = 0.01  # of a parameter, by which the machine is moved to see what that changes
SEED = 1  # of the noise of the gain file's own machine: not that of a simulated log


@display
@dataclass(frozen=True, eq=False)
class LawReplay:
    """A law that ran on logged readings.

    v : k x m, what it commands
    innovation : k x p, reading less the filter's prediction
    difference : by input: the largest difference to the logged command, N or N m, in the second half of the log
    at_once : by input: the same from the first sample on
    rms : by output: of the innovation in the second half, SI
    expected : by output: noise and steps of the machine's sensors, SI
    whiteness : by output: the largest autocorrelation of the innovation over 20 samples, in standard deviations
    same : whether all commands are the logged ones, but for rounding
    own : by output: rms of the innovation of the gain file's own machine on this reference and excitation, SI
    unlike : by output: by how much an autocorrelation of the innovation differs from that one's, at most; 0 where the
        innovation is that of this machine without noise
    allowed : of `unlike`, from the number of samples
    explained : where the innovations are refused, by parameter: its change as a share of its value, and the share of
        their power beyond the own machine's that this explains

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> found = malta.identification.replay_law(
    ...     controller, malta.identification.log_of(run)
    ... )
    >>> found.v.shape, found.innovation.shape
    ((2000, 5), (2000, 5))
    """

    v: FloatArray
    innovation: FloatArray
    difference: Mapping[str, float]
    at_once: Mapping[str, float]
    rms: Mapping[str, float]
    expected: Mapping[str, float]
    whiteness: Mapping[str, float]
    same: bool
    own: Mapping[str, float]
    unlike: Mapping[str, float]
    allowed: float
    explained: Mapping[str, tuple[float, float]]

    @property
    def refusal(self) -> str:
        """Why the log is not one of this law on the machine that its filter knows; "": it is."""
        if not self.same:
            name = max(self.difference, key=lambda n: self.difference[n])
            return (
                f"{name} differs by {self.difference[name]:.2g} from the log: another law or other gains flew"
            )
        return self.doubt + sentence_of(self.explained)

    @property
    def doubt(self) -> str:
        """What is wrong with the innovations, with numbers; "": nothing."""
        name = max(self.own, key=lambda n: self.rms[n] / self.own[n])
        if self.rms[name] > MAX_INNOVATION_RATIO * self.own[name]:
            return (
                f"the innovation of {name} has {self.rms[name]:.3g} rms, {self.rms[name] / self.own[name]:.3g} times "
                f"that of the gain file's machine, at most {MAX_INNOVATION_RATIO:g} is noise"
            )
        name = max(self.unlike, key=lambda n: self.unlike[n])
        if self.unlike[name] > self.allowed:
            return (
                f"the innovation of {name} is not as white as that of the gain file's machine: autocorrelations differ "
                f"by {self.unlike[name]:.2g}, at most {self.allowed:.2g} is noise"
            )
        return ""

    @property
    def description(self) -> Description:
        """Whether the commands are those of the log, and how large the innovations are."""
        rows = [("commands", "as logged" if self.same else "others than logged")]
        rows += [(f"{name} differs by", f"{value:.2g}") for name, value in self.difference.items()]
        return Description(f"Replay of {len(self.v)} samples", tuple(rows))


def replay_law(controller: Controller, log: Log, *, same: bool | None = None) -> LawReplay:
    """Run a law on logged readings and compare what it commands, sample by sample.

    The filter starts at rest at the first reference, as a run of `malta.simulate` does. A log that begins in operation
    agrees once that start is forgotten, which the second half of the log shows. Derivatives of the reference are taken
    from its samples.

    Where the commands are the log's, the gain file's own machine is simulated with the same reference and excitation,
    with noise and steps of its sensors. Innovations of the log that are larger than its, or correlated otherwise, are
    of another machine: `refusal` says so, and which parameter would explain them. Filters that are weighted for
    robustness have no white innovations on any machine; so these are what the log's are compared with, not white noise.

    controller : the gain file
    log : with measured outputs, commands and reference
    same : whether its commands are known to be those of this law, as `replay_dump` knows; None: they are compared here

    Returns a LawReplay, also where its `refusal` says what is wrong.

    Raises InputError for a log without these columns, CheckError for another machine, another sample time or missing
    samples.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/robust.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> run = malta.simulate(plant, controller, malta.Scenario.stroke(noise=1.0))
    >>> malta.identification.replay_law(controller, malta.identification.log_of(run)).same
    True
    """
    controller = given_law("replay_law", controller)
    plant = plant_of(controller.parameters)
    require_same_law(log, plant.name, controller.sample_time)
    log = in_order(log, plant)
    y = log.table("y", [s.name for s in plant.outputs])
    v = log.table("v", [s.name for s in plant.inputs])
    sent = log.columns.get("excitation", np.zeros(1))
    if not all(np.isfinite(table).all() for table in (y, v, sent)) or log.survey.gaps:
        raise CheckError(f"{log.source}: samples are missing, and a law cannot run on")
    simulation, inputs = _inputs(controller, log)
    commands, innovation = _run(simulation, inputs, y)
    half = int(SETTLED_SHARE * len(y))
    off = np.abs(commands - v)
    late = innovation[half:]
    names, forces = [s.name for s in plant.outputs], [s.name for s in plant.inputs]
    noise = np.sqrt(np.array(plant.sensors.noise) ** 2 + np.array(plant.sensors.resolution) ** 2 / 12)
    largest = off[half:].max(axis=0)
    if same is None:
        same = bool((largest <= COMMAND_TOLERANCE * controller.limits.force).all())
    rms = np.sqrt((late**2).mean(axis=0))
    twin = _Twin(controller, log, (simulation, inputs)) if same else None
    own = late if twin is None else twin.innovation(plant, noise=1.0)[half:]
    unlike = np.abs(_autocorrelations(late) - _autocorrelations(own)).max(axis=1)
    allowed = max(MAX_CORRELATION_DIFFERENCE, 6 * float(np.sqrt(2 / len(late))))
    if twin is not None and (unlike > allowed).any():  # or a flight without noise, as simulations have
        still = twin.innovation(plant, noise=0.0)[half:]
        unlike[(late - still).std(axis=0) <= NOISELESS_SHARE * own.std(axis=0)] = 0.0
    found = LawReplay(
        commands,
        innovation,
        difference=dict(zip(forces, largest.tolist(), strict=True)),
        at_once=dict(zip(forces, off.max(axis=0).tolist(), strict=True)),
        rms=dict(zip(names, rms.tolist(), strict=True)),
        expected=dict(zip(names, noise.tolist(), strict=True)),
        whiteness={name: whiteness(column) for name, column in zip(names, late.T, strict=True)},
        same=same,
        own=dict(zip(names, np.maximum(np.sqrt((own**2).mean(axis=0)), 1e-300).tolist(), strict=True)),
        unlike=dict(zip(names, unlike.tolist(), strict=True)),
        allowed=allowed,
        explained={},
    )
    if twin is None or not found.doubt:
        return found
    return replace(found, explained=_explain(plant, twin, late, own, noise))


def whiteness(values: FloatArray) -> float:
    """The largest autocorrelation of a series over LAGS samples, in standard deviations of a white one."""
    return float(np.abs(_autocorrelations(values[:, None])).max() * np.sqrt(len(values)))


def _autocorrelations(table: FloatArray) -> FloatArray:
    """The autocorrelations of each column over 1 to LAGS samples, columns x LAGS; 0 of a series that is constant."""
    centred = table - table.mean(axis=0)
    power = (centred**2).sum(axis=0)
    if len(centred) <= LAGS + 1:
        return np.zeros((table.shape[1], LAGS))
    lags = [(centred[k:] * centred[:-k]).sum(axis=0) for k in range(1, LAGS + 1)]
    return np.asarray((np.array(lags) / np.where(power > 0, power, 1.0)).T)


class _Twin:
    """The machine of a gain file, or one near it, on the reference and the excitation of a log.

    given : what the law is given on that log, `_inputs`
    """

    def __init__(self, controller: Controller, log: Log, given: tuple[Simulation, Inputs]) -> None:
        self.controller, self.log, self.given = controller, log, given

    def innovation(self, plant: Plant, noise: float) -> FloatArray:
        """Innovations of the law on this machine, k x p. Raises CheckError where it does not fly to the end."""
        fidelity: Any = "force" if plant.actuator.windings is None else "dq"
        scenario = self.given[0].scenario.replace(
            noise=noise, quantize=noise > 0, fidelity=fidelity, seed=SEED
        )
        run = simulate(plant, self.controller, scenario)
        if not run.verdict.completed:
            end = f"{run.verdict}"
            raise CheckError(f"{self.log.source}: the gain file's machine does not fly this reference: {end}")
        return _run(*self.given, run.y)[1]


def _explain(
    plant: Plant, twin: _Twin, late: FloatArray, own: FloatArray, noise: FloatArray
) -> dict[str, tuple[float, float]]:
    """By parameter: the change of it that explains most of the innovations, as a share of its value, and how much.

    late : the innovations of the log, second half
    own : those of the gain file's own machine, with noise

    The innovations move by a D with the change a, D from a machine that is 1 % off without noise. The power of what is
    left is compared with that beyond the own machine's noise.
    """
    late_half = slice(-len(late), None)
    still = twin.innovation(plant, noise=0.0)[late_half]
    off = (late - still) / noise
    beyond = float((off**2).sum() - ((own - still) ** 2 / noise**2).sum())
    found: dict[str, tuple[float, float]] = {}
    alike = twins_of(plant.parameters)
    for name in acting_parameters(plant):
        value = float(getattr(plant.parameters, name))
        both = dict.fromkeys([name, *(n for n, other in alike.items() if other == name)], (1 + STEP) * value)
        par: Any = plant.parameters
        try:
            moved = twin.innovation(plant.variant(replace(par, **both)), noise=0.0)[late_half]
        except (CheckError, InputError):
            continue
        D = (moved - still) / (STEP * noise)
        power = float((D**2).sum())
        if power > 0 and beyond > 0:
            a = float((off * D).sum()) / power
            if abs(a) < MAX_PARAMETER_CHANGE:
                found[name] = (a, min(1.0, a**2 * power / beyond))
    return found


def reference_motion(log: Log, names: list[str], sample_time: float) -> Callable[[Any], Motion]:
    """The reference of a log as a motion of time, s, with its derivatives; raises as `reference_spline`.

    An output of which no two successive samples differ but by a jump is at rest between its jumps.
    """
    spline, table = reference_spline(log, names, sample_time), log.table("reference", names)
    moves = np.diff(table, axis=0) != 0
    jumps = moves.any(axis=0) & ~(moves[1:] & moves[:-1]).any(axis=0)

    def motion(t: Any) -> Motion:
        k = np.clip(np.round(np.asarray(t) / sample_time).astype(int), 0, len(table) - 1)
        moving = (spline(t), spline(t, 1), spline(t, 2))
        return Motion(*np.where(jumps, (table[k], *np.zeros((2, *table[k].shape))), moving))

    return motion


def _inputs(controller: Controller, log: Log) -> tuple[Simulation, Inputs]:
    """What the law was given at every sample, from the reference and the excitation of a log."""
    plant, Ts = plant_of(controller.parameters), controller.sample_time
    names = [s.name for s in plant.outputs]
    motion = reference_motion(log, names, Ts)
    sent = log.columns.get("excitation", np.zeros((log.samples, 0)))
    t = Ts * np.arange(log.samples)
    given = motion(t)._replace(p=log.table("reference", names))
    excitation = sample_excitation(Ts, plant, sent) if sent.any() else None
    scenario = Scenario("replay", log.samples * Ts, lambda _: motion, fidelity="force", excitation=excitation)
    simulation = simulation_of(plant, controller, scenario)
    return simulation, Inputs(t, given, sample_inputs(simulation, given, t))


def _run(simulation: Simulation, inputs: Inputs, y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Commands and innovations of the law on readings y."""
    plant, c, _, _ = simulation
    p = len(plant.outputs)
    _, xi, _ = initial_values(simulation, inputs.given[0])
    z = y[:, plant.stroke_output] if plant.has_stroke else np.zeros(len(y))
    table = c.feedforward
    v0 = np.column_stack([np.interp(z, table.z_grid, column) for column in table.v0.T])
    state = np.concatenate([xi, np.zeros(2 * p)])
    rows = _law_loop(simulation)(state, (inputs.given, y, v0), np.zeros(0))
    return rows[:, : len(c.forces)], rows[:, len(c.forces) :]


@lru_cache(maxsize=4)
def _law_loop(simulation: Simulation) -> SampleLoop:
    """The law over samples: (xi_pred, e, frozen; given, y, v0) -> (v, innovation) of each."""
    plant, c, _, setup = simulation
    p, n, m = len(plant.outputs), len(c.states), len(c.forces)
    sizes = layout_of(plant, c, setup).given
    state = ca.SX.sym("state", n + 2 * p)
    given = {name: ca.SX.sym(name, size) for name, size in sizes.items()}
    y, v0 = ca.SX.sym("y", p), ca.SX.sym("v0", m)
    g = {name: ca.SX(value) for name, value in (gains_of(c) | {"rate": ca.DM(c.feedforward.rate)}).items()}
    g = dict(interpolate(g, c.schedule, given["p_ref"]))
    xi_pred, e, frozen = state[:n], state[n : n + p], state[n + p :]
    taken = filter_reading(c.tracks, y, given["p_ref"])
    xi_hat = estimate_states(g, xi_pred, taken)
    still = freeze_moving(g, frozen, given["dp_ref"])
    sums = sum_errors(g, e, still, y, given["p_ref"])
    xi_ref = law_reference(c, plant_of(c.parameters), g, given)
    after, saturated, v = command_forces(g, xi_hat, sums, xi_ref, given["v_ff"], v0)
    after, _ = look_ahead(g, after, y, given["dp_ref"])
    innovation = taken - g["Cd"] @ xi_pred
    inputs = ca.vertcat(*given.values(), y, v0)
    following = ca.vertcat(after, sums, frozen_axes(g, saturated))
    return loop_of(state, inputs, ca.SX(0, 1), following, ca.vertcat(v, innovation))
