"""One text of a bound: no place shows more than is proven, all with the same digits, and no other code rounds one."""

from __future__ import annotations

import ast
import io
import math
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from decimal import Decimal
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from conftest import ROOT
from hypothesis import given, settings, strategies as st
from rich.console import Console

import malta
from malta.app.picture import margin_document
from malta.bound import at_least, at_most
from malta.cli.output import _bounds_text
from malta.cli.stroke_learning import _proven_contraction
from malta.firmware import export
from malta.firmware.signals import Target
from malta.margins.loop_report import ChainStage, LoopReport, TravelPlace
from malta.margins.margin_map import MarginMap
from malta.margins.outcome import Outcome
from malta.proof.blocks.gain import Gain
from malta.proof.loss import RayBound
from malta.proof.margin import NOT_PROVEN, Margin
from malta.proof.rates import RateBound
from malta.report.figures.margins import chain_figure
from malta.report.tables.design import front_markdown, requirements_table
from malta.report.tables.margins import loop_tables, open_bounds, worst_case_table
from malta.report.verdict import verdict_html, verdict_lines, verdict_text
from malta.structured import Tuned
from malta.synthesis.spec import Spec
from malta_papers.ledger import Row, claim_of

VALUES = (0.9962, 0.99999, 1.00001, 3.4999, math.inf, None)
HALF = 0.5  # range of a parameter: a change that is proven is half of the margin
BOX = ("100 % is the box", "box, 100 %", "100 %: ")  # no bounds
FAR = 7.3  # of the upper bound in multiples of the lower one: no number of the one is taken for the other


@settings(max_examples=40)
@given(st.floats(1e-9, 1e9), st.sampled_from([1.0, 0.2, 1 / (2 * math.pi)]))
def test_a_bound_that_is_read_back_never_says_more(value: float, factor: float) -> None:
    exact = Decimal(value) * Decimal(factor)
    room = Decimal("1e-15") * exact  # decimals that read back as the value are not the value
    for low, high in (
        (at_least(value).text(factor=factor), at_most(value).text(factor=factor)),
        (at_least(value).percent(factor, "e-2"), at_most(value).percent(factor, "e-2")),
    ):
        assert Decimal(low) <= exact + room
        assert Decimal(high) >= exact - room
    assert float(at_least(value).text()) <= value <= float(at_most(value).text())


def test_a_bound_keeps_the_digits_that_a_user_typed() -> None:
    for value in (0.9962, 0.29, 0.57, 1.1, 3.0, 16.39):
        assert at_least(value).percent() == at_most(value).percent() == f"{Decimal(repr(value)) * 100:.2f} %"
    assert [at_least(x).percent() for x in (None, math.inf, math.nan)] == ["nothing", "any", "none"]
    assert [at_most(x).text() for x in (None, math.inf, -0.30001)] == ["nothing", "not found", "-0.3"]


@cache
def ball() -> tuple[LoopReport, Spec]:
    spec = malta.read_design(ROOT / "examples/ball/design/ball.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))
    return malta.verify(spec.plant, controller), spec


def margin_of(lower: float | None) -> Margin:
    upper = math.inf if lower is None else lower * FAR
    return replace(NOT_PROVEN, lower=lower, upper=upper, reason="" if lower else "because", searched="up")


def gain_of(lower: float | None) -> Gain:
    found, proven = (2.0, None) if lower is None else (lower, lower * FAR)
    return Gain(found, proven, 10.0, {"m": 0.1}, 3, 0.1, "because" if lower is None else "")


def spoiled(lower: float | None) -> LoopReport:
    """The report of a ball with this margin everywhere."""
    found, _ = ball()
    margin = margin_of(lower)
    asked = Outcome("margin", 2.0, lower or 0.0, "1", "proof", at_least=True)
    return replace(
        found,
        robust=margin,
        chain=(
            ChainStage("LQR", margin, 1.0, "forces"),
            ChainStage("sampled", margin, 1.6, "sensors", loaded=True),
        ),
        places=(TravelPlace(0.0, margin, 1.6, 0.4, 1e-3),),
        tolerance={"m": (margin, margin)},
        mass=margin,
        worst={"y": gain_of(lower)},
        uncertainty={"m": HALF},
        requirements=(asked,),
    )


def rich_text(*parts: Any) -> str:
    file = io.StringIO()
    console = Console(file=file, width=200)
    for part in parts:
        console.print(part)
    return file.getvalue()


def drawn_text(figure: Any) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(lambda one: hasattr(one, "get_text")))


def map_of(lower: float | None) -> MarginMap:
    import numpy as np

    ends = np.array([0.5, 1.5])
    return MarginMap(
        "ball", "m", "C", ("kg", "1"), (1.0, 1.0), (0.2, 0.2), ends, ends, -np.ones((2, 2)), margin_of(lower), ("k",),
        "box", "", ("m", "C"),
    )  # fmt: skip


def tuned_of(lower: float | None) -> Tuned:
    law: Any = None
    return Tuned(
        {}, 1, law, None, {}, (), margin_of(lower), {("S", "y"): gain_of(lower)}, None, True, 1, 0.1, None
    )


def report_text(lower: float | None) -> str:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "rounded_margin", lambda *_: margin_of(lower))
        target = Target(ball()[0].controller, precision="float", fidelity="force")
        return export._margin_text(target, {"m": 0.2}, proof=True)


def proof_document(lower: float | None) -> str:
    from malta.app import worker
    from malta.app.files import Edit, open_design
    from malta.app.picture import solve

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker, "travel_margin", lambda *_, **__: margin_of(lower))
        problem = solve(open_design(ROOT / "examples/ball/design/ball.toml").apply(Edit()))
        (found,) = worker._proof(problem, lambda: False)
    return f"{found['proven']} {found['lost']}"


def eigenvalue_text(lower: float | None) -> str:
    upper = math.inf if lower is None else lower * FAR
    return str(margin_document(RayBound(upper, {}, None, None))["lost"])


def front_text(lower: float | None) -> str:
    from malta.tuning.search import Trial
    from malta.tuning.tune import TuningResult as Found

    trial = Trial((223.0, 50, 0.051), 1, {"margin": lower or 0.0, "force_noise f": 0.01, "motion y": 1e-6})
    found = Found(ball()[1], trial, (), (trial,), trials=3)
    shown = front_markdown(found).replace(" |", " % |")
    return f"{shown}\n{drawn_text(malta.report.front_figure(found))}"


def claim_text(lower: float | None) -> str:
    class OfBall:
        spec = ball()[1]

    figure = math.nan if lower is None else lower
    return claim_of(Row("share", "proven percent", lambda _: figure), [OfBall()], {}, ()).ours[0] + " %"  # type: ignore[list-item]


def merits_text(lower: float | None) -> str:
    units = {"percent": "%", "kg": "kg"}
    shown = ("margin_proven", "margin_lost_at", "requirement margin", "mass_margin")
    return "\n".join(f"{f.text} {units[f.unit]}" for f in spoiled(lower).figures if f.key in shown)


def certificate_text(lower: float | None) -> str:
    from flint import fmpq

    from malta.checker.file import StabilityClaim
    from malta.report.tables.certificate import claim_share

    share = 0.0 if lower is None or math.isinf(lower) else lower
    return claim_share(StabilityClaim(fmpq(*share.as_integer_ratio()), None, None, None, ()))


PLACES: dict[str, Callable[[float | None], str]] = {
    "str(Margin)": lambda v: str(margin_of(v)),
    "str(Gain)": lambda v: str(gain_of(v)),
    "str(RateBound)": lambda v: str(RateBound("p", 0.0, 1.0, v, v, 8, 1.0).description),
    "str(LoopReport)": lambda v: f"{spoiled(v)}\n{spoiled(v).description}",
    "verdict": lambda v: rich_text(verdict_text(spoiled(v))),
    "verdict on a page": lambda v: verdict_html(verdict_lines(spoiled(v))),
    "tables": lambda v: rich_text(*loop_tables(spoiled(v), None, ball()[1])),
    "worst case": lambda v: rich_text(worst_case_table({"y": gain_of(v)})),
    "open bounds": lambda v: "\n".join(open_bounds(spoiled(v))),
    "requirements": lambda v: rich_text(
        requirements_table(asked := spoiled(v).requirements), *map(str, asked)
    ),
    "figures of merit": merits_text,
    "chain figure": lambda v: drawn_text(chain_figure(spoiled(v))),
    "margin map": lambda v: drawn_text(malta.report.margin_map(map_of(v))),
    "REPORT of C": report_text,
    "certificate": certificate_text,
    "structured": lambda v: f"{tuned_of(v).certificate}\n{tuned_of(v).description}",
    "front of a search": front_text,
    "ledger": claim_text,
    "live page": lambda v: f"{proof_document(v)} {eigenvalue_text(v)}",
    "progress": lambda v: _bounds_text(v or 0.0, v * FAR if v else math.inf),
    "contraction": lambda v: _proven_contraction(gain_of(v)),
}
SHARES = {name for name in PLACES if name not in ("str(Gain)", "str(RateBound)", "worst case")}
WITHOUT_LOWER = {"open bounds"}  # says why a bound is not proven


def near(text: str, value: float, pattern: str) -> list[str]:
    """The numbers of a text that a bound may be: within 1 % of it."""
    scale = Decimal("0.01") if "%" in pattern else Decimal(1)
    found = re.findall(pattern, text)
    return [one for one in found if abs(Decimal(one) * scale / Decimal(value) - 1) < Decimal("0.01")]


@pytest.mark.parametrize("place", PLACES)
def test_no_place_says_more_than_is_proven(place: str) -> None:
    drawn = place in ("front of a search", "chain figure", "margin map")  # which take longest
    for value in VALUES[1::2] if drawn else VALUES:  # a number, one with another last digit, none
        check(place, value)


def check(place: str, value: float | None) -> None:
    text = PLACES[place](value)
    for words in BOX:
        text = text.replace(words, "")
    assert not re.search(r"\binf\b|\bnan\b|None", text.replace("no unstable machine", "")), text
    if value is None or math.isinf(value):
        return
    percent = r"(\d+\.?\d*(?:e[+-]?\d+)?) ?(?:%|percent)"
    low, high = (near(text, bound, percent) for bound in (value, value * FAR))
    assert all(Decimal(one) <= 100 * Decimal(repr(value)) for one in low), text
    assert all(Decimal(one) >= 100 * Decimal(repr(value * FAR)) for one in high), text
    if place in SHARES - WITHOUT_LOWER:
        assert {at_least(value).percent(unit="")} == {*low}, text
        assert {*high} <= {at_most(value * FAR).percent(unit="")}, text
    if place == "tables":
        assert f"-{at_least(value).percent(HALF)}" in text
        assert f" {at_least(value).text()} kg" in text
    number = r"(?<![\d.])(\d+\.\d+)(?! ?%|\d)"
    proven = (
        near(text, value * FAR, number)
        if place in ("str(Gain)", "worst case", "tables", "structured")
        else []
    )
    assert all(Decimal(one) >= Decimal(repr(value * FAR)) for one in proven), text


# No other code writes a bound by itself.


def formatted(path: Path) -> Iterator[tuple[int, str]]:
    """The places of a module that format or round `.lower` or `.upper`, by themselves or by a name that is one."""
    text = path.read_text(encoding="utf-8")
    tree = ast.parse(text if re.search(rf"\.({'|'.join(BOUNDS)})\b(?!\()", text) else "")
    for scope in ast.walk(tree):
        if not isinstance(scope, ast.FunctionDef):
            continue
        named = {
            target.id
            for node in ast.walk(scope)
            if isinstance(node, ast.Assign) and reads_bound(node.value, set())
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(scope):
            shown: list[ast.expr] = []
            if isinstance(node, ast.FormattedValue) and node.format_spec is not None:
                shown = [node.value]
            elif isinstance(node, ast.Call) and ast.unparse(node.func) in ROUNDERS:
                shown = node.args
            if any(reads_bound(one, named) for one in shown):
                assert isinstance(node, ast.expr)
                yield node.lineno, ast.unparse(node)


ROUNDERS = {"round", "number", "four_digits", "quantity", "frequency", "math.floor", "math.ceil"}
BOUNDS = {"lower", "upper", "proven", "lost"}


def reads_bound(node: ast.AST, named: set[str]) -> bool:
    """Whether an expression is made of the number of a bound; not by a call, which may be of `Bound`, or str.lower."""
    if isinstance(node, ast.Call | ast.Compare | ast.IfExp):
        return False
    if isinstance(node, ast.Attribute):
        return node.attr in BOUNDS
    if isinstance(node, ast.Name):
        return node.id in named
    return any(reads_bound(one, named) for one in ast.iter_child_nodes(node))


def test_a_formatted_bound_is_noticed(tmp_path: Path) -> None:
    module = tmp_path / "one.py"
    module.write_text(
        'def f(m):\n    t = 100 * m.lower\n    a = f"{100 * m.upper:.1f} %"\n    return a, f"{t:.2f}", round(m.lower)\n'
        'def g(m, s):\n    return f"{m.proven.percent()} {s.lower():>9}"\n'
    )
    assert sorted(line for line, _ in formatted(module)) == [3, 4, 4]


def test_nothing_else_writes_a_bound() -> None:
    contradiction = {"{lower:.9g}", "{upper:.9g}"}  # of two bounds, which no reader takes for proven
    found = {
        f"{path.relative_to(ROOT)}:{line}": text
        for folder in ("malta", "papers")
        for path in sorted((ROOT / folder).rglob("*.py"))
        for line, text in formatted(path)
        if text not in contradiction
    }
    assert found == {}


def test_the_live_page_shows_the_text_that_it_is_sent() -> None:
    for path in sorted((ROOT / "malta/app/static").glob("*.js")):
        text = path.read_text(encoding="utf-8")
        assert not re.findall(
            r"(?:percent|digits|quantity|toFixed|toPrecision)\([^()]*\b(?:lower|upper)\b", text
        )
