"""Subset simulation: small probabilities as a product of larger ones, each by Markov chains on the runs before.

    P(severity >= 1) = P(severity >= b_1) P(severity >= b_2 | severity >= b_1) ...    (Au & Beck 2001, eq. 3)

A tenth of the runs passes each level and begins the chains of the next. What is random is a standard normal vector u
and, for each part of a run, the index of the run whose noise this part has. A step of a chain proposes

    u' = sqrt(1 - s^2) u + s xi,  xi standard normal    (Papaioannou et al. 2015, conditional sampling)

and, with probability s^2 for each part, noise that was never drawn before. Both leave the distribution of (u, noise) as
it is, so that a step which is refused whenever it leaves the level leaves the distribution within the level as it is.
The size s is adapted to an acceptance of 44 %, by all chains together.

The levels follow the most severe runs. Failures of another kind, to which the severity of the first levels does not
lead, are missed, and no coefficient of variation tells of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from malta.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray

SHARE = 10  # one run in SHARE passes a level
LEVELS = 10  # at most: probabilities down to 1e-10
FEWEST = 100  # runs in a level
ACCEPTANCE = 0.44  # of the steps, Papaioannou et al. 2015
FIRST_STEP = 0.6  # size of the first step, in standard deviations


class Runs(NamedTuple):
    """Runs of one level, a row for each."""

    u: FloatArray  # runs x dimensions, standard normal
    noise: NDArray[np.int64]  # runs x parts, index of the run whose noise the part has
    severity: FloatArray  # 1 or more: failed
    ancestor: NDArray[np.int64]  # of the runs of the first level, from which this one's chain descends

    def chosen(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Runs:
        """Some of the runs."""
        return Runs(self.u[rows], self.noise[rows], self.severity[rows], self.ancestor[rows])


class Level(NamedTuple):
    """A level, and how many runs of the level before passed it."""

    threshold: float  # of the severity
    share: float  # of the runs that passed: the conditional probability
    cov: float  # coefficient of variation of the share, with the correlation in the chains
    acceptance: float  # of the steps that led to the runs; NaN for the first level, which has none


@dataclass(frozen=True, eq=False)
class Subset:
    """The result of a subset simulation."""

    levels: tuple[Level, ...]
    simulated: int  # runs
    cov: float  # coefficient of variation of the probability
    failures: Runs  # that the last level has; empty where no run failed
    worst: float  # largest severity below failure; NaN where every run failed
    samples: int  # runs in a level
    interrupted: bool = False

    @property
    def reached(self) -> bool:
        """Whether runs failed, so that `probability` is that of the failure and not a bound above it."""
        return bool(len(self.failures.severity)) and not self.interrupted

    @property
    def probability(self) -> float:
        """Of the failure; of passing the last level where no run failed, which is more probable than a failure."""
        return math.prod(level.share for level in self.levels)

    @property
    def ancestors(self) -> int:
        """Number of runs of the first level from which the failures descend."""
        return len(np.unique(self.failures.ancestor))

    def interval(self, z: float = 1.96) -> tuple[float, float]:
        """The interval of a lognormal probability with this coefficient of variation: 95 % for z = 1.96."""
        width = math.exp(z * math.sqrt(math.log1p(self.cov**2)))
        return self.probability / width, min(1.0, self.probability * width)

    @property
    def plain(self) -> float:
        """Number of runs for which plain sampling has the same coefficient of variation; infinite without failures."""
        if not self.reached or not self.cov:
            return math.inf
        return (1 - self.probability) / (self.probability * self.cov**2)


Severity = Callable[["FloatArray", "NDArray[np.int64]"], "FloatArray"]


def subset_simulation(
    severity: Severity,
    dimensions: int,
    parts: int = 1,
    *,
    samples: int = 1000,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Subset:
    """The probability that a severity is 1 or more.

    severity : (u, noise) -> severity of each run: u is runs x dimensions, standard normal; noise is runs x parts,
        indices of runs whose noise is independent. Larger before it reaches 1 for runs that are nearer to failing.
    samples : runs in each level, in tens
    progress : called now and then with an estimate of the share that is done

    After Ctrl-C the result has the levels that are done, and says `interrupted`; before the first level is done the
    KeyboardInterrupt is raised.

    Raises InputError for fewer than FEWEST samples, and for a severity by which runs cannot be told apart.

        found = subset_simulation(lambda u, noise: u[:, 0] / 5.2, 1)
        print(found.probability, found.cov)  # 1e-7
    """
    if samples < FEWEST:
        raise InputError("rare event", "samples", str(samples), f"at least {FEWEST} in each level")
    chains = samples // SHARE
    rng, size = np.random.default_rng(seed), chains * SHARE
    u, noise = rng.standard_normal((size, dimensions)), np.repeat(np.arange(size)[:, None], parts, axis=1)
    runs = Runs(u, noise, severity(u, noise), np.arange(size))
    stride, levels, interrupted = _Stride(FIRST_STEP, math.nan, size), list[Level](), False
    start = float(np.median(runs.severity))
    while True:
        threshold = _threshold(runs, chains, last=len(levels) == LEVELS - 1)
        passed = runs.severity >= threshold
        if not passed.any():
            break
        cov = _cov(passed, chains, correlated=bool(levels))
        levels.append(Level(threshold, float(passed.mean()), cov, stride.acceptance))
        seeds = runs.chosen(passed)
        if progress is not None:
            progress(min(1.0, max(0.0, (threshold - start) / (1 - start))) if start < 1 else 1.0)
        if threshold >= 1:
            break
        try:
            runs, stride = _climb(severity, seeds, threshold, stride, rng, chains)
        except KeyboardInterrupt:
            interrupted = True
            break
    below = runs.severity[runs.severity < 1]
    return Subset(
        tuple(levels),
        stride.drawn,
        max(_genealogical_cov(seeds, size), math.sqrt(sum(level.cov**2 for level in levels))),
        runs.chosen(runs.severity >= 1),
        float(below.max()) if below.size else math.nan,
        size,
        interrupted,
    )


class _Stride(NamedTuple):
    """The steps of the chains."""

    size: float  # in multiples of the standard deviation of the runs that passed
    acceptance: float  # in the last level
    drawn: int  # runs simulated so far: index of the next noise


def _threshold(runs: Runs, chains: int, *, last: bool) -> float:
    """The severity that `chains` runs reach; 1 where more fail, or where no further level is allowed.

    Where many runs have the same severity, as 0 of something that seldom occurs, it is the next larger one.
    """
    ordered = np.sort(runs.severity)
    threshold = float(ordered[-chains])
    if threshold >= 1 or last:
        return 1.0
    if (ordered >= threshold).sum() > 2 * chains:
        higher = ordered[ordered > threshold]
        if len(higher) < SHARE:
            share = 100 * float((ordered == threshold).mean())
            found = f"the same value in {share:.3g} % of the runs"
            raise InputError("rare event", "severity", found, "one that grows before a run fails")
        threshold = min(1.0, float(higher[0]))
    return threshold


def _climb(
    severity: Severity, seeds: Runs, threshold: float, stride: _Stride, rng: np.random.Generator, chains: int
) -> tuple[Runs, _Stride]:
    """As many runs as before from the next level, by chains that begin with runs which passed it, and the next stride.

    The runs are in order of the steps, in each step in order of the chains.
    """
    state = seeds.chosen(np.resize(rng.permutation(len(seeds.severity)), chains))
    spread, states, rates = state.u.std(axis=0), [state], []
    length, drawn = stride.size, stride.drawn
    for step in range(1, SHARE):
        size = np.minimum(1.0, length * spread)
        u = np.sqrt(1 - size**2) * state.u + size * rng.standard_normal(state.u.shape)
        fresh = rng.random(state.noise.shape) < min(1.0, length) ** 2
        noise = np.where(fresh, drawn + np.arange(chains)[:, None], state.noise)
        proposed = severity(u, noise)
        drawn += chains
        kept = proposed >= threshold
        state = Runs(
            np.where(kept[:, None], u, state.u),
            np.where(kept[:, None], noise, state.noise),
            np.where(kept, proposed, state.severity),
            state.ancestor,
        )
        states.append(state)
        rates.append(float(kept.mean()))
        length *= math.exp((rates[-1] - ACCEPTANCE) / math.sqrt(step))
    u, noise, severities, ancestor = (np.concatenate(column) for column in zip(*states, strict=True))
    return Runs(u, noise, severities, ancestor), _Stride(length, float(np.mean(rates)), drawn)


def _cov(passed: NDArray[np.bool_], chains: int, *, correlated: bool) -> float:
    """Coefficient of variation of a level's share (Au & Beck 2001, eqs. 28 and 29).

    passed : of each run, in order of the steps, in each step in order of the chains
    correlated : the runs are those of chains, and not independent
    """
    share = float(passed.mean())
    correlation = 0.0
    if correlated and share < 1:
        table = passed.reshape(SHARE, chains).astype(float)
        for k in range(1, SHARE):
            covariance = float((table[:-k] * table[k:]).mean()) - share**2
            correlation += 2 * (1 - k / SHARE) * covariance / (share * (1 - share))
    return math.sqrt(max(0.0, (1 - share) / (share * len(passed)) * (1 + correlation)))


def _genealogical_cov(survivors: Runs, size: int) -> float:
    """Coefficient of variation of the product of all shares, from how unequally the first runs have descendants.

    cov^2 = sum over the first level's runs of (share of the survivors that descend from it - 1 / size)^2
    after Lee & Whiteley (2018). Chains that begin with related runs are correlated: Au & Beck's sum leaves that out.
    """
    descendants = np.bincount(survivors.ancestor, minlength=size) / len(survivors.severity)
    return math.sqrt(float(((descendants - 1 / size) ** 2).sum()))
