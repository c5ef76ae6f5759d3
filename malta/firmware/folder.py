"""The exported folder: the controller's C, its test with recorded vectors, build files, an example and a report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from malta.firmware.a2l import a2l_text
from malta.firmware.calibration import FNV_FACTOR, FNV_START
from malta.firmware.ctext import c_name, c_number
from malta.firmware.elementary import Precision
from malta.firmware.export import RISES, context_of, render, sources
from malta.firmware.report import report_text
from malta.firmware.signals import (
    Field,
    Target,
    current_readings,
    input_fields,
    output_fields,
    reference_fields,
    state_fields,
)
from malta.firmware.stand_in import example_stroke, stand_in_context
from malta.firmware.step import programs_of
from malta.firmware.supervisor_text import monitor_lines, supervisor_sources
from malta.firmware.trials import trial_context
from malta.firmware.vectors import SAMPLES, Vector, record_vectors

EXAMPLE_SAMPLES = 10_000  # of the example's main program, beside its stroke


def folder_files(
    t: Target,
    sha256: str,
    uncertainty: Mapping[str, float] | None = None,
    *,
    proof: bool = True,
    clock: float | None = None,
) -> dict[str, str]:
    """Every file of an export by its name.

    sha256 : of the gain file
    uncertainty : of the gain file's margin; proof : whether the report proves it again with rounded coefficients
    clock : Hz, of the processor that the report thinks of; None: that of the paper

        files = folder_files(Target(controller, "float"), sha256)
    """
    name = c_name(t.controller.name)
    files = sources(t, sha256, name) | supervisor_sources(t, name)
    c_files = [file for file in files if file.endswith(".c")]
    context = context_of(t, programs_of(t), name, sha256) | {
        "objects": " ".join(file.removesuffix(".c") + ".o" for file in c_files),
        "c_files": " ".join(c_files),
        "driven": t.driven,
        "currents": len(current_readings(t)) if t.driven else 0,
        **stand_in_context(t, name),
        **_example_context(t),
    }
    tested = context | _test_context(t)
    files |= {
        f"{name}_test.c": render("test.c", tested | trial_context(t, name)),
        f"{name}_pil.c": render("pil.c", tested),
        f"{name}_example.c": render("example.c", context),
        "Makefile": render("Makefile", context),
        "CMakeLists.txt": render("CMakeLists.txt", context),
    }
    context["monitors"] = monitor_lines(t)
    if t.tunable:
        files[f"{name}.a2l"] = a2l_text(t, name)
    report = report_text(t, context, list(files), dict(uncertainty or {}), proof=proof, clock=clock)
    return files | {"REPORT.md": report}


def _example_context(t: Target) -> dict[str, Any]:
    """How long the example runs, and its stroke."""
    if not (t.believed.has_stroke and t.believed.travel > 0):
        return {"example_samples": EXAMPLE_SAMPLES}
    end, rise = example_stroke(t)
    return {
        "example_samples": EXAMPLE_SAMPLES + math.ceil(RISES * rise / t.controller.sample_time),
        "example_end": c_number(end, t.precision),
        "example_rise": c_number(rise, t.precision),
    }


def _test_context(t: Target) -> dict[str, Any]:
    """What the template of the test is filled with."""
    vectors = record_vectors(t)
    return {
        "samples": SAMPLES,
        "real_bytes": 8 if t.precision == "double" else 4,
        "word": "uint64_t" if t.precision == "double" else "uint32_t",
        "readings": vectors[0].readings.shape[1],
        "answers": vectors[0].expected.shape[1],
        "last": "commands" if t.driven or t.has_set_points else "currents",
        "last_field": "command" if t.driven or t.has_set_points else "current",
        "fnv_start": FNV_START,
        "fnv_factor": FNV_FACTOR,
        "reference_all": reference_fields(t),
        "input_all": input_fields(t),
        "output_all": _filled(output_fields(t)),
        "state_all": _filled(state_fields(t)),
        "vectors": [_vector_text(v, t.precision) for v in vectors],
    }


def _filled(fields: list[Field]) -> list[Field]:
    return [field for field in fields if field.size]


def _vector_text(v: Vector, precision: Precision) -> dict[str, Any]:
    """A vector's numbers as C."""

    def rows(values: Any) -> str:
        lines = ["{" + ", ".join(_number(x, precision) for x in row) + "}" for row in values]
        return ",\n".join(lines)

    sums = [f"0x{x:08x}u" for x in v.checksums]
    return {
        "name": v.name,
        "warm": int(v.warm),
        "readings": rows(v.readings),
        "answers": rows(v.expected),
        "checksums": ",\n".join(", ".join(sums[k : k + 10]) for k in range(0, len(sums), 10)),
    }


def _number(value: Any, precision: Precision) -> str:
    """A number as C, also one that is not finite."""
    kind = "double" if precision == "double" else "float"
    if math.isnan(value):
        return f"({kind})NAN"
    if math.isinf(value):
        return f"({kind})INFINITY" if value > 0 else f"-({kind})INFINITY"
    return c_number(float(np.float32(value)) if precision == "float" else float(value), precision)
