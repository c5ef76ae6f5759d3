"""The document of `malta verify`, and what it shares with `malta design`: stability and margins of a loop."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from malta.cli.documents.parts import UNIT, Files, Number, Part, Shares, with_keys

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from malta.loops.recovery import Deviation, Recovery
    from malta.margins.loop_report import LoopReport

Poles = list[tuple[float, float]]


class PolesPart(Part):
    """Poles as [real, imaginary] in rad/s; of sampled systems ln(lambda) / Ts."""

    open_loop: Poles
    regulator: Poles
    filter: Poles
    closed_loop: Poles


class LoopPart(Part):
    """Stability, poles, bandwidths and peak sensitivities of a loop."""

    READS: ClassVar = {"poles_rad_per_s": "poles.pairs"}

    stable: bool
    poles_rad_per_s: PolesPart
    bandwidth_rad_per_s: dict[str, Number] = Field(description="by definition")
    peak_sensitivity: dict[str, dict[str, Number]] = Field(
        description="largest |S| by stage (sampled, current_loops, machine), by sensor, and sigma_max of all"
    )


class MarginPart(Part):
    """A margin in multiples of the uncertainty."""

    lower: Number = Field(description="proven: every loop within it is stable; null where nothing is proven")
    upper: Number = Field(description="an unstable loop was found there; null where none was found")
    frequency_rad_per_s: Number
    witness: dict[str, float] | None = Field(description="parameters of the unstable loop, SI")
    sensitivity: dict[str, float] = Field(description="share of each parameter in the margin")
    cells: int = Field(description="of the proof")
    reason: str = Field(description="why nothing, or less than found, is proven")
    searched: str = Field(description="how far no unstable loop was found, where upper is null")
    time_up: bool = Field(description="the search ended as its time was up: more time may prove more")


OF_MARGIN = {key: f"margin.{UNIT.sub('', key)}" for key in MarginPart.model_fields}


class LinkPart(MarginPart):
    """A stage from the ideal loop to the machine's."""

    READS: ClassVar = OF_MARGIN | {"stage": "name", "peak_sensitivity": "peak", "at": "broken_at"}

    stage: str
    peak_sensitivity: Number
    at: Literal["forces", "sensors"] = Field(description="where the loop is opened for |S|")
    loaded: bool = Field(description="whether |S| is that of the machine under its loads")


class PlacePart(MarginPart):
    """The machine's loop at a place of its travel, or at a value of a parameter."""

    READS: ClassVar = OF_MARGIN | {"peak_sensitivity": "peak"}

    position: float
    unit: str = Field(description="SI unit of the position")
    peak_sensitivity: Number
    disk: Number
    delay_s: Number


class DiskPart(Part):
    """A disk margin."""

    channels: str
    size: Number
    gain: Number = Field(description="factor, up or down")
    phase_rad: Number
    frequency_rad_per_s: Number


class GangPart(Part):
    """Gang of four at a sensor; SP in `unit`/N, FS in N/`unit`, of a torque N m in place of N."""

    S: Number
    T: Number
    SP: Number
    FS: Number
    unit: str


class TolerancePart(Part):
    """Margins of a parameter alone."""

    down: MarginPart
    up: MarginPart


class GainPart(Part):
    """The largest gain over the uncertainty."""

    READS: ClassVar = {"found": "lower", "proven": "upper"}

    found: Number
    frequency_rad_per_s: Number
    proven: Number = Field(description="upper bound")
    reason: str


class RobustPart(Part):
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
    worst_sensitivity: dict[str, GainPart] = Field(
        description="largest |S| over the uncertainty; {}: not asked"
    )


class LeftPart(Part):
    """What is left of a deviation."""

    after_s: float
    value: Number


class CompliancePart(Part):
    """The largest amplitude over frequency under a load of this amplitude."""

    peak: Number
    frequency_rad_per_s: Number


class DeviationPart(Part):
    """What a constant load does to an output."""

    unit: str
    largest: Number
    left: list[LeftPart]
    settled_s: Number
    final: Number
    compliance: CompliancePart


class RecoveryPart(Part):
    """The answer to a constant load from outside."""

    load: dict[str, float] = Field(description="N or N m, by disturbance")
    outputs: dict[str, DeviationPart]


class PayloadPart(Part):
    """How much the machine carries beside its mover; null: any, or not flown."""

    held_kg: Number
    carried_kg: Number
    dropped_kg: Number


class RequirementPart(Part):
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
    gains: str
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
    )
    own = {"gains": str(gains), "files": [str(file) for file in files], "robust": robust}
    return VerifyOutput.of(found, **loop_fields(found) | own, recovery=[_recovery(r) for r in found.recovery])


def _recovery(found: Recovery) -> RecoveryPart:
    """The answer to a constant load, by output."""

    def deviation(d: Deviation) -> DeviationPart:
        left = [{"after_s": t, "value": value} for t, value in zip(found.after, d.left, strict=True)]
        return DeviationPart.of(
            d, left=left, compliance={"peak": d.compliance, "frequency_rad_per_s": d.frequency}
        )

    return RecoveryPart.of(found, outputs={d.output: deviation(d) for d in found.outputs})
