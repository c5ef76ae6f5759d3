"""The documents of `malta excite`, `log`, `identify`, `learn` and `replay`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from malta.cli.documents.parts import Files, Number, Part
from malta.identification.response import units_of_model

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from malta.identification.excite import ExcitationPlan
    from malta.identification.identify import Identified
    from malta.identification.learn import Learned
    from malta.identification.log import Log
    from malta.identification.replay import LawReplay


class ExciteOutput(Part):
    """What `malta excite --json` prints."""

    kind: Literal["malta-excite-output"] = Field(default="malta-excite-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    duration_s: float
    lines_Hz: list[float]
    crest_factor: list[Number] = Field(description="of each input")
    motion: dict[str, float] = Field(description="largest deviation of each output, SI")
    current_A: dict[str, float] = Field(description="largest deviation of each current from that at rest")
    command_share: dict[str, float] = Field(description="largest command of each input, of its limit")
    accuracy_share: dict[str, float] = Field(description="half of the 95 % interval of each parameter")
    files: Files


class SignalStatistics(Part):
    """Statistics of a column of a log, in its unit."""

    unit: str
    least: Number
    mean: Number
    largest: Number
    deviation: Number = Field(description="standard deviation")


class LogOutput(Part):
    """What `malta log --json` prints."""

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
    files: Files


class IdentifiedParameter(Part):
    """A parameter with its interval."""

    unit: str
    value: float
    low: float = Field(description="end of the 95 % interval")
    high: float
    start: float = Field(description="value of the gain file")


class IdentifyOutput(Part):
    """What `malta identify --json` prints."""

    kind: Literal["malta-identify-output"] = Field(default="malta-identify-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    log: str
    parameters: dict[str, IdentifiedParameter]
    correlation: list[list[float]]
    held: dict[str, float] = Field(description="parameters that act too and were taken as known, SI")
    chi2_per_dof: float
    chi2_limit: float
    dof: int
    whiteness: float = Field(description="correlation of neighbouring lines, in standard deviations")
    distortion: Number = Field(description="power where nothing was excited, over the noise")
    refusal: str = Field(description='why the model does not explain the log; "": it does')
    files: Files


class LearnOutput(Part):
    """What `malta learn --json` prints."""

    kind: Literal["malta-learn-output"] = Field(default="malta-learn-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    log: str
    factor: float
    deviation: float = Field(description="standard deviation of the factor")
    parameter: str
    before: float
    after: float
    files: Files


class ReplayOutput(Part):
    """What `malta replay --json` prints."""

    kind: Literal["malta-replay-output"] = Field(default="malta-replay-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    log: str
    same: bool
    difference: dict[str, float] = Field(description="largest of each command in the second half, SI")
    difference_at_once: dict[str, float] = Field(description="the same from the first sample on")
    innovation_rms: dict[str, float] = Field(description="of each output, SI")
    sensor_noise: dict[str, float] = Field(description="noise and steps of each sensor, SI")
    whiteness: dict[str, float] = Field(description="largest autocorrelation, in standard deviations")


def excite_output(gains: Path, plan: ExcitationPlan, files: Iterable[Path]) -> ExciteOutput:
    """The document of an excitation."""
    return ExciteOutput(
        gains=str(gains),
        duration_s=plan.duration,
        lines_Hz=plan.signal.frequencies.tolist(),
        crest_factor=plan.signal.crest_factor.tolist(),
        motion=dict(plan.motion),
        current_A=dict(plan.current),
        command_share=dict(plan.command),
        accuracy_share=dict(plan.accuracy),
        files=list(map(str, files)),
    )


def log_output(log: Log, files: Iterable[Path]) -> LogOutput:
    """The document of a log."""
    found, signals = log.survey, {}
    for heading, numbers in found.statistics.items():
        name, _, unit = heading.partition(" [")
        fields = dict(zip(("least", "mean", "largest", "deviation"), numbers, strict=True))
        signals[name.replace(".", "_")] = SignalStatistics(unit=unit[:-1], **fields)
    return LogOutput(
        log=log.source,
        sha256=log.sha256,
        machine=log.machine,
        controller=log.controller,
        samples=log.samples,
        sample_time_s=log.sample_time,
        period_s=log.period,
        signals=signals,
        jitter_s=found.jitter,
        findings=list(found.findings),
        files=list(map(str, files)),
    )


def identify_output(gains: Path, found: Identified, files: Iterable[Path]) -> IdentifyOutput:
    """The document of an identification."""
    units = units_of_model(found.plant)
    parameters = {
        name: IdentifiedParameter(unit=units[name], value=value, low=low, high=high, start=start)
        for (name, (low, high)), value, start in zip(
            found.intervals.items(), found.values.tolist(), found.start.tolist(), strict=True
        )
    }
    return IdentifyOutput(
        gains=str(gains),
        log=found.log.source,
        parameters=parameters,
        correlation=found.correlation.tolist(),
        held=dict(found.held),
        chi2_per_dof=found.chi2,
        chi2_limit=found.limit,
        dof=found.dof,
        whiteness=found.whiteness,
        distortion=found.distortion,
        refusal=found.refusal,
        files=list(map(str, files)),
    )


def learn_output(gains: Path, log: Path, found: Learned, files: Iterable[Path]) -> LearnOutput:
    """The document of what a stroke taught."""
    return LearnOutput(
        gains=str(gains),
        log=str(log),
        factor=found.factor,
        deviation=found.deviation,
        parameter=found.parameter,
        before=found.before,
        after=found.after,
        files=list(map(str, files)),
    )


def replay_output(gains: Path, log: Path, found: LawReplay) -> ReplayOutput:
    """The document of a replay."""
    return ReplayOutput(
        gains=str(gains),
        log=str(log),
        same=found.same,
        difference=dict(found.difference),
        difference_at_once=dict(found.at_once),
        innovation_rms=dict(found.rms),
        sensor_noise=dict(found.expected),
        whiteness=dict(found.whiteness),
    )
