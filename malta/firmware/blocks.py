"""Functions in blocks: one block an equation, as the expressions' own functions note them (see model/equations.py).

A block computes what its results take, as far as no block before it has given it a name. A long block is computed in
parts, one function each.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Iterator, Mapping, Sequence
from itertools import accumulate, chain, pairwise
from typing import Any, NamedTuple

import casadi as ca

from malta.firmware.program import (
    NamedEquation,
    Precision,
    Program,
    build_program,
    dependencies,
    lower,
    without_unused,
)
from malta.model.equations import Equation

MAX_OPERATIONS = 140  # operations of a function, with results that it only copies
MIN_COPIES, MIN_COPY_OPERATIONS = 4, 8  # copies of a loop, and operations of each, for which it is worth it
LEAF_OPERATIONS = ("INPUT", "CONST")


class Staged(NamedTuple):
    """A function in blocks: its own results, then what its blocks hand on."""

    plain: ca.Function  # with its own results alone
    whole: ca.Function
    blocks: tuple[NamedEquation, ...]


Entry = tuple[str, int]  # of a vector


class Copy(NamedTuple):
    """One of several equal computations."""

    operations: tuple[int, ...]  # in order
    outputs: tuple[tuple[int, int, int], ...]  # result, entry, operation


class BlockStage(NamedTuple):
    """A block, or a part of a long one, in a program."""

    block: NamedEquation
    part: int  # from 1; 0: the whole block
    operations: tuple[int, ...]  # that it computes, in order; of copies the first one's
    outputs: tuple[tuple[int, int, int], ...]  # result, entry, operation; of copies the first one's
    handed: tuple[int, ...] = ()  # operations that later parts of the block take
    copies: tuple[Copy, ...] = ()  # of a loop
    common: tuple[int, ...] = ()  # operations that all copies take, before the loop


def staged_function(
    name: str, arguments: Mapping[str, Any], results: Mapping[str, Any], equations: Sequence[Equation]
) -> Staged:
    """A function with named, dense arguments and results, in the blocks that were noted.

    A noted value that is a result, or the next value of an argument (`e`, of the result `e_next`), is that result; one
    that only bears an argument's name has its block's before it. The first note of a name counts. Raises KeyError for a
    result that no note names.
    """
    blocks: list[NamedEquation] = []
    between: dict[str, Any] = {}
    known: set[str] = set()
    for block, text, values, times in equations:
        names = {(f"{key}_next" if f"{key}_next" in results else key): value for key, value in values.items()}
        names = {(f"{block}_{key}" if key in arguments else key): value for key, value in names.items()}
        names = {key: value for key, value in names.items() if key not in known}
        known |= set(names)
        between |= {key: value for key, value in names.items() if key not in results}
        if names:
            blocks.append(NamedEquation(block, text, tuple(names), times))
    if set(results) - known:
        raise KeyError(f"{name}: no equation gives {', '.join(sorted(set(results) - known))}")
    given = {key: ca.densify(ca.vec(ca.SX(value))) for key, value in {**results, **between}.items()}
    plain, whole = (
        ca.Function(
            name, list(arguments.values()), list(given.values())[:n], list(arguments), list(given)[:n]
        )
        for n in (len(results), len(given))
    )
    return Staged(plain, whole, tuple(blocks))


def staged_program(s: Staged, precision: Precision) -> Program:
    """The program of a staged function. Its blocks hand on only what its own results take."""
    p, own = build_program(lower(s.whole, precision)), s.plain.n_out()
    outputs = tuple(o for o in p.outputs if o[0] < own)
    needed = dependencies(p.operations, [k for *_, k in outputs])
    more = tuple(o for o in p.outputs if o[0] >= own and o[2] in needed)
    taken = {p.results[i][0] for i, *_ in (*outputs, *more)}
    blocks = tuple(block for block in s.blocks if taken & set(block.results))
    whole = p._replace(results=p.results[:own], between=p.results[own:], outputs=outputs + more)
    return without_unused(whole._replace(blocks=blocks))


def stages(p: Program) -> list[BlockStage]:
    """The blocks of a program in order, long ones in parts, those of equal computations as loops."""
    known = named_inputs(p)
    found: list[BlockStage] = []
    names = p.names
    for block in p.blocks:
        outputs = [o for result in block.results for o in p.outputs if names[o[0]] == result]
        loops = _loops(p, block, outputs, known)
        found += loops or _parts(p, block, _order(p, [k for *_, k in outputs], known), outputs)
        for i, j, k in outputs:
            if p.operations[k].op not in LEAF_OPERATIONS:
                known.setdefault(k, (names[i], j))
    return found


def named_inputs(p: Program) -> dict[int, Entry]:
    """The entry of an argument that each input is."""
    return {
        k: (p.arguments[o.place[0]][0], o.place[1]) for k, o in enumerate(p.operations) if o.op == "INPUT"
    }


def unroll(p: Program) -> Program:
    """The same program without loops."""
    return p._replace(blocks=tuple(block._replace(times=1) for block in p.blocks))


def _order(p: Program, wanted: Sequence[int], known: Container[int]) -> list[int]:
    """The operations that the wanted ones take, each behind its operands, without those that are known."""
    order: dict[int, None] = {}
    for last in wanted:
        waiting = [last]
        while waiting:
            k = waiting[-1]
            if k in order or k in known or p.operations[k].op in LEAF_OPERATIONS:
                waiting.pop()
                continue
            missing = [a for a in p.operations[k].operands if not (a in order or a in known)]
            missing = [a for a in missing if p.operations[a].op not in LEAF_OPERATIONS]
            waiting += reversed(missing)
            if not missing:
                order[k] = None
    return list(order)


def _loops(
    p: Program, block: NamedEquation, outputs: list[tuple[int, int, int]], known: Mapping[int, Entry]
) -> list[BlockStage]:
    """A block of several equal computations as loops, one for each form that they have; none where it is not worth it.

    CasADi writes c x - c y as c (x - y), so that copies for equal numbers may have another form than others.
    """
    if block.times < MIN_COPIES or any(result.endswith("_next") for result in block.results):
        return []
    sizes = dict((*p.results, *p.between))
    copies: list[list[tuple[int, int, int]]] = [[] for _ in range(block.times)]
    for i, j, k in outputs:
        copies[j // (sizes[p.names[i]] // block.times)].append((i, j, k))
    orders = [_order(p, [k for *_, k in own], known) for own in copies]
    uses = Counter(k for order in orders for k in order)
    common = [k for k in dict.fromkeys(chain(*orders)) if uses[k] > 1]
    forms: dict[Any, list[Copy]] = {}
    for n, own in enumerate(copies):
        copy = Copy(tuple(k for k in orders[n] if uses[k] == 1), tuple(own))
        begins = {i: n * sizes[p.names[i]] // block.times for i, *_ in own}
        forms.setdefault(_form(p, copy, {**known, **{k: ("", -k - 1) for k in common}}, begins), []).append(
            copy
        )
    loops = [of for of in forms.values() if len(of) >= MIN_COPIES]
    rest = [copy for of in forms.values() if len(of) < MIN_COPIES for copy in of]
    left = [o for copy in rest for o in copy.outputs]
    flat = list(_parts(p, block, _order(p, [k for *_, k in left], known), left)) if left else []
    each = sum(map(len, orders))
    written = len(common) + sum(len(of[0].operations) for of in loops) + sum(len(s.operations) for s in flat)
    if written * 2 > each or each < MIN_COPY_OPERATIONS * block.times or (common and len(loops) > 1):
        return []
    found = [BlockStage(block, 0, *of[0], copies=tuple(of), common=tuple(common)) for of in loops] + flat
    return [stage._replace(part=n if len(found) > 1 else 0) for n, stage in enumerate(found, 1)]


def _form(p: Program, copy: Copy, known: Mapping[int, Entry], begins: Mapping[int, int]) -> Any:
    """What equal computations have in common: all but numbers, and places in vectors."""
    place = {k: n for n, k in enumerate(copy.operations)}

    def operand(k: int) -> Any:
        if k in place:
            return place[k]
        vector, entry = known.get(k, ("number", 0))
        return vector or entry

    steps = [
        (p.operations[k].op, *map(operand, p.operations[k].operands), len(set(p.operations[k].operands)))
        for k in copy.operations
    ]
    return (*steps, *((i, j - begins[i], operand(k)) for i, j, k in copy.outputs))


def _parts(
    p: Program, block: NamedEquation, order: list[int], outputs: list[tuple[int, int, int]]
) -> Iterator[BlockStage]:
    """A block, in parts of MAX_OPERATIONS lines at most."""
    results = {k for *_, k in outputs}
    copies = len(outputs) - len(results & set(order))
    crossing = _count_crossings(p, order, results)
    edges = [0]
    while len(order) + copies - edges[-1] > MAX_OPERATIONS and edges[-1] + MAX_OPERATIONS // 2 < len(order):
        ends = range(edges[-1] + MAX_OPERATIONS // 2, min(edges[-1] + MAX_OPERATIONS, len(order) - 1) + 1)
        edges.append(min(ends, key=lambda at: (crossing[at], -at)))
    edges.append(len(order))
    part_of = {k: n for n, (a, b) in enumerate(pairwise(edges)) for k in order[a:b]}
    last = len(edges) - 2
    taken = _last_use(p, order)
    for n, (a, b) in enumerate(pairwise(edges)):
        own = tuple(order[a:b])
        mine = tuple(o for o in outputs if part_of.get(o[2], last) == n)
        handed = tuple(k for k in own if taken.get(k, 0) >= b and k not in results)
        yield BlockStage(block, n + 1 if last else 0, own, mine, handed)


def _last_use(p: Program, order: list[int]) -> dict[int, int]:
    """By operation: the place in the order of the last one that takes it."""
    return {a: at for at, k in enumerate(order) for a in p.operations[k].operands}


def _count_crossings(p: Program, order: list[int], results: set[int]) -> list[int]:
    """Of each place in the order: how many values without a name are taken behind it."""
    change = [0] * (len(order) + 1)
    taken = _last_use(p, order)
    for at, k in enumerate(order):
        if k not in results and k in taken:
            change[at + 1] += 1
            change[min(taken[k] + 1, len(order))] -= 1
    return list(accumulate(change))
