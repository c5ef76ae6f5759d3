"""Margins of the machine's loop over its travel, and at places along it.

The course of a machine is its stroke, or the first parameter of `plant.over`, as the speed of a rotor. The position
along it is one more interval of the proof when the model along the course is short enough. When it is not, either each
axis is proven alone and the coupling of the axes is bounded (malta.proof.weak_coupling), or a few places stand for it.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.budget import Budget, in_rounds
from malta.linear.closed_loops import instability
from malta.linear.expressions import NotAnalytic
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.classical import Nominal
from malta.loops.parametric_loops import machine_system
from malta.loops.parametric_plants import MAX_MODEL_OPERATIONS, model_of
from malta.loops.sampled_laws import machine_law
from malta.loops.sampled_loops import loaded_loop
from malta.loops.windings import LAST_STAGE, CurrentLoops
from malta.margins.scheduled_loops import loops_between_places
from malta.model.currents import is_commutated
from malta.model.parameters import units_of
from malta.model.places import off_stroke, outputs_at, position_at
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.proof.box import Box, box_of, within_branches
from malta.proof.loss import narrow_loss
from malta.proof.margin import NOT_BEGUN, NOT_WRITTEN, NOT_WRITTEN_TEXT, Margin, Progress, Ranges
from malta.proof.problem import OfSeveral
from malta.proof.robust import (
    TOLERANCE,
    ProofEffort,
    common_margin,
    margin_at,
    margin_of,
    problem_of,
    rank_of,
    robust_margin,
)
from malta.proof.weak_coupling import HeldLoop
from malta.proof.weak_coupling.held_currents import held_machine
from malta.synthesis.law import point_at
from malta.work import WorkUp, answer_in_time, count_work

if TYPE_CHECKING:
    from collections.abc import Sequence

    from malta.arrays import FloatArray
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller


# The intervals that one proof covers beside the uncertainty: the travel of the machine, and some parameters.


Interval = tuple[float, float]


@dataclass(frozen=True)
class Extent:
    """The intervals that every proof covers (SI), and the course, along which the places of the machine lie.

    Example: `str(extent_of(rotor))` is "for all Omega in 0 .. 2094 rad/s" where `rotor.over` is {"Omega": (0, 2094)}.
    """

    stroke: str = ""  # a state; "": the machine has no travel
    travel: float = 0.0  # of the stroke, either way, m
    over: Mapping[str, Interval] = field(default_factory=dict)  # intervals of parameters, SI
    units: Mapping[str, str] = field(default_factory=dict)  # SI units of these parameters

    @property
    def intervals(self) -> dict[str, Interval]:
        """All intervals by name."""
        along = {self.stroke: (-self.travel, self.travel)} if self.stroke else {}
        return along | dict(self.over)

    @property
    def course(self) -> str:
        """The name of the course: the stroke, else the first of the parameters; "" without either."""
        return self.stroke or next(iter(self.over), "")

    @property
    def unit(self) -> str:
        """The SI unit of the course."""
        return "m" if self.stroke else self.units.get(self.course, "1")

    @property
    def values(self) -> str:
        """The intervals of parameters in words: "all Omega in 0 .. 2094 rad/s"; "" without any."""
        parts = (
            f"{name} in {low:.4g} .. {high:.4g} {self.units.get(name, '1')}".removesuffix(" 1")
            for name, (low, high) in self.over.items()
        )
        return "all " + ", ".join(parts) if self.over else ""

    def __str__(self) -> str:
        everywhere = ["over the travel"] if self.stroke else []
        return " and ".join([*everywhere, *([f"for {self.values}"] if self.over else [])])


NO_EXTENT = Extent()  # a machine without a travel and without intervals of parameters


def extent_of(plant: Plant, names: Iterable[str] = (), controller: Controller | None = None) -> Extent:
    """The extent of a plant's proofs, without the uncertain parameters `names`, whose ranges grow with the margin.

    controller : whose schedule is the course, from its first place to its last
    """
    uncertain = set(names)
    over = {name: interval for name, interval in plant.over.items() if name not in uncertain}
    units = units_of(plant.parameters)
    if controller is not None and (schedule := controller.schedule) is not None:
        units = {s.name: s.unit for s in plant.outputs} | units
        over = {schedule.variable: (float(schedule.places[0]), float(schedule.places[-1]))} | over
        return Extent(over=over, units={name: units[name] for name in over})
    stroke = plant.stroke.name if plant.has_stroke else ""
    return Extent(stroke, plant.stroke.travel, over, {name: units[name] for name in over})


@dataclass(frozen=True)
class LoopAlong:
    """A machine's loop along its course, in the parameters of one model; of equal ones all is computed once.

    names : of the uncertain parameters, which are no course
    """

    plant: Plant
    controller: Controller
    names: tuple[str, ...]
    current_loops: CurrentLoops = LAST_STAGE

    @property
    def extent(self) -> Extent:
        """The intervals beside the uncertainty, whatever the law."""
        return extent_of(self.plant, self.names)

    @property
    def whole_extent(self) -> Extent:
        """The intervals of the machine and of its law, whose schedule is the course."""
        return extent_of(self.plant, self.names, self.controller)

    @property
    def intervals(self) -> dict[str, Interval]:
        """The intervals of `extent`, and of the parameters that follow the position."""
        return self.loops[0][0].spread(self.extent.intervals)

    @property
    def loops(self) -> list[tuple[UncertainSystem, Compensator]]:
        """The loop with its position as a parameter; where that is too long, its loops at ENDS of the travel."""
        return _loops_along(self)

    def at(self, position: float) -> tuple[UncertainSystem, Compensator]:
        """The loop at a position along the course (SI); equal positions return the same records."""
        return _loop_at(self, position)

    def under_load(self, position: float) -> Nominal:
        """The loop under the machine's loads at a position along the course (SI), at nominal parameters."""
        there, at = self.machine_at(position)
        return loaded_loop(there, self.controller, at, self.current_loops)

    def machine_at(self, position: float) -> tuple[Plant, dict[str, float]]:
        """The plant at a position along the course (SI), and the states that are not zero there."""
        plant, controller = self.plant, self.controller
        x, course = plant.point(controller.operating_point[0]).x, self.whole_extent.course
        par: Any = plant.parameters
        there, at = plant, dict[str, float]()
        if controller.schedule is not None:
            at = position_at(plant, point_at(plant, x, course, position).x)
        elif plant.has_stroke:
            at = {plant.stroke.name: position}
        elif course:
            there = plant.variant(replace(par, **{course: position}))
        return there, at | off_stroke(plant, x)

    @property
    def covers_travel(self) -> bool:
        """Whether one proof covers the whole travel; of a schedule, one proof between any two of its places."""
        return self.controller.schedule is not None or len(self.loops) == 1

    @property
    def depends_on_course(self) -> bool:
        """Whether the loop depends on the position along its course."""
        if len(self.loops) > 1 or not self.extent.course:
            return len(self.loops) > 1
        system, law = self.loops[0]
        index = system.names.index(self.extent.course)
        return any(index in on for on in problem_of(system, law).loop.program.depends)

    @property
    def places(self) -> tuple[tuple[float, ...], ...]:
        """The places that a report shows: for each its position, or +position and -position (SI)."""
        if self.controller.schedule is not None:
            return tuple((z,) for z in self.controller.schedule.places.tolist())
        return positions_of(self.plant, self.extent, PLACES if self.covers_travel else ENDS)


def positions_of(plant: Plant, extent: Extent, shares: Iterable[float]) -> tuple[tuple[float, ...], ...]:
    """The places of a machine (SI): +- each share of its travel; else the ends and the own value of a parameter."""
    if extent.stroke:
        travel = plant.stroke.travel
        return tuple(tuple(dict.fromkeys((share * travel, -share * travel))) for share in shares)
    own = own_position(plant, extent, {})
    return tuple((value,) for value in sorted({own, *extent.over.get(extent.course, ())}))


def own_position(
    plant: Plant, extent: Extent, states: Mapping[str, float], controller: Controller | None = None
) -> float:
    """The position of the machine along its course (SI): the output of a schedule, the stroke, or the parameter."""
    if controller is not None and controller.schedule is not None:
        x = plant.point(controller.operating_point[0]).x
        return float(outputs_at(plant, x)[controller.schedule.output])
    if extent.stroke or not extent.course:
        return states.get(extent.stroke, 0.0)
    return float(getattr(plant.parameters, extent.course))


NOT_BETWEEN_TEXT = "not between them"  # what a margin of several places says
MAX_ENCLOSED_OPERATIONS = 5000  # operations of matrices that are not enclosed over an interval of positions
PLACES = (0.0, 1 / 3, 2 / 3, 1.0)  # shares of the travel, either way
PLACE_WORK = 6.0  # work, of the margin at a position for itself
ENDS = (0.0, 1.0)  # of those, where no interval is enclosed
AXES = 0.6  # of the work, for the proof of each axis alone


@on_one_thread
@answer_in_time(NOT_BEGUN)
def travel_margin(
    plant: Plant,
    controller: Controller,
    ranges: Ranges,
    current_loops: CurrentLoops = LAST_STAGE,
    names: Sequence[str] = (),
    *,
    time: float | None = None,
    budget: Budget | None = None,
    progress: Progress | None = None,
) -> Margin:
    """The margin of the machine's loop anywhere in its travel: the position is one more interval of the proof.

    The parameters of `plant.over` that are not uncertain are intervals too: a rotor is proven for every speed at once.
    Where the model along the travel is too long, as that of held currents in a planar motor, each axis is proven alone
    with a bound of its coupling to the others (malta.proof.weak_coupling). Where that fails too, the margin is the one
    in the middle and at the end of the travel, and its `reason` says so.

    ranges : by parameter: 0.2 is +-20 % of the nominal value, (low, high) an interval in SI
    names : parameters of the model, a superset of `ranges`; one model can then answer several questions
    time, budget : s, longest search, and its work, as of `malta.robust_margin`
    progress : called with the lower and upper bound so far

    Raises InputError for unknown parameters and empty ranges.

    Example: `travel_margin(plant, controller, {"m": 0.2}).lower`
    """
    loop = LoopAlong(plant, controller, tuple(names or ranges), current_loops)
    effort = ProofEffort(None, time, budget, progress, "travel_margin")
    along = _margin_along if controller.schedule is None else _scheduled_margin
    begun = clock.monotonic()
    found, ended = in_rounds(effort.limits, partial(along, loop, ranges, progress), rank_of)
    found = replace(found, seconds=clock.monotonic() - begun, work=ended.work)
    if controller.schedule is not None or found.reason == NOT_WRITTEN_TEXT:
        return found  # of other systems than the loop's own, or of none
    return replace(found, reason=loop.loops[0][0].reason(found.reason))


def _margin_along(
    loop: LoopAlong, ranges: Ranges, progress: Progress | None, work: float, patient: bool
) -> Margin:
    """The margin along the travel that is found with some work."""
    budget, plant, controller, problem = Budget(patient=patient), loop.plant, loop.controller, None
    try:
        along, over = travel_loops(plant, controller, loop.names, loop.current_loops)
        if plant.has_stroke and not over:  # places of the travel, and no other interval
            problem = margin_anywhere(loop)
    except WorkUp:
        return NOT_WRITTEN
    if problem is not None:
        with count_work(AXES * work):
            found = margin_of(
                problem, _box(along[0][0], ranges), ProofEffort(budget=budget, progress=progress)
            )
        if found.lower is not None:
            return found
    found = common_margin(along, ranges, over, budget=budget, progress=progress)
    if len(along) == 1:
        box = within_branches(_box(along[0][0], ranges, over), along[0][0])
        return at_a_place(*along[0], box, found)
    here = f"at {len(along)} places of the travel, {NOT_BETWEEN_TEXT}"
    return replace(found, reason=f"{here}; {found.reason}" if found.reason else here)


SCANNED = 129  # places of the travel at which a witness is looked for
JUST_BEYOND = 1e-3  # of its distance, at which a witness is unstable
RESOLUTION = 2.0**-24  # of the way to a loss at a position
REACHES = 24  # of boxes beyond a witness that no place has, up to the limit of the search
NOWHERE_TEXT = "what is unstable has values that no position has together"


def at_a_place(system: UncertainSystem, law: Compensator, box: Box, found: Margin) -> Margin:
    """The margin with a witness at a position, whose derived parameters are those that follow it.

    Where no position along its direction is unstable, the witness goes: what is proven stands.
    """
    derived = system.derived
    if derived is None or found.witness is None:
        return found
    own = [name for name in box.names if name not in derived.intervals]
    witness, index = np.array([found.witness[name] for name in box.names]), box.names.index(derived.of)
    places = np.repeat(witness[None], SCANNED, axis=0)
    first, end = box.over[index].tolist()
    places[:, index] = np.linspace(first, end, SCANNED)
    places[:, -len(derived.intervals) :] = [derived.values(z) for z in places[:, index].tolist()]

    def at(t: float, rows: FloatArray) -> FloatArray:
        return box.stretch(rows, t / found.upper) if found.upper else rows

    def rate(place: FloatArray, t: float) -> float:
        return float(instability(system, law, at(t, place))[0])

    last = max(box.limit, 2 * found.upper)
    for t in np.geomspace(found.upper * (1 + JUST_BEYOND), last, REACHES) if found.upper else [0.0]:
        values = instability(system, law, at(t, places))
        if t > box.limit or values.max() < 0:
            continue
        place, high = places[[int(values.argmax())]], float(t)
        if high > found.upper:
            width = RESOLUTION * (high - found.upper)
            high = narrow_loss(partial(rate, place), found.upper, high, width)
        (p,) = at(high, place)
        named = {name: x for name, x in zip(box.names, p.tolist(), strict=True) if name in own}
        moved = {name: x - c for (name, x), c in zip(named.items(), box.nominal.tolist(), strict=False)}
        shares = {name: x for name, x in found.sensitivity.items() if name in own}
        return replace(found, upper=high, witness=named, moved=moved, sensitivity=shares)
    reason = "; ".join(filter(None, (found.reason, NOWHERE_TEXT)))
    return replace(
        found, upper=math.inf, frequency=None, witness=None, moved={}, sensitivity={}, reason=reason,
        searched=box.searched,
    )  # fmt: skip


CELLS = 0.7  # of the work, for the proofs between the places of a schedule


def _scheduled_margin(
    loop: LoopAlong, ranges: Ranges, progress: Progress | None, work: float, patient: bool
) -> Margin:
    """The margin at every constant reference of a schedule; where that is not proven, at its places."""
    schedule, over, budget = loop.controller.schedule, dict(loop.extent.over), Budget(patient=patient)
    assert schedule is not None
    found, why = list[Margin](), ""
    try:
        cells = loops_between_places(loop.plant, loop.controller, (*ranges, *over), loop.current_loops)
    except WorkUp:
        cells = NOT_WRITTEN_TEXT
    with count_work(CELLS * work):
        for cell in [] if isinstance(cells, str) else cells:
            outside = over | {schedule.variable: cell.interval}
            found.append(
                robust_margin(cell.system, cell.law, ranges, outside, budget=budget, progress=progress)
            )
            if found[-1].lower is None:
                low, high = cell.interval
                why = f"between {low:g} and {high:g}: {found[-1].reason}"
                break
    if found and not why:
        return smallest_margin(found)
    margin = common_margin(loop.loops, ranges, over, budget=budget, progress=progress)
    here = f"at {len(loop.loops)} places of {schedule.variable}, {NOT_BETWEEN_TEXT}"
    return replace(margin, reason="; ".join(filter(None, (here, why or str(cells), margin.reason))))


def smallest_margin(margins: Sequence[Margin]) -> Margin:
    """One margin that holds at several places: the smallest lower and the smallest upper bound."""
    lower = None if any(m.lower is None for m in margins) else min(m.lower or 0.0 for m in margins)
    reason = "; ".join(dict.fromkeys(m.reason for m in margins if m.reason))
    return replace(min(margins, key=lambda m: m.upper), lower=lower, reason=reason)


def travel_loops(
    plant: Plant, controller: Controller, names: tuple[str, ...], current_loops: CurrentLoops = LAST_STAGE
) -> tuple[list[tuple[UncertainSystem, Compensator]], dict[str, tuple[float, float]]]:
    """The loops whose common margin travel_margin proves, and the intervals that do not grow with the margin.

    Of a schedule these are the loops at its places.
    """
    whole = LoopAlong(plant, controller, names, current_loops)
    return whole.loops, whole.intervals if len(whole.loops) == 1 else dict(whole.extent.over)


@lru_cache(maxsize=8)  # several margins need the same loops; records compare by identity
def _loops_along(loop: LoopAlong) -> list[tuple[UncertainSystem, Compensator]]:
    plant, controller, extent = loop.plant, loop.controller, loop.extent
    every = replace(loop, names=(*loop.names, *extent.over))
    if controller.schedule is not None:
        return [every.at(z) for z in controller.schedule.places.tolist()]
    if not (plant.has_stroke and _is_long(loop)):
        at = {plant.stroke.name: 0.0} if plant.has_stroke else {}
        at |= off_stroke(plant, plant.point(controller.operating_point[0]).x)
        names = [*loop.names, *extent.intervals]
        whole = machine_system(plant, controller, names, at, loop.current_loops)
        if not plant.has_stroke or whole[0].matrices.n_instructions() < MAX_ENCLOSED_OPERATIONS:
            return [whole]
    return [every.at(share * plant.stroke.travel) for share in ENDS]


def _is_long(loop: LoopAlong) -> bool:
    """Whether the model along the travel is too long for an expansion."""
    believed = plant_of(loop.controller.parameters)
    held = is_commutated(believed) and not believed.actuator.tabulated
    return held and model_of(loop.plant, believed, loop.names).n_instructions() > MAX_MODEL_OPERATIONS


@lru_cache(maxsize=8)
def margin_anywhere(loop: LoopAlong, position: float | None = None) -> HeldLoop | None:
    """The loop as weakly coupled axes, anywhere in the travel or at a position; None where it has not that form."""
    plant, controller = loop.plant, loop.controller
    law = machine_law(plant, controller, loop.current_loops)
    if not _is_long(loop) or law.delay != 1 or law.lag is not None:
        return None
    if plant.sensors.late:  # the axes have no states for readings
        return None
    if off_stroke(plant, plant.point(controller.operating_point[0]).x):
        return None
    along = loop.loops
    try:
        if position is None:
            travel = (-plant.stroke.travel, plant.stroke.travel)
            of = model_of(plant, plant_of(controller.parameters), tuple(loop.names))
            machine = held_machine(of, loop.names, along[0][0].nominal, travel)
        else:
            whole = margin_anywhere(loop)
            if whole is None:
                return None
            machine, along = whole.machine.at(position), [loop.at(position)]
    except NotAnalytic:
        return None
    places = OfSeveral(tuple(problem_of(*one) for one in along))
    return HeldLoop(machine, replace(law, delay=0), places)


def _box(system: UncertainSystem, ranges: Ranges, over: Mapping[str, Interval] | None = None) -> Box:
    return box_of(system.names, system.nominal, system.limits, ranges, over or {}, caller="travel_margin")


@on_one_thread
@answer_in_time(NOT_BEGUN)
def place_margin(
    plant: Plant,
    controller: Controller,
    ranges: Ranges,
    position: float,
    current_loops: CurrentLoops = LAST_STAGE,
    names: Sequence[str] = (),
    travel: Margin | None = None,
) -> Margin:
    """The margin of the machine's loop at a position along its course (`Extent.course`), SI.

    The other arguments are those of travel_margin; travel is its answer, where it is known. Without a proof along the
    travel the search takes PLACE_WORK at most.
    """
    whole = LoopAlong(plant, controller, tuple(names or ranges), current_loops)
    if not plant.has_stroke or controller.schedule is not None:
        return robust_margin(*whole.at(position), ranges)
    if len(whole.loops) == 1:
        derived = whole.loops[0][0].derived
        there = {plant.stroke.name: position} | (derived.at(position) if derived is not None else {})
        return margin_at(*whole.loops[0], ranges, there, tolerance=TOLERANCE, wider=travel)
    loop = whole.at(position)
    if (problem := margin_anywhere(whole, position)) is not None:
        with count_work(PLACE_WORK):
            found = margin_of(problem, _box(loop[0], ranges), ProofEffort())
        if found.lower is not None:
            return found
    with count_work(PLACE_WORK):
        return robust_margin(*loop, ranges)


@lru_cache(maxsize=32)
def _loop_at(loop: LoopAlong, position: float) -> tuple[UncertainSystem, Compensator]:
    there, at = loop.machine_at(position)
    return machine_system(there, loop.controller, loop.names, at, loop.current_loops)
