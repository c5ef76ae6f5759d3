"""What every search of a design's numbers has: requirements, trials and their journal, the cube, the file.

The numbers of [search] are the unit cube, by their logarithms. Values are rounded to five digits before they are tried,
so that the file that is written has the figures that were found. Every trial is kept in a journal. A search that was
interrupted goes through the same trials again, reads them from there, and ends with the same file.
"""

from __future__ import annotations

import itertools
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tomlkit
from scipy import optimize, sparse
from tomlkit.items import Item

from malta.errors import InputError
from malta.files import read_file
from malta.model.linearize import linearize
from malta.synthesis.lqg import synthesize

if TYPE_CHECKING:
    from malta.model.linearize import LinearModel
    from malta.model.plant import FloatArray
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

Progress = Callable[[float], None]
DIGITS = 5  # significant, of what is tried and written
UNSTABLE = 1e3  # ratio that stands for no figures at all
MORE = ("margin", "bandwidth", "payload", "lift_off")  # asked for from below


class Requirement(NamedTuple):
    """What is asked for and what was found, SI."""

    name: str
    asked: float | None  # None: as little as the others leave
    found: float
    unit: str
    how: str  # where the figure comes from

    @property
    def ratio(self) -> float:
        """How near its limit: at most 1 where it holds."""
        asked = math.inf if self.asked is None else self.asked
        return ratio_of(self.name, asked, self.found)

    @property
    def more(self) -> bool:
        """Asked for from below."""
        return self.name in MORE

    @property
    def holds(self) -> bool:
        return self.ratio <= 1

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
        if self.asked is None:
            return f"{self.name} is {self.found:.4g}{unit}, asked for little"
        bound = "at least" if self.more else "at most"
        return f"{self.name} is {self.found:.4g}{unit}, asked for {bound} {self.asked:.4g}{unit}"


class Trial(NamedTuple):
    """Numbers that were tried, in the units of the search's variables, and the linear figures that they give."""

    values: tuple[float, ...]
    delay: int
    figures: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Tuned:
    """What a search found."""

    spec: Spec  # with the weights that were found
    trial: Trial
    requirements: tuple[Requirement, ...]
    front: tuple[Trial, ...]  # by margin: least bearing force noise, least motion; and the trial itself
    trials: int

    @property
    def reached(self) -> bool:
        return all(r.holds for r in self.requirements)

    @property
    def binding(self) -> Requirement:
        """What is nearest to its limit, or furthest beyond it."""
        return max(self.requirements, key=lambda r: r.ratio)


class Effort(NamedTuple):
    """How long to search."""

    generations: int = 20  # of differential evolution
    polish: int = 40  # trials for each variable, of the best point
    front: int = 40  # and of each point of the front


def found_spec(spec: Spec, trial: Trial) -> Spec:
    """The design with the numbers of a trial."""
    return replace(spec.varied(trial.values), delay=trial.delay)


def synthesized(spec: Spec) -> tuple[LinearModel, Controller]:
    """The model at the design's operating point, and its controller."""
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    return model, synthesize(spec, model)


# ---------------------------------------------------------------------------------------------------------------------
# Figures
# ---------------------------------------------------------------------------------------------------------------------


def covariance(A: FloatArray, W: FloatArray) -> FloatArray:
    """X = A X A' + W by doubling; slow poles next to 1 take some thirty steps."""
    X, A = W, A.copy()
    for _ in range(60):
        more = A @ X @ A.T
        X, A = X + more, A @ A
        if np.abs(np.diag(more)).max() <= 1e-12 * np.abs(np.diag(X)).max():
            break
    return X


def ratio_of(name: str, asked: float, found: float) -> float:
    if not math.isfinite(found):
        return math.inf
    if name in MORE:
        return asked / found if found > 0 else math.inf
    return found / asked


def merged(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The worst of every figure; none where one part has none."""
    if not all(parts):
        return {}
    names = dict.fromkeys(name for part in parts for name in part)
    return {
        name: (min if name in MORE else max)(part[name] for part in parts if name in part) for name in names
    }


# ---------------------------------------------------------------------------------------------------------------------
# The search
# ---------------------------------------------------------------------------------------------------------------------


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


class Journal:
    """Trials by what was tried: in memory, and one line each in a file."""

    def __init__(self, path: Path | None, problem: str, *, restart: bool) -> None:
        self.path, self.known = path, dict[str, dict[str, float]]()
        self.counted, self.expected = 0, 1
        self.progress: Progress | None = None
        head = json.dumps({"malta-tune": 1, "problem": problem})
        if path is None:
            return
        old = "" if restart or not path.exists() else read_file(path, "file of trials", _text)
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
            try:
                key, figures = json.loads(line)
            except ValueError:  # cut off while it was written
                continue
            self.known[key] = figures
            whole.append(line)
        with self._writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("\n".join([*whole, ""]), encoding="utf-8")

    @staticmethod
    @contextmanager
    def _writing(path: Path) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            found = error.strerror or type(error).__name__
            raise InputError(path, "", found, "a place to keep the trials") from error

    def expect(self, trials: int, progress: Progress | None) -> None:
        self.expected, self.progress = trials, progress

    def get(self, key: str, compute: Callable[[], dict[str, float]]) -> dict[str, float]:
        if key not in self.known:
            self.known[key] = compute()
            if self.path is not None:
                with self._writing(self.path), self.path.open("a", encoding="utf-8") as file:
                    file.write(json.dumps([key, self.known[key]]) + "\n")
        self.counted += 1
        if self.progress is not None:
            self.progress(min(self.counted / self.expected, 0.99))
        return self.known[key]


def rounded(value: float) -> float:
    """To the digits that a file is written with."""
    return float(f"{value:.{DIGITS}g}")


class Search:
    """The trials of some of the numbers, with one delay, the others as they stand in the design."""

    def __init__(
        self,
        spec: Spec,
        variables: tuple[int, ...],
        delay: int,
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
        """Numbers of the file at a point of the unit cube."""
        sizes = np.exp(self.low + np.clip(u, 0, 1) * self.width)
        return tuple(rounded(float(size)) for size in sizes)

    def figures(self, u: FloatArray) -> dict[str, float]:
        """What a point of the cube gives; none where its loop is unstable."""
        every = [rounded(value) if i in self.among else value for i, value in enumerate(self.others)]
        for index, value in zip(self.variables, self.values(u), strict=True):
            every[index] = value
        key = f"{self.among} {self.delay} {tuple(every[i] for i in self.among)}"
        return self.journal.get(key, lambda: self.compute(self.spec.varied(every)))

    def evolved(self, goal: Callable[[FloatArray], float], generations: int) -> FloatArray:
        """The region: differential evolution from a Latin hypercube with the file's own numbers in it."""
        if not (generations and len(self.low)):
            return self.start
        rng = np.random.default_rng(0)
        k, members = len(self.low), max(8 * len(self.low), 6)
        cube = (
            rng.permuted(np.tile(np.arange(members), (k, 1)), axis=1).T + rng.random((members, k))
        ) / members
        cube[0] = self.start
        found = optimize.differential_evolution(
            goal, optimize.Bounds(np.zeros(k), np.ones(k)), maxiter=generations, init=cube, seed=0,
            tol=1e-6, polish=False, mutation=(0.4, 0.9), recombination=0.8,
        )  # fmt: skip
        best: FloatArray = np.asarray(found.x, dtype=float)
        return best

    def polished(self, goal: Callable[[FloatArray], float], u: FloatArray, trials: int) -> FloatArray:
        """The place: Nelder-Mead from steps of 5 % of a decade or so."""
        if not (trials and len(u)):
            return u
        simplex = np.vstack([u, u + np.diag(np.where(u < 0.5, 1, -1) * 0.1 / self.width)])
        found = optimize.minimize(
            goal, u, method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": trials, "xatol": 1e-4, "fatol": 1e-5, "adaptive": True},
        )  # fmt: skip
        best: FloatArray = np.asarray(found.x, dtype=float)
        return best


def outside(u: FloatArray) -> float:
    """How far a point is from the unit cube."""
    return float(np.abs(u - np.clip(u, 0, 1)).sum())


def joined(touched: Sequence[set[int]], groups: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """What can be searched by itself: variables, and the groups that they touch and no other variable does.

    Groups that none touches stand together, with no variables.
    """
    together = np.eye(groups, dtype=bool)
    for one in (*touched, set(range(groups)).difference(*touched)):
        for a, b in itertools.combinations(sorted(one), 2):
            together[a, b] = True
    count, label = sparse.csgraph.connected_components(together, directed=False)
    found = []
    for c in range(count):
        members = tuple(k for k in range(groups) if label[k] == c)
        found.append((tuple(i for i, one in enumerate(touched) if one & set(members)), members))
    return found


def together(spec: Spec, places: Sequence[tuple[Search, FloatArray]]) -> Trial:
    """One trial of what the searches of a design's parts have found."""
    values = [rounded(spec.value_of(v)) for v in spec.search]
    for search, u in places:
        for index, value in zip(search.variables, search.values(u), strict=True):
            values[index] = value
    figures = merged([search.figures(u) for search, u in places])
    return Trial(tuple(values), places[0][0].delay, figures)


# ---------------------------------------------------------------------------------------------------------------------
# The file
# ---------------------------------------------------------------------------------------------------------------------


def design_text(spec: Spec, trial: Trial, target: Path) -> str:
    """Write the text of the design file with the numbers of a trial, for another folder.

    Comments, the order of keys and all other values stay as they stand in spec.path.
    """
    document = tomlkit.parse(spec.path.read_text(encoding="utf-8"))
    document["machine"] = Path(
        os.path.relpath(spec.machine_file.resolve(), target.resolve().parent)
    ).as_posix()
    if spec.pid is None:
        document["delay"] = trial.delay
    for variable, value in zip(spec.search, trial.values, strict=True):
        for entry in variable.entries:
            *tables, name = entry.split(".")
            table: Any = document
            for key in tables:
                table = table[key]
            if isinstance(table[name], dict):
                table[name]["value"] = _number(value)
                table[name]["unit"] = variable.unit
            else:
                table[name] = _number(value)
    return tomlkit.dumps(document)


def _number(value: float) -> Item:
    """A number as the file shall hold it, in as many digits as were tried."""
    return tomlkit.value(f"{value:.{DIGITS}g}")
