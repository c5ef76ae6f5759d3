"""The machine at rest under its loads in parameters by name, and its control law: what a margin is proven of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial

from malta.arrays import FloatArray
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.loops.feedforward_along import along_stroke, slopes_along
from malta.loops.parametric_plants import held_gain, is_dear, of_plant
from malta.loops.sampled_laws import ReadingUse, machine_law
from malta.loops.sampled_loops import feedforward_slope
from malta.loops.windings import LAST_STAGE, CurrentLoops, chosen_loops, force_modes, windings_of
from malta.model.currents import is_commutated
from malta.model.plant import Plant
from malta.model.plants import plant_of
from malta.synthesis.controller import Controller
from malta.synthesis.law import law_at


def machine_system(
    plant: Plant,
    controller: Controller,
    names: Sequence[str],
    at: Mapping[str, float],
    current_loops: CurrentLoops = LAST_STAGE,
) -> tuple[UncertainSystem, Compensator]:
    """The machine at rest under its loads at the states `at`, in parameters by name, and its control law.

    These are the arguments of robust_margin. Raises CheckError where nothing holds the nominal machine there.
    """
    controller = law_at(controller, plant, plant.at(**at).x)
    believed = plant_of(controller.parameters)
    driven = chosen_loops(plant, controller, current_loops) == "pi"
    system, H = _commanded_system(plant, believed, tuple(names), tuple(at.items()), driven)
    handed = H is not None and system.matrices.size2_out(1) > len(H)
    if plant.stroke.name in names:
        slopes = slopes_along(plant, controller)
        system = along_stroke(system, plant, slopes)
        use = ReadingUse(H, handed, moved=() if slopes is None else slopes.forces)
    else:
        use = ReadingUse(H, handed, feedforward_slope(plant, controller, at))
    return system, machine_law(plant, controller, current_loops, use=use, point=plant.at(**at))


LOADS_LEFT_OUT = (
    "without the slopes that its forces have under its loads at rest, which take too long to enclose"
)


@lru_cache(maxsize=16)  # every controller of a machine has it; plants compare by identity
def _commanded_system(
    plant: Plant, believed: Plant, names: tuple[str, ...], at: tuple[tuple[str, float], ...], driven: bool
) -> tuple[UncertainSystem, FloatArray | None]:
    """The machine at the states `at` in parameters by name, and the gain of currents that are held; None: none are.

    driven : whether the windings are states
    """
    states = dict(at)
    H = held_gain(believed, states) if is_commutated(believed) else None
    windings = windings_of(plant, believed, plant.at(**states), force_modes(believed)) if driven else None
    made = partial(of_plant, plant, names, at=states, believed=believed, held=H, late=True, windings=windings)
    system = made()
    if is_dear(system):
        light = made(loaded=False)
        system = replace(light, left_out=LOADS_LEFT_OUT, positive=system.positive, ends=system.ends)
    return system, H
