"""The page of a commissioning for the lab's binder: steps, findings with limits, logs, signature."""

from __future__ import annotations

from typing import TYPE_CHECKING

from malta.report.page.analysis import KeyFigure
from malta.report.page.document import Front, Page, render
from malta.report.page.sections import Section, plain_sheet
from malta.report.tables.experiments import finding_cells

if TYPE_CHECKING:
    from malta.identification.commission import Commissioning, Entry


def binder_page(done: Commissioning) -> Page:
    """Write a commissioning as one page in HTML that needs no network and no other file, with a place to sign."""
    passed = sum(entry.passed for entry in done.entries)
    state = "good" if done.passed else "bad"
    heads = [
        KeyFigure("steps passed", f"{passed} of {len(done.steps)}", "", state),
        KeyFigure("signature", done.signature[:16], "sha256 of the gain file, logs and results"),
    ]
    front = Front("Commissioning", done.gains, f"Machine {done.machine}", heads, "malta commission")
    return render(front, [*map(_section, done.entries), _signed(done)])


def _section(entry: Entry) -> Section:
    """A step: its question, its findings, and why it was refused."""
    state = "passed" if entry.passed else "FAILED"
    items = [] if not entry.refusal else [entry.refusal]
    sheet = plain_sheet(
        "", ("finding", "found", "95 %", "limits", ""), [finding_cells(one) for one in entry.findings]
    )
    return Section(entry.name, f"{entry.question} {state}", (*items, *([sheet] if entry.findings else [])))


def _signed(done: Commissioning) -> Section:
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
    left = done.steps[len(done.entries) :]
    lines += [f"not gone: {' '.join(left)}"] if left else []
    return "\n".join([*lines, "", f"signature {done.signature}", "", "Date, name:", "Witness:", ""])
