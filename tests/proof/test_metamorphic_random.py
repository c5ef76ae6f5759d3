"""Margins of random loops do not move with what a loop does not feel: units, coordinates, copies, parts of a box."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st

import malta
from malta.proof.robust import problem_of

Matrix = np.ndarray[Any, Any]
CLOCKS = (None, 0.3, "discrete")  # continuous; held and sampled; a system in discrete time


@dataclass(frozen=True)
class Case:
    """E x' = A(k, p) x + B u, y = C x, u = F y; k grows with the margin, p may be anywhere in its interval."""

    A: tuple[Matrix, Matrix, Matrix]  # A_0 + (k - 1) A_1 + (p - 1) A_2
    B: Matrix
    C: Matrix
    E: Matrix
    heavy: bool  # whether p stands in the last row of E
    law: tuple[Matrix, Matrix, Matrix, Matrix]
    clock: Any
    over: tuple[float, float] = (0.8, 1.3)
    seconds: float = 1.0  # the unit of time
    inverse: bool = False  # whether the parameter is 1 / p
    left: Matrix = field(default_factory=lambda: np.eye(1))  # rows are multiplied by it
    right: Matrix = field(default_factory=lambda: np.eye(1))  # x = right times the states
    copies: int = 1

    def loop(self) -> tuple[malta.proof.UncertainSystem, malta.proof.Compensator]:
        n, discrete = len(self.B), self.clock == "discrete"
        T = None if self.clock is None else (1.0 if discrete else self.clock) / self.seconds
        left, right = (M if len(M) == n else M[0, 0] * np.eye(n) for M in (self.left, self.right))
        rate = 1.0 if discrete else self.seconds

        def matrices(k: Any, p: Any) -> Any:
            import casadi as ca

            if self.inverse:
                p = 1 / p
            mass = ca.SX.eye(n)
            mass[n - 1, n - 1] = p if self.heavy else 1
            A = ca.SX(self.A[0]) + (k - 1) * ca.SX(self.A[1]) + (p - 1) * ca.SX(self.A[2])
            E, A, B = (ca.mtimes(ca.DM(left), M) for M in (mass @ self.E, A * rate, ca.SX(self.B * rate)))
            E, A, C = (ca.mtimes(M, ca.DM(right)) for M in (E, A, ca.SX(self.C)))
            A, B, C, E = (ca.diagcat(*[M] * self.copies) for M in (A, B, C, E))
            return A, B, C, ca.DM(C.shape[0], B.shape[1]), E

        system = malta.uncertain(matrices, {"k": 1.0, "p": 1.0}, **({"sample_time": T} if discrete else {}))
        a, b, c, d = (np.kron(np.eye(self.copies), M) for M in self.law)
        rate = self.seconds if T is None else 1.0
        return system, malta.proof.Compensator(a * rate, b * rate, c, d, sample_time=T)

    def margin(self, seconds: float = 3.0) -> malta.proof.Margin:
        low, high = self.over
        over = (1 / high, 1 / low) if self.inverse else self.over
        return malta.robust_margin(*self.loop(), {"k": 0.3}, {"p": over}, budget=malta.proof.Budget(seconds))


def random_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    n, m, own = (int(x) for x in rng.integers([2, 1, 0], [4, 3, 2]))
    clock = CLOCKS[seed % 3]
    A = rng.normal(size=(n, n))
    size = np.linalg.eigvals(A)
    A = A - (size.real.max() + 0.3) * np.eye(n) if clock != "discrete" else A / (1.4 * np.abs(size).max())
    slopes = [np.outer(*rng.normal(size=(2, n))) * 0.3 for _ in range(2)]
    E = np.eye(n) + np.triu(rng.normal(size=(n, n)), 1) * (0.3 if seed % 2 else 0)
    law = (
        rng.normal(size=(own, own)) * 0.3 - (np.eye(own) if clock is None else 0), rng.normal(size=(own, m)),
        rng.normal(size=(m, own)) * 0.2, rng.normal(size=(m, m)) * 0.15,
    )  # fmt: skip
    B, C = rng.normal(size=(n, m)), rng.normal(size=(m, n))
    return Case((E @ A, *slopes), E @ B, C, E, bool(rng.integers(2)), law, clock)


def units(rng: Any, n: int) -> Matrix:
    return np.diag(10.0 ** rng.integers(-9, 10, n))


def channels(case: Case, rng: Any) -> Case:
    """Other units of inputs and outputs."""
    m = case.B.shape[1]
    force, length = units(rng, m), units(rng, m)
    A, B, C, D = case.law
    own = (
        A,
        B @ np.linalg.inv(length),
        np.linalg.inv(force) @ C,
        np.linalg.inv(force) @ D @ np.linalg.inv(length),
    )
    return replace(case, B=case.B @ force, C=length @ case.C, law=own)


CHANGES: dict[str, Callable[[Case, Any], Case]] = {
    "rows of A, B and E": lambda c, rng: replace(c, left=units(rng, len(c.B))),
    "all rows alike": lambda c, rng: replace(c, left=units(rng, 1)),
    "units of states": lambda c, rng: replace(c, right=units(rng, len(c.B))),
    "both": lambda c, rng: replace(c, left=units(rng, len(c.B)), right=units(rng, len(c.B))),
    "permutation": lambda c, rng: replace(c, right=np.eye(len(c.B))[rng.permutation(len(c.B))]),
    "rotation": lambda c, rng: replace(c, right=np.linalg.qr(rng.normal(size=(len(c.B),) * 2))[0]),
    "mixed rows": lambda c, _: replace(
        c, left=np.eye(len(c.B)) + np.triu(np.full((len(c.B),) * 2, 100.0), 1)
    ),
    "units of channels": channels,
    "time": lambda c, rng: replace(c, seconds=10.0 ** int(rng.integers(-9, 10))),
    "copies": lambda c, _: replace(c, copies=2),
    "1 / p": lambda c, _: replace(c, inverse=True),
}


def agree(one: malta.proof.Margin, other: malta.proof.Margin) -> None:
    """No proof exceeds a witness of the same loop; where both are settled they are the same."""
    a, b, upper = one.lower or 0.0, other.lower or 0.0, min(one.upper, other.upper)
    assert max(a, b) <= upper * (1 + 1e-9)
    if not one.reason and not other.reason:
        assert a == pytest.approx(b, rel=2e-3)  # the tolerance of a proof that is not cheap, on either side
        if min(a, b) > (1 - 1e-6) * upper:
            assert a == pytest.approx(b, rel=1e-6)


def stable_below(case: Case, margin: malta.proof.Margin, rng: Any) -> bool:
    """Whether loops at corners and within the box, a little below the proven margin, are stable by their poles."""
    if not margin.lower:
        return True
    t = min(margin.lower, 100.0) * (1 - 1e-9)
    k = 1 + 0.3 * t * np.concatenate([[-1, -1, 1, 1], rng.uniform(-1, 1, 60)])
    p = np.concatenate([[*case.over, *case.over], rng.uniform(*case.over, 60)])
    return bool((problem_of(*case.loop()).instability(np.column_stack([k, p])) < 1e-9).all())


def check(seed: int, names: Any, seconds: float) -> None:
    case, rng = random_case(seed), np.random.default_rng(seed)
    base = case.margin(seconds)
    if base.upper == 0:
        return  # unstable at the nominal values
    assert stable_below(case, base, rng)
    for name in names:
        agree(base, CHANGES[name](case, rng).margin(seconds))
    low, high = case.over
    halves = [replace(case, over=over).margin(seconds) for over in ((low, 1.0), (1.0, high))]
    least = min(halves, key=lambda m: m.lower or 0.0)
    assert (base.lower or 0.0) <= min(m.upper for m in halves) * (1 + 1e-9)
    if not base.reason and not any(m.reason for m in halves) and math.isfinite(base.upper):
        assert base.lower == pytest.approx(least.lower, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGES)
@pytest.mark.parametrize("seed", [8, 12])
def test_margins_of_random_loops(seed: int, name: str) -> None:
    check(seed, [name], 1.0)


@pytest.mark.slow
@settings(max_examples=6, deadline=None, suppress_health_check=list(HealthCheck))
@given(st.integers(0, 100_000))
def test_margins_of_more_random_loops(seed: int) -> None:
    check(seed, CHANGES, 2.0)
