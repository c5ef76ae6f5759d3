"""Laws of lower order: the bound of the error by Hankel singular values, and what is split and not changed."""

from __future__ import annotations

from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, strategies as st
from scipy import linalg

import malta
from malta.linear.conversion import from_control
from malta.linear.system import System
from malta.structured.riccati import split_integrals, truncate


def stable(n: int, seed: int) -> System:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + rng.uniform(0.3, 2)) * np.eye(n)
    return System(A, rng.normal(size=(n, 2)), rng.normal(size=(2, n)), rng.normal(size=(2, 2)))


@given(st.integers(2, 8), st.integers(0, 10_000))
def test_the_error_is_within_twice_the_singular_values_left_out(n: int, seed: int) -> None:
    law = stable(n, seed)
    order, w = n // 2, np.append(0.0, np.geomspace(1e-3, 1e3, 200))
    P, Q = (
        linalg.solve_continuous_lyapunov(law.A, -law.B @ law.B.T),
        linalg.solve_continuous_lyapunov(law.A.T, -law.C.T @ law.C),
    )
    sizes = np.sqrt(np.sort(np.linalg.eigvals(P @ Q).real)[::-1].clip(0))
    error = law.response(1j * w) - truncate(law, order).response(1j * w)
    assert np.linalg.norm(error, 2, axis=(1, 2)).max() <= 2 * sizes[order:].sum() * (1 + 1e-6)
    assert np.linalg.eigvals(truncate(law, order).A).real.max() < 0


def test_integrals_and_the_rest_are_the_law() -> None:
    pid = control.tf([2.0, 30.0, 400.0], [1e-3, 1.0, 0.0])
    law = from_control(pid, "test", "pid")
    integrals, rest = split_integrals(law)
    assert (len(integrals.A), len(rest.A)) == (1, 1)
    s = 1j * np.geomspace(1, 1e5, 50)
    np.testing.assert_allclose(integrals.response(s) + rest.response(s), law.response(s), rtol=1e-9)


def test_what_cannot_be_truncated_is_refused() -> None:
    law = stable(3, 1)
    with pytest.raises(malta.InputError, match="0 to 3"):
        truncate(law, 4)
    with pytest.raises(malta.InputError, match="unstable"):
        truncate(replace(law, A=-law.A), 2)
