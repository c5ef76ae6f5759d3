"""The documents of `malta report` and `malta compare`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from malta.cli.documents.parts import Files, Number, Part

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from malta.report.page.analysis import Analysis
    from malta.report.page.comparison import Comparison


class ReportOutput(Part):
    """What `malta report --json` prints."""

    kind: Literal["malta-report-output"] = Field(default="malta-report-output", alias="schema")
    version: Literal[1] = 1
    gains: str
    design: str
    figures: dict[str, Number] = Field(description="the figures of merit of the page, SI")
    files: Files


class ComparedDesign(Part):
    """A design of a comparison."""

    name: str = Field(description="the design's, or with a number where two have one name")
    gains: str
    machine: str
    stable: bool


class ComparedFigure(Part):
    """A figure of merit of all designs."""

    key: str
    group: str
    better: str | None = Field(description='"high" or "low"; null where neither is better')
    values: list[Number] = Field(description="of each design, SI")
    best: list[str] = Field(description="designs whose value is the better one; none of a tie")


class CompareOutput(Part):
    """What `malta compare --json` prints."""

    kind: Literal["malta-compare-output"] = Field(default="malta-compare-output", alias="schema")
    version: Literal[1] = 1
    designs: list[ComparedDesign]
    differences: dict[str, list[Any]] = Field(description="what the designs do not share, one entry a design")
    figures: list[ComparedFigure]
    remarks: list[str] = Field(description="what could not be compared, and why")
    files: Files


def report_output(gains: Path, analysis: Analysis, files: Iterable[Path]) -> ReportOutput:
    """The document of a report."""
    figures: dict[str, float | None] = {score.key: score.value for score in analysis.figures}
    name = analysis.subject.controller.name
    return ReportOutput(gains=str(gains), design=name, figures=figures, files=list(map(str, files)))


def compare_output(found: Comparison, files: Iterable[Path]) -> CompareOutput:
    """The document of a comparison."""
    designs = [
        ComparedDesign(name=name, gains=a.subject.source, machine=a.plant.name, stable=a.report.stable)
        for name, a in zip(found.names, found.designs, strict=True)
    ]
    figures = [
        ComparedFigure(
            key=row.key,
            group=row.group,
            better=next(s for s in row.scores if s is not None).meaning.better or None,
            values=[None if score is None else score.value for score in row.scores],
            best=[name for name, best in zip(found.names, row.best, strict=True) if best],
        )
        for row in found.rows
    ]
    differences = {
        row.key: [None if entry is None else entry.value for entry in row.entries]
        for row in found.differences
    }
    return CompareOutput(
        designs=designs,
        differences=differences,
        figures=figures,
        remarks=list(found.remarks),
        files=list(map(str, files)),
    )
