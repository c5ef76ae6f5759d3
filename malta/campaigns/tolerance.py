"""Tolerances: the largest spread of each parameter that keeps a wanted yield.

The same points of the unit box and the same noise serve every spread (common random numbers), so that yields of two
spreads differ by the spread alone. Nothing guarantees that a yield falls as a spread grows: SPREADS spreads up to the
widest are tried, and the answer lies before the first that loses the yield; a wider one that keeps it is reported.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.campaigns.block import simulate_machines
from malta.campaigns.limits import Limit
from malta.campaigns.plan import (
    Plan,
    draw_machines,
    machines_at,
    machines_of,
    varied_names,
    varying_columns,
)
from malta.campaigns.result import Rate, rate
from malta.display import Description, display
from malta.errors import InputError
from malta.model.parameters import differences
from malta.simulation.experiments import progress_of_part

if TYPE_CHECKING:
    from collections.abc import Callable

    from malta.model.plant import FloatArray
    from malta.simulation.experiments import Progress

WIDEST = 16.0  # multiples of today's spread that are tried, at most
FARTHEST = 0.95  # relative spread, at most: parameters stay above 0
SPREADS = 6  # that are tried up to the widest
HALVINGS = 7  # of the bracket around the answer
CHUNK = 1024  # runs, after which a yield may be known to be lost


class Spread(NamedTuple):
    """The largest spread of one parameter, the others at their own, or of all together."""

    name: str  # of the parameter; ALL
    factor: float  # in multiples of today's spread; 0 where the yield is lost even without any
    within: Rate | None  # the yield at that spread; None where it is lost without any
    widest: float  # factor that was tried, at most
    monotone: bool  # no wider spread that was tried keeps the yield again


ALL = "all together"


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
    limit : from `malta.limit_of`
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
    >>> plan = malta.Plan(controller, "disturbance", box, samples=20, options=short)
    >>> limit = malta.limit_of(plan, "deviation-y", 50e-6)
    >>> found = malta.tolerances(plan, limit, 0.95, workers=1)
    >>> found.today.share, found.spreads[0].name, found.spreads[0].factor > 1
    (1.0, 'm', True)
    """
    if not 0 < wanted <= 1:
        raise InputError("campaign", "tolerance", f"{wanted:g}", "a yield above 0 and up to 1")
    names, columns = varied_names(plan), varying_columns(plan)
    if not columns:
        raise InputError("campaign", "spread", "nothing that varies", "parameters that vary")
    searches = {names[k]: [k] for k in columns} | ({ALL: columns} if len(columns) > 1 else {})
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
        found.append(_largest(name, keeps, min(_widest(plan, names[k]) for k in chosen), part))
    return Tolerances(plan, limit, wanted, today, tuple(found))


def _widest(plan: Plan, name: str) -> float:
    """The largest factor on a spread that is tried."""
    relative = name in plan.spread and name not in differences(plan.parameters)
    return FARTHEST / plan.spread[name] if relative else WIDEST


def _largest(
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
    """The largest spread itself: a share, or SI for differences and errors of sensors; NaN for ALL."""
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
