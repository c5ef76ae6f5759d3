"""From which displacements and tilts MALTA returns, beside what its force limit allows at best."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from malta import CheckError, InputError, Scenario, linearize, references
from malta.arrays import FloatArray
from malta.model import LinearModel, Plant
from malta.simulation import Experiment, Trajectory, simulate_many
from malta.simulation.engine.batch import is_compiled
from malta.simulation.experiments import NO_NOISE, Merit, PlannedRun, Progress, fly_all, scenario_of
from malta.synthesis import Controller

# From where MALTA returns: starting positions and tilts at rest, beside what its force limit allows at best.
#
# The paper leaves "stability limits with large radial and axial displacements" to future work. Reading: the mover is
# released at rest, the controller knows where, and it returns if after a while both sensor planes are inside the
# clearance of the touchdown bearings. These bearings are far inside the limits of the drive, so maps are of a machine
# without them, whose attraction stays proportional to the displacement.


PLANES = (("x", "beta"), ("y", "alpha"), ("z", "x"))  # of the maps: across and up
RAYS = {"x": ("x", 1), "y up": ("y", 1), "y down": ("y", -1), "beta": ("beta", 1)}
RUN_TIME = 0.15  # s of a run: some 30 time constants of the unstable modes
MAP_WIDTH = 1.2  # half width of a map in multiples of what the force limit allows
RAY_STARTS, REFINEMENTS = (
    64,
    2,
)  # starts on a ray, and how often the interval in which it ends is divided by them
RANDOM_STARTS = 1024  # starts inside the clearance
MAP_WORK_SHARE = 0.7  # share of the work that the maps are


@dataclass(frozen=True, eq=False)
class _Released:
    """A machine that is released at many places."""

    plant: Plant
    controller: Controller
    scenario: Scenario
    clearance: float  # m, of the touchdown bearings as built

    def which_return(self, starts: Mapping[str, FloatArray], progress: Progress | None = None) -> FloatArray:
        """1 for each start from which the mover returns without touching anything, else 0."""
        found = simulate_many(
            self.plant, self.controller, self.scenario, {}, starts=starts, progress=progress
        )
        off = np.hypot(found.last[:, [0, 2]], found.last[:, [1, 3]]).max(axis=1)
        return np.asarray((found.completed == 1) & (off < self.clearance), dtype=float)


def capture(
    plant: Plant,
    controller: Controller,
    *,
    points: int = 31,
    progress: Progress | None = None,
    **options: Any,
) -> Experiment:
    """From which displacements and tilts, at rest, the mover returns: maps of `points` a side, beside what the force
    limit allows at best; starts inside the clearance.

    Raises InputError without a C compiler: these are thousands of runs.
    """
    par: Any = plant.parameters
    bounds = _bounds(plant)
    furthest = max(float(np.hypot(*(b * (1, par.l_S)).T).max()) for b in bounds.values())
    wide = plant.variant(replace(par, r_max=2 * MAP_WIDTH * furthest))
    scenario = scenario_of("capture", RUN_TIME, references.hold, NO_NOISE | options)
    if not is_compiled(plant, controller, scenario):
        raise InputError("simulate", "capture", "no C compiler", "one: these are thousands of runs")
    free = _Released(wide, controller, scenario, par.r_max)
    parts = _PartProgress(progress)
    maps, axes = _maps(free, bounds, points, parts.until(MAP_WORK_SHARE))
    allowed = {
        name: reach(bounds[_plane_of(state)], _along(state, sign)) for name, (state, sign) in RAYS.items()
    }
    found = _furthest_returning(free, allowed, parts.until(0.9))
    inside = replace(free, plant=plant).which_return(_starts_inside(plant), parts.until(0.95))
    wanted = _examples(plant, free, found, options)
    cases, cut = fly_all(wanted, parts.until(1.0), options)
    curves = axes | maps | _clearances(plant) | {f"bound {' '.join(plane)}": b for plane, b in bounds.items()}
    merits = (
        *_merits(found, allowed),
        Merit("starts inside the clearance that return", inside.mean(), "percent", better="high"),
    )
    return Experiment("capture", "From where does it return?", cases, merits, curves, interrupted=cut)


class _PartProgress:
    """Progress of parts of the work, one after the other."""

    def __init__(self, progress: Progress | None) -> None:
        self.progress, self.done = progress, 0.0

    def until(self, share: float) -> Progress | None:
        """The progress function of the part that ends at this share of the work."""
        first, self.done = self.done, share
        progress = self.progress
        return None if progress is None else lambda part: progress(first + (share - first) * part)


def _plane_of(state: str) -> tuple[str, str]:
    """The plane of the first map that a state is in."""
    return next(plane for plane in PLANES if state in plane)


def _along(state: str, sign: float) -> tuple[float, float]:
    """The direction of a state in the plane of its map."""
    first, _ = _plane_of(state)
    return (sign, 0.0) if state == first else (0.0, sign)


def _bounds(plant: Plant) -> dict[tuple[str, str], FloatArray]:
    """What the force limit allows in the planes of a displacement and a tilt, with the loads at the centre."""
    model = linearize(plant, plant.at())
    x = ca.SX(ca.DM(plant.at().x))
    u = ca.SX.zeros(len(plant.inputs))
    pulled = plant.f(x, u, plant.load(x)) - plant.f(x, u, ca.SX.zeros(len(plant.disturbances)))
    load = np.array(ca.evalf(pulled)).ravel()[list(plant.controlled)]
    return {plane: recoverable(model, plane, load) for plane in PLANES[:2]}


def _clearances(plant: Plant) -> dict[str, FloatArray]:
    """Corners of the clearance of touchdown bearings and travel in each plane of the maps, 4 x 2."""
    par: Any = plant.parameters
    r, tilt, z = par.r_max, par.r_max / par.l_S, plant.stroke.travel
    diamond = np.array([(r, 0.0), (0.0, tilt), (-r, 0.0), (0.0, -tilt)])
    box = np.array([(z, r), (-z, r), (-z, -r), (z, -r)])
    return {f"clearance {' '.join(plane)}": box if "z" in plane else diamond for plane in PLANES}


def _maps(
    free: _Released, bounds: Mapping[tuple[str, str], FloatArray], points: int, progress: Progress | None
) -> tuple[dict[str, FloatArray], dict[str, FloatArray]]:
    """Whether the mover returns, on a grid in each plane, and the grids' axes."""
    widest = {plane: MAP_WIDTH * np.abs(b).max(axis=0) for plane, b in bounds.items()}
    reach_x = widest[PLANES[0]][0]
    widest[PLANES[2]] = np.array([0.99 * free.plant.stroke.travel, reach_x])
    axes = {
        f"axis {' '.join(plane)} {name}": np.linspace(-half, half, points)
        for plane, halves in widest.items()
        for name, half in zip(plane, halves, strict=True)
    }
    grids = [np.meshgrid(*(axes[f"axis {' '.join(plane)} {name}"] for name in plane)) for plane in PLANES]
    starts = {name: np.zeros(len(PLANES) * points**2) for name in ("x", "y", "z", "alpha", "beta")}
    for n, (plane, grid) in enumerate(zip(PLANES, grids, strict=True)):
        for name, values in zip(plane, grid, strict=True):
            starts[name][n * points**2 : (n + 1) * points**2] = values.ravel()
    found = free.which_return(starts, progress).reshape(len(PLANES), points, points)
    return {f"map {' '.join(plane)}": one for plane, one in zip(PLANES, found, strict=True)}, axes


def _furthest_returning(
    free: _Released, allowed: Mapping[str, float], progress: Progress | None
) -> dict[str, float]:
    """The furthest start on each ray from which, and from all nearer ones, the mover returns, SI."""
    low, high = np.zeros(len(RAYS)), np.full(len(RAYS), MAP_WIDTH)
    parts = _PartProgress(progress)
    for n in range(1, REFINEMENTS + 1):
        shares = np.linspace(low, high, RAY_STARTS, axis=1)
        starts = {name: np.zeros(shares.shape) for name in ("x", "y", "beta")}
        for k, (ray, (state, sign)) in enumerate(RAYS.items()):
            starts[state][k] = sign * allowed[ray] * shares[k]
        flat = {name: values.ravel() for name, values in starts.items()}
        found = free.which_return(flat, parts.until(n / REFINEMENTS)).reshape(shares.shape)
        first = np.where(found.all(axis=1), RAY_STARTS - 1, np.argmin(found, axis=1))  # that does not return
        rows = np.arange(len(RAYS))
        low, high = shares[rows, np.maximum(first - 1, 0)], shares[rows, first]
    return {ray: float(share) * allowed[ray] for ray, share in zip(RAYS, low, strict=True)}


def _starts_inside(plant: Plant) -> dict[str, FloatArray]:
    """Starts inside the clearance of both touchdown bearings and the travel, evenly spread over all five positions."""
    from scipy.stats import qmc  # a third of a second to import, for this experiment alone

    par: Any = plant.parameters
    u = np.asarray(qmc.Sobol(5, rng=0).random_base2(round(math.log2(RANDOM_STARTS))))
    radius, angle = 0.99 * par.r_max * np.sqrt(u[:, :2]), 2 * math.pi * u[:, 2:4]
    (x1, x2), (y1, y2) = (radius * np.cos(angle)).T, (radius * np.sin(angle)).T
    p = ca.DM(np.vstack([x1, y1, x2, y2, 0.99 * plant.stroke.travel * (2 * u[:, 4] - 1)]))
    names = [s.name for s in plant.states[:5]]
    symbol = ca.SX.sym("p", 5)
    position = ca.Function("position", [symbol], [plant.position_of(symbol)]).map(RANDOM_STARTS)
    return dict(zip(names, np.array(position(p)), strict=True))


def _examples(
    built: Plant, free: _Released, found: Mapping[str, float], options: Mapping[str, Any]
) -> list[tuple[Plant, Controller, PlannedRun]]:
    """Runs from just inside the limits and just beyond one, and of the machine as built from near its bearing."""
    starts = (
        (free.plant, "x, inside", {"x": 0.98 * found["x"]}),
        (free.plant, "x, beyond", {"x": 1.02 * found["x"]}),
        (free.plant, "beta, inside", {"beta": 0.98 * found["beta"]}),
        (built, "x, clearance", {"x": 0.95 * free.clearance}),
    )
    wanted = []
    for plant, label, start in starts:
        scenario = scenario_of(
            "capture", RUN_TIME, references.hold, NO_NOISE | {"start": start} | dict(options)
        )
        wanted.append((plant, free.controller, PlannedRun(label, scenario, _run_merits)))
    return wanted


def _run_merits(run: Trajectory) -> tuple[Merit, ...]:
    """How far a released mover went, when it was back, and the largest bearing current."""
    off = np.abs(run.p[:, :4]).max(axis=1)
    late = np.flatnonzero(off > BACK_DISTANCE)
    back = float(run.t[late[-1]]) if len(late) and late[-1] + 1 < len(run.t) else math.nan
    bearings = [k for k in range(len(run.plant.inputs)) if k != run.plant.thrust_input]
    current = np.abs(run.force[:, bearings] / np.array(run.plant.actuator.force_constant)[bearings]).max()
    return (
        Merit("furthest off centre", float(off.max()), "mm"),
        Merit(f"within {BACK_DISTANCE * 1e6:.0f} um after", back, "ms", key="settled"),
        Merit("largest bearing current", float(current), "A"),
    )


BACK_DISTANCE = 20e-6  # m, off centre: the mover is back


def _merits(found: Mapping[str, float], allowed: Mapping[str, float]) -> tuple[Merit, ...]:
    """The furthest start that returns on each ray, the furthest that the force limit allows, and their ratio."""
    merits = []
    for ray, (state, _) in RAYS.items():
        unit = "mrad" if state in ("alpha", "beta") else "mm"
        merits += [
            Merit(f"{ray}: furthest start that returns", found[ray], unit, better="high"),
            Merit(f"{ray}: furthest that the force limit allows", allowed[ray], unit, better="high"),
            Merit(f"{ray}: their ratio", found[ray] / allowed[ray], "percent", better="high"),
        ]
    return tuple(merits)


# Starting positions from which bounded forces can bring an unstable linear model back to rest.
#
# In a mode with the real pole lambda > 0 and the left eigenvector w, the coordinate s = w x obeys s' = lambda s + w B
# u + w d. It can be brought back if, and only if, s lies in the set of -integral of e^(-lambda t) (w B u + w d) dt
# over all forces |u_i| <= limit_i. No controller returns from beyond: stable modes and rates of force only take away
# from it.


STABLE_RATE = 1.0  # rad/s: slower modes count as stable


def recoverable(
    model: LinearModel, plane: tuple[str, str], load: FloatArray, directions: int = 360
) -> FloatArray:
    """The boundary of the recoverable starts at rest in the plane of two positions, directions x 2, SI.

    plane : names of two positions; the others are zero, and so are all rates
    load : rates of change of the states by a constant load, n

    For each direction c the furthest point of the convex set, reached by u_i = -limit_i sign(c e^(-lambda t) w B_i),
    which changes its sign once at most.

    Raises CheckError unless two real unstable modes, and only two, move the plane's positions.

        recoverable(model, ("x", "beta"), np.zeros(10))[:, 0].max()
    """
    names = [s.name for s in model.plant.design_states]
    columns = [names.index(name) for name in plane]
    poles, W = _unstable_modes(model.A, columns)
    if len(poles) != 2 or abs(poles[0] - poles[1]) < 1e-9 * poles[0]:
        raise CheckError(
            f"{model.plant.name}: {' and '.join(plane)} have {len(poles)} separate unstable modes"
        )
    limits = np.array(model.plant.actuator.force_limit)
    W /= (np.abs(W @ model.B) @ limits / poles)[:, None]  # the set reaches from -1 to 1 in both coordinates
    b = W @ model.B  # 2 x m
    angle = np.linspace(0, 2 * math.pi, directions, endpoint=False)
    furthest = np.array([_furthest(np.array([math.cos(a), math.sin(a)]), poles, b, limits) for a in angle])
    boundary: FloatArray = np.linalg.solve(W[:, columns], (furthest - (W @ load) / poles).T).T
    return boundary


def _unstable_modes(A: FloatArray, columns: list[int]) -> tuple[FloatArray, FloatArray]:
    """Poles and left eigenvectors (rows) of the unstable modes that positions of these columns move."""
    values, vectors = np.linalg.eig(A.T)
    chosen = (values.real > STABLE_RATE) & (np.abs(vectors[columns]).max(axis=0) > 1e-9)
    return values[chosen].real, vectors[:, chosen].real.T


def _furthest(c: FloatArray, poles: FloatArray, b: FloatArray, limits: FloatArray) -> FloatArray:
    """The point of the set that is furthest along c: 2."""
    point = np.zeros(2)
    for b_i, limit in zip(b.T, limits, strict=True):
        first, second = c * b_i
        sign = np.sign(first + second) or 1.0
        ratio = -first / second if second else 0.0
        switch = math.log(ratio) / (poles[0] - poles[1]) if ratio > 0 else math.inf
        left = np.exp(-poles * switch) if switch > 0 else np.zeros(2)  # what comes after the switch
        point += limit * sign * b_i / poles * (1 - 2 * left)
    return point


def reach(boundary: FloatArray, direction: tuple[float, float]) -> float:
    """How far a boundary is from the centre along a direction, in multiples of it; NaN where the ray misses it."""
    along, across = np.array(direction), np.array([-direction[1], direction[0]])
    after = np.roll(boundary, -1, axis=0)
    side, next_side = boundary @ across, after @ across
    with np.errstate(divide="ignore", invalid="ignore"):
        share = side / (side - next_side)
        found = ((boundary + share[:, None] * (after - boundary)) @ along) / (along @ along)
    crossed = (side * next_side <= 0) & (found > 0) & np.isfinite(found)
    return float(found[crossed].max()) if crossed.any() else math.nan
