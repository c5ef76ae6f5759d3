"""Signals of a machine: named scalars with their units, and the kinds of its functions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

Coordinates = Literal[
    "signals", "positions"
]  # of integrals and process noise: of the outputs, or of the positions
CasadiFn = Callable[..., Any]  # takes and returns casadi SX, MX or DM
DEFAULT: Any = None  # stands for a function that follows from the other fields


class Signal(NamedTuple):
    """A named scalar with its SI unit.

    name : as it stands in files and figures
    unit : SI, "1" for a pure number

    >>> import malta
    >>> malta.model.Signal("z", "m")
    Signal(name='z', unit='m')
    """

    name: str
    unit: str
