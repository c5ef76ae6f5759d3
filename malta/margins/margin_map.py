"""The margin map: where a loop is stable in the plane of two parameters, and how much of it is proven.

Two routes to one picture: eigenvalues on a grid show the boundary, at some places of the travel and between grid points
by interpolation, which proves nothing; the margin is proven for every point of its box and every place. The box must
not leave the stable region, and touches its boundary where the witness is.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from malta.errors import InputError, require_known
from malta.margins.travel import extent_of, travel_loops, travel_margin
from malta.model.parameters import units_of
from malta.processes import on_one_thread
from malta.proof.uncertain import instability

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Plant
    from malta.proof.margin import Margin
    from malta.proof.uncertain import Compensator, UncertainSystem
    from malta.synthesis.controller import Controller

GRID = 25  # values of each parameter
ABOUT = (0.97, 1.0, 1.01, 1.03)  # of the proven box: values beside those of the grid
MOST_PLACES = 9  # ends and middle of what does not grow with the margin
LEAST, WIDEST, BEYOND = 1.5, 8.0, 1.6  # of the box: the smallest and the largest map; times the lost margin


@dataclass(frozen=True, eq=False)
class MarginMap:
    """Stability over two parameters of a machine, the others as they are.

    name : of the design
    x, y : the parameters
    units : of x and of y, SI
    nominal : values of x and of y, SI
    half : half widths of the uncertainty box in x and in y, SI; a margin of 1 is this box
    x_values, y_values : of the grid, SI
    growth : of the worst pole at the grid points, len(y_values) x len(x_values), 1/s: positive where unstable
    margin : of the parameters `moved`, in multiples of the box; None: not proven
    parameters : that the margin moves; more than x and y where it is proven for others at once
    where : the places that the margin covers, in words
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
    parameters: tuple[str, ...]
    where: str

    @property
    def proven(self) -> float:
        """The proven margin in multiples of the box; 0 where nothing is proven."""
        return 0.0 if self.margin is None else self.margin.lower or 0.0

    @property
    def witness(self) -> tuple[float, float] | None:
        """The values of x and y with which the loop is at its limit of stability; None without them."""
        if self.margin is None or self.margin.witness is None:
            return None
        return self.margin.witness[self.x], self.margin.witness[self.y]


@on_one_thread
def margin_map_of(
    plant: Plant,
    controller: Controller,
    names: tuple[str, str],
    uncertainty: Mapping[str, float],
    *,
    margin: Margin | None = None,
    proof: bool = True,
    lost: float = LEAST,
) -> MarginMap:
    """Map the stability of a machine's loop over two of its parameters.

    names : x and y
    uncertainty : relative half range of each parameter; that of x and of y is the box of the map
    margin : of all of `uncertainty`, from `malta.verify`; None: that of x and y alone is proven here
    proof : False: without a margin, where none is given
    lost : of a map without a margin: where about stability is lost, in multiples of the box, which sets its width

    Raises InputError for a parameter that is not uncertain, and for one with itself.

    Example: `margin_map_of(plant, controller, ("K_A", "m"), {"m": 0.2, "K_A": 0.2}).proven`
    """
    for axis, name in zip("xy", names, strict=True):
        require_known([name], uncertainty, f"--{axis}", "")
    x, y = names
    if x == y:
        raise InputError("--y", "", repr(y), f"another parameter than {x}")
    box = {name: uncertainty[name] for name in names}
    moved = tuple(uncertainty) if margin is not None else names
    if margin is None and proof:
        margin = travel_margin(plant, controller, box)
    nominal = np.array([float(getattr(plant.parameters, name)) for name in names])
    half = np.abs(nominal) * np.array([box[x], box[y]])
    if margin is not None:
        lost = margin.upper if math.isfinite(margin.upper) else LEAST
    reach = min(max(BEYOND * lost, LEAST), WIDEST)
    loops, over = travel_loops(plant, controller, names)
    limits = np.array(loops[0][0].limits or [(-math.inf, math.inf)] * len(loops[0][0].names))[:2]
    low, high = nominal - reach * half, nominal + reach * half
    room = 1e-3 * np.abs(nominal)
    low, high = np.maximum(low, limits[:, 0] + room), np.minimum(high, limits[:, 1] - room)
    proven = 0.0 if margin is None else margin.lower or 0.0
    values = [_values(*of, proven) for of in zip(low, high, nominal, half, strict=True)]
    units = units_of(plant.parameters)
    return MarginMap(
        controller.name, x, y, (units[x], units[y]), (float(nominal[0]), float(nominal[1])),
        (float(half[0]), float(half[1])), values[0], values[1], _growth(loops, over, names, values),
        margin, moved, str(extent_of(plant, moved)),
    )  # fmt: skip


def _values(low: float, high: float, nominal: float, half: float, proven: float) -> FloatArray:
    """Values of one axis: even ones, and some about the edges of the proven box, where the boundary matters."""
    edges = [nominal + side * share * proven * half for side in (-1, 1) for share in ABOUT]
    return np.unique([*np.linspace(low, high, GRID), *(edge for edge in edges if low < edge < high)])


def _growth(
    loops: list[tuple[UncertainSystem, Compensator]],
    over: Mapping[str, tuple[float, float]],
    names: tuple[str, str],
    values: list[FloatArray],
) -> FloatArray:
    """The growth of the worst pole over the grid, the worst of all loops and of the ends and middles of `over`."""
    X, Y = np.meshgrid(*values)
    worst = np.full(X.size, -math.inf)
    for system, compensator in loops:
        known = list(system.names)
        ends = [(low, high, (low + high) / 2) for name, (low, high) in over.items() if name in known]
        where = [known.index(name) for name in over if name in known]
        for place in itertools.islice(itertools.product(*ends), MOST_PLACES):
            rows = np.tile(system.nominal, (X.size, 1))
            rows[:, where] = place
            rows[:, [known.index(name) for name in names]] = np.column_stack([X.ravel(), Y.ravel()])
            worst = np.maximum(worst, instability(system, compensator, rows))
    return worst.reshape(X.shape)
