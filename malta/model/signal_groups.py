"""Groups of a machine's signals for figures and tables: one unit each, named by the WORDS of its experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from malta.model.parts import attribute_of
from malta.model.plant import Plant, Signal
from malta.units import FINE_UNITS

KINDS: Mapping[str, str] = {"N": "force", "N m": "torque"}


class SignalGroup(NamedTuple):
    """Signals of one unit that a figure shows together."""

    name: str
    unit: str  # SI
    columns: tuple[int, ...]

    @property
    def fine(self) -> str:
        """The unit of deviations."""
        return FINE_UNITS.get(self.unit, self.unit)


def outputs_of(plant: Plant) -> tuple[SignalGroup, ...]:
    """The machine's outputs: the stroke, if it has one, then the others by their units."""
    return _groups(plant, plant.outputs, plant.stroke_output if plant.has_stroke else None, "stroke")


def inputs_of(plant: Plant) -> tuple[SignalGroup, ...]:
    """The machine's inputs: the thrust, if it has a stroke, then the others by their units."""
    return _groups(plant, plant.inputs, plant.thrust_input if plant.has_stroke else None, "thrust")


class AxisUnits(NamedTuple):
    """Units of an output over the input of its axis, and of the input over the output."""

    compliance: str
    stiffness: str
    micro: bool  # whether the output is meant in millionths


def axis_units(output: str, force: str) -> AxisUnits:
    """The units of an axis; motions by forces and torques in millionths, all others in the units of the signals."""
    known = {"m": ("um/N", "N/um"), "rad": ("urad/(N m)", "N m/urad")}
    if output in known and force in KINDS:
        return AxisUnits(*known[output], micro=True)
    return AxisUnits(_per(output, force), _per(force, output), micro=False)


def _per(unit: str, other: str) -> str:
    """One unit over another."""
    if other == "1":
        return unit
    whole = any(sign in other for sign in " /")
    return "1" if unit == other else f"{unit}/({other})" if whole else f"{unit}/{other}"


def lateral_outputs(plant: Plant) -> tuple[SignalGroup, ...]:
    """The outputs across the stroke; of a machine with one output this output."""
    found = outputs_of(plant)
    return (found[1:] or found) if plant.has_stroke else found


def stroke_unit(plant: Plant) -> str:
    """The unit of deviations along the stroke."""
    unit: str = attribute_of(plant, "experiments", "STROKE_UNIT", outputs_of(plant)[0].fine)
    return unit


def _groups(plant: Plant, signals: Sequence[Signal], first: int | None, role: str) -> tuple[SignalGroup, ...]:
    words: Mapping[str, str] = attribute_of(plant, "experiments", "WORDS", {})
    found = []
    if first is not None:
        found.append(SignalGroup(words.get(role, signals[first].name), signals[first].unit, (first,)))
    others = [k for k in range(len(signals)) if k != first]
    for unit in dict.fromkeys(signals[k].unit for k in others):
        columns = tuple(k for k in others if signals[k].unit == unit)
        found.append(SignalGroup(words.get(unit, " ".join(signals[k].name for k in columns)), unit, columns))
    return tuple(found)
