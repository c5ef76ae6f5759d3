"""`make architecture`: the packages of malta in the order in which they import: python docs/house.py [FILE].

A row is a package, a column one that it imports; the number counts the modules that do. What lies above the diagonal
would import upwards.

Beside the picture it prints what must be read to use a function: the lines and files of its module and of all that
these import, transitively, inside of functions too, but not for types alone. Strings and entry points are not seen.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from operator import attrgetter
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

ROOT = Path(__file__).parents[1] / "malta"
FILE = Path(__file__).parent / "_static" / "house.svg"
GROUND = "ground floor"  # modules beside the packages
ORDER = (
    *(
        GROUND,
        "checker",
        "linear",
        "model",
        "synthesis",
        "proof",
        "loops",
        "margins",
        "gains",
        "schemas",
        "simulation",
        "firmware",
    ),
    *("campaigns", "tuning", "structured", "identification", "report", "app", "machines", "cli"),
)

USES = {
    "gains.read": ("gains.read",),
    **{name: (name,) for name in ("simulate", "robust_margin", "export_c", "verify")},
    "kernel": ("linearize", "trim", "lqg", "synthesize", "loop", "simulate", "read_design", "gains.read"),
}


def room_of(module: str) -> str:
    """The package of a module, as malta.proof.box; the ground floor of malta.units."""
    name = (*module.split("."), "")[1]
    return name if name in ORDER else GROUND


def survey() -> tuple[Counter[str], Counter[str], Counter[tuple[str, str]]]:
    """Files and lines of each package, and how many modules of one import another."""
    files, lines, imports = Counter[str](), Counter[str](), Counter[tuple[str, str]]()
    for path in sorted(ROOT.rglob("*.py")):
        own = room_of(".".join(path.relative_to(ROOT.parent).with_suffix("").parts))
        text = path.read_text(encoding="utf-8")
        files[own] += 1
        lines[own] += text.count("\n")
        named = [node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
        found = {room_of(str(node.module)) for node in named if str(node.module).startswith("malta.")}
        if path.parent == ROOT and path.stem.startswith("__"):  # the page of contents, and the program
            continue
        imports.update((own, other) for other in found - {own})
    return files, lines, imports


def modules() -> dict[str, ast.Module]:
    """The trees of malta's modules by name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        name = ".".join(path.relative_to(ROOT.parent).with_suffix("").parts).removesuffix(".__init__")
        found[name] = ast.parse(path.read_text(encoding="utf-8"))
    return found


def imported(tree: ast.AST) -> set[str]:
    """The names of modules, and of what may be modules, that the code of a tree imports when it runs."""
    if isinstance(tree, ast.If) and "TYPE_CHECKING" in ast.unparse(tree.test):
        return set().union(*map(imported, tree.orelse))
    if isinstance(tree, ast.ImportFrom) and tree.module:
        return {tree.module, *(f"{tree.module}.{entry.name}" for entry in tree.names)}
    if isinstance(tree, ast.Import):
        return {entry.name for entry in tree.names}
    return set().union(*map(imported, ast.iter_child_nodes(tree)))


def reached(names: Iterable[str], imports: Mapping[str, set[str]]) -> set[str]:
    """These modules and all that they import, transitively, without the page of contents."""
    found, left = set[str](), [name for name in names if name in imports]
    while left:
        name = left.pop()
        if name not in found and name != "malta":
            found.add(name)
            left += imports[name]
    return found


def measures() -> dict[str, str]:
    """Lines and files that functions need, and how much is said more than once, as the picture's text."""
    trees = modules()
    imports = {name: imported(tree) & trees.keys() for name, tree in trees.items()}
    paths = {name: ROOT.parent.joinpath(*name.split(".")) for name in trees}
    files = {
        name: path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        for name, path in paths.items()
    }
    lines = {name: file.read_text(encoding="utf-8").count("\n") for name, file in files.items()}
    found = {}
    for use, names in USES.items():
        needed = reached(
            (attrgetter(name)(importlib.import_module("malta")).__module__ for name in names), imports
        )
        found[use] = f"{sum(lines[name] for name in needed)} lines, {len(needed)} files"
    classes = [node for tree in trees.values() for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    fields = [
        {ast.unparse(entry.target) for entry in one.body if isinstance(entry, ast.AnnAssign)}
        for one in classes
    ]
    found["records with A and B"] = str(sum({"A", "B"} <= own for own in fields))
    found["names of several classes"] = str(sum(n > 1 for n in Counter(one.name for one in classes).values()))
    found["malta"] = f"{sum(lines.values())} lines, {len(lines)} files"
    return found


def size(lines: int) -> str:
    """Lines in hundreds, digits in groups."""
    return f"{round(lines, -2):_}".replace("_", " ")


def house() -> Figure:
    """The matrix of packages."""
    files, lines, imports = survey()
    count = np.array([[imports[row, column] for column in ORDER] for row in ORDER], dtype=float)
    figure = Figure(figsize=(8.6, 6.2), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(np.log1p(count), cmap="Greys", vmax=6, aspect="auto")
    for k in range(len(ORDER)):
        axes.plot(k, k, "s", color="0.2", markersize=7)
        for n in np.flatnonzero(count[k]).tolist():
            axes.text(n, k, f"{count[k, n]:.0f}", ha="center", va="center", fontsize=8)
    labels = [f"{row}: {files[row]} files, {size(lines[row])} lines" for row in ORDER]
    axes.set_yticks(range(len(ORDER)), labels, fontsize=8)
    axes.set_xticks(range(len(ORDER)), ORDER, fontsize=8, rotation=45, ha="right")
    axes.set(xlabel="is imported by so many modules of the row", ylabel="package")
    axes.set_xticks(np.arange(-0.5, len(ORDER)), minor=True)
    axes.set_yticks(np.arange(-0.5, len(ORDER)), minor=True)
    axes.grid(which="minor", color="0.85", linewidth=0.6)
    axes.tick_params(which="both", length=0)
    whole = f"{sum(files.values())} files, {size(sum(lines.values()))} lines"
    axes.set_title(f"malta: {whole}; nothing imports upwards but the check of a certificate", fontsize=9)
    return figure


if __name__ == "__main__":
    mpl.rcParams.update({"svg.hashsalt": "malta", "svg.fonttype": "none"})
    target = Path(sys.argv[1]) if sys.argv[1:] else FILE
    house().savefig(target, metadata={"Date": None}, facecolor="white")
    for what, much in measures().items():
        print(f"{what:26}{much}")
    print(target)
