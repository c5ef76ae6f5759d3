"""Figures of tunable loops: derivatives by two ways, peaks beside control.linfnorm, noise beside impulse responses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import malta
from malta import structured
from malta.linear.peaks import peak_gain, response_at
from malta.linear.system import System
from malta.structured.loops import ClosedLoop, TunedPlant, models_of_systems, noise, peaks_of
from malta.synthesis.structure import Structure, places_of, sample_law

GOALS = {
    "sensitivity": structured.sensitivity(2.0),
    "at the forces": structured.sensitivity(2.0, at="forces"),
    "disk": structured.disk_margin(0.8),
    "compliance": structured.gain_limit("load", "output", 0.01, weight=control.tf([1, 50], [1, 1])),
    "several signals": structured.gain_limit(["load", "reference"], ["error", "force"], 10.0),
    "tracking": structured.tracking(0.05),
    "noise": structured.noise_limit({"load": 1e-3}, "output", 1e-3),
    "poles": structured.poles(decay=5.0, damping=0.5, fastest=1e3),
    "stable law": structured.stable_law(decay=5.0, damping=0.5, fastest=1e3),
}


def levitated(Ts: float | None, law: structured.Element, D: float = 0.0) -> tuple[TunedPlant, Structure]:
    """A body with a negative stiffness, and a law for it."""
    plant = control.ss([[0, 1], [400, -2]], [[0], [10]], [[1, 0]], D)
    (model,) = models_of_systems(plant if Ts is None else control.c2d(plant, Ts, "zoh"))
    return model, Structure(places_of(law, model.inputs, model.outputs))


def law_of_all_kinds() -> structured.Element:
    pid = structured.pid("pid", Kp=120.0, Ki=400.0, Kd=3.0, filter=2e-3)
    return pid * structured.lead("lead", 500.0, 2000.0) * structured.notch("notch", 800.0, 0.4, 0.6)


def stable_system(seed: int, n: int, m: int, p: int) -> System:
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    A -= (np.linalg.eigvals(A).real.max() + 0.05) * np.eye(n)
    return System(A, rng.normal(size=(n, m)), rng.normal(size=(p, n)), rng.normal(size=(p, m)))


@pytest.mark.parametrize("Ts", [None, 1e-3])
@pytest.mark.parametrize("name", GOALS)
def test_derivatives_are_those_of_differences(name: str, Ts: float | None) -> None:
    model, structure = levitated(Ts, law_of_all_kinds(), 0.0 if name == "noise" else 1e-5)
    size = len(structure.parameters)
    x = np.random.default_rng(1).normal(size=size) * 0.05

    def largest(x: np.ndarray) -> float:
        return max(f.value for f in GOALS[name].figures(ClosedLoop(model, structure.theta(x)[0])))

    theta, slope = structure.theta(x)
    figures = GOALS[name].figures(ClosedLoop(model, theta))
    top = max(figures, key=lambda f: f.value)
    own = top.slope.ravel(order="F") @ slope
    step = 1e-5 * np.eye(size)
    differences = np.array([(largest(x + d) - largest(x - d)) / 2e-5 for d in step])
    assert np.abs(own - differences).max() < 1e-4 * np.abs(differences).max()


@settings(max_examples=15)
@given(st.integers(0, 10_000), st.integers(1, 6), st.integers(1, 2), st.integers(1, 2))
def test_peaks_are_those_of_control_and_no_grid_is_above(seed: int, n: int, m: int, p: int) -> None:
    system = stable_system(seed, n, m, p)
    value, w = peak_gain(system)
    known, _ = control.linfnorm(control.ss(*system), tol=1e-9)
    assert value == pytest.approx(known, rel=1e-5)
    grid = np.geomspace(1e-4, 1e4, 500)
    sizes = np.linalg.norm(control.ss(*system)(1j * grid, squeeze=False).transpose(2, 0, 1), 2, axis=(1, 2))
    assert sizes.max() <= value * (1 + 1e-6)
    found = peaks_of(system)
    assert max(peak.value for peak in found) == pytest.approx(value, rel=1e-5)
    assert w >= 0


def test_a_peak_that_a_grid_misses_is_found() -> None:
    """1 / (s^2 + 2 zeta s + 1) peaks at 1 / (2 zeta sqrt(1 - zeta^2)) within a band of 2 zeta."""
    zeta = 1e-7
    narrow = System(
        np.array([[0.0, 1.0], [-1.0, -2 * zeta]]), np.eye(2, 1, -1), np.eye(1, 2), np.zeros((1, 1))
    )
    assert peak_gain(narrow)[0] == pytest.approx(1 / (2 * zeta * math.sqrt(1 - zeta**2)), rel=1e-5)


@settings(max_examples=10)
@given(st.integers(0, 10_000), st.integers(1, 5))
def test_noise_is_the_impulse_response(seed: int, n: int) -> None:
    system = stable_system(seed, n, 2, 2)
    system = replace(system, A=system.A - np.eye(n), D=np.zeros((2, 2)))
    t = np.linspace(0, 14, 7001)
    values, vectors = np.linalg.eig(system.A)
    inner = np.einsum(
        "pk,kt,km->pmt", system.C @ vectors, np.exp(np.outer(values, t)), np.linalg.solve(vectors, system.B)
    )
    energy = np.trapezoid((np.abs(inner) ** 2).sum(axis=(0, 1)), t)
    assert noise(system)[0] == pytest.approx(math.sqrt(energy), rel=1e-4)


def test_noise_of_a_sampled_loop_is_that_of_its_samples() -> None:
    model, structure = levitated(1e-3, structured.pid("pid", Kp=120.0, Kd=3.0, filter=2e-3))
    goal = structured.noise_limit({"reference": 2e-3}, "force", 1.0)
    theta, _ = structure.theta(np.zeros(3))
    (figure,) = goal.figures(ClosedLoop(model, theta))
    plant = control.c2d(control.ss([[0, 1], [400, -2]], [[0], [10]], [[1, 0]], 0), 1e-3, "zoh")
    K = control.ss(*sample_law(structure.system(np.zeros(3)), 1e-3), 1e-3)
    loop = control.feedback(K, plant)
    X = control.dlyap(loop.A, loop.B @ loop.B.T)
    rms = 2e-3 * math.sqrt((loop.C @ X @ loop.C.T + loop.D @ loop.D.T).item())
    assert figure.value == pytest.approx(rms, rel=1e-9)


def test_a_sampled_loop_has_its_own_peaks_and_poles() -> None:
    model, structure = levitated(1e-3, structured.pid("pid", Kp=120.0, Kd=3.0, filter=2e-3))
    loop = ClosedLoop(model, structure.theta(np.zeros(3))[0])
    plant = control.c2d(control.ss([[0, 1], [400, -2]], [[0], [10]], [[1, 0]], 0), 1e-3, "zoh")
    K = control.c2d(control.ss(*structure.system(np.zeros(3))), 1e-3, "tustin")
    S = control.feedback(1, plant * K)
    system, _ = loop.part(loop.rows("error"), loop.columns("reference"))
    assert peak_gain(system)[0] == pytest.approx(control.linfnorm(S)[0], rel=1e-5)
    s = np.array([pole.value for pole in loop.poles()]) * 1e-3 / 2
    mine = (1 + s) / (1 - s)
    known = S.poles()
    assert all(np.abs(known - z).min() < 1e-9 for z in mine)


ELEMENTS: dict[str, tuple[Callable[[], structured.Element], Callable[[complex], complex]]] = {
    "gain": (lambda: structured.gain("e", -3.0), lambda s: -3.0 + 0 * s),
    "pid": (lambda: structured.pid("e", 2.0, 5.0, 0.3, 0.01), lambda s: 2 + 5 / s + 0.3 * s / (1 + 0.01 * s)),
    "lead": (lambda: structured.lead("e", 10.0, 40.0), lambda s: (1 + s / 10) / (1 + s / 40)),
    "notch": (lambda: structured.notch("e", 9.0, 0.1, 0.7), lambda s: (s * s + 1.8 * s + 81) / (s * s + 12.6 * s + 81)),
    "transfer": (
        lambda: structured.transfer("e", [2, 0, 7], [4, 1, 3, 2]),
        lambda s: (2 * s * s + 7) / (4 * s**3 + s * s + 3 * s + 2),
    ),
    "series": (
        lambda: structured.lead("a", 10.0, 40.0) * structured.gain("b", 3.0),
        lambda s: 3 * (1 + s / 10) / (1 + s / 40),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", ELEMENTS)
def test_elements_are_their_transfer_functions(name: str) -> None:
    made, known = ELEMENTS[name]
    s = 1j * np.geomspace(0.1, 1e3, 7)
    assert np.allclose(made().system.response(s)[:, 0, 0], [known(one) for one in s], rtol=1e-9)


def test_an_element_in_two_places_has_its_parameters_once() -> None:
    one = structured.pid("axis", 2.0, 5.0)
    structure = Structure(places_of({"a": one, "b": one}, ["f", "g"], ["a", "b"]))
    assert len(structure.parameters) == 2
    assert structure.order == 2
    moved = structure.at(np.array([math.log(3), 0.0]))
    assert moved.elements[0].values == pytest.approx({"axis.Kp": 6.0, "axis.Ki": 5.0})


def test_a_law_by_places_acts_in_coordinates() -> None:
    """In the coordinates of a centre of gravity: v = inputs f(of_outputs e)."""
    left, right = np.array([[1.0, 1.0], [1.0, -1.0]]), np.array([[0.5, 0.5], [0.5, -0.5]])
    places = [structured.Place(left[:, [k]], structured.gain(f"g{k}", k + 2.0), right[[k]]) for k in range(2)]
    structure = Structure(places_of(places, ["f", "g"], ["a", "b"]))
    assert np.allclose(structure.system(np.zeros(2)).D, left @ np.diag([2.0, 3.0]) @ right)


def test_diagrams_of_elements_are_those_of_their_responses() -> None:
    a = structured.pid("a", 2.0, 3.0, 0.5, 0.1)
    b, n = structured.lead("b", 5.0, 50.0), structured.notch("n", 7.0, 0.1, 0.9)
    w = np.array([0.3, 2.0, 9.0, 40.0])

    def response(element: structured.Element) -> np.ndarray:
        return np.asarray(response_at(element.system, w)[:, 0, 0])

    A, B, N = (response(e) for e in (a, b, n))
    np.testing.assert_allclose(response(a + b), A + B, rtol=1e-12)
    np.testing.assert_allclose(response(a.feedback(b * n)), A / (1 + A * B * N), rtol=1e-12)
    assert list((a + b).values)[-1] == "b.pole"
    with pytest.raises(malta.InputError, match="one parameter twice"):
        a.feedback(a)


def test_an_observer_has_the_poles_of_its_regulator_and_of_its_filter() -> None:
    """The separation theorem: those of A - B K and A - L C."""
    A, B, C = np.array([[0.0, 1.0], [100.0, 0.0]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    K, L = np.array([[300.0, 20.0]]), np.array([[80.0], [3000.0]])
    law = control.ss(*structured.observer("lqg", (A, B, C), K, L).system)
    closed = control.feedback(control.ss(A, B, C, 0) * law, 1).poles()
    expected = np.concatenate([np.linalg.eigvals(A - B @ K), np.linalg.eigvals(A - L @ C)])
    np.testing.assert_allclose(np.sort_complex(closed), np.sort_complex(expected), rtol=1e-9)
    with pytest.raises(malta.InputError, match="matrices that fit"):
        structured.observer("lqg", (A, B, C), K, L.T)


def test_a_plant_that_only_an_unstable_law_holds_has_no_stable_one() -> None:
    """A pole at 3 between zeros at 2 and at infinity: parity interlacing (Youla, Bongiorno and Lu) fails."""
    plant = control.ss(control.tf([1, -2], [1, -4, 3]))
    A, B, C = plant.A, plant.B, plant.C
    K, L = control.place(A, B, [-2, -3]), control.place(A.T, C.T, [-4, -5]).T
    law = structured.observer("lqg", (A, B, C), K, L)
    assert np.linalg.eigvals(law.system.A).real.max() > 0
    held = structured.tune(plant, law, [], starts=1)
    assert np.linalg.eigvals(held.law.A).real.max() > 0
    with pytest.raises(malta.CheckError, match="stable law of damping"):
        structured.tune(plant, law, [structured.stable_law()], starts=1)


@pytest.mark.slow
def test_a_stable_law_counts_no_integrals() -> None:
    law = structured.pid("axis", Kp=3.0, Ki=1.0, Kd=2.0, filter=0.1)
    goals = [structured.stable_law(fastest=8.0), structured.soft(structured.sensitivity(2.0))]
    found = structured.tune(control.tf([1], [1, 0, 0]), law, goals, starts=1)
    assert found.values["axis.filter"] >= 1 / 8
    assert found.reached["stable law"] <= 1
    with pytest.raises(malta.InputError, match="faster than the decay"):
        structured.stable_law(decay=2.0, fastest=1.0)
