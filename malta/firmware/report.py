"""REPORT.md of an exported folder: what a step costs, what rounding does, and the margin that is left."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from malta.firmware.calibration import LEAST, Parameter, gain_lines, parameters_of
from malta.firmware.cost import CLOCK, PROCESSORS, Cost, costs, operations
from malta.firmware.export import comment, render
from malta.firmware.misra import DEVIATIONS
from malta.firmware.parts import LINK_RANGE
from malta.firmware.rounding import SAMPLES, rounded_margin, rounding_noise, smallest_error
from malta.firmware.signals import Target, reading_ranges
from malta.firmware.supervisor import ReferenceLimits, reference_limits
from malta.firmware.watch import watch_lines

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
    box = ", ".join(f"{name} +-{100 * share:g} %" for name, share in uncertainty.items())
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
