"""Several designs beside each other: what differs, and every figure of merit with the better one marked."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, NamedTuple

from rich.console import Group
from rich.text import Text

from malta.errors import InputError
from malta.merit_lists import by_identifier, find_best
from malta.merits import Merit
from malta.report.page.analysis import (
    GROUPS,
    Analysis,
    FileEntry,
    Subject,
    analyse,
    design_entries,
    display_unit,
)
from malta.report.tables import Paragraph, new_table
from malta.report.verdict import Stair, VerdictLine, staircase, verdict_lines
from malta.simulation.experiments import progress_of_part

if TYPE_CHECKING:
    from rich.table import Table

    from malta.campaigns.summary import Summary

MIN_DESIGNS, MAX_DESIGNS = 2, 8  # designs
NOTHING_TEXT = "-"  # the text of a design that has no such entry or figure
ANY_MACHINE = ("machine", "law", "gains")  # groups of entries that machines have in common
GAP = "\0"  # in the place of a signal's name


class EntryDifference(NamedTuple):
    """An entry that is not the same in all designs; None where a design does not have it."""

    group: str
    key: str
    name: str
    unit: str  # for display
    entries: tuple[FileEntry | None, ...]

    @property
    def texts(self) -> tuple[str, ...]:
        """The value of each design; a dash where there is none."""
        return tuple(NOTHING_TEXT if entry is None else entry.text(self.unit) for entry in self.entries)

    @property
    def heading(self) -> str:
        """The name with its unit in brackets."""
        return self.name if self.unit in ("", "1") else f"{self.name} [{self.unit}]"


class MeritRow(NamedTuple):
    """A figure of merit of all designs; None where a design does not have it."""

    group: str
    key: str
    heading: str
    scores: tuple[Merit | None, ...]
    best: tuple[bool, ...]  # better than some other design

    @property
    def texts(self) -> tuple[str, ...]:
        """The value of each design; a dash where there is none."""
        return tuple(NOTHING_TEXT if score is None else score.text for score in self.scores)


class TableLine(NamedTuple):
    """A line of a table of designs."""

    group: str
    heading: str
    texts: tuple[str, ...]
    best: tuple[bool, ...]


def _join_signals(lines: Iterable[tuple[TableLine, str]]) -> list[TableLine]:
    """Lines, each with its signal: those that differ in the signal alone become one, with all signals in it.

    Example: "motion x1, rms" and "motion y1, rms" of the same values become "motion x1 y1, rms".
    """
    found: list[TableLine] = []
    kept: dict[tuple[Any, ...], tuple[int, list[str]]] = {}  # form of a line -> its place, its signals
    for line, signal in lines:
        form = line._replace(heading=_without(line.heading, signal))
        if not signal or form not in kept:
            kept[form] = len(found), [signal]
            found.append(line)
            continue
        place, signals = kept[form]
        signals.append(signal)
        found[place] = line._replace(heading=form.heading.replace(GAP, " ".join(signals)))
    return found


def _without(heading: str, signal: str) -> str:
    """A heading with a gap in the place of its signal."""
    return (
        re.sub(rf"(?<!\w){re.escape(signal)}(?!\w)", lambda _: GAP, heading, count=1) if signal else heading
    )


@dataclass(frozen=True, eq=False)
class Comparison:
    """Designs beside each other."""

    names: tuple[str, ...]  # each once
    designs: tuple[Analysis, ...]

    def __repr__(self) -> str:
        return f"Comparison({', '.join(self.names)})"

    @cached_property
    def differences(self) -> tuple[EntryDifference, ...]:
        """The entries that are not the same in all designs, in the order of the first design that has them."""
        found = [{entry.key: entry for entry in design_entries(a.subject)} for a in self.designs]
        rows: list[EntryDifference] = []
        for key in dict.fromkeys(key for entries in found for key in entries):
            entries = tuple(of.get(key) for of in found)
            first = next(entry for entry in entries if entry is not None)
            if not self.one_machine and first.group not in ANY_MACHINE:
                continue
            if not all(first.equals(entry) for entry in entries):
                unit = display_unit(first.unit, [entry.value for entry in entries if entry is not None])
                rows.append(EntryDifference(first.group, key, first.name, unit, entries))
        return tuple(sorted(rows, key=lambda row: GROUPS.index(row.group)))

    @cached_property
    def rows(self) -> tuple[MeritRow, ...]:
        """The figures of merit that make sense beside each other."""
        found = [by_identifier(a.figures) for a in self.designs]
        rows = []
        for key in dict.fromkeys(key for scores in found for key in scores):
            scores = tuple(of.get(key) for of in found)
            first = next(score for score in scores if score is not None)
            known = [score for score in scores if score is not None]
            if any(score.unit != first.unit for score in known) or not self._is_shown(first):
                continue
            best = find_best(scores) if self._is_judged(first) else tuple(False for _ in scores)
            rows.append(MeritRow(first.meaning.group, key, first.heading, scores, best))
        order = list(dict.fromkeys(row.group for row in rows))
        return tuple(sorted(rows, key=lambda row: order.index(row.group)))

    @cached_property
    def verdicts(self) -> tuple[tuple[VerdictLine, ...], ...]:
        """The verdict on each design."""
        return tuple(verdict_lines(a.report, a.campaigns) for a in self.designs)

    @cached_property
    def margins(self) -> tuple[Stair, ...]:
        """The proven margin of each design; none where they count in different uncertainties, or one is not proven."""
        robust = [a.report.robust for a in self.designs]
        known = [margin.lower for margin in robust if margin is not None and margin.lower is not None]
        if len(known) < len(robust) or not self.one_box:
            return ()
        return tuple(Stair(name, lower) for name, lower in zip(self.names, known, strict=True))

    @property
    def judged_text(self) -> str:
        """In how many of the figures that the design files bound each design is better; other figures are no score."""
        judged = [
            row
            for row in self.rows
            if sum(one is not None and one.bound is not None for one in row.scores) > 1
        ]
        if not judged:
            return "No figure is bounded by the [specification] of two designs: none counts as better."
        counts = (f"{name} in {sum(row.best[k] for row in judged)}" for k, name in enumerate(self.names))
        return f"Better in the {len(judged)} figures that [specification] bounds: {', '.join(counts)}."

    @cached_property
    def one_machine(self) -> bool:
        """Whether all designs are of the same machine, whatever its parameters."""
        return len({(a.plant.name, *(s.name for s in a.plant.outputs)) for a in self.designs}) == 1

    @cached_property
    def one_box(self) -> bool:
        """Whether the margins of all designs count in the same uncertainty."""
        return self.one_machine and len({tuple(sorted(a.subject.box.items())) for a in self.designs}) == 1

    @property
    def difference_lines(self) -> list[TableLine]:
        """The differences as lines of a table: signals with the same values share one."""
        return _join_signals(
            (
                TableLine(row.group, row.heading, row.texts, (False,) * len(row.texts)),
                next(entry.signal for entry in row.entries if entry is not None),
            )
            for row in self.differences
        )

    @property
    def figure_lines(self) -> list[TableLine]:
        """The figures of merit as lines of a table: signals with the same values share one."""
        return _join_signals(
            (
                TableLine(row.group, row.heading, row.texts, row.best),
                next(score.signal for score in row.scores if score is not None),
            )
            for row in self.rows
        )

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is not compared, and why; what could not be computed."""
        found = []
        if not self.one_machine:
            machines = ", ".join(dict.fromkeys(a.plant.name for a in self.designs))
            found.append(
                f"The machines differ ({machines}): parameters, weights, single sensors, noise, loads, main job and "
                "requirements are not compared."
            )
        elif not self.one_box:
            found.append(
                "The margins of parameters count in different uncertainties; none is marked as better. "
                "--uncertain sets one for all."
            )
        for name, a in zip(self.names, self.designs, strict=True):
            found += [f"{name}: {note}" for note in a.notes]
            if not a.report.stable:
                found.append(f"{name}: the loop is UNSTABLE on its machine.")
        return tuple(found)

    def _is_shown(self, score: Merit) -> bool:
        """Whether a figure means the same in all designs, or at least something beside the others."""
        return self.one_machine or score.meaning.scope != "machine"

    def _is_judged(self, score: Merit) -> bool:
        """Whether one of the designs can be better by this figure."""
        return score.meaning.scope != "box" or self.one_box


def compare(
    subjects: Sequence[Subject],
    *,
    proof: bool = True,
    campaigns: Sequence[Sequence[Summary]] = (),
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Analyse designs and put them beside each other.

    proof : whether the margin of the parameters is proven for each
    campaigns : summaries of the campaigns of each; (): none of any
    progress : takes the share of the work that is done

    Raises InputError for fewer than MIN_DESIGNS or more than MAX_DESIGNS designs, CheckError as `analyse`.
    """

    require_count(len(subjects))
    designs = [
        analyse(
            subject,
            proof=proof,
            stages=False,
            campaigns=flown,
            progress=progress_of_part(progress, n, len(subjects)),
        )
        for n, (subject, flown) in enumerate(zip(subjects, campaigns or [()] * len(subjects), strict=True))
    ]
    return Comparison(names_of(subjects), tuple(designs))


def require_count(count: int) -> None:
    """Raise InputError for fewer than MIN_DESIGNS or more than MAX_DESIGNS designs."""
    if not MIN_DESIGNS <= count <= MAX_DESIGNS:
        raise InputError("compare", "gain files", str(count), f"{MIN_DESIGNS} to {MAX_DESIGNS}")


def names_of(subjects: Sequence[Subject]) -> tuple[str, ...]:
    """A name for each design, no name twice: where designs share a name, with what tells their files apart.

    Two files of one name differ by the folders that they are in; the same file twice is numbered.
    """
    names = [subject.controller.name for subject in subjects]
    for depth in range(1, 1 + max(len(PurePath(subject.source).parts) for subject in subjects)):
        if len(set(names)) == len(names):
            break
        names = [
            _deeper(subject, depth) if names.count(name) > 1 else name
            for subject, name in zip(subjects, names, strict=True)
        ]
    return tuple(
        f"{name} ({names[: k + 1].count(name)})" if names.count(name) > 1 else name
        for k, name in enumerate(names)
    )


def _deeper(subject: Subject, depth: int) -> str:
    """The last parts of the name of a subject's file; the design's name without a file."""
    parts = PurePath(subject.source).parts
    return "/".join(parts[-depth:]) if parts else subject.controller.name


# The tables of a comparison for a terminal: what differs, and figures of merit with the better one marked.


JOINING_SPACE = "\N{NO-BREAK SPACE}"
BEST_MARK = "*"  # behind the better value, beside bold letters
LABELS = 34  # letters of the first column; longer labels are broken into lines
NAME = 18  # letters of a design's name in a heading; longer names are broken
EDGE = 2  # letters at both ends of a line


def comparison_tables(found: Comparison, width: int = 80) -> Group:
    """What differs in the designs, and their figures of merit, in blocks of designs that fit in `width` columns."""
    parts: list[Any] = []
    verdict = [
        TableLine("", lines[0].label, _with_bars(lines, found.margins), tuple(False for _ in lines))
        for lines in zip(*found.verdicts, strict=True)
    ]
    parts += [
        _table("Verdict", found.names, verdict, columns) for columns in _blocks(found.names, verdict, width)
    ]
    parts.append(Paragraph(f"{found.judged_text}\n"))
    for title, lines in (
        ("What differs in the designs", found.difference_lines),
        (f"Figures of merit ({BEST_MARK} and bold: better)", found.figure_lines),
    ):
        for columns in _blocks(found.names, lines, width):
            parts.append(_table(title, found.names, lines, columns))
    if not found.differences:
        parts.append(Text("The designs do not differ.\n"))
    parts += [Text(remark) for remark in found.remarks]
    return Group(*parts)


def _with_bars(lines: Sequence[VerdictLine], margins: Sequence[Stair]) -> tuple[str, ...]:
    """The values of a line of all verdicts; margins behind bars of their heights, the largest a whole one."""
    bars = staircase(margins) if lines[0].label == "margin" else ""
    return tuple(
        f"{bar} {line.value}".lstrip() for bar, line in zip(bars or [""] * len(lines), lines, strict=True)
    )


def _blocks(names: Sequence[str], lines: Sequence[TableLine], width: int) -> Iterator[list[int]]:
    """Columns of designs that fit beside each other; none without lines."""
    block: list[int] = []
    room, sign = width - LABELS - EDGE, _sign_width(lines)
    for k, name in enumerate(names if lines else ()):
        needed = max(min(len(name), NAME), *(len(line.texts[k]) + sign for line in lines)) + EDGE
        if block and needed > room:
            yield block
            block, room = [], width - LABELS - EDGE
        block.append(k)
        room -= needed
    if block:
        yield block


def _sign_width(lines: Sequence[TableLine]) -> int:
    """The letters behind a value that mark it as better."""
    return len(BEST_MARK) + 1 if any(any(line.best) for line in lines) else 0


def _table(title: str, names: Sequence[str], lines: Sequence[TableLine], columns: Sequence[int]) -> Table:
    """A table of some of the designs, with a line for each group, of the lines that one of them has a value in."""
    table = new_table(title, "", *(names[k] for k in columns))
    group, blank = "", JOINING_SPACE * _sign_width(lines)
    for line in lines:
        if all(line.texts[k] == NOTHING_TEXT for k in columns):
            continue
        if line.group != group:
            if group:
                table.add_section()
            group = line.group
            table.add_row(Text(group, style="italic"))
        cells = [
            Text(f"{line.texts[k]}{JOINING_SPACE}{BEST_MARK}", style="bold")
            if line.best[k]
            else Text(line.texts[k] + blank)
            for k in columns
        ]
        table.add_row(Text(line.heading), *cells)
    return table
