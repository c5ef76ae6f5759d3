"""A block: some consecutive runs of a plan, simulated together."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from malta.campaigns.plan import Machines, Plan, draw_machines, planned_run
from malta.simulation.batch import is_compiled, simulate_many
from malta.simulation.digest import Batch
from malta.simulation.experiments import Progress
from malta.simulation.scenario import Scenario

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray


class Block(NamedTuple):
    """The runs of a block, a row for each."""

    values: FloatArray  # runs x names, SI: drawn parameters and errors of the sensors
    batch: Batch
    engine: str  # that simulated them: "compiled" or "virtual machine"


def simulate_machines(
    plan: Plan,
    machines: Machines,
    scenario: Scenario | None = None,
    *,
    first: int = 0,
    noise: NDArray[np.int64] | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Batch:
    """Simulate a plan's scenario, or another one, on machines; first, noise, workers as in `simulate_many`."""
    return simulate_many(
        plan.plant,
        plan.controller,
        planned_run(plan).scenario if scenario is None else scenario,
        machines.changes,
        sensor_errors=machines.sensor_errors,
        first=first,
        noise=noise,
        workers=workers,
        progress=progress,
    )


def fly(
    plan: Plan, first: int, count: int, workers: int | None = None, progress: Progress | None = None
) -> Block:
    """Simulate the `count` runs of a plan from run `first` on.

    first : a multiple of LANES, so that a run has the same place in its group of machines in every block
    workers : threads; None: one for each core
    """
    machines = draw_machines(plan, first, count)
    batch = simulate_machines(plan, machines, first=first, workers=workers, progress=progress)
    compiled = is_compiled(plan.plant, plan.controller, planned_run(plan).scenario)
    return Block(machines.values, batch, "compiled" if compiled else "virtual machine")
