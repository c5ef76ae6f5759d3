"""BLAS on one thread inside the public functions, and on as many as before after them."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np
import pytest
import threadpoolctl

import malta
from malta.processes import on_one_thread, one_blas_thread

if TYPE_CHECKING:
    from collections.abc import Iterator

    from malta.model.linearize import LinearModel


def threads() -> set[int]:
    """How many threads the BLAS of numpy and scipy use now; slycot brings its own."""
    return {
        library["num_threads"]
        for library in threadpoolctl.threadpool_info()
        if library["user_api"] == "blas" and "slycot" not in library["filepath"]
    }


@pytest.fixture
def _two_threads() -> Iterator[None]:
    with threadpoolctl.threadpool_limits(limits=2, user_api="blas"):
        assert threads() == {2}
        yield


@pytest.mark.usefixtures("_two_threads")
def test_the_limit_ends_with_the_last_block() -> None:
    with one_blas_thread():
        with one_blas_thread():
            assert threads() == {1}
        assert threads() == {1}
    assert threads() == {2}


@pytest.mark.usefixtures("_two_threads")
def test_an_error_restores_the_threads() -> None:
    seen = []

    @on_one_thread
    def failing() -> None:
        seen.append(threads())
        raise ArithmeticError

    with pytest.raises(ArithmeticError):
        failing()
    assert seen == [{1}]
    assert threads() == {2}


@pytest.mark.usefixtures("_two_threads")
def test_a_block_of_another_thread_leaves_the_limit_of_this_one() -> None:
    inside, leave, seen = threading.Event(), threading.Event(), []

    def other() -> None:
        with one_blas_thread():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    thread.start()
    inside.wait(10)
    with one_blas_thread():
        leave.set()
        thread.join()
        seen.append(threads())
    assert seen == [{1}]
    assert threads() == {2}


@pytest.mark.slow
@pytest.mark.usefixtures("_two_threads")
def test_public_functions_limit_themselves(model: LinearModel, monkeypatch: pytest.MonkeyPatch) -> None:
    seen, solved = [], np.linalg.solve

    def solve(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        seen.append(threads())
        return np.asarray(solved(a, b))

    spec = malta.read_design("design/table2.toml")
    spec = spec.replace({"bases.state.x": 51e-6})  # asked by no other test: what was computed is kept
    monkeypatch.setattr(np.linalg, "solve", solve)
    malta.verify(model, malta.synthesize(spec, model))
    assert seen
    assert set.union(*seen) == {1}
    assert threads() == {2}
