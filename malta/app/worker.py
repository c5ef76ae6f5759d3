"""The process that follows a design: its nonlinear run, its requirements, its proofs, searches from it.

`python -m malta.app.worker` reads one JSON document a line and answers with lines of its own. A newer document ends the
work on an older one, at the next step of that work. The process ends with its standard input.

Designs from the one that the page shows: what `malta tune` finds on its way, and the front of margin against noise.

The searches are those of `malta.tuning`, begun at the numbers of the page. Each design that they come by is yielded
with its picture as soon as it is found. Figures of a search are estimates; a margin of the front is proven.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple, TextIO

from malta.app.files import DesignFiles, Edited, fingerprint, open_design
from malta.app.followers import describe_error, failed_document
from malta.app.picture import (
    PictureSubject,
    View,
    curves,
    map_document,
    margin_document,
    picture,
    planned_run,
    solve,
)
from malta.errors import CheckError, InputError, shorten
from malta.margins.outcome import Outcome
from malta.margins.travel import travel_loops, travel_margin
from malta.proof.loss import ray_bound
from malta.simulation.simulate import simulate
from malta.synthesis.requirements import base_of, judge_figure, proven_margin, ratio_of, requirements_for
from malta.synthesis.spec import Spec, Variable
from malta.tuning.outcomes import SynthesizedDesign, outcomes_of
from malta.tuning.pid import BOUND_COST, MIN_BOUND_RATIO, ROOM, load_error, name_of, search_gains
from malta.tuning.search import Effort, Journal, Progress, Trial, apply_trial, at_least_of
from malta.tuning.tune import cluster_search, clusters_of, frugal_trials, search_weights
from malta.work import count_work

# Trials for each number, of one search after the other: the page's own, then better ones.
POLISH = (0, 1, 2, 4, 8, 16, 40)
LEAST_GAIN = 1e-3  # of the logarithm that a search makes small, from one candidate to the next
TRIALS_ALONG_FRONT = 4  # trials for each number, of a point of the front
PEAKS_ASKED = (1.4, 1.2, 1.1, 1.0, 0.9, 0.8, 0.7)  # of the peak sensitivity of PIDs along the front
SLACK = 0.005  # of a requirement, beyond which a point of the front misses it
PRICES = ("command noise", "moved by")  # of a margin, named as figures of the picture: of an LQG, of a PID
SAFE_TIME = 10.0  # s, of the proofs of loads of any waveform
POINT_WORK = 20.0  # of the proof of a point of the front


class TuningRequest(NamedTuple):
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


def candidates(search: TuningRequest) -> Iterator[dict[str, Any]]:
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


def front(search: TuningRequest) -> Iterator[dict[str, Any]]:
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
        with count_work(POINT_WORK):
            margin = travel_margin(
                problem.plant,
                problem.controller,
                design.uncertainty,
                progress=lambda *_: search.progress(0.0),
            )
        name, ratio = nearest_limit(spec, trial, free)
        misses = {"limit": name, "ratio": ratio} if ratio > 1 + SLACK else {}
        found = {
            "margin": margin.lower,
            "proven": margin.proven.percent(),
            "reason": margin.reason,
            "price": PRICES[spec.pid is not None],
        }
        yield _document(search, spec, trial, problem) | found | misses


def _trials_of_lqg(spec: Spec, search: TuningRequest) -> Iterator[Trial]:
    """The least noise of the inputs for shares of the margin that is asked for, upwards from the smallest."""
    journal = Journal(None, "", restart=False)
    journal.expect(1, search.progress)
    found = (cluster_search(spec, cluster, spec.delay, journal) for cluster in clusters_of(spec))
    yield from frugal_trials(spec, [(one, one.start) for one in found], "force", TRIALS_ALONG_FRONT)


def _trials_of_pid(spec: Spec, search: TuningRequest) -> Iterator[Trial]:
    """The smallest errors under loads for multiples of the peak sensitivity that is asked for."""
    journal, asked = Journal(None, "", restart=False), spec.specification
    for share in PEAKS_ASKED:
        bound = {"peak_sensitivity": 1 + share * (asked["peak_sensitivity"] - 1)}
        eased = replace(spec, specification={**asked, **bound})
        yield search_gains(eased, journal, Effort(0, TRIALS_ALONG_FRONT, 0), search.progress)[0]


def nearest_limit(spec: Spec, trial: Trial, free: Collection[str] = ()) -> tuple[str, float]:
    """The requirement that a trial is nearest to, or furthest beyond, and the ratio; else "", MIN_BOUND_RATIO.

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
    return worst, found.get(worst, MIN_BOUND_RATIO)


def _badness(spec: Spec, trial: Trial) -> float:
    """What a search makes small: the logarithm of the worst ratio; of a PID that of its errors, bounds being held."""
    beyond = math.log(nearest_limit(spec, trial)[1]) if trial.figures else math.inf
    if spec.pid is None or not trial.figures:
        return beyond
    return math.log(load_error(trial.figures)) + BOUND_COST * max(beyond - 2 * ROOM, 0.0)


def _document(search: TuningRequest, spec: Spec, trial: Trial, problem: PictureSubject) -> dict[str, Any]:
    """A design that was found: its numbers in the units of the file, and its picture."""
    fields, values = search.files.fields, dict[str, float]()
    for variable, value in zip(spec.search, trial.values, strict=True):
        for key in variable.entries:
            values[key] = float(f"{value * fields[key].factor:.12g}")
    if spec.pid is None:
        values["delay"] = trial.delay
    return {"values": values, "picture": picture(problem, search.view)}


TASKS = {"tune": candidates, "front": front}
Message = Mapping[str, Any]
Newer = Callable[[], bool]


class SupersededError(Exception):
    """A newer design is waiting."""


def replies(
    problem: PictureSubject, truth: Edited, message: Message, newer: Newer
) -> Iterator[dict[str, Any]]:
    """What follows a design, one document after the other: message["task"] is "check", "prove" or "map"."""
    if message["task"] == "prove":
        yield from _proof(problem, newer)
        yield from _safe_loads(problem)
        return
    if message["task"] == "map":
        x, y, lost = message["plane"]
        yield {"kind": "map"} | map_document(problem, (x, y), lost)
        return
    if message["margin"] and problem.spec.uncertainty:
        loops, over = travel_loops(problem.plant, problem.controller, tuple(problem.spec.uncertainty))
        yield {"kind": "margin"} | margin_document(ray_bound(loops, problem.spec.uncertainty, over))
    yield _simulate(problem, View(message["run"], message["load"]))
    yield from _requirements(problem, truth)


def _simulate(problem: PictureSubject, view: View) -> dict[str, Any]:
    """The chosen run by the nonlinear simulation."""
    try:
        name, planned = planned_run(problem.plant, problem.controller, view.run, view.load)
        run = simulate(problem.plant, problem.controller, planned.scenario)
    except (InputError, CheckError) as error:
        return {"kind": "run", "error": str(error)}
    found = curves(name, run.t, run.reference, run.p, run.v)
    verdict = {"verdict": run.verdict.words, "end": run.verdict.time, "completed": run.verdict.completed}
    return {"kind": "run", "engine": run.engine, "label": planned.label} | found | verdict


def _requirements(problem: PictureSubject, edited: Edited) -> Iterator[dict[str, Any]]:
    """The outcome of each requirement but the margin, on the machine that the design runs on."""
    asked = {name: bound for name, bound in problem.spec.specification.items() if name != "margin"}
    spec = replace(problem.spec, specification=asked, parameters=edited.truth)
    design = SynthesizedDesign(spec, problem.model, problem.controller)
    for name in asked:
        try:
            yield {"kind": "requirement", "name": name} | outcome_document(outcomes_of(design, name))
        except (InputError, CheckError) as error:
            yield {"kind": "requirement", "name": name, "holds": None, "how": str(error)}


def outcome_document(outcomes: list[Outcome]) -> dict[str, Any]:
    """The figure of a requirement that is nearest to its bound, or furthest beyond it; "holds" is null if undecided."""
    worst = max(outcomes, key=lambda o: (o.verdict == "fails", o.verdict == "undecided", o.ratio))
    found = worst.found if math.isfinite(worst.found) else None
    holds = None if worst.verdict == "undecided" else worst.holds
    how = f"{worst.how}, undecided" if holds is None else worst.how
    return {"holds": holds, "found": found, "how": how}


def _proof(problem: PictureSubject, newer: Newer) -> Iterator[dict[str, Any]]:
    """The margin over the travel with its proof."""
    box = problem.spec.uncertainty
    if not box:
        yield {"kind": "proof", "lower": None, "reason": "the design file has no uncertainty"}
        return
    margin = travel_margin(problem.plant, problem.controller, box, progress=_end_if(newer))
    upper = margin.upper if math.isfinite(margin.upper) else None
    asked = problem.spec.specification.get("margin")
    yield {
        "kind": "proof",
        "lower": margin.lower,
        "proven": margin.proven.percent(),
        "lost": margin.lost.percent(),
        "holds": None
        if asked is None
        else judge_figure(proven_margin(margin), asked, at_least=True) == "holds",
        "upper": upper,
        "frequency": margin.frequency,
        "at": dict(margin.witness or {}),
        "reason": margin.reason,
        "seconds": margin.seconds,
    }


def _safe_loads(problem: PictureSubject) -> Iterator[dict[str, Any]]:
    """Below which size each load touches nothing and saturates nothing, whatever its waveform, in SAFE_TIME."""
    if not (problem.loop.stable and problem.plant.disturbances):
        return
    from malta.margins.safe_loads import answers  # ball arithmetic, which a page opens without

    with count_work(math.inf, SAFE_TIME):
        found = [one for one, _ in answers(problem.loop, [s.name for s in problem.plant.disturbances])]
    texts = {one.disturbance: f"{one.proven.text(3)} {one.unit}" for one in found if one.limit is not None}
    yield {"kind": "safe", "loads": texts, "ends": {one.disturbance: one.ends for one in found}}


def _end_if(newer: Newer) -> Callable[..., None]:
    """The progress of a search that ends where a newer design is waiting."""

    def look(*_bounds: float) -> None:
        if newer():
            raise SupersededError

    return look


def _explore(opened: DesignFiles, edited: Edited, message: Message, newer: Newer) -> Iterator[dict[str, Any]]:
    """Designs that a search comes by, each with its number; the last document says that it ended."""
    search = TuningRequest(opened, edited, View(message["run"], message["load"]), _end_if(newer))
    count = 0
    for count, found in enumerate(TASKS[message["task"]](search), 1):
        yield {"kind": "candidate", "of": message["task"], "number": count} | found
    yield {"kind": "searched", "of": message["task"], "count": count}


def work(message: Message, opened: DesignFiles, newer: Newer) -> Iterator[dict[str, Any]]:
    """Solve the design of a message and follow it; an error is the last document."""
    if message["task"] == "stop":
        return
    try:
        edited = opened.apply(opened.edit(message["values"], redesign=message["redesign"]))
        if fingerprint(*edited) != message["design"]:
            raise CheckError(
                "the files of this design have changed since the page read them: start malta app again"
            )
        if message["task"] in TASKS:
            yield from _explore(opened, edited, message, newer)
        else:
            yield from replies(solve(edited), edited, message, newer)
        yield {"kind": "done"}
    except SupersededError:
        raise
    except Exception as error:
        yield failed_document(message["task"], shorten(describe_error(error)))


class _Inbox:
    """The newest line of standard input; the process ends where the input does."""

    def __init__(self) -> None:
        self.ready = threading.Condition()
        self.newest: Message | None = None
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for line in sys.stdin:
            with self.ready:
                self.newest = json.loads(line)
                self.ready.notify()
        os._exit(0)

    def take(self) -> Message:
        with self.ready:
            while self.newest is None:
                self.ready.wait()
            taken, self.newest = self.newest, None
            return taken


def main() -> None:
    """Answer documents until the input ends."""
    channel = take_channel()
    inbox, files = _Inbox(), dict[Any, DesignFiles]()

    def say(message: Message, reply: Mapping[str, Any]) -> None:
        """Write one document; numbers that are not finite become null before."""
        mark = {"version": message["version"], "serial": message["serial"]}
        print(json.dumps(mark | dict(reply), allow_nan=False, default=str), file=channel, flush=True)

    with suppress(AttributeError, OSError):
        os.nice(5)  # the page's own answers go first
    while True:
        message = inbox.take()
        say(message, {"kind": "begin"})
        try:
            if message["base"] not in files:
                files = {message["base"]: open_message(message)}
            for reply in work(message, files[message["base"]], lambda: inbox.newest is not None):
                if inbox.newest is not None:
                    break
                say(message, reply)
        except SupersededError:
            continue
        except Exception as error:
            say(message, failed_document(message["task"], shorten(describe_error(error))))
        say(message, {"kind": "end"})


def take_channel() -> TextIO:
    """The standard output, for answers alone: what Python or C prints from now on goes to the standard error."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    return channel


def open_message(message: Message) -> DesignFiles:
    """The files of a message, and the machine's module that its user named."""
    if message["machine"]:
        from malta.model.machines import machine

        machine(Path(message["machine"]))
    return open_design(Path(message["path"]))


if __name__ == "__main__":
    main()
