"""Robust stability against real parameters: how far they may all deviate before the loop can become unstable.

    margin = the largest t for which every p with  nominal - t (nominal - low) <= p <= nominal + t (high - nominal)
             is stable; 1: the whole modelled box; 3: three times it ("300 %"), as MATLAB's robstab counts.

A stable loop becomes unstable only where its characteristic polynomial a(jw; p) = 0 for some w, infinity included.
`upper` is a p at which it does, checked by the poles of the loop. `lower` is proven: the nominal loop is stable by
Routh's scheme, and zero is excluded from a(jw; p) over the whole box and all frequencies. Structure is read from the
expressions, coefficients are exact rationals or balls before they are rounded, and what rounding, interpolation and
neglected couplings can do is part of the enclosure.
"""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from malta.errors import InputError
from malta.margins.box import Box, box_of
from malta.margins.expressions import program
from malta.margins.loop import loop_of
from malta.margins.problem import OfCoefficients, OfLoop, OfPolynomial, OfSeveral, Problem
from malta.margins.systems import compensator_of, polynomial_system
from malta.uncertain import Compensator, UncertainSystem

if TYPE_CHECKING:
    from malta.plant import FloatArray

TOLERANCE = 9e-4  # how close the proven bound comes to the witness, relative
MOST_CELLS = 300_000
LONGEST = 120.0  # s, unless a time is asked for: an answer comes anyway

Ranges = Mapping[str, "float | tuple[float, float]"]
Progress = Callable[[float, float], None]  # called with lower and upper so far


@dataclass(frozen=True, eq=False)
class Certificate:
    """What proves the lower bound for one group of states on one part of the box: zero is excluded on each cell."""

    cells: int  # that were looked at
    frequencies: tuple[float, float]  # rad/s, covered without a gap
    intervals: FloatArray  # of each cell: branch (0: of x, 1: of 1 / x), from, to; s = j x 2^scale
    boxes: FloatArray  # of each cell: of the parameters, as shares of the part of the box
    directions: FloatArray  # angle of c, rad: Re(conj(c) f) > 0 on the cell
    sides: FloatArray  # the part of the box: parameters x 2
    inverted: tuple[bool, ...]  # parameters whose shares are of 1 / p
    scale: int


@dataclass(frozen=True, eq=False)
class Margin:
    """A robust stability margin in multiples of the modelled box.

    lower: proven; None where nothing is, `reason` says why. upper: reached by `witness`; infinite where no parameter
    of the range that exists destabilizes.
    """

    lower: float | None
    upper: float
    frequency: float | None  # rad/s, at which the witness loses stability
    witness: Mapping[str, float] | None  # SI
    moved: Mapping[str, float]  # the witness less the nominal values
    sensitivity: Mapping[str, float]  # share of each parameter in the margin; they add up to 1
    certificate: tuple[Certificate, ...] = field(repr=False)
    seconds: float
    reason: str = ""

    @property
    def exhausted(self) -> bool:
        """Stable as far as the parameters exist (a mass above zero)."""
        return math.isinf(self.upper)

    def __str__(self) -> str:
        low = "nothing proven" if self.lower is None else f"proven {100 * self.lower:.2f} %"
        if self.exhausted:
            return f"{low}: stable as far as was looked, or as the parameters exist"
        where = "" if self.frequency is None else f" at {self.frequency:.4g} rad/s"
        return f"{low}, lost at {100 * self.upper:.2f} %{where}"


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
    """How far the parameters may deviate together, in multiples of their modelled range, before the loop is unstable.

    Parameters
    ----------
    compensator : u = F y (positive feedback): a Compensator, a control.StateSpace, or a gain matrix
    ranges : by name; 0.2 is +-20 % of the nominal value, (low, high) an interval in SI. With t the lower side is
        nominal - t (nominal - low), the upper one nominal + t (high - nominal): linear on each side.
    over : intervals that do not grow with t, in SI: the bound holds anywhere in them (`z` over the travel)
    tolerance : how close the proven bound shall come to the witness, relative; None: 9e-4,
        and closer where that costs little
    time : s, after which the bounds found so far are returned; None: 120
    most_cells : where the proof is given up
    progress : called with the bounds so far

    Raises InputError for names that the system does not have, ranges that are none, and shapes that do not fit.

    >>> import malta
    >>> def cart(m, k):
    ...     return [[0, 1], [-k / m, -0.2 / m]], [[0], [1 / m]], [[1, 0]]
    >>> spring = malta.uncertain(cart, {"m": 1, "k": 4})
    >>> found = malta.robust_margin(spring, [[-1.0]], {"m": 0.2, "k": 0.1})
    >>> found.lower <= found.upper
    True
    """
    box = box_of(system.names, system.nominal, system.limits, ranges, over or {})
    problem = problem_of(system, law_of(system, compensator))
    return margin_of(problem, box, Effort(tolerance, time, most_cells, progress))


def common_margin(
    places: Sequence[tuple[UncertainSystem, Compensator]],
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float | None = None,
    time: float | None = None,
    progress: Progress | None = None,
) -> Margin:
    """The margin of several loops in the same parameters, as of one machine at several places: all stay stable.

    places: systems with the same names, nominal values and limits, and their compensators, on the same sample time.
    Further as robust_margin, whose witness is the first one of all the loops.

    Raises InputError for loops that differ in these.
    """
    first, law = places[0]
    for system, other in places[1:]:
        same = system.names == first.names and np.array_equal(system.nominal, first.nominal)
        if not (same and other.sample_time == law.sample_time and system.sample_time == first.sample_time):
            raise InputError(
                "common_margin", "places", "loops of different parameters or clocks", "alike ones"
            )
    box = box_of(first.names, first.nominal, first.limits, ranges, over or {})
    problems = tuple(problem_of(system, law_of(system, other)) for system, other in places)
    return margin_of(OfSeveral(problems), box, Effort(tolerance, time, MOST_CELLS, progress))


def margin_at(
    system: UncertainSystem,
    compensator: Compensator,
    ranges: Ranges,
    at: Mapping[str, float],
    within: Mapping[str, tuple[float, float]],
    *,
    tolerance: float | None = None,
    time: float | None = None,
) -> Margin:
    """robust_margin where parameters stand at other values than the nominal ones, each within an interval.

    The coefficients are enclosed over these intervals, once for all margins in them.
    """
    nominal = system.nominal.copy()
    for name, value in at.items():
        nominal[system.names.index(name)] = value
    frame = {system.names.index(name): interval for name, interval in within.items()}
    box = replace(box_of(system.names, nominal, system.limits, ranges, {}), frame=frame)
    return margin_of(problem_of(system, compensator), box, Effort(tolerance, time))


def law_of(system: UncertainSystem, compensator: Any) -> Compensator:
    """A compensator as a record, on the system's clock. Raises InputError."""
    f = system.matrices
    law = compensator_of(compensator, f.size1_out(2), f.size2_out(1)) if f.n_out() >= 3 else compensator
    if system.sample_time is not None and law.sample_time is None and not len(law.A):
        return Compensator(law.A, law.B, law.C, law.D, sample_time=system.sample_time)
    return law


@lru_cache(maxsize=32)  # several questions are asked of the same loops; records compare by identity
def problem_of(system: UncertainSystem, law: Compensator) -> OfLoop:
    """The closed loop, with what is known of it so far."""
    return OfLoop(loop_of(system, law), system.names)


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
    """The margin of a characteristic polynomial whose coefficients depend on parameters.

    Parameters
    ----------
    coefficients : a function of the parameters by name (or of one array p), or a casadi.Function: the coefficients,
        highest power first
    box : intervals (low, high) by name, or shares of the nominal value
    nominal : values by name; the middle of the interval where none is given
    discrete : whether the roots shall be in the unit disc, in place of the left half plane

    Raises InputError as robust_margin does.

    >>> import malta
    >>> malta.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k], {"k": (1, 2)}, {"k": 1}).upper.__round__(6)
    7.0
    """
    everything = {**box, **(over or {})}
    values = {}
    for name, value in everything.items():
        if nominal is not None and name in nominal:
            values[name] = float(nominal[name])
        elif isinstance(value, tuple) and len(value) == 2:
            values[name] = (value[0] + value[1]) / 2
        else:
            raise InputError("margin_of_polynomial", name, "a share without a nominal value", "nominal={...}")
    for name in nominal or {}:
        if name not in everything:
            raise InputError(
                "margin_of_polynomial", name, "a nominal value without a range", "a range in box"
            )
    names = tuple(values)
    function, _ = polynomial_system(coefficients, names)
    problem = OfPolynomial(OfCoefficients(program(function), names, discrete))
    where = box_of(names, np.array(list(values.values())), (), box, over or {})
    return margin_of(problem, where, Effort(tolerance, time, MOST_CELLS, progress))


@dataclass(frozen=True)
class Effort:
    """How far to go."""

    tolerance: float | None = None
    time: float | None = None
    most_cells: int = MOST_CELLS
    progress: Progress | None = None


def margin_of(problem: Problem, box: Box, effort: Effort) -> Margin:
    """The margin of a problem over a box."""
    from malta.margins.search import Job

    begun = clock.monotonic()
    for name, value in (("tolerance", effort.tolerance), ("time", effort.time)):
        if value is not None and not value > 0:
            raise InputError("robust_margin", name, f"{value}", "a number above zero")
    unstable = problem.instability(box.standing()) >= 0
    if unstable.any():
        where = dict(zip(box.names, box.standing()[unstable.argmax()].tolist(), strict=True))
        spent = clock.monotonic() - begun
        return Margin(0.0, 0.0, None, where, {}, {}, (), spent, "the nominal loop is unstable")
    until = begun + (LONGEST if effort.time is None else effort.time)
    job = Job(
        problem,
        box,
        effort.tolerance or TOLERANCE,
        effort.tolerance is not None,
        until,
        effort.most_cells,
        effort.progress,
    )
    with np.errstate(all="ignore"):  # what is not finite excludes nothing
        return job.margin(begun)
