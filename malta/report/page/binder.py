"""The page of a commissioning for the lab's binder: steps, findings with limits, what was logged, signature."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from malta.errors import CheckError, InputError
from malta.identification.log_files import read_log
from malta.report.page.analysis import KeyFigure
from malta.report.page.bench import log_items
from malta.report.page.document import Front, Page, render
from malta.report.page.sections import Item, Section, plain_sheet
from malta.report.tables.experiments import finding_cells

if TYPE_CHECKING:
    from malta.identification.commission import Commissioning, JournalEntry
    from malta.synthesis.controller import Controller


def binder_page(done: Commissioning, pictures: Mapping[str, Sequence[Item]] | None = None) -> Page:
    """Write a commissioning as one page in HTML that needs no network and no other file, with a place to sign.

    pictures : by step, of `step_pictures`; None: tables alone
    """
    passed = sum(entry.passed for entry in done.entries)
    state, sign = "good" if done.passed else "bad", done.signature
    heads = [
        KeyFigure("steps passed", f"{passed} of {len(done.steps)}", "", state),
        KeyFigure("signature", f"{sign[:8]} {sign[8:16]}", "sha256 of the gain file, logs and results"),
    ]
    front = Front("Commissioning", done.gains, f"Machine {done.machine}", heads, "malta commission")
    return render(
        front,
        [*(_section(e, (pictures or {}).get(e.name, ())) for e in done.entries), _signature_section(done)],
    )


def step_pictures(
    done: Commissioning,
    controller: Controller,
    box: Mapping[str, float],
    reading: Mapping[str, Any] | None = None,
) -> dict[str, list[Item]]:
    """What each step logged, and of an excited loop S as measured and what identification explains.

    controller : under which the logs were recorded
    box : the uncertainty of its gain file, of which measured curves have a tube
    reading : arguments of `read_log`, where other programs wrote the logs

    Returns items by step. A log that is no longer there, or that is refused, has none.
    """
    found: dict[str, list[Item]] = {}
    for entry in done.entries:
        try:
            if entry.sha256 and Path(entry.log).exists():
                found[entry.name] = [*log_items(controller, read_log(entry.log, **(reading or {})), box)]
        except (InputError, CheckError):
            continue
    return found


def _section(entry: JournalEntry, pictures: Sequence[Item]) -> Section:
    """A step: its question, its findings, why it was refused, and what it logged."""
    state = "passed" if entry.passed else "FAILED"
    items = [] if not entry.refusal else [entry.refusal]
    sheet = plain_sheet(
        "", ("finding", "found", "95 %", "limits", ""), [finding_cells(one) for one in entry.findings]
    )
    return Section(
        entry.name, f"{entry.question} {state}", (*items, *([sheet] if entry.findings else []), *pictures)
    )


def _signature_section(done: Commissioning) -> Section:
    """The files with their sha256, the signature, and lines for names."""
    rows = [(done.gains, done.sha256), *((e.log, e.sha256) for e in done.entries if e.sha256)]
    lines = ("Date, name: ______________________________", "Witness: ______________________________")
    sheet = plain_sheet("Files", ("file", "sha256"), rows)
    return Section("signature", "Signature", (sheet, f"Signature {done.signature}", *lines))


def binder_text(done: Commissioning) -> str:
    """The same as plain text."""
    lines = [f"Commissioning of a {done.machine}, gain file {done.gains}", f"sha256 {done.sha256}", ""]
    for entry in done.entries:
        lines.append(f"{entry.name}: {entry.question} {'passed' if entry.passed else 'FAILED'}")
        lines += [f"    {entry.refusal}"] if entry.refusal else []
        for one in entry.findings:
            name, found, half, limits, word = finding_cells(one)
            lines.append(
                f"    {name}: {found} +- {half}{'' if not limits else f', {limits}'} {word}".rstrip()
            )
        lines += [f"    {entry.log} sha256 {entry.sha256}"] if entry.sha256 else []
    lines += [f"not gone: {' '.join(done.left)}"] if done.left else []
    return "\n".join([*lines, "", f"signature {done.signature}", "", "Date, name:", "Witness:", ""])
