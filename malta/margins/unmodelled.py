"""The margin of a machine's loop with unmodelled dynamics at its readings, beside its parameters.

    y = (1 + Delta) P(p) u,    |Delta(jw)| <= t |W(jw)|,    p within t times its box

Delta is one full block around all readings, each over its size, so that cross talk between axes is in it; a reading may
deviate by its share of W. Where the loop falls apart into groups of sensors, the block is as harmful as that around the
worst of them (`sensor_groups`), which is proven group by group.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import casadi as ca
import numpy as np

from malta.loops.windings import LAST_STAGE, CurrentLoops
from malta.margins.travel import LoopAlong, own_position, smallest_margin
from malta.model.places import position_at
from malta.processes import on_one_thread
from malta.proof.groups import loop_of, sensor_groups
from malta.proof.margin import NOT_BEGUN, Margin, Ranges
from malta.work import answer_in_time

if TYPE_CHECKING:
    from malta.arrays import FloatArray
    from malta.linear.uncertain import Compensator, UncertainSystem
    from malta.model.plant import Plant
    from malta.synthesis.controller import Controller

TOLERANCE = 0.1  # between what is proven and what is lost: W is assumed between lines


@dataclass(frozen=True, eq=False)
class UnmodelledMargin:
    """A margin of parameters and unmodelled dynamics together.

    margin : in multiples of the box and of W
    sizes : |W| at some frequencies, by rad/s
    order : of W
    needed : the margin with which the box holds all parameters together
    assumed : what the bound is assumed for, beside the lines of a log
    """

    margin: Margin
    sizes: Mapping[float, float]
    order: int
    needed: float
    assumed: str

    @property
    def covers(self) -> bool:
        """Whether the loop is proven stable with all that the log leaves."""
        return self.margin.lower is not None and self.margin.lower >= self.needed

    @property
    def verdict(self) -> str:
        """Whether what the log leaves is covered, in words."""
        if self.covers:
            return "stable with all that the log leaves, as far as the bound holds: proven"
        if self.margin.upper < self.needed:
            return (
                "dynamics that the log does not exclude make the loop unstable; noise counts as such, and more "
                "periods or larger motion leave less of it"
            )
        return "nothing said of what the log leaves: that the loop is stable with all of it is not proven"


@on_one_thread
@answer_in_time(NOT_BEGUN)
def unmodelled_margin(
    plant: Plant,
    controller: Controller,
    ranges: Ranges,
    weight: Any,
    sizes: FloatArray,
    shares: FloatArray,
    current_loops: CurrentLoops = LAST_STAGE,
    *,
    time: float | None = None,
) -> Margin:
    """The margin of parameters and of a full block of dynamics around all readings, at the operating point.

    weight : W(s), stable and proper, as of `malta.proof.Dynamic`
    sizes : of the readings, in which the block's largest singular value is meant, SI
    shares : of W, by which each reading may deviate, over its size
    time : s, longest search of each group of sensors

    The others are those of travel_margin.

    Raises InputError as `malta.dynamic_margin` does.
    """
    from malta.proof.blocks import Dynamic
    from malta.proof.blocks.gain import dynamic_margin  # with all that dynamics take

    loop, names = LoopAlong(plant, controller, tuple(ranges), current_loops), [s.name for s in plant.outputs]
    place = position_at(plant, plant.point(controller.operating_point[0]).x)
    system, law = loop.at(own_position(plant, loop.whole_extent, place, controller))
    # A law may read more than the outputs: the currents of windings, which are no part of the block.
    widths = np.concatenate([sizes, np.ones(law.B.shape[1] - len(names))])
    scaled, found = in_sizes(system, law, widths), []
    for group in sensor_groups(loop_of(*scaled)):
        own = tuple(k for k in group if k < len(names))
        if own:
            channel = own if len(own) > 1 else own[0]
            block = Dynamic(weight, channel=channel, shares=tuple(shares[list(own)].tolist()))
            margin = dynamic_margin(*scaled, ranges, block, tolerance=TOLERANCE, time=time)
            of = " ".join(names[k] for k in own)
            found.append(replace(margin, reason=f"{of}: {margin.reason}" if margin.reason else ""))
    return smallest_margin(found)


def in_sizes(
    system: UncertainSystem, law: Compensator, sizes: FloatArray
) -> tuple[UncertainSystem, Compensator]:
    """The same loop with its readings over sizes: exactly, where these are powers of two."""
    if not sizes.size or (sizes == sizes[0]).all():
        return system, law
    f, p = system.matrices, ca.SX.sym("p", len(system.names))
    made = [ca.SX(M) for M in f.call([p])]
    for k in (2, 3)[: len(made) - 2]:
        made[k] = ca.diag(ca.DM(1 / sizes)) @ made[k]
    scaled = ca.Function("scaled", [p], made)
    return replace(system, matrices=scaled), replace(law, B=law.B * sizes, D=law.D * sizes)
