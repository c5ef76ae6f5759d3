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
from malta.margins.outcome import Outcome, join_signals
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
from malta.report.verdict import SHOWN_FAILURES, Stair, VerdictLine, staircase, verdict_lines
from malta.simulation.experiments import progress_of_part
from malta.units import distinct
from malta.work import share_time

if TYPE_CHECKING:
    from rich.table import Table

    from malta.campaigns.summary import Summary
    from malta.synthesis.spec import Spec

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
    spec: Spec | None = None  # whose [specification] judges all of them; None: each is judged by its own

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

    @cached_property
    def reference(self) -> int:
        """The design that the others are better or worse than: the one whose file judges all of them, or the first."""
        own = [a.subject.spec is not None and a.subject.spec is self.spec for a in self.designs]
        return own.index(True) if any(own) else 0

    @cached_property
    def standings(self) -> tuple[VerdictLine, ...]:
        """Whether each design is better or worse than the reference by its requirements, and where; () without them."""
        if self.spec is None:
            return ()
        first = self.designs[self.reference].report.requirements
        title = f"the reference, {_count_held(first)} of {self.spec.path.name}"
        lines = []
        for k, (name, a) in enumerate(zip(self.names, self.designs, strict=True)):
            own = a.report.requirements
            state = "good" if all(one.holds for one in own) else "bad"
            if k == self.reference:
                lines.append(VerdictLine(name, title, _failures(own), state))
            else:
                word, where = compare_outcomes(own, first)
                note = "; ".join(filter(None, (_count_held(own), _failures(own), where)))
                lines.append(VerdictLine(name, f"{word} {self.names[self.reference]}", note, state))
        return tuple(lines)

    @property
    def judged_text(self) -> str:
        """Why no design is better or worse than another; "" where `standings` say which is."""
        if self.spec is not None:
            return ""
        if not self.one_machine:
            return "No [specification] judges machines that differ: none counts as better, and no figure is marked."
        return "No [specification] judges all designs: none counts as better as a whole. --specification names one."

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
    def is_marked(self) -> bool:
        """Whether a figure of some design is better than another's."""
        return any(any(row.best) for row in self.rows)

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
        return self.one_machine and (score.meaning.scope != "box" or self.one_box)


def compare_outcomes(own: Sequence[Outcome], other: Sequence[Outcome]) -> tuple[str, str]:
    """Compare two designs by the same requirements: a verdict on the first, and where it is better and worse.

    Better is a design that holds what the other holds and more; of two that hold the same, one that is nearer to no
    limit and further from some.

    >>> tight, loose = (Outcome("motion x", 1e-6, found, "m", "") for found in (0.9e-6, 0.8e-6))
    >>> compare_outcomes([tight], [loose])
    ('worse than', 'worse in motion x')
    """
    theirs = dict(zip(distinct(one.name for one in other), other, strict=True))
    named = zip(distinct(one.name for one in own), own, strict=True)
    pairs = [(one, theirs.get(key)) for key, one in named if one.asked is not None]
    pairs = [(one, two) for one, two in pairs if two is not None and one.found_text != two.found_text]
    better = [one for one, two in pairs if two is not None and one.ratio < two.ratio]
    worse = [one for one, two in pairs if two is not None and one.ratio > two.ratio]
    more, less = (
        {one.name for one in side if one.asked is not None and not one.holds} for side in (other, own)
    )
    if more == less:
        more, less = {one.name for one in better}, {one.name for one in worse}
    words = {(True, False): "better than", (False, True): "worse than", (False, False): "as good as"}
    where = [
        f"{word} in {', '.join(join_signals(dict.fromkeys(one.name for one in side)))}"
        for word, side in (("better", better), ("worse", worse))
        if side
    ]
    return words.get((bool(more - less), bool(less - more)), "neither better nor worse than"), "; ".join(
        where
    )


def _count_held(outcomes: Sequence[Outcome]) -> str:
    asked = [one for one in outcomes if one.asked is not None]
    kept = sum(one.holds for one in asked)
    return (
        f"holds all {kept} requirements"
        if kept == len(asked)
        else f"holds {kept} of {len(asked)} requirements"
    )


def _failures(outcomes: Sequence[Outcome]) -> str:
    """What a design misses, the worst first, with its figures."""
    missed = sorted(
        (one for one in outcomes if one.asked is not None and not one.holds), key=lambda one: -one.ratio
    )
    texts = [f"{one.words} {one.found_text}, asked {one.asked_text}" for one in missed[:SHOWN_FAILURES]]
    more = [f"{len(missed) - len(texts)} more"] if len(missed) > len(texts) else []
    return f"misses {'; '.join((*texts, *more))}" if texts else ""


def judging_spec(subjects: Sequence[Subject], named: Spec | None = None) -> Spec | None:
    """The design whose [specification] judges all of some designs: the named one, else the first of their own.

    None where they are of different machines. Raises InputError for a named one of another machine, or without.
    """
    machines = {(plant.name, *(s.name for s in plant.outputs)) for plant in (one.plant for one in subjects)}
    if named is not None:
        own = (named.plant.name, *(s.name for s in named.plant.outputs))
        if machines != {own}:
            raise InputError("--specification", "machine", named.plant.name, "that of all gain files")
        if not named.specification:
            raise InputError(named.path, "specification", "nothing", "what the designs shall reach")
        return named
    asking = (one.spec for one in subjects if one.spec is not None and one.spec.specification)
    return next(asking, None) if len(machines) == 1 else None


def compare(
    subjects: Sequence[Subject],
    *,
    proof: bool = True,
    spec: Spec | None = None,
    campaigns: Sequence[Sequence[Summary]] = (),
    progress: Callable[[float], None] | None = None,
) -> Comparison:
    """Analyse designs and put them beside each other.

    proof : whether the margin of the parameters is proven for each
    spec : whose [specification] judges all of them; None: of the first that has one
    campaigns : summaries of the campaigns of each; (): none of any
    progress : takes the share of the work that is done

    Raises InputError for fewer than MIN_DESIGNS or more than MAX_DESIGNS designs, CheckError as `analyse`.
    """

    require_count(len(subjects))
    spec = judging_spec(subjects, spec)
    designs, count = list[Analysis](), len(subjects)
    for n, (subject, flown) in enumerate(zip(subjects, campaigns or [()] * count, strict=True)):
        with share_time(1 / (count - n)):
            part = progress_of_part(progress, n, count)
            designs.append(
                analyse(subject, proof=proof, stages=False, spec=spec, campaigns=flown, progress=part)
            )
    return Comparison(names_of(subjects), tuple(designs), spec)


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
    parts: list[Any] = [
        Paragraph(f"{one.label}: {one.value}; {one.note}".rstrip("; ") + ".\n") for one in found.standings
    ]
    verdict = [
        TableLine("", lines[0].label, _with_bars(lines, found.margins), tuple(False for _ in lines))
        for lines in zip(*found.verdicts, strict=True)
    ]
    parts += [
        _table("Verdict", found.names, verdict, columns) for columns in _blocks(found.names, verdict, width)
    ]
    if found.judged_text:
        parts.append(Paragraph(f"{found.judged_text}\n"))
    marks = f" ({BEST_MARK} and bold: better)" if found.is_marked else ""
    for title, lines in (
        ("What differs in the designs", found.difference_lines),
        (f"Figures of merit{marks}", found.figure_lines),
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
