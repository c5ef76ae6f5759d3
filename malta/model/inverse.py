"""Whether the currents of a command make what it commands, along the states of a machine, in words."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from malta.model.signals import Signal

LIMIT_TOLERANCE = 1e-9  # of the limit of a command
SHOWN_STATES = 7  # states


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
        return all(m.share <= LIMIT_TOLERANCE for m in self.mismatches)

    def __repr__(self) -> str:
        return str(self)

    def __str__(self) -> str:
        word = "is" if self.exact else "is not"
        along = ", ".join(m.state.name for m in self.mismatches)
        lines = [f"{self.machine}: `currents` {word} the inverse of `forces` along {along}"]
        worst = sorted((m for m in self.mismatches if m.share > LIMIT_TOLERANCE), key=lambda m: -m.share)
        for m in worst[:SHOWN_STATES]:
            s, u = m.state, m.input
            room = f"in {m.low:.4g} .. {m.high:.4g} {s.unit}: at {m.place:.4g}" if m.low < m.high else "= 0:"
            lines.append(
                f"  {s.name} {room} the currents of {u.name} = "
                f"{m.command:.4g} {u.unit} make {m.made:.4g} {u.unit}, {100 * m.share:.3g} % of its limit apart"
            )
        if len(worst) > SHOWN_STATES:
            lines.append(f"  and along {len(worst) - SHOWN_STATES} more states, less than these")
        return "\n".join([*lines, f"  {self.undefined}"] if self.undefined else lines)
