"""A recursion over samples: compiled, on CasADi's virtual machine and in numpy."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest

from malta.simulation.engine import engines
from malta.simulation.engine.sample_loops import SAMPLES_AT_ONCE, SampleLoop, loop_of


def damped() -> SampleLoop:
    """x+ = a (x + (0, u)) turned by sin(x), with a row of x and u^2."""
    x, u, v, a = ca.SX.sym("x", 2), ca.SX.sym("u"), ca.SX.sym("v"), ca.SX.sym("a")
    after = ca.vertcat(a * x[1], ca.sin(x[0]) + u - v)
    return loop_of(x, ca.vertcat(u, v), a, after, ca.vertcat(x, u**2))


@pytest.mark.parametrize("compiles", [True, False])
@pytest.mark.parametrize("samples", [1, SAMPLES_AT_ONCE, 2 * SAMPLES_AT_ONCE + 7])
def test_rows_are_those_of_a_plain_loop(
    samples: int, compiles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not compiles:
        monkeypatch.setattr(engines, "library", lambda *_, **__: None)
    u = np.random.default_rng(0).standard_normal((samples, 2))
    x, rows = np.array([0.1, -0.2]), []
    for one in u:
        rows.append([*x, one[0] ** 2])
        x = np.array([0.5 * x[1], np.sin(x[0]) + one[0] - one[1]])
    first = np.array([0.1, -0.2])
    found = damped()(first, [u[:, :1], u[:, 1:]], np.array([0.5]))
    assert np.abs(found - rows).max() < 1e-12
    assert first.tolist() == [0.1, -0.2]
    assert damped()(first, [u[:, :1], u[:, 1:]], np.array([0.5]), first) == pytest.approx(np.array(rows))
    assert first == pytest.approx(x, abs=1e-12)
