"""`malta check`: the proof in a certificate, checked without the code that found it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from malta.cli.inputs import read_controller
from malta.cli.options import AsJson, MachineFile
from malta.cli.output import make_console, print_document, print_line, print_note, working

if TYPE_CHECKING:
    from malta.margins.windings import CurrentLoops
    from malta.synthesis.controller import Controller


def check(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A certificate that verify wrote.")],
    gains: Annotated[
        Path | None,
        typer.Option(metavar="GAINS", help="The gain file that it has to be of, to the last digit."),
    ] = None,
    machine: MachineFile = None,
    as_json: AsJson = False,
) -> None:
    """Check the proof of a margin, in arithmetic with rigorous bounds and without the code that found it.

    \b
    Example:  malta check build/table2.json --gains design/gains/table2.json
    """
    from malta.margins.check import check as check_certificate

    with working(f"checking {file}"):
        verdict = check_certificate(file, gains)
        failures = list(verdict.failures)
        if gains is not None and not failures and not _matches_gains(file, read_controller(gains, machine)):
            failures.append(f"the loops are not those of {gains}")
    if as_json:
        from malta.cli.documents.others import CheckOutput

        groups, claim = list(verdict.groups), verdict.claim
        print_document(
            CheckOutput(file=str(file), holds=not failures, lower=claim, groups=groups, failures=failures)
        )
    else:
        console = make_console()
        for line in verdict.groups:
            print_line(console, line)
        holds = "does not hold" if failures else "holds"
        share, loops = f"{100 * verdict.claim:.3f} %", _count_loops(file)
        where = "" if loops == 1 else f" at each of {loops} places, not between them"
        print_line(console, f"{file}: stable in {share} of the uncertainty{where}: {holds}")
        for line in failures:
            print_note(f"{file}: {line}")
    raise typer.Exit(1 if failures else 0)


def _count_loops(certificate: Path) -> int:
    """The loops that a certificate is about: one, or the same machine at several places of its travel."""
    from malta.margins import checked_file

    return len(checked_file.content_of(certificate)["loops"])


def _matches_gains(certificate: Path, controller: Controller) -> bool:
    """Whether a certificate's loops are those of a gain file, with either kind of current loops."""
    from malta.margins import checked_file
    from malta.margins.certificate import matches
    from malta.margins.travel import travel_loops
    from malta.model.data import plant_of

    plant = plant_of(controller.parameters)
    parameters = (entry["name"] for entry in checked_file.content_of(certificate)["parameters"])
    names = tuple(name for name in parameters if name != plant.stroke)
    kinds: tuple[CurrentLoops, ...] = ("lag", "pi") if controller.current_loop is not None else ("lag",)
    return any(matches(certificate, travel_loops(plant, controller, names, kind)[0]) for kind in kinds)
