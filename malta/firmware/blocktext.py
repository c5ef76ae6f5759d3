"""Programs in blocks as C99: a static function for each block, with its equation, and one that calls them in order."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from malta.firmware.blocks import Stage, stages
from malta.firmware.ctext import c_number, kind, operand_text, value_text
from malta.firmware.elementary import Precision
from malta.firmware.program import TRUTHS, Program

Entry = tuple[str, int]  # of a vector


class Place(NamedTuple):
    """Where a vector is: a parameter of C functions, and how the vector is reached from it."""

    parameter: str
    declared: str  # the parameter, without const
    access: str


def array_place(name: str, size: int, prefix: str) -> Place:
    """A vector that is a parameter itself."""
    return Place(name, f"{prefix}_real {name}[{size}]", name)


def member_place(record: str, variable: str, name: str) -> Place:
    """A vector in a record. name : with a dot where it is in a record of the record"""
    return Place(variable, f"{record} *{variable}", f"{variable}->{name}")


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
    stages: list[Stage]
    places: dict[str, Place]
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
    p: Program, places: Mapping[str, Place], prefix: str, precision: Precision, *, static: bool
) -> str:
    """The C of a program in blocks. A result may be where an argument is: it takes its place when no block reads it.

    places : of all arguments and results; static : whether the function is the file's own
    """
    w = _writer(p, places, prefix, precision)
    known: dict[int, Entry] = {
        k: (p.arguments[o.place[0]][0], o.place[1]) for k, o in enumerate(p.operations) if o.op == "INPUT"
    }
    functions, calls = [], []
    taken, given = set[str](), set[str]()
    for stage in w.stages:
        body = _body(w, stage, known)
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
        f"  for (k = 0; k < {w.between[name]}; k++) {{\n    {to}[k] = mid.{name}[k];\n  }}" for name, to in w.late.items()
    ]
    lines += ["  int32_t k;"] if ends else []
    return "\n".join([*_record(w), *functions, head, *lines, *unused, *calls, *ends, "}", ""])


def blocks_signature(p: Program, places: Mapping[str, Place], prefix: str) -> str:
    """The declaration of a program's function with these places, without its end."""
    written = {places[name].parameter for name, size in p.results if size}
    declared = [
        place.declared if place.parameter in written else f"const {place.declared}"
        for place in _own_parameters(p, places)
    ]
    return _wrapped(f"void {prefix}_{p.name}({', '.join(declared)})")


def blocks_call(p: Program, places: Mapping[str, Place], prefix: str) -> str:
    """The call of a program's function by the names of its own parameters."""
    return f"{prefix}_{p.name}({', '.join(place.parameter for place in _own_parameters(p, places))})"


def _own_parameters(p: Program, places: Mapping[str, Place]) -> list[Place]:
    """A place in each parameter of a program's function, in order."""
    own = [places[name] for name, size in (*p.arguments, *p.results) if size]
    return list({place.parameter: place for place in own}.values())


def _writer(p: Program, places: Mapping[str, Place], prefix: str, precision: Precision) -> _Writer:
    found = stages(p)
    given = {p.names[i] for stage in found for i, *_ in stage.outputs}
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


def _read_later(p: Program, found: list[Stage], places: Mapping[str, Place]) -> list[str]:
    """The results that take the place of an argument which a later block still reads."""
    last: dict[str, int] = {}  # by place: the last stage that reads an argument there
    first: dict[str, int] = {}  # by result: the first stage that writes it
    for n, stage in enumerate(found):
        for k in (*(a for k in stage.operations for a in p.operations[k].operands), *(k for *_, k in stage.outputs)):
            if p.operations[k].op == "INPUT":
                last[places[p.arguments[p.operations[k].place[0]][0]].access] = n
        for i, *_ in stage.outputs:
            if i < len(p.results):
                first.setdefault(p.results[i][0], n)
    return [name for name, n in first.items() if last.get(places[name].access, -1) > n]


def _body(w: _Writer, stage: Stage, known: dict[int, Entry]) -> _Body:
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


def _targets(w: _Writer, stage: Stage) -> dict[int, list[Entry]]:
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
    order = [*(name for name, size in (*w.p.arguments, *w.p.results) if size and name not in w.between), *w.between]
    return [v for v in dict.fromkeys(w.places[name].parameter for name in order) if v in wanted]


def _stage_name(w: _Writer, stage: Stage) -> str:
    return f"{w.name}_{stage.block.name}{f'_{stage.part}' if stage.part else ''}"


def _stage_function(w: _Writer, stage: Stage, body: _Body) -> str:
    written = {w.places[name].parameter for name in body.given}
    declared = {place.parameter: place.declared for place in w.places.values()}
    takes = [
        declared[v] if v in written else f"const {declared[v]}" for v in _parameters(w, body.taken | body.given)
    ]
    head = _wrapped(f"static void {_stage_name(w, stage)}({', '.join(takes)})")
    return "\n".join([_comment(stage), f"{head} {{", *body.lines, *body.last, "}", ""])


def _stage_call(w: _Writer, stage: Stage, body: _Body) -> str:
    given = ["&mid" if v == "mid" else v for v in _parameters(w, body.taken | body.given)]
    return f"  {_stage_name(w, stage)}({', '.join(given)});"


def _comment(stage: Stage) -> str:
    part = f" (part {stage.part})" if stage.part else ""
    text = f"/* {stage.block.equation}{part} */"
    return "\n".join(textwrap.wrap(text, 118, subsequent_indent="   ", break_long_words=False))


def _record(w: _Writer) -> list[str]:
    """The record of what the blocks hand on."""
    if not w.between:
        return []
    members = [f"  {w.prefix}_real {name}[{size}];" for name, size in w.between.items()]
    return [f"/* What the blocks of {w.name} hand on. */", "typedef struct {", *members, f"}} {w.name}_values;", ""]


def _wrapped(text: str) -> str:
    return "\n".join(textwrap.wrap(text, 118, subsequent_indent="    ", break_long_words=False))
