"""Shared records: the machine, its linear model, and the shipped designs, each made once."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

import malta
from malta import cli
from malta.data import published as read_published
from malta.plants import tubular

if TYPE_CHECKING:
    from malta.controller import Controller
    from malta.linearize import LinearModel
    from malta.plant import Plant
    from malta.spec import Spec
    from malta.verify import Margins

ROOT = Path(__file__).parents[1]
DESIGNS = ("table2", "calibrated")


class Design(NamedTuple):
    """One shipped design, all the way from its file."""

    spec: Spec
    plant: Plant
    model: LinearModel
    controller: Controller
    margins: Margins


def refusal(read: Callable[[], object], where: Path) -> malta.InputError:
    """The error that reading raises: one printable sentence that names the file."""
    with pytest.raises(malta.InputError) as caught:
        read()
    error = caught.value
    assert error.where == str(where)
    assert str(error).isprintable()
    assert str(error).startswith(f"{where}: ")
    assert f"found {error.found}, expected {error.expected}" in str(error)
    return error


class Said(NamedTuple):
    """What a command leaves behind."""

    code: int
    out: str
    err: str


Run = Callable[..., Said]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run `malta ARGUMENTS`: exit code, standard output, standard error."""

    def runs(*arguments: str | Path) -> Said:
        monkeypatch.setattr(sys, "argv", ["malta", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            cli.main()
        out, err = capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return Said(ended.value.code, out, err)

    return runs


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests name files as a user in the project's root does: data/tubular.toml."""
    monkeypatch.chdir(ROOT)


@pytest.fixture(scope="session")
def par() -> tubular.Parameters:
    """MALTA's parameters, preset table1."""
    parameters: tubular.Parameters = malta.read(ROOT / "data" / "tubular.toml")
    return parameters


@pytest.fixture(scope="session")
def plant(par: tubular.Parameters) -> Plant:
    """The nonlinear mover, preset table1."""
    return tubular.plant(par)


@pytest.fixture(scope="session")
def model(plant: Plant) -> LinearModel:
    """The linear model at z_ss = 0 without preload."""
    return malta.linearize(plant, plant.at(z=0.0))


@pytest.fixture(scope="session")
def published() -> dict[str, Any]:
    """What the paper prints."""
    return read_published(ROOT / "data" / "tubular.toml")


@pytest.fixture(scope="session")
def designs() -> dict[str, Design]:
    """The shipped designs by name."""
    made = {}
    for name in DESIGNS:
        spec = malta.read_design(ROOT / "design" / f"{name}.toml")
        plant = spec.plant
        model = malta.linearize(plant, plant.at(**spec.operating_point))
        controller = malta.synthesize(spec, model)
        made[name] = Design(spec, plant, model, controller, malta.verify(model, controller, spec.uncertainty))
    return made


@pytest.fixture(params=DESIGNS)
def design(request: pytest.FixtureRequest, designs: dict[str, Design]) -> Design:
    """Each shipped design in turn."""
    return designs[request.param]
