"""Shared records: the machine, its linear model, and the shipped designs, each made once."""

from __future__ import annotations

import gc
import hashlib
import io
import math
import os
import pickle
import random
import re
import secrets
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import hypothesis
import pytest
from rich.console import Console

import malta
from malta.cli import main as cli
from malta.firmware import cost
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.machines.tubular import plant as tubular
from malta.model import machines
from malta.model.printed import read_published
from malta.proof import robust
from malta.proof.blocks import gain
from malta.proof.problem import OfLoop, OfSeveral, Problem
from malta.writing import replace_files

if TYPE_CHECKING:
    from malta.margins.loop_report import LoopReport
    from malta.model.linearize import LinearModel
    from malta.model.plant import Plant
    from malta.proof.box import Box
    from malta.synthesis.controller import Controller
    from malta.synthesis.spec import Spec

# As in the program: numeric libraries make many lasting objects, and going through them again and again costs time.
gc.set_threshold(200_000, 50, 50)

# A loaded computer fails no test; `make test` tries fewer cases than all tests together, and always the same ones.
SHARE = float(os.environ.get("SHARE", "1"))  # of the longer tests of each file that are run
hypothesis.settings.register_profile("untimed", deadline=None, max_examples=round(200 * SHARE))
hypothesis.settings.register_profile("fast", deadline=None, max_examples=30, derandomize=True)

os.environ.pop("COLUMNS", None)  # which workers of pytest may have: tables have the width of a file
# Of the make that runs the tests: a make inside one of them would say which folder it enters.
for _name in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS"):
    os.environ.pop(_name, None)
# A shell in the background ignores Ctrl-C, and so would all programs whose end by it is tested.
signal.signal(signal.SIGINT, signal.default_int_handler)
ROOT = Path(__file__).parents[1]
DESIGNS = ("table2", "calibrated")


@pytest.hookimpl(tryfirst=True)  # before hypothesis reads the seed
def pytest_configure(config: pytest.Config) -> None:
    fast = "not slow" in config.option.markexpr
    hypothesis.settings.load_profile("fast" if fast else "untimed")
    if not fast and config.option.hypothesis_seed is None:
        known: dict[str, Any] = getattr(config, "workerinput", {})
        config.option.hypothesis_seed = known.get("malta_seed", secrets.randbits(32))
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = False  # pytest-xdist keeps the order below


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    """Workers of pytest-xdist draw with the seed that the header tells."""
    node.workerinput["malta_seed"] = node.config.option.hypothesis_seed


def pytest_report_header(config: pytest.Config) -> str | None:
    """Cases of the longer tests are drawn anew each time: what repeats them."""
    seed = config.option.hypothesis_seed
    if seed is None:
        return None
    whole = "" if SHARE == 1 else f"{SHARE:.0%} of the longer tests (SHARE), "
    return f"{whole}cases drawn with --hypothesis-seed={seed}"


def undrawn_tests(items: list[pytest.Item], seed: int | None) -> set[str]:
    """The longer tests that are left out, the same ones by every worker; of each file one at least is run."""
    files: dict[str, list[str]] = {}
    for item in items:
        if item.get_closest_marker("slow"):
            files.setdefault(item.nodeid.partition("::")[0], []).append(item.nodeid)
    draw = random.Random(seed)
    kept = {name for names in files.values() for name in draw.sample(names, math.ceil(SHARE * len(names)))}
    return {name for names in files.values() for name in names} - kept


UNKNOWN_CASES = pytest.StashKey[
    set[tuple[str, str]]
]()  # cases that `slow_for` names of tests that have no such case


@pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Cases that the mark `slow_for` names are `slow`, and modules that are marked `first` come first."""
    named, known = set[tuple[str, str]](), set[tuple[str, str]]()
    for item in items:
        test, _, case = item.nodeid.partition("[")
        for mark in item.iter_markers("slow_for"):
            named |= {(test, name) for name in mark.args}
            known.add((test, case.removesuffix("]")))
            if case.removesuffix("]") in mark.args:
                item.add_marker(pytest.mark.slow)
    config.stash[UNKNOWN_CASES] = named - known
    left = undrawn_tests(items, config.option.hypothesis_seed) if SHARE < 1 else set()
    config.hook.pytest_deselected(items=[item for item in items if item.nodeid in left])
    items[:] = [item for item in items if item.nodeid not in left]
    items.sort(key=lambda item: item.get_closest_marker("first") is None)


class Design(NamedTuple):
    """One shipped design, all the way from its file."""

    spec: Spec
    plant: Plant
    model: LinearModel
    controller: Controller
    margins: LoopReport


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


def numbers(content: Any) -> list[float]:
    """Every number in a JSON document; null counts as NaN."""
    if isinstance(content, dict):
        return [number for entry in content.values() for number in numbers(entry)]
    if isinstance(content, list):
        return [number for entry in content for number in numbers(entry)]
    if content is None:
        return [math.nan]
    return [float(content)] if isinstance(content, (int, float)) else []


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
def _silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands say nothing of how far they are, however slow the machine; tests of that set their own patience."""
    monkeypatch.setattr("malta.cli.output.PATIENCE", math.inf)


@pytest.fixture(autouse=True)
def _in_the_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests name files as a user in the project's root does: data/tubular.toml."""
    monkeypatch.chdir(ROOT)


class Answers:
    """What is proven so far, by question: in a folder that all workers of a session share."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.known = folder, dict[str, Any]()

    def of(self, question: bytes, find: Callable[[], Any], lasts: Callable[[Any], bool]) -> Any:
        """The answer to a question, found once. One that does not last, as where the time was up, is forgotten."""
        key = hashlib.sha256(question).hexdigest()
        if key not in self.known:
            file = self.folder / key
            if file.exists():
                self.known[key] = pickle.loads(file.read_bytes())
            else:
                found = find()
                if not lasts(found):
                    return found
                self.known[key] = found
                replace_files({file: pickle.dumps(found)})
        return self.known[key]


def _loop(system: UncertainSystem, law: Any) -> Any:
    """All that a loop consists of."""
    matrices = system.matrices.serialize()
    return system.names, system.nominal, matrices, system.limits, system.sample_time, vars(law)


def _question(problem: Problem, box: Box, effort: robust.ProofEffort) -> bytes | None:
    """All that a margin depends on; None of polynomials."""
    loops = []
    for one in problem.problems if isinstance(problem, OfSeveral) else (problem,):
        if not isinstance(one, OfLoop):
            return None
        loops.append(_loop(one.loop.system, one.loop.law))
    return pickle.dumps((loops, vars(box), effort.tolerance, effort.limits))


@contextmanager
def _remembering(answers: Answers) -> Iterator[None]:
    """Questions that are answered already are not searched again."""
    searched, largest = robust.margin_of, gain.worst_case_gain

    def margin_of(problem: Problem, box: Box, effort: robust.ProofEffort) -> malta.proof.Margin:
        question = _question(problem, box, effort)
        if question is None:
            return searched(problem, box, effort)
        found: malta.proof.Margin = answers.of(
            question, lambda: searched(problem, box, effort), lambda margin: not margin.reason
        )
        if effort.progress is not None:
            effort.progress(found.lower or 0.0, found.upper)
        return found

    def worst_case_gain(system: UncertainSystem, law: Any, *of: Any, **options: Any) -> malta.proof.Gain:
        if not isinstance(law, Compensator):
            return largest(system, law, *of, **options)
        question = pickle.dumps((_loop(system, law), of, options))
        found: malta.proof.Gain = answers.of(
            question, lambda: largest(system, law, *of, **options), lambda found: not found.reason
        )
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robust, "margin_of", margin_of)
        patch.setattr(gain, "worst_case_gain", worst_case_gain)
        yield


@pytest.fixture(scope="session")
def _answers(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Answers:
    folder = tmp_path_factory.getbasetemp()
    return Answers((folder.parent if hasattr(request.config, "workerinput") else folder) / "answers")


@pytest.fixture(scope="session", autouse=True)
def _counted_once(_answers: Answers) -> Iterator[None]:
    """Reports of exports count a text's instructions once: compilers of three processors take seconds for it."""
    count = cost.cost_on

    def cost_on(p: cost.Processor, *of: Any) -> cost.ProcessorCost | None:
        tools = [shutil.which(p.prefix + tool) for tool in ("gcc", "size", "objdump")]
        found: cost.ProcessorCost | None = _answers.of(
            pickle.dumps((p, tools, of)), lambda: count(p, *of), lambda _: True
        )
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cost, "cost_on", cost_on)
        yield


@pytest.fixture(scope="module")
def proven_once(_answers: Answers) -> Iterator[None]:
    """For modules that are about what is done with margins: one search for each question."""
    with _remembering(_answers):
        yield


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
def designs(_answers: Answers) -> dict[str, Design]:
    """The shipped designs by name."""
    made = {}
    for name in DESIGNS:
        spec = malta.read_design(ROOT / "design" / f"{name}.toml")
        plant = spec.plant
        model = malta.linearize(plant, plant.at(**spec.operating_point))
        controller = malta.synthesize(spec, model)
        with _remembering(_answers):
            margins = malta.verify(model, controller, spec.uncertainty)
        made[name] = Design(spec, plant, model, controller, margins)
    return made


@pytest.fixture(params=DESIGNS)
def design(request: pytest.FixtureRequest, designs: dict[str, Design]) -> Design:
    """Each shipped design in turn."""
    return designs[request.param]


@pytest.fixture(autouse=True, scope="module")
def _machines_of_files() -> Iterator[None]:
    """Each test module leaves machines of files as it found them: others have some of the same name."""
    named, loaded = dict(machines._files), {name: sys.modules[name] for name in loaded_machines()}
    yield
    forget_machines()
    machines._files.update(named)
    sys.modules.update(loaded)


def loaded_machines() -> list[str]:
    """The names of modules that come from machines' files."""
    return [name for name in sys.modules if name.startswith(machines.FILES)]


def forget_machines() -> None:
    """Leave no machine of a file behind."""
    machines._files.clear()
    for name in loaded_machines():
        del sys.modules[name]


QUANTITY = re.compile(r"[-+±]*\d[\w.+-]*(?: (?:%|[munk]?(?:m|s|N|A|V|J|Hz|rad|kg|g))(?![\w/]))?")


def printed(renderable: object, width: int = 100) -> str:
    """As a terminal of some columns shows it: no line is longer, and nothing is cut off."""
    stream = io.StringIO()
    Console(file=stream, width=width, markup=False, highlight=False, emoji=False).print(renderable)
    text = stream.getvalue()
    assert max(len(line.rstrip()) for line in text.splitlines()) <= width
    assert "…" not in text
    return text


def assert_folds(renderable: object, *widths: int) -> None:
    """Narrow terminals show every number, with its unit on the same line, as often as a wide one does."""
    whole = Counter(QUANTITY.findall(printed(renderable, 1000)))
    for width in widths:
        assert not whole - Counter(QUANTITY.findall(printed(renderable, width)))


def one_sentence(err: str) -> str:
    """The one line on standard error, without the name of the program."""
    assert "Traceback" not in err
    assert err.startswith("malta: ")
    assert err.count("\n") == 1
    return err.removeprefix("malta: ").rstrip("\n")
