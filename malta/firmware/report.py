"""REPORT.md of an exported folder: what a step costs, what rounding does, and the margin that is left."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from malta.firmware.calibration import LEAST, Parameter, gain_lines, parameters_of
from malta.firmware.cost import (
    CLOCK,
    PROCESSORS,
    SAMPLES,
    Cost,
    costs,
    log_costs,
    operations,
    rounded_margin,
    rounding_noise,
    smallest_error,
)
from malta.firmware.export import comment, render
from malta.firmware.period_functions import LINK_RANGE
from malta.firmware.ring import ring_of
from malta.firmware.signals import Target, reading_ranges
from malta.firmware.supervisor import AWAKE, STATES, ReferenceLimits, State, monitors_of, reference_limits
from malta.model.parameters import box_words

# MISRA C:2012 of the exported C: the rules that it deviates from, each with its reason.
#
# cppcheck and its MISRA addon find no other rule; directives, and rules that cppcheck does not look at, are not
# covered.


class Deviation(NamedTuple):
    """A rule that files deviate from."""

    rule: str
    files: str  # whose names end so
    reason: str


DEVIATIONS = (
    Deviation("2.5", ".h", "macros of the interface are for the caller: a program need not use all of them"),
    Deviation("8.7", "_supervisor.c", "the caller too uses the table of monitors and the initialization"),
    Deviation("21.6", "_test.c", "the test prints its verdict; the controller has no output of its own"),
    Deviation("21.6", "_pil.c", "a PC has its port in the standard streams; a target defines NAME_PIL_PORT"),
    Deviation("21.15", "_pil.c", "memcpy between numbers and words: the line carries bits"),
    Deviation(
        "21.15",
        "_test.c",
        "memcpy of numbers into words and records: the test compares bits, and calls pieces with records",
    ),
)


# Which monitor watches in which state of the supervisor, and why others do not: no cell of the table is empty.


GROUND: tuple[State, ...] = ("OFFSETS", "SENSORS")
OTHERS = {key: tuple(state for state in AWAKE if state != key) for key in AWAKE}

# (monitors, states, why they cannot hurt or do not count there); OFF and FAULT have their gates off
UNWATCHED: tuple[tuple[tuple[str, ...], tuple[State, ...], str], ...] = (
    (("TOUCH",), GROUND, "the machine rests on its bearing"),
    (("TOUCH",), ("LIFT", "LANDING"), "the machine leaves its bearing, or goes to it"),
    (("RANGE", "STUCK", "STALE", "NAN"), ("OFFSETS",), "positions are not used yet"),
    (("RATE",), GROUND, "the first readings come from anywhere, and nothing moves"),
    (("INNOVATION", "UNBELIEVED", "BLIND", "ASTRAY"), GROUND, "the filter does not run"),
    (("INNOVATION",), ("LIFT", "SETTLE", "LANDING"), "a bearing pushes; ASTRAY and UNSETTLED watch"),
    (("HELPLESS", "SATURATION"), GROUND, "no force acts"),
    (("SATURATION",), ("LIFT",), "lift-off ends after its time, and SETTLE watches"),
    (("SATURATION", "LINK"), ("LANDING",), "it lands already; HELPLESS watches"),
    (("MISSED", "OVERRUN"), GROUND, "nothing moves"),
    (("OFFSET",), OTHERS["OFFSETS"], "offsets are known, and subtracted"),
    (("CURRENT_SUM", "CURRENT_EXCESS"), ("OFFSETS",), "offsets are not known; OFFSET and CURRENT watch"),
    (("CURRENT_ERROR",), GROUND, "nothing is commanded; OFFSET, CURRENT and CURRENT_EXCESS watch"),
    (("CURRENT_FROZEN",), GROUND, "nothing is commanded"),
    (("REFERENCE",), (*GROUND, "LIFT", "LANDING"), "requests are not followed"),
    (("REFERENCE",), ("SETTLE",), "it waits until the request is within its limits"),
    (("UNSETTLED",), OTHERS["SETTLE"], "nothing is waited for"),
    (("UNREADY",), OTHERS["SENSORS"], "nothing is waited for"),
)


def watch_table(t: Target) -> dict[str, dict[State, str]]:
    """The reactions of each monitor in each state, as "hold, land", or in brackets why it does not count there.

    watch_table(Target(malta.gains.read("design/gains/robust.json")))["LINK"]["LIFT"]
    """
    table: dict[str, dict[State, str]] = {}
    for row in monitors_of(t):
        cells = table.setdefault(row.key, dict.fromkeys(STATES, ""))
        for state in row.states:
            cells[state] = ", ".join(filter(None, [cells[state], row.reaction.lower()]))
    for key, cells in table.items():
        for state in STATES:
            if state not in AWAKE:
                cells[state] = "(gates are off)"
        for keys, states, reason in UNWATCHED:
            for state in states if key in keys else ():
                cells[state] = cells[state] or f"({reason})"
    return table


def watch_lines(t: Target) -> list[str]:
    """The table in Markdown: monitors down, the states that are not off across; reasons are numbered below it."""
    reasons: list[str] = []
    lines = [
        "| monitor | " + " | ".join(state.lower() for state in AWAKE) + " |",
        "|---" * (1 + len(AWAKE)) + "|",
    ]
    for key, cells in watch_table(t).items():
        shown = []
        for state in AWAKE:
            text = cells[state]
            if text.startswith("("):
                if text not in reasons:
                    reasons.append(text)
                text = f"({reasons.index(text) + 1})"
            shown.append(text)
        lines.append(f"| `{key.lower()}` | " + " | ".join(shown) + " |")
    return [*lines, "", *(f"{k}. {reason.strip('()')}" for k, reason in enumerate(reasons, 1))]


FILES = {
    ".h": "names, units and order of all signals; what may be called",
    ".c": "the controller: one step of the control period",
    "_parts.c": "its pieces, each usable alone",
    "_test.c": "recorded vectors",
    "_pil.c": "a main program that `malta pil` asks over a serial line",
    "_example.c": "a main program with a timer loop, to be filled with hardware",
    "Makefile": "build and test with make",
    "CMakeLists.txt": "the same with CMake",
    "_supervisor.h": "states, monitors and their reactions",
    "_supervisor.c": "the supervisor, from current offsets to landing",
    "_log.h": "a ring buffer of the last samples, with a trigger",
    "_log.c": "the same",
    "_parameters.c": "gains, limits, references and monitors that the target may change",
    ".a2l": "their names, units and ranges for a calibration tool, ASAP2 1.7",
    "_supervisor_test.c": "a walk through its states",
}


def report_text(
    t: Target,
    context: Mapping[str, Any],
    files: list[str],
    uncertainty: dict[str, float],
    *,
    proof: bool,
    clock: float | None = None,
) -> str:
    """The text of REPORT.md.

    files : names of the folder's files; uncertainty : of the gain file's margin; proof : whether to prove it again;
        clock : Hz, of the processor; None: CLOCK
    """
    found = costs(t)
    missing = [p.prefix.rstrip("-") for p in PROCESSORS if p.name not in {c.processor for c in found}]
    name = context["name"]
    return render(
        "REPORT.md",
        {
            **context,
            "file_list": [(f, FILES.get(f.removeprefix(name), "")) for f in sorted(files)],
            "operations": operations(t),
            "costs": found,
            "clock": clock or CLOCK,
            "sample_seconds": t.controller.sample_time,
            "missing": f"Not found here, so not counted: {', '.join(missing)}." if missing else "",
            "rounding_text": _rounding_text(t),
            "noise": _noise(t),
            "rounding_samples": SAMPLES,
            "deviations": DEVIATIONS,
            "margin_text": _margin_text(t, uncertainty, proof=proof),
            "link_range": f"{LINK_RANGE[0]:g} to {LINK_RANGE[1]:g} times its nominal value",
            "ranges": [
                {"name": comment(s.name), "unit": s.unit, "most": most}
                for s, most in zip(t.controller.measurements, reading_ranges(t.believed), strict=True)
            ],
            "watched": watch_lines(t),
            **(_tunable_context(t, found) if t.tunable else {}),
            **(_log_context(t, found) if t.logged else {}),
            "references": [
                {"name": comment(s.name), "unit": s.unit, "position": p, "speed": v, "acceleration": a}
                for s, p, v, a in zip(t.controller.measurements, *reference_limits(t), strict=True)
            ],
        },
    )


def _tunable_context(t: Target, found: list[Cost]) -> dict[str, Any]:
    """The section about parameters that the target may change."""
    plain = {c.processor: c for c in costs(replace(t, tunable=False))}
    limit = f"{100 * LEAST:g} % of the design's to all of it"
    words = dict.fromkeys(("force_limit", "current_limit", *ReferenceLimits._fields), limit)
    words["threshold"] = "0 to those of the table of monitors"
    return {
        "tuned": [
            {"name": p.field.name, "size": p.field.size, "range": words.get(p.field.name, _scatter(p))}
            for p in parameters_of(t)
        ],
        "gain_text": comment(" ".join(gain_lines(t))),
        "tunable_costs": [(c, plain[c.processor]) for c in found if c.processor in plain],
    }


def _log_context(t: Target, found: list[Cost]) -> dict[str, Any]:
    """The section about the ring buffer."""
    plain = {c.processor: c.instructions for c in found}
    return {
        "ring": ring_of(t, ""),
        "seconds": f"{t.logged:g}",
        "log_costs": [(c, plain[c.processor]) for c in log_costs(t) if c.processor in plain],
    }


def _scatter(p: Parameter) -> str:
    """By how much a gain may differ."""
    share = float(np.max(p.most - p.values) / np.max(np.abs(p.values)))
    return f"{100 * share:.3g} % either way" if share else "that of the design"


def _rounding_text(t: Target) -> str:
    """What the precision means for the controller's sums."""
    if t.precision == "double":
        return "Coefficients and signals are those of the simulation; a step rounds as the simulation does."
    error = smallest_error(t.controller, 1e-4)
    return (
        "Coefficients and signals have 24 bits. A plain sum of errors would stand still: at 1e-4 m s an error below "
        f"{error * 1e9:.0f} nm no longer moves it. Sums here keep what rounding takes from them and add it at the next "
        "sample (Kahan), so that they follow the sums of double precision."
    )


def _noise(t: Target) -> list[dict[str, Any]]:
    """Rows of the table of rounding noise; none for double precision."""
    if t.precision == "double":
        return []
    found = rounding_noise(t)
    return [
        {
            "name": comment(s.name),
            "unit": s.unit,
            "rounding": r,
            "sensors": n,
            "share": r / n if n else float("nan"),
        }
        for s, r, n in zip(t.controller.forces, found.rounding, found.sensors, strict=True)
    ]


def _margin_text(t: Target, uncertainty: dict[str, float], *, proof: bool) -> str:
    """The margin of the loop with the coefficients that the C holds."""
    if not uncertainty:
        return "The gain file has no uncertainty, so that no margin was proven."
    if not proof:
        return "Not proven for this export: it was asked for without."
    if t.precision == "double":
        return (
            "The coefficients are those of the gain file, to the bit: its proven margin is this controller's."
        )
    margin = rounded_margin(t.controller, uncertainty)
    assert margin is not None
    box = box_words(uncertainty, t.controller.parameters)
    proven = (
        f"nothing is proven ({margin.reason})"
        if margin.lower is None
        else f"{100 * margin.lower:.2f} % is proven"
    )
    lost = (
        f"lost at {100 * margin.upper:.2f} %"
        if math.isfinite(margin.upper)
        else f"not lost {margin.searched}"
    )
    return (
        f"With the coefficients that single precision holds, of {box} {proven} for the sampled loop over the whole "
        f"travel; it is {lost}."
    )
