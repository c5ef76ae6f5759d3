"""Searches end when their time is up, whatever they are doing: expansions, families, descents, multipliers, poles."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import casadi as ca
import control
import numpy as np
import pytest
from conftest import ROOT

import malta
from malta.margins.travel import travel_margin
from malta.proof.expressions import program
from malta.proof.polynomial.rational import symbolic


LIMIT = 0.3  # s
ALLOWED = 1.2 * LIMIT + 1  # s of processor time, which other processes do not lengthen
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
    return malta.proof.margin_of_polynomial(named(coefficients, count), box, time=LIMIT)


def of_loop(search: Search, made: tuple[Any, Any], law: Any, *more: Any) -> Any:
    system, box = made
    return search(system, law, box, *more, time=LIMIT)


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


@pytest.mark.parametrize("kind", KINDS)
def test_a_search_ends_when_its_time_is_up(kind: str) -> None:
    begun = time.process_time()
    found = KINDS[kind]()
    assert time.process_time() - begun < ALLOWED
    assert found.reason
    bound = found.lower if hasattr(found, "exhausted") else found.upper
    assert bound is None or 0 < bound < math.inf


@pytest.mark.slow
@pytest.mark.parametrize("design", ["planar", "planar_pid", "robust", "halbach"])
def test_a_search_over_the_travel_ends_when_its_time_is_up(design: str) -> None:
    """The machine's model is written out within the time as well."""
    spec = malta.read_design(ROOT / f"design/{design}.toml")
    controller = malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at(**spec.operating_point)))
    begun = time.process_time()
    found = travel_margin(spec.plant, controller, spec.uncertainty, time=LIMIT)
    assert time.process_time() - begun < ALLOWED
    if found.lower is None:
        assert found.time_up
        assert "time was up" in str(found) or "time would be up" in str(found)


def test_the_nearest_limit_counts() -> None:
    assert not is_late(1e9)
    with time_limit(time.monotonic() + 50):
        assert not is_late()
        assert is_late(51)
        with time_limit(time.monotonic() + 500):
            assert is_late(51)
        with time_limit(time.monotonic() - 1), pytest.raises(TimeUp):
            check_time()
        check_time(49)
        with pytest.raises(TimeUp):
            check_time(51)
    check_time(1e9)


def test_an_expansion_that_was_ended_is_begun_again() -> None:
    """Nothing that the end of one search left undone is remembered by the next one."""
    system, box = chain(2)
    with time_limit(0.0), pytest.raises(TimeUp):
        symbolic(program(system.matrices))
    found = malta.robust_margin(system, [[-0.3]], box, time=1e-6)
    assert found.lower is None
    assert found.time_up
    again = malta.robust_margin(system, [[-0.3]], box)
    assert again.lower is not None
    assert not again.reason
