"""Linear verification of a controller on a machine: poles, sensitivities, bandwidths, stage by stage.

The loop is the block diagram of controller.py, sampled: P is the machine from forces to measurements under a
zero-order hold, exactly; F the control law from measurements to forces (v = F y). At the sensors
    S = (I - P F)^-1,   T = I - S,   L = -P F.
Where currents are held that were commutated for the last reading, that is one more input of P, and F hands it on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from malta.errors import CheckError, InputError
from malta.margins.box import Box, box_of
from malta.margins.expressions import NotAnalytic
from malta.margins.extent import NOWHERE, Extent, extent_of, machine_at, positions_of
from malta.margins.gain import Gain, worst_case_gain
from malta.margins.held import held_machine
from malta.margins.plants import LONGEST, of_plant
from malta.margins.problem import OfSeveral
from malta.margins.robust import (
    TOLERANCE,
    Effort,
    Margin,
    common_margin,
    margin_at,
    margin_of,
    problem_of,
    robust_margin,
)
from malta.margins.uncertain import (
    Compensator,
    UncertainSystem,
    held_at,
    holds,
    model_of,
    sampled_law,
)
from malta.margins.weak import AnywhereHeld
from malta.model.data import plant_of
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import position_at, position_in, trim
from malta.synthesis.controller import (
    Controller,
    LinearLaw,
    handed_on,
    linear_law,
)
from malta.synthesis.riccati import (
    add_integrals,
    add_lags,
    delay_inputs,
    eigenvalues,
    sample,
)
from malta.threads import on_one_thread

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from malta.model.plant import ComplexArray, FloatArray, Plant

CurrentLoops = Literal["lag", "pi"]

# ISO 14839-3: upper limits of the peak sensitivity
ZONES = ((3.0, "A"), (4.0, "B"), (5.0, "C"), (np.inf, "D"))


@dataclass(frozen=True, eq=False)
class Poles:
    """Poles in rad/s; of sampled systems ln(lambda) / Ts, poles of pure delay left out."""

    open_loop: ComplexArray  # of the continuous model
    regulator: ComplexArray  # of the file's own sampled model with K, Ki; none of a PID
    filter: ComplexArray  # of the file's own sampled observer; none of a PID
    closed_loop: ComplexArray  # of the machine: hold, delay, current loops, controller

    def pairs(self) -> dict[str, list[list[float]]]:
        """Each set as rows [re, im]."""
        return {f.name: [[float(p.real), float(p.imag)] for p in getattr(self, f.name)] for f in fields(self)}


@dataclass(frozen=True)
class Stage:
    """One loop, from the ideal one to the machine's: what it costs in sensitivity."""

    name: str
    peak_sensitivity: Mapping[str, float]  # by sensor, and sigma_max of all
    peak_frequency: float  # rad/s, of sigma_max
    spectral_radius: float  # of the closed loop; stable below 1

    @property
    def stable(self) -> bool:
        return self.spectral_radius < 1


@dataclass(frozen=True, eq=False)
class Margins:
    """What verify found. The last stage is the machine; bandwidths are of that loop."""

    poles: Poles
    stages: tuple[Stage, ...]
    bandwidth: Mapping[str, float]  # rad/s, by definition
    uncertainty: Mapping[str, float]  # the relative box, by parameter, that the design is meant for
    robust: Margin | None  # in multiples of it, anywhere in `extent`; None without a box
    extent: Extent = NOWHERE  # what the margin covers beside the box

    @property
    def stable(self) -> bool:
        """The machine's loop is stable."""
        return self.stages[-1].stable

    @property
    def peak_sensitivity(self) -> Mapping[str, float]:
        """Of the machine's loop, by sensor and as sigma_max."""
        return self.stages[-1].peak_sensitivity

    def __str__(self) -> str:
        lines = [f"{'stable' if self.stable else 'UNSTABLE'} with hold, delay and current loops"]
        for stage in self.stages:
            peaks = "  ".join(
                f"{k} {v:.2f} {zone(v)}" for k, v in stage.peak_sensitivity.items() if k != "sigma_max"
            )
            largest = stage.peak_sensitivity["sigma_max"]
            lines.append(
                f"peak |S|, {stage.name}: {peaks}  all {largest:.2f} ({20 * np.log10(largest):.1f} dB)"
            )
        for key, value in self.bandwidth.items():
            lines.append(f"bandwidth, {BANDWIDTHS[key]}: {value:.1f} rad/s ({value / (2 * np.pi):.2f} Hz)")
        if self.uncertainty:
            box = "  ".join(f"{name} +-{share * 100:g} %" for name, share in self.uncertainty.items())
            everywhere = self.robust is None or NOT_BETWEEN not in self.robust.reason
            where = str(self.extent) if everywhere else "in the middle and at the end of the travel"
            lines += [f"uncertainty: {box}", f"{f'robust {where}'.rstrip()}: {self.robust}"]
        return "\n".join(lines)


BANDWIDTHS = {
    "sigma_max_T": "last -3 dB of sigma_max(T)",
    "sigma_min_T": "first -3 dB of sigma_min(T)",
    "crossover_max": "last 0 dB of sigma_max(L)",
    "w_n_max": "regulator's fastest natural frequency",
    "w_n_min": "regulator's slowest natural frequency",
}


def zone(peak: float) -> str:
    """ISO 14839-3 zone of a peak sensitivity: A below 3 (9.5 dB), B below 4, C below 5, D above."""
    return next(name for limit, name in ZONES if peak < limit or limit == np.inf)


@dataclass(frozen=True, eq=False)
class Loop:
    """Sampled machine x+ = Ad x + Bd v, y = Cd x, closed by the linear control law v = F y."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray
    control: LinearLaw
    sample_time: float  # s

    @property
    def closed(self) -> FloatArray:
        """State matrix of the closed loop, states of the machine first."""
        c = self.control
        return np.block(
            [
                [self.Ad + self.Bd @ c.D_y @ self.Cd, self.Bd @ c.C],
                [c.B_y @ self.Cd, c.A],
            ]
        )

    def loop_gain(self, w: FloatArray) -> ComplexArray:
        """L = -P F at the frequencies w (rad/s): k x p x p."""
        z = np.exp(1j * np.asarray(w) * self.sample_time)[:, None, None]
        P = self.Cd @ np.linalg.solve(z * np.eye(len(self.Ad)) - self.Ad, self.Bd)
        c = self.control
        F = c.C @ np.linalg.solve(z * np.eye(len(c.A)) - c.A, c.B_y) + c.D_y
        return np.asarray(-P @ F)

    def sensitivity(self, w: FloatArray) -> ComplexArray:
        """S = (I + L)^-1 at the sensors, k x p x p: also what noise becomes of in y."""
        return np.asarray(np.linalg.inv(np.eye(len(self.Cd)) + self.loop_gain(w)))


def loop(
    model: LinearModel,
    controller: Controller,
    *,
    delay: int = 0,
    current_loops: bool = False,
    feedforward: bool = False,
) -> Loop:
    """The sampled loop of a machine and a controller.

    delay : samples between measurement and force
    current_loops : forces follow their commands as a first-order lag at the loops' crossover
    feedforward : v0(z) acts by its slope; for models at their trim, where the loads act by theirs

    The controller commutates as the machine that it believes in, the machine's currents make their own forces.
    """
    model, law = _commanded(model, controller), linear_law(controller)
    A, B, C = model.A, model.B, model.C
    if model.E.any():
        A, B = A - model.E @ C, np.hstack([B, model.E])
    lag = model.plant.actuator.crossover
    if current_loops and math.isfinite(lag):
        A, B = add_lags(A, B, lag)
    Ad, Bd = delay_inputs(*sample(A, B, controller.sample_time), delay)
    Cd = np.hstack([C, np.zeros((len(C), len(Ad) - C.shape[1]))])
    if feedforward:
        m, plant = len(controller.forces), model.plant
        slope = np.zeros((m, len(C)))
        if plant.has_stroke:
            position = float(model.operating_point.x[plant.stroke_state])
            slope[:, plant.stroke_output] = controller.feedforward.slope(position)
        law = law._replace(B_y=law.B_y + law.B_r[:, -m:] @ slope, D_y=law.D_y + law.D_r[:, -m:] @ slope)
    if model.E.any():
        law = handed_on(law)
    return Loop(Ad, Bd, Cd, law, controller.sample_time)


def machine_loop(model: LinearModel, controller: Controller) -> Loop:
    """The loop as the machine runs it: hold, its own delay, current loops, loads against v0(z) at the trim.

    Raises CheckError when no input holds the machine at the model's operating point.
    """
    plant = model.plant
    loaded = linearize(plant, trim(plant, **position_at(plant, model.operating_point.x)))
    delay = plant.actuator.delay(controller.sample_time)
    return loop(loaded, controller, delay=delay, current_loops=True, feedforward=True)


@lru_cache(maxsize=8)  # every stage asks for it; records compare by identity, so no hit is stale
def _commanded(model: LinearModel, controller: Controller) -> LinearModel:
    """The model whose inputs are the forces that the controller wants of the machine it believes in."""
    believed = plant_of(controller.parameters)
    if believed is model.plant:
        return model
    return linearize(model.plant, model.operating_point, believed)


def own_poles(c: Controller) -> tuple[ComplexArray, ComplexArray]:
    """Eigenvalues in z of regulator and filter on the controller's own model (separation principle).

    Forces of disturbance are for the filter to follow, not for the regulator to move.
    """
    k = len(c.Ad) - c.observed * len(c.forces)
    A, B, K = c.Ad[:k, :k], c.Bd[:k], c.K[:, :k]
    if c.integrating:
        A, B = add_integrals(A, B, c.Cd[:, :k], c.sample_time)
        K = np.hstack([K, -c.Ki])
    return eigenvalues(A - B @ K), eigenvalues((np.eye(len(c.Ad)) - c.L @ c.Cd) @ c.Ad)


@on_one_thread
def unstable_gain(c: Controller) -> tuple[str, float] | None:
    """Which gains leave the file's own model unstable, and the size of the worst eigenvalue; None: none do.

    An LQG is judged by its regulator and its filter. A PID or a law of errors has no model: it is judged on the machine
    that it names.
    """
    if c.cost is None:
        plant = plant_of(c.parameters)
        model = linearize(plant, plant.point(c.operating_point[0]))
        found = {"K": eigenvalues(machine_loop(model, c).closed)}
    else:
        found = dict(zip("KL", own_poles(c), strict=True))
    for name, poles in found.items():
        radius = float(np.abs(poles).max())
        if not radius < 1:
            return name, radius
    return None


@on_one_thread
def verify(
    model: LinearModel, controller: Controller, uncertainty: Mapping[str, float] | None = None
) -> Margins:
    """Poles, peak sensitivities and bandwidths of a controller on a machine's linear model.

    Stages: the sampled loop as designed; with the current loops; the machine (`machine_loop`). An unstable loop is
    reported, not raised; its sensitivities are NaN. `uncertainty` is the relative half range of each parameter, which
    the margin counts in, which covers the travel and the intervals of `plant.over`.
    Raises CheckError where numbers overflow or no input holds the machine.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _verify(model, controller, dict(uncertainty or {}))
    except np.linalg.LinAlgError as error:
        raise CheckError(f"{controller.name}: the loop cannot be computed ({error})") from error


def _verify(model: LinearModel, controller: Controller, uncertainty: Mapping[str, float]) -> Margins:
    machine = machine_loop(model, controller)
    loops = {
        "sampled": loop(model, controller, delay=controller.delay),
        "+ current loops": loop(model, controller, delay=controller.delay, current_loops=True),
        "machine": machine,
    }
    names = [s.name for s in controller.measurements]
    stages = tuple(_stage(name, stage, names) for name, stage in loops.items())
    empty = np.zeros(0, dtype=complex)
    regulator, observer = (empty, empty) if controller.cost is None else own_poles(controller)
    poles = Poles(
        open_loop=_sorted(eigenvalues(model.A)),
        regulator=_continuous(regulator, controller.sample_time),
        filter=_continuous(observer, controller.sample_time),
        closed_loop=_continuous(eigenvalues(machine.closed), controller.sample_time),
    )
    bandwidths = _bandwidths(model, controller, machine, stable=stages[-1].stable)
    robust = travel_margin(model.plant, controller, uncertainty) if uncertainty else None
    return Margins(poles, stages, bandwidths, uncertainty, robust, extent_of(model.plant, uncertainty))


def machine_law(
    plant: Plant,
    controller: Controller,
    current_loops: CurrentLoops = "lag",
    *,
    held: FloatArray | None = None,
    handed: bool = False,
) -> Compensator:
    """The control law with the machine's hold, delay and current loops: lags at their crossover, or the PI loops.

    held, handed : as sampled_law takes them

    Raises InputError for other current loops, or PI loops that do not run with the control law.
    """
    if current_loops not in get_args(CurrentLoops):
        raise InputError("verify", "current_loops", repr(current_loops), "lag or pi")
    a = plant.actuator
    delay = a.delay(controller.sample_time)
    if current_loops == "lag" or controller.current_loop is None:
        return sampled_law(controller, delay, a.crossover, held=held, handed=handed)
    if plant.windings is None:
        raise InputError("verify", "current_loops", "pi", f"lag: those of a {plant.name} run much faster")
    return sampled_law(controller, delay, a.R / a.L, controller.current_loop, a.R)


def machine_system(
    plant: Plant,
    controller: Controller,
    names: Sequence[str],
    at: Mapping[str, float],
    current_loops: CurrentLoops = "lag",
) -> tuple[UncertainSystem, Compensator]:
    """The machine at a position in parameters by name, and its law: what its margin is asked of. See `machine_law`."""
    believed = plant_of(controller.parameters)
    if not holds(believed):
        return of_plant(plant, names, at=at, believed=believed), machine_law(plant, controller, current_loops)
    H = held_at(believed, position_in(believed, believed.at(**at).x))
    system = of_plant(plant, names, at=at, believed=believed, held=H)
    handed = system.matrices.size2_out(1) > len(H)
    return system, machine_law(plant, controller, current_loops, held=H, handed=handed)


@on_one_thread
def travel_margin(
    plant: Plant,
    controller: Controller,
    ranges: Mapping[str, float | tuple[float, float]],
    current_loops: CurrentLoops = "lag",
    names: Sequence[str] = (),
    *,
    time: float | None = None,
    progress: Callable[[float, float], None] | None = None,
) -> Margin:
    """The margin of the machine's loop anywhere in its travel: the position is one more interval of the proof.

    So are the parameters of `plant.over` that are not uncertain: a rotor is proven for every speed at once.
    Where the matrices have no short form along the travel, as those of the planar motor's held currents, its axes are
    proven by themselves, with a bound of what couples them anywhere in the travel (`weak`). Where that fails too, the
    margin is that in the middle and at the end, and says so.

    ranges : of the parameters, as robust_margin takes them
    names : parameters of the model, where others stand still beside those of `ranges`: one model for several questions
    time : s, of the whole search; None: 120
    """
    names = tuple(names or ranges)
    along, over = travel_loops(plant, controller, names, current_loops)
    alone = plant.has_stroke and not over  # places of the travel, and no other interval
    if alone and (problem := _anywhere(plant, controller, names, current_loops)) is not None:
        found = margin_of(problem, _box(along[0][0], ranges), Effort(time=time, progress=progress))
        if found.lower is not None:
            return found
    found = common_margin(along, ranges, over, time=time, progress=progress)
    if len(along) == 1:
        return found
    here = f"at {len(along)} places of the travel, {NOT_BETWEEN}"
    return replace(found, reason=f"{here}; {found.reason}" if found.reason else here)


def travel_loops(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops = "lag"
) -> tuple[list[tuple[UncertainSystem, Compensator]], dict[str, tuple[float, float]]]:
    """The loops of which travel_margin proves a margin, and the intervals that do not grow."""
    along, extent = _along(plant, controller, names, current_loops), extent_of(plant, names)
    return along, extent.intervals if len(along) == 1 else dict(extent.over)


@lru_cache(maxsize=8)  # several questions are asked of the same loops; records compare by identity
def _along(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops
) -> list[tuple[UncertainSystem, Compensator]]:
    """The machine's loop with its position as a parameter; its loops in the middle and at the end where not."""
    extent = extent_of(plant, names)
    if not (plant.has_stroke and _is_long(plant, controller, names)):
        at = {plant.stroke: 0.0} if plant.has_stroke else {}
        whole = machine_system(plant, controller, [*names, *extent.intervals], at, current_loops)
        if not plant.has_stroke or whole[0].matrices.n_instructions() < LONG:
            return [whole]
    every = (*names, *extent.over)
    return [loop_at(plant, controller, every, share * plant.travel, current_loops) for share in ENDS]


def _is_long(plant: Plant, controller: Controller, names: tuple[str, ...]) -> bool:
    """Whether the model along the travel is too long to be written out."""
    believed = plant_of(controller.parameters)
    held = holds(believed) and not believed.tabulated
    return held and model_of(plant, believed, names).n_instructions() > LONGEST


@lru_cache(maxsize=8)
def _anywhere(
    plant: Plant,
    controller: Controller,
    names: tuple[str, ...],
    current_loops: CurrentLoops,
    position: float | None = None,
) -> AnywhereHeld | None:
    """The loop anywhere in the travel, or at a position, as `weak` takes it; None where it has not that form."""
    law = machine_law(plant, controller, current_loops)
    if not _is_long(plant, controller, names) or law.delay != 1 or law.lag is not None:
        return None
    along = _along(plant, controller, names, current_loops)
    try:
        if position is None:
            travel = (-plant.travel, plant.travel)
            machine = held_machine(plant, plant_of(controller.parameters), names, travel)
        else:
            whole = _anywhere(plant, controller, names, current_loops)
            if whole is None:
                return None
            machine = whole.machine.at(position)
            along = [loop_at(plant, controller, names, position, current_loops)]
    except NotAnalytic:
        return None
    places = OfSeveral(tuple(problem_of(*loop) for loop in along))
    return AnywhereHeld(machine, replace(law, delay=0), places)


def _box(system: UncertainSystem, ranges: Mapping[str, float | tuple[float, float]]) -> Box:
    return box_of(system.names, system.nominal, system.limits, ranges, {}, caller="travel_margin")


@on_one_thread
def place_margin(
    plant: Plant,
    controller: Controller,
    ranges: Mapping[str, float | tuple[float, float]],
    position: float,
    current_loops: CurrentLoops = "lag",
    names: Sequence[str] = (),
) -> Margin:
    """The margin of the machine's loop at a position along its course; arguments as travel_margin takes them.

    The course is the stroke, or the first parameter of `plant.over`, as the speed of a rotor (`Extent.course`). Where
    there is no proof along the travel the search takes EACH at most.
    """
    names = tuple(names or ranges)
    if not plant.has_stroke:
        return robust_margin(*loop_at(plant, controller, names, position, current_loops), ranges)
    along, over = travel_loops(plant, controller, names, current_loops)
    if plant.stroke in over:
        return margin_at(*along[0], ranges, {plant.stroke: position}, over, tolerance=TOLERANCE)
    loop = loop_at(plant, controller, names, position, current_loops)
    if (problem := _anywhere(plant, controller, names, current_loops, position)) is not None:
        found = margin_of(problem, _box(loop[0], ranges), Effort(time=EACH))
        if found.lower is not None:
            return found
    return robust_margin(*loop, ranges, time=EACH)


@on_one_thread
def worst_sensitivities(
    plant: Plant,
    controller: Controller,
    ranges: Mapping[str, float | tuple[float, float]],
    current_loops: CurrentLoops = "lag",
    *,
    time: float | None = None,
) -> dict[str, Gain]:
    """The largest |S| of each sensor, the other loops closed, over the modelled box, the travel and `plant.over`.

    Arguments as travel_margin takes them; where there is no proof along the travel, in its middle and at its end.
    """
    along, over = travel_loops(plant, controller, tuple(ranges), current_loops)
    found = {}
    for k, sensor in enumerate(plant.outputs):
        each = [worst_case_gain(*loop, ranges, over, channel=k, time=time) for loop in along]
        worst = max(each, key=lambda gain: gain.lower)
        proven = [gain.upper for gain in each if gain.upper is not None]
        found[sensor.name] = replace(worst, upper=max(proven) if len(proven) == len(each) else None)
    return found


def places_along(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops = "lag"
) -> tuple[tuple[float, ...], ...]:
    """Positions along the course at which a margin of its own is worth its time; each place has one, or both signs."""
    shares = PLACES if covers_travel(plant, controller, names, current_loops) else ENDS
    return positions_of(plant, extent_of(plant, names), shares)


def covers_travel(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops = "lag"
) -> bool:
    """Whether one proof covers the travel, and not places of it."""
    return len(_along(plant, controller, names, current_loops)) == 1


def course_enters(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops = "lag"
) -> bool:
    """Whether the machine's loop depends on the position along its course; names as places_along takes them."""
    along, course = _along(plant, controller, names, current_loops), extent_of(plant, names).course
    if len(along) > 1:
        return True
    if not course:
        return False
    system, law = along[0]
    index = system.names.index(course)
    return any(index in on for on in problem_of(system, law).loop.program.depends)


@lru_cache(maxsize=32)
def loop_at(
    plant: Plant,
    controller: Controller,
    names: tuple[str, ...],
    position: float,
    current_loops: CurrentLoops = "lag",
) -> tuple[UncertainSystem, Compensator]:
    """The machine's loop at a position along its course; the same records for the same question."""
    there, at = machine_at(plant, extent_of(plant, names).course, position)
    return machine_system(there, controller, names, at, current_loops)


NOT_PROVEN = Margin(None, math.inf, None, None, {}, {}, (), 0.0, "not asked")  # of a first look
NOT_BETWEEN = "not between them"  # what a margin of several places says
LONG = 5000  # operations of matrices that are not enclosed over an interval of positions
PLACES = (0.0, 1 / 3, 2 / 3, 1.0)  # shares of the travel, either way
EACH = 6.0  # s, of the margin at a position for itself
ENDS = (0.0, 1.0)  # of those, where no interval is enclosed


def require_stable(margins: Margins, name: str) -> None:
    """Raise CheckError when the machine's loop is unstable: such gains are not to be written."""
    for stage in margins.stages:
        if not stage.stable:
            raise CheckError(
                f"{name}: the loop ({stage.name}) is unstable, |lambda| = {stage.spectral_radius:.6f}"
            )


def _grid(Ts: float) -> FloatArray:
    return np.geomspace(1e-2, np.pi / Ts, 240)


def _stage(name: str, stage: Loop, sensors: list[str]) -> Stage:
    radius = float(np.abs(eigenvalues(stage.closed)).max())
    if radius >= 1:
        return Stage(name, dict.fromkeys([*sensors, "sigma_max"], np.nan), np.nan, radius)

    def sizes(w: FloatArray) -> FloatArray:
        S = stage.sensitivity(w)
        return np.column_stack([np.abs(np.einsum("kii->ki", S)), _singular_values(S)[:, 0]])

    peaks, at = largest(sizes, _grid(stage.sample_time))
    return Stage(name, dict(zip([*sensors, "sigma_max"], peaks.tolist(), strict=True)), float(at[-1]), radius)


def largest(sizes: Callable[[FloatArray], FloatArray], w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest values along frequency and where: sizes(w) has a column for each; w is zoomed into three times."""
    around, values = np.tile(w, (sizes(w[:1]).shape[1], 1)), sizes(w).T
    for _ in range(3):
        k = values.argmax(axis=1)
        rows = np.arange(len(k))
        low, high = around[rows, np.maximum(k - 1, 0)], around[rows, np.minimum(k + 1, around.shape[1] - 1)]
        around = np.geomspace(low, high, 17, axis=1)
        found = sizes(around.ravel()).reshape(*around.shape, -1)
        values = found[rows, :, rows]
    return values.max(axis=1), around[rows, values.argmax(axis=1)]


def _bandwidths(
    model: LinearModel, controller: Controller, machine: Loop, *, stable: bool
) -> dict[str, float]:
    natural = _natural_frequencies(_commanded(model, controller), controller)
    if not stable:
        return {key: np.nan for key in BANDWIDTHS if not key.startswith("w_n")} | natural
    w = _grid(machine.sample_time)
    L = machine.loop_gain(w)
    S = machine.sensitivity(w)
    T = _singular_values(np.eye(len(machine.Cd)) - S)
    half = np.sqrt(0.5)
    return {
        "sigma_max_T": crossing(w, T[:, 0], half, last=True),
        "sigma_min_T": crossing(w, T[:, -1], half, last=False),
        "crossover_max": crossing(w, _singular_values(L)[:, 0], 1.0, last=True),
        **natural,
    }


def _natural_frequencies(model: LinearModel, controller: Controller) -> dict[str, float]:
    """Of q'' = (k - G K1) q, rad/s; none where the states are not (q, q'), or nothing is fed back of them."""
    n = model.plant.coordinates
    if not n or controller.tracks == "errors":
        return {}
    closed = model.force_map @ controller.K[:, :n] - model.stiffness
    w_n = np.sqrt(np.maximum(eigenvalues(closed).real, 0))
    return {"w_n_max": float(w_n.max()), "w_n_min": float(w_n.min())}


def _singular_values(G: ComplexArray) -> FloatArray:
    return np.asarray(np.linalg.svd(G, compute_uv=False))


def crossing(w: FloatArray, size: FloatArray, level: float, *, last: bool = False) -> float:
    """Where size falls below level for the first or last time, between grid points on a log-log line.

    Zero where it never reaches the level, the Nyquist frequency where it never falls below.
    """
    falls = np.flatnonzero((size[:-1] >= level) & (size[1:] < level))
    if not len(falls):
        return float(w[-1] if size[-1] >= level else 0.0)
    k = falls[-1 if last else 0]
    (a, b), (wa, wb) = np.log(size[k : k + 2] / level), np.log(w[k : k + 2])
    return float(np.exp(wa + (wb - wa) * a / (a - b)))


def _continuous(sampled: ComplexArray, Ts: float) -> ComplexArray:
    return _sorted(np.asarray(np.log(sampled[np.abs(sampled) > 1e-6].astype(complex)) / Ts))


def _sorted(poles: ComplexArray) -> ComplexArray:
    poles = np.asarray(poles, dtype=complex)
    order = np.lexsort((poles.imag.round(6), poles.real.round(6)))
    frozen: ComplexArray = poles[order]
    frozen.flags.writeable = False
    return frozen
