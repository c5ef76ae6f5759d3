"""C text of CasADi functions: the control period inside the loop of engine.c, on the numbers of numbers.c.

Every number of machine and controller is an entry of theta, so that one compilation serves all machines and gain files
of a shape. What is the same for a run or for all lanes is computed once, see once.py. A long function is cut into
parts that hand numbers over in an array: compilers need far more than twice the time for twice the text in one piece.
Each function has a second version for small tilts, which has no branches.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from importlib.resources import files
from itertools import pairwise
from typing import NamedTuple

import casadi as ca

from malta.simulation.instructions import MASKS, Node, mask_arguments, needed_nodes, read_instructions
from malta.simulation.layout import SHARED
from malta.simulation.once import NONE, Counts, counts_of, find_common, foresee, places
from malta.simulation.period import Period

WHOLE = 4000  # statements: a longer function is cut into parts
PART = 300  # statements of a part at most
IN_PLACE = ("digest", "cruise", "substep")  # an entry that stays as it is is not written


class Text(NamedTuple):
    """A CasADi function in C."""

    prepare: str  # lines that compute its entries of c and d
    function: str
    counts: Counts  # of its own entries
    foresee: str  # lines that compute its entries of g


def source(p: Period, digest: ca.Function | None, cruise: Sequence[ca.Function] = ()) -> str:
    """The whole C text of an engine; the number of lanes is a macro of the compilation.

    digest : the function that updates a run's digest, see digest.py; None for an engine of one lane
    cruise : when a shorter update does the same, and that update
    """
    texts, functions, counts = [], [], NONE
    given = {"sense": 1, "decide": 1, "substep": 2, "digest": 2, "cruises": 2, "cruise": 2}
    common = [k for k, name in enumerate(p.theta) if name in SHARED]
    motion = (p.substep,) if p.enter is None or p.leave is None else (p.enter, p.substep, p.leave)
    for f in (p.sense, p.decide, *motion, *([digest] if digest else []), *cruise):
        text = translate(f, [given[f.name()]] if f.name() in given else [], counts, common)
        functions.append(text.function)
        if f in (p.sense, p.decide, *motion):
            functions.append(_small_tilt_version(text.function))
        texts.append(text)
        counts = Counts(*(have + more for have, more in zip(counts, text.counts, strict=True)))
    columns = range(p.decide.size1_in(3)) if p.columns is None else p.columns
    sizes = {
        "THETA": len(p.theta),
        "CONSTANTS": counts.c,
        "SHARED": counts.d,
        "FORESEEN": counts.g,
        "STATES": p.sense.size1_in(0),
        "MACHINE": (p.enter or p.substep).size1_in(0),
        "WORKING": p.substep.size1_in(0),
        "COORDINATES": int(p.enter is not None),
        "GIVEN": p.sense.size1_in(1),
        "OUTPUTS": p.sense.size1_in(2),
        "FORCES": p.decide.size1_in(3),
        "COLUMNS": len(columns),
        "COLUMN": ", ".join(map(str, columns)),
        "TILTED": int(any("tilt" in function for function in functions)),
        "HELD": p.substep.size1_in(1),
        "JITTER": p.substep.size1_in(3),
        "ROW": p.decide.size1_out(2),
        "DIGEST": digest.size1_in(0) if digest else 0,
        "CRUISE": int(bool(cruise)),
    }
    defines = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    prepare = _once("prepare(const real *theta, real *c, double *d)", [text.prepare for text in texts])
    ahead = _once("foresee(const double *d, const double *given, double *g)", [x.foresee for x in texts])
    numbers, noise, loop = (
        files("malta.simulation").joinpath(f"{name}.c").read_text(encoding="utf-8")
        for name in ("numbers", "noise", "engine")
    )
    noise = f"#if LANES > 1\n{noise}#endif\n"
    return "".join([defines, numbers, prepare, ahead, *functions, noise, loop])


def _once(name: str, blocks: list[str]) -> str:
    """The text of a function of several blocks."""
    return f"static void {name} {{\n" + "\n".join(f"  {{\n{lines}\n  }}" for lines in blocks) + "\n}\n"


class Names(NamedTuple):
    """The C names of nodes."""

    nodes: list[Node]
    place: dict[int, str]  # of nodes that are computed once
    slot: dict[int, int]  # of nodes that one part of a function leaves to another
    part: dict[int, int]  # of the function, that computes a node

    def text(self, k: int, *, at: int | None, mask: bool = False) -> str:
        """The name of a node in part `at` of the function, or in `prepare` (None); as a mask on request."""
        node, place = self.nodes[k], self.place.get(k, "")
        is_mask = node.op in MASKS
        if at is not None and place:
            plain, is_mask = place if place.startswith("c") else f"K({place})", False
        elif k in self.slot and self.part[k] != at:
            plain = f"bits(s[{self.slot[k]}])" if is_mask else f"s[{self.slot[k]}]"
        else:
            plain = f"t{k}" if node.op else node.form
        if mask:
            return plain if is_mask else f"MASK({plain} != 0.0)"
        return f"truth({plain})" if is_mask else plain

    def lines(self, k: int) -> list[str]:
        """The statement that computes a node, and the one that leaves it to other parts."""
        node, at, masks = self.nodes[k], self.part.get(k), mask_arguments(self.nodes[k])
        values = [self.text(a, at=at, mask=i in masks) for i, a in enumerate(node.arguments)]
        kind = "whole" if node.op in MASKS else "real"
        line = f"  const {kind} t{k} = {node.form.format(*values)};"
        if k not in self.slot:
            return [line]
        return [line, f"  s[{self.slot[k]}] = {f'value(t{k})' if kind == 'whole' else f't{k}'};"]

    def keep(self, k: int) -> str:
        """The statement that stores a number that is computed once a run."""
        place, value = self.place[k], self.text(k, at=None)
        return f"  {place} = {value if place.startswith('c') else f'LANE({value}, 0)'};"


def translate(
    f: ca.Function, shared: Sequence[int], first: Counts = NONE, common: Collection[int] = ()
) -> Text:
    """C text of an SX function whose last argument is theta.

    shared : arguments that have the same value in every lane
    first : entries of c, d and g before those of this function
    common : entries of theta that have the same value in every lane

    Raises CheckError for an operation that has no C form here.
    """
    nodes, outputs = read_instructions(f, shared, common)
    used = needed_nodes(nodes, [k for *_, k in outputs])
    early = find_common(nodes, used)
    moving = [k for k in used if nodes[k].op and not nodes[k].fixed and k not in early]
    place = places(nodes, used, early, {k for *_, k in outputs}, first)
    parts = _cut_in_parts(moving)
    part = {k: index for index, members in enumerate(parts) for k in members}
    names = Names(nodes, place, _slots(nodes, parts, {k for *_, k in outputs}), part)
    fixed = [k for k in used if nodes[k].fixed and nodes[k].op]
    prepare = [line for k in fixed for line in names.lines(k)] + [names.keep(k) for k in fixed if k in place]
    bodies = [[line for k in members for line in names.lines(k)] for members in parts]
    results = [(f"r{i}[{j}]", names.text(k, at=len(parts) - 1)) for i, j, k in outputs]
    if f.name() in IN_PLACE:
        results = [(to, value) for to, value in results if value != to.replace("r0", "a0")]
    bodies[-1] += [f"  const real o{n} = {found};" for n, (_, found) in enumerate(results)]
    bodies[-1] += [f"  {to} = o{n};" for n, (to, _) in enumerate(results)]
    function = _assemble(f.name(), _arguments(f, shared), bodies, len(set(names.slot.values())))
    return Text("\n".join(prepare), function, counts_of(place), "\n".join(foresee(nodes, used, early, place)))


def _arguments(f: ca.Function, shared: Sequence[int]) -> list[tuple[str, str]]:
    """(type, name) of the arguments of a function in C: constants c, arguments a0, a1, ..., results r0, r1, ..."""
    kinds = ["double" if i in shared else "real" for i in range(f.n_in() - 1)]
    # The first argument and the first result may be the same array: all entries are read before one is written.
    return [
        ("const real *restrict ", "c"),
        *(("const double *restrict ", array) for array in "dg"),
        *((f"const {kind} *{'restrict ' * (i > 0)}", f"a{i}") for i, kind in enumerate(kinds)),
        *((f"real *{'restrict ' * (i > 0)}", f"r{i}") for i in range(f.n_out())),
    ]


def _cut_in_parts(statements: list[int]) -> list[list[int]]:
    """The statements of one function in parts of about the same length; one part for a short function."""
    count = math.ceil(len(statements) / PART) if len(statements) > WHOLE else 1
    edges = [len(statements) * k // count for k in range(count + 1)]
    return [statements[begin:end] for begin, end in pairwise(edges)]


def _slots(nodes: list[Node], parts: list[list[int]], results: set[int]) -> dict[int, int]:
    """Places in the array s of nodes that later parts read. A place is free again after its last reader."""
    last = {
        k: index for index, members in enumerate(parts) for reader in members for k in nodes[reader].arguments
    }
    last |= dict.fromkeys(results, len(parts) - 1)  # the last part writes the results
    slot: dict[int, int] = {}
    leaving: list[list[int]] = [[] for _ in parts]  # places by the last part that reads them
    free: list[int] = []
    size = 0
    for index, members in enumerate(parts):
        free += leaving[index - 1] if index else []
        for k in members:
            if last[k] > index:
                if not free:
                    free, size = [size], size + 1
                slot[k] = free.pop()
                leaving[last[k]].append(slot[k])
    return slot


def _assemble(name: str, arguments: list[tuple[str, str]], bodies: list[list[str]], slots: int) -> str:
    """The text of a function; of several parts, also a function that calls them in turn with the array s."""
    taken, given = ", ".join(map("".join, arguments)), ", ".join(called for _, called in arguments)
    inline, apart = (
        f"static {x}void" for x in ("inline __attribute__((always_inline)) ", "__attribute__((noinline)) ")
    )
    (*_, body), lines = bodies, []
    if len(bodies) > 1:
        for k, members in enumerate(bodies):
            lines += [f"{apart} {name}_{k}({taken}, real *restrict s) {{", *members, "}"]
        body = [f"  real s[{slots}];", *(f"  {name}_{k}({given}, s);" for k in range(len(bodies)))]
    return "\n".join([*lines, f"{inline} {name}({taken}) {{", *body, "}", ""])


def _small_tilt_version(function: str) -> str:
    """The version of a function for small tilts, without branches. `range` returns the largest squared tilt.

    A sample whose range is too large is computed again by the general version. Parts without a tilt serve both.
    """
    if "tilt" not in function:
        name = function.rpartition("void ")[2].partition("(")[0]
        return f"#define {name}_near(range, ...) {name}(__VA_ARGS__)\n"
    end = "}\n"
    *parts, whole = function.removesuffix(end).split(end)
    tilted = [part for part in parts if "tilt" in part]
    for part in tilted:
        name = part.partition("(const real *")[0].split()[-1]
        whole = whole.replace(f" {name}(c, ", f" {name}_near(range, c, ")
    texts = [text.replace("(const real *", "_near(real *range, const real *", 1) for text in (*tilted, whole)]
    return "".join(text.replace("tilt", "near") + end for text in texts)
