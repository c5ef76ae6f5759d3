"""How a result shows itself: a title and some rows, as ten lines of text or as a table with a curve in a notebook."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    FloatArray = NDArray[np.floating[Any]]

LINES = 10  # of text, the title's included
COLUMNS = 80
ROW_LENGTH = 6  # numbers that stand in a row each
PREFIXES = {-4: "p", -3: "n", -2: "u", -1: "m", 0: "", 1: "k", 2: "M", 3: "G"}
PREFIXED_UNITS = ("m", "rad", "s", "N", "A", "V", "W", "Hz", "K", "Pa", "N m")


class Curves(NamedTuple):
    """A small figure: curves over one axis, both with their units."""

    x: FloatArray
    x_label: str
    y: Mapping[str, FloatArray]  # by name, as long as x
    y_label: str
    logarithmic: bool = False  # both axes


class Description(NamedTuple):
    """What a result says of itself: a sentence, figures with their units, and perhaps curves.

    >>> print(Description("A ball, at rest", (("mass", "20 g"), ("gap", "8 mm"))))
    A ball, at rest
      mass  20 g
      gap   8 mm
    """

    title: str
    rows: tuple[tuple[str, str], ...] = ()
    curves: Curves | None = None

    def __str__(self) -> str:
        shown = self.rows if len(self.rows) < LINES else self.rows[: LINES - 2]
        width = max((len(label) for label, _ in shown), default=0)
        lines = [self.title, *(f"  {label:{width}}  {value}".rstrip() for label, value in shown)]
        if len(shown) < len(self.rows):
            lines.append(f"  and {len(self.rows) - len(shown)} more")
        return "\n".join(line if len(line) <= COLUMNS else f"{line[: COLUMNS - 3]}..." for line in lines)

    @property
    def html(self) -> str:
        """A table of all rows, and the curves as SVG."""
        rows = "".join(
            f"<tr><th style='text-align:left'>{html.escape(label)}</th>"
            f"<td style='text-align:left'>{html.escape(value)}</td></tr>"
            for label, value in self.rows
        )
        picture = "" if self.curves is None else svg(self.curves)
        return f"<div><p><b>{html.escape(self.title)}</b></p><table>{rows}</table>{picture}</div>"


T = TypeVar("T")


def display(record: type[T]) -> type[T]:
    """Let a record print as its description: `repr` in a terminal, a table in a notebook. A decorator of classes.

    A record without a `description` shows its fields.

    >>> from dataclasses import dataclass
    >>> @display
    ... @dataclass(frozen=True)
    ... class Ball:
    ...     mass: float  # kg
    ...     gaps: tuple[float, ...]  # m
    >>> Ball(0.02, (4e-3, 8e-3))
    Ball
      mass  0.02
      gaps  0.004, 0.008
    """

    def text(self: T) -> str:
        return str(_description(self))

    def table(self: T) -> str:
        return _description(self).html

    record.__repr__ = text  # type: ignore[assignment,method-assign]
    record._repr_html_ = table  # type: ignore[attr-defined]
    return record


def _description(record: Any) -> Description:
    """What a record says of itself; else its fields, but for those that have their defaults."""
    own = getattr(record, "description", None)
    if isinstance(own, Description):
        return own
    usual = getattr(record, "_field_defaults", None)
    if usual is None:
        usual = {name: field.default for name, field in record.__dataclass_fields__.items()}
    names = getattr(record, "_fields", usual)
    values = {name: getattr(record, name) for name in names}
    told = {name: value for name, value in values.items() if name not in usual or value is not usual[name]}
    return Description(type(record).__name__, tuple((name, _brief(value)) for name, value in told.items()))


def _brief(value: Any) -> str:
    """A value in a line: numbers with four digits, few of them each, many by their shape and range, records by kind."""
    if isinstance(value, float | complex):
        return f"{value:.4g}"
    if isinstance(value, str | int | Path) or value is None:
        return str(value)
    if hasattr(value, "tolist") and hasattr(value, "shape"):
        if value.ndim == 1 and value.size <= ROW_LENGTH:
            return ", ".join(map(_brief, value.tolist())) or "none"
        ends = f", {value.min():.4g} to {value.max():.4g}" if value.size and value.dtype.kind in "fiu" else ""
        return " x ".join(map(str, value.shape)) + ends
    if isinstance(value, Mapping):
        return (", ".join(value) or "none") if len(value) <= ROW_LENGTH else f"{len(value)} entries"
    if isinstance(value, tuple | list) and not hasattr(value, "_fields"):
        plain = len(value) <= ROW_LENGTH and all(
            isinstance(entry, float | int | str | complex) for entry in value
        )
        return (", ".join(map(_brief, value)) or "none") if plain else f"{len(value)} entries"
    return str(getattr(value, "name", "") or type(value).__name__)


def quantity(value: float, unit: str) -> str:
    """A value in SI with three digits and a prefix of its unit.

    >>> quantity(13.4e-6, "m"), quantity(0.36, "kg"), quantity(2, "1")
    ('13.4 um', '0.36 kg', '2')
    """
    shown, power = prefixed_unit(value, unit)
    return f"{value / 1000.0**power:.3g}" + ("" if unit == "1" else f" {shown}")


def prefixed_unit(value: float, unit: str) -> tuple[str, int]:
    """The unit with a prefix in which a value in SI has one to three digits before its point, and its power of 1000.

    >>> prefixed_unit(13.4e-6, "m"), prefixed_unit(0.36, "kg")
    (('um', -2), ('kg', 0))
    """
    if unit in PREFIXED_UNITS and math.isfinite(value) and value:
        power = math.floor((math.log10(abs(value)) + 1e-9) / 3)
        if power in PREFIXES and (unit != "rad" or power < 0):
            return f"{PREFIXES[power]}{unit}", power
    return unit, 0


def number(value: float, digits: int = 4) -> str:
    """A number with so many significant digits, without exponent; "-" for NaN."""
    if not math.isfinite(value):
        return "-" if math.isnan(value) else f"{value}"
    decimals = digits - 1 - math.floor(math.log10(abs(value))) if value else 0
    text = f"{value:.{min(max(decimals, 0), digits + 1)}f}"
    return text if float(text) else "0"


RADIANS = "rad/s (Hz)"


def frequency(w: float, digits: int = 4) -> str:
    """A frequency in rad/s with the same in Hz beside it, for a column that is headed RADIANS.

    >>> frequency(471.2)
    '471.2 (75.0)'
    """
    return f"{number(w, digits)} ({number(w / (2 * math.pi), 3)})"


def micro(text: str) -> str:
    """A text with µm for um, and other units alike."""
    return re.sub(r"\bu(?=(?:rad|[msANV])\b)", "µ", text)


def svg(curves: Curves) -> str:
    """The curves as an SVG element: lines that differ in grey and dashes, axes with units."""
    from matplotlib.figure import Figure  # here: few results are shown in a notebook

    figure = Figure(figsize=(5.5, 2.4), layout="constrained")
    axes: Any = figure.add_subplot()
    dashes = ("-", "--", "-.", ":")
    for k, (name, y) in enumerate(curves.y.items()):
        grey = str(0.6 * (k % 3) / 2)
        axes.plot(curves.x, y, dashes[k % len(dashes)], color=grey, linewidth=1, label=name)
    if curves.logarithmic:
        axes.set(xscale="log", yscale="log")
    axes.set(xlabel=curves.x_label, ylabel=curves.y_label)
    axes.grid(visible=True, color="0.9")
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1, 0.5))
    file = io.StringIO()
    figure.savefig(file, format="svg")
    return file.getvalue().partition("\n<svg")[2].join(("<svg", ""))
