"""malta without a folder of sources: from a zip, from compiled files alone, and without its metadata."""

from __future__ import annotations

import ast
import compileall
import json
import py_compile
import shutil
import site
import subprocess
import sys
import zipfile
from importlib import import_module, metadata
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT

import malta
from malta import files
from malta.model import machines

FORMS = ("zip", "compiled")
SHIPPED = ("data", "design/gains", "examples/ball")
BEGIN = ("__init__", "contents", "errors")  # what `import malta` reads
USE = """
import hashlib, json, pathlib, malta
from malta.app.server import script
from malta.report.page.document import page_style
plant = malta.plant_of(malta.read("data/tubular.toml"))
model = malta.linearize(plant, plant.at(z=0.0))
controller = malta.gains.read("design/gains/table2.json")
run = malta.simulate(plant, controller, malta.Scenario.stroke())
written = malta.export_c("design/gains/table2.json", "c")
c = "".join(path.read_text() for path in sorted(pathlib.Path("c").iterdir()))
plan = malta.campaigns.Plan(controller, "stroke", {"m": 0.1}, samples=8)
print(json.dumps({
    "malta": malta.__file__,
    "A": model.A.tolist(),
    "poles": sorted(map(abs, malta.loop(plant, controller).poles)),
    "end": [run.verdict.name, *run.p[-1]],
    "c": hashlib.sha256(c.encode()).hexdigest(),
    "pages": [len(page_style()), len(script())],
    "revision": sorted(plan.manifest["revision"]),
    "ball": malta.read("examples/ball/ball.toml").preset,
}))
"""


def run(place: Path, code: str, folder: Path) -> str:
    """What a Python prints that finds malta at a place alone, beside the libraries."""
    found = f"import sys; sys.path[:0] = {[str(place)]}; sys.path += {site.getsitepackages()}\n"
    command = [sys.executable, "-I", "-S", "-W", "error", "-c", found + code]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def in_a_zip(folder: Path, names: dict[str, Path]) -> Path:
    with zipfile.ZipFile(folder / "all.zip", "w") as archive:
        for name, path in names.items():
            archive.write(path, name)
    return folder / "all.zip"


def sources(folder: Path, name: str) -> dict[str, Path]:
    """The files of a folder, by the names that they have below another one."""
    paths = (path for path in sorted(folder.rglob("*")) if path.is_file() and "__pycache__" not in path.parts)
    return {f"{name}/{path.relative_to(folder).as_posix()}": path for path in paths}


@pytest.fixture(scope="module")
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A malta with what ships beside it, as a wheel has it: in a zip, or compiled without its sources."""
    names = sources(ROOT / "malta", "malta")
    for shipped in SHIPPED:
        names |= sources(ROOT / shipped, f"malta/shipped/{shipped}")
    folder = tmp_path_factory.mktemp("whole")
    if request.param == "zip":
        return in_a_zip(folder, names)
    for name, path in names.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, folder / name)
    assert compileall.compile_dir(folder / "malta", maxlevels=9, quiet=2, legacy=True)
    for path in (folder / "malta").rglob("*.py"):
        if "shipped" not in path.parts:
            path.unlink()
    return folder


@pytest.mark.parametrize("form", FORMS)
def test_public_names_need_no_sources(tmp_path: Path, form: str) -> None:
    names = {f"malta/{name}.py": ROOT / "malta" / f"{name}.py" for name in BEGIN}
    if form == "compiled":
        (tmp_path / "malta").mkdir()
        for name, path in names.items():
            py_compile.compile(str(path), str(tmp_path / f"{name}c"), doraise=True)
    place = in_a_zip(tmp_path, names) if form == "zip" else tmp_path
    code = "import json, malta; print(json.dumps([malta.__file__, malta.InputError.__name__, dir(malta)]))"
    file, error, listed = json.loads(run(place, code, tmp_path))
    assert file.startswith(str(place))
    assert (error, listed) == ("InputError", sorted(malta.__all__))


@pytest.fixture(scope="module")
def here(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the sources compute."""
    found: dict[str, Any] = json.loads(run(ROOT, USE, tmp_path_factory.mktemp("here")))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("whole", FORMS, indirect=True)
def test_it_computes_the_same(whole: Path, tmp_path: Path, here: dict[str, Any]) -> None:
    """Data, gains, templates, the engine's C and a page's style come from wherever the modules do."""
    found = json.loads(run(whole, USE, tmp_path))
    assert found.pop("malta").startswith(str(whole))
    assert found == {key: value for key, value in here.items() if key != "malta"}


def test_machines_and_version_without_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of the package's folder alone knows its own machines, and says that it knows no version."""

    def missing(name: str) -> Any:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(machines, "entry_points", lambda group: [])  # noqa: ARG005
    monkeypatch.setattr(metadata, "version", missing)
    assert set(machines._installed_machines.__wrapped__()) == {"tubular", "halbach", "planar"}
    assert files.version() == malta.__version__ == "unknown"


def lazy_packages() -> list[str]:
    names = [path.parent.relative_to(ROOT).as_posix() for path in (ROOT / "malta").rglob("__init__.py")]
    packages = [name.replace("/", ".") for name in sorted(names)]
    return [name for name in packages if isinstance(vars(import_module(name)).get("_NAMES"), dict)]


@pytest.mark.parametrize("package", lazy_packages())
def test_type_checkers_see_the_names_that_are_loaded(package: str) -> None:
    """The imports under TYPE_CHECKING are those of the dict, and every one leads to its name."""
    module: Any = import_module(package)
    assert module.__file__ is not None
    tree = ast.parse(Path(module.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = [
        (str(n.module), a.name, a.asname)
        for n in block.body
        if isinstance(n, ast.ImportFrom)
        for a in n.names
    ]
    assert [(place, name, name) for place, names in module._NAMES.items() for name in names.split()] == seen
    for _, name, _ in seen:
        assert getattr(module, name) is not None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "others"),
    [
        ("simulate", ("loops", "proof", "margins", "gains")),
        (
            "loop",
            ("proof", "margins", "simulation", "loops.curves", "loops.linear_loops", "loops.time_domain"),
        ),
        ("campaigns.Plan", ("proof", "margins", "campaigns.rare", "campaigns.studies", "campaigns.summary")),
        ("structured.h_infinity", ("proof", "model", "loops", "structured.rounds")),
    ],
)
def test_a_public_name_loads_what_it_needs(name: str, others: tuple[str, ...]) -> None:
    """A package loads its other names where they are asked for."""
    code = f"import sys, malta; malta.{name}; print(*(m for m in sys.modules if m.startswith('malta.')))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert len(loaded) > 10
    assert [one for one in loaded for other in others if f"{one}.".startswith(f"malta.{other}.")] == []
