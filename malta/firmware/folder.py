"""The exported folder: the controller's C, its test with recorded vectors, build files, an example and a report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from malta.errors import InputError
from malta.files import file_exists, locate, replace_files
from malta.firmware.ctext import c_name, c_number
from malta.firmware.elementary import Precision
from malta.firmware.export import context_of, render, sources
from malta.firmware.report import report_text
from malta.firmware.signals import (
    Field,
    Target,
    current_readings,
    fidelity_of,
    input_fields,
    output_fields,
    reference_fields,
    state_fields,
)
from malta.firmware.step import programs_of
from malta.firmware.vectors import FNV_FACTOR, FNV_START, SAMPLES, Vector, record_vectors
from malta.gains.file import content_of, read
from malta.model.data import plant_of
from malta.simulation.layout import Fidelity

Until = Literal["currents", "duty-cycles"]
EXAMPLE_SAMPLES = 2000  # of the example's main program


def export_c(
    gains: str | Path,
    out: str | Path,
    *,
    precision: Precision = "double",
    until: Until | None = None,
    proof: bool = True,
) -> list[Path]:
    """Write the controller of a gain file as a folder of C99 with its test and a report; the files.

    out : the folder, new or empty
    until : how far down the C goes; None: as far as the machine is modelled
    proof : prove the margin again with the coefficients that single precision holds

    Raises InputError for a folder that has files, an unknown precision, and duty cycles of a machine without windings.

        malta.export_c("design/gains/robust.json", "build/robust_c", precision="float")
    """
    path = locate(gains)
    controller, content = read(path), content_of(path)[0]
    if until not in (None, *get_args(Until)):
        raise InputError("export", "until", repr(until), "one of " + ", ".join(get_args(Until)))
    deepest = fidelity_of(plant_of(controller.parameters))
    depths: dict[str | None, Fidelity] = {None: deepest, "currents": "force", "duty-cycles": "phase"}
    target = Target(controller, precision, depths[until])
    folder = require_empty(Path(out))
    robust = content.verification.robust
    texts = folder_files(target, content.sha256, {} if robust is None else robust.uncertainty, proof=proof)
    files = {folder / name: text.encode() for name, text in sorted(texts.items())}
    replace_files(files)
    return list(files)


def require_empty(folder: Path) -> Path:
    """The folder, which is new or empty. Raises InputError for one with files, whatever they are."""
    if file_exists(folder):
        if not folder.is_dir():
            raise InputError(folder, "", "a file of that name", "a folder, new or empty")
        try:
            if any(folder.iterdir()):
                raise InputError(folder, "", "a folder with files in it", "one that is new or empty")
        except OSError as error:
            raise InputError(folder, "", error.strerror or str(error), "a folder that can be read") from error
    return folder


def folder_files(
    t: Target, sha256: str, uncertainty: Mapping[str, float] | None = None, *, proof: bool = True
) -> dict[str, str]:
    """Every file of an export by its name.

    sha256 : of the gain file
    uncertainty : of the gain file's margin; proof : whether the report proves it again with rounded coefficients

        files = folder_files(Target(controller, "float"), sha256)
    """
    name = c_name(t.controller.name)
    files = sources(t, sha256, name)
    c_files = [file for file in files if file.endswith(".c")]
    context = context_of(t, programs_of(t), name, sha256) | {
        "objects": " ".join(file.removesuffix(".c") + ".o" for file in c_files),
        "c_files": " ".join(c_files),
        "driven": t.driven,
        "currents": len(current_readings(t)) if t.driven else 0,
        "example_samples": EXAMPLE_SAMPLES,
        "example_end": c_number(t.believed.travel / 10, t.precision),
        "example_rise": c_number(0.02, t.precision),
    }
    files |= {
        f"{name}_test.c": render("test.c", context | _test_context(t)),
        f"{name}_example.c": render("example.c", context),
        "Makefile": render("Makefile", context),
        "CMakeLists.txt": render("CMakeLists.txt", context),
    }
    report = report_text(t, context, list(files), dict(uncertainty or {}), proof=proof)
    return files | {"REPORT.md": report}


def _test_context(t: Target) -> dict[str, Any]:
    """What the template of the test is filled with."""
    vectors = record_vectors(t)
    return {
        "samples": SAMPLES,
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
