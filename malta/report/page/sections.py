"""The sections of a report: what stands in each, as tables, figures and sentences."""

from __future__ import annotations

import platform
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from malta.arrays import FloatArray
from malta.files import version
from malta.loops.noise import budget_of
from malta.merits import four_digits
from malta.model.currents import is_commutated
from malta.model.plant import Signal
from malta.model.printed import published_figures
from malta.report.figures.drawing import micro
from malta.report.page.analysis import Analysis, design_entries, display_unit, summary_sentences
from malta.report.tables.campaign import box_text, campaign_tables, run_text
from malta.report.tables.design import (
    bandwidth_table,
    loop_poles_table,
    poles_table,
    recovery_table,
    sensitivity_table,
)
from malta.report.tables.experiments import experiment_table, limits_text
from malta.report.tables.margins import (
    DISKS,
    chain_table,
    disk_rows,
    disk_table,
    gang_table,
    open_bounds,
    places_table,
    tolerance_table,
    worst_case_table,
)
from malta.synthesis.curve_limits import curve_limits
from malta.units import FINE_UNITS, in_unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from malta.loops.classical import Classical
    from malta.loops.curves import LoopCurves
    from malta.margins.loop_report import LoopReport
    from malta.margins.outcome import Outcome


# Which channels of a loop need a panel of their own: mirror images have the same curves.


CURVE_TOLERANCE = 1e-3  # relative difference of curves that a plot does not show
SAME_POLE = 0.02  # of the fastest pole: difference that a map does not show


class Panels(NamedTuple):
    """The channels to draw, and a sentence on those that have the curves of others; it begins with a space."""

    channels: tuple[str, ...]
    note: str


def distinct_channels(loops: Mapping[str, LoopCurves]) -> Panels:
    """Choose the channels at the sensors whose curves differ in some loop from those of the channels before them."""
    names = dict.fromkeys(s.name for curves in loops.values() for s in curves.channels())
    like: dict[str, list[str]] = {}
    for name in names:
        twin = next((other for other in like if _are_alike(loops, name, other)), None)
        like.setdefault(name if twin is None else twin, []).append(name)
    notes = []
    for name, (_, *others) in like.items():
        if others:
            listed = others[0] if len(others) == 1 else f"{', '.join(others[:-1])} and {others[-1]}"
            notes.append(f"{listed} {'has' if len(others) == 1 else 'have'} the curves of {name}")
    return Panels(tuple(like), f" {'; '.join(notes)}." if notes else "")


def _are_alike(loops: Mapping[str, LoopCurves], one: str, other: str) -> bool:
    """Whether two channels have the same curves in every loop."""
    for curves in loops.values():
        known = [s.name for s in curves.channels()]
        if one not in known or other not in known:
            return False
        alone = curves.responses.alone("sensors")
        a, b = alone[:, known.index(one)], alone[:, known.index(other)]
        if not np.allclose(a, b, rtol=CURVE_TOLERANCE, atol=0.0, equal_nan=True):
            return False
    return True


# Tables of a page, from the same tables that the terminal shows.


MATRIX_COLUMNS = 8  # columns of a matrix beside each other


@dataclass(frozen=True)
class PageTable:
    """A table of a page: cells as text, and for each column whether it is aligned to the right."""

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    right: tuple[bool, ...]
    # by row and column, of a cell that stands out: "good", "near", "bad" or "best"
    marks: tuple[tuple[str, ...], ...] = ()

    def mark(self, row: int, column: int) -> str:
        """The mark of a cell; "" for none."""
        return self.marks[row][column] if self.marks else ""


def sheets_of(parts: Any) -> list[PageTable]:
    """The tables in what a terminal would print, in its order; texts between them become tables without rows."""
    if isinstance(parts, Table):
        return [_sheet(parts)]
    if isinstance(parts, Group):
        return [sheet for part in parts.renderables for sheet in sheets_of(part)]
    if isinstance(parts, str | Text):
        return [PageTable(polish(str(parts)), (), (), ())] if str(parts).strip() else []
    return [sheet for part in parts for sheet in sheets_of(part)] if isinstance(parts, Iterable) else []


def _sheet(table: Table) -> PageTable:
    columns = [[polish(_text(cell)) for cell in column.cells] for column in table.columns]
    return PageTable(
        polish(_text(table.title or "")),
        tuple(polish(_text(column.header)) for column in table.columns),
        tuple(zip(*columns, strict=True)),
        tuple(column.justify == "right" for column in table.columns),
    )


def _text(cell: Any) -> str:
    return cell.plain if isinstance(cell, Text) else str(cell)


def polish(text: str) -> str:
    """A text of a terminal with the signs that a page has: ±, ≤, µm, minus.

    >>> polish("-3745+-3096j <= 1 um")
    '−3745±3096j ≤ 1 µm'
    """
    text = text.replace("+-", "±").replace("<=", "≤").replace(">=", "≥")
    return micro(re.sub(r"(?<![\w.])-(?=\d)", "−", text))


def plain_sheet(title: str, heads: Sequence[str], rows: Iterable[Sequence[str]]) -> PageTable:
    """A table whose first column is of words, the others of numbers."""
    return PageTable(
        polish(title),
        tuple(map(polish, heads)),
        tuple(tuple(map(polish, row)) for row in rows),
        (False, *(True for _ in heads[1:])),
    )


def matrix_sheets(
    title: str, M: FloatArray, rows: Sequence[Signal], columns: Sequence[Signal]
) -> Iterator[PageTable]:
    """A matrix with the names and units of its rows and columns, in parts that a sheet of paper has room for."""
    for first in range(0, len(columns), MATRIX_COLUMNS):
        part = columns[first : first + MATRIX_COLUMNS]
        heads = ["", *(_name(s) for s in part)]
        values = M[:, first : first + MATRIX_COLUMNS].tolist()
        cells = ([_name(s), *(_entry(value) for value in row)] for s, row in zip(rows, values, strict=True))
        more = "" if len(part) == len(columns) else f", columns {first + 1} to {first + len(part)}"
        yield plain_sheet(f"{title}{more}", heads, cells)


def _name(signal: Signal) -> str:
    return signal.name if signal.unit == "1" else f"{signal.name} [{signal.unit}]"


def _entry(value: float) -> str:
    return f"{value:.6g}" if value else "0"


TABLE_COLUMNS = 3  # columns of a table
RANKS = {"fails": 0, "undecided": 1, "holds": 2}
NEAR_BOUND_SHARE = 0.95  # of a bound: a requirement holds, but hardly


@dataclass(frozen=True, eq=False)
class Illustration:
    """A figure of a page: what draws it, and its caption."""

    draw: Callable[[], Figure]
    caption: str


@dataclass(frozen=True)
class Folded:
    """Tables that a reader opens."""

    summary: str
    sheets: tuple[PageTable, ...]

    @property
    def narrow(self) -> bool:
        """Whether the tables have room beside each other."""
        return all(len(sheet.heads) <= TABLE_COLUMNS for sheet in self.sheets)


Item = PageTable | Illustration | Folded | str  # a string is a paragraph


@dataclass(frozen=True)
class Section:
    """A section of a page with its anchor."""

    anchor: str
    title: str
    items: Sequence[Item] = field(default_factory=tuple)


def report_sections(a: Analysis) -> list[Section]:
    """List the sections of a report that have content."""
    parts = (
        ("design", "The design", _design),
        ("requirements", "Requirements", _requirements),
        ("poles", "Poles", _poles),
        ("margins", "Margins, and where they go", _margins),
        ("loop", "The loop over frequency", _loop),
        ("loads", "Loads from outside", _loads),
        ("job", _job_title(a), _job),
        ("noise", "Noise at rest", _noise),
        ("campaign", "Campaigns", _campaigns),
        ("gains", "Gains", _gains),
        ("provenance", "Provenance", _provenance),
    )
    sections = [Section(anchor, title, tuple(build(a))) for anchor, title, build in parts]
    return [section for section in sections if section.items]


def _design(a: Analysis) -> Iterator[Item]:
    from malta.report import plots

    yield from summary_sentences(a)
    groups: dict[str, list[list[str]]] = {}
    for entry in design_entries(a.subject):
        unit = display_unit(entry.unit, [entry.value])
        groups.setdefault(entry.group, []).append([entry.name, entry.text(unit), "" if unit == "1" else unit])
    heads = ("entry", "value", "unit")
    sheets = [plain_sheet(group.capitalize(), heads, rows) for group, rows in groups.items()]
    first = [sheet for sheet in sheets if sheet.title == "Law"]
    yield Illustration(
        partial(plots.block_diagram, a.subject.controller, a.plant),
        "The loop, block by block: what acts, how often, how late and within which limits.",
    )
    yield from first
    yield Folded("Machine, weights, noise and limits", tuple(sheet for sheet in sheets if sheet not in first))


def _requirements(a: Analysis) -> Iterator[Item]:
    if not a.report.requirements:
        return
    if a.subject.written_from is None:
        yield "The design file was changed after the gain file was written: these are its present requirements."
    rows, marks = [], []
    ranked = sorted(a.report.requirements, key=lambda one: (RANKS[one.verdict], one.asked is None))
    for one in ranked:  # failures first
        state, word = _light(one)
        rows.append([word, one.words, one.asked_text, one.found_text, one.nearness, one.how])
        marks.append((state, "", "", "", "", ""))
    heads = ("", "requirement", "asked", "found", "of the limit", "from")
    sheet = plain_sheet("[specification] of the design file, measured with these gains", heads, rows)
    right = (False, False, True, True, True, False)
    yield PageTable(sheet.title, sheet.heads, sheet.rows, right, tuple(marks))


def _light(one: Outcome) -> tuple[str, str]:
    """The traffic light of a requirement: its mark, and its word for readers without colours."""
    if one.asked is None:
        return "", "–"
    if one.verdict == "undecided":
        return "near", "? undecided"
    if not one.holds:
        return "bad", "✗ fails"
    return ("near", "✓ barely") if one.is_graded and one.ratio > NEAR_BOUND_SHARE else ("good", "✓ holds")


def _poles(a: Analysis) -> Iterator[Item]:
    from malta.report import plots

    loops = {a.subject.controller.name: a.curves}
    yield Illustration(
        lambda: plots.pzmap(loops),
        "Poles of the closed loop and of the machine, and zeros of the loop gain; of sampled systems ln(z) / Ts. "
        "The right side is the neighbourhood of the origin." + pole_difference(a),
    )
    changed = a.subject.parameters != a.subject.controller.parameters
    published = None if changed else published_figures(a.plant.name)
    yield from sheets_of([poles_table(a.report.model, published), loop_poles_table(a.report)])


def pole_difference(a: Analysis) -> str:
    """Why poles of the machine in the map are not those of the table; "" where they are."""
    table, drawn = np.linalg.eigvals(a.report.model.A), a.curves.poles["plant"]
    apart = np.abs(table[:, None] - drawn[np.isfinite(drawn)][None]).min(axis=1, initial=np.inf)
    if np.all(apart <= SAME_POLE * np.abs(table).max(initial=0.0)):
        return ""
    held = ", with its currents held between readings" if is_commutated(a.plant) else ""
    return (
        f" The machine in the map is the one in the loop: under its loads{held}. "
        f"The table of open-loop poles is of the linear model without {'these' if held else 'them'}."
    )


def _margins(a: Analysis) -> Iterator[Item]:
    found = a.report
    if found.chain:
        from malta.report.figures.margins import chain_figure

        if found.robust is not None:
            yield Illustration(
                lambda: chain_figure(found),
                "Margins stage by stage, from full state feedback to the machine's own loop, and the peak sensitivity "
                "of each stage with the zones of ISO 14839-3.",
            )
        yield from _margin_map(a)
        yield from sheets_of([chain_table(found)])
        if missing := found.left_out:
            yield f"Not in the last stage: {missing}."
        yield from open_bounds(found)
        yield from sheets_of([disk_table(found)])
        if found.tolerance:
            yield from sheets_of([tolerance_table(found)])
        yield from sheets_of([places_table(found)])
    elif found.classical is not None:
        yield "The gain file names no uncertain parameters, so that no margin of parameters is shown."
        yield _classical_sheet(found, found.classical)
    if found.worst:
        yield from sheets_of([worst_case_table(found.worst)])


def _margin_map(a: Analysis) -> Iterator[Item]:
    """The plane of the two parameters that the margin depends on most; nothing of a single parameter."""
    from malta.margins.margin_map import margin_map_of
    from malta.report import plots

    found = a.report
    if found.robust is None or not found.robust.lower or len(found.uncertainty) < 2:
        return
    shares = found.robust.sensitivity
    x, y, *_ = sorted(found.uncertainty, key=lambda name: -shares.get(name, 0.0))
    drawn = margin_map_of(a.plant, a.subject.controller, (x, y), found.uncertainty, margin=found.robust)
    over = " and ".join(drawn.words)
    yield Illustration(
        lambda: plots.margin_map(drawn, campaigns=a.campaigns),
        f"Margin map over {over}{drawn.beside_text and f', {drawn.beside_text}'}: every machine in the blue "
        "box is proven stable. The line is the boundary of stability by eigenvalues, which prove nothing.",
    )


def _classical_sheet(found: LoopReport, classical: Classical) -> PageTable:
    """Disk and delay margins of a machine without uncertain parameters."""
    rows = disk_rows(classical.disks, classical.delay, found.controller.sample_time, joined=True)
    return plain_sheet("Disk and delay margins of the sampled loop", DISKS, rows)


def _loop(a: Analysis) -> Iterator[Item]:
    from malta.report import plots

    loops = {a.subject.controller.name: a.curves}
    panels, limits = distinct_channels(loops), curve_limits(a.subject.spec)
    asked = " Shaded in red: what the requirements exclude, hatched where they fail." if limits else ""
    sensitivity: tuple[Callable[..., Any], str] = (
        partial(plots.sensitivity_curves, limits=limits),
        "Sensitivity S and complementary sensitivity T at each sensor, with the zones of ISO 14839-3.",
    )
    drawn: list[tuple[Callable[..., Any], str]] = [
        (
            partial(plots.nyquist, limits=limits),
            "Nyquist plots of the loop at each sensor, the others closed, with the circle of max|S|.",
        ),
        (
            plots.bode,
            "Bode plots of the loop at each sensor, the others closed, with gain and phase margins.",
        ),
        (plots.gang_of_four, "Gang of four: what noise, references and forces do at each sensor."),
    ]
    for draw, caption in [sensitivity, *drawn] if a.report.stable else drawn[:2]:
        more = asked if isinstance(draw, partial) else ""
        yield Illustration(partial(draw, loops, channel=panels.channels), f"{caption}{panels.note}{more}")
    if a.report.stable:
        yield Illustration(
            partial(plots.sigma, loops, limits=limits),
            "Singular values of L, S and T with all sensors at once.",
        )
    published = published_figures(a.plant.name)
    tables: list[Any] = [sensitivity_table(a.report), bandwidth_table(a.report, published)]
    yield from sheets_of(tables)
    if a.report.gang:
        yield from sheets_of([gang_table(a.report)])
    elif a.report.classical is not None:
        rows = [[name, *(f"{value:.4g}" for value in gang)] for name, gang in a.report.classical.gang.items()]
        heads = ("sensor", "|S|", "|T|", "from force |SP|, SI", "to force |FS|, SI")
        yield plain_sheet("Gang of four, largest over frequency", heads, rows)


def _loads(a: Analysis) -> Iterator[Item]:
    if not a.report.recovery:
        return
    from malta.report import plots

    loops, limits = {a.subject.controller.name: a.curves}, curve_limits(a.subject.spec)
    yield Illustration(
        partial(plots.load_response, loops, limits=limits),
        "Deviation after a unit step of each load from outside, and compliance over frequency, of the output that "
        "the load moves furthest.",
    )
    yield from sheets_of([recovery_table(a.report.recovery, a.plant)])
    if not a.loads:
        return
    from malta.report.figures.loads import load_limits_figure
    from malta.report.tables.loads import load_limits_table, load_limits_text, place_text

    yield from sheets_of([load_limits_table(a.loads)])
    yield load_limits_text(a.loads, place_text(a.report.loop))
    if any(one.course for one in a.loads):
        yield Illustration(
            lambda: load_limits_figure(a.loads, a.subject.controller.name),
            "The largest share of a clearance that any waveform of a load uses, over its size: proven of the nonlinear "
            "machine up to the dashed line, and of the linear loop.",
        )


def _job_title(a: Analysis) -> str:
    name = a.job.name if a.job is not None else "main job"
    return f"{name.replace('_', ' ').replace('-', ' ').capitalize()}, simulated"


def _job(a: Analysis) -> Iterator[Item]:
    if a.job is None:
        yield from (note for note in a.notes if "was not simulated" in note)
        return
    from malta.report.figures import experiment_figure

    job, published = a.job, published_figures(a.plant.name)
    yield f"{job.question} Fidelity {job.run.scenario.fidelity}: {job.outcome}."
    yield Illustration(
        lambda: experiment_figure(job, published),
        f"The machine's main job, {job.name}, on the nonlinear machine.",
    )
    yield from sheets_of(experiment_table(job, published))
    yield from limits_text(job)


def _noise(a: Analysis) -> Iterator[Item]:
    noise = a.report.noise
    if noise is None:
        return
    budget = budget_of(a.report.loop.sampled, a.plant)
    names = [s.name for s in a.plant.outputs]
    for signals, totals, shares, title in (
        (
            a.plant.outputs,
            noise.motion,
            budget.motion,
            "True motion at rest, rms, and the sensors that cause it",
        ),
        (a.plant.inputs, noise.force, budget.force, "Commands at rest, rms, and the sensors that cause them"),
    ):
        if not np.any(totals):
            continue
        rows = []
        for k, signal in enumerate(signals):
            fine = FINE_UNITS.get(signal.unit, signal.unit)
            parts = (f"{100 * share:.0f} %" if share >= 0.005 else "" for share in shares[k])
            head = signal.name if fine == "1" else f"{signal.name} [{fine}]"
            rows.append([head, four_digits(in_unit(float(totals[k]), fine)), *parts])
        heads = ("signal", "rms", *(f"from {name}" for name in names))
        yield plain_sheet(f"{title}, as shares of the variance", heads, rows)
    if not np.any(noise.motion):
        yield "The machine's sensors have no noise and no steps: at rest nothing moves."


def _campaigns(a: Analysis) -> Iterator[Item]:
    from malta.report.figures import distributions_figure, worst_figure, yield_figure

    for found in a.campaigns:
        text = (
            f"{run_text(found.plan)}: {found.runs} of {found.plan.samples} machines; {box_text(found.plan)}; "
        )
        yield text + f"{found.plan.sampler}, seed {found.plan.seed}."
        if not found.runs:
            continue
        drawn: tuple[tuple[Callable[[Any], Figure], str], ...] = (
            (yield_figure, "How the runs of the campaign end over the ranges of the parameters."),
            (distributions_figure, "Distributions of the figures of merit over the completed runs."),
            (worst_figure, "The worst runs of the campaign."),
        )
        for draw, caption in drawn:
            yield Illustration(partial(draw, found), caption)
        yield from sheets_of(campaign_tables(found))


def _gains(a: Analysis) -> Iterator[Item]:
    c = a.subject.controller
    law = "v = K (ξ* − ξ̂) + Ki e, and ξ̂ = ξ + L (y − Cd ξ)"
    yield f"{law}: rows and columns bear the names of their signals; all numbers are in SI units."
    sums = tuple(Signal(s.name, f"{s.unit} s") for s in c.measurements)
    for name, M, rows, columns, what in (
        ("K", c.K, c.forces, c.states, "states to commands"),
        ("Ki", c.Ki, c.forces, sums, "sums of errors to commands"),
        ("L", c.L, c.states, c.measurements, "innovations to states"),
    ):
        if name != "Ki" or c.integrating:
            sheets = matrix_sheets(name, M, rows, columns)
            yield Folded(f"{name}, {len(rows)} × {len(columns)}: {what}", tuple(sheets))


def _provenance(a: Analysis) -> Iterator[Item]:
    c = a.subject.controller
    rows = [
        ["gain file", a.subject.source],
        ["design", c.name],
        ["sha256 of the design file's content", c.spec_sha256],
        ["machine", a.plant.name],
        ["preset of its data", a.subject.parameters.preset],
        *([[key, value] for key, value in a.subject.provenance]),
        ["this page: malta", version()],
        ["this page: Python", platform.python_version()],
    ]
    sheet = plain_sheet("Where the numbers come from", ("what", "which"), [row for row in rows if row[1]])
    yield PageTable(
        sheet.title, sheet.heads, tuple((row[0], row[1]) for row in rows if row[1]), (False, False)
    )
    yield from (note for note in a.notes if "was not simulated" not in note)
