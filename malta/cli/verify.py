"""`malta verify`: the margins of a gain file, with their proofs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, cast

import typer

from malta.cli.assignments import read_uncertainty
from malta.cli.inputs import change_machine, design_of, read_controller
from malta.cli.options import AsJson, Changes, DesignFile, GainFile, MachineFile, Uncertain
from malta.cli.output import (
    make_console,
    margin_progress,
    print_document,
    print_note,
    print_text,
    print_written,
)
from malta.errors import CheckError, InputError

if TYPE_CHECKING:
    from rich.table import Table

    from malta.cli.documents.loops import VerifyOutput
    from malta.identification.data_file import IdentifiedData
    from malta.loops.recovery import Recovery
    from malta.margins.stages import Robustness
    from malta.margins.verify import Margins
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant
    from malta.proof.blocks.gain import Gain
    from malta.proof.machine.windings import CurrentLoops
    from malta.proof.margin import Margin
    from malta.report.tables.layout import Paragraph
    from malta.simulation.payload import Payload
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec
    from malta.tuning.outcomes import Outcome


MOST = 0.5  # of the time of a verification, which the margins take
NEAREST = 3  # requirements that are named though they hold


class Subject(NamedTuple):
    """A gain file on its machine, and the uncertainty that the margins count in."""

    gains: Path
    controller: Controller
    plant: Plant
    model: LinearModel
    box: Mapping[str, float]  # parameter -> share, either way, at margin 1
    current_loops: CurrentLoops
    spec: Spec | None  # of the machine with its changes; None: no design file


class Analysis(NamedTuple):
    """All that is computed of a loop."""

    margins: Margins
    robustness: Robustness
    worst: Mapping[str, Gain]  # the largest |S| of each sensor; empty where it was not asked for
    recovered: Sequence[
        Recovery
    ]  # of each disturbance; none of an unstable loop, or where no load acts from outside
    payload: Payload | None  # None for an unstable loop, and for a machine without a mass m
    outcomes: Sequence[Outcome]  # of the requirements that no flight measures; none without a design file


def verify(
    gains: GainFile,
    change: Changes = None,
    uncertain: Uncertain = None,
    current_loops: Annotated[
        str, typer.Option(help="Of the last stage: pi (controllers on the windings), or lag (first order).")
    ] = "pi",
    time: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", help="Longest search of a margin over the travel. [120]"),
    ] = None,
    no_proof: Annotated[
        bool, typer.Option("--no-proof", help="A first look: no proof of the margins over the travel.")
    ] = False,
    worst_case: Annotated[
        bool | None,
        typer.Option(
            "--worst-case/--no-worst-case",
            help="The largest |S| of each sensor over the uncertainty. [where one proof covers the travel]",
        ),
    ] = None,
    certificate: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Write the proof of the margin, for `malta check`.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the figures (.png).")] = None,
    design: DesignFile = None,
    identified: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="A data file of malta identify: its machine, its 95 % intervals as the uncertainty.",
        ),
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Verify a gain file on the machine, stage by stage.

    Poles, bandwidths by definition, peak sensitivities with their ISO 14839-3 zones; real parametric margins with
    their proof, from full state feedback to the sampled loop, and over the travel; disk and delay margins, gang of
    four, tolerance of each parameter; what a constant load of 1 N or 1 N m from outside does; the payload that the
    forces hold and the mover carries in flight. Last, what the design file asks for, but for what has to be flown.

    The machine is the one in the file, with the changes given by --set, as far as they shape the linear loop (on MALTA
    also windings and DC link; the current controllers are those of the gain file). What it leaves out is said.

    \b
    Example:  malta verify design/gains/calibrated.json --set m=0.56
    """
    from malta.margins.verify import require_stable
    from malta.model.data import plant_of
    from malta.model.linearize import linearize
    from malta.model.published import published_figures

    controller = read_controller(gains, machine)
    measured = None if identified is None else _read_identified(identified, controller, change, uncertain)
    parameters = controller.parameters if measured is None else measured.parameters
    plant = plant_of(change_machine(parameters, change))
    model = linearize(plant, plant.point(controller.operating_point[0]))
    published = published_figures(plant.name)
    box = measured.shares if measured else read_uncertainty(gains, uncertain, plant.parameters, published)
    _require_options(time, certificate, proof=not no_proof)
    spec = _spec_of(gains, controller, design, plant)
    subject = Subject(gains, controller, plant, model, box, cast("CurrentLoops", current_loops), spec)
    analysis = _analyse(subject, time, proof=not no_proof, worst_case=worst_case)
    files: list[Path] = []
    refusal: InputError | CheckError | None = None
    if certificate is not None:
        try:
            files.append(_write_certificate(certificate, subject, analysis.robustness.travel))
        except (InputError, CheckError) as error:
            refusal = error  # the tables come first
    if out is not None:
        files += _draw(subject, analysis, out)
    if as_json:
        print_document(_document(subject, analysis, files))
    else:
        _print_tables(subject, analysis, published, change or (), files)
    require_stable(analysis.margins, str(gains))
    if refusal is not None:
        raise refusal


def _read_identified(
    path: Path, controller: Controller, change: list[str] | None, uncertain: list[str] | None
) -> IdentifiedData:
    """The machine and the intervals of a data file. Raises InputError beside options that say the same."""
    from malta.identification.data_file import read_identified

    if change or uncertain:
        other = "--set" if change else "--uncertain"
        raise InputError(
            "--identified", "", f"{other} too", "one of them: the file says machine and intervals"
        )
    data = read_identified(path)
    if type(data.parameters) is not type(controller.parameters):
        raise InputError(path, "machine", "another machine", "that of the gain file")
    joint = 100 * data.joint
    print_note(
        f"{path}: margins count in 95 % intervals; all parameters together are within {joint:.0f} % of them"
    )
    return data


def _require_options(time: float | None, certificate: Path | None, *, proof: bool) -> None:
    """Raise InputError for a time that is not positive, or a certificate without a proof."""
    if time is not None and not 0 < time < math.inf:
        raise InputError("--time", "", f"{time:g}", "seconds above 0")
    if certificate is not None and not proof:
        raise InputError("--certificate", "", "--no-proof", "one of them")


def _analyse(subject: Subject, time: float | None, *, proof: bool, worst_case: bool | None) -> Analysis:
    """Compute the margins of a loop behind a progress bar.

    time : s, longest search of a margin over the travel
    worst_case : whether the largest |S| is searched; None: where one proof covers the travel

    Raises CheckError, naming the gain file, when a result fails its own check.
    """
    from malta.loops.recovery import recovery
    from malta.margins.stages import robustness
    from malta.margins.travel import covers_travel, worst_sensitivities
    from malta.margins.verify import verify as compute_margins
    from malta.simulation.payload import payload

    plant, controller, box, current_loops = (
        subject.plant,
        subject.controller,
        subject.box,
        subject.current_loops,
    )
    try:
        with margin_progress("margins") as (progress, bounds):
            margins = compute_margins(subject.model, controller)
            robust = robustness(
                plant, controller, box,
                current_loops=current_loops, progress=lambda share: progress(MOST * share), bounds=bounds,
                time=time, proof=proof,
            )  # fmt: skip
            if worst_case is None:
                worst_case = proof and covers_travel(plant, controller, tuple(box), current_loops)
            worst = (
                worst_sensitivities(plant, controller, box, current_loops, time=time) if worst_case else {}
            )
            progress(0.5 * (1 + MOST))
            recovered = recovery(plant, controller) if margins.stable and plant.disturbances else ()
            carried = payload(plant, controller) if margins.stable and proof else None
            outcomes = _judge(subject, margins, robust, proof=proof)
    except CheckError as error:
        raise CheckError(f"{subject.gains}: {error}") from error
    return Analysis(margins, robust, worst, recovered, carried, outcomes)


def _spec_of(gains: Path, controller: Controller, named: Path | None, plant: Plant) -> Spec | None:
    """The design file of a gain file, on the machine that is verified; None where there is none."""
    spec = design_of(gains, controller, named)
    return None if spec is None else replace(spec, parameters=plant.parameters)


def _judge(subject: Subject, margins: Margins, robust: Robustness, *, proof: bool) -> Sequence[Outcome]:
    """Judge the requirements that no flight measures, by the margins that are known; a margin if it is proven."""
    from malta.tuning.outcomes import judge, unflown

    spec = subject.spec
    if spec is None:
        return ()
    names = [name for name in unflown(spec) if proof or name != "margin"]
    same = subject.current_loops == "pi" and dict(subject.box) == dict(spec.uncertainty)
    verified = replace(margins, robust=robust.travel) if same or "margin" not in names else None
    try:
        return judge(spec, subject.controller, names=names, verified=verified)
    except InputError as error:
        print_note(f"the requirements were not judged: {error}")
        return ()


def _write_certificate(path: Path, subject: Subject, margin: Margin) -> Path:
    """Write the certificate of the margin over the travel."""
    from malta.gains.certified import origin_of
    from malta.margins.travel import travel_loops
    from malta.proof.certificate import certificate

    places, over = travel_loops(subject.plant, subject.controller, tuple(subject.box), subject.current_loops)
    origin = origin_of(subject.gains, subject.plant, subject.controller, subject.current_loops, len(places))
    return certificate.write(path, places, subject.box, over, margin, origin)


def _draw(subject: Subject, analysis: Analysis, folder: Path) -> list[Path]:
    """Draw the margins stage by stage and over the travel, and how loads are carried where there are any."""
    from malta import report

    name = subject.controller.name
    picture, position = folder / f"{name}_margins.png", f"position {subject.plant.stroke}"
    report.robustness(analysis.robustness, name, subject.box, picture, position, analysis.worst)
    files = [picture]
    if analysis.recovered:
        files.append(folder / f"{name}_loads.png")
        report.loads(subject.plant, subject.controller, files[-1], analysis.recovered)
    return files


def _document(subject: Subject, analysis: Analysis, files: Sequence[Path]) -> VerifyOutput:
    """The JSON document of a verification."""
    from malta.cli.documents.loops import (
        VerifyOutput,
        loop_fields,
        payload_part,
        recovery_part,
        requirement_part,
        robust_part,
    )
    from malta.proof.machine.windings import left_out

    units = {signal.name: signal.unit for signal in subject.plant.outputs}
    return VerifyOutput(
        gains=str(subject.gains),
        design=subject.controller.name,
        files=[str(file) for file in files],
        recovery=[recovery_part(one) for one in analysis.recovered],
        robust=robust_part(analysis.robustness, subject.box, analysis.worst, units),
        payload=payload_part(analysis.payload),
        left_out=left_out(subject.plant, subject.controller, subject.current_loops),
        requirements=[requirement_part(one) for one in analysis.outcomes],
        **loop_fields(analysis.margins),
    )


def _print_tables(
    subject: Subject,
    analysis: Analysis,
    published: Mapping[str, Any] | None,
    changes: Sequence[str],
    files: Sequence[Path],
) -> None:
    """Print the tables of a verification; poles of a changed machine stand beside no published ones."""
    from malta import report
    from malta.proof.machine.windings import left_out

    controller, margins, robust = subject.controller, analysis.margins, analysis.robustness
    missing = left_out(subject.plant, controller, subject.current_loops)
    open_bounds = report.open_bounds(robust, analysis.worst)
    box = "  ".join(f"{name} +-{100 * share:g} %" for name, share in subject.box.items())
    console = make_console()
    preset = f"{controller.parameters.preset} {' '.join(changes)}".rstrip()
    print_text(console, f"{subject.gains}: {controller.name}, {subject.plant.name}, preset {preset}")
    for table in (
        report.poles_table(subject.model, None if changes else published),
        report.loop_poles_table(margins),
        report.bandwidth_table(margins, published),
        report.sensitivity_table(margins),
        *([report.recovery_table(analysis.recovered, subject.plant)] if analysis.recovered else []),
        report.Paragraph(f"Uncertainty: {box}\n"),
        report.chain_table(robust),
        *([report.Paragraph(f"Not in the last stage: {missing}\n")] if missing else []),
        *([report.Paragraph("\n".join(open_bounds) + "\n")] if open_bounds else []),
        report.disk_table(robust, controller.sample_time),
        report.gang_table(robust, subject.plant),
        report.tolerance_table(robust, subject.box, analysis.payload),
        report.places_table(robust, controller.sample_time),
        *([report.worst_case_table(analysis.worst)] if analysis.worst else []),
        *_requirements(subject, analysis),
    ):
        console.print(table)
    print_written(console, files)


def _requirements(subject: Subject, analysis: Analysis) -> Iterator[Table | Paragraph]:
    """The requirements of the design file that do not hold, then how many do; nothing without a design file."""
    from malta import report

    spec, asked = subject.spec, [one for one in analysis.outcomes if one.asked is not None]
    if spec is None or not asked:
        return
    failed = [one for one in asked if not one.holds]
    if failed:
        yield report.requirements_table(failed)
    held = sorted((one for one in asked if one.holds), key=lambda one: -one.ratio)
    near = ", ".join(f"{one.name.replace('_', ' ')} {100 * one.ratio:.1f} %" for one in held[:NEAREST])
    text = f"Requirements of {spec.path}: {len(held)} of {len(asked)} hold"
    if held:
        text += f"; nearest their limits {near}"
    judged = {one.name for one in analysis.outcomes}
    others = [name.replace("_", " ") for name in spec.specification if name not in judged]
    if others:
        text += f". Not judged here: {', '.join(others)} (malta tune {spec.path} --check)"
    if spec.sha256 != subject.controller.spec_sha256:
        text += ". The design file was changed after the gain file was written"
    yield report.Paragraph(f"{text}.\n")
