"""The names that fields of a plant had before its groups: until version 0.4 a sentence says what to write for each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn

from malta.errors import InputError
from malta.model.actuator import Actuator
from malta.model.contacts import Contacts
from malta.model.sensors import Sensors
from malta.model.stroke import Stroke

GROUPS = {"actuator": Actuator, "sensors": Sensors, "contacts": Contacts, "stroke": Stroke}
# The field that holds what a field of the machine itself held; `contacts` and `stroke` are names of groups as well.
PLACES = {
    **dict.fromkeys(("currents", "forces", "limited", "tabulated", "windings", "electronics"), "actuator.{}"),
    **dict.fromkeys(("noise", "uniform", "resolution", "sense"), "sensors.{}"),
    **dict.fromkeys(("contact", "cushioned", "bearing"), "contacts.{}"),
    **dict.fromkeys(("thrust", "travel", "mass"), "stroke.{}"),
    "sensor_errors": "sensors.errors",
    "contacts": "contacts.names",
    "stroke": "stroke.name",
}


def refuse_flat(given: Mapping[str, Any], where: str = "Plant") -> None:
    """Raise InputError unless the fields of groups stand in their groups; the sentence spells these groups.

    given : arguments of a plant by name
    """
    flat, groups = [], dict[str, list[str]]()
    for name, value in given.items():
        if name not in PLACES and name not in GROUPS:
            continue
        if name in GROUPS and isinstance(value, GROUPS[name]):
            continue
        group, _, field = PLACES.get(name, f"{name}.").format(name).partition(".")
        groups.setdefault(group, []).append(f"{field}=..." if field else "...")
        flat.append(name)
    if flat:
        expected = ", ".join(f"{g}={GROUPS[g].__name__}({', '.join(own)})" for g, own in groups.items())
        raise InputError(str(given.get("name", where)), ", ".join(flat), "at the machine itself", expected)


def refuse_reading(name: str) -> NoReturn:
    """Raise InputError for a name that a field had, which says its place, and AttributeError for any other."""
    if name in PLACES:
        raise InputError("Plant", name, "a name that has moved", f"plant.{PLACES[name].format(name)}")
    raise AttributeError(f"'Plant' object has no attribute {name!r}")
