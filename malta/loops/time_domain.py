"""How a machine takes a load: its answer to a constant force or torque from outside, and its compliance.

         w (constant, from t = 0)
         |
         v         y
    [ machine ] ------> [ law ] --+        the loop of loop.py: hold, delay, current loops, loads
         ^                        |        against v0(z) at the trim
         +------------------------+

The load acts between samples, as a constant of the continuous machine: x' = A x + B v + B_w w, sampled exactly. Outputs
are the true ones at the samples, also where sensors read them late.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from malta.arrays import FloatArray
from malta.display import Description, display, quantity
from malta.errors import CheckError, InputError, require_known
from malta.linear.peaks import of_plane, part_of, peak_gain
from malta.loops.loop import Loop, loop_along, loop_from
from malta.loops.waveforms import bound_any_waveform
from malta.model.places import position_in
from malta.model.plant import Plant
from malta.processes import on_one_thread
from malta.synthesis.controller import Controller
from malta.synthesis.step_response import StepResponse

if TYPE_CHECKING:
    from malta.synthesis.recovery import RecoveryBound

RECOVERY_TIMES = (0.1, 0.3)  # s
SHARE = 0.01  # of the largest deviation
PLACES = 9  # of the travel, its ends among them


@dataclass(frozen=True, eq=False)
class Deviation:
    """What a constant load does to one output. SI."""

    output: str
    unit: str
    largest: float
    any_waveform: (
        float  # the largest that any load of this amplitude makes, whatever its waveform, at samples
    )
    left: tuple[float, ...]  # the largest from each time of Recovery.after on
    settled: float  # s, from which it stays within SHARE of the largest; inf: never
    final: float  # what stays
    compliance: float  # the largest amplitude over frequency that a load of this amplitude makes
    frequency: float  # rad/s, of it


@display
@dataclass(frozen=True, eq=False)
class Recovery:
    """The answer of a machine's loop to a constant load from outside.

    name : of the load
    load : N or N m, by disturbance
    after : s, times after which what is left is looked at
    outputs : of each output, in SI: `largest` deviation, that under `any_waveform` of this amplitude, what is `left`
        after these times, the time after which it is `settled` (s), the `final` value, and the largest `compliance`
        over frequency with its `frequency` (rad/s)

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> plant = malta.plant_of(controller.parameters)
    >>> found = malta.loops.recovery(plant, controller, {"payload": {"F_z": -2.0}})
    >>> z = found[0].outputs[-1]
    >>> f"{found[0].name} moves {z.output} by {z.largest * 1e6:.0f} um"
    'payload moves z by 699 um'
    """

    name: str
    load: Mapping[str, float]
    after: tuple[float, ...]
    outputs: tuple[Deviation, ...]

    @property
    def description(self) -> Description:
        """What the load does to each output."""
        rows = tuple(
            (
                o.output,
                f"moves {quantity(o.largest, o.unit)}, {quantity(o.final, o.unit)} stay, "
                f"settled after {quantity(o.settled, 's')}",
            )
            for o in self.outputs
        )
        load = ", ".join(f"{name} {value:g}" for name, value in self.load.items())
        return Description(f"Recovery from {self.name}: {load}", rows)


@on_one_thread
def recovery(
    plant: Plant | Loop,
    controller: Controller | None = None,
    loads: Mapping[str, Mapping[str, float]] | None = None,
    *,
    position: float | None = None,
    after: tuple[float, ...] = RECOVERY_TIMES,
) -> tuple[Recovery, ...]:
    """Answer constant loads from outside with the machine's linear loop.

    plant : the machine, or its Loop
    controller : of the plant; None: the Loop has it
    loads : sizes in N or N m by disturbance, for each name; None: 1 N or 1 N m of each of the plant's disturbances
    position : of the stroke, m, of a plant; None: the controller's operating point
    after : s, times after which what is left is looked at

    Returns a Recovery for each load.

    Raises InputError for a machine without disturbances or a load of an unknown one, and CheckError for an unstable
    loop.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> found = malta.loops.recovery(malta.plant_of(controller.parameters), controller)
    >>> x1 = found[0].outputs[0]
    >>> f"1 N of {found[0].name} moves {x1.output} by {x1.largest * 1e6:.1f} um"
    '1 N of F_x moves x1 by 34.2 um'
    """
    whole = loop_from(plant, controller, position)
    plant = whole.plant
    known = [s.name for s in plant.disturbances]
    if not known:
        raise InputError(plant.name, "disturbances", "none", "a machine on which forces act from outside")
    loads = {name: {name: 1.0} for name in known} if loads is None else loads
    sizes = [load_vector(plant, name, load) for name, load in loads.items()]
    loop = whole.sampled
    unit_loads = loop.answer()
    return tuple(
        Recovery(name, dict(load), after, _deviations(whole, unit_loads, size, after))
        for (name, load), size in zip(loads.items(), sizes, strict=True)
    )


def furthest(found: Sequence[Recovery]) -> tuple[tuple[Recovery, Deviation], ...]:
    """Pick the output that each load moves furthest; a load that moves none is left out.

    Outputs of different units are compared by their share of what any of the loads does to their unit.
    """
    units: dict[str, float] = {}
    for d in (d for r in found for d in r.outputs):
        units[d.unit] = max(units.get(d.unit, 0.0), d.largest)
    picked = []
    for r in found:
        moved = [d for d in r.outputs if d.largest > 0]
        if moved:
            picked.append((r, max(moved, key=lambda d: d.largest / units[d.unit])))
    return tuple(picked)


def load_vector(plant: Plant, name: str, load: Mapping[str, float]) -> FloatArray:
    """Return a load as a number for each of a plant's disturbances. Raises InputError for an unknown disturbance."""
    known = [s.name for s in plant.disturbances]
    require_known(load, known, "recovery", name)
    return np.array([load.get(disturbance, 0.0) for disturbance in known])


@on_one_thread
def bounded_deviation(
    plant: Plant, controller: Controller, bound: RecoveryBound, position: float | None = None
) -> float:
    """Compute what a bound is of at a position of the stroke; an unstable loop deviates without limit."""
    chosen = [k for k, s in enumerate(plant.outputs) if s.name in bound.outputs]
    at = position_in(plant, plant.point(controller.operating_point[0]).x) if position is None else position
    try:
        answer = _answer_along(plant, controller, position).of(bound.load_at(at))
    except CheckError:
        return math.inf
    reached = answer.largest if bound.after is None else answer.left(bound.after)
    return float(reached[chosen].max())


@lru_cache(maxsize=16)  # several bounds are of the same positions; records compare by identity
def _answer_along(plant: Plant, controller: Controller, position: float | None) -> StepResponse:
    """The answer to unit loads at a position of the stroke. Raises CheckError for an unstable loop."""
    return loop_along(plant, controller, position).sampled.answer()


def worst_along(plant: Plant, controller: Controller, bound: RecoveryBound) -> tuple[float, float]:
    """The same at the worst of PLACES positions of the travel, and that position, m."""
    positions = np.linspace(-plant.stroke.travel, plant.stroke.travel, PLACES).tolist()
    return max((bounded_deviation(plant, controller, bound, z), z) for z in positions)


def _deviations(
    whole: Loop, unit_loads: StepResponse, load: FloatArray, after: tuple[float, ...]
) -> tuple[Deviation, ...]:
    """What a load does to each output."""
    plant, loop, answer, Ts = whole.plant, whole.sampled, unit_loads.of(load), whole.sample_time
    any_waveform = bound_any_waveform(whole, load) if load.any() else np.zeros(len(plant.outputs))
    system = loop.under_load(load)
    peaks = [peak_gain(part_of(system, [k], [0])) for k in range(len(system.C))]
    at = of_plane(np.array([peak.frequency for peak in peaks]), Ts)
    reached, settled, left = answer.largest, answer.within(SHARE), [answer.left(t) for t in after]
    moves = reached[:, 0] > 1e-12 * float(reached.max())  # what rounding moves stands still
    return tuple(
        Deviation(
            output=s.name,
            unit=s.unit,
            largest=float(reached[k, 0]) if moves[k] else 0.0,
            any_waveform=float(any_waveform[k]) if moves[k] else 0.0,
            left=tuple(float(rest[k, 0]) if moves[k] else 0.0 for rest in left),
            settled=float(settled[k, 0]) if moves[k] else 0.0,
            final=float(answer.final[k, 0]),
            compliance=peaks[k].value,
            frequency=float(at[k]),
        )
        for k, s in enumerate(plant.outputs)
    )
