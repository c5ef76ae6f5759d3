"""Systems of python-control and back: no state and no pole is lost, whatever else is installed."""

from __future__ import annotations

import math
import sys
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import malta
from malta.linear.conversion import from_control
from malta.linear.system import System


def read(source: Any, **options: Any) -> Any:
    return from_control(source, "page", "plant", **options)


@pytest.fixture(params=["with slycot", "without slycot"])
def optional(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "without slycot":
        monkeypatch.setitem(sys.modules, "slycot", None)


PLANT = malta.uncertain(lambda k: ([[-1.0]], [[k]], [[1.0]]), {"k": 1.0})


@pytest.mark.usefixtures("optional")
def test_a_pole_that_a_zero_cancels_stays() -> None:
    hidden = control.tf([1, -1], np.polymul([1, -1], [1, 2]))  # (s - 1) / ((s - 1) (s + 2))
    assert malta.robust_margin(PLANT, -hidden, {"k": 0.5}).lower == 0
    sampled = control.tf([0.1, -0.2], np.polymul([1, -2], [1, -0.5]), 0.01)
    assert malta.robust_margin(PLANT, -sampled, {"k": 0.5}).lower == 0
    assert len(malta.proof.series(hidden, PLANT).state_space(k=1).A) == 3
    L = control.tf([1, -1], [1, 2]) * control.tf([1], [1, -1])
    margins = malta.loops.loop_curves(L).margins[0]
    assert (margins.stable, margins.unstable_poles) == (False, 1)
    assert (
        not malta.loops.loop_curves(control.tf([1], [1, -1]), control.tf([1, -1], [1, 2])).margins[0].stable
    )


@pytest.mark.usefixtures("optional")
def test_a_law_of_order_16_is_stable_as_its_poles_are() -> None:
    """Poles from 6e-5 to 600 rad/s, three of them in a cluster: companion forms have one at +1e-3."""
    w = 2 * np.pi
    pairs = np.array([-0.5 + 0.866j, -0.019 + 0.0148j, -0.01056 + 0.0158j, -1.0024e-5 + 4.15e-8j])
    real = [-100, -1, -0.03, -0.016, -6.88e-4, -1e-4, -1.00001e-4, -0.9952e-5]
    p = w * np.concatenate([pairs, pairs.conj(), real])
    law = control.tf(np.poly([-1e-3, -2e-3, -0.1, -0.05, -0.2]) * 100, np.poly(p).real)
    plant = malta.uncertain(lambda k: ([[-k]], [[1]], [[0.0]]), {"k": 1.0})  # y = 0: the loop is the law
    assert (malta.robust_margin(plant, law, {"k": 0.5}).lower or 0) > 1.99
    assert malta.loops.loop_curves(law).margins[0].unstable_poles == 0
    found = np.sort(read(law).poles.real)
    # a cluster of k roots moves by the k-th root of what rounding has changed in the coefficients
    np.testing.assert_allclose(found, np.sort(p.real), rtol=100 * np.finfo(float).eps ** (1 / 3))
    s = 1j * np.geomspace(1e-6, 1e5, 31)
    np.testing.assert_allclose(read(law).response(s)[:, 0, 0], law(s), rtol=1e-9)


def polynomial(rng: Any, order: int) -> Any:
    roots: list[Any] = []
    while len(roots) < order:
        size = float(10 ** rng.uniform(-2, 2))
        if order - len(roots) > 1 and rng.random() < 0.5:
            r = size * complex(rng.normal(), rng.normal())
            roots += [r, r.conjugate()]
        else:
            roots.append(size * rng.normal())
    return np.atleast_1d(np.poly(roots).real)


@settings(max_examples=60)
@given(st.integers(0, 10**6), st.integers(0, 9), st.sampled_from([None, 1e-3, 0.5]))
def test_every_state_and_every_response_stays(seed: int, order: int, dt: float | None) -> None:
    rng = np.random.default_rng(seed)
    den = polynomial(rng, order)
    num = polynomial(rng, int(rng.integers(0, order + 1))) * rng.normal()
    shared = polynomial(rng, int(rng.integers(0, 3)))  # what both have is not cancelled
    law = control.tf(np.polymul(num, shared), np.polymul(den, shared), dt or 0)
    system = read(law, differences=True)
    assert len(system.A) == len(den) + len(shared) - 2
    assert system.dt == dt
    s = 1j * np.geomspace(1e-2, 1e2, 15)
    z = s if dt is None else 1 + dt * s
    response = np.polyval(law.num[0][0], z) / np.polyval(law.den[0][0], z)
    sizes = np.polyval(np.abs(law.num[0][0]), np.abs(z)) / np.abs(np.polyval(law.den[0][0], z))
    spread = np.polyval(np.abs(law.den[0][0]), np.abs(z)) / np.abs(np.polyval(law.den[0][0], z))
    resolvent = np.abs(np.linalg.inv(s[:, None, None] * np.eye(len(system.A)) - system.A))
    C, B = np.abs(system.C), np.abs(system.B)
    own = (
        C @ resolvent @ (np.abs(system.A) + np.abs(s)[:, None, None] * np.eye(len(system.A))) @ resolvent @ B
    )
    condition = sizes + spread * np.abs(response) + own[:, 0, 0] + np.abs(system.D).max()
    wrong = np.abs(system.response(s)[:, 0, 0] - response)
    assert (wrong <= 1e3 * np.finfo(float).eps * condition).all()
    assert (
        wrong
        <= 1e-6 * np.abs(response).max() + 1e3 * np.finfo(float).eps * (sizes + spread * np.abs(response))
    ).all()


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(0, 3), st.integers(0, 3), st.integers(0, 2), st.booleans())
def test_poles_that_grow_are_counted(seed: int, decay: int, grow: int, cancelled: int, sampled: bool) -> None:
    """Products of known factors, of which zeros cancel some."""
    rng, dt = np.random.default_rng(seed), 0.1 if sampled else 0
    sides = rng.uniform(0.5, 0.9, decay), rng.uniform(1.1, 1.5, grow + cancelled)
    slow, fast = sides if sampled else (-sides[0], sides[1])
    den, num = np.poly([*slow, *fast]), np.atleast_1d(np.poly(fast[:cancelled]))
    system = read(control.tf(num, den, dt))
    assert len(system.A) == decay + grow + cancelled
    growing = (np.abs(system.poles) > 1) if sampled else (system.poles.real > 0)
    assert growing.sum() == grow + cancelled


@pytest.mark.usefixtures("optional")
def test_several_signals() -> None:
    den = [1, 2, 3]
    G = control.tf([[[1, 2], [2, 0, 3]], [[3], [1, 1]]], [[den, den], [den, [1, 4]]])
    system = read(G)
    assert len(system.A) == 5  # one den per column, and 1 / (s + 4)
    s = 1j * np.geomspace(0.1, 10, 9)
    np.testing.assert_allclose(system.response(s), np.moveaxis(G(s), 2, 0), rtol=1e-12)
    one = np.array([1.0, -1.0])
    alike = control.tf([[[1], [2]], [[3], [6]]], [[one, one], [one, one]])  # of rank 1: one pole at +1
    assert read(alike).poles.tolist() == pytest.approx([1.0])
    full = control.tf([[[1], [2]], [[3], [1]]], [[one, one], [one, one]])
    assert read(full).poles.tolist() == pytest.approx([1.0, 1.0])
    hidden = control.tf([[[1, -1], [0]], [[0], [1]]], [[np.polymul(one, [1, 2]), [1]], [[1], [1, 3]]])
    assert sorted(read(hidden).poles.real.tolist()) == pytest.approx([-3.0, -2.0, 1.0])
    beside = control.tf([[[1, -1], [0]], [[0], [1]]], [[np.polymul(one, [1, 2]), [1]], [[1], one]])
    assert sorted(read(beside).poles.real.tolist()) == pytest.approx([-2.0, 1.0, 1.0])  # of two entries


def test_sample_times() -> None:
    law = control.tf([1], [1, -0.5], True)
    with pytest.raises(malta.InputError, match="page: dt: found True, expected 0, or a sample time"):
        read(law)
    assert read(law, step=1.0).dt == 1.0
    assert read(control.ss([[0.5]], [[1]], [[1]], 0, None)).dt is None
    unknown = control.ss([[0.5]], [[1]], [[1]], 0, None)
    assert read(unknown, step=0.1, differences=True).poles.tolist() == [-5.0]
    sampled = malta.loops.loop_curves(unknown, control.ss([], [], [], [[0.2]], 0.1)).loop
    assert sampled.closed_poles.real.item() == pytest.approx(math.log(0.3) / 0.1)
    slow = read(control.tf([1], [1, -1 + 1e-14], 1e-3), differences=True)
    assert slow.poles.real.item() == pytest.approx((-1 + (1 - 1e-14)) / 1e-3, rel=1e-12)


@pytest.mark.parametrize(
    ("source", "words"),
    [
        (control.tf([1, 0], [1]), "found a TransferFunction with more zeros than poles, 1 over 0"),
        (control.tf([np.nan], [1, 1]), "found a TransferFunction with NaN or infinity"),
        (control.frd([1, 2j], [1.0, 2.0]), "found a FrequencyResponseData"),
        (control.ss([[1]], [[np.inf]], [[1]], 0), "found NaN or infinity"),
        (control.nlsys(None, lambda *args: args[2], inputs=1, outputs=1), "found a NonlinearIOSystem"),
        (3.0, r"found 3\.0, expected a proper control.StateSpace"),
        (None, "found None"),
    ],
)  # fmt: skip
def test_what_has_no_states_is_refused_in_one_sentence(source: Any, words: str) -> None:
    with pytest.raises(malta.InputError, match="page: plant: " + words) as caught:
        read(source)
    assert "\n" not in str(caught.value)


def test_complex_numbers_are_refused() -> None:
    law = control.tf([1], [1, 1])
    law.den_array[0, 0] = np.array([1, 1j])
    with pytest.raises(malta.InputError, match="found a TransferFunction with complex coefficients"):
        read(law)

    class Rotating:
        A, B, C, D, dt = np.array([[1j]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 0

    with pytest.raises(malta.InputError, match="plant: found complex matrices, expected real matrices"):
        read(Rotating())


def test_there_and_back() -> None:
    names = {"states": ["a", "b"], "inputs": ["u"], "outputs": ["y"]}
    given = control.ss([[0, 1], [-1e6, -1]], [[0], [1]], [[1, 0]], [[0.5]], 0.1, name="one", **names)
    back = read(given).to_control("one")
    assert (back.state_labels, back.input_labels, back.output_labels) == (["a", "b"], ["u"], ["y"])
    assert (back.dt, back.name) == (0.1, "one")
    z = np.exp(1j * np.array([0.1, 1.0]))
    np.testing.assert_allclose(back(z), given(z), rtol=1e-13)


def test_a_loop_of_records_is_that_of_python_control() -> None:
    P, C = control.tf([1], [1, 0, -1]), control.tf([40, 30], [1, 20])
    found = malta.loops.loop_curves(read(P), read(C)).loop
    expected = malta.loops.loop_curves(P, C).loop
    np.testing.assert_allclose(found.closed_poles, expected.closed_poles, rtol=1e-12)
    assert [s.name for s in found.outputs] == [s.name for s in expected.outputs]
    bare = System(*read(P).matrices)
    assert [s.name for s in malta.loops.loop_curves(bare, read(C)).loop.outputs] == ["y[0]"]
    assert (malta.robust_margin(PLANT, read(-C), {"k": 0.5}).lower or 0) > 0
