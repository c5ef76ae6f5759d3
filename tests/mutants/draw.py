"""Mutants drawn at random: `python -m mutants.draw SEED COUNT` prints a list like those of this folder.

Every place of the packages at which an operator applies is a candidate: a comparison at its bound or turned round, a
sum for a difference, a product for a quotient, a number moved, `and` for `or`, a guard left out. Packages take turns,
and each draws among its candidates. What is only seen (numbers in what draws figures) is no candidate. The tests of a
mutant are the NEAREST modules of tests that import its module, directly or through others, those of few imports first.
"""

from __future__ import annotations

import ast
import random
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from mutants import ROOT

PACKAGES = ("proof", "loops", "simulation", "firmware", "campaigns", "report")
NEAREST = 4  # modules of tests
SEEN = ("malta/report/figures", "malta/report/plots")
COMPARED: dict[type[ast.cmpop], str] = {
    ast.Lt: "<=",
    ast.LtE: "<",
    ast.Gt: ">=",
    ast.GtE: ">",
    ast.Eq: "!=",
    ast.NotEq: "==",
    ast.Is: "is not",
    ast.IsNot: "is",
    ast.In: "not in",
    ast.NotIn: "in",
}
COMBINED: dict[type[ast.operator], str] = {ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*"}


def candidates(path: Path) -> list[tuple[str, str]]:
    """Every (old, new) of a module: old stands once in its text, new has one fault."""
    text = path.read_text(encoding="utf-8")
    lines = text.splitlines(keepends=True)
    found = []
    for node, new in _faults(ast.parse(text), str(path.relative_to(ROOT)).startswith(SEEN)):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        first, last = node.lineno - 1, node.end_lineno
        before = lines[first].encode()[: node.col_offset].decode()
        after = lines[last - 1].encode()[node.end_col_offset :].decode()
        while text.count("".join(lines[first:last])) > 1 and first > 0:
            first -= 1
            before = lines[first] + before
        found.append(("".join(lines[first:last]), before + new + after))
    return found


def _faults(tree: ast.Module, seen: bool) -> Iterator[tuple[ast.expr, str]]:
    """(node, text in its place) for every fault, outside of annotations."""
    skipped = {id(n) for node in ast.walk(tree) for part in _annotations(node) for n in ast.walk(part)}
    for node in ast.walk(tree):
        if id(node) in skipped:
            continue
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            other = COMPARED[type(node.ops[0])]
            yield node, f"{ast.unparse(node.left)} {other} {ast.unparse(node.comparators[0])}"
        elif isinstance(node, ast.BinOp) and type(node.op) in COMBINED and not _is_text(node):
            yield (node, f"({ast.unparse(node.left)}) {COMBINED[type(node.op)]} ({ast.unparse(node.right)})")
        elif isinstance(node, ast.Constant) and not seen and not isinstance(node.value, bool):
            if isinstance(node.value, int):
                yield node, repr(node.value + 1)
            elif isinstance(node.value, float):
                yield node, repr(1.05 * node.value)
        elif isinstance(node, ast.BoolOp):
            other_word = " or " if isinstance(node.op, ast.And) else " and "
            yield node, other_word.join(f"({ast.unparse(value)})" for value in node.values)
        elif isinstance(node, ast.If) and isinstance(node.body[0], ast.Raise | ast.Return | ast.Continue):
            yield node.test, "False"


def _annotations(node: ast.AST) -> list[ast.expr]:
    """The parts of a statement that say types."""
    parts = [getattr(node, "annotation", None), getattr(node, "returns", None)]
    if isinstance(node, ast.Subscript) and ast.unparse(node.value) in (
        "Literal",
        "Callable",
        "tuple",
        "dict",
    ):
        parts.append(node)
    return [part for part in parts if isinstance(part, ast.expr)]


def _is_text(node: ast.BinOp) -> bool:
    return any(isinstance(part, ast.JoinedStr | ast.List | ast.Tuple) for part in ast.walk(node)) or any(
        isinstance(part, ast.Constant) and isinstance(part.value, str) for part in ast.walk(node)
    )


@cache
def _imports(path: Path) -> frozenset[str]:
    """Names of the modules of malta that a file names."""
    return frozenset(re.findall(r"(?:from|import) (malta(?:\.\w+)*)", path.read_text(encoding="utf-8")))


def tests_of(module: Path) -> list[str]:
    """The modules of tests nearest to a module, by steps of imports."""
    reached = {".".join(module.relative_to(ROOT).with_suffix("").parts)}
    sources, modules = sorted((ROOT / "malta").rglob("*.py")), sorted((ROOT / "tests").rglob("test_*.py"))
    for _ in range(4):
        near = sorted((len(_imports(test)), test) for test in modules if _imports(test) & reached)
        if near:
            return [str(test.relative_to(ROOT)) for _, test in near[:NEAREST]]
        reached |= {
            ".".join(p.relative_to(ROOT).with_suffix("").parts) for p in sources if _imports(p) & reached
        }
    return []


def main(seed: int, count: int) -> None:
    """Print `count` mutants of a seed."""
    rng = random.Random(seed)
    pools = {
        package: [
            (path, *one)
            for path in sorted((ROOT / "malta" / package).rglob("*.py"))
            for one in candidates(path)
        ]
        for package in PACKAGES
    }
    print(
        f"# Drawn at random: python -m mutants.draw {seed} {count}, of {sum(map(len, pools.values()))} candidates."
    )
    print("tests = []")
    drawn = 0
    while drawn < count:
        path, old, new = rng.choice(pools[PACKAGES[drawn % len(PACKAGES)]])
        tests = tests_of(path)
        try:
            ast.parse(path.read_text(encoding="utf-8").replace(old, new))
        except SyntaxError:
            continue
        if not tests or path.read_text(encoding="utf-8").count(old) != 1 or old == new:
            continue
        drawn += 1
        listed = ", ".join(f'"{test}"' for test in tests)
        print(f'\n[[mutants]]\nfile = "{path.relative_to(ROOT)}"')
        print(f"old = '''\n{old}'''\nnew = '''\n{new}'''\ntests = [{listed}]")


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]))
