"""Specification -> design: the numbers of [search] that reach what a design file asks for in [specification].

The weights of an LQG are searched here, the gains of a PID by tuning.pid; what is found is judged as the file that
will be written.

Each group of states that nothing joins to the others is searched by itself; groups that are each other's mirror image
are computed once. One number is minimized: the worst ratio of what is found to what is asked for (asked to found where
more is better), so 1 is reached where everything holds, and what binds has a name. Differential evolution finds the
region, a descent by linear programs the place.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display
from malta.errors import InputError
from malta.margins.outcome import Outcome
from malta.margins.travel import travel_margin
from malta.model.parameters import describe
from malta.model.plant import Plant, whole_samples
from malta.synthesis.requirements import Trade, base_of, ratio_of, requirements_for
from malta.synthesis.spec import Spec
from malta.synthesis.weighting import Weights
from malta.tuning import groups, pid
from malta.tuning.descent import BoundPenalty, descend
from malta.tuning.groups import STEP, TuningGroup, figures_of, groups_of, is_driven
from malta.tuning.judging import judge
from malta.tuning.search import (
    DIGITS,
    UNSTABLE_RATIO,
    Effort,
    Journal,
    Progress,
    Trial,
    TrialSearch,
    apply_trial,
    at_least_of,
    combine,
    distance_outside,
    merge,
    model_and_controller,
    separate,
)
from malta.work import count_work, is_stopped, without_limit

FRONT = (0.6, 0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1)  # of the margin that is asked for
MIN_RATIO = 1e-3  # ratio below which a figure counts as nothing
NOISE_PENALTY = BoundPenalty(steep=100.0, floor=0.0)  # what noise can gain beside a bound that is missed
TRADES: tuple[Trade, ...] = get_args(Trade)  # what the front has against the margin


class _Cluster(NamedTuple):
    """Groups that variables join, and those variables."""

    variables: tuple[int, ...]
    groups: tuple[TuningGroup, ...]


def clusters_of(spec: Spec) -> list[_Cluster]:
    """What can be searched by itself: groups that share no variable. Mirror images are left out."""
    groups = groups_of(spec)
    base = spec.weights
    touched: list[set[int]] = []
    middle = [math.sqrt(v.low * v.high) for v in spec.search]
    for index in range(len(spec.search)):
        other = [value * (1.5 if k == index else 1) for k, value in enumerate(middle)]
        a, b = spec.vary(middle).weights, spec.vary(other).weights
        touched.append({k for k, g in enumerate(groups) if _differ(g.part(a), g.part(b))})
        if not touched[-1]:
            raise InputError(
                spec.path, f"search.numbers.{spec.search[index].name}", "no effect", "an entry that has one"
            )
    clusters = []
    for variables, members in separate(touched, len(groups)):
        distinct: dict[Any, TuningGroup] = {}
        for k in members:
            g = groups[k]
            # Mirror images stay so under every weight that the search tries.
            same = tuple(
                tuple(
                    tuple(np.ravel(getattr(g.part(w), name)).tolist())
                    for name in Weights.__dataclass_fields__
                )
                for w in (base, spec.vary(middle).weights)
            )
            distinct.setdefault((g.picture, same), g)
        clusters.append(_Cluster(variables, tuple(distinct.values())))
    return clusters


def _differ(a: Weights, b: Weights) -> bool:
    """Whether they may give other gains: bases of weights that are zero do not matter."""
    names = ("Q", "R", "Q_i", "process_variance", "sensor_variance", "drift_variance", "correlation")
    return any((getattr(a, name) != getattr(b, name)).any() for name in names)


def cluster_search(spec: Spec, cluster: _Cluster, delay: float, journal: Journal) -> TrialSearch:
    """The trials of one cluster with one delay."""
    at_least = at_least_of(spec.plant)

    def compute(design: Spec) -> dict[str, float]:
        return merge([figures_of(spec, g, design.weights, delay) for g in cluster.groups], at_least)

    return TrialSearch(spec, cluster.variables, delay, journal, compute)


def worst_ratio(search: TrialSearch, u: FloatArray) -> float:
    """What is minimized: the worst ratio, and a little of all of them."""
    ratios = _ratios(search.spec, search.figures(u), search.spec.specification)
    return (max(ratios) + 0.01 * sum(ratios) / len(ratios) if ratios else UNSTABLE_RATIO) + distance_outside(
        u
    )


def _look_worst(search: TrialSearch, u: FloatArray) -> tuple[float, FloatArray] | None:
    """The logarithms of all ratios; None for an unstable loop."""
    figures = search.figures(u)
    return (0.0, _logs(search.spec, figures, search.spec.specification)) if figures else None


def _look_frugal(
    search: TrialSearch, u: FloatArray, margin: float, kinds: Collection[str]
) -> tuple[float, FloatArray] | None:
    """The logarithm of noise or motion, and of the ratios at a margin with everything else as it is asked for."""
    figures = search.figures(u)
    if not figures:
        return None
    asked = _beside_trades(search.spec)
    size = sum(math.log(figures[kind]) for kind in figures if base_of(kind) in kinds)
    return size, _logs(search.spec, figures, asked | {"margin": margin})


def _logs(spec: Spec, figures: Mapping[str, float], asked: Mapping[str, float]) -> FloatArray:
    """Logarithms of ratios, each corner's margin among them; MIN_RATIO for what is next to nothing."""
    corners = {name: asked["margin"] for name in figures if "margin" in asked and base_of(name) == "margin"}
    ratios = _ratios(spec, figures, {**asked, **corners})
    return np.asarray(np.log(np.clip(ratios or [MIN_RATIO], MIN_RATIO, 1 / MIN_RATIO)))


def _ratios(spec: Spec, figures: Mapping[str, float], asked: Mapping[str, float]) -> list[float]:
    """How near the figures are to what is asked for of them."""
    at_least = at_least_of(spec.plant)
    return [
        ratio_of(asked[name], value, at_least=base_of(name) in at_least)
        for name, value in figures.items()
        if name in asked
    ]


def _names_of(plant: Plant, trade: Trade) -> list[str]:
    """The requirements that the front shows as noise of the force, or as motion."""
    return [name for name, r in requirements_for(plant).items() if r.trade == trade]


def _beside_noise(spec: Spec, figures: Mapping[str, float]) -> float:
    """The worst ratio of what is no axis of the front."""
    asked = {k: v for k, v in _beside_trades(spec).items() if base_of(k) != "margin"}
    return max(_ratios(spec, figures, asked), default=0.0)


def _beside_trades(spec: Spec) -> dict[str, float]:
    """What is asked for beside noise and motion, which the front has against the margin."""
    free = {name for trade in TRADES for name in _names_of(spec.plant, trade)}
    return {k: v for k, v in spec.specification.items() if base_of(k) not in free}


def search_weights(
    spec: Spec, journal: Journal, effort: Effort, progress: Progress | None
) -> tuple[Trial, tuple[Trial, ...]]:
    """Find the trial with the smallest worst ratio, and the front about it.

    Raises InputError for a machine whose groups no LQG can be searched for, and for a variable without effect.
    """
    with without_limit():
        clusters = clusters_of(spec)
    journal.expect(_count_trials(clusters, spec, effort), progress)
    found: dict[float, list[tuple[TrialSearch, FloatArray]]] = {}
    for delay in spec.delays:
        found[delay] = []
        for search in (cluster_search(spec, cluster, delay, journal) for cluster in clusters):
            goal = partial(worst_ratio, search)
            u = search.evolve(goal, effort.generations)
            look = partial(_look_worst, search)
            found[delay].append((search, descend(look, u, BoundPenalty(), effort.polish * len(search.low))))
    worst = {delay: max(worst_ratio(s, u) for s, u in places) for delay, places in found.items()}
    # More states are worth it only where they help.
    delay = min(d for d, ratio in worst.items() if ratio <= 1.01 * min(worst.values()))
    trial = combine(spec, found[delay])
    return trial, _front(spec, found[delay], effort, trial)


def _count_trials(clusters: Sequence[_Cluster], spec: Spec, effort: Effort) -> int:
    """About how many trials there will be."""
    total = 0
    for cluster in clusters:
        k = len(cluster.variables)
        total += len(spec.delays) * (max(8 * k, 6) * (effort.generations + 1) + effort.polish * k)
        total += 2 * len(FRONT) * effort.front * k if "margin" in spec.specification else 0
    return total


def _front(
    spec: Spec, places: Sequence[tuple[TrialSearch, FloatArray]], effort: Effort, best: Trial
) -> tuple[Trial, ...]:
    """For margins about the one that is asked for: least force noise, least motion; margins then proven."""
    margin = spec.specification.get("margin")
    if margin is None or not effort.front:
        return ()
    trials = [best]
    for trade in TRADES:
        trials += frugal_trials(spec, places, trade, effort.front)
    proven = []
    for one in trials:
        if is_stopped():
            return ()  # which of them is better is not known
        if one.figures and (one is best or _beside_noise(spec, one.figures) <= 1.005):
            design = apply_trial(spec, one)
            bound = travel_margin(spec.plant, model_and_controller(design)[1], spec.uncertainty).lower
            proven.append(one._replace(figures=dict(one.figures) | {"margin": bound or 0.0}))
    return _best_of(spec, proven, best)


def frugal_trials(
    spec: Spec, places: Sequence[tuple[TrialSearch, FloatArray]], trade: Trade, polish: int
) -> Iterator[Trial]:
    """Descend to the least noise of the force, or motion, for one margin after the other; margins are estimates.

    places : where the searches of the design's parts begin
    polish : trials for each number, of one margin
    """
    margin = spec.specification["margin"]
    most = min(1 / share for share in spec.uncertainty.values()) - 2 * STEP
    around = [u for _, u in places]
    for share in FRONT:
        if is_stopped():
            return
        if share * margin > most:
            continue
        for k, (search, _) in enumerate(places):
            look = partial(_look_frugal, search, margin=share * margin, kinds=_names_of(spec.plant, trade))
            around[k] = descend(look, around[k], NOISE_PENALTY, polish * len(search.low))
        yield combine(spec, [(s, u) for (s, _), u in zip(places, around, strict=True)])


def _best_of(spec: Spec, trials: Sequence[Trial], best: Trial) -> tuple[Trial, ...]:
    """Those that no other beats in the margin and in the first figures of force and motion, by margin; and `best`."""
    unique: dict[tuple[float, ...], Trial] = {}
    for one in trials:  # what is equal to three digits counts once
        sizes = [-one.figures["margin"]]
        for trade in TRADES:
            names = _names_of(spec.plant, trade)
            sizes += [value for name, value in one.figures.items() if base_of(name) in names][:1]
        unique.setdefault(tuple(float(f"{size:.3g}") for size in sizes), one)
    every = np.array(list(unique))
    undominated = [
        one for mine, one in zip(every, unique.values(), strict=True)
        if one.values == best.values or not ((every <= mine).all(axis=1) & (every < mine).any(axis=1)).any()
    ]  # fmt: skip
    return tuple(sorted(undominated, key=lambda one: one.figures["margin"]))


@display
@dataclass(frozen=True, eq=False)
class TuningResult:
    """What a search found."""

    spec: Spec  # with the weights that were found
    trial: Trial
    requirements: tuple[Outcome, ...]  # none where the search was ended before they were judged
    front: tuple[Trial, ...]  # by margin: least bearing force noise, least motion; and the trial itself
    trials: int

    @property
    def reached(self) -> bool:
        """Whether every requirement holds that was judged."""
        return all(r.holds for r in self.requirements)

    @property
    def binding(self) -> Outcome:
        """What is nearest to its limit, or furthest beyond it."""
        return max(self.requirements, key=lambda r: r.ratio)

    @property
    def description(self) -> Description:
        """What was asked for, and what was found."""
        rows = tuple((outcome.verdict, str(outcome)) for outcome in self.requirements)
        word = "reached" if self.reached else "not reached"
        word = word if self.requirements else "not judged"
        return Description(f"Tuned {self.spec.name!r} in {self.trials} trials: {word}", rows)


def tune(
    spec: Spec,
    journal: Path | None = None,
    *,
    effort: Effort = Effort(),  # noqa: B008
    restart: bool = False,
    time: float | None = None,
    progress: Progress | None = None,
) -> TuningResult:
    """Search the numbers of [search] in a design file for the figures of [specification].

    spec : the design, from `malta.read_design`
    journal : file of the trials; what is in it is not computed again; None: none is written
    effort : generations of the search, trials that polish its best, and trials for the Pareto front
    restart : forget what is in the journal
    time : s, of the search, whose best design is then judged; None: as long as `effort` takes
    progress : called with the share of the work that is done, 0 to 1

    Returns a Tuned: the `spec` with the numbers that were found, its `requirements`, and the Pareto `front`.

    Raises InputError when the design file asks for nothing or lets nothing vary, for a dead time that no margin can be
    proven with, and when the journal is that of another search.

    >>> import malta
    >>> from malta.tuning.search import Effort
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> tuned = malta.tune(spec, effort=Effort(generations=4, polish=10, front=0))
    >>> tuned.reached, [requirement.name for requirement in tuned.requirements]
    (True, ['margin', 'peak_sensitivity', 'motion y', 'force_noise f'])
    """
    if spec.structure is not None:
        raise InputError(
            spec.path, "structure", "a law of elements", "malta.structured.tune_design, which tunes them"
        )
    if not spec.specification:
        raise InputError(spec.path, "specification", "nothing", "a table of what the design shall reach")
    if not spec.search:
        raise InputError(spec.path, "search", "nothing", "a table of the numbers that may vary")
    if "margin" in spec.specification and is_driven(spec):
        whole_samples(spec.plant, spec.sample_time)  # before the search, which a proof follows
    trials = Journal(journal, problem_sha256(spec), restart=restart)
    search = pid.search_gains if spec.pid else search_weights
    with count_work(math.inf, time):
        trial, front = search(spec, trials, effort, progress)
    chosen = apply_trial(spec, trial)
    requirements = () if is_stopped() else judge(chosen)
    if progress is not None:
        progress(1.0)
    return TuningResult(chosen, trial, requirements, front, len(trials.known))


def problem_sha256(spec: Spec) -> str:
    """Digest everything that the figures of a trial depend on, and what is searched."""
    asked, searched = dict(spec.specification), (spec.search, spec.delays)
    loads = asdict(spec.loads) if spec.loads else None
    pushes = [asdict(bound) for bound in spec.recovery.values()]
    settings = (FRONT, DIGITS, groups.STEP, groups.CORNER_FACTOR)
    content: list[Any] = [describe(spec.parameters), asked, loads, pushes, searched, spec.sha256, *settings]
    if spec.plant.over:
        content.append(sorted(spec.plant.over.items()))
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()
