"""The compiled engine against CasADi's own evaluation: every operation, every fidelity, and its cache."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, strategies as st

import malta
from malta import references
from malta.simulation.engine import compiled, engines, engines as translate, lanes as lanes_of
from malta.simulation.engine.compiled import LANES, process_folder
from malta.simulation.engine.engines import engine_of, library_of, shape_of
from malta.simulation.engine.instructions import Counts
from malta.simulation.layout import FIDELITIES, Fidelity
from malta.simulation.period import Period
from malta.simulation.scenario import Fault, Scenario, setup_of
from malta.simulation.trajectory import SERIES

if TYPE_CHECKING:
    from conftest import Design

    from malta.arrays import FloatArray
    from malta.model.plant import Plant

STATES, GIVEN, THETA = 3, 3, 2  # of the engine that expressions are tried in
SIXTYFOURTHS = st.integers(-512, 512).map(
    lambda k: k / 64
)  # sums, products and comparisons of these are exact
OPERATIONS = """ADD SUB MUL DIV INV NEG SQ TWICE SQRT FABS FLOOR CEIL SIGN FMOD FMIN FMAX LT LE EQ NE NOT AND OR
IF_ELSE_ZERO SIN COS TAN ASIN ACOS ATAN ATAN2 SINH COSH TANH EXP LOG POW CONSTPOW HYPOT"""
NO_NOISE = np.zeros((1, 1))
NOT_FAST = np.zeros((0, 0))
TABLE = compiled.feedforward_table(np.array([-1.0, 0.0, 1.0]), np.array([[-1.0], [0.0], [3.0]]))


class Trial(NamedTuple):
    """Expressions of (state, given, theta): compiled with one lane, with eight, and as CasADi evaluates them."""

    parts: Period
    one: Any
    many: Any
    reference: ca.Function


needs_compiler = pytest.mark.skipif(compiled.compiler() is None, reason="no C compiler")


def _values(n: int) -> Any:
    return st.lists(SIXTYFOURTHS, min_size=n, max_size=n)


def _symbols() -> tuple[Any, ...]:
    sizes = {"state": STATES + 1, "given": GIVEN, "noise": 1, "y": 1, "v0": 1, "held": 1, "theta": THETA}
    return tuple(ca.SX.sym(name, size) for name, size in sizes.items())


def _parts(row: Callable[[Any, Any, Any], Any]) -> tuple[Period, ca.Function]:
    """A machine that stands still and leaves `row` of its state, what it is given and its numbers; and its digest."""
    state, around, noise, y, v0, held, theta = _symbols()
    expression = ca.densify(row(state[:STATES], around, theta))
    rest = ca.SX.sym("row", expression.numel() + 1)
    parts = Period(
        ca.Function("sense", [state, around, noise, theta], [noise, around[0]]),
        ca.Function("decide", [state, around, y, v0, theta], [state[STATES], v0, ca.vertcat(expression, v0)]),
        ca.Function("substep", [state[:STATES], held, around, ca.SX(0, 1), theta], [state[:STATES]]),
        tuple(f"theta{k}" for k in range(THETA)),
    )
    kept = ca.SX.sym("kept", rest.numel())
    return parts, ca.Function("digest", [kept, rest, around, theta], [rest])


def _library(text: str, lanes: int, folder: Path | None = None) -> Any:
    lib = compiled.library(text, lanes, folder)
    if lib is None:
        pytest.skip("no C compiler")
    return lib


def _trial(row: Callable[[Any, Any, Any], Any]) -> Trial:
    parts, digest = _parts(row)
    state, around, *_, theta = _symbols()
    return Trial(
        parts,
        _library(translate.source(parts, None), 1),
        _library(translate.source(parts, digest), LANES),
        ca.Function("reference", [state[:STATES], around, theta], [row(state[:STATES], around, theta)]),
    )


def _run_one(trial: Trial, state: Any, given: FloatArray, theta: Any) -> FloatArray:
    """The rows that one lane leaves, without the last column: v0 of the table."""
    run = engines.compiled_engine(
        trial.one.run, trial.parts.decide.size1_out(2), np.array(theta, dtype=float), 1, TABLE
    )
    begin = np.append(np.array(state, dtype=float), 0.0)
    _, rows = run.run(0, begin, given, np.zeros((len(given), 1)), NOT_FAST)
    return rows[:, :-1]


def _run_lanes(
    trial: Trial, states: FloatArray, given: FloatArray, thetas: FloatArray, table: FloatArray = TABLE
) -> FloatArray:
    """The last row of each of eight lanes, without v0 of the table."""
    return _digests(trial, states, given, thetas, table)[:, :-1]


def _digests(
    trial: Trial, states: FloatArray, given: FloatArray, thetas: FloatArray, table: FloatArray
) -> FloatArray:
    states = np.hstack([states, np.zeros((LANES, 1))])
    theta, start, digests = (
        lanes_of.arrange_in_lanes(rows, 1)
        for rows in (thetas, states, np.zeros((LANES, trial.parts.decide.size1_out(2))))
    )
    lanes = lanes_of.Lanes(
        theta, start, np.zeros((1, 1, LANES)), np.zeros((1, LANES), dtype=np.uint64), digests
    )
    shared = lanes_of.Shared(np.ascontiguousarray(given), table, 1, False)
    lanes_of.run_many(trial.many, slice(0, 1), lanes, shared)
    return np.asarray(digests[0].T)


# Every operation


def _continuous(rng: np.random.Generator, leaves: list[Any], depth: int) -> Any:
    """A random expression of operations that pass on small errors as small errors, within a few hundred in size."""
    if depth == 0:
        return leaves[rng.integers(len(leaves))]

    def part() -> Any:
        return _continuous(rng, leaves, depth - 1)

    def tame(scale: float) -> Any:
        return scale * ca.tanh(part() / 8)

    forms: list[Callable[[], Any]] = [
        lambda: part() + part(),
        lambda: part() - part(),
        lambda: tame(8) * tame(8),
        lambda: part() / (1.5 + ca.fabs(part())),
        lambda: 1 / (1.5 + ca.fabs(part())),
        lambda: -part(),
        lambda: tame(8) ** 2,
        lambda: part() + ca.fabs(part()),
        lambda: ca.sin(tame(30)),
        lambda: ca.cos(tame(30)),
        lambda: ca.tan(tame(1.2)),
        lambda: ca.exp(tame(3)),
        lambda: ca.log(1 + ca.fabs(part())),
        lambda: ca.sqrt(1 + ca.fabs(part())),
        lambda: ca.asin(tame(0.9)),
        lambda: ca.acos(tame(0.9)),
        lambda: ca.atan(part()),
        lambda: ca.sinh(tame(3)),
        lambda: ca.cosh(tame(3)),
        lambda: ca.tanh(part()),
        lambda: ca.atan2(part(), 0.5 + ca.fabs(part())),
        lambda: ca.hypot(part(), 1 + ca.fabs(part())),
        lambda: (1 + ca.fabs(tame(3))) ** tame(2),
        lambda: (1 + ca.fabs(tame(3))) ** 2.7,
        lambda: ca.fmin(part(), part()),
        lambda: ca.fmax(part(), part()),
        lambda: 2 * part(),
    ]
    return forms[rng.integers(len(forms))]()


def _steps(leaves: list[Any]) -> list[Any]:
    """What jumps, of numbers that are exact: there both must agree on the side."""
    a, b, c = leaves[0] + leaves[3], leaves[1] - leaves[4], leaves[6] * 0.5
    return [
        ca.floor(a),
        ca.ceil(a),
        ca.floor(b + 0.5),
        ca.sign(c),
        ca.sign(a - leaves[5]),
        a < b,
        a <= b,
        a == c,
        a != c,
        ca.logic_not(leaves[2]),
        ca.logic_and(leaves[2], leaves[5]),
        ca.logic_or(leaves[2], leaves[5]),
        ca.logic_and(a > b, ca.logic_or(b > c, c == 0)),
        ca.if_else(a < b, leaves[2], c),
        ca.if_else(a == b, ca.sin(a), ca.exp(c / 8)),
        ca.if_else(b > 0, ca.sqrt(ca.fabs(b)), ca.if_else(c > 0, b * c, -a)),
        ca.fmod(a, 3.0),
        ca.fmod(a, 1 + leaves[5] ** 2),
        ca.fmin(a, b),
        ca.fmax(a, b),
        ca.fmin(ca.fmax(a, -1.0), 1.0),
        ca.atan2(a, b),
        ca.atan2(leaves[2], leaves[5]),
        ca.fabs(b) ** leaves[6],
        ca.SX(2.5) + 0 * a,
    ]


def _everything(state: Any, around: Any, theta: Any) -> Any:
    rng = np.random.default_rng(20)
    leaves = [*ca.vertsplit(state), *ca.vertsplit(around), *ca.vertsplit(theta)]
    random = [_continuous(rng, leaves, depth) for depth in (1, 2, 3) for _ in range(25)]
    constant = [_continuous(rng, leaves[-THETA:], 3) for _ in range(10)]
    mixed = [r * k + k / (2 + ca.fabs(k)) for r, k in zip(random, constant, strict=False)]
    return ca.vertcat(*_steps(leaves), *random, *constant, *mixed, *leaves)


@contextmanager
def _parts_of(statements: int) -> Iterator[None]:
    """Every function that is longer is cut in parts of so many statements."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(translate, "MAX_WHOLE_STATEMENTS", statements)
        patch.setattr(translate, "MAX_PART_STATEMENTS", statements)
        yield


@pytest.fixture(scope="module", params=[translate.MAX_WHOLE_STATEMENTS, 7], ids=["whole", "in parts"])
def everything(request: pytest.FixtureRequest) -> Trial:
    """Some 130 expressions in every operation that the engine knows, in one library for each number of lanes."""
    with _parts_of(request.param):
        return _trial(_everything)


def test_every_operation_is_tried(everything: Trial) -> None:
    f = everything.reference
    names = {getattr(ca, name): name for name in dir(ca) if name.startswith("OP_")}
    tried = {names[f.instruction_id(k)].removeprefix("OP_") for k in range(f.n_instructions())}
    assert tried - {"INPUT", "OUTPUT", "CONST"} == set(OPERATIONS.split())


@given(state=_values(STATES), around=_values(GIVEN), theta=_values(THETA))
def test_one_lane_computes_what_casadi_does(
    everything: Trial, state: list[float], around: list[float], theta: list[float]
) -> None:
    """Random trees of all operations, of states, inputs and constants: what is constant alone is computed once."""
    expected = np.array(everything.reference(state, around, theta)).ravel()
    found = _run_one(everything, state, np.array([around]), theta)[0]
    assert np.isfinite(expected).all() == np.isfinite(found).all()
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-12)


@given(values=_values(LANES * (STATES + THETA)), around=_values(GIVEN))
def test_every_lane_computes_what_casadi_does(
    everything: Trial, values: list[float], around: list[float]
) -> None:
    """Eight machines of different states and numbers in one register: branches differ from lane to lane."""
    states, thetas = np.split(np.reshape(values, (LANES, STATES + THETA)), [STATES], axis=1)
    found = _run_lanes(everything, states, np.array([around]), thetas)
    for lane in range(LANES):
        expected = np.array(everything.reference(states[lane], around, thetas[lane])).ravel()
        np.testing.assert_allclose(found[lane], expected, rtol=1e-11, atol=1e-12)


@pytest.fixture(scope="module")
def waves() -> Trial:
    """sin and cos of the first state plus the first input."""
    return _trial(lambda s, g, _: ca.vertcat(ca.sin(s[0] + g[0]), ca.cos(s[0] + g[0])))


def test_sine_and_cosine_are_right_to_1e_15(waves: Trial) -> None:
    """Over +-1e5 rad, near the quadrants' edges, and where a shorter form takes over; small angles to two units in
    the last place: a mover in its air gap tilts by milliradians."""
    rng = np.random.default_rng(0)
    edges = np.pi / 4 * np.arange(-2000, 2001)
    x = np.concatenate(
        [
            *(rng.uniform(-size, size, 50_000) for size in (1e5, 1e4, 100, 1)),
            *(edges + step for step in (0, 1e-12, -1e-12, 1e-6, -1e-6)),
            *(near + rng.uniform(-1e-3, 1e-3, 1000) for near in (0.02, -0.02, 0.785)),
            10 ** rng.uniform(-300, -1, 1000),
            np.array([0.0, 1e-300, -1e-20, 1e-9, 1e4, -1e5]),
        ]
    )
    found = _run_one(waves, np.zeros(STATES), np.pad(x[:, None], ((0, 0), (0, 2))), np.zeros(THETA))
    expected = np.array([np.sin(x), np.cos(x)]).T
    assert np.abs(found - expected).max() < 1e-15
    small = np.abs(x) < 0.02  # the tilt of a mover in its air gap, and three times as much
    assert (np.abs(found - expected) / np.spacing(np.abs(expected)))[small].max() <= 2


def test_quotients_are_right_over_all_sizes() -> None:
    """Reciprocals may be computed without a division; they are right to two units in the last place, and what has no
    answer has none."""
    trial = _trial(lambda s, g, _: ca.vertcat(1 / s[0], g[0] / s[0]))
    rng = np.random.default_rng(2)
    sizes = rng.choice([-1, 1], (100, LANES)) * 10 ** rng.uniform(-300, 300, (100, LANES))
    for row in sizes:
        states = np.zeros((LANES, STATES))
        states[:, 0] = row
        found = _run_lanes(trial, states, np.array([[3.0, 0, 0]]), np.zeros((LANES, THETA)))
        np.testing.assert_allclose(found, np.array([1 / row, 3 / row]).T, rtol=5e-16)
    nothing = _run_lanes(trial, np.zeros((LANES, STATES)), np.array([[3.0, 0, 0]]), np.zeros((LANES, THETA)))
    assert not np.isfinite(nothing).any()


def test_a_lane_does_not_depend_on_its_neighbours(waves: Trial) -> None:
    """Small angles take a short way only where all lanes are small: the last digit is all that may differ."""
    rng = np.random.default_rng(1)
    around, thetas = np.zeros((1, GIVEN)), np.zeros((LANES, THETA))
    for small in np.concatenate([rng.uniform(-0.785, 0.785, 300), [0.0, 0.7848, -0.7848]]):
        states = np.zeros((LANES, STATES))
        states[:, 0] = small
        together = _run_lanes(waves, states, around, thetas)
        assert np.array_equal(together, np.tile(together[0], (LANES, 1)))
        states[1:, 0] = 100 * rng.uniform(1, 10, LANES - 1)
        np.testing.assert_allclose(
            _run_lanes(waves, states, around, thetas)[0], together[0], rtol=0, atol=1e-15
        )


def _tilts(state: Any, around: Any, _: Any) -> Any:
    x = state[0] + around[0]
    return ca.vertcat(ca.sin(x), ca.cos(x), 1 / ca.cos(x), ca.tan(x))


@pytest.fixture(scope="module", params=[translate.MAX_WHOLE_STATEMENTS, 1], ids=["whole", "in parts"])
def tilted(request: pytest.FixtureRequest) -> Trial:
    """Sine, cosine and their quotients of a state and an input: angles of a mover, as the engine sees it."""
    with _parts_of(request.param):
        return _trial(_tilts)


def test_small_tilts_are_right_to_two_units_in_the_last_place(tilted: Trial) -> None:
    rng = np.random.default_rng(3)
    for size in (1e-300, 1e-9, 1e-4, 1e-2, 0.02):
        angles = size * rng.uniform(-1, 1, (50, LANES))
        for x in angles:
            states = np.zeros((LANES, STATES))
            states[:, 0] = x
            found = _run_lanes(tilted, states, np.zeros((1, GIVEN)), np.zeros((LANES, THETA)))
            expected = np.array([np.sin(x), np.cos(x), 1 / np.cos(x), np.tan(x)]).T
            unit = np.spacing(expected)
            assert (np.abs(found - expected) / np.abs(unit)).max() <= 2


@pytest.mark.parametrize("lane", [0, LANES - 1])
def test_a_tilt_that_grows_is_done_over(tilted: Trial, lane: int) -> None:
    """Small, large for a while, and small again: right at every sample."""
    states = np.zeros((LANES, STATES))
    states[:, 0] = 1e-3 * np.arange(LANES)
    states[lane, 0] = 5e-3
    inputs = np.zeros((9, GIVEN))
    inputs[3:6, 0], inputs[7, 0] = 1.0, 7e-3
    for samples in range(1, 10):
        found = _run_lanes(tilted, states, inputs[:samples], np.zeros((LANES, THETA)))
        x = states[:, 0] + inputs[samples - 1, 0]
        expected = np.array([np.sin(x), np.cos(x), 1 / np.cos(x), np.tan(x)]).T
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15 * np.abs(expected).max())


@pytest.mark.parametrize("z_grid", [[-1.0, 0.0, 1.0, 2.0], [-1.0, -0.9, 1.0, 2.0], [0.5, 3.0]])
def test_lanes_look_up_even_grids_and_others(waves: Trial, z_grid: list[float]) -> None:
    v0 = np.random.default_rng(4).uniform(-3, 3, len(z_grid))
    table = compiled.feedforward_table(np.array(z_grid), v0[:, None])
    at = np.unique([*np.linspace(z_grid[0], z_grid[-1], 50), *z_grid])
    for z in at:
        given = np.array([[z, 0, 0]])
        found = _digests(waves, np.zeros((LANES, STATES)), given, np.zeros((LANES, THETA)), table)[:, -1]
        np.testing.assert_allclose(found, np.interp(z, z_grid, v0), rtol=0, atol=1e-14)


def test_sums_share_their_factor() -> None:
    """Two quotients by one number of the machine are one product; equal operations are one; nothing is lost."""
    state, theta = ca.SX.sym("state", 3), ca.SX.sym("theta", 2)
    apart = [
        state[0] / theta[0] * theta[1],
        state[1] * (1 / theta[0]) * theta[1],
        theta[1] * state[2] / theta[0],
    ]
    _, moving, counts, _ = translate.translate(ca.Function("f", [state, theta], [sum(apart)]), [])
    assert moving.count(" * ") == 1
    assert counts.c == 1


# Long functions in parts


_PLACE = re.compile(r"\bs\[\d+\]")  # of the array that parts hand numbers over in


def _statements(text: str) -> list[tuple[str, str]]:
    """What is computed from what, in order, whatever the functions it stands in."""
    lines = [line for line in text.splitlines() if line.startswith("  const ")]
    return [(name, value) for name, _, value in (line.partition(" = ") for line in lines)]


def _engine_text(row: Callable[[Any, Any, Any], Any], name: str = "decide") -> str:
    """C of one function of the engine that `row` is tried in."""
    parts, _ = _parts(row)
    return translate.translate(getattr(parts, name), [1]).function


def test_only_long_functions_are_cut() -> None:
    """In parts of the same statements in the same order, none of them longer than allowed."""
    whole = _engine_text(_everything)
    count = len(re.findall(r"^  const \w+ t", whole, re.MULTILINE))
    with _parts_of(count):
        assert _engine_text(_everything) == whole
    assert "noinline" not in whole
    with _parts_of(count - 1):
        assert _engine_text(_everything).count("noinline") == 2
    with _parts_of(40):
        cut = _engine_text(_everything)
    *parts, last = cut.split("}\n")[:-1]
    assert len(parts) == -(-count // 40)
    assert all(30 <= len(re.findall(r"^  const \w+ t", part, re.MULTILINE)) <= 40 for part in parts)
    assert re.findall(r"  decide_(\d+)\(c, ", last) == [str(k) for k in range(len(parts))]
    for found, expected in zip(_statements(cut), _statements(whole), strict=True):
        assert found[0] == expected[0]


def test_parts_find_every_place_as_it_was_left() -> None:
    """Whoever reads a place of the array finds the very number that it was written for; places are taken again."""
    with _parts_of(20):
        cut = _engine_text(_everything)
    expected = iter(_statements(_engine_text(_everything)))
    places: dict[str, str] = {}
    again = 0
    for line in cut.splitlines():
        written = re.fullmatch(r"  (s\[\d+\]) = (t\d+|value\(t\d+\));", line)
        if written:
            again += written[1] in places
            places[written[1]] = written[2].replace("value", "bits")
        elif line.startswith("  const "):
            ((name, value),) = _statements(line)
            restored = _PLACE.sub(lambda found: places[found[0]], value)
            assert (name, re.sub(r"bits\(bits\((t\d+)\)\)", r"\1", restored)) == next(expected)
    assert next(expected, None) is None
    assert again
    assert f"  real s[{len(places)}];" in cut.splitlines()


def test_truths_cross_parts_as_masks() -> None:
    def row(s: Any, g: Any, _: Any) -> Any:
        less, equal = s[0] < g[0], s[1] == g[1]
        both = ca.logic_and(less, equal)
        return ca.vertcat(ca.if_else(both, s[0], g[2]), less + s[1], equal, ca.logic_not(both), 1 / s[2])

    with _parts_of(1):
        trial, text = _trial(row), _engine_text(row)
    for form in ("= value(t", "pick(bits(s[", "truth(bits(s[", "~bits(s["):
        assert form in text
    for values in np.ndindex(2, 2, 2, 2):
        numbers = np.array([*values, 3.0])
        state, around = numbers[[0, 1, 4]], numbers[[2, 3, 4]]
        expected = np.array(row(ca.DM(state), ca.DM(around), None)).ravel()
        assert _run_one(trial, state, around[None], np.zeros(THETA))[0].tolist() == expected.tolist()
        lanes = np.tile(state, (LANES, 1))
        lanes[0, 0] = 5.0  # the others' truths are not this one's
        found = _run_lanes(trial, lanes, around[None], np.zeros((LANES, THETA)))
        np.testing.assert_allclose(found[1:], np.tile(expected, (LANES - 1, 1)), rtol=1e-15)


def test_parts_without_a_tilt_serve_near_and_far() -> None:
    """What is the same for small tilts and for others is compiled once."""

    def row(s: Any, g: Any, theta: Any) -> Any:
        return ca.vertcat(ca.sin(s[0]), ca.exp(g[0] * theta[0]), 1 / g[1] + ca.cos(s[0]))

    with _parts_of(1):
        parts, _ = _parts(row)
        text = translate.source(parts, None)
    defined = re.findall(r"void (decide\w*)\((real \*range)?", text)
    near = {name.removesuffix("_near"): taken for name, taken in defined if name.endswith("_near")}
    tilts = {
        name
        for name, body in re.findall(r"void (decide_\d+)\([^\n]*\n(.*?)\n}", text, re.DOTALL)
        if "tilt" in body
    }
    assert len(tilts) == 3
    assert set(near) == {"decide", *tilts}
    assert all(near.values())
    called = set(re.findall(r"  (decide_\d+_near)\(range, c, ", text))
    assert called == {f"{name}_near" for name in tilts}


def _long(state: Any, around: Any, theta: Any) -> Any:
    """Long enough to be cut: a walk that stays small, of truths and tilts, whose early steps later ones read."""
    x: list[Any] = [*ca.vertsplit(state), *ca.vertsplit(around)]
    for k in range(780):
        first, second, third = x[-1], x[-2 - k % 4], x[k // 2]
        tilt = ca.sin(state[0] + 1e-3 * around[0])
        x.append(ca.if_else(first < third, 0.5 * second - first, ca.tanh(third + theta[0] * tilt) / (k + 2)))
    return ca.vertcat(*x[::10], x[-1])


@pytest.mark.slow
def test_a_long_function_is_compiled_in_parts() -> None:
    """With the limits as they are, near tilts and far ones."""
    assert f"decide_{translate.MAX_WHOLE_STATEMENTS // translate.MAX_PART_STATEMENTS}(" in _engine_text(_long)
    trial = _trial(_long)
    rng = np.random.default_rng(5)
    for size in (1e-3, 1.0):
        states, thetas = size * rng.uniform(-1, 1, (LANES, STATES)), rng.uniform(-1, 1, (LANES, THETA))
        around = rng.uniform(-1, 1, (1, GIVEN))
        together = _run_lanes(trial, states, around, thetas)
        for lane in range(LANES):
            expected = np.array(trial.reference(states[lane], around, thetas[lane])).ravel()
            alone = _run_one(trial, states[lane], around, thetas[lane])[0]
            for found in (alone, together[lane]):
                np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14)


def test_an_operation_without_a_form_is_refused() -> None:
    state, _, theta = ca.SX.sym("state"), ca.SX.sym("given"), ca.SX.sym("theta")
    with pytest.raises(malta.CheckError, match="has no OP_ERFINV"):
        translate.translate(ca.Function("f", [state, theta], [ca.erfinv(state)]), [])


@needs_compiler
def test_constants_are_any_numbers(tmp_path: Path) -> None:
    """Infinity, which is how an expression says "no limit", the smallest numbers and the largest."""
    numbers = [np.inf, -np.inf, 5e-324, -1.7976931348623157e308, 0.1, -3.0, 1e22]
    parts, _ = _parts(lambda s, g, _: ca.vertcat(*(ca.fmin(s[0] + g[0], n) for n in numbers)))
    lib = compiled.library(translate.source(parts, None), 1, tmp_path)
    assert lib is not None, "it does not compile"
    run = engines.compiled_engine(lib.run, parts.decide.size1_out(2), np.zeros(THETA), 1, TABLE).run
    for value in (-1e9, 0.0, 1e9):
        _, rows = run(0, np.array([value, 0, 0, 0]), np.zeros((1, GIVEN)), NO_NOISE, NOT_FAST)
        assert rows[0, :-1].tolist() == [min(value, n) for n in numbers]


def test_what_depends_on_constants_alone_is_computed_once() -> None:
    """A division by a number of the machine is a reciprocal in `prepare` and a product in the loop."""
    state, theta = ca.SX.sym("state"), ca.SX.sym("theta", 2)
    f = ca.Function("f", [state, theta], [state / theta[0] + ca.exp(theta[1]) * ca.sin(theta[0])])
    prepare, moving, counts, _ = translate.translate(f, [], Counts(c=5))
    assert counts.c == 2
    assert "theta[0]" in prepare
    assert "exp(" in prepare
    assert "c[5]" in moving
    assert "c[6]" in moving
    assert not any(word in moving for word in (" / ", "inverse", "exp", "sin"))
    assert "theta" not in moving


@given(z=st.floats(-2, 2), start=st.floats(-2, 2))
def test_the_table_is_linear_between_its_points(waves: Trial, z: float, start: float) -> None:
    """v0 of a grid that is looked up from wherever the search stood before: numpy's interpolation."""
    run = engines.compiled_engine(
        waves.one.run, waves.parts.decide.size1_out(2), np.zeros(THETA), 1, TABLE
    ).run
    _, rows = run(0, np.zeros(STATES + 1), np.array([[start, 0, 0], [z, 0, 0.0]]), np.zeros((2, 1)), NOT_FAST)
    inside = [np.clip(at, -1, 1) for at in (start, z)]
    expected = np.interp(inside, [-1, 0, 1], [-1, 0, 3])
    slope = [3.0 if at > 0 else 1.0 for at in (start, z)]
    beyond = np.array([start, z]) - inside  # the machine asks within the grid only; the engine goes on
    assert rows[:, -1] == pytest.approx(expected + slope * beyond, abs=1e-12)


# Compiled and on CasADi's virtual machine


def _push(t: FloatArray) -> FloatArray:
    wrench = np.zeros((len(t), 6))
    wrench[:, 0], wrench[:, 4] = 2.0 * (t > 5e-3), 0.01 * np.sin(300 * t)
    return wrench


def _every_option(fidelity: Fidelity) -> dict[str, Any]:
    faults: tuple[Fault, ...] = (
        Fault("lost sample", 2e-3, 2.2e-3),
        Fault("missed step", 3e-3, 3.1e-3),
        Fault("biased sensor", 4e-3, 5e-3, "x2", 3e-6),
        Fault("stuck sensor", 8e-3, 8.5e-3, "y1"),
        Fault("link sag", 10e-3, 11e-3, size=0.3),
        Fault("noisy sensor", 12e-3, 13e-3, "x1", 5.0),
    )
    if fidelity == "phase":
        faults += (Fault("open phase", 6e-3, 7e-3, "i_12_1"),)
    return {
        "noise": 1.0,
        "quantize": True,
        "bearing": True,
        "scheduled": True,
        "disturbance": _push,
        "sensor_errors": {
            "gain_x1": 0.01,
            "offset_y2": 2e-6,
            "hall_amplitude": 0.02,
            "hall_phase": 0.01,
            "hall_single": 0.3,
        },
        "faults": faults,
        "changes": ((9e-3, {"m": 0.4, "K_ind": 2.0}),),
        "real_pwm": fidelity == "phase",
        "bearing_axes": "fixed" if fidelity == "force" else "turning",
    }


@pytest.mark.slow_for("force-every", "dq-every", "phase-plain", "phase-every")
@needs_compiler
@pytest.mark.parametrize("options", ["plain", "every"])
@pytest.mark.parametrize("fidelity", FIDELITIES)
def test_compiled_is_what_the_virtual_machine_computes(
    designs: dict[str, Design], fidelity: Fidelity, options: str
) -> None:
    """Every series to 1e-12 of the largest value of its unit, with every option on and none, on a stroke that the
    voltage limits: forces, axes, phases."""
    design = designs["calibrated"]
    chosen = _every_option(fidelity) if options == "every" else {}
    scenario = Scenario.stroke(5e-3, rise=3e-3, duration=0.02, fidelity=fidelity, **chosen)
    compiled, virtual = (
        malta.simulate(design.plant, design.controller, scenario, engine=kind)
        for kind in ("compiled", "virtual machine")
    )
    assert (compiled.engine, virtual.engine) == ("compiled", "virtual machine")
    assert compiled.verdict == virtual.verdict
    assert compiled.verdict.completed
    for name in SERIES:
        found, expected = getattr(compiled, name), getattr(virtual, name)
        assert found.shape == expected.shape
        if found.size:
            np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    moved = np.abs(virtual.p).max(axis=0)
    assert moved[4] > 2e-3
    if options == "every":
        assert moved[0] > 5e-6
    if fidelity == "phase":
        assert virtual.duty.max() > 0.9


@pytest.mark.slow
@needs_compiler
def test_a_delay_beyond_a_sample_is_the_same_in_both(designs: dict[str, Design]) -> None:
    """Commands under way queue up in the controller's state; an estimate from outside enters where it belongs."""
    design = designs["calibrated"]
    c = malta.lqg(design.model, design.spec.weights, 50e-6, "sampled-data", 2)
    for options in ({"delay": 3}, {"estimator": "kalman"}):
        scenario = Scenario.stroke(
            1e-3, rise=5e-3, duration=0.01, fidelity="force", noise=1.0, substeps=4, **options
        )
        runs = [malta.simulate(design.plant, c, scenario, engine=e) for e in ("compiled", "virtual machine")]
        assert np.abs(runs[0].x - runs[1].x).max() < 1e-15


# One library for all machines and gains of a shape


@needs_compiler
def test_one_library_serves_designs_and_machines(designs: dict[str, Design]) -> None:
    """Gains and parameters are arguments: the same library, and yet other trajectories; no hit is stale."""
    tables, calibrated = (designs[name] for name in ("table2", "calibrated"))
    heavy = malta.plant_of(replace(calibrated.spec.parameters, m=0.4))
    scenario = Scenario.stroke(1e-3, rise=5e-3, duration=0.01, fidelity="force")
    pairs = [
        (calibrated.plant, calibrated.controller),
        (calibrated.plant, tables.controller),
        (heavy, calibrated.controller),
    ]
    shapes = [shape_of(plant, c, setup_of(plant, c, scenario)) for plant, c in pairs]
    libraries = [library_of(shape) for shape in shapes]
    assert libraries[0] is not None
    assert all(library is libraries[0] for library in libraries)
    for plant, c in pairs:
        compiled, virtual = (
            malta.simulate(plant, c, scenario, engine=e) for e in ("compiled", "virtual machine")
        )
        assert np.abs(compiled.x - virtual.x).max() < 1e-15
    ends = [malta.simulate(plant, c, scenario).x[-1, 2] for plant, c in pairs]
    assert len(set(ends)) == 3


def _same(plant: Plant, _: Any) -> Plant:
    return plant


def _pulled(f: Callable[..., Any], gain: float, *given: Any) -> Any:
    """The machine's motion with a spring of its own."""
    return f(*given) + gain * ca.densify(given[0])


@needs_compiler
@pytest.mark.usefixtures("fresh")
def test_a_kept_library_is_found_without_its_text(
    designs: dict[str, Design], monkeypatch: pytest.MonkeyPatch
) -> None:
    """By its functions as they are first written: numbers that a module reads from elsewhere are in them."""
    design, scenario = designs["calibrated"], _hold()
    first = malta.simulate(design.plant, design.controller, scenario)
    monkeypatch.setattr(engines, "engine_text", pytest.fail)
    for memory in (library_of, engine_of, engines.engine_key):
        memory.cache_clear()
    again = malta.simulate(design.plant, design.controller, scenario)
    assert np.array_equal(first.x, again.x)
    keys = set()
    for gain in (0.0, 1e-3, 2e-3):
        library_of.cache_clear()
        engines.engine_key.cache_clear()
        pulled = replace(design.plant, f=partial(_pulled, design.plant.f, gain))
        plant = replace(pulled, variant=partial(_same, pulled))
        setup = setup_of(design.plant, design.controller, scenario)
        keys.add(engines.engine_key(shape_of(plant, design.controller, setup)))
    assert len(keys) == 3


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """A cache folder of its own, nothing remembered; and again nothing afterwards."""

    memories = (compiled.compiler, compiled._processor, library_of, engine_of, process_folder)

    def forget() -> None:
        for memory in memories:
            memory.cache_clear()

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    forget()
    yield tmp_path / "cache" / "malta"
    forget()


def _hold(duration: float = 1e-3) -> Scenario:
    return Scenario("hold", duration, lambda plant: references.hold(plant, x1=1e-6), fidelity="force")


@pytest.mark.slow
@needs_compiler
def test_the_folder_holds_one_file_for_two_designs(designs: dict[str, Design], fresh: Path) -> None:
    for design in designs.values():
        assert malta.simulate(design.plant, design.controller, _hold()).engine == "compiled"
    assert compiled.cache_folder() == fresh
    assert [path.suffix for path in fresh.iterdir()] == [".so"]


@pytest.fixture(scope="module")
def small() -> tuple[Period, str]:
    """An engine that compiles at once: 3 s[0] + g[0], and sin(g[0])."""
    parts, _ = _parts(lambda s, g, _: ca.vertcat(3 * s[0] + g[0], ca.sin(g[0])))
    return parts, translate.source(parts, None)


def _works(lib: Any, parts: Period) -> bool:
    run = engines.compiled_engine(lib.run, parts.decide.size1_out(2), np.zeros(THETA), 1, TABLE).run
    _, rows = run(0, np.array([2.0, 0, 0, 0]), np.array([[0.5, 0, 0]]), NO_NOISE, NOT_FAST)
    return bool(rows[0] == pytest.approx([6.5, np.sin(0.5), 1.5]))


@pytest.mark.slow
@pytest.mark.usefixtures("fresh")
def test_the_cache_knows_what_a_library_depends_on(
    small: tuple[Period, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Text, lanes, options, processor and compiler: a file for each; the same again: none."""
    parts, text = small

    def files() -> int:
        return len(list(tmp_path.glob("*.so")))

    assert _works(_library(text, 1, tmp_path), parts)
    assert _works(_library(text, 1, tmp_path), parts)
    assert files() == 1
    _library(text + "/* otherwise */", 1, tmp_path)
    assert files() == 2
    parts8, digest = _parts(lambda s, *_: s)
    _library(translate.source(parts8, digest), LANES, tmp_path)
    assert files() == 3
    for name, value in (
        ("FLAGS", (*compiled.FLAGS, "-DNOTHING")),
        ("_processor", lambda: "another"),
        ("_version", lambda _: "another"),
    ):
        before = files()
        with monkeypatch.context() as patch:
            patch.setattr(compiled, name, value)
            assert _works(_library(text, 1, tmp_path), parts)
        assert files() == before + 1
    assert [path.name for path in tmp_path.iterdir() if path.is_file() and path.suffix != ".so"] == []


@pytest.mark.parametrize("damage", ["empty", "no library", "its first bytes"])
def test_a_damaged_library_is_replaced(
    small: tuple[Period, str], fresh: Path, tmp_path: Path, damage: str
) -> None:
    parts, text = small
    folder = tmp_path / "libraries"
    _library(text, 1, tmp_path / "sound")
    (sound,) = (tmp_path / "sound").iterdir()
    whole = sound.read_bytes()
    folder.mkdir(0o700)
    damaged = folder / sound.name
    damaged.write_bytes(
        {"empty": b"", "no library": b"#!/bin/sh\n" * 900, "its first bytes": whole[:64]}[damage]
    )
    assert _works(_library(text, 1, folder), parts)
    assert damaged.exists(), "compiled again, but somewhere else"
    assert len(damaged.read_bytes()) == len(whole)
    assert fresh != folder


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_library_that_was_cut_short_is_not_run(
    small: tuple[Period, str], tmp_path: Path, share: float
) -> None:
    """What a power failure leaves of a file: loading it would end the process with a bus error."""
    _, text = small
    _library(text, 1, tmp_path / "sound")
    (sound,) = (tmp_path / "sound").iterdir()
    folder = tmp_path / "libraries"
    folder.mkdir(0o700)
    whole = sound.read_bytes()
    (folder / sound.name).write_bytes(whole[: int(share * len(whole))])
    (tmp_path / "text.c").write_text(text, encoding="utf-8")
    loading = (
        "from pathlib import Path; from malta.simulation.engine.compiled import library; import sys\n"
        "assert library(Path(sys.argv[1]).read_text(encoding='utf-8'), 1, Path(sys.argv[2])) is not None"
    )
    ended = subprocess.run(
        [sys.executable, "-c", loading, str(tmp_path / "text.c"), str(folder)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"TMPDIR": str(tmp_path)},
    )
    assert ended.returncode == 0, ended.stderr


def test_a_folder_that_cannot_be_written_is_passed_over(
    small: tuple[Period, str], fresh: Path, tmp_path: Path
) -> None:
    """A file where the folder should be: the temporary folder serves."""
    parts, text = small
    (tmp_path / "cache").write_text("not a folder", encoding="utf-8")
    assert _works(_library(text, 1), parts)
    assert not fresh.exists()
    assert len(list((tmp_path / "tmp").glob("malta-*/*.so"))) == 1


def test_with_no_folder_at_all_the_virtual_machine_runs(
    designs: dict[str, Design], fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cache").write_text("not a folder", encoding="utf-8")
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "cache"))
    design = designs["calibrated"]
    run = malta.simulate(design.plant, design.controller, _hold())
    assert (run.engine, run.verdict.completed) == ("virtual machine", True)
    assert not fresh.exists()


@pytest.mark.slow
@needs_compiler
@pytest.mark.usefixtures("fresh")
def test_without_a_compiler_the_virtual_machine_runs(
    designs: dict[str, Design], monkeypatch: pytest.MonkeyPatch
) -> None:
    design = designs["calibrated"]
    with_one = malta.simulate(design.plant, design.controller, _hold(5e-3))
    for cached in (library_of, engine_of):
        cached.cache_clear()
    monkeypatch.setattr(compiled, "compiler", lambda: None)
    run = malta.simulate(design.plant, design.controller, _hold(5e-3))
    assert (with_one.engine, run.engine) == ("compiled", "virtual machine")
    np.testing.assert_allclose(run.x, with_one.x, rtol=0, atol=1e-12 * np.abs(run.x).max())
    with pytest.raises(
        malta.InputError,
        match=r"simulate: engine: found no C compiler that works, expected cc, gcc or clang, or \$CC",
    ):
        malta.simulate(design.plant, design.controller, _hold(), engine="compiled")


def test_a_compiler_that_fails_is_no_compiler(
    designs: dict[str, Design], fresh: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CC", "/bin/false")
    design = designs["calibrated"]
    assert compiled.compiler() == ("/bin/false",)
    run = malta.simulate(design.plant, design.controller, _hold())
    assert (run.engine, run.verdict.completed) == ("virtual machine", True)
    assert not list(fresh.iterdir())
    with pytest.raises(malta.InputError, match="no C compiler that works"):
        malta.simulate(design.plant, design.controller, _hold(), engine="compiled")


@pytest.mark.usefixtures("fresh")
def test_a_compiler_that_does_not_exist_is_no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", "/nowhere/cc")
    assert compiled.compiler() is None
    assert compiled.library("", 1) is None


@needs_compiler
def test_a_compiler_may_refuse_the_flags_of_gcc(
    fresh: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As clang does: the rest of the flags is kept."""
    own, cc = compiled.compiler(), tmp_path / "cc"
    assert own is not None
    cc.write_text(
        f'#!/bin/sh\ncase "$*" in *-fsched*) exit 1;; esac\necho "$@" > {tmp_path}/said\nexec {own[0]} "$@"\n'
    )
    cc.chmod(0o700)
    compiled.compiler.cache_clear()
    monkeypatch.setenv("CC", str(cc))
    found = compiled.library("int two(void) { return 2; }\n", 1)
    assert found is not None
    assert found.two() == 2
    assert {"-ffp-contract=off", "-march=native"} < set((tmp_path / "said").read_text().split())
    assert len(list(fresh.rglob("*.so"))) == 1


@pytest.mark.parametrize("hangs_at", ["--version", "-shared"])
def test_a_compiler_that_hangs_is_stopped_with_all_that_it_started(
    hangs_at: str,
    fresh: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    started = tmp_path / "started"
    cc = tmp_path / "cc"
    cc.write_text(f'#!/bin/sh\ncase "$*" in *{hangs_at}*) sleep 3600 & echo $! > {started}; wait;; esac\n')
    cc.chmod(0o700)
    monkeypatch.setenv("CC", str(cc))
    monkeypatch.setattr(compiled, "PATIENCE", 0.3)
    assert compiled.library("", 1) is None
    assert [r.getMessage() for r in caplog.records] == [
        f"malta: found {cc} without an answer for 0.3 s, expected a C compiler"
    ]
    assert not list(fresh.rglob("*.so"))
    child = Path(f"/proc/{started.read_text().strip()}/stat")
    for _ in range(3000):  # a minute
        if not child.exists() or child.read_text().split()[2] == "Z":
            break
        time.sleep(0.02)
    else:
        pytest.fail("what the compiler started goes on")


@pytest.mark.usefixtures("fresh")
def test_a_command_with_an_open_quotation_mark_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("CC", '"gcc')
    with pytest.raises(
        malta.InputError, match=r"^\$CC: found '\"gcc', expected a command, as a shell takes it$"
    ):
        compiled.library("", 1)


def test_a_user_without_a_home_has_engines_in_the_temporary_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless(_: int) -> None:
        raise KeyError("getpwuid(): uid not found")

    monkeypatch.setattr("pwd.getpwuid", homeless)
    for name in ("HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    assert compiled.cache_folder() == Path(tempfile.gettempdir()) / f"malta-{os.getuid()}"


@pytest.mark.slow
def test_two_processes_may_compile_at_once(small: tuple[Period, str], fresh: Path, tmp_path: Path) -> None:
    """A compiler that takes its time, so that both are at it: both succeed, one file is left and nothing else."""
    cc = compiled.compiler()
    if cc is None:
        pytest.skip("no C compiler")
    slow = tmp_path / "slow-cc"
    slow.write_text(
        f'#!/bin/sh\ncase "$*" in *-shared*) echo >> {tmp_path}/calls; sleep 0.4;; esac\nexec {cc[0]} "$@"\n'
    )
    slow.chmod(0o755)
    (tmp_path / "text.c").write_text(small[1], encoding="utf-8")
    compiling = (
        "from pathlib import Path; from malta.simulation.engine.compiled import library; import sys\n"
        "assert library(Path(sys.argv[1]).read_text(encoding='utf-8'), 1) is not None"
    )
    environment = os.environ | {"CC": str(slow)}
    both = [
        subprocess.Popen([sys.executable, "-c", compiling, str(tmp_path / "text.c")], env=environment)
        for _ in range(2)
    ]
    assert [process.wait(timeout=600) for process in both] == [0, 0]
    assert (tmp_path / "calls").read_text().splitlines() in ([""], ["", ""])
    assert [path.suffix for path in fresh.iterdir()] == [".so"]


@pytest.mark.parametrize("runs", [1, 7, 8, 21])
def test_machines_are_dealt_out_to_lanes(runs: int) -> None:
    """Machine k stands in lane k mod 8 of group k / 8; copies of the last one fill the last group."""
    groups = -(-runs // LANES)
    rows = np.random.default_rng(0).normal(size=(runs, 3))
    rows[:, 1] = 0.5
    arranged = lanes_of.arrange_in_lanes(rows, groups)
    assert arranged.shape == (groups, 3, LANES)
    for k in range(groups * LANES):
        assert arranged[k // LANES, :, k % LANES].tolist() == rows[min(k, runs - 1)].tolist()
    own = {0: rows[:, 0], 2: rows[:, 2]}
    assert np.array_equal(lanes_of.repeat_in_lanes(np.array([9.0, 0.5, 9.0]), own, groups), arranged)
