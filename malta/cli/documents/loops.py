"""The document of `malta verify`, and what it shares with `malta design`: stability and margins of a loop."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from malta.merit_lists import by_identifier
from malta.merits import Merit
from malta.units import distinct

if TYPE_CHECKING:
    from malta.loops.time_domain import Deviation, Recovery
    from malta.margins.loop_report import LoopReport
    from malta.margins.unmodelled import UnmodelledMargin
    from malta.report.page.comparison import Comparison


# Parts that several documents share: ends of runs, shares of runs, files.


Number = Annotated[float | None, Field(description="null where it is not finite, or where there is none")]
Files = Annotated[
    list[str],
    BeforeValidator(lambda paths: [str(path) for path in paths]),
    Field(description="files that the command wrote"),
]
Name = Annotated[str, BeforeValidator(str)]  # of a file too
Shares = Annotated[
    dict[str, float],
    Field(
        description="half range of each parameter, as a share of it, or in SI for a difference or an offset"
    ),
]


UNIT = re.compile(r"_(?:rad_per_s|rad|share|kg|s|N|A|si|per_s)$")  # at the end of a key


class DocumentPart(BaseModel):
    """A table of a document, which renders a record: a key has the record's field of its name, without its unit."""

    model_config = ConfigDict(
        extra="forbid", frozen=True, populate_by_name=True, json_schema_serialization_defaults_required=True
    )
    READS: ClassVar[Mapping[str, str]] = {}  # keys of other names -> the field, as "run.verdict"

    @classmethod
    def fields_of(cls, record: Any) -> dict[str, Any]:
        """What a record has of the keys."""
        found = {}
        for key in cls.model_fields:
            path = cls.READS.get(key) or (key if hasattr(record, key) else UNIT.sub("", key))
            if key in cls.READS or hasattr(record, path):
                value = attrgetter(path)(record)
                found[key] = value.tolist() if hasattr(value, "tolist") else value  # an array
        return found

    @classmethod
    def of(cls, record: Any, **given: Any) -> Self:
        """The table of a record; `given` are keys that it does not have, or has in another form."""
        return cls.model_validate(cls.fields_of(record) | given)

    @model_validator(mode="before")
    @classmethod
    def _read(cls, record: Any) -> Any:
        return record if isinstance(record, Mapping | DocumentPart) else cls.fields_of(record)


class End(DocumentPart):
    """How a run ended, and when."""

    name: str = Field(description='"completed", "diverged", "interrupted" or the contact that was touched')
    time_s: Number
    signal: str = Field(description='the output that diverged; "": none, or a value that is no number')


class ShareOfRuns(DocumentPart):
    """A share of runs with its 95 % interval (Clopper-Pearson)."""

    passed: int
    runs: int
    share: Number
    low: Number
    high: Number


def merits_of(merits: Iterable[Merit]) -> dict[str, Number]:
    """Figures of merit by their identifiers."""
    return {name: merit.value for name, merit in by_identifier(merits).items()}


def as_key(label: str) -> str:
    """A label as a key: `+ current loops` is current_loops."""
    return "_".join(re.findall(r"\w+", label))


def with_keys(table: Mapping[str, Any]) -> dict[str, Any]:
    """A table whose keys are labels, with keys that are identifiers."""
    return dict(zip(distinct(map(as_key, table)), table.values(), strict=True))


Poles = list[tuple[float, float]]


class PolesPart(DocumentPart):
    """Poles as [real, imaginary] in rad/s; of sampled systems ln(lambda) / Ts."""

    open_loop: Poles
    regulator: Poles
    filter: Poles
    closed_loop: Poles


class LoopPart(DocumentPart):
    """Stability, poles, bandwidths and peak sensitivities of a loop."""

    READS: ClassVar = {"poles_rad_per_s": "poles.pairs"}

    stable: bool
    poles_rad_per_s: PolesPart
    bandwidth_rad_per_s: dict[str, Number] = Field(description="by definition")
    peak_sensitivity: dict[str, dict[str, Number]] = Field(
        description="largest |S| by stage (sampled, current_loops, machine), by sensor, and sigma_max of all"
    )


class MarginPart(DocumentPart):
    """A margin in multiples of the uncertainty."""

    lower: Number = Field(description="proven: every loop within it is stable; null where nothing is proven")
    upper: Number = Field(description="an unstable loop was found there; null where none was found")
    frequency_rad_per_s: Number
    witness: dict[str, float] | None = Field(description="parameters of the unstable loop, SI")
    sensitivity: dict[str, float] = Field(description="share of each parameter in the margin")
    cells: int = Field(description="of the proof")
    reason: str = Field(description="why nothing, or less than found, is proven")
    searched: str = Field(description="how far no unstable loop was found, where upper is null")
    time_up: bool = Field(description="the search ended with its work or its time: more may prove more")


MARGIN_FIELDS = {key: f"margin.{UNIT.sub('', key)}" for key in MarginPart.model_fields}


class LinkPart(MarginPart):
    """A stage from the ideal loop to the machine's."""

    READS: ClassVar = MARGIN_FIELDS | {"stage": "name", "peak_sensitivity": "peak", "at": "broken_at"}

    stage: str
    peak_sensitivity: Number
    at: Literal["forces", "sensors"] = Field(description="where the loop is opened for |S|")
    loaded: bool = Field(description="whether |S| is that of the machine under its loads")


class PlacePart(MarginPart):
    """The machine's loop at a place of its travel, or at a value of a parameter."""

    READS: ClassVar = MARGIN_FIELDS | {"peak_sensitivity": "peak"}

    position: float
    unit: str = Field(description="SI unit of the position")
    peak_sensitivity: Number
    disk: Number
    delay_s: Number


class DiskPart(DocumentPart):
    """A disk margin."""

    channels: str
    size: Number
    gain: Number = Field(description="factor, up or down")
    phase_rad: Number
    frequency_rad_per_s: Number


class GangPart(DocumentPart):
    """Gang of four at a sensor; SP in `unit`/N, FS in N/`unit`, of a torque N m in place of N."""

    S: Number
    T: Number
    SP: Number
    FS: Number
    unit: str


class TolerancePart(DocumentPart):
    """Margins of a parameter alone."""

    down: MarginPart
    up: MarginPart


class WorstGainPart(DocumentPart):
    """The largest gain over the uncertainty."""

    READS: ClassVar = {"found": "lower", "proven": "upper"}

    found: Number
    frequency_rad_per_s: Number
    proven: Number = Field(description="upper bound")
    reason: str


class UnmodelledPart(MarginPart):
    """The margin of parameters and of the dynamics that a log leaves, together."""

    READS: ClassVar = MARGIN_FIELDS

    needed: Number = Field(description="margin with which the box holds all parameters together")
    covers: bool = Field(description="whether it is proven to be larger than needed")
    weight: dict[str, float] = Field(description="|W|, by rad/s")
    order: int = Field(description="of W")
    assumed: str = Field(description="what the bound of the dynamics is assumed for")


class RobustPart(DocumentPart):
    """Margins over an uncertainty and over the travel."""

    READS: ClassVar = {"worst_sensitivity": "worst"}

    uncertainty: Shares
    chain: list[LinkPart]
    travel: MarginPart
    disks: list[DiskPart]
    delay_s: dict[str, Number] = Field(description="delay margin of each sensor's loop; null: any delay")
    gang_of_four: dict[str, GangPart]
    tolerance: dict[str, TolerancePart]
    mass_kg: MarginPart | None = Field(description="mass margin of the linear loop: lower and upper in kg")
    places: list[PlacePart]
    worst_sensitivity: dict[str, WorstGainPart] = Field(
        description="largest |S| over the uncertainty; {}: not asked"
    )
    unmodelled: UnmodelledPart | None = Field(
        default=None, description="with --identified: dynamics that the machine lacks; null: not asked"
    )


class LeftPart(DocumentPart):
    """What is left of a deviation."""

    after_s: float
    value: Number


class CompliancePart(DocumentPart):
    """The largest amplitude over frequency under a load of this amplitude."""

    peak: Number
    frequency_rad_per_s: Number


class DeviationPart(DocumentPart):
    """What a constant load does to an output."""

    unit: str
    largest: Number
    any_waveform: Number = Field(description="at most, under a load of this amplitude and of any waveform")
    left: list[LeftPart]
    settled_s: Number
    final: Number
    compliance: CompliancePart


class RecoveryPart(DocumentPart):
    """The answer to a constant load from outside."""

    load: dict[str, float] = Field(description="N or N m, by disturbance")
    outputs: dict[str, DeviationPart]


class PayloadPart(DocumentPart):
    """How much the machine carries beside its mover; null: any, or not flown."""

    held_kg: Number
    carried_kg: Number
    dropped_kg: Number


class RequirementPart(DocumentPart):
    """A requirement on a design, and what the design reaches; SI."""

    name: str
    asked: Number = Field(description="null: as little as the others leave")
    found: Number
    unit: str
    how: str = Field(description="where the figure comes from")
    ratio: Number = Field(description="how near its limit: at most 1 where it holds; null: infinite")
    holds: bool = Field(description="false where the verdict is undecided, too")
    verdict: Literal["holds", "fails", "undecided"]
    interval: tuple[float, float] | None = Field(
        description="95 % confidence of a mean over seeds; null: a figure without chance"
    )


class VerifyOutput(LoopPart):
    """What `malta verify --json` prints."""

    READS: ClassVar = LoopPart.READS | {"design": "controller.name"}

    kind: Literal["malta-verify-output"] = Field(default="malta-verify-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    design: str
    files: Files
    recovery: list[RecoveryPart]
    robust: RobustPart
    payload: PayloadPart | None
    left_out: str = ""  # of the machine, by the loop of the last stage; "": nothing
    requirements: list[RequirementPart] = Field(
        default=[], description="of the design file, those that no flight measures; empty: no design file"
    )


def loop_fields(found: LoopReport) -> dict[str, Any]:
    """The fields of a LoopPart."""
    peaks = {stage.name: stage.peak_sensitivity for stage in found.stages}
    return LoopPart.fields_of(found) | {"peak_sensitivity": with_keys(peaks)}


def verify_output(gains: Path, found: LoopReport, files: Sequence[Path]) -> VerifyOutput:
    """The document of a verification."""
    units, unit = {signal.name: signal.unit for signal in found.plant.outputs}, found.extent.unit
    robust = RobustPart.of(
        found,
        gang_of_four={
            name: GangPart(**dict(zip(("S", "T", "SP", "FS"), gang, strict=True)), unit=units[name])
            for name, gang in found.gang.items()
        },
        tolerance={name: {"down": down, "up": up} for name, (down, up) in found.tolerance.items()},
        places=[PlacePart.of(place, unit=unit) for place in found.places],
        unmodelled=None if found.unmodelled is None else _unmodelled_part(found.unmodelled),
    )
    own = {"gains": gains, "files": files, "robust": robust}
    return VerifyOutput.of(found, **loop_fields(found) | own, recovery=[_recovery(r) for r in found.recovery])


def _unmodelled_part(found: UnmodelledMargin) -> UnmodelledPart:
    """The margin with unmodelled dynamics."""
    return UnmodelledPart.of(found, weight={f"{w:.6g}": size for w, size in found.sizes.items()})


def _recovery(found: Recovery) -> RecoveryPart:
    """The answer to a constant load, by output."""

    def deviation(d: Deviation) -> DeviationPart:
        left = [{"after_s": t, "value": value} for t, value in zip(found.after, d.left, strict=True)]
        return DeviationPart.of(
            d, left=left, compliance={"peak": d.compliance, "frequency_rad_per_s": d.frequency}
        )

    return RecoveryPart.of(found, outputs={d.output: deviation(d) for d in found.outputs})


# The documents of `malta report` and `malta compare`.


class ReportOutput(DocumentPart):
    """What `malta report --json` prints."""

    READS: ClassVar = {"design": "subject.controller.name"}

    kind: Literal["malta-report-output"] = Field(default="malta-report-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    design: str
    figures: dict[str, Number] = Field(description="the figures of merit of the page, SI")
    files: Files


class ComparedDesign(DocumentPart):
    """A design of a comparison."""

    READS: ClassVar = {"gains": "subject.source", "machine": "plant.name", "stable": "report.stable"}

    name: str = Field(description="the design's, or with a number where two have one name")
    gains: str
    machine: str
    stable: bool


class ComparedFigure(DocumentPart):
    """A figure of merit of all designs."""

    key: str
    group: str
    better: str | None = Field(description='"high" or "low"; null where neither is better')
    values: list[Number] = Field(description="of each design, SI")
    best: list[str] = Field(description="designs whose value is the better one; none of a tie")


class DesignStanding(DocumentPart):
    """Whether a design is better or worse than the reference, by the same requirements."""

    READS: ClassVar = {"design": "label", "verdict": "value", "where": "note"}

    design: str
    verdict: str
    where: str = Field(description="what it misses, and where it is better and worse")


class CompareOutput(DocumentPart):
    """What `malta compare --json` prints."""

    kind: Literal["malta-compare-output"] = Field(default="malta-compare-output", alias="schema")
    version: Literal[1] = 1
    designs: list[ComparedDesign]
    specification: str | None = Field(description="the design file whose requirements judge all; null: none")
    standings: list[DesignStanding] = Field(description="of each design; none without a specification")
    differences: dict[str, list[Any]] = Field(description="what the designs do not share, one entry a design")
    figures: list[ComparedFigure]
    remarks: list[str] = Field(description="what could not be compared, and why")
    files: Files


def compare_output(found: Comparison, files: Iterable[Path]) -> CompareOutput:
    """The document of a comparison."""
    designs = [ComparedDesign.of(a, name=name) for name, a in zip(found.names, found.designs, strict=True)]
    figures = [
        ComparedFigure.of(
            row,
            better=next(s for s in row.scores if s is not None).better or None,
            values=[None if score is None else score.value for score in row.scores],
            best=[name for name, best in zip(found.names, row.best, strict=True) if best],
        )
        for row in found.rows
    ]
    differences = {
        row.key: [None if entry is None else entry.value for entry in row.entries]
        for row in found.differences
    }
    return CompareOutput.of(
        found,
        designs=designs,
        specification=None if found.spec is None else str(found.spec.path),
        standings=[DesignStanding.of(one) for one in found.standings],
        differences=differences,
        figures=figures,
        files=files,
    )
