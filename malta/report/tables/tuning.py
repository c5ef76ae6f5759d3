"""Tables of a search: requirements and what a design reaches of them, and the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rich.table import Table
from rich.text import Text

from malta.report.figures.drawing import UNITS, front_lines
from malta.report.tables.layout import add_row, new_table
from malta.synthesis.requirements import Trade, requirements_for

if TYPE_CHECKING:
    from malta.margins.loop_report import Outcome
    from malta.tuning.tune import Tuned


COLOURS = {"holds": "green", "undecided": "bold yellow", "fails": "bold red"}  # beside their words


def requirements_table(requirements: Sequence[Outcome]) -> Table:
    """Tabulate the requirements of a design: the limit, the value found, and their ratio.

    requirements : of a Tuned, from `malta.tune`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> from malta.tuning.verify import Outcome
    >>> margin = Outcome("margin", 3.0, 3.6, "1", "proven over the travel", at_least=True)
    >>> rich.print(malta.report.requirements_table([margin]))
    Requirements
    <BLANKLINE>
     requirement      asked   found   of the limit                             from
     ──────────────────────────────────────────────────────────────────────────────
     margin        >= 300 %   360 %         83.3 %   holds   proven over the travel
    <BLANKLINE>
    """
    table = new_table("Requirements", "requirement", "asked", "found", "of the limit", "", "from")
    for r in requirements:
        ratio, verdict = "", ""
        if r.asked is not None:
            ratio, verdict = f"{100 * r.ratio:.1f} %", "FAILS" if r.verdict == "fails" else r.verdict
        cells = [Text(cell) for cell in (r.words, r.asked_text, r.found_text, ratio, verdict, r.how)]
        cells[4].style = COLOURS[r.verdict]
        table.add_row(*cells)
    return table


def _front_columns(tuned: Tuned) -> dict[str, tuple[str, float, str]]:
    """Columns of the front by figure: heading, factor from SI to the unit shown, unit."""
    names = dict.fromkeys(name for one in tuned.front for name in one.figures)
    columns = {"margin": ("margin, proven", 100.0, "%")}
    sides: tuple[tuple[Trade, str], ...] = (("force", ""), ("motion", " motion"))
    for trade, what in sides:
        for name, label, scale, unit in front_lines(tuned.spec.plant, names, trade):
            columns[name] = (f"{label}{what}", scale, f"{unit} rms")
    for name, r in requirements_for(tuned.spec.plant).items():
        if name in names and r.heading and not r.trade:
            columns[name] = (r.heading, *UNITS.get(r.unit, (1.0, "")))
    return columns


def front_rows(tuned: Tuned) -> tuple[list[str], list[list[str]]]:
    """List the Pareto front as headings and cells: a row for each trial, the chosen one with a star.

    tuned : from `malta.tune`

    Returns headings and rows.

    >>> import malta
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import Tuned
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = Tuned(spec, front[1], (), front, trials=120)  # as malta.tune finds it
    >>> heads, rows = malta.report.front_rows(tuned)
    >>> rows[1]
    ['363', '0.0414', '0.501', '*']
    """
    columns = _front_columns(tuned)
    shown = [name for name in columns if any(name in one.figures for one in tuned.front)]
    heads = [f"{columns[k][0]} [{columns[k][2]}]".removesuffix(" []") for k in shown]
    rows = [
        [f"{one.figures[k] * columns[k][1]:.4g}" if k in one.figures else "" for k in shown]
        + ["*" if one.values == tuned.trial.values else ""]
        for one in tuned.front
    ]
    return [*heads, ""], rows


def front_table(tuned: Tuned) -> Table:
    """Tabulate the Pareto front of margin, force noise and motion, in the order of margins.

    tuned : from `malta.tune`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import Tuned
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = Tuned(spec, front[1], (), front, trials=120)  # as malta.tune finds it
    >>> rich.print(malta.report.front_table(tuned))
    What the margin costs (* chosen)
    <BLANKLINE>
     margin, proven [%]   f [N rms]   y motion [µm rms]
     ──────────────────────────────────────────────────────
     328                     0.0122               0.523
     363                     0.0414               0.501   *
    <BLANKLINE>
    """
    heads, rows = front_rows(tuned)
    table = new_table("What the margin costs (* chosen)", *heads)
    for row in rows:
        add_row(table, *row)
    return table


def front_markdown(tuned: Tuned) -> str:
    """Write the Pareto front as a Markdown table.

    tuned : from `malta.tune`

    Returns the text.

    >>> import malta
    >>> from malta.tuning.search import Trial
    >>> from malta.tuning.tune import Tuned
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> noisy = {"margin": 3.63, "force_noise f": 0.0414, "motion y": 0.501e-6}
    >>> quiet = {"margin": 3.28, "force_noise f": 0.0122, "motion y": 0.523e-6}
    >>> front = Trial((223.0, 50, 0.051), 1, quiet), Trial((190.0, 40, 0.11), 1, noisy)
    >>> tuned = Tuned(spec, front[1], (), front, trials=120)  # as malta.tune finds it
    >>> print(malta.report.front_markdown(tuned))
    | margin, proven [%] | f [N rms] | y motion [um rms] |  |
    | ---: | ---: | ---: | ---: |
    | 328 | 0.0122 | 0.523 |  |
    | 363 | 0.0414 | 0.501 | * |
    <BLANKLINE>
    """
    heads, rows = front_rows(tuned)
    lines = ["| " + " | ".join(row) + " |" for row in (heads, ["---:"] * len(heads), *rows)]
    return "\n".join([*lines, ""])
