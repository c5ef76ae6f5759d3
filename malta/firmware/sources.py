"""C files of an exported controller, from jinja2 templates: the law, its ring buffer, a stand-in of the machine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np

from malta.arrays import FloatArray
from malta.errors import InputError
from malta.files import version
from malta.firmware.blocks import unroll
from malta.firmware.calibration import counts_of, gain_lines, law_fields, parameter_context, parameters_of
from malta.firmware.ctext import (
    APART_SUFFIX,
    VectorPlace,
    array_place,
    blocks_call,
    blocks_signature,
    blocks_text,
    c_name,
    c_number,
    c_numbers,
    function_text,
    member_place,
)
from malta.firmware.period_functions import table_size
from malta.firmware.program import FUSED, TYPES, Precision, Program, build_program, lower
from malta.firmware.signals import CField, Target, place_of_readings
from malta.firmware.step import programs_of
from malta.firmware.supervisor import JUMP, MOST_RATE, bounds_of, reference_limits
from malta.model.places import place_states
from malta.model.plant import Signal
from malta.simulation.period import state_reference

if TYPE_CHECKING:
    import jinja2

MOST_POINTS = 65_535  # of a table of v0(z)
FUSION = ("sense", "decide", "state_at")  # functions that a step consists of; the others are its pieces
MOST_PARAMETERS = 6  # of a function
MAX_RISE = 1000.0  # s, of a stroke
RISES = 6.0  # times its rise that a stroke lasts: a logistic one is then within 2e-6 of its ends
MOST_SAMPLES = 1e9  # of a stroke: twice their number is an int32_t
DIVISOR, DIVIDENDS = 7.0, (9.0, 13.0, 18.0)  # of quotients that a reciprocal rounds otherwise
WORDS = {
    "double": "Double precision: the numbers of the simulation.",
    "float": "Single precision: sums keep what rounding takes from them.",
}


def sources(t: Target, sha256: str, name: str = "", *, loops: bool = True) -> dict[str, str]:
    """The C files of a controller by name: <name>.h, <name>.c, <name>_parts.c.

    sha256 : of the gain file; name : the controller's own, as a C identifier, by default
    loops : False writes equal computations one after the other
    """
    name = name or c_name(t.controller.name)
    programs = programs_of(t)
    if not loops:
        programs = {key: unroll(p) for key, p in programs.items()}
    context = template_context(t, programs, name, sha256)
    return {
        f"{name}.h": render("controller.h", context),
        f"{name}.c": render("controller.c", context),
        f"{name}_parts.c": render("parts.c", context),
        **({f"{name}_parameters.c": render("parameters.c", context)} if t.tunable else {}),
    }


def render(template: str, context: Mapping[str, Any]) -> str:
    """A template with a context; every undefined name is an error. Lines end without blanks."""
    text = _environment().get_template(template).render(context)
    return "\n".join(line.rstrip() for line in text.splitlines()) + "\n"


@cache
def _environment() -> jinja2.Environment:
    import jinja2  # here: who flies a supervisor that is compiled already needs no template

    return jinja2.Environment(
        loader=jinja2.PackageLoader("malta.firmware"),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )


def template_context(t: Target, programs: Mapping[str, Program], name: str, sha256: str) -> dict[str, Any]:
    """What the templates of a controller are filled with."""
    c, plant = t.controller, t.believed
    return head_context(t, name) | {
        "machine": comment(plant.name),
        "sha256": sha256,
        "precision": t.precision,
        "precision_text": WORDS[t.precision],
        "fused": t.fused,
        "period": f"{c.sample_time * 1e6:g} us",
        "sample_time": c_number(c.sample_time, t.precision),
        "records": _records(t, name),
        "state": t.state_fields,
        "reference": t.reference_fields,
        "sums": _sums(t),
        "forces": len(c.forces),
        "outputs": len(c.measurements),
        "force_names": comment(" ".join(s.name for s in c.forces)),
        "link": c_number(plant.drive.link_voltage, t.precision) if t.driven else "",
        "last_output": _last_output(t),
        **_function_context(t, programs, name),
        **_limit_context(t),
        **_table_context(t),
        **root_context(t.precision),
        "arithmetic": arithmetic_context(t.precision),
        **parameter_context(t),
        "gain_lines": [comment(line) for line in gain_lines(t)] if t.tunable else [],
    }


def head_context(t: Target, name: str) -> dict[str, str]:
    """What the head of a file is filled with. name : of what the file declares, as a C identifier"""
    title = comment(t.controller.name)
    return {"name": name, "NAME": name.upper(), "title": title, "version": version()}


def _function_context(t: Target, programs: Mapping[str, Program], name: str) -> dict[str, Any]:
    """The functions, the calls of those that a step consists of, and the root that they need."""
    others = {key: p for key, p in programs.items() if key not in FUSION}
    fused_root, parts_root = (
        any(o.op == "SQRT" for key in keys for o in programs[key].operations) for keys in (FUSION, others)
    )
    fused = step_places(t, name)
    pieces = {key: piece_places(p, name) for key, p in others.items()}
    texts = {key: blocks_text(programs[key], fused, name, t.precision, static=True) for key in FUSION}
    functions = "\n".join(
        blocks_text(p, pieces[key], name, t.precision, static=False) for key, p in others.items()
    )
    return {
        **texts,
        "functions": functions,
        "piece_records": [record for p in others.values() for record in piece_records(p)],
        "declarations": [blocks_signature(p, pieces[key], name) for key, p in others.items()],
        "loops": any(APART_SUFFIX in text for text in texts.values()),
        "parts_loops": APART_SUFFIX in functions,
        "fma": any(o.op in FUSED for key in FUSION for o in programs[key].operations),
        "parts_fma": any(o.op in FUSED for p in others.values() for o in p.operations),
        "root": fused_root,
        "parts_root": parts_root,
        **{f"call_{key}": blocks_call(programs[key], fused, name) for key in FUSION},
    }


def step_places(t: Target, name: str) -> dict[str, VectorPlace]:
    """Where the vectors of a step are: in the records of the header; v0 and the table's values are the step's own."""
    state, given, out = f"{name}_state", f"{name}_inputs", f"{name}_outputs"
    places = {f.name: member_place(state, "s", f.name) for f in t.state_fields}
    places |= {f"{key}_next": place for key, place in places.items()}
    places |= {f.name: member_place(state, "s", f"reference.{f.name}") for f in t.reference_fields}
    places |= {f.name: member_place(given, "in", f.name) for f in t.input_fields}
    places |= {f.name: member_place(out, "out", f.name) for f in t.output_fields}
    places |= {f.name: member_place(state, "s", f"parameters->{f.name}") for f in law_fields(t)}
    sizes = {"v0": len(t.controller.forces), "table_at": 2 * len(t.look_ups), "table": table_size(t)}
    return places | {key: array_place(key, size, name) for key, size in sizes.items()}


def piece_places(p: Program, name: str) -> dict[str, VectorPlace]:
    """Where the vectors of a piece are: parameters, or members of two records where these would be too many."""
    if not piece_records(p):
        return {key: array_place(key, size, name) for key, size in (*p.arguments, *p.results)}
    given, found = (f"{name}_{p.name}_{of}" for of in ("given", "found"))
    return {key: member_place(given, "given", key) for key, _ in p.arguments} | {
        key: member_place(found, "found", key) for key, _ in p.results
    }


def piece_records(p: Program) -> list[dict[str, Any]]:
    """The records of a piece with more vectors than a function has parameters; none for most."""
    vectors = [[(key, size) for key, size in of if size] for of in (p.arguments, p.results)]
    if len(vectors[0]) + len(vectors[1]) <= MOST_PARAMETERS - bool(p.between):
        return []
    return [
        {"name": f"{p.name}_{of}", "fields": fields}
        for of, fields in zip(("given", "found"), vectors, strict=True)
    ]


def _limit_context(t: Target) -> dict[str, Any]:
    """What references, tables and strokes may be."""
    plant = t.believed
    stroke = plant.has_stroke and plant.stroke.travel > 0
    longest = min(MAX_RISE, MOST_SAMPLES * t.controller.sample_time / RISES)
    return {
        "limit_lines": _limit_lines(t),
        "force_limits": c_numbers(_finite(t.controller.limits.force), t.precision),
        "limits": {
            key: c_numbers(values, t.precision) for key, values in reference_limits(t)._asdict().items()
        },
        "most_points": MOST_POINTS,
        "most_rate": c_number(MOST_RATE, t.precision),
        "stroke": stroke,
        "stroke_output": plant.stroke_output if stroke else 0,
        "longest_rise": c_number(longest, t.precision),
        "rises": c_number(RISES, t.precision),
        "step_z": f"out->y_used[{plant.stroke_output}]" if plant.has_stroke else "s->z[0]",
        "start_z": f"s->reference.p[{plant.stroke_output}]" if plant.has_stroke else "s->z[0]",
    }


def _limit_lines(t: Target) -> list[str]:
    """The limits of references for readers: output, position, speed, acceleration."""
    limits = reference_limits(t)
    return [
        comment(f"{s.name:<10}{p:.8g} {s.unit}, {v:.8g} {s.unit}/s, {a:.8g} {s.unit}/s^2")
        for s, p, v, a in zip(t.controller.measurements, *limits, strict=True)
    ]


def _table_context(t: Target) -> dict[str, Any]:
    """v0(z), and the table of the currents of a machine that has one."""
    ff = t.controller.feedforward
    nodes = t.look_ups[0].nodes if t.look_ups else np.zeros((1, 1, 0))
    sizes = dict(zip(("table_rows", "table_columns", "table_values"), nodes.shape, strict=True))
    return {
        "points": len(ff.z_grid),
        "z_rows": number_rows(ff.z_grid, 6, t.precision),
        "v0_rows": number_rows(ff.v0, ff.v0.shape[1] if ff.v0.shape[1] > 2 else 6, t.precision),
        "reads": len(t.look_ups),
        **sizes,
        "table_numbers": number_rows(nodes, 6, t.precision),
        "last_row": c_number(nodes.shape[0] - 1, t.precision),
        "last_column": c_number(nodes.shape[1] - 1, t.precision),
    }


def number_rows(values: Any, width: int, precision: Precision) -> str:
    """Numbers in C, so many in a row."""
    flat = [c_number(v, precision) for v in np.ravel(values)]
    return ",\n".join("  " + ", ".join(flat[k : k + width]) for k in range(0, len(flat), width))


def root_context(precision: Precision) -> dict[str, Any]:
    """What root.c is filled with, beside the name."""
    double = precision == "double"
    return {
        "arm_fpu": f" || (defined(__ARM_FP) && ((__ARM_FP & {8 if double else 4}) != 0))",
        "builtin_root": "__builtin_sqrt" if double else "__builtin_sqrtf",
        "library_fma": "fma" if double else "fmaf",
        "digits": 52 if double else 23,
        **{key: c_number(v, precision) for key, v in _NUMBERS.items()},
    }


def arithmetic_context(precision: Precision) -> dict[str, Any]:
    """What arithmetic.c is filled with: numbers for operations whose results are known to the last bit.

    2^p + 1 is 2^p, and (1 + 2^-h)^2 is 1 + 2^(1-h) with 2 h > p; the quotients differ from products
    with the rounded reciprocal in both precisions.
    """
    real = TYPES[precision]
    limits = np.finfo(real)
    p = int(limits.nmant) + 1
    odd = 2.0 ** -(p // 2 + 1)
    quotients = [float(real(value) / real(DIVISOR)) for value in DIVIDENDS]
    given = (0, 1, 2.0**p, 1 + odd, 1 + 2 * odd, DIVISOR, limits.tiny, limits.max, limits.eps / 4, *DIVIDENDS)
    divided = [value for value in quotients for _ in range(2)]
    expected = (0, 0, *divided, 1, 1 + limits.eps, limits.tiny, 1, 0)
    return {
        "given": [c_number(float(value), precision) for value in given],
        "expected": [c_number(float(value), precision) for value in expected],
        "dividends": len(DIVIDENDS),
        "rest": 2 + len(divided),
        "divisor": c_number(DIVISOR, precision),
        **{key: c_number(_NUMBERS[key], precision) for key in ("zero", "half", "two")},
    }


_NUMBERS = {"zero": 0.0, "one": 1.0, "two": 2.0, "four": 4.0, "half": 0.5, "quarter": 0.25}


def _finite(values: Any) -> list[float]:
    """Limits, with the largest number of single precision in place of none."""
    return [min(float(v), float(np.finfo(np.float32).max)) for v in values]


def _records(t: Target, n: str) -> list[dict[str, Any]]:
    """The structs of the header."""
    beside = [
        f"{n}_reference reference; /* of the next step */",
        f"const {n}_real *z; /* v0(z): points of z, m */",
        f"const {n}_real *v0; /* forces at each */",
        "int32_t points;",
    ]
    if t.tunable:
        beside.insert(3, f"const {n}_parameters *parameters;")
    commanded = "What is commanded at a sample, and what else a log or a supervisor wants."
    remembered = "What the controller remembers from one sample to the next."
    found: list[tuple[str, str, list[CField], list[str]]] = [
        *([_parameter_record(t)] if t.tunable else []),
        ("reference", "The reference of a sample.", t.reference_fields, []),
        ("state", remembered, t.state_fields, beside),
        ("inputs", "What is read at a sample.", t.input_fields, []),
        ("outputs", commanded, t.output_fields, []),
    ]
    if t.believed.has_stroke:
        reals = (("start", "m"), ("end", "m"), ("rise", "s, 10 to 90 %"))
        whole = [f"{n}_real {key}; /* {unit} */" for key, unit in reals]
        whole += [
            "int32_t profile;",
            "int32_t sample; /* that comes next */",
            "int32_t samples; /* in all */",
        ]
        found.append(("stroke", "A stroke that is under way.", [], whole))
    return [
        {"name": key, "meaning": meaning, "more": more, "fields": [_show_field(f) for f in fields if f.size]}
        for key, meaning, fields, more in found
    ]


def _parameter_record(t: Target) -> tuple[str, str, list[CField], list[str]]:
    """The record of what a target may change."""
    whole = [
        f"int32_t samples[{len(counts_of(t))}]; /* in a row until a monitor acts */",
        "uint32_t checksum;",
    ]
    return "parameters", "What the target may change.", [p.field for p in parameters_of(t)], whole


def _show_field(field: CField) -> dict[str, Any]:
    """A field with lines that name its signals, as long as lines may be."""
    lines, line = [], ""
    for text in (comment(f"{s.name} [{s.unit}]") for s in field.signals):
        if line and len(line) + len(text) > 100:
            lines.append(line + ",")
            line = ""
        line = f"{line}, {text}" if line else text
    return {"name": field.name, "size": field.size, "meaning": field.meaning, "lines": [*lines, line]}


def comment(text: str) -> str:
    """A text that cannot end a comment in C, whoever gave the names in it."""
    plain = "".join(letter if letter.isascii() and letter.isprintable() else "?" for letter in text)
    return plain.replace("*/", "* /").replace("/*", "/ *").replace("\\", "/").replace("??", "? ?")


def _sums(t: Target) -> list[dict[str, Any]]:
    """The fields that `reset_integrators` sets to zero."""
    c = t.controller
    sizes = {f.name: f.size for f in t.state_fields}
    whole = ("e", "e_rest", "frozen", "xi_rest", "u_integral", "u_limited", "u_rest")
    found = [{"name": key, "first": 0, "end": sizes[key]} for key in whole if sizes.get(key)]
    if c.observed:
        n = len(c.states)
        found.append({"name": "xi_pred", "first": n - len(c.forces), "end": n})
    return found


def _last_output(t: Target) -> str:
    if t.has_set_points:
        return "command: set points of the machine's electronics"
    return "command: duty cycles of the half-bridges" if t.driven else "current: of each coil"


def call_text(p: Program, prefix: str, places: Mapping[str, str]) -> str:
    """The call of a program's function in C. places : where each argument and result is"""
    given = [places[name] for name, size in (*p.arguments, *p.results) if size]
    return f"{prefix}_{p.name}({', '.join(given)})"


# What stands in for a machine in the exported example and test: it is where its reference is, or moves as the law's
# model does, with noisy sensors.


UNEVEN_SHARE = 1e-3  # of the bound of the currents of a star: noise of a current sensor
ROOM = 2.0  # by which an example's stroke stays below the limits of references
QUINTIC_SPEED, QUINTIC_ACCELERATION = 1.3, 4.0  # largest, of a quintic: way / rise, way / rise^2, 10 to 90 %
MIN_RISE_SAMPLES = 20  # samples


def stand_in_context(t: Target, name: str) -> dict[str, Any]:
    """What stand_in.c is filled with. name : the controller's"""
    found: dict[str, Any] = {
        "noise": c_numbers(t.believed.sensors.deviations, t.precision),
        "noise_step": c_number(2.0**-15, t.precision),
    }
    if (reached := readings_at_rest(t)) is not None:
        found["reached"] = c_numbers(reached, t.precision)
    if moves_by_model(t):
        c = t.controller
        C = np.hstack([c.C, np.zeros((len(c.C), len(c.Ad) - c.C.shape[1]))])
        found |= {
            "model": c_numbers(c.Ad, t.precision),
            "shown": c_numbers(C, t.precision),
            "order": len(c.Ad),
        }
    if not t.driven:
        return found
    program = build_program(lower(phase_currents(t), t.precision))
    return found | {
        "phases": function_text(program, name, t.precision, static=True),
        "stand_in_root": any(o.op == "SQRT" for o in program.operations),
        "current_noise": c_number(UNEVEN_SHARE * bounds_of(t).uneven, t.precision),
    }


def moves_by_model(t: Target) -> bool:
    """Whether the stand-in moves as the law's model does: where references do not say what sensors read on the way."""
    plant = t.believed
    odd = not plant.second_order or len(plant.outputs) > len(plant.inputs)
    return odd and t.controller.tracks == "states" and not t.driven


def readings_at_rest(t: Target) -> FloatArray | None:
    """Readings at rest per unit reference, p x p, where fewer forces cannot hold all of them; None: p* itself."""
    plant = t.believed
    if len(plant.outputs) <= len(plant.inputs):
        return None
    p = ca.SX.sym("p", len(plant.outputs))
    x = place_states(plant, state_reference(plant)(p, 0 * p))
    slope = ca.Function("slope", [p], [ca.densify(ca.jacobian(plant.h(x, 0), p))])
    return np.array(slope(np.zeros(len(plant.outputs))))


def phase_currents(t: Target) -> ca.Function:
    """(readings of the positions, commanded currents of the coils) -> i, what the current sensors read then."""
    plant, drive = t.believed, t.believed.drive
    y, current = ca.SX.sym("y", len(plant.outputs)), ca.SX.sym("current", len(plant.actuator.coils))
    axes = drive.command(current)
    i = ca.densify(drive.to_phases(place_of_readings(plant, y)) @ axes if t.fidelity == "phase" else axes)
    return ca.Function("phases", [y, current], [i], ["y", "current"], ["i"])


def example_stroke(t: Target) -> tuple[float, float]:
    """End in m and rise in s of an example's stroke: a tenth of the travel, within half of all limits of references.

    A filter knows forces and the stand-in does not: it then moves by so little in a sample that it is no innovation.
    """
    k, Ts = t.believed.stroke_output, t.controller.sample_time
    limits = reference_limits(t)
    way = min(t.believed.stroke.travel / 10, limits.position[k] / ROOM)
    speed, acceleration = limits.speed[k] / ROOM, limits.acceleration[k] / ROOM
    by_acceleration = float(np.sqrt(QUINTIC_ACCELERATION * way / acceleration))
    rise = max(MIN_RISE_SAMPLES * Ts, QUINTIC_SPEED * way / speed, by_acceleration, 0.02)
    if t.controller.tracks == "states":
        sigma = float(bounds_of(t).sigma[k])
        way = min(way, JUMP / ROOM * sigma * rise / (QUINTIC_SPEED * Ts))
    return way, rise


# The ring buffer of an exported controller: its last samples at the rate of the law, with the state before each block.
#
# A sample is read and commanded in its place in the ring: the caller's `in` and `out` are the ring's. Beside that a
# step copies the reference, and at the begin of each block what the law remembers, so that a replay can begin there.
# docs/formats/log.md describes the dump.

MAGIC = b"MALTALOG"
LAYOUT = 1  # version of the record
ORDER = 0x01020304
SHARE = 8  # blocks that hold the samples that are asked for; one more is being written
MAX_RING_BYTES = 2_000_000_000  # bytes of a ring
CAUSES = ("RUNS", "CALL", "FAULT", "THRESHOLD")
FLOWN_FIELD = CField("flown", (Signal("flown", "1"),), "1 where the law ran")
MEMBERS = (
    ("period", "samples of a period of the excitation; 0: none, or the caller does not say"),
    ("watched", "output whose used reading is a trigger beyond `threshold`; -1: none"),
    ("next", "row of the sample that comes"),
    ("wrapped", "1 where the rows from `next` on have older samples"),
    ("in_block", "samples since the begin of the block"),
    ("cause", "of the trigger"),
    ("triggered", "row of the sample with the trigger; -1: none"),
    ("left", "samples that follow a trigger still"),
    ("stopped", "1 where the ring has stopped"),
)
HEAD = 8 + 4 * (3 + len(MEMBERS))  # bytes before the text


class RingLayout(NamedTuple):
    """The size of a ring: samples of a block, numbers of a sample and of a state, the lines that describe them."""

    block: int
    sample: tuple[tuple[str, CField], ...]  # "in.y" and so on
    state: tuple[CField, ...]
    text: tuple[str, ...]
    real_bytes: int

    @property
    def blocks(self) -> int:
        return SHARE + 1

    @property
    def rows(self) -> int:
        return self.block * self.blocks

    @property
    def text_bytes(self) -> int:
        """Of all lines with their ends, up to a multiple of 8: what follows is aligned."""
        return -(-sum(len(line) + 1 for line in self.text) // 8) * 8

    @property
    def numbers(self) -> int:
        """Of a sample."""
        return sum(field.size for _, field in self.sample)

    @property
    def remembered(self) -> int:
        """Numbers of a state."""
        return sum(field.size for field in self.state)

    @property
    def memory(self) -> int:
        """Bytes of the whole record."""
        reals = 1 + self.blocks * self.remembered + (self.rows + 1) * self.numbers
        return HEAD + self.text_bytes + self.real_bytes * reals


def ring_of(t: Target, sha256: str) -> RingLayout:
    """The ring of an export. Raises InputError for a time that no memory holds.

    ring_of(Target(controller, logged=0.1), sha256).memory
    """
    c = t.controller
    parts = {"reference": t.reference_fields, "in": t.input_fields, "out": t.output_fields}
    sample = tuple((f"{part}.{f.name}", f) for part, fields in parts.items() for f in fields if f.size)
    sample += (("flown", FLOWN_FIELD),)
    state = tuple(f for f in t.state_fields if f.size)
    # Of a huge time the block is not computed: its memory is refused.
    block = math.ceil(min(t.logged / c.sample_time, MAX_RING_BYTES) / SHARE - 1e-9)
    head = {
        "machine": t.believed.name,
        "controller": c.name,
        "gains": sha256,
        "sample_time": repr(float(c.sample_time)),
        "precision": t.precision,
        "fidelity": t.fidelity,
        "excited": str(int(t.excited)),
        "tunable": str(int(t.tunable)),
        "block": str(block),
        "blocks": str(SHARE + 1),
    }
    lines = [[key, value] for key, value in head.items()]
    lines += [[name, *_headings(f)] for name, f in sample]
    lines += [[f"state.{f.name}", *_headings(f)] for f in state]
    text = tuple("\t".join(comment(word).replace('"', "'") for word in line) for line in lines)
    ring = RingLayout(block, sample, state, text, t.real_bytes)
    if ring.memory > MAX_RING_BYTES:
        found = f"{t.logged:g} s of {ring.numbers * ring.real_bytes} bytes a sample"
        raise InputError("export", "log", found, f"at most {MAX_RING_BYTES:.0e} bytes in all")
    return ring


def _headings(field: CField) -> list[str]:
    return [f"{s.name} [{s.unit}]" for s in field.signals]


def ring_sources(t: Target, sha256: str, name: str) -> dict[str, str]:
    """The C files of the ring by name; none of an export without."""
    if not t.logged:
        return {}
    ring = ring_of(t, sha256)
    starts = np.cumsum([0, *(f.size for f in ring.state)]).tolist()
    context: dict[str, Any] = head_context(t, name) | {
        "log_version": LAYOUT,
        "seconds": f"{t.logged:g}",
        "rows": ring.rows,
        "block": ring.block,
        "blocks": ring.blocks,
        "memory": ring.memory,
        "remembered": ring.remembered,
        "text_bytes": ring.text_bytes,
        "text": [line.replace("\t", "\\t") for line in ring.text],
        "causes": CAUSES,
        "members": MEMBERS,
        "magic": ", ".join(f"'{letter}'" for letter in MAGIC.decode()),
        "placed_state": list(zip(ring.state, starts, strict=False)),
        "reference": t.reference_fields,
        "outputs": len(t.controller.measurements),
        "zero": c_number(0.0, t.precision),
    }
    return {f"{name}_log.{end}": render(f"log.{end}", context) for end in ("h", "c")}
