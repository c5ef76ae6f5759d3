"""Rare events of a campaign: the probability of exceeding a limit, and the machine and the noise that cause it.

plan, limit -> rare_event -> RareEvent -> write_event -> read_design_point -> replay_design_point

    rare_touchdown.json      the probability, its repetitions and the design point
    rare_touchdown_0.npz     the first repetition of the subset simulation, with all its failures, under a seal
    rare_touchdown_1.npz     ...

The machines are uniform in the plan's box, as in a campaign, and every run has noise of its own, which changes part by
part where a chain takes a step: see rare.py.
"""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr
from scipy.stats import t as student

from malta.arrays import FloatArray
from malta.campaigns.limits import Limit
from malta.campaigns.plan import (
    Plan,
    machines_in_box,
    machines_of,
    planned_run,
    varied_names,
    varying_columns,
)
from malta.campaigns.result import CONFIDENCE, Rate, rate
from malta.campaigns.run import replay_machine
from malta.campaigns.store import seal, simulate_machines
from malta.display import Description, display
from malta.errors import InputError
from malta.files import file_exists, read_file
from malta.simulation.engine.digest import Batch, verdicts
from malta.simulation.engine.engines import EngineChoice
from malta.simulation.experiments import Experiment, Progress
from malta.simulation.simulate import EngineOf
from malta.tables import read_npz
from malta.writing import json_text, replace_files

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
# Runs of one simulation are related, over the levels too, and intervals from their correlation are too short. How
# exact the probability is, independent repetitions say: as the product of many shares, P is lognormal over R of them.
# With mean m and standard deviation s of log P, the logarithm of its mean is m + s^2 / 2, with the standard error e
# of
#
#     e^2 = s^2 / R + s^4 / (2 (R - 1))
#
# and the interval is m + s^2 / 2 -+ t e with t from Student's distribution of R - 1 degrees of freedom (Cox's method:
# Zhou & Gao 1997, Olsson 2005).
#
# The levels follow the most severe runs. Failures of another kind, to which the severity of the first levels does not
# lead, are missed by every repetition, and no interval tells of them.


SHARE = 10  # one run in SHARE passes a level
LEVELS = 10  # at most: probabilities down to 1e-10
REPETITIONS = 4
MIN_LEVEL_RUNS = 500  # of a repetition: with 100, probabilities of 1e-5 were too large by a half
NOISE_STRIDE = 2**40  # indices of noise from one repetition to the next
ACCEPTANCE = 0.44  # of the steps, Papaioannou et al. 2015
FIRST_STEP = 0.6  # size of the first step, in standard deviations


class LevelRuns(NamedTuple):
    """Runs of one level, a row for each."""

    u: FloatArray  # runs x dimensions, standard normal
    noise: NDArray[np.int64]  # runs x parts, index of the run whose noise the part has
    severity: FloatArray  # 1 or more: failed

    def choose(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> LevelRuns:
        """Some of the runs."""
        return LevelRuns(self.u[rows], self.noise[rows], self.severity[rows])


class Level(NamedTuple):
    """A level, and how many runs of the level before passed it."""

    threshold: float  # of the severity
    share: float  # of the runs that passed: the conditional probability
    acceptance: float  # of the steps that led to the runs; NaN for the first level, which has none


@dataclass(frozen=True, eq=False)
class Subset:
    """The result of one subset simulation."""

    levels: tuple[Level, ...]
    simulated: int  # runs
    failures: LevelRuns  # that the last level has; empty where no run failed
    worst: float  # largest severity below failure; NaN where every run failed
    samples: int  # runs in a level

    @property
    def reached(self) -> bool:
        """Whether runs failed, so that `probability` is that of the failure and not a bound above it."""
        return bool(len(self.failures.severity))

    @property
    def probability(self) -> float:
        """Of the failure; of passing the last level where no run failed, which is more probable than a failure."""
        return math.prod(level.share for level in self.levels)


@dataclass(frozen=True, eq=False)
class RareEventEstimate:
    """The probability that independent repetitions of a subset simulation agree on."""

    repetitions: tuple[Subset, ...]

    @property
    def reached(self) -> bool:
        """Whether runs failed in every repetition: `probability` is that of the failure and not a bound above it."""
        return all(one.reached for one in self.repetitions)

    @property
    def probability(self) -> float:
        """Of the failure; of passing the last levels where a repetition has no failure."""
        return math.exp(self._normal[0]) if self._pooled is None else self._pooled.share

    @property
    def cov(self) -> float:
        """Coefficient of variation of the probability."""
        if self._pooled is None:
            return math.sqrt(math.expm1(min(self._normal[1] ** 2, 700.0)))
        return math.sqrt((1 - self._pooled.share) / (self._pooled.share * self._pooled.runs))

    def interval(self) -> tuple[float, float]:
        """The interval of the probability at CONFIDENCE: see above; Clopper-Pearson's where one level is enough."""
        if self._pooled is not None:
            return self._pooled.low, self._pooled.high
        centre, error = self._normal
        half = error * float(student.ppf((1 + CONFIDENCE) / 2, len(self.repetitions) - 1))
        return math.exp(centre - half), math.exp(min(0.0, centre + half))

    @property
    def simulated(self) -> int:
        """Number of runs of all repetitions."""
        return sum(one.simulated for one in self.repetitions)

    @property
    def failures(self) -> LevelRuns:
        """The failures of all repetitions."""
        found = [one.failures for one in self.repetitions]
        return LevelRuns(*(np.concatenate(columns) for columns in zip(*found, strict=True)))

    @property
    def worst(self) -> float:
        """Largest severity below failure; NaN where every run failed."""
        return max((one.worst for one in self.repetitions if not math.isnan(one.worst)), default=math.nan)

    @property
    def plain(self) -> float:
        """Number of runs for which plain sampling has the same coefficient of variation; infinite without failures."""
        if not self.reached or not self.cov:
            return math.inf
        return (1 - self.probability) / (self.probability * self.cov**2)

    @property
    def _pooled(self) -> Rate | None:
        """Share of the runs that failed, where every repetition has one level: they are independent then."""
        if not self.reached or any(len(one.levels) > 1 for one in self.repetitions):
            return None
        return rate(len(self.failures.severity), sum(one.samples for one in self.repetitions))

    @property
    def _normal(self) -> tuple[float, float]:
        """log of the probability, and its standard error."""
        logs = np.log([one.probability for one in self.repetitions])
        s2, R = float(logs.var(ddof=1)), len(logs)
        return min(0.0, float(logs.mean()) + s2 / 2), math.sqrt(s2 / R + s2**2 / (2 * (R - 1)))


Severity = Callable[["FloatArray", "NDArray[np.int64]"], "FloatArray"]


def repeated_subset_simulation(
    severity: Severity,
    dimensions: int,
    parts: int = 1,
    *,
    samples: int,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
    keep: Callable[[int, Callable[[], Subset]], Subset] | None = None,
) -> RareEventEstimate:
    """The probability that a severity is 1 or more, by REPETITIONS of `subset_simulation`.

    samples : runs in a level of all repetitions together, in multiples of SHARE * REPETITIONS
    keep : (repetition, function that simulates it) -> repetition; for who has some already

    Raises InputError for fewer than MIN_LEVEL_RUNS runs in a level of a repetition, and as `subset_simulation` does.

        found = repeated_subset_simulation(lambda u, noise: u[:, 0] / 5.2, 1, samples=8000)
        print(found.probability, found.interval())  # 1e-7
    """
    each = samples // REPETITIONS
    if each < MIN_LEVEL_RUNS:
        expected = (
            f"at least {REPETITIONS * MIN_LEVEL_RUNS}: "
            f"{REPETITIONS} repetitions of {MIN_LEVEL_RUNS} in each level"
        )
        raise InputError("rare event", "samples", str(samples), expected)
    found: list[Subset] = []

    def report(share: float) -> None:
        if progress is not None:
            progress((len(found) + share) / REPETITIONS)

    for k in range(REPETITIONS):
        simulate = partial(
            subset_simulation,
            severity,
            dimensions,
            parts,
            samples=each,
            seed=(seed, k),
            first=k * NOISE_STRIDE,
            progress=report,
        )
        found.append(simulate() if keep is None else keep(k, simulate))
        report(0.0)
    return RareEventEstimate(tuple(found))


def subset_simulation(
    severity: Severity,
    dimensions: int,
    parts: int = 1,
    *,
    samples: int,
    seed: int | tuple[int, ...] = 0,
    first: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Subset:
    """One subset simulation of the probability that a severity is 1 or more.

    severity : (u, noise) -> severity of each run: u is runs x dimensions, standard normal; noise is runs x parts,
        indices of runs whose noise is independent. Larger before it reaches 1 for runs that are nearer to failing.
    samples : runs in each level, in tens
    first : index of the first run's noise
    progress : called now and then with an estimate of the share that is done

    Raises InputError for a severity by which runs cannot be told apart.
    """
    chains = samples // SHARE
    rng, size = np.random.default_rng(seed), chains * SHARE
    u, noise = (
        rng.standard_normal((size, dimensions)),
        np.repeat(first + np.arange(size)[:, None], parts, axis=1),
    )
    runs = LevelRuns(u, noise, severity(u, noise))
    stride, levels = _Stride(FIRST_STEP, math.nan, size), list[Level]()
    start = float(np.median(runs.severity))
    while True:
        threshold = _threshold(runs, chains, last=len(levels) == LEVELS - 1)
        passed = runs.severity >= threshold
        if not passed.any():
            break
        levels.append(Level(threshold, float(passed.mean()), stride.acceptance))
        if progress is not None:
            progress(min(1.0, max(0.0, (threshold - start) / (1 - start))) if start < 1 else 1.0)
        if threshold >= 1:
            break
        runs, stride = _climb(severity, runs.choose(passed), threshold, stride, rng, chains, first)
    below = runs.severity[runs.severity < 1]
    failures = runs.choose(runs.severity >= 1)
    return Subset(tuple(levels), stride.drawn, failures, float(below.max()) if below.size else math.nan, size)


class _Stride(NamedTuple):
    """The steps of the chains."""

    size: float  # in multiples of the standard deviation of the runs that passed
    acceptance: float  # in the last level
    drawn: int  # runs simulated so far


def _threshold(runs: LevelRuns, chains: int, *, last: bool) -> float:
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
    severity: Severity,
    seeds: LevelRuns,
    threshold: float,
    stride: _Stride,
    rng: np.random.Generator,
    chains: int,
    first: int,
) -> tuple[LevelRuns, _Stride]:
    """As many runs as before from the next level, by chains that begin with runs which passed it, and the next stride.

    The runs are in order of the steps, in each step in order of the chains.
    """
    state = seeds.choose(np.resize(rng.permutation(len(seeds.severity)), chains))
    spread, states, rates = state.u.std(axis=0), [state], []
    length, drawn = stride.size, stride.drawn
    for step in range(1, SHARE):
        size = np.minimum(1.0, length * spread)
        u = np.sqrt(1 - size**2) * state.u + size * rng.standard_normal(state.u.shape)
        fresh = rng.random(state.noise.shape) < min(1.0, length) ** 2
        noise = np.where(fresh, first + drawn + np.arange(chains)[:, None], state.noise)
        proposed = severity(u, noise)
        drawn += chains
        kept = proposed >= threshold
        state = LevelRuns(
            np.where(kept[:, None], u, state.u),
            np.where(kept[:, None], noise, state.noise),
            np.where(kept, proposed, state.severity),
        )
        states.append(state)
        rates.append(float(kept.mean()))
        length *= math.exp((rates[-1] - ACCEPTANCE) / math.sqrt(step))
    u, noise, severities = (np.concatenate(column) for column in zip(*states, strict=True))
    return LevelRuns(u, noise, severities), _Stride(length, float(np.mean(rates)), drawn)


PARTS = 100  # of a run, whose noise changes independently
SCHEMA, VERSION = "malta-rare-event", 2
HEADERS = 100_000  # bytes of a repetition's file beside its failures, at most


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
    found: RareEventEstimate
    design_point: DesignPoint | None  # None where no run failed

    @property
    def description(self) -> Description:
        """The probability with its interval, and the machine that fails most easily."""
        low, high = self.found.interval()
        known = f"{self.found.probability:.3g}, 95 % interval {low:.2g} .. {high:.2g}"
        rows = [("probability", known if self.found.reached else f"below {high:.2g}")]
        levels = max(len(one.levels) for one in self.found.repetitions)
        repetitions = f"{len(self.found.repetitions)} repetitions of up to {levels} level(s)"
        rows.append(("simulated", f"{self.found.simulated} runs, {repetitions}"))
        if self.design_point is not None:
            values = ", ".join(f"{name} = {value:.4g}" for name, value in self.design_point.values.items())
            rows.append(("fails first", f"{values}: {self.design_point.end}"))
        return Description(f"RareEvent of {self.plan.controller.name!r}: {self.limit.text}", tuple(rows))


def rare_event(
    plan: Plan,
    limit: Limit,
    folder: str | Path | None = None,
    *,
    workers: int | None = None,
    progress: Progress | None = None,
) -> RareEvent:
    """Estimate the probability that a run of a plan exceeds a limit, by four repetitions of a subset simulation.

    Each level of a repetition runs plan.samples / 4 machines, of which those beyond the level's threshold begin the
    chains of the next. The interval is that of the repetitions, which have no run in common: see `docs/howto/rare.md`.
    plan.seed decides machines and noise; plan.sampler does not count. Source: S. K. Au and J. L. Beck, Probabilistic
    Engineering Mechanics 16 (2001) 263-277.

    plan : the plan of the runs, at least 2000
    limit : from `malta.campaigns.limit_of`
    folder : that of the plan's campaign, which keeps every repetition as soon as it is done; None: nothing is written
    workers : threads; None: one for each core
    progress : called with the share of the work that is done, 0 to 1

    Returns a RareEvent: `found.probability` with its interval, and the failed run nearest the middle of the box.

    Raises InputError where nothing is random, and for numbers of samples that no level can be made of.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> box = {"m": 0.2}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=2000, options=short
    ... )
    >>> limit = malta.campaigns.limit_of(plan, "deviation-y", 40e-6)
    >>> event = malta.campaigns.rare_event(plan, limit, workers=1)
    >>> low, high = event.found.interval()
    >>> 0.1 < low < event.found.probability < high < 1
    True
    >>> f"{len(event.found.repetitions)} repetitions, {event.found.simulated} runs"
    '4 repetitions, 2000 runs'
    """
    noisy = planned_run(plan).scenario.noise > 0
    dimensions = len(varying_columns(plan))
    if not (dimensions or noisy):
        raise InputError("rare event", "spread", "nothing random", "parameters that vary, or noise")

    def severity(u: FloatArray, noise: NDArray[np.int64]) -> FloatArray:
        return limit.severity(_simulate(plan, u, noise, workers))

    def keep(repetition: int, simulate: Callable[[], Subset]) -> Subset:
        if folder is None:
            return simulate()
        path = Path(folder) / f"{event_name(limit)}_{repetition}.npz"
        known = _read_repetition(path, plan, limit, repetition) if file_exists(path) else None
        if known is not None:
            return known
        found = simulate()
        replace_files({path: _encode_repetition(found, plan, limit, repetition)})
        return found

    found = repeated_subset_simulation(
        severity,
        dimensions,
        PARTS if noisy else 1,
        samples=plan.samples,
        seed=plan.seed,
        progress=progress,
        keep=keep,
    )
    return RareEvent(plan, limit, found, _design_point(plan, found.failures))


def _encode_repetition(found: Subset, plan: Plan, limit: Limit, repetition: int) -> bytes:
    """A repetition as an .npz archive, with the identity of its plan, its limit and its seal."""
    buffer = io.BytesIO()
    arrays = {
        "campaign": np.array(plan.identity),
        "limit": np.array(limit.name),
        "levels": np.array(found.levels),
        "counts": np.array([found.simulated, found.samples]),
        "worst": np.array(found.worst),
        **found.failures._asdict(),
    }
    np.savez(buffer, **arrays, seal=np.array(seal(arrays, repetition)))
    return buffer.getvalue()


def _read_repetition(path: Path, plan: Plan, limit: Limit, repetition: int) -> Subset | None:
    """The repetition that a file has; None for a damaged one, and for one of another plan or limit."""
    largest = 16 * plan.samples * (PARTS + len(varied_names(plan)) + 1) + HEADERS  # twice what it takes
    data = read_file(path, "repetition of a rare event", Path.read_bytes, largest)
    try:
        arrays = read_npz(data)
        sealed = str(arrays.pop("seal"))
        own = (str(arrays["campaign"]), str(arrays["limit"])) == (plan.identity, limit.name)
        if not own or sealed != seal(arrays, repetition):
            return None
        levels = tuple(Level(*map(float, row)) for row in arrays["levels"])
        simulated, samples = map(int, arrays["counts"])
        failures = LevelRuns(*(arrays[name] for name in LevelRuns._fields))
    except (ValueError, KeyError, TypeError):
        return None
    return Subset(levels, simulated, failures, float(arrays["worst"]), samples)


def _simulate(plan: Plan, u: FloatArray, noise: NDArray[np.int64], workers: int | None = None) -> Batch:
    """The figures at standard normal points, runs x the names that vary."""
    return simulate_machines(plan, machines_in_box(plan, ndtr(u)), noise=noise, workers=workers)


def _design_point(plan: Plan, failures: LevelRuns) -> DesignPoint | None:
    if not len(failures.severity):
        return None
    far = np.sqrt((failures.u**2).sum(axis=1))
    nearest = failures.choose(np.array([far.argmin()]))
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
        "worst_severity": found.worst,
        "repetitions": [_repetition_table(one) for one in found.repetitions],
        "design_point": None if point is None else point._asdict(),
    }


def _repetition_table(found: Subset) -> dict[str, Any]:
    """One repetition; its probability is null where no run failed."""
    return {
        "probability": found.probability if found.reached else None,
        "simulated": found.simulated,
        "worst_severity": found.worst,
        "levels": [level._asdict() for level in found.levels],
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
