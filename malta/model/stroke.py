"""The stroke of a plant: the output that travels, the input that drives it, and the mass that moves."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, eq=False)
class Stroke:
    """The long motion of a machine, which strokes, travel and thrust are about; a machine may have none.

    name : of the output and state that the stroke moves; "": the machine has no stroke
    thrust : name of the input that drives the stroke
    travel : either way, m
    mass : kg, moved by the thrust

    >>> import malta
    >>> malta.plant_of(malta.read("data/tubular.toml")).stroke
    Stroke(name='z', thrust='f_D', travel=0.015, mass=0.36)
    """

    name: str = ""
    thrust: str = ""
    travel: float = 0.0
    mass: float = 0.0
