"""How far any load moves an output over a box: above every machine of the box, and near to the worst of them."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from scipy import linalg

import malta
from malta.linear.closed_loops import closed_loop
from malta.linear.uncertain import Compensator, UncertainSystem
from malta.proof.box import box_of
from malta.proof.impulse_bounds import Enclosed, l1_norms
from malta.proof.polynomial.enclosure import Unproven
from malta.proof.worst_load import _LoadedLoop, prove_load


def plain(M: np.ndarray) -> Enclosed:
    return Enclosed(M, np.zeros_like(M))


def test_norms_of_random_loops_are_enclosed() -> None:
    rng = np.random.default_rng(2)
    for n in (1, 3, 6):
        M = rng.normal(size=(n, n))
        M *= 0.98 / np.abs(np.linalg.eigvals(M)).max()
        C, E = rng.normal(size=(2, n)), rng.normal(size=(n, 3))
        lower, upper = l1_norms(plain(M), plain(C), plain(E), 0 * E, 1e-6)
        true, X = np.zeros((2, 3)), E
        for _ in range(4000):
            true, X = true + np.abs(C @ X), M @ X
        assert (lower <= true * (1 + 1e-9)).all()
        assert (true <= upper).all()
        assert (upper < 1.001 * lower + 1e-9).all()
        _, wide = l1_norms(Enclosed(M, 1e-9 + 0 * M), plain(C), plain(E), 0 * E, 1e-6)
        assert (wide > upper).all()
        _, loose = l1_norms(plain(M), plain(C), plain(E), 0.1 * np.abs(E), 1e-6)
        assert (loose >= 1.1 * true).all()
        short, far = l1_norms(plain(M), plain(C), plain(E), 0 * E, 0.5)
        assert (short < true).all()
        assert (true <= far).all()


def test_a_loop_that_may_be_unstable_has_no_norm() -> None:
    one = np.ones((1, 1))
    for M in (plain(1.0 * one), plain(-1.01 * one), Enclosed(0.999 * one, 0.01 * one)):
        with pytest.raises(Unproven):
            l1_norms(M, plain(one), plain(one), 0 * one, 1e-3)


def mass(k: float, lag: float | None = None) -> tuple[UncertainSystem, Compensator, ca.Function]:
    """m x'' = c x + u + w, x measured, with a PD law whose delay is k samples, and a lag of its force."""
    p = ca.SX.sym("p", 2)
    A, B = ca.SX(2, 2), ca.SX(2, 1)
    A[0, 1], A[1, 0], B[1, 0] = 1, p[1] / p[0], 1 / p[0]
    matrices = ca.Function("matrices", [p], [A, B, ca.DM([[1.0, 0.0]])])
    system = UncertainSystem(("m", "c"), np.array([1.0, 50.0]), matrices)
    T, one = 1e-3, np.ones((1, 1))
    law = Compensator(0 * one, one, 20 / T * one, -(200 + 20 / T) * one, 0, T, delay=k, lag=lag)
    return system, law, ca.Function("load", [p], [ca.vertcat(0, 1 / p[0])])


def impulse(system: UncertainSystem, law: Compensator, p: np.ndarray) -> np.ndarray:
    """What a load in each twentieth of a sample before makes of x at samples: its sizes add up to the norm, nearly."""
    T, parts = law.sample_time or 0.0, 20
    A = system.at(p[None])[0][0]
    M = np.eye(3 + int(law.delay) + (law.lag is not None)) + T * closed_loop(system, law, p[None])[0]
    b, left = np.array([0, 1 / p[0], 0]), []
    for k in range(parts + 1):
        whole = np.zeros((3, 3))
        whole[:2, :2], whole[:2, 2] = A, b[:2]
        left.append(linalg.expm(whole * T * (1 - k / parts))[:2, 2])
    X = np.zeros((len(M), parts))
    X[:2] = -np.diff(np.array(left), axis=0).T
    rows = []
    for _ in range(3000):
        rows.append(X[0])
        X = M @ X
    return np.array(rows)


def brute_norm(system: UncertainSystem, law: Compensator, p: np.ndarray) -> float:
    """By a load that is constant in twentieths of a sample: below the norm, by little."""
    return float(np.abs(impulse(system, law, p)).sum())


@pytest.mark.parametrize(("delay", "lag"), [(0, None), (1, None), (0, 1500.0), (0, 20e3)])
def test_no_machine_of_the_box_moves_further_than_is_proven(delay: int, lag: float | None) -> None:
    system, law, load = mass(delay, lag)
    box = box_of(system.names, system.nominal, (), {"m": 0.2, "c": (20.0, 90.0)}, {})
    found = prove_load(system, law, load, np.array([1.0, 0.0]), box)
    assert found.upper is not None
    assert 0.95 * found.upper <= found.lower
    sides, rng = box.sides(1.0), np.random.default_rng(delay)
    some = sides[:, 0] + (sides[:, 1] - sides[:, 0]) * rng.random((12, 2))
    norms = [brute_norm(system, law, p) for p in (*some, np.array(list(found.witness.values())))]
    assert max(norms) <= found.upper
    assert norms[-1] == pytest.approx(found.lower, rel=2e-3)
    assert max(norms) == norms[-1]


def test_a_machine_inside_the_box_may_be_the_worst() -> None:
    """x' = -(1 + 4 (a - 1)^2) x + w: the norm is 1 in the middle of the box, and 0.86 at its ends."""
    p = ca.SX.sym("p", 1)
    A = -(1 + 4 * (p - 1) ** 2)
    system = UncertainSystem(
        ("a",), np.ones(1), ca.Function("m", [p], [A, ca.DM.zeros(1, 1), ca.DM.ones(1, 1)])
    )
    none = np.zeros((0, 0))
    law = Compensator(none, np.zeros((0, 1)), np.zeros((1, 0)), np.zeros((1, 1)), 0, 1e-2)
    box = box_of(system.names, system.nominal, (), {"a": 0.2}, {})
    load = ca.Function("load", [p], [ca.DM.ones(1, 1)])
    found = prove_load(system, law, load, np.ones(1), box, tolerance=0.2)
    assert found.upper is not None
    assert found.lower <= 1 <= found.upper < 1.3


def test_nothing_is_proven_of_a_box_that_holds_an_unstable_loop() -> None:
    system, law, load = mass(1)
    box = box_of(system.names, system.nominal, (), {"c": (20.0, 400.0)}, {})
    found = prove_load(system, law, load, np.array([1.0, 0.0]), box, work=2)
    assert found.upper is None
    assert found.reason == "the loop is unstable"


def test_a_parameter_of_which_the_loop_does_not_depend_changes_nothing() -> None:
    system, law, load = mass(0)
    free = UncertainSystem(
        ("m", "c"),
        system.nominal,
        ca.Function("none", [p := ca.SX.sym("p", 2)], system.matrices(system.nominal)),
    )
    still = ca.Function("load", [p], [load(system.nominal)])
    found = prove_load(
        free, law, still, np.array([1.0, 0.0]), box_of(free.names, free.nominal, (), {"m": 0.2}, {})
    )
    assert found.upper is not None
    assert found.upper == pytest.approx(found.lower, rel=2e-3)  # parts of a sample
    assert found.upper >= brute_norm(system, law, system.nominal)


@pytest.mark.parametrize("lag", [300.0, 1500.0])
def test_slopes_of_a_loop_with_a_lag_are_bounded(lag: float) -> None:
    """The second derivative of the impulse response by m, by differences, at a cell of no width."""
    system, law, load = mass(0, lag)
    sides = np.array([[1.0, 1.0], [50.0, 50.0]])
    loop = _LoadedLoop(system, law, load, np.array([1.0, 0.0]), np.array([[0.99, 1.01], [50.0, 50.0]]))
    bent, whole = loop.curvatures(sides)
    h, step = [impulse(system, law, np.array([m, 50.0])) for m in (0.999, 1.0, 1.001)], 1e-3
    assert np.abs(h[1]).sum() <= whole
    true = np.abs(h[2] - 2 * h[1] + h[0]).sum() / step**2
    assert true <= bent[0] <= 100 * true  # a product of three norms


def test_outputs_that_move_with_the_parameters_are_named() -> None:
    system, law, load = mass(1)
    p = ca.SX.sym("p", 2)
    A, B, C = system.matrices(p)
    moved = UncertainSystem(system.names, system.nominal, ca.Function("matrices", [p], [A, B, C * p[0]]))
    box = box_of(system.names, system.nominal, (), {"m": 0.1}, {})
    found = prove_load(moved, law, load, np.array([1.0, 0.0]), box)
    assert (found.upper, found.reason) == (None, "outputs that depend on the parameters")


@pytest.mark.slow
def test_a_shipped_design_is_proven_to_five_percent_of_its_worst_corner() -> None:
    controller = malta.gains.read(ROOT / "design" / "gains" / "structured.json")
    plant = malta.plant_of(controller.parameters)
    ranges = {"m": 0.1, "K_A": 0.1}
    found = malta.worst_waveform(malta.loop(plant, controller), "F_x", "x1", 2.0, ranges)
    over = found.over
    assert over is not None
    assert over.upper is not None
    assert over.lower > 0.95 * over.upper
    assert found.proven.value == pytest.approx(2 * over.upper)
    rng = np.random.default_rng(3)
    for share in (*rng.uniform(-0.1, 0.1, (6, 2)), np.array([0.1, 0.1])):
        own = {name: vars(plant.parameters)[name] * (1 + x) for name, x in zip(ranges, share, strict=True)}
        one = malta.worst_waveform(malta.loop(plant, controller, parameters=own), "F_x", "x1")
        assert one.value < over.upper
    corner = malta.worst_waveform(malta.loop(plant, controller, parameters=dict(over.witness)), "F_x", "x1")
    assert corner.value == pytest.approx(over.lower, rel=1e-3)


@pytest.mark.parametrize(
    ("disturbance", "output"), [("noise x1", "x1"), ("F_x", "fx_B1"), ("F_x", "touchdown at sensor plane 1")]
)
def test_what_is_not_proven_over_a_box_is_refused(disturbance: str, output: str) -> None:
    controller = malta.gains.read(ROOT / "design" / "gains" / "structured.json")
    loop = malta.loop(malta.plant_of(controller.parameters), controller)
    with pytest.raises(malta.InputError, match="worst_waveform: ranges"):
        malta.worst_waveform(loop, disturbance, output, 1.0, {"m": 0.1})
