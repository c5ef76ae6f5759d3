"""Limits: what a run of a campaign must not do, as a severity that grows before the limit is exceeded.

    touchdown       a contact; severity: share of the clearance that the machine in the middle leaves
    published       outside the bounds that the machine's paper prints
    specification   outside the bounds of a design's [specification]
    a merit's name  its value above a bound of the user's own, as deviation-y1 above 20 um

A severity of 1 or more is a failure, and so is every run that was not completed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from malta.arrays import FloatArray
from malta.campaigns.plan import Plan, machines_at, planned_run, varied_names
from malta.campaigns.result import Campaign, Finding, figures_of, specified_bounds
from malta.campaigns.store import simulate_machines
from malta.campaigns.summary import NO_BOUNDS, RunLimits
from malta.display import display
from malta.errors import InputError
from malta.model.signal_groups import outputs_of
from malta.simulation.engine.digest import Batch
from malta.units import in_unit

EVENTS = ("touchdown", "published", "specification")  # limits without a bound of the user's own
MAX_SEVERITY_WITHIN = float(np.nextafter(1, 0))  # the largest severity of a run within its limit


@display
@dataclass(frozen=True, eq=False)
class Limit:
    """A limit on the runs of a campaign."""

    name: str  # "touchdown", "deviation-y1=20um"
    text: str  # what exceeds it: "touchdown", "deviation y1 above 20 um or an earlier end"
    kept: str  # a run within it: "without touchdown", "with deviation y1 up to 20 um"
    severity: Callable[[Batch], FloatArray]  # of each run; 1 or more: failed

    @property
    def slug(self) -> str:
        """Its name as part of a file's name."""
        return slug(self.name)


def limit_of(plan: Plan, name: str, bound: float | None = None, bounds: RunLimits = NO_BOUNDS) -> Limit:
    """Make the limit that a run of a plan must not exceed, from its name.

    A run of severity 1 or more exceeds the limit, and so does every run that was not completed.

    plan : the campaign's plan
    name : "touchdown", "published" or "specification", or a figure of merit of the scenario, as "deviation-y"
    bound : of a figure of merit, above 0, in SI; None for the three events
    bounds : published figures and the design whose [specification] counts, for these two events

    Returns a Limit: its name, what exceeds it in words, and the severity of each run of a batch.

    Raises InputError for an unknown name, a bound that is missing, needless or not above 0, and for a limit that this
    machine or this scenario does not have.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> box = {"m": 0.2}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, options={"duration": 0.1}
    ... )
    >>> malta.campaigns.limit_of(plan, "deviation-y", 50e-6).text
    'deviation y above 50 um or an earlier end'
    """
    key = slug(name)
    if key in EVENTS:
        if bound is not None:
            raise InputError("campaign", f"limit {key}", f"a bound of {bound:g}", "no bound")
        measure = {"touchdown": _touchdown, "published": _severity, "specification": _specification}[key]
        texts = {
            "touchdown": ("touchdown", "without touchdown"),
            "published": ("a run outside the published bounds", "within the published bounds"),
            "specification": ("a run outside [specification]", "within [specification]"),
        }
        return Limit(key, *texts[key], measure(plan, bounds))
    merits = merits_of(plan)
    if key not in merits:
        expected = "one of " + ", ".join([*EVENTS, *merits])
        raise InputError("campaign", "limit", repr(name), expected)
    if bound is None or not (math.isfinite(bound) and bound > 0):
        found = "no bound" if bound is None else f"{bound:g}"
        raise InputError("campaign", f"limit {key}", found, f"a bound above 0, as {key}=VALUE")
    label, unit = merits[key]
    shown, told = f"{in_unit(bound, unit):.6g}", "%" if unit == "percent" else unit

    def severity(batch: Batch) -> FloatArray:
        listed = {slug(f.label): f.values for f in findings_of(plan, batch)}
        # Without any run that has the figure there is no column of it.
        return _ratio(listed.get(key, np.full(len(batch.completed), np.nan)), bound, batch)

    text, kept = f"{label} above {shown} {told} or an earlier end", f"with {label} up to {shown} {told}"
    return Limit(f"{key}={shown}{told}", text, kept, severity)


def merits_of(plan: Plan) -> dict[str, tuple[str, str]]:
    """The figures of merit that may be bounded: label and unit by name, as "deviation-y1": ("deviation y1", "um")."""
    return {slug(f.label): (f.label, f.merit.unit) for f in findings_of(plan, middle_run(plan))}


def slug(text: str) -> str:
    """A name as it is typed: lower-case letters and digits with hyphens; what follows a comma is left out.

    >>> slug("rise, 10-90 %"), slug("deviation y1")
    ('rise', 'deviation-y1')
    """
    return "-".join(re.findall(r"[^\W_]+", text.split(",")[0].lower()))


def middle_run(plan: Plan) -> Batch:
    """The figures of the machine in the middle of the box, without noise."""
    machines = machines_at(plan, np.full((1, len(varied_names(plan))), 0.5))
    return simulate_machines(plan, machines, replace(planned_run(plan).scenario, noise=0.0))


def _touchdown(plan: Plan, _: RunLimits) -> Callable[[Batch], FloatArray]:
    """Each contact's share of the clearance, 0 at that of the machine in the middle, so that contacts compare."""
    middle = middle_run(plan)
    if not plan.plant.contacts.names:
        raise InputError(
            "campaign", "limit touchdown", f"a {plan.plant.name} without contacts", "a merit's bound"
        )
    start = middle.contact[0]
    if middle.completed[0] and start.max() >= 1:
        raise InputError(
            "campaign", "limit touchdown", f"{plan.scenario}, which begins at rest", "a merit's bound"
        )
    start = np.where(start < 1, start, 0.0)

    def severity(batch: Batch) -> FloatArray:
        used: FloatArray = ((batch.contact - start) / (1 - start)).max(axis=1)
        return _with_failures(used, batch)

    return severity


def _severity(plan: Plan, bounds: RunLimits) -> Callable[[Batch], FloatArray]:
    def bounded(batch: Batch) -> list[Finding]:
        listed = figures_of(_campaign(plan, batch), bounds.published)
        return [f for f in listed if f.bounded]

    if not bounded(middle_run(plan)):
        raise InputError(
            "campaign", "limit published", "no published bounds", "a scenario for which they are"
        )
    return lambda batch: np.max(
        [_ratio(f.values, f.merit.bound or 0.0, batch) for f in bounded(batch)], axis=0
    )


def _specification(plan: Plan, bounds: RunLimits) -> Callable[[Batch], FloatArray]:
    own = {} if bounds.spec is None else specified_bounds(plan, bounds.spec)
    if not own:
        expected = "a design with bounds on this scenario"
        raise InputError("campaign", "limit specification", "no [specification] of it", expected)
    plant = plan.plant
    keys = [("stroke" if plant.has_stroke and k == 0 else g.unit, g) for k, g in enumerate(outputs_of(plant))]
    limits = [(own[key], group.columns) for key, group in keys if key in own]

    def severity(batch: Batch) -> FloatArray:
        far = [batch.deviation[:, columns].max(axis=1) / bound for bound, columns in limits]
        return _ratio(np.max(far, axis=0), 1.0, batch)

    return severity


def _ratio(values: FloatArray, bound: float, batch: Batch) -> FloatArray:
    """values / bound, below 1 exactly where the bound is kept; infinite for a run without the value."""
    ratio = np.where(
        values > bound, np.maximum(values / bound, 1.0), np.minimum(values / bound, MAX_SEVERITY_WITHIN)
    )
    return _with_failures(np.where(np.isnan(values), np.inf, ratio), batch)


def _with_failures(severity: FloatArray, batch: Batch) -> FloatArray:
    """The severity, at least 1 for runs that were not completed; infinite where it is no number."""
    failed = np.where(np.isnan(severity), np.inf, np.maximum(severity, 1.0))
    return np.where(batch.completed == 1, severity, failed)


def findings_of(plan: Plan, batch: Batch) -> list[Finding]:
    """The figures of merit of a batch of a plan's runs; NaN for runs that were not completed."""
    return figures_of(_campaign(plan, batch))


def _campaign(plan: Plan, batch: Batch) -> Campaign:
    """The runs of a batch as those of a campaign, for the functions that evaluate campaigns."""
    runs = len(batch.completed)
    return Campaign(plan, np.arange(runs), (), np.empty((runs, 0)), batch, ())
