"""Changes of sign: against roots that are known, and functions that a secant does not find alone."""

from __future__ import annotations

import math

import pytest

from malta.roots import sign_change


@pytest.mark.parametrize(("f", "low", "high", "root"), [
    (lambda x: x * x - 2, 0.0, 2.0, math.sqrt(2)),
    (lambda x: math.exp(x) - 5000, 0.0, 20.0, math.log(5000)),
    (lambda x: math.atan(1e6 * (x - 1e-4)), 0.0, 1.0, 1e-4),
    (lambda x: -1.0 if x < 0.123 else 1e6, 0.0, 1.0, 0.123),
    (lambda x: 0.3 - x, 0.0, 1.0, 0.3),
])  # fmt: skip
def test_a_change_of_sign_is_found_to_the_last_digits(f, low, high, root) -> None:  # type: ignore[no-untyped-def]
    asked = []
    found = sign_change(lambda x: asked.append(x) or f(x), low, high)  # type: ignore[func-returns-value]
    assert found == pytest.approx(root, rel=1e-15, abs=1e-16)
    assert len(asked) < 250
    assert sign_change(f, low, high, 1e-3) == pytest.approx(root, abs=1e-3)


def test_ends_of_one_sign_are_refused() -> None:
    with pytest.raises(ValueError, match=r"no change of sign from 2\.0 to 3\.0"):
        sign_change(lambda x: x * x - 2, 2.0, 3.0)
