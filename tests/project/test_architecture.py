"""The house: packages in one order, modules without a cycle, generic code that knows no machine."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import conftest
import pytest
from conftest import ROOT, UNKNOWN_CASES
from house import ORDER as PACKAGES, imported, reached

import malta

# Each may import those before it; machines stand where nobody generic imports them.
GROUND = (
    "arrays",
    "contents",
    "errors",
    "units",
    "files",
    "interrupts",
    "writing",
    "tables",
    "processes",
    "bound",
    "display",
    "frames",
    "merits",
    "merit_lists",
    "work",
    "budget",
    "roots",
    "arguments",
)
ORDER = (*GROUND, *PACKAGES[1:])
MACHINES = {"tubular", "halbach", "planar"}
SOURCES = sorted((ROOT / "malta").rglob("*.py"))


def module_of(path: Path) -> str:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(path) for path in SOURCES}


@cache
def tree_of(path: Path) -> ast.Module:
    """A module's syntax."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def imports(path: Path, *, at_load: bool = False, late: bool = True) -> tuple[str, ...]:
    """The modules of malta that a module imports.

    at_load: those that it imports when it is imported itself; late: those of functions too
    """
    return tuple(_imports(statements(tree_of(path), lazy=late and not at_load, typing=not at_load)))


def _imports(nodes: Iterator[ast.AST]) -> Iterator[str]:
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "malta":
            for alias in node.names:
                whole = f"{node.module}.{alias.name}"
                yield whole if whole in MODULES else node.module
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name.split(".")[0] == "malta")


def statements(tree: ast.AST, *, lazy: bool, typing: bool) -> Iterator[ast.AST]:
    """All statements; lazy: those of functions too, typing: those that only types need."""
    for node in ast.iter_child_nodes(tree):
        function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
        types = isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        if (lazy or not function) and (typing or not types):
            yield node
            if not isinstance(node, ast.expr):  # no import stands in an expression
                yield from statements(node, lazy=lazy, typing=typing)


def package_of(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else None


@pytest.mark.slow
def test_packages_import_one_way() -> None:
    """In the order of the sentence: model, synthesis, proof, loops, margins, gains, simulation, campaigns, report."""
    upwards = []
    for path in SOURCES:
        own = package_of(module_of(path))
        if own in (None, "__main__"):
            continue
        assert own in ORDER
        for module in imports(path):
            other = package_of(module)
            machine = other == "machines" and own != "machines"
            if machine or (other is not None and ORDER.index(other) > ORDER.index(own)):
                upwards.append((module_of(path), module))
    assert upwards == []


def test_no_module_imports_itself_in_a_circle() -> None:
    graph = {module_of(path): set(imports(path, at_load=True)) - {module_of(path)} for path in SOURCES}
    order = list(TopologicalSorter(graph).static_order())  # raises CycleError
    assert (
        order.index("malta.errors")
        < order.index("malta.model.plant")
        < order.index("malta.simulation.simulate")
    )


def circles(graph: dict[str, set[str]]) -> list[set[str]]:
    """The largest sets of modules that reach each other."""

    @cache
    def reached(module: str) -> frozenset[str]:
        found, left = set[str](), [module]
        while left:
            left += graph.get(left.pop(), set()) - found
            found.update(left)
        return frozenset(found)

    sets = {frozenset(other for other in reached(module) if module in reached(other)) for module in graph}
    return [set(one) for one in sets if len(one) > 1]


def test_no_type_comes_from_a_module_that_imports_this_one() -> None:
    graph = {module_of(path): set(imports(path, late=False)) - {module_of(path)} for path in SOURCES}
    assert circles(graph) == []


def test_nobody_asks_of_which_class_a_problem_is() -> None:
    """A proof asks `Problem`: its traits, its loops, its polynomials."""
    asked = re.compile(r"isinstance\([^)]*\b(OfLoop|OfSeveral|CoefficientPolynomial|HeldLoop)\b")
    assert [module_of(path) for path in SOURCES if asked.search(path.read_text(encoding="utf-8"))] == []


def test_machines_know_nothing_of_each_other() -> None:
    for path in SOURCES:
        own = module_of(path).split(".")[2:3] if package_of(module_of(path)) == "machines" else []
        for module in imports(path):
            if own and package_of(module) == "machines":
                assert module.split(".")[2:3] in (own, []), (module_of(path), module)


def words_of_code(path: Path) -> Iterator[str]:
    """Names and texts of a module, without comments and docstrings."""
    text = path.read_text(encoding="utf-8")
    tree = tree_of(path)
    documented = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
    docstrings = {
        node.body[0].lineno
        for node in ast.walk(tree)
        if isinstance(node, documented) and node.body and ast.get_docstring(node) is not None
    }
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.NAME or (
            token.type == tokenize.STRING and token.start[0] not in docstrings
        ):
            yield token.string


@pytest.mark.slow
def test_generic_code_names_no_machine() -> None:
    named = []
    for path in SOURCES:
        if package_of(module_of(path)) not in ("machines", "cli"):
            words = set(re.findall(r"[a-z]+", " ".join(words_of_code(path)).lower()))
            named += [(module_of(path), machine) for machine in words & MACHINES]
    assert named == []


def test_a_machine_is_a_folder() -> None:
    folders = [
        path for path in sorted((ROOT / "malta" / "machines").iterdir()) if (path / "plant.py").is_file()
    ]
    assert [path.name for path in folders] == ["halbach", "planar", "tubular"]
    for folder in folders:
        own, printed = ({path.stem for path in place.iterdir()} for place in (folder, PAPERS / folder.name))
        assert {"experiments", "figures"} <= own
        assert {"claims", "experiments", "figures"} <= printed
        assert "claims" not in own


# papers/ compares malta with prints: malta knows nothing of it, and it knows of malta what a user knows,
PAPERS = ROOT / "papers" / "malta_papers"
# what a machine's folder is made of, ours or a user's, and where malta reads what it hands over;
OF_MACHINES = (
    *("malta.arrays", "malta.machines", "malta.simulation.experiments", "malta.simulation.references"),
    *("malta.report.figures.drawing", "malta.report.ledger", "malta.model.parts", "malta.model.printed"),
)
# and these names besides, which no other user has asked for yet: none is added.
OTHER_NAMES = {
    "malta.bound": {"at_least"},
    "malta.campaigns.result": {"rate", "yields_of"},
    "malta.campaigns.run": {"replay"},
    "malta.files": {"shipped_path"},
    "malta.margins.loop_report": {"ZONES"},
    "malta.simulation.current_control": {"link_voltage", "open_loop_gain"},
    "malta.simulation.engine": {"compiled"},
    "malta.simulation.engine.batch": {"is_compiled"},
    "malta.simulation.engine.compiled": {"compiler"},
    "malta.simulation.layout": {"numbers_of"},
    "malta.simulation.period": {"period_of"},
    "malta.simulation.readings": {"keys", "normals"},
    "malta.simulation.scenario": {"Correction", "setup_of"},
    "malta.synthesis.design_models": {"sampled_model"},
    "malta.synthesis.feedforward": {"V0_STEP", "V0_STEPS", "commutate_ahead", "static_feedforward"},
    "malta.synthesis.weighting": {"weights_of"},
    "malta.work": {"is_stopped", "share_time"},
}


def test_malta_knows_nothing_of_papers() -> None:
    """No import, in functions neither, and no name in a text: entry points alone lead there."""
    named = [module_of(path) for path in SOURCES if "malta_papers" in " ".join(words_of_code(path))]
    assert named == []


def test_papers_use_public_names() -> None:
    public = {
        (module.__name__, name)
        for module in (malta, *(getattr(malta, name) for name in malta.__all__))
        for name in getattr(module, "__all__", ())
    }
    others: dict[str, set[str]] = {}
    for path in sorted(PAPERS.rglob("*.py")):
        for node in statements(tree_of(path), lazy=True, typing=False):
            if isinstance(node, ast.Import):
                assert not [alias for alias in node.names if alias.name.split(".")[0] == "malta"]
            elif isinstance(node, ast.ImportFrom) and str(node.module).split(".")[0] == "malta":
                module = str(node.module)
                names = {alias.name for alias in node.names if (module, alias.name) not in public}
                if names and not any(f"{module}.".startswith(f"{known}.") for known in OF_MACHINES):
                    others.setdefault(module, set()).update(names)
    assert others == OTHER_NAMES


def test_every_name_of_the_contents_page_is_there() -> None:
    for name in malta.__all__:
        assert getattr(malta, name) is not None


def test_what_is_remembered_of_machines_is_bounded() -> None:
    """Caches without an end hold texts, numbers and programs: a page that is moved for a day does not grow."""
    endless = []
    for path in SOURCES:
        for node in tree_of(path).body:
            if not isinstance(node, ast.FunctionDef):
                continue
            marks = {ast.unparse(mark) for mark in node.decorator_list}
            if marks & {"cache", "functools.cache", "lru_cache(maxsize=None)"}:
                types = {ast.unparse(a.annotation) for a in node.args.args if a.annotation is not None}
                endless += [(node.name, one) for one in types - {"str", "int", "Path"} if "tuple[" not in one]
    assert endless == []


def test_slow_cases_exist(request: pytest.FixtureRequest) -> None:
    """A case that got another name would be a fast one again, unseen."""
    assert request.config.stash[UNKNOWN_CASES] == set()


def test_a_share_of_the_slow_tests_is_drawn_by_the_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    """By each worker the same, of every file one at least, and none of the fast tests is left out."""

    def item(name: str, *, slow: bool = True) -> Any:
        return SimpleNamespace(nodeid=name, get_closest_marker=lambda _: slow)

    items = [item(f"a.py::test_a[{k}]") for k in range(10)] + [item("b.py::test_one")]
    items += [item(f"a.py::test_fast[{k}]", slow=False) for k in range(10)]
    monkeypatch.setattr(conftest, "SHARE", 0.25)
    left = [conftest.undrawn_tests(items, seed) for seed in (1, 1, 2)]
    assert left[0] == left[1] != left[2]
    assert [len(one) for one in left] == [7, 7, 7]
    assert all(name.startswith("a.py::test_a[") for name in left[0])


# What a room never imports, in functions neither, whatever stands below it.
NEVER = {
    "checker": ("malta",),  # its own files it imports by relative names
    "linear": ("model", "synthesis", "loops", "proof", "margins"),
    "synthesis": ("loops", "simulation", "proof", "margins"),
    "loops": ("proof", "margins", "simulation"),
    "proof": ("model", "synthesis", "loops", "margins", "simulation", "machines"),
    "simulation": ("proof", "margins"),
}


def test_rooms_keep_to_what_they_know() -> None:
    """A prover knows matrices alone; the kernel (model to loops) and a flight know no prover."""
    broken = {
        (module_of(path), module)
        for path in SOURCES
        for module in imports(path)
        if {*module.split(".")[:2]} & {*NEVER.get(package_of(module_of(path)) or "", ())}
    }
    assert broken == set()


# What a function's module never reaches, however far its imports lead, in functions too: packages and modules of malta.
UNREACHED = {
    "gains.file": (
        *("loops", "proof", "margins", "simulation", "writing", "interrupts", "merits"),
        *("linear.system", "linear.uncertain", "linear.expressions"),
    ),
    "simulation.simulate": (
        *("loops", "proof", "margins", "gains", "writing", "interrupts", "merit_lists", "tables"),
        *("model.data", "model.signal_groups", "model.table_look_ups", "synthesis.spec", "synthesis.lqg"),
        *("simulation.trajectory_file", "simulation.engine.batch", "simulation.engine.sample_loops"),
    ),
    "loops.sampled_loops": (
        "proof",
        "simulation",
        "loops.rest",
        "linear.expressions",
        "linear.rational",
        "work",
    ),
    "loops.loop": (
        *("proof", "simulation", "linear.closed_loops", "linear.open_loops", "linear.systems", "budget"),
        *("loops.channel_margins", "loops.bandwidths", "synthesis.spec", "synthesis.recovery"),
    ),
    "proof.robust": (
        *("model", "synthesis", "loops", "linear.open_loops", "linear.diagrams", "linear.reduction"),
        *("linear.rational_tables", "linear.peaks", "linear.systems", "proof.rates", "proof.blocks"),
    ),
    "tuning.verify": (
        *("firmware", "campaigns", "identification", "report", "synthesis.spec", "synthesis.lqg"),
        *("synthesis.recovery", "synthesis.design_file", "linear.systems", "proof.certificate"),
    ),
    "firmware.export": (
        *("campaigns", "tuning", "report", "proof.rates", "proof.blocks", "margins.schedule_rates"),
        *("margins.verify", "synthesis.requirements", "synthesis.recovery", "linear.systems"),
    ),
}


@pytest.mark.slow
def test_a_function_does_not_reach_what_it_does_not_need() -> None:
    """`make architecture` counts the lines that are left to read."""
    trees = {
        f"malta.{one}" if one else "malta": tree_of(path) for path in SOURCES for one in [module_of(path)[6:]]
    }
    imports = {name: imported(tree) & trees.keys() for name, tree in trees.items()}
    for entry, others in UNREACHED.items():
        found = {name.removeprefix("malta.") for name in reached([f"malta.{entry}"], imports)}
        assert entry in found
        for other in others:
            assert f"malta.{other}" in trees
            assert not {name for name in found if name == other or name.startswith(f"{other}.")}, (
                entry,
                other,
            )


def test_what_a_function_needs_is_counted_by_what_runs() -> None:
    """Imports inside functions count, those for types alone do not; a circle of imports ends."""
    text = """
from __future__ import annotations
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from malta.b import B
else:
    from malta.c import C
def f():
    from malta import d
    import malta.e
"""
    found = imported(ast.parse(text))
    assert {"malta.c", "malta.d", "malta.e"} <= found
    assert "malta.b" not in found
    imports = {
        "malta": {"malta.z"},
        "malta.c": {"malta.d"},
        "malta.d": {"malta.c", "malta"},
        "malta.z": set[str](),
    }
    assert reached(["malta.c", "malta.x"], imports) == {"malta.c", "malta.d"}
