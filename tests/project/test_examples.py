"""The reference: every public name says what its parameters or fields are, and has an example that runs.

Public are the names of `malta.__all__`, and those of each module among them: what it defines
or passes on (`from a import b as b`).
"""

from __future__ import annotations

import doctest
import inspect
import io
import re
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from public import all_names, docstring_of, public_names, value_of

import malta
from malta.model import machines

pytestmark = pytest.mark.usefixtures("proven_once")

ROOT = Path(__file__).parents[2]
FOLDERS = ("data", "design", "examples")  # that examples read
# The examples that take longest, compilers included; the others together take some two seconds of processor time.
SLOW = {
    "malta.app.app_widget",
    "malta.firmware.engine_of_c",
    "malta.export_c",
    "malta.export_fmu",
    "malta.simulation.fastest_stroke",
    "malta.ledger",
    "malta.structured.tune_design",
    "malta.simulation.replay_run",
    "malta.report.CampaignFigures",
    "malta.report.campaign",
    "malta.report.chain_figure",
    "malta.report.chain_table",
    "malta.report.comparison_page",
    "malta.report.disk_table",
    "malta.report.distributions_figure",
    "malta.report.gain_page",
    "malta.report.gang_of_four",
    "malta.report.gang_table",
    "malta.report.load_limits_figure",
    "malta.report.load_response",
    "malta.report.recovery_figure",
    "malta.report.loop_tables",
    "malta.report.margin_map",
    "malta.report.open_bounds",
    "malta.report.places_table",
    "malta.report.sensitivity_figure",
    "malta.report.sensitivity_curves",
    "malta.report.sensitivity_tables",
    "malta.report.spreads_table",
    "malta.report.stroke_figure",
    "malta.report.tolerance_table",
    "malta.report.worst_figure",
    "malta.campaigns.sensitivity",
    "malta.tune",
}
WIDEST = 86  # letters of an example's line, prompt and all, that a page shows without scrolling
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE  # tables end their lines with spaces
DESCRIPTORS = (property, cached_property, classmethod)
ENTRY = re.compile(r"^(\*{0,2}\w+(?:, \w+)*) : ", re.MULTILINE)  # "name : meaning", or "one, two : meaning"


@pytest.fixture(autouse=True)
def own_machines(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forget the machines that an example names: other tests have some of the same name."""
    monkeypatch.setattr(machines, "_files", dict(machines._files))


def test_every_public_name_is_listed() -> None:
    """The lists are not empty, and the package's own agrees with its contents page."""
    assert set(public_names(malta)) == set(malta.__all__)
    assert {"malta.gains.read", "malta.references.stroke", "malta.report.stroke_figure"} < set(DOCUMENTED)
    assert len(DOCUMENTED) > 120


DOCUMENTED = {name: docstring_of(name) for name in all_names()}


def _parameters(value: Any) -> tuple[set[str], set[str]]:
    """The parameters or fields that a docstring has to explain, and those that it may explain beside them."""
    if is_dataclass(value):
        return {field.name for field in fields(value)}, set()
    if hasattr(value, "_fields"):
        return set(value._fields), set()
    if inspect.isclass(value):
        value = value.__init__ if "__init__" in vars(value) else None
    if not inspect.isroutine(value):
        return set(), set()
    listed = inspect.signature(value).parameters
    details = {
        key
        for parameter in listed.values()
        if parameter.kind is parameter.VAR_KEYWORD and "Unpack" in str(parameter.annotation)
        for key in get_type_hints(value)[parameter.name].__args__[0].__annotations__
    }
    return {name for name in listed if name not in ("self", "cls")}, details


def _explained(text: str) -> set[str]:
    """The names that a docstring explains, as "name : meaning"."""
    return {name.strip("* ") for names in ENTRY.findall(text) for name in names.split(",")}


def _methods(name: str) -> dict[str, Any]:
    """The methods and properties of a public class, by their names; none of anything else."""
    value = value_of(name)
    members = vars(value) if inspect.isclass(value) else {}
    return {
        f"{name}.{key}": getattr(member, "func", getattr(member, "__func__", member))
        for key, member in members.items()
        if not key.startswith("_") and (callable(member) or isinstance(member, DESCRIPTORS))
    }


METHODS = {name: method for listed in DOCUMENTED for name, method in _methods(listed).items()}


def test_names_explain_their_parameters_and_no_others() -> None:
    wrong = {}
    methods = {name: inspect.getdoc(method) or "" for name, method in METHODS.items()}
    for name, text in {**DOCUMENTED, **methods}.items():
        needed, allowed = _parameters(METHODS[name] if name in METHODS else value_of(name))
        explained = _explained(text)
        wrong[name] = sorted(needed - explained) + [f"{one}?" for one in sorted(explained - needed - allowed)]
    assert {name: found for name, found in wrong.items() if found} == {}


def test_names_begin_with_a_sentence() -> None:
    summaries = {name: text.partition("\n\n")[0] for name, text in DOCUMENTED.items()}
    assert [
        name for name, text in summaries.items() if not re.fullmatch(r"[A-Z].*[.:]", text, re.DOTALL)
    ] == []


def test_examples_fit_the_width_of_a_page() -> None:
    lines = [
        line
        for text in DOCUMENTED.values()
        for line in re.findall(r"^(?:>>>|\.\.\.) .*$", text, re.MULTILINE)
    ]
    assert len(lines) > 500
    assert [line for line in lines if len(line) > WIDEST] == []


def test_a_missing_and_an_invented_parameter_are_found() -> None:
    """The checks above can fail."""
    without_wanted = "Do it.\n\nplan, limit : of it\nother : nothing\n    more : text"
    assert _explained(without_wanted) == {"plan", "limit", "other"}
    needed, allowed = _parameters(malta.campaigns.tolerances)
    assert {"wanted"} <= needed - _explained(without_wanted)
    assert _explained(without_wanted) - needed - allowed == {"other"}


def _examples(name: str, text: str) -> Iterator[doctest.DocTest]:
    """The examples of a name and of the methods of its class."""
    parser = doctest.DocTestParser()
    yield parser.get_doctest(text, {}, name, None, None)
    for part, method in _methods(name).items():
        yield parser.get_doctest(inspect.getdoc(method) or "", {}, part, None, None)


@pytest.mark.slow_for(
    "malta.excite",
    "malta.identify",
    "malta.measure",
    "malta.Scenario",
    "malta.verify",
    "malta.identification.contraction",
    "malta.identification.ExcitationPlan",
    "malta.identification.Identified",
    "malta.identification.learn_strokes",
    "malta.identification.LearnedStrokes",
    "malta.identification.Measurement",
    "malta.identification.MeasurementPlan",
    "malta.identification.plan_measurement",
    "malta.loops.Loop",
    "malta.report.verdict_text",
)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in DOCUMENTED]
)
def test_the_example_of_a_name_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a folder of its own, so that the files which examples write are left nowhere."""
    for folder in FOLDERS:
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "80")
    tests = list(_examples(name, DOCUMENTED[name]))
    assert tests[0].examples, f"{name} has no example"
    runner, said = doctest.DocTestRunner(optionflags=FLAGS), io.StringIO()
    for test in tests:
        runner.run(test, out=said.write)
    assert not runner.failures, said.getvalue()


def test_slow_examples_are_public_names() -> None:
    assert set(DOCUMENTED) >= SLOW
