"""Design and data files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

import malta
from fuzz.cases import ROOT, Case, require_finite
from fuzz.edits import cut, edited
from fuzz.oracle import Defect, Ended, observe
from malta.synthesis.design_file import read_design

EXAMPLES = ("ball", "rotor")


def _toml(tree: Any) -> str:
    """Tables as TOML, which has no null; integers beyond 64 bits are written as they are."""
    if isinstance(tree, dict):
        tree = {str(key): value for key, value in tree.items()}

    def plain(node: Any) -> Any:
        if isinstance(node, dict):
            return {str(key): plain(value) for key, value in node.items()}
        if isinstance(node, list):
            return [plain(value) for value in node]
        return "null" if node is None else node

    return tomlkit.dumps(plain(tree) if isinstance(tree, dict) else {"x": plain(tree)})


def _write_toml(case: Case, source: Path, target: Path) -> bool:
    """Write an edited TOML file; False where TOML cannot hold it."""
    data = source.read_bytes()
    if case.edits:
        try:
            data = _toml(
                edited(tomlkit.parse(source.read_text(encoding="utf-8")).unwrap(), case.edits)
            ).encode()
        except Exception:  # surrogates, keys of control characters
            return False
    target.write_bytes(cut(data, case.cuts))
    return True


def read_design_file(case: Case, folder: Path) -> Ended | None:
    """Read a design file, linearize its machine and synthesize its gains where it can be read."""
    example = case.base in EXAMPLES
    source = ROOT / (f"examples/{case.base}" if example else "") / "design" / f"{case.base}.toml"
    path = folder / "own" / "design" / "mine.toml"
    path.parent.mkdir(parents=True, exist_ok=True)
    data = path.parent.parent / (f"{case.base}.toml" if example else "data")
    if not data.exists():
        _bring_data(data, case.base, example=example)
    if not _write_toml(case, source, path):
        return None
    ended = observe(lambda: read_design(path), folder, [str(folder)])
    if ended.code == 0 and case.base not in ("planar", "rotor"):
        spec = ended.value

        def synthesize() -> Any:
            return malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at(**spec.operating_point)))

        made = observe(synthesize, folder)
        if made.code == 0:
            require_finite(made.value)
    return ended


def _bring_data(target: Path, name: str, *, example: bool) -> None:
    """Copies of what design files name: the data of the machines, and the modules of the examples."""
    sources = (ROOT / "examples" / name).glob("*.*") if example else (ROOT / "data").rglob("*.toml")
    for source in sources:
        inside = source.name if example else str(source.relative_to(ROOT / "data"))
        place = target.parent / inside if example else target / inside
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(source.read_bytes())


def read_data_file(case: Case, folder: Path) -> Ended | None:
    """Read a data file and build its machine where it can be read."""
    example = case.base in EXAMPLES
    source = ROOT / (f"examples/{case.base}" if example else "data") / f"{case.base}.toml"
    path = folder / "mine.toml"
    if example and not (folder / f"{case.base}.py").exists():
        _bring_data(path, case.base, example=True)
    if not _write_toml(case, source, path):
        return None
    ended = observe(lambda: malta.read(path), folder, [str(folder)])
    if ended.code == 0:
        for name, value in vars(ended.value).items():
            if isinstance(value, float) and not np.isfinite(value):
                raise Defect(f"{name} was read as {value}")
        if case.base != "planar":
            observe(lambda: malta.linearize(malta.plant_of(ended.value), malta.plant_of(ended.value).at()))
    return ended
