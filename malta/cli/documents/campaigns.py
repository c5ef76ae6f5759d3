"""The documents of `malta campaign`: runs, status, and the studies on the same box."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from malta.cli.documents.loops import (
    DocumentPart,
    End,
    Files,
    LoopPart,
    Number,
    ShareOfRuns,
    as_key,
    loop_fields,
    merits_of,
    with_keys,
)
from malta.units import distinct, identifier

if TYPE_CHECKING:
    from malta.campaigns.rare import RareEvent
    from malta.campaigns.run import Status
    from malta.campaigns.studies import Index, Sensitivity, Tolerances
    from malta.campaigns.summary import Distribution, Runs, Summary
    from malta.firmware.flight import SignalDifference
    from malta.firmware.program import Precision
    from malta.margins.loop_report import LoopReport
    from malta.simulation.experiments import Experiment

Manifest = dict[str, Any]


class HeadPart(DocumentPart):
    """What every document of a campaign begins with."""

    gains: str
    folder: str
    manifest: Manifest = Field(description="all that the runs depend on, as in campaign.json")


class PercentilesPart(DocumentPart):
    """How exact the percentiles are."""

    exact: bool
    relative_error: float


class DistributionPart(DocumentPart):
    """A figure of merit over the completed runs, SI."""

    READS: ClassVar = {"smallest": "sketch.smallest", "published": "merit.bound"}

    p5: Number
    p50: Number
    p95: Number
    p99: Number
    largest: Number
    smallest: Number
    mean: Number
    standard_deviation: Number
    published: Number


class RunPart(DocumentPart):
    """One run."""

    run: int
    end: str
    time_s: Number
    values: dict[str, float] = Field(description="of what varies, SI")
    deviation: dict[str, Number] = Field(description="largest, by output; a key ends in the SI unit")
    contact: dict[str, Number] = Field(description="how near each contact was; 1: touched")
    replay: str = Field(description="for `malta simulate GAINS --replay`")


class RunsPart(HeadPart):
    """The yield of a campaign, the distribution of each figure of merit, and its worst runs."""

    samples: int = Field(description="runs that the campaign is to have")
    runs: int = Field(
        description="runs that the figures are of; fewer than `samples`: a part of the campaign"
    )
    interrupted: bool
    engines: list[str]
    share: ShareOfRuns = Field(alias="yield", description="runs that were completed")
    within_published: int | None
    within_specification: int | None
    ends: dict[str, int] = Field(description="runs by the way they ended")
    percentiles: PercentilesPart
    merits: dict[str, DistributionPart]
    worst: list[RunPart]


class CampaignOutput(RunsPart):
    """What `malta campaign --json` prints."""

    kind: Literal["malta-campaign-output"] = Field(default="malta-campaign-output", alias="schema")
    version: Literal[1] = 1
    files: Files


class BlocksPart(DocumentPart):
    """Blocks in the folder of a campaign."""

    READS: ClassVar = {"done": "blocks", "all": "of", "runs": "size", "bytes": "stored"}

    done: int
    all: int
    runs: int = Field(description="in a block")
    bytes: int


class StatusOutput(RunsPart):
    """What `malta campaign --status FOLDER --json` prints."""

    kind: Literal["malta-status-output"] = Field(default="malta-status-output", alias="schema")
    version: Literal[1] = 1
    blocks: BlocksPart
    damaged: list[str]
    running: bool
    pace_s: Number = Field(description="from one block to the next")
    age_s: Number = Field(description="of the last block")
    left_s: Number


class LevelPart(DocumentPart):
    """A level of a subset simulation."""

    threshold: Number = Field(description="severity; 1 is the limit")
    share: Number
    acceptance: Number


class RepetitionPart(DocumentPart):
    """One of the repetitions of a subset simulation, which have no run in common."""

    probability: Number = Field(description="null where no run failed")
    simulated: int
    worst_severity: Number
    levels: list[LevelPart]


class DesignPointPart(DocumentPart):
    """The failed run whose machine is nearest the middle of the box."""

    values: dict[str, float] = Field(description="of what varies, SI")
    distance: float = Field(description="from the middle, in standard deviations")
    noise: list[int]
    end: str
    time_s: float


class RareOutput(HeadPart):
    """What `malta campaign --study rare --json` prints."""

    kind: Literal["malta-rare-output"] = Field(default="malta-rare-output", alias="schema")
    version: Literal[2] = 2
    files: Files
    limit: str
    text: str
    probability: Number = Field(
        description="null where no run failed in some repetition: then it is below `bound`"
    )
    bound: Number
    cov: Number = Field(description="coefficient of variation of the probability")
    low: Number
    high: Number
    simulated: int
    plain_sampling: Number = Field(description="runs that plain sampling needs for the same coefficient")
    worst_severity: Number
    repetitions: list[RepetitionPart]
    design_point: DesignPointPart | None


class IndexPart(DocumentPart):
    """Sobol indices of a factor, with half the width of their 95 % intervals."""

    first: Number
    first_half: Number
    total: Number
    total_half: Number


Indices = dict[str, IndexPart] | None


class SobolOutput(HeadPart):
    """What `malta campaign --study sensitivity --json` prints."""

    kind: Literal["malta-sobol-output"] = Field(default="malta-sobol-output", alias="schema")
    version: Literal[1] = 1
    files: Files
    limit: str
    factors: list[str]
    runs: int
    within: ShareOfRuns
    of_yield: Indices = Field(alias="yield", description="null: every run is within the limit, or none")
    merits: dict[str, Indices]


class SpreadPart(DocumentPart):
    """The largest spread of a parameter that keeps the yield."""

    factor: float = Field(description="in multiples of today's")
    spread: Number = Field(description="a share, or SI; null for all together")
    within: ShareOfRuns | None
    at_least: bool = Field(description="true: no wider spread was tried")
    monotone: bool


class ToleranceOutput(HeadPart):
    """What `malta campaign --study tolerances --json` prints."""

    kind: Literal["malta-tolerance-output"] = Field(default="malta-tolerance-output", alias="schema")
    version: Literal[1] = 1
    files: Files
    limit: str
    wanted: float
    today: ShareOfRuns
    spreads: dict[str, SpreadPart]


def runs_fields(found: Summary, worst: int) -> dict[str, Any]:
    """The fields of a RunsPart but `gains` and `folder`."""
    from malta.campaigns.summary import ACCURACY, worst_runs

    completed, within, specified = found.yields
    runs = worst_runs(found, worst)
    names = distinct(one.merit.identifier for one in found.merits)
    error = 0.0 if found.exact else ACCURACY
    return {
        "manifest": found.plan.manifest,
        "samples": found.plan.samples,
        "runs": found.runs,
        "interrupted": found.interrupted,
        "engines": list(found.engines),
        "share": ShareOfRuns.of(completed),
        "within_published": None if within is None else within.passed,
        "within_specification": None if specified is None else specified.passed,
        "ends": with_keys(found.ends),
        "percentiles": PercentilesPart(exact=found.exact, relative_error=error),
        "merits": {name: _distribution(m) for name, m in zip(names, found.merits, strict=True)},
        "worst": [_run_part(found, runs, row) for row in range(len(runs.index))],
    }


def status_fields(found: Status) -> dict[str, Any]:
    """How far a campaign is."""
    return {
        "blocks": BlocksPart.of(found),
        "damaged": [str(file) for file in found.summary.damaged],
        "running": found.running,
        "pace_s": found.pace,
        "age_s": found.age,
        "left_s": found.left,
    }


def rare_fields(event: RareEvent) -> dict[str, Any]:
    """The probability of a rare event."""
    from malta.campaigns.rare import event_document

    document = event_document(event)
    point = event.design_point
    if point is not None:
        document["design_point"] = DesignPointPart.of(point)
    return {name: value for name, value in document.items() if name not in ("schema", "version")}


def sobol_fields(found: Sensitivity) -> dict[str, Any]:
    """Sobol indices of the yield and of each figure of merit, which have no unit."""

    def part(indices: tuple[Index, ...]) -> Indices:
        rows = zip(found.factors, indices, strict=True) if indices else ()
        return {name: IndexPart.of(index) for name, index in rows} or None

    names = distinct(identifier(label, "1") for label in found.of_merits)
    return {
        "limit": found.limit.name,
        "factors": list(found.factors),
        "runs": found.runs,
        "within": ShareOfRuns.of(found.within),
        "of_yield": part(found.of_yield),
        "merits": {name: part(one) for name, one in zip(names, found.of_merits.values(), strict=True)},
    }


def tolerance_fields(found: Tolerances) -> dict[str, Any]:
    """The largest spreads that keep a yield."""
    from malta.campaigns.studies import spread_of

    return {
        "limit": found.limit.name,
        "wanted": found.wanted,
        "today": ShareOfRuns.of(found.today),
        "spreads": {
            as_key(spread.name): SpreadPart.of(
                spread, spread=spread_of(found, spread), at_least=spread.factor == spread.widest
            )
            for spread in found.spreads
        },
    }


def _distribution(found: Distribution) -> DistributionPart:
    marks = found.percentiles((5, 50, 95, 99, 100)).tolist()
    return DistributionPart.of(found, **dict(zip(("p5", "p50", "p95", "p99", "largest"), marks, strict=True)))


def _run_part(found: Summary, runs: Runs, row: int) -> RunPart:
    """One run of a campaign, by its row among some runs."""
    from malta.campaigns.plan import varied_names
    from malta.simulation.engine.digest import verdicts

    plant, batch = found.plan.plant, runs.batch
    outputs = [identifier(signal.name, signal.unit) for signal in plant.outputs]
    contacts = distinct(map(as_key, plant.contacts.names))
    return RunPart(
        run=int(runs.index[row]),
        end=verdicts(plant)[int(batch.verdict[row])],
        time_s=float(batch.duration[row]),
        values=dict(zip(varied_names(found.plan), runs.values[row].tolist(), strict=True)),
        deviation=dict(zip(outputs, batch.deviation[row].tolist(), strict=True)),
        contact=dict(zip(contacts, batch.contact[row].tolist(), strict=True)),
        replay=f"{found.folder}:{runs.index[row]}",
    )


# The documents of `malta simulate` and `malta design`: verdicts, limits and figures of merit of runs.


MERITS = "figures of merit; a key ends in its SI unit, and in _share where 0.01 is 1 %"


class CasePart(DocumentPart):
    """A run of an experiment."""

    READS: ClassVar = {
        "verdict": "run.verdict",
        "limits": "run.limits",
        "integration_error": "run.integration_error",
    }

    label: str
    verdict: End
    limits: list[str] = Field(description="limits of the machine that the run met")
    integration_error: Number = Field(
        default=None, description="bound for every output, m or rad; null: not known"
    )
    merits: dict[str, Number] = Field(description=MERITS)


class StrokePart(DocumentPart):
    """Figures of a stroke, as papers publish them."""

    READS: ClassVar = {"error_along": "axial_error"}

    rise_s: Number = Field(description="10 to 90 % of the stroke")
    overshoot_share: Number
    error_along: Number = Field(description="largest deviation along the stroke, in SI")
    errors_across: dict[str, Number] = Field(description="largest deviation of each other output; _m or _rad")
    force_N: Number
    current_A: Number


class ExperimentPart(DocumentPart):
    """Verdicts, limits and figures of merit of each run of an experiment."""

    READS: ClassVar = {
        "engine": "run.engine",
        "fidelity": "run.scenario.fidelity",
        "interrupted": "cut",
        "verdict": "run.verdict",
    }

    engine: str
    fidelity: str
    interrupted: bool = Field(
        description="true: cut by Ctrl-C; the figures are those of the part that was run"
    )
    verdict: End = Field(description="of the first case")
    merits: dict[str, Number] = Field(description=f"of the whole experiment: {MERITS}")
    cases: list[CasePart]
    stroke: StrokePart | None = None


class SignalPart(DocumentPart):
    """How far a signal is apart in two flights at most, and its range; SI."""

    largest: Number
    range: Number


class FlightPart(DocumentPart):
    """A flight of the exported C against the simulation's own law."""

    case: str
    precision: Literal["double", "float"]
    signals: dict[str, SignalPart]


class SimulateOutput(ExperimentPart):
    """What `malta simulate --json` prints."""

    kind: Literal["malta-simulate-output"] = Field(default="malta-simulate-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    scenario: str
    files: Files
    exported: list[FlightPart] = Field(default=[], description="of --controller c")


class ObserverPart(DocumentPart):
    """How far the observer's gain is from that of filterpy's filter, which ran until it stood."""

    samples: int
    apart: Number = Field(description="of the largest gain, in units of standard deviations")
    allowed: Number


class DesignPart(LoopPart, ExperimentPart):
    """A design that was made, verified and simulated."""

    design: str
    files: Files = Field(description="gain files, and the figure")
    changes: list[str] = Field(default=[], description="of --set")
    observer: ObserverPart | None = Field(default=None, description="of an LQG")


class DesignOutput(DocumentPart):
    """What `malta design --json` prints: the designs whose gain files stand."""

    kind: Literal["malta-design-output"] = Field(default="malta-design-output", alias="schema")
    version: Literal[1] = 1
    designs: list[DesignPart]


def experiment_fields(experiment: Experiment) -> dict[str, Any]:
    """The fields of an ExperimentPart."""
    return ExperimentPart.fields_of(experiment) | {
        "merits": merits_of(experiment.merits),
        "cases": [CasePart.of(case, merits=merits_of(case.merits)) for case in experiment.cases],
        "stroke": _stroke(experiment) if experiment.name == "stroke" else None,
    }


def _stroke(experiment: Experiment) -> StrokePart:
    from malta.simulation.flown_strokes import stroke_figures

    run = experiment.run
    found, units = stroke_figures(run), {signal.name: signal.unit for signal in run.plant.outputs}
    across = {identifier(name, units[name]): value for name, value in found.radial.items()}
    return StrokePart.of(found, errors_across=across)


def flights(found: Mapping[str, Mapping[Precision, Sequence[SignalDifference]]]) -> list[FlightPart]:
    """The differences of the exported C's flights, by case and precision."""
    return [
        FlightPart(case=label, precision=precision, signals={d.name: SignalPart.of(d) for d in rows})
        for label, by_precision in found.items()
        for precision, rows in by_precision.items()
    ]


def design_part(
    name: str, files: Sequence[Path], margins: LoopReport, flown: Experiment, **more: Any
) -> DesignPart:
    """A design with its loop and its main job; `more` are other fields of a DesignPart."""
    return DesignPart(
        design=name,
        files=[str(file) for file in files],
        **loop_fields(margins),
        **experiment_fields(flown),
        **more,
    )
