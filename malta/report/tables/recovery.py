"""The table of constant loads from outside: how far they move a machine, and how fast it comes back."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from malta.loops.recovery import SHARE, furthest
from malta.model.signals import FINE
from malta.report.figures.parts import number
from malta.report.tables.parts import add_row, new_table
from malta.units import in_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.table import Table

    from malta.loops.recovery import Recovery
    from malta.model.plant import Plant


def recovery_table(found: Sequence[Recovery], plant: Plant) -> Table:
    """Tabulate the output that each load moves furthest: largest deviation, what is left, settling, compliance.

    The peak over frequency is the amplitude of the output under a load of this amplitude.

    found : from `malta.recovery`
    plant : the machine

    Returns a rich Table, which `rich.print` prints.

    >>> import malta, rich
    >>> spec = malta.read_design("examples/ball/design/ball.toml")
    >>> controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    >>> found = malta.recovery(spec.plant, controller)
    >>> rich.print(malta.report.recovery_table(found, spec.plant))
    A constant load from outside, and the output that it moves furthest
    <BLANKLINE>
                               left    left     1 %
                      moves   after   after   after     peak
     load    output      by   0.1 s   0.3 s     [s]   over w   at rad/s
     ──────────────────────────────────────────────────────────────────
     1 N w   y [um]   343.4   94.98   1.722   0.266    430.5       42.8
    <BLANKLINE>
    """
    units = {s.name: s.unit for s in plant.disturbances}
    after = [f"left after {t:g} s" for t in (found[0].after if found else ())]
    heads = ("load", "output", "moves by", *after, f"{100 * SHARE:g} % after [s]", "peak over w", "at rad/s")
    table = new_table("A constant load from outside, and the output that it moves furthest", *heads)
    table.columns[1].justify = "left"
    for recovered, d in furthest(found):
        load = ", ".join(f"{size:g} {units[name]} {name}" for name, size in recovered.load.items())
        fine = FINE.get(d.unit, d.unit)
        # Below a millionth of the largest nothing is left.
        left = (value if value > 1e-6 * d.largest else 0.0 for value in d.left)
        lengths = [number(in_unit(value, fine)) for value in (d.largest, *left)]
        settled = "never" if math.isinf(d.settled) else f"{d.settled:.3g}"
        peak = number(in_unit(d.compliance, fine))
        add_row(table, load, f"{d.output} [{fine}]", *lengths, settled, peak, f"{d.frequency:.3g}")
    return table
