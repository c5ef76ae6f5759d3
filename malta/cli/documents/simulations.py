"""The documents of `malta simulate` and `malta design`: verdicts, limits and figures of merit of runs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from malta.cli.documents.loops import LoopPart, loop_fields
from malta.cli.documents.parts import End, Files, Number, Part, merits_of
from malta.identifiers import identifier

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from malta.firmware.elementary import Precision
    from malta.firmware.flight import Difference
    from malta.margins.loop_report import LoopReport
    from malta.simulation.experiments import Experiment

MERITS = "figures of merit; a key ends in its SI unit, and in _share where 0.01 is 1 %"


class CasePart(Part):
    """A run of an experiment."""

    READS: ClassVar = {"verdict": "run.verdict", "limits": "run.limits"}

    label: str
    verdict: End
    limits: list[str] = Field(description="limits of the machine that the run met")
    merits: dict[str, Number] = Field(description=MERITS)


class StrokePart(Part):
    """Figures of a stroke, as papers publish them."""

    READS: ClassVar = {"error_along": "axial_error"}

    rise_s: Number = Field(description="10 to 90 % of the stroke")
    overshoot_share: Number
    error_along: Number = Field(description="largest deviation along the stroke, in SI")
    errors_across: dict[str, Number] = Field(description="largest deviation of each other output; _m or _rad")
    force_N: Number
    current_A: Number


class ExperimentPart(Part):
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


class SignalPart(Part):
    """How far a signal is apart in two flights at most, and its range; SI."""

    largest: Number
    range: Number


class FlightPart(Part):
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


class DesignPart(LoopPart, ExperimentPart):
    """A design that was made, verified and simulated."""

    design: str
    files: Files = Field(description="gain files, and the figure")
    changes: list[str] = Field(default=[], description="of --set")


class DesignOutput(Part):
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
    from malta.simulation.trajectory import stroke_figures

    run = experiment.run
    found, units = stroke_figures(run), {signal.name: signal.unit for signal in run.plant.outputs}
    across = {identifier(name, units[name]): value for name, value in found.radial.items()}
    return StrokePart.of(found, errors_across=across)


def flights(found: Mapping[str, Mapping[Precision, Sequence[Difference]]]) -> list[FlightPart]:
    """The differences of the exported C's flights, by case and precision."""
    return [
        FlightPart(
            case=label,
            precision=precision,
            signals={d.name: SignalPart.of(d) for d in rows},
        )
        for label, by_precision in found.items()
        for precision, rows in by_precision.items()
    ]


def design_part(
    name: str, files: Sequence[Path], changes: Sequence[str], margins: LoopReport, flown: Experiment
) -> DesignPart:
    """A design with its loop and its main job."""
    return DesignPart(
        design=name,
        files=[str(file) for file in files],
        changes=list(changes),
        **loop_fields(margins),
        **experiment_fields(flown),
    )
