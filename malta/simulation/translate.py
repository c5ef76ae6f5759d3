"""C text of CasADi functions: the control period inside the loop of engine.c.

Every number of machine and controller is an entry of theta, so that one compilation serves all machines and gain files
of a shape. The function `prepare` computes, once a run, all scalars that depend on theta only. A long function is cut
into parts that hand numbers over in an array: compilers need far more than twice the time for twice the text in one
piece. With several lanes, each function has a second version for small tilts, which has no branches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.resources import files
from itertools import pairwise

import casadi as ca

from malta.simulation.instructions import MASKS, Node, mask_arguments, needed_nodes, read_instructions
from malta.simulation.period import Period

WHOLE = 4000  # statements: a longer function is cut into parts
PART = 300  # statements of a part at most


def source(p: Period, digest: ca.Function | None) -> str:
    """The whole C text of an engine; the number of lanes is a macro of the compilation.

    digest : the function that updates a run's digest, see digest.py; None for an engine of one lane
    """
    prepares, functions, count = [], [], 0
    given = {"sense": [1], "decide": [1], "substep": [2], "digest": [2]}
    for f in (p.sense, p.decide, p.substep, *([digest] if digest else [])):
        prepare, function, more = translate(f, given[f.name()], count)
        prepares.append(prepare)
        functions.append(function)
        if f is not digest:
            functions.append("#if LANES > 1\n" + _small_tilt_version(function) + "#endif\n")
        count += more
    sizes = {
        "THETA": len(p.theta),
        "CONSTANTS": count,
        "STATES": p.sense.size1_in(0),
        "MACHINE": p.substep.size1_in(0),
        "GIVEN": p.sense.size1_in(1),
        "OUTPUTS": p.sense.size1_in(2),
        "FORCES": p.decide.size1_in(3),
        "HELD": p.substep.size1_in(1),
        "JITTER": p.substep.size1_in(3),
        "ROW": p.decide.size1_out(2),
        "DIGEST": digest.size1_in(0) if digest else 0,
    }
    defines = "".join(f"#define {name} {value}\n" for name, value in sizes.items())
    prepare = "static void prepare(const real *theta, real *c) {\n" + "\n".join(prepares) + "\n}\n"
    frame = files("malta.simulation").joinpath("engine.c").read_text(encoding="utf-8")
    return defines + frame.replace("/*MODEL*/", prepare + "".join(functions))


def translate(f: ca.Function, shared: Sequence[int], first_constant: int) -> tuple[str, str, int]:
    """C text of an SX function whose last argument is theta: lines of `prepare`, the function, number of constants.

    shared : arguments that have the same value in every lane
    first_constant : index of the function's first entry in the array c of constants

    Raises CheckError for an operation that has no C form here.
    """
    nodes, outputs = read_instructions(f, shared)
    used = needed_nodes(nodes, [k for *_, k in outputs])
    fixed = [k for k in used if nodes[k].fixed]
    # `prepare` stores the fixed nodes that the function reads in the array c.
    read = {a for k in used if not nodes[k].fixed for a in nodes[k].arguments} | {k for *_, k in outputs}
    kept = [k for k in fixed if k in read and nodes[k].op]
    place = {k: first_constant + index for index, k in enumerate(kept)}
    moving = [k for k in used if nodes[k].op and not nodes[k].fixed]
    parts = _cut_in_parts(moving)
    part = {k: index for index, members in enumerate(parts) for k in members}
    slot = _slots(nodes, parts, {k for *_, k in outputs})

    def text(k: int, *, at: int | None, mask: bool = False) -> str:
        """The C name of a node in part `at` of the function, or in `prepare` (None); as a mask on request."""
        node = nodes[k]
        is_mask = node.op in MASKS
        if at is not None and k in place:
            plain, is_mask = f"c[{place[k]}]", False
        elif k in slot and part[k] != at:
            plain = f"bits(s[{slot[k]}])" if is_mask else f"s[{slot[k]}]"
        else:
            plain = f"t{k}" if node.op else node.form
        if mask:
            return plain if is_mask else f"MASK({plain} != 0.0)"
        return f"truth({plain})" if is_mask else plain

    def line(k: int) -> str:
        node, at = nodes[k], part.get(k)
        masks = mask_arguments(node)
        values = [text(a, at=at, mask=i in masks) for i, a in enumerate(node.arguments)]
        kind = "whole" if node.op in MASKS else "real"
        return f"  const {kind} t{k} = {node.form.format(*values)};"

    def store(k: int) -> str:
        return f"  s[{slot[k]}] = {f'value(t{k})' if nodes[k].op in MASKS else f't{k}'};"

    prepare = [line(k) for k in fixed if nodes[k].op]
    prepare += [f"  c[{place[k]}] = {text(k, at=None)};" for k in kept]
    bodies = [
        [x for k in members for x in (line(k), *([store(k)] if k in slot else []))] for members in parts
    ]
    results = [(f"r{i}[{j}]", text(k, at=len(parts) - 1)) for i, j, k in outputs]
    bodies[-1] += [f"  const real o{n} = {found};" for n, (_, found) in enumerate(results)]
    bodies[-1] += [f"  {place} = o{n};" for n, (place, _) in enumerate(results)]
    function = _assemble(f.name(), _arguments(f, shared), bodies, len(set(slot.values())))
    return "\n".join(["  {", *prepare, "  }"]), function, len(kept)


def _arguments(f: ca.Function, shared: Sequence[int]) -> list[tuple[str, str]]:
    """(type, name) of the arguments of a function in C: constants c, arguments a0, a1, ..., results r0, r1, ..."""
    kinds = ["double" if i in shared else "real" for i in range(f.n_in() - 1)]
    # The first argument and the first result may be the same array: all entries are read before one is written.
    return [
        ("const real *restrict ", "c"),
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
    end = "}\n"
    *parts, whole = function.removesuffix(end).split(end)
    tilted = [part for part in parts if "tilt" in part]
    for part in tilted:
        name = part.partition("(const real *")[0].split()[-1]
        whole = whole.replace(f" {name}(c, ", f" {name}_near(range, c, ")
    texts = [text.replace("(const real *", "_near(real *range, const real *", 1) for text in (*tilted, whole)]
    return "".join(text.replace("tilt", "near") + end for text in texts)
