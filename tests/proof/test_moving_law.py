"""How fast a parameter may vary of which the law depends too: beside the older proof, finite differences, courses."""

from __future__ import annotations

from typing import Any

import control
import numpy as np
import pytest
from flint import arb
from scipy import linalg

import malta
from malta.linear.compensators import compensator_of
from malta.linear.uncertain import Compensator
from malta.margins import schedule_rate, schedule_rates
from malta.margins.schedule_rates import rate_of_cells
from malta.margins.scheduled_loops import loops_between_places
from malta.proof.polynomial.enclosure import precision
from malta.proof.rates import BITS, middle

TS = 0.01  # s


def _spring(k: Any) -> Any:
    return [[0, 1], [-k, -0.2]], [[0], [1]], [[1, 0]]


def _damping() -> Compensator:
    lead = control.c2d(control.ss(control.tf([-3, -1], [0.05, 1])), TS, "tustin")
    return compensator_of(lead, 1, 1)


@pytest.mark.slow
def test_a_constant_law_has_the_bound_of_the_affine_proof() -> None:
    """One bound of P, and two of curvature and of the motion within a sample: the older one is coarser."""
    spring, law = malta.uncertain(_spring, {"k": 2.0}), _damping()
    affine = malta.proof.prove_rate(spring, law, "k", (1.0, 3.0))
    whole = rate_of_cells([(spring, law, (1.0, 3.0))])
    halves = rate_of_cells([(spring, law, (1.0, 2.0)), (spring, law, (2.0, 3.0))])
    assert affine.rate is not None
    for found in (whole, halves):
        assert found.rate is not None
        assert affine.rate <= found.rate < 3 * affine.rate
        assert found.decay == pytest.approx(affine.decay, rel=1e-6)


def test_nothing_is_proven_of_a_loop_that_is_unstable_at_a_value() -> None:
    push = Compensator(
        np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), np.array([[1.5]]), sample_time=TS
    )
    found = rate_of_cells([(malta.uncertain(_spring, {"k": 2.0}), push, (1.0, 3.0))])
    assert found.rate is None
    assert "unstable" in found.reason


@pytest.mark.parametrize(
    "law",
    [
        Compensator(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), -np.eye(1)),
        Compensator(
            np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), -np.eye(1), sample_time=TS, delay=1
        ),
    ],
)
def test_other_laws_are_refused(law: Compensator) -> None:
    with pytest.raises(malta.InputError, match="one parameter under sampled laws"):
        rate_of_cells([(malta.uncertain(_spring, {"k": 2.0}), law, (1.0, 3.0))])


@pytest.fixture(scope="module")
def magnet() -> tuple[Any, Any]:
    spec = malta.read_design("examples/magnet/design/scheduled.toml")
    return spec.plant, malta.synthesize(spec, malta.linearize(spec.plant, spec.plant.at()))


@pytest.mark.slow
def test_the_enclosure_holds_the_loop_and_its_curvature(magnet: tuple[Any, Any]) -> None:
    """Phi at a place beside the machine's own loop; Phi'' on an interval beside differences of Phi."""
    cells = loops_between_places(*magnet, (), "lag")
    assert not isinstance(cells, str)
    with precision(BITS):
        for cell in schedule_rates._cells_of(cells):
            p, h = (cell.low + cell.high) / 2, 1e-5
            below, here, above = (middle(cell.at(p + d)) for d in (-h, 0.0, h))
            second, _ = cell.curvature(arb(p, h))
            i = float(magnet[0].position_of([p])[2])
            own = np.abs(np.linalg.eigvals(malta.loop(*magnet, q=p, i=i).matrix)).max()
            assert np.abs(np.linalg.eigvals(here)).max() == pytest.approx(own, rel=1e-9)
            found = (above - 2 * here + below) / h**2
            bounds = np.array([[float(abs(x).upper()) for x in row] for row in second.tolist()])
            assert (np.abs(found) <= bounds * (1 + 1e-3) + 1e-4 * bounds.max()).all()
            assert np.abs(found).max() > 0.3 * bounds.max()


@pytest.mark.slow
def test_courses_as_fast_as_proven_decay(magnet: tuple[Any, Any]) -> None:
    """The machine between samples in steps, its place on sawtooths of the proven rate; the law that of the sample."""
    bound = schedule_rate(*magnet)
    assert bound.rate is not None
    assert bound.rate > 3e-3  # m/s, what the design file lets references do
    cells = loops_between_places(*magnet, (), "lag")
    assert not isinstance(cells, str)
    T, rng, steps, p, way = magnet[1].sample_time, np.random.default_rng(2), 4, 0.0, bound.rate
    functions = [schedule_rates._expressions(*cell[:2], None) for cell in cells]
    n = functions[0][2]
    whole = np.eye(functions[0][0].size1_out(1))
    for _ in range(600):
        if rng.uniform() < 0.02 or abs(p + way * T) > 2.9e-3:
            way = -way
        parts = next(f for (f, _, _), cell in zip(functions, cells, strict=True) if p <= cell.interval[1])
        L, R = (np.array(x) for x in parts(p)[1:])
        z = R @ whole
        for k in range(steps):
            between = np.array(parts(p + way * T * (k + 0.5) / steps)[0])
            z = linalg.expm(between * T / steps) @ z
        whole, p = L @ whole, p + way * T
        whole[:n] += z[:n]
    assert np.abs(np.linalg.eigvals(whole)).max() < 1e-4
