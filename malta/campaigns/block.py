"""A block: some consecutive runs of a plan, simulated together."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from malta.campaigns.plan import Plan, draw_machines, planned_run
from malta.simulation.batch import is_compiled, simulate_many
from malta.simulation.digest import Batch
from malta.simulation.experiments import Progress

if TYPE_CHECKING:
    from malta.model.plant import FloatArray


class Block(NamedTuple):
    """Some runs of a plan, from one index on."""

    values: FloatArray  # runs x names, SI: the values of what varies
    batch: Batch
    engine: str  # what flew them: "compiled" or "virtual machine"


def fly(
    plan: Plan, first: int, count: int, workers: int | None = None, progress: Progress | None = None
) -> Block:
    """Simulate runs `first` to `first + count` of a plan. `first` is a multiple of the lanes of the engine."""
    machines = draw_machines(plan)
    scenario, part = planned_run(plan).scenario, slice(first, first + count)
    batch = simulate_many(
        plan.plant,
        plan.controller,
        scenario,
        {name: column[part] for name, column in machines.changes.items()},
        sensor_errors={name: column[part] for name, column in machines.sensor_errors.items()},
        first=first,
        workers=workers,
        progress=progress,
    )
    compiled = is_compiled(plan.plant, plan.controller, scenario)
    return Block(machines.values[part], batch, "compiled" if compiled else "virtual machine")
