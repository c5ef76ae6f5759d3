"""The benchmark collections CAREX and DAREX (Benner, Laub, Mehrmann 1995, 1997) beside solutions in 400 bits.

riccati_examples.json holds their matrices with the default parameters, as SLICOT's BB01AD and BB02AD make them.
Left out: 2.9, 3.2 and 4.2 .. 4.4 of CAREX, 1.13 and 4.1 of DAREX, of 26 states and more.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from conftest import ROOT
from scipy import linalg

from malta.synthesis.riccati import RiccatiSolution, care, dare

if TYPE_CHECKING:
    from malta.arrays import FloatArray

flint = pytest.importorskip("flint")

BITS, STEPS, DOUBLINGS = 400, 12, 60
EXAMPLES: dict[str, Any] = json.loads(
    Path(ROOT, "tests", "riccati_examples.json").read_text(encoding="utf-8")
)
SINGULAR = {"DAREX 1.1", "DAREX 1.2", "DAREX 1.4"}  # weights of inputs
INDEFINITE = {"CAREX 1.3", "CAREX 1.4", "CAREX 2.5", "DAREX 1.2", "DAREX 1.4"}  # weights of states
ACCURACY = 1e-11  # of X, or ten times what scipy misses it by: some examples are ill-conditioned
SLOW = {"CAREX 1.6", "CAREX 3.1", "CAREX 4.1"}  # of 21 states and more, in many bits


def matrices(name: str) -> dict[str, FloatArray]:
    """A, B, Q, R and N of an example."""
    found = {}
    for key, table in EXAMPLES[name].items():
        found[key] = np.zeros(table["shape"])
        for i, j, value in table["entries"]:
            found[key][i, j] = value
    found.setdefault("N", np.zeros_like(found["B"]))
    return found


def solve(name: str) -> RiccatiSolution:
    M = matrices(name)
    if name.startswith("DAREX"):
        return dare(M["A"], M["B"], M["Q"], M["R"], M["N"])
    return care(M["A"], M["B"], M["Q"], M["R"], N=M["N"])


@pytest.fixture(autouse=True)
def _many_bits() -> Iterator[None]:
    before, flint.ctx.prec = flint.ctx.prec, BITS
    yield
    flint.ctx.prec = before


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in EXAMPLES]
)
def test_an_example_is_solved_to_its_digits(name: str) -> None:
    found = solve(name)
    X, K = exact_solution(name, found.X)
    size = np.abs(X).max()
    missed = np.abs(of_scipy(name) - X).max() / size
    assert np.abs(found.X - X).max() <= max(ACCURACY, 10 * missed) * size
    assert np.abs(found.K - K).max() <= max(1e-7, 10 * missed) * np.abs(K).max() + 1e-20
    assert found.residual < 1e-12


@pytest.mark.parametrize("name", ["CAREX 2.1", "CAREX 2.6", "DAREX 2.3", "DAREX 2.4"])
def test_examples_that_scaling_gives_more_digits(name: str) -> None:
    """Where scipy's X has lost three digits and more."""
    X, _ = exact_solution(name, solve(name).X)
    assert np.abs(of_scipy(name) - X).max() > 1e-13 * np.abs(X).max()
    assert np.abs(solve(name).X - X).max() < 1e-14 * np.abs(X).max()


def of_scipy(name: str) -> FloatArray:
    M = matrices(name)
    solver = linalg.solve_discrete_are if name.startswith("DAREX") else linalg.solve_continuous_are
    return np.asarray(solver(M["A"], M["B"], M["Q"], M["R"], s=M["N"]))


def test_the_collection_has_singular_and_indefinite_weights() -> None:
    """Those that a solver for definite weights refuses."""
    weights = {name: matrices(name) for name in EXAMPLES}
    least = {
        name: float(np.linalg.eigvalsh(M["Q"]).min() / np.abs(M["Q"]).max()) for name, M in weights.items()
    }
    assert {name for name, value in least.items() if value < -1e-9} == INDEFINITE
    assert {name for name, M in weights.items() if np.linalg.matrix_rank(M["R"]) < len(M["R"])} == SINGULAR


def exact_solution(name: str, start: FloatArray) -> tuple[FloatArray, FloatArray]:
    """X and K by Newton's steps in many bits; the stabilizing solution is the only one with a stable closed loop."""
    M = {key: _many(value) for key, value in matrices(name).items()}
    A, B, Q, R, N = (M[key] for key in "ABQRN")
    discrete, X = name.startswith("DAREX"), _many(start)
    for _ in range(STEPS):
        if discrete:
            K = _mid((R + B.transpose() * X * B).inv() * (B.transpose() * X * A + N.transpose()))
        else:
            K = _mid(R.inv() * (B.transpose() * X + N.transpose()))
        F = A - B * K
        cost = Q - N * K - K.transpose() * N.transpose() + K.transpose() * R * K
        X = _lyapunov(F, cost, discrete=discrete)
    poles = np.linalg.eigvals(_floats(F))
    assert np.abs(poles).max() < 1 if discrete else poles.real.max() < 0
    left = cost + (F.transpose() * X * F - X if discrete else F.transpose() * X + X * F)
    assert np.abs(_floats(left)).max() <= 1e-30 * np.abs(_floats(X)).max()
    return _floats(X), _floats(K)


def _lyapunov(F: Any, cost: Any, *, discrete: bool) -> Any:
    """P of F'PF - P + cost = 0, or of F'P + PF + cost = 0 by Cayley's transform, as a sum that is doubled."""
    if not discrete:
        one = _many(np.eye(F.nrows()) * float(np.abs(np.linalg.eigvals(_floats(F))).max()))
        back = _mid((one - F).inv())
        F, cost = _mid((one + F) * back), _mid(2 * one[0, 0] * (back.transpose() * cost * back))
    P = cost
    for _ in range(DOUBLINGS):
        P, F = _mid(P + F.transpose() * P * F), _mid(F * F)
    return P


def _many(M: FloatArray) -> Any:
    return flint.arb_mat(M.tolist())


def _mid(M: Any) -> Any:
    return M.mid()


def _floats(M: Any) -> FloatArray:
    return np.array([[float(x) for x in row] for row in M.tolist()])
