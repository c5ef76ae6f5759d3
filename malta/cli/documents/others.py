"""The documents of `malta check`, `malta tune`, `malta claims`, `malta export` and `malta pil`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from malta.cli.documents.loops import RequirementPart
from malta.cli.documents.parts import Files, Number, Part
from malta.identifiers import identifier
from malta.report.ledger import Word

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from malta.proof.certificate.checked_file import Claim
    from malta.report.ledger import Ledger
    from malta.synthesis.spec import Spec
    from malta.tuning.tune import Tuned


class ClaimedParameter(Part):
    """A parameter of a certificate's box; SI."""

    name: str
    unit: str | None
    nominal: float
    low: float = Field(description="of the interval at `lower`")
    high: float


class CertifiedPart(Part):
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


class CheckOutput(Part):
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


def certified_part(claim: Claim) -> CertifiedPart:
    """What a certificate says that it is of."""
    from malta.proof.certificate.checked_file import double

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
            ClaimedParameter(
                name=p.name,
                unit=p.unit,
                nominal=double(p.nominal),
                low=double(p.interval[0]),
                high=double(p.interval[1]),
            )
            for p in claim.parameters
        ],
    )


class SearchPart(Part):
    """How a design was found."""

    trials: int
    values: dict[str, float] = Field(description="the numbers that were searched, by their names in the file")
    delay_samples: int
    front: list[dict[str, Number]] = Field(description="figures of the trials of the Pareto front")


class TuneOutput(Part):
    """What `malta tune --json` prints."""

    kind: Literal["malta-tune-output"] = Field(default="malta-tune-output", alias="schema")
    version: Literal[1] = 1
    design: str
    files: Files = Field(default=[])
    requirements: list[RequirementPart]
    search: SearchPart | None = Field(default=None, description="null with --check, which searches nothing")


class ClaimPart(Part):
    """A published number, ours for each design, and the verdict; as text, with the printed digits."""

    subject: str
    published: str
    ours: list[str]
    verdict: str = Field(description="with notes and reasons")
    word: Word = Field(description="the verdict in one word")


class LedgerPart(Part):
    """All published numbers on a machine."""

    machine: str
    source: str
    designs: list[str]
    reproducing: list[str] = Field(
        description="designs that are meant to reproduce the paper: these are judged"
    )
    claims: list[ClaimPart]


class ClaimsOutput(Part):
    """What `malta claims --json` prints."""

    kind: Literal["malta-claims-output"] = Field(default="malta-claims-output", alias="schema")
    version: Literal[1] = 1
    ledgers: list[LedgerPart]


class ExportOutput(Part):
    """What `malta export --json` prints."""

    kind: Literal["malta-export-output"] = Field(default="malta-export-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    to: Literal["c", "fmu"]
    files: Files


class VectorPart(Part):
    """What a target made of a recorded vector."""

    name: str
    samples: int
    first_that_differs: int | None = Field(description="a sample; null where all bits agree")
    largest_difference: Number = Field(description="of a force, N or N m, or of a command")


class PilOutput(Part):
    """What `malta pil --json` prints."""

    kind: Literal["malta-pil-output"] = Field(default="malta-pil-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    port: str
    precision: Literal["double", "float"]
    agrees: bool
    vectors: list[VectorPart]
    samples_per_s: float = Field(description="with the line")
    requests_sent_again: int
    slowest_step_counts: int | None = Field(description="of the target's timer; null where it has none")


def tune_output(spec: Spec, tuned: Tuned, files: Sequence[Path]) -> TuneOutput:
    """The document of a search."""
    from malta.synthesis.requirements import requirements_for

    units = {name: one.unit for name, one in requirements_for(spec.plant).items()}
    search = SearchPart(
        trials=tuned.trials,
        values=dict(zip((v.name for v in spec.search), tuned.trial.values, strict=True)),
        delay_samples=tuned.trial.delay,
        front=[
            {identifier(name, units.get(name, "1")): value for name, value in point.figures.items()}
            for point in tuned.front
        ],
    )
    return TuneOutput(
        design=spec.name,
        files=[str(path) for path in files],
        requirements=[RequirementPart.of(r) for r in tuned.requirements],
        search=search,
    )


def claims_output(ledgers: Sequence[Ledger]) -> ClaimsOutput:
    """The document of ledgers."""
    return ClaimsOutput(
        ledgers=[
            LedgerPart(
                machine=one.machine,
                source=one.source,
                designs=list(one.designs),
                reproducing=list(one.reproducing),
                claims=[
                    ClaimPart(
                        subject=c.subject,
                        published=c.published,
                        ours=list(c.ours),
                        verdict=c.verdict,
                        word=c.word,
                    )
                    for c in one.claims
                ],
            )
            for one in ledgers
        ]
    )
