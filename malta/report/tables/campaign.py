"""Tables of a campaign: how its runs end, percentiles of their figures of merit, the worst runs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group
from rich.table import Table

from malta.model.parameters import differences
from malta.model.signals import (
    lateral_outputs,
)
from malta.report.figures.parts import Published, number
from malta.report.tables.parts import add_row, new_table
from malta.units import in_unit

if TYPE_CHECKING:
    from malta.campaigns.result import Campaign
    from malta.synthesis.spec import Spec


def box_text(found: Campaign) -> str:
    """The parameters that a campaign varies, with their half-widths."""
    from malta.campaigns.statistics import spread_text

    spreads: dict[str, list[str]] = {}
    for name in (*found.plan.spread, *found.plan.sensor_spread):
        spreads.setdefault(spread_text(found.plan, name), []).append(name)
    return ", ".join(f"{' '.join(names)} {width}" for width, names in spreads.items())


def campaign_tables(
    found: Campaign, published: Published | None = None, worst: int = 5, spec: Spec | None = None
) -> Group:
    """How the runs of a campaign end, their figures of merit beside the published bounds, and the worst runs.

    spec : the design whose [specification] bounds the runs as well
    """
    tables: list[Table | str] = [_ends_table(found, published, spec)]
    if found.completed.any():
        tables.append(_findings_table(found, published))
    if worst and len(found.index):
        tables.append(_worst_table(found, worst))
    return Group(*tables)


def _ends_table(found: Campaign, published: Published | None, spec: Spec | None) -> Table:
    from malta.campaigns.result import rate
    from malta.campaigns.yields import yields_of

    yields, runs = yields_of(found, published, spec), len(found.index)
    table = new_table("How the runs end", "end", "runs", "share [%]", "95 % interval [%]")
    rows = {"completed": yields.completed} | {
        name: rate(count, runs) for name, count in found.ends.items() if name != "completed"
    }
    if yields.published is not None:
        rows["completed within the published bounds"] = yields.published
    if yields.specified is not None:
        rows["completed within the [specification]"] = yields.specified
    for name, share in rows.items():
        interval = f"{number(100 * share.low)} to {number(100 * share.high)}"
        add_row(table, name, f"{share.passed}", number(100 * share.share), interval)
    return table


def _findings_table(found: Campaign, published: Published | None) -> Table:
    from malta.campaigns.statistics import figures_of

    listed = figures_of(found, published)
    bounds = any(math.isfinite(f.published) for f in listed)
    heads = [*(f"{p} %" for p in PERCENTILES), "largest", *(["published", "kept [%]"] if bounds else [])]
    table = new_table("Figures of merit: percentiles of the completed runs", "figure", *heads)
    table.columns[0].no_wrap = True
    for f in listed:
        values = in_unit(1.0, f.unit) * f.values[np.isfinite(f.values)]
        if not values.size:
            continue
        cells = [number(float(v), 3) for v in (*np.percentile(values, PERCENTILES), values.max())]
        if bounds and math.isfinite(f.published):
            bound = f"{in_unit(f.published, f.unit):.6g}"
            at_most = f.relation == "at most"
            cells += [
                f"<= {bound}" if at_most else bound,
                number(100 * float(f.within.mean())) if at_most else "",
            ]
        unit = "%" if f.unit == "percent" else f.unit
        add_row(table, f"{f.label} [{unit}]", *cells, *([""] * (len(heads) - len(cells))))
    return table


PERCENTILES = (5, 50, 95, 99)


def _worst_table(found: Campaign, count: int) -> Table:
    """The worst runs, each with its parameters relative to the middle of the box and its sensor errors."""
    from malta.campaigns.statistics import worst_of
    from malta.simulation.digest import verdicts

    plant = found.plan.plant
    names, groups = verdicts(plant), lateral_outputs(plant)
    far = [f"{group.name} [{group.fine}]" for group in groups]
    table = new_table("The worst runs", "run", "end", "at [ms]", *far, "off the middle of the box")
    table.columns[0].justify = "right"
    table.columns[1].justify = table.columns[-1].justify = "left"
    for row in worst_of(found, count):
        off = [_deviation_text(found, row, k) for k in range(len(found.names))]
        add_row(
            table,
            f"{found.index[row]}",
            names[int(found.batch.verdict[row])],
            f"{found.batch.duration[row] * 1e3:.1f}",
            *(number(in_unit(float(found.batch.deviation[row, g.columns].max()), g.fine), 3) for g in groups),
            " ".join(off),
        )
    return table


def _deviation_text(found: Campaign, row: int, k: int) -> str:
    """The k-th varied quantity of a run: a parameter in percent of its middle, a sensor error in its unit."""
    from malta.campaigns.statistics import unit_of

    name, value = found.names[k], float(found.values[row, k])
    if name in found.plan.spread and name not in differences(found.plan.parameters):
        middle = getattr(found.plan.parameters, name)
        return f"{name}={100 * (value / middle - 1):+.1f}%" if middle else f"{name}={value:+.3g}"
    unit = unit_of(found.plan, name)
    return f"{name}={in_unit(value, unit):+.2f}{'%' if unit == 'percent' else unit}"
