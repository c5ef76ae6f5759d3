"""Tables of a campaign: how its runs end, percentiles of their figures of merit, the worst runs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table

from malta.model.parameters import differences
from malta.model.signals import (
    lateral_outputs,
)
from malta.report.figures.parts import Published, number
from malta.report.tables.layout import Paragraph
from malta.report.tables.parts import add_row, new_table
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.campaigns.plan import Plan
    from malta.campaigns.result import Campaign
    from malta.campaigns.summary import Summary
    from malta.synthesis.spec import Spec


def run_text(plan: Plan) -> str:
    """Say what each machine of a plan does: its scenario, with the case, and the fidelity.

    plan : of a campaign

    Returns a line of text.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> malta.report.run_text(malta.Plan(controller, "stroke", spread={"m": 0.1}))
    'stroke, fidelity dq'
    """
    from malta.campaigns.plan import planned_run

    wanted = planned_run(plan)
    case = "" if wanted.label == plan.scenario else f" ({wanted.label})"
    return f"{plan.scenario}{case}, fidelity {wanted.scenario.fidelity}"


def box_text(plan: Plan) -> str:
    """Name the parameters that a plan varies, with their half-widths.

    plan : of a campaign

    Returns a line of text.

    >>> import malta
    >>> controller = malta.gains.read("design/gains/calibrated.json")
    >>> malta.report.box_text(malta.Plan(controller, spread={"m": 0.1, "K_A": 0.05}))
    'm ±10 %, K_A ±5 %'
    """
    from malta.campaigns.statistics import spread_text

    spreads: dict[str, list[str]] = {}
    for name in (*plan.spread, *plan.sensor_spread):
        spreads.setdefault(spread_text(plan, name), []).append(name)
    return ", ".join(f"{' '.join(names)} {width}" for width, names in spreads.items())


def campaign_tables(
    found: Campaign | Summary,
    published: Published | None = None,
    worst: int = 5,
    spec: Spec | None = None,
) -> Group:
    """Tabulate how the runs of a campaign end, their figures of merit beside the published bounds, and the worst runs.

    found : the campaign, or its summary
    published : figures of the machine's paper, from `malta.published`; None: none; a summary has its own
    worst : number of the worst runs that are listed
    spec : the design whose [specification] bounds the runs as well; a summary has its own

    Returns a rich Group of tables, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.Plan(controller, "disturbance", {"m": 0.1}, samples=8, options=short)
    >>> tables = malta.report.campaign_tables(malta.campaign(plan, workers=1))
    >>> rich.print(tables.renderables[0])
    How the runs end
    <BLANKLINE>
     end         runs   share [%]   95 % interval [%]
     ────────────────────────────────────────────────
     completed      8       100.0      63.06 to 100.0
    <BLANKLINE>
    """
    from malta.campaigns.summary import Bounds, as_summary

    summary = as_summary(found, Bounds(published, spec))
    tables: list[Table | Paragraph] = [*_missing_text(summary), _ends_table(summary)]
    if summary.rate.passed:
        tables.append(_findings_table(summary))
    if worst and summary.runs:
        tables.append(_worst_table(summary, worst))
    return Group(*tables)


def _missing_text(found: Summary) -> list[Paragraph]:
    """A sentence on the runs that are not there yet; none of a whole campaign."""
    if found.runs >= found.plan.samples:
        return []
    done = f"{found.runs} of {found.plan.samples} runs"
    ended = ", interrupted" if found.interrupted else " so far"
    return [Paragraph(f"{done}{ended}: the figures below are of these, none is final.\n")]


def _ends_table(found: Summary) -> Table:
    from malta.campaigns.result import rate

    yields = found.yields
    table = new_table("How the runs end", "end", "runs", "share [%]", "95 % interval [%]")
    rows = {"completed": yields.completed} | {
        name: rate(count, found.runs) for name, count in found.ends.items() if name != "completed"
    }
    if yields.published is not None:
        rows["completed within the published bounds"] = yields.published
    if yields.specified is not None:
        rows["completed within the [specification]"] = yields.specified
    for name, share in rows.items():
        interval = f"{number(100 * share.low)} to {number(100 * share.high)}"
        add_row(table, name, f"{share.passed}", number(100 * share.share), interval)
    return table


def _findings_table(found: Summary) -> Table:
    from malta.campaigns.sketch import ACCURACY

    bounds = any(math.isfinite(m.published) for m in found.merits)
    heads = [*(f"{p} %" for p in PERCENTILES), "largest", *(["published", "kept [%]"] if bounds else [])]
    accuracy = "" if found.exact else f", within {100 * ACCURACY:.1g} % of their values"
    table = new_table(
        f"Figures of merit: percentiles of the completed runs{accuracy}",
        "figure",
        *heads,
    )
    for m in found.merits:
        if not m.sketch.count:
            continue
        unit = in_unit(1.0, m.unit)
        cells = [number(float(v) * unit, 3) for v in (*m.percentiles(PERCENTILES), m.sketch.largest)]
        if bounds and math.isfinite(m.published):
            bound = f"{in_unit(m.published, m.unit):.6g}"
            at_most = m.relation == "at most"
            cells += [
                f"<= {bound}" if at_most else bound,
                number(100 * m.within / found.runs) if at_most else "",
            ]
        shown = "%" if m.unit == "percent" else m.unit
        add_row(table, f"{m.label} [{shown}]", *cells, *([""] * (len(heads) - len(cells))))
    return table


PERCENTILES = (5, 50, 95, 99)


def _worst_table(found: Summary, count: int) -> Table:
    """The worst runs, each with its parameters relative to the middle of the box and its sensor errors."""
    from malta.campaigns.plan import varied_names
    from malta.campaigns.summary import worst_runs
    from malta.simulation.digest import verdicts

    plan, runs = found.plan, worst_runs(found, count)
    ends, groups = verdicts(plan.plant), lateral_outputs(plan.plant)
    far = [f"{group.name} [{group.fine}]" for group in groups]
    table = new_table("The worst runs", "run", "end", "at [ms]", *far, "off the middle of the box")
    table.columns[0].justify = "right"
    table.columns[1].justify = table.columns[-1].justify = "left"
    for row, index in enumerate(runs.index):
        values = zip(varied_names(plan), runs.values[row].tolist(), strict=True)
        add_row(
            table,
            f"{index}",
            ends[int(runs.batch.verdict[row])],
            f"{runs.batch.duration[row] * 1e3:.1f}",
            *(number(in_unit(float(runs.batch.deviation[row, g.columns].max()), g.fine), 3) for g in groups),
            " ".join(_deviation_text(plan, name, value) for name, value in values),
        )
    return table


def _deviation_text(plan: Plan, name: str, value: float) -> str:
    """A varied quantity of a run: a parameter in percent of its middle, a sensor error in its unit."""
    from malta.campaigns.statistics import unit_of

    if name in plan.spread and name not in differences(plan.parameters):
        middle = getattr(plan.parameters, name)
        return f"{name}={100 * (value / middle - 1):+.1f}%" if middle else f"{name}={value:+.3g}"
    unit = unit_of(plan, name)
    return f"{name}={in_unit(value, unit):+.2f}{'%' if unit == 'percent' else unit}"
