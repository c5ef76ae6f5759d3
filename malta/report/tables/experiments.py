"""Tables of experiments: figures of merit beside the published ones, and the scenarios of a machine."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.table import Table
from rich.text import Text

from malta.display import quantity
from malta.report.figures.drawing import Published
from malta.report.tables import (
    COLOURS,
    INDENT,
    Paragraph,
    add_row,
    end_cell,
    fold,
    merit_text,
    new_sheet,
    new_table,
    published_text,
)
from malta.simulation.experiments import Experiment
from malta.simulation.experiments.catalogue import experiments_of, option_units, options_of
from malta.units import FINE_UNITS, unit_factor

if TYPE_CHECKING:
    from malta.identification.commission import Check, Commissioning, StepFinding
    from malta.identification.excite import ExcitationPlan
    from malta.identification.explanation import Explanation
    from malta.identification.frequency_response import ResponseComparison
    from malta.identification.identified import Identified
    from malta.identification.log import Log
    from malta.identification.measure import Measurement, MeasurementPlan
    from malta.identification.prediction import Predicted
    from malta.identification.replay import LawReplay
    from malta.identification.strokes import LearnedStrokes
    from malta.identification.windings import Windings
    from malta.merits import Merit
    from malta.model.plant import Plant
    from malta.report.ledger import Ledger


def limits_text(e: Experiment) -> list[str]:
    """Name the limits that runs reached: a sentence for each set of limits, with the cases that reached it.

    e : from `malta.experiment`

    Returns the sentences; none where no run reached a limit.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> push = malta.experiment("disturbance", spec.plant, controller, size=8.0)
    >>> malta.report.limits_text(push)
    ['met the force limit: w']
    """
    met: dict[tuple[str, ...], list[str]] = {}
    for case in e.cases:
        met.setdefault(case.run.limits, []).append(case.label)
    return [f"met the {' and the '.join(names)}: {', '.join(cases)}" for names, cases in met.items() if names]


INTERRUPTED_TEXT = "Interrupted: the figures below are of what was simulated until then; none is final.\n"


def experiment_table(e: Experiment, published: Published | None = None) -> Group:
    """Tabulate the cases of an experiment, and its figures of merit beside the published ones.

    Where the experiment has no figures of merit of its own, each case has a row.

    e : from `malta.experiment`
    published : figures of the machine's paper, from `malta.model.read_published`; None: none

    Returns a rich Group of tables, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> exact = {"noise": 0.0, "quantize": False}  # sensors
    >>> push = malta.experiment("disturbance", spec.plant, controller, size=0.1, **exact)
    >>> rich.print(malta.report.experiment_table(push))
    How far does a load move it, and does it come back?
    <BLANKLINE>
     figure                       ours
     ─────────────────────────────────
     y moves by [µm]             34.29
     y, left at the end [µm]   0.05314
    <BLANKLINE>
    """
    tables: list[Table | Paragraph] = [Paragraph(INTERRUPTED_TEXT)] if e.cut else []
    if len(e.cases) > 1 and e.merits is e.cases[0].merits:
        return Group(*tables, _cases_table(e, published))
    first = len(tables)
    if [merit.label for merit in e.merits] != [merit.label for merit in e.cases[0].merits]:
        tables.append(_cases_table(e, published))
    if e.merits:
        tables.append(_merits_table("" if tables[first:] else e.question, e.merits, published))
    return Group(*tables)


def _merits_table(title: str, merits: Sequence[Merit], published: Published | None) -> Table:
    """One row for each figure of merit."""
    if published is None or not any(merit.published for merit in merits):
        table = new_table(title, "figure", "ours")
        for merit in merits:
            add_row(table, merit.heading, merit_text(merit))
        return table
    table = new_table(title, "figure", "ours", "published")
    for merit in merits:
        add_row(table, merit.heading, merit_text(merit), published_text(merit, published))
    return table


def _cases_table(e: Experiment, published: Published | None) -> Table:
    """One row for each case; one column for each case where there are more than COLUMNS figures of merit.

    Where the cases have different figures of merit, or one figure in other units, they stand below each other.
    """
    fullest = max((case.merits for case in e.cases), key=len)
    labels, headings = [merit.label for merit in fullest], {merit.heading for merit in fullest}
    if any(merit.heading not in headings for case in e.cases for merit in case.merits):
        return _list_of_merits(e)
    if len(labels) > COLUMNS:
        return _transpose(e, fullest)
    ended = any(not case.run.verdict.completed for case in e.cases)
    heads = ["verdict", "at [ms]"] if ended else []
    table = new_table(e.question, "case", *heads, *(merit.heading for merit in fullest))
    if ended:
        table.columns[1].justify = "left"
    for case in e.cases:
        end, found = case.run.verdict, {merit.label: merit_text(merit) for merit in case.merits}
        ends: list[str | Text] = []
        if ended:
            ends = [end_cell(end.words, completed=end.completed), f"{end.time * 1e3:.1f}"]
        add_row(table, case.label, *ends, *(found.get(label, "-") for label in labels))
    if published is not None and any(merit.published for merit in fullest):
        table.add_section()
        add_row(
            table, "published", *("" for _ in heads), *(published_text(merit, published) for merit in fullest)
        )
    return table


COLUMNS = 6  # largest number of figures of merit beside each other


def _transpose(e: Experiment, fullest: Sequence[Merit]) -> Table:
    """One column for each case."""
    table = new_table(e.question, "figure", *(case.label for case in e.cases))
    found = [{merit.label: merit_text(merit) for merit in case.merits} for case in e.cases]
    ends = [case.run.verdict for case in e.cases]
    add_row(table, "verdict", *(end_cell(end.words, completed=end.completed) for end in ends))
    add_row(table, "at [ms]", *(f"{end.time * 1e3:.1f}" for end in ends))
    for merit in fullest:
        add_row(table, merit.heading, *(values.get(merit.label, "-") for values in found))
    return table


def _list_of_merits(e: Experiment) -> Table:
    """The figures of merit of all cases below each other."""
    table = new_table(e.question, "case", "figure", "ours")
    table.columns[1].justify = "left"
    for case in e.cases:
        end = case.run.verdict
        ended = end_cell(f"{end.words} at {end.time * 1e3:.1f} ms", completed=end.completed)
        add_row(table, case.label, "verdict", ended)
        for merit in case.merits:
            add_row(table, "", merit.heading, merit_text(merit))
    return table


def scenarios_table(plant: Plant, flown: Collection[str] | None = None) -> Table:
    """Tabulate the experiments of a machine, each with a description and the options that only it has.

    plant : the machine
    flown : names of the experiments to list; None: all

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> ball = malta.read_design("examples/ball/design/ball.toml").plant
    >>> rich.print(malta.report.scenarios_table(ball, ["disturbance"]))
    Scenarios of the machine 'ball'
    <BLANKLINE>
     scenario      what is run                                   options of its own
     ──────────────────────────────────────────────────────────────────────────────
     disturbance   A constant load of `size` (SI; 0: 1, or       on=all
                   what half of the way to a contact takes) on   size=0.0 N
                   one disturbance, or on each.                  time=0.0 s
    <BLANKLINE>
    """
    table = new_table(
        f"Scenarios of the machine {plant.name!r}", "scenario", "what is run", "options of its own"
    )
    table.columns[1].justify = table.columns[2].justify = "left"
    for name, run in experiments_of(plant).items():
        if flown is None or name in flown:
            what = (inspect.getdoc(run) or "").partition("\n\n")[0]
            add_row(table, name, " ".join(what.split()), "\n".join(_options(name, plant)))
    return table


def _options(name: str, plant: Plant) -> list[str]:
    """Options of an experiment with their defaults and units, as the command line takes them."""
    units, shown = option_units(name, plant), list[str]()
    for option, default in options_of(name, plant).items():
        values = default if isinstance(default, tuple) else (default,)
        text = ",".join(str(v).lower() if isinstance(v, bool) else f"{v}" for v in values)
        shown.append(f"{option}={text} {units.get(option, '')}".rstrip())
    return shown


# Tables of logs, excitations, identified parameters and replays.


def micro(unit: str) -> tuple[float, str]:
    """How lengths, angles and voltages of a machine are shown: what SI is multiplied with, and the unit."""
    fine = FINE_UNITS.get(unit, unit)
    return (1 / unit_factor(fine, "unit"), fine) if fine != unit else (1.0, unit)


def log_table(log: Log) -> Table:
    """Statistics of the columns of a log, lengths in um; a column that never changes has one number."""
    table = new_table("Signals", "signal", "least", "mean", "largest", "deviation")
    for row in log_rows(log):
        add_row(table, *row)
    return table


def log_rows(log: Log) -> list[tuple[str, ...]]:
    """The rows of `log_table`."""
    rows = []
    for heading, numbers in log.survey.statistics.items():
        name, unit = heading[:-1].rsplit(" [", 1)
        scale, shown = micro(unit)
        if not heading.startswith("flag."):
            rows.append((f"{name} [{shown}]", *(f"{scale * value:.4g}" for value in numbers)))
    return rows


def excitation_tables(plan: ExcitationPlan, plant: Plant) -> list[Table]:
    """What moves how far, what current flows, and what will be found how well."""
    from malta.identification.response import axes_of  # loads an optimizer

    moved = new_table("What it does, by the linear loop", "signal", "largest", "of its limit")
    for signal in plant.outputs:
        scale, unit = micro(signal.unit)
        stop = f"stop beyond {scale * plan.window[signal.name]:.3g}"
        add_row(moved, f"{signal.name} [{unit}]", f"{scale * plan.motion[signal.name]:.4g}", stop)
    for signal, limit in zip(plant.inputs, plant.actuator.force_limit, strict=True):
        share = plan.command[signal.name]
        add_row(moved, f"{signal.name} [{signal.unit}]", f"{share * limit:.4g}", f"{100 * share:.3g} %")
    most, unit_of = max(plan.current.values()), {s.name: s.unit for s in axes_of(plant)}
    for name, value in plan.current.items():
        if value > 1e-6 * most:
            share = value / plant.actuator.current_limit
            add_row(
                moved, f"{name} beside that at rest [{unit_of[name]}]", f"{value:.4g}", f"{100 * share:.3g} %"
            )
    told = new_table("What its log will tell", "parameter", "half of the 95 % interval [%]")
    for name, share in plan.accuracy.items():
        add_row(told, name, f"{100 * share:.2g}")
    return [moved, told]


def identified_table(found: Identified) -> Table:
    """The identified parameters with their total 95 % intervals, and those of noise alone."""
    from malta.identification.response import units_of_model  # loads an optimizer

    headings = ("parameter", "value", "95 % interval, total", "half [%]", "by noise alone", "gain file")
    table = new_table("Identified", *headings)
    units = units_of_model(found.plant)
    columns = (found.values, found.total, found.half_widths, found.start)
    for name, value, total, alone, start in zip(found.names, *(c.tolist() for c in columns), strict=True):
        unit = "" if units[name] == "1" else f" [{units[name]}]"
        shares = [f"{100 * half / abs(value):.2g}" if value else "-" for half in (total, alone)]
        ends = f"{value - total:.5g} .. {value + total:.5g}"
        add_row(table, f"{name}{unit}", f"{value:.5g}", ends, *shares, f"{start:.5g}")
    return table


def explanation_table(e: Explanation) -> Table:
    """What explains a log beside the parameters, and what does it as well."""
    table = new_table(
        "What explains the log beside them", "imperfection", "found", "usual", "share [%]", "or"
    )
    for one in e.causes:
        usual = quantity(1.96 * abs(one.size), one.unit)
        found = f"{quantity(one.value, one.unit)} +- {quantity(one.half, one.unit)}"
        more = " ..." if len(one.alike) > 2 else ""
        add_row(
            table, one.name, found, f"+- {usual}", f"{100 * one.share:.2g}", " ".join(one.alike[:2]) + more
        )
    return table


KNOWN_ROWS = 12  # of a table of what is known
MIN_EFFECT = 1e-3  # of a parameter: what moves none by more is not listed


def known_table(e: Explanation) -> Table:
    """What was taken as known, how well, and what it moves: 1 % of it, of what is zero as much as the log leaves."""
    table = new_table("Taken as known, and what it moves", "known", "value, 95 %", "so much of it", "moves")
    for one in sorted(e.effects, key=lambda one: not one.value)[:KNOWN_ROWS]:
        share = 0.01 * abs(one.value) / one.left if one.value else 1.0
        moved = {name: x * share for name, x in one.effect.items() if abs(x) * share > MIN_EFFECT}
        most = sorted(moved, key=lambda name: -abs(moved[name]))[:3]
        text = ", ".join(f"{name} {100 * x:+.2g} %" for name, x in moved.items() if name in most)
        if text:
            value = f"{quantity(one.value, one.unit)} +- {quantity(1.96 * one.size, one.unit)}"
            add_row(table, one.name, value, "1 %" if one.value else quantity(one.left, one.unit), text)
    return table


def in_time_table(found: Identified, in_time: Predicted) -> Table:
    """The same parameters from prediction errors in time, and how far apart both estimates are."""
    table = new_table("The same from prediction errors in time", "figure", "found", "if the model is right")
    for name, value in zip(found.names, in_time.values.tolist(), strict=True):
        add_row(table, name, f"{value:.5g}", f"{found.differences[name]:.1g} sigma off, at most 3")
    for name, value in zip(found.by_output, in_time.rms.tolist(), strict=True):
        add_row(table, f"innovation of {name} over its expected size", f"{value:.3g}", "1")
    add_row(table, "missing readings", str(in_time.missing), "")
    add_row(table, "outliers, beyond 6 sigma", str(in_time.outliers), "0")
    return table


def drive_table(found: Windings) -> Table:
    """R, L and the dead time with their 95 % intervals, and the current loops that they make."""
    table = new_table("The drive, from voltages to currents", "figure", "value", "half [%]", "gain file")
    for name, (one, own) in found.estimates.items():
        scale, unit = (1e6, "us") if one.unit == "s" else (1e3, "mH") if one.unit == "H" else (1, one.unit)
        share = f"{100 * one.half / one.value:.2g}"
        add_row(table, f"{name} [{unit}]", f"{scale * one.value:.5g}", share, f"{scale * own:.5g}")
    crossover, margin = found.designed
    add_row(table, "crossover of the current loops [rad/s]", f"{found.crossover:.4g}", "", f"{crossover:.4g}")
    degrees = f"{math.degrees(found.phase_margin):.3g}", "", f"{math.degrees(margin):.3g}"
    add_row(table, "their phase margin [deg]", *degrees)
    add_row(table, f"chi2 / dof, at most {found.limit:.3g}", f"{found.chi2:.3g}", "", "")
    return table


def quality_table(found: Identified) -> Table:
    """How well the model explains the log."""
    table = new_table("How well the model explains the log", "figure", "found", "if it is right")
    if found.record is not None:
        for signal, size in zip(found.plant.outputs, found.record.noise.sensors.tolist(), strict=True):
            add_row(table, f"noise of {signal.name}, rms", quantity(math.sqrt(size), signal.unit), "")
        add_row(
            table, "largest correlation of prediction errors", f"{found.record.correlation:.2g}", "below 0.15"
        )
        return table
    add_row(table, f"chi2 / dof, {found.dof} degrees", f"{found.chi2:.3g}", f"1, at most {found.limit:.3g}")
    for name, value in found.by_output.items():
        add_row(table, f"of {name}", f"{value:.3g}", "1")
    if found.explanation is not None and found.chi2 > found.limit:
        add_row(table, "chi2 / dof with imperfections", f"{found.explanation.chi2:.3g}", "1")
        add_row(table, "response that is left [%]", f"{100 * found.explanation.share:.2g}", "0")
    add_row(table, "correlation of neighbouring lines [sigma]", f"{found.whiteness:.2g}", "-2 .. 2")
    add_row(table, "power where nothing was excited", f"{found.distortion:.3g}", "1")
    return table


def strokes_table(found: LearnedStrokes) -> Table:
    """The error of each stroke, and what it taught."""
    errors = "largest axial error [um]", "without noise [um]"
    table = new_table("Stroke by stroke", "stroke", *errors, "patterns above the noise")
    for k, (error, count) in enumerate(zip(found.axial_error, found.patterns, strict=True)):
        taught = "the force constant" if k == 0 else str(count)
        add_row(table, str(k + 1), f"{1e6 * error:.3g}", f"{1e6 * found.without_noise[k]:.3g}", taught)
    return table


def replay_table(found: LawReplay, plant: Plant) -> Table:
    """Commands and innovations of a law on a log."""
    columns = ("signal", "from the start", "second half", "own machine", "sensor", "whiteness")
    table = new_table("The law on the log", *columns)
    for signal in plant.inputs:
        off = f"{found.at_once[signal.name]:.2g}", f"{found.difference[signal.name]:.2g}"
        add_row(table, f"{signal.name} differs by [{signal.unit}]", *off, "", "", "")
    for signal in plant.outputs:
        name, (scale, unit) = signal.name, micro(signal.unit)
        own = f"{scale * found.own[name]:.3g}" if found.same else ""
        sizes = f"{scale * found.rms[name]:.3g}", own, f"{scale * found.expected[name]:.3g}"
        add_row(table, f"innovation of {name}, rms [{unit}]", "", *sizes, f"{found.whiteness[name]:.2g}")
    return table


def response_table(found: ResponseComparison) -> Table:
    """A response of an analyser beside what is predicted, where it is largest, and where it misses most."""
    size, heads = np.abs(found.response.values), ("where", "at [Hz]", "measured", "predicted", "error [%]")
    table = new_table(f"{found.of}: measured beside predicted", *heads)
    for where, k in (("largest", int(size.argmax())), ("misses most", int(found.error.argmax()))):
        tube = f"{found.low[k]:.3g} .. {found.high[k]:.3g}" if found.machines > 1 else f"{found.high[k]:.3g}"
        at = f"{found.response.w[k] / (2 * np.pi):.4g}"
        add_row(table, where, at, f"{size[k]:.3g}", tube, f"{100 * found.error[k]:.2g}")
    return table


def measured_tables(found: Measurement) -> list[Table]:
    """The largest |S| and |T| of each sensor as measured, with bands, and disk margins, beside what is predicted."""
    from malta.margins.loop_report import zone  # here: it brings all proofs

    table = new_table(
        "The loop as measured, at the lines",
        "sensor", "largest |S|", "at [Hz]", "95 % below", "zone", "predicted", "largest |T|", "predicted",
    )  # fmt: skip
    for i, name in enumerate(found.sensors):
        peak, high, w = found.peaks[name]
        tube = [f"{c.low[:, i].max():.3g} .. {c.high[:, i].max():.3g}" for c in (found.S, found.T)]
        at = f"{w / (2 * np.pi):.4g}"
        top = f"{found.T.size[:, i].max():.3g}"
        add_row(table, name, f"{peak:.3g}", at, f"{high:.3g}", zone(high), tube[0], top, tube[1])
    margins = new_table("Disk margins as measured, at the lines", "channels", "size", "95 % above", "at [Hz]")
    for disk, low in found.disks:
        cells = (f"{disk.size:.3g}", f"{low:.3g}", f"{disk.frequency / (2 * np.pi):.4g}")
        add_row(margins, disk.channels, *cells)
    return [table, margins]


def measurement_plan_table(plan: MeasurementPlan) -> Table:
    """What a measurement will tell of each sensor."""
    table = new_table(
        "What it will tell", "sensor", "coherence, least", "median", "half of a band of |S| [%]", "at [Hz]"
    )
    share = plan.half_width / np.maximum(np.abs(plan.S), 1.0)
    for i, name in enumerate(plan.sensors):
        k = int(share[:, i].argmax())
        gamma = plan.coherence[name]
        cells = (f"{gamma.min():.4f}", f"{np.median(gamma):.4f}", f"{100 * share[k, i]:.2g}")
        add_row(table, name, *cells, f"{plan.w[k] / (2 * np.pi):.4g}")
    return table


def checklist_table(steps: Sequence[Check]) -> Table:
    """The steps of a commissioning: what each asks, needs, aborts at and writes."""
    heads = ("step", "question", "needs", "aborts at", "writes")
    table = new_sheet("Checklist", [(head, "left") for head in heads])
    for step in steps:
        add_row(table, step.name, step.question, step.needs, step.aborts, f"{step.name}.npz")
    return table


def findings_table(done: Commissioning) -> Table:
    """What the steps of a commissioning found."""
    sides = ("left", "left", "right", "right", "right", "left")
    heads = ("step", "finding", "found", "95 %", "limits", "")
    table = new_sheet("Commissioning", list(zip(heads, sides, strict=True)))
    for entry in done.entries:
        name = f"{entry.name} {'passed' if entry.passed else 'FAILED'}"
        for one in entry.findings:
            add_row(table, name, *finding_cells(one))
            name = ""
        if entry.refusal:
            add_row(table, name, entry.refusal, "", "", "", "")
    return table


def finding_cells(one: StepFinding) -> tuple[str, str, str, str, str]:
    """Name, value, half of the interval, limits, and a word where they are not kept."""
    value, half, unit = one.found
    scale, shown = (1e6, "um") if unit == "m" else (1.0, unit)  # phases of waves are in rad
    name = one.name if unit == "1" else f"{one.name} [{shown}]"
    ends = [f"{scale * end:.4g}" for end in (one.low, one.high) if math.isfinite(end)]
    limits = " .. ".join(ends)
    if len(ends) == 1:
        limits = f">= {ends[0]}" if math.isfinite(one.low) else f"<= {ends[0]}"
    return name, f"{scale * value:.4g}", f"{scale * half:.2g}", limits, "" if one.holds else "FAILS"


# The ledger of published numbers, a line a claim.


GAP = 2  # columns of a terminal between those of a line
MIN_CLAIM_LETTERS = 30  # a terminal with less room for a claim has fewer designs a line


MEANINGS = {
    "reproduced": "holds",
    "kept": "holds",
    "near": "undecided",
    "partly": "undecided",
    "differs": "fails",
}  # of their words


@dataclass(frozen=True)
class ClaimLines:
    """A line for each claim: claim, published figure, that of each design, and the verdict in one word.

    Names that are too long for their line take several, the figures stand beside the last. Where not all designs fit
    beside each other, the lines are printed once for as many designs as fit, and then for the others.

    ledger : from `malta.ledger`
    why : below each line the whole verdict with its reason
    """

    ledger: Ledger
    why: bool = False

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Draw the lines in the width that is given."""
        width = options.max_width
        yield Text("\n".join(fold(f"Published numbers and ours: {self.ledger.title}", width)))
        for designs in self._blocks(width):
            shown = Text("\n".join(["", *self._lines(designs, width)]))
            for word, meaning in MEANINGS.items():
                shown.highlight_regex(re.compile(f"(?<= {{{GAP}}}){word}$", re.M), COLOURS[meaning])
            yield shown

    def _columns(self, designs: Sequence[int]) -> list[list[str]]:
        """The texts of all columns but the claim's, each with its heading."""
        ledger = self.ledger
        ours = [[ledger.designs[k], *(claim.ours[k] for claim in ledger.claims)] for k in designs]
        published = ["published", *(claim.published for claim in ledger.claims)]
        return [published, *ours, ["verdict", *(claim.word for claim in ledger.claims)]]

    def _room(self, designs: Sequence[int], width: int) -> int:
        """The letters that are left for the claim."""
        return width - sum(max(map(len, column)) + GAP for column in self._columns(designs))

    def _blocks(self, width: int) -> list[list[int]]:
        """The designs that stand beside each other."""
        blocks: list[list[int]] = [[]]
        for k in range(len(self.ledger.designs)):
            if blocks[-1] and self._room([*blocks[-1], k], width) < MIN_CLAIM_LETTERS:
                blocks.append([])
            blocks[-1].append(k)
        return blocks

    def _lines(self, designs: Sequence[int], width: int) -> Iterator[str]:
        """Heading, rule and claims for some of the designs."""
        columns = self._columns(designs)
        longest = max(len("claim"), *(len(claim.subject) for claim in self.ledger.claims))
        room = max(min(self._room(designs, width), longest), len(INDENT) + 1)
        widths = [max(map(len, column)) for column in columns]
        for row, claim in enumerate((None, *self.ledger.claims)):
            numbers = (
                " " * GAP + column[row].rjust(n) for column, n in zip(columns[:-1], widths, strict=False)
            )
            *above, last = _name("claim" if claim is None else claim.subject, room)
            yield from above
            yield last.ljust(room) + "".join(numbers) + " " * GAP + columns[-1][row]
            if claim is None:
                yield "─" * (room + sum(n + GAP for n in widths))
            elif self.why and claim.verdict != claim.word:
                yield from (INDENT + line for line in fold(claim.verdict, width - len(INDENT)))


def _name(text: str, room: int) -> list[str]:
    """A claim's name in lines of `room` letters: whole, the further lines indented.

    >>> _name("K(p) and pseudo-inverse, table [us]", 24)
    ['K(p) and', '  pseudo-inverse, table', '  [us]']
    """
    if len(text) <= room:
        return [text]
    first, *rest = fold(text, max(room - len(INDENT), 1))
    return [first, *(INDENT + line for line in rest)]


def claims_table(ledger: Ledger, *, why: bool = False) -> ClaimLines:
    """Tabulate published numbers, a line each: the paper's value, that of each design, and the verdict in one word.

    ledger : from `malta.ledger`
    why : below each line the whole verdict, with its reason

    Returns what `rich.print` prints: a line for each claim, two or more for a long name, in the width of the terminal.

    >>> import malta, rich
    >>> from malta.report.ledger import LedgerClaim, Ledger
    >>> verdict = "by construction; K_A"
    >>> ours = ("±218.92",)
    >>> claim = LedgerClaim("pole of x [rad/s]", "±218.92", ours, verdict, "input")
    >>> ledger = Ledger("tubular", "the paper", ("table2",), (claim,))
    >>> rich.print(malta.report.claims_table(ledger, why=True))
    Published numbers and ours: tubular, the paper
    <BLANKLINE>
    claim              published   table2  verdict
    ──────────────────────────────────────────────
    pole of x [rad/s]    ±218.92  ±218.92  input
      by construction; K_A
    """
    return ClaimLines(ledger, why)
