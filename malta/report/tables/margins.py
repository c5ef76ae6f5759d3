"""Tables of a robustness analysis: margins stage by stage and along the travel, disks, tolerances, worst cases."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

from rich.table import Table

from malta.arguments import is_number
from malta.bound import at_least, at_most
from malta.display import RADIANS, frequency, number
from malta.margins.loop_report import LoopReport, zone
from malta.margins.outcome import near_limits
from malta.model.parameters import box_words
from malta.model.signal_groups import axis_units
from malta.proof.margin import NOT_PROVEN, Margin, unproven
from malta.report.tables import Paragraph, add_row, new_table
from malta.report.tables.design import (
    bandwidth_table,
    loop_poles_table,
    recovery_table,
    requirements_table,
    sensitivity_table,
)

if TYPE_CHECKING:
    from malta.loops.classical import Disk
    from malta.margins.travel import Extent
    from malta.margins.unmodelled import UnmodelledMargin
    from malta.proof.blocks.gain import Gain
    from malta.report.figures.drawing import Published
    from malta.synthesis.spec import Spec

PROVEN_HEADINGS = ("proven", "lost at", "rad/s", "first to give")  # of a proof; no room for Hz
WAYS = ("down", "up")
SHOWN_NEAR_LIMITS = 3  # requirements that are named though they hold


def loop_tables(
    found: LoopReport, published: Published | None = None, spec: Spec | None = None
) -> Iterator[Table | Paragraph]:
    """Tabulate all that is known of a loop, as `malta verify` prints it.

    found : from `malta.verify`; without `stages` what is linear alone
    published : figures of the machine's paper, from `malta.model.read_published`; None: none
    spec : the design file, whose requirements were judged; None: none

    Returns an iterator of what `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True, spec=spec)
    >>> tables = list(malta.report.loop_tables(found, None, spec))
    >>> rich.print(tables[-1])
    Requirements of examples/ball/design/ball.toml: 4 of 4 hold; nearest their
    limits peak sensitivity 98.38 %, margin 93.58 %, motion y 54.32 %.
    <BLANKLINE>
    """
    yield loop_poles_table(found)
    yield bandwidth_table(found, published)
    yield sensitivity_table(found)
    if found.recovery:
        yield recovery_table(found.recovery, found.plant)
    if found.chain:
        yield from _margin_tables(found)
    if found.worst:
        yield worst_case_table(found.worst)
    if found.unmodelled is not None:
        yield Paragraph(unmodelled_text(found.unmodelled) + "\n")
    if spec is not None:
        yield from _requirements(found, spec)


def _margin_tables(found: LoopReport) -> Iterator[Table | Paragraph]:
    """The margins of the stages, over the travel and of each parameter, and what they leave open."""
    yield Paragraph(f"Uncertainty: {box_words(found.uncertainty, found.plant.parameters)}\n")
    yield chain_table(found)
    if missing := found.left_out:
        yield Paragraph(f"Not in the last stage: {missing}\n")
    if bounds := open_bounds(found):
        yield Paragraph("\n".join(bounds) + "\n")
    yield disk_table(found)
    yield gang_table(found)
    if found.tolerance or found.mass is not None or found.payload is not None:
        yield tolerance_table(found)
    yield places_table(found)


def _requirements(found: LoopReport, spec: Spec) -> Iterator[Table | Paragraph]:
    """The requirements of the design file that do not hold, then how many do; nothing where none was judged."""
    asked = [one for one in found.requirements if one.asked is not None]
    if not asked:
        return
    failed = [one for one in asked if not one.holds]
    if failed:
        yield requirements_table(failed)
    text = f"Requirements of {spec.path}: {len(asked) - len(failed)} of {len(asked)} hold"
    if near := near_limits(asked, SHOWN_NEAR_LIMITS):
        text += f"; nearest their limits {near}"
    judged = {one.name for one in found.requirements}
    others = [name.replace("_", " ") for name in spec.specification if name not in judged]
    if others:
        text += f". Not judged here: {', '.join(others)} (malta tune {spec.path} --check)"
    if spec.sha256 != found.controller.spec_sha256:
        text += ". The design file was changed after the gain file was written"
    yield Paragraph(f"{text}.\n")


def chain_table(found: LoopReport) -> Table:
    """Tabulate the parametric margin and the peak sensitivity of each stage, from the ideal loop to the machine's.

    The machine of the last stages is under its loads, in its margins and in `|S|`.

    found : from `malta.verify`, with `stages`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> rich.print(malta.report.chain_table(found))
    Where the margin goes: margin in multiples of the uncertainty box, 100 % is the
    box
    <BLANKLINE>
                                              first
                                                 to   peak
     stage       proven     lost at   rad/s    give    |S|   zone                of
     ──────────────────────────────────────────────────────────────────────────────
     LQR       499.94 %   not found                   1.00                   forces
     LQI       499.94 %   not found                   1.00                   forces
     LQG       390.33 %    390.34 %    1006      m-   1.60      A           sensors
     LQGI      386.27 %    386.28 %    1010      m-   1.64      A           sensors
     sampled   390.69 %    390.70 %    1047      m-   1.57      A   sensors, loaded
    <BLANKLINE>
    """
    proven = any(link.margin is not NOT_PROVEN for link in found.chain)
    table = new_table(
        "Where the margin goes: margin in multiples of the uncertainty box, 100 % is the box" if proven
        else "Peak sensitivity by stage",
        "stage", *(PROVEN_HEADINGS if proven else ()), "peak |S|", "zone", "of",
    )  # fmt: skip
    for link in found.chain:
        unstable = math.isnan(link.peak)
        sensed = link.broken_at == "sensors" and not unstable
        add_row(
            table,
            link.name,
            *(_proof_cells(link.margin) if proven else ()),
            "unstable" if unstable else f"{link.peak:.2f}",
            zone(link.peak) if sensed else "",
            f"{link.broken_at}, loaded" if link.loaded else link.broken_at,
        )
    if found.extent.intervals and proven:
        add_row(table, _coverage_text(found), *_proof_cells(found.travel), "", "", "")
    return table


def _proof_cells(margin: Margin) -> tuple[str, ...]:
    """The cells of a margin under the headings PROVEN_HEADINGS."""
    return *_margin_cells(margin), _limiting_parameters(margin)


def open_bounds(found: LoopReport) -> list[str]:
    """Say why a bound is not proven, and where a search ended that found no unstable machine: a line for each.

    found : from `malta.verify`, with `stages`

    >>> import malta
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> malta.report.open_bounds(found)[0].rpartition("; ")[2]
    'no unstable machine found up to t = 5, where m reaches its limit 0'
    """
    margins = [(link.name, link.margin) for link in found.chain]
    margins += [(_coverage_text(found), found.travel)] if found.extent.intervals else []
    unit = " mm" if found.extent.stroke else ""
    margins += [(f"at {position_text(found.extent, p.position)}{unit}", p.margin) for p in found.places]
    alone = [
        (f"{name} {way}", m)
        for name, both in found.tolerance.items()
        for way, m in zip(WAYS, both, strict=True)
    ]
    alone += [] if found.mass is None else [("mass margin", found.mass)]
    said = [(name, str(m)) for name, m in margins if m is not NOT_PROVEN and (m.lower is None or m.exhausted)]
    said += [(name, unproven(m.reason)) for name, m in alone if m.lower is None]
    said += [(f"|S| of {name}", str(gain)) for name, gain in found.worst.items() if gain.upper is None]
    together: dict[str, list[str]] = {}  # margins of loops that do not depend on the place are the same
    for name, text in said:
        together.setdefault(text, []).append(name)
    return [f"{', '.join(names)}: {text}" for text, names in together.items()]


def _coverage_text(found: LoopReport) -> str:
    """The positions and parameters that the margin over the extent covers, as a row of a table."""
    if not found.covers_travel:
        return found.places_covered if found.controller.schedule is not None else "middle and end of it"
    parts = ["all of the travel"] if found.extent.stroke else []
    return ", ".join([*parts, found.extent.values] if found.extent.over else parts)


def _margin_cells(margin: Margin) -> tuple[str, str, str]:
    """Proven share, share at which the loop is lost, frequency in rad/s."""
    if margin is NOT_PROVEN:
        return "not asked", "", ""
    low = f"{margin.proven.percent()} so far" if margin.time_up else margin.proven.percent()
    return low, margin.lost.percent(), "" if margin.frequency is None else f"{margin.frequency:.4g}"


def _limiting_parameters(margin: Margin) -> str:
    """The parameters that the margin depends on most, with the sign of their change; or why nothing is proven."""
    if margin.witness is None:
        return "" if margin is NOT_PROVEN else margin.reason
    largest = sorted(margin.sensitivity, key=lambda name: -margin.sensitivity[name])
    return " ".join(
        f"{name}{'+' if margin.moved[name] > 0 else '-'}"
        for name in largest
        if margin.sensitivity[name] > 0.02
    )


def disk_table(found: LoopReport) -> Table:
    """Tabulate disk margins of the machine's loop, and the delay margin of each sensor's loop.

    found : from `malta.verify`, with `stages`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> rich.print(malta.report.disk_table(found))
    Margins of the sampled loop without parameters
    <BLANKLINE>
     factor in               disk           gain   phase [deg]     rad/s (Hz)
     ────────────────────────────────────────────────────────────────────────
     forces                 0.810   0.42 .. 2.36         ±44.1   66.57 (10.6)
     sensors                0.810   0.42 .. 2.36         ±44.1   66.57 (10.6)
     forces and sensors     0.401   0.67 .. 1.50         ±22.6   295.3 (47.0)
     y alone                0.810   0.42 .. 2.36         ±44.1   66.57 (10.6)
     delay at y alone     2719 µs   13.6 samples
    <BLANKLINE>
    """
    table = new_table(f"Margins of the sampled loop without parameters{_places_text(found)}", *DISKS)
    for row in disk_rows(found.disks, found.delay, found.controller.sample_time):
        add_row(table, *row)
    return table


DISKS = ("factor in", "disk", "gain", "phase [deg]", RADIANS)


def disk_rows(
    disks: Iterable[Disk], delays: Mapping[str, float], Ts: float, *, joined: bool = False
) -> Iterator[tuple[str, ...]]:
    """Rows under the headings DISKS; joined: a delay and its samples stand in one cell."""
    for disk in disks:
        gain, phase = f"{1 / disk.gain:.2f} .. {disk.gain:.2f}", f"±{math.degrees(disk.phase):.1f}"
        yield disk.channels, f"{disk.size:.3f}", gain, phase, frequency(disk.frequency)
    for name, delay in delays.items():
        cells = _delay_cells(delay, Ts)
        both = (", ".join(filter(None, cells)), "") if joined else cells
        yield f"delay at {name} alone", *both, "", ""


def _places_text(found: LoopReport) -> str:
    """The end of a title: the places of which a table has the smallest value."""
    course = found.extent.course
    along = "along the travel" if found.extent.stroke else f"of {len(found.places)} values of {course}"
    return f", the smallest {along}" if course else ""


def _delay_cells(delay: float, Ts: float) -> tuple[str, str]:
    """A delay margin (s) as time and in samples."""
    if math.isnan(delay):
        return "unstable", ""
    text = f"{delay * 1e6:.0f} us" if delay < 0.1 else f"{delay:.3g} s"
    return (text, f"{delay / Ts:.1f} samples") if math.isfinite(delay) else ("any", "")


def gang_table(found: LoopReport) -> Table:
    """Tabulate the gang of four: the largest gains of S, T, PS and FS at each sensor.

    found : from `malta.verify`, with `stages`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> rich.print(malta.report.gang_table(found))
    Gang of four, largest over frequency
    <BLANKLINE>
     sensor    |S|    |T|   from force |SP| [µm/N]   to force |FS| [N/µm]
     ────────────────────────────────────────────────────────────────────
     y        1.57   1.72                    430.5                0.03418
    <BLANKLINE>
    """
    outputs, forces_of = found.plant.outputs, found.plant.inputs
    last = len(forces_of) - 1
    units = {s.name: axis_units(s.unit, forces_of[min(k, last)].unit) for k, s in enumerate(outputs)}
    same = next(iter(units.values())) if len(set(units.values())) == 1 else None
    heads = (f" [{unit}]" for unit in same[:2]) if same else ("", "")
    extent = found.extent
    title = f"Gang of four, largest over frequency{f' and {_course_text(extent)}' if extent.course else ''}"
    forces = (f"{what}{unit}" for what, unit in zip(("from force |SP|", "to force |FS|"), heads, strict=True))
    table = new_table(title, "sensor", "|S|", "|T|", *forces)
    for name, (S, T, PS, FS) in found.gang.items():
        unit = units[name]
        scale = 1e6 if unit.micro else 1.0
        cells = number(scale * PS), number(FS / scale)
        if not same:
            over, under = ("" if of == "1" else f" {of}" for of in unit[:2])
            cells = f"{cells[0]}{over}", f"{cells[1]}{under}"
        add_row(table, name, f"{S:.2f}", f"{T:.2f}", *cells)
    return table


def _course_text(extent: Extent) -> str:
    """The word for the travel, or for the parameter in its place."""
    return "travel" if extent.stroke else extent.course


def tolerance_table(found: LoopReport) -> Table:
    """Tabulate the proven range of each parameter alone, and its share in the margin of all together.

    The mass margin is that of the linear loop; the payload below it is bounded by limits of forces and by simulation.

    found : from `malta.verify`, with `stages`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> rich.print(malta.report.tolerance_table(found))
    One at a time, proven
    <BLANKLINE>
                                                                   share in the
     parameter                   down to                   up to         margin
     ──────────────────────────────────────────────────────────────────────────
     m                          -78.13 %   +633.88 % and further          100 %
     mass margin, linear loop                 0.6338 kg and more
     payload held at rest                              0.6339 kg
    <BLANKLINE>
    """
    anywhere = ["anywhere in the travel"] if found.extent.stroke else []
    anywhere += [f"for {found.extent.values}"] if found.extent.over else []
    own = "in its middle and at its end" if found.controller.schedule is None else found.places_covered
    where = " and ".join(anywhere) if found.covers_travel else own
    table = new_table(
        f"One at a time, proven {where}".rstrip(), "parameter", "down to", "up to", "share in the margin"
    )
    shares = found.chain[-1].margin.sensitivity
    for name, (down, up) in found.tolerance.items():
        cells = []
        for margin, sign in ((down, "-"), (up, "+")):
            proven = margin.lower is not None
            share = found.uncertainty[name]
            change = (
                f"{sign}{margin.proven.percent(share)}"
                if is_number(share)
                else f"{margin.proven.percent()} of it"
            )
            change = change if proven else "nothing proven"
            cells.append(f"{change} and further" if proven and margin.exhausted else change)
        add_row(table, name, *cells, f"{100 * shares.get(name, 0):.0f} %")
    if found.mass is not None:
        more = " and more" if found.mass.exhausted else ""
        shown = "nothing proven" if found.mass.lower is None else f"{found.mass.proven.text()} kg{more}"
        add_row(table, "mass margin, linear loop", "", shown, "")
    payload = found.payload
    if payload is not None:
        held = at_least(payload.held).text()
        add_row(table, "payload held at rest", "", held if held == "any" else f"{held} kg", "")
        if not math.isnan(payload.carried):
            dropped = "" if math.isinf(payload.dropped) else f", not {at_most(payload.dropped).text()}"
            add_row(table, "payload in flight", "", f"{at_least(payload.carried).text()} kg{dropped}", "")
    return table


def worst_case_table(gains: Mapping[str, Gain]) -> Table:
    """Tabulate the largest `|S|` of each sensor over all that the margin covers: found, and proven upper bound.

    gains : by sensor, from `malta.worst_case_gain`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> def spring(k):
    ...     return [[0, 1], [-k, -1]], [[0], [1]], [[1, 0]]
    >>> system = malta.uncertain(spring, {"k": 4.0})
    >>> gain = malta.worst_case_gain(system, [[-5.0]], {"k": 0.2})
    >>> rich.print(malta.report.worst_case_table({"y": gain}))
    Worst-case peak |S| over the uncertainty and all that the margin covers
    <BLANKLINE>
     sensor   found   at rad/s (Hz)   proven below   zone
     ────────────────────────────────────────────────────
     y        2.105   3.026 (0.482)          2.112      A
    <BLANKLINE>
    """
    title = "Worst-case peak |S| over the uncertainty and all that the margin covers"
    table = new_table(title, "sensor", "found", f"at {RADIANS}", "proven below", "zone")
    for name, gain in gains.items():
        found, at = (
            ("unstable", "") if math.isinf(gain.lower) else (gain.reached.text(), frequency(gain.frequency))
        )
        proven = "nothing proven" if gain.upper is None else gain.proven.text()
        reached = zone(gain.lower if gain.upper is None else gain.upper)
        worse = " or worse" if gain.upper is None and reached != zone(math.inf) else ""
        add_row(table, name, found, at, proven, reached + worse)
    return table


def unmodelled_text(found: UnmodelledMargin) -> str:
    """Say how large the margin with unmodelled dynamics is, what W is, and what is assumed.

    found : of a LoopReport, `unmodelled`
    """
    sizes = ", ".join(
        f"{at_most(size).percent()} at {w / (2 * math.pi):.4g} Hz" for w, size in found.sizes.items()
    )
    return (
        f"Unmodelled dynamics: {found.verdict}. Margin of parameters and of W together: {found.margin}; the box of "
        f"all parameters needs {at_most(found.needed).percent()}. |W|, of order {found.order}: {sizes}. "
        f"Assumed: {found.assumed}."
    )


def places_table(found: LoopReport) -> Table:
    """Tabulate margins of the machine's loop along the travel, where each holds at a position and at its negative.

    A machine without a travel has the first parameter that its proofs cover in its place.

    found : from `malta.verify`, with `stages`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.verify(spec.plant, controller, {"m": 0.2}, stages=True)
    >>> rich.print(malta.report.places_table(found))
    The machine's loop, under its loads
    <BLANKLINE>
                                            peak        disk,
     at            proven   lost at  rad/s   |S|  zone    all         delay
     ──────────────────────────────────────────────────────────────────────
     its values  390.69 %  390.70 %   1047  1.57     A  0.401      2719 µs,
                                                               13.6 samples
    <BLANKLINE>
    """
    extent = found.extent
    if not extent.stroke:
        title = f"Along {extent.course}" if extent.course else "The machine's loop"
    elif found.covers_travel:
        title = "Along the travel, either way"
    else:
        title = "In the middle of the travel and at its ends (margin: at the positive one)"
    proven = any(place.margin is not NOT_PROVEN for place in found.places)
    title += ", under its loads"
    table = new_table(
        title,
        f"at [{'mm' if extent.stroke else extent.unit}]" if extent.course else "at",
        *(PROVEN_HEADINGS[:3] if proven else ()),
        "peak |S|",
        "zone",
        "disk, all",
        "delay",
    )
    for place in found.places:
        unstable = math.isnan(place.peak)
        add_row(
            table,
            position_text(extent, place.position),
            *(_margin_cells(place.margin) if proven else ()),
            "unstable" if unstable else f"{place.peak:.2f}",
            "" if unstable else zone(place.peak),
            "none" if math.isnan(place.disk) else f"{place.disk:.3f}",
            ", ".join(cell for cell in _delay_cells(place.delay, found.controller.sample_time) if cell),
        )
    return table


def position_text(extent: Extent, position: float) -> str:
    """A place along the travel, mm, or along a parameter."""
    if extent.stroke:
        return f"{round(position * 1e3, 6):.4g}"
    return f"{position:.4g}" if extent.course else "its values"
