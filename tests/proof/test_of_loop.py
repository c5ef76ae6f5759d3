"""robust_margin takes a Loop: the same margin as of its matrices, and a sentence for what is neither."""

from __future__ import annotations

from typing import Any

import pytest

import malta


@pytest.fixture(scope="module")
def loop() -> malta.loops.Loop:
    """The shipped ball with its PID."""
    spec = malta.read_design("examples/ball/design/ball_pid.toml")
    model = malta.linearize(spec.plant, spec.plant.at())
    return malta.loop(spec.plant, malta.synthesize(spec, model))


@pytest.mark.slow
def test_a_loop_brings_its_law(loop: malta.loops.Loop) -> None:
    ranges = {"m": 0.1, "C": 0.1}
    found = malta.robust_margin(loop, ranges)
    apart = malta.robust_margin(*loop.uncertain(("m", "C")), ranges)
    assert (found.lower, found.upper, found.cells) == (apart.lower, apart.upper, apart.cells)
    assert found.lower is not None
    assert found.lower > 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "ranges: found None, expected robust_margin(loop, ranges)"),
        (([[1.0]],), "ranges: found"),
        (({"m": 0.1}, {"m": 0.1}), "ranges: found more than a Loop and ranges"),
        (({"q": 0.1},), "q: found an unknown parameter"),
    ],
)
def test_what_does_not_go_with_a_loop_is_refused(
    loop: malta.loops.Loop, arguments: tuple[Any, ...], said: str
) -> None:
    with pytest.raises(malta.InputError) as refused:
        malta.robust_margin(loop, *arguments)
    assert said in str(refused.value)


def test_neither_a_loop_nor_a_system_is_refused() -> None:
    with pytest.raises(
        malta.InputError, match=r"system: found 3, expected a malta\.uncertain system, or a Loop"
    ):
        malta.robust_margin(3, {"m": 0.1})  # type: ignore[arg-type]
    spring = malta.uncertain(lambda k: ([[-k]], [[1.0]], [[1.0]]), {"k": 1.0})
    with pytest.raises(malta.InputError, match="ranges: found None, expected values by name"):
        malta.robust_margin(spring, [[0.5]])


def test_the_margin_of_a_loop_says_where_it_has_moved(loop: malta.loops.Loop) -> None:
    with pytest.raises(malta.InputError, match=r"expected malta\.robust_margin\(loop, ranges\)"):
        loop.margin({"m": 0.1})
