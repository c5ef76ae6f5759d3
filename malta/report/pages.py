"""Records -> pages: tables for a terminal of 100 columns, and the figures of figures/, saved."""

from __future__ import annotations

import inspect
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text
from scipy.optimize import linear_sum_assignment

from malta.margins.verify import (
    BANDWIDTHS,
    NOT_BETWEEN,
    NOT_PROVEN,
    Margins,
    zone,
)
from malta.model.data import in_unit, published_value
from malta.model.linearize import LinearModel
from malta.model.signals import (
    aside,
    compliance_unit,
    stiffness_unit,
)
from malta.report.figures import distributions_figure as distributions_figure
from malta.report.figures import experiment_figure as experiment_figure
from malta.report.figures import front_figure as front_figure
from malta.report.figures import save as save
from malta.report.figures import stroke_figure as stroke_figure
from malta.report.figures import worst_figure as worst_figure
from malta.report.figures import yield_figure as yield_figure
from malta.report.figures.margins import chain_figure as chain_figure
from malta.report.figures.parts import STYLES as STYLES
from malta.report.figures.parts import UNITS, Published, front_lines, number, read_out
from malta.simulation.catalogue import experiments_of, options_of
from malta.simulation.experiments import setting
from malta.simulation.trajectory import Trajectory
from malta.synthesis.lqg import continuous_poles
from malta.synthesis.requirements import Trade, requirements_for
from malta.synthesis.spec import Spec

if TYPE_CHECKING:
    from malta.campaigns.result import Campaign
    from malta.margins.extent import Extent
    from malta.margins.gain import Gain
    from malta.margins.robust import Margin
    from malta.margins.stages import Robustness
    from malta.model.plant import ComplexArray, FloatArray, Plant
    from malta.report.ledger import Ledger
    from malta.simulation.experiments import Experiment, Merit
    from malta.tuning.outcomes import Outcome
    from malta.tuning.tune import Tuned


# --- pages ---


def poles_table(model: LinearModel, published: Published | None) -> Table:
    """Open-loop poles by mode, beside Table I where it applies."""
    n = len(model.A) // 2
    if not model.plant.second_order or np.any(model.A[n:, n:]):  # damped: no pairs of opposite poles
        table = _table("Open-loop poles [rad/s]", "of", "poles")
        poles = np.linalg.eigvals(model.A).astype(complex)
        _row(table, "ours", _pole_text(np.where(np.abs(poles) < 1e-9 * np.abs(poles).max(), 0, poles)))
        return table
    names, squares = _modes(model)
    table = _table("Open-loop poles [rad/s]", "mode", *names)
    _row(table, "ours, +-", *(f"{math.sqrt(abs(s)):.2f}{'j' if s < 0 else ''}" for s in squares))
    at_centre = not np.any(model.operating_point.x)
    if _prints(published, "table_I", "poles") and at_centre:
        printed = [published_value(published, f"table_I.poles.{name}") for name in names]
        digits = published["table_I"]["digits"]
        _row(table, "Table I, +-", *(f"{value:.{digits}f}" for value in printed))
    return table


def _prints(published: Published | None, table: str, key: str) -> TypeGuard[Published]:
    return published is not None and key in published.get(table, {})


def loop_poles_table(margins: Margins, continuous: Mapping[str, ComplexArray] | None = None) -> Table:
    """Poles of the continuous design, if given, and of the sampled loop as s-plane values."""
    table = _table("Poles [rad/s]; of sampled systems ln(lambda) / Ts", "of", "poles")
    for what, poles in (continuous or {}).items():
        _row(table, what, _pole_text(poles))
    for what, key in (
        ("sampled regulator", "regulator"),
        ("sampled Kalman filter", "filter"),
        ("closed loop of the machine", "closed_loop"),
    ):
        if (found := getattr(margins.poles, key)).size:
            _row(table, what, _pole_text(found))
    return table


def bandwidth_table(margins: Margins, published: Published | None) -> Table:
    """Bandwidths by definition; a paper may give one figure and no definition."""
    table = _table("Bandwidth by definition", "definition", "rad/s", "Hz")
    for key, meaning in BANDWIDTHS.items():
        if key not in margins.bandwidth:  # a machine or a law without natural frequencies
            continue
        value = margins.bandwidth[key]
        _row(table, meaning, f"{value:.1f}", f"{value / (2 * math.pi):.2f}")
    if _prints(published, "position_controller", "bandwidth"):
        value = read_out(published, "position_controller.bandwidth", "rad/s")
        _row(table, "published, without a definition", f"about {value:.0f}", f"{value / (2 * math.pi):.0f}")
    return table


def sensitivity_table(margins: Margins) -> Table:
    """Peak sensitivity at each sensor with its ISO 14839-3 zone, stage by stage."""
    sensors = [k for k in margins.peak_sensitivity if k != "sigma_max"]
    table = _table(
        "Peak sensitivity (ISO 14839-3 zone: A < 3, B < 4, C < 5)", "loop", *sensors, "sigma_max", "at rad/s"
    )
    for stage in margins.stages:
        peaks = [f"{stage.peak_sensitivity[s]:.2f} {zone(stage.peak_sensitivity[s])}" for s in sensors]
        _row(
            table,
            stage.name,
            *peaks,
            f"{stage.peak_sensitivity['sigma_max']:.2f}",
            f"{stage.peak_frequency:.3g}",
        )
    return table


def chain_table(found: Robustness) -> Table:
    """Parametric margin and peak sensitivity, stage by stage."""
    table = _table(
        "Where the margin goes: multiples of the uncertainty that no parameter set may exceed",
        "stage", "proven", "lost at", "rad/s", "first to give", "peak |S|", "of",
    )  # fmt: skip
    for link in found.chain:
        peak = "unstable" if math.isnan(link.peak) else f"{link.peak:.2f}"
        if link.broken_at == "sensors" and not math.isnan(link.peak):
            peak += f" {zone(link.peak)}"
        _row(table, link.name, *_margin_cells(link.margin), _blame(link.margin), peak, link.broken_at)
    if found.extent.intervals:
        _row(table, _everything(found), *_margin_cells(found.travel), _blame(found.travel), "", "")
    return table


def _everything(found: Robustness) -> str:
    """What the margin over the extent covers, as a row of a table."""
    if not _everywhere(found.travel):
        return "middle and end of it"
    parts = ["all of the travel"] if found.extent.stroke else []
    return ", ".join([*parts, found.extent.values] if found.extent.over else parts)


def _margin_cells(margin: Margin) -> tuple[str, str, str]:
    if margin is NOT_PROVEN:
        return "not asked", "", ""
    low = "nothing" if margin.lower is None else f"{100 * margin.lower:.2f} %"
    high = "not found" if margin.exhausted else f"{100 * margin.upper:.2f} %"
    return low, high, "" if margin.frequency is None else f"{margin.frequency:.4g}"


def _blame(margin: Margin) -> str:
    """The parameters that pull hardest, and which way they went."""
    if margin.witness is None:
        return "" if margin is NOT_PROVEN else margin.reason
    largest = sorted(margin.sensitivity, key=lambda name: -margin.sensitivity[name])
    return " ".join(
        f"{name}{'+' if margin.moved[name] > 0 else '-'}"
        for name in largest
        if margin.sensitivity[name] > 0.02
    )


def disk_table(found: Robustness, Ts: float) -> Table:
    """Disk margins of the machine's loop, and the delay that each sensor's loop stands."""
    table = _table(
        f"Margins of the sampled loop without parameters{_least_along(found)}",
        "factor in",
        "disk",
        "gain",
        "phase [deg]",
        "rad/s",
    )
    for disk in found.disks:
        _row(
            table,
            disk.channels,
            f"{disk.size:.3f}",
            f"{1 / disk.gain:.2f} .. {disk.gain:.2f}",
            f"+-{math.degrees(disk.phase):.1f}",
            f"{disk.frequency:.4g}",
        )
    for name, delay in found.delay.items():
        _row(table, f"delay at {name} alone", *_delay_cells(delay, Ts), "", "")
    return table


def _least_along(found: Robustness) -> str:
    """Which of the places a figure is of, where there are several."""
    course = found.extent.course
    along = "along the travel" if found.extent.stroke else f"of {len(found.places)} values of {course}"
    return f", the smallest {along}" if course else ""


def _delay_cells(delay: float, Ts: float) -> tuple[str, str]:
    if math.isnan(delay):
        return "unstable", ""
    return (f"{delay * 1e6:.0f} us", f"{delay / Ts:.1f} samples") if math.isfinite(delay) else ("any", "")


def gang_table(found: Robustness, plant: Plant) -> Table:
    """Gang of four: the largest gain of each closed-loop response, by sensor."""
    units = {signal.name: signal.unit for signal in plant.outputs}
    one = next(iter(set(units.values()))) if len(set(units.values())) == 1 else ""
    heads = (f" [{per(one)}]" if one else "" for per in (compliance_unit, stiffness_unit))
    extent = found.extent
    title = f"Gang of four, largest over frequency{f' and {_course(extent)}' if extent.course else ''}"
    forces = (f"{what}{unit}" for what, unit in zip(("from force |SP|", "to force |FS|"), heads, strict=True))
    table = _table(title, "sensor", "|S|", "|T|", *forces)
    for name, (S, T, PS, FS) in found.gang.items():
        unit = units[name]
        cells = f"{PS * 1e6:.1f}", f"{FS * 1e-6:.3f}"
        if not one:
            cells = f"{cells[0]} {compliance_unit(unit)}", f"{cells[1]} {stiffness_unit(unit)}"
        _row(table, name, f"{S:.2f}", f"{T:.2f}", *cells)
    return table


def _course(extent: Extent) -> str:
    return "travel" if extent.stroke else extent.course


def tolerance_table(found: Robustness, uncertainty: Mapping[str, float]) -> Table:
    """What each parameter may do alone, proven, and its share in the margin of all."""
    anywhere = ["anywhere in the travel"] if found.extent.stroke else []
    anywhere += [f"for {found.extent.values}"] if found.extent.over else []
    where = " and ".join(anywhere) if _everywhere(found.travel) else "in its middle and at its end"
    table = _table(
        f"One at a time, proven {where}".rstrip(), "parameter", "down to", "up to", "share in the margin"
    )
    shares = found.chain[-1].margin.sensitivity
    for name, (down, up) in found.tolerance.items():
        cells = []
        for margin, sign in ((down, -1), (up, 1)):
            t = margin.lower
            change = "nothing proven" if t is None else f"{100 * sign * t * uncertainty[name]:+.1f} %"
            cells.append(f"{change} and further" if t is not None and margin.exhausted else change)
        _row(table, name, *cells, f"{100 * shares.get(name, 0):.0f} %")
    if found.payload is not None:
        t = found.payload.lower
        more = " and more" if found.payload.exhausted else ""
        _row(table, "payload", "", "nothing proven" if t is None else f"{t:.3g} kg{more}", "")
    return table


def worst_case_table(gains: Mapping[str, Gain]) -> Table:
    """The largest |S| of each sensor over the modelled box and all that the margin covers, found and proven."""
    title = "Worst-case peak |S| over the uncertainty and all that the margin covers"
    table = _table(title, "sensor", "found", "at rad/s", "proven below", "zone")
    for name, gain in gains.items():
        high = "nothing proven" if gain.upper is None else f"{gain.upper:.3f}"
        _row(table, name, f"{gain.lower:.3f}", f"{gain.frequency:.4g}", high, zone(gain.upper or math.inf))
    return table


def places_table(found: Robustness, Ts: float) -> Table:
    """The machine's loop along the travel, in which it is even, or along the first parameter that runs."""
    extent = found.extent
    if not extent.stroke:
        title = f"Along {extent.course}" if extent.course else "The machine's loop"
    elif _everywhere(found.travel):
        title = "Along the travel, either way"
    else:
        title = "In the middle of the travel and at its ends (margin: at the positive one)"
    table = _table(
        title,
        f"at [{'mm' if extent.stroke else extent.unit}]" if extent.course else "at",
        "proven",
        "lost at",
        "rad/s",
        "peak |S|",
        "disk, all",
        "delay",
    )
    for place in found.places:
        peak = "unstable" if math.isnan(place.peak) else f"{place.peak:.2f} {zone(place.peak)}"
        _row(
            table,
            f"{place.position * 1e3:.1f}" if extent.stroke else _at(extent, place.position),
            *_margin_cells(place.margin),
            peak,
            "none" if math.isnan(place.disk) else f"{place.disk:.3f}",
            ", ".join(cell for cell in _delay_cells(place.delay, Ts) if cell),
        )
    return table


def _at(extent: Extent, position: float) -> str:
    return f"{position:.4g}" if extent.course else "its values"


def design_page(
    spec: Spec, model: LinearModel, margins: Margins, flown: Experiment, published: Published | None
) -> Group:
    """One readable page about a design, and what it does in the machine's main job."""
    made = f"{spec.discretization}, {_sampled(spec.sample_time)}, delay {spec.delay} in the design model"
    if spec.pid is not None:
        made = f"PID, {_sampled(spec.sample_time)}"
    return Group(
        Text(f"{spec.name}: {spec.summary}", style="bold"),
        f"{model.plant.name}, preset {spec.parameters.preset}, {made}",
        "",
        poles_table(model, published),
        loop_poles_table(margins, continuous_poles(model, spec.weights) if spec.pid is None else None),
        bandwidth_table(margins, published),
        sensitivity_table(margins),
        *([] if margins.robust is None else [_travel_text(margins)]),
        experiment_table(flown, published),
    )


def _travel_text(margins: Margins) -> Text:
    box_text = " ".join(f"{name} +-{100 * share:g} %" for name, share in margins.uncertainty.items())
    assert margins.robust is not None
    where = str(margins.extent).replace("the travel", "the whole travel")
    if not _everywhere(margins.robust):
        where = "in the middle and at the end of the travel"
    return Text(f"{f'Parametric margin {where}'.rstrip()} ({box_text}): {margins.robust}\n")


def _everywhere(margin: Margin) -> bool:
    """Whether a margin of the travel is one of all positions, or of places alone."""
    return NOT_BETWEEN not in margin.reason


def _sampled(Ts: float) -> str:
    return f"{1e-3 / Ts:g} kHz" if Ts <= 1e-3 else f"a sample every {Ts * 1e3:g} ms"


def limits_text(e: Experiment) -> list[str]:
    """The limits that runs met on the way, a line for each set of them."""
    met: dict[tuple[str, ...], list[str]] = {}
    for case in e.cases:
        met.setdefault(case.run.limits, []).append(case.label)
    return [f"met the {' and the '.join(names)}: {', '.join(cases)}" for names, cases in met.items() if names]


def experiment_table(e: Experiment, published: Published | None = None) -> Group:
    """What an experiment found: its cases, and its figures of merit beside the published ones.

    Of several cases whose figures nothing sums up, as steps of one output after the other, every one has its row.
    """
    if len(e.cases) > 1 and e.merits is e.cases[0].merits:
        return Group(_cases_table(e, published))
    tables = []
    if [merit.label for merit in e.merits] != [merit.label for merit in e.cases[0].merits]:
        tables.append(_cases_table(e, published))
    if e.merits:
        tables.append(_merits_table("" if tables else e.question, e.merits, published))
    return Group(*tables)


def _merits_table(title: str, merits: Sequence[Merit], published: Published | None) -> Table:
    """A row for each figure."""
    if published is None or not any(merit.published for merit in merits):
        table = _table(title, "figure", "ours")
        for merit in merits:
            _row(table, _named(merit), _shown(merit))
        return table
    table = _table(title, "figure", "ours", "published")
    for merit in merits:
        _row(table, _named(merit), _shown(merit), _printed(merit, published))
    return table


def _cases_table(e: Experiment, published: Published | None) -> Table:
    """A row for each case, or a column where there are many figures; one below the other where they differ."""
    fullest = max((case.merits for case in e.cases), key=len)
    labels = [merit.label for merit in fullest]
    if any(merit.label not in labels for case in e.cases for merit in case.merits):
        return _listed(e)
    if len(labels) > COLUMNS:
        return _transposed(e, fullest)
    ended = any(not case.run.verdict.completed for case in e.cases)
    heads = ["verdict", "at [ms]"] if ended else []
    table = _table(e.question, "case", *heads, *map(_named, fullest))
    longest = max(len(case.label) for case in e.cases)
    table.columns[0].no_wrap = longest <= WORDY
    if ended:
        table.columns[1].justify = "left"
    for case in e.cases:
        end, found = case.run.verdict, {merit.label: _shown(merit) for merit in case.merits}
        ends = [end.name, f"{end.time * 1e3:.1f}"] if ended else []
        _row(table, case.label, *ends, *(found.get(label, "-") for label in labels))
    if published is not None and any(merit.published for merit in fullest):
        table.add_section()
        _row(table, "published", *("" for _ in heads), *(_printed(merit, published) for merit in fullest))
    return table


COLUMNS = 6  # figures of merit beside each other, at most
WORDY = 44  # letters of a case's name that stay in one line


def _transposed(e: Experiment, fullest: Sequence[Merit]) -> Table:
    table = _table(e.question, "figure", *(case.label for case in e.cases))
    found = [{merit.label: _shown(merit) for merit in case.merits} for case in e.cases]
    ends = [case.run.verdict for case in e.cases]
    _row(table, "verdict", *(end.name for end in ends))
    _row(table, "at [ms]", *(f"{end.time * 1e3:.1f}" for end in ends))
    for merit in fullest:
        _row(table, _named(merit), *(values.get(merit.label, "-") for values in found))
    return table


def _listed(e: Experiment) -> Table:
    table = _table(e.question, "case", "figure", "ours")
    table.columns[0].no_wrap = table.columns[1].no_wrap = True
    table.columns[1].justify = "left"
    for case in e.cases:
        end = case.run.verdict
        _row(table, case.label, "verdict", f"{end.name} at {end.time * 1e3:.1f} ms")
        for merit in case.merits:
            _row(table, "", _named(merit), _shown(merit))
    return table


def scenarios_table(plant: Plant, flown: Collection[str] | None = None) -> Table:
    """What a machine can be asked for, with the options that each experiment has of its own."""
    table = _table(
        f"Scenarios of the machine {plant.name!r}", "scenario", "what is run", "options of its own"
    )
    table.columns[1].justify = table.columns[2].justify = "left"
    for name, run in experiments_of(plant).items():
        if flown is None or name in flown:
            what = (inspect.getdoc(run) or "").partition("\n\n")[0]
            _row(table, name, " ".join(what.split()), "\n".join(_options(name, plant)))
    return table


def _options(name: str, plant: Plant) -> list[str]:
    units, shown = setting(plant, "OPTION_UNITS", {}), []
    for option, default in options_of(name, plant).items():
        values = default if isinstance(default, tuple) else (default,)
        text = ",".join(str(v).lower() if isinstance(v, bool) else f"{v}" for v in values)
        shown.append(f"{option}={text} {units.get(option, '')}".rstrip())
    return shown


def claims_table(ledger: Ledger) -> Table:
    """The ledger of published numbers."""
    table = _table(
        f"Published numbers and ours: {ledger.title}", "claim", "published", *ledger.designs, "verdict"
    )
    table.columns[-1].justify = "left"
    for claim in ledger.claims:
        _row(table, claim.subject, claim.published, *claim.ours, claim.verdict)
    return table


def box_text(found: Campaign) -> str:
    """What was varied, and how far either way."""
    from malta.campaigns.statistics import spread_text

    spreads: dict[str, list[str]] = {}
    for name in (*found.plan.spread, *found.plan.sensor_spread):
        spreads.setdefault(spread_text(found.plan, name), []).append(name)
    return ", ".join(f"{' '.join(names)} {width}" for width, names in spreads.items())


def campaign_tables(found: Campaign, published: Published | None = None, worst: int = 5) -> Group:
    """How the runs of a campaign end, their figures of merit beside the published bounds, and the worst runs."""
    tables: list[Table | str] = [_ends_table(found, published)]
    if found.completed.any():
        tables.append(_findings_table(found, published))
    if worst and len(found.index):
        tables.append(_worst_table(found, worst))
    return Group(*tables)


def _ends_table(found: Campaign, published: Published | None) -> Table:
    from malta.campaigns.result import rate
    from malta.campaigns.statistics import runs_within_bounds

    within, runs = runs_within_bounds(found, published), len(found.index)
    table = _table("How the runs end", "end", "runs", "share [%]", "95 % interval [%]")
    rows = {"completed": found.rate} | {
        name: rate(count, runs) for name, count in found.ends.items() if name != "completed"
    }
    if within is not None:
        rows["completed within the published bounds"] = rate(int(within.sum()), runs)
    for name, share in rows.items():
        interval = f"{number(100 * share.low)} to {number(100 * share.high)}"
        _row(table, name, f"{share.passed}", number(100 * share.share), interval)
    return table


def _findings_table(found: Campaign, published: Published | None) -> Table:
    from malta.campaigns.statistics import figures_of

    listed = figures_of(found, published)
    bounds = any(math.isfinite(f.published) for f in listed)
    heads = [*(f"{p} %" for p in PERCENTILES), "largest", *(["published", "kept [%]"] if bounds else [])]
    table = _table("Figures of merit: percentiles of the completed runs", "figure", *heads)
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
        _row(table, f"{f.label} [{unit}]", *cells, *([""] * (len(heads) - len(cells))))
    return table


PERCENTILES = (5, 50, 95, 99)


def _worst_table(found: Campaign, count: int) -> Table:
    """The worst runs, each with what it was flown with: parameters off the middle of the box, errors of the sensors."""
    from malta.campaigns.statistics import worst_of
    from malta.simulation.digest import verdicts

    plant = found.plan.plant
    names, groups = verdicts(plant), aside(plant)
    far = [f"{group.name} [{group.fine}]" for group in groups]
    table = _table("The worst runs", "run", "end", "at [ms]", *far, "off the middle of the box")
    table.columns[0].justify = "right"
    table.columns[1].justify = table.columns[-1].justify = "left"
    for row in worst_of(found, count):
        off = [_off(found, row, k) for k in range(len(found.names))]
        _row(
            table,
            f"{found.index[row]}",
            names[int(found.batch.verdict[row])],
            f"{found.batch.duration[row] * 1e3:.1f}",
            *(number(in_unit(float(found.batch.deviation[row, g.columns].max()), g.fine), 3) for g in groups),
            " ".join(off),
        )
    return table


def _off(found: Campaign, row: int, k: int) -> str:
    from malta.campaigns.statistics import unit_of

    name, value = found.names[k], float(found.values[row, k])
    if name in found.plan.spread:
        middle = getattr(found.plan.parameters, name)
        return f"{name}={100 * (value / middle - 1):+.1f}%" if middle else f"{name}={value:+.3g}"
    unit = unit_of(found.plan, name)
    return f"{name}={in_unit(value, unit):+.2f}{'%' if unit == 'percent' else unit}"


def _named(merit: Merit) -> str:
    unit = {"percent": "%", "1": ""}.get(merit.unit, merit.unit)
    return f"{merit.label} [{unit}]" if unit else merit.label


def _shown(merit: Merit) -> str:
    count = merit.unit == "1" and merit.value.is_integer()
    return f"{merit.value:.0f}" if count else number(in_unit(merit.value, merit.unit))


def _printed(merit: Merit, published: Published) -> str:
    if not merit.published:
        return ""
    value = f"{read_out(published, merit.published, merit.unit):.6g}"
    return f"<= {value}" if merit.relation == "at most" else value


def requirements_table(requirements: Sequence[Outcome]) -> Table:
    """What a design was asked for, what it has, and how near each limit is."""
    table = _table("Requirements", "requirement", "asked", "found", "of the limit", "", "from")
    for r in requirements:
        scale, unit = UNITS.get(r.unit, (1.0, ""))
        found = f"{r.found * scale:.4g} {unit}".rstrip()
        if r.asked is None:
            _row(table, r.name.replace("_", " "), "least", found, "", "", r.how)
            continue
        bound = ">=" if r.at_least else "<="
        _row(
            table,
            r.name.replace("_", " "),
            f"{bound} {r.asked * scale:.4g} {unit}".rstrip(),
            found,
            f"{100 * r.ratio:.1f} %",
            "holds" if r.holds else "FAILS",
            r.how,
        )
    return table


def _front_columns(tuned: Tuned) -> dict[str, tuple[str, float, str]]:
    """What the front holds of each trial: heading, factor, unit."""
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
    """The Pareto front as headings and cells: a row for each trial, the chosen one with a star."""
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
    """Margin against force noise against motion, by margin."""
    heads, rows = front_rows(tuned)
    table = _table("What the margin costs (* chosen)", *heads)
    for row in rows:
        _row(table, *row)
    return table


def front_markdown(tuned: Tuned) -> str:
    """The same table for a page."""
    heads, rows = front_rows(tuned)
    lines = ["| " + " | ".join(row) + " |" for row in (heads, ["---:"] * len(heads), *rows)]
    return "\n".join([*lines, ""])


def front(tuned: Tuned, path: str | Path) -> Path:
    """Draw the Pareto front."""
    return save(front_figure(tuned), path)


def _table(title: str, *columns: str) -> Table:
    heading = Text(title)  # a Text, because [ms] is markup to rich
    table = Table(title=heading, title_justify="left", title_style="", box=box.SIMPLE_HEAD, pad_edge=False)
    for i, column in enumerate(columns):
        table.add_column(Text(column), justify="left" if i == 0 or column == "poles" else "right")
    return table


def _row(table: Table, *cells: str) -> None:
    table.add_row(*map(Text, cells))


def _modes(model: LinearModel) -> tuple[list[str], FloatArray]:
    """Squares of the pairs of poles +-value, each by the position that moves most in it."""
    names = [s.name for s in model.plant.design_states[: len(model.stiffness)]]
    squares, shapes = np.linalg.eig(model.stiffness)
    participation = np.abs(shapes * np.linalg.inv(shapes).T)  # of position i in mode j, free of units
    _, mode = linear_sum_assignment(-participation)
    found = squares.real[mode]
    return names, np.where(np.abs(found) < 1e-12 * np.abs(found).max(initial=0.0), 0.0, found)


def _pole_text(poles: ComplexArray) -> str:
    """Poles in one line: conjugate pairs once, repeated ones counted."""
    counted: dict[str, int] = {}
    for pole in poles:
        if pole.imag < -1e-6 * abs(pole):
            continue
        real = f"{pole.real:.4g}"
        text = f"{real}+-{pole.imag:.4g}j" if pole.imag > 1e-6 * abs(pole) else real
        counted[text] = counted.get(text, 0) + 1
    return "  ".join(text if count == 1 else f"{text} (x{count})" for text, count in counted.items())


# --- saved figures ---


def stroke(run: Trajectory, path: str | Path | None = None, published: Published | None = None) -> Path:
    """Draw a stroke, or a run, and save it, as build/NAME_SCENARIO.png if no path is given."""
    return save(stroke_figure(run, published), _default(run, run.scenario.name) if path is None else path)


def experiment(e: Experiment, path: str | Path | None = None, published: Published | None = None) -> Path:
    """Draw an experiment and save it, as build/NAME_EXPERIMENT.png if no path is given."""
    return save(experiment_figure(e, published), _default(e.run, e.name) if path is None else path)


def _default(run: Trajectory, name: str) -> Path:
    return Path("build") / f"{run.controller.name}_{name}.png"


def robustness(
    found: Robustness,
    name: str,
    uncertainty: Mapping[str, float],
    path: str | Path,
    position: str = "position",
    worst: Mapping[str, Gain] | None = None,
) -> Path:
    """Draw where the margin of a design goes; arguments as `chain_figure` takes them."""
    return save(chain_figure(found, name, uncertainty, position, worst), Path(path))


def campaign(found: Campaign, folder: str | Path, published: Published | None = None) -> list[Path]:
    """Draw what a campaign found: distributions.png, yield.png and worst.png in a folder."""
    return [
        save(draw(found, published), Path(folder) / name)
        for name, draw in (
            ("distributions.png", distributions_figure),
            ("yield.png", yield_figure),
            ("worst.png", worst_figure),
        )
    ]
