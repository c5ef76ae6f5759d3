"""Groups of machines on several threads: each is simulated once, and an error or a wish to stop ends them all."""

from __future__ import annotations

import threading
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from malta.simulation.engine import batch as workers
from malta.simulation.engine.compiled import LANES
from malta.simulation.engine.lanes import Lanes, Shared, TimeSpan, numbers_in_lanes, repeat_in_lanes

SAMPLES, SUBSTEPS = 100, 4


def _work(groups: int, parts: int = 1) -> workers.LaneWork:
    empty = np.zeros((groups, 1, LANES))
    keys = np.zeros((groups, LANES), dtype=np.uint64)
    shared = Shared(np.zeros((SAMPLES, 1)), np.zeros((2, 3)), SUBSTEPS, uniform=False)
    return workers.LaneWork(
        Lanes(empty, empty, empty, keys, empty), shared, [TimeSpan(slice(None), keys) for _ in range(parts)]
    )


def _calls(monkeypatch: pytest.MonkeyPatch, *, fail_at: int | None = None) -> list[slice]:
    """The calls of the engine, which simulates nothing here."""
    calls: list[slice] = []

    def call(_: Any, chosen: slice, *__: Any) -> None:
        calls.append(chosen)
        if fail_at is not None and chosen.start <= fail_at < chosen.stop:
            raise ArithmeticError

    monkeypatch.setattr(workers, "run_many", call)
    return calls


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("threads", [1, 2, 7])
@pytest.mark.parametrize("groups", [1, 2, 13, 500])
def test_every_group_is_simulated_once(
    monkeypatch: pytest.MonkeyPatch, groups: int, threads: int, parts: int
) -> None:
    calls, told = _calls(monkeypatch), list[float]()
    workers.run_groups(None, _work(groups, parts), threads, told.append)
    covered = [k for chosen in calls for k in range(chosen.start, chosen.stop)]
    assert sorted(covered) == list(range(groups))
    assert told.count(1.0) == 1
    assert told[-1] == 1


def test_the_last_calls_are_the_smallest(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = _calls(monkeypatch)
    workers.run_groups(None, _work(200), 1, None)
    sizes = [chosen.stop - chosen.start for chosen in calls]
    assert sizes[0] == 16
    assert sizes[-1] == 1
    assert all(after <= before for before, after in pairwise(sizes))


def test_a_call_has_at_most_so_many_substeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(workers, "WORK", 3 * SAMPLES * SUBSTEPS)
    calls = _calls(monkeypatch)
    workers.run_groups(None, _work(50), 2, None)
    assert max(chosen.stop - chosen.start for chosen in calls) == 3


def test_an_error_ends_all_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = _calls(monkeypatch, fail_at=5)
    with pytest.raises(ArithmeticError):
        workers.run_groups(None, _work(10_000), 1, None)
    assert calls[-1].stop < 10_000


def test_who_is_told_may_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls that wait until progress was reported: what raises there ends the work, and nothing waits for ever."""
    monkeypatch.setattr(workers, "PROGRESS_INTERVAL", 1e-3)
    stopped, calls = threading.Event(), list[slice]()

    def call(_: Any, chosen: slice, *__: Any) -> None:
        if calls:
            assert stopped.wait(10)
        calls.append(chosen)

    def stop(share: float) -> None:
        assert 0 < share < 1
        stopped.set()
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "run_many", call)
    with pytest.raises(KeyboardInterrupt):
        workers.run_groups(None, _work(1000), 2, stop)
    assert sum(chosen.stop - chosen.start for chosen in calls) < 1000


def test_numbers_in_lanes_are_those_of_the_whole_array() -> None:
    own = {2: np.arange(2 * LANES - 5.0), 0: -np.arange(2 * LANES - 5.0)}
    same = np.array([9.0, 0.5, 9.0])
    numbers, whole = numbers_in_lanes(same, own, 2), repeat_in_lanes(same, own, 2)
    assert np.array_equal(numbers.own, whole[:, numbers.places])
    assert (whole[:, 1] == 0.5).all()
