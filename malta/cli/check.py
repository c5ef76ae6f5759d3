"""`malta check`: the proof in a certificate, checked without the code that found it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.assignments import read_uncertainty
from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, MachineFile, Uncertain
from malta.cli.output import make_console, print_document, print_line, print_note, print_text, working
from malta.errors import InputError, shorten

if TYPE_CHECKING:
    from malta.cli.documents.others import CheckOutput
    from malta.proof.certificate.check import Verdict


def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A certificate that verify wrote.")],
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
    from malta.proof.certificate.check import check as check_certificate

    with working(f"checking {file}"):
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
    from malta.model.data import plant_of
    from malta.model.published import published_figures

    controller = read_controller(gains, machine)
    if not uncertain:
        return None
    plant = plant_of(controller.parameters)
    return read_uncertainty(gains, uncertain, plant.parameters, published_figures(plant.name))


def _print(file: Path, gains: Path | None, verdict: Verdict) -> None:
    """Print what is claimed, of what and where, and whether it holds."""
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
    print_line(console, f"{file}: stable in {share}{where}: {holds}")
    for line in verdict.failures:
        print_note(shorten(f"{file}: {line}"))


def _document(file: Path, verdict: Verdict) -> CheckOutput:
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
