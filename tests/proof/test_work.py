"""Searches are given work: they end with it whatever they are doing, on any computer and under any load alike."""

from __future__ import annotations

import math
import pickle
import time
from collections.abc import Callable
from itertools import count
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest
from conftest import ROOT
from test_metamorphic_random import random_case

import malta
from malta.errors import InputError
from malta.linear.expressions import program
from malta.linear.rational import symbolic
from malta.margins.travel import travel_margin
from malta.proof import Budget, Interrupted
from malta.work import MORE_WORK, WorkUp, count_work, is_past, remember, spend, work_done, work_limit

LIMIT = 0.3  # units of work
SAMPLED = control.c2d(control.tf([-0.3, -0.3], [0.2, 1]), 0.1, "tustin")

Search = Callable[..., Any]


def named(function: Callable[[list[Any]], Any], count: int) -> Any:
    """The function of one list as a casadi.Function, whose parameters have names."""
    p = ca.SX.sym("p", count)
    found = function([p[i] for i in range(count)])
    parts = found if isinstance(found, tuple) else (ca.vertcat(*found),)
    return ca.Function("f", [p], [ca.SX(part) for part in parts])


def chain(n: int) -> tuple[Any, dict[str, float]]:
    """n masses on springs, of 2 n parameters: the force acts on the last one, whose position is measured."""

    def matrices(p: list[Any]) -> Any:
        k, m = p[:n], p[n:]
        A = ca.SX.zeros(2 * n, 2 * n)
        for i in range(n):
            A[i, n + i], A[n + i, n + i] = 1, -0.2 / m[i]
            A[n + i, i] -= k[i] / m[i]
            if i:
                A[n + i, i - 1] += k[i] / m[i]
                A[n + i - 1, i] += k[i] / m[i - 1]
                A[n + i - 1, i - 1] -= k[i] / m[i - 1]
        into, out = np.zeros((2 * n, 1)), np.zeros((1, 2 * n))
        into[2 * n - 1], out[0, n - 1] = 1, 1
        return A, ca.SX(into) / m[n - 1], out

    names = [f"k{i}" for i in range(n)] + [f"m{i}" for i in range(n)]
    system = malta.uncertain(named(matrices, 2 * n), {name: 1.0 + 0.1 * k for k, name in enumerate(names)})
    return system, dict.fromkeys(names, 0.05)


def coefficients(p: list[Any]) -> list[Any]:
    """The product of ten factors, each of a few parameters."""
    a: list[Any] = [1.0]
    for i in range(10):
        w = 1 + 0.3 * i + 0.3 * p[i % len(p)] + 0.1 * p[(i + 3) % len(p)] * p[(i + 5) % len(p)]
        b = [1, 2 * (0.5 + 0.1 * p[(i + 1) % len(p)]) * w, w * w] if i % 2 else [1, w]
        a = [
            sum((a[k - j] if 0 <= k - j < len(a) else 0) * x for j, x in enumerate(b))
            for k in range(len(a) + len(b) - 1)
        ]
    return a


def functions(p: list[Any]) -> Any:
    """Sines and roots of all parameters in every entry."""
    n = len(p)
    A = ca.SX(n, n)
    for i in range(n):
        for j in range(n):
            A[i, j] = 0.1 * ca.sin(p[(i + j) % n] + i) * ca.sqrt(2 + p[i] * p[j])
        A[i, i] -= 2 + ca.exp(0.1 * p[i])
    return A, np.ones((n, 1)), np.ones((1, n))


def dense(p: list[Any]) -> Any:
    """Twenty states; every entry depends on every parameter by a quotient."""
    rng = np.random.default_rng(7)
    A = ca.SX(0.3 * rng.normal(size=(20, 20)) - 2 * np.eye(20))
    for i, q in enumerate(p):
        A = A + 0.05 * q / (3 + p[(i + 1) % len(p)]) * rng.normal(size=(20, 20))
    return A, np.ones((20, 1)), np.ones((1, 20))


def plain(matrices: Any, count: int) -> tuple[Any, dict[str, tuple[float, float]]]:
    """A system of parameters that are nominally zero."""
    names = [f"q{i}" for i in range(count)]
    return malta.uncertain(named(matrices, count), dict.fromkeys(names, 0.0)), dict.fromkeys(
        names, (-0.5, 0.5)
    )


def of_polynomial(count: int) -> Any:
    box = dict.fromkeys([f"q{i}" for i in range(count)], (-0.1, 0.1))
    return malta.proof.margin_of_polynomial(named(coefficients, count), box)


def of_loop(search: Search, made: tuple[Any, Any], law: Any, *more: Any) -> Any:
    system, box = made
    return search(system, law, box, *more)


KINDS: dict[str, Callable[[], Any]] = {
    "continuous loop of 14 parameters": lambda: of_loop(malta.robust_margin, chain(7), [[-0.3]]),
    "sampled loop of 14 parameters": lambda: of_loop(malta.robust_margin, chain(7), SAMPLED),
    "polynomial of 4 parameters": lambda: of_polynomial(4),
    "polynomial of 14 parameters": lambda: of_polynomial(14),
    "functions of parameters": lambda: of_loop(malta.robust_margin, plain(functions, 6), [[-0.1]]),
    "quotients in every entry": lambda: of_loop(malta.robust_margin, plain(dense, 8), [[-0.1]]),
    "dynamics": lambda: of_loop(malta.dynamic_margin, chain(4), SAMPLED, malta.proof.Dynamic(0.1)),
    "gain": lambda: of_loop(malta.worst_case_gain, chain(4), SAMPLED),
}


@pytest.mark.slow_for(
    "continuous loop of 14 parameters",
    "polynomial of 4 parameters",
    "polynomial of 14 parameters",
    "functions of parameters",
    "quotients in every entry",
)
@pytest.mark.parametrize("kind", KINDS)
def test_a_search_ends_with_its_work(kind: str) -> None:
    """A last look for a witness may take 0.4 units and a tenth more; one step is not cut in two."""
    with count_work(LIMIT) as meter:
        found = KINDS[kind]()
    assert meter.work < 1.2 * LIMIT + 0.8
    assert found.reason
    bound = found.lower if hasattr(found, "exhausted") else found.upper
    assert bound is None or 0 < bound < math.inf


@pytest.fixture
def hasty(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A clock that goes faster than it should."""

    def run(times: float) -> None:
        now = time.monotonic
        monkeypatch.setattr(time, "monotonic", lambda: times * now())

    return run


def bits(found: Any) -> tuple[Any, ...]:
    """All that a margin says, but for the seconds it took."""
    witness = None if found.witness is None else tuple(found.witness.items())
    return found.lower, found.upper, found.frequency, witness, found.reason, found.work, found.cells


def asked(which: str) -> malta.proof.Margin:
    """A fresh loop each time: by cells of frequency, by multipliers, of functions, and one that is left open."""
    if which == "cubic":
        return malta.proof.margin_of_polynomial(lambda k: [1, 3, 3, 1 + k], {"k": 0.5}, {"k": 1})
    if which == "polynomial":
        return malta.proof.margin_of_polynomial(
            named(coefficients, 3), dict.fromkeys(["q0", "q1", "q2"], (-0.1, 0.1))
        )
    system, box = plain(functions, 2) if which == "functions" else chain(1 if which == "sampled" else 2)
    law: Any = SAMPLED if which == "sampled" else [[-0.1]]
    return malta.robust_margin(system, law, box, budget=Budget(0.5, patient=False))


@pytest.mark.slow_for("polynomial", "chain", "sampled")
@pytest.mark.parametrize("which", ["cubic", "polynomial", "chain", "functions", "sampled"])
def test_a_clock_fifty_times_as_fast_changes_nothing(which: str, hasty: Callable[[float], None]) -> None:
    one = asked(which)
    hasty(50.0)
    assert bits(asked(which)) == bits(one)


@pytest.mark.slow
def test_work_does_not_depend_on_earlier_questions() -> None:
    """A wider box and another law were asked before: what is remembered of them counts as if it were done again."""
    system, box = chain(2)
    fresh = malta.robust_margin(system, [[-0.3]], box, budget=Budget(0.5))
    system, box = chain(2)
    malta.robust_margin(system, [[-0.3]], box)
    malta.robust_margin(system, [[-0.2]], box)
    assert bits(malta.robust_margin(system, [[-0.3]], box, budget=Budget(0.5))) == bits(fresh)


@pytest.mark.slow
def test_a_clock_that_ends_a_search_is_named(hasty: Callable[[float], None]) -> None:
    system, box = chain(4)
    malta.robust_margin(system, SAMPLED, box, budget=Budget(1e-3))
    hasty(1e4)
    found = malta.robust_margin(system, SAMPLED, box, time=10.0)
    assert "the clock ended the search after" in found.reason
    assert found.reason.endswith(f"{2 * found.work:.3g} {MORE_WORK}")
    assert found.lower is None or found.lower <= found.upper


@pytest.mark.slow
def test_time_that_is_given_is_used() -> None:
    """A tenth of a unit leaves this loop open; rounds that follow decide it, long before the minute is over."""
    system, box = chain(2)
    brief = malta.robust_margin(system, [[-0.3]], box, budget=Budget(0.1, patient=False))
    assert brief.reason.endswith(MORE_WORK)
    found = malta.robust_margin(system, [[-0.3]], box, budget=Budget(time=60.0))
    assert not found.reason
    assert found.work > brief.work
    assert found.lower == pytest.approx(found.upper, rel=1e-3)


@pytest.mark.slow
def test_rounds_follow_as_long_as_the_clock_allows() -> None:
    """Seven of these loops were given up by shares of the time, while most of it was left."""
    for seed in (13, 19, 55, 88, 94, 100):
        case = random_case(seed)
        found = malta.robust_margin(*case.loop(), {"k": 0.3}, {"p": case.over}, time=600.0)
        assert not found.reason, seed
        assert found.lower == pytest.approx(found.upper, rel=1e-3)


@pytest.mark.slow
def test_an_interrupted_search_says_what_it_knows() -> None:
    system, box = chain(2)
    whole = malta.robust_margin(system, [[-0.3]], box)
    calls = count()

    def press(lower: float, _: float) -> None:
        if lower > 0 and next(calls) > 3:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        malta.robust_margin(system, [[-0.3]], box, progress=press)
    known = stopped.value.margin
    assert known.lower is not None
    assert whole.lower is not None
    assert 0 < known.lower <= whole.lower <= known.upper * (1 + 1e-9)
    assert known.reason.startswith("interrupted after ")
    assert str(stopped.value).startswith("interrupted: proven ")
    assert pickle.loads(pickle.dumps(stopped.value)).margin.lower == known.lower


@pytest.mark.slow
@pytest.mark.parametrize("design", ["planar", "planar_pid", "robust", "halbach"])
def test_a_search_over_the_travel_ends_with_its_work_and_with_the_clock(
    design: str, hasty: Callable[[float], None]
) -> None:
    """The machine's model is written out within the time as well."""
    spec = malta.read_design(ROOT / f"design/{design}.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at(**spec.operating_point)))
    with count_work(LIMIT) as meter:
        travel_margin(spec.plant, controller, spec.uncertainty)
    assert meter.work < 1.2 * LIMIT + 0.8
    hasty(1e3)
    found = travel_margin(spec.plant.variant(spec.plant.parameters), controller, spec.uncertainty, time=LIMIT)
    if found.lower is None:
        assert found.time_up
        assert "the clock ended the search" in str(found)


def test_the_nearest_limit_counts() -> None:
    assert not is_past(price=1e9)
    spend(1e9)
    with work_limit(50.0):
        assert not is_past()
        with work_limit(500.0), pytest.raises(WorkUp):
            spend(51.0)
        assert work_done() == 0.0  # what was too dear counts nothing
        spend(49.0)
        assert is_past(49.0)
        assert not is_past()
        assert is_past(price=2.0)
    with count_work(10.0) as outer:
        with count_work(20.0) as inner:
            assert inner.end == outer.end
            spend(3.0)
        assert outer.work == 3.0


def test_what_is_remembered_counts_each_time() -> None:
    known: dict[str, Any] = {}

    def made() -> str:
        spend(0.1)
        spend(0.2)
        return "made"

    for _ in range(3):
        with work_limit(1.0):
            assert remember(known, "it", made) == "made"
            assert work_done() == pytest.approx(0.3)
    with work_limit(0.25):
        with pytest.raises(WorkUp):
            remember(known, "it", made)
        assert work_done() == pytest.approx(0.1)  # as the first time


@pytest.mark.parametrize(
    "limits", [{"work": 0}, {"work": math.nan}, {"time": -1.0}, {"cells": 0}, {"work": "1"}]
)
def test_a_budget_of_nothing_is_refused(limits: Any) -> None:
    with pytest.raises(InputError, match="budget"):
        Budget(**limits)


@pytest.mark.slow
def test_an_expansion_that_was_ended_is_begun_again() -> None:
    """Nothing that the end of one search left undone is remembered by the next one."""
    system, box = chain(2)
    with count_work(1.0, -1.0), pytest.raises(WorkUp):
        symbolic(program(system.matrices))
    found = malta.robust_margin(system, [[-0.3]], box, time=1e-6)
    assert found.lower is None
    assert found.time_up
    again = malta.robust_margin(system, [[-0.3]], box)
    assert again.lower is not None
    assert not again.reason
    assert bits(again) == bits(malta.robust_margin(chain(2)[0], [[-0.3]], box))
