"""Rare events of a campaign: the probability of exceeding a limit, and the machine and the noise that cause it.

plan, limit -> rare_event -> RareEvent -> write_event -> read_design_point -> replay_design_point

The machines are uniform in the plan's box, as in a campaign, and every run has noise of its own, which changes part by
part where a chain takes a step: see rare.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from malta.campaigns.limits import Limit
from malta.campaigns.plan import (
    Plan,
    machines_in_box,
    machines_of,
    planned_run,
    varied_names,
    varying_columns,
)
from malta.campaigns.run import replay_machine
from malta.campaigns.store import simulate_machines
from malta.display import Description, display
from malta.errors import InputError
from malta.files import json_text, read_file, replace_files
from malta.simulation.engine.digest import verdicts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray
    from malta.simulation.engine.digest import Batch
    from malta.simulation.engine.engines import EngineChoice
    from malta.simulation.experiments import Experiment, Progress
    from malta.simulation.simulate import EngineOf


# Subset simulation: small probabilities as a product of larger ones, each by Markov chains on the runs before.
#
#     P(severity >= 1) = P(severity >= b_1) P(severity >= b_2 | severity >= b_1) ...    (Au & Beck 2001, eq. 3)
#
# A tenth of the runs passes each level and begins the chains of the next. What is random is a standard normal vector u
# and, for each part of a run, the index of the run whose noise this part has. A step of a chain proposes
#
#     u' = sqrt(1 - s^2) u + s xi,  xi standard normal    (Papaioannou et al. 2015, conditional sampling)
#
# and, with probability s^2 for each part, noise that was never drawn before. Both leave the distribution of (u,
# noise) as it is, so that a step which is refused whenever it leaves the level leaves the distribution within the
# level as it is. The size s is adapted to an acceptance of 44 %, by all chains together.
#
# The levels follow the most severe runs. Failures of another kind, to which the severity of the first levels does not
# lead, are missed, and no coefficient of variation tells of them.


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


PARTS = 100  # of a run, whose noise changes independently
SCHEMA, VERSION = "malta-rare-event", 1
FEW = 10  # ancestors of the failures: with fewer, the coefficient of variation is itself uncertain


class DesignPoint(NamedTuple):
    """The failed run whose machine is nearest the middle of the box."""

    values: Mapping[str, float]  # of what varies, SI
    distance: float  # from the middle, in standard normal coordinates
    noise: tuple[int, ...]  # index of the run whose noise each part has
    end: str  # verdict
    time: float  # s, of the end


@display
@dataclass(frozen=True, eq=False)
class RareEvent:
    """The probability that a run exceeds a limit. `found` says how it was estimated."""

    plan: Plan
    limit: Limit
    found: Subset
    design_point: DesignPoint | None  # None where no run failed

    @property
    def uncertain(self) -> bool:
        """Whether the failures descend from so few first runs that their coefficient of variation is a guess."""
        return self.found.reached and len(self.found.levels) > 1 and self.found.ancestors < FEW

    @property
    def description(self) -> Description:
        """The probability with its interval, and the machine that fails most easily."""
        low, high = self.found.interval()
        known = f"{self.found.probability:.3g}, 95 % interval {low:.2g} .. {high:.2g}"
        rows = [("probability", known if self.found.reached else f"below {high:.2g}, no run failed")]
        rows.append(("simulated", f"{self.found.simulated} runs, {len(self.found.levels)} levels"))
        if self.design_point is not None:
            values = ", ".join(f"{name} = {value:.4g}" for name, value in self.design_point.values.items())
            rows.append(("fails first", f"{values}: {self.design_point.end}"))
        return Description(f"RareEvent of {self.plan.controller.name!r}: {self.limit.text}", tuple(rows))


def rare_event(
    plan: Plan, limit: Limit, *, workers: int | None = None, progress: Progress | None = None
) -> RareEvent:
    """Estimate the probability that a run of a plan exceeds a limit, by subset simulation.

    Each level runs plan.samples machines, of which those beyond the level's threshold begin the chains of the next.
    plan.seed decides machines and noise; plan.sampler does not count. Source: S. K. Au and J. L. Beck, Probabilistic
    Engineering Mechanics 16 (2001) 263-277.

    plan : the plan of the runs
    limit : from `malta.limit_of`
    workers : threads; None: one for each core
    progress : called with the share of the work that is done, 0 to 1

    Returns a RareEvent: `found.probability` with its interval, and the failed run nearest the middle of the box.

    Raises InputError where nothing is random, and for numbers of samples that no level can be made of.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> box = {"m": 0.2}
    >>> plan = malta.Plan(controller, "disturbance", box, samples=100, options=short)
    >>> limit = malta.limit_of(plan, "deviation-y", 40e-6)
    >>> event = malta.rare_event(plan, limit, workers=1)
    >>> 1e-4 < event.found.probability < 1
    True
    >>> f"{len(event.found.levels)} level(s), {event.found.simulated} runs"
    '1 level(s), 100 runs'
    """
    noisy = planned_run(plan).scenario.noise > 0
    dimensions = len(varying_columns(plan))
    if not (dimensions or noisy):
        raise InputError("rare event", "spread", "nothing random", "parameters that vary, or noise")

    def severity(u: FloatArray, noise: NDArray[np.int64]) -> FloatArray:
        return limit.severity(_simulate(plan, u, noise, workers))

    found = subset_simulation(
        severity,
        dimensions,
        PARTS if noisy else 1,
        samples=plan.samples,
        seed=plan.seed,
        progress=progress,
    )
    return RareEvent(plan, limit, found, _design_point(plan, found.failures))


def _simulate(plan: Plan, u: FloatArray, noise: NDArray[np.int64], workers: int | None = None) -> Batch:
    """The figures at standard normal points, runs x the names that vary."""
    return simulate_machines(plan, machines_in_box(plan, ndtr(u)), noise=noise, workers=workers)


def _design_point(plan: Plan, failures: Runs) -> DesignPoint | None:
    if not len(failures.severity):
        return None
    far = np.sqrt((failures.u**2).sum(axis=1))
    nearest = failures.chosen(np.array([far.argmin()]))
    machines = machines_in_box(plan, ndtr(nearest.u))
    batch = simulate_machines(plan, machines, noise=nearest.noise)
    return DesignPoint(
        dict(zip(machines.names, machines.values[0].tolist(), strict=True)),
        float(far.min()),
        tuple(nearest.noise[0].tolist()),
        verdicts(plan.plant)[int(batch.verdict[0])],
        float(batch.duration[0]),
    )


def event_document(event: RareEvent) -> dict[str, Any]:
    """A rare event as plain tables, SI."""
    found = event.found
    low, high = found.interval()
    point = event.design_point
    return {
        "schema": SCHEMA,
        "version": VERSION,
        "limit": event.limit.name,
        "text": event.limit.text,
        "probability": found.probability if found.reached else None,
        "bound": None if found.reached else high,
        "cov": found.cov,
        "low": low if found.reached else None,
        "high": high,
        "simulated": found.simulated,
        "plain_sampling": found.plain if found.reached else None,
        "ancestors": found.ancestors,
        "worst_severity": found.worst,
        "interrupted": found.interrupted,
        "levels": [level._asdict() for level in found.levels],
        "design_point": None if point is None else point._asdict(),
    }


def event_name(limit: Limit) -> str:
    """The name of a rare event in its folder: rare_touchdown."""
    return f"rare_{limit.slug}"


def write_event(event: RareEvent, folder: Path) -> Path:
    """Write a rare event beside the manifest of its plan."""
    path = folder / f"{event_name(event.limit)}.json"
    replace_files({path: (json_text(event_document(event)) + "\n").encode()})
    return path


def read_design_point(path: Path, plan: Plan) -> DesignPoint:
    """The design point of a file that `write_event` wrote.

    Raises InputError for any other file, and for an event without a failure.
    """
    text = read_file(path, "rare event", partial(Path.read_text, encoding="utf-8"))
    try:
        content = json.loads(text)
        if (content["schema"], content["version"]) != (SCHEMA, VERSION):
            raise ValueError("another kind of file")
        point = content["design_point"]
        if point is None:
            raise InputError(path, "design_point", "none", "an event in which a run failed")
        values = {name: float(point["values"][name]) for name in varied_names(plan)}
        noise = tuple(int(index) for index in point["noise"])
        if not noise or min(noise) < 0 or not all(map(math.isfinite, values.values())):
            raise ValueError("numbers that no run has")
        return DesignPoint(values, float(point["distance"]), noise, str(point["end"]), float(point["time"]))
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(path, "", "a damaged or foreign file", "a rare event of a campaign") from error


def replay_design_point(
    plan: Plan,
    point: DesignPoint,
    *,
    engine: EngineChoice | EngineOf = "auto",
    progress: Progress | None = None,
) -> Experiment:
    """Simulate a design point again, with all its time series: the same to the bit by the compiled engine."""
    machines = machines_of(plan, np.array([[point.values[name] for name in varied_names(plan)]]))
    return replay_machine(plan, machines, 0, np.array([point.noise]), engine=engine, progress=progress)
