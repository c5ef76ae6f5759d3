"""The documents of `malta check`, `malta inspect`, `malta tune`, `malta claims`, `malta export` and `malta pil`."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from malta.cli.documents.loops import DocumentPart, Files, Name, Number, RequirementPart
from malta.identification.response import units_of_model
from malta.report.ledger import Word
from malta.units import identifier

if TYPE_CHECKING:
    from malta.checker.file import StabilityClaim
    from malta.identification.dump import ExactReplay
    from malta.identification.frequency_response import ResponseComparison
    from malta.identification.identified import Identified
    from malta.identification.log import Log
    from malta.identification.measure import Curve, Measurement, MeasurementPlan
    from malta.identification.replay import LawReplay
    from malta.identification.strokes import LearnedStrokes
    from malta.identification.windings import Windings
    from malta.proof.blocks.gain import Gain
    from malta.synthesis.spec import Spec
    from malta.tuning.tune import TuningResult


class ClaimedParameter(DocumentPart):
    """A parameter of a certificate's box; SI."""

    name: str
    unit: str | None
    nominal: float
    low: float = Field(description="of the interval at `lower`")
    high: float


class CertifiedPart(DocumentPart):
    """What a certificate says that it is of; null where it is of matrices alone."""

    machine: str | None
    preset: str | None
    law: str | None
    law_sha256: str | None
    current_loops: str | None = Field(description="the stage: lag, or pi")
    sample_time_s: Number
    places: list[float] | None = Field(
        description="along the travel, one for each loop; null: all of the travel"
    )
    parameters: list[ClaimedParameter]


class CheckOutput(DocumentPart):
    """What `malta check --json` prints."""

    kind: Literal["malta-check-output"] = Field(default="malta-check-output", alias="schema")
    version: Literal[1] = 1
    file: str
    holds: bool
    lower: Number = Field(description="what the certificate claims, in multiples of the uncertainty")
    compared: bool = Field(
        description="a gain file has this machine, law, uncertainty and travel; false: they are the certificate's own"
    )
    claim: CertifiedPart
    groups: list[str]
    failures: list[str]


class InspectRow(DocumentPart):
    """A part of a machine, what was found, and what is expected there."""

    part: str
    found: str
    change: str
    unproven: bool = Field(description="nothing is proven because of it")


class InspectOutput(DocumentPart):
    """What `malta inspect --json` prints."""

    kind: Literal["malta-inspect-output"] = Field(default="malta-inspect-output", alias="schema")
    version: Literal[1] = 1
    machine: str
    proves: bool = Field(description="proofs of the linear model are proofs of the machine")
    rows: list[InspectRow]
    switches: list[str] = Field(description="of each position: where its slopes change nearest to rest")


def certified_part(claim: StabilityClaim) -> CertifiedPart:
    """What a certificate says that it is of."""
    from malta.checker.file import double

    o, places, T = claim.origin, claim.places, claim.sample_time
    names = None if o is None else (o.machine, o.preset, o.law, o.sha256, o.current_loops)
    machine, preset, law, sha256, stage = names or (None,) * 5
    return CertifiedPart(
        machine=machine,
        preset=preset,
        law=law,
        law_sha256=sha256,
        current_loops=stage,
        sample_time_s=None if T is None else double(T),
        places=None if places is None else [double(x) for x in places.at],
        parameters=[
            ClaimedParameter.of(
                p, nominal=double(p.nominal), low=double(p.interval[0]), high=double(p.interval[1])
            )
            for p in claim.parameters
        ],
    )


class SearchPart(DocumentPart):
    """How a design was found."""

    trials: int
    values: dict[str, float] = Field(description="the numbers that were searched, by their names in the file")
    delay_samples: int
    front: list[dict[str, Number]] = Field(description="figures of the trials of the Pareto front")


class TuneOutput(DocumentPart):
    """What `malta tune --json` prints."""

    kind: Literal["malta-tune-output"] = Field(default="malta-tune-output", alias="schema")
    version: Literal[1] = 1
    design: str
    files: Files = Field(default=[])
    requirements: list[RequirementPart]
    search: SearchPart | None = Field(default=None, description="null with --check, which searches nothing")


class ClaimPart(DocumentPart):
    """A published number, ours for each design, and the verdict; as text, with the printed digits."""

    subject: str
    published: str
    ours: list[str]
    verdict: str = Field(description="with notes and reasons")
    word: Word = Field(description="the verdict in one word")


class LedgerPart(DocumentPart):
    """All published numbers on a machine."""

    machine: str
    source: str
    designs: list[str]
    reproducing: list[str] = Field(
        description="designs that are meant to reproduce the paper: these are judged"
    )
    claims: list[ClaimPart]


class ClaimsOutput(DocumentPart):
    """What `malta claims --json` prints."""

    kind: Literal["malta-claims-output"] = Field(default="malta-claims-output", alias="schema")
    version: Literal[1] = 1
    ledgers: list[LedgerPart]


class ExportOutput(DocumentPart):
    """What `malta export --json` prints."""

    kind: Literal["malta-export-output"] = Field(default="malta-export-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    to: Literal["c", "fmu"]
    files: Files


class VectorPart(DocumentPart):
    """What a target made of a recorded vector."""

    READS: ClassVar = {"largest_difference": "largest"}

    name: str
    samples: int
    first_that_differs: int | None = Field(description="a sample; null where all bits agree")
    largest_difference: Number = Field(description="of a force, N or N m, or of a command")


class PilOutput(DocumentPart):
    """What `malta pil --json` prints."""

    READS: ClassVar = {"samples_per_s": "samples_per_second", "requests_sent_again": "repeated"}

    kind: Literal["malta-pil-output"] = Field(default="malta-pil-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    port: str
    precision: Literal["double", "float"]
    agrees: bool
    vectors: list[VectorPart]
    samples_per_s: float = Field(description="with the line")
    requests_sent_again: int
    slowest_step_counts: int | None = Field(description="of the target's timer; null where it has none")


def tune_output(spec: Spec, tuned: TuningResult, files: Sequence[Path]) -> TuneOutput:
    """The document of a search."""
    from malta.synthesis.requirements import requirements_for

    units = {name: one.unit for name, one in requirements_for(spec.plant).items()}
    search = SearchPart.of(
        tuned,
        values=dict(zip((v.name for v in spec.search), tuned.trial.values, strict=True)),
        delay_samples=tuned.trial.delay,
        front=[
            {identifier(name, units.get(name, "1")): value for name, value in point.figures.items()}
            for point in tuned.front
        ],
    )
    return TuneOutput.of(tuned, design=spec.name, files=files, search=search)


# The documents of `malta excite`, `log`, `identify`, `learn`, `replay`, `measure` and `commission`.


class ExciteOutput(DocumentPart):
    """What `malta excite --json` prints."""

    READS: ClassVar = {"lines_Hz": "signal.frequencies", "crest_factor": "signal.crest_factor"}

    kind: Literal["malta-excite-output"] = Field(default="malta-excite-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    duration_s: float
    lines_Hz: list[float]
    crest_factor: list[Number] = Field(description="of each input")
    motion: dict[str, float] = Field(description="largest deviation of each output, SI")
    window: dict[str, float] = Field(
        description="of each output: a deviation beyond it should end the flight, SI"
    )
    current_A: dict[str, float] = Field(description="largest deviation of each current from that at rest")
    command_share: dict[str, float] = Field(description="largest command of each input, of its limit")
    accuracy_share: dict[str, float] = Field(description="half of the 95 % interval of each parameter")
    files: Files


class SignalStatistics(DocumentPart):
    """Statistics of a column of a log, in its unit."""

    unit: str
    least: Number
    mean: Number
    largest: Number
    deviation: Number = Field(description="standard deviation")


class LogOutput(DocumentPart):
    """What `malta log --json` prints."""

    READS: ClassVar = {"log": "source", "jitter_s": "survey.jitter"}

    kind: Literal["malta-log-output"] = Field(default="malta-log-output", alias="schema")
    version: Literal[1] = 1
    log: str
    sha256: str
    machine: str
    controller: str
    samples: int
    sample_time_s: float
    period_s: float = Field(description="of the excitation; 0: none")
    signals: dict[str, SignalStatistics]
    jitter_s: float
    findings: list[str]
    notes: list[str] = Field(default=[], description="what reading made of the file")
    files: Files


class IdentifiedParameter(DocumentPart):
    """A parameter with its interval."""

    unit: str
    value: float
    low: float = Field(description="end of the total 95 % interval")
    high: float
    noise_half: Number | None = Field(
        default=None,
        description="half of the 95 % interval that noise alone leaves; null: low to high is that",
    )
    start: float = Field(description="value of the gain file")
    in_time: Number | None = Field(
        default=None, description="from prediction errors in time; null: not estimated"
    )
    apart_sigma: Number | None = Field(
        default=None, description="of the two estimates, in standard deviations"
    )


class ExplainedBy(DocumentPart):
    """An imperfection that explains a part of a log."""

    READS: ClassVar = {"usual": "size"}

    name: str
    unit: str
    value: float
    half: float = Field(description="of the 95 % interval")
    usual: float = Field(description="standard deviation before the log")
    share: float = Field(description="of what the parameters alone leave")
    alike: list[str] = Field(description="imperfections that explain as much")


class IdentifyOutput(DocumentPart):
    """What `malta identify --json` prints."""

    READS: ClassVar = {"log": "log.source", "chi2_per_dof": "chi2", "chi2_limit": "limit"}

    kind: Literal["malta-identify-output"] = Field(default="malta-identify-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    log: str
    parameters: dict[str, IdentifiedParameter]
    correlation: list[list[float]]
    held: dict[str, float] = Field(description="parameters that act too and were taken as known, SI")
    chi2_per_dof: float
    chi2_limit: float
    dof: int
    whiteness: float = Field(description="correlation of neighbouring lines, in standard deviations")
    distortion: Number = Field(description="power where nothing was excited, over the noise")
    verdict: str
    explained_by: list[ExplainedBy]
    left: float = Field(description="share of the response at the lines that nothing explains")
    loop_error: Number | None = Field(
        default=None, description="of |S| predicted, beside its band, as a share; null: not measured"
    )
    refusal: str = Field(description='why the model does not explain the log; "": it does')
    drive: dict[str, IdentifiedParameter] | None = Field(
        default=None, description="R, L and dead time of the drive; null: not asked for"
    )
    files: Files


class LearnOutput(DocumentPart):
    """What `malta learn --json` prints."""

    kind: Literal["malta-learn-output"] = Field(default="malta-learn-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    log: Name
    factor: float
    deviation: float = Field(description="standard deviation of the factor by noise")
    half: float = Field(description="of its 95 % interval, by noise and an unknown load along the stroke")
    at_limit: float = Field(description="share of the samples in which the thrust was at its limit")
    parameter: str
    before: float
    after: float
    half_after: float = Field(
        description="of its total 95 % interval, with mass and gains of sensors as usual"
    )
    files: Files


class LearnedV0Output(DocumentPart):
    """What `malta learn --v0 --json` prints."""

    kind: Literal["malta-learned-v0-output"] = Field(default="malta-learned-v0-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    log: Name
    z: list[float] = Field(description="m, places of the table v0(z) that the log has seen")
    change: list[float] = Field(description="N, of v0 of the thrust at these places")
    deviation: list[float] = Field(description="N, standard deviations of the change")
    files: Files


class LearnedStrokesOutput(DocumentPart):
    """What `malta learn --strokes --json` prints."""

    READS: ClassVar = {"axial_error_m": "axial_error"}

    kind: Literal["malta-learned-strokes-output"] = Field(
        default="malta-learned-strokes-output", alias="schema"
    )
    version: Literal[1] = 1
    gains: Name
    axial_error_m: list[float] = Field(description="the largest true error of each stroke")
    without_noise_m: list[float] = Field(description="the same of each stroke flown again without noise")
    patterns: list[int] = Field(description="of each stroke: patterns of its error that rose above the noise")
    largest_thrust_N: float = Field(description="that the next stroke would be sent beside the law's")
    repeatable_error_m: float = Field(description="the largest axial error of the next stroke without noise")
    contraction: float | None = Field(
        description="proven bound of what a stroke leaves of an error that thrust can make, over the box; null: none"
    )
    files: Files


class Explained(DocumentPart):
    """What a change of a parameter would explain of the innovations."""

    change: float = Field(description="as a share of the parameter's value")
    share: float = Field(description="of the power beyond that of the gain file's own machine")


class ReplayOutput(DocumentPart):
    """What `malta replay --json` prints."""

    READS: ClassVar = {"difference_at_once": "at_once", "innovation_rms": "rms", "sensor_noise": "expected"}

    kind: Literal["malta-replay-output"] = Field(default="malta-replay-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    log: Name
    same: bool
    difference: dict[str, float] = Field(description="largest of each command in the second half, SI")
    difference_at_once: dict[str, float] = Field(description="the same from the first sample on")
    innovation_rms: dict[str, float] = Field(description="of each output, SI")
    sensor_noise: dict[str, float] = Field(description="noise and steps of each sensor, SI")
    whiteness: dict[str, float] = Field(description="largest autocorrelation, in standard deviations")
    own_machine_rms: dict[str, float] = Field(description="of innovations of the gain file's own machine, SI")
    explained: dict[str, Explained] = Field(description="by parameter, where the innovations are refused")
    samples_to_the_bit: int | None = Field(
        default=None, description="of a dump: with the commands of the exported C; null of other logs"
    )
    refusal: str = Field(description="why the log is not of this law on its machine; empty: it is")


class MeasuredCurve(DocumentPart):
    """A magnitude over the lines, as measured and as predicted; NaN becomes null."""

    measured: list[Number]
    deviation: list[Number] = Field(description="standard deviation of the measured magnitude")
    predicted: list[Number]
    low: list[Number] = Field(description="least magnitude over the uncertainty, sampled")
    high: list[Number]


class MeasuredSensor(DocumentPart):
    """The loop at a sensor, the others closed."""

    peak: float = Field(description="largest measured |S|")
    peak_at_Hz: float
    peak_below: float = Field(description="upper end of its 95 % band")
    zone: Literal["A", "B", "C", "D"] = Field(description="of ISO 14839-3, by peak_below")
    disk: float = Field(description="size of the disk margin of this sensor alone")
    disk_above: float = Field(description="lower end of its 95 % band")
    S: MeasuredCurve
    T: MeasuredCurve
    L: MeasuredCurve
    compliance: dict[str, MeasuredCurve] = Field(description="|S P| by force, SI")


class MeasureOutput(DocumentPart):
    """What `malta measure GAINS LOG --json` prints."""

    READS: ClassVar = {"logs": "source", "law_missed_share": "law"}

    kind: Literal["malta-measure-output"] = Field(default="malta-measure-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    logs: str
    frequency_Hz: list[float]
    sensors: dict[str, MeasuredSensor]
    largest: MeasuredCurve = Field(description="largest singular value of S")
    disk: float = Field(description="size of the disk margin of all sensors at once, a lower bound")
    disk_above: float
    machines: int = Field(description="of the box, that were sampled for low and high")
    box_share: dict[str, float]
    law_missed_share: Number = Field(description="rms of commands at the lines beside those of the gain file")
    refusal: str = Field(description='why the machine is not as predicted; "": it is')
    files: Files


class MeasurePlanOutput(DocumentPart):
    """What `malta measure GAINS --plan --json` prints."""

    kind: Literal["malta-measure-plan-output"] = Field(default="malta-measure-plan-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    flights: int
    duration_s: float = Field(description="of all flights")
    periods: int
    frequency_Hz: list[float]
    half_width: dict[str, list[float]] = Field(description="of the 95 % band of |S|, by sensor")
    coherence: dict[str, list[float]] = Field(
        description="within a period, the least of the flights, by sensor"
    )
    motion: dict[str, float] = Field(description="largest deviation of each output, SI")
    current_A: dict[str, float] = Field(description="largest deviation of each current from that at rest")


class ResponseOutput(DocumentPart):
    """What `malta measure GAINS --response FILE --json` prints."""

    kind: Literal["malta-response-output"] = Field(default="malta-response-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    file: str
    response: str = Field(description='which one, as "S x1"')
    frequency_Hz: list[float]
    measured: list[float] = Field(description="magnitude, SI")
    predicted: list[float] = Field(description="magnitude, SI")
    low: list[float] = Field(description="least predicted magnitude of the machines")
    high: list[float]
    error: list[float] = Field(description="of the complex value, over the predicted magnitude")
    machines: int = Field(description="of the box, that were sampled for low and high")
    refusal: str = Field(description='why the response is not as predicted; "": it is')


class RealizeOutput(DocumentPart):
    """What `malta identify GAINS LOG --order N --json` prints: x+ = A x + B v, y = C x, y late by the delay."""

    READS: ClassVar = {
        **{name: f"system.{name}" for name in "ABC"}, "logs": "lines.source", "sample_time_s": "system.dt"
    }  # fmt: skip

    kind: Literal["malta-realize-output"] = Field(default="malta-realize-output", alias="schema")
    version: Literal[1] = 1
    gains: Name
    logs: str
    order: int
    sample_time_s: float
    delay_s: float
    singular_values: list[float]
    chi2: Number = Field(description="1 where noise alone is left")
    fit: dict[str, float] = Field(description="by output, at the lines, %")
    fresh_fit: dict[str, float] | None = Field(description="of a second log, %")
    A: list[list[float]]
    B: list[list[float]]
    C: list[list[float]]
    refusal: str = Field(description='why the second log refuses the model; "": it does not')
    files: Files


class CommissionFinding(DocumentPart):
    """A figure of a step, with half of its 95 % interval and its limits."""

    READS: ClassVar = {"unit": "found.unit", "value": "found.value", "half": "found.half"}

    name: str
    unit: str
    value: Number
    half: Number
    low: Number
    high: Number
    holds: bool


class CommissionStep(DocumentPart):
    """What a step of the checklist found."""

    name: str
    question: str
    passed: bool
    refusal: str
    log: str
    sha256: str
    findings: list[CommissionFinding]


class CommissionOutput(DocumentPart):
    """What `malta commission --json` prints."""

    kind: Literal["malta-commission-output"] = Field(default="malta-commission-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    sha256: str
    machine: str
    passed: bool
    steps: list[CommissionStep] = Field(description="as far as they were gone")
    left: list[str] = Field(description="steps that were not gone")
    kept: list[str] = Field(description="steps that an earlier call had gone")
    signature: str
    files: Files


def log_output(log: Log, files: Iterable[Path], beyond: Iterable[str] = ()) -> LogOutput:
    """The document of a log; `beyond` are findings about its machine."""
    signals = {}
    for heading, numbers in log.survey.statistics.items():
        name, _, unit = heading.partition(" [")
        fields = dict(zip(("least", "mean", "largest", "deviation"), numbers, strict=True))
        signals[name.replace(".", "_")] = SignalStatistics(unit=unit[:-1], **fields)
    findings = [*log.survey.findings, *beyond]
    return LogOutput.of(log, signals=signals, findings=findings, files=files)


def identify_output(
    gains: Path, found: Identified, files: Iterable[Path], windings: Windings | None = None
) -> IdentifyOutput:
    """The document of an identification."""
    drive = (
        None
        if windings is None
        else {
            name: IdentifiedParameter(
                unit=one.unit, value=one.value, low=one.value - one.half, high=one.value + one.half, start=own
            )
            for name, (one, own) in windings.estimates.items()
        }
    )
    units = units_of_model(found.plant)
    in_time = (
        {} if found.in_time is None else dict(zip(found.names, found.in_time.values.tolist(), strict=True))
    )
    parameters = {
        name: IdentifiedParameter(
            unit=units[name],
            value=float(found.values[k]),
            low=found.intervals[name][0],
            high=found.intervals[name][1],
            noise_half=float(found.half_widths[k]),
            start=float(found.start[k]),
            in_time=in_time.get(name),
            apart_sigma=found.differences.get(name),
        )
        for k, name in enumerate(found.names)
    }
    refusal = found.refusal or ("" if windings is None else windings.refusal)
    e = found.explanation
    return IdentifyOutput.of(
        found,
        gains=gains,
        parameters=parameters,
        refusal=refusal,
        drive=drive,
        files=files,
        explained_by=[] if e is None else [ExplainedBy.of(one) for one in e.causes],
        left=0.0 if e is None else e.share,
        loop_error=None if found.loop is None else found.loop.error,
    )


def learned_strokes_output(
    gains: Path, found: LearnedStrokes, shrinks: Gain | None, files: Iterable[Path]
) -> LearnedStrokesOutput:
    """The document of strokes that learned."""
    *flown, following = found.without_noise
    return LearnedStrokesOutput.of(
        found,
        gains=gains,
        without_noise_m=flown,
        largest_thrust_N=float(abs(found.thrust).max()),
        repeatable_error_m=following,
        contraction=None if shrinks is None else shrinks.upper,
        files=files,
    )


def replay_output(gains: Path, log: Path, found: LawReplay, exact: ExactReplay | None) -> ReplayOutput:
    """The document of a replay."""
    return ReplayOutput.of(
        found,
        gains=gains,
        log=log,
        own_machine_rms=found.own if found.same else {},
        explained={name: Explained(change=a, share=b) for name, (a, b) in found.explained.items()},
        samples_to_the_bit=None if exact is None else exact.same,
    )


def measure_output(gains: Path, found: Measurement, files: Iterable[Path]) -> MeasureOutput:
    """The document of a loop that was measured."""
    sensors = {}
    for i, name in enumerate(found.sensors):
        (peak, high, w), (disk, low) = found.peaks[name], found.disks[i]
        sensors[name] = MeasuredSensor(
            peak=peak,
            peak_at_Hz=w / (2 * math.pi),
            peak_below=high,
            zone=found.zones[name],  # type: ignore[arg-type]
            disk=disk.size,
            disk_above=low,
            S=_curve(found.S, i),
            T=_curve(found.T, i),
            L=_curve(found.L, i),
            compliance={force: _curve(found.compliance, i, j) for j, force in enumerate(found.forces)},
        )
    disk, low = found.disks[-1]
    return MeasureOutput.of(
        found,
        gains=gains,
        frequency_Hz=(found.w / (2 * math.pi)).tolist(),
        sensors=sensors,
        largest=_curve(found.largest, 0),
        disk=disk.size,
        disk_above=low,
        files=files,
    )


def _curve(curve: Curve, *at: int) -> MeasuredCurve:
    """The magnitudes of a channel."""
    one = curve.at(*at)
    tables = {"measured": one.size, "deviation": one.deviation, "predicted": abs(one.predicted)}
    tables |= {"low": one.low, "high": one.high}
    return MeasuredCurve(**{name: table.tolist() for name, table in tables.items()})


def response_output(gains: Path, path: Path, found: ResponseComparison) -> ResponseOutput:
    """The document of a response of an analyser beside the predicted one."""
    return ResponseOutput.of(
        found,
        gains=gains,
        file=str(path),
        response=found.of,
        frequency_Hz=(found.response.w / (2 * math.pi)).tolist(),
        measured=abs(found.response.values).tolist(),
        predicted=abs(found.predicted).tolist(),
    )


def measure_plan_output(gains: Path, plan: MeasurementPlan) -> MeasurePlanOutput:
    """The document of a measurement that is planned."""
    first = plan.excitations[0]
    return MeasurePlanOutput.of(
        plan,
        gains=gains,
        flights=len(plan.excitations),
        periods=first.periods,
        frequency_Hz=first.signal.frequencies.tolist(),
        half_width=dict(zip(plan.sensors, plan.half_width.T.tolist(), strict=True)),
        coherence={name: values.tolist() for name, values in plan.coherence.items()},
        motion={name: max(one.motion[name] for one in plan.excitations) for name in first.motion},
        current_A={name: max(one.current[name] for one in plan.excitations) for name in first.current},
    )
