"""Functions in blocks: one block an equation, as the expressions' own functions note them (see model/equations.py).

A block computes what its results take, as far as no block before it has given it a name. A long block is computed in
parts, one function each.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from typing import Any, NamedTuple

import casadi as ca

from malta.firmware.elementary import Precision
from malta.firmware.lowering import lower
from malta.firmware.program import Block, Program, program_of, reached, without_unused
from malta.model.equations import Equation

LONGEST = 140  # operations of a function, with results that it only copies
LEAVES = ("INPUT", "CONST")


class Staged(NamedTuple):
    """A function in blocks: its own results, then what its blocks hand on."""

    plain: ca.Function  # with its own results alone
    whole: ca.Function
    blocks: tuple[Block, ...]


class Stage(NamedTuple):
    """A block, or a part of a long one, in a program."""

    block: Block
    part: int  # from 1; 0: the whole block
    operations: tuple[int, ...]  # that it computes, in order
    outputs: tuple[tuple[int, int, int], ...]  # result, entry, operation
    handed: tuple[int, ...]  # operations that later parts of the block take


def staged_function(
    name: str, arguments: Mapping[str, Any], results: Mapping[str, Any], equations: Sequence[Equation]
) -> Staged:
    """A function with named, dense arguments and results, in the blocks that were noted.

    A noted value that is a result, or the next value of an argument (`e`, of the result `e_next`), is that result; the
    first note of a name counts. Raises KeyError for a result that no note names.
    """
    blocks: list[Block] = []
    between: dict[str, Any] = {}
    known: set[str] = set()
    for block, text, values in equations:
        names = {(f"{key}_next" if f"{key}_next" in results else key): value for key, value in values.items()}
        names = {key: value for key, value in names.items() if key not in known}
        known |= set(names)
        between |= {key: value for key, value in names.items() if key not in results}
        if names:
            blocks.append(Block(block, text, tuple(names)))
    if set(results) - known:
        raise KeyError(f"{name}: no equation gives {', '.join(sorted(set(results) - known))}")
    given = {key: ca.densify(ca.vec(ca.SX(value))) for key, value in {**results, **between}.items()}
    plain, whole = (
        ca.Function(name, list(arguments.values()), list(given.values())[:n], list(arguments), list(given)[:n])
        for n in (len(results), len(given))
    )
    return Staged(plain, whole, tuple(blocks))


def staged_program(s: Staged, precision: Precision) -> Program:
    """The program of a staged function. Its blocks hand on only what its own results take."""
    p, own = program_of(lower(s.whole, precision)), s.plain.n_out()
    outputs = tuple(o for o in p.outputs if o[0] < own)
    needed = reached(p.operations, [k for *_, k in outputs])
    more = tuple(o for o in p.outputs if o[0] >= own and o[2] in needed)
    taken = {p.results[i][0] for i, *_ in (*outputs, *more)}
    blocks = tuple(block for block in s.blocks if taken & set(block.results))
    whole = p._replace(results=p.results[:own], between=p.results[own:], outputs=outputs + more)
    return without_unused(whole._replace(blocks=blocks))


def stages(p: Program) -> list[Stage]:
    """The blocks of a program in order, long ones in parts."""
    known: set[int] = set()
    found: list[Stage] = []
    names = p.names
    for block in p.blocks:
        outputs = [o for result in block.results for o in p.outputs if names[o[0]] == result]
        order = _order(p, [k for *_, k in outputs], known)
        found += _parts(p, block, order, outputs)
        known.update(k for *_, k in outputs if p.operations[k].op not in LEAVES)
    return found


def _order(p: Program, wanted: Sequence[int], known: set[int]) -> list[int]:
    """The operations that the wanted ones take, each behind its operands, without those that are known."""
    order: dict[int, None] = {}
    for last in wanted:
        waiting = [last]
        while waiting:
            k = waiting[-1]
            if k in order or k in known or p.operations[k].op in LEAVES:
                waiting.pop()
                continue
            missing = [a for a in p.operations[k].operands if not (a in order or a in known)]
            missing = [a for a in missing if p.operations[a].op not in LEAVES]
            waiting += reversed(missing)
            if not missing:
                order[k] = None
    return list(order)


def _parts(
    p: Program, block: Block, order: list[int], outputs: list[tuple[int, int, int]]
) -> Iterator[Stage]:
    """A block, in parts of LONGEST lines at most."""
    results = {k for *_, k in outputs}
    copies = len(outputs) - len(results & set(order))
    crossing = _crossing(p, order, results)
    edges = [0]
    while len(order) + copies - edges[-1] > LONGEST and edges[-1] + LONGEST // 2 < len(order):
        ends = range(edges[-1] + LONGEST // 2, min(edges[-1] + LONGEST, len(order) - 1) + 1)
        edges.append(min(ends, key=lambda at: (crossing[at], -at)))
    edges.append(len(order))
    part_of = {k: n for n, (a, b) in enumerate(pairwise(edges)) for k in order[a:b]}
    last = len(edges) - 2
    taken = _last_use(p, order)
    for n, (a, b) in enumerate(pairwise(edges)):
        own = tuple(order[a:b])
        mine = tuple(o for o in outputs if part_of.get(o[2], last) == n)
        handed = tuple(k for k in own if taken.get(k, 0) >= b and k not in results)
        yield Stage(block, n + 1 if last else 0, own, mine, handed)


def _last_use(p: Program, order: list[int]) -> dict[int, int]:
    """By operation: the place in the order of the last one that takes it."""
    return {a: at for at, k in enumerate(order) for a in p.operations[k].operands}


def _crossing(p: Program, order: list[int], results: set[int]) -> list[int]:
    """Of each place in the order: how many values without a name are taken behind it."""
    change = [0] * (len(order) + 1)
    taken = _last_use(p, order)
    for at, k in enumerate(order):
        if k not in results and k in taken:
            change[at + 1] += 1
            change[min(taken[k] + 1, len(order))] -= 1
    return list(accumulate(change))
