"""What `malta export` writes: a gain file's controller as a folder of C, or a part of its loop as an FMU."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from malta.arguments import describe, positive
from malta.errors import InputError
from malta.files import file_exists, locate
from malta.firmware.agreement import require_same_law
from malta.firmware.calibration import (
    FNV_FACTOR,
    FNV_START,
    MIN_LIMIT_SHARE,
    RecordMember,
    counts_of,
    gain_lines,
    monitor_titles,
    parameters_of,
)
from malta.firmware.cost import (
    CLOCK,
    PROCESSORS,
    ROUNDING_SAMPLES,
    ProcessorCost,
    costs,
    log_costs,
    operations,
    round_gains,
    rounded_margin,
    rounding_noise,
    smallest_error,
)
from malta.firmware.ctext import c_name, c_number
from malta.firmware.period_functions import LINK_RANGE
from malta.firmware.program import Precision
from malta.firmware.signals import CField, Target, fidelity_of, reading_ranges
from malta.firmware.sources import (
    RISES,
    comment,
    example_stroke,
    render,
    ring_of,
    ring_sources,
    sources,
    stand_in_context,
    template_context,
)
from malta.firmware.step import programs_of
from malta.firmware.supervisor import (
    TIMES,
    ReferenceLimits,
    monitor_names,
    monitors_of,
    reference_limits,
    states_of,
)
from malta.firmware.supervisor_text import monitor_lines, supervisor_sources
from malta.firmware.vectors import (
    SAMPLES,
    Vector,
    record_vectors,
    transition_lines,
    trial_context,
    watch_lines,
)
from malta.firmware.wiring import wiring_table
from malta.firmware.xcp import (
    COMMITS,
    FOUND,
    INPUTS,
    OUTPUTS,
    PARAMETERS,
    REFERENCE,
    SUPERVISOR,
    WIRED,
    XcpPort,
    if_data,
    wiring_results,
    xcp_sources,
)
from malta.gains.file import content_of
from malta.gains.stable import read_stable
from malta.model.parameters import box_words
from malta.model.plants import plant_of
from malta.simulation.layout import Fidelity
from malta.synthesis.controller import Controller
from malta.writing import replace_files

# ASAP2 description (1.7) of a tunable controller: its parameters as CHARACTERISTIC, what it commands as MEASUREMENT.
#
# Addresses are symbol links with offsets: the parameters are those of <name>_default_parameters, the measurements
# those of the variables `out` and `supervisor` of the program, as in <name>_example.c. A linker's map makes them
# numbers.


UNLIMITED_READING = 1e12  # of a measurement without a limit
INT_BYTES = 4  # bytes of an int32_t


class MemoryEntry(NamedTuple):
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
    area: int = 0  # of an XCP slave's addresses


def a2l_text(t: Target, name: str) -> str:
    """The text of <name>.a2l. name : the controller's, as a C identifier"""
    entries = list(_parameters(t, name))
    measured = [*_outputs(t), *_supervision(t), *(_xcp_entries(t) if t.xcp else ())]
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
            "characteristics": [_show_entry(e, methods) for e in entries],
            "measurements": [_show_entry(e, methods) for e in measured],
            "states": list(enumerate(states_of(t))),
            **if_data(t),
            "monitors": [(-1, "NONE"), *enumerate(monitor_names(t))],
        },
    )


def _show_entry(e: MemoryEntry, methods: dict[tuple[str, float], str]) -> dict[str, Any]:
    return e._asdict() | {
        "meaning": comment(e.meaning).replace('"', "'"),
        "address": f"0x{(e.area << 16) + e.offset:X}",
        "method": e.table or methods[e.unit, e.factor],
        "low": repr(float(e.low)),
        "high": repr(float(e.high)),
    }


def _labels(field: CField) -> list[str]:
    """A name for each number of a field, which is a C identifier."""
    if field.size == 1 and not field.signals[0].name:
        return [field.name]
    labels = [f"{field.name}.{c_name(s.name.replace('*', ''))}" for s in field.signals]
    if len(set(labels)) < len(labels):
        return [f"{field.name}.entry_{k}" for k in range(field.size)]
    return labels


def _parameters(t: Target, name: str) -> Iterator[MemoryEntry]:
    """The record of parameters, in its order."""
    symbol, at = f"{name}_default_parameters", 0
    for p in parameters_of(t):
        factor, own = p.shown or (1.0, "")
        ranges = np.stack([p.least, p.most]) * factor
        for label, signal, low, high in zip(_labels(p.field), p.field.signals, *ranges, strict=True):
            unit = own or ("" if signal.unit in ("SI", "1") else signal.unit)
            yield MemoryEntry(label, p.field.meaning, unit, factor, low, high, symbol, at, area=PARAMETERS)
            at += t.real_bytes
    for title, most in zip(monitor_titles(monitors_of(t)), counts_of(t), strict=True):
        words = "samples in a row until a monitor acts"
        yield MemoryEntry(
            f"samples.{c_name(title)}", words, "", 1.0, 1, most, symbol, at, "LONG", area=PARAMETERS
        )
        at += INT_BYTES
    words = f"FNV-1a, from 0x{FNV_START:08x}, over the bytes of the record before it"
    yield MemoryEntry("checksum", words, "", 1.0, 0, 2**32 - 1, symbol, at, "ULONG", area=PARAMETERS)


def _outputs(t: Target) -> Iterator[MemoryEntry]:
    """What a step commands and estimates."""
    c, at = t.controller, 0
    most = {
        "y_used": reading_ranges(t.believed),
        "v": np.asarray(c.limits.force, dtype=float),
        "current": np.broadcast_to(c.limits.current, len(t.believed.actuator.coils)),
    }
    for field in t.output_fields:
        limits = np.minimum(most.get(field.name, np.full(field.size, UNLIMITED_READING)), UNLIMITED_READING)
        for label, signal, limit in zip(_labels(field), field.signals, limits, strict=True):
            unit = "" if signal.unit in ("SI", "1") else signal.unit
            is_share = field.name in ("refused", "saturated", "met")
            low, high = (0.0, 1.0) if is_share else (-limit, limit)
            yield MemoryEntry(label, field.meaning, unit, 1.0, low, high, "out", at, area=OUTPUTS)
            at += t.real_bytes


def _supervision(t: Target) -> Iterator[MemoryEntry]:
    """What a supervisor says; its record begins with its times."""
    at = INT_BYTES * len(TIMES)
    tables = {"state": "state_names", "enable": "", "monitor": "monitor_names", "reaction": ""}
    for k, (key, table) in enumerate(tables.items()):
        low, high = (-1, len(monitor_names(t))) if key == "monitor" else (0, len(states_of(t)))
        words = "of the supervisor"
        yield MemoryEntry(
            f"supervisor.{key}",
            *(words, "", 1.0, low, high, "supervisor", at + INT_BYTES * k, "LONG", table, SUPERVISOR),
        )


def _xcp_entries(t: Target) -> Iterator[MemoryEntry]:
    """What an XCP slave shows beside that: readings, references, and what became of commits."""
    for area, symbol, fields in (
        (INPUTS, "in", t.input_fields),
        (REFERENCE, "reference", t.reference_fields),
    ):
        at = 0
        for field in fields:
            for label, signal in zip(_labels(field), field.signals, strict=True):
                unit = "" if signal.unit in ("SI", "1") else signal.unit
                most = UNLIMITED_READING
                yield MemoryEntry(
                    f"{symbol}.{label}", field.meaning, unit, 1.0, -most, most, symbol, at, area=area
                )
                at += t.real_bytes
    if t.wiring:
        for area, kind, members in zip((WIRED, FOUND), ("LONG", "REAL"), wiring_results(t), strict=True):
            at = 0
            for key, size in members:
                for k in range(max(size, 1)):
                    title = f"wiring.{key}.entry_{k}" if size else f"wiring.{key}"
                    most, words = UNLIMITED_READING if kind == "REAL" else 2.0**31 - 1, "what was found"
                    yield MemoryEntry(title, words, "", 1.0, -most, most, "supervisor", at, kind, area=area)
                    at += t.real_bytes if kind == "REAL" else INT_BYTES
    for k, key in enumerate(("page", "reason", "entry", "commits")):
        words = "of the commits of parameters"
        yield MemoryEntry(
            f"calibration.{key}",
            words,
            "",
            1.0,
            -1,
            2**31 - 1,
            "calibration",
            INT_BYTES * k,
            "LONG",
            area=COMMITS,
        )


# The exported folder: the controller's C, its test with recorded vectors, build files, an example and a report.


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
    files = sources(t, sha256, name) | supervisor_sources(t, name) | ring_sources(t, sha256, name)
    c_files = [file for file in files if file.endswith(".c")] + ([f"{name}_xcp.c"] if t.xcp else [])
    context = template_context(t, programs_of(t), name, sha256) | {
        "objects": " ".join(file.removesuffix(".c") + ".o" for file in c_files),
        "c_files": " ".join(c_files),
        "driven": t.driven,
        "logged": t.logged > 0,
        "wiring": t.wiring,
        "xcp": t.xcp is not None,
        "currents": len(t.current_readings) if t.driven else 0,
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
    files |= xcp_sources(t, name, context)
    if t.tunable:
        files[f"{name}.a2l"] = a2l_text(t, name)
    report = report_text(t, context, list(files), dict(uncertainty or {}), proof=proof, clock=clock)
    return files | {"REPORT.md": report}


def _example_context(t: Target) -> dict[str, Any]:
    """How long the example runs, and its stroke."""
    if not (t.believed.has_stroke and t.believed.stroke.travel > 0):
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
        "real_bytes": t.real_bytes,
        "word": "uint64_t" if t.precision == "double" else "uint32_t",
        "readings": vectors[0].readings.shape[1],
        "answers": vectors[0].expected.shape[1],
        "last": "commands" if t.driven or t.has_set_points else "currents",
        "last_field": "command" if t.driven or t.has_set_points else "current",
        "fnv_start": FNV_START,
        "fnv_factor": FNV_FACTOR,
        "reference_all": t.reference_fields,
        "input_all": t.input_fields,
        "output_all": _fill(t.output_fields),
        "state_all": _fill(t.state_fields),
        "vectors": [_vector_text(v, t.precision) for v in vectors],
    }


def _fill(fields: list[CField]) -> list[CField]:
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


# REPORT.md of an exported folder: what a step costs, what rounding does, and the margin that is left.


# MISRA C:2012 of the exported C: the rules that it deviates from, each with its reason.
#
# cppcheck and its MISRA addon find no other rule; directives, and rules that cppcheck does not look at, are not
# covered.


class Waiver(NamedTuple):
    """A rule that files deviate from."""

    rule: str
    files: str  # whose names end so
    reason: str


DEVIATIONS = (
    Waiver("2.5", ".h", "macros of the interface are for the caller: a program need not use all of them"),
    Waiver("8.7", "_supervisor.c", "the caller too uses the table of monitors and the initialization"),
    Waiver("8.7", "_parameters.c", "the caller too asks whether a record is refused"),
    Waiver("21.6", "_test.c", "the test prints its verdict; the controller has no output of its own"),
    Waiver("21.6", "_pil.c", "a PC has its port in the standard streams; a target defines NAME_PIL_PORT"),
    Waiver("21.15", "_pil.c", "memcpy between numbers and words: the line carries bits"),
    Waiver(
        "21.15",
        "_test.c",
        "memcpy of numbers into words and records: the test compares bits, and calls pieces with records",
    ),
)


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
    "_xcp.h": "an XCP slave for calibration tools, on UDP and a serial line",
    "_xcp.c": "the same",
    "_port.h": "what the law needs of a board: timer, converters, PWM, a serial line",
    "_main.c": "a main program for a board with such a port",
    "_xcp_pc.c": "the same on this computer, with a stand-in in place of the machine",
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
            "missing": f"Not {'fused, or not ' * t.fused}found here, so not counted: {', '.join(missing)}."
            if missing
            else "",
            "rounding_text": _rounding_text(t),
            "noise": _noise_rows(t),
            "rounding_samples": ROUNDING_SAMPLES,
            "deviations": DEVIATIONS,
            "margin_text": _margin_text(t, uncertainty, proof=proof),
            "link_range": f"{LINK_RANGE[0]:g} to {LINK_RANGE[1]:g} times its nominal value",
            "ranges": [
                {"name": comment(s.name), "unit": s.unit, "most": most}
                for s, most in zip(t.controller.measurements, reading_ranges(t.believed), strict=True)
            ],
            "watched": watch_lines(t),
            "transitions": transition_lines(t),
            **(_tunable_context(t, found) if t.tunable else {}),
            **(_log_context(t, found) if t.logged else {}),
            "references": [
                {"name": comment(s.name), "unit": s.unit, "position": p, "speed": v, "acceleration": a}
                for s, p, v, a in zip(t.controller.measurements, *reference_limits(t), strict=True)
            ],
        },
    )


def _tunable_context(t: Target, found: list[ProcessorCost]) -> dict[str, Any]:
    """The section about parameters that the target may change."""
    plain = {c.processor: c for c in costs(replace(t, tunable=False, xcp=None))}
    limit = f"{100 * MIN_LIMIT_SHARE:g} % of the design's to all of it"
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


def _log_context(t: Target, found: list[ProcessorCost]) -> dict[str, Any]:
    """The section about the ring buffer."""
    plain = {c.processor: c.instructions for c in found}
    return {
        "ring": ring_of(t, ""),
        "seconds": f"{t.logged:g}",
        "log_costs": [(c, plain[c.processor]) for c in log_costs(t) if c.processor in plain],
    }


def _scatter(p: RecordMember) -> str:
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


def _noise_rows(t: Target) -> list[dict[str, Any]]:
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
        else f"{margin.proven.percent()} is proven"
    )
    lost = f"not lost {margin.searched}" if margin.exhausted else f"lost at {margin.lost.percent()}"
    return (
        f"With the coefficients that single precision holds, of {box} {proven} for the sampled loop over the whole "
        f"travel; it is {lost}."
    )


MAX_CLOCK_RATE = 1e12  # Hz, of a clock
Until = Literal["currents", "duty-cycles"]


def export_c(
    gains: str | Path,
    out: str | Path,
    *,
    precision: Precision = "double",
    until: Until | None = None,
    proof: bool = True,
    clock: float | None = None,
    tunable: bool = False,
    excitation: bool = False,
    log: float | None = None,
    wiring: bool = False,
    xcp: XcpPort | None = None,
    fma: bool = False,
) -> list[Path]:
    """Write the controller of a gain file as a folder of C99 with its test and a report.

    gains : the gain file
    out : the folder, new or empty
    precision : of all numbers, "double" or "float"
    until : how far down the C goes: "currents" or "duty-cycles"; None: as far as the machine is modelled
    proof : prove the margin again with the coefficients that single precision holds, and with other gains if tunable
    clock : of the processor, Hz, with which the report turns instructions into a share of the sample; None: 667 MHz
    tunable : gains, limits, references and monitors are in a record that the target may change, with an ASAP2 file
    excitation : forces beside the law's are read at every sample, which the filter knows as sent
    log : s, of the last samples that a ring buffer keeps, with a trigger; `malta log` and `malta replay` read its dump;
        None: without
    xcp : where a slave for calibration tools listens, XcpPort(address, port, baud), parameters tunable; None: none
    wiring : the supervisor tries sensors, coils and commutation at small voltages before the first lift-off
    fma : products and the sums that take them are one operation, for targets that have it as an instruction; the bits
        are other ones, and the recorded vectors are of these

    Returns the files.

    Raises InputError for a clock or a log that is not above 0, a folder that has files, an unknown precision, duty
    cycles of a machine without windings, a wiring of a machine that nothing carries at rest, and a sensor whose
    range nothing tells; CheckError where the export answers readings within their ranges otherwise than the law of
    simulations.

    >>> import malta
    >>> gains = "design/gains/tubular_pid.json"
    >>> files = malta.export_c(gains, "build/pid_c", until="currents")
    >>> [file.name for file in files if file.suffix == ".h"]
    ['tubular_pid.h', 'tubular_pid_supervisor.h']
    """
    path = locate_gains("export_c", gains)
    if clock is not None:
        positive("export", "clock", clock, below=MAX_CLOCK_RATE)
    tunable = tunable or xcp is not None
    target = replace(
        target_of(read_stable(path), precision, until),
        tunable=tunable,
        excited=excitation,
        xcp=xcp,
        fused=fma,
    )
    if wiring:
        target = replace(target, wiring=True)
        wiring_table(target)  # raises before anything is proven
    if log is not None:
        target = replace(target, logged=positive("export", "log", log))
        ring_of(target, "")  # raises before anything is proven
    folder, content = require_empty(Path(out)), content_of(path)[0]
    require_same_law(target)
    robust = content.verification.robust
    uncertainty = {} if robust is None else robust.uncertainty
    if tunable and proof:
        from malta.margins.tuned_gains import gain_box  # flint, which no other export needs

        held = round_gains(target.controller) if precision == "float" else target.controller
        target = replace(target, gains=gain_box(target.believed, held, uncertainty))
    texts = folder_files(target, content.sha256, uncertainty, proof=proof, clock=clock)
    files = {folder / name: text.encode() for name, text in sorted(texts.items())}
    replace_files(files)
    return list(files)


def locate_gains(caller: str, gains: Any) -> Path:
    """The gain file of this name. Raises InputError for what is no name, as a Controller."""
    if not isinstance(gains, str | Path):
        raise InputError(caller, "gains", describe(gains), "the name of a gain file")
    return locate(gains)


def target_of(c: Controller, precision: Precision, until: Until | None) -> Target:
    """What is exported. Raises InputError for what a machine does not have."""
    if until not in (None, *get_args(Until)):
        raise InputError("export", "until", repr(until), "one of " + ", ".join(get_args(Until)))
    deepest = fidelity_of(plant_of(c.parameters))
    depths: dict[str | None, Fidelity] = {None: deepest, "currents": "force", "duty-cycles": "phase"}
    return Target(c, precision, depths[until])


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
