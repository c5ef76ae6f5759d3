"""Which parameter costs yield: Sobol indices over the box of a campaign, by the design of Saltelli and others.

    first-order index   Var(E[Y | x_i]) / Var(Y)       what fixing x_i alone would take away of Y's variance
    total index         E[Var(Y | x_not i)] / Var(Y)   what is left when everything but x_i is fixed

Y is a figure of merit, or the yield: 1 for a run within the limit, 0 for one beyond it. The noise of the runs is a
factor like the parameters: its index says what part of the variance no tolerance of a machine can change.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.stats import qmc, sobol_indices

from malta.campaigns.block import simulate_machines
from malta.campaigns.limits import Limit, findings_of
from malta.campaigns.plan import Plan, machines_in_box, planned_run, varied_names, varying_columns
from malta.campaigns.result import Rate, rate
from malta.display import Description, display
from malta.errors import InputError

if TYPE_CHECKING:
    from malta.model.plant import FloatArray
    from malta.simulation.experiments import Progress

NOISE = "noise"  # the name of its factor
LEAST = 16  # points of each of the two samples
RESAMPLES = 100
NORMAL = 1.96  # standard deviations of a 95 % interval, either way
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
    of_merits: Mapping[
        str, tuple[Index, ...]
    ]  # by label; empty where a run has no value, or all have the same

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
    limit : from `malta.limit_of`; a run within it counts for the yield
    workers : threads; None: one for each core
    progress : called with the share of the runs that is done, 0 to 1

    Returns a Sensitivity: indices with 95 % intervals by factor, of the yield and of each figure of merit.

    Raises InputError for a box in which nothing varies, and for too few samples.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> box, options = {"m": 0.2, "C": 0.2}, {"duration": 0.02, "noise": 0.0}
    >>> plan = malta.Plan(controller, "disturbance", box, samples=64, options=options)
    >>> found = malta.sensitivity(plan, malta.limit_of(plan, "touchdown"), workers=1)
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
    if size < LEAST:
        expected = f"at least {LEAST * (len(factors) + 2)} for {len(factors)} factors"
        raise InputError("campaign", "samples", str(plan.samples), expected)
    points = _points(len(factors), size, plan.seed)
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
        _indices(within.astype(float), size, plan.seed),
        {f.label: _indices(f.values, size, plan.seed) for f in findings_of(plan, batch)},
    )


def _points(factors: int, size: int, seed: int) -> FloatArray:
    """Saltelli's design in the unit box: samples A and B, then A with each column from B in turn."""
    both = qmc.Sobol(2 * factors, rng=np.random.default_rng(seed)).random(size)
    A, B = both[:, :factors], both[:, factors:]
    mixed = [np.where(np.arange(factors) == i, B, A) for i in range(factors)]
    return np.concatenate([A, B, *mixed])


def _indices(values: FloatArray, size: int, seed: int) -> tuple[Index, ...]:
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
    half = [NORMAL * np.nanstd(x[1:], axis=0, ddof=1) for x in (first, total)]
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
