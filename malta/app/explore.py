"""Designs from the one that the page shows: what `malta tune` finds on its way, and the front of margin against noise.

The searches are those of `malta.tuning`, begun at the numbers of the page. Each design that they come by is yielded
with its picture as soon as it is found. Figures of a search are estimates; a margin of the front is proven.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import replace
from itertools import chain
from typing import Any, NamedTuple

from malta.app.files import DesignFiles, Edited
from malta.app.picture import Problem, View, picture, solve
from malta.errors import InputError
from malta.margins.travel import travel_margin
from malta.synthesis.requirements import ratio_of, requirements_for
from malta.synthesis.spec import Spec, Variable
from malta.tuning.pid import LEAST, ROOM, STEEP, load_error, name_of, search_gains
from malta.tuning.search import Effort, Journal, Progress, Trial, apply_trial, at_least_of, base_of
from malta.tuning.tune import cluster_search, clusters_of, frugal_trials, search_weights

POLISH = (
    0,
    1,
    2,
    4,
    8,
    16,
    40,
)  # trials for each number, of one search after the other: the page's own, then better ones
LEAST_GAIN = 1e-3  # of the logarithm that a search makes small, from one candidate to the next
ALONG = 4  # trials for each number, of a point of the front
EASED = (1.4, 1.2, 1.1, 1.0, 0.9, 0.8, 0.7)  # of the peak sensitivity that a PID may have, along its front
SLACK = 0.005  # of a requirement, beyond which a point of the front misses it
PRICES = (
    "command noise",
    "moved by",
)  # of a margin, as the figures of the picture are named: of an LQG, of a PID
LONGEST = 20.0  # s, of the proof of a point of the front


class Search(NamedTuple):
    """What a search begins with, and what it reports to."""

    files: DesignFiles
    edited: Edited
    view: View
    progress: Progress  # called at each trial; what it raises ends the search


def searched_spec(files: DesignFiles, edited: Edited) -> Spec:
    """The design of the page with what may vary: the numbers of [search], else the sliders of the page's first group.

    Raises InputError for a machine that differs from the one that is designed for, and for a law of [structure].
    """
    spec = edited.spec
    if spec.structure is not None:
        expected = "`malta tune`, which tunes elements until their proof closes"
        raise InputError(spec.path.name, "structure", "a law of elements", expected)
    if edited.truth != spec.parameters:
        found, expected = "a machine that differs from the design's", "a design for the machine's numbers"
        raise InputError(spec.path.name, "search", found, expected)
    if spec.search:
        return spec
    chosen = {f.tuning: f for f in files.fields.values() if f.tuning}
    variables = tuple(Variable(name, f.linked, f.low, f.high, f.unit) for name, f in chosen.items())
    return replace(spec, search=variables)


def candidates(search: Search) -> Iterator[dict[str, Any]]:
    """Designs that come nearer to [specification], from the design of the page on, each better than the one before.

    Raises InputError as `malta.tune`.
    """
    spec = searched_spec(search.files, search.edited)
    if not spec.specification:
        raise InputError(spec.path.name, "specification", "nothing", "a table of what the design shall reach")
    journal, find, best = Journal(None, "", restart=False), search_gains if spec.pid else search_weights, None
    efforts = [Effort(0, polish, 0) for polish in POLISH] + [Effort(Effort().generations, POLISH[-1], 0)]
    for effort in efforts:  # each goes over the trials of the one before, which the journal holds
        trial, _ = find(spec, journal, effort, search.progress)
        badness = _badness(spec, trial)
        if best is not None and badness < best - LEAST_GAIN:
            name, ratio = nearest_limit(spec, trial)
            problem = solve(Edited(apply_trial(spec, trial), search.edited.truth))
            yield _document(search, spec, trial, problem) | {
                "limit": name,
                "ratio": ratio,
                "trials": len(journal.known),
            }
        best = badness if best is None else min(best, badness)


def front(search: Search) -> Iterator[dict[str, Any]]:
    """Designs of least noise for margins about the one that is asked for; of a PID, of least errors under loads.

    Raises InputError as `malta.tune`, and for a design that asks for neither.
    """
    spec = searched_spec(search.files, search.edited)
    asked = "peak_sensitivity" if spec.pid else "margin"
    if asked not in spec.specification:
        raise InputError(
            spec.path.name, f"specification.{asked}", "nothing", "a bound: the front is about it"
        )
    if not spec.uncertainty:
        raise InputError(
            spec.path.name, "uncertainty", "nothing", "parameters that vary: a margin is of their box"
        )
    axes = {"margin", asked} | {name for name, r in requirements_for(spec.plant).items() if r.trade}
    free = axes if spec.pid is None else {"margin", asked}
    own = Trial(tuple(spec.value_of(v) for v in spec.search), spec.delay, {})
    seen = set[tuple[float, ...]]()
    for trial in chain([own], _trials_of_pid(spec, search) if spec.pid else _trials_of_lqg(spec, search)):
        if trial.values in seen or not (trial.figures or trial is own):
            continue
        seen.add(trial.values)
        design = apply_trial(spec, trial)
        problem = solve(Edited(design, search.edited.truth))
        margin = travel_margin(
            problem.plant,
            problem.controller,
            design.uncertainty,
            time=LONGEST,
            progress=lambda *_: search.progress(0.0),
        )
        name, ratio = nearest_limit(spec, trial, free)
        misses = {"limit": name, "ratio": ratio} if ratio > 1 + SLACK else {}
        found = {"margin": margin.lower, "reason": margin.reason, "price": PRICES[spec.pid is not None]}
        yield _document(search, spec, trial, problem) | found | misses


def _trials_of_lqg(spec: Spec, search: Search) -> Iterator[Trial]:
    """The least noise of the inputs for shares of the margin that is asked for, upwards from the smallest."""
    journal = Journal(None, "", restart=False)
    journal.expect(1, search.progress)
    found = (cluster_search(spec, cluster, spec.delay, journal) for cluster in clusters_of(spec))
    yield from frugal_trials(spec, [(one, one.start) for one in found], "force", ALONG)


def _trials_of_pid(spec: Spec, search: Search) -> Iterator[Trial]:
    """The smallest errors under loads for multiples of the peak sensitivity that is asked for."""
    journal, asked = Journal(None, "", restart=False), spec.specification
    for share in EASED:
        bound = {"peak_sensitivity": 1 + share * (asked["peak_sensitivity"] - 1)}
        eased = replace(spec, specification={**asked, **bound})
        yield search_gains(eased, journal, Effort(0, ALONG, 0), search.progress)[0]


def nearest_limit(spec: Spec, trial: Trial, free: Collection[str] = ()) -> tuple[str, float]:
    """The requirement that a trial's figures are nearest to, or furthest beyond, and the ratio; ("", LEAST) for none.

    free : requirements that do not count
    """
    at_least = at_least_of(spec.plant)
    asked = {name: bound for name, bound in spec.specification.items() if base_of(name) not in free}
    found: dict[str, float] = {}
    for figure, value in trial.figures.items():
        name = name_of(figure)
        bound = asked.get(figure, asked.get(name, asked.get(base_of(name))))
        if bound is not None:
            ratio = ratio_of(bound, value, at_least=base_of(name) in at_least)
            found[base_of(name)] = max(found.get(base_of(name), 0.0), ratio)
    worst = max(found, key=found.__getitem__, default="")
    return worst, found.get(worst, LEAST)


def _badness(spec: Spec, trial: Trial) -> float:
    """What a search makes small: the logarithm of the worst ratio; of a PID that of its errors, bounds being held."""
    beyond = math.log(nearest_limit(spec, trial)[1]) if trial.figures else math.inf
    if spec.pid is None or not trial.figures:
        return beyond
    return math.log(load_error(trial.figures)) + STEEP * max(beyond - 2 * ROOM, 0.0)


def _document(search: Search, spec: Spec, trial: Trial, problem: Problem) -> dict[str, Any]:
    """A design that was found: its numbers in the units of the file, and its picture."""
    fields, values = search.files.fields, dict[str, float]()
    for variable, value in zip(spec.search, trial.values, strict=True):
        for key in variable.entries:
            values[key] = float(f"{value * fields[key].factor:.12g}")
    if spec.pid is None:
        values["delay"] = trial.delay
    return {"values": values, "picture": picture(problem, search.view)}


TASKS = {"tune": candidates, "front": front}
