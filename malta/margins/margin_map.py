"""The margin map: where a loop is stable in the plane of two parameters, and how much of it is proven.

A point of the plane stands for all machines with these two values: the other uncertain parameters are anywhere in the
box, times the multiple of it at which the point lies, or all nominal. Eigenvalues at the ends and middles of what is
not drawn show the boundary, which proves nothing; the margin is proven for every point of its box, every value of the
others in theirs and every place. The box must not leave the stable region, and touches its boundary where the loop is
lost. Whoever draws this plane, or is asked about a point of it, takes the machines from here.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import itemgetter
from typing import Literal, NamedTuple, get_args

import numpy as np

from malta.arrays import ComplexArray, FloatArray
from malta.errors import InputError, require_known
from malta.linear.closed_loops import closed_loop, instability
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.sampled_loops import continuous_poles
from malta.margins.travel import extent_of, travel_loops, travel_margin
from malta.model.parameters import units_of, words_of
from malta.model.plant import Plant
from malta.processes import on_one_thread
from malta.proof.margin import Margin
from malta.synthesis.controller import Controller

GRID, COARSE_STEP = 25, 4  # values of each parameter; every so many of them are looked at first
BOX_FACTORS = (0.97, 1.0, 1.01, 1.03)  # of the proven box: values beside those of the grid
MOST_PLACES = 9  # ends and middle of what does not grow with the margin
DERIVED_PLACES = 9  # of a parameter that others follow, as the position that a cogging has
MOST_SIDES = 9  # corners and middle of the box of the parameters that are not drawn
MIN_SIZE, MAX_SIZE, LOSS_FACTOR = 1.5, 8.0, 1.6  # of the box: the map; times the lost margin
ROOM = 1e-3  # of a nominal value, to a limit of its parameter
EDGE = 1 - 1e-6  # of the multiple of a witness: parameters that reach it

Others = Literal["box", "nominal"]  # what the parameters are that are not drawn


@dataclass(frozen=True, eq=False)
class Plane:
    """The machines that the points of a plane stand for: values of x and y, and of what is not drawn.

    names : x and y, then the parameters that vary and are not drawn
    loops : of the machine in these names, and in `over`, whose intervals do not grow with the multiple
    nominal, half, low, high : by name, SI: values, half widths of the box, ends of what is looked at
    """

    names: tuple[str, ...]
    loops: list[tuple[UncertainSystem, Compensator]]
    over: Mapping[str, tuple[float, float]]
    nominal: FloatArray
    half: FloatArray
    low: FloatArray
    high: FloatArray

    def growth(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """The growth of the worst pole of all machines on a grid, len(y) x len(x), 1/s.

        Of the machines of a point those are looked at that are the worst on a coarse grid.
        """
        some, every = (_points(x[::step], y[::step]) for step in (COARSE_STEP, 1))
        worst = np.full(len(every), -math.inf)
        for system, law in self.loops:
            ends = self._ends(system)
            found = np.array([instability(system, law, self._rows(system, some, *end)) for end in ends])
            for k in np.unique(found.argmax(axis=0)):
                worst = np.maximum(worst, instability(system, law, self._rows(system, every, *ends[k])))
        return worst.reshape(len(y), len(x))

    def worst(self, x: float, y: float) -> Lost:
        """The machine at a point whose worst pole grows fastest, and the poles of its loop."""
        each = (
            (system, law, self._rows(system, np.array([[x, y]]), *end))
            for system, law in self.loops
            for end in self._ends(system)
        )
        growth, (system, law, rows) = max(
            ((instability(*one).item(), one) for one in each), key=itemgetter(0)
        )
        (poles,) = np.linalg.eigvals(closed_loop(system, law, rows))
        if law.sample_time is not None:
            poles = continuous_poles(1 + law.sample_time * poles, law.sample_time)
        return Lost(dict(zip(system.names, rows[0].tolist(), strict=True)), growth, poles)

    def _ends(self, system: UncertainSystem) -> list[tuple[tuple[float, ...], FloatArray]]:
        """Ends and middles of the intervals that do not grow, each with all sides of the box of the others."""
        derived = system.derived
        free = {n: ends for n, ends in self.over.items() if n in system.names}
        if derived is not None:
            free = {n: ends for n, ends in free.items() if n not in derived.intervals}
        each = (
            np.linspace(low, high, DERIVED_PLACES).tolist()
            if derived is not None and name == derived.of
            else (low, high, (low + high) / 2)
            for name, (low, high) in free.items()
        )
        places = []
        for values in itertools.islice(itertools.product(*each), MOST_PLACES):
            at = dict(zip(free, values, strict=True))
            at |= derived.at(at[derived.of]) if derived is not None and derived.of in at else {}
            places.append(tuple(at[name] for name in self.over if name in system.names))
        return [*itertools.product(places, _sides(len(self.names) - 2))]

    def _rows(
        self, system: UncertainSystem, points: FloatArray, place: tuple[float, ...], side: FloatArray
    ) -> FloatArray:
        """The parameters of a system at points of the plane: one machine for each."""
        known, multiple = list(system.names), (np.abs(points - self.nominal[:2]) / self.half[:2]).max(axis=1)
        beside = self.nominal[2:] + multiple[:, None] * side * self.half[2:]
        rows = np.tile(system.nominal, (len(points), 1))
        rows[:, [known.index(name) for name in self.over if name in known]] = place
        rows[:, [known.index(name) for name in self.names]] = np.hstack(
            [points, np.clip(beside, self.low[2:], self.high[2:])]
        )
        return rows


class Lost(NamedTuple):
    """The machine of a point that is nearest to instability, or furthest beyond."""

    values: Mapping[str, float]  # of its parameters, SI
    growth: float  # of the worst pole, 1/s
    poles: ComplexArray  # of the closed loop, rad/s


def _points(x: FloatArray, y: FloatArray) -> FloatArray:
    """The points of a grid as rows, x first."""
    return np.column_stack([values.ravel() for values in np.meshgrid(x, y)])


def _sides(count: int) -> Iterator[FloatArray]:
    """The middle and the ends of so many intervals: also on edges and faces while these are few, else the corners."""
    few = 3**count <= MOST_SIDES
    yield np.zeros(count)
    yield from map(np.array, itertools.product((-1.0, 0.0, 1.0) if few else (-1.0, 1.0), repeat=count))


@dataclass(frozen=True, eq=False)
class MarginMap:
    """Stability over two parameters of a machine, the others anywhere in the box or nominal.

    name : of the design
    x, y : the parameters
    units : of x and of y, SI
    nominal : values of x and of y, SI
    half : half widths of the uncertainty box in x and in y, SI; a margin of 1 is this box
    x_values, y_values : of the grid, SI
    growth : of the worst pole at the grid points, len(y_values) x len(x_values), 1/s: positive where unstable
    margin : of the parameters `moved`, in multiples of the box; None: not proven
    beside : the other uncertain parameters
    others : what these are: "box", anywhere in the box with the margin, or "nominal"
    where : the places that the margin covers, in words
    words : x and y with the words that the machine declares them with, as "magnet stiffness K_A"
    """

    name: str
    x: str
    y: str
    units: tuple[str, str]
    nominal: tuple[float, float]
    half: tuple[float, float]
    x_values: FloatArray
    y_values: FloatArray
    growth: FloatArray
    margin: Margin | None
    beside: tuple[str, ...]
    others: Others
    where: str
    words: tuple[str, str]

    @property
    def proven(self) -> float:
        """The proven margin in multiples of the box; 0 where nothing is proven."""
        return 0.0 if self.margin is None else self.margin.lower or 0.0

    @property
    def beside_text(self) -> str:
        """What the parameters are that are not drawn: "m K_D anywhere in the box"; "": all are drawn."""
        words = {"box": "anywhere in the box", "nominal": "nominal"}
        return f"{' '.join(self.beside)} {words[self.others]}" if self.beside else ""

    @property
    def witness(self) -> tuple[float, float] | None:
        """The values of x and y of the machine that is lost; None where there is none, or others alone reach its bound.

        The latter is no point of this plane, where the others are no further than x or y.
        """
        if self.margin is None or self.margin.witness is None:
            return None
        at = self.margin.witness[self.x], self.margin.witness[self.y]
        off = max(abs(v - m) / h for v, m, h in zip(at, self.nominal, self.half, strict=True))
        return at if off >= EDGE * self.margin.upper else None


@on_one_thread
def margin_map_of(
    plant: Plant,
    controller: Controller,
    names: tuple[str, str],
    uncertainty: Mapping[str, float],
    *,
    others: Others = "box",
    margin: Margin | None = None,
    proof: bool = True,
    lost: float = MIN_SIZE,
) -> MarginMap:
    """Map the stability of a machine's loop over two of its parameters.

    names : x and y
    uncertainty : relative half range of each parameter, whose box the map is of
    others : what the parameters are that are not drawn: "box", anywhere in the box, or "nominal"
    margin : of the parameters that vary, from `malta.verify`; None: it is proven here
    proof : False: without a margin, where none is given
    lost : of a map without a margin: where about stability is lost, in multiples of the box, which sets its width

    Raises InputError for a parameter that is not uncertain, and for one with itself.

    Example: `margin_map_of(plant, controller, ("K_A", "m"), {"m": 0.2, "K_A": 0.2}).proven`
    """
    plane = plane_of(plant, controller, names, uncertainty, others)
    box = {name: uncertainty[name] for name in plane.names}
    if margin is None and proof:
        margin = travel_margin(plant, controller, box)
    if margin is not None:
        lost = margin.upper if math.isfinite(margin.upper) else MIN_SIZE
    reach = min(max(LOSS_FACTOR * lost, MIN_SIZE), MAX_SIZE)
    nominal, half = plane.nominal[:2], plane.half[:2]
    low, high = (
        np.maximum(nominal - reach * half, plane.low[:2]),
        np.minimum(nominal + reach * half, plane.high[:2]),
    )
    proven = 0.0 if margin is None else margin.lower or 0.0
    values = [_values(*of, proven) for of in zip(low, high, nominal, half, strict=True)]
    x, y = names
    units, words = units_of(plant.parameters), words_of(plant.parameters)
    return MarginMap(
        controller.name, x, y, (units[x], units[y]), (float(nominal[0]), float(nominal[1])),
        (float(half[0]), float(half[1])), values[0], values[1], plane.growth(*values), margin,
        tuple(name for name in uncertainty if name not in names), others, str(extent_of(plant, box)),
        (words[x], words[y]),
    )  # fmt: skip


def plane_of(
    plant: Plant,
    controller: Controller,
    names: tuple[str, ...],
    uncertainty: Mapping[str, float],
    others: Others = "box",
) -> Plane:
    """The plane of two parameters of a machine. Raises InputError for one that is not uncertain, or is taken twice."""
    for axis, name in zip("xy", names, strict=True):
        require_known([name], uncertainty, f"--{axis}", "")
    if names[0] == names[1]:
        raise InputError("--y", "", repr(names[1]), f"another parameter than {names[0]}")
    if others not in get_args(Others):
        raise InputError("--others", "", repr(others), "box or nominal")
    if others == "box":
        names = (*names, *(name for name in uncertainty if name not in names))
    loops, over = travel_loops(plant, controller, names)
    nominal: FloatArray = np.array([float(getattr(plant.parameters, name)) for name in names])
    system = loops[0][0]
    limits = system.limits or [(-math.inf, math.inf)] * len(system.names)
    low, high = np.array([limits[system.names.index(name)] for name in names]).T
    room, shares = ROOM * np.abs(nominal), np.array([uncertainty[name] for name in names])
    return Plane(names, loops, over, nominal, np.abs(nominal) * shares, low + room, high - room)


def _values(low: float, high: float, nominal: float, half: float, proven: float) -> FloatArray:
    """Values of one axis: even ones, and some about the edges of the proven box, where the boundary matters."""
    edges = [nominal + side * share * proven * half for side in (-1, 1) for share in BOX_FACTORS]
    return np.unique([*np.linspace(low, high, GRID), *(edge for edge in edges if low < edge < high)])
