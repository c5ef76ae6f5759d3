"""Exported C99: names of its identifiers, and one operation a statement, so that no compiler changes the bits."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from malta.errors import InputError
from malta.firmware.blocks import LEAF_OPERATIONS, BlockStage, Entry, named_inputs, stages
from malta.firmware.program import TRUTHS, Operation, Precision, Program

_FORMS = {
    "ADD": "{0} + {1}",
    "SUB": "{0} - {1}",
    "MUL": "{0} * {1}",
    "DIV": "{0} / {1}",
    "NEG": "-{0}",
    "FMA": "{fma}({0}, {1}, {2})",
    "FMS": "{fma}({0}, {1}, -{2})",
    "FNMA": "{fma}(-{0}, {1}, {2})",
    "FABS": "({0} < {zero}) ? -{0} : {0}",
    "SQRT": "{root}({0})",
    "FMIN": "({0} < {1}) ? {0} : {1}",
    "FMAX": "({0} > {1}) ? {0} : {1}",
    "LT": "{0} < {1}",
    "LE": "{0} <= {1}",
    "EQ": "{0} == {1}",
    "NE": "{0} != {1}",
    "NOT": "!{0}",
    "AND": "{0} && {1}",
    "OR": "{0} || {1}",
    "IF_ELSE_ZERO": "{0} ? {1} : {zero}",
    "PICK": "{0} ? {1} : {2}",
}
HEADERS = (  # of C's library, which NAME.h may not hide
    *("assert", "complex", "ctype", "errno", "features", "fenv", "float", "inttypes", "iso646"),
    *("limits", "locale", "math", "setjmp", "signal", "stdarg", "stdbool", "stddef", "stdint"),
    *("stdio", "stdlib", "string", "tgmath", "time", "wchar", "wctype"),
)
_CONDITIONS = {"NOT": 1, "AND": 2, "OR": 2, "IF_ELSE_ZERO": 1, "PICK": 1}  # operands that are true or false


def c_name(text: str) -> str:
    """A text as part of a C identifier."""
    name = re.sub(r"\W+", "_", text.lower(), flags=re.ASCII).strip("_")
    return f"m_{name}" if not name or name[0].isdigit() or name in HEADERS else name


def c_number(value: float, precision: Precision) -> str:
    """A number as C reads it back to the bit. Raises InputError for one that the precision does not hold."""
    if precision == "float":
        with np.errstate(over="ignore"):
            single = np.float32(value)
        if not np.isfinite(single):
            raise InputError("export", "precision", f"float for a number of {float(value):g}", "double")
        return _with_point(str(single)) + "f"
    return _with_point(repr(float(value)))


def c_numbers(values: Any, precision: Precision) -> str:
    """Numbers as C reads them, with commas between them."""
    return ", ".join(c_number(float(value), precision) for value in np.ravel(values))


def _with_point(text: str) -> str:
    return text if any(mark in text for mark in ".e") else f"{text}.0"


def signature(p: Program, prefix: str) -> str:
    """The declaration of a program's function, without its end."""
    takes = [f"const {prefix}_real {name}[{size}]" for name, size in p.arguments if size]
    gives = [f"{prefix}_real {name}[{size}]" for name, size in p.results if size]
    return _wrap(f"void {prefix}_{p.name}({', '.join([*takes, *gives])})")


def function_text(p: Program, prefix: str, precision: Precision, *, static: bool = False) -> str:
    """The C function of a program. All arguments are read before a result is written: they may be the same arrays."""
    zero = c_number(0.0, precision)
    inputs = {k for k, o in enumerate(p.operations) if o.op == "INPUT"}
    names = {k: f"t{k}" for k, o in enumerate(p.operations) if o.op != "CONST"}
    lines = []
    for k, operation in enumerate(p.operations):
        if k in inputs:
            argument, entry = operation.place
            lines.append(f"  const {prefix}_real t{k} = {p.arguments[argument][0]}[{entry}];")
        elif operation.op != "CONST":
            of = kind(operation, prefix)
            lines.append(f"  const {of} t{k} = {value_text(p, k, names, prefix, precision)};")
    own = [o for o in p.outputs if o[0] < len(p.results)]
    for i, j, k in own:
        lines.append(f"  {p.results[i][0]}[{j}] = {operand_text(p, k, names, precision)};")
    written = {(i, j) for i, j, _ in own}
    for i, (name, size) in enumerate(p.results):
        lines += [f"  {name}[{j}] = {zero};" for j in range(size) if (i, j) not in written]
    head = f"{'static ' if static else ''}{signature(p, prefix)} {{"
    used = {p.operations[k].place[0] for k in inputs}
    unused = [f"  (void){name};" for i, (name, size) in enumerate(p.arguments) if size and i not in used]
    return "\n".join([head, *unused, *lines, "}", ""])


def kind(operation: Operation, prefix: str) -> str:
    """The type of an operation's value."""
    return "bool" if operation.op in TRUTHS else f"{prefix}_real"


def value_text(p: Program, k: int, names: Mapping[int, str], prefix: str, precision: Precision) -> str:
    """An operation on operands that have these names; one without a name is a constant."""
    operation = p.operations[k]
    conditions = _CONDITIONS.get(operation.op, 0)
    operands = [
        operand_text(p, a, names, precision, condition=i < conditions)
        for i, a in enumerate(operation.operands)
    ]
    form = _FORMS[operation.op]
    return form.format(*operands, zero=c_number(0.0, precision), root=f"{prefix}_root", fma=f"{prefix}_fma")


def operand_text(
    p: Program, k: int, names: Mapping[int, str], precision: Precision, *, condition: bool = False
) -> str:
    """The value of an operation as a number, or as a condition. Names with brackets are entries of arrays: numbers."""
    zero, one = c_number(0.0, precision), c_number(1.0, precision)
    if p.operations[k].op == "CONST" and k not in names:
        number = c_number(p.operations[k].value, precision)
        return f"({number} != {zero})" if condition else _bracket(number)
    name = names[k]
    if p.operations[k].op in TRUTHS and not name.endswith("]"):
        return name if condition else f"({name} ? {one} : {zero})"
    return f"({name} != {zero})" if condition else name


def _bracket(number: str) -> str:
    return f"({number})" if number.startswith("-") else number


# Programs in blocks as C99: a static function for each block, with its equation, and one that calls them in order.


APART_SUFFIX = "_APART"  # of the macro that keeps a long loop a function of its own, see apart.c
MIN_APART_OPERATIONS = 40  # operations of such a loop; shorter ones take fewer registers than their call


class VectorPlace(NamedTuple):
    """Where a vector is: a parameter of C functions, and how the vector is reached from it."""

    parameter: str
    declared: str  # the parameter, without const
    access: str


def array_place(name: str, size: int, prefix: str) -> VectorPlace:
    """A vector that is a parameter itself."""
    return VectorPlace(name, f"{prefix}_real {name}[{size}]", name)


def member_place(record: str, variable: str, name: str) -> VectorPlace:
    """A vector in a record. name : with a dot where it is in a record of the record"""
    return VectorPlace(variable, f"{record} *{variable}", f"{variable}->{name}")


@dataclass
class _Body:
    """The text of a stage, and which vectors it takes and gives."""

    lines: list[str] = field(default_factory=list)
    last: list[str] = field(default_factory=list)
    taken: set[str] = field(default_factory=set)
    given: set[str] = field(default_factory=set)


class _Writer(NamedTuple):
    """A program with the places of its vectors, those between its blocks among them."""

    p: Program
    stages: list[BlockStage]
    places: dict[str, VectorPlace]
    between: dict[str, int]  # vectors that only blocks see, with their sizes
    late: dict[str, str]  # results whose old values later blocks take, and where they go at the end
    prefix: str
    precision: Precision

    @property
    def name(self) -> str:
        return f"{self.prefix}_{self.p.name}"

    def text(self, entry: Entry) -> str:
        return f"{self.places[entry[0]].access}[{entry[1]}]"


def blocks_text(
    p: Program, places: Mapping[str, VectorPlace], prefix: str, precision: Precision, *, static: bool
) -> str:
    """The C of a program in blocks. A result may be where an argument is: it takes its place when no block reads it.

    places : of all arguments and results; static : whether the function is the file's own
    """
    w = _writer(p, places, prefix, precision)
    known = named_inputs(p)
    functions, calls = [], []
    taken, given = set[str](), set[str]()
    for stage in w.stages:
        body = _loop_body(w, stage, known) if stage.copies else _body(w, stage, known)
        taken, given = taken | body.taken, given | body.given
        functions.append(_stage_function(w, stage, body))
        calls.append(_stage_call(w, stage, body))
    head = f"{'static ' if static else ''}{blocks_signature(p, places, prefix)} {{"
    used = _parameters(w, taken | given)
    own = [name for name, size in (*p.arguments, *p.results) if size]
    unused = [f"  (void){v};" for v in dict.fromkeys(places[name].parameter for name in own) if v not in used]
    if len(w.stages) == 1:
        (stage,) = w.stages
        return "\n".join([_comment(stage), head, *unused, *body.lines, *body.last, "}", ""])
    lines = [f"  {w.name}_values mid;"] if w.between else []
    ends = [
        f"  for (k = 0; k < {w.between[name]}; k++) {{\n    {to}[k] = mid.{name}[k];\n  }}"
        for name, to in w.late.items()
    ]
    lines += ["  int32_t k;"] if ends else []
    return "\n".join([*_record(w), *functions, head, *lines, *unused, *calls, *ends, "}", ""])


def blocks_signature(p: Program, places: Mapping[str, VectorPlace], prefix: str) -> str:
    """The declaration of a program's function with these places, without its end."""
    written = {places[name].parameter for name, size in p.results if size}
    declared = [
        place.declared if place.parameter in written else f"const {place.declared}"
        for place in _own_parameters(p, places)
    ]
    return _wrap(f"void {prefix}_{p.name}({', '.join(declared)})")


def blocks_call(p: Program, places: Mapping[str, VectorPlace], prefix: str) -> str:
    """The call of a program's function by the names of its own parameters."""
    return f"{prefix}_{p.name}({', '.join(place.parameter for place in _own_parameters(p, places))})"


def _own_parameters(p: Program, places: Mapping[str, VectorPlace]) -> list[VectorPlace]:
    """A place in each parameter of a program's function, in order."""
    own = [places[name] for name, size in (*p.arguments, *p.results) if size]
    return list({place.parameter: place for place in own}.values())


def _writer(p: Program, places: Mapping[str, VectorPlace], prefix: str, precision: Precision) -> _Writer:
    found = stages(p)
    given = {p.names[i] for i, *_ in p.outputs}
    between = {name: size for name, size in p.between if name in given}
    for stage in found:
        if stage.handed:
            name = f"{stage.block.name}_parts"
            between[name] = between.get(name, 0) + len(stage.handed)
    late = {name: places[name].access for name in _read_later(p, found, places)}
    between |= {name: dict(p.results)[name] for name in late}
    record = f"{prefix}_{p.name}_values"
    own = {name: member_place(record, "mid", name) for name in between}
    return _Writer(p, found, dict(places) | own, between, late, prefix, precision)


def _read_later(p: Program, found: list[BlockStage], places: Mapping[str, VectorPlace]) -> list[str]:
    """The results that take the place of an argument which a later block still reads."""
    last: dict[str, int] = {}  # by place: the last stage that reads an argument there
    first: dict[str, int] = {}  # by result: the first stage that writes it
    for n, stage in enumerate(found):
        read = {a for k in stage.operations for a in p.operations[k].operands} | {
            k for *_, k in stage.outputs
        }
        vectors = {p.arguments[p.operations[k].place[0]][0] for k in read if p.operations[k].op == "INPUT"}
        last |= {places[name].access: n for name in vectors}
        for i, *_ in stage.outputs:
            if i < len(p.results):
                first.setdefault(p.results[i][0], n)
    return [name for name, n in first.items() if last.get(places[name].access, -1) > n]


def _body(w: _Writer, stage: BlockStage, known: dict[int, Entry]) -> _Body:
    """The statements of a stage; what it gives is known from here on."""
    p, body = w.p, _Body()
    targets = _targets(w, stage)
    names = {k: w.text(entry) for k, entry in known.items()}
    overwritten = {w.text(target) for of in targets.values() for target in of}
    taken_at: dict[int, int] = {}  # by operation: the last statement that takes it
    read_at: dict[str, int] = {}  # the same by the text of an entry
    for n, k in enumerate(stage.operations):
        for a in p.operations[k].operands:
            taken_at[a] = n
            if a in known:
                body.taken.add(known[a][0])
                read_at[names[a]] = n
    count = 0
    for k in targets:  # entries that are copied, and written before: kept from the beginning
        if k in known and names[k] in overwritten and [w.text(v) for v in targets[k]] != [names[k]]:
            body.lines.append(f"  const {w.prefix}_real t{count} = {names[k]};")
            names[k], count = f"t{count}", count + 1
            body.taken.add(known[k][0])
    for n, k in enumerate(stage.operations):
        value = value_text(p, k, names, w.prefix, w.precision)
        ends = [w.text(target) for target in targets.get(k, [])]
        if ends and taken_at.get(k, -1) <= n and not any(read_at.get(end, -1) > n for end in ends):
            body.lines.append(f"  {ends[0]} = {_as_number(w, k, value)};")
            body.last += [f"  {end} = {ends[0]};" for end in ends[1:]]
        else:
            names[k] = f"t{count}"
            body.lines.append(f"  const {kind(p.operations[k], w.prefix)} t{count} = {value};")
            body.last += [f"  {end} = {operand_text(p, k, names, w.precision)};" for end in ends]
            count += 1
    own = set(stage.operations)
    for k, of in targets.items():
        body.given |= {vector for vector, _ in of}
        if k not in own:
            text = operand_text(p, k, names, w.precision)
            ends = [end for end in map(w.text, of) if end != text]
            body.last += [f"  {end} = {text};" for end in ends]
            body.taken |= {known[k][0]} if k in known and ends else set()
        if p.operations[k].op not in ("INPUT", "CONST"):
            known.setdefault(k, of[0])
    return body


class _Copies:
    """The copies of a loop: tables of what differs from one to the next.

    numbers : columns of constants; steps : by how much places in vectors are further, as columns too
    """

    def __init__(self, w: _Writer, stage: BlockStage, known: Mapping[int, Entry]) -> None:
        self.w, self.stage, self.known = w, stage, known
        self.numbers: list[tuple[float, ...]] = []
        self.steps: list[tuple[int, ...]] = []

    def number(self, of: Sequence[int]) -> str | None:
        """The name of a number that differs; None where it is the same in all copies. of : its operation in each"""
        values = tuple(self.w.p.operations[k].value for k in of)
        if len(set(values)) == 1:
            return None
        return f"numbers[k][{_column(self.numbers, values)}]"

    def entry(self, of: Sequence[Entry]) -> str:
        """An entry of a vector. of : the entry in each copy"""
        vector, first = of[0]
        steps = tuple(j - first for _, j in of)
        access = self.w.places[vector].access
        if not any(steps):
            return f"{access}[{first}]"
        step = f"at{_column(self.steps, steps)}"
        return f"{access}[{step} + {first}]" if first else f"{access}[{step}]"

    def lines(self) -> tuple[list[str], list[str]]:
        """The tables, and the places at the beginning of a loop's body."""
        tables, begin, columns = list[str](), list[str](), list[tuple[int, ...]]()
        count = len(self.stage.copies)
        for n, steps in enumerate(self.steps):
            if steps == tuple(range(0, count * steps[1], steps[1] or 1)) and steps[1] > 0:
                begin.append(f"    const int32_t at{n} = {f'{steps[1]} * ' if steps[1] > 1 else ''}k;")
            else:
                begin.append(f"    const int32_t at{n} = at[k][{len(columns)}];")
                columns.append(steps)
        if columns:
            tables += _table("int32_t at", [[str(v) for v in row] for row in zip(*columns, strict=True)])
        if self.numbers:
            rows = [[c_number(v, self.w.precision) for v in row] for row in zip(*self.numbers, strict=True)]
            tables += _table(f"{self.w.prefix}_real numbers", rows)
        return tables, begin


def _column(columns: list[Any], values: Any) -> int:
    """The place of a column, which is added where it is new."""
    if values not in columns:
        columns.append(values)
    return columns.index(values)


def _table(head: str, rows: list[list[str]]) -> list[str]:
    body = ",\n".join(f"    {{ {', '.join(row)} }}" for row in rows)
    wrapped = "\n".join(
        "\n".join(textwrap.wrap(line, 118, initial_indent="    ", subsequent_indent="      "))
        for line in body.splitlines()
    )
    return [f"  static const {head}[{len(rows)}][{len(rows[0])}] = {{", wrapped, "  };"]


def _loop_body(w: _Writer, stage: BlockStage, known: dict[int, Entry]) -> _Body:
    """The statements of a loop over equal computations."""
    p, body, tables = w.p, _Body(), _Copies(w, stage, known)
    first, names, inner = stage.copies[0], dict[int, str](), list[str]()
    targets: dict[int, list[int]] = {}
    for n, (*_, k) in enumerate(first.outputs):
        targets.setdefault(k, []).append(n)
    ends = [
        tables.entry([(p.names[c.outputs[n][0]], c.outputs[n][1]) for c in stage.copies])
        for n in range(len(first.outputs))
    ]
    taken_at = {a: n for n, k in enumerate(first.operations) for a in p.operations[k].operands}
    before = _common_lines(w, stage, known, names, body)
    for n, k in enumerate(first.operations):
        own = dict(names)
        for m, a in enumerate(p.operations[k].operands):
            if a not in names:
                own |= _name_differences(
                    tables, a, [p.operations[c.operations[n]].operands[m] for c in stage.copies], body
                )
        value = value_text(p, k, own, w.prefix, w.precision)
        if k in targets and taken_at.get(k, -1) <= n:
            inner.append(f"    {ends[targets[k][0]]} = {_as_number(w, k, value)};")
            body.last += [f"    {ends[m]} = {ends[targets[k][0]]};" for m in targets[k][1:]]
        else:
            names[k] = f"t{len(names)}"
            inner.append(f"    const {kind(p.operations[k], w.prefix)} {names[k]} = {value};")
            body.last += [
                f"    {ends[m]} = {operand_text(p, k, names, w.precision)};" for m in targets.get(k, [])
            ]
    for n, (*_, k) in enumerate(first.outputs):
        if k not in first.operations:
            given = (
                names
                if k in names
                else _name_differences(tables, k, [c.outputs[n][2] for c in stage.copies], body)
            )
            body.last.append(f"    {ends[n]} = {operand_text(p, k, given, w.precision)};")
    for copy in stage.copies:
        body.given |= {p.names[i] for i, *_ in copy.outputs}
        for i, j, k in copy.outputs:
            if p.operations[k].op not in LEAF_OPERATIONS:
                known.setdefault(k, (p.names[i], j))
    heads, begin = tables.lines()
    count = len(stage.copies)
    body.lines = [*heads, *before, "  int32_t k;", f"  for (k = 0; k < {count}; k++) {{", *begin, *inner]
    body.last.append("  }")
    return body


def _common_lines(
    w: _Writer, stage: BlockStage, known: Mapping[int, Entry], names: dict[int, str], body: _Body
) -> list[str]:
    """What all copies of a loop take, before it."""
    lines = []
    for k in stage.common:
        of = {a: w.text(known[a]) for a in w.p.operations[k].operands if a in known}
        body.taken |= {known[a][0] for a in of}
        value = value_text(w.p, k, names | of, w.prefix, w.precision)
        names[k] = f"t{len(names)}"
        lines.append(f"  const {kind(w.p.operations[k], w.prefix)} {names[k]} = {value};")
    return lines


def _name_differences(tables: _Copies, a: int, of: Sequence[int], body: _Body) -> dict[int, str]:
    """The name of an operand that is no operation of the loop; none for a number that is the same in all copies."""
    if a in tables.known:
        entries = [tables.known[k] for k in of]
        body.taken |= {vector for vector, _ in entries}
        return {a: tables.entry(entries)}
    number = tables.number(of)
    return {} if number is None else {a: number}


def _targets(w: _Writer, stage: BlockStage) -> dict[int, list[Entry]]:
    """Where the values of operations go."""
    targets: dict[int, list[Entry]] = {}
    for i, j, k in stage.outputs:
        targets.setdefault(k, []).append((w.p.names[i], j))
    name = f"{stage.block.name}_parts"
    before = 0
    for other in w.stages:
        if other.block is stage.block and other.part < stage.part:
            before += len(other.handed)
    for n, k in enumerate(stage.handed):
        targets.setdefault(k, []).append((name, before + n))
    return targets


def _as_number(w: _Writer, k: int, value: str) -> str:
    if w.p.operations[k].op not in TRUTHS:
        return value
    return f"({value}) ? {c_number(1.0, w.precision)} : {c_number(0.0, w.precision)}"


def _parameters(w: _Writer, vectors: Iterable[str]) -> list[str]:
    """The parameters where vectors are, in the order of the program's own, then that of the blocks."""
    wanted = {w.places[name].parameter for name in vectors}
    order = [
        *(name for name, size in (*w.p.arguments, *w.p.results) if size and name not in w.between),
        *w.between,
    ]
    return [v for v in dict.fromkeys(w.places[name].parameter for name in order) if v in wanted]


def _stage_name(w: _Writer, stage: BlockStage) -> str:
    return f"{w.name}_{stage.block.name}{f'_{stage.part}' if stage.part else ''}"


def _stage_function(w: _Writer, stage: BlockStage, body: _Body) -> str:
    written = {w.places[name].parameter for name in body.given}
    declared = {place.parameter: place.declared for place in w.places.values()}
    takes = [
        declared[v] if v in written else f"const {declared[v]}"
        for v in _parameters(w, body.taken | body.given)
    ]
    apart = (
        f"{w.prefix.upper()}{APART_SUFFIX} "
        if stage.copies and len(stage.operations) > MIN_APART_OPERATIONS
        else ""
    )
    head = _wrap(f"static {apart}void {_stage_name(w, stage)}({', '.join(takes)})")
    return "\n".join([_comment(stage), f"{head} {{", *body.lines, *body.last, "}", ""])


def _stage_call(w: _Writer, stage: BlockStage, body: _Body) -> str:
    given = ["&mid" if v == "mid" else v for v in _parameters(w, body.taken | body.given)]
    return f"  {_stage_name(w, stage)}({', '.join(given)});"


def _comment(stage: BlockStage) -> str:
    part = f" (part {stage.part})" if stage.part else ""
    return _wrap(f"/* {stage.block.equation}{part} */", "   ")


def _record(w: _Writer) -> list[str]:
    """The record of what the blocks hand on."""
    if not w.between:
        return []
    members = [f"  {w.prefix}_real {name}[{size}];" for name, size in w.between.items()]
    return [
        f"/* What the blocks of {w.name} hand on. */",
        "typedef struct {",
        *members,
        f"}} {w.name}_values;",
        "",
    ]


def _wrap(text: str, indent: str = "    ") -> str:
    return "\n".join(textwrap.wrap(text, 118, subsequent_indent=indent, break_long_words=False))
