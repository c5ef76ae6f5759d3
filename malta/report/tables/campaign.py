"""Tables of a campaign: how its runs end, percentiles of their figures of merit, the worst runs."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from rich.console import Group
from rich.table import Table

from malta.model.parameters import differences
from malta.model.signal_groups import lateral_outputs
from malta.report.figures.drawing import Published, number
from malta.report.tables import Paragraph, add_row, digits_of, end_cell, new_table
from malta.simulation.engine.digest import verdicts
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.campaigns.plan import Plan
    from malta.campaigns.rare import RareEvent
    from malta.campaigns.result import Campaign, Rate
    from malta.campaigns.studies import Index, Sensitivity, Spread, Tolerances
    from malta.campaigns.summary import Summary
    from malta.synthesis.spec import Spec


def run_text(plan: Plan) -> str:
    """What each machine of a plan does: its scenario, with the case, and the fidelity."""
    from malta.campaigns.plan import planned_run

    wanted = planned_run(plan)
    case = "" if wanted.label == plan.scenario else f" ({wanted.label})"
    return f"{plan.scenario}{case}, fidelity {wanted.scenario.fidelity}"


def box_text(plan: Plan) -> str:
    """The parameters that a plan varies, with their half-widths: "m ±10 %, K_A ±5 %"."""
    from malta.campaigns.result import spread_text

    spreads: dict[str, list[str]] = {}
    for name in (*plan.spread, *plan.sensor_spread):
        spreads.setdefault(spread_text(plan, name), []).append(name)
    return ", ".join(f"{' '.join(names)} {width}" for width, names in spreads.items())


def campaign_tables(
    found: Campaign | Summary, published: Published | None = None, worst: int = 5, spec: Spec | None = None
) -> Group:
    """Tabulate how the runs of a campaign end, their figures of merit beside the published bounds, and the worst runs.

    found : the campaign, or its summary
    published : figures of the machine's paper, from `malta.model.read_published`; None: none; a summary has its own
    worst : number of the worst runs that are listed
    spec : the design whose [specification] bounds the runs as well; a summary has its own

    Returns a rich Group of tables, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", {"m": 0.1}, samples=8, options=short
    ... )
    >>> tables = malta.report.campaign_tables(malta.campaign(plan, workers=1))
    >>> rich.print(tables.renderables[0])
    How the runs end
    <BLANKLINE>
     end         runs   share [%]   95 % interval [%]
     ────────────────────────────────────────────────
     completed      8       100.0      63.06 to 100.0
    <BLANKLINE>
    """
    from malta.campaigns.summary import RunLimits, as_summary

    summary = as_summary(found, RunLimits(published, spec))
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
    from malta.campaigns.summary import ACCURACY

    bounds = any(m.merit.bound is not None for m in found.merits)
    heads = [*(f"{p} %" for p in PERCENTILES), "largest", *(["published", "kept [%]"] if bounds else [])]
    accuracy = "" if found.exact else f", within {100 * ACCURACY:.1g} % of their values"
    table = new_table(f"Figures of merit: percentiles of the completed runs{accuracy}", "figure", *heads)
    for m in found.merits:
        if not m.sketch.count:
            continue
        unit = in_unit(1.0, m.merit.unit)
        cells = [digits_of(float(v) * unit, 3) for v in (*m.percentiles(PERCENTILES), m.sketch.largest)]
        if m.merit.bound is not None:
            bound = f"{in_unit(m.merit.bound, m.merit.unit):.6g}"
            at_most = m.merit.relation == "at most"
            cells += [
                f"<= {bound}" if at_most else bound,
                number(100 * m.within / found.runs) if at_most else "",
            ]
        add_row(table, m.merit.heading, *cells, *([""] * (len(heads) - len(cells))))
    return table


PERCENTILES = (5, 50, 95, 99)


def _worst_table(found: Summary, count: int) -> Table:
    """The worst runs, each with its parameters relative to the middle of the box and its sensor errors."""
    from malta.campaigns.plan import varied_names
    from malta.campaigns.summary import worst_runs

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
            end_cell(ends[int(runs.batch.verdict[row])], completed=runs.batch.verdict[row] == 0),
            f"{runs.batch.duration[row] * 1e3:.1f}",
            *(
                digits_of(in_unit(float(runs.batch.deviation[row, g.columns].max()), g.fine), 3)
                for g in groups
            ),
            " ".join(_deviation_text(plan, name, value) for name, value in values),
        )
    return table


def _deviation_text(plan: Plan, name: str, value: float) -> str:
    """A varied quantity of a run: a parameter in percent of its middle, a sensor error in its unit."""
    from malta.campaigns.result import unit_of

    if name in plan.spread and name not in differences(plan.parameters):
        middle = getattr(plan.parameters, name)
        return f"{name}={100 * (value / middle - 1):+.1f}%" if middle else f"{name}={value:+.3g}"
    unit = unit_of(plan, name)
    return f"{name}={in_unit(value, unit):+.2f}{'%' if unit == 'percent' else unit}"


# Tables of the studies on a campaign's box: rare events, sensitivities, tolerances.


def rare_event_tables(event: RareEvent) -> Group:
    """Tabulate the probability of a rare event with its interval, the repetitions behind it, and its design point.

    event : from `malta.campaigns.rare_event`

    Returns a rich Group of tables, which `rich.print` prints.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> box = {"m": 0.2}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=2000, options=short
    ... )
    >>> limit = malta.campaigns.limit_of(plan, "deviation-y", 40e-6)
    >>> event = malta.campaigns.rare_event(plan, limit, workers=1)
    >>> tables = malta.report.rare_event_tables(event).renderables
    >>> [str(table.title) for table in tables][:2]
    ['Rare event: deviation y above 40 um or an earlier end', 'Repetitions: 1 is the limit']
    """
    parts: list[Table | str] = [_probability_table(event), _repetitions_table(event)]
    if event.design_point is not None:
        parts.append(_design_point_table(event))
    return Group(*parts)


def rare_event_sentence(event: RareEvent) -> str:
    """What is known of a rare event where no run failed; "" where runs failed."""
    found = event.found
    if found.reached:
        return ""
    _, high = found.interval()
    failed, count = sum(one.reached for one in found.repetitions), len(found.repetitions)
    runs = f"runs failed in {failed} of {count} repetitions alone" if failed else "no run failed"
    below = "" if failed else f"; the most severe of {found.simulated} runs reached {found.worst:.3g}"
    return f"{runs}: {event.limit.text} has a probability below {high:.2g}{below}"


def _probability_table(event: RareEvent) -> Table:
    found = event.found
    table = new_table(f"Rare event: {event.limit.text}", "", "")
    table.show_header = False
    if not found.reached:
        add_row(table, "probability", f"below {found.interval()[1]:.2g}")
        add_row(table, "simulated runs", f"{found.simulated}")
        return table
    low, high = found.interval()
    add_row(table, "probability", f"{found.probability:.3g}")
    add_row(table, "coefficient of variation [%]", f"{100 * found.cov:.3g}")
    add_row(table, "95 % interval", f"{low:.3g} to {high:.3g}")
    add_row(table, "simulated runs", f"{found.simulated}")
    add_row(table, "plain sampling needs, for the same coefficient", f"{found.plain:.2g}")
    return table


def _repetitions_table(event: RareEvent) -> Table:
    """One row for each repetition; a severity of 1 is the limit."""
    heads = ("repetition", "levels", "runs", "accepted [%]", "last severity", "passed [%]", "probability")
    table = new_table("Repetitions: 1 is the limit", *heads)
    table.columns[0].justify = "right"
    for k, one in enumerate(event.found.repetitions):
        last, rates = one.levels[-1], [level.acceptance for level in one.levels[1:]]
        accepted = f"{100 * sum(rates) / len(rates):.0f}" if rates else ""
        counts = f"{k + 1}", f"{len(one.levels)}", f"{one.simulated}"
        below = "" if one.reached else "below "
        shares = f"{last.threshold:.4g}", f"{100 * last.share:.3g}", f"{below}{one.probability:.3g}"
        add_row(table, *counts, accepted, *shares)
    return table


def _design_point_table(event: RareEvent) -> Table:
    """The machine of the design point: each value, and how far it is off the middle."""
    from malta.campaigns.plan import half_width

    plan, point = event.plan, event.design_point
    assert point is not None
    title = f"Design point: {point.end} at {point.time * 1e3:.1f} ms, {point.distance:.3g} standard deviations off"
    table = new_table(title, "parameter", "value", "off the middle [% of the spread]")
    for name, value in point.values.items():
        half = half_width(plan, name)
        middle = getattr(plan.parameters, name) if name in plan.spread else 0.0
        off = f"{100 * (value - middle) / half:+.1f}" if half else "0"
        add_row(table, name, value_text(plan, name, value), off)
    return table


def sensitivity_tables(found: Sensitivity) -> Group:
    """Tabulate total and first-order Sobol indices of the yield and of each figure of merit, by what varies.

    found : from `malta.campaigns.sensitivity`

    Returns a rich Group of tables, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> options = {"duration": 0.02, "noise": 0.0}
    >>> box = {"m": 0.2, "C": 0.2}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=64, options=options
    ... )
    >>> found = malta.campaigns.sensitivity(
    ...     plan, malta.campaigns.limit_of(plan, "touchdown"), workers=1
    ... )
    >>> rich.print(malta.report.sensitivity_tables(found).renderables[0])
    yield: 100 % (89.11 to 100 %) of the machines without touchdown; 64 runs
    """
    said = f"yield: {share_text(found.within)} of the machines {found.limit.kept}; {found.runs} runs"
    parts: list[Table | Paragraph] = [Paragraph(said)]
    if not (found.of_yield or any(found.of_merits.values())):
        return Group(*parts)
    parts.append(_index_table("Total indices: a parameter, alone and with others", found, total=True))
    parts.append(_index_table("First-order indices: a parameter alone", found, total=False))
    return Group(*parts)


def sensitivity_sentence(found: Sensitivity) -> str:
    """Why figures have no indices; "" where all have."""
    if not found.of_yield:
        every = "every" if found.within.share == 1 else "no"
        return f"{every} run is {found.limit.kept}: the yield has no indices"
    if not all(found.of_merits.values()):
        return "figures that some runs have no value of, as they were not completed, have no indices"
    return ""


def _index_table(title: str, found: Sensitivity, *, total: bool) -> Table:
    table = new_table(f"{title}, with 95 % intervals", "figure", *found.factors)

    def cell(index: Index) -> str:
        value, half = (index.total, index.total_half) if total else (index.first, index.first_half)
        return f"{max(value, 0.0):.2f} ±{half:.2f}" if abs(value) < 0.005 else f"{value:.2f} ±{half:.2f}"

    for label, indices in {"yield": found.of_yield, **found.of_merits}.items():
        if indices:
            add_row(table, label, *map(cell, indices))
    return table


def spreads_table(found: Tolerances) -> Table:
    """Tabulate the largest spread of each parameter that keeps the wanted yield, beside today's.

    found : from `malta.campaigns.tolerances`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> short = {"duration": 0.02}  # s
    >>> box = {"m": 0.1}
    >>> plan = malta.campaigns.Plan(
    ...     controller, "disturbance", box, samples=20, options=short
    ... )
    >>> limit = malta.campaigns.limit_of(plan, "deviation-y", 50e-6)
    >>> found = malta.campaigns.tolerances(plan, limit, 0.95, workers=1)
    >>> table = malta.report.spreads_table(found)
    >>> [str(column.header) for column in table.columns][:4], table.row_count
    (['parameter', 'today', 'largest', 'times'], 1)
    """
    from malta.campaigns.result import spread_text

    wanted = f"{100 * found.wanted:.6g} %"
    title = f"Largest spreads that keep {wanted} {found.limit.kept}; today {share_text(found.today)}"
    table = new_table(title, "parameter", "today", "largest", "times", "yield [%]", "95 % interval [%]")
    for spread in found.spreads:
        alone = spread.name in found.plan.spread or spread.name in found.plan.sensor_spread
        today = spread_text(found.plan, spread.name) if alone else ""
        if spread.within is None:
            add_row(table, spread.name, today, "none", "0", "", "")
            continue
        more = ">= " if spread.factor == spread.widest else ""
        times = f"{more}{spread.factor:.3g}"
        largest = more + spread_text(_with_spread(found, spread), spread.name) if alone else ""
        interval = f"{100 * spread.within.low:.4g} to {100 * spread.within.high:.4g}"
        add_row(table, spread.name, today, largest, times, f"{100 * spread.within.share:.4g}", interval)
    return table


def tolerance_sentence(found: Tolerances) -> str:
    """The parameters that keep the yield again with a wider spread; "" for none."""
    names = " ".join(spread.name for spread in found.spreads if not spread.monotone)
    return f"a wider spread keeps the yield again: {names}" if names else ""


def _with_spread(found: Tolerances, spread: Spread) -> Plan:
    """The plan with the largest spread of one parameter."""
    plan = found.plan
    own = {name: width * (spread.factor if name == spread.name else 1) for name, width in plan.spread.items()}
    errors = plan.sensor_spread
    wider = {name: width * (spread.factor if name == spread.name else 1) for name, width in errors.items()}
    return replace(plan, spread=own, sensor_spread=wider)


def share_text(share: Rate) -> str:
    """A rate in percent with its interval."""
    return f"{100 * share.share:.4g} % ({100 * share.low:.4g} to {100 * share.high:.4g} %)"


def value_text(plan: Plan, name: str, value: float) -> str:
    """A varied value with its unit."""
    from malta.campaigns.result import unit_of

    unit = unit_of(plan, name)
    return f"{in_unit(value, unit):.6g} {'%' if unit == 'percent' else unit}"
