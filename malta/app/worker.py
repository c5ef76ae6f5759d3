"""The process that follows a design: its nonlinear run, its requirements, the proof of its margin, searches from it.

`python -m malta.app.worker` reads one JSON document a line and answers with lines of its own. A newer document ends the
work on an older one, at the next step of that work. The process ends with its standard input.
"""

from __future__ import annotations

import json
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from malta.app.explore import TASKS, Search
from malta.app.files import DesignFiles, Edited, fingerprint, open_design
from malta.app.followers import describe_error, failed_document
from malta.app.picture import (
    Problem,
    View,
    curves,
    map_document,
    margin_document,
    planned_run,
    solve,
)
from malta.errors import CheckError, InputError, shorten
from malta.margins.loop_report import Outcome
from malta.margins.travel import travel_loops, travel_margin
from malta.proof.loss import ray_bound
from malta.simulation.simulate import simulate
from malta.synthesis.requirements import judge_figure, proven_margin
from malta.tuning.verify import SynthesizedDesign, outcomes_of

LONGEST = 120.0  # s, of a proof

Message = Mapping[str, Any]
Newer = Callable[[], bool]


class SupersededError(Exception):
    """A newer design is waiting."""


def replies(problem: Problem, truth: Edited, message: Message, newer: Newer) -> Iterator[dict[str, Any]]:
    """What follows a design, one document after the other: message["task"] is "check", "prove" or "map"."""
    if message["task"] == "prove":
        yield from _proof(problem, newer)
        return
    if message["task"] == "map":
        x, y, lost = message["plane"]
        yield {"kind": "map"} | map_document(problem, (x, y), lost)
        return
    if message["margin"] and problem.spec.uncertainty:
        loops, over = travel_loops(problem.plant, problem.controller, tuple(problem.spec.uncertainty))
        yield {"kind": "margin"} | margin_document(ray_bound(loops, problem.spec.uncertainty, over))
    yield _simulate(problem, View(run=message["run"]))
    yield from _requirements(problem, truth)


def _simulate(problem: Problem, view: View) -> dict[str, Any]:
    """The chosen run by the nonlinear simulation."""
    try:
        name, planned = planned_run(problem.plant, problem.controller, view.run)
        run = simulate(problem.plant, problem.controller, planned.scenario)
    except (InputError, CheckError) as error:
        return {"kind": "run", "error": str(error)}
    found = curves(name, run.t, run.reference, run.p, run.v)
    verdict = {"verdict": run.verdict.name, "end": run.verdict.time, "completed": run.verdict.completed}
    return {"kind": "run", "engine": run.engine, "label": planned.label} | found | verdict


def _requirements(problem: Problem, edited: Edited) -> Iterator[dict[str, Any]]:
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


def _proof(problem: Problem, newer: Newer) -> Iterator[dict[str, Any]]:
    """The margin over the travel with its proof."""
    box = problem.spec.uncertainty
    if not box:
        yield {"kind": "proof", "lower": None, "reason": "the design file has no uncertainty"}
        return
    margin = travel_margin(problem.plant, problem.controller, box, time=LONGEST, progress=_end_if(newer))
    upper = margin.upper if math.isfinite(margin.upper) else None
    asked = problem.spec.specification.get("margin")
    yield {
        "kind": "proof",
        "lower": margin.lower,
        "holds": None
        if asked is None
        else judge_figure(proven_margin(margin), asked, at_least=True) == "holds",
        "upper": upper,
        "frequency": margin.frequency,
        "at": dict(margin.witness or {}),
        "reason": margin.reason,
        "seconds": margin.seconds,
    }


def _end_if(newer: Newer) -> Callable[..., None]:
    """The progress of a search that ends where a newer design is waiting."""

    def look(*_bounds: float) -> None:
        if newer():
            raise SupersededError

    return look


def _explore(opened: DesignFiles, edited: Edited, message: Message, newer: Newer) -> Iterator[dict[str, Any]]:
    """Designs that a search comes by, each with its number; the last document says that it ended."""
    search = Search(opened, edited, View(message["run"], message["load"]), _end_if(newer))
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
