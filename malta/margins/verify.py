"""Linear verification of a controller on a machine: poles, sensitivities, bandwidths, stage by stage.

The loops and their signals are those of loops.py; at the sensors S = (I - P F)^-1, T = I - S, L = -P F.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np

from malta.arrays import FloatArray
from malta.budget import Budget
from malta.errors import CheckError, InputError
from malta.linear.closed_loops import instability
from malta.linear.matrices import eigenvalues, system_matrix
from malta.linear.open_loops import open_systems
from malta.linear.peaks import peak_gain
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.bandwidths import (
    in_sizes,
    last_crossover,
    peak_of_channels,
    peak_sensitivity,
    reading_sizes,
    tracked_band,
)
from malta.loops.classical import Classical, Nominal, classical_margins, worst_of
from malta.loops.loop import loop_of_model
from malta.loops.parametric_plants import of_plant
from malta.loops.sampled_laws import machine_law
from malta.loops.sampled_loops import (
    SampledLoop,
    commanded_model,
    continuous_poles,
    sampled_loop,
    sorted_poles,
)
from malta.loops.windings import LAST_STAGE, CurrentLoops, chosen_loops
from malta.margins.loop_report import BANDWIDTHS, ChainStage, LoopReport, Poles, StagePeak, TravelPlace
from malta.margins.travel import (
    PLACE_WORK,
    PLACES,
    LoopAlong,
    extent_of,
    own_position,
    place_margin,
    smallest_margin,
    travel_margin,
)
from malta.model.linearize import LinearModel, linearize
from malta.model.parameters import units_of
from malta.model.places import position_at
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.proof.margin import NOT_PROVEN, NOT_WRITTEN_TEXT, Margin, Progress, Ranges
from malta.proof.robust import robust_margin
from malta.synthesis.controller import Controller
from malta.synthesis.filters import gain_at_rest, kalman
from malta.synthesis.regulators import integrals_of, lqi, lqr
from malta.synthesis.separation import controller_poles
from malta.synthesis.weighting import weights_of
from malta.work import count_work, without_limit


@on_one_thread
def linear_report(
    model: LinearModel,
    controller: Controller,
    uncertainty: Ranges | None = None,
    current_loops: CurrentLoops = LAST_STAGE,
    *,
    time: float | None = None,
) -> LoopReport:
    """Report what is linear: poles, peak sensitivities, bandwidths, and the robust margin over an uncertainty.

    Stages: the sampled loop as designed; with the current loops; the machine. The robust margin covers the travel and
    the intervals of `plant.over`. The peak sensitivities of an unstable loop are NaN; instability raises nothing.

    Raises CheckError when numbers overflow or no input holds the machine.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            found = _nominal_report(model, controller, current_loops)
            if not uncertainty:
                return found
            robust = travel_margin(model.plant, controller, uncertainty, current_loops, time=time)
    except np.linalg.LinAlgError as error:
        raise CheckError(f"{controller.name}: the loop cannot be computed ({error})") from error
    extent = extent_of(model.plant, uncertainty, controller)
    return replace(found, uncertainty=dict[str, Any](uncertainty), robust=robust, extent=extent)


def _sizes(plant: Plant, controller: Controller) -> FloatArray | None:
    return reading_sizes(plant, None if controller.noise is None else controller.noise.sensor)


def _nominal_report(model: LinearModel, controller: Controller, current_loops: CurrentLoops) -> LoopReport:
    loops = {
        "sampled": sampled_loop(model, controller, delay=controller.delay),
        "+ current loops": sampled_loop(model, controller, delay=controller.delay, current_loops="lag"),
    }
    names = [s.name for s in controller.measurements]
    sizes = _sizes(model.plant, controller)
    stages = tuple(stage_of(name, stage, names, sizes) for name, stage in loops.items())
    found = machine_report(model, controller)
    return replace(found, stages=(*stages, *found.stages), current_loops=current_loops)


def machine_report(model: LinearModel, controller: Controller) -> LoopReport:
    """The report of the machine's loop alone, without the stages before it: what a page shows at each move."""
    whole = loop_of_model(model, controller)
    sizes = _sizes(model.plant, controller)
    stage = stage_of("machine", whole.sampled, [s.name for s in controller.measurements], sizes)
    empty = np.zeros(0, dtype=complex)
    regulator, observer = (empty, empty) if controller.cost is None else controller_poles(controller)
    poles = Poles(
        open_loop=sorted_poles(eigenvalues(model.A)),
        regulator=continuous_poles(regulator, controller.sample_time),
        filter=continuous_poles(observer, controller.sample_time),
        closed_loop=whole.poles,
    )
    bandwidths = bandwidths_of(model, controller, whole.sampled, stable=stage.stable)
    return LoopReport(
        model, controller, poles, (stage,), bandwidths, extent=extent_of(model.plant, controller=controller)
    )


def stage_of(name: str, stage: SampledLoop, sensors: list[str], sizes: FloatArray | None = None) -> StagePeak:
    """The peak sensitivities and the spectral radius of a loop; the peaks of an unstable one are NaN.

    sizes : in which the largest singular value has the readings, see `reading_sizes`
    """
    radius = stage.spectral_radius
    if radius >= 1:
        return StagePeak(name, dict.fromkeys([*sensors, "sigma_max"], np.nan), np.nan, radius)

    cut = stage.cut
    peaks = {name: peak_gain(cut.sensitivity(i)).value for i, name in enumerate(sensors)}
    largest = peak_of_channels(in_sizes(cut, sizes), cut.sensors)
    return StagePeak(name, peaks | {"sigma_max": largest.value}, largest.frequency, radius)


def bandwidths_of(
    model: LinearModel, controller: Controller, machine: SampledLoop, *, stable: bool
) -> dict[str, float]:
    """The bandwidths of the machine's loop by the definitions of BANDWIDTHS, rad/s; NaN where it is unstable."""
    natural = _natural_frequencies(commanded_model(model, controller), controller)
    if not stable:
        return {key: np.nan for key in BANDWIDTHS if not key.startswith("w_n")} | natural
    cut = in_sizes(machine.cut, _sizes(model.plant, controller))
    lowest, highest = tracked_band(cut, min(len(machine.Cd), len(controller.forces)))
    crossover = last_crossover(cut)
    return {"sigma_max_T": highest, "sigma_min_T": lowest, "crossover_max": crossover} | natural


def _natural_frequencies(model: LinearModel, controller: Controller) -> dict[str, float]:
    """Natural frequencies of q'' = (k - G K1) q, rad/s; none unless the controller feeds back states (q, q')."""
    n = model.plant.coordinates
    if not n or controller.tracks == "errors":
        return {}
    K = controller.K[:, :n]
    if controller.lagging:
        K = gain_at_rest(controller.K, len(controller.A), controller.lagging + controller.stored)
    closed = model.force_map @ K - model.stiffness
    w_n = np.sqrt(np.maximum(eigenvalues(closed).real, 0))
    return {"w_n_max": float(w_n.max()), "w_n_min": float(w_n.min())}


# The margin at each stage of a design, from full state feedback to the machine's own loop.
#
#     LQR -> LQI -> LQG -> LQGI -> with current loops -> sampled -> machine
#
# From `sampled` on the gains are the gain file's own, with hold and delay. Current loops are first-order lags, as
# papers have them, up to `sampled`. The machine has the PI controllers of the gain file on its windings
# (windings.py), as simulations fly it by default; a machine without windings ends at `sampled`. A PID has the stages
# from `sampled` on. A design without weights on integrals has no LQI and no LQGI.
#
# The first five stages are continuous; they are synthesized from the cost and the noise in the gain file. Each stage
# has its parametric margin (robust.py) and its peak sensitivity: at the forces for state feedback, where an LQR
# guarantees at most 1, at the sensors for output feedback, as ISO 14839-3 measures it. The parametric margins of all
# stages are of the design model at a position, without the loads, which v0(z) cancels. The peak sensitivity of the
# last stage, and the disk margins, delay margins and the gang of four, are of the machine's loop under its loads
# against v0(z), as in verify.py: a cogging that is stiffer than the axial loop shows there.


SAMPLED_STAGE = "sampled"  # with first-order lags
MACHINE_STAGE = "machine"  # with PI controllers on the windings: the last stage of a machine that has some


def compensators(
    plant: Plant, controller: Controller, current_loops: CurrentLoops = LAST_STAGE
) -> dict[str, tuple[Compensator, bool]]:
    """The control laws of the stages by name, each with whether it feeds back the states.

    plant : the machine, whose delay and current loops the last stages have

    State feedback reads [y, x]; the other laws read y.
    """
    own = {SAMPLED_STAGE: (machine_law(plant, controller, "lag"), False)}
    if chosen_loops(plant, controller, current_loops) == "pi":
        own[MACHINE_STAGE] = machine_law(plant, controller), False
    if controller.cost is None:
        return own
    believed, weights = plant_of(controller.parameters), weights_of(controller)
    model = linearize(believed, believed.point(controller.operating_point[0]))
    A, B, C = model.A, model.B, model.C
    K, L = lqr(model, weights, solver="scipy"), kalman(model, weights, solver="scipy")
    n, p, m = len(A), len(C), B.shape[1]
    half = believed.coordinates
    summed = integrals_of(model, weights).outputs
    to_modes = np.linalg.inv(C[:, :half]) if len(summed) == p == half else np.eye(p)
    back = np.linalg.inv(to_modes)
    stages: dict[str, tuple[Compensator, bool]] = {
        "LQR": (
            Compensator(
                np.zeros((0, 0)), np.zeros((0, p + n)), np.zeros((m, 0)), np.hstack([np.zeros((m, p)), -K])
            ),
            True,
        )
    }
    K_i, Ki = lqi(model, weights, solver="scipy")
    Ki, k = (Ki @ back)[:, summed], len(summed)
    e = -to_modes[summed]  # e' = -y, in the coordinates of the modes
    if summed:
        read = np.hstack([e, np.zeros((k, n))])
        D = np.hstack([np.zeros((m, p)), -K_i])
        stages["LQI"] = Compensator(np.zeros((k, k)), read, Ki, D, integrals=k), True
    stages["LQG"] = Compensator(A - B @ K - L @ C, L, -K, np.zeros((m, p))), False
    last = stages["LQG"][0]
    if summed:
        observer = system_matrix(A - B @ K_i - L @ C, B @ Ki)
        last = Compensator(observer, np.vstack([L, e]), np.hstack([-K_i, Ki]), np.zeros((m, p)), integrals=k)
        stages["LQGI"] = last, False
    if np.isfinite(plant.actuator.crossover):
        stages["+ current loops"] = replace(last, lag=plant.actuator.crossover), False
    return stages | own


@dataclass(frozen=True, eq=False)
class _Question:
    """The arguments of `staged_report`, and results that its parts share."""

    loop: LoopAlong  # in uncertain parameters, and the mass for its margin: one model answers all questions
    uncertainty: Ranges
    time: float | None
    proof: bool
    report: Callable[[], None]  # called after each part

    @property
    def plant(self) -> Plant:
        return self.loop.plant

    @property
    def controller(self) -> Controller:
        return self.loop.controller

    @cached_property
    def whole(self) -> bool:
        """Whether one proof covers the travel."""
        return self.loop.covers_travel

    @cached_property
    def _place_margins(self) -> dict[float, Margin]:
        return {}

    @cached_property
    def _travel_margins(self) -> dict[tuple[object, bool], Margin]:
        return {}

    def margin_at(self, position: float) -> Margin:
        """The margin at a position along the course; computed once if the loop does not depend on the position."""
        with without_limit():
            z, known = position if self.loop.depends_on_course else 0.0, self._place_margins
        if z not in known:
            travel = self._travel_margins.get((tuple(self.uncertainty.items()), False))
            known[z] = place_margin(
                self.plant,
                self.controller,
                self.uncertainty,
                z,
                self.loop.current_loops,
                self.loop.names,
                travel,
            )
        return known[z]

    def margin_over(self, ranges: Ranges, *, brief: bool = False, progress: Progress | None = None) -> Margin:
        """The margin anywhere in the extent; computed once for equal ranges: +1 kg may be the range of the mass.

        brief : whether it may take the work of one place
        """
        known, key = self._travel_margins, (tuple(ranges.items()), brief)
        if key not in known:
            budget = Budget(time=self.time, patient=False if brief else None)
            with count_work(PLACE_WORK if brief else math.inf):
                known[key] = travel_margin(
                    self.plant, self.controller, ranges, self.loop.current_loops, self.loop.names,
                    budget=budget, progress=progress,
                )  # fmt: skip
        self.report()
        return known[key]


@on_one_thread
def staged_report(
    found: LoopReport,
    uncertainty: Ranges,
    *,
    progress: Callable[[float], None] | None = None,
    bounds: Progress | None = None,
    time: float | None = None,
    proof: bool = True,
) -> LoopReport:
    """Add what `malta verify` shows beside the linear figures: parametric margins with proof, and the classical ones.

    The margin over the travel is the largest t for which all parameters may deviate by t times their range at once.

    found : the linear figures, whose `current_loops` is that of the last stage
    uncertainty : relative half range of each parameter, as {"m": 0.2} for +-20 %; margins are multiples of it
    progress : called with the share of the work that is done, 0 to 1
    bounds : called with the lower and upper bound of the margin over the travel so far
    time : s, longest search of the margin over the travel; None: 120
    proof : False: without parametric margins, in a fraction of the time

    Raises InputError for unknown parameters or none.
    """
    if not uncertainty:
        raise InputError("verify", "uncertainty", "no parameters", 'some, as {"m": 0.2}')
    steps, total = itertools.count(1), 9 + 2 * len(uncertainty) + len(PLACES)

    def report() -> None:
        if progress is not None:
            progress(min(1.0, next(steps) / total))

    plant, names = found.plant, tuple(uncertainty)
    names += tuple({"m"} & set(units_of(plant.parameters)) - set(names))
    loop = LoopAlong(plant, found.controller, names, found.current_loops)
    question = _Question(loop, uncertainty, time, proof, report)
    travel = question.margin_over(uncertainty, progress=bounds) if proof else None
    if travel is not None and travel.reason == NOT_WRITTEN_TEXT:  # nor is there time for the other margins
        return replace(found, uncertainty=dict[str, Any](uncertainty), robust=travel)
    links = _links(question)
    tolerance, mass = _tolerances(question) if proof else ({}, None)
    places, worst = _places(question)
    sensors = [s.name for s in plant.outputs]
    return replace(
        found,
        uncertainty=dict[str, Any](uncertainty),
        robust=travel,
        extent=loop.whole_extent,
        chain=links,
        disks=worst.disks if worst else (),
        delay=worst.delay if worst else dict.fromkeys(sensors, float("nan")),
        gang=worst.gang if worst else {},
        tolerance=tolerance,
        mass=mass,
        places=places,
        notes=(*found.notes, *([] if travel is None else _idle_notes(travel))),
    )


def _idle_notes(travel: Margin) -> list[str]:
    """Which parameters of the box the margin says nothing of."""
    return [f"the loop does not depend on {name}: the margin says nothing of it" for name in travel.idle]


def _links(q: _Question) -> tuple[ChainStage, ...]:
    """The stages of the chain, each with its margin and its peak sensitivity."""
    at = position_at(q.plant, q.plant.point(q.controller.operating_point[0]).x)
    believed = plant_of(q.controller.parameters)
    links = []
    stages = compensators(q.plant, q.controller, q.loop.current_loops)
    last = [*stages][-1]
    for name, (law, states) in stages.items():
        own = name in (SAMPLED_STAGE, MACHINE_STAGE)
        if own:
            stage = q if name == last else replace(q, loop=replace(q.loop, current_loops="lag"))
            position = own_position(q.plant, q.loop.whole_extent, at, q.controller)
            with without_limit():
                loop = stage.loop.under_load(position)
            margin = stage.margin_at(position) if q.proof else NOT_PROVEN
        else:
            with without_limit():
                system = of_plant(
                    q.plant, list(q.uncertainty), states=states, at=at, believed=believed, loaded=False
                )
                loop = nominal_loop(system, law)
            margin = robust_margin(system, law, q.uncertainty, time=q.time) if q.proof else NOT_PROVEN
        where: Literal["forces", "sensors"] = "forces" if states else "sensors"
        links.append(ChainStage(name, margin, peak_sensitivity(loop, where), where, loaded=own))
        q.report()
    return tuple(links)


NOT_VARIED = replace(NOT_PROVEN, reason="its interval ends at the nominal value")


def _tolerances(q: _Question) -> tuple[dict[str, tuple[Margin, Margin]], Margin | None]:
    """How far each parameter alone may go, down and up; and the mass margin of a machine with a mass m, kg."""
    over, tolerance = partial(q.margin_over, brief=not q.whole), {}
    for name, share in q.uncertainty.items():
        nominal = getattr(q.plant.parameters, name)
        low, high = (
            share if isinstance(share, tuple | list) else (nominal * (1 - share), nominal * (1 + share))
        )
        sides = ((low, nominal), (nominal, high))
        down, up = (over({name: side}) if side[0] < side[1] else NOT_VARIED for side in sides)
        tolerance[name] = down, up
    if "m" not in units_of(q.plant.parameters):
        return tolerance, None
    m: float = getattr(q.plant.parameters, "m")  # noqa: B009  a machine's own field
    return tolerance, over({"m": (m, m + 1.0)})


def _places(q: _Question) -> tuple[tuple[TravelPlace, ...], Classical | None]:
    """The places along the course, and the worst of their classical margins; None where one of them is unstable."""
    sensors, units = [s.name for s in q.plant.outputs], [s.unit for s in q.plant.inputs]
    places: list[TravelPlace] = []
    classical: list[Classical | None] = []
    for positions in q.loop.places:
        proven_at = positions if q.whole else positions[:1]  # else a place takes as long as the whole travel
        margin = smallest_margin([q.margin_at(z) for z in proven_at]) if q.proof else NOT_PROVEN
        with without_limit():
            loops = [q.loop.under_load(z) for z in positions]
        peak = float(np.max([peak_sensitivity(loop, "sensors") for loop in loops]))
        sides = [classical_margins(loop, sensors, units) if loop.stable else None for loop in loops]
        classical += sides
        worst = worst_of(sides)
        disk, delay = (worst.disks[2].size, min(worst.delay.values())) if worst else (np.nan, np.nan)
        places.append(TravelPlace(positions[0], margin, peak, disk, delay))
        q.report()
    return tuple(places), worst_of(classical)


def nominal_loop(system: UncertainSystem, law: Compensator) -> Nominal:
    """A loop at its nominal parameters."""
    stable = bool(instability(system, law, system.nominal)[0] < 0)
    return Nominal(*open_systems(system, law, system.nominal), stable, law.sample_time)
