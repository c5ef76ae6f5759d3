"""`malta verify`: the margins of a gain file, with their proofs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from malta.cli.options import (
    AsJson,
    Changes,
    DesignFile,
    GainFile,
    MachineFile,
    Uncertain,
    WholeTime,
    change_machine,
    find_design,
    offer,
    read_controller,
    read_uncertainty,
)
from malta.cli.output import (
    make_console,
    print_document,
    print_line,
    print_note,
    print_text,
    print_written,
    progress_on,
    require_whole,
    work_until,
)
from malta.errors import CheckError, InputError, shorten

if TYPE_CHECKING:
    from malta.campaigns.summary import Summary
    from malta.checker.check import CertificateVerdict
    from malta.cli.documents.others import CheckOutput
    from malta.identification.data_file import IdentifiedData
    from malta.loops.windings import CurrentLoops
    from malta.margins.loop_report import LoopReport
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec


TRAVEL_SHARE = 0.5  # of the time, for the margin over the travel


def verify(
    gains: GainFile,
    change: Changes = None,
    uncertain: Uncertain = None,
    current_loops: Annotated[
        str,
        typer.Option(
            metavar="WORD",
            autocompletion=offer("pi", "lag"),
            help="Current loops of the last stage: pi (controllers on the windings), or lag (first order).",
        ),
    ] = "pi",
    time: WholeTime = None,
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
        Path | None,
        typer.Option(metavar="CERTIFICATE", help="Write the proof of the margin, for `malta check`."),
    ] = None,
    renew: Annotated[
        Path | None, typer.Option(metavar="CERTIFICATE", help="Prove an older certificate anew.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Folder for the figures (.png).")] = None,
    design: DesignFile = None,
    identified: Annotated[
        Path | None,
        typer.Option(
            metavar="DATA",
            help="A data file of malta identify: its machine, its 95 % intervals as the uncertainty.",
        ),
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Verify a gain file on the machine, stage by stage.

    Poles, bandwidths by definition, peak sensitivities with their ISO 14839-3 zones; real parametric margins with
    their proof, from full state feedback to the sampled loop, and over the travel; disk and delay margins, gang of
    four, tolerance of each parameter; what a constant load of 1 N or 1 N m does; the payload that is held and carried
    in flight. Last, what the design file asks for, but for what has to be flown.

    The machine is the one in the file, with the changes given by --set, as far as they shape the linear loop (on MALTA
    also windings and DC link; the current controllers are those of the gain file). What it leaves out is said.

    \b
    Example:  malta verify design/gains/calibrated.json --set m=0.56
    """
    from malta.cli.report import campaigns_of
    from malta.gains.writing import require_stable
    from malta.model.plants import plant_of
    from malta.model.printed import published_figures
    from malta.tuning.verify import verify as verify_loop

    controller = read_controller(gains, machine)
    measured = None if identified is None else _read_identified(identified, controller, change, uncertain)
    parameters = controller.parameters if measured is None else measured.parameters
    plant = plant_of(change_machine(parameters, change))
    published = published_figures(plant.name)
    box = measured.shares if measured else read_uncertainty(gains, uncertain, plant.parameters)
    certificate = _certificate_of(certificate, renew)
    if certificate is not None and no_proof:
        raise InputError("--certificate", "", "--no-proof", "one of them")
    spec = find_design(gains, controller, design)
    refusal: InputError | CheckError | None = None  # that comes after the tables
    try:
        with work_until("margins", time) as work:
            found = verify_loop(
                plant, controller, box, stages=True, spec=spec, current_loops=cast("CurrentLoops", current_loops),
                proof=not no_proof, worst_case=worst_case, time=None if time is None else TRAVEL_SHARE * time,
                progress=work.report, bounds=work.bound,
            )  # fmt: skip
            if measured is not None and not no_proof:
                work.step("unmodelled dynamics")
                found, refusal = _with_unmodelled(found, measured, identified, time)
    except CheckError as error:
        raise CheckError(f"{gains}: {error}") from error
    for note in found.notes:
        print_note(note)
    files: list[Path] = []
    if certificate is not None:
        try:
            files.append(_write_certificate(certificate, gains, found))
        except (InputError, CheckError) as error:
            refusal = error
    if out is not None:
        files += _draw(found, out)
    if as_json:
        from malta.cli.documents.loops import verify_output

        print_document(verify_output(gains, found, files))
    else:
        flown = campaigns_of(None, controller, spec, changed=bool(change or measured))
        _print_tables(gains, found, spec, published, change or (), campaigns=flown)
        print_written(make_console(), files)
    require_whole(work)
    require_stable(found, str(gains))
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
    if data.unmodelled is None:
        print_note(
            f"{path}: no bound of unmodelled dynamics in it: what its log leaves is no part of the proof; malta "
            "identify writes one, of a log with an excitation"
        )
    joint = 100 * data.joint
    print_note(
        f"{path}: margins count in 95 % intervals; all parameters together are within {joint:.0f} % of them"
    )
    return data


def _with_unmodelled(
    found: LoopReport, data: IdentifiedData, path: Path | None, time: float | None
) -> tuple[LoopReport, CheckError | None]:
    """The report with the margin that covers what the log left, or why there is none."""
    from dataclasses import replace

    from malta.identification.unmodelled import margin_with_left

    left, loops = data.unmodelled, found.current_loops
    if left is None:
        return found, None
    longest = None if time is None else (1 - TRAVEL_SHARE) * time
    try:
        whole = margin_with_left(
            found.plant, found.controller, data.shares, left, data.joint, loops, time=longest
        )
    except CheckError as error:
        return found, CheckError(f"{path}: {error}")
    return replace(found, unmodelled=whole), None


def _certificate_of(certificate: Path | None, renew: Path | None) -> Path | None:
    """Where the certificate goes. Raises InputError for one to renew that is none, and for two places."""
    if renew is None:
        return certificate
    if certificate is not None:
        raise InputError("--renew", "", "--certificate too", "one of them")
    from malta.checker.file import json_of
    from malta.proof.certificate import refused_as_input

    with refused_as_input():
        json_of(renew)
    return renew


def _write_certificate(path: Path, gains: Path, found: LoopReport) -> Path:
    """Write the certificate of the margin over the travel."""
    from malta.gains.certified import origin_of
    from malta.margins.travel import travel_loops
    from malta.proof.certificate import write_certificate

    plant, controller, box, stage = found.plant, found.controller, found.uncertainty, found.current_loops
    places, over = travel_loops(plant, controller, tuple(box), stage)
    origin = origin_of(gains, plant, controller, stage, len(places))
    return write_certificate(path, places, box, over, found.travel, origin)


def _draw(found: LoopReport, folder: Path) -> list[Path]:
    """Draw the margins stage by stage and over the travel, and how loads are carried where there are any."""
    from malta import report

    files = [folder / f"{found.controller.name}_margins.png"]
    report.chain_figure(found, files[0])
    if found.recovery:
        files.append(folder / f"{found.controller.name}_loads.png")
        report.recovery_figure(found.plant, found.controller, found.recovery, files[-1])
    return files


def _print_tables(
    gains: Path,
    found: LoopReport,
    spec: Spec | None,
    published: Mapping[str, Any] | None,
    changes: Sequence[str],
    *,
    campaigns: Sequence[Summary],
) -> None:
    """Print the tables of a verification; poles of a changed machine stand beside no published ones."""
    from malta import report

    controller, console = found.controller, make_console()
    preset = f"{controller.parameters.preset} {' '.join(changes)}".rstrip()
    verdict = report.verdict_text(found, campaigns)
    print_text(console, f"{gains}: {controller.name}, {found.plant.name}, preset {preset}")
    console.print(verdict, "\n")
    console.print(report.poles_table(found.model, None if changes else published))
    for table in report.loop_tables(found, published, spec):
        console.print(table)
    console.print(verdict)


# `malta check`: the proof in a certificate, checked without the code that found it.


def check(
    file: Annotated[Path, typer.Argument(metavar="CERTIFICATE", help="A certificate that verify wrote.")],
    gains: Annotated[
        Path | None,
        typer.Option(metavar="GAINS", help="The gain file that it has to be of: loops, box and travel."),
    ] = None,
    uncertain: Uncertain = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Check the proof of a margin, in arithmetic with rigorous bounds and without the code that found it.

    With --gains, loops, uncertainty and travel are made anew from the gain file; a certificate that claims less, or
    something else, does not hold. Without it they are the certificate's own.

    \b
    Example:  malta check build/table2.json --gains design/gains/table2.json
    """
    from malta.gains.certified import check as check_certificate

    with progress_on(f"checking {file}"):
        box = None if gains is None else _box_of(gains, uncertain, machine)
        if gains is None and uncertain:
            raise InputError("--uncertain", "", "no gain file", "--gains GAINS, whose uncertainty it is")
        verdict = check_certificate(file, gains, uncertain=box)
    if as_json:
        print_document(_document(file, verdict))
    else:
        _print(file, gains, verdict)
    raise typer.Exit(0 if verdict.ok else 1)


def _box_of(gains: Path, uncertain: list[str] | None, machine: Path | None) -> dict[str, float] | None:
    """The uncertainty that was asked for; None: that of the gain file. It makes the machine's module known."""
    controller = read_controller(gains, machine)
    return read_uncertainty(gains, uncertain, controller.parameters) if uncertain else None


def _print(file: Path, gains: Path | None, verdict: CertificateVerdict) -> None:
    """Print what is claimed, of what and where, and whether it holds."""
    from malta.report.tables import COLOURS
    from malta.report.tables.certificate import claim_share, claim_table, claim_text

    console, stated = make_console(), verdict.stated
    print_text(console, f"{claim_text(stated)}\n")
    console.print(claim_table(stated))
    for line in verdict.groups:
        print_line(console, line)
    places = stated.places
    where = "" if places is None else f" at each of {len(places.at)} places, not between them"
    holds = "holds" if verdict.ok else "does not hold"
    share = f"{claim_share(stated)} of the uncertainty"
    if gains is None:
        share += ", in the certificate's own box above, compared with no gain file"
    print_line(
        console, f"{file}: stable in {share}{where}: {holds}", COLOURS["holds" if verdict.ok else "fails"]
    )
    for line in verdict.failures:
        print_note(shorten(f"{file}: {line}"))


def _document(file: Path, verdict: CertificateVerdict) -> CheckOutput:
    """The JSON document of a check."""
    from malta.cli.documents.others import CheckOutput, certified_part

    return CheckOutput(
        file=str(file),
        holds=verdict.ok,
        lower=verdict.claim,
        compared=verdict.compared,
        claim=certified_part(verdict.stated),
        groups=list(verdict.groups),
        failures=list(verdict.failures),
    )
