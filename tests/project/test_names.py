"""One name, one thing: functions are verbs or nouns, constants are nouns, a class name stands in one place."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator

from conftest import ROOT

TREES = {
    path: ast.parse(path.read_text(encoding="utf-8"))
    for folder in ("malta", "papers")
    for path in sorted((ROOT / folder).rglob("*.py"))
}
IRREGULAR = re.compile(
    r"""bent|built|chosen|drawn|driven|flown|found|given|gone|held|kept|known|lost|made|seen|
    sent|shown|spent|stuck|taken|taught|told|written""",
    re.VERBOSE,
)
NOUNS = re.compile(
    r"""binding|commissioning|coupling|decoupling|heading|rounding|setting|string|timing|tracking|
    winding""",
    re.VERBOSE,
)
# Of a record these read well: Scenario.excited(...), coils.limited(v, limit).
READS_WELL = {"bound", "excited", "limited", "sampled"}
ADJECTIVES = re.compile(
    r"""ABOUT|ABOVE|AFTER|AGAIN|AHEAD|ALIKE|ALL|APART|AROUND|BEFORE|BELOW|BENT|BESIDE|BETWEEN|
    BEYOND|CHEAP|CLOSE|COARSE|DEAR|DEEPEST|EACH|EMPTY|ENOUGH|EXACT|FAR|FARTHEST|FAST|
    FASTEST|FEW|FEWER|FEWEST|FINE|FINEST|FIRST|FIXED|FLAT|GIVEN|GONE|HIGHEST|HUGE|IDLE|
    INSIDE|KEPT|KNOWN|LARGER|LARGEST|LAST|LATE|LATER|LEAST|LESS|LIGHT|LONG|LONGEST|LOST|
    LOWEST|MANY|MORE|MOST|NARROW|NARROWEST|NEAR|NEAREST|NEVER|NEXT|NONE|NOTHING|OTHER|
    OTHERS|OVER|OWN|PLAIN|QUIET|REAL|REMEMBERED|ROUGH|ROUND|SAFE|SAME|SETTLED|SHORT|
    SHORTEST|SHOWN|SLOW|SLOWEST|SMALL|SMALLEST|SOME|STEEP|STIFF|STILL|SURE|TINY|UNBOUNDED|
    UNSTABLE|WHOLE|WHY|WIDE|WIDER|WIDEST|WITHIN|WORST""",
    re.VERBOSE,
)
SHARED = {"Parameters"}  # of every machine: its interface


def functions(body: list[ast.stmt]) -> Iterator[str]:
    """Functions and methods without properties."""
    for node in body:
        if isinstance(node, ast.FunctionDef):
            if not any("property" in ast.unparse(one) for one in node.decorator_list):
                yield node.name.strip("_")
        elif isinstance(node, ast.ClassDef):
            yield from functions(node.body)


def constants(body: list[ast.stmt]) -> Iterator[str]:
    for node in body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                yield from (one.id.strip("_") for one in ast.walk(target) if isinstance(one, ast.Name))


def test_a_function_is_no_bare_participle() -> None:
    found = {
        f"{path.name}: {name}"
        for path, tree in TREES.items()
        for name in functions(tree.body)
        if (re.fullmatch(r"[a-z]{2,}(?:ed|ing)", name) or IRREGULAR.fullmatch(name))
        and not NOUNS.fullmatch(name)
        and name not in READS_WELL
    }
    assert not found, "write the verb: what does it do?"


def test_a_constant_is_no_bare_adjective() -> None:
    found = {
        f"{path.name}: {name}"
        for path, tree in TREES.items()
        for name in constants(tree.body)
        if ADJECTIVES.fullmatch(name)
    }
    assert not found, "name what is so large, near or few"


def test_a_class_name_stands_in_one_place() -> None:
    names = Counter(
        node.name for tree in TREES.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)
    )
    assert {name for name, count in names.items() if count > 1} == SHARED
