"""The table of the loads that a machine bears whatever their waveform, and what it is of in words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from rich.table import Table

from malta.bound import at_most
from malta.display import number, quantity
from malta.loops.loop import Loop
from malta.margins.load_sizes import COVERED, LEFT_OUT, LoadLimit
from malta.report.tables import add_row, new_sheet
from malta.units import FINE_UNITS, in_unit

HEADS = (
    ("load", "left"),
    ("any waveform, proven", "right"),
    ("beyond, it may be that", "left"),
    ("of a clearance", "right"),
    ("of a force", "right"),
    ("linear loop touches at", "right"),
)


def load_limits_table(found: Sequence[LoadLimit]) -> Table:
    """Tabulate below which size each load touches nothing and saturates nothing, whatever its waveform, and why.

    Shares of clearances and forces are the largest ones at that size. A reason stands where nothing is proven.

    found : from `malta.margins.load_limits`

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.margins.load_limits(malta.loop(spec.plant, controller))
    >>> rich.print(malta.report.load_limits_table(found))
    Any load of at most this size touches nothing and saturates nothing
    <BLANKLINE>
                  any                                                        linear
            waveform,   beyond, it may be            of a                      loop
     load      proven   that                    clearance   of a force   touches at
     ──────────────────────────────────────────────────────────────────────────────
     w        0.301 N   f may reach its limit     15.63 %      29.38 %       2.91 N
    <BLANKLINE>
    """
    share = found[0].safe.clearance if found else 1.0
    does = "touches nothing" if share == 1 else f"uses at most {100 * share:g} % of any clearance"
    heads = HEADS if share == 1 else (*HEADS[:-1], ("linear loop uses more from", "right"))
    table = new_sheet(f"Any load of at most this size {does} and saturates nothing", heads)
    for one in found:
        safe = one.safe
        proven = f"{one.proven.text()} {safe.unit}" if safe.limit is not None else "nothing"
        shares = ("", "")
        if safe.limit is not None:
            shares = _largest(safe.used.values()), _largest(safe.forces.values())
        add_row(table, safe.disturbance, proven, safe.ends, *shares, touch_text(one))
    return table


def _largest(shares: Iterable[float]) -> str:
    values = [*shares]
    return at_most(max(values)).percent() if values else ""


def touch_text(found: LoadLimit) -> str:
    """From which size on the linear loop touches, and what."""
    if math.isnan(found.touches):
        return ""
    if math.isinf(found.touches):
        return "none"
    return f"{number(found.touches, 3)} {found.safe.unit}"


def reaches_table(title: str, found: Iterable[tuple[str, str, float, str]], rms: str = "") -> Table:
    """Tabulate how far signals go at most: by what, signal, size and unit."""
    table = new_sheet(title, (("by", "left"), ("signal", "left"), ("at most", "right")))
    for by, signal, size, unit in found:
        fine = FINE_UNITS.get(unit, unit)
        add_row(table, by, signal, f"{at_most(size).text(factor=in_unit(1.0, fine))} {fine}{rms}")
    return table


def load_limits_text(found: Sequence[LoadLimit], at: str = "") -> str:
    """What is covered by these sizes and what is left out, in a paragraph.

    at : the place along the stroke, as "z = 0 mm"
    """
    proven = [one.safe for one in found if one.safe.limit is not None]
    if not proven:
        return f"Left out of what was tried to prove: {LEFT_OUT}."
    first = proven[0]
    aside = (f"{name} within {quantity(x, unit)}" for name, (x, unit) in first.aside.items())
    while_ = ", ".join([f"readings are off by at most {first.noise:g} times their noise", *aside])
    place = f" at {at}" if at else ""
    return f"Proven of {COVERED}{place}, while {while_}. Left out: {LEFT_OUT}."


def place_text(loop: Loop) -> str:
    """Where a loop is, by the states that are not zero; along a stroke always."""
    units = {s.name: s.unit for s in loop.plant.states}
    names = [loop.plant.stroke.name] if loop.plant.has_stroke else []
    names += [name for name, value in loop.at.items() if value and name not in names]
    return ", ".join(f"{name} = {quantity(loop.at.get(name, 0.0), units[name])}" for name in names)
