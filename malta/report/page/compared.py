"""The page of a comparison: the same tables as in a terminal, and the curves of all designs over each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

from malta.report.page.document import Front, Page, render
from malta.report.page.headline import KeyFigure
from malta.report.page.overlay import overlaid
from malta.report.page.sections import Item, Section
from malta.report.page.sheets import Sheet, polish

if TYPE_CHECKING:
    from malta.report.page.comparison import Comparison, Line

SIGN = "★"  # before the better value, beside bold letters


def comparison_page(found: Comparison, progress: Callable[[float], None] | None = None) -> Page:
    """Write a comparison as one page in HTML that needs no network and no other file.

    progress : takes the share of the figures that are drawn
    """
    machines = ", ".join(dict.fromkeys(a.plant.name for a in found.designs))
    front = Front(
        "Comparison of designs",
        " · ".join(found.names),
        f"Machine {machines}",
        _heads(found),
        "malta compare",
    )
    sections = (
        Section("differences", "What differs in the designs", tuple(_differences(found))),
        Section("figures", "Figures of merit", tuple(_figures(found))),
        Section("curves", "Curves", tuple(overlaid(found))),
    )
    return render(front, [section for section in sections if section.items], progress)


def _heads(found: Comparison) -> list[KeyFigure]:
    """One figure for each design: whether it is stable, its margin, and in how many rows it is better."""
    heads = []
    for k, (name, a) in enumerate(zip(found.names, found.designs, strict=True)):
        better = sum(row.best[k] for row in found.rows)
        margin = a.report.robust
        proven = (
            f"margin {100 * margin.lower:.1f} %, " if margin is not None and margin.lower is not None else ""
        )
        stable = "stable" if a.report.stable else "UNSTABLE"
        note = f"{proven}better in {better} of {len(found.rows)} figures"
        heads.append(KeyFigure(name, stable, note, "good" if a.report.stable else "bad"))
    return heads


def _differences(found: Comparison) -> Iterator[Item]:
    if not found.differences:
        yield "The designs do not differ."
        return
    yield _sheet(found.names, found.difference_lines)


def _figures(found: Comparison) -> Iterator[Item]:
    yield f"{SIGN} and bold: better than another design, in digits that are shown. Ties are not marked."
    yield _sheet(found.names, found.figure_lines)
    yield from found.remarks


def _sheet(names: Sequence[str], lines: Sequence[Line]) -> Sheet:
    """A table with a heading line for each group."""
    rows: list[tuple[str, ...]] = []
    marks: list[tuple[str, ...]] = []
    group = ""
    for own, heading, texts, best in lines:
        if own != group:
            group = own
            rows.append((own.capitalize(),))
            marks.append(("",))
        cells = (f"{SIGN} {text}" if star else text for text, star in zip(texts, best, strict=True))
        rows.append((polish(heading), *map(polish, cells)))
        marks.append(("", *("best" if star else "" for star in best)))
    return Sheet("", ("", *names), tuple(rows), (False, *(True for _ in names)), tuple(marks))
