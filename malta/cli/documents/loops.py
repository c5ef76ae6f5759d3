"""The document of `malta verify`, and what it shares with `malta design`: stability and margins of a loop."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from malta.cli.documents.parts import Files, Number, Part, Shares, with_keys

if TYPE_CHECKING:
    from malta.loops.recovery import Deviation, Recovery
    from malta.margins.stages import Robustness
    from malta.margins.verify import Margins
    from malta.proof.blocks.gain import Gain
    from malta.proof.margin import Margin
    from malta.simulation.payload import Payload
    from malta.tuning.outcomes import Outcome

Poles = list[tuple[float, float]]


class PolesPart(Part):
    """Poles as [real, imaginary] in rad/s; of sampled systems ln(lambda) / Ts."""

    open_loop: Poles
    regulator: Poles
    filter: Poles
    closed_loop: Poles


class LoopPart(Part):
    """Stability, poles, bandwidths and peak sensitivities of a loop."""

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


class LinkPart(MarginPart):
    """A stage from the ideal loop to the machine's."""

    stage: str
    peak_sensitivity: Number
    at: Literal["forces", "sensors"] = Field(description="where the loop is opened for |S|")
    loaded: bool = Field(description="whether |S| is that of the machine under its loads")


class PlacePart(MarginPart):
    """The machine's loop at a place of its travel, or at a value of a parameter."""

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

    found: Number
    frequency_rad_per_s: Number
    proven: Number = Field(description="upper bound")
    reason: str


class RobustPart(Part):
    """Margins over an uncertainty and over the travel."""

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


def requirement_part(outcome: Outcome) -> RequirementPart:
    """A requirement and what is reached of it."""
    return RequirementPart(
        name=outcome.name,
        asked=outcome.asked,
        found=outcome.found,
        unit=outcome.unit,
        how=outcome.how,
        ratio=outcome.ratio,
        holds=outcome.holds,
        verdict=outcome.verdict,
        interval=outcome.interval,
    )


def loop_fields(margins: Margins) -> dict[str, Any]:
    """The fields of a LoopPart."""
    peaks = {stage.name: dict(stage.peak_sensitivity) for stage in margins.stages}
    return {
        "stable": margins.stable,
        "poles_rad_per_s": margins.poles.pairs(),
        "bandwidth_rad_per_s": dict(margins.bandwidth),
        "peak_sensitivity": with_keys(peaks),
    }


def recovery_part(found: Recovery) -> RecoveryPart:
    """The answer to a constant load, by output."""

    def deviation(d: Deviation) -> DeviationPart:
        return DeviationPart(
            unit=d.unit,
            largest=d.largest,
            left=[LeftPart(after_s=t, value=left) for t, left in zip(found.after, d.left, strict=True)],
            settled_s=d.settled,
            final=d.final,
            compliance=CompliancePart(peak=d.compliance, frequency_rad_per_s=d.frequency),
        )

    return RecoveryPart(load=dict(found.load), outputs={d.output: deviation(d) for d in found.outputs})


def payload_part(found: Payload | None) -> PayloadPart | None:
    """The payload of a machine."""
    if found is None:
        return None
    return PayloadPart(held_kg=found.held, carried_kg=found.carried, dropped_kg=found.dropped)


def robust_part(
    found: Robustness, box: Mapping[str, float], worst: Mapping[str, Gain], units: Mapping[str, str]
) -> RobustPart:
    """Margins over an uncertainty and over the travel.

    worst : the largest |S| of each sensor; empty where it was not asked for
    units : of the sensors
    """
    along = "m" if found.extent.stroke else found.extent.unit
    return RobustPart(
        uncertainty=dict(box),
        chain=[
            LinkPart(
                stage=link.name,
                peak_sensitivity=link.peak,
                at=link.broken_at,
                loaded=link.loaded,
                **_margin_fields(link.margin),
            )
            for link in found.chain
        ],
        travel=margin_part(found.travel),
        disks=[
            DiskPart(
                channels=disk.channels,
                size=disk.size,
                gain=disk.gain,
                phase_rad=disk.phase,
                frequency_rad_per_s=disk.frequency,
            )
            for disk in found.disks
        ],
        delay_s=dict(found.delay),
        gang_of_four={
            name: GangPart(S=S, T=T, SP=SP, FS=FS, unit=units[name])
            for name, (S, T, SP, FS) in found.gang.items()
        },
        tolerance={
            name: TolerancePart(down=margin_part(down), up=margin_part(up))
            for name, (down, up) in found.tolerance.items()
        },
        mass_kg=None if found.mass is None else margin_part(found.mass),
        places=[
            PlacePart(
                position=place.position,
                unit=along,
                peak_sensitivity=place.peak,
                disk=place.disk,
                delay_s=place.delay,
                **_margin_fields(place.margin),
            )
            for place in found.places
        ],
        worst_sensitivity={name: _gain_part(gain) for name, gain in worst.items()},
    )


def margin_part(margin: Margin) -> MarginPart:
    """A margin in multiples of the uncertainty."""
    return MarginPart(**_margin_fields(margin))


def _margin_fields(margin: Margin) -> dict[str, Any]:
    return {
        "lower": margin.lower,
        "upper": None if margin.exhausted else margin.upper,
        "frequency_rad_per_s": margin.frequency,
        "witness": None if margin.witness is None else dict(margin.witness),
        "sensitivity": dict(margin.sensitivity),
        "cells": sum(proof.cells for proof in margin.certificate),
        "reason": margin.reason,
        "searched": margin.searched,
        "time_up": margin.time_up,
    }


def _gain_part(gain: Gain) -> GainPart:
    return GainPart(
        found=gain.lower, frequency_rad_per_s=gain.frequency, proven=gain.upper, reason=gain.reason
    )
