"""The intervals that one proof covers beside the uncertainty: the travel of the machine, and some parameters."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from malta.model.parameters import units_of

if TYPE_CHECKING:
    from malta.model.plant import Plant

Interval = tuple[float, float]


@dataclass(frozen=True)
class Extent:
    """The intervals that every proof covers (SI), and the course, along which the places of the machine lie.

    Example: `str(extent_of(rotor))` is "for all Omega in 0 .. 2094 rad/s" where `rotor.over` is {"Omega": (0, 2094)}.
    """

    stroke: str = ""  # a state; "": the machine has no travel
    travel: float = 0.0  # of the stroke, either way, m
    over: Mapping[str, Interval] = field(default_factory=dict)  # intervals of parameters, SI
    units: Mapping[str, str] = field(default_factory=dict)  # SI units of these parameters

    @property
    def intervals(self) -> dict[str, Interval]:
        """All intervals by name."""
        along = {self.stroke: (-self.travel, self.travel)} if self.stroke else {}
        return along | dict(self.over)

    @property
    def course(self) -> str:
        """The name of the course: the stroke, else the first of the parameters; "" without either."""
        return self.stroke or next(iter(self.over), "")

    @property
    def unit(self) -> str:
        """The SI unit of the course."""
        return "m" if self.stroke else self.units.get(self.course, "1")

    @property
    def values(self) -> str:
        """The intervals of parameters in words: "all Omega in 0 .. 2094 rad/s"; "" without any."""
        parts = (
            f"{name} in {low:.4g} .. {high:.4g} {self.units.get(name, '1')}".removesuffix(" 1")
            for name, (low, high) in self.over.items()
        )
        return "all " + ", ".join(parts) if self.over else ""

    def __str__(self) -> str:
        everywhere = ["over the travel"] if self.stroke else []
        return " and ".join([*everywhere, *([f"for {self.values}"] if self.over else [])])


NOWHERE = Extent()  # a machine without a travel and without intervals of parameters


def extent_of(plant: Plant, names: Iterable[str] = ()) -> Extent:
    """The extent of a plant's proofs, without the uncertain parameters `names`, whose ranges grow with the margin."""
    uncertain = set(names)
    over = {name: interval for name, interval in plant.over.items() if name not in uncertain}
    units = units_of(plant.parameters)
    stroke = plant.stroke if plant.has_stroke else ""
    return Extent(stroke, plant.travel, over, {name: units[name] for name in over})


def machine_at(plant: Plant, course: str, position: float) -> tuple[Plant, dict[str, float]]:
    """The plant at a position of its course (SI), and the states that are not zero there."""
    if plant.has_stroke:
        return plant, {plant.stroke: position}
    if not course:
        return plant, {}
    par: Any = plant.parameters
    return plant.variant(replace(par, **{course: position})), {}


def positions_of(plant: Plant, extent: Extent, shares: Iterable[float]) -> tuple[tuple[float, ...], ...]:
    """The places of a machine (SI): +- each share of its travel; else the ends and the own value of a parameter."""
    if extent.stroke:
        return tuple(tuple(dict.fromkeys((share * plant.travel, -share * plant.travel))) for share in shares)
    own = own_position(plant, extent, {})
    return tuple((value,) for value in sorted({own, *extent.over.get(extent.course, ())}))


def own_position(plant: Plant, extent: Extent, states: Mapping[str, float]) -> float:
    """The position of the machine along its course (SI): the stroke in `states`, else the value of the parameter."""
    if extent.stroke or not extent.course:
        return states.get(extent.stroke, 0.0)
    return float(getattr(plant.parameters, extent.course))
