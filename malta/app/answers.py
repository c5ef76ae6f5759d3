"""Answers to a move in two parts: at once what takes little time, the rest when the page asks for it.

A part of a picture that would make an answer late, by what it took the last time, is left out of it, and so are those
that come after it. Numbers are those of the whole picture: nothing is rounded or thinned to be early.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from malta.app.files import fingerprint
from malta.app.picture import PARTS, PictureSubject, View, add_part, eigenvalue_margin, first_picture
from malta.model.plant import Parameters

LONGEST_ANSWER_TIME = 0.07  # s of processor time, beyond which no answer is taken by a further part
TIME_DECAY = 0.9  # of what a part took, at each answer that goes without it: a busy computer is so no longer
MARGIN = "margin"


@dataclass(frozen=True, eq=False)
class Answer:
    """A picture that may lack parts, `missing`; the eigenvalue margin is None where it is left out."""

    problem: PictureSubject
    view: View
    new: bool  # whether the machine is another than that of the answer before
    document: dict[str, Any] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)

    @cached_property
    def design(self) -> str:
        """The fingerprint of the design."""
        return fingerprint(self.problem.spec, self.problem.plant.parameters)


class Answers:
    """What is known from one answer to the next: how long parts take, and the ray of the last eigenvalue margin."""

    def __init__(self) -> None:
        self.lost = 1.0  # the last eigenvalue margin
        self._ray: tuple[int, float] | None = None  # of it
        self._takes = dict[tuple[str, bool], float]()  # s of processor time of a part, new machine or not
        self._traced: Parameters | None = None  # of the machine of the last answer

    def begin(self, problem: PictureSubject, view: View, began: float) -> Answer:
        """What a picture opens with, and its parts while there is time; all of them of an unstable loop.

        began : of time.thread_time
        """
        machine = problem.plant.parameters
        found = Answer(problem, view, machine != self._traced, first_picture(problem) | {MARGIN: None})
        for name in (*PARTS, MARGIN):
            takes = 0.0 if self._traced is None else self._takes.get((name, found.new), 0.0)
            late = found.document["stable"] and time.thread_time() - began + takes > LONGEST_ANSWER_TIME
            if found.missing or late:
                found.missing.append(name)
            else:
                self._add(found, name)
            if found.missing == [name]:
                self._takes[name, found.new] = TIME_DECAY * takes
        self._traced = machine
        return found

    def complete(self, found: Answer) -> dict[str, Any]:
        """The parts that an answer lacks, but for an eigenvalue margin that takes long by itself: it stays missing."""
        asked, rest = [*found.missing], {}
        found.missing.clear()
        for name in asked:
            if name == MARGIN and self._takes.get((name, found.new), 0.0) > LONGEST_ANSWER_TIME:
                found.missing.append(name)
                continue
            self._add(found, name)
            rest[name] = found.document[name]
        return rest

    def _add(self, found: Answer, name: str) -> None:
        began = time.thread_time()
        if name == MARGIN:
            self._add_margin(found)
        else:
            add_part(found.document, name, found.problem, found.view)
        if self._traced is not None:  # the first answer traces the machine
            self._takes[name, found.new] = time.thread_time() - began

    def _add_margin(self, found: Answer) -> None:
        margin = found.document[MARGIN] = eigenvalue_margin(found.problem, self._ray)
        if margin is not None and margin["upper"] is not None:
            self._ray, self.lost = (margin["ray"], margin["upper"]), margin["upper"] or self.lost
