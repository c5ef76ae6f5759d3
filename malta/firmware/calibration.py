"""Parameters of an exported controller that its target may change: gains, limits, references and monitors.

They are members of one constant record, which the C reads from a pointer in the state. A record counts when its
checksum fits and every number is in its range: limits and references at most what they are in the gain file, monitors
at least as strict, and gains those for which the margin stays proven: rows of K and Ki times a factor for each axis.
Where nothing is proven, gains are within SCATTER of those of the gain file.
"""

from __future__ import annotations

import math
import textwrap
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.firmware.ctext import c_number, c_numbers
from malta.firmware.signals import CField, Target
from malta.firmware.supervisor import Monitor, monitors_of, reference_limits
from malta.model.plant import Signal
from malta.synthesis.law import gains_of
from malta.units import unit_factor

SCATTER = 0.1  # share of each gain by which it may differ, either way
TOLERANCES = {
    "double": 1e-9,
    "float": 1e-6,
}  # of a gain: rounding by which entries with one factor may differ
MIN_LIMIT_SHARE = 0.01  # share of a limit or of a reference that is left at least
FNV_START, FNV_FACTOR = 0x811C9DC5, 0x01000193
GAINS = ("K", "Ki", "L")
LAW = (*GAINS, "force_limit", "current_limit", "Kp", "Ki_current")  # of what a step computes with


class RecordMember(NamedTuple):
    """A member of the record with its numbers and the range of each."""

    field: CField
    values: FloatArray
    least: FloatArray
    most: FloatArray
    shown: tuple[float, str] | None = None  # factor and unit of a calibration tool; None: the number itself


@lru_cache(maxsize=16)
def parameters_of(t: Target) -> tuple[RecordMember, ...]:
    """The real members of the record, in its order; none of a target that is not tunable.

    parameters_of(Target(controller, tunable=True))[0].field.name
    """
    return (*_law_parameters(t), *_reference_parameters(t), _thresholds(t)) if t.tunable else ()


def proven_share(t: Target) -> float | None:
    """The share by which the factors of the axes' gains may differ from 1, in whole per mille; None: nothing proven."""
    if t.gains is None or t.gains.share is None:
        return None
    return math.floor(1000 * t.gains.share) / 1000


def axes_of_rows(t: Target, name: str) -> list[int]:
    """The axis whose factor each entry of K or Ki takes, in the order of the record."""
    assert t.gains is not None
    axis = {force: k for k, forces in enumerate(t.gains.axes) for force in forces}
    gain = gains_of(t.controller)[name]
    rows = gain.sparsity().get_triplet()[0]
    return [axis[row] for row, yes in zip(rows, is_tunable(gain), strict=True) if yes]


def law_fields(t: Target) -> list[CField]:
    """The members with which a step computes; none of a target that is not tunable."""
    return [p.field for p in parameters_of(t) if p.field.name in LAW]


def law_values(t: Target) -> dict[str, Any]:
    """Their numbers by name, in the precision of the target."""
    return {p.field.name: p.values.astype(t.real) for p in parameters_of(t) if p.field.name in LAW}


def counts_of(t: Target) -> list[int]:
    """For each row of the table of monitors, the samples in a row until it acts: whole numbers of the record."""
    return [row.samples for row in monitors_of(t)]


@lru_cache(maxsize=16)
def law_arguments(t: Target, *names: str) -> dict[str, Any]:
    """Symbols of the members of these names, or of all; none of a target that is not tunable."""
    if names:
        return {name: symbol for name, symbol in law_arguments(t).items() if name in names}
    return {f.name: ca.SX.sym(f.name, f.size) for f in law_fields(t)}


def law_symbols(t: Target) -> dict[str, Any]:
    """The same in the shapes in which a law takes them."""
    found = dict(law_arguments(t))
    for name, gain in gains_of(t.controller).items():
        if name in found and name in GAINS:
            kept, symbols = is_tunable(gain), iter(ca.vertsplit(found[name]))
            entries = [
                next(symbols) if yes else ca.SX(v) for v, yes in zip(gain.nonzeros(), kept, strict=True)
            ]
            found[name] = ca.SX(gain.sparsity(), ca.vertcat(*entries))
    return found


def is_tunable(gain: ca.DM) -> list[bool]:
    """Of each entry that is not zero: whether it is no 1 or -1, which takes a signal as it is and computes nothing."""
    return [abs(value) != 1 for value in gain.nonzeros()]


def _law_parameters(t: Target) -> list[RecordMember]:
    c = t.controller
    gains, proven = gains_of(c), proven_share(t)
    share, others = (SCATTER, SCATTER) if proven is None else (proven, 0.0)
    found = [
        _gain("K", gains["K"], c.forces, c.states, "feedback of the states", share),
        _gain(
            "Ki", gains["Ki"], c.forces, c.measurements, "feedback of the sums of errors", share, over=" s"
        ),
        _gain("L", gains["L"], c.states, c.measurements, "gain of the filter", others),
    ]
    if np.isfinite(c.limits.force).all():
        found.append(_shrinking_member("force_limit", c.forces, "limit of a force", c.limits.force))
    coils = t.believed.actuator.coils
    limits = np.broadcast_to(c.limits.current, len(coils))
    if np.isfinite(limits).all():
        found.append(_shrinking_member("current_limit", coils, "limit of a current", limits))
    if t.driven and c.current_loop is not None:
        loop = c.current_loop
        found.append(_scattered_member("Kp", (Signal("", "V/A"),), "of the current loops", [loop.Kp], others))
        step = _scattered_member(
            "Ki_current",
            (Signal("", "V/A"),),
            "integral gain of the current loops, times the sample time",
            [loop.Ki * c.sample_time],
            others,
        )
        found.append(step._replace(shown=(1 / c.sample_time, "V / (A s)")))
    return [p for p in found if p.field.size]


def _gain(
    name: str,
    matrix: ca.DM,
    rows: tuple[Signal, ...],
    columns: tuple[Signal, ...],
    meaning: str,
    share: float,
    *,
    over: str = "",
) -> RecordMember:
    """The entries of a gain that may be tuned, column by column."""
    kept = is_tunable(matrix)
    places = [
        at for at, yes in zip(zip(*matrix.sparsity().get_triplet(), strict=True), kept, strict=True) if yes
    ]
    signals = tuple(
        Signal(f"{rows[i].name} {columns[j].name}", _quotient(rows[i].unit, columns[j].unit + over))
        for i, j in places
    )
    return _scattered_member(name, signals, meaning, np.array(matrix.nonzeros())[kept], share)


def _quotient(unit: str, by: str) -> str:
    """The unit of a quotient; "SI" where one of the two has no name that is known."""
    text = f"{unit} / ({by})"
    try:
        unit_factor(text, "unit")
    except InputError:
        return "SI"
    return "1" if unit == by else text


def _scattered_member(
    name: str, signals: tuple[Signal, ...], meaning: str, values: Any, share: float
) -> RecordMember:
    numbers = np.asarray(values, dtype=float)
    around = share * np.abs(numbers)
    return RecordMember(CField(name, signals, meaning), numbers, numbers - around, numbers + around)


def _shrinking_member(name: str, signals: tuple[Signal, ...], meaning: str, values: Any) -> RecordMember:
    numbers = np.asarray(values, dtype=float)
    return RecordMember(CField(name, signals, meaning), numbers, MIN_LIMIT_SHARE * numbers, numbers)


def _reference_parameters(t: Target) -> list[RecordMember]:
    """The limits of references."""
    outputs = t.controller.measurements
    per = {"position": "", "speed": "/s", "acceleration": "/s^2"}
    return [
        _shrinking_member(
            name,
            tuple(Signal(s.name, f"{s.unit}{per[name]}") for s in outputs),
            f"limit of references: {name}",
            values,
        )
        for name, values in reference_limits(t)._asdict().items()
    ]


def _thresholds(t: Target) -> RecordMember:
    """The thresholds of the monitors, a number for each row of their table."""
    rows = monitors_of(t)
    values = np.array([row.threshold for row in rows])
    signals = tuple(Signal(title, "1") for title in monitor_titles(rows))
    return RecordMember(
        CField("threshold", signals, "of a monitor's level"), values, np.zeros(len(rows)), values
    )


def monitor_titles(rows: tuple[Monitor, ...]) -> list[str]:
    """A name for each row: its monitor, and its reaction and states where it has several rows."""
    keys = [row.key for row in rows]
    titles = [
        row.key.lower() if keys.count(row.key) == 1 else f"{row.key} {row.reaction}".lower() for row in rows
    ]
    again = [titles[:k].count(title) for k, title in enumerate(titles)]
    return [f"{title} {n + 1}" if n else title for title, n in zip(titles, again, strict=True)]


def checksum_of(t: Target) -> int:
    """FNV-1a over the bytes of all numbers of the default record, the lowest byte of each first."""
    real = t.real
    data = b"".join(p.values.astype(np.dtype(real).newbyteorder("<")).tobytes() for p in parameters_of(t))
    data += np.array(counts_of(t), dtype="<i4").tobytes()
    found = FNV_START
    for byte in data:
        found = ((found ^ byte) * FNV_FACTOR) & 0xFFFFFFFF
    return found


def parameter_context(t: Target) -> dict[str, Any]:
    """What the templates are filled with for a target that is tunable; `tunable` alone for one that is not."""
    if not t.tunable:
        return {"tunable": False}
    real = t.real

    def numbers(values: FloatArray) -> str:
        text = c_numbers(values, t.precision)
        return textwrap.fill(text, 110, subsequent_indent="    ")

    def inside(p: RecordMember) -> Any:
        """The range, of which rounding takes nothing."""
        kept = p.values.astype(real)
        return np.minimum(p.least.astype(real), kept), np.maximum(p.most.astype(real), kept)

    return {
        "tunable": True,
        "parameters": [
            {
                "name": p.field.name,
                "size": p.field.size,
                "values": numbers(p.values),
                "least": numbers(inside(p)[0]),
                "most": numbers(inside(p)[1]),
            }
            for p in parameters_of(t)
        ],
        "law_parameters": [f.name for f in law_fields(t)],
        "has_force_limit": any(f.name == "force_limit" for f in law_fields(t)),
        "rows": counts_of(t),
        "ones": ", ".join(["1"] * len(counts_of(t))),
        "counts": ", ".join(map(str, counts_of(t))),
        "parameter_checksum": f"0x{checksum_of(t):08x}u",
        "fnv": {"start": f"0x{FNV_START:08x}u", "factor": f"0x{FNV_FACTOR:08x}u"},
        **_factors(t),
        "unity": c_number(1.0, t.precision),
    }


def gain_lines(t: Target) -> list[str]:
    """What is proven of other gains, for readers."""
    share = proven_share(t)
    if share is None:
        reason = "it was not asked for" if t.gains is None else t.gains.reason
        return [
            f"No margin is proven for other gains than the default ones ({reason}); they may differ by",
            f"{100 * SCATTER:g} % each, for trials.",
        ]
    axes = ", ".join(
        "(" + " ".join(t.controller.forces[k].name for k in forces) + ")"
        for forces in (() if t.gains is None else t.gains.axes)
    )
    searched = t.gains is not None and t.gains.searched
    end = "" if searched else ", and nothing beyond was looked at"
    return [
        "Proven stable for the whole uncertainty of the gain file, anywhere in the travel, while the rows of K and",
        f"Ki for the forces {axes} are those of the gain file times a factor for each of these",
        f"axes within {100 * share:g} % of 1{end}; L and the gains of the current loops stay.",
    ]


def _factors(t: Target) -> dict[str, Any]:
    """Which entries of gains share a factor, and the first entry of K of each axis; none where nothing is proven."""
    if proven_share(t) is None:
        return {"factors": []}
    names = [f.name for f in law_fields(t) if f.name in ("K", "Ki")]
    axes = {name: axes_of_rows(t, name) for name in names}
    count = 0 if t.gains is None else len(t.gains.axes)
    return {
        "factors": [
            {"name": name, "size": len(of), "axes": ", ".join(map(str, of))} for name, of in axes.items()
        ],
        "first_entries": ", ".join(str(axes["K"].index(k)) for k in range(count)),
        "axis_count": count,
        "same": c_number(TOLERANCES[t.precision], t.precision),
        "nought": c_number(0.0, t.precision),
    }
