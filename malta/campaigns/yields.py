"""The yield of a campaign: shares of its machines that complete a scenario, within the bounds of a paper or a design.

campaign -> runs_within_bounds         every bound that the paper prints for the scenario
         -> runs_within_specification  every bound of [specification] on the motion in the scenario
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from malta.campaigns.plan import Plan
from malta.campaigns.result import Rate, rate
from malta.campaigns.run import campaign
from malta.campaigns.statistics import runs_within_bounds
from malta.model.signals import outputs_of
from malta.simulation.catalogue import main_job, settling
from malta.simulation.experiments import Progress, setting

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from malta.campaigns.result import Campaign
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

MACHINES = 4_000  # a share of 1 % is known to 0.3 %


class Yields(NamedTuple):
    """Shares of machines, each with its interval; None where there are no bounds."""

    completed: Rate
    published: Rate | None  # completed within every published bound
    specified: Rate | None  # completed within every bound of [specification]


def specified_bounds(plan: Plan, spec: Spec) -> dict[str, float]:
    """The bounds of a design's [specification] on the scenario of a plan, SI: by "stroke", or by unit of the others."""
    names: Callable[..., Mapping[str, str]] | None = setting(plan.plant, "bounds_in_specification", None)
    if names is None:
        return {}
    found = names(plan.scenario, plan.options)
    return {key: spec.specification[name] for key, name in found.items() if name in spec.specification}


def runs_within_specification(found: Campaign, spec: Spec | None) -> NDArray[np.bool_] | None:
    """True for runs that were completed within the bounds of [specification]; None where it has none for them."""
    bounds = {} if spec is None else specified_bounds(found.plan, spec)
    if not bounds:
        return None
    plant, within = found.plan.plant, found.completed
    for k, group in enumerate(outputs_of(plant)):
        bound = bounds.get("stroke" if plant.has_stroke and k == 0 else group.unit, np.inf)
        within = within & (found.batch.deviation[:, group.columns] <= bound).all(axis=1)
    return np.asarray(within)


def yields_of(
    found: Campaign, published: Mapping[str, Any] | None = None, spec: Spec | None = None
) -> Yields:
    """The yields of a campaign.

    published : the figures of the machine's paper
    spec : the design whose [specification] counts
    """
    runs = len(found.index)

    def share(within: NDArray[np.bool_] | None) -> Rate | None:
        return None if within is None else rate(int(within.sum()), runs)

    return Yields(
        found.rate,
        share(runs_within_bounds(found, published)),
        share(runs_within_specification(found, spec)),
    )


def main_yields(
    controller: Controller,
    spec: Spec,
    published: Mapping[str, Any] | None = None,
    *,
    machines: int = MACHINES,
    settle: bool = True,
    progress: Progress | None = None,
) -> Yields:
    """The yields of a machine's main job over machines drawn at random from the design's uncertainty.

    settle : machines come to rest before, as long as the machine's SETTLE says; False: they begin with what v0 lacks
        for them, and with empty integrals

    spec, controller = malta.read_design("design/robust.toml"), malta.gains.read("design/gains/robust.json")
    print(main_yields(controller, spec, malta.published("data/tubular.toml"), machines=1000).published)
    """
    return yields_of(
        main_campaign(controller, spec, machines, settle=settle, progress=progress), published, spec
    )


def main_campaign(
    controller: Controller,
    spec: Spec,
    machines: int = MACHINES,
    *,
    settle: bool = True,
    progress: Progress | None = None,
) -> Campaign:
    """The campaign of `main_yields`."""
    job = main_job(spec.plant)
    options = settling(job, spec.plant) if settle else {}
    plan = Plan(controller, job, dict(spec.uncertainty), samples=machines, options=options)
    return campaign(plan, progress=progress)
