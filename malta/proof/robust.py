"""Robust stability against real parameters: how far all of them may deviate before the loop can become unstable.

    margin = the largest t for which every p with  nominal - t (nominal - low) <= p <= nominal + t (high - nominal)
             is stable; 1: the whole modelled box; 3: three times it ("300 %"), as MATLAB's robstab counts.

A stable loop becomes unstable only where its characteristic polynomial a(jw; p) = 0 for some w, infinity included.
`upper` belongs to a p at which it does, confirmed by the poles of the loop. `lower` is proven: the nominal loop is
stable by Routh's scheme, and a(jw; p) is not zero anywhere on the box at any frequency. Structure is read from the
expressions, coefficients are exact rationals or balls before they are rounded, and the enclosure contains the errors of
rounding, of interpolation and of neglected couplings.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.proof.arguments import (
    by_name,
    describe,
    interval,
    is_pair,
    number,
    positive,
)
from malta.proof.basis import in_plain_basis
from malta.proof.box import Box, box_of
from malta.proof.branches import within_branches
from malta.proof.expressions import program
from malta.proof.groups import loop_of
from malta.proof.loss import first_loss, loss_beside
from malta.proof.margin import Margin, Progress, Ranges
from malta.proof.problem import (
    OfCoefficients,
    OfLoop,
    OfPolynomial,
    OfSeveral,
    Problem,
    approximation,
)
from malta.proof.search import Job
from malta.proof.systems import compensator_of, polynomial_system
from malta.proof.uncertain import Compensator, UncertainSystem
from malta.threads import on_one_thread

if TYPE_CHECKING:
    pass

TOLERANCE = 9e-4  # relative distance between the proven bound and the witness
MOST_CELLS = 300_000
LONGEST = 120.0  # s, default time of a search
PLACES = 64  # nominal places of a box whose poles are computed at once


@on_one_thread
def robust_margin(
    system: UncertainSystem,
    compensator: Compensator | Any,
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float | None = None,
    time: float | None = None,
    most_cells: int = MOST_CELLS,
    progress: Progress | None = None,
) -> Margin:
    """Prove how far the parameters may deviate together, in multiples of their ranges, before the loop is unstable.

    With t the range (low, high) of a parameter grows to nominal - t (nominal - low) .. nominal + t (high - nominal).
    The proof encloses the characteristic polynomial on cells of frequency and parameters, and excludes zero on each.

    system : the uncertain system, from `malta.uncertain`
    compensator : u = F y (positive feedback): a Compensator, a control.StateSpace, or a gain matrix
    ranges : by name; 0.2 is +-20 % of the nominal value, (low, high) an interval in SI
    over : intervals that do not grow with t, in SI: the bound holds anywhere in them (`z` over the travel)
    tolerance : relative distance between the proven bound and the witness; None: 9e-4, and less where that is cheap
    time : s, longest search, which then returns the bounds found so far; None: 120
    most_cells : number of cells after which the proof is given up
    progress : called with the lower and upper bound so far

    Returns a Margin: proven lower bound, and a witness at the upper one.

    Raises InputError for names that the system does not have, ranges that are not valid, and shapes that do not fit.

    >>> import malta
    >>> def cart(m, k):
    ...     return [[0, 1], [-k / m, -0.2 / m]], [[0], [1 / m]], [[1, 0]]
    >>> spring = malta.uncertain(cart, {"m": 1, "k": 4})
    >>> push = [[2.0]]  # F = +2 N/m, away from rest: stable while k > 2
    >>> found = malta.robust_margin(spring, push, {"m": 0.2, "k": 0.1})
    >>> f"{found.lower:.2f} {found.upper:.2f} {found.witness['k']:.2f}"
    '5.00 5.00 2.00'
    """
    effort = Effort(tolerance, time, most_cells, progress)
    law = law_of(system, compensator)
    box = box_of(system.names, system.nominal, system.limits, ranges, {} if over is None else over)
    return margin_of(problem_of(system, law), within_branches(box, system.positive), effort)


@on_one_thread
def common_margin(
    places: Sequence[tuple[UncertainSystem, Compensator | Any]],
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float | None = None,
    time: float | None = None,
    progress: Progress | None = None,
) -> Margin:
    """The margin within which several loops in the same parameters all stay stable, as one machine at several places.

    places : pairs of a system and its compensator, with equal names, nominal values, limits and sample times

    The other arguments are those of robust_margin. The witness is the nearest one of all loops.

    Raises InputError for loops that differ in parameters or sample times.
    """
    effort = Effort(tolerance, time, MOST_CELLS, progress, "margin")
    loops = [(system, law_of(system, law, "margin")) for system, law in _pairs(places)]
    first, law = loops[0]
    for system, other in loops[1:]:
        same = system.names == first.names and np.array_equal(system.nominal, first.nominal)
        if not (same and other.sample_time == law.sample_time and system.sample_time == first.sample_time):
            raise InputError("margin", "places", "loops of different parameters or clocks", "alike ones")
    outside = {} if over is None else over
    box = box_of(first.names, first.nominal, first.limits, ranges, outside, caller="margin")
    for system, _ in loops:
        box = within_branches(box, system.positive)
    return margin_of(OfSeveral(tuple(problem_of(*loop) for loop in loops)), box, effort)


def _pairs(places: Any) -> list[tuple[UncertainSystem, Any]]:
    """The loops as a list of pairs. Raises InputError for anything else."""
    found = list(places) if isinstance(places, Iterable) and not isinstance(places, str) else []
    if not found or not all(is_pair(place) for place in found):
        wanted = "pairs of a system and its compensator, at least one"
        raise InputError("margin", "places", describe(places), wanted)
    return [(system, law) for system, law in found]


@on_one_thread
def margin_at(
    system: UncertainSystem,
    compensator: Compensator,
    ranges: Ranges,
    at: Mapping[str, float],
    *,
    tolerance: float | None = None,
    time: float | None = None,
    wider: Margin | None = None,
) -> Margin:
    """The margin with some parameters fixed at the values `at` in place of the nominal ones.

    wider : the margin of the same ranges over intervals that hold these values: what it proves is proven here too, and
        a loss as near in the direction of its witness ends the search
    """
    nominal = system.nominal.copy()
    for name, value in at.items():
        nominal[system.names.index(name)] = value
    box = within_branches(box_of(system.names, nominal, system.limits, ranges, {}), system.positive)
    problem = problem_of(system, compensator)
    if wider is not None and wider.lower and wider.witness is not None:
        begun, reach = clock.monotonic(), wider.lower * (1 + (tolerance or TOLERANCE))
        witness = np.array([at.get(name, wider.witness[name]) for name in box.names])
        t, frequency, p = loss_beside(problem, box, witness, wider.lower, min(reach, box.limit))
        if p is not None and t >= wider.lower:
            named = dict(zip(box.names, p.tolist(), strict=True))
            moved = dict(zip(box.names, (p - box.nominal).tolist(), strict=True))
            spent = clock.monotonic() - begun
            return Margin(wider.lower, t, frequency, named, moved, wider.sensitivity, (), spent)
    return margin_of(problem, box, Effort(tolerance, time))


def law_of(system: UncertainSystem, compensator: Any, caller: str = "robust_margin") -> Compensator:
    """A compensator as a record, with the system's sample time. Raises InputError for invalid systems and laws."""
    if not isinstance(system, UncertainSystem):
        raise InputError(caller, "system", describe(system), "a malta.uncertain system")
    f = system.matrices
    law = compensator_of(compensator, f.size1_out(2), f.size2_out(1)) if f.n_out() >= 3 else compensator
    if system.sample_time is not None and law.sample_time is None and not len(law.A):
        return Compensator(law.A, law.B, law.C, law.D, sample_time=system.sample_time)
    return law


@lru_cache(maxsize=32)  # several margins need the same loops; records compare by identity
def problem_of(system: UncertainSystem, law: Compensator) -> OfLoop:
    """The closed loop as a problem, which remembers its polynomials."""
    return OfLoop(in_plain_basis(loop_of(system, law)), system.names)


@on_one_thread
def margin_of_polynomial(
    coefficients: Any,
    box: Ranges,
    nominal: Mapping[str, float] | None = None,
    *,
    over: Mapping[str, tuple[float, float]] | None = None,
    discrete: bool = False,
    tolerance: float | None = None,
    time: float | None = None,
    progress: Progress | None = None,
) -> Margin:
    """Prove the margin of a characteristic polynomial whose coefficients depend on parameters.

    coefficients : a function of the parameters by name (or of one array p), or a casadi.Function: the coefficients,
        highest power first
    box : intervals (low, high) by name, or shares of the nominal value
    nominal : values by name; the middle of the interval for a parameter without one
    over : intervals that do not grow with t, in SI
    discrete : whether stable roots lie in the unit disc, in place of the left half plane
    tolerance : relative distance between the proven bound and the witness; None: 9e-4, and less where that is cheap
    time : s, longest search, which then returns the bounds found so far; None: 120
    progress : called with the lower and upper bound so far

    Returns a Margin.

    Raises InputError as `malta.robust_margin` does.

    >>> import malta
    >>> def cubic(k):  # stable while k < 8
    ...     return [1, 3, 3, 1 + k]
    >>> found = malta.margin_of_polynomial(cubic, {"k": (1, 2)}, {"k": 1})
    >>> f"{found.lower:.2f}, {found.upper:.2f}"
    '7.00, 7.00'
    """
    caller = "margin_of_polynomial"
    effort = Effort(tolerance, time, MOST_CELLS, progress, caller)
    outside = by_name(caller, "over", {} if over is None else over, '{"k": (1, 2)}')
    values = _middles({**by_name(caller, "box", box, '{"k": (1, 2)}'), **outside}, nominal)
    names = tuple(values)
    function, _ = polynomial_system(coefficients, names)
    problem = OfPolynomial(OfCoefficients(program(function), names, discrete))
    where = box_of(names, np.array(list(values.values())), (), box, outside, caller=caller)
    return margin_of(problem, where, effort)


def _middles(ranges: Mapping[str, Any], nominal: Any) -> dict[str, float]:
    """The nominal values of a polynomial's parameters: as given, else the middle of the interval."""
    caller = "margin_of_polynomial"
    given = by_name(caller, "nominal", {} if nominal is None else nominal, '{"k": 1.5}')
    for name in given:
        if name not in ranges:
            raise InputError(caller, name, "a nominal value without a range", "a range in box")
    if not ranges:
        raise InputError(caller, "box", "no parameters", "at least one uncertain parameter")
    values = {}
    for name, value in ranges.items():
        if name in given:
            values[name] = number(caller, name, given[name])
        elif is_pair(value):
            low, high = interval(caller, name, value)
            values[name] = low / 2 + high / 2
        else:
            raise InputError(caller, name, "a share without a nominal value", "nominal={...}")
    return values


@dataclass(frozen=True)
class Effort:
    """The limits of a search. Raises InputError for an invalid tolerance or time."""

    tolerance: float | None = None
    time: float | None = None
    most_cells: int = MOST_CELLS
    progress: Progress | None = None
    caller: str = "robust_margin"

    def __post_init__(self) -> None:
        if self.tolerance is not None:
            positive(self.caller, "tolerance", self.tolerance, below=1)
        if self.time is not None:
            positive(self.caller, "time", self.time, endless=True)


def deadline(begun: float, time: float | None) -> float:
    """The end of a search that began at `begun` and may take `time` seconds; None: LONGEST."""
    return begun + (LONGEST if time is None else time)


def margin_of(problem: Problem, box: Box, effort: Effort) -> Margin:
    """The margin of a problem over a box; zero when the nominal loop is unstable."""
    begun = clock.monotonic()
    until = deadline(begun, effort.time)
    if not box.most > 0:
        return Margin(None, math.inf, None, None, {}, {}, (), 0.0, box.ends, box.searched)
    places = box.nominal_places()
    for k in range(0, len(places), PLACES):
        if clock.monotonic() > until:
            break
        unstable = problem.instability(places[k : k + PLACES]) >= 0
        if unstable.any():
            where = dict(zip(box.names, places[k + int(unstable.argmax())].tolist(), strict=True))
            spent = clock.monotonic() - begun
            return Margin(0.0, 0.0, None, where, {}, {}, (), spent, "the nominal loop is unstable")
    if why := approximation(problem):
        upper, frequency, witness = first_loss(problem, box, box.limit)
        found = None if witness is None else dict(zip(box.names, witness.tolist(), strict=True))
        return Margin(None, upper, frequency, found, {}, {}, (), clock.monotonic() - begun, why)
    job = Job(
        problem,
        box,
        effort.tolerance or TOLERANCE,
        effort.tolerance is not None,
        until,
        effort.most_cells,
        effort.progress,
    )
    with np.errstate(all="ignore"):  # a cell with infinite bounds excludes nothing
        return job.margin(begun)
