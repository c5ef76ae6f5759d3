"""Specification -> weights: what a design file asks for in [specification], searched over what [search] may vary.

Each group of states that nothing joins to the others is searched by itself; groups that are each other's mirror image
are computed once. One number is minimized: the worst ratio of what is found to what is asked for (asked to found where
more is better), so 1 is reached where everything holds, and what binds has a name. Differential evolution finds the
region, Nelder-Mead the place. Values are rounded to five digits before they are tried, so that the file that is written
has the figures that were found.

The linear figures of a trial come from the machine's loop (hold, delay, current loops):

    margin             box of the parameters at which a corner of it becomes unstable, at the middle and the ends
    peak sensitivity   largest |S_ii|; bandwidth: the smallest of verify's definitions, in every group
    motion, noise      discrete Lyapunov equation with the sensors' noise and the steps' q^2 / 12
    tilt               what the held sensor plane moves at the reference's frequency, and 4.5 sigma of its motion

What the search ends with is judged by the certified margin, by verify() and by simulated experiments: `judged`.
Every trial is kept in a journal. A search that was interrupted goes through the same trials again, reads them from
there, and ends with the same file.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import linalg, optimize, sparse

from malta.data import plant_of, units_of
from malta.errors import CheckError, InputError
from malta.experiments import experiment
from malta.files import read_file
from malta.linearize import linearize
from malta.plant import trim
from malta.riccati import add_lags, delay_inputs, sample
from malta.simulate import Scenario, simulate, stroke_figures
from malta.spec import SPECIFIED, Spec, Specification, Weights
from malta.synthesize import Gains, gains, static_feedforward, synthesize
from malta.uncertain import uncertain
from malta.verify import BANDWIDTHS, machine_loop, travel_margin, verify

if TYPE_CHECKING:
    from malta.controller import Controller
    from malta.experiments import Experiment
    from malta.linearize import LinearModel
    from malta.plant import ComplexArray, FloatArray, Plant
    from malta.verify import Loop

Progress = Callable[[float], None]
DIGITS = 5  # significant, of what is tried and written
STEP = 0.15  # of the multiples of the box at which the machine is sampled; linear between them
UNSTABLE = 1e3  # ratio that stands for no figures at all
MORE = ("margin", "bandwidth", "payload", "lift_off")  # asked for from below
LINEAR = (
    "margin", "peak_sensitivity", "bandwidth", "radial_motion", "axial_motion", "force_noise", "thrust_noise",
    "tilt_deviation",
)  # fmt: skip
TILT, TILTING, SIGMAS = 200e-6, 2.0, 4.5  # m, Hz: the tilt of the experiments; the largest of 10 000 samples
HOLD = 1.0  # s, of the simulated rest; its second half counts
DRIVE_ERROR = 0.05  # of the drive's force constant, in tracking_error
FRONT = (0.6, 0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1)  # of the margin that is asked for


class Requirement(NamedTuple):
    """What is asked for and what was found, SI."""

    name: str
    asked: float
    found: float
    unit: str
    how: str  # where the figure comes from

    @property
    def ratio(self) -> float:
        """How near its limit: at most 1 where it holds."""
        return _ratio(self.name, self.asked, self.found)

    @property
    def more(self) -> bool:
        """Asked for from below."""
        return self.name in MORE

    @property
    def holds(self) -> bool:
        return self.ratio <= 1

    def __str__(self) -> str:
        unit = "" if self.unit == "1" else f" {self.unit}"
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


# ---------------------------------------------------------------------------------------------------------------------
# Figures of a group
# ---------------------------------------------------------------------------------------------------------------------


class _Part(NamedTuple):
    A: FloatArray
    B: FloatArray
    C: FloatArray

    @property
    def E(self) -> FloatArray:
        """Nothing is held between samples here; see `_groups`."""
        return np.zeros((len(self.A), len(self.C)))


class _Law(NamedTuple):
    """s+ = A s + B y, v = C s + D y; s = (xi_pred, e)."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray


def law_of(g: Gains, Ts: float) -> _Law:
    """controller.linear_law of gains alone."""
    n, p = len(g.Ad), len(g.Cd)
    rest = np.eye(n) - g.L @ g.Cd
    C, D = np.hstack([-g.K @ rest, g.Ki]), -g.K @ g.L - Ts * g.Ki
    A = linalg.block_diag(g.Ad @ rest, np.eye(p))
    A[:n] += g.Bd @ C
    return _Law(A, np.vstack([g.Ad @ g.L + g.Bd @ D, -Ts * np.eye(p)]), C, D)


@dataclass(frozen=True, eq=False)
class _Machine:
    """Sampled machines with hold, delay and current loops; leading axes are corners of the box."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray

    def closed(self, F: _Law) -> FloatArray:
        n, k = self.Ad.shape[-1], len(F.A)
        M = np.zeros((*self.Ad.shape[:-2], n + k, n + k))
        M[..., :n, :n], M[..., :n, n:] = self.Ad + self.Bd @ F.D @ self.Cd, self.Bd @ F.C
        M[..., n:, :n], M[..., n:, n:] = F.B @ self.Cd, F.A
        return M


@dataclass(frozen=True, eq=False)
class _Group:
    """Some states, inputs and outputs of the machine that close loops by themselves."""

    states: tuple[int, ...]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    model: _Part
    nominal: _Machine  # with its loads, at their trim
    slope: FloatArray  # of v0(z), which acts against them: inputs x outputs
    corners: _Machine | None  # levels x corners
    w: FloatArray  # rad/s
    response: ComplexArray  # of the nominal machine at w
    variance: FloatArray  # of a measurement, m2
    stroke: bool
    thrust: bool

    @property
    def picture(self) -> tuple[Any, ...]:
        """Equal for mirror images: nothing here depends on the signs of coordinates."""
        parts = (np.abs(M).round(12) for M in self.model)
        return (*(M.tobytes() for M in parts), self.variance.tobytes(), self.stroke, self.thrust)

    def part(self, w: Weights) -> Weights:
        i, j, o = (list(index) for index in (self.states, self.inputs, self.outputs))
        return Weights(
            w.q[i], w.q_base[i], w.r[j], w.r_base[j], w.q_i[o], w.q_i_base[o],
            w.process_variance[j], w.sensor_variance[o],
        )  # fmt: skip


def _groups(spec: Spec) -> list[_Group]:
    """The groups of a design's machine, each with what its trials need."""
    plant, Ts = spec.plant, spec.sample_time
    model = linearize(plant, plant.at(**spec.operating_point))
    if model.E.any():
        what = f"a {plant.name}, whose currents are held between samples"
        raise InputError(
            spec.path, "search", what, "a PID, or a machine whose forces do not depend on where it is"
        )
    loaded = linearize(plant, trim(plant, **spec.operating_point))
    asked, position = spec.specification, spec.operating_point.get(plant.stroke, 0.0)
    positions = sorted({position, -plant.travel, plant.travel})
    slope = np.zeros((model.B.shape[1], len(model.C)))
    slope[:, plant.stroke_output] = static_feedforward(plant).slope(position)
    n, m = model.B.shape
    touch = np.zeros((n + m + len(model.C),) * 2, dtype=bool)
    for z in positions:
        at = linearize(plant, plant.at(**{plant.stroke: z}))
        touch[:n, :n] |= at.A != 0
        touch[:n, n : n + m] |= at.B != 0
        touch[n + m :, :n] |= at.C != 0
    count, label = sparse.csgraph.connected_components(touch, directed=False)
    names = tuple(spec.uncertainty)
    systems = [uncertain(plant, names, at={plant.stroke: z}) for z in positions] if asked.margin else []
    found = []
    for k in range(count):
        i, j, o = (
            np.flatnonzero(label[part] == k) for part in (slice(n), slice(n, n + m), slice(n + m, None))
        )
        if not (len(i) and len(j) and len(o)):
            raise InputError(
                spec.path, "machine", "states that no input or sensor reaches", "another machine"
            )
        part = _Part(model.A[np.ix_(i, i)], model.B[np.ix_(i, j)], model.C[np.ix_(o, i)])
        nominal = _sampled(spec, _Part(loaded.A[np.ix_(i, i)], part.B, part.C))
        w = np.concatenate([np.geomspace(0.05, 50, 30), np.geomspace(60, 0.2 / Ts, 240), [1 / Ts, 2 / Ts]])
        lag = np.exp(1j * w * Ts)[:, None, None] * np.eye(len(nominal.Ad)) - nominal.Ad
        index = list(o)
        variance = np.array(plant.noise)[index] ** 2 + np.array(plant.resolution)[index] ** 2 / 12
        found.append(
            _Group(
                tuple(i.tolist()),
                tuple(j.tolist()),
                tuple(o.tolist()),
                part,
                nominal,
                slope[np.ix_(j, o)],
                _corners(spec, systems, i, j, o) if systems else None,
                w,
                np.asarray(nominal.Cd @ np.linalg.solve(lag, nominal.Bd)),
                variance,
                plant.stroke_output in o,
                plant.thrust_input in j,
            )
        )
    return found


def _sampled(spec: Spec, part: _Part) -> _Machine:
    actuator = spec.plant.actuator
    A, B = add_lags(part.A, part.B, actuator.crossover)
    Ad, Bd = delay_inputs(*sample(A, B, spec.sample_time), actuator.delay(spec.sample_time))
    return _Machine(Ad, Bd, np.hstack([part.C, np.zeros((len(part.C), len(Ad) - part.C.shape[1]))]))


def _corners(spec: Spec, systems: list[Any], i: Any, j: Any, o: Any) -> _Machine:
    """The machine at every corner of growing boxes, those that differ in this group."""
    signs = np.array(list(itertools.product((-1, 1), repeat=len(spec.uncertainty))))
    share = np.array(list(spec.uncertainty.values()))
    levels = np.arange(0.0, min(1 / share) - STEP / 3, STEP)
    made: dict[bytes, list[_Machine]] = {}  # machines that are mirror images have the same poles: once
    for system in systems:
        for corner in signs:
            rows = np.array([system.nominal * (1 + t * share * corner) for t in levels])
            A, B, C = system.at(rows)
            parts = [A[:, i][:, :, i], B[:, i][:, :, j], C[:, o][:, :, i]]
            key = b"".join(np.abs(M).round(9).tobytes() for M in parts)
            if key not in made:
                made[key] = [_sampled(spec, _Part(*part)) for part in zip(*parts, strict=True)]
    stacked = (
        np.array([[getattr(m, name) for m in one] for one in made.values()]) for name in ("Ad", "Bd", "Cd")
    )
    return _Machine(*(M.swapaxes(0, 1) for M in stacked))


def _margin(group: _Group, F: _Law) -> float:
    """Where the first corner of the growing box becomes unstable, by bisection."""
    table = group.corners
    assert table is not None
    last = len(table.Ad) - 1
    which = np.arange(table.Ad.shape[1])
    low, high = 0.0, STEP * last
    for _ in range(13):
        t = (low + high) / 2
        k = min(int(t / STEP), last - 1)
        share = t / STEP - k
        between = _Machine(
            *((1 - share) * M[k, which] + share * M[k + 1, which] for M in (table.Ad, table.Bd, table.Cd))
        )
        lost = np.abs(np.linalg.eigvals(between.closed(F))).max(axis=1) >= 1
        if lost.any():
            high, which = t, which[lost]  # the others are lost later
        else:
            low = t
    return low


def _figures(spec: Spec, group: _Group, weights: Weights, delay: int) -> dict[str, float]:
    """The linear figures of a group; none where its loop is unstable."""
    own = group.part(weights)
    Ts = spec.sample_time
    try:
        with np.errstate(all="ignore"):
            g = gains(group.model, own, Ts, spec.discretization, delay)
    except CheckError:
        return {}
    F = law_of(g, Ts)
    steady = F._replace(D=F.D + group.slope)
    closed = group.nominal.closed(steady)
    if not (np.isfinite(closed).all() and np.abs(np.linalg.eigvals(closed)).max() < 1):
        return {}
    found: dict[str, float] = {}
    if group.corners is not None:
        found["margin"] = _margin(group, F)
    F = steady
    z = np.exp(1j * group.w * Ts)[:, None, None]
    law = F.C @ np.linalg.solve(z * np.eye(len(F.A)) - F.A, F.B) + F.D
    eye = np.eye(len(group.outputs))
    S = np.linalg.inv(eye - group.response @ law)
    T = np.linalg.svd(eye - S, compute_uv=False)
    L = np.linalg.svd(group.response @ law, compute_uv=False)
    half = len(group.states) // 2
    stiffness = group.model.B[half:] @ g.K[:, :half] - group.model.A[half:, :half]
    w_n = math.sqrt(max(float(np.linalg.eigvals(stiffness).real.min()), 0.0))
    found["peak_sensitivity"] = float(np.abs(np.einsum("kii->ki", S)).max())
    found["bandwidth"] = min(
        _falls(group.w, T[:, -1], math.sqrt(0.5)), _falls(group.w, L[:, 0], 1.0, last=True), w_n
    )
    noise = np.vstack([group.nominal.Bd @ F.D, F.B])
    X = _covariance(closed, noise * group.variance @ noise.T)
    k = len(group.nominal.Ad)
    out = group.nominal.Cd @ X[:k, :k] @ group.nominal.Cd.T
    command = np.hstack([F.D @ group.nominal.Cd, F.C])
    force = np.diag(command @ X @ command.T + F.D * group.variance @ F.D.T)
    motion = float(np.sqrt(np.diag(out).max()))
    found["axial_motion" if group.stroke else "radial_motion"] = motion
    found["thrust_noise" if group.thrust else "force_noise"] = float(np.sqrt(force.max()))
    if not group.stroke and len(group.outputs) > 1:
        found["tilt_deviation"] = _tilt(spec, group, g, closed) + SIGMAS * motion
    return found


def _covariance(A: FloatArray, W: FloatArray) -> FloatArray:
    """X = A X A' + W by doubling; slow poles next to 1 take some thirty steps."""
    X, A = W, A.copy()
    for _ in range(60):
        more = A @ X @ A.T
        X, A = X + more, A @ A
        if np.abs(np.diag(more)).max() <= 1e-12 * np.abs(np.diag(X)).max():
            break
    return X


def _tilt(spec: Spec, group: _Group, g: Gains, closed: FloatArray) -> float:
    """How far the other sensor planes move, m, while the first one follows the tilt's circle and they are held."""
    half, held = len(group.states) // 2, len(group.nominal.Ad)
    C = group.model.C[:, :half]
    if C.shape[0] != half:
        return 0.0
    p, rate = TILT * np.eye(half)[0], 2j * math.pi * TILTING
    q = np.linalg.solve(C, p)
    xi = np.concatenate([q, rate * q, np.zeros(len(g.Ad) - 2 * half)])
    v = g.K @ xi + spec.sample_time * g.Ki @ p
    driven = np.concatenate([group.nominal.Bd @ v, g.Bd @ v, spec.sample_time * p])
    x = np.linalg.solve(np.exp(rate * spec.sample_time) * np.eye(len(closed)) - closed, driven)
    return float(np.abs((group.nominal.Cd @ x[:held])[1:]).max())


def _falls(w: FloatArray, size: FloatArray, level: float, *, last: bool = False) -> float:
    """Where size falls below level, on a log-log line between the grid's points, as verify has it."""
    falls = np.flatnonzero((size[:-1] >= level) & (size[1:] < level))
    if not len(falls):
        return float(w[-1]) if size[-1] >= level else 0.0
    k = falls[-1 if last else 0]
    (a, b), (wa, wb) = np.log(size[k : k + 2] / level), np.log(w[k : k + 2])
    return float(np.exp(wa + (wb - wa) * a / (a - b)))


def _ratio(name: str, asked: float, found: float) -> float:
    if not math.isfinite(found):
        return math.inf
    if name in MORE:
        return asked / found if found > 0 else math.inf
    return found / asked


# ---------------------------------------------------------------------------------------------------------------------
# The search
# ---------------------------------------------------------------------------------------------------------------------


class _Cluster(NamedTuple):
    """Groups that variables join, and those variables."""

    variables: tuple[int, ...]
    groups: tuple[_Group, ...]


def _clusters(spec: Spec) -> list[_Cluster]:
    """What can be searched by itself: groups that share no variable. Mirror images are left out."""
    groups = _groups(spec)
    base = spec.weights
    touched: list[set[int]] = []
    middle = [math.sqrt(v.low * v.high) for v in spec.search]
    for index in range(len(spec.search)):
        other = [value * (1.5 if k == index else 1) for k, value in enumerate(middle)]
        a, b = spec.varied(middle).weights, spec.varied(other).weights
        touched.append({k for k, g in enumerate(groups) if _differ(g.part(a), g.part(b))})
        if not touched[-1]:
            raise InputError(
                spec.path, f"search.numbers.{spec.search[index].name}", "no effect", "an entry that has one"
            )
    joined = np.eye(len(groups), dtype=bool)
    for one in touched:
        for a_, b_ in itertools.combinations(sorted(one), 2):
            joined[a_, b_] = True
    count, label = sparse.csgraph.connected_components(joined, directed=False)
    clusters = []
    for c in range(count):
        members = [k for k in range(len(groups)) if label[k] == c]
        variables = tuple(i for i, one in enumerate(touched) if one & set(members))
        distinct: dict[Any, _Group] = {}
        for k in members:
            g = groups[k]
            # Mirror images stay so under every weight that the search tries.
            same = tuple(
                tuple(tuple(getattr(g.part(w), name).tolist()) for name in Weights.__dataclass_fields__)
                for w in (base, spec.varied(middle).weights)
            )
            distinct.setdefault((g.picture, same), g)
        clusters.append(_Cluster(variables, tuple(distinct.values())))
    return clusters


def _differ(a: Weights, b: Weights) -> bool:
    """Whether they may give other gains: bases of weights that are zero do not matter."""
    names = ("Q", "R", "Q_i", "process_variance", "sensor_variance")
    return any((getattr(a, name) != getattr(b, name)).any() for name in names)


def merged(parts: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """The worst of every figure; none where one part has none."""
    if not all(parts):
        return {}
    names = dict.fromkeys(name for part in parts for name in part)
    return {
        name: (min if name in MORE else max)(part[name] for part in parts if name in part) for name in names
    }


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


class _Journal:
    """Trials by what was tried: in memory, and one line each in a file."""

    def __init__(self, path: Path | None, spec: Spec, *, restart: bool) -> None:
        self.path, self.known = path, dict[str, dict[str, float]]()
        self.counted, self.expected = 0, 1
        self.progress: Progress | None = None
        head = json.dumps({"malta-tune": 1, "problem": problem_sha256(spec)})
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


def problem_sha256(spec: Spec) -> str:
    """Of everything that the figures of a trial depend on, and of what is searched."""
    asked, searched = asdict(spec.specification), (spec.search, spec.delays)
    content = [repr(spec.parameters), asked, searched, spec.sha256, FRONT, DIGITS, STEP]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def rounded(value: float) -> float:
    """To the digits that a file is written with."""
    return float(f"{value:.{DIGITS}g}")


class _Search:
    """The trials of one cluster with one delay."""

    def __init__(self, spec: Spec, cluster: _Cluster, delay: int, journal: _Journal) -> None:
        self.spec, self.cluster, self.delay, self.journal = spec, cluster, delay, journal
        chosen = [spec.search[i] for i in cluster.variables]
        self.low = np.log([v.low for v in chosen])
        self.width = np.log([v.high for v in chosen]) - self.low
        start = np.log([max(spec.value_of(v), 1e-300) for v in chosen])
        self.start: FloatArray = np.clip((start - self.low) / self.width, 0, 1)
        self.others = [spec.value_of(v) for v in spec.search]

    def values(self, u: FloatArray) -> tuple[float, ...]:
        """Numbers of the file at a point of the unit cube."""
        sizes = np.exp(self.low + np.clip(u, 0, 1) * self.width)
        return tuple(rounded(float(size)) for size in sizes)

    def figures(self, values: tuple[float, ...]) -> dict[str, float]:
        key = f"{self.cluster.variables} {self.delay} {values}"

        def compute() -> dict[str, float]:
            every = list(self.others)
            for index, value in zip(self.cluster.variables, values, strict=True):
                every[index] = value
            weights = self.spec.varied(every).weights
            return merged([_figures(self.spec, g, weights, self.delay) for g in self.cluster.groups])

        return self.journal.get(key, compute)

    def worst(self, u: FloatArray) -> float:
        """What is minimized: the worst ratio, and a little of all of them."""
        outside = float(np.abs(u - np.clip(u, 0, 1)).sum())
        ratios = _ratios(self.spec, self.figures(self.values(u)))
        return max(ratios) + 0.01 * sum(ratios) / len(ratios) + outside if ratios else UNSTABLE + outside

    def frugal(self, u: FloatArray, margin: float, kinds: Sequence[str]) -> float:
        """The logarithm of noise or motion at a margin, with everything else as it is asked for."""
        figures = self.figures(self.values(u))
        if not figures:
            return UNSTABLE
        worst = max(
            _ratio("margin", margin, figures.get("margin", math.inf)), _beside_noise(self.spec, figures)
        )
        beyond = max(worst - 1, 0.0) + float(np.abs(u - np.clip(u, 0, 1)).sum())
        return sum(math.log(figures[kind]) for kind in kinds if kind in figures) + 100 * beyond

    def evolved(self, generations: int) -> FloatArray:
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
            self.worst, optimize.Bounds(np.zeros(k), np.ones(k)), maxiter=generations, init=cube, seed=0,
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


def _ratios(spec: Spec, figures: Mapping[str, float]) -> list[float]:
    asked = asdict(spec.specification)
    return [
        _ratio(name, asked[name], figures[name])
        for name in LINEAR
        if asked[name] is not None and name in figures
    ]


def _beside_noise(spec: Spec, figures: Mapping[str, float]) -> float:
    """The worst ratio of what is no axis of the front."""
    free = ("margin", "force_noise", "thrust_noise", "radial_motion", "axial_motion")
    return max(_ratios(spec, {k: v for k, v in figures.items() if k not in free}), default=0.0)


class Effort(NamedTuple):
    """How long to search."""

    generations: int = 20  # of differential evolution
    polish: int = 40  # trials for each variable, of the best point
    front: int = 40  # and of each point of the front


def tune(
    spec: Spec,
    journal: Path | None = None,
    *,
    effort: Effort = Effort(),  # noqa: B008
    restart: bool = False,
    progress: Progress | None = None,
) -> Tuned:
    """Search the numbers of [search] for the figures of [specification].

    journal : file of the trials; what is in it is not computed again

    Raises InputError when the design file asks for nothing or lets nothing vary, or the journal is another search's.
    """
    if spec.specification == Specification():
        raise InputError(spec.path, "specification", "nothing", "a table of what the design shall reach")
    if not spec.search:
        raise InputError(spec.path, "search", "nothing", "a table of the numbers that may vary")
    kept = _Journal(journal, spec, restart=restart)
    clusters = _clusters(spec)
    kept.expect(_expected(clusters, spec, effort), progress)
    found: dict[int, list[tuple[_Search, FloatArray]]] = {}
    for delay in spec.delays:
        searches = [_Search(spec, cluster, delay, kept) for cluster in clusters]
        found[delay] = [
            (s, s.polished(s.worst, s.evolved(effort.generations), effort.polish * len(s.low)))
            for s in searches
        ]
    worst = {delay: max(s.worst(u) for s, u in places) for delay, places in found.items()}
    # More states are worth it only where they help.
    delay = min(d for d, ratio in worst.items() if ratio <= 1.01 * min(worst.values()))
    trial = _together(spec, found[delay])
    front = _front(spec, found[delay], effort, trial)
    chosen = found_spec(spec, trial)
    requirements = judged(chosen)
    if progress is not None:
        progress(1.0)
    return Tuned(chosen, trial, requirements, front, len(kept.known))


def _expected(clusters: Sequence[_Cluster], spec: Spec, effort: Effort) -> int:
    """About how many trials there will be."""
    total = 0
    for cluster in clusters:
        k = len(cluster.variables)
        total += len(spec.delays) * (max(8 * k, 6) * (effort.generations + 1) + effort.polish * k)
        total += 2 * len(FRONT) * effort.front * k if spec.specification.margin else 0
    return total


def _together(spec: Spec, places: Sequence[tuple[_Search, FloatArray]]) -> Trial:
    values = [rounded(spec.value_of(v)) for v in spec.search]
    for search, u in places:
        for index, value in zip(search.cluster.variables, search.values(u), strict=True):
            values[index] = value
    figures = merged([search.figures(search.values(u)) for search, u in places])
    return Trial(tuple(values), places[0][0].delay, figures)


def _front(
    spec: Spec, places: Sequence[tuple[_Search, FloatArray]], effort: Effort, best: Trial
) -> tuple[Trial, ...]:
    """For margins about the one that is asked for: least force noise, least motion; margins then proven."""
    margin = spec.specification.margin
    if margin is None or not effort.front:
        return ()
    most = min(1 / share for share in spec.uncertainty.values()) - 2 * STEP
    trials = [best]
    for kinds in (("force_noise", "thrust_noise"), ("radial_motion", "axial_motion")):
        around = [u for _, u in places]
        for share in FRONT:
            if share * margin > most:
                continue
            for k, (search, _) in enumerate(places):

                def goal(u: FloatArray, s: _Search = search, m: float = share * margin) -> float:
                    return s.frugal(u, m, kinds)  # noqa: B023

                around[k] = search.polished(goal, around[k], effort.front * len(search.low))
            trials.append(_together(spec, [(s, u) for (s, _), u in zip(places, around, strict=True)]))
    proven = []
    for one in trials:
        if one.figures and (one is best or _beside_noise(spec, one.figures) <= 1.005):
            design = found_spec(spec, one)
            bound = travel_margin(spec.plant, synthesized(design)[1], spec.uncertainty).lower
            proven.append(one._replace(figures=dict(one.figures) | {"margin": bound or 0.0}))
    unique: dict[tuple[float, ...], Trial] = {}
    for one in proven:  # what is equal to three digits counts once
        sizes = (
            -one.figures["margin"],
            *(one.figures[k] for k in ("force_noise", "radial_motion") if k in one.figures),
        )
        unique.setdefault(tuple(float(f"{size:.3g}") for size in sizes), one)
    best_of = np.array(list(unique))
    kept = [
        one for own, one in zip(best_of, unique.values(), strict=True)
        if one.values == best.values or not ((best_of <= own).all(axis=1) & (best_of < own).any(axis=1)).any()
    ]  # fmt: skip
    return tuple(sorted(kept, key=lambda one: one.figures["margin"]))


def found_spec(spec: Spec, trial: Trial) -> Spec:
    """The design with the numbers of a trial."""
    return replace(spec.varied(trial.values), delay=trial.delay)


# ---------------------------------------------------------------------------------------------------------------------
# The judgement
# ---------------------------------------------------------------------------------------------------------------------


def synthesized(spec: Spec) -> tuple[LinearModel, Controller]:
    """The model at the design's operating point, and its controller."""
    model = linearize(spec.plant, spec.plant.at(**spec.operating_point))
    return model, synthesize(spec, model)


def judged(spec: Spec) -> tuple[Requirement, ...]:
    """Every requirement of a design: proven margin, verified loop, covariance, simulated experiments."""
    asked, plant = spec.specification, spec.plant
    model, controller = synthesized(spec)
    margins = verify(model, controller, spec.uncertainty if asked.margin else None)
    found: list[tuple[str, float, str]] = []
    if margins.robust is not None:
        found.append(("margin", margins.robust.lower or 0.0, "proven over the travel"))
    sensors = [s.name for s in controller.measurements]
    found.append(
        ("peak_sensitivity", max(margins.peak_sensitivity[s] for s in sensors), "worst sensor, machine")
    )
    narrow = min(margins.bandwidth, key=lambda key: margins.bandwidth[key])
    found.append(("bandwidth", margins.bandwidth[narrow], BANDWIDTHS[narrow]))
    if margins.stable:
        motion, noise = noise_of(machine_loop(model, controller), plant)
        found += _still(plant, motion, noise, "covariance")
        if asked.radial_motion or asked.axial_motion or asked.force_noise or asked.thrust_noise:
            run = _flown(experiment("hold", plant, controller, duration=HOLD)).run
            rest = slice(-len(run.t) // 2, None)
            moved, pushed = run.p[rest], run.v[rest] - run.v[rest].mean(axis=0)
            found += _still(plant, _rms(moved - moved.mean(axis=0)), _rms(pushed), "simulated hold")
        found += _experiments(spec, plant, controller)
    rows = []
    for name, value, how in found:
        wanted = getattr(asked, name)
        if wanted:
            rows.append(Requirement(name, float(wanted), value, SPECIFIED.get(name, "1"), how))
    return tuple(rows)


def noise_of(loop: Loop, plant: Plant) -> tuple[FloatArray, FloatArray]:
    """Rms of the true outputs, m, and of the commanded forces, N, from sensor noise and the q^2 / 12 of steps."""
    c, V = loop.control, np.array(plant.noise) ** 2 + np.array(plant.resolution) ** 2 / 12
    noise = np.vstack([loop.Bd @ c.D_y, c.B_y])
    X, n = _covariance(loop.closed, noise * V @ noise.T), len(loop.Ad)
    command = np.hstack([c.D_y @ loop.Cd, c.C])
    out = np.diag(loop.Cd @ X[:n, :n] @ loop.Cd.T)
    return np.sqrt(out), np.sqrt(np.diag(command @ X @ command.T + c.D_y * V @ c.D_y.T))


def _still(plant: Plant, motion: FloatArray, noise: FloatArray, how: str) -> list[tuple[str, float, str]]:
    """The worst axis of each kind."""
    stroke, thrust = plant.stroke_output, plant.thrust_input
    return [
        ("radial_motion", float(np.delete(motion, stroke).max()), how),
        ("axial_motion", float(motion[stroke]), how),
        ("force_noise", float(np.delete(noise, thrust).max()), how),
        ("thrust_noise", float(noise[thrust]), how),
    ]


def _rms(values: FloatArray) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.square(values), axis=0)))


def _experiments(spec: Spec, plant: Plant, controller: Controller) -> list[tuple[str, float, str]]:
    asked = spec.specification
    found: list[tuple[str, float, str]] = []
    if asked.tracking_error or asked.radial_deviation:
        errors = []
        name = drive_constant(plant)
        for share in (1 - DRIVE_ERROR, 1 + DRIVE_ERROR):
            other = replace(plant.parameters, **{name: share * getattr(plant.parameters, name)})
            run = simulate(plant.variant(other), controller, Scenario.stroke(noise=1.0, quantize=True))
            if run.verdict.name == "interrupted":
                raise KeyboardInterrupt
            figures = stroke_figures(run)
            radial = max(figures.radial.values())
            errors.append((figures.axial_error, radial) if run.verdict.completed else (math.inf, math.inf))
        axial, radial = np.array(errors).max(axis=0).tolist()
        how = f"strokes with {name} {100 * DRIVE_ERROR:g} % off"
        found += [("tracking_error", axial, how), ("radial_deviation", radial, how)]
    if asked.tilt_deviation:
        tilts = _flown(experiment("tilt", plant, controller))
        worst = max(case.merits[0].value for case in tilts.cases)
        found.append(("tilt_deviation", math.inf if tilts.failed else worst, "tilt, either feedforward"))
    if asked.lift_off:
        lifted = not _flown(experiment("lift-off", plant, controller)).failed
        found.append(("lift_off", float(lifted), "every estimator"))
    if asked.payload:
        picked = _flown(experiment("payload", plant, controller, masses=(asked.payload,)))
        carried = picked.cases[0].run.verdict.completed
        found.append(("payload", asked.payload if carried else 0.0, "hold and stroke"))
    return found


def _flown(e: Experiment) -> Experiment:
    """The experiment, unless Ctrl-C cut it short: then there is nothing to judge."""
    if e.interrupted or any(case.run.verdict.name == "interrupted" for case in e.cases):
        raise KeyboardInterrupt
    return e


def drive_constant(plant: Plant) -> str:
    """The parameter that scales the thrust and no other force."""
    before = np.array(plant.actuator.force_constant)
    for name in units_of(plant.parameters):
        try:
            other: Any = replace(plant.parameters, **{name: 1.01 * getattr(plant.parameters, name)})
            changed = np.array(plant_of(other).actuator.force_constant) != before
        except InputError:
            continue
        if changed[plant.thrust_input] and changed.sum() == 1:
            return name
    raise InputError(plant.name, "tracking_error", "no parameter of the thrust alone", "a machine with one")


# ---------------------------------------------------------------------------------------------------------------------
# The file
# ---------------------------------------------------------------------------------------------------------------------


def design_text(spec: Spec, trial: Trial, target: Path) -> str:
    """The text of the design file with the numbers of a trial, everything else as it stands, for another folder.

    Raises CheckError when the text does not hold what was meant.
    """
    text = spec.path.read_text(encoding="utf-8")
    wanted: dict[str, str] = {}
    for variable, value in zip(spec.search, trial.values, strict=True):
        number = f"{value:.{DIGITS}g}"
        for entry in variable.entries:
            is_weight = entry.startswith("weights.")
            wanted[entry] = number if is_weight else f'{{ value = {number}, unit = "{variable.unit}" }}'
    machine = Path(os.path.relpath(spec.machine_file.resolve(), target.resolve().parent)).as_posix()
    wanted |= {"delay": str(trial.delay), "machine": json.dumps(machine)}
    for entry, new in wanted.items():
        text = _replaced(text, entry, new)
    found = tomllib.loads(text)
    for entry, new in wanted.items():
        node: Any = found
        for key in entry.split("."):
            node = node[key]
        if node != tomllib.loads(f"value = {new}")["value"]:
            raise CheckError(
                f"{spec.path}: {entry} stands where it cannot be replaced: a line of its own is needed"
            )
    return text


VALUE = r"(\{[^{}]*\}|\"[^\"]*\"|[^\s,}#]+)"  # of a key: an inline table, a text, a number


def _replaced(text: str, entry: str, value: str) -> str:
    """The text with another value of a dotted key: on a line of its table, or in a table on one line."""
    keys, header, lines = entry.split("."), "", text.split("\n")
    for k, line in enumerate(lines):
        table = re.match(r"\s*\[([^\[\]]+)\]", line)
        if table:
            header = table[1].strip()
            continue
        prefix = f"{header}." if header else ""
        if not entry.startswith(prefix) or (header and header.split(".") != keys[: len(header.split("."))]):
            continue
        rest = keys[len(header.split(".")) if header else 0 :]
        if re.match(rf"\s*{re.escape(rest[0])}\s*=", line) is None:
            continue
        pattern = rf"(?<![\w.-]){re.escape(rest[-1])}(\s*=\s*){VALUE}"
        lines[k] = re.sub(pattern, lambda m: f"{rest[-1]}{m[1]}{value}", line, count=1)  # noqa: B023
        break
    return "\n".join(lines)
