"""A block: some consecutive runs of a plan, simulated together."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from malta.campaigns.plan import PRECISIONS, Machines, Plan, draw_machines, planned_run
from malta.firmware.flight import engine_of_c
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
    engine: str  # that simulated them, see store.ENGINES


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
        engine=None if plan.law == "own" else engine_of_c(PRECISIONS[plan.law]),
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
    return Block(machines.values, batch, _engine_name(plan))


def _engine_name(plan: Plan) -> str:
    """What simulates a plan's runs."""
    if plan.law != "own":
        return f"exported C, {PRECISIONS[plan.law]}"
    compiled = is_compiled(plan.plant, plan.controller, planned_run(plan).scenario)
    return "compiled" if compiled else "virtual machine"
