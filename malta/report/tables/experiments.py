"""Tables of experiments: figures of merit beside the published ones, and the scenarios of a machine."""

from __future__ import annotations

import inspect
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table

from malta.report.figures.parts import Published
from malta.report.tables.layout import Paragraph
from malta.report.tables.parts import add_row, merit_heading, merit_text, new_table, published_text
from malta.simulation.catalogue import experiments_of, options_of
from malta.simulation.experiments import setting

if TYPE_CHECKING:
    from malta.model.plant import Plant
    from malta.simulation.experiments import Experiment, Merit


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


CUT = "Interrupted: the figures below are of what was simulated until then; none is final.\n"


def experiment_table(e: Experiment, published: Published | None = None) -> Group:
    """Tabulate the cases of an experiment, and its figures of merit beside the published ones.

    Where the experiment has no figures of merit of its own, each case has a row.

    e : from `malta.experiment`
    published : figures of the machine's paper, from `malta.published`; None: none

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
     y moves by [um]             34.29
     y, left at the end [um]   0.05314
    <BLANKLINE>
    """
    tables: list[Table | Paragraph] = [Paragraph(CUT)] if e.cut else []
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
            add_row(table, merit_heading(merit), merit_text(merit))
        return table
    table = new_table(title, "figure", "ours", "published")
    for merit in merits:
        add_row(table, merit_heading(merit), merit_text(merit), published_text(merit, published))
    return table


def _cases_table(e: Experiment, published: Published | None) -> Table:
    """One row for each case; one column for each case where there are more than COLUMNS figures of merit.

    Where the cases have different figures of merit, the figures stand below each other.
    """
    fullest = max((case.merits for case in e.cases), key=len)
    labels = [merit.label for merit in fullest]
    if any(merit.label not in labels for case in e.cases for merit in case.merits):
        return _list_of_merits(e)
    if len(labels) > COLUMNS:
        return _transposed(e, fullest)
    ended = any(not case.run.verdict.completed for case in e.cases)
    heads = ["verdict", "at [ms]"] if ended else []
    table = new_table(e.question, "case", *heads, *map(merit_heading, fullest))
    if ended:
        table.columns[1].justify = "left"
    for case in e.cases:
        end, found = case.run.verdict, {merit.label: merit_text(merit) for merit in case.merits}
        ends = [end.name, f"{end.time * 1e3:.1f}"] if ended else []
        add_row(table, case.label, *ends, *(found.get(label, "-") for label in labels))
    if published is not None and any(merit.published for merit in fullest):
        table.add_section()
        add_row(
            table, "published", *("" for _ in heads), *(published_text(merit, published) for merit in fullest)
        )
    return table


COLUMNS = 6  # largest number of figures of merit beside each other


def _transposed(e: Experiment, fullest: Sequence[Merit]) -> Table:
    """One column for each case."""
    table = new_table(e.question, "figure", *(case.label for case in e.cases))
    found = [{merit.label: merit_text(merit) for merit in case.merits} for case in e.cases]
    ends = [case.run.verdict for case in e.cases]
    add_row(table, "verdict", *(end.name for end in ends))
    add_row(table, "at [ms]", *(f"{end.time * 1e3:.1f}" for end in ends))
    for merit in fullest:
        add_row(table, merit_heading(merit), *(values.get(merit.label, "-") for values in found))
    return table


def _list_of_merits(e: Experiment) -> Table:
    """The figures of merit of all cases below each other."""
    table = new_table(e.question, "case", "figure", "ours")
    table.columns[1].justify = "left"
    for case in e.cases:
        end = case.run.verdict
        add_row(table, case.label, "verdict", f"{end.name} at {end.time * 1e3:.1f} ms")
        for merit in case.merits:
            add_row(table, "", merit_heading(merit), merit_text(merit))
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
     scenario      what is run                                  options of its own
     ─────────────────────────────────────────────────────────────────────────────
     disturbance   A constant force or torque of `size` (N or   on=all
                   N m) on one input of disturbance, or on      size=1.0
                   each in turn.                                time=0.0
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
    units, shown = setting(plant, "OPTION_UNITS", {}), []
    for option, default in options_of(name, plant).items():
        values = default if isinstance(default, tuple) else (default,)
        text = ",".join(str(v).lower() if isinstance(v, bool) else f"{v}" for v in values)
        shown.append(f"{option}={text} {units.get(option, '')}".rstrip())
    return shown
