"""A machine of one's own, from its own folder, by every way in; and every wrong one in a sentence."""

from __future__ import annotations

import pickle
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from conftest import ROOT, forget_machines, one_sentence

import malta
from malta.model import machines, parts

if TYPE_CHECKING:
    from conftest import Run

BALL = ROOT / "examples" / "ball"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> Iterator[Path]:
    """A machine `lev`, as `malta new` writes it; forgotten afterwards."""
    monkeypatch.chdir(tmp_path)
    assert run("new", "lev")[0] == 0
    monkeypatch.chdir(tmp_path / "lev")
    yield tmp_path / "lev"
    forget_machines()


@pytest.mark.slow
@pytest.mark.usefixtures("folder")
def test_new_writes_a_folder_that_runs_at_once(run: Run) -> None:
    """Designed, verified, flown and flown many times by the command line."""
    code, out, err = run("design")
    assert (code, err) == (0, "")
    forget_machines()
    gains = "design/gains/lev.json"
    code, _, err = run("verify", gains)
    assert code == 2
    assert one_sentence(err).endswith("or its file by --machine lev.py")
    code, out, err = run("verify", gains, "--machine", "lev.py", "--no-worst-case")
    assert (code, err) == (0, "")
    proven = re.search(r"sampled +([\d.]+) % +([\d.]+) %", out)
    assert proven is not None
    assert 300 < float(proven[1]) <= float(proven[2]) < 330
    code, out, err = run("simulate", gains, "--scenario", "disturbance", "--option", "size=0.1")
    assert (code, err) == (0, "")
    assert "y moves by" in out
    code, out, err = run("campaign", gains, "--samples", "8", "--scenario", "hold", "--out", "c")
    assert (code, err) == (0, "")
    assert "100.0" in out


def test_the_module_has_at_most_80_lines(folder: Path) -> None:
    assert len((folder / "lev.py").read_text(encoding="utf-8").splitlines()) <= 80  # as the README says
    assert not [path for path in folder.rglob("*") if "ball" in path.name]


def test_new_refuses_what_would_harm(folder: Path, run: Run) -> None:
    for name, found in (("tubular", "'tubular'"), ("Bad-Name", "'Bad-Name'"), ("lev", "'lev'")):
        code, _, err = run("new", name)
        assert code == 2 or name == "lev"
        assert found in err or name == "lev"
    (folder / "other").mkdir()
    code, _, err = run("new", "other")
    assert (code, list((folder / "other").iterdir())) == (2, [])
    assert one_sentence(err).startswith("other: found a file or folder of that name")


def test_a_record_finds_its_own_plant(folder: Path) -> None:
    """In Python: the module by its file, the plant by its record, the gain file by the name that is known then."""
    module = malta.machine(folder / "lev.py")
    assert malta.machine(folder / "lev.py") is module
    par = malta.read(folder / "lev.toml")
    assert isinstance(par, module.Parameters)
    plant = malta.plant_of(par)
    assert (plant.name, plant.has_stroke, plant.contacts.names) == ("lev", False, ("stop",))
    spec = malta.read_design(folder / "design" / "lev.toml")
    model = malta.linearize(plant, plant.at())
    controller = malta.synthesize(spec, model)
    malta.gains.write(controller, malta.verify(model, controller), folder / "lev.json")
    again = malta.gains.read(folder / "lev.json")
    np.testing.assert_array_equal(again.K, controller.K)


WRONG = {
    "does not import": (
        "import casadi as ca",
        "import nothing_of_that_name",
        "ModuleNotFoundError: No module named",
    ),
    "a syntax error": ("def plant(", "def plant((", "SyntaxError"),
    "no Parameters": ("class Parameters:", "class Values:", "found"),
    "no plant": ("def plant(", "def machine(", "plant: found nothing, expected a function"),
    "f of a wrong size": ("ca.vertcat(x[1], (u + w) / par.m)", "u / par.m", "f: found 1 entries, expected 2"),
    "f that fails": ("(u + w) / par.m", "(u + w) / par.mass", "f: found AttributeError"),
    "another name": ('name="lev"', 'name="other"', "name: found 'other', expected 'lev'"),
    "twins": (
        'Signal("q_dot", "m/s")',
        'Signal("q", "m/s")',
        "states: found q q, expected names that differ",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_wrong_module_is_one_sentence(folder: Path, run: Run, wrong: str) -> None:
    old, new, expected = WRONG[wrong]
    file = folder / "lev.py"
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
    code, out, err = run("design", "design/lev.toml")
    assert (code, out) == (2, "")
    assert expected in one_sentence(err)
    assert not (folder / "design" / "gains").exists()


def test_wrong_data_is_one_sentence(folder: Path, run: Run) -> None:
    file = folder / "lev.toml"
    text = file.read_text(encoding="utf-8")
    for old, new, expected in (
        ("I_max ", "I_min ", "parameters.I_min: found an unknown parameter"),
        ('machine = "lev.py"', 'machine = "lost.py"', "lost.py: found no such file"),
        ('machine = "lev.py"', 'machine = "lost"', "machine: found 'lost', expected one of"),
    ):
        file.write_text(text.replace(old, new), encoding="utf-8")
        code, out, err = run("design", "design/lev.toml")
        assert (code, out) == (2, "")
        assert expected in one_sentence(err)


@pytest.mark.slow
def test_a_plant_is_written_about_its_operating_point(folder: Path, run: Run) -> None:
    """1 mm above the middle: another stiffness, a pull that the current has to balance, and it stands there."""
    file = folder / "lev.py"
    text = file.read_text(encoding="utf-8").replace("pull(par, x[0], i)", "pull(par, 1e-3 + x[0], i)")
    file.write_text(text, encoding="utf-8")
    par = malta.read(folder / "lev.toml")
    plant = malta.plant_of(par)
    closer, wider = par.s - 1e-3, par.s + 1e-3
    k_s = 2 * par.C * par.I_0**2 * (closer**-3 + wider**-3)
    model = malta.linearize(plant, plant.at())
    assert model.A[1, 0] * par.m == pytest.approx(k_s, rel=1e-12)
    spec = malta.read_design(folder / "design" / "lev.toml")
    controller = malta.synthesize(spec, model)
    (v0,) = set(controller.feedforward.v0.ravel().tolist())
    current = v0 * par.s**2 / (4 * par.C * par.I_0)
    force = par.C * (((par.I_0 + current) / closer) ** 2 - ((par.I_0 - current) / wider) ** 2)
    assert force == pytest.approx(par.m * par.g, rel=1e-12)
    assert v0 < 0.5 * par.m * par.g  # the nearer magnet carries most of the weight
    still = malta.experiment("hold", plant, controller, noise=0.0)
    assert np.abs(still.run.p).max() < 1e-12
    design = folder / "design" / "lev.toml"
    design.write_text(
        design.read_text(encoding="utf-8").replace(
            "operating_point = {}", 'operating_point = { q = { value = 1, unit = "mm" } }'
        ),
        encoding="utf-8",
    )
    assert run("design", "design/lev.toml")[0] == 0  # about 2 mm, then
    beside = malta.gains.read("design/gains/lev.json")
    assert beside.operating_point[0].tolist() == [1e-3, 0.0]


@pytest.mark.slow
def test_a_gain_file_runs_no_code_that_was_not_named(folder: Path, run: Run) -> None:
    """Beside a module of the machine's name, in the folder that the command runs in."""
    assert run("design", "design/lev.toml")[0] == 0
    forget_machines()
    (folder / "lev.py").write_text("raise SystemExit('run')", encoding="utf-8")
    with pytest.raises(
        malta.InputError, match=r"plant.name: found 'lev', expected one of .*--machine lev.py"
    ):
        malta.gains.read("design/gains/lev.json")


def test_a_changed_file_is_loaded_again(folder: Path) -> None:
    """The last one of a name counts; a record of the first keeps its plant."""
    before = malta.read(folder / "lev.toml")
    file = folder / "lev.py"
    file.write_text(file.read_text(encoding="utf-8").replace('("stop",)', '("floor",)'), encoding="utf-8")
    after = malta.read(folder / "lev.toml")
    assert malta.plant_of(after).contacts.names == ("floor",)
    assert malta.plant_of(before).contacts.names == ("stop",)
    assert malta.machine("lev") is malta.machine(file)
    assert machines.name_of(malta.machine(file)) == "lev"


def test_a_name_of_an_installed_machine_is_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "lev.py", tmp_path / "tubular.py")
    with pytest.raises(malta.InputError, match="a machine 'tubular', as an installed package has one"):
        malta.machine(tmp_path / "tubular.py")


def test_a_copy_of_a_machine_has_the_modules_beside_itself(folder: Path, tmp_path: Path) -> None:
    """The same text in two folders, of which one has experiments: each finds its own."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    (folder / "experiments.py").write_text("def fly() -> int:\n    return 1\n", encoding="utf-8")
    (copy / "experiments.py").write_text("def fly() -> int:\n    return 2\n", encoding="utf-8")
    for where, value in ((copy, 2), (folder, 1), (copy, 2)):
        module = malta.machine(where / "lev.py")
        plant = module.plant(malta.read(where / "lev.toml"))
        assert parts.attribute_of(plant, "experiments", "fly")() == value
        assert machines.name_of(module) == "lev"
    shutil.rmtree(copy)
    assert malta.machine(folder / "lev.py").__file__ == str((folder / "lev.py").resolve())


def test_the_text_of_a_machine_goes_to_a_worker(folder: Path) -> None:
    """Loaded from the text of its module where there is no file: the same plant."""
    malta.machine(folder / "lev.py")
    text = machines.sources_of("lev")
    (name,) = text
    assert name.startswith(f"{machines.FILES}.lev_")
    forget_machines()
    shutil.rmtree(folder)
    module = machines.load_sources("lev", text)
    assert module.plant.__module__ == name
    assert machines.sources_of("tubular") == {}


def test_parameters_may_stand_in_a_module_beside_the_plant(folder: Path) -> None:
    """As those of malta's own machines do, which need no module but that of the record to be found."""
    text = (folder / "lev.py").read_text(encoding="utf-8")
    start, end = text.index("@dataclass"), text.index("\n\n\ndef plant")
    imports = "from dataclasses import dataclass\n\nfrom malta.model import check_parameters, si\n\n\n"
    (folder / "parameters.py").write_text(imports + text[start:end], encoding="utf-8")
    moved = text[:start] + "from .parameters import Parameters" + text[end:]
    (folder / "lev.py").write_text(moved, encoding="utf-8")
    module = malta.machine(folder / "lev.py")
    record = pickle.loads(pickle.dumps(malta.read("lev.toml")))
    assert type(record).__module__ == f"{module.__name__}.parameters"
    assert machines.module_of(record) is module
    assert malta.plant_of(record).name == "lev"
    sources = machines.sources_of("lev")
    forget_machines()
    assert machines.load_sources("lev", sources).Parameters.__module__ == type(record).__module__


@pytest.mark.parametrize("name", ["tubular", "halbach", "planar"])
def test_the_plant_of_a_record_is_found_where_nothing_else_is_loaded(name: str) -> None:
    """As in a worker process, to which pickle brings a record alone."""
    module = malta.machine(name)
    record = malta.read(f"data/{name}.toml")
    assert module.__name__ != type(record).__module__
    del sys.modules[module.__name__]
    try:
        assert machines.module_of(record).__name__ == module.__name__
    finally:
        sys.modules[module.__name__] = module
