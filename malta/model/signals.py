"""Signals of a machine, arrays of their values, and whether commanded ones are those that its currents make.

What a plant is made of stands below it: this module imports none of a model's.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    FloatArray = NDArray[np.floating[Any]]
    ComplexArray = NDArray[np.complexfloating[Any, Any]]

CasadiFn = Callable[..., Any]  # takes and returns casadi SX, MX or DM
EXACT = 1e-9  # of the limit of a command
SHOWN = 7  # states


class Signal(NamedTuple):
    """A named scalar with its SI unit.

    name : as it stands in files and figures
    unit : SI, "1" for a pure number

    >>> import malta
    >>> malta.Signal("z", "m")
    Signal(name='z', unit='m')
    """

    name: str
    unit: str


def readonly(array: ArrayLike) -> FloatArray:
    """A read-only copy as floats; a read-only array of floats is returned unchanged."""
    if isinstance(array, np.ndarray) and array.dtype == float and not array.flags.writeable:
        return array
    copy = np.array(array, dtype=float)
    copy.flags.writeable = False
    return copy


class Mismatch(NamedTuple):
    """Along one state: the command whose currents miss it most."""

    state: Signal
    low: float  # ends of the clearance, SI
    high: float
    place: float  # the state there
    input: Signal
    command: float
    made: float  # what the currents of the command make
    share: float  # the difference, of the limit of the input, or of 1 N or 1 N m where it has none


@dataclass(frozen=True)
class InverseCheck:
    """Whether `currents` is the inverse of `forces` along the states of a machine.

    machine : its name
    mismatches : of each state with a clearance or a travel, where currents miss their command most
    undefined : commands without currents at the states' zero, in words; "": none

    >>> import malta
    >>> malta.plant_of(malta.read("data/halbach.toml")).check().exact
    True
    """

    machine: str
    mismatches: tuple[Mismatch, ...]
    undefined: str = ""

    @property
    def exact(self) -> bool:
        """Whether every command was made within rounding."""
        return all(m.share <= EXACT for m in self.mismatches)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        word = "is" if self.exact else "is not"
        along = ", ".join(m.state.name for m in self.mismatches)
        lines = [f"{self.machine}: `currents` {word} the inverse of `forces` along {along}"]
        worst = sorted((m for m in self.mismatches if m.share > EXACT), key=lambda m: -m.share)
        for m in worst[:SHOWN]:
            s, u = m.state, m.input
            room = f"in {m.low:.4g} .. {m.high:.4g} {s.unit}: at {m.place:.4g}" if m.low < m.high else "= 0:"
            lines.append(
                f"  {s.name} {room} the currents of {u.name} = "
                f"{m.command:.4g} {u.unit} make {m.made:.4g} {u.unit}, {100 * m.share:.3g} % of its limit apart"
            )
        if len(worst) > SHOWN:
            lines.append(f"  and along {len(worst) - SHOWN} more states, less than these")
        return "\n".join([*lines, f"  {self.undefined}"] if self.undefined else lines)
