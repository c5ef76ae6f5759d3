"""The largest |S| of each sensor over the uncertainty and along the travel, proven."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from malta.errors import InputError
from malta.loops.windings import LAST_STAGE, CurrentLoops
from malta.margins.travel import travel_loops
from malta.processes import on_one_thread
from malta.proof.margin import Ranges
from malta.work import is_stopped

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.proof.blocks.gain import Gain
    from malta.synthesis.controller import Controller


@on_one_thread
def worst_sensitivities(
    plant: Plant,
    controller: Controller,
    ranges: Ranges,
    current_loops: CurrentLoops = LAST_STAGE,
    *,
    at: Literal["sensors", "forces"] = "sensors",
    time: float | None = None,
) -> dict[str, Gain]:
    """The largest |S| of each sensor, the other loops closed, over the modelled box, the travel and `plant.over`.

    at : the sensors, or the forces in their place

    The others are those of travel_margin. Without a proof along the travel, it covers the middle and the end alone.
    Sensors for which the clock leaves no time are left out.
    """
    if controller.schedule is not None:
        raise InputError("worst_case", controller.name, "a scheduled law", "a law of one set of matrices")
    from malta.proof.blocks.gain import (
        worst_case_gain,  # with all that dynamics take, which a design does not ask for
    )

    along, over = travel_loops(plant, controller, tuple(ranges), current_loops)
    found: dict[str, Gain] = {}
    for k, signal in enumerate(plant.outputs if at == "sensors" else plant.inputs):
        if is_stopped():
            break
        each = [worst_case_gain(*loop, ranges, over, at=at, channel=k, time=time) for loop in along]
        worst = max(each, key=lambda gain: gain.lower)
        proven = [gain.upper for gain in each if gain.upper is not None]
        found[signal.name] = replace(worst, upper=max(proven) if len(proven) == len(each) else None)
    return found
