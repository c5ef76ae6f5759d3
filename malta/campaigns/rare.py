"""Rare events of a campaign: the probability of exceeding a limit, and the machine and the noise that cause it.

plan, limit -> rare_event -> RareEvent -> write_event -> read_design_point -> replay_design_point

The machines are uniform in the plan's box, as in a campaign, and every run has noise of its own, which changes part by
part where a chain takes a step: see subset.py.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from malta.campaigns.block import simulate_machines
from malta.campaigns.limits import Limit
from malta.campaigns.plan import (
    Plan,
    machines_in_box,
    machines_of,
    planned_run,
    varied_names,
    varying_columns,
)
from malta.campaigns.run import replay_machine
from malta.campaigns.subset import Runs, Subset, subset_simulation
from malta.display import Description, display
from malta.errors import InputError
from malta.files import json_text, read_file, replace_files
from malta.simulation.digest import verdicts

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.model.plant import FloatArray
    from malta.simulation.digest import Batch
    from malta.simulation.engines import EngineChoice
    from malta.simulation.experiments import Experiment, Progress
    from malta.simulation.simulate import EngineOf

PARTS = 100  # of a run, whose noise changes independently
SCHEMA, VERSION = "malta-rare-event", 1
FEW = 10  # ancestors of the failures: with fewer, the coefficient of variation is itself uncertain


class DesignPoint(NamedTuple):
    """The failed run whose machine is nearest the middle of the box."""

    values: Mapping[str, float]  # of what varies, SI
    distance: float  # from the middle, in standard normal coordinates
    noise: tuple[int, ...]  # index of the run whose noise each part has
    end: str  # verdict
    time: float  # s, of the end


@display
@dataclass(frozen=True, eq=False)
class RareEvent:
    """The probability that a run exceeds a limit. `found` says how it was estimated."""

    plan: Plan
    limit: Limit
    found: Subset
    design_point: DesignPoint | None  # None where no run failed

    @property
    def uncertain(self) -> bool:
        """Whether the failures descend from so few first runs that their coefficient of variation is a guess."""
        return self.found.reached and len(self.found.levels) > 1 and self.found.ancestors < FEW

    @property
    def description(self) -> Description:
        """The probability with its interval, and the machine that fails most easily."""
        low, high = self.found.interval()
        known = f"{self.found.probability:.3g}, 95 % interval {low:.2g} .. {high:.2g}"
        rows = [("probability", known if self.found.reached else f"below {high:.2g}, no run failed")]
        rows.append(("simulated", f"{self.found.simulated} runs, {len(self.found.levels)} levels"))
        if self.design_point is not None:
            values = ", ".join(f"{name} = {value:.4g}" for name, value in self.design_point.values.items())
            rows.append(("fails first", f"{values}: {self.design_point.end}"))
        return Description(f"RareEvent of {self.plan.controller.name!r}: {self.limit.text}", tuple(rows))


def rare_event(
    plan: Plan, limit: Limit, *, workers: int | None = None, progress: Progress | None = None
) -> RareEvent:
    """Estimate the probability that a run of a plan exceeds a limit, by subset simulation.

    Each level runs plan.samples machines, of which those beyond the level's threshold begin the chains of the next.
    plan.seed decides machines and noise; plan.sampler does not count. Source: S. K. Au and J. L. Beck, Probabilistic
    Engineering Mechanics 16 (2001) 263-277.

    plan : the plan of the runs
    limit : from `malta.limit_of`
    workers : threads; None: one for each core
    progress : called with the share of the work that is done, 0 to 1

    Returns a RareEvent: `found.probability` with its interval, and the failed run nearest the middle of the box.

    Raises InputError where nothing is random, and for numbers of samples that no level can be made of.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> box = {"m": 0.2}
    >>> plan = malta.Plan(controller, "disturbance", box, samples=100, options=short)
    >>> limit = malta.limit_of(plan, "deviation-y", 40e-6)
    >>> event = malta.rare_event(plan, limit, workers=1)
    >>> 1e-4 < event.found.probability < 1
    True
    >>> f"{len(event.found.levels)} level(s), {event.found.simulated} runs"
    '1 level(s), 100 runs'
    """
    noisy = planned_run(plan).scenario.noise > 0
    dimensions = len(varying_columns(plan))
    if not (dimensions or noisy):
        raise InputError("rare event", "spread", "nothing random", "parameters that vary, or noise")

    def severity(u: FloatArray, noise: NDArray[np.int64]) -> FloatArray:
        return limit.severity(_simulate(plan, u, noise, workers))

    found = subset_simulation(
        severity,
        dimensions,
        PARTS if noisy else 1,
        samples=plan.samples,
        seed=plan.seed,
        progress=progress,
    )
    return RareEvent(plan, limit, found, _design_point(plan, found.failures))


def _simulate(plan: Plan, u: FloatArray, noise: NDArray[np.int64], workers: int | None = None) -> Batch:
    """The figures at standard normal points, runs x the names that vary."""
    return simulate_machines(plan, machines_in_box(plan, ndtr(u)), noise=noise, workers=workers)


def _design_point(plan: Plan, failures: Runs) -> DesignPoint | None:
    if not len(failures.severity):
        return None
    far = np.sqrt((failures.u**2).sum(axis=1))
    nearest = failures.chosen(np.array([far.argmin()]))
    machines = machines_in_box(plan, ndtr(nearest.u))
    batch = simulate_machines(plan, machines, noise=nearest.noise)
    return DesignPoint(
        dict(zip(machines.names, machines.values[0].tolist(), strict=True)),
        float(far.min()),
        tuple(nearest.noise[0].tolist()),
        verdicts(plan.plant)[int(batch.verdict[0])],
        float(batch.duration[0]),
    )


def event_document(event: RareEvent) -> dict[str, Any]:
    """A rare event as plain tables, SI."""
    found = event.found
    low, high = found.interval()
    point = event.design_point
    return {
        "schema": SCHEMA,
        "version": VERSION,
        "limit": event.limit.name,
        "text": event.limit.text,
        "probability": found.probability if found.reached else None,
        "bound": None if found.reached else high,
        "cov": found.cov,
        "low": low if found.reached else None,
        "high": high,
        "simulated": found.simulated,
        "plain_sampling": found.plain if found.reached else None,
        "ancestors": found.ancestors,
        "worst_severity": found.worst,
        "interrupted": found.interrupted,
        "levels": [level._asdict() for level in found.levels],
        "design_point": None if point is None else point._asdict(),
    }


def event_name(limit: Limit) -> str:
    """The name of a rare event in its folder: rare_touchdown."""
    return f"rare_{limit.slug}"


def write_event(event: RareEvent, folder: Path) -> Path:
    """Write a rare event beside the manifest of its plan."""
    path = folder / f"{event_name(event.limit)}.json"
    replace_files({path: (json_text(event_document(event)) + "\n").encode()})
    return path


def read_design_point(path: Path, plan: Plan) -> DesignPoint:
    """The design point of a file that `write_event` wrote.

    Raises InputError for any other file, and for an event without a failure.
    """
    text = read_file(path, "rare event", partial(Path.read_text, encoding="utf-8"))
    try:
        content = json.loads(text)
        if (content["schema"], content["version"]) != (SCHEMA, VERSION):
            raise ValueError("another kind of file")
        point = content["design_point"]
        if point is None:
            raise InputError(path, "design_point", "none", "an event in which a run failed")
        values = {name: float(point["values"][name]) for name in varied_names(plan)}
        noise = tuple(int(index) for index in point["noise"])
        if not noise or min(noise) < 0 or not all(map(math.isfinite, values.values())):
            raise ValueError("numbers that no run has")
        return DesignPoint(values, float(point["distance"]), noise, str(point["end"]), float(point["time"]))
    except InputError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        raise InputError(path, "", "a damaged or foreign file", "a rare event of a campaign") from error


def replay_design_point(
    plan: Plan,
    point: DesignPoint,
    *,
    engine: EngineChoice | EngineOf = "auto",
    progress: Progress | None = None,
) -> Experiment:
    """Simulate a design point again, with all its time series: the same to the bit by the compiled engine."""
    machines = machines_of(plan, np.array([[point.values[name] for name in varied_names(plan)]]))
    return replay_machine(plan, machines, 0, np.array([point.noise]), engine=engine, progress=progress)
