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
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Protocol
from weakref import WeakKeyDictionary

import numpy as np
from flint import arb, fmpq, fmpq_mat
from scipy import linalg

from malta.arguments import by_name, describe, is_pair, positive
from malta.budget import GROWTH, WORK, Budget, in_rounds
from malta.errors import InputError
from malta.interrupts import watch_interrupts
from malta.linear.branches import branch_cases
from malta.linear.compensators import compensator_of
from malta.linear.expressions import MatrixProgram, NotAnalytic, exact, program
from malta.linear.rational import Ratio, Symbolic, product
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.processes import on_one_thread
from malta.proof.box import NO_ONE_REST, Box, box_of, within_branches
from malta.proof.branch_cases import margin_by_cases
from malta.proof.groups import A, B, C, E, UncertainLoop, loop_of
from malta.proof.loss import first_loss, loss_beside
from malta.proof.margin import IDLE_TEXT, NOT_BEGUN, NOT_PROVEN, Margin, Progress, Ranges
from malta.proof.problem import OfLoop, OfSeveral, Problem, is_nominal_stable
from malta.proof.question import Question, Standing
from malta.proof.search import search
from malta.work import MORE_WORK, answer_in_time, is_past

# A loop in the coordinates in which its parameters act apart: x = S x', exactly, found from how the parameters enter.
#
#     S_1 E S x'' = S_1 A S x' + S_1 B u,    y = C S x',      S_1 = (E_0 S)^-1,  E_0: E at the nominal values
#
# Each product of parameters has a matrix of coefficients in [E A B], whose range is where it acts: a mass on the
# motions of the centre of gravity, whatever the coordinates. The ranges, and what A makes of them, are the basis S.
# All numbers are rationals, so that the loop is the same and only entries that cancel are gone.


MAX_LAURENT_STATES = 16  # states
ROUNDING = 1e-11  # relative size of what rounding may leave of terms that cancel
MIN_SINGULAR = 1e-6  # singular value of independent vectors of size one, at least
MAX_TERM_SHARE = 0.8  # share of the terms from which on another basis is worth it
_KNOWN_PROGRAMS: WeakKeyDictionary[MatrixProgram, MatrixProgram | None] = WeakKeyDictionary()


def in_plain_basis(loop: UncertainLoop) -> UncertainLoop:
    """The loop in the basis in which its matrices have clearly fewer terms; the loop itself when none is found."""
    if loop.direct or not 1 < loop.states <= MAX_LAURENT_STATES:
        return loop
    s = loop.symbolic
    if s is None or s.atoms:
        return loop
    if loop.program not in _KNOWN_PROGRAMS:  # laws change, the system stays
        try:
            _KNOWN_PROGRAMS[loop.program] = _transform(loop, s)
        except (ZeroDivisionError, NotAnalytic, np.linalg.LinAlgError):
            _KNOWN_PROGRAMS[loop.program] = None
    found = _KNOWN_PROGRAMS[loop.program]
    return loop if found is None else UncertainLoop(loop.system, loop.law, found)


def _transform(loop: UncertainLoop, s: Symbolic) -> MatrixProgram | None:
    n, E_0 = loop.states, _identity(loop.states)
    nominal = [exact(x) for x in loop.system.nominal.tolist()]
    if loop.descriptor:
        E_0 = _matrix(n, n, {at: _value(r, nominal) for at, r in s.entries[E].items()})
    S = _basis(loop, s, E_0.inv())
    if S is None:
        return None
    right, left = (
        {(i, j): s.constant(M[i, j]) for i in range(n) for j in range(n) if M[i, j] != 0}
        for M in (S, (E_0 * S).inv())
    )
    made = [
        product(left, product(s.entries[A], right)),
        product(left, s.entries[B]),
        product(s.entries[C], right),
    ]
    if loop.descriptor:
        made += [{}, product(left, product(s.entries[E], right))]
    if _terms(made, nominal) > MAX_TERM_SHARE * _terms(s.entries, nominal):
        return None
    return _program(made, loop.program)


def _identity(n: int) -> Any:
    return fmpq_mat([[fmpq(int(i == j)) for j in range(n)] for i in range(n)])


def _matrix(rows: int, columns: int, entries: dict[tuple[int, int], Any]) -> Any:
    return fmpq_mat(
        rows, columns, [entries.get((i, j), fmpq(0)) for i in range(rows) for j in range(columns)]
    )


def _laurent(
    entries: dict[tuple[int, int], Ratio],
) -> dict[tuple[int, ...], dict[tuple[int, int], Any]] | None:
    """The coefficients of each product of powers of p; None where a sum stands below."""
    found: dict[tuple[int, ...], dict[tuple[int, int], Any]] = {}
    for at, r in entries.items():
        below, unit = (None, fmpq(1)) if r.den is None else next(iter(r.den.to_dict().items()))
        if r.den is not None and len(r.den) > 1:
            return None
        for powers, c in r.num.to_dict().items():
            own = tuple(int(e) for e in powers)
            if below is not None:
                own = tuple(e - int(d) for e, d in zip(own, below, strict=True))
            found.setdefault(own, {})[at] = c / unit
    return found


def _basis(loop: UncertainLoop, s: Symbolic, left: Any) -> Any:
    """The columns of S: the ranges, smallest first, and what A makes of them; None for sums below."""
    n, m = loop.states, loop.program.shapes[B][1]
    wide: dict[tuple[int, ...], list[Any]] = {}
    constant = None
    for which, columns in ((A, n), (B, m), *([(E, n)] if loop.descriptor else [])):
        parts = _laurent(s.entries[which])
        if parts is None:
            return None
        for powers, entries in parts.items():
            M = left * _matrix(n, columns, entries)
            if any(powers):
                wide.setdefault(powers, []).append(M)
            elif which == A:
                constant = M
    ranges = sorted((_range(parts, n) for parts in wide.values()), key=len)
    columns_of_S: list[list[Any]] = []
    for one in ranges:
        _extend(columns_of_S, one)
    for x in columns_of_S:  # grows while it is walked
        if constant is not None:
            _extend(columns_of_S, [(constant * fmpq_mat(n, 1, x)).entries()])
    _extend(columns_of_S, _identity(n).tolist())
    return fmpq_mat(columns_of_S).transpose()


def _range(parts: list[Any], n: int) -> list[list[Any]]:
    """A basis of what the columns of matrices span, in echelon form, without directions of the size of rounding."""
    columns = [[M[i, j] for i in range(n)] for M in parts for j in range(M.ncols())]
    sizes = [max(abs(c) for c in x) for x in columns]
    top = max(sizes)
    values = np.array([[float(arb(c / top)) for c in x] for x in columns])
    _, s, V = np.linalg.svd(values)
    rank = int((s > ROUNDING * s[0]).sum())
    reduced, exact_rank = fmpq_mat(columns).rref()
    if rank == int(exact_rank):
        return [list(row) for row in reduced.tolist()[:rank]]
    _, _, pivots = linalg.qr(V[:rank], pivoting=True)
    echelon = np.linalg.solve(V[:rank][:, np.sort(pivots[:rank])], V[:rank])
    echelon[np.abs(echelon) < ROUNDING] = 0
    return [[exact(x) for x in row] for row in echelon.tolist()]


def _extend(vectors: list[list[Any]], more: list[list[Any]]) -> None:
    """Append those of `more` that the vectors do not span, of size one."""
    for x in more:
        size = max(abs(c) for c in x)
        if not size:
            continue
        unit = [c / size for c in x]
        values = np.array([[float(arb(c)) for c in y] for y in (*vectors, unit)])
        if np.linalg.svd(values, compute_uv=False)[-1] > MIN_SINGULAR and len(values) <= values.shape[1]:
            vectors.append(unit)


def _value(r: Ratio, p: list[Any]) -> Any:
    return r.num(*p) / (1 if r.den is None else r.den(*p))


def _terms(matrices: Any, p: list[Any]) -> int:
    """The number of terms above rounding: of the largest of their row at the nominal values."""
    count = 0
    for entries in matrices:
        sizes: dict[int, list[float]] = {}
        for (i, _), r in entries.items():
            below = 1 if r.den is None else r.den(*p)
            terms = [c * math.prod(x**int(e) for x, e in zip(p, powers, strict=True)) / below
                     for powers, c in r.num.to_dict().items()]  # fmt: skip
            sizes.setdefault(i, []).extend(abs(float(arb(x))) for x in terms)
            sizes[i] += [math.inf] * (0 if r.den is None else len(r.den))
        for row in sizes.values():
            top = max((x for x in row if math.isfinite(x)), default=0.0)
            count += sum(x > ROUNDING * top for x in row)
    return count


def _program(matrices: list[dict[tuple[int, int], Ratio]], old: MatrixProgram) -> MatrixProgram:
    """The instructions of matrices of rational functions."""
    steps: list[tuple[str, int, tuple[int, ...], Any]] = [("input", i, (), 0.0) for i in range(old.inputs)]

    def step(name: str, *on: int, value: Any = 0.0) -> int:
        steps.append((name, 0, on, value))
        return len(steps) - 1

    def polynomial(f: Any) -> int:
        total = None
        for powers, c in f.to_dict().items():
            term = step("const", value=c)
            for i, e in enumerate(powers):
                if e:
                    power = i if e == 1 else step("constpow", i, value=float(e))
                    term = step("mul", term, power)
            total = term if total is None else step("add", total, term)
        assert total is not None
        return total

    entries = []
    for matrix in matrices:
        made = []
        for (i, j), r in sorted(matrix.items(), key=lambda pair: pair[0]):
            top = polynomial(r.num)
            made.append((i, j, top if r.den is None else step("div", top, polynomial(r.den))))
        entries.append(tuple(made))
    return MatrixProgram(tuple(steps), tuple(entries), old.shapes, old.inputs)


TOLERANCE = 9e-4  # relative distance between the proven bound and the witness
UNSTABLE_TEXT = "the nominal loop is unstable"
PLACES = 64  # nominal places of a box whose poles are computed at once


class ParametricLoop(Protocol):
    """What gives itself as a system and a law in parameters by name, as the loop of a machine does."""

    def uncertain(self, names: Sequence[str]) -> tuple[UncertainSystem, Compensator]: ...


@on_one_thread
@answer_in_time(NOT_BEGUN)
def robust_margin(
    system: UncertainSystem | ParametricLoop,
    compensator: Compensator | Any = None,
    ranges: Ranges | None = None,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float | None = None,
    time: float | None = None,
    budget: Budget | None = None,
    progress: Progress | None = None,
) -> Margin:
    """Prove how far the parameters may deviate together, in multiples of their ranges, before the loop is unstable.

        robust_margin(loop, ranges)        a machine's loop, from `malta.loop`
        robust_margin(system, F, ranges)   matrices

    With t the range (low, high) of a parameter grows to nominal - t (nominal - low) .. nominal + t (high - nominal).
    The proof encloses the characteristic polynomial on cells of frequency and parameters, and excludes zero on each.

    system : the uncertain system, from `malta.uncertain`; or a Loop, which brings its law
    compensator : u = F y (positive feedback): a Compensator, a control.StateSpace, or a gain matrix; none with a Loop
    ranges : by name; 0.2 is +-20 % of the nominal value, (low, high) an interval in SI
    over : intervals that do not grow with t, in SI: the bound holds anywhere in them (`z` over the travel)
    tolerance : relative distance between the proven bound and the witness; None: 9e-4, and less where that is cheap
    time : s, longest search, which then returns the bounds found so far; None: the clock ends none
    budget : what the search may take; None: 120 units of work, each about a second of one core
    progress : called with the lower and upper bound so far

    Work is counted and not timed: without `time` the answer is the same on every computer, however busy it is.

    Returns a Margin: proven lower bound, and a witness at the upper one.

    Raises InputError for names that the system does not have, ranges that are not valid, and shapes that do not fit;
    Interrupted, with the bounds found so far, on Ctrl-C.

    >>> import malta
    >>> def cart(m, k):
    ...     return [[0, 1], [-k / m, -0.2 / m]], [[0], [1 / m]], [[1, 0]]
    >>> spring = malta.uncertain(cart, {"m": 1, "k": 4})
    >>> push = [[2.0]]  # F = +2 N/m, away from rest: stable while k > 2
    >>> found = malta.robust_margin(spring, push, {"m": 0.2, "k": 0.1})
    >>> f"{found.lower:.2f} {found.upper:.2f} {found.witness['k']:.2f}"
    '5.00 5.00 2.00'
    """
    effort = ProofEffort(tolerance, time, budget, progress)
    over = by_name("robust_margin", "over", {} if over is None else over, '{"k": (1, 2)}')
    named, law, ranges = _either_form(system, compensator, ranges, over)
    box = box_of(named.names, named.nominal, named.limits, ranges, named.spread(over))
    problem, whole = problem_of(named, law), box
    box = within_branches(whole, named, partial(_loss_by_poles, problem))
    cases = branch_cases(named.matrices) if program(named.matrices).foreign else []
    if cases:
        lost = _lost_by_poles(problem, box, "")
        found = margin_by_cases(named, cases, box, lost, partial(_margin_of_case, law, effort))
        found = _name_idle(found, problem, box)
    else:
        found = margin_of(problem, box, effort)
    if box.ends == NO_ONE_REST and math.isinf(found.upper):
        lost = _lost_by_poles(problem, whole, "")
        if math.isfinite(lost.upper):
            found = replace(
                found, upper=lost.upper, frequency=lost.frequency, witness=lost.witness, searched="",
                reason=found.reason or NO_ONE_REST,
            )  # fmt: skip
    if found.reason == UNSTABLE_TEXT and _is_of_the_other_sign(named, law):
        found = replace(found, reason=f"{UNSTABLE_TEXT}, and stable with -F: u = F y is positive feedback")
    return replace(found, reason=named.reason(found.reason))


def _is_of_the_other_sign(system: UncertainSystem, law: Compensator) -> bool:
    """Whether -F makes the nominal loop stable, as with the K of control.lqr, which is of u = -K x."""
    turned = replace(law, C=-law.C, D=-law.D)
    return bool(problem_of(system, turned).instability(system.nominal[None])[0] < 0)


def _either_form(
    system: UncertainSystem | ParametricLoop, compensator: Any, ranges: Ranges | None, over: Mapping[str, Any]
) -> tuple[UncertainSystem, Compensator, Ranges]:
    """System, law and ranges of robust_margin(system, compensator, ranges) or of robust_margin(loop, ranges)."""
    if isinstance(system, UncertainSystem):
        if ranges is None:
            raise InputError("robust_margin", "ranges", "None", "values by name, as {'k': 0.2}")
        return system, law_of(system, compensator), ranges
    if not hasattr(system, "uncertain"):
        raise InputError("robust_margin", "system", describe(system), "a malta.uncertain system, or a Loop")
    if ranges is not None or not isinstance(compensator, Mapping):
        found = "more than a Loop and ranges" if ranges is not None else describe(compensator)
        raise InputError("robust_margin", "ranges", found, "robust_margin(loop, ranges), as {'m': 0.2}")
    named, law = system.uncertain((*compensator, *over))
    return named, law, compensator


@on_one_thread
@answer_in_time(NOT_BEGUN)
def common_margin(
    places: Sequence[tuple[UncertainSystem, Compensator | Any]],
    ranges: Ranges,
    over: Mapping[str, tuple[float, float]] | None = None,
    *,
    tolerance: float | None = None,
    budget: Budget | None = None,
    progress: Progress | None = None,
) -> Margin:
    """The margin within which several loops in the same parameters all stay stable, as one machine at several places.

    places : pairs of a system and its compensator, with equal names, nominal values, limits and sample times

    The other arguments are those of robust_margin. The witness is the nearest one of all loops.

    Raises InputError for loops that differ in parameters or sample times.
    """
    effort = ProofEffort(tolerance, None, budget, progress, "margin")
    loops = [(system, law_of(system, law, "margin")) for system, law in _pairs(places)]
    first, law = loops[0]
    for system, other in loops[1:]:
        same = system.names == first.names and np.array_equal(system.nominal, first.nominal)
        if not (same and other.sample_time == law.sample_time and system.sample_time == first.sample_time):
            raise InputError("margin", "places", "loops of different parameters or clocks", "alike ones")
    outside = {} if over is None else over
    box = box_of(first.names, first.nominal, first.limits, ranges, outside, caller="margin")
    for system, law in loops:
        box = within_branches(box, system, partial(_loss_by_poles, problem_of(system, law)))
    return margin_of(OfSeveral(tuple(problem_of(*loop) for loop in loops)), box, effort)


def _pairs(places: Any) -> list[tuple[UncertainSystem, Any]]:
    """The loops as a list of pairs. Raises InputError for anything else."""
    found = list(places) if isinstance(places, Iterable) and not isinstance(places, str) else []
    if not found or not all(is_pair(place) for place in found):
        wanted = "pairs of a system and its compensator, at least one"
        raise InputError("margin", "places", describe(places), wanted)
    return [(system, law) for system, law in found]


@on_one_thread
@answer_in_time(NOT_BEGUN)
def margin_at(
    system: UncertainSystem,
    compensator: Compensator,
    ranges: Ranges,
    at: Mapping[str, float],
    *,
    tolerance: float | None = None,
    wider: Margin | None = None,
) -> Margin:
    """The margin with some parameters fixed at the values `at` in place of the nominal ones.

    wider : the margin of the same ranges over intervals that hold these values: what it proves is proven here too, and
        a loss as near in the direction of its witness ends the search
    """
    nominal = system.nominal.copy()
    for name, value in at.items():
        nominal[system.names.index(name)] = value
    problem = problem_of(system, compensator)
    box = box_of(system.names, nominal, system.limits, ranges, {})
    box = within_branches(box, system, partial(_loss_by_poles, problem))
    if wider is not None and wider.lower and wider.witness is not None:
        reach = wider.lower * (1 + (tolerance or TOLERANCE))
        witness = np.array([at[name] if name in at else wider.witness[name] for name in box.names])
        t, frequency, p = loss_beside(problem, box, witness, wider.lower, min(reach, box.limit))
        if p is not None and t >= wider.lower:
            named = dict(zip(box.names, p.tolist(), strict=True))
            moved = dict(zip(box.names, (p - box.nominal).tolist(), strict=True))
            reason = system.reason("")
            return Margin(wider.lower, t, frequency, named, moved, wider.sensitivity, (), 0.0, reason)
    found = margin_of(problem, box, ProofEffort(tolerance))
    return replace(found, reason=system.reason(found.reason))


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
    return OfLoop(in_plain_basis(loop_of(system, law)))


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while a margin is searched.

    margin : what is known by then, a Margin with its reason

    >>> import malta
    >>> motor = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})
    >>> known = malta.robust_margin(motor, [[0.5]], {"k": 0.1})  # lost at k = 2
    >>> f"{malta.proof.Interrupted(known).margin.lower:.2f}"
    '10.00'
    """

    def __init__(self, margin: Margin) -> None:
        super().__init__(margin)
        self.margin = margin

    def __str__(self) -> str:
        return f"interrupted: {self.margin}"


@dataclass(frozen=True)
class ProofEffort:
    """The tolerance of a search and what it may take. Raises InputError for an invalid tolerance or time."""

    tolerance: float | None = None
    time: float | None = None
    budget: Budget | None = None
    progress: Progress | None = None
    caller: str = "robust_margin"

    def __post_init__(self) -> None:
        if self.tolerance is not None:
            positive(self.caller, "tolerance", self.tolerance, below=1)
        if self.time is not None:
            positive(self.caller, "time", self.time, endless=True)

    def of(self, count: int) -> ProofEffort:
        """The effort of each of some searches that share it, without progress."""
        budget = self.limits
        if budget.work is None and budget.time is None:
            budget = replace(budget, work=WORK, patient=bool(budget.patient))
        work, time = (None if x is None else x / count for x in (budget.work, budget.time))
        return replace(self, time=time, budget=replace(budget, work=work), progress=None)

    @property
    def limits(self) -> Budget:
        """The budget with the time."""
        budget = self.budget or Budget()
        return budget if self.time is None else replace(budget, time=self.time)


def margin_of(problem: Problem, box: Box, effort: ProofEffort) -> Margin:
    """The margin of a problem over a box; zero when the nominal loop is unstable. Raises Interrupted on Ctrl-C."""
    begun, standing = clock.monotonic(), Standing(effort.progress)
    if not box.most > 0:
        return Margin(None, math.inf, None, None, {}, {}, (), 0.0, box.ends, box.searched)
    ask = partial(_ask, problem, box, effort, standing)

    def rank(found: Margin) -> float:
        return math.inf if found.reason == problem.traits.approximate else rank_of(found)

    try:
        with watch_interrupts():
            found, ended = in_rounds(effort.limits, ask, rank)
    except KeyboardInterrupt as stop:
        raise Interrupted(_interrupted_margin(problem, box, standing, clock.monotonic() - begun)) from stop
    found = _name_idle(found, problem, box)
    if found.reason.startswith(IDLE_TEXT):
        return found
    is_open = bool(found.reason) and found.reason not in (UNSTABLE_TEXT, problem.traits.approximate)
    reason = ended.explain(found.reason) if is_open else found.reason
    return replace(found, seconds=clock.monotonic() - begun, work=ended.work, reason=reason)


def _name_idle(found: Margin, problem: Problem, box: Box) -> Margin:
    """The margin with the parameters that do not act; nothing is proven where none does."""
    idle = _idle(problem, box)
    if found.lower and idle and len(idle) == int((box.down + box.up > 0).sum()):
        reason = f"{IDLE_TEXT} {' '.join(idle)}"
        return replace(found, lower=None, upper=math.inf, certificate=(), reason=reason)
    return replace(found, idle=idle)


def _idle(problem: Problem, box: Box) -> tuple[str, ...]:
    """The parameters of a box that grow and on which neither matrices nor conditions of the loops depend."""
    loops = [loop for loop in problem.loops if loop is not None]
    if len(loops) < len(problem.loops) or not loops:
        return ()
    models = [loop.program for loop in loops]
    models += [program(loop.system.positive) for loop in loops if loop.system.positive is not None]
    acting = frozenset[int]().union(*(own for model in models for own in model.depends))
    grows = box.down + box.up > 0
    return tuple(name for k, name in enumerate(box.names) if grows[k] and k not in acting)


def rank_of(found: Margin) -> float:
    """The proven bound, infinite where nothing is open."""
    return found.lower or 0.0 if found.reason and found.reason != UNSTABLE_TEXT else math.inf


def _ask(
    problem: Problem, box: Box, effort: ProofEffort, standing: Standing, work: float, patient: bool
) -> Margin:
    """The margin that is found with some work."""
    places = box.nominal_places()
    for k in range(0, len(places), PLACES):
        if is_past(work, problem.traits.poles * min(PLACES, len(places))):
            break
        unstable = problem.instability(places[k : k + PLACES]) >= 0
        if unstable.any():
            where = dict(zip(box.names, places[k + int(unstable.argmax())].tolist(), strict=True))
            return Margin(0.0, 0.0, None, where, {}, {}, (), 0.0, UNSTABLE_TEXT)
    if why := problem.traits.approximate:
        return _lost_by_poles(problem, box, why)
    tolerance, fixed = effort.tolerance or TOLERANCE, effort.tolerance is not None
    question = Question(problem, box, tolerance, fixed, work, effort.limits.cells, patient, standing)
    with np.errstate(all="ignore"):  # a cell with infinite bounds excludes nothing
        return search(question)


def _loss_by_poles(problem: Problem, box: Box) -> float:
    """The first loss along the diagonals of a box; else infinity."""
    return first_loss(problem, box, box.limit)[0]


def _lost_by_poles(problem: Problem, box: Box, why: str) -> Margin:
    """A margin of which nothing is proven, with the first loss along the diagonals of the box."""
    upper, frequency, witness = first_loss(problem, box, box.limit)
    named = None if witness is None else dict(zip(box.names, witness.tolist(), strict=True))
    return Margin(None, upper, frequency, named, {}, {}, (), 0.0, why)


def _margin_of_case(
    law: Compensator, effort: ProofEffort, case: UncertainSystem, box: Box, count: int
) -> Margin:
    """The margin of one case of branches. Raises Interrupted, with nothing that is known of the loop, on Ctrl-C."""
    try:
        return margin_of(problem_of(case, law), box, effort.of(count))
    except Interrupted as stop:
        raise Interrupted(replace(NOT_PROVEN, reason=stop.margin.reason)) from stop


def _interrupted_margin(problem: Problem, box: Box, standing: Standing, seconds: float) -> Margin:
    """What is known of a margin whose search was interrupted."""
    lower = standing.lower if standing.lower > 0 and is_nominal_stable(problem, box) else None
    done = standing.work
    reason = f"interrupted after {done:.3g} units of work{standing.where(problem)}; {GROWTH * done:.3g} {MORE_WORK}"
    return Margin(lower, standing.upper, None, None, {}, {}, (), seconds, reason, "", done)
