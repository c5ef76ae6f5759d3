"""The result of a campaign: a row of figures for each run, and the share of the runs that were completed."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from malta.arrays import FloatArray, readonly
from malta.campaigns.plan import Plan, half_width, varied_names
from malta.campaigns.store import RunBlock, figure_shapes
from malta.display import Description, display
from malta.frames import data_frame
from malta.merits import Merit
from malta.model.parameters import differences, units_of
from malta.model.printed import published_value
from malta.model.signal_groups import inputs_of, outputs_of, stroke_unit
from malta.simulation.engine.digest import Batch, verdicts
from malta.simulation.experiments import setting
from malta.synthesis.spec import Spec
from malta.units import in_unit

CONFIDENCE = 0.95  # of the interval about a share


@display
@dataclass(frozen=True, eq=False)
class Campaign:
    """The result of a campaign: a row of figures for each run that was simulated. SI.

    plan : the plan of the campaign
    index : number of each run in the plan
    names : of the values that vary: parameters, then errors of the sensors
    values : the values that vary, runs x names, SI
    batch : figures of the runs, see `malta.simulation.Batch`
    engines : which simulated them: "compiled" or "virtual machine"
    interrupted : whether Ctrl-C ended the campaign; it has the runs of the blocks before
    damaged : files of blocks that could not be read; their runs were simulated again
    folder : where the blocks are stored; None: nowhere

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> short = {"duration": 0.01}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "hold", {"m": 0.1}, samples=5, options=short
    ... )
    >>> found = malta.campaign(plan, workers=1)
    >>> found.names, found.values.shape, found.ends
    (('m',), (5, 1), {'completed': 5})
    """

    plan: Plan
    index: NDArray[np.int64]
    names: tuple[str, ...]
    values: FloatArray
    batch: Batch
    engines: tuple[str, ...]
    interrupted: bool = False
    damaged: tuple[Path, ...] = ()
    folder: Path | None = None

    @property
    def completed(self) -> NDArray[np.bool_]:
        """True for each run that reached the end of the scenario."""
        return np.asarray(self.batch.completed == 1)

    @property
    def ends(self) -> dict[str, int]:
        """Number of runs by the name of their verdict."""
        counts = np.bincount(self.batch.verdict.astype(int), minlength=len(verdicts(self.plan.plant)))
        return {name: int(n) for name, n in zip(verdicts(self.plan.plant), counts, strict=True) if n}

    def to_pandas(self) -> Any:
        """A row for each run: the values that vary, SI, how it ended, and its figures of merit, NaN where it has none.

        Raises InputError where pandas is not installed.
        """
        ends = verdicts(self.plan.plant)
        varied = dict(zip(self.names, self.values.T, strict=True))
        figures = {found.merit.identifier: found.values for found in every_figure(self)}
        columns = varied | {"verdict": [ends[int(k)] for k in self.batch.verdict]} | figures
        return data_frame(columns, ("run", self.index))

    @property
    def rate(self) -> Rate:
        """Share of the runs that were completed."""
        return rate(int(self.completed.sum()), len(self.index))

    @property
    def description(self) -> Description:
        """Its plan, its ends and its yield."""
        ends = ", ".join(f"{name} {count}" for name, count in self.ends.items())
        rows = (
            ("varied", " ".join(self.names) or "nothing"),
            ("ends", ends or "none"),
            ("completed", str(self.rate)),
            ("engines", " ".join(self.engines)),
        )
        title = f"Campaign of {self.plan.controller.name!r} in {self.plan.scenario!r}"
        return Description(f"{title}: {len(self.index)} of {self.plan.samples} machines", rows)


def gather(plan: Plan, done: Mapping[int, RunBlock]) -> Campaign:
    """The campaign of the blocks that are done, by their first runs, in order of the runs."""
    order = sorted(done)
    blocks = [done[first] for first in order]
    index = np.concatenate(
        [
            np.empty(0, np.int64),
            *(np.arange(k, k + len(b.values)) for k, b in zip(order, blocks, strict=True)),
        ]
    )
    index.flags.writeable = False
    names = varied_names(plan)
    return Campaign(
        plan,
        index,
        names,
        readonly(np.concatenate([b.values for b in blocks]) if blocks else np.empty((0, len(names)))),
        _join(plan, [b.batch for b in blocks]),
        tuple(sorted({b.engine for b in blocks})),
    )


def _join(plan: Plan, batches: list[Batch]) -> Batch:
    """The runs of several batches in one."""
    columns = {
        name: [getattr(batch, name) for batch in batches] or [np.empty((0, *shape))]
        for name, shape in figure_shapes(plan).items()
    }
    return Batch(**{name: np.concatenate(column) for name, column in columns.items()})


class Rate(NamedTuple):
    """A share of runs with its two-sided interval (Clopper-Pearson) at CONFIDENCE."""

    passed: int
    runs: int
    share: float  # passed / runs; NaN without runs
    low: float
    high: float

    def __str__(self) -> str:
        share, low, high = (f"{100 * x:.4g}" for x in (self.share, self.low, self.high))
        return f"{self.passed} of {self.runs}: {share} %, {100 * CONFIDENCE:g} % interval {low} .. {high} %"


def rate(count: int, runs: int) -> Rate:
    """The rate count / runs with its interval, which contains the true rate with a probability of CONFIDENCE or more.

    >>> rate(99, 100).low
    0.9455...
    """
    if not runs:
        return Rate(0, 0, math.nan, 0.0, 1.0)
    low, high = binomtest(count, runs).proportion_ci(CONFIDENCE, method="exact")
    return Rate(count, runs, count / runs, float(low), float(high))


# Statistics of a campaign: figures of merit beside the paper's, runs within its bounds, the worst runs.


class Finding(NamedTuple):
    """A figure of merit over all completed runs, SI."""

    merit: Merit  # what the values are of, without one of its own; its bound is the published one
    kind: str  # figures of one kind share a diagram
    values: FloatArray  # a row for each run of the campaign; NaN where it has none

    @property
    def label(self) -> str:
        """The words of the figure."""
        return self.merit.label

    @property
    def bounded(self) -> bool:
        """Whether the paper prints an upper bound."""
        return self.merit.bound is not None and self.merit.relation == "at most"

    @property
    def within(self) -> NDArray[np.bool_]:
        """True for runs that were completed within the published bound."""
        return np.asarray(self.values <= (math.nan if self.merit.bound is None else self.merit.bound))


CLEARANCE = "clearance:"  # kind of the figures that tell how close a run came to each contact
RISE = ("rise, 10-90 %", "overshoot")  # of a stroke: a scenario without one has them at no run


def figures_of(found: Campaign, published: Mapping[str, Any] | None = None) -> list[Finding]:
    """The figures of merit of a campaign, with the bounds that the paper prints for this scenario."""
    rose = np.isfinite(found.batch.rise).any()
    return [f for f in every_figure(found, published) if rose or f.kind not in RISE]


def every_figure(found: Campaign, published: Mapping[str, Any] | None = None) -> list[Finding]:
    """The same for every block of a campaign: also the figures of a stroke where no run has made one."""
    plan, batch = found.plan, found.batch
    plant, done = plan.plant, found.completed
    names = [signal.name for signal in plant.outputs]
    keys = {} if published is None else bounds_of(plan)

    def finding(
        name: str, kind: str, unit: str, values: FloatArray, key: str = "", relation: str = "at most"
    ) -> Finding:
        bound = published_value(published or {}, keys[key]) if key in keys else math.nan
        label = f"{kind} {name}" if name else kind
        merit = Merit(label, math.nan, unit, relation=relation, kind="runs", signal=name)
        if math.isfinite(bound):
            merit = merit._replace(bound=bound)
        return Finding(merit, kind, readonly(np.where(done, values, np.nan)))

    first = 1 if plant.has_stroke else 0  # of the groups: the stroke and the thrust
    strokes, others = outputs_of(plant)[:first], outputs_of(plant)[first:]
    thrusts, efforts = inputs_of(plant)[:first], inputs_of(plant)[first:]
    lengthwise = [(k, group) for group in strokes for k in group.columns]
    sides = [(k, group) for group in others for k in group.columns]
    listed = [
        finding("", RISE[0], "ms", batch.rise, "rise", "about"),
        finding("", RISE[1], "percent", batch.overshoot, "overshoot"),
    ]
    listed += [
        finding("", f"deviation of {names[k]}", stroke_unit(plant), batch.deviation[:, k], "stroke")
        for k, _ in lengthwise
    ]
    listed += [finding(names[k], "deviation", g.fine, batch.deviation[:, k], g.unit) for k, g in sides]
    if plan.scenario == "hold":
        listed += [finding("", f"rms of {names[k]}", g.fine, batch.rms[:, k]) for k, g in lengthwise]
        listed += [finding(names[k], "rms", g.fine, batch.rms[:, k]) for k, g in sides]
    listed += [
        finding("", f"largest {g.name}", g.unit, batch.force[:, g.columns].max(axis=1, initial=0.0))
        for g in (*efforts, *thrusts)
    ]
    listed += [
        finding(name.removeprefix("touchdown at "), CLEARANCE, "percent", batch.contact[:, k])
        for k, name in enumerate(plant.contacts.names)
    ]
    return [*listed, finding("", "limited commands", "percent", batch.saturated.max(axis=1, initial=0.0))]


def bounds_of(plan: Plan) -> Mapping[str, str]:
    """The bounds that the machine's paper prints for the scenario of a plan, as keys of data/published/."""
    bounds = setting(plan.plant, "bounds", None)
    found: Mapping[str, str] = {} if bounds is None else bounds(plan.scenario, plan.options)
    return found


def runs_within_bounds(
    found: Campaign, published: Mapping[str, Any] | None = None
) -> NDArray[np.bool_] | None:
    """True for runs that were completed within every published bound; None where the paper has no bounds."""
    bounds = [f for f in every_figure(found, published) if f.bounded]
    return np.all([f.within for f in bounds], axis=0) if bounds else None


def unit_of(plan: Plan, name: str) -> str:
    """The unit in which a varied value is displayed."""
    errors = {signal.name: signal.unit for signal in plan.plant.sensors.errors} | differences(plan.parameters)
    shown = {"1": "percent", "m": "um", "rad": "deg"}
    return shown.get(errors[name], errors[name]) if name in errors else units_of(plan.parameters)[name]


def spread_text(plan: Plan, name: str) -> str:
    """The spread of a value to either side as text, as "±10 %"."""
    if name in plan.spread and name not in differences(plan.parameters):
        return f"±{100 * plan.spread[name]:.4g} %"
    unit = unit_of(plan, name)
    size = f"±{in_unit(half_width(plan, name), unit):.4g}"
    return f"{size} %" if unit == "percent" else f"{size} {unit.replace('um', 'µm')}"


# The yield of a campaign: shares of its machines that complete a scenario, within the bounds of a paper or a design.
#
# campaign -> runs_within_bounds         every bound that the paper prints for the scenario
#          -> runs_within_specification  every bound of [specification] on the motion in the scenario


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
        found.rate, share(runs_within_bounds(found, published)), share(runs_within_specification(found, spec))
    )
