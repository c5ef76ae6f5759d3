"""Specification -> weights: what the design file of an LQG asks for, searched over what [search] may vary.

Each group of states that nothing joins to the others is searched by itself; groups that are each other's mirror image
are computed once. One number is minimized: the worst ratio of what is found to what is asked for (asked to found where
more is better), so 1 is reached where everything holds, and what binds has a name. Differential evolution finds the
region, Nelder-Mead the place.

The linear figures of a trial come from the machine's loop (hold, delay, current loops):

    margin             box of the parameters at which a corner of it becomes unstable, at the middle and the ends
    peak sensitivity   largest |S_ii|; bandwidth: the smallest of verify's definitions, in every group
    motion, noise      discrete Lyapunov equation with the sensors' noise and the steps' q^2 / 12
    tilt               what the held sensor plane moves at the reference's frequency, and 4.5 sigma of its motion

What the search ends with is judged by the certified margin, by verify() and by simulated experiments: `judged`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy import sparse

from malta.errors import CheckError, InputError
from malta.margins.plants import of_plant
from malta.margins.verify import (
    BANDWIDTHS,
    crossing,
    machine_loop,
    travel_margin,
    verify,
)
from malta.model.data import plant_of, units_of
from malta.model.linearize import linearize
from malta.model.plant import trim
from malta.simulation.experiments import experiment
from malta.simulation.simulate import Scenario, simulate, stroke_figures
from malta.synthesis.controller import linear_law_of
from malta.synthesis.lqg import Gains, gains, static_feedforward
from malta.synthesis.riccati import add_lags, delay_inputs, sample
from malta.synthesis.spec import SPECIFIED, Spec, Weights
from malta.tuning.search import (
    UNSTABLE,
    Effort,
    Journal,
    Progress,
    Requirement,
    Search,
    Trial,
    covariance,
    found_spec,
    joined,
    merged,
    outside,
    ratio_of,
    synthesized,
    together,
)

if TYPE_CHECKING:
    from malta.margins.verify import Loop
    from malta.model.plant import ComplexArray, FloatArray, Plant
    from malta.simulation.experiments import Experiment
    from malta.synthesis.controller import Controller, LinearLaw

STEP = 0.15  # of the multiples of the box at which the machine is sampled; linear between them
LINEAR = (
    "margin", "peak_sensitivity", "bandwidth", "radial_motion", "axial_motion", "force_noise", "thrust_noise",
    "tilt_deviation",
)  # fmt: skip
TILT, TILTING, SIGMAS = 200e-6, 2.0, 4.5  # m, Hz: the tilt of the experiments; the largest of 10 000 samples
HOLD = 1.0  # s, of the simulated rest; its second half counts
DRIVE_ERROR = 0.05  # of the drive's force constant, in tracking_error
FRONT = (0.6, 0.7, 0.8, 0.9, 0.95, 1.0, 1.05, 1.1)  # of the margin that is asked for


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


@dataclass(frozen=True, eq=False)
class _Machine:
    """Sampled machines with hold, delay and current loops; leading axes are corners of the box."""

    Ad: FloatArray
    Bd: FloatArray
    Cd: FloatArray

    def closed(self, F: LinearLaw) -> FloatArray:
        n, k = self.Ad.shape[-1], len(F.A)
        M = np.zeros((*self.Ad.shape[:-2], n + k, n + k))
        M[..., :n, :n], M[..., :n, n:] = self.Ad + self.Bd @ F.D_y @ self.Cd, self.Bd @ F.C
        M[..., n:, :n], M[..., n:, n:] = F.B_y @ self.Cd, F.A
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
    systems = [of_plant(plant, names, at={plant.stroke: z}) for z in positions] if asked.margin else []
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


def _margin(group: _Group, F: LinearLaw) -> float:
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
    F = linear_law_of(g, Ts)
    steady = F._replace(D_y=F.D_y + group.slope)
    closed = group.nominal.closed(steady)
    if not (np.isfinite(closed).all() and np.abs(np.linalg.eigvals(closed)).max() < 1):
        return {}
    found: dict[str, float] = {}
    if group.corners is not None:
        found["margin"] = _margin(group, F)
    F = steady
    z = np.exp(1j * group.w * Ts)[:, None, None]
    law = F.C @ np.linalg.solve(z * np.eye(len(F.A)) - F.A, F.B_y) + F.D_y
    eye = np.eye(len(group.outputs))
    S = np.linalg.inv(eye - group.response @ law)
    T = np.linalg.svd(eye - S, compute_uv=False)
    L = np.linalg.svd(group.response @ law, compute_uv=False)
    half = len(group.states) // 2
    stiffness = group.model.B[half:] @ g.K[:, :half] - group.model.A[half:, :half]
    w_n = math.sqrt(max(float(np.linalg.eigvals(stiffness).real.min()), 0.0))
    found["peak_sensitivity"] = float(np.abs(np.einsum("kii->ki", S)).max())
    found["bandwidth"] = min(
        crossing(group.w, T[:, -1], math.sqrt(0.5)), crossing(group.w, L[:, 0], 1.0, last=True), w_n
    )
    noise = np.vstack([group.nominal.Bd @ F.D_y, F.B_y])
    X = covariance(closed, noise * group.variance @ noise.T)
    k = len(group.nominal.Ad)
    out = group.nominal.Cd @ X[:k, :k] @ group.nominal.Cd.T
    command = np.hstack([F.D_y @ group.nominal.Cd, F.C])
    force = np.diag(command @ X @ command.T + F.D_y * group.variance @ F.D_y.T)
    motion = float(np.sqrt(np.diag(out).max()))
    found["axial_motion" if group.stroke else "radial_motion"] = motion
    found["thrust_noise" if group.thrust else "force_noise"] = float(np.sqrt(force.max()))
    if not group.stroke and len(group.outputs) > 1:
        found["tilt_deviation"] = _tilt(spec, group, g, closed) + SIGMAS * motion
    return found


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
    clusters = []
    for variables, members in joined(touched, len(groups)):
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


def _search(spec: Spec, cluster: _Cluster, delay: int, journal: Journal) -> Search:
    """The trials of one cluster with one delay."""

    def compute(design: Spec) -> dict[str, float]:
        return merged([_figures(spec, g, design.weights, delay) for g in cluster.groups])

    return Search(spec, cluster.variables, delay, journal, compute)


def _worst(search: Search, u: FloatArray) -> float:
    """What is minimized: the worst ratio, and a little of all of them."""
    ratios = _ratios(search.spec, search.figures(u))
    return (max(ratios) + 0.01 * sum(ratios) / len(ratios) if ratios else UNSTABLE) + outside(u)


def _frugal(search: Search, u: FloatArray, margin: float, kinds: Sequence[str]) -> float:
    """The logarithm of noise or motion at a margin, with everything else as it is asked for."""
    figures = search.figures(u)
    if not figures:
        return UNSTABLE
    worst = max(
        ratio_of("margin", margin, figures.get("margin", math.inf)), _beside_noise(search.spec, figures)
    )
    beyond = max(worst - 1, 0.0) + outside(u)
    return sum(math.log(figures[kind]) for kind in kinds if kind in figures) + 100 * beyond


def _ratios(spec: Spec, figures: Mapping[str, float]) -> list[float]:
    asked = asdict(spec.specification)
    return [
        ratio_of(name, asked[name], figures[name])
        for name in LINEAR
        if asked[name] is not None and name in figures
    ]


def _beside_noise(spec: Spec, figures: Mapping[str, float]) -> float:
    """The worst ratio of what is no axis of the front."""
    free = ("margin", "force_noise", "thrust_noise", "radial_motion", "axial_motion")
    return max(_ratios(spec, {k: v for k, v in figures.items() if k not in free}), default=0.0)


def searched(
    spec: Spec, journal: Journal, effort: Effort, progress: Progress | None
) -> tuple[Trial, tuple[Trial, ...]]:
    """The trial with the smallest worst ratio, and the front about it."""
    clusters = _clusters(spec)
    journal.expect(_expected(clusters, spec, effort), progress)
    found: dict[int, list[tuple[Search, FloatArray]]] = {}
    for delay in spec.delays:
        found[delay] = []
        for search in (_search(spec, cluster, delay, journal) for cluster in clusters):
            goal = partial(_worst, search)
            u = search.evolved(goal, effort.generations)
            found[delay].append((search, search.polished(goal, u, effort.polish * len(search.low))))
    worst = {delay: max(_worst(s, u) for s, u in places) for delay, places in found.items()}
    # More states are worth it only where they help.
    delay = min(d for d, ratio in worst.items() if ratio <= 1.01 * min(worst.values()))
    trial = together(spec, found[delay])
    return trial, _front(spec, found[delay], effort, trial)


def _expected(clusters: Sequence[_Cluster], spec: Spec, effort: Effort) -> int:
    """About how many trials there will be."""
    total = 0
    for cluster in clusters:
        k = len(cluster.variables)
        total += len(spec.delays) * (max(8 * k, 6) * (effort.generations + 1) + effort.polish * k)
        total += 2 * len(FRONT) * effort.front * k if spec.specification.margin else 0
    return total


def _front(
    spec: Spec, places: Sequence[tuple[Search, FloatArray]], effort: Effort, best: Trial
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
                goal = partial(_frugal, search, margin=share * margin, kinds=kinds)
                around[k] = search.polished(goal, around[k], effort.front * len(search.low))
            trials.append(together(spec, [(s, u) for (s, _), u in zip(places, around, strict=True)]))
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


# ---------------------------------------------------------------------------------------------------------------------
# The judgement
# ---------------------------------------------------------------------------------------------------------------------


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
    X, n = covariance(loop.closed, noise * V @ noise.T), len(loop.Ad)
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
