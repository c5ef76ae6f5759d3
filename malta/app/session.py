"""One design under edit, behind the page of `malta app` and the widget in a notebook.

Both send documents {"ask": ..., ...} and get documents back; `Session.answer` is the one door. The newest move wins: an
evaluation that a newer one overtook is dropped, and so is what follows it in worker processes.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from malta.app.answers import MARGIN, Answer, Answers
from malta.app.fields import is_number
from malta.app.files import (
    DesignFiles,
    Edit,
    TakenError,
    default_file,
    fingerprint,
    inside,
    is_design,
    open_design,
    save_design,
    save_gains,
)
from malta.app.followers import Worker, describe_error
from malta.app.picture import View, poles_document, run_names, solve
from malta.app.pull import Handle, Pull, compare_numbers, pull_to
from malta.errors import InputError, shorten
from malta.report.page.bodies import machine_svg
from malta.synthesis.curve_limits import curve_limits
from malta.synthesis.requirements import base_of, requirements_for
from malta.synthesis.spec import Spec

PAUSE_BEFORE_PROOF = 0.25  # s, after the last move until its proof begins
LONGEST_WAIT = 20.0  # s, of a question for news
KEPT_NEWS = 1000  # news of one version

LOST_TEXT = (
    "This design was opened in another tab or cell, which has it now. Reload the page to take it back here."
)

Document = dict[str, Any]


def _view_of(body: Mapping[str, Any]) -> View:
    """What a document of the page looks at beside the design."""
    return View(str(body.get("run", "")), str(body.get("load", "")))


class Session:
    """The state of a page: the files, the newest edit, and what follows it.

    design : the design file
    root : the folder that files may be saved in
    machine : the module that the user named for the machine, or None
    hear : called with each piece of news, from another thread; None: `news` is asked for them
    """

    def __init__(
        self,
        design: Path,
        root: Path,
        machine: Path | None = None,
        hear: Callable[[Document], None] | None = None,
    ) -> None:
        self.root, self.machine = root.resolve(), machine
        self.files: DesignFiles = open_design(design)
        self.edit = Edit()
        self._followed: Edit | None = None  # what the version is of
        self._hear = hear
        self._busy = threading.Lock()  # one evaluation at a time
        self._state = threading.Condition()
        self._newest, self._version, self._base = 0, 0, 0
        self._news: list[tuple[int, Document]] = []  # numbered
        self._count = 0
        self._slopes: tuple[Handle, View, dict[str, tuple[float, ...]]] | None = None  # of a pull
        self._answers = Answers()
        self._answer: tuple[int, Answer] | None = None  # to the newest evaluation, and its number
        self._timer: threading.Timer | None = None
        self._searched = -1  # the serial of the newest search
        self._serial, self._due = 0, set[str]()  # tasks that the workers are asked for when the page rests
        self._workers = {task: Worker(self._tell) for task in ("check", "prove", "map", "search")}
        self._plane: tuple[str, str] | None = None  # of the map that the page shows
        self._message: Callable[[], Document] | None = None  # of the design that the workers follow
        self._page: object = None  # that opened the design last: others have lost it

    # --- the door ---

    def answer(self, body: object) -> Document:
        """Answer a document of the page; what is wrong with it becomes {"error": sentence}."""
        doors: dict[str, Callable[[Mapping[str, Any]], Document]] = {
            "open": self.open,
            "evaluate": self.evaluate,
            "rest": self.rest,
            "news": self.news,
            "map": self.map,
            "search": self.search,
            "pull": self.pull,
            "designs": self.designs,
            "switch": self.switch,
            "save": self.save,
            "gains": self.gains,
        }
        try:
            ask = body.get("ask") if isinstance(body, dict) else None
            if not isinstance(body, dict) or not isinstance(ask, str) or ask not in doors:
                raise InputError("malta app", "ask", "another document", "one of " + ", ".join(doors))
            if ask != "open" and self._is_lost(body):
                return {"lost": LOST_TEXT}
            return doors[ask](body)
        except Exception as error:
            return {"error": shorten(describe_error(error))}

    # --- what the page asks ---

    def _is_lost(self, body: Mapping[str, Any]) -> bool:
        """Whether another page has opened the design since the one that sent a document."""
        return "page" in body and body["page"] != self._page

    def open(self, body: Mapping[str, Any]) -> Document:
        """Describe the design: fields, runs, disturbances, requirements, units. The page has the design from now on."""
        with self._state:
            self._page = body.get("page", self._page)
            self._state.notify_all()
        files, spec = self.files, self.files.spec
        problem = solve(files.apply(Edit()))
        return {
            "name": spec.name,
            "summary": spec.summary,
            "machine": spec.plant.name,
            "preset": spec.parameters.preset,
            "picture": machine_svg(spec.plant),
            "law": spec.kind,
            "file": default_file(self.root, files.path),
            "fields": [asdict(field) for field in files.fields.values()],
            "runs": run_names(problem.plant, problem.controller),
            "loads": [s._asdict() for s in spec.plant.disturbances],
            "inputs": [s._asdict() for s in spec.plant.inputs],
            "outputs": [s._asdict() for s in spec.plant.outputs],
            "parameters": dict(spec.uncertainty),
            "requirements": requirement_list(spec),
            "edit": {"values": dict(self.edit.values), "redesign": self.edit.redesign},
        }

    def evaluate(self, body: Mapping[str, Any]) -> Document:
        """The picture of an edit, with "missing" parts, which `rest` gives; {"stale": true} where a newer one was asked
        for meanwhile."""
        number = body.get("number")
        if not isinstance(number, int) or isinstance(number, bool):
            raise InputError("malta app", "number", repr(number), "a whole number")
        with self._state:
            self._newest = max(self._newest, number)
        with self._busy:
            if number < self._newest:
                return {"number": number, "stale": True}
            began, cpu = time.perf_counter(), time.thread_time()
            try:
                edit = self._edit_of(body)
            except InputError as error:
                self._followed = None
                return {"number": number, "version": self._supersede(), "error": shorten(str(error))}
            view = _view_of(body)
            same = edit == self._followed
            self.edit = self._followed = edit
            version = self._version if same else self._supersede()
            try:
                answer = self._answers.begin(solve(self.files.apply(edit)), view, cpu)
            except Exception as error:
                return {"number": number, "version": version, "error": shorten(describe_error(error))}
            tasks = {"check"} if same else {"check", "prove", *(["map"] if self._plane else [])}
            self._answer = number, answer
            self._follow_later(edit, tasks, answer)
            spent = {"wall": time.perf_counter() - began, "cpu": time.thread_time() - cpu}
            asked = {
                "requirements": requirement_list(answer.problem.spec),
                "limits": limit_list(answer.problem.spec),
            }
            given = {**answer.document, **asked, "missing": [*answer.missing], "seconds": spent}
            return {"number": number, "version": version, **given}

    def rest(self, body: Mapping[str, Any]) -> Document:
        """The parts that the answer to the evaluation body["number"] lacks; {"stale": true} after a newer one."""
        number = body.get("number")
        with self._busy:
            if self._answer is None or number != self._answer[0] or number < self._newest:
                return {"number": number, "stale": True}
            try:
                return {"number": number, **self._answers.complete(self._answer[1])}
            except Exception as error:
                return {"number": number, "error": shorten(describe_error(error))}

    def map(self, body: Mapping[str, Any]) -> Document:
        """Ask for the plane of two parameters, which follows as news; of body["at"], a point of it, the poles there."""
        names, at = (body.get("x"), body.get("y")), body.get("at")
        known = list(self.files.spec.uncertainty)
        if names[0] not in known or names[1] not in known or names[0] == names[1]:
            raise InputError("malta app", "map", repr(names), "two of " + " ".join(known))
        if at is None:
            with self._state:
                self._plane, message = (str(names[0]), str(names[1])), self._message
            if message is not None:
                self._workers["map"].ask(message() | {"task": "map"})
            return {"version": self._version}
        if not (isinstance(at, list) and len(at) == 2 and all(map(is_number, at))):
            raise InputError("malta app", "at", repr(at), "two numbers")
        with self._busy:
            problem = solve(self.files.apply(self.edit))
            point = {str(name): float(value) for name, value in zip(names, at, strict=True)}
            return {"version": self._version, **poles_document(problem, point)}

    def search(self, body: Mapping[str, Any]) -> Document:
        """Begin a search from the design of the page, body["task"] "tune" or "front", or end it, "stop".

        What it finds follows as news without a version: it goes on while the page moves.
        """
        task = body.get("task")
        if task not in ("tune", "front", "stop"):
            raise InputError("malta app", "task", repr(task), "tune, front or stop")
        edit = self._edit_of(body)
        edited = self.files.apply(edit)
        view = _view_of(body)
        return {"search": self._begin_search(edit, view, fingerprint(*edited), str(task))}

    def _begin_search(self, edit: Edit, view: View, design: str, task: str) -> int:
        """Send a search to its worker, which supersedes the one before; its serial."""
        with self._state:
            message = self._message_of(edit, view) | {"version": None, "task": task, "design": design}
            self._searched = int(message["serial"])
            self._news = [one for one in self._news if one[1]["version"] is not None]
        self._workers["search"].ask(message)
        return self._searched

    def pull(self, body: Mapping[str, Any]) -> Document:
        """The values with which the figure of body["kind"] and body["signal"] is body["asked"], SI: malta.app.pull."""
        asked = body.get("asked")
        if not is_number(asked) or asked <= 0:
            raise InputError("malta app", "asked", repr(asked), "a number above 0")
        with self._busy:
            edit = self._edit_of(body)
            handle = Handle(str(body.get("kind", "")), str(body.get("signal", "")))
            view = _view_of(body)
            one = Pull(self.files, edit, view, handle)
            known = self._slopes is not None and self._slopes[:2] == (handle, view)
            for fresh in (not known, True):  # numbers compared for another design may be wrong ones
                if fresh:
                    self._slopes = (handle, view, compare_numbers(one))
                assert self._slopes is not None
                found = pull_to(one, float(asked), self._slopes[2])
                if found["reached"] or found["at_end"] or fresh:
                    break
            return found

    def designs(self, _body: Mapping[str, Any]) -> Document:
        """The design files beside this one and in the folder of the page: name, folder, whether it has gain files."""
        found = self._found_designs()
        own = self.files.path.resolve()
        return {
            "designs": [
                {
                    "id": str(path),
                    "name": path.stem,
                    "folder": default_file(self.root, path).rpartition("/")[0],
                    "gains": (path.parent / "gains" / f"{path.stem}.json").is_file(),
                    "open": path == own,
                }
                for path in found
            ]
        }

    def _found_designs(self) -> list[Path]:
        own = self.files.path.resolve()
        folders = dict.fromkeys([own.parent, self.root, self.root / "design"])
        paths = dict.fromkeys([own, *(p for folder in folders for p in sorted(folder.glob("*.toml")))])
        return [path for path in paths if path == own or (path.resolve() == path and is_design(path))]

    def switch(self, body: Mapping[str, Any]) -> Document:
        """Open another of `designs`, body["id"]; {"unsaved": entries} where body["discard"] is not true.

        Raises InputError as `malta.read_design`; the page then stays with its design.
        """
        chosen = [path for path in self._found_designs() if str(path) == body.get("id")]
        if not chosen:
            raise InputError("malta app", "id", repr(body.get("id")), "one of the designs that are listed")
        with self._busy:
            unsaved = self.unsaved_changes()
            if unsaved and body.get("discard") is not True:
                return {"unsaved": unsaved}
            files = open_design(chosen[0])
            solve(files.apply(Edit()))
            self._begin_search(Edit(), View(), "", "stop")
            self.files, self.edit, self._followed = files, Edit(), None
            self._base += 1
            self._plane = self._slopes = self._answer = None
            self._answers = Answers()
            self._supersede()
            return {"open": self.open({})}

    def news(self, body: Mapping[str, Any]) -> Document:
        """News that are newer than body["after"], as soon as there are some; none after LONGEST_WAIT."""
        after = body.get("after", 0)
        if not isinstance(after, int):
            raise InputError("malta app", "after", repr(after), "a whole number")
        with self._state:
            self._state.wait_for(lambda: self._count > after or self._is_lost(body), LONGEST_WAIT)
            if self._is_lost(body):
                return {"lost": LOST_TEXT}
            return {"after": self._count, "news": [item for number, item in self._news if number > after]}

    def save(self, body: Mapping[str, Any]) -> Document:
        """Save the design; {"exists": files} where these exist and body["replace"] is not true."""
        with self._busy:
            edit = self._edit_of(body)
            target = inside(self.root, str(body.get("file", "")))
            try:
                self.files, written = save_design(
                    self.files, edit, target, self.root, replace=body.get("replace") is True
                )
            except TakenError as taken:
                return {"exists": taken.files}
            self._base += 1
            followed = edit == self._followed  # or another page asked for another design meanwhile
            self.edit = Edit() if edit.redesign else Edit(_machine_values(edit), redesign=False)
            self._followed = self.edit if followed else None
            return {"written": written, "open": self.open({})}

    def gains(self, body: Mapping[str, Any]) -> Document:
        """Write the gain files of the saved design, as `malta design` does; {"exists": files} as `save`.

        Refused while something is unsaved.
        """
        if self.unsaved_changes():
            raise InputError(
                "gain files", "design", "changes that are not saved", "a design file that is saved"
            )
        target = inside(self.root, default_file(self.root, self.files.path))
        if not target.is_file():
            raise InputError(
                "gain files", "design", "a design file outside of this folder", "one that is saved here"
            )
        try:
            return {
                "written": save_gains(target, self.root, self.machine, replace=body.get("replace") is True)
            }
        except TakenError as taken:
            return {"exists": taken.files}

    def unsaved_changes(self) -> list[str]:
        """The entries that differ from the file; parameters that the machine alone has are no part of the design."""
        edit = self.edit
        return list(edit.values) if edit.redesign else list(edit.design)

    def close(self) -> None:
        """End the worker processes."""
        if self._timer is not None:
            self._timer.cancel()
        for worker in self._workers.values():
            worker.close()

    # --- what follows ---

    def _supersede(self) -> int:
        """A new version: what followed the last one counts no longer."""
        with self._state:
            if self._timer is not None:
                self._timer.cancel()
            self._due.clear()
            self._news = [one for one in self._news if one[1]["version"] is None]
            self._version += 1
            return self._version

    def _follow_later(self, edit: Edit, tasks: set[str], answer: Answer) -> None:
        """Ask the workers for these tasks, and for those that are due, once the page rests."""
        with self._state:
            begun = self._message_of(edit, answer.view)

        def message() -> Document:
            plane = [*(self._plane or ()), self._answers.lost]
            return begun | {"design": answer.design, "margin": MARGIN in answer.missing, "plane": plane}

        self._message = message

        def ask() -> None:
            with self._state:
                due = [task for task in self._workers if task in self._due]
                self._due.clear()
            for task in due:
                self._workers[task].ask(message() | {"task": task})

        with self._state:
            if self._timer is not None:
                self._timer.cancel()
            self._due |= tasks
            self._timer = threading.Timer(PAUSE_BEFORE_PROOF, ask)
            self._timer.daemon = True
            self._timer.start()

    def _edit_of(self, body: Mapping[str, Any]) -> Edit:
        """The edit that a document of the page asks for."""
        return self.files.edit(body.get("values", {}), redesign=body.get("redesign", True))

    def _message_of(self, edit: Edit, view: View) -> Document:
        """A document for a worker, but for its task and the fingerprint of the design."""
        self._serial += 1
        return {
            "version": self._version,
            "serial": self._serial,
            "base": self._base,
            "path": str(self.files.path.resolve()),
            "machine": None if self.machine is None else str(self.machine.resolve()),
            "values": dict(edit.values),
            "redesign": edit.redesign,
            "run": view.run,
            "load": view.load,
        }

    def _tell(self, reply: Document) -> None:
        """Take a document of a worker, unless it is of an older version or of an older search."""
        with self._state:
            if reply["version"] is None and reply["serial"] != self._searched:
                return
            if reply["version"] not in (None, self._version):
                return
            self._count += 1
            self._news = [*self._news, (self._count, reply)][-KEPT_NEWS:]
            self._state.notify_all()
        if self._hear is not None:
            self._hear(reply)


def requirement_list(spec: Spec) -> list[Document]:
    """What the design is asked for: name, bound, unit, side."""
    known, rows = requirements_for(spec.plant), []
    for name, asked in spec.specification.items():
        requirement, signal = known[base_of(name)], name.partition(" ")[2]
        rows.append(
            {
                "name": name,
                "asked": asked if math.isfinite(asked) else None,
                "unit": requirement.unit_of(spec, signal),
                "frequency": requirement.unit == "rad/s",
                "at_least": requirement.at_least,
                "switch": requirement.form == "switch",
            }
        )
    return rows


def limit_list(spec: Spec) -> list[Document]:
    """The regions that requirements exclude, with the fields of the page that hold their bounds; null: without end."""
    return [
        limit._asdict()
        | {
            "words": limit.words,
            "high": limit.high if math.isfinite(limit.high) else None,
            "asked": spec.specification[limit.entry],
            "field": "specification." + limit.entry.replace(" ", "."),
        }
        for limit in curve_limits(spec)
    ]


def _machine_values(edit: Edit) -> Document:
    return {key: value for key, value in edit.values.items() if key not in edit.design}
