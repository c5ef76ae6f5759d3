"""Whether the gains of a controller hold what it believes in: its own model, or the machine that it names."""

from __future__ import annotations

from malta.linear.matrices import eigenvalues
from malta.loops.loop import loop_of_model
from malta.model.linearize import linearize
from malta.model.plants import plant_of
from malta.processes import on_one_thread
from malta.synthesis import separation
from malta.synthesis.controller import Controller


@on_one_thread
def unstable_gain(c: Controller) -> tuple[str, float] | None:
    """The name of a gain that leaves the controller's own model unstable, and the worst |lambda|; None: all are stable.

    An LQG is judged by its regulator and its filter. A PID or a law of errors has no model and is judged on the machine
    that it names.
    """
    if c.cost is not None:
        return separation.unstable_gain(c)
    plant = plant_of(c.parameters)
    model = linearize(plant, plant.point(c.operating_point[0]))
    for law in separation.fixed_laws(c):
        found = separation.unstable_pole({"K": eigenvalues(loop_of_model(model, law).matrix)})
        if found is not None:
            return found
    return None
