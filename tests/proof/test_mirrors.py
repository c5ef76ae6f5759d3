"""Groups of states that are mirror images of each other share their system's minors; others do not."""

from __future__ import annotations

import numpy as np
import pytest

import malta
from malta.linear.uncertain import Compensator
from malta.proof import robust
from malta.proof.groups import groups, loop_of
from malta.proof.polynomial import minors, minors as mirrors
from malta.proof.polynomial.minors import Image, MinorPlaces, first_alike, image_of

ONE, TWO = MinorPlaces((0, 1), (1,)), MinorPlaces((2, 3), (1,))


def planes(
    stiffness: float = 4.0, signs: tuple[float, float, float] = (-1.0, -1.0, 1.0)
) -> malta.proof.UncertainSystem:
    """Two planes x, v and y, w; signs: of y' = w, w' = y, and the second reading, a force along -w."""
    a, b, c = signs
    return malta.uncertain(
        lambda k: (
            [[0, 1, 0, 0], [4 * k, 0, 0, 0], [0, 0, 0, a], [0, 0, b * stiffness * k, 0]],
            [[0, 0], [1, 0], [0, 0], [0, -1]],
            [[1, 0, 0, 0], [0, 0, c, 0]],
        ),
        {"k": 1.0},
    )  # fmt: skip


def law(gain: float = 1.0) -> Compensator:
    """Proportional-derivative control of each plane behind a filter."""
    A, B = -50 * np.eye(2), 50 * np.eye(2)
    return Compensator(A, B, np.diag([1000.0, gain * 1000.0]), np.diag([-1030.0, gain * -1030.0]))


def image(system: malta.proof.UncertainSystem) -> Image | None:
    loop = loop_of(system, law())
    assert loop.symbolic is not None
    return image_of(loop.symbolic, ONE, TWO)


@pytest.mark.parametrize(
    ("signs", "relative"), [((-1.0, -1.0, 1.0), -1), ((1.0, 1.0, -1.0), 1), ((1.0, 1.0, 1.0), 1)]
)
def test_planes_that_differ_in_signs_alone_are_mirror_images(
    signs: tuple[float, float, float], relative: int
) -> None:
    """Signs of forces and readings do not matter: they are no part of the resolvent."""
    found = image(planes(signs=signs))
    assert found is not None
    assert found.of == ONE
    assert found.signs[0] * found.signs[1] == relative


@pytest.mark.parametrize(
    "system",
    [
        planes(stiffness=np.nextafter(4.0, 5.0)),  # the last digit of a number
        planes(signs=(-1.0, 1.0, 1.0)),  # a spring that pulls back in place of one that pushes away
        planes(signs=(-2.0, -0.5, 1.0)),  # other units: equal but for a factor that is no sign
    ],
)
def test_planes_that_differ_in_more_than_signs_are_none(system: malta.proof.UncertainSystem) -> None:
    assert image(system) is None


def test_mirror_images_share_what_is_known_and_keep_their_own_compensators() -> None:
    loop = loop_of(planes(), law(1.1))
    found = [minors.minors(loop, group) for group in groups(loop)]
    one, two = (m for m in found if m is not None)
    assert one.image.of == two.image.of
    assert one.resolvents is two.resolvents
    assert one.kappa != two.kappa


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_margin_of_mirror_images_is_that_without_sharing(
    monkeypatch: pytest.MonkeyPatch, sign: float
) -> None:
    """The second plane has the smaller gain, and loses stability first: the first plane's proof is not enough."""

    def margin(gain: float) -> malta.proof.Margin:
        return malta.robust_margin(planes(signs=(-1.0, -1.0, sign)), law(sign * gain), {"k": 0.2})

    shared = margin(0.5)
    assert shared.lower is not None
    assert shared.upper < 0.75 * margin(1.0).upper
    monkeypatch.setattr(mirrors, "image_of", lambda *_: None)
    for known in (robust.problem_of, minors._kept_minors, mirrors._firsts):
        known.cache_clear()
    alone = margin(0.5)
    assert (shared.lower, shared.upper) == pytest.approx((alone.lower, alone.upper), rel=1e-12)


def test_a_group_without_rational_entries_stands_for_itself() -> None:
    loop = loop_of(planes(), law())
    assert first_alike(loop.program, None, TWO) == Image(TWO, (1, 1))
