"""What every search of a design's numbers has: trials, their journal, and the cube that they are points of.

The numbers of [search] are the unit cube, by their logarithms. Values are rounded to five digits before they are tried,
so that the file that is written has the figures that were found. Every trial is kept in a journal. A search that was
interrupted goes through the same trials again, reads them from there, and ends with the same file.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import StrictFloat, StrictStr, TypeAdapter
from scipy import optimize, sparse

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.files import file_exists, read_file
from malta.model.linearize import LinearModel, linearize
from malta.model.plant import Plant
from malta.synthesis.controller import Controller
from malta.synthesis.requirements import base_of, requirements_for
from malta.synthesis.spec import Spec
from malta.synthesis.synthesize import synthesize
from malta.work import WorkUp, check_clock, without_limit
from malta.writing import replace_files

Progress = Callable[[float], None]
DIGITS = 5  # significant, of what is tried and written
UNSTABLE_RATIO = 1e3  # ratio that stands for no figures at all


class Trial(NamedTuple):
    """Numbers that were tried, in the units of the search's variables, and the linear figures that they give."""

    values: tuple[float, ...]
    delay: float
    figures: Mapping[str, float]


class Effort(NamedTuple):
    """How long to search."""

    generations: int = 8  # of differential evolution
    polish: int = 40  # trials for each variable, of the best point
    front: int = 12  # and of each point of the front


def apply_trial(spec: Spec, trial: Trial) -> Spec:
    """Return the design with the numbers of a trial."""
    return replace(spec.vary(trial.values), delay=trial.delay)


def model_and_controller(spec: Spec) -> tuple[LinearModel, Controller]:
    """Linearize the machine at the design's operating point, and synthesize the controller."""
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    return model, synthesize(spec, model, solver="scipy")


def at_least_of(plant: Plant) -> frozenset[str]:
    """Name the requirements that bound from below."""
    return frozenset(name for name, r in requirements_for(plant).items() if r.at_least)


def merge(parts: Sequence[Mapping[str, float]], at_least: Collection[str]) -> dict[str, float]:
    """Take the worst of every figure: the smallest of those that `at_least` names; none where one part has none."""
    if not all(parts):
        return {}
    names = dict.fromkeys(name for part in parts for name in part)
    return {
        name: (min if base_of(name) in at_least else max)(part[name] for part in parts if name in part)
        for name in names
    }


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def _trial_of(line: str) -> tuple[str, dict[str, float]] | None:
    """The key and the figures of a trial in a line; None for a line that was cut off or edited."""
    try:
        return _TRIAL.validate_json(line)
    except ValueError:
        return None


_TRIAL: TypeAdapter[tuple[str, dict[str, float]]] = TypeAdapter(
    tuple[StrictStr, dict[StrictStr, StrictFloat]]
)


class Journal:
    """Trials by what was tried: in memory, and one line each in a file."""

    def __init__(self, path: Path | None, problem: str, *, restart: bool) -> None:
        self.path, self.known = path, dict[str, dict[str, float]]()
        self.counted, self.expected = 0, 1
        self.progress: Progress | None = None
        head = json.dumps({"malta-tune": 1, "problem": problem})
        if path is None:
            return
        old = "" if restart or not file_exists(path) else read_file(path, "file of trials", _text)
        lines = old.split("\n") if old else []
        if lines and lines[0] != head:
            raise InputError(
                path,
                "",
                "the trials of another design file",
                "those of this one, another folder, or --restart",
            )
        whole = [head]
        for line in lines[1:]:
            trial = _trial_of(line)
            if trial is not None:
                self.known[trial[0]] = trial[1]
                whole.append(line)
        replace_files({path: "\n".join([*whole, ""]).encode()})

    @staticmethod
    @contextmanager
    def _write_locked(path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            found = error.strerror or type(error).__name__
            raise InputError(path, "", found, "a place to keep the trials") from error

    def expect(self, trials: int, progress: Progress | None) -> None:
        """Set how many trials there will be, and who is told of their share."""
        self.expected, self.progress = trials, progress

    def get(self, key: str, compute: Callable[[], dict[str, float]]) -> dict[str, float]:
        """Return the figures of a trial: those of the journal, or computed ones, which the journal then holds."""
        if key not in self.known:
            with without_limit():  # the clock ends a search between its trials
                self.known[key] = compute()
            if self.path is not None:
                with self._write_locked(self.path), self.path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps([key, self.known[key]]) + "\n")
        self.counted += 1
        if self.progress is not None:
            self.progress(min(self.counted / self.expected, 0.99))
        return self.known[key]


def round_off(value: float) -> float:
    """Round a number to the digits that a file is written with."""
    return float(f"{value:.{DIGITS}g}")


class TrialSearch:
    """The trials of some of the numbers, with one delay, the others as they stand in the design."""

    def __init__(
        self,
        spec: Spec,
        variables: tuple[int, ...],
        delay: float,
        journal: Journal,
        compute: Callable[[Spec], dict[str, float]],
        among: tuple[int, ...] = (),
    ) -> None:
        """among: the numbers that the figures depend on, where these are more than those that vary."""
        self.spec, self.variables, self.among = spec, variables, among or variables
        self.delay, self.journal, self.compute = delay, journal, compute
        chosen = [spec.search[i] for i in variables]
        self.low = np.log([v.low for v in chosen])
        self.width = np.log([v.high for v in chosen]) - self.low
        start = np.log([max(spec.value_of(v), 1e-300) for v in chosen])
        self.start: FloatArray = np.clip((start - self.low) / self.width, 0, 1)
        self.others = [spec.value_of(v) for v in spec.search]

    def values(self, u: FloatArray) -> tuple[float, ...]:
        """Return the numbers of the file at a point of the unit cube."""
        sizes = np.exp(self.low + np.clip(u, 0, 1) * self.width)
        return tuple(round_off(float(size)) for size in sizes)

    def figures(self, u: FloatArray) -> dict[str, float]:
        """Return the figures of a point of the cube; none where its loop is unstable."""
        every = [round_off(value) if i in self.among else value for i, value in enumerate(self.others)]
        for index, value in zip(self.variables, self.values(u), strict=True):
            every[index] = value
        key = f"{self.among} {self.delay} {tuple(every[i] for i in self.among)}"
        return self.journal.get(key, lambda: self.compute(self.spec.vary(every)))

    def evolve(self, goal: Callable[[FloatArray], float], generations: int) -> FloatArray:
        """Find the region: differential evolution from a Latin hypercube with the file's own numbers in it.

        Where the clock ends the search, its best member is what is found.
        """
        if not (generations and len(self.low)):
            return self.start
        least, best = math.inf, self.start

        def look(u: FloatArray) -> float:
            nonlocal least, best
            check_clock()
            value = goal(u)
            if value < least:
                least, best = value, u.copy()
            return value

        rng = np.random.default_rng(0)
        k, members = len(self.low), max(8 * len(self.low), 6)
        cube = (
            rng.permuted(np.tile(np.arange(members), (k, 1)), axis=1).T + rng.random((members, k))
        ) / members
        cube[0] = self.start
        with suppress(WorkUp):
            found = optimize.differential_evolution(
                look, optimize.Bounds(np.zeros(k), np.ones(k)), maxiter=generations, init=cube, seed=0,
                tol=1e-6, polish=False, mutation=(0.4, 0.9), recombination=0.8,
            )  # fmt: skip
            best = np.asarray(found.x, dtype=float)
        return best


def distance_outside(u: FloatArray) -> float:
    """Measure how far a point lies outside the unit cube, as a sum over its coordinates."""
    return float(np.abs(u - np.clip(u, 0, 1)).sum())


def separate(touched: Sequence[set[int]], groups: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """Find what can be searched by itself: variables, and the groups that they touch and no other variable does.

    Groups that none touches stand together, with no variables.
    """
    joined = np.eye(groups, dtype=bool)
    for one in (*touched, set(range(groups)).difference(*touched)):
        for a, b in itertools.combinations(sorted(one), 2):
            joined[a, b] = True
    count, label = sparse.csgraph.connected_components(joined, directed=False)
    found = []
    for c in range(count):
        members = tuple(k for k in range(groups) if label[k] == c)
        found.append((tuple(i for i, one in enumerate(touched) if one & set(members)), members))
    return found


def combine(spec: Spec, places: Sequence[tuple[TrialSearch, FloatArray]]) -> Trial:
    """Make one trial of the places that the searches of a design's parts ended at."""
    values = [round_off(spec.value_of(v)) for v in spec.search]
    for search, u in places:
        for index, value in zip(search.variables, search.values(u), strict=True):
            values[index] = value
    figures = merge([search.figures(u) for search, u in places], at_least_of(spec.plant))
    return Trial(tuple(values), places[0][0].delay, figures)
