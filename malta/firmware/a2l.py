"""ASAP2 description (1.7) of a tunable controller: its parameters as CHARACTERISTIC, what it commands as MEASUREMENT.

Addresses are symbol links with offsets: the parameters are those of <name>_default_parameters, the measurements those
of the variables `out` and `supervisor` of the program, as in <name>_example.c. A linker's map makes them numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from malta.firmware.calibration import FNV_START, counts_of, monitor_titles, parameters_of
from malta.firmware.ctext import c_name
from malta.firmware.export import comment, render
from malta.firmware.signals import Field, Target, output_fields, reading_ranges
from malta.firmware.supervisor import MONITORS, STATES, TIMES, monitors_of

WIDE = 1e12  # of a measurement without a limit
WHOLE = 4  # bytes of an int32_t


class Entry(NamedTuple):
    """A number in the target's memory."""

    name: str
    meaning: str
    unit: str
    factor: float  # the number times this is in the unit
    low: float  # in the unit
    high: float
    symbol: str
    offset: int  # bytes
    kind: str = "REAL"  # or LONG, ULONG
    table: str = ""  # words for its values


def a2l_text(t: Target, name: str) -> str:
    """The text of <name>.a2l. name : the controller's, as a C identifier"""
    entries = list(_parameters(t, name))
    measured = [*_outputs(t), *_supervision()]
    known = dict.fromkeys((e.unit, e.factor) for e in (*entries, *measured) if not e.table)
    methods = {key: f"conversion_{k}" for k, key in enumerate(known, 1)}
    return render(
        "parameters.a2l",
        {
            "name": name,
            "title": comment(t.controller.name).replace('"', "'"),
            "real": "FLOAT64_IEEE" if t.precision == "double" else "FLOAT32_IEEE",
            "methods": [
                {"name": title, "unit": unit, "factor": repr(factor)}
                for (unit, factor), title in methods.items()
            ],
            "characteristics": [_shown(e, methods) for e in entries],
            "measurements": [_shown(e, methods) for e in measured],
            "states": list(enumerate(STATES)),
            "monitors": [(-1, "NONE"), *enumerate(MONITORS)],
        },
    )


def _shown(e: Entry, methods: dict[tuple[str, float], str]) -> dict[str, Any]:
    return e._asdict() | {
        "meaning": comment(e.meaning).replace('"', "'"),
        "method": e.table or methods[e.unit, e.factor],
        "low": repr(float(e.low)),
        "high": repr(float(e.high)),
    }


def _bytes(t: Target) -> int:
    return 8 if t.precision == "double" else 4


def _labels(field: Field) -> list[str]:
    """A name for each number of a field, which is a C identifier."""
    if field.size == 1 and not field.signals[0].name:
        return [field.name]
    labels = [f"{field.name}.{c_name(s.name.replace('*', ''))}" for s in field.signals]
    if len(set(labels)) < len(labels):
        return [f"{field.name}.entry_{k}" for k in range(field.size)]
    return labels


def _parameters(t: Target, name: str) -> Iterator[Entry]:
    """The record of parameters, in its order."""
    symbol, at = f"{name}_default_parameters", 0
    for p in parameters_of(t):
        factor, own = p.shown or (1.0, "")
        ranges = np.stack([p.least, p.most]) * factor
        for label, signal, low, high in zip(_labels(p.field), p.field.signals, *ranges, strict=True):
            unit = own or ("" if signal.unit in ("SI", "1") else signal.unit)
            yield Entry(label, p.field.meaning, unit, factor, low, high, symbol, at)
            at += _bytes(t)
    for title, most in zip(monitor_titles(monitors_of(t)), counts_of(t), strict=True):
        words = "samples in a row until a monitor acts"
        yield Entry(f"samples.{c_name(title)}", words, "", 1.0, 1, most, symbol, at, "LONG")
        at += WHOLE
    words = f"FNV-1a, from 0x{FNV_START:08x}, over the bytes of the record before it"
    yield Entry("checksum", words, "", 1.0, 0, 2**32 - 1, symbol, at, "ULONG")


def _outputs(t: Target) -> Iterator[Entry]:
    """What a step commands and estimates."""
    c, at = t.controller, 0
    most = {
        "y_used": reading_ranges(t.believed),
        "v": np.asarray(c.limits.force, dtype=float),
        "current": np.broadcast_to(c.limits.current, len(t.believed.actuator.coils)),
    }
    for field in output_fields(t):
        limits = np.minimum(most.get(field.name, np.full(field.size, WIDE)), WIDE)
        for label, signal, limit in zip(_labels(field), field.signals, limits, strict=True):
            unit = "" if signal.unit in ("SI", "1") else signal.unit
            is_share = field.name in ("refused", "saturated", "met")
            low, high = (0.0, 1.0) if is_share else (-limit, limit)
            yield Entry(label, field.meaning, unit, 1.0, low, high, "out", at)
            at += _bytes(t)


def _supervision() -> Iterator[Entry]:
    """What a supervisor says; its record begins with its times."""
    at = WHOLE * len(TIMES)
    tables = {"state": "state_names", "enable": "", "monitor": "monitor_names", "reaction": ""}
    for k, (key, table) in enumerate(tables.items()):
        low, high = (-1, len(MONITORS)) if key == "monitor" else (0, len(STATES))
        words = "of the supervisor"
        yield Entry(
            f"supervisor.{key}", words, "", 1.0, low, high, "supervisor", at + WHOLE * k, "LONG", table
        )
