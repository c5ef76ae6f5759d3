"""What one proof covers beside the uncertainty: the travel of the machine, and intervals of its parameters."""

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
    """The intervals that every proof covers, in SI, and the one that places of the machine lie along.

    Example: `str(extent_of(rotor))` is "for all Omega in 0 .. 2094 rad/s" where `rotor.over` is {"Omega": (0, 2094)}.
    """

    stroke: str = ""  # a state; "": the machine has no travel
    travel: float = 0.0  # of it, either way, m
    over: Mapping[str, Interval] = field(default_factory=dict)  # of parameters
    units: Mapping[str, str] = field(default_factory=dict)  # theirs

    @property
    def intervals(self) -> dict[str, Interval]:
        """All of them by name."""
        along = {self.stroke: (-self.travel, self.travel)} if self.stroke else {}
        return along | dict(self.over)

    @property
    def course(self) -> str:
        """What places lie along: the stroke, else the first of the parameters; "" where there is neither."""
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


NOWHERE = Extent()  # a point: a machine without a travel, whose parameters stand


def extent_of(plant: Plant, names: Iterable[str] = ()) -> Extent:
    """What proofs of a plant cover; a parameter of `names` is uncertain, and grows with the margin instead."""
    uncertain = set(names)
    over = {name: interval for name, interval in plant.over.items() if name not in uncertain}
    units = units_of(plant.parameters)
    stroke = plant.stroke if plant.has_stroke else ""
    return Extent(stroke, plant.travel, over, {name: units[name] for name in over})


def machine_at(plant: Plant, course: str, position: float) -> tuple[Plant, dict[str, float]]:
    """The machine at a position of its course: the plant, and the states that are not zero there."""
    if plant.has_stroke:
        return plant, {plant.stroke: position}
    if not course:
        return plant, {}
    par: Any = plant.parameters
    return plant.variant(replace(par, **{course: position})), {}


def positions_of(plant: Plant, extent: Extent, shares: Iterable[float]) -> tuple[tuple[float, ...], ...]:
    """The places of a machine, SI: at shares of its travel either way; of a parameter both ends and its own value."""
    if extent.stroke:
        return tuple(tuple(dict.fromkeys((share * plant.travel, -share * plant.travel))) for share in shares)
    own = own_position(plant, extent, {})
    return tuple((value,) for value in sorted({own, *extent.over.get(extent.course, ())}))


def own_position(plant: Plant, extent: Extent, states: Mapping[str, float]) -> float:
    """The position of the machine itself along its course, at these states."""
    if extent.stroke or not extent.course:
        return states.get(extent.stroke, 0.0)
    return float(getattr(plant.parameters, extent.course))
