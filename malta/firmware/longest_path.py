"""Instructions on the longest path of a compiled function, at most: a bound for the time of the supervised step.

Instructions of a listing are nodes of a graph, and a loop is one node: its longest way round, times the passes that
the C text says (`for` up to a number). Of each branch the longer side counts, also where the sides of two branches
exclude each other, so that the bound may be above what ever happens. A loop that ends by its data (the search in a
table) counts once.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache
from typing import NamedTuple

# Functions stay functions, and a switch stays branches, so that lines and branches are those of the text.
FLAGS = ("-g", "-fno-inline", "-fno-partial-inlining", "-fno-ipa-cp", "-fno-ipa-sra", "-fno-jump-tables")
LISTING = ("-d", "-l", "-r", "--no-show-raw-insn")  # of objdump
_ENDS = re.compile(r"^(?:ret|retq|bx\s+lr|(?:pop|ldmia(?:\.w)?)\b.*\bpc\b.*)")
_LEAVES = re.compile(r"^(?:b|b\.n|b\.w|jmp|jmpq)\s")
_CALLS = re.compile(r"^(?:bl|blx|call|callq)\s")
_BRANCHES = re.compile(r"^(?:b[a-z]{2}(?:\.[nw])?|b|b\.n|b\.w|cbn?z|j[a-z]+)\s")


class Instruction(NamedTuple):
    """A line of a listing: what it costs, and where it may go."""

    address: int
    text: str
    weight: int  # passes of the loops that it is in
    symbol: str  # of another function that it calls or jumps to


def longest_path(listings: Mapping[str, str], texts: Mapping[str, str], function: str) -> int:
    """The instructions of a function with all that it calls, at most.

    listings : what objdump shows of each C file, compiled with FLAGS; texts : all files, headers too, by name
    """
    macros = dict(re.findall(r"#define (\w+) (\d+)u?\b", "\n".join(texts.values())))
    functions: dict[str, list[Instruction]] = {}
    for file, listing in listings.items():
        functions |= _functions_of(listing, passes_of(texts[file], macros))

    @cache
    def cost(name: str) -> int:
        code = functions.get(name, [])
        return _longest(code, [i.weight * (1 + (cost(i.symbol) if i.symbol else 0)) for i in code])

    return cost(function)


def passes_of(text: str, macros: Mapping[str, str]) -> list[int]:
    """How often each line of a C text runs at most, by the loops around it.

    >>> passes_of("for (k = 0; k < N; k++) {\\n  x++;\\n}\\ny++;", {"N": "4"})
    [4, 4, 4, 1]
    """
    lines = text.split("\n")
    passes = [1] * len(lines)
    for at, line in enumerate(lines):
        head = re.search(r"\bfor \(.*?[<>]=? \(?(\w+)", line)
        count = macros.get(head[1], head[1]).rstrip("u") if head else ""
        if not count.isdigit():
            continue
        depth = 0
        for k in range(at, len(lines)):
            passes[k] *= int(count)
            depth += lines[k].count("{") - lines[k].count("}")
            if depth <= 0:
                break
    return passes


def _functions_of(listing: str, passes: list[int]) -> dict[str, list[Instruction]]:
    """The instructions of each function."""
    found: dict[str, list[Instruction]] = {}
    code: list[Instruction] = []
    name, weight = "", 1
    for line in listing.splitlines():
        if head := re.match(r"^[0-9a-f]+ <([^>]+)>:$", line):
            name = head[1]
            code = found.setdefault(name, [])
        elif place := re.match(r"^\S*\.c:(\d+)", line):
            weight = passes[int(place[1]) - 1]
        elif relocation := re.match(r"^\s+[0-9a-f]+: R_\S*(?:CALL|JUMP|PLT|PC32)\S*\s+(\w+)", line):
            if code and (_CALLS.match(code[-1].text) or _LEAVES.match(code[-1].text)):
                code[-1] = code[-1]._replace(symbol=relocation[1])
        elif one := re.match(r"^\s+([0-9a-f]+):\s+([a-z].*)", line):
            text = one[2].strip()
            target = re.search(r"<(\w+)>", text)  # a function's beginning
            calls = target and target[1] != name and (_CALLS.match(text) or _LEAVES.match(text))
            code.append(Instruction(int(one[1], 16), text, weight, target[1] if target and calls else ""))
    return found


def _longest(code: list[Instruction], costs: list[int]) -> int:
    """The dearest way through instructions."""
    places = {i.address: k for k, i in enumerate(code)}
    after: dict[int, list[int]] = {}
    for k, i in enumerate(code):
        onward = [] if _ENDS.match(i.text) or _LEAVES.match(i.text) else [k + 1]
        goal = re.search(r"\b([0-9a-f]+) <", i.text)
        if goal and _BRANCHES.match(i.text) and not i.symbol and int(goal[1], 16) in places:
            onward.append(places[int(goal[1], 16)])
        after[k] = [j for j in onward if j < len(code)]
    return _way(after, costs, set(after), 0) if code else 0


def _way(after: Mapping[int, list[int]], costs: list[int], nodes: set[int], start: int) -> int:
    """The dearest way from a node within others; a loop is one node, whose cost is its dearest way round."""
    ways: dict[int, int] = {}  # from each loop on, by its first node in the order of its group
    groups = _loops(after, nodes, start)  # the last ones first
    group_of = {k: n for n, group in enumerate(groups) for k in group}
    for n, group in enumerate(groups):
        if len(group) == 1:
            own = costs[min(group)]
        else:
            first = start if start in group else min(j for k in nodes - group for j in after[k] if j in group)
            inside = {k: [j for j in after[k] if j in group and j != first] for k in group}
            own = _way(inside, costs, group, first)
        onward = {group_of[j] for k in group for j in after[k] if j in group_of and group_of[j] != n}
        ways[n] = own + max((ways[m] for m in onward), default=0)
    return ways[group_of[start]]


def _loops(after: Mapping[int, list[int]], nodes: Iterable[int], start: int) -> list[set[int]]:
    """The strongly connected groups that a node reaches, each behind those that it leads to (Tarjan 1972)."""
    allowed = set(nodes)
    number: dict[int, int] = {start: 0}
    low, path, found = {start: 0}, [start], []
    work = [(start, iter([j for j in after[start] if j in allowed]))]
    on_path = {start}
    while work:
        k, onward = work[-1]
        j = next(onward, None)
        if j is None:
            work.pop()
            if work:
                low[work[-1][0]] = min(low[work[-1][0]], low[k])
            if low[k] == number[k]:
                group = set()
                while k not in group:
                    group.add(path.pop())
                found.append(group)
                on_path -= group
        elif j not in number:
            number[j] = low[j] = len(number)
            path.append(j)
            on_path.add(j)
            work.append((j, iter([i for i in after[j] if i in allowed])))
        elif j in on_path:
            low[k] = min(low[k], number[j])
    return found
