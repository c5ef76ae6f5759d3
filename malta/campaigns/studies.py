"""Which parameter costs yield: Sobol indices over the box of a campaign, by the design of Saltelli and others.

    first-order index   Var(E[Y | x_i]) / Var(Y)       what fixing x_i alone would take away of Y's variance
    total index         E[Var(Y | x_not i)] / Var(Y)   what is left when everything but x_i is fixed

Y is a figure of merit, or the yield: 1 for a run within the limit, 0 for one beyond it. The noise of the runs is a
factor like the parameters: its index says what part of the variance no tolerance of a machine can change.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import qmc, sobol_indices

from malta.arrays import FloatArray
from malta.campaigns.limits import Limit, findings_of
from malta.campaigns.plan import (
    Plan,
    draw_machines,
    machines_at,
    machines_in_box,
    machines_of,
    planned_run,
    varied_names,
    varying_columns,
)
from malta.campaigns.result import Rate, rate
from malta.campaigns.store import simulate_machines
from malta.display import Description, display
from malta.errors import InputError
from malta.model.parameters import differences
from malta.simulation.experiments import Progress, progress_of_part

NOISE = "noise"  # the name of its factor
MIN_POINTS = 16  # points of each of the two samples
RESAMPLES = 100
INTERVAL_DEVIATIONS = 1.96  # standard deviations of a 95 % interval, either way
DRAWS = 2**40  # of the noise, among which its factor chooses


class Index(NamedTuple):
    """The Sobol indices of one factor, with half the width of their 95 % intervals (bootstrap)."""

    first: float
    first_half: float
    total: float
    total_half: float


@display
@dataclass(frozen=True, eq=False)
class Sensitivity:
    """Sobol indices of a campaign's figures of merit and of its yield."""

    plan: Plan
    limit: Limit  # that ends the yield
    factors: tuple[str, ...]  # what varies, and NOISE
    runs: int  # simulated
    within: Rate  # of the independent runs: share within the limit
    of_yield: tuple[Index, ...]  # by factor; empty where all runs, or none, are within the limit
    of_merits: Mapping[str, tuple[Index, ...]]  # by label; empty where a run has no value, or all the same

    @property
    def description(self) -> Description:
        """The indices of the yield."""
        rows = [("within", str(self.within)), ("simulated", f"{self.runs} runs")]
        for factor, index in zip(self.factors, self.of_yield, strict=False):
            first, total = (
                f"{index.first:.3g} +- {index.first_half:.2g}",
                f"{index.total:.3g} +- {index.total_half:.2g}",
            )
            rows.append((factor, f"first-order {first}, total {total}"))
        return Description(f"Sensitivity of {self.plan.controller.name!r} {self.limit.kept}", tuple(rows))


def sensitivity(
    plan: Plan, limit: Limit, *, workers: int | None = None, progress: Progress | None = None
) -> Sensitivity:
    """Attribute the variance of a campaign's yield and figures to the parameters: Sobol indices by Saltelli's design.

        first-order index   Var(E[Y | x_i]) / Var(Y)
        total index         E[Var(Y | x_not i)] / Var(Y)

    The design takes n (factors + 2) runs, n the largest power of two with which they are at most plan.samples.
    plan.seed decides machines and noise; plan.sampler does not count. The estimators are those of
    `scipy.stats.sobol_indices`. Source: A. Saltelli et al., Computer Physics Communications 181 (2010) 259-270.

    plan : the plan of the runs
    limit : from `malta.campaigns.limit_of`; a run within it counts for the yield
    workers : threads; None: one for each core
    progress : called with the share of the runs that is done, 0 to 1

    Returns a Sensitivity: indices with 95 % intervals by factor, of the yield and of each figure of merit.

    Raises InputError for a box in which nothing varies, and for too few samples.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> box, options = {"m": 0.2, "C": 0.2}, {"duration": 0.02, "noise": 0.0}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=64, options=options
    ... )
    >>> found = malta.campaigns.sensitivity(
    ...     plan, malta.campaigns.limit_of(plan, "touchdown"), workers=1
    ... )
    >>> mass, constant = found.of_merits["deviation y"]
    >>> found.factors, constant.total > mass.total  # magnets matter more
    (('m', 'C'), True)
    """
    names = [varied_names(plan)[k] for k in varying_columns(plan)]
    if not names:
        raise InputError("campaign", "spread", "nothing that varies", "parameters that vary")
    noisy = planned_run(plan).scenario.noise > 0
    factors = (*names, *([NOISE] if noisy else []))
    size = 2 ** int(math.log2(max(plan.samples / (len(factors) + 2), 1)))
    if size < MIN_POINTS:
        expected = f"at least {MIN_POINTS * (len(factors) + 2)} for {len(factors)} factors"
        raise InputError("campaign", "samples", str(plan.samples), expected)
    points = sobol_points(len(factors), size, plan.seed)
    machines = machines_in_box(plan, points[:, : len(names)])
    draws = (points[:, -1] * DRAWS).astype(np.int64) if noisy else np.zeros(len(points), np.int64)
    batch = simulate_machines(plan, machines, noise=draws[:, None], workers=workers, progress=progress)
    within = limit.severity(batch) < 1

    independent = within[: 2 * size]  # the other points differ from the first sample in one factor
    return Sensitivity(
        plan,
        limit,
        factors,
        len(points),
        rate(int(independent.sum()), independent.size),
        indices_of(within.astype(float), size, plan.seed),
        {f.label: indices_of(f.values, size, plan.seed) for f in findings_of(plan, batch)},
    )


def sobol_points(factors: int, size: int, seed: int) -> FloatArray:
    """Saltelli's design in the unit box: samples A and B, then A with each column from B in turn."""
    both = qmc.Sobol(2 * factors, rng=np.random.default_rng(seed)).random(size)
    A, B = both[:, :factors], both[:, factors:]
    mixed = [np.where(np.arange(factors) == i, B, A) for i in range(factors)]
    return np.concatenate([A, B, *mixed])


def indices_of(values: FloatArray, size: int, seed: int) -> tuple[Index, ...]:
    """The indices of each factor, with half 95 % intervals by resampling; none where the values have no variance."""
    if not np.isfinite(values).all() or np.ptp(values) == 0:
        return ()
    rows = np.random.default_rng(seed + 1).integers(0, size, (RESAMPLES + 1, size))
    rows[0] = np.arange(size)
    A, B, *mixed = (values - values.mean()).reshape(-1, size)  # the estimators lose digits to a mean
    with np.errstate(all="ignore"):  # a resample without variance has no indices
        found = sobol_indices(
            func={"f_A": A[rows], "f_B": B[rows], "f_AB": np.array([one[rows] for one in mixed])}, n=size
        )
    first, total = (np.reshape(x, (RESAMPLES + 1, -1)) for x in (found.first_order, found.total_order))
    half = [INTERVAL_DEVIATIONS * np.nanstd(x[1:], axis=0, ddof=1) for x in (first, total)]
    return tuple(Index(*map(float, row)) for row in zip(first[0], half[0], total[0], half[1], strict=True))


def sensitivity_document(found: Sensitivity) -> dict[str, Any]:
    """Sobol indices as plain tables; null where there are none."""

    def table(indices: tuple[Index, ...]) -> dict[str, Any] | None:
        rows = zip(found.factors, indices, strict=True) if indices else ()
        return {name: index._asdict() for name, index in rows} or None

    return {
        "schema": "malta-sensitivity",
        "version": 1,
        "limit": found.limit.name,
        "factors": list(found.factors),
        "runs": found.runs,
        "within": found.within._asdict(),
        "yield": table(found.of_yield),
        "merits": {label: table(indices) for label, indices in found.of_merits.items()},
    }


# Tolerances: the largest spread of each parameter that keeps a wanted yield.
#
# The same points of the unit box and the same noise serve every spread (common random numbers), so that yields of two
# spreads differ by the spread alone. Nothing guarantees that a yield falls as a spread grows: SPREADS spreads up to
# the widest are tried, and the answer lies before the first that loses the yield; a wider one that keeps it is
# reported.


MAX_SPREAD_FACTOR = 16.0  # multiples of today's spread that are tried, at most
MAX_RELATIVE_SPREAD = 0.95  # relative spread, at most: parameters stay above 0
SPREADS = 6  # that are tried up to the widest
HALVINGS = 7  # of the bracket around the answer
CHUNK = 1024  # runs, after which a yield may be known to be lost


class Spread(NamedTuple):
    """The largest spread of one parameter, the others at their own, or of all together."""

    name: str  # of the parameter; ALL_PARAMETERS
    factor: float  # in multiples of today's spread; 0 where the yield is lost even without any
    within: Rate | None  # the yield at that spread; None where it is lost without any
    widest: float  # factor that was tried, at most
    monotone: bool  # no wider spread that was tried keeps the yield again


ALL_PARAMETERS = "all together"


@display
@dataclass(frozen=True, eq=False)
class Tolerances:
    """The largest spreads that keep a yield."""

    plan: Plan
    limit: Limit  # that ends the yield
    wanted: float  # yield to keep
    today: Rate  # the yield of the plan's own spreads
    spreads: tuple[Spread, ...]  # by parameter, then of all together

    @property
    def description(self) -> Description:
        """The factors on the spreads of today."""
        rows = [("today", str(self.today))]
        rows += [(s.name, f"{s.factor:.3g} times, {s.within or 'lost without any'}") for s in self.spreads]
        title = f"Tolerances of {self.plan.controller.name!r} for {100 * self.wanted:g} % {self.limit.kept}"
        return Description(title, tuple(rows))


def tolerances(
    plan: Plan, limit: Limit, wanted: float, *, workers: int | None = None, progress: Progress | None = None
) -> Tolerances:
    """Find the largest spread of each parameter of a plan, and the largest common factor, that keep a yield.

    All spreads share their points of the unit box and their noise (common random numbers). A spread with which a
    machine cannot exist counts as one that loses the yield.

    plan : the plan, whose spreads are today's
    limit : from `malta.campaigns.limit_of`
    wanted : share of the plan's machines within the limit, above 0 and up to 1
    workers : threads; None: one for each core
    progress : called with the share of the work that is done, 0 to 1

    Returns a Tolerances: the yield of today, and a factor on each spread with the yield that it keeps.

    Raises InputError for a yield out of range, and for a box in which nothing varies.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> box = {"m": 0.1}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=20, options=short
    ... )
    >>> limit = malta.campaigns.limit_of(plan, "deviation-y", 50e-6)
    >>> found = malta.campaigns.tolerances(plan, limit, 0.95, workers=1)
    >>> found.today.share, found.spreads[0].name, found.spreads[0].factor > 1
    (1.0, 'm', True)
    """
    if not 0 < wanted <= 1:
        raise InputError("campaign", "tolerance", f"{wanted:g}", "a yield above 0 and up to 1")
    names, columns = varied_names(plan), varying_columns(plan)
    if not columns:
        raise InputError("campaign", "spread", "nothing that varies", "parameters that vary")
    searches = {names[k]: [k] for k in columns} | ({ALL_PARAMETERS: columns} if len(columns) > 1 else {})
    today = _yield(plan, limit, np.ones(len(names)), 0.0, workers)
    assert today is not None
    found: list[Spread] = []
    for name, chosen in searches.items():

        def keeps(factor: float, chosen: list[int] = chosen) -> Rate | None:
            widths = np.ones(len(names))
            widths[chosen] = factor
            try:
                return _yield(plan, limit, widths, wanted, workers)
            except InputError:  # values that no machine has
                return None

        part = progress_of_part(progress, len(found), len(searches))
        found.append(largest_spread(name, keeps, min(_widest(plan, names[k]) for k in chosen), part))
    return Tolerances(plan, limit, wanted, today, tuple(found))


def _widest(plan: Plan, name: str) -> float:
    """The largest factor on a spread that is tried."""
    relative = name in plan.spread and name not in differences(plan.parameters)
    return MAX_RELATIVE_SPREAD / plan.spread[name] if relative else MAX_SPREAD_FACTOR


def largest_spread(
    name: str, keeps: Callable[[float], Rate | None], widest: float, progress: Progress | None
) -> Spread:
    """The largest factor that keeps the yield, by bisection before the first that loses it.

    keeps : the yield at a factor; None where it is lost
    """
    steps = 1 + SPREADS + HALVINGS

    def tried(factor: float, step: int) -> Rate | None:
        within = keeps(factor)
        if progress is not None:
            progress((step + 1) / steps)
        return within

    low, within = 0.0, tried(0.0, 0)
    if within is None:
        return Spread(name, 0.0, None, widest, monotone=True)
    factors = [widest * (k + 1) / SPREADS for k in range(SPREADS)]
    yields = [tried(factor, k + 1) for k, factor in enumerate(factors)]
    lost = next((k for k, found in enumerate(yields) if found is None), SPREADS)
    if lost:
        low, within = factors[lost - 1], yields[lost - 1]
    high = factors[min(lost, SPREADS - 1)]
    for step in range(HALVINGS if lost < SPREADS else 0):
        middle = (low + high) / 2
        now = tried(middle, 1 + SPREADS + step)
        low, high, within = (low, middle, within) if now is None else (middle, high, now)
    return Spread(name, low, within, widest, monotone=all(found is None for found in yields[lost:]))


def _yield(plan: Plan, limit: Limit, widths: FloatArray, wanted: float, workers: int | None) -> Rate | None:
    """The yield with spreads in multiples of the plan's; None as soon as it is known to be below the wanted one."""
    middle = machines_at(plan, np.full((1, len(widths)), 0.5)).values
    values = middle + (draw_machines(plan).values - middle) * widths
    allowed = int(plan.samples * (1 - wanted) + 1e-9)
    failed = 0
    for first in range(0, plan.samples, CHUNK):
        machines = machines_of(plan, values[first : first + CHUNK])
        batch = simulate_machines(plan, machines, first=first, workers=workers)
        failed += int((limit.severity(batch) >= 1).sum())
        if failed > allowed:
            return None
    return rate(plan.samples - failed, plan.samples)


def spread_of(found: Tolerances, spread: Spread) -> float:
    """The largest spread itself: a share, or SI for differences and errors of sensors; NaN for ALL_PARAMETERS."""
    own = {**found.plan.spread, **found.plan.sensor_spread}
    return spread.factor * own[spread.name] if spread.name in own else math.nan


def tolerance_document(found: Tolerances) -> dict[str, Any]:
    """Tolerances as plain tables."""
    return {
        "schema": "malta-tolerances",
        "version": 1,
        "limit": found.limit.name,
        "wanted": found.wanted,
        "today": found.today._asdict(),
        "spreads": {
            spread.name: {
                "factor": spread.factor,
                "spread": spread_of(found, spread),
                "within": None if spread.within is None else spread.within._asdict(),
                "at_least": spread.factor == spread.widest,
                "monotone": spread.monotone,
            }
            for spread in found.spreads
        },
    }
