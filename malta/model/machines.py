"""Machines by name: the one module that finds and loads them.

A machine is a Python module with `Parameters` and `plant(par) -> Plant`. It comes from
  - an entry point of the group `malta.machines`: `tubular = "malta.machines.tubular.plant"` (malta's own and those of
    any installed package);
  - a file that the user names: `machine = "rotor.py"` in a data file, `--machine rotor.py`, or in Python
    `malta.machine("rotor.py")`.
A gain file names a machine, never a path, so reading one never runs code that the user did not name.
"""

from __future__ import annotations

import atexit
import hashlib
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, lru_cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from pkgutil import iter_modules
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from malta.errors import CheckError, InputError
from malta.files import file_exists, read_file
from malta.model.faults import line_of
from malta.model.parameters import Parameters

if TYPE_CHECKING:
    from malta.model.plant import Plant


class _File(NamedTuple):
    """A machine's file and the name of its module, which contains a hash of the text."""

    path: Path
    module: str


GROUP = "malta.machines"
FILES = "malta_machine_files"  # in sys.modules, the machines that come from files are modules of this package
_files: dict[str, _File] = {}  # machines that the user named by their files, by the files' stems


def machine(name: str | Path | ModuleType) -> ModuleType:
    """Find the module of a machine, by its name or by its file.

    After `malta.machine("rotor.py")` the name `rotor` finds this machine, as `malta.gains.read` does. A file is loaded
    again after its text has changed; the last file of a name counts, and records of an earlier one keep their plant.

    name : of an installed machine, as "tubular"; a file; or a module, which is returned unchanged

    Returns the module, with its Parameters and its function plant.

    Raises InputError for an unknown name, a file that cannot be imported, or a module without Parameters and plant.

    >>> import malta
    >>> malta.machine("examples/ball/ball.py").__doc__.splitlines()[0]
    'A steel sphere between two electromagnets: one axis, open-loop unstable.'
    """
    if isinstance(name, ModuleType):
        return _require_plant(name, str(getattr(name, "__file__", name.__name__)))
    if isinstance(name, Path) or name.endswith(".py"):
        return _from_file(Path(name))
    if name in _files:
        return sys.modules[_files[name].module]
    installed = _installed_machines()
    if name not in installed:
        known = ", ".join(map(repr, machine_names()))
        raise InputError("machine", "name", repr(name), f"one of {known}, or its file by --machine {name}.py")
    try:
        module = import_module(installed[name])
    except ImportError as error:
        raise InputError("machine", name, _reason(error), "a module that can be imported") from error
    return _require_plant(module, installed[name])


def name_of(module: ModuleType) -> str:
    """The machine's name: of its entry point, or the stem of its file."""
    if module.__name__.startswith(FILES + "."):
        return module.__name__.removeprefix(FILES + ".").split(".")[0].rpartition("_")[0]
    for name, target in _installed_machines().items():
        if target == module.__name__:
            return name
    return module.__name__.rpartition(".")[2]


def module_of(parameters: Any) -> ModuleType:
    """The module of the machine whose record of parameters this is: that of the record, or one beside it.

    A record may stand in a module of its own, `parameters`, beside a file or beside the `plant` of a folder.
    """
    own = sys.modules[type(parameters).__module__]
    folder = own.__name__.rpartition(".")[0]
    if hasattr(own, "plant") or not folder:
        return own
    beside = sys.modules.get(folder)
    if beside is not None and callable(getattr(beside, "plant", None)):
        return beside
    try:
        return import_module(f"{folder}.plant")
    except ModuleNotFoundError as error:
        if error.name not in (f"{folder}.plant", folder):  # a module that `plant` imports
            raise
        return own


@lru_cache(maxsize=64)  # records are immutable, and building a plant is slow
def build_plant(parameters: Any) -> Plant:
    """The plant that the function `plant` of a record's module makes, one for equal records; `plant_of` checks it."""
    module = module_of(parameters)
    build: Callable[[Any], Plant] | None = getattr(module, "plant", None)
    if build is None:
        raise InputError(module.__name__, "plant", "nothing", "a function of Parameters -> Plant beside them")
    name = name_of(module)
    try:
        plant = build(parameters)
    except (InputError, CheckError):
        raise
    except Exception as error:  # a user's function may raise anything
        found = f"{type(error).__name__}: {error}{(line := line_of(error)) and f', at {line}'}"
        raise InputError(f"{name}.py", "plant", found, "a function that makes a Plant") from error
    if not hasattr(plant, "design_states"):
        raise InputError(
            f"{name}.py", "plant", f"a function that returns {plant!r}", "one that returns a Plant"
        )
    if file_of(name) is not None and plant.name != name:
        raise InputError(f"{name}.py", "plant: name", repr(plant.name), f"{name!r}, as the file is called")
    return plant


def machine_names() -> list[str]:
    """The names of all machines: of installed packages and of files loaded so far."""
    return sorted({*_installed_machines(), *_files})


def file_of(name: str) -> Path | None:
    """The file of a machine that was loaded from a file; None for others."""
    return _files[name].path if name in _files else None


@cache
def _installed_machines() -> dict[str, str]:
    """The machines of installed packages, malta's own also without its metadata: names and modules."""
    own = {found.name: f"{GROUP}.{found.name}.plant" for found in iter_modules(import_module(GROUP).__path__)}
    return own | {point.name: point.value for point in entry_points(group=GROUP)}


def _from_file(path: Path) -> ModuleType:
    """Load the module of a machine's file, which imports modules beside it by `from . import NAME`."""
    where, name = path, path.stem
    path = path.resolve()
    if not re.fullmatch(r"[A-Za-z_]\w*", name):
        raise InputError(
            where, "", f"a file called {path.name!r}", "a name that Python can import, as rotor.py"
        )
    if not (file_exists(path) and path.is_file()):
        raise InputError(where, "", "no such file", "a Python module with Parameters and plant")
    if name in _installed_machines():
        found = f"a machine {name!r}, as an installed package has one"
        raise InputError(where, "", found, "another file name")
    text = read_file(where, "Python module", Path.read_bytes)
    module = f"{FILES}.{name}_{hashlib.sha256(text).hexdigest()[:12]}"
    known = sys.modules.get(module)
    if known is not None and Path(str(known.__file__)) != path:  # a copy, perhaps beside other modules
        module += hashlib.sha256(str(path).encode()).hexdigest()[:12]
    return _load(where, _File(path, module))


def _load(where: Path, file: _File) -> ModuleType:
    """The module of a machine's file, which counts from now on; loaded unless it is already."""
    module = sys.modules.get(file.module)
    if module is None:
        sys.modules.setdefault(FILES, ModuleType(FILES))
        folder = str(file.path.parent)
        spec = spec_from_file_location(file.module, file.path, submodule_search_locations=[folder])
        assert spec is not None
        assert spec.loader is not None
        module = module_from_spec(spec)
        sys.modules[spec.name] = module
        try:
            spec.loader.exec_module(module)
            _require_plant(module, where)
        except BaseException as error:
            del sys.modules[spec.name]
            if isinstance(error, InputError) or not isinstance(error, Exception):
                raise
            raise InputError(where, "", _reason(error), "a module that can be imported") from error
    _files[file.path.stem] = file
    return module


def _require_plant(module: ModuleType, where: str | Path) -> ModuleType:
    """The same module. Raises InputError when it lacks Parameters or plant."""
    for name, kind in (("Parameters", "a frozen dataclass"), ("plant", "a function of Parameters -> Plant")):
        if not callable(getattr(module, name, None)):
            raise InputError(where, name, "nothing", f"{kind} of this name")
    return module


def _reason(error: BaseException) -> str:
    """The error in one line, with its line of the file."""
    line = " ".join(str(error).split())[:160]
    at = ""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if isinstance(error, SyntaxError) and error.lineno:
        at = f" (line {error.lineno})"
    elif trace is not None and not trace.tb_frame.f_code.co_filename.startswith("<frozen"):
        at = f" (line {trace.tb_lineno} of {Path(trace.tb_frame.f_code.co_filename).name})"
    return f"{type(error).__name__}: {line}{at}"


def parameters_record(module: ModuleType, where: str | Path) -> type[Parameters]:
    """The class Parameters of a machine's module.

    Raises InputError unless it is a dataclass whose fields have units and one of which is `preset`.
    """
    record: Any = getattr(module, "Parameters")  # noqa: B009  a user's module
    if not (is_dataclass(record) and isinstance(record, type)):
        raise InputError(
            where, f"{module.__name__.rpartition('.')[2]}.Parameters", repr(record), "a frozen dataclass"
        )
    if not any("unit" in f.metadata for f in fields(record)):
        raise InputError(
            where, "Parameters", "no field with a unit", 'some, as `m: float = si("kg", above=0)`'
        )
    if "preset" not in {f.name for f in fields(record)}:
        raise InputError(where, "Parameters", "no field preset", '`preset: str = "custom"`')
    return cast("type[Parameters]", record)


def sources_of(name: str) -> dict[str, str]:
    """The texts of the modules of a machine that was loaded from a file, by module name; empty for others."""
    if name not in _files:
        return {}
    own = _files[name].module
    modules = {key: module for key, module in sys.modules.items() if key == own or key.startswith(own + ".")}
    paths = {key: getattr(module, "__file__", None) for key, module in modules.items()}
    return {key: Path(path).read_text(encoding="utf-8") for key, path in paths.items() if path}


def load_sources(name: str, sources: Mapping[str, str]) -> ModuleType:
    """Load a machine from the texts of its modules, as `sources_of` returns them, on a computer without its files."""
    own = min(sources, key=len)
    if own in sys.modules:
        return sys.modules[own]
    folder = Path(tempfile.mkdtemp(prefix="malta-machine-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    for key, text in sources.items():
        stem = name if key == own else key.rpartition(".")[2]
        (folder / f"{stem}.py").write_text(text, encoding="utf-8")
    path = folder / f"{name}.py"
    return _load(path, _File(path.resolve(), own))  # under the name that records from elsewhere bear
