"""The public names of malta, and the pages of the reference that they stand on.

Public are the names of `malta.__all__`, and those of each module among them: what it defines or passes on (`from a
import b as b`).
"""

from __future__ import annotations

import ast
import importlib
import inspect
from functools import cache
from itertools import pairwise
from pathlib import Path
from types import ModuleType
from typing import Any

import malta

MODULES = tuple(name for name in malta.__all__ if isinstance(getattr(malta, name), ModuleType))
# Packages that pass on names of their own, on the page of the package.
LISTS = (
    "app",
    "model",
    "synthesis",
    "proof",
    "loops",
    "margins",
    "firmware",
    "campaigns",
    "identification",
    "simulation",
    "structured",
)


def names_of(page: str) -> list[str]:
    """List the public names on a page of the reference.

    page : a package, as "margins", for the names of malta itself that come from it, and for its own; a public module,
        as "malta.gains", for the names within it, or "malta.report:tables" for those from this part of it
    """
    if not page.startswith("malta."):
        own = [name for name in malta.__all__ if name not in MODULES]
        flat = [f"malta.{name}" for name in sorted(own, key=str.lower) if _package_of(name) == page]
        return flat + (names_of(f"malta.{page}") if page in LISTS else [])
    whole, _, part = page.partition(":")
    module = getattr(malta, whole.removeprefix("malta."))
    sources = dict(_passed_on(module))
    found = []
    for name in sorted(public_names(module), key=str.lower):
        here = not part or f"{sources.get(name)}.".startswith(f"{whole}.{part}.")
        if here and not isinstance(getattr(module, name), ModuleType):
            found.append(f"{whole}.{name}")
    return found


def all_names() -> list[str]:
    """List every public name."""
    own = [f"malta.{name}" for name in malta.__all__ if name not in MODULES]
    return own + [name for module in MODULES for name in names_of(f"malta.{module}")]


def value_of(name: str) -> Any:
    """Return what a public name stands for."""
    value: Any = malta
    for part in name.split(".")[1:]:
        value = getattr(value, part)
    return value


def docstring_of(name: str) -> str:
    """Return the text of a public name: of a constant the string below its assignment."""
    value = value_of(name)
    if inspect.isroutine(value) or inspect.isclass(value):
        return inspect.cleandoc(value.__doc__ or "")
    return _text_below(value_of(name.rpartition(".")[0]), name.rpartition(".")[2])


def summary_of(name: str) -> str:
    """Return the first paragraph of the text of a public name, on one line."""
    return " ".join(docstring_of(name).partition("\n\n")[0].split())


def _package_of(name: str) -> str:
    return str(getattr(malta, name).__module__).split(".")[1]


@cache
def _tree(module: ModuleType) -> ast.Module:
    assert module.__file__ is not None
    return ast.parse(Path(module.__file__).read_text(encoding="utf-8"))


def public_names(module: ModuleType) -> list[str]:
    """List the names that a module offers: what it passes on, and what it defines."""
    names = [alias for alias, _ in _passed_on(module)]
    names += [name for node in _tree(module).body for name in _defined_names(node)]
    return [name for name in dict.fromkeys(names) if not name.startswith("_")]


def _passed_on(module: ModuleType) -> list[tuple[str, str]]:
    """Names that a module imports for others, each with the module that it comes from."""
    imports = [node for node in ast.walk(_tree(module)) if isinstance(node, ast.ImportFrom) and node.module]
    return [(a.name, str(node.module)) for node in imports for a in node.names if a.asname == a.name]


def _defined_names(node: ast.stmt) -> list[str]:
    """The names that a statement of a module defines."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        return [node.name]
    targets = node.targets if isinstance(node, ast.Assign) else []
    targets = [node.target] if isinstance(node, ast.AnnAssign) else targets
    return [target.id for target in targets if isinstance(target, ast.Name)]


def _text_below(module: ModuleType, name: str) -> str:
    """The string below the assignment of a constant, in this module or in the one that it comes from."""
    for node, after in pairwise(_tree(module).body):
        if (
            name in _defined_names(node)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            return inspect.cleandoc(str(after.value.value))
    sources = dict(_passed_on(module))
    return _text_below(importlib.import_module(sources[name]), name) if name in sources else ""
