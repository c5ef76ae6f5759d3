"""Whether a machine's `currents` is the inverse of its `forces`: where, and by how much not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.model.equilibrium import chain

if TYPE_CHECKING:
    from malta.model.plant import FloatArray, Plant, Signal

PLACES = 21  # along a state, from one end to the other
SHARES = (-0.5, -0.1, 0.0, 0.1, 0.5)  # of the limits, commanded beside the preload
EXACT = 1e-9  # of the limit
FARTHEST, NEAREST = 1e6, 1e-9  # m or rad: a clearance lies between
SHOWN = 7  # states


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


def check_inverse(plant: Plant) -> InverseCheck:
    """Compare forces(x, currents(h(x), v)) with v along each position of a plant: see `Plant.check`."""
    made, currents = chain(plant, None)
    positions = plant.controlled[: plant.coordinates] if plant.second_order else plant.controlled
    found = []
    for index in positions:
        low, high = (_clearance(plant, index, sign) for sign in (-1.0, 1.0))
        if low < high:
            found.append(_mismatch(plant, (made, currents), index, (low, high)))
    if not found:  # no contact bounds any state
        found.append(_mismatch(plant, (made, currents), positions[0], (0.0, 0.0)))
    x = np.zeros(len(plant.states))
    lost = [
        f"{s.name} = {v[k]:.4g} {s.unit}"
        for k, s in enumerate(plant.inputs)
        for v in _commands(plant, k)
        if not np.isfinite(np.array(currents(x, v))).all()
    ]
    undefined = f"no currents for {', '.join(lost[:3])}{' and others' if lost[3:] else ''}" if lost else ""
    return InverseCheck(plant.name, tuple(found), undefined)


def _clearance(plant: Plant, index: int, sign: float) -> float:
    """How far a state may go either way, SI: to the first contact or the end of the travel; 0 without any."""
    if plant.has_stroke and index == plant.stroke_state:
        return sign * plant.travel
    if not plant.contacts:
        return 0.0
    x = ca.SX.sym("x", len(plant.states))
    share = ca.Function("contact", [x], [ca.densify(plant.contact(x))])

    def is_free(distance: float) -> bool:
        there = np.zeros(len(plant.states))
        there[index] = sign * distance
        return bool(np.max(np.array(share(there))) < 1)

    if is_free(FARTHEST) or not is_free(NEAREST):
        return 0.0
    low, high = NEAREST, FARTHEST
    while high > low * (1 + 1e-6):
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_free(middle) else (low, middle)
    return sign * low


def _commands(plant: Plant, index: int) -> list[FloatArray]:
    """Commands beside the preload at the states' zero in one input, within its limit."""
    limits = _limits(plant)
    preload = plant.at().u
    along = np.eye(len(limits))[index] * limits
    found = [preload + share * along for share in SHARES]
    return [v for v in found if (np.abs(v) <= np.maximum(limits, np.abs(preload)) * (1 + 1e-12)).all()]


def _limits(plant: Plant) -> FloatArray:
    limits = np.array(plant.actuator.force_limit or np.ones(len(plant.inputs)), dtype=float)
    return np.where(np.isfinite(limits) & (limits > 0), limits, 1.0)


def _mismatch(plant: Plant, functions: Any, index: int, ends: tuple[float, float]) -> Mismatch:
    """The worst command along one state, of those whose currents are defined and within their limits."""
    made, currents = functions
    limits, worst = _limits(plant), Mismatch(plant.states[index], *ends, 0.0, plant.inputs[0], 0.0, 0.0, 0.0)
    for place in np.linspace(*ends, PLACES if ends[0] < ends[1] else 1):
        x = np.zeros(len(plant.states))
        x[index] = place
        for k in range(len(plant.inputs)):
            for v in _commands(plant, k):
                i, u = np.array(currents(x, v)).ravel(), np.array(made(x, v)).ravel()
                if not (np.isfinite(i).all() and np.isfinite(u).all()):
                    continue
                if not np.allclose(
                    np.array(ca.evalf(ca.vertcat(plant.limited(ca.DM(i))))).ravel(), i, rtol=1e-9
                ):
                    continue
                j = int((np.abs(u - v) / limits).argmax())
                share = float(abs(u[j] - v[j]) / limits[j])
                if share > worst.share:
                    worst = worst._replace(
                        place=float(place),
                        input=plant.inputs[j],
                        command=float(v[j]),
                        made=float(u[j]),
                        share=share,
                    )
    return worst
